"""Opposite rays: their test finds and measures a wrong centre, keeps its rate of false alarms, and knows its limits."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic import Ellipsoid, line_integrals
from refusals import refused

from torchpcct import ConeBeam, FanBeam, ParallelBeam, full_turn
from torchpcct.checks.moments import moment_test
from torchpcct.checks.opposite_rays import (
    CENTRE_TOLERANCE,
    FALSE_ALARMS,
    SCALE_TOLERANCE,
    STEP_TOLERANCE,
    centre_test,
    geometry_test,
)
from torchpcct.checks.ray_pairs import OppositeRays
from torchpcct.detector_window import DetectorWindow

VIEWS, RODS = 180, ((12.0, -7.0, 6.0, 0.02), (12.0, -7.0, 3.0, 0.01), (-20.0, 15.0, 9.0, 0.015))
"""Rods along z: x, y, radius in mm, attenuation in mm⁻¹."""
WIDE = (*RODS, (25.0, -12.0, 6.0, 0.02), (-18.0, -20.0, 5.0, 0.02), (5.0, 28.0, 3.0, 0.03))
GEOMETRIES = {
    "parallel": ParallelBeam(full_turn(VIEWS), 90, 1.0, 0.25),
    "fan": FanBeam(full_turn(VIEWS), 300.0, 500.0, 128, 1.0, 0.25, "curved"),
    "flat": FanBeam(full_turn(VIEWS), 300.0, 500.0, 128, 1.0),
    "cone": ConeBeam(full_turn(VIEWS), 300.0, 500.0, 128, 4, 1.0, (0.5, -0.25)),
}


def _lines(g, rods=RODS):
    bodies = [Ellipsoid((y, x), radius, value=mu) for x, y, radius, mu in rods]
    return torch.from_numpy(line_integrals(g, bodies, sub=1).astype(np.float32))


def _moved(g, columns):
    if isinstance(g, ConeBeam):
        return replace(g, offset=(g.offset[0], g.offset[1] + columns * g.pitch[1]))
    return replace(g, offset=g.offset + columns * g.pitch)


@pytest.mark.parametrize("kind", GEOMETRIES)
@pytest.mark.parametrize("columns", [-0.5, 0.25, 1.0])
def test_a_wrong_centre_is_found_and_measured(kind, columns):
    g = GEOMETRIES[kind]
    lines = _lines(g)
    found = centre_test(lines, _moved(g, columns))
    assert found.sizes["centre"] == pytest.approx(columns, rel=0.2)
    assert f"too {'high' if columns > 0 else 'low'}" in found.findings[0]
    right = centre_test(lines, g)
    assert abs(right.sizes["centre"]) < CENTRE_TOLERANCE / 4
    assert right.findings == ()


def test_an_error_within_the_tolerance_is_measured_but_no_finding():
    g = GEOMETRIES["fan"]
    found = centre_test(_lines(g), _moved(g, 0.7 * CENTRE_TOLERANCE))
    assert found.sizes["centre"] == pytest.approx(0.7 * CENTRE_TOLERANCE, rel=0.3)
    assert found.findings == ()


@pytest.mark.parametrize("kind", ["parallel", "fan"])
def test_a_swing_is_found_and_a_displacement_is_not(kind):
    """A rod that swings along y in quadrature with the views: no mean error of the centre, a wave of it."""
    g = GEOMETRIES[kind]
    x, y, radius, mu = RODS[0]
    swing = 0.8 * (g.pitch if kind == "parallel" else g.pitch / g.magnification)

    def scanned(shift):
        return torch.cat([_lines(g.select(slice(k, k + 1)), [(x, y + d, radius, mu)]) for k, d in enumerate(shift)])

    moving = centre_test(scanned(swing * np.sin(g.angles)), g)
    assert abs(moving.sizes["centre"]) < CENTRE_TOLERANCE
    assert moving.sizes["swing"] == pytest.approx(0.4, rel=0.3)  # c(β) = a sin β cos β
    assert "the object moved" in moving.findings[0]
    elsewhere = centre_test(scanned(np.full(g.views, swing)), g)
    assert elsewhere.sizes["swing"] < CENTRE_TOLERANCE
    assert elsewhere.findings == ()


def test_the_order_of_the_views_does_not_matter():
    g = _moved(GEOMETRIES["fan"], 0.5)
    order = np.random.default_rng(0).permutation(VIEWS)
    expected, shuffled = centre_test(_lines(g), g), centre_test(_lines(g)[order], g.select(order))
    assert shuffled.sizes["centre"] == pytest.approx(expected.sizes["centre"], abs=1e-6)


def test_each_pair_of_rays_counts_once():
    """Twice, the stated error would be too small by √2."""
    g = GEOMETRIES["flat"]  # no offset: the opposite of a column is its mirror image
    _, known = OppositeRays(g, DetectorWindow.full(g), (0.0, 0.0)).opposite(
        torch.zeros(VIEWS, 1, 128), np.arange(VIEWS)
    )
    assert bool((known | known.flip(-1)).all())
    assert not bool((known & known.flip(-1)).any())


def test_a_window_that_follows_an_inset():
    g = GEOMETRIES["cone"]
    rod = RODS[0]
    middle = g.sdd * np.arctan2(
        -rod[0] * np.sin(g.angles) + rod[1] * np.cos(g.angles),
        g.sod - rod[0] * np.cos(g.angles) - rod[1] * np.sin(g.angles),
    )
    first = np.clip(np.round(middle / g.pitch[1] + 64 - 20).astype(int), 0, g.columns - 40)
    window = DetectorWindow(first, 40, 1, 3)
    lines = DetectorWindow.full(g).crop(_lines(g, [rod]), window)
    for columns in (0.0, 0.4):
        found = centre_test(lines, _moved(g, columns), window, (rod[1], rod[0]))
        assert found.sizes["centre"] == pytest.approx(columns, abs=0.08)
        assert bool(found.findings) == (columns > 0)


@pytest.mark.parametrize("draws", [12, pytest.param(400, marks=pytest.mark.slow)])
def test_false_alarms_keep_their_rate(draws):
    """At the largest tolerated error, where they are most; a faultless scan raises fewer."""
    g = GEOMETRIES["fan"].select(slice(None, None, 3))
    lines, rng = _lines(g), np.random.default_rng(1)
    alarms = {CENTRE_TOLERANCE: 0, 0.0: 0}
    for columns in alarms:
        moved = _moved(g, columns)
        for _ in range(draws):
            noise = torch.from_numpy(rng.standard_normal(lines.shape).astype(np.float32))
            alarms[columns] += bool(centre_test(lines + 0.05 * noise, moved).findings)
    # Four standard errors of a share of FALSE_ALARMS.
    most = draws * FALSE_ALARMS + 4 * math.sqrt(draws * FALSE_ALARMS)
    assert max(alarms.values()) <= most


def test_without_opposite_rays_or_anything_to_see_nothing_is_found():
    g = GEOMETRIES["fan"]
    half = g.select(slice(60))
    above = replace(GEOMETRIES["cone"], offset=(40.0, 0.0))
    noise = torch.from_numpy(np.random.default_rng(0).standard_normal(g.shape).astype(np.float32))
    cases = ((half, _lines(half)), (g, torch.zeros(g.shape)), (above, _lines(above)), (g, 1e-3 * noise))
    for geometry, lines in cases:
        found = centre_test(lines, geometry)
        assert found.findings == ()


@pytest.mark.parametrize("kind", ["fan", "flat", "cone"])
@pytest.mark.parametrize("kappa", [-0.03, 0.04])
def test_fan_angles_of_a_wrong_size_are_found_and_measured(kind, kappa):
    """Was silent: sdd 3 % wrong, a thorax 200 HU off."""
    g = GEOMETRIES[kind]
    found = geometry_test(_lines(g, WIDE), replace(g, sdd=g.sdd * (1 + kappa)))
    assert found.sizes["scale"] == pytest.approx(kappa, rel=0.35)
    assert "sdd" in found.findings[0]
    assert f"too {'small' if kappa > 0 else 'large'}" in found.findings[0]
    assert len(found.findings) == 1


@pytest.mark.parametrize("kind", ["parallel", "fan", "cone"])
@pytest.mark.parametrize("part", [1.0, 0.8])
def test_steps_between_views_of_a_wrong_size_are_found_and_measured(kind, part):
    """Was silent: angle step -2 %."""
    g = GEOMETRIES[kind].select(slice(round(part * VIEWS)))
    found = geometry_test(_lines(g, WIDE), replace(g, angles=0.98 * g.angles))
    assert found.sizes["step"] == pytest.approx(1 / 0.98 - 1, rel=0.35)
    assert "steps between the views" in found.findings[0]
    assert len(found.findings) == 1


@pytest.mark.extended
def test_a_rolled_detector_is_found_and_measured():
    """Was silent by every method: 2°, which is 0.3 columns of 1 mm at the outer of 17 rows."""
    g = replace(GEOMETRIES["cone"], rows=17, offset=(0.0, 0.0))
    lines = _lines(g, WIDE)
    for k, height in enumerate(g.row_positions):
        lines[:, k] = _lines(_moved(g, -math.radians(2.0) * height), WIDE)[:, k]
    found = geometry_test(lines, g)
    assert math.degrees(found.sizes["roll"]) == pytest.approx(2.0, rel=0.2)
    assert "rolled" in found.findings[0]
    assert abs(found.sizes["centre"]) < CENTRE_TOLERANCE


def test_a_sound_scan_has_no_finding_and_small_sizes():
    for kind in GEOMETRIES:
        g = GEOMETRIES[kind]
        found = geometry_test(_lines(g, WIDE), g)
        assert found.findings == ()
        assert found.sizes["mismatch"] < 0.01
        assert abs(found.sizes["step"]) < STEP_TOLERANCE / 4
        assert abs(found.sizes.get("scale", 0.0)) < SCALE_TOLERANCE


def test_rays_that_have_nothing_in_common_are_named():
    """Columns or angles of the other sign, views out of order, a half turn given as a whole one: all were silent."""
    g = GEOMETRIES["fan"]
    lines = _lines(g, WIDE)
    half = g.select(slice(VIEWS // 2))
    wrong = (
        (lines.flip(-1), g), (lines, replace(g, angles=-g.angles)),
        (lines[np.random.default_rng(0).permutation(VIEWS)], g),
        (_lines(half, WIDE), replace(half, angles=full_turn(VIEWS // 2))),
    )  # fmt: skip
    texts = [geometry_test(*case).findings[0] for case in wrong]
    assert ["counted the other way" in text for text in texts] == [True, True, False, False]
    assert ["little in common" in text for text in texts] == [False, False, True, True]


def test_what_opposite_rays_cannot_show_raises_no_alarm():
    """The angle of the first view; sod; parallel rays' pitch and direction: another object's scan, described right."""
    g, parallel = GEOMETRIES["flat"], GEOMETRIES["parallel"]
    mirrored = replace(parallel, offset=-parallel.offset)
    for lines, other in (
        (_lines(g, WIDE), replace(g, angles=g.angles + 0.3)), (_lines(g, WIDE), replace(g, sod=1.03 * g.sod)),
        (_lines(parallel, WIDE), replace(parallel, pitch=1.03, offset=0.2575)),
        (_lines(parallel, WIDE).flip(-1), mirrored),
    ):  # fmt: skip
        assert geometry_test(lines, other).findings == ()


@pytest.mark.parametrize("test", [centre_test, geometry_test, moment_test])
def test_bad_input_is_refused(test):
    g = GEOMETRIES["fan"]
    refused(
        ("must have the shape", lambda: test(torch.zeros(3, 4), g)),
        ("NaN or Inf", lambda: test(torch.full(g.shape, math.nan), g)),
    )
