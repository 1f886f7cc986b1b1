"""The spectral study: decomposition into PE and PVC, virtual monochromatic images, tissue maps, by FBP and joint MBIR.

The paper's plaque is scanned in eight energy bins and every ray decomposed into line integrals of the two basis
materials. Their FBP, and their joint model-based reconstruction, give basis images, those virtual monochromatic images
(VMI) and tissue maps.

* Noise of VMIs is exact: FBP is linear, the rays' covariance is known (Cramér–Rao, which the decomposition reaches: the
  study checks it on its own rays), so one adjoint pass per functional replaces realisations.
* The paper's noise levels are shares of the *standard noise*: the difference of a noisy to the noise-free scan is
  multiplied by 0.25, 0.5 and 1.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from recon.analytic.exact_noise import functional_covariance
from recon.evaluate.store import Pieces
from recon.least_squares.basis_problem import BasisProblem
from recon.least_squares.qggmrf import DEFAULT_PRIOR
from recon.study.spectral.calibration import calibration_costs
from recon.study.spectral.scan import SpectralScan, second_order_bound, starved_rays, water_hu
from recon.study.spectral.settings import Settings
from recon.study.spectral.tissues import RULES, Tissues
from recon.study.study import Clock, Progress, silent
from torchpcct.spectral import MMD_TISSUES, VMI_ENERGIES_KEV, VmiCurve, vmi, vmi_curve

__all__ = ["Images", "Measured", "measure"]

LOW_EXPOSURE_S = 0.35
"""The paper's shortest exposure: the decomposition must hold there, too."""

_FAT_MM = 3.2  # from the vessel's axis on there is only fat
_LOW_EXPOSURE_STEP = 8  # views between those that are looked at there


@dataclass
class Images:
    """Basis images: ``clean`` ``(2, z, y, x)``, ``noisy`` ``(n, 2, z, y, x)`` at the standard noise, both by FBP, and
    ``mbir``, the first of every noise level, ``(levels, 2, z, y, x)``."""

    clean: Tensor
    noisy: Tensor
    mbir: Tensor | None = None

    def fbp(self, level: float) -> Tensor:
        """FBP at a share of the standard noise, ``(n, 2, z, y, x)``; one image without noise."""
        return self.clean + level * (self.noisy - self.clean) if level else self.clean[None]


@dataclass(frozen=True)
class Measured:
    """What the report needs.

    Attributes:
        settings: of the study.
        data: JSON values by part.
        scan, tissues, images: geometry, truth and volumes of the figures.
        seconds: step → seconds; processor_seconds: of all steps.
    """

    settings: Settings
    data: dict[str, Any]
    scan: SpectralScan
    tissues: Tissues
    images: Images
    seconds: dict[str, float]
    processor_seconds: float


def measure(settings: Settings, progress: Progress = silent, folder: str | Path | None = None) -> Measured:
    """Scan, decompose, reconstruct, label, in resumable pieces."""
    s, clock, spent = settings, Clock(), time.process_time()
    pieces = Pieces(folder, settings)

    def done(step: str) -> None:
        clock.lap(step)
        progress(step, 1.0)

    scan = SpectralScan(s, lambda fraction: progress("simulate", fraction), pieces=pieces)
    data: dict[str, Any] = {"plan": scan.clean.info["plan"]}
    done("simulate")
    clean = scan.fbp.images(scan.exact.line_integrals)[0][0]
    data["second_order_bound"] = pieces("bound", partial(second_order_bound, scan, LOW_EXPOSURE_S))
    data["starved"] = pieces("starved", partial(starved_rays, scan, s.starved_rays, s.seed))
    data["water"] = {k: v.tolist() for k, v in pieces("water", partial(water_hu, VMI_ENERGIES_KEV, s.views)).items()}
    done("water and starved rays")
    lines, volumes, data["rays"] = [], [], []
    pieces.ahead(_noisy_ahead, *((k,) for k in range(s.realizations)))
    for k in range(s.realizations):
        volume, used, statistics = _noisy(scan, pieces, k)
        data["rays"].append(statistics)
        volumes.append(volume)
        lines += used
        progress("decompose noisy scans", (k + 1) / (s.realizations + 1))
    low = pieces("noisy_low", lambda: scan.noisy(LOW_EXPOSURE_S, s.seed, _LOW_EXPOSURE_STEP)[1])
    data["rays"].append(low)
    images = Images(clean, torch.stack(volumes))
    done("decompose noisy scans")
    data["vmi"] = _vmi(scan, images)
    done("monochromatic images")
    tissues = Tissues(scan, data["vmi"]["voxel_covariance"])
    data["separation"] = tissues.separation()
    data["misplaced_core"] = tissues.misplaced_core(clean)
    data["dice"] = {
        name: [_scores(level, tissues, images.fbp(level), rule) for level in s.noise_levels]
        for rule, name in RULES.items()
    }
    done("tissue maps")
    if lines:
        data["mbir"], data["dice"]["joint MBIR"] = _mbir(scan, tissues, lines, images, data["vmi"], pieces, progress)
        done("joint MBIR")
    if s.calibration_views:
        costs = partial(calibration_costs, s, tissues, lambda fraction: progress("wrong calibrations", fraction))
        data["calibration"] = pieces("calibration", costs)
        clock.lap("wrong calibrations")
    return Measured(s, data, scan, tissues, images, clock.seconds, time.process_time() - spent)


def _noisy(scan: SpectralScan, pieces: Pieces, k: int) -> tuple[Tensor, list[Tensor], dict[str, Any]]:
    """FBP of a realisation, its line integrals if MBIR needs them, and what is told of its rays."""
    s = scan.settings

    def draw() -> tuple[Tensor, list[Tensor], dict[str, Any]]:
        noisy, statistics = scan.noisy(s.exposure_s, s.seed + k)
        return scan.fbp.images(noisy)[0][0], [noisy] if k < s.mbir_realizations else [], statistics

    return pieces(f"noisy_{k}", draw)


def _noisy_ahead(settings: Settings, pieces: Pieces, k: int) -> None:
    _noisy(SpectralScan(settings, pieces=pieces), pieces, k)


def _curve(curve: VmiCurve) -> dict[str, Any]:
    return {
        "contrast_hu": curve.contrast.tolist(),
        "noise_hu": curve.noise.tolist(),
        "cnr": curve.cnr.tolist(),
        "optimum_kev": curve.optimum_kev,
        "best_cnr": float(curve.cnr.max()),
        "limit": curve.limit,
    }


def _vmi(scan: SpectralScan, images: Images) -> dict[str, Any]:
    """Contrast of core and fibrous tissue, noise and CNR against energy."""
    foreground, background = scan.rois.on(scan.grid)
    core, fibrous = (roi(images.clean).numpy() for roi in (foreground, background))
    voxel = torch.zeros(scan.grid.shape, dtype=torch.float64)
    most = int(background.weights.argmax())  # the voxel that the background ROI weighs most
    voxel.view(-1)[most] = 1.0
    functionals = torch.stack([voxel, foreground.weights, background.weights]).to(torch.float32)
    exact = functional_covariance(scan.fbp, functionals, scan.covariance(scan.settings.exposure_s))
    # The noise of the inset is nearly stationary in the plane: all voxels of the ROI's slice, far from rounding errors.
    z = most // (scan.grid.shape[1] * scan.grid.shape[2])
    noise = (images.noisy - images.clean)[:, :, z].transpose(0, 1).reshape(2, -1).double()
    return {
        "energies_kev": list(VMI_ENERGIES_KEV),
        "roi": scan.rois.as_dict(),
        "core": core.tolist(),
        "fibrous": fibrous.tolist(),
        "voxel_covariance": exact[0, 0].tolist(),
        "sampled_covariance": torch.cov(noise).numpy()[(0, 0, 1), (0, 1, 1)].tolist(),
        "voxel": _curve(vmi_curve(fibrous, core, exact[0, 0], scan.basis)),
        # Protocol of the paper's CNR tables: noise of both ROI means over realisations.
        "roi_means": _curve(vmi_curve(fibrous, core, exact[1, 1] + exact[2, 2], scan.basis)),
    }


def _scores(level: float, tissues: Tissues, volumes: Sequence[Tensor] | Tensor, rule: str = "nearest") -> Any:
    """Mean and SD of every tissue's Dice coefficient over realisations."""
    values = np.array([tissues.dice(v, rule) for v in volumes])
    spread = values.std(0, ddof=1) if len(values) > 1 else np.full(len(MMD_TISSUES), np.nan)
    scores = zip(MMD_TISSUES, values.mean(0), spread, strict=True)
    return {"noise": level, **{t: {"mean": float(m), "sd": float(d)} for t, m, d in scores}}


def _at_energy(scan: SpectralScan, images: Tensor, energy: float) -> dict[str, float]:
    """ROI means, and the SD of voxels in fat, of one monochromatic image, HU."""
    hu = vmi(images, scan.basis, [energy])[0]
    _, y, x = (a - c for a, c in zip(scan.grid.axes, scan.grid.center, strict=True))
    far = torch.from_numpy(np.hypot(y[:, None], x) > _FAT_MM)
    middle = scan.grid.shape[0] // 2
    fat = hu[middle - 4 : middle + 4][:, far]
    core, fibrous = (float(roi(hu)) for roi in scan.rois.on(scan.grid))
    return {"core_hu": core, "fibrous_hu": fibrous, "fat_sd_hu": float(fat.double().std())}


def _mbir(
    scan: SpectralScan, tissues: Tissues, lines: list[Tensor], images: Images, curves: dict[str, Any],
    pieces: Pieces, progress: Progress,
) -> tuple[dict[str, Any], list[dict[str, Any]]]:  # fmt: skip
    """Joint MBIR at every noise level, and its scores; volumes of the first realisation go to ``images``."""
    s = scan.settings
    problem = BasisProblem(scan.clean, scan.model(1.0), scan.grid)
    clean, best = scan.exact.line_integrals, curves["voxel"]["optimum_kev"]
    lowest = next((v for v in s.noise_levels if v > 0), 1.0)
    steps, scores, reports, pictures, values = 1 + (len(s.noise_levels) - 1) * len(lines), [], [], [], []
    for level in s.noise_levels:
        # Data without noise take the weights of the lowest noise: it is the prior that changes them.
        dose, found = s.exposure_s / (level or lowest) ** 2, []
        for k, noisy in enumerate(lines if level else lines[:1]):
            data = clean + level * (noisy - clean)
            solve = partial(problem.solve, data, scan.window, dose=dose, tolerance=1.0)
            volume, report = pieces(f"mbir_{level:g}_{k}", solve)
            found.append(volume)
            reports.append({"noise": level, **report})
            progress("joint MBIR", len(reports) / steps)
        scores.append(_scores(level, tissues, found))
        pictures.append(found[0])
        both = {"FBP": images.fbp(level)[0], "joint MBIR": found[0]}
        values.append({"noise": level, **{k: _at_energy(scan, v, best) for k, v in both.items()}})
    images.mbir = torch.stack(pictures)
    return {
        "anisotropy": problem.anisotropy,
        "whitening": problem.whitening.forward.tolist(),
        "prior": asdict(DEFAULT_PRIOR),
        "solves": reports,
        "at_best_energy": values,
    }, scores
