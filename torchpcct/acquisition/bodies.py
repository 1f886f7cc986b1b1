"""A scene's bodies as the kernel reads them: packed once, then evaluated for the energies and
views of each launch."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchpcct.geometry import ConeBeam, view_step
from torchpcct.scene.chords import pack
from torchpcct.scene.scene import Scene

Floats = NDArray[np.float64]

_ENDLESS_MM = 1e5
"""Where an endless body is cut for the bookkeeping of windows: far beyond any scanner."""


class BodySet(NamedTuple):
    """Packed bodies at given energies and views, ready for the kernel.

    Attributes:
        kinds, params: of :func:`torchpcct.scene.chords.pack`.
        contrast: ``(bodies, energies)`` Δμ in mm⁻¹.
        offsets: ``(bodies, views, 3)`` displacement in mm at the middle of each view.
        drift: ``(bodies, views, 3)`` displacement in mm over the duration of each view.
        circle: ``(x, y, radius)`` in mm around all bodies at rest, seen along z; radius inf: every
            reading sees them.
    """

    kinds: NDArray[np.int64]
    params: Floats
    contrast: Floats
    offsets: Floats
    drift: Floats
    circle: tuple[float, float, float]


@dataclass(frozen=True)
class Bodies:
    """A scene prepared for one turn: bodies that differ between views first, the rotationally
    symmetric ones last.

    Attributes:
        scene: whose bodies they are.
        order: ``(B,)`` index in the scene of each prepared body; a moving body leads.
        varying: how many of them differ between views.
        kinds, params: packed at rest, in this order.
        low, high: corners (x, y, z) mm of the varying bodies on all of their way; of all bodies if
            none varies.
        circle: see :class:`BodySet`.
        first_angle: rad, where the turn begins.
        view_step: rad that the gantry turns while a view is read.
        rotation_s: time of one turn in s, None for a scene at rest.
    """

    scene: Scene
    order: NDArray[np.int64]
    varying: int
    kinds: NDArray[np.int64]
    params: Floats
    low: Floats
    high: Floats
    circle: tuple[float, float, float]
    first_angle: float
    view_step: float
    rotation_s: float | None

    @classmethod
    def of(cls, scene: Scene, geometry: ConeBeam, rotation_s: float | None, duty: float) -> Bodies:
        """Prepare a scene for a turn of ``geometry``; arguments as for :func:`torchpcct.acquire`.

        Raises:
            ValueError: a moving scene without ``rotation_s``; a duty outside (0, 1].
        """
        if not 0 < duty <= 1:
            raise ValueError(
                f"duty must lie in (0, 1], the share of a view's time with the beam on, got {duty}"
            )
        moving = scene.moving
        if moving.any() and rotation_s is None:
            raise ValueError(
                "the scene moves: give rotation_s, the time of one turn in s (or exposure_s)"
            )
        shapes = scene.shapes
        symmetric = np.array(
            [s.rotationally_symmetric and not m for s, m in zip(shapes, moving, strict=True)]
        )
        # A moving body leads: the circle around the varying bodies moves with the first of them.
        order = np.lexsort((np.arange(len(shapes)), ~moving, symmetric))
        varying = int((~symmetric).sum())
        kinds, params = pack([shapes[i] for i in order])
        boxes = np.array([shapes[i].bounding_box for i in order])  # (bodies, 2, 3)
        boxes = np.clip(boxes[:varying] if varying else boxes, -_ENDLESS_MM, _ENDLESS_MM)
        low, high = boxes[:, 0].min(0), boxes[:, 1].max(0)
        # Bodies that move beside bodies that do not have no common circle.
        mixed = moving.any() and not moving[order[:varying]].all()
        radius = math.inf if mixed else float(np.linalg.norm((high - low)[:2]) / 2)
        x, y, _ = (low + high) / 2
        if moving.any():
            travel = np.abs(scene.offsets(np.linspace(0, float(rotation_s or 0), 256))).max((0, 1))
            low, high = low - travel, high + travel
        step = duty * view_step(geometry.angles)
        circle = (float(x), float(y), radius)
        angle = float(geometry.angles[0])
        return cls(scene, order, varying, kinds, params, low, high, circle, angle, step, rotation_s)

    def at(self, energies: ArrayLike, geometry: ConeBeam, *, still: bool = False) -> BodySet:
        """All bodies at ``energies`` (keV) in the views of ``geometry``; ``still``: as if
        nothing moved."""
        offsets = np.zeros((self.order.size, geometry.views, 3))
        drift = np.zeros_like(offsets)
        if not (still or self.scene.is_static):
            turn = float(self.rotation_s or 0)
            times = (geometry.angles - self.first_angle) / (2 * np.pi) * turn
            half = self.view_step / (2 * np.pi) * turn / 2
            offsets = self.scene.offsets(times)[self.order]
            drift = (self.scene.offsets(times + half) - self.scene.offsets(times - half))[
                self.order
            ]
        contrast = self.scene.contrast(energies)[self.order]
        return BodySet(self.kinds, self.params, contrast, offsets, drift, self.circle)

    def attenuation(self, energies: ArrayLike, geometry: ConeBeam) -> tuple[Floats, Floats]:
        """Attenuation of the scene's materials, ``(materials, energies)`` in mm⁻¹, and the longest
        path of a ray in each, ``(materials,)`` in mm, or more."""
        stretch = np.hypot(1.0, np.abs(geometry.row_positions).max() / geometry.sdd)
        boxes = np.array([shape.bounding_box[:, :2] for shape in self.scene.shapes])
        widths = np.ptp(np.clip(boxes, -geometry.sod, geometry.sod), axis=1)
        paths = np.hypot(widths[:, 0], widths[:, 1]) * stretch
        mu = np.stack([m.attenuation(energies) for m in self.scene.materials])
        mu, material = np.unique(mu, axis=0, return_inverse=True)
        longest = np.bincount(material.ravel(), paths)
        return mu, np.minimum(longest, 2.0 * geometry.sod * stretch)

    def symmetric(self, energies: ArrayLike, geometry: ConeBeam) -> BodySet:
        """Only the rotationally symmetric bodies, which all views see alike; there may be none."""
        rest = slice(self.varying, None)
        still = np.zeros((self.order.size - self.varying, geometry.views, 3))
        contrast = self.scene.contrast(energies)[self.order[rest]]
        return BodySet(
            self.kinds[rest], self.params[rest], contrast, still, still, (0.0, 0.0, math.inf)
        )
