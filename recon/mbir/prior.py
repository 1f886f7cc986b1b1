"""The learned prior: a small 3-D field of experts on several scales, an energy with a gradient in closed form.

    R(u) = Σ_levels Σ_units Σ_positions ψ_n(ρ_n),      ρ = C ⋆ ‖h_g‖²,      h = W_l ⋆ pool_l(u),
    ψ_n(ρ) = ½ Σ_j a_nj τ_j² ln(1 + ρ/τ_j²)

plus a quadratic term ½ Σ_f Q(f) |û(f)|² that holds down what the filters do not see (the highest frequencies).

The volume u is in units of its own noise (see :mod:`recon.mbir.unrolled`), so one set of weights serves every dose:
what the noise level adds is only a slow change of the a_gj. The potentials are of the Lorentzian (Geman-McClure,
Student-t) family: below τ_j they smooth, far above they let go, so a large contrast is not shrunk (Roth, Black 2009,
Int. J. Comput. Vis. 82:205, fields of experts; Chen, Pock 2017, IEEE TPAMI 39:1256, as unrolled steps). Filters come in
groups whose joint magnitude is penalised, as the three derivatives are in isotropic total variation.

Filters act on 2 × 2 × 2 blocks of voxels with a 3 × 3 × 3 neighbourhood of blocks, 6³ voxels in all; each level halves
the resolution with the orthonormal Haar average. Outside the grid u is 0, the background.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

__all__ = [
    "LearnedPrior",
    "PriorConfig",
    "filtered",
    "from_frequencies",
    "squared_frequencies",
    "to_frequencies",
]

REFERENCE_SCALE_HU = 200.0
"""Noise scale (:class:`recon.mbir.unrolled.NormalisedProblem`) at which the conditioning variable is 0: about 1 s."""


@dataclass(frozen=True)
class PriorConfig:
    """Size of the prior.

    Args:
        levels: resolutions, each half of the one before.
        filters: filters of each level, a multiple of ``group``.
        group: filters whose joint magnitude counts.
        units: potentials of each level; each sees a learned, non-negative mixture of all groups' squared magnitudes
            over a 3 × 3 × 3 neighbourhood.
        thresholds: τ_j, in units of the noise scale.
        voxel_mm: size of the cubic voxels that the filters are for.
    """

    levels: int = 3
    filters: int = 24
    group: int = 3
    units: int = 12
    thresholds: tuple[float, ...] = (0.1, 0.3, 1.0, 3.0, 10.0)
    voxel_mm: float = 0.2

    def __post_init__(self) -> None:
        for name in ("levels", "filters", "group", "units"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"{name} must be an integer of at least 1, got {value!r}")
        if self.filters % self.group:
            raise ValueError(f"filters ({self.filters}) must be a multiple of group ({self.group})")
        object.__setattr__(self, "thresholds", tuple(float(t) for t in self.thresholds))
        if not self.voxel_mm > 0:
            raise ValueError(f"voxel_mm must be greater than 0, got {self.voxel_mm!r}")
        if not self.thresholds or min(self.thresholds) <= 0:
            raise ValueError(f"thresholds must be positive, got {self.thresholds}")


class LearnedPrior(nn.Module):
    """R(u) and ∇R(u) of volumes ``(batch, z, y, x)`` in noise units.

    Args:
        config: size.
    """

    def __init__(self, config: PriorConfig | None = None) -> None:
        super().__init__()
        self.config = c = config or PriorConfig()
        start = _differences(c.filters)
        self.filters = nn.ParameterList(nn.Parameter(start.clone()) for _ in range(c.levels))
        groups = c.filters // c.group
        # A mild start, at which the first steps neither blur everything nor do nothing.
        self.gain = nn.Parameter(torch.full((c.levels, c.units, len(c.thresholds)), -2.5))
        # A prior that is fixed in HU grows with the square of the noise scale in noise units: start near that.
        self.gain_slope = nn.Parameter(torch.full((c.levels, c.units, len(c.thresholds)), 1.5))
        self.smooth = nn.Parameter(torch.tensor([0.05, 0.3]).log())
        self.smooth_slope = nn.Parameter(torch.tensor([1.0, 1.0]))
        self.along = nn.Parameter(torch.tensor([math.log(2.0), 0.0]))
        mixtures = torch.full((c.units, groups, 3, 3, 3), -5.0)
        for n in range(c.units):  # each unit starts with one group of its own
            mixtures[n, n % groups, 1, 1, 1] = 0.0
        self.mixtures = nn.ParameterList(nn.Parameter(mixtures.clone()) for _ in range(c.levels))
        self._squares = tuple(t * t for t in c.thresholds)

    def _kernels(self, level: int) -> Tensor:
        """Zero-mean filters of unit norm ``(filters, 8, 3, 3, 3)``: a constant costs nothing."""
        w = self.filters[level]
        w = w - w.mean(dim=(1, 2, 3, 4), keepdim=True)
        return w / w.flatten(1).norm(dim=1).clamp_min(1e-6).reshape(-1, 1, 1, 1, 1)

    def _mixture(self, level: int) -> Tensor:
        """C ``(units, groups, 3, 3, 3)``, ≥ 0, of unit sum per unit."""
        c = self.mixtures[level].exp()
        return c / c.sum(dim=(1, 2, 3, 4), keepdim=True)

    def amplitudes(self, scale_hu: Tensor) -> Tensor:
        """a_nj at a noise scale: ``(batch, levels, units, thresholds)``, ≥ 0."""
        x = torch.log(scale_hu / REFERENCE_SCALE_HU).clamp(-3.0, 3.0).reshape(-1, 1, 1, 1)
        return F.softplus(self.gain + x * self.gain_slope)

    def _weights_at_zero(self, scale_hu: Tensor) -> Tensor:
        """Largest weights of the groups, those of a flat volume: ``(batch, levels, groups)``."""
        a = self.amplitudes(scale_hu).sum(-1)
        mixed = torch.stack([self._mixture(level).sum(dim=(2, 3, 4)) for level in range(self.config.levels)])
        return torch.einsum("bln,lng->blg", a, mixed)

    def quadratic(self, shape: tuple[int, ...], voxel_mm: float, scale_hu: Tensor) -> Tensor:
        """Q on the frequencies of ``rfftn``: a part ∝ f² and one ∝ f⁴ (f in line pairs per mm)."""
        f2 = squared_frequencies(shape, voxel_mm).to(scale_hu)
        level = torch.log(scale_hu / REFERENCE_SCALE_HU).clamp(-3.0, 3.0)
        first, second = torch.exp(self.smooth + self.smooth_slope * level[:, None]).T
        return first.reshape(-1, 1, 1, 1) * f2 + second.reshape(-1, 1, 1, 1) * f2 * f2

    def along_strength(self, scale_hu: Tensor) -> Tensor:
        """Strength of the smoothing along vessels (:class:`recon.mbir.along_vessel.VesselSmoothing`), ``(batch,)``."""
        level = torch.log(scale_hu / REFERENCE_SCALE_HU).clamp(-3.0, 3.0)
        return torch.exp(self.along[0] + self.along[1] * level)

    def curvature(self, scale_hu: Tensor) -> Tensor:
        """Mean eigenvalue of the Hessian of a flat volume, ``(batch,)``: for preconditioners."""
        return self._weights_at_zero(scale_hu).sum(dim=(1, 2)) * (self.config.group / 8.0)

    def slope_bound(self, scale_hu: Tensor) -> Tensor:
        """Upper bound of the Lipschitz constant of ∇R, ``(batch,)``: what a step length may rely on."""
        weights = self._weights_at_zero(scale_hu).amax(-1)
        norms = []
        for level in range(self.config.levels):
            # Norm of a convolution: the largest singular value of its response to plane waves.
            response = torch.fft.fftn(self._kernels(level), s=(8, 8, 8), dim=(-3, -2, -1)).movedim((0, 1), (-2, -1))
            norms.append(torch.linalg.matrix_norm(response, ord=2).amax() ** 2)
        return (weights * torch.stack(norms)).sum(-1)

    def gradient(self, u: Tensor, scale_hu: Tensor) -> Tensor:
        """∇R(u), ``(batch, z, y, x)``.

        Args:
            u: volumes in noise units.
            scale_hu: ``(batch,)`` noise scale of each volume in HU.
        """
        amplitudes = self.amplitudes(scale_hu)
        shape = u.shape[-3:]
        v = self._pad(u)
        total = torch.zeros_like(v)
        for level in range(self.config.levels):
            kernels = self._kernels(level)
            blocks = to_blocks(v)
            h = F.conv3d(blocks, kernels, padding=1)
            weighed = self._weigh(h, amplitudes[:, level], self._mixture(level))
            back = F.conv_transpose3d(weighed, kernels, padding=1)
            part = from_blocks(back)
            for _ in range(level):
                part = _unpool(part)
            total = total + part
            if level + 1 < self.config.levels:
                v = blocks.sum(1) / math.sqrt(8.0)
        return total[..., : shape[0], : shape[1], : shape[2]]

    def energy(self, u: Tensor, scale_hu: Tensor) -> Tensor:
        """R(u), ``(batch,)``."""
        amplitudes = self.amplitudes(scale_hu)
        v = self._pad(u)
        total: Any = 0.0
        for level in range(self.config.levels):
            blocks = to_blocks(v)
            r2 = self._magnitudes(F.conv3d(blocks, self._kernels(level), padding=1))
            r2 = F.conv3d(r2, self._mixture(level), padding=1)
            for j, tau2 in enumerate(self._squares):
                a = amplitudes[:, level, :, j].reshape(*r2.shape[:2], 1, 1, 1)
                total = total + 0.5 * (a * tau2 * torch.log1p(r2 / tau2)).sum(dim=(1, 2, 3, 4))
            v = blocks.sum(1) / math.sqrt(8.0)
        return total

    def _magnitudes(self, h: Tensor) -> Tensor:
        """‖h_g‖² of each group, ``(batch, groups, z, y, x)``."""
        return h.unflatten(1, (-1, self.config.group)).square().sum(2)

    def _weigh(self, h: Tensor, amplitudes: Tensor, mixture: Tensor) -> Tensor:
        """∂R/∂h = Cᵀ ψ'(C ‖h_g‖²) · 2 h."""
        rho = F.conv3d(self._magnitudes(h), mixture, padding=1)
        weight: Any = 0.0
        for j, tau2 in enumerate(self._squares):
            a = amplitudes[..., j].reshape(*rho.shape[:2], 1, 1, 1)
            weight = weight + a / (1.0 + rho / tau2)
        weight = F.conv_transpose3d(weight, mixture, padding=1)
        return (h.unflatten(1, (-1, self.config.group)) * weight.unsqueeze(2)).flatten(1, 2)

    def _pad(self, u: Tensor) -> Tensor:
        """Zeros after the last voxel up to a multiple of the coarsest block."""
        block = 2**self.config.levels
        extra = [(-n) % block for n in u.shape[-3:]]
        return F.pad(u, (0, extra[2], 0, extra[1], 0, extra[0]))


def squared_frequencies(shape: tuple[int, ...], voxel_mm: float, along: float = 1.0) -> Tensor:
    """f_xy² + ``along`` · f_z² in (line pairs per mm)² on the frequencies of ``rfftn`` of ``(z, y, x)`` volumes."""
    z, y, x = shape
    total: Tensor = (
        along * torch.fft.fftfreq(z, voxel_mm)[:, None, None] ** 2
        + torch.fft.fftfreq(y, voxel_mm)[:, None] ** 2
        + torch.fft.rfftfreq(x, voxel_mm) ** 2
    )
    return total


def to_frequencies(v: Tensor) -> Tensor:
    """``rfftn`` of volumes ``(..., z, y, x)``."""
    return torch.fft.rfftn(v, dim=(-3, -2, -1))


def from_frequencies(spectrum: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Volumes ``(..., *shape)`` of :func:`to_frequencies`."""
    return torch.fft.irfftn(spectrum, s=shape, dim=(-3, -2, -1))


def filtered(v: Tensor, spectrum: Tensor) -> Tensor:
    """Volumes ``(..., z, y, x)`` times ``spectrum`` on the frequencies of ``rfftn``."""
    return from_frequencies(spectrum * to_frequencies(v), v.shape[-3:])


def to_blocks(u: Tensor) -> Tensor:
    """``(batch, z, y, x)`` to ``(batch, 8, z/2, y/2, x/2)``."""
    b, z, y, x = u.shape
    return (
        u.reshape(b, z // 2, 2, y // 2, 2, x // 2, 2).permute(0, 2, 4, 6, 1, 3, 5).reshape(b, 8, z // 2, y // 2, x // 2)
    )


def from_blocks(blocks: Tensor) -> Tensor:
    """Inverse (and adjoint) of :func:`to_blocks`."""
    b, _, z, y, x = blocks.shape
    return blocks.reshape(b, 2, 2, 2, z, y, x).permute(0, 4, 1, 5, 2, 6, 3).reshape(b, 2 * z, 2 * y, 2 * x)


def _unpool(v: Tensor) -> Tensor:
    """Adjoint of the orthonormal Haar average."""
    v = v / math.sqrt(8.0)
    return v.repeat_interleave(2, -3).repeat_interleave(2, -2).repeat_interleave(2, -1)


def _differences(count: int, seed: int = 0) -> Tensor:
    """Start of the filters ``(count, 8, 3, 3, 3)``: for each voxel of a block its three forward differences.

    Compact filters act up to one voxel from a strong edge; wide ones let go as soon as they touch it. Beyond the 24
    differences of a block come random filters of the same kind, differences to more distant voxels.
    """
    generator = torch.Generator().manual_seed(seed)
    cubes = torch.zeros(count, 6, 6, 6)
    for n in range(count):
        voxel, axis = divmod(n, 3)
        at = [2 + (voxel >> 2 & 1), 2 + (voxel >> 1 & 1), 2 + (voxel & 1)]
        step = [0, 0, 0]
        step[axis] = 1
        if n >= 24:
            step = (torch.randint(0, 5, (3,), generator=generator) - 2).tolist()
            step = step if any(step) else [1, 1, 1]
        cubes[n, at[0] % 6, at[1] % 6, at[2] % 6] = -1.0
        cubes[n, min(at[0] + step[0], 5), min(at[1] + step[1], 5), min(at[2] + step[2], 5)] += 1.0
    cubes = cubes + 0.02 * torch.randn(cubes.shape, generator=generator)
    return to_blocks(cubes)
