"""Motion of an inset from its own scan: what moves is followed, within its errors; nothing is
invented."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from refusals import refused

import recon
import recon.motion.estimate
from recon.analytic.coverage import _at_rest, consistency_warnings
from recon.analytic.inset import InsetFbp, view_motion
from recon.least_squares.inset_problem import InsetProblem
from recon.motion import PathTooLongError, estimate_motion
from recon.motion.belief import believed, likelihood_of
from recon.motion.estimate import _about, _Found
from recon.motion.problem import MotionProblem, basis_of
from recon.study.motion_estimates import AlongAxis, JumpMotion
from recon.study.paths import KINDS, true_path
from recon.variable_projection import Normal
from torchpcct import ConeBeam, FanBeam, ParallelBeam, Scan, VolumeGrid, acquire, full_turn
from torchpcct.geometry import project_points
from torchpcct.scanner import presets
from torchpcct.scene import Body, Scene, SinusoidalMotion
from torchpcct.scene.bodies import Ellipsoid, EllipticCylinder

X, Y = -18.0, -12.0
GRID = VolumeGrid((9, 16, 16), 0.45, (0.0, Y, X))
SCANNER = presets.pcct(views=48, rows=16, columns=500)
TURN_S = 0.35
EXPOSURE_S = 40.0  # 48 views of the many of a turn


def _scan(*motion: SinusoidalMotion, second: bool = False) -> Scan:
    def ball(name: str, radius: float, dx: float, material: str) -> Body:
        return Body(name, Ellipsoid((radius,) * 3, position=(X + dx, Y, 0.0)), material, "patient")

    bodies = [Body("patient", EllipticCylinder(40.0), "pericoronary_fat")]
    bodies += [ball("vessel", 1.2, -1.6 if second else 0.0, "blood_iodine")]
    bodies += [ball("second", 1.0, 2.0, "blood_iodine")] if second else []
    scene = Scene(bodies, motion)
    return acquire(scene, SCANNER, region=GRID, rotation_s=TURN_S, sub_rays=16)


@pytest.fixture(scope="module")
def moving():
    return _scan(SinusoidalMotion("vessel", 1.0, direction=0.4))


def _truth(scan: Scan) -> Any:
    motion = SinusoidalMotion("vessel", 1.0, direction=0.4)
    path = view_motion(motion, scan.geometry, TURN_S)
    return path, path - path.mean(0)


def test_a_moving_inset_is_followed_and_shown_at_rest(moving):
    scan = moving.with_noise(EXPOSURE_S, 0)
    volume = recon.reconstruct(scan, GRID, motion="estimate")
    said = volume.report["motion"]
    path, truth = np.array(said["path_mm"]), _truth(scan)[1]
    errors = np.array(said["errors_mm"])
    assert said["held"]
    assert said["jump"] is None
    assert not any("move differently" in text for text in volume.report["warnings"])
    assert np.sqrt(((path - truth) ** 2).sum(1).mean()) < 0.06
    assert (np.abs(path - truth) < 3.5 * errors).all()
    assert said["misfit"][1] < 0.7 * said["misfit"][0]
    known, ignored = (
        InsetFbp(scan, [GRID], ["standard"], motion=m)(scan)[0][0] for m in (truth, None)
    )
    off = [float((v - known).square().mean().sqrt()) for v in (volume.data, ignored)]
    assert off[0] < 0.25 * off[1]
    again = recon.reconstruct(scan, GRID, motion=path)
    torch.testing.assert_close(again.data, volume.data, rtol=0, atol=0.5)
    for still in (volume, again):  # taken out of what the tests of the scan see, too
        assert not any("object moved" in text for text in still.report["warnings"])


def test_a_motion_that_is_not_that_of_the_readings_is_named(moving):
    scan, truth = moving.with_noise(EXPOSURE_S, 0), _truth(moving)[1]
    assert consistency_warnings(scan, GRID, truth) == []
    (ignored,) = consistency_warnings(scan, GRID)
    assert "the object moved" in ignored
    for wrong in (-truth, truth[:, [0, 2, 1]], truth[::-1]):
        (text,) = consistency_warnings(scan, GRID, wrong)
        assert "the object moved" in text
        assert "its sign, the order z, y, x" in text
    (said,) = (t for t in reconstruct_said(scan, -truth) if "object moved" in t)
    assert "with the given motion taken out" in said
    rest = _scan().with_noise(EXPOSURE_S, 1)
    assert consistency_warnings(rest, GRID, np.zeros_like(truth)) == []
    assert len(consistency_warnings(rest, GRID, truth)) == 1


def reconstruct_said(scan, motion, **options):
    return recon.reconstruct(scan, GRID, motion=motion, **options).report["warnings"]


@pytest.mark.extended
def test_a_problem_that_moves_is_tested_along_its_motion(moving):
    scan, truth = moving.with_noise(EXPOSURE_S, 0), _truth(moving)[1]
    for sign, said in ((1.0, False), (-1.0, True)):
        problem = InsetProblem(scan, GRID).with_motion(sign * truth)
        found = recon.reconstruct(scan, GRID, "pwls", problem=problem).report["warnings"]
        assert any("object moved" in text for text in found) is said


@pytest.mark.parametrize("detector", ["flat", "curved"])
def test_readings_are_moved_to_where_they_would_be_at_rest(detector):
    """A point's shadow in every view, of a cone beam and of a parallel one."""
    cone = ConeBeam(full_turn(7), 400.0, 700.0, 70, 50, (0.7, 0.8), detector=detector)
    parallel = ParallelBeam(full_turn(7), 70, 0.8)
    about, motion = (3.0, -5.0), np.random.default_rng(0).uniform(-2, 2, (7, 3))
    for g in (cone, parallel):
        shapes = [g.row_positions, g.column_positions][-1 - g.has_rows :]

        def shadow(points, g=g, axes=shapes):
            # A smooth spot where the point is seen.
            z, y, x = points.T
            seen = project_points(g, x, y, z)[: len(axes)]
            at = [a - v[:, None] for a, v in zip(axes, reversed(seen), strict=True)]
            spots = [np.exp(-0.5 * (a / 3.0) ** 2) for a in at]
            return torch.from_numpy(
                spots[0] if len(spots) == 1 else spots[0][:, :, None] * spots[1][:, None, :]
            )

        moved, rest = (shadow(np.array((0.0, *about)) + m) for m in (motion, 0.0 * motion))
        assert float((moved - rest).abs().max()) > 0.2
        found = _at_rest(moved, g, about, motion)
        torch.testing.assert_close(found, rest, rtol=0, atol=0.02)


@pytest.mark.extended
def test_a_jump_is_found_and_said():
    """Along the ray of its view, where no view sees it."""
    jump = JumpMotion("vessel", 0.8, direction=0.0, at_s=0.5 * TURN_S)
    scan = _scan(jump).with_noise(EXPOSURE_S, 0)
    found = estimate_motion(scan, GRID)
    path = view_motion(jump, scan.geometry, TURN_S)
    off = found.path - path + path.mean(0)
    assert found.jump is not None
    assert abs(found.jump.view - 24) <= 1
    assert np.linalg.norm(found.jump.mm - [0.0, 0.0, 0.8]) < 0.1
    assert np.median(np.linalg.norm(off, axis=1)) < 0.05
    assert "its motion is not smooth" in found.warnings[0]
    assert found.report()["jump"]["view"] == found.jump.view


def test_a_path_far_along_the_axis_is_refused(monkeypatch):
    scan = _scan(AlongAxis("vessel", 0.8)).with_noise(EXPOSURE_S, 0)
    path = estimate_motion(scan, GRID).path
    assert 0.2 < np.abs(path[:, 0]).max() < recon.motion.estimate._REACH_ALONG_MM
    monkeypatch.setattr(recon.motion.estimate, "_REACH_ALONG_MM", 0.1)
    with pytest.raises(PathTooLongError, match=r"along the axis, more than the 0\.1 mm"):
        estimate_motion(scan, GRID)


def test_no_motion_is_invented():
    scan = _scan().with_noise(EXPOSURE_S, 1)
    found = estimate_motion(scan, GRID)
    assert not found.held
    assert not found.path.any()
    assert found.rms_mm < 0.04
    assert found.errors.max() < 0.1
    assert "show no motion" in found.warnings[0]


@pytest.mark.extended
def test_vessels_that_move_differently_are_said():
    apart = [
        SinusoidalMotion(name, 0.5, direction=way) for name, way in (("vessel", 0), ("second", 1.6))
    ]
    found = estimate_motion(_scan(*apart, second=True).with_noise(EXPOSURE_S, 2), GRID)
    assert any("may move differently" in text for text in found.warnings)
    alike = [replace(m, direction=0.3) for m in apart]
    found = estimate_motion(_scan(*alike, second=True).with_noise(EXPOSURE_S, 2), GRID)
    assert found.held
    assert not found.warnings


@pytest.mark.extended
def test_errors_cover_what_noise_does(moving):
    truth = _truth(moving)[1]
    found = [estimate_motion(moving.with_noise(EXPOSURE_S / 6, seed), GRID) for seed in range(6)]
    off = np.array([(f.path - truth) / f.errors for f in found])
    assert np.mean(np.abs(off) < 2.0) > 0.9
    assert np.sqrt(np.mean(off**2)) > 0.1  # nor are they empty words


@pytest.mark.extended
def test_a_beating_heart(moving, monkeypatch):
    """It does not jump: nothing of the kind is looked for."""
    monkeypatch.setattr("recon.motion.estimate._with_jump", None)
    beat = SinusoidalMotion("vessel", 0.8, rate_bpm=100.0, direction=1.0)
    scan = _scan(beat).with_noise(EXPOSURE_S, 0)
    found = estimate_motion(scan, GRID, heart_rate=100.0, rotation_s=TURN_S)
    path = view_motion(beat, scan.geometry, TURN_S)
    assert np.sqrt(((found.path - path + path.mean(0)) ** 2).sum(1).mean()) < 0.08


def test_what_the_readings_leave_open_stays_open():
    """Paths of any direction, of which one coefficient an axis is seen: the others are covered too.
    Of the likeliest prior alone 64 % are."""
    rng = np.random.default_rng(0)
    seen = np.tile([0.01, 3.0, 3.0, 3.0, 3.0, 3.0], 3)  # mm
    inside = []
    for _ in range(20):
        truth = 0.3 * rng.standard_normal(18) * np.repeat([0.3, 1.0, 1.0], 6)
        information = np.diag(seen**-2.0)
        pull = truth / seen**2 + rng.standard_normal(18) / seen
        found = believed(Normal(information, pull, information, 1.0), np.zeros((6, 3)), 1.0)
        off = found.mean.T.ravel() - truth
        inside.append(np.abs(off) <= 2.0 * np.sqrt(np.diag(found.covariance)))
    assert 0.9 < np.mean(inside) < 0.995


@pytest.mark.extended
def test_loops_are_covered(moving):
    """Drawn in the equations of one scan, whose noise they have: 95 % within two errors, of all
    together."""
    problem = MotionProblem(moving.with_noise(EXPOSURE_S, 0), GRID, None)
    at = np.linalg.lstsq(problem.basis, _truth(moving)[1], rcond=None)[0]
    seen = problem.at(at)[0]
    precision = likelihood_of(seen, at, problem.inflation)[0]
    rng = np.random.default_rng(0)
    noise = np.linalg.cholesky(precision + 1e-9 * np.trace(precision) * np.eye(len(precision)))
    inside, off = [], []
    for _ in range(60):
        path = true_path(KINDS["loops"](rng), moving)
        pull = precision @ np.linalg.lstsq(problem.basis, path, rcond=None)[0].T.ravel()
        pull += noise @ rng.standard_normal(len(pull))
        found = believed(Normal(precision, pull, precision, 1.0), 0.0 * at, 1.0)
        errors = problem.errors(found.covariance)
        off.append((problem.path(found.mean) - path) / errors)
        inside.append(np.mean(np.abs(off[-1]) <= 2.0))
    assert 0.9 < np.mean(inside) < 0.99
    assert 0.7 < np.sqrt(np.mean(np.square(off))) < 1.1


def test_a_jump_is_told_from_a_smooth_path():
    """Of noisy displacements along one axis in every view."""
    rng, times = np.random.default_rng(0), np.linspace(0.0, 1.0, 60)
    smooth = basis_of(times, None)
    late = (times > 0.4) - np.mean(times > 0.4)
    columns = np.column_stack([smooth, late])
    seen = np.kron(np.eye(3), columns.T @ columns) / 0.05**2
    for path, jumps in ((0.3 * smooth[:, 0] - 0.2 * smooth[:, 2], False), (0.3 * late, True)):
        drawn = np.outer([0.0, 0.6, 0.8], path) + 0.05 * rng.standard_normal((3, 60))
        pull = (drawn @ columns).ravel() / 0.05**2
        found = believed(Normal(seen, pull, seen, 1.0), np.zeros((7, 3)), 1.0, jumps=True)
        assert (found.gain > 8.0) is jumps
        assert found.mean[-1] == pytest.approx([0.0, 0.18 * jumps, 0.24 * jumps], abs=0.07)
        off = columns @ found.mean - np.outer(path, [0.0, 0.6, 0.8])
        assert np.sqrt((off**2).mean()) < 0.03


def test_a_jump_has_the_view_the_size_and_the_errors_of_its_coefficients():
    """The last one of each axis, at the first of the views that were averaged."""
    errors = np.arange(1.0, 10.0)
    problem = SimpleNamespace(jump=3, first_view=lambda view: 10 * view)
    found = SimpleNamespace(
        problem=problem,
        coefficients=np.array([[9.0, 9.0, 9.0], [9.0, 9.0, 9.0], [0.0, 0.3, 0.4]]),
        belief=SimpleNamespace(covariance=np.diag(errors**2)),
    )
    jump = _Found.jump.fget(found)
    assert jump.view == 30
    assert jump.length == pytest.approx(0.5)
    assert jump.errors == pytest.approx([3.0, 6.0, 9.0], rel=1e-3)
    problem.jump = None
    assert _Found.jump.fget(found) is None


def test_a_jump_of_averaged_views_is_one_between_two_of_the_scan():
    averaged = SimpleNamespace(_averaging=np.kron(np.eye(4), np.full(2, 0.5)))
    assert MotionProblem.first_view(averaged, 2) == 4
    assert MotionProblem.late(averaged, 2) == pytest.approx([-0.5] * 4 + [0.5] * 4)
    assert MotionProblem.late(averaged, 3) == pytest.approx([-0.25] * 6 + [0.75] * 2)


def test_a_jump_at_the_same_view_is_no_gain(moving):
    """Nor are views before the first and behind the last asked for."""
    problem = MotionProblem(moving.with_noise(EXPOSURE_S, 0), GRID, None).with_jump(24)
    at = np.zeros((problem.basis.shape[1], 3))
    effects = problem.at(at)[1]
    same, other = problem.gains([24, 12], at, effects)
    assert same == pytest.approx(0.0, abs=1e-6)
    assert abs(other) > 1e-3
    found = SimpleNamespace(problem=problem)
    assert _about(found, 2, 4) == [1, 3, 4, 5, 6]
    assert _about(found, 46, 2) == [44, 45, 47]


def test_voxels_are_no_larger_than_cells(moving):
    coarse = MotionProblem(moving, VolumeGrid((4, 7, 7), 1.0, GRID.center), None)
    assert max(coarse.grid.spacing) == pytest.approx(moving.geometry.cell)


def test_refusals(moving):
    counts = torch.ones(moving.geometry.shape)
    whole = replace(moving, window=None, exterior=None, region=None, counts=counts)
    fan = FanBeam(full_turn(60), 40.0, 60.0, 48, 0.4)
    flat = Scan.from_line_integrals(torch.zeros(fan.shape), fan, photons=1e4, mu_water=0.02)
    few = moving.select(slice(0, None, 2))
    refused(
        ("only if the exterior of the inset is known", lambda: estimate_motion(whole, GRID)),
        ("at least 48 views", lambda: estimate_motion(few, GRID)),
        ("cone beams on a circle", lambda: estimate_motion(flat, GRID)),
        ("needs rotation_s", lambda: estimate_motion(moving, GRID, heart_rate=60.0)),
        ("give both", lambda: estimate_motion(moving, GRID, rotation_s=0.35)),
        ("must be a Scan", lambda: estimate_motion(torch.zeros(3), GRID)),  # type: ignore[arg-type]
        ('"estimate" or', lambda: recon.reconstruct(moving, GRID, motion="guess")),
        ("exterior of the inset", lambda: recon.reconstruct(whole, GRID, motion="estimate")),
        (r"\(48, 3\)", lambda: recon.reconstruct(moving, GRID, motion=np.zeros((47, 3)))),
    )
