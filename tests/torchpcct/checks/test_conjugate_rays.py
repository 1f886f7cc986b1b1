"""Conjugate rays: their test finds and measures a wrong centre, keeps its rate of false alarms,
and knows its limits."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic import Ellipsoid, line_integrals
from refusals import refused
from sound_scans import BOX, CYLINDER, Solid, draw, transmissions

from torchpcct import ConeBeam, FanBeam, ParallelBeam, full_turn
from torchpcct.checks.conjugate_rays import (
    CENTRE_TOLERANCE,
    FALSE_ALARMS,
    SCALE_TOLERANCE,
    STEP_TOLERANCE,
    centre_test,
    geometry_test,
)
from torchpcct.checks.moments import moment_test
from torchpcct.checks.ray_pairs import ConjugateRays, RayPairs
from torchpcct.detector_window import DetectorWindow

VIEWS = 180
RODS = ((12.0, -7.0, 6.0, 0.02), (12.0, -7.0, 3.0, 0.01), (-20.0, 15.0, 9.0, 0.015))
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
    """A rod that swings along y in quadrature with the views: no mean error of the centre, a
    wave of it."""
    g = GEOMETRIES[kind]
    x, y, radius, mu = RODS[0]
    swing = 0.8 * (g.pitch if kind == "parallel" else g.pitch / g.magnification)

    def scanned(shift):
        return torch.cat(
            [
                _lines(g.select(slice(k, k + 1)), [(x, y + d, radius, mu)])
                for k, d in enumerate(shift)
            ]
        )

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
    _, known = ConjugateRays(g, DetectorWindow.full(g), (0.0, 0.0)).conjugate(
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


def test_without_conjugate_rays_or_anything_to_see_nothing_is_found():
    g = GEOMETRIES["fan"]
    half = g.select(slice(60))
    above = replace(GEOMETRIES["cone"], offset=(40.0, 0.0))
    noise = torch.from_numpy(np.random.default_rng(0).standard_normal(g.shape).astype(np.float32))
    cases = (
        (half, _lines(half)),
        (g, torch.zeros(g.shape)),
        (above, _lines(above)),
        (g, 1e-3 * noise),
    )
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


@pytest.mark.parametrize("kind", ["parallel", "fan"])
@pytest.mark.parametrize("order", ["from a quarter on", "backwards", "from 0 to 2π"])
def test_steps_are_measured_wherever_the_turn_begins(kind, order):
    """The conjugate ray was read half a turn later or earlier, which the angle from 0 to 2π does
    not
    tell: sizes had the other sign."""
    g = GEOMETRIES[kind]
    begins = {
        "from a quarter on": 1.7 + g.angles,
        "backwards": 2.0 - g.angles,
        "from 0 to 2π": 4.0 + g.angles,
    }[order]
    g = replace(g, angles=begins)
    described = g.angles[0] + (g.angles - g.angles[0]) / 1.01
    wrong = replace(g, angles=described % (2 * math.pi) if order == "from 0 to 2π" else described)
    found = geometry_test(_lines(g, WIDE), wrong)
    assert found.sizes["step"] == pytest.approx(0.01, rel=0.02)
    assert "steps between the views are described about 1 ±" in found.findings[0]


@pytest.mark.parametrize("cause", ["centre", "scale", "step"])
def test_large_errors_are_measured_to_what_is_said(cause):
    """Of first order sizes were a third too small: they are measured again where nothing is left
    of them."""
    g = GEOMETRIES["flat"]
    size = {"centre": 2.5, "scale": -0.07, "step": 0.025}[cause]
    wrong = {
        "centre": lambda: _moved(g, size),
        "scale": lambda: replace(g, pitch=g.pitch / (1.0 + size)),
        "step": lambda: replace(g, angles=g.angles / (1.0 + size)),
    }[cause]()
    found = geometry_test(_lines(g, WIDE), wrong)
    assert found.sizes[cause] == pytest.approx(size, rel=0.04)
    assert abs(found.sizes[cause] - size) < 2.5 * found.errors[cause] < 0.1 * abs(size)


def _box(photons):
    """A box beside the axis: few views see its faces edge on, and nothing else has much to say."""
    g = FanBeam(full_turn(240), 300.0, 500.0, 120, 1.2, 0.3)
    rng = np.random.default_rng(0)
    shone = transmissions(g, [Solid(BOX, (8.0, -5.0, 0.0), (22.0, 9.0, 1e5), 0.03, 0.3)])
    return g, torch.from_numpy(-np.log(rng.poisson(photons * shone) / photons).astype(np.float32))


def test_what_few_views_see_is_found_and_measured():
    """The scatter of the blocks' scores, in which few views have most of what is seen, hid
    errors of 30 sigmas."""
    g, lines = _box(3e4)
    assert geometry_test(lines, g).findings == ()
    for cause, size, wrong in (
        ("scale", 0.03, replace(g, pitch=g.pitch / 1.03, offset=g.offset / 1.03)),
        ("step", 0.01, replace(g, angles=g.angles / 1.01)),
    ):
        found = geometry_test(lines, wrong)
        assert {"scale": "fan angles", "step": "steps between"}[cause] in found.findings[0]
        assert abs(found.sizes[cause] - size) < 2.0 * found.errors[cause] < 0.5 * size


def test_interpolation_is_no_error_of_the_description():
    """Round bodies about the axis in coarse cells: their edges stay at one place between two
    cells in all views."""
    for radius in (6.3, 7.7, 9.1):
        g = FanBeam(full_turn(60), 60.0, 100.0, 26, 1.6, 0.5)
        lines = torch.from_numpy(
            -np.log(
                transmissions(g, [Solid(CYLINDER, (0.0, 0.0, 0.0), (radius, radius, 1e5), 0.1)])
            )
        )
        pairs = RayPairs.of(lines, g, None, (0.0, 0.0))
        known = pairs.known & torch.roll(pairs.known, 1, -1)
        left, straight = (
            float(v[known].square().mean()) for v in (pairs.residue, pairs.difference)
        )
        assert left < 0.7 * straight
        assert geometry_test(lines, g).findings == ()


@pytest.mark.parametrize("up", [0.0, 0.5])
def test_two_rows_show_the_centre(up):
    """Nobody knows where the object ends along z, but a column aside is more than that can be."""
    g = ConeBeam(full_turn(VIEWS), 300.0, 500.0, 128, 2, 1.0, (up, -0.25))
    lines = _lines(g, WIDE)
    found = geometry_test(lines, _moved(g, 1.0))
    assert "rotation centre" in found.findings[0]
    assert abs(found.sizes["centre"] - 1.0) < 2.0 * found.errors["centre"] < 0.5
    assert geometry_test(lines, g).findings == ()


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
    """Columns or angles of the other sign, views out of order, a half turn given as a whole one:
    all were silent."""
    g = GEOMETRIES["fan"]
    lines = _lines(g, WIDE)
    half = g.select(slice(VIEWS // 2))
    wrong = (
        (lines.flip(-1), g),
        (lines, replace(g, angles=-g.angles)),
        (lines[np.random.default_rng(0).permutation(VIEWS)], g),
        (_lines(half, WIDE), replace(half, angles=full_turn(VIEWS // 2))),
    )
    texts = [geometry_test(*case).findings[0] for case in wrong]
    assert ["counted the other way" in text for text in texts] == [True, True, False, False]
    assert ["little in common" in text for text in texts] == [False, False, True, True]


def test_what_conjugate_rays_cannot_show_raises_no_alarm():
    """The angle of the first view; sod; parallel rays' pitch and direction: another object's
    scan, described right."""
    g, parallel = GEOMETRIES["flat"], GEOMETRIES["parallel"]
    mirrored = replace(parallel, offset=-parallel.offset)
    for lines, other in (
        (_lines(g, WIDE), replace(g, angles=g.angles + 0.3)),
        (_lines(g, WIDE), replace(g, sod=1.03 * g.sod)),
        (_lines(parallel, WIDE), replace(parallel, pitch=1.03, offset=0.2575)),
        (_lines(parallel, WIDE).flip(-1), mirrored),
    ):
        assert geometry_test(lines, other).findings == ()


@pytest.mark.parametrize("test", [centre_test, geometry_test, moment_test])
def test_bad_input_is_refused(test):
    g = GEOMETRIES["fan"]
    refused(
        ("must have the shape", lambda: test(torch.zeros(3, 4), g)),
        ("NaN or Inf", lambda: test(torch.full(g.shape, math.nan), g)),
    )


def test_a_round_wall_in_coarse_columns_is_no_disorder():
    """Its conjugate rays differed by 6.4 times what changes from view to view: other columns sample
    the wall otherwise, in all views alike."""
    drawn = draw(120243, readings=60_000)
    assert drawn.text.startswith("parallel body shell; 958 views")
    assert geometry_test(drawn.scan().line_integrals(), drawn.geometry).findings == ()


def test_what_all_views_share_is_no_wrong_centre():
    """Air of few photons: its noise is in every view alike, so that their scatter tells nothing of
    it, and of a body round about the axis the centre is known by nothing else."""
    g = FanBeam(full_turn(115), 120.0, 300.0, 68, 0.5, 0.0, "curved")
    shone = transmissions(g, [Solid(CYLINDER, (0.0, 0.0, 0.0), (5.5, 5.5, 1e5), 0.0055)])
    rng = np.random.default_rng(5)
    sigmas, findings = [], 0
    for _ in range(40):
        air = rng.poisson(870.0, (17, g.columns)).mean(0)
        lines = torch.from_numpy(-np.log(rng.poisson(870.0 * shone) / air))
        found = centre_test(lines, g)
        findings += len(found.findings)
        if "centre" in found.sizes:
            sigmas.append(found.sizes["centre"] / found.errors["centre"])
    assert findings == 0
    assert 0.5 < np.std(sigmas) < 1.3
    # A centre that is farther off than that is named.
    known = torch.from_numpy(-np.log(rng.poisson(1e5 * shone) / 1e5))
    assert "rotation centre" in centre_test(known, _moved(g, 1.0)).findings[0]
