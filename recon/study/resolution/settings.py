"""What the resolution study simulates and blurs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from recon.study.paper import facts as paper
from recon.study.study import StudySettings
from torchpcct.validate import number

__all__ = ["Settings"]


@dataclass(frozen=True)
class Settings(StudySettings):
    """Settings of the resolution study; it draws no noise.

    Args:
        thinning: simulate one view in so many (1: all); thinned views last as long as one of the complete scan.
        sigmas_px: standard deviations of the blur in pixels of 0.035 mm, from 0, rising.
        tolerance: relative error of lumen area and cap thickness that is accepted.
        bulges_mm: variants of the plaque for the test of what the core's segmentation hinges on: how far the vessel
            bulges, an assumption of ours that sets how much tissue lies between the core and the fat.
        exposure_s: of the PCCT in the comparison of CNRs; the EID-CT gets the same fluence at the isocentre.

    Raises:
        TypeError: a value of a wrong type.
        ValueError: a value out of range.
    """

    thinning: int = 1
    sigmas_px: tuple[float, ...] = tuple(1.25 * k for k in range(9))
    tolerance: float = 0.20
    bulges_mm: tuple[float, ...] = (0.425, 0.475, 0.5)
    exposure_s: float = paper.TABLE_EXPOSURE_S

    # An eighth of the views, one variant.
    QUICK: ClassVar[dict[str, Any]] = {"thinning": 8, "bulges_mm": (0.5,)}

    def __post_init__(self) -> None:
        self.check_whole(thinning=1)
        s = np.array(self.sigmas_px, dtype=np.float64)
        if s.size < 3 or s[0] != 0 or not (np.diff(s) > 0).all():
            raise ValueError(f"sigmas_px must rise from 0 in at least 3 values, got {self.sigmas_px}")
        if not 0 < self.tolerance < 1:
            raise ValueError(f"tolerance must lie between 0 and 1, got {self.tolerance}")
        number("exposure_s", self.exposure_s, positive=True, unit="s")
