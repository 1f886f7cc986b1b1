"""ASTRA's per-view vectors: there and back, and refusals."""

from __future__ import annotations

import math

import numpy as np
import pytest

from torchpcct.geometry import ConeBeam, FanBeam, ParallelBeam, full_turn
from torchpcct.projector.vectors import from_vectors, to_vectors

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
