"""Random drawing of training scenes (:mod:`train.scenes.scene`), a pure function of the seed."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from train.scenes.scene import Bump, Range, SceneConfig, Solid, Texture, TrainingScene, Triple, Vessel, is_paper_family

__all__ = ["Draw", "draw_scene"]


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

    Depends on the seed and on the extent only, not on voxels. Positions are uniform in the inset (vessel axes in its
    inner 84 %), so bodies may be cut by its border.
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
    tissues: tuple[Solid, ...] = ()
    if draw.chance(config.second_tissue):
        tissues = (_draw_tissue(draw, extent, config, background, draw(config.fat if in_muscle else config.muscle)),)
    vessels: tuple[Vessel, ...] = ()
    free: tuple[Solid, ...] = ()
    if draw.chance(config.free_probability):
        contrast = config.wide_contrast if draw.chance(config.wide_probability) else config.free_contrast
        free = tuple(
            _draw_free(draw, extent, config, background, draw(contrast)) for _ in range(draw.count(*config.free_count))
        )
    else:
        cores = draw.chance(config.core_probability)
        vessels = (_draw_vessel(draw, extent, config, cores),)
        if draw.chance(config.second_vessel):
            for _ in range(10):
                other = _draw_vessel(draw, extent, config, None)
                gap = math.dist(other.position, vessels[0].position)
                if gap > 0.5 * (other.diameter + vessels[0].diameter) + 0.3:
                    # Beneath the first, where the two cross elsewhere.
                    vessels = (other, *vessels)
                    break
    count = 2 if draw.chance(config.texture_probability) else 0
    textures = [Texture(draw(config.texture_sd), draw.log(config.texture_length), draw.seed()) for _ in range(count)]
    return TrainingScene(background, vessels, free, tuple(textures), tissues)


def _draw_tissue(draw: Draw, extent: Triple, config: SceneConfig, background: float, hu: float) -> Solid:
    """An ellipsoid whose surface passes through a point of the inset."""
    axes, rotation = draw.axes(config.tissue_size), draw.rotation()
    on = [draw((-0.5 * e, 0.5 * e)) for e in extent[::-1]]
    x, y, z = (p - axes[0] * r for p, r in zip(on, rotation[:3], strict=True))
    return Solid("free", "ellipsoid", hu, (x, y, z), axes, rotation=rotation, contrast=hu - background)


def _draw_free(draw: Draw, extent: Triple, config: SceneConfig, background: float, contrast: float) -> Solid:
    shape = ("ellipsoid", "superquadric", "tube")[draw.count(0, 2)]
    axes = draw.axes(config.free_size)
    if shape == "tube":
        # An ellipsoid longer than any inset: a body of slowly varying section.
        axes = (*axes[:2], 5.0 * max(extent))
    x, y, z = (draw((-0.5 * e, 0.5 * e)) for e in extent[::-1])
    return Solid(
        kind="free",
        shape=shape,
        hu=background + contrast,
        centre=(x, y, z),
        semi_axes=axes,
        exponent=draw.log(config.exponent) if shape == "superquadric" else 2.0,
        rotation=draw.rotation(),
        contrast=contrast,
    )


def _bumps(draw: Draw, extent: Triple, amplitude: Range, width: Range, high: int) -> tuple[Bump, ...]:
    half = 0.5 * extent[0]
    return tuple(Bump(draw(amplitude), draw((-half, half)), draw(width)) for _ in range(draw.count(0, high)))


def _draw_vessel(draw: Draw, extent: Triple, config: SceneConfig, cores: bool | None) -> Vessel:
    """A vessel with cores (true), a virtual core (false) or none (None)."""
    diameter, wall, aspect = draw(config.diameter), draw(config.wall), draw(config.aspect)
    inner = 0.5 * diameter * aspect - wall
    fraction, eccentricity = draw(config.lumen_fraction), draw(config.eccentricity)
    low, high = config.lumen_fraction
    if cores is not None and fraction > (middle := low + 0.6 * (high - low)):
        # Room for a core: the thin-walled vessels are those without one, most often.
        fraction = draw((low, middle))
    tilt, towards = math.tan(math.radians(draw((0.0, config.tilt)))), draw.angle()
    unenhanced = draw.chance(config.unenhanced_probability)
    fibrous = draw(config.fibrous_hu)
    vessel = Vessel(
        position=(draw((-0.42 * extent[2], 0.42 * extent[2])), draw((-0.42 * extent[1], 0.42 * extent[1]))),
        slope=(tilt * math.cos(towards), tilt * math.sin(towards)),
        diameter=diameter,
        aspect=aspect,
        angle=draw.angle(),
        wall=wall,
        wall_hu=draw(config.wall_hu),
        fibrous_hu=fibrous,
        lumen_hu=draw(config.unenhanced_hu if unenhanced else config.lumen_hu),
        lumen_radius=fraction * inner,
        lumen_aspect=draw(config.lumen_aspect) if draw.chance(0.5) else 1.0,
        lumen_angle=draw.angle(),
        eccentricity=eccentricity,
        eccentric_angle=draw.angle(),
        wander_x=_bumps(draw, extent, config.wander, config.wander_width, 2),
        wander_y=_bumps(draw, extent, config.wander, config.wander_width, 2),
        narrowing=_bumps(draw, extent, config.narrowing, config.bump_width, 2),
        swelling=_bumps(draw, extent, config.swelling, config.bump_width, 2),
    )
    solids: list[Solid] = []
    if cores is not None:
        weights = np.cumsum(config.core_counts) / sum(config.core_counts)
        number = 1 + int(np.searchsorted(weights, draw.rng.random())) if cores else 1
        for _ in range(min(number, len(weights))):
            contrast = draw.log(config.core_contrast) * (-1.0 if draw.chance(config.core_negative) else 1.0)
            contrast = contrast if cores else 0.0
            solids.append(_draw_core(draw, extent, config, vessel, contrast))
    if draw.chance(config.calcification_probability):
        for _ in range(draw.count(1, 2)):
            (u, w), z, _, _ = _place(draw, extent, vessel, math.pi)
            axes, hu = draw.axes(config.calcification_size), draw(config.calcification_hu)
            solids.append(Solid("calcification", "ellipsoid", hu, (u, w, z), axes, rotation=draw.rotation()))
    return replace(vessel, solids=tuple(solids))


def _place(
    draw: Draw, extent: Triple, vessel: Vessel, spread: float
) -> tuple[tuple[float, float], float, float, float]:
    """A point of the fibrous layer: ``(u, w)``, z, its direction in rad, and the layer's thickness there in mm.

    ``spread`` is the largest angle to where the layer is thickest, opposite to the lumen's displacement.
    """
    half = 0.5 * extent[0]
    # Mostly where the vessel is inside the inset: the tilted centreline may leave it.
    z = 0.0
    for _ in range(6):
        z = draw((-0.9 * half, 0.9 * half))
        t = vessel.tables(np.array([z, z + 1e-3]))[:, 0]
        if abs(t[0]) < 0.5 * extent[2] and abs(t[1]) < 0.5 * extent[1]:
            break
    inner = t[4] * vessel.aspect - vessel.wall
    direction = vessel.eccentric_angle + math.pi + draw((-spread, spread))
    c, s = math.cos(direction), math.sin(direction)
    # Distance from the vessel's axis to the far side of the lumen, taken as a circle of its mean radius
    edge = max(t[5] * c + t[6] * s + 0.5 * (t[7] + t[8]), 0.0)
    thickness = max(inner - edge, 0.05)
    r = inner - draw((0.3, 0.7)) * thickness
    return (r * c, r * s), z, direction, thickness


def _draw_core(draw: Draw, extent: Triple, config: SceneConfig, vessel: Vessel, contrast: float) -> Solid:
    shape = ("ellipsoid", "superquadric", "crescent", "rod")[draw.count(0, 3)]
    (u, w), z, direction, thickness = _place(draw, extent, vessel, 1.0)
    inner = 0.5 * vessel.diameter * vessel.aspect - vessel.wall
    low, high = config.core_size
    # Radial, tangential, along the vessel; wall and cap cut off what does not fit.
    room = (max(1.3 * low, min(high, 0.8 * thickness)), max(1.3 * low, min(high, 0.9 * inner)), high)
    axes = [draw.log((low, r)) for r in room]
    if shape == "crescent":
        # Wide as the vessel and around the lumen: the lumen's cap hollows it out.
        axes[0] = max(low, draw((0.6, 0.9)) * thickness)
        axes[1] = max(low, draw((0.8, 1.1)) * inner)
    elif shape == "rod":
        axes[1] = min(axes[1], 1.5 * axes[0])
        axes[2] = draw.log((max(low, 0.6 * high), high))
    c, s = math.cos(direction), math.sin(direction)
    rotation: tuple[float, ...] = (c, s, 0.0, -s, c, 0.0, 0.0, 0.0, 1.0)
    if shape in ("ellipsoid", "superquadric") and draw.chance(0.5):
        rotation = draw.rotation()
    return Solid(
        kind="core",
        shape=shape,
        hu=vessel.fibrous_hu + contrast,
        centre=(u, w, z),
        semi_axes=(min(axes[0], high), min(axes[1], high), axes[2]),
        exponent=draw.log(config.exponent) if shape in ("superquadric", "rod") else 2.0,
        rotation=rotation,
        cap=draw(config.cap),
        contrast=contrast,
    )
