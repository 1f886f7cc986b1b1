"""Densities, mass fractions and CT numbers of the five materials."""

from __future__ import annotations

from typing import Any

import numpy as np

from recon.study.paper import facts as paper
from recon.study.phantom.recipes import PLAQUE_RECIPES, plaque_tissue
from torchpcct.scanner import presets
from torchpcct.scene.materials import MATERIALS
from torchpcct.scene.plaque import PATIENT_DIAMETER

__all__ = ["compositions", "ct_numbers"]


def compositions() -> list[dict[str, Any]]:
    """Per material: density, mass fractions, and their largest difference to the paper's table.

    ``from_molecules`` compares what follows from the molecular formulas and weights in the paper's text (None where it
    gives an element table alone): an independent way to the same numbers. The library's own fractions are the paper's
    table, normalised.
    """
    rows = []
    for name, (density, _, published) in paper.MATERIALS.items():
        ours = MATERIALS[name]
        found = dict(ours.mass_fractions)
        derived = dict(plaque_tissue(name).mass_fractions) if name in PLAQUE_RECIPES else None
        rows.append(
            {
                "material": name,
                "density_g_cm3": ours.density_g_cm3,
                "published_g_cm3": density,
                "fractions": found,
                "fraction_error": _largest(found, published),
                "from_molecules": None if derived is None else _largest(derived, published),
                "published_sum": sum(published.values()),
            }
        )
    return rows


def _largest(ours: dict[str, float], published: Any) -> float:
    return max(abs(ours.get(e, 0.0) - published.get(e, 0.0)) for e in {*ours, *published})


def ct_numbers(energies_kev: tuple[float, ...]) -> dict[str, dict[str, float]]:
    """Spectrum → material → HU against water.

    Monochromatic; then of the photons that leave the tube, of those behind the patient (the scanner's filters, the
    large bowtie's middle, 24 cm of fat), and of the signals that PCCT and EID-CT make of these.
    """
    spectra: dict[str, tuple[Any, Any]] = {f"{e:g} keV": (e, 1.0) for e in energies_kev}
    patient = {MATERIALS["pericoronary_fat"]: PATIENT_DIAMETER}
    pcct, eid = presets.pcct(), presets.eid()
    middle = pcct.geometry.columns // 2
    energies, photons = pcct.quanta()
    behind = MATERIALS["pericoronary_fat"].attenuation(energies) * PATIENT_DIAMETER
    spectra["100 kVp, filtered, in air"] = energies, photons[middle]
    spectra["100 kVp behind 24 cm fat"] = energies, photons[middle] * np.exp(-behind)
    spectra["the same, counted by the PCCT"] = energies, pcct.behind(patient)[0, middle]
    spectra["the same, integrated by the EID-CT"] = eid.weights()[0], eid.behind(patient)[0, eid.geometry.columns // 2]
    return {name: {m: MATERIALS[m].hu(*spectrum) for m in paper.MATERIALS} for name, spectrum in spectra.items()}
