"""What a reconstruction has left in the data although it is no noise.

A prior takes away what looks like noise to it, and a pattern that it has not learned may look so: fine bars, a weave, a
thread. But the noise of the data is known, so whether the difference between data and volume is noise can be asked. The
step d = (H_c + δ)⁻¹ (β − H u) towards the data is cut into overlapping blocks under a sine window, and each block is
transformed. A coefficient counts as structure if its size is more than :data:`_STRIKING` times what noise has there,
or more than :data:`_BESIDE` times and its neighbour in frequency is such a one (hysteresis, as for edges: Canny 1986,
IEEE Trans. Pattern Anal. Mach. Intell. 8:679). Their sum is what the volume lacks; all else stays noise (hard
thresholds: Donoho, Johnstone 1994, Biometrika 81:425).

Noise alone passes the first threshold in one of 70 million coefficients. A pattern that fills a block is found while it
is far too weak to be seen in a voxel.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional as F

from recon.mbir.problem import NormalisedProblem, filtered, from_frequencies

__all__ = ["significant_residual"]

_BLOCK, _STEP = 16, 4
"""Edge of a block and distance of neighbours in voxels: at 0.2 mm 3.2 mm, some periods of the finest lines."""
_STRIKING, _BESIDE = 4.25, 1.5
"""Thresholds, in root mean squares of a coefficient of noise. Of 24 insets of noise alone at 0.35 s the first one puts
stripes of 16 HU into one. With 4.0 it is 14 of 24 (up to 27 HU); with 3.5, and real coefficients taken for complex
ones, all of 12 had stripes of 30 to 83 HU. A higher one costs patterns that are there: line pairs of 1 mm at 0.35 s /
2 s keep 0.47 / 0.81 of their contrast with 3.5, 0.41 / 0.78 with 4.0, 0.36 / 0.75 with 4.5 (4 draws, before real
coefficients were told apart), 0.18 / 0.59 if nothing is put back, and 0.52 by soft FBP."""
_AXES = (-3, -2, -1)


def significant_residual(problem: NormalisedProblem, spectrum: Tensor, u: Tensor, damping: float) -> Tensor:
    """What ``u`` lacks, ``(batch, z, y, x)``: 0 where nothing but noise is left, and in slices smaller than a block.

    It is linear but for the choice of coefficients.

    Args:
        problem: normalised problem.
        spectrum: of H, :meth:`recon.mbir.problem.NormalisedProblem.spectrum`.
        u: the reconstruction, ``(batch, z, y, x)``.
        damping: δ of the step towards the data.
    """
    shape = u.shape[-3:]
    if min(shape[-2:]) < _BLOCK:
        return torch.zeros_like(u)
    inverse = 1.0 / (spectrum + damping)
    step = filtered(problem.beta - problem.apply(u), inverse)
    correlation = from_frequencies(spectrum * inverse.square(), shape)
    # Slices of a stack that is thinner than a block are looked at one by one.
    edges = [_BLOCK if n >= _BLOCK else 1 for n in shape]
    along = [torch.sin(math.pi * (torch.arange(e) + 0.5) / e).to(u) for e in edges]
    window = along[0][:, None, None] * along[1][:, None] * along[2]
    noise = _noise(correlation, window)
    return torch.stack([_significant(v, window, n) for v, n in zip(step, noise, strict=True)])


def _significant(step: Tensor, window: Tensor, noise: Tensor) -> Tensor:
    """The structure in one volume ``(z, y, x)``, given the mean square of noise of a block's coefficients."""
    edges = window.shape
    hops = [_STEP if e > 1 else 1 for e in edges]
    # Every voxel lies in as many blocks as the window's squares need to add up to a constant.
    before, after = [], []
    for e, hop, n in zip(edges, hops, step.shape, strict=True):
        extra = (e - n) % hop
        before.append(e - hop + extra // 2)
        after.append(e - hop + extra - extra // 2)
    padded = F.pad(step, [p for pair in zip(before[::-1], after[::-1], strict=True) for p in pair])
    out = torch.zeros_like(padded)
    for z in range(0, padded.shape[0] - edges[0] + 1, hops[0]):
        for y in range(0, padded.shape[1] - edges[1] + 1, hops[1]):
            row = padded[z : z + edges[0], y : y + edges[1]]
            found = torch.fft.rfftn(row.unfold(-1, edges[2], hops[2]).movedim(-2, 0) * window, dim=_AXES)
            real, imaginary = torch.view_as_real(found.detach()).unbind(-1)
            power = (real.square() + imaginary.square()) / noise
            # Few blocks have any.
            for k in torch.nonzero(power.flatten(1).amax(1) > _STRIKING**2).flatten().tolist():
                x = k * hops[2]
                block = torch.fft.irfftn(found[k] * _structure(power[k]), s=edges, dim=_AXES) * window
                out[z : z + edges[0], y : y + edges[1], x : x + edges[2]] += block
    times = math.prod(e / (2 * hop) if e > 1 else 1.0 for e, hop in zip(edges, hops, strict=True))
    inside = tuple(slice(b, b + n) for b, n in zip(before, step.shape, strict=True))
    return out[inside] / times


def _structure(power: Tensor) -> Tensor:
    """Which coefficients ``(z, y, x // 2 + 1)`` of a block count, given their squares over those of noise."""
    striking = (power > _STRIKING**2).to(power)
    # Frequencies are periodic, and those that rfftn leaves out are mirror images.
    mirrored = striking.flip((-3, -2)).roll((1, 1), (-3, -2))
    around = torch.cat([mirrored[..., 1:2], striking, mirrored[..., -2:-1]], -1)
    around = torch.cat([around[..., -1:, :], around, around[..., :1, :]], -2)
    around = torch.cat([around[..., -1:, :, :], around, around[..., :1, :, :]], -3)
    beside = F.max_pool3d(around[None], 3, 1)[0] > 0
    return beside & (power > _BESIDE**2)


def _noise(correlation: Tensor, window: Tensor) -> Tensor:
    """Mean square of the coefficients of windowed noise, ``(batch, z, y, x // 2 + 1)``.

    Args:
        correlation: of the noise, ``(batch, z, y, x)``, lag 0 first, periodic.
        window: of a block.
    """
    edges = window.shape
    both = tuple(2 * e for e in edges)
    overlap = from_frequencies(torch.fft.rfftn(window, s=both).abs().square(), both)
    lags = [torch.arange(1 - e, e) for e in edges]
    at = [lag % n for lag, n in zip(lags, correlation.shape[-3:], strict=True)]
    product = correlation[:, at[0][:, None, None], at[1][:, None], at[2]]
    product = product * overlap[lags[0][:, None, None], lags[1][:, None], lags[2]]
    for axis, (e, lag) in enumerate(zip(edges, lags, strict=True)):
        # The product is even under inversion, so the transform is real; along one axis it is not.
        phase = torch.exp(-2j * math.pi / e * torch.outer(torch.arange(e), lag)).to(product.device)
        product = torch.movedim(torch.tensordot(product.to(phase.dtype), phase, ([axis + 1], [1])), -1, axis + 1)
    noise = product.real[..., : edges[2] // 2 + 1].clamp_min(torch.finfo(correlation.dtype).tiny)
    # A coefficient that is its own mirror image is real, and reaches a threshold as often as a complex one reaches that
    # over √2: it counts as half of its square.
    own = [2 * torch.arange(e) % e == 0 for e in edges]
    real = own[0][:, None, None] & own[1][:, None] & own[2][: edges[2] // 2 + 1]
    return torch.where(real.to(noise.device), 2.0 * noise, noise)
