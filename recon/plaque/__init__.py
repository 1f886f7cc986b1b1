"""Reading a vessel by its tissues: outlines, tissue values and plaque bodies as unknowns, each with
an interval.

Opt-in: for a contrast-enhanced vessel with a plaque, not for looking at images. A tissue's value is
then an average over all of the tissue instead of over a small ROI, and its uncertainty holds that
of the outlines.

:mod:`~recon.plaque.reading` does all of it (:func:`~recon.plaque.reading.read_plaque`). Below it,
in the order of the data: :mod:`~recon.plaque.data` (statistic and operator of a scan),
:mod:`~recon.plaque.start` and :mod:`~recon.plaque.centreline` (where the vessel is),
:mod:`~recon.plaque.vessel_prior`, :mod:`~recon.plaque.outline` and :mod:`~recon.plaque.vessel` (its
model and fit), :mod:`~recon.plaque.core` and :mod:`~recon.plaque.particles` (plaque bodies),
:mod:`~recon.plaque.layer` (what the fibrous layer holds, linearly), :mod:`~recon.plaque.figures`
(draws of what is reported), :mod:`~recon.plaque.quality` (misfit, texture),
:mod:`~recon.plaque.beside` (FBP's noise over the same regions), :mod:`~recon.plaque.report` (text,
files, picture). What makes it fast: :mod:`~recon.plaque.local_gram` and
:mod:`~recon.plaque.kernels`.
"""

from recon.plaque.data import TissueData
from recon.plaque.figures import Estimate
from recon.plaque.reading import PlaqueReading, read_plaque
from recon.plaque.vessel_prior import VesselPrior

__all__ = ["Estimate", "PlaqueReading", "TissueData", "VesselPrior", "read_plaque"]
