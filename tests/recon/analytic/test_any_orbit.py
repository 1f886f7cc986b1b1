"""FBP of detectors that tilt, roll, jitter and mirror: exact lines along the vectors, compared
with exact bodies."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic import Ellipsoid, Gaussian, vector_lines

from recon.analytic.any_orbit import rebin_to_circle
from recon.analytic.fbp import fbp
from torchpcct.geometry import ConeBeam, FanBeam, ParallelBeam, VolumeGrid, full_turn
from torchpcct.vector_geometry import VectorGeometry, helical_motion

MU = 0.02
BODY = (Ellipsoid((4.0, -6.0), (30.0, 36.0), value=MU), Gaussian((10.0, 12.0), 5.0, value=0.3 * MU))
GRID = VolumeGrid((48, 48), 2.0)
CONE = ConeBeam(full_turn(180), 400.0, 650.0, 110, 16, (1.6, 1.5))
FAN = FanBeam(full_turn(180), 400.0, 650.0, 110, 1.5)


def lines(vectors, columns, rows=None, parallel=False):
    """Exact line integrals along the rays that the vectors themselves describe."""
    return torch.from_numpy(vector_lines(VectorGeometry(vectors, columns, rows, parallel), BODY, 1))


def worst(image, grid):
    y, x = grid.axes[-2][:, None], grid.axes[-1]
    value = sum(b.at(np.zeros(1), y, x) for b in BODY)
    inside = Ellipsoid((4.0, -6.0), (25.0, 31.0), value=1.0).at(np.zeros(1), y, x) > 0
    return float(np.abs(image.numpy() - value)[..., inside].max() / MU)


def rotated(x, axis, angle):
    """Rodrigues' rotation of vectors about unit axes."""
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    return x * c + np.cross(axis, x) * s + axis * (axis * x).sum(-1, keepdims=True) * (1 - c)


def wobbling(seed=0):
    """A cone beam whose detector jitters by cells, rolls and tilts by degrees, and whose source
    leaves the circle."""
    rng, v = np.random.default_rng(seed), VectorGeometry.of(CONE).vectors.reshape(-1, 4, 3).copy()
    n = len(v)
    normal = v[:, 0] / np.linalg.norm(v[:, 0], axis=1, keepdims=True)
    for axis, size in ((normal, 3.0), (np.tile([0.0, 0, 1.0], (n, 1)), 4.0)):
        angle = np.radians(rng.uniform(-size, size, n))
        v[:, 2], v[:, 3] = rotated(v[:, 2], axis, angle), rotated(v[:, 3], axis, angle)
    v[:, 1] += rng.uniform(-2, 2, (n, 3)) + 4.0 * v[:, 2]
    v[:, 0] += rng.uniform(-0.15, 0.15, (n, 3))
    return v.reshape(n, 12)


@pytest.mark.extended
def test_wobbling_cone_beam():
    """3° of roll, 4° of tilt, four columns aside, a cell of jitter: 2 % of the truth; ignored,
    more than 10 %."""
    v, grid = wobbling(), VolumeGrid((2, 48, 48), (1.0, 2.0, 2.0))
    data = lines(v, CONE.columns, CONE.rows)
    geometry = VectorGeometry(v, CONE.columns, CONE.rows)
    assert worst(fbp(data, geometry, grid, outside=0.0), grid) < 0.02
    with pytest.raises(ValueError, match="sinogram must have the shape"):
        fbp(data[:, :-1], geometry, grid)
    assert worst(fbp(data, CONE, grid, outside=0.0), grid) > 0.1


def test_an_ideal_circle_stays_itself():
    for geometry, rows in ((CONE, CONE.rows), (FAN, None)):
        data = lines(VectorGeometry.of(geometry).vectors, geometry.columns, rows)
        rebinned, circle = rebin_to_circle(data, VectorGeometry.of(geometry))
        assert circle.motion is None
        assert circle.geometry.shape == geometry.shape
        torch.testing.assert_close(rebinned, data, atol=1e-9, rtol=0)


@pytest.mark.parametrize("aside", [0.25, 0.4, 0.7])
def test_slopes_stay_in_their_place_between_cells(aside):
    """A parabola along the columns, a slope along the rows, and detectors that stand aside by
    turns. Torch's cubic interpolation moved slopes there and back by a twentieth of a cell: sound
    scans had steps of 1 % too few."""
    moved = VectorGeometry.of(CONE).shifted(
        columns=np.resize([aside, -aside], CONE.views), rows=0.3
    )
    u, v = np.arange(CONE.columns), np.arange(CONE.rows)[:, None]
    data = torch.from_numpy(np.broadcast_to(0.01 * (u - 20.0) ** 2 + 0.3 * v, moved.shape).copy())
    rebinned, circle = rebin_to_circle(data, moved)
    h, w = circle.rows.size, circle.geometry.columns
    place = np.stack(
        [np.tile(circle.geometry.column_positions, h), np.repeat(circle.rows, w), np.ones(h * w)]
    )
    at = circle.maps @ place
    at = at[:, :2] / at[:, 2:] + np.array([[(CONE.columns - 1) / 2], [(CONE.rows - 1) / 2]])
    inside = ((at >= 1.0) & (at <= np.array([[CONE.columns], [CONE.rows]]) - 2.0)).all(1)
    expected = 0.01 * (at[:, 0] - 20.0) ** 2 + 0.3 * at[:, 1]
    assert inside.mean() > 0.5
    np.testing.assert_allclose(
        rebinned.numpy().reshape(len(at), -1)[inside], expected[inside], atol=1e-9
    )


def test_mirrored_axes_and_other_pitches_of_a_fan():
    v = VectorGeometry.of(FAN).vectors.copy()
    v[:, 4:] *= -1.0  # columns counted the other way
    v[::2, 4:] *= 0.98  # two detectors
    v[:, 2:4] += np.random.default_rng(1).uniform(-1, 1, (len(v), 2))
    assert (
        worst(fbp(lines(v, FAN.columns), VectorGeometry(v, FAN.columns), GRID, outside=0.0), GRID)
        < 0.015
    )


def test_parallel_vectors_with_roll_and_jitter():
    geometry = ParallelBeam(np.arange(120) * math.pi / 120, 100, 1.0)
    flat, rng = VectorGeometry.of(geometry).vectors, np.random.default_rng(2)
    n, roll = len(flat), math.radians(1.5)
    zero = np.zeros((n, 1))
    u = np.concatenate([flat[:, 4:] * math.cos(roll), zero + math.sin(roll)], 1)
    up = np.concatenate([-flat[:, 4:] * math.sin(roll), zero + math.cos(roll)], 1)
    centre = np.concatenate(
        [flat[:, 2:4] + rng.uniform(-2, 2, (n, 1)) * flat[:, 4:], rng.uniform(-1, 1, (n, 1))], 1
    )
    v = np.concatenate([flat[:, :2], zero, centre, u, up], 1)
    grid = VolumeGrid((3, 48, 48), (1.0, 2.0, 2.0))
    image = fbp(lines(v, 100, 9, parallel=True), VectorGeometry(v, 100, 9, True), grid, outside=0.0)
    assert image.shape == grid.shape
    assert worst(image, grid) < 0.015
    thick = VolumeGrid((3, 48, 48), (9.0, 2.0, 2.0))
    with pytest.raises(ValueError, match="slices must lie in the rows'"):
        fbp(lines(v, 100, 9, parallel=True), VectorGeometry(v, 100, 9, True), thick, outside=0.0)


def test_what_fbp_cannot_do_is_refused():
    v = VectorGeometry.of(CONE).vectors
    data = torch.zeros(CONE.shape)
    helix = v.copy()
    helix[:, [2, 5]] += np.linspace(-10, 10, len(v))[:, None]
    with pytest.raises(
        ValueError, match=r"climbs by 20\.00 mm.*of a helix is not provided.*recon\.pwls"
    ):
        rebin_to_circle(data, VectorGeometry(helix, CONE.columns, CONE.rows))
    with pytest.raises(ValueError, match=r"table travels by 20\.00 mm.*recon\.pwls"):
        fbp(data, CONE, VolumeGrid((2, 8, 8), 2.0), motion=helical_motion(CONE, 20.0 * 180 / 179))
    before = np.concatenate([v[:, :3], 1.5 * v[:, :3], v[:, 6:]], 1)
    with pytest.raises(ValueError, match="does not lie behind its source"):
        rebin_to_circle(data, VectorGeometry(before, CONE.columns, CONE.rows))
    tilted = np.concatenate([-v[:, :3], v[:, 3:]], 1)
    tilted[:, 2] = 20.0
    with pytest.raises(ValueError, match=r"leave the plane of rotation by up to 2\.86°"):
        rebin_to_circle(data, VectorGeometry(tilted, CONE.columns, CONE.rows, parallel=True))
    # 0.8 m to either side
    edge_on = VectorGeometry.of(replace(CONE, pitch=(1.6, 15.0))).turned(slant=1.45)
    with pytest.raises(ValueError, match="part of a detector lies behind its source"):
        rebin_to_circle(data, edge_on)
