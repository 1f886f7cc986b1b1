"""Analytic solid shapes: position and rotation in the scanner's frame (mm), never voxelised.

A shape's local frame has its origin at ``position``; the columns of ``rotation`` are the local axes
in the scanner's frame, so that ``scanner = position + rotation @ local``. Exact chords of rays
through these shapes are in :mod:`torchpcct.scene.chords`; how shapes nest into an object is in
:mod:`torchpcct.scene.scene`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchpcct.validate import checked, number, numbers, reals

if TYPE_CHECKING:
    from collections.abc import Sequence

    from torchpcct.validate import Limits


__all__ = ["Box", "Ellipsoid", "EllipticCylinder", "Shape", "rotation_matrix"]

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Matrix = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]

FAR = 2000.0
"""Where the surface of an infinite shape is sampled to, mm: far beyond any scanner."""
_MOST_MM = 1e9
"""Places and sizes at most, beyond any scanner; larger ones overflow on the way."""
_SIZES: Limits = {"positive": True, "low": 1e-9, "high": _MOST_MM, "unit": "mm"}
"""Limits of sizes: an atom is larger than the smallest."""
_ORTHOGONAL = 1e-9
"""Deviation of m mᵀ from the identity up to which m is a rotation."""


@checked
def rotation_matrix(axis: ArrayLike, angle: float) -> Floats:
    """Right-handed rotation by ``angle`` rad about ``axis`` (3 numbers, any length > 0), ``(3, 3)``
    float64.

    Raises:
        ValueError: an axis of zero length or of other than 3 components.
    """
    a = np.asarray(axis, dtype=np.float64)
    length = float(np.linalg.norm(a)) if a.shape == (3,) else 0.0
    if not (math.isfinite(length) and length > 0):
        raise ValueError(f"axis must be 3 finite numbers, not all 0, got {axis!r}")
    x, y, z = a / length
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * (cross @ cross)


def _rotation(value: ArrayLike) -> Matrix:
    if np.ndim(value) == 0:
        angle = number("rotation", value)
        m = rotation_matrix((0.0, 0.0, 1.0), angle)
    else:
        m = reals("rotation", value)
        if m.shape != (3, 3):
            raise ValueError(
                f"rotation must be an angle about z in rad or a 3 × 3 matrix, got shape {m.shape}"
            )
        proper = np.abs(m @ m.T - np.eye(3)).max() < _ORTHOGONAL and np.linalg.det(m) > 0
        if not proper:
            raise ValueError(
                "rotation must be a proper rotation matrix (orthonormal, determinant +1), got "
                f"{m.tolist()}"
            )
    return tuple(tuple(float(v) for v in row) for row in m)  # type: ignore[return-value]


def _fibonacci_sphere(count: int) -> Floats:
    k = np.arange(count) + 0.5
    z = 1.0 - 2.0 * k / count
    phi = k * (math.pi * (3.0 - math.sqrt(5.0)))
    r = np.sqrt(1.0 - z * z)
    # The poles and the equator's cardinal points: where touching bodies usually touch.
    extra = np.concatenate([np.eye(3), -np.eye(3)])
    return np.concatenate([np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1), extra])


def disc_points(count: int) -> Floats:
    """About ``count`` points of the closed unit disc, rim and centre included, ``(N, 2)``."""
    rings = max(int(math.sqrt(count / 4.0)), 2)
    phi = np.arange(4 * rings) * (2.0 * math.pi / (4 * rings))
    radius = np.linspace(0.0, 1.0, rings + 1)
    return np.stack(
        [np.outer(radius, np.cos(phi)).ravel(), np.outer(radius, np.sin(phi)).ravel()], axis=1
    )


@dataclass(frozen=True, kw_only=True)
class Shape:
    """Base of the solid shapes.

    Args:
        position: ``(x, y, z)`` of the local origin in mm.
        rotation: a 3 × 3 proper rotation matrix (local to scanner axes), or one number: an angle
            about +z in rad.

    Raises:
        ValueError, TypeError: a value out of range or of the wrong kind; the message names it.
    """

    position: Sequence[float] = (0.0, 0.0, 0.0)
    rotation: Any = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(
            self,
            "position",
            numbers("position", self.position, 3, low=-_MOST_MM, high=_MOST_MM, unit="mm"),
        )
        object.__setattr__(self, "rotation", _rotation(self.rotation))

    @property
    def matrix(self) -> Floats:
        """``rotation`` as an array, ``(3, 3)`` float64: its columns are the local axes."""
        return np.array(self.rotation, dtype=np.float64)

    def to_local(self, points: ArrayLike) -> Floats:
        """Scanner coordinates ``(..., 3)`` in mm to the local frame, same shape."""
        return (np.asarray(points, dtype=np.float64) - np.array(self.position)) @ self.matrix

    def to_scanner(self, points: ArrayLike) -> Floats:
        """Local coordinates ``(..., 3)`` in mm to the scanner's frame, same shape."""
        return np.asarray(points, dtype=np.float64) @ self.matrix.T + np.array(self.position)

    def level(self, points: ArrayLike) -> Floats:
        """A dimensionless gauge: < 1 inside, 1 on the surface, > 1 outside.

        Args:
            points: ``(..., 3)`` (x, y, z) in mm in the scanner's frame.

        Returns:
            ``(...)`` float64.
        """
        p = np.asarray(points, dtype=np.float64)
        if p.shape[-1:] != (3,):
            raise ValueError(f"points must have the shape (..., 3) of x, y, z, got {p.shape}")
        return self._level(self.to_local(p))

    def contains(self, points: ArrayLike) -> Bools:
        """Whether each point ``(..., 3)`` (mm, scanner's frame) lies inside or on the surface,
        ``(...)`` bool."""
        return self.level(points) <= 1.0

    def surface_points(self, count: int = 2000) -> Floats:
        """About ``count`` points of the surface, ``(N, 3)`` mm; infinite shapes are cut at ±
        2000 mm."""
        return self.to_scanner(self._surface(count))

    @property
    def bounding_box(self) -> Floats:
        """Lowest and highest corner of an axis-parallel box that holds the shape, ``(2, 3)`` mm
        (may be infinite)."""
        half = self._half_extent()
        position = np.array(self.position)
        return np.stack([position - half, position + half])

    @property
    def rotationally_symmetric(self) -> bool:
        """Whether turning the shape about the scanner's z axis leaves it as it is (then every
        view sees the same)."""
        raise NotImplementedError

    @property
    def _on_axis(self) -> bool:
        return self.position[0] == 0.0 and self.position[1] == 0.0

    @property
    def _upright(self) -> bool:
        """The local z axis is parallel to the scanner's."""
        return abs(abs(self.rotation[2][2]) - 1.0) < 1e-15

    def _level(self, local: Floats) -> Floats:
        raise NotImplementedError

    def _surface(self, count: int) -> Floats:
        raise NotImplementedError

    def _half_extent(self) -> Floats:
        raise NotImplementedError


@dataclass(frozen=True)
class Ellipsoid(Shape):
    """A solid ellipsoid.

    Args:
        semi_axes: the three semi-axes along the local x, y, z in mm, or one number for a sphere.
        position: ``(x, y, z)`` of the local origin in mm (default: the isocentre).
        rotation: angle about z in rad, or the 3 × 3 matrix of the local axes (default: none).

    Raises:
        ValueError: lengths that are not positive, a position or rotation that is not one.
    """

    semi_axes: Any

    def __post_init__(self) -> None:
        super().__post_init__()
        axes = (self.semi_axes,) * 3 if np.ndim(self.semi_axes) == 0 else self.semi_axes
        object.__setattr__(self, "semi_axes", numbers("semi_axes", axes, 3, **_SIZES))

    @property
    def rotationally_symmetric(self) -> bool:
        form = self.matrix @ np.diag(np.array(self.semi_axes) ** -2.0) @ self.matrix.T
        upright = np.diag([form[0, 0], form[0, 0], form[2, 2]])
        return self._on_axis and bool(np.abs(form - upright).max() <= 1e-13 * np.abs(form).max())

    def _level(self, local: Floats) -> Floats:
        return np.sqrt(((local / np.array(self.semi_axes)) ** 2).sum(axis=-1))

    def _surface(self, count: int) -> Floats:
        return _fibonacci_sphere(count) * np.array(self.semi_axes)

    def _half_extent(self) -> Floats:
        return np.sqrt(((self.matrix * np.array(self.semi_axes)) ** 2).sum(axis=1))


@dataclass(frozen=True)
class EllipticCylinder(Shape):
    """A solid cylinder of elliptic section along the local z axis.

    Args:
        semi_axes: the two semi-axes of the section along the local x and y in mm, or one number for
            a circle.
        half_length: half the height in mm; ``inf`` (the default) for an endless cylinder.
        position: ``(x, y, z)`` of the local origin in mm (default: the isocentre).
        rotation: angle about z in rad, or the 3 × 3 matrix of the local axes (default: none).

    Raises:
        ValueError: lengths that are not positive, a position or rotation that is not one.
    """

    semi_axes: Any
    half_length: float = math.inf

    def __post_init__(self) -> None:
        super().__post_init__()
        axes = (self.semi_axes,) * 2 if np.ndim(self.semi_axes) == 0 else self.semi_axes
        object.__setattr__(self, "semi_axes", numbers("semi_axes", axes, 2, **_SIZES))
        object.__setattr__(
            self,
            "half_length",
            number("half_length", self.half_length, positive=True, finite=False),
        )

    @property
    def rotationally_symmetric(self) -> bool:
        return self._on_axis and self._upright and self.semi_axes[0] == self.semi_axes[1]

    def _level(self, local: Floats) -> Floats:
        radial = np.hypot(local[..., 0] / self.semi_axes[0], local[..., 1] / self.semi_axes[1])
        return np.maximum(radial, np.abs(local[..., 2]) / self.half_length)

    def _surface(self, count: int) -> Floats:
        a, b = self.semi_axes
        phi = np.arange(64) * (2.0 * math.pi / 64)
        half = min(self.half_length, FAR)
        z = np.linspace(-half, half, max(count // 64, 2) | 1)
        side = np.stack(
            [np.tile(a * np.cos(phi), z.size), np.tile(b * np.sin(phi), z.size), np.repeat(z, 64)],
            axis=1,
        )
        cap = np.pad(disc_points(count // 4) * (a, b), ((0, 0), (0, 1)))
        return np.concatenate(
            [side, cap + np.array([0.0, 0.0, half]), cap - np.array([0.0, 0.0, half])]
        )

    def _half_extent(self) -> Floats:
        section = np.sqrt(((self.matrix[:, :2] * np.array(self.semi_axes)) ** 2).sum(axis=1))
        return section + along_axis(self.matrix[:, 2], self.half_length)


@dataclass(frozen=True)
class Box(Shape):
    """A solid box with faces perpendicular to the local axes.

    Args:
        half_lengths: half the edge lengths along the local x, y, z in mm, or one number for a cube.
        position: ``(x, y, z)`` of the local origin in mm (default: the isocentre).
        rotation: angle about z in rad, or the 3 × 3 matrix of the local axes (default: none).

    Raises:
        ValueError: lengths that are not positive, a position or rotation that is not one.
    """

    half_lengths: Any

    def __post_init__(self) -> None:
        super().__post_init__()
        half = (self.half_lengths,) * 3 if np.ndim(self.half_lengths) == 0 else self.half_lengths
        object.__setattr__(self, "half_lengths", numbers("half_lengths", half, 3, **_SIZES))

    @property
    def rotationally_symmetric(self) -> bool:
        return False

    def _level(self, local: Floats) -> Floats:
        return (np.abs(local) / np.array(self.half_lengths)).max(axis=-1)

    def _surface(self, count: int) -> Floats:
        side = np.linspace(-1.0, 1.0, max(int(math.sqrt(count / 6.0)), 3))
        u, v = (g.ravel() for g in np.meshgrid(side, side))
        faces = []
        for axis in range(3):
            for sign in (-1.0, 1.0):
                faces.append(np.insert(np.stack([u, v], axis=1), axis, sign, axis=1))
        return np.concatenate(faces) * np.array(self.half_lengths)

    def _half_extent(self) -> Floats:
        return np.abs(self.matrix) @ np.array(self.half_lengths)


def along_axis(direction: Floats, half_length: float) -> Floats:
    """``|direction| * half_length`` per component, with 0 · inf = 0, ``(3,)``."""
    size = np.abs(direction)
    reach = np.zeros(3)
    np.multiply(size, half_length, out=reach, where=size > 1e-15)
    return reach
