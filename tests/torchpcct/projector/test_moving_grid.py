"""A grid displaced from view to view: exact line integrals of moving bodies, adjoint, window, vectors."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from analytic import Ellipsoid, Gaussian, line_integrals, rasterize

from torchpcct.detector_window import footprint
from torchpcct.geometry import ConeBeam, FanBeam, ParallelBeam, VolumeGrid, full_turn
from torchpcct.projector import Projector
from torchpcct.vector_geometry import to_vectors

ANGLES = full_turn(6, 0.2)
PLANE, VOLUME = VolumeGrid((40, 36), 0.5, (1.0, -2.0)), VolumeGrid((28, 40, 36), 0.5, (0.5, 1.0, -2.0))
SCANS = {
    "parallel": (ParallelBeam(ANGLES, 90, 0.6), PLANE),
    "fan": (FanBeam(ANGLES, 150.0, 270.0, 110, 0.9, 0.3), PLANE),
    "fan curved": (FanBeam(ANGLES, 150.0, 270.0, 110, 0.9, detector="curved"), PLANE),
    "cone": (ConeBeam(ANGLES, 150.0, 270.0, 110, 48, (1.1, 0.9), (0.2, 0.3)), VOLUME),
    "cone curved": (ConeBeam(ANGLES, 150.0, 270.0, 110, 48, (1.1, 0.9), detector="curved"), VOLUME),
}


def _path(axes):
    return np.random.default_rng(3).uniform(-4, 4, (6, axes))


def _exact(geometry, body, motion):
    """Every view of the body where it is then."""
    views = []
    for v, shift in enumerate(motion):
        center = tuple(c + s for c, s in zip(body.center, shift, strict=True))
        there = type(body)(center, body.radii, body.angle, body.value)
        views.append(line_integrals(geometry, [there], sub=4)[v])
    return np.stack(views)


@pytest.mark.parametrize("name", sorted(SCANS))
@pytest.mark.parametrize("kind", [Gaussian, Ellipsoid])
def test_moving_body(name, kind):
    geometry, grid = SCANS[name]
    scale = 1.0 if kind is Gaussian else 2.0
    body = kind(tuple(c + 0.7 for c in grid.center), (1.6 * scale, 2.0 * scale, 1.8 * scale)[-grid.ndim :], 0.4, 0.02)
    x = torch.as_tensor(rasterize(grid, [body], 4))
    errors = []
    for motion, assumed in ((_path(grid.ndim), True), (np.zeros((6, grid.ndim)), True), (_path(grid.ndim), False)):
        exact = _exact(geometry, body, motion)
        found = Projector(geometry, grid, motion=motion if assumed else None)(x).numpy()
        errors.append(float(np.linalg.norm(found - exact) / np.linalg.norm(exact)))
    moving, rest, ignored = errors
    assert moving < 1.4 * rest < 6e-2  # rest: voxels of 0.5 mm under a body of a few mm
    assert ignored > 0.2


@pytest.mark.parametrize("name", sorted(SCANS))
@pytest.mark.parametrize(("dtype", "epsilon"), [(torch.float32, 1e-6), (torch.float64, 1e-13)])
def test_adjoint_with_motion_and_window(name, dtype, epsilon):
    geometry, grid = SCANS[name]
    motion = _path(grid.ndim)
    window = footprint(geometry, grid, motion=motion)
    A = Projector(geometry, grid, window, motion)
    generator = torch.Generator().manual_seed(0)
    x, y = (torch.randn(shape, generator=generator, dtype=dtype) for shape in (A.domain_shape, A.range_shape))
    Ax, Aty = A(x).double(), A.T(y).double()
    scale = Ax.norm() * y.norm() + x.norm() * Aty.norm()
    assert abs((Ax * y.double()).sum() - (x.double() * Aty).sum()) <= epsilon * scale


@pytest.mark.parametrize("name", sorted(SCANS))
def test_shadow_follows_the_motion(name):
    geometry, grid = SCANS[name]
    motion = _path(grid.ndim)
    x = torch.ones(grid.shape, dtype=torch.float64)
    window = footprint(geometry, grid, motion=motion)
    whole, cropped = Projector(geometry, grid, motion=motion)(x), Projector(geometry, grid, window, motion)(x)
    torch.testing.assert_close(cropped.sum(), whole.sum(), rtol=1e-12, atol=0)


@pytest.mark.parametrize("name", ["parallel", "fan", "cone"])
def test_vectors_move_against_the_object(name):
    geometry, grid = SCANS[name]
    motion = _path(grid.ndim)
    still, moved = to_vectors(geometry), to_vectors(geometry, motion)
    n = grid.ndim
    np.testing.assert_allclose(still[:, n : 2 * n] - moved[:, n : 2 * n], motion[:, ::-1], atol=1e-12)
    source = 0.0 if name == "parallel" else motion[:, ::-1]
    np.testing.assert_allclose(still[:, :n] - moved[:, :n], np.broadcast_to(source, (6, n)), atol=1e-12)
    np.testing.assert_array_equal(still[:, 2 * n :], moved[:, 2 * n :])


def test_refusals():
    geometry, grid = SCANS["fan"]
    for motion in (np.zeros((5, 2)), np.zeros((6, 3)), np.zeros(6)):
        with pytest.raises(ValueError, match=r"motion needs the shape \(6, 2\)"):
            Projector(geometry, grid, motion=motion)
        with pytest.raises(ValueError, match=r"motion needs the shape \(6, 2\)"):
            footprint(geometry, grid, motion=motion)
    with pytest.raises(ValueError, match="not finite"):
        Projector(geometry, grid, motion=np.full((6, 2), np.nan))
    with pytest.raises(ValueError, match="lies inside the grid"):
        Projector(geometry, grid, motion=np.tile([29.0, 149.0], (6, 1)))
