"""The built-in materials: composition tables, and the derivation of the plaque tissues from molecular formulas.

The plaque tissues carry the *published* element table of Li et al. (rounded to 1e-4). :func:`plaque_tissue` derives the
same numbers from their recipe: dry mass of cholesterol, lipids, mineral and protein, plus water.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

from torchpcct.scene.materials import Material, compound, formula_mass_fractions, mixture

__all__ = ["BASIS_FORMULAS", "FACTORIES", "PLAQUE_RECIPES", "elastin_formula", "plaque_tissue"]

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
    import xraydb

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


# name → (density g/cm³, mass fractions)
_TABLES: Mapping[str, tuple[float, Mapping[str, float]]] = {
    # Plaque scene, Li et al.; blood with 1 % iodine sums to 1.0002 and is normalised.
    "vessel_wall": (1.074, dict(H=0.1040, C=0.1818, N=0.0368, O=0.6739, P=0.0011, Ca=0.0024)),
    "fibrous_tissue": (1.113, dict(H=0.1089, C=0.1378, N=0.0178, O=0.7355)),
    "necrotic_core": (1.055, dict(H=0.1083, C=0.1737, N=0.0217, O=0.6963)),
    "blood_iodine": (
        1.060,
        dict(H=0.1010, C=0.1089, N=0.0327, O=0.7376, Na=0.001, P=0.001, S=0.002, Cl=0.003, K=0.002, Fe=0.001, I=0.0100),
    ),
    "pericoronary_fat": (0.950, dict(H=0.114, C=0.598, N=0.007, O=0.278, Na=0.001, S=0.001, Cl=0.001)),
    # Body tissues, ICRU Report 44; lung is given at its inflated density. Heart and spongiosa: Woodard and White 1986.
    "adipose": (0.950, dict(H=0.114, C=0.598, N=0.007, O=0.278, Na=0.001, S=0.001, Cl=0.001)),
    "blood": (
        1.060,
        dict(H=0.102, C=0.110, N=0.033, O=0.745, Na=0.001, P=0.001, S=0.002, Cl=0.003, K=0.002, Fe=0.001),
    ),
    "heart": (
        1.060,
        dict(H=0.103, C=0.121, N=0.032, O=0.734, Na=0.001, P=0.001, S=0.002, Cl=0.003, K=0.002, Fe=0.001),
    ),
    "lung": (0.260, dict(H=0.103, C=0.105, N=0.031, O=0.749, Na=0.002, P=0.002, S=0.003, Cl=0.003, K=0.002)),
    "skeletal_muscle": (
        1.050,
        dict(H=0.102, C=0.143, N=0.034, O=0.710, Na=0.001, P=0.002, S=0.003, Cl=0.001, K=0.004),
    ),
    "soft_tissue": (1.060, dict(H=0.102, C=0.143, N=0.034, O=0.708, Na=0.002, P=0.003, S=0.003, Cl=0.002, K=0.003)),
    "skin": (1.090, dict(H=0.100, C=0.204, N=0.042, O=0.645, Na=0.002, P=0.001, S=0.002, Cl=0.003, K=0.001)),
    "cortical_bone": (
        1.920,
        dict(H=0.034, C=0.155, N=0.042, O=0.435, Na=0.001, Mg=0.002, P=0.103, S=0.003, Ca=0.225),
    ),
    "spongiosa": (
        1.180,
        dict(
            H=0.085,
            C=0.404,
            N=0.028,
            O=0.367,
            Na=0.001,
            Mg=0.001,
            P=0.034,
            S=0.002,
            Cl=0.002,
            K=0.001,
            Ca=0.074,
            Fe=0.001,
        ),
    ),
    "air": (0.001205, dict(C=0.000124, N=0.755268, O=0.231781, Ar=0.012827)),  # dry, 20 °C, NIST
    # Elements.
    "aluminium": (2.699, {"Al": 1.0}),
    "silicon": (2.330, {"Si": 1.0}),
    "titanium": (4.540, {"Ti": 1.0}),
    "copper": (8.960, {"Cu": 1.0}),
    "graphite": (1.700, {"C": 1.0}),
    "molybdenum": (10.22, {"Mo": 1.0}),
    "tungsten": (19.30, {"W": 1.0}),
    "iodine": (4.930, {"I": 1.0}),
    # Alloys by nominal composition.
    "stainless_steel": (8.00, dict(Fe=0.655, Cr=0.17, Ni=0.12, Mo=0.025, Mn=0.02, Si=0.01)),  # 316L
    "cobalt_chromium": (9.10, dict(Co=0.53, Cr=0.20, W=0.15, Ni=0.10, Mn=0.015, Fe=0.005)),  # L605
    "nitinol": (6.45, dict(Ni=0.56, Ti=0.44)),
    # Lumex-like ceramic garnet scintillator Y1.34 Gd0.60 Eu0.06 O3 (Duclos et al. 2003).
    "lumex": (5.950, dict(O=0.177377, Y=0.440259, Eu=0.033695, Gd=0.348670)),
}

# name → (density g/cm³, atoms per molecule)
_FORMULAS: Mapping[str, tuple[float, Mapping[str, float]]] = {
    "water": (1.000, {"H": 2, "O": 1}),
    "pmma": (1.190, {"C": 5, "H": 8, "O": 2}),
    "polyethylene": (0.930, {"C": 2, "H": 4}),
    "pvc": (1.370, {"C": 2, "H": 3, "Cl": 1}),
    "hydroxyapatite": (3.160, {"H": 1, "Ca": 5, "O": 13, "P": 3}),
    "gos": (7.340, {"Gd": 2, "O": 2, "S": 1}),  # gadolinium oxysulphide
}

FACTORIES: Mapping[str, Callable[[], Material]] = {
    **{name: partial(Material, name, density, dict(parts)) for name, (density, parts) in _TABLES.items()},
    **{name: partial(compound, name, density, dict(formula)) for name, (density, formula) in _FORMULAS.items()},
}
"""Name → function that builds the material."""
