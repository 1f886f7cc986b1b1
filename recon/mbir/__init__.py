"""Model-based reconstruction with a learned prior.

Read :mod:`~recon.mbir.mbir` (from a scan to HU), then :mod:`~recon.mbir.unrolled` (the steps), and what they descend:
:mod:`~recon.mbir.prior` (learned), :mod:`~recon.mbir.along_vessel` (by hand). :mod:`~recon.mbir.minimise` goes on to
the end and certifies it. Weights and their training card lie in ``weights``; :mod:`~recon.mbir.weights_io` reads them.
"""
