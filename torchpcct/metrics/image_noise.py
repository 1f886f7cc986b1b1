"""Noise of a uniform region as image quality reports have it: SD, radial NPS, noise magnitude and central frequency.

Reconstructions are judged against FBP by two ratios of the radially averaged noise power spectrum NPS(f) of axial
images:

* noise magnitude ratio NMR = √(∫ NPS_method df / ∫ NPS_FBP df): below 1 the method is less noisy;
* central frequency ratio CFR = f̄_method / f̄_FBP with f̄ = ∫ f NPS df / ∫ NPS df: below 1 the noise is coarser, the
  "plastic" texture of strong iterative reconstruction.

f̄ is the first moment of the one-dimensional radial mean, each frequency weighing the same: so
``pylinac.core.nps.average_power`` has it, and so we understand the average frequency of AAPM Task Group 233 (2019) and
of Solomon et al. (2020, Med. Phys. 47:3961). Their noise magnitude is the SD, the root of the integral over the plane,
∫ NPS 2πf df; the ratio of SDs is that of :attr:`RegionNoise.sd_hu`. In the NMR, the root of the plain one-dimensional
integral, low frequencies count more. The names are those of phantom studies (Greffier et al. 2020, Eur. Radiol.
30:3951). None of these papers was at hand for a check by the word: compare formulas, not names.

Neither ratio says anything about resolution: see :mod:`torchpcct.metrics.matched_resolution`. Intervals are paired over
realisations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchpcct.metrics.bootstrap import Estimate
from torchpcct.metrics.jackknife import Jackknifed, combined, log_of_sum
from torchpcct.metrics.noise_power import NoisePower
from torchpcct.validate import checked, per_axis

__all__ = ["RegionNoise", "central_frequency_ratio", "noise_magnitude_ratio"]

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RegionNoise:
    """Noise in a uniform region, of every realisation. Made by :meth:`of`.

    Attributes:
        frequencies: ``(shells,)`` mean frequency of each shell of the radial NPS, cycles per mm.
        radial_parts: ``(n, shells)`` HU² mm²; their sum over n − 1 is the NPS.
        across: ``(n,)`` HU² squared deviations from the mean of the realisations, mean over voxels.
        spatial: ``(n,)`` HU² variance over the voxels of a slice, mean over slices.
    """

    frequencies: Floats
    radial_parts: Floats
    across: Floats
    spatial: Floats

    @classmethod
    def of(cls, realizations: Any, spacing: Any, width: float | None = None) -> RegionNoise:
        """From the region's voxels.

        Args:
            realizations: ``(n, y, x)``, or ``(n, z, y, x)`` whose slices are averaged; HU, n ≥ 3 realisations of the
                same uniform region.
            spacing: in-plane voxel size in mm, one number or ``(y, x)``.
            width: of the shells in cycles per mm, as for :meth:`NoisePower.radial`. The same region in mm gives the
                same shells.

        Raises:
            ValueError: fewer than 3 realisations, a wrong number of axes, NaN or Inf, a spacing that is not positive.
        """
        x = realizations.detach().cpu().numpy() if isinstance(realizations, torch.Tensor) else np.asarray(realizations)
        if x.ndim not in (3, 4) or x.shape[0] < 3 or min(x.shape[-2:]) < 2:
            raise ValueError(f"realizations must be (n ≥ 3, y, x) or (n ≥ 3, z, y, x), got the shape {x.shape}")
        x = x[:, None] if x.ndim == 3 else x
        per = per_axis("spacing", spacing, 2, positive=True, unit="mm")
        mean = x.mean(0, dtype=np.float64)
        if not np.isfinite(mean).all():
            raise ValueError("realizations hold NaN or Inf: check the reconstruction before measuring it")
        n, cells = len(x), x.shape[-2] * x.shape[-1]
        radial, across, spatial = [], np.empty(n), np.empty(n)
        frequencies = np.zeros(0)
        for i, image in enumerate(x):
            deviation = image - mean
            power = np.square(np.abs(np.fft.fft2(deviation))).mean(0) * (np.prod(per) / cells)
            frequencies, shells = NoisePower(power, per, n).radial(width)
            radial.append(shells)
            across[i] = np.square(deviation).mean()
            spatial[i] = image.astype(np.float64).var(axis=(-2, -1), ddof=1).mean()
        return cls(frequencies, np.stack(radial), across, spatial)

    @property
    def log_variance(self) -> Jackknifed:
        """Logarithm of the variance of a voxel across realisations, averaged over the region."""
        return log_of_sum(self.across, lost=1)

    @property
    def sd_hu(self) -> Estimate:
        """SD of a voxel across realisations: the noise alone."""
        return self.log_variance.exponential(scale=0.5)

    @property
    def spatial_sd_hu(self) -> Estimate:
        """SD over the region in one image, as a reader measures it: with what is not uniform in the mean image, but
        without the noise whose wavelength exceeds the region."""
        return log_of_sum(self.spatial).exponential(scale=0.5)

    @property
    def radial(self) -> Floats:
        """Radially averaged NPS, ``(shells,)`` HU² mm²."""
        total: Floats = self.radial_parts.sum(0) / (len(self.radial_parts) - 1)
        return total

    def moment(self, order: int, limit: float) -> Jackknifed:
        """ln ∫ f^order NPS(f) df from the lowest shell to ``limit`` (cycles per mm), trapezoidal."""
        f, p = self.frequencies, self.radial_parts
        if not f[0] < limit <= f[-1] * (1 + 1e-12):
            raise ValueError(f"limit must lie within the spectrum, {f[0]:g}…{f[-1]:g} cycles per mm, got {limit:g}")
        inside = f < limit
        k = int(inside.sum())
        share = (limit - f[k - 1]) / (f[k] - f[k - 1]) if k < f.size else 1.0
        last = p[:, k - 1] + share * (p[:, min(k, f.size - 1)] - p[:, k - 1])
        nodes = np.append(f[:k], limit)
        values = np.concatenate([p[:, :k], last[:, None]], axis=1) * nodes**order
        return log_of_sum(np.trapezoid(values, nodes, axis=1), lost=1)


def _limit(method: RegionNoise, reference: RegionNoise) -> float:
    return float(min(method.frequencies[-1], reference.frequencies[-1]))


@checked
def noise_magnitude_ratio(method: RegionNoise, reference: RegionNoise, level: float = 0.95) -> Estimate:
    """NMR = √(∫ NPS_method df / ∫ NPS_reference df), up to the lower of both highest frequencies.

    Args:
        method, reference: of the same realisations (paired by noise seed), of regions of one size.
        level: coverage of the interval.

    Raises:
        ValueError: different numbers of realisations.
    """
    limit = _limit(method, reference)
    return combined(np.subtract, method.moment(0, limit), reference.moment(0, limit)).exponential(level, 0.5)


@checked
def central_frequency_ratio(method: RegionNoise, reference: RegionNoise, level: float = 0.95) -> Estimate:
    """CFR = f̄_method / f̄_reference of the mean frequencies f̄ = ∫ f NPS df / ∫ NPS df; arguments and errors as
    :func:`noise_magnitude_ratio`."""
    limit = _limit(method, reference)
    moments = [noise.moment(order, limit) for noise in (method, reference) for order in (1, 0)]
    return combined(lambda a, b, c, d: (a - b) - (c - d), *moments).exponential(level)
