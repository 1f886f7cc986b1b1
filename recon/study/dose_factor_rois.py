"""The dose factor on wider ROIs than the paper's: how much of a limit and of a gain is the ROI's doing.

The limit (generalised least squares with all shapes known) is one for all ROIs: it is about the two tissues. What FBP
and every other method lose against it is not: a small ROI in one slice throws most of the data away.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.study.compare import inset_grid
from recon.study.dose_factor import Measured
from recon.study.dose_factor_scene import FBP_BASE, MAIN_SCENES, StudyScene, crop_window, fbp_label
from torchpcct.metrics import ContrastSlope, DoseCurve, contrast_slope

__all__ = ["Wide"]

Floats = NDArray[np.float64]


class Wide:
    """Samples and exact figures of one wider ROI.

    Args:
        measured: of the study.
        scene: its geometry.
        name: of :data:`recon.study.dose_factor_scene.WIDE_ROIS`.
        truth: contrasts of the main scenes, HU.
    """

    def __init__(self, measured: Measured, scene: StudyScene, name: str, truth: Floats) -> None:
        self.m, self.name, self.truth = measured, name, truth
        self.scene = scene
        self.rois = scene.wide_rois(name)
        self._weights: dict[float, Floats] = {}
        self._place = 2 * measured.settings.rois.index(name)

    def means(self, crop: Any, voxel_mm: float) -> Floats:
        """``(..., 2)`` ROI means of crops ``(..., z, y, x)``."""
        if voxel_mm not in self._weights:
            grid = inset_grid(self.scene.plaque, voxel_mm)
            place = crop_window(grid, self.scene.core_center)[0]
            weights = np.stack([r.weights.numpy() for r in self.rois.on(grid)])
            inside = weights[(slice(None), *place)]
            if not np.allclose(inside.sum((1, 2, 3)), 1.0):
                raise ValueError(f"the ROI {self.name!r} leaves the crop that is kept: make it smaller")
            self._weights[voxel_mm] = inside
        result: Floats = np.einsum("...zyx,rzyx->...r", np.asarray(crop, dtype=np.float64), self._weights[voxel_mm])
        return result

    def fbp(self, kernel: str, voxel_mm: float) -> dict[str, Any]:
        """Exact slope, ROI means and covariance at 1 s of an FBP variant."""
        label = fbp_label(kernel, voxel_mm)
        means = np.stack([self.means(self.m.facts[k].fbp_crop[label], voxel_mm) for k in MAIN_SCENES])
        slope = float(np.polyfit(self.truth, means[:, 1] - means[:, 0], 1)[0])
        part = slice(self._place, self._place + 2)
        return {"label": label, "slope": slope, "roi_hu": means[0], "covariance": self.m.wide[label][part, part]}

    def base_curves(self) -> dict[str, DoseCurve]:
        """Dose curves of the reference FBP."""
        base = self.fbp(*FBP_BASE)
        return {
            "paper_cnr": DoseCurve.paper_cnr(base["roi_hu"], base["covariance"]),
            "contrast_variance": DoseCurve.contrast_variance(base["covariance"], base["slope"]),
        }

    def samples(self, method: str, dose: float) -> tuple[Floats, ContrastSlope]:
        """ROI means ``(realisations, 2)`` of the paper's scene, and the contrast slope."""
        voxel = self.m.settings.voxel_mm
        means = [self.means(self.m.samples[method, k, dose]["crop"], voxel) for k in MAIN_SCENES]
        contrasts = np.stack([m[:, 1] - m[:, 0] for m in means])
        return means[0], contrast_slope(self.truth, contrasts)


def sd_at(covariance: Floats, dose: float) -> float:
    """Standard deviation of the contrast at an exposure, from the covariance at 1 s."""
    return math.sqrt((covariance[0, 0] + covariance[1, 1] - 2 * covariance[0, 1]) / dose)
