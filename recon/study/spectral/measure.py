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

import itertools
import logging
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.fbp.exact_noise import functional_covariance
from recon.pwls.basis_problem import DEFAULT_JOINT_PRIOR, BasisProblem
from recon.study.report import Report
from recon.study.spectral.scan import PlaqueScan, second_order_bound, starved_rays, water_hu
from recon.study.spectral.tissues import RULES, Tissues
from torchpcct.metrics.placement import place_rois
from torchpcct.metrics.roi import axial_grid
from torchpcct.spectral import MMD_TISSUES, VMI_ENERGIES_KEV, VmiCurve, vmi, vmi_curve

__all__ = ["Settings", "run"]

log = logging.getLogger(__name__)

Floats = NDArray[np.float64]
Progress = Callable[[str, float], None]

LOW_EXPOSURE_S = 0.35
"""The paper's shortest exposure: the decomposition must hold there, too."""

_FAT_MM = 3.2  # from the vessel's axis on there is only fat
_METHOD = {"nearest": "FBP", "k-means": "FBP, k-means of fractions", "largest": "FBP, largest fraction"}
_LOW_EXPOSURE_STEP = 8  # views between those that are looked at there


@dataclass(frozen=True)
class Settings:
    """Settings of the study.

    Args:
        exposure_s: of the standard noise (the paper does not state it; 2.0 s is the exposure of its tables).
        realizations: of the noise, for tissue maps by FBP.
        mbir_realizations: of these, how many are reconstructed by joint MBIR at every noise level; 0: none.
        noise_levels: shares of the standard noise, ascending, 0 first.
        views: per rotation (paper: 1968).
        voxel_mm: [paper: 0.2].
        kernel: of FBP (the paper names none for its spectral images).
        starved_rays: number of rays from no counts to air that the decomposition is tried on.
        seed: first seed of the noise.

    Raises:
        ValueError: a value out of range.
    """

    exposure_s: float = 2.0
    realizations: int = 4
    mbir_realizations: int = 2
    noise_levels: tuple[float, ...] = (0.0, 0.25, 0.5, 1.0)
    views: int = 1968
    voxel_mm: float = 0.2
    kernel: str = "standard"
    starved_rays: int = 20_000
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.exposure_s > 0:
            raise ValueError(f"exposure_s must be greater than 0 s, got {self.exposure_s}")
        if self.realizations < 1:
            raise ValueError(f"realizations must be at least 1, got {self.realizations}")
        if not 0 <= self.mbir_realizations <= self.realizations:
            raise ValueError(
                f"mbir_realizations must lie in 0…{self.realizations} (realizations), got {self.mbir_realizations}"
            )
        levels = self.noise_levels
        if not levels or levels[0] != 0 or any(b <= a for a, b in itertools.pairwise(levels)):
            raise ValueError(f"noise_levels must ascend from 0, got {levels}")
        if self.views < 60:
            raise ValueError(f"views must be at least 60, got {self.views}")
        if self.starved_rays < 100:
            raise ValueError(f"starved_rays must be at least 100, got {self.starved_rays}")

    @classmethod
    def quick(cls, **changes: Any) -> Settings:
        """A first look in under a minute: an eighth of the views, one realisation."""
        values: dict[str, Any] = {"views": 246, "realizations": 1, "mbir_realizations": 1, "starved_rays": 5000}
        return cls(**{**values, **changes})


def run(settings: Settings, progress: Progress | None = None) -> Report:
    """Run the study.

    Args:
        settings: see :class:`Settings`.
        progress: called with the name of the step and its finished fraction.
    """
    from recon.study.spectral.report import build_report

    started, spent = time.perf_counter(), time.process_time()

    def tell(step: str, fraction: float) -> None:
        if progress is not None:
            progress(step, fraction)

    data: dict[str, Any] = {"settings": asdict(settings), "seconds": {}}

    def done(step: str) -> None:
        data["seconds"][step] = round(time.perf_counter() - started - sum(data["seconds"].values()), 1)
        tell(step, 1.0)

    plaque = PlaqueScan(settings, lambda f: tell("simulate", f))
    data["plan"] = plaque.info["plan"]
    done("simulate")
    images = {"clean": plaque.fbp.images(plaque.exact.line_integrals)[0][0]}
    data["second_order_bound"] = second_order_bound(plaque, LOW_EXPOSURE_S)
    data["starved"] = starved_rays(plaque, settings.starved_rays, settings.seed)
    data["water"] = {k: v.tolist() for k, v in water_hu(plaque, VMI_ENERGIES_KEV).items()}
    done("water and starved rays")
    lines, statistics = _noisy_scans(plaque, images, tell)
    data["rays"] = [asdict(s) for s in statistics]
    done("decompose noisy scans")
    data["vmi"] = _vmi(plaque, images)
    done("monochromatic images")
    tissues = Tissues(plaque, data["vmi"]["voxel_covariance"])
    data["separation"] = tissues.separation()
    data["misplaced_core"] = tissues.misplaced_core(images["clean"])
    data["dice"] = {_METHOD[rule]: _dice_fbp(tissues, images, settings, rule) for rule in RULES}
    done("tissue maps")
    if settings.mbir_realizations:
        data["mbir"] = _mbir(plaque, tissues, lines, images, data, tell)
        done("joint MBIR")
    data["total_seconds"] = round(time.perf_counter() - started, 1)
    data["processor_seconds"] = round(time.process_time() - spent, 1)
    return build_report(data, plaque, tissues, images)


def _noisy_scans(plaque: PlaqueScan, images: dict[str, Tensor], tell: Progress) -> tuple[list[Tensor], list[Any]]:
    """Decompose the noisy scans; their FBP goes to ``images["noisy"]``. Returns what MBIR needs, and statistics."""
    s = plaque.settings
    volumes, kept, statistics = [], [], []
    for k in range(s.realizations):
        lines, found = plaque.noisy(s.exposure_s, s.seed + k)
        statistics.append(found)
        volumes.append(plaque.fbp.images(lines)[0][0])
        if k < s.mbir_realizations:
            kept.append(lines)
        tell("decompose noisy scans", (k + 1) / (s.realizations + 1))
    statistics.append(plaque.noisy(LOW_EXPOSURE_S, s.seed, _LOW_EXPOSURE_STEP)[1])
    images["noisy"] = torch.stack(volumes)
    return kept, statistics


def _curve(curve: VmiCurve) -> dict[str, Any]:
    return {
        "contrast_hu": curve.contrast.tolist(),
        "noise_hu": curve.noise.tolist(),
        "cnr": curve.cnr.tolist(),
        "optimum_kev": curve.optimum_kev,
        "best_cnr": float(curve.cnr.max()),
        "limit": curve.limit,
    }


def _vmi(plaque: PlaqueScan, images: dict[str, Tensor]) -> dict[str, Any]:
    """Contrast of core and fibrous tissue, noise and CNR against energy."""
    s = plaque.settings
    px, py, pz = plaque.plaque.position
    rois = place_rois(plaque.scene, axial_grid((pz, py, px)))
    foreground, background = rois.on(plaque.grid)
    core, fibrous = (roi(images["clean"]).numpy() for roi in (foreground, background))
    voxel = torch.zeros(plaque.grid.shape, dtype=torch.float64)
    voxel.view(-1)[int(background.weights.argmax())] = 1.0  # the voxel that the background ROI weighs most
    functionals = torch.stack([voxel, foreground.weights, background.weights]).to(torch.float32)
    exact = functional_covariance(plaque.fbp, functionals, plaque.covariance(s.exposure_s))
    noisy = images["noisy"] - images["clean"]
    # The noise of the inset is nearly stationary in the plane: all voxels of the ROI's slice, far from rounding errors.
    z = int(background.weights.argmax()) // (plaque.grid.shape[1] * plaque.grid.shape[2])
    sampled = torch.cov(noisy[:, :, z].transpose(0, 1).reshape(2, -1).double()).numpy()[(0, 0, 1), (0, 1, 1)]
    return {
        "energies_kev": list(VMI_ENERGIES_KEV),
        "roi": rois.as_dict(),
        "core": core.tolist(),
        "fibrous": fibrous.tolist(),
        "voxel_covariance": exact[0, 0].tolist(),
        "sampled_covariance": sampled.tolist(),
        "voxel": _curve(vmi_curve(fibrous, core, exact[0, 0], plaque.basis)),
        # Protocol of the paper's CNR tables: noise of both ROI means over realisations.
        "roi_means": _curve(vmi_curve(fibrous, core, exact[1, 1] + exact[2, 2], plaque.basis)),
    }


def _summary(scores: list[dict[str, float]]) -> dict[str, Any]:
    values = np.array([[s[t] for t in MMD_TISSUES] for s in scores])
    spread = values.std(0, ddof=1) if len(values) > 1 else np.full(len(MMD_TISSUES), np.nan)
    return {t: {"mean": float(m), "sd": float(d)} for t, m, d in zip(MMD_TISSUES, values.mean(0), spread, strict=True)}


def _dice_fbp(tissues: Tissues, images: dict[str, Tensor], settings: Settings, rule: str) -> list[Any]:
    out = []
    for level in settings.noise_levels:
        many = images["clean"] + level * (images["noisy"] - images["clean"]) if level else images["clean"][None]
        out.append({"noise": level, **_summary([dict(tissues.dice(v, rule)) for v in many])})
    return out


def _at_best(plaque: PlaqueScan, rois: Any, images: Tensor, energy: float) -> dict[str, float]:
    """ROI means, and the SD of voxels in fat, of one monochromatic image, HU."""
    hu = vmi(images, plaque.basis, [energy])[0]
    _, y, x = (a - c for a, c in zip(plaque.grid.axes, plaque.grid.center, strict=True))
    far = torch.from_numpy(np.hypot(y[:, None], x) > _FAT_MM)
    middle = plaque.grid.shape[0] // 2
    fat = hu[middle - 4 : middle + 4][:, far]
    core, fibrous = (float(roi(hu)) for roi in rois)
    return {"core_hu": core, "fibrous_hu": fibrous, "fat_sd_hu": float(fat.double().std())}


def _mbir(
    plaque: PlaqueScan, tissues: Tissues, lines: list[Tensor], images: dict[str, Tensor], data: dict[str, Any],
    tell: Progress,
) -> dict[str, Any]:  # fmt: skip
    """Joint MBIR at every noise level; pictures of the first realisation go to ``images["mbir"]``."""
    s = plaque.settings
    problem = BasisProblem(plaque.clean, plaque.model(1.0), plaque.grid)
    clean = plaque.exact.line_integrals
    scores, reports, pictures, values = [], [], [], []
    px, py, pz = plaque.plaque.position
    rois = place_rois(plaque.scene, axial_grid((pz, py, px))).on(plaque.grid)
    best = data["vmi"]["voxel"]["optimum_kev"]
    lowest = next((v for v in s.noise_levels if v > 0), 1.0)
    steps, count = 1 + (len(s.noise_levels) - 1) * len(lines), 0
    for level in s.noise_levels:
        # Data without noise take the weights of the lowest noise: it is the prior that changes them.
        dose = s.exposure_s / (level or lowest) ** 2
        found = []
        for noisy in lines if level else lines[:1]:
            volume, report = problem.solve(clean + level * (noisy - clean), plaque.window, dose=dose, tolerance=1.0)
            found.append(volume)
            reports.append({"noise": level, **report})
            count += 1
            tell("joint MBIR", count / steps)
        scores.append({"noise": level, **_summary([dict(tissues.dice(v)) for v in found])})
        pictures.append(found[0])
        fbp = images["clean"] + level * (images["noisy"][0] - images["clean"])
        values.append({"noise": level, "FBP": _at_best(plaque, rois, fbp, best),
                       "joint MBIR": _at_best(plaque, rois, found[0], best)})  # fmt: skip
    data["dice"]["joint MBIR"] = scores
    images["mbir"] = torch.stack(pictures)
    return {
        "anisotropy": problem.anisotropy,
        "whitening": problem.whitening.forward.tolist(),
        "prior": asdict(DEFAULT_JOINT_PRIOR),
        "solves": reports,
        "at_best_energy": values,
    }
