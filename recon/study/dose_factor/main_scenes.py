"""The figures of every method on the main scenes: contrast, dose factors, observer, resolution, shapes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.study.dose_factor.estimates import (
    DRAWS,
    attempt,
    contrast_figures,
    controlled,
    estimate,
    factor,
    mean_of,
    none,
    observer_factor,
    paired_ratio,
    reached,
    slope_of,
)
from recon.study.dose_factor.exact import Exact
from recon.study.dose_factor.measures import OBSERVERS
from recon.study.dose_factor.settings import FBP_BASE, MAIN_SCENES, fbp_label
from torchpcct.metrics import (
    ContrastSlope,
    DoseCurve,
    auc,
    channel_responses,
    d_prime,
    false_positive_difference,
    hotelling_scores,
    roi_bias,
    sd_interval,
)
from torchpcct.metrics.dose_curve import DOSES

__all__ = ["method_entry"]

Floats = NDArray[np.float64]

_LEAST_CONTROLLED = 12
"""Realisations from which a regression on two ROI means costs less than it gains."""

_PAIR = ("paper", "absent_core")
"""With and without the core."""


def method_entry(exact: Exact, name: str, dose: float) -> dict[str, Any]:
    """All figures of a method at an exposure."""
    m = exact.m
    samples = {scene: m.samples[name, scene, dose] for scene in MAIN_SCENES}
    roi = samples["paper"]["roi"].astype(np.float64)
    contrast = roi[:, 1] - roi[:, 0]
    n = len(roi)
    slope = slope_of(exact.truth, [samples[scene]["roi"] for scene in MAIN_SCENES])
    sd = float(contrast.std(ddof=1))
    unbiased, absent = (_controlled(exact, name, scene, dose) for scene in _PAIR)
    observer = {o: _observer(exact, samples, dose, o) for o in OBSERVERS}
    with_core, without = (samples[scene]["crop"].astype(np.float64).mean(0) for scene in _PAIR)
    resolution = exact.resolution(with_core - without, exact.s.voxel_mm)
    entry: dict[str, Any] = {
        "method": name, "exposure_s": dose, "realizations": n,
        "seconds_per_volume": round(m.seconds.get(name, math.nan), 3),
        "roi_hu": roi.mean(0).tolist(),
        **contrast_figures(roi, slope, exact.limits(dose)["contrast_sd_hu"]),
        "bias_hu": [estimate(e) for e in roi_bias(unbiased, exact.paper.truth_hu)],
        "bias_to_reference_hu": [estimate(e) for e in roi_bias(unbiased, exact.paper.reference_hu)],
        "contrasts_hu": {k: float((v["roi"][:, 1] - v["roi"][:, 0]).mean()) for k, v in samples.items()},
        "contrast_sd_raw_hu": estimate((sd, *sd_interval(sd, n))),
        "false_contrast_hu": mean_of(absent[:, 1] - absent[:, 0]),
        "observer": {o: found for o, (found, _) in observer.items()},
        "resolution": resolution,
        "factors": _factors(exact, roi, slope, {o: scores for o, (_, scores) in observer.items()}, dose),
        "matched_edge": _matched(exact, resolution["edge_width_mm"], contrast, slope, dose),
        "to_linear": _to_linear(exact, name, dose),
        "shape": _shape(exact, samples["paper"]["shape"]),
    }  # fmt: skip
    if ("paper", dose) in m.fbp:
        entry["fbp_shape"] = _shape(exact, m.fbp["paper", dose]["shape"][:n])
    return entry


def _controlled(exact: Exact, name: str, scene: str, dose: float) -> Floats:
    """ROI means of a method, for their mean: FBP of the same noise, whose expectation is exact, is the control."""
    roi: Floats = exact.m.samples[name, scene, dose]["roi"].astype(np.float64)
    fbp = exact.m.fbp.get((scene, dose))
    if fbp is None or len(roi) < _LEAST_CONTROLLED:
        return roi
    return controlled(roi, fbp["roi"][: len(roi)], exact.facts[scene].fbp_hu[exact.base])


def _observer(exact: Exact, samples: Any, dose: float, observer: str) -> tuple[dict[str, Any], Any]:
    """Figures of an observer, and its scores ``(realisations, 2)``, absent and present; None: too few to train it."""
    count = exact.channel_count(exact.s.n)
    crops = [samples[k]["crop"] for k in _PAIR]
    fbp = [exact.m.fbp[k, dose]["crop"] for k in _PAIR if (k, dose) in exact.m.fbp]
    n = len(crops[0])
    found: dict[str, Any] = {"channels": count}
    if exact.channel_count(n) < count:
        found["d_prime"] = found["auc"] = none(f"{n} realisations are too few to train {count} channels")
        return found, None

    def scores(volumes: list[Any], voxel_mm: float) -> tuple[Floats, Floats]:
        channels = exact.channels(voxel_mm, observer)[:count]
        present, absent = hotelling_scores(*[channel_responses(v[:n], channels) for v in volumes])
        return present, absent

    def compute() -> Any:
        own = scores(crops, exact.s.voxel_mm)
        found["d_prime"], found["auc"] = estimate(d_prime(*own, draws=DRAWS)), estimate(auc(*own))
        if len(fbp) == len(_PAIR):
            reference = scores(fbp, FBP_BASE[1])
            found["d_prime_fbp"] = estimate(d_prime(*reference, draws=DRAWS))
            found["auc_fbp"] = estimate(auc(*reference))
            found["false_positives_to_fbp"] = estimate(false_positive_difference(own, reference, draws=DRAWS))
        return np.stack(own[::-1], axis=-1)

    result = attempt(compute)
    if isinstance(result, dict):
        found["d_prime"] = found["auc"] = result
        return found, None
    return found, result


def _factors(exact: Exact, roi: Floats, slope: ContrastSlope, scores: Any, dose: float) -> dict[str, Any]:
    """Dose factors against every FBP variant."""
    found: dict[str, Any] = {}
    for variant in exact.variants:
        label = fbp_label(*variant)
        fbp, c = exact.fbp[label], exact.paper.fbp_covariance[label][:2, :2] / dose
        at = exact.at(label, dose)
        found[label] = entry = {
            "paper_cnr": factor(roi, DoseCurve.paper_cnr(fbp["roi_hu"], c), "paper_cnr"),
            "contrast_variance": factor(roi, DoseCurve.contrast_variance(c, fbp["slope"]), "contrast_variance", slope),
        }
        for observer, values in scores.items():
            curve = DoseCurve(DOSES, at[f"d_prime_{observer}"] * np.sqrt(DOSES))
            for figure in ("d_prime", "auc"):
                entry[f"{figure}_{observer}"] = observer_factor(values, curve, figure)
    return found


def _matched(exact: Exact, width: float | None, contrast: Floats, slope: ContrastSlope, dose: float) -> Any:
    """Factor by contrast variance against FBP of the same edge width (kernels, and soft with Gaussian filters)."""
    family = []
    for label, fbp in exact.fbp.items():
        w = fbp["resolution"]["edge_width_mm"]
        if w is not None and fbp["voxel_mm"] == FBP_BASE[1]:
            family.append((w, exact.at(label, dose)["contrast_sd_hu"]))
    family.sort()
    if width is None or len(family) < 2:
        return none("no edge width")
    widths, sds = np.array(family).T
    if not widths[0] <= width <= widths[-1]:
        return none(f"edge width {width:.2f} mm outside {widths[0]:.2f}…{widths[-1]:.2f} mm of FBP")
    sd = float(np.exp(np.interp(width, widths, np.log(sds))))
    return {**reached(sd, contrast, slope), "fbp_contrast_sd_hu": sd}


def _to_linear(exact: Exact, name: str, dose: float) -> Any:
    """Dose factor against the best linear 3-D filter, by variance and by CNR, both resampled together."""
    m = exact.m
    if name == "linear" or "linear" not in m.methods:
        return None
    n = min(len(m.samples[k, "paper", dose]["roi"]) for k in (name, "linear"))

    def pair(method: str) -> tuple[Floats, ContrastSlope]:
        rois = [m.samples[method, scene, dose]["roi"][:n] for scene in MAIN_SCENES]
        return rois[0].astype(np.float64), slope_of(exact.truth, rois)

    def compute() -> Any:
        first, second = pair(name), pair("linear")
        return {figure: paired_ratio(figure, first, second) for figure in ("contrast_variance", "paper_cnr")}

    found = attempt(compute)
    return found if "paper_cnr" in found else {"contrast_variance": found, "paper_cnr": found}


def _shape(exact: Exact, shape: Floats) -> dict[str, Any]:
    """Error of lumen area and cap thickness of single realisations."""
    truth, result = exact.true_values(), {}
    for name, values in zip(("lumen_mm2", "cap_mm", "lumen_half_mm2"), shape.T, strict=True):
        true = truth[name.replace("_half", "")]
        v = values[np.isfinite(values)]
        result[name] = {
            "true": true,
            "mean": float(v.mean()) if v.size else None,
            "absolute_error": mean_of(np.abs(v - true)) if v.size > 2 else None,
            "lost": float(1 - v.size / len(values)),
        }
    return result
