"""Detectors and grids of next to nothing: reconstructed, or refused in words."""

import logging
import math

import numpy as np
import pytest
import torch

from recon import reconstruct
from torchpcct import ConeBeam, FanBeam, ParallelBeam, Scan, VolumeGrid, full_turn


def geometries(columns):
    turn = full_turn(24)
    yield ParallelBeam(np.arange(24) * math.pi / 24, columns, 1.0), VolumeGrid((3, 3), 1.0)
    yield FanBeam(turn, 50.0, 80.0, columns, 1.6, 0.3), VolumeGrid((3, 3), 1.0)
    yield ConeBeam(turn, 50.0, 80.0, columns, 1, 1.6), VolumeGrid((1, 3, 3), 1.0)
    yield (
        ConeBeam(turn, 50.0, 80.0, columns, 2, 1.6, (0.0, 0.3), "curved"),
        VolumeGrid((2, 1, 1), 1.0),
    )
    yield FanBeam([0.3], 50.0, 80.0, columns, 1.6), VolumeGrid((1, 1), 1.0)


@pytest.mark.parametrize("columns", [1, 2, 3, 4])
@pytest.mark.parametrize("method", ["fbp", "pwls"])
def test_detectors_of_few_columns(columns, method, caplog):
    caplog.set_level(logging.CRITICAL)
    for geometry, grid in geometries(columns):
        counts = np.random.default_rng(0).poisson(9e3, geometry.shape).astype("f4")
        try:
            volume = reconstruct(
                Scan.from_counts(counts, geometry, air=1e4, mu_water=0.02), grid, method
            )
        except ValueError as error:
            assert len(str(error)) > 40  # noqa: PT017 (some are refused, some not)
        else:
            assert torch.isfinite(volume.data).all()


def test_a_single_column_has_a_field_of_view():
    """Of its width: once it had none."""
    assert FanBeam(full_turn(8), 50.0, 80.0, 1, 1.6).fov_radius == pytest.approx(0.5, rel=1e-3)
