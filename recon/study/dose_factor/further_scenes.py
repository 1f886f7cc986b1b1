"""Figures of the further scenes: what FBP and the methods see where something may be invented."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from recon.study.dose_factor.estimates import estimate, mean_of, paper_cnr
from recon.study.dose_factor.exact import Exact, contrast_sd
from recon.study.dose_factor.scene import SceneFacts
from torchpcct.metrics import auc, auc_from_d_prime, roi_bias

__all__ = ["scene_rows"]

_NO_CONTRAST_HU = 1.0
"""A scene of less true contrast has no core to see: what is seen is false."""


def scene_rows(exact: Exact) -> list[dict[str, Any]]:
    """Every further scene at every dose: FBP, then the methods."""
    rows = []
    for name in exact.m.scenes:
        for dose in exact.s.scene_doses:
            rows.append(_fbp_row(exact, name, dose))
            rows += [
                _method_row(exact, k, name, dose) for k in exact.s.scene_methods if (k, name, dose) in exact.m.extra
            ]
    return rows


def _head(facts: SceneFacts, name: str, dose: float, method: str) -> dict[str, Any]:
    return {
        "scene": name, "exposure_s": dose, "method": method,
        "truth_hu": facts.truth_hu.tolist(), "true_contrast_hu": facts.contrast_hu,
    }  # fmt: skip


def _fbp_row(exact: Exact, name: str, dose: float) -> dict[str, Any]:
    facts, twin = exact.facts[name], exact.facts.get(f"{name}:absent")
    c = facts.fbp_covariance[exact.base] / dose
    sd = contrast_sd(c)
    fg, bg = facts.fbp_hu[exact.base]
    row = {
        **_head(facts, name, dose, f"FBP {exact.base}"), "exact": True,
        "bias_hu": [{"value": float(v)} for v in (fg, bg) - facts.truth_hu],
        "contrast_hu": {"value": float(bg - fg)}, "contrast_sd_raw_hu": sd,
        "paper_cnr": {"value": float((bg - fg) / math.sqrt(c[0, 0] + c[1, 1]))},
    }  # fmt: skip
    if twin is not None:
        without = twin.fbp_contrast(exact.base)
        row["false_contrast_hu"] = {"value": without}
        row["auc"] = {"value": auc_from_d_prime(abs(bg - fg - without) / sd)}
    elif abs(facts.contrast_hu) < _NO_CONTRAST_HU:
        row["false_contrast_hu"] = row["contrast_hu"]
    return row


def _method_row(exact: Exact, method: str, name: str, dose: float) -> dict[str, Any]:
    facts, entry = exact.facts[name], exact.m.extra[method, name, dose]
    roi = entry["roi"].astype(np.float64)
    contrast = roi[:, 1] - roi[:, 0]
    row = {
        **_head(facts, name, dose, method), "exact": False, "realizations": len(roi),
        "bias_hu": [estimate(e) for e in roi_bias(roi, facts.truth_hu)],
        "contrast_hu": mean_of(contrast), "contrast_sd_raw_hu": float(contrast.std(ddof=1)),
        "paper_cnr": paper_cnr(roi),
    }  # fmt: skip
    if "absent" in entry:
        without = entry["absent"].astype(np.float64)
        false = without[:, 1] - without[:, 0]
        sign = 1.0 if facts.contrast_hu > 0 else -1.0
        row["false_contrast_hu"] = mean_of(false)
        row["auc"] = estimate(auc(sign * contrast, sign * false))
    elif abs(facts.contrast_hu) < _NO_CONTRAST_HU:
        row["false_contrast_hu"] = row["contrast_hu"]
    return row
