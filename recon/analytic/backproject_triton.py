# mypy: ignore-errors
"""Triton counterparts of the backprojection of :mod:`recon.analytic.backproject_kernels`.

One program holds a block of voxels and sums over all views: no atomics, and every voxel's sum has a
fixed order. Of a plane the lanes are pixels of a grid row; of a volume they are slices (innermost,
so that they read neighbouring rows of a detector column) of some voxel columns.

Positions are computed relative to that of the grid's centre, which is known in float64: with
(A, D) the coordinates across and along the central ray, A = A₀ + a and D = D₀ − d,

    A / D − A₀ / D₀ = (a D₀ + A₀ d) / (D D₀),

and for a curved detector the angle between both rays is atan2(a D₀ + A₀ d, D D₀ + A A₀). So float32
loses nothing of a small grid far from the axis.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

ENTRIES = 6
"""Of the table of a view: cosine, sine, A₀, D₀ (mm), the part of a column by which the centre's
position exceeds a whole one, and the displacement upwards (mm)."""
LANES = 128
"""Pixels of a program of a plane, and voxels of one of a volume."""


@triton.jit
def _place(
    table,
    whole,
    view,
    x,
    y,
    sod,
    unit,
    atan,
    KIND: tl.constexpr,
    TERMS: tl.constexpr,
    ENTRIES: tl.constexpr,
):
    """Column position (its whole part apart), distance weight and 1 / depth (curved: 1 / distance)
    of voxels at (x, y) from the grid's centre."""
    at = table + view * ENTRIES
    c, s, across0, depth0 = tl.load(at), tl.load(at + 1), tl.load(at + 2), tl.load(at + 3)
    part, start = tl.load(at + 4), tl.load(whole + view)
    a, d = y * c - x * s, x * c + y * s
    depth = depth0 - d
    if KIND == 0:
        position = a * unit + part
        inverse = depth * 0 + 1
        weight = inverse
    elif KIND == 1:
        inverse = 1.0 / depth
        position = (a * depth0 + across0 * d) * inverse * (unit / depth0) + part
        weight = sod * inverse * (sod * inverse)
    else:
        across = across0 + a
        square = across * across + depth * depth
        num, den = a * depth0 + across0 * d, depth * depth0 + across * across0
        t = num / (tl.sqrt(num * num + den * den) + den)
        t2 = t * t
        value = t2 * 0 + tl.load(atan)
        for m in tl.static_range(1, TERMS):
            value = value * t2 + tl.load(atan + m)
        position = value * t * unit + part
        inverse = 1.0 / tl.sqrt(square)
        weight = sod * inverse * (sod * inverse)
    return position, start, weight, inverse


@triton.jit
def _between(position, start, last):
    """The left one of two neighbours, and the share of the right one; the outermost is repeated."""
    low = tl.floor(position)
    share = position - low
    k = low.to(tl.int32) + start
    share = tl.where(k < 0, 0.0, tl.where(k > last, 1.0, share)).to(position.dtype)
    return tl.minimum(tl.maximum(k, 0), last), share


@triton.jit
def _plane_kernel(
    data,
    out,
    table,
    whole,
    atan,
    numbers,
    views,
    columns,
    step,
    last,
    ny,
    nx,
    KIND: tl.constexpr,
    TERMS: tl.constexpr,
    ENTRIES: tl.constexpr,
    BLOCK: tl.constexpr,
):
    row = tl.program_id(0) % ny
    batch = (tl.program_id(0) // ny).to(tl.int64)
    k = tl.program_id(1) * BLOCK + tl.arange(0, BLOCK)
    y = tl.load(numbers) + tl.load(numbers + 1) * row
    x = tl.load(numbers + 2) + tl.load(numbers + 3) * k
    sod, unit = tl.load(numbers + 4), tl.load(numbers + 5)
    acc = tl.zeros((BLOCK,), dtype=data.dtype.element_ty)
    sinogram = data + batch * views * columns
    for v in tl.range(0, views):
        position, start, weight, _ = _place(
            table, whole, v, x, y, sod, unit, atan, KIND, TERMS, ENTRIES
        )
        low, share = _between(position, start, last)
        near = sinogram + v * columns + low
        left, right = tl.load(near), tl.load(near + step)
        acc += weight * (left + share * (right - left))
    tl.store(out + (batch * ny + row) * nx + k, acc, mask=k < nx)


@triton.jit
def _volume_kernel(
    data,
    out,
    table,
    whole,
    atan,
    numbers,
    views,
    rows,
    columns,
    step,
    last,
    row_step,
    row_last,
    nz,
    ny,
    nx,
    KIND: tl.constexpr,
    TERMS: tl.constexpr,
    ENTRIES: tl.constexpr,
    ALONG: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """``data``: ``(batch, views, columns, rows)``; ``out``: ``(batch, y, x, z)``."""
    pixel = tl.program_id(0) * ALONG + tl.arange(0, ALONG)[:, None]
    k = tl.program_id(1) * BLOCK + tl.arange(0, BLOCK)[None, :]
    batch = tl.program_id(2).to(tl.int64)
    z = tl.load(numbers) + tl.load(numbers + 1) * k
    y = tl.load(numbers + 2) + tl.load(numbers + 3) * (pixel // nx)
    x = tl.load(numbers + 4) + tl.load(numbers + 5) * (pixel % nx)
    sod, unit = tl.load(numbers + 6), tl.load(numbers + 7)
    row_unit, row_start = tl.load(numbers + 8), tl.load(numbers + 9)
    acc = tl.zeros((ALONG, BLOCK), dtype=data.dtype.element_ty)
    for v in tl.range(0, views):
        position, start, weight, inverse = _place(
            table, whole, v, x, y, sod, unit, atan, KIND, TERMS, ENTRIES
        )
        low, share = _between(position, start, last)
        height = (z + tl.load(table + v * ENTRIES + 5)) * (inverse * row_unit) + row_start
        row, part = _between(height, 0, row_last)
        near = data + ((batch * views + v) * columns + low) * rows + row
        a, b = tl.load(near), tl.load(near + row_step)
        c, d = tl.load(near + step), tl.load(near + step + row_step)
        left, right = a + part * (b - a), c + part * (d - c)
        acc += weight * (left + share * (right - left))
    target = out + (batch * ny * nx + pixel) * nz + k
    tl.store(target, acc, mask=(pixel < ny * nx) & (k < nz))


def backproject_plane(
    data: Tensor,
    out: Tensor,
    table: Tensor,
    whole: Tensor,
    atan: Tensor,
    numbers: Tensor,
    kind: int,
) -> None:
    """``data (B, V, columns)`` into ``out (B, Y, X)``, both contiguous.

    Args:
        data, out: of one dtype, as ``table``, ``atan`` and ``numbers``. (A number that is no tensor
            is float32 to a compiled kernel.)
        table: ``(V, ENTRIES)``.
        whole: ``(V,)`` int32, the column below the position of the grid's centre.
        atan: coefficients c of 2 atan(t) = t c(t²), highest power first.
        numbers: first y from the grid's centre and pitch, the same of x; sod; columns per unit of
            the tangent or of the angle.
        kind: of beam, see :mod:`recon.analytic.backproject_kernels`.
    """
    batch, views, columns = data.shape
    ny, nx = out.shape[1:]
    block = min(LANES, triton.next_power_of_2(nx))
    _plane_kernel[(batch * ny, triton.cdiv(nx, block))](
        data,
        out,
        table,
        whole,
        atan,
        numbers,
        views,
        columns,
        *_ends(columns),
        ny,
        nx,
        KIND=kind,
        TERMS=len(atan),
        ENTRIES=ENTRIES,
        BLOCK=block,
        num_warps=_warps(block),
    )


def backproject_volume(
    data: Tensor,
    out: Tensor,
    table: Tensor,
    whole: Tensor,
    atan: Tensor,
    numbers: Tensor,
    kind: int,
) -> None:
    """``data (B, V, rows, columns)`` into ``out (B, Z, Y, X)``.

    Arguments as of :func:`backproject_plane`; ``numbers``: first z and pitch, those of y and x from
    the grid's centre, sod, columns per unit, rows per unit of z over depth and the row at height 0.
    """
    batch, views, rows, columns = data.shape
    nz, ny, nx = out.shape[1:]
    block = min(LANES, 64, triton.next_power_of_2(nz))
    along = max(1, LANES // block)
    turned = data.transpose(-1, -2).contiguous()
    volume = torch.empty((batch, ny, nx, nz), dtype=out.dtype, device=out.device)
    step, last = _ends(columns)
    _volume_kernel[(triton.cdiv(ny * nx, along), triton.cdiv(nz, block), batch)](
        turned,
        volume,
        table,
        whole,
        atan,
        numbers,
        views,
        rows,
        columns,
        step * rows,
        last,
        *_ends(rows),
        nz,
        ny,
        nx,
        KIND=kind,
        TERMS=len(atan),
        ENTRIES=ENTRIES,
        ALONG=along,
        BLOCK=block,
        num_warps=_warps(along * block),
    )
    out.copy_(volume.permute(0, 3, 1, 2))


def _ends(cells: int) -> tuple[int, int]:
    """Steps to the next cell, 0 where there is but one, and the last one that has a next."""
    return min(cells - 1, 1), max(cells - 2, 0)


def _warps(lanes: int) -> int:
    return max(1, min(4, lanes // 32))
