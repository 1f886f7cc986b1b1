"""The tables of the dose-factor study: each a section of Markdown, or nothing where there is nothing to show."""

from __future__ import annotations

from typing import Any

from recon.study.dose_factor.measures import LUMEN_HALF_HU, OBSERVERS
from recon.study.dose_factor.merit import FACTOR_NAMES
from recon.study.dose_factor.settings import FBP_BASE, METHOD_NAMES, PURPOSES, ROIS, TWIN_REALIZATIONS, fbp_label
from recon.study.dose_factor.shape_limit import CORRELATION_MM
from recon.study.dose_factor.vessels import FINE_MM
from recon.study.report import markdown_table

__all__ = ["at_dose", "tables", "text"]

BASE = fbp_label(*FBP_BASE)


def tables(data: dict[str, Any]) -> list[str]:
    """All sections, in the order of the report."""
    return [
        *(_dose_section(data, dose) for dose in data["settings"]["doses"]),
        _purposes(data),
        _shape_limit_table(data),
        _slope_table(data),
        _resolution_table(data),
        _shape_table(data),
        _gain_table(data),
        _scene_table(data),
        _vessel_table(data),
    ]


def at_dose(data: dict[str, Any], dose: float) -> list[dict[str, Any]]:
    """Every method's entry at a dose, FBP's first."""
    return [e for e in data["methods"] if e["exposure_s"] == dose]


def text(e: Any, digits: int = 2) -> str:
    """Value, with half of the 95 % interval behind ± where there is one; a dash where there is none."""
    if e is None or e.get("value") is None:
        return "–"
    value = f"{e['value']:.{digits}f}"
    low, high = e.get("low"), e.get("high")
    return value if low is None or high is None else f"{value}±{(high - low) / 2:.{digits}f}"


def _name(e: dict[str, Any]) -> str:
    return str(METHOD_NAMES.get(e["method"], e["method"]))


def _count(e: dict[str, Any]) -> str:
    return "exact" if e["realizations"] is None else str(e["realizations"])


def _dose_section(data: dict[str, Any], dose: float) -> str:
    """One dose: noise, task and error, quantification, dose factors. The same rows in each."""
    entries = at_dose(data, dose)
    limit = next(c for c in data["limits"] if c["exposure_s"] == dose)
    noise = [
        [
            _name(e), _count(e), text(e["fat_sd_hu"], 1), text(e["noise_magnitude_ratio"]),
            text(e["central_frequency_ratio"]), text(e["f50_lp_mm"]["plane"]), text(e["f50_lp_mm"]["z"]),
        ]
        for e in entries
    ]  # fmt: skip
    task = [
        [
            _name(e), *(text(e["d_prime"][o]) for o in OBSERVERS), text(e["rmse_hu"]["vessel"], 1),
            text(e["rmse_hu"]["fat"], 1),
        ]
        for e in entries
    ]  # fmt: skip
    ideal = f"{limit['d_prime']:.2f}"
    task.append(["limit of the data", ideal, ideal, "–", "–"])
    parts = [f"## {dose:g} s", "Noise (HU) and resolution (f50 of the core's edge, line pairs per mm):"]
    parts += [markdown_table(["", "n", "fat SD", "NMR", "CFR", "f50 plane", "f50 z"], noise)]
    parts += ["Task, and error of the image (HU):"]
    parts += [markdown_table(["", "d′ axial", "d′ volume", "RMSE vessel", "RMSE fat"], task)]
    parts += ["Quantification, HU: bias, SD and RMSE of core and fibrous tissue, then of the contrast:"]
    for roi in ROIS:
        parts += [_tissue_table(entries, roi), _contrast_table(entries, roi, limit)]
    parts += [f"Dose factors against FBP {BASE}, last row the limit (σ²: slope-corrected contrast variance):"]
    names = list(FACTOR_NAMES)
    for part in (names[:5], names[5:]):
        rows = [[_name(e), *(text(e["factors"][k]) for k in part)] for e in entries]
        rows.append(["limit of the data", *(_limit(limit["factors"].get(k)) for k in part)])
        parts.append(markdown_table(["", *(FACTOR_NAMES[k] for k in part)], rows))
    return "\n\n".join(parts)


def _limit(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"


_ROI_TITLES = {"paper": "paper's ROIs", "section": "one slice", "tissue": "whole lesion"}


def _tissue_table(entries: list[dict[str, Any]], roi: str) -> str:
    header = [_ROI_TITLES[roi], "core bias", "SD", "RMSE", "fibrous bias", "SD", "RMSE"]
    keys = [f"{tissue}_{key}_hu" for tissue in ("core", "fibrous") for key in ("bias", "sd", "rmse")]
    return markdown_table(header, [[_name(e), *(text(e["rois"][roi][k], 1) for k in keys)] for e in entries])


def _contrast_table(entries: list[dict[str, Any]], roi: str, limit: dict[str, Any]) -> str:
    header = [_ROI_TITLES[roi], "contrast bias", "SD", "RMSE", "slope"]
    rows = []
    for e in entries:
        r, last = e["rois"][roi], {}
        if roi == "paper":
            last = {"CNR": text(e["paper_cnr"])}
        elif roi == "tissue":
            shares = {k: None if v is None else 100 * v for k, v in e["efficiency_tissue"].items()}
            last = {"% of limit": text(shares, 0)}
        rows.append([
            _name(e), text(r["contrast_bias_hu"], 1), text(r["contrast_sd_hu"], 1), text(r["contrast_rmse_hu"], 1),
            text(r["slope"], 3), *last.values(),
        ])  # fmt: skip
    sd = f"{limit['contrast_sd_hu']:.1f}"
    end = {"paper": [f"{limit['paper_cnr']:.2f}"], "tissue": ["100"]}.get(roi, [])
    rows.append(["limit of the data", "0", sd, sd, "1", *end])
    return markdown_table([*header, *last], rows)


def _purposes(data: dict[str, Any]) -> str:
    lines = [f"* {METHOD_NAMES[m]}: {PURPOSES[m]}." for m in data["methods_run"]]
    return "## What each method is for\n\n" + "\n".join(lines)


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
        "(`recon.limits.deformation_limit`; 0 mm: shapes known). The factor is the largest by the contrast of the "
        f"whole lesion against FBP {BASE}.\n\n"
        + markdown_table(["displacement, SD", "contrast SD, HU", "% of the limit", "largest factor"], rows)
    )


def _slope_table(data: dict[str, Any]) -> str:
    names = ("paper", "half_contrast", "flipped_contrast")
    rows = [[f"{_name(e)}, {e['exposure_s']:g} s", *(text(e["slopes"][k], 3) for k in names),
             text(e["rois"]["paper"]["false_contrast_hu"], 1)] for e in data["methods"]]  # fmt: skip
    return (
        "## Contrast slopes in the paper's ROIs\n\nFrom the absent core to contrasts of 1, ½ and −1, and the contrast "
        "seen (HU) where there is none; a nonlinear method has several slopes.\n\n"
        + markdown_table(["", "to 1", "to ½", "to −1", "false contrast"], rows)
    )


def _resolution_table(data: dict[str, Any]) -> str:
    rows = []
    for e in data["methods"]:
        f, m = e["f50_lp_mm"], e["factors"]["noise_matched"]
        sigmas = f"{m['sigma_mm']:.2f} / {m['sigma_z_mm']:.2f}" if "sigma_mm" in m else "–"
        cells = [text(f["plane"]), text(f["z"]), text(e.get("edge_sd_hu"), 1), m.get("against", "–"), sigmas, text(m)]
        rows.append([f"{_name(e)}, {e['exposure_s']:g} s", *cells])
    return (
        "## Noise at matched resolution\n\nBoth at the core's edge: f50 (present minus absent), line pairs per mm, in "
        "plane and along z, and the SD of its voxels, HU. FBP of the softest kernel that is sharp enough, filtered by "
        "Gaussians of σ in plane and along z to the same f50; its variance at the edge over the method's. (A method "
        "that adapts to the image is quiet in plain fat without being sharp: that noise belongs to no resolution.)\n\n"
        + markdown_table(["", "f50 plane", "f50 z", "edge SD", "FBP", "σ / σ z, mm", "factor"], rows)
    )


def _shape_table(data: dict[str, Any]) -> str:
    rows = []
    t = data["truth"]
    for e in data["methods"]:
        if "shape" in e:
            lumen, half, cap = (e["shape"][k] for k in ("lumen_mm2", "lumen_half_mm2", "cap_mm"))
            rows.append([
                f"{_name(e)}, {e['exposure_s']:g} s", text(lumen["absolute_error"], 3), text(half["absolute_error"], 3),
                f"{100 * lumen['lost']:.0f}", text(cap["absolute_error"], 3), f"{100 * cap['lost']:.0f}",
            ])  # fmt: skip
    if not rows:
        return ""
    header = ["", "lumen, 250 HU", "half max", "lost, %", "cap, mm", "lost, %"]
    return (
        "## Lumen area and cap thickness in single realisations\n\n"
        f"Mean absolute error; true: {t['lumen_mm2']:.2f} mm², {t['cap_mm']:.2f} mm. Lumen (mm²): contour at 250 HU, "
        f"as in the paper, and at {LUMEN_HALF_HU:.0f} HU, half way between blood and fibrous tissue. Cap: on the line "
        f"from lumen to core, from 250 to 70 HU.\n\n{markdown_table(header, rows)}"
    )


def _gain_table(data: dict[str, Any]) -> str:
    if not data["worst_case_gains"]:
        return ""
    names = [k for k in data["worst_case_gains"][0] if k != "exposure_s"]
    standard = f"FBP {fbp_label('standard', FBP_BASE[1])}"
    rows = [
        [METHOD_NAMES.get(k, k), *(f"{g[k]:.1f} ({g[k] / g[standard]:.2f})" for g in data["worst_case_gains"])]
        for k in names
    ]
    doses = [f"{g['exposure_s']:g} s" for g in data["worst_case_gains"]]
    return (
        "## Worst-case response\n\nLargest change of the volume, HU mm^1.5 (L2 norm), per perturbation of the data by "
        "one standard deviation in all (norm of the whitened perturbation), by power iteration on the Jacobian at the "
        f"first realisation; in brackets relative to {standard}.\n\n" + markdown_table(["", *doses], rows)
    )


def _count_of(rows: list[dict[str, Any]]) -> str:
    """Realisations of the rows that are not exact."""
    counts = sorted({e["realizations"] for e in rows if e["realizations"] is not None})
    return f"{' … '.join(map(str, counts))} draws, controlled" if counts else "all exact"


def _head(e: dict[str, Any], place: str) -> list[str]:
    method = "FBP" if e["method"].startswith("FBP") else _name(e)
    return [e[place].replace("_", " "), method]


def _by_dose(rows: list[dict[str, Any]]) -> dict[float, list[dict[str, Any]]]:
    return {dose: [e for e in rows if e["exposure_s"] == dose] for dose in sorted({e["exposure_s"] for e in rows})}


def _scene_table(data: dict[str, Any]) -> str:
    if not data["scenes"] and not data["scenes_left_out"]:
        return ""
    parts = []
    for dose, entries in _by_dose(data["scenes"]).items():
        header = [f"{dose:g} s", "", "true", "contrast", "SD", "no core", "slope", "AUC"]
        rows = [
            [
                *_head(e, "scene"), f"{e['true_contrast_hu']:.1f}", text(e["contrast_hu"], 1),
                text(e["contrast_sd_hu"], 1), text(e.get("false_contrast_hu"), 1), text(e.get("slope")),
                text(e.get("auc")),
            ]
            for e in entries
        ]  # fmt: skip
        parts.append(markdown_table(header, rows))
        header = [f"{dose:g} s", "", "core bias", "fibrous bias", "CNR"]
        rows = [[*_head(e, "scene"), *(text(b, 1) for b in e["bias_hu"]), text(e["paper_cnr"])] for e in entries]
        parts.append(markdown_table(header, rows))
    return (
        f"## Further scenes\n\nIn HU; paper's ROIs; FBP {BASE} and linear methods exact; others of "
        f"{_count_of(data['scenes'])} by their own first-order response, with noise of the scene's own covariance. “No "
        "core”, slope and AUC (of normal readings): against the same scene with fibrous tissue in place of the core, "
        f"the first {TWIN_REALIZATIONS} draws.\n\n"
        + "\n\n".join(parts)
        + "".join(f"\n\nLeft out: {k}, {v}." for k, v in data["scenes_left_out"].items())
    )


def _vessel_table(data: dict[str, Any]) -> str:
    if not data["vessels"]:
        return ""
    parts = []
    for roi, title in (("section", "The paper's ROIs in the section across the vessel"), ("tissue", "All tissue")):
        parts.append(f"### {title}")
        for dose, entries in _by_dose([e for e in data["vessels"] if e["roi"] == roi]).items():
            header = [f"{dose:g} s", "", "SD", "no core", "slope", "fat SD", "to linear", "kept"]
            rows = [
                [
                    *_head(e, "vessel"), text(e["contrast_sd_hu"], 1), text(e["false_contrast_hu"], 1),
                    text(e["slope"]), text(e["fat_sd_hu"], 1), text(e["to_linear"]), text(e["kept"]),
                ]
                for e in entries
            ]  # fmt: skip
            parts.append(markdown_table(header, rows))
    return (
        "## Vessels of any direction\n\nThe plaque on a vessel along z, tilted by 45°, in plane, curved and with a "
        f"side branch at 45°: painted on voxels of {FINE_MM:g} mm, which are projected exactly. Linear methods exact; "
        f"others of {_count_of(data['vessels'])}, the same in all vessels. ROIs follow the tissues in space. In HU; "
        f"true contrast {data['vessels'][0]['true_contrast_hu']:.1f}. SD: of the contrast. No core: contrast without "
        f"it. Slope: what the core adds to the contrast, over the true one, of the first {TWIN_REALIZATIONS} draws "
        "with and without it. To linear: slope-corrected contrast variance of the isotropic linear filter over the "
        "method's. Kept: that factor over the straight vessel's.\n\n" + "\n\n".join(parts)
    )
