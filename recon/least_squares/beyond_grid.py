"""Does something that differs from the known exterior lie beyond an inset's grid?

The iterative methods explain the readings behind a grid by its voxels and the exterior alone. Of a
body that goes on beyond its slices they place up to two fifths of the contrast into the outermost
two or three, and a body beside the grid draws streaks into it. FBP filters all readings of the
window, so its slices are right (measured: no difference at all). The residual is that of noise
almost, and without noise nothing tests it; but rows and columns beside the grid's footprint see
such a body, and would see the exterior alone without it.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchpcct.detector_window import DetectorWindow
from torchpcct.geometry import ConeBeam, VolumeGrid, project_points
from torchpcct.scan import Scan

if TYPE_CHECKING:
    from torchpcct.typing import Floats

__all__ = ["beyond_grid"]

_GUARD_ROWS = 1.0
"""Rows beside the footprint that see the grid's end by the width of focal spot and cell."""
_GUARD_COLUMNS = 3
"""The same of columns."""
_FAR_COLUMNS = 24
"""Columns beside the footprint that are searched."""
_REACH_COLUMNS = 64
"""Columns up to which those further off tell what the exterior is off by in a row."""
_LEAST = 1e-4
"""Of a line integral, which rounding stays below: 1 HU over 5 mm."""
_SHARE = 0.05
"""Of what readings behind the grid differ by from the exterior, that those beside it may."""
_SIGMAS = 6.0
"""Standard deviations by which a sum of squares must exceed that of noise."""
_MOST_READINGS = 2_000_000
"""Readings that are looked at; more only cost time."""


class _Profile(NamedTuple):
    """What lines differ by from the exterior, averaged over views: ``mean`` and the variance of its
    noise, of one shape; inf where nothing was read."""

    mean: Tensor
    variance: Tensor

    def square(self) -> Tensor:
        """Mean square over the last axis, less that of noise; 0 where nothing was read."""
        square = (self.mean.square() - self.variance).nanmean(-1).clamp_min(0.0)
        return torch.where(self.variance.amax(-1) < math.inf, square, 0.0)

    def stands_out(self, least: float, noise_free: bool) -> Tensor:
        """Where the last axis's root mean square exceeds ``least`` and noise, bool."""
        clear = self.square().sqrt() > least
        if noise_free:
            return clear
        n = self.mean.shape[-1]
        sigmas = ((self.mean.square() / self.variance).sum(-1) - n) / math.sqrt(2.0 * n)
        return clear & (sigmas > _SIGMAS)


def beyond_grid(
    scan: Scan,
    grid: VolumeGrid,
    footprint: DetectorWindow,
    background: Tensor,
    motion: Floats | None = None,
) -> list[str]:
    """Warnings of what lies beyond a grid, above and below its slices and beside it.

    Args:
        scan: windowed, one channel.
        grid: ``(z, y, x)`` grid of the inset.
        footprint: its footprint, a part of the scan's window.
        background: line integrals of the exterior, ``(rows, columns)``.
        motion: displacement of the grid in every view, ``(views, 3)`` z, y, x mm, or None.

    Returns:
        One text for the slices' ends and one for the sides; none if nothing is seen there.
    """
    outer = scan.window
    assert outer is not None
    path = np.zeros((scan.geometry.views, 3)) if motion is None else motion
    stride = math.ceil(scan.counts.numel() / _MOST_READINGS)
    if stride > 1:
        views = slice(None, None, stride)
        scan, path = scan.select(views), path[views]
        outer, footprint = outer.select(views), footprint.select(views)
    # Columns counted from the footprint's first one, (views, rows, columns).
    device = scan.counts.device
    place = torch.arange(-_REACH_COLUMNS, footprint.columns + _REACH_COLUMNS, device=device)
    first = torch.from_numpy(footprint.first_column - outer.first_column).to(device)
    index = first[:, None] + place
    there = (index >= 0) & (index < outer.columns)
    index = index.clamp(0, outer.columns - 1)[:, None].expand(-1, outer.rows, -1)
    lines = outer.less(scan.line_integrals(), background).gather(-1, index).double()
    weights = outer.take(scan.exterior_weights()).gather(-1, index) * there[:, None]
    if scan.dead is not None:
        weights = weights.masked_fill(scan.dead.gather(-1, index), 0.0)
    inside = (place >= 0) & (place < footprint.columns)
    off = torch.maximum(-place, place - footprint.columns + 1)  # columns beside the footprint

    # Of few photons, or with another exposure, a whole row is off by the same.
    free = scan.noise_free
    far = _mean(lines, weights * (off > _FAR_COLUMNS), (0, 2), free)
    lines = lines - torch.where(far.variance < math.inf, far.mean, 0.0)[:, None]
    low, high = (
        torch.from_numpy(rows).to(device)[:, None] for rows in _rows_of(grid, scan.geometry, path)
    )
    row = outer.first_row + torch.arange(outer.rows, dtype=torch.float64, device=device)
    held = (row > low) & (row < high)
    found = []
    behind = _mean(lines, weights * held[..., None], (0,), free)
    along = _Profile(behind.mean[:, inside], behind.variance[:, inside])
    least = max(_LEAST, _SHARE * float(along.square().max().sqrt()))
    cut = []
    for name, at in (
        ("lower", row < low - _GUARD_ROWS),
        ("upper", row > high + _GUARD_ROWS),
    ):
        seen = _mean(lines[..., inside], (weights * at[..., None])[..., inside], (0,), free)
        if bool(seen.stands_out(least, free).any()):
            cut.append(name)
    if cut:
        found.append(_of_slices(grid, cut))

    # Over the turn a body beside the grid comes by at many distances, on both sides.
    whole = _mean(lines, weights * held[..., None], (0, 1), free)
    behind = _Profile(whole.mean[inside], whole.variance[inside])
    near = (off > _GUARD_COLUMNS) & (off <= _FAR_COLUMNS)
    least = max(_LEAST, _SHARE * float(behind.square().sqrt()))
    if bool(_Profile(whole.mean[near], whole.variance[near]).stands_out(least, free)):
        found.append(_of_sides(scan, grid))
    return found


def _rows_of(grid: VolumeGrid, geometry: ConeBeam, path: Floats) -> tuple[Floats, Floats]:
    """Lowest and highest row that sees a grid's box in each view, ``(views,)``, fractions of
    rows."""
    (z, y, x), (dz, dy, dx) = grid.center, (e / 2 for e in grid.extent)
    corners = np.array([(y + b * dy, x + a * dx) for a in (-1, 1) for b in (-1, 1)])
    ends = np.array([z - dz, z + dz])[:, None, None] + path[:, :1]
    _, height = project_points(
        geometry, corners[:, 1] + path[:, 2:], corners[:, 0] + path[:, 1:2], ends
    )
    row = (height - geometry.row_positions[0]) / geometry.row_pitch
    return row.min((0, 2)) - 0.5, row.max((0, 2)) + 0.5


def _of_slices(grid: VolumeGrid, ends: list[str]) -> str:
    half, (z, *_) = grid.extent[0] / 2, grid.center
    return (
        f"what differs from the exterior goes on beyond the {' and the '.join(ends)} end of the "
        f"grid's slices (z = {z - half:g} … {z + half:g} mm): PWLS and MBIR place up to two fifths "
        "of its contrast into the outermost two or three slices. Take a grid of more slices, until "
        "it ends or by three at each end, and leave those out; fbp is right on any slices"
    )


def _of_sides(scan: Scan, grid: VolumeGrid) -> str:
    region = scan.region
    like = "" if region is None or region == grid else f", such as the scan's own region, {region}"
    return (
        "what differs from the exterior lies beside the grid, too: PWLS and MBIR draw streaks into "
        f"it. Take a grid that holds all of it{like}; fbp is right on any part of it"
    )


def _mean(lines: Tensor, weights: Tensor, axes: tuple[int, ...], noise_free: bool) -> _Profile:
    """Weighted means over axes, and the variances of their noise: 0 and inf where no weight is."""
    total = weights.sum(axes)
    mean = (weights * lines).sum(axes) / total
    variance = torch.where(total > 0, 0.0, math.inf) if noise_free else 1.0 / total
    return _Profile(torch.where(total > 0, mean, 0.0), variance)
