"""Readings: wrong descriptions come out right, or are named, sound scans are not; dead ones are
interpolated exactly."""

import math
import re

import numpy as np
import pytest
import torch
from analytic import Ellipsoid, line_integrals

from recon import reconstruct
from torchpcct import ConeBeam, FanBeam, ParallelBeam, Scan, VolumeGrid, full_turn
from torchpcct.checks.defects import repair_defects
from torchpcct.checks.readings import reading_warnings
from torchpcct.readings import (
    interpolate_dead,
    log_bias,
    quartile_sd,
    smoothed,
)

MU = 0.02
AIR = 1e5
BODY = [
    Ellipsoid((2.0, -3.0), (80.0, 100.0), value=MU),
    Ellipsoid((30.0, 20.0), (12.0, 12.0), value=MU),
    Ellipsoid((-30.0, -40.0), (10.0, 15.0), value=-0.6 * MU),
]
ROUND = [
    Ellipsoid((0.0, 0.0), (70.0, 95.0), value=MU),
    Ellipsoid((-42.0, 0.0), (13.0, 13.0), value=MU),
]
FAN = FanBeam(full_turn(240), 600.0, 1100.0, 160, 3.0)
GRID = VolumeGrid((80, 80), 3.0)
LINES = line_integrals(FAN, BODY, sub=1)
SHONE = np.exp(-LINES)


def counted(shone=SHONE, air=AIR, seed=0):
    return np.random.default_rng(seed).poisson(air * shone).astype(float)


def water(volume):
    """Mean HU of the water in the middle."""
    y, x = np.meshgrid(*GRID.axes, indexing="ij")
    at = np.hypot(y - 2, x + 3) < 22
    return float(volume.data[torch.from_numpy(at)].mean())


def warnings_of(readings, **description):
    return reading_warnings(
        repair_defects(Scan.from_counts(readings, FAN, mu_water=MU, **description))[0]
    )


def test_transmissions_are_no_counts():
    """Half a photon more made -790 HU of water; percentages -50 HU."""
    n = counted()
    for whole in (1.0, 100.0):
        scan = Scan.from_counts(whole * n / AIR, FAN, air=whole, mu_water=MU)
        assert abs(water(reconstruct(scan, GRID, "fbp"))) < 3
        assert float(scan.air.mean()) == pytest.approx(AIR, rel=0.15)  # the photons, from the noise
        assert reading_warnings(scan) == []
        torch.testing.assert_close(
            scan.weights(),
            Scan.from_counts(n, FAN, air=AIR, mu_water=MU).weights(),
            rtol=0.15,
            atol=0,
        )
    for air in (60.0, 1.5):  # counts stay what they are, however few
        low = counted(air=air)
        scan = Scan.from_counts(low, FAN, air=air)
        assert torch.equal(scan.counts, torch.from_numpy(low).float())


@pytest.mark.parametrize("known", [5.0, None])
def test_a_photon_or_two_under_electronic_noise_are_counts_too(known):
    """They were taken for transmissions of a million photons."""
    rng = np.random.default_rng(0)
    n, dark = rng.normal(counted(air=1.8), 5.0), rng.normal(0.0, 5.0, (400, 160))
    scan = Scan.from_counts(n, FAN, air=1.8, dark=dark, electronic_noise=known)
    assert scan.info["signal_of_one_photon"] == 1.0
    assert float(scan.air.mean()) == pytest.approx(1.8, abs=0.1)
    # Transmissions of a scan that is too small to tell their noise stay what they are.
    two = ParallelBeam(np.zeros(2), 4, 1.0)
    few = Scan.from_counts(np.exp(-np.linspace(0.0, 1.0, 8).reshape(2, 4)), two, air=1.0)
    assert few.info["signal_of_one_photon_from"] == "assumed of transmissions"


def test_the_gain_is_that_of_air_frames_however_uneven_the_field():
    """Behind a bowtie one photon was 1.7: each frame was divided by the reading of one cell."""
    profile = np.exp(-1.5 * np.linspace(-1, 1, FAN.columns) ** 2)
    rng = np.random.default_rng(5)
    for gain in (1.0, 4.0):
        frames = gain * rng.poisson(1e4 * profile * np.linspace(1.0, 1.1, 16)[:, None])
        counts = gain * rng.poisson(1e4 * profile * SHONE)
        scan = Scan.from_counts(counts.astype(float), FAN, air=frames.astype(float), mu_water=MU)
        assert scan.info["signal_of_one_photon"] == pytest.approx(gain, rel=0.06)


def test_the_logarithm_of_few_counts_is_not_biased():
    rng = np.random.default_rng(0)
    for mean in (0.5, 1.0, 2.0, 5.0, 30.0):
        n = torch.from_numpy(rng.poisson(mean, (60, 2000)).astype(np.float32))
        lines = torch.log(n + 0.5) - log_bias(smoothed(n, None, False))
        # 0.48 at half a count, 0.17 at one
        assert float(lines.mean()) == pytest.approx(np.log(mean), abs=0.04)
    few = 0.2 * AIR**0.5 / SHONE.mean() / 4
    scan = Scan.from_counts(counted(air=few), FAN, air=few, mu_water=MU)
    assert 8 < float(scan.counts.mean()) < 20
    assert abs(water(reconstruct(scan, GRID, "fbp"))) < 30  # -75 HU


@pytest.mark.parametrize("gain", [1.0, 60.0])
@pytest.mark.parametrize(
    ("noise", "means"), [(1.0, (1.0, 2.0, 5.0)), (4.0, (4.0, 7.0, 15.0)), (200.0, (180.0, 700.0))]
)
def test_nor_is_that_of_few_counts_with_electronic_noise(noise, means, gain):
    """0.11 at seven counts over four of electronic noise, before."""
    g = ParallelBeam(full_turn(60), 400, 1.0)
    for mean in means:
        rng = np.random.default_rng(3)
        y = gain * (rng.poisson(mean, g.shape) + noise * rng.standard_normal(g.shape))
        scan = Scan.from_counts(y, g, air=100.0 * mean * gain, gain=gain, electronic_noise=noise)
        assert float(scan.line_integrals().mean()) == pytest.approx(math.log(100.0), abs=0.045)


@pytest.mark.parametrize("dead", [False, True])
def test_weights_do_not_follow_electronic_noise(dead):
    """Bright noise weighed more: 0.11 too low."""
    g = ParallelBeam(full_turn(60), 400, 1.0)
    rng = np.random.default_rng(8)
    y = rng.poisson(8.0, g.shape) + 4.0 * rng.standard_normal(g.shape)
    mask = rng.random(g.shape) < 0.05 * dead
    scan = Scan.from_counts(y, g, air=800.0, electronic_noise=4.0, dead=mask)
    p, w = scan.line_integrals(), scan.weights()
    assert bool((w[torch.from_numpy(mask)] == 0.0).all())
    mean = float((w * p).sum() / w.sum())
    assert mean == pytest.approx(math.log(100.0), abs=0.04)
    # As much in all as the variance says.
    assert float(w[w > 0].mean()) == pytest.approx(8.0**2 / (8.0 + 16.0), rel=0.15)


WRONG = {
    "an offset below both": (
        lambda: counted() + 2000.0,
        {"air": AIR + 2000.0},
        "over an offset of",
    ),
    "an offset below the readings": (lambda: counted() + 2000.0, {"air": AIR}, "over an offset of"),
    "scatter": (
        lambda: counted(SHONE + 0.05),
        {"air": AIR},
        r"beside the object are 4\.[89] % brighter",
    ),
    "full well": (
        lambda: np.minimum(counted(), 0.5 * AIR),
        {"air": AIR},
        "the detector is saturated",
    ),
    "full well in air, too": (
        lambda: np.minimum(counted(), 0.5 * AIR),
        {"air": 0.5 * AIR},
        "detector is saturated",
    ),
    "line integrals": (lambda: LINES.clip(0), {"air": 1.0}, "line integrals given as counts"),
    "line integrals, scaled": (
        lambda: 1000 * LINES.clip(0),
        {"air": 1e4},
        "darkest .* given as counts",
    ),
    "another beam's air": (counted, {"air": 0.5 * AIR}, "more than 1.5 times as bright as air"),
    "no light": (lambda: counted(air=6.0), {"air": 6.0}, r"leave less than 0\.3 photons"),
}


@pytest.mark.parametrize("what", WRONG)
def test_a_wrong_description_is_named(what):
    readings, description, expected = WRONG[what]
    found = warnings_of(readings(), **description)
    assert len(found) == 1
    assert re.search(expected, found[0])


@pytest.mark.filterwarnings("ignore:the rows end inside")
def test_transmissions_given_as_line_integrals_are_named_by_every_method(caplog):
    scan = Scan.from_line_integrals(counted() / AIR, FAN, mu_water=MU)
    for method in ("fbp", "pwls"):
        caplog.clear()
        assert "given as line integrals" in reconstruct(scan, GRID, method).report["warnings"][0]
        assert caplog.text.count("given as line integrals") == 1


@pytest.mark.parametrize("air", [30.0, 1e3, 1e5])
@pytest.mark.parametrize(
    "kind", ["parallel", "fan", "cone", "cut off", "metal", "bowtie", "blurred", "lines"]
)
def test_sound_scans_are_not_accused(kind, air):
    rng, profile, bodies = np.random.default_rng(3), np.ones(96), list(BODY)
    g = {
        "parallel": ParallelBeam(full_turn(120) / 2, 96, 2.4),
        "cone": ConeBeam(full_turn(90), 600.0, 1100.0, 96, 3, (4.0, 4.6)),
        "cut off": FanBeam(full_turn(120), 600.0, 1100.0, 96, 2.5),
    }.get(kind, FanBeam(full_turn(120), 600.0, 1100.0, 96, 4.6))
    if kind == "metal":
        bodies += [
            Ellipsoid((-30.0, 30.0), (6.0, 9.0), value=2.0),
            Ellipsoid((40.0, -20.0), (2.5, 2.5), value=5.0),
        ]
    if kind == "bowtie":
        profile = np.exp(-2.0 * np.linspace(-1, 1, 96) ** 2) * rng.uniform(0.9, 1.1, 96)
    n = rng.poisson(air * profile * np.exp(-0.7 * line_integrals(g, bodies, sub=1))).astype(float)
    if kind == "blurred":
        n = 0.25 * np.roll(n, 1, -1) + 0.5 * n + 0.25 * np.roll(n, -1, -1)
    if kind == "lines":
        scan = Scan.from_line_integrals(-np.log((n + 0.5) / air), g)
    else:
        scan = Scan.from_counts(n, g, air=np.broadcast_to(air * profile, g.shape[1:]))
    fixed, found = repair_defects(scan)
    assert (found, reading_warnings(fixed)) == ([], [])


def test_few_photons_in_air_are_not_brighter_than_air():
    """Every sixth reading of three photons is more than 1.5 times as bright as they are."""
    for air in (2.5, 4.0):
        found = warnings_of(counted(np.sqrt(SHONE), air=air), air=air)
        assert not any("bright as air" in text for text in found)
    (found,) = warnings_of(counted(np.sqrt(SHONE), air=8.0), air=4.0)
    assert "bright as air" in found
    # Electronic noise above the signal: the mean is that of air, that of the logarithm is not.
    noisy = counted(np.sqrt(SHONE), air=9.0)
    noisy += 8.0 * np.random.default_rng(1).standard_normal(SHONE.shape)
    found = warnings_of(noisy, air=9.0, electronic_noise=8.0)
    assert not any("brighter than air" in text for text in found)


def without_lost(shone, share, prolonged, seed=0):
    """Counts of a detector that loses a share of those in air to its dead time, of the variance
    that leaves (binomial), over those in air."""
    rate = share * shone  # times the dead time
    kept, lack = (
        (np.exp(-rate), 2.0 * rate * np.exp(-rate))
        if prolonged
        else (1.0 / (1.0 + rate), 1.0 - (1.0 + rate) ** -2)
    )
    in_air = math.exp(-share) if prolonged else 1.0 / (1.0 + share)
    mean = 2e4 * shone * kept
    counts = np.random.default_rng(seed).binomial(np.round(mean / lack).astype(int), lack)
    return counts.astype(float), 2e4 * in_air


@pytest.mark.parametrize("prolonged", [True, False])
@pytest.mark.parametrize("share", [0.1, 0.15, 0.3])
def test_counts_lost_to_a_dead_time_are_named_by_their_noise(share, prolonged):
    counts, air = without_lost(SHONE, share, prolonged)
    (found,) = warnings_of(counts, air=air)
    assert "pile-up" in found
    size = float(re.search(r"loses ([\d.]+) %", found).group(1))
    assert size == pytest.approx(100.0 * share, abs=2.0 + 25.0 * share)
    # The same counts by photons that are not spaced: another object's.
    rng = np.random.default_rng(1)
    assert warnings_of(rng.poisson(counts).astype(float), air=air) == []


def test_filtered_readings_lack_noise_everywhere_and_are_no_pile_up():
    n = counted(air=2e4)
    for kept in (0.95, 0.8):  # the rest is read in the next view
        assert warnings_of(kept * n + (1.0 - kept) * np.roll(n, 1, 0), air=2e4) == []


def test_bridging_is_linear_and_knows_nothing_of_the_dead():
    ramp = (
        2.0 * torch.arange(9.0) + torch.arange(4.0)[:, None] * 5 + torch.arange(3.0)[:, None, None]
    )
    dead = torch.zeros(3, 4, 9, dtype=torch.bool)
    dead[1, :, 4:6] = True
    dead[2, 1] = True  # a whole row
    broken = torch.where(dead, math.nan, ramp)
    torch.testing.assert_close(interpolate_dead(broken, dead, rows=True), ramp)
    edge = torch.where(torch.arange(9) < 2, math.inf, ramp[0])
    torch.testing.assert_close(
        interpolate_dead(edge, torch.arange(9) < 2, rows=True)[:, :2], ramp[0, :, 2:3].expand(-1, 2)
    )
    x = broken.double().requires_grad_()
    (gradient,) = torch.autograd.grad(interpolate_dead(x, dead, rows=True).sum(), x)
    assert gradient[dead].abs().max() == 0
    assert float(gradient.sum()) == dead.numel()
    with pytest.raises(ValueError, match="100 % of the readings of view 2 are dead"):
        interpolate_dead(ramp, (torch.arange(3) == 2)[:, None, None], rows=True)


def test_lost_columns_rows_and_views_of_linear_data_come_back():
    lines = (
        1
        + 0.1 * torch.arange(9.0)[:, None, None]
        - 0.2 * torch.arange(5.0)[:, None]
        + 0.05 * torch.arange(11.0)
    )
    mask = torch.zeros(lines.shape, dtype=torch.bool)
    mask[:, :, 4:6] = mask[3] = mask[:, 2] = True
    broken = torch.where(mask, 1e9, lines)
    torch.testing.assert_close(interpolate_dead(broken, mask, rows=True, most=1.0), lines)


def test_at_the_edge_the_other_axis_serves_and_then_the_nearest():
    lines = (
        1
        + 0.1 * torch.arange(9.0)[:, None, None]
        - 0.2 * torch.arange(5.0)[:, None]
        + 0.05 * torch.arange(11.0)
    )
    mask = torch.zeros(lines.shape, dtype=torch.bool)
    mask[:, 2, 0] = True  # the rows beside it are alive
    torch.testing.assert_close(
        interpolate_dead(lines.masked_fill(mask, 1e9), mask, rows=True), lines
    )
    mask[:, :, 0] = mask[0] = True
    full = interpolate_dead(lines.masked_fill(mask, 1e9), mask, rows=True, most=1.0)
    torch.testing.assert_close(full[1:, :, 0], lines[1:, :, 1])
    torch.testing.assert_close(full[0, :, 1:], lines[1, :, 1:])
    with pytest.raises(ValueError, match="all readings are dead"):
        interpolate_dead(lines, torch.ones_like(mask), rows=True, most=1.0)


def test_logarithms_to_base_ten_are_told_by_how_their_noise_grows():
    """-560 HU of water without a word; of electronic noise alone the variance grows as exp(2 p)."""
    lines = np.log(AIR / counted())
    electronic = counted(air=4e4) + 150.0 * np.random.default_rng(1).standard_normal(SHONE.shape)
    electronic = np.log(4e4 / np.maximum(electronic, 1.0))

    def said(values):
        return reading_warnings(Scan.from_line_integrals(values, FAN, mu_water=MU))

    (text,) = said(lines / math.log(10.0))
    assert re.search(r"grows as exp\(2\.\d p\).*logarithms to base 10", text)
    for sound in (lines, LINES, electronic, 1.05 * lines, np.maximum(lines, 0.0)):
        assert said(sound) == []
    # A bow-tie filter darkens the beam where the object is thin.
    bowtie = np.exp(-1.5 * np.linspace(-1.0, 1.0, FAN.columns) ** 2)
    assert said(np.log(AIR * bowtie / np.maximum(counted(SHONE * bowtie), 0.5))) == []


@pytest.mark.parametrize(("first", "copies"), [(0, 12), (45, 12), (20, 20), (20, 40)])
def test_views_that_were_stored_twice_are_no_dead_time(first, copies):
    """Copies of a view have no noise between them (42 % less variance than photons have), and
    reach the same highest values."""
    g = ConeBeam(full_turn(90), 570.0, 1040.0, 96, 6, (2.0, 4.6))
    n = np.random.default_rng(1).poisson(4e4 * np.exp(-line_integrals(g, ROUND, sub=1))) * 1.0
    n[first : first + copies] = n[first]
    assert reading_warnings(Scan.from_counts(n, g, air=4e4, mu_water=MU)) == []


def test_a_mask_is_no_readings():
    with pytest.raises(TypeError, match="array of real numbers"):
        Scan.from_counts(counted() > 100.0, FAN, air=AIR)


def test_a_tenth_of_edges_counts_little():
    values = np.random.default_rng(0).normal(scale=3.0, size=4000)
    assert quartile_sd(values) == pytest.approx(3.0, rel=0.05)
    values[::10] = 1e4
    assert quartile_sd(values) == pytest.approx(3.0, rel=0.25)
    assert np.std(values) > 1e3
