"""Filtered backprojection.

Read :mod:`~recon.fbp.fbp` (the whole in one call), then :mod:`~recon.fbp.ramp` (kernels), :mod:`~recon.fbp.filter_plan`
(rows, from one window of columns to another), :mod:`~recon.fbp.angular_weights`, :mod:`~recon.fbp.backproject`,
:mod:`~recon.fbp.inset` (a small inset of a scan: what studies use) and :mod:`~recon.fbp.exact_noise` (its covariance).
"""
