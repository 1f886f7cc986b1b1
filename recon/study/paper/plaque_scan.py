"""What the studies of the plaque share: grids, ROIs, the noise-free scan and its FBP, what is read off an image."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from recon.analytic.inset import InsetFbp
from recon.evaluate.store import Pieces
from torchpcct.acquisition.acquire import acquire
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.placement import RoiPair, place_rois
from torchpcct.metrics.plaque_measures import PlaqueSegmentation, basin_depth, cap_on_line, dice, segment_plaque
from torchpcct.metrics.roi import axial_grid
from torchpcct.scan import Scan
from torchpcct.scanner import Scanner, presets
from torchpcct.scene import Scene
from torchpcct.scene.plaque import Plaque

__all__ = [
    "INSET_MM",
    "REFERENCE_KERNEL",
    "REFERENCE_VOXEL_MM",
    "SCANNERS",
    "PlaqueImage",
    "PlaqueScan",
    "Truth",
    "duty",
    "enclosing",
    "equal_dose",
    "inset_grid",
    "measure_plaque",
    "prepare",
]


@dataclass(frozen=True, eq=False)
class Truth:
    """The plaque as it is, on the protocol's axial image through its middle.

    Attributes:
        image: the axial image, ``(1, y, x)``.
        masks: ``"lumen"`` and ``"core"`` → ``(y, x)`` bool, where they are.
        line: ``(y, x)`` mm of the lumen's and of the core's centre: the line on which the cap is measured.
    """

    image: VolumeGrid
    masks: dict[str, NDArray[np.bool_]]
    line: tuple[tuple[float, float], tuple[float, float]]

    @classmethod
    def of(cls, scene: Scene, plaque: Plaque) -> Truth:
        """Of a scene at rest and its plaque."""
        image = axial_grid(plaque.position[::-1])
        labels = scene.labels(image)[0]
        x, y, _, _ = (float(v) for v in plaque.section("lumen", 0.0))
        lumen, core = plaque.to_scanner((x, y, 0.0)), plaque.to_scanner(plaque.core_center)
        return cls(
            image,
            {name: labels == scene.index(name) for name in ("lumen", "core")},
            ((float(lumen[1]), float(lumen[0])), (float(core[1]), float(core[0]))),
        )


@dataclass(frozen=True, eq=False)
class PlaqueImage:
    """Measures of one axial image.

    Attributes:
        image: ``(y, x)`` HU.
        segmentation: of it.
        cap_line: cap thickness in mm on the line from the lumen's to the core's centre; NaN where there is no lumen.
        depth: of the core's basin, HU (:func:`torchpcct.metrics.plaque_measures.basin_depth`).
        lumen_dice, core_dice: overlap of the segmented regions with the true ones.
    """

    image: Tensor
    segmentation: PlaqueSegmentation
    cap_line: float
    depth: float
    lumen_dice: float
    core_dice: float

    def as_dict(self) -> dict[str, Any]:
        """JSON values."""
        s = self.segmentation
        return {
            "lumen_mm2": s.lumen_area,
            "core_found": s.core_found,
            "core_mm2": s.core_area,
            "cap_line_mm": self.cap_line,
            "lumen_dice": self.lumen_dice,
            "core_dice": self.core_dice,
            "basin_depth_hu": self.depth,
        }


def measure_plaque(image: Tensor, truth: Truth) -> PlaqueImage:
    """Segment and measure an axial image ``(y, x)`` HU on ``truth.image``."""
    found = segment_plaque(image, truth.image)
    return PlaqueImage(
        image,
        found,
        cap_on_line(image, truth.image, *truth.line),
        basin_depth(image, truth.image, truth.masks["core"]),
        dice(found.lumen, truth.masks["lumen"]),
        dice(found.core, truth.masks["core"]),
    )


INSET_MM = (11.3, 9.0, 9.0)
"""Extent (z, y, x) of the reconstructed inset: the paper's 113 × 90 × 90 voxels of 0.1 mm."""

REFERENCE_VOXEL_MM = 0.10
REFERENCE_KERNEL = "standard"
"""Of the noise-free image that the ROIs are checked on."""

SCANNERS: dict[str, Callable[..., Scanner]] = {"PCCT": presets.pcct, "EID-CT": presets.eid}
"""The paper's two scanners: name → preset, called with the number of views."""


def inset_grid(plaque: Plaque, voxel_mm: float) -> VolumeGrid:
    """The grid of the inset about a plaque at a voxel size."""
    z, y, x = INSET_MM
    # Never smaller than the inset: the protocol's image of 256 × 0.035 mm must fit in.
    shape = tuple(math.ceil(extent / voxel_mm - 1e-6) for extent in (z, y, x))
    px, py, pz = plaque.position
    return VolumeGrid(shape, voxel_mm, (pz, py, px))


def duty(scanner: Scanner, full_views: int) -> float:
    """Share of a view's time with the beam on: fewer views than ``full_views`` stand for the same scan, thinned out."""
    return min(1.0, scanner.geometry.views / full_views)


def equal_dose(scanner: Scanner) -> float:
    """Exposure of a scanner over that of the PCCT at equal dose: equal fluence at the isocentre.

    The spectrum in front of the patient is the same, so it falls with the square of the tube's distance."""
    return float((scanner.geometry.sod / presets.pcct(8).geometry.sod) ** 2)


@dataclass
class PlaqueScan:
    """A noise-free scan of the plaque, and FBP on all grids of a study.

    Attributes:
        clean: windowed about the inset.
        fine: grid of the reference image.
        grids, pairs: for every voxel size the grid and its two ROI means (core, fibrous).
        rois: the ROIs.
        fbp: on ``grids`` with the study's kernels.
    """

    clean: Scan
    fine: VolumeGrid
    grids: list[VolumeGrid]
    pairs: list[Any]
    rois: RoiPair
    fbp: InsetFbp

    def roi_means(self, volumes: Sequence[Tensor]) -> NDArray[np.float64]:
        """``(S, 2)`` HU, the two ROI means of what ``fbp`` gives: all grids and kernels, the grid varying slowest."""
        return np.array(
            [
                [float(roi(volume)) for roi in pair]
                for pair, grid in zip(self.pairs, volumes, strict=True)
                for volume in grid
            ]
        )


def prepare(
    kernels: Sequence[str],
    voxels_mm: Sequence[float],
    scene: tuple[Scene, Plaque],
    scanner: Scanner,
    full_views: int,
    progress: Callable[[float], None] | None = None,
    pieces: Pieces | None = None,
) -> PlaqueScan:
    """Simulate the noise-free scan of a plaque and place grids and ROIs.

    Args:
        kernels, voxels_mm: of the study.
        scene: a scene and its plaque, as :func:`torchpcct.scene.plaque.plaque.plaque_scene` gives.
        scanner: with the number of views to simulate.
        full_views: views of the complete scan, see :func:`duty`.
        progress: called with the finished fraction of the simulation.
        pieces: keep the scan.

    Raises:
        ValueError: ROIs that come out empty; an inset outside the field of view.
    """
    bodies, plaque = scene
    grids = [inset_grid(plaque, v) for v in voxels_mm]
    fine = inset_grid(plaque, REFERENCE_VOXEL_MM)
    rois = place_rois(bodies, axial_grid(fine.center))
    region = enclosing([*grids, fine])
    on = duty(scanner, full_views)
    keep = pieces or Pieces(None, None)
    clean = keep("scan", lambda: acquire(bodies, scanner, region=region, duty=on, progress=progress))
    return PlaqueScan(clean, fine, grids, [rois.on(g) for g in grids], rois, InsetFbp(clean, grids, kernels))


def enclosing(grids: list[VolumeGrid]) -> VolumeGrid:
    """One voxel as large as the largest of ``grids`` that share a centre."""
    extent = tuple(max(g.extent[a] for g in grids) for a in range(3))
    return VolumeGrid((1, 1, 1), extent, grids[0].center)
