"""Dose of the two bowties: CTDI phantom, thorax and patient, unscattered and scattered photons."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.study.bowtie.slices import BOWTIES
from torchpcct.dose import CtdiDose, ctdi_dose, monte_carlo_dose, primary_dose
from torchpcct.geometry import VolumeGrid
from torchpcct.scanner import Scanner
from torchpcct.scanner.filters import large_bowtie, roi_bowtie
from torchpcct.scene import Scene
from torchpcct.scene.phantoms.quality import water_cylinder

__all__ = [
    "DoseMaps",
    "ctdi_figures",
    "dose_maps",
    "patient_ratio",
    "ramp_figures",
    "ratios",
    "region_ratio",
    "thorax_ratios",
    "transmission",
]

RAMPS_MM = (1.0, 7.5, 15.0, 22.5, 30.0)
"""Widths of the ROI bowtie's ramp, which is not published, for which the dose is given."""

_SIDES = tuple(f"rib_{side}_{k}" for side in ("left", "right") for k in (1, 2, 3))
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


@dataclass(frozen=True)
class DoseMaps:
    """Dose of one slice in mGy, one entry per bowtie of :data:`BOWTIES`.

    Attributes:
        grid: of the maps.
        labels: ``(y, x)`` index of the innermost body, −1 in air.
        doses: ``"unscattered"``: ``(2, y, x)`` in the plane of a thin slice; ``"with scatter"``, where there are
            histories: ``(2, y, x)`` by all photons in a contiguous scan of 100 mm.
    """

    grid: VolumeGrid
    labels: NDArray[np.int64]
    doses: dict[str, NDArray[np.float64]]


def dose_maps(
    scene: Scene, scanners: dict[str, Scanner], grid: VolumeGrid, exposure_s: float, histories: int, seed: int
) -> DoseMaps:
    """Maps of both bowties; ``histories`` 0: unscattered photons only."""
    y, x = np.meshgrid(*grid.axes, indexing="ij")
    labels = scene.labels(np.stack([x, y, np.zeros_like(x)], axis=-1))
    doses = {"unscattered": [primary_dose(scene, scanners[b], grid, exposure_s) for b in BOWTIES]}
    if histories:
        runs = (monte_carlo_dose(scene, scanners[b], grid, exposure_s, histories=histories, seed=seed) for b in BOWTIES)
        doses["with scatter"] = [run.primary + run.scattered for run in runs]
    return DoseMaps(grid, labels, {k: np.stack(v) for k, v in doses.items()})


def region_ratio(maps: DoseMaps, scene: Scene, begins: tuple[str, ...]) -> dict[str, float]:
    """Mean dose with over without the ROI bowtie of the bodies whose names begin so, by kind of dose.

    Raises:
        ValueError: no voxel of the map lies in them.
    """
    inside = np.isin(maps.labels, [k for k, n in enumerate(scene.names) if n.startswith(begins)])
    if not inside.any():
        raise ValueError("none of the map's voxels lies in these bodies: refine the grid or name others")
    return {kind: float(dose[1][inside].mean() / dose[0][inside].mean()) for kind, dose in maps.doses.items()}


def thorax_ratios(maps: DoseMaps, scene: Scene) -> dict[str, dict[str, float]]:
    """:func:`region_ratio` of every tissue of the thorax."""
    return {tissue: region_ratio(maps, scene, begins) for tissue, begins in TISSUES.items()}


def patient_ratio(scanners: dict[str, Scanner], exposure_s: float, histories: int, seed: int) -> dict[str, float]:
    """Mean dose with over without the ROI bowtie of the plaque's own patient, 24 cm of fat."""
    fat = water_cylinder(240.0, material="pericoronary_fat")
    maps = dose_maps(fat, scanners, VolumeGrid((64, 64), 4.0), exposure_s, histories, seed)
    return {kind: float(dose[1].sum() / dose[0].sum()) for kind, dose in maps.doses.items()}


def ctdi_figures(
    scanners: dict[str, Scanner], exposure_s: float, histories: int, seed: int
) -> dict[str, dict[str, CtdiDose]]:
    """Doses in the bores of the 32 cm phantom for both bowties, by four readings of "dose".

    Returns:
        ``"plane"``: unscattered, in the plane; ``"contiguous"``: unscattered part of CTDI100; ``"interacted"``: all
        energy of the first interaction; ``"total"``: with scatter (only with histories); each bowtie → dose.
    """
    asked: dict[str, dict[str, Any]] = {
        "plane": {"axial": "plane"}, "contiguous": {}, "interacted": {"quantity": "interacted"},
    }  # fmt: skip
    if histories:
        asked["total"] = {"histories": histories, "seed": seed}
    return {
        kind: {b: ctdi_dose(scanner, exposure_s, **how) for b, scanner in scanners.items()}
        for kind, how in asked.items()
    }


def ratios(doses: dict[str, CtdiDose]) -> dict[str, float]:
    """With over without the ROI bowtie: peripheral, central, weighted."""
    large, roi = (doses[b] for b in BOWTIES)
    return {
        "peripheral": roi.total_peripheral / large.total_peripheral,
        "central": roi.total_central / large.total_central,
        "weighted": roi.weighted / large.weighted,
    }


def ramp_figures(scanners: dict[str, Scanner], exposure_s: float) -> list[dict[str, float]]:
    """Ratios of the unscattered dose in the plane for several widths of the ROI bowtie's ramp."""
    large = scanners["large"]
    reference = ctdi_dose(large, exposure_s, axial="plane")
    rows = []
    for ramp in RAMPS_MM:
        bowties = (large_bowtie(), roi_bowtie(large.geometry.sod, ramp_mm=ramp))
        dose = ctdi_dose(large.replace(bowties=bowties), exposure_s, axial="plane")
        rows.append({"ramp_mm": ramp, **ratios(dict(zip(BOWTIES, (reference, dose), strict=True)))})
    return rows


def transmission(scanners: dict[str, Scanner]) -> dict[str, Any]:
    """Share of the energy that each bowtie lets through, relative to no bowtie, and thickness, over the fan."""
    gamma = np.linspace(0.0, 0.32, 161)
    sod = scanners["large"].geometry.sod
    result: dict[str, Any] = {"fan_angle_deg": np.degrees(gamma), "offset_at_isocentre_mm": sod * np.sin(gamma)}
    for name, scanner in scanners.items():
        spectrum = scanner.source.spectrum(scanner.energy_bin_kev)
        slab: Any = sum((m.attenuation(spectrum.energies) * t for m, t in scanner.filters), np.zeros(1))
        energy = spectrum.energies * spectrum.fluence * np.exp(-np.multiply.outer(1.0 / np.cos(gamma), slab))
        passed = energy.copy()
        for bowtie in scanner.bowties:
            passed *= bowtie.transmission(gamma, spectrum.energies)
        result[name] = passed.sum(-1) / energy.sum(-1)
        result[f"{name} mm"] = np.sum([b.thickness(gamma) for b in scanner.bowties], axis=0)
    edge = 50.0
    return {**result, "roi_edge_mm": edge, "roi_edge_deg": math.degrees(math.asin(edge / sod))}
