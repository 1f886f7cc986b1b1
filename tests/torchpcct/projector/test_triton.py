"""The Triton kernels against the CPU kernels, run by Triton's interpreter (``tests/conftest.py``
asks for it)."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

if sys.platform != "linux":  # where the test extra brings it along: missing it there is a failure
    pytest.importorskip("triton")
from triton import knobs

from torchpcct.detector_window import DetectorWindow
from torchpcct.geometry import ConeBeam, FanBeam, ParallelBeam, VolumeGrid
from torchpcct.projector import Projector
from torchpcct.projector import engine as engine_module
from torchpcct.projector.cuda.passes import GpuPasses, slices

pytestmark = pytest.mark.skipif(
    not knobs.runtime.interpret, reason="TRITON_INTERPRET=0: kernels need a GPU"
)
CPU = torch.device("cpu")
_PLANE = VolumeGrid((4, 3), (2.0, 1.7), (1.0, -0.5))
_VOLUME = VolumeGrid((3, 2, 3), (1.5, 2.0, 2.2), (0.4, 1.0, -1.0))
_TURN = np.arange(5) * 1.3
CASES = {
    "parallel": (ParallelBeam([0.1, 2.0], 5, 1.7, 0.4), _PLANE, None),
    "fan": (FanBeam([0.3, 0.8], 30.0, 60.0, 6, 3.0, 0.5), _PLANE, None),
    "fan window": (
        FanBeam([4.0], 30.0, 60.0, 20, 1.0, detector="curved"),
        _PLANE,
        DetectorWindow([7], 5),
    ),
    "wide cells": (FanBeam([0.3, 2.8], 30.0, 60.0, 4, 12.0), VolumeGrid((5, 4), 1.0), None),
    "fine cells": (
        FanBeam([0.3, 4.0], 30.0, 60.0, 40, 0.8, detector="curved"),
        VolumeGrid((3, 4), 2.0),
        None,
    ),
    # Some views have the grid behind their source.
    "beside the source": (
        FanBeam(_TURN, 9.0, 60.0, 12, 6.0),
        VolumeGrid((4, 4), 1.0, (12.0, 3.0)),
        None,
    ),
    "cone": (ConeBeam([0.7], 60.0, 110.0, 4, 3, (1.7, 2.5), (0.6, -0.6)), _VOLUME, None),
    "cone beside the source": (
        ConeBeam(_TURN[:3], 3.0, 60.0, 9, 6, (9.0, 30.0)),
        VolumeGrid((6, 4, 3), 1.0, (0.5, 6.0, 1.0)),
        None,
    ),
    # So far from the source that slabs share depth layers.
    "cone layered": (
        ConeBeam([2.4], 600.0, 1100.0, 4, 3, (1.7, 2.5), detector="curved"),
        _VOLUME,
        None,
    ),
}


@pytest.mark.extended
@pytest.mark.parametrize("lanes", [2, 128])
@pytest.mark.parametrize("name", sorted(CASES))
def test_same_weights_as_the_cpu(name, lanes):
    A = Projector(*CASES[name])
    passes = A._engine.on(CPU)
    passes.lanes = lanes
    generator = torch.Generator().manual_seed(0)
    x = torch.randn((2, *A.domain_shape), generator=generator, dtype=torch.float64)
    y = torch.randn((2, *A.range_shape), generator=generator, dtype=torch.float64)
    for there, here, given in ((passes.forward, A, x), (passes.adjoint, A.T, y)):
        expect = here(given)
        assert expect.abs().max() > 0
        torch.testing.assert_close(there(given), expect, rtol=1e-12, atol=1e-12)
        # float32 is relative to the voxel: rounding of the data, of weights and of sums.
        single = there(given.float()).double()
        assert (single - expect).norm() < 1e-6 * expect.norm()
    left, right = (passes.forward(x) * y).sum(), (x * passes.adjoint(y)).sum()
    torch.testing.assert_close(left, right, rtol=1e-12, atol=0)


@pytest.mark.extended
@pytest.mark.parametrize("name", ["fan", "cone"])
def test_slices_that_fit_the_memory_give_the_same_bits(name, monkeypatch):
    geometry, grid, window = CASES[name]
    geometry = geometry.select([0, 0])

    A = Projector(geometry, grid, window)
    passes = A._engine.on(CPU)
    generator = torch.Generator().manual_seed(0)
    x, y = (
        torch.randn((2, *shape), generator=generator) for shape in (A.domain_shape, A.range_shape)
    )
    whole = passes.forward(x), passes.adjoint(y)
    assert slices(passes.tables, None, 2, 4) == (2, 2)
    assert slices(passes.tables, 1, 2, 4) == (1, 1)
    # so little that everything goes one by one
    monkeypatch.setattr(GpuPasses, "_budget", lambda self: 1)
    assert torch.equal(passes.forward(x), whole[0])
    assert torch.equal(passes.adjoint(y), whole[1])
    assert 0 < A.memory_estimate(1, device="cuda") < A.memory_estimate(2, device="cuda")


def test_a_deviating_kernel_is_refused(monkeypatch):
    engine = Projector(FanBeam([0.0], 60.0, 110.0, 1, 1.0), VolumeGrid((1, 1), 3.0))._engine
    assert engine.deviation(CPU, torch.float32) < 1e-6
    monkeypatch.setitem(engine_module._CHECKED, ("cpu FanBeam", torch.float32), 1e-3)
    with pytest.raises(RuntimeError, match=r"differs from the CPU's by 1\.0e-03 \(allowed 1e-04\)"):
        engine._trusted_on(CPU, torch.float32)


@pytest.mark.extended
def test_the_kernels_compile_for_cards():
    """Without Triton's interpreter, and without a card: what the interpreter lets pass, such as a
    loop that changes a type, does not compile."""
    program = Path(__file__).parents[2] / "bench" / "compile_triton.py"
    environment = {k: v for k, v in os.environ.items() if k != "TRITON_INTERPRET"}
    done = subprocess.run(
        [sys.executable, program], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
