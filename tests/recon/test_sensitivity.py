"""Worst-case response against dense singular values."""

import math

import pytest
import torch

from recon.sensitivity import worst_case_gain


def test_a_linear_method_against_its_singular_values():
    generator = torch.Generator().manual_seed(0)
    matrix = torch.randn(12, 30, generator=generator, dtype=torch.float64)
    variance = torch.rand(30, generator=generator, dtype=torch.float64) + 0.1
    gain, worst = worst_case_gain(
        lambda x: matrix @ x, torch.zeros(30, dtype=torch.float64), lambda v: variance * v, 0.5, iterations=300
    )
    left, values, _ = torch.linalg.svd(matrix * variance.sqrt())
    assert gain == pytest.approx(float(values[0]) * 0.5**1.5, rel=1e-6)
    assert abs(float(worst @ left[:, 0])) == pytest.approx(1.0, abs=1e-4)


def test_a_nonlinear_method_at_its_point():
    data = torch.tensor([0.3, -1.2, 2.0], dtype=torch.float64)
    gain, _ = worst_case_gain(lambda x: x**3, data, lambda v: v, 1.0, iterations=60)
    assert gain == pytest.approx(3 * 4.0)


def test_a_constant_is_refused():
    with pytest.raises(ValueError, match="constant"):
        worst_case_gain(lambda x: 0.0 * x, torch.ones(3), lambda v: v, 1.0)
    with pytest.raises(ValueError, match="iterations"):
        worst_case_gain(lambda x: x, torch.ones(3), lambda v: v, 1.0, iterations=0)
    assert math.isfinite(worst_case_gain(lambda x: x, torch.ones(3), lambda v: v, 1.0)[0])
