"""Dead readings are bridged by their neighbours: exactly for linear data, and whatever they hold."""

from __future__ import annotations

import math

import pytest
import torch

from torchpcct.readings import bridge


def test_bridging_is_linear_and_knows_nothing_of_the_dead():
    ramp = 2.0 * torch.arange(9.0) + torch.arange(4.0)[:, None] * 5 + torch.arange(3.0)[:, None, None]
    dead = torch.zeros(3, 4, 9, dtype=torch.bool)
    dead[1, :, 4:6] = True
    dead[2, 1] = True  # a whole row
    broken = torch.where(dead, math.nan, ramp)
    torch.testing.assert_close(bridge(broken, dead, rows=True), ramp)
    edge = torch.where(torch.arange(9) < 2, math.inf, ramp[0])
    torch.testing.assert_close(bridge(edge, torch.arange(9) < 2, rows=True)[:, :2], ramp[0, :, 2:3].expand(-1, 2))
    x = broken.double().requires_grad_()
    (gradient,) = torch.autograd.grad(bridge(x, dead, rows=True).sum(), x)
    assert gradient[dead].abs().max() == 0
    assert float(gradient.sum()) == dead.numel()
    with pytest.raises(ValueError, match="100 % of the readings of view 2 are dead"):
        bridge(ramp, (torch.arange(3) == 2)[:, None, None], rows=True)


def test_lost_columns_rows_and_views_of_linear_data_come_back():
    lines = 1 + 0.1 * torch.arange(9.0)[:, None, None] - 0.2 * torch.arange(5.0)[:, None] + 0.05 * torch.arange(11.0)
    mask = torch.zeros(lines.shape, dtype=torch.bool)
    mask[:, :, 4:6] = mask[3] = mask[:, 2] = True
    broken = torch.where(mask, 1e9, lines)
    torch.testing.assert_close(bridge(broken, mask, rows=True, most=1.0), lines)


def test_at_the_edge_the_other_axis_serves_and_then_the_nearest():
    lines = 1 + 0.1 * torch.arange(9.0)[:, None, None] - 0.2 * torch.arange(5.0)[:, None] + 0.05 * torch.arange(11.0)
    mask = torch.zeros(lines.shape, dtype=torch.bool)
    mask[:, 2, 0] = True  # the rows beside it are alive
    torch.testing.assert_close(bridge(lines.masked_fill(mask, 1e9), mask, rows=True), lines)
    mask[:, :, 0] = mask[0] = True
    full = bridge(lines.masked_fill(mask, 1e9), mask, rows=True, most=1.0)
    torch.testing.assert_close(full[1:, :, 0], lines[1:, :, 1])
    torch.testing.assert_close(full[0, :, 1:], lines[1, :, 1:])
    with pytest.raises(ValueError, match="no live reading is left"):
        bridge(lines, torch.ones_like(mask), rows=True, most=1.0)
