"""Reconstruction: FBP and model-based, from scans to volumes in HU.

Read :mod:`~recon.api` (one call for everything), then a method: :mod:`recon.fbp` (filtered backprojection),
:mod:`recon.pwls` (penalised least squares; its engine is :mod:`recon.gram`, AᵀWA by FFT), :mod:`recon.mbir` (unrolled
steps with a learned prior). Tools: :mod:`~recon.linear_operator`, :mod:`~recon.conjugate_gradient`. What any method can
reach at best and at worst: :mod:`~recon.limits`, :mod:`~recon.sensitivity`; what it has to beat:
:mod:`recon.evaluate`. Comparisons: :mod:`recon.study`.
"""

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

import torchpcct  # noqa: F401  (first: it settles how torch's threads wait)

if TYPE_CHECKING:
    from recon.api import METHODS, reconstruct
    from recon.fbp.fbp import fbp
    from recon.pwls.pwls import pwls

__all__ = ["METHODS", "fbp", "pwls", "reconstruct"]

_SOURCES = {"fbp": "recon.fbp.fbp", "pwls": "recon.pwls.pwls", "METHODS": "recon.api", "reconstruct": "recon.api"}


def _lazy(name: str) -> property:
    """A name of another module, which loads (torch, numba) when the name is first used."""
    return property(
        lambda module: getattr(importlib.import_module(_SOURCES[name]), name),
        # The functions deliberately take the place of the packages of the same name, ``recon.fbp(sinogram, …)`` and
        # ``recon.pwls(A, y, weights, prior, …)``: the import system's own assignment of the package has no effect.
        lambda module, value: None,
    )


class _Recon(ModuleType):
    fbp, pwls, METHODS, reconstruct = (_lazy(name) for name in _SOURCES)

    def __dir__(self) -> list[str]:
        return sorted({*super().__dir__(), *_SOURCES})


def _become_lazy(module: Any) -> None:
    module.__class__ = _Recon


_become_lazy(sys.modules[__name__])
