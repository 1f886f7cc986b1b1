"""Scenes on grids: area-averaged voxel values."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from train.scenes.paint_kernels import KINDS, QUADRIC_COLUMNS, TABLE_ROWS, TUBE_COLUMNS, paint
from train.scenes.scene import Solid, TrainingScene, Triple

__all__ = ["rasterise"]

# Spacing in mm of the tables over z, well below the shortest bump.
TABLE_STEP = 0.1


def rasterise(scene: TrainingScene, shape: tuple[int, int, int], spacing_mm: Triple) -> NDArray[np.float32]:
    """Averages over the voxels of a grid about the origin, ``(3, nz, ny, nx)`` float32.

    Image in HU; volume fraction of all cores, of the virtual ones too; volume fraction of the fibrous layers of the
    vessels that hold them.
    """
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
