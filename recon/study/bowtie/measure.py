"""Study ``dose``: what the ROI bowtie saves, what it costs in noise, and what MBIR and ROI bowtie give together.

Parts: transmission of the bowties; CTDI doses of the 32 cm phantom; dose maps of phantom and thorax, unscattered and
scattered; noise inside and outside of the region of interest; residual cupping of the 5th-order beam-hardening
correction; and the plaque scanned with both bowties, reconstructed by FBP and by MBIR. Not to be confused with
``torchpcct dose-factor`` (:mod:`recon.study.dose_factor`), which measures what MBIR saves at 200 realisations.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from recon.study.bowtie.slice_scan import BOWTIES, radial_profile, slice_image, slice_scans, wide_scanner
from torchpcct.geometry import VolumeGrid

if TYPE_CHECKING:
    from recon.study.bowtie.combined import Combined
    from recon.study.bowtie.dose_maps import DoseMaps
    from recon.study.report import Report
    from torchpcct.scene import Scene

__all__ = ["Images", "Measured", "Settings", "run"]

Floats = NDArray[np.float64]
Progress = Callable[[str, float], None]

PIXEL_MM = 0.78
"""Voxels of the paper's images."""

CTDI_REGIONS_MM = {"inside": (10.0, 40.0), "outside": (85.0, 115.0)}
"""Rings (inner, outer radius) of the CTDI phantom whose noise is compared; clear of bores and of the ROI's edge."""

HEART_DISC_MM = 8.0
"""Radius of the disc of heart muscle at the isocentre whose noise is compared."""

_THORAX_CENTER = (-34.0, -14.0)


@dataclass(frozen=True)
class Settings:
    """Settings of the study.

    Args:
        exposure_s: of the scans for dose and noise, at 1000 mA.
        views: of the slices' scans.
        kernel: reconstruction kernel of the slices (the paper does not name it).
        realizations: of the slices' noise.
        detector: ``"eid"`` as the paper, or ``"silicon"``; see :func:`recon.study.bowtie.slice_scan.wide_scanner`.
        map_mm: voxels of the thorax's dose map; that of the phantom has half of them, at least 1 mm.
        histories: photons of each Monte Carlo run; 0: no scatter.
        plaque_views: of the plaque's scans; fewer than 1968 keep the tube load.
        plaque_doses: exposures of the plaque's scans in s.
        plaque_realizations: paired realisations for MBIR.
        seed: of the first realisation and of the Monte Carlo.

    Raises:
        ValueError, TypeError: a value out of range or of the wrong kind.
    """

    exposure_s: float = 0.35
    views: int = 1968
    kernel: str = "standard"
    realizations: int = 4
    detector: str = "eid"
    map_mm: float = 2.0
    histories: int = 2_000_000
    plaque_views: int = 984
    plaque_doses: tuple[float, ...] = (0.35, 2.0)
    plaque_realizations: int = 40
    seed: int = 0

    def __post_init__(self) -> None:
        for name, least in (
            ("views", 8), ("realizations", 2), ("histories", 0), ("plaque_views", 8), ("plaque_realizations", 4),
            ("seed", 0),
        ):  # fmt: skip
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int):
                raise TypeError(f"{name} must be a whole number, got {value!r}")
            if value < least:
                raise ValueError(f"{name} must be at least {least}, got {value}")
        if 0 < self.histories < 10_000:
            raise ValueError(f"histories must be 0 (no scatter) or at least 10000, got {self.histories}")
        for name in ("exposure_s", "map_mm"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"{name} must be greater than 0, got {getattr(self, name)}")
        doses = tuple(float(d) for d in self.plaque_doses)
        object.__setattr__(self, "plaque_doses", doses)
        if not doses or not all(math.isfinite(d) and d > 0 for d in doses):
            raise ValueError(f"plaque_doses must be exposures greater than 0 s, got {doses}")
        if self.detector not in ("eid", "silicon"):
            raise ValueError(f"detector must be 'eid' or 'silicon', got {self.detector!r}")

    @classmethod
    def quick(cls, **changes: Any) -> Settings:
        """A first look in under a minute: a quarter of the views, coarse maps, few photons and realisations."""
        values: dict[str, Any] = {
            "views": 492, "realizations": 2, "map_mm": 6.0, "histories": 100_000, "plaque_views": 123,
            "plaque_doses": (2.0,), "plaque_realizations": 4,
        }  # fmt: skip
        return cls(**{**values, **changes})


@dataclass(frozen=True)
class Images:
    """Images of one slice with both bowties, HU: ``clean`` and one ``noisy`` realisation, ``(2, y, x)``."""

    grid: VolumeGrid
    clean: Floats
    noisy: Floats


@dataclass
class Measured:
    """Everything the report needs."""

    settings: Settings
    transmission: dict[str, Any] = field(default_factory=dict)
    ctdi: dict[str, Any] = field(default_factory=dict)
    ramps: list[dict[str, float]] = field(default_factory=list)
    maps: dict[str, DoseMaps] = field(default_factory=dict)
    thorax: dict[str, dict[str, float]] = field(default_factory=dict)
    images: dict[str, Images] = field(default_factory=dict)
    noise: dict[str, dict[str, Any]] = field(default_factory=dict)
    cupping_hu: dict[str, float] = field(default_factory=dict)
    patient_ratio: dict[str, float] = field(default_factory=dict)
    combined: list[Combined] = field(default_factory=list)
    plan: dict[str, Any] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)


def run(settings: Settings, progress: Progress | None = None) -> Report:
    """Run the study; see the module's docstring.

    Args:
        settings: of the study.
        progress: called with the name of the step and its finished fraction.
    """
    from recon.study.bowtie.report import build_report

    return build_report(measure(settings, progress))


def measure(settings: Settings, progress: Progress | None = None) -> Measured:
    """Everything but the report."""
    report = progress or (lambda step, fraction: None)
    m = Measured(settings)
    for name, part in (
        ("dose", _dose), ("noise", _noise), ("beam hardening", _cupping), ("plaque: MBIR and ROI bowtie", _plaque)
    ):  # fmt: skip
        start = time.perf_counter()
        report(name, 0.0)
        part(m, lambda fraction, name=name: report(name, fraction))  # type: ignore[misc]
        report(name, 1.0)
        m.seconds[name] = round(time.perf_counter() - start, 1)
    return m


def _scenes() -> dict[str, Scene]:
    from torchpcct.scene.phantoms.quality import ctdi
    from torchpcct.scene.phantoms.thorax import thorax

    return {"ctdi": ctdi(), "thorax": thorax()}


def _grid(name: str, spacing: float) -> VolumeGrid:
    """Square voxels that hold the object with a rim of air."""
    extent, center = ((340.0, 340.0), (0.0, 0.0)) if name == "ctdi" else ((252.0, 356.0), _THORAX_CENTER)
    return VolumeGrid(tuple(math.ceil(e / spacing) for e in extent), spacing, center)


def _dose(m: Measured, report: Callable[[float], None]) -> None:
    from recon.study.bowtie import dose_maps as part
    from torchpcct.dose import monte_carlo_dose, primary_dose
    from torchpcct.scene.phantoms.quality import water_cylinder

    s = m.settings
    scanners = {b: wide_scanner(b, 8) for b in BOWTIES}
    m.transmission = part.transmission(scanners)
    m.ramps = part.ramp_figures(scanners, s.exposure_s)
    m.ctdi = part.ctdi_figures(scanners, s.exposure_s, s.histories, s.seed, lambda f: report(0.3 * f))
    scenes = _scenes()
    m.maps["ctdi"] = part.dose_maps(
        scenes["ctdi"], scanners, _grid("ctdi", max(s.map_mm / 2, 1.0)), s.exposure_s, 0, s.seed,
        lambda f: report(0.3 + 0.2 * f),
    )  # fmt: skip
    thorax, maps = scenes["thorax"], part.dose_maps(
        scenes["thorax"], scanners, _grid("thorax", s.map_mm), s.exposure_s, s.histories, s.seed,
        lambda f: report(0.5 + 0.4 * f),
    )  # fmt: skip
    m.maps["thorax"] = maps
    side = ("rib_left_1", "rib_left_2", "rib_left_3", "rib_right_1", "rib_right_2", "rib_right_3")
    regions: dict[str, Any] = {
        "side ribs": lambda n: n.startswith(side),
        "all ribs": lambda n: n.startswith("rib_"),
        "skin": ("skin",), "muscle of the chest wall": ("muscle",), "lungs": ("lungs",), "heart wall": ("heart",),
        "whole slice": lambda n: True,
    }  # fmt: skip
    for name, chosen in regions.items():
        m.thorax[name] = {"unscattered": part.region_ratio(maps, thorax, chosen)}
        if s.histories:
            m.thorax[name]["with scatter"] = part.region_ratio(maps, thorax, chosen, scatter=True)
    # The plaque's own patient: mean dose to 24 cm of fat.
    fat, grid = water_cylinder(240.0, material="pericoronary_fat"), VolumeGrid((64, 64), 4.0)
    means = {b: [primary_dose(fat, scanners[b], grid, s.exposure_s).sum()] for b in BOWTIES}
    if s.histories:
        for b in BOWTIES:
            result = monte_carlo_dose(fat, scanners[b], grid, s.exposure_s, histories=s.histories // 2, seed=s.seed)
            means[b].append((result.primary + result.scattered).sum())
    kinds = ("unscattered", "with scatter")
    m.patient_ratio = {
        k: float(roi / large) for k, large, roi in zip(kinds, means["large"], means["large+roi"], strict=False)
    }


def _noise(m: Measured, report: Callable[[float], None]) -> None:
    s = m.settings
    scanners = [wide_scanner(b, s.views, s.detector) for b in BOWTIES]
    for k, (name, scene) in enumerate(_scenes().items()):
        scans = slice_scans(scene, scanners, s.exposure_s)
        report(0.5 * k + 0.25)
        grid = _grid(name, PIXEL_MM)
        clean = np.stack([slice_image(scan, grid, s.kernel) for scan in scans])
        y, x = np.meshgrid(*grid.axes, indexing="ij")
        r = np.hypot(x, y)
        regions = {"heart": r < HEART_DISC_MM}
        if name == "ctdi":
            regions = {region: (r >= low) & (r < high) for region, (low, high) in CTDI_REGIONS_MM.items()}
        squares, first, rings = [], clean, np.zeros((len(BOWTIES), 0))
        for i in range(s.realizations):
            noisy = np.stack([slice_image(scan, grid, s.kernel, seed=s.seed + i) for scan in scans])
            error = noisy - clean
            squares.append({region: [float(e[mask].var()) for e in error] for region, mask in regions.items()})
            profile = np.stack([radial_profile(e**2, grid, 155.0) for e in error])
            rings = profile[..., 1] + (rings if i else 0.0)
            first = noisy if i == 0 else first
        m.images[name] = Images(grid, clean, first)
        entry: dict[str, Any] = {
            "quanta_per_reading": {b: float((c.mean / c.gain).min()) for b, c in zip(BOWTIES, scans, strict=True)}
        }
        for region, mask in regions.items():
            variance = np.array([q[region] for q in squares])
            sd = np.sqrt(variance.mean(0))
            ratio = np.sqrt(variance[:, 1] / variance[:, 0])
            entry[region] = {
                "mean_hu": [float(c[mask].mean()) for c in clean],
                "sd_hu": sd.tolist(),
                "ratio": float(sd[1] / sd[0]),
                "ratio_error": float(ratio.std(ddof=1) / math.sqrt(len(ratio))),
            }
        if name == "ctdi":
            entry["profile"] = {"radius_mm": profile[0, :, 0], "sd_hu": np.sqrt(rings / s.realizations)}
        m.noise[name] = entry
        report(0.5 * (k + 1))


def _cupping(m: Measured, report: Callable[[float], None]) -> None:
    """Largest difference between ring means of a water cylinder of 32 cm, 5 mm rings out to 95 % of its radius."""
    from torchpcct.scene.phantoms.quality import water_cylinder

    radius = 160.0
    # Round about the axis: every view is the same, a few are enough.
    scanners = [wide_scanner(b, min(m.settings.views, 492), m.settings.detector) for b in BOWTIES]
    grid = _grid("ctdi", 2 * PIXEL_MM)
    for bowtie, scan in zip(BOWTIES, slice_scans(water_cylinder(2 * radius), scanners, 1.0), strict=True):
        profile = radial_profile(slice_image(scan, grid, m.settings.kernel), grid, 0.95 * radius)[:, 1]
        m.cupping_hu[bowtie] = float(np.ptp(profile))
    report(1.0)


def _plaque(m: Measured, report: Callable[[float], None]) -> None:
    from recon.study.bowtie.combined import combine

    s = m.settings
    m.combined, m.plan = combine(s.plaque_doses, s.plaque_realizations, s.plaque_views, s.seed, report)


def settings_dict(settings: Settings) -> dict[str, Any]:
    """JSON values of the settings."""
    return asdict(settings)
