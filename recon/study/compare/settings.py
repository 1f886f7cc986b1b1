"""What the comparison runs over."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from recon.study.paper import facts as paper
from recon.study.study import StudySettings
from torchpcct.validate import numbers

__all__ = ["Settings"]


@dataclass(frozen=True)
class Settings(StudySettings):
    """Settings of the comparison.

    Args:
        methods: what is measured, see :mod:`recon.evaluate.methods`.
        n: noise realisations of each, at least 8.
        seed: of the first.
        views: views per rotation.
        exposures_s: of the scans in s.

    Raises:
        ValueError, TypeError: a count out of range, or none.
    """

    methods: tuple[str, ...] = (
        "fbp:soft", "fbp:standard", "fbp:detail", "fbp:bone", "pwls", "bilateral@fbp:detail", "mbir"
    )  # fmt: skip
    n: int = 16
    seed: int = 0
    views: int = paper.FULL_VIEWS["PCCT"]
    exposures_s: tuple[float, ...] = (0.35, 2.0)

    # An eighth of the views, 8 realisations, no PWLS: ≤ 45 s.
    QUICK: ClassVar[Mapping[str, Any]] = {"views": 246, "n": 8, "methods": ("fbp:soft", "bilateral@fbp:detail", "mbir")}

    def __post_init__(self) -> None:
        self.check_whole(n=8, seed=0, views=8)
        numbers("exposures_s", self.exposures_s, positive=True, unit="s")
        if not self.methods:
            raise ValueError("methods must name at least one method")
