"""The paper's plaque on a vessel of any direction: tilted, in plane, curved, bifurcating.

The analytic scenes know vessels along z only. Here a point of space is taken to the vessel's own
coordinates (across towards the plaque, across, along the centreline) and there asked which tissue
of the straight plaque it lies in. So all vessels have the same sections. The plaque sits across the
plane of a bend, where bending neither stretches nor squeezes it on average: every tissue keeps its
volume exactly (Pappus), as its sections are symmetric about that plane.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchpcct.geometry import VolumeGrid
from torchpcct.scene import Scene
from torchpcct.scene.plaque import Plaque, plaque_scene

Floats = NDArray[np.float64]

LENGTH_MM = 8.0
"""Of every vessel, along its centreline: in any direction it ends inside of the inset, 9 mm
wide."""

_PLAQUE = Plaque(position=(0.0, 0.0, 0.0), vessel_length=LENGTH_MM)
"""Plaque of every vessel."""


@dataclass(frozen=True)
class VesselAxis:
    """A straight line or a circle's arc through the origin.

    Args:
        tangent: ``(x, y, z)`` unit vector along the vessel at the origin.
        side: unit vector across, towards the plaque.
        radius: of the arc in mm, which bends towards ``tangent × side``; ``inf`` for a line.

    Raises:
        ValueError: vectors that are not of unit length and perpendicular, a radius that is not
            positive.
    """

    tangent: tuple[float, float, float]
    side: tuple[float, float, float]
    radius: float = math.inf

    def __post_init__(self) -> None:
        frame = np.stack([self.side, self.tangent])
        if not np.allclose(frame @ frame.T, np.eye(2)):
            raise ValueError(
                f"tangent and side must be perpendicular unit vectors, got {self.tangent}, "
                f"{self.side}"
            )
        if not self.radius > 0:
            raise ValueError(f"radius must be positive, got {self.radius} mm")

    def local(self, points: ArrayLike) -> Floats:
        """``(..., 3)`` x, y, z in mm → towards the plaque, across, along the centreline, mm."""
        p = np.asarray(points, dtype=np.float64)
        towards, across, along = (p @ np.asarray(v, np.float64) for v in self.axes)
        if math.isinf(self.radius):
            return np.stack([towards, across, along], axis=-1)
        left = self.radius - across
        return np.stack(
            [towards, self.radius - np.hypot(along, left), self.radius * np.arctan2(along, left)],
            axis=-1,
        )

    def point(self, local: ArrayLike) -> Floats:
        """The inverse of :meth:`local`."""
        towards, across, along = np.moveaxis(np.asarray(local, dtype=np.float64), -1, 0)
        if not math.isinf(self.radius):
            angle, distance = along / self.radius, self.radius - across
            across, along = self.radius - distance * np.cos(angle), distance * np.sin(angle)
        result: Floats = np.stack([towards, across, along], axis=-1) @ np.asarray(
            self.axes, np.float64
        )
        return result

    @property
    def axes(self) -> tuple[tuple[float, float, float], Floats, tuple[float, float, float]]:
        """Unit vectors at the origin: towards the plaque, across, along."""
        return self.side, np.cross(self.tangent, self.side), self.tangent


@dataclass(frozen=True)
class Branch:
    """A healthy side branch, away from the plaque; lengths in mm.

    Args:
        angle: to the vessel, rad.
        diameter: outer; its wall is as thick as the vessel's.
        length: from the vessel's lumen to its flat end.
    """

    angle: float = math.pi / 4
    diameter: float = 2.24
    length: float = 4.5


@dataclass(frozen=True)
class PaintedVessel:
    """The plaque on a centreline.

    Args:
        line: the vessel's, in a frame about ``center``.
        center: ``(z, y, x)`` mm of the vessel's axis in the middle of the plaque.
        branch: None for none.
        plaque: its geometry, in the vessel's own coordinates.
    """

    line: VesselAxis
    center: tuple[float, float, float]
    branch: Branch | None = None
    plaque: Plaque = _PLAQUE

    @cached_property
    def straight(self) -> Scene:
        """The plaque in the vessel's own coordinates."""
        return plaque_scene(self.plaque)[0]

    def local(self, points: Floats) -> Floats:
        """Points ``(..., 3)`` of the scanner's frame in the vessel's coordinates, mm."""
        return self.line.local(points - np.array(self.center[::-1]))

    def labels(self, points: Floats) -> NDArray[np.int64]:
        """Index of the tissue in :attr:`straight` at points ``(..., 3)`` x, y, z in mm."""
        local = self.local(points)
        labels = self.straight.labels(local)
        if self.branch is not None:
            index, b = self.straight.index, self.branch
            along = np.array([-math.sin(b.angle), 0.0, math.cos(b.angle)])
            start = np.array([float(self.plaque.section("lumen", 0.0)[0]), 0.0, 0.0])
            depth = (local - start) @ along
            off = np.linalg.norm(local - start - depth[..., None] * along, axis=-1)
            within = (depth >= 0) & (depth <= b.length)
            labels[within & (off <= b.diameter / 2) & (labels == index("patient"))] = index("wall")
            blood = within & (off <= b.diameter / 2 - self.plaque.wall_thickness)
            labels[blood & (labels != index("core"))] = index("lumen")
        return labels

    def volume_fractions(self, grid: VolumeGrid) -> dict[str, Floats]:
        """Tissue of :attr:`straight` → its share of each voxel ``grid.shape``, to about 0.001 rms.

        See :func:`torchpcct.scene.raster.label_fractions`.
        """
        from torchpcct.scene.raster import label_fractions  # its kernels need numba, a slow import

        names = self.straight.names
        return dict(zip(names, label_fractions(self.labels, len(names), grid), strict=True))

    def painted(self, grid: VolumeGrid, values: Mapping[str, float]) -> Floats:
        """Mean over each voxel ``grid.shape`` of ``values`` of the tissues; of other tissues 0."""
        volume_fractions = self.volume_fractions(grid)
        result: Floats = np.tensordot(
            [values.get(n, 0.0) for n in volume_fractions], list(volume_fractions.values()), axes=1
        )
        return result


_X = (1.0, 0.0, 0.0)
"""Unit vector."""
_Y = (0.0, 1.0, 0.0)
"""Unit vector."""
_Z = (0.0, 0.0, 1.0)
"""Unit vector."""
_HALF = math.sqrt(0.5)
"""Both components of a unit vector at 45°."""

SHAPES: dict[str, tuple[VesselAxis, Branch | None]] = {
    "straight": (VesselAxis(_Z, _X), None),
    "tilted": (VesselAxis((0.0, _HALF, _HALF), _X), None),
    "in_plane_x": (VesselAxis(_X, (0.0, -1.0, 0.0)), None),
    "in_plane_y": (VesselAxis(_Y, _X), None),
    "curved_8mm": (VesselAxis(_Z, _X, 8.0), None),
    "curved_5mm": (VesselAxis(_Z, _X, 5.0), None),
    "bifurcating": (VesselAxis(_Z, _X), Branch()),
}
"""Centreline and side branch of every vessel; ``in_plane_x`` is ``in_plane_y`` turned by a right
angle about z."""
