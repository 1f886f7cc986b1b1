"""Do neighbouring views fit each other? Views in a wrong order, missing, stuck or displaced,
without conjugate rays.

From view to view an object turns by one step. Means of a view under windows that are wide against
the way of a point in one step are smooth functions of the angle, whatever the object: their change
over a pair of views is predicted by the changes before and behind it. What is left over,

    d(v) = x(v + 1) − x(v) − a x′,    x′ from the pairs v ± 1 and v ± 2 alone,

with the described step a, is small and changes slowly in a sound scan; where views are missing,
exchanged or of an object that has moved, it is as large as so many steps. Over a full turn the last
view leads back to the first: a table that travels during the turn (a helix), or anything else that
does not come back, shows there. Views in random order have no smooth functions of the angle at all:
the mean squared difference of neighbours is that of any two views (von Neumann 1941, Ann. Math.
Stat. 12:367). Views that alternate (a focal spot that flies) leave a residual that alternates and
looks like the slope along the columns or rows. Angles that scatter about the described ones leave
one in all views that looks like the change itself.

Each mean is taken twice, over columns that share no noise; products of the two are squares without
noise, and what the two differ by is the noise.

A reading that two views at different angles share to the last digit is no measurement, if the noise
lets few others do so: a view, or a module of the detector, that was stuck.

What these tests cannot show: changes that are slow against a step (a slow motion that comes back, a
gantry that speeds up and slows down; conjugate rays and moments see those), and anything about an
object that is round about the axis.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpcct.checks.scan_test import UNKNOWN, ScanTest, check_lines
from torchpcct.geometry import Geometry, view_step
from torchpcct.readings import MEDIAN_TO_SD
from torchpcct.validate import checked

if TYPE_CHECKING:
    from collections.abc import Sequence


__all__ = ["neighbour_test", "stuck_views"]

Floats = NDArray[np.float64]

JUMP_STEPS = 0.9
"""Steps by which two views may lie farther apart than described."""
OTHER_STEPS = 10.0
"""Steps by which two views may differ otherwise: plane faces that the rays pass along do."""
JUMP_CELLS = 0.5
"""Cells at the border of the object by which two views may differ."""
ALTERNATION = 0.25
"""Shift between views (or columns) that alternate, in cells at the axis, that is no finding."""
_LEAST_JUMP = 0.75
"""Of a pair's own step, by which it must be longer or shorter to be of views that are missing,
stuck or exchanged, which a whole step makes; less is of an edge that the rays pass along."""
_SIGMAS = 8.0
"""Standard errors by which views must differ, and by which an alternation must stand out."""
_JUMP_SIGMAS = 10.0
"""How many times its noise a squared residual must be."""
_GOES_ON = 0.25
"""Part of a step back that one of the next pairs makes up for at least."""
_BURST = 25.0
"""How many times larger than beside it a squared residual must be."""
_BURST_AT_THE_END = 9.0
"""The same where a turn closes, of the one pair of its kind."""
_SHARE = 0.4
"""Share of the windows on the object that a view at a wrong place changes."""
_SHARE_AT_THE_END = 0.25
"""The same of a travel, which only shows where the object has an upper or lower end."""
_SHARE_OF_MANY = 0.15
"""The same of many steps forward, beyond the noise."""
_FEW_WINDOWS = 5
"""Windows below which nearly all must change."""
_SCATTER = (0.3, 0.8)
"""Least and largest median residual, in steps, of angles that scatter; with more the views are in
no order."""
_SCATTER_SIGMAS = 5.0
"""Standard errors by which that residual is none of noise."""
_LIKE_THE_CHANGE = (0.6, 1.6)
"""Size of a residual, over that of the change, from and up to which it looks like it."""
_CLEAR = 0.5
"""Squared change over its noise below which nothing is reported. Edges leave up to 0.23 in sound
scans."""
_STEPS_A_RESIDUAL = math.sqrt(7.0) / MEDIAN_TO_SD
"""Median size of the residual of angles that scatter independently by one step (normal, rms)."""
_REACH = 4
"""Views on either side that foretell a change, and one more."""
_STEADY = 1.5
"""Steps of this size, in usual ones, and larger are gaps."""
_ROWS = 6
"""Groups of detector rows that are looked at one by one, at most."""
_WINDOW_STEPS = 16.0
"""Width of a window, in ways of a border point in one step."""
_LEAST_WINDOW = 12
"""Columns of the smallest window."""
_LEAST_STEPS = 5.0
"""Fewest ways of a border point in a window."""
_FEWEST_VIEWS = 24
"""Views of a scan that is tested."""
_SLOW_HARMONICS = 4.0
"""Harmonics of a turn up to which the widest windows change; moments of order k have k."""
_PERIODS = (2, 4, 3)
"""Views after which an alternation repeats."""
_STUCK_SHARE = 0.98
"""Share of equal readings from which a view repeats another."""
_STUCK_COLUMNS = 16
"""Columns that are looked at together for readings that repeat."""
_POPULAR = 0.02
"""Share of all readings from which a value is a limit of the detector or one of few, and its
repetition no surprise."""
_CHANCE = 1e-9
"""Probability below which a repetition is none of chance, in all views together."""
_DARK_VIEWS = 8
"""Views for which a module of the detector is off at least; shorter ones are interpolated."""
_DARK_WIDTH = 3
"""Columns side by side that such a module has at least; narrower ones are interpolated."""
_MOST = 4_000_000
"""Readings that are looked at; more only cost time."""


@checked
def neighbour_test(lines: Tensor, geometry: Geometry) -> ScanTest:
    """Test whether neighbouring views lie one step apart, in the order of their angles.

    Args:
        lines: line integrals ``(views, [rows,] columns)`` of any unit, views in any order.
        geometry: parallel, fan or cone beam.

    Returns:
        The test of ``order`` (mean squared difference of neighbours over that of any two views: 1
        in random order), ``jump`` (largest distance of two neighbours beyond the described one, in
        steps), ``alternation`` (shift of views that alternate, in cells at the axis) and
        ``scatter`` (of the angles about the described ones, in steps).
        :data:`~torchpcct.checks.scan_test.UNKNOWN` of fewer than 24 views or 24 columns.

    Raises:
        ValueError: a wrong shape, NaN or Inf.
    """
    g: Any = geometry
    check_lines(lines, g.shape)
    views = _Views.of(lines, g)
    if views is None:
        return UNKNOWN
    sizes: dict[str, float] = {}
    errors: dict[str, float] = {}
    findings: list[str] = []
    order, limit, known = views.order()
    if known:
        sizes["order"] = order
        if order > limit:
            findings.append(
                f"neighbouring views differ as much as {100 * min(order, 1.0):.0f} % of what any "
                f"two views do, of an object that turns by {math.degrees(views.step):.2g}° at most "
                f"{100 * limit:.0f} %: the views are not in the order of their angles (files "
                "sorted by the text of their names: 1, 10, 100, 2?), or the angles are wrong; "
                "everything in the volume is"
            )
            return ScanTest(sizes, errors, tuple(findings))
    jumps, alternating, scatter = views.jumps(), views.alternation(), None
    if jumps is not None:
        sizes["jump"], errors["jump"] = jumps.size, jumps.error
        findings += jumps.findings
        scatter = jumps.scatter
    if alternating is not None:
        sizes["alternation"], errors["alternation"] = alternating[0], alternating[1]
        if alternating[2] and not findings:
            findings.append(alternating[2])
    if scatter is not None:
        sizes["scatter"], errors["scatter"] = scatter[0], scatter[1]
        # the largest of many jumps is none by itself
        if scatter[2] and not (alternating and alternating[2]):
            findings = [scatter[2]]
    return ScanTest(sizes, errors, tuple(findings))


@dataclass(frozen=True)
class _Jumps:
    size: float
    error: float
    findings: tuple[str, ...]
    scatter: tuple[float, float, str] | None
    """Size, error and text."""


class _Views:
    """Two sets of means with independent noise, ``(views, means)``, in the order of the angles."""

    def __init__(self, p: Floats, angles: Floats, number: NDArray[np.int64], g: Any) -> None:
        self.p, self.angles, self.number, self.g = p, angles, number, g
        self.step = view_step(angles)
        span = float(np.ptp(angles))
        self.closes = abs(span + self.step - 2.0 * math.pi) < 0.5 * self.step
        reach = g.ray_distances
        self.cell = float(np.median(np.abs(np.diff(reach))))
        highest = p.max((0, 1))
        body = highest > 0.05 * highest.max()
        self.seen, self.shadow = body, (mean := p.mean((0, 1))) > 0.02 * mean.max()
        self.radius = float(np.abs(reach[body]).max()) if body.any() else 0.0
        self.way = self.step * self.radius / self.cell

    @classmethod
    def of(cls, lines: Tensor, g: Any) -> _Views | None:
        if g.views < _FEWEST_VIEWS or g.columns < 2 * _LEAST_WINDOW:
            return None
        values = lines.detach().to("cpu")
        if g.has_rows:
            groups = np.array_split(np.arange(g.rows), min(g.rows, _ROWS))
            values = torch.stack([values[:, int(k[0]) : int(k[-1]) + 1].mean(1) for k in groups], 1)
        else:
            values = values[:, None]
        order = np.argsort(g.angles, kind="stable")
        angles, p = g.angles[order], values.double().numpy()[order]
        # Views at the same angle are one.
        first = np.flatnonzero(np.r_[True, np.diff(angles) > 1e-9])
        if first.size < _FEWEST_VIEWS:
            return None
        if first.size < angles.size:
            counts = np.diff(np.r_[first, angles.size])
            p = np.add.reduceat(p, first, axis=0) / counts[:, None, None]
        views = cls(p, angles[first], order[first], g)
        return views if views.radius > 0.0 and views.step > 0.0 else None

    def means(self, width: int, slope: bool = False) -> tuple[Floats, Floats]:
        """Means under Hann windows of so many columns, of two sets of columns that do not touch,
        ``(views, rows, windows)``; ``slope``: of the slopes along the columns, per column."""
        middle, windows, sets, slopes = _windows(self.p.shape[-1], width)
        number = middle.size
        self.body = self.seen[middle] | (np.arange(number) == number // 2)
        self.lit = (windows * self.shadow[:, None]).max(0) > 0.0
        one, other = slopes if slope else sets
        return self.p @ one, self.p @ other

    @property
    def width(self) -> int:
        """Of the windows in columns."""
        return int(np.clip(math.ceil(_WINDOW_STEPS * self.way), _LEAST_WINDOW, self.g.columns // 2))

    def order(self) -> tuple[float, float, bool]:
        """Von Neumann's ratio of the slowest means, its limit, and whether it can be determined."""
        slow = 1.0 - math.cos(min(_SLOW_HARMONICS * self.step, math.pi))
        limit = 3.0 * slow + 0.2
        if limit > 0.8:
            return math.nan, limit, False
        a, b = (x.reshape(len(x), -1) for x in self.means(self.g.columns // 2))
        a, b = (x - x.mean(1, keepdims=True) for x in (a, b))  # exposures differ
        noise = 0.5 * ((a - b) - (a - b).mean(0)) ** 2
        a, b = a - a.mean(0), b - b.mean(0)
        whole = (a * b).sum(1)
        steps = (np.diff(a, axis=0) * np.diff(b, axis=0)).sum(1)
        n = len(whole)
        # A round object shows noise only: its products scatter about 0.
        if (
            whole.mean() < _SIGMAS * float(noise.sum(1).mean()) / math.sqrt(n)
            or whole.mean() <= 0.0
        ):
            return math.nan, limit, False
        ratio = float(steps.mean() / (2.0 * whole.mean()))
        error = float(steps.std()) / math.sqrt(n) / (2.0 * float(whole.mean()))
        return max(ratio, 0.0), limit, ratio - 3.0 * error > limit or ratio < limit

    def _around(self, x: Floats) -> Floats:
        """Views before the first and behind the last: of a closed turn those at the other end."""
        return np.concatenate([x[-_REACH:], x, x[:_REACH]]) if self.closes else x

    def jumps(self) -> _Jumps | None:
        if self.way * _LEAST_STEPS > self.width:
            return None
        n = len(self.angles)
        angles = self.angles
        if self.closes:
            turn = 2.0 * math.pi
            angles = np.concatenate([angles[-_REACH:] - turn, angles, angles[:_REACH] + turn])
        a = np.diff(angles)
        pairs = len(a) - 4
        if pairs < _FEWEST_VIEWS - 4:
            return None
        means = self.means(self.width)
        columns = means[0].shape[2]
        sets = [self._around(x.reshape(n, -1)) for x in means]
        # A view whose air is brighter or darker is of another exposure, not at another place.
        air = np.tile(~self.lit, means[0].shape[1])
        if air.any():
            sets = [x - x[:, air].mean(1, keepdims=True) for x in sets]
        change = [np.diff(x, axis=0) for x in sets]
        scatter = 0.5 * np.square(np.diff(change[0] - change[1], axis=0)).mean(0)
        scatter = scatter + 0.1 * scatter.mean() + 1e-9 * np.square(change[0]).mean()
        # Nothing changes at all in a round body without noise.
        scatter = np.maximum(scatter, np.finfo(np.float64).tiny)
        change = [c / np.sqrt(scatter) for c in change]
        rate = [c / a[:, None] for c in change]
        # The rate at the pair from two pairs before and two behind it: exact for a cubic function
        # of the angle.
        predicted = [
            ((r[1:-3] + r[3:-1]) * (4.0 / 6.0) - (r[:-4] + r[4:]) / 6.0) * a[2:-2, None]
            for r in rate
        ]
        left = [c[2:-2] - f for c, f in zip(change, predicted, strict=True)]
        turning = [(r[3:-1] - r[1:-3]) * a[2:-2, None] for r in rate]
        # Few columns sample a sharp edge differently: one set may turn about, the other not.
        kink = np.maximum((turning[0] * turning[1]).sum(1), 0.0)
        aliased = 0.5 * np.square(turning[0] - turning[1]).sum(1)
        kink += 0.5 * np.maximum(aliased - _beside(aliased, self.closes), 0.0)
        steady = np.all([a[k : k + pairs] < _STEADY * self.step for k in range(5)], axis=0)
        square, usual = ((x[0] * x[1]).sum(1) for x in (left, predicted))
        near = np.maximum(_beside(square, self.closes), 0.0)
        # The noise of these sums, from what the sets differ by there and beside it; windows overlap
        # by half.
        apart = 0.5 * np.square(left[0] - left[1]).sum(1)
        single = 0.5 * np.square(change[0] - change[1]).sum(1)
        there = np.median([single[k : k + pairs] for k in (0, 1, 3, 4)], axis=0)
        there = there * np.median(apart) / max(float(np.median(single)), 1e-300)
        noisy = np.maximum(_beside(apart, self.closes), there) * math.sqrt(2.0 / left[0].shape[1])
        scale = max(float(np.median(usual)), float(np.mean(usual)) / 4.0)
        if scale <= 3.0 * float(np.median(noisy)) / math.sqrt(pairs):
            return None
        scatter = self._scatter(left, predicted) if scale > _CLEAR * float(apart.mean()) else None
        steps = np.sqrt(np.maximum(square, 0.0) / scale)
        along = (left[0] * predicted[1] + left[1] * predicted[0]).sum(1) / 2.0
        seen = usual > 0.05 * scale
        shift = np.where(seen, along / np.where(seen, usual, 1.0), 0.0)
        # No step forward, or many: a step back is none of a gantry.
        along_it = seen & (shift**2 * usual > 0.6 * square) & (shift > -1.5)
        # Views that are stuck or exchanged go back and on again; an opaque face that the rays pass
        # along need not.
        padded = np.pad(shift, 2)
        onward = np.max([padded[k : k + pairs] for k in (0, 1, 3, 4)], axis=0)
        along_it &= np.abs(shift) > _LEAST_JUMP
        along_it &= (shift > 0.0) | (onward > _GOES_ON * np.abs(shift))
        # Pair k is of the views k + 2 and k + 3 of the longer sequence.
        first = (np.arange(pairs) + 2 - (_REACH if self.closes else 0)) % n
        burst = np.where(self.closes & (first == n - 1), _BURST_AT_THE_END, _BURST)
        share = np.where(
            burst < _BURST,
            _SHARE_AT_THE_END,
            np.where(along_it & (steps > 3.0), _SHARE_OF_MANY, _SHARE),
        )
        found = (
            steady
            & (self._share(left, change, columns, first) > share)
            & (steps > np.where(along_it | (burst < _BURST), JUMP_STEPS, OTHER_STEPS))
            & (steps > JUMP_CELLS / self.way)
            & (square > burst * near)
            # an edge that the rays pass along turns the rate about, and makes no step
            & (square > 2.0 * kink)
            & (square > _JUMP_SIGMAS * noisy)
        )
        most = (
            int(np.argmax(np.where(found, square, -1.0))) if found.any() else int(np.argmax(steps))
        )
        # Of the square root of a sum whose noise is that of products with the signal.
        error = math.sqrt(float(noisy[most]) / scale / max(left[0].shape[1] / 2.0, 1.0) ** 0.5)
        if not found.any():
            return _Jumps(float(steps[most]), error, (), scatter)
        at = sorted({int(first[k]) for k in np.flatnonzero(found) if _largest(square, int(k))})
        explained = bool(along_it[most])
        size = float(shift[most]) if explained else float(steps[most])
        sigmas = float(square[most] / max(noisy[most], 1e-300))
        text = self._jump_text(at, int(first[most]), size, sigmas, explained)
        return _Jumps(float(steps[most]), error, (text,), scatter)

    def _scatter(self, left: list[Floats], predicted: list[Floats]) -> tuple[float, float, str]:
        """Of the angles about the described ones in steps, rms: what the residuals of all pairs
        have of the change.

        Products of the two sets are squares without noise; the median passes over edges.
        """
        square, usual = ((x[0] * x[1]).sum(1) for x in (left, predicted))
        clear = usual > 0.3 * float(np.median(usual))
        one, other = ((left[k] * predicted[1 - k]).sum(1)[clear] / usual[clear] for k in range(2))
        products = one * other
        n, median = products.size, float(np.median(products))
        error = (
            math.sqrt(math.pi / 2.0 / n)
            * MEDIAN_TO_SD
            * float(np.median(np.abs(products - median)))
        )
        size = math.sqrt(max(median, 0.0))
        steps = size / _STEPS_A_RESIDUAL
        spread = error / (2.0 * max(size, math.sqrt(error), 1e-300)) / _STEPS_A_RESIDUAL
        alike, whole = float((products * usual[clear]).sum()), float(square[clear].sum())
        # Noise of the two sets has the same sign by chance.
        sigmas = (2.0 * float((products > 0.0).mean()) - 1.0) * math.sqrt(n)
        low, high = _LIKE_THE_CHANGE
        if not (
            _SCATTER[0] < size < _SCATTER[1]
            and sigmas > _SCATTER_SIGMAS
            and low * whole < alike < high * whole
        ):
            return steps, spread, ""
        return (
            steps,
            spread,
            f"the views scatter by about {steps:.1g} of a step about the described angles "
            f"({sigmas:.0f} standard errors): the gantry does not turn evenly, or the object "
            "trembles; give the measured angle of each view",
        )

    def _share(
        self, left: list[Floats], change: list[Floats], columns: int, first: NDArray[np.int64]
    ) -> Floats:
        """Share of the windows along the columns in which a pair of views is off by half a step or
        more.

        A plane face that the rays pass along changes a few windows at once, a view at a wrong place
        all of them.
        """
        pairs = len(left[0])
        square, usual = (
            (x[0] * x[1]).reshape(len(x[0]), -1, columns).sum(1)
            for x in (left, [c[2:-2] for c in change])
        )
        noise = 0.5 * np.square(left[0] - left[1]).reshape(pairs, -1, columns).sum(1)
        noise, usual = _beside(noise, self.closes), _beside(usual, self.closes)
        off = (square > 0.25 * usual) & (square > 3.0 * noise)
        share: Floats = off[:, self.body].mean(1)
        if self.body.sum() >= _FEW_WINDOWS:
            return share
        ends = self.closes & (first == len(self.angles) - 1)
        return np.where(ends | (share > 0.75), share, 0.0)

    def _jump_text(
        self, at: list[int], most: int, size: float, sigmas: float, explained: bool
    ) -> str:
        n = len(self.angles)
        sure = f"({min(sigmas, 999.0):.0f} standard errors)"
        if self.closes and most == n - 1:
            return (
                f"the last view (number {self.number[-1]}) does not lead back to the first "
                f"({self.number[0]}): they differ by {abs(size):.2g} times what neighbouring views "
                f"do {sure}: something moved on during the turn (a table that travels, a helix "
                "described as a circle, an object that sinks or breathes), or the range of the "
                "angles is wrong; give the motion or the true angles"
            )
        pair = f"the views {self.number[most]} and {self.number[(most + 1) % n]}"
        more = f" (and {len(at) - 1} more pairs)" if len(at) > 1 else ""
        if explained and size > 0.0:
            return (
                f"{pair}{more} lie about {1.0 + size:.2g} steps apart, not one {sure}: views are "
                "missing there, stuck or out of order (files sorted by the text of their names: "
                "1, 10, 100, 2?), or the angles are wrong; give the angle of each view, in the "
                "order of the views"
            )
        return (
            f"{pair}{more} differ by {abs(size):.2g} times what neighbouring views do {sure}: "
            "views are exchanged, missing, stuck or out of order, or the object moved; sort the "
            "views by their angles"
        )

    def alternation(self) -> tuple[float, float, str] | None:
        """Shift along the columns, or the rows, of views that alternate; its error; what to say."""
        width = (
            max(self.width, 2 * _LEAST_WINDOW)
            if self.g.columns >= 4 * _LEAST_WINDOW
            else _LEAST_WINDOW
        )
        # the order of the angles must be that of the views, or the other way
        turns = np.sign(np.diff(self.number))
        if self.way * _LEAST_STEPS > width or np.any(turns != turns[0]):
            return None
        values, slopes = self.means(width), self.means(width, slope=True)
        best: tuple[float, float, str] | None = None
        patterns: list[tuple[str, Sequence[Floats]]] = [("columns", slopes)]
        if self.g.has_rows and values[0].shape[1] >= 3:
            patterns.append(("rows", [np.gradient(v, axis=1) for v in values]))
        bends = [v[1:-1] - (v[2:] + v[:-2]) / 2.0 for v in values]
        for along, slope in patterns:
            power = (slope[0][1:-1] * slope[1][1:-1]).sum((1, 2))
            product = bends[0] * slope[1][1:-1] + bends[1] * slope[0][1:-1]
            for period in _PERIODS:
                found = self._alternates(product, power, period)
                if found is None:
                    continue
                size, error = found
                if best is None:
                    best = (size, error, "")
                limit = (
                    ALTERNATION
                    if along == "columns"
                    else ALTERNATION * _ROWS / max(self.g.rows, _ROWS)
                )
                if size - _SIGMAS * error > limit and not (best[2] and best[0] > size):
                    scale = 1.0 if along == "columns" else max(self.g.rows / _ROWS, 1.0)
                    best = (
                        scale * size,
                        scale * error,
                        f"views that follow each other lie about {scale * size:.2g} {along} apart "
                        f"by turns, with a period of {period} views ({size / error:.0f} standard "
                        "errors): a focal spot that flies, which the geometry does not describe; "
                        "give its positions (VectorGeometry), or reconstruct the views of one "
                        "position",
                    )
        return best

    def _alternates(
        self, product: Floats, slopes: Floats, period: int
    ) -> tuple[float, float] | None:
        """Peak-to-peak shift of views with this period, and its error from the scatter of blocks
        of views.

        Args:
            product: of second differences between views and slopes, of both sets,
                ``(views, rows, windows)``.
            slopes: squared, without noise, ``(views,)``.
            period: in views.
        """
        n = len(product)
        index = np.arange(1, n + 1)
        blocks = np.array_split(np.arange(n), 16)
        found, power = [], []
        waves = (np.cos, np.sin) if period > 2 else (np.cos,)
        # Of a wave of this period the second difference keeps 1 − cos.
        keeps = 1.0 - math.cos(2.0 * math.pi / period)
        total = sum(slopes[b].sum() for b in blocks)
        if total <= 0.0:
            return None
        for wave in waves:
            w = wave(2.0 * math.pi * index / period)[:, None, None]
            score = (w * product).sum((1, 2)) / 2.0
            parts = np.array([score[b].sum() for b in blocks])
            norm = total * keeps * (1.0 if period == 2 else 0.5)
            found.append(float(parts.sum()) / norm)
            power.append(float(parts.std(ddof=1)) * math.sqrt(len(blocks)) / abs(norm))
        return 2.0 * math.hypot(*found), 2.0 * max(power)


@lru_cache(maxsize=4)
def _windows(
    columns: int, width: int
) -> tuple[NDArray[np.int64], Floats, tuple[Floats, ...], tuple[Floats, ...]]:
    """Hann windows of so many columns, half of which overlap: the columns in their middles; the
    windows, ``(columns, windows)``; and of two sets of columns that do not touch what takes the
    means under the windows, and what takes the slopes per column."""
    number = max(2, round(2.0 * (columns - width) / width) + 1)
    starts = np.linspace(0.0, columns - width, number)
    middle = (starts + width / 2.0).astype(int)
    at = np.arange(columns)
    x = (at[:, None] + 0.5 - starts) / width
    inside = (x > 0.0) & (x < 1.0)
    windows = np.where(inside, 1.0 - np.cos(2.0 * math.pi * x), 0.0)
    # The window's own slope, of the other sign: no difference of noisy readings.
    slopes = np.where(inside, -np.sin(2.0 * math.pi * x) * 2.0 * math.pi / width, 0.0)
    parts = [np.isin(at % 6, part)[:, None] for part in ((0, 1), (3, 4))]
    totals = [(windows * chosen).sum(0) for chosen in parts]
    sets = [
        tuple(kind * chosen / total for chosen, total in zip(parts, totals, strict=True))
        for kind in (windows, slopes)
    ]
    for array in (middle, windows, *sets[0], *sets[1]):
        array.setflags(write=False)
    return middle, windows, sets[0], sets[1]


def _beside(values: Floats, closes: bool) -> Floats:
    """Median of the values 6 … 14 places before and behind each, along the first axis."""
    n = len(values)
    offsets = np.r_[-14:-5, 6:15]
    at = np.arange(n)[:, None] + offsets
    inside = np.full(at.shape, True) if closes else (at >= 0) & (at < n)
    chosen = values[at % n]  # (places, offsets, …)
    chosen[~inside] = np.inf  # behind all others
    chosen.sort(axis=1)
    count = inside.sum(1)
    one, other = (chosen[np.arange(n), k] for k in ((count - 1) // 2, count // 2))
    return np.asarray((one + other) / 2.0, np.float64)


def _largest(values: Floats, k: int) -> bool:
    """Whether no value beside it is larger: one jump shows in five pairs."""
    return bool(values[k] >= values[max(k - 3, 0) : k + 4].max())


_MANY_COPIES = 0.2
"""Share of the views that repeat others if the object is symmetric and there is no noise."""
_AIR = 0.02
"""Share of readings with the largest value of all, or of line integrals the smallest: air without
noise."""
_ALIKE = 1e-4
"""Of the range of the readings: differences below are those of a projector in float32, and less
than the noise of 10⁷ photons."""


@checked
def stuck_views(readings: Tensor, geometry: Geometry) -> list[str]:
    """Name views at different angles that hold the same readings, to the last digit.

    Args:
        readings: as they were stored, ``(views, [rows,] columns)`` with noise; NaN where they are
            not to be looked at.
        geometry: parallel, fan or cone beam.

    Returns:
        One sentence; empty if no views repeat, or repetition is no surprise (values of few digits,
        no noise).
    """
    g: Any = geometry
    if readings.ndim != len(g.shape) or g.views < _FEWEST_VIEWS or g.columns < _STUCK_COLUMNS:
        return []
    rows = readings.detach().to("cpu").reshape(g.views, -1, g.columns)
    order = np.argsort(g.angles, kind="stable")
    n, angles = rows[:, :: max(1, math.ceil(rows.numel() / _MOST))].numpy()[order], g.angles[order]
    dark = _dark_columns(n, order)
    apart = np.diff(angles) > 1e-9
    values, counts = np.unique(n[:: max(1, g.views // 64)], return_counts=True)
    popular = values[counts > _POPULAR * counts.sum()]
    telling = np.isfinite(n) & (n != 0.0) & ~np.isin(n, popular)
    both = telling[1:] & telling[:-1]
    equal = both & (n[1:] == n[:-1])
    edges = np.arange(0, g.columns - _STUCK_COLUMNS + 1, _STUCK_COLUMNS)
    same, of = (np.add.reduceat(v.sum(1), edges, axis=1).astype(np.float64) for v in (equal, both))
    enough = (of >= _STUCK_COLUMNS // 2) & apart[:, None]
    # How often neighbouring views of these columns share a reading by chance, or because nothing
    # changes.
    chance = np.ones(len(edges))
    for k in np.flatnonzero(enough.sum(0) >= 8):
        chance[k] = np.median(same[enough[:, k], k] / of[enough[:, k], k])
    few = chance < 0.3
    unlikely = of * np.log(np.maximum(chance, 0.05)) < math.log(_CHANCE / max(int(enough.sum()), 1))
    stuck = enough & few & (same >= _STUCK_SHARE * of) & (of > 0) & unlikely
    later = _copies(n, telling, angles)
    # Readings without noise repeat where nothing moves: noise of neighbouring columns has nothing
    # in common.
    if not (stuck.any() or later) or not _noisy(n, edges, stuck):
        return dark
    pairs = np.flatnonzero(stuck.any(1))
    views = sorted({int(order[k + 1]) for k in pairs} | {int(order[k]) for k in later})
    whole = stuck.sum(1) >= 0.5 * np.maximum((enough & few).sum(1), 1)
    where = "" if later or whole[pairs].mean() > 0.5 else _columns_text(edges, stuck)
    which = ", ".join(map(str, views)) if len(views) <= 4 else f"{views[0]} … {views[-1]}"
    return [
        *dark,
        f"{len(views)} views{where} hold the same readings as views at other angles, noise and all "
        f"(views {which}): the detector was stuck, or files were copied; leave them out "
        "(Scan.select), or mask them (dead=)",
    ]


def _dark_columns(n: NDArray[np.float32], order: NDArray[np.int64]) -> list[str]:
    """Columns side by side that go dark at once, stay so, and are bright again at once: no shadow
    does that.

    Args:
        n: ``(views, rows, columns)``.
        order: number of each view.
    """
    dark = n <= 0.0
    if not dark.any():
        return []
    found: dict[tuple[int, int, int], int] = {}
    for row in np.flatnonzero(dark.any((0, 2))).tolist():
        change = np.diff(np.pad(dark[:, row].astype(np.int8), ((1, 1), (0, 0))), axis=0)
        begins, ends = change.T == 1, change.T == -1  # (columns, views + 1)
        columns = np.nonzero(begins)[0]
        spans = list(
            zip(
                columns.tolist(),
                np.nonzero(begins)[1].tolist(),
                np.nonzero(ends)[1].tolist(),
                strict=True,
            )
        )
        known = set(spans)
        for column, first, end in spans:
            long = end - first >= _DARK_VIEWS and (first > 0 or end < len(n))
            if not long or (column - 1, first, end) in known:
                continue
            width = 1
            while (column + width, first, end) in known:
                width += 1
            sides = [c for c in (column - 1, column + width) if 0 <= c < n.shape[2]]
            if width >= _DARK_WIDTH and not dark[first:end, row][:, sides].any():
                found[column, width, first] = end - first
    if not found:
        return []
    (column, width, first), views = max(found.items(), key=lambda item: item[0][1] * item[1])
    return [
        f"the columns {column} … {column + width - 1} read nothing in {views} views from number "
        f"{order[first]} on, and go dark and bright again all at once, which no shadow does: a "
        "module of the detector was off; mask it (dead=), or leave the views out (Scan.select)"
    ]


def _copies(n: NDArray[np.float32], telling: NDArray[np.bool_], angles: Floats) -> list[int]:
    """Whole views that repeat another one at a different angle, most of whose readings say
    something."""
    first: dict[bytes, int] = {}
    found = []
    whole = np.flatnonzero(telling.mean((1, 2)) > 0.5).tolist()
    # Views that add up to different sums are different: nearly always all are.
    sums = n.sum((1, 2), dtype=np.float64)[whole]
    if np.unique(sums).size == len(whole):
        return []
    for k in whole:
        before = first.setdefault(hashlib.sha256(n[k].tobytes()).digest(), k)
        if before != k and abs(angles[k] - angles[before]) > 1e-9:
            found.append(k)
    return [] if _symmetric(n, len(found) / max(len(whole), 1)) else found


def _symmetric(n: NDArray[Any], copies: float) -> bool:
    """Whether views repeat as those of a symmetric object without noise do (a phantom of voxels, a
    quarter of a turn later, or mirrored): a large share of them, and air reads the same
    everywhere, as it does not with noise."""
    if copies < _MANY_COPIES:
        return False
    low, high = float(np.nanmin(n)), float(np.nanmax(n))
    alike = _ALIKE * (high - low)
    return max(float((n < low + alike).mean()), float((n > high - alike).mean())) > _AIR


def _columns_text(edges: NDArray[np.int64], stuck: NDArray[np.bool_]) -> str:
    at = np.flatnonzero(stuck.any(0))
    return f" in the columns {edges[at[0]]} … {edges[at[-1]] + _STUCK_COLUMNS - 1}"


def _noisy(n: NDArray[np.float32], edges: NDArray[np.int64], stuck: NDArray[np.bool_]) -> bool:
    """Whether what changes from view to view in the columns that were stuck differs from column
    to column."""
    products, squares = 0.0, 0.0
    for k in np.flatnonzero(stuck.any(0)) if stuck.any() else range(len(edges)):
        part = n[:, :, edges[k] : edges[k] + _STUCK_COLUMNS].astype(np.float64)
        d = np.diff(part, n=2, axis=0)
        d = d[..., 2:] - 2.0 * d[..., 1:-1] + d[..., :-2]  # white noise: neighbours −2/3
        good = np.isfinite(d[..., 1:]) & np.isfinite(d[..., :-1]) & (d[..., 1:] != 0.0)
        a, b = d[..., 1:][good], d[..., :-1][good]
        if a.size < 50:
            continue
        limit = 5.0 * MEDIAN_TO_SD * np.median(np.abs(a)) + 1e-300
        small = (np.abs(a) < limit) & (np.abs(b) < limit)
        products += float((a * b)[small].sum())
        squares += float(np.sqrt((a * a)[small].sum() * (b * b)[small].sum()))
    return squares > 0.0 and products < -0.3 * squares
