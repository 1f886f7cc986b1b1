"""What FBP makes of the paper's ROIs in a scene of the study, without sampling error."""

from __future__ import annotations

from typing import Any

import numpy as np

from recon.fbp.exact_noise import roi_covariance
from recon.fbp.inset import InsetFbp
from recon.study.dose_factor.settings import FBP_BASE, MAIN_SCENES
from recon.study.dose_factor.variant import Variant
from recon.study.paper.plaque_scan import REFERENCE_KERNEL, REFERENCE_VOXEL_MM
from torchpcct.scan import NOISE_FREE_EXPOSURE_S, Scan

__all__ = ["exact_fbp"]


def exact_fbp(variant: Variant, clean: Scan) -> dict[str, Any]:
    """Arrays of :class:`recon.study.dose_factor.scene.SceneFacts` about FBP.

    Further scenes have ROI means and covariance of the reference FBP; of the main scenes
    :mod:`recon.study.dose_factor.exact_figures` says more.
    """
    fine = variant.grid_of(REFERENCE_VOXEL_MM)
    reference = InsetFbp(clean, [fine], [REFERENCE_KERNEL])(clean)[0][0]
    result = {"reference_hu": np.array([float(r(reference)) for r in variant.rois.on(fine)])}
    if variant.name in MAIN_SCENES:
        return result
    kernel, voxel = FBP_BASE
    grid = variant.grid_of(voxel)
    fbp, pair = InsetFbp(clean, [grid], [kernel]), variant.rois.on(grid)
    volume = fbp(clean)[0][0]
    result["fbp_hu"] = np.array([float(r(volume)) for r in pair])
    result["fbp_covariance"] = np.asarray(roi_covariance(clean, fbp, [pair], NOISE_FREE_EXPOSURE_S)[0][0])
    return result
