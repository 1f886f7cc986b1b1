"""MBIR and ROI bowtie together, in one simulation: what the paper multiplies from two studies.

The plaque (42.4 mm off the isocentre, inside the 10 cm that the ROI bowtie spares) is scanned with both bowties.
Noise of FBP is exact (adjoint passes). Noise of MBIR comes from realisations of AᵀW y drawn from its covariance, with
the same white noise for both bowties and for the scene with and without its core, which gives the contrast slope.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from recon.study.bowtie.slice_scan import BOWTIES
from recon.study.paper.plaque_scan import PlaqueScan, inset_grid, prepare
from torchpcct.metrics import ContrastSlope, DoseCurve, DoseFactor, contrast_slope, dose_factor
from torchpcct.scanner import presets
from torchpcct.scene.plaque import plaque_scene

__all__ = ["Combined", "combine"]

Floats = NDArray[np.float64]

KERNEL, VOXEL_MM = "soft", 0.25
"""FBP that factors are quoted against: the paper's best."""

FULL_VIEWS = 1968


@dataclass(frozen=True)
class Combined:
    """Figures of one exposure.

    Attributes:
        exposure_s: of the scan.
        fbp_sd: bowtie → SD of the two ROI means (core, fibrous) of FBP and of their difference, HU, exact.
        mbir_sd: bowtie → the same of MBIR over the realisations.
        means: (method, bowtie) → mean of the two ROI means, HU: noise free for FBP, over the realisations for MBIR.
        variance_ratio: MBIR's contrast variance with over without the ROI bowtie, (value, low, high), paired.
        slope: MBIR's contrast slope with the large bowtie.
        factors: figure → dose factor of MBIR with the ROI bowtie against FBP with the large one, equal exposure = 1.
        factors_large: the same of MBIR with the large bowtie.
    """

    exposure_s: float
    fbp_sd: dict[str, list[float]]
    mbir_sd: dict[str, list[float]]
    means: dict[str, list[float]]
    variance_ratio: tuple[float, float, float]
    slope: ContrastSlope
    factors: dict[str, DoseFactor]
    factors_large: dict[str, DoseFactor]


def combine(
    doses: tuple[float, ...], n: int, views: int, seed: int, progress: Callable[[float], None]
) -> tuple[list[Combined], dict[str, Any]]:
    """Scan, reconstruct, measure.

    Args:
        doses: exposures in s.
        n: paired realisations.
        views: per rotation; fewer keep the tube load of the whole scan.
        seed: realisation k uses the seed ``seed + k``.
        progress: called with the finished fraction.

    Returns:
        Figures of each exposure, and the plan of the simulation.
    """
    from recon.fbp.exact_noise import roi_covariance
    from recon.mbir.mbir import Mbir, working_grid
    from recon.pwls.inset_problem import InsetProblem

    prior = Mbir.load()
    scans: dict[tuple[str, bool], PlaqueScan] = {}
    for k, (bowtie, core) in enumerate((("large", True), ("large", False), ("large+roi", True))):
        scanner = presets.pcct(views=views, bowtie=bowtie)
        scene = plaque_scene(core_contrast=1.0 if core else 0.0)
        # The ROIs are those of the plaque with its core, whatever fills it.
        scans[bowtie, core] = prepare((KERNEL,), (VOXEL_MM,), scene, scanner, FULL_VIEWS)
        progress(0.12 * (k + 1))
    reference = scans["large", True]
    plaque = plaque_scene()[1]
    grid = working_grid(inset_grid(plaque, 0.2), prior.voxel_mm)
    rois = reference.rois.on(grid)
    covariance, problems, statistics, fbp_means = {}, {}, {}, {}
    for (bowtie, core), scan in scans.items():
        if core:
            covariance[bowtie] = roi_covariance(scan.clean, scan.fbp, scan.pairs, 1.0)[0][0]
            problems[bowtie] = InsetProblem(scan.clean, grid)
        statistics[bowtie, core] = problems[bowtie].statistic(scan.clean).b
        volume = scan.fbp(scan.clean)[0][0]
        fbp_means[bowtie, core] = [float(r(volume)) for r in reference.pairs[0]]
    contrasts = np.array([np.diff(fbp_means["large", core])[0] for core in (True, False)])
    true = np.array([_true_contrast(reference), 0.0])
    fbp_slope = float((contrasts[0] - contrasts[1]) / true[0])
    results = []
    for j, dose in enumerate(doses):
        samples: dict[Any, Any] = {}
        for i, key in enumerate(scans):
            bowtie = key[0]
            problem = problems[bowtie]
            rows = []
            for k in range(n):
                generator = torch.Generator().manual_seed(seed + k)
                b = statistics[key] * dose + problem.gram.scaled(dose).noise(generator=generator).to(torch.float32)
                volume = prior(problem, b[None], dose)[0]
                rows.append([float(r(volume)) for r in rois])
            samples[key] = np.array(rows)
            progress(0.4 + 0.6 * (j + (i + 1) / len(scans)) / len(doses))
        results.append(_figures(dose, samples, covariance, fbp_means, fbp_slope, true))
    return results, dict(reference.clean.info["plan"])


def _true_contrast(scan: PlaqueScan) -> float:
    """Fibrous tissue minus core as the scanner sees them behind the patient, HU."""
    from torchpcct.scene.materials import MATERIALS

    scanner = presets.pcct()
    energies = scanner.weights()[0]
    column = scanner.geometry.columns // 2
    weights = scanner.behind({MATERIALS["pericoronary_fat"]: 240.0})[0, column]
    hu = [MATERIALS[m].hu(energies, weights) for m in ("fibrous_tissue", "necrotic_core")]
    return hu[0] - hu[1]


def _figures(dose: float, samples: Any, covariance: Any, fbp_means: Any, fbp_slope: float, true: Floats) -> Combined:
    difference = {key: s[:, 1] - s[:, 0] for key, s in samples.items()}
    slope = contrast_slope(true, np.stack([difference["large", True], difference["large", False]]))
    c = covariance["large"] / dose
    curves = {
        "contrast_variance": DoseCurve.contrast_variance(c, fbp_slope),
        "paper_cnr": DoseCurve.paper_cnr(fbp_means["large", True], c),
    }
    factors = {
        bowtie: {
            "contrast_variance": dose_factor(
                samples[bowtie, True], curves["contrast_variance"], "contrast_variance", slope=slope
            ),
            "paper_cnr": dose_factor(samples[bowtie, True], curves["paper_cnr"], "paper_cnr"),
        }
        for bowtie in BOWTIES
    }
    means = {f"mbir {b}": samples[b, True].mean(0).tolist() for b in BOWTIES}
    means |= {f"fbp {b}": fbp_means[b, True] for b in BOWTIES}
    return Combined(
        dose,
        {b: _sd(covariance[b] / dose) for b in BOWTIES},
        {b: _sd(np.cov(samples[b, True].T)) for b in BOWTIES},
        means,
        _variance_ratio(difference["large+roi", True], difference["large", True]),
        slope,
        factors["large+roi"],
        factors["large"],
    )


def _sd(c: Any) -> list[float]:
    return [math.sqrt(c[0, 0]), math.sqrt(c[1, 1]), math.sqrt(c[0, 0] + c[1, 1] - 2 * c[0, 1])]


def _variance_ratio(a: Floats, b: Floats) -> tuple[float, float, float]:
    """Ratio of the variances of paired samples with a 95 % interval (Pitman and Morgan's exact one for normal data)."""
    from scipy.stats import t as student

    n = a.size
    ratio = float(a.var(ddof=1) / b.var(ddof=1))
    r = float(np.corrcoef(a, b)[0, 1])
    # (1 − r²) t² / (n − 2): see Snedecor and Cochran, Statistical Methods, section on correlated variances.
    k = 1.0 + 2.0 * max(1.0 - r * r, 0.0) * float(student.ppf(0.975, n - 2)) ** 2 / (n - 2)
    spread = math.sqrt(k * k - 1.0)
    return ratio, ratio * (k - spread), ratio * (k + spread)
