"""An unknown exterior, found by a coarse FBP of the whole field."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from recon.least_squares.exterior import UnknownExterior, _joined_views
from torchpcct import ConeBeam, Projector, VolumeGrid, full_turn
from torchpcct.detector_window import footprint

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


@pytest.fixture(scope="module")
def around():
    window = footprint(GEOMETRY, GRID, margin=1)
    return UnknownExterior(GEOMETRY, GRID, window, Projector(GEOMETRY, GRID, window))


@pytest.fixture(scope="module")
def left(around, lines):
    return around.take_off(lines, 0.02)


def test_nothing_is_left_of_a_uniform_inset(around, lines, left):
    """Every row: a path of 8 mm through 1 HU is 1.6e-4."""
    assert around.level(lines) == pytest.approx(0.02, abs=3 * HU)
    assert left.shape == around.window.shape
    assert float(lines.max()) > 2.0
    assert float(left.mean((0, 2)).abs().max()) < 2e-4


def test_what_the_inset_holds_stays_its_own(around, lines, left):
    """A ball in it: its readings are left, and nothing of it is taken for exterior (once 12 %
    were)."""
    z, y, x = np.meshgrid(*GRID.axes, indexing="ij")
    ball = torch.from_numpy(0.02 * (np.hypot(np.hypot(y - 12.0, x + 15.0), z) < 1.8)).float()
    holding = around.take_off(lines + Projector(GEOMETRY, GRID)(ball), 0.02)
    own = around.projector(ball)
    error = holding - left - own
    assert abs(float(error.mean())) < 0.03 * float(own.mean())


def test_a_body_beyond_the_detector_is_refused(lines):
    """Its readings would be left in the inset's: 250 HU of a thorax."""
    narrow = ConeBeam(full_turn(360), 300.0, 550.0, 120, 8, (1.0, 0.9), detector="curved")
    window = footprint(narrow, GRID, margin=1)
    around = UnknownExterior(narrow, GRID, window, Projector(narrow, GRID, window))
    with pytest.raises(ValueError, match=r"rows end inside the object.*outside="):
        around.level(lines[..., 90:-90].contiguous())


def test_views_are_joined_where_there_are_enough_of_them():
    """About as many as the voxels of the field need, π R / size; views out of order stay single."""
    dense = ConeBeam(full_turn(1968), 626.0, 1098.0, 1500, 8, (0.5, 0.35), detector="curved")
    assert dense.fov_radius == pytest.approx(148.2, abs=0.1)
    assert (_joined_views(dense, 0.6), _joined_views(dense, 1.2)) == (2, 4)
    assert _joined_views(replace(dense, angles=full_turn(1969)), 0.6) == 1
    assert _joined_views(replace(dense, angles=full_turn(1)), 0.6) == 1
    mixed = np.concatenate([full_turn(1968)[::2], full_turn(1968)[1::2]])
    assert _joined_views(replace(dense, angles=mixed), 0.6) == 1
