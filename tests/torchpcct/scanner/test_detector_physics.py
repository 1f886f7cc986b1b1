"""Pile-up, charge sharing and photons followed through the silicon detector, against closed
forms and event lists."""

from dataclasses import replace

import numpy as np
import pytest

from torchpcct import acquire
from torchpcct.scanner import SiliconDetector, presets
from torchpcct.scanner.compton import mean_recoil_fraction
from torchpcct.scanner.pileup import recorded_rates
from torchpcct.scanner.silicon_transport import Stack, efficiency, follow
from torchpcct.scene.materials import material
from torchpcct.scene.phantoms.quality import water_cylinder

ENERGIES = np.array([25.0, 45.0, 70.0, 95.0])
QUANTA = np.array([2e6, 8e6, 6e6, 1e6])


# --- pile-up --------------------------------------------------------------------------------------


def test_without_dead_time_rates_are_quanta_times_response():
    for mode in ("counting", "spectral"):
        detector = SiliconDetector(mode)
        np.testing.assert_allclose(
            recorded_rates(detector, ENERGIES, QUANTA),
            detector.response(ENERGIES) @ QUANTA,
            rtol=1e-12,
        )


def test_one_segment_is_non_paralysable():
    detector = SiliconDetector(segments=1, dead_time_ns=80.0)
    true = detector.response(ENERGIES)[0] @ QUANTA
    recorded = recorded_rates(detector, ENERGIES, QUANTA)[0]
    assert recorded == pytest.approx(true / (1 + 80e-9 * true), rel=1e-12)
    # Three segments share the load, each with the photons that interact in it.
    parts = (detector.response(ENERGIES)[0] * QUANTA) @ replace(
        detector, segments=3
    ).segment_shares(ENERGIES).T
    split = recorded_rates(replace(detector, segments=3), ENERGIES, QUANTA)[0]
    assert split == pytest.approx(float((parts / (1 + 80e-9 * parts)).sum()), rel=1e-12)
    # More segments lose less, and the counting mode is the sum of the bins.
    three = replace(detector, segments=3)
    assert recorded < recorded_rates(three, ENERGIES, QUANTA)[0] < true
    for merge in (0.0, 30.0):
        spectral = replace(three, mode="spectral", merge_ns=merge)
        assert recorded_rates(spectral, ENERGIES, QUANTA).sum() == pytest.approx(
            recorded_rates(three, ENERGIES, QUANTA)[0], rel=1e-6
        )


def test_merged_pulses_against_a_list_of_events():
    """Arrival times, pulse heights, dead time and merging drawn event by event in one segment."""
    rng = np.random.default_rng(3)
    detector = SiliconDetector("spectral", segments=1, dead_time_ns=60.0, merge_ns=30.0)
    photo, compton = detector.interaction(ENERGIES)
    expected = recorded_rates(detector, ENERGIES, QUANTA)
    duration = 0.02
    rate = float((photo + compton) @ QUANTA)
    n = rng.poisson(rate * duration)
    times = np.sort(rng.uniform(0, duration, n))
    # survival of the height
    cumulative = detector.above(ENERGIES, np.arange(-12.0, 120.0, 0.05)) @ QUANTA / rate
    heights = np.interp(-rng.random(n), -cumulative, np.arange(-12.0, 120.0, 0.05))
    recorded, free_at, i = [], -1.0, 0
    while i < n:
        if times[i] >= free_at and heights[i] > detector.thresholds_kev[0]:
            last = np.searchsorted(times, times[i] + 30e-9)
            recorded.append(heights[i:last].sum())
            free_at = times[i] + 60e-9
        i += 1
    counts, _ = np.histogram(recorded, [*detector.thresholds_kev, np.inf])
    assert counts.sum() == pytest.approx(expected.sum() * duration, rel=0.015)
    # Heights are in steps of 1 keV: 1 % of the total on top of the counting error.
    error = 4.5 * np.sqrt(counts) + 0.006 * counts.sum()
    assert np.all(np.abs(counts - expected * duration) < error)
    # Merging matters here: without it the top bin would hold a quarter of that.
    plain = recorded_rates(replace(detector, merge_ns=0.0), ENERGIES, QUANTA)
    assert counts[-1] > 1.3 * plain[-1] * duration


def test_the_map_is_off_by_default_and_reproduces_the_rates():
    assert presets.pcct().pile_up() is None
    assert presets.eid().pile_up() is None
    scanner = presets.pcct(detector=SiliconDetector(dead_time_ns=50.0))
    pile_up = scanner.pile_up()
    energies, quanta = scanner.quanta()
    for column, path in ((750, 0.0), (750, 55.0), (123, 170.0), (40, 0.0)):
        arriving = quanta[column] * 1000.0 * np.exp(-material("water").attenuation(energies) * path)
        true = scanner.detector.response(energies)[0] @ arriving
        air = scanner.detector.response(energies)[0] @ quanta[column] * 1000.0
        found = float(pile_up.at(np.log(air / true), column)[0])
        recorded = recorded_rates(scanner.detector, energies, arriving)[0]
        assert found == pytest.approx(np.log(recorded / true), abs=2e-4)
    # Twice the current, more loss; the number of views does not matter.
    double = scanner.replace(source=replace(scanner.source, current_ma=2000.0)).pile_up()
    assert double.at(0.0, 750)[0] < pile_up.at(0.0, 750)[0]
    assert scanner.with_views(17).pile_up() is pile_up


def test_scans_with_pile_up_lose_counts_and_stay_linear_in_water():
    system = presets.pcct(views=4, detector=SiliconDetector(dead_time_ns=50.0))
    system = system.replace(
        geometry=replace(system.geometry, rows=1), source=replace(system.source, focal_spot=(0, 0))
    )
    ideal = system.replace(detector=SiliconDetector())
    scan, free = (acquire(water_cylinder(200.0), s, sub_rays=1, duty=1e-6) for s in (system, ideal))
    lost = 1 - scan.air / free.air
    assert 0.4 < float(lost[0, 750]) < 0.6
    behind = 1 - scan.counts / free.counts
    assert 0.01 < float(behind[0, 0, 750]) < 0.05
    gamma = system.geometry.fan_angles
    chord = 2 * np.sqrt(np.clip(100.0**2 - (626.0 * np.sin(gamma)) ** 2, 0, None))
    inside = chord > 20
    lines = scan.line_integrals()[0, 0].double().numpy()
    linear = lines / (scan.linearisation.mu_ref * np.maximum(chord, 1))
    np.testing.assert_allclose(linear[inside], 1.0, atol=2.5e-3)
    np.testing.assert_allclose(linear[chord > 60], 1.0, atol=5e-4)
    # With the ideal detector's correction the same readings would be far off.
    wrong = replace(scan, linearisation=free.linearisation).line_integrals()[0, 0].double().numpy()
    assert (wrong[740:760] / (free.linearisation.mu_ref * chord[740:760]) < 0.9).all()


# --- photons followed -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def followed():
    scanner = presets.pcct()
    energies, quanta = scanner.quanta()
    beam = quanta[750] * np.exp(-material("pericoronary_fat").attenuation(energies) * 240.0)
    return (
        energies,
        beam,
        follow(SiliconDetector(), energies, beam, 60_000, np.random.default_rng(1)),
    )


def test_first_interactions_are_the_one_interaction_model(followed):
    energies, beam, deposits = followed
    detector = SiliconDetector()
    first = deposits.order == 0
    n = deposits.photons
    heights = np.full(n, -1e9)
    heights[deposits.photon[first]] = deposits.energy_kev[first]
    heights += np.random.default_rng(2).normal(0, detector.sigma_kev, n)
    for threshold in (-np.inf, 5.0, 22.0, 52.0):
        share = float(detector.above(energies, [threshold])[0] @ beam / beam.sum())
        counted = (heights > max(threshold, -1e6)).mean()
        assert abs(counted - share) < 4.5 * np.sqrt(share * (1 - share) / n)
    shares = (detector.segment_shares(energies) * detector.above(energies, [-np.inf])[0]) @ beam
    found = np.bincount(deposits.segment[first], minlength=3) / first.sum()
    np.testing.assert_allclose(found, shares / shares.sum(), atol=4.5 * 0.5 / np.sqrt(n))


def test_energy_is_conserved_and_photons_count_repeatedly(followed):
    deposits = followed[2]
    total = np.bincount(deposits.photon, deposits.energy_kev, deposits.photons)
    assert np.all(total <= deposits.incident_kev * (1 + 1e-9))
    counted = deposits.counts(5.0, 1e-6, np.random.default_rng(0))
    assert (total > 5.0).mean() < counted.mean()
    assert counted.max() > 1


def test_compton_deposits_have_the_mean_of_klein_and_nishina():
    n = 40_000
    deposits = follow(
        SiliconDetector(fill_factor=1.0),
        [80.0],
        [1.0],
        n,
        np.random.default_rng(4),
        Stack(foil_mm=0.0),
    )
    first = deposits.order == 0
    compton = deposits.energy_kev[first & (deposits.energy_kev < 79.9)]
    expected = 80.0 * float(mean_recoil_fraction(80.0)[0])
    assert compton.mean() == pytest.approx(
        expected, abs=4.5 * compton.std() / np.sqrt(compton.size)
    )
    photo, scattered = SiliconDetector(fill_factor=1.0).interaction([80.0])
    share = float(scattered[0] / (photo + scattered)[0])
    assert compton.size / first.sum() == pytest.approx(share, abs=4.5 * 0.5 / np.sqrt(n))


def test_foils_stop_scattered_photons():
    rng = np.random.default_rng(5)
    k = [
        follow(SiliconDetector(), [70.0], [1.0], 8000, rng, Stack(foil_mm=f))
        .counts(-1e9, 1.0, rng)
        .mean()
        for f in (0.0, 0.005, 0.02)
    ]
    assert k[0] > 1.5 > k[1] > 1.1 > k[2]


def test_a_dead_layer_records_nothing():
    rng = np.random.default_rng(6)
    detector = SiliconDetector(dead_layer_mm=5.0, fill_factor=1.0)
    deposits = follow(detector, [40.0], [1.0], 20_000, rng, Stack(foil_mm=0.0))
    photo, compton = detector.interaction([40.0])
    first = (deposits.order == 0).sum() / 20_000
    assert first == pytest.approx(float(photo[0] + compton[0]), abs=4.5 * 0.5 / np.sqrt(20_000))


def test_efficiency_in_closed_form():
    counts = np.repeat([0, 1, 2], [20, 60, 20])
    value, error = efficiency(counts)
    assert value == pytest.approx(1.0**2 / 1.4)
    assert error > 0
    assert efficiency(np.zeros(10)) == (0.0, 0.0)
    ones = np.ones(4)
    assert efficiency(ones)[0] == 1.0
    assert efficiency(ones, [1.0, 1.0, 3.0, 3.0])[0] == pytest.approx(2.0**2 / 5.0)
    # The standard error against repeated experiments.
    rng = np.random.default_rng(0)
    draws = [efficiency(rng.choice([0, 1, 2], 500, p=[0.2, 0.6, 0.2])) for _ in range(400)]
    values, errors = np.array(draws).T
    assert errors.mean() == pytest.approx(values.std(), rel=0.15)
    with pytest.raises(ValueError, match="task has shape"):
        efficiency(ones, [1.0])


def test_charge_sharing_of_followed_pulses_doubles_counts_without_a_threshold(followed):
    deposits = followed[2]
    rng = np.random.default_rng(7)
    plain = deposits.counts(-1e9, 1.0, rng).mean()
    assert deposits.counts(-1e9, 1.0, rng, charge_sharing=1.0).mean() == pytest.approx(2 * plain)
