"""The passes of the cone beam: volumes one by one, the adjoint in chunks of views."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchpcct.projector.cpu.cone_kernels import VIEWS, backproject, padded, project
from torchpcct.projector.tables import Tables
from torchpcct.threads import get_num_threads

ROW_SUMS_BYTES = 64 << 20
"""Row sums of the adjoint are made for chunks of views of about this size: large enough to keep all
threads busy."""


class ConePasses:
    """Forward and adjoint passes of a cone-beam scan on arrays with one leading batch axis."""

    def __init__(self, tables: Tables) -> None:
        self.tables = tables

    def forward(self, x: NDArray) -> NDArray:
        t, r = self.tables, self.tables.rays
        _, ny, nx = t.grid.shape
        y = np.empty((x.shape[0], *t.range_shape), dtype=x.dtype)
        # One volume after the other: each stays in the cache, a batch of them would not.
        for n in range(x.shape[0]):
            project(
                running_sums(x[n]),
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
                y[n],
            )
        return y

    def adjoint(self, y: NDArray) -> NDArray:
        t, r = self.tables, self.tables.rays
        x = np.empty((y.shape[0], *t.grid.shape), dtype=y.dtype)
        for n in range(y.shape[0]):
            backproject(
                y[n],
                t.pose,
                r.edges,
                r.centers,
                r.first,
                t.segments.table,
                t.segments.start,
                t.lattice,
                *t.heights,
                t.layer,
                self.views_at_once(y.itemsize),
                x[n],
            )
        return x

    def workspace(self, batch: int, itemsize: int) -> int:
        """Bytes held besides input and output, the larger of the two directions; volumes pass
        one by one."""
        forward, adjoint, per_view = self.bytes(itemsize)
        return max(forward, adjoint + per_view * self.views_at_once(itemsize))

    def bytes(self, itemsize: int) -> tuple[int, int, int]:
        """Working memory of the passes of one volume: forward, adjoint, adjoint per view held at
        a time."""
        r, table = (
            self.tables.rays,
            8 * (8 * self.tables.rays.views + 4 * len(self.tables.segments.table)),
        )
        nz, ny, nx = self.tables.grid.shape
        sums = VIEWS * r.columns * padded(r.rows) * get_num_threads()
        forward = ny * nx * (nz + 16) + sums
        return (
            table + itemsize * forward,
            table + itemsize * 2 * ny * nx * (nz + 8),
            itemsize * r.columns * (r.rows + 1),
        )

    def views_at_once(self, itemsize: int) -> int:
        """Views whose row sums the adjoint holds at a time."""
        return int(max(1, min(self.tables.rays.views, ROW_SUMS_BYTES // self.bytes(itemsize)[2])))


def running_sums(x: NDArray[np.float32 | np.float64]) -> NDArray[np.float32 | np.float64]:
    """``(nz, ny, nx)`` to the ``lines`` of ``cone_kernels.project``."""
    nz, ny, nx = x.shape
    lines = np.empty((ny * nx, padded(nz) + 8), dtype=x.dtype)
    lines[:, 0] = 0
    np.cumsum(x.reshape(nz, ny * nx).T, axis=-1, out=lines[:, 1 : nz + 1])
    lines[:, nz + 1 :] = lines[:, nz, None]
    return lines
