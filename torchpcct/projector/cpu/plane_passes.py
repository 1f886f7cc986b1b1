# mypy: disable-error-code="call-arg"
"""The passes of the parallel and fan beam: tables made once per dtype, images dealt to lanes,
kernels launched."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchpcct.projector.cpu.plane_kernels import (
    TILE,
    backproject,
    cell_values,
    collect,
    deal,
    load_image,
    project,
    spread_tasks,
    tabulate,
)
from torchpcct.projector.cpu.symmetry import Orbits, address, find_orbits, inverse, no_orbits, place
from torchpcct.projector.rays import Segments, slab_lattice
from torchpcct.projector.tables import Tables
from torchpcct.threads import run

_WIDTHS = (1, 2, 4, 8)
"""Numbers of lanes of a vector register that the kernels are compiled for; a lane holds an image or
one of its symmetric copies."""
_NEAR = 1.0
"""Voxels over which the positions of lanes spread at most where they reach two intervals between
knots."""
_FAR = 2.0
"""Where they reach three."""


class _LaneTables:
    """Edge lines, gains and slab weights of the projected views, and the lanes' places, in one
    dtype.

    ``apart``: ``(2, 2 * lanes)`` per axis: at an edge of the slope q, lane l reads ``q * apart[l] +
    apart[lanes + l]`` beyond the shared position.
    """

    def __init__(self, passes: PlanePasses, dtype: np.dtype, width: int, steepest: float) -> None:
        n = int(passes.entries)
        self.p, self.q, self.gain = (np.empty(n, dtype=dtype) for _ in range(3))
        part = passes.placement.part
        part = part[np.arange(width) % len(part)] if passes.placement.apart else part[:1]
        bias, self.apart = np.zeros(2), np.zeros((2, 2 * width), dtype=dtype)
        self.reach: tuple[int, ...] = ()
        if passes.placement.apart:
            lowest, spread = _lane_range(passes.placement.part, steepest)
            self.reach = (0,) * (2 if spread.max() <= _NEAR else 3)
            bias = len(self.reach) + lowest
            for axis in range(2):
                self.apart[axis] = np.concatenate(
                    [part[:, axis], -part[:, 1 - axis] - lowest[axis]]
                )
        self.weight = np.empty(
            (len(passes.segments), max(passes.placement.shape), len(part)), dtype=dtype
        )
        rays = passes.rays
        pose = np.ascontiguousarray(rays.pose[passes.orbits.views])
        first = np.ascontiguousarray(rays.first[passes.orbits.views])
        tabulate(
            passes.segments,
            passes.offset,
            pose,
            rays.edges,
            rays.centers,
            first,
            passes.lattice,
            np.array(passes.placement.shape),
            rays.parallel,
            bias,
            np.ascontiguousarray(part.T),
            self.p,
            self.q,
            self.gain,
            self.weight,
        )
        self.weight = self.weight.reshape(len(passes.segments), -1)


def _lane_range(
    part: NDArray[np.float64], steepest: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Per axis: lowest position of a lane against the shared one for slopes up to ``steepest``,
    and the spread."""
    across, along = part, -part[:, ::-1]  # axis 0: slabs are rows
    lowest = (along - steepest * np.abs(across)).min(axis=0)
    return lowest, (along + steepest * np.abs(across)).max(axis=0) - lowest


class PlanePasses:
    """Forward and adjoint passes of a 2-D scan on arrays with one leading batch axis."""

    def __init__(self, tables: Tables) -> None:
        self.grid, self.rays = tables.grid, tables.rays
        self._lay_out(
            tables.segments, find_orbits(tables.geometry, tables.grid, tables.rays, tables.windowed)
        )
        if self.placement.apart:
            self._steepest = float(np.abs(_LaneTables(self, np.dtype(np.float64), 1, 0.0).q).max())
            if _lane_range(self.placement.part, self._steepest)[1].max() > _FAR:
                self._lay_out(tables.segments, no_orbits(tables.rays.views))

    def _lay_out(self, segments: Segments, orbits: Orbits) -> None:
        rays, grid = self.rays, self.grid
        self.orbits, self.placement = orbits, place(orbits.operations, grid)
        kept = np.full(rays.views, -1)
        kept[orbits.views] = np.arange(orbits.views.size)
        table = segments.table[kept[segments.table[:, 0]] >= 0].copy()
        table[:, 0] = kept[table[:, 0]]
        self.segments = np.ascontiguousarray(table)
        self.start = np.searchsorted(table[:, 0], np.arange(orbits.views.size + 1)).astype(np.int64)
        entries = np.concatenate([[0], np.cumsum(table[:, 3] + 1)])
        self.offset, self.entries = np.ascontiguousarray(entries[:-1]), int(entries[-1])
        ny, nx = grid.shape
        self.addresses = np.array([address(g, ny, nx) for g in orbits.operations])
        self.inverse = np.array([inverse(g, ny, nx) for g in orbits.operations])
        self.lattice = slab_lattice(self.placement.center, self.placement.shape, grid.spacing[-2:])
        self._steepest = 0.0
        self._tables: dict[tuple[np.dtype, int], _LaneTables] = {}

    def tables(self, dtype: np.dtype, width: int) -> _LaneTables:
        key = (dtype, width if self.placement.apart else 1)
        if key not in self._tables:
            self._tables[key] = _LaneTables(self, dtype, width, self._steepest)
        return self._tables[key]

    @property
    def operations(self) -> int:
        return len(self.orbits.operations)

    def lanes(self, batch: int) -> int:
        """Lanes of one launch: the operations times as many images as fill a register."""
        images = max(1, min(batch, 8 // self.operations))
        return next(w for w in _WIDTHS if w >= images * self.operations)

    def _size(self, reach: int) -> NDArray[np.int64]:
        """``(2, 2)``: slabs and knots of the lattice per axis."""
        ny, nx = self.placement.shape
        more = 2 * reach + 1 if reach else 1
        return np.array([[ny, nx + 1 + more], [nx, ny + 1 + more]], dtype=np.int64)

    def _place(self, width: int, reach: int) -> NDArray[np.int64]:
        """``(2, lanes, 2)`` per axis: slab and knot where each lane's image begins."""
        shift = self.placement.shift[np.arange(width) % self.operations]
        places = np.stack([shift, shift[:, ::-1]])
        places[..., 1] += reach
        return np.ascontiguousarray(places)

    def workspace(self, batch: int, itemsize: int) -> int:
        """Bytes held besides input and output, tables included."""
        lanes = self.lanes(batch)
        knots = int(self._size(3 if self.placement.apart else 0).prod(axis=1).sum())
        readings = max(self.orbits.views.size * self.rays.columns, self.entries)
        weights = (
            len(self.segments) * max(self.placement.shape) * (lanes if self.placement.apart else 1)
        )
        return itemsize * (lanes * (knots + readings) + 3 * self.entries + weights)

    def forward(self, x: NDArray) -> NDArray:
        ny, nx = self.grid.shape
        images = x.reshape(x.shape[0], ny * nx)
        y = np.empty((x.shape[0], self.rays.views, self.rays.columns), dtype=x.dtype)
        width = self.lanes(x.shape[0])
        t = self.tables(x.dtype, width)
        step = max(1, width // self.operations)
        places = self._place(width, len(t.reach))
        out = np.empty((self.orbits.views.size, self.rays.columns * width), dtype=x.dtype)
        for n in range(0, x.shape[0], step):
            count = min(step, x.shape[0] - n)
            sums = []
            for axis, shape in enumerate(self._size(len(t.reach))):
                lines = np.empty((*shape, width), dtype=x.dtype)
                slabs, pixels = (ny, nx) if axis == 0 else (nx, ny)
                table = self._lane_table(n, count, width, axis)
                run(
                    load_image,
                    len(lines),
                    images,
                    table,
                    places[axis],
                    slabs,
                    pixels,
                    lines,
                    operations=lines[0].size,
                )
                sums.append(lines.reshape(shape[0], -1))
            run(
                project,
                len(out),
                (0,) * width,
                t.reach,
                self.segments,
                self.offset,
                self.start,
                *sums,
                t.p,
                t.q,
                t.gain,
                t.weight,
                t.apart,
                out,
            )
            orbits = self.orbits
            deal(
                out.reshape(len(out), -1, width),
                orbits.target,
                orbits.reverse,
                count,
                y[n : n + count],
            )
        return y

    def adjoint(self, y: NDArray) -> NDArray:
        ny, nx = self.grid.shape
        x = np.empty((y.shape[0], ny, nx), dtype=y.dtype)
        width = self.lanes(y.shape[0])
        t = self.tables(y.dtype, width)
        step = max(1, width // self.operations)
        size, places = self._size(len(t.reach)), self._place(width, len(t.reach))
        values = np.zeros((self.entries, width), dtype=y.dtype)
        by_row = np.empty((width, ny, nx), dtype=y.dtype)
        by_column = np.empty((width, nx, ny), dtype=y.dtype)
        for n in range(0, y.shape[0], step):
            part = y[n : n + step]
            orbits = self.orbits
            cell_values(
                part, orbits.target, orbits.reverse, self.segments, self.offset, t.gain, values
            )
            run(
                backproject,
                spread_tasks(size),
                (0,) * width,
                t.reach,
                self.segments,
                self.offset,
                t.p,
                t.q,
                t.weight,
                t.apart,
                values.reshape(-1),
                size,
                places,
                by_row,
                by_column,
            )
            tiles, pixels = -(-ny // TILE), TILE * nx * 2 * width
            run(
                collect,
                tiles,
                by_row,
                by_column,
                self.inverse,
                self.operations,
                x[n : n + step],
                operations=pixels,
            )
        return x

    def _lane_table(self, first: int, count: int, width: int, axis: int) -> NDArray[np.int64]:
        """``(lanes, 4)``: image, base, step per slab, step along the slab; spare lanes repeat
        the first."""
        table = np.zeros((width, 4), dtype=np.int64)
        table[:, 0], table[:, 1:] = first, self.addresses[0]
        for n in range(count):
            here = slice(n * self.operations, (n + 1) * self.operations)
            table[here, 0], table[here, 1:] = first + n, self.addresses
        return table if axis == 0 else np.ascontiguousarray(table[:, [0, 1, 3, 2]])
