"""Figures beyond the main scenes and the paper's ROIs: wider ROIs, larger voxels, further scenes."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from recon.study.dose_factor.estimates import estimate, factor, sd_of
from recon.study.dose_factor.rois import OTHER_VOXELS_MM, OtherVoxels, Wide, sd_at
from torchpcct.metrics import auc, auc_from_d_prime, cnr, cnr_interval, mean_interval, roi_bias

if TYPE_CHECKING:
    from recon.study.dose_factor.analysis import Analysis

__all__ = ["Further"]

Floats = NDArray[np.float64]


class Further:
    """Figures of the study beyond the main scenes and the paper's ROIs.

    Args:
        analysis: of the main scenes; its truth, limits and FBP variants are used here, too.
    """

    def __init__(self, analysis: Analysis) -> None:
        self.m, self.s, self.facts, self.paper = analysis.m, analysis.s, analysis.facts, analysis.paper
        self.scene, self.truth = analysis.scene, analysis.truth
        self.base, self.variants = analysis.base, analysis.variants
        self.limits, self.reached = analysis.limits, analysis.reached

    # -- wider ROIs -----------------------------------------------------------------------------------------------

    def wide(self, name: str) -> dict[str, Any]:
        """Figures of every FBP variant and method in a wider ROI, at every dose."""
        wide = Wide(self.m, self.scene, name, self.truth)
        rows: list[dict[str, Any]] = []
        for dose in self.s.doses:
            limits, curves = self.limits(dose), wide.base_curves(dose)
            for kernel, voxel, _ in self.variants:
                f = wide.fbp(kernel, voxel)
                sd, c = sd_at(f["covariance"], dose), f["covariance"] / dose
                own = float(f["roi_hu"][1] - f["roi_hu"][0]) / math.sqrt(c[0, 0] + c[1, 1])
                rows.append({
                    "method": f"FBP {f['label']}", "exposure_s": dose, "exact": True, "slope": {"value": f["slope"]},
                    "contrast_sd_hu": {"value": sd / f["slope"]}, "paper_cnr": {"value": own},
                    "efficiency": {"value": (limits["contrast_sd_hu"] * f["slope"] / sd) ** 2},
                    "limit_factors": {
                        "paper_cnr": (limits["paper_cnr"] / own) ** 2,
                        "contrast_variance": (sd / f["slope"] / limits["contrast_sd_hu"]) ** 2,
                    },
                })  # fmt: skip
            for method in self.m.methods:
                roi, slope = wide.samples(method, dose)
                reached = self.reached(roi, slope, dose)
                rows.append({
                    "method": method, "exposure_s": dose, "exact": False, "realizations": len(roi),
                    "slope": estimate((slope.value, slope.low, slope.high)),
                    "efficiency": reached, "contrast_sd_hu": sd_of(reached, limits["contrast_sd_hu"]),
                    "paper_cnr": estimate((cnr(roi[:, 0], roi[:, 1]), *cnr_interval(roi[:, 0], roi[:, 1]))),
                    "factors": {
                        "paper_cnr": factor(roi, curves["paper_cnr"], "paper_cnr"),
                        "contrast_variance": factor(roi, curves["contrast_variance"], "contrast_variance", slope),
                    },
                })  # fmt: skip
        return {"roi": name, **wide.rois.as_dict(), "rows": rows}

    def other_voxels(self) -> list[dict[str, Any]]:
        """MBIR's figures in the paper's ROIs on larger voxels."""
        rows: list[dict[str, Any]] = []
        if "mbir" not in self.m.methods:
            return rows
        for voxel in (self.s.voxel_mm, *(v for v in OTHER_VOXELS_MM if v > self.s.voxel_mm)):
            rois = OtherVoxels(self.m, self.scene, voxel, self.truth)
            for dose in self.s.doses:
                roi, slope = rois.samples("mbir", dose)
                reached = self.reached(roi, slope, dose)
                rows.append({
                    "voxel_mm": voxel, "exposure_s": dose, "slope": estimate((slope.value, slope.low, slope.high)),
                    "bias_hu": [estimate(e) for e in roi_bias(roi, self.paper.truth_hu)],
                    "contrast_sd_hu": sd_of(reached, self.limits(dose)["contrast_sd_hu"]), "efficiency": reached,
                    "paper_cnr": estimate((cnr(roi[:, 0], roi[:, 1]), *cnr_interval(roi[:, 0], roi[:, 1]))),
                })  # fmt: skip
        return rows

    # -- further scenes -------------------------------------------------------------------------------------------

    def scenes(self) -> list[dict[str, Any]]:
        rows = []
        for name in self.m.scenes:
            facts = self.facts[name]
            twin = self.facts.get(f"{name}:absent")
            for dose in self.s.scene_doses:
                c = facts.fbp_covariance[self.base] / dose
                variance = float(c[0, 0] + c[1, 1] - 2 * c[0, 1])
                fg, bg = facts.fbp_hu[facts.labels.index(self.base)]
                row: dict[str, Any] = {
                    "scene": name, "exposure_s": dose, "method": f"FBP {self.base}", "exact": True,
                    "truth_hu": facts.truth_hu.tolist(), "true_contrast_hu": facts.contrast_hu,
                    "bias_hu": [{"value": float(v)} for v in (fg, bg) - facts.truth_hu],
                    "contrast_hu": {"value": float(bg - fg)}, "contrast_sd_raw_hu": math.sqrt(variance),
                    "paper_cnr": {"value": float((bg - fg) / math.sqrt(c[0, 0] + c[1, 1]))},
                }  # fmt: skip
                if twin is not None:
                    without = twin.fbp_contrast(self.base)
                    row["false_contrast_hu"] = {"value": without}
                    row["auc"] = {"value": auc_from_d_prime(abs(bg - fg - without) / math.sqrt(variance))}
                elif abs(facts.contrast_hu) < 1.0:
                    row["false_contrast_hu"] = row["contrast_hu"]
                rows.append(row)
                for method in self.m.methods:
                    if (method, name, dose) in self.m.extra:
                        rows.append(self._scene(method, name, dose))
        return rows

    def _scene(self, method: str, name: str, dose: float) -> dict[str, Any]:
        facts, entry = self.facts[name], self.m.extra[method, name, dose]
        roi = entry["roi"].astype(np.float64)
        contrast = roi[:, 1] - roi[:, 0]
        row: dict[str, Any] = {
            "scene": name, "exposure_s": dose, "method": method, "exact": False, "realizations": len(roi),
            "truth_hu": facts.truth_hu.tolist(), "true_contrast_hu": facts.contrast_hu,
            "bias_hu": [estimate(e) for e in roi_bias(roi, facts.truth_hu)],
            "contrast_hu": estimate((contrast.mean(), *mean_interval(contrast))),
            "contrast_sd_raw_hu": float(contrast.std(ddof=1)),
            "paper_cnr": estimate((cnr(roi[:, 0], roi[:, 1]), *cnr_interval(roi[:, 0], roi[:, 1]))),
        }  # fmt: skip
        if "absent" in entry:
            without = entry["absent"].astype(np.float64)
            false = without[:, 1] - without[:, 0]
            row["false_contrast_hu"] = estimate((false.mean(), *mean_interval(false)))
            sign = 1.0 if facts.contrast_hu > 0 else -1.0
            row["auc"] = estimate(auc(sign * contrast, sign * false))
        elif abs(facts.contrast_hu) < 1.0:
            row["false_contrast_hu"] = row["contrast_hu"]
        return row
