"""Simulate the plaque's scan, reconstruct every noise realisation by FBP, PWLS and MBIR, take the ROI means."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from recon import reconstruct
from recon.evaluate.store import Pieces
from recon.fbp.exact_noise import roi_covariance
from recon.fbp.inset import InsetFbp
from recon.mbir.mbir import Mbir
from recon.pwls.inset_problem import InsetProblem
from recon.study.compare.draws import Draws, reconstruct_draws
from recon.study.compare.placements import Placements, vary_placement
from recon.study.compare.reference import Reference, exact_reference
from recon.study.compare.regions import Regions
from recon.study.compare.settings import Settings
from recon.study.dose_factor.response import linear_response
from recon.study.paper import facts as paper
from recon.study.paper.plaque_scan import (
    REFERENCE_KERNEL,
    REFERENCE_VOXEL_MM,
    PlaqueScan,
    duty,
    enclosing,
    inset_grid,
    prepare,
    roi_entry,
)
from recon.study.paper.rods import RodValues, rod_values
from recon.study.paper.tables import table_checks
from recon.study.study import Clock, Progress, silent
from torchpcct.acquisition.acquire import acquire
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.placement import RoiPair
from torchpcct.scan import Scan
from torchpcct.scanner import presets
from torchpcct.scene.plaque import plaque_scene, plaque_variant

__all__ = ["MBIR", "PWLS", "Key", "Measured", "measure"]

PWLS = ("pwls", "q-GGMRF")
"""Method and "kernel" of PWLS in the tables."""
MBIR = ("mbir", "learned")
"""Method and "kernel" of MBIR in the tables."""

PWLS_VOXEL_MM = 0.25
"""Voxel size of PWLS: the paper's best for FBP."""

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
        pwls: how PWLS converged, for every dose.
        draws: exposure → MBIR with and without the core, beside its control.
        reference: exact figures of the FBP that dose factors refer to; rods: true values of core and fibrous tissue;
            both None without MBIR.
        placements: of the FBPs that have a figure outside its tolerance.
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
    draws: dict[float, Draws]
    reference: Reference | None
    rods: RodValues | None
    placements: list[Placements]
    seconds: dict[str, float]


def measure(settings: Settings, progress: Progress = silent, folder: str | Path | None = None) -> Measured:
    """Simulate, reconstruct, measure; see :mod:`recon.study.study`."""
    clock, pieces = Clock(), Pieces(folder, settings)
    scene = plaque_scene()
    scanned = prepare(
        settings.kernels, settings.voxels_mm, scene, presets.pcct(views=settings.views),
        paper.FULL_VIEWS["PCCT"], lambda f: progress("simulate", f), pieces,
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
        draws={},
        reference=None,
        rods=None,
        placements=[],
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
    if settings.placements:
        _vary_placements(m, scanned, pieces, progress)
        clock.lap("ROIs and grids elsewhere")
    mbir = _MbirRun(m, scanned, Regions(*scene, scanned.rois), pieces, clock, progress) if settings.mbir else None
    pwls = InsetProblem(clean, inset_grid(scene[1], PWLS_VOXEL_MM)) if settings.pwls else None
    clock.lap("PWLS")
    for exposure in settings.doses.values():
        scans: list[Scan] = []
        draw = partial(_realisations, m, scanned, exposure, expected, mbir, scans, clock, progress)
        means, noise, images, noisy = pieces(f"realisations/{exposure:g}s", draw)
        m.means.update(means)
        m.voxel_noise.update(noise)
        m.images.update(images)
        if pwls is not None and exposure in settings.pwls_s:
            _run_pwls(m, scanned, pwls, exposure, scans, pieces, progress)
            clock.lap("PWLS")
        if mbir is not None and settings.mbir_draws(exposure):
            mbir(exposure, noisy)
    return m


def _vary_placements(m: Measured, scanned: PlaqueScan, pieces: Pieces, progress: Progress) -> None:
    """Move ROIs and grid for every FBP that has a figure of the paper's tables outside its tolerance."""
    outside: dict[float, list[str]] = {}
    for e in m.noise_free[1:]:
        covariance = np.array(e["covariance_hu2_s"]) / paper.TABLE_EXPOSURE_S
        means = (e["foreground_hu"], e["background_hu"])
        if not all(c.ok for c in table_checks(e["kernel"], e["voxel_mm"], means, covariance)):
            outside.setdefault(e["voxel_mm"], []).append(e["kernel"])
    for done, (voxel, kernels) in enumerate(outside.items()):
        progress("ROIs and grids elsewhere", done / len(outside))
        vary = partial(vary_placement, scanned.clean, m.grids[voxel], scanned.rois, kernels)
        m.placements += pieces(f"placements/{voxel:g}mm", vary)


Drawn = tuple[dict[Key, NDArray[np.float64]], dict[Key, float], dict[tuple[str, str, float], Any], Any]
"""Of one exposure: ``means``, ``voxel_noise`` and ``images`` of :class:`Measured`; b of every realisation, or None."""


def _realisations(
    m: Measured,
    scanned: PlaqueScan,
    exposure: float,
    expected: Any,
    mbir: _MbirRun | None,
    kept: list[Scan],
    clock: Clock,
    progress: Progress,
) -> Drawn:
    """FBP of every noise realisation of an exposure, and its b for MBIR; what PWLS needs is added to ``kept``."""
    s = m.settings
    means: dict[Key, list[tuple[float, float]]] = {}
    squares: dict[Key, float] = {}
    images: dict[tuple[str, str, float], Any] = {}
    noisy: list[torch.Tensor] = []
    before = list(s.doses.values()).index(exposure) * s.realizations
    draws = s.mbir_draws(exposure) if mbir is not None else 0
    for k in range(max(s.realizations, draws)):
        scan = scanned.clean.with_noise(exposure, s.seed + k)
        clock.lap("noise")
        if mbir is not None and k < draws:
            noisy.append(mbir.problem.statistic(scan).b)
            clock.lap("MBIR")
        if k >= s.realizations:
            continue
        for grid, pair, volumes, truth in zip(scanned.grids, scanned.pairs, scanned.fbp(scan), expected, strict=True):
            voxel = grid.spacing[0]
            for kernel, volume, mean in zip(s.kernels, volumes, truth, strict=True):
                key = ("fbp", kernel, voxel, exposure)
                # FBP is linear: its expectation is known, and every voxel of every run adds to the variance.
                squares[key] = squares.get(key, 0.0) + float(torch.mean((volume - mean) ** 2)) / s.realizations
                means.setdefault(key, []).append((float(pair[0](volume)), float(pair[1](volume))))
                if k == 0 and exposure == paper.table_exposure(s.doses):
                    images["fbp", kernel, voxel] = volume
        clock.lap("FBP")
        if s.pwls and exposure in s.pwls_s:
            kept.append(scan)
        progress("noise realisations, FBP", (before + k + 1) / (len(s.doses) * s.realizations))
    return (
        {key: np.array(values) for key, values in means.items()},
        {key: math.sqrt(value) for key, value in squares.items()},
        images,
        torch.stack(noisy) if noisy else None,
    )


def _run_pwls(
    m: Measured,
    scanned: PlaqueScan,
    problem: InsetProblem,
    exposure: float,
    scans: Sequence[Scan],
    pieces: Pieces,
    progress: Progress,
) -> None:
    s, grid = m.settings, problem.grid
    pair = scanned.rois.on(grid)

    def compute() -> tuple[NDArray[np.float64], dict[str, Any], torch.Tensor]:
        # A run that found the FBP of these realisations finished has not drawn them.
        drawn = scans or [scanned.clean.with_noise(exposure, s.seed + k) for k in range(s.realizations)]
        volumes = reconstruct(drawn, grid, "pwls", problem=problem, progress=lambda f: progress("PWLS", f))
        about = {
            "voxel_mm": PWLS_VOXEL_MM,
            "exposure_s": exposure,
            "largest_rmsd_hu": max(v.report["rmsd_hu"][-1] for v in volumes),
            "seconds_per_volume": float(np.mean([v.report["seconds"] for v in volumes])),
            **volumes[0].report,
        }
        return np.array([[float(roi(v.data)) for roi in pair] for v in volumes]), about, volumes[0].data

    means, about, first = pieces(f"pwls/{exposure:g}s", compute)
    m.means[*PWLS, PWLS_VOXEL_MM, exposure] = means
    m.pwls.append(about)
    if exposure == paper.table_exposure(s.doses):
        m.grids[PWLS_VOXEL_MM] = grid
        m.images[*PWLS, PWLS_VOXEL_MM] = first


class _MbirRun:
    """MBIR of every realisation with and without the core, on the voxels of its network.

    Args:
        m: where results go; the exact figures of FBP and the true values are found here.
        scanned: the plaque's scan.
        regions: what is read.
        pieces, clock, progress: of the study.
    """

    def __init__(
        self, m: Measured, scanned: PlaqueScan, regions: Regions, pieces: Pieces, clock: Clock, progress: Progress
    ) -> None:
        self.m, self.clean, self.regions, self.clock, self.progress = m, scanned.clean, regions, clock, progress
        self.pieces = pieces
        scanner = presets.pcct(views=m.settings.views)
        without_core = plaque_variant("paper", core_contrast=0.0)[0]
        simulate = partial(
            acquire, without_core, scanner, region=enclosing([*scanned.grids, scanned.fine]),
            duty=duty(scanner, paper.FULL_VIEWS["PCCT"]), progress=lambda f: progress("simulate without core", f),
        )  # fmt: skip
        absent = pieces("scan_absent", simulate)
        clock.lap("simulate")
        progress("exact noise of FBP", 0.0)
        m.reference = pieces("reference", partial(exact_reference, self.clean, absent, regions))
        clock.lap("exact noise of FBP")
        tissues = {b.name: b.material for b in regions.scene.bodies if b.name in ("core", "fibrous")}
        m.rods = rod_values(regions.scene, scanner, regions.plaque.position, tissues=tissues)
        clock.lap("true values")
        self.network = Mbir.load()
        self.grid = inset_grid(regions.plaque, self.network.voxel_mm)
        self.problem = InsetProblem(self.clean, self.grid)
        self.rois, self.fat = regions.on(self.grid), regions.fat(self.grid)
        self.weights = torch.stack([r.weights for r in self.rois])
        self.statistic = self.problem.statistic(self.clean).b
        self.change = self.problem.statistic(absent).b - self.statistic
        clock.lap("MBIR")

    def __call__(self, exposure: float, noisy: torch.Tensor) -> None:
        """Reconstruct the draws of one exposure, from their b ``(n, z, y, x)``."""
        m, clean = self.m, self.statistic * exposure

        def compute() -> Draws:
            control = None
            if m.settings.control:
                self.progress("control of MBIR", 0.0)
                control = linear_response(
                    self.network,
                    self.problem,
                    self.weights,
                    clean,
                    exposure,
                    self.clean,
                    m.settings.response_draws,
                )
                self.clock.lap("control of MBIR")
            return reconstruct_draws(
                self.network, self.problem, self.rois, self.fat, noisy, self.change * exposure, exposure, control,
                lambda f: self.progress("MBIR", f),
            )  # fmt: skip

        draws = self.pieces(f"mbir/{exposure:g}s", compute)
        self.clock.lap("MBIR")
        m.draws[exposure] = draws
        voxel = self.grid.spacing[0]
        m.means[*MBIR, voxel, exposure] = draws.means[: m.settings.realizations, :2]
        if exposure == paper.table_exposure(m.settings.doses):
            m.grids[voxel] = self.grid
            m.images[*MBIR, voxel] = draws.images[0]
            m.images["mbir absent", MBIR[1], voxel] = draws.images[1]
