"""The Triton kernels against the CPU kernels, run by Triton's interpreter (``tests/conftest.py``
asks for it)."""

import sys

import pytest
import torch

if sys.platform != "linux":  # where the test extra brings it along: missing it there is a failure
    pytest.importorskip("triton")
from triton import knobs

from torchpcct.detector_window import DetectorWindow
from torchpcct.geometry import ConeBeam, FanBeam, ParallelBeam, VolumeGrid
from torchpcct.projector import Projector
from torchpcct.projector.cuda.passes import GpuPasses, slices

pytestmark = pytest.mark.skipif(
    not knobs.runtime.interpret, reason="TRITON_INTERPRET=0: kernels need a GPU"
)
CPU = torch.device("cpu")
_PLANE = VolumeGrid((4, 3), (2.0, 1.7), (1.0, -0.5))
_VOLUME = VolumeGrid((3, 2, 3), (1.5, 2.0, 2.2), (0.4, 1.0, -1.0))
CASES = {
    "parallel": (ParallelBeam([0.1, 2.0], 5, 1.7, 0.4), _PLANE, None),
    "fan": (FanBeam([0.3, 0.8], 30.0, 60.0, 6, 3.0, 0.5), _PLANE, None),
    "fan window": (
        FanBeam([4.0], 30.0, 60.0, 20, 1.0, detector="curved"),
        _PLANE,
        DetectorWindow([7], 5),
    ),
    "cone": (ConeBeam([0.7], 60.0, 110.0, 4, 3, (1.7, 2.5), (0.6, -0.6)), _VOLUME, None),
    # So far from the source that slabs share depth layers.
    "cone layered": (
        ConeBeam([2.4], 600.0, 1100.0, 4, 3, (1.7, 2.5), detector="curved"),
        _VOLUME,
        None,
    ),
}


@pytest.mark.extended
@pytest.mark.parametrize("name", sorted(CASES))
def test_same_weights_as_the_cpu(name):
    A = Projector(*CASES[name])
    passes = A._engine.on(CPU)
    generator = torch.Generator().manual_seed(0)
    x = torch.randn((1, *A.domain_shape), generator=generator, dtype=torch.float64)
    y = torch.randn((1, *A.range_shape), generator=generator, dtype=torch.float64)
    torch.testing.assert_close(passes.forward(x), A(x), rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(passes.adjoint(y), A.T(y), rtol=1e-10, atol=1e-10)


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
    assert engine.agrees(CPU, torch.float32)
    forward = GpuPasses.forward
    monkeypatch.setattr(GpuPasses, "forward", lambda self, x: 1.001 * forward(self, x))
    with pytest.warns(RuntimeWarning, match=r"differs from the CPU's by 1\.0e-03"):
        assert not engine.agrees(CPU, torch.float32)
