"""ROI means as linear functionals."""

import numpy as np
import pytest
import torch

from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.roi import RoiMean, axial_grid, sample_axial

GRID = VolumeGrid((8, 45, 46), 0.2, (0.1, -30.38, -29.63))


def affine_volume(grid, c, dtype=torch.float64):
    z, y, x = (torch.as_tensor(a) for a in grid.axes)
    return (c[0] + c[1] * z[:, None, None] + c[2] * y[:, None] + c[3] * x).to(dtype)


def test_interpolation_is_exact_for_affine_volumes():
    coefficients = (40.0, 3.0, -2.0, 5.0)
    image = axial_grid((0.0, -30.38, -29.63))
    inner = VolumeGrid((1, 200, 200), 0.035, image.center)
    expected = affine_volume(inner, coefficients)
    torch.testing.assert_close(
        sample_axial(affine_volume(GRID, coefficients), GRID, inner), expected
    )


def test_roi_mean_is_the_mean_of_the_interpolated_image():
    image = axial_grid((0.0, -30.38, -29.63))
    mask = np.zeros(image.shape, bool)
    mask[0, 100:140, 90:170] = np.random.default_rng(0).random((40, 80)) > 0.5
    volume = torch.randn(
        3, *GRID.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    roi = RoiMean(GRID, image, mask)
    direct = sample_axial(volume, GRID, image)[:, torch.from_numpy(mask)].mean(-1)
    torch.testing.assert_close(roi(volume), direct)
    assert roi.weights.sum().item() == pytest.approx(1)


def test_refusals():
    image = axial_grid((0.0, -30.38, -29.63))
    with pytest.raises(ValueError, match="empty"):
        RoiMean(GRID, image, np.zeros(image.shape, bool))
    with pytest.raises(ValueError, match="beyond the volume"):
        RoiMean(GRID, axial_grid((0.0, 0.0, 0.0)), np.ones(image.shape, bool))
