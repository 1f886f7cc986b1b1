"""From arrays to kernels: what one geometry, grid and window need, computed once, and the CPU passes.

numba is imported on first use. Launches are serialised by a lock, since numba's fallback threading layer must not be
entered from two threads at once.
"""

from __future__ import annotations

import threading
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from torchpcct.detector_window import DetectorWindow
from torchpcct.geometry import Geometry, VolumeGrid
from torchpcct.projector.cpu.depth_layers import layer_spacing, running_sums
from torchpcct.projector.cpu.plane_passes import PlanePasses
from torchpcct.projector.rays import (
    Rays,
    Segments,
    check_motion,
    check_pair,
    check_source,
    rays_of,
    slab_lattice,
    split,
)

if TYPE_CHECKING:
    from torchpcct.projector.cuda.passes import GpuPasses

__all__ = ["Engine"]

_LAUNCH = threading.Lock()
# Row sums of the adjoint are made for chunks of views of about this size: large enough to keep all threads busy.
ROW_SUMS_BYTES = 64 << 20


class Engine:
    """Forward and adjoint passes on NumPy arrays with exactly one leading batch axis.

    Args:
        geometry, grid, window, motion, memory: as for ``Projector``.

    Raises:
        TypeError, ValueError: see ``rays.check_pair``, ``rays.check_source`` and ``Projector``.
    """

    def __init__(
        self,
        geometry: Geometry,
        grid: VolumeGrid,
        window: DetectorWindow | None,
        motion: Any = None,
        memory: int | None = None,
    ) -> None:
        check_pair(geometry, grid, window)
        if memory is not None and (isinstance(memory, bool) or not isinstance(memory, int) or memory < 1):
            raise ValueError(f"memory must be a number of bytes ≥ 1 or None, got {memory!r}")
        self.memory = memory
        # Symmetric views share their work only if all of the detector is read and nothing moves.
        self.geometry, self.grid, self.windowed = geometry, grid, window is not None or motion is not None
        self.rays: Rays = rays_of(geometry, window)
        if motion is not None:
            self.rays = self.rays.moved(check_motion(motion, geometry.views, grid.ndim))
        check_source(self.rays, grid)
        self.lattice = slab_lattice(grid.center[-2:], grid.shape[-2:], grid.spacing[-2:])
        self._devices: dict[Any, GpuPasses] = {}

    def on(self, device: Any) -> GpuPasses:
        """The CUDA passes of this engine, with their tables on ``device``."""
        if device not in self._devices:
            from torchpcct.projector.cuda.passes import GpuPasses

            self._devices[device] = GpuPasses(self, device)
        return self._devices[device]

    @property
    def domain_shape(self) -> tuple[int, ...]:
        return tuple(self.grid.shape)

    @property
    def range_shape(self) -> tuple[int, ...]:
        r = self.rays
        return (r.views, r.rows, r.columns) if self.grid.ndim == 3 else (r.views, r.columns)

    @cached_property
    def segments(self) -> Segments:
        return split(self.rays, self.grid)

    @cached_property
    def _poses(self) -> NDArray[np.float64]:
        return self.rays.pose

    def forward(self, x: NDArray) -> NDArray:
        """Line integrals of ``x``, ``(batch, *domain_shape)``, as ``(batch, *range_shape)``."""
        self._check_memory(x)
        with _LAUNCH:
            return self._forward_volume(x) if self.grid.ndim == 3 else self._plane.forward(x)

    def adjoint(self, y: NDArray) -> NDArray:
        """The transpose: ``(batch, *range_shape)`` to ``(batch, *domain_shape)``."""
        self._check_memory(y)
        with _LAUNCH:
            return self._adjoint_volume(y) if self.grid.ndim == 3 else self._plane.adjoint(y)

    def workspace(self, batch: int, itemsize: int) -> int:
        """Bytes that one pass holds besides its input and output (the larger of the two directions)."""
        if self.grid.ndim == 2:
            return self._plane.workspace(batch, itemsize)
        forward, adjoint, per_view = self._volume_bytes(itemsize)
        return max(forward, adjoint + per_view * self._views_at_once(itemsize))

    def _volume_bytes(self, itemsize: int) -> tuple[int, int, int]:
        """Working memory of the passes of one volume (volumes pass one by one): forward, adjoint, adjoint per view."""
        r, table = self.rays, 8 * (8 * self.rays.views + 4 * len(self.segments.table))
        nz, ny, nx = self.grid.shape
        forward = ny * nx * (nz + 16) + r.columns * r.rows * _threads()
        return (
            table + itemsize * forward,
            table + itemsize * 2 * ny * nx * (nz + 8),
            itemsize * r.columns * (r.rows + 1),
        )

    def _views_at_once(self, itemsize: int) -> int:
        """Views whose row sums the adjoint holds at a time."""
        _, rest, per_view = self._volume_bytes(itemsize)
        room = ROW_SUMS_BYTES if self.memory is None else min(ROW_SUMS_BYTES, self.memory - rest)
        return int(max(1, min(self.rays.views, room // per_view)))

    def _check_memory(self, x: NDArray) -> None:
        if self.memory is not None and (need := self.workspace(x.shape[0], x.itemsize)) > self.memory:
            raise ValueError(
                f"a pass of this scan needs {need} bytes of working memory, memory allows {self.memory}: raise it, or "
                "use fewer voxels, fewer columns, float32" + (", or a smaller batch" if self.grid.ndim == 2 else "")
            )

    @cached_property
    def _plane(self) -> PlanePasses:
        return PlanePasses(self.geometry, self.grid, self.rays, self.windowed)

    @cached_property
    def _layer(self) -> float:
        r = self.rays
        _, _, row0, row_pitch = self._heights()
        return layer_spacing(self._poses, self.grid, row0, row_pitch, r.rows)

    def _heights(self) -> tuple[float, float, float, float]:
        z, dz = self.grid.axes[0][0], self.grid.spacing[0]
        return (z - dz / 2, dz, self.rays.row_edge + self.rays.first_row * self.rays.row_pitch, self.rays.row_pitch)

    def _forward_volume(self, x: NDArray) -> NDArray:
        from torchpcct.projector.cpu import cone_kernels as volume_kernels

        r, seg = self.rays, self.segments
        _, ny, nx = self.grid.shape
        y = np.empty((x.shape[0], *self.range_shape), dtype=x.dtype)
        # One volume after the other: each stays in the cache, a batch of them would not.
        for n in range(x.shape[0]):
            volume_kernels.project(
                running_sums(x[n]), ny, nx, self._poses, r.edges, r.centers, r.first,
                seg.table, seg.start, self.lattice, *self._heights(), self._layer, y[n],
            )  # fmt: skip
        return y

    def _adjoint_volume(self, y: NDArray) -> NDArray:
        from torchpcct.projector.cpu import cone_kernels as volume_kernels

        r, seg = self.rays, self.segments
        x = np.empty((y.shape[0], *self.grid.shape), dtype=y.dtype)
        for n in range(y.shape[0]):
            volume_kernels.backproject(
                y[n], self._poses, r.edges, r.centers, r.first, seg.table, seg.start, self.lattice, *self._heights(),
                self._layer, self._views_at_once(y.itemsize), x[n],
            )  # fmt: skip
        return x


def _threads() -> int:
    import numba

    return int(numba.get_num_threads())
