"""Readings that stop at a lowest value: negative ones that were set to 0; few photons do not."""

import math

import numpy as np
import pytest
from analytic import Ellipsoid, line_integrals

from torchpcct import ConeBeam, FanBeam, ParallelBeam, Scan, full_turn
from torchpcct.checks.defects import repair_defects
from torchpcct.checks.floor import _chance, clipped_floor, folded_share
from torchpcct.checks.readings import reading_warnings

MU = 0.02
BODIES = [
    Ellipsoid((2.0, -3.0), (80.0, 100.0), value=MU),
    Ellipsoid((30.0, 20.0), (12.0, 12.0), value=MU),
]
BEAMS = {
    "parallel": ParallelBeam(full_turn(120) / 2, 96, 2.4),
    "fan": FanBeam(full_turn(120), 600.0, 1100.0, 96, 4.6),
    "cone": ConeBeam(full_turn(60), 600.0, 1100.0, 96, 3, (4.0, 4.6)),
}
LOWER = "lower ones were"
SHONE = {name: np.exp(-line_integrals(g, BODIES, sub=1)) for name, g in BEAMS.items()}


def read(beam="fan", air=100.0, noise=0.0, seed=0):
    """Photons, with the noise of electronics, as over their dark signal."""
    rng = np.random.default_rng(seed)
    shone = SHONE[beam]
    return rng.poisson(air * shone) + noise * rng.standard_normal(shone.shape)


def said(readings, beam="fan", air=100.0, **description):
    scan = Scan.from_counts(readings, BEAMS[beam], air=air, mu_water=MU, **description)
    fixed, _ = repair_defects(scan)
    return [text for text in reading_warnings(fixed) if LOWER in text]


@pytest.mark.parametrize(("air", "noise"), [(60.0, 4.0), (100.0, 7.0), (1e3, 30.0), (1e4, 200.0)])
@pytest.mark.parametrize("beam", BEAMS)
def test_negative_readings_set_to_zero_are_named(beam, air, noise):
    y = read(beam, air, noise)
    (text,) = said(np.maximum(y, 0.0), beam, air)
    share = float(text.split(" %")[0])
    assert share == pytest.approx(100.0 * (y <= 0).mean(), rel=0.05)
    assert "% of the readings read 0, " in text
    assert "negative ones too" in text
    assert said(y, beam, air, electronic_noise=noise) == []


@pytest.mark.parametrize(
    "change",
    [
        lambda y: (np.maximum(np.round(y), 0.0), {}),  # digits
        lambda y: (np.maximum(np.round(3.7 * y), 0.0), {"gain": 3.7, "air": 370.0}),
        lambda y: (np.maximum(y, 1.0), {}),  # so that a logarithm exists
        lambda y: (np.maximum(y / 100.0, 1e-4), {"air": 1.0}),  # transmissions
        lambda y: (np.maximum(y, 0.0), {"electronic_noise": 7.0}),
        lambda y: (np.where(y > 0, y, 1.0), {}),  # some are lower
        lambda y: (np.where(y > 0, y, np.nan), {}),
        lambda y: (y.clip(0), {"dead": y <= 2.0}),
    ],
)
def test_whatever_the_lowest_value_and_the_digits(change):
    readings, description = change(read(noise=7.0))
    assert len(said(readings, **description)) == 1
    lines = -np.log(np.maximum(read(noise=7.0), 0.5) / 100.0)
    found = reading_warnings(Scan.from_line_integrals(lines, BEAMS["fan"], mu_water=MU))
    assert sum(LOWER in text for text in found) == 1


@pytest.mark.parametrize("air", [3.0, 10.0, 30.0, 100.0, 1e3])
@pytest.mark.parametrize("beam", BEAMS)
def test_photons_that_are_few_read_zero_rightly(beam, air):
    n = read(beam, air)
    assert said(n, beam, air) == []
    assert said(3.0 * n, beam, 3.0 * air, gain=3.0) == []
    assert said(3.0 * n, beam, 3.0 * air) == []  # another gain than described
    for lines in (n + 0.5, np.maximum(n, 0.5)):
        scan = Scan.from_line_integrals(-np.log(lines / air), BEAMS[beam], mu_water=MU)
        assert not any(LOWER in text for text in reading_warnings(scan))


def test_energies_of_few_photons_are_no_clipped_readings():
    """A scintillator without electronic noise reads 0 of no photon, else any energy."""
    rng = np.random.default_rng(2)
    for air in (10.0, 30.0, 100.0):
        n = rng.poisson(air * SHONE["fan"])
        for shape in (2.0, 20.0):
            energy = np.where(n > 0, rng.gamma(np.maximum(n, 1) * shape, 1.0 / shape), 0.0)
            assert said(energy, air=air, electronic_noise=0.0) == []


def test_shadows_of_metal_are_no_clipped_readings():
    """Their edges have zeros beside bright readings on one side, thin wires on both, along one
    axis."""
    g = BEAMS["fan"]
    wires = [Ellipsoid((-60.0 + 12.0 * k, 5.0 * k), (1.5, 1.5), value=8.0) for k in range(10)]
    rod = Ellipsoid((-30.0, 30.0), (6.0, 9.0), value=2.0)
    for metal in (wires, [rod], [rod, *wires]):
        shone = np.exp(-line_integrals(g, [*BODIES, *metal], sub=3))
        for air in (30.0, 300.0, 3e3):
            counts = np.random.default_rng(3).poisson(air * shone).astype(float)
            assert said(counts, air=air) == []


def test_nothing_is_said_where_nothing_was_clipped():
    y = read(air=1e4, noise=7.0)
    assert y.min() > 0
    assert said(np.maximum(y, 0.0), air=1e4) == []


@pytest.mark.parametrize("n", [2, 3, 5, 9])
def test_the_chance_of_no_photon_between_two_readings_is_that_of_all_ways_to_share_them(n):
    share = {True: 0.0, False: 0.0}
    for a in range(1, n):
        for c in range(1, n - a + 1):
            ways = math.comb(n, a) * math.comb(n - a, c)
            share[a + c == n] += ways
    expected = share[True] / (share[True] + share[False])
    assert float(_chance(np.array([float(n)]))[0]) == pytest.approx(expected, rel=1e-12)


def test_dead_readings_and_windows_do_not_disturb():
    counts = np.maximum(read(noise=7.0), 0.0)[:, None]
    counts[::9, :, ::7] = np.nan
    assert clipped_floor(counts, 1.0).clipped
    assert not clipped_floor(np.where(np.isnan(counts), np.nan, read()[:, None]), 1.0).clipped
    assert not clipped_floor(counts[:3, :, :5], 1.0).clipped  # too few
    lost = np.random.default_rng(5).random(counts.shape) < 0.03  # at random, not the dark ones
    for n in (read(air=1e3), read(air=30.0)):
        assert not clipped_floor(np.where(lost, np.nan, n[:, None]), 1.0).clipped


FOLDED = "made positive"


def of_negative(readings, beam="fan", air=100.0, **description):
    scan = Scan.from_counts(readings, BEAMS[beam], air=air, mu_water=MU, **description)
    return [text for text in reading_warnings(repair_defects(scan)[0]) if FOLDED in text]


@pytest.mark.parametrize(("air", "noise"), [(100.0, 2.0), (100.0, 7.0), (1e3, 30.0), (1e4, 200.0)])
@pytest.mark.parametrize("beam", ["parallel", "fan"])
def test_absolute_values_of_negative_readings_are_named(beam, air, noise):
    y = read(beam, air, noise)
    for folded, description in (
        (np.abs(y), {}),
        (np.abs(y), {"electronic_noise": noise}),
        (np.abs(np.round(12.0 * y)), {"gain": 12.0, "air": 12.0 * air}),
    ):
        (text,) = of_negative(folded, beam, **{"air": air, **description})
        # Half of a standard deviation of what is left of the noise.
        assert 0.2 < float(text.split(" %")[0]) / (100.0 * (y <= 0).mean()) < 4.0
    assert of_negative(y, beam, air, electronic_noise=noise) == []


def test_logarithms_of_absolute_values_are_named():
    p = np.log(1e3 / np.abs(read(air=1e3, noise=30.0)))
    scan = Scan.from_line_integrals(p, BEAMS["fan"], mu_water=MU)
    assert any(FOLDED in text for text in reading_warnings(scan))


@pytest.mark.parametrize("air", [3.0, 10.0, 30.0, 100.0, 300.0])
def test_photons_end_at_0_without_absolute_values(air):
    """Counts, each cell over its gain, means of frames, pulses of different energies, what was
    interpolated, logarithms with half a photon added."""
    rng = np.random.default_rng(7)
    n = read(air=air)
    gains = rng.uniform(0.8, 1.2, n.shape[-1])
    blurred = 0.3 * np.roll(n * gains, 1, -1) + 0.7 * n * gains
    for values in (
        n,
        n * gains,
        rng.poisson(16 * air * SHONE["fan"]) / 16.0,
        rng.gamma(np.maximum(9.0 * n, 1e-9)),
        blurred,
        0.4 * np.roll(blurred, 1, 0) + 0.6 * blurred,
        (n + 0.5) * gains,
        np.maximum(n, 0.5) * gains,
        SHONE["fan"] ** 6,  # no noise
    ):
        assert folded_share(values[:, None].astype(float)) == 0.0
