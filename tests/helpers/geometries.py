"""A registry of small scans: every geometry, with what can go wrong in each. Contract tests run
over all of them."""

import math

import numpy as np

from torchpcct.detector_window import DetectorWindow, footprint
from torchpcct.geometry import ConeBeam, FanBeam, Geometry, ParallelBeam, VolumeGrid, full_turn

Case = tuple[Geometry, VolumeGrid, DetectorWindow | None]
_PLANE = VolumeGrid((9, 9), 2.0)
# no view on an axis or diagonal: every one has all its mirrored copies
_EVEN = full_turn(24, math.pi / 24)
_VOLUME = VolumeGrid((5, 7, 6), (1.5, 2.0, 2.2), (0.4, 1.0, -2.0))


def _inset(geometry: Geometry, grid: VolumeGrid, margin: int = 0) -> Case:
    return geometry, grid, footprint(geometry, grid, margin)


REGISTRY: dict[str, Case] = {
    "parallel_half_turn": (ParallelBeam(np.arange(8) * math.pi / 8, 15, 1.9), _PLANE, None),
    "parallel_quarter_column_irregular": (
        ParallelBeam([0.1, 2.0, -1.3, 5.0], 13, 1.7, 0.425),
        VolumeGrid((8, 11), (2.0, 1.4), (3.0, -1.0)),
        None,
    ),
    "fan_flat": (FanBeam(full_turn(12), 60.0, 110.0, 21, 2.1), _PLANE, None),
    "fan_flat_offset_shifted_grid": (
        FanBeam(full_turn(7, 0.2), 60.0, 110.0, 20, 2.1, 0.525),
        VolumeGrid((7, 10), (1.9, 1.1), (4.0, 3.0)),
        None,
    ),
    "fan_symmetric_shifted_grid": (
        FanBeam(_EVEN, 60.0, 110.0, 20, 2.1),
        VolumeGrid((9, 9), 2.0, (0.7, -1.3)),
        None,
    ),
    "fan_symmetric_grid_off_by_parts_of_a_voxel": (
        FanBeam(_EVEN, 60.0, 110.0, 20, 2.1),
        VolumeGrid((9, 9), 2.0, (0.3, 0.7)),
        None,
    ),
    "fan_quarter_column_shifted_grid": (
        FanBeam(_EVEN, 60.0, 110.0, 21, 2.1, 0.525),
        VolumeGrid((9, 9), 2.0, (0.5, 1.0)),
        None,
    ),
    "fan_mirrored_views_shifted_grid": (
        FanBeam(_EVEN, 60.0, 110.0, 20, 2.1, detector="curved"),
        VolumeGrid((7, 9), (2.0, 1.5), (1.0, 0.9)),
        None,
    ),
    "parallel_symmetric_shifted_grid": (
        ParallelBeam((np.arange(12) + 0.5) * math.pi / 12, 18, 1.9),
        VolumeGrid((9, 9), 2.0, (0.3, 1.1)),
        None,
    ),
    "fan_curved_short_scan": (
        FanBeam(np.linspace(0, math.pi + 0.5, 9), 60.0, 110.0, 23, 2.0, detector="curved"),
        _PLANE,
        None,
    ),
    "fan_wide": (FanBeam(full_turn(6, 0.05), 30.0, 45.0, 31, 3.0), VolumeGrid((10, 12), 2.5), None),
    "fan_window": _inset(
        FanBeam(full_turn(10), 60.0, 110.0, 40, 1.0, 0.25, "curved"),
        VolumeGrid((6, 5), 0.9, (-6.0, 4.0)),
        1,
    ),
    "fan_voxel_much_smaller": (
        FanBeam(full_turn(5), 60.0, 110.0, 7, 6.0),
        VolumeGrid((20, 20), 0.6),
        None,
    ),
    "fan_voxel_much_larger": (
        FanBeam(full_turn(5, 0.3), 60.0, 110.0, 60, 0.4),
        VolumeGrid((3, 2), 5.0),
        None,
    ),
    "cone_flat": (ConeBeam(full_turn(8), 60.0, 110.0, 14, 9, (1.8, 2.5)), _VOLUME, None),
    "cone_curved_offset": (
        ConeBeam(full_turn(5, 0.7), 60.0, 110.0, 14, 6, (1.7, 2.5), (0.6, -0.625), "curved"),
        _VOLUME,
        None,
    ),
    "cone_window": _inset(
        ConeBeam(full_turn(9), 60.0, 110.0, 60, 12, (0.9, 1.1), detector="curved"),
        VolumeGrid((4, 6, 5), (0.8, 0.9, 1.0), (0.5, -7.0, 5.0)),
    ),
    "cone_wide_fan": (
        ConeBeam(full_turn(4, 0.1), 30.0, 45.0, 25, 7, (3.0, 3.5)),
        VolumeGrid((4, 9, 10), 2.5),
        None,
    ),
    "cone_one_of_each": (
        ConeBeam([0.4], 60.0, 110.0, 1, 1, 30.0),
        VolumeGrid((1, 1, 1), 3.0),
        None,
    ),
    "fan_one_of_each": (FanBeam([0.0], 60.0, 110.0, 1, 1.0), VolumeGrid((1, 1), 3.0), None),
}
