"""The dose factor on wider ROIs than the paper's, and the paper's ROIs on larger voxels.

How much of a limit and of a gain is the ROI's doing? The limit (generalised least squares with all shapes known) is one
for all ROIs: it is about the two tissues. What FBP and every other method lose against it is not: a small ROI in one
slice throws most of the data away.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from recon.mbir.mbir import average_onto
from recon.study.dose_factor.estimates import contrast_figures, estimate, factor, slope_of
from recon.study.dose_factor.exact import Exact, contrast_sd
from recon.study.dose_factor.measures import crop_window
from recon.study.dose_factor.settings import FBP_BASE, MAIN_SCENES, fbp_label
from recon.study.dose_factor.variant import Variant
from torchpcct.metrics import ContrastSlope, DoseCurve, roi_bias

__all__ = ["CropRois", "averaged_rois", "other_voxels", "wide_entry", "wide_rois"]

Floats = NDArray[np.float64]

OTHER_VOXELS_MM = (0.25, 0.30, 0.35, 0.40)
"""The paper's voxel sizes beside the methods' own."""


class CropRois:
    """Means in two ROIs of the crops that are kept of volumes.

    Args:
        variant: where the crop is.
        weights: voxel size in mm → ``(2, z, y, x)`` weights of whole volumes.
    """

    def __init__(self, variant: Variant, weights: Callable[[float], Floats]) -> None:
        self.variant, self._whole = variant, weights

    @cache  # noqa: B019 - lives for one report
    def _weights(self, voxel_mm: float) -> Floats:
        whole = self._whole(voxel_mm)
        inside: Floats = whole[(slice(None), *crop_window(self.variant.grid_of(voxel_mm), self.variant.core_center)[0])]
        if not np.allclose(inside.sum((1, 2, 3)), whole.sum((1, 2, 3))):
            raise ValueError("the ROI leaves the crop that is kept of every volume: make it smaller")
        return inside

    def means(self, crop: Any, voxel_mm: float) -> Floats:
        """``(..., 2)`` ROI means of crops ``(..., z, y, x)``."""
        result: Floats = np.einsum("...zyx,rzyx->...r", np.asarray(crop, dtype=np.float64), self._weights(voxel_mm))
        return result

    def samples(self, exact: Exact, method: str, dose: float) -> tuple[Floats, ContrastSlope]:
        """ROI means ``(realisations, 2)`` of a method in the paper's scene, and its contrast slope."""
        crops = [exact.m.samples[method, scene, dose]["crop"] for scene in MAIN_SCENES]
        means = [self.means(crop, exact.s.voxel_mm) for crop in crops]
        return means[0], slope_of(exact.truth, means)


def wide_rois(variant: Variant, name: str) -> CropRois:
    """The wider ROIs of a name."""
    pair = variant.wide_rois(name)
    return CropRois(variant, lambda voxel: np.stack([r.weights.numpy() for r in pair.on(variant.grid_of(voxel))]))


def averaged_rois(variant: Variant, coarse_mm: float) -> CropRois:
    """The paper's ROIs on volumes averaged onto voxels of ``coarse_mm``, as :func:`recon.reconstruct` gives them."""

    def weights(voxel_mm: float) -> Floats:
        fine, coarse = variant.grid_of(voxel_mm), variant.grid_of(coarse_mm)
        volume = torch.zeros(fine.shape, dtype=torch.float64, requires_grad=True)
        # ROI mean and average are linear: their gradient is the weight of every voxel.
        means = [r(average_onto(volume, fine, coarse)) for r in variant.rois.on(coarse)]
        return np.stack([torch.autograd.grad(m, volume, retain_graph=True)[0].numpy() for m in means])

    return CropRois(variant, weights)


def wide_entry(exact: Exact, name: str) -> dict[str, Any]:
    """Figures of every FBP variant and method in a wider ROI, at every dose."""
    rois = wide_rois(exact.variant, name)
    first = 2 * exact.s.rois.index(name)
    part = slice(first, first + 2)
    fbp = {}
    for kernel, voxel, _ in exact.variants:
        label = fbp_label(kernel, voxel)
        means = np.stack([rois.means(exact.facts[k].fbp_crop[label], voxel) for k in MAIN_SCENES])
        slope = float(np.polyfit(exact.truth, means[:, 1] - means[:, 0], 1)[0])
        fbp[label] = (means[0], slope, exact.m.wide[label][part, part])
    rows: list[dict[str, Any]] = []
    for dose in exact.s.doses:
        limits = exact.limits(dose)
        for label, (roi_hu, slope, covariance) in fbp.items():
            sd, c = contrast_sd(covariance, dose), covariance / dose
            own = float(roi_hu[1] - roi_hu[0]) / math.sqrt(c[0, 0] + c[1, 1])
            rows.append({
                "method": f"FBP {label}", "exposure_s": dose, "exact": True, "slope": {"value": slope},
                "contrast_sd_hu": {"value": sd / slope}, "paper_cnr": {"value": own},
                "efficiency": {"value": (limits["contrast_sd_hu"] * slope / sd) ** 2},
                "limit_factors": {
                    "paper_cnr": (limits["paper_cnr"] / own) ** 2,
                    "contrast_variance": (sd / slope / limits["contrast_sd_hu"]) ** 2,
                },
            })  # fmt: skip
        base_hu, base_slope, covariance = fbp[fbp_label(*FBP_BASE)]
        of_cnr = DoseCurve.paper_cnr(base_hu, covariance / dose)
        of_variance = DoseCurve.contrast_variance(covariance / dose, base_slope)
        for method in exact.m.methods:
            roi, own_slope = rois.samples(exact, method, dose)
            rows.append({
                "method": method, "exposure_s": dose, "exact": False, "realizations": len(roi),
                **contrast_figures(roi, own_slope, limits["contrast_sd_hu"]),
                "factors": {
                    "paper_cnr": factor(roi, of_cnr, "paper_cnr"),
                    "contrast_variance": factor(roi, of_variance, "contrast_variance", own_slope),
                },
            })  # fmt: skip
    return {"roi": name, **exact.variant.wide_rois(name).as_dict(), "rows": rows}


def other_voxels(exact: Exact) -> list[dict[str, Any]]:
    """MBIR's figures in the paper's ROIs on its own and on larger voxels."""
    if "mbir" not in exact.m.methods:
        return []
    rows = []
    for voxel in (exact.s.voxel_mm, *(v for v in OTHER_VOXELS_MM if v > exact.s.voxel_mm)):
        rois = averaged_rois(exact.variant, voxel)
        for dose in exact.s.doses:
            roi, slope = rois.samples(exact, "mbir", dose)
            rows.append({
                "voxel_mm": voxel, "exposure_s": dose,
                **contrast_figures(roi, slope, exact.limits(dose)["contrast_sd_hu"]),
                "bias_hu": [estimate(e) for e in roi_bias(roi, exact.paper.truth_hu)],
            })  # fmt: skip
    return rows
