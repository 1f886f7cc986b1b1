"""AᵀWA of a small inset by FFT: what solvers, limits and training use in place of projections.

Read :mod:`~recon.gram.gram` (the operator), then :mod:`~recon.gram.impulse_response` (what it is
fitted to), and :mod:`~recon.gram.kernels` (banded matrices, CPU).
"""
