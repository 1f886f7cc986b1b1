"""Report of the spectral study: text, checks and figures."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from recon.study.checks import Check, around, checks_section, effects_section
from recon.study.paper import facts as paper
from recon.study.report import Report, by_sign, markdown_table, records_table
from recon.study.spectral.calibration_text import calibration_section, contrast_cost
from recon.study.spectral.figures import curves_figure, tissue_figure
from recon.study.spectral.measure import Measured
from recon.study.spectral.tissues import RULES
from recon.study.study import environment, time_line
from torchpcct.acquisition.plan import Effect
from torchpcct.spectral import MMD_TISSUES, pe_pvc

__all__ = ["build_report", "checks_of"]

VISIBLE_DICE = 0.5
"""The core counts as visible in a tissue map if its Dice coefficient reaches this. The paper judges by eye."""


def build_report(measured: Measured) -> Report:
    """Checks, tables, figures."""
    s, m = measured.settings, measured.data
    checks = checks_of(m)
    data = {
        "study": "spectral",
        "settings": asdict(s),
        **m,
        "seconds": measured.seconds,
        "total_seconds": sum(measured.seconds.values()),
        "processor_seconds": measured.processor_seconds,
        "checks": [c.as_dict() for c in checks],
        "environment": environment(),
    }
    effects = [Effect(**e) for e in m["plan"]["effects"]]
    parts = [
        "# Spectral imaging of a coronary plaque",
        f"The paper's plaque, scanned with the deep-silicon scanner in 8 energy bins ({s.views} views, 100 kVp, "
        f"1000 mA, {s.exposure_s:g} s: the *standard noise*). Every ray is decomposed into line integrals of "
        "polyethylene (PE) and polyvinyl chloride (PVC) by maximum likelihood; FBP (kernel "
        f"`{s.kernel}`, {s.voxel_mm:g} mm voxels) and joint model-based reconstruction give the basis images.",
        checks_section(checks),
        _rays(m),
        _monochromatic(m),
        "## Tissue maps\n\n"
        "Fractions of blood, core, fibrous tissue and fat by multi-material decomposition (Mendonça 2014), then one "
        "tissue a voxel. The paper uses a standard 2-D k-means and does not name its features. The main rule here "
        "(*FBP*, *joint MBIR*) is its assignment step with the centres held at the known tissues, in the two "
        "dimensions of the basis plane in units of its noise: the most likely pure tissue. Dice coefficient over the "
        f"{measured.tissues.truth.shape[0]} slices through the core, voxels that a tissue fills by more than half; the "
        f"vessel's wall, a fifth material, is left out. Mean ± SD over {s.realizations} realisations (FBP) and "
        f"{s.mbir_realizations} (MBIR).\n\n{_dice_table(m)}\n\n{_core_kept(m)}\n\n{_separation(m)}",
        *([_mbir(m)] if "mbir" in m else []),
        *([calibration_section(m["calibration"])] if "calibration" in m else []),
        effects_section([*effects, *_own_effects(m)], m["plan"]["tolerance_hu"]),
        "## Environment\n\n" + ", ".join(f"{k} {v}" for k, v in data["environment"].items()),
        time_line(measured.seconds, f"{measured.processor_seconds:.0f} s of processor time; first seed {s.seed}"),
    ]
    figures = {"spectral.png": curves_figure(measured), "tissues.png": tissue_figure(measured)}
    return Report("spectral", data, "\n\n".join(parts), figures)


def _at(scores: list[dict[str, Any]], noise: float, tissue: str) -> float:
    return next((float(s[tissue]["mean"]) for s in scores if s["noise"] == noise), float("nan"))


def _rises(scores: list[dict[str, Any]]) -> float:
    """Largest rise of any tissue's mean Dice from one noise level to the next."""
    means = np.array([[s[t]["mean"] for t in MMD_TISSUES] for s in scores])
    return float(np.diff(means, axis=0).max()) if len(means) > 1 else float("nan")


def checks_of(data: dict[str, Any]) -> list[Check]:
    """The figures that the study must show."""
    standard, low = data["rays"][0], data["rays"][-1]
    starved, vmi, fbp = data["starved"], data["vmi"], data["dice"]["FBP"]
    water = max(float(np.abs(v).max()) for v in data["water"].values())
    rate = max(r["rays_per_core_second"] for r in data["rays"])
    limit, lost = paper.SPECTRAL["core_visible_up_to"], paper.SPECTRAL["core_lost_at"]
    return [
        Check(f"decomposition: variance over the Cramér–Rao bound, {standard['exposure_s']:g} s",
              standard["whitened_ratio"], "not given", high=1.05),
        Check(f"decomposition: variance over the Cramér–Rao bound, {low['exposure_s']:g} s",
              low["whitened_ratio"], "not given", high=1.08,
              note=f"Bhattacharyya's bound, which no unbiased estimate beats, is "
              f"{100 * data['second_order_bound']:.1f} % above it"),
        Check("decomposition: rays without a finite, converged answer, 0 counts … air",
              starved["not_finite"] + starved["not_converged"] + sum(r["failed"] for r in data["rays"]),
              "not given", high=0.0),
        Check("decomposition: million rays per second of processor time", rate / 1e6, "not given", low=0.5),
        Check("water in monochromatic images, 40–140 keV: largest |HU|", water, 0.0, high=1.0),
        around("best energy, noise of a voxel, keV", vmi["voxel"]["optimum_kev"], paper.SPECTRAL["optimum_kev"],
               paper.SPECTRAL["optimum_tolerance_kev"]),
        around("best energy, noise of the ROI means, keV", vmi["roi_means"]["optimum_kev"],
               paper.SPECTRAL["optimum_kev"], paper.SPECTRAL["optimum_tolerance_kev"]),
        Check(f"core's Dice at {100 * limit:.0f} % noise (visible ≥ {VISIBLE_DICE})",
              _at(fbp, limit, "necrotic_core"), "visible", low=VISIBLE_DICE),
        Check(f"core's Dice at {100 * lost:.0f} % noise (lost < {VISIBLE_DICE})",
              _at(fbp, lost, "necrotic_core"), "lost", high=VISIBLE_DICE),
        Check("largest rise of a tissue's Dice from one noise level to the next", _rises(fbp), "monotone", high=0.0),
    ]  # fmt: skip


def _rays(data: dict[str, Any]) -> str:
    columns = {
        "exposure": "{exposure_s:g} s",
        "M rays": "{millions:.2f}",
        "var PE / CRB": "{variance_ratio[0]:.3f}",
        "var PVC / CRB": "{variance_ratio[1]:.3f}",
        "both": "{whitened_ratio:.3f}",
        "bias PE, SD": "{bias[0]:+.4f}",
        "bias PVC, SD": "{bias[1]:+.4f}",
        "empty bins": "{empty:.2f} %",
        "at bound": "{at_bound}",
        "M rays/s (threads)": "{speed:.2f} ({threads})",
        "M rays / core s": "{core_speed:.2f}",
    }
    rays = [
        {**r, "millions": r["rays"] / 1e6, "empty": 100 * r["zero_bins"], "speed": r["rays_per_second"] / 1e6,
         "core_speed": r["rays_per_core_second"] / 1e6}
        for r in data["rays"]
    ]  # fmt: skip
    starved = (
        "{rays} further rays behind 0–600 mm of water at 1e-6 … 1 of the exposure, {without_counts} of them without "
        "a single count: {not_finite} not finite, {not_converged} not converged, {at_bound} at the bounds of the "
        "estimate."
    )
    return (
        "## Decomposition of the rays\n\n"
        "Mean squared error of every ray's estimate over the Cramér–Rao bound at its true line integrals "
        "(*both*: in the metric of the Fisher information), on the scan's own rays.\n\n"
        f"{records_table(rays, columns)}\n\n{starved.format(**data['starved'])}"
    )


def _monochromatic(data: dict[str, Any]) -> str:
    v = data["vmi"]
    voxel, means, energies = v["voxel"], v["roi_means"], v["energies_kev"]
    rows = []
    for e in sorted({40, 52, 60, 70, 80, 100, 120, 140, round(voxel["optimum_kev"])}):
        k = energies.index(float(e))
        water = max(abs(w[k]) for w in data["water"].values())
        rows.append([
            f"{e} keV", f"{voxel['contrast_hu'][k]:.1f}", f"{voxel['noise_hu'][k]:.1f}", f"{voxel['cnr'][k]:.3f}",
            f"{means['noise_hu'][k]:.1f}", f"{means['cnr'][k]:.2f}", f"{water:.2f}",
        ])  # fmt: skip
    head = ["energy", "contrast, HU", "voxel noise, HU", "CNR", "noise of ROI means, HU", "CNR of ROI means",
            "water, largest abs. HU"]  # fmt: skip
    share = np.array(v["sampled_covariance"]) / np.array(v["voxel_covariance"])
    water_rows = [[k, f"{min(hu):+.2f}", f"{max(hu):+.2f}"] for k, hu in data["water"].items()]
    return (
        "## Virtual monochromatic images\n\n"
        "Contrast: fibrous tissue less core, ROI means of the noise-free images. Noise: exact covariance of one voxel "
        "in the fibrous ROI, and of the two ROI means of the paper's CNR protocol (σ² of both added).\n\n"
        f"{markdown_table(head, rows)}\n\n"
        f"Best energy {voxel['optimum_kev']:.1f} keV for the noise of a voxel (CNR {voxel['best_cnr']:.3f}; the best "
        "combination of the basis images, which is no image at one energy, reaches "
        f"{voxel['limit']:.3f}), {means['optimum_kev']:.1f} keV for ROI means (CNR {means['best_cnr']:.2f}). "
        "Sampled over exact covariance of the voxels (PE, mixed, PVC): "
        f"{', '.join(f'{r:.3f}' for r in share)}.\n\nWater, noise free, through the whole chain:\n\n"
        + markdown_table(["where", "lowest HU, 40–140 keV", "highest"], water_rows)
    )


def _dice_table(data: dict[str, Any]) -> str:
    def cell(score: dict[str, float]) -> str:
        return f"{score['mean']:.3f}" + (f" ± {score['sd']:.3f}" if np.isfinite(score["sd"]) else "")

    rows = [
        [f"{method}, {100 * s['noise']:.0f} %", *(cell(s[t]) for t in MMD_TISSUES)]
        for method, scores in data["dice"].items()
        for s in scores
    ]
    return markdown_table(["method, noise", "blood", "core", "fibrous", "fat"], rows)


def _core_kept(data: dict[str, Any]) -> str:
    """Up to which noise each way to a tissue map keeps the core."""
    limit, found = paper.SPECTRAL["core_visible_up_to"], []
    for method, scores in data["dice"].items():
        kept = [s for s in scores if s["necrotic_core"]["mean"] >= VISIBLE_DICE]
        upto = f"up to {100 * kept[-1]['noise']:.0f} %" if kept else "at no noise"
        here = _at(scores, limit, "necrotic_core")
        found.append(f"{method}: {upto}" + ("" if np.isnan(here) else f" (Dice {here:.2f} at {100 * limit:.0f} %)"))
    return (
        f"Noise up to which the core's Dice reaches {VISIBLE_DICE:g}: {'; '.join(found)}. The paper calls the core "
        f"visible up to {100 * limit:.0f} % and used k-means. With the centres of the tissues held fixed at their "
        f"known values its Dice there is {_at(data['dice']['FBP'], limit, 'necrotic_core'):.2f}, with the free centres "
        f"of k-means {_at(data['dice'][RULES['k-means']], limit, 'necrotic_core'):.2f}."
    )


def _separation(data: dict[str, Any]) -> str:
    d = data["separation"]
    return (
        "Why the rules differ: in standard deviations of a voxel at the standard noise the core lies "
        f"{d['core to fibrous']:.2f} from fibrous tissue and {d['core to fat']:.2f} from fat, but only "
        f"{d['core to the line from fat to fibrous']:.2f} from the line between the two. So noise turns a core into a "
        "mixture of fat and fibrous tissue long before it hides it: the largest fraction fails at a quarter of the "
        "noise, where the mixture as a whole still lies nearest to the core. Free centres of k-means follow the mixed "
        "voxels at the edge of the vessel, which look like the core, too: without any noise "
        f"{100 * data['misplaced_core']:.0f} % of the voxels nearest to it lie outside the core."
    )


def _mbir(data: dict[str, Any]) -> str:
    m = data["mbir"]
    solves = m["solves"]
    pairs = [s["exact_pairs"] for s in solves]
    seconds = float(np.median([s["seconds"] for s in solves]))
    values = [
        {**v[method], "method": method, "percent": 100 * v["noise"]}
        for method in ("FBP", "joint MBIR")
        for v in m["at_best_energy"]
    ]
    columns = {
        "method, noise": "{method}, {percent:.0f} %",
        "core": "{core_hu:.1f}",
        "fibrous": "{fibrous_hu:.1f}",
        "SD of voxels in fat": "{fat_sd_hu:.1f}",
    }
    return (
        "## Joint model-based reconstruction\n\n"
        "Both basis images at once: least squares with the 2 × 2 Fisher information of every ray and a vectorial "
        f"q-GGMRF prior (strength {m['prior']['strength']:g}, threshold "
        f"{solves[-1]['threshold_hu_per_mm']:.0f} HU/mm at 52 keV and the standard noise, in proportion to the noise), "
        "solved to the exact minimum. After mixing the channels so that their mean noise is equal and uncorrelated, "
        f"the information still differs from a multiple of the identity by {100 * m['anisotropy']:.1f} % (rms over the "
        f"rays); {min(pairs)}–{max(pairs)} exact projection pairs and {seconds:.1f} s a volume pair brought it within "
        f"{max(s['rmsd_hu'][-1] for s in solves):.2f} HU of the minimum (largest relative gradient "
        f"{max(s['gradient'][-1] for s in solves):.1e}).\n\n"
        f"Monochromatic image at {data['vmi']['voxel']['optimum_kev']:.1f} keV, first realisation, HU:\n\n"
        f"{records_table(values, columns)}\n\n{_noise_for_contrast(m['at_best_energy'])}"
    )


def _noise_for_contrast(values: list[dict[str, Any]]) -> str:
    """What joint MBIR does to the noise, and what to the contrast."""
    clean, noisy = values[0], values[-1]

    def contrast(of: dict[str, float]) -> float:
        return of["fibrous_hu"] - of["core_hu"]

    noise = noisy["joint MBIR"]["fat_sd_hu"] / noisy["FBP"]["fat_sd_hu"]
    kept = contrast(clean["joint MBIR"]) / contrast(clean["FBP"])
    return (
        f"At {100 * noisy['noise']:.0f} % noise joint MBIR has {100 * noise:.0f} % of FBP's noise in fat. It "
        f"{by_sign(kept, 'gains', 'pays with', 1.0)} contrast: without noise fibrous tissue and core differ by "
        f"{contrast(clean['joint MBIR']):.1f} HU, by FBP by {contrast(clean['FBP']):.1f}: {100 * abs(1 - kept):.0f} % "
        f"{by_sign(kept, 'more', 'less', 1.0)}. For equal contrast the noise is {100 * noise / kept:.0f} % of FBP's. "
        "Contrasts in noise are those of one realisation."
    )


def _own_effects(data: dict[str, Any]) -> list[Effect]:
    residual, blood = (float(np.abs(pe_pvc().residual(n)).max()) for n in ("necrotic_core", "blood_iodine"))
    wrong = contrast_cost(data["calibration"]) if "calibration" in data else None
    return [
        Effect("two basis functions for every tissue", True, residual,
               f"what PE and PVC cannot express of soft tissue; of blood with iodine (K edge) up to {blood:.0f} HU"),
        Effect("spectral calibration", False, wrong, "decomposition uses the simulation's own spectra; cost: of the "
               "contrast, the worst of the wrong calibrations above" if wrong is not None else
               "decomposition uses the simulation's own spectra"),
        Effect("correlation between energy bins", False, None, "bins count independently: no pile-up, no sharing"),
    ]  # fmt: skip
