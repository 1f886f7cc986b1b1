"""Numba kernels of the voxel-driven backprojector and of its exact transpose.

Detector data come padded by one repeated column (and row) at the far end, so that a position anywhere in
``[0, n − 1]`` may read its two neighbours without a branch. Every voxel belongs to one thread in the
backprojection and every view to one thread in the transpose, with a fixed order of summation: results do not
depend on the number of threads.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

__all__ = ["backproject_2d", "backproject_3d", "spread_2d", "spread_3d"]

PARALLEL, FLAT, CURVED = 0, 1, 2
_OPTIONS = {"parallel": True, "cache": True, "error_model": "numpy", "fastmath": {"contract", "nsz"}}
_INLINE = {"cache": True, "error_model": "numpy", "inline": "always"}


@njit(**_INLINE)
def _sample(kind, x, y, c, s, sod, sdd, scale, start, last):
    """Column index of a voxel (clamped to the data), distance weight, and magnification of heights."""
    across = y * c - x * s
    if kind == 0:
        index = across * scale + start
        weight = 1.0
        height = 1.0
    else:
        depth = sod - (x * c + y * s)
        if kind == 1:
            index = sdd * across / depth * scale + start
            weight = sod * sod / (depth * depth)
            height = sdd / depth
        else:
            square = across * across + depth * depth
            index = sdd * math.atan2(across, depth) * scale + start
            weight = sod * sod / square
            height = sdd / math.sqrt(square)
    return min(max(index, 0.0), last), weight, height


@njit(**_OPTIONS)
def backproject_2d(kind, data, cosines, sines, starts, x, y, sod, sdd, scale, out):
    """``data (B, V, columns + 1)`` into ``out (B, Y, X)``."""
    batch, views, padded = data.shape
    ny, nx = out.shape[1], out.shape[2]
    number = data.dtype.type
    last = padded - 2.0
    for iy in prange(ny):
        index = np.empty(nx, np.uint32)
        near = np.empty(nx, data.dtype)
        far = np.empty(nx, data.dtype)
        out[:, iy, :] = number(0)
        for v in range(views):
            for ix in range(nx):
                position, weight, _ = _sample(
                    kind, x[ix], y[iy], cosines[v], sines[v], sod, sdd, scale, starts[v], last
                )
                i = np.int32(position)
                fraction = (position - i) * weight
                index[ix] = np.uint32(i)
                far[ix] = number(fraction)
                near[ix] = number(weight - fraction)
            for b in range(batch):
                row = data[b, v]
                line = out[b, iy]
                for ix in range(nx):
                    line[ix] += near[ix] * row[index[ix]] + far[ix] * row[index[ix] + np.uint32(1)]


@njit(**_OPTIONS)
def spread_2d(kind, volume, cosines, sines, starts, x, y, sod, sdd, scale, out):
    """Transpose of :func:`backproject_2d`: ``volume (B, Y, X)`` into ``out (B, V, columns + 1)``."""
    batch, views, padded = out.shape
    ny, nx = volume.shape[1], volume.shape[2]
    number = volume.dtype.type
    last = padded - 2.0
    for v in prange(views):
        out[:, v, :] = number(0)
        for iy in range(ny):
            for ix in range(nx):
                position, weight, _ = _sample(
                    kind, x[ix], y[iy], cosines[v], sines[v], sod, sdd, scale, starts[v], last
                )
                i = np.uint32(np.int32(position))
                fraction = (position - np.float64(i)) * weight
                far = number(fraction)
                near = number(weight - fraction)
                for b in range(batch):
                    out[b, v, i] += near * volume[b, iy, ix]
                    out[b, v, i + np.uint32(1)] += far * volume[b, iy, ix]


@njit(**_OPTIONS)
def backproject_3d(kind, data, cosines, sines, starts, x, y, z, sod, sdd, scale, row_scale, row_start, out):
    """``data (V, columns + 1, rows + 1, B)`` into ``out (Y, X, Z, B)``."""
    views, padded, row_count, batch = data.shape
    ny, nx, nz = out.shape[0], out.shape[1], out.shape[2]
    number = data.dtype.type
    zero = number(0)
    last = padded - 2.0
    last_row = number(row_count - 2.0)
    origin = number(row_start)
    tile = 16
    for t in prange((ny * nx + tile - 1) // tile):
        column = np.empty((row_count, batch), data.dtype)
        low, high = t * tile, min((t + 1) * tile, ny * nx)
        for p in range(low, high):
            out[p // nx, p % nx] = zero
        for v in range(views):
            for p in range(low, high):
                iy, ix = p // nx, p % nx
                position, weight, height = _sample(
                    kind, x[ix], y[iy], cosines[v], sines[v], sod, sdd, scale, starts[v], last
                )
                i = np.uint64(position)
                fraction = (position - np.float64(i)) * weight
                far, near = number(fraction), number(weight - fraction)
                left, right = data[v, i], data[v, i + np.uint64(1)]
                for r in range(row_count):
                    for b in range(batch):
                        column[r, b] = near * left[r, b] + far * right[r, b]
                step = number(height * row_scale)
                target = out[iy, ix]
                for k in range(nz):
                    row = min(max(z[k] * step + origin, zero), last_row)
                    j = np.int32(row)
                    f = row - number(j)
                    lower = np.uint32(j)
                    upper = lower + np.uint32(1)
                    for b in range(batch):
                        a = column[lower, b]
                        target[k, b] += a + f * (column[upper, b] - a)


@njit(**_OPTIONS)
def spread_3d(kind, volume, cosines, sines, starts, x, y, z, sod, sdd, scale, row_scale, row_start, out):
    """Transpose of :func:`backproject_3d`: ``volume (Y, X, Z, B)`` into ``out (V, columns + 1, rows + 1, B)``."""
    views, padded, row_count, batch = out.shape
    ny, nx, nz = volume.shape[0], volume.shape[1], volume.shape[2]
    number = volume.dtype.type
    zero = number(0)
    last = padded - 2.0
    last_row = number(row_count - 2.0)
    origin = number(row_start)
    for v in prange(views):
        column = np.empty((row_count, batch), volume.dtype)
        out[v] = zero
        for iy in range(ny):
            for ix in range(nx):
                position, weight, height = _sample(
                    kind, x[ix], y[iy], cosines[v], sines[v], sod, sdd, scale, starts[v], last
                )
                i = np.uint64(position)
                fraction = (position - np.float64(i)) * weight
                far, near = number(fraction), number(weight - fraction)
                column[:] = zero
                step = number(height * row_scale)
                for k in range(nz):
                    row = min(max(z[k] * step + origin, zero), last_row)
                    j = np.int32(row)
                    f = row - number(j)
                    lower = np.uint32(j)
                    upper = lower + np.uint32(1)
                    for b in range(batch):
                        value = volume[iy, ix, k, b]
                        part = f * value
                        column[lower, b] += value - part
                        column[upper, b] += part
                for r in range(row_count):
                    for b in range(batch):
                        out[v, i, r, b] += near * column[r, b]
                        out[v, i + np.uint64(1), r, b] += far * column[r, b]
