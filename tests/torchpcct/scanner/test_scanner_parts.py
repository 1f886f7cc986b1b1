"""Tube, bowties and detectors by themselves."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchpcct.scanner import Bowtie, Detector, Scintillator, SiliconDetector, Source, large_bowtie, presets, roi_bowtie
from torchpcct.scanner.compton import ELECTRON_REST_KEV, mean_recoil_fraction, recoil
from torchpcct.scene.materials import material

ENERGIES = np.arange(12.5, 120.0)


# --- tube ---------------------------------------------------------------------------------------------------------


def test_spectrum_units_are_photons_per_mm2_mas_at_1_m():
    import spekpy

    tube = spekpy.Spek(kvp=100.0, th=7.0, dk=1.0, z=100.0, mas=1.0, physics="casim")
    tube.filter("Al", 2.5)
    per_cm2 = tube.get_flu()
    spectrum = Source(output=1.0).spectrum()
    assert spectrum.total == pytest.approx(per_cm2 / 100, rel=0.01)  # the aluminium tables differ a little
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
    thin, thick = Source(filtration=((aluminium, 2.0),)).spectrum(), Source(filtration=((aluminium, 6.0),)).spectrum()
    assert thick.mean_energy > thin.mean_energy + 2
    assert thick.total < thin.total
    np.testing.assert_allclose(Source(output=2.0).spectrum().fluence, 2 * Source(output=1.0).spectrum().fluence)


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
        assert spectrum.mean_energy == pytest.approx((energies * fluence).sum() / fluence.sum(), rel=1e-5)
        assert spectrum.energies.size <= 80 / width + 2
    np.testing.assert_allclose(source.spectrum(0.5).fluence.max(), fluence.max(), rtol=1e-12)


@pytest.mark.parametrize(
    ("energies", "fluence", "message"),
    [
        ([50.0, 60.0], [1.0], "as many fluences"),
        ([60.0, 50.0], [1.0, 1.0], "strictly increasing"),
        ([50.0, 60.0], [1.0, -1.0], "≥ 0"),
        ([50.0, 60.0], [0.0, 0.0], "not all 0"),
    ],
)
def test_bad_tables_are_refused(energies, fluence, message):
    with pytest.raises(ValueError, match=message):
        Source.tabulated(energies, fluence)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"kvp": 300.0}, ValueError, "kvp must lie"),
        ({"kvp": float("nan")}, ValueError, "kvp must be"),
        ({"current_ma": 0.0}, ValueError, "current_ma must be"),
        ({"anode_angle_deg": 1.0}, ValueError, "anode_angle_deg must lie"),
        ({"output": -1.0}, ValueError, "output must be"),
        ({"focal_spot": (-1.0, 0.5)}, ValueError, r"focal_spot\[0\] must be at least 0 mm"),
        ({"focal_spot": 0.5}, ValueError, "focal_spot must be 2 numbers"),
        ({"filtration": ()}, ValueError, "filtration must not be empty"),
        ({"filtration": 2.0}, TypeError, "pairs"),
    ],
)
def test_bad_tubes_are_refused(change, error, message):
    with pytest.raises(error, match=message):
        Source(**change)


def test_bad_bin_width_is_refused():
    with pytest.raises(ValueError, match="bin_kev"):
        Source().spectrum(10.0)


# --- bowties ------------------------------------------------------------------------------------------------------


def test_large_bowtie_meets_its_table_and_is_symmetric():
    bowtie = large_bowtie()
    table = {0.0: 2.548, 0.06: 2.635, 0.10: 3.63, 0.15: 7.38, 0.20: 13.63, 0.25: 21.57, 0.30: 30.13, 0.40: 35.64}
    np.testing.assert_allclose(bowtie.thickness(list(table)), list(table.values()), rtol=1e-12)
    gamma = np.linspace(0, 0.6, 601)
    np.testing.assert_array_equal(bowtie.thickness(-gamma), bowtie.thickness(gamma))
    assert np.all(np.diff(bowtie.thickness(gamma)) >= 0)
    assert bowtie.thickness(0.6) == bowtie.thickness(0.48)


def test_bowtie_between_its_nodes_by_hand():
    """Monotone cubic of Fritsch and Butland: the slope at a node is the harmonic mean of its neighbours', 0 at a turn.

    Nodes of 0, 1, 4 mm every 0.1 rad: slopes 0, 2 · 10 · 30 / 40 = 15 at the first two, so half way between them
    (0 + 1) / 2 + 0.1 / 8 · (0 - 15) mm. A straight line would say 0.5.
    """
    bowtie = Bowtie(material("aluminium"), (0.0, 0.1, 0.2), (0.0, 1.0, 4.0))
    assert bowtie.thickness([-0.05, 0.05]) == pytest.approx(0.3125, abs=1e-9)


@given(st.lists(st.floats(0, 50), min_size=2, max_size=8))
@settings(max_examples=50, deadline=None)
def test_bowtie_interpolation_never_overshoots(values):
    bowtie = Bowtie(material("aluminium"), tuple(0.1 * i for i in range(len(values))), tuple(values))
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
    assert bowtie.thickness(np.arctan((at_filter + 7.5) / (626 - 263))) == pytest.approx(19.5, rel=0.03)
    assert bowtie.thickness(0.4) == pytest.approx(39.0)


def test_bowtie_transmission_is_beer_lambert():
    aluminium = material("aluminium")
    bowtie = Bowtie(aluminium, (0.0, 0.2), (1.0, 5.0))
    expected = np.exp(-bowtie.thickness([0.0, 0.1])[:, None] * aluminium.attenuation([40.0, 80.0]))
    np.testing.assert_allclose(bowtie.transmission([0.0, 0.1], [40.0, 80.0]), expected, rtol=1e-14)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Bowtie(material("aluminium"), (0.1, 0.2), (1.0, 2.0)), "increase strictly from 0"),
        (lambda: Bowtie(material("aluminium"), (0.0, 0.2, 0.1), (1.0, 2.0, 3.0)), "increase strictly"),
        (lambda: Bowtie(material("aluminium"), (0.0, 0.2), (1.0, -2.0)), "thickness_mm.* must be at least 0 mm"),
        (lambda: Bowtie(material("aluminium"), (0.0,), (1.0,)), "at least 2 nodes"),
        (lambda: roi_bowtie(626.0, diameter_mm=2000.0), "nearer to the"),
        (lambda: roi_bowtie(626.0, ramp_mm=0.0), "ramp_mm"),
        (lambda: roi_bowtie(626.0, thickness_mm=-1.0), "thickness_mm"),
    ],
)
def test_bad_bowties_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
    with pytest.raises(TypeError, match="must be a Material"):
        Bowtie("aluminium", (0.0, 0.1), (1.0, 1.0))


# --- Compton ------------------------------------------------------------------------------------------------------


@given(st.floats(5.0, 150.0))
@settings(max_examples=40, deadline=None)
def test_recoil_spectrum_has_its_edge_and_unit_mass(energy):
    t, p = recoil([energy])
    edge = 2 * energy**2 / (ELECTRON_REST_KEV + 2 * energy)
    assert p.sum() == pytest.approx(1, abs=1e-12)
    assert t.min() >= 0
    assert edge * 0.999 < t.max() < edge


def test_mean_recoil_fraction_against_the_closed_forms_of_klein_and_nishina():
    """σ_tr / σ of Klein–Nishina in closed form (Attix, Introduction to Radiological Physics, ch. 7)."""
    energies = np.array([20.0, 60.0, 100.0, 150.0])
    a = energies / ELECTRON_REST_KEV
    log = np.log1p(2 * a)
    total = (1 + a) / a**2 * (2 * (1 + a) / (1 + 2 * a) - log / a) + log / (2 * a) - (1 + 3 * a) / (1 + 2 * a) ** 2
    transfer = (
        2 * (1 + a) ** 2 / (a**2 * (1 + 2 * a))
        - (1 + 3 * a) / (1 + 2 * a) ** 2
        - (1 + a) * (2 * a**2 - 2 * a - 1) / (a**2 * (1 + 2 * a) ** 2)
        - 4 * a**2 / (3 * (1 + 2 * a) ** 3)
        - ((1 + a) / a**3 - 1 / (2 * a) + 1 / (2 * a**3)) * log
    )
    np.testing.assert_allclose(mean_recoil_fraction(energies), transfer / total, rtol=1e-9)


# --- silicon ------------------------------------------------------------------------------------------------------


def test_detectors_follow_the_protocol():
    assert isinstance(SiliconDetector(), Detector)
    assert isinstance(Scintillator(), Detector)
    assert not SiliconDetector().energy_integrating
    assert Scintillator().energy_integrating
    assert (SiliconDetector().bins, SiliconDetector("spectral").bins, Scintillator().bins) == (1, 8, 1)


def test_silicon_bins_add_up_to_the_counts_above_the_lowest_threshold():
    spectral, counting = SiliconDetector("spectral"), SiliconDetector()
    assert spectral.response(ENERGIES).shape == (8, ENERGIES.size)
    np.testing.assert_allclose(spectral.response(ENERGIES).sum(0), counting.response(ENERGIES)[0], rtol=1e-10)
    np.testing.assert_array_equal(spectral.variance(ENERGIES), spectral.response(ENERGIES))
    assert counting.response(ENERGIES).max() <= counting.fill_factor


def test_silicon_without_threshold_counts_every_interaction():
    detector = SiliconDetector()
    photo, compton = detector.interaction(ENERGIES)
    np.testing.assert_allclose(detector.above(ENERGIES, -np.inf)[0], photo + compton, rtol=1e-12)
    silicon = material("silicon")
    mu = silicon.attenuation(ENERGIES) - silicon.attenuation(ENERGIES, "coh")
    np.testing.assert_allclose(photo + compton, 0.96 * (1 - np.exp(-60 * mu)), rtol=1e-12)


def test_the_response_against_monte_carlo():
    """Interaction, Klein–Nishina rejection sampling (Kahn) and blur, drawn photon by photon."""
    rng = np.random.default_rng(7)
    detector, energy, n = SiliconDetector("spectral"), 70.0, 400_000
    photo, compton = (float(v) for v in detector.interaction(energy))
    u = rng.random(n)
    deposit = np.full(n, -1e9)
    deposit[u < photo] = energy
    which = np.flatnonzero((u >= photo) & (u < photo + compton))
    deposit[which] = _sample_recoil(energy, which.size, rng)
    recorded = deposit + rng.normal(0, detector.sigma_kev, n)
    counts, _ = np.histogram(recorded, [*detector.thresholds_kev, np.inf])
    expected = detector.response([energy])[:, 0] * n
    assert np.all(np.abs(counts - expected) < 4.5 * np.sqrt(expected + 1))


def _sample_recoil(energy, count, rng):
    out = np.empty(0)
    alpha = energy / ELECTRON_REST_KEV
    while out.size < count:
        cosine = rng.uniform(-1, 1, 4 * count)
        ratio = 1 / (1 + alpha * (1 - cosine))
        density = ratio**2 * (ratio + 1 / ratio - 1 + cosine**2)
        out = np.concatenate([out, energy * (1 - ratio[rng.uniform(0, 2, cosine.size) < density])])
    return out[:count]


def test_detected_share_behind_24_cm_of_fat():
    scanner = presets.pcct()
    energies, quanta = scanner.quanta()
    behind = quanta[750] * np.exp(-material("pericoronary_fat").attenuation(energies) * 240.0)
    share = (scanner.detector.response(energies)[0] * behind).sum() / behind.sum()
    assert share == pytest.approx(0.71, abs=0.01)


def test_efficiency_against_the_threshold_beside_the_published_dqe():
    """Zero-frequency DQE of a counting detector = share of photons counted (each photon counts at most once).

    Published for deep silicon: 0.68 at 0 keV, falling by 1.7 points per keV. The model has only the foils' loss, and
    every scattered photon escapes: it starts higher (0.90) and falls faster (2.9 points per keV up to 15 keV). With
    the published start as geometric efficiency the two stay within 9 points up to 15 keV.
    """
    scanner = presets.pcct()
    energies, quanta = scanner.quanta()
    behind = quanta[750] * np.exp(-material("pericoronary_fat").attenuation(energies) * 240.0)
    thresholds = np.arange(0.0, 16.0)
    dqe = SiliconDetector().above(energies, thresholds) @ behind / behind.sum()
    assert dqe[0] == pytest.approx(0.896, abs=0.01)
    assert (dqe[0] - dqe[15]) / 15 == pytest.approx(0.029, abs=0.002)
    lossy = SiliconDetector(fill_factor=0.96 * 0.68 / dqe[0]).above(energies, thresholds) @ behind / behind.sum()
    np.testing.assert_allclose(lossy, 0.68 - 0.017 * thresholds, atol=0.095)


def test_detection_falls_with_the_threshold_and_grows_with_the_length():
    detector = SiliconDetector()
    counts = detector.above(ENERGIES, np.arange(0.0, 30.0))
    assert np.all(np.diff(counts, axis=0) <= 1e-12)
    assert np.all(np.diff(counts[:6], axis=0)[:, ENERGIES > 40] < -0.01)
    short = SiliconDetector(length_mm=30.0).response(ENERGIES)
    assert np.all(short <= detector.response(ENERGIES))
    assert np.all((short < 0.9 * detector.response(ENERGIES))[:, ENERGIES > 60])


def test_a_dead_layer_takes_soft_photons():
    lossy = SiliconDetector(dead_layer_mm=0.5).response(ENERGIES) / SiliconDetector().response(ENERGIES)
    assert np.all(np.diff(lossy[0]) > 0)
    assert lossy[0, 0] < 0.8
    assert lossy[0, -1] > 0.97


def test_charge_sharing_moves_counts_down_and_is_off_by_default():
    assert SiliconDetector().charge_sharing == 0.0
    pure, shared = SiliconDetector("spectral"), SiliconDetector("spectral", charge_sharing=0.2)
    at_80 = shared.response([80.0])[:, 0] - pure.response([80.0])[:, 0]
    assert at_80[-1] < 0  # photopeak loses
    assert np.all(at_80[3:6] > 0)  # the tail gains
    # Every split event counts twice if nothing falls below the threshold.
    no_threshold = shared.above([80.0], -np.inf) / pure.above([80.0], -np.inf)
    assert no_threshold[0, 0] == pytest.approx(1.2, rel=1e-9)


def test_depth_segments_share_the_load():
    detector = SiliconDetector()
    assert len(detector.segment_mm) == 3
    assert sum(detector.segment_mm) == pytest.approx(60.0, rel=1e-12)
    np.testing.assert_allclose(detector.segment_shares([60.0]), 1 / 3, rtol=1e-12)
    np.testing.assert_allclose(detector.segment_shares(ENERGIES).sum(0), 1.0, rtol=1e-12)
    assert detector.segment_shares([30.0])[0, 0] > 1 / 3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mode": "both"}, "unknown mode 'both'"),
        ({"thresholds_kev": ()}, "one number or more"),
        ({"thresholds_kev": (20.0, 10.0)}, "increasing"),
        ({"thresholds_kev": (-5.0, 10.0)}, "at least 0 keV"),
        ({"length_mm": 0.0}, "length_mm must lie"),
        ({"segments": 0}, "segments must be"),
        ({"sigma_kev": 0.0}, "sigma_kev must lie"),
        ({"fill_factor": 1.2}, "fill_factor must lie"),
        ({"dead_layer_mm": -1.0}, "dead_layer_mm must lie"),
        ({"charge_sharing": 2.0}, "charge_sharing must lie"),
        ({"dead_time_ns": float("nan")}, "dead_time_ns must be finite"),
    ],
)
def test_bad_silicon_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        SiliconDetector(**change)
    with pytest.raises(TypeError, match="segments must be a whole number"):
        SiliconDetector(segments=1.5)


# --- scintillator -------------------------------------------------------------------------------------------------


def test_scintillator_integrates_energy():
    detector = Scintillator()
    absorbed = 0.81 * (1 - np.exp(-3.0 * material("lumex").attenuation(ENERGIES)))
    np.testing.assert_allclose(detector.response(ENERGIES)[0], absorbed * ENERGIES, rtol=1e-12)
    np.testing.assert_allclose(detector.variance(ENERGIES)[0], absorbed * ENERGIES**2, rtol=1e-12)
    assert detector.electronic_noise == 206.0


def test_bad_scintillators_are_refused():
    with pytest.raises(ValueError, match="depth_mm must lie"):
        Scintillator(depth_mm=0.0)
    with pytest.raises(ValueError, match="electronic_noise_kev must lie"):
        Scintillator(electronic_noise_kev=-1.0)
    with pytest.raises(TypeError, match="must be a Material"):
        Scintillator(material="lumex")
