"""The operator of a reconstructed volume whose noise is known: what AᵀWA is to a scan.

A volume v = h ∗ x + n with stationary noise of power S(f) and a transfer function T(f) (of h) has the likelihood of a
scan with G(f) = T² / S and the statistic (T / S) v. Both must be known: a reading's intervals are as good as they are.
FBP throws information away where its kernel does; what is left is in T² / S.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from scipy.fft import next_fast_len
from torch import Tensor

from torchpcct.geometry import VolumeGrid

__all__ = ["Spectrum", "StationaryGram"]

Spectrum = Callable[[Any, Any], Any]
"""Values at in-plane and axial frequencies in line pairs per mm, arrays of one shape."""

_FLOOR = 1e-3
"""Noise power below this share of its largest value is not believed: 1 / S would be all the information there is."""
_LAG_ENERGY = 1e-6
"""Lags along z with less than this share of the operator's energy are left out."""


class StationaryGram:
    """T² / S of a volume, with what the reader needs of :class:`recon.gram.gram.Gram`.

    Args:
        grid: of the volume, ``(z, y, x)``.
        noise_power: S, HU² mm³.
        transfer: T, 1 at frequency 0; None: 1 everywhere.

    Raises:
        ValueError: noise power that is not finite, or not positive anywhere.
    """

    def __init__(self, grid: VolumeGrid, noise_power: Spectrum, transfer: Spectrum | None = None) -> None:
        self.grid, self.dtype = grid, torch.float32
        self.padded = tuple(next_fast_len(2 * n - 1, real=True) for n in grid.shape)
        f = [np.fft.fftfreq(n, s) for n, s in zip(self.padded, grid.spacing, strict=True)]
        z, y, x = np.meshgrid(f[0], f[1], np.abs(f[2][: self.padded[2] // 2 + 1]), indexing="ij")
        power = np.asarray(noise_power(np.hypot(y, x), np.abs(z)), np.float64) * np.ones_like(z)
        if not np.isfinite(power).all() or not power.max() > 0:
            raise ValueError("noise_power must be finite, and positive somewhere: HU² mm³ at every frequency")
        power = np.maximum(power, _FLOOR * power.max())
        passed = np.ones_like(z) if transfer is None else np.asarray(transfer(np.hypot(y, x), np.abs(z)), np.float64)
        voxel = float(np.prod(grid.spacing))
        self._weigh = torch.from_numpy(passed / power * voxel).float()
        kernel = np.fft.irfftn(passed**2 / power * voxel, s=self.padded, axes=(0, 1, 2))
        nz = grid.shape[0]
        energy = (kernel**2).sum((1, 2))[:nz]
        kept = np.flatnonzero(energy > _LAG_ENERGY * energy.sum())
        self._lags = int(kept.max()) + 1
        lags = np.arange(self.padded[0])
        near = np.minimum(lags, self.padded[0] - lags) < self._lags
        # The same lags in every use, so that blocks and products agree.
        self._kernel = torch.from_numpy(kernel * near[:, None, None])
        self._spectrum = torch.fft.rfftn(self._kernel).real.float()

    def statistic(self, volume: Tensor) -> Tensor:
        """(T / S) v of a volume in HU; the volume is continued by its median."""
        level = volume.median()
        found = torch.fft.irfftn(self._weigh * torch.fft.rfftn((volume - level).float(), s=self.padded), s=self.padded)
        z, y, x = self.grid.shape
        # A constant passes through T with gain 1.
        return found[:z, :y, :x] + self.apply(torch.full(tuple(self.grid.shape), float(level)))

    def apply(self, x: Tensor) -> Tensor:
        """G x, ``(..., z, y, x)``."""
        out = torch.fft.irfftn(self._spectrum * torch.fft.rfftn(x, s=self.padded, dim=(-3, -2, -1)), s=self.padded,
                               dim=(-3, -2, -1))  # fmt: skip
        nz, ny, nx = self.grid.shape
        return out[..., :nz, :ny, :nx]

    def lag_kernels(self) -> Tensor:
        """As :meth:`recon.gram.gram.Gram.lag_kernels`."""
        slices = self._kernel[: self._lags].float()
        return slices[None, :, None].expand(1, self._lags, self.grid.shape[0], *self.padded[1:])

    @property
    def polynomials(self) -> Tensor:
        """As :attr:`recon.gram.gram.Gram.polynomials`."""
        return torch.ones(1, *self.grid.shape[1:])

    def periodic_spectrum(self) -> Tensor:
        """Eigenvalues on the frequencies of the grid, about."""
        nz, ny, nx = self.grid.shape
        fold = torch.zeros(nz, ny, nx, dtype=torch.float64)
        at = [torch.arange(-(n // 2), n - n // 2) for n in (nz, ny, nx)]
        part = self._kernel[at[0] % self.padded[0]][:, at[1] % self.padded[1]][:, :, at[2] % self.padded[2]]
        fold[(at[0] % nz)[:, None, None], (at[1] % ny)[:, None], at[2] % nx] = part
        spectrum = torch.fft.rfftn(fold).real
        return spectrum.clamp_min(1e-6 * float(spectrum.max())).float()
