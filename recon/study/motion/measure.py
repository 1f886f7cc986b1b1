"""Scans of the still and of the moving vessel, and what their images show."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from recon.analytic.inset import view_motion
from recon.evaluate.store import Pieces
from recon.study.motion.compensation import Key, compensate, reconstruct_fbp
from recon.study.motion.observed import Observed, Reference, observe
from recon.study.motion.settings import Settings
from recon.study.paper import facts as paper
from recon.study.paper.plaque_scan import SCANNERS, duty, inset_grid
from recon.study.study import Clock, Progress, silent
from torchpcct.acquisition.acquire import acquire
from torchpcct.scan import Scan
from torchpcct.scene.plaque import plaque_scene

__all__ = ["Measured", "measure"]


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
        seconds: per step.
    """

    settings: Settings
    at_rest: dict[str, Observed] = field(default_factory=dict)
    residual: dict[tuple[str, float], tuple[Observed, Observed]] = field(default_factory=dict)
    compensated: dict[Key, list[Observed]] = field(default_factory=dict)
    range_mm: tuple[float, float] = (0.0, 0.0)
    step_mm: float = 0.0
    plan: dict[str, Any] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)

    def residuals(self, scanner: str) -> dict[float, tuple[Observed, Observed]]:
        """``residual`` of one scanner, by fraction."""
        return {fraction: pair for (name, fraction), pair in self.residual.items() if name == scanner}


def measure(settings: Settings, progress: Progress = silent, folder: str | Path | None = None) -> Measured:
    """Simulate and reconstruct residual motion in both scanners, and compensate the PCCT's, in resumable pieces."""
    clock, pieces = Clock(), Pieces(folder, settings)
    m = Measured(settings, seconds=clock.seconds)
    scene, plaque = plaque_scene()
    reference = Reference.of(scene, plaque, inset_grid(plaque, settings.voxel_mm))
    fractions = {"PCCT": (0.0, *settings.fractions), "EID-CT": (0.0, *settings.eid_fractions)}
    pieces.ahead(_scan_ahead, *((name, f) for name in SCANNERS for f in dict.fromkeys(fractions[name])))
    for name in SCANNERS:
        with clock.step(f"{name}, residual motion"):
            still, moving = _residual(m, name, reference, pieces.within(name), progress)
        if name == "PCCT":
            m.plan = dict(moving.info["plan"])
            with clock.step("compensation"):
                m.compensated = compensate(
                    settings, still, moving, reference, pieces.within("compensation"), partial(progress, "compensation")
                )
    return m


def _residual(m: Measured, name: str, reference: Reference, pieces: Pieces, progress: Progress) -> tuple[Scan, Scan]:
    """Images with residual motion; returns the scans at rest and of the largest motion."""
    s, grid = m.settings, reference.grid
    still = moving = _scan(s, pieces, name, 0.0)
    rest = reconstruct_fbp(still, grid)
    m.at_rest[name] = observe(rest, reference, rest)
    path = view_motion(s.motion, still.geometry, s.rotation_s)
    if name == "PCCT":
        along = path @ np.array([0.0, math.sin(s.direction), math.cos(s.direction)])
        m.range_mm = (float(along.min()), float(along.max()))
        m.step_mm = float(np.linalg.norm(np.diff(path, axis=0), axis=1).max())
    fractions = s.fractions if name == "PCCT" else s.eid_fractions
    for done, fraction in enumerate(fractions):
        moving = _scan(s, pieces, name, fraction)
        mean = np.tile(fraction * path.mean(0), (len(path), 1))
        in_place, back = reconstruct_fbp(moving, grid), reconstruct_fbp(moving, grid, mean)
        m.residual[name, fraction] = (observe(in_place, reference, rest), observe(back, reference, rest))
        progress(name, (done + 1) / len(fractions))
    return still, moving


def _scan(s: Settings, pieces: Pieces, name: str, fraction: float) -> Scan:
    scanner = SCANNERS[name](paper.FULL_VIEWS[name] // s.thinning)
    scene, plaque = plaque_scene(motion=s.motion.scaled(fraction))
    run = partial(
        acquire, scene, scanner, region=inset_grid(plaque, s.voxel_mm), rotation_s=s.rotation_s,
        duty=duty(scanner, paper.FULL_VIEWS[name]),
    )  # fmt: skip
    return pieces(f"scan_{fraction:g}", run)


def _scan_ahead(settings: Settings, pieces: Pieces, name: str, fraction: float) -> None:
    _scan(settings, pieces.within(name), name, fraction)
