"""Every case by every method: the error against the sound scan of the same noise, what was said, the verdict."""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from recon import reconstruct
from recon.study.hardcases.cases import CASES
from recon.study.hardcases.settings import Settings
from recon.study.store import Pieces
from recon.study.study import Clock, Progress, silent
from torchpcct.acquisition.acquire import acquire
from torchpcct.geometry import VolumeGrid
from torchpcct.scan import Scan
from torchpcct.scanner import presets
from torchpcct.scene.plaque import plaque_scene

__all__ = ["RIGHT_NOISES", "Measured", "measure", "verdict"]

RIGHT_NOISES = 0.5
"""A result is right if what the case adds is at most half of the noise that the sound scan has anyway: 12 % more."""
_ROWS, _GRID_MM = 20, (6.4, 9.2, 9.2)


@dataclass
class Measured:
    """What the report needs.

    Attributes:
        rows: one for each case and method: ``case``, ``title``, ``method``, ``error_hu`` (rms of the difference to the
            sound scan's volume, None if refused), ``noise_hu`` (rms of the sound scan's noise), ``finite``, ``said``
            (warnings, or the refusal), ``refused``, ``seconds``, ``verdict``.
        seconds: per step.
    """

    settings: Settings
    rows: list[dict[str, Any]]
    seconds: dict[str, float]


def verdict(error_hu: float | None, noise_hu: float, finite: bool, said: list[str], noise: float = 1.0) -> str:
    """``right``, ``said`` (wrong or refused, in words) or ``SILENT`` (wrong without a word).

    Args:
        error_hu: rms error in HU; None: refused.
        noise_hu: rms noise of the sound result.
        finite: whether all values are.
        said: warnings and refusals beside those of the sound scan.
        noise: of :class:`recon.study.hardcases.cases.Case`: what it adds is no error.
    """
    allowed = (RIGHT_NOISES + 1.3 * max(noise**2 - 1.0, 0.0) ** 0.5) * noise_hu
    if error_hu is not None and finite and error_hu <= allowed:
        return "right"
    return "said" if said else "SILENT"


def measure(settings: Settings, progress: Progress = silent, folder: str | Path | None = None) -> Measured:
    """Reconstruct every case by every method; see :mod:`recon.study.study`."""
    clock, pieces = Clock(), Pieces(folder, settings)
    scene, plaque = plaque_scene(vessel_length=_GRID_MM[0] - 0.2)
    scanner = presets.pcct(views=settings.views)
    scanner = scanner.replace(geometry=replace(scanner.geometry, rows=_ROWS))
    shape = tuple(round(e / settings.voxel_mm) for e in _GRID_MM)
    grid = VolumeGrid(shape, settings.voxel_mm, plaque.position[::-1])
    region = VolumeGrid((1, 1, 1), _GRID_MM, plaque.position[::-1])
    duty = settings.views / presets.PCCT_VIEWS

    def simulate() -> Scan:
        return acquire(scene, scanner, region=region, duty=min(duty, 1.0), progress=lambda f: progress("simulate", f))

    clean = pieces("scan", simulate)
    noisy = clean.with_noise(settings.exposure_s, settings.seed)
    clock.lap("simulate")
    sound, usual, noise = {}, {}, {}
    for m in settings.methods:

        def both(m: str = m) -> tuple[torch.Tensor, list[str], float]:
            volume = reconstruct(noisy, grid, m)
            return (
                volume.data,
                list(volume.report.get("warnings", ())),
                _rms(volume.data - reconstruct(clean, grid, m).data),
            )

        sound[m], texts, noise[m] = pieces(f"sound/{m}", both)
        usual[m] = {_kind(text) for text in texts}
    clock.lap("sound scan")
    rows = []
    for k, name in enumerate(settings.cases):
        scan = CASES[name].apply(clean, noisy, np.random.default_rng(settings.seed))
        for method in settings.methods:
            run = partial(_row, scan, grid, method, sound[method], noise[method], usual[method], CASES[name].noise)
            row = pieces(f"case_{name}/{method}", run)
            rows.append({"case": name, "title": CASES[name].title, "method": method, **row})
        progress("cases", (k + 1) / len(settings.cases))
    clock.lap("cases")
    return Measured(settings, rows, clock.seconds)


def _row(
    scan: Scan, grid: VolumeGrid, method: str, sound: torch.Tensor, noise: float, usual: set[str], lost: float
) -> dict[str, Any]:
    start = time.perf_counter()
    with _heard() as said:
        try:
            volume = reconstruct(scan, grid, method)
        except (ValueError, TypeError) as error:
            return {
                "error_hu": None, "noise_hu": noise, "finite": True, "said": [str(error)], "refused": True,
                "seconds": time.perf_counter() - start, "verdict": verdict(None, noise, True, [str(error)]),
            }  # fmt: skip
    finite = bool(torch.isfinite(volume.data).all())
    error_hu = _rms(volume.data - sound)
    texts = list(dict.fromkeys([*volume.report.get("warnings", []), *said]))
    more = [t for t in texts if _kind(t) not in usual]
    return {
        "error_hu": error_hu, "noise_hu": noise, "finite": finite, "said": texts, "refused": False,
        "seconds": time.perf_counter() - start, "verdict": verdict(error_hu, noise, finite, more, lost),
    }  # fmt: skip


def _kind(text: str) -> str:
    """A warning without its figures: the same one with others says nothing new."""
    return re.sub(r"[-\d.…]+", "#", text)


def _rms(difference: torch.Tensor) -> float:
    return float(difference.double().square().mean().sqrt())


@contextmanager
def _heard() -> Iterator[list[str]]:
    """The warnings that are logged meanwhile; they do not reach the terminal."""
    said: list[str] = []

    class Listener(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            said.append(record.getMessage())

    listener = Listener(logging.WARNING)
    loggers = [logging.getLogger("recon"), logging.getLogger("torchpcct")]
    before = [log.propagate for log in loggers]
    for log in loggers:
        log.addHandler(listener)
        log.propagate = False
    try:
        yield said
    finally:
        for log, propagate in zip(loggers, before, strict=True):
            log.removeHandler(listener)
            log.propagate = propagate
