"""Scans that we did not simulate: raw readings of other detectors, and line integrals of other
software."""

import math

import numpy as np
import pytest
import torch
from analytic import Ellipsoid, line_integrals
from refusals import refusals

from recon import reconstruct
from torchpcct import ConeBeam, FanBeam, ParallelBeam, Scan, VolumeGrid, full_turn

MU = 0.02
BODY = [Ellipsoid((2.0, -3.0), (20.0, 26.0), value=MU)]
GEOMETRIES = {
    "parallel": ParallelBeam(np.arange(90) * math.pi / 90, 64, 1.0),
    "fan": FanBeam(full_turn(90), 300.0, 500.0, 64, 1.7),
    "cone": ConeBeam(full_turn(90), 300.0, 500.0, 64, 3, (1.5, 1.7)),
}
CYLINDER = GEOMETRIES["cone"]


def grid_of(geometry):
    return (
        VolumeGrid((2, 24, 24), (1.0, 2.0, 2.0))
        if isinstance(geometry, ConeBeam)
        else VolumeGrid((24, 24), 2.0)
    )


@pytest.fixture(scope="module")
def lines():
    return {name: line_integrals(g, BODY, sub=1) for name, g in GEOMETRIES.items()}


@pytest.mark.parametrize("kind", GEOMETRIES)
def test_raw_readings_give_back_their_line_integrals(kind, lines):
    """Any dark frame, gain, air frame and flux: the line integrals are those of the object."""
    g, p, rng = GEOMETRIES[kind], lines[kind], np.random.default_rng(1)
    air = 1e6 * rng.uniform(0.5, 1.5, g.shape[1:])
    dark, flux, gain = rng.uniform(90, 110, g.shape[1:]), rng.uniform(0.9, 1.1, g.views), 3.5
    beam = flux.reshape(-1, *[1] * (len(g.shape) - 1))
    raw = dark + gain * (air * beam * np.exp(-p))
    scan = Scan.from_counts(
        raw, g, air=dark + gain * air, dark=dark, gain=gain, flux=flux, mu_water=MU
    )
    np.testing.assert_allclose(scan.line_integrals().numpy(), p, atol=3e-5)
    inside = reconstruct(scan, grid_of(g), "fbp").data[..., 10:14, 10:14]
    assert float(inside.abs().max()) < 10  # water reads 0 HU
    # Attenuation instead of HU, where water means nothing.
    bare = Scan.from_counts(raw, g, air=dark + gain * air, dark=dark, gain=gain, flux=flux)
    volume = reconstruct(bare, grid_of(g), "fbp")
    assert volume.unit == "mm^-1"
    torch.testing.assert_close(
        volume.data[..., 10:14, 10:14], torch.full_like(inside, MU), rtol=0.01, atol=0
    )


@pytest.mark.parametrize("kind", GEOMETRIES)
def test_line_integrals_stay_what_they_are(kind, lines):
    g, p = GEOMETRIES[kind], lines[kind].copy()
    p[0, ..., 0] = -0.01  # noise in air
    scan = Scan.from_line_integrals(p, g, photons=1e5, mu_water=MU)
    np.testing.assert_allclose(scan.line_integrals().numpy(), p, atol=1e-6)
    np.testing.assert_allclose(scan.weights().numpy()[5:-5], (1e5 * np.exp(-p))[5:-5], rtol=0.35)
    assert (scan.unit, scan.logged) == ("HU", True)


def test_slices_are_reconstructed_one_by_one(lines):
    g, p = GEOMETRIES["fan"], lines["fan"]
    stack = Scan.from_line_integrals(np.stack([p, 0.5 * p]), g, photons=1e5, mu_water=MU)
    single = Scan.from_line_integrals(p, g, photons=1e5, mu_water=MU)
    volume = reconstruct(stack, VolumeGrid((2, 24, 24), 2.0), "fbp").data
    torch.testing.assert_close(
        volume[0], reconstruct(single, VolumeGrid((24, 24), 2.0), "fbp").data, atol=0.1, rtol=0
    )
    torch.testing.assert_close(volume[1], 0.5 * volume[0] - 500.0, atol=0.2, rtol=0)
    with pytest.raises(
        ValueError, match=r"2 slices needs a grid of shape \(2, 'y', 'x'\), got \(3, 24, 24\)"
    ):
        reconstruct(stack, VolumeGrid((3, 24, 24), 2.0), "fbp")


def test_dead_cells_do_not_spread(lines):
    """Masked, NaN, silent and air-less columns: within 2 % of a detector without them, and no
    weight."""
    g, p = GEOMETRIES["fan"], lines["fan"]
    counts, air = 1e6 * np.exp(-p), np.full(g.columns, 1e6)
    whole = reconstruct(Scan.from_counts(counts, g, air=air, mu_water=MU), grid_of(g), "fbp").data
    counts[:, 20], counts[:, 25], air[33] = np.nan, 0.0, 0.0
    counts[:, 40] *= 7.0  # a hot cell, which only the user knows
    mask = np.arange(g.columns) == 40
    scan = Scan.from_counts(counts, g, air=air, dead=mask, mu_water=MU)
    assert scan.info["dead_readings"] == 4 * g.views
    image = reconstruct(scan, grid_of(g), "fbp").data
    assert float((image - whole)[4:-4, 4:-4].abs().max()) < 20
    assert (scan.weights()[:, [20, 25, 33, 40]] == 0).all()
    assert (scan.weights()[:, [19, 26, 50]] > 0).all()


def test_a_photon_transfer_finds_the_gain():
    """50 air frames of 64 × 3 cells: the gain's standard error is √(2 / 49 / 192) = 1.5 %."""
    rng = np.random.default_rng(3)
    frames = 100.0 + 7.0 * rng.poisson(4000.0, (50, *CYLINDER.shape[1:])) * rng.uniform(
        0.98, 1.02, (50, 1, 1)
    )
    raw = 100.0 + 7.0 * rng.poisson(500.0, CYLINDER.shape)
    scan = Scan.from_counts(raw, CYLINDER, air=frames, dark=100.0)
    assert scan.info["signal_of_one_photon"] == pytest.approx(7.0, rel=0.06)
    assert float(scan.counts.mean()) == pytest.approx(500.0, rel=0.06)


def test_dark_frames_give_the_electronic_noise():
    rng = np.random.default_rng(4)
    dark = 50.0 + rng.normal(0, 6.0, (20, *CYLINDER.shape[1:]))
    raw = 50.0 + rng.poisson(30.0, CYLINDER.shape) + rng.normal(0, 6.0, CYLINDER.shape)
    scan = Scan.from_counts(raw, CYLINDER, air=1050.0, dark=dark, gain=1.0)
    assert scan.electronic_noise == pytest.approx(6.0, rel=0.1)
    starved = Scan.from_counts(raw - 25.0, CYLINDER, air=1050.0, dark=dark, gain=1.0)
    assert float(starved.counts.min()) < 0
    assert torch.isfinite(starved.line_integrals()).all()
    assert torch.isfinite(scan.line_integrals()).all()
    expected = 30.0**2 / (30.0 + scan.electronic_noise**2)
    assert float(scan.weights().mean()) == pytest.approx(expected, rel=0.2)


def test_weights_are_inverse_variances_and_do_not_follow_the_noise():
    """Weighting by the noisy counts themselves biases the mean of the logarithm by 1 / N, smooth
    weights far less."""
    mean, g = 20.0, ConeBeam(full_turn(60), 300.0, 500.0, 64, 9, 1.0)
    counts = np.random.default_rng(5).poisson(mean, g.shape).astype(float)
    scan = Scan.from_counts(counts, g, air=1000.0)
    p, w = scan.line_integrals().double(), scan.weights().double()
    assert float(w.mean()) == pytest.approx(mean, rel=0.01)
    assert float(p.var()) * mean == pytest.approx(1.0, rel=0.1)  # a Poisson logarithm at 20 counts
    truth, error = math.log(1000.0 / mean), 1 / math.sqrt(mean * p.numel())
    naive = counts + 0.5
    assert truth - float((naive * p.numpy()).sum() / naive.sum()) > 0.8 / mean
    assert abs(float((w * p).sum() / w.sum()) - truth) < 0.15 / mean + 4 * error


@pytest.mark.parametrize("modulated", [False, True])
def test_photons_are_estimated_from_noise(modulated):
    g = GEOMETRIES["fan"]
    flux = 1.0 + 0.8 * torch.from_numpy(np.cos(2 * g.angles)).float()[:, None] * modulated
    p = torch.linspace(0, 3, 64) + torch.zeros(g.views, 1)
    counts = torch.poisson(
        2e4 * flux * torch.exp(-p), generator=torch.Generator().manual_seed(0)
    ).clamp_min(1.0)
    noisy = -torch.log(counts / (2e4 * flux))
    scan = Scan.from_line_integrals(noisy, g, flux=flux[:, 0] if modulated else None)
    assert float(scan.air[0]) == pytest.approx(2e4, rel=0.1)
    assert scan.info["photons"].startswith("estimated")
    np.testing.assert_allclose(scan.line_integrals(), noisy, atol=1e-5)
    given = Scan.from_line_integrals(noisy, g, photons=2e4, flux=flux[:, 0])
    np.testing.assert_allclose(given.counts, counts, rtol=1e-4)
    with pytest.raises(ValueError, match=r"flux must have one number per view, \(\d+,\), got"):
        Scan.from_line_integrals(noisy, g, flux=np.ones(3))


def test_a_polynomial_linearises():
    g, t = GEOMETRIES["fan"], np.linspace(0, 2, 64)
    p = np.broadcast_to(t - 0.05 * t**2, (g.views, 64))
    scan = Scan.from_line_integrals(
        p, g, photons=1e6, linearisation=(1.0, 0.05, 0.005), mu_water=MU
    )
    expected = p + 0.05 * p**2 + 0.005 * p**3
    np.testing.assert_allclose(scan.line_integrals().numpy(), expected, atol=2e-6)
    slope = 1 + 0.1 * p + 0.015 * p**2
    np.testing.assert_allclose(
        scan.weights()[:, 4:-4], (1e6 * np.exp(-p) / slope**2)[:, 4:-4], rtol=0.01
    )


FIVE = np.full((90, 64), 5.0)


def scanned(readings=FIVE, air=10.0, **given):
    return Scan.from_counts(readings, GEOMETRIES["fan"], air=air, **given)


test_bad_readings_are_named = refusals(
    (
        r"shape \(3, 64\), the geometry needs \(\[slices,\] 90, 64\)",
        lambda: scanned(np.zeros((3, 64))),
    ),
    ("give dark=, or use from_line_integrals", lambda: scanned(np.full((90, 64), -1.0))),
    ("air must be one number, or have the shape", lambda: scanned(air=np.ones((5, 5)))),
    ("air is not brighter than dark", lambda: scanned(air=1.0, dark=5.0)),
    ("gain must be greater than 0", lambda: scanned(gain=0.0)),
    ("flux must be finite and greater than 0", lambda: scanned(flux=np.zeros(90))),
    ("dead must have the shape", lambda: scanned(dead=np.ones(7, bool))),
    ("mu_water must be greater than 0", lambda: scanned(mu_water=-1.0)),
    (
        "no line integrals",
        lambda: Scan.from_line_integrals(np.full((90, 64), 4000.0), GEOMETRIES["fan"]),
    ),
    ("real numbers", lambda: Scan.from_line_integrals(np.full((90, 64), "x"), GEOMETRIES["fan"])),
    (
        "mask of bool",
        lambda: Scan.from_line_integrals(np.ones((90, 64)), GEOMETRIES["fan"], dead=np.zeros(64)),
    ),
)


@pytest.mark.parametrize("method", ["fbp", "pwls"])
def test_readings_that_are_lost_for_a_while_are_counted_and_harmless(method, lines):
    """One cell, dead for a third of the turn, of thousands of counts: 40 times the noise once,
    and a white arc."""
    g = GEOMETRIES["fan"]
    n = np.random.default_rng(2).poisson(2e4 * np.exp(-lines["fan"])).astype(float)
    broken = n.copy()
    broken[20:50, 27] = 0.0
    volumes = [
        reconstruct(Scan.from_counts(v, g, air=2e4, mu_water=MU), grid_of(g), method)
        for v in (n, broken)
    ]
    assert [v.report["dead_readings"] for v in volumes] == [0, 30]
    first, *others = volumes[1].report["warnings"]
    assert first.startswith("1 cell that was dead for part of the views")
    assert len(others) == len(volumes[0].report["warnings"])
    assert float((volumes[1].data - volumes[0].data).std()) < 0.5 * float(
        volumes[0].data[8:16, 8:16].std()
    )
