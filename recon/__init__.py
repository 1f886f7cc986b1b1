"""Reconstruction: FBP and model-based, from scans to volumes in HU."""

import torchpcct  # noqa: F401  (first: it settles how the thread pools of numba and torch wait)

# The function deliberately takes the place of the submodule of the same name: ``recon.fbp(sinogram, …)``.
from recon.fbp.fbp import fbp  # isort: skip
from recon.api import METHODS, reconstruct

__all__ = ["METHODS", "fbp", "reconstruct"]
