"""Simulate the plaque's scan, reconstruct every noise realisation by FBP and PWLS, take the ROI means."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from recon import reconstruct
from recon.fbp.exact_noise import roi_covariance
from recon.fbp.inset import InsetFbp
from recon.pwls.inset_problem import InsetProblem
from recon.study.compare.settings import Settings
from recon.study.paper import facts as paper
from recon.study.paper.plaque_scan import REFERENCE_KERNEL, REFERENCE_VOXEL_MM, PlaqueScan, prepare, roi_entry
from recon.study.study import Clock, Progress, silent
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.placement import RoiPair
from torchpcct.scanner import presets
from torchpcct.scene.plaque import plaque_scene

__all__ = ["PWLS", "Key", "Measured", "measure"]

PWLS = ("pwls", "q-GGMRF")
"""Method and "kernel" of PWLS in the tables."""

PWLS_VOXEL_MM = 0.25
"""Voxel size at which PWLS is run at every dose (the paper's best for FBP); at the tables' dose it is run at all."""

Key = tuple[str, str, float, float]
"""Method, kernel, voxel size in mm, exposure in s."""


@dataclass
class Measured:
    """Everything the report needs.

    Attributes:
        rois: the two ROIs; plan: of the simulation.
        noise_free: ROI means of noise-free FBP, the reference image first; then with their exact covariance at 1 s.
        means: setting → ``(realisations, 2)`` ROI means in HU: core, fibrous.
        voxel_noise: setting of FBP → SD over the realisations, rms over the inset, HU.
        images: (method, kernel, voxel size) → first realisation at the tables' dose, and the noise-free reference.
        grids: voxel size → grid.
        pwls: how PWLS converged, for every voxel size and dose.
        seconds: per step.
    """

    settings: Settings
    rois: RoiPair
    plan: dict[str, Any]
    noise_free: list[dict[str, Any]]
    means: dict[Key, NDArray[np.float64]]
    voxel_noise: dict[Key, float]
    images: dict[tuple[str, str, float], Any]
    grids: dict[float, VolumeGrid]
    pwls: list[dict[str, Any]]
    seconds: dict[str, float]


def measure(settings: Settings, progress: Progress = silent, folder: str | Path | None = None) -> Measured:
    """Simulate, reconstruct, measure; see :mod:`recon.study.study`."""
    clock = Clock()
    scanned = prepare(
        settings.kernels, settings.voxels_mm, plaque_scene(), presets.pcct(views=settings.views),
        paper.FULL_VIEWS["PCCT"], lambda f: progress("simulate", f),
    )  # fmt: skip
    clean, fine, fbp = scanned.clean, scanned.fine, scanned.fbp
    clock.lap("simulate")
    reference = InsetFbp(clean, [fine], [REFERENCE_KERNEL])(clean)[0][0]
    m = Measured(
        settings=settings,
        rois=scanned.rois,
        plan=dict(clean.info["plan"]),
        noise_free=[roi_entry("fbp", REFERENCE_KERNEL, REFERENCE_VOXEL_MM, scanned.rois.on(fine), reference)],
        means={},
        voxel_noise={},
        images={("noise free", REFERENCE_KERNEL, REFERENCE_VOXEL_MM): reference},
        grids={g.spacing[0]: g for g in [fine, *scanned.grids]},
        pwls=[],
        seconds=clock.seconds,
    )
    expected = fbp(clean)
    for grid, pair, volumes in zip(scanned.grids, scanned.pairs, expected, strict=True):
        for kernel, volume in zip(settings.kernels, volumes, strict=True):
            m.noise_free.append(roi_entry("fbp", kernel, grid.spacing[0], pair, volume))
    clock.lap("noise-free FBP")
    progress("exact noise of FBP", 0.0)
    covariances = roi_covariance(clean, fbp, scanned.pairs, 1.0)
    for entry, matrix in zip(m.noise_free[1:], itertools.chain.from_iterable(covariances), strict=True):
        entry["covariance_hu2_s"] = matrix.tolist()
    clock.lap("exact noise of FBP")
    _realisations(m, scanned, expected, clock, progress)
    if settings.pwls:
        _run_pwls(m, scanned, progress)
        clock.lap("PWLS")
    return m


def _realisations(m: Measured, scanned: PlaqueScan, expected: Any, clock: Clock, progress: Progress) -> None:
    """FBP of every noise realisation."""
    s = m.settings
    means: dict[Key, list[tuple[float, float]]] = {}
    squares: dict[Key, float] = {}
    total = len(s.doses) * s.realizations
    for done, (exposure, seed) in enumerate(_runs(s)):
        scan = scanned.clean.with_noise(exposure, seed)
        clock.lap("noise")
        for grid, pair, volumes, truth in zip(scanned.grids, scanned.pairs, scanned.fbp(scan), expected, strict=True):
            voxel = grid.spacing[0]
            for kernel, volume, mean in zip(s.kernels, volumes, truth, strict=True):
                key = ("fbp", kernel, voxel, exposure)
                # FBP is linear: its expectation is known, and every voxel of every run adds to the variance.
                squares[key] = squares.get(key, 0.0) + float(torch.mean((volume - mean) ** 2)) / s.realizations
                means.setdefault(key, []).append((float(pair[0](volume)), float(pair[1](volume))))
                if seed == s.seed and exposure == paper.table_exposure(s.doses):
                    m.images["fbp", kernel, voxel] = volume
        clock.lap("FBP")
        progress("noise realisations, FBP", (done + 1) / total)
    m.means.update({key: np.array(values) for key, values in means.items()})
    m.voxel_noise.update({key: math.sqrt(value) for key, value in squares.items()})


def _run_pwls(m: Measured, scanned: PlaqueScan, progress: Progress) -> None:
    s = m.settings
    shown = paper.table_exposure(s.doses)
    problems: dict[float, InsetProblem] = {}
    jobs = [
        (exposure, grid, pair)
        for exposure in s.doses.values()
        for grid, pair in zip(scanned.grids, scanned.pairs, strict=True)
        if (exposure == shown) + (grid.spacing[0] == PWLS_VOXEL_MM) >= (1 if s.pwls_everywhere else 2)
    ]
    for done, (exposure, grid, pair) in enumerate(jobs):
        voxel = grid.spacing[0]
        scans = [scanned.clean.with_noise(exposure, seed) for e, seed in _runs(s) if e == exposure]
        if voxel not in problems:
            problems[voxel] = InsetProblem(scanned.clean, grid)

        def inner(fraction: float, done: int = done) -> None:
            progress("PWLS", (done + fraction) / len(jobs))

        volumes = reconstruct(scans, grid, "pwls", problem=problems[voxel], progress=inner)
        m.means[*PWLS, voxel, exposure] = np.array([[float(roi(v.data)) for roi in pair] for v in volumes])
        m.pwls.append(
            {
                "voxel_mm": voxel,
                "exposure_s": exposure,
                "largest_rmsd_hu": max(v.report["rmsd_hu"][-1] for v in volumes),
                "seconds_per_volume": float(np.mean([v.report["seconds"] for v in volumes])),
                **volumes[0].report,
            }
        )
        if exposure == shown:
            m.images[*PWLS, voxel] = volumes[0].data


def _runs(settings: Settings) -> Iterator[tuple[float, int]]:
    """Exposure and seed of every realisation."""
    return itertools.product(settings.doses.values(), range(settings.seed, settings.seed + settings.realizations))
