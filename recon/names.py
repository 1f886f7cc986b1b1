"""Names of methods and of kernels, which can be checked before anything that computes is loaded."""

__all__ = ["KERNELS", "METHODS"]

METHODS: tuple[str, ...] = ("fbp", "pwls", "mbir")
"""Of :func:`recon.reconstruct`."""

KERNELS: tuple[str, ...] = ("soft", "standard", "detail", "bone", "ram-lak")
"""Reconstruction kernels of filtered backprojection, from smooth to sharp (:mod:`recon.analytic.ramp`)."""
