"""Absorbed dose in axial slices of a scene: primary photons exactly, scattered ones by Monte Carlo, CTDI figures."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchpcct.dose.coefficients import air_fluence, mass_energy_absorption
    from torchpcct.dose.ctdi import CtdiDose, ctdi_dose
    from torchpcct.dose.primary import primary_dose
    from torchpcct.dose.scatter import MonteCarloDose, monte_carlo_dose

_HOME = {
    "CtdiDose": "ctdi",
    "MonteCarloDose": "scatter",
    "air_fluence": "coefficients",
    "ctdi_dose": "ctdi",
    "mass_energy_absorption": "coefficients",
    "monte_carlo_dose": "scatter",
    "primary_dose": "primary",
}

__all__ = [
    "CtdiDose",
    "MonteCarloDose",
    "air_fluence",
    "ctdi_dose",
    "mass_energy_absorption",
    "monte_carlo_dose",
    "primary_dose",
]


def __getattr__(name: str) -> Any:
    # The kernels need numba: loaded on first use.
    if name in _HOME:
        from importlib import import_module

        return getattr(import_module(f"torchpcct.dose.{_HOME[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
