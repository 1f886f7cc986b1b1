"""Anatomies that break assumptions: vessels with what a prior for vessels does not expect, painted
with exact truths.

A reconstruction that knows what vessels look like may close an ulcer, flatten a thrombus or draw a
wall that is not there. Each :class:`Anatomy` is a pair of scenes about the middle of an inset, with
a feature and without it. On the same noise realisation the difference of two volumes is what a
method shows of the feature, and what else it shows. :class:`recon.evaluate.tasks.AnatomyTask`
measures it.

Scenes are made of parts, laid over each other in order. Shapes and CT numbers are our own choice of
what coronary arteries look like on CT: lumens of 2 to 3 mm with 460 HU, walls of 0.2 mm, fat of -90
HU around.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from recon.evaluate.vessels import VesselAxis
from torchpcct.geometry import VolumeGrid
from torchpcct.scene.plaque import Plaque
from torchpcct.validate import choice

__all__ = ["ANATOMIES", "Anatomy", "AnatomyPart", "anatomy"]

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

_STRAIGHT = VesselAxis((0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
"""A vessel along z."""


@dataclass(frozen=True)
class AnatomyPart:
    """A region of one tissue.

    Args:
        tissue: a key of :data:`TISSUES_HU`.
        inside: of coordinates towards the plaque, across, along the vessel (mm, arrays of one
            shape) → bool.
        over: tissues that it replaces; empty: all.
    """

    tissue: str
    inside: Inside
    over: tuple[str, ...] = ()


@dataclass(frozen=True)
class Anatomy:
    """A feature in its surroundings, and the same surroundings without it.

    Args:
        title: one line on what it is.
        base: what is there in both scenes.
        feature: what is laid over it in one of them.
        line: the vessel's centreline.
        hu: CT numbers other than those of :data:`TISSUES_HU`.
    """

    title: str
    base: tuple[AnatomyPart, ...]
    feature: tuple[AnatomyPart, ...]
    line: VesselAxis = _STRAIGHT
    hu: Mapping[str, float] = field(default_factory=dict)

    @cached_property
    def values(self) -> dict[str, float]:
        """Tissue → HU, fat first."""
        return {**TISSUES_HU, **self.hu}

    def labels(self, points: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Index of the tissue in :attr:`values` with and without the feature, at points ``(...,
        3)`` x, y, z in mm about the inset's middle."""
        names, local = list(self.values), np.moveaxis(self.line.local(points), -1, 0)

        def laid(over: NDArray[np.int64], parts: tuple[AnatomyPart, ...]) -> NDArray[np.int64]:
            found = over.copy()
            for part in parts:
                inside = part.inside(*local)
                if part.over:
                    inside = inside & np.array([name in part.over for name in names])[found]
                found[inside] = names.index(part.tissue)
            return found

        without = laid(np.zeros(local.shape[1:], np.int64), self.base)
        return laid(without, self.feature), without

    def volume_fractions(self, grid: VolumeGrid) -> dict[tuple[str, str], Floats]:
        """(tissue with the feature, tissue without it) → its share of each voxel ``grid.shape``.

        See :func:`torchpcct.scene.raster.label_fractions`; ``grid`` is about the inset's middle as
        its origin.
        """
        from torchpcct.scene.raster import label_fractions  # its kernels need numba, a slow import

        names = list(self.values)
        before = [*dict.fromkeys(["fat", *(part.tissue for part in self.base)])]
        # A part of the feature may lie over another one of it, and so over whatever that has
        # replaced.
        pairs = [
            *dict.fromkeys(
                [*((t, t) for t in before), *((p.tissue, t) for p in self.feature for t in before)]
            )
        ]
        index = np.full((len(names), len(names)), -1)
        for k, (after, without) in enumerate(pairs):
            index[names.index(after), names.index(without)] = k

        volume_fractions = label_fractions(
            lambda points: index[self.labels(points)], len(pairs), grid
        )
        return {
            pair: share for pair, share in zip(pairs, volume_fractions, strict=True) if share.any()
        }

    def painted(self, grid: VolumeGrid, values: Mapping[str, float], *, feature: bool) -> Floats:
        """Mean over each voxel ``grid.shape`` of ``values`` of the tissues; of other tissues 0."""
        result = np.zeros(grid.shape)
        for pair, share in self.volume_fractions(grid).items():
            result += values.get(pair[0 if feature else 1], 0.0) * share
        return result


# --- shapes, in the vessel's coordinates: a towards the plaque, b across, s along -----------------

_R = 1.75
"""Radius of the healthy vessel, mm."""
_WALL = 0.2
"""Thickness of its wall, mm."""
_LUMEN = 1.4
"""Radius of its lumen, mm."""
_HALF = 4.4
"""Half of its length, mm."""
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
"""Plaque of the anatomies that differ elsewhere, mm."""


def _tube(
    radius: float | Callable[[Floats], Floats],
    half: float = _HALF,
    a0: float = 0.0,
    b0: float = 0.0,
) -> Inside:
    """A round tube; its radius may change along it."""

    def inside(a: Floats, b: Floats, s: Floats) -> Bools:
        r = radius(s) if callable(radius) else radius
        return np.asarray((np.hypot(a - a0, b - b0) < r) & (np.abs(s) < half))

    return inside


def _ball(centre: Sequence[float], semi_axes: float | Sequence[float]) -> Inside:
    c, r = centre, np.broadcast_to(np.asarray(semi_axes, float), 3)

    def inside(a: Floats, b: Floats, s: Floats) -> Bools:
        return np.asarray(
            ((a - c[0]) / r[0]) ** 2 + ((b - c[1]) / r[1]) ** 2 + ((s - c[2]) / r[2]) ** 2 < 1.0
        )

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


def _vessel(
    radius: float = _R, lumen: float | Callable[[Floats], Floats] = _LUMEN, half: float = _HALF
) -> list[AnatomyPart]:
    """A healthy vessel: wall, thin intima, lumen."""
    return [
        AnatomyPart("wall", _tube(radius, half)),
        AnatomyPart("fibrous", _tube(radius - _WALL, half)),
        AnatomyPart("lumen", _tube(lumen, half)),
    ]


def _plaque(plaque: Plaque = _PLAQUE) -> list[AnatomyPart]:
    return [
        AnatomyPart("wall", _within_shape(plaque.outer)),
        AnatomyPart("fibrous", _within_shape(plaque.inner)),
        AnatomyPart("lumen", _within_shape(plaque.lumen)),
    ]


def _core(tissue: str = "core", plaque: Plaque = _PLAQUE) -> list[AnatomyPart]:
    return [AnatomyPart(tissue, _within_shape(plaque.core), ("fibrous",))]


def _second(
    distance: float, tilt: float, tissue: str = "lumen", radius: float = 0.95
) -> list[AnatomyPart]:
    """Another vessel next to the first, its axis ``distance`` mm off on the side of the plaque."""
    u = (0.0, math.sin(tilt), math.cos(tilt))
    start, length = (distance, -4.0 * u[1], -4.0 * u[2]), 8.0
    return [
        AnatomyPart("wall", _rod(start, u, radius, length), ("fat",)),
        AnatomyPart(tissue, _rod(start, u, radius - 0.18, length), ("fat", "wall")),
    ]


def _muscle(face: float) -> list[AnatomyPart]:
    """Muscle beyond a plane so far from the axis, on the side away from the plaque."""
    return [AnatomyPart("muscle", lambda a, b, s: a < -face, ("fat",))]


def _narrowing(depth: float, length: float) -> Callable[[Floats], Floats]:
    return lambda s: _LUMEN * (1.0 - depth * np.exp(-0.5 * (s / length) ** 2))


def _struts(a: Floats, b: Floats, s: Floats) -> Bools:
    """A stent of zigzag rings of 0.11 mm wire (square section) against the lumen's wall, three
    links between rings."""
    r, turn = np.hypot(a, b), np.arctan2(b, a) / (2.0 * math.pi)
    shell = np.abs(r - (_LUMEN - 0.075)) < 0.055
    zigzag = 0.3 * np.abs(np.mod(6.0 * turn, 1.0) * 4.0 - 2.0)
    rings = np.abs(np.mod(s + zigzag + 0.7, 1.4) - 0.7) < 0.065
    links = np.abs(np.mod(3.0 * turn + 0.25, 1.0) - 0.5) * 2.0 * math.pi / 3.0 * r < 0.055
    return np.asarray(shell & (rings | links) & (np.abs(s) < 3.1))


def _bulging(s: Floats) -> Floats:
    return 1.15 * np.exp(-0.5 * (s / 1.2) ** 2)


_BRANCH = (0.0, math.sin(0.85), math.cos(0.85))
"""Direction of the branch, (x, y, z)."""
_THIN = replace(_PLAQUE, cap_thickness=0.12)
"""The plaque under a thin cap."""
_PAPER = Plaque(position=(0.0, 0.0, 0.0))
"""The plaque of the paper."""
_PAPER_HU = {"wall": 63.5, "fibrous": 103.2, "lumen": 480.0, "core": 41.1}
"""What the tissues of that plaque read on its scanner, HU."""
_BENT = VesselAxis((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), 3.5)
"""A vessel along z that bends towards x, radius in mm."""

_HEALTHY = tuple(_vessel())
"""Parts of a healthy vessel."""
_WITH_PLAQUE = tuple(_plaque())
"""Parts of a vessel with plaque."""

ANATOMIES: dict[str, Anatomy] = {
    "healthy": Anatomy("a healthy vessel in fat, nothing more", (), _HEALTHY),
    "core": Anatomy("a necrotic core in an eccentric plaque", _WITH_PLAQUE, tuple(_core())),
    "lipid_core": Anatomy("a core of lipid", _WITH_PLAQUE, tuple(_core("lipid"))),
    "thin_cap": Anatomy(
        "a necrotic core under a cap of 0.12 mm", tuple(_plaque(_THIN)), tuple(_core(plaque=_THIN))
    ),
    "ulcer": Anatomy(
        "a crater of 1 mm in the plaque, open to the lumen",
        _WITH_PLAQUE,
        (AnatomyPart("lumen", _ball((0.55, 0.0, 0.3), (0.85, 0.5, 0.5)), ("fibrous",)),),
    ),
    "thrombus": Anatomy(
        "a thrombus of 1.1 mm on the lumen's wall",
        _HEALTHY,
        (AnatomyPart("thrombus", _ball((-0.4, 1.05, -0.2), 0.55), ("lumen",)),),
    ),
    "flap": Anatomy(
        "a dissection: a flap of 0.28 mm across the lumen",
        _HEALTHY,
        (
            AnatomyPart(
                "flap",
                lambda a, b, s: (
                    (np.abs(0.8 * a + 0.6 * b - 0.25 - 0.08 * s) < 0.14) & (np.abs(s) < 2.6)
                ),
                ("lumen",),
            ),
        ),
    ),
    "calcification": Anatomy(
        "a spotty calcification of 0.5 mm in the wall",
        _HEALTHY,
        (AnatomyPart("calcium", _ball((-1.1, -1.1, 0.4), 0.25), ("wall", "fibrous")),),
    ),
    "stent": Anatomy(
        "a stent of wires of 0.11 mm", _HEALTHY, (AnatomyPart("metal", _struts, ("lumen",)),)
    ),
    "inflamed_30": Anatomy(
        "fat inflamed by 30 HU in a ring of 1 mm",
        _HEALTHY,
        (AnatomyPart("inflamed", _tube(_R + 1.0), ("fat",)),),
    ),
    "inflamed_15": Anatomy(
        "fat inflamed by 15 HU in a ring of 1 mm",
        _HEALTHY,
        (AnatomyPart("inflamed", _tube(_R + 1.0), ("fat",)),),
        hu={"inflamed": -75.0},
    ),
    "branch": Anatomy(
        "a side branch of 1.6 mm",
        _HEALTHY,
        (
            AnatomyPart("wall", _rod((0.0, 0.0, -0.5), _BRANCH, 0.8, 4.9), ("fat",)),
            AnatomyPart("lumen", _rod((0.0, 0.0, -0.5), _BRANCH, 0.6, 4.9)),
        ),
    ),
    "touching": Anatomy(
        "a vessel that touches, crossing at a right angle",
        _HEALTHY,
        tuple(_second(_R + 0.95, math.pi / 2)),
    ),
    "second": Anatomy(
        "a vein of 1.6 mm alongside, 0.8 mm off",
        _HEALTHY,
        tuple(_second(_R + 0.8 + 0.8, 0.15, tissue="vein", radius=0.8)),
    ),
    "muscle_2mm": Anatomy(
        "a necrotic core, muscle 2 mm off the vessel",
        (*_WITH_PLAQUE, *_muscle(_R + 2.0)),
        tuple(_core()),
    ),
    "muscle_touching": Anatomy(
        "a necrotic core, muscle that touches", (*_WITH_PLAQUE, *_muscle(_R)), tuple(_core())
    ),
    "paper_muscle_2mm": Anatomy(
        "the paper's plaque, muscle 2 mm off the vessel",
        (*_plaque(_PAPER), *_muscle(_PAPER.vessel_diameter / 2 + 2.0)),
        tuple(_core(plaque=_PAPER)),
        hu=_PAPER_HU,
    ),
    "paper_muscle_touching": Anatomy(
        "the paper's plaque, muscle that touches",
        (*_plaque(_PAPER), *_muscle(_PAPER.vessel_diameter / 2)),
        tuple(_core(plaque=_PAPER)),
        hu=_PAPER_HU,
    ),
    "stenosis": Anatomy(
        "a round stenosis of 72 %",
        _HEALTHY,
        (
            AnatomyPart(
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
            AnatomyPart("wall", _tube(lambda s: _R + _bulging(s)), ("fat",)),
            AnatomyPart("fibrous", _tube(lambda s: _R - _WALL + _bulging(s)), ("fat", "wall")),
            AnatomyPart("lumen", _tube(lambda s: _LUMEN + _bulging(s))),
        ),
    ),
    "occlusion": Anatomy(
        "an occlusion by thrombus, from the middle on",
        _HEALTHY,
        (AnatomyPart("thrombus", lambda a, b, s: s > 0.35 + 0.15 * a, ("lumen",)),),
    ),
    "low_enhancement": Anatomy(
        "a necrotic core, the lumen enhanced to 160 HU",
        _WITH_PLAQUE,
        tuple(_core()),
        hu={"lumen": 160.0},
    ),
    "curved": Anatomy(
        "a necrotic core in a vessel bent with 3.5 mm", _WITH_PLAQUE, tuple(_core()), line=_BENT
    ),
}
"""By name."""


def anatomy(name: str) -> Anatomy:
    """One of :data:`ANATOMIES`.

    Raises:
        ValueError: an unknown name.
    """
    return ANATOMIES[choice("anatomy", name, ANATOMIES)]
