"""CUDA passes of scans given by vectors: cells tabulated on the device, some views at a time,
Triton kernels, slices that fit the memory."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from torchpcct.projector.cuda.passes import LANES, DevicePasses
from torchpcct.projector.cuda.vector_cells import ORDER, VectorCells, bits_of
from torchpcct.projector.tables import NEAREST, POINT, VectorTables, along_xyz

if TYPE_CHECKING:
    from torchpcct.typing import Floats

_CELL_BYTES = 420
"""Working memory of a cell while it is tabulated, at most: its table, and what that is made of, in
float64; of cells in several parts, that of each part."""
_TABLE_BYTES = 1 << 30
"""Of the views that are tabulated at a time, where the memory allows: more would not be faster."""
_MARGIN = 1e-3
"""Of a cell, of the search for a voxel's cells, beside what rounding asks for."""
_WIDER = 1.001
"""The same of the widest cell of a view."""
_ROUNDING = 32
"""Of numbers that are sums of a few: at most so many units of their last place."""


class GpuVectorPasses(DevicePasses):
    """Forward and adjoint passes of a scan given by vectors on one device (any device under the
    Triton interpreter).

    Args:
        tables: of the scan.
        device: where the passes run.
    """

    def __init__(self, tables: VectorTables, device: torch.device) -> None:
        self.tables, self.device = tables, device
        self.cells = VectorCells(tables, device)
        self.plane, self.parallel = tables.grid.ndim == 2, tables.geometry.parallel
        self.lanes = LANES
        shape = self.cells.shape
        step = max(1, _table_limit(self._budget()) // (_CELL_BYTES * self._readings))
        self.survey = self.cells.survey(step)
        # A ray moves by a voxel a slab at most: what is further away passes by.
        self.bound = 2.0 * int(shape.max()) + self.survey.reach + 8.0
        self.bits = bits_of(self.bound + int(shape.max()))
        self._entries = np.argwhere(self.survey.widest[..., 0] >= 0)
        self.entries = torch.from_numpy(self._entries.astype(np.int32, order="C")).to(device)
        self._sent: dict[torch.dtype, tuple[Tensor, Tensor]] = {}

    @property
    def _readings(self) -> int:
        return self.cells.rows * self.cells.columns

    def _of(self, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        """Numbers and projections in a dtype."""
        if dtype not in self._sent:
            cells = self.cells
            numbers = [
                2.0**-self.bits,
                NEAREST,
                POINT,
                cells.rows - 1.0,
                cells.columns - 1.0,
                *((cells.shape - 1) / 2).tolist(),
            ]
            made = np.array(numbers), self._projections(float(torch.finfo(dtype).eps))
            sent = [torch.from_numpy(x).to(self.device, dtype) for x in made]
            self._sent[dtype] = sent[0], sent[1]
        return self._sent[dtype]

    def _projections(self, eps: float) -> Floats:
        """``(entries, 20)``: where a view sees a place from the grid's middle, in voxels along its
        main axis, a and b.

        Column, row and depth, four numbers each: of the middle, and their growth; of diverging rays
        column and row times the depth, which is 0 at the source and 1 on the detector. Then the
        widest cell along a and b, see :class:`Survey`; the source's slab; what rounding does to the
        three; margins in columns and rows.
        """
        cells = self.cells
        _, spacing, center = along_xyz(self.tables.grid)
        out = np.zeros((len(self._entries), 20))
        for at, (view, axis) in enumerate(self._entries):
            source, detector, u, v = self.tables.geometry.poses[view]
            ray, origin = (source, detector) if self.parallel else (detector - source, source)
            inverse = np.linalg.inv(np.stack([u, v, ray], 1))
            found = np.concatenate([(inverse @ (center - origin))[:, None], inverse * spacing], 1)
            if self.parallel:
                found[2] = 1.0, 0.0, 0.0, 0.0
            for k, cells_along in enumerate((cells.columns, cells.rows)):
                found[k] += (cells_along - 1) / 2 * found[2]
            found = found[:, [0, *(1 + ORDER[axis])]]
            if self.plane:
                found[:, 2] = 0.0
            reach = np.array([1.0, *((cells.shape[ORDER[axis]] + 1) / 2)])
            size = np.abs(found) @ reach
            size[:2] += size[2] * (np.array([cells.columns, cells.rows]) + 1.0)
            split = self.survey.split[view, :2]
            margin = _MARGIN + np.where(split > 1, 0.5, 0.0)
            widest = _WIDER * self.survey.widest[view, axis]
            slab = (source[axis] - center[axis]) / spacing[axis]
            out[at] = [*found.ravel(), *widest, slab, *(_ROUNDING * eps * size), *margin]
        return out

    def forward(self, x: Tensor) -> Tensor:
        """``(batch, *domain_shape)`` to ``(batch, *range_shape)``."""
        batch, cells = x.shape[0], self.cells
        out = x.new_empty((batch, cells.views * self._readings))
        step = self._volumes(batch, x.element_size())
        for n in range(0, batch, step):
            self._forward_slice(x[n : n + step], out[n : n + step])
        return out.reshape(batch, *self.tables.range_shape)

    def _forward_slice(self, x: Tensor, out: Tensor) -> None:
        from torchpcct.projector.cuda import vector_kernels as kernels  # Triton may be missing

        nx, ny, nz = self.cells.shape.tolist()
        images = torch.stack([x.flatten(1), x.transpose(-1, -2).flatten(1)], 1)
        numbers, _ = self._of(x.dtype)
        for begin, stop in self._chunks():
            table = self.cells.table(begin, stop, self.bits, self.bound, self.survey, x.dtype)
            count = table.axes.numel()
            kernels.project_vectors[(math.ceil(count / self.lanes), len(x))](
                images,
                out,
                table.lines,
                table.widths,
                table.axes,
                table.starts,
                numbers,
                self.bits,
                nx,
                ny,
                nz,
                nx * ny * nz,
                count,
                table.lines.shape[1],
                begin * self._readings,
                out.shape[1],
                PLANE=self.plane,
                PARALLEL=self.parallel,
                PARTS=table.most > 1,
                BLOCK=self.lanes,
                num_warps=max(1, self.lanes // 32),
            )

    def adjoint(self, y: Tensor) -> Tensor:
        """``(batch, *range_shape)`` to ``(batch, *domain_shape)``: each voxel's sum goes on where
        the views before left it."""
        from torchpcct.projector.cuda import vector_kernels as kernels  # Triton may be missing

        batch, cells, data = y.shape[0], self.cells, y.contiguous()
        nx, ny, nz = cells.shape.tolist()
        out = y.new_zeros((batch, *self.tables.domain_shape))
        numbers, projections = self._of(y.dtype)
        for begin, stop in self._chunks():
            table = cells.table(begin, stop, self.bits, self.bound, self.survey, y.dtype)
            first, last = np.searchsorted(self._entries[:, 0], [begin, stop]).tolist()
            kernels.backproject_vectors[(math.ceil(nx * ny * nz / self.lanes), batch)](
                data,
                out,
                table.lines,
                table.widths,
                table.axes,
                table.starts,
                self.entries[first:last],
                projections[first:last],
                numbers,
                self.bits,
                last - first,
                nx,
                ny,
                nz,
                nx * ny * nz,
                table.lines.shape[1],
                begin,
                cells.views,
                cells.rows,
                cells.columns,
                PLANE=self.plane,
                PARALLEL=self.parallel,
                PARTS=table.most > 1,
                BLOCK=self.lanes,
                num_warps=max(1, self.lanes // 32),
            )
        return out

    def _volumes(self, batch: int, itemsize: int) -> int:
        """Volumes whose copies fit beside the tables; at least one."""
        budget = self._budget()
        if budget is None:
            return batch
        room = budget - _table_limit(budget)
        return max(1, min(batch, room // (2 * itemsize * self.tables.grid.voxels)))

    def _chunks(self) -> list[tuple[int, int]]:
        """First view, and the one after the last, of those whose cells are tabulated at a time; at
        least one."""
        limit, begin, used, out = _table_limit(self._budget()), 0, 0, []
        for view, need in enumerate((_CELL_BYTES * self._held()).tolist()):
            if view > begin and used + need > limit:
                out.append((begin, view))
                begin, used = view, 0
            used += need
        return [*out, (begin, self.cells.views)]

    def _held(self) -> np.ndarray:
        """Cells, and parts of those that have several, of each view."""
        parts = self.survey.parts
        return self._readings + np.where(parts > self._readings, parts, 0)


def _table_limit(budget: int | None) -> int:
    """Bytes for the tables of the views that are tabulated at a time."""
    return _TABLE_BYTES if budget is None else min(_TABLE_BYTES, budget // 2)


def workspace(tables: VectorTables, batch: int, itemsize: int) -> int:
    """Bytes that one pass of a whole batch on a CUDA device holds besides input and output."""
    cells = VectorCells(tables, torch.device("cpu"))
    each = cells.rows * cells.columns
    # How long cells are cut changes slowly over a detector.
    parts = cells.survey(cells.views, samples=5).split[:, 2]
    views = _CELL_BYTES * each * np.where(parts > 1, 1 + parts, 1).astype(np.int64)
    held = min(int(views.sum()), max(_TABLE_BYTES, int(views.max())))
    return held + 2 * batch * itemsize * tables.grid.voxels + cells.views * (60 * itemsize + 96)
