"""Filtered backprojection.

Read :mod:`~recon.fbp.fbp` (the whole in one call; as ``nn.Module``: :mod:`~recon.fbp.layer`), then
:mod:`~recon.fbp.ramp` (kernels), :mod:`~recon.fbp.filter_plan` (rows, from one window of columns to another),
:mod:`~recon.fbp.angular_weights` and :mod:`~recon.fbp.backproject`. CPU passes lie beside them in ``*_kernels``.
:mod:`~recon.fbp.detector_edges` completes offset detectors and rows that end inside the object;
:mod:`~recon.fbp.any_orbit` takes per-view vectors. :mod:`~recon.fbp.inset` is the FBP of a small inset of a scan, in HU
or in channels: what studies use. :mod:`~recon.fbp.exact_noise` gives its covariance without a single noisy scan.
"""
