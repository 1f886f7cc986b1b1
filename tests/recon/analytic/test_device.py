"""Filtered backprojection where the data lie: torch and Triton's kernels (run by its interpreter)
against those of the CPU."""

import numpy as np
import pytest
import torch

from recon.analytic import backproject_triton as kernels
from recon.analytic.backproject import BackprojectionPlan
from recon.analytic.filter_plan import FilterPlan
from torchpcct.detector_window import DetectorWindow, footprint
from torchpcct.geometry import ConeBeam, FanBeam, ParallelBeam, VolumeGrid

_ANGLES = (0.1, 0.9, 2.0, 4.4)
_PLANE = VolumeGrid((5, 6), (2.0, 1.7), (1.0, -0.5))
_INSET = VolumeGrid((3, 4), (0.5, 0.4), (6.0, -9.0))
_VOLUME = VolumeGrid((3, 4, 5), (1.5, 2.0, 2.2), (0.4, 1.0, -1.0))
_SWAY = np.array([[0.3, -0.2, 0.5], [0.0, 0.4, 0.1], [-0.5, 0.2, 0.0], [0.1, 0.0, 0.3]])
CASES = {
    "parallel": (ParallelBeam(_ANGLES, 15, 1.7, 0.4), _PLANE, None),
    "fan": (FanBeam(_ANGLES, 30.0, 60.0, 16, 3.0, 0.5), _PLANE, None),
    "fan, a column": (FanBeam(_ANGLES, 30.0, 60.0, 1, 60.0), _PLANE, None),
    "curved inset": (FanBeam(_ANGLES, 60.0, 110.0, 40, 1.5, detector="curved"), _INSET, None),
    "cone": (ConeBeam(_ANGLES, 60.0, 110.0, 14, 4, (2.5, 2.5), (0.6, -0.6)), _VOLUME, None),
    "curved, moving": (
        ConeBeam(_ANGLES, 60.0, 110.0, 18, 6, (1.7, 2.0), detector="curved"),
        _VOLUME,
        _SWAY,
    ),
    "cone, a row": (ConeBeam(_ANGLES, 60.0, 110.0, 14, 1, (9.0, 2.5)), _VOLUME, None),
}


def _window(geometry, grid, motion):
    try:
        return footprint(geometry, grid, margin=1, motion=motion)
    except ValueError:
        return DetectorWindow.full(geometry)


def _plan(name, windowed):
    geometry, grid, motion = CASES[name]
    window = _window(geometry, grid, motion) if windowed else DetectorWindow.full(geometry)
    return BackprojectionPlan(geometry, grid, window, motion)


def _data(plan, batch=2, dtype=torch.float64):
    w = plan.window
    shape = (w.views, w.rows, w.columns) if plan.cone else (w.views, w.columns)
    return torch.randn((batch, *shape), generator=torch.Generator().manual_seed(0), dtype=dtype)


@pytest.mark.parametrize("lanes", [4, 128])
@pytest.mark.parametrize("name", sorted(CASES))
def test_backprojection_is_that_of_the_cpu(name, lanes, monkeypatch):
    monkeypatch.setattr(kernels, "LANES", lanes)
    plan = _plan(name, windowed=lanes == 4)
    data = _data(plan)
    expect = plan.forward(data)
    assert expect.abs().max() > 0.1
    torch.testing.assert_close(plan._forward_there(data), expect, rtol=1e-10, atol=1e-9)
    single = plan._forward_there(data.float()).double()
    assert (single - expect).norm() < 2e-6 * expect.norm()


@pytest.mark.parametrize("name", sorted(CASES))
def test_the_transpose_is_that_of_the_same_weights(name):
    plan = _plan(name, windowed=True)
    data = _data(plan)
    volume = torch.randn(
        plan.forward(data).shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )
    torch.testing.assert_close(
        plan._transpose_there(volume), plan.transpose(volume), rtol=1e-9, atol=1e-9
    )
    left = (plan._forward_there(data) * volume).sum()
    torch.testing.assert_close(
        (data * plan._transpose_there(volume)).sum(), left, rtol=1e-9, atol=0
    )


@pytest.mark.parametrize("name", ["fan", "curved inset", "cone"])
@pytest.mark.parametrize("by_matrix", [True, False])
def test_the_filter_is_that_of_the_cpu(name, by_matrix, monkeypatch):
    monkeypatch.setattr(FilterPlan, "chunk", 3)
    geometry, grid, motion = CASES[name]
    part = _window(geometry, grid, motion)
    angular = np.linspace(0.5, 1.0, geometry.views * geometry.columns).reshape(geometry.views, -1)
    plan = FilterPlan(geometry, ("soft", "bone"), angular, DetectorWindow.full(geometry), part)
    object.__setattr__(plan, "by_matrix", by_matrix)
    w = plan.window_in
    data = torch.randn(
        (2, w.views, w.rows, w.columns),
        generator=torch.Generator().manual_seed(0),
        dtype=torch.float64,
    )
    there = plan._forward_there(data)
    torch.testing.assert_close(there, plan.forward(data), rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(
        plan._transpose_there(there), plan.transpose(there), rtol=1e-10, atol=1e-12
    )
