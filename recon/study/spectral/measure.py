"""The plaque in energy bins: basis materials, monochromatic images, tissue maps, by FBP and joint
MBIR.

The paper's plaque is scanned in eight energy bins and every ray decomposed into line integrals of
the two basis materials, PE and PVC. Their FBP, and their joint model-based reconstruction, give
basis images, those virtual monochromatic images (VMI) and tissue maps.

* Noise of VMIs is exact: FBP is linear, the rays' covariance is known (Cramér–Rao, which the
  decomposition reaches: the study checks it on its own rays), so one adjoint pass per functional
  replaces realisations.
* The paper's noise levels are shares of the *standard noise*: the difference of a noisy to the
  noise-free scan is multiplied by 0.25, 0.5 and 1.
* What a wrong calibration costs is found by decomposing noise-free scans with a model that is not
  theirs, see :mod:`recon.study.spectral.calibration`.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from recon.analytic.exact_noise import functional_covariance
from recon.jobs.store import Step, StudyCache
from recon.least_squares.basis_problem import BasisProblem
from recon.least_squares.qggmrf import DEFAULT_PRIOR
from recon.study.figures import extent
from recon.study.paper import published as paper
from recon.study.report import Check, around
from recon.study.spectral.calibration import calibration_costs
from recon.study.spectral.scan import RULES, SpectralScan, Tissues
from recon.study.study import Measured, Progress, StudySettings, silent
from torchpcct.spectral import (
    MMD_TISSUES,
    VMI_ENERGIES_KEV,
    VmiCurve,
    pe_pvc,
    vmi,
    vmi_curve,
)
from torchpcct.validate import number
from torchpcct.viz import WINDOW_HU

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

    from torchpcct.typing import JsonObject, Reals


VISIBLE_DICE = 0.5
"""The core counts as visible in a tissue map if its Dice coefficient reaches this. The paper
judges by eye."""

LOW_EXPOSURE_S = 0.35
"""The paper's shortest exposure: the decomposition must hold there, too."""
_LOW_EXPOSURE_STEP = 8
"""Views between those that are looked at there."""

_COLOURS = ("#2ca02c", "#d62728", "#1f77b4", "#202020")
"""The paper's colours of tissues: blood green, core red, fibrous blue, fat dark."""
_PICTURED_KEV = (40.0, 52.0, 70.0)
"""Energies of the monochromatic images that are shown."""


@dataclass(frozen=True)
class SpectralSettings(StudySettings):
    """Settings of the study; the quick ones take an eighth of the views, one realisation, no wrong
    calibrations.

    Args:
        exposure_s: of the standard noise (the paper does not state it; 2.0 s is the exposure of its
            tables).
        realisations: of the noise, for tissue maps by FBP.
        mbir_realisations: of these, how many are reconstructed by joint MBIR at every noise level;
            0: none.
        noise_levels: shares of the standard noise, ascending, 0 first.
        views: per rotation.
        voxel_mm: [paper: 0.2].
        kernel: of FBP (the paper names none for its spectral images).
        calibration_views: of the noise-free scans with a wrong calibration; 0: no wrong
            calibrations.
        threshold_error_kev: by which every threshold lies lower than the decomposition assumes.
        voltage_error_kv: by which the tube's voltage lies lower than the decomposition assumes.
        gain_error: relative error of the counts since the air scan, in all energy bins or in one.
        transport_photons: followed through the silicon for a scan with all their interactions; 0:
            no such scan.
        seed: first seed of the noise.
    """

    exposure_s: float = 2.0
    realisations: int = 4
    mbir_realisations: int = 2
    noise_levels: tuple[float, ...] = (0.0, 0.25, 0.5, 1.0)
    views: int = paper.FULL_VIEWS["PCCT"]
    voxel_mm: float = 0.2
    kernel: str = "standard"
    calibration_views: int = 246
    threshold_error_kev: float = 2.0
    voltage_error_kv: float = 2.0
    gain_error: float = 0.01
    transport_photons: int = 1_000_000
    seed: int = 0

    QUICK: ClassVar = {
        "views": 246,
        "realisations": 1,
        "mbir_realisations": 1,
        "calibration_views": 0,
    }

    def __post_init__(self) -> None:
        number("exposure_s", self.exposure_s, positive=True, unit="s")
        number("voxel_mm", self.voxel_mm, positive=True, unit="mm")
        self.check_whole(realisations=1, mbir_realisations=0, views=60, seed=0)
        self.check_whole(calibration_views=0, transport_photons=0)
        number("threshold_error_kev", self.threshold_error_kev, low=-4.0, high=4.0, unit="keV")
        number("voltage_error_kv", self.voltage_error_kv, low=-20.0, high=20.0, unit="kV")
        number("gain_error", self.gain_error, low=-0.5, high=0.5)
        for name, low in (("calibration_views", 60), ("transport_photons", 1000)):
            if 0 < getattr(self, name) < low:
                raise ValueError(f"{name} must be 0 or at least {low}, got {getattr(self, name)}")
        if self.mbir_realisations > self.realisations:
            raise ValueError(
                f"mbir_realisations must lie in 0…{self.realisations} (realisations), got "
                f"{self.mbir_realisations}"
            )
        levels = self.noise_levels
        if not levels or levels[0] != 0 or any(b <= a for a, b in itertools.pairwise(levels)):
            raise ValueError(f"noise_levels must ascend from 0, got {levels}")


@dataclass
class Images:
    """Basis images: ``clean`` ``(2, z, y, x)``, ``noisy`` ``(n, 2, z, y, x)`` at the standard
    noise, both by FBP, and ``mbir``, the first of every noise level, ``(levels, 2, z, y, x)``."""

    clean: Tensor
    noisy: Tensor
    mbir: Tensor | None = None

    def fbp(self, level: float) -> Tensor:
        """FBP at a share of the standard noise, ``(n, 2, z, y, x)``; one image without noise."""
        return self.clean + level * (self.noisy - self.clean) if level else self.clean[None]


@dataclass(frozen=True)
class PictureVolumes:
    """Geometry, truth and volumes of the pictures."""

    scan: SpectralScan
    tissues: Tissues
    images: Images


def measure(
    settings: SpectralSettings, progress: Progress = silent, folder: str | Path | None = None
) -> Measured:
    """Scan, decompose, reconstruct, label; finished parts are cached."""
    s, cache, spent = settings, StudyCache(folder, settings), time.process_time()

    scan = SpectralScan(s, lambda fraction: progress("simulate", fraction), cache=cache)
    data: JsonObject = {"plan": scan.clean.info["plan"]}
    progress("simulate", 1.0)
    noise_free = scan.fbp.images(scan.exact.line_integrals)[0][0]
    lines, volumes, data["rays"] = [], [], []
    cache.ahead(*_step(s))
    for k in range(s.realisations):
        volume, used, statistics = _noisy(s, cache, k, scan)
        data["rays"].append(statistics)
        volumes.append(volume)
        lines += used
        progress("decompose noisy scans", (k + 1) / (s.realisations + 1))
    low = cache("noisy_low", lambda: scan.noisy(LOW_EXPOSURE_S, s.seed, _LOW_EXPOSURE_STEP)[1])
    data["rays"].append(low)
    images = Images(noise_free, torch.stack(volumes))
    progress("decompose noisy scans", 1.0)
    data["vmi"] = _vmi(scan, images)
    progress("monochromatic images", 1.0)
    tissues = Tissues(scan, data["vmi"]["voxel_covariance"])
    data["slices"] = len(tissues.truth)
    data["dice"] = {
        name: [_scores(level, tissues, images.fbp(level), rule) for level in s.noise_levels]
        for rule, name in RULES.items()
    }
    progress("tissue maps", 1.0)
    if lines:
        data["mbir"], data["dice"]["joint MBIR"] = _mbir(
            scan, tissues, lines, images, data["vmi"], cache, progress
        )
        progress("joint MBIR", 1.0)
    if s.calibration_views:
        costs = partial(
            calibration_costs, s, tissues, lambda fraction: progress("wrong calibrations", fraction)
        )
        data["calibration"] = cache("calibration", costs)
    residual = {
        name: float(np.abs(pe_pvc().residual(name)).max())
        for name in ("necrotic_core", "blood_iodine")
    }
    data |= {"basis_residual_hu": residual, "processor_seconds": time.process_time() - spent}
    return Measured(s, data, PictureVolumes(scan, tissues, images))


def plan(settings: SpectralSettings, folder: str | Path | None) -> None:
    """List the jobs that are left; see :mod:`recon.study.study`."""
    StudyCache(folder, settings).plan(_step(settings))


def _step(s: SpectralSettings) -> Step:
    return _noisy, [(k,) for k in range(s.realisations)]


def _noisy(
    s: SpectralSettings, cache: StudyCache, k: int, scan: SpectralScan | None = None
) -> tuple[Tensor, list[Tensor], dict[str, object]]:
    """FBP of a realisation, its line integrals if MBIR needs them, and figures of its rays."""
    scan = scan or SpectralScan(s, cache=cache)

    def draw() -> tuple[Tensor, list[Tensor], dict[str, object]]:
        noisy, statistics = scan.noisy(s.exposure_s, s.seed + k)
        return scan.fbp.images(noisy)[0][0], [noisy] if k < s.mbir_realisations else [], statistics

    return cache(f"noisy_{k}", draw)


def _curve(curve: VmiCurve) -> dict[str, object]:
    return {
        "contrast_hu": curve.contrast.tolist(),
        "noise_hu": curve.noise.tolist(),
        "cnr": curve.cnr.tolist(),
        "optimum_kev": curve.optimum_kev,
        "best_cnr": float(curve.cnr.max()),
        "limit": curve.limit,
    }


def _vmi(scan: SpectralScan, images: Images) -> JsonObject:
    """Contrast of core and fibrous tissue, noise and CNR against energy."""
    foreground, background = scan.rois.on(scan.grid)
    core, fibrous = (roi(images.clean).numpy() for roi in (foreground, background))
    voxel = torch.zeros(scan.grid.shape, dtype=torch.float64)
    most = int(background.weights.argmax())  # the voxel that the background ROI weighs most
    voxel.view(-1)[most] = 1.0
    functionals = torch.stack([voxel, foreground.weights, background.weights]).to(torch.float32)
    exact = functional_covariance(scan.fbp, functionals, scan.covariance(scan.settings.exposure_s))
    # The noise of the inset is nearly stationary in the plane: all voxels of the ROI's slice, far
    # from rounding errors.
    z = most // (scan.grid.shape[1] * scan.grid.shape[2])
    noise = (images.noisy - images.clean)[:, :, z].transpose(0, 1).reshape(2, -1).double()
    return {
        "energies_kev": list(VMI_ENERGIES_KEV),
        "roi": scan.rois.as_dict(),
        "core": core.tolist(),
        "fibrous": fibrous.tolist(),
        "voxel_covariance": exact[0, 0].tolist(),
        "sampled_covariance": torch.cov(noise).numpy()[(0, 0, 1), (0, 1, 1)].tolist(),
        "voxel": _curve(vmi_curve(fibrous, core, exact[0, 0], scan.basis)),
        # Protocol of the paper's CNR tables: noise of both ROI means over realisations.
        "roi_means": _curve(vmi_curve(fibrous, core, exact[1, 1] + exact[2, 2], scan.basis)),
    }


def _scores(
    level: float, tissues: Tissues, volumes: Sequence[Tensor] | Tensor, rule: str = "nearest"
) -> dict[str, object]:
    """Mean and SD of every tissue's Dice coefficient over realisations."""
    values = np.array([tissues.dice(v, rule) for v in volumes])
    spread = values.std(0, ddof=1) if len(values) > 1 else np.full(len(MMD_TISSUES), np.nan)
    scores = zip(MMD_TISSUES, values.mean(0), spread, strict=True)
    return {"noise": level, **{t: {"mean": float(m), "sd": float(d)} for t, m, d in scores}}


def _at_energy(scan: SpectralScan, images: Tensor, energy: float) -> dict[str, float]:
    """ROI means, and the SD of voxels in fat, of one monochromatic image, HU."""
    hu = vmi(images, scan.basis, [energy])[0]
    core, fibrous = (float(roi(hu)) for roi in scan.rois.on(scan.grid))
    return {"core_hu": core, "fibrous_hu": fibrous, "fat_sd_hu": float(hu[scan.fat].double().std())}


def _mbir(
    scan: SpectralScan,
    tissues: Tissues,
    lines: list[Tensor],
    images: Images,
    curves: JsonObject,
    cache: StudyCache,
    progress: Progress,
) -> tuple[JsonObject, list[JsonObject]]:
    """Joint MBIR at every noise level, and its scores; volumes of the first realisation go to
    ``images``."""
    s = scan.settings
    problem = BasisProblem(scan.clean, scan.model(1.0), scan.grid)
    exact, best = scan.exact.line_integrals, curves["voxel"]["optimum_kev"]
    lowest = next((v for v in s.noise_levels if v > 0), 1.0)
    steps, scores, reports, pictures, values = (
        1 + (len(s.noise_levels) - 1) * len(lines),
        [],
        [],
        [],
        [],
    )
    for level in s.noise_levels:
        # Data without noise take the weights of the lowest noise: it is the prior that changes
        # them.
        dose, found = s.exposure_s / (level or lowest) ** 2, []
        for k, noisy in enumerate(lines if level else lines[:1]):
            data = exact + level * (noisy - exact)
            solve = partial(problem.solve, data, scan.window, dose=dose, tolerance=1.0)
            volume, report = cache(f"mbir_{level:g}_{k}", solve)
            found.append(volume)
            reports.append({"noise": level, **report})
            progress("joint MBIR", len(reports) / steps)
        scores.append(_scores(level, tissues, found))
        pictures.append(found[0])
        both = {"FBP": images.fbp(level)[0], "joint MBIR": found[0]}
        values.append({"noise": level, **{k: _at_energy(scan, v, best) for k, v in both.items()}})
    images.mbir = torch.stack(pictures)
    return {
        "anisotropy": problem.anisotropy,
        "whitening": problem.whitening.forward.tolist(),
        "prior": asdict(DEFAULT_PRIOR),
        "solves": reports,
        "at_best_energy": values,
    }, scores


# --- the report -----------------------------------------------------------------------------------


def checks(data: JsonObject) -> list[Check]:
    """The decomposition at its bound, the best energy, and what noise leaves of the core, beside
    the paper's."""
    rays, curves, fbp = data["rays"], data["vmi"], data["dice"]["FBP"]
    best, tolerance = paper.SPECTRAL["optimum_kev"], paper.SPECTRAL["optimum_tolerance_kev"]

    def core(noise: float) -> float:
        return next((s["necrotic_core"]["mean"] for s in fbp if s["noise"] == noise), float("nan"))

    means = np.array([[s[t]["mean"] for t in MMD_TISSUES] for s in fbp])
    rise = float(np.diff(means, axis=0).max()) if len(means) > 1 else float("nan")
    limit, lost = paper.SPECTRAL["core_visible_up_to"], paper.SPECTRAL["core_lost_at"]
    bound = "decomposition: variance over the Cramér–Rao bound"
    return [
        Check(
            f"{bound}, {rays[0]['exposure_s']:g} s",
            rays[0]["whitened_ratio"],
            "not given",
            high=1.05,
        ),
        Check(
            f"{bound}, {rays[-1]['exposure_s']:g} s",
            rays[-1]["whitened_ratio"],
            "not given",
            high=1.08,
        ),
        Check(
            "decomposition: rays without a finite, converged answer",
            sum(r["failed"] for r in rays),
            "not given",
            high=0.0,
        ),
        around(
            "best energy, noise of a voxel, keV", curves["voxel"]["optimum_kev"], best, tolerance
        ),
        around(
            "best energy, noise of the ROI means, keV",
            curves["roi_means"]["optimum_kev"],
            best,
            tolerance,
        ),
        Check(
            f"core's Dice at {100 * limit:.0f} % noise (visible ≥ {VISIBLE_DICE})",
            core(limit),
            "visible",
            low=VISIBLE_DICE,
        ),
        Check(
            f"core's Dice at {100 * lost:.0f} % noise (lost < {VISIBLE_DICE})",
            core(lost),
            "lost",
            high=VISIBLE_DICE,
        ),
        Check(
            "largest rise of a tissue's Dice from one noise level to the next",
            rise,
            "monotone",
            high=0.0,
        ),
    ]


def figures(measured: Measured) -> dict[str, Figure]:
    """Basis and monochromatic images with the CNR curve, and tissue maps."""
    return {"spectral.png": _curves_figure(measured), "tissues.png": _tissue_figure(measured)}


def _show(
    ax: Axes, image: Reals | Tensor, measured: Measured, title: str, **options: Any
) -> AxesImage:
    ax.set_xticks([])
    ax.set_yticks([])
    ax.set_title(title, fontsize=8)
    edges = extent(measured.seen.scan.grid)
    return ax.imshow(
        np.asarray(image), origin="lower", extent=edges, interpolation="nearest", **options
    )


def _curves_figure(measured: Measured) -> Figure:
    """Basis images, monochromatic images (noise free above, standard noise below), and CNR
    against energy."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 7.2), dpi=130, layout="constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=(1.55, 1.0))
    top, bottom = parts
    axes = top.subplots(2, 5)
    scan, images = measured.seen.scan, measured.seen.images
    z = scan.grid.shape[0] // 2
    low, high = WINDOW_HU[0] - WINDOW_HU[1] / 2, WINDOW_HU[0] + WINDOW_HU[1] / 2
    for row, (name, volume) in enumerate(
        (("noise free", images.clean), ("standard noise", images.noisy[0]))
    ):
        middle = volume[:, z]
        for c, material in enumerate(("PE", "PVC")):
            clean = images.clean[c, z]
            reach = (float(clean.min()), float(clean.max()))
            if row:
                spread = 2 * float(middle[c].std())
                reach = (reach[0] - spread, reach[1] + spread)
            _show(
                axes[row, c],
                middle[c],
                measured,
                f"{material}, {name}",
                cmap="gray",
                vmin=reach[0],
                vmax=reach[1],
            )
        for c, energy in enumerate(_PICTURED_KEV):
            hu = vmi(middle, scan.basis, [energy])[0]
            shown = _show(
                axes[row, 2 + c],
                hu,
                measured,
                f"{energy:g} keV, {name}",
                cmap="gray",
                vmin=low,
                vmax=high,
            )
    top.colorbar(shown, ax=axes[:, -1], shrink=0.7, label="HU")
    left, right = bottom.subplots(1, 2)
    v = measured.data["vmi"]
    energies = v["energies_kev"]
    left.plot(energies, v["voxel"]["noise_hu"], color="tab:red", label="noise of a voxel")
    left.plot(
        energies, v["voxel"]["contrast_hu"], color="tab:blue", label="contrast fibrous − core"
    )
    left.set_yscale("log")
    left.set_ylabel("HU")
    for key, style, label in (
        ("voxel", "-", "voxel noise"),
        ("roi_means", "--", "ROI means (paper's protocol)"),
    ):
        cnr = np.array(v[key]["cnr"])
        best = v[key]["optimum_kev"]
        right.plot(
            energies, cnr / cnr.max(), style, color="black", label=f"{label}: best {best:.1f} keV"
        )
        right.axvline(best, color="black", linestyle=style, linewidth=0.8)
    right.axvline(
        paper.SPECTRAL["optimum_kev"], color="tab:orange", linewidth=1.2, label="paper: 52 keV"
    )
    right.set_ylabel("CNR / best CNR")
    for ax in (left, right):
        ax.set_xlabel("energy of the monochromatic image, keV")
        ax.legend(fontsize=8)
        ax.grid(alpha=0.3)
    return figure


def _tissue_figure(measured: Measured) -> Figure:
    """Tissue maps of the middle slice: truth, then one column per noise level; rows: FBP, joint
    MBIR."""
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    levels, dice = measured.settings.noise_levels, measured.data["dice"]
    tissues, images = measured.seen.tissues, measured.seen.images
    methods = [m for m in ("FBP", "joint MBIR") if m in dice]
    figure = Figure(
        figsize=(1.9 * (1 + len(levels)) + 0.4, 2.25 * len(methods) + 0.7),
        dpi=150,
        layout="constrained",
    )
    axes = figure.subplots(len(methods), 1 + len(levels), squeeze=False)
    colours = ListedColormap(["white", *_COLOURS])
    k = tissues.middle
    for row, method in enumerate(methods):
        _show(
            axes[row, 0],
            tissues.truth[k] + 1,
            measured,
            "truth" if row == 0 else "",
            cmap=colours,
            vmin=0,
            vmax=4,
        )
        axes[row, 0].set_ylabel(method, fontsize=9)
        for c, level in enumerate(levels):
            volume = (
                images.fbp(level)[0] if images.mbir is None or method == "FBP" else images.mbir[c]
            )
            labels = tissues.labels(volume)[k]
            ax = axes[row, 1 + c]
            _show(
                ax, labels + 1, measured, f"{100 * level:.0f} % noise", cmap=colours, vmin=0, vmax=4
            )
            score = dice[method][c]["necrotic_core"]["mean"]
            ax.set_xlabel(f"core's Dice {score:.2f}", fontsize=7)
    names = [t.replace("_", " ") for t in MMD_TISSUES]
    handles = [Patch(color=c, label=n) for c, n in zip(_COLOURS, names, strict=True)]
    handles.append(
        Patch(facecolor="white", edgecolor="black", label="vessel wall, mixed voxels (left out)")
    )
    figure.legend(handles=handles, loc="outside lower center", ncols=5, fontsize=7)
    return figure
