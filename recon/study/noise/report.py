"""Tables, text and figures of the noise study."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy import stats

from recon.study.checks import Check, around, checks_section, effects_section
from recon.study.noise.few_runs import Table, measured_table
from recon.study.noise.figures import cnr_figure, images_figure
from recon.study.noise.measure import Measured, as_dict
from recon.study.noise.ranking import claims_data, claims_section, pairs_data, pairs_section
from recon.study.paper import facts as paper
from recon.study.paper.tables import published, table_checks
from recon.study.report import Report, markdown_table
from recon.study.study import environment
from torchpcct.acquisition.plan import Effect
from torchpcct.metrics.cnr import cnr_interval, cnr_range, sd_interval

__all__ = ["build_report"]


def build_report(m: Measured) -> Report:
    """Report of :func:`recon.study.noise.measure.measure`: ``report.json``, ``report.md`` and two figures."""
    exposure = m.settings.table_exposure_s
    tables = {name: _dose_table(m, dose) for name, dose in m.settings.doses.items()}
    claims, shares = claims_data(m, exposure)
    pairs = pairs_data(m, exposure)
    checks = _checks(m)
    data = {
        "study": "noise",
        **as_dict(m),
        "doses": tables,
        "noise_against_dose": {"slopes": np.round(m.slopes(), 5).tolist()},
        "claims": claims,
        "ten_run_experiments": shares,
        "pairs": pairs,
        "eid": m.eid,
        "checks": [c.as_dict() for c in checks],
        "environment": environment(),
    }
    plan = m.scanned.clean.info["plan"]
    sections = [
        "# Noise of the plaque images: kernels, voxel sizes, doses",
        _intro(m),
        _dose_section(m, exposure),
        _other_doses(m),
        claims_section(m, claims, shares),
        pairs_section(m, pairs),
        _slopes_section(m),
        _averaging_section(m),
        _eid_section(m),
        checks_section(checks, every=False),
        effects_section([_effect(e) for e in plan["effects"]], plan["tolerance_hu"]),
        "Time: " + ", ".join(f"{k} {v:.0f} s" for k, v in m.seconds.items()) + ".",
    ]
    figures = {"noise_images.png": images_figure(m), "noise_cnr.png": cnr_figure(m)}
    return Report("noise", data, "\n\n".join(s for s in sections if s), figures)


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
    exact = m.exact(exposure)
    values = m.means[exposure]
    measured, ten = measured_table(values), measured_table(values[:10])
    rows = []
    for i, (kernel, voxel) in enumerate(m.axes):
        part = slice(2 * i, 2 * i + 2)
        matrix = m.covariance[part, part] / exposure
        rows.append(
            {
                "kernel": kernel,
                "voxel_mm": voxel,
                "exposure_s": exposure,
                "exact": {"mean_hu": exact.mean[i], "sd_hu": exact.sd[i], "cnr": exact.cnr[i]},
                "measured": {
                    "mean_hu": measured.mean[i],
                    "sd_hu": measured.sd[i],
                    "sd_interval": [list(sd_interval(float(v), len(values))) for v in measured.sd[i]],
                    "cnr": measured.cnr[i],
                    "cnr_interval": list(cnr_interval(values[:, i, 0], values[:, i, 1])),
                },
                "ten_runs": {
                    "mean_hu": ten.mean[i],
                    "sd_hu": ten.sd[i],
                    "cnr": ten.cnr[i],
                    "cnr_interval": list(cnr_interval(values[:10, i, 0], values[:10, i, 1])),
                    "cnr_range": list(cnr_range(exact.mean[i], matrix, 10)),
                },
            }
        )
    return rows


def _grid(m: Measured, title: str, cell: Any) -> str:
    rows = [[f"FBP {k}", *(cell(k, v) for v in m.settings.voxels_mm)] for k in m.settings.kernels]
    return markdown_table([title, *(f"{v:.2f} mm" for v in m.settings.voxels_mm)], rows)


def _index(m: Measured, kernel: str, voxel: float) -> int:
    return m.axes.index((kernel, voxel))


def _beside(text: str, entry: Any, digits: int) -> str:
    if entry is None:
        return text
    values = np.atleast_1d(entry)
    shown = f"{values[0]:.{digits}f}" + (f" ({values[1]:.1f})" if values.size == 2 else "")
    return f"{text}; paper {shown}"


def _dose_section(m: Measured, exposure: float) -> str:
    exact, values = m.exact(exposure), m.means[exposure]
    measured, ten = measured_table(values), measured_table(values[:10])
    n = len(values)
    parts = [f"## ROI means and CNR at {exposure:g} s"]
    for roi, name, table in ((0, "Core", paper.FOREGROUND), (1, "Fibrous", paper.BACKGROUND)):

        def moments(kernel: str, voxel: float, roi: int = roi, table: Any = table) -> str:
            i = _index(m, kernel, voxel)
            text = f"{exact.mean[i, roi]:.1f} ({exact.sd[i, roi]:.1f})"
            text += f"; n = {n}: {measured.mean[i, roi]:.1f} ({measured.sd[i, roi]:.1f})"
            return _beside(text, published(table, kernel, voxel, exposure), 1)

        parts.append(_grid(m, f"{name}, exact mean (SD), HU", moments))

    def ratio(kernel: str, voxel: float) -> str:
        i = _index(m, kernel, voxel)
        low, high = cnr_interval(values[:, i, 0], values[:, i, 1])
        text = f"{exact.cnr[i]:.2f}; n = {n}: {measured.cnr[i]:.2f} [{low:.2f}, {high:.2f}]; n = 10: {ten.cnr[i]:.2f}"
        return _beside(text, published(paper.CNR, kernel, voxel, exposure), 2)

    parts.append(_grid(m, "CNR, exact", ratio))

    def spread(kernel: str, voxel: float) -> str:
        i = _index(m, kernel, voxel)
        part = slice(2 * i, 2 * i + 2)
        low, high = cnr_range(exact.mean[i], m.covariance[part, part] / exposure, 10)
        return f"{low:.2f} … {high:.2f}"

    parts.append(_grid(m, "95 % of experiments of 10 read a CNR of", spread))
    return "\n\n".join(parts)


def _other_doses(m: Measured) -> str:
    parts = ["## CNR at every dose"]
    for name, exposure in m.settings.doses.items():
        exact, measured = m.exact(exposure), measured_table(m.means[exposure])

        def cell(kernel: str, voxel: float, exact: Table = exact, measured: Table = measured) -> str:
            i = _index(m, kernel, voxel)
            return f"{exact.cnr[i]:.2f} ({measured.cnr[i]:.2f})"

        parts.append(_grid(m, f"{name}, {exposure:g} s: exact (n = {m.settings.realizations})", cell))
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
        i = _index(m, kernel, voxel)
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
    for roi, value in paper.NOISE_FREE_ROI_HU.items():
        checks.append(around(f"noise-free {roi} mean, standard 0.10 mm, HU", m.reference[f"{roi}_hu"], value, 8.0))
    for i, (kernel, voxel) in enumerate(m.axes):
        part = slice(2 * i, 2 * i + 2)
        covariance = m.covariance[part, part] / paper.TABLE_EXPOSURE_S
        means = (float(m.expected[i, 0]), float(m.expected[i, 1]))
        entry = [published(t, kernel, voxel, paper.TABLE_EXPOSURE_S) for t in (paper.FOREGROUND, paper.BACKGROUND)]
        for check in table_checks(kernel, voxel, means, covariance):
            if not check.ok and " mean," in check.name:
                sd = entry[0 if check.name.startswith("core") else 1][1]
                check = replace(check, note=f"standard error of the paper's mean: {sd / 10**0.5:.0f} HU")
            elif not check.ok and " SD," in check.name:
                note = _sd_note(check)
                if (kernel, voxel) in m.averaging:
                    sd = m.averaging[kernel, voxel][0 if check.name.startswith("core") else 1]
                    note += f"; {sd / paper.TABLE_EXPOSURE_S**0.5:.1f} HU with averaging voxels"
                check = replace(check, note=note)
            checks.append(check)
    soft = {e["scanner"]: e for e in m.eid if (e["kernel"], e["voxel_mm"]) == ("soft", 0.25)}
    if soft:
        share = soft["EID-CT"]["contrast_hu"] / soft["PCCT"]["contrast_hu"]
        checks.append(
            Check("contrast of the core in EID-CT over PCCT, soft 0.25 mm", share, "hardly discernible", 0, 0.25)
        )
    slopes = m.slopes()
    checks.append(Check("slope of σ against dose, lowest of all ROI means", float(slopes.min()), -0.5, -0.515, -0.485))
    checks.append(Check("slope of σ against dose, highest of all ROI means", float(slopes.max()), -0.5, -0.515, -0.485))
    checks.append(
        Check("full reconstructions: difference of ROI means, SDs", m.check["largest_difference_in_sd"], "–", 0.0, 0.05)
    )
    return checks


def _sd_note(check: Check) -> str:
    """How likely ten realisations of our scan are to read the paper's SD or one farther off."""
    ratio = 9 * (float(check.paper) / check.ours) ** 2
    tail = stats.chi2.cdf(ratio, 9) if float(check.paper) < check.ours else stats.chi2.sf(ratio, 9)
    return f"10 runs of ours read this or farther off with p = {2 * tail:.1g}"
