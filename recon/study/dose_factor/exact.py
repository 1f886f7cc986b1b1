"""What is known without sampling error: the true tissues, the limit of the data, FBP at every dose."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.study.dose_factor.estimates import attempt
from recon.study.dose_factor.measure import Measured
from recon.study.dose_factor.measures import DOG_CHANNELS, OBSERVERS, crop_window, observer_channels
from recon.study.dose_factor.settings import FBP_BASE, MAIN_SCENES, fbp_label
from recon.study.dose_factor.variant import Variant
from recon.study.paper.facts import ASSUMED_FACTOR
from torchpcct.metrics import (
    auc_from_d_prime,
    ceiling,
    channel_responses,
    ellipsoid_distance,
    paper_cnr_ceiling,
    task_transfer,
)

__all__ = ["Exact", "contrast_sd"]

Floats = NDArray[np.float64]

_REACH_MM = (0.5, 1.0)
_BIN_MM = 0.05


def contrast_sd(covariance: Floats, dose: float = 1.0) -> float:
    """Standard deviation of the contrast between two ROI means, from their covariance at 1 s."""
    return math.sqrt((covariance[0, 0] + covariance[1, 1] - 2 * covariance[0, 1]) / dose)


class Exact:
    """Exact figures of the main scenes.

    Args:
        measured: of the study.

    Attributes:
        m, s, facts: of the study; paper: facts of the paper's scene.
        variant: where things are in it.
        truth: contrasts of the main scenes, HU.
        base: label of the reference FBP; variants: kernel, voxel size and blur of FBP without filters.
        fbp: label → entry of the report.
    """

    def __init__(self, measured: Measured) -> None:
        self.m, self.s, self.facts = measured, measured.settings, measured.facts
        self.paper = self.facts["paper"]
        self.variant = Variant("paper", self.s)
        self.truth = np.array([self.facts[name].contrast_hu for name in MAIN_SCENES])
        self.base = fbp_label(*FBP_BASE)
        self.variants = [(k, v, 0.0) for v in self.s.voxels_mm for k in self.s.kernels]
        self.fbp: dict[str, dict[str, Any]] = {}
        for each in [*self.variants, *((*FBP_BASE, b) for b in self.s.blurs_mm)]:
            self._add_fbp(*each)

    def true_values(self) -> dict[str, Any]:
        """Tissues, contrasts and shapes as they are."""
        plaque = self.variant.plaque
        return {
            "tissues_hu": dict(zip(self.paper.tissues, self.paper.amplitudes_hu.tolist(), strict=True)),
            "reference_hu": self.paper.reference_hu.tolist(),
            "contrasts_hu": dict(zip(MAIN_SCENES, self.truth.tolist(), strict=True)),
            "lumen_mm2": float(plaque.area("lumen", 0.0)),
            "cap_mm": float(plaque.cap_thickness),
        }

    # -- limit of the data ----------------------------------------------------------------------------------------

    def limits(self, dose: float) -> dict[str, float]:
        """Figures of the best unbiased estimate at an exposure, the surrounding fat known from the rest of the scan."""
        keep = [k for k, t in enumerate(self.paper.tissues) if t != "patient"]
        information = self.paper.information[np.ix_(keep, keep)]
        amplitudes = self.paper.amplitudes_hu[keep]
        names = [self.paper.tissues[k] for k in keep]
        core, fibrous = names.index("core"), names.index("fibrous")
        h = np.zeros(len(keep))
        h[core], h[fibrous] = -1.0, 1.0
        full = np.zeros(len(self.paper.tissues))
        full[self.paper.tissue("core")], full[self.paper.tissue("fibrous")] = -1.0, 1.0
        return {
            "contrast_sd_hu": ceiling(information, h, dose).contrast_sd,
            "contrast_sd_fat_unknown_hu": ceiling(self.paper.information, full, dose).contrast_sd,
            "paper_cnr": paper_cnr_ceiling(information, amplitudes, core, fibrous, dose),
            # The ideal observer knows everything but whether the core is there.
            "d_prime": abs(self.paper.contrast_hu) * math.sqrt(information[core, core] * dose),
        }

    def limit_entry(self, dose: float) -> dict[str, Any]:
        """The limit, and the largest dose factors that it allows against every FBP variant."""
        limits = self.limits(dose)
        factors = {}
        for each in self.variants:
            f = self.at(fbp_label(*each), dose)
            entry = {
                "paper_cnr": (limits["paper_cnr"] / f["paper_cnr"]) ** 2,
                "contrast_variance": (f["contrast_sd_hu"] / limits["contrast_sd_hu"]) ** 2,
                **{f"d_prime_{o}": (limits["d_prime"] / f[f"d_prime_{o}"]) ** 2 for o in OBSERVERS},
            }
            below = {k: bool(v >= ASSUMED_FACTOR) for k, v in entry.items()}
            factors[fbp_label(*each)] = {**entry, "assumed_below": below}
        return {"exposure_s": dose, **limits, "factors": factors}

    def shape_limit_entries(self) -> list[dict[str, float]]:
        """The limit with outlines that are only roughly known: its share of the one with known shapes, and the largest
        factor against the reference FBP."""
        rows = []
        for dose, sds in self.m.shape_limits.items():
            ideal, base = self.limits(dose)["contrast_sd_hu"], self.at(self.base, dose)["contrast_sd_hu"]
            for displacement, sd in sds.items():
                rows.append({
                    "exposure_s": dose, "displacement_mm": displacement, "contrast_sd_hu": sd,
                    "share": (ideal / sd) ** 2, "factor": (base / sd) ** 2,
                })  # fmt: skip
        return rows

    # -- FBP ------------------------------------------------------------------------------------------------------

    def _add_fbp(self, kernel: str, voxel: float, blur: float) -> None:
        label = fbp_label(kernel, voxel, blur)
        contrasts = [self.facts[name].fbp_contrast(label) for name in MAIN_SCENES]
        slope, intercept = np.polyfit(self.truth, contrasts, 1)
        self.fbp[label] = {
            "label": label, "kernel": kernel, "voxel_mm": voxel, "blur_mm": blur,
            "roi_hu": self.paper.fbp_hu[label].tolist(),
            "slope": float(slope), "false_contrast_hu": contrasts[1], "intercept_hu": float(intercept),
            "resolution": self.resolution(self._fbp_difference(label), voxel),
        }  # fmt: skip
        self.fbp[label]["doses"] = [{"exposure_s": d, **self.at(label, d)} for d in self.s.doses]

    def at(self, label: str, dose: float) -> dict[str, Any]:
        """Figures of an FBP variant at an exposure."""
        c = self.paper.fbp_covariance[label] / dose
        fg, bg = self.paper.fbp_hu[label]
        sd = contrast_sd(c)
        result = {
            "paper_cnr": float((bg - fg) / math.sqrt(c[0, 0] + c[1, 1])),
            "contrast_sd_raw_hu": sd,
            "contrast_sd_hu": sd / self.fbp[label]["slope"],
        }
        if len(c) > 2:
            count = self.channel_count(self.s.n)
            difference = self._fbp_difference(label)[None]
            for k, observer in enumerate(OBSERVERS):
                first = 2 + k * (1 + DOG_CHANNELS)
                use = slice(first, first + count)
                channels = self.channels(self.fbp[label]["voxel_mm"], observer)[:count]
                delta = channel_responses(difference, channels)[0]
                value = float(math.sqrt(delta @ np.linalg.solve(c[use, use], delta)))
                result[f"d_prime_{observer}"], result[f"auc_{observer}"] = value, auc_from_d_prime(value)
        return result

    def _fbp_difference(self, label: str) -> Any:
        """Core present minus absent, noise free."""
        return self.paper.fbp_crop[label].astype(np.float64) - self.facts["absent_core"].fbp_crop[label]

    @cache  # noqa: B019 - lives for one report
    def channels(self, voxel: float, observer: str) -> Floats:
        """The observer's channels on crops of a voxel size."""
        return observer_channels(self.variant, self.variant.grid_of(voxel), observer)

    def channel_count(self, n: int) -> int:
        """As many channels as the realisations can train, 8 for each: the core's shape first."""
        return max(1, min(1 + DOG_CHANNELS, n // 8))

    def resolution(self, difference: Any, voxel: float) -> dict[str, Any]:
        """Edge width and transfer function of the core's own edge, on present minus absent."""
        grid = crop_window(self.variant.grid_of(voxel), self.variant.core_center)[1]
        core = self.variant.plaque.core
        distance = ellipsoid_distance(grid, self.variant.core_center, tuple(core.semi_axes[::-1]))

        def compute() -> Any:
            t = task_transfer(difference, distance, _REACH_MM, _BIN_MM)
            found = {"edge_width_mm": t.edge_width, "f50_lp_mm": t.f50, "f10_lp_mm": t.f10, "contrast_hu": t.contrast}
            return {k: v if math.isfinite(v) else None for k, v in found.items()}

        found = attempt(compute)
        return found if "edge_width_mm" in found else {"edge_width_mm": None, **found}
