"""Neighbouring views: wrong order, missing and stuck views, travel and flying spots are found;
sound scans are not."""

import math
import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from analytic import Ellipsoid, line_integrals
from refusals import refused

from torchpcct import ConeBeam, FanBeam, ParallelBeam, Projector, VolumeGrid, full_turn
from torchpcct.checks.moments import moment_test
from torchpcct.checks.neighbours import _beside, neighbour_test, stuck_views

VIEWS = 180
PHOTONS = 2e5
BODIES = [
    Ellipsoid((0.0, 0.0), (55.0, 80.0), value=0.02),
    Ellipsoid((20.0, -30.0), 14.0, value=0.004),
    Ellipsoid((-15.0, 25.0), (9.0, 18.0), 0.4, value=-0.006),
    Ellipsoid((-30.0, -20.0), 7.0, value=0.02),
]
GEOMETRIES = {
    "parallel": ParallelBeam(full_turn(VIEWS), 150, 1.4),
    "half": ParallelBeam(full_turn(VIEWS) / 2, 150, 1.4, 0.35),
    "fan": FanBeam(full_turn(VIEWS), 500.0, 900.0, 180, 2.2, 0.55, "curved"),
    "cone": ConeBeam(full_turn(VIEWS), 500.0, 900.0, 150, 3, 2.6),
}


@cache
def _sinogram(kind):
    return line_integrals(GEOMETRIES[kind], BODIES, sub=1)


def _counts(p, seed=0):
    return torch.from_numpy(
        np.random.default_rng(seed).poisson(PHOTONS * np.exp(-p)).astype(np.float32)
    )


def _lines(p, seed=0):
    return torch.log(PHOTONS / _counts(p, seed).clamp_min(0.5))


def _found(p, g, seed=0):
    return neighbour_test(_lines(p, seed), g).findings


@pytest.mark.parametrize("kind", GEOMETRIES)
def test_sound_scans_raise_no_alarm_in_whatever_order_they_are_stored(kind):
    g, p = GEOMETRIES[kind], _sinogram(kind)
    order = np.random.default_rng(0).permutation(g.views)
    assert (
        _found(p, g)
        == _found(p[order], g.select(order))
        == _found(p[::3], g.select(slice(None, None, 3)))
        == ()
    )
    assert stuck_views(_counts(p), g) == []
    assert stuck_views(torch.from_numpy(p).float(), g) == []  # no noise


@pytest.mark.parametrize("kind", GEOMETRIES)
def test_views_in_random_or_text_order_are_named(kind):
    g, p = GEOMETRIES[kind], _sinogram(kind)
    text = sorted(range(g.views), key=str)
    for order in (np.random.default_rng(0).permutation(g.views), text):
        found = _found(p[order], g)
        assert found
        assert "order" in found[0]
    coarse = slice(None, None, 2)
    assert (
        "not in the order"
        in _found(p[coarse][np.random.default_rng(1).permutation(90)], g.select(coarse))[0]
    )


@pytest.mark.parametrize("kind", GEOMETRIES)
def test_angles_that_scatter_are_named_unless_they_are_described(kind):
    g = GEOMETRIES[kind]
    step = g.angles[1] - g.angles[0]
    for share in (0.3, 0.4):
        true = replace(
            g, angles=g.angles + np.random.default_rng(1).normal(0.0, share * step, VIEWS)
        )
        p = line_integrals(true, BODIES, sub=1)
        (text,) = _found(p, g)
        assert re.search(r"scatter by about 0\.\d of a step", text)
        assert "scatter" not in str(_found(p, true))
    test = neighbour_test(_lines(p), g)
    assert 0.2 < test.sizes["scatter"] < 0.6


@pytest.mark.parametrize("kind", GEOMETRIES)
def test_exchanged_and_lost_views_are_named(kind):
    g, p = GEOMETRIES[kind], _sinogram(kind)
    swapped = p.copy()
    swapped[[40, 120]] = p[[120, 40]]
    assert any(
        f"views {k} and {k + 1}" in text for text in _found(swapped, g) for k in (39, 40, 119, 120)
    )
    turn = 2 * math.pi if kind != "half" else math.pi
    lost = replace(g, angles=np.linspace(0.0, turn, g.views - 5, endpoint=False))
    (text,) = _found(np.delete(p, range(70, 75), 0), lost)
    assert "the views 69 and 70 lie about" in text
    # The same views are no finding where the angles say what is missing.
    assert (
        _found(
            np.delete(p, range(70, 75), 0), g.select(np.delete(np.arange(g.views), range(70, 75)))
        )
        == ()
    )


@pytest.mark.parametrize("kind", GEOMETRIES)
def test_readings_that_repeat_are_named(kind):
    g, p = GEOMETRIES[kind], _sinogram(kind)
    stuck, module, copied = _counts(p), _counts(p), _counts(p)
    stuck[60:66] = stuck[60]
    assert "5 views hold the same readings" in stuck_views(stuck, g)[0]
    module[60:90, ..., 64:96] = module[60, ..., 64:96]
    assert "in the columns 64 … 95 hold the same" in stuck_views(module, g)[0]
    copied[100] = copied[10]
    assert "views 100" in stuck_views(copied, g)[0]
    # Views at one angle may be one reading, clipped air repeats, and a handful of photons does.
    twice = g.select(np.repeat(np.arange(g.views), 2))
    assert stuck_views(_counts(p).repeat_interleave(2, 0), twice) == []
    assert stuck_views(_counts(p).clamp_max(0.8 * PHOTONS), g) == []
    few = np.random.default_rng(0).poisson(4.0 * np.exp(-p)).astype(np.float32)
    assert stuck_views(torch.from_numpy(few), g) == []


@pytest.mark.parametrize("kind", GEOMETRIES)
def test_a_half_that_was_copied_is_named(kind):
    g, p = GEOMETRIES[kind], _sinogram(kind)
    copied, middle = _counts(p), g.views // 2
    copied[middle:] = copied[: g.views - middle]
    assert f"{g.views - middle} views hold the same readings" in stuck_views(copied, g)[0]


@pytest.mark.parametrize("radius", [10.0, 17.0, 21.3])
@pytest.mark.parametrize("photons", [2e3, 2e4, 1e6])
def test_a_symmetric_phantom_of_voxels_without_noise_repeats_and_is_sound(radius, photons):
    grid = VolumeGrid((80, 80), 0.5)
    y, x = np.meshgrid(*grid.axes, indexing="ij")
    disc = torch.from_numpy(np.where(np.hypot(x, y) < radius, 0.02, 0.0)).float()
    for g in (
        ParallelBeam(np.arange(180) * np.pi / 180, 96, 0.5),
        FanBeam(full_turn(180), 300.0, 600.0, 96, 1.0),
    ):
        lines = Projector(g, grid)(disc)
        assert stuck_views(photons * torch.exp(-lines), g) == []
        assert stuck_views(lines, g) == []


@pytest.mark.parametrize("kind", GEOMETRIES)
def test_a_module_that_was_off_is_named_and_a_shadow_is_not(kind):
    g, p = GEOMETRIES[kind], _sinogram(kind)
    off = _counts(p)
    off[60:90, ..., 70:78] = 0.0
    assert "the columns 70 … 77 read nothing in 30 views from number 60" in stuck_views(off, g)[0]
    dense = [
        *BODIES,
        Ellipsoid((-30.0, -20.0), (2.0, 9.0), value=2.0),
        Ellipsoid((1.0, 2.0), 5.0, value=2.0),
    ]
    shadows = _counts(line_integrals(g, dense, sub=1))
    assert (shadows == 0).any()
    assert stuck_views(shadows, g) == []


def test_a_focal_spot_that_flies_is_named_and_measured():
    g, p = GEOMETRIES["parallel"], _sinogram("parallel")
    for columns in (1.0, 2.0):
        moved = line_integrals(replace(g, offset=columns * g.pitch), BODIES, sub=1)
        flying = np.where((np.arange(g.views) % 2 == 0)[:, None], p, moved)
        found = neighbour_test(_lines(flying), g)
        assert found.sizes["alternation"] == pytest.approx(columns, rel=0.2)
        assert "a focal spot that flies" in found.findings[0]
        assert "period of 2" in found.findings[0]


def _at(body, center):
    return replace(body, center=center)


def _moving(g, shift):
    """The scan of bodies that stand elsewhere in every view: ``shift(view)`` is z, y, x in mm."""
    parts = []
    for k in range(g.views):
        z, y, x = shift(k)
        bodies = [_at(b, (b.center[0] + z, b.center[1] + y, b.center[2] + x)) for b in SOLID]
        parts.append(line_integrals(g.select(slice(k, k + 1)), bodies, sub=1))
    return np.concatenate(parts)


SOLID = [
    Ellipsoid((0.0, 0.0, 0.0), (400.0, 55.0, 80.0), value=0.02),
    Ellipsoid((2.0, 20.0, -30.0), (8.0, 14.0, 14.0), value=0.01),
    Ellipsoid((-3.0, -15.0, 25.0), (6.0, 9.0, 18.0), value=-0.01),
    Ellipsoid((0.0, -30.0, -20.0), 7.0, value=0.02),
]
THICK = ConeBeam(full_turn(90), 500.0, 900.0, 110, 12, (3.0, 3.6))


def test_a_table_that_travels_or_wobbles_is_named():
    turns = np.arange(THICK.views) / THICK.views
    at_rest = _moving(THICK, lambda k: (0.0, 0.0, 0.0))
    assert (
        neighbour_test(_lines(at_rest), THICK).findings
        == moment_test(_lines(at_rest), THICK).findings
        == ()
    )
    helix = _lines(_moving(THICK, lambda k: (15.0 * turns[k], 0.0, 0.0)))
    found = (*neighbour_test(helix, THICK).findings, *moment_test(helix, THICK).findings)
    assert any("helix" in text for text in found)
    wobble = moment_test(
        _lines(_moving(THICK, lambda k: (3.0 * math.sin(6 * math.pi * turns[k]), 0.0, 0.0))), THICK
    )
    assert wobble.sizes["axial"] == pytest.approx(3.0 / math.sqrt(2.0), rel=0.5)
    assert "higher or lower" in wobble.findings[0]


@pytest.mark.parametrize("cycles", [2.0, 3.0, 2.4])
def test_an_object_that_breathes_is_named(cycles):
    """Two cycles a turn bring the object back where the conjugate ray comes: nothing but the
    moments shows them."""
    g = FanBeam(full_turn(120), 500.0, 900.0, 150, 2.6)
    swing = 4.0 * np.sin(2 * math.pi * cycles * np.arange(g.views) / g.views)
    parts = []
    for k, d in enumerate(swing):
        bodies = [_at(b, (b.center[0] + d, b.center[1])) for b in BODIES]
        parts.append(line_integrals(g.select(slice(k, k + 1)), bodies, sub=1))
    found = moment_test(_lines(np.concatenate(parts)), g)
    assert "the object moved" in found.findings[0]
    assert 0.8 < found.sizes["centre"] < 4.0


def test_wrong_input_is_refused():
    g = GEOMETRIES["parallel"]
    refused(
        ("shape", lambda: neighbour_test(torch.zeros(3, 4), g)),
        ("NaN", lambda: neighbour_test(torch.full(g.shape, math.nan), g)),
    )
    assert neighbour_test(torch.zeros(g.shape), g).findings == ()
    few = g.select(slice(10))
    assert neighbour_test(torch.zeros(few.shape), few).sizes == {}


@pytest.mark.parametrize("closes", [True, False])
def test_what_lies_beside_is_the_median_of_the_places_there_are(closes):
    values = np.random.default_rng(0).normal(size=(31, 2))
    found = _beside(values, closes)
    for k in (0, 3, 15, 30):
        places = [p for p in range(k - 14, k + 15) if abs(p - k) > 5]
        inside = [p % 31 for p in places if closes or 0 <= p < 31]
        assert found[k] == pytest.approx(np.median(values[inside], axis=0), abs=0.0)
