# mypy: disable-error-code="call-arg"
"""Numba kernels of the voxel-driven backprojector and of its exact transpose.

Every voxel belongs to one task of the backprojection and every view to one task of the transpose,
each with a fixed order of summation: results do not depend on the number of threads. Positions on a
curved detector are ``γ = 2 atan(across / (distance + depth))``, with the arc tangent as a
polynomial that is fitted to the fans that occur, because a library call per voxel and view would
cost more than all the rest.

``shifts (views, 3)`` displaces the grid in every view: towards the source, along the columns,
upwards, in mm.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from torchpcct.kernel_cache import forget_outdated
from torchpcct.projector.cpu.simd_interpolation import add_between

PARALLEL = 0
"""Kind of a parallel beam."""
FLAT = 1
"""Kind of a divergent beam on a flat detector."""
CURVED = 2
"""Kind of a divergent beam on a curved detector."""
TILE = 32
"""Pixels of the edge of a tile of :func:`collect_lanes`."""

# No "nnan" or "ninf": NaN and Inf of the data must reach the image.
_FAST = {"contract", "nsz", "arcp"}
_OPTIONS: Any = {
    "nogil": True,
    "cache": True,
    "error_model": "numpy",
    "fastmath": _FAST,
}
_INLINE: Any = {"cache": True, "error_model": "numpy", "fastmath": _FAST}
_BARE: Any = {
    **_INLINE,
    "_nrt": False,
}  # without reference counts: for what allocates nothing


@njit(**_INLINE)
def _positions_2d(
    kind, x, y, c, s, toward, aside, sod, sdd, scale, start, last, atan, index, near, far
):
    """Left neighbour and the two weights of a line of pixels, in the precision of ``x``."""
    number = x.dtype.type
    zero, one, edge, first = number(0), number(1), number(last), number(start)
    depth0, depth1 = number((sod - toward) - y * s), number(-c)
    across0, across1 = number(y * c + aside), number(-s)
    unit, radius = number(sdd * scale), number(sod)
    for i in range(x.size):
        across = across0 + across1 * x[i]
        if kind == 0:
            position = across * number(scale) + first
            weight = one
        else:
            depth = depth0 + depth1 * x[i]
            if kind == 1:
                inverse = one / depth
                position = across * inverse * unit + first
                weight = radius * inverse
                weight = weight * weight
            else:
                square = depth * depth + across * across
                t = across / (math.sqrt(square) + depth)
                t2 = t * t
                value = number(atan[0])
                for m in range(1, len(atan)):
                    value = value * t2 + number(atan[m])
                position = value * t * unit + first
                weight = radius * radius / square
        position = min(max(position, zero), edge)
        left = np.int32(position)
        fraction = (position - number(left)) * weight
        index[i] = left
        near[i] = weight - fraction
        far[i] = fraction


@njit(**_OPTIONS)
def interleave_lanes(begin, end, data, first, target, reverse, images, columns, lanes, rows):
    """``data (B, V, width)`` into ``rows (groups, views, ≥ (columns + 1) * lanes)``, by group and
    projected view.

    Lane ``operation + n * operations`` of group g holds view ``target[v, operation]`` of image ``g
    * images + n`` from column ``first`` of that view on, all columns backwards where ``reverse``.
    All else is 0, also the place after the last column, which is read with weight 0 at that
    column's centre.
    """
    batch, _, width = data.shape
    views, operations = target.shape
    for task in range(begin, end):
        group, v = task // views, task % views
        line = rows[group, v]
        line[:] = 0
        for l in range(images * operations):
            n, to = group * images + l // operations, target[v, l % operations]
            if n < batch and to >= 0:
                source, start, step = data[n, to], first[to], 1
                if reverse[v, l % operations]:
                    start, step = columns - 1 - start, -1
                for i in range(width):
                    line[(start + step * i) * lanes + l] = source[i]


@njit(**_OPTIONS)
def backproject_2d(
    begin,
    end,
    lanes,
    kind,
    rows,
    cosines,
    sines,
    shifts,
    starts,
    x,
    y,
    sod,
    sdd,
    scale,
    atan,
    columns,
    block,
    inside,
    out,
):
    """``rows (groups, V, ≥ (columns + 1) * lanes)`` into ``out (groups, Y, X * lanes)``, by blocks
    of ``block`` lines.

    ``inside (Y, 2)``: first pixel of every line that is wanted, and the one after the last.
    """
    width = len(lanes)
    views, size = rows.shape[1], rows.shape[2] // width
    ny, nx = y.size, x.size
    number = rows.dtype.type
    blocks = (ny + block - 1) // block
    index = np.empty(nx, np.int32)
    near, far = np.empty(nx, rows.dtype), np.empty(nx, rows.dtype)
    xs = np.empty(nx, rows.dtype)
    for i in range(nx):
        xs[i] = number(x[i])
    for task in range(begin, end):
        group, first = task // blocks, (task % blocks) * block
        stop = min(first + block, ny)
        out[group, first:stop] = number(0)
        for v in range(views):
            for iy in range(first, stop):
                i0, i1 = inside[iy, 0], inside[iy, 1]
                _positions_2d(
                    kind,
                    xs[i0:i1],
                    y[iy],
                    cosines[v],
                    sines[v],
                    shifts[v, 0],
                    shifts[v, 1],
                    sod,
                    sdd,
                    scale,
                    starts[v],
                    columns - 1,
                    atan,
                    index,
                    near,
                    far,
                )
                add_between(
                    lanes,
                    near,
                    far,
                    index,
                    rows[group, v],
                    size,
                    i1 - i0,
                    out[group, iy, i0 * width :],
                )


@njit(**_OPTIONS)
def collect_lanes(begin, end, lanes, inverse, images, out):
    """Sum of the lanes ``lanes (groups, Y, X, lanes)`` at each pixel of ``out (B, Y, X)``, by
    blocks of :data:`TILE` lines.

    ``inverse (operations, 6)``: row and column of the operated image that show pixel (y, x), each
    as base, per y, per x.
    """
    _, ny, nx = out.shape
    operations = inverse.shape[0]
    blocks = (ny + TILE - 1) // TILE
    for task in range(begin, end):
        b, y0 = task // blocks, (task % blocks) * TILE
        y1 = min(y0 + TILE, ny)
        group, n = b // images, b % images
        image = out[b]
        image[y0:y1] = 0
        for x0 in range(0, nx, TILE):
            x1 = min(x0 + TILE, nx)
            for g in range(operations):
                at, l = inverse[g], n * operations + g
                for y in range(y0, y1):
                    for x in range(x0, x1):
                        row = at[0] + at[1] * y + at[2] * x
                        column = at[3] + at[4] * y + at[5] * x
                        image[y, x] += lanes[group, row, column, l]


@njit(**_OPTIONS)
def spread_2d(
    begin, end, kind, volume, cosines, sines, shifts, starts, x, y, sod, sdd, scale, atan, out
):
    """Transpose of :func:`backproject_2d`: ``volume (B, Y, X)`` into ``out (B, V, columns)``."""
    _, views, columns = out.shape
    ny, nx = volume.shape[1], volume.shape[2]
    number = volume.dtype.type
    for task in range(begin, end):
        b, v = task // views, task % views
        index = np.empty(nx, np.int32)
        near, far = np.empty(nx, volume.dtype), np.empty(nx, volume.dtype)
        row = np.zeros(columns + 1, volume.dtype)
        xs = np.empty(nx, volume.dtype)
        for i in range(nx):
            xs[i] = number(x[i])
        for iy in range(ny):
            _positions_2d(
                kind,
                xs,
                y[iy],
                cosines[v],
                sines[v],
                shifts[v, 0],
                shifts[v, 1],
                sod,
                sdd,
                scale,
                starts[v],
                columns - 1,
                atan,
                index,
                near,
                far,
            )
            for i in range(nx):
                k = np.uint32(index[i])
                row[k] += near[i] * volume[b, iy, i]
                row[k + np.uint32(1)] += far[i] * volume[b, iy, i]
        for i in range(columns):
            out[b, v, i] = row[i]


@njit(**_INLINE)
def _positions_3d(
    kind, x, y, c, s, toward, aside, sod, sdd, scale, start, atan, index, weight, height
):
    """Column position, distance weight and magnification of heights of voxel columns, in
    float64."""
    for p in range(x.size):
        across = (y[p] * c - x[p] * s) + aside
        depth = (sod - toward) - (x[p] * c + y[p] * s)
        if kind == 1:
            inverse = 1.0 / depth
            height[p] = sdd * inverse
            index[p] = sdd * inverse * across * scale + start
            weight[p] = sod * inverse * (sod * inverse)
        else:
            square = across * across + depth * depth
            distance = math.sqrt(square)
            t = across / (distance + depth)
            t2 = t * t
            value = atan[0]
            for m in range(1, len(atan)):
                value = value * t2 + atan[m]
            height[p] = sdd / distance
            index[p] = sdd * scale * value * t + start
            weight[p] = sod * sod / square


# These two take whole arrays and indices: a row as an array of its own costs more (reference
# counts) than its loop.


@njit(inline="always", **_INLINE)
def _add_by_kink(near, far, table, m, z, tau, step, total, p):
    """One voxel column: ``total[p] += row interpolation``, three rows of each neighbour for every
    voxel.

    Where the heights of a voxel on the detector stay within one row of row κ for the whole tile,
    interpolation is ``g(κ) + min(t, 0) · (g(κ) − g(κ−1)) + max(t, 0) · (g(κ+1) − g(κ))`` with t the
    distance from κ: no index depends on the voxel column, and the loop along z vectorises.
    """
    zero, n = z.dtype.type(0), m + np.uint64(1)
    for k in range(np.uint64(z.size)):
        t = z[k] * step + tau[k]
        below, above = min(t, zero), max(t, zero)
        total[p, k] += (
            (near * table[m, 0, k] + far * table[n, 0, k])
            + below * (near * table[m, 1, k] + far * table[n, 1, k])
            + above * (near * table[m, 2, k] + far * table[n, 2, k])
        )


@njit(inline="always", **_INLINE)
def _add_by_index(near, far, turned, m, z, step, origin, below, column, lower, upper, total, p):
    """One voxel column, any magnification: interpolate the columns first, then look the rows up."""
    number, n = z.dtype.type, m + np.uint64(1)
    rows = turned.shape[1] - 2
    for r in range(np.uint64(rows + 1)):
        column[r] = near * turned[m, r + np.uint64(1)] + far * turned[n, r + np.uint64(1)]
    zero, last = number(0), number(rows - 1)
    for k in range(z.size):  # apart from the look-ups, so that it vectorises
        row = min(max((z[k] * step + origin) - below, zero), last)
        lower[k] = np.int32(row)
        upper[k] = row - number(lower[k])
    for k in range(np.uint64(z.size)):
        near_row = np.uint32(lower[k])
        a = column[near_row]
        total[p, k] += a + upper[k] * (column[near_row + np.uint32(1)] - a)


@njit(**_BARE)
def _add_view(
    index,
    weight,
    height,
    first,
    last,
    row_scale,
    kink,
    table,
    tau,
    turned,
    origin,
    below,
    column,
    lower,
    upper,
    heights,
    total,
):
    """What one view adds to every voxel column of a tile; apart, because it needs no reference
    counts."""
    number = total.dtype.type
    for p in range(index.size):
        position = min(max(index[p], 0.0), last)
        i = int(position)
        fraction = (position - i) * weight[p]
        near, far = number(weight[p] - fraction), number(fraction)
        step = number(height[p] * row_scale)
        m = np.uint64(i - first)
        q = np.uint64(p)
        if kink:
            _add_by_kink(near, far, table, m, heights, tau, step, total, q)
        else:
            _add_by_index(
                near, far, turned, m, heights, step, origin, below, column, lower, upper, total, q
            )


@njit(**_OPTIONS)
def backproject_3d(
    begin,
    end,
    kind,
    data,
    cosines,
    sines,
    shifts,
    starts,
    x,
    y,
    z,
    sod,
    sdd,
    scale,
    row_scale,
    row_start,
    atan,
    first_row,
    bottom,
    top,
    tile_y,
    tile_x,
    out,
):
    """``data (B, V, rows, columns)`` into ``out (B, Z, Y, X)``, tile by tile of ``tile_y × tile_x``
    voxel columns.

    ``z`` may be some slices of a volume that reaches from ``bottom`` to ``top``, and ``data`` the
    rows from ``first_row`` that they read: every voxel then gets the same bits as in the whole
    volume.
    """
    _, views, rows, columns = data.shape
    nz, ny, nx = out.shape[1], out.shape[2], out.shape[3]
    number = data.dtype.type
    tiles_y, tiles_x = (ny + tile_y - 1) // tile_y, (nx + tile_x - 1) // tile_x
    tiles = tiles_y * tiles_x
    padded = (nz + 7) // 8 * 8
    last = columns - 1.0
    origin, below = number(row_start), number(first_row)
    for task in range(begin, end):
        b = task // tiles
        iy, ix = (task % tiles) // tiles_x, task % tiles_x
        y0, y1 = iy * ny // tiles_y, (iy + 1) * ny // tiles_y
        x0, x1 = ix * nx // tiles_x, (ix + 1) * nx // tiles_x
        width = x1 - x0
        n = (y1 - y0) * width
        px, py = np.empty(n), np.empty(n)
        for p in range(n):
            px[p], py[p] = x[x0 + p % width], y[y0 + p // width]
        index, weight, height = np.empty(n), np.empty(n), np.empty(n)
        total = np.zeros((n, padded), data.dtype)
        heights = np.zeros(padded, data.dtype)
        tau = np.zeros(padded, data.dtype)
        table = np.zeros((columns + 1, 3, padded), data.dtype)
        column = np.empty(rows + 1, data.dtype)
        turned = np.empty((columns + 1, rows + 2), data.dtype)
        lower, upper = np.empty(padded, np.int32), np.empty(padded, data.dtype)
        for v in range(views):
            _positions_3d(
                kind,
                px,
                py,
                cosines[v],
                sines[v],
                shifts[v, 0],
                shifts[v, 1],
                sod,
                sdd,
                scale,
                starts[v],
                atan,
                index,
                weight,
                height,
            )
            lift = shifts[v, 2]
            for k in range(nz):
                heights[k] = number(z[k] + lift)
            low, high, left, right = height[0], height[0], index[0], index[0]
            for p in range(n):
                low, high = min(low, height[p]), max(high, height[p])
                left, right = min(left, index[p]), max(right, index[p])
            first = int(min(max(left, 0.0), last))
            stop = int(min(max(right, 0.0), last)) + 2
            slab = data[b, v]
            # columns become contiguous; the outermost rows are repeated
            for r in range(rows):
                for i in range(first, stop):
                    turned[i - first, r + 1] = slab[r, min(i, columns - 1)]
            for i in range(stop - first):
                turned[i, 0], turned[i, rows + 1] = turned[i, 1], turned[i, rows]
            reach = max(abs(bottom + lift), abs(top + lift)) * row_scale
            kink = reach * (high - low) <= 1.0
            if kink:
                for k in range(nz):
                    r = max((z[k] + lift) * low, (z[k] + lift) * high) * row_scale + row_start
                    middle = min(max(math.floor(r) - first_row, 0.0), rows - 1.0)
                    tau[k] = number(row_start - (middle + first_row))
                    lower[k] = np.int32(middle)
                for i in range(stop - first):
                    source, g, d, e = turned[i], table[i, 0], table[i, 1], table[i, 2]
                    for k in range(nz):
                        j = np.uint32(lower[k])
                        here = source[j + np.uint32(1)]
                        g[k] = here
                        d[k] = here - source[j]
                        e[k] = source[j + np.uint32(2)] - here
            _add_view(
                index,
                weight,
                height,
                first,
                last,
                row_scale,
                kink,
                table,
                tau,
                turned,
                origin,
                below,
                column,
                lower,
                upper,
                heights,
                total,
            )
        for k in range(nz):
            for p in range(n):
                out[b, k, y0 + p // width, x0 + p % width] = total[p, k]


@njit(**_OPTIONS)
def spread_3d(
    begin,
    end,
    kind,
    volume,
    cosines,
    sines,
    shifts,
    starts,
    x,
    y,
    z,
    sod,
    sdd,
    scale,
    row_scale,
    row_start,
    atan,
    out,
):
    """Transpose of :func:`backproject_3d`: ``volume (B, Y, X, Z)`` into ``out (B, V, rows,
    columns)``."""
    _, views, rows, columns = out.shape
    ny, nx, nz = volume.shape[1], volume.shape[2], volume.shape[3]
    number = volume.dtype.type
    zero, last = number(0), columns - 1.0
    last_row, origin = number(rows - 1), number(row_start)
    for task in range(begin, end):
        b, v = task // views, task % views
        index, weight, height = np.empty(nx), np.empty(nx), np.empty(nx)
        line = np.empty(nx)
        column = np.empty(rows + 1, volume.dtype)
        slab = np.zeros((columns + 1, rows), volume.dtype)
        heights = np.empty(nz, volume.dtype)
        lower, upper = np.empty(nz, np.int32), np.empty(nz, volume.dtype)
        for k in range(nz):
            heights[k] = number(z[k] + shifts[v, 2])
        for iy in range(ny):
            for ix in range(nx):
                line[ix] = y[iy]
            _positions_3d(
                kind,
                x,
                line,
                cosines[v],
                sines[v],
                shifts[v, 0],
                shifts[v, 1],
                sod,
                sdd,
                scale,
                starts[v],
                atan,
                index,
                weight,
                height,
            )
            for ix in range(nx):
                position = min(max(index[ix], 0.0), last)
                left = np.uint64(int(position))
                fraction = (position - int(position)) * weight[ix]
                near, far = number(weight[ix] - fraction), number(fraction)
                step = number(height[ix] * row_scale)
                for r in range(np.uint64(rows + 1)):
                    column[r] = zero
                for k in range(nz):
                    row = min(max(heights[k] * step + origin, zero), last_row)
                    lower[k] = np.int32(row)
                    upper[k] = row - number(lower[k])
                for k in range(np.uint64(nz)):
                    m = np.uint32(lower[k])
                    value = volume[b, iy, ix, k]
                    part = upper[k] * value
                    column[m] += value - part
                    column[m + np.uint32(1)] += part
                right = left + np.uint64(1)
                for r in range(np.uint64(rows)):
                    slab[left, r] += near * column[r]
                    slab[right, r] += far * column[r]
        for r in range(rows):
            for i in range(columns):
                out[b, v, r, i] = slab[i, r]


forget_outdated(__name__)
