"""What the ROI bowtie saves in dose and costs in noise, and what MBIR and ROI bowtie give together.

The paper's dose study is two-dimensional and uses an energy-integrating detector without electronic
noise behind the PCCT's tube and bowties. Here its cells are those of the paper's EID-CT, on an arc
wide enough for the phantoms (the PCCT's own field of view of 296 mm is not).

MBIR and ROI bowtie together, which the paper multiplies from two studies, are one simulation here:
the plaque (42.4 mm off the isocentre, inside the 10 cm that the ROI bowtie spares) is scanned with
both bowties, and MBIR measured against FBP behind each (:mod:`recon.evaluate`). FBP's figures are
exact, so the factor of MBIR with the ROI bowtie against FBP with the large one is the first times
the ratio of FBP's two figures.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from recon.analytic.fbp import fbp
from recon.evaluate.experiment import evaluate
from recon.evaluate.tasks import read_task
from recon.jobs.store import Step, StudyCache
from recon.study.paper import published as paper
from recon.study.report import Check, around
from recon.study.study import Measured, Progress, StudySettings, silent
from torchpcct.acquisition.acquire import acquire
from torchpcct.dose import CtdiDose, ctdi_dose, monte_carlo_dose, primary_dose
from torchpcct.geometry import VolumeGrid
from torchpcct.scan import Scan
from torchpcct.scanner import Scanner, Scintillator, presets
from torchpcct.scanner.linearisation import WaterLinearisation
from torchpcct.scene import Scene
from torchpcct.scene.materials import MATERIALS
from torchpcct.scene.phantoms.quality import ctdi, water_cylinder
from torchpcct.scene.phantoms.thorax import thorax
from torchpcct.validate import choice, number, numbers
from torchpcct.volume import to_hu

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike

    from recon.evaluate.experiment import Evaluation
    from recon.evaluate.task import Task
    from torchpcct.typing import Bools, JsonObject


Floats = NDArray[np.float64]

BOWTIES = ("large", "large+roi")
"""Names of the bowties that are compared."""

HALF_FAN_RAD = 0.32
"""Half-angle of the fan: holds the thorax with the heart at the isocentre (radius 190 mm)."""

CALIBRATION_ORDER = 5
"""Beam-hardening correction as published: order of the polynomial."""
CALIBRATION_STEP_MM = 10.0
"""Steps of water, mm."""
CALIBRATION_MAX_MM = 380.0
"""Thickest water, mm."""

PIXEL_MM = 0.78
"""Voxels of the paper's images."""

CTDI_REGIONS_MM = {"inside": (10.0, 40.0), "outside": (85.0, 115.0)}
"""Rings (inner, outer radius) of the CTDI phantom whose noise is compared; clear of bores and of
the ROI's edge."""

HEART_DISC_MM = 8.0
"""Radius of the disc of heart muscle at the isocentre whose noise is compared."""

_THORAX_CENTER = (-34.0, -14.0)
"""Centre of the thorax, (y, x) mm."""

DETECTORS = ("eid", "silicon")
"""Detectors of the two scanners."""

_SIDES = tuple(f"rib_{side}_{k}" for side in ("left", "right") for k in (1, 2, 3))
"""Beginnings of the names of the ribs at the sides."""
TISSUES: dict[str, tuple[str, ...]] = {
    "side ribs": _SIDES,
    "all ribs": ("rib_",),
    "skin": ("skin",),
    "muscle of the chest wall": ("muscle",),
    "lungs": ("lungs",),
    "heart wall": ("heart",),
    "whole slice": ("",),
}
"""Tissue → what the names of its bodies in the thorax begin with."""


_RECORDS = {
    "contrast_variance": ("contrast SD at slope 1", -2.0, "dose factor: contrast at slope 1"),
    "paper_cnr": ("CNR", 2.0, "dose factor: CNR"),
}
"""What factors are measured by → record, the power of it that is proportional to dose, and the
dose factor's record."""
_KEYS = ("value", "low", "high")
"""Of a record: a figure and its interval."""
_ROI_RADIUS_MM = 50.0
"""Radius of the region of interest within which the ROI bowtie is open."""
_COLOURS = dict(zip(BOWTIES, ("tab:blue", "tab:orange"), strict=True))
"""Of the charts."""


@dataclass(frozen=True)
class BowtieSettings(StudySettings):
    """Settings of the study; the quick ones: a quarter of the views, coarse maps, few photons.

    Args:
        exposure_s: of the scans for dose and noise, at 1000 mA.
        views: of the slices' scans.
        kernel: reconstruction kernel of the slices (the paper does not name it).
        realisations: of the slices' noise.
        detector: ``"eid"``, the energy-integrating one of the paper, or ``"silicon"``, the
            photon-counting one.
        map_mm: voxels of the thorax's dose map; that of the phantom has half of them, at least 1
            mm.
        histories: photons of each Monte Carlo run; 0: no scatter.
        plaque_views: of the plaque's scans; fewer than the paper's keep the tube load.
        plaque_doses: exposures of the plaque's scans in s.
        plaque_realisations: paired realisations for MBIR; controlling them needs at least 8.
        seed: of the first realisation and of the Monte Carlo.
    """

    exposure_s: float = 0.35
    views: int = paper.FULL_VIEWS["PCCT"]
    kernel: str = "standard"
    realisations: int = 4
    detector: str = "eid"
    map_mm: float = 2.0
    histories: int = 2_000_000
    plaque_views: int = paper.FULL_VIEWS["PCCT"] // 2
    plaque_doses: tuple[float, ...] = (0.35, 2.0)
    plaque_realisations: int = 40
    seed: int = 0

    QUICK: ClassVar = {
        "views": 492,
        "realisations": 2,
        "map_mm": 6.0,
        "histories": 100_000,
        "plaque_views": 123,
        "plaque_doses": (2.0,),
        "plaque_realisations": 8,
    }

    def __post_init__(self) -> None:
        self.check_whole(
            views=8, realisations=2, histories=0, plaque_views=8, plaque_realisations=8, seed=0
        )
        if 0 < self.histories < 10_000:
            raise ValueError(
                f"histories must be 0 (no scatter) or at least 10000, got {self.histories}"
            )
        number("exposure_s", self.exposure_s, positive=True, unit="s")
        number("map_mm", self.map_mm, positive=True, unit="mm")
        doses = numbers("plaque_doses", self.plaque_doses, positive=True, unit="s")
        object.__setattr__(self, "plaque_doses", doses)
        choice("detector", self.detector, DETECTORS)


def measure(
    settings: BowtieSettings, progress: Progress = silent, folder: str | Path | None = None
) -> Measured:
    """Dose, noise, and the plaque by FBP and MBIR; finished parts are cached."""
    s, cache = settings, StudyCache(folder, settings)
    data: JsonObject = {}
    scenes = phantoms()

    scanners = wide_scanners(8)
    data["transmission"] = transmission(scanners)
    cache.ahead(*_step())
    doses: dict[str, dict[str, CtdiDose]] = _kept(s, cache, "ctdi")
    progress("dose", 0.3)
    data["ctdi_ratios"] = {k: ratios(v) for k, v in doses.items()}
    more = ("total_peripheral", "total_central", "weighted", "weighted_error")
    data["ctdi_mgy"] = {
        k: {
            b: {**asdict(d), **{name: float(getattr(d, name)) for name in more}}
            for b, d in v.items()
        }
        for k, v in doses.items()
    }
    maps = {}
    for k, name in enumerate(("ctdi", "thorax")):
        maps[name] = _kept(s, cache, f"map_{name}")
        progress("dose", 0.3 + 0.3 * (k + 1))
    data["thorax_dose_ratio"] = {
        t: region_ratio(maps["thorax"], scenes["thorax"], b) for t, b in TISSUES.items()
    }
    data["patient_dose_ratio"] = _kept(s, cache, "patient")
    progress("dose", 1.0)

    found = {}
    for k, name in enumerate(scenes):
        found[name] = _kept(s, cache, f"noise_{name}")
        progress("noise", (k + 1) / len(scenes))
    data["noise"] = {name: values for name, (values, _) in found.items()}

    saved: dict[str, float] = {
        k: 1.0 / data["ctdi_ratios"][k]["weighted"] for k in ("plane", "total") if k in doses
    }
    data["combined"] = _combined(s, saved, cache.folder("evaluate"), progress)
    images = {name: image for name, (_, image) in found.items()}
    return Measured(s, data, (maps, images))


def plan(settings: BowtieSettings, folder: str | Path | None) -> None:
    """List the jobs that are left: doses and noise, then those of the evaluation; see
    :mod:`recon.study.study`."""
    cache = StudyCache(folder, settings)
    cache.plan(_step())
    _evaluated(settings, cache.folder("evaluate"), silent)


def _step() -> Step:
    of_scenes = [f"{kind}_{name}" for kind in ("noise", "map") for name in phantoms()]
    return _kept, [(name,) for name in ("ctdi", "patient", *of_scenes)]


def _kept(settings: BowtieSettings, cache: StudyCache, name: str) -> Any:
    """A part of the study by its name, cached; of the CTDI phantom the doses in its bores, by four
    readings of "dose"."""
    s, (kind, _, scene) = settings, name.partition("_")
    asked: dict[str, dict[str, Any]] = {
        "plane": {"axial": "plane"},
        "contiguous": {},
        "interacted": {"quantity": "interacted"},
        **({"total": {"histories": s.histories, "seed": s.seed}} if s.histories else {}),
    }

    def compute() -> object:
        if kind == "noise":
            scanners, seeds = (
                wide_scanners(s.views, s.detector),
                range(s.seed, s.seed + s.realisations),
            )
            return noise(scene, phantoms()[scene], scanners, s.exposure_s, s.kernel, seeds)
        scanners = wide_scanners(8)
        if kind == "ctdi":
            return {
                k: {b: ctdi_dose(d, s.exposure_s, **how) for b, d in scanners.items()}
                for k, how in asked.items()
            }
        if kind == "patient":  # the plaque's own, 24 cm of fat
            fat, grid = (
                water_cylinder(240.0, material="pericoronary_fat"),
                VolumeGrid((64, 64), 4.0),
            )
            maps = dose_maps(fat, scanners, grid, s.exposure_s, s.histories // 2, s.seed)
            return {k: float(dose[1].sum() / dose[0].sum()) for k, dose in maps.doses.items()}
        # The CTDI phantom's map is drawn only, its doses are those in the bores: no scatter.
        spacing, histories = (
            (max(s.map_mm / 2, 1.0), 0) if scene == "ctdi" else (s.map_mm, s.histories)
        )
        grid = phantom_grid(scene, spacing)
        return dose_maps(phantoms()[scene], scanners, grid, s.exposure_s, histories, s.seed)

    return cache(name, compute)


# --- slices ---------------------------------------------------------------------------------------


def wide_scanners(views: int, detector: str = "eid") -> dict[str, Scanner]:
    """The paper's scanner of the dose study, one detector row, with each of :data:`BOWTIES`.

    Args:
        views: per rotation.
        detector: ``"eid"``: energy-integrating cells of 1.02 × 1.10 mm without electronic noise;
            ``"silicon"``: the PCCT's counting cells of 0.35 × 0.5 mm.

    Raises:
        ValueError: another detector.
    """
    choice("detector", detector, DETECTORS)
    integrating = detector == "eid"
    scanners = {b: presets.pcct(views=views, bowtie=b, rows=1) for b in BOWTIES}
    pitch = presets.EID_PITCH_MM if integrating else presets.PCCT_PITCH_MM
    geometry = scanners["large"].geometry
    columns = 2 * math.ceil(HALF_FAN_RAD * geometry.sdd / pitch[1])
    changes: dict[str, object] = {"geometry": replace(geometry, columns=columns, pitch=pitch)}
    if integrating:
        changes["detector"] = Scintillator(electronic_noise_kev=0.0)
    return {b: s.replace(**changes) for b, s in scanners.items()}


def slice_scans(scene: Scene, scanners: dict[str, Scanner]) -> dict[str, Scan]:
    """Noise-free scans of the slice z = 0 with the paper's beam-hardening correction.

    Each reading is that of its central ray; smooth bodies need no finite beam at the voxels of this
    study. Readings of equal expectation carry equal noise in the scans of all bowties.
    """
    return {
        b: replace(acquire(scene, s, sub_rays=1), linearisation=polynomial_linearisation(s))
        for b, s in scanners.items()
    }


def polynomial_linearisation(scanner: Scanner) -> WaterLinearisation:
    """The paper's beam-hardening correction: per column a polynomial through 0, fitted to equal
    steps of water.

    The value of water is that of the library's own correction, so that images of both compare.
    """
    step = CALIBRATION_STEP_MM
    thickness = np.arange(step, CALIBRATION_MAX_MM + 0.5 * step, step)
    energies, weights = scanner.weights()
    mu_water = MATERIALS["water"].attenuation(energies)
    transmitted = weights[0] @ np.exp(-np.outer(mu_water, thickness))
    p = np.log(weights[0].sum(-1))[:, None] - np.log(transmitted)
    middle = weights.shape[1] // 2
    mu_ref = WaterLinearisation.calibrate(weights[0, middle : middle + 1], mu_water).mu_ref
    scale = p[:, -1]
    powers = (p / scale[:, None])[..., None] ** np.arange(1, CALIBRATION_ORDER + 1)
    fits = [
        np.linalg.lstsq(a, mu_ref * thickness / s, rcond=None)[0]
        for a, s in zip(powers, scale, strict=True)
    ]
    return WaterLinearisation(np.stack(fits), scale, mu_ref)


def slice_image(scan: Scan, grid: VolumeGrid, kernel: str) -> Floats:
    """FBP of a slice in HU, ``grid.shape`` float64."""
    image = fbp(scan.line_integrals()[:, 0], scan.geometry.central_fan, grid, kernel)
    return np.asarray(to_hu(image, scan.linearisation.mu_ref).numpy(), dtype=np.float64)


def _radius(grid: VolumeGrid) -> Floats:
    y, x = np.meshgrid(*grid.axes, indexing="ij")
    return np.asarray(np.hypot(x, y))


def radial_profile(
    image: ArrayLike, grid: VolumeGrid, radius: float, step_mm: float = 5.0
) -> Floats:
    """Means over rings of ``step_mm`` about the isocentre out to ``radius``, ``(rings, 2)`` of
    radius and mean."""
    ring = (_radius(grid) / step_mm).astype(np.int64).ravel()
    count = int(radius / step_mm)
    total = np.bincount(ring, np.asarray(image, np.float64).ravel())[:count]
    return np.stack([(np.arange(count) + 0.5) * step_mm, total / np.bincount(ring)[:count]], axis=1)


def phantoms() -> dict[str, Scene]:
    """The CTDI phantom and the thorax."""
    return {"ctdi": ctdi(), "thorax": thorax()}


def phantom_grid(name: str, spacing: float) -> VolumeGrid:
    """Square voxels that hold the phantom with a rim of air."""
    extent, center = (
        ((340.0, 340.0), (0.0, 0.0)) if name == "ctdi" else ((252.0, 356.0), _THORAX_CENTER)
    )
    return VolumeGrid(tuple(math.ceil(e / spacing) for e in extent), spacing, center)


def noise(
    name: str,
    scene: Scene,
    scanners: dict[str, Scanner],
    exposure_s: float,
    kernel: str,
    seeds: range,
) -> tuple[dict[str, object], Floats]:
    """Mean and noise of the regions of one of :func:`phantoms` with both bowties, a realisation for
    each seed.

    Returns:
        JSON values by region (and of the CTDI phantom the noise against the radius), and the first
        realisation's images in HU on :func:`phantom_grid`, ``(2, y, x)``.
    """
    scans, grid = slice_scans(scene, scanners), phantom_grid(name, PIXEL_MM)
    clean = np.stack([slice_image(scan, grid, kernel) for scan in scans.values()])
    r = _radius(grid)
    regions: dict[str, Bools] = {"heart": r < HEART_DISC_MM}
    if name == "ctdi":
        regions = {
            region: (r >= low) & (r < high) for region, (low, high) in CTDI_REGIONS_MM.items()
        }
    first, rings = clean, []
    squares: list[list[list[float]]] = []
    for seed in seeds:
        noisy = np.stack(
            [slice_image(s.with_noise(exposure_s, seed), grid, kernel) for s in scans.values()]
        )
        first, error = (first if squares else noisy), noisy - clean
        squares.append([[float(e[mask].var()) for e in error] for mask in regions.values()])
        rings.append([radial_profile(e**2, grid, 155.0) for e in error])
    # Expected, of the darkest reading.
    quanta = {b: s.counts if s.quantum is None else s.counts / s.quantum for b, s in scans.items()}
    found: dict[str, object] = {
        "quanta_per_reading": {b: float(q.min()) * exposure_s for b, q in quanta.items()}
    }
    variances = np.array(squares)  # (realisations, regions, bowties)
    for k, (region, mask) in enumerate(regions.items()):
        sd, ratio = (
            np.sqrt(variances[:, k].mean(0)),
            np.sqrt(variances[:, k, 1] / variances[:, k, 0]),
        )
        found[region] = {
            "mean_hu": [float(c[mask].mean()) for c in clean],
            "sd_hu": sd.tolist(),
            "ratio": float(sd[1] / sd[0]),
            "ratio_error": float(ratio.std(ddof=1) / math.sqrt(len(ratio))),
        }
    if name == "ctdi":
        profile = np.mean(rings, axis=0)
        found["profile"] = {"radius_mm": profile[0, :, 0], "sd_hu": np.sqrt(profile[..., 1])}
    return found, first


# --- dose -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class DoseMaps:
    """Dose of one slice in mGy, one entry per bowtie of :data:`BOWTIES`.

    Attributes:
        grid: of the maps.
        labels: ``(y, x)`` index of the innermost body, −1 in air.
        doses: ``"unscattered"``: ``(2, y, x)`` in the plane of a thin slice; ``"with scatter"``,
            where there are histories: ``(2, y, x)`` by all photons in a contiguous scan of 100 mm.
    """

    grid: VolumeGrid
    labels: NDArray[np.int64]
    doses: dict[str, NDArray[np.float64]]


def dose_maps(
    scene: Scene,
    scanners: dict[str, Scanner],
    grid: VolumeGrid,
    exposure_s: float,
    histories: int,
    seed: int,
) -> DoseMaps:
    """Maps of both bowties; ``histories`` 0: unscattered photons only."""
    y, x = np.meshgrid(*grid.axes, indexing="ij")
    labels = scene.labels(np.stack([x, y, np.zeros_like(x)], axis=-1))
    doses = {"unscattered": [primary_dose(scene, scanners[b], grid, exposure_s) for b in BOWTIES]}
    if histories:
        runs = (
            monte_carlo_dose(scene, scanners[b], grid, exposure_s, histories=histories, seed=seed)
            for b in BOWTIES
        )
        doses["with scatter"] = [run.primary + run.scattered for run in runs]
    return DoseMaps(grid, labels, {k: np.stack(v) for k, v in doses.items()})


def region_ratio(maps: DoseMaps, scene: Scene, begins: tuple[str, ...]) -> dict[str, float]:
    """Mean dose with over without the ROI bowtie of the bodies whose names begin so, by kind of
    dose.

    Raises:
        ValueError: no voxel of the map lies in them.
    """
    inside = np.isin(maps.labels, [k for k, n in enumerate(scene.names) if n.startswith(begins)])
    if not inside.any():
        raise ValueError(
            "none of the map's voxels lies in these bodies: refine the grid or name others"
        )
    return {
        kind: float(dose[1][inside].mean() / dose[0][inside].mean())
        for kind, dose in maps.doses.items()
    }


def ratios(doses: dict[str, CtdiDose]) -> dict[str, float]:
    """With over without the ROI bowtie: peripheral, central, weighted."""
    large, roi = (doses[b] for b in BOWTIES)
    figures = {"peripheral": "total_peripheral", "central": "total_central", "weighted": "weighted"}
    return {name: getattr(roi, of) / getattr(large, of) for name, of in figures.items()}


def transmission(scanners: dict[str, Scanner]) -> dict[str, object]:
    """Share of the energy that each bowtie lets through, relative to no bowtie, and thickness,
    over the fan."""
    gamma = np.linspace(0.0, 0.32, 161)
    sod = scanners["large"].geometry.sod
    result: dict[str, object] = {
        "fan_angle_deg": np.degrees(gamma),
        "offset_at_isocentre_mm": sod * np.sin(gamma),
    }
    for name, scanner in scanners.items():
        spectrum = scanner.source.spectrum(scanner.energy_bin_kev)
        slab: Floats = sum(
            (m.attenuation(spectrum.energies) * t for m, t in scanner.filters), np.zeros(1)
        )
        energy = (
            spectrum.energies
            * spectrum.fluence
            * np.exp(-np.multiply.outer(1.0 / np.cos(gamma), slab))
        )
        passed = energy.copy()
        for bowtie in scanner.bowties:
            passed *= bowtie.transmission(gamma, spectrum.energies)
        result[name] = passed.sum(-1) / energy.sum(-1)
        result[f"{name} mm"] = np.sum([b.thickness(gamma) for b in scanner.bowties], axis=0)
    edge = 50.0
    return {**result, "roi_edge_mm": edge, "roi_edge_deg": math.degrees(math.asin(edge / sod))}


# --- MBIR and ROI bowtie --------------------------------------------------------------------------


def _combined(
    s: BowtieSettings, saved: dict[str, float], folder: Path | None, progress: Progress
) -> list[dict[str, object]]:
    """Scan, reconstruct, measure; ``saved``: kind of dose → factor that the ROI bowtie saves at
    equal exposure.

    Returns:
        JSON values of each exposure. Factors ``[value, low, high]`` in the paper's ROIs: of MBIR
        with either bowtie against FBP with the large one at equal exposure, and the second times
        the dose that the bowtie saves (``product_…``); FBP's own ratio, with over without the ROI
        bowtie; MBIR's contrast slope.
    """
    tasks, found = _evaluated(s, folder, progress)
    large, roi = (tasks[b].name for b in BOWTIES)

    def record(task: str, method: str, dose: float, figure: str) -> Any:
        wanted = {
            "task": task,
            "method": method,
            "exposure_s": dose,
            "figure": figure,
            "where": "small",
        }
        return next(
            (r for r in found.records if wanted.items() <= r.items()), dict.fromkeys(_KEYS, 0.0)
        )

    results: list[dict[str, object]] = []
    for dose in s.plaque_doses:
        slope = record(large, "mbir", dose, "slope")
        row: dict[str, object] = {
            "exposure_s": dose,
            "mbir_contrast_slope": [slope[k] for k in _KEYS],
        }
        for figure, (name, power, saving) in _RECORDS.items():
            with_roi, without = (
                record(task, "fbp:soft", dose, name)["value"] for task in (roi, large)
            )
            ratio = (with_roi / without) ** power
            factors = [
                [by * record(task, "mbir", dose, saving)[k] for k in _KEYS]
                for task, by in ((large, 1.0), (roi, ratio))
            ]
            row[figure] = {
                "fbp_ratio_roi_to_large": ratio,
                "mbir_factor_large_bowtie": factors[0],
                "mbir_factor_roi_bowtie": factors[1],
                **{
                    f"product_{kind}": [factor * v for v in factors[1]]
                    for kind, factor in saved.items()
                },
            }
        results.append(row)
    return results


def _evaluated(
    s: BowtieSettings, folder: Path | None, progress: Progress
) -> tuple[dict[str, Task], Evaluation]:
    """FBP and MBIR of the plaque behind either bowtie: the tasks by bowtie, and what they gave."""
    plaque = read_task("plaque")
    scanners = {b: presets.pcct(views=s.plaque_views, bowtie=b) for b in BOWTIES}
    tasks = {
        b: replace(plaque, name=f"plaque-behind-{b.replace('+', '-')}", scanner=scanner)
        for b, scanner in scanners.items()
    }
    found = evaluate(
        list(tasks.values()),
        ["fbp:soft", "mbir"],
        exposures_s=s.plaque_doses,
        n=s.plaque_realisations,
        seed=s.seed,
        folder=folder,
        progress=progress,
    )
    return tasks, found


# --- the report -----------------------------------------------------------------------------------


def checks(data: JsonObject) -> list[Check]:
    """Doses and noise with over without the ROI bowtie, and the dose saved together with MBIR,
    beside the paper's."""
    p, r, noise = paper.BOWTIE, data["ctdi_ratios"]["plane"], data["noise"]
    inferred = "the ramp's width, not published, was fitted to this ratio"
    same = "by construction: the open part and tube current × time are the same"
    ribs, skin = (
        100.0 * (1.0 - data["thorax_dose_ratio"][n]["unscattered"]) for n in ("side ribs", "skin")
    )
    inside, outside, heart = (
        noise["ctdi"]["inside"],
        noise["ctdi"]["outside"],
        noise["thorax"]["heart"],
    )
    found = [
        around(
            "CTDI phantom: peripheral dose, with / without", r["peripheral"], 0.48, 0.06, inferred
        ),
        around("CTDI phantom: central dose, with / without", r["central"], 0.96, 0.06),
        around("CTDI phantom: CTDIw, with / without", r["weighted"], 0.50, 0.06),
        Check("thorax: side ribs, % less dose", ribs, "> 45", 35.0),
        around("thorax: skin, % less dose", skin, p["skin_reduction_percent"], 10.0),
        around(
            "CTDI phantom: noise inside the ROI, with / without", inside["ratio"], 1.04, 0.05, same
        ),
        around("CTDI phantom: noise outside the ROI, with / without", outside["ratio"], 2.59, 0.4),
        around("thorax: noise in the heart, with / without", heart["ratio"], 1.02, 0.05, same),
    ]
    for c in data["combined"]:
        factors = c["contrast_variance"]
        note = (
            f"bowtie {1 / r['weighted']:.2f} × MBIR "
            f"{factors['mbir_factor_roi_bowtie'][0]:.2f}: the paper adds up 2 × 4"
        )
        if "product_total" in factors:
            note += f"; with scatter {factors['product_total'][0]:.2f}"
        name = f"dose saved by MBIR and ROI bowtie at {c['exposure_s']:g} s, contrast variance"
        found.append(
            Check(
                name,
                factors["product_plane"][0],
                p["total_dose_factor"],
                p["total_dose_factor"],
                note=note,
            )
        )
    return found


def _picture(
    ax: Axes, image: ArrayLike, grid: VolumeGrid, title: str, cmap: str, low: float, high: float
) -> None:
    (y, x), (h, w) = grid.center[-2:], grid.extent[-2:]
    extent = (x - w / 2, x + w / 2, y - h / 2, y + h / 2)
    shown = ax.imshow(
        image,
        origin="lower",
        extent=extent,
        cmap=cmap,
        vmin=low,
        vmax=high,
        interpolation="nearest",
    )
    phi = np.linspace(0.0, 2.0 * np.pi, 200)
    ax.plot(
        _ROI_RADIUS_MM * np.cos(phi),
        _ROI_RADIUS_MM * np.sin(phi),
        color="tab:orange",
        linewidth=0.8,
    )
    ax.set_title(title, fontsize=8)
    ax.set_xticks([])
    ax.set_yticks([])
    ax.figure.colorbar(shown, ax=ax, shrink=0.75, pad=0.01).ax.tick_params(labelsize=6)


def _curves(ax: Axes, title: str, label: str, x: ArrayLike, curves: dict[str, ArrayLike]) -> None:
    for bowtie, colour in _COLOURS.items():
        ax.plot(x, curves[bowtie], color=colour, label=bowtie)
    ax.axvline(_ROI_RADIUS_MM, color="grey", linewidth=0.7, linestyle=":")
    ax.set_xlabel(label, fontsize=7)
    ax.set_title(title, fontsize=8)
    ax.legend(fontsize=6)
    ax.tick_params(labelsize=6)


def figures(measured: Measured) -> dict[str, Figure]:
    """Bowties, dose maps and their ratios, noise with and without the ROI bowtie."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.5, 9.0), dpi=74, layout="constrained")
    axes = figure.subplots(3, 4)
    through = measured.data["transmission"]
    offset = through["offset_at_isocentre_mm"]
    label = "distance of the ray from the isocentre, mm"
    _curves(axes[0, 0], "energy let through; dashed: aluminium", label, offset, through)
    twin = axes[0, 0].twinx()
    for bowtie, colour in _COLOURS.items():
        twin.plot(offset, through[f"{bowtie} mm"], color=colour, linestyle="--", linewidth=0.8)
    twin.set_ylabel("mm", fontsize=7)
    twin.tick_params(labelsize=6)
    for row, (name, centre) in enumerate((("ctdi", 0.0), ("thorax", -100.0)), start=1):
        maps, images = (part[name] for part in measured.seen)
        unscattered, grid = maps.doses["unscattered"], phantom_grid(name, PIXEL_MM)
        body = maps.labels >= 0
        high = float(np.nanpercentile(unscattered[0][body], 95.0))
        dose = np.where(body, unscattered, np.nan)
        for k, bowtie in enumerate(BOWTIES):
            label = f"{name}, {bowtie}: dose, mGy"
            _picture(axes[row, k], dose[k], maps.grid, label, "inferno", 0.0, high)
            label = f"{name}, {bowtie}: image, HU"
            _picture(
                axes[row, 2 + k], images[k], grid, label, "gray", centre - 250.0, centre + 250.0
            )
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = unscattered[1] / unscattered[0]
        _picture(
            axes[0, row], ratio, maps.grid, f"{name}: dose with / without", "viridis", 0.3, 1.05
        )
    profile = measured.data["noise"]["ctdi"]["profile"]
    curves = dict(zip(BOWTIES, profile["sd_hu"], strict=True))
    _curves(axes[0, 3], "CTDI phantom: noise against radius", "mm", profile["radius_mm"], curves)
    axes[0, 3].set_ylabel("SD, HU", fontsize=7)
    axes[0, 3].set_ylim(bottom=0.0)
    title = (
        "Dose and noise with and without the ROI bowtie; orange circle: region of interest "
        "(unscattered dose)"
    )
    figure.suptitle(title, fontsize=10)
    return {"bowtie.png": figure}
