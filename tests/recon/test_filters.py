"""The simple filters that a reconstruction is judged against."""

import sys
import types

import numpy as np
import pytest
import torch
from refusals import refused
from scipy import ndimage

from recon import filters, names
from recon.filters import FILTERS, denoised, flat_noise, perona_malik

SHAPE = (10, 12, 14)
NOISE = 20.0
SMALL = {"nlm": {"search": 2}, "bilateral": {"reach": 1.0}}
"""Quicker than the defaults."""
OWN = sorted(set(FILTERS) - {"bm4d"})


@pytest.fixture(scope="module")
def noise():
    return NOISE * torch.randn(SHAPE, generator=torch.Generator().manual_seed(1))


def run(name, volume, noise_hu=NOISE, **settings):
    return FILTERS[name](volume, noise_hu, **SMALL.get(name, {}), **settings)


@pytest.fixture
def fake_bm4d(monkeypatch):
    """In the place of BM4D's package: half of the volume, and what it was told."""
    told = []

    def bm4d(z, sigma_psd):
        told.append((z, sigma_psd))
        return z / 2

    monkeypatch.setitem(sys.modules, "bm4d", types.SimpleNamespace(bm4d=bm4d))
    return told


@pytest.mark.parametrize("name", OWN)
def test_what_every_filter_leaves_alone(name, noise):
    """Constants, an added constant, the unit, the mirror, the kind and dtype, and the caller's
    volume."""
    found = run(name, noise)
    torch.testing.assert_close(
        run(name, torch.full(SHAPE, -93.0)), torch.full(SHAPE, -93.0), rtol=0, atol=1e-3
    )
    torch.testing.assert_close(run(name, noise + 500.0), found + 500.0, rtol=0, atol=2e-2)
    torch.testing.assert_close(run(name, 2 * noise, 2 * NOISE), 2 * found, rtol=0, atol=2e-2)
    for axis in range(3):
        # Total variation by forward differences is symmetric but for its discretisation.
        mirrored = run(name, noise.flip(axis))
        torch.testing.assert_close(
            mirrored, found.flip(axis), rtol=0, atol=0.15 * NOISE if name == "tv" else 2e-2
        )
    kept = noise.double().numpy().copy()
    array = run(name, kept)
    assert isinstance(array, np.ndarray)
    assert array.dtype == np.float64
    np.testing.assert_allclose(array, found.numpy(), atol=2e-2)
    np.testing.assert_array_equal(kept, noise.double().numpy())
    assert found.dtype == torch.float32
    # Half precision and whole HU are computed in float32.
    assert run(name, noise.half()).dtype == torch.float16
    assert run(name, noise.round().to(torch.int16).numpy()).dtype == np.float32


GROWING = {
    "gaussian": ("sigma", (0.0, 0.5, 1.0)),
    "perona_malik": ("steps", (0, 5, 15)),
    "bilateral": ("edge", (0.005, 0.1, 2.0)),
    "nlm": ("strength", (0.05, 0.5, 2.0)),
    "tv": ("strength", (0.01, 0.3, 1.0)),
}


@pytest.mark.parametrize("name", OWN)
def test_more_takes_more_noise_and_only_the_gaussian_takes_the_edge(name, noise):
    setting, values = GROWING[name]
    left = [float(run(name, noise, 0.5 * NOISE, **{setting: v}).std()) for v in values]
    assert left == sorted(left, reverse=True)
    assert left[0] > 0.7 * NOISE > 1.5 * left[-1]
    step = torch.zeros(SHAPE)
    step[..., 7:] = 500.0
    # The noise of the smoothed volume, for those that look at it.
    found = run(name, step + noise, 0.4 * NOISE if name in ("perona_malik", "bilateral") else NOISE)
    across = (found[..., 7] - found[..., 6]).mean()
    assert (across > 400.0) == (name != "gaussian")


def test_diffusion_is_the_published_scheme(noise):
    """Against a few lines of SciPy, and it keeps the mean."""
    want = noise.double().numpy()
    for _ in range(3):
        smooth, total = ndimage.gaussian_filter(want, 0.7, mode="nearest"), np.zeros(SHAPE)
        for axis in range(3):
            for shift in (-1, 1):
                gap = np.roll(smooth, shift, axis) - smooth
                step = (np.roll(want, shift, axis) - want) * np.exp(-((gap / (1.3 * 8.0)) ** 2))
                # Nothing flows across the faces.
                np.moveaxis(step, axis, 0)[0 if shift == 1 else -1] = 0.0
                total += step
        want = want + total / 7
    found = perona_malik(noise.double(), 8.0, steps=3)
    np.testing.assert_allclose(found.numpy(), want, atol=1e-3)
    assert float(found.mean()) == pytest.approx(float(noise.double().mean()), abs=1e-9)


def test_non_local_means_are_their_formula(noise):
    """At one voxel, written out; the volume goes on with its outermost voxels."""
    wide = np.pad(noise.double().numpy(), 3, mode="edge")
    place = (1, 6, 13)
    cubes = np.lib.stride_tricks.sliding_window_view(wide, (3, 3, 3))[
        tuple(slice(k, k + 5) for k in place)
    ]
    unlike = np.square(cubes - cubes[2, 2, 2]).mean((3, 4, 5))
    weights = np.exp(-np.maximum(unlike - 2 * NOISE**2, 0) / (0.6 * NOISE) ** 2)
    want = (weights * cubes[..., 1, 1, 1]).sum() / weights.sum()
    assert float(run("nlm", noise.double())[place]) == pytest.approx(want, abs=1e-6)


def test_the_noise_is_measured_where_the_volume_is_flat(noise):
    volume = 100.0 + noise
    volume[5:] = 900.0
    flat = torch.zeros(SHAPE, dtype=torch.bool)
    flat[:3] = True
    level = flat_noise(volume, flat)
    assert level == pytest.approx(float(noise[:3].std()), rel=1e-5)
    smooth = flat_noise(volume, flat.numpy(), sigma=0.7)
    assert smooth < 0.6 * level
    # Each filter gets the level of what it looks at.
    torch.testing.assert_close(denoised("tv", volume, flat), FILTERS["tv"](volume, level))
    torch.testing.assert_close(denoised("perona_malik", volume, flat), perona_malik(volume, smooth))
    torch.testing.assert_close(
        denoised("perona_malik", volume, flat, sigma=0.0), perona_malik(volume, level, sigma=0)
    )


def test_bm4d_is_told_the_noise_and_its_spectrum(fake_bm4d, noise):
    found = filters.bm4d(noise + 1000.0, NOISE, strength=0.5)
    torch.testing.assert_close(
        found, (noise + 1000.0) / 2 + float((noise + 1000.0).mean()) / 2, rtol=0, atol=1e-2
    )
    assert fake_bm4d[0][1] == 0.5 * NOISE
    # White noise, smoothed along x: its spectrum falls along x alone, and adds up to the variance.
    covariance = np.zeros((3, 3, 5))
    covariance[1, 1] = np.array([0.0, 0.5, 1.0, 0.5, 0.0]) * 7.0
    filters.bm4d(noise.numpy(), NOISE, covariance=covariance)
    power = fake_bm4d[1][1]
    assert power.shape == SHAPE
    assert power.sum() / noise.numel() ** 2 == pytest.approx(NOISE**2)
    assert power.std((0, 1)).max() < 1e-9 * power.max()
    assert power[0, 0, 0] > 1.9 * power.mean() > 1e9 * power[0, 0, 7]
    for wrong in (covariance[..., :4], np.zeros((3, 3, 3)), np.ones((3, 3)), np.ones((11, 3, 3))):
        with pytest.raises(ValueError, match="covariance"):
            filters.bm4d(noise, NOISE, covariance=wrong)


def test_bm4d_without_its_package_says_how_to_get_it(monkeypatch, noise):
    monkeypatch.setitem(sys.modules, "bm4d", None)
    with pytest.raises(ImportError, match=r"torchpcct\[rivals\].*non-commercial"):
        filters.bm4d(noise, NOISE)
    # A release that calls what NumPy no longer has.
    monkeypatch.setitem(
        sys.modules, "bm4d", types.SimpleNamespace(bm4d=lambda z, sigma: np.not_there)
    )
    with pytest.raises(ImportError, match=r"does not run with NumPy.*not_there"):
        filters.bm4d(noise, NOISE)


@pytest.mark.parametrize("name", FILTERS)
def test_refusals(name, noise, fake_bm4d):
    call = FILTERS[name]
    holed = noise.clone()
    holed[0, 0, :3] = float("nan")
    setting, (least, *_) = GROWING.get(name, ("strength", (0.0,)))
    refused(
        ("shape", lambda: call(noise[0], NOISE)),
        ("voxels", lambda: call(noise[:0], NOISE)),
        ("3 voxels of the volume are NaN", lambda: call(holed, NOISE)),
        ("real", lambda: call(noise.to(torch.complex64), NOISE)),
        ("bool", lambda: call(noise > 0, NOISE)),
        ("list", lambda: call([[1.0]], NOISE)),
        (setting, lambda: call(noise, NOISE, **{setting: -1 - least})),
    )
    if name != "gaussian":
        for bad in (0.0, -1.0, float("nan")):
            refused(("noise_hu", lambda bad=bad: call(noise, bad)))


def test_refusals_of_the_flat_region(noise):
    everywhere = torch.ones(SHAPE, dtype=torch.bool)
    refused(
        ("unknown filter", lambda: denoised("median", noise, everywhere)),
        ("bool mask", lambda: denoised("tv", noise, everywhere[:2])),
        ("bool mask", lambda: denoised("tv", noise, everywhere.int())),
        ("0 voxels", lambda: flat_noise(noise, ~everywhere)),
        ("no noise", lambda: flat_noise(torch.zeros(SHAPE), everywhere)),
    )


def test_every_filter_that_has_a_name_is_there():
    assert tuple(FILTERS) == names.FILTERS
