"""Efficiency of the detector by following photons: repeated counts, against the threshold and the energy."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.study.detector.rate import beam_behind, hu_shift
from torchpcct.scanner import SiliconDetector, presets
from torchpcct.scanner.silicon_transport import Stack, efficiency, follow
from torchpcct.scene.materials import material

__all__ = ["ENERGIES_KEV", "PUBLISHED_DQE", "Case", "at_energy", "cases", "efficiencies", "repeated_counts_hu"]

PUBLISHED_DQE = 0.68
PUBLISHED_SLOPE = 0.017
"""Density-imaging performance at a lowest threshold of 0 keV relative to an ideal detector, and its fall per keV, of an
edge-on silicon detector: Grönberg, Yin, Maltz, Pelc and Persson, "The effects of intra-detector Compton scatter on
zero-frequency DQE for photon-counting CT using edge-on-irradiated silicon detectors", arXiv 2206.04164 (2022)."""

THRESHOLDS_KEV = (0.0, 2.5, 5.0, 7.5, 10.0, 15.0)
ENERGIES_KEV = (20.0, 30.0, 40.0, 50.0, 60.0, 70.0, 80.0, 100.0, 120.0)


class Case(NamedTuple):
    """A detector in a beam: photons per energy in keV."""

    name: str
    detector: SiliconDetector
    stack: Stack
    energies: NDArray[np.float64]
    photons: NDArray[np.float64]


def cases() -> list[Case]:
    """The detectors and beams that are compared, from this package's defaults to the published figure's."""
    standard, hard = beam_behind(presets.pcct()), beam_behind(presets.pcct(kvp=120.0), "water", 300.0)
    deep, short = SiliconDetector(), SiliconDetector(length_mm=30.0)
    return [
        Case("60 mm, 100 kVp, 24 cm fat", deep, Stack(), *standard),
        Case("60 mm, foils of 10 µm", deep, Stack(foil_mm=0.01), *standard),
        Case("60 mm, no foils", deep, Stack(foil_mm=0.0), *standard),
        Case("30 mm, 100 kVp, 24 cm fat", short, Stack(), *standard),
        Case("60 mm, 120 kVp, 30 cm water", deep, Stack(), *hard),
        Case("30 mm, 120 kVp, 30 cm water", short, Stack(), *hard),
    ]


def efficiencies(case: Case, photons: int, rng: np.random.Generator) -> dict[str, Any]:
    """One-interaction share, and DQE of counts by following photons, against the lowest threshold."""
    d = replace(case.detector, fill_factor=1.0 - case.stack.foil_mm / case.stack.sheet_pitch_mm)
    single = d.above(case.energies, THRESHOLDS_KEV) @ case.photons / case.photons.sum()
    deposits = follow(d, case.energies, case.photons, photons, rng, case.stack)
    task = material("water").attenuation(deposits.incident_kev)
    rows = []
    for threshold, share in zip(THRESHOLDS_KEV, single, strict=True):
        k = deposits.counts(threshold, d.sigma_kev, rng)
        dqe, error = efficiency(k)
        density, density_error = efficiency(k, task)
        rows.append(
            {
                "threshold_kev": threshold,
                "one_interaction": float(share),
                "counts_per_photon": float(k.mean()),
                "dqe": dqe,
                "dqe_error": error,
                "density": density,
                "density_error": density_error,
                "published": PUBLISHED_DQE - PUBLISHED_SLOPE * threshold,
            }
        )
    return {"case": case.name, "rows": rows}


def at_energy(energy: float, photons: int, rng: np.random.Generator) -> dict[str, Any]:
    """The same of photons of one energy in keV, at the detector's own threshold."""
    d = SiliconDetector()
    k = follow(d, [energy], [1.0], photons, rng).counts(d.thresholds_kev[0], d.sigma_kev, rng)
    dqe, error = efficiency(k)
    photo, compton = d.interaction([energy])
    return {
        "energy_kev": energy,
        "photoelectric": float(photo[0]),
        "compton": float(compton[0]),
        "one_interaction": float(d.response([energy])[0, 0]),
        "counts_per_photon": float(k.mean()),
        "dqe": dqe,
        "dqe_error": error,
    }


def repeated_counts_hu(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Shifts of the plaque's CT numbers by the weight that repeated counts, see :func:`at_energy`, give to energies."""
    energies, beam = beam_behind(presets.pcct())
    weight = SiliconDetector().response(energies)[0] * beam
    ratio = [r["counts_per_photon"] / r["one_interaction"] for r in rows]
    return hu_shift(energies, weight, weight * np.interp(energies, [r["energy_kev"] for r in rows], ratio))
