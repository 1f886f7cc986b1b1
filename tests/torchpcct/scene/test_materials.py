"""Materials: published compositions, the molecular derivation, attenuation, CT numbers, mixing,
validation."""

import copy
import pickle

import numpy as np
import pytest
import xraydb
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refusals

from torchpcct.scene.materials import (
    MATERIALS,
    PLAQUE_MATERIALS,
    Material,
    blend,
    calcification,
    compound,
    formula_mass_fractions,
    material,
    mixture,
    solution,
)

BASIS = {
    "CE": {"C": 45, "H": 76, "O": 2},  # cholesteryl linoleate
    "FC": {"C": 27, "H": 46, "O": 1},  # free cholesterol
    "TG": {"C": 55, "H": 98, "O": 6},  # mixed triglyceride
    "CS": {"H": 1, "Ca": 5, "O": 13, "P": 3},  # hydroxyapatite
    "collagen": {"C": 57, "H": 91, "N": 19, "O": 16},  # type I
    "elastin": {"C": 35.94, "H": 57.88, "N": 11.40, "O": 11.40},
}
"""Molecular formulas of the basis materials (Li et al., table of basis materials)."""
# Collagen to elastin in delipidised arterial tissue, by weight.
IN_DA = {"collagen": 26 / 57, "elastin": 31 / 57}
RECIPES = {
    "vessel_wall": (0.70, {"FC": 6, "TG": 30, "CS": 2, **{k: 62 * v for k, v in IN_DA.items()}}),
    "fibrous_tissue": (
        0.80,
        {"CE": 15, "FC": 30, "TG": 10, **{k: 45 * v for k, v in IN_DA.items()}},
    ),
    # The core is fibrous tissue with 10 % more collagen, 8 % more FC, 8 % more CE: sums to 126 %,
    # normalised.
    "necrotic_core": (
        0.75,
        {
            "CE": 23,
            "FC": 38,
            "TG": 10,
            "collagen": 45 * IN_DA["collagen"] + 10,
            "elastin": 45 * IN_DA["elastin"],
        },
    ),
}
"""Tissue: water's share of the mass, parts of the dry mass (any unit; normalised)."""
RESIDUES = {
    "glycine": (29.8, {"C": 2, "H": 5, "N": 1, "O": 2}),
    "alanine": (21.1, {"C": 3, "H": 7, "N": 1, "O": 2}),
    "valine": (13.1, {"C": 5, "H": 11, "N": 1, "O": 2}),
    "proline": (12.7, {"C": 5, "H": 9, "N": 1, "O": 2}),
    "leucine": (6.5, {"C": 6, "H": 13, "N": 1, "O": 2}),
}
"""Amino acids of intimal elastin: per cent of the weight of residues (one water less each); the
free acids."""


@pytest.mark.parametrize("name", RECIPES)
def test_the_molecular_recipe_gives_the_published_element_table(name):
    water, dry = RECIPES[name]
    shares = {k: (1 - water) * part / sum(dry.values()) for k, part in dry.items()}
    parts = {
        Material(k, 1.0, formula_mass_fractions(BASIS[k])): share for k, share in shares.items()
    }
    derived, published = mixture(name, 1.0, {**parts, material("water"): water}), material(name)
    assert dict(derived.mass_fractions) == pytest.approx(dict(published.mass_fractions), abs=1e-4)


def test_elastin_residues_give_the_published_formula():
    """Atoms per 1000 units of residue weight; the sum of the abundances, 83.2 %, is not
    normalised."""
    formula = dict.fromkeys("CHNO", 0.0)
    for abundance, free in RESIDUES.values():
        residue = {**free, "H": free["H"] - 2, "O": free["O"] - 1}
        weight = sum(n * float(xraydb.atomic_mass(element)) for element, n in residue.items())
        for element, atoms in residue.items():
            formula[element] += 10 * abundance / weight * atoms
    assert formula == pytest.approx(BASIS["elastin"], abs=0.012)


def test_water_fractions_are_those_of_h2o():
    fractions = material("water").mass_fractions
    assert fractions["H"] == pytest.approx(0.111894, abs=2e-5)
    assert fractions["O"] == pytest.approx(0.888106, abs=2e-5)


def test_attenuation_is_the_mass_weighted_sum_of_the_elam_total_cross_sections():
    energies = np.array([[20.0, 33.0, 34.0], [60.0, 80.0, 100.0]])
    for name in ("blood_iodine", "water", "cortical_bone"):
        m = material(name)
        expected = sum(
            fraction * xraydb.mu_elam(element, energies.ravel() * 1e3)
            for element, fraction in m.mass_fractions.items()
        )
        expected = expected.reshape(2, 3) * m.density_g_cm3 / 10
        np.testing.assert_allclose(m.attenuation(energies), expected, rtol=1e-13)
        assert m.attenuation(energies).dtype == np.float64


def test_water_attenuation_against_nist_xcom():
    # NIST X-ray mass attenuation coefficients of liquid water, cm²/g, coherent scatter included.
    nist = {30.0: 0.3756, 40.0: 0.2683, 50.0: 0.2269, 60.0: 0.2059, 80.0: 0.1837, 100.0: 0.1707}
    ours = material("water").attenuation(list(nist)) * 10
    np.testing.assert_allclose(ours, list(nist.values()), rtol=0.01)


def test_the_kinds_of_interaction_add_up_to_the_total():
    energies = np.linspace(15, 120, 36)
    m = material("blood_iodine")
    parts = sum(m.attenuation(energies, kind) for kind in ("photo", "incoh", "coh"))
    np.testing.assert_allclose(parts, m.attenuation(energies), rtol=1e-12)


def test_water_reads_zero_and_air_minus_1000_for_any_spectrum():
    energies, weights = np.arange(20.0, 100), np.linspace(1, 0.1, 80)
    assert material("water").hu(energies, weights) == pytest.approx(0, abs=1e-9)
    assert material("air").hu(energies, weights) == pytest.approx(-1000, abs=2)


@given(st.lists(st.floats(0.05, 1.0), min_size=2, max_size=4), st.floats(20, 120))
@settings(max_examples=50, deadline=None)
def test_blending_by_volume_is_linear_in_attenuation(shares, energy):
    names = ["water", "hydroxyapatite", "adipose", "blood_iodine"][: len(shares)]
    shares = np.array(shares) / sum(shares)
    parts = {material(n): float(s) for n, s in zip(names, shares, strict=True)}
    expected = sum(s * m.attenuation(energy) for m, s in parts.items())
    assert float(blend("b", parts).attenuation(energy)) == pytest.approx(float(expected), rel=1e-10)


def test_mixing_by_mass_adds_mass_fractions():
    m = mixture("saline-like", 1.0, {material("water"): 0.9, material("iodine"): 0.1})
    assert m.mass_fractions["I"] == pytest.approx(0.1)
    assert m.mass_fractions["H"] == pytest.approx(0.9 * material("water").mass_fractions["H"])


@pytest.mark.parametrize("hu", [200.0, 800.0, 1500.0, 3000.0])
def test_calcification_reads_what_was_asked_for(hu):
    assert calcification(hu).hu(64.0) == pytest.approx(hu, abs=1e-6)


def test_every_material_of_the_registry_builds_and_attenuates():
    assert set(PLAQUE_MATERIALS) <= set(MATERIALS)
    for name in MATERIALS:
        m = MATERIALS[name]
        assert m.name == name
        mu = m.attenuation(np.array([20.0, 60.0, 100.0]))
        assert np.all(mu > 0)
        assert mu[0] > mu[1]


def test_materials_are_values():
    m = material("blood_iodine")
    assert pickle.loads(pickle.dumps(m)) == m
    assert hash(copy.deepcopy(m)) == hash(m)
    assert m.with_density(1.2) != m
    with pytest.raises(TypeError):
        m.mass_fractions["I"] = 0.5  # type: ignore[index]


test_bad_input_is_refused_with_a_remedy = refusals(
    ("greater than 0", lambda: Material("m", 0.0, {"H": 1})),
    ("greater than 0", lambda: Material("m", float("nan"), {"H": 1})),
    ("sum to 0.9", lambda: Material("m", 1.0, {"H": 0.5, "O": 0.4})),
    ("not per cent", lambda: Material("m", 1.0, {"H": 11.2, "O": 88.8})),
    ("must be ≥ 0", lambda: Material("m", 1.0, {"H": 1.5, "O": -0.5})),
    ("unknown element 'Xx'", lambda: Material("m", 1.0, {"Xx": 1.0})),
    ("at least one element", lambda: Material("m", 1.0, {})),
    ("unknown element 'Qq'", lambda: compound("m", 1.0, {"Qq": 2})),
    ("at least one atom", lambda: formula_mass_fractions({})),
    ("sum to 0.5", lambda: mixture("m", 1.0, {material("water"): 0.5})),
    ("sum to 0.5", lambda: blend("m", {material("water"): 0.5})),
    ("unknown material 'watr'", lambda: material("watr")),
    ("keV, not eV", lambda: material("water").attenuation(60e3)),
    ("got nan", lambda: material("water").attenuation([60.0, float("nan")])),
    (r"1…500 keV", lambda: material("water").attenuation(0.1)),
    ("kind must be one of", lambda: material("water").attenuation(60.0, "pair")),
    ("weights must be", lambda: material("water").hu([60.0], [-1.0])),
    ("hu must lie between", lambda: calcification(10_000.0)),
)


def test_a_concentration_of_iodine_by_its_name():
    """10 mg in every ml; volumes add, so 1 - 0.01 / 4.93 of the ml is blood. About 30 HU for 1
    mg/ml at 65 keV."""
    blood, mixed = material("blood"), material("iodine 10 mg/ml in blood")
    assert mixed == solution("iodine", 10.0, "blood")
    assert mixed.mass_fractions["I"] * mixed.density_g_cm3 == pytest.approx(0.010, rel=1e-9)
    assert mixed.density_g_cm3 == pytest.approx(1.06 * (1 - 0.01 / 4.93) + 0.01)
    assert (mixed.hu(65.0) - blood.hu(65.0)) / 10 == pytest.approx(30.5, abs=0.5)
    assert material("hydroxyapatite 0 mg/ml in water").hu(65.0) == pytest.approx(0.0, abs=1e-9)
    for name, expected_text in (
        ("iodine 1e4 mg/ml in blood", r"must lie in \[0, 4930\] mg/ml of iodine"),
        ("iodine -1 mg/ml in blood", "must lie in"),
        ("iodine 1-1 mg/ml in blood", "concentration"),
        ("iodine 10 mg/ml in custard", "unknown material 'custard'"),
        ("iodine 10 mg in blood", "iodine 10 mg/ml in blood"),
    ):
        with pytest.raises((ValueError, TypeError), match=expected_text):
            material(name)
