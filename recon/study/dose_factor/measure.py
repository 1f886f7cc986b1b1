"""The measured dose factor: every method on the same noise realisations of the paper's scan, in resumable pieces.

Stages, each of them a set of files that are written whole and reused:

1. scenes: noise-free scans, what FBP makes of them exactly (means, covariances, images without noise), the limit of
   the data by generalised least squares on exact path lengths;
2. data: b = AᵀW y of every noise realisation, and FBP of the same readings
(:mod:`recon.study.dose_factor.realisations`);
3. methods: ROI means, a crop about the core and segmentation figures of every reconstruction.

The scenes with half and with flipped contrast carry the noise of the paper's scene (the counts behind the core
differ by less than 1 %).
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.study.dose_factor.measures import crop_window, segmentation
from recon.study.dose_factor.methods import Method, fingerprint, load_methods
from recon.study.dose_factor.realisations import Realisations, joined
from recon.study.dose_factor.scene import SceneFacts, StudyScene
from recon.study.dose_factor.settings import IMAGE_METHODS, MAIN_SCENES, NOISY_SCENES, Settings, with_twin
from recon.study.dose_factor.shape_limit import shape_limits
from recon.study.dose_factor.stability import worst_case_gains
from recon.study.dose_factor.store import Store
from recon.study.dose_factor.vessels import VesselScans
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
        fbp: (scene, dose) → FBP realisations (``roi (n, 2)``, ``crop``; of the paper's scene ``shape (slow_n, 3)``, see
            :func:`recon.study.dose_factor.measures.segmentation`); empty with fast noise.
        samples: (method, scene, dose) → the same of each method, ``shape`` of all of its realisations.
        extra: (method, scene, dose) → ``roi`` and, with the core replaced by fibrous tissue, ``absent`` ``(n, 2)``.
        vessels: (method, vessel, dose) → what :class:`recon.study.dose_factor.vessels.VesselScans` reads.
        volumes: (method or "fbp", scene, dose) → first realisation, HU.
        wide: FBP variant → covariance of the means in the wider ROIs at 1 s.
        gains: dose → method or FBP variant → worst-case response, HU mm^1.5.
        shape_limits: dose → displacement of the outlines in mm → smallest contrast SD, HU.
        seconds: (method) → s per volume; total_seconds: of this run, with the pieces that it found finished.
    """

    settings: Settings
    methods: dict[str, str]
    facts: dict[str, SceneFacts] = field(default_factory=dict)
    scenes: tuple[str, ...] = ()
    left_out: dict[str, str] = field(default_factory=dict)
    fbp: dict[tuple[str, float], dict[str, Any]] = field(default_factory=dict)
    samples: dict[tuple[str, str, float], dict[str, Any]] = field(default_factory=dict)
    extra: dict[tuple[str, str, float], dict[str, Any]] = field(default_factory=dict)
    vessels: dict[tuple[str, str, float], dict[str, Any]] = field(default_factory=dict)
    volumes: dict[tuple[str, str, float], Any] = field(default_factory=dict)
    wide: dict[str, Any] = field(default_factory=dict)
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
        if s.fast_noise:
            for name in NOISY_SCENES:
                m.volumes["fbp", name, s.doses[-1]] = self.noise.picture(name, s.doses[-1])
        else:
            self._data()
        for method in self.methods:
            self._main(method)
        self._extra()
        self._vessels()
        m.wide = self.scene("paper").wide_covariance() if s.rois else {}
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
            if name not in NOISY_SCENES:
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

    def _data(self) -> None:
        s, m = self.settings, self.m

        def without_b(name: str, dose: float, block: range) -> dict[str, Any]:
            return {k: v for k, v in self.noise.data(name, dose, block).items() if k != "b"}

        jobs = [
            ((name, dose), partial(without_b, name, dose, block))
            for name in NOISY_SCENES for dose in s.doses for block in s.blocks(s.n)
        ]  # fmt: skip
        for (name, dose), pieces in self._collected("noise realisations, FBP", jobs).items():
            m.fbp[name, dose] = joined(pieces)
            m.volumes["fbp", name, dose] = m.fbp[name, dose].pop("first")
        for dose in s.doses:
            pieces = [self.noise.images("paper", dose, block) for block in s.blocks(min(s.n, s.slow_n))]
            m.fbp["paper", dose]["shape"] = np.concatenate([p["shape"] for p in pieces])

    # -- methods --------------------------------------------------------------------------------------------------

    def _main(self, method: Method) -> None:
        s, m = self.settings, self.m
        n = s.realizations(method.name)
        jobs = [
            ((method.name, name, dose), partial(self._method_piece, method, name, dose, block))
            for dose in s.doses for block in s.blocks(n) for name in MAIN_SCENES
        ]  # fmt: skip
        spent = 0.0
        for key, pieces in self._collected(method.name, jobs).items():
            m.samples[key] = joined(pieces)
            m.volumes[key] = m.samples[key].pop("first")
            spent += sum(float(p["seconds"]) for p in pieces)
        m.seconds[method.name] = spent / (len(MAIN_SCENES) * n * len(s.doses))

    def _method_piece(self, method: Method, name: str, dose: float, block: range) -> dict[str, Any]:
        scene = self.scene(name)

        def compute() -> dict[str, Any]:
            of = self.noise.image_statistic if method.name in IMAGE_METHODS else self.noise.statistic
            volume, seconds = _timed(method, scene, of(name, dose, block), dose)
            rois = scene.rois.on(scene.grid)
            crop = crop_window(scene.grid, scene.core_center)[0]
            result = {
                "roi": torch.stack([r(volume) for r in rois], dim=-1).numpy(),
                "crop": volume[(slice(None), *crop)].numpy().astype(np.float16),
                "shape": np.array([segmentation(scene, scene.grid, v) for v in volume]),
                "seconds": np.array(seconds),
            }
            if block.start == 0:
                result["first"] = volume[0].numpy().astype(np.float16)
            return result

        place = f"methods/{method.name}/{name}_{dose:g}s_{block.start}-{block.stop}"
        return self.store.piece(place, f"{self.noise.key} {fingerprint(method)} 2", compute)

    def _scene_methods(self) -> list[Method]:
        return [m for m in self.methods if m.name in self.settings.scene_methods and m.name not in IMAGE_METHODS]

    def _vessels(self) -> None:
        jobs = VesselScans(self.noise).jobs(self.settings.vessels, self._scene_methods())
        self.m.vessels = {key: joined(pieces) for key, pieces in self._collected("vessels", jobs).items()}

    def _extra(self) -> None:
        s, methods = self.settings, self._scene_methods()
        jobs = [
            ((method.name, name, dose), partial(self._extra_piece, method, name, dose, block))
            for name in self.m.scenes for dose in s.scene_doses for block in s.blocks(s.scene_n) for method in methods
        ]  # fmt: skip
        self.m.extra = {key: joined(pieces) for key, pieces in self._collected("further scenes", jobs).items()}

    def _extra_piece(self, method: Method, name: str, dose: float, block: range) -> dict[str, Any]:
        """ROI means with the scene's core and, on the same noise, with fibrous tissue in its place."""
        scene = self.scene(name)

        def compute() -> dict[str, Any]:
            noise = self.noise.gram_noise(name, dose, block)
            rois = scene.rois.on(scene.grid)
            result: dict[str, Any] = {}
            for label, other in (("roi", name), ("absent", f"{name}:absent")):
                if name == "core_for_fibrous" and label == "absent":
                    continue
                b = torch.from_numpy(self.scene(other).facts.statistic) * dose + noise
                volume, _ = _timed(method, scene, b, dose)
                result[label] = torch.stack([r(volume) for r in rois], dim=-1).numpy()
                if block.start == 0 and label == "roi":
                    result["first"] = volume[0].numpy().astype(np.float16)
            return result

        place = f"methods/{method.name}/{name}_{dose:g}s_{block.start}-{block.stop}"
        return self.store.piece(place, f"{self.noise.key} {fingerprint(method)}", compute)

    def _bounds(self, compute: Callable[..., dict[Any, float]], *arguments: Any) -> dict[float, dict[Any, float]]:
        """A bound at every dose, if the settings ask for them."""
        found = {}
        for k, dose in enumerate(self.settings.doses if self.settings.bounds else ()):
            self.report(compute.__name__.replace("_", " "), k / len(self.settings.doses))
            found[dose] = compute(self.noise, *arguments, dose)
        return found


def _timed(method: Method, scene: StudyScene, b: Tensor, dose: float) -> tuple[Tensor, float]:
    start = time.perf_counter()
    with torch.no_grad():
        volume = method(scene.problem, b, dose)
    seconds = time.perf_counter() - start
    if tuple(volume.shape) != tuple(b.shape) or not bool(torch.isfinite(volume).all()):
        raise ValueError(
            f"the method {method.name!r} gave {tuple(volume.shape)} for {tuple(b.shape)} or NaN or Inf "
            f"(scene {scene.name}, {dose:g} s): repair it or leave it out with --methods"
        )
    return volume.to(torch.float32), seconds
