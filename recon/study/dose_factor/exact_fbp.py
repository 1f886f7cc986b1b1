"""What FBP makes of a scene of the study without sampling error: images, ROI means, covariances."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from torch import Tensor

from recon.fbp.exact_noise import roi_covariance
from recon.fbp.inset import InsetFbp
from recon.study.dose_factor.measures import OBSERVERS, crop_window, observer_channels
from recon.study.dose_factor.settings import FBP_BASE, MAIN_SCENES, fbp_label
from recon.study.dose_factor.variant import Variant
from recon.study.paper.plaque_scan import REFERENCE_KERNEL, REFERENCE_VOXEL_MM, Functional
from torchpcct.geometry import VolumeGrid
from torchpcct.scan import NOISE_FREE_EXPOSURE_S, Scan

__all__ = ["exact_fbp"]

Floats = NDArray[np.float64]


def exact_fbp(variant: Variant, clean: Scan) -> dict[str, Any]:
    """Arrays of :class:`recon.study.dose_factor.scene.SceneFacts` about FBP.

    The paper's scene has all variants with ROI means and observer channels; the main scenes carry its noise and need
    images only; further scenes the reference and the noise of its ROI means.
    """
    s, full, main = variant.settings, variant.name == "paper", variant.name in MAIN_SCENES
    fine = variant.grid_of(REFERENCE_VOXEL_MM)
    reference = InsetFbp(clean, [fine], [REFERENCE_KERNEL])(clean)[0][0]
    fbp = InsetFbp(
        clean,
        [variant.grid_of(v) for v in (s.voxels_mm if main else FBP_BASE[1:])],
        s.kernels if main else FBP_BASE[:1],
    )
    result = {"reference_hu": np.array([float(r(reference)) for r in variant.rois.on(fine)])}
    result |= _images(variant, fbp, clean)
    if full or not main:
        result |= _covariances(clean, fbp, [_functionals(variant, grid, channels=full) for grid in fbp.grids])
    if full and s.blurs_mm:
        result |= _blurred_covariances(variant, clean)
    return result


def _images(variant: Variant, fbp: InsetFbp, clean: Scan) -> dict[str, Any]:
    """ROI means and crops of every FBP variant."""
    labels, means, crops = [], [], {}
    for grid, volumes in zip(fbp.grids, fbp(clean), strict=True):
        pair, crop = variant.rois.on(grid), crop_window(grid, variant.core_center)[0]
        for kernel, volume in zip(fbp.kernels, volumes, strict=True):
            base = (kernel, grid.spacing[0]) == FBP_BASE
            for blur in (0.0, *(variant.settings.blurs_mm if base else ())):
                image = _blurred(volume, grid, blur)
                labels.append(fbp_label(kernel, grid.spacing[0], blur))
                means.append([float(r(image)) for r in pair])
                crops[f"crop {labels[-1]}"] = image[crop].numpy()
    return {"labels": np.array(labels), "fbp_hu": np.array(means), **crops}


def _covariances(clean: Scan, fbp: InsetFbp, functionals: Sequence[Sequence[Any]]) -> dict[str, Any]:
    found = roi_covariance(clean, fbp, cast(Any, functionals), NOISE_FREE_EXPOSURE_S)
    return {
        f"covariance {fbp_label(kernel, grid.spacing[0])}": matrix
        for grid, matrices in zip(fbp.grids, found, strict=True)
        for kernel, matrix in zip(fbp.kernels, matrices, strict=True)
    }


def _blurred_covariances(variant: Variant, clean: Scan) -> dict[str, Any]:
    """Of the reference FBP behind each Gaussian filter, all in one pass."""
    blurs, grid = variant.settings.blurs_mm, variant.grid_of(FBP_BASE[1])
    fbp = InsetFbp(clean, [grid], FBP_BASE[:1])
    rows = [Functional(_blurred(r.weights, grid, b)) for b in blurs for r in variant.rois.on(grid)]
    matrix = roi_covariance(clean, fbp, cast(Any, [rows]), NOISE_FREE_EXPOSURE_S)[0][0]
    return {
        f"covariance {fbp_label(*FBP_BASE, blur)}": matrix[2 * k : 2 * k + 2, 2 * k : 2 * k + 2]
        for k, blur in enumerate(blurs)
    }


def _functionals(variant: Variant, grid: VolumeGrid, channels: bool) -> list[Any]:
    """The two ROI means and, if asked for, the observers' channels."""
    rows: list[Any] = list(variant.rois.on(grid))
    place = crop_window(grid, variant.core_center)[0]
    for observer in OBSERVERS if channels else ():
        for channel in observer_channels(variant, grid, observer):
            weights = torch.zeros(grid.shape, dtype=torch.float64)
            weights[place] = torch.from_numpy(channel)
            rows.append(Functional(weights))
    return rows


def _blurred(volume: Tensor, grid: VolumeGrid, blur_mm: float) -> Tensor:
    """Gaussian filter of σ = ``blur_mm``, zero outside: its own transpose."""
    if not blur_mm:
        return volume
    sigma = [blur_mm / s for s in grid.spacing]
    return torch.from_numpy(gaussian_filter(volume.numpy(), sigma, mode="constant", truncate=5.0))
