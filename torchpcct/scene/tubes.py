"""Vessel segments whose section changes along the axis: the surfaces of an eccentric plaque.

Both tubes are circular cylinders of radius ``R`` about the local z axis except for ``|z| <
bulge_length / 2``, where the profile ``d(z) = amplitude * cos²(π z / bulge_length)`` deforms the
section. One side of the wall, the line ``x = -R``, stays where it is; the plaque lies on the other
side, towards +x.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from torchpcct.scene.bodies import FAR, Floats, Shape, along_axis, disc_points
from torchpcct.validate import number

__all__ = ["BulgedTube", "NarrowedTube"]


@dataclass(frozen=True)
class _Tube(Shape):
    radius: float
    amplitude: float
    bulge_length: float
    half_length: float = math.inf

    def __post_init__(self) -> None:
        super().__post_init__()
        set_ = object.__setattr__
        set_(self, "radius", number("radius", self.radius, positive=True))
        set_(self, "amplitude", number("amplitude", self.amplitude, low=0.0, unit="mm"))
        set_(self, "bulge_length", number("bulge_length", self.bulge_length, positive=True))
        set_(
            self,
            "half_length",
            number("half_length", self.half_length, positive=True, finite=False),
        )

    def profile(self, z: ArrayLike) -> Floats:
        """``d(z)`` in mm at the local heights ``z`` (mm), same shape."""
        height = np.asarray(z, dtype=np.float64)
        d = self.amplitude * np.cos(math.pi / self.bulge_length * height) ** 2
        return np.where(np.abs(height) < self.bulge_length / 2.0, d, 0.0)

    def section(self, z: ArrayLike) -> tuple[Floats, Floats, Floats]:
        """The section at the local heights ``z`` (mm): an ellipse about ``(centre, 0)``.

        Returns:
            centre along the local x, semi-axis along x, semi-axis along y, each in mm and of the
            shape of ``z``.
        """
        raise NotImplementedError

    @property
    def rotationally_symmetric(self) -> bool:
        return self._on_axis and self._upright and self.amplitude == 0.0

    def _level(self, local: Floats) -> Floats:
        centre, ax, ay = self.section(local[..., 2])
        radial = np.hypot((local[..., 0] - centre) / ax, local[..., 1] / ay)
        return np.maximum(radial, np.abs(local[..., 2]) / self.half_length)

    def _surface(self, count: int) -> Floats:
        half = min(self.half_length, FAR)
        reach = min(half, self.bulge_length / 2.0)
        # Half of the rings over the bulge, where neighbours may touch; an odd number, so that z = 0
        # is one of them.
        rings = max(count // 128, 8)
        z = np.unique(
            np.concatenate(
                [np.linspace(-reach, reach, rings | 1), np.linspace(-half, half, rings | 1)]
            )
        )
        centre, ax, ay = (v[:, None] for v in self.section(z))
        phi = np.arange(64) * (2.0 * math.pi / 64)
        x, y = centre + ax * np.cos(phi), ay * np.sin(phi)
        side = np.stack([x, y, np.broadcast_to(z[:, None], x.shape)], axis=-1).reshape(-1, 3)
        caps = []
        for end in (-half, half):
            c, a, b = self.section(end)
            disc = disc_points(count // 4)
            caps.append(
                np.stack([c + a * disc[:, 0], b * disc[:, 1], np.full(len(disc), end)], axis=1)
            )
        return np.concatenate([side, *caps])

    @property
    def bounding_box(self) -> Floats:
        low, high = -self.radius, self.radius + self._outward()
        middle = np.array([(low + high) / 2.0, 0.0, 0.0])
        m = self.matrix
        half = np.abs(m[:, :2]) @ np.array([(high - low) / 2.0, self.radius]) + along_axis(
            m[:, 2], self.half_length
        )
        centre = np.array(self.position) + m @ middle
        return np.stack([centre - half, centre + half])

    def _outward(self) -> float:
        """How far in mm the tube reaches beyond ``x = R``."""
        raise NotImplementedError


@dataclass(frozen=True)
class BulgedTube(_Tube):
    """A vessel surface pushed outwards by a plaque: the ellipse about ``(d, 0)`` with semi-axes
    ``(R + d, R)``.

    Args:
        radius: ``R`` of the undisturbed tube in mm.
        amplitude: largest bulge ``d(0)`` in mm (≥ 0): the section widens by ``2 d`` towards the
            local +x.
        bulge_length: length in mm of the deformed segment, centred at the local z = 0.
        half_length: half the tube's length in mm; ``inf`` for an endless tube.
        position: ``(x, y, z)`` of the local origin in mm (default: the isocentre).
        rotation: angle about z in rad, or the 3 × 3 matrix of the local axes (default: none).
    """

    def section(self, z: ArrayLike) -> tuple[Floats, Floats, Floats]:
        d = self.profile(z)
        return d, self.radius + d, np.full_like(d, self.radius)

    def _outward(self) -> float:
        return 2.0 * self.amplitude


@dataclass(frozen=True)
class NarrowedTube(_Tube):
    """A lumen narrowed by a plaque: the circle of radius ``r = R² / (R + d)`` that touches the line
    ``x = -R``.

    ``r`` is the radius of curvature that the :class:`BulgedTube` of the same ``R`` and ``d`` has at
    ``x = -R``: the circle is the largest one that touches that tube there from inside.

    Args:
        radius: ``R`` of the undisturbed tube in mm.
        amplitude: largest ``d(0)`` in mm (≥ 0).
        bulge_length: length in mm of the narrowed segment, centred at the local z = 0.
        half_length: half the tube's length in mm; ``inf`` for an endless tube.
        position: ``(x, y, z)`` of the local origin in mm (default: the isocentre).
        rotation: angle about z in rad, or the 3 × 3 matrix of the local axes (default: none).
    """

    def section(self, z: ArrayLike) -> tuple[Floats, Floats, Floats]:
        r = self.radius**2 / (self.radius + self.profile(z))
        return r - self.radius, r, r

    def _outward(self) -> float:
        return 0.0
