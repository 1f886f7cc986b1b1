"""The Triton kernels of scans given by vectors against the CPU's, run by Triton's interpreter
(``tests/conftest.py`` asks for it)."""

import sys
from unittest import mock

import numpy as np
import pytest
import torch

if sys.platform != "linux":  # where the test extra brings it along: missing it there is a failure
    pytest.importorskip("triton")
from standin import DEVICE, Standin, standin
from torch.utils._python_dispatch import _disable_current_modes
from triton import knobs

from torchpcct import ConeBeam, FanBeam, Projector, VectorGeometry, VolumeGrid
from torchpcct.projector import engine as engine_module
from torchpcct.projector.cuda.vector_passes import GpuVectorPasses
from torchpcct.projector.engine import Engine
from torchpcct.projector.tables import VectorTables

pytestmark = pytest.mark.skipif(
    not knobs.runtime.interpret, reason="TRITON_INTERPRET=0: kernels need a GPU"
)
CPU = torch.device("cpu")
GRID = VolumeGrid((3, 4, 5), (1.5, 2.0, 2.2), (0.4, 1.0, -1.0))
CONE = ConeBeam([0.7, 2.2], 60.0, 110.0, 5, 4, (2.7, 3.5), (0.6, -0.6))
FAN = FanBeam([0.3, 0.8], 30.0, 60.0, 6, 3.0, 0.5)
_PARALLEL = np.array([[1.0, 0.4, 0.0, 0.0, -0.3, 1.6], [0.0, 1.0, 0.0, 0.0, 1.7, 0.2]])
TURNED = VectorGeometry.of(CONE).turned(0.1, -0.2, 0.15)


def tilted_parallel(rise):
    """Parallel rays out of the plane of rotation, whose detector is upright to them."""
    beta = np.array([0.3, 2.0])
    radial = np.stack([np.cos(beta), np.sin(beta), 0 * beta], 1)
    tangent = np.stack([-np.sin(beta), np.cos(beta), 0 * beta], 1)
    ray = np.array([0, 0, np.sin(rise)]) - np.cos(rise) * radial
    v = np.cross(tangent, ray)
    vectors = np.concatenate([ray, 0 * ray, 1.9 * tangent, 1.7 * v], 1)
    return VectorGeometry(vectors, 6, 5, parallel=True)


def beside_the_source():
    """Of a cone whose detector stands askew beside the grid, next to which its source is."""
    source, centre = [9.0, 1.0, 0.5], [-30.0, 30.0, 4.0]
    steps = [0.0, 9.0, 0.0, 1.0, 0.0, 8.0]
    return VectorGeometry(np.array([[*source, *centre, *steps]]), 9, 7)


CASES = {
    "fan": (VectorGeometry.of(FAN).turned(slant=[0.3, -0.2]), GRID.slice),
    "parallel": (
        VectorGeometry(_PARALLEL, 7, None, True),
        GRID.slice,
    ),
    "cone": (TURNED, GRID),
    "wide cells": (VectorGeometry(TURNED.vectors * np.repeat([1, 1, 4, 6], 3), 3, 2), GRID),
    "fine cells": (
        VectorGeometry(TURNED.vectors * np.repeat([1, 1, 0.11, 0.2], 3), 11, 13),
        VolumeGrid((2, 2, 2), 3.0),
    ),
    # Cut into parts of several numbers.
    "rolled long cells": (
        VectorGeometry.of(ConeBeam([0.7], 60.0, 110.0, 3, 4, (1.1, 9.0))).turned(0.6, 0.4),
        GRID,
    ),
    "laminography": (tilted_parallel(0.5), GRID),
    "steep": (tilted_parallel(1.2), GRID),  # rays that cross more slices than rows
    "flipped": (TURNED.select([1]).flipped(columns=True, rows=True), GRID),
    "beside the source": (beside_the_source(), VolumeGrid((3, 4, 5), 2.5)),
    # 10⁵ voxels from the origin: float32 of a place there is off by a hundredth of a voxel.
    "far away": (
        TURNED.select([0]).moved(np.full((1, 3), -2e5)),
        VolumeGrid(GRID.shape, GRID.spacing, (2e5 + 0.4, 2e5 + 1.0, 2e5 - 1.0)),
    ),
}


def made(name):
    A = Projector(*CASES[name])
    assert isinstance(A._engine.tables, VectorTables)
    generator = torch.Generator().manual_seed(0)
    x, y = (
        torch.randn((2, *shape), generator=generator, dtype=torch.float64)
        for shape in (A.domain_shape, A.range_shape)
    )
    return A, A._engine.on(CPU), x, y


@pytest.mark.extended
@pytest.mark.parametrize("lanes", [32, 128])
@pytest.mark.parametrize("name", sorted(CASES))
def test_same_weights_as_the_cpu(name, lanes):
    A, passes, x, y = made(name)
    passes.lanes = lanes
    if lanes < 128:
        x, y = x[:1], y[:1]
    for there, here, given in ((passes.forward, A, x), (passes.adjoint, A.T, y)):
        expect = here(given)
        assert expect.abs().max() > 0
        rounding = 1e-12 if name != "far away" else 1e-9
        torch.testing.assert_close(there(given), expect, rtol=rounding, atol=rounding)
        if lanes < 128:
            continue
        # float32 is relative to the voxel: rounding of the data, of weights and of sums.
        single = there(given.float()).double()
        assert (single - expect).norm() < 1e-6 * expect.norm()
    left, right = (passes.forward(x) * y).sum(), (x * passes.adjoint(y)).sum()
    torch.testing.assert_close(left, right, rtol=1e-11, atol=0)


def test_long_cells_are_cut_into_parts():
    assert made("rolled long cells")[1].survey.split[:, 2].max() > 2
    assert made("cone")[1].survey.split.max() == 1


@pytest.mark.extended
@pytest.mark.parametrize("name", ["fan", "cone", "rolled long cells"])
def test_slices_that_fit_the_memory_give_the_same_bits(name, monkeypatch):
    geometry, grid = CASES[name]
    passes = Engine(VectorTables(geometry.select([0, -1]), grid)).on(CPU)
    generator = torch.Generator().manual_seed(0)
    x, y = (
        torch.randn((2, *shape), generator=generator)
        for shape in (passes.tables.domain_shape, passes.tables.range_shape)
    )
    whole = passes.forward(x), passes.adjoint(y)
    assert passes._chunks() == [(0, 2)]
    assert passes._volumes(2, 4) == 2
    # so little that everything goes one by one
    monkeypatch.setattr(GpuVectorPasses, "_budget", lambda self: 1)
    assert passes._chunks() == [(0, 1), (1, 2)]
    assert passes._volumes(2, 4) == 1
    assert torch.equal(passes.forward(x), whole[0])
    assert torch.equal(passes.adjoint(y), whole[1])


def test_estimate_of_memory_holds_what_is_tabulated():
    for name in ("fan", "cone", "rolled long cells"):
        A, passes, _, _ = made(name)
        one, two = (A.memory_estimate(n, device="cuda") for n in (1, 2))
        assert 0 < one < two
        arrays = 4 * (np.prod(A.domain_shape) + np.prod(A.range_shape))
        tables = passes.cells.table(
            0, passes.cells.views, passes.bits, passes.bound, passes.survey, torch.float32
        )
        assert one - arrays > sum(
            t.numel() * t.itemsize for t in (tables.lines, tables.widths, tables.axes)
        )
    assert A.memory_estimate(0, device="cuda") == 0


@pytest.mark.parametrize(
    "name",
    ["parallel", *(pytest.param(n, marks=pytest.mark.extended) for n in ("fan", "cone", "steep"))],
)
def test_kernels_are_trusted_once_they_reproduce_the_cpu(name, monkeypatch):
    engine = Projector(*CASES[name])._engine
    kind, small = engine_module._small_scan(engine.tables)
    assert small.geometry.parallel == engine.tables.geometry.parallel
    assert small.grid.ndim == engine.tables.grid.ndim
    monkeypatch.setattr(engine_module, "_CHECKED", {})
    assert engine._trusted_on(CPU, torch.float32) is engine.on(CPU)
    ((key, found),) = engine_module._CHECKED.items()
    assert key == (f"cpu {kind}", torch.float32)
    assert 0 < found < 1e-6
    monkeypatch.setitem(engine_module._CHECKED, key, 1e-3)
    with pytest.raises(RuntimeError, match=r"differs from the CPU's by 1\.0e-03 \(allowed 1e-04\)"):
        engine._trusted_on(CPU, torch.float32)


@pytest.mark.extended
def test_a_kernel_that_looks_beside_the_cell_is_found(monkeypatch):
    """What the check at first use is for."""
    monkeypatch.setattr("torchpcct.projector.cuda.vector_passes._WIDER", 0.1)
    _, small = engine_module._small_scan(made("cone")[0]._engine.tables)
    assert Engine(small).deviation(CPU, torch.float32) > 1e-4


def test_without_triton_it_says_so(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ValueError, match="the projector on meta needs Triton"):
        Projector(*CASES["cone"])._engine._trusted_on(DEVICE, torch.float32)


class _Passes:
    """Triton's passes, by the interpreter, for tensors on the stand-in device."""

    def __init__(self, engine):
        self.passes = engine.on(CPU)

    def forward(self, x):
        with _disable_current_modes():
            return Standin(self.passes.forward(x.inner))

    def adjoint(self, y):
        with _disable_current_modes():
            return Standin(self.passes.adjoint(y.inner))


@pytest.mark.extended
def test_gradients_and_empty_batches_on_a_device():
    geometry, grid = CASES["fan"]
    A = Projector(geometry, grid)
    generator = torch.Generator().manual_seed(0)
    x = torch.rand((2, *A.domain_shape), generator=generator)
    y = A(0.02 * torch.ones(A.domain_shape))
    expect = A.T(A(x) - y)
    with (
        standin() as counter,
        mock.patch.object(Engine, "_trusted_on", lambda engine, device, dtype: _Passes(engine)),
    ):
        there = x.to(DEVICE).requires_grad_()
        (0.5 * (A(there) - y.to(DEVICE)).square().sum()).backward()
        empty = A(there.detach()[:0])
        assert empty.shape == (0, *A.range_shape)
        assert empty.device == DEVICE
        assert not counter.copies
        gradient = there.grad.cpu()
    assert (gradient - expect).norm() < 1e-5 * expect.norm()
