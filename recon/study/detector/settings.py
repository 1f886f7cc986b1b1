"""Settings of the detector study."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from recon.study.study import StudySettings
from torchpcct.validate import numbers

__all__ = ["Settings"]


@dataclass(frozen=True)
class Settings(StudySettings):
    """Settings of the detector study; the quick ones follow a fifth of the photons.

    Args:
        photons: photons followed through the detector per case, at least 1000.
        seed: of their random numbers.
        dead_times_ns: dead times looked at, ns (assumed; the merging time is half of each).
        charge_sharing: shares of split pulses looked at (assumed), in (0, 1].

    Raises:
        TypeError, ValueError: a value of the wrong kind or out of range.
    """

    photons: int = 200_000
    seed: int = 0
    dead_times_ns: tuple[float, ...] = (20.0, 50.0, 100.0)
    charge_sharing: tuple[float, ...] = (0.1, 0.2)

    QUICK: ClassVar = {"photons": 40_000}

    def __post_init__(self) -> None:
        self.check_whole(photons=1000, seed=0)
        numbers("dead_times_ns", self.dead_times_ns, positive=True, unit="ns")
        numbers("charge_sharing", self.charge_sharing, positive=True, high=1.0)
