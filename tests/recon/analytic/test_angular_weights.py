"""Angular weights: pairs of conjugate rays, spacing, short and over-scans."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.analytic.angular_weights import angular_weights, parker_share
from recon.analytic.coverage import view_notes
from torchpcct.angles import view_steps
from torchpcct.geometry import ConeBeam, FanBeam, ParallelBeam, VolumeGrid, full_turn

FAN = dict(sod=570.0, sdd=1040.0, columns=81, pitch=8.0)
HALF_FAN = math.atan(40 * 8.0 / 1040.0)


def line_of_ray(beta: float, gamma: float) -> tuple[float, float]:
    """Direction (mod π) and signed distance of a ray, from the conventions of the geometry
    alone."""
    source = np.array([math.cos(beta), math.sin(beta)])
    across = np.array([-math.sin(beta), math.cos(beta)])
    d = -source * math.cos(gamma) + across * math.sin(gamma)
    normal = np.array([-d[1], d[0]])
    return math.atan2(d[1], d[0]), float(normal @ source)


@settings(max_examples=200, deadline=None)
@given(
    half_fan=st.floats(0.05, 1.5),
    extra=st.floats(0, 1),
    where=st.floats(0, 1),
    ray=st.floats(-0.999, 0.999),
)
def test_pairs_of_conjugate_rays_share_one(half_fan, extra, where, ray):
    """w(β, γ) + w(β′, −γ) = 1 on minimal (extra 0), over- and nearly full (extra 1) scans."""
    virtual = half_fan + extra * (math.pi / 2 - 1e-9 - half_fan)
    span = math.pi + 2 * virtual
    gamma = ray * half_fan
    beta = where * span
    conjugate = beta + math.pi - 2 * gamma
    a, b = line_of_ray(beta, gamma), line_of_ray(conjugate, -gamma)
    # the same line, the other way round
    assert math.isclose(math.cos(a[0] - b[0]), -1, abs_tol=1e-12)
    assert math.isclose(a[1], -b[1], abs_tol=1e-12)
    shares = [
        float(parker_share(np.array(x), np.array(g), virtual))
        for x, g in ((beta, gamma), (conjugate, -gamma), (conjugate - 2 * math.pi, -gamma))
    ]
    assert min(shares) >= 0
    assert sum(shares) == pytest.approx(1, abs=1e-12)


def test_the_outermost_ray_of_a_minimal_scan_counts_once():
    ends = np.array([0.0, math.pi + 2.0])
    assert parker_share(ends, np.array([-1.0, 1.0]), 1.0).tolist() == [1.0, 0.0]


def test_parker_is_smooth_and_not_all_ones():
    beta = np.linspace(0, math.pi + 2 * HALF_FAN, 20001)
    w = parker_share(beta[:, None], np.linspace(-HALF_FAN, HALF_FAN, 7)[1:-1], HALF_FAN)
    assert np.abs(np.diff(w, axis=0)).max() < 2e-3
    assert w[0].max() == 0
    assert w[-1].max() < 1e-20
    assert w.max() == 1
    assert 0.4 < w.mean() < 0.95


@pytest.mark.parametrize("detector", ["flat", "curved"])
@pytest.mark.parametrize("degrees", [0.0, 8.0, 60.0, 130.0])
def test_weights_of_a_scan_cover_every_line_once(degrees, detector):
    """Σ over all readings of a line's neighbourhood: the integral of w over β at fixed lines is
    ∫dθ = π."""
    half_fan = HALF_FAN if detector == "flat" else 40 * 8.0 / 1040.0
    span = math.pi + 2 * half_fan + math.radians(degrees)
    n = 720
    geometry = FanBeam((np.arange(n) + 0.5) * span / n + 1.0, **FAN, detector=detector)
    w = angular_weights(geometry)
    assert w.shape == (n, 81)
    # at column γ = 0 both readings of each line lie in the same column
    assert w[:, 40].sum() == pytest.approx(math.pi, rel=1e-5)
    # columns at ±γ together see every line of that distance twice in 2π
    np.testing.assert_allclose(w.sum(axis=0) + w.sum(axis=0)[::-1], 2 * math.pi, rtol=1e-4)
    _, start, covered = view_steps(geometry.angles)
    assert start == pytest.approx(1.0, abs=1e-9)
    assert covered == pytest.approx(span, rel=1e-9)


def test_full_circle_shares_are_one_half():
    w = angular_weights(FanBeam(full_turn(90, 0.3), **FAN))
    assert w.shape == (90, 1)
    np.testing.assert_allclose(w, math.pi / 90, rtol=1e-12)
    assert view_steps(full_turn(90, 0.3))[2] == 2 * math.pi


@settings(max_examples=60, deadline=None)
@given(
    n=st.integers(20, 200),
    turns=st.integers(1, 3),
    jitter=st.floats(0, 0.4),
    copies=st.integers(1, 3),
    seed=st.integers(0, 1000),
)
def test_steps_of_closed_scans_add_up_in_any_order(n, turns, jitter, copies, seed):
    rng = np.random.default_rng(seed)
    angles = full_turn(n) + jitter * rng.uniform(-1, 1, n) * 2 * math.pi / n
    many = np.concatenate([angles + 2 * math.pi * t for t in range(turns)] * copies)
    order = rng.permutation(many.size)
    steps, _, span = view_steps(many[order])
    assert span == 2 * math.pi
    assert steps.sum() == pytest.approx(2 * math.pi, rel=1e-12)
    alone = view_steps(angles)[0]
    expected = np.tile(alone, turns * copies)[order] / (turns * copies)
    np.testing.assert_allclose(steps, expected, rtol=1e-6)


def test_steps_of_known_scans():
    steps, start, span = view_steps(np.array([0.1, 0.2, 0.4, 0.5]))
    np.testing.assert_allclose(steps, [0.1, 0.15, 0.15, 0.1])
    assert (start, span) == pytest.approx((0.05, 0.5))
    steps, _, span = view_steps(np.linspace(0, 2 * math.pi, 11))  # the end repeats the start
    np.testing.assert_allclose(steps, [0.1 * math.pi, *[0.2 * math.pi] * 9, 0.1 * math.pi])
    np.testing.assert_allclose(view_steps(np.array([2.0]))[0], 2 * math.pi)
    np.testing.assert_allclose(view_steps(np.array([2.0, 2.0]))[0], math.pi)
    # an arc that crosses the turn's end
    steps, start, span = view_steps(np.arange(10) * 0.1 + 2 * math.pi - 0.55)
    np.testing.assert_allclose(steps, 0.1)
    assert (start, span) == pytest.approx((2 * math.pi - 0.6, 1.0))


def test_parallel_scans_repeat_after_half_a_turn():
    half = angular_weights(ParallelBeam(np.arange(60) * math.pi / 60, 9, 1.0))
    np.testing.assert_allclose(half, math.pi / 60)
    np.testing.assert_allclose(angular_weights(ParallelBeam(full_turn(60), 9, 1.0)), math.pi / 60)
    np.testing.assert_allclose(angular_weights(ParallelBeam(full_turn(61), 9, 1.0)), math.pi / 61)
    gap = angular_weights(ParallelBeam(np.arange(178) * math.pi / 180, 9, 1.0))  # two views lost
    assert gap.sum() == pytest.approx(math.pi)


@pytest.mark.parametrize(("turn", "views"), [(360.0, 457), (360.0, 361), (180.0, 181)])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_both_ends_of_a_turn_share_one_step(turn, views, dtype, caplog):
    """Angles of a file, in single precision: no gap "where the usual step is 0.00°", and said as
    what it is."""
    geometry = ParallelBeam(np.deg2rad(np.linspace(0.0, turn, views)).astype(dtype), 9, 1.0)
    weights = angular_weights(geometry)[:, 0]
    assert weights.sum() == pytest.approx(math.pi)
    inner = weights[1:-1]
    np.testing.assert_allclose(inner, inner.mean(), rtol=0.35 if turn == 360.0 else 0.01)
    assert weights[0] + weights[-1] == pytest.approx(inner.mean(), rel=0.4)
    assert not caplog.records
    (note,) = view_notes(geometry)
    assert f"from 0° to {turn:.0f}°, both ends included" in note
    assert ("mirrored" in note) == (turn == 180.0)
    assert view_notes(replace(geometry, angles=geometry.angles[:-1])) == []


def test_each_call_warns_and_has_weights_of_its_own(caplog):
    """Those of small scans are kept, of which a caller who changes them must know nothing."""
    angles = np.delete(np.arange(300), [50, 51, 52]) * math.pi / 180
    geometry = FanBeam(angles, **FAN)
    expected = angular_weights(replace(geometry, angles=angles + 1e-3))
    caplog.clear()
    for calls in (1, 2):
        weights = angular_weights(geometry)
        np.testing.assert_allclose(weights, expected, atol=1e-6)
        weights[:] = 0.0
        assert caplog.text.count("gap of 4.00° where the usual step is 1.00°") == calls


def test_weights_of_a_short_scan_follow_the_grid():
    """Of an offset detector's short scan one grid is complete, a larger one is refused."""
    geometry = FanBeam(np.arange(230) * math.pi / 180, 570.0, 1040.0, 81, 8.0, offset=200.0)
    small = VolumeGrid((8, 8), 5.0)
    assert angular_weights(geometry, small).shape == (230, 81)
    with pytest.raises(ValueError, match="needs a full turn"):
        angular_weights(geometry)
    with pytest.raises(ValueError, match="needs a full turn"):
        angular_weights(geometry, VolumeGrid((80, 80), 5.0))
    assert angular_weights(geometry, small).shape == (230, 81)


def test_too_few_views_are_refused():
    with pytest.raises(ValueError, match=r"cover 120\.0°, but parallel rays need 180°"):
        angular_weights(ParallelBeam(np.arange(120) * math.pi / 180, 9, 1.0))
    with pytest.raises(
        ValueError,
        match=r"cover 200\.0°, but this fan needs 180° \+ 34\.\d°.*or reconstruct by \"pwls\"",
    ):
        angular_weights(FanBeam(np.arange(200) * math.pi / 180, **FAN))


@pytest.mark.parametrize("kind", [FanBeam, ConeBeam])
@pytest.mark.parametrize("step", [0.5, 2.0, 5.0, 9.0])
@pytest.mark.parametrize("lacking", [0.0, 3.0, 7.0])
def test_a_short_scan_that_lacks_some_of_its_fan(kind, step, lacking):
    """What may lack does not grow with the step: at 5° a whole fan of 7° once passed without a
    word."""
    cells = (100,) if kind is FanBeam else (100, 2)
    half_fan = math.degrees(math.atan(50 * 0.5 / 400.0)) - math.degrees(0.25 / 400.0)
    needed = 180.0 + 2.0 * half_fan
    views = math.ceil((needed - lacking) / step)
    # Equal steps that cover exactly so much, half a step beyond the first and the last view.
    angles = np.deg2rad(np.arange(views) * (needed - lacking) / views)
    geometry = kind(angles, 300.0, 400.0, *cells, 0.5)
    if lacking:
        with pytest.raises(ValueError, match="but this fan needs 180°"):
            angular_weights(geometry)
    else:
        assert angular_weights(geometry).shape == (views, 100)
