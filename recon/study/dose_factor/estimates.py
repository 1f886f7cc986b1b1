"""Estimates with 95 % intervals as JSON values: ``value``, ``low`` and ``high``, and ``why`` where there is none."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchpcct.metrics import (
    ContrastSlope,
    DoseCurve,
    cnr,
    cnr_interval,
    contrast_slope,
    dose_factor,
    efficiency,
    mean_interval,
)
from torchpcct.metrics.bootstrap import bca_interval, leave_one_out, resampling

__all__ = [
    "DRAWS",
    "attempt",
    "contrast_figures",
    "controlled",
    "estimate",
    "factor",
    "kept",
    "mean_of",
    "none",
    "observer_factor",
    "paired_ratio",
    "paper_cnr",
    "reached",
    "slope_of",
]

Floats = NDArray[np.float64]

DRAWS = 2000
"""Of every bootstrap."""


def estimate(value: Any) -> dict[str, float | None]:
    """Of value, low and high; what is not finite is None."""
    v, low, high = (float(x) for x in (value[0], value[1], value[2]))
    return {k: (x if math.isfinite(x) else None) for k, x in (("value", v), ("low", low), ("high", high))}


def none(why: str) -> dict[str, Any]:
    """No figure, and the reason."""
    return {"value": None, "low": None, "high": None, "why": why}


def attempt(compute: Callable[[], Any]) -> Any:
    """The figure, or why there is none."""
    try:
        return compute()
    except ValueError as error:
        return none(str(error))


def mean_of(values: Floats) -> dict[str, float | None]:
    """Mean of a sample."""
    return estimate((values.mean(), *mean_interval(values)))


def paper_cnr(roi: Floats) -> dict[str, float | None]:
    """The paper's CNR of ROI means ``(n, 2)``: core, fibrous."""
    return estimate((cnr(roi[:, 0], roi[:, 1]), *cnr_interval(roi[:, 0], roi[:, 1])))


def slope_of(truth: Floats, rois: list[Floats], draws: int = DRAWS) -> ContrastSlope:
    """Contrast slope over the main scenes, from the ROI means ``(n, 2)`` in each."""
    return contrast_slope(truth, np.stack([r[:, 1] - r[:, 0] for r in rois]), draws=draws)


def reached(ideal_sd: float, contrast: Floats, slope: ContrastSlope) -> Any:
    """Share of the limit: ideal over slope-corrected variance of the contrast."""
    return attempt(lambda: estimate(efficiency(ideal_sd, contrast, slope, draws=DRAWS)))


def contrast_figures(roi: Floats, slope: ContrastSlope, ideal_sd: float) -> dict[str, Any]:
    """What every pair of ROIs is judged by: the paper's CNR, slope, share of the limit and slope-corrected SD.

    Args:
        roi: ``(n, 2)`` ROI means of the paper's scene, HU.
        slope: of the contrast.
        ideal_sd: of the best unbiased estimate of the contrast, HU.
    """
    share = reached(ideal_sd, roi[:, 1] - roi[:, 0], slope)

    def sd(name: str) -> float | None:
        return ideal_sd / math.sqrt(share[name]) if share.get(name) else None

    return {
        "paper_cnr": paper_cnr(roi),
        "slope": estimate((slope.value, slope.low, slope.high)),
        "efficiency": share,
        "contrast_sd_hu": {"value": sd("value"), "low": sd("high"), "high": sd("low")},
    }


def factor(samples: Any, curve: DoseCurve, figure: str, slope: Any = 1.0) -> Any:
    """Dose factor of a method's samples on a dose curve of FBP."""

    def compute() -> Any:
        f = dose_factor(samples, curve, figure, slope=slope, draws=DRAWS)
        return {**estimate(f), "text": str(f)}

    return attempt(compute)


def observer_factor(scores: Any, curve: DoseCurve, figure: str) -> Any:
    """Dose factor by an observer's scores, ``(n, 2)`` without and with the core, or None."""
    if scores is None:
        return none("too few realisations")
    if figure == "auc" and float(scores[:, 1].min()) > float(scores[:, 0].max()):
        return none("AUC is 1: look at d′")
    return factor(scores, curve, figure)


def controlled(values: Floats, control: Floats, expectation: Any) -> Floats:
    """Samples whose mean is that of ``values`` with less sampling error (control variates).

    Args:
        values: ``(n, k)`` of a method.
        control: ``(n, m)`` of a method with a known expectation, on the same noise.
        expectation: ``(m,)``.

    Returns:
        ``(n, k)``, ``values`` less what the control's deviation from its expectation explains by linear regression.
    """
    deviation = control - control.mean(0)
    slopes = np.linalg.lstsq(deviation, values - values.mean(0), rcond=None)[0]
    result: Floats = values - (control - np.asarray(expectation)) @ slopes
    return result


def _slope_corrected(roi: Floats, slope: Any) -> Floats:
    return np.square(slope) / (roi[..., 1] - roi[..., 0]).var(-1, ddof=1)


def _squared_cnr(roi: Floats, slope: Any) -> Floats:
    mean, variance = roi.mean(-2), roi.var(-2, ddof=1)
    return np.square(mean[..., 1] - mean[..., 0]) / variance.sum(-1)


_PAIRED = {"contrast_variance": _slope_corrected, "paper_cnr": _squared_cnr}


Sample = tuple[Floats, ContrastSlope]
"""ROI means ``(n, 2)`` of a method, and its contrast slope on the same noise."""


def _resampled_ratio(figure: str, first: Sample, second: Sample) -> tuple[float, Floats, Floats]:
    """The ratio of two methods' figures, of bootstrap samples, and its logarithm with one realisation left out."""
    of, (a, slope_a), (b, slope_b) = _PAIRED[figure], first, second
    n = len(a)

    def ratio(index: Any, slopes: tuple[Any, Any]) -> Floats:
        with np.errstate(divide="ignore", invalid="ignore"):
            return of(a[index], slopes[0]) / of(b[index], slopes[1])

    value = float(ratio(np.arange(n)[None], (slope_a.value, slope_b.value))[0])
    with np.errstate(divide="ignore"):
        jackknife = np.log(ratio(leave_one_out(n), (slope_a.jackknife, slope_b.jackknife)))
    return value, ratio(resampling(n, DRAWS, 0), (slope_a.draws, slope_b.draws)), jackknife


def paired_ratio(figure: str, first: Sample, second: Sample) -> Any:
    """Dose factor of one method against another, both resampled together.

    Args:
        figure: ``"contrast_variance"`` or ``"paper_cnr"``.
        first, second: of the two methods, on the same noise.
    """
    value, draws, jackknife = _resampled_ratio(figure, first, second)
    return estimate((value, *bca_interval(value, draws, jackknife)))


def kept(figure: str, here: tuple[Sample, Sample], there: tuple[Sample, Sample]) -> Any:
    """Share of a dose factor (:func:`paired_ratio`) in one place that is left in another, all resampled together.

    Args:
        figure: as there.
        here, there: the two methods in the place asked for and in the place compared with.
    """
    (a, drawn_a, left_a), (b, drawn_b, left_b) = (_resampled_ratio(figure, *pair) for pair in (here, there))
    return estimate((a / b, *bca_interval(a / b, drawn_a / drawn_b, left_a - left_b)))
