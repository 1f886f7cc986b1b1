"""The plaque tissues from molecular formulas: dry mass of cholesterol, lipids, mineral and protein, plus water."""

from __future__ import annotations

from collections.abc import Mapping

import xraydb

from torchpcct.scene.materials import Material, formula_mass_fractions, mixture

__all__ = ["BASIS_FORMULAS", "PLAQUE_RECIPES", "elastin_formula", "plaque_tissue"]

# Amino acids of intimal elastin: abundance in per cent and formula (C, H, N, O) of the free acid.
_ELASTIN_RESIDUES: Mapping[str, tuple[float, Mapping[str, int]]] = {
    "glycine": (29.8, {"C": 2, "H": 5, "N": 1, "O": 2}),
    "alanine": (21.1, {"C": 3, "H": 7, "N": 1, "O": 2}),
    "valine": (13.1, {"C": 5, "H": 11, "N": 1, "O": 2}),
    "proline": (12.7, {"C": 5, "H": 9, "N": 1, "O": 2}),
    "leucine": (6.5, {"C": 6, "H": 13, "N": 1, "O": 2}),
}

BASIS_FORMULAS: Mapping[str, Mapping[str, float]] = {
    "CE": {"C": 45, "H": 76, "O": 2},  # cholesteryl linoleate
    "FC": {"C": 27, "H": 46, "O": 1},  # free cholesterol
    "TG": {"C": 55, "H": 98, "O": 6},  # mixed triglyceride
    "CS": {"H": 1, "Ca": 5, "O": 13, "P": 3},  # hydroxyapatite
    "collagen": {"C": 57, "H": 91, "N": 19, "O": 16},  # type I
    "elastin": {"C": 35.94, "H": 57.88, "N": 11.40, "O": 11.40},
    "water": {"H": 2, "O": 1},
}
"""Molecular formulas of the basis materials (Li et al., table of basis materials)."""

# Collagen to elastin in delipidised arterial tissue (DA), by weight.
_COLLAGEN, _ELASTIN = 26.0, 31.0
_IN_DA = {"collagen": _COLLAGEN / (_COLLAGEN + _ELASTIN), "elastin": _ELASTIN / (_COLLAGEN + _ELASTIN)}

PLAQUE_RECIPES: Mapping[str, tuple[float, float, Mapping[str, float]]] = {
    "vessel_wall": (1.074, 0.70, {"FC": 6, "TG": 30, "CS": 2, **{k: 62 * v for k, v in _IN_DA.items()}}),
    "fibrous_tissue": (1.113, 0.80, {"CE": 15, "FC": 30, "TG": 10, **{k: 45 * v for k, v in _IN_DA.items()}}),
    # The core is fibrous tissue with 10 % more collagen, 8 % more FC, 8 % more CE: sums to 126 %, normalised.
    "necrotic_core": (
        1.055,
        0.75,
        {"CE": 23, "FC": 38, "TG": 10, "collagen": 45 * _IN_DA["collagen"] + 10, "elastin": 45 * _IN_DA["elastin"]},
    ),
}
"""Tissue → density in g/cm³, water share of the total mass, dry-mass parts (any unit; normalised)."""


def elastin_formula() -> dict[str, float]:
    """Elastin as a mixture of five amino-acid *residues* (one water less each): atoms per 1000 units of residue weight.

    The published C35.94 H57.88 N11.40 O11.40 follows only if the abundances are read as per cent of residue *weight*
    (their sum, 83.2 %, is not re-normalised; only the ratios of the elements matter).
    """
    formula = {"C": 0.0, "H": 0.0, "N": 0.0, "O": 0.0}
    for abundance, free in _ELASTIN_RESIDUES.values():
        residue = {**free, "H": free["H"] - 2, "O": free["O"] - 1}
        moles = 10.0 * abundance / _molar_mass(residue)
        for element, atoms in residue.items():
            formula[element] += moles * atoms
    return formula


def _molar_mass(formula: Mapping[str, float]) -> float:
    return sum(count * float(xraydb.atomic_mass(element)) for element, count in formula.items())


def plaque_tissue(name: str) -> Material:
    """A plaque tissue derived from molecular formulas; agrees with the published element table to 1e-4.

    Args:
        name: ``"vessel_wall"``, ``"fibrous_tissue"`` or ``"necrotic_core"``.

    Raises:
        ValueError: another name.
    """
    if name not in PLAQUE_RECIPES:
        raise ValueError(f"no recipe for {name!r}: known are {', '.join(PLAQUE_RECIPES)}")
    density, water, dry = PLAQUE_RECIPES[name]
    total = sum(dry.values())
    shares = {basis: (1.0 - water) * part / total for basis, part in dry.items()} | {"water": water}
    parts = {Material(b, 1.0, formula_mass_fractions(BASIS_FORMULAS[b])): share for b, share in shares.items()}
    return mixture(name, density, parts)
