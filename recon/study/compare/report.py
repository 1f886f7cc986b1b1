"""The comparison's tables and text."""

from __future__ import annotations

import resource
import sys
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import numpy as np

from recon.study.checks import Check, around, checks_section
from recon.study.compare.figures import sections_figure
from recon.study.compare.measure import PWLS, Key, Measured
from recon.study.paper import facts as paper
from recon.study.paper.plaque_scan import REFERENCE_KERNEL, REFERENCE_VOXEL_MM
from recon.study.paper.tables import published, table_checks
from recon.study.report import Report, markdown_table
from recon.study.study import environment, time_line
from torchpcct.metrics.cnr import cnr, cnr_interval, mean_interval, sd_interval

__all__ = ["build_report"]


def build_report(m: Measured) -> Report:
    """Report of :func:`recon.study.compare.measure.measure`: ``report.json``, ``report.md``, ``compare.png``."""
    data: dict[str, Any] = {
        "study": "compare",
        "settings": asdict(m.settings),
        "plan": m.plan,
        "rois": m.rois.as_dict(),
        "noise_free": m.noise_free,
        "statistics": [_statistics(key, means) for key, means in m.means.items()],
        "noise_against_dose": _noise_against_dose(m),
        "pwls": m.pwls,
        "seconds": {k: round(v, 2) for k, v in m.seconds.items()},
    }
    checks = _checks(data)
    data["checks"] = [c.as_dict() for c in checks]
    data["environment"] = environment()
    sections = [
        "# Plaque CNR by FBP and PWLS, beside the paper",
        _intro(data),
        _noise_free_table(data),
        *(_tables(data, name, exposure) for name, exposure in m.settings.doses.items()),
        _noise_table(data),
        _pwls_table(data),
        checks_section(checks, every=False),
        time_line(m.seconds, f"peak memory {_peak_memory_gib():.1f} GiB"),
    ]
    return Report("compare", data, "\n\n".join(s for s in sections if s), {"compare.png": sections_figure(m)})


# --- figures ------------------------------------------------------------------------------------------------------


def _statistics(key: Key, means: Any) -> dict[str, Any]:
    """Means, standard deviations and CNR with their 95 % intervals."""
    result: dict[str, Any] = dict(zip(("method", "kernel", "voxel_mm", "exposure_s"), key, strict=True))
    result["realizations"] = len(means)
    foreground, background = means.T
    for name, values in (("foreground", foreground), ("background", background)):
        sd = float(np.std(values, ddof=1))
        result[name] = {
            "means_hu": values.tolist(),
            "mean_hu": float(np.mean(values)),
            "mean_interval": list(mean_interval(values)),
            "sd_hu": sd,
            "sd_interval": list(sd_interval(sd, len(values))),
        }
    result["cnr"] = float(cnr(foreground, background))
    result["cnr_interval"] = list(cnr_interval(foreground, background))
    return result


def _noise_against_dose(m: Measured) -> list[dict[str, Any]]:
    """Slope of log σ against log dose per method, kernel, voxel size and ROI: −½ for pure counting noise.

    The noise of the voxels (entry ``pixel``, SD across realisations, rms over the inset) pins the slope down; that of
    two ROI means over few realisations does not.
    """
    groups: dict[tuple[str, str, float], list[Key]] = {}
    for key in m.means:
        groups.setdefault(key[:3], []).append(key)
    slopes = []
    for (method, kernel, voxel), keys in groups.items():
        if len(keys) < 2:
            continue
        x = np.log([exposure for *_, exposure in keys])
        entry: dict[str, Any] = {"method": method, "kernel": kernel, "voxel_mm": voxel}
        for i, roi in enumerate(("foreground", "background")):
            sds = [np.std(m.means[key][:, i], ddof=1) for key in keys]
            entry[roi] = float(np.polyfit(x, np.log(sds), 1)[0])
        if all(key in m.voxel_noise for key in keys):
            entry["pixel"] = float(np.polyfit(x, np.log([m.voxel_noise[key] for key in keys]), 1)[0])
        slopes.append(entry)
    return slopes


def _is_reference(entry: dict[str, Any]) -> bool:
    return (entry["kernel"], entry["voxel_mm"]) == (REFERENCE_KERNEL, REFERENCE_VOXEL_MM)


def _checks(data: dict[str, Any]) -> list[Check]:
    """Every row of the paper that this study covers, with its tolerance."""
    checks: list[Check] = []
    for e in data["noise_free"]:
        if _is_reference(e):
            for roi, published_hu in paper.NOISE_FREE_ROI_HU.items():
                checks.append(around(f"noise-free {roi} mean, standard 0.10 mm, HU", e[f"{roi}_hu"], published_hu, 8))
        if "covariance_hu2_s" in e:
            covariance = np.array(e["covariance_hu2_s"]) / paper.TABLE_EXPOSURE_S
            checks += table_checks(e["kernel"], e["voxel_mm"], (e["foreground_hu"], e["background_hu"]), covariance)
    for e in data["noise_against_dose"]:
        if e["method"] == "fbp" and "pixel" in e:
            name = f"slope of voxel noise against dose, {e['kernel']} {e['voxel_mm']:.2f} mm"
            checks.append(Check(name, e["pixel"], -0.5, -0.515, -0.485))
    return checks


# --- text ---------------------------------------------------------------------------------------------------------


def _intro(data: dict[str, Any]) -> str:
    s, r = data["settings"], data["rois"]
    return (
        f"{s['realizations']} noise realisations per dose (seeds {s['seed']}…{s['seed'] + s['realizations'] - 1}, the "
        f"same for every method), {s['views']} views. Foreground ROI (necrotic core): {r['foreground_pixels']} pixels "
        f"of {r['pixel_mm']} mm, {r['foreground_mm2']:.2f} mm²; background ROI (fibrous tissue): "
        f"{r['background_pixels']} pixels, {r['background_mm2']:.2f} mm². "
        "CNR = (mean_bg − mean_fg) / sqrt(var_bg + var_fg) of the ROI means across "
        "realisations. Square brackets: 95 % interval. “exact”: expectation and SD of FBP without sampling error (one "
        "adjoint pass per ROI). The paper's number follows after “paper”; its tables are for "
        f"{paper.TABLE_EXPOSURE_S:g} s (our inference)."
    )


def _label(method: str, kernel: str) -> str:
    return f"{method.upper()} {kernel}"


def _noise_free_table(data: dict[str, Any]) -> str:
    s = data["settings"]
    voxels = [REFERENCE_VOXEL_MM, *s["voxels_mm"]]
    entries = {(e["kernel"], e["voxel_mm"]): e for e in data["noise_free"]}

    def cell(kernel: str, voxel: float) -> str:
        e = entries.get((kernel, voxel))
        if e is None:
            return "–"
        text = f"{e['foreground_hu']:.1f} / {e['background_hu']:.1f}"
        if _is_reference(e):
            p = paper.NOISE_FREE_ROI_HU
            text += f" (paper {p['foreground']:.1f} / {p['background']:.1f})"
        return text

    kernels = list(dict.fromkeys([*s["kernels"], REFERENCE_KERNEL]))
    rows = [[f"FBP {k}", *(cell(k, v) for v in voxels)] for k in kernels]
    table = markdown_table(["core / fibrous, HU", *(f"{v:.2f} mm" for v in voxels)], rows)
    return f"## Noise-free ROI means\n\n{table}"


def _tables(data: dict[str, Any], dose: str, exposure: float) -> str:
    """Measured and exact moments of both ROIs and the CNR at an exposure."""
    s = data["settings"]
    measured = {(e["method"], e["kernel"], e["voxel_mm"]): e for e in data["statistics"] if e["exposure_s"] == exposure}
    exact = {(e["kernel"], e["voxel_mm"]): e for e in data["noise_free"] if "covariance_hu2_s" in e}
    methods = [("fbp", kernel) for kernel in s["kernels"]] + ([PWLS] if s["pwls"] else [])
    parts = [f"## {dose} dose: {exposure:.2f} s"]

    def add(
        title: str, table: Any, found: Callable[[Any], str], of_paper: str, known: Callable[[Any, Any], str]
    ) -> None:
        def cell(method: str, kernel: str, voxel: float) -> str:
            if (method, kernel, voxel) not in measured:
                return "–"
            text = found(measured[method, kernel, voxel])
            entry = published(table, kernel, voxel, exposure) if method == "fbp" else None
            return text if entry is None else f"{text} paper {of_paper.format(*np.atleast_1d(entry))}"

        def exact_cell(kernel: str, voxel: float) -> str:
            e = exact.get((kernel, voxel))
            if e is None:
                return "–"
            return known((e["foreground_hu"], e["background_hu"]), np.diag(e["covariance_hu2_s"]) / exposure)

        rows = [[_label(m, k), *(cell(m, k, v) for v in s["voxels_mm"])] for m, k in methods]
        rows += [[f"FBP {k}, exact", *(exact_cell(k, v) for v in s["voxels_mm"])] for k in s["kernels"]]
        parts.append(markdown_table([title, *(f"{v:.2f} mm" for v in s["voxels_mm"])], rows))

    for i, (roi, title, table) in enumerate(
        (
            ("foreground", "Core ROI mean (SD), HU", paper.FOREGROUND),
            ("background", "Fibrous ROI mean (SD), HU", paper.BACKGROUND),
        )
    ):

        def moments(e: Any, roi: str = roi) -> str:
            low, high = e[roi]["mean_interval"]
            return f"{e[roi]['mean_hu']:.1f} [{low:.0f}, {high:.0f}] ({e[roi]['sd_hu']:.1f})"

        def exact_moments(means: Any, variances: Any, i: int = i) -> str:
            return f"{means[i]:.1f} ({np.sqrt(variances[i]):.1f})"

        add(title, table, moments, "{:.1f} ({:.1f})", exact_moments)

    def ratio(e: Any) -> str:
        low, high = e["cnr_interval"]
        return f"{e['cnr']:.2f} [{low:.1f}, {high:.1f}]"

    def exact_ratio(means: Any, variances: Any) -> str:
        return f"{(means[1] - means[0]) / np.sqrt(variances.sum()):.2f}"

    add("CNR", paper.CNR, ratio, "{:.2f}", exact_ratio)
    return "\n\n".join(parts)


def _noise_table(data: dict[str, Any]) -> str:
    slopes = data["noise_against_dose"]
    if not slopes:
        return ""
    rows = [
        [_label(e["method"], e["kernel"]), f"{e['voxel_mm']:.2f}", f"{e['pixel']:.3f}"] for e in slopes if "pixel" in e
    ]
    text = (
        "## Noise against dose\n\n"
        "Slope of log σ (voxel noise over the inset) against log exposure; −0.5 for counting noise."
    )
    return f"{text}\n\n{markdown_table(['method', 'voxel, mm', 'slope'], rows)}"


def _pwls_table(data: dict[str, Any]) -> str:
    if not data["pwls"]:
        return ""
    rows = [
        [
            f"{e['exposure_s']:.2f} s, {e['voxel_mm']:.2f} mm", str(e["exact_pairs"]), str(sum(e["inner_iterations"])),
            f"{e['gradient'][-1]:.1e}", f"{e['largest_rmsd_hu']:.2f}", f"{e['seconds_per_volume']:.1f}",
        ]
        for e in data["pwls"]
    ]  # fmt: skip
    header = ["PWLS", "exact pairs", "inner steps", "gradient left", "HU from minimum", "s / volume"]
    text = "## PWLS, convergence\n\nFirst realisation; “HU from minimum” is the worst of all, rms over the volume."
    return f"{text}\n\n{markdown_table(header, rows)}"


def _peak_memory_gib() -> float:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**30 if sys.platform == "darwin" else peak / 2**20
