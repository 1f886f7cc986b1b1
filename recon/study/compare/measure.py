"""Simulate the plaque's scan, reconstruct every noise realisation by FBP, take the ROI means; then measure methods."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from recon.evaluate.experiment import Evaluation, evaluate
from recon.evaluate.store import Pieces
from recon.evaluate.tasks import read_task
from recon.fbp.exact_noise import roi_covariance
from recon.fbp.inset import InsetFbp
from recon.study.compare.placements import Placements, vary_placement
from recon.study.compare.settings import Settings
from recon.study.paper import facts as paper
from recon.study.paper.plaque_scan import REFERENCE_KERNEL, REFERENCE_VOXEL_MM, PlaqueScan, prepare, roi_entry
from recon.study.paper.tables import table_checks
from recon.study.study import Clock, Progress, silent
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.placement import RoiPair
from torchpcct.scanner import presets
from torchpcct.scene.plaque import plaque_scene

__all__ = ["TASK", "Key", "Measured", "measure"]

TASK = "plaque"
"""Of :mod:`recon.evaluate.tasks`: at which the methods are measured."""

Key = tuple[str, float, float]
"""Kernel, voxel size in mm, exposure in s."""


@dataclass
class Measured:
    """Everything the report needs.

    Attributes:
        rois: the two ROIs; plan: of the simulation.
        noise_free: ROI means of noise-free FBP, the reference image first; then with their exact covariance at 1 s.
        means: setting → ``(realisations, 2)`` ROI means in HU: core, fibrous.
        voxel_noise: setting → SD over the realisations, rms over the inset, HU.
        images: (kernel, voxel size) → first realisation at the tables' dose; ``noise_free_image``: the reference.
        grids: voxel size → grid.
        placements: of the FBPs that have a figure outside its tolerance.
        evaluation: of the methods at :data:`TASK`; None: none was asked for.
        seconds: per step.
    """

    settings: Settings
    rois: RoiPair
    plan: dict[str, Any]
    noise_free: list[dict[str, Any]]
    means: dict[Key, NDArray[np.float64]]
    voxel_noise: dict[Key, float]
    images: dict[tuple[str, float], Any]
    noise_free_image: Any
    grids: dict[float, VolumeGrid]
    placements: list[Placements]
    evaluation: Evaluation | None
    seconds: dict[str, float]


def measure(settings: Settings, progress: Progress = silent, folder: str | Path | None = None) -> Measured:
    """Simulate, reconstruct, measure; see :mod:`recon.study.study`."""
    clock, pieces = Clock(), Pieces(folder, settings)
    scanner = presets.pcct(views=settings.views)
    scanned = prepare(
        settings.kernels, settings.voxels_mm, plaque_scene(), scanner, paper.FULL_VIEWS["PCCT"],
        lambda f: progress("simulate", f), pieces,
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
        images={},
        noise_free_image=reference,
        grids={g.spacing[0]: g for g in [fine, *scanned.grids]},
        placements=[],
        evaluation=None,
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
    for exposure in settings.doses.values():
        draw = partial(_realisations, m, scanned, exposure, expected, progress)
        means, noise, images = pieces(f"realisations/{exposure:g}s", draw)
        m.means.update(means)
        m.voxel_noise.update(noise)
        m.images.update(images)
    clock.lap("noise realisations, FBP")
    if settings.methods:
        task = replace(read_task(TASK), scanner=scanner)
        m.evaluation = evaluate(
            task, settings.methods, exposures_s=settings.method_s, n=settings.method_draws, seed=settings.seed,
            folder=pieces.folder("evaluate"), progress=progress,
        )  # fmt: skip
        clock.lap("methods")
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


Drawn = tuple[dict[Key, NDArray[np.float64]], dict[Key, float], dict[tuple[str, float], Any]]
"""Of one exposure: ``means``, ``voxel_noise`` and ``images`` of :class:`Measured`."""


def _realisations(m: Measured, scanned: PlaqueScan, exposure: float, expected: Any, progress: Progress) -> Drawn:
    """FBP of every noise realisation of an exposure."""
    s = m.settings
    means: dict[Key, list[tuple[float, float]]] = {}
    squares: dict[Key, float] = {}
    images: dict[tuple[str, float], Any] = {}
    before = list(s.doses.values()).index(exposure) * s.realizations
    for k in range(s.realizations):
        scan = scanned.clean.with_noise(exposure, s.seed + k)
        for grid, pair, volumes, truth in zip(scanned.grids, scanned.pairs, scanned.fbp(scan), expected, strict=True):
            voxel = grid.spacing[0]
            for kernel, volume, mean in zip(s.kernels, volumes, truth, strict=True):
                key = (kernel, voxel, exposure)
                # FBP is linear: its expectation is known, and every voxel of every run adds to the variance.
                squares[key] = squares.get(key, 0.0) + float(torch.mean((volume - mean) ** 2)) / s.realizations
                means.setdefault(key, []).append((float(pair[0](volume)), float(pair[1](volume))))
                if k == 0 and exposure == paper.table_exposure(s.doses):
                    images[kernel, voxel] = volume
        progress("noise realisations, FBP", (before + k + 1) / (len(s.doses) * s.realizations))
    return (
        {key: np.array(values) for key, values in means.items()},
        {key: math.sqrt(value) for key, value in squares.items()},
        images,
    )
