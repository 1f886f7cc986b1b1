"""Where the rays of every view run: per-view poses, cell edges, and the split of each view by its
main axis.

The kernels never see a geometry. They see, for each view, a source, an in-plane vector ``axial``
and an in-plane vector ``across``; the in-plane ray of the detector position with table entries
``(a, b)`` points along ``a * axial + b * across``. Flat detector: ``a = 1, b = u``. Curved: ``a =
cos γ, b = sdd * sin γ``. Both reach the detector at the ray parameter λ = 1, so that heights scale
with λ. A parallel beam has the one direction ``axial`` and starts at ``source + b * across``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from torchpcct.detector_window import DetectorWindow
from torchpcct.geometry import Geometry, ParallelBeam, VolumeGrid, beam

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Rays:
    """Poses of all views and the detector cells they are read with (mm, float64).

    Args:
        parallel: parallel rays (see the module's text) instead of a point source.
        source: ``(views, 3)`` source position x, y, z (parallel: a point of the ray ``b = 0``).
        axial: ``(views, 2)`` in-plane vector from the source to the detector's foot.
        across: ``(views, 2)`` in-plane direction of growing columns.
        foot_z: ``(views,)`` height of the detector position ``v = 0``.
        edges: ``(columns + 1, 2)`` table entries (a, b) of the cell edges.
        centers: ``(columns, 2)`` table entries of the cell centres.
        row_edge, row_pitch: height of the first row's lower edge above ``v = 0``, and the row pitch
            (2-D: -0.5, 1).
        first: ``(views,)`` first column kept in each view.
        columns, first_row, rows: the columns and rows kept.
    """

    parallel: bool
    source: Floats
    axial: Floats
    across: Floats
    foot_z: Floats
    edges: Floats
    centers: Floats
    row_edge: float
    row_pitch: float
    first: Ints
    columns: int
    first_row: int
    rows: int

    @property
    def views(self) -> int:
        return int(self.source.shape[0])

    @property
    def pose(self) -> Floats:
        """``(views, 8)``: source x, y, z; axial x, y; across x, y; foot height. What the kernels
        read."""
        return np.ascontiguousarray(
            np.concatenate(
                [self.source, self.axial, self.across, self.foot_z[:, None]],
                axis=1,
                dtype=np.float64,
            )
        )

    def moved(self, shift: Floats) -> Rays:
        """The rays seen from an object displaced by ``shift``, ``(views, 2)`` (y, x) or
        ``(views, 3)`` (z, y, x) mm."""
        source = self.source.copy()
        source[:, :2] -= shift[:, :-3:-1]
        if shift.shape[1] == 2:
            return replace(self, source=source)
        source[:, 2] -= shift[:, 0]
        return replace(self, source=source, foot_z=self.foot_z - shift[:, 0])


def check_pair(geometry: Geometry, grid: object, window: object) -> None:
    """Refuse a geometry, grid and window that do not belong together.

    Raises:
        TypeError: an argument of the wrong kind.
        ValueError: a 3-D grid with a 2-D geometry or the reverse, a window that does not fit the
            detector.
    """
    geometry = beam(geometry)
    if not isinstance(grid, VolumeGrid):
        raise TypeError(f"grid must be a VolumeGrid, got {type(grid).__name__}")
    axes = 3 if geometry.has_rows else 2
    if grid.ndim != axes:
        raise ValueError(
            f"{type(geometry).__name__} needs a {axes}-D grid, got shape {grid.shape}: "
            + (
                "use FanBeam for one slice"
                if axes == 3
                else "use grid.slice, or ConeBeam for a volume"
            )
        )
    if window is None:
        return
    if not isinstance(window, DetectorWindow):
        raise TypeError(f"window must be a DetectorWindow or None, got {type(window).__name__}")
    window.check(geometry)


def rays_of(geometry: Geometry, window: DetectorWindow | None = None) -> Rays:
    """The rays of a circular scan (see :class:`Rays`)."""
    geometry = beam(geometry)
    views, columns = geometry.views, geometry.columns
    beta = geometry.angles
    radial = np.stack([np.cos(beta), np.sin(beta)], axis=1)
    tangent = np.stack([-np.sin(beta), np.cos(beta)], axis=1)
    row_edge, row_pitch, rows = -0.5, 1.0, 1
    centers, pitch = geometry.column_positions, geometry.column_pitch
    if geometry.has_rows:
        row_pitch, rows = geometry.row_pitch, geometry.row_positions.size
        row_edge = geometry.row_positions[0] - row_pitch / 2
    edges = np.append(centers - pitch / 2, centers[-1] + pitch / 2)
    source = np.zeros((views, 3))
    if isinstance(geometry, ParallelBeam):
        axial = -radial
        table = [np.stack([np.ones(t.size), t], axis=1) for t in (edges, centers)]
    else:
        source[:, :2] = geometry.sod * radial
        axial = -geometry.sdd * radial
        if geometry.detector == "curved":
            table = [
                np.stack(
                    [np.cos(t / geometry.sdd), geometry.sdd * np.sin(t / geometry.sdd)], axis=1
                )
                for t in (edges, centers)
            ]
        else:
            table = [np.stack([np.ones(t.size), t], axis=1) for t in (edges, centers)]
    first = np.zeros(views, dtype=np.int64) if window is None else np.asarray(window.first_column)
    return Rays(
        parallel=geometry.parallel,
        source=source,
        axial=axial,
        across=tangent,
        foot_z=np.zeros(views),
        edges=table[0],
        centers=table[1],
        row_edge=row_edge,
        row_pitch=row_pitch,
        first=first,
        columns=columns if window is None else window.columns,
        first_row=0 if window is None else window.first_row,
        rows=rows if window is None else window.rows,
    )


@dataclass(frozen=True, eq=False)
class Segments:
    """Runs of neighbouring columns of a view whose rays share their main axis.

    Rays that cross more grid rows than columns are followed row by row (axis 0), the others column
    by column (axis 1), whatever the view: this keeps the step along a grid line below one voxel for
    every ray of a wide fan.

    Args:
        table: ``(segments, 4)`` int64: view, axis, first column (within the window), number of
            columns; sorted by view.
        start: ``(views + 1,)`` int64, the segments of view ``v`` are ``start[v]:start[v + 1]``.
    """

    table: Ints
    start: Ints


def split(rays: Rays, grid: VolumeGrid) -> Segments:
    """The segments of all views for the voxels of ``grid`` (see :class:`Segments`)."""
    hy, hx = grid.spacing[-2:]
    rows: list[Ints] = []
    offset = np.arange(rays.columns)
    for begin in range(0, rays.views, 256):
        view = slice(begin, min(begin + 256, rays.views))
        cell = rays.centers[rays.first[view, None] + offset]  # (views, columns, 2)
        b = np.zeros_like(cell[..., 1]) if rays.parallel else cell[..., 1]
        dx = cell[..., 0] * rays.axial[view, None, 0] + b * rays.across[view, None, 0]
        dy = cell[..., 0] * rays.axial[view, None, 1] + b * rays.across[view, None, 1]
        # A hair's breadth in favour of rows, so that exact diagonals do not flip with the rounding
        # of the cosine.
        along_x = (np.abs(dx) * hy > np.abs(dy) * hx * (1 + 1e-9)).astype(np.int64)
        change = np.diff(along_x, axis=1) != 0
        cut = np.concatenate([np.ones((along_x.shape[0], 1), bool), change], axis=1)
        v, first = np.nonzero(cut)
        stop = np.append(first[1:], 0)
        stop[stop == 0] = rays.columns
        rows.append(np.stack([v + begin, along_x[v, first], first, stop - first], axis=1))
    table = np.ascontiguousarray(np.concatenate(rows).astype(np.int64))
    start = np.searchsorted(table[:, 0], np.arange(rays.views + 1)).astype(np.int64)
    return Segments(table, start)


def slab_lattice(center: Sequence[float], shape: Sequence[int], spacing: Sequence[float]) -> Floats:
    """``(8,)`` mm: y of the first row of voxels and the row pitch, x of the first voxel edge and
    the pitch along a row; then the same for columns. All arguments ``(y, x)``."""
    (hy, hx), (ny, nx) = spacing, shape
    y, x = center[0] - (ny - 1) / 2 * hy, center[1] - (nx - 1) / 2 * hx
    return np.array([y, hy, x - hx / 2, hx, x, hx, y - hy / 2, hy])


def check_source(place: Floats, grid: VolumeGrid) -> None:
    """Refuse a source inside the grid: its line integrals would start in the middle of the object.

    Args:
        place: ``(views, axes)`` of the source in mm, axes as the grid has them.
        grid: of the object.

    Raises:
        ValueError: some view's source lies inside the grid (or touches it).
    """
    inside = (np.abs(place - np.array(grid.center)) <= np.array(grid.extent) / 2).all(1)
    if inside.any():
        view = int(inside.argmax())
        x, extent, center = (
            ", ".join(f"{v:.4g}" for v in values[::-1])
            for values in (place[view], grid.extent, grid.center)
        )
        raise ValueError(
            f"the source of view {view} at {x} mm lies inside the grid of {extent} mm about "
            f"{center} mm: shrink or move the grid, or move the source away (a larger sod)"
        )
