# mypy: ignore-errors
"""Triton counterparts of the CPU's kernels for scans given by vectors: the same weights, gathered
on both sides, so without atomics and in a fixed order.

**Weights.** In slab r of its main axis a cell (or each part of one that is rolled and long) is a
rectangle along the other two axes, a and b. Its centre moves with r along a line, ``t = p + q r``
in voxels, which is computed in whole numbers of 2⁻ᵇ (``bits``), exactly; its sides grow in
proportion to the ray parameter. Only what lies beside a voxel becomes a number of the data's dtype:
float32 is relative to the voxel, wherever the grid stands.

**Forward.** Lanes are neighbouring cells of all views, which walk the slabs of their own main axis,
in a volume whose x and y are swapped for rays along x so that neighbours read neighbours.

**Adjoint.** Lanes are neighbouring voxels. A view whose rays have two main axes is visited once for
each. A cell touches a voxel if its centre lies in a rectangle about the voxel that is larger by the
widest cell of the view; where on the detector that is its projection tells, and every cell there is
asked for its weight. The projection needs no more digits than find a cell, with a margin.

A number that is no tensor is float32 to a compiled kernel: all that are not whole come in tensors
of the data's dtype.
"""

from __future__ import annotations

import triton
import triton.language as tl


@triton.jit
def _part(lines, widths, at, parts, live, PARALLEL: tl.constexpr):
    """Of a cell or one of its parts: lines of its centre along a and b; sides per ray parameter,
    the ray parameter in slab 0 and its growth, path per slab."""
    pa = tl.load(lines + at, mask=live, other=0)
    qa = tl.load(lines + parts + at, mask=live, other=0)
    pb = tl.load(lines + 2 * parts + at, mask=live, other=0)
    qb = tl.load(lines + 3 * parts + at, mask=live, other=0)
    wa = tl.load(widths + at, mask=live, other=1.0)
    wb = tl.load(widths + parts + at, mask=live, other=1.0)
    path = tl.load(widths + 2 * parts + at, mask=live, other=0.0)
    if PARALLEL:
        l0, l1 = wa, wb  # not read
    else:
        l0 = tl.load(widths + 3 * parts + at, mask=live, other=1.0)
        l1 = tl.load(widths + 4 * parts + at, mask=live, other=0.0)
    return pa, qa, pb, qb, wa, wb, path, l0, l1


@triton.jit
def _low(p, q, r, wide, bits, ulp, number: tl.constexpr):
    """Voxel that holds the centre in slab r, and the lower end beside that voxel."""
    t = p + q * r
    k = t >> bits
    return k.to(tl.int32), (t - (k << bits)).to(number) * ulp - 0.5 * wide


@triton.jit
def _overlap(low, wide, beside):
    """Of an interval with a voxel; not above 0: none."""
    inner = tl.minimum(wide, 1.0)  # exactly the whole of a narrow one
    return tl.minimum(inner, tl.minimum(low + wide - beside, beside + 1.0 - low))


@triton.jit
def _most(wide0, wide1, size):
    """Voxels of an axis of so many that an interval touches whose width is between these two."""
    wide = tl.minimum(tl.maximum(wide0, wide1), size.to(wide0.dtype))
    return tl.minimum(wide.to(tl.int32) + 2, size)


@triton.jit
def _within(p, q, wide0, growth, size, bits, ulp, low, high, number: tl.constexpr):
    """Slabs ``low`` to ``high`` without those in which an interval passes by the axis; by rounding
    one or two too many."""
    whole = p >> bits
    p = whole.to(number) + (p - (whole << bits)).to(number) * ulp
    q = q.to(number) * ulp
    slack = 0.5 * wide0 + 1e-5 * (tl.abs(p) + tl.abs(wide0) + size) + 0.01
    low, high = _above(p + slack, q + 0.5 * growth, low, high)
    return _above(size - p + slack, 0.5 * growth - q, low, high)


@triton.jit
def _above(start, growth, low, high):
    """Of ``low`` to ``high`` where a line is above 0, as far as its growth tells."""
    zero = -start / tl.where(tl.abs(growth) > 1e-3, growth, 1.0)
    low = tl.where(growth > 1e-3, tl.maximum(low, zero - 1.0), low)
    return low, tl.where(growth < -1e-3, tl.minimum(high, zero + 1.0), high)


@triton.jit
def project_vectors(
    images,
    out,
    lines,
    widths,
    axes,
    starts,
    numbers,
    bits,
    nx,
    ny,
    nz,
    voxels,
    count,
    parts,
    begin,
    readings,
    PLANE: tl.constexpr,
    PARALLEL: tl.constexpr,
    PARTS: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """``images``: ``(batch, 2, voxels)``, the second one with x and y swapped; ``out``: ``(batch,
    readings)``, of which ``count`` from ``begin`` on are written; ``lines, widths``: ``(4, parts)``
    and ``(5, parts)``; ``axes``: of each cell; ``starts``: of each cell its first part, where they
    have several."""
    number: tl.constexpr = out.dtype.element_ty
    cell, batch = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK), tl.program_id(1).to(tl.int64)
    inside = cell < count
    axis = tl.load(axes + cell, mask=inside, other=1)
    # a, b: z, y of rays along x; z, x of rays along y; y, x of rays along z
    slabs = tl.where(axis == 0, nx, tl.where(axis == 1, ny, nz))
    size_a, size_b = tl.where(axis == 2, ny, nz), tl.where(axis == 0, ny, nx)
    step_a = tl.where(axis == 2, nx, nx * ny)
    step_r = tl.where(axis == 0, ny, tl.where(axis == 1, nx, nx * ny))
    ulp, nearest, point = tl.load(numbers), tl.load(numbers + 1), tl.load(numbers + 2)
    image = images + (batch * 2 + tl.where(axis == 0, 1, 0)) * voxels
    if PARTS:
        first = tl.load(starts + cell, mask=inside, other=0)
        own = tl.load(starts + cell + 1, mask=inside, other=0) - first
        rounds = tl.max(own)
    else:
        first, own, rounds = cell, tl.where(inside, 1, 0), 1
    acc = tl.zeros((BLOCK,), dtype=number)
    for n in tl.range(0, rounds):
        live = n < own
        pa, qa, pb, qb, wa, wb, path, l0, l1 = _part(
            lines, widths, first + n, parts, live, PARALLEL
        )
        low, high = tl.zeros((BLOCK,), dtype=number), (slabs - 1).to(number)
        if PARALLEL:
            if not PLANE:
                low, high = _within(pa, qa, wa, 0.0, size_a, bits, ulp, low, high, number)
            low, high = _within(pb, qb, wb, 0.0, size_b, bits, ulp, low, high, number)
            many_a = tl.max(tl.where(live, _most(wa, wa, size_a), 0))
            many_b = tl.max(tl.where(live, _most(wb, wb, size_b), 0))
        else:
            if not PLANE:
                low, high = _within(pa, qa, wa * l0, wa * l1, size_a, bits, ulp, low, high, number)
            low, high = _within(pb, qb, wb * l0, wb * l1, size_b, bits, ulp, low, high, number)
            l2 = l0 + l1 * (slabs - 1)
            many_a = tl.max(tl.where(live, _most(wa * l0, wa * l2, size_a), 0))
            many_b = tl.max(tl.where(live, _most(wb * l0, wb * l2, size_b), 0))
        if PLANE:
            many_a = 1
        live = live & (low <= high)
        begun = tl.min(tl.where(live, low.to(tl.int32), 1 << 30))
        ended = tl.max(tl.where(live, high.to(tl.int32), -1)) + 1
        for r in tl.range(begun, ended):
            seen = live & (r < slabs)
            wide_a, wide_b = wa, wb
            if not PARALLEL:
                t = l0 + l1 * r
                seen = seen & (t > nearest)
                wide_a, wide_b = wa * t, wb * t
            wide_a, wide_b = tl.maximum(wide_a, point), tl.maximum(wide_b, point)
            kb, low_b = _low(pb, qb, r, wide_b, bits, ulp, number)
            first_b = tl.maximum(kb + tl.floor(low_b).to(tl.int32), 0)
            if PLANE:
                ka, low_a, first_a, scale = kb, low_b, tl.zeros_like(kb), path / wide_b
            else:
                ka, low_a = _low(pa, qa, r, wide_a, bits, ulp, number)
                first_a = tl.maximum(ka + tl.floor(low_a).to(tl.int32), 0)
                scale = path / (wide_a * wide_b)
            slab = r * step_r.to(tl.int64)
            for m in tl.range(0, many_a):
                k = first_a + m
                if PLANE:
                    w, good = scale, seen
                else:
                    w = _overlap(low_a, wide_a, (k - ka).to(number))
                    good = seen & (k < size_a) & (w > 0)
                    w = w * scale
                row = image + slab + k * step_a.to(tl.int64)
                for c in tl.range(0, many_b):
                    j = first_b + c
                    v = _overlap(low_b, wide_b, (j - kb).to(number))
                    touched = good & (j < size_b) & (v > 0)
                    value = tl.load(row + j, mask=touched, other=0.0)
                    acc += tl.where(touched, w * v, 0.0) * value
    tl.store(out + batch * readings + begin + cell, acc, mask=inside)


@triton.jit
def _place(table, r, a, b):
    """An affine function of a voxel's place, and what it grows by along a and b."""
    along_a, along_b = tl.load(table + 2), tl.load(table + 3)
    return tl.load(table) + tl.load(table + 1) * r + along_a * a + along_b * b, along_a, along_b


@triton.jit
def _range(place, along_a, along_b, half_a, half_b, tiny, slack, last, whole):
    """First and number of the detector's rows or columns about a place whose share in what is
    looked at is ``half`` along either axis."""
    reach = (tl.abs(along_a) * half_a + tl.abs(along_b) * half_b + tiny) + slack
    low = tl.ceil(tl.maximum(place - reach, 0.0))
    high = tl.floor(tl.minimum(place + reach, last))
    low, high = tl.where(whole, 0.0, tl.minimum(low, last + 1.0)), tl.where(whole, last, high)
    return low.to(tl.int32), tl.maximum(high - low + 1.0, 0.0).to(tl.int32)


@triton.jit
def backproject_vectors(
    data,
    out,
    lines,
    widths,
    axes,
    starts,
    entries,
    projections,
    numbers,
    bits,
    count,
    nx,
    ny,
    nz,
    voxels,
    parts,
    begin,
    views,
    rows,
    columns,
    PLANE: tl.constexpr,
    PARALLEL: tl.constexpr,
    PARTS: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Add ``count`` entries (a view and one of its main axes) to ``out``, ``(batch, voxels)``.

    ``data``: ``(batch, views, rows, columns)``; ``lines, widths, axes, starts``: of the cells from
    view ``begin`` on; ``entries``: ``(count, 2)`` view and axis; ``projections``: ``(count, 20)``,
    see ``vector_passes``.
    """
    number: tl.constexpr = out.dtype.element_ty
    voxel = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    batch = tl.program_id(1).to(tl.int64)
    inside = voxel < voxels
    x, y = (voxel % nx).to(tl.int32), (voxel // nx % ny).to(tl.int32)
    z = (voxel // nx // ny).to(tl.int32)
    ulp, nearest, point = tl.load(numbers), tl.load(numbers + 1), tl.load(numbers + 2)
    last_row, last_column = tl.load(numbers + 3), tl.load(numbers + 4)
    middle_x, middle_y, middle_z = (
        tl.load(numbers + 5),
        tl.load(numbers + 6),
        tl.load(numbers + 7),
    )
    acc = tl.load(out + batch * voxels + voxel, mask=inside, other=0.0)
    for s in tl.range(0, count):
        view, axis = tl.load(entries + s * 2), tl.load(entries + s * 2 + 1)
        table = projections + s * 20
        r = tl.where(axis == 0, x, tl.where(axis == 1, y, z))
        ka, kb = tl.where(axis == 2, y, z), tl.where(axis == 0, y, x)
        at_r = r - tl.where(axis == 0, middle_x, tl.where(axis == 1, middle_y, middle_z))
        at_a = ka - tl.where(axis == 2, middle_y, middle_z)
        at_b = kb - tl.where(axis == 0, middle_y, middle_x)
        column, column_a, column_b = _place(table, at_r, at_a, at_b)
        row, row_a, row_b = _place(table + 4, at_r, at_a, at_b)
        wide_a, wide_b = tl.load(table + 12), tl.load(table + 13)
        shown, whole = inside, inside & (r < 0)
        tiny_column, tiny_row = tl.load(table + 15), tl.load(table + 16)
        half_a, half_b = 0.5 + 0.5 * wide_a, 0.5 + 0.5 * wide_b
        if not PARALLEL:
            depth, depth_a, depth_b = _place(table + 8, at_r, at_a, at_b)
            away = tl.abs(at_r - tl.load(table + 14))  # slabs from the source's
            half_a, half_b = 0.5 + 0.5 * wide_a * away, 0.5 + 0.5 * wide_b * away
            spread = tl.abs(depth_a) * half_a + tl.abs(depth_b) * half_b + tl.load(table + 17)
            # Of what lies beside the source no projection bounds the place.
            whole = inside & (tl.abs(depth) <= spread)
            shown = inside & (depth > -spread)
            depth_ok = tl.where(depth > spread, depth, 1.0)
            near = tl.where(depth > spread, depth - spread, 1.0)
            column, row = column / depth_ok, row / depth_ok
            column_a, column_b = (
                (column_a - column * depth_a) / near,
                (column_b - column * depth_b) / near,
            )
            row_a, row_b = (row_a - row * depth_a) / near, (row_b - row * depth_b) / near
            tiny_column, tiny_row = tiny_column / near, tiny_row / near
        j0, many_j = _range(
            column,
            column_a,
            column_b,
            half_a,
            half_b,
            tiny_column,
            tl.load(table + 18),
            last_column,
            whole,
        )
        if PLANE:
            i0, many_i = tl.zeros_like(j0), tl.where(shown, 1, 0)
        else:
            i0, many_i = _range(
                row, row_a, row_b, half_a, half_b, tiny_row, tl.load(table + 19), last_row, whole
            )
        many_i, many_j = tl.where(shown, many_i, 0), tl.where(shown, many_j, 0)
        given = data + ((batch * views + view) * rows) * columns
        for m in tl.range(0, tl.max(many_i)):
            for c in tl.range(0, tl.max(many_j)):
                place = (i0 + m) * columns + j0 + c
                asked = (m < many_i) & (c < many_j)
                cell = (view - begin) * (rows * columns) + place
                asked = asked & (tl.load(axes + cell, mask=asked, other=-1) == axis)
                value = tl.load(given + place, mask=asked, other=0.0)
                first, own, rounds = cell, tl.where(asked, 1, 0), 1
                if PARTS:
                    first = tl.load(starts + cell, mask=asked, other=0)
                    own = tl.load(starts + cell + 1, mask=asked, other=0) - first
                    rounds = tl.max(own)
                for n in tl.range(0, rounds):
                    live = n < own
                    pa, qa, pb, qb, wa, wb, path, l0, l1 = _part(
                        lines, widths, first + n, parts, live, PARALLEL
                    )
                    good = live
                    if not PARALLEL:
                        t = l0 + l1 * r
                        good = good & (t > nearest)
                        wa, wb = wa * t, wb * t
                    wa, wb = tl.maximum(wa, point), tl.maximum(wb, point)
                    k, low = _low(pb, qb, r, wb, bits, ulp, number)
                    v = _overlap(low, wb, (kb - k).to(number))
                    good = good & (v > 0)
                    w = path * v / wb
                    if not PLANE:
                        k, low = _low(pa, qa, r, wa, bits, ulp, number)
                        v = _overlap(low, wa, (ka - k).to(number))
                        good = good & (v > 0)
                        w = w * v / wa
                    acc += tl.where(good, w, 0.0) * value
    tl.store(out + batch * voxels + voxel, acc, mask=inside)
