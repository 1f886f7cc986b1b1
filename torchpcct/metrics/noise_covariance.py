"""Autocovariance of stationary noise, and the variance that it has after a Gaussian filter, without filtering it::

    ∫ NPS(f) G²(f) df = Σ_τ C(τ) w_z(τ_z) w(τ_y) w(τ_x),    w(τ) = h ∫ G²(f) cos(2πfτ) df,  |f| ≤ 1/2h,

with G(f) = exp(−2π²σ²f²) and the autocovariance C on the voxels' lags (h apart), the inverse transform of the NPS. The
sum over lags is exact for stationary noise. A periodogram of a small region in place of the NPS would taper C: with
lags of a tenth of the region it loses a tenth of their covariance on each axis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchpcct.validate import number, per_axis

__all__ = ["NoiseCovariance"]

Floats = NDArray[np.float64]

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(512)
_REACH = 3.0
"""Lags that the covariance must hold, in units of √2 σ: w is below 1 % of its peak beyond."""


@dataclass(frozen=True, eq=False)
class NoiseCovariance:
    """Autocovariance of stationary noise. Made by :meth:`of` or :meth:`exact`.

    Attributes:
        values: ``(z, y, x)`` HU² on lags −k…k of each axis, in steps of a voxel; lag 0 in the middle.
        spacing: voxel size in mm, ``(z, y, x)``.
        parts: ``(n, z, y, x)`` of each realisation, ``values`` times n − 1 in sum; None: exact.
    """

    values: Floats
    spacing: tuple[float, ...]
    parts: Floats | None = None

    @classmethod
    def of(cls, realizations: Any, spacing: Any, reach_mm: float) -> NoiseCovariance:
        """From realisations of a uniform region, free of bias for stationary noise.

        Args:
            realizations: ``(n, z, y, x)`` HU, n ≥ 3.
            spacing: voxel size in mm, one number or ``(z, y, x)``.
            reach_mm: largest lag; it must leave two thirds of the region to average over.

        Raises:
            ValueError: wrong shape, NaN or Inf, a reach of more than a third of the region.
        """
        x = realizations.detach().cpu().numpy() if isinstance(realizations, torch.Tensor) else np.asarray(realizations)
        if x.ndim != 4 or len(x) < 3:
            raise ValueError(f"realizations must be (n ≥ 3, z, y, x), got the shape {x.shape}")
        per = per_axis("spacing", spacing, 3, positive=True, unit="mm")
        lags = [round(number("reach_mm", reach_mm, low=0.0) / s) for s in per]
        if any(3 * k > n for k, n in zip(lags, x.shape[1:], strict=True)):
            extent = [round(n * s, 3) for n, s in zip(x.shape[1:], per, strict=True)]
            raise ValueError(f"reach_mm must be at most a third of the region's {extent} mm, got {reach_mm:g}")
        mean = x.mean(0, dtype=np.float64)
        if not np.isfinite(mean).all():
            raise ValueError("realizations hold NaN or Inf: check the reconstruction before measuring it")
        padded = [n + k for n, k in zip(x.shape[1:], lags, strict=True)]
        keep = [np.arange(-k, k + 1) for k in lags]
        pairs = [n - np.abs(k) for n, k in zip(x.shape[1:], keep, strict=True)]
        count = pairs[0][:, None, None] * pairs[1][:, None] * pairs[2]
        parts = np.empty((len(x), *count.shape))
        for i, volume in enumerate(x):
            power = np.square(np.abs(np.fft.rfftn(volume - mean, padded, axes=(0, 1, 2))))
            parts[i] = np.fft.irfftn(power, padded, axes=(0, 1, 2))[np.ix_(*keep)] / count
        return cls(parts.sum(0) / (len(x) - 1), per, parts)

    @classmethod
    def exact(cls, row: Any, spacing: Any) -> NoiseCovariance:
        """From the covariance of one voxel with those around it, of :func:`recon.fbp.exact_noise.voxel_covariance`.

        Args:
            row: ``(z, y, x)`` HU², odd sizes, the voxel in the middle.
            spacing: voxel size in mm, one number or ``(z, y, x)``.

        Raises:
            ValueError: even sizes, NaN or Inf, a middle that is not positive.
        """
        c = np.asarray(row, dtype=np.float64)
        if c.ndim != 3 or not all(n % 2 for n in c.shape) or not np.isfinite(c).all():
            raise ValueError(f"row must be finite, (z, y, x) of odd sizes, got the shape {c.shape}")
        if not c[tuple(n // 2 for n in c.shape)] > 0:
            raise ValueError("the variance in the middle of row must be positive")
        # A row taken from noise that is only nearly stationary need not be even.
        return cls((c + c[::-1, ::-1, ::-1]) / 2, per_axis("spacing", spacing, 3, positive=True, unit="mm"))

    def _weights(self, sigma: float, sigma_z: float, lag_z: float) -> list[Floats]:
        found = []
        for axis, (s, h, n) in enumerate(zip((sigma_z, sigma, sigma), self.spacing, self.values.shape, strict=True)):
            lag = h * np.arange(-(n // 2), n // 2 + 1)
            if _REACH * math.sqrt(2.0) * s > lag[-1] + h:
                raise ValueError(
                    f"a filter of σ = {s:.3g} mm needs lags up to {_REACH * math.sqrt(2.0) * s:.2f} mm, the covariance "
                    f"holds {lag[-1]:.2f}: raise its reach"
                )
            f = _NODES / (2.0 * h)
            spectrum = np.exp(-np.square(2.0 * math.pi * s * f)) * _WEIGHTS / 2.0
            found.append(np.cos(2.0 * math.pi * np.outer(lag - (lag_z if axis == 0 else 0.0), f)) @ spectrum)
        return found

    def filtered(self, sigma: float, sigma_z: float, lag_z: float = 0.0, leave: int | None = None) -> float:
        """Covariance in HU² of two voxels ``lag_z`` mm apart along z after a Gaussian filter; the variance at 0.

        Args:
            sigma, sigma_z: of the filter in mm, in plane and along z; 0: none.
            lag_z: in mm.
            leave: number of a realisation to leave out.

        Raises:
            ValueError: lags that do not reach to 3√2 σ; ``leave`` of an exact covariance.
        """
        c = self.values
        if leave is not None:
            if self.parts is None:
                raise ValueError("an exact covariance has no realisations to leave out")
            n = len(self.parts)
            c = ((n - 1) * c - n / (n - 1) * self.parts[leave]) / (n - 2)
        return float(np.einsum("zyx,z,y,x->", c, *self._weights(sigma, sigma_z, lag_z)))
