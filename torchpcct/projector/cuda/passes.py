"""CUDA passes: tables on the device, Triton kernels, slices that fit the memory."""

from __future__ import annotations

import importlib.util
import math
from typing import Any

import torch
from torch import Tensor

from torchpcct.projector.tables import Tables


def available() -> bool:
    """True if Triton is installed."""
    return importlib.util.find_spec("triton") is not None


class GpuPasses:
    """Forward and adjoint passes of a scan on one device (any device under the Triton interpreter).

    Args:
        tables: of the scan.
        device: where the tables live and the passes run.
        cells, axes: of all cells, see ``cone_kernels.tabulate_cells``.
        nearest, layers_per_slab: limits of the CPU's cone-beam kernels (``NEAREST``,
            ``MAX_LAYERS_PER_SLAB``).
    """

    def __init__(
        self,
        tables: Tables,
        device: torch.device,
        cells: Any,
        axes: Any,
        nearest: float,
        layers_per_slab: float,
    ) -> None:
        self.tables, self.device = tables, device
        self.cells, self.axes = (
            torch.as_tensor(cells, device=device),
            torch.as_tensor(axes, device=device),
        )
        self.pose = torch.as_tensor(tables.pose, device=device)
        self.segments = torch.as_tensor(tables.segments.table, device=device)
        self.plane = tables.grid.ndim == 2
        self.heights = (0.0, 1.0, 0.0, 1.0) if self.plane else tables.heights
        self.layer = 1.0 if self.plane else tables.layer
        self.limits = (nearest, layers_per_slab)

    def _shape(self) -> tuple[int, int, int]:
        nz, ny, nx = (1, *self.tables.grid.shape) if self.plane else self.tables.grid.shape
        return nz, ny, nx

    def _budget(self) -> int | None:
        """Bytes of working memory allowed, None for no limit."""
        return (
            int(torch.cuda.mem_get_info(self.device)[0]) // 2
            if self.device.type == "cuda"
            else None
        )

    def forward(self, x: Tensor) -> Tensor:
        """``(batch, *domain_shape)`` to ``(batch, *range_shape)``."""
        rays, batch = self.tables.rays, x.shape[0]
        out = x.new_empty((batch, rays.views, rays.rows, rays.columns))
        step = slices(self.tables, self._budget(), batch, x.element_size())[0]
        for n in range(0, batch, step):
            self._forward_slice(x[n : n + step], out[n : n + step])
        return out.reshape(batch, *self.tables.range_shape)

    def _forward_slice(self, x: Tensor, out: Tensor) -> None:
        from torchpcct.projector.cuda.kernels import project_kernel  # Triton may be missing

        nz, ny, nx = self._shape()
        rays, batch = self.tables.rays, x.shape[0]
        if self.plane:
            lines, knots = x.contiguous(), 1
        else:
            knots = nz + 1
            lines = x.new_zeros((batch, ny, nx, knots))
            torch.cumsum(x.permute(0, 2, 3, 1), dim=-1, out=lines[..., 1:])
        block = 1 if self.plane else min(64, _power_of_two(rays.rows))
        project_kernel[(rays.views * rays.columns, math.ceil(rays.rows / block), batch)](
            lines,
            out,
            self.cells,
            self.pose,
            self.axes,
            ny,
            nx,
            knots,
            knots - 1,
            rays.views,
            rays.rows,
            rays.columns,
            *self.heights,
            self.layer,
            *self.limits,
            self.plane,
            rays.parallel,
            block,
        )

    def adjoint(self, y: Tensor) -> Tensor:
        """``(batch, *range_shape)`` to ``(batch, *domain_shape)``."""
        batch = y.shape[0]
        out = y.new_empty((batch, *self.tables.domain_shape))
        step, views = slices(self.tables, self._budget(), batch, y.element_size())
        for n in range(0, batch, step):
            out[n : n + step] = self._adjoint_slice(y[n : n + step], views)
        return out

    def _adjoint_slice(self, y: Tensor, views: int) -> Tensor:
        """The whole sum, ``views`` at a time: each voxel's sum goes on where the views before
        left it."""
        from torchpcct.projector.cuda.kernels import backproject_kernel  # Triton may be missing

        nz, ny, nx = self._shape()
        rays, batch, start = self.tables.rays, y.shape[0], self.tables.segments.start
        along, block = (
            (min(64, _power_of_two(max(nx, ny))), 1)
            if self.plane
            else (1, min(64, _power_of_two(nz)))
        )
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
                backproject_kernel[
                    (slabs * math.ceil(width / along), math.ceil(nz / block), batch)
                ](
                    sums,
                    parts[axis],
                    self.cells,
                    self.pose,
                    segments,
                    len(segments),
                    axis,
                    slabs,
                    width,
                    nz,
                    begin,
                    stop - begin,
                    rays.rows,
                    rays.columns,
                    *self.heights,
                    self.layer,
                    *self.limits,
                    self.plane,
                    rays.parallel,
                    rays.columns.bit_length() + 1,
                    along,
                    block,
                )
        total = parts[0].add_(parts[1].transpose(1, 2))
        return total[..., 0] if self.plane else total.permute(0, 3, 1, 2)

    def _slant(self, dtype: torch.dtype, begin: int, stop: int) -> Tensor:
        _, _, row0, pitch = self.heights
        rows = torch.arange(self.tables.rays.rows, device=self.device, dtype=torch.float64)
        pose = self.pose[begin:stop]
        rise = row0 + (rows + 0.5) * pitch + (pose[:, 7] - pose[:, 2])[:, None]
        return torch.sqrt(1.0 + rise[:, :, None] ** 2 / self.cells[begin:stop, None, :, 7]).to(
            dtype
        )


def _slice_bytes(tables: Tables, itemsize: int) -> tuple[int, int, int]:
    """Working memory per volume: forward; adjoint; adjoint per view (also per view of a whole
    batch: the slants)."""
    rays, voxels = tables.rays, math.prod(tables.grid.shape)
    readings = rays.rows * rays.columns
    if tables.grid.ndim == 2:
        return itemsize * voxels, 2 * itemsize * voxels, itemsize * readings
    lines = voxels + voxels // tables.grid.shape[0]
    # Running sums and a copy in their order; two partial volumes; slants, slanted readings, a copy,
    # running sums.
    return (
        itemsize * (lines + voxels),
        2 * itemsize * voxels,
        itemsize * (3 * readings + 2 * rays.columns) + 24 * readings,
    )


def _table_bytes(tables: Tables) -> int:
    rays = tables.rays
    return rays.views * (68 * rays.columns + 64) + 32 * len(tables.segments.table)


def slices(tables: Tables, budget: int | None, batch: int, itemsize: int) -> tuple[int, int]:
    """Volumes per launch and, for the adjoint, views at a time, so that the working memory stays
    within the budget.

    At least one of each, whatever the budget.
    """
    views = tables.rays.views
    if budget is None:
        return batch, views
    forward, adjoint, per_view = _slice_bytes(tables, itemsize)
    room = budget - _table_bytes(tables)
    volumes = min(batch, room // max(forward, adjoint + views * per_view))
    if volumes >= 1:
        return volumes, views
    return 1, max(1, min(views, (room - adjoint) // per_view))


def workspace(tables: Tables, batch: int, itemsize: int) -> int:
    """Bytes that one pass of a whole batch on a CUDA device holds besides input and output."""
    forward, adjoint, per_view = _slice_bytes(tables, itemsize)
    return _table_bytes(tables) + batch * max(forward, adjoint + tables.rays.views * per_view)


def _power_of_two(n: int) -> int:
    return 1 << max(0, (n - 1).bit_length())
