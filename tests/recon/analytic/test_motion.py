"""Backprojection onto a displaced grid, and the reconstruction of a moving inset."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from analytic import Gaussian, line_integrals
from linear_maps import mismatch
from refusals import refused

from recon.analytic.backproject import BackprojectionPlan, backproject
from recon.analytic.fbp import Fbp, fbp
from recon.analytic.inset import InsetFbp, view_motion
from recon.least_squares.inset_problem import InsetProblem
from recon.least_squares.qggmrf import QGGMRF
from torchpcct.acquisition.acquire import acquire
from torchpcct.detector_window import DetectorWindow, footprint
from torchpcct.geometry import ConeBeam, FanBeam, ParallelBeam, VolumeGrid, full_turn
from torchpcct.scanner import presets
from torchpcct.scene import Body, Scene, SinusoidalMotion
from torchpcct.scene.bodies import Ellipsoid, EllipticCylinder
from torchpcct.vector_geometry import VectorGeometry

ANGLES = full_turn(12, 0.2)
PLANE = VolumeGrid((9, 7), 0.9, (6.0, -12.0))
VOLUME = VolumeGrid((6, 9, 7), 0.9, (0.5, 6.0, -12.0))
SCANS: dict[str, tuple[Any, VolumeGrid]] = {
    "parallel": (ParallelBeam(ANGLES, 60, 0.9, 0.1), PLANE),
    "fan": (FanBeam(ANGLES, 100.0, 180.0, 60, 1.6, 0.3), PLANE),
    "fan curved": (FanBeam(ANGLES, 100.0, 180.0, 60, 1.6, detector="curved"), PLANE),
    "cone": (ConeBeam(ANGLES, 100.0, 180.0, 60, 16, (1.1, 1.6), (0.2, 0.3)), VOLUME),
    "cone curved": (ConeBeam(ANGLES, 100.0, 180.0, 60, 16, (1.1, 1.6), detector="curved"), VOLUME),
    # heights change by rows within a tile: the kernel's other path
    "steep": (
        ConeBeam(ANGLES, 40.0, 72.0, 96, 16, (0.9, 1.2), detector="curved"),
        replace(VOLUME, spacing=1.4),
    ),
}


def _path(axes: int, views: int = 12) -> np.ndarray:
    return np.random.default_rng(3).uniform(-2, 2, (views, axes))


def _moved(grid: VolumeGrid, shift: np.ndarray) -> VolumeGrid:
    return replace(grid, center=tuple(c + s for c, s in zip(grid.center, shift, strict=True)))


@pytest.mark.parametrize("name", sorted(SCANS))
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 2e-5), (torch.float64, 1e-12)])
def test_each_view_sees_the_grid_where_it_is_then(name, dtype, tolerance):
    """The sum over views of single-view backprojections onto displaced grids at rest."""
    geometry, grid = SCANS[name]
    motion = _path(grid.ndim)
    data = torch.randn(2, *geometry.shape, dtype=dtype, generator=torch.Generator().manual_seed(0))
    parts = [
        backproject(data[:, v : v + 1], geometry.select([v]), _moved(grid, motion[v]))
        for v in range(geometry.views)
    ]
    expected = torch.stack(parts).sum(0)
    found = backproject(data, geometry, grid, motion=motion)
    torch.testing.assert_close(
        found, expected, rtol=0, atol=tolerance * float(expected.abs().max())
    )
    rest = backproject(data, geometry, grid)
    assert torch.equal(backproject(data, geometry, grid, motion=np.zeros_like(motion)), rest)
    assert (rest - found).abs().max() > 0.1 * found.abs().max()


@pytest.mark.parametrize("name", sorted(SCANS))
def test_transpose_through_a_window(name):
    geometry, grid = SCANS[name]
    motion = _path(grid.ndim)
    window = footprint(geometry, grid, margin=1, motion=motion)
    plan = BackprojectionPlan(geometry, grid, window, motion)
    shape = (
        (window.views, window.rows, window.columns)
        if grid.ndim == 3
        else (window.views, window.columns)
    )
    assert mismatch(plan.forward, plan.transpose, shape, grid.shape) <= 1e-13


@pytest.mark.parametrize("name", sorted(set(SCANS) - {"steep"}))
def test_a_moving_body_is_shown_at_rest(name):
    few, grid = SCANS[name]
    views = 120
    changes: dict[str, Any] = {"angles": full_turn(views), "columns": 120}
    changes |= {"pitch": (1.0, 0.8), "rows": 8} if grid.ndim == 3 else {"pitch": 0.8}
    geometry = replace(few, **changes)
    grid = VolumeGrid((3, 7, 7)[-grid.ndim :], 0.5, (0.0, *grid.center[-2:])[-grid.ndim :])
    phase = np.arange(views) / views * 2.2
    # in the plane: FDK is exact for no other motion
    motion = np.stack([0.0 * phase, 1.1 * np.sin(phase), 2.0 * np.cos(phase)], axis=1)[
        :, -grid.ndim :
    ]
    body = Gaussian(tuple(c + 0.3 for c in grid.center), (1.5,) * grid.ndim, 0.0, 0.02)

    def at(v: int) -> np.ndarray:
        center = tuple(c + s for c, s in zip(body.center, motion[v], strict=True))
        return line_integrals(geometry.select([v]), [replace(body, center=center)])

    moving = torch.from_numpy(np.concatenate([at(v) for v in range(views)]))
    rest = fbp(torch.from_numpy(line_integrals(geometry, [body])), geometry, grid, "soft")
    found = fbp(moving, geometry, grid, "soft", motion=motion)
    ignored = fbp(moving, geometry, grid, "soft")
    error = float((found - rest).abs().max() / rest.max())
    assert error < 0.02
    assert float((ignored - rest).abs().max() / rest.max()) > 0.3


# A vessel in a cylinder of fat: the exterior stands still.

CENTER = (0.0, -24.0, -20.0)
GRID = VolumeGrid((4, 24, 24), 0.4, CENTER)
TURN_S = 0.35


def _scene(amplitude: float) -> Scene:
    x, y = CENTER[2], CENTER[1]
    bodies = (
        Body("patient", EllipticCylinder(60.0), "pericoronary_fat"),
        Body(
            "vessel", Ellipsoid((1.6, 1.6, 6.0), position=(x, y, 0.0)), "fibrous_tissue", "patient"
        ),
        Body(
            "lumen",
            Ellipsoid((0.9, 0.9, 5.0), position=(x + 0.3, y, 0.0)),
            "blood_iodine",
            "vessel",
        ),
    )
    return Scene(
        bodies, SinusoidalMotion("vessel", amplitude, direction=0.4) if amplitude else None
    )


@pytest.fixture(scope="module")
def scans():
    scanner = presets.pcct(views=300, rows=8, columns=700)
    return {
        a: acquire(_scene(a), scanner, region=GRID, rotation_s=TURN_S, sub_rays=16)
        for a in (0.0, 2.0)
    }


@pytest.fixture(scope="module")
def path(scans):
    return view_motion(_scene(2.0).motion[0], scans[2.0].geometry, TURN_S)


def test_view_motion_is_that_of_the_acquisition(path):
    assert path.shape == (300, 3)
    np.testing.assert_array_equal(path[0], 0.0)
    np.testing.assert_allclose(path[:, 0], 0.0)
    np.testing.assert_allclose(path[:, 1], path[:, 2] * np.tan(0.4), atol=1e-12)
    assert np.hypot(path[:, 1], path[:, 2]).max() == pytest.approx(2.0, rel=1e-3)


def test_compensated_fbp_shows_the_inset_at_rest(scans, path):
    rest = InsetFbp(scans[0.0], [GRID], ["standard"])(scans[0.0])[0]
    found = InsetFbp(scans[2.0], [GRID], ["standard"], motion=path)(scans[2.0])[0]
    ignored = InsetFbp(scans[2.0], [GRID], ["standard"])(scans[2.0])[0]
    rms = [float((v - rest).square().mean().sqrt()) for v in (found, ignored)]
    assert rms[0] < 5.0
    assert rms[1] > 60.0
    # Fat at the corners: the body of fat has not moved along.
    corner = (found - rest)[..., :3, :3].abs().max()
    assert corner < 3.0


@pytest.mark.extended
def test_compensated_pwls_shows_the_inset_at_rest(scans, path):
    prior = QGGMRF(strength=0.3, threshold=300.0)
    problem = InsetProblem(scans[0.0], GRID)
    rest, _ = problem.solve(problem.term(scans[0.0]), prior, tolerance=2.0)
    moved = problem.with_motion(path)
    found, report = moved.solve(moved.term(scans[2.0]), prior, tolerance=2.0)
    assert report["converged"]
    assert report["exact_pairs"] <= 6
    assert float((found - rest).square().mean().sqrt()) < 12.0
    same = InsetProblem(scans[2.0], GRID, nodes=1).with_motion(path)
    assert torch.equal(same.data(scans[2.0]), moved.data(scans[2.0]))
    assert moved.with_motion(None).window == problem.window != moved.window
    # The Gram holds for the moving operator about as well as for the one at rest; its weights move
    # along.
    x = rest[0] - rest.min()
    errors = []
    for gram, p in ((problem.gram, problem), (moved.gram, moved), (problem.gram, moved)):
        exact = p.projector.T(p.weights * p.projector(x))
        errors.append(float((gram(x) - exact).norm() / exact.norm()))
    assert errors[0] < 0.005
    assert errors[1] < 0.007
    assert errors[2] > 0.015


def test_refusals(scans, path):
    geometry, grid = SCANS["fan"]
    data, narrow = torch.zeros(geometry.shape), DetectorWindow(np.full(12, 15), 30)
    whole = replace(
        scans[0.0],
        window=None,
        exterior=None,
        region=None,
        counts=torch.ones(scans[0.0].geometry.shape),
    )
    refused(
        (
            r"motion needs the shape \(12, 2\)",
            lambda: backproject(data, geometry, grid, motion=np.zeros((12, 3))),
        ),
        ("not finite", lambda: backproject(data, geometry, grid, motion=np.full((12, 2), np.inf))),
        (
            "leaves the field of view",
            lambda: backproject(data, geometry, grid, motion=np.full((12, 2), 30.0)),
        ),
        (
            "misses columns",
            lambda: backproject(data[:, :30], geometry, grid, narrow, motion=np.full((12, 2), 4.0)),
        ),
        ("rotation_s", lambda: view_motion(SinusoidalMotion("vessel", 1.0), geometry, 0.0)),
        ("exterior at rest", lambda: InsetFbp(whole, [GRID], ["soft"], motion=path)),
    )


def _readings_and_motion(kind):
    """Random ones, float64, of a scan in :data:`SCANS`."""
    geometry, grid = SCANS[kind]
    random = torch.Generator().manual_seed(3)
    lines = torch.randn(2, *geometry.shape, generator=random, dtype=torch.float64)
    return lines, 0.3 * torch.randn(len(ANGLES), grid.ndim, generator=random, dtype=torch.float64)


@pytest.mark.parametrize("kind", SCANS)
def test_gradients_by_readings_and_motion(kind):
    geometry, grid = SCANS[kind]
    lines, motion = _readings_and_motion(kind)
    expected = fbp(lines, geometry, grid, motion=motion)
    lines.requires_grad_()
    motion.requires_grad_()

    def made(lines, motion):
        return fbp(lines, geometry, grid, motion=motion)

    torch.testing.assert_close(made(lines, motion), expected, rtol=0, atol=0)
    assert torch.autograd.gradcheck(made, (lines, motion), fast_mode=True, atol=1e-7)


def test_an_optimiser_may_change_the_motion_of_a_layer():
    geometry, grid = SCANS["cone"]
    lines, motion = _readings_and_motion("cone")
    layer = Fbp(geometry, grid, motion=torch.nn.Parameter(motion))
    assert [p.shape for p in layer.parameters()] == [motion.shape]
    before = layer(lines).square().sum()
    before.backward()
    with torch.no_grad():
        layer.motion -= 1e-3 * layer.motion.grad / layer.motion.grad.norm()
    after = layer(lines).square().sum()
    step = -1e-3 * float(layer.motion.grad.norm())
    assert (after - before).item() == pytest.approx(step, rel=0.05)
    (first,) = torch.autograd.grad(after, layer.motion, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        first.sum().backward()
    with pytest.raises(ValueError, match="or use Projector"):
        fbp(lines, VectorGeometry.of(geometry), grid, motion=motion.requires_grad_())
