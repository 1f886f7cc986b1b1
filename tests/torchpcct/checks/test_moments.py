"""Moments of the views: constant weight, frequency of the centre of mass; found where conjugate
rays cannot tell."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic import Ellipsoid, line_integrals
from sound_scans import BOX, Solid, transmissions

from torchpcct import ConeBeam, FanBeam, ParallelBeam, full_turn
from torchpcct.checks.moments import STEP_TOLERANCE, WEIGHT_TOLERANCE, moment_test

ELLIPSE = Ellipsoid((-5.0, 8.0), (60.0, 90.0), value=0.02)
GEOMETRIES = {
    "parallel": ParallelBeam(full_turn(180), 200, 1.25),
    "half": ParallelBeam(full_turn(180) / 2, 200, 1.25, 0.8),
    "fan": FanBeam(full_turn(180), 500.0, 900.0, 256, 1.8, 0.45),
    "short": FanBeam(full_turn(180)[:125], 500.0, 900.0, 256, 1.8, 0.0, "curved"),
    "cone": ConeBeam(full_turn(180), 500.0, 900.0, 256, 3, 1.8),
}


def _lines(g, photons=1e5):
    p = line_integrals(g, [ELLIPSE], sub=1)
    p += np.random.default_rng(0).standard_normal(p.shape) * np.exp(p / 2) / math.sqrt(photons)
    return torch.from_numpy(p.astype(np.float32))


@pytest.mark.parametrize("kind", GEOMETRIES)
def test_a_sound_scan_has_the_same_weight_from_all_sides(kind):
    g = GEOMETRIES[kind]
    found = moment_test(_lines(g), g)
    assert found.findings == ()
    assert found.sizes["weight"] < WEIGHT_TOLERANCE / 4
    assert abs(found.sizes.get("step", 0.0)) < STEP_TOLERANCE / 2


@pytest.mark.parametrize("kind", GEOMETRIES)
def test_readings_that_are_no_line_integrals_are_found(kind):
    """Pile-up of 10 % was silent by every method: a counter of dead time reads n exp(-0.1 n / n
    in air)."""
    g = GEOMETRIES[kind]
    p = _lines(g)
    piled_up = p + 0.1 * (torch.exp(-p) - 1.0)
    scattered = -torch.log((torch.exp(-p) + 0.01) / 1.01)
    for wrong in (piled_up, scattered):
        found = moment_test(wrong, g)
        assert "the sum of a view's line integrals changes" in found.findings[0]
        assert found.sizes["weight"] > WEIGHT_TOLERANCE


@pytest.mark.parametrize("turn", [0.0, 0.3])
def test_cells_that_a_dense_edge_crosses_are_no_wrong_steps(turn):
    """Where a face lies along the rays the cells that it crosses read too little, all at once: the
    moments then do not turn with the views, of a half turn by 1 % of wrong steps."""
    g = ParallelBeam(np.linspace(0.0, math.pi, 360, endpoint=False), 64, 4.0, 1.0)
    box = [Solid(BOX, (-6.4, 46.0, 0.0), (47.0, 21.7, 31.4), 0.0216, turn)]
    lines = torch.from_numpy(-np.log(transmissions(g, box, subs=(9, 1, 1))))
    read = moment_test(lines, g)
    if turn == 0.0:
        assert abs(read.sizes["step"]) > STEP_TOLERANCE + 4.0 * read.errors["step"]
    assert read.findings == ()
    # Errors beyond what such edges leave in doubt are found in such a scan, too.
    wrong = moment_test(lines, replace(g, angles=0.95 * g.angles))
    assert "steps between the views" in wrong.findings[0]


def test_the_range_of_a_half_turn_is_measured():
    """No ray of a half turn of parallel rays is met again."""
    g = GEOMETRIES["half"]
    for factor in (0.98, 1.03):
        found = moment_test(_lines(g, 1e7), replace(g, angles=factor * g.angles))
        assert found.sizes["step"] == pytest.approx(1 / factor - 1, rel=0.15)
        assert f"too {'small' if factor < 1 else 'large'}" in found.findings[0]


def test_what_the_moments_cannot_show_raises_no_alarm():
    """A round body weighs the same from all sides whatever the readings are; air, a few views, a
    part of a turn."""
    g = GEOMETRIES["parallel"]
    t = g.column_positions / 80.0
    p = torch.from_numpy(3.0 * np.sqrt(np.maximum(1 - t**2, 0.0))).float().expand(g.shape)
    part = GEOMETRIES["half"].select(slice(60))
    few = g.select(slice(None, None, 20))
    cases = (
        (p + 0.1 * (torch.exp(-p) - 1), g),
        (torch.zeros(g.shape), g),
        (_lines(part), part),
        (_lines(few), few),
    )
    assert all(moment_test(*case).findings == () for case in cases)
