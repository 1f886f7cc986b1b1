"""What the tests of a residual (:mod:`torchpcct.metrics.residual_test`) need of its readings: sums,
in one pass over blocks of views that stay in the processor's cache."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

QUIET = 1.0
"""Square of the steps to neighbouring readings, over the variance of the noise, up to which a
reading is none at an edge: of a step voxels leave a third at most, 0.1 of the variance."""
EDGE = 1.0 / 3.0
"""Part of such a step that voxels leave at most."""
TINY = torch.finfo(torch.float32).tiny
"""What a weight is divided by that is 0."""
_BLOCK = 1 << 17
"""Readings of a block: a few arrays of as many fit the second-level cache."""
_FEWEST_VIEWS = 8
"""Views of a block, at least: those beside it are read, too."""


class Readings(NamedTuple):
    """Some views: weights, residual and fitted lines, ``(views, rows, columns)``; the last two are
    0 where the weight is."""

    w: Tensor
    r: Tensor
    lines: Tensor


class Weighted(NamedTuple):
    """Sums of weights times residuals, and of weights."""

    total: Tensor
    weight: Tensor


@dataclass
class Gains:
    """What is known of the gains of views, or of rows.

    Attributes:
        inner: of readings beside steps from row to row, but for the outermost rows, ``(views,)`` or
            ``(rows,)``.
        of_voxels: sum of their weights times :attr:`Sums.of_voxels`' terms.
        inner_squared: squares of what a gain of each cell, constant over the views, adds to the
            sum of weights.
        beside: of readings beside steps from row to row and beside what looks like the object
            itself, ``(views, columns)`` or ``(rows, columns)``.
        beside_squared: of these the same as ``inner_squared``.
    """

    inner: Weighted
    of_voxels: Tensor
    inner_squared: Tensor
    beside: Weighted
    beside_squared: Tensor


@dataclass
class Sums:
    """All sums, float64.

    Attributes:
        count, chi2: readings of positive weight, and their χ².
        of_voxels: what voxels leave at edges at most, in χ².
        quiet, quiet_chi2: the same of readings without edges, and those of the cells ``(rows,
            columns)``, ``quiet_cells``.
        level, level_cells: of readings beside steps from row to row.
        shift: of a shift of the columns.
        turned: of views that lie beside their angles, ``(views, columns)``.
        views, rows: see :class:`Gains`.
        all_level: whether all readings were taken for such without a step from row to row.
    """

    count: int
    chi2: float
    of_voxels: float
    quiet: int
    quiet_chi2: float
    quiet_cells: Weighted
    level: int
    level_cells: Weighted
    shift: tuple[float, float]
    turned: Weighted
    views: Gains
    rows: Gains
    all_level: bool


def readings(residual: Tensor, weights: Tensor, fitted: Tensor) -> Readings:
    """Readings in their own precision, at least float32.

    Raises:
        ValueError: negative weights; NaN or Inf where the weight is not 0.
    """
    w = weights.to(torch.promote_types(residual.dtype, torch.float32))
    if not bool((w >= 0).all()):
        raise ValueError(WRONG_WEIGHTS)
    r, lines = (torch.where(w > 0, v.to(w.dtype), 0.0) for v in (residual, fitted))
    if not bool(torch.isfinite(r).all() and torch.isfinite(lines).all()):
        raise ValueError("residual and fitted must be finite where the weight is not 0")
    return Readings(w, r, lines)


WRONG_WEIGHTS = "weights must be 0 or more, and some greater than 0: give inverse variances"
"""Message on weights that determine nothing."""


def level_weights(w: Tensor, lines: Tensor) -> Tensor:
    """Weights, 0 at steps from row to row: of a face along the rows voxels leave the same in all
    columns and views, of other steps a part in either direction, noise of its own."""
    return torch.where(w * _steps(lines, 1).square() <= QUIET, w, 0.0)


def sums(
    residual: Tensor,
    weights: Tensor,
    fitted: Tensor,
    *,
    all_quiet: bool = False,
    all_level: bool = False,
) -> Sums:
    """Sums over ``(views, rows, columns)``.

    Args:
        residual, weights, fitted: of :func:`torchpcct.metrics.residual_test.residual_test`.
        all_quiet: take all readings for such without edges.
        all_level: take all for such without a step from row to row.

    Raises:
        ValueError: see :func:`readings`; all weights are 0.
    """
    views, rows, columns = residual.shape
    size = max(_FEWEST_VIEWS, _BLOCK // max(rows * columns, 1))
    found = _Collected(views, rows, columns)
    for first in range(0, views, size):
        end = min(first + size, views)
        low, high = max(first - 1, 0), min(end + 1, views)
        block = readings(residual[low:high], weights[low:high], fitted[low:high])
        found.add(block, slice(first, end), low, all_quiet, all_level)
    if found.count == 0:
        raise ValueError(WRONG_WEIGHTS)
    return found.sums(all_level)


class _Collected:
    """Sums while they are collected, block by block."""

    def __init__(self, views: int, rows: int, columns: int) -> None:
        def zeros(*shape: int) -> Tensor:
            return torch.zeros(shape, dtype=torch.float64)

        self.count = self.quiet = self.level = 0
        self.values = zeros(5)
        self.quiet_cells, self.level_cells, self.beside_rows, self.turned, self.beside_views = (
            Weighted(zeros(n, columns), zeros(n, columns)) for n in (rows, rows, rows, views, views)
        )
        self.inner_views = Weighted(zeros(views), zeros(views))
        self.voxels_of_views, self.voxels_of_rows = zeros(views), zeros(rows)
        self.squared_inner, self.squared_beside = zeros(views), zeros(views)

    def add(self, block: Readings, own: slice, low: int, all_quiet: bool, all_level: bool) -> None:
        """Add the views ``own`` of a block that begins at the view ``low``, neighbours included."""
        here = slice(own.start - low, own.stop - low)
        w, r, lines = (v[here] for v in block)
        wr = w * r
        squares = torch.maximum(_steps(block.lines, 0)[here], _steps(lines, 2))
        squares = w * torch.maximum(squares, _steps(lines, 1)).square()
        self.count += int(w.count_nonzero())

        calm = w
        if not all_quiet:
            calm = torch.where(squares <= QUIET, w, 0.0)
            # Whether the object ends beyond the outermost rows, or just within them, no reading
            # says.
            for row in (0, -1) if w.shape[1] > 1 else ():
                calm[:, row][w[:, row] * lines[:, row].square() > QUIET] = 0.0
        self.quiet += int(calm.count_nonzero())
        calm_r = calm * r
        _add(self.quiet_cells, calm_r.sum(0), calm.sum(0))

        step = (lines[..., 2:] - lines[..., :-2]) / 2.0
        inside = w[..., 1:-1] * step
        self.values += torch.stack(
            [
                (wr * r).sum(),
                squares.sum() * EDGE**2,
                (calm_r * r).sum(),
                (inside * r[..., 1:-1]).sum(),
                (inside * step).sum(),
            ]
        ).double()

        # A view at another angle differs by a part of what neighbouring views do.
        step = (block.lines[2:] - block.lines[:-2]) / 2.0
        inside = block.w[1:-1] * step
        turned = Weighted(*(v[low + 1 : low + 1 + len(step)] for v in self.turned))
        _add(turned, (inside * block.r[1:-1]).sum(1), (inside * step).sum(1))
        self._add_gains(w if all_level else level_weights(w, lines), r, lines, squares, own)

    def _add_gains(self, w: Tensor, r: Tensor, lines: Tensor, squares: Tensor, own: slice) -> None:
        """Add what tells gains of views and rows; ``squares`` are those of the steps to
        neighbours, times the weights."""
        wr = w * r
        self.level += int(w.count_nonzero())
        _add(self.level_cells, wr.sum(0), w.sum(0))
        outer = w.shape[1] > 1
        inside = slice(1, -1) if outer else slice(None)
        inner, inner_r = w[:, inside], wr[:, inside]
        of_columns = Weighted(inner_r.sum(1), inner.sum(1))
        of_voxels = (inner * squares[:, inside]).sum(2).double() * EDGE**2
        squared = inner.square().sum((1, 2)).double()
        _add(Weighted(*(v[own] for v in self.inner_views)), *(v.sum(1) for v in of_columns))
        self.voxels_of_views[own] += of_voxels.sum(1)
        self.voxels_of_rows[inside] += of_voxels.sum(0)
        self.squared_inner[own] += squared
        self.squared_beside[own] += squared
        beside = Weighted(*(v[own] for v in self.beside_views))
        _add(beside, *of_columns)
        if not outer:
            _add(self.beside_rows, wr.sum(0), w.sum(0))
            return
        seen, left = _beside_object(w, r, lines)
        _add(self.beside_rows, left.sum(0), seen.sum(0))
        # Of views the inner rows are taken as they are.
        for row in (0, -1):
            _add(beside, left[:, row], seen[:, row])
            self.squared_beside[own] += seen[:, row].square().sum(1).double()

    def sums(self, all_level: bool) -> Sums:
        chi2, of_voxels, quiet_chi2, *shift = self.values.tolist()
        rows = len(self.level_cells.weight)
        inner = Weighted(*(v.clone() for v in self.level_cells))
        for values in inner if rows > 1 else ():
            values[[0, -1]] = 0.0
        return Sums(
            self.count,
            chi2,
            of_voxels,
            self.quiet,
            quiet_chi2,
            self.quiet_cells,
            self.level,
            self.level_cells,
            (shift[0], shift[1]),
            self.turned,
            Gains(
                self.inner_views,
                self.voxels_of_views,
                self.squared_inner,
                self.beside_views,
                self.squared_beside,
            ),
            Gains(
                Weighted(*(v.sum(1) for v in inner)),
                self.voxels_of_rows,
                inner.weight.square().sum(1),
                self.beside_rows,
                self.beside_rows.weight.square().sum(1),
            ),
            all_level,
        )


def _add(to: Weighted, total: Tensor, weight: Tensor) -> None:
    to.total.add_(total)
    to.weight.add_(weight)


def _steps(lines: Tensor, axis: int) -> Tensor:
    """The larger difference of each of ``(views, rows, columns)`` to a neighbour along an axis."""
    found = torch.zeros_like(lines)
    step = lines.diff(dim=axis).abs()
    for first in (0, 1):
        part = found.narrow(axis, first, step.shape[axis])
        torch.maximum(part, step, out=part)
    return found


def _beside_object(w: Tensor, r: Tensor, lines: Tensor) -> tuple[Tensor, Tensor]:
    """Weights, and weights times what is left of the residual where each row of each view has a
    part of what looks like the object itself; all ``(views, rows, columns)``.

    Voxels end with a slice, an object within it: as it comes nearer to the source in some views,
    a row sees more of it than of the voxels. In the outermost rows nobody knows where it ends.
    Gain and part of the object are fitted together; of the gain's information a share is left.
    """

    def total(values: Tensor) -> Tensor:
        return (w * values).sum(2, keepdim=True)

    power = total(lines.square()).clamp_min(TINY)
    pattern = 1.0 - lines * (total(lines) / power)
    known = total(pattern.square())
    gain = total(pattern * r) / known.clamp_min(TINY)
    left = r - lines * (total(lines * (r - gain)) / power)
    seen = w * (known / w.sum(2, keepdim=True).clamp_min(TINY))
    return seen, seen * left
