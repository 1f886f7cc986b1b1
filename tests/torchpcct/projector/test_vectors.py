"""ASTRA's per-view vectors: there and back, and refusals."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from torchpcct.geometry import ConeBeam, FanBeam, ParallelBeam, VolumeGrid, full_turn
from torchpcct.projector import Projector
from torchpcct.projector.vectors import from_moving_vectors, from_vectors, to_vectors

FAN = FanBeam(full_turn(5, 0.2), 60.0, 110.0, 21, 2.1, 0.5)
CONE = ConeBeam(full_turn(5, 0.2), 60.0, 110.0, 21, 4, (1.5, 2.1), (0.3, 0.5))


def test_fan_vectors_of_the_first_view():
    fan = FanBeam([math.pi / 2], 60.0, 110.0, 21, 2.0, 3.0)
    assert to_vectors(fan)[0] == pytest.approx([0, 60, -3, -50, -2, 0], abs=1e-12)


def test_cone_vectors_of_the_first_view():
    cone = ConeBeam([0.0], 60.0, 110.0, 21, 4, (1.5, 2.0), (0.5, 3.0))
    assert to_vectors(cone)[0] == pytest.approx([60, 0, 0, -50, 3, 0.5, 0, 2, 0, 0, 0, 1.5])


def test_parallel_vectors_run_against_e_r():
    assert to_vectors(ParallelBeam([0.0], 3, 2.0, 0.5))[0] == pytest.approx([-1, 0, 0, 0.5, 0, 2])


@pytest.mark.parametrize(("geometry", "rows"), [(FAN, None), (CONE, 4)])
def test_there_and_back(geometry, rows):
    vectors = to_vectors(geometry)
    back = from_vectors(vectors, geometry.columns, rows)
    assert back.shape == geometry.shape
    np.testing.assert_allclose(to_vectors(back), vectors, atol=1e-9)


def test_refusals_name_the_cause():
    vectors = to_vectors(CONE)
    vectors[2, 2] += 1.0
    with pytest.raises(ValueError, match="z part of the source is off by"):
        from_vectors(vectors, 21, 4)
    with pytest.raises(ValueError, match="shape"):
        from_vectors(vectors[:, :7], 21)
    with pytest.raises(ValueError, match="need rows"):
        from_vectors(vectors, 21)
    with pytest.raises(ValueError, match="curved"):
        to_vectors(FanBeam([0.0], 60.0, 110.0, 3, 2.0, detector="curved"))
    with pytest.raises(TypeError, match="geometry must be"):
        to_vectors("fan")  # type: ignore[arg-type]


@pytest.mark.parametrize(("geometry", "rows"), [(FAN, None), (CONE, 4)])
def test_moving_vectors_there_and_back(geometry, rows):
    axes = 2 if rows is None else 3
    motion = np.random.default_rng(4).uniform(-3, 3, (5, axes))
    vectors = to_vectors(geometry, motion)
    back, found = from_moving_vectors(vectors, geometry.columns, rows, sod=60.0)
    np.testing.assert_allclose(found, motion, atol=1e-11)
    np.testing.assert_allclose(to_vectors(back), to_vectors(geometry), atol=1e-11)
    # Without the orbit's radius: another split between orbit and motion, the same rays, and no larger motion.
    back, least = from_moving_vectors(vectors, geometry.columns, rows)
    np.testing.assert_allclose(to_vectors(back, least), vectors, atol=1e-11)
    assert np.linalg.norm(least) < np.linalg.norm(motion)


def test_moving_vectors_give_the_same_line_integrals():
    motion = np.random.default_rng(4).uniform(-3, 3, (5, 2))
    grid = VolumeGrid((9, 8), 2.0, (1.0, -2.0))
    x = torch.randn(9, 8, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    geometry, found = from_moving_vectors(to_vectors(FAN, motion), 21)
    there = Projector(geometry, grid, motion=found)(x)
    torch.testing.assert_close(there, Projector(FAN, grid, motion=motion)(x), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("geometry", "rows"), [(FAN, None), (CONE, 4)])
def test_vectors_at_rest_have_no_motion(geometry, rows):
    back, motion = from_moving_vectors(to_vectors(geometry), geometry.columns, rows)
    np.testing.assert_allclose(motion, 0.0, atol=1e-11)
    np.testing.assert_allclose(to_vectors(back), to_vectors(geometry), atol=1e-11)


def test_motion_that_is_none_is_refused():
    moving = to_vectors(CONE, np.full((5, 3), 1.0))
    with pytest.raises(ValueError, match="use from_moving_vectors"):
        from_vectors(moving, 21, 4)
    alone = moving.copy()
    alone[1, 3:5] += 1.0  # the detector without the source
    with pytest.raises(ValueError, match="part of the way from detector to source is off by"):
        from_moving_vectors(alone, 21, 4)
    tilted = moving.copy()
    tilted[3, 8] += 0.5
    with pytest.raises(ValueError, match="z part of the u is off by"):
        from_moving_vectors(tilted, 21, 4)
    with pytest.raises(ValueError, match="sod must lie between 0 and"):
        from_moving_vectors(moving, 21, 4, sod=200.0)
    moving[0, 0] = np.nan
    with pytest.raises(ValueError, match="finite"):
        from_moving_vectors(moving, 21, 4)
