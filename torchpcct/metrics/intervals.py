"""Intervals of figures over paired realisations: bootstrap and jackknife.

All methods see the same noise seeds. So one set of resampling indices serves everything that shares
them; and what methods have in common cancels in a ratio or a difference only if the figures are
left without the same realisation together. A :class:`Jackknifed` carries its replicates along, and
any smooth function of several has its interval for free.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.special import ndtr, ndtri

from torchpcct.validate import checked, coverage, whole

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


__all__ = ["Estimate", "Jackknifed", "combined"]

Floats = NDArray[np.float64]


class Estimate(NamedTuple):
    """A figure with its confidence interval."""

    value: float
    low: float
    high: float


def generator(seed: int) -> np.random.Generator:
    """Random numbers of a seed, a whole number ≥ 0: the one rule of this package."""
    return np.random.default_rng(whole("seed", seed, low=0))


def resampling(realisations: int, draws: int, seed: int) -> NDArray[np.int64]:
    """``(draws, realisations)`` indices with replacement. The same arguments give the same
    indices: paired."""
    return generator(seed).integers(0, realisations, (draws, realisations))


def leave_one_out(realisations: int) -> NDArray[np.int64]:
    """``(realisations, realisations − 1)`` indices, row i without i."""
    index = np.arange(realisations - 1)
    return index + (index >= np.arange(realisations)[:, None])


def bca_interval(
    value: float, draws: ArrayLike, jackknife: ArrayLike, level: float = 0.95
) -> tuple[float, float]:
    """Bias-corrected and accelerated bootstrap interval (Efron 1987).

    A variance from few realisations is skewed: the plain percentile interval lies too low. Order
    statistics are not interpolated, so draws may be 0 or Inf (a dose beyond the curve's range).

    Args:
        value: the figure of all realisations.
        draws: ``(draws,)`` of the resampled ones.
        jackknife: ``(realisations,)`` with one left out; not finite: no acceleration.
        level: coverage, in (0, 1).
    """
    coverage("level", level)
    d = np.sort(np.asarray(draws, dtype=np.float64))
    n = d.size
    below = np.clip(((d < value).sum() + (d <= value).sum()) / 2, 0.5, n - 0.5) / n
    bias = ndtri(below)
    acceleration = 0.0
    j = np.asarray(jackknife, dtype=np.float64)
    if np.isfinite(j).all():
        deviation = j.mean() - j
        square = float((deviation**2).sum())
        if square > 0:
            acceleration = float((deviation**3).sum()) / (6 * square**1.5)
    ends = []
    for z in ndtri([0.5 - level / 2, 0.5 + level / 2]):
        shifted = bias + z
        p = ndtr(bias + shifted / (1 - acceleration * shifted))
        ends.append(float(p) * (n - 1))
    return float(d[int(np.floor(ends[0]))]), float(d[int(np.ceil(ends[1]))])


@dataclass(frozen=True, eq=False)
class Jackknifed:
    """A figure of n paired realisations.

    Attributes:
        value: of all realisations.
        left_out: ``(n,)``, each realisation left out once; realisation k has the same noise seed in
            every figure that this one is combined with.
    """

    value: float
    left_out: Floats

    @property
    def standard_error(self) -> float:
        """Jackknife standard error (Efron, Stein 1981, Ann. Stat. 9:586)."""
        n = self.left_out.size
        return math.sqrt((n - 1) / n * float(np.square(self.left_out - self.left_out.mean()).sum()))

    def estimate(self, level: float = 0.95) -> Estimate:
        """The figure with Student's interval of n − 1 degrees of freedom."""
        coverage("level", level)
        half = float(stats.t.ppf(0.5 + level / 2, self.left_out.size - 1)) * self.standard_error
        return Estimate(self.value, self.value - half, self.value + half)

    def exponential(self, level: float = 0.95, scale: float = 1.0) -> Estimate:
        """exp(scale · figure) with the interval of the figure: for logarithms of a variance (½:
        the SD)."""
        value, *ends = (math.exp(scale * v) for v in self.estimate(level))
        return Estimate(value, *sorted(ends))


@checked
def combined(function: Callable[..., float | Floats], *figures: Jackknifed | float) -> Jackknifed:
    """A smooth function of figures of the same realisations; numbers are taken as exact.

    Args:
        function: of as many arguments as there are figures, on floats and arrays alike.
        figures: at least one :class:`Jackknifed`.

    Raises:
        ValueError: figures of different numbers of realisations, or none of a sample; a value that
            is not finite.
    """
    sizes = {f.left_out.size for f in figures if isinstance(f, Jackknifed)}
    if len(sizes) != 1:
        raise ValueError(
            f"figures must be of the same realisations, got numbers of realisations {sorted(sizes)}"
        )
    value = float(function(*[f.value if isinstance(f, Jackknifed) else f for f in figures]))
    left_out = function(*[f.left_out if isinstance(f, Jackknifed) else f for f in figures])
    left_out = np.broadcast_to(np.asarray(left_out, dtype=np.float64), (sizes.pop(),))
    if not (math.isfinite(value) and np.isfinite(left_out).all()):
        raise ValueError(
            f"the combined figure is not finite ({value}): check its arguments (a logarithm of 0?)"
        )
    return Jackknifed(value, left_out)


def log_of_sum(parts: ArrayLike, lost: int = 0) -> Jackknifed:
    """ln(Σ parts / (n − lost)) of non-negative parts, one for each realisation.

    Args:
        parts: ``(n,)``.
        lost: 0 for a mean. 1 for squared deviations from the mean of the realisations, where the
            sum without one loses n / (n − 1) of its part.

    Raises:
        ValueError: fewer than 3 realisations; nothing varies.
    """
    p = np.asarray(parts, dtype=np.float64)
    n = p.size
    if p.ndim != 1 or n < 3:
        raise ValueError(f"parts must be (realisations ≥ 3,), got the shape {p.shape}")
    rest = (p.sum() - p * (n / (n - lost))) / (n - 1 - lost)
    if not (p.sum() > 0 and (rest > 0).all()):
        raise ValueError("the realisations do not vary: they must be noisy")
    return Jackknifed(math.log(p.sum() / (n - lost)), np.log(rest))
