"""What the comparison runs over."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

from recon.study.paper import facts as paper
from recon.study.study import StudySettings

__all__ = ["Settings"]


@dataclass(frozen=True)
class Settings(StudySettings):
    """Settings of the comparison.

    Args:
        realizations: noise realisations per dose (paper: 10), at least 3 for an interval, 5 for MBIR.
        seed: first seed.
        views: views per rotation. Fewer than the paper's keep the tube load of the whole scan.
        kernels, voxels_mm, doses: the axes of the tables.
        pwls: whether to run PWLS; pwls_s: exposures at which it is run, those of ``doses``.
        mbir: whether to run MBIR, and with it the dose factors; mbir_s: exposures, those of ``doses``.
        low_dose_draws: realisations of MBIR at the lowest of its exposures, at least ``realizations``: its figures vary
            most there. The tables have the first ``realizations``.
        control: whether MBIR's figures are controlled by a linear functional of the same noise, which is worth its time
            from 8 realisations.
        response_draws: of noise that this functional is averaged over (:mod:`recon.study.dose_factor.response`).
        placements: whether the checks outside their tolerance are computed again with ROIs and grid moved.

    Raises:
        ValueError, TypeError: a count out of range, or none; too few realisations for MBIR.
    """

    realizations: int = paper.REALIZATIONS
    seed: int = 0
    views: int = paper.FULL_VIEWS["PCCT"]
    kernels: tuple[str, ...] = paper.KERNELS
    voxels_mm: tuple[float, ...] = paper.VOXELS_MM
    doses: dict[str, float] = field(default_factory=lambda: dict(paper.DOSES))
    pwls: bool = True
    pwls_s: tuple[float, ...] = (0.35, 2.00)
    mbir: bool = True
    mbir_s: tuple[float, ...] = (0.35, 0.70, 2.00)
    low_dose_draws: int = 20
    control: bool = True
    response_draws: int = 4
    placements: bool = True

    # An eighth of the views, two kernels, two voxel sizes, two doses, 8 realisations, no PWLS: ≤ 45 s.
    QUICK: ClassVar[Mapping[str, Any]] = {
        "realizations": 8,
        "views": 246,
        "kernels": ("soft", "standard"),
        "voxels_mm": (0.25, 0.40),
        "doses": {"1x": 0.35, "5.7x": 2.00},
        "pwls": False,
        "mbir_s": (0.35, 2.00),
        "low_dose_draws": 8,
        "response_draws": 0,
        "placements": False,
    }

    def __post_init__(self) -> None:
        self.check_whole(realizations=3, low_dose_draws=0, response_draws=0, seed=0, views=8)
        least = (8 if self.control else 5) if self.mbir else 3
        if self.realizations < least:
            raise ValueError(
                f"realizations must be at least {least} for MBIR{' with control' if self.control else ''}, got "
                f"{self.realizations}: set mbir=False{', or control=False from 5' if self.control else ''}"
            )

    def mbir_draws(self, exposure_s: float) -> int:
        """Realisations of MBIR at an exposure; 0: none."""
        own = self.exposures(self.mbir_s) if self.mbir else ()
        if exposure_s not in own:
            return 0
        return max(self.realizations, self.low_dose_draws) if exposure_s == min(own) else self.realizations

    def exposures(self, wanted: tuple[float, ...]) -> tuple[float, ...]:
        """Those of ``wanted`` that are among the doses."""
        return tuple(e for e in self.doses.values() if e in wanted)
