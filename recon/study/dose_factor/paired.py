"""Figures of methods that reconstructed the same noise: ratios and what is kept of them, resampled together."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.study.dose_factor.estimates import estimate
from torchpcct.metrics import ContrastSlope, contrast_slope
from torchpcct.metrics.bootstrap import bca_interval, leave_one_out, resampling

__all__ = ["DRAWS", "Sample", "controlled", "kept", "paired_ratio", "slope_of"]

Floats = NDArray[np.float64]

DRAWS = 2000
"""Of every bootstrap."""


def slope_of(truth: Floats, rois: list[Floats], draws: int = DRAWS) -> ContrastSlope:
    """Contrast slope over the main scenes, from the ROI means ``(n, 2)`` in each."""
    return contrast_slope(truth, np.stack([r[:, 1] - r[:, 0] for r in rois]), draws=draws)


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


Sample = tuple[Floats, ContrastSlope]
"""ROI means ``(n, 2)`` of a method, and its contrast slope on the same noise."""


def _resampled_ratio(first: Sample, second: Sample) -> tuple[float, Floats, Floats]:
    """The second's slope-corrected contrast variance over the first's, that of bootstrap samples, and its logarithm
    with one realisation left out."""
    (a, slope_a), (b, slope_b) = first, second
    n = len(a)

    def ratio(index: Any, slopes: tuple[Any, Any]) -> Floats:
        with np.errstate(divide="ignore", invalid="ignore"):
            return _slope_corrected(a[index], slopes[0]) / _slope_corrected(b[index], slopes[1])

    value = float(ratio(np.arange(n)[None], (slope_a.value, slope_b.value))[0])
    with np.errstate(divide="ignore"):
        jackknife = np.log(ratio(leave_one_out(n), (slope_a.jackknife, slope_b.jackknife)))
    return value, ratio(resampling(n, DRAWS, 0), (slope_a.draws, slope_b.draws)), jackknife


def paired_ratio(first: Sample, second: Sample) -> Any:
    """Dose factor by contrast variance of one method against another, both resampled together.

    Args:
        first, second: of the two methods, on the same noise.
    """
    value, draws, jackknife = _resampled_ratio(first, second)
    return estimate((value, *bca_interval(value, draws, jackknife)))


def kept(here: tuple[Sample, Sample], there: tuple[Sample, Sample]) -> Any:
    """Share of a dose factor (:func:`paired_ratio`) in one place that is left in another, all resampled together.

    Args:
        here, there: the two methods in the place asked for and in the place compared with.
    """
    (a, drawn_a, left_a), (b, drawn_b, left_b) = (_resampled_ratio(*pair) for pair in (here, there))
    return estimate((a / b, *bca_interval(a / b, drawn_a / drawn_b, left_a - left_b)))
