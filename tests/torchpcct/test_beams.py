"""What all beams answer, so that nobody has to ask of which kind one is."""

import math
from dataclasses import replace

import numpy as np
import pytest

from torchpcct import ConeBeam, FanBeam, ParallelBeam
from torchpcct.geometry import beam
from torchpcct.vector_geometry import VectorGeometry

ANGLES = np.array([0.1, 1.3, 2.0, 4.4])
BEAMS = {
    "parallel": ParallelBeam(ANGLES, 9, 0.5, 0.125),
    "fan": FanBeam(ANGLES, 60.0, 100.0, 9, 0.5, -0.2),
    "cone": ConeBeam(ANGLES, 60.0, 100.0, 9, 4, (0.8, 0.5), (0.3, -0.2)),
}
CHANGES = {
    "widened": lambda g: g.widened(2, 5),
    "narrowed": lambda g: g.widened(-1, -3),
    "interleaved": lambda g: g.interleaved(),
    "another column offset": lambda g: g.with_column_offset(0.7),
    "wider columns": lambda g: g.scaled(1.03),
    "other rows": lambda g: g.with_rows(1, 2),
}


@pytest.fixture(params=BEAMS)
def given(request):
    return BEAMS[request.param]


def test_a_beam_given_view_by_view_answers_the_same(given):
    vectors = VectorGeometry.of(given)
    names = ("column_pitch", "row_pitch", "column_offset", "row_offset", "cell", "cell_height")
    for name in (*names, "magnification", "parallel", "has_rows"):
        assert getattr(vectors, name) == pytest.approx(getattr(given, name), abs=1e-9), name
    assert given.on_circle
    assert not vectors.on_circle
    assert beam(given) is given
    with pytest.raises(TypeError, match="must be ParallelBeam, FanBeam or ConeBeam, got Vector"):
        beam(vectors)


@pytest.mark.parametrize("change", CHANGES)
def test_changes_are_the_same_view_by_view(given, change):
    ours, vectors = CHANGES[change](given), CHANGES[change](VectorGeometry.of(given))
    assert vectors.shape == ours.shape
    np.testing.assert_allclose(vectors.vectors, VectorGeometry.of(ours).vectors, atol=1e-12)


def test_cells_stay_at_their_places(given):
    u = given.column_positions
    np.testing.assert_allclose(given.widened(2, 5).column_positions[2:-5], u, atol=1e-12)
    np.testing.assert_allclose(given.widened(-1, -3).column_positions, u[1:-3], atol=1e-12)
    np.testing.assert_allclose(given.interleaved().column_positions[::2], u, atol=1e-12)
    if given.has_rows:
        np.testing.assert_allclose(
            given.with_rows(1, 2).row_positions, given.row_positions[1:3], atol=1e-12
        )
    else:
        assert given.with_rows(1, 2) is given
        assert (given.row_pitch, given.cell_height) == (math.inf, math.inf)


def test_where_rays_pass_the_axis():
    parallel, fan = BEAMS["parallel"], BEAMS["fan"]
    np.testing.assert_array_equal(parallel.ray_distances, parallel.column_positions)
    curved = replace(fan, detector="curved")
    for one in (fan, curved):
        np.testing.assert_allclose(one.ray_distances, one.sod * np.sin(one.fan_angles))
    # 9 cells of 0.5 mm, 0.125 mm off: 2.125 mm to the near edge.
    assert parallel.fov_radius == pytest.approx(2.125)
