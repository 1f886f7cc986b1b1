"""Paired bootstrap over realisations: one set of resampling indices for everything that shares the noise seeds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from torchpcct.validate import coverage, whole

__all__ = ["Estimate", "bca_interval", "evaluate", "generator", "leave_one_out", "resampling"]

Floats = NDArray[np.float64]
_ELEMENTS = 1 << 21


class Estimate(NamedTuple):
    """A figure with its confidence interval."""

    value: float
    low: float
    high: float


def generator(seed: int) -> np.random.Generator:
    """Random numbers of a seed, a whole number ≥ 0: the one rule of this package."""
    return np.random.default_rng(whole("seed", seed, low=0))


def resampling(realizations: int, draws: int, seed: int) -> NDArray[np.int64]:
    """``(draws, realizations)`` indices with replacement. The same arguments give the same indices: paired."""
    return generator(seed).integers(0, realizations, (draws, realizations))


def leave_one_out(realizations: int) -> NDArray[np.int64]:
    """``(realizations, realizations − 1)`` indices, row i without i."""
    index = np.arange(realizations - 1)
    return index + (index >= np.arange(realizations)[:, None])


def evaluate(statistic: Callable[[NDArray[np.int64]], Any], indices: NDArray[np.int64]) -> Floats:
    """``statistic`` of blocks of rows of ``indices``, so that the resampled data stay small."""
    block = max(1, _ELEMENTS // indices.shape[1])
    parts = [np.asarray(statistic(indices[k : k + block])) for k in range(0, len(indices), block)]
    return np.concatenate(parts).astype(np.float64)


def bca_interval(value: float, draws: Any, jackknife: Any, level: float = 0.95) -> tuple[float, float]:
    """Bias-corrected and accelerated bootstrap interval (Efron 1987).

    A variance from few realisations is skewed: the plain percentile interval lies too low. Order statistics are not
    interpolated, so draws may be 0 or Inf (a dose beyond the curve's range).

    Args:
        value: the figure of all realisations.
        draws: ``(draws,)`` of the resampled ones.
        jackknife: ``(realizations,)`` with one left out; not finite: no acceleration.
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
