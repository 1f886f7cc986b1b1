"""Two basis materials, in which every body material is written: μ(E) = a₁ μ₁(E) + a₂ μ₂(E).

Between two absorption edges the attenuation of all elements is nearly a combination of two
functions of energy (Alvarez and Macovski 1976: photoelectric absorption and Compton scattering),
and the attenuation of any two different materials spans the same plane. Li et al. choose
polyethylene (PE) and polyvinyl chloride (PVC). A coefficient is dimensionless (the density is in
it: half as dense means half the coefficients), its line integral is a length in mm. Iodine has its
K edge at 33.2 keV, inside the spectrum, so blood with contrast agent is only approximated;
:meth:`Basis.residual` says by how much.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchpcct.scene.materials import Material, material
from torchpcct.validate import checked

__all__ = ["Basis", "pe_pvc"]

Floats = NDArray[np.float64]

FIT_ENERGIES_KEV = tuple(float(e) for e in range(40, 141))
"""Energies at which materials are fitted unless others are given: those of the virtual
monochromatic images."""


@dataclass(frozen=True)
class Basis:
    """Two materials that span the attenuation of all others.

    Args:
        first, second: the basis materials.

    Raises:
        TypeError: not a :class:`~torchpcct.scene.materials.Material`.
        ValueError: attenuations that are proportional to each other, which span a line instead of a
            plane.
    """

    first: Material
    second: Material

    def __post_init__(self) -> None:
        for m in (self.first, self.second):
            if not isinstance(m, Material):
                raise TypeError(
                    f"a basis needs two Material objects, got {m!r}: use material('polyethylene')"
                )
        mu = self.attenuation((40.0, 60.0, 80.0))
        ratio = mu[0] / mu[1]
        if np.ptp(ratio) < 1e-3 * ratio.mean():
            raise ValueError(
                f"{self.first.name!r} and {self.second.name!r} attenuate alike at every energy: "
                "choose basis materials of different atomic numbers, such as polyethylene and pvc"
            )

    @property
    def names(self) -> tuple[str, str]:
        """Names of the two materials."""
        return self.first.name, self.second.name

    def attenuation(self, energies_kev: ArrayLike) -> Floats:
        """Linear attenuation coefficients of the two basis materials.

        Args:
            energies_kev: photon energies, ``(...)``.

        Returns:
            μ₁ and μ₂ in mm⁻¹, ``(2, ...)`` float64.

        Raises:
            ValueError: energies outside 1 … 500 keV.
        """
        return np.stack(
            [self.first.attenuation(energies_kev), self.second.attenuation(energies_kev)]
        )

    def coefficients(
        self,
        of: Material | str,
        energies_kev: ArrayLike = FIT_ENERGIES_KEV,
        weights: ArrayLike = 1.0,
    ) -> Floats:
        """The basis coefficients of a material at its own density.

        Weighted least squares of the *relative* error of μ, so that every energy counts alike.

        Args:
            of: the material, or the name of a built-in one.
            energies_kev: ``(E,)`` energies of the fit in keV, at least two.
            weights: ≥ 0, ``(E,)`` or one number, e.g. the detected spectrum.

        Returns:
            ``(2,)`` float64, dimensionless.

        Raises:
            ValueError: fewer than two energies of positive weight, a negative or non-finite weight.
        """
        energies = np.atleast_1d(np.asarray(energies_kev, np.float64))
        w = np.broadcast_to(np.asarray(weights, np.float64), energies.shape)
        if not (np.isfinite(w).all() and (w >= 0).all() and (w > 0).sum() >= 2):
            raise ValueError(
                "a fit of two coefficients needs weights ≥ 0, positive at two energies or more, "
                f"got {weights!r}"
            )
        target = (material(of) if isinstance(of, str) else of).attenuation(energies)
        root = np.sqrt(w)
        rows = (self.attenuation(energies) / target).T * root[:, None]
        return np.asarray(np.linalg.lstsq(rows, root, rcond=None)[0])

    def mu(self, coefficients: ArrayLike, energies_kev: ArrayLike) -> Floats:
        """Attenuation in mm⁻¹ from coefficients.

        Args:
            coefficients: ``(2, ...)``.
            energies_kev: ``(E,)`` or one energy, in keV.

        Returns:
            ``(E, ...)``, or ``(...)`` for one energy, float64.
        """
        c = np.asarray(coefficients, np.float64)
        if c.ndim == 0 or c.shape[0] != 2:
            raise ValueError(
                f"coefficients must have 2 entries on their first axis, got the shape {c.shape}"
            )
        return np.asarray(np.tensordot(self.attenuation(energies_kev).T, c, axes=1))

    def residual(
        self, of: Material | str, energies_kev: ArrayLike = FIT_ENERGIES_KEV, **fit: ArrayLike
    ) -> Floats:
        """What the basis cannot express of a material, in HU at each energy: ``(E,)``, fit less
        exact.

        Args:
            of, energies_kev: the material and the energies in keV to evaluate at.
            **fit: ``energies_kev`` and ``weights`` of the fit, see :meth:`coefficients`.
        """
        exact = (material(of) if isinstance(of, str) else of).attenuation(energies_kev)
        error = self.mu(self.coefficients(of, **fit), energies_kev) - exact
        return np.asarray(1000.0 * error / material("water").attenuation(energies_kev))


@checked
def pe_pvc() -> Basis:
    """Polyethylene (0.93 g/cm³) and rigid PVC (1.37 g/cm³), the basis of Li et al. (densities
    assumed)."""
    return Basis(material("polyethylene"), material("pvc"))
