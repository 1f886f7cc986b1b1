"""The exact covariance of ROI means after FBP: one adjoint pass per ROI, no Monte Carlo.

FBP is linear, so an ROI mean is one inner product h·y of the line integrals with h = filterᵀ backprojectionᵀ w. The
readings are independent, so Cov(h₁·y, h₂·y) = Σ_i h₁ᵢ h₂ᵢ Var(yᵢ) with Var(yᵢ) = slope² / expected counts (delta
method, slope of the water correction). It holds for any number of photons at which the logarithm is nearly linear.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon._filtering import FilterPlan
from recon.angular_weights import angular_weights
from recon.backproject import BackprojectionPlan
from recon.inset import InsetFbp
from torchpcct.metrics.roi import RoiMean
from torchpcct.scan import NOISE_FREE_EXPOSURE_S, Scan
from torchpcct.window import DetectorWindow

__all__ = ["line_integral_variance", "roi_covariance"]

_MARGIN = 32
"""Columns on either side of the shadow whose noise is counted. The filter's tail falls as 1 / n², its square as
1 / n⁴: what lies beyond adds less than 1e-4 to the variance of an ROI mean."""


def line_integral_variance(clean: Scan, exposure_s: float) -> Tensor:
    """Variance of the water-linearised line integrals of a noise-free scan at an exposure, shape of ``clean.counts``.

    Raises:
        ValueError: the scan is noisy (its expectations are needed), or ``exposure_s`` ≤ 0.
    """
    if not clean.noise_free:
        raise ValueError("the variance follows from expected readings: give the noise-free scan")
    if not exposure_s > 0:
        raise ValueError(f"exposure_s must be greater than 0 s, got {exposure_s}")
    p = clean.counts.log().neg_().add_(clean._at_window(clean.air.log()))
    slope = clean.linearisation.slope(p, clean.window)
    return slope.square_().div_(clean.counts).mul_(NOISE_FREE_EXPOSURE_S / exposure_s)


def roi_covariance(
    clean: Scan, fbp: InsetFbp, rois: Sequence[Sequence[RoiMean]], exposure_s: float
) -> list[NDArray[np.float64]]:
    """Covariance of ROI means in HU² for every grid and kernel of ``fbp``.

    Args:
        clean: noise-free windowed scan.
        fbp: its grids and kernels.
        rois: for every grid of ``fbp``, the ROIs on that grid.
        exposure_s: exposure; the covariance falls as its inverse.

    Returns:
        for every grid ``(kernels, rois, rois)``.

    Raises:
        ValueError: a scan that is noisy or not windowed.
    """
    if clean.window is None:
        raise ValueError("roi_covariance needs a windowed scan: acquire it with region=")
    near = _trim(fbp.shadow, clean.window)
    variance = clean.window.crop(line_integral_variance(clean, exposure_s), near)
    weights = angular_weights(fbp.geometry)
    scale = 1000.0 / clean.linearisation.mu_ref
    results = []
    for grid, grid_rois in zip(fbp.grids, rois, strict=True):
        spread = BackprojectionPlan(fbp.geometry, grid, fbp.shadow).transpose
        traces = spread(torch.stack([r.weights for r in grid_rois]).to(variance.dtype))
        matrices = []
        for kernel in fbp.kernels:
            plan = FilterPlan(fbp.geometry, (kernel,), weights, near, fbp.shadow)
            h: list[Any] = [plan.transpose(t[None]).mul_(scale) for t in traces]
            matrices.append([[_weighted_dot(a, b, variance) for b in h] for a in h])
        results.append(np.array(matrices))
    return results


def _trim(inner: DetectorWindow, outer: DetectorWindow) -> DetectorWindow:
    """``inner`` widened by the margin, inside ``outer``."""
    width = min(inner.columns + 2 * _MARGIN, outer.columns)
    last = outer.first_column + outer.columns - width
    first = np.clip(inner.first_column - _MARGIN, outer.first_column, last)
    return DetectorWindow(first, width, outer.first_row, outer.rows)


def _weighted_dot(a: Tensor, b: Tensor, weight: Tensor) -> float:
    # Summed view by view in float64: 25 million terms of one sign would lose digits in float32.
    return float((a * b * weight).sum((-1, -2), dtype=torch.float64).sum())
