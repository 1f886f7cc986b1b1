"""Causes of the figures outside their tolerance: what ROIs and a grid that lie a little elsewhere would show.

The paper does not say where its ROIs are, nor where its voxels lie against the plaque. Both ROIs are moved together by
± 0.1 mm in x and y (they stay within their tissues), and the grid by half a voxel along every axis; for each placement
the expectation and the SD of the ROI means are computed without sampling error.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import stats

from recon.analytic.exact_noise import line_integral_variance, roi_adjoints
from recon.analytic.inset import InsetFbp
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.placement import RoiPair
from torchpcct.metrics.roi import RoiMean
from torchpcct.scan import Scan

__all__ = ["SHIFT_MM", "Placements", "vary_placement"]

SHIFT_MM = 0.1

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Placements:
    """Exact ROI means of one FBP for every placement; the nominal one comes first.

    Attributes:
        kernel, voxel_mm: of the FBP.
        means, variances: ``(placements, 2)`` core, fibrous: HU; HU² at 1 s.
    """

    kernel: str
    voxel_mm: float
    means: Floats
    variances: Floats

    def range_of(self, roi: str, quantity: str, exposure_s: float, runs: int | None = None) -> tuple[float, float]:
        """Smallest and largest ``"mean"`` or ``"SD"`` of the ``"core"`` or ``"fibrous"`` ROI over all placements.

        Args:
            roi, quantity: which.
            exposure_s: in s.
            runs: widened to what 95 of 100 experiments of so many noise realisations would show; None: exact figures.
        """
        column = ("core", "fibrous").index(roi)
        means, sds = self.means[:, column], np.sqrt(self.variances[:, column] / exposure_s)
        if quantity == "mean":
            half = 0.0 if runs is None else stats.norm.ppf(0.975) * sds / np.sqrt(runs)
            return float((means - half).min()), float((means + half).max())
        low, high = (1.0, 1.0) if runs is None else np.sqrt(stats.chi2.ppf((0.025, 0.975), runs - 1) / (runs - 1))
        return float(sds.min() * low), float(sds.max() * high)

    def as_dict(self) -> dict[str, Any]:
        """JSON values."""
        return {
            "kernel": self.kernel, "voxel_mm": self.voxel_mm, "placements": len(self.means),
            "means_hu": self.means.tolist(), "variances_hu2_s": self.variances.tolist(),
        }  # fmt: skip


def vary_placement(clean: Scan, grid: VolumeGrid, rois: RoiPair, kernels: Sequence[str]) -> list[Placements]:
    """Move ROIs and grid, one at a time: 9 places of the ROIs on the grid, and the grid's 7 other half-voxel phases.

    Args:
        clean: noise-free scan; a moved grid is one voxel smaller, so that its window holds it.
        grid: of the FBP.
        rois: the two ROIs.
        kernels: of the FBP.

    Returns:
        One entry for every kernel.
    """
    shifts = sorted(itertools.product((0.0, -SHIFT_MM, SHIFT_MM), repeat=2), key=lambda s: s != (0.0, 0.0))
    jobs: list[tuple[VolumeGrid, list[RoiMean]]] = []
    for phase in itertools.product((0.0, 0.5), repeat=3):
        moved = _moved(grid, phase)
        places = shifts if phase == (0.0, 0.0, 0.0) else shifts[:1]
        jobs.append((moved, [roi for dy, dx in places for roi in _shifted(rois, dy, dx).on(moved)]))
    means: list[Floats] = []
    variances: list[Floats] = []
    for moved, functionals in jobs:  # one grid at a time: the adjoints of all would fill the memory
        fbp = InsetFbp(clean, [moved], list(kernels))
        volumes = fbp(clean)[0]
        means.append(np.array([[float(r(v)) for r in functionals] for v in volumes]).reshape(len(volumes), -1, 2))
        found = exact_variances(clean, fbp, [functionals])[0]
        variances.append(found.reshape(len(volumes), -1, 2))
    mean, variance = np.concatenate(means, axis=1), np.concatenate(variances, axis=1)
    return [Placements(k, grid.spacing[0], mean[i], variance[i]) for i, k in enumerate(kernels)]


def exact_variances(clean: Scan, fbp: InsetFbp, rows: Sequence[Sequence[Any]]) -> list[Floats]:
    """Variance at 1 s of functionals after FBP, without their covariances: for every grid ``(kernels, rows)`` HU²."""
    adjoints = roi_adjoints(clean, fbp, rows)
    variance = line_integral_variance(clean.crop(adjoints.window), 1.0)
    return [
        np.array(
            [[float((h * h * variance).sum((-1, -2), dtype=torch.float64).sum()) for h in kernel] for kernel in vectors]
        )
        for vectors in adjoints.vectors
    ]


def _moved(grid: VolumeGrid, phase: Sequence[float]) -> VolumeGrid:
    """The grid moved by parts of a voxel, one voxel smaller along axes that move: it stays within the inset."""
    shape = tuple(n - (p > 0) for n, p in zip(grid.shape, phase, strict=True))
    return VolumeGrid(shape, grid.spacing, grid.center)


def _shifted(rois: RoiPair, dy: float, dx: float) -> RoiPair:
    """Both ROIs moved, their image cut to what they cover (a moved image would reach beyond the grid)."""
    rows, columns = (np.nonzero((rois.foreground | rois.background)[0].any(axis))[0] for axis in (1, 0))
    box = (slice(None), slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
    z, y, x = rois.image.axes
    center = (float(z[0]), float(y[box[1]].mean()) + dy, float(x[box[2]].mean()) + dx)
    foreground, background = rois.foreground[box], rois.background[box]
    return replace(
        rois, foreground=foreground, background=background,
        image=VolumeGrid(foreground.shape, rois.image.spacing, center),
    )  # fmt: skip
