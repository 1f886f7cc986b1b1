"""The noise study: FBP of the plaque with every kernel, voxel size and dose, and what the paper's tables establish.

The ROI means of FBP are inner products of the line integrals with adjoint vectors (:mod:`recon.analytic.exact_noise`).
So their joint covariance is exact, and hundreds of realisations cost one noisy scan each instead of a reconstruction
per kernel and voxel size; a few are reconstructed in full beside, which must give the same ROI means.

Read ``settings``, ``few_runs`` (what a few realisations establish about a table), ``claims`` (what the paper concludes
from its tables), ``measure`` with ``equal_dose`` (the energy-integrating scan), then ``ranking`` and ``report``, which
ask the claims, and ``figures``.
"""
