# mypy: ignore-errors
"""Triton counterparts of the CPU kernels for CUDA: the same weights, gathered on both sides, so
without atomics.

Forward: one program per (view, column), lanes along the rows; it walks the slabs. Adjoint: one
program per slab and voxels along it, lanes along z (plane: along the slab); it walks the segments,
finds by bisection the columns that touch its voxels, and adds their overlaps. A plane is a volume
of one slice without heights.
"""

from __future__ import annotations

import triton
import triton.language as tl


@triton.jit
def _read(base, zeta, last):
    """Linear interpolation of knots 0…last at ``zeta``, clamped."""
    zeta = tl.minimum(tl.maximum(zeta, 0.0), last)
    k = tl.minimum(zeta.to(tl.int32), last - 1)
    part = zeta - k
    low = tl.load(base + k)
    return low + part.to(low.dtype) * (tl.load(base + k + 1) - low)


@triton.jit
def project_kernel(
    lines,
    out,
    cells,
    pose,
    axes,
    ny,
    nx,
    knots,
    last,
    views,
    rows,
    columns,
    z0,
    dz,
    row0,
    row_pitch,
    layer,
    nearest,
    layered_below,
    PLANE: tl.constexpr,
    PARALLEL: tl.constexpr,
    BLOCK: tl.constexpr,
):
    cell = tl.program_id(0)
    view = cell // columns
    column = cell % columns
    batch = tl.program_id(2)
    row = tl.program_id(1) * BLOCK + tl.arange(0, BLOCK)
    table = cells + cell * 8
    p0, q0, p1, q1 = tl.load(table), tl.load(table + 1), tl.load(table + 2), tl.load(table + 3)
    l0, l1, path, square = (
        tl.load(table + 4),
        tl.load(table + 5),
        tl.load(table + 6),
        tl.load(table + 7),
    )
    axis = tl.load(axes + cell)
    source_z, foot = tl.load(pose + view * 8 + 2), tl.load(pose + view * 8 + 7)
    slabs = tl.where(axis == 0, ny, nx)
    width = tl.where(axis == 0, nx, ny)
    across = tl.where(axis == 0, nx, 1)
    along = tl.where(axis == 0, 1, nx)
    volume = lines + batch.to(tl.int64) * ny * nx * knots
    layered = tl.abs(l1) < layered_below * layer
    acc = tl.zeros((BLOCK,), dtype=out.dtype.element_ty)
    r = slabs * 0  # while loops: the interpreter cannot take a tensor as the end of a range
    while r < slabs:
        ta, tb = p0 + q0 * r, p1 + q1 * r
        lo = tl.maximum(tl.minimum(ta, tb), 0.0)
        hi = tl.minimum(tl.maximum(ta, tb), width.to(tl.float64))
        depth = l0 + l1 * r
        seen = hi > lo
        if not PARALLEL:
            seen = seen & (depth > nearest)
        if seen:
            scale = path / tl.abs(tb - ta)
            k = lo.to(tl.int32)
            stop = tl.minimum(tl.ceil(hi).to(tl.int32), width)
            while k < stop:
                w = scale * (tl.minimum(hi, k + 1.0) - tl.maximum(lo, k.to(tl.float64)))
                base = volume + (r * across + k * along) * knots
                if PLANE:
                    acc += w.to(acc.dtype) * tl.load(base)
                else:
                    low = tl.floor(depth / layer)
                    for m in tl.static_range(2):
                        at = tl.where(layered, (low + m) * layer, depth)
                        share = tl.where(
                            layered,
                            tl.where(m == 0, 1 - depth / layer + low, depth / layer - low),
                            1 - m,
                        )
                        at = tl.where(share > 0, at, depth)
                        step = at * row_pitch / dz
                        zeta = (source_z + at * (row0 + foot - source_z) - z0) / dz + step * row
                        change = _read(base, zeta + step, last) - _read(base, zeta, last)
                        acc += (w * share / step).to(acc.dtype) * change
                k += 1
        r += 1
    if not PLANE:
        rise = row0 + (row + 0.5) * row_pitch + foot - source_z
        acc = acc * tl.sqrt(1.0 + rise * rise / square).to(acc.dtype)
    target = out + ((batch.to(tl.int64) * views + view) * rows + row) * columns + column
    tl.store(target, acc, mask=row < rows)


@triton.jit
def backproject_kernel(
    sums,
    out,
    cells,
    pose,
    segments,
    count,
    axis,
    slabs,
    width,
    nz,
    begin,
    views,
    rows,
    columns,
    z0,
    dz,
    row0,
    row_pitch,
    layer,
    nearest,
    layered_below,
    PLANE: tl.constexpr,
    PARALLEL: tl.constexpr,
    STEPS: tl.constexpr,
    ALONG: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Add a slice of views, ``begin`` and on, to ``out``, ``(batch, slabs, width, nz)``.

    ``sums``: ``(batch, views, columns, rows + 1)`` (plane: readings); ``segments``: those of the
    slice.
    """
    blocks = tl.cdiv(width, ALONG)
    r = tl.program_id(0) // blocks
    k = (tl.program_id(0) % blocks) * ALONG + tl.arange(0, ALONG)[:, None]
    z = tl.program_id(1) * BLOCK + tl.arange(0, BLOCK)[None, :]
    batch = tl.program_id(2).to(tl.int64)
    target = out + ((batch * slabs + r) * width + k) * nz + z
    inside = (k < width) & (z < nz)
    acc = tl.load(target, mask=inside, other=0.0)
    entries = tl.where(PLANE, 1, rows + 1)
    s = slabs * 0
    while s < count:
        if tl.load(segments + s * 4 + 1) == axis:
            view = tl.load(segments + s * 4)
            start = tl.load(segments + s * 4 + 2)
            cells_in = tl.load(segments + s * 4 + 3)
            first = cells + (view * columns + start) * 8
            end = first + (cells_in - 1) * 8
            rising = (
                tl.load(end + 2) + tl.load(end + 3) * r > tl.load(first) + tl.load(first + 1) * r
            )
            source_z, foot = tl.load(pose + view * 8 + 2), tl.load(pose + view * 8 + 7)
            # First column whose far edge lies beyond the voxel's near edge.
            low = tl.zeros((ALONG, 1), dtype=tl.int64)
            high = tl.zeros((ALONG, 1), dtype=tl.int64) + cells_in
            for _ in range(STEPS):
                middle = tl.minimum((low + high) // 2, cells_in - 1)
                far = tl.load(first + middle * 8 + 2) + tl.load(first + middle * 8 + 3) * r
                beyond = tl.where(rising, far > k, far < k + 1)
                open_ = low < high
                high = tl.where(open_ & beyond, middle, high)
                low = tl.where(open_ & (beyond == 0), middle + 1, low)
            j = low
            more = tl.max(tl.where((j < cells_in) & (k < width), 1, 0))
            while more > 0:
                here = first + tl.minimum(j, cells_in - 1) * 8
                ta = tl.load(here) + tl.load(here + 1) * r
                tb = tl.load(here + 2) + tl.load(here + 3) * r
                depth = tl.load(here + 4) + tl.load(here + 5) * r
                touch = (j < cells_in) & (k < width) & tl.where(rising, ta < k + 1, ta > k)
                lo = tl.maximum(tl.minimum(ta, tb), k.to(tl.float64))
                hi = tl.minimum(tl.maximum(ta, tb), k + 1.0)
                good = touch & (hi > lo)
                if not PARALLEL:
                    good = good & (depth > nearest)
                w = tl.where(good, tl.load(here + 6) * (hi - lo) / tl.abs(tb - ta), 0.0)
                column = start + tl.minimum(j, cells_in - 1)
                base = sums + ((batch * views + view - begin) * columns + column) * entries
                if PLANE:
                    acc += tl.where(good, w.to(acc.dtype) * tl.load(base), 0.0)
                else:
                    layered = tl.abs(tl.load(here + 5)) < layered_below * layer
                    q = tl.floor(depth / layer)
                    for m in tl.static_range(2):
                        share = tl.where(
                            layered,
                            tl.where(m == 0, 1 - depth / layer + q, depth / layer - q),
                            1 - m,
                        )
                        at = tl.where(
                            good, tl.where(layered & (share > 0), (q + m) * layer, depth), 1.0
                        )
                        step = dz / (at * row_pitch)
                        rho = (
                            (z0 - source_z) / at - (row0 + foot - source_z)
                        ) / row_pitch + step * z
                        change = _read(base, rho + step, rows) - _read(base, rho, rows)
                        acc += tl.where(good, (w * share).to(acc.dtype) * change, 0.0)
                j += 1
                more = tl.max(tl.where(touch & (j < cells_in), 1, 0))
        s += 1
    tl.store(target, acc, mask=inside)
