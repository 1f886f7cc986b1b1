# mypy: disable-error-code="assignment, call-arg"
"""CPU kernels of the derivative of :mod:`~torchpcct.projector.cpu.vector_kernels` by the poses.

A reading is a sum of means over rectangles, whose edges move with the pose. The voxels are constant
between grid lines, so that the mean changes with an edge by the value at the edge less the mean,
over the width: the derivative is exact and needs only what the reading itself reads. It jumps where
an edge crosses a grid line. What jumps in the reading itself (another main axis, another number of
parts of a rolled cell) is not in it.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from torchpcct.kernel_cache import forget_outdated
from torchpcct.projector.cpu.cone_kernels import INNER
from torchpcct.projector.cpu.vector_kernels import (
    cell_parts,
    main_axis,
    overlap,
    place_cell,
    start_ray,
)
from torchpcct.projector.tables import NEAREST, POINT

_small = njit(**INNER)


@_small
def _cell_gradient(
    local, ray, parallel, axis, lower, spacing, shape, strides, flat, steps, value, out
):
    """Add ``value`` times the gradient of a part's reading to ``out (4, 3)``: by the ray's origin,
    its direction, and the steps u and v of the part, which are ``steps (2,)`` of the cell's."""
    a, b = (axis + 2) % 3, (axis + 1) % 3
    if strides[b] > strides[a]:
        a, b = b, a
    d = ray[1, axis]
    square = ray[1, 0] ** 2 + ray[1, 1] ** 2 + ray[1, 2] ** 2
    path = spacing[axis] * math.sqrt(square) / abs(d)
    u, v = local[2, axis] * steps[0] / d, local[3, axis] * steps[1] / d
    ua, va = local[2, a] * steps[0] - ray[1, a] * u, local[3, a] * steps[1] - ray[1, a] * v
    ub, vb = local[2, b] * steps[0] - ray[1, b] * u, local[3, b] * steps[1] - ray[1, b] * v
    size_a, size_b = math.hypot(ua, va), math.hypot(ub, vb)
    wa, wb = size_a / spacing[a], size_b / spacing[b]
    # Sums over the slabs of the means and their derivatives by centre and width, plain and times t.
    total = a0 = a1 = wide_a = b0 = b1 = wide_b = t0 = t1 = 0.0
    for r in range(shape[axis]):
        t = (lower[axis] + (r + 0.5) * spacing[axis] - ray[0, axis]) / d
        if not parallel and t <= NEAREST:
            continue
        scale = 1.0 if parallel else t
        ha, hb = wa * scale, wb * scale
        ca = (ray[0, a] + t * ray[1, a] - lower[a]) / spacing[a]
        cb = (ray[0, b] + t * ray[1, b] - lower[b]) / spacing[b]
        la, ha_end, lb, hb_end = ca - ha / 2, ca + ha / 2, cb - hb / 2, cb + hb / 2
        if ha_end <= 0.0 or la >= shape[a] or hb_end <= 0.0 or lb >= shape[b]:
            continue
        first_a, stop_a = int(max(la, 0.0)), min(math.ceil(ha_end), shape[a])
        first_b, stop_b = int(max(lb, 0.0)), min(math.ceil(hb_end), shape[b])
        if ha < POINT:
            stop_a = min(first_a + 1, shape[a])
        if hb < POINT:
            stop_b = min(first_b + 1, shape[b])
        low_a, high_a = math.floor(la), math.ceil(ha_end) - 1
        low_b, high_b = math.floor(lb), math.ceil(hb_end) - 1
        mean = at_low_a = at_high_a = at_low_b = at_high_b = 0.0
        base = r * strides[axis]
        for ka in range(first_a, stop_a):
            share_a = overlap(la, ha_end, ka, ha)
            line = 0.0
            for kb in range(first_b, stop_b):
                x = flat[base + ka * strides[a] + kb * strides[b]]
                line += overlap(lb, hb_end, kb, hb) * x
                if kb == low_b:
                    at_low_b += share_a * x
                if kb == high_b:
                    at_high_b += share_a * x
            mean += share_a * line
            if ka == low_a:
                at_low_a += line
            if ka == high_a:
                at_high_a += line
        by_ca = by_ha = by_cb = by_hb = 0.0
        if ha >= POINT:
            by_ca, by_ha = (at_high_a - at_low_a) / ha, ((at_high_a + at_low_a) / 2 - mean) / ha
        if hb >= POINT:
            by_cb, by_hb = (at_high_b - at_low_b) / hb, ((at_high_b + at_low_b) / 2 - mean) / hb
        by_t = by_ca * ray[1, a] / spacing[a] + by_cb * ray[1, b] / spacing[b]
        if not parallel:
            by_t += by_ha * wa + by_hb * wb
        total += mean
        a0 += by_ca
        a1 += by_ca * t
        b0 += by_cb
        b1 += by_cb * t
        wide_a += by_ha * scale
        wide_b += by_hb * scale
        t0 += by_t
        t1 += by_t * t
    factor = value * path
    out[0, a] += factor * a0 / spacing[a]
    out[1, a] += factor * a1 / spacing[a]
    out[0, b] += factor * b0 / spacing[b]
    out[1, b] += factor * b1 / spacing[b]
    out[0, axis] -= factor * t0 / d
    out[1, axis] -= factor * t1 / d
    for k in range(3):
        out[1, k] += factor * total * ray[1, k] / square
    out[1, axis] -= factor * total / d
    # Widths: hypot of what the steps u and v cover in the plane, seen along the ray.
    for side in range(2):
        to, size, wide = (a, size_a, wide_a) if side == 0 else (b, size_b, wide_b)
        if size <= 0.0:
            continue
        for step in range(2):
            covered = (ua if side == 0 else ub) if step == 0 else (va if side == 0 else vb)
            along = u if step == 0 else v
            share = factor * wide * covered / (size * spacing[to])
            out[2 + step, to] += share * steps[step]
            out[2 + step, axis] -= share * ray[1, to] / d * steps[step]
            out[1, to] -= share * along
            out[1, axis] += share * ray[1, to] * along / d


@_small
def _reading_gradient(
    pose,
    bend,
    i,
    j,
    parallel,
    lower,
    spacing,
    shape,
    strides,
    flat,
    value,
    ray,
    local,
    part,
    steps,
    out,
):
    """Add ``value`` times the gradient of a cell's reading to ``out (4, 3)``: by source (or
    direction), centre, u, v of its view. ``ray``, ``local``, ``part (8, 3)`` and ``steps`` are
    overwritten."""
    place_cell(pose, bend, i, j, local)
    start_ray(local, 0.0, 0.0, parallel, ray)
    axis = main_axis(ray, spacing)
    parts_u, parts_v = cell_parts(local, ray, parallel, axis, lower, spacing, shape)
    steps[0], steps[1] = 1.0 / parts_u, 1.0 / parts_v
    # By source, cell, and the steps at the cell; then of a part.
    whole, of_part = part[:4], part[4:]
    whole[:] = 0.0
    for p in range(parts_v):
        for q in range(parts_u):
            di, dj = (p + 0.5) / parts_v - 0.5, (q + 0.5) / parts_u - 0.5
            start_ray(local, di, dj, parallel, ray)
            of_part[:] = 0.0
            _cell_gradient(
                local,
                ray,
                parallel,
                axis,
                lower,
                spacing,
                shape,
                strides,
                flat,
                steps,
                value * steps[0] * steps[1],
                of_part,
            )
            for k in range(3):
                origin, direction = of_part[0, k], of_part[1, k]
                by_cell = origin if parallel else direction
                whole[0, k] += direction if parallel else origin - direction
                whole[1, k] += by_cell
                whole[2, k] += of_part[2, k] + dj * by_cell
                whole[3, k] += of_part[3, k] + di * by_cell
    turn = j * bend
    ahead, along = 1.0, j
    ahead_step, along_step = 0.0, 1.0
    if bend != 0.0:
        ahead, along = math.cos(turn), math.sin(turn) / bend
        ahead_step, along_step = -bend * math.sin(turn), ahead
    for k in range(3):
        centre = ahead * whole[1, k] + ahead_step * whole[2, k]
        out[0, k] += whole[0, k] + whole[1, k] - centre
        out[1, k] += centre
        out[2, k] += along * whole[1, k] + along_step * whole[2, k]
        out[3, k] += i * whole[1, k] + whole[3, k]


@njit(nogil=True, cache=True)
def pose_gradients(
    begin, end, poses, parallel, bend, middle, lower, spacing, shape, strides, flat, data, out
):
    """Add the gradient of ⟨data, readings⟩ by the poses of the views ``begin … end`` to ``out
    (views, 4, 3)``.

    Args: as for :func:`~torchpcct.projector.cpu.vector_kernels.project_vectors`; ``data (views,
        rows, columns)`` is given.
    """
    rows, columns = data.shape[1:]
    ray, local, part, steps = np.empty((2, 3)), np.empty((4, 3)), np.empty((8, 3)), np.empty(2)
    for n in range(begin, end):
        for i in range(rows):
            for j in range(columns):
                if data[n, i, j] != 0.0:
                    _reading_gradient(
                        poses[n],
                        bend,
                        i - middle,
                        j - (columns - 1) / 2,
                        parallel,
                        lower,
                        spacing,
                        shape,
                        strides,
                        flat,
                        float(data[n, i, j]),
                        ray,
                        local,
                        part,
                        steps,
                        out[n],
                    )


@njit(nogil=True, cache=True)
def differentiate_readings(
    begin, end, poses, parallel, bend, middle, lower, spacing, shape, strides, flat, tangents, out
):
    """Derivatives of the readings of one volume along changes of the poses.

    Args: as for :func:`~torchpcct.projector.cpu.vector_kernels.project_vectors`; and

        tangents: ``(directions, views, 4, 3)``.
        out: ``(directions, views, rows, columns)`` output, overwritten.
    """
    directions, _, rows, columns = out.shape
    ray, local, part, steps = np.empty((2, 3)), np.empty((4, 3)), np.empty((8, 3)), np.empty(2)
    gradient = np.empty((4, 3))
    for n in range(begin, end):
        for i in range(rows):
            for j in range(columns):
                gradient[:] = 0.0
                _reading_gradient(
                    poses[n],
                    bend,
                    i - middle,
                    j - (columns - 1) / 2,
                    parallel,
                    lower,
                    spacing,
                    shape,
                    strides,
                    flat,
                    1.0,
                    ray,
                    local,
                    part,
                    steps,
                    gradient,
                )
                for direction in range(directions):
                    total = 0.0
                    for m in range(4):
                        for k in range(3):
                            total += gradient[m, k] * tangents[direction, n, m, k]
                    out[direction, n, i, j] = total


@_small
def _spread_cell(
    local,
    moving,
    ray,
    turning,
    parallel,
    axis,
    lower,
    spacing,
    shape,
    strides,
    r0,
    r1,
    steps,
    value,
    flat,
):
    """Add ``value`` times the derivatives of a part's weights to the slabs ``r0 … r1``: along
    ``moving (4, 3)`` of the cell's vectors and ``turning (2, 3)`` of the ray."""
    real = flat.dtype.type
    a, b = (axis + 2) % 3, (axis + 1) % 3
    if strides[b] > strides[a]:
        a, b = b, a
    d, dd = ray[1, axis], turning[1, axis]
    square = along = 0.0
    for k in range(3):
        square += ray[1, k] ** 2
        along += ray[1, k] * turning[1, k]
    path = spacing[axis] * math.sqrt(square) / abs(d)
    dpath = path * (along / square - dd / d)
    u, v = local[2, axis] * steps[0] / d, local[3, axis] * steps[1] / d
    du = (moving[2, axis] * steps[0] - u * dd) / d
    dv = (moving[3, axis] * steps[1] - v * dd) / d
    ua, va = local[2, a] * steps[0] - ray[1, a] * u, local[3, a] * steps[1] - ray[1, a] * v
    ub, vb = local[2, b] * steps[0] - ray[1, b] * u, local[3, b] * steps[1] - ray[1, b] * v
    dua = moving[2, a] * steps[0] - turning[1, a] * u - ray[1, a] * du
    dva = moving[3, a] * steps[1] - turning[1, a] * v - ray[1, a] * dv
    dub = moving[2, b] * steps[0] - turning[1, b] * u - ray[1, b] * du
    dvb = moving[3, b] * steps[1] - turning[1, b] * v - ray[1, b] * dv
    size_a, size_b = math.hypot(ua, va), math.hypot(ub, vb)
    wa, wb = size_a / spacing[a], size_b / spacing[b]
    dwa = (ua * dua + va * dva) / (size_a * spacing[a]) if size_a > 0.0 else 0.0
    dwb = (ub * dub + vb * dvb) / (size_b * spacing[b]) if size_b > 0.0 else 0.0
    for r in range(r0, r1):
        t = (lower[axis] + (r + 0.5) * spacing[axis] - ray[0, axis]) / d
        if not parallel and t <= NEAREST:
            continue
        dt = -(turning[0, axis] + t * dd) / d
        scale, dscale = (1.0, 0.0) if parallel else (t, dt)
        ha, hb = wa * scale, wb * scale
        dha, dhb = dwa * scale + wa * dscale, dwb * scale + wb * dscale
        ca = (ray[0, a] + t * ray[1, a] - lower[a]) / spacing[a]
        cb = (ray[0, b] + t * ray[1, b] - lower[b]) / spacing[b]
        dca = (turning[0, a] + t * turning[1, a] + dt * ray[1, a]) / spacing[a]
        dcb = (turning[0, b] + t * turning[1, b] + dt * ray[1, b]) / spacing[b]
        la, ha_end, lb, hb_end = ca - ha / 2, ca + ha / 2, cb - hb / 2, cb + hb / 2
        if ha_end <= 0.0 or la >= shape[a] or hb_end <= 0.0 or lb >= shape[b]:
            continue
        first_a, stop_a = int(max(la, 0.0)), min(math.ceil(ha_end), shape[a])
        first_b, stop_b = int(max(lb, 0.0)), min(math.ceil(hb_end), shape[b])
        if ha < POINT:
            stop_a = min(first_a + 1, shape[a])
        if hb < POINT:
            stop_b = min(first_b + 1, shape[b])
        low_a, high_a = math.floor(la), math.ceil(ha_end) - 1
        low_b, high_b = math.floor(lb), math.ceil(hb_end) - 1
        base = r * strides[axis]
        for ka in range(first_a, stop_a):
            share_a = overlap(la, ha_end, ka, ha)
            dshare_a = 0.0
            if ha >= POINT:
                up = dca + dha / 2 if ka == high_a else 0.0
                down = dca - dha / 2 if ka == low_a else 0.0
                dshare_a = (up - down - share_a * dha) / ha
            for kb in range(first_b, stop_b):
                share_b = overlap(lb, hb_end, kb, hb)
                dshare_b = 0.0
                if hb >= POINT:
                    up = dcb + dhb / 2 if kb == high_b else 0.0
                    down = dcb - dhb / 2 if kb == low_b else 0.0
                    dshare_b = (up - down - share_b * dhb) / hb
                change = dpath * share_a * share_b + path * (
                    dshare_a * share_b + share_a * dshare_b
                )
                flat[base + ka * strides[a] + kb * strides[b]] += real(value * change)


@njit(nogil=True, cache=True)
def spread_derivatives(
    begin,
    end,
    poses,
    parallel,
    bend,
    middle,
    lower,
    spacing,
    shape,
    strides,
    tangent,
    block,
    data,
    axis,
    flat,
):
    """Add the transpose of :func:`differentiate_readings` along one ``tangent (views, 4, 3)`` to
    ``flat``: rays along one axis, in blocks of so many of its slabs."""
    views, rows, columns = data.shape
    ray, local, steps = np.empty((2, 3)), np.empty((4, 3)), np.empty(2)
    turning, moving = np.empty((2, 3)), np.empty((4, 3))
    for number in range(begin, end):
        r0 = number * block
        r1 = min(r0 + block, shape[axis])
        for n in range(views):
            for i in range(rows):
                for j in range(columns):
                    at_i, at_j = i - middle, j - (columns - 1) / 2
                    place_cell(poses[n], bend, at_i, at_j, local)
                    start_ray(local, 0.0, 0.0, parallel, ray)
                    if main_axis(ray, spacing) != axis:
                        continue
                    parts_u, parts_v = cell_parts(local, ray, parallel, axis, lower, spacing, shape)
                    steps[0], steps[1] = 1.0 / parts_u, 1.0 / parts_v
                    # The cell's vectors are linear in the pose.
                    place_cell(tangent[n], bend, at_i, at_j, moving)
                    for p in range(parts_v):
                        for q in range(parts_u):
                            di, dj = (p + 0.5) / parts_v - 0.5, (q + 0.5) / parts_u - 0.5
                            start_ray(local, di, dj, parallel, ray)
                            start_ray(moving, di, dj, parallel, turning)
                            _spread_cell(
                                local,
                                moving,
                                ray,
                                turning,
                                parallel,
                                axis,
                                lower,
                                spacing,
                                shape,
                                strides,
                                r0,
                                r1,
                                steps,
                                float(data[n, i, j]) * steps[0] * steps[1],
                                flat,
                            )


forget_outdated(
    __name__, "torchpcct.projector.cpu.cone_kernels", "torchpcct.projector.cpu.vector_kernels"
)
