"""What the phantom study looks at."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from recon.study.phantom.geometry import analytic_lengths, assumptions, raster_lengths
from recon.study.phantom.materials import compositions, ct_numbers
from recon.study.phantom.settings import Settings
from recon.study.study import Clock, Progress, silent
from torchpcct.scene import Scene
from torchpcct.scene.plaque import Plaque, plaque_scene

__all__ = ["Measured", "measure"]


@dataclass(frozen=True)
class Measured:
    """What the report needs.

    Attributes:
        settings: of the study.
        parts: JSON values by part.
        scene, plaque: what was measured, for the picture.
        seconds: step → seconds.
    """

    settings: Settings
    parts: dict[str, Any]
    scene: Scene
    plaque: Plaque
    seconds: dict[str, float]


def measure(settings: Settings, progress: Progress = silent, folder: str | Path | None = None) -> Measured:
    """Materials and lengths; nothing is kept in ``folder``."""
    clock = Clock()
    scene, plaque = plaque_scene()
    parts: dict[str, Any] = {"materials": compositions(), "hu": ct_numbers(settings.energies_kev)}
    clock.lap("materials")
    progress("materials", 1.0)
    parts["lengths_mm"] = {
        "bodies": analytic_lengths(scene, plaque),
        "raster": raster_lengths(scene, plaque, settings.voxel_mm, settings.sections),
    }
    parts["assumed_mm"] = assumptions(plaque)
    clock.lap("lengths")
    progress("lengths", 1.0)
    return Measured(settings, parts, scene, plaque, clock.seconds)
