"""The 3-D scenes in HU that a learned prior is trained with: what they consist of, and how they are
distributed.

A scene (:class:`TrainingScene`) is drawn in mm and HU, without a grid
(:mod:`train.scenes.drawing`); :mod:`train.scenes.rasterise` gives its averages over voxels, and
:mod:`train.scenes.held_out` scenes of other families, which checkpoints are chosen by. It holds
either vessels or free-standing bodies of random contrast, in fat or muscle.

A vessel is a tube about any smooth curve in space: lumen, fibrous layer, wall; healthy or narrowed,
bulging to one side, an aneurysm, occluded, with side branches, touching another. In it and beside
it lie what disease makes: soft cores of both signs of contrast, ulcers, thrombi at the wall and in
the lumen, dissection flaps, calcifications down to 0.3 mm, stents, inflamed fat, strands and
nodules; muscle lies at any distance from it. The plaque of the paper
(:mod:`torchpcct.scene.plaque.plaque`) is never drawn: :func:`is_paper_family` rejects what comes
close to it.

A vessel scene without a core still has a *virtual* one where it could have been: a core of contrast
0 that leaves no trace in the image but has a mask, so that a loss on ROI contrast also sees true
contrasts of 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from enum import IntEnum
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray

from torchpcct.validate import number, numbers, whole

__all__ = ["SceneConfig", "TrainingScene"]

Range = tuple[float, float]
"""Of HU or relative changes, which may be negative."""
Amount: TypeAlias = Range
"""Of what is at least 0."""
Size: TypeAlias = Range
"""Of sizes and ratios, many log-uniform, which are greater than 0."""
Probability: TypeAlias = float
Triple = tuple[float, float, float]
IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
"""Rows of the unit matrix."""
WAVES = 64
"""Plane waves in a texture: enough for a marginal distribution that is close to Gaussian."""


class Tissue(IntEnum):
    """What a part of a voxel is made of; bodies are painted one after the other, and each says
    what it displaces."""

    BACKGROUND = 0
    BESIDE = 1
    """A second tissue beside the vessels, like muscle."""
    WALL = 2
    FIBROUS = 3
    LAYER = 4
    """The fibrous layer of a vessel that holds a core, or could hold one."""
    CORE = 5
    LUMEN = 6
    INSERT = 7
    """Thrombi, flaps, nodules, strands."""
    HARD = 8
    """Calcifications and stents."""


@dataclass(frozen=True)
class SceneConfig:
    """Distribution of the scenes: ranges in mm or HU, uniform unless stated otherwise, and
    probabilities.

    Args:
        fat, muscle: HU of the background; muscle_probability: of the second one.
        free_probability: of free-standing bodies instead of vessels; free_count, free_contrast,
            free_size: their number, contrast to the background, and semi-axes (log-uniform);
            wide_probability: of free bodies with wide_contrast instead, like bone, air or contrast
            agent.
        small_probability: of 1 to 4 free bodies in a scene of vessels, too, of free_contrast and as
            small as nodules; they lie in the background and in the tissue beside.
        beside_probability: of fat beside muscle, or muscle beside fat, behind the vessels or
            bodies; beside_distance: of its face from the wall of the first vessel; beside_size:
            semi-axes (log-uniform) of the ellipsoid in which it lies, so large that the inset sees
            one gently curved border.
        second_vessel: probability of a second vessel; touching: probability that it does; gap:
            distance of the walls of those that do not.
        along_z: probability that a vessel runs within ``tilt`` degrees of z; the others run in any
            direction.
        bend_probability, bend_radius: of strong bends, and their radius of curvature (log-uniform);
            gentle_radius: of all others.
        diameter, wall, wall_hu, fibrous_hu: outer diameter, thickness and HU of the layers;
            plain_probability: that there is no wall of its own.
        lumen_hu, unenhanced_hu, unenhanced_probability: HU of the lumen with and without contrast
            agent; mixing, of the probability mixing_probability: relative change of its HU over the
            inset along the vessel, and from its axis to its border.
        aspect: ratio of the outer section's axes.
        lumen_fraction, lumen_aspect, eccentricity: lumen diameter over inner diameter; ratio of its
            axes; displacement over the largest possible one. wide_lumen, wide_fraction: probability
            of lumens that leave a thin layer only, and their fraction.
        narrowing, swelling: amplitudes of the Gaussians along the vessel by which the lumen narrows
            and the outer radius varies, relative; bump_width: their standard deviation.
            bulge_probability, bulge: of an outer section that grows to one side, and by how much of
            its radius. aneurysm_probability, aneurysm: of a local widening of lumen and wall,
            relative.
        branch_probability: of a side branch; branch_ratio: its diameter over the vessel's.
        core_probability: in vessel scenes; core_counts: relative frequency of 1, 2, 3 cores.
        core_size, core_contrast: semi-axes and magnitude of the contrast to the fibrous layer,
            log-uniform; core_negative: probability of a negative contrast.
        cap: smallest distance of core and lumen.
        exponent: of superquadrics ``Σ |xᵢ / aᵢ|ᵖ = 1``, log-uniform.
        calcification_probability, calcification_hu, calcification_size: 1 to 3 of them in wall and
            layer; size log-uniform; spotty_probability: that they are small and stand in the wall,
            spotty_size: then.
        ulcer_probability, ulcer_size: craters of the lumen in the layer, semi-axes log-uniform.
        thrombus_probability, thrombus_hu, thrombus_size: at the wall, or (a quarter) free in the
            lumen.
        flap_probability, flap_thickness: of a dissection flap; occlusion_probability: of a lumen
            that is filled from one place on, or over a length.
        stent_probability, stent_hu, stent_wire: HU and width of its wires.
        halo_probability, halo_hu, halo_width, halo_softness: of inflamed fat about a vessel: HU
            above the fat, width, standard deviation of its outer border.
        strand_probability, strand_hu: of 1 to 4 strands in fat; nodule_probability, nodule_hu,
            nodule_size: of 1 or 2 nodules beside the vessel.
        texture_probability, texture_sd, texture_length: of a Gaussian random field per tissue;
            length is the standard deviation of its Gaussian autocorrelation, log-uniform.
        blur, motion: standard deviations of the focal spot's blur in the plane, and of motion in
            one direction of the plane, which motion_probability of the scenes have: what the data
            show is blurred, the truth is not.

    Raises:
        TypeError, ValueError: a value that is no probability, range or number of its kind.
    """

    fat: Range = (-105.0, -55.0)
    muscle: Range = (0.0, 70.0)
    muscle_probability: Probability = 0.15
    free_probability: Probability = 0.12
    free_count: tuple[int, int] = (2, 6)
    free_contrast: Range = (-150.0, 300.0)
    free_size: Size = (0.3, 3.0)
    wide_probability: Probability = 0.3
    wide_contrast: Range = (-900.0, 1500.0)
    small_probability: Probability = 0.0
    beside_probability: Probability = 0.45
    beside_distance: Range = (-0.3, 4.0)
    beside_size: Size = (5.0, 40.0)
    second_vessel: Probability = 0.3
    touching: Probability = 0.4
    gap: Amount = (0.1, 2.5)
    along_z: Probability = 0.5
    tilt: float = 40.0
    bend_probability: Probability = 0.25
    bend_radius: Size = (3.0, 9.0)
    gentle_radius: Size = (9.0, 80.0)
    diameter: Size = (2.0, 5.0)
    wall: Amount = (0.1, 0.6)
    wall_hu: Range = (0.0, 110.0)
    fibrous_hu: Range = (40.0, 140.0)
    plain_probability: Probability = 0.08
    lumen_hu: Range = (150.0, 700.0)
    unenhanced_hu: Range = (30.0, 150.0)
    unenhanced_probability: Probability = 0.12
    mixing_probability: Probability = 0.25
    mixing: Range = (-0.25, 0.25)
    aspect: Size = (0.8, 1.0)
    lumen_fraction: Size = (0.3, 0.9)
    wide_lumen: Probability = 0.4
    wide_fraction: Size = (0.8, 0.95)
    lumen_aspect: Size = (0.6, 1.0)
    eccentricity: Amount = (0.0, 0.95)
    narrowing: Range = (0.0, 0.6)
    swelling: Range = (-0.15, 0.2)
    bump_width: Size = (0.8, 4.0)
    bulge_probability: Probability = 0.3
    bulge: Range = (0.15, 0.7)
    aneurysm_probability: Probability = 0.06
    aneurysm: Range = (0.2, 0.8)
    branch_probability: Probability = 0.12
    branch_ratio: Size = (0.35, 0.9)
    core_probability: Probability = 0.6
    core_counts: tuple[float, ...] = (0.65, 0.25, 0.1)
    core_size: Size = (0.3, 2.0)
    core_contrast: Size = (10.0, 140.0)
    core_negative: Probability = 0.65
    cap: Amount = (0.05, 0.4)
    exponent: Size = (2.5, 8.0)
    calcification_probability: Probability = 0.3
    calcification_hu: Range = (300.0, 1800.0)
    calcification_size: Size = (0.15, 0.9)
    spotty_probability: Probability = 0.5
    spotty_size: Size = (0.15, 0.4)
    ulcer_probability: Probability = 0.15
    ulcer_size: Size = (0.25, 1.0)
    thrombus_probability: Probability = 0.15
    thrombus_hu: Range = (20.0, 110.0)
    thrombus_size: Size = (0.25, 1.3)
    flap_probability: Probability = 0.08
    flap_thickness: Size = (0.15, 0.5)
    occlusion_probability: Probability = 0.06
    stent_probability: Probability = 0.06
    stent_hu: Range = (1500.0, 7000.0)
    stent_wire: Size = (0.08, 0.16)
    halo_probability: Probability = 0.25
    halo_hu: Range = (8.0, 45.0)
    halo_width: Size = (0.4, 3.0)
    halo_softness: Size = (0.05, 0.8)
    strand_probability: Probability = 0.15
    strand_hu: Range = (15.0, 110.0)
    nodule_probability: Probability = 0.12
    nodule_hu: Range = (-40.0, 90.0)
    nodule_size: Size = (0.3, 1.2)
    texture_probability: Probability = 0.25
    texture_sd: Amount = (0.0, 15.0)
    texture_length: Size = (0.3, 2.0)
    blur: Amount = (0.03, 0.1)
    motion: Amount = (0.05, 0.3)
    motion_probability: Probability = 0.25

    def __post_init__(self) -> None:
        for field in fields(self):
            value = _checked(field.name, str(field.type), getattr(self, field.name))
            object.__setattr__(self, field.name, value)


def _checked(name: str, kind: str, value: Any) -> object:
    """A value of :class:`SceneConfig` of the kind that its annotation names.

    Raises:
        TypeError, ValueError: it is none.
    """
    if kind == "Probability":
        return number(name, value, low=0.0, high=1.0)
    if kind == "float":
        return number(name, value, low=0.0, high=90.0, unit="°")
    if kind == "tuple[float, ...]":
        found = numbers(name, value, low=0.0)
        if not sum(found) > 0.0:
            raise ValueError(f"{name} must hold a frequency above 0, got {value!r}")
        return found
    low, high = numbers(
        name, value, 2, positive=kind == "Size", low=None if kind == "Range" else 0.0
    )
    if kind == "tuple[int, int]":
        low, high = whole(f"{name}[0]", value[0], 0), whole(f"{name}[1]", value[1], 0)
    if low > high:
        raise ValueError(f"{name} must be a range, the lower end first, got {value!r}")
    return low, high


@dataclass(frozen=True)
class Bump:
    """A Gaussian ``amplitude · exp(−(s − centre)² / 2 width²)``; mm, amplitude in mm or
    relative."""

    amplitude: float
    centre: float
    width: float

    def __call__(self, s: NDArray[np.float64]) -> NDArray[np.float64]:
        return self.amplitude * np.exp(-0.5 * ((s - self.centre) / self.width) ** 2)


@dataclass(frozen=True)
class Solid:
    """A superquadric ``Σ |xᵢ / aᵢ|ᵖ ≤ 1``; an ellipsoid for ``exponent`` 2.

    Args:
        tissue: what it is made of.
        hu: its value.
        centre: mm: ``(x, y, z)``, or ``(u, w, s)`` in the frame of a vessel.
        semi_axes: mm.
        displaces: the tissues in whose place it is painted.
        exponent: p.
        rotation: rows of the rotation into its own axes.
        vessel: number of the vessel in whose frame it lies; -1 for none.
        cap: distance that it keeps from the lumen, mm.
        contrast: of a core to the fibrous layer; HU.
        kind: what it stands for, for records and counts.
    """

    tissue: Tissue
    hu: float
    centre: Triple
    semi_axes: Triple
    displaces: tuple[Tissue, ...]
    exponent: float = 2.0
    rotation: tuple[float, ...] = IDENTITY
    vessel: int = -1
    cap: float = 0.0
    contrast: float = 0.0
    kind: str = ""


@dataclass(frozen=True)
class Stent:
    """Rings of zigzag wire at a radius of a vessel's lumen, joined by straight wires.

    Args:
        vessel: number of the vessel.
        hu: of the wire.
        wire: its width, mm.
        inset: distance of its middle from the lumen's border, mm; negative: in the layer.
        pitch: distance of the rings, mm.
        waves: of a ring around the vessel.
        amplitude: of the zigzag along the vessel, mm.
        first, last: its ends along the vessel, mm.
    """

    vessel: int
    hu: float
    wire: float
    inset: float
    pitch: float
    waves: int
    amplitude: float
    first: float
    last: float


@dataclass(frozen=True)
class Halo:
    """Fat about a vessel that is denser than other fat.

    Args:
        vessel: number of the vessel.
        hu: above the background.
        width: from the outer wall, mm.
        softness: standard deviation of its outer border, mm.
        towards: direction in which it is widest, rad; one_sided: how much narrower it is on the
            other side, 0 … 1.
    """

    vessel: int
    hu: float
    width: float
    softness: float
    towards: float = 0.0
    one_sided: float = 0.0


COLUMNS = (
    "x",
    "y",
    "z",
    "tx",
    "ty",
    "tz",
    "ux",
    "uy",
    "uz",
    "wx",
    "wy",
    "wz",
    "s",
    "outer_u",
    "outer_w",
    "outer_a",
    "outer_b",
    "lumen_u",
    "lumen_w",
    "lumen_a",
    "lumen_b",
)
"""Rows of a vessel's table over the nodes of its centreline: position, unit tangent, two unit
normals u and w that do not twist, way along the curve; centre and semi-axes of the outer section
and of the lumen in the frame (u, w)."""


@dataclass(frozen=True, eq=False)
class Vessel:
    """A tube about a curve.

    Args:
        table: ``(len(COLUMNS), nodes)``, nodes at equal steps of s.
        outer_angle, lumen_angle: directions of the first semi-axes in the frame (u, w), rad.
        wall: thickness, mm; 0 for none.
        wall_hu, fibrous_hu, lumen_hu: HU.
        along: relative change of the lumen's HU per mm of s; across: from its axis to its border.
        holds_core: whether a core lies in its layer, or could.
        diameter: outer, before all variations, mm.
    """

    table: NDArray[np.float64]
    outer_angle: float
    lumen_angle: float
    wall: float
    wall_hu: float
    fibrous_hu: float
    lumen_hu: float
    along: float = 0.0
    across: float = 0.0
    holds_core: bool = False
    diameter: float = 0.0

    def at(self, s: float) -> NDArray[np.float64]:
        """The table at a place of the curve, ``(len(COLUMNS),)``."""
        return np.array([np.interp(s, self.table[COLUMNS.index("s")], row) for row in self.table])


@dataclass(frozen=True)
class Texture:
    """A stationary Gaussian random field of unit variance as a sum of plane waves, times an SD in
    HU.

    Args:
        sd: HU.
        length: standard deviation in mm of the Gaussian autocorrelation.
        seed: of the waves.
    """

    sd: float
    length: float
    seed: int

    def field(self, shape: tuple[int, int, int], spacing: Triple) -> NDArray[np.float32]:
        """Voxel averages ``(nz, ny, nx)`` in HU; grids with other spacings sample the same
        field."""
        rng = np.random.default_rng(self.seed)
        waves = rng.normal(size=(3, WAVES)) / self.length
        phases = np.exp(2j * np.pi * rng.random(WAVES))
        factors = []
        for n, step, k in zip(shape, spacing, waves, strict=True):
            position = (np.arange(n) - 0.5 * (n - 1)) * step
            factors.append(
                (np.exp(1j * np.outer(position, k)) * np.sinc(k * step / (2 * np.pi))).astype(
                    np.complex64
                )
            )
        fz, fy, fx = factors
        left = ((phases.astype(np.complex64) * fz)[:, None, :] * fy[None]).reshape(-1, WAVES)
        # Re(left · fxᵀ) as one real product
        left, right = (
            np.concatenate([left.real, -left.imag], 1),
            np.concatenate([fx.real, fx.imag], 1),
        )
        # By PyTorch, whose threads a data loader limits; NumPy's BLAS has its own.
        field = (
            torch.from_numpy(left)
            @ torch.from_numpy(right * np.float32(self.sd * math.sqrt(2.0 / WAVES))).T
        )
        return field.numpy().reshape(shape)


@dataclass(frozen=True, eq=False)
class TrainingScene:
    """All parameters of a scene, mm and HU, about the grid's centre.

    Args:
        background: HU.
        beside: bodies behind the vessels.
        vessels: painted layer by layer, so that the lumens of two that meet are one.
        cores: bodies in the fibrous layers, virtual ones (contrast 0) included; lumens are painted
            over them.
        solids: bodies over the lumens, in the order of painting.
        stents, halos: of the vessels.
        textures: of the background and what is beside, and of wall, fibrous layer and cores, or
            empty.
        blur: standard deviation of the focal spot's blur in the plane, mm.
        motion: standard deviations ``(y, x)`` of a further blur, mm.
        signal: the tissue whose contrast to the tissue ``around`` it counts.
    """

    background: float
    beside: tuple[Solid, ...] = ()
    vessels: tuple[Vessel, ...] = ()
    cores: tuple[Solid, ...] = ()
    solids: tuple[Solid, ...] = ()
    stents: tuple[Stent, ...] = ()
    halos: tuple[Halo, ...] = ()
    textures: tuple[Texture, ...] = ()
    blur: float = 0.0
    motion: tuple[float, float] = (0.0, 0.0)
    signal: Tissue = Tissue.CORE
    around: Tissue = Tissue.LAYER

    def without_lesions(self) -> TrainingScene:
        """The same vessels and stents in the same tissues, without what else there is: cores,
        calcifications, ulcers, thrombi, flaps, inflamed fat, nodules, strands and free bodies."""
        tissue = tuple(body for body in self.beside if body.tissue is Tissue.BESIDE)
        return replace(self, beside=tissue, cores=(), solids=(), halos=())


def is_paper_family(scene: TrainingScene) -> bool:
    """Whether a scene is close to the paper's plaque in everything that describes it.

    True if some vessel has an outer diameter within 20 % of 3.36 mm and holds, maybe among others,
    a core of any shape whose semi-axes are, in order of size, all within 30 % of 0.6, 0.985, 0.985
    mm, with a contrast of −90…−30 HU.
    """
    return any(
        -90.0 <= core.contrast <= -30.0
        and all(
            abs(a / b - 1.0) <= 0.3
            for a, b in zip(sorted(core.semi_axes), (0.6, 0.985, 0.985), strict=True)
        )
        and abs(scene.vessels[core.vessel].diameter / 3.36 - 1.0) <= 0.2
        for core in scene.cores
    )
