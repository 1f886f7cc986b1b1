"""Scans given view by view: exact chords, the native geometries, the adjoint, and what is
refused."""

import math

import numpy as np
import pytest
import torch
from analytic import Gaussian, line_integrals, rasterize, vector_lines
from linear_maps import mismatch
from refusals import refused

from torchpcct import (
    ConeBeam,
    FanBeam,
    ParallelBeam,
    Projector,
    VectorGeometry,
    VolumeGrid,
    full_turn,
)
from torchpcct.detector_window import DetectorWindow
from torchpcct.formats.geometry_yaml import geometry_of
from torchpcct.projector.tables import Tables, VectorTables
from torchpcct.vector_geometry import helical_motion

CONE = ConeBeam(full_turn(7, 0.2), 60.0, 110.0, 18, 11, (1.8, 2.1), (0.3, 0.5))
FAN = FanBeam(full_turn(7, 0.2), 60.0, 110.0, 21, 2.1, 0.5)
PARALLEL = ParallelBeam(np.arange(7) * math.pi / 7 + 0.1, 19, 1.3, 0.4)
GRID = VolumeGrid((8, 11, 12), (1.2, 1.1, 1.0), (0.4, 1.0, -2.0))
BODY = Gaussian((0.6, 1.2, -2.2), (1.4, 1.8, 1.8), value=0.4)


def wobbling(geometry, seed=0, size=1.0):
    """Jitter of cells, several degrees of tilt, roll and slant, sources off the circle, other
    pitches."""
    rng = np.random.default_rng(seed)
    g = VectorGeometry.of(geometry).shifted(
        rng.uniform(-1, 1, geometry.views), rng.uniform(-1, 1, geometry.views)
    )
    angles = size * np.radians(rng.uniform(-8, 8, (3, geometry.views)))
    g = g.turned(angles[0], angles[1], angles[2]) if g.rows else g.turned(slant=angles[2])
    v = np.array(g.vectors)
    v[:, : 3 if g.rows else 2] += rng.uniform(-2, 2, (g.views, 3 if g.rows else 2))
    v[:, 6 if g.rows else 4 :] *= rng.uniform(0.9, 1.1, (g.views, 1))
    return VectorGeometry(v, g.columns, g.rows, g.parallel)


def laminography(tilt=0.5):
    """Parallel rays that leave the plane of rotation (ASTRA's parallel3d_vec), detector upright
    to them."""
    beta = full_turn(9, 0.3)
    radial = np.stack([np.cos(beta), np.sin(beta), 0 * beta], 1)
    tangent = np.stack([-np.sin(beta), np.cos(beta), 0 * beta], 1)
    ray = -radial * math.cos(tilt) + np.array([0, 0, math.sin(tilt)])
    v = np.cross(ray, tangent)
    return VectorGeometry(
        np.concatenate([ray, 0 * ray, 1.1 * tangent, -1.2 * v], 1), 20, 16, parallel=True
    )


SCANS = {
    "cone": lambda: (wobbling(CONE), GRID),
    "fan": lambda: (wobbling(FAN), GRID.slice),
    "parallel": lambda: (VectorGeometry.of(PARALLEL).turned(slant=0.2), GRID.slice),
    "laminography": lambda: (laminography(), GRID),
    "rolled by 40°": lambda: (VectorGeometry.of(CONE).turned(roll=0.7), GRID),
    "steep": lambda: (laminography(1.2), GRID),  # rays that cross more slices than rows
}


def general(geometry, grid):
    """The general passes, whatever the geometry."""
    A = Projector(geometry, grid)
    A._engine.tables = VectorTables(geometry, grid)
    return A


@pytest.mark.parametrize("name", SCANS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_adjoint_is_the_transpose(name, dtype):
    A = Projector(*SCANS[name]())
    assert isinstance(A._engine.tables, VectorTables)
    bound = {torch.float32: 1e-6, torch.float64: 1e-13}[dtype]
    assert mismatch(A, A.T, A.domain_shape, A.range_shape, dtype) <= bound


@pytest.mark.parametrize("name", SCANS)
def test_batches_and_gradients(name):
    A = Projector(*SCANS[name]())
    x = torch.rand(2, *A.domain_shape, dtype=torch.float64).requires_grad_()
    y = A(x)
    torch.testing.assert_close(y[1], A(x[1]))
    y.square().sum().backward()
    torch.testing.assert_close(x.grad, 2 * A.T(A(x.detach())))


@pytest.mark.parametrize("name", SCANS)
def test_exact_chords(name):
    """What is wrong is the voxels, of second order: a quarter of the error at half their size."""
    geometry, grid = SCANS[name]()
    bodies = [BODY] if grid.ndim == 3 else [Gaussian(BODY.center[1:], 1.8)]
    exact = vector_lines(geometry, bodies, 4)
    errors = []
    for fine in (1, 2):
        g = VolumeGrid(
            tuple(n * fine for n in grid.shape), tuple(s / fine for s in grid.spacing), grid.center
        )
        image = torch.from_numpy(rasterize(g, bodies, 3))
        errors.append(
            float(
                np.linalg.norm(Projector(geometry, g)(image).numpy() - exact)
                / np.linalg.norm(exact)
            )
        )
    assert errors[0] < 0.09
    assert errors[1] < 0.4 * errors[0]


@pytest.mark.parametrize("roll", [0.1, 0.785])
def test_long_cells_that_are_rolled(roll):
    """Aspect 10 and 20: no further from the exact integrals than what voxels do to upright
    cells, 5 % of the peak."""
    grid, body = (
        VolumeGrid((24, 24, 24), 1.0, (0.4, 1.0, -2.0)),
        Gaussian((0.6, 1.2, -2.2), (2.0, 2.5, 2.5)),
    )
    image = torch.from_numpy(rasterize(grid, [body], 3))
    for aspect in (10, 20):
        cone = ConeBeam(full_turn(3, 0.2), 60.0, 110.0, 3, 24, (1.2, 1.2 * aspect), (0.3, 0.5))
        upright, g = VectorGeometry.of(cone), VectorGeometry.of(cone).turned(roll=roll)
        exact, plain = (vector_lines(x, [body], 2 * aspect) for x in (g, upright))
        A, error = Projector(g, grid), general(upright, grid)(image).numpy() - plain
        assert (
            np.abs(A(image).numpy() - exact).max()
            < 1.05 * np.abs(error).max() * exact.max() / plain.max()
        )
        x, y = (
            torch.rand(grid.shape, dtype=torch.float64),
            torch.rand(A.range_shape, dtype=torch.float64),
        )
        torch.testing.assert_close((A(x) * y).sum(), (x * A.T(y)).sum())


@pytest.mark.parametrize("geometry", [CONE, FAN, PARALLEL])
def test_the_general_passes_agree_with_the_native_ones(geometry):
    """Both are distance-driven: of an upright detector their weights are the same but for the
    cells' edges."""
    grid = GRID if isinstance(geometry, ConeBeam) else GRID.slice
    vectors = VectorGeometry.of(geometry)
    A = Projector(geometry, grid)
    assert isinstance(Projector(vectors, grid)._engine.tables, Tables)
    x = torch.rand(A.domain_shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    torch.testing.assert_close(Projector(vectors, grid)(x), A(x), rtol=0, atol=1e-9)
    error = float((general(vectors, grid)(x) - A(x)).norm() / A(x).norm())
    assert error < 5e-3


def test_flips_and_shifts_are_those_of_the_readings():
    grid = GRID
    g = wobbling(CONE)
    x = torch.rand(grid.shape, dtype=torch.float64)
    y = Projector(g, grid)(x)
    torch.testing.assert_close(
        Projector(g.flipped(columns=True), grid)(x), y.flip(-1), rtol=0, atol=1e-10
    )
    torch.testing.assert_close(
        Projector(g.flipped(rows=True), grid)(x), y.flip(-2), rtol=0, atol=1e-10
    )
    one = Projector(g.shifted(columns=1.0, rows=-2.0), grid)(x)
    torch.testing.assert_close(one[:, 2:, :-1], y[:, :-2, 1:], rtol=0, atol=1e-10)
    part = [4, 1]
    torch.testing.assert_close(Projector(g.select(part), grid)(x), y[part])


def test_roll_tilt_and_slant_turn_right_handed():
    """The source on +x: the normal u × v points at it; roll takes u = +y to v = +z, tilt v to the
    normal, slant u off it."""
    a, c, s = math.radians(20.0), math.cos(math.radians(20.0)), math.sin(math.radians(20.0))
    cone = {
        "kind": "cone",
        "angles_deg": [0],
        "sod": 50,
        "sdd": 90,
        "columns": 4,
        "rows": 3,
        "pitch": 1.0,
    }
    for name, u, v in (
        ("roll", (0, c, s), (0, -s, c)),
        ("tilt", (0, 1, 0), (s, 0, c)),
        ("slant", (-s, c, 0), (0, 0, 1)),
    ):
        turned = VectorGeometry.of(geometry_of(cone)).turned(**{name: a})
        np.testing.assert_allclose(turned.vectors[0, 6:], (*u, *v), atol=1e-12, err_msg=name)
        np.testing.assert_allclose(
            geometry_of({**cone, "pose": {f"{name}_deg": 20}}).vectors, turned.vectors
        )


@pytest.mark.parametrize("curved", [False, True])
def test_a_helix_takes_the_native_passes(curved):
    """Exact chords of a source that climbs by 6 mm a turn; the same scan by vectors is
    recognised as such."""
    cone = ConeBeam(
        np.linspace(0, 4 * math.pi, 12),
        60.0,
        110.0,
        18,
        11,
        (1.8, 2.1),
        detector="curved" if curved else "flat",
    )
    motion = helical_motion(cone, 6.0, -6.0)
    assert motion[:, 0] == pytest.approx(6.0 - 6.0 * cone.angles / (2 * math.pi))
    grid = VolumeGrid(
        tuple(2 * n for n in GRID.shape), tuple(s / 2 for s in GRID.spacing), GRID.center
    )
    x = torch.from_numpy(rasterize(grid, [BODY], 2))
    y = Projector(cone, grid, motion=motion)(x)
    for k in (0, 5, 11):  # a grid that is lower by what the source is higher
        z, *rest = grid.center
        moved = VolumeGrid(grid.shape, grid.spacing, (z + motion[k, 0], *rest))
        body = Gaussian(
            (BODY.center[0] + motion[k, 0], *BODY.center[1:]), BODY.radii, value=BODY.value
        )
        exact = line_integrals(cone.select([k]), [body], sub=4)[0]
        assert np.linalg.norm(y[k].numpy() - exact) < 0.05 * np.linalg.norm(exact)
        torch.testing.assert_close(
            y[k], Projector(cone.select([k]), moved)(x)[0], rtol=0, atol=1e-9
        )
    if not curved:
        vectors = VectorGeometry.of(cone, motion)
        A = Projector(vectors, grid)
        assert isinstance(A._engine.tables, Tables)
        torch.testing.assert_close(A(x), y, rtol=0, atol=1e-9)
        exact = vector_lines(vectors, [BODY], 4)
        assert np.linalg.norm(y.numpy() - exact) < 0.05 * np.linalg.norm(exact)


def test_parallel_jitter_takes_the_native_passes():
    jitter = np.random.default_rng(0).uniform(-2, 2, PARALLEL.views)
    g = VectorGeometry.of(PARALLEL).shifted(columns=jitter)
    v = np.array(g.vectors)
    v[::2, :2] *= -3.0  # a line has no sense and no length
    g = VectorGeometry(v, g.columns, parallel=True)
    A = Projector(g, GRID.slice)
    assert isinstance(A._engine.tables, Tables)
    x = torch.from_numpy(rasterize(GRID.slice, [Gaussian((2.0, -1.0), 1.6)], 3))
    exact = vector_lines(g, [Gaussian((2.0, -1.0), 1.6)])
    assert np.linalg.norm(A(x).numpy() - exact) < 0.05 * np.linalg.norm(exact)
    motion = np.random.default_rng(1).uniform(-2, 2, (PARALLEL.views, 2))
    both = Projector(g, GRID.slice, motion=motion)(x)
    torch.testing.assert_close(both, general(g.moved(motion), GRID.slice)(x), rtol=0, atol=0.05)


def test_refusals():
    g = VectorGeometry.of(CONE)
    with pytest.raises(ValueError, match="12 numbers per view need rows ≥ 1"):
        VectorGeometry(g.vectors, 18)
    with pytest.raises(ValueError, match=r"shape \(views, 6\) or \(views, 12\)"):
        VectorGeometry(np.zeros((3, 7)), 18)
    ray = g.vectors[:, 3:6] - g.vectors[:, :3]
    with pytest.raises(ValueError, match="do not meet their detector, or meet it edge on"):
        VectorGeometry(np.concatenate([g.vectors[:, :6], ray, g.vectors[:, 9:]], 1), 18, 11)
    broken = np.array(g.vectors)
    broken[3, 4] = np.nan
    refused(
        ("those of view 3 are not", lambda: VectorGeometry(broken, 18, 11)),
        ("would leave the plane", lambda: VectorGeometry.of(FAN).turned(roll=0.1)),
        ("one per view", lambda: g.shifted(columns=np.zeros(3))),
        ("need a 3-D grid", lambda: Projector(wobbling(CONE), GRID.slice)),
        (
            r"source of view 0 .* lies inside the grid",
            lambda: Projector(wobbling(CONE), VolumeGrid((4, 70, 70), 2.0)),
        ),
        (
            "window belongs to a circular scan",
            lambda: Projector(wobbling(CONE), GRID, DetectorWindow.full(CONE)),
        ),
    )


@pytest.mark.parametrize(
    ("geometry", "expected"),
    [
        (FanBeam([math.pi / 2], 60.0, 110.0, 21, 2.0, 3.0), [0, 60, -3, -50, -2, 0]),
        (
            ConeBeam([0.0], 60.0, 110.0, 21, 4, (1.5, 2.0), (0.5, 3.0)),
            [60, 0, 0, -50, 3, 0.5, 0, 2, 0, 0, 0, 1.5],
        ),
        (ParallelBeam([0.0], 3, 2.0, 0.5), [-1, 0, 0, 0.5, 0, 2]),
    ],
)
def test_vectors_of_the_first_view(geometry, expected):
    assert VectorGeometry.of(geometry).vectors[0] == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("geometry", [CONE, FAN, PARALLEL])
def test_a_circle_is_found_in_its_vectors(geometry, moving):
    """Of a radial displacement and a larger orbit, which look the same, with no larger motion
    than the one given."""
    motion = (
        np.random.default_rng(4).uniform(-3, 3, (7, 3 if geometry.has_rows else 2))
        if moving
        else None
    )
    vectors = VectorGeometry.of(geometry, motion)
    found, moved = vectors.as_circular()
    assert (moved is not None) == moving
    np.testing.assert_allclose(VectorGeometry.of(found, moved).vectors, vectors.vectors, atol=1e-11)
    if moving:
        assert np.linalg.norm(moved) < np.linalg.norm(motion)
    else:
        np.testing.assert_allclose(found.angles % (2 * math.pi), geometry.angles, atol=1e-11)


@pytest.mark.parametrize(
    ("place", "off"), [(slice(3, 5), 1.0), (slice(8, 9), 0.5), (slice(2, 3), 1.0)]
)
def test_no_circle(place, off):
    """A detector without the source, one that is rolled, a source without the detector."""
    vectors = np.array(VectorGeometry.of(CONE).vectors)
    vectors[1, place] += off
    assert VectorGeometry(vectors, CONE.columns, CONE.rows).as_circular() is None
    assert VectorGeometry.of(CONE).flipped(columns=True).as_circular() is None
    assert laminography().as_circular() is None
