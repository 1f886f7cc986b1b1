"""The passes of the cone beam: a few volumes at a time, the adjoint in chunks of views."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchpcct.projector.cpu.cone_kernels import VIEWS, backproject, padded, project
from torchpcct.projector.tables import Tables
from torchpcct.threads import get_num_threads

ROW_SUMS_BYTES = 64 << 20
"""Row sums of the adjoint are made for chunks of views of about this size: large enough to keep all
threads busy."""
MOST_TOGETHER = 8
"""Volumes of a batch that are projected together, at most: more gain nothing."""
TOGETHER_BYTES = 12 << 20
"""Of their voxels, at most: lines of more leave the second-level cache before they are read again.
Against one by one, processor time of eight volumes of 32³ 0.65 (both passes), of four of 64³ 0.85,
of two of 128³ 1.0 to 1.1."""


class ConePasses:
    """Forward and adjoint passes of a cone-beam scan on arrays with one leading batch axis."""

    def __init__(self, tables: Tables) -> None:
        self.tables = tables

    def forward(self, x: NDArray) -> NDArray:
        t, r = self.tables, self.tables.rays
        _, ny, nx = t.grid.shape
        y = np.empty((x.shape[0], *t.range_shape), dtype=x.dtype)
        for some in self._groups(len(x), x.itemsize):
            project(
                running_sums(x[some]),
                ny,
                nx,
                t.pose,
                r.edges,
                r.centers,
                r.first,
                t.segments.table,
                t.segments.start,
                t.lattice,
                *t.heights,
                t.layer,
                y[some],
            )
        return y

    def adjoint(self, y: NDArray) -> NDArray:
        t, r = self.tables, self.tables.rays
        x = np.empty((y.shape[0], *t.grid.shape), dtype=y.dtype)
        for some in self._groups(len(y), y.itemsize):
            backproject(
                y[some],
                t.pose,
                r.edges,
                r.centers,
                r.first,
                t.segments.table,
                t.segments.start,
                t.lattice,
                *t.heights,
                t.layer,
                self.views_at_once(y.itemsize, len(y[some])),
                x[some],
            )
        return x

    def together(self, itemsize: int) -> int:
        """How many volumes are projected together: they share what the geometry alone decides."""
        nz, ny, nx = self.tables.grid.shape
        fit = TOGETHER_BYTES // (itemsize * ny * nx * padded(nz))
        return max(1, min(MOST_TOGETHER, fit))

    def _groups(self, batch: int, itemsize: int) -> list[slice]:
        most = self.together(itemsize)
        return [slice(n, n + most) for n in range(0, batch, most)]

    def workspace(self, batch: int, itemsize: int) -> int:
        """Bytes held besides input and output, the larger of the two directions."""
        volumes = min(batch, self.together(itemsize))
        r = self.tables.rays
        table = 8 * (8 * r.views + 4 * len(self.tables.segments.table))
        forward, adjoint, per_view = (volumes * part for part in self.bytes(itemsize))
        return table + max(forward, adjoint + per_view * self.views_at_once(itemsize, volumes))

    def bytes(self, itemsize: int) -> tuple[int, int, int]:
        """Working memory of the passes for one volume: forward, adjoint, adjoint per view held at
        a time."""
        r = self.tables.rays
        nz, ny, nx = self.tables.grid.shape
        sums = VIEWS * r.columns * padded(r.rows) * get_num_threads()
        return (
            itemsize * (ny * nx * (nz + 16) + sums),
            itemsize * 2 * ny * nx * (nz + 8),
            itemsize * r.columns * (r.rows + 1),
        )

    def views_at_once(self, itemsize: int, volumes: int = 1) -> int:
        """Views whose row sums the adjoint of so many volumes holds at a time."""
        fit = ROW_SUMS_BYTES // (volumes * self.bytes(itemsize)[2])
        return int(max(1, min(self.tables.rays.views, fit)))


def running_sums(x: NDArray[np.float32 | np.float64]) -> NDArray[np.float32 | np.float64]:
    """``(batch, nz, ny, nx)`` to the ``lines`` of ``cone_kernels.project``."""
    batch, nz, ny, nx = x.shape
    lines = np.empty((ny * nx, batch, padded(nz) + 8), dtype=x.dtype)
    lines[..., 0] = 0
    columns = x.reshape(batch, nz, ny * nx).transpose(2, 0, 1)
    np.cumsum(columns, axis=-1, out=lines[..., 1 : nz + 1])
    lines[..., nz + 1 :] = lines[..., nz, None]
    return lines.reshape(ny * nx, -1)
