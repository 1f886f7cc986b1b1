"""Exact line integrals of ellipses, ellipsoids and Gaussians, averaged over the detector cells.

The oracle of the projector: nothing here knows of voxels. Chord of a ray ``p + λ d`` (``|d| = 1``)
in an ellipsoid ``|M (x - c)| ≤ 1``: with ``a = M d``, ``b = M (p - c)`` it is ``2 √(max((a·b)² -
|a|² (|b|² - 1), 0)) / |a|²``. Line integral of ``exp(-|M (x - c)|² / 2)``: ``√(2π) / |a| ·
exp(-(|b|² - (a·b)² / |a|²) / 2)``. Sub-rays spread evenly over each cell give the cell average.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchpcct.detector_window import DetectorWindow
from torchpcct.geometry import Geometry, VolumeGrid
from torchpcct.projector.rays import rays_of
from torchpcct.validate import per_axis
from torchpcct.vector_geometry import VectorGeometry

__all__ = ["Ellipsoid", "Gaussian", "line_integrals", "rasterize", "vector_lines"]

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class _Body:
    center: Any
    radii: Any
    angle: float = 0.0
    value: float = 1.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "center", per_axis("center", self.center, len(self.center)))
        object.__setattr__(
            self, "radii", per_axis("radii", self.radii, len(self.center), positive=True)
        )

    @property
    def _frame(self) -> tuple[Floats, Floats]:
        """Centre ``(x, y, z)`` and the matrix M to the unit ball; a 2-D body is a cylinder along
        z."""
        cy, cx = self.center[-2:]
        ry, rx = self.radii[-2:]
        c, s = math.cos(self.angle), math.sin(self.angle)
        flat = len(self.center) == 2
        rows = [
            [c / rx, s / rx, 0.0],
            [-s / ry, c / ry, 0.0],
            [0.0, 0.0, 0.0 if flat else 1.0 / self.radii[0]],
        ]
        return np.array([cx, cy, 0.0 if flat else self.center[0]]), np.array(rows)

    def _chord(self, aa: Floats, ab: Floats, bb: Floats) -> Floats:
        raise NotImplementedError

    def _density(self, square: Floats) -> Floats:
        raise NotImplementedError

    def along(self, point: Floats, direction: Floats) -> Floats:
        """Exact integrals along lines through ``point`` with unit ``direction``, both ``(...,
        3)`` mm (x, y, z)."""
        center, matrix = self._frame
        a = direction @ matrix.T
        b = (point - center) @ matrix.T
        return self.value * self._chord((a * a).sum(-1), (a * b).sum(-1), (b * b).sum(-1))

    def at(self, z: Floats, y: Floats, x: Floats) -> Floats:
        """Values at points, mm; broadcasts."""
        center, matrix = self._frame
        d = (x - center[0], y - center[1], z - center[2])
        square = sum((m[0] * d[0] + m[1] * d[1] + m[2] * d[2]) ** 2 for m in matrix)
        return self.value * self._density(np.asarray(square))


class Ellipsoid(_Body):
    """A uniform ellipse or ellipsoid.

    Args:
        center: ``(y, x)`` or ``(z, y, x)`` mm. A 2-D body in a cone beam is an endless cylinder
            along z.
        radii: semi-axes in the order of ``center``, mm, one number or one per axis.
        angle: rotation about z, rad, counter-clockwise from x to y.
        value: added value inside, mm⁻¹.
    """

    def _chord(self, aa: Floats, ab: Floats, bb: Floats) -> Floats:
        return 2.0 * np.sqrt(np.maximum(ab * ab - aa * (bb - 1.0), 0.0)) / aa

    def _density(self, square: Floats) -> Floats:
        return (square <= 1.0).astype(np.float64)


class Gaussian(_Body):
    """A Gaussian ``value · exp(-|M (x - c)|² / 2)``; ``radii`` are the standard deviations. See
    :class:`Ellipsoid`."""

    def _chord(self, aa: Floats, ab: Floats, bb: Floats) -> Floats:
        return np.sqrt(2.0 * math.pi / aa) * np.exp(-0.5 * (bb - ab * ab / aa))

    def _density(self, square: Floats) -> Floats:
        return np.exp(-0.5 * square)


def _view_lines(
    geometry: Geometry, window: DetectorWindow | None, sub: tuple[int, int], transaxial: bool
) -> Iterator[tuple[Floats, Floats]]:
    """Points and unit directions per view, ``(rows * sub rows, columns * sub columns, 3)``."""
    rays = rays_of(geometry, window)
    columns: Any = geometry.column_positions  # type: ignore[attr-defined]
    pitch: Any = geometry.pitch  # type: ignore[attr-defined]
    pitch = pitch[1] if isinstance(pitch, tuple) else pitch
    offsets = (np.arange(sub[1]) - (sub[1] - 1) / 2) / sub[1]
    heights = (np.arange(rays.rows * sub[0]) + 0.5) / sub[0]
    v = np.zeros(1) if transaxial else rays.row_edge + (rays.first_row + heights) * rays.row_pitch
    sdd = getattr(geometry, "sdd", 1.0)
    for view in range(rays.views):
        first = int(rays.first[view])
        u = (columns[first : first + rays.columns, None] + offsets * pitch).ravel()
        a, b = np.ones_like(u), u
        if getattr(geometry, "detector", "flat") == "curved":
            a, b = np.cos(u / sdd), sdd * np.sin(u / sdd)
        point = np.zeros((v.size, u.size, 3)) + rays.source[view]
        direction = np.zeros_like(point)
        if rays.parallel:
            point[..., :2] += b[:, None] * rays.across[view]
            direction[..., :2] = rays.axial[view]
        else:
            direction[..., :2] = a[:, None] * rays.axial[view] + b[:, None] * rays.across[view]
            direction[..., 2] = v[:, None]
        yield point, direction / np.linalg.norm(direction, axis=-1, keepdims=True)


def line_integrals(
    geometry: Geometry,
    bodies: Sequence[_Body],
    window: DetectorWindow | None = None,
    sub: int | tuple[int, int] = 4,
) -> Floats:
    """Line integrals of ``bodies``, averaged over each cell.

    Args:
        geometry: parallel, fan or cone beam.
        bodies: :class:`Ellipsoid` and :class:`Gaussian`; their values add up.
        window: the part of the detector to compute, or None for all of it.
        sub: sub-rays per cell, one number or (along rows, along columns).

    Returns:
        ``(views, columns)`` or ``(views, rows, columns)`` float64.
    """
    per = (sub, sub) if isinstance(sub, int) else sub
    plane = len(geometry.shape) == 2
    rows = 1 if plane else (window.rows if window is not None else geometry.shape[1])
    columns = geometry.columns if window is None else window.columns
    out = np.empty((geometry.views, rows, columns))
    sub_rows = 1 if plane else per[0]
    for view, (point, direction) in enumerate(
        _view_lines(geometry, window, (sub_rows, per[1]), plane)
    ):
        total = sum(body.along(point, direction) for body in bodies)
        out[view] = np.asarray(total).reshape(rows, sub_rows, columns, per[1]).mean(axis=(1, 3))
    return out[:, 0] if plane else out


def vector_lines(geometry: VectorGeometry, bodies: Sequence[_Body], sub: int = 4) -> Floats:
    """The same along the rays that a scan's vectors describe; ``(views, [rows,] columns)``
    float64."""
    poses, rows = geometry.poses, geometry.rows or 1
    offset = (np.arange(sub) - (sub - 1) / 2) / sub
    columns = ((np.arange(geometry.columns) - (geometry.columns - 1) / 2)[:, None] + offset).ravel()
    heights = (
        np.zeros(1)
        if geometry.rows is None
        else ((np.arange(rows) - (rows - 1) / 2)[:, None] + offset).ravel()
    )
    out = np.empty((geometry.views, heights.size, columns.size))
    for view, (source, centre, u, v) in enumerate(poses):
        cell = centre + columns[:, None] * u + heights[:, None, None] * v
        direction = np.broadcast_to(source, cell.shape) if geometry.parallel else cell - source
        direction = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
        out[view] = sum(body.along(cell, direction) for body in bodies)
    out = out.reshape(geometry.views, rows, -1, geometry.columns, sub).mean((2, 4))
    return out if geometry.rows else out[:, 0]


def rasterize(grid: VolumeGrid, bodies: Sequence[_Body], sub: int = 1) -> Floats:
    """``bodies`` on the grid, averaged over ``sub`` sample points per axis in each voxel,
    float64."""
    fine = VolumeGrid(
        tuple(n * sub for n in grid.shape), tuple(s / sub for s in grid.spacing), grid.center
    )
    y, x = fine.axes[-2:]
    out = np.empty(grid.shape)
    z = fine.axes[0] if grid.ndim == 3 else np.zeros(sub)
    flat = out.reshape(-1, *grid.shape[-2:])
    for k in range(flat.shape[0]):
        total = np.zeros(fine.shape[-2:])
        levels = z[k * sub : (k + 1) * sub] if grid.ndim == 3 else z[:1]
        for level in levels:
            for body in bodies:
                total += body.at(np.asarray(level), y[:, None], x)
        flat[k] = total.reshape(grid.shape[-2], sub, grid.shape[-1], sub).mean(axis=(1, 3)) / len(
            levels
        )
    return out
