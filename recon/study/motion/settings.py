"""What the motion study simulates and reconstructs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from recon.study.paper import facts as paper
from recon.study.study import StudySettings
from torchpcct.scene.motion import SinusoidalMotion
from torchpcct.validate import number

__all__ = ["METHODS", "Settings"]

METHODS = {"fbp": "FBP", "pwls": "q-GGMRF PWLS", "mbir": "MBIR (learned prior)"}


@dataclass(frozen=True)
class Settings(StudySettings):
    """Settings of the motion study.

    Args:
        thinning: simulate one view in so many (1: all); thinned views last as long as one of the complete scan.
        amplitude_mm: of the whole motion.
        rate_bpm: beats per minute.
        rotation_s: time of one turn.
        direction: of the motion in the axial plane, rad from +x, the side of the plaque [assumed].
        fractions: residual motions of the PCCT, of the whole one.
        eid_fractions: residual motions of the EID-CT; those that the PCCT has too are compared.
        errors: errors of the amplitude that the compensation assumes, of the whole one.
        voxel_mm: of all volumes.
        exposure_s: of the noisy reconstructions.
        seed, realizations: of their noise; realisation i uses ``seed + i``.
        methods: of the compensation, of :data:`METHODS`.

    Raises:
        TypeError: a value of a wrong type.
        ValueError: a value out of range, an unknown method.
    """

    thinning: int = 1
    amplitude_mm: float = 2.0
    rate_bpm: float = 60.0
    rotation_s: float = paper.ROTATION_S
    direction: float = 0.0
    fractions: tuple[float, ...] = paper.MOTION["fractions"]
    eid_fractions: tuple[float, ...] = paper.MOTION["eid_fractions"]
    errors: tuple[float, ...] = (0.05, 0.10, 0.20, 0.40)
    voxel_mm: float = 0.2
    exposure_s: float = paper.TABLE_EXPOSURE_S
    seed: int = 0
    realizations: int = 2
    methods: tuple[str, ...] = tuple(METHODS)

    # An eighth of the views, four residual motions, one error of the estimate, no PWLS.
    QUICK: ClassVar[dict[str, Any]] = {
        "thinning": 8,
        "fractions": (0.1, 0.4, 0.6, 1.0),
        "errors": (0.10,),
        "realizations": 1,
        "methods": ("fbp", "mbir"),
    }

    def __post_init__(self) -> None:
        self.check_whole(thinning=1, realizations=1, seed=0)
        for name in ("amplitude_mm", "rate_bpm", "rotation_s", "voxel_mm", "exposure_s"):
            number(name, getattr(self, name), positive=True)
        for name in ("fractions", "eid_fractions", "errors"):
            values = getattr(self, name)
            if not all(0 < v <= 1 for v in values) or list(values) != sorted(values):
                raise ValueError(f"{name} must rise within (0, 1], got {values}")
        if not self.fractions:
            raise ValueError("fractions must hold at least one residual motion")
        if set(self.methods) - set(METHODS) or "fbp" not in self.methods:
            raise ValueError(f"methods must hold fbp and be of {', '.join(METHODS)}, got {self.methods}")

    @property
    def motion(self) -> SinusoidalMotion:
        """The whole motion of the vessel."""
        return SinusoidalMotion("wall", self.amplitude_mm, self.rate_bpm, direction=self.direction)

    @property
    def worst(self) -> float:
        """The largest residual motion of the PCCT, of the whole one: what is compensated."""
        return max(self.fractions)
