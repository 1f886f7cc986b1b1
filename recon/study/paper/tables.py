"""The paper's tables beside ours: where an entry is, and what is accepted of it."""

from __future__ import annotations

from typing import Any

import numpy as np

from recon.study.checks import Check
from recon.study.paper import facts as paper
from torchpcct.metrics.cnr import cnr_range

__all__ = ["published", "table_checks"]


def published(table: Any, kernel: str, voxel_mm: float, exposure_s: float) -> Any:
    """The entry of one of the paper's tables for FBP at this setting, or None."""
    if exposure_s != paper.TABLE_EXPOSURE_S or kernel not in paper.KERNELS or voxel_mm not in paper.VOXELS_MM:
        return None
    return table[paper.KERNELS.index(kernel)][paper.VOXELS_MM.index(voxel_mm)]


def table_checks(
    kernel: str, voxel_mm: float, means_hu: tuple[float, float], covariance_hu2: Any, note: str = ""
) -> list[Check]:
    """The paper's tables against the exact expectation and covariance of the same ROI means: no sampling error.

    Args:
        kernel, voxel_mm: of FBP.
        means_hu: expectation of the core's and the fibrous ROI.
        covariance_hu2: ``(2, 2)`` of the two ROI means at the tables' exposure.
        note: added to a check that is not met.

    Returns:
        Means ± 10 HU, SDs within a factor of 1.5, and the paper's CNR inside the range that 95 of 100 experiments with
        10 realisations of our scan would give; nothing where the paper has no entry.
    """
    checks = []
    covariance = np.asarray(covariance_hu2, dtype=np.float64)
    name = f"{kernel} {voxel_mm:.2f} mm"
    for i, (roi, table) in enumerate((("core", paper.FOREGROUND), ("fibrous", paper.BACKGROUND))):
        entry = published(table, kernel, voxel_mm, paper.TABLE_EXPOSURE_S)
        if entry is None:
            return []
        mean, sd = (float(v) for v in entry)
        checks.append(Check(f"{roi} mean, {name}, HU", means_hu[i], mean, mean - 10, mean + 10))
        checks.append(Check(f"{roi} SD, {name}, HU", float(np.sqrt(covariance[i, i])), sd, sd / 1.5, sd * 1.5))
    cnr = float(published(paper.CNR, kernel, voxel_mm, paper.TABLE_EXPOSURE_S))
    low, high = cnr_range(means_hu, covariance, paper.REALIZATIONS)
    checks.append(Check(f"the paper's CNR, {name}, in the range of our 10-run estimates", cnr, cnr, low, high))
    return [c.explained(note) for c in checks]
