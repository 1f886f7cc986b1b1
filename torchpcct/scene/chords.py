"""Exact intersections of rays with the analytic shapes, as numba kernels that other kernels can call.

``pack`` turns shapes into two arrays; :func:`interval` finds where one ray is inside one packed shape. All in float64:
away from grazing incidence the end points are exact to about 1e-11 mm for sources a metre away.

Quadrics and boxes are met at most once. The tubes of :mod:`torchpcct.scene.tubes` are not convex:

* a ray of small slope (``|dz|`` below the limit that ``pack`` derives from the tube's profile, 0.12 for a plaque: every
  ray of a circular scan) sees a section that changes so slowly that the curve it draws in the section's own
  coordinates is flatter than their unit circle. Then the implicit function is convex along the ray, there are at
  most two crossings, and Newton's iteration from the section at the closest approach finds both;
* a steeper ray may leave the tube at a flank of the bulge and enter it again. It is searched piece by piece for all
  crossings; the interval returned starts at the first entry and has the exact TOTAL length inside.

Callers that compile against these functions with numba's ``cache=True`` must clear their cache when this file changes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchpcct.scene import _tube_rays
from torchpcct.scene.bodies import Box, Ellipsoid, EllipticCylinder, Shape
from torchpcct.scene.tubes import BulgedTube, NarrowedTube

__all__ = ["PARAMETERS", "chord_lengths", "interval", "pack"]

ELLIPSOID, CYLINDER, BOX, BULGED, NARROWED = range(5)
# Row of ``params``: 0-2 centre of the bounding z cylinder, 3 its radius squared, 4 radius, 5 half height; 6-8 position;
# 9-17 matrix from scanner to local axes (scaled to the unit shape for ellipsoid, cylinder section and box);
# 18 half length; 19-23 tubes: radius, amplitude, 2 π / bulge length, bulge length / 2, largest slope of the fast path.
PARAMETERS = 24

# Contraction to FMA is safe; reassociation would undo the cancellation-free order of the operations below.
_FAST = {"contract", "arcp", "nsz"}
# The bounding cylinder is a little wider than the shape, so that rounding never rejects a ray that grazes it.
_SLACK = 1.0 + 1e-9


def _bounding_radius(shape: Shape) -> float:
    if isinstance(shape, Ellipsoid):
        form = (shape.matrix * np.array(shape.semi_axes) ** 2) @ shape.matrix.T
        return math.sqrt(float(np.linalg.eigvalsh(form[:2, :2])[-1]))
    if shape._upright and isinstance(shape, EllipticCylinder):
        return max(shape.semi_axes)
    if shape._upright and isinstance(shape, Box):
        return math.hypot(shape.half_lengths[0], shape.half_lengths[1])
    if shape._upright and isinstance(shape, BulgedTube):
        return shape.radius + shape.amplitude
    if shape._upright and isinstance(shape, NarrowedTube):
        return shape.radius
    low, high = shape.bounding_box
    return math.hypot(*((high - low)[:2] / 2.0))


def pack(shapes: Sequence[Shape]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Shapes as the arrays that the kernels read.

    Args:
        shapes: ``B`` shapes of this package.

    Returns:
        kinds ``(B,)`` int64 and params ``(B, PARAMETERS)`` float64, both C-contiguous.

    Raises:
        TypeError: an object that is none of the package's shapes.
    """
    kinds = np.zeros(len(shapes), dtype=np.int64)
    params = np.zeros((len(shapes), PARAMETERS), dtype=np.float64)
    for b, shape in enumerate(shapes):
        if not isinstance(shape, Shape):
            raise TypeError(f"shapes[{b}] must be a shape of torchpcct.scene, got {type(shape).__name__}")
        row = params[b]
        low, high = shape.bounding_box
        finite = np.isfinite(low) & np.isfinite(high)
        with np.errstate(invalid="ignore"):
            row[0:3] = np.where(finite, (low + high) / 2.0, np.array(shape.position))
        radius = _bounding_radius(shape) * _SLACK
        row[3], row[4], row[5] = radius * radius, radius, (high[2] - low[2]) / 2.0 * _SLACK
        row[6:9] = shape.position
        scale = np.ones(3)
        if isinstance(shape, Ellipsoid):
            kinds[b], scale = ELLIPSOID, np.array(shape.semi_axes)
        elif isinstance(shape, EllipticCylinder):
            kinds[b], scale = CYLINDER, np.array([*shape.semi_axes, 1.0])
            row[18] = shape.half_length
        elif isinstance(shape, Box):
            kinds[b], scale = BOX, np.array(shape.half_lengths)
        elif isinstance(shape, BulgedTube | NarrowedTube):
            kinds[b] = BULGED if isinstance(shape, BulgedTube) else NARROWED
            row[18] = shape.half_length
            row[19], row[20] = shape.radius, shape.amplitude
            row[21], row[22] = 2.0 * math.pi / shape.bulge_length, shape.bulge_length / 2.0
            row[23] = _tube_rays.slope_limit(shape)
        else:
            raise TypeError(f"shapes[{b}]: no chord kernel for {type(shape).__name__}")
        row[9:18] = (shape.matrix.T / scale[:, None]).ravel()
    return kinds, params


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def _ellipsoid(lx: float, ly: float, lz: float, ux: float, uy: float, uz: float) -> Any:
    a = ux * ux + uy * uy + uz * uz
    # Measured from the point of closest approach: no difference of large numbers for a far source.
    t = -(lx * ux + ly * uy + lz * uz) / a
    x, y, z = lx + t * ux, ly + t * uy, lz + t * uz
    rest = 1.0 - (x * x + y * y + z * z)
    if rest <= 0.0:
        return 0.0, 0.0
    half = math.sqrt(rest / a)
    return t - half, t + half


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def _box(lx: float, ly: float, lz: float, ux: float, uy: float, uz: float) -> Any:
    t0, t1 = -math.inf, math.inf
    for axis in range(3):
        p = lx if axis == 0 else (ly if axis == 1 else lz)
        u = ux if axis == 0 else (uy if axis == 1 else uz)
        if u == 0.0:
            if abs(p) >= 1.0:
                return 0.0, 0.0
        else:
            near, far = (-1.0 - p) / u, (1.0 - p) / u
            if near > far:
                near, far = far, near
            # Written so that a NaN replaces the bound instead of being skipped.
            t0 = t0 if t0 >= near else near
            t1 = t1 if t1 <= far else far
    return t0, t1


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def interval(
    kind: int, row: NDArray[np.float64], ox: float, oy: float, oz: float, dx: float, dy: float, dz: float
) -> Any:
    """Where the straight line ``o + t d`` is inside one packed shape.

    Args:
        kind, row: one element of each of the arrays of :func:`pack` (``kinds[b]``, ``params[b]``).
        ox, oy, oz: a point of the line, usually the source, in mm. Subtract a body's displacement from it.
        dx, dy, dz: unit direction.

    Returns:
        ``(t0, t1)`` in mm along the line, not clipped to ``t > 0``; ``t1 <= t0`` where the line misses the shape.
        A line inside an endless shape and parallel to it gives ``(-inf, inf)``.
    """
    qx, qy = row[0] - ox, row[1] - oy
    cross = qx * dy - qy * dx
    p2 = dx * dx + dy * dy
    if cross * cross > row[3] * p2:
        return 0.0, 0.0
    if abs((oz - row[2]) * p2 + (qx * dx + qy * dy) * dz) > row[5] * p2 + row[4] * abs(dz):
        return 0.0, 0.0
    x, y, z = ox - row[6], oy - row[7], oz - row[8]
    lx = row[9] * x + row[10] * y + row[11] * z
    ly = row[12] * x + row[13] * y + row[14] * z
    lz = row[15] * x + row[16] * y + row[17] * z
    ux = row[9] * dx + row[10] * dy + row[11] * dz
    uy = row[12] * dx + row[13] * dy + row[14] * dz
    uz = row[15] * dx + row[16] * dy + row[17] * dz
    if kind == ELLIPSOID:
        return _ellipsoid(lx, ly, lz, ux, uy, uz)
    if kind == CYLINDER:
        t0, t1 = _tube_rays.unit_circle(lx, ly, ux, uy)
        if t1 <= t0:
            return 0.0, 0.0
        return _tube_rays.clip(t0, t1, lz, uz, row[18])
    if kind == BOX:
        return _box(lx, ly, lz, ux, uy, uz)
    narrowed = kind == NARROWED
    if abs(uz) <= row[23]:
        t0, t1 = _tube_rays.shallow(narrowed, lx, ly, lz, ux, uy, uz, row[19], row[20], row[21], row[22])
        if t1 <= t0:
            return 0.0, 0.0
        return _tube_rays.clip(t0, t1, lz, uz, row[18])
    return _tube_rays.steep(narrowed, lx, ly, lz, ux, uy, uz, row[19], row[20], row[21], row[22], row[18])


@numba.njit(cache=True, parallel=True, fastmath=_FAST, error_model="numpy")
def _chords(kinds: Any, params: Any, origins: Any, directions: Any, out: Any) -> None:
    for n in numba.prange(origins.shape[0]):
        ox, oy, oz = origins[n, 0], origins[n, 1], origins[n, 2]
        dx, dy, dz = directions[n, 0], directions[n, 1], directions[n, 2]
        for b in range(kinds.shape[0]):
            t0, t1 = interval(kinds[b], params[b], ox, oy, oz, dx, dy, dz)
            out[b, n] = 0.0 if t1 <= t0 else t1 - t0


def chord_lengths(scene: Any, origins: ArrayLike, directions: ArrayLike) -> NDArray[np.float64]:
    """Length that straight lines run inside each shape.

    Args:
        scene: a :class:`~torchpcct.scene.Scene` (at rest) or a sequence of ``B`` shapes.
        origins: a point of each line, ``(N, 3)`` or ``(3,)`` for all, x, y, z in mm.
        directions: ``(N, 3)`` or ``(3,)`` for all; any length greater than 0. The lines are endless both ways.

    Returns:
        ``(B, N)`` float64 in mm. A child's length is part of its parent's.

    Raises:
        ValueError: a wrong shape, a value that is not finite, a direction of length 0.
        TypeError: an element that is not a shape.
    """
    kinds, params = pack(scene.shapes if hasattr(scene, "shapes") else list(scene))
    o = np.atleast_2d(np.asarray(origins, dtype=np.float64))
    d = np.atleast_2d(np.asarray(directions, dtype=np.float64))
    for name, value in (("origins", o), ("directions", d)):
        if value.ndim != 2 or value.shape[1] != 3:
            raise ValueError(f"{name} must have the shape (N, 3) or (3,), got {value.shape}")
        if not np.isfinite(value).all():
            raise ValueError(f"{name} must be finite, but row {int(np.argwhere(~np.isfinite(value))[0, 0])} is not")
    if o.shape[0] != d.shape[0] and 1 not in (o.shape[0], d.shape[0]):
        raise ValueError(f"origins and directions must be equally many (or one single), got {len(o)} and {len(d)}")
    length = np.linalg.norm(d, axis=1, keepdims=True)
    if not (length > 0).all():
        raise ValueError(f"directions must have a length greater than 0, but row {int(np.argmin(length))} is 0")
    o, d = np.broadcast_arrays(o, d / length)
    out = np.empty((kinds.size, o.shape[0]), dtype=np.float64)
    _chords(kinds, params, np.ascontiguousarray(o), np.ascontiguousarray(d), out)
    return out
