"""Tube, bowties and detectors by themselves."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refused

from torchpcct.scanner import (
    Bowtie,
    Scintillator,
    SiliconDetector,
    Source,
    TransportedSilicon,
    large_bowtie,
    presets,
    roi_bowtie,
)
from torchpcct.scanner.compton import ELECTRON_REST_KEV, mean_recoil_fraction, recoil
from torchpcct.scanner.silicon_transport import Stack, follow
from torchpcct.scene.materials import material

ENERGIES = np.arange(12.5, 120.0)


# --- tube -----------------------------------------------------------------------------------------


def test_spectrum_units_are_photons_per_mm2_mas_at_1_m():
    import spekpy

    tube = spekpy.Spek(kvp=100.0, th=7.0, dk=1.0, z=100.0, mas=1.0, physics="casim")
    tube.filter("Al", 2.5)
    per_cm2 = tube.get_flu()
    spectrum = Source(output=1.0).spectrum()
    # the aluminium tables differ a little
    assert spectrum.total == pytest.approx(per_cm2 / 100, rel=0.01)
    assert 1.0e6 < Source().spectrum().total < 1.9e6


def test_spectrum_ends_at_the_tube_voltage_and_holds_no_soft_photons():
    for kvp in (80.0, 100.0, 120.0):
        spectrum = Source(kvp=kvp).spectrum()
        assert spectrum.energies[-1] < kvp
        assert spectrum.energies[-1] > kvp - 2
        assert spectrum.energies[0] > 9
        assert np.all(np.diff(spectrum.energies) > 0)
        assert np.all(spectrum.fluence >= 0)
    assert 48 < Source().spectrum().mean_energy < 54


def test_filtration_hardens_and_output_scales():
    aluminium = material("aluminium")
    thin, thick = (
        Source(filtration=((aluminium, 2.0),)).spectrum(),
        Source(filtration=((aluminium, 6.0),)).spectrum(),
    )
    assert thick.mean_energy > thin.mean_energy + 2
    assert thick.total < thin.total
    np.testing.assert_allclose(
        Source(output=2.0).spectrum().fluence, 2 * Source(output=1.0).spectrum().fluence
    )


def test_bin_width_keeps_photons_and_energy():
    fine, coarse = Source().spectrum(0.5), Source().spectrum(2.0)
    assert coarse.total == pytest.approx(fine.total, rel=5e-3)
    assert coarse.mean_energy == pytest.approx(fine.mean_energy, abs=0.2)


def test_a_tabulated_spectrum_keeps_photons_and_energy():
    energies = np.arange(10.25, 90.0, 0.5)
    fluence = np.exp(-(((energies - 55) / 15) ** 2)) * 1e5
    source = Source.tabulated(energies, fluence, current_ma=400.0)
    assert (source.current_ma, source.kvp) == (400.0, energies[-1])
    for width in (0.5, 1.0, 3.0):
        spectrum = source.spectrum(width)
        assert spectrum.total == pytest.approx(fluence.sum(), rel=2e-6)
        assert spectrum.mean_energy == pytest.approx(
            (energies * fluence).sum() / fluence.sum(), rel=1e-5
        )
        assert spectrum.energies.size <= 80 / width + 2
    np.testing.assert_allclose(source.spectrum(0.5).fluence.max(), fluence.max(), rtol=1e-12)


# --- bowties --------------------------------------------------------------------------------------


def test_large_bowtie_meets_its_table_and_is_symmetric():
    bowtie = large_bowtie()
    table = {
        0.0: 2.548,
        0.06: 2.635,
        0.10: 3.63,
        0.15: 7.38,
        0.20: 13.63,
        0.25: 21.57,
        0.30: 30.13,
        0.40: 35.64,
    }
    np.testing.assert_allclose(bowtie.thickness(list(table)), list(table.values()), rtol=1e-12)
    gamma = np.linspace(0, 0.6, 601)
    np.testing.assert_array_equal(bowtie.thickness(-gamma), bowtie.thickness(gamma))
    assert np.all(np.diff(bowtie.thickness(gamma)) >= 0)
    assert bowtie.thickness(0.6) == bowtie.thickness(0.48)


def test_bowtie_between_its_nodes_by_hand():
    """Monotone cubic of Fritsch and Butland: the slope at a node is the harmonic mean of its
    neighbours', 0 at a turn.

    Nodes of 0, 1, 4 mm every 0.1 rad: slopes 0, 2 · 10 · 30 / 40 = 15 at the first two, so half way
    between them (0 + 1) / 2 + 0.1 / 8 · (0 - 15) mm. A straight line would say 0.5.
    """
    bowtie = Bowtie(material("aluminium"), (0.0, 0.1, 0.2), (0.0, 1.0, 4.0))
    assert bowtie.thickness([-0.05, 0.05]) == pytest.approx(0.3125, abs=1e-9)


@given(st.lists(st.floats(0, 50), min_size=2, max_size=8))
@settings(max_examples=50, deadline=None)
def test_bowtie_interpolation_never_overshoots(values):
    bowtie = Bowtie(
        material("aluminium"), tuple(0.1 * i for i in range(len(values))), tuple(values)
    )
    gamma = np.linspace(0, 0.1 * (len(values) - 1), 333)
    thickness = bowtie.thickness(gamma)
    left = np.minimum((gamma / 0.1).astype(int), len(values) - 2)
    low = np.minimum(np.array(values)[left], np.array(values)[left + 1])
    high = np.maximum(np.array(values)[left], np.array(values)[left + 1])
    # The rounding of 0.1 * i can put a sample one interval off: allow for that at the nodes.
    inside = np.abs(gamma / 0.1 - np.round(gamma / 0.1)) > 1e-9
    assert np.all(thickness[inside] >= low[inside] - 2e-9)
    assert np.all(thickness[inside] <= high[inside] + 2e-9)


def test_roi_bowtie_geometry():
    bowtie = roi_bowtie(626.0)
    half_angle = np.arcsin(50 / 626)
    assert np.degrees(half_angle) == pytest.approx(4.58, abs=0.005)
    assert np.all(bowtie.thickness(np.linspace(0, half_angle, 50)) == 0)
    at_filter = (626 - 263) * np.tan(half_angle)
    assert bowtie.thickness(np.arctan((at_filter + 15) / (626 - 263))) == pytest.approx(39.0)
    assert bowtie.thickness(np.arctan((at_filter + 7.5) / (626 - 263))) == pytest.approx(
        19.5, rel=0.03
    )
    assert bowtie.thickness(0.4) == pytest.approx(39.0)


# --- Compton --------------------------------------------------------------------------------------


@given(st.floats(5.0, 150.0))
@settings(max_examples=40, deadline=None)
def test_recoil_spectrum_has_its_edge_and_unit_mass(energy):
    t, p = recoil([energy])
    edge = 2 * energy**2 / (ELECTRON_REST_KEV + 2 * energy)
    assert p.sum() == pytest.approx(1, abs=1e-12)
    assert t.min() >= 0
    assert edge * 0.999 < t.max() < edge


def test_mean_recoil_fraction_against_the_closed_forms_of_klein_and_nishina():
    """σ_tr / σ of Klein–Nishina in closed form (Attix, Introduction to Radiological Physics, ch.
    7)."""
    energies = np.array([20.0, 60.0, 100.0, 150.0])
    a = energies / ELECTRON_REST_KEV
    log = np.log1p(2 * a)
    total = (
        (1 + a) / a**2 * (2 * (1 + a) / (1 + 2 * a) - log / a)
        + log / (2 * a)
        - (1 + 3 * a) / (1 + 2 * a) ** 2
    )
    transfer = (
        2 * (1 + a) ** 2 / (a**2 * (1 + 2 * a))
        - (1 + 3 * a) / (1 + 2 * a) ** 2
        - (1 + a) * (2 * a**2 - 2 * a - 1) / (a**2 * (1 + 2 * a) ** 2)
        - 4 * a**2 / (3 * (1 + 2 * a) ** 3)
        - ((1 + a) / a**3 - 1 / (2 * a) + 1 / (2 * a**3)) * log
    )
    np.testing.assert_allclose(mean_recoil_fraction(energies), transfer / total, rtol=1e-9)


# --- silicon --------------------------------------------------------------------------------------


def test_silicon_bins_add_up_to_the_counts_above_the_lowest_threshold():
    spectral, counting = SiliconDetector("spectral"), SiliconDetector()
    assert spectral.response(ENERGIES).shape == (8, ENERGIES.size)
    np.testing.assert_allclose(
        spectral.response(ENERGIES).sum(0), counting.response(ENERGIES)[0], rtol=1e-10
    )
    np.testing.assert_array_equal(spectral.variance(ENERGIES), spectral.response(ENERGIES))
    assert counting.response(ENERGIES).max() <= counting.fill_factor


def test_silicon_without_threshold_counts_every_interaction():
    detector = SiliconDetector()
    photo, compton = detector.interaction(ENERGIES)
    np.testing.assert_allclose(detector.above(ENERGIES, -np.inf)[0], photo + compton, rtol=1e-12)
    silicon = material("silicon")
    mu = silicon.attenuation(ENERGIES) - silicon.attenuation(ENERGIES, "coh")
    np.testing.assert_allclose(photo + compton, 0.96 * (1 - np.exp(-60 * mu)), rtol=1e-12)


def test_depth_segments_share_the_load():
    detector = SiliconDetector()
    assert len(detector.segment_mm) == 3
    assert sum(detector.segment_mm) == pytest.approx(60.0, rel=1e-12)
    np.testing.assert_allclose(detector.segment_shares([60.0]), 1 / 3, rtol=1e-12)
    np.testing.assert_allclose(detector.segment_shares(ENERGIES).sum(0), 1.0, rtol=1e-12)
    assert detector.segment_shares([30.0])[0, 0] > 1 / 3


# --- scintillator ---------------------------------------------------------------------------------


def test_scintillator_integrates_energy():
    detector = Scintillator()
    absorbed = 0.81 * (1 - np.exp(-3.0 * material("lumex").attenuation(ENERGIES)))
    np.testing.assert_allclose(detector.response(ENERGIES)[0], absorbed * ENERGIES, rtol=1e-12)
    np.testing.assert_allclose(detector.variance(ENERGIES)[0], absorbed * ENERGIES**2, rtol=1e-12)
    assert detector.electronic_noise == 206.0


# --- bad input ------------------------------------------------------------------------------------

ALUMINIUM = material("aluminium")
RNG = np.random.default_rng(0)
BAD = {
    Source: (
        ({"kvp": 300.0}, "kvp must lie"),
        ({"kvp": float("nan")}, "kvp must be"),
        ({"output": -1.0}, "output must be"),
        ({"anode_angle_deg": 1.0}, "anode_angle_deg must lie"),
        ({"current_ma": 0.0}, "current_ma must be"),
        ({"focal_spot": (-1.0, 0.5)}, r"focal_spot\[0\] must lie in \[0, 100\] mm, got -1"),
        ({"filtration": 2.0}, "pairs"),
        ({"focal_spot": 0.5}, "focal_spot must be 2 numbers"),
        ({"filtration": ()}, "filtration must not be empty"),
    ),
    SiliconDetector: (
        ({"mode": "both"}, "unknown mode 'both'"),
        ({"thresholds_kev": ()}, "one number or more"),
        ({"thresholds_kev": (20.0, 10.0)}, "increasing"),
        ({"thresholds_kev": (-5.0, 10.0)}, "at least 0 keV"),
        ({"length_mm": 0.0}, "length_mm must lie"),
        ({"segments": 0}, "segments must be"),
        ({"segments": 1.5}, "segments must be a whole number"),
        ({"fill_factor": 1.2}, "fill_factor must lie"),
        ({"dead_layer_mm": -1.0}, "dead_layer_mm must lie"),
        ({"charge_sharing": 2.0}, "charge_sharing must lie"),
        ({"dead_time_ns": float("nan")}, "dead_time_ns must be finite"),
        ({"sigma_kev": 0.0}, "sigma_kev must lie"),
        ({"dead_time_ns": 20.0, "merge_ns": 30.0}, "merge_ns must lie"),
    ),
    TransportedSilicon: (
        ({"fill_factor": 0.9}, "fill_factor"),
        ({"charge_sharing": 0.1}, "charge"),
        ({"photons": 10}, "photons"),
    ),
    Scintillator: (
        ({"depth_mm": 0.0}, "depth_mm must lie"),
        ({"electronic_noise_kev": -1.0}, "electronic_noise_kev must lie"),
        ({"material": "lumex"}, "must be a Material"),
    ),
    presets.pcct().replace: (
        ({"geometry": None}, "geometry must be a ConeBeam"),
        ({"source": 100.0}, "source must be a Source"),
        ({"detector": "silicon"}, "detector must be a Detector"),
        ({"bowties": ("large",)}, "Bowtie objects"),
        ({"filters": (("aluminium", 3.0),)}, "Material, mm"),
        ({"energy_bin_kev": 0.0}, "energy_bin_kev"),
        ({"filters": ((ALUMINIUM, -3.0),)}, r"must lie in \[0, 1e\+06\] mm, got -3"),
    ),
    presets.pcct: (
        ({"bowtie": "medium"}, "unknown bowtie 'medium'"),
        ({"mode": "integrating"}, "unknown mode 'integrating'"),
    ),
}


@pytest.mark.parametrize(
    ("make", "change", "message"), [(m, *case) for m, cases in BAD.items() for case in cases]
)
def test_bad_parts_are_refused(make, change, message):
    with pytest.raises((ValueError, TypeError), match=message):
        make(**change)


def test_bad_calls_are_refused():
    refused(
        ("as many fluences", lambda: Source.tabulated([50.0, 60.0], [1.0])),
        ("strictly increasing", lambda: Source.tabulated([60.0, 50.0], [1.0, 1.0])),
        ("≥ 0", lambda: Source.tabulated([50.0, 60.0], [1.0, -1.0])),
        ("not all 0", lambda: Source.tabulated([50.0, 60.0], [0.0, 0.0])),
        ("bin_kev", lambda: Source().spectrum(10.0)),
        ("increase strictly from 0", lambda: Bowtie(ALUMINIUM, (0.1, 0.2), (1.0, 2.0))),
        ("increase strictly", lambda: Bowtie(ALUMINIUM, (0.0, 0.2, 0.1), (1.0, 2.0, 3.0))),
        (
            "thickness_mm.* must be at least 0 mm",
            lambda: Bowtie(ALUMINIUM, (0.0, 0.2), (1.0, -2.0)),
        ),
        ("at least 2 nodes", lambda: Bowtie(ALUMINIUM, (0.0,), (1.0,))),
        ("must be a Material", lambda: Bowtie("aluminium", (0.0, 0.1), (1.0, 1.0))),
        ("the filter stands 263 mm", lambda: roi_bowtie(200.0)),
        ("photons must be", lambda: follow(SiliconDetector(), [60.0], [1.0], 0, RNG)),
        ("weights must be", lambda: follow(SiliconDetector(), [60.0], [0.0], 10, RNG)),
        ("foil_mm", lambda: Stack(foil_mm=0.6)),
    )
