"""Edges and transfer functions against closed forms."""

import math

import numpy as np
import pytest
import torch
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
    assert edge.frequency(0.1) == pytest.approx(math.sqrt(math.log(10) / 2) / (math.pi * sigma), rel=0.02)


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
