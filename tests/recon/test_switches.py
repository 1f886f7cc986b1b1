"""What a program has switched for all of torch and numpy changes no result."""

import contextlib
import copy
import math

import numpy as np
import pytest
import torch

from recon import reconstruct
from recon.analytic.fbp import Fbp
from torchpcct import FanBeam, ParallelBeam, Projector, Scan, VolumeGrid, full_turn
from torchpcct.switches import unswitched

GRID = VolumeGrid((20, 20), 1.0)
GEOMETRY = ParallelBeam(np.arange(40) * math.pi / 40, 28, 1.0)


@contextlib.contextmanager
def default_dtype(dtype):
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)


SWITCHES = {
    "float64": lambda: default_dtype(torch.float64),
    "meta": lambda: torch.device("meta"),
    "autocast bfloat16": lambda: torch.autocast("cpu", torch.bfloat16),
    "autocast float16": lambda: torch.autocast("cpu", torch.float16),
    "numpy raises": lambda: np.errstate(all="raise"),
}


def scanned():
    lines = 0.04 * np.sqrt(np.clip(9.0**2 - GEOMETRY.column_positions**2, 0, None))
    counts = np.random.default_rng(0).poisson(1e4 * np.exp(-np.tile(lines, (GEOMETRY.views, 1))))
    return Scan.from_counts(counts.astype("f4"), GEOMETRY, air=1e4, mu_water=0.02)


@pytest.fixture(scope="module")
def wanted():
    return {method: reconstruct(scanned(), GRID, method).data for method in ("fbp", "pwls", "mbir")}


@pytest.mark.parametrize("method", ["fbp", "pwls", "mbir"])
@pytest.mark.parametrize("name", list(SWITCHES))
def test_every_method_gives_the_same(name, method, wanted):
    with SWITCHES[name]():
        found = reconstruct(scanned(), GRID, method)
    assert found.data.device.type == "cpu"
    torch.testing.assert_close(found.data, wanted[method], atol=1e-3, rtol=0)


def test_the_switches_are_back_afterwards():
    with (
        default_dtype(torch.float64),
        torch.device("meta"),
        np.errstate(all="raise"),
        torch.autocast("cpu"),
    ):
        with unswitched():
            assert (torch.get_default_dtype(), torch.zeros(1).device.type) == (torch.float32, "cpu")
            assert not torch.is_autocast_enabled("cpu")
            assert np.geterr()["under"] == "ignore"
        assert (torch.get_default_dtype(), torch.zeros(1).device.type) == (torch.float64, "meta")
        assert torch.is_autocast_enabled("cpu")
        assert np.geterr()["under"] == "raise"
        with pytest.raises(ZeroDivisionError), unswitched():
            _ = 1 / 0
        assert torch.get_default_dtype() is torch.float64


@pytest.mark.filterwarnings("ignore:the rows end inside the object")
@pytest.mark.parametrize("name", ["float64", "autocast bfloat16"])
def test_gradients_are_the_same(name):
    """Of a backward pass that runs under the switch, too: its products of matrices are ours."""
    layer, A = Fbp(GEOMETRY, GRID, "soft"), Projector(GEOMETRY, GRID)
    given = torch.rand(GRID.shape, generator=torch.Generator().manual_seed(0))

    def gradient():
        x = given.clone().requires_grad_()
        y = layer(A(x))
        return torch.autograd.grad((y * y.detach()).sum(), x)[0]

    plain = gradient()
    with SWITCHES[name]():
        torch.testing.assert_close(gradient(), plain)


@pytest.mark.filterwarnings("ignore:the rows end inside the object")
def test_fbp_in_a_compiled_network():
    layer = Fbp(FanBeam(full_turn(12), 60.0, 100.0, 21, 1.7), VolumeGrid((9, 11), 1.3))
    y = torch.randn(2, 12, 21, generator=torch.Generator().manual_seed(0), requires_grad=True)
    compiled = torch.compile(layer, backend="eager", fullgraph=True)
    torch.testing.assert_close(compiled(y), layer(y))
    gradients = [torch.autograd.grad(f(y).square().sum(), y)[0] for f in (compiled, layer)]
    torch.testing.assert_close(*gradients)
    torch.testing.assert_close(copy.deepcopy(layer)(y), layer(y))
