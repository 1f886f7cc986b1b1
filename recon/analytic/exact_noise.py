"""The exact covariance of ROI means after FBP, and the ROI means of noisy scans without
reconstructing them.

FBP is linear, so an ROI mean is one inner product h·y of the line integrals with h = filterᵀ
backprojectionᵀ w: one adjoint pass per ROI. The readings are independent, so Cov(h₁·y, h₂·y) = Σ_i
h₁ᵢ h₂ᵢ Var(yᵢ) with Var(yᵢ) = slope² · Var(reading) / reading² (delta method, slope of the water
correction; :meth:`torchpcct.scan.Scan.relative_variance` for counts and for energy-integrating
signals). It holds for any number of photons at which the logarithm is nearly linear. The same h
gives the ROI means of any realisation: a scan costs one pass over the few readings that the ROI
sees instead of a reconstruction per kernel and voxel size.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.analytic.filter_plan import FilterPlan
from recon.analytic.inset import InsetFbp
from torchpcct.detector_window import DetectorWindow
from torchpcct.metrics.roi import RoiMean
from torchpcct.scan import Scan
from torchpcct.validate import checked

__all__ = [
    "RoiAdjoints",
    "functional_covariance",
    "line_integral_variance",
    "roi_adjoints",
    "roi_covariance",
    "voxel_covariance",
]

FILTER_MARGIN_COLUMNS = 32
"""Columns on either side of the footprint whose noise is counted. The filter's tail falls as 1 /
n², its square as 1 / n⁴: what lies beyond adds less than 1e-4 to the variance of an ROI mean."""


class HasWeights(Protocol):
    """A linear functional of a volume, such as :class:`torchpcct.metrics.roi.RoiMean`."""

    @property
    def weights(self) -> Tensor:
        """Of its voxels, the shape of its grid."""
        ...


class Functional(NamedTuple):
    """The sum of a volume with any weights."""

    weights: Tensor


@checked
def line_integral_variance(clean: Scan, exposure_s: float) -> Tensor:
    """Variance of the water-linearised line integrals of a noise-free scan at an exposure, shape of
    ``clean.counts``.

    Raises:
        ValueError: the scan is noisy (its expectations are needed); ``exposure_s`` ≤ 0; an
            energy-integrating scan that does not hold the energy of its quanta.
    """
    variance = clean.relative_variance(exposure_s)
    p = clean.counts.log().neg_().add_(clean._at_window(clean.air.log()))
    slope = clean.linearisation.slope(p, clean.window)
    return slope.square_().mul_(variance)


@dataclass(frozen=True, eq=False)
class RoiAdjoints:
    """ROI means of FBP as inner products with the line integrals.

    Attributes:
        window: the readings that the ROIs see.
        vectors: for every grid ``(kernels, rois, views, rows, columns)`` on ``window``: h in HU,
            float32.
    """

    window: DetectorWindow
    vectors: list[Tensor]

    @property
    def matrix(self) -> Tensor:
        """All vectors as rows, ``(grids · kernels · rois, readings)``: the grid varies slowest,
        the ROI fastest."""
        return torch.cat([v.flatten(0, 1).flatten(1) for v in self.vectors])

    def joint_covariance(self, clean: Scan, exposure_s: float) -> NDArray[np.float64]:
        """Covariance in HU² of all ROI means with each other, ``(M, M)``, ordered as the rows of
        :attr:`matrix`.

        Args:
            clean: the noise-free windowed scan.
            exposure_s: exposure in s.

        Raises:
            ValueError: a scan that is noisy or not windowed, or whose window does not hold the
                ROIs' readings.
        """
        return self.covariance_of(line_integral_variance(clean.crop(self.window), exposure_s))

    def covariance_of(self, variance: Tensor) -> NDArray[np.float64]:
        """The same from the variances of the line integrals on ``window``, ``(views, rows,
        columns)``."""
        rows = self.matrix.view(-1, variance.shape[0], variance[0].numel())
        total = np.zeros((rows.shape[0], rows.shape[0]))
        for view in range(rows.shape[1]):  # one view in float64 at a time: no copy of all vectors
            h = rows[:, view].double()
            total += ((h * variance[view].double().reshape(-1)) @ h.T).numpy()
        return total


@checked
def roi_adjoints(clean: Scan, fbp: InsetFbp, rois: Sequence[Sequence[RoiMean]]) -> RoiAdjoints:
    """The adjoint vectors of ROI means.

    Args:
        clean: a windowed scan of the family (its readings do not matter).
        fbp: its grids and kernels.
        rois: for every grid of ``fbp``, the ROIs on that grid.

    Raises:
        ValueError: a scan that is not windowed.
    """
    traces = [_traces(fbp, i, r, clean) for i, r in zip(range(len(fbp.grids)), rois, strict=True)]
    first = min(start for start, _ in traces)
    rows = max(start + trace.shape[-2] for start, trace in traces) - first
    window = _near(fbp, clean, first, rows)
    vectors = []
    for start, trace in traces:
        padded = torch.zeros((*trace.shape[:2], rows, trace.shape[-1]), dtype=trace.dtype)
        padded[:, :, start - first : start - first + trace.shape[-2]] = trace
        vectors.append(
            torch.stack(list(_filtered(fbp, padded, window, 1000.0 / fbp.linearisation.mu_ref)))
        )
    return RoiAdjoints(window, vectors)


@checked
def roi_covariance(
    clean: Scan, fbp: InsetFbp, rois: Sequence[Sequence[HasWeights]], exposure_s: float
) -> list[NDArray[np.float64]]:
    """Covariance of ROI means in HU² for every grid and kernel of ``fbp``.

    Args:
        clean: noise-free windowed scan.
        fbp: its grids and kernels.
        rois: for every grid of ``fbp``, the ROIs on that grid.
        exposure_s: exposure; the covariance falls as its inverse (but for the share of electronic
            noise).

    Returns:
        for every grid ``(kernels, rois, rois)``.

    Raises:
        ValueError: a scan that is noisy or not windowed.
    """
    results = []
    # The vectors of many ROIs are large: one kernel at a time.
    for i, grid_rois in zip(range(len(fbp.grids)), rois, strict=True):
        first, trace = _traces(fbp, i, grid_rois, clean)
        window = _near(fbp, clean, first, trace.shape[-2])
        variance = line_integral_variance(clean.crop(window), exposure_s)
        vectors = _filtered(fbp, trace, window, 1000.0 / fbp.linearisation.mu_ref)
        results.append(np.array([_gram(h, variance) for h in vectors]))
    return results


@checked
def functional_covariance(
    fbp: InsetFbp, functionals: Tensor, ray_covariance: Tensor
) -> NDArray[np.float64]:
    """Exact covariance of linear functionals of two channels: one adjoint pass per functional, no
    Monte Carlo.

    FBP is linear and rays are independent, so with h the adjoint of a functional's weights the
    covariance between channel c of functional i and channel d of functional j is Σ_rays h_i h_j
    C_cd.

    Args:
        fbp: of one grid with one kernel.
        functionals: ``(functionals, *grid.shape)`` weights on the volume: one voxel, an ROI mean.
        ray_covariance: ``(3, views, rows, columns)`` C₁₁, C₁₂, C₂₂ on the window, as
            :func:`torchpcct.spectral.cramer_rao` gives it.

    Returns:
        ``(functionals, functionals, 3)`` float64.

    Raises:
        ValueError: wrong shapes, a scan that is not windowed.
    """
    w, (grid,) = fbp.window, fbp.grids
    if w is None:
        raise ValueError("the noise of functionals needs a windowed scan: acquire it with region=")
    if tuple(ray_covariance.shape) != (3, w.views, w.rows, w.columns):
        raise ValueError(
            f"ray_covariance must have the shape {(3, w.views, w.rows, w.columns)}, got "
            f"{tuple(ray_covariance.shape)}"
        )
    if tuple(functionals.shape[1:]) != grid.shape:
        raise ValueError(
            f"functionals must have the shape (n, *{grid.shape}), got {tuple(functionals.shape)}"
        )
    traces = fbp.plan.backprojections[0].transpose(functionals.to(ray_covariance.dtype))
    seen = w.with_rows(fbp.footprint.first_row, fbp.footprint.rows)
    (h,) = _filtered(fbp, traces, seen, 1.0)
    return np.stack([_gram(h, c) for c in w.crop(ray_covariance, seen)], axis=-1)


@checked
def voxel_covariance(clean: Scan, fbp: InsetFbp, exposure_s: float, voxel: Sequence[int]) -> Tensor:
    """Exact covariance in HU² of one voxel with all voxels: one adjoint pass and one
    reconstruction.

    Args:
        clean: noise-free windowed scan.
        fbp: of one grid with one kernel.
        exposure_s: of the noise; covariances fall as its inverse.
        voxel: ``(z, y, x)`` index.

    Returns:
        ``grid.shape``, float32.

    Raises:
        ValueError: several grids or kernels, a scan that is noisy or not windowed.
    """
    if len(fbp.grids) != 1 or len(fbp.kernels) != 1 or clean.window is None:
        raise ValueError(
            "the covariance of a voxel needs FBP of one grid with one kernel, and a windowed scan"
        )
    window = clean.window
    variance = line_integral_variance(clean, exposure_s).to(torch.float32)
    hu = 1000.0 / fbp.linearisation.mu_ref

    def reconstruct(lines: Tensor) -> Tensor:
        return fbp.plan.backprojected(fbp.plan.filtered(lines, held=window))[0][0] * hu

    leaf = torch.zeros_like(variance, requires_grad=True)
    with torch.enable_grad():
        (h,) = torch.autograd.grad(reconstruct(leaf)[tuple(voxel)], leaf)
    with torch.no_grad():
        return reconstruct(h * variance)


def _traces(
    fbp: InsetFbp, grid: int, rois: Sequence[HasWeights], clean: Scan
) -> tuple[int, Tensor]:
    """Transposed backprojection of ROI weights on one of the grids: first detector row, ``(rois,
    views, rows, columns)`` of those seen.

    Filtering stays within a row, so the rows that no ROI sees are left out."""
    if clean.window is None or fbp.window is None:
        raise ValueError("the noise of ROI means needs a windowed scan: acquire it with region=")
    weights = torch.stack([r.weights for r in rois])
    traces = fbp.moving.backprojections[grid].transpose(weights.to(clean.counts.dtype))
    seen = (traces != 0).sum((0, 1, 3)).nonzero()
    first, last = int(seen.min()), int(seen.max())
    return fbp.footprint.first_row + first, traces[:, :, first : last + 1].contiguous()


def _near(fbp: InsetFbp, clean: Scan, first_row: int, rows: int) -> DetectorWindow:
    """Where the filtered traces are not negligible."""
    assert clean.window is not None
    near = fbp.footprint.widened(FILTER_MARGIN_COLUMNS, clean.window)
    return near.with_rows(first_row, rows)


def _filtered(
    fbp: InsetFbp, traces: Tensor, window: DetectorWindow, scale: float
) -> Iterator[Tensor]:
    """``scale`` times the adjoint vectors of every kernel, ``(rois, views, rows, columns)`` on
    ``window``."""
    traced = fbp.footprint.with_rows(window.first_row, window.rows)
    weights = fbp.plan.weights
    for kernel in fbp.kernels:
        plan = FilterPlan(fbp.geometry, (kernel,), weights, window, traced)
        yield torch.stack([plan.transpose(t[None]).mul_(scale) for t in traces])


def _gram(vectors: Tensor, variance: Tensor) -> list[list[float]]:
    return [[_weighted_dot(a, b, variance) for b in vectors] for a in vectors]


def _weighted_dot(a: Tensor, b: Tensor, weight: Tensor) -> float:
    # Summed view by view in float64: 25 million terms of one sign would lose digits in float32.
    return float((a * b * weight).sum((-1, -2), dtype=torch.float64).sum())
