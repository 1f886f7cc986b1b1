"""Dose of the two bowties: CTDI phantom and thorax, unscattered and scattered photons."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from recon.study.bowtie.slice_scan import BOWTIES
from torchpcct.dose import CtdiDose, ctdi_dose, monte_carlo_dose, primary_dose
from torchpcct.geometry import VolumeGrid
from torchpcct.scanner.filters import large_bowtie, roi_bowtie

if TYPE_CHECKING:
    from torchpcct.scanner import Scanner
    from torchpcct.scene import Scene

__all__ = [
    "RAMPS_MM",
    "DoseMaps",
    "ctdi_figures",
    "dose_maps",
    "ramp_figures",
    "ratios",
    "region_ratio",
    "transmission",
]

Floats = NDArray[np.float64]

RAMPS_MM = (1.0, 7.5, 15.0, 22.5, 30.0)
"""Widths of the ROI bowtie's ramp, which is not published, for which the dose is given."""


@dataclass(frozen=True)
class DoseMaps:
    """Dose of one slice in mGy, one entry per bowtie of :data:`BOWTIES`.

    Attributes:
        grid: of the maps.
        labels: ``(y, x)`` index of the innermost body, −1 in air.
        primary: ``(2, y, x)`` by unscattered photons in the plane of a thin slice.
        scattered: ``(2, y, x)`` added by scattered photons in a contiguous scan of 100 mm, or None.
        contiguous: ``(2, y, x)`` by unscattered photons in the same scan, by the same Monte Carlo, or None.
    """

    grid: VolumeGrid
    labels: NDArray[np.int64]
    primary: Floats
    scattered: Floats | None
    contiguous: Floats | None

    @property
    def ratio(self) -> Floats:
        """``(y, x)`` unscattered dose with over without the ROI bowtie; NaN in air."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(self.primary[1] / self.primary[0])


def dose_maps(
    scene: Scene,
    scanners: dict[str, Scanner],
    grid: VolumeGrid,
    exposure_s: float,
    histories: int,
    seed: int,
    progress: Callable[[float], None],
) -> DoseMaps:
    """Maps of both bowties; ``histories`` 0: unscattered photons only."""
    y, x = np.meshgrid(*grid.axes, indexing="ij")
    labels = scene.labels(np.stack([x, y, np.zeros_like(x)], axis=-1))
    primary, scattered, contiguous = [], [], []
    for k, bowtie in enumerate(BOWTIES):
        primary.append(primary_dose(scene, scanners[bowtie], grid, exposure_s))
        if histories:
            result = monte_carlo_dose(scene, scanners[bowtie], grid, exposure_s, histories=histories, seed=seed)
            scattered.append(result.scattered)
            contiguous.append(result.primary)
        progress((k + 1) / len(BOWTIES))
    both = (np.stack(scattered), np.stack(contiguous)) if histories else (None, None)
    return DoseMaps(grid, labels, np.stack(primary), *both)


def region_ratio(maps: DoseMaps, scene: Scene, names: Any, *, scatter: bool = False) -> float:
    """Mean dose of bodies with the ROI bowtie over that without; bodies by name or by a test of the name."""
    chosen = [k for k, n in enumerate(scene.names) if (names(n) if callable(names) else n in names)]
    inside = np.isin(maps.labels, chosen)
    if not inside.any():
        raise ValueError("none of the map's voxels lies in these bodies: refine the grid or name others")
    dose = maps.primary
    if scatter:
        if maps.scattered is None or maps.contiguous is None:
            raise ValueError("these maps hold no scatter: make them with histories > 0")
        dose = maps.contiguous + maps.scattered
    return float(dose[1][inside].mean() / dose[0][inside].mean())


def ctdi_figures(
    scanners: dict[str, Scanner], exposure_s: float, histories: int, seed: int, progress: Callable[[float], None]
) -> dict[str, Any]:
    """Doses in the bores of the 32 cm phantom for both bowties, by three readings of "dose".

    Returns:
        ``"plane"``: unscattered, in the plane; ``"contiguous"``: unscattered part of CTDI100; ``"interacted"``: all
        energy of the first interaction; ``"total"``: with scatter (only with histories); each bowtie → CtdiDose.
    """
    doses: dict[str, dict[str, CtdiDose]] = {"plane": {}, "contiguous": {}, "interacted": {}}
    for k, (name, scanner) in enumerate(scanners.items()):
        doses["plane"][name] = ctdi_dose(scanner, exposure_s, axial="plane")
        doses["contiguous"][name] = ctdi_dose(scanner, exposure_s)
        doses["interacted"][name] = ctdi_dose(scanner, exposure_s, quantity="interacted")
        if histories:
            doses.setdefault("total", {})[name] = ctdi_dose(scanner, exposure_s, histories=histories, seed=seed)
        progress((k + 1) / len(scanners))
    return doses


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
    result: dict[str, Any] = {"fan_angle_deg": np.degrees(gamma)}
    result["offset_at_isocentre_mm"] = scanners["large"].geometry.sod * np.sin(gamma)
    for name, scanner in scanners.items():
        spectrum = scanner.source.spectrum(scanner.energy_bin_kev)
        slab: Any = sum((m.attenuation(spectrum.energies) * t for m, t in scanner.filters), np.zeros(1))
        energy = spectrum.energies * spectrum.fluence * np.exp(-np.multiply.outer(1.0 / np.cos(gamma), slab))
        passed = energy.copy()
        for bowtie in scanner.bowties:
            passed *= bowtie.transmission(gamma, spectrum.energies)
        result[name] = passed.sum(-1) / energy.sum(-1)
        result[f"{name} mm"] = np.sum([b.thickness(gamma) for b in scanner.bowties], axis=0)
    result["roi_edge_mm"] = 50.0
    result["roi_edge_deg"] = math.degrees(math.asin(50.0 / scanners["large"].geometry.sod))
    return result
