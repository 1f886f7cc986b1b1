"""The grid of what a scan sees, as :meth:`torchpcct.VolumeGrid.of` gives it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

from torchpcct.angles import is_offset, view_steps
from torchpcct.detector_window import NOISE_MARGIN_COLUMNS, DetectorWindow, footprint
from torchpcct.geometry import Beam, ConeBeam, Geometry, VolumeGrid
from torchpcct.validate import number, numbers
from torchpcct.vector_geometry import VectorGeometry

if TYPE_CHECKING:
    from collections.abc import Sequence

    from torch import Tensor


Floats = NDArray[np.float64]

_SLACK = 1e-6
"""Of a voxel: an extent that is a whole number of voxels stays one."""
_LEAST_MARGIN = 1
"""Columns beside a grid's footprint that reconstruction needs; a scan that was acquired for a
region has more."""
_SHARES = 40
"""Sizes that are tried, the largest first."""


class _Seen(Protocol):
    """What is asked of a :class:`torchpcct.Scan`, or of the slices of its file."""

    @property
    def geometry(self) -> Any: ...

    @property
    def window(self) -> DetectorWindow | None: ...

    @property
    def region(self) -> VolumeGrid | None: ...

    @property
    def counts(self) -> Tensor: ...


def grid_of(
    scan: _Seen, voxel: object = None, extent: object = None, center: object = None
) -> VolumeGrid:
    """See :meth:`torchpcct.VolumeGrid.of`, whose arguments these are."""
    voxel = None if voxel is None else number("voxel", voxel, positive=True, unit="mm")
    extent, center = _of_axes(scan, extent, center)
    if scan.window is not None:
        return _of_region(scan, scan.window, voxel, extent, center)
    g = scan.geometry
    cell, radius = _field_of_view(g)
    voxel = voxel or cell
    size, center = extent or [0.0, 2.0 * radius, 2.0 * radius], center or [None, 0.0, 0.0]
    plane = _voxels(size[1:], voxel)
    if not g.has_rows:
        slices = tuple(scan.counts.shape[:-2])
        place = (center[0] or 0.0, *center[1:])
        return VolumeGrid((*slices, *plane), voxel, place[1 - len(slices) :])
    if isinstance(g, VectorGeometry):
        # What views above and below see together: a helix covers more than its rows.
        _, heights, _ = g.border_rays()
        low, high = float(heights.min()), float(heights.max())
        orbit = math.inf if g.parallel else float(np.hypot(*g.poses[:, 0, :2].T).mean())
        height = size[0] or high - low - float(np.median(np.ptp(heights, axis=1))) * radius / orbit
        middle = 0.5 * (low + high) if center[0] is None else center[0]
    else:
        height = size[0] or g.rows * g.cell_height * (1.0 - radius / g.sod)
        middle = center[0] or 0.0
    return VolumeGrid(
        (max(1, math.floor(height / voxel + _SLACK)), *plane), voxel, (middle, *center[1:])
    )


def _voxels(extent: Sequence[float], voxel: float | Sequence[float]) -> tuple[int, ...]:
    """As many voxels an axis as cover an extent."""
    per_axis = np.broadcast_to(voxel, len(extent))
    return tuple(max(1, math.ceil(e / v - _SLACK)) for e, v in zip(extent, per_axis, strict=True))


def _of_axes(
    scan: _Seen, extent: object, center: object
) -> tuple[list[float] | None, Sequence[float | None] | None]:
    """Extent and centre as z, y, x, where they are given; of slices the extent along z is 0.

    Raises:
        ValueError: two numbers of a volume; a height of slices, which are those of the readings.
    """
    flat = not scan.geometry.has_rows
    single = flat and scan.counts.ndim == 2
    extent = None if extent is None else list(numbers("extent", extent, positive=True, unit="mm"))
    center = None if center is None else list(numbers("center", center, unit="mm"))
    if extent is not None and len(extent) != (2 if flat else 3):
        wanted = (
            "two numbers, Y X: this scan's slices are those of its readings"
            if flat
            else "three numbers, Z Y X"
        )
        raise ValueError(f"extent must be {wanted}; got {len(extent)}")
    if center is not None and len(center) not in ((2,) if single else (2, 3) if flat else (3,)):
        raise ValueError(
            f"center must be {'two numbers, Y X' if single else 'three numbers, Z Y X'}; got "
            f"{len(center)}"
        )
    return extent and [0.0] * (3 - len(extent)) + extent, center and [None] * (
        3 - len(center)
    ) + center


def _field_of_view(g: Beam | VectorGeometry) -> tuple[float, float]:
    """Size of a cell at the axis, and radius of what is seen, mm."""
    if isinstance(g, VectorGeometry):
        return g.cell, float(g.border_rays()[0].max())
    if not g.parallel and is_offset(g) and view_steps(g.angles)[2] < 2.0 * math.pi:
        return g.cell, g.fov_radius  # of a short scan the lines that the short side measures, too
    return g.cell, float(np.abs(g.ray_distances).max())


def cells_at_axis(geometry: Geometry) -> tuple[float, float, float]:
    """Size of a detector cell as it is seen at the axis, along z, y and x in mm; along z inf
    without rows.

    Of a geometry view by view the median over its views.
    """
    return geometry.cell_height, geometry.cell, geometry.cell


def finite_cells(geometry: Geometry) -> list[float]:
    """:func:`cells_at_axis` without z, where there are no rows."""
    return [cell for cell in cells_at_axis(geometry) if math.isfinite(cell)]


# --- a part of the detector -----------------------------------------------------------------------


def _of_region(
    scan: _Seen,
    window: DetectorWindow,
    voxel: float | None,
    extent: Sequence[float] | None,
    center: Sequence[float | None] | None,
) -> VolumeGrid:
    """The region; with another voxel size or extent, or from one voxel (an extent alone), a grid
    about it."""
    region = scan.region
    if region is None:
        voxel = voxel or scan.geometry.cell
        region = _seen_by(scan.geometry, window, voxel)
    elif region.voxels == 1:
        voxel = voxel or scan.geometry.cell
    if voxel is None and extent is None and center is None:
        return region
    spacing = voxel or region.spacing
    return VolumeGrid(
        _voxels(extent or region.extent, spacing), spacing, tuple(center or region.center)
    )


def _seen_by(g: ConeBeam, window: DetectorWindow, voxel: float) -> VolumeGrid:
    """A box that all views of a window see: of a file that does not say for which region it was
    acquired.

    Raises:
        ValueError: there is no such box.
    """
    for margin in (NOISE_MARGIN_COLUMNS, _LEAST_MARGIN):
        if (box := _box(g, window, voxel, margin)) is not None:
            return box
    raise ValueError(
        "no box lies in the field of view of this scan's part of the detector in all views: give "
        "extent and center"
    )


def _box(g: ConeBeam, window: DetectorWindow, voxel: float, margin: int) -> VolumeGrid | None:
    """The box with the longest edges, whole voxels of them, whose footprint, ``margin`` columns
    wider, a window holds.

    The lines at the window's edges are half-planes that the box must not leave. A box of centre c
    and half edges h lies in n · p ≥ d if n · c − |n| · h ≥ d, so the one with the longest edges is
    a linear programme (Boyd and Vandenberghe, Convex Optimization, 2004, section 4.3).
    """
    if window.columns <= 2 * margin:
        return None
    beta = g.angles
    # Edges of the columns within the margin, as tangents of their fan angles.
    cells = g.column_positions[window.column_indices[:, [margin, -1 - margin]]]
    edges = (cells + 0.5 * g.pitch[1] * np.array([-1.0, 1.0])) / g.sdd
    tangent = np.tan(edges) if g.detector == "curved" else edges
    towards_source = np.stack([np.sin(beta), np.cos(beta)], -1)  # y, x
    across = np.stack([np.cos(beta), -np.sin(beta)], -1)
    side = np.array([1.0, -1.0])  # beyond the first column's line, before the last one's
    normal = side[:, None] * (across[:, None] + tangent[..., None] * towards_source[:, None])
    limit = side * tangent * g.sod
    found = linprog(
        [0.0, 0.0, -1.0, -1.0],
        A_ub=np.hstack([-normal.reshape(-1, 2), np.abs(normal.reshape(-1, 2))]),
        b_ub=-limit.reshape(-1),
        bounds=[(None, None)] * 2 + [(0.0, None)] * 2,
    )
    if found.status != 0 or min(found.x[2:]) <= 0.0:
        return None
    place, half = found.x[:2], found.x[2:]
    corners = place + half * np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])
    depth = g.sod - corners @ towards_source.T
    distance = np.hypot(corners @ across.T, depth) if g.detector == "curved" else depth
    near, far = float(distance.min()) / g.sdd, float(distance.max()) / g.sdd
    rows = g.row_positions[[window.first_row, window.first_row + window.rows - 1]]
    inner = rows + 0.5 * g.pitch[0] * np.array([1.0, -1.0])
    bottom, top = max(inner[0] * near, inner[0] * far), min(inner[1] * near, inner[1] * far)
    if bottom >= top:  # of a row or two
        bottom = top = float(rows.mean()) / g.magnification
    height = max(top - bottom, 0.5 * g.pitch[0] / g.magnification)

    # A window is as wide in every view as in the widest, and begins where the region does: the
    # whole box may be beyond.
    for share in np.linspace(1.0, 0.0, _SHARES, endpoint=False):
        shape = [max(1, math.floor(share * e / voxel + _SLACK)) for e in (height, *(2.0 * half))]
        box = VolumeGrid(shape, voxel, (0.5 * (bottom + top), *place))
        if window.holds(footprint(g, box, margin)):
            return box
    return None
