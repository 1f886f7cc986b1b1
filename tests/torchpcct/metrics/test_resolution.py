"""Edges and transfer functions against closed forms."""

import math

import numpy as np
import pytest
import torch
from scipy import ndimage
from scipy.special import erf

from torchpcct import VolumeGrid
from torchpcct.metrics import edge_profile, task_transfer

GRID = VolumeGrid((120, 120), 0.1, (3.0, -2.0))
Y, X = np.meshgrid(*GRID.axes, indexing="ij")
DISK = np.hypot(Y - 3.03, X + 1.98) - 4.0


def blurred(distance, sigma, inside=40.0, outside=100.0):
    """A straight edge blurred by a Gaussian; on a disk of 4 mm its curvature is negligible."""
    return inside + (outside - inside) * 0.5 * (1 + erf(distance / (math.sqrt(2) * sigma)))


@pytest.mark.parametrize("sigma", [0.15, 0.3])
@pytest.mark.parametrize("contrast", [60.0, -400.0])
def test_gaussian_disk(sigma, contrast):
    image = blurred(DISK, sigma, 40.0, 40.0 + contrast)
    edge = task_transfer(torch.from_numpy(image), DISK, (1.5, 1.5), 0.03)
    f = edge.frequencies
    expected = np.exp(-2 * (math.pi * sigma * f) ** 2)
    use = expected > 0.02
    np.testing.assert_allclose(edge.values[use], expected[use], atol=0.01)
    assert edge.values[0] == pytest.approx(1)
    assert edge.f50 == pytest.approx(math.sqrt(math.log(2) / 2) / (math.pi * sigma), rel=0.01)
    assert edge.frequency(0.1) == pytest.approx(
        math.sqrt(math.log(10) / 2) / (math.pi * sigma), rel=0.02
    )


def test_bins_do_not_blur():
    f50 = [task_transfer(blurred(DISK, 0.2), DISK, (1.4, 1.4), width).f50 for width in (0.02, 0.1)]
    assert f50[1] == pytest.approx(f50[0], rel=0.01)


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: edge_profile(DISK, DISK[:5], (1, 1), 0.1), "same shape"),
        (lambda: edge_profile(DISK, DISK, (1, 1), 0.0), "bin_mm"),
        (lambda: edge_profile(DISK, DISK, (0.1, 0.1), 0.1), "at least 8"),
        (lambda: edge_profile(DISK * np.nan, DISK, (1, 1), 0.1), "NaN"),
        (lambda: edge_profile(DISK, DISK, (0.1, 0.1), 1e-4), "empty"),
        (lambda: task_transfer(0 * DISK, DISK, (1, 1), 0.1), "no contrast"),
        (lambda: task_transfer(DISK, DISK, (1, 1), 0.1).frequency(1.0), "level"),
    ],
)
def test_refusals(call, match):
    with pytest.raises(ValueError, match=match):
        call()


@pytest.fixture(scope="module")
def faint():
    """A disc of 60 HU on voxels of 0.25 mm, with the distance from its edge."""
    axes = [(np.arange(80) - 39.5) / 4] * 2
    y, x = np.meshgrid(*axes, indexing="ij")
    distance = np.hypot(y - 0.07, x + 0.13) - 5.0
    return blurred(distance, 0.5, -60.0, 0.0), distance


@pytest.mark.parametrize("correlated", [0.0, 1.0])
def test_noise_has_no_resolution(faint, correlated):
    """An edge that is not there, or as faint as the noise, is refused; what is not refused is
    near the truth."""
    disc, distance = faint
    true = task_transfer(disc, distance, (2.0, 2.0), 0.125).f50
    for seed in range(6):
        noise = np.random.default_rng(seed).normal(size=disc.shape)
        noise = ndimage.gaussian_filter(noise, correlated) if correlated else noise
        noise /= noise.std()
        with pytest.raises(ValueError, match="noise"):
            task_transfer(60.0 * noise, distance, (2.0, 2.0), 0.125)
        with pytest.raises(ValueError, match="noise"):
            task_transfer(disc + 60.0 * noise, distance, (2.0, 2.0), 0.125)
        assert task_transfer(disc + 3.0 * noise, distance, (2.0, 2.0), 0.125).f50 == pytest.approx(
            true, rel=0.15
        )
