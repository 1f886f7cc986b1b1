"""The dose-factor study's report: its sentence, its tables, its figures."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from recon.study.dose_factor.exact import Exact
from recon.study.dose_factor.figures import factors_figure, images_figure
from recon.study.dose_factor.further_scenes import scene_rows
from recon.study.dose_factor.measure import Measured
from recon.study.dose_factor.settings import FBP_BASE, METHOD_NAMES, ROIS, fbp_label
from recon.study.dose_factor.tables import at_dose, tables, text
from recon.study.dose_factor.vessel_rows import vessel_rows
from recon.study.paper.facts import ASSUMED_FACTOR
from recon.study.report import Report
from recon.study.study import environment

__all__ = ["build_report"]


def build_report(measured: Measured) -> Report:
    """``report.json``, ``report.md``, ``dose_factor.png`` and ``dose_factor_images.png``."""
    data = {"study": "dose-factor", **_analyse(measured), "environment": environment()}
    data["command"], data["seconds"] = "", measured.total_seconds
    sections = [_headline(data), "# Measured dose factors", _intro(data), *tables(data), _footer(data)]
    figures = {"dose_factor.png": factors_figure(data), "dose_factor_images.png": images_figure(measured, data)}
    return Report("dose-factor", data, "\n\n".join(s for s in sections if s), figures)


def _analyse(measured: Measured) -> dict[str, Any]:
    """All figures of the study, each with a 95 % interval where it is not exact."""
    exact, s = Exact(measured), measured.settings
    return {
        "settings": asdict(s),
        "methods_run": measured.methods,
        "rois": {name: exact.variant.pair_of(name).as_dict() for name in ROIS},
        "truth": exact.true_values(),
        "limits": [exact.limit_entry(dose) for dose in s.doses],
        "methods": [e for dose in s.doses for e in exact.entries(dose)],
        "shape_limits": exact.shape_limit_entries(),
        "worst_case_gains": [{"exposure_s": dose, **gains} for dose, gains in measured.gains.items()],
        "scenes": scene_rows(exact),
        "scenes_left_out": measured.left_out,
        "vessels": vessel_rows(measured.vessels, exact.paper.contrast_hu),
    }


def _headline(data: dict[str, Any]) -> str:
    """The study's sentence."""
    names = list(data["methods_run"])
    method = "mbir" if "mbir" in names else names[-1]
    parts = []
    for dose, limit in zip(data["settings"]["doses"], data["limits"], strict=True):
        e = next(e for e in at_dose(data, dose) if e["method"] == method)
        f, c = e["factors"], limit["factors"]
        asked = (("contrast_paper", "contrast in the paper's ROI"), ("contrast_tissue", "contrast in the whole lesion"),
                 ("d_prime_volume", "d′ of the volume"))  # fmt: skip
        found = ", ".join(f"{text(f[k])} by {label} (limit {c[k]:.1f})" for k, label in asked)
        parts.append(
            f"at {dose:g} s {found}, {text(f['noise'])} by the noise in plain fat, the tissue that MBIR is told"
        )
    return (
        f"The paper assumes {ASSUMED_FACTOR}×; measured for {METHOD_NAMES[method]} against FBP {fbp_label(*FBP_BASE)}: "
        + "; ".join(parts)
        + "."
    )


def _intro(data: dict[str, Any]) -> str:
    s, t = data["settings"], data["truth"]
    drawn = (
        "The noise of b = AᵀW y is drawn from its covariance (the Gram operator), not in the readings."
        if s["fast_noise"]
        else "Noise is drawn in the readings of the paper's scan; the other main scenes carry the same noise; further "
        "scenes draw the noise of b = AᵀW y from its covariance."
    )
    own = "MBIR's own mean response for all rows with its network, for others " if s["responses"] else ""
    controls = f"{own}linear filters"
    tissues = ", ".join(f"{k} {v:.1f}" for k, v in t["tissues_hu"].items())
    rois = ", ".join(f"{k} {r['foreground_mm2']:.2f} / {r['background_mm2']:.2f}" for k, r in data["rois"].items())
    notes = "".join(f"\n\n{note}" for note in data.get("notes", ()))
    return (
        f"Seeds from {s['seed']}, the same for every method and scene. {s['views']} views; methods on "
        f"{s['voxel_mm']:g} mm voxels. {drawn}\n\n"
        f"ROIs, core / fibrous, mm² over all slices: {rois}. True tissue values, HU, by rods of each tissue at the "
        f"plaque's place: {tissues}; noise-free FBP standard 0.10 mm reads {t['reference_hu'][0]:.1f} / "
        f"{t['reference_hu'][1]:.1f} in the paper's ROIs.\n\n"
        "Behind ±: half of the 95 % interval (jackknife over realisations, regression on linear functionals of "
        f"the same draws whose mean and covariance are exact: {controls}). n “exact”: FBP and linear methods, without "
        "realisations. NMR, "
        "CFR: noise magnitude and central frequency in fat over FBP's. d′: Hotelling observer on the core's shape and "
        "difference-of-Gaussians channels, the same channels and estimate for all; with and without core the draws are "
        "the same, which counts as n draws. RMSE against the true volume. The limit is the best unbiased estimate with "
        "all shapes known; for d′ the ideal observer, which knows all but whether the core is there. A figure above "
        f"the limit is bias, not skill.{notes}"
    )


def _footer(data: dict[str, Any]) -> str:
    e = data["environment"]
    return (
        f"torchpcct {e['torchpcct']}, PyTorch {e['torch']}, {e['cores']} cores. "
        f"Time of the last run, with the pieces it found finished: {data['seconds']:.0f} s."
    )
