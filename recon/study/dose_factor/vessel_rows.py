"""Figures of the vessels of any direction: contrast, false contrast, noise in fat, gain over a linear filter."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.study.dose_factor.estimates import attempt, estimate, mean_of, none
from recon.study.dose_factor.paired import Sample, controlled, kept, paired_ratio, slope_of
from recon.study.dose_factor.settings import VESSEL_ROIS, VESSELS

__all__ = ["REFERENCE", "vessel_rows"]

Floats = NDArray[np.float64]
Pieces = Mapping[tuple[str, str, float], dict[str, Any]]

REFERENCE = "linear"
"""The method that gains are quoted against, and whose noise-free readings are the control of all means."""


def vessel_rows(samples: Pieces, true_contrast_hu: float) -> list[dict[str, Any]]:
    """Every vessel at every dose with every method, for both pairs of ROIs.

    Args:
        samples: (method, vessel, dose) → ``roi (n, rois, 2)``, ``absent (k, rois, 2)`` of the first k, ``fat (n,
            voxels)`` in HU, and of linear filters ``expected (1, 2, rois, 2)``, see
            :class:`recon.study.dose_factor.vessels.VesselScans`.
        true_contrast_hu: fibrous tissue less core.
    """
    return [
        _row(samples, key, roi, true_contrast_hu)
        for roi in range(len(VESSEL_ROIS)) for key in samples
    ]  # fmt: skip


def _row(samples: Pieces, key: tuple[str, str, float], roi: int, true_contrast_hu: float) -> dict[str, Any]:
    (method, name, dose), entry = key, samples[key]
    means, slope = _sample(entry, roi, true_contrast_hu)
    contrast = means[:, 1] - means[:, 0]
    mean = _mean(entry, samples.get((REFERENCE, name, dose)), contrast, roi)
    # Without the core, on all draws: what the core adds is taken off.
    added = slope.value * true_contrast_hu
    false = {k: None if v is None else v - added for k, v in mean.items()}

    def against(vessel: str) -> tuple[Sample, Sample] | None:
        pair = [samples.get((m, vessel, dose)) for m in (method, REFERENCE)]
        if method == REFERENCE or pair[0] is None or pair[1] is None:
            return None
        first, second = (_sample(e, roi, true_contrast_hu) for e in pair if e is not None)
        return first, second

    here, straight = against(name), against(VESSELS[0])
    return {
        "roi": VESSEL_ROIS[roi], "vessel": name, "exposure_s": dose, "method": method, "realizations": len(means),
        "true_contrast_hu": true_contrast_hu, "contrast_hu": mean, "contrast_sd_raw_hu": float(contrast.std(ddof=1)),
        "false_contrast_hu": false, "slope": estimate((slope.value, slope.low, slope.high)),
        "fat_sd_hu": _noise(entry["fat"]),
        "to_linear": none("nothing to compare with")
        if here is None
        else attempt(lambda: paired_ratio(*here)),
        "kept": none("nothing to compare with")
        if here is None or straight is None or name == VESSELS[0]
        else attempt(lambda: kept(here, straight)),
    }  # fmt: skip


def _sample(entry: dict[str, Any], roi: int, true_contrast_hu: float) -> Sample:
    """All ROI means, and the slope of the realisations that have a twin, as one of all realisations."""
    means, absent = (entry[k][:, roi].astype(np.float64) for k in ("roi", "absent"))
    slope = slope_of(np.array([true_contrast_hu, 0.0]), [means[: len(absent)], absent])
    # A realisation without a twin leaves the slope as it is.
    rest = np.full(len(means) - len(absent), slope.value)
    return means, replace(slope, jackknife=np.concatenate([slope.jackknife, rest]))


def _mean(entry: dict[str, Any], linear: dict[str, Any] | None, contrast: Floats, roi: int) -> dict[str, float | None]:
    """Mean contrast: exact of a linear filter, with the linear filter's as control variate of others."""
    if "expected" in entry:
        core, fibrous = entry["expected"][0, 0, roi]
        return {"value": float(fibrous - core), "low": None, "high": None}
    if linear is None or len(linear["roi"]) != len(contrast):
        return mean_of(contrast)
    control = np.diff(linear["roi"][:, roi].astype(np.float64))
    return mean_of(controlled(contrast[:, None], control, np.diff(linear["expected"][0, 0, roi]))[:, 0])


def _noise(fat: Any) -> dict[str, float | None]:
    """SD of a voxel over the realisations, root mean square over voxels."""
    values = fat.astype(np.float64)
    n = len(values)
    found = mean_of(np.square(values - values.mean(0)).mean(1) * (n / (n - 1)))
    return {k: None if v is None else float(np.sqrt(max(v, 0.0))) for k, v in found.items()}
