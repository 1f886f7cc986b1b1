"""Noise and resolution from two halves of one scan, against repeated draws and known spectra."""

import math

import numpy as np
import pytest
import torch
from analytic import Ellipsoid, line_integrals

from recon import reconstruct
from torchpcct import FanBeam, Scan, VolumeGrid, full_turn
from torchpcct.metrics.half_split import HalfSplit, half_split, halves

MU = 0.02
GEOMETRY = FanBeam(full_turn(240), 300.0, 500.0, 64, 1.7)
LINES = line_integrals(GEOMETRY, [Ellipsoid((0.0, 0.0), 25.0, value=MU)], sub=1)
GRID = VolumeGrid((24, 24), 1.0)


def draw(seed):
    counts = np.random.default_rng(seed).poisson(2000.0 * np.exp(-LINES)).astype(float)
    return Scan.from_counts(counts, GEOMETRY, air=2000.0, mu_water=MU)


def fbp(scan):
    return reconstruct(scan, GRID, "fbp", kernel="soft").data


def test_the_noise_is_that_of_repeated_scans():
    """SD of 576 voxels (about 60 independent) from 5 scans each: standard error 6 %."""
    truth = float(torch.stack([fbp(draw(seed)) for seed in range(8)]).var(0).mean().sqrt())
    found = [half_split(draw(100 + seed), fbp).noise() for seed in range(5)]
    assert math.sqrt(np.mean(np.square(found))) == pytest.approx(truth, rel=0.15)


def test_halves_are_every_other_view():
    scan = draw(0)
    views = halves(scan)
    assert [h.geometry.views for h in views] == [120, 120]
    assert torch.equal(views[1].counts, scan.counts[1::2])


def test_the_resolution_is_where_signal_and_noise_cross():
    """White noise and a signal up to a known frequency: the halves agree just as far."""
    generator = torch.Generator().manual_seed(0)
    radius = np.hypot(np.fft.fftfreq(128)[:, None], np.fft.fftfreq(128))
    low = torch.from_numpy(radius < 0.2)
    signal = torch.fft.ifft2(
        torch.fft.fft2(torch.randn(4, 128, 128, generator=generator).double()) * low
    ).real
    pair = [signal + 0.1 * torch.randn(4, 128, 128, generator=generator).double() for _ in range(2)]
    assert HalfSplit(*pair).resolution(0.5) == pytest.approx(0.2 / 0.5, rel=0.05)
    noise = [torch.randn(4, 128, 128, generator=generator) for _ in range(2)]
    assert HalfSplit(*noise).resolution(0.5) < 0.15


def test_the_transfer_is_the_blur_whatever_the_noise():
    """A Gaussian known in advance, and a method that blurs the signal but not its noise; noise
    power drops out."""
    generator = torch.Generator().manual_seed(1)
    square = np.fft.fftfreq(96)[:, None] ** 2 + np.fft.fftfreq(96) ** 2
    gauss = torch.from_numpy(0.5 ** (square / 0.12**2))
    signal = torch.randn(8, 96, 96, generator=generator).double()
    noise = [torch.randn(8, 96, 96, generator=generator).double() for _ in range(4)]
    reference = HalfSplit(signal + 0.5 * noise[0], signal + 0.5 * noise[1])
    smooth = torch.fft.ifft2(torch.fft.fft2(signal) * gauss).real
    method = HalfSplit(smooth + 0.3 * noise[2], smooth + 0.3 * noise[3])
    assert method.f50(reference, 0.5) == pytest.approx(0.24, rel=0.04)
    f, t = method.transfer(reference, 0.5)
    np.testing.assert_allclose(t, 0.5 ** ((f * 0.5 / 0.12) ** 2), atol=0.06)
    assert reference.f50(reference, 0.5) == math.inf
    blurred = reference.blurred(0.24, 0.5)
    assert blurred.f50(reference, 0.5) == pytest.approx(0.24, rel=0.02)
    assert blurred.noise() < 0.5 * reference.noise()
    torch.testing.assert_close(reference.blurred(math.inf, 0.5).first, reference.first)
    # A sharp edge elsewhere speaks for the whole image, but not for the part beside it.
    step = torch.zeros(96, 96, dtype=torch.float64)
    step[:30, :30] = 100.0
    edge = [HalfSplit(pair.first + step, pair.second + step) for pair in (method, reference)]
    assert edge[0].f50(edge[1], 0.5) > 0.3
    beside = [pair.within(slice(32, 96), slice(32, 96)) for pair in edge]
    assert beside[0].f50(beside[1], 0.5) == pytest.approx(0.24, rel=0.08)
    with pytest.raises(ValueError, match="f50 must be greater than 0"):
        reference.blurred(0.0, 0.5)
    with pytest.raises(ValueError, match="reference has the shape"):
        HalfSplit(signal[0], signal[1]).transfer(reference, 0.5)


def test_what_cannot_be_split_is_refused():
    lines = Scan.from_line_integrals(LINES, GEOMETRY, photons=1e4)
    assert halves(lines)[0].logged
    with pytest.raises(ValueError, match="two voxels"):
        HalfSplit(torch.zeros(3, 3), torch.zeros(3, 3)).noise(np.eye(3) > 2)
