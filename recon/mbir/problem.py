"""The normalised problem: what the network sees looks the same at every dose and voxel size.

With the data's information I at 0.5 lp/mm (1/(HU² mm³), see
:meth:`recon.gram.gram.Gram.information`) and the voxel volume V, the noise scale is c = (I
V)^(−1/2) HU, and

    u = x / c,      H = c² G  (about 1 at 0.5 lp/mm),      β = c b,      β = H u + noise of
    covariance H.

So the same tissue at four times the dose looks to the network like twice the contrast at the same
noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from torch import Tensor

from recon.linear_operator import NormalOperator

__all__ = [
    "NormalisedProblem",
    "filtered",
    "from_frequencies",
    "squared_frequencies",
    "to_frequencies",
]


@dataclass(frozen=True)
class NormalisedProblem:
    """A batch of normalised problems that share one Gram operator.

    Args:
        gram: G, AᵀWA at unit exposure, in mm⁻¹ units.
        beta: ``(batch, z, y, x)``, c·b in HU units.
        scale_hu: ``(batch,)`` noise scales c.
        factor: ``(batch,)`` so that H = factor · G.
        voxel_mm: voxel size.
        zero_hu: HU where u is 0, that of the surround.
    """

    gram: NormalOperator
    beta: Tensor
    scale_hu: Tensor
    factor: Tensor
    voxel_mm: float
    zero_hu: float = 0.0

    @classmethod
    def from_statistic(
        cls, gram: NormalOperator, b: Tensor, exposure: Tensor, mu_per_hu: float, voxel_mm: float
    ) -> NormalisedProblem:
        """From AᵀW y.

        Args:
            gram: AᵀWA at unit exposure.
            b: ``(batch, z, y, x)``, AᵀW y with the weights of the exposures, y in line integrals of
                mm⁻¹.
            exposure: ``(batch,)`` factors on its weights.
            mu_per_hu: 1 HU in mm⁻¹.
            voxel_mm: size of the cubic voxels.
        """
        unit = cls.with_beta(gram, b, exposure, mu_per_hu, voxel_mm)
        return replace(unit, beta=b * (unit.scale_hu * mu_per_hu).reshape(-1, 1, 1, 1))

    @classmethod
    def with_beta(
        cls, gram: NormalOperator, beta: Tensor, exposure: Tensor, mu_per_hu: float, voxel_mm: float
    ) -> NormalisedProblem:
        """From β, which is in noise units already; the other arguments are those of
        :meth:`from_statistic`."""
        unit = gram.information(mu_per_hu)
        scale = (unit * exposure.to(beta) * voxel_mm**3).rsqrt()
        return cls(gram, beta, scale, exposure.to(beta) * (scale * mu_per_hu) ** 2, voxel_mm)

    def part(self, which: Sequence[int] | Tensor) -> NormalisedProblem:
        """Those of the batch."""
        return replace(
            self, beta=self.beta[which], scale_hu=self.scale_hu[which], factor=self.factor[which]
        )

    def apply(self, u: Tensor) -> Tensor:
        """H u."""
        out: Tensor = self.gram.apply(u) * self.factor.reshape(-1, 1, 1, 1)
        return out

    def spectrum(self) -> Tensor:
        """Eigenvalues of the circulant approximation of H, ``(batch, z, y, x//2 + 1)``."""
        return self.gram.periodic_spectrum().to(self.beta) * self.factor.reshape(-1, 1, 1, 1)


def squared_frequencies(
    shape: Sequence[int], voxel_mm: float, like: Tensor | None = None
) -> Tensor:
    """f² in (line pairs per mm)² on the frequencies of ``rfftn`` of volumes, ``(z, y, x//2 + 1)``;
    not to be changed.

    Args:
        shape: ``(z, y, x)`` of the volumes; voxel_mm: their voxels.
        like: whose dtype and device they get; None: float32 on the CPU.
    """
    dtype, device = (
        (torch.float32, torch.device("cpu")) if like is None else (like.dtype, like.device)
    )
    return _squared_frequencies(tuple(shape), voxel_mm, dtype, device)


@lru_cache(maxsize=32)
def _squared_frequencies(
    shape: tuple[int, ...], voxel_mm: float, dtype: torch.dtype, device: torch.device
) -> Tensor:
    z, y, x = shape
    # Not of inference mode: they are kept, and a training may come after.
    with torch.inference_mode(False):
        total: Tensor = (
            torch.fft.fftfreq(z, voxel_mm)[:, None, None] ** 2
            + torch.fft.fftfreq(y, voxel_mm)[:, None] ** 2
            + torch.fft.rfftfreq(x, voxel_mm) ** 2
        )
        return total.to(device, dtype)


def to_frequencies(v: Tensor) -> Tensor:
    """``rfftn`` of volumes ``(..., z, y, x)``."""
    return torch.fft.rfftn(v, dim=(-3, -2, -1))


def from_frequencies(spectrum: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Volumes ``(..., *shape)`` of :func:`to_frequencies`."""
    return torch.fft.irfftn(spectrum, s=shape, dim=(-3, -2, -1))


def filtered(v: Tensor, spectrum: Tensor) -> Tensor:
    """Volumes ``(..., z, y, x)`` times ``spectrum`` on the frequencies of ``rfftn``."""
    return from_frequencies(spectrum * to_frequencies(v), v.shape[-3:])
