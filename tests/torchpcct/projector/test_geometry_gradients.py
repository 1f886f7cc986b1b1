"""Gradients of readings by motion and geometry: central differences of the very projector."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from analytic import Gaussian, rasterize
from refusals import refusals
from torch.autograd import gradcheck

from torchpcct import (
    ConeBeam,
    FanBeam,
    ParallelBeam,
    Projector,
    VectorGeometry,
    VolumeGrid,
    full_turn,
)
from torchpcct.detector_window import footprint
from torchpcct.projector import with_parameters

ANGLES = full_turn(3, 0.23)
GRID = VolumeGrid((3, 4, 5), (1.2, 1.1, 1.0), (0.4, 1.0, -2.0))
CONE = ConeBeam(ANGLES, 60.0, 110.0, 7, 5, (1.8, 2.1), (0.3, 0.5))
CURVED = ConeBeam(ANGLES, 60.0, 110.0, 7, 5, (1.8, 2.1), (0.3, 0.5), "curved")
FAN = FanBeam(ANGLES, 60.0, 110.0, 9, 2.1, 0.5)
TURNED = VectorGeometry.of(CONE).turned(0.1, -0.07, 0.05)
LONG = VectorGeometry.of(ConeBeam(ANGLES, 60.0, 110.0, 5, 2, (9.0, 1.1))).turned(roll=0.6)
SCANS: dict[str, tuple[Any, VolumeGrid]] = {
    "parallel": (ParallelBeam(ANGLES, 9, 1.1, 0.4), GRID.slice),
    "fan": (FAN, GRID.slice),
    "fan, curved": (FanBeam(ANGLES, 60.0, 110.0, 9, 2.1, 0.5, "curved"), GRID.slice),
    "cone": (CONE, GRID),
    "cone, curved": (CURVED, GRID),
    "vectors": (TURNED, GRID),
    "vectors without rows": (VectorGeometry.of(FAN).turned(slant=0.1), GRID.slice),
    "long cells that are rolled": (LONG, GRID),
    "tilted parallel rays": (
        VectorGeometry(
            [[-0.9, 0.1, 0.3, 1, 2, 0.3, -0.1, 1.1, 0.1, 0.2, 0.1, 1.2]], 8, 6, parallel=True
        ),
        GRID,
    ),
}
PARAMETERS: dict[str, tuple[Any, dict[str, float]]] = {
    "parallel": (SCANS["parallel"][0], {"offset": 0.3, "axis": 0.2, "slant": 0.05}),
    "fan": (FAN, {"offset": 0.3, "axis": 0.2, "sod": 57.0, "sdd": 112.0, "slant": 0.05}),
    "fan, curved": (SCANS["fan, curved"][0], {"offset": 0.7, "axis": 0.2, "sod": 57.0}),
    "cone": (
        CONE,
        {
            "offset": 0.3,
            "row_offset": 0.1,
            "axis": 0.2,
            "sod": 57.0,
            "sdd": 112.0,
            "roll": 0.05,
            "tilt": 0.04,
            "slant": 0.03,
        },
    ),
    "vectors": (TURNED, {"offset": 0.3, "row_offset": 0.1, "axis": 0.2, "roll": 0.1, "tilt": 0.1}),
}


def _free(value: Any) -> torch.Tensor:
    return torch.tensor(np.array(value), dtype=torch.float64, requires_grad=True)


def _path(views: int, columns: int, seed: int = 0) -> torch.Tensor:
    return _free(np.random.default_rng(seed).uniform(-0.3, 0.3, (views, columns)))


def _volume(shape: Any, seed: int = 1) -> torch.Tensor:
    return _free(np.random.default_rng(seed).uniform(0.2, 1.0, tuple(shape)))


@pytest.mark.parametrize("name", SCANS)
@pytest.mark.parametrize("transposed", [False, True])
def test_by_motion(name, transposed):
    geometry, grid = SCANS[name]
    motion = _path(geometry.views, grid.ndim + 1)

    def readings(x, motion):
        A = Projector(with_parameters(geometry), grid, motion=motion)
        return (A.T if transposed else A)(x)

    A = Projector(geometry, grid, motion=motion)
    x = _volume(A.range_shape if transposed else A.domain_shape)
    assert gradcheck(readings, (x, motion), fast_mode=True)


@pytest.mark.extended
@pytest.mark.filterwarnings("ignore:.torch.jit.script")  # torch's own, of forward derivatives
@pytest.mark.parametrize("transposed", [False, True])
def test_forward_derivatives(transposed):
    scan, motion = with_parameters(CONE), _path(3, 4)

    def readings(x, motion):
        A = Projector(scan, GRID, motion=motion)
        return (A.T if transposed else A)(x)

    x = _volume(CONE.shape if transposed else GRID.shape)
    assert gradcheck(
        readings, (x, motion), check_forward_ad=True, check_backward_ad=False, fast_mode=True
    )


@pytest.mark.parametrize("name", PARAMETERS)
def test_by_every_number_of_the_geometry(name):
    geometry, numbers = PARAMETERS[name]
    grid = GRID if geometry.has_rows else GRID.slice
    x = _volume(grid.shape).detach()
    values = {n: _free(v) for n, v in numbers.items()}
    values["vectors" if name == "vectors" else "angles"] = _free(
        geometry.vectors if name == "vectors" else geometry.angles
    )

    def readings(*tensors):
        given = dict(zip(values, tensors, strict=True))
        return Projector(with_parameters(geometry, **given), grid)(x)

    assert gradcheck(readings, tuple(values.values()), fast_mode=True)


def test_per_view_numbers_and_windows():
    grid = VolumeGrid((2, 3, 3), 0.8, (0.4, 5.0, -6.0))
    geometry = ConeBeam(ANGLES, 60.0, 110.0, 40, 9, (1.8, 1.1), detector="curved")
    window = footprint(geometry, grid)
    x, motion = _volume(grid.shape), _path(3, 3)
    assert window.columns < 20
    found = Projector(geometry, grid, window, motion)(x)
    whole = Projector(geometry, grid, motion=motion)(x)
    columns = torch.from_numpy(window.column_indices)[:, None].expand(found.shape)
    kept = whole[:, window.first_row : window.first_row + window.rows].gather(-1, columns)
    torch.testing.assert_close(found, kept)
    assert gradcheck(
        lambda m: Projector(geometry, grid, window, m)(x.detach()), (motion,), fast_mode=True
    )


def test_one_number_per_view():
    x, offset = _volume(GRID.slice.shape).detach(), _path(3, 1)[:, 0].detach().requires_grad_()
    assert gradcheck(lambda o: Projector(with_parameters(FAN, offset=o), GRID.slice)(x), (offset,))
    with torch.no_grad():
        offset[:] = torch.tensor([0.5, 0.5, 0.1])
    y = Projector(with_parameters(FAN, offset=offset), GRID.slice)(x)
    expected = Projector(with_parameters(FAN.with_column_offset(0.1)), GRID.slice)(x)
    torch.testing.assert_close(y[2], expected[2])
    assert not torch.allclose(y[1], expected[1])


@pytest.mark.parametrize("name", SCANS)
def test_values_are_those_of_the_ordinary_passes(name):
    """Of a smooth object; the models differ by less than voxels do."""
    geometry, _ = SCANS[name]
    grid = VolumeGrid((24, 28, 28), 0.5)
    body = Gaussian((0.3, 0.5, -0.4), (1.5, 1.7, 1.8), value=0.4)
    if not geometry.has_rows:
        grid, body = grid.slice, Gaussian((0.5, -0.4), (1.7, 1.8), value=0.4)
    x = torch.from_numpy(rasterize(grid, [body]))
    motion = _path(geometry.views, grid.ndim + 1)
    still = motion.detach().numpy()
    found = Projector(geometry, grid, motion=motion)(x).detach()
    expected = Projector(geometry, grid, motion=still)(x)
    error = float((found - expected).abs().max() / expected.abs().max())
    assert error < (1e-12 if isinstance(geometry, VectorGeometry) and geometry.rows else 3e-3)


@pytest.mark.parametrize("name", ["fan", "fan, curved", "cone", "vectors"])
def test_a_grid_that_turns_is_seen_from_elsewhere(name):
    """A quarter turn of a square grid is the volume turned by a quarter."""
    geometry, _ = SCANS[name]
    grid = VolumeGrid((3, 8, 8), 1.0) if geometry.has_rows else VolumeGrid((8, 8), 1.0)
    x = _volume(grid.shape).detach()
    motion = np.zeros((geometry.views, grid.ndim + 1))
    motion[:, -1] = math.pi / 2
    # Index y, x at (x, y): a turn by +90° takes +x to +y.
    turned = x.flip(-2).transpose(-1, -2)
    for m in (motion, torch.from_numpy(motion).requires_grad_()):
        found = Projector(geometry, grid, motion=m)(x)
        still = 0 * m if isinstance(m, np.ndarray) else (0 * m.detach()).requires_grad_()
        if isinstance(m, np.ndarray):  # of a tensor without gradient the ordinary passes, too
            assert torch.equal(Projector(geometry, grid, motion=torch.from_numpy(m))(x), found)
        expected = Projector(geometry, grid, motion=still)(turned)
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)


def test_second_order_by_volume_and_geometry():
    motion = _path(3, 4)
    x, y = _volume(GRID.shape), _volume(CONE.shape, 2)

    def by_motion(x, y):
        value = (Projector(CONE, GRID, motion=motion)(x) * y).sum()
        return torch.autograd.grad(value, motion, create_graph=True)[0]

    assert gradcheck(by_motion, (x, y), fast_mode=True)

    def by_volume(motion):
        A = Projector(CONE, GRID, motion=motion)
        return torch.autograd.grad(A(x).square().sum(), x, create_graph=True)[0]

    assert gradcheck(by_volume, (motion,), fast_mode=True)


def test_no_second_derivative_by_the_geometry():
    motion = _path(3, 4)
    value = Projector(CONE, GRID, motion=motion)(_volume(GRID.shape)).square().sum()
    (first,) = torch.autograd.grad(value, motion, create_graph=True)
    with pytest.raises(NotImplementedError, match="Gauss-Newton"):
        torch.autograd.grad(first.square().sum(), motion)


def test_an_optimiser_finds_the_path():
    """In place, through a projector that is made once; float32."""
    grid = VolumeGrid((12, 12), 1.0)
    geometry = FanBeam(full_turn(5, 0.1), 60.0, 110.0, 21, 1.9)
    x = torch.from_numpy(rasterize(grid, [Gaussian((0.5, -0.4), (1.7, 1.8), value=0.4)])).float()
    true = torch.tensor([[0.4, -0.3]]).repeat(5, 1)
    data = Projector(geometry, grid, motion=true.clone().requires_grad_())(x).detach()
    motion = torch.zeros(5, 2, requires_grad=True)
    A = Projector(geometry, grid, motion=motion)
    steps = torch.optim.LBFGS([motion], max_iter=25)

    def loss():
        steps.zero_grad()
        value = (A(x) - data).square().sum()
        value.backward()
        return value

    steps.step(loss)
    # Along the rays a shift is hardly seen: the readings are what must be found.
    assert float((A(x).detach() - data).abs().max()) < 0.02 * float(data.max())


def test_batches_add_up():
    motion = _path(3, 3)
    x = torch.stack([_volume(GRID.shape, n).detach() for n in (1, 2)])
    A = Projector(CONE, GRID, motion=motion)
    (both,) = torch.autograd.grad(A(x).sum(), motion)
    each = [torch.autograd.grad(A(v).sum(), motion)[0] for v in x]
    torch.testing.assert_close(both, sum(each))
    assert A(x[:0]).shape == (0, *A.range_shape)


def test_settled():
    offset, angles = torch.tensor(0.7), torch.from_numpy(ANGLES + 0.1)
    flat = with_parameters(CONE, offset=offset, angles=angles).settled()
    assert isinstance(flat, ConeBeam)
    assert flat.column_offset == pytest.approx(0.7, abs=1e-6)
    np.testing.assert_allclose(flat.angles % (2 * math.pi), ANGLES + 0.1)
    curved = with_parameters(CURVED, offset=offset).settled()
    assert curved == CURVED.with_column_offset(float(offset))
    rolled = with_parameters(CONE, roll=torch.tensor(0.1, dtype=torch.float64)).settled()
    np.testing.assert_allclose(
        rolled.vectors, VectorGeometry.of(CONE).turned(roll=0.1).vectors, atol=1e-12
    )


ZERO = torch.zeros(())
FREE = torch.zeros(3, 4, requires_grad=True)
test_refusals = refusals(
    ("needs a detector with rows", lambda: with_parameters(FAN, roll=ZERO)),
    ("did you mean 'offset'", lambda: with_parameters(FAN, ofset=ZERO)),
    ("parallel rays", lambda: with_parameters(SCANS["parallel"][0], sod=ZERO)),
    ("curved detector", lambda: with_parameters(CURVED, roll=ZERO)),
    ("in its vectors", lambda: with_parameters(TURNED, sod=ZERO)),
    ("VectorGeometry.of", lambda: with_parameters(FAN, vectors=torch.zeros(3, 6))),
    (r"\(3,\)", lambda: with_parameters(FAN, angles=torch.zeros(4))),
    ("finite", lambda: with_parameters(FAN, offset=torch.tensor(math.nan))),
    ("floating point", lambda: with_parameters(FAN, offset=torch.tensor(1))),
    ("geometry must be", lambda: with_parameters("fan", offset=ZERO)),  # type: ignore[arg-type]
    ("sdd greater", lambda: Projector(with_parameters(FAN, sdd=ZERO + 20), GRID.slice)),
    (r"\(3, 2\)", lambda: Projector(FAN, GRID.slice, motion=FREE)),
    ("3-D grid", lambda: Projector(CONE, GRID.slice, motion=FREE)),
    ("inside the grid", lambda: Projector(with_parameters(FAN, sod=ZERO + 2.0), GRID.slice)),
)
