"""Virtual monochromatic images (VMI) from basis images, their noise, and the best energy.

    HU(E) = 1000 (a₁ μ₁(E) + a₂ μ₂(E) − μ_w(E)) / (μ_w(E) − μ_air(E))                       (Li et
    al., eq. CTE)

with μ_w of water *in the basis*: water reads 0 HU at every energy by construction, and what the
basis cannot express of water (0.3 HU for PE and PVC) does not tint the images. A VMI is linear in
the basis values, so its noise follows from their 2 × 2 covariance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from torchpcct.scene.materials import material
from torchpcct.spectral.basis import Basis
from torchpcct.validate import checked

__all__ = ["VMI_ENERGIES_KEV", "VmiCurve", "vmi", "vmi_curve", "vmi_noise", "vmi_weights"]

Floats = NDArray[np.float64]

_SINGULAR = 1e-5
"""Of the product of the variances, by which rounding of float32 may push a singular covariance
below 0."""

VMI_ENERGIES_KEV = tuple(float(e) for e in range(40, 141))
"""Energies of the paper's virtual monochromatic images."""


@checked
def vmi_weights(basis: Basis, energies_kev: ArrayLike = VMI_ENERGIES_KEV) -> tuple[Floats, Floats]:
    """The linear map from basis values to HU: ``HU(E) = g(E) · a + offset(E)``.

    Args:
        basis: of the images.
        energies_kev: ``(E,)`` keV.

    Returns:
        ``g`` (E, 2) in HU, ``offset`` (E,) in HU, float64.

    Raises:
        ValueError: energies outside 1…500 keV.
    """
    energies = np.atleast_1d(np.asarray(energies_kev, np.float64))
    mu_water = basis.mu(basis.coefficients("water"), energies)
    span = mu_water - material("air").attenuation(energies)
    return 1000.0 * basis.attenuation(energies).T / span[:, None], -1000.0 * mu_water / span


def _pair(name: str, value: object, entries: int) -> Tensor:
    t = torch.as_tensor(value)
    if t.ndim < 1 or t.shape[0] != entries:
        raise ValueError(
            f"{name} must have {entries} entries on the first axis, got the shape {tuple(t.shape)}"
        )
    return t if t.is_floating_point() else t.to(torch.float64)


@checked
def vmi(basis_images: Tensor, basis: Basis, energies_kev: ArrayLike = VMI_ENERGIES_KEV) -> Tensor:
    """Virtual monochromatic images.

    Args:
        basis_images: ``(2, ...)`` basis coefficients (dimensionless: line integrals in mm,
            reconstructed in mm).
        basis, energies_kev: see :func:`vmi_weights`.

    Returns:
        ``(E, ...)`` in HU, dtype and device of ``basis_images``, differentiable.

    Raises:
        ValueError: a wrong shape, see also :func:`vmi_weights`.
    """
    images = _pair("basis_images", basis_images, 2)
    g, offset = (torch.from_numpy(v).to(images) for v in vmi_weights(basis, energies_kev))
    return torch.tensordot(g, images, dims=1) + offset.reshape(-1, *(1,) * (images.ndim - 1))


@checked
def vmi_noise(
    covariance: ArrayLike, basis: Basis, energies_kev: ArrayLike = VMI_ENERGIES_KEV
) -> Tensor:
    """Standard deviation of virtual monochromatic images.

    Args:
        covariance: ``(3, ...)`` C₁₁, C₁₂, C₂₂ of the basis images (dimensionless).
        basis, energies_kev: see :func:`vmi_weights`.

    Returns:
        ``(E, ...)`` in HU.

    Raises:
        ValueError: a wrong shape, a variance below 0, an indefinite matrix, NaN.
    """
    c = _pair("covariance", covariance, 3)
    if bool((c[0] < 0).any()) or bool((c[2] < 0).any()):
        raise ValueError("covariance holds negative variances: pack it as C11, C12, C22")
    # Rounding may leave the determinant of a singular covariance slightly below 0.
    if not bool((c[1] ** 2 <= c[0] * c[2] * (1 + _SINGULAR)).all()):
        raise ValueError(
            "covariance is not that of two images (C12² > C11 · C22, or NaN): pack it as C11, "
            "C12, C22"
        )
    g = torch.from_numpy(vmi_weights(basis, energies_kev)[0]).to(c)
    terms = torch.stack([g[:, 0] ** 2, 2 * g[:, 0] * g[:, 1], g[:, 1] ** 2], dim=1)
    return torch.tensordot(terms, c, dims=1).clamp_min(0).sqrt()


@dataclass(frozen=True, eq=False)
class VmiCurve:
    """Contrast and noise of two tissues against energy, all ``(E,)`` float64.

    Attributes:
        energies: keV.
        contrast: HU of the first tissue less the second.
        noise: standard deviation in HU.
        cnr: ``|contrast| / noise``.
        limit: CNR of the best linear combination of the two basis images; no VMI exceeds it.
    """

    energies: Floats
    contrast: Floats
    noise: Floats
    cnr: Floats
    limit: float

    @property
    def optimum_kev(self) -> float:
        """Energy of the highest CNR: a parabola through the best sample and its neighbours."""
        k = int(self.cnr.argmax())
        if 0 < k < self.cnr.size - 1:
            a, b = np.polyfit(
                self.energies[k - 1 : k + 2] - self.energies[k], self.cnr[k - 1 : k + 2], 2
            )[:2]
            if a < 0:
                return float(self.energies[k] - b / (2 * a))
        return float(self.energies[k])


@checked
def vmi_curve(
    first: ArrayLike,
    second: ArrayLike,
    covariance: ArrayLike,
    basis: Basis,
    energies_kev: ArrayLike = VMI_ENERGIES_KEV,
) -> VmiCurve:
    """Contrast, noise and CNR of two tissues against the energy of the VMI.

    Args:
        first, second: ``(2,)`` mean basis coefficients of the tissues.
        covariance: ``(3,)`` C₁₁, C₁₂, C₂₂ of the noise of the basis images, positive definite.
        basis, energies_kev: see :func:`vmi_weights`.

    Raises:
        ValueError: wrong shapes, a covariance that is not positive definite.
    """
    a, b, c = (np.asarray(v, np.float64) for v in (first, second, covariance))
    if a.shape != (2,) or b.shape != (2,) or c.shape != (3,):
        raise ValueError(
            "first and second must hold 2 coefficients, covariance 3 values, got the shapes "
            f"{a.shape}, {b.shape} and {c.shape}"
        )
    det = c[0] * c[2] - c[1] ** 2
    if not (c[0] > 0 and c[2] > 0 and det > 0):
        raise ValueError(f"covariance must be positive definite, packed as C11, C12, C22, got {c}")
    energies = np.atleast_1d(np.asarray(energies_kev, np.float64))
    d = a - b
    contrast = vmi_weights(basis, energies)[0] @ d
    noise = vmi_noise(c, basis, energies).numpy()
    limit = np.sqrt((c[2] * d[0] ** 2 - 2 * c[1] * d[0] * d[1] + c[0] * d[1] ** 2) / det)
    return VmiCurve(energies, contrast, noise, np.abs(contrast) / noise, float(limit))
