"""Apodisation windows and ramp filters against integrals, published points and closed forms."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refused

from recon.analytic.ramp import KERNELS, apodization, fast_length, ramp_kernel

POINTS = {
    "soft": [1, 0.815, 0.4564, 0.1636, 0],
    "standard": [1, 0.9338, 0.7441, 0.4425, 0.0531],
    "bone": [1, 1.0485, 1.17, 1.2202, 0.9201],
    "ram-lak": [1, 1, 1, 1, 1],
}
QUARTERS = np.array([0, 0.25, 0.5, 0.75, 1])


@pytest.mark.parametrize("kernel", POINTS)
def test_windows_pass_through_the_published_points(kernel):
    np.testing.assert_allclose(apodization(kernel, QUARTERS), POINTS[kernel], atol=1e-12)
    np.testing.assert_array_equal(apodization(kernel, -QUARTERS), apodization(kernel, QUARTERS))
    np.testing.assert_array_equal(apodization(kernel, [1.01, 3.0]), 0)


def test_detail_lies_midway_between_standard_and_bone():
    f = np.linspace(0, 1, 101)
    middle = (apodization("standard", f) + apodization("bone", f)) / 2
    np.testing.assert_allclose(apodization("detail", f), middle, atol=1e-12)


@pytest.mark.parametrize("kernel", KERNELS)
def test_spatial_kernel_is_the_integral_of_the_apodised_ramp(kernel):
    pitch = 0.7
    nodes, weights = np.polynomial.legendre.leggauss(400)
    x = np.concatenate([(q + (nodes + 1) / 8) for q in QUARTERS[:-1]])
    # breaks of the spline lie at the quarters' midpoints too: many nodes make up for them
    w = np.tile(weights / 8, 4)
    m = np.arange(40)
    nyquist = 1 / (2 * pitch)
    integral = 2 * nyquist**2 * (np.cos(np.pi * m[:, None] * x) * x * apodization(kernel, x)) @ w
    np.testing.assert_allclose(ramp_kernel(40, pitch, kernel), integral, atol=2e-8 / pitch**2)


def test_ram_lak_is_the_closed_form():
    h = ramp_kernel(9, 0.5)
    expected = np.zeros(9)
    expected[0] = 1 / (4 * 0.25)
    m = np.arange(1, 9, 2)
    expected[m] = -1 / (np.pi * m * 0.5) ** 2
    np.testing.assert_allclose(h, expected, rtol=1e-12, atol=1e-15)
    alpha = 0.01
    curved = ramp_kernel(9, alpha, equiangular=True)
    np.testing.assert_allclose(curved[m], -1 / (np.pi * np.sin(m * alpha)) ** 2, rtol=1e-12)
    assert curved[0] == pytest.approx(1 / (4 * alpha**2), rel=1e-14)


@pytest.mark.parametrize("kernel", KERNELS)
def test_spatial_kernel_keeps_the_mean_that_sampling_the_ramp_loses(kernel):
    """Sampling |f| instead sets the mean of the image to 0 (Kak and Slaney, chapter 3.3)."""
    n, pitch = 200, 0.8
    h = ramp_kernel(n, pitch, kernel) * pitch
    response = np.fft.rfft(np.concatenate([h, [0.0], h[:0:-1]])).real
    f = np.arange(response.size) / (2 * (response.size - 1)) / pitch
    ideal = f * apodization(kernel, np.clip(2 * f * pitch, 0, 1))
    # what lies beyond the truncated kernel is missing from the DC term: 2 Σ_{odd m ≥ n} 1/(π m)² ≈ 1/(π² n), per pitch
    assert response[0] == pytest.approx(1 / (np.pi**2 * n * pitch), rel=0.02)
    assert np.abs(response - ideal).max() < 2 / (np.pi**2 * n * pitch)


@settings(max_examples=40, deadline=None)
@given(n=st.integers(1, 5000))
def test_fast_length(n):
    m = fast_length(n)
    assert m >= n
    assert m % 2 == 0
    assert m <= max(2, 2 * n)
    for p in (2, 3, 5):
        while m % p == 0:
            m //= p
    assert m == 1


def test_bad_kernels_name_the_options():
    refused(
        ("one of soft, standard, detail, bone, ram-lak", lambda: ramp_kernel(3, 1.0, "sharp")),
        ("at least 1 sample", lambda: ramp_kernel(0, 1.0)),
        ("greater than 0", lambda: ramp_kernel(3, 0.0)),
        ("180°", lambda: ramp_kernel(400, 0.01, equiangular=True)),
    )
