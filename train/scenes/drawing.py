"""Random drawing of training scenes (:mod:`train.scenes.scene`), a pure function of the seed."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from train.scenes.scene import (
    Bump,
    Halo,
    Range,
    SceneConfig,
    Solid,
    Stent,
    Texture,
    Tissue,
    TrainingScene,
    Triple,
    Vessel,
    is_paper_family,
)

STEP = 0.2
"""Distance of the nodes of a centreline, mm."""
BEYOND = 1.5
"""How far a centreline goes on outside of the inset, as a factor on its half diagonal."""
LEAST_LAYER = 0.02
"""Thickness of the fibrous layer that is left where the lumen is widest, mm."""
IN_LAYER = (Tissue.FIBROUS, Tissue.LAYER)
"""Tissues of the fibrous layer."""
IN_WALL = (Tissue.WALL, *IN_LAYER, Tissue.CORE)
"""Tissues between the vessel's border and the lumen."""
OUTSIDE = (Tissue.BACKGROUND, Tissue.BESIDE)
"""Tissues beyond the vessel."""


class Draw:
    """Random numbers of one scene."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)

    def __call__(self, range_: Range) -> float:
        low, high = range_
        return float(low + (high - low) * self.rng.random())

    def log(self, range_: Range) -> float:
        return math.exp(self((math.log(range_[0]), math.log(range_[1]))))

    def axes(self, range_: Range) -> Triple:
        """Three semi-axes, log-uniform."""
        return self.log(range_), self.log(range_), self.log(range_)

    def chance(self, probability: float) -> bool:
        return bool(self.rng.random() < probability)

    def count(self, low: int, high: int) -> int:
        return int(self.rng.integers(low, high + 1))

    def angle(self) -> float:
        return self((0.0, 2.0 * math.pi))

    def seed(self) -> int:
        return int(self.rng.integers(2**62))

    def direction(self) -> NDArray[np.float64]:
        """A uniform unit vector ``(x, y, z)``."""
        v = self.rng.normal(size=3)
        return v / np.linalg.norm(v)

    def rotation(self) -> tuple[float, ...]:
        """Rows of a uniform random rotation (from a uniform unit quaternion)."""
        w, x, y, z = (q := self.rng.normal(size=4)) / np.linalg.norm(q)
        return (
            *(1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
            *(2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
            *(2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
        )


def draw_scene(seed: int, extent_mm: Triple, config: SceneConfig | None = None) -> TrainingScene:
    """A random scene for an inset of ``extent_mm`` = ``(z, y, x)``, outside the paper's family.

    Depends on the seed and on the extent only, not on voxels. Vessels pass through the inner part
    of the inset, and what lies in them is most often inside; bodies may be cut by its border.
    """
    config = config if config is not None else SceneConfig()
    draw = Draw(seed)
    while True:
        scene = _draw(draw, extent_mm, config)
        if not is_paper_family(scene):
            return scene


def _draw(draw: Draw, extent: Triple, config: SceneConfig) -> TrainingScene:
    in_muscle = draw.chance(config.muscle_probability)
    background = draw(config.muscle if in_muscle else config.fat)
    if draw.chance(config.free_probability):
        scene = _free_bodies(draw, extent, config, background)
    else:
        scene = _Anatomy(draw, extent, config).scene(background)
    if draw.chance(config.beside_probability):
        hu = draw(config.fat if in_muscle else config.muscle)
        scene = replace(
            scene, beside=(_second_tissue(draw, extent, config, hu, scene.vessels), *scene.beside)
        )
    textured = draw.chance(config.texture_probability)
    textures = [
        Texture(draw(config.texture_sd), draw.log(config.texture_length), draw.seed())
        for _ in range(2 * textured)
    ]
    motion = (0.0, 0.0)
    if draw.chance(config.motion_probability):
        size, angle = draw(config.motion), draw.angle()
        motion = (size * abs(math.sin(angle)), size * abs(math.cos(angle)))
    scene = replace(scene, textures=tuple(textures), blur=draw(config.blur), motion=motion)
    # Drawn last, and without a number of its own where there are none: scenes without them are
    # those of configurations that do not know them.
    if scene.vessels and config.small_probability and draw.chance(config.small_probability):
        small = tuple(
            _free_body(draw, extent, config, background, config.free_contrast, config.nodule_size)
            for _ in range(draw.count(1, 4))
        )
        scene = replace(
            scene, solids=(*scene.solids, *(replace(body, displaces=OUTSIDE) for body in small))
        )
    return scene


def _second_tissue(
    draw: Draw, extent: Triple, config: SceneConfig, hu: float, vessels: tuple[Vessel, ...]
) -> Solid:
    """A wide ellipsoid with its face at a distance from the first vessel, or through a point of
    the inset."""
    axes, rotation = draw.axes(config.beside_size), np.array(draw.rotation()).reshape(3, 3)
    on = np.array([draw((-0.5 * e, 0.5 * e)) for e in extent[::-1]])
    if vessels:
        vessel = vessels[0]
        at = vessel.at(draw((-0.3, 0.3)) * extent[0])
        normal, tangent = draw.direction(), at[3:6]
        normal -= 0.9 * (normal @ tangent) * tangent  # mostly along the vessel
        normal /= np.linalg.norm(normal)
        on = at[:3] + normal * (float(at[15]) + draw(config.beside_distance))
        # The first axis of the ellipsoid points to the vessel.
        rotation = _towards(draw, -normal)
    x, y, z = on - axes[0] * rotation[0]
    return Solid(
        Tissue.BESIDE,
        hu,
        (float(x), float(y), float(z)),
        axes,
        (Tissue.BACKGROUND,),
        rotation=tuple(map(float, rotation.ravel())),
        kind="beside",
    )


def _towards(draw: Draw, first: NDArray[np.float64]) -> NDArray[np.float64]:
    """A random rotation whose first row is given."""
    other = draw.direction()
    second = other - (other @ first) * first
    second /= np.linalg.norm(second)
    return np.stack([first, second, np.cross(first, second)])


def _free_bodies(
    draw: Draw, extent: Triple, config: SceneConfig, background: float
) -> TrainingScene:
    contrast = (
        config.wide_contrast if draw.chance(config.wide_probability) else config.free_contrast
    )
    bodies = tuple(
        _free_body(draw, extent, config, background, contrast, config.free_size)
        for _ in range(draw.count(*config.free_count))
    )
    return TrainingScene(background, solids=bodies, signal=Tissue.INSERT, around=Tissue.BACKGROUND)


def _free_body(
    draw: Draw, extent: Triple, config: SceneConfig, background: float, contrast: Range, size: Range
) -> Solid:
    shape = ("ellipsoid", "superquadric", "tube")[draw.count(0, 2)]
    axes = draw.axes(size)
    if shape == "tube":
        # An ellipsoid longer than any inset: a body of slowly varying section.
        axes = (*axes[:2], 5.0 * max(extent))
    x, y, z = (draw((-0.5 * e, 0.5 * e)) for e in extent[::-1])
    return Solid(
        Tissue.INSERT,
        background + draw(contrast),
        (x, y, z),
        axes,
        tuple(Tissue),
        exponent=draw.log(config.exponent) if shape == "superquadric" else 2.0,
        rotation=draw.rotation(),
        kind="free",
    )


# -- vessels ---------------------------------------------------------------------------------------


def curve(
    start: NDArray[np.float64],
    direction: NDArray[np.float64],
    bends: NDArray[np.float64],
    half: int,
) -> NDArray[np.float64]:
    """Nodes of a smooth curve with a frame that does not twist, ``(12, 2 · half + 1)``: x, tangent,
    u, w.

    Args:
        start, direction: of the middle node.
        bends: ``(2 · half + 1, 2)`` curvatures towards u and w, 1/mm.
        half: nodes on either side.
    """
    nodes = np.empty((2 * half + 1, 12))
    other = np.eye(3)[int(np.argmin(np.abs(direction)))]
    u = other - (other @ direction) * direction
    u /= np.linalg.norm(u)
    frame = np.stack([direction, u, np.cross(direction, u)])
    for sign in (1, -1):
        x, f = np.array(start, dtype=np.float64), frame.copy()
        nodes[half] = np.concatenate([x, f.ravel()])
        for k in range(1, half + 1):
            index = half + sign * k
            a, b = 0.5 * (bends[index] + bends[index - sign])
            turn = sign * STEP * math.hypot(a, b)
            before = f.copy()
            if abs(turn) > 1e-12:
                # The frame turns about the binormal of this piece.
                towards = (a * before[1] + b * before[2]) / math.hypot(a, b)
                c, s = math.cos(turn), math.sin(turn)
                tangent = before[0]
                f[0] = c * tangent + s * towards
                for n in (1, 2):
                    along = before[n] @ towards
                    f[n] = before[n] + along * ((c - 1.0) * towards - s * tangent)
            x = x + 0.5 * sign * STEP * (before[0] + f[0])
            nodes[index] = np.concatenate([x, f.ravel()])
    return nodes.T


def vessel_table(
    line: NDArray[np.float64],
    outer: tuple[NDArray[np.float64] | float, ...],
    lumen: tuple[NDArray[np.float64] | float, ...],
) -> NDArray[np.float64]:
    """The table of a :class:`train.scenes.scene.Vessel` from its :func:`curve` and ``(u, w, a,
    b)`` of its sections."""
    n = line.shape[1]
    s = (np.arange(n) - n // 2) * STEP
    return np.concatenate([line, s[None], *(np.broadcast_to(v, (1, n)) for v in (*outer, *lumen))])


@dataclass
class _Drawn:
    """A vessel and what is known of it while a scene is drawn."""

    vessel: Vessel
    inner: float
    """Mean radius within the wall, mm."""
    thickest: float
    """Direction in which the layer is thickest, rad."""


class _Anatomy:
    """Draws a scene of vessels."""

    def __init__(self, draw: Draw, extent: Triple, config: SceneConfig) -> None:
        self.draw = draw
        self.extent = extent
        self.config = config
        self.half = math.ceil(BEYOND * 0.5 * math.hypot(*extent) / STEP)
        self.s: NDArray[np.float64] = np.arange(-self.half, self.half + 1, dtype=np.float64) * STEP
        self.reach = 0.45 * max(extent)
        """Places along a vessel that lie in the inset, most often."""

    def scene(self, background: float) -> TrainingScene:
        draw, c = self.draw, self.config
        with_core = draw.chance(c.core_probability)
        first = self._vessel(0, holds_core=True)
        vessels = [first]
        if draw.chance(c.second_vessel):
            vessels.append(self._second(first))
        if draw.chance(c.branch_probability):
            vessels.append(self._branch(first))
        cores = self._cores(first, with_core)
        inserts = [
            *(self._occlusion(first) if draw.chance(c.occlusion_probability) else ()),
            *(self._thrombus(first) if draw.chance(c.thrombus_probability) else ()),
            *(self._flap(first) if draw.chance(c.flap_probability) else ()),
        ]
        solids = [
            *inserts,
            *(self._ulcer(first) if draw.chance(c.ulcer_probability) else ()),
            *(self._calcifications(first) if draw.chance(c.calcification_probability) else ()),
        ]
        beside = [
            *(self._strands(background) if draw.chance(c.strand_probability) else ()),
            *(self._nodules(first) if draw.chance(c.nodule_probability) else ()),
        ]
        stents = (self._stent(first),) if draw.chance(c.stent_probability) else ()
        halos = (self._halo(first),) if draw.chance(c.halo_probability) else ()
        signal, around = Tissue.CORE, Tissue.LAYER
        if not with_core and inserts:
            signal, around = Tissue.INSERT, Tissue.LUMEN
        return TrainingScene(
            background,
            beside=tuple(beside),
            vessels=tuple(d.vessel for d in vessels),
            cores=tuple(cores),
            solids=tuple(solids),
            stents=stents,
            halos=halos,
            signal=signal,
            around=around,
        )

    # -- courses and sections ----------------------------------------------------------------------

    def _bumps(self, amplitude: Range, width: Range, most: int) -> NDArray[np.float64]:
        out: NDArray[np.float64] = np.zeros_like(self.s)
        for _ in range(self.draw.count(0, most)):
            out += Bump(
                self.draw(amplitude), self.draw((-self.reach, self.reach)), self.draw(width)
            )(self.s)
        return out

    def _direction(self) -> NDArray[np.float64]:
        draw, c = self.draw, self.config
        if not draw.chance(c.along_z):
            return draw.direction()
        tilt, towards = math.radians(draw((0.0, c.tilt))), draw.angle()
        return np.array(
            [math.sin(tilt) * math.cos(towards), math.sin(tilt) * math.sin(towards), math.cos(tilt)]
        )

    def _course(
        self, start: NDArray[np.float64], direction: NDArray[np.float64], radius: float
    ) -> NDArray[np.float64]:
        draw, c = self.draw, self.config
        strong = draw.chance(c.bend_probability)
        tightest = draw.log(c.bend_radius if strong else c.gentle_radius)
        # A tube that is wider than its bend would meet itself.
        most = 1.0 / max(tightest, 1.25 * radius)
        bends = np.stack(
            [self._bumps((-1.0, 1.0), (2.0, 6.0), 3) + draw((-0.5, 0.5)) for _ in range(2)], 1
        )
        size = np.hypot(*bends.T).max()
        return curve(start, direction, bends * (most / max(size, 1e-9)), self.half)

    def _vessel(
        self,
        number: int,
        holds_core: bool,
        line: NDArray[np.float64] | None = None,
        diameter: Range | None = None,
        lumen_hu: float | None = None,
    ) -> _Drawn:
        draw, c = self.draw, self.config
        size = draw(diameter or c.diameter)
        wall = 0.0 if draw.chance(c.plain_probability) else min(draw(c.wall), 0.25 * size)
        if line is None:
            start = np.array([draw((-0.35 * e, 0.35 * e)) for e in self.extent[::-1]])
            line = self._course(start, self._direction(), 0.5 * size)
        aspect = draw(c.aspect)
        radius = 0.5 * size * (1.0 + self._bumps(c.swelling, c.bump_width, 2))
        widened: NDArray[np.float64] = np.ones_like(self.s)
        if draw.chance(c.aneurysm_probability):
            widened += Bump(draw(c.aneurysm), draw((-self.reach, self.reach)), draw((0.8, 2.5)))(
                self.s
            )
        radius = radius * widened
        eccentric = draw.angle()
        bulge: NDArray[np.float64] = np.zeros_like(self.s)
        if draw.chance(c.bulge_probability):
            bulge = (
                0.25
                * size
                * Bump(draw(c.bulge), draw((-self.reach, self.reach)), draw((0.7, 2.5)))(self.s)
            )
        # The outer section grows opposite to the lumen's displacement.
        outer_angle = eccentric if bulge.any() else draw.angle()
        away = (-math.cos(eccentric), -math.sin(eccentric))
        outer = (bulge * away[0], bulge * away[1], radius + bulge, radius * aspect)
        inner = np.maximum(np.minimum(outer[2], outer[3]) - wall, 0.3)
        fraction = draw(c.wide_fraction if draw.chance(c.wide_lumen) else c.lumen_fraction)
        narrow = np.clip(1.0 - self._bumps(c.narrowing, c.bump_width, 2), 0.25, 1.0)
        lumen = np.minimum(fraction * inner * narrow, inner - LEAST_LAYER)
        shift = draw(c.eccentricity) * (inner - lumen)
        lumen_aspect = draw(c.lumen_aspect) if draw.chance(0.5) else 1.0
        # Where the outer section has grown to one side, the lumen stays where it was.
        centre = tuple(
            o - shift * a - bulge * a * draw((0.6, 1.0))
            for o, a in zip(outer[:2], away, strict=True)
        )
        table = vessel_table(line, outer, (centre[0], centre[1], lumen, lumen * lumen_aspect))
        if lumen_hu is None:
            lumen_hu = draw(
                c.unenhanced_hu if draw.chance(c.unenhanced_probability) else c.lumen_hu
            )
        along, across = 0.0, 0.0
        if draw.chance(c.mixing_probability):
            along, across = draw(c.mixing) / max(self.extent), draw(c.mixing)
        vessel = Vessel(
            table,
            outer_angle,
            draw.angle() if lumen_aspect < 1.0 else 0.0,
            wall,
            draw(c.wall_hu),
            draw(c.fibrous_hu),
            lumen_hu,
            along=along,
            across=across,
            holds_core=holds_core,
            diameter=size,
        )
        return _Drawn(vessel, float(inner.mean()), eccentric + math.pi)

    def _second(self, first: _Drawn) -> _Drawn:
        """Another vessel beside the first, in another direction."""
        draw, c = self.draw, self.config
        size = draw(c.diameter)
        at = first.vessel.at(draw((-self.reach, self.reach)))
        angle = draw.angle()
        sideways = math.cos(angle) * at[6:9] + math.sin(angle) * at[9:12]
        gap = 0.0 if draw.chance(c.touching) else draw(c.gap)
        start = at[:3] + sideways * (max(at[15], at[16]) + 0.5 * size + gap)
        across = draw.direction()
        direction = across - (across @ sideways) * sideways
        # Where they are closest they run beside each other: later bends lead the second away from
        # the first.
        line = self._course(start, direction / np.linalg.norm(direction), 0.5 * size)
        hu = None if draw.chance(0.5) else first.vessel.lumen_hu
        return self._vessel(1, False, line, (size, size), hu)

    def _branch(self, first: _Drawn) -> _Drawn:
        """A vessel that begins in the first."""
        draw, c = self.draw, self.config
        at = first.vessel.at(draw((-self.reach, self.reach)))
        angle, lean = draw.angle(), math.radians(draw((30.0, 90.0)))
        sideways = math.cos(angle) * at[6:9] + math.sin(angle) * at[9:12]
        direction = math.sin(lean) * sideways + math.cos(lean) * at[3:6]
        size = draw(c.branch_ratio) * first.vessel.diameter
        line = self._course(at[:3], direction, 0.5 * size)
        found = self._vessel(2, False, line, (size, size), first.vessel.lumen_hu)
        # One half of the curve is enough: the other would leave the vessel on its far side.
        kept = found.vessel.table[:, self.half :]
        last = kept[:, -1:]
        steps = np.arange(1, self.half + 1) * STEP
        beyond = np.repeat(last, self.half, axis=1)
        beyond[:3] += last[3:6] * steps
        beyond[12] += steps
        table = np.concatenate([kept, beyond], axis=1)
        return replace(found, vessel=replace(found.vessel, table=table))

    # -- what lies in and about them ---------------------------------------------------------------

    def _place(self, first: _Drawn, spread: float) -> tuple[float, float, float, float, float]:
        """A place in the layer: s, direction, and there the radii of lumen and wall's inside, and a
        radius between.

        ``spread`` is the largest angle to where the layer is thickest.
        """
        draw, v = self.draw, first.vessel
        s = 0.0
        for _ in range(6):
            s = draw((-self.reach, self.reach))
            at = v.at(s)
            if all(abs(p) < 0.45 * e for p, e in zip(at[:3], self.extent[::-1], strict=True)):
                break
        at = v.at(s)
        direction = first.thickest + draw((-spread, spread))
        c, d = math.cos(direction), math.sin(direction)
        edge = max(at[17] * c + at[18] * d + 0.5 * (at[19] + at[20]), 0.0)
        outer = at[13] * c + at[14] * d + self._radius(at[15], at[16], direction - v.outer_angle)
        inner = max(outer - v.wall, edge + 0.05)
        return (
            s,
            direction,
            float(edge),
            float(inner),
            float(edge + draw((0.3, 0.7)) * (inner - edge)),
        )

    @staticmethod
    def _radius(a: float, b: float, angle: float) -> float:
        return float(a * b / math.hypot(b * math.cos(angle), a * math.sin(angle)))

    @staticmethod
    def _radial(direction: float) -> tuple[float, ...]:
        """Rotation of a vessel's frame into (outwards, around, along)."""
        c, s = math.cos(direction), math.sin(direction)
        return (c, s, 0.0, -s, c, 0.0, 0.0, 0.0, 1.0)

    def _cores(self, first: _Drawn, real: bool) -> list[Solid]:
        draw, c = self.draw, self.config
        weights = np.cumsum(c.core_counts) / sum(c.core_counts)
        number = 1 + int(np.searchsorted(weights, draw.rng.random())) if real else 1
        return [self._core(first, real) for _ in range(min(number, len(weights)))]

    def _core(self, first: _Drawn, real: bool) -> Solid:
        draw, c = self.draw, self.config
        contrast = draw.log(c.core_contrast) * (-1.0 if draw.chance(c.core_negative) else 1.0)
        shape = ("ellipsoid", "superquadric", "crescent", "rod")[draw.count(0, 3)]
        s, direction, edge, inner, r = self._place(first, 1.0)
        thickness = inner - edge
        low, high = c.core_size
        # Radial, tangential, along the vessel; wall and cap cut off what does not fit.
        room = (
            max(1.3 * low, min(high, 0.8 * thickness)),
            max(1.3 * low, min(high, 0.9 * inner)),
            high,
        )
        axes = [draw.log((low, r_)) for r_ in room]
        if shape == "crescent":
            # Wide as the vessel and around the lumen: the lumen's cap hollows it out.
            axes[0] = max(low, draw((0.6, 0.9)) * thickness)
            axes[1] = max(low, draw((0.8, 1.1)) * inner)
        elif shape == "rod":
            axes[1] = min(axes[1], 1.5 * axes[0])
            axes[2] = draw.log((max(low, 0.6 * high), high))
        rotation = self._radial(direction)
        if shape in ("ellipsoid", "superquadric") and draw.chance(0.5):
            rotation = draw.rotation()
        contrast = contrast if real else 0.0
        return Solid(
            Tissue.CORE,
            first.vessel.fibrous_hu + contrast,
            (r * math.cos(direction), r * math.sin(direction), s),
            (min(axes[0], high), min(axes[1], high), axes[2]),
            (Tissue.LAYER,),
            exponent=draw.log(c.exponent) if shape in ("superquadric", "rod") else 2.0,
            rotation=rotation,
            vessel=0,
            cap=draw(c.cap),
            contrast=contrast,
            kind=shape,
        )

    def _calcifications(self, first: _Drawn) -> list[Solid]:
        draw, c = self.draw, self.config
        found = []
        for _ in range(draw.count(1, 3)):
            spotty = draw.chance(c.spotty_probability)
            s, direction, _, inner, r = self._place(first, math.pi)
            r = inner + draw((-0.3, 0.15)) if spotty else r
            found.append(
                Solid(
                    Tissue.HARD,
                    draw(c.calcification_hu),
                    (r * math.cos(direction), r * math.sin(direction), s),
                    draw.axes(c.spotty_size if spotty else c.calcification_size),
                    IN_WALL if draw.chance(0.5) else (*IN_WALL, *OUTSIDE, Tissue.LUMEN),
                    rotation=draw.rotation(),
                    vessel=0,
                    kind="spotty" if spotty else "calcification",
                )
            )
        return found

    def _ulcer(self, first: _Drawn) -> list[Solid]:
        """A crater from the lumen into layer and core: a plaque that has ruptured, where it
        reaches a core."""
        draw, c = self.draw, self.config
        s, direction, edge, inner, _ = self._place(first, 1.6)
        depth = min(draw.log(c.ulcer_size) * 1.5, 0.95 * max(inner - edge, 0.2))
        r = edge - 0.1 + draw((0.0, 0.3)) * depth
        return [
            Solid(
                Tissue.LUMEN,
                first.vessel.lumen_hu,
                (r * math.cos(direction), r * math.sin(direction), s),
                (depth, draw.log(c.ulcer_size), draw.log(c.ulcer_size)),
                (*IN_LAYER, Tissue.CORE),
                exponent=2.0 if draw.chance(0.6) else draw.log(c.exponent),
                rotation=self._radial(direction),
                vessel=0,
                kind="ulcer",
            )
        ]

    def _thrombus(self, first: _Drawn) -> list[Solid]:
        draw, c = self.draw, self.config
        s, direction, edge, _, _ = self._place(first, math.pi)
        free = draw.chance(0.25)
        at = first.vessel.at(s)
        r = (
            draw((0.0, 0.5)) * edge
            if free
            else edge - draw((-0.3, 0.3)) * draw.log(c.thrombus_size)
        )
        u, w = r * math.cos(direction), r * math.sin(direction)
        if free:
            u, w = u + at[17], w + at[18]
        return [
            Solid(
                Tissue.INSERT,
                draw(c.thrombus_hu),
                (float(u), float(w), s),
                draw.axes(c.thrombus_size),
                (Tissue.LUMEN,),
                exponent=2.0 if draw.chance(0.6) else draw.log(c.exponent),
                rotation=self._radial(direction) if draw.chance(0.5) else draw.rotation(),
                vessel=0,
                kind="free thrombus" if free else "mural thrombus",
            )
        ]

    def _flap(self, first: _Drawn) -> list[Solid]:
        """A thin sheet through the lumen; a false lumen may have less contrast agent."""
        draw, c = self.draw, self.config
        s, direction, _, _, _ = self._place(first, math.pi)
        at = first.vessel.at(s)
        r = draw((-0.5, 0.6)) * min(at[19], at[20])
        thickness, length = draw.log(c.flap_thickness), draw((0.8, 6.0))
        c_, s_ = math.cos(direction), math.sin(direction)
        lean, turn = draw((-0.3, 0.3)), np.array(self._radial(direction)).reshape(3, 3)
        tilt = np.array(
            [[math.cos(lean), 0, -math.sin(lean)], [0, 1, 0], [math.sin(lean), 0, math.cos(lean)]]
        )
        rotation = tuple(map(float, (tilt @ turn).ravel()))
        centre = (float(at[17] + r * c_), float(at[18] + r * s_), s)
        found = [
            Solid(
                Tissue.INSERT,
                draw(c.thrombus_hu),
                centre,
                (0.5 * thickness, 4.0, length),
                (Tissue.LUMEN,),
                exponent=8.0,
                rotation=rotation,
                vessel=0,
                kind="flap",
            )
        ]
        if draw.chance(0.4):
            beyond = (centre[0] + 2.0 * c_, centre[1] + 2.0 * s_, s)
            found.insert(
                0,
                Solid(
                    Tissue.LUMEN,
                    draw((0.3, 0.95)) * first.vessel.lumen_hu,
                    beyond,
                    (2.0, 4.0, length),
                    (Tissue.LUMEN,),
                    exponent=8.0,
                    rotation=rotation,
                    vessel=0,
                    kind="false lumen",
                ),
            )
        return found

    def _occlusion(self, first: _Drawn) -> list[Solid]:
        draw, c = self.draw, self.config
        length = draw((0.5, 2.5)) if draw.chance(0.5) else 100.0
        sign = 1.0 if draw.chance(0.5) else -1.0
        end = draw((-0.6, 0.6)) * self.reach
        return [
            Solid(
                Tissue.INSERT,
                draw(c.thrombus_hu),
                (0.0, 0.0, end + sign * length),
                (60.0, 60.0, length),
                (Tissue.LUMEN,),
                exponent=8.0 if draw.chance(0.7) else 2.0,
                vessel=0,
                kind="occlusion",
            )
        ]

    def _stent(self, first: _Drawn) -> Stent:
        draw, c = self.draw, self.config
        middle, half = draw((-self.reach, self.reach)), draw((1.5, 8.0))
        pitch = draw((0.9, 1.8))
        at = first.vessel.at(middle)
        # Cells of about a millimetre, whatever the lumen's width.
        waves = 2 * max(1, round(math.pi * math.sqrt(at[19] * at[20]) / draw((0.8, 1.6))))
        return Stent(
            0,
            draw(c.stent_hu),
            draw(c.stent_wire),
            draw((-0.1, 0.15)),
            pitch,
            waves,
            draw((0.1, 0.4)) * pitch,
            middle - half,
            middle + half,
        )

    def _halo(self, first: _Drawn) -> Halo:
        draw, c = self.draw, self.config
        sided = draw((0.3, 1.0)) if draw.chance(0.4) else 0.0
        return Halo(
            0,
            draw(c.halo_hu),
            draw.log(c.halo_width),
            draw.log(c.halo_softness),
            draw.angle(),
            sided,
        )

    def _strands(self, background: float) -> list[Solid]:
        draw, c = self.draw, self.config
        found = []
        for _ in range(draw.count(1, 4)):
            x, y, z = (draw((-0.5 * e, 0.5 * e)) for e in self.extent[::-1])
            width = draw.log((0.1, 0.5))
            axes = (width, width * draw.log((1.0, 6.0)), draw((2.0, 12.0)))
            found.append(
                Solid(
                    Tissue.INSERT,
                    background + draw(c.strand_hu),
                    (x, y, z),
                    axes,
                    (Tissue.BACKGROUND,),
                    rotation=draw.rotation(),
                    kind="strand",
                )
            )
        return found

    def _nodules(self, first: _Drawn) -> list[Solid]:
        draw, c = self.draw, self.config
        found = []
        for _ in range(draw.count(1, 2)):
            at = first.vessel.at(draw((-self.reach, self.reach)))
            axes, angle = draw.axes(c.nodule_size), draw.angle()
            far = max(at[15], at[16]) + min(axes) + draw((-0.2, 1.5))
            x, y, z = at[:3] + far * (math.cos(angle) * at[6:9] + math.sin(angle) * at[9:12])
            found.append(
                Solid(
                    Tissue.INSERT,
                    draw(c.nodule_hu),
                    (float(x), float(y), float(z)),
                    axes,
                    OUTSIDE,
                    rotation=draw.rotation(),
                    kind="nodule",
                )
            )
        return found
