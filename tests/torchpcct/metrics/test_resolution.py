"""Edges and transfer functions against closed forms."""

import math

import numpy as np
import pytest
import torch
from scipy.special import erf

from torchpcct import VolumeGrid
from torchpcct.metrics import edge_profile, ellipsoid_distance, task_transfer

GRID = VolumeGrid((120, 120), 0.1, (3.0, -2.0))
DISK = ellipsoid_distance(GRID, (3.03, -1.98), (4.0, 4.0))


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


@pytest.mark.parametrize("axes", [(0.6, 0.985, 0.985), (1.0, 0.3, 2.0), (1.0, 1.0, 1.0), (math.inf, 0.5, 1.5)])
def test_distance_from_an_ellipsoid(axes):
    """Walking from surface points along the normal by a known distance."""
    rng = np.random.default_rng(0)
    bounded = np.isfinite(axes)
    e = np.array(axes)[bounded]
    n = rng.standard_normal((20, e.size))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    surface = e * n
    normal = n / e
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    for step in (-0.04, 0.0, 0.3, 2.0):
        for point in surface + step * normal:
            p = np.full(3, 7.0)
            p[bounded] = point
            one = VolumeGrid((1, 1, 1), 1.0, tuple(np.add(p, (1.0, 2.0, 3.0))))
            got = ellipsoid_distance(one, (1.0, 2.0, 3.0), axes)
            assert got.item() == pytest.approx(step, abs=1e-9)


def test_distance_at_the_centre_and_on_symmetry_planes():
    line = VolumeGrid((1, 5), 0.25)
    np.testing.assert_allclose(ellipsoid_distance(line, (0.0, 0.0), (1.0, 1.0)), [[-0.5, -0.75, -1, -0.75, -0.5]])
    flat = ellipsoid_distance(line, (0.0, 0.0), (0.3, 1.0))
    # The nearest point of a flat ellipse lies above the axis, at x = x₀ a² / (a² − b²).
    x0 = np.array([-0.5, -0.25, 0, 0.25, 0.5])
    x = x0 / (1 - 0.09)
    np.testing.assert_allclose(flat[0], -np.hypot(x - x0, 0.3 * np.sqrt(1 - x**2)), atol=1e-9)


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
        (lambda: ellipsoid_distance(GRID, (0.0, 0.0, 0.0), (1.0, 1.0)), "one per axis"),
        (lambda: ellipsoid_distance(GRID, (0.0, 0.0), (1.0, 0.0)), "positive"),
    ],
)
def test_refusals(call, match):
    with pytest.raises(ValueError, match=match):
        call()
