"""What dose MBIR saves at the paper's plaque, beside FBP, PWLS and the best simple filter: the main
job.

One task of the instrument (:mod:`recon.evaluate`): every method on the same noise realisations.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import torch

from recon.evaluate.experiment import Evaluation, evaluate
from recon.evaluate.report import plain, task_sections
from recon.evaluate.tasks import read_task
from recon.jobs.store import StudyCache
from recon.study.energies import VIEWS, energy_rows
from recon.study.figures import extent
from recon.study.paper import published as paper
from recon.study.study import Measured, Progress, StudySettings, silent
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.roi import axial_grid, sample_axial
from torchpcct.scanner import presets
from torchpcct.validate import numbers
from torchpcct.viz import Panel, panels

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from recon.evaluate.task import Task
    from torchpcct.typing import JsonObject

SCREEN = "compare_screen"
"""Template of what a terminal shows: the answer, the dose factors of every method, and where the
rest is."""

_LOW_S = paper.DOSES["1x"]
"""The paper's lowest exposure, s."""
_HIGH_S = paper.DOSES["5.7x"]
"""The paper's highest exposure, s."""


@dataclass(frozen=True)
class CompareSettings(StudySettings):
    """Settings of the comparison.

    Args:
        methods: what is measured, see :mod:`recon.evaluate.methods`.
        n: noise realisations of each, at least 8.
        seed: of the first.
        views: views per rotation.
        exposures_s: of the scans in s.
        energies_views: of the scan for what the weights of energy bins bring
            (:mod:`recon.study.energies`); 0: it is not computed.
    """

    methods: tuple[str, ...] = (
        "fbp:soft",
        "fbp:standard",
        "fbp:detail",
        "fbp:bone",
        "pwls",
        "bilateral@fbp:detail",
        "mbir",
    )
    n: int = 16
    seed: int = 0
    views: int = paper.FULL_VIEWS["PCCT"]
    exposures_s: tuple[float, ...] = (0.35, 2.0)
    energies_views: int = VIEWS

    # An eighth of the views, 8 realisations, no PWLS: some minutes on two slow cores.
    QUICK: ClassVar[Mapping[str, object]] = {
        "views": 246,
        "n": 8,
        "energies_views": 48,
        "methods": ("fbp:soft", "bilateral@fbp:detail", "mbir"),
    }

    def __post_init__(self) -> None:
        self.check_whole(n=8, seed=0, views=8, energies_views=0)
        numbers("exposures_s", self.exposures_s, positive=True, unit="s")
        if not self.methods:
            raise ValueError("methods must name at least one method")


def measure(
    settings: CompareSettings, progress: Progress = silent, folder: str | Path | None = None
) -> Measured:
    """Simulate, reconstruct, measure; see :mod:`recon.study.study`."""
    s = settings
    task = _task(s)
    cache = StudyCache(folder, settings)
    found = _evaluated(s, task, cache.folder("evaluate"), progress)
    records = plain(found.records)
    data = {
        "claim": claim(records),
        "records": records,
        "reference": task.reference,
        "tables": "\n\n".join(task_sections(found)),
        "peak_memory_gib": _peak_memory_gib(),
    }
    if s.energies_views:
        rows = partial(energy_rows, task, views=s.energies_views, progress=progress)
        data["energies"] = cache("energies", rows)
    return Measured(s, data, found)


def plan(settings: CompareSettings, folder: str | Path | None) -> None:
    """List the jobs that are left; see :mod:`recon.study.study`."""
    folder = StudyCache(folder, settings).folder("evaluate")
    _evaluated(settings, _task(settings), folder, silent)


def _task(s: CompareSettings) -> Task:
    return replace(read_task("plaque"), scanner=presets.pcct(views=s.views))


def _evaluated(
    s: CompareSettings, task: Task, folder: Path | None, progress: Progress
) -> Evaluation:
    return evaluate(
        task,
        s.methods,
        exposures_s=s.exposures_s,
        n=s.n,
        seed=s.seed,
        folder=folder,
        progress=progress,
    )


def claim(records: list[JsonObject]) -> JsonObject | None:
    """The paper's claim made testable, from records of an evaluation: MBIR at 0.35 s has the CNR of
    FBP at 2 s.

    Returns:
        Both CNRs, the dose factor at 0.35 s, the one that is needed, and whether it is as large:
        ``"yes"`` or ``"no"`` where the whole interval is, else ``"open"``; None where one of the
        two was not measured.
    """

    def found(method: str, exposure_s: float, figure: str) -> JsonObject | None:
        wanted = {"method": method, "exposure_s": exposure_s, "figure": figure, "where": "small"}
        return next((r for r in records if wanted.items() <= r.items()), None)

    ours, factor = found("mbir", _LOW_S, "CNR"), found("mbir", _LOW_S, "dose factor: CNR")
    fbp = found("fbp:soft", _HIGH_S, "CNR")
    if ours is None or factor is None or fbp is None:
        return None
    needed = _HIGH_S / _LOW_S
    low, high = (factor["value"] if factor[end] is None else factor[end] for end in ("low", "high"))
    met = "yes" if low >= needed else "no" if high < needed else "open"
    return {
        "mbir_s": _LOW_S,
        "fbp_s": _HIGH_S,
        "needed": needed,
        "mbir": ours,
        "fbp": fbp,
        "factor": factor,
        "met": met,
    }


def figures(measured: Measured) -> JsonObject:
    """Axial and sagittal sections of one realisation at the largest exposure, the truth first,
    and without noise."""
    evaluation: Evaluation = measured.seen
    seen = evaluation.results[0]
    grid, dose = seen.task.grid, max(measured.settings.exposures_s)
    image = axial_grid(grid.center)
    section = VolumeGrid(
        (int(8.75 / image.spacing[1]), 1, image.shape[2]), image.spacing[1], image.center
    )
    columns: list[tuple[str, NDArray[np.floating]]] = [("truth", seen.truth)]
    for name in measured.settings.methods:
        columns.append((name.replace("@", "\n@ "), seen.volumes[name, dose][0]))
    rows: list[list[Panel]] = [[], []]
    for title, volume in columns:
        hu = torch.as_tensor(volume).float()
        rows[0].append(Panel(sample_axial(hu, grid, image)[0], extent(image), title))
        rows[1].append(Panel(sample_axial(hu, grid, section)[:, 0], extent(section, 0, 2)))
    figure = panels(
        rows,
        ("axial", "sagittal (x–z)"),
        f"Plaque, deep-silicon PCCT, {dose:g} s, one realisation",
        f"C150 / W600 HU, voxels of {grid.spacing[0]:.2f} mm.",
    )
    return {
        "compare.png": figure,
        "dose_factors.png": dose_chart(measured.data["records"], measured.settings),
    }


_QUESTIONS = (
    ("the paper's CNR", "dose factor: CNR", "small"),
    ("contrast of the lesion", "dose factor: contrast at slope 1", "lesion"),
    ("noise of a voxel in fat", "dose factor: noise", "patient"),
)
"""Questions: title, figure and place of each dose factor."""
_BEYOND = 1000.0
"""Intervals are drawn to this factor, and its inverse."""


def dose_chart(records: list[JsonObject], settings: CompareSettings) -> Figure:
    """Dose factors with their intervals by question, a colour for each exposure; 1 and what the
    paper assumes marked.

    Args:
        records: of an evaluation.
        settings: what was measured.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter

    methods, exposures = list(settings.methods), sorted(settings.exposures_s)
    figure = Figure((12.4, 0.9 + 0.24 * len(methods)), dpi=110, layout="constrained")
    panels = figure.subplots(1, len(_QUESTIONS), sharey=True, squeeze=False)[0]
    for axes, (title, name, where) in zip(panels, _QUESTIONS, strict=True):
        axes.axvline(1.0, color="0.4", linewidth=1.0)
        axes.axvline(
            paper.DOSES["5.7x"] / paper.DOSES["1x"], color="tab:red", linewidth=1.0, linestyle=":"
        )
        for k, exposure in enumerate(exposures):
            place = 0.3 * (k - (len(exposures) - 1) / 2)
            for row, method in enumerate(methods):
                wanted = {"method": method, "exposure_s": exposure, "figure": name, "where": where}
                found = next((r for r in records if wanted.items() <= r.items()), None)
                if found is None or not found["value"] > 0.0:
                    continue
                ends = [
                    found[end] if found[end] is not None and found[end] > 0 else found["value"]
                    for end in ("low", "high")
                ]
                low, high = np.clip(ends, 1.0 / _BEYOND, _BEYOND)
                axes.plot([low, high], [row + place] * 2, color=f"C{k}", linewidth=2.0, alpha=0.6)
                axes.plot(found["value"], row + place, "o", color=f"C{k}", markersize=4.0)
        axes.set_xscale("log")
        low, high = axes.get_xlim()
        axes.set_xlim(min(low, 0.4), max(high, 8.0))
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 20.0 else (1.0,)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_title(title, fontsize=10)
        axes.grid(axis="x", color="0.9")
        axes.tick_params(labelsize=8)
    panels[0].set_yticks(range(len(methods)), methods)
    panels[0].set_ylim(len(methods) - 0.5, -0.5)
    panels[0].set_xlabel("costs dose ←   1   → saves dose", fontsize=8)
    panels[-1].plot([], [], color="tab:red", linestyle=":", label="the paper assumes 5.7")
    for k, exposure in enumerate(exposures):
        panels[-1].plot([], [], "o", color=f"C{k}", markersize=4.0, label=f"{exposure:g} s")
    panels[-1].legend(fontsize=8, frameon=False, loc="upper right")
    return figure


def _peak_memory_gib() -> float:
    """Of this process; 0 where the system does not say (Windows)."""
    try:
        import resource
    except ImportError:
        return 0.0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**30 if sys.platform == "darwin" else peak / 2**20
