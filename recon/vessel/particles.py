"""Sequential Monte Carlo: a cloud of parameters that is led from the prior to the posterior.

Del Moral, Doucet, Jasra 2006, "Sequential Monte Carlo samplers": likelihoods to the power of a
temperature that rises as fast as the weights allow, resampling, and Metropolis moves as wide as the
cloud.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

Target = Callable[[Floats], tuple[Floats, Floats]]
"""Parameters ``(m, d)`` → log prior and log likelihood, ``(m,)`` each."""

_KEEP = 0.5
"""Effective share of the cloud that a step in temperature leaves."""
_MOST_STEPS = 40
"""Largest number of temperatures."""
_SCALES = (1.0, 0.5, 0.2)
"""Widths of the Metropolis moves of every point at every temperature, as shares of the cloud's."""


class Cloud(NamedTuple):
    """A cloud at the posterior, of equal weights.

    Attributes:
        points: ``(m, d)``.
        log_evidence: log of the mean likelihood under the prior.
    """

    points: Floats
    log_evidence: float


def sample_towards(
    start: Floats,
    base: Target,
    target: Target,
    rng: np.random.Generator,
    *,
    log_evidence: float = 0.0,
) -> Cloud:
    """Samples of a distribution from those of another (sequential Monte Carlo).

    Args:
        start: ``(m, d)`` draws of the first distribution.
        base: its log prior and log likelihood (0 where the first is the prior).
        target: log prior and log likelihood of the last distribution; the prior is the same.
        rng: of all randomness.
        log_evidence: of the first distribution.
    """
    points = start
    log_prior, first = base(points)
    _, last = target(points)
    done, steps = 0.0, 0
    while done < 1.0 and steps < _MOST_STEPS:
        gain = last - first
        step = _step(gain, 1.0 - done)
        weight = np.exp(step * gain - (step * gain).max())
        log_evidence += float(np.log(weight.mean()) + (step * gain).max())
        done, steps = min(1.0, done + step), steps + 1
        spread = np.cov(points.T, aweights=weight) + 1e-8 * np.eye(points.shape[1])
        keep = _resample(weight, rng)
        points, log_prior, first, last = points[keep], log_prior[keep], first[keep], last[keep]
        factor = np.linalg.cholesky(spread) * (2.38 / np.sqrt(points.shape[1]))
        for scale in _SCALES:
            tried = points + rng.standard_normal(points.shape) @ factor.T * scale
            prior, one = base(tried)
            _, other = target(tried)
            # −inf where the prior is 0.
            ratio = prior - log_prior + (1 - done) * (one - first) + done * (other - last)
            taken = np.log(rng.random(len(points))) < ratio
            points = np.where(taken[:, None], tried, points)
            log_prior, first = np.where(taken, prior, log_prior), np.where(taken, one, first)
            last = np.where(taken, other, last)
    return Cloud(points, log_evidence)


def _step(gain: Floats, most: float) -> float:
    """Largest step in temperature that keeps the effective size of the cloud."""

    def effective(step: float) -> float:
        w = np.exp(step * (gain - gain.max()))
        return float(w.sum() ** 2 / (w**2).sum() / len(w))

    if effective(most) >= _KEEP:
        return most
    low, high = 0.0, most
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if effective(middle) >= _KEEP else (low, middle)
    return max(low, 1e-6)


def _resample(weight: Floats, rng: np.random.Generator) -> NDArray[np.int64]:
    """Systematic resampling."""
    edges = np.cumsum(weight / weight.sum())
    at = (rng.random() + np.arange(len(weight))) / len(weight)
    return np.minimum(np.searchsorted(edges, at), len(weight) - 1)
