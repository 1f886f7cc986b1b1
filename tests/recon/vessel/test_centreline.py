"""Lines through vessels: coordinates about an arc, and the walk along tubes of any direction."""

import drawn_vessel
import numpy as np
import pytest

from recon.vessel.centreline import Centreline, follow
from recon.vessel.data import pilot
from recon.vessel.start import find_vessel
from torchpcct import VolumeGrid


def arc(radius=6.0, count=60):
    a = np.linspace(0, 1.4, count)
    return np.stack([radius * np.sin(a), radius * (1 - np.cos(a)), np.zeros(count)], 1)


def test_coordinates_about_an_arc():
    line = Centreline(arc())
    rng = np.random.default_rng(0)
    angle, off, side = rng.uniform(0.2, 1.2, 50), rng.uniform(-1, 1, 50), rng.uniform(-1, 1, 50)
    r = 6.0 - off
    points = np.stack([r * np.sin(angle), 6.0 - r * np.cos(angle), side], 1)
    c = line.coordinates(points)
    assert np.allclose(c.s, 6.0 * angle, atol=2e-3)
    assert np.allclose(c.rho, np.hypot(off, side), atol=2e-3)
    assert np.allclose(np.einsum("nij,nkj->nik", c.frame, c.frame), np.eye(3), atol=1e-6)
    # The frame does not turn: along a plane arc the angle about the line is the one in the section.
    sense = np.sign(
        np.sin(c.theta[1] - c.theta[0])
        * np.sin((expected := np.arctan2(side, off))[1] - expected[0])
    )
    turned = c.theta - sense * expected
    assert np.allclose(np.exp(1j * (turned - turned[0])), 1, atol=0.02)


def test_straight_beyond_its_ends():
    line = Centreline(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]]))
    c = line.coordinates(np.array([[-2.0, 0.3, 0.4], [5.0, 0, 0.5]]))
    assert np.allclose(c.s, [-2, 5], atol=1e-6)
    assert np.allclose(c.rho, [0.5, 0.5], atol=1e-6)


GRID = VolumeGrid((41, 41, 41), 0.25, (1.0, -30.0, 20.0))


@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.5, 0.6, -0.6)])
def test_follows_a_tube_in_any_direction(direction):
    d = np.array(direction) / np.linalg.norm(direction)
    points = np.stack(np.meshgrid(*GRID.axes, indexing="ij"), -1) - np.array(GRID.center)
    along = points @ d
    distance = np.linalg.norm(points - along[..., None] * d, axis=-1)
    volume = 400 / (1 + np.exp((distance - 1.2) / 0.1)) + 20 * np.random.default_rng(
        0
    ).standard_normal(GRID.shape)
    line, ends = follow(volume, GRID, 200.0, np.array(GRID.center) + 0.3, 1.8)
    middle = line.point(np.linspace(0, line.length, 20)) - np.array(GRID.center)
    assert np.linalg.norm(middle - (middle @ d)[:, None] * d, axis=1).max() < 0.1
    assert line.length > 6.0
    assert not np.isfinite(ends).any()  # it leaves the volume
    cut = np.where(np.abs(along) < 3.0, volume, 0.0)
    line, ends = follow(cut, GRID, 200.0, np.array(GRID.center), 1.8)
    assert ends[1] - ends[0] == pytest.approx(6.0, abs=0.4)


def test_nothing_to_follow():
    with pytest.raises(ValueError, match="no vessel brighter than 200 HU"):
        follow(np.zeros(GRID.shape), GRID, 200.0, np.array(GRID.center), 1.8)


def test_a_narrow_lumen_is_followed_though_it_is_brighter_in_its_middle():
    """A ball much wider than the lumen stayed at its brightest part: "no direction, or shorter
    than 5 mm"."""
    z, y, x = np.meshgrid(
        *(a - c for a, c in zip(GRID.axes, GRID.center, strict=True)), indexing="ij", sparse=True
    )
    rho = np.hypot(y, x)
    lumen = np.exp(-((rho / 0.6) ** 2)) * (200.0 + 100.0 * np.exp(-((z / 1.2) ** 2)))
    pilot = -90.0 + 150.0 / (1.0 + np.exp((rho - 1.3) / 0.15)) + lumen
    start = find_vessel(pilot, GRID, None)
    assert start.lumen.length > 6.0
    assert not np.isfinite(start.ends).any()
    assert np.abs(start.lumen.points[:, 1:] - np.array(GRID.center)[1:]).max() < 0.1


def test_what_holds_a_walk_back_is_no_end():
    """A bright place held the walk back 1 mm beside it: the vessel was taken to leave the volume
    there, and narrowed to nothing where it did not."""
    z, y, x = np.meshgrid(
        *(a - c for a, c in zip(GRID.axes, GRID.center, strict=True)), indexing="ij", sparse=True
    )
    rho = np.hypot(y, x)
    lumen = (
        300.0 / (1.0 + np.exp((rho - 0.7) / 0.1)) * (1.0 + 8.0 * np.exp(-(((z + 1.5) / 0.4) ** 2)))
    )
    pilot = np.where(
        np.abs(z) < 4.0, -90.0 + 150.0 / (1.0 + np.exp((rho - 1.2) / 0.1)) + lumen, -90.0
    )
    line, ends = follow(pilot, GRID, 230.0, np.array(GRID.center) - (1.5, 0.0, 0.0), 1.8)
    reached = np.sort(line.point(ends)[:, 0]) - GRID.center[0]
    assert np.allclose(reached, (-4.0, 4.0), atol=0.3)


def test_a_vessel_is_found_wherever_the_zero_lies(gram):
    seen = pilot(drawn_vessel.data(gram, drawn_vessel.image(gram.finer, 0.0, samples=2)))
    still, moved = (find_vessel(seen + zero, gram.grid, None) for zero in (0.0, -150.0))
    assert np.allclose(moved.lumen.points, still.lumen.points, atol=1e-6)
    assert np.allclose(moved.outer.points, still.outer.points, atol=1e-6)
    assert np.allclose(moved.radii, still.radii, atol=1e-6)
    assert np.allclose(moved.values, np.array(still.values) - 150.0)
