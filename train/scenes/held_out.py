"""Held-out plaques: neither random scenes nor the paper's plaque, with regions whose contrast is
known."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy import ndimage

from torchpcct.validate import number
from train.scenes.drawing import STEP, Draw, curve, vessel_table
from train.scenes.rasterise import rasterise
from train.scenes.scene import Solid, Tissue, TrainingScene, Triple, Vessel

if TYPE_CHECKING:
    from collections.abc import Sequence


__all__ = ["HeldOutPlaques", "held_out_plaques"]


@dataclass(frozen=True)
class HeldOutPlaques:
    """Held-out plaques, each at several core contrasts with all else equal.

    Args:
        image: ``(scenes, contrasts, nz, ny, nx)`` float32, HU.
        core: ``(scenes, nz, ny, nx)`` float32, volume fraction of the core.
        core_roi: likewise, 0 or 1: voxels wholly inside the core.
        fibrous_roi: likewise, 0 or 1: voxels at most 1.5 mm from the core that lie, with all their
            26 neighbours, wholly inside fibrous tissue (or, where that leaves fewer than 20, that
            lie wholly inside without them).
        scenes: parameters at the first contrast.
    """

    image: torch.Tensor
    core: torch.Tensor
    core_roi: torch.Tensor
    fibrous_roi: torch.Tensor
    scenes: tuple[TrainingScene, ...]


def held_out_plaques(
    grid_shape: tuple[int, int, int],
    voxel_mm: float,
    *,
    seed: int = 0,
    contrasts: tuple[float, ...] = (-60.0, -30.0, 0.0, 40.0),
    size: int = 8,
) -> HeldOutPlaques:
    """Plaques, each with several core contrasts; not the paper's, and not random ones.

    Vessels of 2.6 and 4.4 mm alternate, with a superquadric or a crescent in the fibrous layer;
    position, orientation, eccentricity and HU vary with ``seed``. The vessel's axis at z = 0 lies
    in the inner third of the inset.

    Raises:
        ValueError: an invalid grid, or one in which a ROI is empty (too coarse or too small for the
            plaques).
    """
    shape = _checked(grid_shape)
    voxel_mm = number("voxel_mm", voxel_mm, positive=True, unit="mm")
    extent = (shape[0] * voxel_mm, shape[1] * voxel_mm, shape[2] * voxel_mm)
    rng = np.random.default_rng(seed)
    found, scenes = [], []
    for index in range(size):
        draw = Draw(int(rng.integers(2**62)))
        scene = _plaque(draw, extent, large=bool(index % 2), crescent=bool(index // 2 % 2))
        painted = rasterise(_with_contrast(scene, 0.0), shape, voxel_mm)
        base, weight, fibrous = painted.image, painted.signal, painted.around
        core_roi = weight > 0.99
        near = ndimage.distance_transform_edt(weight < 0.5, sampling=voxel_mm) <= 1.5
        fibrous_roi = ndimage.binary_erosion(fibrous > 0.99, np.ones((3, 3, 3))) & near
        if fibrous_roi.sum() < 20:
            fibrous_roi = (fibrous > 0.99) & near
        if not core_roi.any() or not fibrous_roi.any():
            raise ValueError(
                f"grid {shape} at {voxel_mm:g} mm leaves no voxel wholly inside core or fibrous "
                f"tissue of plaque {index}: take smaller voxels or a larger inset"
            )
        each = np.stack([base + contrast * weight for contrast in contrasts])
        found.append((each, weight, core_roi.astype(np.float32), fibrous_roi.astype(np.float32)))
        scenes.append(_with_contrast(scene, contrasts[0]))
    image, core, inside, around = (
        torch.from_numpy(np.stack(maps)) for maps in zip(*found, strict=True)
    )
    return HeldOutPlaques(image, core, inside, around, tuple(scenes))


def _checked(shape: Sequence[int]) -> tuple[int, int, int]:
    """Shape of a grid; ``ValueError`` unless it is three positive numbers."""
    if len(shape) != 3 or any(int(n) != n or n < 1 for n in shape):
        raise ValueError(
            f"grid_shape must be three positive whole numbers (nz, ny, nx), got {shape!r}"
        )
    return int(shape[0]), int(shape[1]), int(shape[2])


def _with_contrast(scene: TrainingScene, contrast: float) -> TrainingScene:
    """The scene with another contrast of its core."""
    hu = scene.vessels[0].fibrous_hu + contrast
    return replace(
        scene, cores=tuple(replace(core, contrast=contrast, hu=hu) for core in scene.cores)
    )


def _plaque(draw: Draw, extent: Triple, *, large: bool, crescent: bool) -> TrainingScene:
    diameter = 4.4 if large else 2.6
    wall = 0.25 if large else 0.15
    inner = 0.5 * diameter - wall
    lumen = (0.45 if large else 0.4) * inner
    eccentricity, direction, angle = draw((0.75, 0.95)), draw.angle(), draw.angle()
    # far side of the lumen, seen from the axis towards the plaque
    edge = lumen - eccentricity * (inner - lumen)
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
    tilt = math.radians(draw((0.0, 20.0)))
    towards = np.array(
        [math.sin(tilt) * math.cos(angle), math.sin(tilt) * math.sin(angle), math.cos(tilt)]
    )
    start = np.array([draw((-0.15, 0.15)) * extent[2], draw((-0.15, 0.15)) * extent[1], 0.0])
    half = math.ceil(0.75 * math.hypot(*extent) / STEP)
    line = curve(start, towards, np.zeros((2 * half + 1, 2)), half)
    shift = eccentricity * (inner - lumen)
    radius = 0.5 * diameter
    vessel = Vessel(
        vessel_table(line, (0.0, 0.0, radius, radius), (shift * -c, shift * -s, lumen, lumen)),
        outer_angle=0.0,
        lumen_angle=0.0,
        wall=wall,
        wall_hu=draw((20.0, 60.0)),
        fibrous_hu=fibrous,
        lumen_hu=draw((300.0, 420.0)),
        holds_core=True,
        diameter=diameter,
    )
    core = Solid(
        Tissue.CORE,
        fibrous,
        (r * c, r * s, z),
        axes,
        (Tissue.LAYER,),
        exponent=exponent,
        rotation=(c, s, 0.0, -s, c, 0.0, 0.0, 0.0, 1.0),
        vessel=0,
        cap=cap,
        kind="crescent" if crescent else "superquadric",
    )
    return TrainingScene(draw((-100.0, -80.0)), vessels=(vessel,), cores=(core,))
