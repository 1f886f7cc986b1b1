"""The main job: the paper's CNR tables, by FBP and PWLS, with intervals, beside the paper's numbers."""

from __future__ import annotations

import itertools
import logging
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from recon.study.paper import facts as paper
from recon.study.paper.plaque_scan import (
    INSET_MM,
    REFERENCE_KERNEL,
    REFERENCE_VOXEL_MM,
    inset_grid,
    prepare,
    roi_entry,
)
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.cnr import cnr, cnr_interval, mean_interval, sd_interval
from torchpcct.metrics.placement import RoiPair

if TYPE_CHECKING:
    from torchpcct.scan import Scan
    from torchpcct.scanner import Scanner
    from torchpcct.scene import Scene
    from torchpcct.scene.plaque import Plaque

__all__ = ["FULL_VIEWS", "INSET_MM", "Compared", "Settings", "Statistics", "inset_grid", "run"]

log = logging.getLogger(__name__)

FULL_VIEWS = 1968
"""Views per rotation of the paper's PCCT."""

PWLS_VOXEL_MM = 0.25
"""Voxel size at which PWLS is run at every dose (the paper's best for FBP); at the tables' dose it is run at all."""

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Settings:
    """Settings of the comparison.

    Args:
        realizations: noise realisations per dose (paper: 10), at least 3.
        seed: first seed; realisation i uses ``seed + i`` at every dose and for every method.
        views: views per rotation (paper: 1968). Fewer views keep the tube load of the whole scan.
        kernels, voxels_mm, doses: the axes of the tables.
        pwls: whether to run PWLS.
        pwls_everywhere: PWLS at the tables' dose for all voxel sizes and at every dose for one; False: one of each.
    """

    realizations: int = paper.REALIZATIONS
    seed: int = 0
    views: int = FULL_VIEWS
    kernels: tuple[str, ...] = paper.KERNELS
    voxels_mm: tuple[float, ...] = paper.VOXELS_MM
    doses: dict[str, float] = field(default_factory=lambda: dict(paper.DOSES))
    pwls: bool = True
    pwls_everywhere: bool = True

    def __post_init__(self) -> None:
        if self.realizations < 3:
            raise ValueError(f"realizations must be at least 3 to give an interval, got {self.realizations}")
        if self.views < 8:
            raise ValueError(f"views must be at least 8, got {self.views}")

    @classmethod
    def quick(cls, **changes: Any) -> Settings:
        """A first look in under a minute: an eighth of the views, two kernels, two voxel sizes, two doses."""
        values: dict[str, Any] = {
            "realizations": 5,
            "views": 246,
            "kernels": ("soft", "standard"),
            "voxels_mm": (0.25, 0.40),
            "doses": {"1x": 0.35, "5.7x": 2.00},
            "pwls_everywhere": False,
        }
        return cls(**{**values, **changes})


@dataclass(frozen=True)
class Statistics:
    """ROI means over the realisations of one setting."""

    method: str
    kernel: str
    voxel_mm: float
    exposure_s: float
    foreground: Any
    background: Any

    def as_dict(self) -> dict[str, Any]:
        """Means, standard deviations and CNR with their 95 % intervals."""
        result: dict[str, Any] = {
            "method": self.method,
            "kernel": self.kernel,
            "voxel_mm": self.voxel_mm,
            "exposure_s": self.exposure_s,
            "realizations": len(self.foreground),
        }
        for name, means in (("foreground", self.foreground), ("background", self.background)):
            sd = float(np.std(means, ddof=1))
            result[name] = {
                "means_hu": np.asarray(means).tolist(),
                "mean_hu": float(np.mean(means)),
                "mean_interval": list(mean_interval(means)),
                "sd_hu": sd,
                "sd_interval": list(sd_interval(sd, len(means))),
            }
        result["cnr"] = float(cnr(self.foreground, self.background))
        result["cnr_interval"] = list(cnr_interval(self.foreground, self.background))
        return result


@dataclass
class Compared:
    """Everything the report needs: statistics, noise-free means, one realisation's images."""

    settings: Settings
    rois: RoiPair
    plan: dict[str, Any]
    noise_free: list[dict[str, Any]]
    statistics: list[Statistics]
    images: dict[tuple[str, str, float], Any]
    grids: dict[float, VolumeGrid]
    shown_exposure_s: float
    voxel_noise: dict[tuple[str, str, float, float], float]
    pwls: list[dict[str, Any]]
    seconds: dict[str, float]

    def find(self, method: str, kernel: str, voxel_mm: float, exposure_s: float) -> Statistics | None:
        """The statistics of one setting, or None if it was not run."""
        for s in self.statistics:
            if (s.method, s.kernel, s.voxel_mm, s.exposure_s) == (method, kernel, voxel_mm, exposure_s):
                return s
        return None

    def as_dict(self) -> dict[str, Any]:
        """JSON values."""
        return {
            "settings": asdict(self.settings),
            "plan": self.plan,
            "rois": self.rois.as_dict(),
            "noise_free": self.noise_free,
            "statistics": [s.as_dict() for s in self.statistics],
            "noise_against_dose": dose_slopes(self),
            "pwls": self.pwls,
            "seconds": {k: round(v, 2) for k, v in self.seconds.items()},
        }


def dose_slopes(result: Compared) -> list[dict[str, Any]]:
    """Slope of log σ against log dose per method, kernel, voxel size and ROI: −½ for pure counting noise.

    The noise of the voxels (entry ``pixel``, SD across realisations, rms over the inset) pins the slope down; that of
    two ROI means over few realisations does not.
    """
    groups: dict[tuple[str, str, float], list[Statistics]] = {}
    for s in result.statistics:
        groups.setdefault((s.method, s.kernel, s.voxel_mm), []).append(s)
    slopes = []
    for (method, kernel, voxel), members in groups.items():
        if len(members) < 2:
            continue
        x = np.log([m.exposure_s for m in members])
        entry: dict[str, Any] = {"method": method, "kernel": kernel, "voxel_mm": voxel}
        for roi in ("foreground", "background"):
            y = np.log([np.std(getattr(m, roi), ddof=1) for m in members])
            entry[roi] = float(np.polyfit(x, y, 1)[0])
        noise = [result.voxel_noise.get((method, kernel, voxel, m.exposure_s)) for m in members]
        if all(noise):
            entry["pixel"] = float(np.polyfit(x, np.log(np.array(noise, dtype=float)), 1)[0])
        slopes.append(entry)
    return slopes


class _Clock:
    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.seconds[name] = self.seconds.get(name, 0.0) + now - self._last
        self._last = now


def run(
    settings: Settings | None = None,
    scene: tuple[Scene, Plaque] | None = None,
    scanner: Scanner | None = None,
    progress: Progress | None = None,
) -> Compared:
    """Simulate, reconstruct, measure.

    Args:
        settings: axes and size; None: the paper's.
        scene: a scene and its plaque, as :func:`torchpcct.scene.plaque.plaque.plaque_scene` gives; None: the paper's.
        scanner: None: the deep-silicon PCCT in counting mode.
        progress: called with the name of the step and its finished fraction.

    Raises:
        ValueError: settings out of range; ROIs that come out empty; an inset outside the field of view.
    """
    from recon.fbp.exact_noise import roi_covariance
    from recon.fbp.inset import InsetFbp
    from torchpcct.scanner import presets
    from torchpcct.scene.plaque import plaque_scene

    settings = settings or Settings()
    scanner = scanner or presets.pcct(views=settings.views)
    report = progress or (lambda step, fraction: None)
    clock = _Clock()

    scanned = prepare(
        settings.kernels, settings.voxels_mm, scene or plaque_scene(), scanner, FULL_VIEWS,
        lambda f: report("simulate", f),
    )  # fmt: skip
    clean, fine, grids, pairs, rois = scanned.clean, scanned.fine, scanned.grids, scanned.pairs, scanned.rois
    clock.lap("simulate")

    images: dict[tuple[str, str, float], Any] = {}
    noise_free = []
    reference = InsetFbp(clean, [fine], [REFERENCE_KERNEL])(clean)[0][0]
    noise_free.append(roi_entry("fbp", REFERENCE_KERNEL, REFERENCE_VOXEL_MM, rois.on(fine), reference))
    images["noise free", REFERENCE_KERNEL, REFERENCE_VOXEL_MM] = reference
    fbp = scanned.fbp
    expected = fbp(clean)
    for grid, pair, volumes in zip(grids, pairs, expected, strict=True):
        for kernel, volume in zip(settings.kernels, volumes, strict=True):
            noise_free.append(roi_entry("fbp", kernel, grid.spacing[0], pair, volume))
    clock.lap("noise-free FBP")
    report("exact noise of FBP", 0.0)
    covariances = roi_covariance(clean, fbp, pairs, 1.0)
    for entry, matrix in zip(noise_free[1:], itertools.chain.from_iterable(covariances), strict=True):
        entry["covariance_hu2_s"] = matrix.tolist()
    clock.lap("exact noise of FBP")

    collected: dict[tuple[str, str, float, float], list[tuple[float, float]]] = {}
    pwls_reports: list[dict[str, Any]] = []
    squares: dict[tuple[str, str, float, float], float] = {}
    shown_dose = _table_exposure(settings)
    total = len(settings.doses) * settings.realizations
    for done, (exposure, seed) in enumerate(_runs(settings)):
        scan = clean.with_noise(exposure, seed)
        clock.lap("noise")
        for grid, pair, volumes, truth in zip(grids, pairs, fbp(scan), expected, strict=True):
            voxel = grid.spacing[0]
            for kernel, volume, mean in zip(settings.kernels, volumes, truth, strict=True):
                key = ("fbp", kernel, voxel, exposure)
                # FBP is linear: its expectation is known, and every voxel of every run adds to the variance.
                squares[key] = squares.get(key, 0.0) + float(torch.mean((volume - mean) ** 2)) / settings.realizations
                collected.setdefault(key, []).append((float(pair[0](volume)), float(pair[1](volume))))
                if seed == settings.seed and exposure == shown_dose:
                    images["fbp", kernel, voxel] = volume
        clock.lap("FBP")
        report("noise realisations, FBP", (done + 1) / total)
    if settings.pwls:
        _run_pwls(settings, clean, grids, pairs, collected, images, pwls_reports, shown_dose, report)
        clock.lap("PWLS")
    statistics = [
        Statistics(*key, foreground=np.array(v)[:, 0], background=np.array(v)[:, 1]) for key, v in collected.items()
    ]
    return Compared(
        settings=settings,
        rois=rois,
        plan=dict(clean.info["plan"]),
        noise_free=noise_free,
        statistics=statistics,
        images=images,
        grids={g.spacing[0]: g for g in [fine, *grids]},
        shown_exposure_s=shown_dose,
        voxel_noise={key: math.sqrt(value) for key, value in squares.items()},
        pwls=pwls_reports,
        seconds=clock.seconds,
    )


def _run_pwls(
    settings: Settings, clean: Scan, grids: Any, pairs: Any, collected: Any, images: Any, reports: Any,
    shown_dose: float, report: Progress,
) -> None:  # fmt: skip
    from recon import reconstruct
    from recon.pwls.inset_problem import InsetProblem

    problems: dict[float, InsetProblem] = {}
    jobs = [
        (exposure, grid, pair)
        for exposure in settings.doses.values()
        for grid, pair in zip(grids, pairs, strict=True)
        if (exposure == shown_dose) + (grid.spacing[0] == PWLS_VOXEL_MM) >= (1 if settings.pwls_everywhere else 2)
    ]
    for done, (exposure, grid, pair) in enumerate(jobs):
        voxel = grid.spacing[0]
        scans = [clean.with_noise(exposure, seed) for e, seed in _runs(settings) if e == exposure]
        if voxel not in problems:
            problems[voxel] = InsetProblem(clean, grid)

        def inner(fraction: float, done: int = done) -> None:
            report("PWLS", (done + fraction) / len(jobs))

        volumes = reconstruct(scans, grid, "pwls", problem=problems[voxel], progress=inner)
        collected["pwls", "q-GGMRF", voxel, exposure] = [
            (float(pair[0](v.data)), float(pair[1](v.data))) for v in volumes
        ]
        reports.append(
            {
                "voxel_mm": voxel,
                "exposure_s": exposure,
                "largest_rmsd_hu": max(v.report["rmsd_hu"][-1] for v in volumes),
                "seconds_per_volume": float(np.mean([v.report["seconds"] for v in volumes])),
                **volumes[0].report,
            }
        )
        if exposure == shown_dose:
            images["pwls", "q-GGMRF", voxel] = volumes[0].data


def _table_exposure(settings: Settings) -> float:
    exposures = list(settings.doses.values())
    return paper.TABLE_EXPOSURE_S if paper.TABLE_EXPOSURE_S in exposures else exposures[-1]


def _runs(settings: Settings) -> Iterator[tuple[float, int]]:
    for exposure in settings.doses.values():
        for i in range(settings.realizations):
            yield exposure, settings.seed + i
