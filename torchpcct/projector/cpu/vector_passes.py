"""The passes of per-view geometry: volumes one by one, 2-D grids as one slice."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchpcct.geometry import VolumeGrid
from torchpcct.projector.cpu.vector_kernels import SLAB_BLOCK, backproject_vectors, project_vectors
from torchpcct.projector.tables import VectorTables, along_xyz
from torchpcct.threads import run

Floats = NDArray[np.float64]


class PosePasses:
    """Passes between a grid and readings, in whatever poses the views have: forward, adjoint, and
    their derivatives by the poses.

    All arrays of volumes and readings have one leading batch axis; poses are ``(views, 4, 3)``
    float64: source (parallel rays: direction), centre, u, v.

    Args:
        grid: 2-D or 3-D.
        readings: views, rows (of a 2-D grid 1) and columns.
        parallel: whether the rays of a view are parallel.
        bend: angle between neighbouring columns of a detector on an arc, rad; 0: flat.
        middle: row, fractional, at the centre of the detector; None: the middle one.
    """

    def __init__(
        self,
        grid: VolumeGrid,
        readings: tuple[int, int, int],
        parallel: bool,
        bend: float = 0.0,
        middle: float | None = None,
    ) -> None:
        self.grid, self.readings = grid, readings
        shape, spacing, center = along_xyz(grid)
        nx, ny = int(shape[0]), int(shape[1])
        lower = center - shape * spacing / 2
        strides = np.array([1, nx, nx * ny], dtype=np.int64)
        row = (readings[1] - 1) / 2 if middle is None else float(middle)
        self._scan = (bool(parallel), float(bend), row, lower, spacing, shape, strides)
        self._blocks = [(axis, -(-int(size) // SLAB_BLOCK)) for axis, size in enumerate(shape)]

    def _poses(self, poses: NDArray) -> Floats:
        out = np.array(poses, dtype=np.float64)
        if self.grid.ndim == 2:
            out[..., 3, :] = 0.0  # cells without height read the slice itself
        return out

    def _outer(self) -> tuple[int, ...]:
        views, rows, columns = self.readings
        return (views, rows, columns) if self.grid.ndim == 3 else (views, columns)

    def forward(self, poses: NDArray, x: NDArray) -> NDArray:
        y = np.empty((x.shape[0], *self.readings), dtype=x.dtype)
        placed = self._poses(poses)
        for n in range(x.shape[0]):
            flat = np.ascontiguousarray(x[n]).reshape(-1)
            run(project_vectors, self.readings[0], placed, *self._scan, flat, y[n])
        return y.reshape(x.shape[0], *self._outer())

    def adjoint(self, poses: NDArray, y: NDArray) -> NDArray:
        x = np.zeros((y.shape[0], *self.grid.shape), dtype=y.dtype)
        data = np.ascontiguousarray(y).reshape(y.shape[0], *self.readings)
        placed = self._poses(poses)
        for n in range(y.shape[0]):
            for axis, blocks in self._blocks:
                run(
                    backproject_vectors,
                    blocks,
                    placed,
                    *self._scan,
                    data[n],
                    axis,
                    x[n].reshape(-1),
                )
        return x

    def gradient(self, poses: NDArray, x: NDArray, y: NDArray) -> Floats:
        """Of ⟨y, A(poses) x⟩ by the poses, ``(views, 4, 3)``, summed over the batch."""
        from torchpcct.projector.cpu.pose_kernels import pose_gradients

        placed = self._poses(poses)
        out = np.zeros_like(placed)
        data = np.ascontiguousarray(y).reshape(y.shape[0], *self.readings)
        for n in range(x.shape[0]):
            flat = np.ascontiguousarray(x[n]).reshape(-1)
            run(pose_gradients, self.readings[0], placed, *self._scan, flat, data[n], out)
        if self.grid.ndim == 2:
            out[:, 3] = 0.0
        return out

    def derivative(self, poses: NDArray, x: NDArray, tangents: NDArray) -> NDArray:
        """Of A(poses) x along ``tangents (directions, views, 4, 3)``, ``(batch, directions,
        *readings)``."""
        from torchpcct.projector.cpu.pose_kernels import differentiate_readings

        placed, along = self._poses(poses), self._poses(tangents)
        out = np.empty((x.shape[0], len(along), *self.readings), dtype=x.dtype)
        for n in range(x.shape[0]):
            flat = np.ascontiguousarray(x[n]).reshape(-1)
            run(differentiate_readings, self.readings[0], placed, *self._scan, flat, along, out[n])
        return out.reshape(*out.shape[:2], *self._outer())

    def transposed_derivative(self, poses: NDArray, y: NDArray, tangent: NDArray) -> NDArray:
        """Of Aᵀ(poses) y along one ``tangent (views, 4, 3)``."""
        from torchpcct.projector.cpu.pose_kernels import spread_derivatives

        x = np.zeros((y.shape[0], *self.grid.shape), dtype=y.dtype)
        data = np.ascontiguousarray(y).reshape(y.shape[0], *self.readings)
        placed, along = self._poses(poses), self._poses(tangent)
        for n in range(y.shape[0]):
            for axis, blocks in self._blocks:
                run(
                    spread_derivatives,
                    blocks,
                    placed,
                    *self._scan,
                    along,
                    SLAB_BLOCK,
                    data[n],
                    axis,
                    x[n].reshape(-1),
                )
        return x


class VectorPasses:
    """Forward and adjoint passes of a scan given by vectors on arrays with one leading batch
    axis."""

    def __init__(self, tables: VectorTables) -> None:
        g = tables.geometry
        self._poses = g.poses
        self._passes = PosePasses(tables.grid, (g.views, g.rows or 1, g.columns), g.parallel)

    def forward(self, x: NDArray) -> NDArray:
        return self._passes.forward(self._poses, x)

    def adjoint(self, y: NDArray) -> NDArray:
        return self._passes.adjoint(self._poses, y)

    def workspace(self, batch: int, itemsize: int) -> int:
        """Bytes held besides input and output."""
        return 8 * 12 * len(self._poses)
