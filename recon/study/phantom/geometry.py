"""Lengths of the phantom: of the analytic bodies, and measured on a binary raster of them.

The raster lies along the plaque's own axes: z along the vessel, x from its axis to the plaque.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion
from scipy.spatial import cKDTree

from torchpcct.geometry import VolumeGrid
from torchpcct.scene import Scene
from torchpcct.scene.plaque import Plaque

__all__ = ["analytic_lengths", "assumptions", "raster_lengths"]

_MARGIN_MM = 0.1


def analytic_lengths(scene: Scene, plaque: Plaque) -> dict[str, float]:
    """Lengths in mm of the bodies, named as the paper's."""
    away = 0.5 * (plaque.bulge_length + plaque.vessel_length) / 2.0  # on either side of here there is no plaque
    outer, inner = (float(plaque.section(name, away)[2]) for name in ("outer", "inner"))
    minor, _, major = sorted(2.0 * a for a in plaque.core.semi_axes)
    patient = scene["patient"].shape
    return {
        "core, major axis": major,
        "core, minor axis": minor,
        "fibrous cap": plaque.minimum_cap,
        "wall": outer - inner,
        "vessel diameter": 2.0 * outer,
        "distance from the isocentre": math.hypot(*plaque.position[:2]),
        "patient diameter": 2.0 * float(patient.semi_axes[0]),  # type: ignore[attr-defined]
    }


def assumptions(plaque: Plaque) -> dict[str, float]:
    """Lengths in mm that the paper does not give."""
    throat = 2.0 * float(plaque.section("lumen", 0.0)[3])
    return {
        "core, third axis, along the vessel": 2.0 * plaque.core_semi_axes[2],
        "lumen, diameter beyond the plaque": 2.0 * plaque.inner_radius,
        "lumen, diameter at the plaque's middle": throat,
        "bulge of the wall": plaque.bulge,
        "length of the bulge": plaque.bulge_length,
        "length of the vessel": plaque.vessel_length,
    }


def raster_lengths(scene: Scene, plaque: Plaque, voxel_mm: float, sections: int) -> dict[str, float]:
    """The same lengths on voxels that are what their centre is.

    Core: extents of its voxels. Cap: smallest distance between voxels of core and lumen, less one voxel. Vessel and
    wall: extents of their voxels across the plaque's direction, mean over sections beyond the plaque; distance from the
    isocentre: of the vessel's centre of mass there. Patient: voxels on a line through the isocentre.
    """
    core = _raster(
        scene,
        plaque,
        plaque.core_center,
        tuple(a + plaque.minimum_cap + _MARGIN_MM for a in plaque.core.semi_axes),
        voxel_mm,
    )
    inside = core[0] == scene.index("core")
    width, depth, length = (_extent(inside, axis, voxel_mm) for axis in (2, 1, 0))
    low, high = 0.5 * plaque.bulge_length, 0.5 * plaque.vessel_length
    heights = low + (np.arange(sections) + 0.5) * (high - low) / sections
    diameters, walls, centres = [], [], []
    reach = plaque.vessel_diameter / 2.0 + _MARGIN_MM
    for z in heights:
        labels, points = _raster(scene, plaque, (0.0, 0.0, float(z)), (reach, reach, 0.5 * voxel_mm), voxel_mm)
        vessel = labels != scene.index("patient")
        across = labels[0, :, labels.shape[2] // 2]  # to the plaque's direction
        wall = across == scene.index("wall")
        diameters.append((across != scene.index("patient")).sum() * voxel_mm)
        walls.append(0.5 * wall.sum() * voxel_mm)
        centres.append(np.hypot(*points[vessel].mean(0)[:2]))
    radius = float(scene["patient"].shape.semi_axes[0])  # type: ignore[attr-defined]
    n = 2 * math.ceil((radius + 1.0) / voxel_mm)
    line = np.zeros((n, 3))
    line[:, 0] = (np.arange(n) - (n - 1) / 2) * voxel_mm
    return {
        "core, major axis": max(width, depth, length),
        "core, minor axis": min(width, depth, length),
        "fibrous cap": _cap(scene, core, voxel_mm),
        "wall": float(np.mean(walls)),
        "vessel diameter": float(np.mean(diameters)),
        "distance from the isocentre": float(np.mean(centres)),
        "patient diameter": float((scene.labels(line) >= 0).sum() * voxel_mm),
    }


def _raster(scene: Scene, plaque: Plaque, center: Any, half: Any, voxel_mm: float) -> tuple[Any, Any]:
    """Labels ``(z, y, x)`` of a box in the plaque's frame, and its points in the scanner's."""
    n = [max(1, 2 * math.floor(h / voxel_mm) + 1) for h in half][::-1]
    z, y, x = VolumeGrid(tuple(n), voxel_mm, tuple(center)[::-1]).axes
    zz, yy, xx = np.meshgrid(z, y, x, indexing="ij")
    points = plaque.to_scanner(np.stack([xx, yy, zz], -1))
    return scene.labels(points), points


def _extent(inside: NDArray[np.bool_], axis: int, voxel_mm: float) -> float:
    other = tuple(k for k in range(3) if k != axis)
    return float(np.flatnonzero(inside.any(other)).size * voxel_mm)


def _cap(scene: Scene, raster: tuple[Any, Any], voxel_mm: float) -> float:
    labels, points = raster
    lumen, core = (points[_surface(labels == scene.index(name))] for name in ("lumen", "core"))
    if not len(lumen):
        return math.nan
    return float(cKDTree(lumen).query(core)[0].min() - voxel_mm)


def _surface(inside: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return np.asarray(inside & ~binary_erosion(inside))
