"""The FBP that dose factors refer to, soft kernel on 0.25 mm, without sampling error: expectations, noise, slope."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.fbp.exact_noise import line_integral_variance, roi_adjoints, roi_covariance
from recon.fbp.inset import InsetFbp
from recon.study.compare.regions import Regions
from recon.study.paper.plaque_scan import Functional, inset_grid
from torchpcct.scan import Scan

__all__ = ["KERNEL", "VOXEL_MM", "Reference", "exact_reference", "exact_variances"]

KERNEL, VOXEL_MM = "soft", 0.25

Floats = NDArray[np.float64]

_FAT_VOXELS = 8
"""Single voxels of plain fat whose variance is averaged; it varies by a few per cent over the inset."""


@dataclass(frozen=True, eq=False)
class Reference:
    """Exact figures of the reference FBP.

    Attributes:
        means, absent: ``(rois,)`` expectations in HU with and without the core.
        covariance: ``(rois, rois)`` HU² at 1 s; it falls as the inverse of the exposure.
        fat_variance: of a voxel of plain fat at 1 s, HU²; fat_spread: largest deviation of a voxel's from it, relative.
    """

    means: Floats
    absent: Floats
    covariance: Floats
    fat_variance: float
    fat_spread: float


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


def exact_reference(clean: Scan, absent: Scan, regions: Regions) -> Reference:
    """Figures of the reference FBP.

    Args:
        clean, absent: noise-free scans with and without the core, of one window.
        regions: what is read.
    """
    grid = inset_grid(regions.plaque, VOXEL_MM)
    fbp = InsetFbp(clean, [grid], [KERNEL])
    rois = regions.on(grid)

    def read(volume: Tensor) -> Floats:
        return np.array([float(r(volume)) for r in rois])

    means, without = (read(fbp(scan)[0][0]) for scan in (clean, absent))
    covariance = np.asarray(roi_covariance(clean, fbp, [rois], 1.0)[0][0])
    single = [Functional(torch.from_numpy(w)) for w in regions.fat_voxels(grid, _FAT_VOXELS)]
    fat = exact_variances(clean, fbp, [single])[0][0]
    return Reference(means, without, covariance, float(fat.mean()), float(np.abs(fat / fat.mean() - 1.0).max()))
