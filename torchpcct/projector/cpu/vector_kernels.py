# mypy: disable-error-code="assignment, call-arg"
"""CPU kernels of per-view geometry: any source, any flat detector, slab by slab along the axis a
ray crosses most.

In every slab of voxels the cell's parallelogram is projected onto the slab's middle plane and
replaced by the rectangle along the grid's axes that has its centre and its second moments: sides
√(u² + v²) of the projected steps along either axis. Of an upright detector that is the
parallelogram itself, and the distance-driven model of :mod:`~torchpcct.projector.cpu.cone_kernels`;
of a turned one the corners differ, the mean and the width do not. The reading is the mean over the
rectangle times the path through the slab, summed over slabs. A long cell that is rolled lies along
a diagonal, which no rectangle along the axes does (aspect 20: 32 % of the peak off): its reading is
the mean of so many parts that each part's rectangle fits.

Forward runs in parallel over views, the adjoint over blocks of slabs, one axis after the other: no
two threads write to one place, and every sum has a fixed order.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from torchpcct.kernel_cache import forget_outdated
from torchpcct.projector.cpu.cone_kernels import INNER
from torchpcct.projector.tables import LEAST_SLANT, LEAST_SLOPE, MOST_PARTS, NEAREST, POINT

SLAB_BLOCK = 16
"""Slabs of one task of the adjoint."""
_small = njit(**INNER)


@_small
def place_cell(pose, bend, i, j, local):
    """A view as its cell (i, j) sees it: source, the cell's centre, and the steps there, into
    ``local (4, 3)``."""
    turn = j * bend
    ahead, along = 1.0, j  # of the way from the source to the centre, and of u
    ahead_step, along_step = 0.0, 1.0
    if bend != 0.0:
        ahead, along = math.cos(turn), math.sin(turn) / bend
        ahead_step, along_step = -bend * math.sin(turn), ahead
    for k in range(3):
        way = pose[1, k] - pose[0, k]
        local[0, k] = pose[0, k]
        local[1, k] = pose[1, k] + (ahead - 1.0) * way + along * pose[2, k] + i * pose[3, k]
        local[2, k] = ahead_step * way + along_step * pose[2, k]
        local[3, k] = pose[3, k]


@_small
def start_ray(local, di, dj, parallel, ray):
    """Origin and direction of the ray of offsets (di, dj) from a cell into ``ray[0]``,
    ``ray[1]``."""
    for k in range(3):
        cell = local[1, k] + dj * local[2, k] + di * local[3, k]
        ray[0, k] = cell if parallel else local[0, k]
        ray[1, k] = local[0, k] if parallel else cell - local[0, k]


@_small
def main_axis(ray, spacing):
    """The axis along which the ray crosses most voxels; a hair's breadth in favour of y, then x."""
    best, most = 1, abs(ray[1, 1]) / spacing[1]
    for k in (0, 2):
        steps = abs(ray[1, k]) / spacing[k]
        if steps > most * (1 + 1e-9):
            best, most = k, steps
    return best


@_small
def overlap(low, high, k, width):
    """Share of the interval that lies in voxel k."""
    if width < POINT:
        return 1.0
    return (min(high, k + 1.0) - max(low, float(k))) / width


@_small
def cell_parts(pose, ray, parallel, axis, lower, spacing, shape):
    """Parts along u and along v into which a cell is cut, so that rectangles along the axes
    stand for them."""
    a, b = (axis + 2) % 3, (axis + 1) % 3
    d = ray[1, axis]
    scale = (
        1.0
        if parallel
        else min(max((lower[axis] + shape[axis] * spacing[axis] / 2 - ray[0, axis]) / d, 0.0), 1.0)
    )
    u, v = pose[2, axis] / d, pose[3, axis] / d
    ua, ub = (
        (pose[2, a] - ray[1, a] * u) / spacing[a] * scale,
        (pose[2, b] - ray[1, b] * u) / spacing[b] * scale,
    )
    va, vb = (
        (pose[3, a] - ray[1, a] * v) / spacing[a] * scale,
        (pose[3, b] - ray[1, b] * v) / spacing[b] * scale,
    )
    parts_u = parts_v = 1
    while max(parts_u, parts_v) < MOST_PARTS:
        pa, pb, qa, qb = ua / parts_u, ub / parts_u, va / parts_v, vb / parts_v
        across = abs(pa * pb + qa * qb)
        if across <= max(
            LEAST_SLANT, LEAST_SLOPE * math.sqrt((pa * pa + qa * qa) * (pb * pb + qb * qb))
        ):
            break
        if abs(pa * pb) >= abs(qa * qb):
            parts_u += 1
        else:
            parts_v += 1
    return parts_u, parts_v


@_small
def _cell(pose, ray, parallel, axis, lower, spacing, shape, strides, r0, r1, flat, value, gather):
    """Add ``value`` times the cell's weights to the slabs ``r0 … r1`` of ``flat``, or
    (``gather``) return their sum."""
    real = flat.dtype.type
    a, b = (axis + 2) % 3, (axis + 1) % 3  # b has the smaller stride, except for axis x
    if strides[b] > strides[a]:
        a, b = b, a
    d = ray[1, axis]
    path = spacing[axis] * math.sqrt(ray[1, 0] ** 2 + ray[1, 1] ** 2 + ray[1, 2] ** 2) / abs(d)
    # Where a step along u or v meets the plane, for a ray parameter of 1.
    u, v = pose[2, axis] / d, pose[3, axis] / d
    wa = math.hypot(pose[2, a] - ray[1, a] * u, pose[3, a] - ray[1, a] * v) / spacing[a]
    wb = math.hypot(pose[2, b] - ray[1, b] * u, pose[3, b] - ray[1, b] * v) / spacing[b]
    total = 0.0
    for r in range(r0, r1):
        t = (lower[axis] + (r + 0.5) * spacing[axis] - ray[0, axis]) / d
        if not parallel and t <= NEAREST:
            continue
        scale = 1.0 if parallel else t
        ha, hb = wa * scale, wb * scale
        ca = (ray[0, a] + t * ray[1, a] - lower[a]) / spacing[a]
        cb = (ray[0, b] + t * ray[1, b] - lower[b]) / spacing[b]
        la, ua, lb, ub = ca - ha / 2, ca + ha / 2, cb - hb / 2, cb + hb / 2
        if ua <= 0.0 or la >= shape[a] or ub <= 0.0 or lb >= shape[b]:
            continue
        a0, a1 = int(max(la, 0.0)), min(math.ceil(ua), shape[a])
        b0, b1 = int(max(lb, 0.0)), min(math.ceil(ub), shape[b])
        if ha < POINT:
            a1 = min(a0 + 1, shape[a])
        if hb < POINT:
            b1 = min(b0 + 1, shape[b])
        base = r * strides[axis]
        for ka in range(a0, a1):
            weight = path * overlap(la, ua, ka, ha)
            for kb in range(b0, b1):
                w = weight * overlap(lb, ub, kb, hb)
                at = base + ka * strides[a] + kb * strides[b]
                if gather:
                    total += w * flat[at]
                else:
                    flat[at] += real(w * value)
    return total


@_small
def _whole_cell(
    pose,
    ray,
    part,
    parallel,
    axis,
    lower,
    spacing,
    shape,
    strides,
    r0,
    r1,
    flat,
    value,
    gather,
):
    """:func:`_cell` of all parts of the cell whose ray is in ``ray``; ``ray`` and ``part (4,
    3)`` are overwritten."""
    parts_u, parts_v = cell_parts(pose, ray, parallel, axis, lower, spacing, shape)
    if parts_u * parts_v == 1:
        return _cell(
            pose, ray, parallel, axis, lower, spacing, shape, strides, r0, r1, flat, value, gather
        )
    for k in range(3):
        part[0, k], part[1, k] = pose[0, k], pose[1, k]
        part[2, k], part[3, k] = pose[2, k] / parts_u, pose[3, k] / parts_v
    share = 1.0 / (parts_u * parts_v)
    total = 0.0
    for p in range(parts_v):
        for q in range(parts_u):
            start_ray(pose, (p + 0.5) / parts_v - 0.5, (q + 0.5) / parts_u - 0.5, parallel, ray)
            total += share * _cell(
                part,
                ray,
                parallel,
                axis,
                lower,
                spacing,
                shape,
                strides,
                r0,
                r1,
                flat,
                value * share,
                gather,
            )
    return total


@_small
def _project_view(pose, parallel, bend, middle, lower, spacing, shape, strides, flat, data):
    rows, columns = data.shape
    ray, local, part = np.empty((2, 3)), np.empty((4, 3)), np.empty((4, 3))
    for i in range(rows):
        for j in range(columns):
            place_cell(pose, bend, i - middle, j - (columns - 1) / 2, local)
            start_ray(local, 0.0, 0.0, parallel, ray)
            axis = main_axis(ray, spacing)
            data[i, j] = _whole_cell(
                local,
                ray,
                part,
                parallel,
                axis,
                lower,
                spacing,
                shape,
                strides,
                0,
                shape[axis],
                flat,
                0.0,
                True,
            )


@njit(nogil=True, cache=True)
def project_vectors(
    begin, end, poses, parallel, bend, middle, lower, spacing, shape, strides, flat, data
):
    """Line integrals of one volume in the views ``begin … end``.

    Args:
        poses: ``(views, 4, 3)``, see :class:`torchpcct.vector_geometry.VectorGeometry`.
        parallel: whether ``poses[:, 0]`` are directions.
        bend: angle between neighbouring columns of a detector on an arc about the source, in rad,
            whose columns follow the arc through the centre and whose rows stand along v; 0: flat.
        middle: row, fractional, that stands at the centre: (rows - 1) / 2 of a centred detector.
        lower, spacing, shape, strides: ``(3,)`` x, y, z: lower edge and voxel size in mm, voxels,
            step in ``flat``.
        flat: the volume, flat.
        data: ``(views, rows, columns)`` output, overwritten.
    """
    for n in range(begin, end):
        _project_view(
            poses[n], parallel, bend, middle, lower, spacing, shape, strides, flat, data[n]
        )


@_small
def _gather_slabs(
    poses, parallel, bend, middle, lower, spacing, shape, strides, data, axis, r0, r1, flat
):
    views, rows, columns = data.shape
    ray, local, part = np.empty((2, 3)), np.empty((4, 3)), np.empty((4, 3))
    for n in range(views):
        for i in range(rows):
            for j in range(columns):
                place_cell(poses[n], bend, i - middle, j - (columns - 1) / 2, local)
                start_ray(local, 0.0, 0.0, parallel, ray)
                if main_axis(ray, spacing) == axis:
                    _whole_cell(
                        local,
                        ray,
                        part,
                        parallel,
                        axis,
                        lower,
                        spacing,
                        shape,
                        strides,
                        r0,
                        r1,
                        flat,
                        float(data[n, i, j]),
                        False,
                    )


@njit(nogil=True, cache=True)
def backproject_vectors(
    begin, end, poses, parallel, bend, middle, lower, spacing, shape, strides, data, axis, flat
):
    """Add the exact transpose of :func:`project_vectors` to ``flat``: rays along one axis, in
    blocks of its slabs."""
    for block in range(begin, end):
        r0 = block * SLAB_BLOCK
        _gather_slabs(
            poses,
            parallel,
            bend,
            middle,
            lower,
            spacing,
            shape,
            strides,
            data,
            axis,
            r0,
            min(r0 + SLAB_BLOCK, shape[axis]),
            flat,
        )


forget_outdated(__name__, "torchpcct.projector.cpu.cone_kernels")
