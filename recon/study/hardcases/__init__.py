"""What every method makes of hard scans: ``cases`` (what is done to them) → ``measure``."""

from recon.study.hardcases.measure import Settings, figures, measure

__all__ = ["Settings", "figures", "measure"]
