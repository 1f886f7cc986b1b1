"""The plaque in energy bins: ``scan`` (and tissue maps), ``calibration`` (wrong ones),
``measure`` (the study)."""

from recon.study.spectral.measure import Settings, checks, figures, measure

__all__ = ["Settings", "checks", "figures", "measure"]
