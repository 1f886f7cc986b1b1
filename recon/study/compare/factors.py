"""Dose factors: how many times the dose of a method the reference FBP needs for the same figure.

FBP's covariance is exact and falls as the inverse of the dose, so its figure at any dose is known: the factor by a
variance is FBP's over the method's at the same dose, the factor by the CNR is the squared ratio of both CNRs.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from recon.study.compare.draws import Draws
from recon.study.compare.reference import KERNEL, VOXEL_MM, Reference
from recon.study.compare.regions import PAIRS
from torchpcct.metrics import (
    Estimate,
    combined,
    controlled_cnr,
    controlled_log_variance,
    controlled_mean,
    variance_factor,
)
from torchpcct.metrics.jackknife import log_of_sum

__all__ = ["dose_factors", "reference_entry"]

_CONTRAST = np.array([-1.0, 1.0])


def _values(estimate: Estimate) -> dict[str, float]:
    return {k: float(v) for k, v in estimate._asdict().items()}


def _contrast_moments(reference: Reference, pair: tuple[int, int]) -> tuple[float, float, float]:
    """Contrast with and without the core in HU, variance at 1 s."""
    chosen = list(pair)
    covariance = reference.covariance[np.ix_(chosen, chosen)]
    return (
        float(_CONTRAST @ reference.means[chosen]),
        float(_CONTRAST @ reference.absent[chosen]),
        float(_CONTRAST @ covariance @ _CONTRAST),
    )


def _cnr(reference: Reference, exposure_s: float) -> float:
    (fg, bg), variances = reference.means[:2], np.diag(reference.covariance)[:2]
    return float((bg - fg) / math.sqrt(variances.sum() / exposure_s))


def reference_entry(reference: Reference, exposure_s: float, truth_hu: float) -> dict[str, Any]:
    """The reference FBP at an exposure, in the form of :func:`dose_factors`, exact: numbers without interval.

    Args:
        reference: exact figures.
        exposure_s: in s.
        truth_hu: true contrast, fibrous tissue minus core.
    """
    contrasts = {}
    for name, pair in PAIRS.items():
        present, absent, variance = _contrast_moments(reference, pair)
        contrasts[name] = {
            "sd_hu": math.sqrt(variance / exposure_s),
            "slope": (present - absent) / truth_hu,
            "bias_hu": present - truth_hu,
            "false_contrast_hu": absent,
        }
    return {
        "method": "fbp", "kernel": KERNEL, "voxel_mm": VOXEL_MM, "exposure_s": exposure_s,
        "fat_sd_hu": math.sqrt(reference.fat_variance / exposure_s), "fat_spread": reference.fat_spread,
        "paper_cnr": _cnr(reference, exposure_s), "contrast": contrasts,
    }  # fmt: skip


def dose_factors(draws: Draws, reference: Reference, truth_hu: float) -> dict[str, Any]:
    """Figures of a method at the exposure of its draws, and its dose factors against the reference FBP.

    Args:
        draws: of the method.
        reference: exact figures of FBP.
        truth_hu: true contrast, fibrous tissue minus core.

    Returns:
        ``fat_sd_hu``, ``paper_cnr`` and, for every contrast, ``sd_hu``, ``slope``, ``bias_hu``, ``false_contrast_hu``
        as ``{"value", "low", "high"}`` (95 %), the factors ``fat_factor``, ``paper_cnr_factor`` and, of the
        slope-corrected variance, ``contrast/…/factor``; ``correlation`` with the control.
    """
    exposure = draws.exposure_s
    control, x = draws.control, draws.controls
    log_fat = log_of_sum(draws.fat, lost=1)
    entry: dict[str, Any] = {
        "exposure_s": exposure,
        "realizations": len(draws.means),
        "controlled": control is not None,
        "fat_sd_hu": _values(log_fat.exponential(scale=0.5)),
        "fat_factor": _values(variance_factor(log_fat, reference.fat_variance / exposure)),
    }
    first = np.s_[:2]
    known = (None, None, None)
    if control is not None and x is not None:
        known = (x[:, first], control.mean[first], control.covariance[first, first])  # type: ignore[assignment]
    cnr = controlled_cnr(draws.means[:, 0], draws.means[:, 1], *known).estimate()
    of_fbp = _cnr(reference, exposure)
    entry["paper_cnr"] = _values(cnr)
    entry["paper_cnr_factor"] = _values(Estimate(*((max(v, 0.0) / of_fbp) ** 2 for v in cnr)))
    entry["contrast"] = {}
    for name, pair in PAIRS.items():
        chosen = list(pair)
        y, without = (m[:, chosen] @ _CONTRAST for m in (draws.means, draws.absent))
        xc = mean = variance = None
        if control is not None and x is not None:
            xc, mean = x[:, chosen] @ _CONTRAST, float(_CONTRAST @ control.mean[chosen])
            variance = float(_CONTRAST @ control.covariance[np.ix_(chosen, chosen)] @ _CONTRAST)
        log_variance = controlled_log_variance(y, xc, variance)
        # The twin has the same noise: the same control serves it.
        present, absent = (controlled_mean(v, xc, mean) for v in (y, without))
        slope = combined(lambda p, a: (p - a) / truth_hu, present, absent)
        fbp_present, fbp_absent, fbp_variance = _contrast_moments(reference, pair)
        entry["contrast"][name] = {
            "sd_hu": _values(log_variance.exponential(scale=0.5)),
            "slope": _values(slope.estimate()),
            "bias_hu": _values(combined(lambda p: p - truth_hu, present).estimate()),
            "false_contrast_hu": _values(absent.estimate()),
            "factor": _values(
                variance_factor(log_variance, fbp_variance / exposure, slope, (fbp_present - fbp_absent) / truth_hu)
            ),
            "correlation": None if xc is None else float(np.corrcoef(y, xc)[0, 1]),
        }
    return entry
