"""Noise power spectra against filtered white noise, whose spectrum is known."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refusals

from torchpcct.metrics import noise_power_spectrum


def coloured(shape, spacing, sigma, n, seed, sd=10.0):
    """White noise of ``sd`` HU filtered by a Gaussian of ``sigma`` mm, and its exact NPS."""
    f = np.meshgrid(
        *(np.fft.fftfreq(k, s) for k, s in zip(shape, spacing, strict=True)), indexing="ij"
    )
    gain = np.exp(-2 * (math.pi * sigma) ** 2 * sum(np.square(a) for a in f))
    noise = sd * np.random.default_rng(seed).standard_normal((n, *shape))
    axes = tuple(range(1, noise.ndim))
    return np.fft.ifftn(np.fft.fftn(noise, axes=axes) * gain, axes=axes).real, sd**2 * math.prod(
        spacing
    ) * gain**2


@pytest.mark.parametrize(
    ("shape", "spacing"), [((24, 30), (0.3, 0.2)), ((8, 12, 10), (0.4, 0.25, 0.2))]
)
def test_filtered_white_noise(shape, spacing):
    realisations, exact = coloured(shape, spacing, 0.25, 400, 1)
    object_ = np.linspace(-500, 500, math.prod(shape)).reshape(shape)
    spectrum = noise_power_spectrum(torch.from_numpy(realisations + object_), spacing)
    assert spectrum.power.shape == shape
    strong = exact > 1e-3 * exact.max()
    ratio = spectrum.power[strong] / exact[strong]
    # Each frequency has about 400 exponential samples: SD 5 %.
    assert ratio.mean() == pytest.approx(1, abs=0.01)
    assert ratio.std() == pytest.approx(0.05, rel=0.35)
    volume = math.prod(shape) * math.prod(spacing)
    assert spectrum.variance == pytest.approx(exact.sum() / volume, rel=0.02)


@settings(max_examples=25, deadline=None)
@given(st.integers(2, 6), st.integers(0, 99), st.sampled_from([(7, 6), (4, 5, 6)]))
def test_integral_is_the_unbiased_variance(n, seed, shape):
    x = np.random.default_rng(seed).normal(40, 12, (n, *shape)) + np.arange(shape[-1])
    spectrum = noise_power_spectrum(x, tuple(0.2 + 0.1 * k for k in range(len(shape))))
    assert spectrum.variance == pytest.approx(x.var(0, ddof=1).mean(), rel=1e-12)
    assert spectrum.realisations == n
    assert spectrum.power.flat[0] >= 0


def test_radial_mean_of_an_isotropic_spectrum():
    realisations, _ = coloured((32, 32), (0.25, 0.25), 0.3, 300, 2)
    f, power = noise_power_spectrum(realisations, 0.25).radial()
    expected = 100 * 0.25**2 * np.exp(-4 * (math.pi * 0.3 * f) ** 2)
    assert f[0] == 0
    assert f[-1] <= 2.0
    strong = expected > 0.02 * expected[0]
    assert strong.sum() >= 5
    np.testing.assert_allclose(power[strong][1:], expected[strong][1:], rtol=0.08)


ZEROS = np.zeros((5, 4, 4))
test_refusals = refusals(
    ("n ≥ 2", lambda: noise_power_spectrum(ZEROS[:1], 0.2)),
    ("n ≥ 2", lambda: noise_power_spectrum(ZEROS[0], 0.2)),
    ("spacing", lambda: noise_power_spectrum(ZEROS, (0.2,))),
    ("spacing", lambda: noise_power_spectrum(ZEROS, -0.2)),
    ("NaN", lambda: noise_power_spectrum(ZEROS * np.nan, 0.2)),
)
