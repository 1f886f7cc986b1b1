"""What a method does to contrast: the slope of measured against true contrast, and the bias of ROI means."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchpcct.metrics.bootstrap import Estimate, bca_interval, evaluate, leave_one_out, resampling
from torchpcct.metrics.cnr import mean_interval
from torchpcct.validate import checked

__all__ = ["ContrastSlope", "contrast_slope", "paired_interval", "roi_bias"]

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ContrastSlope:
    """Slope of the measured against the true contrast, with what pairs it with other figures.

    Attributes:
        value, low, high: slope and its interval.
        intercept: measured contrast where the true one is 0 (false contrast), HU.
        draws: ``(draws,)`` slopes of resampled realisations; jackknife: ``(realisations,)`` with one left out.
        seed: of the resampling.
    """

    value: float
    low: float
    high: float
    intercept: float
    draws: Floats
    jackknife: Floats
    seed: int


@checked
def contrast_slope(
    true_contrasts: ArrayLike, measured: ArrayLike, level: float = 0.95, draws: int = 2000, seed: int = 0
) -> ContrastSlope:
    """Weighted least-squares slope over scenes whose core differs; 1 is unbiased, below 1 shrinks contrast.

    Args:
        true_contrasts: ``(scenes,)`` HU, at least 2 different values (sign-flipped ones too).
        measured: ``(scenes, realisations)`` contrasts in HU; realisation k has the noise seed k in every scene. A scene
            counts with the inverse variance over its realisations.
        level, draws, seed: of the bootstrap over realisations.

    Raises:
        ValueError: wrong shapes, fewer than 3 realisations, equal true contrasts, NaN or Inf, a scene without noise.
    """
    t, y = np.asarray(true_contrasts, dtype=np.float64), np.asarray(measured, dtype=np.float64)
    if t.ndim != 1 or y.ndim != 2 or y.shape[0] != t.size or y.shape[1] < 3:
        raise ValueError(
            f"true_contrasts must be (scenes,) and measured (scenes, realisations ≥ 3), got {t.shape} and {y.shape}"
        )
    if not (np.isfinite(t).all() and np.isfinite(y).all()):
        raise ValueError("true_contrasts or measured hold NaN or Inf: check the reconstructions")
    variance = y.var(1, ddof=1)
    if not (variance > 0).all():
        raise ValueError(f"the contrasts of scene {int(np.argmin(variance))} do not vary: realisations must be noisy")
    weight = 1.0 / variance
    weight /= weight.sum()
    centered = t - weight @ t
    spread = float(weight @ centered**2)
    if not spread > 0:
        raise ValueError("true_contrasts must hold at least 2 different values")
    # The slope is linear in the scenes' means, so it is the mean of what each realisation alone would give.
    each = (weight * centered / spread) @ y
    n = each.size
    value = float(each.mean())
    resampled = evaluate(lambda i: each[i].mean(-1), resampling(n, draws, seed))
    jackknife = (each.sum() - each) / (n - 1)
    low, high = bca_interval(value, resampled, jackknife, level)
    intercept = float(weight @ y.mean(1) - value * (weight @ t))
    return ContrastSlope(value, low, high, intercept, resampled, jackknife, seed)


def paired_interval(
    statistic: Callable[[Any, Any], Floats], n: int, slope: float | ContrastSlope, level: float, draws: int, seed: int
) -> Estimate:
    """A figure that a slope corrects, with its bootstrap interval: figure and slope are resampled together.

    Args:
        statistic: figures ``(m,)`` of resampling indices ``(m, n)`` and their slopes, ``(m,)`` or one number.
        n: number of realisations.
        slope: taken as exact if a number.
        level, draws, seed: of the bootstrap.
    """
    value: Any = slope
    drawn: Any = slope
    left_out: Any = slope
    if isinstance(slope, ContrastSlope):
        value, drawn, left_out = slope.value, slope.draws, slope.jackknife
        own = (left_out.size, drawn.size, slope.seed)
        if own != (n, draws, seed):
            raise ValueError(
                f"the slope was resampled with (realisations, draws, seed) = {own}, the figure with {n, draws, seed}: "
                "use the same, or give slope.value"
            )
    if not (math.isfinite(value) and value > 0):
        raise ValueError(
            f"slope must be a positive number, got {value}: contrast of the wrong sign cannot be corrected"
        )
    exact = float(statistic(np.arange(n)[None], value)[0])
    with np.errstate(divide="ignore"):
        jackknife = np.log(statistic(leave_one_out(n), left_out))
    return Estimate(exact, *bca_interval(exact, statistic(resampling(n, draws, seed), drawn), jackknife, level))


@checked
def roi_bias(means: ArrayLike, truth: ArrayLike, level: float = 0.95) -> list[Estimate]:
    """Mean minus truth of each ROI with Student's interval.

    Args:
        means: ``(realisations, rois)`` HU.
        truth: ``(rois,)`` HU: the tissue's value, or the noise-free mean of a reference reconstruction.

    Raises:
        ValueError: wrong shapes, fewer than 2 realisations, NaN or Inf.
    """
    m, t = np.asarray(means, dtype=np.float64), np.asarray(truth, dtype=np.float64)
    if m.ndim != 2 or t.shape != m.shape[1:]:
        raise ValueError(f"means must be (realisations, rois) and truth (rois,), got {m.shape} and {t.shape}")
    return [Estimate(float(d.mean()), *mean_interval(d, level)) for d in (m - t).T]
