"""CUDA passes: tables on the device, Triton kernels, and the check against the CPU before they are used."""

from __future__ import annotations

import importlib.util
import math
import warnings
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

if TYPE_CHECKING:
    from torchpcct.projector.cpu.engine import Engine

__all__ = ["GpuPasses", "agrees", "available", "workspace"]

_TOLERANCE = {torch.float32: 1e-4, torch.float64: 1e-10}
_CHECKED: dict[tuple[str, torch.dtype], bool] = {}


def available() -> bool:
    """True if Triton is installed."""
    return importlib.util.find_spec("triton") is not None


def cell_table(engine: Engine) -> tuple[np.ndarray, np.ndarray]:
    """Per view and column ``p0, q0, p1, q1, l0, l1, path, square`` (see ``volume_kernels``) and the main axis."""
    rays, lattice = engine.rays, engine.lattice
    axes = np.zeros((rays.views, rays.columns), dtype=np.int32)
    for v, axis, start, count in engine.segments.table:
        axes[v, start : start + count] = axis
    table = np.empty((rays.views, rays.columns, 8))
    columns = np.arange(rays.columns)
    for v in range(rays.views):
        axis = axes[v]
        own, other = np.where(axis == 0, 1, 0), np.where(axis == 0, 0, 1)  # coordinate across and along the slabs
        slab0, pitch = np.where(axis == 0, lattice[0], lattice[4]), np.where(axis == 0, lattice[1], lattice[5])
        edge0, step = np.where(axis == 0, lattice[2], lattice[6]), np.where(axis == 0, lattice[3], lattice[7])
        for position, entries in ((0, rays.edges), (2, rays.edges[1:]), (4, rays.centers)):
            a, b = entries[rays.first[v] + columns].T
            point = np.broadcast_to(rays.source[v, :2], (rays.columns, 2))
            if rays.parallel:
                point = point + b[:, None] * rays.across[v]
                direction = np.broadcast_to(rays.axial[v], point.shape)
            else:
                direction = a[:, None] * rays.axial[v] + b[:, None] * rays.across[v]
            normal, along = direction[columns, own], direction[columns, other]
            if position < 4:
                slope = along / normal
                table[v, :, position] = (point[columns, other] - edge0 + (slab0 - point[columns, own]) * slope) / step
                table[v, :, position + 1] = slope * pitch / step
            else:
                square = (direction**2).sum(-1)
                table[v, :, 4] = (slab0 - rays.source[v, own]) / normal
                table[v, :, 5] = pitch / normal
                table[v, :, 6] = pitch * np.sqrt(square) / np.abs(normal)
                table[v, :, 7] = square
    return table, axes


class GpuPasses:
    """Forward and adjoint passes of an engine on one device (any device under the Triton interpreter).

    Args:
        engine: the scan. device: where the tables live and the passes run.
    """

    def __init__(self, engine: Engine, device: torch.device) -> None:
        from torchpcct.projector.cpu import cone_kernels as volume_kernels

        self.engine, self.device = engine, device
        cells, axes = cell_table(engine)
        self.cells, self.axes = torch.as_tensor(cells, device=device), torch.as_tensor(axes, device=device)
        self.pose = torch.as_tensor(engine.rays.pose, device=device)
        self.segments = torch.as_tensor(engine.segments.table, device=device)
        self.plane = engine.grid.ndim == 2
        self.heights = (0.0, 1.0, 0.0, 1.0) if self.plane else engine._heights()
        self.layer = 1.0 if self.plane else engine._layer
        self.limits = (volume_kernels.NEAREST, volume_kernels.MAX_LAYERS_PER_SLAB)

    def _shape(self) -> tuple[int, int, int]:
        nz, ny, nx = (1, *self.engine.grid.shape) if self.plane else self.engine.grid.shape
        return nz, ny, nx

    def _budget(self) -> int | None:
        """Bytes of working memory allowed, None for no limit."""
        if self.engine.memory is None and self.device.type == "cuda":
            return int(torch.cuda.mem_get_info(self.device)[0]) // 2
        return self.engine.memory

    def forward(self, x: Tensor) -> Tensor:
        """``(batch, *domain_shape)`` to ``(batch, *range_shape)``."""
        rays, batch = self.engine.rays, x.shape[0]
        out = x.new_empty((batch, rays.views, rays.rows, rays.columns))
        step = _slice(self.engine, self._budget(), batch, x.element_size())[0]
        for n in range(0, batch, step):
            self._forward_slice(x[n : n + step], out[n : n + step])
        return out.reshape(batch, *self.engine.range_shape)

    def _forward_slice(self, x: Tensor, out: Tensor) -> None:
        from torchpcct.projector.cuda.kernels import project_kernel

        nz, ny, nx = self._shape()
        rays, batch = self.engine.rays, x.shape[0]
        if self.plane:
            lines, knots = x.contiguous(), 1
        else:
            knots = nz + 1
            lines = x.new_zeros((batch, ny, nx, knots))
            torch.cumsum(x.permute(0, 2, 3, 1), dim=-1, out=lines[..., 1:])
        block = 1 if self.plane else min(64, _power_of_two(rays.rows))
        project_kernel[(rays.views * rays.columns, math.ceil(rays.rows / block), batch)](
            lines, out, self.cells, self.pose, self.axes, ny, nx, knots, knots - 1, rays.views, rays.rows,
            rays.columns, *self.heights, self.layer, *self.limits, self.plane, rays.parallel, block,
        )  # fmt: skip

    def adjoint(self, y: Tensor) -> Tensor:
        """``(batch, *range_shape)`` to ``(batch, *domain_shape)``."""
        batch = y.shape[0]
        out = y.new_empty((batch, *self.engine.domain_shape))
        step, views = _slice(self.engine, self._budget(), batch, y.element_size())
        for n in range(0, batch, step):
            out[n : n + step] = self._adjoint_slice(y[n : n + step], views)
        return out

    def _adjoint_slice(self, y: Tensor, views: int) -> Tensor:
        """The whole sum, ``views`` at a time: each voxel's sum goes on where the views before left it."""
        from torchpcct.projector.cuda.kernels import backproject_kernel

        nz, ny, nx = self._shape()
        rays, batch, start = self.engine.rays, y.shape[0], self.engine.segments.start
        along, block = (min(64, _power_of_two(max(nx, ny))), 1) if self.plane else (1, min(64, _power_of_two(nz)))
        parts = [y.new_zeros((batch, ny, nx, nz)), y.new_zeros((batch, nx, ny, nz))]
        for begin in range(0, rays.views, views):
            stop = min(begin + views, rays.views)
            part = y[:, begin:stop]
            if self.plane:
                sums = part.contiguous()
            else:
                sums = y.new_zeros((batch, stop - begin, rays.columns, rays.rows + 1))
                slanted = (part * self._slant(y.dtype, begin, stop)).transpose(-1, -2)
                torch.cumsum(slanted, dim=-1, out=sums[..., 1:])
            segments = self.segments[start[begin] : start[stop]]
            for axis, (slabs, width) in enumerate(((ny, nx), (nx, ny))):
                backproject_kernel[(slabs * math.ceil(width / along), math.ceil(nz / block), batch)](
                    sums, parts[axis], self.cells, self.pose, segments, len(segments), axis, slabs, width, nz,
                    begin, stop - begin, rays.rows, rays.columns, *self.heights, self.layer, *self.limits,
                    self.plane, rays.parallel, rays.columns.bit_length() + 1, along, block,
                )  # fmt: skip
        total = parts[0].add_(parts[1].transpose(1, 2))
        return total[..., 0] if self.plane else total.permute(0, 3, 1, 2)

    def _slant(self, dtype: torch.dtype, begin: int, stop: int) -> Tensor:
        _, _, row0, pitch = self.heights
        rows = torch.arange(self.engine.rays.rows, device=self.device, dtype=torch.float64)
        pose = self.pose[begin:stop]
        rise = row0 + (rows + 0.5) * pitch + (pose[:, 7] - pose[:, 2])[:, None]
        return torch.sqrt(1.0 + rise[:, :, None] ** 2 / self.cells[begin:stop, None, :, 7]).to(dtype)


def _slice_bytes(engine: Engine, itemsize: int) -> tuple[int, int, int]:
    """Working memory per volume: forward; adjoint; adjoint per view (also per view of a whole batch: the slants)."""
    rays, voxels = engine.rays, math.prod(engine.grid.shape)
    readings = rays.rows * rays.columns
    if engine.grid.ndim == 2:
        return itemsize * voxels, 2 * itemsize * voxels, itemsize * readings
    lines = voxels + voxels // engine.grid.shape[0]
    # Running sums and a copy in their order; two partial volumes; slants, slanted readings, a copy, running sums.
    return (
        itemsize * (lines + voxels),
        2 * itemsize * voxels,
        itemsize * (3 * readings + 2 * rays.columns) + 24 * readings,
    )


def _tables(engine: Engine) -> int:
    rays = engine.rays
    return rays.views * (68 * rays.columns + 64) + 32 * len(engine.segments.table)


def _slice(engine: Engine, budget: int | None, batch: int, itemsize: int) -> tuple[int, int]:
    """Volumes per launch and, for the adjoint, views at a time, so that the working memory stays within the budget.

    Raises:
        ValueError: ``Projector``'s ``memory`` is less than one volume and one view need.
    """
    views = engine.rays.views
    if budget is None:
        return batch, views
    forward, adjoint, per_view = _slice_bytes(engine, itemsize)
    room = budget - _tables(engine)
    volumes = min(batch, room // max(forward, adjoint + views * per_view))
    if volumes >= 1:
        return volumes, views
    least = max(forward, adjoint + per_view)
    if room < least and engine.memory is not None:
        raise ValueError(
            f"a pass of this scan needs {least + _tables(engine)} bytes of working memory at least, memory allows "
            f"{engine.memory}: raise it, or use fewer voxels or float32"
        )
    return 1, max(1, min(views, (room - adjoint) // per_view))


def workspace(engine: Engine, batch: int, itemsize: int) -> int:
    """Bytes that one pass on a CUDA device holds besides input and output, within the engine's limit if it has one."""
    volumes, views = _slice(engine, engine.memory, batch, itemsize)
    forward, adjoint, per_view = _slice_bytes(engine, itemsize)
    return _tables(engine) + volumes * max(forward, adjoint + views * per_view)


def _power_of_two(n: int) -> int:
    return 1 << max(0, (n - 1).bit_length())


def agrees(engine: Engine, device: torch.device, dtype: torch.dtype) -> bool:
    """True if the device's kernels reproduce the CPU's on random data of this engine, both ways; warns if not."""
    generator = torch.Generator().manual_seed(0)
    passes: Any = GpuPasses(engine, device)
    for here, there, shape in (
        (passes.forward, engine.forward, engine.domain_shape),
        (passes.adjoint, engine.adjoint, engine.range_shape),
    ):
        given = torch.randn((1, *shape), generator=generator, dtype=dtype)
        expect = torch.from_numpy(np.ascontiguousarray(there(given.numpy())))
        found = here(given.to(device)).cpu()
        error = float((found - expect).norm() / expect.norm().clamp_min(torch.finfo(dtype).tiny))
        if not error <= _TOLERANCE[dtype]:
            warnings.warn(
                f"the Triton projector on {device} differs from the CPU's by {error:.1e} (allowed "
                f"{_TOLERANCE[dtype]:.0e}); the CPU's is used instead. Check the installed triton version.",
                RuntimeWarning,
                stacklevel=2,
            )
            return False
    return True


def trusted(engine: Engine, device: torch.device, dtype: torch.dtype) -> bool:
    """:func:`agrees`, checked once per device, dtype and kind of scan, on a scan of a few views and voxels."""
    from torchpcct.geometry import ConeBeam, FanBeam, ParallelBeam, VolumeGrid
    from torchpcct.projector.cpu.engine import Engine as Small

    kind = type(engine.geometry).__name__
    key = (f"{device} {kind}", dtype)
    if key not in _CHECKED:
        angles = [0.1, 1.9, 4.0]
        plane, volume = VolumeGrid((9, 8), 2.0, (1.0, -2.0)), VolumeGrid((5, 7, 6), (1.5, 2.0, 2.2), (0.4, 1.0, -2.0))
        small = {
            "ParallelBeam": lambda: Small(ParallelBeam(angles, 15, 1.9), plane, None),
            "FanBeam": lambda: Small(FanBeam(angles, 60.0, 110.0, 21, 2.1), plane, None),
            "ConeBeam": lambda: Small(ConeBeam(angles, 60.0, 110.0, 14, 9, (1.8, 2.5)), volume, None),
        }[kind]()
        _CHECKED[key] = agrees(small, device, dtype)
    return _CHECKED[key]
