"""Scenes on grids: averages over voxels, of small cells within them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from train.scenes.paint_kernels import (
    HALO,
    INNER,
    LUMEN,
    OUTER,
    QUADRIC,
    QUADRIC_IN_TUBE,
    STENT,
    paint,
)
from train.scenes.scene import COLUMNS, Solid, Tissue, TrainingScene

if TYPE_CHECKING:
    from collections.abc import Sequence

    from train.scenes.paint_kernels import Painting


CELLS = 2
"""Cells along each edge of a voxel: at voxels of 0.2 mm, averages are within a HU rms of
converged ones near faces."""
QUADRIC_COLUMNS = 17
"""Centre (3), rows of the rotation into its own axes (9), semi-axes (3), exponent, cap to the
lumen."""


@dataclass(frozen=True)
class Painted:
    """Averages over the voxels of a grid about the origin, ``(nz, ny, nx)`` float32.

    Args:
        image: HU. data: the same as blurred by focal spot and motion, which is what a scan holds.
        signal, around: volume fractions of the tissues that the scene names so.
    """

    image: NDArray[np.float32]
    data: NDArray[np.float32]
    signal: NDArray[np.float32]
    around: NDArray[np.float32]


def rasterise(
    scene: TrainingScene, shape: tuple[int, int, int], voxel_mm: float, cells: int = CELLS
) -> Painted:
    """A scene on a grid of cubic voxels.

    Args:
        scene: what is painted.
        shape: ``(nz, ny, nx)``.
        voxel_mm: edge of a voxel.
        cells: along each edge of a voxel.
    """
    fine = (shape[0] * cells, shape[1] * cells, shape[2] * cells)
    cell = voxel_mm / cells
    maps = paint(fine, cell, _arrays(scene, cell), int(scene.signal), int(scene.around))
    image = maps[0]
    for texture, weight in zip(scene.textures, maps[3:], strict=False):
        image = image + weight * texture.field(fine, (cell,) * 3)
    widths = (0.0, math.hypot(scene.blur, scene.motion[0]), math.hypot(scene.blur, scene.motion[1]))
    blurred = (
        ndimage.gaussian_filter(image, [w / cell for w in widths], mode="nearest")
        if any(widths)
        else image
    )
    return Painted(*(_averaged(m, cells) for m in (image, blurred, maps[1], maps[2])))


def _averaged(fine: NDArray[np.float32], cells: int) -> NDArray[np.float32]:
    z, y, x = (n // cells for n in fine.shape)
    means: NDArray[np.float32] = fine.reshape(z, cells, y, cells, x, cells).mean(
        (1, 3, 5), dtype=np.float64
    )
    return means.astype(np.float32)


def _mask(tissues: tuple[Tissue, ...]) -> int:
    return sum(1 << int(t) for t in tissues)


def _arrays(scene: TrainingScene, cell: float) -> Painting:
    """What :func:`train.scenes.paint_kernels.paint` reads of a scene, in the order of painting."""
    bodies: list[tuple[int, int, int, int]] = []
    values: list[float] = []
    rows: list[NDArray[np.float64]] = []

    def add(
        kind: int,
        vessel: int,
        tissue: Tissue,
        displaces: tuple[Tissue, ...],
        hu: float,
        row: Sequence[float] = (),
    ) -> None:
        bodies.append((kind, vessel, int(tissue), _mask(displaces)))
        values.append(hu)
        rows.append(np.pad(np.asarray(row, dtype=np.float64), (0, QUADRIC_COLUMNS - len(row))))

    def solid(s: Solid) -> None:
        row = (*s.centre, *s.rotation, *s.semi_axes, s.exponent, s.cap)
        add(
            QUADRIC if s.vessel < 0 else QUADRIC_IN_TUBE, s.vessel, s.tissue, s.displaces, s.hu, row
        )

    outside = (Tissue.BACKGROUND, Tissue.BESIDE, Tissue.INSERT)
    within = (Tissue.WALL, Tissue.FIBROUS, Tissue.LAYER, Tissue.CORE, Tissue.LUMEN)
    for s in scene.beside:
        solid(s)
    for h in scene.halos:
        add(
            HALO,
            h.vessel,
            Tissue.BACKGROUND,
            (),
            h.hu,
            (h.width, 0.55 * h.softness, h.towards, h.one_sided),
        )
    for v, vessel in enumerate(scene.vessels):
        add(OUTER, v, Tissue.WALL, outside, vessel.wall_hu)
    for v, vessel in enumerate(scene.vessels):
        layer = Tissue.LAYER if vessel.holds_core else Tissue.FIBROUS
        add(INNER, v, layer, (Tissue.WALL,), vessel.fibrous_hu)
    for s in scene.cores:
        solid(s)
    for v, vessel in enumerate(scene.vessels):
        add(LUMEN, v, Tissue.LUMEN, within, vessel.lumen_hu)
    for s in scene.solids:
        solid(s)
    for t in scene.stents:
        row = (t.inset, 0.5 * t.wire, t.pitch, float(t.waves), t.amplitude, t.first, t.last)
        add(STENT, t.vessel, Tissue.HARD, tuple(Tissue), t.hu, row)
    reaches = [_reach(scene, v, cell) for v in range(len(scene.vessels))]
    tubes = [
        (
            *(
                math.cos(v.outer_angle),
                math.sin(v.outer_angle),
                math.cos(v.lumen_angle),
                math.sin(v.lumen_angle),
            ),
            *(v.wall, v.along, v.across),
        )
        for v in scene.vessels
    ]
    tables = (
        np.stack([v.table for v in scene.vessels])
        if scene.vessels
        else np.empty((0, len(COLUMNS), 2))
    )
    return (
        tables,
        np.array(tubes, dtype=np.float64).reshape(-1, 7),
        np.array(reaches, dtype=np.float64),
        np.array(bodies, dtype=np.int64).reshape(-1, 4),
        np.array(values, dtype=np.float64),
        np.array(rows).reshape(-1, QUADRIC_COLUMNS),
        float(scene.background),
    )


def _reach(scene: TrainingScene, number: int, cell: float) -> float:
    """Distance from the curve beyond which a vessel and all that lies in its frame leave no
    trace, mm."""
    rows = {name: scene.vessels[number].table[COLUMNS.index(name)] for name in COLUMNS[13:]}
    outer = np.hypot(rows["outer_u"], rows["outer_w"]) + np.maximum(
        rows["outer_a"], rows["outer_b"]
    )
    far = [float(outer.max())]
    far += [
        math.hypot(s.centre[0], s.centre[1]) + math.hypot(*s.semi_axes)
        if max(s.semi_axes) < 50.0
        else 0.0
        for s in (*scene.cores, *scene.solids)
        if s.vessel == number
    ]
    far += [far[0] + h.width + 5.0 * h.softness for h in scene.halos if h.vessel == number]
    return max(far) + 3.0 * cell
