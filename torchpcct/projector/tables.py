"""What one geometry, grid and window come to, computed once for all passes: rays, slabs, depth
layers."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from torchpcct.detector_window import DetectorWindow
from torchpcct.geometry import Geometry, VolumeGrid, beam
from torchpcct.projector.rays import (
    Segments,
    check_pair,
    check_source,
    rays_of,
    slab_lattice,
    split,
)
from torchpcct.vector_geometry import VectorGeometry, split_motion

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from torchpcct.typing import Floats


LAYER_SHIFT = 0.04
"""Row edges may move by this part of the blur between two depth layers (see layer_spacing)."""
MAX_LAYERS_PER_SLAB = 0.4
"""Slabs farther apart than this part of a layer are interpolated one by one (see
layer_spacing)."""
NEAREST = 1e-6
"""Slabs closer to the source than this part of the way to the detector are behind it."""
POINT = 1e-9
"""A rectangle narrower than this part of a voxel is a point."""
MOST_PARTS = 256
"""Of a cell that is cut into parts, along either step of the detector."""
LEAST_SLOPE = 0.2
"""A cell is cut where the mixed second moment of its footprint is above this fraction of the
geometric mean of the other two, and above :data:`LEAST_SLANT`: a rectangle along the axes will do
for others."""
LEAST_SLANT = 0.1
"""The same, as a fraction of a voxel's."""


class Tables:
    """Tables of one scan.

    Args:
        geometry, grid, window, motion: as for ``Projector``.

    Raises:
        TypeError, ValueError: see ``rays.check_pair``, ``rays.check_source`` and ``Projector``.
    """

    def __init__(
        self,
        geometry: Geometry,
        grid: VolumeGrid,
        window: DetectorWindow | None = None,
        motion: ArrayLike | None = None,
    ) -> None:
        check_pair(geometry, grid, window)
        # Symmetric views share their work only if all of the detector is read and nothing moves.
        self.geometry, self.grid, self.windowed = (
            geometry,
            grid,
            window is not None or motion is not None,
        )
        self.rays = rays_of(geometry, window)
        if motion is not None:
            shift, turn = split_motion(motion, geometry.views, grid.ndim)
            if turn is not None:  # a grid that turns is seen from elsewhere, displaced the same way
                c, s = np.cos(turn), np.sin(turn)
                y, x = shift[:, -2].copy(), shift[:, -1].copy()
                shift[:, -2], shift[:, -1] = c * y - s * x, c * x + s * y
                seen = replace(beam(geometry), angles=geometry.angles - turn)
                self.rays = rays_of(seen, window)
            self.rays = self.rays.moved(shift)
        if not self.rays.parallel:
            # in the plane, whatever the source's height
            check_source(self.rays.source[:, 1::-1], grid.slice)
        self.lattice = slab_lattice(grid.center[-2:], grid.shape[-2:], grid.spacing[-2:])

    @property
    def domain_shape(self) -> tuple[int, ...]:
        return tuple(self.grid.shape)

    @property
    def range_shape(self) -> tuple[int, ...]:
        r = self.rays
        return (r.views, r.rows, r.columns) if self.grid.ndim == 3 else (r.views, r.columns)

    @cached_property
    def segments(self) -> Segments:
        return split(self.rays, self.grid)

    @cached_property
    def pose(self) -> NDArray[np.float64]:
        """``(views, 8)``, see :attr:`torchpcct.projector.rays.Rays.pose`."""
        return self.rays.pose

    @cached_property
    def heights(self) -> tuple[float, float, float, float]:
        """Lower edge of the grid along z, its pitch, lower edge of the first row kept, row
        pitch, mm (cone beam)."""
        z, dz = self.grid.axes[0][0], self.grid.spacing[0]
        return (
            z - dz / 2,
            dz,
            self.rays.row_edge + self.rays.first_row * self.rays.row_pitch,
            self.rays.row_pitch,
        )

    @cached_property
    def layer(self) -> float:
        """Spacing of the depth layers (cone beam), see :func:`layer_spacing`."""
        # Of all rows, whichever the window keeps: a reading must not depend on what else is read.
        rows = self.geometry.shape[1]
        return layer_spacing(self.pose, self.grid, self.rays.row_edge, self.rays.row_pitch, rows)


def along_xyz(grid: VolumeGrid) -> tuple[NDArray[np.int64], Floats, Floats]:
    """Voxels, spacing and centre in mm of a grid along x, y and z; a plane is one slice of 1 mm."""
    spacing, center = (
        np.array([*v[::-1], w])[:3] for v, w in ((grid.spacing, 1.0), (grid.center, 0.0))
    )
    return np.array([*grid.shape[::-1], 1], dtype=np.int64)[:3], spacing, center


class VectorTables:
    """The same of a scan given by vectors that no circular scan describes; its passes need no
    tables.

    Args:
        geometry, grid: as for ``Projector``.

    Raises:
        TypeError: an argument of the wrong kind.
        ValueError: a grid of other axes than the detector needs, a source inside the grid.
    """

    def __init__(self, geometry: VectorGeometry, grid: VolumeGrid) -> None:
        if not isinstance(grid, VolumeGrid):
            raise TypeError(f"grid must be a VolumeGrid, got {type(grid).__name__}")
        axes = 2 if geometry.rows is None else 3
        if grid.ndim != axes:
            raise ValueError(
                f"vectors of {len(geometry.vectors[0])} numbers need a {axes}-D grid, got "
                f"{grid.shape}"
            )
        self.geometry, self.grid = geometry, grid
        if not geometry.parallel:
            check_source(geometry.poses[:, 0, :axes][:, ::-1], grid)

    @property
    def domain_shape(self) -> tuple[int, ...]:
        return tuple(self.grid.shape)

    @property
    def range_shape(self) -> tuple[int, ...]:
        return self.geometry.shape


def layer_spacing(
    pose: NDArray[np.float64], grid: VolumeGrid, row0: float, row_pitch: float, rows: int
) -> float:
    """Spacing of depth layers in the ray parameter λ; layers replace slabs where slabs are closer
    than this.

    The heights of the row edges grow with λ, so each slab needs its own interpolation along z.
    Where the magnification changes little (a small grid), slabs are instead shared linearly between
    two layers, and only layers are interpolated. Between two layers the row edges move by at most
    ``LAYER_SHIFT`` of the blur that the voxel and the row have anyway; the error is of second order
    in it.
    """
    z, hz = grid.axes[0], grid.spacing[0]
    reach = max(abs(z[0] - hz / 2 - pose[:, 2]).max(), abs(z[-1] + hz / 2 - pose[:, 2]).max())
    ends = np.array([row0, row0 + rows * row_pitch])
    rise = np.abs(ends + (pose[:, 7] - pose[:, 2])[:, None]).max()
    # Depths of the grid's corners and centre in every view; rows are finest, and moves largest, at
    # the nearest.
    x, y = (grid.center[i] + grid.extent[i] / 2 * np.array([-1, -1, 1, 1, 0]) for i in (2, 1))
    y[:4] = y[[0, 2, 0, 2]]
    offset = np.stack([x, y], axis=-1) - pose[:, None, :2]
    depth = (offset * pose[:, None, 3:5]).sum(axis=-1) / (pose[:, None, 3:5] ** 2).sum(axis=-1)
    near = depth.min()
    if near <= 0:
        return 1e-6  # of λ: slabs one by one
    depth = depth[:, 4].min()
    blur = math.hypot(hz, depth * row_pitch)
    return float(min(LAYER_SHIFT * blur / max(min(rise, reach / depth), 1e-12 * blur), near / 4))
