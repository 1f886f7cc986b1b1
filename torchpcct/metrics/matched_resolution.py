"""Noise at matched resolution: how noisy FBP is once it is as blurred as the method, in plane and along z separately.

Whatever smooths lowers the noise, so a noise ratio says something only at equal resolution. A method's resolution is
the frequency f50 at which its task transfer function falls to ½, at the contrast of the task (a nonlinear method has
one for each), once in plane and once along z (AAPM Task Group 233, 2019). FBP is brought there by Gaussian post-filters
of σ in plane and σ_z, whose transfer function G(f) = exp(−2π²σ²f²) is known, so that TTF_FBP(f50) · G(f50) = ½, and its
noise ∫ NPS G² df follows without a single new reconstruction (:mod:`torchpcct.metrics.noise_covariance`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from torchpcct.metrics.bootstrap import Estimate
from torchpcct.metrics.jackknife import Jackknifed
from torchpcct.metrics.noise_covariance import NoiseCovariance
from torchpcct.metrics.resolution import TransferFunction, task_transfer
from torchpcct.validate import checked, choice, number, per_axis

__all__ = [
    "LinearReference",
    "MatchedNoise",
    "edge_mask",
    "gaussian_to_reach",
    "jackknifed_f50",
    "matched_noise_ratio",
]

Floats = NDArray[np.float64]


@checked
def edge_mask(distance: ArrayLike, spacing: ArrayLike, along: str, within_deg: float = 30.0) -> NDArray[np.bool_]:
    """Voxels whose nearest surface faces in plane, or along z, for :func:`task_transfer`.

    Args:
        distance: ``(z, y, x)`` signed distance from the surface, mm.
        spacing: voxel size in mm, one number or ``(z, y, x)``.
        along: ``"plane"`` or ``"z"``.
        within_deg: largest angle between the surface's normal and the plane or the z axis.

    Raises:
        ValueError: no volume, an unknown direction, no such voxel (an endless cylinder has no end along z).
    """
    r = np.asarray(distance, dtype=np.float64)
    if r.ndim != 3:
        raise ValueError(f"distance must be (z, y, x), got the shape {r.shape}")
    within = math.radians(number("within_deg", within_deg, positive=True, high=90.0, unit="degrees"))
    slopes = np.gradient(r, *per_axis("spacing", spacing, 3, positive=True, unit="mm"))
    share = np.abs(slopes[0]) / np.maximum(np.sqrt(sum(np.square(s) for s in slopes)), 1e-12)
    along_z = choice("along", along, ("plane", "z")) == "z"
    mask: NDArray[np.bool_] = share >= math.cos(within) if along_z else share <= math.sin(within)
    if not mask.any():
        raise ValueError(f"no part of the surface faces {along} within {within_deg:g} degrees")
    return mask


@checked
def jackknifed_f50(
    images: ArrayLike, distance: ArrayLike, reach: tuple[float, float], bin_mm: float, mask: Any = None
) -> Jackknifed:
    """f50 of an edge in the mean image, cycles per mm, with each realisation left out once.

    Args:
        images: ``(n, ...)`` HU, n ≥ 3 realisations.
        distance, reach, bin_mm, mask: as for :func:`task_transfer`; the mask e.g. of :func:`edge_mask`.

    Raises:
        ValueError: as for :func:`task_transfer`; fewer than 3 realisations; a TTF that does not fall to ½.
    """
    x = images.detach().cpu().numpy() if isinstance(images, torch.Tensor) else np.asarray(images)
    if x.ndim < 2 or len(x) < 3:
        raise ValueError(f"images must be (n ≥ 3, ...), got the shape {x.shape}")

    def f50(mean: Any) -> float:
        f = task_transfer(mean, distance, reach, bin_mm, mask).f50
        if not math.isfinite(f):
            raise ValueError("the transfer function does not fall to 0.5: use smaller bins")
        return f

    total = x.sum(0, dtype=np.float64)
    return Jackknifed(f50(total / len(x)), np.array([f50((total - image) / (len(x) - 1)) for image in x]))


@checked
def gaussian_to_reach(transfer: TransferFunction, f50: float) -> float:
    """σ in mm of the Gaussian filter after which a transfer function falls to ½ at ``f50`` (cycles per mm).

    Raises:
        ValueError: the reference is less sharp than that already, or its transfer function ends below ``f50``.
    """
    f = number("f50", f50, positive=True, unit="cycles per mm")
    if f > transfer.frequencies[-1]:
        raise ValueError(f"the reference's transfer function ends at {transfer.frequencies[-1]:.3g} cycles per mm, "
                         f"below the f50 of {f:.3g}: use smaller bins")  # fmt: skip
    value = float(np.interp(f, transfer.frequencies, transfer.values))
    if f > transfer.f50 or value < 0.5 * (1 - 1e-9):
        raise ValueError(f"the reference is less sharp (f50 {transfer.f50:.3g} cycles per mm) than {f:.3g}: take a "
                         "sharper kernel")  # fmt: skip
    return math.sqrt(max(math.log(2.0 * value), 0.0) / 2.0) / (math.pi * f)


@dataclass(frozen=True, eq=False)
class LinearReference:
    """A linear reconstruction (FBP of one kernel) that Gaussian filters bring to any lower resolution.

    Attributes:
        plane, along_z: its transfer functions, noise free, of the edges that the method's were measured at.
        noise: its autocovariance at the method's exposure.
    """

    plane: TransferFunction
    along_z: TransferFunction
    noise: NoiseCovariance


@dataclass(frozen=True)
class MatchedNoise:
    """The noise ratio at matched resolution.

    Attributes:
        ratio: SD of the method over SD of the filtered reference; below 1 the method is less noisy.
        sigma_mm, sigma_z_mm: of the Gaussian filters.
        reference_sd_hu: of the filtered reference.
        reference_z_correlation: of neighbouring slices of the filtered reference.
    """

    ratio: Estimate
    sigma_mm: float
    sigma_z_mm: float
    reference_sd_hu: float
    reference_z_correlation: float


@checked
def matched_noise_ratio(
    log_variance: Jackknifed,
    f50: Jackknifed | float,
    f50_z: Jackknifed | float,
    reference: LinearReference,
    level: float = 0.95,
) -> MatchedNoise:
    """SD of a method over that of FBP filtered to the method's f50 in plane and along z.

    Args:
        log_variance: of the method's voxels (``RegionNoise.log_variance``), in the reference's region.
        f50, f50_z: of the method at the task's contrast, cycles per mm; of the same realisations, or exact.
        reference: exact, or of the same realisations.
        level: coverage of the interval, over all that is measured.

    Raises:
        ValueError: a method that is sharper than the reference; different numbers of realisations; lags that do not
            reach far enough.
    """
    n = log_variance.left_out.size
    parts = reference.noise.parts
    for f in (f50, f50_z):
        if isinstance(f, Jackknifed) and f.left_out.size != n:
            raise ValueError(f"f50 has {f.left_out.size} realisations, the variance {n}: pair them by seed")
    if parts is not None and len(parts) != n:
        raise ValueError(f"the reference has {len(parts)} realisations, the variance {n}: pair them by seed")

    def sigmas(k: int | None) -> tuple[float, float]:
        at = [
            (f.value if k is None else float(f.left_out[k])) if isinstance(f, Jackknifed) else f for f in (f50, f50_z)
        ]
        return gaussian_to_reach(reference.plane, at[0]), gaussian_to_reach(reference.along_z, at[1])

    own = sigmas(None)
    variance = reference.noise.filtered(*own)
    fixed = parts is None and not isinstance(f50, Jackknifed) and not isinstance(f50_z, Jackknifed)
    left = [
        variance if fixed else reference.noise.filtered(*sigmas(k), leave=None if parts is None else k)
        for k in range(n)
    ]
    if not (variance > 0 and min(left) > 0):
        raise ValueError("the filtered reference has no positive variance: its covariance holds too few lags or draws")
    ratio = Jackknifed(log_variance.value - math.log(variance), log_variance.left_out - np.log(left))
    neighbour = reference.noise.filtered(*own, lag_z=reference.noise.spacing[0]) / variance
    return MatchedNoise(ratio.exponential(level, 0.5), *own, math.sqrt(variance), neighbour)
