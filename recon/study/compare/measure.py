"""The paper's plaque by every method on the same noise realisations: one task of the instrument."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from recon.evaluate.experiment import Evaluation, evaluate
from recon.evaluate.store import Pieces
from recon.evaluate.tasks import read_task
from recon.study.compare.settings import Settings
from recon.study.study import Clock, Progress, silent
from torchpcct.scanner import presets

__all__ = ["Measured", "measure"]


@dataclass(frozen=True)
class Measured:
    """What the report needs: the evaluation, and seconds per step."""

    settings: Settings
    evaluation: Evaluation
    seconds: dict[str, float]


def measure(settings: Settings, progress: Progress = silent, folder: str | Path | None = None) -> Measured:
    """Simulate, reconstruct, measure; see :mod:`recon.study.study`."""
    s, clock = settings, Clock()
    task = replace(read_task("plaque"), scanner=presets.pcct(views=s.views))
    kept = Pieces(folder, settings).folder("evaluate")
    found = evaluate(task, s.methods, exposures_s=s.exposures_s, n=s.n, seed=s.seed, folder=kept, progress=progress)
    clock.lap("evaluation")
    return Measured(settings, found, clock.seconds)
