"""Settings of the hard cases."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from recon.study.hardcases.cases import CASES
from recon.study.study import StudySettings
from torchpcct.validate import choice, number

__all__ = ["Settings"]


@dataclass(frozen=True)
class Settings(StudySettings):
    """Settings of the hard cases; the quick ones have an eighth of the views, FBP alone, every case.

    Args:
        views: of the plaque's scan that is made hard, at least 120.
        exposure_s: its exposure in s.
        voxel_mm: voxel size of its inset.
        seed: of the noise, and of what is broken at random.
        methods: of :func:`recon.reconstruct`; ``"tissues"``: MBIR with them, of some scans of the plaque.
        cases: names of :data:`recon.study.hardcases.cases.CASES`.

    Raises:
        TypeError, ValueError: a value of the wrong kind or out of range; an unknown case.
    """

    views: int = 360
    exposure_s: float = 2.0
    voxel_mm: float = 0.4
    seed: int = 0
    methods: tuple[str, ...] = ("fbp", "pwls", "mbir", "tissues")
    cases: tuple[str, ...] = tuple(CASES)

    QUICK: ClassVar = {"views": 120, "methods": ("fbp",)}

    def __post_init__(self) -> None:
        self.check_whole(views=120, seed=0)
        number("exposure_s", self.exposure_s, positive=True, unit="s")
        number("voxel_mm", self.voxel_mm, positive=True, unit="mm")
        for name in ("methods", "cases"):
            if isinstance(getattr(self, name), str) or not getattr(self, name):
                raise ValueError(f"{name} must be one name or more, got {getattr(self, name)!r}")
        for name in self.cases:
            choice("case", name, CASES)
