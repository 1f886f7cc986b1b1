"""The measured dose factor: every method on the same noise realisations of the paper's scan, in resumable pieces.

Stages, each of them a set of files that are written whole and reused:

1. scenes: noise-free scans, what FBP makes of them exactly (means, covariances, images without noise), the limit of
   the data by generalised least squares on exact path lengths;
2. data: b = AᵀW y of every noise realisation, and FBP of the same readings
(:mod:`recon.study.dose_factor.realisations`);
3. methods: ROI means, a crop about the core and segmentation figures of every reconstruction.

Realisation k uses the noise seed ``seed + k`` in every scene, at every dose and for every method. The scenes with half
and with flipped contrast carry the noise of the paper's scene (the counts behind the core differ by less than 1 %).
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.study.dose_factor.facts import SceneFacts
from recon.study.dose_factor.measures import crop_window, segmentation
from recon.study.dose_factor.methods import IMAGE_METHODS, Method, fingerprint, load_methods
from recon.study.dose_factor.realisations import Realisations, joined
from recon.study.dose_factor.scene import StudyScene
from recon.study.dose_factor.settings import MAIN_SCENES, NOISY_SCENES, Settings, with_twin
from recon.study.dose_factor.shape_limit import shape_limits
from recon.study.dose_factor.stability import worst_case_gains
from recon.study.dose_factor.store import Store
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
        volumes: (method or "fbp", scene, dose) → first realisation, HU.
        wide: FBP variant → covariance of the means in the wider ROIs at 1 s.
        gains: dose → method or FBP variant → worst-case response, HU mm^1.5.
        shape_limits: dose → displacement of the outlines in mm → smallest contrast SD, HU.
        seconds: (method) → s per volume; total_seconds: of this run, with the pieces that it found finished.
    """

    settings: Settings
    methods: dict[str, str]
    facts: dict[str, SceneFacts]
    scenes: tuple[str, ...]
    left_out: dict[str, str]
    fbp: dict[tuple[str, float], dict[str, Any]]
    samples: dict[tuple[str, str, float], dict[str, Any]]
    extra: dict[tuple[str, str, float], dict[str, Any]]
    volumes: dict[tuple[str, str, float], Any]
    wide: dict[str, Any]
    gains: dict[float, dict[str, float]]
    shape_limits: dict[float, dict[float, float]]
    seconds: dict[str, float]
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
    measured = _Study(settings, Store(Path(folder)), progress).run()
    clock.lap("all")
    measured.total_seconds = clock.seconds["all"]
    return measured


class _Study:
    def __init__(self, settings: Settings, store: Store, progress: Progress) -> None:
        self.settings, self.store, self.report = settings, store, progress
        self.methods = load_methods(settings.methods)
        self.seconds: dict[str, float] = {}
        self._scenes: dict[str, StudyScene] = {}
        self.noise = Realisations(settings, store, self.scene)

    def scene(self, name: str) -> StudyScene:
        """A scene with its scan; problems (Gram operators) are shared where grid, window and surround agree."""
        if name not in self._scenes:
            scene = StudyScene(name, self.settings, self.store)
            scene.peers = self._scenes
            self._scenes[name] = scene
        return self._scenes[name]

    def run(self) -> Measured:
        s = self.settings
        facts, left_out = self._facts()
        fbp = {} if s.fast_noise else self._data()
        samples, volumes = self._main()
        extra = self._extra()
        wide = self.scene("paper").wide_covariance() if s.rois else {}
        for (name, dose), entry in fbp.items():
            volumes["fbp", name, dose] = entry.pop("first")
        if s.fast_noise:
            for name in NOISY_SCENES:
                volumes["fbp", name, s.doses[-1]] = self.noise.picture(name, s.doses[-1])
        return Measured(
            settings=s,
            methods={m.name: fingerprint(m) for m in self.methods},
            facts=facts,
            scenes=self.scenes,
            left_out=left_out,
            fbp=fbp,
            samples=samples,
            extra=extra,
            volumes=volumes,
            wide=wide,
            gains=self._bounds(worst_case_gains, self.methods),
            shape_limits=self._bounds(shape_limits),
            seconds=self.seconds,
        )

    def _facts(self) -> tuple[dict[str, SceneFacts], dict[str, str]]:
        """What holds of every scene; further scenes that cannot be simulated are left out, with the reason."""
        names = [*MAIN_SCENES, *(n for name in self.settings.scenes for n in with_twin(name))]
        facts: dict[str, SceneFacts] = {}
        left_out: dict[str, str] = {}
        for k, name in enumerate(names):
            self.report("scenes", k / len(names))
            try:
                facts[name] = self.scene(name).facts()
            except ValueError as error:
                if name in MAIN_SCENES:
                    raise
                log.warning("the scene %s is left out: %s", name, error)
                left_out[name.partition(":")[0]] = str(error)
            if name not in NOISY_SCENES:
                self.scene(name).release()
        self.report("scenes", 1.0)
        self.scenes = tuple(n for n in self.settings.scenes if n not in left_out)
        return facts, left_out

    def _data(self) -> dict[tuple[str, float], dict[str, Any]]:
        s = self.settings
        jobs = [(name, dose, block) for name in NOISY_SCENES for dose in s.doses for block in s.blocks(s.n)]
        collected: dict[tuple[str, float], list[Any]] = {}
        for done, (name, dose, block) in enumerate(jobs):
            self.report("noise realisations, FBP", done / len(jobs))
            piece = self.noise.data(name, dose, block)
            collected.setdefault((name, dose), []).append({k: piece[k] for k in ("roi", "crop", "first") if k in piece})
        self.report("noise realisations, FBP", 1.0)
        found = {key: joined(pieces) for key, pieces in collected.items()}
        for dose in s.doses:
            pieces = [self.noise.images("paper", dose, block) for block in s.blocks(min(s.n, s.slow_n))]
            found["paper", dose]["shape"] = np.concatenate([p["shape"] for p in pieces])
        return found

    # -- methods --------------------------------------------------------------------------------------------------

    def _main(self) -> tuple[dict[Any, Any], dict[Any, Any]]:
        s = self.settings
        samples: dict[Any, Any] = {}
        volumes: dict[Any, Any] = {}
        for method in self.methods:
            n = s.realizations(method.name)
            jobs = [(name, dose, block) for dose in s.doses for block in s.blocks(n) for name in MAIN_SCENES]
            collected: dict[Any, list[Any]] = {}
            for done, (name, dose, block) in enumerate(jobs):
                self.report(method.name, done / len(jobs))
                piece = self._method_piece(method, name, dose, block)
                collected.setdefault((method.name, name, dose), []).append(piece)
            self.report(method.name, 1.0)
            for key, pieces in collected.items():
                entry = joined(pieces)
                volumes[key] = entry.pop("first")
                samples[key] = entry
            spent = [p["seconds"] for pieces in collected.values() for p in pieces]
            self.seconds[method.name] = float(np.sum(spent)) / (len(MAIN_SCENES) * n * len(s.doses))
        return samples, volumes

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

    def _extra(self) -> dict[Any, Any]:
        s = self.settings
        methods = [m for m in self.methods if m.name in s.scene_methods and m.name not in IMAGE_METHODS]
        jobs = [
            (method, name, dose, block)
            for name in self.scenes for dose in s.scene_doses for block in s.blocks(s.scene_n) for method in methods
        ]  # fmt: skip
        collected: dict[Any, list[Any]] = {}
        for done, (method, name, dose, block) in enumerate(jobs):
            self.report("further scenes", done / len(jobs))
            piece = self._extra_piece(method, name, dose, block)
            collected.setdefault((method.name, name, dose), []).append(piece)
        if jobs:
            self.report("further scenes", 1.0)
        return {key: joined(pieces) for key, pieces in collected.items()}

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
                b = torch.from_numpy(self.scene(other).facts().statistic) * dose + noise
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
    import time

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
