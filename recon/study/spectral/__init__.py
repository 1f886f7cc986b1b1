"""The plaque in energy bins: ``scan`` (and tissue maps), ``calibration`` (wrong ones),
``measure`` (the study)."""

from recon.study.spectral.measure import SpectralSettings as SpectralSettings
from recon.study.spectral.measure import checks as checks
from recon.study.spectral.measure import figures as figures
from recon.study.spectral.measure import measure as measure
from recon.study.spectral.measure import plan as plan
