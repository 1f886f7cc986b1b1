"""What every method makes of hard scans: ``cases`` (what is done to them) → ``measure``."""

from recon.study.hardcases.measure import HardcasesSettings as HardcasesSettings
from recon.study.hardcases.measure import figures as figures
from recon.study.hardcases.measure import measure as measure
from recon.study.hardcases.measure import plan as plan
