# mypy: disable-error-code="call-arg"
"""The passes of the parallel and fan beam: tables made once per dtype, images dealt to lanes, kernels launched."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchpcct.geometry import Geometry, VolumeGrid
from torchpcct.projector.rays import Rays, split
from torchpcct.projector.symmetry import address, find_orbits

__all__ = ["PlanePasses"]

_WIDTHS = (1, 2, 4, 8)


class _Tables:
    """Edge lines, gains and slab weights of the projected views in one dtype."""

    def __init__(self, passes: PlanePasses, dtype: np.dtype) -> None:
        from torchpcct.projector import plane_kernels

        n = int(passes.entries)
        self.p, self.q, self.gain = (np.empty(n, dtype=dtype) for _ in range(3))
        self.weight = np.empty((len(passes.segments), max(passes.grid.shape)), dtype=dtype)
        rays = passes.rays
        pose = np.ascontiguousarray(rays.pose[passes.orbits.views])
        first = np.ascontiguousarray(rays.first[passes.orbits.views])
        plane_kernels.tabulate(
            passes.segments, passes.offset, pose, rays.edges, rays.centers, first, passes.lattice,
            np.array(passes.grid.shape), rays.parallel, self.p, self.q, self.gain, self.weight,
        )  # fmt: skip


class PlanePasses:
    """Forward and adjoint passes of a 2-D scan on arrays with one leading batch axis.

    Args:
        geometry, grid: the scan and the pixels. rays: its rays. lattice: slab positions (see ``_edge_line``).
        windowed: only a part of the detector is read, which breaks symmetries.
    """

    def __init__(
        self, geometry: Geometry, grid: VolumeGrid, rays: Rays, lattice: NDArray[np.float64], windowed: bool
    ) -> None:
        self.grid, self.rays, self.lattice = grid, rays, lattice
        self.orbits = find_orbits(geometry, grid, rays, windowed)
        segments = split(rays, grid)
        kept = np.full(rays.views, -1)
        kept[self.orbits.views] = np.arange(self.orbits.views.size)
        table = segments.table[kept[segments.table[:, 0]] >= 0].copy()
        table[:, 0] = kept[table[:, 0]]
        self.segments = np.ascontiguousarray(table)
        self.start = np.searchsorted(table[:, 0], np.arange(self.orbits.views.size + 1)).astype(np.int64)
        entries = np.concatenate([[0], np.cumsum(table[:, 3] + 1)])
        self.offset, self.entries = np.ascontiguousarray(entries[:-1]), int(entries[-1])
        ny, nx = grid.shape
        self.addresses = np.array([address(g, ny, nx) for g in self.orbits.operations])
        self.inverse = np.array([_inverse(a, ny, nx) for a in self.addresses])
        self._tables: dict[np.dtype, _Tables] = {}

    def tables(self, dtype: np.dtype) -> _Tables:
        if dtype not in self._tables:
            self._tables[dtype] = _Tables(self, dtype)
        return self._tables[dtype]

    @property
    def operations(self) -> int:
        return len(self.orbits.operations)

    def lanes(self, batch: int) -> int:
        """Lanes of one launch: the operations times as many images as fill a register."""
        images = max(1, min(batch, 8 // self.operations))
        return next(w for w in _WIDTHS if w >= images * self.operations)

    def workspace(self, batch: int, itemsize: int) -> int:
        """Bytes held besides input and output, tables included."""
        ny, nx = self.grid.shape
        lanes = self.lanes(batch)
        knots = ny * (nx + 2) + nx * (ny + 2)
        readings = max(self.orbits.views.size * self.rays.columns, self.entries)
        return itemsize * (lanes * (knots + readings) + 3 * self.entries + len(self.segments) * max(ny, nx))

    def forward(self, x: NDArray) -> NDArray:
        from torchpcct.projector import plane_kernels as kernels

        ny, nx = self.grid.shape
        images = x.reshape(x.shape[0], ny * nx)
        y = np.empty((x.shape[0], self.rays.views, self.rays.columns), dtype=x.dtype)
        t = self.tables(x.dtype)
        width = self.lanes(x.shape[0])
        step = max(1, width // self.operations)
        out = np.empty((self.orbits.views.size, self.rays.columns * width), dtype=x.dtype)
        for n in range(0, x.shape[0], step):
            count = min(step, x.shape[0] - n)
            sums = []
            for axis, shape in ((0, (ny, nx)), (1, (nx, ny))):
                lines = np.empty((shape[0], shape[1] + 2, width), dtype=x.dtype)
                kernels.load_image(images, self._lane_table(n, count, width, axis), axis, lines)
                sums.append(lines.reshape(shape[0], -1))
            kernels.project(
                (0,) * width, self.segments, self.offset, self.start, *sums, t.p, t.q, t.gain, t.weight, out
            )
            orbits = self.orbits
            kernels.deal(out.reshape(len(out), -1, width), orbits.target, orbits.reverse, count, y[n : n + count])
        return y

    def adjoint(self, y: NDArray) -> NDArray:
        from torchpcct.projector import plane_kernels as kernels

        ny, nx = self.grid.shape
        x = np.empty((y.shape[0], ny, nx), dtype=y.dtype)
        t = self.tables(y.dtype)
        width = self.lanes(y.shape[0])
        step = max(1, width // self.operations)
        values = np.zeros((self.entries, width), dtype=y.dtype)
        by_row = np.empty((width, ny, nx), dtype=y.dtype)
        by_column = np.empty((width, nx, ny), dtype=y.dtype)
        for n in range(0, y.shape[0], step):
            part = y[n : n + step]
            orbits = self.orbits
            kernels.cell_values(part, orbits.target, orbits.reverse, self.segments, self.offset, t.gain, values)
            kernels.backproject(
                (0,) * width, self.segments, self.offset, t.p, t.q, t.weight, values.reshape(-1), by_row, by_column
            )
            kernels.collect(by_row, by_column, self.inverse, self.operations, x[n : n + step])
        return x

    def _lane_table(self, first: int, count: int, width: int, axis: int) -> NDArray[np.int64]:
        """``(lanes, 4)``: image, base, step per slab, step along the slab; spare lanes repeat the first."""
        table = np.zeros((width, 4), dtype=np.int64)
        table[:, 0], table[:, 1:] = first, self.addresses[0]
        for n in range(count):
            here = slice(n * self.operations, (n + 1) * self.operations)
            table[here, 0], table[here, 1:] = first + n, self.addresses
        return table if axis == 0 else np.ascontiguousarray(table[:, [0, 1, 3, 2]])


def _inverse(affine: NDArray[np.int64], ny: int, nx: int) -> NDArray[np.int64]:
    """Row and column of the operated image that show pixel (y, x): two times (base, per y, per x)."""
    base, down, right = (int(v) for v in affine)
    rows = np.arange(ny * nx).reshape(ny, nx)
    index = (base + down * np.arange(ny)[:, None] + right * np.arange(nx)).ravel()
    where = np.empty(ny * nx, dtype=np.int64)
    where[index] = rows.ravel()
    at = np.stack(np.divmod(where.reshape(ny, nx), nx))  # (2, y, x): operated row and column
    per_y = at[:, 1, 0] - at[:, 0, 0] if ny > 1 else np.zeros(2, dtype=np.int64)
    per_x = at[:, 0, 1] - at[:, 0, 0] if nx > 1 else np.zeros(2, dtype=np.int64)
    return np.stack([at[:, 0, 0], per_y, per_x], axis=1).ravel()
