"""A silicon detector that follows its photons: against the reference that it is made from, and
in a scanner."""

import numpy as np
import pytest

from torchpcct.scanner import SiliconDetector, TransportedSilicon, presets
from torchpcct.scanner.silicon_transport import follow


@pytest.fixture(scope="module")
def detector():
    return TransportedSilicon("spectral", photons=140_000)


@pytest.mark.parametrize("energy", [30.0, 60.0, 100.0])
def test_counts_are_those_of_followed_photons(detector, energy):
    """Other photons, other random numbers, and counting instead of expectation."""
    photons = 40_000
    rng = np.random.default_rng(7)
    deposits = follow(SiliconDetector(), [energy], [1.0], photons, rng)
    for k, threshold in ((0, 5.0), (2, 22.0), (4, 42.0)):
        counted = deposits.counts(threshold, detector.sigma_kev, rng)
        expected = detector.above([energy], [threshold])[0, 0]
        error = counted.std() / photons**0.5
        # 2000 photons made the expectation
        assert counted.mean() == pytest.approx(expected, abs=4 * error + 0.03)
        assert detector.response([energy])[k:].sum() == pytest.approx(expected, abs=1e-9)


def test_repeated_interactions_add_counts_in_the_low_bins(detector):
    energies = np.arange(40.0, 101.0, 5.0)
    once, more = SiliconDetector("spectral").response(energies), detector.response(energies)
    assert (more.sum(0) > once.sum(0)).all()
    assert ((more - once)[:2].sum(0)[8:] > 0.01).all()  # recoil electrons of 80 keV and more


def test_nothing_beyond_the_first_interaction_without_scatter(detector):
    """Soft photons are absorbed at once."""
    soft = [12.0, 15.0]
    np.testing.assert_allclose(
        detector.response(soft), SiliconDetector("spectral").response(soft), atol=0.01
    )


def test_bins_sum_to_the_count_and_repeat(detector):
    energies = [45.0, 72.5]
    counting = TransportedSilicon("counting", photons=detector.photons)
    np.testing.assert_allclose(
        counting.response(energies)[0], detector.response(energies).sum(0), rtol=1e-9
    )
    again = TransportedSilicon("spectral", photons=detector.photons)
    np.testing.assert_array_equal(again.response(energies), detector.response(energies))
    assert hash(again) == hash(detector)


def test_in_a_scanner(detector):
    plain, followed = presets.pcct(mode="spectral", rows=2), presets.pcct(rows=2, detector=detector)
    assert followed.detector.bins == 8
    ratio = followed.weights()[1].sum((0, 2)) / plain.weights()[1].sum((0, 2))
    assert 1.03 < ratio.min() <= ratio.max() < 1.15
