"""Measure any reconstruction at any task: how much dose does it save, and what does it do to the
image?

:func:`evaluate` runs tasks (:mod:`~recon.evaluate.task`, ready ones in
:mod:`~recon.evaluate.tasks`) × methods (:mod:`~recon.evaluate.methods`) on the same noise
realisations (:mod:`~recon.evaluate.realisations`), reads the volumes
(:mod:`~recon.evaluate.measure`) and gives figures with intervals
(:mod:`~recon.evaluate.estimates`), of which :func:`save` makes a report. What every method has to
beat is in :mod:`~recon.evaluate.rivals`: the strongest simple filters of a volume. Where nobody
knows the truth: :func:`evaluate_scans`, and :func:`contrast_recovery`, what a method would show of
a lesion in a given scan.

Your denoiser on a lung nodule::

    from recon.evaluate import denoiser, evaluate, save

    found = evaluate(
        "nodule", ["mbir", denoiser(mine, "fbp:detail")], n=20, folder="out/mine/cache"
    )
    save(found, "out/mine")
"""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from recon.evaluate.experiment import Evaluation, evaluate, export_scans
    from recon.evaluate.insertion import (
        ContrastRecovery,
        InsertedBall,
        contrast_recovery,
    )
    from recon.evaluate.methods import Method, denoiser, method_of
    from recon.evaluate.names import TASKS
    from recon.evaluate.report import save
    from recon.evaluate.task import Task
    from recon.evaluate.tasks import read_task
    from recon.evaluate.without_truth import evaluate_scans, evaluate_volumes
    from recon.filters import deepinv_denoiser

__all__ = [
    "TASKS",
    "ContrastRecovery",
    "Evaluation",
    "InsertedBall",
    "Method",
    "Task",
    "contrast_recovery",
    "deepinv_denoiser",
    "denoiser",
    "evaluate",
    "evaluate_scans",
    "evaluate_volumes",
    "export_scans",
    "method_of",
    "read_task",
    "save",
]

_SOURCES = {
    "recon.evaluate.insertion": ("ContrastRecovery", "InsertedBall", "contrast_recovery"),
    "recon.evaluate.experiment": ("Evaluation", "evaluate", "export_scans"),
    "recon.evaluate.names": ("TASKS",),
    "recon.evaluate.methods": ("Method", "denoiser", "method_of"),
    "recon.evaluate.report": ("save",),
    "recon.evaluate.task": ("Task",),
    "recon.evaluate.tasks": ("read_task",),
    "recon.evaluate.without_truth": ("evaluate_scans", "evaluate_volumes"),
    "recon.filters": ("deepinv_denoiser",),
}
"""Where the names of the package come from, at their first use."""


def __getattr__(name: str) -> object:
    """A name of another module, which loads (torch, numba) when the name is first used."""
    for module, names in _SOURCES.items():
        if name in names:
            return getattr(importlib.import_module(module), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
