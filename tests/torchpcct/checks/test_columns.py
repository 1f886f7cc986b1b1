"""Columns: gains and exchanged places are found and measured; what stands on the axis, and sound
scans, are not."""

import math

import numpy as np
import pytest
import torch
from analytic import Ellipsoid, line_integrals

from torchpcct import ConeBeam, FanBeam, ParallelBeam, full_turn
from torchpcct.checks.columns import GAIN_TOLERANCE, column_test

PHOTONS = 2e4
BODIES = [
    Ellipsoid((4.0, -6.0), (55.0, 80.0), value=0.02),
    Ellipsoid((20.0, -30.0), 14.0, value=0.004),
]
GEOMETRIES = {
    "parallel": ParallelBeam(full_turn(180), 150, 1.4, 0.2),
    "half": ParallelBeam(full_turn(180) / 2, 150, 1.4, 0.2),
    "fan": FanBeam(full_turn(180), 500.0, 900.0, 181, 2.2),
    "short": FanBeam(full_turn(180)[:120], 500.0, 900.0, 180, 2.2, 0.55),
    "cone": ConeBeam(full_turn(180), 500.0, 900.0, 150, 3, 2.6),
}


def _lines(g, bodies=BODIES, gains=1.0):
    n = np.random.default_rng(0).poisson(PHOTONS * np.exp(-line_integrals(g, bodies, sub=2)))
    return torch.from_numpy(-np.log(np.maximum(n * gains, 0.5) / PHOTONS))


@pytest.mark.parametrize("kind", GEOMETRIES)
def test_a_wrong_gain_is_found_and_measured(kind):
    g = GEOMETRIES[kind]
    assert column_test(_lines(g), g).findings == ()
    # The middle of 150 columns lies 0.64 columns beside the axis: the hardest place. Of part of a
    # turn the object's edges hide smaller errors.
    whole = [((75,), 0.95), ((40,), 1.06), ((100, 101), 0.94)]
    for columns, gain in whole if kind in ("parallel", "fan", "cone") else [((85,), 0.9)]:
        gains = np.ones(g.columns)
        gains[list(columns)] = gain
        found = column_test(_lines(g, gains=gains), g)
        assert found.sizes["gain"] == pytest.approx(gain - 1.0, abs=0.01)
        assert f"{columns[0]}" in found.findings[0]
        assert "a wrong gain" in found.findings[0]


def test_a_gain_below_the_tolerance_and_what_turns_about_the_axis_are_no_findings():
    g = GEOMETRIES["parallel"]
    gains = np.ones(g.columns)
    gains[75] = 1.0 - 0.6 * GAIN_TOLERANCE
    assert column_test(_lines(g, gains=gains), g).findings == ()
    wire = Ellipsoid((0.0, 0.0), 0.3, value=0.1)
    tube = [Ellipsoid((0.0, 0.0), 30.0, value=0.05), Ellipsoid((0.0, 0.0), 29.0, value=-0.05)]
    for kind in ("parallel", "half", "fan"):
        for bodies in ([*BODIES, wire], [*BODIES, *tube], tube):
            assert column_test(_lines(GEOMETRIES[kind], bodies), GEOMETRIES[kind]).findings == ()


@pytest.mark.parametrize("kind", ["parallel", "fan", "cone"])
def test_a_cell_of_one_row_is_named_with_its_row(kind):
    g = GEOMETRIES[kind]
    gains = np.ones(g.shape[1:])
    gains[(1, 60) if kind == "cone" else 60] = 0.93
    (text,) = column_test(_lines(g, gains=gains), g).findings
    assert ("of row 1" in text) == (kind == "cone")


def test_columns_whose_order_is_exchanged_are_named():
    g = GEOMETRIES["parallel"]
    lines = _lines(g)
    pairs = np.arange(g.columns).reshape(-1, 2)[:, ::-1].ravel().copy()
    found = column_test(lines[:, pairs], g)
    assert abs(found.sizes["place"]) == pytest.approx(1.0, rel=0.3)
    assert "neighbouring columns are exchanged" in found.findings[0]
    assert abs(column_test(lines, g).sizes["place"]) < 0.05


def test_wrong_input_is_refused():
    g = GEOMETRIES["parallel"]
    with pytest.raises(ValueError, match="shape"):
        column_test(torch.zeros(3, 4), g)
    with pytest.raises(ValueError, match="NaN"):
        column_test(torch.full(g.shape, math.nan), g)
    few = g.select(slice(10))
    assert column_test(torch.zeros(few.shape), few).sizes == {}


@pytest.mark.parametrize(
    ("offset", "radii", "mu"),
    [
        (-2.19, (3.91, 5.97), 0.06),
        (2.25, (2.26, 5.64, 6.66), 0.093),
        (3.85, (2.17, 2.41, 4.84), 0.09),
        (-1.14, (1.87, 5.11), 0.079),
        (-1.34, (2.25, 5.82), 0.095),
    ],
)
def test_a_turned_part_that_ends_in_steps_within_a_row_has_no_wrong_gain(offset, radii, mu):
    """The mirror image of a step that one column sees falls between others."""
    g = ParallelBeam(full_turn(64), 60, 1.0, offset)
    within = (np.arange(9) - 4.0) / 9.0
    t = np.asarray(g.column_positions)[:, None] + within
    chords = [2.0 * np.sqrt(np.clip(r * r - t * t, 0.0, None)) for r in radii]
    light = np.mean([np.exp(-mu * chord) for chord in chords], axis=0).mean(-1)
    n = np.random.default_rng(0).poisson(4e5 * light, (64, 60))
    assert column_test(torch.from_numpy(-np.log(n / 4e5)), g).findings == ()
