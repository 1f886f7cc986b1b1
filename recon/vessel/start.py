"""Where a vessel is, from thresholds on a smooth volume: what the fit starts with."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from recon.vessel.centreline import Centreline, follow, sections, smooth_line
from recon.vessel.model import Start
from torchpcct.geometry import VolumeGrid

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


Floats = NDArray[np.float64]

_BALLS_MM = (1.8, 0.9)
"""Larger than any lumen's radius; and for a narrow one, whose noise along it holds the walk of a
large ball back."""
_LEAST_STEP_HU = 120.0
"""Least difference of the lumen from its surroundings, HU."""
_LEAST_LUMEN_HU = 270.0
"""Difference below which the outline of the lumen is that of the noise, HU: fibrous tissue is up to
240 HU above fat."""
_LUMEN_AT = 0.69
"""Between the surroundings (0) and the lumen (1): half-way between fibrous tissue and lumen, where
the lumen's outline is first looked for, wherever the scanner's zero lies."""
_WALL_AT = 0.175
"""The same half-way between fat and wall, for the outer outline."""
_LEAST_LENGTH_MM = 2.0
"""Shortest line that is taken for a vessel, mm."""
_LEAST_SECTIONS = 4
"""Points that such a line needs."""


def find_vessel(pilot: Floats, grid: VolumeGrid, point: Floats | None) -> Start:
    """Lumen and outer wall of the vessel nearest to a point, or of the largest one.

    Args:
        pilot: ``grid.shape`` HU, smooth.
        grid: of the volume.
        point: ``(3,)`` z, y, x mm, or None.

    Raises:
        ValueError: a point outside of the grid, no lumen brighter than its surroundings, a bright
            thing that cannot be followed as a vessel.
    """
    origin, step = np.array([a[0] for a in grid.axes]), np.array(grid.spacing)
    fat = float(np.median(pilot))
    top = float(np.percentile(pilot, 99.8))
    bright = fat + 0.6 * (top - fat)
    labels, count = ndimage.label(pilot > bright)
    if not count or top - fat < _LEAST_STEP_HU:
        raise ValueError(
            f"nothing stands out of the surroundings ({fat:.0f} HU, brightest {top:.0f} HU): "
            "a plaque is read beside a lumen with contrast agent"
        )
    if point is None:
        wanted = int(np.argmax(np.bincount(labels.ravel())[1:])) + 1
    else:
        require_within(point, grid)
        at = (point - origin) / step
        near, places = ndimage.distance_transform_edt(
            labels == 0, sampling=step, return_indices=True
        )
        index = tuple(np.clip(np.rint(at).astype(int), 0, np.array(grid.shape) - 1))
        if near[index] > 4.0:
            raise ValueError(f"no vessel within 4 mm of the point {point.tolist()} mm (z, y, x)")
        wanted = int(labels[tuple(p[index] for p in places)])
    lumen = labels == wanted
    blood = float(np.percentile(pilot[lumen], 75))
    middle = origin + np.argwhere(lumen).mean(0) * step
    if point is not None:
        # The part of the lumen beside the point.
        voxels = origin + np.argwhere(lumen) * step
        middle = voxels[np.argsort(np.linalg.norm(voxels - point, axis=1))[:50]].mean(0)
    if blood - fat < _LEAST_LUMEN_HU:
        raise ValueError(
            f"the brightest tissue at {np.round(middle, 1).tolist()} mm (z, y, x) reads "
            f"{blood:.0f} HU in surroundings of {fat:.0f} HU: the outline of a lumen is determined "
            f"only with contrast agent (at least {_LEAST_LUMEN_HU:.0f} HU above fat)"
        )
    half = fat + _LUMEN_AT * (blood - fat)
    try:
        line, ends = follow(pilot, grid, half, middle, _BALLS_MM[0])
    except ValueError:
        line, ends = follow(pilot, grid, half, middle, _BALLS_MM[1])
    low, high = max(ends[0], -0.5), min(ends[1], line.length + 0.5)
    region, _ = ndimage.label(pilot > half)
    at = tuple(np.clip(np.rint((middle - origin) / step).astype(int), 0, np.array(grid.shape) - 1))
    own = region == region[at] if region[at] else region > 0
    s, centres, radii = sections(own, grid, line, low, high)
    _require(len(s) >= _LEAST_SECTIONS, middle, "its bright sections are too few or too small")
    lumen_line = Centreline(smooth_line(centres))
    shift = lumen_line.coordinates(line.point(np.array([0.0])))
    ends = ends + float(shift.s[0])
    wall = fat + _WALL_AT * (blood - fat)
    outside, _ = ndimage.label(pilot > wall)
    vessel = outside == outside[at]
    low, high = max(ends[0], -0.5), min(ends[1], lumen_line.length + 0.5)
    _require(
        high - low >= _LEAST_LENGTH_MM,
        middle,
        f"its lumen is followed over {max(high - low, 0.0):.1f} mm only",
    )
    s2, centres2, radii2 = sections(ndimage.binary_fill_holes(vessel), grid, lumen_line, low, high)
    _require(len(s2) >= _LEAST_SECTIONS, middle, "its outer wall is not seen")
    outer_line = Centreline(smooth_line(centres2))
    s = lumen_line.coordinates(centres).s
    s2 = outer_line.coordinates(centres2).s
    return Start(lumen_line, outer_line, ends, ((s, radii), (s2, radii2)), (fat, blood))


def require_within(point: ArrayLike, grid: VolumeGrid) -> None:
    """Refuse (ValueError) a point ``(3,)`` z, y, x mm outside of a volume."""
    low = np.array([a[0] for a in grid.axes]) - 0.5 * np.array(grid.spacing)
    if np.any(np.asarray(point) < low) or np.any(np.asarray(point) > low + np.array(grid.extent)):
        raise ValueError(
            f"the point {np.asarray(point).tolist()} mm (z, y, x) lies outside of the volume, "
            f"which reaches from {np.round(low, 2).tolist()} to "
            f"{np.round(low + np.array(grid.extent), 2).tolist()} mm"
        )


def _require(seen: bool, at: Floats, why: str) -> None:
    """Refuse (ValueError) what cannot be followed as a vessel."""
    if not seen:
        raise ValueError(
            f"the bright region at {np.round(at, 1).tolist()} mm (z, y, x) is no vessel that can "
            f"be read: {why}. Metal (a stent), bone and noise are as bright; give a point in a "
            "lumen with contrast agent"
        )
