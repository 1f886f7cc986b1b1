"""The dose-factor study's tables, text and figures."""

from __future__ import annotations

import math
from typing import Any

from recon.study.dose_factor.analysis import ASSUMED_FACTOR, analyse
from recon.study.dose_factor.facts import fbp_label
from recon.study.dose_factor.figures import curves_figure, images_figure
from recon.study.dose_factor.measure import Measured
from recon.study.dose_factor.measures import LUMEN_HALF_HU, OBSERVERS
from recon.study.dose_factor.methods import METHOD_NAMES
from recon.study.dose_factor.settings import FBP_BASE, MAIN_SCENES
from recon.study.dose_factor.shape_limit import CORRELATION_MM
from recon.study.report import Report, markdown_table
from recon.study.study import environment

__all__ = ["build_report", "headline_method"]

FIGURE_NAMES = {
    "paper_cnr": "paper's CNR",
    "contrast_variance": "contrast variance",
    "d_prime_axial": "d′, axial image",
    "auc_axial": "AUC, axial image",
    "d_prime_volume": "d′, volume",
    "auc_volume": "AUC, volume",
}


def headline_method(methods: Any) -> str:
    """The method that the first sentence is about: MBIR, or the last one that ran."""
    names = list(methods)
    return "mbir" if "mbir" in names else names[-1]


def build_report(measured: Measured) -> Report:
    """``report.json``, ``report.md``, ``dose_factor.png`` and ``dose_factor_images.png``."""
    data = {"study": "dose-factor", **analyse(measured), "environment": environment()}
    data["command"], data["seconds"] = "", measured.total_seconds
    sections = [
        headline(data),
        "# Measured dose factors",
        _intro(data),
        *(_methods_table(data, dose) for dose in data["settings"]["doses"]),
        _factor_tables(data),
        _limit_table(data),
        _shape_limit_table(data),
        *(_wide_table(data, entry) for entry in data["wide_rois"]),
        _voxel_table(data),
        _fbp_table(data),
        _bias_table(data),
        _observer_table(data),
        _shape_table(data),
        _gain_table(data),
        _scene_table(data),
        _footer(data),
    ]
    figures = {"dose_factor.png": curves_figure(data), "dose_factor_images.png": images_figure(measured, data)}
    return Report("dose-factor", data, "\n\n".join(s for s in sections if s), figures)


def headline(data: dict[str, Any]) -> str:
    """The study's sentence."""
    method = headline_method(data["methods_run"])
    base = fbp_label(*FBP_BASE)
    parts = []
    for entry, limit in zip(_of(data, method), data["ceiling"], strict=True):
        f, c = entry["factors"][base], limit["factors"][base]
        parts.append(
            f"at {entry['exposure_s']:g} s {_text(f['contrast_variance'])} by slope-corrected contrast variance, "
            f"{_text(f['paper_cnr'])} by the paper's CNR, {_text(f['d_prime_axial'])} by d′ of the axial image; "
            f"physics allows at most {c['contrast_variance']:.1f}, {c['paper_cnr']:.1f} and {c['d_prime_axial']:.1f}"
        )
    return (
        f"The paper assumes {ASSUMED_FACTOR}×; measured for {METHOD_NAMES[method]} against FBP {base}: "
        + "; ".join(parts)
        + "."
    )


def _of(data: dict[str, Any], method: str) -> list[dict[str, Any]]:
    return [e for e in data["methods"] if e["method"] == method]


def _at(data: dict[str, Any], dose: float) -> list[dict[str, Any]]:
    return [e for e in data["methods"] if e["exposure_s"] == dose]


def _text(e: Any, digits: int = 2, unit: str = "") -> str:
    """Value and interval; a figure that is out of range or missing says so."""
    if e is None:
        return "–"
    if "text" in e:
        return str(e["text"])
    if e.get("value") is None:
        return "–"
    value = f"{e['value']:.{digits}f}{unit}"
    if e.get("low") is None and e.get("high") is None:
        return value
    low, high = (("−∞", "∞")[k] if e[n] is None else f"{e[n]:.{digits}f}" for k, n in enumerate(("low", "high")))
    return f"{value} [{low}, {high}]"


def _intro(data: dict[str, Any]) -> str:
    s, r, t = data["settings"], data["rois"], data["truth"]
    drawn = (
        "The noise of b = AᵀW y is drawn from its covariance (the Gram operator), not in the readings."
        if s["fast_noise"]
        else "Noise is drawn in the readings of the paper's and the absent core's scan; half and flipped contrast "
        "carry the paper scan's noise; further scenes draw the noise of b = AᵀW y from its covariance."
    )
    tissues = ", ".join(f"{k} {v:.1f}" for k, v in t["tissues_hu"].items())
    counts = ", ".join(f"{METHOD_NAMES[e['method']]} {e['realizations']}" for e in _at(data, s["doses"][0]))
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


def _methods_table(data: dict[str, Any], dose: float) -> str:
    limit = next(c for c in data["ceiling"] if c["exposure_s"] == dose)
    header = ["method", "paper's CNR", "slope", "false contrast, HU", "contrast SD, HU", "corrected SD, HU",
              "efficiency, %", "to linear (variance)", "s / volume"]  # fmt: skip
    rows = [
        [
            "limit of the data",
            f"{limit['paper_cnr']:.2f}",
            "1",
            "0",
            "",
            f"{limit['contrast_sd_hu']:.2f}",
            "100",
            "",
            "",
        ]
    ]
    for fbp in data["fbp"]:
        e = next(d for d in fbp["doses"] if d["exposure_s"] == dose)
        share = 100 * (limit["contrast_sd_hu"] / e["contrast_sd_hu"]) ** 2
        rows.append([
            f"FBP {fbp['label']}, exact", f"{e['paper_cnr']:.2f}", f"{fbp['slope']:.3f}",
            f"{fbp['false_contrast_hu']:.1f}", f"{e['contrast_sd_raw_hu']:.1f}", f"{e['contrast_sd_hu']:.1f}",
            f"{share:.0f}", "", "",
        ])  # fmt: skip
    for e in _at(data, dose):
        to_linear = e["to_linear"]["contrast_variance"] if e["to_linear"] else None
        share = {k: None if v is None else 100 * v for k, v in e["efficiency"].items() if k != "why"}
        rows.append([
            METHOD_NAMES[e["method"]], _text(e["paper_cnr"]), _text(e["slope"], 3), _text(e["false_contrast_hu"], 1),
            _text(e["contrast_sd_raw_hu"], 1), _text(e["contrast_sd_hu"], 1), _text(share, 0),
            _text(to_linear), f"{e['seconds_per_volume']:.2f}",
        ])  # fmt: skip
    return f"## {dose:g} s\n\n{markdown_table(header, rows)}"


def _factor_tables(data: dict[str, Any]) -> str:
    """Dose factors against the reference FBP in full, against the others by variance."""
    base = fbp_label(*FBP_BASE)
    parts = [f"## Dose factors against FBP {base}\n\nDose at which FBP reaches the method's figure at 1×; last row of "
             "each dose: the limit."]  # fmt: skip
    header = ["dose, method", *FIGURE_NAMES.values(), "variance, same edge width"]
    rows = []
    for limit in data["ceiling"]:
        dose, c = limit["exposure_s"], limit["factors"][base]
        for e in _at(data, dose):
            f = e["factors"][base]
            cells = [_text(f[k]) for k in FIGURE_NAMES]
            rows.append([f"{dose:g} s, {METHOD_NAMES[e['method']]}", *cells, _text(e["matched_edge"])])
        cells = [f"{c[k.replace('auc', 'd_prime')]:.2f}" for k in FIGURE_NAMES]
        rows.append([f"{dose:g} s, limit", *cells, ""])
    parts.append(markdown_table(header, rows))
    labels = [f["label"] for f in data["fbp"] if not f["blur_mm"]]
    method = headline_method(data["methods_run"])
    rows = []
    for e, limit in zip(_of(data, method), data["ceiling"], strict=True):
        for label in labels:
            f, c = e["factors"][label], limit["factors"][label]
            rows.append([
                f"{e['exposure_s']:g} s, FBP {label}",
                *(f"{_text(f[k])} (≤ {c[k]:.1f})" for k in ("paper_cnr", "contrast_variance", "d_prime_axial")),
            ])  # fmt: skip
    parts.append(f"{METHOD_NAMES[method]} against every FBP kernel (in brackets: the limit):")
    parts.append(markdown_table(["against", "paper's CNR", "contrast variance", "d′, axial image"], rows))
    return "\n\n".join(parts)


def _limit_table(data: dict[str, Any]) -> str:
    method = headline_method(data["methods_run"])
    keys = ("paper_cnr", "contrast_variance", *(f"d_prime_{o}" for o in OBSERVERS))
    rows = []
    for limit, e in zip(data["ceiling"], _of(data, method), strict=True):
        for label, c in limit["factors"].items():
            cells = []
            for k in keys:
                f = e["factors"][label][k]
                cells.append(f"{'yes' if c[k] >= ASSUMED_FACTOR else 'no'} ({c[k]:.1f}), {_reached(f)}")
            rows.append([f"{limit['exposure_s']:g} s, {label}", *cells])
    return f"## Is {ASSUMED_FACTOR}× below the limit, and does {METHOD_NAMES[method]} reach it?\n\n" + markdown_table(
        ["FBP", *(FIGURE_NAMES[k] for k in keys)], rows
    )


def _reached(f: dict[str, Any]) -> str:
    if "text" not in f:
        return "–"
    # A missing end is a dose beyond the curve: 0 is kept as a number, Inf is not.
    low = math.inf if f["low"] is None else f["low"]
    high = math.inf if f["high"] is None else f["high"]
    if low >= ASSUMED_FACTOR:
        return "reached"
    return "not reached" if high < ASSUMED_FACTOR else "undecided"


def _shape_limit_table(data: dict[str, Any]) -> str:
    if not data["shape_limits"]:
        return ""
    rows = [
        [
            f"{e['exposure_s']:g} s, {e['displacement_mm']:g} mm",
            f"{e['contrast_sd_hu']:.1f}",
            f"{100 * e['share']:.0f}",
            f"{e['factor']:.1f}",
        ]
        for e in data["shape_limits"]
    ]
    return (
        "## What not knowing the shapes costs\n\nThe limit takes every outline as known. Here all outlines are "
        "displaced along their normals by a smooth random field of the given standard deviation (correlation "
        f"{CORRELATION_MM:g} mm), which the data must tell together with the tissues "
        "(`recon.limits.deformation_limit`; 0 mm: shapes known). The factor is the largest by contrast variance "
        f"against FBP {fbp_label(*FBP_BASE)}.\n\n"
        + markdown_table(["displacement, SD", "contrast SD, HU", "% of the limit", "largest factor"], rows)
    )


_WIDE_TITLES = {
    "section": "all of core and fibrous tissue in the axial image",
    "tissue": "all of core and fibrous tissue in the slices of the core",
}


def _wide_table(data: dict[str, Any], entry: dict[str, Any]) -> str:
    """Efficiencies and factors in a wider ROI."""
    base = f"FBP {fbp_label(*FBP_BASE)}"
    rows = []
    for e in entry["rows"]:
        share = {k: None if v is None else 100 * v for k, v in e["efficiency"].items() if k != "why"}
        if e["exact"]:
            c = e["limit_factors"]
            name = f"{e['method']}, exact"
            cells = [f"≤ {c[k]:.1f}{'' if c[k] >= ASSUMED_FACTOR else ' (below 5.7)'}" for k in c]
        else:
            name, f = METHOD_NAMES[e["method"]], e["factors"]
            cells = [_text(f[k]) for k in ("paper_cnr", "contrast_variance")]
        rows.append([
            f"{e['exposure_s']:g} s, {name}", _text(e["paper_cnr"]), _text(e["slope"], 3),
            _text(e["contrast_sd_hu"], 1), _text(share, 0), *cells,
        ])  # fmt: skip
    header = ["", "paper's CNR", "slope", "corrected SD, HU", "efficiency, %", "factor, CNR", "factor, variance"]
    rule = entry["rule_mm"]
    return (
        f"## Wider ROI: {_WIDE_TITLES[entry['roi']]}\n\nAt least {rule['core_margin']:g} mm from every edge, "
        f"{rule['lumen_margin']:g} mm from the lumen: core {entry['foreground_mm2']:.2f} mm², fibrous "
        f"{entry['background_mm2']:.2f} mm², all slices added up. Factors of methods against {base}; of FBP the "
        f"largest factor that the limit allows against it.\n\n{markdown_table(header, rows)}"
    )


def _voxel_table(data: dict[str, Any]) -> str:
    if not data["other_voxels"]:
        return ""
    rows = [
        [
            f"{e['exposure_s']:g} s, {e['voxel_mm']:.2f} mm", _text(e["paper_cnr"]), _text(e["slope"], 3),
            *(_text(b, 1) for b in e["bias_hu"]), _text(e["contrast_sd_hu"], 1),
            _text({k: None if v is None else 100 * v for k, v in e["efficiency"].items() if k != "why"}, 0),
        ]
        for e in sorted(data["other_voxels"], key=lambda e: e["exposure_s"])
    ]  # fmt: skip
    header = ["", "paper's CNR", "slope", "core bias, HU", "fibrous bias, HU", "corrected SD, HU", "efficiency, %"]
    return (
        f"## {METHOD_NAMES['mbir']}, on larger voxels\n\nThe volume averaged onto them, as the inference API gives it; "
        f"the paper's ROIs.\n\n{markdown_table(header, rows)}"
    )


def _fbp_table(data: dict[str, Any]) -> str:
    rows = []

    def row(name: str, r: dict[str, Any]) -> list[str]:
        cells = [r.get(k) for k in ("edge_width_mm", "f50_lp_mm", "f10_lp_mm")]
        return [name, *("–" if v is None else f"{v:.2f}" for v in cells)]

    for f in data["fbp"]:
        rows.append(row(f"FBP {f['label']}", f["resolution"]))
    for e in data["methods"]:
        rows.append(row(f"{METHOD_NAMES[e['method']]}, {e['exposure_s']:g} s", e["resolution"]))
    return (
        "## Resolution at the core's own contrast\n\nEdge of the core in the ensemble mean, present minus absent.\n\n"
        + markdown_table(["", "10–90 % width, mm", "f50, lp/mm", "f10, lp/mm"], rows)
    )


def _bias_table(data: dict[str, Any]) -> str:
    rows = []
    for e in data["methods"]:
        cells = [_text(b, 1) for b in (*e["bias_hu"], *e["bias_to_reference_hu"])]
        contrasts = " / ".join(f"{e['contrasts_hu'][k]:.1f}" for k in MAIN_SCENES)
        rows.append([f"{METHOD_NAMES[e['method']]}, {e['exposure_s']:g} s", *cells, contrasts])
    true = " / ".join(f"{v:.1f}" for v in data["truth"]["contrasts_hu"].values())
    header = ["", "core, true", "fibrous, true", "core, FBP 0.1 mm", "fibrous, FBP 0.1 mm", "contrasts"]
    return (
        "## Bias of the ROI means, HU\n\nAgainst the true tissue and against noise-free FBP standard 0.10 mm; mean "
        f"contrast at true contrasts {true} HU.\n\n{markdown_table(header, rows)}"
    )


def _observer_table(data: dict[str, Any]) -> str:
    rows = []
    for e in data["methods"]:
        for observer in OBSERVERS:
            o = e["observer"][observer]
            fbp = next(f for f in data["fbp"] if f["label"] == fbp_label(*FBP_BASE))
            exact = next(d for d in fbp["doses"] if d["exposure_s"] == e["exposure_s"])
            rows.append([
                f"{METHOD_NAMES[e['method']]}, {e['exposure_s']:g} s, {observer}", _text(o["d_prime"]),
                f"{exact[f'd_prime_{observer}']:.2f}", _text(o["auc"], 4), _text(o.get("auc_fbp"), 4),
                _text(o.get("false_positives_to_fbp"), 3),
            ])  # fmt: skip
    header = ["", "d′", "d′ FBP, exact", "AUC", "AUC FBP", "false positives − FBP's"]
    return (
        "## Observer: core present or absent\n\nChannelised Hotelling observer (the core's shape and difference-of-"
        "Gaussians channels), trained with each pair left out in turn; FBP with its exact covariance. False positives "
        f"at a sensitivity of 90 %.\n\n{markdown_table(header, rows)}"
    )


def _shape_table(data: dict[str, Any]) -> str:
    rows = []
    t = data["truth"]

    def cells(shape: dict[str, Any]) -> list[str]:
        lumen, half, cap = shape["lumen_mm2"], shape["lumen_half_mm2"], shape["cap_mm"]
        return [
            _text(lumen["absolute_error"], 3), _text(half["absolute_error"], 3), f"{100 * lumen['lost']:.0f}",
            _text(cap["absolute_error"], 3), f"{100 * cap['lost']:.0f}",
        ]  # fmt: skip

    for e in data["methods"]:
        name = f"{METHOD_NAMES[e['method']]}, {e['exposure_s']:g} s"
        if "fbp_shape" in e and e is _at(data, e["exposure_s"])[0]:
            rows.append([f"FBP {fbp_label(*FBP_BASE)}, {e['exposure_s']:g} s", *cells(e["fbp_shape"])])
        rows.append([name, *cells(e["shape"])])
    header = ["", "lumen at 250 HU, |error|, mm²", "at half maximum", "lost, %", "cap |error|, mm", "lost, %"]
    return (
        "## Lumen area and cap thickness in single realisations\n\n"
        f"True: {t['lumen_mm2']:.2f} mm², {t['cap_mm']:.2f} mm. "
        f"Lumen: contour at 250 HU, as in the paper, and at {LUMEN_HALF_HU:.0f} HU, half way between blood and fibrous "
        "tissue; at 250 HU the contour lies outside of a sharp edge (the true volume, averaged over 0.2 mm voxels, is "
        "off by 0.13 mm² there and by 0.07 mm² at half maximum), which blur happens to make up for. Cap: on the line "
        "from lumen to core, from 250 to 70 HU.\n\n"
        f"{markdown_table(header, rows)}"
    )


def _gain_table(data: dict[str, Any]) -> str:
    if not data["worst_case_gains"]:
        return ""
    names = [k for k in data["worst_case_gains"][0] if k != "exposure_s"]
    standard = f"FBP {fbp_label('standard', FBP_BASE[1])}"
    rows = []
    for gains in data["worst_case_gains"]:
        cells = [f"{gains[k]:.1f} ({gains[k] / gains[standard]:.2f})" for k in names]
        rows.append([f"{gains['exposure_s']:g} s", *cells])
    return (
        "## Worst-case response\n\nLargest change of the volume, HU mm^1.5 (L2 norm), per perturbation of the data by "
        "one standard deviation in all (norm of the whitened perturbation), by power iteration on the Jacobian at the "
        f"first realisation; in brackets relative to {standard}.\n\n"
        + markdown_table(["", *(METHOD_NAMES.get(k, k) for k in names)], rows)
    )


def _scene_table(data: dict[str, Any]) -> str:
    if not data["scenes"] and not data["scenes_left_out"]:
        return ""
    rows = []
    for e in data["scenes"]:
        name = METHOD_NAMES.get(e["method"], e["method"])
        rows.append([
            f"{e['scene']}, {e['exposure_s']:g} s, {name}", f"{e['true_contrast_hu']:.1f}",
            _text(e["contrast_hu"], 1), *(_text(b, 1) for b in e["bias_hu"]), f"{e['contrast_sd_raw_hu']:.1f}",
            _text(e["paper_cnr"]), _text(e.get("false_contrast_hu"), 1), _text(e.get("auc"), 3),
        ])  # fmt: skip
    header = ["", "true contrast", "contrast, HU", "core bias", "fibrous bias", "SD", "paper's CNR",
              "contrast without core", "AUC of the contrast"]  # fmt: skip
    return (
        "## Further scenes\n\nFBP exact; methods with noise of the scene's own covariance. “Contrast without core” and "
        f"AUC: the same scene with fibrous tissue in place of the core.\n\n{markdown_table(header, rows)}"
        + "".join(f"\n\nLeft out: {k}, {v}." for k, v in data["scenes_left_out"].items())
    )


def _footer(data: dict[str, Any]) -> str:
    e = data["environment"]
    return (
        f"torchpcct {e['torchpcct']}, PyTorch {e['torch']}, {e['cores']} cores. "
        f"Time of the last run, with the pieces it found finished: {data['seconds']:.0f} s."
    )
