# mypy: ignore-errors
"""Triton counterparts of the CPU kernels for CUDA: the same weights, gathered on both sides, so
without atomics and in a fixed order.

**Places.** Where the edge of a cell crosses slab r, ``t = p + q r`` in voxels, is computed in whole
numbers of 2⁻ᵇ (``bits``), exactly; only what is left beside a voxel becomes a number of the data's
dtype. So float32 is relative to the voxel, and float64 is not needed, which cards for graphics
compute 64 times as slowly.

**Forward.** Plane: lanes are neighbouring columns of one view, which walk the slabs of their own
main axis, in an image that is turned for one of them so that neighbours read neighbours. Cone: one
program per (view, column), lanes along the rows, four of them each: neighbours share an edge, which
is read once; a second depth layer is read only by cells that share layers.

**Adjoint.** Plane: lanes are the voxels of a slab. Cone: one program per voxel column, lanes along
z, four slices each. It walks the segments. All edges of a segment pass through the source, so their
slope ``q`` tells them apart whatever the slab (of parallel rays, ``p``): a table of equal steps of
it says with which column a voxel begins, with one look-up instead of a bisection. From there on the
columns are followed until they are past the voxel.

A number that is no tensor is float32 to a compiled kernel: all that are not whole come in tensors
of the data's dtype.
"""

from __future__ import annotations

import triton
import triton.language as tl


@triton.jit
def _edges(lines, cell):
    """p and q of both edges of a cell."""
    at = lines + cell * 4
    return tl.load(at), tl.load(at + 1), tl.load(at + 2), tl.load(at + 3)


@triton.jit
def _crossing(ta, tb, bits, ulp, number: tl.constexpr):
    """Of a cell whose edges cross a slab at ta and tb the lower end of its overlap: whole voxel and
    what lies beside it; and its width, all in voxels."""
    low = tl.minimum(ta, tb)
    k = low >> bits
    part = (low - (k << bits)).to(number) * ulp
    width = (tl.maximum(ta, tb) - low).to(number) * ulp
    return k.to(tl.int32), part, width


@triton.jit
def _knot(place, last):
    """Of a place among knots 0…last, clamped: the knot below, and how far beyond it it lies."""
    place = tl.minimum(tl.maximum(place, 0.0), last)
    k = tl.minimum(place.to(tl.int32), last - 1)
    return k, place - k


@triton.jit
def _read(base, k, part):
    """Linear interpolation between a knot and the next."""
    low = tl.load(base + k)
    return low + part * (tl.load(base + k + 1) - low)


@triton.jit
def _four(base, place, step, last):
    """Of four cells side by side, the first of which begins at ``place``, the changes of what is
    tabulated at knots 0…last. Neighbours share an edge, which is read once."""
    k0, part0 = _knot(place, last)
    k1, part1 = _knot(place + step, last)
    k2, part2 = _knot(place + 2 * step, last)
    k3, part3 = _knot(place + 3 * step, last)
    k4, part4 = _knot(place + 4 * step, last)
    e0, e1, e2 = _read(base, k0, part0), _read(base, k1, part1), _read(base, k2, part2)
    e3, e4 = _read(base, k3, part3), _read(base, k4, part4)
    return e1 - e0, e2 - e1, e3 - e2, e4 - e3


@triton.jit
def _four_rows(volume, first, stop, apart, knots, k0, part, wide, place, step, last):
    """What four rows side by side see of the voxels first…stop of a slab, weighted by the width of
    the overlap. Before the interpolation, which all voxels of a slab have in common, knots are
    summed over the voxels: ``a`` those below the five edges of the rows, ``b`` those above."""
    at0, part0 = _knot(place, last)
    at1, part1 = _knot(place + step, last)
    at2, part2 = _knot(place + 2 * step, last)
    at3, part3 = _knot(place + 3 * step, last)
    at4, part4 = _knot(place + 4 * step, last)
    a0, a1, a2, a3, a4 = place * 0, place * 0, place * 0, place * 0, place * 0
    b0, b1, b2, b3, b4 = a0, a0, a0, a0, a0
    for k in tl.range(first, stop):
        d = (k - k0).to(place.dtype)
        w = tl.minimum(part + wide, d + 1.0) - tl.maximum(part, d)
        base = volume + (k * apart).to(tl.int64) * knots
        a0 += w * tl.load(base + at0)
        b0 += w * tl.load(base + at0 + 1)
        a1 += w * tl.load(base + at1)
        b1 += w * tl.load(base + at1 + 1)
        a2 += w * tl.load(base + at2)
        b2 += w * tl.load(base + at2 + 1)
        a3 += w * tl.load(base + at3)
        b3 += w * tl.load(base + at3 + 1)
        a4 += w * tl.load(base + at4)
        b4 += w * tl.load(base + at4 + 1)
    e0, e1, e2 = a0 + part0 * (b0 - a0), a1 + part1 * (b1 - a1), a2 + part2 * (b2 - a2)
    e3, e4 = a3 + part3 * (b3 - a3), a4 + part4 * (b4 - a4)
    return e1 - e0, e2 - e1, e3 - e2, e4 - e3


@triton.jit
def project_plane(
    images,
    out,
    lines,
    depths,
    axes,
    numbers,
    bits,
    count,
    ny,
    nx,
    most,
    views,
    columns,
    blocks,
    PARALLEL: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """``images``: ``(batch, 2, ny * nx)``, the second one turned; ``out``: ``(batch, views,
    columns)``; ``count``: voxels that a cell touches in a slab at most."""
    number: tl.constexpr = out.dtype.element_ty
    view, batch = tl.program_id(0) // blocks, tl.program_id(1).to(tl.int64)
    column = (tl.program_id(0) % blocks) * BLOCK + tl.arange(0, BLOCK)
    inside = column < columns
    cell = view * columns + tl.minimum(column, columns - 1)
    axis = tl.load(axes + cell)
    slabs, width = tl.where(axis == 0, ny, nx), tl.where(axis == 0, nx, ny)
    l0, l1, path = (
        tl.load(depths + cell * 4),
        tl.load(depths + cell * 4 + 1),
        tl.load(depths + cell * 4 + 2),
    )
    ulp, nearest = tl.load(numbers), tl.load(numbers + 1)
    image = images + (batch * 2 + axis) * (ny * nx)
    ta, qa, tb, qb = _edges(lines, cell)
    acc = tl.zeros((BLOCK,), dtype=number)
    for r in tl.range(0, most):
        seen = inside & (r < slabs)
        if not PARALLEL:
            seen = seen & (l0 + l1 * r > nearest)
        k0, part, wide = _crossing(ta, tb, bits, ulp, number)
        ta, tb = ta + qa, tb + qb
        first = tl.maximum(k0, 0)
        scale = path / wide
        for m in tl.range(0, count):
            k = first + m
            beside = (k - k0).to(number)
            w = tl.minimum(part + wide, beside + 1.0) - tl.maximum(part, beside)
            good = seen & (k < width) & (w > 0)
            value = tl.load(image + r * width + k, mask=good, other=0.0)
            acc += tl.where(good, scale * w, 0.0) * value
    tl.store(out + (batch * views + view) * columns + column, acc, mask=inside)


@triton.jit
def project_cone(
    sums,
    out,
    lines,
    depths,
    axes,
    heights,
    numbers,
    bits,
    ny,
    nx,
    knots,
    last,
    views,
    rows,
    columns,
    middle,
    BLOCK: tl.constexpr,
):
    """``sums``: running sums along z, ``(batch, ny, nx, knots)``; ``heights``: ``(views, 5)``, see
    ``passes``; ``out``: ``(batch, views, rows, columns)``. A lane has four rows."""
    number: tl.constexpr = out.dtype.element_ty
    cell, batch = tl.program_id(0), tl.program_id(2).to(tl.int64)
    view, column = cell // columns, cell % columns
    row = 4 * (tl.program_id(1) * BLOCK + tl.arange(0, BLOCK))
    beside = (row - middle).to(number)
    axis = tl.load(axes + cell)
    slabs, width = tl.where(axis == 0, ny, nx), tl.where(axis == 0, nx, ny)
    across, along = tl.where(axis == 0, nx, 1), tl.where(axis == 0, 1, nx)
    l0, l1 = tl.load(depths + cell * 4), tl.load(depths + cell * 4 + 1)
    path, square = tl.load(depths + cell * 4 + 2), tl.load(depths + cell * 4 + 3)
    ulp, nearest, layer = tl.load(numbers), tl.load(numbers + 1), tl.load(numbers + 2)
    pitch, layered = tl.load(numbers + 4), tl.abs(l1) < tl.load(numbers + 3)
    source, climb = tl.load(heights + view * 5), tl.load(heights + view * 5 + 1)
    volume = sums + batch * ny * nx * knots
    ta, qa, tb, qb = _edges(lines, cell)
    acc0, acc1 = tl.zeros((BLOCK,), dtype=number), tl.zeros((BLOCK,), dtype=number)
    acc2, acc3 = tl.zeros((BLOCK,), dtype=number), tl.zeros((BLOCK,), dtype=number)
    for r in tl.range(0, slabs):
        k0, part, wide = _crossing(ta, tb, bits, ulp, number)
        ta, tb = ta + qa, tb + qb
        depth = l0 + l1 * r
        first = tl.maximum(k0, 0)
        stop = tl.minimum(k0 + tl.ceil(part + wide).to(tl.int32), width)
        if (first < stop) & (depth > nearest):
            whole = tl.floor(depth / layer)
            upper = depth / layer - whole
            at = tl.where(layered, whole * layer, depth)
            share = path / wide * tl.where(layered, 1.0 - upper, 1.0)
            slab = volume + (r * across).to(tl.int64) * knots
            step = at * pitch
            place = source + at * climb + step * beside
            d0, d1, d2, d3 = _four_rows(
                slab, first, stop, along, knots, k0, part, wide, place, step, last
            )
            acc0 += share / step * d0
            acc1 += share / step * d1
            acc2 += share / step * d2
            acc3 += share / step * d3
            if layered & (upper > 0):
                share = path / wide * upper
                step = (at + layer) * pitch
                place = source + (at + layer) * climb + step * beside
                d0, d1, d2, d3 = _four_rows(
                    slab, first, stop, along, knots, k0, part, wide, place, step, last
                )
                acc0 += share / step * d0
                acc1 += share / step * d1
                acc2 += share / step * d2
                acc3 += share / step * d3
    rise, pitch = tl.load(heights + view * 5 + 2), tl.load(numbers + 5)
    rise = rise + pitch * beside
    target = out + ((batch * views + view) * rows + row) * columns + column
    acc0 = acc0 * tl.sqrt(1.0 + rise * rise / square)
    tl.store(target, acc0, mask=row < rows)
    rise += pitch
    acc1 = acc1 * tl.sqrt(1.0 + rise * rise / square)
    tl.store(target + columns, acc1, mask=row + 1 < rows)
    rise += pitch
    acc2 = acc2 * tl.sqrt(1.0 + rise * rise / square)
    tl.store(target + 2 * columns, acc2, mask=row + 2 < rows)
    rise += pitch
    acc3 = acc3 * tl.sqrt(1.0 + rise * rise / square)
    tl.store(target + 3 * columns, acc3, mask=row + 3 < rows)


@triton.jit
def _keys(table, r, k, PARALLEL: tl.constexpr):
    """Of voxels k of slab r in a segment: the lower one of the keys of their two edges, how many
    keys one is wide, and whether the slab lies before the source."""
    slope, start, sign = tl.load(table), tl.load(table + 1), tl.load(table + 2)
    if PARALLEL:
        low, wide, front = k - slope * r, sign * sign, sign != 0
    else:
        away = r - slope  # slabs from the source's
        front = away * sign > 0
        away = tl.where(away == 0, 1.0, away)
        low = tl.minimum((k - start) / away, (k + 1 - start) / away)
        wide = 1.0 / tl.abs(away)
    return low, wide, front


@triton.jit
def _first(of, table, buckets, low):
    """The first column of a segment, in the order of its keys, that may touch what begins at a
    key."""
    step = (low - tl.load(table + 3)) * tl.load(table + 4)
    step = tl.minimum(tl.maximum(step, 0.0), tl.load(of + 4) - 1)
    return tl.load(buckets + tl.load(of + 3) + step.to(tl.int32))


@triton.jit
def _many(of, table, wide, front, cells):
    """How many columns a voxel touches at most: its width, and a step of the table, in the
    narrowest cells of the segment."""
    many = tl.minimum(wide * tl.load(table + 5), cells).to(tl.int32) + tl.load(of + 5)
    return tl.where(front, tl.minimum(many, cells), 0)


@triton.jit
def backproject_plane(
    data,
    out,
    lines,
    depths,
    segments,
    tables,
    buckets,
    numbers,
    bits,
    count,
    slabs,
    width,
    begin,
    views,
    columns,
    blocks,
    PARALLEL: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Add a slice of views, ``begin`` and on, to ``out``, ``(batch, slabs, width)``.

    ``data``: ``(batch, views, columns)``; ``segments, tables``: of the slice and of one main axis,
    see ``passes``.
    """
    number: tl.constexpr = out.dtype.element_ty
    r, batch = tl.program_id(0) // blocks, tl.program_id(1).to(tl.int64)
    k = (tl.program_id(0) % blocks) * BLOCK + tl.arange(0, BLOCK)
    ulp = tl.load(numbers)
    target = out + (batch * slabs + r) * width + k
    acc = tl.load(target, mask=k < width, other=0.0)
    for s in tl.range(0, count):
        of, table = segments + s * 6, tables + s * 6
        view, first, cells = tl.load(of), tl.load(of + 1), tl.load(of + 2)
        low, wide, front = _keys(table, r, k, PARALLEL)
        backward = cells < 0
        cells = tl.abs(cells)
        j, many = _first(of, table, buckets, low), _many(of, table, wide, front, cells)
        for m in tl.range(0, many):
            c = tl.minimum(j + m, cells - 1)
            column = first + tl.where(backward, cells - 1 - c, c)
            cell = view * columns + column
            p0, q0, p1, q1 = _edges(lines, cell)
            k0, part, breadth = _crossing(p0 + q0 * r, p1 + q1 * r, bits, ulp, number)
            near = (k0 - k).to(number) + part
            w = tl.minimum(near + breadth, 1.0) - tl.maximum(near, 0.0)
            good = (j + m < cells) & (k < width) & (w > 0)
            path = tl.load(depths + cell * 4 + 2)
            value = tl.load(
                data + (batch * views + view - begin) * columns + column, mask=good, other=0.0
            )
            acc += tl.where(good, path / breadth * w, 0.0) * value
    tl.store(target, acc, mask=k < width)


@triton.jit
def backproject_cone(
    sums,
    out,
    lines,
    depths,
    segments,
    tables,
    buckets,
    heights,
    numbers,
    bits,
    count,
    slabs,
    width,
    nz,
    begin,
    views,
    rows,
    columns,
    middle,
    BLOCK: tl.constexpr,
):
    """Add a slice of views, ``begin`` and on, to ``out``, ``(batch, slabs, width, nz)``.

    ``sums``: running sums along the rows, ``(batch, views, columns, rows + 1)``. A lane has four
    slices.
    """
    number: tl.constexpr = out.dtype.element_ty
    r, k = tl.program_id(0) // width, tl.program_id(0) % width
    z = 4 * (tl.program_id(1) * BLOCK + tl.arange(0, BLOCK))
    batch = tl.program_id(2).to(tl.int64)
    beside = (z - middle).to(number)
    ulp, nearest, layer = tl.load(numbers), tl.load(numbers + 1), tl.load(numbers + 2)
    limit, pitch = tl.load(numbers + 3), tl.load(numbers + 6)
    target = out + ((batch * slabs + r) * width + k) * nz + z
    acc0 = tl.load(target, mask=z < nz, other=0.0)
    acc1 = tl.load(target + 1, mask=z + 1 < nz, other=0.0)
    acc2 = tl.load(target + 2, mask=z + 2 < nz, other=0.0)
    acc3 = tl.load(target + 3, mask=z + 3 < nz, other=0.0)
    for s in tl.range(0, count):
        of, table = segments + s * 6, tables + s * 6
        view, first, cells = tl.load(of), tl.load(of + 1), tl.load(of + 2)
        low, wide, front = _keys(table, r, k, False)
        backward = cells < 0
        cells = tl.abs(cells)
        j, many = _first(of, table, buckets, low), _many(of, table, wide, front, cells)
        many = tl.minimum(many, cells - j)
        source, foot = tl.load(heights + view * 5 + 3), tl.load(heights + view * 5 + 4)
        for m in tl.range(0, many):
            c = j + m
            column = first + tl.where(backward, cells - 1 - c, c)
            cell = view * columns + column
            p0, q0, p1, q1 = _edges(lines, cell)
            k0, part, breadth = _crossing(p0 + q0 * r, p1 + q1 * r, bits, ulp, number)
            near = (k0 - k).to(number) + part
            w = tl.minimum(near + breadth, 1.0) - tl.maximum(near, 0.0)
            l1 = tl.load(depths + cell * 4 + 1)
            depth = tl.load(depths + cell * 4) + l1 * r
            if (w > 0) & (depth > nearest):
                w = w * tl.load(depths + cell * 4 + 2) / breadth
                base = sums + ((batch * views + view - begin) * columns + column) * (rows + 1)
                layered = tl.abs(l1) < limit
                whole = tl.floor(depth / layer)
                upper = depth / layer - whole
                at = tl.where(layered, whole * layer, depth)
                share = w * tl.where(layered, 1.0 - upper, 1.0)
                step = pitch / at
                place = source / at - foot + step * beside
                d0, d1, d2, d3 = _four(base, place, step, rows)
                acc0 += share * d0
                acc1 += share * d1
                acc2 += share * d2
                acc3 += share * d3
                if layered & (upper > 0):
                    step = pitch / (at + layer)
                    place = source / (at + layer) - foot + step * beside
                    d0, d1, d2, d3 = _four(base, place, step, rows)
                    acc0 += w * upper * d0
                    acc1 += w * upper * d1
                    acc2 += w * upper * d2
                    acc3 += w * upper * d3
    tl.store(target, acc0, mask=z < nz)
    tl.store(target + 1, acc1, mask=z + 1 < nz)
    tl.store(target + 2, acc2, mask=z + 2 < nz)
    tl.store(target + 3, acc3, mask=z + 3 < nz)
