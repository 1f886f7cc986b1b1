"""Opposite rays: their test finds and measures a wrong centre, keeps its rate of false alarms, and knows its limits."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from torchpcct import ConeBeam, FanBeam, ParallelBeam, full_turn
from torchpcct.detector_window import DetectorWindow
from torchpcct.metrics.opposite_rays import CENTRE_TOLERANCE, FALSE_ALARMS, _Rays, centre_test

VIEWS, RODS = 180, ((12.0, -7.0, 6.0, 0.02), (12.0, -7.0, 3.0, 0.01), (-20.0, 15.0, 9.0, 0.015))
"""Rods along z: x, y, radius in mm, attenuation in mm⁻¹."""
GEOMETRIES = {
    "parallel": ParallelBeam(full_turn(VIEWS), 90, 1.0, 0.25),
    "fan": FanBeam(full_turn(VIEWS), 300.0, 500.0, 128, 1.0, 0.25, "curved"),
    "flat": FanBeam(full_turn(VIEWS), 300.0, 500.0, 128, 1.0),
    "cone": ConeBeam(full_turn(VIEWS), 300.0, 500.0, 128, 4, 1.0, (0.5, -0.25)),
}


def _lines(g, rods=RODS):
    """Line integrals of the rods, by the distance of each ray from their axes."""
    beta = g.angles[:, None]
    parallel = isinstance(g, ParallelBeam)
    gamma = 0.0 * g.column_positions if parallel else g.fan_angles
    direction = beta + math.pi - gamma
    total = np.zeros(direction.shape)
    for x, y, radius, mu in rods:
        if parallel:
            distance = -x * np.sin(beta) + y * np.cos(beta) - g.column_positions
        else:
            dx, dy = x - g.sod * np.cos(beta), y - g.sod * np.sin(beta)
            distance = np.cos(direction) * dy - np.sin(direction) * dx
        total += 2 * mu * np.sqrt(np.maximum(radius**2 - distance**2, 0.0))
    lines = torch.from_numpy(total.astype(np.float32))
    return lines[:, None].expand(g.shape).clone() if isinstance(g, ConeBeam) else lines


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
    assert found.columns == pytest.approx(columns, rel=0.2)
    assert found.p_value < FALSE_ALARMS
    assert f"too {'high' if columns > 0 else 'low'}" in found.findings[0]
    right = centre_test(lines, g)
    assert abs(right.columns) < CENTRE_TOLERANCE / 4
    assert right.findings == ()


def test_an_error_within_the_tolerance_is_measured_but_no_finding():
    g = GEOMETRIES["fan"]
    found = centre_test(_lines(g), _moved(g, 0.7 * CENTRE_TOLERANCE))
    assert found.columns == pytest.approx(0.7 * CENTRE_TOLERANCE, rel=0.3)
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
    assert abs(moving.columns) < CENTRE_TOLERANCE
    assert moving.swing == pytest.approx(0.4, rel=0.3)  # c(β) = a sin β cos β
    assert "the object moved" in moving.findings[0]
    elsewhere = centre_test(scanned(np.full(g.views, swing)), g)
    assert elsewhere.swing < CENTRE_TOLERANCE
    assert elsewhere.findings == ()


def test_the_order_of_the_views_does_not_matter():
    g = _moved(GEOMETRIES["fan"], 0.5)
    order = np.random.default_rng(0).permutation(VIEWS)
    expected, shuffled = centre_test(_lines(g), g), centre_test(_lines(g)[order], g.select(order))
    assert shuffled.columns == pytest.approx(expected.columns, abs=1e-6)


def test_each_pair_of_rays_counts_once():
    """Twice, the stated error would be too small by √2."""
    g = GEOMETRIES["flat"]  # no offset: the opposite of a column is its mirror image
    _, known = _Rays(g, DetectorWindow.full(g), (0.0, 0.0)).opposite(torch.zeros(VIEWS, 1, 128), np.arange(VIEWS))
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
        assert found.columns == pytest.approx(columns, abs=0.08)
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
        assert found.p_value > FALSE_ALARMS


def test_bad_input():
    g = GEOMETRIES["fan"]
    with pytest.raises(ValueError, match="must have the shape"):
        centre_test(torch.zeros(3, 4), g)
    with pytest.raises(ValueError, match="NaN or Inf"):
        centre_test(torch.full(g.shape, math.nan), g)
    with pytest.raises(ValueError, match="false_alarms"):
        centre_test(torch.zeros(g.shape), g, false_alarms=1.0)
