"""CUDA passes: tables on the device, Triton kernels, slices that fit the memory."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchpcct.projector.tables import MAX_LAYERS_PER_SLAB, NEAREST, Tables

if TYPE_CHECKING:
    from torchpcct.typing import Floats

LANES = 128
"""Columns or voxels of a program of a plane; of a cone beam at most twice as many rows or
slices."""
_STEPS = 2
"""Steps of a segment's look-up table for each of its columns."""


class DevicePasses(ABC):
    """Passes of a scan on one device.

    Attributes:
        device: where the tables live and the passes run.
    """

    device: torch.device

    @abstractmethod
    def forward(self, x: Tensor) -> Tensor:
        """``(batch, *domain_shape)`` to ``(batch, *range_shape)``."""

    @abstractmethod
    def adjoint(self, y: Tensor) -> Tensor:
        """``(batch, *range_shape)`` to ``(batch, *domain_shape)``."""

    def _budget(self) -> int | None:
        """Bytes of working memory allowed, None for no limit."""
        return (
            int(torch.cuda.mem_get_info(self.device)[0]) // 2
            if self.device.type == "cuda"
            else None
        )


class GpuPasses(DevicePasses):
    """Forward and adjoint passes of a scan on one device (any device under the Triton interpreter).

    Args:
        tables: of the scan.
        device: where the tables live and the passes run.
        cells, axes: of all cells, see ``cone_kernels.tabulate_cells``.
    """

    def __init__(
        self,
        tables: Tables,
        device: torch.device,
        cells: object,
        axes: object,
    ) -> None:
        self.tables, self.device = tables, device
        self.plane = tables.grid.ndim == 2
        self.lanes = LANES
        self._cells = np.asarray(cells)
        self.bits = _bits(self._cells, max(tables.grid.shape[-2:]))
        lines = np.rint(self._cells[..., :4] * 2.0**self.bits).astype(np.int64)
        self.lines = torch.from_numpy(lines).to(device)
        self.axes = torch.from_numpy(np.ascontiguousarray(axes)).to(device)
        self.touched = _touched(self._cells, axes, tables)
        self.segments = [_Segments(tables, self._cells, axis, device) for axis in (0, 1)]
        self._numbers: dict[torch.dtype, _Numbers] = {}

    def _of(self, dtype: torch.dtype) -> _Numbers:
        """The tables of numbers in a dtype."""
        if dtype not in self._numbers:
            self._numbers[dtype] = self._made(dtype)
        return self._numbers[dtype]

    def _made(self, dtype: torch.dtype) -> _Numbers:
        nz = self._shape()[0]
        rays, tables = self.tables.rays, self.tables
        z0, dz, row0, pitch = (0.0, 1.0, 0.0, 1.0) if self.plane else tables.heights
        layer = 1.0 if self.plane else tables.layer
        source, foot = tables.pose[:, 2], tables.pose[:, 7]
        low = row0 + foot - source  # lower edge of the first row above the source
        heights = np.stack(
            [
                (source - z0) / dz,
                (low + rays.rows // 2 * pitch) / dz,
                low + (rays.rows // 2 + 0.5) * pitch,
                (z0 + nz // 2 * dz - source) / pitch,
                low / pitch,
            ],
            axis=1,
        )
        numbers = [
            2.0**-self.bits,
            NEAREST,
            layer,
            MAX_LAYERS_PER_SLAB * layer,
            pitch / dz,
            pitch,
            dz / pitch,
        ]

        def sent(values: Floats) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(values)).to(self.device, dtype)

        return _Numbers(
            sent(self._cells[..., 4:]),
            sent(heights),
            sent(np.array(numbers)),
            [sent(part.table) for part in self.segments],
        )

    def _shape(self) -> tuple[int, int, int]:
        nz, ny, nx = (1, *self.tables.grid.shape) if self.plane else self.tables.grid.shape
        return nz, ny, nx

    def forward(self, x: Tensor) -> Tensor:
        """``(batch, *domain_shape)`` to ``(batch, *range_shape)``."""
        rays, batch = self.tables.rays, x.shape[0]
        out = x.new_empty((batch, rays.views, rays.rows, rays.columns))
        step = slices(self.tables, self._budget(), batch, x.element_size())[0]
        for n in range(0, batch, step):
            self._forward_slice(x[n : n + step], out[n : n + step])
        return out.reshape(batch, *self.tables.range_shape)

    def _forward_slice(self, x: Tensor, out: Tensor) -> None:
        from torchpcct.projector.cuda import kernels  # Triton may be missing

        nz, ny, nx = self._shape()
        rays, batch, of = self.tables.rays, x.shape[0], self._of(x.dtype)
        if self.plane:
            images = torch.stack([x.flatten(1), x.transpose(1, 2).flatten(1)], 1)
            block = min(self.lanes, _power_of_two(rays.columns))
            blocks = math.ceil(rays.columns / block)
            kernels.project_plane[(rays.views * blocks, batch)](
                images,
                out,
                self.lines,
                of.depths,
                self.axes,
                of.numbers,
                self.bits,
                self.touched,
                ny,
                nx,
                max(ny, nx),
                rays.views,
                rays.columns,
                blocks,
                PARALLEL=rays.parallel,
                BLOCK=block,
                num_warps=_warps(block, 32),
            )
            return
        sums = x.new_zeros((batch, ny, nx, nz + 1))
        torch.cumsum(x.permute(0, 2, 3, 1), dim=-1, out=sums[..., 1:])
        fours = math.ceil(rays.rows / 4)
        block = _block(fours, max(1, self.lanes // 2))
        kernels.project_cone[(rays.views * rays.columns, math.ceil(fours / block), batch)](
            sums,
            out,
            self.lines,
            of.depths,
            self.axes,
            of.heights,
            of.numbers,
            self.bits,
            ny,
            nx,
            nz + 1,
            nz,
            rays.views,
            rays.rows,
            rays.columns,
            rays.rows // 2,
            BLOCK=block,
            num_warps=_warps(block, 64),
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
        from torchpcct.projector.cuda import kernels  # Triton may be missing

        nz, ny, nx = self._shape()
        rays, batch, of = self.tables.rays, y.shape[0], self._of(y.dtype)
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
            for axis, (slabs, width) in enumerate(((ny, nx), (nx, ny))):
                held, table = self.segments[axis], of.tables[axis]
                first, last = held.between(begin, stop)
                given = (
                    sums,
                    parts[axis],
                    self.lines,
                    of.depths,
                    held.whole[first:last],
                    table[first:last],
                    held.buckets,
                )
                if self.plane:
                    block = min(self.lanes, _power_of_two(width))
                    blocks = math.ceil(width / block)
                    kernels.backproject_plane[(slabs * blocks, batch)](
                        *given,
                        of.numbers,
                        self.bits,
                        last - first,
                        slabs,
                        width,
                        begin,
                        stop - begin,
                        rays.columns,
                        blocks,
                        PARALLEL=rays.parallel,
                        BLOCK=block,
                        num_warps=_warps(block, 32),
                    )
                    continue
                fours = math.ceil(nz / 4)
                block = _block(fours, max(1, self.lanes // 2))
                kernels.backproject_cone[(slabs * width, math.ceil(fours / block), batch)](
                    *given,
                    of.heights,
                    of.numbers,
                    self.bits,
                    last - first,
                    slabs,
                    width,
                    nz,
                    begin,
                    stop - begin,
                    rays.rows,
                    rays.columns,
                    nz // 2,
                    BLOCK=block,
                    num_warps=_warps(block, 64),
                )
        total = parts[0].add_(parts[1].transpose(1, 2))
        return total[..., 0] if self.plane else total.permute(0, 3, 1, 2)

    def _slant(self, dtype: torch.dtype, begin: int, stop: int) -> Tensor:
        """√(1 + rise² / in-plane length²) of every ray, ``(views, rows, columns)``."""
        _, _, row0, pitch = self.tables.heights
        pose, rows = self.tables.pose[begin:stop], np.arange(self.tables.rays.rows)
        rise = row0 + (rows + 0.5) * pitch + (pose[:, 7] - pose[:, 2])[:, None]
        of = self._of(dtype)
        square = torch.from_numpy(rise**2).to(self.device, dtype)[..., None]
        return torch.sqrt(1.0 + square / of.depths[begin:stop, None, :, 3])


class _Numbers(NamedTuple):
    """Tables of numbers on a device in one dtype.

    Attributes:
        depths: ``(views, columns, 4)``: depth ``l0 + l1 r`` of a cell in slab r, path per slab,
            squared in-plane ray length.
        heights: ``(views, 5)``: of the source in voxels above the grid's lower end; of the lower
            edge of the middle row above the source at the depth 1, in voxels; of that row's middle,
            mm; of the lower end of the middle slice above the source, and of the first row's lower
            edge at the depth 1, both in rows.
        numbers: 2⁻ᵇ, the least depth, the spacing of layers, slabs closer than which share them,
            row pitch in voxels, in mm, and slices in row pitches.
        tables: per main axis, see :class:`_Segments`.
    """

    depths: Tensor
    heights: Tensor
    numbers: Tensor
    tables: list[Tensor]


class _Segments:
    """The segments of one main axis, and where in them a voxel finds its columns (see the kernels).

    Attributes:
        whole: ``(segments, 6)`` int32 on the device: view, first column, number of columns
            (negative where keys fall with them), first entry in ``buckets``, number of entries,
            columns that a step of the table holds at most, and two.
        table: ``(segments, 6)``: source's slab (parallel: slope q), its place in the slab, sign of
            the depth's growth with the slabs, least key, steps per key, one over the least width of
            a cell.
        buckets: int32 on the device: of each step the first column, in the order of the keys, that
            ends beyond it.
    """

    def __init__(self, tables: Tables, cells: Floats, axis: int, device: torch.device) -> None:
        whole, table, buckets, begin = [], [], [np.zeros(0, np.int32)], 0
        parallel = tables.rays.parallel
        chosen = tables.segments.table[tables.segments.table[:, 1] == axis]
        for view, _, first, count in chosen.tolist():
            lines = cells[view, first : first + count]
            p0, q0, p1, q1, l0, l1 = lines[:, :6].T
            keys = np.append(p0, p1[-1]) if parallel else np.append(q0, q1[-1])
            backward = keys[-1] < keys[0]
            keys = np.ascontiguousarray(keys[::-1]) if backward else keys
            middle = count // 2
            slope, start, sign = q0[middle], 0.0, 1.0
            if not parallel:
                slope, sign = -l0[middle] / l1[middle], math.copysign(1.0, l1[middle])
                start = p0[middle] + q0[middle] * slope
            steps, least = _STEPS * count, float(np.diff(keys).min())
            step = float(keys[-1] - keys[0]) / steps
            found = np.searchsorted(keys[1:], keys[0] + (np.arange(steps) - 0.01) * step, "right")
            buckets.append(np.minimum(found, count - 1).astype(np.int32))
            held = math.ceil(1.02 * step / least) + 2
            whole.append([view, first, -count if backward else count, begin, steps, held])
            table.append([slope, start, sign, keys[0], 1.0 / step, 1.0 / least])
            begin += steps
        self._views = chosen[:, 0]
        self.table = np.array(table).reshape(-1, 6)
        self.whole = torch.from_numpy(np.array(whole, np.int32).reshape(-1, 6)).to(device)
        self.buckets = torch.from_numpy(np.concatenate(buckets)).to(device)

    def between(self, begin: int, stop: int) -> tuple[int, int]:
        """The first segment of the views ``begin … stop - 1``, and the one after their last."""
        first, last = np.searchsorted(self._views, [begin, stop])
        return int(first), int(last)


def _bits(cells: Floats, slabs: int) -> int:
    """Of the whole numbers that places are computed in: as many as the largest leaves room for."""
    p, q = np.abs(cells[..., :4:2]).max(initial=1.0), np.abs(cells[..., 1:4:2]).max(initial=1.0)
    return 61 - math.ceil(math.log2(p + q * slabs + slabs))


def _touched(cells: Floats, axes: object, tables: Tables) -> int:
    """Voxels that a cell of a plane touches in a slab at most."""
    ny, nx = tables.grid.shape[-2:]
    p0, q0, p1, q1, l0, l1 = np.moveaxis(cells[..., :6], -1, 0)
    widest = 0.0
    for slab in (np.zeros_like(p0), np.where(axes == 0, ny, nx) - 1.0):
        wide = np.abs(p1 - p0 + (q1 - q0) * slab)
        seen = np.ones_like(wide, bool) if tables.rays.parallel else l0 + l1 * slab > NEAREST
        widest = max(widest, float(wide[seen].max(initial=0.0)))
    return int(min(math.floor(widest) + 2, max(ny, nx)))


def _slice_bytes(tables: Tables, itemsize: int) -> tuple[int, int, int]:
    """Working memory per volume: forward; adjoint; adjoint per view (also per view of a whole
    batch: the slants)."""
    rays, voxels = tables.rays, math.prod(tables.grid.shape)
    readings = rays.rows * rays.columns
    if tables.grid.ndim == 2:  # the image and a turned copy
        return 2 * itemsize * voxels, 2 * itemsize * voxels, itemsize * readings
    lines = voxels + voxels // tables.grid.shape[0]
    # Running sums and a copy in their order; two partial volumes; slants, slanted readings, a copy,
    # running sums.
    return (
        itemsize * (lines + voxels),
        2 * itemsize * voxels,
        itemsize * (5 * readings + 2 * rays.columns),
    )


def _table_bytes(tables: Tables) -> int:
    """Edges, axis and steps of the look-up of every cell; its depth in both dtypes."""
    rays = tables.rays
    return rays.views * ((36 + 4 * _STEPS + 48) * rays.columns + 120)


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


def _warps(lanes: int, each: int) -> int:
    """Warps of a program whose threads hold ``each / 32`` lanes: more where a thread's own
    arithmetic is shared by all of its lanes."""
    return max(1, min(8, lanes // each))


def _block(lanes: int, most: int) -> int:
    """Lanes of a program: as many as allowed, or half of that where it leaves fewer idle."""
    block = min(most, _power_of_two(lanes))
    half = max(1, block // 2)
    return (
        half if math.ceil(lanes / half) * half < 0.9 * math.ceil(lanes / block) * block else block
    )


def _power_of_two(n: int) -> int:
    return 1 << max(0, (n - 1).bit_length())
