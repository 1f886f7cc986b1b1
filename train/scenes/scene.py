"""The 3-D scenes in HU that a learned prior is trained with: what they consist of, and how they are distributed.

A scene (:class:`TrainingScene`) is drawn in mm and HU, without a grid (:mod:`train.scenes.drawing`);
:mod:`train.scenes.rasterise` gives its area-averaged voxel values, and :mod:`train.scenes.held_out` a family of its own
to select checkpoints with. It holds either vessels (bent, tilted tubes: wall, fibrous layer, eccentric and narrowing
lumen; soft inclusions, called cores, and calcifications in the fibrous layer) or free-standing bodies of random
contrast, in fat or in a tissue like muscle. Cores have contrasts of both signs. The plaque of the paper
(:mod:`torchpcct.scene.plaque.plaque`) is never drawn: outer sections are centred on a smooth centreline, with no
``cos²`` bulge to one side, and :func:`is_paper_family` rejects what comes close in the parameters that both share.

A vessel scene without a core still has a *virtual* one where it could have been: a core of contrast 0 that leaves no
trace in the image but has a mask, so that a loss on ROI contrast also sees true contrasts of 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from train.scenes.paint_kernels import TABLE_ROWS

__all__ = ["Bump", "SceneConfig", "Solid", "Texture", "TrainingScene", "Vessel", "is_paper_family"]

Range = tuple[float, float]
Triple = tuple[float, float, float]
IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
# Plane waves in a texture: enough for a marginal distribution that is close to Gaussian.
WAVES = 64


@dataclass(frozen=True)
class SceneConfig:
    """Distribution of the scenes: ranges in mm or HU, uniform unless said otherwise, and probabilities.

    Args:
        fat, muscle: HU of the background; muscle_probability: of the second one.
        free_probability: of free-standing bodies instead of vessels; free_count, free_contrast, free_size: their
            number, contrast to the background, and semi-axes (log-uniform); wide_probability: of free bodies with
            wide_contrast instead, like bone, air or contrast agent.
        second_vessel: probability of a second vessel.
        second_tissue: probability of fat beside muscle, or muscle beside fat, behind the vessels or bodies;
            tissue_size: semi-axes (log-uniform) of the ellipsoid in which it lies, so large that the inset sees one
            gently curved border.
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
    wide_probability: float = 0.3
    wide_contrast: Range = (-900.0, 1500.0)
    second_vessel: float = 0.25
    second_tissue: float = 0.3
    tissue_size: Range = (4.0, 30.0)
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
    wander: Range = (-1.0, 1.0)
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
class Solid:
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
        solids: cores, then calcifications.
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
    solids: tuple[Solid, ...] = ()

    @property
    def cores(self) -> tuple[Solid, ...]:
        """The cores, virtual ones (contrast 0) included."""
        return tuple(s for s in self.solids if s.kind == "core")

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
class TrainingScene:
    """All parameters of a scene, mm and HU, about the grid's centre.

    Args:
        background: HU.
        textures: of the background (and free bodies) and of wall, fibrous layer and cores, or empty.
        tissues: bodies of a second tissue behind all others.
    """

    background: float
    vessels: tuple[Vessel, ...] = ()
    free: tuple[Solid, ...] = ()
    textures: tuple[Texture, ...] = ()
    tissues: tuple[Solid, ...] = ()

    @property
    def cores(self) -> tuple[Solid, ...]:
        """Cores of all vessels, virtual ones included."""
        return tuple(core for vessel in self.vessels for core in vessel.cores)


def is_paper_family(scene: TrainingScene) -> bool:
    """Whether a scene is close to the paper's plaque in everything that describes it.

    True if some vessel has an outer diameter within 20 % of 3.36 mm and holds, maybe among others, a core of any shape
    whose semi-axes are, in order of size, all within 30 % of 0.6, 0.985, 0.985 mm, with a contrast of −90…−30 HU. That
    is one in a hundred of the scenes that are drawn. (The first of the trainings behind the shipped weights had half of
    these widths and single ellipsoids only, which is so rare a scene that the rule rejected nothing.)
    """
    return any(
        -90.0 <= core.contrast <= -30.0
        and all(abs(a / b - 1.0) <= 0.3 for a, b in zip(sorted(core.semi_axes), (0.6, 0.985, 0.985), strict=True))
        for vessel in scene.vessels
        if abs(vessel.diameter / 3.36 - 1.0) <= 0.2
        for core in vessel.cores
    )
