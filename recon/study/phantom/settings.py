"""Settings of the phantom study."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from recon.study.paper import facts as paper
from recon.study.study import StudySettings
from torchpcct.validate import number, numbers

__all__ = ["Settings"]


@dataclass(frozen=True)
class Settings(StudySettings):
    """Settings of the study; the quick ones take a raster four times as coarse.

    Args:
        voxel_mm: of the raster that is measured [paper: 0.021].
        sections: of the vessel beyond the plaque, on which diameter, wall and place are measured.
        energies_kev: of the monochromatic CT numbers.

    Raises:
        TypeError, ValueError: a value of the wrong kind or out of range.
    """

    voxel_mm: float = paper.PHANTOM_VOXEL_MM
    sections: int = 5
    energies_kev: tuple[float, ...] = (55.0, 60.0, 63.0, 64.0, 65.0, 70.0)

    QUICK: ClassVar = {"voxel_mm": 4 * paper.PHANTOM_VOXEL_MM}

    def __post_init__(self) -> None:
        self.check_whole(sections=1)
        number("voxel_mm", self.voxel_mm, low=0.005, high=0.1, unit="mm")
        energies = numbers("energies_kev", self.energies_kev, low=20.0, high=150.0, unit="keV")
        object.__setattr__(self, "energies_kev", energies)
