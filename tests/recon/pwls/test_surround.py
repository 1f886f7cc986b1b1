"""An unknown surround, found by a coarse FBP of the whole field."""

import numpy as np
import pytest
import torch

from recon.pwls.surround import UnknownSurround
from torchpcct import ConeBeam, Projector, VolumeGrid, full_turn
from torchpcct.detector_window import shadow

GEOMETRY = ConeBeam(full_turn(360), 300.0, 550.0, 300, 8, (1.0, 0.9), detector="curved")
GRID = VolumeGrid((8, 16, 16), 0.5, (0.0, 12.0, -15.0))
HU = 2e-5


@pytest.fixture(scope="module")
def lines():
    """A cylinder with a denser rod in it, outside the inset, both constant along z."""
    big = VolumeGrid((12, 200, 200), (1.0, 0.6, 0.6))
    y, x = np.meshgrid(*big.axes[1:], indexing="ij")
    body = 0.02 * (np.hypot(y, x) < 50) + 0.02 * (np.hypot(y + 25, x - 10) < 8)
    return Projector(GEOMETRY, big)(torch.from_numpy(body).float().expand(big.shape))


def test_nothing_is_left_of_a_uniform_inset(lines):
    """Every row: a path of 8 mm through 1 HU is 1.6e-4."""
    window = shadow(GEOMETRY, GRID, margin=1)
    around = UnknownSurround(GEOMETRY, GRID, window, Projector(GEOMETRY, GRID, window))
    assert around.level(lines) == pytest.approx(0.02, abs=3 * HU)
    left = around.take_off(lines, 0.02)
    assert left.shape == window.shape
    assert float(lines.max()) > 2.0
    assert float(left.mean((0, 2)).abs().max()) < 2e-4
