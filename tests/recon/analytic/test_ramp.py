"""Apodisation windows and ramp filters against integrals, published points and closed forms."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refused

from recon.analytic.ramp import _POINTS, apodization, fast_length, ramp_kernel
from recon.names import KERNELS

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


def test_the_equiangular_kernel_is_the_closed_form():
    alpha, m = 0.01, np.arange(1, 9, 2)
    h = ramp_kernel(9, alpha, equiangular=True)
    np.testing.assert_allclose(h[m], -1 / (np.pi * np.sin(m * alpha)) ** 2, rtol=1e-12)
    np.testing.assert_allclose(
        h[::2], [1 / (4 * alpha**2), 0, 0, 0, 0], rtol=1e-12, atol=1e-12 / alpha**2
    )


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


def test_every_kernel_that_has_a_name_has_its_points():
    assert tuple(_POINTS) == KERNELS
