"""The passes of per-view geometry: volumes one by one, 2-D grids as one slice."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchpcct.projector.cpu.vector_kernels import SLAB_BLOCK, backproject_vectors, project_vectors
from torchpcct.projector.tables import VectorTables
from torchpcct.threads import run

__all__ = ["VectorPasses"]


class VectorPasses:
    """Forward and adjoint passes of a scan given by vectors on arrays with one leading batch
    axis."""

    def __init__(self, tables: VectorTables) -> None:
        self.tables = tables
        grid, g = tables.grid, tables.geometry
        nx, ny = grid.shape[-1], grid.shape[-2]
        nz = grid.shape[0] if grid.ndim == 3 else 1
        poses = np.array(g.poses)
        if grid.ndim == 2:
            poses[:, 3] = 0.0  # cells without height read the slice itself
        spacing, center = (
            np.array([*v[::-1], w])[:3] for v, w in ((grid.spacing, 1.0), (grid.center, 0.0))
        )
        shape = np.array([nx, ny, nz], dtype=np.int64)
        lower = center - shape * spacing / 2
        strides = np.array([1, nx, nx * ny], dtype=np.int64)
        self._scan = (poses, bool(g.parallel), lower, spacing, shape, strides)

    def forward(self, x: NDArray) -> NDArray:
        views, rows, columns = self._readings
        y = np.empty((x.shape[0], views, rows, columns), dtype=x.dtype)
        for n in range(x.shape[0]):
            run(project_vectors, views, *self._scan, np.ascontiguousarray(x[n]).reshape(-1), y[n])
        return y.reshape(x.shape[0], *self.tables.range_shape)

    def adjoint(self, y: NDArray) -> NDArray:
        x = np.zeros((y.shape[0], *self.tables.domain_shape), dtype=y.dtype)
        data = np.ascontiguousarray(y).reshape(y.shape[0], *self._readings)
        for n in range(y.shape[0]):
            for axis, size in enumerate(self._scan[-2]):
                blocks = -(-int(size) // SLAB_BLOCK)
                run(backproject_vectors, blocks, *self._scan, data[n], axis, x[n].reshape(-1))
        return x

    @property
    def _readings(self) -> tuple[int, int, int]:
        g = self.tables.geometry
        return g.views, g.rows or 1, g.columns

    def workspace(self, batch: int, itemsize: int) -> int:
        """Bytes held besides input and output."""
        return 8 * 12 * self.tables.geometry.views
