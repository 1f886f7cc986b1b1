"""MBIR and ROI bowtie together, in one simulation: what the paper multiplies from two studies.

The plaque (42.4 mm off the isocentre, inside the 10 cm that the ROI bowtie spares) is scanned with both bowties.
Noise of FBP is exact (adjoint passes). Noise of MBIR comes from realisations of AᵀW y drawn from its covariance, with
the same white noise for both bowties and for the scene with and without its core, which gives the contrast slope. They
are controlled by the method's linear response (:mod:`recon.study.dose_factor.response`): forty draws alone would leave
a factor open by a third either way.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import t as student
from torch import Tensor

from recon.evaluate.store import Pieces
from recon.fbp.exact_noise import roi_covariance
from recon.mbir.mbir import Mbir, working_grid
from recon.pwls.inset_problem import InsetProblem
from recon.study.bowtie.slices import BOWTIES
from recon.study.dose_factor.response import RESPONSE_DRAWS, Response, linear_response
from recon.study.paper import facts as paper
from recon.study.paper.plaque_scan import PlaqueScan, inset_grid, prepare
from torchpcct.metrics import (
    Estimate,
    combined,
    controlled_cnr,
    controlled_log_variance,
    controlled_mean,
    variance_factor,
)
from torchpcct.scanner import presets
from torchpcct.scene.materials import MATERIALS
from torchpcct.scene.plaque import plaque_scene

__all__ = ["FIGURES", "combine", "variance_ratio"]

Floats = NDArray[np.float64]

KERNEL, VOXEL_MM = "soft", 0.25
"""FBP that factors are quoted against: the paper's best."""

_H = np.array([-1.0, 1.0])
"""Contrast of (core, fibrous)."""

FIGURES = {"contrast_variance": "contrast variance", "paper_cnr": "paper's CNR"}
"""What factors are measured by → its name in tables."""


def combine(
    doses: tuple[float, ...], n: int, views: int, seed: int, saved: dict[str, float],
    pieces: Pieces, progress: Callable[[float], None],
) -> tuple[list[dict[str, Any]], dict[str, Any]]:  # fmt: skip
    """Scan, reconstruct, measure.

    Args:
        doses: exposures in s.
        n: paired realisations.
        views: per rotation; fewer keep the tube load of the whole scan.
        seed: realisation k uses the seed ``seed + k``.
        saved: kind of dose → factor that the ROI bowtie saves at equal exposure.
        pieces: keep the scans and the realisations.
        progress: called with the finished fraction.

    Returns:
        JSON values of each exposure, and the plan of the simulation. SDs are those of the two ROI means (core, fibrous)
        and of their difference, exact for FBP, over the realisations for MBIR, uncontrolled; means likewise, noise free
        for FBP.
        Factors have their interval: of MBIR with either bowtie against FBP with the large one at equal exposure, and
        the first times the dose that the bowtie saves (``product_…``).
    """
    prior = Mbir.load()
    scans: dict[tuple[str, bool], PlaqueScan] = {}
    for k, (bowtie, core) in enumerate((("large", True), ("large", False), ("large+roi", True))):
        scanner = presets.pcct(views=views, bowtie=bowtie)
        # The ROIs are those of the plaque with its core, whatever fills it.
        scene = plaque_scene(core_contrast=1.0 if core else 0.0)
        kept = pieces.within(f"plaque_{bowtie}_{core}")
        scans[bowtie, core] = prepare((KERNEL,), (VOXEL_MM,), scene, scanner, paper.FULL_VIEWS["PCCT"], None, kept)
        progress(0.12 * (k + 1))
    reference = scans["large", True]
    grid = working_grid(inset_grid(plaque_scene()[1], 0.2), prior.voxel_mm)
    rois = reference.rois.on(grid)
    covariance, problems, statistics, fbp_means = {}, {}, {}, {}
    for (bowtie, core), scan in scans.items():
        if core:
            covariance[bowtie] = roi_covariance(scan.clean, scan.fbp, scan.pairs, 1.0)[0][0]
            problems[bowtie] = InsetProblem(scan.clean, grid)
        statistics[bowtie, core] = problems[bowtie].statistic(scan.clean).b
        volume = scan.fbp(scan.clean)[0][0]
        fbp_means[bowtie, core] = [float(r(volume)) for r in reference.pairs[0]]
    true = np.array([_true_contrast(), 0.0])
    with_core, without = (np.diff(fbp_means["large", core])[0] for core in (True, False))
    fbp_slope = float((with_core - without) / true[0])
    results = []

    def drawn(key: tuple[str, bool], k: int, dose: float) -> Tensor:
        """b of realisation k."""
        noise = problems[key[0]].gram.scaled(dose).noise(generator=torch.Generator().manual_seed(seed + k))
        return statistics[key] * dose + noise.to(torch.float32)

    for j, dose in enumerate(doses):
        samples: dict[tuple[str, bool], Floats] = {}
        controls: dict[str, _Control] = {}
        for i, key in enumerate(scans):

            def draw(key: tuple[str, bool] = key, dose: float = dose) -> Floats:
                rows = []
                for k in range(n):
                    with torch.no_grad():
                        volume = prior(problems[key[0]], drawn(key, k, dose)[None], dose)[0]
                    rows.append([float(r(volume)) for r in rois])
                return np.array(rows)

            def control(key: tuple[str, bool] = key, dose: float = dose) -> _Control:
                weights = torch.stack([r.weights for r in rois])
                found = linear_response(
                    prior, problems[key[0]], weights, statistics[key] * dose, dose, scans[key].clean, RESPONSE_DRAWS
                )
                assert found is not None
                return np.concatenate([found.of(drawn(key, k, dose)[None]) for k in range(n)]), found

            samples[key] = pieces(f"mbir_{key[0]}_{key[1]}_{dose:g}s", draw)
            if key[1]:
                controls[key[0]] = pieces(f"control_{key[0]}_{dose:g}s", control)
            progress(0.4 + 0.6 * (j + (i + 1) / len(scans)) / len(doses))
        results.append(_figures(dose, samples, controls, covariance, fbp_means, fbp_slope, true, saved))
    return results, dict(reference.clean.info["plan"])


def _true_contrast() -> float:
    """Fibrous tissue minus core as the scanner sees them behind the patient, HU."""
    scanner = presets.pcct()
    energies = scanner.weights()[0]
    weights = scanner.behind({MATERIALS["pericoronary_fat"]: 240.0})[0, scanner.geometry.columns // 2]
    fibrous, core = (MATERIALS[m].hu(energies, weights) for m in ("fibrous_tissue", "necrotic_core"))
    return fibrous - core


_Control = tuple[Floats, Response]
"""Linear functionals of the draws ``(n, 2)``, and their exact moments."""


def _factors(samples: Floats, control: _Control, slope: Any, fbp: tuple[Floats, Floats, float]) -> dict[str, Any]:
    """Figure → factor against FBP, of ``(n, 2)`` ROI means (core, fibrous); fbp: means, covariance, slope."""
    (means, c, fbp_slope), (readings, moments) = fbp, control
    log = controlled_log_variance(samples @ _H, readings @ _H, float(_H @ moments.covariance @ _H))
    cnr = controlled_cnr(samples[:, 0], samples[:, 1], readings, moments.mean, moments.covariance).estimate()
    of_fbp = float(_H @ means / math.sqrt(np.trace(c)))
    return {
        "contrast_variance": variance_factor(log, float(_H @ c @ _H), slope, fbp_slope),
        "paper_cnr": Estimate(*((max(v, 0.0) / of_fbp) ** 2 for v in cnr)),
    }


def _figures(
    dose: float, samples: Any, controls: dict[str, _Control], covariance: Any, fbp_means: Any, fbp_slope: float,
    true: Floats, saved: dict[str, float],
) -> dict[str, Any]:  # fmt: skip
    difference = {key: s[:, 1] - s[:, 0] for key, s in samples.items()}
    fbp = (np.array(fbp_means["large", True]), covariance["large"] / dose, fbp_slope)
    # The twin without core has the same noise, the same control serves it.
    readings, moments = controls["large"]
    seen = [controlled_mean(difference["large", k], readings @ _H, moments.mean @ _H) for k in (True, False)]
    slope = combined(lambda p, a: (p - a) / (true[0] - true[1]), *seen)
    factors = {b: _factors(samples[b, True], controls[b], slope, fbp) for b in BOWTIES}
    fbp_sd = {b: _sd(covariance[b] / dose) for b in BOWTIES}
    means = {f"mbir {b}": samples[b, True].mean(0).tolist() for b in BOWTIES}
    result: dict[str, Any] = {
        "exposure_s": dose,
        "controlled": True,
        "fbp_sd_hu": fbp_sd,
        "mbir_sd_hu": {b: _sd(np.cov(samples[b, True].T)) for b in BOWTIES},
        "means_hu": means | {f"fbp {b}": fbp_means[b, True] for b in BOWTIES},
        "mbir_contrast_slope": list(slope.estimate()),
        "mbir_variance_ratio_roi_to_large": variance_ratio(difference["large+roi", True], difference["large", True]),
        "fbp_variance_ratio_roi_to_large": [
            (roi / large) ** 2 for large, roi in zip(*(fbp_sd[b] for b in BOWTIES), strict=True)
        ],
    }
    for figure in FIGURES:
        large, roi = (list(factors[b][figure]) for b in BOWTIES)
        result[figure] = {
            "mbir_factor_roi_bowtie": roi,
            "mbir_factor_large_bowtie": large,
            **{f"product_{kind}": [factor * v for v in roi] for kind, factor in saved.items()},
        }
    return result


def _sd(c: Any) -> list[float]:
    return [math.sqrt(c[0, 0]), math.sqrt(c[1, 1]), math.sqrt(c[0, 0] + c[1, 1] - 2 * c[0, 1])]


def variance_ratio(a: Floats, b: Floats) -> tuple[float, float, float]:
    """Ratio of the variances of paired samples with a 95 % interval (Pitman and Morgan's exact one for normal data)."""
    n = a.size
    ratio = float(a.var(ddof=1) / b.var(ddof=1))
    r = float(np.corrcoef(a, b)[0, 1])
    # (1 − r²) t² / (n − 2): see Snedecor and Cochran, Statistical Methods, section on correlated variances.
    k = 1.0 + 2.0 * max(1.0 - r * r, 0.0) * float(student.ppf(0.975, n - 2)) ** 2 / (n - 2)
    spread = math.sqrt(k * k - 1.0)
    return ratio, ratio * (k - spread), ratio * (k + spread)
