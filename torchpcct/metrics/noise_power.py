"""Noise power spectrum and autocorrelation from an ensemble of realisations.

``NPS(f) = (Π Δ / Π N) · n / (n − 1) · <|DFT(x − x̄)|²>`` in HU² mm^d, where x̄ is the mean over the
n realisations: it removes the object, and the factor n / (n − 1) the variance that goes with it. By
Parseval's theorem the sum of NPS over the frequency cells is the mean unbiased variance of a voxel,
exactly. The noise is taken as stationary over the region; a region that is not periodic leaks power
between neighbouring frequencies (ICRU Report 87).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchpcct.metrics.roi import as_array
from torchpcct.validate import checked, per_axis

__all__ = ["NoisePower", "noise_power_spectrum"]

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class NoisePower:
    """A noise power spectrum.

    Attributes:
        power: ``(y, x)`` or ``(z, y, x)`` HU² mm², HU² mm³; frequencies in the order of
            ``numpy.fft.fftfreq``.
        spacing: voxel size in mm per axis.
        realisations: size of the ensemble.
    """

    power: Floats
    spacing: tuple[float, ...]
    realisations: int

    @property
    def frequencies(self) -> tuple[Floats, ...]:
        """Frequencies per axis in cycles per mm."""
        sizes = zip(self.power.shape, self.spacing, strict=True)
        return tuple(np.fft.fftfreq(n, s).astype(np.float64) for n, s in sizes)

    @property
    def variance(self) -> float:
        """Integral of the spectrum: mean variance of a voxel in HU²."""
        return float(
            self.power.sum()
            / np.prod([n * s for n, s in zip(self.power.shape, self.spacing, strict=True)])
        )

    def radial(self) -> tuple[Floats, Floats]:
        """Mean over shells of equal ``|f|``, each as wide as the coarsest axis' frequency step.

        Returns:
            mean frequency of each shell (cycles per mm) and mean power; shells without a sample are
            left out. Frequencies beyond the smallest axis' Nyquist frequency (the corners) are left
            out.
        """
        f = np.sqrt(
            sum(np.square(a) for a in np.meshgrid(*self.frequencies, indexing="ij"))
        ).ravel()
        inside = f <= 0.5 / max(self.spacing) + 1e-12
        radius, values = f[inside], self.power.ravel()[inside]
        width = max(1 / (n * s) for n, s in zip(self.power.shape, self.spacing, strict=True))
        shell = np.round(radius / width).astype(np.int64)
        count = np.bincount(shell)
        used = count > 0
        return np.bincount(shell, radius)[used] / count[used], np.bincount(shell, values)[
            used
        ] / count[used]


@checked
def noise_power_spectrum(realisations: object, spacing: float | tuple[float, ...]) -> NoisePower:
    """Noise power spectrum of an ensemble.

    Args:
        realisations: ``(n, y, x)`` or ``(n, z, y, x)`` array or tensor in HU, at least 2
            realisations of one object.
        spacing: voxel size in mm, one number or one per axis.

    Raises:
        ValueError: fewer than 2 realisations, a wrong number of axes, a spacing that is not
            positive, NaN or Inf.
    """
    x = as_array(realisations)
    if x.ndim not in (3, 4) or x.shape[0] < 2:
        raise ValueError(
            f"realisations must be (n ≥ 2, y, x) or (n ≥ 2, z, y, x), got the shape {x.shape}"
        )
    per = per_axis("spacing", spacing, x.ndim - 1, positive=True, unit="mm")
    n = x.shape[0]
    mean = x.mean(0, dtype=np.float64)
    if not np.isfinite(mean).all():
        raise ValueError(
            "realisations hold NaN or Inf: check the reconstruction before measuring it"
        )
    power = np.zeros(x.shape[1:])
    for image in x:
        power += np.square(np.abs(np.fft.fftn(image - mean)))
    power *= np.prod(per) / power.size / (n - 1)
    return NoisePower(power, per, n)
