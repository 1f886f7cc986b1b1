"""CPU kernels: the part of a voxel behind an outline, and the Gram operator between chosen voxels."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

__all__ = ["core_fractions", "gather_block", "outline_radius", "outline_spread", "plane_fractions", "symmetric_step"]

_LEAST = 0.04
"""Smallest share of a voxel's edge that an outline's normal sees; the exact formula divides by it."""


@njit(cache=True)
def _behind(d, a, b, c):
    """Share of a box behind a plane at the signed distance d (negative: the centre lies behind), and −d(share)/dd.

    The box's half widths along the plane's normal are a, b, c: the share is the distribution function of a sum of three
    uniform variables.
    """
    reach = a + b + c
    if d >= reach:
        return 0.0, 0.0
    if d <= -reach:
        return 1.0, 0.0
    t = -d
    share, slope = 0.0, 0.0
    for i in range(8):
        sign, at = 1.0, t
        if i & 1:
            at += a
        else:
            at -= a
            sign = -sign
        if i & 2:
            at += b
        else:
            at -= b
            sign = -sign
        if i & 4:
            at += c
        else:
            at -= c
            sign = -sign
        if at > 0.0:
            share += sign * at * at * at
            slope += sign * at * at
    volume = 48.0 * a * b * c
    return min(max(share / volume, 0.0), 1.0), max(3.0 * slope / volume, 0.0)


@njit(cache=True)
def _widened(a, b, c, blur):
    """Half widths of a box whose variance along the normal, (a² + b² + c²) / 3, has grown by a blur."""
    own = a * a + b * b + c * c
    scale = math.sqrt(max(1.0 + 3.0 * blur / own, 0.2))
    return scale * a, scale * b, scale * c


@njit(cache=True)
def plane_fractions(distance, widths, blur, share, slope):
    """Share of every voxel behind its plane, and its derivative by −distance.

    A blurred edge is taken for that of a larger voxel, of the variance of voxel and blur along the normal.

    Args:
        distance: ``(n,)`` mm from the plane to the voxel's centre.
        widths: ``(n, 3)`` half edges of the voxel times the components of the plane's unit normal, mm, any sign.
        blur: ``(n,)`` variance of the edge's blur, mm² (negative: sharper than the voxel).
        share, slope: ``(n,)``, filled.
    """
    for i in range(distance.size):
        a, b, c = _widened(abs(widths[i, 0]), abs(widths[i, 1]), abs(widths[i, 2]), blur[i])
        least = _LEAST * max(a, b, c)
        share[i], slope[i] = _behind(distance[i], max(a, least), max(b, least), max(c, least))


@njit(nogil=True, cache=True)
def core_fractions(begin, end, centres, axes, semi, caps, points, half, inner, lumen, normals, blur, out):
    """Share of every voxel inside each ellipsoid, inside the fibrous layer and farther than a cap from the lumen.

    Nested outlines that face each other within a voxel are parallel planes there: the part inside of several is the
    smallest of the shares.

    Args:
        centres: ``(bodies, 3)`` mm; axes: ``(bodies, 3, 3)`` rows are the unit axes; semi: ``(bodies, 3)`` mm.
        caps: ``(bodies,)`` mm.
        points: ``(n, 3)`` voxel centres, ordered by z; half: ``(3,)`` half edges of a voxel.
        inner: ``(n,)`` share of each voxel inside the wall's inner surface.
        lumen: ``(n,)`` distance from the lumen, mm; normals: ``(n, 3)`` half edges times the lumen's unit normal.
        blur: variance of the edges' blur in the plane, mm².
        out: ``(bodies, n)``, filled.
    """
    for p in range(begin, end):
        cz, cy, cx = centres[p]
        largest = max(semi[p, 0], semi[p, 1], semi[p, 2]) + half[0] + half[1] + half[2]
        flattest = 0.0
        for k in range(3):
            flattest += 1.0 / semi[p, k] ** 2
        out[p] = 0.0
        first, last = np.searchsorted(points[:, 0], cz - largest), np.searchsorted(points[:, 0], cz + largest)
        for i in range(first, last):
            z, y, x = points[i, 0] - cz, points[i, 1] - cy, points[i, 2] - cx
            if z * z + y * y + x * x > largest * largest or inner[i] <= 0.0:
                continue
            f, gz, gy, gx, q = 0.0, 0.0, 0.0, 0.0, 0.0
            for k in range(3):
                u = axes[p, k, 0] * z + axes[p, k, 1] * y + axes[p, k, 2] * x
                w = u / (semi[p, k] * semi[p, k])
                f += u * w
                q += w * w
                gz += w * axes[p, k, 0]
                gy += w * axes[p, k, 1]
                gx += w * axes[p, k, 2]
            r, g = math.sqrt(f), math.sqrt(q)
            if r < 0.2:
                share = 1.0
                if r * g < 1e-9 or (1.0 - r) * r / g < half[0] + half[1] + half[2]:
                    # Inside a body of a voxel's size: the distance is that along the shortest axis.
                    short = min(semi[p, 0], semi[p, 1], semi[p, 2])
                    share = _behind((r - 1.0) * short, half[0], 0.1 * half[1], 0.1 * half[2])[0]
            else:
                # Mean curvature's share of the distance's own average over the voxel.
                bend = (flattest - q / f) * r / g
                d = (r - 1.0) * r / g + bend * half[1] * half[1] / 6.0
                a, b, c = _widened(
                    abs(gz / g) * half[0], abs(gy / g) * half[1], abs(gx / g) * half[2], blur * (1 - (gz / g) ** 2)
                )
                least = _LEAST * max(a, b, c)
                share = _behind(d, max(a, least), max(b, least), max(c, least))[0]
            if share > 0.0:
                flat = blur * (1.0 - (normals[i, 0] / half[0]) ** 2)
                a, b, c = _widened(abs(normals[i, 0]), abs(normals[i, 1]), abs(normals[i, 2]), flat)
                least = _LEAST * max(a, b, c)
                blood = _behind(lumen[i] - caps[p], max(a, least), max(b, least), max(c, least))[0]
                out[p, i] = max(min(share, inner[i], 1.0 - blood), 0.0)


@njit(nogil=True, cache=True, fastmath={"contract", "reassoc", "nsz"})
def gather_block(begin, end, kernel, polynomials, there, runs, out):
    """The Gram operator from voxels of one slice to voxels of another.

    Args:
        kernel: ``(terms, 2·ny − 1, 2·nx − 1)`` of the two slices, lag 0 in the middle, its x axis mirrored.
        polynomials: ``(terms, ny, nx)``.
        there: ``(n, 2)`` indices (y, x) in the slice that is written.
        runs: ``(runs, 4)`` of voxels in the slice that is read, side by side along x: y, first x, first column, count.
        out: ``(n, m)``, filled.
    """
    terms = kernel.shape[0]
    my, mx = kernel.shape[1] // 2, kernel.shape[2] // 2
    half = kernel.dtype.type(0.5)
    for i in range(begin, end):
        y, x = there[i]
        for r in range(runs.shape[0]):
            v, u, column, count = runs[r]
            first = u - x + mx
            row = out[i, column : column + count]
            k = kernel[0, y - v + my, first : first + count]
            for j in range(count):
                row[j] = k[j]
            for c in range(1, terms):
                k, own = kernel[c, y - v + my, first : first + count], polynomials[c, y, x]
                other = polynomials[c, v, u : u + count]
                for j in range(count):
                    row[j] += half * (own + other[j]) * k[j]


@njit(cache=True)
def outline_radius(first, spline, spline_slope, wave, wave_slope, shape, r, turn, slope):
    """Radius of an outline and its derivatives, see :class:`recon.plaque.outline.OutlineAt`.

    Args:
        first: ``(n,)``; spline, spline_slope: ``(n, 4)``; wave, wave_slope: ``(n, orders)``.
        shape: ``(splines, orders)``.
        r, turn, slope: ``(n,)`` radius, its derivatives by θ and s, filled.
    """
    for i in range(first.size):
        radius, around, along = 0.0, 0.0, 0.0
        for a in range(4):
            value, value_slope, lift = 0.0, 0.0, shape[first[i] + a]
            for k in range(lift.size):
                value += lift[k] * wave[i, k]
                value_slope += lift[k] * wave_slope[i, k]
            radius += spline[i, a] * value
            around += spline[i, a] * value_slope
            along += spline_slope[i, a] * value
        r[i], turn[i], slope[i] = radius, around, along


@njit(cache=True)
def outline_spread(change, first, spline, wave, out):
    """Add change · dr/d(coefficients) to ``out`` ``(n, splines · orders)``; arguments as in :func:`outline_radius`."""
    orders = wave.shape[1]
    for i in range(first.size):
        if change[i] != 0.0:
            for a in range(4):
                factor, column = change[i] * spline[i, a], (first[i] + a) * orders
                for k in range(orders):
                    out[i, column + k] += factor * wave[i, k]


@njit(cache=True, fastmath={"contract", "reassoc", "nsz"})
def symmetric_step(block, here, there, out_here, out_there):
    """Add ``block @ here`` to ``out_there`` and its transpose times ``there`` to ``out_here``, reading it once.

    Args:
        block: ``(n, m)``; here, out_here: ``(m,)``; there, out_there: ``(n,)``.
    """
    for i in range(block.shape[0]):
        row, factor, total = block[i], there[i], block.dtype.type(0.0)
        for j in range(row.size):
            total += row[j] * here[j]
            out_here[j] += row[j] * factor
        out_there[i] += total
