"""What the dose-factor study measures, and roughly how long that takes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from recon.study.paper import facts as paper
from recon.study.study import StudySettings

__all__ = [
    "EXTRA_SCENES",
    "FBP_BASE",
    "IMAGE_METHODS",
    "MAIN_SCENES",
    "METHODS",
    "METHOD_NAMES",
    "NOISY_SCENES",
    "SLOW_METHODS",
    "VESSELS",
    "VESSEL_ROIS",
    "WIDE_ROIS",
    "Settings",
    "fbp_label",
    "with_twin",
]

MAIN_SCENES = ("paper", "absent_core", "half_contrast", "flipped_contrast")
"""They share all shapes and differ in the core's contrast (1, 0, ½, −1): slope, false contrast, observer."""

FBP_BASE = ("soft", 0.25)
"""Kernel and voxel size (mm) that factors are quoted against, and of the FBP realisations."""

WIDE_ROIS = ("section", "tissue")
"""ROIs beyond the paper's: all of core and fibrous tissue in the axial image, and in all slices of the core."""

NOISY_SCENES = ("paper", "absent_core")
"""Scenes with readings drawn in the sinogram; half and flipped contrast carry the paper scene's noise."""

EXTRA_SCENES = (
    "moved_core", "mirrored", "turned", "half_size_core", "core_for_fibrous", "calcification", "stent", "textured",
    "small_patient", "large_patient", "pitch_0.30mm", "pitch_0.40mm",
)  # fmt: skip
"""Scenes that can expose an invention."""

VESSELS = ("straight", "tilted", "in_plane_x", "in_plane_y", "curved_8mm", "curved_5mm", "bifurcating")
"""Vessels of any direction, :data:`recon.study.dose_factor.vessel_shapes.SHAPES`; the first is what gains are compared
with."""

VESSEL_ROIS = ("section", "tissue")
"""What is read of a vessel: the paper's ROIs in the section across it, and all of core and fibrous tissue."""

METHOD_NAMES = {
    "linear": "linear 3-D filter",
    "linear_z": "linear filter along z",
    "quadratic": "quadratic PWLS",
    "qggmrf": "q-GGMRF PWLS",
    "tv": "smoothed TV",
    "fbp_cnn": "FBP + MBIR's prior",
    "mbir_one_pass": "MBIR, one pass",
    "mbir": "MBIR, two passes",
    "mbir_noise_half": "MBIR, noise taken for ½",
    "mbir_noise_double": "MBIR, noise taken for 2×",
}
"""Methods in the order of the tables, as reports call them. ``fbp_cnn`` is MBIR's prior on FBP images, ``mbir_noise_*``
MBIR that takes the noise for half or twice of what it is."""

METHODS = tuple(METHOD_NAMES)

IMAGE_METHODS = ("fbp_cnn",)
"""Methods of an image domain: in place of b = AᵀW y they are given G x of an FBP volume x."""

SLOW_METHODS = ("quadratic", "qggmrf", "tv", "fbp_cnn", "mbir_noise_half", "mbir_noise_double")
"""Few realisations place them well enough: iterated to convergence, drawn anew as images, or a test of robustness."""

_SECONDS = {"scene": 45.0, "vessel": 8.0, "fbp": 90.0, "data": 3.0, "images": 3.0, "linear": 0.3, "linear_z": 0.3,
            "quadratic": 1.5, "qggmrf": 5.0, "tv": 10.0, "fbp_cnn": 1.0, "mbir_one_pass": 0.5, "mbir": 1.0,
            "mbir_noise_half": 1.0, "mbir_noise_double": 1.0}  # fmt: skip
"""Rough cost at all views on two cores: a scene, a vessel, exact FBP noise, one realisation, one volume of a method."""


@dataclass(frozen=True)
class Settings(StudySettings):
    """Settings of the study.

    Args:
        n: paired realisations of each main scene and dose; claims need ≥ 200.
        slow_n: realisations for :data:`SLOW_METHODS` and for FBP's lumen and cap, at most ``n``.
        scene_n: realisations of each further scene and dose.
        doses: exposures in s.
        scene_doses: exposures of the further scenes.
        seed: first seed.
        methods: names of :data:`METHODS`.
        scenes: further scenes, of :data:`EXTRA_SCENES`.
        scene_methods: methods that reconstruct the further scenes and the vessels.
        vessels: vessels of other directions, of :data:`VESSELS`, at ``scene_doses`` with ``scene_n`` realisations.
        views: per rotation; fewer than the paper's keep the tube load of the whole scan.
        voxel_mm: of the methods' grid.
        kernels, voxels_mm: FBP that is analysed exactly.
        blurs_mm: σ of Gaussian filters after soft FBP, for FBP of the same resolution as a method.
        bounds: measure the worst-case response of FBP and of the learned methods, and the limit of the data with
            outlines that are only roughly known.
        rois: wider ROIs than the paper's, of :data:`WIDE_ROIS`.
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
    vessels: tuple[str, ...] = VESSELS
    views: int = paper.FULL_VIEWS["PCCT"]
    voxel_mm: float = 0.2
    kernels: tuple[str, ...] = paper.KERNELS
    voxels_mm: tuple[float, ...] = (0.25, 0.20)
    blurs_mm: tuple[float, ...] = (0.15, 0.25, 0.40, 0.60)
    bounds: bool = True
    rois: tuple[str, ...] = WIDE_ROIS
    fast_noise: bool = False
    block: int = 8

    # About 90 s: an eighth of the views, 8 realisations, fast noise.
    QUICK: ClassVar[Mapping[str, Any]] = {
        "n": 8, "scene_n": 4, "doses": (2.0,), "scene_doses": (2.0,), "views": 246, "fast_noise": True,
        "methods": ("linear", "mbir_one_pass", "mbir"), "scenes": ("half_size_core",),
        "kernels": ("soft", "standard"), "voxels_mm": (0.25,), "blurs_mm": (0.25,), "bounds": False, "rois": (),
        "vessels": (),
    }  # fmt: skip

    def __post_init__(self) -> None:
        self.check_whole(n=3, slow_n=3, scene_n=3, seed=0, views=8, block=1)
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
            ("vessels", VESSELS),
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

    def realizations(self, method: str) -> int:
        """Realisations of each main scene and dose for a method."""
        return min(self.n, self.slow_n) if method in SLOW_METHODS else self.n

    def blocks(self, n: int) -> list[range]:
        """Realisations of every piece."""
        return [range(k, min(k + self.block, n)) for k in range(0, n, self.block)]

    def estimated_seconds(self) -> dict[str, float]:
        """Rough time in s of each part on two idle cores, nothing finished yet."""
        share = self.views / paper.FULL_VIEWS["PCCT"]
        further = sum(len(with_twin(name)) for name in self.scenes)
        extra = (further + len(self.vessels)) * self.scene_n * len(self.scene_doses)
        drawn = 0 if self.fast_noise else len(NOISY_SCENES) * self.n * len(self.doses)
        on_images = bool(set(self.methods) & set(IMAGE_METHODS))
        image_scenes = len(NOISY_SCENES) if on_images else int(not self.fast_noise)
        images = image_scenes * min(self.n, self.slow_n) * len(self.doses)
        parts = {
            "scenes": share * ((len(MAIN_SCENES) + further) * _SECONDS["scene"] + _SECONDS["fbp"]),
            "data": share * drawn * _SECONDS["data"],
            "images": share * images * _SECONDS["images"],
            "vessels": share * len(self.vessels) * _SECONDS["vessel"],
        }
        for name in self.methods:
            volumes = len(MAIN_SCENES) * self.realizations(name) * len(self.doses)
            parts[name] = (volumes + (extra if name in self.scene_methods else 0)) * _SECONDS[name]
        return parts


def fbp_label(kernel: str, voxel_mm: float, blur_mm: float = 0.0) -> str:
    """Name of an FBP variant."""
    return f"{kernel} {voxel_mm:.2f} mm" + (f" + {blur_mm:.2f} mm Gauss" if blur_mm else "")


def with_twin(name: str) -> list[str]:
    """A further scene and the same without its core, if it has one."""
    return [name] if name == "core_for_fibrous" else [name, f"{name}:absent"]
