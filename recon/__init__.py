"""Reconstruction: FBP and model-based, from scans to volumes in HU.

Read :mod:`~recon.api` (one call for everything), then a method: :mod:`recon.fbp` (filtered backprojection),
:mod:`recon.pwls` (penalised least squares; its engine is :mod:`recon.gram`, AᵀWA by FFT), :mod:`recon.mbir` (unrolled
steps with a learned prior). Tools: :mod:`~recon.linear_operator`, :mod:`~recon.conjugate_gradient`. What any method can
reach at best and at worst: :mod:`~recon.limits`, :mod:`~recon.sensitivity`. Comparisons: :mod:`recon.study`.
"""

import torchpcct  # noqa: F401  (first: it settles how the thread pools of numba and torch wait)

# The functions deliberately take the place of the packages of the same name: ``recon.fbp(sinogram, …)``,
# ``recon.pwls(A, y, weights, prior, …)``.
from recon.fbp.fbp import fbp  # isort: skip
from recon.pwls.pwls import pwls  # isort: skip
from recon.api import METHODS, reconstruct

__all__ = ["METHODS", "fbp", "pwls", "reconstruct"]
