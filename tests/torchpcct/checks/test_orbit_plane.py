"""The plane of the orbit: what conjugate rays part by along z is foretold, and rows that part are
not averaged."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic import Ellipsoid, line_integrals
from sound_scans import BALL, BOX, CYLINDER, Solid, transmissions

from torchpcct import ConeBeam, full_turn
from torchpcct.checks.conjugate_rays import geometry_test
from torchpcct.checks.moments import moment_test
from torchpcct.checks.orbit_plane import PARTED, orbit_plane
from torchpcct.checks.ray_pairs import ConjugateRays
from torchpcct.detector_window import DetectorWindow

SOD = 400.0


def _cone(rows, up=0.0):
    return ConeBeam(full_turn(80), SOD, 700.0, 90, rows, (3.0, 3.0), (up, 0.0))


def _scanned(g, bodies, photons=None):
    lines = line_integrals(g, bodies, sub=(6, 2))
    if photons:
        lines = lines + np.random.default_rng(0).standard_normal(lines.shape) * np.exp(
            lines / 2
        ) / math.sqrt(photons)
    return torch.from_numpy(lines.astype(np.float32))


def _difference(g, plane):
    """Mean square of what conjugate rays differ by."""
    fan = g.central_fan
    conjugate, known = ConjugateRays(fan, DetectorWindow.full(fan), (0.0, 0.0)).conjugate(
        plane.lines, np.arange(g.views)
    )
    return float((plane.lines - conjugate)[known].double().square().mean())


@pytest.mark.parametrize("up", [0.0, 1.5, 0.6])
@pytest.mark.parametrize("thick", [1.0, 2.2, 3.4])
def test_what_rays_part_by_is_foretold(up, thick):
    """Bodies beside the axis that end in the rows about the plane."""
    g = _cone(7, up)
    bodies = [Ellipsoid((0.6, 50.0, -40.0), (thick, 40.0, 25.0), value=0.02)]
    plane = orbit_plane(_scanned(g, bodies), g)
    assert _difference(g, plane) < plane.parted
    if thick < 2.0:  # within the rows: the estimate itself
        assert _difference(g, plane) > 0.3 * plane.parted / PARTED


def test_a_tall_object_uses_all_rows_that_hardly_part():
    g = _cone(9)
    plane = orbit_plane(
        _scanned(g, [Ellipsoid((30.0, -20.0), (40.0, 25.0), value=0.02)], photons=1e4), g
    )
    assert plane.rows >= 5  # the outermost ones are the borders
    assert plane.part < 0.05
    assert math.sqrt(plane.parted) < 0.002


def test_a_face_beside_the_plane_leaves_the_rows_within():
    g = _cone(15)
    discs = [Ellipsoid((0.0, 30.0, -20.0), (5.0, 40.0, 25.0), value=0.02)]
    assert orbit_plane(_scanned(g, discs, photons=1e5), g).rows < 5


def test_of_one_or_two_rows_nobody_knows_where_the_object_ends():
    for rows in (1, 2):
        g = _cone(rows)
        plane = orbit_plane(
            _scanned(g, [Ellipsoid((0.0, 30.0, -20.0), (0.8, 40.0, 25.0), value=0.02)]), g
        )
        assert plane.part > 0.99
        assert _difference(g, plane) < plane.parted


BETWEEN = {  # a pancake at the border of two rows, a plate that lies within them
    "pancake": (_cone(3), Solid(BALL, (0.0, 0.0, 0.86), (75.0, 45.0, 0.3), 0.02, 1.3)),
    "plate": (
        replace(_cone(2, 0.08), angles=full_turn(80)[:52]),
        Solid(BOX, (35.0, -20.0, -0.1), (30.0, 26.0, 1.4), 0.02),
    ),
}


@pytest.mark.parametrize("name", BETWEEN)
def test_a_body_at_the_border_of_two_rows_is_told_nothing(name):
    """It is in one of them from this side and in the other from that side: conjugate rays "disagree
    by 6 columns", and steps between views are "8.5 % too small"."""
    g, body = BETWEEN[name]
    n = np.random.default_rng(1).poisson(1e5 * transmissions(g, [body], subs=(3, 12, 1)))
    lines = torch.from_numpy(np.log(1e5 / (n + 0.5)).astype(np.float32))
    assert geometry_test(lines, g).findings == ()
    assert moment_test(lines, g).findings == ()
    plane = orbit_plane(lines, g)
    assert plane.part > 0.5
    assert _difference(g, plane) < plane.parted + 1e-4


def test_no_row_near_the_plane():
    g = _cone(4, up=40.0)
    assert orbit_plane(torch.zeros(g.shape), g) is None


THIN = {
    "disc": Solid(CYLINDER, (30.0, -25.0, 0.7), (45.0, 45.0, 2.5), 0.02),
    "plate": Solid(BOX, (-40.0, 10.0, -1.0), (40.0, 20.0, 1.2), 0.03, 0.4, 0.02),
    "opaque plate": Solid(BOX, (-10.0, 20.0, 1.0), (60.0, 20.0, 0.8), 0.08, 0.4),
}


@pytest.mark.parametrize("body", THIN)
@pytest.mark.parametrize("rows", [2, 7])
def test_thin_bodies_within_the_rows_are_told_nothing(body, rows):
    """Fan angles 12 … 22 % too small, a sum that changes with the direction: the face of a disc
    in the rows."""
    g = _cone(rows)
    n = np.random.default_rng(1).poisson(1e5 * transmissions(g, [THIN[body]], subs=(3, 12, 1)))
    lines = torch.from_numpy(np.log(1e5 / (n + 0.5)).astype(np.float32))
    assert geometry_test(lines, g).findings == ()
    assert moment_test(lines, g).findings == ()


@pytest.mark.parametrize("columns", [1, 2])
def test_a_detector_of_one_or_two_columns_has_a_plane(columns):
    """Rays through the axis part nowhere: the way that they part over was divided by."""
    g = ConeBeam(full_turn(60), SOD, 700.0, columns, 3, (3.0, 3.0))
    assert orbit_plane(torch.ones(g.shape), g) is not None
    assert geometry_test(torch.ones(g.shape), g).findings == ()
