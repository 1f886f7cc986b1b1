"""The rotation axis is found within its stated error, whatever the beam, the turn, the noise and
the cells' gains."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic import Ellipsoid, line_integrals

from torchpcct import ConeBeam, FanBeam, ParallelBeam, Scan, full_turn
from torchpcct.checks.rotation_axis import RotationAxis, at_axis, axis_column, rotation_axis
from torchpcct.formats.preprocess import centred, find_axis

COLUMNS = 120
TURNS = {
    "half": lambda views: np.arange(views) * math.pi / views,
    "half inclusive": lambda views: np.linspace(0, math.pi, views),
    "full": full_turn,
    "full inclusive": lambda views: np.linspace(0.3, 0.3 + 2 * math.pi, views),
    "short": lambda views: np.linspace(0, math.radians(225), views),
}


def beam(kind, angles):
    if kind == "parallel":
        return ParallelBeam(angles, COLUMNS, 1.0), 52.0
    if kind == "cone":
        return ConeBeam(angles, 400.0, 700.0, COLUMNS, 3, 1.0), 28.0
    return FanBeam(angles, 400.0, 700.0, COLUMNS, 1.0, detector=kind), 28.0


def scanned(g, radius, column, photons, cells, seed):
    """Line integrals of an ellipse with 20 others in it, noise, and gains of single cells that
    are off."""
    rng = np.random.default_rng(seed)
    bodies = [
        Ellipsoid((0.05 * radius, -0.03 * radius), (0.7 * radius, 0.85 * radius), value=1 / radius)
    ]
    for _ in range(20):
        r, t, s = (
            0.6 * math.sqrt(rng.uniform()),
            rng.uniform(0, 2 * math.pi),
            rng.uniform(0.01, 0.12),
        )
        place = (radius * r * math.sin(t), radius * r * math.cos(t))
        bodies.append(
            Ellipsoid(place, (radius * s, radius * s), value=rng.uniform(-0.6, 1.5) / radius)
        )
    p = line_integrals(at_axis(g, column), bodies, sub=3)
    p += rng.standard_normal(p.shape) * np.exp(p / 2) / math.sqrt(
        photons
    ) + cells * rng.standard_normal(p.shape[1:])
    return torch.from_numpy(p.astype(np.float32))


@pytest.mark.parametrize(
    ("kind", "turn"),
    [
        ("parallel", "half"),
        *(
            pytest.param("parallel", turn, marks=pytest.mark.extended)
            for turn in TURNS
            if turn != "half"
        ),
        ("flat", "full"),
        pytest.param("curved", "short", marks=pytest.mark.extended),
    ],
)
def test_the_axis_lies_within_its_error(kind, turn):
    cases = (
        (59.9, 1e5, 0.0, 1.0),
        (52.2, 1e4, 0.004, 1.0),
        (71.7, 1e3, 0.0, 0.8),
        (57.25, 1e4, 0.003, 1.3),
    )
    for seed, (column, photons, cells, size) in enumerate(cases):
        g, radius = beam(kind, TURNS[turn](60 if seed % 2 else 151))
        found = rotation_axis(scanned(g, size * radius, column, photons, cells, seed), g)
        assert abs(found.column - column) <= found.error, (column, photons, found)
        assert found.error < (0.1 if turn.startswith("full") else 0.4)


def test_the_axis_of_a_cone_beam_and_of_a_half_fan():
    g, radius = beam("cone", full_turn(60))
    found = rotation_axis(scanned(g, radius, 62.4, 1e4, 0.003, 0), g)
    assert abs(found.column - 62.4) <= found.error < 0.05
    g, radius = beam("flat", full_turn(120))
    found = rotation_axis(scanned(g, 1.5 * radius, 23.6, 1e4, 0.0, 1), g)
    assert abs(found.column - 23.6) <= found.error < 0.1


def test_what_cannot_tell_the_axis_is_refused():
    g, radius = beam("parallel", np.linspace(0, 2.0, 60))
    with pytest.raises(ValueError, match="the views cover 115° of the 180°"):
        rotation_axis(scanned(g, radius, 60.0, 1e4, 0.0, 0), g)
    g, radius = beam("flat", np.linspace(0, 3.0, 60))
    with pytest.raises(ValueError, match="hardly any line was measured twice"):
        rotation_axis(scanned(g, radius, 60.0, 1e4, 0.0, 0), g)


@pytest.mark.parametrize(
    ("kind", "turn"),
    [("parallel", "full"), ("parallel", "half"), ("flat", "full"), ("cone", "full")],
)
def test_noise_tells_no_axis(kind, turn):
    """Air alone: an axis was stated, of another column in every draw."""
    g, _ = beam(kind, TURNS[turn](60))
    for seed in range(3):
        noise = np.random.default_rng(seed).standard_normal(g.shape)
        with pytest.raises(ValueError, match="do not tell the axis"):
            rotation_axis(torch.from_numpy(0.01 * noise.astype(np.float32)), g)


@pytest.mark.parametrize("kind", ["parallel", "flat"])
def test_an_object_that_is_round_about_the_axis(kind):
    """Taking off what all views share leaves noise: 66 ± 4 for 75.3. Parallel rays' half turn tells
    the axis all the same, other rays nothing."""
    g, radius = beam(kind, full_turn(90))
    lines = line_integrals(
        at_axis(g, 63.2), [Ellipsoid((0.0, 0.0), radius, value=1 / radius)], sub=3
    )
    for seed in range(4):
        noise = np.random.default_rng(seed).standard_normal(lines.shape) * np.exp(lines / 2) / 1e3
        noisy = torch.from_numpy((lines + noise).astype(np.float32))
        if kind == "parallel":
            found = rotation_axis(noisy, g)
            assert abs(found.column - 63.2) <= found.error < 0.2
        else:
            with pytest.raises(ValueError, match="round about the axis"):
                rotation_axis(noisy, g)


@pytest.mark.parametrize("turn", ["half", "full"])
def test_an_object_beyond_the_detector_whose_ends_are_alike_everywhere(turn):
    """Of a wide round object and few photons the narrowest overlap won: 4 ± 0.3 for 44."""
    g, _ = beam("parallel", TURNS[turn](60))
    lines = line_integrals(at_axis(g, 55.3), [Ellipsoid((0.0, 0.0), (100.0, 100.0), value=4e-3)])
    for seed in range(6):
        noise = np.random.default_rng(seed).standard_normal(lines.shape) * np.exp(lines / 2)
        noisy = torch.from_numpy((lines + noise / math.sqrt(1e3)).astype(np.float32))
        with pytest.raises(ValueError, match="the readings do not tell the axis"):
            rotation_axis(noisy, g)


def test_a_half_turn_of_three_views_is_too_few():
    """The first two were continued over 60°: 46.7 ± 0.6 for 44.2."""
    g, radius = beam("parallel", TURNS["half"](3))
    with pytest.raises(ValueError, match="3 views in half a turn are too few, 4 are needed"):
        rotation_axis(scanned(g, radius, 57.3, 1e5, 0.0, 4), g)


@pytest.mark.parametrize(
    "order", ["clockwise", "clockwise inclusive", "shuffled", "from the middle"]
)
def test_half_turns_in_any_order(order):
    """They were refused: the angles were counted from that of the first view."""
    angles = {
        "clockwise": math.pi - np.arange(90) * math.pi / 90,
        "clockwise inclusive": np.linspace(math.pi, 0.0, 91),
        "shuffled": np.random.default_rng(0).permutation(np.linspace(-1.0, math.pi - 1.0, 91)),
        "from the middle": np.roll(np.arange(90) * math.pi / 90, 40),
    }[order]
    g, radius = beam("parallel", angles)
    found = rotation_axis(scanned(g, radius, 57.3, 1e5, 0.0, 4), g)
    assert abs(found.column - 57.3) <= found.error < 0.2


def test_the_error_covers_what_rays_part_by_along_z():
    """A plate whose face lies in the rows about the plane: conjugate rays of a cone differ there,
    and pull the axis."""
    rng = np.random.default_rng(0)
    for seed in range(6):
        g, radius = beam("cone", full_turn(60))
        g = replace(g, rows=5, pitch=(2.0, 1.0))
        place = (rng.uniform(-1, 1), *rng.uniform(-0.4, 0.4, 2) * radius)
        body = [
            Ellipsoid(place, (rng.uniform(0.5, 3.0), 0.4 * radius, 0.55 * radius), value=1 / radius)
        ]
        lines = line_integrals(at_axis(g, 60.2), body, sub=(6, 2))
        noise = 0.003 * np.random.default_rng(seed).standard_normal(lines.shape)
        found = rotation_axis(torch.from_numpy((lines + noise).astype(np.float32)), g)
        assert abs(found.column - 60.2) <= found.error


def test_the_axis_as_text():
    assert str(RotationAxis(244.93, 0.1, "")) == "axis at column 244.9 ± 0.1"
    assert str(RotationAxis(244.93, 0.032, "")) == "axis at column 244.93 ± 0.04"
    assert str(RotationAxis(244.93, 2.1, "")) == "axis at column 245 ± 3"


def test_of_several_slices_the_richest_is_looked_at_and_a_scan_is_centred():
    g, radius = beam("parallel", full_turn(90))
    lines = scanned(g, radius, 61.3, 1e4, 0.0, 3)
    empty = 0.01 * torch.from_numpy(
        np.random.default_rng(1).standard_normal(lines.shape).astype(np.float32)
    )
    scan = Scan.from_line_integrals(
        torch.stack([empty, lines, empty]), replace(g, offset=5.0), photons=1e4
    )
    found = find_axis(scan)
    assert found.column == pytest.approx(61.3, abs=found.error)
    made = centred(scan)
    assert axis_column(made.geometry) == pytest.approx(found.column)
    assert made.info["axis"] == {
        "column": found.column,
        "error": found.error,
        "found_from": "conjugate rays",
    }
