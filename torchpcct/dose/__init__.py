"""Absorbed dose in axial slices of a scene: primary photons exactly, scattered ones by Monte Carlo,
CTDI figures.

Reading order: ``coefficients`` (energy absorption, and the fluence that reaches the object) →
``primary`` (exact paths from the focal spot) → ``scatter`` with ``transport_kernels`` (photon
histories) → ``ctdi``, the figures of a standard phantom.
"""

from torchpcct.dose.coefficients import air_fluence, mass_energy_absorption
from torchpcct.dose.ctdi import CtdiDose, ctdi_dose
from torchpcct.dose.primary import primary_dose
from torchpcct.dose.scatter import MonteCarloDose, monte_carlo_dose

__all__ = [
    "CtdiDose",
    "MonteCarloDose",
    "air_fluence",
    "ctdi_dose",
    "mass_energy_absorption",
    "monte_carlo_dose",
    "primary_dose",
]
