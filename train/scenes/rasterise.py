"""Scenes on grids: area-averaged voxel values, and batches of random scenes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from train.scenes.drawing import draw_scene
from train.scenes.paint_kernels import KINDS, QUADRIC_COLUMNS, TABLE_ROWS, TUBE_COLUMNS, paint
from train.scenes.scene import SceneConfig, Solid, TrainingScene, Triple

__all__ = ["SceneBatch", "check_grid", "random_scene", "rasterise"]

# Spacing in mm of the tables over z, well below the shortest bump.
TABLE_STEP = 0.1
# A core with less than this inside the grid does not count as one, mm³: half of the smallest ellipsoid drawn.
SMALLEST_CORE = 0.05


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
    scenes: tuple[TrainingScene, ...]


def rasterise(scene: TrainingScene, shape: tuple[int, int, int], spacing_mm: Triple) -> NDArray[np.float32]:
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

    def add(solid: Solid, tube: int) -> None:
        quadrics.append((*solid.centre, *solid.rotation, *solid.semi_axes, solid.exponent, solid.cap, diagonal))
        bodies.append((KINDS[solid.kind], tube, len(quadrics) - 1))
        values.append(solid.hu)
        roles.append("core" if solid.kind == "core" else solid.kind)

    for solid in scene.tissues:
        add(solid, -1)
    for index, vessel in enumerate(scene.vessels):
        table = vessel.tables(z)
        steepest = math.sqrt(1.0 + float(np.max(table[2] ** 2 + table[3] ** 2)))
        # Calcifications may stick out of the vessel.
        outside = max((max(s.semi_axes) for s in vessel.solids if s.kind == "calcification"), default=0.0)
        reach = steepest * (float(table[4].max()) + outside + 1.5 * diagonal)
        turns = [(math.cos(a), math.sin(a)) for a in (vessel.angle, vessel.lumen_angle)]
        tubes.append((vessel.aspect, *turns[0], vessel.wall, *turns[1], reach))
        tables.append(table)
        bodies += [(KINDS[name], index, -1) for name in ("wall", "fibrous", "lumen")]
        values += [vessel.wall_hu, vessel.fibrous_hu, vessel.lumen_hu]
        roles += ["wall", "surround" if vessel.cores else "fibrous", "lumen"]
        for solid in vessel.solids:
            add(solid, index)
    for solid in scene.free:
        add(solid, -1)
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
    shape, spacing = check_grid(grid_shape, spacing_mm)
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


def check_grid(shape: Any, spacing: Any) -> tuple[tuple[int, int, int], Triple]:
    """Shape and spacing as tuples; ``ValueError`` unless they are three positive numbers each."""
    if len(shape) != 3 or any(int(n) != n or n < 1 for n in shape):
        raise ValueError(f"grid_shape must be three positive whole numbers (nz, ny, nx), got {shape!r}")
    if len(spacing) != 3 or not all(math.isfinite(s) and s > 0 for s in spacing):
        raise ValueError(f"spacing_mm must be three positive numbers (dz, dy, dx), got {spacing!r}")
    return (int(shape[0]), int(shape[1]), int(shape[2])), (float(spacing[0]), float(spacing[1]), float(spacing[2]))
