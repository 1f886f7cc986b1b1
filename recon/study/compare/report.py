"""The comparison's tables and text."""

from __future__ import annotations

import resource
import sys
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from recon.evaluate.report import plain, task_sections
from recon.study.checks import Check, around
from recon.study.compare.answer import answer, claim
from recon.study.compare.figures import sections_figure
from recon.study.compare.measure import Key, Measured
from recon.study.compare.placements import SHIFT_MM
from recon.study.compare.tables import is_reference, noise_free_table, tables
from recon.study.paper import facts as paper
from recon.study.paper.tables import table_checks
from recon.study.report import Report, markdown_table
from recon.study.study import environment, time_line
from torchpcct.metrics.cnr import cnr, cnr_interval, mean_interval, sd_interval

__all__ = ["build_report"]


def build_report(m: Measured) -> Report:
    """Report of :func:`recon.study.compare.measure.measure`: ``report.json``, ``report.md``, ``compare.png``."""
    records = m.evaluation.records if m.evaluation else []
    data: dict[str, Any] = {
        "study": "compare",
        "settings": asdict(m.settings),
        "plan": m.plan,
        "rois": m.rois.as_dict(),
        "claim": claim(records),
        "records": plain(records),
        "noise_free": m.noise_free,
        "statistics": [_statistics(key, means) for key, means in m.means.items()],
        "noise_against_dose": _noise_against_dose(m),
        "placements": [p.as_dict() for p in m.placements],
        "seconds": {k: round(v, 2) for k, v in m.seconds.items()},
    }
    data["answer"] = answer(data)
    checks = _checks(data)
    causes = [_cause(c, m) for c in checks]
    data["checks"] = [_noted(c, cause).as_dict() for c, cause in zip(checks, causes, strict=True)]
    data["causes"] = [cause for cause in causes if cause is not None]
    data["environment"] = environment()
    measured = task_sections(m.evaluation) if m.evaluation else []
    sections = [
        "# What MBIR saves at the paper's plaque, and the paper's CNR tables",
        data["answer"],
        *measured,
        _intro(data),
        noise_free_table(data),
        *(tables(data, name, exposure) for name, exposure in m.settings.doses.items()),
        _noise_table(data),
        _agreement(checks, data),
        _FITTED,
        time_line(m.seconds, f"peak memory {_peak_memory_gib():.1f} GiB"),
    ]
    text, screen = ("\n\n".join(s for s in part if s) for part in (sections, [data["answer"], *measured]))
    return Report("compare", data, text, {"compare.png": sections_figure(m)}, screen)


_FITTED = (
    "## What was fitted to the paper's tables, and what was not\n\n"
    "Fitted, or inferred from the very figures that are compared: the rule that places the two ROIs "
    "(torchpcct/metrics/placement.py: from their noise-free means and the ratio of their SDs), the exposure of the "
    "tables (from the size of their SDs), and in the bowtie study the width of the ROI bowtie's ramp (from the dose in "
    "the peripheral bores). Inferred from other statements of the paper: the detector's pitch. Not fitted to these "
    "tables: vessel, wall, cap and core (torchpcct/scene/plaque says what the paper leaves open), materials, spectrum, "
    "tube output (from the public CatSim spectrum), detector, kernels (public CatSim points; “detail” is assumed "
    "midway between standard and bone), PWLS and MBIR."
)


# --- figures ------------------------------------------------------------------------------------------------------


def _statistics(key: Key, means: Any) -> dict[str, Any]:
    """Means, standard deviations and CNR with their 95 % intervals."""
    result: dict[str, Any] = dict(zip(("kernel", "voxel_mm", "exposure_s"), key, strict=True))
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
    """Slope of log σ against log dose per kernel, voxel size and ROI: −½ for pure counting noise.

    The noise of the voxels (entry ``pixel``, SD across realisations, rms over the inset) pins the slope down; that of
    two ROI means over few realisations does not.
    """
    groups: dict[tuple[str, float], list[Key]] = {}
    for key in m.means:
        groups.setdefault(key[:2], []).append(key)
    slopes = []
    for (kernel, voxel), keys in groups.items():
        if len(keys) < 2:
            continue
        x = np.log([exposure for *_, exposure in keys])
        entry: dict[str, Any] = {"kernel": kernel, "voxel_mm": voxel}
        for i, roi in enumerate(("foreground", "background")):
            sds = [np.std(m.means[key][:, i], ddof=1) for key in keys]
            entry[roi] = float(np.polyfit(x, np.log(sds), 1)[0])
        if all(key in m.voxel_noise for key in keys):
            entry["pixel"] = float(np.polyfit(x, np.log([m.voxel_noise[key] for key in keys]), 1)[0])
        slopes.append(entry)
    return slopes


def _checks(data: dict[str, Any]) -> list[Check]:
    """Every row of the paper that this study covers, with its tolerance."""
    checks: list[Check] = []
    for e in data["noise_free"]:
        if is_reference(e):
            for roi, published_hu in paper.NOISE_FREE_ROI_HU.items():
                checks.append(around(f"noise-free {roi} mean, standard 0.10 mm, HU", e[f"{roi}_hu"], published_hu, 8))
        if "covariance_hu2_s" in e:
            covariance = np.array(e["covariance_hu2_s"]) / paper.TABLE_EXPOSURE_S
            found = table_checks(e["kernel"], e["voxel_mm"], (e["foreground_hu"], e["background_hu"]), covariance)
            checks += found
    for e in data["noise_against_dose"]:
        if "pixel" in e:
            name = f"slope of voxel noise against dose, {e['kernel']} {e['voxel_mm']:.2f} mm"
            checks.append(Check(name, e["pixel"], -0.5, -0.515, -0.485))
    return checks


def _cause(check: Check, m: Measured) -> dict[str, Any] | None:
    """The ranges that a mean or SD outside its tolerance takes where ROIs and grid lie elsewhere; None: no such check.

    ``"placements"`` of the exact figure; ``"runs"`` of as many realisations as the paper has; ``"inside"`` the first of
    them that holds the paper's value, or ``"none"``."""
    what, _, setting = check.name.partition(", ")
    roi, _, quantity = what.partition(" ")
    varied = [p for p in m.placements if setting.startswith(f"{p.kernel} {p.voxel_mm:.2f} mm")]
    if check.ok or roi not in ("core", "fibrous") or not varied or isinstance(check.paper, str):
        return None
    ranges = {
        name: varied[0].range_of(roi, quantity, paper.TABLE_EXPOSURE_S, runs)
        for name, runs in (("placements", None), ("runs", paper.REALIZATIONS))
    }
    inside = next((name for name, (low, high) in ranges.items() if low <= check.paper <= high), "none")
    return {"check": check.name, **ranges, "inside": inside}


def _noted(check: Check, cause: dict[str, Any] | None) -> Check:
    """The check with its cause in words."""
    if cause is None:
        return check
    first, second = (f"{cause[name][0]:.1f} … {cause[name][1]:.1f}" for name in ("placements", "runs"))
    where = {"placements": "in both ranges", "runs": "in the second range only", "none": "in neither"}[cause["inside"]]
    return replace(
        check, note=f"{first} over placements, {second} in {paper.REALIZATIONS} runs; the paper's value lies {where}"
    )


# --- text ---------------------------------------------------------------------------------------------------------


def _intro(data: dict[str, Any]) -> str:
    s, r = data["settings"], data["rois"]
    n = s["realizations"]
    low, high = sd_interval(1.0, n)
    half = float(mean_interval(np.linspace(-1.0, 1.0, n))[1] / np.std(np.linspace(-1.0, 1.0, n), ddof=1))
    return (
        f"## The paper's tables\n\n{n} noise realisations of FBP per dose (seeds {s['seed']}…{s['seed'] + n - 1}, the "
        f"same for every method), {s['views']} views. Foreground ROI (necrotic core): {r['foreground_pixels']} pixels "
        f"of {r['pixel_mm']} mm, {r['foreground_mm2']:.2f} mm²; background ROI (fibrous tissue): "
        f"{r['background_pixels']} pixels, {r['background_mm2']:.2f} mm². "
        "CNR = (mean_bg − mean_fg) / sqrt(var_bg + var_fg) of the ROI means across "
        "realisations. “exact”: expectation and SD of FBP without sampling error (one adjoint pass per ROI). "
        f"“{n} runs”: as the paper measures; the 95 % interval of such a mean is ± {half:.2f} SD, of an SD "
        f"×{low:.2f}…{high:.2f} (all intervals, those of the CNR too, are in report.json). "
        f"“paper”: its tables, which are for {paper.TABLE_EXPOSURE_S:g} s (our inference)."
    )


def _agreement(checks: list[Check], data: dict[str, Any]) -> str:
    """The checks outside their tolerance, with the causes that were computed."""
    outside = [c for c in checks if not c.ok]
    text = (
        f"## Agreement with the paper\n\n{len(checks) - len(outside)} of {len(checks)} checks inside their tolerance "
        "(means ± 10 HU, SDs within a factor of 1.5, the paper's CNR where 95 of 100 ten-run experiments of ours lie)."
    )
    if not outside:
        return text
    causes = {cause["check"]: cause for cause in data["causes"]}
    words = {"placements": "in both", "runs": "in runs", "none": "in none"}
    rows = []
    for c in outside:
        row = [c.name, f"{c.ours:.4g}", c.paper if isinstance(c.paper, str) else f"{c.paper:.4g}"]
        cause = causes.get(c.name)
        if cause is None:
            rows.append([*row, "", "", ""])
        else:
            ranges = [f"{low:.1f} … {high:.1f}" for low, high in (cause["placements"], cause["runs"])]
            rows.append([*row, *ranges, words[cause["inside"]]])
    header = ["check", "ours", "paper", "placements", f"{paper.REALIZATIONS} runs", "paper"]
    text += f" Outside:\n\n{markdown_table(header, rows)}"
    if not causes:
        return text
    return (
        f"{text}\n\n“placements”: range of the exact figure over {data['placements'][0]['placements']} placements, the "
        f"two ROIs moved together by ± {SHIFT_MM:g} mm in x and y, and the grid by half a voxel along each axis. "
        f"“{paper.REALIZATIONS} runs”: the range that 95 of 100 experiments of {paper.REALIZATIONS} realisations show "
        "at each of these placements, put together. Last column: where the paper's value lies. In both: a matter of "
        "where ROIs and voxels are. In runs: one of chance as well. In none: we know no cause."
    )


def _noise_table(data: dict[str, Any]) -> str:
    slopes = data["noise_against_dose"]
    if not slopes:
        return ""
    rows = [[e["kernel"], f"{e['voxel_mm']:.2f}", f"{e['pixel']:.3f}"] for e in slopes if "pixel" in e]
    text = (
        "## Noise against dose\n\n"
        "Slope of log σ (voxel noise over the inset) against log exposure; −0.5 for counting noise."
    )
    return f"{text}\n\n{markdown_table(['kernel', 'voxel, mm', 'slope'], rows)}"


def _peak_memory_gib() -> float:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**30 if sys.platform == "darwin" else peak / 2**20
