"""The dose-factor study's report: its sentence, its tables, its figures."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from recon.study.dose_factor.exact import Exact
from recon.study.dose_factor.figures import curves_figure, images_figure
from recon.study.dose_factor.further_scenes import scene_rows
from recon.study.dose_factor.main_scenes import method_entry
from recon.study.dose_factor.measure import Measured
from recon.study.dose_factor.other_rois import other_voxels, wide_entry
from recon.study.dose_factor.settings import FBP_BASE, METHOD_NAMES, fbp_label
from recon.study.dose_factor.tables import at_dose, headline_method, of_method, tables, text
from recon.study.paper.facts import ASSUMED_FACTOR
from recon.study.report import Report
from recon.study.study import environment

__all__ = ["build_report"]


def build_report(measured: Measured) -> Report:
    """``report.json``, ``report.md``, ``dose_factor.png`` and ``dose_factor_images.png``."""
    data = {"study": "dose-factor", **_analyse(measured), "environment": environment()}
    data["command"], data["seconds"] = "", measured.total_seconds
    sections = [
        _headline(data),
        "# Measured dose factors",
        _intro(data),
        *tables(data),
        _footer(data),
    ]
    figures = {"dose_factor.png": curves_figure(data), "dose_factor_images.png": images_figure(measured, data)}
    return Report("dose-factor", data, "\n\n".join(s for s in sections if s), figures)


def _analyse(measured: Measured) -> dict[str, Any]:
    """All figures of the study, each with a 95 % interval where it is not exact."""
    exact, s = Exact(measured), measured.settings
    return {
        "settings": asdict(s),
        "methods_run": measured.methods,
        "rois": exact.variant.rois.as_dict(),
        "truth": exact.true_values(),
        "ceiling": [exact.limit_entry(dose) for dose in s.doses],
        "fbp": list(exact.fbp.values()),
        "methods": [method_entry(exact, name, dose) for dose in s.doses for name in measured.methods],
        "wide_rois": [wide_entry(exact, name) for name in s.rois],
        "other_voxels": other_voxels(exact),
        "shape_limits": exact.shape_limit_entries(),
        "worst_case_gains": [{"exposure_s": dose, **gains} for dose, gains in measured.gains.items()],
        "scenes": scene_rows(exact),
        "scenes_left_out": measured.left_out,
    }


def _headline(data: dict[str, Any]) -> str:
    """The study's sentence."""
    method = headline_method(data["methods_run"])
    base = fbp_label(*FBP_BASE)
    parts = []
    for entry, limit in zip(of_method(data, method), data["ceiling"], strict=True):
        f, c = entry["factors"][base], limit["factors"][base]
        parts.append(
            f"at {entry['exposure_s']:g} s {text(f['contrast_variance'])} by slope-corrected contrast variance, "
            f"{text(f['paper_cnr'])} by the paper's CNR, {text(f['d_prime_axial'])} by d′ of the axial image; "
            f"physics allows at most {c['contrast_variance']:.1f}, {c['paper_cnr']:.1f} and {c['d_prime_axial']:.1f}"
        )
    return (
        f"The paper assumes {ASSUMED_FACTOR}×; measured for {METHOD_NAMES[method]} against FBP {base}: "
        + "; ".join(parts)
        + "."
    )


def _intro(data: dict[str, Any]) -> str:
    s, r, t = data["settings"], data["rois"], data["truth"]
    drawn = (
        "The noise of b = AᵀW y is drawn from its covariance (the Gram operator), not in the readings."
        if s["fast_noise"]
        else "Noise is drawn in the readings of the paper's and the absent core's scan; half and flipped contrast "
        "carry the paper scan's noise; further scenes draw the noise of b = AᵀW y from its covariance."
    )
    tissues = ", ".join(f"{k} {v:.1f}" for k, v in t["tissues_hu"].items())
    counts = ", ".join(f"{METHOD_NAMES[e['method']]} {e['realizations']}" for e in at_dose(data, s["doses"][0]))
    return (
        f"Realisations (seeds from {s['seed']}, the same for every method and scene): {counts}. {s['views']} views; "
        f"methods on {s['voxel_mm']:g} mm voxels. {drawn}\n\n"
        f"Core ROI {r['foreground_mm2']:.2f} mm² ({r['foreground_pixels']} pixels of {r['pixel_mm']} mm), fibrous ROI "
        f"{r['background_mm2']:.2f} mm² ({r['background_pixels']} pixels). True tissue values as the scanner sees them "
        f"(generalised least squares on exact path lengths, noise-free readings), HU: {tissues}; noise-free FBP "
        f"standard 0.10 mm reads {t['reference_hu'][0]:.1f} / {t['reference_hu'][1]:.1f} in the ROIs.\n\n"
        "Square brackets: 95 % interval, bootstrap over paired realisations. FBP's figures are exact (adjoint passes). "
        "Biases and false contrasts are means with FBP of the same noise, whose expectation is exact, as control "
        "variate. "
        "The limit is the best unbiased estimate with all shapes known (generalised least squares, the fat around the "
        "vessel known); for d′ it is the ideal observer, which knows all but whether the core is there. A figure above "
        "the limit is bias, not skill. Contrast SD is corrected by the contrast slope over cores of contrast 1, ½, 0 "
        "and −1."
    )


def _footer(data: dict[str, Any]) -> str:
    e = data["environment"]
    return (
        f"torchpcct {e['torchpcct']}, PyTorch {e['torch']}, {e['cores']} cores. "
        f"Time of the last run, with the pieces it found finished: {data['seconds']:.0f} s."
    )
