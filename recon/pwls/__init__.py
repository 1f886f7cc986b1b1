"""Penalised weighted least squares with a q-GGMRF prior, to the exact minimum.

Read :mod:`~recon.pwls.inset_problem` (from a scan to HU), then :mod:`~recon.pwls.pwls` (exact pairs around
:mod:`~recon.pwls.model_solver`) and the prior, :mod:`~recon.pwls.qggmrf` (CPU passes beside it in ``qggmrf_kernels``).
Two channels with correlated noise: :mod:`~recon.pwls.basis_problem` (from a spectral scan to basis images),
:mod:`~recon.pwls.joint`, :mod:`~recon.pwls.whitening`.
"""
