"""Scans of one slice with the whole detector, with and without the ROI bowtie: noise, images, residual cupping.

The paper's dose study is two-dimensional and uses an energy-integrating detector without electronic noise behind the
PCCT's tube and bowties. Here its cells are those of the paper's EID-CT, on an arc wide enough for the phantoms (the
PCCT's own field of view of 296 mm is not).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.analytic.fbp import fbp
from recon.study.bowtie.settings import DETECTORS
from torchpcct.acquisition.acquire import acquire
from torchpcct.geometry import VolumeGrid
from torchpcct.scan import Scan
from torchpcct.scanner import Scanner, Scintillator, presets
from torchpcct.scanner.linearisation import WaterLinearisation
from torchpcct.scene import Body, EllipticCylinder, Scene
from torchpcct.scene.materials import MATERIALS
from torchpcct.scene.phantoms.quality import ctdi, water_cylinder
from torchpcct.scene.phantoms.thorax import thorax
from torchpcct.validate import choice
from torchpcct.volume import to_hu

__all__ = [
    "BOWTIES",
    "Images",
    "cupping",
    "enlarged",
    "noise",
    "noise_regions",
    "phantom_grid",
    "phantoms",
    "polynomial_linearisation",
    "radial_profile",
    "slice_image",
    "slice_scans",
    "wide_scanners",
]

Floats = NDArray[np.float64]

BOWTIES = ("large", "large+roi")

HALF_FAN_RAD = 0.32
"""Half-angle of the fan: holds the thorax with the heart at the isocentre (radius 190 mm)."""

CALIBRATION_ORDER, CALIBRATION_STEP_MM, CALIBRATION_MAX_MM = 5, 10.0, 380.0
"""Beam-hardening correction as published: 5th order, 10 mm steps of water up to 380 mm."""

PIXEL_MM = 0.78
"""Voxels of the paper's images."""

CTDI_REGIONS_MM = {"inside": (10.0, 40.0), "outside": (85.0, 115.0)}
"""Rings (inner, outer radius) of the CTDI phantom whose noise is compared; clear of bores and of the ROI's edge."""

HEART_DISC_MM = 8.0
"""Radius of the disc of heart muscle at the isocentre whose noise is compared."""

_THORAX_CENTER = (-34.0, -14.0)


def wide_scanners(views: int, detector: str = "eid", half_fan_rad: float = HALF_FAN_RAD) -> dict[str, Scanner]:
    """The paper's scanner of the dose study, one detector row, with each of :data:`BOWTIES`.

    Args:
        views: per rotation.
        half_fan_rad: half-angle of the fan.
        detector: ``"eid"``: energy-integrating cells of 1.02 × 1.10 mm without electronic noise; ``"silicon"``: the
            PCCT's counting cells of 0.35 × 0.5 mm.

    Raises:
        ValueError: another detector.
    """
    choice("detector", detector, DETECTORS)
    integrating = detector == "eid"
    scanners = {b: presets.pcct(views=views, bowtie=b, rows=1) for b in BOWTIES}
    pitch = presets.EID_PITCH_MM if integrating else presets.PCCT_PITCH_MM
    geometry = scanners["large"].geometry
    columns = 2 * math.ceil(half_fan_rad * geometry.sdd / pitch[1])
    changes: dict[str, Any] = {"geometry": replace(geometry, columns=columns, pitch=pitch)}
    if integrating:
        changes["detector"] = Scintillator(electronic_noise_kev=0.0)
    return {b: s.replace(**changes) for b, s in scanners.items()}


def slice_scans(scene: Scene, scanners: dict[str, Scanner]) -> dict[str, Scan]:
    """Noise-free scans of the slice z = 0 with the paper's beam-hardening correction.

    Each reading is that of its central ray; smooth bodies need no finite beam at the voxels of this study. Readings of
    equal expectation carry equal noise in the scans of all bowties.
    """
    return {
        b: replace(acquire(scene, s, sub_rays=1), linearisation=polynomial_linearisation(s))
        for b, s in scanners.items()
    }


def polynomial_linearisation(
    scanner: Scanner,
    order: int = CALIBRATION_ORDER,
    step_mm: float = CALIBRATION_STEP_MM,
    max_mm: float = CALIBRATION_MAX_MM,
) -> WaterLinearisation:
    """The paper's beam-hardening correction: per column a polynomial through 0, fitted to equal steps of water.

    The value of water is that of the library's own correction, so that images of both compare.

    Args:
        scanner: of one energy bin.
        order: of the polynomial.
        step_mm, max_mm: calibration thicknesses.

    Raises:
        ValueError: fewer thicknesses than coefficients.
    """
    thickness = np.arange(step_mm, max_mm + 0.5 * step_mm, step_mm)
    if thickness.size < order:
        raise ValueError(f"{thickness.size} thicknesses do not determine {order} coefficients: take smaller steps")
    energies, weights = scanner.weights()
    mu_water = MATERIALS["water"].attenuation(energies)
    transmitted = weights[0] @ np.exp(-np.outer(mu_water, thickness))
    p = np.log(weights[0].sum(-1))[:, None] - np.log(transmitted)
    middle = weights.shape[1] // 2
    mu_ref = WaterLinearisation.calibrate(weights[0, middle : middle + 1], mu_water).mu_ref
    scale = p[:, -1]
    powers = (p / scale[:, None])[..., None] ** np.arange(1, order + 1)
    fits = [np.linalg.lstsq(a, mu_ref * thickness / s, rcond=None)[0] for a, s in zip(powers, scale, strict=True)]
    return WaterLinearisation(np.stack(fits), scale, mu_ref)


def slice_image(scan: Scan, grid: VolumeGrid, kernel: str) -> Floats:
    """FBP of a slice in HU, ``grid.shape`` float64."""
    image = fbp(scan.line_integrals()[:, 0], scan.geometry.central_fan, grid, kernel)
    return np.asarray(to_hu(image, scan.linearisation.mu_ref).numpy(), dtype=np.float64)


def _radius(grid: VolumeGrid) -> Floats:
    y, x = np.meshgrid(*grid.axes, indexing="ij")
    return np.asarray(np.hypot(x, y))


def radial_profile(image: Any, grid: VolumeGrid, radius: float, step_mm: float = 5.0) -> Floats:
    """Means over rings of ``step_mm`` about the isocentre out to ``radius``, ``(rings, 2)`` of radius and mean."""
    ring = (_radius(grid) / step_mm).astype(np.int64).ravel()
    count = int(radius / step_mm)
    total = np.bincount(ring, np.asarray(image, np.float64).ravel())[:count]
    return np.stack([(np.arange(count) + 0.5) * step_mm, total / np.bincount(ring)[:count]], axis=1)


def phantoms() -> dict[str, Scene]:
    """The CTDI phantom and the thorax."""
    return {"ctdi": ctdi(), "thorax": thorax()}


def enlarged(scene: Scene, factor: float) -> Scene:
    """A scene of elliptic cylinders with all lengths across the axis, and places, times ``factor``."""

    def larger(body: Body) -> Body:
        assert isinstance(body.shape, EllipticCylinder)
        x, y, z = body.shape.position
        axes = tuple(factor * a for a in body.shape.semi_axes)
        return replace(body, shape=replace(body.shape, semi_axes=axes, position=(factor * x, factor * y, z)))

    return Scene([larger(scene[name]) for name in scene.names])


def phantom_grid(name: str, spacing: float) -> VolumeGrid:
    """Square voxels that hold the phantom with a rim of air."""
    extent, center = ((340.0, 340.0), (0.0, 0.0)) if name == "ctdi" else ((252.0, 356.0), _THORAX_CENTER)
    return VolumeGrid(tuple(math.ceil(e / spacing) for e in extent), spacing, center)


def noise_regions(name: str, grid: VolumeGrid) -> dict[str, Any]:
    """Where the noise of a phantom of :func:`phantoms` is measured: region → mask."""
    r = _radius(grid)
    if name == "ctdi":
        return {region: (r >= low) & (r < high) for region, (low, high) in CTDI_REGIONS_MM.items()}
    return {"heart": r < HEART_DISC_MM}


@dataclass(frozen=True)
class Images:
    """Images of one slice with both bowties, HU: ``clean`` and one ``noisy`` realisation, ``(2, y, x)``."""

    grid: VolumeGrid
    clean: Floats
    noisy: Floats


def noise(
    name: str, scene: Scene, scanners: dict[str, Scanner], exposure_s: float, kernel: str, seeds: range
) -> tuple[dict[str, Any], Images]:
    """Mean and noise of a phantom's regions with both bowties.

    Args:
        name, scene: one of :func:`phantoms`.
        scanners: of :func:`wide_scanners`.
        exposure_s: of the scans.
        kernel: of FBP.
        seeds: of the noise, one realisation each.

    Returns:
        JSON values by region (and of the CTDI phantom the noise against the radius), and images of the first
        realisation.
    """
    scans, grid = slice_scans(scene, scanners), phantom_grid(name, PIXEL_MM)
    clean = np.stack([slice_image(scan, grid, kernel) for scan in scans.values()])
    regions = noise_regions(name, grid)
    first, rings = clean, []
    squares: list[list[list[float]]] = []
    for seed in seeds:
        noisy = np.stack([slice_image(s.with_noise(exposure_s, seed), grid, kernel) for s in scans.values()])
        first, error = (first if squares else noisy), noisy - clean
        squares.append([[float(e[mask].var()) for e in error] for mask in regions.values()])
        rings.append([radial_profile(e**2, grid, 155.0) for e in error])
    found: dict[str, Any] = {"quanta_per_reading": {b: _fewest_quanta(s, exposure_s) for b, s in scans.items()}}
    variances = np.array(squares)  # (realisations, regions, bowties)
    for k, (region, mask) in enumerate(regions.items()):
        sd, ratio = np.sqrt(variances[:, k].mean(0)), np.sqrt(variances[:, k, 1] / variances[:, k, 0])
        found[region] = {
            "mean_hu": [float(c[mask].mean()) for c in clean],
            "sd_hu": sd.tolist(),
            "ratio": float(sd[1] / sd[0]),
            "ratio_error": float(ratio.std(ddof=1) / math.sqrt(len(ratio))),
        }
    if name == "ctdi":
        profile = np.mean(rings, axis=0)
        found["profile"] = {"radius_mm": profile[0, :, 0], "sd_hu": np.sqrt(profile[..., 1])}
    return found, Images(grid, clean, first)


def _fewest_quanta(scan: Scan, exposure_s: float) -> float:
    """Expected quanta of the darkest reading."""
    quanta = scan.counts if scan.quantum is None else scan.counts / scan.quantum
    return float(quanta.min()) * exposure_s


def cupping(scanners: dict[str, Scanner], kernel: str) -> dict[str, float]:
    """Largest difference between ring means of a water cylinder of 32 cm, 5 mm rings out to 95 % of its radius."""
    radius, grid = 160.0, phantom_grid("ctdi", 2 * PIXEL_MM)
    scans = slice_scans(water_cylinder(2 * radius), scanners)
    images = {b: slice_image(scan, grid, kernel) for b, scan in scans.items()}
    return {b: float(np.ptp(radial_profile(image, grid, 0.95 * radius)[:, 1])) for b, image in images.items()}
