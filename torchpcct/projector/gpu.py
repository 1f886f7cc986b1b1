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
    from torchpcct.projector.engine import Engine

__all__ = ["GpuPasses", "agrees", "available"]

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
        from torchpcct.projector import volume_kernels

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

    def forward(self, x: Tensor) -> Tensor:
        """``(batch, *domain_shape)`` to ``(batch, *range_shape)``."""
        from torchpcct.projector.triton_kernels import project_kernel

        nz, ny, nx = self._shape()
        rays, batch = self.engine.rays, x.shape[0]
        if self.plane:
            lines, knots = x.contiguous(), 1
        else:
            knots = nz + 1
            lines = x.new_zeros((batch, ny, nx, knots))
            torch.cumsum(x.permute(0, 2, 3, 1), dim=-1, out=lines[..., 1:])
        out = x.new_empty((batch, rays.views, rays.rows, rays.columns))
        block = 1 if self.plane else min(64, _power_of_two(rays.rows))
        project_kernel[(rays.views * rays.columns, math.ceil(rays.rows / block), batch)](
            lines, out, self.cells, self.pose, self.axes, ny, nx, knots, knots - 1, rays.views, rays.rows,
            rays.columns, *self.heights, self.layer, *self.limits, self.plane, rays.parallel, block,
        )  # fmt: skip
        return out.reshape(batch, *self.engine.range_shape)

    def adjoint(self, y: Tensor) -> Tensor:
        """``(batch, *range_shape)`` to ``(batch, *domain_shape)``."""
        from torchpcct.projector.triton_kernels import backproject_kernel

        nz, ny, nx = self._shape()
        rays, batch = self.engine.rays, y.shape[0]
        if self.plane:
            sums = y.contiguous()
        else:
            sums = y.new_zeros((batch, rays.views, rays.columns, rays.rows + 1))
            torch.cumsum((y * self._slant(y.dtype)).transpose(-1, -2), dim=-1, out=sums[..., 1:])
        along, block = (min(64, _power_of_two(max(nx, ny))), 1) if self.plane else (1, min(64, _power_of_two(nz)))
        parts = []
        for axis, (slabs, width) in enumerate(((ny, nx), (nx, ny))):
            out = y.new_empty((batch, slabs, width, nz))
            backproject_kernel[(slabs * math.ceil(width / along), math.ceil(nz / block), batch)](
                sums, out, self.cells, self.pose, self.segments, len(self.segments), axis, slabs, width, nz,
                rays.views, rays.rows, rays.columns, *self.heights, self.layer, *self.limits,
                self.plane, rays.parallel, rays.columns.bit_length() + 1, along, block,
            )  # fmt: skip
            parts.append(out)
        total = parts[0] + parts[1].transpose(1, 2)
        return total[..., 0].contiguous() if self.plane else total.permute(0, 3, 1, 2).contiguous()

    def _slant(self, dtype: torch.dtype) -> Tensor:
        _, _, row0, pitch = self.heights
        rows = torch.arange(self.engine.rays.rows, device=self.device, dtype=torch.float64)
        rise = row0 + (rows + 0.5) * pitch + (self.pose[:, 7] - self.pose[:, 2])[:, None]
        return torch.sqrt(1.0 + rise[:, :, None] ** 2 / self.cells[:, None, :, 7]).to(dtype)


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
    from torchpcct.projector.engine import Engine as Small

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
