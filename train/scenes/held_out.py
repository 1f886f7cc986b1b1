"""Held-out plaques that checkpoints are selected with: neither random scenes nor the paper's plaque."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from scipy import ndimage

from train.scenes.drawing import Draw
from train.scenes.rasterise import rasterise
from train.scenes.scene import Solid, TrainingScene, Triple, Vessel

__all__ = ["CHECKPOINT_SEED", "CHECKPOINT_SIZE", "ValidationScenes", "validation_scenes"]

CHECKPOINT_SEED, CHECKPOINT_SIZE = 0, 8
"""Seed and number of the plaques that checkpoints are chosen by: those of any other seed took no part in a training."""


@dataclass(frozen=True)
class ValidationScenes:
    """Held-out plaques, each at several core contrasts with all else equal.

    Args:
        image: ``(scenes, contrasts, nz, ny, nx)`` float32, HU.
        core: ``(scenes, nz, ny, nx)`` float32, volume fraction of the core.
        core_roi: likewise, 0 or 1: voxels wholly inside the core.
        fibrous_roi: likewise, 0 or 1: voxels at most 1.5 mm from the core that lie, with all their 26 neighbours,
            wholly inside fibrous tissue (or, where that leaves fewer than 20, that lie wholly inside without them).
        scenes: parameters at the first contrast.
    """

    image: torch.Tensor
    core: torch.Tensor
    core_roi: torch.Tensor
    fibrous_roi: torch.Tensor
    scenes: tuple[TrainingScene, ...]


def validation_scenes(
    grid_shape: tuple[int, int, int],
    spacing_mm: Triple,
    *,
    seed: int = CHECKPOINT_SEED,
    contrasts: tuple[float, ...] = (-60.0, -30.0, 0.0, 40.0),
    size: int = CHECKPOINT_SIZE,
) -> ValidationScenes:
    """Plaques for the selection of checkpoints, each with several core contrasts; not the paper's, and not random ones.

    Vessels of 2.6 and 4.4 mm alternate, with a superquadric or a crescent in the fibrous layer; position, orientation,
    eccentricity and HU vary with ``seed``. The vessel's axis at z = 0 lies in the inner third of the inset.

    Raises:
        ValueError: an invalid grid, or one in which a ROI is empty (too coarse or too small for the plaques).
    """
    shape, spacing = _checked(grid_shape, spacing_mm)
    extent = (shape[0] * spacing[0], shape[1] * spacing[1], shape[2] * spacing[2])
    rng = np.random.default_rng(seed)
    found, scenes = [], []
    for index in range(size):
        draw = Draw(int(rng.integers(2**62)))
        scene = _validation_scene(draw, extent, large=bool(index % 2), crescent=bool(index // 2 % 2))
        base, weight, fibrous = rasterise(_with_contrast(scene, 0.0), shape, spacing)
        core_roi = weight > 0.99
        near = ndimage.distance_transform_edt(weight < 0.5, sampling=spacing) <= 1.5
        fibrous_roi = ndimage.binary_erosion(fibrous > 0.99, np.ones((3, 3, 3))) & near
        if fibrous_roi.sum() < 20:
            fibrous_roi = (fibrous > 0.99) & near
        if not core_roi.any() or not fibrous_roi.any():
            raise ValueError(
                f"grid {shape} at {spacing} mm leaves no voxel wholly inside core or fibrous tissue of validation "
                f"scene {index}: take smaller voxels or a larger inset"
            )
        each = np.stack([base + contrast * weight for contrast in contrasts])
        found.append((each, weight, core_roi.astype(np.float32), fibrous_roi.astype(np.float32)))
        scenes.append(_with_contrast(scene, contrasts[0]))
    image, core, inside, around = (torch.from_numpy(np.stack(maps)) for maps in zip(*found, strict=True))
    return ValidationScenes(image, core, inside, around, tuple(scenes))


def _checked(shape: Any, spacing: Any) -> tuple[tuple[int, int, int], Triple]:
    """Shape and spacing as tuples; ``ValueError`` unless they are three positive numbers each."""
    if len(shape) != 3 or any(int(n) != n or n < 1 for n in shape):
        raise ValueError(f"grid_shape must be three positive whole numbers (nz, ny, nx), got {shape!r}")
    if len(spacing) != 3 or not all(math.isfinite(s) and s > 0 for s in spacing):
        raise ValueError(f"spacing_mm must be three positive numbers (dz, dy, dx), got {spacing!r}")
    return (int(shape[0]), int(shape[1]), int(shape[2])), (float(spacing[0]), float(spacing[1]), float(spacing[2]))


def _with_contrast(scene: TrainingScene, contrast: float) -> TrainingScene:
    """The scene, whose only solids are cores, with another contrast of all of them."""
    vessels = (
        replace(v, solids=tuple(replace(s, contrast=contrast, hu=v.fibrous_hu + contrast) for s in v.solids))
        for v in scene.vessels
    )
    return replace(scene, vessels=tuple(vessels))


def _validation_scene(draw: Draw, extent: Triple, *, large: bool, crescent: bool) -> TrainingScene:
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
    core = Solid(
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
        solids=(core,),
    )
    return TrainingScene(draw((-100.0, -80.0)), (vessel,))
