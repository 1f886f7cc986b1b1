"""Smoothing along vessels: the direction in which a volume does not change, found at the vessels' strong outlines.

A vessel's lumen and the fat around it stand out hundreds of HU at any dose of interest, so the direction t(x) of a
vessel is known long before the tissue in its wall can be told apart. Along t little changes, whatever the wall is made
of; averaging along it lowers the noise of small regions next to a strong edge, where every isotropic prior lets go. The
penalty is

    S(u) = ½ μ Σ_x w(x) |t(x)·∇u(x)|²,

with t the eigenvector of the smallest eigenvalue λ₃ of the structure tensor ⟨∇ũ ∇ũᵀ⟩ of a pilot volume ũ (Bigün,
Granlund 1987; Weickert 1998, "Anisotropic Diffusion in Image Processing", coherence-enhancing diffusion) and the
coherence w = (λ₂ − λ₃) / (λ₂ + λ₃) of tube-like surroundings: 1 in a tube, 0 at a plane or in noise. The pilot is fixed
by the data, so S is quadratic in u: it keeps the energy an energy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from recon.linear_operator import gaussian_kernel, separable_filter

__all__ = ["VesselSmoothing"]

PILOT_SD_MM = 0.3
"""Standard deviation of the Gaussian that the pilot's gradient is taken with."""
WINDOW_SD_MM = 1.2
"""Standard deviation of the Gaussian window of the structure tensor: about the radius of a coronary artery."""
COARSE = 4
"""The structure tensor is so smooth that one in 4 × 4 × 4 voxels is enough."""
_AXES = (-3, -2, -1)
# Components of a symmetric tensor.
_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
_INDEX = ((0, 3, 4), (3, 1, 5), (4, 5, 2))


@dataclass(frozen=True)
class VesselSmoothing:
    """The penalty S of a batch of volumes.

    Args:
        tensor: ``(batch, 6, z, y, x)`` components zz, yy, xx, zy, zx, yx of w t tᵀ.
        strength: ``(batch,)`` μ, per voxel² (differences are between neighbours, not per mm).
    """

    tensor: Tensor
    strength: Tensor

    @classmethod
    def of(cls, pilot: Tensor, voxel_mm: float, strength: Tensor) -> VesselSmoothing:
        """S with the directions of pilot volumes ``(batch, z, y, x)``, which are taken as fixed."""
        return cls(_directions(pilot.detach(), voxel_mm), strength)

    def _flux(self, g: list[Tensor]) -> list[Tensor]:
        t = self.tensor
        return [sum((t[:, _INDEX[i][j]] * g[j] for j in range(3)), torch.zeros_like(g[0])) for i in range(3)]

    def gradient(self, u: Tensor) -> Tensor:
        """∇S(u), ``(batch, z, y, x)``."""
        total = torch.zeros_like(u)
        # Forward and backward differences in turn, half each: neither side of a voxel is preferred.
        for shift in (0, 1):
            flux = self._flux([_difference(u, a, shift) for a in _AXES])
            for a, h in zip(_AXES, flux, strict=True):
                total = total + _transposed(h, a, shift)
        return total * (0.5 * self.strength.reshape(-1, 1, 1, 1))

    def energy(self, u: Tensor) -> Tensor:
        """S(u), ``(batch,)`` float64."""
        return 0.5 * (u * self.gradient(u)).sum(dim=(1, 2, 3), dtype=torch.float64)

    def spectrum(self) -> Tensor:
        """Eigenvalues on the frequencies of ``rfftn`` if the whole volume were like its most coherent part."""
        z, y, x = self.tensor.shape[-3:]
        turns = (torch.fft.fftfreq(z)[:, None, None], torch.fft.fftfreq(y)[:, None], torch.fft.rfftfreq(x))
        angles = [2 * math.pi * t.to(self.tensor) for t in turns]
        coherence = self.tensor[:, :3].sum(1)
        peak = coherence.amax((1, 2, 3)) / coherence.mean((1, 2, 3)).clamp_min(1e-6)
        mean = self.tensor.mean((2, 3, 4)) * (peak * self.strength)[:, None]
        total = torch.zeros_like(mean[0, 0])
        for k, (i, j) in enumerate(_PAIRS):
            # Products of sines for what mixes two axes, as central differences have them.
            wave = 2 - 2 * torch.cos(angles[i]) if i == j else 2 * torch.sin(angles[i]) * torch.sin(angles[j])
            total = total + mean[:, k].reshape(-1, 1, 1, 1) * wave
        return total.clamp_min(0.0)

    def bound(self) -> Tensor:
        """Upper bound of the largest eigenvalue of S, ``(batch,)``: w ≤ 1 and three differences of norm 2 each."""
        return 12.0 * self.strength


def _directions(pilot: Tensor, voxel_mm: float) -> Tensor:
    """Components of w t tᵀ, ``(batch, 6, z, y, x)``."""
    smooth = _gaussian(pilot, PILOT_SD_MM / voxel_mm)
    g = [torch.gradient(smooth, dim=a)[0] for a in _AXES]
    # NaN would stop the eigenvalue solver; the volume itself carries it on.
    products = torch.stack([torch.nan_to_num(g[i] * g[j], posinf=0.0, neginf=0.0) for i, j in _PAIRS], 1)
    step = min(COARSE, *pilot.shape[-3:])
    coarse = F.avg_pool3d(products, step, ceil_mode=True, count_include_pad=False)
    coarse = _gaussian(coarse.flatten(0, 1), WINDOW_SD_MM / (voxel_mm * step)).reshape(coarse.shape)
    matrix = coarse.movedim(1, -1)[..., torch.tensor(_INDEX)]
    # Its scale does not matter, and eigh of numbers near the smallest float may fail.
    size = matrix.diagonal(dim1=-2, dim2=-1).sum(-1).clamp_min(torch.finfo(matrix.dtype).tiny)
    values, vectors = torch.linalg.eigh((matrix / size[..., None, None]).double())
    coherence = ((values[..., 1] - values[..., 0]) / (values[..., 1] + values[..., 0]).clamp_min(1e-12)).clamp(0, 1)
    t = vectors[..., 0]
    field = torch.stack([coherence * t[..., i] * t[..., j] for i, j in _PAIRS], 1).to(pilot)
    field = F.interpolate(field, scale_factor=float(step), mode="trilinear", align_corners=False)
    z, y, x = pilot.shape[-3:]
    return field[..., :z, :y, :x].contiguous()


def _pad(axis: int, before: int, after: int) -> list[int]:
    out = [0] * 6
    out[2 * (-1 - axis)], out[2 * (-1 - axis) + 1] = before, after
    return out


def _difference(u: Tensor, axis: int, shift: int) -> Tensor:
    """Differences of neighbours, at the voxel before (``shift`` 0) or after; 0 at the end without a neighbour."""
    return F.pad(torch.diff(u, dim=axis), _pad(axis, shift, 1 - shift))


def _transposed(h: Tensor, axis: int, shift: int) -> Tensor:
    """Transpose of :func:`_difference`."""
    inner = h.narrow(axis, shift, h.shape[axis] - 1)
    return F.pad(inner, _pad(axis, 1, 0)) - F.pad(inner, _pad(axis, 0, 1))


def _gaussian(v: Tensor, sd: float) -> Tensor:
    """Gaussian filter of ``(batch, z, y, x)``, edges repeated; ``sd`` in voxels."""
    kernel = gaussian_kernel(sd, math.ceil(3 * sd), v)
    return separable_filter(v, kernel / kernel.sum(), "replicate")
