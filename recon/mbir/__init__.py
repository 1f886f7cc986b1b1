"""Model-based reconstruction with a learned prior.

Read :mod:`~recon.mbir.reconstruct` (from scans to HU; what differs between an inset and a whole
field is in :mod:`~recon.mbir.inset` and :mod:`~recon.mbir.field`), then :mod:`~recon.mbir.mbir`
(from a data term to HU, with the shipped weights), :mod:`recon.data_term` (the data, in noise
units), :mod:`~recon.mbir.unrolled` (data steps and network in turn) and
:mod:`~recon.mbir.network` (the learned prior).
:mod:`~recon.mbir.priors` says what may stand in that network's place: filters, denoisers, a network
of a user's own.
:mod:`~recon.mbir.known` is what may be modelled before, because it is known of the object
(:mod:`recon.vessel` models a vessel). Weights, their model card and the record of their training
lie in ``weights``; :mod:`~recon.mbir.weights_io` reads them.
"""
