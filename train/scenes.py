"""Random 3-D scenes in HU for the training of a learned prior, and a held-out family to select checkpoints with.

A scene (:class:`Scene`) is drawn in mm and HU, without a grid; :func:`rasterise` gives its area-averaged voxel values.
It holds either vessels (bent, tilted tubes: wall, fibrous layer, eccentric and narrowing lumen; soft inclusions, called
cores, and calcifications in the fibrous layer) or free-standing bodies of random contrast, in fat or in a tissue like
muscle. Cores have contrasts of both signs. The plaque of the paper (:mod:`torchpcct.scene.plaque`) is never drawn:
outer sections are centred on a smooth centreline, with no ``cos²`` bulge to one side, and :func:`is_paper_family`
rejects what comes close in the parameters that both constructions share.

A vessel scene without a core still has a *virtual* one where it could have been: a core of contrast 0 that leaves no
trace in the image but has a mask, so that a loss on ROI contrast also sees true contrasts of 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage

from train._shapes import KINDS, QUADRIC_COLUMNS, TABLE_ROWS, TUBE_COLUMNS, paint

__all__ = [
    "Bump",
    "Scene",
    "SceneBatch",
    "SceneConfig",
    "Texture",
    "ValidationScenes",
    "Vessel",
    "Volume",
    "draw_scene",
    "is_paper_family",
    "random_scene",
    "rasterise",
    "validation_scenes",
]

Range = tuple[float, float]
Triple = tuple[float, float, float]
IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
# Spacing in mm of the tables over z, well below the shortest bump.
TABLE_STEP = 0.1
# A core with less than this inside the grid does not count as one, mm³: half of the smallest ellipsoid drawn.
SMALLEST_CORE = 0.05
# Plane waves in a texture: enough for a marginal distribution that is close to Gaussian.
WAVES = 64


@dataclass(frozen=True)
class SceneConfig:
    """Distribution of the scenes: ranges in mm or HU, uniform unless said otherwise, and probabilities.

    Args:
        fat, muscle: HU of the background; muscle_probability: of the second one.
        free_probability: of free-standing bodies instead of vessels; free_count, free_contrast, free_size: their
            number, contrast to the background, and semi-axes (log-uniform).
        second_vessel: probability of a second vessel.
        diameter, wall, wall_hu, fibrous_hu: outer diameter, thickness and HU of the layers.
        lumen_hu, unenhanced_hu, unenhanced_probability: HU of the lumen with and without contrast agent.
        tilt: largest angle to z in degrees.
        aspect: ratio of the outer section's axes.
        lumen_fraction, lumen_aspect, eccentricity: lumen diameter over inner diameter; ratio of its axes; displacement
            over the largest possible one.
        narrowing, swelling: amplitudes of the Gaussians along z by which the lumen narrows and the outer radius varies,
            relative; bump_width: their standard deviation.
        wander, wander_width: amplitudes and widths of the Gaussians that bend the centreline.
        core_probability: in vessel scenes; core_counts: relative frequency of 1, 2, 3 cores.
        core_size, core_contrast: semi-axes and magnitude of the contrast to the fibrous layer, log-uniform;
            core_negative: probability of a negative contrast.
        cap: smallest distance of core and lumen.
        exponent: of superquadrics ``Σ |xᵢ / aᵢ|ᵖ = 1``, log-uniform.
        calcification_probability, calcification_hu, calcification_size: 1 or 2 of them; size log-uniform.
        texture_probability, texture_sd, texture_length: of a Gaussian random field per tissue; length is the standard
            deviation of its Gaussian autocorrelation, log-uniform.
    """

    fat: Range = (-105.0, -55.0)
    muscle: Range = (0.0, 60.0)
    muscle_probability: float = 0.15
    free_probability: float = 0.15
    free_count: tuple[int, int] = (2, 6)
    free_contrast: Range = (-150.0, 300.0)
    free_size: Range = (0.3, 3.0)
    second_vessel: float = 0.25
    diameter: Range = (2.0, 5.0)
    wall: Range = (0.1, 0.6)
    wall_hu: Range = (0.0, 100.0)
    fibrous_hu: Range = (40.0, 140.0)
    lumen_hu: Range = (150.0, 500.0)
    unenhanced_hu: Range = (30.0, 60.0)
    unenhanced_probability: float = 0.1
    tilt: float = 40.0
    aspect: Range = (0.8, 1.0)
    lumen_fraction: Range = (0.3, 0.9)
    lumen_aspect: Range = (0.6, 1.0)
    eccentricity: Range = (0.0, 0.95)
    narrowing: Range = (0.0, 0.6)
    swelling: Range = (-0.15, 0.2)
    bump_width: Range = (0.8, 4.0)
    wander: Range = (-0.6, 0.6)
    wander_width: Range = (2.0, 5.0)
    core_probability: float = 0.7
    core_counts: tuple[float, ...] = (0.65, 0.25, 0.1)
    core_size: Range = (0.3, 2.0)
    core_contrast: Range = (10.0, 120.0)
    core_negative: float = 0.6
    cap: Range = (0.05, 0.4)
    exponent: Range = (2.5, 8.0)
    calcification_probability: float = 0.25
    calcification_hu: Range = (300.0, 1800.0)
    calcification_size: Range = (0.1, 0.8)
    texture_probability: float = 0.3
    texture_sd: Range = (0.0, 15.0)
    texture_length: Range = (0.3, 2.0)


@dataclass(frozen=True)
class Bump:
    """A Gaussian ``amplitude · exp(−(z − centre)² / 2 width²)``; mm, amplitude in mm or relative."""

    amplitude: float
    centre: float
    width: float

    def __call__(self, z: NDArray[np.float64]) -> NDArray[np.float64]:
        return self.amplitude * np.exp(-0.5 * ((z - self.centre) / self.width) ** 2)


@dataclass(frozen=True)
class Volume:
    """A superquadric ``Σ |xᵢ / aᵢ|ᵖ ≤ 1``; an ellipsoid for ``exponent`` 2.

    Args:
        kind: ``"core"``, ``"calcification"`` (both in the frame of a vessel) or ``"free"``.
        shape: ``"ellipsoid"``, ``"superquadric"``, ``"crescent"``, ``"rod"`` or ``"tube"``: how it was drawn.
        hu: its value.
        centre: mm: ``(x, y, z)`` if free, otherwise ``(u, w)`` in the plane normal to the vessel and z of the foot.
        semi_axes: mm.
        rotation: rows of the rotation into its own axes.
        cap: distance that a core keeps from the lumen, mm.
        contrast: of a core to the fibrous layer, of a free body to the background; HU.
    """

    kind: str
    shape: str
    hu: float
    centre: Triple
    semi_axes: Triple
    exponent: float = 2.0
    rotation: tuple[float, ...] = IDENTITY
    cap: float = 0.0
    contrast: float = 0.0


@dataclass(frozen=True)
class Vessel:
    """A bent tube; lengths in mm, angles in rad.

    Args:
        position: ``(x, y)`` of the centreline at z = 0, before ``wander``.
        slope: ``(dx/dz, dy/dz)``.
        diameter: outer diameter, the long axis of the section, before ``swelling``.
        aspect, angle: ratio of the section's axes; direction of the long one.
        lumen_radius, lumen_aspect, lumen_angle: likewise for the lumen, before ``narrowing``.
        eccentricity, eccentric_angle: displacement of the lumen over the largest possible one, and its direction.
        wander_x, wander_y, narrowing, swelling: sums of Gaussians along z.
        volumes: cores, then calcifications.
    """

    position: tuple[float, float]
    slope: tuple[float, float]
    diameter: float
    aspect: float
    angle: float
    wall: float
    wall_hu: float
    fibrous_hu: float
    lumen_hu: float
    lumen_radius: float
    lumen_aspect: float
    lumen_angle: float
    eccentricity: float
    eccentric_angle: float
    wander_x: tuple[Bump, ...] = ()
    wander_y: tuple[Bump, ...] = ()
    narrowing: tuple[Bump, ...] = ()
    swelling: tuple[Bump, ...] = ()
    volumes: tuple[Volume, ...] = ()

    @property
    def cores(self) -> tuple[Volume, ...]:
        """The cores, virtual ones (contrast 0) included."""
        return tuple(v for v in self.volumes if v.kind == "core")

    def tables(self, z: NDArray[np.float64]) -> NDArray[np.float64]:
        """Centre, slope, radius and lumen at heights ``z``: ``(len(TABLE_ROWS), len(z))``."""
        out = np.empty((len(TABLE_ROWS), z.size))
        out[0] = self.position[0] + self.slope[0] * z + sum(b(z) for b in self.wander_x)
        out[1] = self.position[1] + self.slope[1] * z + sum(b(z) for b in self.wander_y)
        out[2] = np.gradient(out[0], z)
        out[3] = np.gradient(out[1], z)
        radius = 0.5 * self.diameter * (1.0 + sum(b(z) for b in self.swelling))
        inner = radius * self.aspect - self.wall
        narrow = np.clip(1.0 - sum(b(z) for b in self.narrowing), 0.25, 1.0)
        # At least 0.03 mm of fibrous layer: a swelling may be negative.
        lumen = np.minimum(self.lumen_radius * narrow, inner - 0.03)
        shift = self.eccentricity * (inner - lumen)
        out[4] = radius
        out[5] = shift * math.cos(self.eccentric_angle)
        out[6] = shift * math.sin(self.eccentric_angle)
        out[7] = lumen
        out[8] = lumen * self.lumen_aspect
        return out


@dataclass(frozen=True)
class Texture:
    """A stationary Gaussian random field of unit variance as a sum of plane waves, times an SD in HU.

    Args:
        sd: HU.
        length: standard deviation in mm of the Gaussian autocorrelation.
        seed: of the waves.
    """

    sd: float
    length: float
    seed: int

    def field(self, shape: tuple[int, int, int], spacing: Triple) -> NDArray[np.float32]:
        """Voxel averages ``(nz, ny, nx)`` in HU; grids with other spacings sample the same field."""
        rng = np.random.default_rng(self.seed)
        waves = rng.normal(size=(3, WAVES)) / self.length
        phases = np.exp(2j * np.pi * rng.random(WAVES))
        factors = []
        for n, step, k in zip(shape, spacing, waves, strict=True):
            position = (np.arange(n) - 0.5 * (n - 1)) * step
            factors.append((np.exp(1j * np.outer(position, k)) * np.sinc(k * step / (2 * np.pi))).astype(np.complex64))
        fz, fy, fx = factors
        left = ((phases.astype(np.complex64) * fz)[:, None, :] * fy[None]).reshape(-1, WAVES)
        # Re(left · fxᵀ) as one real product
        left, right = np.concatenate([left.real, -left.imag], 1), np.concatenate([fx.real, fx.imag], 1)
        # By PyTorch, whose threads a data loader limits; NumPy's BLAS has its own.
        field = torch.from_numpy(left) @ torch.from_numpy(right * np.float32(self.sd * math.sqrt(2.0 / WAVES))).T
        return field.numpy().reshape(shape)


@dataclass(frozen=True)
class Scene:
    """All parameters of a scene, mm and HU, about the grid's centre.

    Args:
        background: HU.
        textures: of the background (and free bodies) and of wall, fibrous layer and cores, or empty.
    """

    background: float
    vessels: tuple[Vessel, ...] = ()
    free: tuple[Volume, ...] = ()
    textures: tuple[Texture, ...] = ()

    @property
    def cores(self) -> tuple[Volume, ...]:
        """Cores of all vessels, virtual ones included."""
        return tuple(core for vessel in self.vessels for core in vessel.cores)

    @property
    def contrast(self) -> float:
        """Contrast in HU of the first core to its fibrous layer; 0 without a core."""
        return self.cores[0].contrast if self.cores else 0.0


@dataclass(frozen=True)
class SceneBatch:
    """Rasterised scenes.

    Args:
        image: ``(batch, nz, ny, nx)`` float32, HU: averages over the voxels.
        core: likewise, volume fraction of all cores, of the virtual ones too (then ``has_core`` is false, contrast 0).
        surround: likewise, volume fraction of the fibrous layer of the vessels that hold these cores.
        has_core: ``(batch,)`` bool: a core of a contrast other than 0, at least 0.05 mm³ of it inside the grid.
        contrast: ``(batch,)`` float32, HU: of the first core to its fibrous layer, 0 without one; also where the core
            lies outside the grid.
        scenes: parameters, one object per scene; HU of every body are in there.
    """

    image: torch.Tensor
    core: torch.Tensor
    surround: torch.Tensor
    has_core: torch.Tensor
    contrast: torch.Tensor
    scenes: tuple[Scene, ...]


@dataclass(frozen=True)
class ValidationScenes:
    """Held-out plaques, each at several core contrasts with all else equal.

    Args:
        image: ``(scenes, contrasts, nz, ny, nx)`` float32, HU.
        contrasts: ``(contrasts,)`` HU of the core to its fibrous layer.
        core: ``(scenes, nz, ny, nx)`` float32, volume fraction of the core.
        core_roi: likewise, 0 or 1: voxels wholly inside the core.
        fibrous_roi: likewise, 0 or 1: voxels at most 1.5 mm from the core that lie, with all their 26 neighbours,
            wholly inside fibrous tissue (or, where that leaves fewer than 20, that lie wholly inside without them).
        scenes: parameters at the first contrast.
    """

    image: torch.Tensor
    contrasts: torch.Tensor
    core: torch.Tensor
    core_roi: torch.Tensor
    fibrous_roi: torch.Tensor
    scenes: tuple[Scene, ...]


def is_paper_family(scene: Scene) -> bool:
    """Whether a scene is close to the paper's plaque in everything that describes it.

    True if some vessel has an outer diameter within 10 % of 3.36 mm and holds exactly one core, an ellipsoid whose
    semi-axes are, in order of size, all within 20 % of 0.6, 0.985, 0.985 mm, with a contrast of −70…−35 HU.
    """
    for vessel in scene.vessels:
        cores = vessel.cores
        if len(cores) != 1 or cores[0].shape != "ellipsoid" or not -70.0 <= cores[0].contrast <= -35.0:
            continue
        ratios = [a / b for a, b in zip(sorted(cores[0].semi_axes), (0.6, 0.985, 0.985), strict=True)]
        if abs(vessel.diameter / 3.36 - 1.0) <= 0.1 and all(abs(ratio - 1.0) <= 0.2 for ratio in ratios):
            return True
    return False


class _Draw:
    """Random numbers of one scene."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)

    def __call__(self, range_: Range) -> float:
        low, high = range_
        return float(low + (high - low) * self.rng.random())

    def log(self, range_: Range) -> float:
        return math.exp(self((math.log(range_[0]), math.log(range_[1]))))

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


def draw_scene(seed: int, extent_mm: Triple, config: SceneConfig | None = None) -> Scene:
    """A random scene for an inset of ``extent_mm`` = ``(z, y, x)``, outside the paper's family.

    Depends on the seed and on the extent only, not on voxels. Positions are uniform in the inset (vessel axes in its
    inner 84 %), so bodies may be cut by its border.
    """
    config = config if config is not None else SceneConfig()
    draw = _Draw(seed)
    while True:
        scene = _draw(draw, extent_mm, config)
        if not is_paper_family(scene):
            return scene


def _draw(draw: _Draw, extent: Triple, config: SceneConfig) -> Scene:
    background = draw(config.muscle if draw.chance(config.muscle_probability) else config.fat)
    vessels: tuple[Vessel, ...] = ()
    free: tuple[Volume, ...] = ()
    if draw.chance(config.free_probability):
        free = tuple(_draw_free(draw, extent, config, background) for _ in range(draw.count(*config.free_count)))
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
    textures: tuple[Texture, ...] = ()
    if draw.chance(config.texture_probability):
        textures = tuple(
            Texture(draw(config.texture_sd), draw.log(config.texture_length), draw.seed()) for _ in range(2)
        )
    return Scene(background, vessels, free, textures)


def _draw_free(draw: _Draw, extent: Triple, config: SceneConfig, background: float) -> Volume:
    shape = ("ellipsoid", "superquadric", "tube")[draw.count(0, 2)]
    axes = [draw.log(config.free_size) for _ in range(3)]
    if shape == "tube":
        # An ellipsoid longer than any inset: a body of slowly varying section.
        axes[2] = 5.0 * max(extent)
    centre = tuple(draw((-0.5 * e, 0.5 * e)) for e in extent[::-1])
    contrast = draw(config.free_contrast)
    return Volume(
        kind="free",
        shape=shape,
        hu=background + contrast,
        centre=(centre[0], centre[1], centre[2]),
        semi_axes=(axes[0], axes[1], axes[2]),
        exponent=draw.log(config.exponent) if shape == "superquadric" else 2.0,
        rotation=draw.rotation(),
        contrast=contrast,
    )


def _bumps(draw: _Draw, extent: Triple, amplitude: Range, width: Range, high: int) -> tuple[Bump, ...]:
    half = 0.5 * extent[0]
    return tuple(Bump(draw(amplitude), draw((-half, half)), draw(width)) for _ in range(draw.count(0, high)))


def _draw_vessel(draw: _Draw, extent: Triple, config: SceneConfig, cores: bool | None) -> Vessel:
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
    volumes: list[Volume] = []
    if cores is not None:
        weights = np.cumsum(config.core_counts) / sum(config.core_counts)
        number = 1 + int(np.searchsorted(weights, draw.rng.random())) if cores else 1
        for _ in range(min(number, len(weights))):
            contrast = draw.log(config.core_contrast) * (-1.0 if draw.chance(config.core_negative) else 1.0)
            contrast = contrast if cores else 0.0
            volumes.append(_draw_core(draw, extent, config, vessel, contrast))
    if draw.chance(config.calcification_probability):
        for _ in range(draw.count(1, 2)):
            (u, w), z, _, _ = _place(draw, extent, vessel, math.pi)
            axes = [draw.log(config.calcification_size) for _ in range(3)]
            volumes.append(
                Volume(
                    kind="calcification",
                    shape="ellipsoid",
                    hu=draw(config.calcification_hu),
                    centre=(u, w, z),
                    semi_axes=(axes[0], axes[1], axes[2]),
                    rotation=draw.rotation(),
                )
            )
    return replace(vessel, volumes=tuple(volumes))


def _place(
    draw: _Draw, extent: Triple, vessel: Vessel, spread: float
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


def _draw_core(draw: _Draw, extent: Triple, config: SceneConfig, vessel: Vessel, contrast: float) -> Volume:
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
    return Volume(
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


def rasterise(scene: Scene, shape: tuple[int, int, int], spacing_mm: Triple) -> NDArray[np.float32]:
    """Image in HU, volume fraction of the cores and of their fibrous layers: ``(3, nz, ny, nx)`` float32."""
    diagonal = math.sqrt(sum(s * s for s in spacing_mm))
    half = 0.5 * shape[0] * spacing_mm[0]
    # A foot lies at most reach · sin(tilt) above or below its point
    pad = 4.0 if scene.vessels else 0.0
    count = math.ceil(2 * (half + pad) / TABLE_STEP) + 1
    z: NDArray[np.float64] = (np.arange(count, dtype=np.float64) - 0.5 * (count - 1)) * TABLE_STEP
    bodies: list[tuple[int, int, int]] = []
    values: list[float] = [scene.background]
    roles: list[str] = [""]
    tubes, tables, quadrics = [], [], []

    def add(volume: Volume, tube: int) -> None:
        quadrics.append(
            (
                *volume.centre,
                *volume.rotation,
                *volume.semi_axes,
                volume.exponent,
                volume.cap,
                diagonal,
            )
        )
        bodies.append((KINDS[volume.kind], tube, len(quadrics) - 1))
        values.append(volume.hu)
        roles.append("core" if volume.kind == "core" else volume.kind)

    for index, vessel in enumerate(scene.vessels):
        table = vessel.tables(z)
        steepest = math.sqrt(1.0 + float(np.max(table[2] ** 2 + table[3] ** 2)))
        angle, lumen_angle = vessel.angle, vessel.lumen_angle
        # Calcifications may stick out of the vessel.
        outside = max((max(v.semi_axes) for v in vessel.volumes if v.kind == "calcification"), default=0.0)
        tubes.append(
            (
                vessel.aspect,
                math.cos(angle),
                math.sin(angle),
                vessel.wall,
                math.cos(lumen_angle),
                math.sin(lumen_angle),
                steepest * (float(table[4].max()) + outside + 1.5 * diagonal),
            )
        )
        tables.append(table)
        bodies += [(KINDS[name], index, -1) for name in ("wall", "fibrous", "lumen")]
        values += [vessel.wall_hu, vessel.fibrous_hu, vessel.lumen_hu]
        roles += ["wall", "surround" if vessel.cores else "fibrous", "lumen"]
        for volume in vessel.volumes:
            add(volume, index)
    for volume in scene.free:
        add(volume, -1)
    groups: list[tuple[str, ...]] = [("core",), ("surround",)]
    if scene.textures:
        groups += [("", "free"), ("wall", "fibrous", "surround", "core")]
    weights = np.array([values] + [[float(role in group) for role in roles] for group in groups])
    maps = paint(
        shape,
        spacing_mm,
        weights,
        np.array(bodies, dtype=np.int64).reshape(-1, 3),
        np.array(tables).reshape(-1, len(TABLE_ROWS), count),
        np.array(tubes).reshape(-1, len(TUBE_COLUMNS)),
        np.array(quadrics).reshape(-1, QUADRIC_COLUMNS),
        float(z[0]),
        TABLE_STEP,
    )
    for texture, weight in zip(scene.textures, maps[3:], strict=True):
        maps[0] += weight * texture.field(shape, spacing_mm)
    return maps[:3]


def random_scene(
    grid_shape: tuple[int, int, int],
    spacing_mm: Triple,
    *,
    generator: torch.Generator,
    config: SceneConfig | None = None,
    size: int = 1,
) -> SceneBatch:
    """A batch of random scenes on a grid.

    One number per scene is taken from ``generator``: a batch of two gives what two batches of one give, and equal
    extents in mm give the same scenes at every voxel size.

    Args:
        grid_shape: ``(nz, ny, nx)``.
        spacing_mm: ``(dz, dy, dx)``.
        generator: of PyTorch, on the CPU.
        config: default :class:`SceneConfig`.
        size: scenes in the batch.

    Raises:
        ValueError: a shape or spacing that is not three positive numbers, or a size below 1.
    """
    shape, spacing = _grid(grid_shape, spacing_mm)
    if size < 1:
        raise ValueError(f"size must be 1 or more, got {size}")
    extent = (shape[0] * spacing[0], shape[1] * spacing[1], shape[2] * spacing[2])
    # The extents of equal insets differ by rounding; without this so would positions drawn in them, in the last digit.
    extent = (round(extent[0], 6), round(extent[1], 6), round(extent[2], 6))
    seeds = torch.randint(2**62, (size,), generator=generator, dtype=torch.int64).tolist()
    scenes = tuple(draw_scene(seed, extent, config) for seed in seeds)
    stacks = torch.empty((3, size, *shape), dtype=torch.float32)
    for index, scene in enumerate(scenes):
        stacks[:, index] = torch.from_numpy(rasterise(scene, shape, spacing))
    voxel = math.prod(spacing)
    inside = stacks[1].sum(dim=(1, 2, 3)) * voxel >= SMALLEST_CORE
    contrast = torch.tensor([scene.contrast for scene in scenes], dtype=torch.float32)
    return SceneBatch(stacks[0], stacks[1], stacks[2], inside & (contrast != 0), contrast, scenes)


def _grid(shape: Any, spacing: Any) -> tuple[tuple[int, int, int], Triple]:
    if len(shape) != 3 or any(int(n) != n or n < 1 for n in shape):
        raise ValueError(f"grid_shape must be three positive whole numbers (nz, ny, nx), got {shape!r}")
    if len(spacing) != 3 or not all(math.isfinite(s) and s > 0 for s in spacing):
        raise ValueError(f"spacing_mm must be three positive numbers (dz, dy, dx), got {spacing!r}")
    return (int(shape[0]), int(shape[1]), int(shape[2])), (float(spacing[0]), float(spacing[1]), float(spacing[2]))


def validation_scenes(
    grid_shape: tuple[int, int, int],
    spacing_mm: Triple,
    *,
    seed: int = 0,
    contrasts: tuple[float, ...] = (-60.0, -30.0, 0.0, 40.0),
    size: int = 8,
) -> ValidationScenes:
    """Plaques for the selection of checkpoints, each with several core contrasts; not the paper's, and not random ones.

    Vessels of 2.6 and 4.4 mm alternate, with a superquadric or a crescent in the fibrous layer; position, orientation,
    eccentricity and HU vary with ``seed``. The vessel's axis at z = 0 lies in the inner third of the inset.

    Raises:
        ValueError: an invalid grid, or one in which a ROI is empty (too coarse or too small for the plaques).
    """
    shape, spacing = _grid(grid_shape, spacing_mm)
    extent = (shape[0] * spacing[0], shape[1] * spacing[1], shape[2] * spacing[2])
    rng = np.random.default_rng(seed)
    images, cores, core_rois, fibrous_rois, scenes = [], [], [], [], []
    for index in range(size):
        draw = _Draw(int(rng.integers(2**62)))
        scene = _validation_scene(draw, extent, large=bool(index % 2), crescent=bool(index // 2 % 2))
        base, weight, fibrous = rasterise(_with_contrast(scene, 0.0), shape, spacing)
        core_roi = weight > 0.99
        near = ndimage.distance_transform_edt(weight < 0.5, sampling=spacing) <= 1.5
        tissue = (fibrous > 0.99) & near
        fibrous_roi = ndimage.binary_erosion(fibrous > 0.99, np.ones((3, 3, 3))) & near
        if fibrous_roi.sum() < 20:
            fibrous_roi = tissue
        if not core_roi.any() or not fibrous_roi.any():
            raise ValueError(
                f"grid {shape} at {spacing} mm leaves no voxel wholly inside core or fibrous tissue of validation "
                f"scene {index}: take smaller voxels or a larger inset"
            )
        images.append(np.stack([base + contrast * weight for contrast in contrasts]))
        cores.append(weight)
        core_rois.append(core_roi.astype(np.float32))
        fibrous_rois.append(fibrous_roi.astype(np.float32))
        scenes.append(_with_contrast(scene, contrasts[0]))
    return ValidationScenes(
        torch.from_numpy(np.stack(images)),
        torch.tensor(contrasts, dtype=torch.float32),
        torch.from_numpy(np.stack(cores)),
        torch.from_numpy(np.stack(core_rois)),
        torch.from_numpy(np.stack(fibrous_rois)),
        tuple(scenes),
    )


def _with_contrast(scene: Scene, contrast: float) -> Scene:
    """The scene with another contrast of all cores."""

    def change(vessel: Vessel) -> Vessel:
        volumes = tuple(
            replace(v, contrast=contrast, hu=vessel.fibrous_hu + contrast) if v.kind == "core" else v
            for v in vessel.volumes
        )
        return replace(vessel, volumes=volumes)

    return replace(scene, vessels=tuple(change(vessel) for vessel in scene.vessels))


def _validation_scene(draw: _Draw, extent: Triple, *, large: bool, crescent: bool) -> Scene:
    diameter = 4.4 if large else 2.6
    wall = 0.25 if large else 0.15
    inner = 0.5 * diameter - wall
    lumen = (0.45 if large else 0.4) * inner
    eccentricity, direction, angle = draw((0.75, 0.95)), draw.angle(), draw.angle()
    edge = lumen - eccentricity * (inner - lumen)  # far side of the lumen, seen from the axis towards the plaque
    thickness = inner - edge
    cap = 0.15
    plaque = direction + math.pi
    c, s = math.cos(plaque), math.sin(plaque)
    z = draw((-0.1, 0.1)) * extent[0]
    if crescent:
        # Tangentially wide, hollowed out by the lumen's cap; the wall side stays fibrous.
        axes = (0.45 * thickness, 0.8 * inner, 0.9 if large else 0.8)
        r, exponent = edge + 0.3 * thickness, 2.0
    else:
        axes = (0.27 * thickness, 0.4 * inner, 0.9 if large else 0.75)
        r, exponent = edge + cap + 0.27 * thickness, 4.0
    fibrous = draw((80.0, 110.0))
    core = Volume(
        kind="core",
        shape="crescent" if crescent else "superquadric",
        hu=fibrous,
        centre=(r * c, r * s, z),
        semi_axes=axes,
        exponent=exponent,
        rotation=(c, s, 0.0, -s, c, 0.0, 0.0, 0.0, 1.0),
        cap=cap,
    )
    tilt = math.tan(math.radians(draw((0.0, 20.0))))
    vessel = Vessel(
        position=(draw((-0.15, 0.15)) * extent[2], draw((-0.15, 0.15)) * extent[1]),
        slope=(tilt * math.cos(angle), tilt * math.sin(angle)),
        diameter=diameter,
        aspect=1.0,
        angle=0.0,
        wall=wall,
        wall_hu=draw((20.0, 60.0)),
        fibrous_hu=fibrous,
        lumen_hu=draw((300.0, 420.0)),
        lumen_radius=lumen,
        lumen_aspect=1.0,
        lumen_angle=0.0,
        eccentricity=eccentricity,
        eccentric_angle=direction,
        volumes=(core,),
    )
    return Scene(draw((-100.0, -80.0)), (vessel,))
