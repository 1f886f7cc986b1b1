"""The channelised Hotelling observer against Gaussian closed forms."""

import math

import numpy as np
import pytest
import torch

from torchpcct import VolumeGrid
from torchpcct.metrics import (
    channel_responses,
    d_prime,
    dog_channels,
    hotelling_scores,
    observe,
    template_channel,
)


def pairs(n, channels=4, seed=0, correlation=0.0, separation=0.8):
    """Gaussian channel responses of known covariance and their ideal d′."""
    rng = np.random.default_rng((seed, n))
    root = np.linalg.cholesky(0.5 * np.eye(channels) + 0.5)
    difference = separation * np.linspace(1, 0.2, channels)
    common = rng.standard_normal((n, channels))
    a, b = (
        math.sqrt(correlation) * common
        + math.sqrt(1 - correlation) * rng.standard_normal((n, channels))
        for _ in range(2)
    )
    ideal = math.sqrt(difference @ np.linalg.solve(root @ root.T, difference))
    return a @ root.T + difference, b @ root.T, difference, ideal


def test_hotelling_reaches_the_ideal_observer():
    present, absent, _, ideal = pairs(1500, seed=1)
    s1, s0 = hotelling_scores(present, absent)
    assert s1.shape == (1500,)
    assert d_prime(s1, s0).value == pytest.approx(ideal, rel=0.06)


def test_leave_one_out_is_what_it_says():
    present, absent, _, _ = pairs(12, 3, seed=2)
    s1, s0 = hotelling_scores(present, absent)
    for k in range(12):
        a, b = np.delete(present, k, 0), np.delete(absent, k, 0)
        ma, mb = a.mean(0), b.mean(0)
        covariance = ((a - ma).T @ (a - ma) + (b - mb).T @ (b - mb)) / 20
        w = np.linalg.solve(covariance, ma - mb)
        assert s1[k] == pytest.approx((present[k] - (ma + mb) / 2) @ w, rel=1e-9)
        assert s0[k] == pytest.approx((absent[k] - (ma + mb) / 2) @ w, rel=1e-9)


def test_an_observer_without_signal_guesses():
    """Scores of the pairs it was trained on would claim a core that is not there."""
    honest, deceived = [], []
    for seed in range(20):
        present, absent, _, _ = pairs(30, 10, seed=seed, separation=0.0)
        honest.append(d_prime(*hotelling_scores(present, absent)).value)
        trained_on_all = np.linalg.solve(
            np.cov(present.T) + np.cov(absent.T), present.mean(0) - absent.mean(0)
        )
        deceived.append(d_prime(present @ trained_on_all, absent @ trained_on_all).value)
    assert abs(np.mean(honest)) < 0.3
    assert np.mean(deceived) > 0.8


def test_units_of_the_channels_do_not_matter():
    present, absent, _, _ = pairs(50, seed=4)
    units = np.array([1e-6, 1.0, 1e3, 1e7])
    for s, t in zip(
        hotelling_scores(present, absent),
        hotelling_scores(present * units, absent * units),
        strict=True,
    ):
        np.testing.assert_allclose(s, t, rtol=1e-6, atol=1e-9)


def test_d_prime_interval_coverage():
    covered = 0
    for seed in range(200):
        a, b = np.random.default_rng(seed).standard_normal((2, 50))
        result = d_prime(a + 1.5, b).estimate()
        covered += result.low <= 1.5 <= result.high
    assert 0.90 <= covered / 200 <= 0.985


@pytest.mark.parametrize(
    "grid", [VolumeGrid((64, 80), 0.25), VolumeGrid((24, 28, 32), (0.3, 0.25, 0.2))]
)
def test_channels_have_their_spectrum(grid):
    """In the frequency domain a channel is the difference of two Gaussians, at any spacing,
    place and dimension."""
    center = tuple(0.3 * s for s in grid.spacing)
    channels = dog_channels(grid, center, count=2, lowest=0.2)
    np.testing.assert_allclose(np.square(channels).sum(tuple(range(1, channels.ndim))), 1)
    f = np.sqrt(
        sum(
            np.square(a)
            for a in np.meshgrid(*map(np.fft.fftfreq, grid.shape, grid.spacing), indexing="ij")
        )
    )
    for k, channel in enumerate(channels):
        s = 0.2 * 1.4**k
        expected = np.exp(-0.5 * (f / (1.67 * s)) ** 2) - np.exp(-0.5 * (f / s) ** 2)
        spectrum = np.abs(np.fft.fftn(channel))
        spectrum *= (spectrum * expected).sum() / np.square(spectrum).sum()
        np.testing.assert_allclose(spectrum, expected, atol=0.01 * expected.max())


def test_channels_follow_the_core():
    grid = VolumeGrid((21, 21), 0.5, (10.0, -20.0))
    centred = dog_channels(grid, (10.0, -20.0))
    moved = dog_channels(grid, (11.0, -21.5))
    assert centred.shape == (10, 21, 21)
    # Norms differ by what leaves the grid; the narrowest channel lies well inside.
    np.testing.assert_allclose(moved[-1, 2:, :-3], centred[-1, :-2, 3:], atol=1e-6)
    assert np.unravel_index(moved[-1].argmax(), (21, 21)) == (12, 7)


def test_observer_on_images():
    """White noise and a known blob: with the blob as a channel the observer is the matched
    filter, d′ = |s| / σ."""
    grid = VolumeGrid((16, 16), 0.5)
    y, x = np.meshgrid(*grid.axes, indexing="ij")
    blob = -60 * np.exp(-(x**2 + y**2) / 2)
    noise = 120 * np.random.default_rng(6).standard_normal((2, 300, 16, 16))
    ideal = float(np.linalg.norm(blob)) / 120
    channels = np.concatenate([template_channel(blob), dog_channels(grid, (0.0, 0.0), 4)])
    result = observe(torch.from_numpy(100 + blob + noise[0]), 100 + noise[1], channels)
    assert result.left_out.shape == (300,)
    assert result.estimate().low < ideal < result.estimate().high


def test_responses_are_inner_products():
    images, channels = np.random.default_rng(7).standard_normal((2, 3, 4, 5))
    expected = np.einsum("nij,cij->nc", images, channels)
    np.testing.assert_allclose(
        channel_responses(torch.from_numpy(images), channels), expected, rtol=1e-12
    )


PRESENT, ABSENT, _, _ = pairs(20)


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: hotelling_scores(PRESENT, ABSENT[:5]), "pairs"),
        (lambda: hotelling_scores(PRESENT[:5], ABSENT[:5]), "too few"),
        (lambda: hotelling_scores(PRESENT[:, [0, 0]], ABSENT[:, [0, 0]]), "dependent"),
        (lambda: hotelling_scores(PRESENT * [0, 1, 1, 1], ABSENT * [0, 1, 1, 1]), "does not vary"),
        (lambda: dog_channels(VolumeGrid((4, 4), 1.0), (0.0,)), "center"),
        (lambda: dog_channels(VolumeGrid((4, 4), 1.0), (0.0, 0.0), lowest=0.0), "lowest"),
        (lambda: template_channel(np.zeros((3, 3))), "differ from 0"),
        (lambda: channel_responses(np.zeros((3, 4, 4)), np.zeros((2, 4, 5))), "match"),
        (lambda: channel_responses(np.full((3, 4, 4), np.nan), np.ones((2, 4, 4))), "NaN"),
        (lambda: d_prime(np.ones(9), np.zeros(9)), "do not vary"),
        (lambda: d_prime(np.arange(4.0), np.arange(4.0)), "at least 5"),
        (lambda: d_prime(np.arange(9.0), np.arange(8.0)), "same realisations"),
        (lambda: d_prime([*np.arange(8.0), np.nan], np.arange(9.0)), "NaN"),
    ],
)
def test_refusals(call, match):
    with pytest.raises(ValueError, match=match):
        call()
