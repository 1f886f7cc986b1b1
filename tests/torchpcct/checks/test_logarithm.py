"""How far logarithms of few photons are off, reading by reading."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import poisson

from torchpcct import ConeBeam, FanBeam, Scan, full_turn
from torchpcct.checks.logarithm import _along, logarithm_error
from torchpcct.detector_window import DetectorWindow

MU = 0.02
VIEWS, COLUMNS = 160, 96
G = FanBeam(full_turn(VIEWS), 570.0, 1040.0, COLUMNS, 4.8)
P = 0.3 + 2.7 * np.exp(-((np.arange(COLUMNS) - 47.5) ** 2) / 30.0**2)
"""Of each column, the same in all views."""
AIR = 60.0
DARK = slice(30, 66)
"""Columns of 3 to 8 photons."""


def photons(seed=0, air=AIR, p=P):
    return np.random.default_rng(seed).poisson(air * np.exp(-np.broadcast_to(p, (VIEWS, COLUMNS))))


MADE = {
    "zeros as half a photon": lambda n, air: np.log(air / np.maximum(n, 0.5)),
    "zeros as one photon": lambda n, air: np.log(air / np.maximum(n, 1.0)),
    "one more": lambda n, air: np.log(air / (n + 1.0)),
    "half of one more": lambda n, air: np.log(air / (n + 0.5)),
}


def lines(n, air=AIR, how="zeros as half a photon"):
    return MADE[how](n, air)


def logarithms(p, geometry=G, **options):
    return Scan.from_line_integrals(p, geometry, mu_water=MU, **options)


def exact(air=AIR, how="zeros as half a photon", p=P):
    """Mean error of each column, from the sum over all counts."""
    n, mean = np.arange(2000), air * np.exp(-p)
    return poisson.pmf(n, mean[:, None]) @ lines(n, air, how) - p


def mean_error(scan):
    return logarithm_error(scan)[0].double().numpy().mean(0)


@pytest.mark.parametrize("how", MADE)
def test_the_error_is_that_of_the_sum_over_all_counts(how):
    """Once taken for sure of the other sign between the exposures that had been tried."""
    for air in (25.0, 40.0, 60.0, 80.0, 120.0, 200.0):
        known = []
        for seed in range(4):
            error, sure = logarithm_error(logarithms(lines(photons(seed, air), air, how)))
            assert error.shape == (VIEWS, COLUMNS)
            if sure:
                known.append(error.double().numpy().mean(0)[DARK])
        assert len(known) == 4 or air > 60.0
        if known:
            assert np.mean(known, 0) == pytest.approx(exact(air, how)[DARK], rel=0.3, abs=0.03)


def test_last_digits_do_not_decide():
    """Many means of three readings are equal but for them, and they depend on what was added up:
    here they are higher or lower for three that differ. Once they turned a sign that was sure."""
    n = np.maximum(photons(21), 0.5)[:, None, :]
    level, variance, number = _along(np.moveaxis(n, 0, -1))
    for digits in (1e-7, -1e-7):
        found = _along(np.moveaxis(n * (1.0 + digits * n), 0, -1))
        for values, same in zip(found, (level, variance, number), strict=True):
            assert values == pytest.approx(same, rel=1e-4)


def test_of_many_photons_there_is_none():
    assert logarithm_error(logarithms(lines(photons(air=4e4), 4e4))) is None
    assert logarithm_error(Scan.from_counts(photons(air=4e4), G, air=4e4, mu_water=MU)) is None


def test_dead_readings_say_nothing():
    rng = np.random.default_rng(1)
    dead = rng.random((VIEWS, COLUMNS)) < 0.1
    given = np.where(dead, np.nan, lines(photons()))
    assert mean_error(logarithms(given))[DARK] == pytest.approx(
        mean_error(logarithms(lines(photons())))[DARK], rel=0.15
    )


def test_dark_columns_take_their_signal_from_bright_ones():
    """One of a dozen scans of which the noise of few photons, some of them not read, tells too
    little of it."""
    dead = np.random.default_rng(11).random((VIEWS, COLUMNS)) < 0.1
    given = np.where(dead, np.nan, lines(photons(1011, 100.0), 100.0))
    error, sure = logarithm_error(logarithms(given))
    assert sure
    mean = error.double().numpy().mean(0)[DARK]
    assert mean == pytest.approx(exact(100.0)[DARK], rel=0.3, abs=0.03)


@pytest.mark.parametrize("views", [24, 60, 160])
@pytest.mark.parametrize("air", [1.0, 3.0, 10.0, 200.0])
def test_of_few_readings_as_much_is_known_as_they_tell(views, air):
    """Classes of brightness that hold too few are left out: of some columns one is left."""
    dead = np.random.default_rng(1).random((views, COLUMNS)) < 0.1
    given = np.where(dead, np.nan, lines(photons(air=air)[:views], air))
    scan = logarithms(given, replace(G, angles=full_turn(views)))
    found = logarithm_error(scan)
    assert found is None or bool(torch.isfinite(found[0]).all())


def test_each_slice_of_a_stack_has_its_own():
    """Of a thick object, and of one of half its thickness."""
    both = (P, P / 2.0)
    stack = np.stack([lines(photons(k, p=p)) for k, p in enumerate(both)])
    error, _ = logarithm_error(logarithms(stack))
    assert error.shape == stack.shape
    for found, p in zip(error.double().numpy().mean(1), both, strict=True):
        assert found[DARK] == pytest.approx(exact(p=p)[DARK], rel=0.3, abs=0.01)


def test_noise_of_electronics_is_counted():
    """What it adds is off by more than photons alone would be."""
    noise, air = 4.0, 300.0

    def read(seed):
        z = np.random.default_rng(100 + seed).standard_normal((VIEWS, COLUMNS))
        return np.log(air / np.maximum(photons(seed, air) + noise * z, 0.5))

    off = np.mean([read(seed) for seed in range(40)], (0, 1)) - P
    found = np.mean([mean_error(logarithms(read(seed))) for seed in range(3)], 0)
    assert off[DARK].mean() > 1.5 * exact(air)[DARK].mean()
    assert found[DARK].mean() == pytest.approx(off[DARK].mean(), rel=0.3)


def test_a_signal_in_kev_is_that_of_its_quanta():
    air, kev = 5.0, 60.0
    n = photons(air=air)
    counts = Scan.from_counts(n, G, air=air, mu_water=MU, gain=1.0)
    signal = replace(
        counts,
        counts=kev * counts.counts,
        air=kev * counts.air,
        counting=False,
        quantum=torch.full_like(counts.counts, kev),
    )
    expected, _ = logarithm_error(counts)
    assert float(expected.abs().max()) > 0.1
    torch.testing.assert_close(logarithm_error(signal)[0], expected, rtol=1e-3, atol=1e-6)


def test_noise_of_no_photons_leaves_it_unsure():
    """It grows as the signal does, where that of photons grows as its root."""
    z = np.random.default_rng(0).standard_normal((VIEWS, COLUMNS))
    found = logarithm_error(logarithms(P + 0.3 * z))
    assert found is None or not found[1]


def test_of_noise_free_and_windowed_scans_nothing_is_asked():
    g = ConeBeam(full_turn(48), 570.0, 1040.0, 32, 4, (4.0, 4.8))
    n = np.random.default_rng(0).poisson(1.0, g.shape)
    few = Scan.from_counts(n, g, air=20.0, mu_water=MU, gain=1.0)
    assert logarithm_error(few) is not None
    assert logarithm_error(replace(few, exposure_s=None)) is None
    window = DetectorWindow(np.full(48, 8), 16, 0, 4)
    inset = replace(
        few,
        counts=DetectorWindow.full(g).crop(few.counts, window),
        window=window,
        exterior=torch.full(few.air.shape, 1.0),
    )
    assert logarithm_error(inset) is None
