"""The tables of the dose-factor study: each a section of Markdown, or nothing where there is nothing to show."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

from recon.study.dose_factor.measures import LUMEN_HALF_HU, OBSERVERS
from recon.study.dose_factor.settings import FBP_BASE, MAIN_SCENES, METHOD_NAMES, fbp_label
from recon.study.dose_factor.shape_limit import CORRELATION_MM
from recon.study.dose_factor.vessels import FINE_MM, TWIN_REALIZATIONS
from recon.study.paper.facts import ASSUMED_FACTOR
from recon.study.report import markdown_table

__all__ = ["at_dose", "headline_method", "of_method", "tables", "text"]

BASE = fbp_label(*FBP_BASE)

FIGURE_NAMES = {
    "paper_cnr": "paper's CNR",
    "contrast_variance": "contrast variance",
    "d_prime_axial": "d′, axial image",
    "auc_axial": "AUC, axial image",
    "d_prime_volume": "d′, volume",
    "auc_volume": "AUC, volume",
}


def tables(data: dict[str, Any]) -> list[str]:
    """All sections, in the order of the report."""
    return [
        *(_methods_table(data, dose) for dose in data["settings"]["doses"]),
        _factor_tables(data),
        _limit_table(data),
        _shape_limit_table(data),
        *(_wide_table(entry) for entry in data["wide_rois"]),
        _voxel_table(data),
        _resolution_table(data),
        _bias_table(data),
        _observer_table(data),
        _shape_table(data),
        _gain_table(data),
        _scene_table(data),
        _vessel_table(data),
    ]


def headline_method(methods: Iterable[str]) -> str:
    """The method that the first sentence is about: MBIR, or the last one that ran."""
    names = list(methods)
    return "mbir" if "mbir" in names else names[-1]


def of_method(data: dict[str, Any], method: str) -> list[dict[str, Any]]:
    """A method's entries, one for every dose."""
    return [e for e in data["methods"] if e["method"] == method]


def at_dose(data: dict[str, Any], dose: float) -> list[dict[str, Any]]:
    """Every method's entry at a dose."""
    return [e for e in data["methods"] if e["exposure_s"] == dose]


def text(e: Any, digits: int = 2) -> str:
    """Value and interval; a figure that is out of range or missing says so."""
    if e is None:
        return "–"
    if "text" in e:
        return str(e["text"])
    if e.get("value") is None:
        return "–"
    value = f"{e['value']:.{digits}f}"
    if e.get("low") is None and e.get("high") is None:
        return value
    low, high = (("−∞", "∞")[k] if e[n] is None else f"{e[n]:.{digits}f}" for k, n in enumerate(("low", "high")))
    return f"{value} [{low}, {high}]"


def _percent(e: dict[str, Any]) -> str:
    """A share with its interval."""
    return text({k: None if v is None else 100 * v for k, v in e.items() if k != "why"}, 0)


def _name(e: dict[str, Any]) -> str:
    return f"{METHOD_NAMES[e['method']]}, {e['exposure_s']:g} s"


def _methods_table(data: dict[str, Any], dose: float) -> str:
    limit = next(c for c in data["ceiling"] if c["exposure_s"] == dose)
    header = ["method", "paper's CNR", "slope", "false contrast, HU", "contrast SD, HU", "corrected SD, HU",
              "efficiency, %", "to linear (variance)", "s / volume"]  # fmt: skip
    ideal = f"{limit['contrast_sd_hu']:.2f}"
    rows = [["limit of the data", f"{limit['paper_cnr']:.2f}", "1", "0", "", ideal, "100", "", ""]]
    for fbp in data["fbp"]:
        e = next(d for d in fbp["doses"] if d["exposure_s"] == dose)
        share = 100 * (limit["contrast_sd_hu"] / e["contrast_sd_hu"]) ** 2
        rows.append([
            f"FBP {fbp['label']}, exact", f"{e['paper_cnr']:.2f}", f"{fbp['slope']:.3f}",
            f"{fbp['false_contrast_hu']:.1f}", f"{e['contrast_sd_raw_hu']:.1f}", f"{e['contrast_sd_hu']:.1f}",
            f"{share:.0f}", "", "",
        ])  # fmt: skip
    for e in at_dose(data, dose):
        to_linear = e["to_linear"]["contrast_variance"] if e["to_linear"] else None
        rows.append([
            METHOD_NAMES[e["method"]], text(e["paper_cnr"]), text(e["slope"], 3), text(e["false_contrast_hu"], 1),
            text(e["contrast_sd_raw_hu"], 1), text(e["contrast_sd_hu"], 1), _percent(e["efficiency"]),
            text(to_linear), f"{e['seconds_per_volume']:.2f}",
        ])  # fmt: skip
    return f"## {dose:g} s\n\n{markdown_table(header, rows)}"


def _factor_tables(data: dict[str, Any]) -> str:
    """Dose factors against the reference FBP in full, against the others by variance."""
    parts = [f"## Dose factors against FBP {BASE}\n\nDose at which FBP reaches the method's figure at 1×; last row of "
             "each dose: the limit."]  # fmt: skip
    header = ["dose, method", *FIGURE_NAMES.values(), "variance, same edge width"]
    rows = []
    for limit in data["ceiling"]:
        dose, c = limit["exposure_s"], limit["factors"][BASE]
        for e in at_dose(data, dose):
            f = e["factors"][BASE]
            cells = [text(f[k]) for k in FIGURE_NAMES]
            rows.append([f"{dose:g} s, {METHOD_NAMES[e['method']]}", *cells, text(e["matched_edge"])])
        cells = [f"{c[k.replace('auc', 'd_prime')]:.2f}" for k in FIGURE_NAMES]
        rows.append([f"{dose:g} s, limit", *cells, ""])
    parts.append(markdown_table(header, rows))
    labels = [f["label"] for f in data["fbp"] if not f["blur_mm"]]
    method = headline_method(data["methods_run"])
    rows = []
    for e, limit in zip(of_method(data, method), data["ceiling"], strict=True):
        for label in labels:
            f, c = e["factors"][label], limit["factors"][label]
            rows.append([
                f"{e['exposure_s']:g} s, FBP {label}",
                *(f"{text(f[k])} (≤ {c[k]:.1f})" for k in ("paper_cnr", "contrast_variance", "d_prime_axial")),
            ])  # fmt: skip
    parts.append(f"{METHOD_NAMES[method]} against every FBP kernel (in brackets: the limit):")
    parts.append(markdown_table(["against", "paper's CNR", "contrast variance", "d′, axial image"], rows))
    return "\n\n".join(parts)


def _limit_table(data: dict[str, Any]) -> str:
    method = headline_method(data["methods_run"])
    keys = ("paper_cnr", "contrast_variance", *(f"d_prime_{o}" for o in OBSERVERS))
    rows = []
    for limit, e in zip(data["ceiling"], of_method(data, method), strict=True):
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
            f"{e['exposure_s']:g} s, {e['displacement_mm']:g} mm", f"{e['contrast_sd_hu']:.1f}",
            f"{100 * e['share']:.0f}", f"{e['factor']:.1f}",
        ]
        for e in data["shape_limits"]
    ]  # fmt: skip
    return (
        "## What not knowing the shapes costs\n\nThe limit takes every outline as known. Here all outlines are "
        "displaced along their normals by a smooth random field of the given standard deviation (correlation "
        f"{CORRELATION_MM:g} mm), which the data must tell together with the tissues "
        "(`recon.limits.deformation_limit`; 0 mm: shapes known). The factor is the largest by contrast variance "
        f"against FBP {BASE}.\n\n"
        + markdown_table(["displacement, SD", "contrast SD, HU", "% of the limit", "largest factor"], rows)
    )


_WIDE_TITLES = {
    "section": "all of core and fibrous tissue in the axial image",
    "tissue": "all of core and fibrous tissue in the slices of the core",
}


def _wide_table(entry: dict[str, Any]) -> str:
    """Efficiencies and factors in a wider ROI."""
    rows = []
    for e in entry["rows"]:
        if e["exact"]:
            c = e["limit_factors"]
            name = f"{e['method']}, exact"
            cells = [f"≤ {c[k]:.1f}{'' if c[k] >= ASSUMED_FACTOR else f' (below {ASSUMED_FACTOR})'}" for k in c]
        else:
            name, f = METHOD_NAMES[e["method"]], e["factors"]
            cells = [text(f[k]) for k in ("paper_cnr", "contrast_variance")]
        rows.append([
            f"{e['exposure_s']:g} s, {name}", text(e["paper_cnr"]), text(e["slope"], 3),
            text(e["contrast_sd_hu"], 1), _percent(e["efficiency"]), *cells,
        ])  # fmt: skip
    header = ["", "paper's CNR", "slope", "corrected SD, HU", "efficiency, %", "factor, CNR", "factor, variance"]
    rule = entry["rule_mm"]
    return (
        f"## Wider ROI: {_WIDE_TITLES[entry['roi']]}\n\nAt least {rule['core_margin']:g} mm from every edge, "
        f"{rule['lumen_margin']:g} mm from the lumen: core {entry['foreground_mm2']:.2f} mm², fibrous "
        f"{entry['background_mm2']:.2f} mm², all slices added up. Factors of methods against FBP {BASE}; of FBP the "
        f"largest factor that the limit allows against it.\n\n{markdown_table(header, rows)}"
    )


def _voxel_table(data: dict[str, Any]) -> str:
    if not data["other_voxels"]:
        return ""
    rows = [
        [
            f"{e['exposure_s']:g} s, {e['voxel_mm']:.2f} mm", text(e["paper_cnr"]), text(e["slope"], 3),
            *(text(b, 1) for b in e["bias_hu"]), text(e["contrast_sd_hu"], 1), _percent(e["efficiency"]),
        ]
        for e in sorted(data["other_voxels"], key=lambda e: e["exposure_s"])
    ]  # fmt: skip
    header = ["", "paper's CNR", "slope", "core bias, HU", "fibrous bias, HU", "corrected SD, HU", "efficiency, %"]
    return (
        f"## {METHOD_NAMES['mbir']}, on larger voxels\n\nThe volume averaged onto them, as the inference API gives it; "
        f"the paper's ROIs.\n\n{markdown_table(header, rows)}"
    )


def _resolution_table(data: dict[str, Any]) -> str:
    entries = [(f"FBP {f['label']}", f["resolution"]) for f in data["fbp"]]
    entries += [(_name(e), e["resolution"]) for e in data["methods"]]
    keys = ("edge_width_mm", "f50_lp_mm", "f10_lp_mm")
    rows = [[name, *("–" if r.get(k) is None else f"{r[k]:.2f}" for k in keys)] for name, r in entries]
    return (
        "## Resolution at the core's own contrast\n\nEdge of the core in the ensemble mean, present minus absent.\n\n"
        + markdown_table(["", "10–90 % width, mm", "f50, lp/mm", "f10, lp/mm"], rows)
    )


def _bias_table(data: dict[str, Any]) -> str:
    rows = []
    for e in data["methods"]:
        cells = [text(b, 1) for b in (*e["bias_hu"], *e["bias_to_reference_hu"])]
        contrasts = " / ".join(f"{e['contrasts_hu'][k]:.1f}" for k in MAIN_SCENES)
        rows.append([_name(e), *cells, contrasts])
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
            fbp = next(f for f in data["fbp"] if f["label"] == BASE)
            exact = next(d for d in fbp["doses"] if d["exposure_s"] == e["exposure_s"])
            rows.append([
                f"{_name(e)}, {observer}", text(o["d_prime"]),
                f"{exact[f'd_prime_{observer}']:.2f}", text(o["auc"], 4), text(o.get("auc_fbp"), 4),
                text(o.get("false_positives_to_fbp"), 3),
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
            text(lumen["absolute_error"], 3), text(half["absolute_error"], 3), f"{100 * lumen['lost']:.0f}",
            text(cap["absolute_error"], 3), f"{100 * cap['lost']:.0f}",
        ]  # fmt: skip

    for e in data["methods"]:
        if "fbp_shape" in e and e is at_dose(data, e["exposure_s"])[0]:
            rows.append([f"FBP {BASE}, {e['exposure_s']:g} s", *cells(e["fbp_shape"])])
        rows.append([_name(e), *cells(e["shape"])])
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
            text(e["contrast_hu"], 1), *(text(b, 1) for b in e["bias_hu"]), f"{e['contrast_sd_raw_hu']:.1f}",
            text(e["paper_cnr"]), text(e.get("false_contrast_hu"), 1), text(e.get("auc"), 3),
        ])  # fmt: skip
    header = ["", "true contrast", "contrast, HU", "core bias", "fibrous bias", "SD", "paper's CNR",
              "contrast without core", "AUC of the contrast"]  # fmt: skip
    return (
        "## Further scenes\n\nFBP exact; methods with noise of the scene's own covariance. “Contrast without core” and "
        f"AUC: the same scene with fibrous tissue in place of the core.\n\n{markdown_table(header, rows)}"
        + "".join(f"\n\nLeft out: {k}, {v}." for k, v in data["scenes_left_out"].items())
    )


def _vessel_table(data: dict[str, Any]) -> str:
    if not data["vessels"]:
        return ""
    header = ["", "contrast, HU", "SD", "contrast without core", "slope", "SD in fat, HU", "to linear (variance)",
              "gain kept"]  # fmt: skip
    parts = []
    for roi, title in (("section", "The paper's ROIs in the section across the vessel"), ("tissue", "All tissue")):
        rows = [
            [
                f"{e['vessel'].replace('_', ' ')}, {e['exposure_s']:g} s, {METHOD_NAMES[e['method']]}",
                text(e["contrast_hu"], 1), f"{e['contrast_sd_raw_hu']:.1f}", text(e["false_contrast_hu"], 1),
                text(e["slope"], 3), text(e["fat_sd_hu"], 1), text(e["to_linear"]), text(e["kept"]),
            ]
            for e in data["vessels"] if e["roi"] == roi
        ]  # fmt: skip
        parts.append(f"### {title}\n\n{markdown_table(header, rows)}")
    e = data["vessels"][0]
    return (
        "## Vessels of any direction\n\nThe plaque on a vessel along z, tilted by 45°, in plane, curved and with a "
        f"side branch at 45°: painted on voxels of {FINE_MM:g} mm, which are projected exactly; {e['realizations']} "
        "realisations with noise of the paper scene's covariance, the same in all vessels. ROIs follow the tissues in "
        f"space. True contrast {e['true_contrast_hu']:.1f} HU. Slope: what the core adds to the contrast, over the "
        f"true one, from the first {TWIN_REALIZATIONS} realisations with and without it. To linear: slope-corrected "
        "contrast variance of the isotropic linear filter over the method's, on the same noise. Gain kept: that "
        "factor over the straight vessel's.\n\n" + "\n\n".join(parts)
    )
