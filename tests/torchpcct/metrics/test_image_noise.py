"""Noise of a uniform region on noise of known spectrum."""

import math

import numpy as np
import pytest

from torchpcct.metrics import RegionNoise, central_frequency_ratio, noise_magnitude_ratio, noise_power_spectrum

STEP = 0.25


def noise(n, shape, sigma_mm=0.0, seed=0):
    """White noise of SD 10 through a periodic Gaussian of σ."""
    white = 10.0 * np.random.default_rng(seed).standard_normal((n, *shape))
    f2 = np.fft.fftfreq(shape[-2], STEP)[:, None] ** 2 + np.fft.fftfreq(shape[-1], STEP) ** 2
    return np.fft.ifft2(np.fft.fft2(white) * np.exp(-2 * (math.pi * sigma_mm) ** 2 * f2)).real


def test_is_the_mean_spectrum_of_the_slices():
    x = noise(5, (3, 12, 12), 0.2)
    region = RegionNoise.of(x, STEP)
    spectra = [noise_power_spectrum(x[:, k], STEP).radial() for k in range(3)]
    np.testing.assert_allclose(region.frequencies, spectra[0][0])
    np.testing.assert_allclose(region.radial, np.mean([p for _, p in spectra], axis=0))
    assert math.exp(region.log_variance.value) == pytest.approx(x.var(0, ddof=1).mean())
    left = [math.log(np.delete(x, k, 0).var(0, ddof=1).mean()) for k in range(5)]
    np.testing.assert_allclose(region.log_variance.left_out, left)
    assert region.spatial_sd_hu.value == pytest.approx(math.sqrt(x.var(axis=(-1, -2), ddof=1).mean()))


def test_sd_of_known_noise():
    """SD 10 across realisations; the spatial one adds what is not uniform in the mean image."""
    shade = 20.0 * np.sin(np.linspace(0, 2 * np.pi, 16, endpoint=False))
    region = RegionNoise.of(noise(80, (4, 16, 16)) + shade, STEP)
    assert region.sd_hu.low < 10 < region.sd_hu.high
    assert region.sd_hu.high / region.sd_hu.low < 1.03
    assert region.spatial_sd_hu.value == pytest.approx(math.hypot(10, 20 / math.sqrt(2)), rel=0.02)


def test_ratios_of_gaussian_noise():
    """∫ exp(−4π²σ²f²) df and its first moment, in closed form."""
    sharp, soft = 0.2, 0.4
    x = noise(200, (4, 32, 32), sharp, seed=1)
    f2 = np.fft.fftfreq(32, STEP)[:, None] ** 2 + np.fft.fftfreq(32, STEP) ** 2
    blurred = np.fft.ifft2(np.fft.fft2(x) * np.exp(-2 * math.pi**2 * (soft**2 - sharp**2) * f2)).real
    reference, method = RegionNoise.of(x, STEP), RegionNoise.of(blurred, STEP)
    limit = reference.frequencies[-1]

    def area(s):
        return math.erf(2 * math.pi * s * limit) / (4 * math.sqrt(math.pi) * s)

    def mean(s):
        return (1 - math.exp(-((2 * math.pi * s * limit) ** 2))) / (8 * (math.pi * s) ** 2) / area(s)

    nmr, cfr = noise_magnitude_ratio(method, reference), central_frequency_ratio(method, reference)
    assert nmr.value == pytest.approx(math.sqrt(area(soft) / area(sharp)), rel=0.01)
    assert cfr.value == pytest.approx(mean(soft) / mean(sharp), rel=0.01)
    for ratio in (nmr, cfr):
        assert ratio.low < ratio.value < ratio.high
        assert ratio.high / ratio.low < 1.03


def test_coverage_of_the_ratios():
    """Independent noise of the same SD and spectrum: both ratios are 1; 300 experiments, 95 % nominal."""
    hits = np.zeros(2)
    for s in range(300):
        a, b = (RegionNoise.of(noise(20, (8, 8), seed=2 * s + k), STEP) for k in (0, 1))
        found = noise_magnitude_ratio(a, b), central_frequency_ratio(a, b)
        hits += [f.low <= 1 <= f.high for f in found]
    assert (hits >= 0.92 * 300).all(), hits


def test_common_range_of_frequencies():
    """A finer grid of the same region has more frequencies: what the coarser one lacks does not count."""
    x = noise(40, (24, 24), 0.4, seed=5)
    wide = np.pad(np.fft.fftshift(np.fft.fft2(x), axes=(1, 2)), ((0, 0), (12, 12), (12, 12)))
    fine = 4 * np.fft.ifft2(np.fft.ifftshift(wide, axes=(1, 2))).real
    pair = RegionNoise.of(x, STEP), RegionNoise.of(fine, STEP / 2)
    assert noise_magnitude_ratio(*pair).value == pytest.approx(1.0, rel=0.02)
    assert central_frequency_ratio(*pair).value == pytest.approx(1.0, rel=0.02)


def test_refusals():
    with pytest.raises(ValueError, match="n ≥ 3"):
        RegionNoise.of(noise(2, (8, 8)), STEP)
    with pytest.raises(ValueError, match="NaN"):
        RegionNoise.of(np.full((4, 8, 8), np.nan), STEP)
    with pytest.raises(ValueError, match="spacing"):
        RegionNoise.of(noise(4, (8, 8)), -1.0)
    with pytest.raises(ValueError, match="do not vary"):
        _ = RegionNoise.of(np.ones((4, 8, 8)), STEP).sd_hu
    with pytest.raises(ValueError, match="limit"):
        RegionNoise.of(noise(4, (8, 8)), STEP).moment(0, 9.0)
    with pytest.raises(ValueError, match="same realisations"):
        noise_magnitude_ratio(RegionNoise.of(noise(4, (8, 8)), STEP), RegionNoise.of(noise(5, (8, 8)), STEP))
