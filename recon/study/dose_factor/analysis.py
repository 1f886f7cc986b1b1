"""From the samples of the dose-factor study to its figures, each with a 95 % interval."""

from __future__ import annotations

import math
from dataclasses import asdict
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.study.dose_factor.estimates import (
    DRAWS,
    attempt,
    controlled,
    estimate,
    factor,
    observer_factor,
    paired,
    sd_of,
    slope_corrected,
    squared_cnr,
)
from recon.study.dose_factor.facts import SceneFacts, fbp_label
from recon.study.dose_factor.further import Further
from recon.study.dose_factor.measure import Measured
from recon.study.dose_factor.measures import DOG_CHANNELS, OBSERVERS, crop_window, observer_channels
from recon.study.dose_factor.scene import StudyScene
from recon.study.dose_factor.settings import FBP_BASE, MAIN_SCENES
from recon.study.paper.plaque_scan import inset_grid
from torchpcct.metrics import (
    ContrastSlope,
    DoseCurve,
    auc,
    auc_from_d_prime,
    ceiling,
    channel_responses,
    cnr,
    cnr_interval,
    contrast_slope,
    d_prime,
    efficiency,
    ellipsoid_distance,
    false_positive_difference,
    hotelling_scores,
    mean_interval,
    paper_cnr_ceiling,
    roi_bias,
    sd_interval,
    task_transfer,
)
from torchpcct.metrics.dose_curve import DOSES

__all__ = ["ASSUMED_FACTOR", "Analysis", "analyse"]

Floats = NDArray[np.float64]

ASSUMED_FACTOR = 5.7
"""Dose that the paper assumes denoising to save."""

_LEAST_CONTROLLED = 12
"""Realisations from which a regression on two ROI means costs less than it gains."""

_REACH_MM = (0.5, 1.0)
_BIN_MM = 0.05


def analyse(measured: Measured) -> dict[str, Any]:
    """All figures of the study as JSON values."""
    return Analysis(measured).result()


class Analysis:
    """Figures of the main scenes.

    Args:
        measured: of the study.
    """

    def __init__(self, measured: Measured) -> None:
        self.m, self.s = measured, measured.settings
        self.facts = measured.facts
        self.paper: SceneFacts = measured.facts["paper"]
        self.truth = np.array([measured.facts[name].contrast_hu for name in MAIN_SCENES])
        # Only geometry is asked of it: nothing is read from or written to a store.
        self.scene = StudyScene("paper", self.s, None)  # type: ignore[arg-type]
        self.base = fbp_label(*FBP_BASE)
        self.variants = [(k, v, 0.0) for v in self.s.voxels_mm for k in self.s.kernels]
        self.blurred = [(*FBP_BASE, b) for b in self.s.blurs_mm]
        self.fbp: dict[str, dict[str, Any]] = {}

    def result(self) -> dict[str, Any]:
        for variant in [*self.variants, *self.blurred]:
            self.fbp[fbp_label(*variant)] = self._fbp(*variant)
        further = Further(self)
        methods = [self._method(name, dose) for dose in self.s.doses for name in self.m.methods]
        return {
            "settings": asdict(self.s),
            "methods_run": self.m.methods,
            "rois": self.scene.rois.as_dict(),
            "truth": self._truth(),
            "ceiling": [self._ceiling(dose) for dose in self.s.doses],
            "fbp": list(self.fbp.values()),
            "methods": methods,
            "wide_rois": [further.wide(name) for name in self.s.rois],
            "other_voxels": further.other_voxels(),
            "shape_limits": [
                {"exposure_s": dose, "displacement_mm": d, "contrast_sd_hu": sd, **self._shape_limit(sd, dose)}
                for dose, sds in self.m.shape_limits.items()
                for d, sd in sds.items()
            ],
            "worst_case_gains": [{"exposure_s": dose, **gains} for dose, gains in self.m.gains.items()],
            "scenes": further.scenes(),
            "scenes_left_out": self.m.left_out,
        }

    # -- truth, limit, FBP ----------------------------------------------------------------------------------------

    def _truth(self) -> dict[str, Any]:
        tissues = dict(zip(self.paper.tissues, self.paper.amplitudes_hu.tolist(), strict=True))
        plaque = self.scene.plaque
        return {
            "tissues_hu": tissues,
            "reference_hu": self.paper.reference_hu.tolist(),
            "contrasts_hu": dict(zip(MAIN_SCENES, self.truth.tolist(), strict=True)),
            "lumen_mm2": float(plaque.area("lumen", 0.0)),
            "cap_mm": float(plaque.cap_thickness),
        }

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

    def _ceiling(self, dose: float) -> dict[str, Any]:
        limits = self.limits(dose)
        factors = {}
        for variant in self.variants:
            f = self._at(fbp_label(*variant), dose)
            entry = {
                "paper_cnr": (limits["paper_cnr"] / f["paper_cnr"]) ** 2,
                "contrast_variance": (f["contrast_sd_hu"] / limits["contrast_sd_hu"]) ** 2,
                **{f"d_prime_{o}": (limits["d_prime"] / f[f"d_prime_{o}"]) ** 2 for o in OBSERVERS},
            }
            factors[fbp_label(*variant)] = {
                **entry, "assumed_below": {k: bool(v >= ASSUMED_FACTOR) for k, v in entry.items()}
            }  # fmt: skip
        return {"exposure_s": dose, **limits, "factors": factors}

    def _shape_limit(self, sd: float, dose: float) -> dict[str, float]:
        """Share of the limit with known shapes, and the largest factor against the reference FBP."""
        ideal, base = self.limits(dose)["contrast_sd_hu"], self._at(self.base, dose)["contrast_sd_hu"]
        return {"share": (ideal / sd) ** 2, "factor": (base / sd) ** 2}

    def _fbp(self, kernel: str, voxel: float, blur: float) -> dict[str, Any]:
        label = fbp_label(kernel, voxel, blur)
        contrasts = [self.facts[name].fbp_contrast(label) for name in MAIN_SCENES]
        slope, intercept = np.polyfit(self.truth, contrasts, 1)
        difference = self._fbp_difference(label)
        entry: dict[str, Any] = {
            "label": label, "kernel": kernel, "voxel_mm": voxel, "blur_mm": blur,
            "roi_hu": self.paper.fbp_hu[self.paper.labels.index(label)].tolist(),
            "slope": float(slope), "false_contrast_hu": contrasts[1], "intercept_hu": float(intercept),
            "resolution": self._resolution(difference, voxel),
        }  # fmt: skip
        self.fbp[label] = entry
        entry["doses"] = [{"exposure_s": d, **self._at(label, d)} for d in self.s.doses]
        return entry

    def _covariance(self, label: str, dose: float) -> Floats:
        return self.paper.fbp_covariance[label] / dose

    def _at(self, label: str, dose: float) -> dict[str, Any]:
        """Exact figures of an FBP variant at an exposure."""
        c = self._covariance(label, dose)
        fg, bg = self.paper.fbp_hu[self.paper.labels.index(label)]
        variance = c[0, 0] + c[1, 1] - 2 * c[0, 1]
        result = {
            "paper_cnr": float((bg - fg) / math.sqrt(c[0, 0] + c[1, 1])),
            "contrast_sd_raw_hu": math.sqrt(variance),
            "contrast_sd_hu": math.sqrt(variance) / self.fbp[label]["slope"],
        }
        if len(c) > 2:
            count = self._channel_count(self.s.n)
            difference = self._fbp_difference(label)[None]
            for k, observer in enumerate(OBSERVERS):
                first = 2 + k * (1 + DOG_CHANNELS)
                use = slice(first, first + count)
                channels = self._channels(self.fbp[label]["voxel_mm"], observer)[:count]
                delta = channel_responses(difference, channels)[0]
                value = float(math.sqrt(delta @ np.linalg.solve(c[use, use], delta)))
                result[f"d_prime_{observer}"], result[f"auc_{observer}"] = value, auc_from_d_prime(value)
        return result

    def _fbp_difference(self, label: str) -> Any:
        """Core present minus absent, noise free."""
        return self.facts["paper"].fbp_crop[label].astype(np.float64) - self.facts["absent_core"].fbp_crop[label]

    @cache  # noqa: B019 - the analysis lives for one report
    def _channels(self, voxel: float, observer: str) -> Floats:
        return observer_channels(self.scene, inset_grid(self.scene.plaque, voxel), observer)

    def _channel_count(self, n: int) -> int:
        """As many channels as the realisations can train, 8 for each: the core's shape first."""
        return max(1, min(1 + DOG_CHANNELS, n // 8))

    def _resolution(self, difference: Any, voxel: float) -> dict[str, Any]:
        """Edge width and transfer function of the core's own edge, on present minus absent."""
        grid = crop_window(inset_grid(self.scene.plaque, voxel), self.scene.core_center)[1]
        core = self.scene.plaque.core
        distance = ellipsoid_distance(grid, self.scene.core_center, tuple(core.semi_axes[::-1]))

        def compute() -> Any:
            t = task_transfer(difference, distance, _REACH_MM, _BIN_MM)
            found = {"edge_width_mm": t.edge_width, "f50_lp_mm": t.f50, "f10_lp_mm": t.f10, "contrast_hu": t.contrast}
            return {k: v if math.isfinite(v) else None for k, v in found.items()}

        found = attempt(compute)
        return found if "edge_width_mm" in found else {"edge_width_mm": None, **found}

    # -- methods --------------------------------------------------------------------------------------------------

    def _samples(self, name: str, dose: float) -> dict[str, dict[str, Any]]:
        return {scene: self.m.samples[name, scene, dose] for scene in MAIN_SCENES}

    def _slope(self, name: str, dose: float, n: int | None = None) -> ContrastSlope:
        roi = [self.m.samples[name, scene, dose]["roi"][:n] for scene in MAIN_SCENES]
        return contrast_slope(self.truth, np.stack([r[:, 1] - r[:, 0] for r in roi]), draws=DRAWS)

    def _method(self, name: str, dose: float) -> dict[str, Any]:
        samples = self._samples(name, dose)
        roi = samples["paper"]["roi"].astype(np.float64)
        contrast = roi[:, 1] - roi[:, 0]
        n = len(roi)
        slope = self._slope(name, dose)
        limits = self.limits(dose)
        sd = float(contrast.std(ddof=1))
        ratio = cnr(roi[:, 0], roi[:, 1])
        unbiased = self._controlled(name, "paper", dose)
        absent = self._controlled(name, "absent_core", dose)
        false = absent[:, 1] - absent[:, 0]
        reached = self.reached(roi, slope, dose)
        entry: dict[str, Any] = {
            "method": name, "exposure_s": dose, "realizations": n,
            "seconds_per_volume": round(self.m.seconds.get(name, math.nan), 3),
            "roi_hu": roi.mean(0).tolist(),
            "paper_cnr": estimate((ratio, *cnr_interval(roi[:, 0], roi[:, 1]))),
            "bias_hu": [estimate(e) for e in roi_bias(unbiased, self.paper.truth_hu)],
            "bias_to_reference_hu": [estimate(e) for e in roi_bias(unbiased, self.paper.reference_hu)],
            "slope": estimate((slope.value, slope.low, slope.high)),
            "contrasts_hu": {k: float((v["roi"][:, 1] - v["roi"][:, 0]).mean()) for k, v in samples.items()},
            "contrast_sd_raw_hu": estimate((sd, *sd_interval(sd, n))),
            "efficiency": reached,
            "contrast_sd_hu": sd_of(reached, limits["contrast_sd_hu"]),
            "false_contrast_hu": estimate((false.mean(), *mean_interval(false))),
        }  # fmt: skip
        entry["observer"] = {}
        scores = {o: self._observer(entry, samples, dose, o) for o in OBSERVERS}
        entry["resolution"] = self._resolution(
            samples["paper"]["crop"].astype(np.float64).mean(0)
            - samples["absent_core"]["crop"].astype(np.float64).mean(0),
            self.s.voxel_mm,
        )
        entry["factors"] = self._factors(roi, slope, scores, dose)
        entry["matched_edge"] = self._matched(entry, contrast, slope, dose)
        entry["to_linear"] = self._to_linear(name, dose)
        entry["shape"] = self._shape(samples["paper"]["shape"])
        if ("paper", dose) in self.m.fbp:
            entry["fbp_shape"] = self._shape(self.m.fbp["paper", dose]["shape"][:n])
        return entry

    def _controlled(self, name: str, scene: str, dose: float) -> Floats:
        """ROI means of a method, for their mean: FBP of the same noise, whose expectation is exact, is the control."""
        roi: Floats = self.m.samples[name, scene, dose]["roi"].astype(np.float64)
        fbp = self.m.fbp.get((scene, dose))
        if fbp is None or len(roi) < _LEAST_CONTROLLED:
            return roi
        facts = self.facts[scene]
        return controlled(roi, fbp["roi"][: len(roi)], facts.fbp_hu[facts.labels.index(self.base)])

    def reached(self, roi: Floats, slope: ContrastSlope, dose: float) -> dict[str, Any]:
        """Share of the limit: ideal over slope-corrected variance of the contrast, with interval."""
        ideal = self.limits(dose)["contrast_sd_hu"]
        return attempt(lambda: estimate(efficiency(ideal, roi[:, 1] - roi[:, 0], slope, draws=DRAWS)))

    def _observer(self, entry: dict[str, Any], samples: Any, dose: float, observer: str) -> Any:
        """Scores ``(realisations, 2)``, absent and present; None where there are too few realisations."""
        n, count = entry["realizations"], self._channel_count(self.s.n)
        channels = self._channels(self.s.voxel_mm, observer)[:count]
        pair = [channel_responses(samples[k]["crop"], channels) for k in ("paper", "absent_core")]
        fbp = [self.m.fbp.get((k, dose)) for k in ("paper", "absent_core")]
        found: dict[str, Any] = {"channels": count}
        entry["observer"][observer] = found

        def compute() -> Any:
            if self._channel_count(n) < count:
                raise ValueError(f"{n} realisations are too few to train {count} channels")
            present, absent = hotelling_scores(*pair)
            found["d_prime"] = estimate(d_prime(present, absent, draws=DRAWS))
            found["auc"] = estimate(auc(present, absent))
            if all(f is not None for f in fbp):
                own = self._channels(FBP_BASE[1], observer)[:count]
                reference = hotelling_scores(*[channel_responses(f["crop"][:n], own) for f in fbp if f is not None])
                found["d_prime_fbp"] = estimate(d_prime(*reference, draws=DRAWS))
                found["auc_fbp"] = estimate(auc(*reference))
                found["false_positives_to_fbp"] = estimate(
                    false_positive_difference((present, absent), reference, draws=DRAWS)
                )
            return np.stack([absent, present], axis=-1)

        scores = attempt(compute)
        if isinstance(scores, dict):
            found["d_prime"] = found["auc"] = scores
            return None
        return scores

    def _factors(self, roi: Floats, slope: ContrastSlope, scores: Any, dose: float) -> dict[str, Any]:
        """Dose factors against every FBP variant."""
        found: dict[str, Any] = {}
        for variant in self.variants:
            label = fbp_label(*variant)
            fbp, c = self.fbp[label], self._covariance(label, dose)[:2, :2]
            exact = self._at(label, dose)
            found[label] = entry = {
                "paper_cnr": factor(roi, DoseCurve.paper_cnr(fbp["roi_hu"], c), "paper_cnr"),
                "contrast_variance": factor(
                    roi, DoseCurve.contrast_variance(c, fbp["slope"]), "contrast_variance", slope
                ),
            }
            for observer, values in scores.items():
                curve = DoseCurve(DOSES, exact[f"d_prime_{observer}"] * np.sqrt(DOSES))
                for figure in ("d_prime", "auc"):
                    entry[f"{figure}_{observer}"] = observer_factor(values, curve, figure)
        return found

    def _matched(self, entry: dict[str, Any], contrast: Floats, slope: ContrastSlope, dose: float) -> Any:
        """Factor by contrast variance against FBP of the same edge width (kernels, and soft with Gaussian filters)."""
        width = entry["resolution"]["edge_width_mm"]
        family = []
        for label, fbp in self.fbp.items():
            w = fbp["resolution"]["edge_width_mm"]
            if w is not None and fbp["voxel_mm"] == FBP_BASE[1]:
                family.append((w, self._at(label, dose)["contrast_sd_hu"]))
        family.sort()
        if width is None or len(family) < 2:
            return {"value": None, "low": None, "high": None, "why": "no edge width"}
        widths, sds = np.array(family).T
        if not widths[0] <= width <= widths[-1]:
            why = f"edge width {width:.2f} mm outside {widths[0]:.2f}…{widths[-1]:.2f} mm of FBP"
            return {"value": None, "low": None, "high": None, "why": why}
        sd = float(np.exp(np.interp(width, widths, np.log(sds))))
        found = attempt(lambda: estimate(efficiency(sd, contrast, slope, draws=DRAWS)))
        return {**found, "fbp_contrast_sd_hu": sd}

    def _to_linear(self, name: str, dose: float) -> Any:
        """Dose factor against the best linear 3-D filter, by variance and by CNR, both resampled together."""
        if name == "linear" or "linear" not in self.m.methods:
            return None
        n = min(len(self.m.samples[k, "paper", dose]["roi"]) for k in (name, "linear"))

        def compute() -> Any:
            pair = []
            for k in (name, "linear"):
                roi = self.m.samples[k, "paper", dose]["roi"][:n].astype(np.float64)
                pair.append((roi, self._slope(k, dose, n)))
            return {
                "contrast_variance": paired(pair, n, slope_corrected),
                "paper_cnr": paired(pair, n, squared_cnr),
            }

        found = attempt(compute)
        return found if "paper_cnr" in found else {"contrast_variance": found, "paper_cnr": found}

    def _shape(self, shape: Floats) -> dict[str, Any]:
        """Error of lumen area and cap thickness of single realisations."""
        truth = self._truth()
        result = {}
        columns = (("lumen_mm2", 0, "lumen_mm2"), ("cap_mm", 1, "cap_mm"), ("lumen_half_mm2", 2, "lumen_mm2"))
        for name, column, true in columns:
            values = shape[:, column]
            v = values[np.isfinite(values)]
            error = np.abs(v - truth[true])
            result[name] = {
                "true": truth[true],
                "mean": float(v.mean()) if v.size else None,
                "absolute_error": estimate((error.mean(), *mean_interval(error))) if v.size > 2 else None,
                "lost": float(1 - v.size / len(values)),
            }
        return result
