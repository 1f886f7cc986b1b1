"""How well the path of a moving inset is found from its own scan, on vessels drawn at random.

:mod:`recon.motion` states its errors and says when a path is no smooth one, or none at all. Whether
that is so is counted here on vessels and motions that no constant of the method was chosen on
(``first`` draws them): bulging vessels with a plaque, and ellipsoids of blood, anywhere in a
patient of 240 mm, that stand still, beat along a line, go round in loops, or jump. The paper's own
plaque and its motions are those of the study "motion".
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from recon.api import reconstruct
from recon.jobs.store import Step, StudyCache
from recon.motion import InsetMotion
from recon.study.figures import curve_axes
from recon.study.motion_estimates import AlongAxis, JumpMotion, motion_or_refusal
from recon.study.paper import published as paper
from recon.study.paper.plaque_scan import duty
from recon.study.study import Measured, Progress, StudySettings, silent
from torchpcct.acquisition.acquire import acquire
from torchpcct.geometry import VolumeGrid
from torchpcct.scan import Scan
from torchpcct.scanner import presets
from torchpcct.scene import Body, Scene, SinusoidalMotion
from torchpcct.scene.bodies import Ellipsoid, EllipticCylinder
from torchpcct.scene.plaque import PATIENT_DIAMETER, Plaque, plaque_scene
from torchpcct.validate import choice, number

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from torchpcct.typing import JsonObject

Floats = NDArray[np.float64]
Motions = tuple[SinusoidalMotion, ...]

_ROWS = 26
"""Of the detector: as many as the inset needs."""
_GRID = ((28, 32, 32), 0.22)
"""Voxels of the inset, and their size in mm."""
_BODY = "wall"
"""That moves, with all that lies in it."""
_RADII_MM = (15.0, 55.0)
"""Distances of the vessels from the axis of the scanner."""
_COVERED = 0.95
"""Share of a path within two standard errors, from which on the path counts as covered."""


def _sine(
    rng: np.random.Generator, mm: float, rates: tuple[float, float], way: float
) -> SinusoidalMotion:
    phase = rng.uniform(0.0, 2.0 * math.pi)
    return SinusoidalMotion(_BODY, mm, rng.uniform(*rates), phase, way)


def _line(rng: np.random.Generator) -> Motions:
    mm, way = rng.uniform(0.2, 1.2), rng.uniform(0.0, 2.0 * math.pi)
    beat = _sine(rng, mm, (50.0, 80.0), way)
    if rng.random() < 0.6:
        return (beat,)
    phase = rng.uniform(0.0, 2.0 * math.pi)
    return beat, AlongAxis(_BODY, rng.uniform(0.2, 0.6) * mm, beat.rate_bpm, phase)


def _loop(rng: np.random.Generator) -> Motions:
    mm, way, rates = rng.uniform(0.2, 1.0), rng.uniform(0.0, 2.0 * math.pi), (50.0, 110.0)
    across = _sine(rng, mm * rng.uniform(0.3, 1.0), rates, way + math.pi / 2)
    height = _sine(rng, mm * rng.uniform(0.0, 0.7), rates, 0.0)
    along = AlongAxis(_BODY, height.amplitude, height.rate_bpm, height.phase)
    return _sine(rng, mm, rates, way), across, along


def _jump(rng: np.random.Generator) -> Motions:
    mm, way = rng.uniform(0.2, 1.0), rng.uniform(0.0, 2.0 * math.pi)
    at = rng.uniform(0.15, 0.85) * paper.ROTATION_S
    return (JumpMotion(_BODY, mm, direction=way, at_s=at),)


def _beat_and_jump(rng: np.random.Generator) -> Motions:
    return *_line(rng)[:1], *_jump(rng)


KINDS: Mapping[str, Callable[[np.random.Generator], Motions]] = {
    "at rest": lambda rng: (),
    "along a line": _line,
    "loops": _loop,
    "a jump": _jump,
    "beats and a jump": _beat_and_jump,
}
"""Motions by name, drawn."""

SMOOTH = ("at rest", "along a line", "loops")
"""Those in which nothing jumps."""


@dataclass(frozen=True)
class PathsSettings(StudySettings):
    """Settings of the study of paths.

    Args:
        kinds: of :data:`KINDS`.
        vessels: of each kind.
        first: number of the first vessel; those below 1000 were looked at when the constants of
            :mod:`recon.motion` were chosen.
        views: of a turn, with the photons of all of the PCCT's.
        exposures_s: of the estimates.
        seed: of the noise; the vessel numbered i draws with ``seed + i``.
    """

    kinds: tuple[str, ...] = tuple(KINDS)
    vessels: int = 10
    first: int = 1000
    views: int = 96
    exposures_s: tuple[float, ...] = (2.0, 0.35)
    seed: int = 0

    # Two vessels of each kind, one exposure.
    QUICK: ClassVar[dict[str, object]] = {"vessels": 2, "exposures_s": (2.0,)}

    def __post_init__(self) -> None:
        self.check_whole(vessels=1, first=0, seed=0, views=48)
        for kind in self.kinds:
            choice("kinds", kind, tuple(KINDS))
        if not self.kinds or not self.exposures_s:
            raise ValueError("kinds and exposures_s need at least one each")
        for exposure in self.exposures_s:
            number("exposures_s", exposure, positive=True, unit="s")


@dataclass
class Examples:
    """What the picture shows.

    Attributes:
        examples: kind → true path ``(views, 3)`` and what was found.
    """

    examples: dict[str, tuple[Floats, InsetMotion]] = field(default_factory=dict)


def drawn(kind: str, vessel: int) -> tuple[Scene, VolumeGrid, Motions]:
    """A vessel in a patient, the grid of its inset, and how it moves.

    Args:
        kind: of :data:`KINDS`.
        vessel: its number; of each kind there are others.
    """
    for attempt in itertools.count():
        rng = np.random.default_rng([list(KINDS).index(kind), vessel, attempt])
        radius, turn = rng.uniform(*_RADII_MM), rng.uniform(0.0, 2.0 * math.pi)
        x, y = radius * math.cos(turn), radius * math.sin(turn)
        motions = KINDS[kind](rng)
        grid = VolumeGrid(*_GRID, (0.0, y, x))
        try:
            scene = _vessel(rng, x, y) if rng.random() < 2 / 3 else _blood(rng, x, y)
            return scene.with_motion(motions), grid, motions
        except ValueError:  # its core does not fit into it
            continue
    raise AssertionError("itertools.count does not end")


def _vessel(rng: np.random.Generator, x: float, y: float) -> Scene:
    wide = rng.uniform(2.4, 4.0)
    core = (0.15 * wide, 0.25 * wide, rng.uniform(0.4, 1.0))
    return plaque_scene(
        Plaque(
            position=(x, y, 0.0),
            orientation=rng.uniform(0.0, 2.0 * math.pi),
            vessel_diameter=wide,
            bulge=rng.uniform(0.1, 0.5),
            bulge_length=rng.uniform(2.5, 4.5),
            vessel_length=rng.uniform(3.5, 4.6),
            core_semi_axes=core,
            core_scale=0.6,
        )
    )[0]


def _blood(rng: np.random.Generator, x: float, y: float) -> Scene:
    radii = tuple(rng.uniform(0.9, 2.0, 3).tolist())
    patient = Body("patient", EllipticCylinder(PATIENT_DIAMETER / 2), "pericoronary_fat")
    vessel = Body(_BODY, Ellipsoid(radii, position=(x, y, 0.0)), "blood_iodine", "patient")
    return Scene([patient, vessel])


def measure(
    settings: PathsSettings, progress: Progress = silent, folder: str | Path | None = None
) -> Measured:
    """Simulate, estimate and compare; finished vessels are cached, so that more of them go on where
    fewer ended."""
    s, seen = settings, Examples()
    cache = _cache(s, folder)
    rows: list[JsonObject] = []
    vessels = range(s.first, s.first + s.vessels)
    cache.ahead(*_step(s))
    for kind in s.kinds:
        for done, vessel in enumerate(vessels):
            truth, motions, found, seconds = _path(s, cache, kind, vessel)
            jump = next((m for m in motions if isinstance(m, JumpMotion)), None)
            for exposure, one, cpu in zip(s.exposures_s, found, seconds, strict=True):
                row = {"kind": kind, "vessel": vessel, "exposure_s": exposure, "cpu_seconds": cpu}
                rows.append(row | compared(one, truth, jump))
            if found[0] is not None:
                seen.examples.setdefault(kind, (truth, found[0]))
            progress(kind, (done + 1) / s.vessels)
    mbir = cache("mbir", partial(_mbir_seconds, s))
    summary = [
        {"kind": kind, "exposure_s": exposure}
        | _together([r for r in rows if (r["kind"], r["exposure_s"]) == (kind, exposure)])
        for kind in s.kinds
        for exposure in s.exposures_s
    ]
    return Measured(s, {"paths": rows, "kinds": summary, "mbir_seconds": mbir}, seen)


def plan(settings: PathsSettings, folder: str | Path | None) -> None:
    """List the jobs that are left; see :mod:`recon.study.study`."""
    _cache(settings, folder).plan(_step(settings))


def _cache(s: PathsSettings, folder: str | Path | None) -> StudyCache:
    """Each vessel has its own, whatever others are asked for."""
    return StudyCache(folder, replace(s, kinds=tuple(KINDS), vessels=1))


def _step(s: PathsSettings) -> Step:
    return _path, [(k, vessel) for k in s.kinds for vessel in range(s.first, s.first + s.vessels)]


def _path(
    s: PathsSettings, cache: StudyCache, kind: str, vessel: int
) -> tuple[Floats, Motions, list[InsetMotion | None], list[float]]:
    """What is cached of one vessel."""
    return cache.within(kind.replace(" ", "_"))(f"{vessel}", partial(_estimated, s, kind, vessel))


def _estimated(
    s: PathsSettings, kind: str, vessel: int
) -> tuple[Floats, Motions, list[InsetMotion | None], list[float]]:
    """True path, motions, and what was found at each exposure in how much processor time."""
    scene, grid, motions = drawn(kind, vessel)
    scan = _scan(s, scene, grid)
    found, seconds = [], []
    for exposure in s.exposures_s:
        began = time.process_time()
        found.append(motion_or_refusal(_noisy(s, scan, exposure, vessel), grid))
        seconds.append(time.process_time() - began)
    return true_path(motions, scan), motions, found, seconds


def _scan(s: PathsSettings, scene: Scene, grid: VolumeGrid) -> Scan:
    scanner = presets.pcct(s.views, rows=_ROWS)
    taken = duty(scanner, paper.FULL_VIEWS["PCCT"])
    return acquire(scene, scanner, region=grid, rotation_s=paper.ROTATION_S, duty=taken)


def _noisy(s: PathsSettings, scan: Scan, exposure_s: float, vessel: int) -> Scan:
    return scan.with_noise(exposure_s * paper.FULL_VIEWS["PCCT"] / s.views, s.seed + vessel)


def _mbir_seconds(s: PathsSettings) -> float:
    """Processor time of MBIR of the first vessel, once it is loaded."""
    scene, grid, _ = drawn(s.kinds[0], s.first)
    scan = _noisy(s, _scan(s, scene, grid), s.exposures_s[0], s.first)
    for _ in range(2):
        began = time.process_time()
        reconstruct(scan, grid, "mbir")
    return time.process_time() - began


def true_path(motions: Sequence[SinusoidalMotion], scan: Scan) -> Floats:
    """``(views, 3)`` z, y, x mm, about its mean."""
    angles = scan.geometry.angles
    times = (angles - angles[0]) / (2.0 * math.pi) * paper.ROTATION_S
    path = np.zeros((len(times), 3))
    for motion in motions:
        path += motion.displacement(times)[:, ::-1]
    return path - path.mean(0)


def compared(found: InsetMotion | None, truth: Floats, jump: JumpMotion | None) -> JsonObject:
    """One estimate, or none as it was refused, beside the truth.

    Returns:
        ``refused``; ``true_mm``, ``error_mm`` (of what is applied) and ``stated_mm`` (standard
        errors), root mean squares; ``inside``, the share within two of them; ``held``; ``jumps``,
        whether a jump was reported, ``jump_mm`` its true size, ``jump_error_mm`` how far the
        reported one is from it; ``other``, whether a warning says that something moves otherwise.
    """
    if found is None:
        nothing = ("error_mm", "stated_mm", "inside", "jump_error_mm")
        return {"refused": True, "held": False, "jumps": False, "other": False} | {
            "true_mm": _rms(truth),
            "jump_mm": None if jump is None else jump.amplitude,
            **dict.fromkeys(nothing),
        }
    off = found.path - truth
    row: JsonObject = {
        "refused": False,
        "true_mm": _rms(truth),
        "error_mm": _rms(off),
        "stated_mm": _rms(found.errors),
        "inside": float((np.abs(off) <= 2.0 * found.errors).mean()),
        "held": found.held,
        "jumps": found.jump is not None,
        "jump_mm": None if jump is None else jump.amplitude,
        "jump_error_mm": None,
        "other": any("move differently" in text for text in found.warnings),
    }
    if jump is not None and found.jump is not None:
        step = jump.displacement(np.array([jump.at_s]))[0, ::-1]
        row["jump_error_mm"] = float(np.linalg.norm(found.jump.mm - step))
    return row


def _rms(path: Floats) -> float:
    return float(np.sqrt((path**2).sum(1).mean()))


def _together(rows: list[JsonObject]) -> JsonObject:
    """Of several paths: root mean squares, the largest error, how many. Errors are those of the
    paths that were found, None if there is none."""
    found = [row for row in rows if not row["refused"]]
    of: dict[str, Floats] = {
        name: np.array([row[name] for row in found], dtype=np.float64)
        for name in ("error_mm", "stated_mm", "inside")
    }
    errors: JsonObject = dict.fromkeys(
        ("error_mm", "stated_mm", "median_mm", "largest_mm", "inside")
    )
    if found:
        errors = {
            **{name: float(np.sqrt((of[name] ** 2).mean())) for name in ("error_mm", "stated_mm")},
            "median_mm": float(np.median(of["error_mm"])),
            "largest_mm": float(of["error_mm"].max()),
            "inside": float(of["inside"].mean()),
        }
    return {
        "n": len(rows),
        "true_mm": float(np.sqrt(np.mean([row["true_mm"] ** 2 for row in rows]))),
        **errors,
        "covered": int((of["inside"] >= _COVERED).sum()),
        **{name: sum(row[name] for row in rows) for name in ("refused", "held", "jumps", "other")},
        "cpu_seconds": float(np.median([row["cpu_seconds"] for row in rows])),
    }


def figures(measured: Measured) -> dict[str, Figure]:
    """One path of each kind that moves, beside the one that was found with two standard errors."""
    shown = {k: v for k, v in measured.seen.examples.items() if k != "at rest"}
    figure, axes = curve_axes("view", [f"{kind}, mm" for kind in shown] or ["mm"])
    for ax, (truth, found) in zip(axes, shown.values(), strict=False):
        views = np.arange(len(truth))
        for axis, color in ((2, "tab:blue"), (1, "tab:orange"), (0, "tab:green")):
            ax.plot(views, truth[:, axis], "k--", lw=0.8)
            path, error = found.path[:, axis], 2.0 * found.errors[:, axis]
            ax.plot(views, path, color=color, label="zyx"[axis])
            ax.fill_between(views, path - error, path + error, color=color, alpha=0.25, lw=0)
        ax.legend(fontsize=6.5)
    return {"paths.png": figure}
