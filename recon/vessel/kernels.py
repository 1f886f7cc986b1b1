"""CPU kernels: bodies drawn on voxels, an averaging undone, and the Gram operator between chosen
voxels."""

from __future__ import annotations

import math

import numpy as np
from numba import njit


@njit(cache=True)
def sharpened(values, neighbours, excess, out):
    """Take an averaging of variance ``excess`` (along each axis, in squared voxels) off values on
    voxels.

    ``out = values − ½ excess Σ (second difference along each axis)``: the inverse of the averaging
    to second order in the frequency, and no steeper where the voxels hold nothing any more.

    Args:
        values: ``(n, k)``.
        neighbours: ``(n, 6)`` positions of the voxels beside each; −1: there the value is 0.
        out: ``(n, k)``, filled.
    """
    side, own = out.dtype.type(0.5 * excess), out.dtype.type(1.0 + 3.0 * excess)
    for i in range(values.shape[0]):
        row = out[i]
        for k in range(row.size):
            row[k] = own * values[i, k]
        for j in neighbours[i]:
            if j >= 0:
                other = values[j]
                for k in range(row.size):
                    row[k] -= side * other[k]


@njit(nogil=True, cache=True)
def core_fractions(
    begin,
    end,
    centres,
    axes,
    semi,
    caps,
    points,
    sd,
    inner,
    lumen,
    lumen_sd,
    lumen_normal,
    blur,
    out,
):
    """Each ellipsoid inside the fibrous layer and farther than a cap from the lumen, drawn with
    soft edges.

    Where a body meets the cap the part inside of both is that of two Gaussians whose correlation is
    the cosine of the angle between the outlines, exact where both halve the voxel; the wall's inner
    surface is taken for parallel.

    Args:
        centres: ``(bodies, 3)`` mm; axes: ``(bodies, 3, 3)`` rows are the unit axes; semi:
            ``(bodies, 3)`` mm.
        caps: ``(bodies,)`` mm.
        points: ``(n, 3)`` voxel centres, ordered by z; sd: ``(3,)`` of the edges along each axis,
            mm.
        inner: ``(n,)`` share of each voxel inside the wall's inner surface.
        lumen: ``(n,)`` distance from the lumen, mm; lumen_sd: ``(n,)`` of its edge, mm;
            lumen_normal: ``(n, 3)``.
        blur: variance that the edges' blur adds in the plane, mm².
        out: ``(bodies, n)``, filled.
    """
    for p in range(begin, end):
        cz, cy, cx = centres[p]
        largest = max(semi[p, 0], semi[p, 1], semi[p, 2]) + 3.0 * max(sd[0], sd[1], sd[2])
        flattest, short = 0.0, min(semi[p, 0], semi[p, 1], semi[p, 2])
        for k in range(3):
            flattest += 1.0 / semi[p, k] ** 2
        out[p] = 0.0
        first, last = (
            np.searchsorted(points[:, 0], cz - largest),
            np.searchsorted(points[:, 0], cz + largest),
        )
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
                # The normal turns within a voxel: the distance is that along the shortest axis.
                d, variance, nz, ny, nx = (r - 1.0) * short, sd[0] ** 2, 0.0, 0.0, 0.0
            else:
                nz, ny, nx = gz / g, gy / g, gx / g
                variance = (sd[0] * nz) ** 2 + (sd[1] * ny) ** 2 + (sd[2] * nx) ** 2
                variance = variance + blur * (1.0 - nz * nz)
                # The distance's own average under the blur: half the sum of the curvatures times
                # its variance.
                d = (r - 1.0) * r / g + 0.5 * (flattest - q / f) * r / g * variance
            share = 0.5 * math.erfc(d / math.sqrt(2.0 * variance))
            if share > 1e-4:
                far = 0.5 * math.erfc((caps[p] - lumen[i]) / (math.sqrt(2.0) * lumen_sd[i]))
                along = -(
                    nz * lumen_normal[i, 0] + ny * lumen_normal[i, 1] + nx * lumen_normal[i, 2]
                )
                weight = math.asin(min(abs(along), 1.0)) * 2.0 / math.pi
                both = min(share, far) if along > 0.0 else max(share + far - 1.0, 0.0)
                out[p, i] = min(weight * both + (1.0 - weight) * share * far, inner[i])


@njit(nogil=True, cache=True, fastmath={"contract", "reassoc", "nsz"})
def gather_block(begin, end, kernel, polynomials, there, runs, out):
    """The Gram operator from voxels of one slice to voxels of another.

    Args:
        kernel: ``(terms, 2·ny − 1, 2·nx − 1)`` of the two slices, lag 0 in the middle, its x axis
            mirrored.
        polynomials: ``(terms, ny, nx)``.
        there: ``(n, 2)`` indices (y, x) in the slice that is written.
        runs: ``(runs, 4)`` of voxels in the slice that is read, side by side along x: y, first x,
            first column, count.
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
    """Radius of an outline and its derivatives, see :class:`recon.vessel.outline.OutlineAt`.

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
    """Add change · dr/d(coefficients) to ``out`` ``(n, splines · orders)``; arguments as in
    :func:`outline_radius`."""
    orders = wave.shape[1]
    for i in range(first.size):
        if change[i] != 0.0:
            for a in range(4):
                factor, column = change[i] * spline[i, a], (first[i] + a) * orders
                for k in range(orders):
                    out[i, column + k] += factor * wave[i, k]


@njit(cache=True, fastmath={"contract", "reassoc", "nsz"})
def symmetric_step(block, here, there, out_here, out_there):
    """Add ``block @ here`` to ``out_there`` and its transpose times ``there`` to ``out_here``,
    reading it once.

    Args:
        block: ``(n, m)``; here, out_here: ``(m,)``; there, out_there: ``(n,)``.
    """
    for i in range(block.shape[0]):
        row, factor, total = block[i], there[i], block.dtype.type(0.0)
        for j in range(row.size):
            total += row[j] * here[j]
            out_here[j] += row[j] * factor
        out_there[i] += total
