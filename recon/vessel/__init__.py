"""Reading a vessel by its tissues: outlines, tissue values and plaque bodies as unknowns, each with
an interval.

An application of :mod:`recon.mbir` and of the operator of an inset, which know nothing of it.
Opt-in: for a contrast-enhanced vessel with a plaque, not for looking at images. A tissue's value is
then an average over all of the tissue instead of over a small ROI, and its uncertainty holds that
of the outlines.

:mod:`~recon.vessel.reading` does all of it (:func:`~recon.vessel.reading.read_plaque`). Below it,
in the order of the data: :mod:`~recon.vessel.data` (the data term in HU),
:mod:`~recon.vessel.start` and :mod:`~recon.vessel.centreline` (where the vessel is),
:mod:`~recon.vessel.prior`, :mod:`~recon.vessel.outline` and :mod:`~recon.vessel.model` (its model
and fit), :mod:`~recon.vessel.core` and :mod:`~recon.vessel.particles` (plaque bodies),
:mod:`~recon.vessel.layer` (what the fibrous layer holds, linearly), :mod:`~recon.vessel.figures`
(draws of what is reported), :mod:`~recon.vessel.quality` (misfit, texture),
:mod:`~recon.vessel.fbp_noise` (FBP's noise over the same regions), :mod:`~recon.vessel.report`
(text, files, picture). What makes it fast: :mod:`~recon.vessel.local_gram` and
:mod:`~recon.vessel.kernels`. :mod:`~recon.vessel.known` gives MBIR the outlines or the tissues to
reconstruct the rest around.
"""

from recon.vessel.figures import TissueEstimate
from recon.vessel.prior import VesselPrior
from recon.vessel.reading import PlaqueReading, read_plaque

__all__ = ["PlaqueReading", "TissueEstimate", "VesselPrior", "read_plaque"]
