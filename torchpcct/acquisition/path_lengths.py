"""Exact path lengths of rays in the tissues of a scene, averaged over the finite beam of every reading.

A tissue is a body WITHOUT what lies inside it, so the tissues of a scene are disjoint and their path lengths add up to
the chord of the outermost body. They are the columns of the linear model that the limit of
:mod:`torchpcct.metrics.data_limit` rests on.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpcct.acquisition.transmission import sub_rays as sub_rays_of
from torchpcct.detector_window import DetectorWindow
from torchpcct.geometry import ConeBeam
from torchpcct.scene.chords import chord_lengths
from torchpcct.scene.scene import Scene

__all__ = ["tissue_path_lengths"]

_LINES = 1 << 19
"""Lines held at once: their points, directions and chords take about 50 MB."""


def tissue_path_lengths(
    scene: Scene,
    names: Sequence[str | Sequence[str]],
    geometry: ConeBeam,
    window: DetectorWindow | None = None,
    *,
    sub_rays: int = 16,
    focal_spot: tuple[float, float] = (0.0, 0.0),
    view_step: float = 0.0,
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """Mean path length in each tissue over the sub-rays of every reading.

    Args:
        scene: bodies at rest.
        names: for every tissue the name of its body, or several names whose path lengths are added. What lies
            inside a body does not count to it.
        geometry: cone beam.
        window: the cells to compute; None: the whole detector.
        sub_rays: beam samples a reading, one of :data:`torchpcct.acquisition.transmission.SUB_RAY_COUNTS`.
        focal_spot: ``(width, length)`` in mm, along ``e_t`` and z; 0: a point.
        view_step: rad that the gantry turns while a view is read; 0: standing still.
        dtype: of the result; the chords are computed in float64.

    Returns:
        ``(tissues, views, rows, columns)`` in mm.

    Raises:
        ValueError: no names, an unknown or repeated body, a moving scene, a window of other views, a bad ``sub_rays``.
        TypeError: a geometry that is not a cone beam.
    """
    if not isinstance(geometry, ConeBeam):
        raise TypeError(f"geometry must be a ConeBeam, got {type(geometry).__name__}")
    if not scene.is_static:
        raise ValueError("the scene moves: path lengths are those of one place, give scene.with_motion(None)")
    if window is None:
        window = DetectorWindow.full(geometry)
    window.check(geometry)
    used, mixing = _mixing(scene, names)
    shapes = [scene.shapes[b] for b in used]
    active = (focal_spot[0] > 0, focal_spot[1] > 0, True, True, view_step > 0)
    points = sub_rays_of(sub_rays, active)
    out = torch.empty((len(names), *window.shape), dtype=dtype)
    cells = window.rows * window.columns
    step = max(1, _LINES // (cells * len(points)))
    for first in range(0, geometry.views, step):
        views = slice(first, min(first + step, geometry.views))
        origins, directions = _lines(geometry, window, views, points, focal_spot, view_step)
        chords = chord_lengths(shapes, origins.reshape(-1, 3), directions.reshape(-1, 3))
        lengths = mixing @ chords.reshape(len(used), -1, len(points)).mean(-1)
        out[:, views] = torch.from_numpy(lengths).view(len(names), -1, window.rows, window.columns).to(dtype)
    return out


def _mixing(scene: Scene, names: Sequence[str | Sequence[str]]) -> tuple[list[int], Any]:
    """The bodies whose chords are needed, and the ``(tissues, bodies)`` signs that turn chords into path lengths."""
    if isinstance(names, str) or not len(names):
        raise ValueError(f"names must be a non-empty sequence of bodies, got {names!r}")
    signs = np.zeros((len(names), len(scene)))
    seen: set[str] = set()
    parents = scene.parents
    for tissue, group in enumerate(names):
        for name in (group,) if isinstance(group, str) else group:
            if name in seen:
                raise ValueError(f"the body {name!r} is named twice: tissues must not overlap")
            seen.add(name)
            index = scene.index(name)
            signs[tissue, index] += 1.0
            signs[tissue, parents == index] -= 1.0
    used = np.flatnonzero(signs.any(0))
    return used.tolist(), signs[:, used]


def _lines(
    geometry: ConeBeam, window: DetectorWindow, views: slice, points: Any, focal_spot: Any, view_step: float
) -> tuple[Any, Any]:
    """Points and directions of all sub-rays, two ``(views, rows, columns, sub-rays, 3)``; same beam as the readings."""
    beta = geometry.angles[views, None, None, None] + points[:, 4] * view_step
    cos, sin = np.cos(beta), np.sin(beta)
    columns = geometry.column_positions[window.column_indices[views]]
    rows = geometry.row_positions[window.first_row : window.first_row + window.rows]
    u = columns[:, None, :, None] + points[:, 2] * geometry.pitch[1]
    v = rows[None, :, None, None] + points[:, 3] * geometry.pitch[0]
    # Source and cell in the turning frame (along e_r, along e_t, z).
    source_t, source_z = points[:, 0] * focal_spot[0], points[:, 1] * focal_spot[1]
    if geometry.detector == "curved":
        along, across = -geometry.sdd * np.cos(u / geometry.sdd), geometry.sdd * np.sin(u / geometry.sdd) - source_t
    else:
        along, across = np.full_like(u, -geometry.sdd), u - source_t
    shape = np.broadcast_shapes(u.shape, v.shape, beta.shape)
    directions, origins = np.empty((*shape, 3)), np.empty((*shape, 3))
    directions[..., 0] = along * cos - across * sin
    directions[..., 1] = along * sin + across * cos
    directions[..., 2] = v - source_z
    origins[..., 0] = geometry.sod * cos - source_t * sin
    origins[..., 1] = geometry.sod * sin + source_t * cos
    origins[..., 2] = source_z
    return origins, directions
