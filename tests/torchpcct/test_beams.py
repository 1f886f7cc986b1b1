"""What all beams answer, so that nobody has to ask of which kind one is."""

import math
from dataclasses import replace

import numpy as np
import pytest
import yaml
from hypothesis import given as drawn
from hypothesis import settings
from hypothesis import strategies as st
from refusals import refused

from torchpcct import ConeBeam, FanBeam, ParallelBeam
from torchpcct.formats.damage import yaml_values
from torchpcct.formats.geometry_yaml import geometry_of, geometry_values
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


@settings(max_examples=120, deadline=None)
@drawn(st.data())
def test_geometries_that_a_scan_can_have_are_taken(data):
    """Of any unit of length, from cells of 20 nm to line scanners of 100 000 cells and sources that
    stand for a synchrotron's, detectors beside the axis, single cells moved sideways, and thousands
    of turns: the limits of lengths, cells and angles refuse none."""
    draw, unit = data.draw, data.draw(st.sampled_from([1e-3, 0.1, 1.0, 1e3]))
    columns, rows = draw(st.integers(1, 100_000)), draw(st.integers(1, 4000))
    pitch = 10.0 ** draw(st.floats(-4.7, 1.3))
    aside = draw(st.floats(-1.0, 1.0)) * (1e4 if columns == 1 else columns) * pitch
    upwards = draw(st.floats(-1.0, 1.0)) * rows * pitch
    reach = columns * pitch / 2 + abs(aside) + rows * pitch / 2 + abs(upwards)
    sdd = min(reach / math.tan(math.radians(draw(st.floats(1e-4, 84.9)))), 1e8)
    sdd = max(sdd, reach / 11.0)
    sod = sdd * draw(st.floats(1e-4, 0.9999))
    first, step = draw(st.floats(-1e5, 1e5)), draw(st.floats(-170.0, 170.0))
    angles = np.radians(first + step * np.arange(draw(st.integers(1, 30))))
    if np.ptp(angles) > 20.0:  # what looks like degrees is warned of
        angles = np.radians(first + draw(st.floats(-2.0, 2.0)) * np.arange(angles.size))
    made = [
        ParallelBeam(angles, columns, unit * pitch, unit * aside),
        FanBeam(angles, unit * sod, unit * sdd, columns, unit * pitch, unit * aside),
        ConeBeam(
            angles,
            unit * sod,
            unit * sdd,
            columns,
            rows,
            (unit * pitch, unit * pitch),
            (unit * upwards, unit * aside),
        ),
    ]
    for geometry in made:
        VectorGeometry.of(geometry)
        again = geometry_of(yaml_values(yaml.safe_dump(geometry_values(geometry))))
        assert replace(again, angles=geometry.angles) == geometry
        np.testing.assert_allclose(again.angles, geometry.angles, atol=1e-9 * max(1.0, abs(first)))


def test_what_no_scan_can_be_is_refused_with_its_value():
    beam = {"kind": "parallel", "angles_deg": [0, 1], "columns": 48, "pitch": 0.8}
    cone = {**beam, "kind": "cone", "sod": 400, "sdd": 800, "rows": 4}
    step = [[400, 0, 0, -400, 0, 0, 0, 1, 0, 0, 0, 1]]
    refused(
        (r"offset must be .* at most 1e\+09 cells .* got 1e\+30 mm", of(beam, offset=1e30)),
        (r"pitch must lie in \[1e-09, 1e\+12\] mm, got 1e-300", of(beam, pitch=1e-300)),
        (r"pitch must be a number in mm, got True", of(beam, pitch=True)),
        (r"columns must be at most 10000000, got 10000000000", of(beam, columns=10**10)),
        (r"within ±1e\+09 rad, got 1\.7.*e\+28 at view 1", of(beam, angles_deg=[0, 1e30])),
        (r"met by rays at 90\..*are columns, pitch, offset", of(cone, pitch=[0.8, 800e3])),
        (r"met by rays at 89\.95.*are rows, pitch, offset", of(cone, offset=[1e6, 0])),
        (r"sdd must lie in", of(cone, sdd=1e300)),
        (r"vectors must be places in mm, .* got 1e\+30 in view 0", of_vectors(step, 0, 1e30)),
        (r"u and v must be the steps .* got 1e-300 in view 0", of_vectors(step, 7, 1e-300)),
        (r"vectors must hold real numbers", of_vectors(step, 7, "1")),
        (r"pose\.roll_deg must lie within ±360°, got 1e\+30", of(cone, pose={"roll_deg": 1e30})),
        (r"pose\.tilt_deg must hold real numbers", of(cone, pose={"tilt_deg": ["1", "2"]})),
    )


def of(values, **changes):
    return lambda: geometry_of({**values, **changes})


def of_vectors(vectors, at, value):
    vectors = [list(v) for v in vectors]
    vectors[0][at] = value
    return lambda: geometry_of({"kind": "vectors", "vectors": vectors, "columns": 48, "rows": 4})
