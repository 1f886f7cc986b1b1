"""Noise at matched resolution against filters that are really applied, and transfer functions of known blur."""

import math

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.special import erf

from torchpcct import VolumeGrid
from torchpcct.metrics import (
    LinearReference,
    NoiseCovariance,
    RegionNoise,
    TransferFunction,
    edge_mask,
    ellipsoid_distance,
    gaussian_to_reach,
    jackknifed_f50,
    matched_noise_ratio,
    task_transfer,
)

STEP = (0.25, 0.2, 0.2)
F = np.linspace(0, 2.4, 481)


def gaussian_ttf(sigma):
    return TransferFunction(F, np.exp(-2 * (math.pi * sigma * F) ** 2), F, F)


def f50_of(sigma):
    return math.sqrt(math.log(2) / 2) / (math.pi * sigma)


def periodic(x, sigma, sigma_z):
    """Gaussian filter by its transfer function on a ring: what the formula integrates."""
    axes = [np.fft.fftfreq(n, h) for n, h in zip(x.shape[-3:], STEP, strict=True)]
    exponent = (sigma_z * axes[0])[:, None, None] ** 2 + (sigma * axes[1])[:, None] ** 2 + (sigma * axes[2]) ** 2
    return np.fft.ifftn(np.fft.fftn(x, axes=(-3, -2, -1)) * np.exp(-2 * math.pi**2 * exponent), axes=(-3, -2, -1)).real


def white(n, shape=(24, 24, 24), seed=0):
    return 10.0 * np.random.default_rng(seed).standard_normal((n, *shape))


def delta(lags=8):
    row = np.zeros((2 * lags + 1,) * 3)
    row[lags, lags, lags] = 100.0
    return NoiseCovariance.exact(row, STEP)


def test_white_noise_in_closed_form():
    """σ² h³ ∏ ∫ exp(−4π²σ²f²) df; lag by lag a Gaussian of √2 σ along z."""
    sigma, sigma_z = 0.35, 0.45
    c = delta(12)
    expected = 100.0
    for s, h in zip((sigma_z, sigma, sigma), STEP, strict=True):
        expected *= h * erf(math.pi * s / h) / (2 * math.sqrt(math.pi) * s)
    assert c.filtered(sigma, sigma_z) == pytest.approx(expected, rel=1e-12)
    # Beyond 0.4 voxels the Nyquist limit no longer matters.
    ratio = c.filtered(sigma, sigma_z, lag_z=0.5) / c.filtered(sigma, sigma_z)
    assert ratio == pytest.approx(math.exp(-(0.5**2) / (4 * sigma_z**2)), rel=1e-3)
    assert c.filtered(0.0, 0.0) == pytest.approx(100.0, rel=1e-12)
    assert c.filtered(0.0, 0.0, lag_z=0.25) == pytest.approx(0.0, abs=1e-9)


def test_is_the_integral_of_the_spectrum():
    """Coloured noise with a spectrum on a ring: Σ C w = ∫ NPS G², where the ring is longer than all lags that count."""
    shape = (41, 41, 41)
    impulse = np.zeros(shape)
    impulse[20, 20, 20] = 1.0
    kernel = gaussian_filter(impulse, 1.0) - 0.9 * gaussian_filter(impulse, 2.0)  # a band, as FBP's noise
    power = np.abs(np.fft.fftn(kernel)) ** 2
    row = np.fft.fftshift(np.fft.ifftn(power).real)
    found = NoiseCovariance.exact(row, STEP).filtered(0.3, 0.4)
    axes = [np.fft.fftfreq(41, h) for h in STEP]
    f2 = (0.4 * axes[0])[:, None, None] ** 2 + (0.3 * axes[1])[:, None] ** 2 + (0.3 * axes[2]) ** 2
    assert found == pytest.approx(float((power * np.exp(-4 * math.pi**2 * f2)).mean()), rel=1e-4)


def test_from_realisations():
    """Without bias, although the region is small: the mean over regions of noise that is filtered for real."""
    x = periodic(white(60, seed=1), 0.25, 0.2)
    part = x[:, :18, :18, :18]
    estimate = NoiseCovariance.of(part, STEP, 1.2)
    true = periodic(x, 0.2, 0.2).var(0, ddof=1).mean()
    assert estimate.filtered(0.2, 0.2) == pytest.approx(true, rel=0.03)
    # A periodogram of the part alone, on its own ring, loses covariance at its ends.
    ring = np.square(np.abs(np.fft.fftn(part - part.mean(0), axes=(1, 2, 3)))).sum(0) / 59 / 18**3
    axes = [np.fft.fftfreq(18, h) for h in STEP]
    f2 = axes[0][:, None, None] ** 2 + axes[1][:, None] ** 2 + axes[2] ** 2
    assert (ring * np.exp(-((2 * math.pi * 0.2) ** 2) * f2)).mean() < 0.97 * true
    lagged = np.mean((x - x.mean(0))[:, 1:] * (x - x.mean(0))[:, :-1]) * 60 / 59
    assert estimate.filtered(0.0, 0.0, lag_z=0.25) == pytest.approx(lagged, rel=0.03)


def test_one_left_out():
    x = white(5, (9, 9, 9))
    c = NoiseCovariance.of(x, STEP, 0.6)
    for k in range(5):
        rest = NoiseCovariance.of(np.delete(x, k, 0), STEP, 0.6)
        # The mean of the rest is another one: its deviations give the same sum.
        assert c.filtered(0.1, 0.1, leave=k) == pytest.approx(rest.filtered(0.1, 0.1), rel=1e-9)


def test_sigma_of_known_blurs():
    """Gaussian blurs add in square."""
    for own, wanted in ((0.2, 0.35), (0.3, 0.3)):
        sigma = gaussian_to_reach(gaussian_ttf(own), f50_of(wanted))
        assert sigma == pytest.approx(math.sqrt(wanted**2 - own**2), abs=5e-3)


def test_a_filtered_reference_matches_itself():
    """A "method" that is the reference through a Gaussian has the ratio 1 at its own resolution, noise and all."""
    x = periodic(white(60, (32, 24, 24), seed=2), 0.15, 0.15)
    method = periodic(x, 0.2, 0.3)
    noise = RegionNoise.of(method, STEP[1:])
    f50, f50_z = f50_of(math.hypot(0.15, 0.2)), f50_of(math.hypot(0.15, 0.3))
    own = gaussian_ttf(0.15)
    sampled = LinearReference(own, own, NoiseCovariance.of(x, STEP, 1.5))
    found = matched_noise_ratio(noise.log_variance, f50, f50_z, sampled)
    assert found.sigma_mm == pytest.approx(0.2, abs=2e-3)
    assert found.sigma_z_mm == pytest.approx(0.3, abs=2e-3)
    assert found.ratio.value == pytest.approx(1.0, abs=0.02)
    assert found.ratio.low < 1.005
    assert found.ratio.high > 0.995
    assert found.reference_sd_hu == pytest.approx(method.std(), rel=0.02)
    z = method - method.mean(0)
    neighbours = (z[:, 1:] * z[:, :-1]).mean() / np.square(z).mean()
    assert found.reference_z_correlation == pytest.approx(neighbours, abs=0.02)
    # An exact covariance of the same noise: the filter 0.15 twice.
    impulse = np.zeros((25, 25, 25))
    impulse[12, 12, 12] = 100.0
    exact = LinearReference(own, own, NoiseCovariance.exact(periodic(impulse, 0.15 * 2**0.5, 0.15 * 2**0.5), STEP))
    other = matched_noise_ratio(noise.log_variance, f50, f50_z, exact)
    assert other.ratio.value == pytest.approx(1.0, abs=0.02)
    assert other.ratio.high > other.ratio.low
    # Resolution that is measured counts in the interval.
    f = {"value": f50, "left_out": f50 + 0.002 * np.random.default_rng(0).standard_normal(60)}
    wider = matched_noise_ratio(noise.log_variance, type(noise.log_variance)(**f), f50_z, exact)
    assert wider.ratio.high - wider.ratio.low > other.ratio.high - other.ratio.low


def test_directions_of_an_ellipsoid():
    """A ball blurred by 0.3 mm in plane and 0.6 mm along z shows each in its own direction.

    Voxels, and normals up to 12° off the direction, blur the sharper one to 0.31 mm."""
    grid = VolumeGrid((72, 72, 72), 0.2)
    distance = ellipsoid_distance(grid, (0, 0, 0), (4.0, 4.0, 4.0))
    ball = np.clip(0.5 - distance / 0.2, 0, 1) * 60
    image = gaussian_filter(ball, [3.0, 1.5, 1.5])
    f50 = {
        along: task_transfer(image, distance, (2.5, 2.5), 0.1, edge_mask(distance, 0.2, along, 12)).f50
        for along in ("plane", "z")
    }
    assert f50["plane"] == pytest.approx(f50_of(0.3), rel=0.08)
    assert f50["z"] == pytest.approx(f50_of(0.6), rel=0.05)
    draws = image + np.random.default_rng(0).normal(0, 3, (6, *image.shape))
    mask = edge_mask(distance, 0.2, "plane", 20)
    found = jackknifed_f50(draws, distance, (2.5, 2.5), 0.1, mask)
    assert found.value == pytest.approx(f50["plane"], rel=0.05)
    third = task_transfer(np.delete(draws, 2, 0).mean(0), distance, (2.5, 2.5), 0.1, mask).f50
    assert found.left_out[2] == pytest.approx(third, rel=1e-6)


def test_refusals():
    own = gaussian_ttf(0.3)
    with pytest.raises(ValueError, match="sharper kernel"):
        gaussian_to_reach(own, f50_of(0.2))
    with pytest.raises(ValueError, match="ends at"):
        gaussian_to_reach(own, 9.0)
    with pytest.raises(ValueError, match="raise its reach"):
        delta(3).filtered(1.0, 0.2)
    with pytest.raises(ValueError, match="third"):
        NoiseCovariance.of(white(4, (9, 9, 9)), STEP, 2.0)
    with pytest.raises(ValueError, match="odd"):
        NoiseCovariance.exact(np.ones((4, 4, 4)), STEP)
    with pytest.raises(ValueError, match="leave out"):
        delta().filtered(0.1, 0.1, leave=0)
    distance = ellipsoid_distance(VolumeGrid((6, 20, 20), 0.3), (0, 0, 0), (math.inf, 2.0, 2.0))
    with pytest.raises(ValueError, match="faces z"):
        edge_mask(distance, 0.3, "z")
    noise = RegionNoise.of(white(5), STEP[1:]).log_variance
    with pytest.raises(ValueError, match="pair them by seed"):
        matched_noise_ratio(noise, 0.4, 0.4, LinearReference(own, own, NoiseCovariance.of(white(4), STEP, 1.0)))
