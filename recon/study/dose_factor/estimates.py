"""Estimates with intervals as JSON values."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchpcct.metrics import DoseCurve, dose_factor
from torchpcct.metrics.bootstrap import bca_interval, leave_one_out, resampling

__all__ = [
    "DRAWS",
    "attempt",
    "controlled",
    "estimate",
    "factor",
    "observer_factor",
    "paired",
    "sd_of",
    "slope_corrected",
    "squared_cnr",
]

Floats = NDArray[np.float64]

DRAWS = 2000
"""Of every bootstrap."""


def estimate(value: Any) -> dict[str, float | None]:
    v, low, high = (float(x) for x in (value[0], value[1], value[2]))
    return {k: (x if math.isfinite(x) else None) for k, x in (("value", v), ("low", low), ("high", high))}


def attempt(compute: Callable[[], Any]) -> Any:
    """The figure, or why there is none."""
    try:
        return compute()
    except ValueError as error:
        return {"value": None, "low": None, "high": None, "why": str(error)}


def factor(samples: Any, curve: DoseCurve, figure: str, slope: Any = 1.0) -> Any:
    def compute() -> Any:
        f = dose_factor(samples, curve, figure, slope=slope, draws=DRAWS)
        return {**estimate(f), "text": str(f)}

    return attempt(compute)


def observer_factor(scores: Any, curve: DoseCurve, figure: str) -> Any:
    if scores is None:
        return {"value": None, "low": None, "high": None, "why": "too few realisations"}
    if figure == "auc" and float(scores[:, 1].min()) > float(scores[:, 0].max()):
        return {"value": None, "low": None, "high": None, "why": "AUC is 1: look at d′"}
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


def sd_of(reached: dict[str, Any], ideal: float) -> dict[str, Any]:
    """Slope-corrected SD from an efficiency: the ends change places."""

    def turned(name: str) -> float | None:
        return ideal / math.sqrt(reached[name]) if reached.get(name) else None

    return {"value": turned("value"), "low": turned("high"), "high": turned("low")}


def slope_corrected(roi: Floats, slope: Any) -> Floats:
    return np.square(slope) / (roi[..., 1] - roi[..., 0]).var(-1, ddof=1)


def squared_cnr(roi: Floats, slope: Any) -> Floats:
    mean, variance = roi.mean(-2), roi.var(-2, ddof=1)
    return np.square(mean[..., 1] - mean[..., 0]) / variance.sum(-1)


def paired(pair: Any, n: int, figure: Callable[[Floats, Any], Floats]) -> dict[str, float | None]:
    (a, slope_a), (b, slope_b) = pair

    def ratio(index: Any, draws: bool | None) -> Floats:
        slopes = [{None: s.value, True: s.draws, False: s.jackknife}[draws] for s in (slope_a, slope_b)]
        with np.errstate(divide="ignore", invalid="ignore"):
            return figure(a[index], slopes[0]) / figure(b[index], slopes[1])

    value = float(ratio(np.arange(n)[None], None)[0])
    with np.errstate(divide="ignore"):
        jackknife = np.log(ratio(leave_one_out(n), False))
    return estimate((value, *bca_interval(value, ratio(resampling(n, DRAWS, 0), True), jackknife)))
