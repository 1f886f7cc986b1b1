"""Exact moments of the ROI means, their noise realisations, and a few reconstructions in full."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from recon.analytic.exact_noise import roi_adjoints, roi_covariance
from recon.analytic.inset import InsetFbp
from recon.evaluate.store import Pieces
from recon.study.noise.equal_dose import equal_dose_rows
from recon.study.noise.few_runs import Table, exact_table
from recon.study.noise.placements import Placements, vary_placement
from recon.study.noise.settings import Settings
from recon.study.paper.facts import FULL_VIEWS, TABLE_EXPOSURE_S
from recon.study.paper.plaque_scan import (
    REFERENCE_KERNEL,
    REFERENCE_VOXEL_MM,
    Functional,
    PlaqueScan,
    prepare,
    roi_entry,
)
from recon.study.paper.tables import table_checks
from recon.study.study import Clock, Progress, silent
from torchpcct.geometry import VolumeGrid
from torchpcct.scan import Scan
from torchpcct.scanner import presets
from torchpcct.scene.plaque import plaque_scene

__all__ = ["Measured", "measure"]

_AVERAGED_FROM_MM = 0.30
"""Voxel size from which averaging over the voxel is looked at."""

_BLOCK = 40
"""Realisations of a piece."""
_SQUARES = 4
"""Realisations per dose of which every reading's squared deviation is summed: 10⁶ independent readings pin the variance
of an ROI mean down to some 0.1 %, which a few hundred ROI means do not."""


@dataclass
class Measured:
    """What the report is written from. ``S`` settings: :attr:`recon.study.noise.settings.Settings.axes`.

    Attributes:
        expected: ``(S, 2)`` exact ROI means in HU: core, fibrous.
        covariance: ``(2 S, 2 S)`` HU² at 1 s, exact.
        means: exposure → ``(n, S, 2)`` ROI means of every realisation.
        variances: exposure → ``(2 S,)`` variance of the ROI means from the readings' squared deviations, HU².
        check: what the full reconstructions say.
        reference: noise-free ROI means on the reference image.
        scanned: grids, ROIs and plan.
        images: (kernel, voxel) → volume of one realisation at the tables' dose.
        averaging: (kernel, voxel) → exact SDs at 1 s if a voxel's value were the mean over its volume, HU.
        eid: rows of the comparison with the energy-integrating scan.
        placements: of the settings that have a figure outside its tolerance.
        seconds: per step.
    """

    settings: Settings
    expected: Any
    covariance: Any
    means: dict[float, Any]
    variances: dict[float, Any]
    check: dict[str, Any]
    reference: dict[str, Any]
    scanned: PlaqueScan
    images: dict[tuple[str, float], Any]
    averaging: dict[tuple[str, float], Any]
    eid: list[dict[str, Any]]
    placements: list[Placements]
    seconds: dict[str, float]

    @property
    def axes(self) -> list[tuple[str, float]]:
        """The settings."""
        return self.settings.axes

    def exact(self, exposure_s: float) -> Table:
        """The truth at an exposure."""
        return exact_table(self.expected, self.covariance / exposure_s)

    def block(self, i: int, exposure_s: float) -> Any:
        """``(2, 2)`` HU², the exact covariance of the two ROI means of setting ``i`` at an exposure."""
        return self.covariance[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] / exposure_s

    def variance_ratios(self) -> Any:
        """Variance of the ROI means from the readings' squared deviations over the exact one, ``(doses, 2 S)``."""
        exact = np.diag(self.covariance)
        return np.array([v * exposure / exact for exposure, v in self.variances.items()])

    def slopes(self) -> Any:
        """Slope of log σ against log exposure of every ROI mean, ``(2 S,)``; −½ for counting noise."""
        x = np.log(list(self.variances))
        return np.polyfit(x, 0.5 * np.log(np.array(list(self.variances.values()))), 1)[0]


def measure(settings: Settings, progress: Progress = silent, folder: str | Path | None = None) -> Measured:
    """Simulate, take exact moments, draw realisations, reconstruct a few in full, in resumable pieces."""
    clock, pieces = Clock(), Pieces(folder, settings)
    scene = plaque_scene()
    scanner, full = presets.pcct(views=settings.views), FULL_VIEWS["PCCT"]
    scanned = prepare(settings.kernels, settings.voxels_mm, scene, scanner, full, partial(progress, "simulate"), pieces)
    clean = scanned.clean
    clock.lap("simulate")
    fine = InsetFbp(clean, [scanned.fine], [REFERENCE_KERNEL])(clean)[0][0]
    reference = roi_entry("fbp", REFERENCE_KERNEL, REFERENCE_VOXEL_MM, scanned.rois.on(scanned.fine), fine)
    expected = scanned.roi_means(scanned.fbp(clean))
    clock.lap("noise-free FBP")
    progress("exact noise", 0.0)
    adjoints = roi_adjoints(clean, scanned.fbp, scanned.pairs)
    covariance = adjoints.joint_covariance(clean, 1.0)
    near, matrix = clean.crop(adjoints.window), adjoints.matrix
    del adjoints
    clock.lap("exact noise")
    means, variances = _realisations(settings, near, matrix, expected, pieces, progress)
    clock.lap("noise realisations")
    sd = np.sqrt(np.diag(covariance) / settings.table_exposure_s).reshape(expected.shape)
    full_runs = partial(_reconstructions, settings, scanned, means[settings.table_exposure_s], sd, progress)
    images, check = pieces("full_reconstructions", full_runs)
    clock.lap("full reconstructions")
    averaging = pieces("averaging", partial(_averaging, scanned, settings.kernels))
    clock.lap("averaging voxels")
    eid = equal_dose_rows(settings, scene, expected, covariance, progress) if settings.eid else []
    clock.lap("EID-CT")
    placements = _vary_placements(settings, scanned, expected, covariance, pieces) if settings.placements else []
    clock.lap("ROIs and grids elsewhere")
    return Measured(
        settings, expected, covariance, means, variances, check, reference, scanned, images, averaging, eid,
        placements, clock.seconds,
    )  # fmt: skip


def _vary_placements(
    settings: Settings, scanned: PlaqueScan, expected: Any, covariance: Any, pieces: Pieces
) -> list[Placements]:
    """Move ROIs and grid for every FBP that has a figure of the paper's tables outside its tolerance."""
    outside: dict[float, list[str]] = {}
    for i, (kernel, voxel) in enumerate(settings.axes):
        block = covariance[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] / TABLE_EXPOSURE_S
        if not all(c.ok for c in table_checks(kernel, voxel, (expected[i, 0], expected[i, 1]), block)):
            outside.setdefault(voxel, []).append(kernel)
    grids = {g.spacing[0]: g for g in scanned.grids}
    found: list[Placements] = []
    for voxel, kernels in outside.items():
        vary = partial(vary_placement, scanned.clean, grids[voxel], scanned.rois, kernels)
        found += pieces(f"placements/{voxel:g}mm", vary)
    return found


def _realisations(
    settings: Settings, near: Scan, matrix: Tensor, expected: Any, pieces: Pieces, progress: Progress
) -> tuple[dict[float, Any], dict[float, Any]]:
    """ROI means of every realisation, and their variances from the readings; see :class:`Measured`.

    Args:
        near: the noise-free readings that the ROIs see.
        matrix: adjoint vectors, a row for every ROI mean.
        expected: ``(S, 2)`` exact ROI means.
    """
    quiet = near.line_integrals().flatten()
    means: dict[float, Any] = {}
    variances: dict[float, Any] = {}
    total = len(settings.doses) * settings.realizations
    n = settings.realizations
    for exposure in settings.doses.values():

        def block(first: int, exposure: float = exposure) -> tuple[Any, Any]:
            values, squares = [], np.zeros(matrix.shape[0])
            for i in range(first, min(first + _BLOCK, n)):
                deviation = near.with_noise(exposure, settings.seed + i).line_integrals().flatten() - quiet
                values.append(expected + (matrix @ deviation).double().numpy().reshape(expected.shape))
                if i < _SQUARES:
                    for row, h in enumerate(matrix):
                        squares[row] += float((h * deviation).square().sum(dtype=torch.float64)) / _SQUARES
                progress("noise realisations", (len(means) * n + i + 1) / total)
            return np.array(values), squares

        found = [pieces(f"realisations/{exposure:g}s_{k}", partial(block, k)) for k in range(0, n, _BLOCK)]
        means[exposure] = np.concatenate([values for values, _ in found])
        variances[exposure] = np.sum([squares for _, squares in found], axis=0)
    return means, variances


def _reconstructions(
    settings: Settings, scanned: PlaqueScan, means: Any, sd: Any, progress: Progress
) -> tuple[dict[tuple[str, float], Any], dict[str, Any]]:
    """The first realisation's images at the tables' dose, and how far FBP in full is from ``means`` ``(n, S, 2)``."""
    images: list[Tensor] = []
    differences = []
    for i in range(min(settings.reconstructed, settings.realizations)):
        volumes = scanned.fbp(scanned.clean.with_noise(settings.table_exposure_s, settings.seed + i))
        differences.append(scanned.roi_means(volumes) - means[i])
        images = images or [image for grid in volumes for image in grid]
        progress("full reconstructions", (i + 1) / settings.reconstructed)
    far = np.abs(np.array(differences))
    return dict(zip(settings.axes, images, strict=True)), {
        "reconstructed": len(differences),
        "largest_difference_hu": float(far.max()),
        "largest_difference_in_sd": float((far / sd).max()),
    }


def _averaging(scanned: PlaqueScan, kernels: tuple[str, ...]) -> dict[tuple[str, float], Any]:
    """SDs of the ROI means on large voxels that average over their volume: the mean of 2 × 2 × 2 voxels of half the
    size. FBP samples the filtered image at points; where the voxels are wider than its detail, noise aliases."""
    chosen = [(g, p) for g, p in zip(scanned.grids, scanned.pairs, strict=True) if g.spacing[0] >= _AVERAGED_FROM_MM]
    if not chosen:
        return {}
    halves = [VolumeGrid(tuple(2 * n for n in g.shape), g.spacing[0] / 2, g.center) for g, _ in chosen]
    eighths = torch.full((2, 2, 2), 1 / 8, dtype=torch.float64)
    rois: Any = [[Functional(torch.kron(roi.weights, eighths)) for roi in pair] for _, pair in chosen]
    matrices = roi_covariance(scanned.clean, InsetFbp(scanned.clean, halves, kernels), rois, 1.0)
    return {
        (kernel, grid.spacing[0]): np.sqrt(np.diag(matrix))
        for (grid, _), found in zip(chosen, matrices, strict=True)
        for kernel, matrix in zip(kernels, found, strict=True)
    }
