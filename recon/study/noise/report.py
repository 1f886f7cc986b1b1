"""Tables and text of the noise study."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from scipy import stats

from recon.study.checks import Check, around, checks_section, effects_section
from recon.study.noise.few_runs import measured_table
from recon.study.noise.figures import cnr_figure, images_figure
from recon.study.noise.measure import Measured
from recon.study.noise.placements import SHIFT_MM
from recon.study.noise.ranking import claims_data, claims_section, pairs_data, pairs_section
from recon.study.paper import facts as paper
from recon.study.paper.tables import published, table_checks
from recon.study.report import Report, markdown_table
from recon.study.study import environment, time_line
from torchpcct.acquisition.plan import Effect
from torchpcct.metrics.cnr import cnr_interval, cnr_range, sd_interval

__all__ = ["build_report"]


def build_report(m: Measured) -> Report:
    """Report of :func:`recon.study.noise.measure.measure`: ``report.json``, ``report.md`` and two figures."""
    exposure = m.settings.table_exposure_s
    tables = {name: _dose_table(m, dose) for name, dose in m.settings.doses.items()}
    shown = next(rows for name, rows in tables.items() if m.settings.doses[name] == exposure)
    claims, shares = claims_data(m, exposure)
    pairs = pairs_data(m, exposure)
    checks = _checks(m)
    plan = m.scanned.clean.info["plan"]
    data = {
        "study": "noise",
        "settings": asdict(m.settings),
        "plan": dict(plan),
        "rois": m.scanned.rois.as_dict(),
        "noise_free_reference": m.reference,
        "order": "settings: voxel size slowest, then kernel; ROI means: setting, then core / fibrous",
        "axes": m.axes,
        "expected_hu": np.round(m.expected, 4),
        "covariance_hu2_at_1s": np.round(m.covariance, 4),
        "averaging_voxels_sd_hu_at_1s": [[*k, *np.round(v, 4)] for k, v in m.averaging.items()],
        "full_reconstructions": m.check,
        "doses": tables,
        "noise_against_dose": {"slopes": np.round(m.slopes(), 5)},
        "claims": claims,
        "ten_run_experiments": shares,
        "pairs": pairs,
        "eid": m.eid,
        "placements": [p.as_dict() for p in m.placements],
        "checks": [c.as_dict() for c in checks],
        "seconds": m.seconds,
        "environment": environment(),
    }
    sections = [
        "# Noise of the plaque images: kernels, voxel sizes, doses",
        _intro(m),
        _dose_section(m, shown),
        _all_doses(m, tables),
        claims_section(m, claims, shares),
        pairs_section(m, pairs),
        _slopes_section(m),
        _averaging_section(m),
        _eid_section(m),
        checks_section(checks, every=False),
        _FITTED,
        effects_section([_effect(e) for e in plan["effects"]], plan["tolerance_hu"]),
        time_line(m.seconds),
    ]
    figures = {"noise_images.png": images_figure(m), "noise_cnr.png": cnr_figure(m, shown)}
    return Report("noise", data, "\n\n".join(s for s in sections if s), figures)


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


def _effect(entry: dict[str, Any]) -> Effect:
    effect = Effect(**entry)
    if not effect.name.startswith("pile-up"):
        return effect
    return replace(effect, note=f"{effect.note}: `torchpcct study detector` has the figures")


def _intro(m: Measured) -> str:
    s, r = m.settings, m.scanned.rois.as_dict()
    c = m.check
    return (
        f"FBP of the paper's plaque (deep-silicon PCCT in counting mode, {s.views} views, 100 kVp, 1000 mA) with "
        f"{len(s.kernels)} kernels × {len(s.voxels_mm)} voxel sizes at {len(s.doses)} doses. ROIs in the axial image "
        f"of {r['pixel_mm']} mm: necrotic core {r['foreground_mm2']:.2f} mm², fibrous tissue "
        f"{r['background_mm2']:.2f} mm². CNR = (mean_fibrous − mean_core) / sqrt(var_fibrous + var_core) of the ROI "
        "means across realisations.\n\n"
        "Three kinds of figures: **exact** (expectation and covariance of FBP's ROI means from the adjoint vectors: no "
        f"sampling error), **n = {s.realizations}** (paired realisations, seeds {s.seed}…"
        f"{s.seed + s.realizations - 1}, the same for all settings and doses) and **n = 10** (the first ten of them, "
        "as the paper did). Square brackets: 95 % interval. The ROI means of a realisation are inner products of its "
        f"line integrals with the adjoint vectors; {c['reconstructed']} realisations were also reconstructed in full "
        f"and gave the same ROI means within {c['largest_difference_hu']:.2f} HU "
        f"({c['largest_difference_in_sd']:.3f} SD)."
    )


# --- tables -------------------------------------------------------------------------------------------------------


def _dose_table(m: Measured, exposure: float) -> list[dict[str, Any]]:
    """One row per setting: exact, by all realisations, by the first ten."""
    exact, values = m.exact(exposure), m.means[exposure]

    def sampled(runs: Any, i: int, **more: Any) -> dict[str, Any]:
        table = measured_table(runs[:, i : i + 1])
        interval = list(cnr_interval(runs[:, i, 0], runs[:, i, 1]))
        return {"mean_hu": table.mean[0], "sd_hu": table.sd[0], "cnr": table.cnr[0], "cnr_interval": interval, **more}

    rows = []
    for i, (kernel, voxel) in enumerate(m.axes):
        measured, ten = sampled(values, i), sampled(values[:10], i)
        measured["sd_interval"] = [list(sd_interval(float(v), len(values))) for v in measured["sd_hu"]]
        ten["cnr_range"] = list(cnr_range(exact.mean[i], m.block(i, exposure), 10))
        rows.append(
            {
                "kernel": kernel,
                "voxel_mm": voxel,
                "exposure_s": exposure,
                "exact": {"mean_hu": exact.mean[i], "sd_hu": exact.sd[i], "cnr": exact.cnr[i]},
                "measured": measured,
                "ten_runs": ten,
            }
        )
    return rows


def _grid(m: Measured, title: str, cells: Iterable[str]) -> str:
    """A table of all settings, kernels down, voxel sizes across."""
    by = dict(zip(m.axes, cells, strict=True))
    rows = [[f"FBP {k}", *(by[k, v] for v in m.settings.voxels_mm)] for k in m.settings.kernels]
    return markdown_table([title, *(f"{v:.2f} mm" for v in m.settings.voxels_mm)], rows)


def _paper(table: Any, row: dict[str, Any], digits: int) -> str:
    """The paper's entry, as the end of a cell."""
    entry = published(table, row["kernel"], row["voxel_mm"], row["exposure_s"])
    if entry is None:
        return ""
    values = np.atleast_1d(entry)
    return f"; paper {values[0]:.{digits}f}" + (f" ({values[1]:.1f})" if values.size == 2 else "")


def _dose_section(m: Measured, rows: list[dict[str, Any]]) -> str:
    n = m.settings.realizations
    parts = [f"## ROI means and CNR at {m.settings.table_exposure_s:g} s"]
    for roi, name, table in ((0, "Core", paper.FOREGROUND), (1, "Fibrous", paper.BACKGROUND)):
        both = [[f"{r[t]['mean_hu'][roi]:.1f} ({r[t]['sd_hu'][roi]:.1f})" for t in ("exact", "measured")] for r in rows]
        cells = [f"{a}; n = {n}: {b}{_paper(table, row, 1)}" for (a, b), row in zip(both, rows, strict=True)]
        parts.append(_grid(m, f"{name}, exact mean (SD), HU", cells))
    ratios, spreads = [], []
    for row in rows:
        exact, measured, ten = row["exact"], row["measured"], row["ten_runs"]
        low, high = measured["cnr_interval"]
        text = f"{exact['cnr']:.2f}; n = {n}: {measured['cnr']:.2f} [{low:.2f}, {high:.2f}]; n = 10: {ten['cnr']:.2f}"
        ratios.append(text + _paper(paper.CNR, row, 2))
        low, high = ten["cnr_range"]
        spreads.append(f"{low:.2f} … {high:.2f}")
    parts.append(_grid(m, "CNR, exact", ratios))
    parts.append(_grid(m, "95 % of experiments of 10 read a CNR of", spreads))
    return "\n\n".join(parts)


def _all_doses(m: Measured, tables: dict[str, list[dict[str, Any]]]) -> str:
    parts = ["## CNR at every dose"]
    for name, rows in tables.items():
        title = f"{name}, {m.settings.doses[name]:g} s: exact (n = {m.settings.realizations})"
        parts.append(_grid(m, title, (f"{r['exact']['cnr']:.2f} ({r['measured']['cnr']:.2f})" for r in rows)))
    return "\n\n".join(parts)


def _slopes_section(m: Measured) -> str:
    slopes = m.slopes()
    shown = [np.log(np.std(m.means[e], axis=0, ddof=1)).ravel() for e in m.settings.doses.values()]
    ratios = m.variance_ratios()
    n = m.settings.realizations
    spread = measured_table(m.means[m.settings.table_exposure_s]).sd / m.exact(m.settings.table_exposure_s).sd
    sampled = np.polyfit(np.log(list(m.settings.doses.values())), np.array(shown), 1)[0]
    return (
        "## Noise against dose\n\n"
        "Slope of log σ of the ROI means against log exposure, −0.5 for counting noise: from the readings' squared "
        f"deviations {slopes.min():.4f} … {slopes.max():.4f} over all settings and ROIs; from the SDs of the "
        f"{n} ROI means {sampled.min():.3f} … {sampled.max():.3f} (mean {sampled.mean():.3f}). The squared deviations "
        f"give {ratios.min():.3f} … {ratios.max():.3f} times the exact variances. The SDs of the {n} ROI means at "
        f"{m.settings.table_exposure_s:g} s are {spread.min():.2f} … {spread.max():.2f} times the exact ones (95 % "
        f"range of one: {1 - 1.96 / (2 * n) ** 0.5:.2f} … {1 + 1.96 / (2 * n) ** 0.5:.2f}; settings share their noise)."
    )


def _averaging_section(m: Measured) -> str:
    if not m.averaging:
        return ""
    exposure = m.settings.table_exposure_s
    exact = m.exact(exposure)
    rows = []
    for (kernel, voxel), sd in m.averaging.items():
        i = m.axes.index((kernel, voxel))
        cells = [f"{kernel} {voxel:.2f} mm"]
        for roi, table in ((0, paper.FOREGROUND), (1, paper.BACKGROUND)):
            entry = published(table, kernel, voxel, exposure)
            averaged = sd[roi] / exposure**0.5
            cells += [f"{exact.sd[i, roi]:.1f}", f"{averaged:.1f}", "–" if entry is None else f"{entry[1]:.1f}"]
        rows.append(cells)
    head = ["exact SD, HU", "core", "averaging", "paper", "fibrous", "averaging", "paper"]
    return (
        "## Point-sampled and averaging voxels\n\n"
        "FBP evaluates the filtered image at the voxels' centres. With a sharp kernel and large voxels its fine noise "
        "aliases into the ROI means, and the SD grows with the voxel. If a voxel's value is the mean over its volume "
        "(computed as the mean of 2 × 2 × 2 voxels of half the size), it does not.\n\n"
        f"{markdown_table(head, rows)}"
    )


def _eid_section(m: Measured) -> str:
    if not m.eid:
        return ""
    rows = [
        [
            f"{e['scanner']}, {e['kernel']} {e['voxel_mm']:.2f} mm, {e['exposure_s']:g} s",
            f"{e['mean_hu'][0]:.1f} ({e['sd_hu'][0]:.1f})",
            f"{e['mean_hu'][1]:.1f} ({e['sd_hu'][1]:.1f})",
            f"{e['contrast_hu']:.1f} ({e['contrast_sd_hu']:.1f})",
            f"{e['cnr']:.2f}",
        ]
        for e in m.eid
    ]
    share = max(e.get("largest_electronic_share", 0.0) for e in m.eid)
    head = ["exact mean (SD), HU", "core", "fibrous", "contrast", "CNR"]
    return (
        "## EID-CT at equal dose\n\n"
        "The same plaque and spectrum by the energy-integrating scanner (541 / 949 mm, 1.02 × 1.10 mm cells, compound "
        "Poisson noise of the transmitted spectrum and electronic noise), at equal fluence at the isocentre: its "
        "exposure is (541 / 626)² of the PCCT's. The electronics make at most "
        f"{100 * share:.1f} % of a reading's variance.\n\n{markdown_table(head, rows)}"
    )


# --- checks -------------------------------------------------------------------------------------------------------


def _checks(m: Measured) -> list[Check]:
    checks = []
    for name, value in paper.NOISE_FREE_ROI_HU.items():
        checks.append(around(f"noise-free {name} mean, standard 0.10 mm, HU", m.reference[f"{name}_hu"], value, 8.0))
    for i, (kernel, voxel) in enumerate(m.axes):
        means = (float(m.expected[i, 0]), float(m.expected[i, 1]))
        for check in table_checks(kernel, voxel, means, m.block(i, paper.TABLE_EXPOSURE_S)):
            roi = int(check.name.startswith("fibrous"))
            note = ""
            if " mean," in check.name:
                sd = published((paper.FOREGROUND, paper.BACKGROUND)[roi], kernel, voxel, paper.TABLE_EXPOSURE_S)[1]
                note = f"standard error of the paper's mean: {sd / 10**0.5:.0f} HU"
            elif " SD," in check.name:
                note = _sd_note(check)
                if (kernel, voxel) in m.averaging:
                    sd = m.averaging[kernel, voxel][roi] / paper.TABLE_EXPOSURE_S**0.5
                    note += f"; {sd:.1f} HU with averaging voxels"
            checks.append(check.explained(note + _elsewhere(check, m, kernel, voxel)))
    soft = {e["scanner"]: e for e in m.eid if (e["kernel"], e["voxel_mm"]) == ("soft", 0.25)}
    if soft:
        share = soft["EID-CT"]["contrast_hu"] / soft["PCCT"]["contrast_hu"]
        checks.append(
            Check("contrast of the core in EID-CT over PCCT, soft 0.25 mm", share, "hardly discernible", 0, 0.25)
        )
    slopes = m.slopes()
    for name, slope in (("lowest", slopes.min()), ("highest", slopes.max())):
        checks.append(around(f"slope of σ against dose, {name} of all ROI means", float(slope), -0.5, 0.015))
    checks.append(
        Check("full reconstructions: difference of ROI means, SDs", m.check["largest_difference_in_sd"], "–", 0.0, 0.05)
    )
    return checks


def _elsewhere(check: Check, m: Measured, kernel: str, voxel: float) -> str:
    """The range of a figure outside its tolerance where ROIs and grid lie elsewhere; empty: no such check."""
    varied = [p for p in m.placements if (p.kernel, p.voxel_mm) == (kernel, voxel)]
    roi, _, quantity = check.name.partition(",")[0].partition(" ")
    if check.ok or roi not in ("core", "fibrous") or not varied:
        return ""
    ranges = [varied[0].range_of(roi, quantity, paper.TABLE_EXPOSURE_S, n) for n in (None, paper.REALIZATIONS)]
    first, second = (f"{low:.1f} … {high:.1f}" for low, high in ranges)
    inside = [low <= float(check.paper) <= high for low, high in ranges]
    where = "both" if inside[0] else "the second only" if inside[1] else "neither"
    return (
        f"; {first} with ROIs moved by ± {SHIFT_MM:g} mm and the grid by half a voxel, {second} in "
        f"{paper.REALIZATIONS} runs there: the paper's value lies in {where}"
    )


def _sd_note(check: Check) -> str:
    """How likely ten realisations of our scan are to read the paper's SD or one farther off."""
    ratio = 9 * (float(check.paper) / check.ours) ** 2
    tail = stats.chi2.cdf(ratio, 9) if float(check.paper) < check.ours else stats.chi2.sf(ratio, 9)
    return f"10 runs of ours read this or farther off with p = {2 * tail:.1g}"
