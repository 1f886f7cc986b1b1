"""What the Triton kernels of scans given by vectors know of the detector's cells: computed on the
device in float64, some views at a time, kept in the data's dtype relative to the voxel."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchpcct.projector.tables import LEAST_SLANT, LEAST_SLOPE, MOST_PARTS, VectorTables, along_xyz

if TYPE_CHECKING:
    from torchpcct.typing import Floats


ORDER = np.array([[0, 2, 1], [1, 2, 0], [2, 1, 0]])
"""Of each main axis itself, a and b: 0 x, 1 y, 2 z."""


class Cells(NamedTuple):
    """The cells of some views.

    Attributes:
        lines: ``(4, parts)`` int64: where in its slabs the centre of a cell, or of its part, lies
            along a and b, as ``p + q r`` in 2⁻ᵇ voxels: p and q along a, p and q along b.
        widths: ``(5, parts)``: sides along a and b in voxels at the ray parameter 1, path per slab
            in mm (times the part's share), ray parameter in slab 0 and its growth.
        axes: ``(cells,)`` int32, main axes: 0 x, 1 y, 2 z.
        starts: ``(cells + 1,)`` int32, first part of each cell; empty where all have one.
        most: parts of a cell at most.
    """

    lines: Tensor
    widths: Tensor
    axes: Tensor
    starts: Tensor
    most: int


class Survey(NamedTuple):
    """What is known of all views beforehand, on the CPU.

    Attributes:
        widest: ``(views, 3, 2)`` by main axis, along a and b: the widest cell in voxels, of
            diverging rays for each slab that it is away from the source; -1: no cell has that axis.
        reach: widest of all in the grid, voxels.
        parts: ``(views,)`` int64, parts of all cells of a view.
        split: ``(views, 3)`` int64: parts of a cell at most, along u, along v, and of both.
    """

    widest: Floats
    reach: float
    parts: np.ndarray
    split: np.ndarray


class _Lines(NamedTuple):
    """Of rays in float64: centre along a and b in slab 0 and its growth, sides along a and b, path
    per slab, ray parameter in slab 0 and its growth."""

    pa: Tensor
    qa: Tensor
    pb: Tensor
    qb: Tensor
    wa: Tensor
    wb: Tensor
    path: Tensor
    l0: Tensor
    l1: Tensor


class VectorCells:
    """Tables of the cells of a scan given by vectors.

    Args:
        tables: of the scan.
        device: where they are computed.
    """

    def __init__(self, tables: VectorTables, device: torch.device) -> None:
        g, grid = tables.geometry, tables.grid
        self.parallel, self.device = g.parallel, device
        self.views, self.rows, self.columns = g.views, g.rows or 1, g.columns
        self.shape, spacing, center = along_xyz(grid)
        lower = center - self.shape * spacing / 2
        poses = np.array(g.poses)
        if grid.ndim == 2:
            poses[:, 3] = 0.0  # cells without height read the slice itself
        self._poses = torch.from_numpy(poses).to(device)
        # By main axis, of (main axis, a, b): spacing, lower edge, voxels.
        about = np.concatenate([spacing[ORDER], lower[ORDER], self.shape[ORDER]], axis=1)
        self._about = torch.from_numpy(np.ascontiguousarray(about.T)).to(device)
        self._spacing = spacing.tolist()

    def survey(self, step: int, samples: int | None = None) -> Survey:
        """Look at all cells, ``step`` views at a time; or at ``samples`` rows and columns only."""
        found = []
        for begin in range(0, self.views, step):
            found.append(self._surveyed(begin, min(begin + step, self.views), samples))
        widest, reach, parts, split = (torch.cat(x).cpu().numpy() for x in zip(*found, strict=True))
        return Survey(widest, float(reach.max()), parts, split)

    def _surveyed(self, begin: int, stop: int, samples: int | None) -> tuple[Tensor, ...]:
        views = stop - begin
        poses, i, j = self._whole(begin, stop, samples)
        axis = self._main_axis(poses, i, j)
        pieces = self._pieces(poses, i, j, axis)
        place = torch.arange(views, device=self.device)[:, None, None].expand(axis.shape)
        split = torch.ones((views, 3), dtype=torch.int64, device=self.device)
        parts = torch.full((views,), axis[0].numel(), device=self.device)
        if pieces is not None:
            both = pieces[0] * pieces[1]
            split = torch.stack([n.flatten(1).amax(1) for n in (*pieces, both)], 1)
            parts = both.flatten(1).sum(1)
            _, cell, i, j, counts = self._spread(pieces, i, j)
            axis, place = axis.flatten()[cell], place.flatten()[cell]
            poses = self._poses[begin:stop][place]
        else:
            counts = None
        found = self._lines(poses, i, j, axis, counts)
        size = self._about[6][axis]
        grow = torch.ones_like(found.wa) if self.parallel else found.l1.abs()
        last = found.l0 + found.l1 * (size - 1.0)
        far = (
            torch.ones_like(found.wa)
            if self.parallel
            else torch.maximum(found.l0.abs(), last.abs())
        )
        key = (place * 3 + axis).flatten()
        widest = torch.stack(
            [
                torch.full((views * 3,), -1.0, dtype=torch.float64, device=self.device)
                .scatter_reduce_(0, key, (w * grow).flatten(), "amax")
                .reshape(views, 3)
                for w in (found.wa, found.wb)
            ],
            -1,
        )
        reach = (torch.maximum(found.wa, found.wb) * far).max()[None]
        return widest, reach, parts, split

    def table(
        self, begin: int, stop: int, bits: int, bound: float, survey: Survey, dtype: torch.dtype
    ) -> Cells:
        """The cells of the views ``begin … stop - 1``.

        Args:
            bits: of the whole numbers of places.
            bound: voxels beyond which a ray passes by the grid, wherever it is.
            survey: of all views.
            dtype: of the data.
        """
        poses, i, j = self._whole(begin, stop)
        axis = self._main_axis(poses, i, j)
        axes, counts = axis.flatten().to(torch.int32), None
        starts = torch.zeros(0, dtype=torch.int32, device=self.device)
        most = int(survey.split[begin:stop, 2].max())
        if most > 1:
            pieces = self._pieces(poses, i, j, axis)
            assert pieces is not None
            starts, cell, i, j, counts = self._spread(pieces, i, j)
            axis = axis.flatten()[cell]
            poses = self._poses[begin:stop][cell // (self.rows * self.columns)]
        f = self._lines(poses, i, j, axis, counts)
        lines = torch.empty((4, axis.numel()), dtype=torch.int64, device=self.device)
        for at, value in zip(lines, (f.pa, f.qa, f.pb, f.qb), strict=True):
            at.copy_((value.clamp(-bound, bound) * 2.0**bits).round_().flatten())
        widths = torch.empty((5, axis.numel()), dtype=dtype, device=self.device)
        for at, value in zip(widths, (f.wa, f.wb, f.path, f.l0, f.l1), strict=True):
            at.copy_(value.flatten())
        return Cells(lines, widths, axes, starts.to(torch.int32), most)

    def _whole(
        self, begin: int, stop: int, samples: int | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Poses ``(views, 1, 1, 4, 3)`` and the cells' rows and columns from the detector's
        middle."""

        def along(n: int) -> Tensor:
            at = np.arange(n) if samples is None else np.unique(np.linspace(0, n - 1, samples))
            return torch.from_numpy(at - (n - 1) / 2).to(self.device)

        poses = self._poses[begin:stop, None, None]
        return poses, along(self.rows)[:, None], along(self.columns)[None]

    def _rays(self, poses: Tensor, i: Tensor, j: Tensor) -> tuple[list[Tensor], list[Tensor]]:
        """Origins and directions, x, y, z."""
        source, centre, u, v = (poses[..., k, :].unbind(-1) for k in range(4))
        cell = [centre[k] + j * u[k] + i * v[k] for k in range(3)]
        if self.parallel:
            return cell, [source[k].expand_as(cell[k]) for k in range(3)]
        return [source[k].expand_as(cell[k]) for k in range(3)], [
            cell[k] - source[k] for k in range(3)
        ]

    def _main_axis(self, poses: Tensor, i: Tensor, j: Tensor) -> Tensor:
        """int64, of the whole cells: ``cpu.vector_kernels.main_axis``."""
        direction = self._rays(poses, i, j)[1]
        steps = [d.abs() / s for d, s in zip(direction, self._spacing, strict=True)]
        axis, most = torch.ones_like(steps[1], dtype=torch.int64), steps[1]
        for k in (0, 2):
            more = steps[k] > most * (1 + 1e-9)
            axis, most = torch.where(more, k, axis), torch.where(more, steps[k], most)
        return axis

    def _pieces(
        self, poses: Tensor, i: Tensor, j: Tensor, axis: Tensor
    ) -> tuple[Tensor, Tensor] | None:
        """Parts of whole cells along u and v: ``cpu.vector_kernels.cell_parts``; None: all 1."""
        origin, direction = (_by_axis(x, axis) for x in self._rays(poses, i, j))
        u, v = (_by_axis(poses[..., k, :].unbind(-1), axis) for k in (2, 3))
        sm, sa, sb, lower, _, _, size, _, _ = (x[axis] for x in self._about)
        d = direction[0]
        scale = torch.ones_like(d)
        if not self.parallel:
            scale = ((lower + size * sm / 2 - origin[0]) / d).clamp_(0.0, 1.0)
        ua, ub, va, vb = (
            (step[k] - direction[k] * (step[0] / d)) / s * scale
            for step in (u, v)
            for k, s in ((1, sa), (2, sb))
        )

        def too_slanted(pa: Tensor, pb: Tensor, qa: Tensor, qb: Tensor) -> Tensor:
            least = LEAST_SLOPE * torch.sqrt((pa * pa + qa * qa) * (pb * pb + qb * qb))
            return (pa * pb + qa * qb).abs() > least.clamp_min_(LEAST_SLANT)

        found = too_slanted(ua, ub, va, vb)
        if not found.any():
            return None
        ua, ub, va, vb = (x[found] for x in (ua, ub, va, vb))
        along_u, along_v = torch.ones_like(ua), torch.ones_like(ua)
        while True:
            pa, pb, qa, qb = ua / along_u, ub / along_u, va / along_v, vb / along_v
            more = too_slanted(pa, pb, qa, qb)
            more &= torch.maximum(along_u, along_v) < MOST_PARTS
            if not more.any():
                break
            longer = (pa * pb).abs() >= (qa * qb).abs()
            along_u += more & longer
            along_v += more & ~longer
        counts = torch.ones_like(axis), torch.ones_like(axis)
        for n, own in zip(counts, (along_u, along_v), strict=True):
            n[found] = own.to(n.dtype)
        return counts

    @staticmethod
    def _spread(
        pieces: tuple[Tensor, Tensor], i: Tensor, j: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, tuple[Tensor, Tensor]]:
        """Of all parts: the first one of each cell, their cells, their rows and columns, and into
        how many parts along u and v their cells are cut."""
        shape = pieces[0].shape
        along_u, along_v = (n.flatten() for n in pieces)
        ends = torch.cumsum(along_u * along_v, 0)
        starts = torch.cat([ends.new_zeros(1), ends])
        cell = torch.repeat_interleave(along_u * along_v)
        along_u, along_v = along_u[cell], along_v[cell]
        own = torch.arange(cell.numel(), device=cell.device) - starts[cell]
        # Whole numbers and a number that is no tensor would make float32.
        half = torch.full((), 0.5, dtype=i.dtype, device=cell.device)
        i, j = i.expand(shape).flatten()[cell], j.expand(shape).flatten()[cell]
        i = i + ((own // along_u + half) / along_v - half)
        j = j + ((own % along_u + half) / along_u - half)
        return starts, cell, i, j, (along_u, along_v)

    def _lines(
        self,
        poses: Tensor,
        i: Tensor,
        j: Tensor,
        axis: Tensor,
        counts: tuple[Tensor, Tensor] | None,
    ) -> _Lines:
        """``cpu.vector_kernels._cell``, as far as it does not depend on the slab."""
        origin, direction = self._rays(poses, i, j)
        length = torch.sqrt(direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2)
        (om, oa, ob), (d, da, db) = _by_axis(origin, axis), _by_axis(direction, axis)
        u, v = (_by_axis(poses[..., k, :].unbind(-1), axis) for k in (2, 3))
        sm, sa, sb, lm, la, lb, _, _, _ = (x[axis] for x in self._about)
        path = sm * length / d.abs()
        if counts is not None:
            u, v = [x / counts[0] for x in u], [x / counts[1] for x in v]
            path = path / (counts[0] * counts[1])
        along_u, along_v = u[0] / d, v[0] / d
        l0, l1 = (lm + 0.5 * sm - om) / d, sm / d
        return _Lines(
            (oa + l0 * da - la) / sa,
            l1 * da / sa,
            (ob + l0 * db - lb) / sb,
            l1 * db / sb,
            torch.hypot(u[1] - da * along_u, v[1] - da * along_v) / sa,
            torch.hypot(u[2] - db * along_u, v[2] - db * along_v) / sb,
            path,
            l0,
            l1,
        )


def _by_axis(xyz: Sequence[Tensor], axis: Tensor) -> list[Tensor]:
    """Components along the main axis, a and b: z, y of rays along x; z, x of rays along y; y, x of
    rays along z."""
    x, y, z = xyz
    along_x, along_z = axis == 0, axis == 2
    return [
        torch.where(along_x, x, torch.where(along_z, z, y)),
        torch.where(along_z, y, z),
        torch.where(along_x, y, x),
    ]


def bits_of(bound: float) -> int:
    """Of the whole numbers that places up to ``bound`` voxels are computed in."""
    return 61 - math.ceil(math.log2(bound))
