"""Figures of the further scenes: what FBP and the methods see where something may be invented."""

from __future__ import annotations

from typing import Any

from recon.study.dose_factor.exact import Exact
from recon.study.dose_factor.merit import attempt, joint, json_of
from recon.study.dose_factor.scene import SceneFacts
from recon.study.dose_factor.seen import Seen

__all__ = ["scene_rows"]

_NO_CONTRAST_HU = 1.0
"""A scene of less true contrast has no core to see: what is seen is false."""


def scene_rows(exact: Exact) -> list[dict[str, Any]]:
    """Every further scene at every dose: FBP, then the methods."""
    rows = []
    for name in exact.m.scenes:
        for dose in exact.s.scene_doses:
            rows.append(_row(exact.facts[name], name, dose, f"FBP {exact.base}", _fbp(exact, name, dose)))
            rows += [
                _row(exact.facts[name], name, dose, k, Seen.of(exact.m.extra[k, name, dose]))
                for k in exact.s.scene_methods if (k, name, dose) in exact.m.extra
            ]  # fmt: skip
    return rows


def _fbp(exact: Exact, name: str, dose: float) -> Seen:
    facts, twin = exact.facts[name], exact.facts.get(f"{name}:absent")
    assert facts.fbp_covariance is not None
    return Seen.of_moments(facts.fbp_hu, facts.fbp_covariance / dose, None if twin is None else twin.fbp_hu)


def _row(facts: SceneFacts, name: str, dose: float, method: str, seen: Seen) -> dict[str, Any]:
    contrast = json_of(seen.contrast)
    row = {
        "scene": name, "exposure_s": dose, "method": method, "realizations": seen.realizations,
        "truth_hu": facts.truth_hu.tolist(), "true_contrast_hu": facts.contrast_hu,
        "bias_hu": [
            json_of(joint(lambda v, t=t: v - t, figure))
            for figure, t in zip((seen.core, seen.fibrous), facts.truth_hu.tolist(), strict=True)
        ],
        "contrast_hu": contrast, "contrast_sd_hu": json_of(seen.log_contrast, 0.5), "paper_cnr": seen.cnr(),
    }  # fmt: skip
    if seen.absent is not None:
        row["false_contrast_hu"] = json_of(seen.absent)
        row["slope"] = attempt(lambda: json_of(seen.slope(facts.contrast_hu)))
        row["auc"] = attempt(lambda: seen.auc(1.0 if facts.contrast_hu > 0 else -1.0))
    elif abs(facts.contrast_hu) < _NO_CONTRAST_HU:
        row["false_contrast_hu"] = contrast
    return row
