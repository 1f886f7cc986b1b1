"""Noise at equal resolution: what a filter of the reference saves is nothing, whatever its
directions and the noise."""

import numpy as np
import pytest
import torch
from scipy import ndimage

from torchpcct.metrics.equal_resolution import noise_at_equal_resolution
from torchpcct.metrics.half_split import HalfSplit

SHAPE = (20, 40, 40)
SPACING = (0.4, 0.3, 0.3)


def drawn(kind, draw, shape=SHAPE):
    white = draw.normal(size=shape)
    if kind == "white":
        return white
    if kind == "soft":
        return 4.0 * ndimage.gaussian_filter(white, 0.8)
    radius = np.hypot(np.fft.fftfreq(shape[1])[:, None], np.fft.fftfreq(shape[2]))
    return 2.0 * np.fft.ifft2(np.fft.fft2(white) * np.sqrt(radius)).real


def pair(*volumes):
    return HalfSplit(*(torch.from_numpy(np.ascontiguousarray(v)) for v in volumes))


@pytest.fixture(scope="module")
def balls():
    """Some that are cut by the borders."""
    draw, object_ = np.random.default_rng(0), np.zeros(SHAPE)
    axes = np.meshgrid(*(np.arange(n) - n / 2 for n in SHAPE), indexing="ij")
    for _ in range(30):
        middle, radius = [draw.uniform(-n / 2, n / 2) for n in SHAPE], draw.uniform(2, 8)
        inside = sum((a - m) ** 2 for a, m in zip(axes, middle, strict=True)) < radius**2
        object_ += draw.uniform(-10, 10) * inside
    return ndimage.gaussian_filter(object_, 0.5)


def scans(object_, kind, noise=0.7):
    draw = np.random.default_rng(1)
    return [object_ + noise * drawn(kind, draw, object_.shape) for _ in range(2)]


WIDTHS = {
    "isotropic": [(0.5,) * 3, (1.0,) * 3, (2.0,) * 3],
    "plane": [(0, 1, 1), (0, 2, 2)],
    "axial": [(1.5, 0, 0)],
    "one direction of the plane": [(0, 1.5, 0), (0, 0, 1), (0.5, 0.7, 1.4)],
}


@pytest.mark.parametrize("kind", ["white", "ramp", "soft"])
@pytest.mark.parametrize("direction", WIDTHS)
def test_a_gaussian_saves_nothing(balls, kind, direction):
    reference = scans(balls, kind)
    for width in WIDTHS[direction]:
        found = noise_at_equal_resolution(
            pair(*(ndimage.gaussian_filter(v, width) for v in reference)), pair(*reference), SPACING
        )
        assert found.dose_factor.low < 1.0 < found.dose_factor.high, width
        assert found.dose_factor.value == pytest.approx(1.0, abs=0.01), width
        # ½ = exp(-2 (π σ f)²)
        for sigma, step, f50 in ((width[1], 0.3, found.f50_plane), (width[0], 0.4, found.f50_z)):
            if width[1] != width[2]:
                continue
            if sigma >= 1:
                assert f50 == pytest.approx(0.1874 / (sigma * step), rel=0.03)
            elif not sigma:
                assert f50 == np.inf


def continued(volume, width):
    """As if the volume went on periodically."""
    f = np.meshgrid(*(np.fft.fftfreq(n) for n in volume.shape), indexing="ij")
    gauss = np.exp(-2 * (np.pi * width) ** 2 * sum(a * a for a in f))
    return np.fft.ifftn(np.fft.fftn(volume) * gauss).real


@pytest.mark.parametrize(
    "method",
    [lambda v: ndimage.gaussian_filter(v, 1.0, mode="nearest"), lambda v: continued(v, 1.0)],
)
def test_borders_widen_the_interval(balls, method):
    """A filter that continues the volume in another way still saves nothing."""
    reference = scans(balls, "ramp")
    found = noise_at_equal_resolution(
        pair(*map(method, reference)), pair(*reference), SPACING
    ).dose_factor
    assert found.low < 1.0 < found.high
    assert found.value == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("kind", ["white", "ramp"])
def test_half_the_noise_is_four_times_the_dose(balls, kind):
    """A method that knows how to halve the noise of a blur, not the object; twice as much noise
    costs four times."""
    reference = scans(balls, kind)
    for share in (0.5, 2.0):
        volumes = [ndimage.gaussian_filter(balls + share * (v - balls), 1.0) for v in reference]
        found = noise_at_equal_resolution(pair(*volumes), pair(*reference), SPACING).dose_factor
        assert found.value == pytest.approx(share**-2, rel=0.05)
        assert found.low < share**-2 * 1.02
        assert found.high > share**-2 * 0.98


def test_an_object_that_does_not_change_along_z_credits_no_blur_along_z():
    y, x = np.meshgrid(*(np.arange(n) - n / 2 for n in SHAPE[1:]), indexing="ij")
    reference = scans(np.broadcast_to(10.0 * (np.hypot(y, x) < 12), SHAPE), "white", 2.0)
    blurred = [ndimage.gaussian_filter(v, (2.0, 0, 0)) for v in reference]
    found = noise_at_equal_resolution(pair(*blurred), pair(*reference), SPACING)
    assert found.dose_factor.value == pytest.approx(1.0, abs=0.02)
    assert found.shown_z == 0.0
    assert found.noise < 0.5 * 2.0


def test_a_region_counts_alone():
    """Half the noise in one half of the volume."""
    draw, shape = np.random.default_rng(3), (1, 96, 96)
    object_ = 4.0 * ndimage.gaussian_filter(draw.normal(size=shape), (0, 1.5, 1.5)) * 5
    reference = scans(object_, "white")
    share = np.where(np.arange(96) < 48, 1.0, 0.5)
    method = [object_ + share * (v - object_) for v in reference]
    for columns, expected in ((slice(8, 40), 1.0), (slice(56, 88), 4.0)):
        region = np.zeros(shape, bool)
        region[:, 8:88, columns] = True
        found = noise_at_equal_resolution(pair(*method), pair(*reference), SPACING, region)
        assert found.dose_factor.value == pytest.approx(expected, rel=0.1)
        assert found.noise == pytest.approx(0.7 / np.sqrt(expected), rel=0.05)


def test_an_interval_that_says_nothing_is_no_factor(balls):
    """A method in other units had the factor 0.00 [0.00, 10³⁰⁴]."""
    reference = scans(balls, "ramp")
    found = noise_at_equal_resolution(
        pair(*(1e6 * v for v in reference)), pair(*reference), SPACING
    )
    assert np.isnan(found.dose_factor.value)
    assert found.why


def test_nothing_can_be_said_of_noise_alone():
    draw = np.random.default_rng(2)
    noise = [draw.normal(size=SHAPE) for _ in range(2)]
    found = noise_at_equal_resolution(
        pair(*(ndimage.gaussian_filter(v, 1) for v in noise)), pair(*noise), SPACING
    )
    assert "nothing in common" in found.why
    assert np.isnan(found.dose_factor.value)


@pytest.mark.parametrize(
    ("method", "said"),
    [
        (lambda r: pair(np.ones(SHAPE), np.ones(SHAPE)), "constant"),
        (lambda r: pair(r[0], r[0]), "equal volumes"),
        (lambda r: pair(r[0][1:], r[1][1:]), "one shape"),
    ],
)
def test_volumes_that_say_nothing_are_refused(balls, method, said):
    reference = scans(balls, "white")
    with pytest.raises(ValueError, match=said):
        noise_at_equal_resolution(method(reference), pair(*reference), SPACING)
    with pytest.raises(ValueError, match="two voxels"):
        noise_at_equal_resolution(
            pair(*reference), pair(*reference), SPACING, np.zeros(SHAPE, bool)
        )
