"""Figures of the vessels of any direction: contrast, false contrast, noise in fat, gain over a linear filter."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.study.dose_factor.estimates import Sample, attempt, estimate, kept, mean_of, none, paired_ratio, slope_of
from recon.study.dose_factor.settings import VESSELS

__all__ = ["REFERENCE", "vessel_rows"]

Floats = NDArray[np.float64]

REFERENCE = "linear"
"""The method that gains are quoted against."""

_FIGURE = "contrast_variance"


def vessel_rows(samples: Mapping[tuple[str, str, float], dict[str, Any]], true_contrast_hu: float) -> list[Any]:
    """Every vessel at every dose with every method.

    Args:
        samples: (method, vessel, dose) → ``roi`` and ``absent`` ``(n, 2)``, ``fat (n, voxels)`` in HU.
        true_contrast_hu: fibrous tissue less core.
    """
    found = {key: _sample(entry, true_contrast_hu) for key, entry in samples.items()}

    def against(method: str, name: str, dose: float) -> tuple[Sample, Sample] | None:
        pair = found.get((method, name, dose)), found.get((REFERENCE, name, dose))
        return None if pair[0] is None or pair[1] is None else (pair[0], pair[1])

    rows = []
    for (method, name, dose), entry in samples.items():
        means, slope = found[method, name, dose]
        contrast = means[:, 1] - means[:, 0]
        false = np.diff(entry["absent"].astype(np.float64))[:, 0]
        here, straight = against(method, name, dose), against(method, VESSELS[0], dose)
        own = method == REFERENCE
        rows.append({
            "vessel": name, "exposure_s": dose, "method": method, "realizations": len(means),
            "true_contrast_hu": true_contrast_hu, "contrast_hu": mean_of(contrast),
            "contrast_sd_raw_hu": float(contrast.std(ddof=1)), "false_contrast_hu": mean_of(false),
            "slope": estimate((slope.value, slope.low, slope.high)), "fat_sd_hu": _noise(entry["fat"]),
            "to_linear": _factor(None if own else here),
            "kept": _kept(None if own else here, straight, name),
        })  # fmt: skip
    return rows


def _sample(entry: dict[str, Any], true_contrast_hu: float) -> Sample:
    roi, absent = (entry[k].astype(np.float64) for k in ("roi", "absent"))
    return roi, slope_of(np.array([true_contrast_hu, 0.0]), [roi, absent])


def _noise(fat: Any) -> dict[str, float | None]:
    """SD of a voxel over the realisations, root mean square over voxels."""
    values = fat.astype(np.float64)
    n = len(values)
    square = np.square(values - values.mean(0)).mean(1) * (n / (n - 1))
    found = mean_of(square)
    return {k: None if v is None else float(np.sqrt(max(v, 0.0))) for k, v in found.items()}


def _factor(here: tuple[Sample, Sample] | None) -> Any:
    if here is None:
        return none("no other linear filter to compare with")
    return attempt(lambda: paired_ratio(_FIGURE, *here))


def _kept(here: tuple[Sample, Sample] | None, straight: tuple[Sample, Sample] | None, name: str) -> Any:
    if here is None or straight is None or name == VESSELS[0]:
        return none("nothing to compare with")
    return attempt(lambda: kept(_FIGURE, here, straight))
