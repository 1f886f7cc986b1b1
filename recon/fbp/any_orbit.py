"""FBP of scans that are not quite circles: detectors that tilt, roll and jitter, sources that wobble, mirrored axes.

Every view is resampled onto the upright flat detector of an ideal circle, seen from the view's own source: a projective
map that keeps every line integral. What is left, the source's way off the circle, is a motion of the object, which the
backprojection compensates view by view. Costs one interpolation; slower than a circular scan, and as general as
filtered backprojection gets: an orbit that climbs (a helix) is refused.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.fbp.backproject import check_data
from recon.fbp.fbp import fbp
from torchpcct.geometry import ConeBeam, FanBeam, Geometry, ParallelBeam, VolumeGrid
from torchpcct.validate import whole

__all__ = ["Straightened", "fbp_of_vectors", "straighten"]

Floats = NDArray[np.float64]

CLIMB = 0.05
"""Way of the source along z that makes an orbit a helix, as a share of the height that the rows cover at the axis."""
_TILTED_RAY = 1e-3


class Straightened(NamedTuple):
    """A scan on an ideal circle.

    Attributes:
        sinogram: ``(..., views, [rows,] columns)``, of parallel rays with rows ``(..., slices, views, columns)``.
        geometry: of it.
        motion: displacement of the grid in every view, ``(views, 2)`` (y, x) or ``(views, 3)`` (z, y, x) mm, or None.
        slices: heights of the slices of a parallel scan in mm, else None.
    """

    sinogram: Tensor
    geometry: Geometry
    motion: Floats | None
    slices: Floats | None = None


def straighten(sinogram: Tensor, vectors: Any, *, parallel: bool = False) -> Straightened:
    """Resample a scan of any flat detectors onto an ideal circle about z.

    Args:
        sinogram: line integrals ``(..., views, [rows,] columns)``, float32 or float64.
        vectors: ASTRA's per view, in mm: ``(views, 6)`` without rows, ``(views, 12)`` with rows
            (:mod:`torchpcct.projector.vectors`); of parallel rays the ray's direction in place of the source.
        parallel: whether they are those of parallel rays.

    Raises:
        ValueError: shapes that do not fit, an orbit that climbs, parallel rays that leave the plane, rays that do not
            meet their detector, a detector that faces the source with its edge.
        TypeError: data that are not float32 or float64 tensors.
    """
    v = np.asarray(vectors, dtype=np.float64)
    if v.ndim != 2 or v.shape[1] not in (6, 12) or not np.isfinite(v).all():
        raise ValueError(f"vectors must be finite and of shape (views, 6) or (views, 12), got {v.shape}")
    cone = v.shape[1] == 12
    if not isinstance(sinogram, Tensor) or sinogram.ndim < (3 if cone else 2):
        raise ValueError(f"{v.shape[1]} numbers per view need a sinogram (views, {'rows, ' * cone}columns)")
    shape = tuple(sinogram.shape[-3:] if cone else sinogram.shape[-2:])
    check_data("sinogram", sinogram, (len(v), *shape[1:]))
    if not cone:
        zero = np.zeros((len(v), 1))
        v = np.concatenate([v[:, :2], zero, v[:, 2:4], zero, v[:, 4:], zero, zero, zero, zero + 1.0], axis=1)
        sinogram = sinogram.unsqueeze(-2)
    rows, columns = sinogram.shape[-2:]
    poses = v.reshape(-1, 4, 3)
    work = _parallel if parallel else _divergent
    geometry, motion, positions, slices = work(poses, rows, columns, cone)
    out = _resampled(sinogram, positions)
    if not cone:
        out = out.squeeze(-2)
    elif parallel:
        out = out.transpose(-3, -2)
    if motion is not None and np.abs(motion).max() < 1e-9 * max(1.0, float(np.abs(v).max())):
        motion = None
    return Straightened(out, geometry, motion, slices)


def fbp_of_vectors(
    sinogram: Tensor,
    vectors: Any,
    grid: VolumeGrid,
    kernel: str | Sequence[str] = "standard",
    *,
    parallel: bool = False,
    weights: Any = None,
    outside: float | None = None,
) -> Tensor:
    """Filtered backprojection of a scan that is given by its vectors; see :func:`straighten` and :func:`recon.fbp.fbp`.

    Args:
        sinogram, vectors, parallel: of :func:`straighten`.
        grid: 2-D without rows, else 3-D; of parallel rays its z axis is interpolated from the slices.
        kernel, weights, outside: of :func:`recon.fbp.fbp.fbp`.

    Returns:
        ``(..., *grid.shape)`` mm⁻¹; with a sequence of kernels a leading axis of kernels.

    Raises:
        ValueError, TypeError: as both.
    """
    s = straighten(sinogram, vectors, parallel=parallel)
    if s.slices is None:
        return fbp(s.sinogram, s.geometry, grid, kernel, weights=weights, motion=s.motion, outside=outside)
    if grid.ndim != 3:
        raise ValueError(f"parallel rays with rows need a 3-D grid, got shape {grid.shape}")
    place = np.interp(grid.axes[0], s.slices, np.arange(s.slices.size))
    if grid.axes[0][0] < s.slices[0] - 1e-6 or grid.axes[0][-1] > s.slices[-1] + 1e-6:
        raise ValueError(f"the grid's slices must lie in the rows' {s.slices[0]:g} … {s.slices[-1]:g} mm")
    below = np.minimum(place.astype(int), max(s.slices.size - 2, 0))
    share = torch.from_numpy(place - below).to(s.sinogram)[:, None, None]
    above = torch.from_numpy(np.minimum(below + 1, s.slices.size - 1))
    lines = torch.lerp(s.sinogram[..., torch.from_numpy(below), :, :], s.sinogram[..., above, :, :], share)
    return fbp(lines, s.geometry, grid.slice, kernel, weights=weights, outside=outside)


def _axis_of(low: float, high: float, pitch: float) -> tuple[int, float]:
    """Number of cells of a pitch whose centres cover ``low … high``, and the middle."""
    return whole("cells", math.ceil((high - low) / pitch - 1e-6) + 1), 0.5 * (low + high)


def _divergent(poses: Floats, rows: int, columns: int, cone: bool) -> tuple[Geometry, Floats | None, Floats, None]:
    source, centre, across, up = poses.transpose(1, 0, 2)
    beta = np.arctan2(source[:, 1], source[:, 0])
    radial = np.stack([np.cos(beta), np.sin(beta), 0 * beta], 1)
    tangent = np.stack([-np.sin(beta), np.cos(beta), 0 * beta], 1)
    orbit = np.hypot(source[:, 0], source[:, 1])
    sod, level = float(orbit.mean()), float(source[:, 2].mean())
    depth = ((source - centre) * radial).sum(1)
    if depth.min() <= 0:
        raise ValueError(f"the detector of view {int(depth.argmin())} does not stand behind the axis")
    sdd = float(depth.mean())
    if sdd <= sod:
        raise ValueError(f"the detectors stand {sdd:g} mm from the sources, which turn at {sod:g} mm: before the axis")
    # Where the actual corners meet the ideal plane, seen from the actual source.
    half = np.array([(a * (columns - 1) / 2, b * (rows - 1) / 2) for a in (-1, 1) for b in (-1, 1)])
    corner = centre[:, None] + half[:, :1] * across[:, None] + half[:, 1:] * up[:, None] - source[:, None]
    towards = -(corner * radial[:, None]).sum(-1)
    if towards.min() <= 0:
        raise ValueError("a detector reaches behind its source: are the vectors in the order source, centre, u, v?")
    scale = sdd / towards
    u, w = (corner * tangent[:, None]).sum(-1) * scale, corner[..., 2] * scale
    middle = sdd / depth
    pitch = float(np.median(np.linalg.norm(across, axis=1) * middle))
    count, offset = _axis_of(float(u.min()), float(u.max()), pitch)
    if cone:
        row_pitch = float(np.median(np.linalg.norm(up, axis=1) * middle))
        height = rows * row_pitch * sod / sdd
        climb = float(np.ptp(source[:, 2]))
        if climb > CLIMB * height:
            raise ValueError(
                f"the source climbs by {climb:.2f} mm, the rows cover {height:.2f} mm at the axis: filtered "
                "backprojection of a helix is not provided. Use recon.pwls with Projector(VectorGeometry(…), grid)"
            )
        number, middle_row = _axis_of(float(w.min()), float(w.max()), row_pitch)
        geometry: Any = ConeBeam(beta, sod, sdd, count, number, (row_pitch, pitch), (middle_row, offset))
        v = geometry.row_positions
    else:
        if np.abs(source[:, 2]).max() + np.abs(centre[:, 2]).max() > 0:
            raise ValueError("the vectors of a fan beam lie in the plane z = 0")
        geometry, v = FanBeam(beta, sod, sdd, count, pitch, offset), np.zeros(1)
    rays = -sdd * radial[:, None, None] + geometry.column_positions[:, None] * tangent[:, None, None]
    rays = rays + v[:, None, None] * np.array([0.0, 0.0, 1.0])
    # source + λ ray = centre + a · across + b · up
    matrix = np.stack([np.broadcast_to(x[:, None, None], rays.shape) for x in (across, up)] + [-rays], axis=-1)
    if np.abs(np.linalg.det(matrix)).min() < 1e-9 * sdd * pitch:
        raise ValueError("a detector faces its source with its edge")
    right = np.broadcast_to((source - centre)[:, None, None], rays.shape)
    places = np.linalg.solve(matrix, right[..., None])[..., :2, 0]
    ideal = sod * radial + np.array([0.0, 0.0, level])
    shift = (ideal - source)[:, ::-1]
    shift[:, 0] -= level  # an orbit about another height is a grid that is lower by as much
    return geometry, np.ascontiguousarray(shift if cone else shift[:, 1:]), places, None


def _parallel(poses: Floats, rows: int, columns: int, cone: bool) -> tuple[Geometry, None, Any, Floats | None]:
    ray, centre, across, up = poses.transpose(1, 0, 2)
    ray = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    if np.abs(ray[:, 2]).max() > _TILTED_RAY:
        raise ValueError(
            f"the rays leave the plane of rotation by up to {math.degrees(math.asin(np.abs(ray[:, 2]).max())):.2f}°: "
            "slices cannot be reconstructed one by one; filtered backprojection of tilted rays is not provided"
        )
    beta = np.arctan2(-ray[:, 1], -ray[:, 0])
    tangent = np.stack([-np.sin(beta), np.cos(beta), 0 * beta], 1)

    def in_plane(x: Floats) -> Floats:
        return np.stack([(x * tangent).sum(-1), x[..., 2]], -1)

    c, a, b = in_plane(centre), in_plane(across), in_plane(up)
    matrix = np.stack([a, b], -1)
    if np.abs(np.linalg.det(matrix)).min() < 1e-9:
        raise ValueError("a detector faces its rays with its edge")
    half = np.array([(x * (columns - 1) / 2, y * (rows - 1) / 2) for x in (-1, 1) for y in (-1, 1)])
    corner = c[:, None] + half[:, :1] * a[:, None] + half[:, 1:] * b[:, None]
    pitch = float(np.median(np.linalg.norm(a, axis=1)))
    count, offset = _axis_of(float(corner[..., 0].min()), float(corner[..., 0].max()), pitch)
    geometry = ParallelBeam(beta, count, pitch, offset)
    heights: Any = np.zeros(1)
    if cone:
        row_pitch = float(np.median(np.linalg.norm(b, axis=1)))
        number, middle = _axis_of(float(corner[..., 1].min()), float(corner[..., 1].max()), row_pitch)
        heights = (np.arange(number) - (number - 1) / 2) * row_pitch + middle
    t, z = np.meshgrid(geometry.column_positions, heights)
    target = np.stack([t, z], -1)[None] - c[:, None, None]
    places = np.linalg.solve(np.broadcast_to(matrix[:, None, None], (*target.shape, 2)), target[..., None])[..., 0]
    return geometry, None, places, heights if cone else None


def _resampled(sinogram: Tensor, places: Floats) -> Tensor:
    """``(..., views, rows, columns)`` at ``places (views, rows', columns', 2)``, in columns and rows from the centre.

    Cubic interpolation; beyond the edges the outermost reading is repeated.
    """
    views, rows, columns = sinogram.shape[-3:]
    lead = sinogram.shape[:-3]
    scale = np.array([max((columns - 1) / 2, 0.5), max((rows - 1) / 2, 0.5)])
    grid = torch.from_numpy(places / scale).to(sinogram)
    flat = sinogram.reshape(-1, views, rows, columns).transpose(0, 1)
    if rows == 1:  # equal rows make a plane of a line
        flat = flat.expand(-1, -1, 4, -1)
        grid = torch.stack([grid[..., 0], torch.zeros_like(grid[..., 0])], -1)
    out = torch.nn.functional.grid_sample(flat, grid, mode="bicubic", padding_mode="border", align_corners=True)
    return out.transpose(0, 1).reshape(*lead, *out.shape[:1], *out.shape[2:])
