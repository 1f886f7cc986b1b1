"""The projector, of grids at rest and moving ones, against exact line integrals, and those
against closed forms."""

import math

import numpy as np
import pytest
import torch
from analytic import Ellipsoid, Gaussian, line_integrals, rasterize
from hypothesis import given, settings
from hypothesis import strategies as st
from linear_maps import mismatch

from torchpcct.detector_window import footprint
from torchpcct.geometry import ConeBeam, FanBeam, ParallelBeam, VolumeGrid, full_turn
from torchpcct.projector import Projector
from torchpcct.vector_geometry import VectorGeometry


def _error(geometry, grid, bodies, window=None, sub=1, dtype=torch.float64):
    exact = line_integrals(geometry, bodies, window, 5)
    image = torch.as_tensor(rasterize(grid, bodies, sub), dtype=dtype)
    found = Projector(geometry, grid, window)(image).double().numpy()
    return np.linalg.norm(found - exact) / np.linalg.norm(exact)


def test_the_exact_line_integrals_are_closed_forms():
    """A disc's diameter, both axes of a turned ellipse, a Gaussian's mass, a sphere off the
    middle plane."""
    disc = line_integrals(
        ParallelBeam([0.0, 1.0, 2.5], 3, 1e-6), [Ellipsoid((0.0, 0.0), 7.0, value=2.0)]
    )
    assert disc == pytest.approx(28.0)
    across = FanBeam([0.3, 0.3 + math.pi / 2], 100.0, 200.0, 1, 1e-6)
    assert line_integrals(across, [Ellipsoid((0.0, 0.0), (2.0, 5.0), angle=0.3)])[
        :, 0
    ] == pytest.approx([10.0, 4.0])
    mass = (
        line_integrals(
            ParallelBeam([0.2], 400, 0.1), [Gaussian((1.0, -2.0), (1.5, 2.5), 0.7, 3.0)]
        ).sum()
        * 0.1
    )
    assert mass == pytest.approx(3.0 * 2 * math.pi * 1.5 * 2.5, rel=1e-9)
    sphere = line_integrals(
        ConeBeam([0.0], 100.0, 200.0, 1, 1, 1e-6, (30.0, 0.0)), [Ellipsoid((0.0, 0.0, 0.0), 20.0)]
    )
    distance = 100.0 * math.sin(math.atan(30.0 / 200.0))
    assert sphere[0, 0, 0] == pytest.approx(2 * math.sqrt(20.0**2 - distance**2))


@settings(max_examples=25, deadline=None)
@given(
    start=st.floats(0, 2 * math.pi),
    sod=st.floats(150, 1e6),
    ratio=st.floats(1.2, 3),
    offset=st.floats(-3, 3),
    curved=st.booleans(),
    cy=st.floats(-10, 10),
    cx=st.floats(-10, 10),
    spacing=st.floats(0.7, 1.2),
)
def test_gaussians_in_any_fan_beam(start, sod, ratio, offset, curved, cy, cx, spacing):
    detector = "curved" if curved else "flat"
    geometry = FanBeam(full_turn(7, start), sod, sod * ratio, 120, 0.9 * ratio, offset, detector)
    grid = VolumeGrid((64, 60), (1.0, spacing), (cy, cx))
    body = Gaussian((cy + 1.3, cx - 2.1), (4.0, 5.5), 0.4, 0.02)
    # blur by voxels up to 1.2 mm; 4.9e-3 is the worst of 150 random scans
    assert _error(geometry, grid, [body]) < 6e-3


@settings(max_examples=10, deadline=None)
@given(
    start=st.floats(0, 2 * math.pi),
    curved=st.booleans(),
    cz=st.floats(-4, 4),
    cx=st.floats(-30, 30),
)
def test_gaussians_in_any_cone_beam(start, curved, cz, cx):
    geometry = ConeBeam(
        full_turn(5, start),
        200.0,
        380.0,
        120,
        40,
        (1.7, 1.9),
        (0.3, 0.6),
        "curved" if curved else "flat",
    )
    grid = VolumeGrid((30, 32, 28), (1.0, 0.9, 1.1), (cz, 5.0, cx))
    body = Gaussian((cz + 1, 4.0, cx - 1.0), (3.0, 2.5, 3.5), 0.8)
    assert _error(geometry, grid, [body]) < 1.4e-2  # the voxels blur σ = 2.5 mm by 0.29 mm


@pytest.mark.parametrize(("voxel", "pitch"), [(0.25, 3.0), (0.5, 1.0), (1.0, 0.25)])
def test_no_aliasing_whatever_the_ratio_of_voxel_and_cell(voxel, pitch):
    geometry = FanBeam(full_turn(6, 0.1), 200.0, 380.0, int(130 / pitch), pitch)
    n = int(40 / voxel)
    assert _error(geometry, VolumeGrid((n, n), voxel), [Gaussian((1.0, -2.0), (4.0, 5.0))]) < 5e-3


@pytest.mark.parametrize("angle", [0.0, math.pi / 4, math.pi / 2, 3 * math.pi / 4])
def test_rays_along_grid_lines_and_diagonals(angle):
    geometry = ParallelBeam([angle], 41, 1.0)  # cell edges fall on voxel edges at 0 and 90°
    value = Projector(geometry, VolumeGrid((20, 20), 1.0))(torch.ones(20, 20, dtype=torch.float64))
    assert float(value.sum()) == pytest.approx(400.0, rel=1e-12)
    if angle in (0.0, math.pi / 2):
        edge = 0.5  # 41 cells about the axis: the outermost seen cell is half covered
        expect = np.where(np.abs(geometry.column_positions) < 9.9, 20.0, 0.0)
        expect[np.abs(np.abs(geometry.column_positions) - 10) < 1e-9] = 20 * edge
        assert value.numpy()[0] == pytest.approx(expect, abs=1e-9)


@pytest.mark.parametrize(
    ("spacing", "center"), [(0.2, (0.0, -30.38, -29.63)), (0.4, (0.5, 20.0, 35.0))]
)
def test_small_inset_far_from_the_axis(spacing, center):
    geometry = ConeBeam(full_turn(9, 0.2), 626.0, 1098.0, 1500, 40, (0.5, 0.35), detector="curved")
    n = round(11 / spacing)
    grid = VolumeGrid((n, round(9 / spacing), round(9 / spacing)), spacing, center)
    bodies = [
        Gaussian(
            tuple(c + d for c, d in zip(center, shift, strict=True)), (0.8, 0.7, 0.9), 0.3, value
        )
        for shift, value in (((2.0, 0.5, -0.4), 1.0), ((-2.0, -0.6, 0.5), -0.5))
    ]
    assert (
        _error(geometry, grid, bodies, footprint(geometry, grid)) < 1.2e-2 * (spacing / 0.2) ** 2
    )  # voxel blur of σ = 0.7 mm


ANGLES = full_turn(6, 0.2)
PLANE = VolumeGrid((40, 36), 0.5, (1.0, -2.0))
VOLUME = VolumeGrid((28, 40, 36), 0.5, (0.5, 1.0, -2.0))
SCANS = {
    "parallel": (ParallelBeam(ANGLES, 90, 0.6), PLANE),
    "fan": (FanBeam(ANGLES, 150.0, 270.0, 110, 0.9, 0.3), PLANE),
    "fan curved": (FanBeam(ANGLES, 150.0, 270.0, 110, 0.9, detector="curved"), PLANE),
    "cone": (ConeBeam(ANGLES, 150.0, 270.0, 110, 48, (1.1, 0.9), (0.2, 0.3)), VOLUME),
    "cone curved": (ConeBeam(ANGLES, 150.0, 270.0, 110, 48, (1.1, 0.9), detector="curved"), VOLUME),
}


def _walk(axes):
    return np.random.default_rng(3).uniform(-4, 4, (6, axes))


def _moving_lines(geometry, body, motion):
    """Every view of the body where it is then."""
    views = []
    for v, shift in enumerate(motion):
        center = tuple(c + s for c, s in zip(body.center, shift, strict=True))
        there = type(body)(center, body.radii, body.angle, body.value)
        views.append(line_integrals(geometry.select([v]), [there], sub=4)[0])
    return np.stack(views)


@pytest.mark.extended
@pytest.mark.parametrize("name", sorted(SCANS))
@pytest.mark.parametrize("kind", [Gaussian, Ellipsoid])
def test_moving_body(name, kind):
    geometry, grid = SCANS[name]
    scale = 1.0 if kind is Gaussian else 2.0
    body = kind(
        tuple(c + 0.7 for c in grid.center),
        (1.6 * scale, 2.0 * scale, 1.8 * scale)[-grid.ndim :],
        0.4,
        0.02,
    )
    x = torch.as_tensor(rasterize(grid, [body], 4))
    errors = []
    for motion, assumed in (
        (_walk(grid.ndim), True),
        (np.zeros((6, grid.ndim)), True),
        (_walk(grid.ndim), False),
    ):
        exact = _moving_lines(geometry, body, motion)
        found = Projector(geometry, grid, motion=motion if assumed else None)(x).numpy()
        errors.append(float(np.linalg.norm(found - exact) / np.linalg.norm(exact)))
    moving, rest, ignored = errors
    assert moving < 1.4 * rest < 6e-2  # rest: voxels of 0.5 mm under a body of a few mm
    assert ignored > 0.2


@pytest.mark.parametrize("name", sorted(SCANS))
@pytest.mark.parametrize(("dtype", "epsilon"), [(torch.float32, 1e-6), (torch.float64, 1e-13)])
def test_adjoint_with_motion_and_window(name, dtype, epsilon):
    geometry, grid = SCANS[name]
    motion = _walk(grid.ndim)
    window = footprint(geometry, grid, motion=motion)
    A = Projector(geometry, grid, window, motion)
    assert mismatch(A, A.T, A.domain_shape, A.range_shape, dtype) <= epsilon


@pytest.mark.parametrize("name", sorted(SCANS))
def test_shadow_follows_the_motion(name):
    geometry, grid = SCANS[name]
    motion = _walk(grid.ndim)
    x = torch.ones(grid.shape, dtype=torch.float64)
    window = footprint(geometry, grid, motion=motion)
    whole, cropped = (
        Projector(geometry, grid, motion=motion)(x),
        Projector(geometry, grid, window, motion)(x),
    )
    torch.testing.assert_close(cropped.sum(), whole.sum(), rtol=1e-12, atol=0)


@pytest.mark.parametrize("name", ["parallel", "fan", "cone"])
def test_vectors_move_against_the_object(name):
    geometry, grid = SCANS[name]
    motion = _walk(grid.ndim)
    still, moved = VectorGeometry.of(geometry).vectors, VectorGeometry.of(geometry, motion).vectors
    n = grid.ndim
    np.testing.assert_allclose(
        still[:, n : 2 * n] - moved[:, n : 2 * n], motion[:, ::-1], atol=1e-12
    )
    source = 0.0 if name == "parallel" else motion[:, ::-1]
    np.testing.assert_allclose(
        still[:, :n] - moved[:, :n], np.broadcast_to(source, (6, n)), atol=1e-12
    )
    np.testing.assert_array_equal(still[:, 2 * n :], moved[:, 2 * n :])
