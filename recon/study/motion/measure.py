"""How much residual motion the plaque's image bears, in PCCT and EID-CT, and what motion compensation gets back.

Protocol of Li et al., section "Motion Artifacts": the vessel moves rigidly in the axial plane, 2 mm · sin(2π t) (60
beats a minute), during one turn of 0.35 s; residual motion is 10 to 60 % of that. FBP on 0.2 mm voxels without noise.
Every view sees the vessel where it is then, and blurred by its way during the view: no phase volumes.

Beyond the paper: reconstruction with the motion known (FBP, penalised least squares and the learned MBIR, each with
the displaced inset in its backprojector or projector), with the motion known wrongly, and with noise.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from recon.fbp.inset import InsetFbp, view_motion
from recon.study.motion.observed import Observed, Reference, observe
from recon.study.paper import facts as paper
from recon.study.paper.plaque_scan import inset_grid
from torchpcct.scan import Scan

if TYPE_CHECKING:
    from recon.study.report import Report
    from torchpcct.geometry import VolumeGrid
    from torchpcct.scanner import Scanner
    from torchpcct.scene import SinusoidalMotion
    from torchpcct.scene.plaque import Plaque

__all__ = ["FULL_VIEWS", "KERNEL", "METHODS", "Measured", "Settings", "measure_all", "run"]

FULL_VIEWS = {"PCCT": 1968, "EID-CT": 984}
"""Views per turn of the paper."""

KERNEL = "standard"
METHODS = {"fbp": "FBP", "pwls": "q-GGMRF PWLS", "mbir": "MBIR (learned prior)"}


@dataclass(frozen=True)
class Settings:
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
        ValueError: a value out of range, an unknown method.
    """

    thinning: int = 1
    amplitude_mm: float = 2.0
    rate_bpm: float = 60.0
    rotation_s: float = 0.35
    direction: float = 0.0
    fractions: tuple[float, ...] = paper.MOTION["fractions"]
    eid_fractions: tuple[float, ...] = paper.MOTION["eid_fractions"]
    errors: tuple[float, ...] = (0.05, 0.10, 0.20, 0.40)
    voxel_mm: float = 0.2
    exposure_s: float = paper.TABLE_EXPOSURE_S
    seed: int = 0
    realizations: int = 2
    methods: tuple[str, ...] = tuple(METHODS)

    def __post_init__(self) -> None:
        if self.thinning < 1 or self.realizations < 1 or self.seed < 0:
            raise ValueError(
                "thinning and realizations must be at least 1 and seed at least 0, got "
                f"{self.thinning}, {self.realizations}, {self.seed}"
            )
        for name in ("amplitude_mm", "rate_bpm", "rotation_s", "voxel_mm", "exposure_s"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be greater than 0, got {getattr(self, name)}")
        for name in ("fractions", "eid_fractions", "errors"):
            values = getattr(self, name)
            if not all(0 < v <= 1 for v in values) or list(values) != sorted(values):
                raise ValueError(f"{name} must rise within (0, 1], got {values}")
        if not self.fractions:
            raise ValueError("fractions must hold at least one residual motion")
        unknown = set(self.methods) - set(METHODS)
        if unknown or "fbp" not in self.methods:
            raise ValueError(f"methods must hold fbp and be of {', '.join(METHODS)}, got {self.methods}")

    @classmethod
    def quick(cls, **changes: Any) -> Settings:
        """A first look: an eighth of the views, four residual motions, one error of the estimate, no PWLS."""
        values: dict[str, Any] = {
            "thinning": 8,
            "fractions": (0.1, 0.4, 0.6, 1.0),
            "errors": (0.10,),
            "realizations": 1,
            "methods": ("fbp", "mbir"),
        }
        return cls(**{**values, **changes})

    @property
    def motion(self) -> SinusoidalMotion:
        """The whole motion of the vessel."""
        from torchpcct.scene import SinusoidalMotion

        return SinusoidalMotion("wall", self.amplitude_mm, self.rate_bpm, direction=self.direction)


@dataclass
class Measured:
    """All that the report needs.

    Attributes:
        at_rest: scanner → what the still vessel's image shows; its reference.
        residual: (scanner, fraction) → the uncompensated image, in place and moved back by the mean displacement.
        compensated: (method, error of the estimate, noisy) → one entry per realisation; error 0: the true motion;
            None: the still vessel by the same method.
        range_mm: smallest and largest displacement of the whole motion; step_mm: largest from view to view.
        plan: of the scan of the whole motion.
    """

    settings: Settings
    plaque: Plaque
    grid: VolumeGrid
    at_rest: dict[str, Observed] = field(default_factory=dict)
    residual: dict[tuple[str, float], tuple[Observed, Observed]] = field(default_factory=dict)
    compensated: dict[tuple[str, float | None, bool], list[Observed]] = field(default_factory=dict)
    range_mm: tuple[float, float] = (0.0, 0.0)
    step_mm: float = 0.0
    plan: dict[str, Any] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)


def run(settings: Settings, progress: Callable[[str, float], None] | None = None) -> Report:
    """Simulate, reconstruct, compensate, measure; see :mod:`recon.study.registry`."""
    from recon.study.motion.report import build_report

    return build_report(measure_all(settings, progress))


def measure_all(settings: Settings, progress: Callable[[str, float], None] | None = None) -> Measured:
    """The study without its report."""
    from torchpcct.scanner import presets
    from torchpcct.scene.plaque import plaque_scene

    report = progress or (lambda step, fraction: None)
    scene, plaque = plaque_scene()
    m = Measured(settings, plaque, inset_grid(plaque, settings.voxel_mm))
    reference = Reference.of(scene, plaque)
    for name, preset in (("PCCT", presets.pcct), ("EID-CT", presets.eid)):
        start = time.perf_counter()
        scanner = preset(FULL_VIEWS[name] // settings.thinning)
        fractions = settings.fractions if name == "PCCT" else settings.eid_fractions
        kept = _residual(m, name, scanner, reference, fractions, partial(report, name))
        m.seconds[f"{name}, residual motion"] = time.perf_counter() - start
        if name == "PCCT":
            start = time.perf_counter()
            from recon.study.motion.compensation import compensate

            m.plan = dict(kept[1].info["plan"])
            compensate(m, *kept, reference, partial(report, "compensation"))
            m.seconds["compensation"] = time.perf_counter() - start
    return m


def simulate(settings: Settings, scanner: Scanner, name: str, fraction: float, grid: VolumeGrid) -> Scan:
    """Noise-free scan of the vessel with ``fraction`` of the motion, windowed about the inset."""
    from torchpcct.acquisition.acquire import acquire
    from torchpcct.scene.plaque import plaque_scene

    scene = plaque_scene(motion=settings.motion.scaled(fraction))[0]
    duty = min(1.0, scanner.geometry.views / FULL_VIEWS[name])
    return acquire(scene, scanner, region=grid, rotation_s=settings.rotation_s, duty=duty)


def _residual(
    m: Measured,
    name: str,
    scanner: Scanner,
    reference: Reference,
    fractions: Sequence[float],
    progress: Callable[[float], None],
) -> tuple[Scan, Scan]:
    """Images with residual motion; returns the scans at rest and of the largest motion."""
    s = m.settings
    still = simulate(s, scanner, name, 0.0, m.grid)
    rest = _fbp(still, m.grid)
    m.at_rest[name] = observe(rest, m.grid, reference, rest)
    path = view_motion(s.motion, still.geometry, s.rotation_s)
    if name == "PCCT":
        along = path @ np.array([0.0, math.sin(s.direction), math.cos(s.direction)])
        m.range_mm = (float(along.min()), float(along.max()))
        m.step_mm = float(np.linalg.norm(np.diff(path, axis=0), axis=1).max())
    moving = still
    for done, fraction in enumerate(fractions):
        moving = simulate(s, scanner, name, fraction, m.grid)
        mean = np.tile(fraction * path.mean(0), (len(path), 1))
        m.residual[name, fraction] = (
            observe(_fbp(moving, m.grid), m.grid, reference, rest),
            observe(_fbp(moving, m.grid, mean), m.grid, reference, rest),
        )
        progress((done + 1) / len(fractions))
    return still, moving


def _fbp(scan: Scan, grid: VolumeGrid, motion: Any = None) -> Tensor:
    return InsetFbp(scan, [grid], [KERNEL], motion=motion)(scan)[0][0]
