"""What every projector must do, over the registry of geometries."""

from __future__ import annotations

import pytest
import torch
from geometries import REGISTRY
from torch.autograd import gradcheck, gradgradcheck

from torchpcct.projector import Projector

NAMES = sorted(REGISTRY)
EPS = {torch.float32: 1e-6, torch.float64: 1e-13}


def _projector(name: str) -> Projector:
    return Projector(*REGISTRY[name]())


def _random(shape, dtype=torch.float64, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_adjoint_is_the_transpose(name, dtype):
    A = _projector(name)
    x, y = _random(A.domain_shape, dtype), _random(A.range_shape, dtype, 1)
    Ax, Aty = A(x), A.T(y)
    assert Ax.shape == A.range_shape
    assert Aty.shape == A.domain_shape
    assert Ax.dtype == Aty.dtype == dtype
    difference = (Ax.double() * y.double()).sum() - (x.double() * Aty.double()).sum()
    scale = Ax.double().norm() * y.double().norm() + x.double().norm() * Aty.double().norm()
    assert scale > 0
    assert abs(difference) <= EPS[dtype] * scale


@pytest.mark.parametrize("name", NAMES)
def test_dense_matrix_of_both_directions_agrees(name):
    A = _projector(name)
    n, m = torch.Size(A.domain_shape).numel(), torch.Size(A.range_shape).numel()
    forward = A(torch.eye(n, dtype=torch.float64).reshape(n, *A.domain_shape)).reshape(n, m)
    # Cone-beam volumes pass one by one: a random part of the readings.
    some = torch.randperm(m, generator=torch.Generator().manual_seed(0))[: 120 if len(A.domain_shape) == 3 else m]
    adjoint = A.T(torch.eye(m, dtype=torch.float64)[some].reshape(-1, *A.range_shape)).reshape(-1, n)
    torch.testing.assert_close(forward[:, some], adjoint.T, rtol=0, atol=1e-12 * float(forward.abs().max()))
    assert float(forward.min()) > -1e-12 * float(forward.max())


@pytest.mark.parametrize("name", ["parallel_half_turn", "fan_window", "cone_window", "cone_curved_offset"])
def test_gradients_of_first_and_second_order(name):
    A = _projector(name)
    x = _random((2, *A.domain_shape)).requires_grad_()
    y = _random((2, *A.range_shape)).requires_grad_()
    assert gradcheck(A, x, fast_mode=True)
    assert gradcheck(A.T, y, fast_mode=True)
    square = lambda t: A(t) ** 2  # noqa: E731
    assert gradgradcheck(square, x, fast_mode=True)
