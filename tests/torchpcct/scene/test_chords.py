"""Chord kernels against closed forms, brute-force sampling and invariances."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refused

from torchpcct.scene import (
    Box,
    BulgedTube,
    Ellipsoid,
    EllipticCylinder,
    NarrowedTube,
    chord_lengths,
    rotation_matrix,
)
from torchpcct.scene.chord_kernels import chords_from, may_meet
from torchpcct.scene.chords import pack
from torchpcct.threads import get_num_threads, set_num_threads

PLACE = (-29.63, -30.38, 0.4)
TILT = rotation_matrix((1.0, 2.0, -0.5), 0.7)
SHAPES = {
    "ellipsoid": Ellipsoid((0.6, 0.985, 0.7), position=PLACE, rotation=TILT),
    "cylinder": EllipticCylinder((1.2, 0.7), 2.0, position=PLACE, rotation=TILT),
    "box": Box((0.5, 1.0, 1.5), position=PLACE, rotation=TILT),
    "bulged": BulgedTube(1.68, 0.45, 6.0, 4.83, position=PLACE, rotation=0.4),
    "narrowed": NarrowedTube(1.49, 0.45, 6.0, 4.83, position=PLACE, rotation=0.4),
    "bulged, tilted": BulgedTube(1.68, 0.45, 6.0, 4.83, position=PLACE, rotation=TILT),
    "strong bulge": BulgedTube(1.0, 1.2, 3.0, 2.5, position=PLACE, rotation=-1.1),
    "strong narrowing": NarrowedTube(1.0, 1.2, 3.0, 2.5, position=PLACE, rotation=-1.1),
}


def rays(rng, n, reach, height, spread=2.5):
    """Lines from a source orbit, ``height`` mm around the mid plane, to points around PLACE."""
    beta = rng.uniform(0, 2 * math.pi, n)
    o = np.stack(
        [reach * np.cos(beta), reach * np.sin(beta), height * rng.uniform(-1, 1, n)], axis=1
    )
    target = np.array(PLACE) + rng.uniform(-1, 1, (n, 3)) * (spread, spread, 1.6 * spread)
    d = target - o
    return o, d / np.linalg.norm(d, axis=1, keepdims=True)


def crossings(shape, o, d, half=8.0):
    """Ends of the chords by a dense scan and bisection in numpy: total length to 1e-11 mm,
    number of pieces."""
    t = (np.array(PLACE) - o) @ d + np.linspace(-half, half, 4001)
    flags = shape.contains(o + t[:, None] * d)
    k = np.flatnonzero(flags[1:] != flags[:-1])
    low, high = t[k], t[k + 1]
    for _ in range(45):
        mid = (low + high) / 2
        same = shape.contains(o + mid[:, None] * d) == flags[k]
        low, high = np.where(same, mid, low), np.where(same, high, mid)
    ends = (low + high) / 2
    return float((ends[1::2] - ends[::2]).sum()), len(k) // 2


@pytest.mark.parametrize("height", [0.0, 6.0, 30.0, 120.0, 700.0, 6000.0])
@pytest.mark.parametrize("name", SHAPES)
def test_chords_equal_the_bisected_ends(name, height):
    rng = np.random.default_rng([len(name), int(height)])
    shape = SHAPES[name]
    o, d = (
        np.concatenate(pair)
        for pair in zip(
            rays(rng, 15, 626.0, height), rays(rng, 15, 626.0, height, 0.6), strict=True
        )
    )
    (lengths,) = chord_lengths([shape], o, d)
    hit = 0
    for n in range(len(o)):
        expected, pieces = crossings(shape, o[n], d[n])
        # A piece shorter than the scan's 4e-3 mm step escapes the reference, not the kernel.
        tolerance = 1e-9 if pieces else 4e-3
        # Near grazing the end points are ill-conditioned: an offset of 1e-13 mm moves them by
        # sqrt(1e-13).
        if expected < 0.05:
            tolerance = max(tolerance, 8e-3)
        assert lengths[n] == pytest.approx(expected, abs=tolerance), (n, pieces)
        hit += pieces > 0
    assert hit > 5


@pytest.mark.parametrize("name", ["strong bulge", "bulged"])
def test_a_steep_ray_may_cross_a_bulge_twice(name):
    """Lines almost along the tube that cut both concave flanks: the kernel returns the total of
    all pieces."""
    shape = SHAPES[name]
    rng = np.random.default_rng(3)
    most = 0
    for _ in range(150):
        edge = shape.radius + rng.uniform(0.0, 2 * shape.amplitude)
        a = shape.to_scanner((edge + rng.normal(0, 0.15), rng.normal(0, 0.2), -shape.half_length))
        b = shape.to_scanner((edge + rng.normal(0, 0.15), rng.normal(0, 0.2), shape.half_length))
        d = (b - a) / np.linalg.norm(b - a)
        expected, pieces = crossings(shape, a - 3 * d, d)
        length = chord_lengths([shape], a - 3 * d, d)[0, 0]
        assert length == pytest.approx(expected, abs=1e-9 if expected > 0.1 else 9e-3)
        most = max(most, pieces)
    if name == "strong bulge":
        assert most >= 2


def test_closed_forms():
    sphere = Ellipsoid(3.0, position=(1.0, 2.0, 3.0))
    for offset in (0.0, 1.0, 2.9, 2.9999, 3.0, 3.1):
        expected = 2 * math.sqrt(max(9.0 - offset**2, 0.0))
        length = chord_lengths([sphere], (-500.0, 2.0 + offset, 3.0), (1.0, 0.0, 0.0))[0, 0]
        assert length == pytest.approx(expected, abs=1e-9)
    cylinder = EllipticCylinder(120.0)
    for slope in (0.0, 0.01, 0.3):
        length = chord_lengths([cylinder], (-626.0, 50.0, 0.0), (1.0, 0.0, slope))[0, 0]
        assert length == pytest.approx(
            2 * math.sqrt(120.0**2 - 50.0**2) * math.hypot(1, slope), abs=1e-9
        )
    cube = Box(1.0)
    assert chord_lengths([cube], (-5.0, 0.0, 0.0), (1.0, 0.0, 0.0))[0, 0] == pytest.approx(
        2.0, abs=1e-12
    )
    assert chord_lengths([cube], (-5.0, -5.0, -5.0), (1.0, 1.0, 1.0))[0, 0] == pytest.approx(
        2 * 3**0.5, abs=1e-12
    )
    assert chord_lengths([cube], (-5.0, 1.5, 0.0), (1.0, 0.0, 0.0))[0, 0] == 0.0


def test_along_the_axis():
    finite, endless = EllipticCylinder(2.0, 3.0), EllipticCylinder(2.0)
    tube = BulgedTube(1.68, 0.45, 6.0, 4.83)
    narrow = NarrowedTube(1.49, 0.45, 6.0, 4.83)
    up = (0.0, 0.0, 1.0)
    assert chord_lengths([finite], (0.5, 0.0, -9.0), up)[0, 0] == pytest.approx(6.0, abs=1e-12)
    assert chord_lengths([endless], (0.5, 0.0, -9.0), up)[0, 0] == math.inf
    assert chord_lengths([endless], (2.5, 0.0, -9.0), up)[0, 0] == 0.0
    assert chord_lengths([tube, narrow], (0.0, 0.0, -9.0), up)[:, 0] == pytest.approx(
        [9.66, 9.66], abs=1e-12
    )
    # At x = R + d(1) the line is inside the bulge for |z| < z* with R + 2 d(z*) = x.
    x = 1.68 + 0.45
    expected = 2 * 6.0 / math.pi * math.acos(math.sqrt(0.5))
    assert chord_lengths([tube], (x, 0.0, -9.0), up)[0, 0] == pytest.approx(expected, abs=1e-10)
    # In the narrowed tube the same x is outside where the lumen's edge 2 R²/(R + d) - R lies below
    # it.
    x = 1.2
    d = 2 * 1.49**2 / (x + 1.49) - 1.49
    expected = 9.66 - 2 * 6.0 / math.pi * math.acos(math.sqrt(d / 0.45))
    assert chord_lengths([narrow], (x, 0.0, -9.0), up)[0, 0] == pytest.approx(expected, abs=1e-10)
    assert chord_lengths([BulgedTube(1.0, 0.0, 3.0)], (0.2, 0.0, -9.0), up)[0, 0] == math.inf


number = st.floats(-1.0, 1.0)


@settings(max_examples=60, deadline=None)
@given(
    name=st.sampled_from(sorted(SHAPES)),
    angle=st.floats(0.0, 6.28),
    axis=st.tuples(number, number, number).filter(lambda a: np.linalg.norm(a) > 0.1),
    shift=st.tuples(number, number, number),
    seed=st.integers(0, 10**6),
)
def test_moving_everything_changes_nothing(name, angle, axis, shift, seed):
    """A rigid motion of shape and ray together, the reverse ray and another starting point give
    the same chord."""
    shape = SHAPES[name]
    o, d = rays(np.random.default_rng(seed), 4, 300.0, 100.0)
    turn, move = rotation_matrix(axis, angle), 20.0 * np.array(shift)
    moved = replace(
        shape, position=tuple(turn @ shape.position + move), rotation=turn @ shape.matrix
    )
    (reference,) = chord_lengths([shape], o, d)
    clear = reference > 0.1  # near grazing the chord is ill-conditioned
    for other in (
        chord_lengths([moved], o @ turn.T + move, d @ turn.T),
        chord_lengths([shape], o, -3.0 * d),
        chord_lengths([shape], o + 77.0 * d, d),
    ):
        np.testing.assert_allclose(other[0][clear], reference[clear], atol=2e-9)
        np.testing.assert_allclose(other[0], reference, atol=1e-4)


def test_bad_input_is_named():
    shape, bad = Ellipsoid(1.0), [(1.0, 0.0, 0.0), (math.nan, 0.0, 0.0)]
    refused(
        (
            "origins must have the shape",
            lambda: chord_lengths([shape], np.zeros((2, 2)), (1.0, 0.0, 0.0)),
        ),
        ("directions must be finite, but row 1", lambda: chord_lengths([shape], np.zeros(3), bad)),
        ("row 0 is 0", lambda: chord_lengths([shape], np.zeros(3), np.zeros(3))),
        ("equally many", lambda: chord_lengths([shape], np.zeros((2, 3)), np.ones((3, 3)))),
        (r"shapes\[0\] must be a shape", lambda: pack(["sphere"])),
    )


def test_same_result_with_one_thread():
    o, d = rays(np.random.default_rng(0), 5000, 626.0, 5.0)
    shapes = list(SHAPES.values())
    many = chord_lengths(shapes, o, d)
    threads = get_num_threads()
    set_num_threads(1)
    try:
        single = chord_lengths(shapes, o, d)
    finally:
        set_num_threads(threads)
    assert np.array_equal(many, single)


@pytest.mark.parametrize("height", [0.0, 6.0, 120.0, 6000.0])
@pytest.mark.parametrize("name", SHAPES)
def test_many_rays_of_one_source_have_the_chords_of_each(name, height):
    """Rays that hit, miss and graze, shallow and steep, side by side."""
    rng = np.random.default_rng([len(name), int(height), 1])
    origin = rays(rng, 1, 626.0, height)[0][0]
    targets = np.array(PLACE) + rng.uniform(-1, 1, (60, 3)) * (1.5, 1.5, 2.2)
    d = targets - origin
    d /= np.hypot(d[:, :1], d[:, 1:2])
    kinds, params = pack([SHAPES[name]])
    out = np.full(60, np.nan)
    rows = [np.ascontiguousarray(d[:, axis]) for axis in range(3)]
    chords_from(int(kinds[0]), params, 0, *origin, *rows, np.hypot(1.0, d[:, 2]), 60, out)
    (expected,) = chord_lengths([SHAPES[name]], origin, d)
    np.testing.assert_allclose(out, expected, atol=2e-10)
    seen = [may_meet(params, 0, *origin[:2], *ray) for ray in d[:, :2]]
    assert np.all(seen >= (expected > 0))
    assert (expected > 0).sum() > 5


@pytest.mark.parametrize("shape", [EllipticCylinder(2.0, 3.0), Box((2.0, 2.0, 3.0))])
def test_rays_along_a_face_of_many_from_one_source(shape):
    """No climb, at a height inside, on and beyond the face; exactly along the other faces, too."""
    kinds, params = pack([shape])
    for z in (-3.5, -3.0, 0.0, 2.9, 3.1):
        out, one, zero = np.empty(1), np.ones(1), np.zeros(1)
        chords_from(int(kinds[0]), params, 0, -9.0, 0.0, z, one, zero, zero, one, 1, out)
        assert out[0] == chord_lengths([shape], (-9.0, 0.0, z), (1.0, 0.0, 0.0))[0, 0]
