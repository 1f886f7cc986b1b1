"""The measured dose factor: every method on the same noise realisations of the paper's scan, in resumable pieces.

Stages, each of them a set of files that are written whole and reused:

1. scenes: noise-free scans, true values by rods, the limit of the data by generalised least squares;
2. exact: FBP and the linear methods without sampling error (:mod:`recon.study.dose_factor.exact_figures`);
3. data: b = AᵀW y of every noise realisation, and FBP of the same readings
   (:mod:`recon.study.dose_factor.realisations`); the linear controls' readings of every b, by inner products;
4. methods: what is read off every reconstruction of the others (:mod:`recon.study.dose_factor.readings`).

All main scenes carry the noise of the paper's scene, seed by seed (the counts behind the core differ by less than 1 %).
So the difference between two of them is free of what noise they have in common.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from recon.evaluate.store import Store
from recon.study.dose_factor.exact_figures import fbp_figures, linear_figures
from recon.study.dose_factor.exact_linear import statistic_covariance
from recon.study.dose_factor.measures import segmentation
from recon.study.dose_factor.methods import Method, fingerprint, load_methods
from recon.study.dose_factor.places import Place, Places, ScenePlace
from recon.study.dose_factor.readings import Readings
from recon.study.dose_factor.realisations import NOISY_SCENE, Realisations, joined
from recon.study.dose_factor.reconstructed import in_parts, reconstructed
from recon.study.dose_factor.response import RESPONSE_DRAWS, linear_response
from recon.study.dose_factor.scene import SceneFacts, StudyScene
from recon.study.dose_factor.settings import (
    FBP_BASE,
    IMAGE_METHODS,
    LINEAR_METHODS,
    MAIN_SCENES,
    Settings,
    fbp_label,
    with_twin,
)
from recon.study.dose_factor.shape_limit import shape_limits
from recon.study.dose_factor.stability import worst_case_gains
from recon.study.dose_factor.vessels import VesselPlace
from recon.study.study import Clock, Progress, silent

__all__ = ["Measured", "measure"]

log = logging.getLogger(__name__)

Floats = NDArray[np.float64]


@dataclass
class Measured:
    """Everything the report needs.

    Attributes:
        settings: of the study; ``methods``: names of the methods that ran, with their fingerprints.
        facts: scene → what holds without sampling error.
        scenes: further scenes; left_out: those that could not be simulated, with the reason.
        distances: direction → distance from the core's surface of the bins of an edge profile, on each of FBP's and the
            methods' grids (keys ``("fbp" or "method", direction)``); fat_shape: ``(y, x)`` voxels of a slice of fat.
        fbp: FBP variant → :func:`recon.study.dose_factor.exact_figures.fbp_figures` at 1 s.
        linear: (method, dose) → :func:`recon.study.dose_factor.exact_figures.linear_figures`, without its adjoints.
        controls: dose → ``readings (n, 2 · rows)`` of the linear controls in the paper's scene, their exact
            ``mean (scenes, 2 · rows)`` and ``covariance``; ``fbp (n, channels)`` of FBP of the same readings.
        responses: (method, dose) → the same of the method's own linear response
            (:mod:`recon.study.dose_factor.response`), a better control; of methods with all realisations.
        samples: (method, scene, dose) → ``readings (n, rows)``, with and without the core ``plane`` and ``z``
            ``(n, bins)``; of the paper's scene also ``fat``, ``edge``, ``square`` and ``shape``.
        extra, vessels: (method, scene or vessel, dose) → :meth:`recon.study.dose_factor.places.Places.found`.
        volumes: (method or "fbp", scene, dose) → first realisation, HU.
        gains: dose → method or FBP variant → worst-case response, HU mm^1.5.
        shape_limits: dose → displacement of the outlines in mm → smallest contrast SD, HU.
        seconds: (method) → s per volume; total_seconds: of this run, with the pieces that it found finished.
    """

    settings: Settings
    methods: dict[str, str]
    facts: dict[str, SceneFacts] = field(default_factory=dict)
    scenes: tuple[str, ...] = ()
    left_out: dict[str, str] = field(default_factory=dict)
    distances: dict[tuple[str, str], Any] = field(default_factory=dict)
    fat_shape: dict[str, tuple[int, int]] = field(default_factory=dict)
    fbp: dict[str, dict[str, Any]] = field(default_factory=dict)
    linear: dict[tuple[str, float], dict[str, Any]] = field(default_factory=dict)
    controls: dict[float, dict[str, Any]] = field(default_factory=dict)
    responses: dict[tuple[str, float], dict[str, Any]] = field(default_factory=dict)
    samples: dict[tuple[str, str, float], dict[str, Any]] = field(default_factory=dict)
    extra: dict[tuple[str, str, float], dict[str, Any]] = field(default_factory=dict)
    vessels: dict[tuple[str, str, float], dict[str, Any]] = field(default_factory=dict)
    volumes: dict[tuple[str, str, float], Any] = field(default_factory=dict)
    gains: dict[float, dict[str, float]] = field(default_factory=dict)
    shape_limits: dict[float, dict[float, float]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    total_seconds: float = 0.0


def measure(settings: Settings, progress: Progress = silent, folder: str | Path | None = None) -> Measured:
    """Measure, or finish a measurement that was interrupted.

    Args:
        settings: what to measure.
        progress: called with the name of the step and its finished fraction.
        folder: of the pieces, made if need be; finished pieces of the same settings are kept and reused. None: they
            are kept until the measurement is complete.

    Raises:
        ValueError: no method to run.
    """
    if folder is None:
        with TemporaryDirectory() as kept:
            return measure(settings, progress, kept)
    clock = Clock()
    study = _Study(settings, Store(Path(folder)), progress)
    study.run()
    clock.lap("all")
    study.m.total_seconds = clock.seconds["all"]
    return study.m


class _Study:
    """A measurement under way: the methods, the scenes that are open, and what has been measured."""

    def __init__(self, settings: Settings, store: Store, progress: Progress) -> None:
        self.settings, self.store, self.report = settings, store, progress
        self.methods = load_methods(settings.methods)
        self.m = Measured(settings, {m.name: fingerprint(m) for m in self.methods})
        self._scenes: dict[str, StudyScene] = {}
        self._of_grid: dict[str, Readings] = {}
        self.noise = Realisations(settings, store, self.scene)

    def scene(self, name: str) -> StudyScene:
        """A scene with its scan; problems (Gram operators) are shared where grid, window and surround agree."""
        if name not in self._scenes:
            self._scenes[name] = StudyScene(name, self.settings, self.store, self._scenes)
        return self._scenes[name]

    def run(self) -> None:
        """All stages."""
        s, m = self.settings, self.m
        self._facts()
        if not s.fast_noise:
            self._data()
        self._exact()
        for name in MAIN_SCENES[:2]:
            m.volumes["fbp", name, s.doses[-1]] = self.noise.picture(name, s.doses[-1])
        for method in self.methods:
            if method.name not in LINEAR_METHODS:
                self._main(method)
        m.extra = self._elsewhere("further scenes", partial(ScenePlace, self.noise), m.scenes)
        m.vessels = self._elsewhere("vessels", partial(VesselPlace, self.noise), s.vessels)
        m.gains = self._bounds(worst_case_gains, self.methods)
        m.shape_limits = self._bounds(shape_limits)

    def _facts(self) -> None:
        """What holds of every scene; further scenes that cannot be simulated are left out, with the reason."""
        names = [*MAIN_SCENES, *(n for name in self.settings.scenes for n in with_twin(name))]
        for k, name in enumerate(names):
            self.report("scenes", k / len(names))
            try:
                self.m.facts[name] = self.scene(name).facts
            except ValueError as error:
                if name in MAIN_SCENES:
                    raise
                log.warning("the scene %s is left out: %s", name, error)
                self.m.left_out[name.partition(":")[0]] = str(error)
            if name not in MAIN_SCENES:
                self.scene(name).release()
        self.report("scenes", 1.0)
        self.m.scenes = tuple(n for n in self.settings.scenes if n not in self.m.left_out)

    def _collected(self, step: str, jobs: Sequence[tuple[Any, Callable[[], dict[str, Any]]]]) -> dict[Any, list[Any]]:
        """The pieces of ``jobs``, each a key and what gives a piece: key → pieces."""
        found: dict[Any, list[Any]] = {}
        for done, (key, piece) in enumerate(jobs):
            self.report(step, done / len(jobs))
            found.setdefault(key, []).append(piece())
        if jobs:
            self.report(step, 1.0)
        return found

    def _readings(self, kind: str) -> Readings:
        """On FBP's or the methods' grid."""
        if kind not in self._of_grid:
            scene = self.scene("paper")
            grid = scene.grid_of(FBP_BASE[1]) if kind == "fbp" else scene.grid
            self._of_grid[kind] = found = Readings(scene, grid, scene.facts.tissue_hu)
            self.m.distances |= {(kind, direction): r for direction, r in found.distances.items()}
            self.m.fat_shape[kind] = found.fat_shape
        return self._of_grid[kind]

    def _exact(self) -> None:
        """FBP and linear methods, and the controls."""
        s, m = self.settings, self.m
        scenes = [self.scene(name) for name in MAIN_SCENES]
        run = {method.name: method for method in self.methods if method.name in LINEAR_METHODS}
        names = [*run, *(c for c in s.controls if c not in run)]
        steps, done = len(s.kernels) + len(s.doses) * len(names), 0
        for kernel in s.kernels:
            self.report("exact: FBP, linear methods", done / steps)
            done += 1
            m.fbp[fbp_label(kernel, FBP_BASE[1])] = self.store.piece(
                f"exact/fbp_{kernel}", f"{self.noise.key} 3",
                partial(fbp_figures, scenes, self._readings("fbp"), kernel),
            )  # fmt: skip
        for method in load_methods(names):
            for dose in s.doses:
                self.report("exact: FBP, linear methods", done / steps)
                done += 1
                place, key = f"exact/{method.name}_{dose:g}s", f"{self.noise.key} {fingerprint(method)} 3"
                kept = in_parts(method, self.store, place, key)
                found = self.store.piece(
                    place, key,
                    partial(linear_figures, kept, scenes, self._readings("method"), dose, not s.fast_noise),
                )  # fmt: skip
                self.store.drop(place)
                m.linear[method.name, dose] = found
        for dose in s.doses:
            m.controls[dose] = self._controls(dose)
        for found in m.linear.values():
            found.pop("adjoints")
        self._readings("fbp")
        self._readings("method")
        self.report("exact: FBP, linear methods", 1.0)

    def _controls(self, dose: float) -> dict[str, Any]:
        s, scene = self.settings, self.scene("paper")
        of = [self.m.linear[name, dose] for name in s.controls]
        g = torch.from_numpy(np.concatenate([c["adjoints"] for c in of])).double()
        offset = np.concatenate([c["offset"] for c in of])
        key = f"{self.noise.key} {[fingerprint(m) for m in load_methods(s.controls)]}"

        def joint() -> dict[str, Any]:
            clean = None if s.fast_noise else scene.clean
            return {"covariance": statistic_covariance(scene.problem, g, dose, clean)}

        def block_of(block: range) -> dict[str, Any]:
            b = self.noise.statistic("paper", dose, block).double()
            found = {"readings": torch.einsum("nzyx,rzyx->nr", b, g).numpy() + offset}
            if not s.fast_noise:
                crops = self.noise.data(NOISY_SCENE, dose, block)["crop"]
                found["fbp"] = self._readings("fbp").channels_of_crops(crops)
            return found

        any_drawn = any(m.name not in LINEAR_METHODS for m in self.methods)
        pieces = [
            self.store.piece(f"controls/{dose:g}s_{k.start}-{k.stop}", key, partial(block_of, k))
            for k in (s.blocks(s.n) if any_drawn else ())
        ]
        return {
            "covariance": self.store.piece(f"exact/controls_{dose:g}s", key, joint)["covariance"],
            "mean": np.concatenate([c["readings"] for c in of], axis=1),
            **(joined(pieces) if pieces else {}),
        }

    def _data(self) -> None:
        """The realisations, if a method needs them."""
        s = self.settings
        if all(m.name in LINEAR_METHODS for m in self.methods):
            return
        jobs = [(dose, block) for dose in s.doses for block in s.blocks(s.n)]
        for done, job in enumerate(jobs):
            self.report("noise realisations, FBP", done / len(jobs))
            self.noise.data(NOISY_SCENE, *job)
        self.report("noise realisations, FBP", 1.0)

    # -- methods --------------------------------------------------------------------------------------------------

    def _main(self, method: Method) -> None:
        s, m = self.settings, self.m
        n = s.realizations(method.name)
        count = {name: n if name in MAIN_SCENES[:2] else min(n, s.slow_n) for name in MAIN_SCENES}
        jobs = [
            ((method.name, name, dose), partial(self._method_piece, method, name, dose, block))
            for name in MAIN_SCENES for dose in s.doses for block in s.blocks(count[name])
        ]  # fmt: skip
        spent = 0.0
        for key, pieces in self._collected(method.name, jobs).items():
            m.samples[key] = joined(pieces)
            if "first" in m.samples[key]:
                m.volumes[key] = m.samples[key].pop("first")
            spent += sum(float(p["seconds"]) for p in pieces)
        m.seconds[method.name] = spent / (sum(count.values()) * len(s.doses))
        if s.responds(method.name):
            for k, dose in enumerate(s.doses):
                self.report(f"{method.name}: its own control", k / len(s.doses))
                found = self._response(method, dose)
                if found is not None:
                    m.responses[method.name, dose] = found

    def _response(self, method: Method, dose: float) -> dict[str, Any] | None:
        """A method's linear response in the paper's scene, as :meth:`_controls`; None: autograd does not see it."""
        s, scene, rows = self.settings, self.scene("paper"), self._readings("method").weights

        def compute() -> dict[str, Any]:
            b = torch.from_numpy(scene.facts.statistic) * dose
            clean = None if s.fast_noise else scene.clean
            found = linear_response(method, scene.problem, rows, b, dose, clean, RESPONSE_DRAWS)
            if found is None:
                return {"seen": np.array(False)}
            main = torch.stack([torch.from_numpy(self.scene(n).facts.statistic) for n in MAIN_SCENES]) * dose
            readings = [found.of(self.noise.statistic("paper", dose, block)) for block in s.blocks(s.n)]
            return {
                "seen": np.array(True), "covariance": found.covariance, "mean": found.of(main),
                "readings": np.concatenate(readings),
            }  # fmt: skip

        key = f"{self.noise.key} {fingerprint(method)} {s.n}"
        found = self.store.piece(f"controls/{method.name}_{dose:g}s", key, compute)
        return found if bool(found["seen"]) else None

    def _method_piece(self, method: Method, name: str, dose: float, block: range) -> dict[str, Any]:
        scene = self.scene(name)

        def compute() -> dict[str, Any]:
            of = self.noise.image_statistic if method.name in IMAGE_METHODS else self.noise.statistic
            b = of(name, dose, block)
            volume, seconds = reconstructed(method, scene.problem, b, dose, self.store, place, key)
            readings = self._readings("method")
            result = {"readings": readings.linear(volume), "seconds": np.array(seconds)}
            if name in MAIN_SCENES[:2]:
                result |= readings.profiles(volume)
                if block.start == 0:
                    result["first"] = volume[0].numpy().astype(np.float16)
            if name == "paper":
                result |= {"fat": readings.fat(volume), "square": readings.squares(volume)}
                result["edge"] = readings.edge(volume)
                result["shape"] = np.array([segmentation(scene, scene.grid, v) for v in volume])
            return result

        place = f"methods/{method.name}/{name}_{dose:g}s_{block.start}-{block.stop}"
        key = f"{self.noise.key} {fingerprint(method)} 4"
        found = self.store.piece(place, key, compute)
        self.store.drop(place)
        return found

    def _scene_methods(self) -> list[Method]:
        s = self.settings
        wanted = bool(self.m.scenes or s.vessels)
        return [m for m in load_methods(s.scene_methods) if m.name not in IMAGE_METHODS] if wanted else []

    def _elsewhere(self, step: str, of: Callable[[str], Place], names: Sequence[str]) -> dict[Any, dict[str, Any]]:
        """Every method at the places of these names: (method, name, dose) → what is found."""
        places, methods = Places(self.noise), self._scene_methods()
        jobs = [(m, name, d) for name in names for m in methods for d in self.settings.scene_doses]
        found, place = {}, None
        for done, (method, name, dose) in enumerate(jobs):
            self.report(step, done / len(jobs))
            if place is None or place[0] != name:
                place = (name, of(name))  # one at a time: what it keeps is large
            found[method.name, name, dose] = places.found(method, place[1], dose)
            if done + 1 == len(jobs):
                self.report(step, 1.0)
        return found

    def _bounds(self, compute: Callable[..., dict[Any, float]], *arguments: Any) -> dict[float, dict[Any, float]]:
        """A bound at every dose, if the settings ask for them."""
        found = {}
        for k, dose in enumerate(self.settings.doses if self.settings.bounds else ()):
            self.report(compute.__name__.replace("_", " "), k / len(self.settings.doses))
            found[dose] = compute(self.noise, *arguments, dose)
        return found
