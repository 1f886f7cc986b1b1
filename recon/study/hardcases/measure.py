"""Every case by every method: the error against the sound scan of the same noise, what was said, the verdict.

The error against the truth, beside that of soft FBP from the same scan, says whether a method makes a case worse than
need be: a prior or weights that the case fools.
"""

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
from recon.study.hardcases.cases import CASES, untouched
from recon.study.hardcases.settings import Settings
from recon.study.paper.rods import rod_values
from recon.study.store import Pieces
from recon.study.study import Clock, Progress, silent
from torchpcct.acquisition.acquire import acquire
from torchpcct.geometry import VolumeGrid
from torchpcct.scan import Scan
from torchpcct.scanner import Scanner, presets
from torchpcct.scene import Scene
from torchpcct.scene.plaque import plaque_scene

__all__ = ["RIGHT_NOISES", "WORSE", "Measured", "measure", "verdict"]

RIGHT_NOISES = 0.5
"""A result is right if what the case adds is at most half of the noise that the sound scan has anyway: 12 % more."""
WORSE = 1.05
"""A method that is further from the truth than soft FBP of the same scan by more than this factor has to say so."""
_ROWS, _GRID_MM = 20, (6.4, 9.2, 9.2)
_ROD_VIEWS = 60


@dataclass
class Measured:
    """What the report needs.

    Attributes:
        rows: one for each case and method: ``case``, ``title``, ``method``, ``error_hu`` (rms of the difference to the
            sound scan's volume, None if refused), ``noise_hu`` (rms of the sound scan's noise), ``finite``, ``said``
            (warnings, or the refusal), ``refused``, ``seconds``, ``verdict``, ``truth_hu`` (rms of the difference to
            the truth), ``soft_hu`` (that of soft FBP from the same scan; either is None if refused).
        seconds: per step.
    """

    settings: Settings
    rows: list[dict[str, Any]]
    seconds: dict[str, float]


def verdict(
    error_hu: float | None,
    noise_hu: float,
    finite: bool,
    said: list[str],
    noise: float = 1.0,
    worse: float = 1.0,
) -> str:
    """``right``, ``said`` (wrong or refused, in words) or ``SILENT`` (wrong without a word).

    Args:
        error_hu: rms error in HU; None: refused.
        noise_hu: rms noise of the sound result.
        finite: whether all values are.
        said: warnings and refusals beside those of the sound scan.
        noise: of :class:`recon.study.hardcases.cases.Case`: what it adds is no error.
        worse: error against the truth over that of soft FBP; more than :data:`WORSE` is not right.
    """
    allowed = (RIGHT_NOISES + 1.3 * max(noise**2 - 1.0, 0.0) ** 0.5) * noise_hu
    if error_hu is not None and finite and error_hu <= allowed and worse <= WORSE:
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

    def simulate(scene: Scene, label: str = "simulate") -> Scan:
        return acquire(scene, scanner, region=region, duty=min(duty, 1.0), progress=lambda f: progress(label, f))

    clean = pieces("scan", partial(simulate, scene))
    noisy = clean.with_noise(settings.exposure_s, settings.seed)
    clock.lap("simulate")
    truth = pieces("truth", partial(_truth, scene, scanner, grid))
    sound: dict[str, torch.Tensor] = {}
    usual: dict[str, set[str]] = {}
    noise: dict[str, float] = {}
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
        case, within = CASES[name], pieces.within(f"case_{name}")
        its_clean, its_noisy, its_truth, seen, lost = clean, noisy, truth, torch.ones(grid.shape).bool(), case.noise
        if case.scene is not None:
            its_scene = case.scene(plaque)
            its_clean = within("scan", partial(simulate, its_scene, f"simulate {name}"))
            its_noisy = its_clean.with_noise(settings.exposure_s, settings.seed)
            its_truth = within("truth", partial(_truth, its_scene, scanner, grid))
            seen = torch.from_numpy(untouched(its_scene, plaque, grid))
            assert clean.surround is not None
            assert its_clean.surround is not None
            lost *= float(clean._at_window(clean.surround / its_clean.surround).mean()) ** 0.5
        scan = case.apply(its_clean, its_noisy, np.random.default_rng(settings.seed))
        soft = within("soft", partial(_from_truth, scan, grid, its_truth, seen))
        for method in settings.methods:
            against = _Against(sound[method], its_truth, seen, noise[method], usual[method], lost, soft)
            row = within(method, partial(_row, scan, grid, method, against))
            rows.append({"case": name, "title": case.title, "method": method, **row})
        progress("cases", (k + 1) / len(settings.cases))
    clock.lap("cases")
    return Measured(settings, rows, clock.seconds)


def _truth(scene: Scene, scanner: Scanner, grid: VolumeGrid) -> torch.Tensor:
    """``grid.shape`` HU of a scene at rest: each tissue reads what a rod of it does at the plaque's place."""
    tissues = {b.name: b.material for b in scene.bodies if b.name in plaque_scene()[0].names}
    hu = rod_values(scene, scanner, grid.center[::-1], tissues=tissues, views=_ROD_VIEWS).hu
    values = {name: hu.get(name, 0.0) for name in scene.names}  # what a case adds is left out
    return torch.from_numpy(scene.render(grid, values)).float()


@dataclass(frozen=True)
class _Against:
    """What a row is judged by.

    Attributes:
        sound, truth: volumes in HU. seen: the voxels that count.
        noise: rms noise of the sound volume. usual: kinds of warnings of the sound scan.
        lost: of :func:`verdict`. soft: error of soft FBP against the truth, None if refused.
    """

    sound: torch.Tensor
    truth: torch.Tensor
    seen: torch.Tensor
    noise: float
    usual: set[str]
    lost: float
    soft: float | None


def _from_truth(scan: Scan, grid: VolumeGrid, truth: torch.Tensor, seen: torch.Tensor) -> float | None:
    """Error of soft FBP against the truth, rms HU; None if it is refused."""
    with _heard():
        try:
            volume = reconstruct(scan, grid, "fbp", kernel="soft")
        except (ValueError, TypeError):
            return None
    return _rms((volume.data - truth)[seen])


def _row(scan: Scan, grid: VolumeGrid, method: str, by: _Against) -> dict[str, Any]:
    start = time.perf_counter()
    with _heard() as said:
        try:
            volume = reconstruct(scan, grid, method)
        except (ValueError, TypeError) as error:
            return {
                "error_hu": None, "noise_hu": by.noise, "finite": True, "said": [str(error)], "refused": True,
                "seconds": time.perf_counter() - start, "verdict": verdict(None, by.noise, True, [str(error)]),
                "truth_hu": None, "soft_hu": by.soft,
            }  # fmt: skip
    seconds = time.perf_counter() - start
    finite = bool(torch.isfinite(volume.data).all())
    error_hu, truth_hu = (_rms((volume.data - other)[by.seen]) for other in (by.sound, by.truth))
    texts = list(dict.fromkeys([*volume.report.get("warnings", []), *said]))
    more = [t for t in texts if _kind(t) not in by.usual]
    # The standard kernel is sharper and noisier than the soft one by intent.
    worse = 1.0 if by.soft is None or method == "fbp" else truth_hu / by.soft
    return {
        "error_hu": error_hu, "noise_hu": by.noise, "finite": finite, "said": texts, "refused": False,
        "seconds": seconds, "verdict": verdict(error_hu, by.noise, finite, more, by.lost, worse),
        "truth_hu": truth_hu, "soft_hu": by.soft,
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
