"""What is measured on a plaque's axial image: by contours at a threshold, by segmentation, on a
line.

By contours, :func:`lumen_area` finds the closed contour around a point that is known to lie in the
lumen, to a fraction of a voxel; it needs no protocol and no fat around the vessel.

By segmentation, :func:`segment_plaque` follows the protocol of Li et al. (section "Image
Resolution"): on the axial image of 0.035 mm pixels the lumen is what reads at least 250 HU (half of
the contrast-enhanced blood), the necrotic core what reads 20 to 60 HU (half to one and a half times
its value); the lumen's area is its number of pixels, the cap's thickness the smallest distance
between the two.

A band of CT numbers selects more than the core: every edge between bright tissue and fat passes
through it, and so does the vessel's wall. All of that is connected to the fat around the vessel.
The core is therefore the part of the band that tissue brighter than the band ENCLOSES in the image
("well identified and separated from the vessel media", as the paper puts it); once blur or noise
opens a way out, there is no core to measure, and its measures are NaN. On the line from the lumen
to the core, :func:`cap_on_line` still reads what is left of the cap.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import binary_dilation, map_coordinates
from scipy.spatial import cKDTree
from skimage.measure import find_contours, label, points_in_poly
from skimage.morphology import reconstruction

from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.resolution import first_below
from torchpcct.metrics.roi import as_array
from torchpcct.validate import checked

if TYPE_CHECKING:
    from torch import Tensor

    from torchpcct.typing import Ints


__all__ = ["PlaqueSegmentation", "dice", "lumen_area", "segment_plaque"]

LUMEN_HU = 250.0
"""Threshold of the lumen in HU (Li et al.)."""

CORE_HU = (20.0, 60.0)
"""Band of the necrotic core in HU (Li et al.)."""

_STEP_MM = 0.005
"""Between samples of a line."""

Mask = NDArray[np.bool_]
Floats = NDArray[np.float64]

_CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], dtype=bool)
"""Dark regions join at edges only, bright ones at corners too: a closed diagonal line of cap
separates."""


@checked
def lumen_area(
    image: ArrayLike, grid: VolumeGrid, seed: tuple[float, float], threshold: float = LUMEN_HU
) -> float:
    """Area in mm² inside the contour at a threshold around a point, by marching squares with linear
    interpolation.

    Args:
        image: ``(y, x)`` or ``(1, y, x)`` HU, tensor or array.
        grid: of the image.
        seed: ``(y, x)`` mm, a point of the lumen: the smallest closed contour around it is taken.
        threshold: HU.

    Returns:
        NaN where no closed contour surrounds the seed (the lumen is lost, or merged with the
        image's border).

    Raises:
        ValueError: an image that is not one slice of the grid's shape, NaN or Inf.
    """
    x, plane = _slice(image, grid)
    origin = np.array([a[0] for a in plane.axes])
    closed = (
        origin + c * plane.spacing
        for c in find_contours(x, threshold)
        if np.array_equal(c[0], c[-1])
    )
    return min((_area(c) for c in closed if points_in_poly([seed], c)[0]), default=math.nan)


@dataclass(frozen=True, eq=False)
class PlaqueSegmentation:
    """Lumen and core of one axial image.

    Attributes:
        image: ``(y, x)`` HU, float64.
        grid: of the image, ``(y, x)``.
        lumen: ``(y, x)`` bool, the largest connected region of at least the lumen's threshold.
        band: ``(y, x)`` bool, all that reads between the core's limits, rims and wall included.
        core: ``(y, x)`` bool, the largest enclosed part of the band; empty where there is none.
    """

    image: Floats
    grid: VolumeGrid
    lumen: Mask
    band: Mask
    core: Mask

    @property
    def _pixel_mm2(self) -> float:
        return float(self.grid.spacing[0] * self.grid.spacing[1])

    @property
    def lumen_area(self) -> float:
        """Area of the lumen in mm², by its pixels; NaN where nothing reaches the threshold."""
        return float(self.lumen.sum()) * self._pixel_mm2 if self.lumen.any() else math.nan

    @property
    def core_area(self) -> float:
        """Area of the core in mm², by its pixels; NaN where none is enclosed."""
        return float(self.core.sum()) * self._pixel_mm2 if self.core.any() else math.nan

    @property
    def core_found(self) -> bool:
        """Whether there is a core, apart from rims and wall."""
        return bool(self.core.any())

    @property
    def cap_thickness(self) -> float:
        """Smallest distance in mm between lumen and core, NaN where either is lost.

        Between the contours at the lumen's threshold and at the core's upper limit, with linear
        interpolation between pixels: whole pixels would quantise a cap of 0.17 mm in steps of a
        fifth.
        """
        if not self.lumen.any() or not self.core.any():
            return math.nan
        lumen = self._contours(self.lumen, LUMEN_HU)
        core = self._contours(self.core, CORE_HU[1])
        return min(_between(a, b) for a in lumen for b in core)

    def _contours(self, region: Mask, level: float) -> list[Floats]:
        """Contours of the image at ``level`` that bound ``region``, each ``(points, 2)`` mm."""
        near = binary_dilation(region, np.ones((3, 3), bool))
        found = []
        for line in find_contours(self.image, level):
            i, j = np.round(line).astype(np.int64).T
            part = line[near[i, j]]
            if len(part):
                found.append(part * np.array(self.grid.spacing))
        return found


@checked
def segment_plaque(image: ArrayLike, grid: VolumeGrid) -> PlaqueSegmentation:
    """Segment lumen and core by the paper's thresholds.

    Args:
        image: ``(y, x)`` or ``(1, y, x)`` HU, tensor or array; fat must surround the vessel in it.
        grid: of the image.

    Raises:
        ValueError: an image that is not one slice of the grid's shape, NaN or Inf.
    """
    x, plane = _slice(image, grid)
    lumen = _largest(label(x >= LUMEN_HU, connectivity=2))
    low, high = CORE_HU
    band = (x >= low) & (x <= high)
    dark = label(x <= high, connectivity=1)
    border = np.unique(np.concatenate([dark[0], dark[-1], dark[:, 0], dark[:, -1]]))
    core = _largest(np.where(np.isin(dark, border) | ~band, 0, dark))
    return PlaqueSegmentation(x, plane, lumen, band, core)


@checked
def cap_on_line(
    image: ArrayLike, grid: VolumeGrid, start: tuple[float, float], end: tuple[float, float]
) -> float:
    """Cap thickness in mm on the line from the lumen to the core: where the image falls below both
    thresholds.

    Unlike :attr:`PlaqueSegmentation.cap_thickness` it needs no closed core: it still reads what
    blur makes of the cap where the core has joined the wall.

    Args:
        image, grid: as for :func:`segment_plaque`.
        start, end: ``(y, x)`` mm, in the lumen and in the core (their centres). The lumen ends
            where the image first falls below its threshold, the core begins where it first falls to
            its upper one, by linear interpolation between samples 5 µm apart.

    Returns:
        NaN where the line does not start in the lumen, or does not reach the core.

    Raises:
        ValueError: as :func:`segment_plaque`; a line that leaves the image, or has no length.
    """
    x, plane = _slice(image, grid)
    a, b = np.array(start, dtype=np.float64), np.array(end, dtype=np.float64)
    length = float(np.hypot(*(b - a)))
    if not length > _STEP_MM:
        raise ValueError(f"start and end must lie apart, got a line of {length:g} mm")
    along = np.linspace(0.0, length, math.ceil(length / _STEP_MM) + 1)
    points = a[:, None] + (b - a)[:, None] * along / length
    index = (points - np.array([v[0] for v in plane.axes])[:, None]) / np.array(plane.spacing)[
        :, None
    ]
    if index.min() < 0 or (index.max(axis=1) > np.array(plane.shape) - 1).any():
        raise ValueError(
            f"the line from {tuple(start)} to {tuple(end)} mm leaves the image: give points "
            "inside it"
        )
    profile = map_coordinates(x, index, order=1)
    edges = [first_below(along, profile, level, math.nan) for level in (LUMEN_HU, CORE_HU[1])]
    return edges[1] - edges[0] if profile[0] >= LUMEN_HU else math.nan


@checked
def basin_depth(image: ArrayLike, grid: VolumeGrid, within: ArrayLike) -> float:
    """Depth in HU of the deepest basin in a region: from its bottom to the lowest pass that leads
    to the border.

    What remains of a dark core's boundary, whatever its absolute CT numbers: 0 where the image
    falls from the core all the way to the fat, so that no contour of any level closes around the
    core.

    Args:
        image, grid: as for :func:`segment_plaque`.
        within: ``(y, x)`` bool, where the core is.

    Raises:
        ValueError: as :func:`segment_plaque`; a region of another shape or without pixels.
    """
    x, _ = _slice(image, grid)
    region = np.asarray(within, dtype=bool)
    if region.shape != x.shape or not region.any():
        raise ValueError(
            f"within must mark pixels of an image of shape {x.shape}, got {region.shape}, "
            f"{region.sum()}"
        )
    lake = x.copy()
    lake[1:-1, 1:-1] = x.max()
    return float((reconstruction(lake, x, method="erosion", footprint=_CROSS) - x)[region].max())


@checked
def dice(a: ArrayLike, b: ArrayLike) -> float:
    """Dice overlap ``2 |a ∩ b| / (|a| + |b|)`` of two masks, 0…1; NaN where both are empty.

    Raises:
        ValueError: shapes that differ.
    """
    first, second = np.asarray(a, dtype=bool), np.asarray(b, dtype=bool)
    if first.shape != second.shape:
        raise ValueError(f"masks must have the same shape, got {first.shape} and {second.shape}")
    total = int(first.sum()) + int(second.sum())
    return 2.0 * int((first & second).sum()) / total if total else math.nan


def _slice(image: Tensor | ArrayLike, grid: VolumeGrid) -> tuple[Floats, VolumeGrid]:
    """The image as ``(y, x)`` float64, and its 2-D grid."""
    x = as_array(image)
    if grid.ndim == 3 and grid.shape[0] != 1:
        raise ValueError(f"grid must be one slice, got {grid.shape}: sample the axial image first")
    if x.shape not in (grid.shape, grid.shape[-2:]):
        raise ValueError(f"image must be one slice of the grid's shape {grid.shape}, got {x.shape}")
    x = x.reshape(grid.shape[-2:]).astype(np.float64)
    if not np.isfinite(x).all():
        raise ValueError("image holds NaN or Inf: check the reconstruction before measuring it")
    return x, grid.slice if grid.ndim == 3 else grid


def _area(points: Floats) -> float:
    p = points - points[0]
    return abs(float((p[:-1, 0] * p[1:, 1] - p[1:, 0] * p[:-1, 1]).sum())) / 2


def _largest(labels: Ints) -> Mask:
    """The label with the most pixels; nothing where all are 0."""
    sizes = np.bincount(labels.ravel())
    if sizes.size < 2:
        return np.zeros(labels.shape, bool)
    return np.asarray(labels == 1 + int(np.argmax(sizes[1:])))


def _between(points: Floats, others: Floats) -> float:
    """Smallest distance between the points of two contours (a pixel holds several of each)."""
    return float(cKDTree(others).query(points)[0].min())
