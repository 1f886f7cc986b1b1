"""FBP of scans that are not quite circles: detectors that tilt, roll and jitter, sources that
wobble, mirrored axes.

Every view is resampled onto the upright flat detector of an ideal circle, seen from the view's own
source: a projective map that keeps every line integral. What is left, the source's way off the
circle, is a motion of the object, which the backprojection compensates view by view. Costs one
interpolation; slower than a circular scan, and as general as filtered backprojection gets: an orbit
that climbs (a helix) is refused.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.analytic.backproject import check_data
from torchpcct.geometry import ConeBeam, FanBeam, Geometry, ParallelBeam, VolumeGrid
from torchpcct.validate import checked, whole
from torchpcct.vector_geometry import VectorGeometry

__all__ = ["IdealCircle", "ideal_circle", "rebin_to_circle"]

Floats = NDArray[np.float64]

CLIMB = 0.05
"""Way of the source along z that makes an orbit a helix, as a share of the height that the rows
cover at the axis."""
_TILTED_RAY = 1e-3
"""Sine of a parallel ray's angle with the plane of the circle that is no rounding."""


class IdealCircle(NamedTuple):
    """The ideal circle next to a scan, and the way there.

    Attributes:
        geometry: of the circle.
        motion: displacement of the grid in every view, ``(views, 2)`` (y, x) or ``(views, 3)`` (z,
            y, x) mm, or None.
        slices: heights of the slices of a parallel scan with rows in mm, else None.
        rows: positions of the ideal rows in mm; of a detector without rows 0.
        maps: ``(views, 3, 3)``: (column position, row position, 1) on the ideal detector in mm to
            homogeneous (columns, rows, 1) from the centre of the actual one.
    """

    geometry: Geometry
    motion: Floats | None
    slices: Floats | None
    rows: Floats
    maps: Floats


@checked
def ideal_circle(geometry: VectorGeometry) -> IdealCircle:
    """The ideal circle about z that a scan of any flat detectors can be resampled onto.

    Raises:
        ValueError: an orbit that climbs, parallel rays that leave the plane, a detector before the
            axis.
    """
    work = _parallel if geometry.parallel else _divergent
    found = work(geometry.poses, geometry.rows or 1, geometry.columns, geometry.rows is not None)
    far = float(np.abs(geometry.vectors).max())
    still = found.motion is None or np.abs(found.motion).max() < 1e-9 * far
    return found._replace(motion=None) if still else found


@checked
def rebin_to_circle(sinogram: Tensor, geometry: VectorGeometry) -> tuple[Tensor, IdealCircle]:
    """Resample a scan of any flat detectors onto an ideal circle about z.

    Args:
        sinogram: line integrals ``(..., *geometry.shape)``, float32 or float64.
        geometry: of the scan.

    Returns:
        ``(..., views, [rows,] columns)``, of parallel rays with rows ``(..., slices, views,
        columns)``; and the circle.

    Raises:
        ValueError: a shape that does not fit; see :func:`ideal_circle`.
        TypeError: data that are not float32 or float64 tensors.
    """
    check_data("sinogram", sinogram, geometry.shape)
    circle = ideal_circle(geometry)
    flat = geometry.rows is None
    out = _resampled(sinogram.unsqueeze(-2) if flat else sinogram, circle)
    if flat:
        out = out.squeeze(-2)
    elif geometry.parallel:
        out = out.transpose(-3, -2)
    return out, circle


@checked
def at_slices(sinogram: Tensor, slices: Floats, grid: VolumeGrid) -> Tensor:
    """Sinograms ``(..., z, views, columns)`` of a grid's slices, interpolated between those at the
    heights ``slices``.

    Raises:
        ValueError: a grid without z axis, or beyond the rows.
    """
    if grid.ndim != 3:
        raise ValueError(f"parallel rays with rows need a 3-D grid, got shape {grid.shape}")
    place = np.interp(grid.axes[0], slices, np.arange(slices.size))
    # The outermost rows reach half a row beyond their centres.
    half = 0.5 * float(slices[1] - slices[0]) if slices.size > 1 else 0.0
    slack = 1e-6 * max(half, grid.spacing[0])
    if grid.axes[0][0] < slices[0] - half - slack or grid.axes[0][-1] > slices[-1] + half + slack:
        raise ValueError(
            f"the grid's slices must lie in the rows' {slices[0]:g} … {slices[-1]:g} mm"
        )
    below = np.minimum(place.astype(int), max(slices.size - 2, 0))
    share = torch.from_numpy(place - below).to(sinogram)[:, None, None]
    low, high = (
        sinogram.index_select(-3, torch.from_numpy(at).to(sinogram.device))
        for at in (below, np.minimum(below + 1, slices.size - 1))
    )
    return torch.lerp(low, high, share)


def _axis_of(low: float, high: float, pitch: float) -> tuple[int, float]:
    """Number of cells of a pitch whose centres cover ``low … high``, and the middle."""
    return whole("cells", math.ceil((high - low) / pitch - 1e-6) + 1), 0.5 * (low + high)


def _divergent(poses: Floats, rows: int, columns: int, cone: bool) -> IdealCircle:
    source, centre, across, up = poses.transpose(1, 0, 2)
    beta = np.arctan2(source[:, 1], source[:, 0])
    radial = np.stack([np.cos(beta), np.sin(beta), 0 * beta], 1)
    tangent = np.stack([-np.sin(beta), np.cos(beta), 0 * beta], 1)
    orbit = np.hypot(source[:, 0], source[:, 1])
    sod, level = float(orbit.mean()), float(source[:, 2].mean())
    depth = ((source - centre) * radial).sum(1)
    if depth.min() <= 0:
        raise ValueError(
            f"the detector of view {int(depth.argmin())} does not lie behind its source: are the "
            "vectors in the order source, centre, u, v?"
        )
    sdd = float(depth.mean())
    if sdd <= sod:
        raise ValueError(
            f"the detectors are {sdd:g} mm from the sources, whose orbit has a radius of {sod:g} "
            "mm: they must lie behind the axis; check the vectors"
        )
    # Where the actual corners meet the ideal plane, seen from the actual source.
    half = np.array([(a * (columns - 1) / 2, b * (rows - 1) / 2) for a in (-1, 1) for b in (-1, 1)])
    corner = (
        centre[:, None]
        + half[:, :1] * across[:, None]
        + half[:, 1:] * up[:, None]
        - source[:, None]
    )
    towards = -(corner * radial[:, None]).sum(-1)
    if towards.min() <= 0:
        raise ValueError(
            "part of a detector lies behind its source: are the vectors in the order source, "
            "centre, u, v?"
        )
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
                f"the source climbs by {climb:.2f} mm, the rows cover {height:.2f} mm at the "
                "axis: filtered "
                'backprojection of a helix is not provided. Use the method "pwls" (recon.pwls with '
                "Projector(geometry, grid))"
            )
        number, middle_row = _axis_of(float(w.min()), float(w.max()), row_pitch)
        geometry: ConeBeam | FanBeam = ConeBeam(
            beta, sod, sdd, count, number, (row_pitch, pitch), (middle_row, offset)
        )
        v = geometry.row_positions
    else:
        geometry, v = FanBeam(beta, sod, sdd, count, pitch, offset), np.zeros(1)
    # source + k · ray = centre + a · across + b · up, where the ray goes to a place of the ideal
    # detector.
    upward = np.broadcast_to([0.0, 0.0, 1.0], radial.shape)
    actual, wanted = (
        np.stack([across, up, centre - source], -1),
        np.stack([tangent, upward, -sdd * radial], -1),
    )
    maps = np.linalg.solve(actual, wanted)
    ends = np.array([(x, y, 1.0) for x in geometry.column_positions[[0, -1]] for y in v[[0, -1]]])
    if (maps[:, 2] @ ends.T).min() <= 0:
        raise ValueError(
            "a detector is almost parallel to its rays (edge on): are the vectors in the order "
            "source, centre, u, v?"
        )
    ideal = sod * radial + np.array([0.0, 0.0, level])
    shift = (ideal - source)[:, ::-1]
    shift[:, 0] -= level  # an orbit about another height is a grid that is lower by as much
    return IdealCircle(
        geometry, np.ascontiguousarray(shift if cone else shift[:, 1:]), None, v, maps
    )


def _parallel(poses: Floats, rows: int, columns: int, cone: bool) -> IdealCircle:
    ray, centre, across, up = poses.transpose(1, 0, 2)
    ray = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    if np.abs(ray[:, 2]).max() > _TILTED_RAY:
        raise ValueError(
            "the rays leave the plane of rotation by up to "
            f"{math.degrees(math.asin(np.abs(ray[:, 2]).max())):.2f}°: "
            "slices cannot be reconstructed one by one. Filtered backprojection of tilted rays is "
            "not provided: use "
            'the method "pwls" (recon.pwls with Projector(geometry, grid))'
        )
    beta = np.arctan2(-ray[:, 1], -ray[:, 0])
    tangent = np.stack([-np.sin(beta), np.cos(beta), 0 * beta], 1)

    def in_plane(x: Floats) -> Floats:
        return np.stack([(x * tangent).sum(-1), x[..., 2]], -1)

    c, a, b = in_plane(centre), in_plane(across), in_plane(up)
    matrix = np.stack([a, b], -1)
    half = np.array([(x * (columns - 1) / 2, y * (rows - 1) / 2) for x in (-1, 1) for y in (-1, 1)])
    corner = c[:, None] + half[:, :1] * a[:, None] + half[:, 1:] * b[:, None]
    pitch = float(np.median(np.linalg.norm(a, axis=1)))
    count, offset = _axis_of(float(corner[..., 0].min()), float(corner[..., 0].max()), pitch)
    geometry = ParallelBeam(beta, count, pitch, offset)
    heights: NDArray[np.float64] = np.zeros(1)
    if cone:
        row_pitch = float(np.median(np.linalg.norm(b, axis=1)))
        number, middle = _axis_of(
            float(corner[..., 1].min()), float(corner[..., 1].max()), row_pitch
        )
        heights = (np.arange(number, dtype=np.float64) - (number - 1) / 2) * row_pitch + middle
    inverse = np.linalg.inv(matrix)
    maps = np.zeros((len(poses), 3, 3))
    maps[:, :2, :2], maps[:, :2, 2], maps[:, 2, 2] = (
        inverse,
        -np.einsum("nij,nj->ni", inverse, c),
        1.0,
    )
    return IdealCircle(geometry, None, heights if cone else None, heights, maps)


def _resampled(sinogram: Tensor, circle: IdealCircle) -> Tensor:
    """``(..., views, rows, columns)`` on the ideal detector, view by view.

    Cubic interpolation; beyond the edges the outermost reading is repeated.
    """
    rows, columns = sinogram.shape[-2:]
    u, v = circle.geometry.column_positions, circle.rows
    place = np.stack([np.tile(u, v.size), np.repeat(v, u.size), np.ones(u.size * v.size)])
    middle = np.array([[(columns - 1) / 2], [(rows - 1) / 2]])
    out = []
    for view, to_actual in enumerate(circle.maps):
        at = to_actual @ place
        at = at[:2] / at[2] + middle
        across, low = _weights(at[0], columns)
        along, lower = _weights(at[1], rows)
        flat = sinogram[..., view, :, :]
        one = flat.new_zeros(())
        for i in range(along.shape[0]):
            for j in range(across.shape[0]):
                weight = torch.from_numpy(along[i] * across[j]).to(sinogram)
                r, c = (torch.from_numpy(n).to(flat.device) for n in (lower[i], low[j]))
                one = one + weight * flat[..., r, c]
        out.append(one.reshape(*sinogram.shape[:-3], v.size, u.size))
    return torch.stack(out, -3)


def _weights(at: Floats, cells: int) -> tuple[Floats, NDArray[np.int64]]:
    """Of the four cells about each place their weights ``(4, places)`` and numbers; one cell weighs
    1.

    Keys (1981, IEEE Trans. Acoust. 29:1153), a = -1/2: straight lines and parabolas are kept. What
    torch interpolates with, a = -3/4, moves a slope by up to a twentieth of a cell, there and back
    between two cells.
    """
    if cells == 1:
        return np.ones((1, at.size)), np.zeros((1, at.size), np.int64)
    at = np.clip(at, 0.0, cells - 1.0)
    low = np.minimum(np.floor(at), cells - 2.0)
    s = at - low
    weights = np.stack(
        [
            -0.5 * s * (1.0 - s) ** 2,
            1.0 + s * s * (1.5 * s - 2.5),
            s * (0.5 + s * (2.0 - 1.5 * s)),
            -0.5 * s * s * (1.0 - s),
        ]
    )
    return weights, np.clip(low + np.arange(-1, 3)[:, None], 0, cells - 1).astype(np.int64)
