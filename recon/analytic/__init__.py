"""Filtered backprojection.

Read :mod:`~recon.analytic.fbp` (the whole in one call, also as ``nn.Module``), then
:mod:`~recon.analytic.ramp` (kernels), :mod:`~recon.analytic.filter_plan` (rows, from one window of
columns to another), :mod:`~recon.analytic.angular_weights` and :mod:`~recon.analytic.backproject`.
CPU passes lie beside them in ``*_kernels``. :mod:`~recon.analytic.detector_edges` completes offset
detectors and rows that end inside the object; :mod:`~recon.analytic.any_orbit` takes per-view
vectors. :mod:`~recon.analytic.inset` is the FBP of a small inset of a scan, in HU or in channels:
what studies use. :mod:`~recon.analytic.exact_noise` gives its covariance without a single noisy
scan.
"""
