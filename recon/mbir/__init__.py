"""Model-based reconstruction with a learned prior.

Read :mod:`~recon.mbir.reconstruct` (from a scan to HU; whole fields of any scanner:
:mod:`~recon.mbir.field`), then :mod:`~recon.mbir.mbir` (from AᵀW y to HU, with the shipped
weights), :mod:`recon.data_term` (the data, in noise units), :mod:`~recon.mbir.unrolled` (data
steps and network in turn) and :mod:`~recon.mbir.network` (the learned prior).
:mod:`~recon.mbir.priors` says what may stand in that network's place: filters, denoisers, a network
of a user's own.
:mod:`~recon.mbir.known` says what may be drawn before, because it is known of the object
(:mod:`recon.vessel` draws a vessel). Weights, their model card and the record of their training lie
in ``weights``; :mod:`~recon.mbir.weights_io` reads them.
"""
