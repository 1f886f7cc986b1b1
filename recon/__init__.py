"""Reconstruction: FBP and model-based, from scans to volumes in HU.

Read :mod:`~recon.api` (one call for everything), then a method: :mod:`recon.analytic` (filtered
backprojection), :mod:`recon.least_squares` (PWLS; its engine is :mod:`recon.gram`, AᵀWA by FFT),
:mod:`recon.mbir` (unrolled steps with a learned prior). All that PWLS and MBIR see of a scan is
its :mod:`~recon.data_term`; each method gives :mod:`~recon.result`. Tools:
:mod:`~recon.conjugate_gradient`, :mod:`~recon.filters` of a volume.
A geometry from the object itself: :mod:`recon.calibration`; the motion of an inset from its own
scan: :mod:`recon.motion`. What a method has to beat:
:mod:`recon.evaluate`. Comparisons: :mod:`recon.study`.
"""

import importlib
from typing import TYPE_CHECKING

import torchpcct  # noqa: F401  (first: it settles how torch's threads wait)

if TYPE_CHECKING:
    from recon.analytic.fbp import fbp
    from recon.api import reconstruct
    from recon.calibration import calibrate
    from recon.least_squares.pwls import pwls
    from recon.names import METHODS

__all__ = ["METHODS", "calibrate", "fbp", "pwls", "reconstruct"]

_SOURCES = {
    "calibrate": "recon.calibration",
    "fbp": "recon.analytic.fbp",
    "pwls": "recon.least_squares.pwls",
    "METHODS": "recon.names",
    "reconstruct": "recon.api",
}
"""Where the names of the package come from, at their first use."""


def __getattr__(name: str) -> object:
    """Public names load their module (torch, numba) when they are first used."""
    if name not in _SOURCES:
        raise AttributeError(f"module 'recon' has no attribute {name!r}")
    return getattr(importlib.import_module(_SOURCES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_SOURCES})
