"""Impossible readings (dead and hot cells, dead columns and views, lost readings): found, masked,
interpolated.

A reading of 0 where hundreds are expected has the logarithm of a ray through lead, and FBP draws it
as a streak or a ring of thousands of HU. It cannot be noise: the Poisson probability of 0 at an
expectation of 30 is 1e-13. Metal can darken rays down to 0, too, but its footprint has edges: the
cells beside it dim before it reaches them, it walks over the columns from view to view, and it
neither comes nor goes from one view to the next.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpcct.readings import MEDIAN_TO_SD, MOST_DEAD, dispersion, interpolate_dead
from torchpcct.scan import Scan
from torchpcct.threads import run
from torchpcct.validate import shaped

if TYPE_CHECKING:
    from torchpcct.typing import Floats, Ints


__all__ = ["Defects", "dead_readings", "find_defects", "repair_defects"]

BRIGHT = 30.0
"""Expected readings from which 0 cannot be noise (probability 1e-13)."""
GAIN_ERROR = 0.1
"""Deviation of a cell's mean log signal from its neighbours' from which its gain is taken as wrong;
the calibration in air of a good detector leaves 0.001."""
_NEIGHBOURS = 4
"""Cells on either side whose median a cell is compared with."""
_FREQUENT = 0.005
"""Share of single lost readings from which zeros up to three wide are taken for lost, too."""
_NEARLY_LOST = 0.2
"""Share of a bright reading below which no noise of a bright reading comes (six photons of 30: one
in 10⁷)."""
_DETAILS = 0.05
"""Readings that are nearly lost, over those that are, from which both are shadows of details that
are narrower than a cell: what is lost reads 0."""
_MOST_DIM = 200_000
"""Readings that are looked at for it."""
_IN_CACHE = 2**16
"""Readings that are compared at a time."""
_SIGMAS = 8.0
"""Standard errors from which a deviation is none of chance."""
_TOGETHER = 2
"""Most cells of a wrong gain side by side."""
_BENT = 0.25
"""The bend beside such cells, over their error, from which it is an outline."""
_ABOUT = 5
"""Columns to either side in which outlines are looked for."""
_MIRRORED = 0.25
"""What deviates on the other side by that share, up to its inverse, is an outline."""
_LASTING = 3
"""Views from which a cell that reads 0 without a break is dead for part of the turn, and not a
lost reading."""
_WIDTH = 6
"""Most cells side by side that are lost together."""
_DIMMED = 0.1
"""Step of the logarithm of the mean reading over all views, from the second to the first cell
beside a footprint that turns about the axis, on both sides."""
_DIP = 1.0
"""Step of the logarithm from the second to the first cell beside a footprint, on both sides: what
blur and the thin edge of an opaque body leave. A bright detail three cells wide has 0.6."""


@dataclass(frozen=True)
class Defects:
    """Readings that are not those of the object.

    Attributes:
        mask: ``(views, rows, columns)`` bool, True where a reading must not be used.
        dead_cells, hot_cells, dead_views, lost_readings: how many of each were found; lost readings
            are single ones beside the others.
        dead_for_a_while: cells that were dead for part of the views.
    """

    mask: Tensor
    dead_cells: int
    hot_cells: int
    dead_views: int
    lost_readings: int
    dead_for_a_while: int

    @property
    def text(self) -> str:
        """What was found, one sentence; empty if nothing."""
        parts = (
            (self.dead_cells, "dead detector cell", "dead detector cells"),
            (self.hot_cells, "cell of a wrong gain", "cells of a wrong gain"),
            (self.dead_views, "view without signal", "views without signal"),
            (
                self.dead_for_a_while,
                "cell that was dead for part of the views",
                "cells that were dead for part of the views",
            ),
            (self.lost_readings, "single lost reading", "single lost readings"),
        )
        found = ", ".join(f"{n} {one if n == 1 else more}" for n, one, more in parts if n)
        if not found:
            return ""
        share = 100 * int(self.mask.count_nonzero()) / self.mask.numel()
        return f"{found}: {share:.2g} % of the readings were interpolated from their neighbours"


def find_defects(
    counts: Tensor,
    air: Tensor,
    first_column: object = None,
    *,
    known: Tensor | None = None,
    photon: float = 1.0,
    electronic_noise: float = 0.0,
    cells: DefectiveCells | None = None,
) -> Defects:
    """Find readings that no object can cause.

    * a view in which 99 % of the readings are 0, while others are not;
    * a detector cell that reads 0 in (nearly) all of its views, while the cells beside it are
      bright (more than 30 photons) and not dimmed;
    * a cell that reads 0 for some views, alone or with up to five others, between bright cells that
      are not dimmed, and is bright just before and after;
    * a single 0 with bright readings on both sides;
    * a cell whose log signal lies above or below the mean of its neighbours by 10 % and eight
      standard errors more than that of the other rows (three or more) does.

    Args:
        counts: ``(views, rows, columns)`` noisy readings, the dark taken off: 0 or less is no
            signal.
        air: ``(rows, detector columns)`` expected readings without the object.
        first_column: ``(views,)`` detector column of the first reading of each view (a window);
            None: 0.
        known: bool, the shape of ``counts``: readings that are known to be dead, which are not
            found again.
        photon: reading of one photon.
        electronic_noise: standard deviation that the electronics add to a reading.
        cells: of some rows of a detector, what all of them say of these cells and of the views;
            None: found here.

    Raises:
        ValueError: shapes that do not fit.
    """
    if counts.ndim != 3 or air.ndim != 2 or air.shape[0] != counts.shape[1]:
        raise ValueError(
            "counts must be (views, rows, columns) and air (rows, detector columns), got "
            f"{tuple(counts.shape)} and {tuple(air.shape)}"
        )
    n = counts.detach().cpu().numpy()
    views, _, columns = n.shape
    first: Ints = (
        np.zeros(views, np.int64) if first_column is None else np.asarray(first_column, np.int64)
    )
    if first.shape != (views,) or first.min() < 0 or first.max() + columns > air.shape[1]:
        raise ValueError(
            f"first_column must hold {views} columns of a detector with {air.shape[1]}"
        )
    light = BRIGHT * photon + _SIGMAS * electronic_noise
    zeros = _zeros(n)
    if cells is None:
        lost = dark_views(zeros / n[0].size)
        cells = wrong_cells(cell_sums(n, air, first, lost, light), lost, photon, light)
    view_dead, dead, hot = cells
    alive = np.flatnonzero(~view_dead)
    new = None if known is None else ~known.numpy()
    if new is not None:
        fresh = np.zeros_like(dead)
        for c, those in zip(first.tolist(), new, strict=True):
            fresh[:, c : c + columns] |= those
        dead, hot, view_dead = dead & fresh, hot & fresh, view_dead & new.any((1, 2))
    mask, wrong = np.zeros(n.shape, bool), dead | hot
    if wrong.any() or view_dead.any():
        for those, lost, c in zip(mask, view_dead, first.tolist(), strict=True):
            those[...] = lost | wrong[:, c : c + columns]
        if new is not None:
            mask &= new
    at = np.zeros((0, 3), np.int64)
    if zeros.any():
        zero = (n <= 0) & ~mask
        at = np.argwhere(zero if new is None else zero & new)
    # Without the dead views, which nobody is the neighbour of.
    at = at[~view_dead[at[:, 0]]]
    at[:, 0] = np.searchsorted(alive, at[:, 0])
    single, lasting, resting = _unshadowed(n[alive], at, first[alive], air.shape[1], light)
    single[:, 0] = alive[single[:, 0]]
    mask[tuple(single.T)] = True
    return Defects(
        torch.from_numpy(mask),
        int(dead.sum()),
        int(hot.sum()),
        int(view_dead.sum()),
        len(single) - lasting,
        resting,
    )


def _zeros(n: NDArray[np.float32]) -> NDArray[np.int64]:
    """Readings of each view that are 0 or less; some views at a time: what is compared stays in
    the cache."""
    together = max(1, _IN_CACHE // max(n[0].size, 1))
    parts = [n[k : k + together] <= 0 for k in range(0, len(n), together)]
    return np.concatenate([np.count_nonzero(part, axis=(1, 2)) for part in parts])


class DefectiveCells(NamedTuple):
    """Views without signal ``(views,)``, dead cells and cells of a wrong gain ``(rows, detector
    columns)``, bool."""

    views: NDArray[np.bool_]
    dead: NDArray[np.bool_]
    hot: NDArray[np.bool_]


def dark_views(share: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Views without signal, by the share of their readings that is 0."""
    dark: NDArray[np.bool_] = share > 0.99
    return dark & ~dark.all()


def cell_sums(
    n: NDArray[np.float32], air: Tensor, first: Ints, lost: NDArray[np.bool_], light: float
) -> NDArray[np.float64]:
    """What the readings of every cell add up to over the views that have a signal, row by row for
    itself.

    Args:
        n: readings ``(views, rows, columns)``.
        air: ``(rows, detector columns)``.
        first: detector column of the first reading of each view.
        lost: views without signal.
        light: readings from which 0 cannot be noise.

    Returns:
        ``(5, rows, detector columns)``: how often each was read, and 0; the sum of its readings;
        how far its log signal lies above the mean of its neighbours', summed over the views in
        which both are good, and how many those are.
    """
    from torchpcct.checks.defect_kernels import bends, levels  # numba loads with its first use

    first = np.asarray(first)
    rows, alive = n.shape[1], np.flatnonzero(~lost)
    shaped("air", air, (rows, None))
    shaped("first", first, (len(n),))
    shaped("lost", lost, (len(n),))
    if first.size and (first.min() < 0 or first.max() + n.shape[2] > air.shape[1]):
        raise ValueError(
            f"first must be columns of a detector of {air.shape[1]}, {n.shape[2]} of which are read"
        )
    sums = np.zeros((5, *air.shape))
    seen, dark, bright, above, times = sums
    # The same of every row: where windows begin, less where they end.
    ends = [np.bincount(first[alive] + k, minlength=air.shape[1] + 1) for k in (0, n.shape[2])]
    seen[:] = np.cumsum(ends[0] - ends[1])[:-1]
    run(levels, rows, n, first, alive, dark, bright, operations=2 * alive.size * n.shape[2])
    if rows >= 3:
        dead = _dead_cells(sums, light)
        run(
            bends,
            rows,
            n,
            first,
            alive,
            dead,
            above,
            times,
            operations=10 * alive.size * n.shape[2],
        )
        # The air's own share, which no view changes.
        reference = np.log(air.detach().cpu().to(torch.float64).numpy())
        expected = reference[:, 1:-1] - (reference[:, :-2] + reference[:, 2:]) / 2
        above[:, 1:-1] -= np.where(times[:, 1:-1] > 0, times[:, 1:-1] * expected, 0.0)
    return sums


def _dead_cells(sums: NDArray[np.float64], light: float) -> NDArray[np.bool_]:
    """Cells that read 0 in (nearly) all views, beside bright ones that are not dimmed."""
    seen, dark, bright = sums[:3]
    used = seen > 0
    dead: NDArray[np.bool_] = used & (dark > 0.98 * seen)
    if not dead.any():
        return dead
    good_level = np.where(dead | ~used, np.nan, bright / np.maximum(seen, 1))
    # Of a dead row the neighbours are in other rows.
    dead &= np.fmax(_neighbours_median(good_level), _neighbours_median(good_level.T).T) > light
    along = _dimmed(good_level, dead)
    dead &= ~np.where(
        np.isnan(along), np.nan_to_num(_dimmed(good_level.T, dead.T).T), along
    ).astype(bool)
    return dead


def wrong_cells(
    sums: NDArray[np.float64], lost: NDArray[np.bool_], photon: float, light: float
) -> DefectiveCells:
    """Cells that are dead or of a wrong gain, by :func:`cell_sums` of all rows; see
    :func:`find_defects`."""
    dead = _dead_cells(sums, light)
    hot = np.zeros_like(dead)
    if sums.shape[1] >= 3:
        seen, _, bright, above, times = sums
        level, mean = bright / np.maximum(seen, 1), above / np.maximum(times, 1)
        # The object's edges are seen by all rows alike, the gain of a cell by one.
        deviation = mean - np.median(mean, axis=0)
        some = times > 0.25 * seen.max()
        usual = MEDIAN_TO_SD * np.median(np.abs(deviation[some])) if some.any() else 0.0
        error = np.hypot(np.sqrt(1.5 * photon / np.maximum(level * times, photon)), usual)
        hot = some & (np.abs(deviation) > np.maximum(GAIN_ERROR, _SIGMAS * error)) & (level > light)
        hot = _alone(deviation, hot, some)
    return DefectiveCells(lost, dead, hot)


def _alone(
    deviation: NDArray[np.float64], found: NDArray[np.bool_], known: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Those cells of a wrong gain that stand out of a smooth row, up to :data:`_TOGETHER` side by
    side.

    The outline of a body that is round about the axis stays on its cells, too, and on others in
    every row: many of the cells about one of its own deviate, and so does one on the other side.
    Gains are gone once their cells are interpolated: those beside them then lie on a line with the
    next. An outline bends the row wherever it is interpolated.

    Args:
        deviation: how far cells lie above the mean of their neighbours in the row.
        found: cells that do by much.
        known: of which that is known.
    """
    columns = deviation.shape[1]
    hot = np.zeros_like(found)
    for r, c in np.argwhere(found):
        about = np.abs(deviation[max(r - 1, 0) : r + 2, max(c - _ABOUT, 0) : c + _ABOUT + 1])
        if np.quantile(about, 0.8) > _BENT * abs(deviation[r, c]):
            continue
        if _mirrored(deviation, r, c):
            continue
        least, start_of, alone = math.inf, 0, 0
        for count in range(1, _TOGETHER + 1):
            bends = np.eye(count) - 0.5 * (np.eye(count, k=1) + np.eye(count, k=-1))
            for start in range(max(c - count + 1, 1), min(c, columns - 1 - count) + 1):
                inside = slice(start, start + count)
                if not known[r, inside].all():
                    continue
                excess = np.linalg.solve(bends, deviation[r, inside])
                size = float(np.abs(excess).min())
                ends = [
                    deviation[r, at] + 0.5 * own
                    for at, own in ((start - 1, excess[0]), (start + count, excess[-1]))
                    if known[r, at]
                ]
                left = max((abs(float(end)) for end in ends), default=math.inf) / max(size, 1e-300)
                # At the detector's border one side has to tell it all.
                if left < min(least, _BENT if len(ends) == 2 else _BENT / 3) and size > GAIN_ERROR:
                    least, start_of, alone = left, start, count
        hot[r, start_of : start_of + alone] = True
    return hot


def _mirrored(deviation: NDArray[np.float64], row: int, column: int) -> bool:
    """Whether a cell deviates about as much on the other side of the axis, or of the plane of the
    source.

    Neither is far from the middle of the detector.
    """
    rows, columns = deviation.shape
    reach, other, above = max(4, columns // 20), columns - 1 - column, rows - 1 - row
    sides = []
    if abs(other - column) > 2 * reach:
        sides.append(deviation[row, max(other - reach, 0) : other + reach + 1])
    beyond = [r for r in (above - 1, above, above + 1) if 0 <= r < rows and r != row]
    sides.append(deviation[beyond, max(column - 1, 0) : column + 2].ravel())
    alike = np.concatenate(sides) / deviation[row, column]
    return bool(((alike > _MIRRORED) & (alike < 1.0 / _MIRRORED)).any())


def _neighbours_median(cells: NDArray[np.float64]) -> NDArray[np.float64]:
    """Median of the cells up to four places beside each on the last axis, NaN left out; NaN
    where there is none."""
    padded = np.pad(cells, ((0, 0), (_NEIGHBOURS, _NEIGHBOURS)), constant_values=np.nan)
    width = cells.shape[1]
    shifts = [padded[:, k : k + width] for k in range(2 * _NEIGHBOURS + 1) if k != _NEIGHBOURS]
    stacked = np.ma.masked_invalid(np.stack(shifts))
    return np.ma.filled(np.ma.median(stacked, axis=0), np.nan)


def _dimmed(level: NDArray[np.float64], dead: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Whether the live cells next to each dead one on the last axis are dimmed on both sides: 1 or
    0, NaN: unknown.

    Args:
        level: mean readings, NaN where there are none.
    """
    found = np.full(level.shape, np.nan)
    for r in np.flatnonzero(dead.any(1)):
        live = np.flatnonzero(~np.isnan(level[r]))
        at = np.flatnonzero(dead[r])
        right = np.searchsorted(live, at)
        known = (right > 1) & (right < live.size - 1)
        at, right = at[known], right[known]
        sides = [
            np.log(np.maximum(level[r, live[far]], 1e-9) / np.maximum(level[r, live[near]], 1e-9))
            for near, far in ((right - 1, right - 2), (right, right + 1))
        ]
        found[r, at] = np.min(sides, axis=0) > _DIMMED
    return found


def _isolated(
    n: NDArray[np.float32],
    at: NDArray[np.int64],
    first: NDArray[np.int64],
    light: float,
    reach: int = 1,
) -> NDArray[np.int64]:
    """Those of the zeros ``at`` ``(k, 3)`` whose non-zero neighbours in the row and the next rows
    are bright on both sides; and not both dim in the neighbouring rows or views: a detail as narrow
    as a cell goes on there."""
    sides = np.stack(
        [_nearest([_around(n, at, side * dc) for dc in range(1, reach + 1)]) for side in (-1, 1)]
    )
    good = (sides > light).all(0) & ~_dim_rows(n, at, light)
    onward = []
    for step in (-1, 1):
        there = np.clip(at[:, 0] + step, 0, len(n) - 1)
        column = first[at[:, 0]] - first[there]
        around = np.nan_to_num(_around(n, at, column, step))
        onward.append(around[len(around) // 2])
    return at[good & ~_dim(np.stack(onward), light)]


def _of_details(
    lost: NDArray[np.int64], n: NDArray[np.float32], first: NDArray[np.int64], light: float
) -> bool:
    """Whether zeros between bright readings are the noise of details that are narrower than a cell.

    Their shadows then also leave a few photons in some readings between bright ones, where
    readings that are lost leave none.
    """
    if not len(lost):
        return False
    at = np.flatnonzero((n > 0.0) & (n <= _NEARLY_LOST * light))
    step = max(1, math.ceil(at.size / _MOST_DIM))
    places = np.stack(np.unravel_index(at[::step], n.shape), 1)
    return step * len(_isolated(n, places, first, light)) > _DETAILS * len(lost)


def _dim_rows(n: NDArray[np.float32], at: NDArray[np.int64], light: float) -> NDArray[np.bool_]:
    """Whether the zeros ``at`` have only dim neighbours in the next rows, as an upright detail
    has."""
    if n.shape[1] == 1:
        return np.zeros(len(at), bool)
    return _dim(_around(n, at, 0)[[0, 2]], light)


def _dim(pair: NDArray[np.float32], light: float) -> NDArray[np.bool_]:
    """Whether there is a reading in ``(2, k)`` pairs, and none that is bright."""
    return np.asarray((pair > 0).any(0) & ~(pair > light).any(0))


def _around(
    n: NDArray[np.float32], at: NDArray[np.int64], column: int | Ints, view: int | Ints = 0
) -> NDArray[np.float32]:
    """The readings ``column`` columns (and ``view`` views) from ``at``, in the same row and the
    next ones: ``(1 | 3, k)``; 0 beyond the detector, NaN beyond the first and the last view."""
    limits = np.array(n.shape) - 1
    values = []
    for dr in (-1, 0, 1) if n.shape[1] > 1 else (0,):
        p = at + np.stack(np.broadcast_arrays(view, dr, column), -1)
        inside = ((p >= 0) & (p <= limits)).all(1)
        q = np.clip(p, 0, limits)
        found = np.where(inside, n[q[:, 0], q[:, 1], q[:, 2]], 0.0)
        values.append(np.where((p[:, 0] < 0) | (p[:, 0] > limits[0]), np.nan, found))
    return np.stack(values)


def _company(
    n: NDArray[np.float32], at: NDArray[np.int64], first: NDArray[np.int64], step: int, apart: int
) -> NDArray[np.bool_]:
    """Whether the view ``step`` from the zeros ``at`` has one within ``apart`` columns, too;
    True beyond the scan."""
    there = np.clip(at[:, 0] + step, 0, len(n) - 1)
    drift = first[at[:, 0]] - first[there]
    found = (at[:, 0] + step < 0) | (at[:, 0] + step >= len(n))
    for d in range(-apart, apart + 1):
        column = at[:, 2] + d + drift
        inside = (column >= 0) & (column < n.shape[2])
        found |= inside & (n[there, at[:, 1], np.clip(column, 0, n.shape[2] - 1)] <= 0)
    return found


def _unshadowed(
    n: NDArray[np.float32],
    at: NDArray[np.int64],
    first: NDArray[np.int64],
    columns: int,
    light: float,
) -> tuple[NDArray[np.int64], int, int]:
    """Those of the zeros ``at`` ``(k, 3)`` that are no footprint; how many of them are of cells
    that were dead for a while, and how many cells those are.

    Args:
        n: of the views that have a signal.
        columns: of the detector.
    """
    if not len(at):
        return at, 0, 0
    # From view to view a footprint moves by so many columns at most.
    moving = math.ceil(math.pi * columns / len(n))
    single = _isolated(n, at, first, light)
    if len(single) > _FREQUENT * n.size:
        # So many are no accident, unless they follow each other: neighbours on one side are often
        # lost together.
        follow = np.mean(
            _company(n, single, first, -1, moving) & _company(n, single, first, 1, moving)
        )
        chance = (1 - (1 - np.mean(n <= 0)) ** (2 * moving + 1)) ** 2
        if follow < chance + 0.25:
            lost = np.unique(
                np.concatenate([single, _isolated(n, at, first, light, reach=3)]), axis=0
            )
            return (at[:0] if _of_details(lost, n, first, light) else lost), 0, 0
    # Cells of the detector, one after the other, each view by view: what follows without a break is
    # one run.
    cell = at[:, 2] + first[at[:, 0]]
    order = np.lexsort((at[:, 0], cell, at[:, 1]))
    at, cell = at[order], cell[order]
    begins = np.ones(len(at), bool)
    begins[1:] = (np.diff(at[:, 1]) != 0) | (np.diff(cell) != 0) | (np.diff(at[:, 0]) != 1)
    starts = np.flatnonzero(begins)
    which = np.cumsum(begins) - 1
    lengths = np.diff(np.append(starts, len(at)))
    reach, near, far = zip(*(_flank(n, at, side) for side in (-1, 1)), strict=True)
    distance = np.stack(reach)
    dip = np.min(
        [np.log(np.maximum(f, 0.5) / np.maximum(v, 0.5)) for f, v in zip(far, near, strict=True)],
        axis=0,
    )

    def share(values: NDArray[np.generic]) -> Floats:
        return np.add.reduceat(values.astype(np.float64), starts) / lengths

    middle = starts + lengths // 2
    lit = (np.minimum(*near) > light) & (distance > 0).all(0)
    # A footprint that walks has its edges in other columns while it stays on a cell.
    still = (distance == distance[:, middle[which]]).all(0)
    narrow = distance[:, middle].sum(0) - 1 <= _WIDTH
    upright = share(_dim_rows(n, at, light)) >= 0.5
    good = narrow & ~upright & (share(lit) >= 0.75) & (share(still) >= 0.75) & (share(dip) <= _DIP)
    # Before and after: as bright as its neighbours then, and no footprint has come from elsewhere
    # and gone elsewhere.
    moved, tested = np.ones(len(starts), bool), np.zeros(len(starts), bool)
    for step, place in ((-1, starts), (1, starts + lengths - 1)):
        p = at[place]
        drift = first[p[:, 0]] - first[np.clip(p[:, 0] + step, 0, len(n) - 1)]
        own, left, right = (
            _nearest([_around(n, p, d + drift, step)])
            for d in (0, -distance[0, middle], distance[1, middle])
        )
        inside = np.isfinite(own)
        lower = np.minimum(np.where(left > 0, left, np.inf), np.where(right > 0, right, np.inf))
        good &= ~inside | (own >= 0.5 * lower)
        moved &= _company(n, p, first, step, _WIDTH + moving)
        tested |= inside
    good &= tested & ~moved
    if _of_details(at[good[which]], n, first, light):
        return at[:0], 0, 0
    lasting = good & (lengths >= _LASTING)
    cells = np.unique(np.stack([at[starts, 1], cell[starts]], 1)[lasting], axis=0)
    return at[good[which]], int(lengths[lasting].sum()), len(cells)


def _nearest(values: list[NDArray[np.float32]]) -> NDArray[np.float32]:
    """The first reading above 0 of the own row, where all are 0 the lowest one above 0 of the
    next rows; 0 where there is none; NaN stays.

    Rows differ where a face of the object lies between them: what the next ones read says little
    of a row that has readings itself.

    Args:
        values: :func:`_around` at one place after the other.
    """
    stacked = np.stack(values)  # (places, rows, k)
    middle = stacked.shape[1] // 2
    live = np.where(stacked > 0, stacked, np.inf)
    found = live.min((0, 1)) if stacked.shape[1] > 1 else np.full(stacked.shape[2], np.inf)
    for own in reversed(live[:, middle]):
        found = np.where(np.isfinite(own), own, found)
    found = np.where(np.isfinite(found), found, 0.0).astype(stacked.dtype)
    return np.where(np.isnan(stacked[0, middle]), np.nan, found)


def _flank(
    n: NDArray[np.float32], at: NDArray[np.int64], side: int
) -> tuple[Ints, Floats, NDArray[np.float32]]:
    """The first reading above 0 in the row on one side of the zeros ``at``: how many columns away
    (0: none near), it, the next."""
    distance = np.zeros(len(at), np.int64)
    near, far = np.zeros(len(at)), np.zeros(len(at))
    for d in range(1, _WIDTH + 3):
        around = _around(n, at, side * d)
        value = around[len(around) // 2]
        first = (distance == 0) & (value > 0)
        second = (distance > 0) & (far == 0) & (value > 0)
        near, far = np.where(first, value, near), np.where(second, value, far)
        distance = np.where(first, d, distance)
    return distance, near, np.where(far > 0, far, near)


def is_repaired(scan: Scan) -> bool:
    """Whether :func:`repair_defects` looks at a scan: at noisy readings of a known noise,
    without energy bins."""
    noisy = not (scan.noise_free or scan.logged)
    return noisy and scan.counts.ndim <= 3 and (scan.quantum is not None or scan.counting)


def photon_and_light(scan: Scan) -> tuple[float, float]:
    """Reading of one photon, and readings from which 0 cannot be noise."""
    photon = 1.0 if scan.quantum is None else float(scan.quantum.median())
    photon = (
        max(photon, dispersion(scan.counts, scan.geometry.has_rows))
        if scan.window is None
        else photon
    )
    return photon, BRIGHT * photon + _SIGMAS * scan.electronic_noise


def repair_defects(
    scan: Scan, cells: DefectiveCells | None = None, photon: float | None = None
) -> tuple[Scan, list[str]]:
    """A scan whose impossible readings are interpolated from their neighbours, and what was done.

    Of a scan without window they are dead from then on (``scan.dead``): they weigh nothing. In
    views of which more is lost than :data:`torchpcct.readings.MOST_DEAD`, and in scans with a
    window, they are replaced by the counts that the interpolated line integrals stand for, which
    are less noisy than those lost.

    Args:
        scan: noisy readings of any geometry, of several slices or one; other scans (noise-free
            ones, line integrals, energy bins) are returned as they are.
        cells, photon: of :func:`find_defects`, where they are known of more rows than these; None:
            found here.

    Returns:
        The scan (the same object if nothing was found), its ``info`` with the number of
        ``dead_readings``; and one sentence for what was found now or at an earlier call.
    """
    g = scan.geometry
    before = list(scan.info.get("repaired", scan.info.get("mended", [])))  # its former name
    if not is_repaired(scan):
        return scan, before
    window, dead = scan.window, scan.dead
    air = (
        scan.air if window is None else scan.air[window.first_row : window.first_row + window.rows]
    )
    options: dict[str, Any] = {
        "photon": photon_and_light(scan)[0] if photon is None else photon,
        "electronic_noise": scan.electronic_noise,
    }
    if g.has_rows:
        first = None if window is None else window.first_column
        found = find_defects(scan.counts, air, first, known=dead, cells=cells, **options)
        mask = found.mask
    else:
        # Slices of a stack need not be neighbours.
        counts, beam = scan.counts.reshape(-1, g.views, 1, g.columns), air.reshape(-1, 1, g.columns)
        known = [None] * len(counts) if dead is None else list(dead.reshape(counts.shape))
        slices = [
            find_defects(n, a, known=k, **options)
            for n, a, k in zip(counts, beam, known, strict=True)
        ]
        mask = torch.stack([f.mask for f in slices]).reshape(scan.counts.shape)
        found = Defects(
            mask,
            sum(f.dead_cells for f in slices),
            sum(f.hot_cells for f in slices),
            max(f.dead_views for f in slices),
            sum(f.lost_readings for f in slices),
            sum(f.dead_for_a_while for f in slices),
        )
    if not found.text:
        return scan, before
    dead = mask if scan.dead is None else mask | scan.dead
    p = replace(scan, dead=dead)._logarithm()
    # Dead readings stand as 1 in p.
    replaced = p.sub_(interpolate_dead(p, dead, rows=g.has_rows, most=1.0)).exp_()
    replaced.sub_(0.5 * (1.0 if scan.quantum is None else scan.quantum)).clamp_min_(0.0)
    changes: dict[str, Any] = {"counts": torch.where(mask, replaced, scan.counts)}
    if window is None:
        axes = (-2, -1) if g.has_rows else (-1,)
        few = dead.float().mean(axes, keepdim=True) <= MOST_DEAD
        changes["dead"] = (mask & few) | (
            torch.zeros_like(mask) if scan.dead is None else scan.dead
        )
    texts = [*before, found.text]
    return replace(
        scan, **changes, info={**scan.info, "repaired": texts, "dead_readings": int(dead.sum())}
    ), texts


def dead_readings(scan: Scan) -> int:
    """How many readings of a scan are interpolated from their neighbours, after
    :func:`repair_defects`."""
    known = 0 if scan.dead is None else int(scan.dead.sum())
    return max(known, int(scan.info.get("dead_readings", 0)))
