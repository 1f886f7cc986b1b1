"""Penalised weighted least squares with a q-GGMRF prior, to the exact minimum.

Read :mod:`~recon.pwls.inset_problem` (from a scan to HU; surround unknown: :mod:`~recon.pwls.surround`; whole field:
:mod:`~recon.pwls.field_problem`), then :mod:`~recon.pwls.pwls` (exact pairs; steps proposed by
:mod:`~recon.pwls.model_solver` for an inset, by :mod:`~recon.pwls.field_model` for a whole field; stopped by
:mod:`~recon.pwls.approach`; :mod:`~recon.pwls.memory` first) and the prior, :mod:`~recon.pwls.qggmrf` (CPU passes
beside it in ``qggmrf_kernels``).
Two channels with correlated noise: :mod:`~recon.pwls.basis_problem` (from a spectral scan to basis images),
:mod:`~recon.pwls.joint`, :mod:`~recon.pwls.whitening`.
"""
