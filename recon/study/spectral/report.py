"""Report of the spectral study: text, checks and figures."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor

from recon.study.checks import Check, around, checks_section, effects_section
from recon.study.paper import facts as paper
from recon.study.report import Report, markdown_table
from recon.study.spectral.figures import curves_figure, tissue_figure
from recon.study.spectral.scan import PlaqueScan
from recon.study.spectral.tissues import Tissues
from recon.study.study import environment
from torchpcct.acquisition.plan import Effect
from torchpcct.spectral import MMD_TISSUES

__all__ = ["VISIBLE_DICE", "build_report", "checks_of"]

VISIBLE_DICE = 0.5
"""The core counts as visible in a tissue map if its Dice coefficient reaches this. The paper judges by eye."""

_NAMES = {"blood_iodine": "blood", "necrotic_core": "core", "fibrous_tissue": "fibrous", "pericoronary_fat": "fat"}


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
    checks = [
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
    return checks


def _rays_table(data: dict[str, Any]) -> str:
    rows = [
        [
            f"{r['exposure_s']:g} s", f"{r['rays'] / 1e6:.2f}", f"{r['variance_ratio'][0]:.3f}",
            f"{r['variance_ratio'][1]:.3f}", f"{r['whitened_ratio']:.3f}", f"{r['bias'][0]:+.4f}",
            f"{r['bias'][1]:+.4f}", f"{100 * r['zero_bins']:.2f} %", str(r["at_bound"]),
            f"{r['rays_per_second'] / 1e6:.2f} ({r['threads']})", f"{r['rays_per_core_second'] / 1e6:.2f}",
        ]
        for r in data["rays"]
    ]  # fmt: skip
    return markdown_table(
        ["exposure", "M rays", "var PE / CRB", "var PVC / CRB", "both", "bias PE, SD", "bias PVC, SD",
         "empty bins", "at bound", "M rays/s (threads)", "M rays / core s"],
        rows,
    )  # fmt: skip


def _vmi_table(data: dict[str, Any]) -> str:
    v = data["vmi"]
    energies = v["energies_kev"]
    shown = sorted({40, 52, 60, 70, 80, 100, 120, 140, round(v["voxel"]["optimum_kev"])})
    rows = []
    for e in shown:
        k = energies.index(float(e))
        water = max(abs(w[k]) for w in data["water"].values())
        rows.append([
            f"{e} keV", f"{v['voxel']['contrast_hu'][k]:.1f}", f"{v['voxel']['noise_hu'][k]:.1f}",
            f"{v['voxel']['cnr'][k]:.3f}", f"{v['roi_means']['noise_hu'][k]:.1f}", f"{v['roi_means']['cnr'][k]:.2f}",
            f"{water:.2f}",
        ])  # fmt: skip
    return markdown_table(
        ["energy", "contrast, HU", "voxel noise, HU", "CNR", "noise of ROI means, HU", "CNR of ROI means",
         "water, largest abs. HU"],
        rows,
    )  # fmt: skip


def _dice_table(data: dict[str, Any]) -> str:
    rows = []
    for method, scores in data["dice"].items():
        for s in scores:
            cells = [
                f"{s[t]['mean']:.3f}" + (f" ± {s[t]['sd']:.3f}" if np.isfinite(s[t]["sd"]) else "") for t in MMD_TISSUES
            ]
            rows.append([f"{method}, {100 * s['noise']:.0f} %", *cells])
    return markdown_table(["method, noise", *(_NAMES[t] for t in MMD_TISSUES)], rows)


def _separation_text(data: dict[str, Any]) -> str:
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


def _mbir_text(data: dict[str, Any]) -> str:
    m = data["mbir"]
    solves = m["solves"]
    pairs = [s["exact_pairs"] for s in solves]
    seconds = float(np.median([s["seconds"] for s in solves]))
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
        + markdown_table(["method, noise", "core", "fibrous", "SD of voxels in fat"], _values(m))
    )


def _values(mbir: dict[str, Any]) -> list[list[str]]:
    return [
        [
            f"{method}, {100 * v['noise']:.0f} %",
            *(f"{v[method][k]:.1f}" for k in ("core_hu", "fibrous_hu", "fat_sd_hu")),
        ]
        for method in ("FBP", "joint MBIR")
        for v in mbir["at_best_energy"]
    ]


def build_report(data: dict[str, Any], plaque: PlaqueScan, tissues: Tissues, images: dict[str, Tensor]) -> Report:
    """The report of a finished study.

    Args:
        data: JSON values of all steps.
        plaque, tissues: geometry and truth for the figures.
        images: ``clean`` (2, z, y, x), ``noisy`` (n, 2, z, y, x) and, with MBIR, ``mbir`` (levels, 2, z, y, x).
    """
    s, vmi = data["settings"], data["vmi"]
    checks = checks_of(data)
    data["checks"] = [c.as_dict() for c in checks]
    data["environment"] = environment()
    share = np.array(vmi["sampled_covariance"]) / np.array(vmi["voxel_covariance"])
    water_rows = [[k, f"{min(v):+.2f}", f"{max(v):+.2f}"] for k, v in data["water"].items()]
    parts = [
        "# Spectral imaging of a coronary plaque",
        f"The paper's plaque, scanned with the deep-silicon scanner in 8 energy bins ({s['views']} views, 100 kVp, "
        f"1000 mA, {s['exposure_s']:g} s: the *standard noise*). Every ray is decomposed into line integrals of "
        "polyethylene (PE) and polyvinyl chloride (PVC) by maximum likelihood; FBP (kernel "
        f"`{s['kernel']}`, {s['voxel_mm']:g} mm voxels) and joint model-based reconstruction give the basis images. "
        f"First seed {s['seed']}; {data['total_seconds']:.0f} s in all, {data['processor_seconds']:.0f} s of "
        "processor time "
        f"({', '.join(f'{k} {v:.0f} s' for k, v in data['seconds'].items())}).",
        checks_section(checks),
        "## Decomposition of the rays\n\n"
        "Mean squared error of every ray's estimate over the Cramér–Rao bound at its true line integrals "
        "(*both*: in the metric of the Fisher information), on the scan's own rays.\n\n" + _rays_table(data) + "\n\n"
        f"{data['starved']['rays']} further rays behind 0–600 mm of water at 1e-6 … 1 of the exposure, "
        f"{data['starved']['without_counts']} of them without a single count: "
        f"{data['starved']['not_finite']} not finite, {data['starved']['not_converged']} not converged, "
        f"{data['starved']['at_bound']} at the bounds of the estimate.",
        "## Virtual monochromatic images\n\n"
        "Contrast: fibrous tissue less core, ROI means of the noise-free images. Noise: exact covariance of one voxel "
        "in the fibrous ROI, and of the two ROI means of the paper's CNR protocol (σ² of both added).\n\n"
        f"{_vmi_table(data)}\n\n"
        f"Best energy {vmi['voxel']['optimum_kev']:.1f} keV for the noise of a voxel (CNR "
        f"{vmi['voxel']['best_cnr']:.3f}; the best combination of the basis images, which is no image at one energy, "
        f"reaches {vmi['voxel']['limit']:.3f}), {vmi['roi_means']['optimum_kev']:.1f} keV "
        f"for ROI means (CNR {vmi['roi_means']['best_cnr']:.2f}). "
        "Sampled over exact covariance of the voxels (PE, mixed, PVC): "
        f"{', '.join(f'{v:.3f}' for v in share)}.\n\n"
        "Water, noise free, through the whole chain:\n\n"
        + markdown_table(["where", "lowest HU, 40–140 keV", "highest"], water_rows),
        "## Tissue maps\n\n"
        "Fractions of blood, core, fibrous tissue and fat by multi-material decomposition (Mendonça 2014), then one "
        "tissue a voxel. The paper uses a standard 2-D k-means and does not name its features. The main rule here "
        "(*FBP*, *joint MBIR*) is its assignment step with the centres held at the known tissues, in the two "
        "dimensions of the basis plane in units of its noise: the most likely pure tissue. Dice coefficient over the "
        f"{tissues.truth.shape[0]} slices through the core, voxels that a tissue fills by more than half; the vessel's "
        f"wall, a fifth material, is left out. Mean ± SD over {s['realizations']} realisations (FBP) and "
        f"{s['mbir_realizations']} (MBIR).\n\n" + _dice_table(data) + "\n\n" + _separation_text(data),
    ]  # fmt: skip
    if "mbir" in data:
        parts.append(_mbir_text(data))
    parts.append(effects_section([*plaque.effects, *_own_effects()], data["plan"]["tolerance_hu"]))
    env = data["environment"]
    parts.append("## Environment\n\n" + ", ".join(f"{k} {v}" for k, v in env.items()))
    figures = {"spectral.png": curves_figure(data, plaque, images)}
    figures["tissues.png"] = tissue_figure(data, plaque, tissues, images)
    return Report("spectral", data, "\n\n".join(parts), figures)


def _own_effects() -> list[Effect]:
    residual = float(np.abs(_residual("necrotic_core")).max())
    blood = float(np.abs(_residual("blood_iodine")).max())
    return [
        Effect("two basis functions for every tissue", True, residual,
               f"what PE and PVC cannot express of soft tissue; of blood with iodine (K edge) up to {blood:.0f} HU"),
        Effect("spectral calibration", False, None, "decomposition uses the spectra of the simulation itself"),
        Effect("correlation between energy bins", False, None, "bins count independently: no pile-up, no sharing"),
    ]  # fmt: skip


def _residual(name: str) -> Any:
    from torchpcct.spectral import pe_pvc

    return pe_pvc().residual(name)
