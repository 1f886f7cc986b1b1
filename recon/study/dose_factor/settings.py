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
    "LINEAR_METHODS",
    "MAIN_SCENES",
    "METHODS",
    "METHOD_NAMES",
    "PURPOSES",
    "ROIS",
    "SLOW_METHODS",
    "TISSUE_METHODS",
    "TWIN_REALIZATIONS",
    "VESSELS",
    "VESSEL_ROIS",
    "Settings",
    "fbp_label",
    "with_twin",
]

MAIN_SCENES = ("paper", "absent_core", "half_contrast", "flipped_contrast")
"""They share all shapes and differ in the core's contrast (1, 0, ½, −1): slope, false contrast, observer."""

FBP_BASE = ("soft", 0.25)
"""Kernel and voxel size (mm) that factors are quoted against, and of the FBP realisations."""

ROIS = ("paper", "section", "tissue")
"""The paper's ROIs; all of core and fibrous tissue in the axial image; the same in all slices of the core."""

EXTRA_SCENES = (
    "moved_core", "mirrored", "turned", "half_size_core", "core_for_fibrous", "calcification", "stent", "textured",
    "small_patient", "large_patient", "pitch_0.30mm", "pitch_0.40mm",
)  # fmt: skip
"""Scenes that can expose an invention."""

VESSELS = ("straight", "tilted", "in_plane_x", "in_plane_y", "curved_8mm", "curved_5mm", "bifurcating")
"""Vessels of any direction, :data:`recon.evaluate.vessels.SHAPES`; the first is what gains are compared
with."""

VESSEL_ROIS = ("section", "tissue")
"""What is read of a vessel: the paper's ROIs in the section across it, and all of core and fibrous tissue."""

METHOD_NAMES = {
    "linear": "linear 3-D",
    "linear_z": "linear along z",
    "linear_z_added": "linear z + add-back",
    "quadratic": "quadratic PWLS",
    "qggmrf": "q-GGMRF PWLS",
    "tv": "smoothed TV",
    "fbp_cnn": "FBP + CNN",
    "mbir": "MBIR",
    "mbir_tissues": "MBIR + tissues",
    "mbir_viewing": "MBIR, look 0",
    "mbir_measuring": "MBIR, look 1",
    "mbir_no_cnn": "MBIR, no CNN",
    "mbir_one_step": "MBIR, one step",
    "mbir_free": "MBIR, no data end",
    "mbir_noise_half": "MBIR told noise ½×",
    "mbir_noise_double": "MBIR told noise 2×",
}
"""Methods in the order of the tables, as reports call them. ``linear_z_added`` adds 1.3 times the residual back;
``fbp_cnn`` is MBIR's network on FBP images. ``mbir_tissues`` fits the vessel's tissues first
(:mod:`recon.mbir.tissues`); ``mbir_viewing`` and ``mbir_measuring`` have the other looks;
``mbir_no_cnn`` is MBIR without its network, linear; ``mbir_one_step`` has one step of it, ``mbir_free`` no data
consistency at the end; ``mbir_noise_*`` takes the noise for half or twice of what it is."""

PURPOSES = {
    "linear": "the best post-filter of FBP that treats all directions alike",
    "linear_z": "quiet images and whole-plaque means where thin slices do not matter",
    "linear_z_added": "ROI means at full contrast by a filter that anybody can write",
    "quadratic": "penalised least squares without edges",
    "qggmrf": "quiet images with edges kept; reference for iterative reconstruction",
    "tv": "quiet, piecewise constant images",
    "fbp_cnn": "the network without the data term",
    "mbir": "quiet images with sharp outlines, ROI means a little shrunk",
    "mbir_tissues": "plaques in an enhanced vessel: sharp outlines, a core that is certain at full contrast",
    "mbir_viewing": "the quietest images",
    "mbir_measuring": "more of the contrast, at more noise",
    "mbir_no_cnn": "what the network adds (ablation)",
    "mbir_one_step": "what the second step adds (ablation)",
    "mbir_free": "what data consistency adds (ablation)",
    "mbir_noise_half": "robustness",
    "mbir_noise_double": "robustness",
}
"""What a method is for."""

METHODS = tuple(METHOD_NAMES)

LINEAR_METHODS = ("linear", "linear_z", "linear_z_added", "quadratic", "mbir_no_cnn")
"""Exact, without realisations."""

IMAGE_METHODS = ("fbp_cnn",)
"""Methods of an image domain: in place of b = AᵀW y they are given G x of an FBP volume x."""

SLOW_METHODS = (
    "qggmrf", "tv", "fbp_cnn", "mbir_viewing", "mbir_measuring", "mbir_one_step", "mbir_free", "mbir_noise_half",
    "mbir_noise_double",
)  # fmt: skip
"""Fewer realisations: iterated to convergence, drawn anew as images, ablations, looks, tests of robustness."""

TISSUE_METHODS = ("mbir_tissues",)
"""They fit a vessel for every volume, which costs several times more: they have realisations of their own number, and
in a further scene half as many as its twin."""

RELATIVES = ("mbir_tissues", "mbir_viewing", "mbir_measuring", "mbir_one_step", "mbir_free", "fbp_cnn")
"""Methods with MBIR's network. Where they have no control of their own, MBIR's response follows their contrast more
closely than linear filters do in most ROIs: one choice for all, made on the correlations of the study's draws."""

TWIN_REALIZATIONS = 16
"""Of a further scene or vessel without its core, in whole blocks. What the core adds hardly changes from draw to draw
(at 2 s by below 1 % with MBIR), so few say what the slope is."""

_RESPONSE_VOLUMES = 10
"""A method's first-order response at a place costs about as much as so many volumes."""

_SECONDS = {"scene": 45.0, "vessel": 8.0, "fbp": 90.0, "data": 3.0, "images": 3.0, "linear": 20.0, "linear_z": 25.0,
            "linear_z_added": 30.0, "quadratic": 90.0, "qggmrf": 5.0, "tv": 10.0, "fbp_cnn": 0.6, "mbir": 0.6,
            "mbir_tissues": 4.0, "mbir_viewing": 0.6, "mbir_measuring": 0.6, "mbir_no_cnn": 25.0,
            "mbir_one_step": 0.5, "mbir_free": 0.6, "mbir_noise_half": 0.6, "mbir_noise_double": 0.6}  # fmt: skip
"""Rough cost at all views on two cores: one scene, one vessel, exact FBP noise, one realisation, a linear method at one
exposure, one volume of each other method."""


@dataclass(frozen=True)
class Settings(StudySettings):
    """Settings of the study.

    Args:
        n: paired realisations of each main scene and dose; claims need ≥ 200.
        slow_n: realisations for :data:`SLOW_METHODS`, and of half and flipped contrast; at most ``n``.
        tissue_n: realisations for :data:`TISSUE_METHODS`; at most ``n``.
        scene_n: realisations of each further scene, vessel and dose, for methods that are not linear.
        doses: exposures in s.
        scene_doses: exposures of the further scenes.
        seed: first seed.
        methods: names of :data:`METHODS`.
        scenes: further scenes, of :data:`EXTRA_SCENES`.
        scene_methods: methods that reconstruct the further scenes and the vessels.
        vessels: vessels of other directions, of :data:`VESSELS`, at ``scene_doses`` with ``scene_n`` realisations.
        views: per rotation; fewer than the paper's keep the tube load of the whole scan.
        voxel_mm: of the methods' grid.
        kernels: of FBP, on the reference's voxels.
        bounds: measure the worst-case response of FBP and of the learned methods, and the limit of the data with
            outlines that are only roughly known.
        controls: linear methods of the same draws that the figures of all nonlinear methods are controlled by, of
            :data:`LINEAR_METHODS`.
        responses: control methods with all ``n`` realisations by their own linear response instead, and the rest of
            :data:`RELATIVES` by MBIR's, if MBIR is run.
        fast_noise: draw b = AᵀW y from the Gram's covariance instead of drawing the readings. The further scenes
            always do. There are no FBP realisations then; FBP's exact figures stay.
        block: realisations in one piece.

    Raises:
        ValueError: a value out of range or an unknown name.
    """

    n: int = 200
    slow_n: int = 48
    tissue_n: int = 100
    scene_n: int = 100
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
    bounds: bool = True
    controls: tuple[str, ...] = ("linear", "linear_z_added")
    responses: bool = True
    fast_noise: bool = False
    block: int = 8

    # A twelfth of the views, 12 realisations, fast noise, one control.
    QUICK: ClassVar[Mapping[str, Any]] = {
        "n": 12, "slow_n": 5, "scene_n": 8, "doses": (2.0,), "scene_doses": (2.0,), "views": 164, "fast_noise": True,
        "methods": ("linear", "mbir"), "scenes": (), "controls": ("linear",),
        "responses": False, "kernels": ("soft",), "bounds": False, "block": 12, "vessels": (),
    }  # fmt: skip

    def __post_init__(self) -> None:
        self.check_whole(n=8, slow_n=5, tissue_n=8, scene_n=8, seed=0, views=8, block=1)
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
            ("vessels", VESSELS),
            ("controls", LINEAR_METHODS),
        ):
            values = tuple(getattr(self, name))
            object.__setattr__(self, name, values)
            for value in values:
                if value not in known:
                    raise ValueError(f"unknown entry {value!r} of {name}: choose from {', '.join(known)}")
        object.__setattr__(self, "scenes", tuple(s for s in self.scenes if s not in MAIN_SCENES))
        if not self.controls:
            raise ValueError(f"controls is empty: choose from {', '.join(LINEAR_METHODS)}")
        if not self.methods:
            raise ValueError(f"methods is empty: choose from {', '.join(METHODS)}")
        if FBP_BASE[0] not in self.kernels:
            raise ValueError(f"kernels must hold that of the reference, FBP {FBP_BASE[0]}, got {self.kernels}")

    def realizations(self, method: str) -> int:
        """Realisations with and without the core at each dose for a method that is not linear."""
        if method in TISSUE_METHODS:
            return min(self.n, self.tissue_n)
        return min(self.n, max(self.slow_n, 8)) if method in SLOW_METHODS else self.n

    def scene_realizations(self, method: str) -> int:
        """The same in a further scene or vessel."""
        return min(self.scene_n, TWIN_REALIZATIONS // 2) if method in TISSUE_METHODS else self.scene_n

    def responds(self, method: str) -> bool:
        """Whether a method is controlled by its own linear response."""
        return self.responses and method not in (*LINEAR_METHODS, *SLOW_METHODS, *TISSUE_METHODS)

    def blocks(self, n: int) -> list[range]:
        """Realisations of every piece."""
        return [range(k, min(k + self.block, n)) for k in range(0, n, self.block)]

    def estimated_seconds(self) -> dict[str, float]:
        """Rough time in s of each part on two idle cores, nothing finished yet."""
        share = self.views / paper.FULL_VIEWS["PCCT"]
        further = sum(len(with_twin(name)) for name in self.scenes)
        places = (len(self.scenes) + len(self.vessels)) * len(self.scene_doses)
        here = {name: self.scene_realizations(name) for name in self.scene_methods if name not in LINEAR_METHODS}
        extra = {name: places * (n + min(n, TWIN_REALIZATIONS) + _RESPONSE_VOLUMES) for name, n in here.items()}
        drawn = 0 if self.fast_noise else self.n * len(self.doses)
        on_images = bool(set(self.methods) & set(IMAGE_METHODS))
        images = min(self.n, self.slow_n) * len(self.doses) if on_images else 0
        parts = {
            "scenes": share * ((len(MAIN_SCENES) + further) * _SECONDS["scene"] + _SECONDS["fbp"]),
            "data": share * drawn * _SECONDS["data"],
            "images": share * images * _SECONDS["images"],
            "vessels": share * len(self.vessels) * _SECONDS["vessel"],
        }
        for name in self.methods:
            scenes = 2 * self.realizations(name) + 2 * min(self.n, self.slow_n)
            volumes = len(self.doses) * (1 if name in LINEAR_METHODS else scenes)
            own = len(self.doses) * _RESPONSE_VOLUMES if self.responds(name) else 0
            parts[name] = (volumes + own + extra.get(name, 0)) * _SECONDS[name]
        return parts


def fbp_label(kernel: str, voxel_mm: float) -> str:
    """Name of an FBP variant."""
    return f"{kernel} {voxel_mm:.2f} mm"


def with_twin(name: str) -> list[str]:
    """A further scene and the same without its core, if it has one."""
    return [name] if name == "core_for_fibrous" else [name, f"{name}:absent"]
