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
        realizations: noise realisations of FBP per dose (paper: 10), at least 3 for an interval.
        seed: first seed.
        views: views per rotation. Fewer than the paper's keep the tube load of the whole scan.
        kernels, voxels_mm, doses: the axes of the tables.
        methods: measured against FBP (:func:`recon.evaluate.evaluate`, task ``plaque``); none: the tables alone.
        method_s: exposures of these; method_draws: their realisations, at least 8.
        placements: whether the checks outside their tolerance are computed again with ROIs and grid moved.

    Raises:
        ValueError, TypeError: a count out of range, or none.
    """

    realizations: int = paper.REALIZATIONS
    seed: int = 0
    views: int = paper.FULL_VIEWS["PCCT"]
    kernels: tuple[str, ...] = paper.KERNELS
    voxels_mm: tuple[float, ...] = paper.VOXELS_MM
    doses: dict[str, float] = field(default_factory=lambda: dict(paper.DOSES))
    methods: tuple[str, ...] = ("pwls", "bilateral@fbp:detail", "mbir")
    method_s: tuple[float, ...] = (0.35, 2.00)
    method_draws: int = 16
    placements: bool = True

    # An eighth of the views, two kernels, two voxel sizes, two doses, 8 realisations, no PWLS: ≤ 45 s.
    QUICK: ClassVar[Mapping[str, Any]] = {
        "realizations": 8,
        "views": 246,
        "kernels": ("soft", "standard"),
        "voxels_mm": (0.25, 0.40),
        "doses": {"1x": 0.35, "5.7x": 2.00},
        "methods": ("bilateral@fbp:detail", "mbir"),
        "method_draws": 8,
        "placements": False,
    }

    def __post_init__(self) -> None:
        self.check_whole(realizations=3, method_draws=8 if self.methods else 0, seed=0, views=8)
