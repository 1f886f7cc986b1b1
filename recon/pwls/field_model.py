"""A model of AᵀWA for whole fields of view, of any geometry, made from two exact projection pairs.

    AᵀWA ≈ D F⁻¹ K F D,        D² = AᵀW 1 at each voxel, K the spectrum of the impulse response at the centre

(Fessler and Booth 1999, IEEE Trans. Image Process. 8:688). It is too rough to solve with, because the weights of the
rays change over the field; with the prior's own spectrum beside K it preconditions conjugate gradients on exact pairs,
which need neither its accuracy nor the memory of :class:`recon.gram.gram.Gram`.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from recon.gram.gram import check_weights, information_at_reference
from recon.pwls.model_solver import mean_share
from recon.pwls.qggmrf import BoundPrior

__all__ = ["FieldModel", "GradientStep"]

# Smallest eigenvalue of K, as a share of the median one: between the views' directions it is 0 or, cut off, negative.
LEAST = 0.02
# Voxels that fewer rays meet than this share of those through the middle are not determined by the data.
DETERMINED = 0.75
# Voxels that the rays hardly meet are scaled as if they met this share of what the best seen voxel has.
LEAST_SEEN = 1e-4


class FieldModel:
    """Diagonal and circulant model of x ↦ AᵀW A x.

    Args:
        projector: A, with ``A.T``, ``domain_shape``, ``range_shape`` and ``grid``; nothing else is asked of it.
        weights: W, inverse variances of the line integrals, ``range_shape``, finite and ≥ 0.

    Attributes:
        seen: AᵀW 1, ``domain_shape``: 0 where no ray of positive weight passes.
        determined: bool, ``domain_shape``: voxels that (nearly) all views see. Beyond, in the corners of a grid that is
            wider than the field of view and in slices that some views miss, directions are left to the prior alone.

    Raises:
        ValueError, TypeError: weights as :class:`recon.gram.gram.Gram` refuses them, or a grid that no ray meets.
    """

    def __init__(self, projector: Any, weights: Tensor) -> None:
        check_weights(weights, tuple(projector.range_shape))
        self.grid = projector.grid
        shape = tuple(projector.domain_shape)
        self.seen: Tensor = projector.T(weights)
        if not bool((self.seen > 0).any()):
            raise ValueError("no ray of positive weight meets the grid: check its centre, in mm, and the geometry")
        self.at = _central(self.seen)
        met = projector.T((weights > 0).to(weights.dtype))
        self.determined: Tensor = met >= DETERMINED * met[self.at]
        impulses = torch.zeros(2, *shape, dtype=weights.dtype, device=weights.device)
        impulses[0][self.at] = 1.0
        # The whole column along z: what a wave that is constant along z sees.
        impulses[1][..., self.at[-2], self.at[-1]] = 1.0
        # One after the other: a batch would need twice the memory.
        response, column = (projector.T(weights * projector(v)) for v in impulses)
        self.spectrum = _periodic(response / self.seen[self.at], self.at)
        self._column = column if self.grid.ndim == 3 else column[None]

    def information(self, hu: float, spacing: tuple[float, ...] | None = None) -> float:
        """The data's information at 0.5 lp/mm in the middle of the grid, see :meth:`recon.gram.gram.Gram.information`.

        Args:
            hu: 1 HU in mm⁻¹.
            spacing: as if the voxels had this size in mm; None: their own.
        """
        rolled = torch.roll(self._column, [-k for k in self.at[-2:]], (-2, -1))
        # Slices that the rays do not meet say nothing.
        kept = rolled[rolled[..., 0, 0] > 0]
        return information_at_reference(
            torch.fft.rfft2(kept).real, (rolled.shape[-2], rolled.shape[-1]), spacing or self.grid.spacing, hu
        )

    def scaled(self, factor: float) -> FieldModel:
        """The model of ``factor`` · W."""
        other = object.__new__(FieldModel)
        other.grid, other.at, other.spectrum = self.grid, self.at, self.spectrum
        other.determined = self.determined
        other.seen, other._column = self.seen * factor, self._column * factor
        return other


class GradientStep:
    """Steps of preconditioned conjugate gradients: −(D F⁻¹ (K + η R) F D)⁻¹ times the gradient.

    Args:
        spectrum: K, ``rfftn`` layout of the grid, > 0.
        prior: its curvature at gradient 0 is R.
        x: volumes ``(batch, *shape)``; only their shape, dtype and device matter.
        seen: D², the shape of the grid; None: 1.
    """

    def __init__(self, spectrum: Tensor, prior: BoundPrior, x: Tensor, seen: Tensor | None = None) -> None:
        self.prior = prior
        self._grid = tuple(x.shape[-len(prior.spacing) :])
        self._data = spectrum.to(x)
        self._prior = prior.spectrum(self._grid).to(x)
        self._steps, self._share = 0, 1.0
        self._scale: Tensor | None = None
        if seen is not None:
            bounded = seen.to(x).clamp_min(LEAST_SEEN * float(seen.max()))
            self._scale = bounded.rsqrt()
            self._prior *= float(bounded.reciprocal().mean(dtype=torch.float64))

    @classmethod
    def of(cls, model: FieldModel, prior: BoundPrior, x: Tensor) -> GradientStep:
        """For a whole field."""
        return cls(model.spectrum, prior, x, model.seen)

    def step(self, x: Tensor, data_gradient: Tensor) -> tuple[Tensor, int]:
        """The direction of descent, ``(batch, *shape)``, and 0: no iteration of a model."""
        g = data_gradient + self.prior.gradient(x)
        axes = tuple(range(-len(self._grid), 0))
        g = g if self._scale is None else g * self._scale
        if self._steps & (self._steps - 1) == 0:  # after 0, 1, 2, 4, 8 … steps: by then x hardly changes
            self._share = mean_share(self.prior, x)
        self._steps += 1
        step = torch.fft.irfftn(
            torch.fft.rfftn(g, dim=axes).div_(self._data + self._share * self._prior), s=self._grid, dim=axes
        ).neg_()
        return (step if self._scale is None else step * self._scale), 0


def _central(seen: Tensor) -> tuple[int, ...]:
    """The voxel next to the middle of the grid that at least half the median information of seen voxels reaches."""
    enough = seen >= 0.5 * seen[seen > 0].median()
    distance = torch.zeros((), device=seen.device)
    for axis, n in enumerate(seen.shape):
        along = (torch.arange(n, device=seen.device) - (n - 1) / 2).square()
        distance = distance + along.reshape(-1, *[1] * (seen.dim() - 1 - axis))
    flat = int(torch.where(enough, distance, torch.full_like(distance, math.inf)).argmin())
    place = []
    for n in reversed(seen.shape):
        flat, k = divmod(flat, n)
        place.append(k)
    return tuple(reversed(place))


def _periodic(response: Tensor, at: tuple[int, ...]) -> Tensor:
    """Eigenvalues of the circulant matrix next to the response at ``at`` (T. Chan 1988), ``rfftn`` layout, > 0."""
    for axis, (n, k) in enumerate(zip(response.shape, at, strict=True)):
        lag = (torch.arange(n, device=response.device) - k).abs().to(response)
        response = response * (1 - lag / n).reshape(-1, *[1] * (response.dim() - 1 - axis))
    response = torch.roll(response, [-k for k in at], tuple(range(response.dim())))
    spectrum = torch.fft.rfftn(response).real
    return spectrum.clamp_min(LEAST * float(spectrum.median().clamp_min(1e-6 * float(spectrum.max()))))
