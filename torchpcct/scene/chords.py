"""Exact intersections of rays with the analytic shapes, as numba kernels that other kernels can
call.

``pack`` turns shapes into two arrays; :func:`~torchpcct.scene.chord_kernels.interval` finds where
one ray is inside one packed shape. All in float64: away from grazing incidence the end points are
exact to about 1e-11 mm for sources a metre away.

Quadrics and boxes are met at most once. The tubes of :mod:`torchpcct.scene.tubes` are not convex:

* a ray of small slope (``|dz|`` below the limit that ``pack`` derives from the tube's profile, 0.12
  for a plaque: every ray of a circular scan) sees a section that changes so slowly that the curve
  it draws in the section's own coordinates is flatter than their unit circle. Then the implicit
  function is convex along the ray, there are at most two crossings, and Newton's iteration from the
  section at the closest approach finds both;
* a steeper ray may leave the tube at a flank of the bulge and enter it again. It is searched piece
  by piece for all crossings; the interval returned starts at the first entry and has the exact
  TOTAL length inside.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchpcct.scene.bodies import Box, Ellipsoid, EllipticCylinder, Shape
from torchpcct.scene.chord_kernels import (
    BOX,
    BULGED,
    CYLINDER,
    ELLIPSOID,
    NARROWED,
    chords,
)
from torchpcct.scene.tubes import BulgedTube, NarrowedTube
from torchpcct.threads import run
from torchpcct.validate import checked

__all__ = ["chord_lengths"]

PARAMETERS = 24
"""Row of ``params``: 0-2 centre of the bounding z cylinder, 3 its radius squared, 4 radius, 5 half
height; 6-8 position; 9-17 matrix from scanner to local axes (scaled to the unit shape for
ellipsoid, cylinder section and box); 18 half length; 19-23 tubes: radius, amplitude, 2 π / bulge
length, bulge length / 2, largest slope of the fast path."""

_SERIES = 0.7
"""Largest phase of the profile (rad) that the series in the kernels carry to 1e-11."""
_SLACK = 1.0 + 1e-9
"""The bounding cylinder is a little wider than the shape, so that rounding never rejects a ray that
grazes it."""


def _slope_limit(shape: BulgedTube | NarrowedTube) -> float:
    """Largest ``|dz|`` for which ``h`` is convex along the ray and the phase stays in the series'
    range.

    In the section's coordinates the ray is a curve of acceleration ``P''`` and speed ``|P'|``.
    ``h'' = 2 |P'|² + 2 P·P''`` is positive while ``|P| |P''| < |P'|²``; the bounds hold in the
    whole bounding disc, and a factor 2 is in hand.
    """
    r, a = shape.radius, shape.amplitude
    if a == 0.0:
        return math.inf
    reach = 2.0 * (r + a)
    steepest, bend = math.pi * a / shape.bulge_length, 2.0 * (math.pi / shape.bulge_length) ** 2 * a
    if isinstance(shape, NarrowedTube):
        first, second = steepest / r**2, bend / r**2
        scale = 1.0 / r
    else:
        first, second = steepest / r**2, bend / r**2 + 2.0 * steepest**2 / r**3
        scale = 1.0 / (r + a)
    farthest = 2.0 * ((r + a) / r) ** 2
    low, high = 0.0, 1.0
    for _ in range(40):
        s = 0.5 * (low + high)
        acceleration = s * (2.0 * first + reach * second * s)
        speed = math.sqrt(1.0 - s * s) * scale - s * reach * first
        phase = 2.0 * math.pi / shape.bulge_length * s * reach
        if speed > 0 and 2.0 * farthest * acceleration <= speed * speed and phase <= _SERIES:
            low = s
        else:
            high = s
    return low


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


@checked
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
            raise TypeError(
                f"shapes[{b}] must be a shape of torchpcct.scene, got {type(shape).__name__}"
            )
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
            row[23] = _slope_limit(shape)
        else:
            raise TypeError(f"shapes[{b}]: no chord kernel for {type(shape).__name__}")
        row[9:18] = (shape.matrix.T / scale[:, None]).ravel()
    return kinds, params


@checked
def chord_lengths(scene: object, origins: ArrayLike, directions: ArrayLike) -> NDArray[np.float64]:
    """Length that straight lines run inside each shape.

    Args:
        scene: a :class:`~torchpcct.scene.Scene` (at rest) or a sequence of ``B`` shapes.
        origins: a point of each line, ``(N, 3)`` or ``(3,)`` for all, x, y, z in mm.
        directions: ``(N, 3)`` or ``(3,)`` for all; any length greater than 0. The lines are endless
            both ways.

    Returns:
        ``(B, N)`` float64 in mm. A child's length is part of its parent's.

    Raises:
        ValueError: a wrong shape, a value that is not finite, a direction of length 0.
        TypeError: an element that is not a shape.
    """
    shapes = getattr(scene, "shapes", scene)
    if not isinstance(shapes, Sequence):
        raise TypeError(
            f"scene must be a Scene or a sequence of shapes, got {type(scene).__name__}"
        )
    kinds, params = pack(shapes)
    o = np.atleast_2d(np.asarray(origins, dtype=np.float64))
    d = np.atleast_2d(np.asarray(directions, dtype=np.float64))
    for name, value in (("origins", o), ("directions", d)):
        if value.ndim != 2 or value.shape[1] != 3:
            raise ValueError(f"{name} must have the shape (N, 3) or (3,), got {value.shape}")
        if not np.isfinite(value).all():
            raise ValueError(
                f"{name} must be finite, but row {int(np.argwhere(~np.isfinite(value))[0, 0])} is "
                "not"
            )
    if o.shape[0] != d.shape[0] and 1 not in (o.shape[0], d.shape[0]):
        raise ValueError(
            f"origins and directions must be equally many (or one single), got {len(o)} and "
            f"{len(d)}"
        )
    length = np.linalg.norm(d, axis=1, keepdims=True)
    if not (length > 0).all():
        raise ValueError(
            f"directions must have a length greater than 0, but row {int(np.argmin(length))} is 0"
        )
    o, d = np.broadcast_arrays(o, d / length)
    out = np.empty((kinds.size, o.shape[0]), dtype=np.float64)
    lines = np.ascontiguousarray(o), np.ascontiguousarray(d)
    run(chords, len(o), kinds, params, *lines, out, operations=50 * kinds.size)
    return out
