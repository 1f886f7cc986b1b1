"""How well the motion of an inset is found from its own scan: of the motion study's vessel, and of
motions that the model of a smooth, rigid path does not describe."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recon.jobs.store import StudyCache
from recon.motion import InsetMotion, PathTooLongError, estimate_motion
from recon.study.paper import published as paper
from recon.study.paper.plaque_scan import SCANNERS, duty
from torchpcct.acquisition.acquire import acquire
from torchpcct.geometry import VolumeGrid
from torchpcct.scan import Scan
from torchpcct.scene import Body, SinusoidalMotion
from torchpcct.scene.bodies import Ellipsoid
from torchpcct.scene.plaque import Plaque, plaque_scene

if TYPE_CHECKING:
    from torchpcct.typing import JsonObject

__all__ = ["CASES", "AlongAxis", "JumpMotion", "estimated_paths", "motion_or_refusal"]

_SECOND_MM = (-3.3, 0.0)
"""Where the second vessel lies beside the plaque's, x and y, on the side away from the plaque."""
_SECOND_RADIUS_MM = 0.7
"""Its radius."""
_SECOND_MOST_MM = 0.8
"""Largest motion at which the two do not meet."""


class EstimateSettings(Protocol):
    """What :class:`recon.study.motion.MotionSettings` says of the estimates."""

    @property
    def thinning(self) -> int: ...
    @property
    def rate_bpm(self) -> float: ...
    @property
    def rotation_s(self) -> float: ...
    @property
    def seed(self) -> int: ...
    @property
    def estimated_cases(self) -> tuple[str, ...]: ...
    @property
    def estimated_mm(self) -> tuple[float, ...]: ...
    @property
    def estimated_exposures_s(self) -> tuple[float, ...]: ...
    @property
    def estimated_realisations(self) -> int: ...


@dataclass(frozen=True)
class AlongAxis(SinusoidalMotion):
    """The sinusoid along the axis of the scanner."""

    @property
    def _unit(self) -> NDArray[np.float64]:
        return np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class JumpMotion(SinusoidalMotion):
    """All of the displacement at once.

    Args:
        at_s: when, after half a turn of 0.35 s by default.
    """

    at_s: float = 0.5 * paper.ROTATION_S

    def displacement(self, times: ArrayLike) -> NDArray[np.float64]:
        late = np.asarray(times, dtype=np.float64) >= self.at_s
        return self.amplitude * late[..., None] * self._unit


def _sine(body: str, mm: float, rate: float, way: float, phase: float = 0.0) -> SinusoidalMotion:
    return SinusoidalMotion(body, mm, rate, phase, way)


CASES: Mapping[str, Callable[[float, float], tuple[SinusoidalMotion, ...]]] = {
    "at rest": lambda mm, rate: (),
    "along x": lambda mm, rate: (_sine("wall", mm, rate, 0.0),),
    "along y": lambda mm, rate: (_sine("wall", mm, rate, math.pi / 2),),
    "along z": lambda mm, rate: (AlongAxis("wall", mm, rate),),
    "ellipse": lambda mm, rate: (
        _sine("wall", mm, rate, 0.6),
        _sine("wall", 0.5 * mm, rate, 0.6 + math.pi / 2, math.pi / 2),
    ),
    "jump along x": lambda mm, rate: (JumpMotion("wall", mm, rate),),
    "two vessels, alike": lambda mm, rate: tuple(
        _sine(body, mm, rate, math.pi / 2) for body in ("wall", "second")
    ),
    "two vessels, apart": lambda mm, rate: (
        _sine("wall", mm, rate, 0.0),
        _sine("second", mm, rate, math.pi / 2),
    ),
}
"""Motions by name: of an amplitude in mm, and beats a minute."""


def estimated_paths(
    s: EstimateSettings, grid: VolumeGrid, cache: StudyCache, progress: Callable[[float], None]
) -> list[JsonObject]:
    """One row for each case, amplitude and exposure.

    Args:
        s: of the study.
        grid: of the inset.
        cache: for scans and estimates.
        progress: called with the finished fraction.

    Returns:
        ``case``, ``mm``, ``exposure_s``, ``true_mm`` (root mean square of the motion about its
        mean), ``error_mm`` (of what is applied), ``stated_mm`` (of the standard errors), ``inside``
        (share within two of them), ``refused``, ``held``, ``jumps`` and ``warned`` (in how many
        realisations no path was found as it leads too far, a motion was applied, a jump was
        found, a warning reported that something else moves). None where two vessels have no common
        path, or all are refused.
    """
    jobs = [
        (case, mm)
        for case in s.estimated_cases
        for mm in (s.estimated_mm if case != "at rest" else s.estimated_mm[:1])
        if "vessels" not in case or mm <= _SECOND_MOST_MM
    ]
    rows = []
    for done, (case, mm) in enumerate(jobs):
        motions = CASES[case](mm, s.rate_bpm)
        short = case.replace(",", "").replace(" ", "-")
        scan = cache(f"{short}_{mm:g}", partial(_scan, s, grid, motions, "vessels" in case))
        truth = _truth(motions, scan, s.rotation_s)
        for exposure in s.estimated_exposures_s:
            name = f"{short}_{mm:g}_{exposure:g}"
            seeds = range(s.seed, s.seed + s.estimated_realisations)
            found = cache(name, partial(_estimates, scan, grid, exposure * s.thinning, seeds))
            row = {"case": case, "mm": mm if motions else 0.0, "exposure_s": exposure}
            rows.append(row | _row(found, None if "apart" in case else truth))
        progress((done + 1) / len(jobs))
    return rows


def _scan(
    s: EstimateSettings, grid: VolumeGrid, motions: tuple[SinusoidalMotion, ...], two: bool
) -> Scan:
    scanner = SCANNERS["PCCT"](paper.FULL_VIEWS["PCCT"] // s.thinning)
    x, y, z = Plaque().position
    place = (x + _SECOND_MM[0], y + _SECOND_MM[1], z)
    second = Body(
        "second",
        Ellipsoid((_SECOND_RADIUS_MM,) * 2 + (3.0,), position=place),
        "blood_iodine",
        "patient",
    )
    scene, _ = plaque_scene(extra=(second,) if two else ())
    return acquire(
        scene.with_motion(motions),
        scanner,
        region=grid,
        rotation_s=s.rotation_s,
        duty=duty(scanner, paper.FULL_VIEWS["PCCT"]),
    )


def _truth(
    motions: tuple[SinusoidalMotion, ...], scan: Scan, rotation_s: float
) -> NDArray[np.float64]:
    """``(views, 3)`` z, y, x mm of the plaque's vessel, about its mean."""
    angles = scan.geometry.angles
    times = (angles - angles[0]) / (2.0 * math.pi) * rotation_s
    path = np.zeros((len(times), 3))
    for motion in motions:
        if motion.body == "wall":
            path += motion.displacement(times)[:, ::-1]
    return path - path.mean(0)


def _estimates(
    scan: Scan, grid: VolumeGrid, exposure_s: float, seeds: range
) -> list[InsetMotion | None]:
    return [motion_or_refusal(scan.with_noise(exposure_s, seed), grid) for seed in seeds]


def motion_or_refusal(scan: Scan, grid: VolumeGrid) -> InsetMotion | None:
    """What is found, or None where the estimate is refused: the path leads too far."""
    try:
        return estimate_motion(scan, grid)
    except PathTooLongError:
        return None


def _row(estimates: list[InsetMotion | None], truth: NDArray[np.float64] | None) -> JsonObject:
    def rms(values: list[NDArray[np.float64]] | NDArray[np.float64]) -> float:
        return float(np.sqrt((np.asarray(values) ** 2).sum(-1).mean()))

    found = [one for one in estimates if one is not None]
    row: JsonObject = {
        "refused": len(estimates) - len(found),
        "stated_mm": rms([f.errors for f in found]) if found else None,
        "held": sum(f.held for f in found),
        "jumps": sum(f.jump is not None for f in found),
        "warned": sum(any("move differently" in text for text in f.warnings) for f in found),
    }
    row |= {"true_mm": None if truth is None else rms(truth), "error_mm": None, "inside": None}
    if truth is None or not found:
        return row
    inside = [np.abs(f.path - truth) <= 2.0 * f.errors for f in found]
    return row | {
        "error_mm": rms([f.path - truth for f in found]),
        "inside": float(np.mean(inside)),
    }
