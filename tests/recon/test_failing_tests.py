"""A test of a finished volume that fails becomes a warning: it must never lose the work."""

import math

import numpy as np
import pytest
import torch

import recon.api
from recon import reconstruct
from recon.least_squares.field_problem import FieldProblem
from torchpcct import FanBeam, ParallelBeam, Scan, VolumeGrid, full_turn

GEOMETRY = ParallelBeam(np.arange(40) * math.pi / 40, 30, 1.0)
GRID = VolumeGrid((24, 24), 1.0)


def scan(geometry=GEOMETRY):
    lines = 0.04 * np.sqrt(np.clip(9.0**2 - geometry.column_positions**2, 0, None))
    counts = np.random.default_rng(0).poisson(1e4 * np.exp(-np.tile(lines, (geometry.views, 1))))
    return Scan.from_counts(counts.astype("f4"), geometry, air=1e4, mu_water=0.02)


def fails(*_, **__):
    raise OverflowError("too large")


@pytest.mark.parametrize("method", ["pwls", "mbir"])
def test_the_residual_test_of_a_field(method, monkeypatch):
    whole = reconstruct(scan(), GRID, method)
    monkeypatch.setattr(FieldProblem, "residual_test", fails)
    volume = reconstruct(scan(), GRID, method)
    assert torch.equal(volume.data, whole.data)
    assert [w for w in volume.report["warnings"] if "failed (OverflowError: too large)" in w]
    assert "residual_p" not in volume.report


@pytest.mark.parametrize("name", ["consistency_warnings", "metal_warnings"])
def test_what_is_asked_of_every_volume(name, monkeypatch):
    monkeypatch.setattr(recon.api, name, fails)
    volume = reconstruct(scan(), GRID)
    assert torch.isfinite(volume.data).all()
    assert [w for w in volume.report["warnings"] if "failed (OverflowError: too large)" in w]


def test_one_row_of_a_fan():
    """Its rows' test has one degree of freedom, which a converged volume fits to rounding."""
    volume = reconstruct(scan(FanBeam(full_turn(40), 60.0, 100.0, 40, 1.2)), GRID, "pwls")
    assert 0.0 <= volume.report["residual_p"]["rows"] <= 1.0
