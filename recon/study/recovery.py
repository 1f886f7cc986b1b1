"""What each method shows of small and faint bodies in the paper's scan, by dose: contrast recovery
by insertion (:mod:`recon.evaluate.insertion`)."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import torch

from recon.evaluate.insertion import REFERENCE, ContrastRecovery, InsertedBall, contrast_recovery
from recon.evaluate.names import check_method
from recon.jobs.store import StudyCache
from recon.least_squares.inset_problem import InsetProblem
from recon.mbir.mbir import Mbir
from recon.mbir.unrolled import DEFAULT_FIDELITY
from recon.study.paper import published as paper
from recon.study.paper.plaque_scan import duty
from recon.study.study import Measured, Progress, StudySettings, silent
from torchpcct.acquisition.acquire import acquire
from torchpcct.geometry import VolumeGrid
from torchpcct.scan import Scan
from torchpcct.scanner import presets
from torchpcct.scene.plaque import plaque_scene
from torchpcct.validate import number, numbers

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from torchpcct.typing import JsonObject


_EDGE_MM = 9.2
"""Of the inset about the plaque, seen in every view."""


@dataclass(frozen=True)
class RecoverySettings(StudySettings):
    """Settings of the study.

    Args:
        methods: what is measured, see :mod:`recon.evaluate.methods`.
        balls: diameters in mm and contrasts in HU.
        exposures_s: of the scans in s. The noise of the shortest and of the longest is near the
            ends of what MBIR is trained for.
        n: noise realisations.
        places: balls in each, at other places in each realisation.
        seed: of the first realisation.
        views: per rotation.
        voxel_mm: of the volumes.
    """

    methods: tuple[str, ...] = (
        "fbp:standard",
        "pwls",
        "bilateral@fbp:detail",
        "mbir:prior=bilateral",
        "mbir",
        "mbir:fidelity=1",
    )
    balls: tuple[tuple[float, float], ...] = (
        (0.5, 600.0),
        (0.5, 300.0),
        (1.0, 400.0),
        (1.0, 100.0),
        (1.0, -100.0),
        (1.5, 50.0),
    )
    exposures_s: tuple[float, ...] = (0.06, paper.DOSES["1x"], paper.DOSES["5.7x"], 12.0)
    n: int = 2
    places: int = 8
    seed: int = 0
    views: int = paper.FULL_VIEWS["PCCT"]
    voxel_mm: float = 0.2

    # An eighth of the views, one realisation, one ball, the paper's exposures.
    QUICK: ClassVar[Mapping[str, object]] = {
        "views": 246,
        "exposures_s": (paper.DOSES["1x"], paper.DOSES["5.7x"]),
        "n": 1,
        "balls": ((1.0, 100.0),),
        "methods": ("pwls", "mbir"),
    }

    def __post_init__(self) -> None:
        self.check_whole(n=1, places=2, seed=0, views=8)
        numbers("exposures_s", self.exposures_s, positive=True, unit="s")
        number("voxel_mm", self.voxel_mm, positive=True, high=0.5, unit="mm")
        if not self.methods or not self.balls:
            raise ValueError("methods and balls must name at least one each")
        for method in self.methods:
            check_method(method)
        for ball in self.balls:
            InsertedBall(*ball)


def measure(
    settings: RecoverySettings, progress: Progress = silent, folder: str | Path | None = None
) -> Measured:
    """Insert, reconstruct, compare; see :mod:`recon.study.study`.

    ``rows`` of the data, one for each exposure, ball and method: ``exposure_s``, ``diameter_mm``,
    ``contrast_hu``, ``method``, ``recovered`` with its ``standard_error`` (over places and
    realisations), ``soft_fbp``, ``verdict`` (``less``, ``more`` or ``as much`` as soft FBP), the
    ``detectability`` d′ of the ball in the readings, and how many ``balls`` there were.
    ``noise_scale_hu``: of each exposure.
    """
    s = settings
    cache = StudyCache(folder, s)
    jobs = _pairs(s)
    cache.ahead(_realisation, jobs)
    clean = _clean(s, cache)
    found: dict[tuple[float, int], list[dict[str, object]]] = {}
    for k, job in enumerate(jobs):
        progress("realisations", k / len(jobs))
        found[job] = _realisation(s, cache, *job, clean=clean)
    progress("realisations", 1.0)
    rows = []
    for exposure in s.exposures_s:
        of_draws = [found[exposure, seed] for seed in range(s.seed, s.seed + s.n)]
        rows += [_pooled(exposure, same) for same in zip(*of_draws, strict=True)]
    noise = _noise_scales(clean, _grid(s), s.exposures_s)
    data = {
        "rows": rows,
        "reference": REFERENCE,
        "noise_scale_hu": noise,
        "weights_sha256": Mbir.load().weights_sha256,
    }
    return Measured(s, data)


def plan(settings: RecoverySettings, folder: str | Path | None) -> None:
    """List the jobs that are left; see :mod:`recon.study.study`."""
    StudyCache(folder, settings).plan((_realisation, _pairs(settings)))


def _pairs(s: RecoverySettings) -> list[tuple[float, int]]:
    """Exposure and seed of each realisation."""
    return [(e, seed) for e in s.exposures_s for seed in range(s.seed, s.seed + s.n)]


def mbir_recovery(report: JsonObject) -> str:
    """JSON of the rows of MBIR with the weights that ship, as :mod:`recon.mbir.recovery_note` reads
    them.

    Args:
        report: of this study.
    """
    scales = dict(zip(report["settings"]["exposures_s"], report["noise_scale_hu"], strict=True))
    fidelities = {"mbir": DEFAULT_FIDELITY, "mbir:fidelity=1": 1.0}
    rows = [
        {
            "noise_scale_hu": round(scales[row["exposure_s"]], 3),
            "fidelity": fidelities[row["method"]],
            **{key: row[key] for key in ("diameter_mm", "contrast_hu")},
            **{key: round(row[key], 4) for key in ("recovered", "soft_fbp")},
        }
        for row in report["rows"]
        if row["method"] in fidelities
    ]
    return json.dumps({"weights_sha256": report["weights_sha256"], "rows": rows}, indent=1) + "\n"


def _grid(settings: RecoverySettings) -> VolumeGrid:
    n = round(_EDGE_MM / settings.voxel_mm)
    return VolumeGrid((n, n, n), settings.voxel_mm, plaque_scene()[1].position[::-1])


def _noise_scales(clean: Scan, grid: VolumeGrid, exposures_s: Sequence[float]) -> list[float]:
    """HU of the noise scale (:mod:`recon.data_term`) at each exposure."""
    problem = InsetProblem(clean, grid)
    nothing = torch.zeros(1, *grid.shape)
    return [float(problem.term_of(nothing, e).in_noise_units().unit_hu) for e in exposures_s]


def _clean(settings: RecoverySettings, cache: StudyCache) -> Scan:
    """The noise-free scan."""
    scene, _ = plaque_scene()
    scanner = presets.pcct(views=settings.views)
    on = duty(scanner, paper.FULL_VIEWS["PCCT"])
    scan: Scan = cache("scan", lambda: acquire(scene, scanner, region=_grid(settings), duty=on))
    return scan


def _realisation(
    settings: RecoverySettings,
    cache: StudyCache,
    exposure_s: float,
    seed: int,
    clean: Scan | None = None,
) -> list[dict[str, object]]:
    """All balls and methods in one noise realisation."""
    rows: list[dict[str, object]] = cache(
        f"{exposure_s:g}_{seed}", partial(_rows, settings, cache, exposure_s, seed, clean)
    )
    return rows


def _rows(
    s: RecoverySettings, cache: StudyCache, exposure_s: float, seed: int, clean: Scan | None
) -> list[dict[str, object]]:
    scan = clean or _clean(s, cache)
    balls = [InsertedBall(*ball) for ball in s.balls]
    found = contrast_recovery(
        scan.with_noise(exposure_s, seed),
        _grid(s),
        list(s.methods),
        balls,
        n=s.places,
        seed=seed,
    )
    return [row.as_dict() for row in found]


def _pooled(exposure_s: float, rows: Sequence[JsonObject]) -> dict[str, object]:
    """One ball and method over the realisations."""
    first = rows[0]
    together = ContrastRecovery(
        first["method"],
        InsertedBall(first["diameter_mm"], first["contrast_hu"]),
        tuple(v for row in rows for v in row["values"]),
        tuple(v for row in rows for v in row["reference"]),
        tuple(tuple(p) for row in rows for p in row["places_mm"]),
        float(np.mean([row["detectability"] for row in rows])),
    )
    kept = ("diameter_mm", "contrast_hu", "method", "recovered", "standard_error")
    found = together.as_dict()
    return {
        "exposure_s": exposure_s,
        **{key: found[key] for key in (*kept, "soft_fbp", "verdict", "detectability")},
        "balls": len(together.values),
    }


def figures(measured: Measured) -> dict[str, Figure]:
    """Contrast recovery by ball, a colour for each method, an exposure in each panel."""
    from matplotlib.figure import Figure

    s: RecoverySettings = measured.settings
    rows = measured.data["rows"]
    across = min(len(s.exposures_s), 2)
    down = math.ceil(len(s.exposures_s) / across)
    figure = Figure((5.4 * across, 3.6 * down + 0.6), dpi=110, layout="constrained")
    panels: NDArray[np.object_] = figure.subplots(down, across, sharey=True, squeeze=False).ravel()
    width = 0.8 / len(s.methods)
    for axes in panels[len(s.exposures_s) :]:
        axes.set_axis_off()
    for axes, exposure in zip(panels, s.exposures_s, strict=False):
        at = np.arange(len(s.balls))
        for k, method in enumerate(s.methods):
            of = [r for r in rows if r["exposure_s"] == exposure and r["method"] == method]
            axes.bar(
                at - 0.4 + (k + 0.5) * width,
                [r["recovered"] for r in of],
                width,
                yerr=[2.0 * (r["standard_error"] or 0.0) for r in of],
                label=method,
                error_kw={"linewidth": 1.0},
            )
        soft = [
            next(
                r["soft_fbp"]
                for r in rows
                if r["exposure_s"] == exposure and (r["diameter_mm"], r["contrast_hu"]) == tuple(b)
            )
            for b in s.balls
        ]
        for place, value in zip(at, soft, strict=True):
            axes.plot([place - 0.45, place + 0.45], [value] * 2, color="black", linewidth=1.5)
        axes.plot([], [], color="black", linewidth=1.5, label=REFERENCE)
        axes.axhline(1.0, color="0.6", linewidth=0.8)
        axes.set_xticks(at, [f"{d:g} mm\n{c:+g} HU" for d, c in s.balls], fontsize=8)
        axes.set_title(f"{exposure:g} s", fontsize=10)
        axes.grid(axis="y", color="0.9")
        axes.set_axisbelow(True)
    for axes in panels[::across]:
        axes.set_ylabel("contrast shown / true contrast")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, fontsize=8, frameon=False, loc="outside lower center", ncols=4)
    return {"recovery.png": figure}
