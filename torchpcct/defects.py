"""Readings that cannot be: dead and hot cells, dead columns and views, single lost readings; found, masked, bridged.

A reading of 0 where hundreds are expected has the logarithm of a ray through lead, and FBP draws it as a streak or a
ring of thousands of HU. It cannot be noise: the Poisson probability of 0 at an expectation of 30 is 1e-13. Metal can
darken rays down to 0, but never a single cell between bright ones, and never the same cell in most of the views.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpcct.dead_cells import bridge
from torchpcct.detector_window import DetectorWindow
from torchpcct.robust import MEDIAN_TO_SD
from torchpcct.scan import Scan
from torchpcct.threads import run

__all__ = ["Defects", "find_defects", "mended"]

BRIGHT = 30.0
"""Expected readings from which 0 cannot be noise (probability 1e-13)."""
GAIN_ERROR = 0.1
"""Deviation of a cell's mean log signal from its neighbours' from which its gain is taken as wrong; the calibration in
air of a good detector leaves 0.001."""
_NEIGHBOURS = 4
# Share of single lost readings from which zeros up to three wide are taken for lost, too.
_FREQUENT = 0.01
_SIGMAS = 8.0


@dataclass(frozen=True)
class Defects:
    """Readings that are not those of the object.

    Attributes:
        mask: ``(views, rows, columns)`` bool, True where a reading must not be used.
        dead_cells, hot_cells, dead_views, lost_readings: how many of each were found; lost readings are single ones
            beside the others.
    """

    mask: Tensor
    dead_cells: int
    hot_cells: int
    dead_views: int
    lost_readings: int

    @property
    def text(self) -> str:
        """What was found, one sentence; empty if nothing."""
        parts = (
            (self.dead_cells, "dead detector cells"),
            (self.hot_cells, "cells of a wrong gain"),
            (self.dead_views, "views without signal"),
            (self.lost_readings, "single lost readings"),
        )
        found = ", ".join(f"{n} {what}" for n, what in parts if n)
        share = 100 * float(self.mask.float().mean())
        return f"{found}: {share:.2g} % of the readings were interpolated from their neighbours" if found else ""


def find_defects(counts: Tensor, air: Tensor, first_column: Any = None) -> Defects:
    """Find readings that no object can cause.

    * a view in which 99 % of the readings are 0, while others are not;
    * a detector cell that reads 0 in three quarters of its views, while the cells beside it are bright (more than 30);
    * a cell whose log signal lies above or below the mean of its neighbours by 10 % and eight standard errors more than
      that of the other rows (three or more) does;
    * a single 0 with bright readings on both sides, in its row or the next rows.

    Args:
        counts: ``(views, rows, columns)`` noisy counts.
        air: ``(rows, detector columns)`` expected readings without the object.
        first_column: ``(views,)`` detector column of the first reading of each view (a window); None: 0.

    Raises:
        ValueError: shapes that do not fit.
    """
    if counts.ndim != 3 or air.ndim != 2 or air.shape[0] != counts.shape[1]:
        raise ValueError(
            f"counts must be (views, rows, columns) and air (rows, detector columns), got {tuple(counts.shape)} and "
            f"{tuple(air.shape)}"
        )
    n = counts.detach().cpu().numpy()
    reference = np.log(air.detach().cpu().to(torch.float64).numpy())
    views, rows, columns = n.shape
    first: Any = np.zeros(views, np.int64) if first_column is None else np.asarray(first_column, np.int64)
    if first.shape != (views,) or first.min() < 0 or first.max() + columns > air.shape[1]:
        raise ValueError(f"first_column must hold {views} columns of a detector with {air.shape[1]}")
    zero = n <= 0
    view_dead = zero.mean((1, 2)) > 0.99
    if view_dead.all():
        view_dead[:] = False
    parts = [np.s_[:, c : c + columns] for c in first]
    from torchpcct.defects_kernels import bends, levels  # numba loads with its first use

    alive = np.flatnonzero(~view_dead)
    seen, dark, bright = (np.zeros((rows, air.shape[1])) for _ in range(3))
    run(levels, rows, n, first, alive, seen, dark, bright, operations=3 * alive.size * columns)
    used = seen > 0
    level = bright / np.maximum(seen, 1)
    dead = used & (dark > 0.75 * seen)
    good_level = np.where(dead | ~used, np.nan, level)
    # Of a dead row the neighbours are in other rows.
    dead &= np.fmax(_beside(good_level), _beside(good_level.T).T) > BRIGHT
    # How far a cell's log signal lies above the mean of its neighbours', over the views in which both are good.
    above, times = np.zeros_like(seen), np.zeros_like(seen)
    run(bends, rows, n, first, alive, dead, above, times, operations=20 * alive.size * columns)
    # The air's own share, which no view changes.
    expected = reference[:, 1:-1] - (reference[:, :-2] + reference[:, 2:]) / 2
    above[:, 1:-1] -= np.where(times[:, 1:-1] > 0, times[:, 1:-1] * expected, 0.0)
    hot = np.zeros_like(dead)
    if rows >= 3:
        mean = above / np.maximum(times, 1)
        # The object's edges are seen by all rows alike, the gain of a cell by one.
        deviation = mean - np.median(mean, axis=0)
        some = times > 0.25 * seen.max()
        usual = MEDIAN_TO_SD * np.median(np.abs(deviation[some])) if some.any() else 0.0
        error = np.hypot(np.sqrt(1.5 / np.maximum(level * times, 1.0)), usual)
        hot = some & (np.abs(deviation) > np.maximum(GAIN_ERROR, _SIGMAS * error)) & (level > BRIGHT)
        # The neighbours of a hot cell deviate by half as much, the other way.
        strength = np.pad(np.where(hot, np.abs(deviation), 0.0), ((0, 0), (1, 1)))
        hot &= np.abs(deviation) >= np.maximum(strength[:, :-2], strength[:, 2:])
    mask = np.stack([lost | (dead | hot)[part] for lost, part in zip(view_dead, parts, strict=True)])
    at = np.argwhere(zero) if zero.any() else np.zeros((0, 3), np.int64)
    at = at[~mask[tuple(at.T)]]
    single = _isolated(n, at)
    if len(single) > _FREQUENT * n.size:
        # So many are no accident: neighbours on one side are often lost together.
        single = np.unique(np.concatenate([single, _isolated(n, at, reach=3)]), axis=0)
    mask[tuple(single.T)] = True
    return Defects(
        torch.from_numpy(mask), int(dead.sum()), int(hot.sum()), int(view_dead.sum()), len(single)
    )  # fmt: skip


def _beside(cells: NDArray[np.float64]) -> NDArray[np.float64]:
    """Median of the cells up to four places beside each on the last axis, NaN left out; NaN where there is none."""
    padded = np.pad(cells, ((0, 0), (_NEIGHBOURS, _NEIGHBOURS)), constant_values=np.nan)
    width = cells.shape[1]
    shifts = [padded[:, k : k + width] for k in range(2 * _NEIGHBOURS + 1) if k != _NEIGHBOURS]
    stacked = np.ma.masked_invalid(np.stack(shifts))
    return np.ma.filled(np.ma.median(stacked, axis=0), np.nan)


def _isolated(n: NDArray[Any], at: NDArray[np.int64], reach: int = 1) -> NDArray[np.int64]:
    """Those of the zeros ``at`` ``(k, 3)`` whose non-zero neighbours in the row and the next rows are bright on both
    sides."""
    limits = np.array(n.shape) - 1
    sides = []
    for side in (-1, 1):
        values = []
        for dr, dc in itertools.product((-1, 0, 1), range(1, reach + 1)):
            p = at + np.array([0, dr, dc * side])
            inside = ((p >= 0) & (p <= limits)).all(1)
            q = np.clip(p, 0, limits)
            values.append(np.where(inside, n[q[:, 0], q[:, 1], q[:, 2]], 0.0))
        stacked = np.ma.masked_less_equal(np.stack(values), 0.0)
        sides.append(np.ma.filled(np.ma.median(stacked, axis=0), 0.0))
    return at[(sides[0] > BRIGHT) & (sides[1] > BRIGHT)]


def mended(scan: Scan) -> tuple[Scan, list[str]]:
    """A counting scan whose impossible readings are replaced, and what was done.

    The replacements are expected counts of interpolated line integrals: they are less noisy than the readings that
    they stand for.

    Args:
        scan: a noisy scan in counting mode by a detector with rows; any other is returned as it is.

    Returns:
        The scan (the same object if nothing was found), and one sentence for each finding.
    """
    rows = scan.geometry.has_rows
    if scan.noise_free or scan.logged or not (scan.counting and rows) or scan.counts.ndim != 3:
        return scan, []
    window = scan.window or DetectorWindow.full(scan.geometry)
    kept = scan.air[window.first_row : window.first_row + window.rows]
    found = find_defects(scan.counts, kept, window.first_column)
    if not found.text:
        return scan, []
    air = scan._at_window(scan.air)
    lines = torch.log(air) - torch.log(scan.counts + 0.5)
    replaced = (air * torch.exp(-bridge(lines, found.mask, rows=True, most=1.0)) - 0.5).clamp_min(0.0)
    return replace(scan, counts=torch.where(found.mask, replaced, scan.counts)), [found.text]
