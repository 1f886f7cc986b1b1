"""Do the readings stop at a lowest value? Negative readings that were set to 0, or left out, or
made positive, after the dark was taken off.

Behind dense objects a detector with electronic noise reads as often below its dark level as above.
Where such readings are set to 0 (or to any other lowest value: 1, a small transmission), those that
are left are too bright on average, by 0.4 standard deviations where no light comes, and what these
rays pass reads too low. Photons that are counted read 0, too, but rarely beside readings of
several photons. Of three neighbours a, b, c that expect the same number of photons, or numbers on a
straight line, the middle one holds a third of all n = a + b + c on average, whatever is expected:
given n it is binomial, so that

    P(b = 0 | n, a > 0, c > 0) = (2/3)ⁿ (1 − 2 (1/2)ⁿ) / (1 − 2 (2/3)ⁿ + (1/3)ⁿ)

holds for photons of any number (Fisher's conditional test, Stat. Methods Res. Workers, 1925).
Shadows have two sides, so their edges are no such triples; a wire one cell wide is, along the
columns or along the views: readings are clipped if both have more zeros than photons have.

Readings that were marked as dead for being low count as zeros, if there are few among bright ones.

Absolute values of negative readings come once each: the density of readings, which is smooth where
electronics add some noise, then goes on unchanged down to 0 and is nothing below. Where photons are
counted the density ends at 0, too, but 0 itself comes again and again there.

What this cannot show: noise of the electronics below the signal of a photon or a step of the
digits, which clips little; and counts so high that nothing was below 0, where nothing was changed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchpcct.readings import quartile_sd, second_differences

__all__ = ["Floor", "clipped_floor", "folded_share"]

Floats = NDArray[np.float64]

FLOOR_SHARE = 0.002
"""Share of the readings that stand at the lowest value beyond what photons explain, between two
that do not, from which it is named."""
_PART = 0.08
"""The same over all readings at the lowest value; more of them are the shadows of opaque parts."""
_TIMES = 1.25
"""How many times as many as of photons there must be; to so much the signal of one is known."""
_SIGMAS = 8.0
"""Standard errors to which their number must be above that of photons."""
_OVERLAP = 3.0
"""Triples that share a reading with each, itself among them: their variances add up so."""
_SAME = 1e-4
"""Relative difference of values that are the same: exp and log in float32 leave less."""
_CLASSES = 12
"""Classes of brightness from whose noise the signal of a photon is found."""
_CLEAR = 4.0
"""Standard deviations above the lowest value from which nothing of a class is clipped."""
_ALONE = 20.0
"""How many times as often as any other a value must come to stand for lower readings that are not
there, while some are lower than it is."""
_AT_RANDOM = 0.1
"""Share of dead readings among bright ones, over that among dark ones, below which they were not
lost at random."""
_SAMPLE = 200_000
"""Readings among which a value is looked for that comes again and again."""
_LEAST = 200
"""Triples of a class, and of readings beside the lowest value, that say something."""

_DARKEST = 0.05
"""Share of the readings, the darkest ones, whose noise is looked at for absolute values."""
_NEAR = 0.5
"""Standard deviations above 0 in which their density is looked at."""
_FEWEST_NEAR = 80
"""Readings so near to 0 that tell; of a smooth density a fifth as many lie below 0."""
_EVEN = (0.7, 1.35)
"""Part of them in the lower half of that interval, over a half: of a density that goes on to 0."""
_EXACT = 0.02
"""Part of them that may read 0 itself: more are readings without a photon."""
_STEPS = 4.0
"""Values of the digits in that interval, at least: no photons that are counted reach 0 there."""
_FEWEST_DARK = 2000
"""The same in readings, at least."""
_WHITE = -0.3
"""Correlation of neighbouring second differences up to which they are noise (white: -2/3, somewhat
more of those chosen for a dark mean)."""


class Floor(NamedTuple):
    """What is known of the lowest value.

    Attributes:
        value: that stands for all lower readings; NaN: they are marked as dead.
        share: of the readings that stand there.
        excess: share of the readings that stand there, between two that do not, beyond what photons
            explain; along the columns or the views, the smaller one.
        clipped: whether that is more than chance and the object's edges leave.
    """

    value: float
    share: float
    excess: float
    clipped: bool


def clipped_floor(counts: Floats, quantum: float) -> Floor:
    """Whether readings were clipped at a lowest value, or those below it marked as dead.

    Args:
        counts: ``(views, rows, columns)`` in any unit, NaN where dead.
        quantum: reading of one photon, as described; less, if the noise of bright readings says
            so.
    """
    lowest = float(np.nanmin(np.where(np.isnan(counts), np.inf, counts)))
    if not 0.0 <= lowest < math.inf:
        return Floor(lowest, 0.0, 0.0, False)
    value = _repeated(counts, lowest)
    low = counts <= value + _SAME * max(value, quantum)
    found = _tested(low, np.where(low, 0.0, counts - value), value, quantum)
    if found.clipped:
        return found
    dead = np.isnan(counts)
    masked = _tested(dead, np.where(dead, 0.0, counts), math.nan, quantum)
    if masked.clipped and all(_in_the_dark(np.moveaxis(counts, k, -1)) for k in (0, 2)):
        return masked
    return found


def folded_share(counts: Floats) -> float:
    """Share of the readings that lie close above 0 while none lies below: negative ones were made
    positive; 0 where that is not so, or cannot be determined.

    Args:
        counts: ``(views, rows, columns)`` in any unit, NaN where dead.
    """
    known = counts[np.isfinite(counts)]
    if known.size < _LEAST or float(known.min()) < 0.0:
        return 0.0
    sd = _noise_of_the_darkest(counts)
    near = known[known < _NEAR * sd]
    if near.size < max(_FEWEST_NEAR, 1e-4 * known.size):
        return 0.0
    lower = float((near < _NEAR * sd / 2.0).mean()) / 0.5
    values = np.unique(near)
    steps = values.size if values.size < 0.5 * near.size else math.inf
    if not _EVEN[0] < lower < _EVEN[1] or steps < _STEPS:
        return 0.0
    # Of whole steps 0 is one, as likely as half of another one.
    exact = float((near == 0.0).mean())
    return 0.0 if exact > max(_EXACT, 1.0 / steps) else near.size / known.size


def _noise_of_the_darkest(counts: Floats) -> float:
    """Standard deviation of the darkest readings about their neighbours in the row; 0 where what
    changes between them is no noise."""
    second, mean = second_differences(counts)
    known = np.isfinite(second)
    if not known.any():
        return 0.0
    share = min(max(_DARKEST, _FEWEST_DARK / known.sum()), 1.0)
    dark = known & (mean <= np.quantile(mean[known], share))
    both = dark[..., 1:] & dark[..., :-1]
    if both.sum() < _LEAST:
        return 0.0
    a, b = second[..., 1:][both], second[..., :-1][both]
    if (a * b).sum() > _WHITE * math.sqrt(float((a * a).sum() * (b * b).sum())):
        return 0.0
    return quartile_sd(second[dark]) / math.sqrt(6.0)


def _repeated(counts: Floats, lowest: float) -> float:
    """The value that stands for all lower readings: the lowest, or one that comes again and again
    where no other does."""
    some = counts.ravel()[:: max(1, counts.size // _SAMPLE)]
    values, numbers = np.unique(some[np.isfinite(some)], return_counts=True)
    if values.size < 2:
        return lowest
    most = int(numbers.argmax())
    alone = numbers[most] > _ALONE * np.delete(numbers, most).max()
    return float(values[most]) if alone and values[most] < np.median(some) else lowest


def _tested(low: NDArray[np.bool_], above: Floats, value: float, quantum: float) -> Floor:
    """The test of readings ``low`` by what the others stand ``above`` them; 0 where ``low``."""
    share = float(low.mean())
    if share < FLOOR_SHARE:
        return Floor(value, share, 0.0, False)
    axes = (above, np.moveaxis(above, 0, -1))
    # Details of the object add to the noise of some readings. The smallest step of the digits is
    # one photon at most.
    step = float(np.nanmin(np.where(low, np.inf, above)))
    photon = max(min(quantum, *(_photon(x) for x in axes)), step)
    found = [_excess(x, photon) for x in axes]
    excess = min(e for e, _ in found)
    sure = all(s for _, s in found) and excess > max(FLOOR_SHARE, _PART * share)
    return Floor(value, share, excess, sure)


def _in_the_dark(x: Floats) -> bool:
    """Whether dead readings between two live ones on the last axis have dark neighbours, which
    those that were lost at random have not."""
    beside, dead = x[..., :-2] + x[..., 2:], np.isnan(x[..., 1:-1])
    known = np.isfinite(beside)
    dark = known & (beside < np.nanmedian(beside))
    rates = [float(dead[part].sum()) / max(int(part.sum()), 1) for part in (dark, known & ~dark)]
    return rates[1] < _AT_RANDOM * rates[0]


def _excess(x: Floats, photon: float) -> tuple[float, bool]:
    """Share of the readings that are 0 between two that are not beyond that of photons, along the
    last axis; and whether it is beyond chance."""
    a, b, c = x[..., :-2], x[..., 1:-1], x[..., 2:]
    with np.errstate(invalid="ignore"):
        beside = (a > 0.0) & (c > 0.0) & (b >= 0.0)
    n = ((a + c)[beside] + b[beside]) / photon
    if n.size < _LEAST:
        return 0.0, False
    zeros = float((b[beside] == 0.0).sum())
    chance = _chance(n)
    expected = float(chance.sum())
    sd = math.sqrt(_OVERLAP * float((chance * (1.0 - chance)).sum()) + 1.0)
    return (zeros - expected) / x.size, zeros > _TIMES * expected + _SIGMAS * sd


def _chance(n: Floats) -> Floats:
    """Probability that of n photons in three readings alike none is in the middle one, if both
    others have some."""
    n = np.maximum(n, 2.0)
    dark = (2.0 / 3.0) ** n
    probability: Floats = dark * (1.0 - 2.0 * 0.5**n) / (1.0 - 2.0 * dark + (1.0 / 3.0) ** n)
    return np.minimum(probability, 1.0)


def _photon(x: Floats) -> float:
    """Signal of a photon, by how the variance along the last axis grows with the reading where
    nothing is clipped (photon transfer, Janesick 2007); what the electronics add does not grow.

    Infinite where that cannot be determined.
    """
    second, mean = second_differences(x)
    known = np.isfinite(second)
    second, mean = second[known], mean[known]
    if second.size < _LEAST:
        return math.inf
    edges = np.quantile(mean, np.linspace(0.0, 1.0, _CLASSES + 1))
    at = np.clip(np.searchsorted(edges, mean, "right") - 1, 0, _CLASSES - 1)
    found = []
    for k in range(_CLASSES):
        chosen = at == k
        number = int(chosen.sum())
        if number < _LEAST:
            continue
        m, v = float(mean[chosen].mean()), quartile_sd(second[chosen]) ** 2 / 6.0
        if v > 0.0 and m > _CLEAR * math.sqrt(v):
            found.append((m, v, number / v**2))
    if not found:
        return math.inf
    means, variances, weights = np.array(found).T
    largest = float(variances[-1] / means[-1])
    about = means - float((weights * means).sum() / weights.sum())
    power = float((weights * about * about).sum())
    if means[-1] < 2.0 * means[0] or power <= 0.0:
        return largest
    slope = float((weights * about * variances).sum()) / power
    return min(max(slope, 0.3 * largest), largest)
