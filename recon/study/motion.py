"""How much residual motion the plaque's image bears, in PCCT and EID-CT, and what motion
compensation gets back.

Protocol of Li et al., section "Motion Artifacts": the vessel moves rigidly in the axial plane, 2 mm
· sin(2π t) (60 beats a minute), during one turn of 0.35 s; residual motion is 10 to 60 % of that.
FBP on 0.2 mm voxels without noise. Every view sees the vessel where it is then, and blurred by its
way during the view: no phase volumes.

Beyond the paper: reconstruction with the motion known (FBP, penalised least squares and the learned
MBIR, each with the displaced inset in its backprojector or projector), with the motion known
wrongly, with the motion estimated from the scan itself (:mod:`recon.motion`), and with noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import torch
from torch import Tensor

from recon.analytic.inset import view_motion
from recon.jobs.store import Step, StudyCache
from recon.least_squares.inset_problem import InsetProblem
from recon.least_squares.qggmrf import DEFAULT_PRIOR
from recon.mbir.mbir import Mbir
from recon.motion import estimate_motion
from recon.study.figures import curve_axes, middle_panel, plaque_panel
from recon.study.motion_estimates import CASES, estimated_paths
from recon.study.paper import published as paper
from recon.study.paper.plaque_scan import (
    SCANNERS,
    PlaqueImage,
    Truth,
    duty,
    inset_grid,
    measure_plaque,
    reference_fbp,
)
from recon.study.report import Check
from recon.study.study import Measured, Progress, StudySettings, silent
from torchpcct.acquisition.acquire import acquire
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.placement import place_rois
from torchpcct.metrics.roi import RoiMean, sample_axial
from torchpcct.scan import NOISE_FREE_EXPOSURE_S, Scan
from torchpcct.scene import Scene
from torchpcct.scene.motion import SinusoidalMotion
from torchpcct.scene.plaque import Plaque, plaque_scene
from torchpcct.validate import choice, number
from torchpcct.viz import WINDOW_HU, Panel, panels

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from torchpcct.typing import Floats, JsonObject


METHODS = {"fbp": "FBP", "pwls": "q-GGMRF PWLS", "mbir": "MBIR (learned prior)"}
"""Methods and their names in tables."""

_TOLERANCE = 20.0
"""Largest error of a measure in per cent that the paper accepts (its resolution study)."""

_DICE = 0.5
"""Overlap with the true core from which a segmented region counts as the core: in noise, closed
specks do not."""

_PWLS_TOLERANCE_HU = 2.0
"""Distance to the minimum up to which PWLS iterates."""
_ERROR_WIDTH_HU = 200.0
"""Window of the error maps, about 0 HU, as in the paper."""

ESTIMATED = "estimated"
"""In the place of an error: the motion estimated from the scan."""

Key = tuple[str, float | str | None, bool]
"""Method, error of the assumed motion (0: the true one; None: the still vessel; :data:`ESTIMATED`),
whether there is noise."""


@dataclass(frozen=True)
class MotionSettings(StudySettings):
    """Settings of the motion study.

    Args:
        thinning: simulate one view in so many (1: all); thinned views last as long as one of the
            complete scan.
        amplitude_mm: of the whole motion.
        rate_bpm: beats per minute.
        rotation_s: time of one turn.
        direction: of the motion in the axial plane, rad from +x, the side of the plaque [assumed].
        fractions: residual motions of the PCCT, of the whole one.
        eid_fractions: residual motions of the EID-CT; those that the PCCT has too are compared.
        errors: errors of the amplitude that the compensation assumes, of the whole one.
        voxel_mm: of all volumes.
        exposure_s: of the noisy reconstructions.
        seed, realisations: of their noise; realisation i uses ``seed + i``.
        methods: of the compensation, of ``"fbp"`` (always), ``"pwls"``, ``"mbir"``.
        estimated_mm: amplitudes of the motions that are estimated from the scan itself, mm.
        estimated_exposures_s: exposures of these estimates.
        estimated_cases: of :data:`recon.study.motion_estimates.CASES`.
        estimated_realisations: noise realisations of each.
    """

    thinning: int = 1
    amplitude_mm: float = 2.0
    rate_bpm: float = 60.0
    rotation_s: float = paper.ROTATION_S
    direction: float = 0.0
    fractions: tuple[float, ...] = paper.MOTION["fractions"]
    eid_fractions: tuple[float, ...] = paper.MOTION["eid_fractions"]
    errors: tuple[float, ...] = (0.05, 0.10, 0.20, 0.40)
    voxel_mm: float = 0.2
    exposure_s: float = paper.TABLE_EXPOSURE_S
    seed: int = 0
    realisations: int = 2
    methods: tuple[str, ...] = tuple(METHODS)
    estimated_mm: tuple[float, ...] = (0.2, 0.4, 0.8, 1.2, 2.0)
    estimated_exposures_s: tuple[float, ...] = (2.0, 0.35)
    estimated_cases: tuple[str, ...] = tuple(CASES)
    estimated_realisations: int = 5

    # An eighth of the views, four residual motions, one error of the estimate, no PWLS.
    QUICK: ClassVar[dict[str, object]] = {
        "thinning": 8,
        "fractions": (0.1, 0.4, 0.6, 1.0),
        "errors": (0.10,),
        "realisations": 1,
        "methods": ("fbp", "mbir"),
        "estimated_mm": (0.4, 1.2),
        "estimated_realisations": 1,
    }

    def __post_init__(self) -> None:
        self.check_whole(thinning=1, realisations=1, seed=0, estimated_realisations=1)
        for case in self.estimated_cases:
            choice("estimated_cases", case, tuple(CASES))
        for name in ("estimated_mm", "estimated_exposures_s"):
            for value in getattr(self, name):
                number(name, value, positive=True)
        for name in ("amplitude_mm", "rate_bpm", "rotation_s", "voxel_mm", "exposure_s"):
            number(name, getattr(self, name), positive=True)
        for name in ("fractions", "eid_fractions", "errors"):
            values = getattr(self, name)
            if not all(0 < v <= 1 for v in values) or list(values) != sorted(values):
                raise ValueError(f"{name} must rise within (0, 1], got {values}")
        if not self.fractions:
            raise ValueError("fractions must hold at least one residual motion")
        if set(self.methods) - set(METHODS) or "fbp" not in self.methods:
            raise ValueError(
                f"methods must hold fbp and be of {', '.join(METHODS)}, got {self.methods}"
            )

    @property
    def motion(self) -> SinusoidalMotion:
        """The whole motion of the vessel."""
        return SinusoidalMotion("wall", self.amplitude_mm, self.rate_bpm, direction=self.direction)

    @property
    def worst(self) -> float:
        """The largest residual motion of the PCCT, of the whole one: what is compensated."""
        return max(self.fractions)


@dataclass
class MotionImages:
    """The images of the study, by scanner, motion and method.

    Attributes:
        at_rest: scanner → what the still vessel's image shows; its reference.
        residual: (scanner, fraction) → the uncompensated image, in place and moved back by the mean
            displacement.
        compensated: (method, error of the estimate, noisy) → one entry per realisation; error 0:
            the true motion; None: the still vessel by the same method.
    """

    at_rest: dict[str, PlaqueImage] = field(default_factory=dict)
    residual: dict[tuple[str, float], tuple[PlaqueImage, PlaqueImage]] = field(default_factory=dict)
    compensated: dict[Key, list[PlaqueImage]] = field(default_factory=dict)

    def residuals(self, scanner: str) -> dict[float, tuple[PlaqueImage, PlaqueImage]]:
        """``residual`` of one scanner, by fraction."""
        return {
            fraction: pair for (name, fraction), pair in self.residual.items() if name == scanner
        }


def measure(
    settings: MotionSettings, progress: Progress = silent, folder: str | Path | None = None
) -> Measured:
    """Simulate and reconstruct residual motion in both scanners, and compensate the PCCT's;
    finished parts are cached."""
    s, cache, m = settings, StudyCache(folder, settings), MotionImages()
    scene, plaque = plaque_scene()
    reference = Reference.of(scene, plaque, inset_grid(plaque, s.voxel_mm))
    cache.ahead(*_step(s))
    data: JsonObject = {}
    for name in SCANNERS:
        still, moving = _residual(s, m, name, reference, cache, progress)
        if name == "PCCT":
            path = view_motion(s.motion, moving.geometry, s.rotation_s)
            along = path @ np.array([0.0, math.sin(s.direction), math.cos(s.direction)])
            data = {
                "range_mm": (float(along.min()), float(along.max())),
                "step_mm": float(np.linalg.norm(np.diff(path, axis=0), axis=1).max()),
                "plan": dict(moving.info["plan"]),
            }
            advance = partial(progress, "compensation")
            m.compensated = compensate(
                s, still, moving, reference, cache.within("compensation"), advance
            )
    paths = cache.within("found")
    data |= {
        "estimates": estimated_paths(s, reference.grid, paths, partial(progress, "estimates")),
        "at_rest": {name: o.measures for name, o in m.at_rest.items()},
        "residual": [
            {"scanner": name, "fraction": f, "in_place": here.measures, "moved_back": back.measures}
            for (name, f), (here, back) in m.residual.items()
        ],
        "compensated": [
            {
                "method": method,
                "error": error,
                "noisy": noisy,
                "realisations": [o.measures for o in found],
            }
            for (method, error, noisy), found in m.compensated.items()
        ],
    }
    data["borne"] = _borne({**data, "settings": vars(s)})
    return Measured(s, data, m)


def plan(settings: MotionSettings, folder: str | Path | None) -> None:
    """List the jobs that are left; see :mod:`recon.study.study`."""
    StudyCache(folder, settings).plan(_step(settings))


def _step(s: MotionSettings) -> Step:
    fractions = {"PCCT": (0.0, *s.fractions), "EID-CT": (0.0, *s.eid_fractions)}
    return _scan, [(name, f) for name in SCANNERS for f in dict.fromkeys(fractions[name])]


def _residual(
    s: MotionSettings,
    m: MotionImages,
    name: str,
    reference: Reference,
    cache: StudyCache,
    progress: Progress,
) -> tuple[Scan, Scan]:
    """Images with residual motion; returns the scans at rest and of the largest motion."""
    grid = reference.grid
    still = moving = _scan(s, cache, name, 0.0)
    rest = reference_fbp(still, grid)
    m.at_rest[name] = observe(rest, reference, rest)
    path = view_motion(s.motion, still.geometry, s.rotation_s)
    fractions = s.fractions if name == "PCCT" else s.eid_fractions
    for done, fraction in enumerate(fractions):
        moving = _scan(s, cache, name, fraction)
        mean = np.tile(fraction * path.mean(0), (len(path), 1))
        in_place, back = reference_fbp(moving, grid), reference_fbp(moving, grid, mean)
        m.residual[name, fraction] = (
            observe(in_place, reference, rest),
            observe(back, reference, rest),
        )
        progress(name, (done + 1) / len(fractions))
    return still, moving


def _scan(s: MotionSettings, cache: StudyCache, name: str, fraction: float) -> Scan:
    scanner = SCANNERS[name](paper.FULL_VIEWS[name] // s.thinning)
    scene, plaque = plaque_scene(motion=s.motion.scaled(fraction))
    run = partial(
        acquire,
        scene,
        scanner,
        region=inset_grid(plaque, s.voxel_mm),
        rotation_s=s.rotation_s,
        duty=duty(scanner, paper.FULL_VIEWS[name]),
    )
    return cache.within(name)(f"scan_{fraction:g}", run)


# --- what one image yields ------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Reference:
    """Where things are at rest: the plaque on the protocol's axial image, and its ROIs on the
    grid of all volumes."""

    grid: VolumeGrid
    truth: Truth
    rois: tuple[RoiMean, RoiMean]

    @classmethod
    def of(cls, scene: Scene, plaque: Plaque, grid: VolumeGrid) -> Reference:
        """Of a scene at rest, for volumes on ``grid``."""
        truth = Truth.of(scene, plaque)
        return cls(grid, truth, place_rois(scene, truth.image).on(grid))


def observe(volume: Tensor, reference: Reference, rest: Tensor) -> PlaqueImage:
    """Measure a volume ``(z, y, x)`` HU; ``rest``: the same without motion.

    ``nrmse``: rms difference to it over the rms of its deviation from fat; ``roi_hu``: of core and
    fibrous tissue.
    """
    image = sample_axial(volume.double(), reference.grid, reference.truth.image)[0]
    core, fibrous = (float(r(volume)) for r in reference.rois)
    # Fat fills most of the inset.
    fat = float(rest.median())
    error = (volume.double() - rest.double()).square().mean().sqrt()
    nrmse = float(error / (rest.double() - fat).square().mean().sqrt())
    return measure_plaque(
        image, reference.truth, nrmse=nrmse, roi_hu=(core, fibrous), contrast_hu=fibrous - core
    )


# --- motion known ---------------------------------------------------------------------------------


def compensate(
    s: MotionSettings,
    still: Scan,
    moving: Scan,
    reference: Reference,
    cache: StudyCache,
    progress: Callable[[float], None],
) -> dict[Key, list[PlaqueImage]]:
    """Reconstruct the noise-free scans of the still and of the moving vessel and their noisy
    realisations.

    PWLS, whose solution is to be certified by exact projections, is run without noise and for the
    first noise realisation, at rest and with the true motion; FBP and MBIR with every assumed
    motion and with that estimated from the scan. One entry per realisation.
    """
    grid = reference.grid
    path = view_motion(s.motion.scaled(s.worst), moving.geometry, s.rotation_s)
    estimates: dict[float | str | None, Floats | None] = {None: None}
    estimates |= {e: (1.0 - e) * path for e in (0.0, *s.errors)}
    problems: dict[float | str | None, InsetProblem] = {}
    if set(s.methods) - {"fbp"}:
        problem = InsetProblem(still, grid)
        problems = {
            e: problem if motion is None else problem.with_motion(motion)
            for e, motion in estimates.items()
        }
    network = Mbir.load() if "mbir" in s.methods else None

    def reconstruct(method: str, scan: Scan, error: float | str | None) -> Tensor:
        if method == "fbp":
            return reference_fbp(scan, grid, estimates[error])
        if network is None or method == "pwls":
            term = problems[error].term(scan)
            found, _ = problems[error].solve(term, DEFAULT_PRIOR, tolerance=_PWLS_TOLERANCE_HU)
            return found[0].float()
        # Noise free: as a scan of the study's exposure whose readings happen to be their
        # expectations.
        term = problems[error].term(scan)
        if scan.noise_free:
            term = term.times(s.exposure_s / NOISE_FREE_EXPOSURE_S)
        return network(term)[0]

    noise: list[int | None] = [None, *range(s.seed, s.seed + s.realisations)]
    found: dict[Key, list[PlaqueImage]] = {}
    rest: dict[str, Tensor] = {}
    for k, seed in enumerate(noise):
        # The same draws at rest and in motion: noise belongs to the reading, not to what is seen.
        scans = [
            scan if seed is None else scan.with_noise(s.exposure_s, seed)
            for scan in (still, moving)
        ]
        # Where the vessel is on average no scan tells: in the place of the true mean.
        seen = cache(f"path_{seed}", partial(_estimated, scans[1], grid))
        estimates[ESTIMATED] = seen.numpy() + path.mean(0)
        if problems:
            problems[ESTIMATED] = problems[None].with_motion(estimates[ESTIMATED])
        for method in s.methods:
            for error in estimates:
                if method == "pwls" and (k > 1 or error):
                    continue
                run = partial(reconstruct, method, scans[error is not None], error)
                volume = cache(f"{method}_{error}_{seed}", run)
                if seed is None and error is None:
                    rest[method] = volume
                found.setdefault((method, error, seed is not None), []).append(
                    observe(volume, reference, rest[method])
                )
        progress((k + 1) / len(noise))
    return found


def _estimated(scan: Scan, grid: VolumeGrid) -> Tensor:
    return torch.from_numpy(estimate_motion(scan, grid).path)


# --- the report -----------------------------------------------------------------------------------


def _up_to(errors: Sequence[float], good: Sequence[bool]) -> float | None:
    """The last of the errors up to which all are good; None: not even the first."""
    kept = None
    for error, ok in zip(errors, good, strict=True):
        if not ok:
            break
        kept = error
    return kept


def _core_right(found: JsonObject) -> bool:
    """Whether a core was segmented where it is."""
    return bool(found["core_found"] and found["core_dice"] >= _DICE)


def _borne(data: JsonObject) -> JsonObject:
    """Up to which motion the PCCT's core survives: shares of the whole motion; None: not even the
    least was borne.

    Returns:
        Of the image with residual motion ``contrast`` (within 20 % of that at rest) and ``core``
        (segmented); of noise-free FBP with a wrong estimate of the motion ``assumed_contrast``, and
        of every method ``assumed_core``.
    """
    s, rest = data["settings"], data["at_rest"]["PCCT"]
    series = [r["in_place"] for r in data["residual"] if r["scanner"] == "PCCT"]
    errors = (0.0, *s["errors"])

    def kept(found: JsonObject) -> bool:
        return bool(100.0 * abs(found["contrast_hu"] / rest["contrast_hu"] - 1.0) <= _TOLERANCE)

    estimates: dict[str, list[JsonObject]] = {}
    for c in data["compensated"]:
        if not c["noisy"] and c["error"] not in (None, ESTIMATED):
            estimates.setdefault(c["method"], []).append(c["realisations"][0])
    whole = {name: found for name, found in estimates.items() if len(found) == len(errors)}
    return {
        "contrast": _up_to(s["fractions"], [kept(o) for o in series]),
        "core": _up_to(s["fractions"], [_core_right(o) for o in series]),
        "core_at_rest": _core_right(rest),
        "assumed_contrast": _up_to(errors, [kept(o) for o in estimates["fbp"]]),
        "assumed_core": {
            name: _up_to(errors, [_core_right(o) for o in found]) for name, found in whole.items()
        },
    }


def checks(data: JsonObject) -> list[Check]:
    """The motion itself, what lumen and core bear of it, and the EID-CT beside the PCCT."""
    s, rest = data["settings"], data["at_rest"]["PCCT"]
    series, eid = (
        {r["fraction"]: r["in_place"] for r in data["residual"] if r["scanner"] == name}
        for name in ("PCCT", "EID-CT")
    )
    stable, tolerated = paper.MOTION["lumen_stable_below"], paper.MOTION["tolerated"]
    drift = {f: abs(100.0 * o["lumen_mm2"] / rest["lumen_mm2"] - 100.0) for f, o in series.items()}
    small, worst = [v for f, v in drift.items() if f < stable], max(series)
    low, high = (x / s["amplitude_mm"] for x in data["range_mm"])
    checks = [
        Check("largest displacement over the amplitude", high, "range [0, A]", 0.99, 1.01),
        Check("smallest displacement over the amplitude", low, "range [0, A]", -0.01, 0.01),
    ]
    if small:
        name = f"lumen area's change below {100 * stable:.0f} % of the motion, %"
        checks.append(Check(name, max(small), "stable", high=_TOLERANCE))
    if stable in drift and worst > stable:
        name = (
            f"lumen area's change at {100 * worst:.0f} % over that at {100 * stable:.0f} % of "
            "the motion"
        )
        checks.append(
            Check(name, drift[worst] / max(drift[stable], 1e-9), "suffers beyond", low=1.0)
        )
    if tolerated in series:
        here, least, borne = series[tolerated], series[min(series)], data["borne"]["contrast"]
        if rest["core_found"]:
            lost = (
                100.0 * abs(here["core_mm2"] / rest["core_mm2"] - 1.0)
                if here["core_found"]
                else 100.0
            )
            name = f"core area's change at {100 * tolerated:.0f} % (100: lost), %"
            more = f"more than the lumen's {drift[tolerated]:.1f}"
            checks.append(Check(name, lost, more, low=max(drift[tolerated], 1.0)))
        name = "largest residual motion with the core's contrast within 20 %, % of the motion"
        ours, limit = math.nan if borne is None else 100 * borne, 100 * tolerated
        checks.append(Check(name, ours, f"{limit:.0f}", limit / 2, limit))
        name = f"core segmented at {100 * min(series):.0f} % of the motion (1: yes)"
        note = f"contrast {least['contrast_hu']:.1f} HU, at rest {rest['contrast_hu']:.1f}"
        check = Check(name, float(_core_right(least)), "visible up to 20 %", low=1.0)
        checks.append(check.explained(f"no such region of 20–60 HU; {note}"))
    name = f"core segmented at {100 * worst:.0f} % of the motion (1: yes)"
    checks.append(
        Check(name, float(series[worst]["core_found"]), "structures not reconstructed", high=0.0)
    )
    if len(series) > 1:
        rise = min(np.diff([o["nrmse"] for o in series.values()]))
        checks.append(Check("smallest rise of the NRMSE with the motion", rise, "rises", low=0.0))
    for fraction in (f for f in eid if f in series):
        name = f"NRMSE at {100 * fraction:.0f} %, EID-CT over PCCT"
        ratio = eid[fraction]["nrmse"] / series[fraction]["nrmse"]
        checks.append(Check(name, ratio, "EID-CT less sensitive", high=1.0))
    return checks


def figures(measured: Measured) -> dict[str, Figure]:
    """Images with error maps, and measures against the motion."""
    s, m = measured.settings, measured.seen
    return {"motion_images.png": _images(m), "motion.png": _curves(s, m)}


def _error_map(found: PlaqueImage, rest: PlaqueImage) -> Panel:
    # The one grey scale of the figure is that of images: stretch the error to its window.
    center, width = WINDOW_HU
    return middle_panel((found.image - rest.image) * (width / _ERROR_WIDTH_HU) + center)


def _images(m: MotionImages) -> Figure:
    """PCCT and EID-CT with residual motion and their error maps; then the compensated images."""
    rows: list[list[Panel]] = []
    labels = []

    def title_of(error: float | str | None) -> str:
        return (
            "at rest"
            if error is None
            else "estimated motion"
            if isinstance(error, str)
            else f"wrong by {100 * error:.0f} %"
            if error
            else "true motion"
        )

    for name, rest in m.at_rest.items():
        found = {
            "at rest": rest,
            **{f"{100 * f:.0f} %": here for f, (here, _) in m.residuals(name).items()},
        }
        rows += [
            [plaque_panel(o, title) for title, o in found.items()],
            [_error_map(o, rest) for o in found.values()],
        ]
        labels += [name, "error"]
    for noisy in (False, True):
        for method, title in METHODS.items():
            row = [
                plaque_panel(found[0], title_of(error))
                for (name, error, with_noise), found in m.compensated.items()
                if name == method and with_noise == noisy
            ]
            if row:
                rows.append(row)
                labels.append(f"{title.split(' (')[0]}{', noise' if noisy else ''}")
    figure = panels(
        rows,
        labels,
        "Residual motion, and compensation of the largest",
        f"C150 / W600 HU; error maps C0 / W{_ERROR_WIDTH_HU:g} HU. Outlines: lumen (red), core "
        "where segmented (yellow).",
    )
    width, height = 0.6 * figure.get_size_inches()  # ten rows of small images
    figure.set_size_inches(width, height)
    return figure


def _curves(s: MotionSettings, m: MotionImages) -> Figure:
    """NRMSE, lumen area and depth of the core's basin against residual motion, uncompensated and
    compensated."""
    figure, axes = curve_axes(
        "residual motion, mm", ["NRMSE, %", "lumen area, of that at rest", "core's basin, HU"]
    )

    def draw(
        x: list[float],
        found: list[PlaqueImage],
        rest: PlaqueImage,
        marker: str,
        color: str,
        label: str,
    ) -> None:
        curves = (
            [100 * o["nrmse"] for o in found],
            [o["lumen_mm2"] / rest["lumen_mm2"] for o in found],
            [o["basin_depth_hu"] for o in found],
        )
        for ax, values in zip(axes, curves, strict=True):
            # Moving the image back does not change an area.
            if marker != "x--" or ax is not axes[1]:
                ax.plot(x, values, marker, color=color, label=label)

    amplitude = s.amplitude_mm
    for name, color in (("PCCT", "black"), ("EID-CT", "tab:blue")):
        rest, pairs = m.at_rest[name], m.residuals(name)
        if pairs:
            x = [amplitude * f for f in (0.0, *pairs)]
            in_place, back = ([rest, *(pair[k] for pair in pairs.values())] for k in (0, 1))
            draw(x, in_place, rest, "o-", color, f"{name}, in place")
            draw(x, back, rest, "x--", color, f"{name}, moved back")
    known = [0.0, *s.errors]
    for method, color in (("fbp", "tab:orange"), ("mbir", "tab:red")):
        if method in s.methods:
            rest = m.compensated[method, None, False][0]
            found = [m.compensated[method, e, False][0] for e in known]
            x = [e * amplitude * s.worst for e in known]
            draw(x, found, rest, "s-", color, f"compensated {METHODS[method].split(' (')[0]}")
    for ax in axes:
        ax.legend(fontsize=6.5)
    return figure
