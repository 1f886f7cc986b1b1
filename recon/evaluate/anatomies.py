"""Anatomies that break assumptions: vessels with what a prior for vessels does not expect, painted with exact truths.

A reconstruction that knows what vessels look like may close an ulcer, flatten a thrombus or draw a wall that is not
there. Each :class:`Anatomy` is a pair of scenes about the middle of an inset, with a feature and without it. On the
same noise draw the difference of two volumes is what a method shows of the feature, and what it shows beside.

Scenes are made of parts, laid over each other in order. Shapes and CT numbers are our own choice of what coronary
arteries look like on CT: lumens of 2 to 3 mm with 460 HU, walls of 0.2 mm, fat of -90 HU around.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from recon.evaluate.vessels import Centreline
from torchpcct.geometry import VolumeGrid
from torchpcct.scene.plaque import Plaque
from torchpcct.validate import choice

__all__ = ["ANATOMIES", "TISSUES_HU", "Anatomy", "Part", "Regions", "anatomy", "coarsened"]

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Inside = Callable[[Floats, Floats, Floats], Bools]

TISSUES_HU: Mapping[str, float] = {
    "fat": -90.0,
    "wall": 60.0,
    "fibrous": 100.0,
    "lumen": 460.0,
    "core": 35.0,
    "lipid": -20.0,
    "thrombus": 65.0,
    "flap": 90.0,
    "calcium": 950.0,
    "metal": 5500.0,
    "muscle": 105.0,
    "vein": 140.0,
    "inflamed": -60.0,
}
"""CT numbers of the tissues; all but fat, which fills the rest, are those of parts."""

_FINER = 2
"""Scenes are painted on voxels of half the inset's size: thin parts are found there, and data are projected from them.
"""
_NEAR_MM, _ABOUT_MM = 0.6, 1.5
"""What is beside a feature; what is about a vessel."""

_STRAIGHT = Centreline((0.0, 0.0, 1.0), (1.0, 0.0, 0.0))


@dataclass(frozen=True)
class Part:
    """A region of one tissue.

    Args:
        tissue: a key of :data:`TISSUES_HU`.
        inside: of coordinates towards the plaque, across, along the vessel (mm, arrays of one shape) → bool.
        over: tissues that it replaces; empty: all.
    """

    tissue: str
    inside: Inside
    over: tuple[str, ...] = ()


@dataclass(frozen=True)
class Regions:
    """Where an anatomy is read on a grid, bool masks ``grid.shape``.

    Attributes:
        feature: voxels that the feature changes by more than half of what it changes at most.
        beside: within 0.6 mm of them, the feature included.
        elsewhere: within 1.5 mm of a vessel, and not ``beside``: nothing differs there.
    """

    feature: Bools
    beside: Bools
    elsewhere: Bools


@dataclass(frozen=True)
class Anatomy:
    """A feature in its surroundings, and the same surroundings without it.

    Args:
        title: one line on what it is.
        base: what is there in both scenes.
        feature: what is laid over it in one of them; empty: nothing, both scenes are the same.
        line: the vessel's centreline.
        hu: CT numbers other than those of :data:`TISSUES_HU`.
    """

    title: str
    base: tuple[Part, ...]
    feature: tuple[Part, ...] = ()
    line: Centreline = _STRAIGHT
    hu: Mapping[str, float] = field(default_factory=dict)

    @cached_property
    def values(self) -> dict[str, float]:
        """Tissue → HU, fat first."""
        return {**TISSUES_HU, **self.hu}

    @property
    def base_key(self) -> tuple[object, ...]:
        """What the scene without the feature is made of: equal for anatomies that share it."""
        return self.base, self.line, tuple(self.values[part.tissue] for part in self.base)

    def labels(self, points: Floats, *, feature: bool) -> NDArray[np.int64]:
        """Index of the tissue in :attr:`values` at points ``(..., 3)`` x, y, z in mm about the inset's middle."""
        names = list(self.values)
        towards, across, along = np.moveaxis(self.line.local(points), -1, 0)
        labels = np.zeros(towards.shape, np.int64)
        for part in (*self.base, *(self.feature if feature else ())):
            inside = part.inside(towards, across, along)
            if part.over:
                inside = inside & np.isin(labels, [names.index(tissue) for tissue in part.over])
            labels[inside] = names.index(part.tissue)
        return labels

    def painted(self, grid: VolumeGrid, *, feature: bool) -> Floats:
        """HU on voxels of half the size of an inset's ``grid``, means over each voxel to 0.5 HU rms."""
        from torchpcct.scene.raster import label_fractions  # its kernels need numba, a slow import

        fine = VolumeGrid(tuple(_FINER * n for n in grid.shape), tuple(s / _FINER for s in grid.spacing), (0.0,) * 3)
        shares = label_fractions(lambda p: self.labels(p, feature=feature), len(self.values), fine)
        # One tissue at a time: all shares at once would be a copy of what is large already.
        return np.sum([hu * share for hu, share in zip(self.values.values(), shares, strict=True)], axis=0)

    def regions(self, with_feature: Floats, without: Floats, grid: VolumeGrid) -> Regions:
        """Where to read, from the true volumes ``grid.shape`` (:func:`coarsened`) with and without the feature."""
        change = np.abs(with_feature - without)
        feature = change > 0.5 * change.max() if self.feature else np.zeros(grid.shape, bool)
        touched = change > 0.0
        bodies = (np.maximum(with_feature, without) > self.values["fat"] + 1.0) & ~touched
        beside = _within(feature, _NEAR_MM, grid) | touched
        elsewhere = _within(bodies, _ABOUT_MM, grid) & ~beside & ~_within(touched, _NEAR_MM, grid)
        return Regions(feature, beside, elsewhere)


def coarsened(fine: Floats) -> Floats:
    """Means over blocks of what was painted on voxels of half the size."""
    z, y, x = (n // _FINER for n in fine.shape)
    means: Floats = fine.reshape(z, _FINER, y, _FINER, x, _FINER).mean((1, 3, 5))
    return means


def _within(mask: Bools, mm: float, grid: VolumeGrid) -> Bools:
    if not mask.any():
        return np.zeros_like(mask)
    return np.asarray(ndimage.distance_transform_edt(~mask, sampling=grid.spacing) <= mm)


# --- shapes, in the vessel's coordinates: a towards the plaque, b across, s along -----------------------------------

_R, _WALL, _LUMEN, _HALF = 1.75, 0.2, 1.4, 4.4
"""Radius of the healthy vessel, its wall, radius of its lumen, half of its length, mm."""
_PLAQUE = Plaque(
    position=(0.0, 0.0, 0.0),
    vessel_diameter=3.5,
    wall_thickness=_WALL,
    vessel_length=2 * _HALF,
    bulge=0.5,
    bulge_length=6.4,
    cap_thickness=0.3,
    core_semi_axes=(0.5, 0.9, 1.1),
)


def _tube(radius: float | Callable[[Floats], Floats], half: float = _HALF, a0: float = 0.0, b0: float = 0.0) -> Inside:
    """A round tube; its radius may change along it."""

    def inside(a: Floats, b: Floats, s: Floats) -> Bools:
        r = radius(s) if callable(radius) else radius
        return np.asarray((np.hypot(a - a0, b - b0) < r) & (np.abs(s) < half))

    return inside


def _ball(centre: Sequence[float], semi_axes: float | Sequence[float]) -> Inside:
    c, r = centre, np.broadcast_to(np.asarray(semi_axes, float), 3)

    def inside(a: Floats, b: Floats, s: Floats) -> Bools:
        return np.asarray(((a - c[0]) / r[0]) ** 2 + ((b - c[1]) / r[1]) ** 2 + ((s - c[2]) / r[2]) ** 2 < 1.0)

    return inside


def _within_shape(shape: object) -> Inside:
    def inside(a: Floats, b: Floats, s: Floats) -> Bools:
        return np.asarray(shape.contains(np.stack([a, b, s], axis=-1)))  # type: ignore[attr-defined]

    return inside


def _rod(start: Sequence[float], along: Sequence[float], radius: float, length: float) -> Inside:
    """A round rod from a point."""
    p, u = np.asarray(start, float), np.asarray(along, float) / np.linalg.norm(along)

    def inside(a: Floats, b: Floats, s: Floats) -> Bools:
        d = [a - p[0], b - p[1], s - p[2]]
        t = d[0] * u[0] + d[1] * u[1] + d[2] * u[2]
        off = sum((d[k] - t * u[k]) ** 2 for k in range(3))
        return np.asarray((off < radius**2) & (t > 0.0) & (t < length))

    return inside


def _vessel(radius: float = _R, lumen: float | Callable[[Floats], Floats] = _LUMEN, half: float = _HALF) -> list[Part]:
    """A healthy vessel: wall, thin intima, lumen."""
    return [
        Part("wall", _tube(radius, half)),
        Part("fibrous", _tube(radius - _WALL, half)),
        Part("lumen", _tube(lumen, half)),
    ]


def _plaque(plaque: Plaque = _PLAQUE) -> list[Part]:
    return [
        Part("wall", _within_shape(plaque.outer)),
        Part("fibrous", _within_shape(plaque.inner)),
        Part("lumen", _within_shape(plaque.lumen)),
    ]


def _core(tissue: str = "core", plaque: Plaque = _PLAQUE) -> list[Part]:
    return [Part(tissue, _within_shape(plaque.core), ("fibrous",))]


def _second(distance: float, tilt: float, tissue: str = "lumen", radius: float = 0.95) -> list[Part]:
    """Another vessel beside, its axis ``distance`` mm off on the side of the plaque."""
    u = (0.0, math.sin(tilt), math.cos(tilt))
    start, length = (distance, -4.0 * u[1], -4.0 * u[2]), 8.0
    return [
        Part("wall", _rod(start, u, radius, length), ("fat",)),
        Part(tissue, _rod(start, u, radius - 0.18, length), ("fat", "wall")),
    ]


def _muscle(face: float) -> list[Part]:
    """Muscle beyond a plane so far from the axis, on the side away from the plaque."""
    return [Part("muscle", lambda a, b, s: a < -face, ("fat",))]


def _narrowing(depth: float, length: float) -> Callable[[Floats], Floats]:
    return lambda s: _LUMEN * (1.0 - depth * np.exp(-0.5 * (s / length) ** 2))


def _struts(a: Floats, b: Floats, s: Floats) -> Bools:
    """A stent of zigzag rings of 0.11 mm wire (square section) against the lumen's wall, three links between rings."""
    r, turn = np.hypot(a, b), np.arctan2(b, a) / (2.0 * math.pi)
    shell = np.abs(r - (_LUMEN - 0.075)) < 0.055
    zigzag = 0.3 * np.abs(np.mod(6.0 * turn, 1.0) * 4.0 - 2.0)
    rings = np.abs(np.mod(s + zigzag + 0.7, 1.4) - 0.7) < 0.065
    links = np.abs(np.mod(3.0 * turn + 0.25, 1.0) - 0.5) * 2.0 * math.pi / 3.0 * r < 0.055
    return np.asarray(shell & (rings | links) & (np.abs(s) < 3.1))


def _bulging(s: Floats) -> Floats:
    return 1.15 * np.exp(-0.5 * (s / 1.2) ** 2)


_BRANCH = (0.0, math.sin(0.85), math.cos(0.85))
_THIN = replace(_PLAQUE, cap_thickness=0.12)
_BENT = Centreline((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), 3.5)

_HEALTHY, _WITH_PLAQUE = tuple(_vessel()), tuple(_plaque())

ANATOMIES: dict[str, Anatomy] = {
    "healthy": Anatomy("a healthy vessel, nothing more", _HEALTHY),
    "core": Anatomy("a necrotic core in an eccentric plaque", _WITH_PLAQUE, tuple(_core())),
    "lipid_core": Anatomy("a core of lipid", _WITH_PLAQUE, tuple(_core("lipid"))),
    "thin_cap": Anatomy("a necrotic core under a cap of 0.12 mm", tuple(_plaque(_THIN)), tuple(_core(plaque=_THIN))),
    "ulcer": Anatomy(
        "a crater of 1 mm in the plaque, open to the lumen",
        _WITH_PLAQUE,
        (Part("lumen", _ball((0.55, 0.0, 0.3), (0.85, 0.5, 0.5)), ("fibrous",)),),
    ),
    "thrombus": Anatomy(
        "a thrombus of 1.1 mm on the lumen's wall",
        _HEALTHY,
        (Part("thrombus", _ball((-0.4, 1.05, -0.2), 0.55), ("lumen",)),),
    ),
    "flap": Anatomy(
        "a dissection: a flap of 0.28 mm across the lumen",
        _HEALTHY,
        (
            Part(
                "flap",
                lambda a, b, s: (np.abs(0.8 * a + 0.6 * b - 0.25 - 0.08 * s) < 0.14) & (np.abs(s) < 2.6),
                ("lumen",),
            ),
        ),
    ),
    "calcification": Anatomy(
        "a spotty calcification of 0.5 mm in the wall",
        _HEALTHY,
        (Part("calcium", _ball((-1.1, -1.1, 0.4), 0.25), ("wall", "fibrous")),),
    ),
    "stent": Anatomy("a stent of wires of 0.11 mm", _HEALTHY, (Part("metal", _struts, ("lumen",)),)),
    "inflamed_30": Anatomy(
        "fat inflamed by 30 HU in a ring of 1 mm", _HEALTHY, (Part("inflamed", _tube(_R + 1.0), ("fat",)),)
    ),
    "inflamed_15": Anatomy(
        "fat inflamed by 15 HU in a ring of 1 mm",
        _HEALTHY,
        (Part("inflamed", _tube(_R + 1.0), ("fat",)),),
        hu={"inflamed": -75.0},
    ),
    "branch": Anatomy(
        "a side branch of 1.6 mm",
        _HEALTHY,
        (
            Part("wall", _rod((0.0, 0.0, -0.5), _BRANCH, 0.8, 4.9), ("fat",)),
            Part("lumen", _rod((0.0, 0.0, -0.5), _BRANCH, 0.6, 4.9)),
        ),
    ),
    "touching": Anatomy(
        "a vessel that touches, crossing at a right angle", _HEALTHY, tuple(_second(_R + 0.95, math.pi / 2))
    ),
    "second": Anatomy(
        "a vein of 1.6 mm alongside, 0.8 mm off",
        _HEALTHY,
        tuple(_second(_R + 0.8 + 0.8, 0.15, tissue="vein", radius=0.8)),
    ),
    "muscle_2mm": Anatomy(
        "a necrotic core, muscle 2 mm off the vessel", (*_WITH_PLAQUE, *_muscle(_R + 2.0)), tuple(_core())
    ),
    "muscle_touching": Anatomy("a necrotic core, muscle that touches", (*_WITH_PLAQUE, *_muscle(_R)), tuple(_core())),
    "stenosis": Anatomy(
        "a round stenosis of 72 %",
        _HEALTHY,
        (
            Part(
                "fibrous",
                lambda a, b, s: np.hypot(a, b) > _narrowing(0.72, 0.8)(s),
                ("lumen",),
            ),
        ),
    ),
    "aneurysm": Anatomy(
        "an aneurysm of 5.8 mm",
        _HEALTHY,
        (
            Part("wall", _tube(lambda s: _R + _bulging(s)), ("fat",)),
            Part("fibrous", _tube(lambda s: _R - _WALL + _bulging(s)), ("fat", "wall")),
            Part("lumen", _tube(lambda s: _LUMEN + _bulging(s))),
        ),
    ),
    "occlusion": Anatomy(
        "an occlusion by thrombus, from the middle on",
        _HEALTHY,
        (Part("thrombus", lambda a, b, s: s > 0.35 + 0.15 * a, ("lumen",)),),
    ),
    "low_enhancement": Anatomy(
        "a necrotic core, the lumen enhanced to 160 HU", _WITH_PLAQUE, tuple(_core()), hu={"lumen": 160.0}
    ),
    "curved": Anatomy("a necrotic core in a vessel bent with 3.5 mm", _WITH_PLAQUE, tuple(_core()), line=_BENT),
}
"""By name."""


def anatomy(name: str) -> Anatomy:
    """One of :data:`ANATOMIES`.

    Raises:
        ValueError: an unknown name.
    """
    return ANATOMIES[choice("anatomy", name, ANATOMIES)]
