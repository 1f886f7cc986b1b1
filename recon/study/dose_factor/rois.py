"""The dose factor on wider ROIs than the paper's, and the paper's ROIs on other voxels.

How much of a limit and of a gain is the ROI's doing? The limit (generalised least squares with all shapes known) is one
for all ROIs: it is about the two tissues. What FBP and every other method lose against it is not: a small ROI in one
slice throws most of the data away.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from recon.mbir.mbir import average_onto
from recon.study.dose_factor.facts import fbp_label
from recon.study.dose_factor.measure import Measured
from recon.study.dose_factor.measures import crop_window
from recon.study.dose_factor.scene import StudyScene
from recon.study.dose_factor.settings import FBP_BASE, MAIN_SCENES
from recon.study.paper.plaque_scan import inset_grid
from torchpcct.metrics import ContrastSlope, DoseCurve, contrast_slope

__all__ = ["OTHER_VOXELS_MM", "OtherVoxels", "Wide", "sd_at"]

Floats = NDArray[np.float64]

OTHER_VOXELS_MM = (0.25, 0.30, 0.35, 0.40)
"""The paper's voxel sizes beside the methods' own."""


class _CropRois:
    """Means over ROIs of the crops of a method's volumes, and the contrast slope."""

    def __init__(self, measured: Measured, scene: StudyScene, truth: Floats) -> None:
        self.m, self.scene, self.truth = measured, scene, truth

    def means(self, crop: Any, voxel_mm: float) -> Floats:
        """``(..., 2)`` ROI means of crops ``(..., z, y, x)``."""
        raise NotImplementedError

    def samples(self, method: str, dose: float) -> tuple[Floats, ContrastSlope]:
        """ROI means ``(realisations, 2)`` of the paper's scene, and the contrast slope."""
        voxel = self.m.settings.voxel_mm
        means = [self.means(self.m.samples[method, k, dose]["crop"], voxel) for k in MAIN_SCENES]
        contrasts = np.stack([m[:, 1] - m[:, 0] for m in means])
        return means[0], contrast_slope(self.truth, contrasts)

    def _in_crop(self, weights: Floats, voxel_mm: float) -> Floats:
        """``(2, z, y, x)`` weights of whole volumes, cut to the crop that holds them."""
        place = crop_window(inset_grid(self.scene.plaque, voxel_mm), self.scene.core_center)[0]
        inside: Floats = weights[(slice(None), *place)]
        if not np.allclose(inside.sum((1, 2, 3)), weights.sum((1, 2, 3))):
            raise ValueError("the ROI leaves the crop that is kept of every volume: make it smaller")
        return inside


class OtherVoxels(_CropRois):
    """The paper's ROIs on a method's volumes averaged onto larger voxels, as :func:`recon.reconstruct` gives them.

    Args:
        measured: of the study.
        scene: its geometry.
        voxel_mm: of the larger voxels.
        truth: contrasts of the main scenes, HU.
    """

    def __init__(self, measured: Measured, scene: StudyScene, voxel_mm: float, truth: Floats) -> None:
        super().__init__(measured, scene, truth)
        fine, coarse = scene.grid, inset_grid(scene.plaque, voxel_mm)
        volume = torch.zeros(fine.shape, dtype=torch.float64, requires_grad=True)
        # ROI mean and average are linear: their gradient is the weight of every voxel.
        means = [r(average_onto(volume, fine, coarse)) for r in scene.rois.on(coarse)]
        weights = np.stack([torch.autograd.grad(m, volume, retain_graph=True)[0].numpy() for m in means])
        self._weights = self._in_crop(weights, fine.spacing[0])

    def means(self, crop: Any, voxel_mm: float) -> Floats:
        """``(..., 2)`` ROI means of crops of the method's own voxels."""
        result: Floats = np.einsum("...zyx,rzyx->...r", np.asarray(crop, dtype=np.float64), self._weights)
        return result


class Wide(_CropRois):
    """Samples and exact figures of one wider ROI.

    Args:
        measured: of the study.
        scene: its geometry.
        name: of :data:`recon.study.dose_factor.settings.WIDE_ROIS`.
        truth: contrasts of the main scenes, HU.
    """

    def __init__(self, measured: Measured, scene: StudyScene, name: str, truth: Floats) -> None:
        super().__init__(measured, scene, truth)
        self.name = name
        self.rois = scene.wide_rois(name)
        self._weights: dict[float, Floats] = {}
        self._place = 2 * measured.settings.rois.index(name)

    def means(self, crop: Any, voxel_mm: float) -> Floats:
        """``(..., 2)`` ROI means of crops ``(..., z, y, x)``."""
        if voxel_mm not in self._weights:
            pair = self.rois.on(inset_grid(self.scene.plaque, voxel_mm))
            self._weights[voxel_mm] = self._in_crop(np.stack([r.weights.numpy() for r in pair]), voxel_mm)
        result: Floats = np.einsum("...zyx,rzyx->...r", np.asarray(crop, dtype=np.float64), self._weights[voxel_mm])
        return result

    def fbp(self, kernel: str, voxel_mm: float) -> dict[str, Any]:
        """Exact slope, ROI means and covariance at 1 s of an FBP variant."""
        label = fbp_label(kernel, voxel_mm)
        means = np.stack([self.means(self.m.facts[k].fbp_crop[label], voxel_mm) for k in MAIN_SCENES])
        slope = float(np.polyfit(self.truth, means[:, 1] - means[:, 0], 1)[0])
        part = slice(self._place, self._place + 2)
        return {"label": label, "slope": slope, "roi_hu": means[0], "covariance": self.m.wide[label][part, part]}

    def base_curves(self, dose: float) -> dict[str, DoseCurve]:
        """Dose curves of the reference FBP about an exposure."""
        base = self.fbp(*FBP_BASE)
        covariance = base["covariance"] / dose
        return {
            "paper_cnr": DoseCurve.paper_cnr(base["roi_hu"], covariance),
            "contrast_variance": DoseCurve.contrast_variance(covariance, base["slope"]),
        }


def sd_at(covariance: Floats, dose: float) -> float:
    """Standard deviation of the contrast at an exposure, from the covariance at 1 s."""
    return math.sqrt((covariance[0, 0] + covariance[1, 1] - 2 * covariance[0, 1]) / dose)
