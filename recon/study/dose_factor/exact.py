"""What the report starts from: true values, the limit of the data, FBP and its figures at every exposure."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.study.dose_factor.figures_found import drawn_figures, exact_figures
from recon.study.dose_factor.measure import Measured
from recon.study.dose_factor.measures import OBSERVERS
from recon.study.dose_factor.merit import Figures, entry_of, factors_of, json_of
from recon.study.dose_factor.readings import BIN_MM, REACH_MM
from recon.study.dose_factor.settings import FBP_BASE, LINEAR_METHODS, MAIN_SCENES, ROIS, fbp_label
from recon.study.dose_factor.variant import Variant
from torchpcct.metrics import LinearReference, NoiseCovariance, ceiling, paper_cnr_ceiling, task_transfer

__all__ = ["Exact"]

Floats = NDArray[np.float64]


class Exact:
    """Entries of the report.

    Args:
        measured: of the study.

    Attributes:
        m, s, facts: of the study; paper: facts of the paper's scene.
        variant: where things are in it.
        truth: main scene → true values of core and fibrous tissue, HU.
        base: label of the reference FBP.
    """

    def __init__(self, measured: Measured) -> None:
        self.m, self.s, self.facts = measured, measured.settings, measured.facts
        self.paper = self.facts["paper"]
        self.variant = Variant("paper", self.s)
        self.truth = {name: self.facts[name].truth_hu for name in MAIN_SCENES}
        self.base = fbp_label(*FBP_BASE)

    @property
    def difference(self) -> float:
        """True contrast with the core less that without, HU."""
        return self.paper.contrast_hu - self.facts["absent_core"].contrast_hu

    def true_values(self) -> dict[str, Any]:
        """Tissues, contrasts and shapes as they are."""
        plaque = self.variant.plaque
        return {
            "tissues_hu": self.paper.tissue_hu,
            "reference_hu": self.paper.reference_hu.tolist(),
            "contrasts_hu": {name: self.facts[name].contrast_hu for name in MAIN_SCENES},
            "lumen_mm2": float(plaque.area("lumen", 0.0)),
            "cap_mm": float(plaque.cap_thickness),
        }

    # -- limit of the data ----------------------------------------------------------------------------------------

    def limits(self, dose: float) -> dict[str, float]:
        """Figures of the best unbiased estimate at an exposure, the surrounding fat known from the rest of the scan."""
        keep = [k for k, t in enumerate(self.paper.tissues) if t != "patient"]
        information = self.paper.information[np.ix_(keep, keep)]
        names = [self.paper.tissues[k] for k in keep]
        values = np.array([self.paper.tissue_hu[name] for name in names])
        core, fibrous = names.index("core"), names.index("fibrous")
        h = np.zeros(len(keep))
        h[core], h[fibrous] = -1.0, 1.0
        full = np.zeros(len(self.paper.tissues))
        full[self.paper.tissue("core")], full[self.paper.tissue("fibrous")] = -1.0, 1.0
        return {
            "contrast_sd_hu": ceiling(information, h, dose).contrast_sd,
            "contrast_sd_fat_unknown_hu": ceiling(self.paper.information, full, dose).contrast_sd,
            "paper_cnr": paper_cnr_ceiling(information, values, core, fibrous, dose),
            # The ideal observer knows everything but whether the core is there.
            "d_prime": abs(self.difference) * math.sqrt(information[core, core] * dose),
        }

    def limit_entry(self, dose: float) -> dict[str, Any]:
        """The limit, and the largest dose factors that it allows against the reference FBP."""
        limits, fbp = self.limits(dose), self._fbp(self.base, dose)
        factors: dict[str, float] = {
            f"d_prime_{o}": limits["d_prime"] ** 2 / math.exp(_number(fbp.log_detectability[o])) for o in OBSERVERS
        }
        for k, name in enumerate(ROIS):
            variance = math.exp(_number(fbp.log_corrected(k, self.difference)))
            factors[f"contrast_{name}"] = variance / limits["contrast_sd_hu"] ** 2
        factors["paper_cnr"] = limits["paper_cnr"] ** 2 / math.exp(_number(fbp.log_cnr))
        return {"exposure_s": dose, **limits, "factors": factors}

    def shape_limit_entries(self) -> list[dict[str, float]]:
        """The limit with outlines that are only roughly known: its share of the one with known shapes, and the largest
        factor against the reference FBP by the contrast of all tissue."""
        rows = []
        for dose, sds in self.m.shape_limits.items():
            ideal = self.limits(dose)["contrast_sd_hu"]
            fbp = self._fbp(self.base, dose)
            base = math.exp(0.5 * _number(fbp.log_corrected(ROIS.index("tissue"), self.difference)))
            for displacement, sd in sds.items():
                rows.append({
                    "exposure_s": dose, "displacement_mm": displacement, "contrast_sd_hu": sd,
                    "share": (ideal / sd) ** 2, "factor": (base / sd) ** 2,
                })  # fmt: skip
        return rows

    # -- methods --------------------------------------------------------------------------------------------------

    def _fbp(self, label: str, dose: float) -> Figures:
        return exact_figures(self.m.fbp[label], self.m, "fbp", self.truth, dose)

    def figures(self, name: str, dose: float) -> Figures:
        """Of a method at an exposure."""
        if name in LINEAR_METHODS:
            return exact_figures(self.m.linear[name, dose], self.m, "method", self.truth)
        return drawn_figures(self.m, name, dose, self.truth)

    def _sharper(self, dose: float) -> dict[str, LinearReference]:
        """FBP variants to match resolution with, and their noise at the core's edge."""
        found = {}
        for label, f in self.m.fbp.items():
            plane, z = (task_transfer(f[d], self.m.distances["fbp", d], REACH_MM, BIN_MM) for d in ("plane", "z"))
            # The correlation of neighbours is that of fat, the variance that of the core's edge.
            row = f["row"] * (f["variance"][2] / f["variance"][0] / dose)
            found[label] = LinearReference(plane, z, NoiseCovariance.exact(row, FBP_BASE[1]))
        return found

    def entries(self, dose: float) -> list[dict[str, Any]]:
        """FBP, then every method, at an exposure."""
        base = self._fbp(self.base, dose)
        try:
            sharper = self._sharper(dose)
        except ValueError:
            sharper = {}  # too few views or voxels too large to tell the edge of the core
        found = [(f"FBP {label}", True, self._fbp(label, dose)) for label in self.m.fbp]
        found += [(name, False, self.figures(name, dose)) for name in self.m.methods]
        ideal, bias2 = self.limits(dose)["contrast_sd_hu"], self.m.fbp[self.base]["square"]
        rows = []
        for name, is_fbp, figures in found:
            entry = {"method": name, "exposure_s": dose, "is_fbp": is_fbp, **entry_of(figures, base, self.truth)}
            sd = entry["rois"]["tissue"]["corrected_sd_hu"]
            # Only where the estimator pools the same tissue as the limit.
            entry["efficiency_tissue"] = {
                k: None if sd.get(j) is None else (ideal / sd[j]) ** 2
                for k, j in (("value", "value"), ("low", "high"), ("high", "low"))
            }
            entry["factors"] = factors_of(figures, base, self.difference, sharper, bias2)
            if name in self.m.seconds:
                entry["seconds_per_volume"] = round(self.m.seconds[name], 3)
            samples = self.m.samples.get((name, "paper", dose))
            if samples is not None:
                entry["shape"] = self._shape(samples["shape"])
            rows.append(entry)
        return rows

    def _shape(self, shape: Floats) -> dict[str, Any]:
        """Error of lumen area and cap thickness of single realisations."""
        truth, result = self.true_values(), {}
        for name, values in zip(("lumen_mm2", "cap_mm", "lumen_half_mm2"), shape.T, strict=True):
            true = truth[name.replace("_half", "")]
            v = values[np.isfinite(values)]
            result[name] = {
                "true": true, "mean": float(v.mean()) if v.size else None,
                "absolute_error": json_of(float(np.abs(v - true).mean())) if v.size else None,
                "lost": float(1 - v.size / len(values)),
            }  # fmt: skip
        return result


def _number(figure: Any) -> float:
    return float(figure)
