"""Settings of the spectral study."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import ClassVar

from recon.study.paper import facts as paper
from recon.study.study import StudySettings
from torchpcct.validate import number

__all__ = ["Settings"]


@dataclass(frozen=True)
class Settings(StudySettings):
    """Settings of the study; the quick ones take an eighth of the views and one realisation.

    Args:
        exposure_s: of the standard noise (the paper does not state it; 2.0 s is the exposure of its tables).
        realizations: of the noise, for tissue maps by FBP.
        mbir_realizations: of these, how many are reconstructed by joint MBIR at every noise level; 0: none.
        noise_levels: shares of the standard noise, ascending, 0 first.
        views: per rotation.
        voxel_mm: [paper: 0.2].
        kernel: of FBP (the paper names none for its spectral images).
        starved_rays: number of rays from no counts to air that the decomposition is tried on.
        seed: first seed of the noise.

    Raises:
        TypeError, ValueError: a value of the wrong kind or out of range.
    """

    exposure_s: float = 2.0
    realizations: int = 4
    mbir_realizations: int = 2
    noise_levels: tuple[float, ...] = (0.0, 0.25, 0.5, 1.0)
    views: int = paper.FULL_VIEWS["PCCT"]
    voxel_mm: float = 0.2
    kernel: str = "standard"
    starved_rays: int = 20_000
    seed: int = 0

    QUICK: ClassVar = {"views": 246, "realizations": 1, "mbir_realizations": 1, "starved_rays": 5000}

    def __post_init__(self) -> None:
        number("exposure_s", self.exposure_s, positive=True, unit="s")
        number("voxel_mm", self.voxel_mm, positive=True, unit="mm")
        self.check_whole(realizations=1, mbir_realizations=0, views=60, starved_rays=100, seed=0)
        if self.mbir_realizations > self.realizations:
            raise ValueError(
                f"mbir_realizations must lie in 0…{self.realizations} (realizations), got {self.mbir_realizations}"
            )
        levels = self.noise_levels
        if not levels or levels[0] != 0 or any(b <= a for a, b in itertools.pairwise(levels)):
            raise ValueError(f"noise_levels must ascend from 0, got {levels}")
