"""The noise study: FBP of the plaque with every kernel, voxel size and dose, and what the paper's tables establish.

The ROI means of FBP are inner products of the line integrals with adjoint vectors (:mod:`recon.fbp.exact_noise`). So
their joint covariance is exact, and hundreds of realisations cost one noisy scan each instead of a reconstruction per
kernel and voxel size; a few are reconstructed in full beside, which must give the same ROI means.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from recon.study.noise.few_runs import Table, exact_table
from recon.study.paper import facts as paper
from recon.study.paper.plaque_scan import REFERENCE_KERNEL, REFERENCE_VOXEL_MM, PlaqueScan, prepare, roi_entry
from torchpcct.geometry import VolumeGrid

if TYPE_CHECKING:
    from recon.study.report import Report
    from torchpcct.scan import Scan

__all__ = ["Measured", "Settings", "measure", "run"]

EID_VIEWS = paper.FULL_VIEWS["EID-CT"]
EID_KERNELS = ("soft", "standard")
EID_VOXELS_MM = (0.25, 0.40)
AVERAGED_FROM_MM = 0.30
"""Voxel size from which averaging over the voxel is looked at."""

SQUARES = 4
"""Realisations per dose of which every reading's squared deviation is summed: 10⁶ independent readings pin the variance
of an ROI mean down to some 0.1 %, which a few hundred ROI means do not."""

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Settings:
    """Settings of the noise study.

    Args:
        realizations: paired noise realisations per dose, at least 10 (the paper's number).
        seed: first seed; realisation i uses ``seed + i`` at every dose.
        views: views per rotation (paper: 1968). Fewer views keep the tube load of the whole scan.
        kernels, voxels_mm: of FBP.
        doses: name → exposure in s.
        reconstructed: realisations at the tables' dose that are reconstructed in full, at least 1.
        experiments: number of simulated experiments of 10 realisations.
        eid: whether to set an energy-integrating scan of equal dose beside.

    Raises:
        ValueError: a value out of range.
    """

    realizations: int = 200
    seed: int = 0
    views: int = paper.FULL_VIEWS["PCCT"]
    kernels: tuple[str, ...] = paper.KERNELS
    voxels_mm: tuple[float, ...] = paper.VOXELS_MM
    doses: dict[str, float] = field(default_factory=lambda: dict(paper.DOSES))
    reconstructed: int = 3
    experiments: int = 20_000
    eid: bool = True

    def __post_init__(self) -> None:
        for name, low in (("realizations", 10), ("views", 8), ("reconstructed", 1), ("experiments", 100)):
            value = getattr(self, name)
            if not value >= low:
                raise ValueError(f"{name} must be at least {low}, got {value}")
        if self.seed < 0:
            raise ValueError(f"seed must be 0 or more, got {self.seed}")
        if len(self.kernels) * len(self.voxels_mm) < 2:
            raise ValueError("a ranking needs at least two settings: give more kernels or voxels_mm")
        if len(self.doses) < 2:
            raise ValueError(f"doses must hold at least two exposures, got {self.doses}")

    @classmethod
    def quick(cls, **changes: Any) -> Settings:
        """A first look in under a minute: an eighth of the views, two kernels, three voxel sizes, two doses."""
        values: dict[str, Any] = {
            "realizations": 40,
            "views": 246,
            "kernels": ("soft", "standard"),
            "voxels_mm": (0.20, 0.25, 0.40),
            "doses": {"1x": 0.35, "5.7x": 2.00},
            "reconstructed": 2,
            "experiments": 4000,
        }
        return cls(**{**values, **changes})

    @property
    def table_exposure_s(self) -> float:
        """Exposure that the tables are shown for: the paper's, or the last."""
        exposures = list(self.doses.values())
        return paper.TABLE_EXPOSURE_S if paper.TABLE_EXPOSURE_S in exposures else exposures[-1]


@dataclass
class Measured:
    """What the report is written from. ``S`` settings: (kernel, voxel size), the voxel size varying slowest.

    Attributes:
        axes: the settings.
        expected: ``(S, 2)`` exact ROI means in HU: core, fibrous.
        covariance: ``(2 S, 2 S)`` HU² at 1 s, exact.
        means: exposure → ``(n, S, 2)`` ROI means of every realisation.
        variances: exposure → ``(2 S,)`` variance of the ROI means from the readings' squared deviations, HU².
        check: what the full reconstructions say.
        reference: noise-free ROI means on the reference image.
        scanned: grids, ROIs and plan.
        images: (kernel, voxel) → volume of one realisation at the tables' dose.
        averaging: (kernel, voxel) → exact SDs at 1 s if a voxel's value were the mean over its volume, HU.
        eid: rows of the comparison with the energy-integrating scan.
        seconds: per step.
    """

    settings: Settings
    axes: list[tuple[str, float]]
    expected: Any
    covariance: Any
    means: dict[float, Any]
    variances: dict[float, Any]
    check: dict[str, Any]
    reference: dict[str, Any]
    scanned: PlaqueScan
    images: dict[tuple[str, float], Any]
    averaging: dict[tuple[str, float], Any]
    eid: list[dict[str, Any]]
    seconds: dict[str, float]

    def exact(self, exposure_s: float) -> Table:
        """The truth at an exposure."""
        return exact_table(self.expected, self.covariance / exposure_s)

    def variance_ratios(self) -> Any:
        """Variance of the ROI means from the readings' squared deviations over the exact one, ``(doses, 2 S)``."""
        exact = np.diag(self.covariance)
        return np.array([v * exposure / exact for exposure, v in self.variances.items()])

    def slopes(self) -> Any:
        """Slope of log σ against log exposure of every ROI mean, ``(2 S,)``; −½ for counting noise."""
        x = np.log(list(self.variances))
        return np.polyfit(x, 0.5 * np.log(np.array(list(self.variances.values()))), 1)[0]


def run(settings: Settings | None = None, progress: Progress | None = None) -> Report:
    """Measure, and write the report."""
    from recon.study.noise.report import build_report

    return build_report(measure(settings or Settings(), progress))


def measure(settings: Settings, progress: Progress | None = None) -> Measured:
    """Simulate, take exact moments, draw realisations, reconstruct a few in full."""
    from recon.fbp.exact_noise import roi_adjoints
    from recon.fbp.inset import InsetFbp
    from torchpcct.scanner import presets
    from torchpcct.scene.plaque import plaque_scene

    report = progress or (lambda step, fraction: None)
    seconds: dict[str, float] = {}
    last = time.perf_counter()

    def lap(name: str) -> None:
        nonlocal last
        now = time.perf_counter()
        seconds[name] = seconds.get(name, 0.0) + now - last
        last = now

    scene = plaque_scene()
    scanner = presets.pcct(views=settings.views)
    kernels, voxels = settings.kernels, settings.voxels_mm
    scanned = prepare(kernels, voxels, scene, scanner, paper.FULL_VIEWS["PCCT"], lambda f: report("simulate", f))
    clean = scanned.clean
    lap("simulate")
    fine = InsetFbp(clean, [scanned.fine], [REFERENCE_KERNEL])(clean)[0][0]
    reference = roi_entry("fbp", REFERENCE_KERNEL, REFERENCE_VOXEL_MM, scanned.rois.on(scanned.fine), fine)
    expected = _roi_means(scanned, scanned.fbp(clean))
    lap("noise-free FBP")
    report("exact noise", 0.0)
    adjoints = roi_adjoints(clean, scanned.fbp, scanned.pairs)
    covariance = adjoints.joint_covariance(clean, 1.0)
    near = clean.crop(adjoints.window)
    matrix = adjoints.matrix
    del adjoints
    lap("exact noise")

    quiet = near.line_integrals().flatten()
    means: dict[float, Any] = {}
    variances: dict[float, Any] = {}
    total = len(settings.doses) * settings.realizations
    for exposure in settings.doses.values():
        values = np.empty((settings.realizations, *expected.shape))
        squares = torch.zeros(matrix.shape[0], dtype=torch.float64)
        for i in range(settings.realizations):
            deviation = _deviation(near, exposure, settings.seed + i, quiet)
            values[i] = expected + (matrix @ deviation).double().numpy().reshape(expected.shape)
            if i < SQUARES:
                for row, h in enumerate(matrix):
                    squares[row] += float((h * deviation).square().sum(dtype=torch.float64)) / SQUARES
            report("noise realisations", (len(means) * settings.realizations + i + 1) / total)
        means[exposure], variances[exposure] = values, squares.numpy()
    lap("noise realisations")

    exposure = settings.table_exposure_s
    images: dict[tuple[str, float], Any] = {}
    differences = []
    for i in range(min(settings.reconstructed, settings.realizations)):
        volumes = scanned.fbp(clean.with_noise(exposure, settings.seed + i))
        differences.append(_roi_means(scanned, volumes) - means[exposure][i])
        if i == 0:
            images = {
                (k, v): image
                for v, grid in zip(voxels, volumes, strict=True)
                for k, image in zip(kernels, grid, strict=True)
            }
        report("full reconstructions", (i + 1) / settings.reconstructed)
    sd = np.sqrt(np.diag(covariance) / exposure).reshape(expected.shape)
    relative = np.abs(np.array(differences)) / sd
    check = {
        "reconstructed": len(differences),
        "largest_difference_hu": float(np.abs(differences).max()),
        "largest_difference_in_sd": float(relative.max()),
    }
    lap("full reconstructions")
    averaging = _averaging(scanned, kernels)
    lap("averaging voxels")
    eid = _eid_rows(settings, scene, scanner, covariance, expected, report) if settings.eid else []
    lap("EID-CT")
    return Measured(
        settings, [(k, v) for v in voxels for k in kernels], expected, covariance, means, variances, check, reference,
        scanned, images, averaging, eid, seconds,
    )  # fmt: skip


def _roi_means(scanned: PlaqueScan, volumes: Any) -> Any:
    """``(S, 2)`` ROI means of the volumes of all grids and kernels."""
    return np.array(
        [
            [float(pair[0](volume)), float(pair[1](volume))]
            for pair, grid in zip(scanned.pairs, volumes, strict=True)
            for volume in grid
        ]
    )


@dataclass(frozen=True)
class _Weights:
    """A functional of a volume, as :func:`recon.fbp.exact_noise.roi_covariance` takes ROIs."""

    weights: torch.Tensor


def _averaging(scanned: PlaqueScan, kernels: tuple[str, ...]) -> dict[tuple[str, float], Any]:
    """SDs of the ROI means on large voxels that average over their volume: the mean of 2 × 2 × 2 voxels of half the
    size. FBP samples the filtered image at points; where the voxels are wider than its detail, noise aliases."""
    from recon.fbp.exact_noise import roi_covariance
    from recon.fbp.inset import InsetFbp

    chosen = [(g, p) for g, p in zip(scanned.grids, scanned.pairs, strict=True) if g.spacing[0] >= AVERAGED_FROM_MM]
    if not chosen:
        return {}
    halves = [VolumeGrid(tuple(2 * n for n in g.shape), g.spacing[0] / 2, g.center) for g, _ in chosen]
    rois: Any = [
        [_Weights(roi.weights.repeat_interleave(2, 0).repeat_interleave(2, 1).repeat_interleave(2, 2) / 8) for roi in p]
        for _, p in chosen
    ]
    matrices = roi_covariance(scanned.clean, InsetFbp(scanned.clean, halves, kernels), rois, 1.0)
    return {
        (kernel, grid.spacing[0]): np.sqrt(np.diag(matrix))
        for (grid, _), found in zip(chosen, matrices, strict=True)
        for kernel, matrix in zip(kernels, found, strict=True)
    }


def _deviation(clean: Scan, exposure_s: float, seed: int, quiet: torch.Tensor) -> torch.Tensor:
    return clean.with_noise(exposure_s, seed).line_integrals().flatten() - quiet


def _eid_rows(
    settings: Settings, scene: Any, pcct: Any, covariance: Any, expected: Any, report: Progress
) -> list[dict[str, Any]]:
    """Exact ROI statistics of the energy-integrating scanner beside the photon-counting one, at equal dose.

    The spectrum in front of the patient is the same, so equal dose is equal fluence at the isocentre: the exposure of
    the scanner whose tube is nearer falls with the square of the distance.
    """
    from recon.fbp.exact_noise import roi_adjoints
    from torchpcct.scanner import presets

    kernels = [k for k in EID_KERNELS if k in settings.kernels]
    voxels = [v for v in EID_VOXELS_MM if v in settings.voxels_mm]
    if not kernels or not voxels:
        return []
    scanner = presets.eid(views=max(8, EID_VIEWS * settings.views // paper.FULL_VIEWS["PCCT"]))
    scanned = prepare(kernels, voxels, scene, scanner, EID_VIEWS, lambda f: report("EID-CT", 0.8 * f))
    means = _roi_means(scanned, scanned.fbp(scanned.clean)).reshape(len(voxels), len(kernels), 2)
    adjoints = roi_adjoints(scanned.clean, scanned.fbp, scanned.pairs)
    per_dose = (scanner.geometry.sod / pcct.geometry.sod) ** 2
    electronic = _electronic_share(scanned.clean, per_dose * min(settings.doses.values()))
    rows = []
    for exposure in (min(settings.doses.values()), settings.table_exposure_s):
        matrices = adjoints.covariance(scanned.clean, exposure * per_dose)
        for v, voxel in enumerate(voxels):
            for k, kernel in enumerate(kernels):
                index = settings.voxels_mm.index(voxel) * len(settings.kernels) + settings.kernels.index(kernel)
                part = slice(2 * index, 2 * index + 2)
                rows.append(
                    _eid_row("PCCT", kernel, voxel, exposure, expected[index], covariance[part, part] / exposure)
                )
                rows.append(_eid_row("EID-CT", kernel, voxel, exposure, means[v, k], matrices[v][k]))
                rows[-1].update(own_exposure_s=exposure * per_dose, largest_electronic_share=electronic)
    report("EID-CT", 1.0)
    return rows


def _electronic_share(clean: Scan, exposure_s: float) -> float:
    """Largest share of a reading's variance that the electronics make."""
    assert clean.quantum is not None
    quanta = clean.quantum * clean.counts * exposure_s
    electronics = clean.electronic_noise**2
    return float((electronics / (quanta + electronics)).max())


def _eid_row(scanner: str, kernel: str, voxel: float, exposure: float, means: Any, covariance: Any) -> dict[str, Any]:
    sd = np.sqrt(np.diag(covariance))
    return {
        "scanner": scanner,
        "kernel": kernel,
        "voxel_mm": voxel,
        "exposure_s": exposure,
        "mean_hu": [float(m) for m in means],
        "sd_hu": [float(s) for s in sd],
        "contrast_hu": float(means[1] - means[0]),
        "contrast_sd_hu": math.sqrt(float(covariance[0, 0] + covariance[1, 1] - 2 * covariance[0, 1])),
        "cnr": float((means[1] - means[0]) / math.hypot(*sd)),
    }


def as_dict(measured: Measured) -> dict[str, Any]:
    """JSON values of the settings and the moments."""
    return {
        "settings": asdict(measured.settings),
        "plan": dict(measured.scanned.clean.info["plan"]),
        "rois": measured.scanned.rois.as_dict(),
        "noise_free_reference": measured.reference,
        "order": "settings: voxel size slowest, then kernel; ROI means: setting, then core / fibrous",
        "axes": [list(a) for a in measured.axes],
        "expected_hu": np.round(measured.expected, 4).tolist(),
        "covariance_hu2_at_1s": np.round(measured.covariance, 4).tolist(),
        "averaging_voxels_sd_hu_at_1s": [[*k, *np.round(v, 4).tolist()] for k, v in measured.averaging.items()],
        "full_reconstructions": measured.check,
        "seconds": {k: round(v, 2) for k, v in measured.seconds.items()},
    }
