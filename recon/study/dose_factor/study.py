"""The measured dose factor: every method on the same noise realisations of the paper's scan, in resumable pieces.

Stages, each of them a set of files that are written whole and reused:

1. scenes: noise-free scans, what FBP makes of them exactly (means, covariances, images without noise), the limit of
   the data by generalised least squares on exact path lengths;
2. data: b = AᵀW y of every noise realisation, and FBP of the same readings (:mod:`recon.study.dose_factor_noise`);
3. methods: ROI means, a crop about the core and segmentation figures of every reconstruction.

Realisation k uses the noise seed ``seed + k`` in every scene, at every dose and for every method. The scenes with half
and with flipped contrast carry the noise of the paper's scene (the counts behind the core differ by less than 1 %).
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.study import paper
from recon.study.dose_factor_noise import NOISY_SCENES, Realisations, joined
from recon.study.dose_factor_scene import (
    FBP_BASE,
    MAIN_SCENES,
    WIDE_ROIS,
    SceneFacts,
    StudyScene,
    crop_window,
    segmentation,
)
from recon.study.dose_factor_store import Store
from recon.study.methods import IMAGE_METHODS, METHODS, Method, fingerprint, load_methods

__all__ = ["EXTRA_SCENES", "MAIN_SCENES", "Measured", "Settings", "estimate_seconds", "run"]

log = logging.getLogger(__name__)

Floats = NDArray[np.float64]
Progress = Callable[[str, float], None]

EXTRA_SCENES = (
    "moved_core", "mirrored", "turned", "half_size_core", "core_for_fibrous", "calcification", "stent", "textured",
    "small_patient", "large_patient", "pitch_0.30mm", "pitch_0.40mm",
)  # fmt: skip
"""Scenes that can expose an invention."""

SLOW_METHODS = ("quadratic", "qggmrf", "tv", "fbp_cnn", "mbir_noise_half", "mbir_noise_double")
"""Few realisations place them well enough: iterated to convergence, drawn anew as images, or a test of robustness."""

_SECONDS = {"scene": 45.0, "fbp": 90.0, "data": 3.0, "images": 3.0, "linear": 0.3, "linear_z": 0.3, "quadratic": 1.5,
            "qggmrf": 5.0, "tv": 10.0, "fbp_cnn": 1.0, "mbir_one_pass": 0.5, "mbir": 1.0, "mbir_noise_half": 1.0,
            "mbir_noise_double": 1.0}  # fmt: skip
"""Rough cost at 1968 views on two cores: one scene, exact FBP noise, one realisation, one volume of each method."""


@dataclass(frozen=True)
class Settings:
    """Settings of the study.

    Args:
        n: paired realisations of each main scene and dose; claims need ≥ 200.
        slow_n: realisations for :data:`SLOW_METHODS` and for FBP's lumen and cap, at most ``n``.
        scene_n: realisations of each further scene and dose.
        doses: exposures in s.
        scene_doses: exposures of the further scenes.
        seed: realisation k uses the noise seed ``seed + k``.
        methods: names of :data:`recon.study.methods.METHODS`.
        scenes: further scenes, of :data:`EXTRA_SCENES`.
        scene_methods: methods that reconstruct the further scenes.
        views: per rotation (paper: 1968); fewer keep the tube load of the whole scan.
        voxel_mm: of the methods' grid.
        kernels, voxels_mm: FBP that is analysed exactly.
        blurs_mm: σ of Gaussian filters after soft FBP, for FBP of the same resolution as a method.
        gains: measure the worst-case response of FBP and of the learned methods.
        rois: wider ROIs than the paper's, of :data:`recon.study.dose_factor_scene.WIDE_ROIS`.
        fast_noise: draw b = AᵀW y from the Gram's covariance instead of drawing the readings. The further scenes
            always do. There are no FBP realisations then; FBP's exact figures stay.
        block: realisations in one piece.

    Raises:
        ValueError: a value out of range or an unknown name.
    """

    n: int = 200
    slow_n: int = 64
    scene_n: int = 40
    doses: tuple[float, ...] = (0.35, 0.70, 2.00)
    scene_doses: tuple[float, ...] = (0.35, 2.00)
    seed: int = 0
    methods: tuple[str, ...] = METHODS
    scenes: tuple[str, ...] = EXTRA_SCENES
    scene_methods: tuple[str, ...] = ("linear", "mbir")
    views: int = 1968
    voxel_mm: float = 0.2
    kernels: tuple[str, ...] = paper.KERNELS
    voxels_mm: tuple[float, ...] = (0.25, 0.20)
    blurs_mm: tuple[float, ...] = (0.15, 0.25, 0.40, 0.60)
    gains: bool = True
    rois: tuple[str, ...] = WIDE_ROIS
    fast_noise: bool = False
    block: int = 8

    def __post_init__(self) -> None:
        for name, least in (("n", 3), ("slow_n", 3), ("scene_n", 3), ("seed", 0), ("views", 8), ("block", 1)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int):
                raise TypeError(f"{name} must be a whole number, got {value!r}")
            if value < least:
                raise ValueError(f"{name} must be at least {least}, got {value}")
        for name in ("doses", "scene_doses"):
            values = tuple(float(v) for v in getattr(self, name))
            object.__setattr__(self, name, values)
            if not all(np.isfinite(v) and v > 0 for v in values) or len(set(values)) != len(values):
                raise ValueError(f"{name} must be different exposures greater than 0 s, got {values}")
        if not self.doses:
            raise ValueError("doses is empty: give at least one exposure in s")
        for name, known in (
            ("scenes", (*MAIN_SCENES, *EXTRA_SCENES)),
            ("methods", METHODS),
            ("scene_methods", METHODS),
            ("rois", WIDE_ROIS),
        ):
            values = tuple(getattr(self, name))
            object.__setattr__(self, name, values)
            for value in values:
                if value not in known:
                    raise ValueError(f"unknown entry {value!r} of {name}: choose from {', '.join(known)}")
        object.__setattr__(self, "scenes", tuple(s for s in self.scenes if s not in MAIN_SCENES))
        if not self.methods:
            raise ValueError(f"methods is empty: choose from {', '.join(METHODS)}")
        if FBP_BASE[0] not in self.kernels or FBP_BASE[1] not in self.voxels_mm:
            raise ValueError(f"kernels and voxels_mm must hold FBP {FBP_BASE[0]} at {FBP_BASE[1]} mm, the reference")

    @classmethod
    def quick(cls, **changes: Any) -> Settings:
        """A first look in about 90 s: an eighth of the views, 8 realisations, fast noise."""
        values: dict[str, Any] = {
            "n": 8, "scene_n": 4, "doses": (2.0,), "scene_doses": (2.0,), "views": 246, "fast_noise": True,
            "methods": ("linear", "mbir_one_pass", "mbir"), "scenes": ("half_size_core",),
            "kernels": ("soft", "standard"), "voxels_mm": (0.25,), "blurs_mm": (0.25,), "gains": False, "rois": (),
        }  # fmt: skip
        return cls(**{**values, **changes})

    def realizations(self, method: str) -> int:
        """Realisations of each main scene and dose for a method."""
        return min(self.n, self.slow_n) if method in SLOW_METHODS else self.n

    def blocks(self, n: int) -> list[range]:
        """Realisations of every piece."""
        return [range(k, min(k + self.block, n)) for k in range(0, n, self.block)]


@dataclass
class Measured:
    """Everything the report needs.

    Attributes:
        settings: of the study; ``methods``: names of the methods that ran, with their fingerprints.
        facts: scene → what holds without sampling error.
        scenes: further scenes; left_out: those that could not be simulated, with the reason.
        fbp: (scene, dose) → FBP realisations (``roi (n, 2)``, ``crop``; of the paper's scene ``shape (slow_n, 3)``, see
            :func:`recon.study.dose_factor_scene.segmentation`); empty with fast noise.
        samples: (method, scene, dose) → the same of each method, ``shape`` of all of its realisations.
        extra: (method, scene, dose) → ``roi`` and, with the core replaced by fibrous tissue, ``absent`` ``(n, 2)``.
        volumes: (method or "fbp", scene, dose) → first realisation, HU.
        wide: FBP variant → covariance of the means in the wider ROIs at 1 s.
        gains: dose → method or FBP variant → worst-case response, HU mm^1.5.
        seconds: (method) → s per volume.
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
    seconds: dict[str, float]


def estimate_seconds(settings: Settings) -> dict[str, float]:
    """Rough time in s of each part on two idle cores, nothing finished yet."""
    share = settings.views / 1968
    further = sum(len(_with_twin(name)) for name in settings.scenes)
    extra = further * settings.scene_n * len(settings.scene_doses)
    drawn = 0 if settings.fast_noise else len(NOISY_SCENES) * settings.n * len(settings.doses)
    parts = {
        "scenes": share * ((len(MAIN_SCENES) + further) * _SECONDS["scene"] + _SECONDS["fbp"]),
        "data": share * drawn * _SECONDS["data"],
        "images": share * _image_draws(settings) * _SECONDS["images"],
    }
    for name in settings.methods:
        volumes = len(MAIN_SCENES) * settings.realizations(name) * len(settings.doses)
        parts[name] = (volumes + (extra if name in settings.scene_methods else 0)) * _SECONDS[name]
    return parts


def _image_draws(settings: Settings) -> int:
    scenes = len(NOISY_SCENES) if set(settings.methods) & set(IMAGE_METHODS) else int(not settings.fast_noise)
    return scenes * min(settings.n, settings.slow_n) * len(settings.doses)


def run(settings: Settings, folder: str | Path, progress: Progress | None = None) -> Measured:
    """Measure, or finish a measurement that was interrupted.

    Args:
        settings: what to measure.
        folder: of the pieces, made if need be; finished pieces of the same settings are kept and reused.
        progress: called with the name of the step and its finished fraction.

    Raises:
        ValueError: settings out of range, no method to run.
    """
    return _Study(settings, Store(Path(folder)), progress or (lambda step, fraction: None)).run()


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
            gains=self._gains(),
            seconds=self.seconds,
        )

    def _facts(self) -> tuple[dict[str, SceneFacts], dict[str, str]]:
        """What holds of every scene; further scenes that cannot be simulated are left out, with the reason."""
        names = [*MAIN_SCENES, *(n for name in self.settings.scenes for n in _with_twin(name))]
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

    def _gains(self) -> dict[float, dict[str, float]]:
        if not self.settings.gains:
            return {}
        from recon.study.dose_factor_stability import worst_case_gains

        found = {}
        for k, dose in enumerate(self.settings.doses):
            self.report("worst-case response", k / len(self.settings.doses))
            found[dose] = worst_case_gains(self.noise, self.methods, dose)
        self.report("worst-case response", 1.0)
        return found


def _with_twin(name: str) -> list[str]:
    """A further scene and the same without its core, if it has one."""
    return [name] if name == "core_for_fibrous" else [name, f"{name}:absent"]


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
