"""FBP of the plaque with every kernel, voxel size and dose: CNR tables, and which rankings they
establish.

The ROI means of FBP are inner products of the line integrals with adjoint vectors
(:mod:`recon.analytic.exact_noise`). So their joint covariance is exact, and hundreds of
realisations cost one noisy scan each instead of a reconstruction per kernel and voxel size; a few
are reconstructed in full, too, which must give the same ROI means.

All settings (kernels × voxel sizes) of a realisation are made of one scan: their ROI means are
jointly normal with that covariance. So three things are computable: the truth (exact CNR of every
setting), what experiments of ten realisations would report (drawn from the joint law), and how sure
a measured ranking is (paired bootstrap over its realisations).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import stats
from torch import Tensor

from recon.analytic.exact_noise import roi_adjoints
from recon.jobs.store import StudyCache
from recon.study.figures import extent, roi_outlines
from recon.study.paper import published as paper
from recon.study.paper.plaque_scan import (
    REFERENCE_KERNEL,
    REFERENCE_VOXEL_MM,
    PlaqueScan,
    prepare,
    reference_fbp,
)
from recon.study.report import Check, around
from recon.study.study import Measured, Progress, StudySettings, silent
from torchpcct.metrics.cnr import cnr_from_moments, cnr_interval, cnr_range, sd_interval
from torchpcct.metrics.intervals import bca_interval, leave_one_out, resampling
from torchpcct.metrics.roi import sample_axial
from torchpcct.scan import Scan
from torchpcct.scanner import presets
from torchpcct.scene.plaque import plaque_scene
from torchpcct.viz import Panel, panels

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike

    from torchpcct.typing import JsonObject


Floats = NDArray[np.float64]

_BLOCK = 40
"""Realisations whose readings are cached together."""
_SQUARES = 4
"""Realisations per dose of which every reading's squared deviation is summed: 10⁶ independent
readings pin the variance of an ROI mean down to some 0.1 %, which a few hundred ROI means do not.
"""
_TEN = paper.REALISATIONS
"""Realisations of the paper's tables."""
_BOOTSTRAP = 40_000
"""Resamplings of intervals that hold for all pairs of settings together."""
_IMAGES_SCALE = 0.62
"""Of the pictures: noise does not compress; twenty panels stay below 400 kB at this size."""


@dataclass(frozen=True)
class NoiseSettings(StudySettings):
    """Settings of the noise study.

    Args:
        realisations: paired noise realisations per dose, at least 10 (the paper's number).
        seed: first seed; realisation i uses ``seed + i`` at every dose.
        views: views per rotation. Fewer than the paper's keep the tube load of the whole scan.
        kernels, voxels_mm: of FBP.
        doses: name → exposure in s.
        reconstructed: realisations at the tables' dose that are reconstructed in full, at least 1.
        experiments: number of simulated experiments of 10 realisations.
    """

    realisations: int = 200
    seed: int = 0
    views: int = paper.FULL_VIEWS["PCCT"]
    kernels: tuple[str, ...] = paper.KERNELS
    voxels_mm: tuple[float, ...] = paper.VOXELS_MM
    doses: dict[str, float] = field(default_factory=lambda: dict(paper.DOSES))
    reconstructed: int = 3
    experiments: int = 20_000

    # An eighth of the views, two kernels, three voxel sizes, two doses.
    QUICK: ClassVar[dict[str, object]] = {
        "realisations": 40,
        "views": 246,
        "kernels": ("soft", "standard"),
        "voxels_mm": (0.20, 0.25, 0.40),
        "doses": {"1x": 0.35, "5.7x": 2.00},
        "reconstructed": 2,
        "experiments": 4000,
    }

    def __post_init__(self) -> None:
        self.check_whole(realisations=10, seed=0, views=8, reconstructed=1, experiments=100)
        if len(self.kernels) * len(self.voxels_mm) < 2:
            raise ValueError(
                "a ranking needs at least two settings: give more kernels or voxels_mm"
            )
        if len(self.doses) < 2:
            raise ValueError(f"doses must hold at least two exposures, got {self.doses}")

    @property
    def axes(self) -> list[tuple[str, float]]:
        """Every (kernel, voxel size), the voxel size varying slowest."""
        return [(k, v) for v in self.voxels_mm for k in self.kernels]

    @property
    def table_exposure_s(self) -> float:
        """Exposure that the tables are shown for: the paper's, or the last."""
        exposures = list(self.doses.values())
        return paper.TABLE_EXPOSURE_S if paper.TABLE_EXPOSURE_S in exposures else exposures[-1]


@dataclass
class Moments:
    """What the study computes and draws. ``S`` settings: :attr:`NoiseSettings.axes`.

    Attributes:
        scanned: noise-free scan, grids and ROIs.
        expected: ``(S, 2)`` exact ROI means in HU: core, fibrous.
        covariance: ``(2 S, 2 S)`` HU² at 1 s, exact.
        means: exposure → ``(n, S, 2)`` ROI means of every realisation.
        variances: exposure → ``(2 S,)`` variance of the ROI means from the readings' squared
            deviations, HU².
        images: (kernel, voxel) → volume of one realisation at the tables' dose.
    """

    scanned: PlaqueScan
    expected: Floats
    covariance: Floats
    means: dict[float, Floats]
    variances: dict[float, Floats]
    images: dict[tuple[str, float], Tensor] = field(default_factory=dict)

    def exact(self, exposure_s: float) -> RoiStatistics:
        """The truth at an exposure."""
        return RoiStatistics(
            self.expected,
            np.sqrt(np.diag(self.covariance) / exposure_s).reshape(self.expected.shape),
        )


def measure(
    settings: NoiseSettings, progress: Progress = silent, folder: str | Path | None = None
) -> Measured:
    """Simulate, take exact moments, draw realisations, reconstruct a few in full; finished
    parts are cached."""
    s, cache = settings, StudyCache(folder, settings)
    scanner, full = presets.pcct(views=s.views), paper.FULL_VIEWS["PCCT"]
    scanned = prepare(
        s.kernels, s.voxels_mm, plaque_scene(), scanner, full, partial(progress, "simulate"), cache
    )
    clean = scanned.clean
    fine = reference_fbp(clean, scanned.fine)
    core, fibrous = (float(roi(fine)) for roi in scanned.rois.on(scanned.fine))
    expected = scanned.roi_means(scanned.fbp(clean))
    progress("noise-free FBP", 1.0)
    adjoints = roi_adjoints(clean, scanned.fbp, scanned.pairs)
    covariance = adjoints.joint_covariance(clean, 1.0)
    near, matrix = clean.crop(adjoints.window), adjoints.matrix
    del adjoints
    progress("exact noise", 1.0)
    means, variances = _realisations(s, near, matrix, expected, cache, progress)
    m = Moments(scanned, expected, covariance, means, variances)
    exposure = s.table_exposure_s
    full_runs = partial(
        _reconstructions, s, scanned, means[exposure], m.exact(exposure).sd, progress
    )
    m.images, compared = cache("full_reconstructions", full_runs)
    data = {
        "plan": dict(clean.info["plan"]),
        "rois": scanned.rois.as_dict(),
        "noise_free_reference": {
            "kernel": REFERENCE_KERNEL,
            "voxel_mm": REFERENCE_VOXEL_MM,
            "foreground_hu": core,
            "background_hu": fibrous,
        },
        "order": (
            "settings: voxel size slowest, then kernel; ROI means: setting, then core / fibrous"
        ),
        "axes": s.axes,
        "expected_hu": np.round(expected, 4),
        "covariance_hu2_at_1s": np.round(covariance, 4),
        "full_reconstructions": compared,
        "table_exposure_s": exposure,
        "doses": {name: _dose_table(s, m, dose) for name, dose in s.doses.items()},
        "noise_against_dose": _against_dose(s, m),
        "ten_run_experiments": _ten_run_experiments(s, m, exposure),
        "pairs": _pairs(s, m, exposure),
    }
    progress("statistics", 1.0)
    return Measured(s, data, m)


def _realisations(
    settings: NoiseSettings,
    near: Scan,
    matrix: Tensor,
    expected: Floats,
    cache: StudyCache,
    progress: Progress,
) -> tuple[dict[float, Floats], dict[float, Floats]]:
    """``means`` and ``variances`` of :class:`Moments`, from the noise-free readings that the ROIs
    see and the adjoint vectors, a row of ``matrix`` for every ROI mean."""
    quiet = near.line_integrals().flatten()
    means: dict[float, Floats] = {}
    variances: dict[float, Floats] = {}
    total = len(settings.doses) * settings.realisations
    n = settings.realisations
    for exposure in settings.doses.values():

        def block(first: int, exposure: float = exposure) -> tuple[Floats, Floats]:
            values, squares = [], np.zeros(matrix.shape[0])
            for i in range(first, min(first + _BLOCK, n)):
                deviation = (
                    near.with_noise(exposure, settings.seed + i).line_integrals().flatten() - quiet
                )
                values.append(
                    expected + (matrix @ deviation).double().numpy().reshape(expected.shape)
                )
                if i < _SQUARES:
                    for row, h in enumerate(matrix):
                        squares[row] += (
                            float((h * deviation).square().sum(dtype=torch.float64)) / _SQUARES
                        )
                progress("noise realisations", (len(means) * n + i + 1) / total)
            return np.array(values), squares

        found = [
            cache(f"realisations/{exposure:g}s_{k}", partial(block, k)) for k in range(0, n, _BLOCK)
        ]
        means[exposure] = np.concatenate([values for values, _ in found])
        variances[exposure] = np.sum([squares for _, squares in found], axis=0)
    return means, variances


def _reconstructions(
    settings: NoiseSettings, scanned: PlaqueScan, means: Floats, sd: Floats, progress: Progress
) -> tuple[dict[tuple[str, float], Tensor], dict[str, float]]:
    """The first realisation's images at the tables' dose, and how far FBP in full is from
    ``means`` ``(n, S, 2)``."""
    images: list[Tensor] = []
    differences = []
    for i in range(min(settings.reconstructed, settings.realisations)):
        volumes = scanned.fbp(
            scanned.clean.with_noise(settings.table_exposure_s, settings.seed + i)
        )
        differences.append(scanned.roi_means(volumes) - means[i])
        images = images or [image for grid in volumes for image in grid]
        progress("full reconstructions", (i + 1) / settings.reconstructed)
    far = np.abs(np.array(differences))
    return dict(zip(settings.axes, images, strict=True)), {
        "reconstructed": len(differences),
        "largest_difference_hu": float(far.max()),
        "largest_difference_in_sd": float((far / sd).max()),
    }


def _dose_table(s: NoiseSettings, m: Moments, exposure: float) -> list[dict[str, object]]:
    """One row per setting: exact, by all realisations, by the first ten, and the paper's
    entries."""
    exact, values = m.exact(exposure), m.means[exposure]

    def sampled(runs: Floats, i: int, **more: Any) -> JsonObject:
        table = measured_table(runs[:, i : i + 1])
        interval = list(cnr_interval(runs[:, i, 0], runs[:, i, 1]))
        return {
            "mean_hu": table.mean[0],
            "sd_hu": table.sd[0],
            "cnr": table.cnr[0],
            "cnr_interval": interval,
            **more,
        }

    rows = []
    for i, (kernel, voxel) in enumerate(s.axes):
        measured, ten = sampled(values, i), sampled(values[:_TEN], i)
        measured["sd_interval"] = [
            list(sd_interval(float(v), len(values))) for v in measured["sd_hu"]
        ]
        both = slice(2 * i, 2 * i + 2)
        ten["cnr_range"] = list(cnr_range(exact.mean[i], m.covariance[both, both] / exposure, _TEN))
        theirs = [
            published(t, kernel, voxel, exposure)
            for t in (paper.FOREGROUND, paper.BACKGROUND, paper.CNR)
        ]
        rows.append(
            {
                "kernel": kernel,
                "voxel_mm": voxel,
                "exposure_s": exposure,
                "exact": {"mean_hu": exact.mean[i], "sd_hu": exact.sd[i], "cnr": exact.cnr[i]},
                "measured": measured,
                "ten_runs": ten,
                "paper": None if theirs[2] is None else {"rois": theirs[:2], "cnr": theirs[2]},
            }
        )
    return rows


def _against_dose(s: NoiseSettings, m: Moments) -> dict[str, object]:
    """Slope of log σ of the ROI means against log exposure, −½ for counting noise, and how exact
    the noise is.

    ``slopes``: ``(2 S,)``, from the readings' squared deviations; ``sampled_slopes``: from the SDs
    of the realisations; ``variance_ratios``: lowest and highest of the first variances over the
    exact ones; ``sd_ratios``: of the SDs.
    """
    doses = np.log(list(s.doses.values()))
    variances = np.array([m.variances[e] for e in s.doses.values()])
    sds = np.array([np.std(m.means[e], axis=0, ddof=1).ravel() for e in s.doses.values()])
    ratios = variances * np.exp(doses)[:, None] / np.diag(m.covariance)
    spread = measured_table(m.means[s.table_exposure_s]).sd / m.exact(s.table_exposure_s).sd
    return {
        "slopes": np.round(np.polyfit(doses, 0.5 * np.log(variances), 1)[0], 5),
        "sampled_slopes": np.polyfit(doses, np.log(sds), 1)[0],
        "variance_ratios": [ratios.min(), ratios.max()],
        "sd_ratios": [spread.min(), spread.max()],
    }


def _ten_run_experiments(s: NoiseSettings, m: Moments, exposure: float) -> dict[str, object]:
    """How often each setting has the highest CNR in experiments of ten realisations."""
    shared = few_run_tables(m.expected, m.covariance / exposure, s.experiments, s.seed)
    winners = np.bincount(shared.cnr.argmax(-1), minlength=len(s.axes)) / s.experiments
    return {
        "experiments": s.experiments,
        "winners": {f"{k} {v:.2f} mm": float(w) for (k, v), w in zip(s.axes, winners, strict=True)},
    }


def _pairs(s: NoiseSettings, m: Moments, exposure: float) -> dict[str, object]:
    """CNR differences: the paper's best against all others, and how many of all pairs are
    established."""
    axes, exact = s.axes, m.exact(exposure)
    best = ("soft", 0.25) if ("soft", 0.25) in axes else axes[int(np.argmax(exact.cnr))]
    a = axes.index(best)
    values, others = m.means[exposure], [(a, b) for b in range(len(axes)) if b != a]
    single = pair_differences(values, exact, others, draws=_BOOTSTRAP, seed=s.seed)
    every = list(itertools.combinations(range(len(axes)), 2))
    joint = pair_differences(
        values, exact, every, level=1 - 0.05 / len(every), draws=_BOOTSTRAP, seed=s.seed
    )
    found = [p for p in joint if p.established]
    theirs, agree = [published(paper.CNR, k, v, exposure) for k, v in axes], None
    if None not in theirs:
        agree = sum(
            np.sign(p.difference) == np.sign(theirs[p.first] - theirs[p.second]) for p in found
        )
    return {
        "reference": f"{best[0]} {best[1]:.2f} mm",
        "against": [
            {
                "kernel": axes[p.second][0],
                "voxel_mm": axes[p.second][1],
                "difference": p.difference,
                "interval": [p.low, p.high],
                "exact": p.exact,
                "runs_needed": p.runs_needed(len(values)),
            }
            for p in single
        ],
        "pairs": len(every),
        "established_jointly": len(found),
        "with_the_right_sign": sum(np.sign(p.difference) == np.sign(p.exact) for p in found),
        "in_the_papers_order": agree,
    }


# --- statistics -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class RoiStatistics:
    """Statistics of ROI means for every setting, any number of leading axes.

    Attributes:
        mean, sd: ``(..., settings, 2)`` HU: core, fibrous.
    """

    mean: Floats
    sd: Floats

    @property
    def cnr(self) -> Floats:
        """``(..., settings)``."""
        return np.asarray(
            cnr_from_moments(self.mean[..., 0], self.sd[..., 0], self.mean[..., 1], self.sd[..., 1])
        )


def measured_table(means: ArrayLike) -> RoiStatistics:
    """From realisations: ``(..., n, settings, 2)`` ROI means."""
    values = np.asarray(means, dtype=np.float64)
    return RoiStatistics(values.mean(-3), values.std(-3, ddof=1))


def few_run_tables(mean: ArrayLike, covariance: Floats, draws: int, seed: int) -> RoiStatistics:
    """Tables that so many experiments of ten realisations would report, whose ROI means
    ``(settings, 2)`` HU have this covariance ``(2 · settings, 2 · settings)`` HU²."""
    rng, parts = np.random.default_rng(seed), []
    for start in range(0, draws, 1000):
        shape = (min(1000, draws - start), _TEN)
        runs = rng.multivariate_normal(
            np.ravel(mean), covariance, shape, check_valid="ignore", method="eigh"
        )
        parts.append(measured_table(runs.reshape(*shape, *np.shape(mean))))
    return RoiStatistics(
        np.concatenate([p.mean for p in parts]), np.concatenate([p.sd for p in parts])
    )


def resampled_tables(values: Floats, indices: NDArray[np.int64]) -> RoiStatistics:
    """Tables of resamples of ``(n, settings, 2)`` ROI means, by counts: moments are linear in how
    often each realisation was drawn."""
    n = len(values)
    size = indices.shape[1]
    counts = np.zeros((len(indices), n))
    np.add.at(counts, (np.arange(len(indices))[:, None], indices), 1.0)
    centre = values.mean(0)
    flat = (values - centre).reshape(n, -1)
    first, second = counts @ flat / size, counts @ flat**2 / size
    variance = np.clip(second - first**2, 0.0, None) * size / (size - 1)
    shape = (-1, *values.shape[1:])
    return RoiStatistics(first.reshape(shape) + centre, np.sqrt(variance).reshape(shape))


@dataclass(frozen=True)
class Pair:
    """CNR of one setting minus that of another, from paired realisations.

    Attributes:
        first, second: indices of the settings.
        difference, low, high: measured, with its interval.
        exact: without sampling error.
    """

    first: int
    second: int
    difference: float
    low: float
    high: float
    exact: float

    @property
    def established(self) -> bool:
        """Whether the interval excludes zero."""
        return self.low > 0 or self.high < 0

    def runs_needed(self, n: int) -> float:
        """Paired realisations for an 80 % chance that a 95 % interval excludes zero, from one of
        ``n``."""
        error = (self.high - self.low) / (2 * 1.96)
        return float(n * ((1.96 + 0.84) * error / self.exact) ** 2) if self.exact else float("inf")


def pair_differences(
    means: ArrayLike,
    exact: RoiStatistics,
    pairs: Sequence[tuple[int, int]],
    *,
    level: float = 0.95,
    draws: int = 4000,
    seed: int = 0,
) -> list[Pair]:
    """Differences of CNR between settings with paired bootstrap intervals (BCa) of coverage
    ``level``.

    ``means``: ``(n, settings, 2)`` HU; the same resamples serve all pairs.
    """
    values = np.asarray(means, dtype=np.float64)
    measured = measured_table(values).cnr
    boot = resampled_tables(values, resampling(len(values), draws, seed)).cnr
    jackknife = resampled_tables(values, leave_one_out(len(values))).cnr
    result = []
    for a, b in pairs:
        value = float(measured[a] - measured[b])
        low, high = bca_interval(
            value, boot[:, a] - boot[:, b], jackknife[:, a] - jackknife[:, b], level
        )
        result.append(Pair(a, b, value, low, high, float(exact.cnr[a] - exact.cnr[b])))
    return result


# --- the report -----------------------------------------------------------------------------------


def checks(data: JsonObject) -> list[Check]:
    """The paper's tables beside the exact figures, the slope of the noise, and the full
    reconstructions."""
    found = []
    for name, value in paper.NOISE_FREE_ROI_HU.items():
        ours = data["noise_free_reference"][f"{name}_hu"]
        found.append(around(f"noise-free {name} mean, standard 0.10 mm, HU", ours, value, 8.0))
    covariance = np.asarray(data["covariance_hu2_at_1s"]) / paper.TABLE_EXPOSURE_S
    for i, ((kernel, voxel), means) in enumerate(
        zip(data["axes"], data["expected_hu"], strict=True)
    ):
        found += table_checks(
            kernel, voxel, means, covariance[2 * i : 2 * i + 2, 2 * i : 2 * i + 2]
        )
    slopes = data["noise_against_dose"]["slopes"]
    for name, slope in (("lowest", min(slopes)), ("highest", max(slopes))):
        found.append(
            around(f"slope of σ against dose, {name} of all ROI means", float(slope), -0.5, 0.015)
        )
    far = data["full_reconstructions"]["largest_difference_in_sd"]
    return [
        *found,
        Check("full reconstructions: difference of ROI means, SDs", far, "–", 0.0, 0.05),
    ]


def published(table: Floats, kernel: str, voxel_mm: float, exposure_s: float) -> Any:
    """The entry of one of the paper's tables for FBP at this setting, or None."""
    if (
        exposure_s != paper.TABLE_EXPOSURE_S
        or kernel not in paper.KERNELS
        or voxel_mm not in paper.VOXELS_MM
    ):
        return None
    return table[paper.KERNELS.index(kernel)][paper.VOXELS_MM.index(voxel_mm)]


def table_checks(
    kernel: str, voxel_mm: float, means_hu: Sequence[float], covariance_hu2: ArrayLike
) -> list[Check]:
    """The paper's tables against the exact expectation and covariance of the core's and the fibrous
    ROI mean at their exposure: no sampling error.

    Returns:
        Means ± 10 HU, SDs within a factor of 1.5, and the paper's CNR inside the range that 95 of
        100 experiments with 10 realisations of our scan would give; nothing where the paper has no
        entry.
    """
    checks = []
    covariance = np.asarray(covariance_hu2, dtype=np.float64)
    name = f"{kernel} {voxel_mm:.2f} mm"
    for i, (roi, table) in enumerate((("core", paper.FOREGROUND), ("fibrous", paper.BACKGROUND))):
        entry = published(table, kernel, voxel_mm, paper.TABLE_EXPOSURE_S)
        if entry is None:
            return []
        mean, sd = (float(v) for v in entry)
        error = f"standard error of the paper's mean: {sd / _TEN**0.5:.0f} HU"
        checks.append(
            Check(f"{roi} mean, {name}, HU", means_hu[i], mean, mean - 10, mean + 10).explained(
                error
            )
        )
        ours = float(np.sqrt(covariance[i, i]))
        ratio = (_TEN - 1) * (sd / ours) ** 2
        tail = (stats.chi2.cdf if sd < ours else stats.chi2.sf)(ratio, _TEN - 1)
        rare = f"10 runs of ours read this or farther off with p = {2 * tail:.1g}"
        checks.append(Check(f"{roi} SD, {name}, HU", ours, sd, sd / 1.5, sd * 1.5).explained(rare))
    cnr = float(published(paper.CNR, kernel, voxel_mm, paper.TABLE_EXPOSURE_S))
    low, high = cnr_range(means_hu, covariance, _TEN)
    checks.append(
        Check(f"the paper's CNR, {name}, in the range of our 10-run estimates", cnr, cnr, low, high)
    )
    return checks


def figures(measured: Measured) -> dict[str, Figure]:
    """Images of every setting, and CNRs with their uncertainty, at the tables' dose."""
    s, m = measured.settings, measured.seen
    name = next(name for name, dose in s.doses.items() if dose == s.table_exposure_s)
    return {
        "noise_images.png": _images(s, m),
        "noise_cnr.png": _cnrs(s, measured.data["doses"][name]),
    }


def _images(s: NoiseSettings, m: Moments) -> Figure:
    """One realisation at the tables' dose: kernels down, voxel sizes across."""
    rois = m.scanned.rois
    rows = []
    for kernel in s.kernels:
        first = kernel == s.kernels[0]
        row = []
        for voxel, grid in zip(s.voxels_mm, m.scanned.grids, strict=True):
            image = sample_axial(m.images[kernel, voxel], grid, rois.image)[0]
            title, outlines = (f"{voxel:.2f} mm", roi_outlines(rois)) if first else ("", ())
            row.append(Panel(image, extent(rois.image), title, outlines))
        rows.append(row)
    figure = panels(
        rows,
        s.kernels,
        f"FBP of one noise realisation, {s.table_exposure_s:g} s, axial",
        "C150 / W600 HU. ROI outlines (top row): necrotic core (blue), fibrous tissue (red).",
    )
    width, height = _IMAGES_SCALE * figure.get_size_inches()
    figure.set_size_inches(width, height)
    return figure


def _cnrs(s: NoiseSettings, rows: list[JsonObject]) -> Figure:
    """CNR of every setting: exact, n realisations with interval, range of 10-run experiments,
    the paper's."""
    from matplotlib.figure import Figure

    exposure, kernels = s.table_exposure_s, s.kernels
    figure = Figure(figsize=(2.4 * len(kernels) + 1.0, 4.0), dpi=150, layout="constrained")
    axes = figure.subplots(1, len(kernels), squeeze=False, sharey=True)[0]
    x = np.array(s.voxels_mm)
    step = 0.05 if x.size < 2 else float(np.diff(x).min())
    for ax, kernel in zip(axes, kernels, strict=True):
        own = [r for r in rows if r["kernel"] == kernel]
        bands = np.array([r["ten_runs"]["cnr_range"] for r in own])
        ax.fill_between(
            x,
            bands[:, 0],
            bands[:, 1],
            color="0.85",
            label="95 % of 10-run experiments",
            linewidth=0,
        )
        ax.plot(x, [r["exact"]["cnr"] for r in own], color="black", linewidth=1.2, label="exact")
        middle = np.array([r["measured"]["cnr"] for r in own])
        ends = np.array([r["measured"]["cnr_interval"] for r in own])
        ax.errorbar(
            x + 0.12 * step,
            middle,
            [middle - ends[:, 0], ends[:, 1] - middle],
            fmt="o",
            markersize=3,
            capsize=2,
            color="tab:blue",
            linewidth=1,
            label=f"n = {s.realisations}, 95 %",
        )
        entries = [r["paper"]["cnr"] for r in own if r["paper"] is not None]
        if len(entries) == len(own):
            ax.plot(x, entries, "x", color="tab:red", label="paper (n = 10)")
        ax.set_title(kernel, fontsize=10)
        ax.set_xlabel("voxel, mm")
        ax.set_xticks(x)
        ax.tick_params(labelsize=8)
    axes[0].set_ylabel("CNR of the core")
    axes[0].set_ylim(0, None)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=8)
    figure.suptitle(f"CNR of the necrotic core by FBP at {exposure:g} s", fontsize=10)
    return figure
