"""Settings of the bowtie study."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from recon.study.paper import facts as paper
from recon.study.study import StudySettings
from torchpcct.validate import choice, number, numbers

__all__ = ["DETECTORS", "Settings"]

DETECTORS = ("eid", "silicon")


@dataclass(frozen=True)
class Settings(StudySettings):
    """Settings of the study; the quick ones: a quarter of the views, coarse maps, few photons.

    Args:
        exposure_s: of the scans for dose and noise, at 1000 mA.
        views: of the slices' scans.
        kernel: reconstruction kernel of the slices (the paper does not name it).
        realizations: of the slices' noise.
        detector: ``"eid"`` as the paper, or ``"silicon"``; see :func:`recon.study.bowtie.slices.wide_scanners`.
        map_mm: voxels of the thorax's dose map; that of the phantom has half of them, at least 1 mm.
        histories: photons of each Monte Carlo run; 0: no scatter.
        plaque_views: of the plaque's scans; fewer than the paper's keep the tube load.
        plaque_doses: exposures of the plaque's scans in s.
        plaque_realizations: paired realisations for MBIR; controlling them needs at least 8.
        seed: of the first realisation and of the Monte Carlo.

    Raises:
        ValueError, TypeError: a value out of range or of the wrong kind.
    """

    exposure_s: float = 0.35
    views: int = paper.FULL_VIEWS["PCCT"]
    kernel: str = "standard"
    realizations: int = 4
    detector: str = "eid"
    map_mm: float = 2.0
    histories: int = 2_000_000
    plaque_views: int = paper.FULL_VIEWS["PCCT"] // 2
    plaque_doses: tuple[float, ...] = (0.35, 2.0)
    plaque_realizations: int = 40
    seed: int = 0

    QUICK: ClassVar = {
        "views": 492, "realizations": 2, "map_mm": 6.0, "histories": 100_000,
        "plaque_views": 123, "plaque_doses": (2.0,), "plaque_realizations": 8,
    }  # fmt: skip

    def __post_init__(self) -> None:
        self.check_whole(views=8, realizations=2, histories=0, plaque_views=8, plaque_realizations=8, seed=0)
        if 0 < self.histories < 10_000:
            raise ValueError(f"histories must be 0 (no scatter) or at least 10000, got {self.histories}")
        number("exposure_s", self.exposure_s, positive=True, unit="s")
        number("map_mm", self.map_mm, positive=True, unit="mm")
        doses = numbers("plaque_doses", self.plaque_doses, positive=True, unit="s")
        object.__setattr__(self, "plaque_doses", doses)
        choice("detector", self.detector, DETECTORS)
