"""A registry of small scans: every geometry, with what can go wrong in each. Contract tests run over all of them."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from torchpcct.detector_window import DetectorWindow, footprint
from torchpcct.geometry import ConeBeam, FanBeam, Geometry, ParallelBeam, VolumeGrid, full_turn

Case = tuple[Geometry, VolumeGrid, DetectorWindow | None]
REGISTRY: dict[str, Callable[[], Case]] = {}


def _case(make: Callable[[], Case]) -> Callable[[], Case]:
    REGISTRY[make.__name__] = make
    return make


_PLANE = VolumeGrid((9, 9), 2.0)
_EVEN = full_turn(24, math.pi / 24)  # no view on an axis or diagonal: every one has all its mirrored copies
_VOLUME = VolumeGrid((5, 7, 6), (1.5, 2.0, 2.2), (0.4, 1.0, -2.0))


@_case
def parallel_half_turn() -> Case:
    return ParallelBeam(np.arange(8) * math.pi / 8, 15, 1.9), _PLANE, None


@_case
def parallel_quarter_column_irregular() -> Case:
    return ParallelBeam([0.1, 2.0, -1.3, 5.0], 13, 1.7, 0.425), VolumeGrid((8, 11), (2.0, 1.4), (3.0, -1.0)), None


@_case
def fan_flat() -> Case:
    return FanBeam(full_turn(12), 60.0, 110.0, 21, 2.1), _PLANE, None


@_case
def fan_flat_offset_shifted_grid() -> Case:
    return FanBeam(full_turn(7, 0.2), 60.0, 110.0, 20, 2.1, 0.525), VolumeGrid((7, 10), (1.9, 1.1), (4.0, 3.0)), None


@_case
def fan_symmetric_shifted_grid() -> Case:
    return FanBeam(_EVEN, 60.0, 110.0, 20, 2.1), VolumeGrid((9, 9), 2.0, (0.7, -1.3)), None


@_case
def fan_symmetric_grid_off_by_parts_of_a_voxel() -> Case:
    return FanBeam(_EVEN, 60.0, 110.0, 20, 2.1), VolumeGrid((9, 9), 2.0, (0.3, 0.7)), None


@_case
def fan_quarter_column_shifted_grid() -> Case:
    return FanBeam(_EVEN, 60.0, 110.0, 21, 2.1, 0.525), VolumeGrid((9, 9), 2.0, (0.5, 1.0)), None


@_case
def fan_mirrored_views_shifted_grid() -> Case:
    geometry = FanBeam(_EVEN, 60.0, 110.0, 20, 2.1, detector="curved")
    return geometry, VolumeGrid((7, 9), (2.0, 1.5), (1.0, 0.9)), None


@_case
def parallel_symmetric_shifted_grid() -> Case:
    return ParallelBeam((np.arange(12) + 0.5) * math.pi / 12, 18, 1.9), VolumeGrid((9, 9), 2.0, (0.3, 1.1)), None


@_case
def fan_curved_short_scan() -> Case:
    geometry = FanBeam(np.linspace(0, math.pi + 0.5, 9), 60.0, 110.0, 23, 2.0, detector="curved")
    return geometry, _PLANE, None


@_case
def fan_wide() -> Case:
    return FanBeam(full_turn(6, 0.05), 30.0, 45.0, 31, 3.0), VolumeGrid((10, 12), 2.5), None


@_case
def fan_window() -> Case:
    geometry = FanBeam(full_turn(10), 60.0, 110.0, 40, 1.0, 0.25, "curved")
    grid = VolumeGrid((6, 5), 0.9, (-6.0, 4.0))
    return geometry, grid, footprint(geometry, grid, 1)


@_case
def fan_voxel_much_smaller() -> Case:
    return FanBeam(full_turn(5), 60.0, 110.0, 7, 6.0), VolumeGrid((20, 20), 0.6), None


@_case
def fan_voxel_much_larger() -> Case:
    return FanBeam(full_turn(5, 0.3), 60.0, 110.0, 60, 0.4), VolumeGrid((3, 2), 5.0), None


@_case
def cone_flat() -> Case:
    return ConeBeam(full_turn(8), 60.0, 110.0, 14, 9, (1.8, 2.5)), _VOLUME, None


@_case
def cone_curved_offset() -> Case:
    geometry = ConeBeam(full_turn(5, 0.7), 60.0, 110.0, 14, 6, (1.7, 2.5), (0.6, -0.625), "curved")
    return geometry, _VOLUME, None


@_case
def cone_window() -> Case:
    geometry = ConeBeam(full_turn(9), 60.0, 110.0, 60, 12, (0.9, 1.1), detector="curved")
    grid = VolumeGrid((4, 6, 5), (0.8, 0.9, 1.0), (0.5, -7.0, 5.0))
    return geometry, grid, footprint(geometry, grid)


@_case
def cone_wide_fan() -> Case:
    return ConeBeam(full_turn(4, 0.1), 30.0, 45.0, 25, 7, (3.0, 3.5)), VolumeGrid((4, 9, 10), 2.5), None


@_case
def cone_one_of_each() -> Case:
    return ConeBeam([0.4], 60.0, 110.0, 1, 1, 30.0), VolumeGrid((1, 1, 1), 3.0), None


@_case
def fan_one_of_each() -> Case:
    return FanBeam([0.0], 60.0, 110.0, 1, 1.0), VolumeGrid((1, 1), 3.0), None
