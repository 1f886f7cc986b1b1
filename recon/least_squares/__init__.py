"""Penalised weighted least squares with a q-GGMRF prior, to the exact minimum.

Read :mod:`~recon.least_squares.reconstruct` (from a scan to HU) and what it gets of a scan:
:mod:`~recon.least_squares.inset_problem` (exterior unknown: :mod:`~recon.least_squares.exterior`)
or :mod:`~recon.least_squares.field_problem` (whole field); then :mod:`~recon.least_squares.pwls`
(exact pairs; steps proposed by :mod:`~recon.least_squares.model_solver` for an inset, by
:mod:`~recon.least_squares.field_model` for a whole field; :mod:`~recon.least_squares.memory` first)
and the prior, :mod:`~recon.least_squares.qggmrf` (CPU passes beside it in ``qggmrf_kernels``). Two
channels with correlated noise: :mod:`~recon.least_squares.basis_problem` (from a spectral scan to
basis images).
"""
