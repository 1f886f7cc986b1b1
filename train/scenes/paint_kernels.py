"""Rasteriser of the training scenes: volume fractions of bent tubes and superquadrics in voxels.

Every body is a signed, approximately Euclidean distance d (negative inside). Bodies are painted in the order of
``bodies``; a later one displaces the earlier ones in proportion, so that the fractions of a voxel sum to 1. The part
inside one surface is the ramp ``clip(1/2 − d / cell, 0, 1)``, where d carries the term ``cell² / 24 · ∇²d`` of its own
average over the cell: without it the ramp makes a ball of radius R too large by ``(cell / 2 R)²``. A cell is a voxel,
except near superquadrics, which may be small, and in oblong voxels: those are averaged over sub-cells.

Frames, all in mm. A tube is given by tables over z: centre ``(x, y)`` and slope ``(dx/dz, dy/dz)``, so it must run
mostly along z. The foot of a point on the centreline is found in one Newton step; ``(u, w)`` are then its coordinates
in the plane normal to the centreline there, and s is the way along the centreline from the foot of the body's centre.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

__all__ = ["KINDS", "QUADRIC_COLUMNS", "TABLE_ROWS", "TUBE_COLUMNS", "paint"]

# What a row (kind, tube, quadric) of ``bodies`` is.
KINDS = {"wall": 0, "fibrous": 1, "lumen": 2, "core": 3, "calcification": 4, "free": 5}
# Rows of a tube's tables over z.
TABLE_ROWS = ("x", "y", "slope_x", "slope_y", "radius", "lumen_u", "lumen_w", "lumen_a", "lumen_b")
# Constants of a tube: sections are ellipses of semi-axes (radius, aspect · radius) turned by an angle.
TUBE_COLUMNS = ("aspect", "cos", "sin", "wall", "lumen_cos", "lumen_sin", "reach")
# A superquadric: centre (3), rows of the rotation into its own axes (9), semi-axes (3), exponent, cap to the lumen,
# margin: how far from its box it matters.
QUADRIC_COLUMNS = 18
FAR = 1e3


@numba.njit(cache=True, fastmath=True)
def _ellipse(u: float, w: float, a: float, b: float, cell: float) -> float:
    """Distance to the ellipse of semi-axes a, b: its function over the gradient's length, plus the curvature's term."""
    p, q = u / a, w / b
    r = np.sqrt(p * p + q * q)
    if r < 1e-6:
        return -min(a, b)
    p, q = p / a, q / b
    g = np.sqrt(p * p + q * q)
    curvature = r * (q * q / (a * a) + p * p / (b * b)) / (g * g * g)
    return (r - 1.0) * r / g + min(curvature * cell / 24.0, 0.25) * cell


@numba.njit(cache=True, fastmath=True)
def _quadric(x: float, y: float, z: float, row: Any, cell: float) -> float:
    """Distance averaged over a cube of side ``cell`` about a point relative to the superquadric's centre."""
    x0 = abs(row[3] * x + row[4] * y + row[5] * z)
    x1 = abs(row[6] * x + row[7] * y + row[8] * z)
    x2 = abs(row[9] * x + row[10] * y + row[11] * z)
    if max(x0 - row[12], x1 - row[13], x2 - row[14]) > row[17]:
        return FAR
    p = row[15]
    x0, x1, x2 = x0 / row[12], x1 / row[13], x2 / row[14]
    s = np.sqrt(x0 * x0 + x1 * x1 + x2 * x2) if p == 2.0 else (x0**p + x1**p + x2**p) ** (1.0 / p)
    smallest = min(row[12], row[13], row[14])
    if s < 1e-3:
        return -smallest
    x0, x1, x2 = x0 / s, x1 / s, x2 / s
    if p == 2.0:
        c0, c1, c2 = 1.0, 1.0, 1.0
    else:
        c0, c1, c2 = x0 ** (p - 2.0), x1 ** (p - 2.0), x2 ** (p - 2.0)
    g0, g1, g2 = c0 * x0 / row[12], c1 * x1 / row[13], c2 * x2 / row[14]
    g = g0 * g0 + g1 * g1 + g2 * g2
    c0, c1, c2 = c0 / row[12] ** 2, c1 / row[13] ** 2, c2 / row[14] ** 2
    curvature = (p - 1.0) * (c0 + c1 + c2 - (c0 * g0 * g0 + c1 * g1 * g1 + c2 * g2 * g2) / g)
    g = np.sqrt(g)
    # The correction is a series in cell · curvature: it means nothing where the cell is larger than the edge is round.
    return (s - 1.0) / g + min(curvature / g * cell / 24.0, 0.25) * cell


@numba.njit(cache=True, fastmath=True)
def _height(z: float, z_first: float, z_step: float, heights: int) -> Any:
    """Where z lies in a tube's tables: the index below it, and the share of the way to the next one."""
    f = min(max((z - z_first) / z_step, 0.0), heights - 1.001)
    k = int(f)
    return k, f - k


@numba.njit(cache=True, fastmath=True)
def _at(row: Any, k: int, f: float) -> float:
    """A row of a tube's tables at a height of :func:`_height`."""
    return row[k] + f * (row[k + 1] - row[k])


@numba.njit(cache=True, fastmath=True)
def _distances(
    x: float,
    y: float,
    z: float,
    cell: float,
    bodies: Any,
    tables: Any,
    tubes: Any,
    quadrics: Any,
    z_first: float,
    z_step: float,
    local: Any,
    d: Any,
) -> bool:
    """Distances ``d`` of a point to all bodies; returns whether any is worth looking at."""
    for v in range(tables.shape[0]):
        t = tables[v]
        local[v, 0] = FAR
        k, f = _height(z, z_first, z_step, tables.shape[2])
        vx = x - _at(t[0], k, f)
        vy = y - _at(t[1], k, f)
        if vx * vx + vy * vy > tubes[v, 6] ** 2:
            continue
        tx, ty = _at(t[2], k, f), _at(t[3], k, f)
        foot = z + (vx * tx + vy * ty) / (1.0 + tx * tx + ty * ty)
        k, f = _height(foot, z_first, z_step, tables.shape[2])
        vx = x - _at(t[0], k, f)
        vy = y - _at(t[1], k, f)
        vz = z - foot
        tx, ty = _at(t[2], k, f), _at(t[3], k, f)
        m = np.sqrt(1.0 + tx * tx)
        n = np.sqrt(1.0 + tx * tx + ty * ty)
        u = (vx - tx * vz) / m
        w = (m * m * vy - tx * ty * vx - ty * vz) / (m * n)
        radius = _at(t[4], k, f)
        c, s = tubes[v, 1], tubes[v, 2]
        local[v, 0] = _ellipse(c * u + s * w, c * w - s * u, radius, radius * tubes[v, 0], cell)
        du = u - _at(t[5], k, f)
        dw = w - _at(t[6], k, f)
        a, b = _at(t[7], k, f), _at(t[8], k, f)
        c, s = tubes[v, 4], tubes[v, 5]
        local[v, 1] = _ellipse(c * du + s * dw, c * dw - s * du, a, b, cell)
        local[v, 2], local[v, 3], local[v, 4], local[v, 5] = u, w, foot, n
    touched = False
    for m in range(bodies.shape[0]):
        kind, v, q = bodies[m, 0], bodies[m, 1], bodies[m, 2]
        value = FAR
        if kind == 5:
            r = quadrics[q]
            value = _quadric(x - r[0], y - r[1], z - r[2], r, cell)
        elif local[v, 0] < FAR:
            if kind == 0:
                value = local[v, 0]
            elif kind == 1:
                value = local[v, 0] + tubes[v, 3]
            elif kind == 2:
                value = local[v, 1]
            else:
                r = quadrics[q]
                value = _quadric(local[v, 2] - r[0], local[v, 3] - r[1], (local[v, 4] - r[2]) * local[v, 5], r, cell)
                if kind == 3:
                    value = max(value, local[v, 0] + tubes[v, 3], r[16] - local[v, 1])
        d[m] = value
        touched = touched or value < cell
    return touched


@numba.njit(cache=True, fastmath=True)
def _reach(
    y: float, z: float, bodies: Any, tables: Any, tubes: Any, quadrics: Any, z_first: float, z_step: float
) -> Any:
    """Interval of x outside of which no body touches the row at ``(y, z)``."""
    low, high = FAR, -FAR
    for v in range(tables.shape[0]):
        k, f = _height(z, z_first, z_step, tables.shape[2])
        x0 = _at(tables[v, 0], k, f)
        square = tubes[v, 6] ** 2 - (y - _at(tables[v, 1], k, f)) ** 2
        if square > 0.0:
            low, high = min(low, x0 - np.sqrt(square)), max(high, x0 + np.sqrt(square))
    for m in range(bodies.shape[0]):
        if bodies[m, 0] != 5:
            continue
        row = quadrics[bodies[m, 2]]
        half_x, half_y, half_z = 0.0, 0.0, 0.0
        for i in range(3):
            a = row[12 + i] + row[17]
            half_x += abs(row[3 + 3 * i]) * a
            half_y += abs(row[4 + 3 * i]) * a
            half_z += abs(row[5 + 3 * i]) * a
        if abs(y - row[1]) <= half_y and abs(z - row[2]) <= half_z:
            low, high = min(low, row[0] - half_x), max(high, row[0] + half_x)
    return low, high


@numba.njit(cache=True, fastmath=True)
def _mix(d: Any, cell: float, fraction: Any) -> None:
    """Fractions of the background and the bodies, painted in order, from their distances."""
    fraction[0] = 1.0
    for m in range(d.shape[0]):
        o = min(max(0.5 - d[m] / cell, 0.0), 1.0)
        fraction[m + 1] = o
        if o > 0.0:
            for b in range(m + 1):
                fraction[b] *= 1.0 - o


@numba.njit(cache=True, fastmath=True, nogil=True)
def _fill(
    out: Any,
    weights: Any,
    spacing: Any,
    cells: Any,
    bodies: Any,
    tables: Any,
    tubes: Any,
    quadrics: Any,
    z_first: float,
    z_step: float,
) -> None:
    count = bodies.shape[0]
    maps, nz, ny, nx = out.shape
    dz, dy, dx = spacing[0], spacing[1], spacing[2]
    volume = dz * dy * dx
    voxel = volume ** (1.0 / 3.0)
    base = cells[0] * cells[1] * cells[2]
    # 1.25 for distances that are only approximate
    margin = 1.25 * 0.5 * np.sqrt(dz * dz + dy * dy + dx * dx)
    d = np.empty(count)
    fraction = np.empty(count + 1)
    total = np.empty(count + 1)
    local = np.empty((tables.shape[0], 6))
    for k in range(nz):
        z = (k - 0.5 * (nz - 1)) * dz
        for j in range(ny):
            y = (j - 0.5 * (ny - 1)) * dy
            low, high = _reach(y, z, bodies, tables, tubes, quadrics, z_first, z_step)
            first = min(max(int(np.ceil(low / dx + 0.5 * (nx - 1))), 0), nx)
            last = min(max(int(np.floor(high / dx + 0.5 * (nx - 1))) + 1, first), nx)
            for c in range(maps):
                out[c, k, j, :first] = weights[c, 0]
                out[c, k, j, last:] = weights[c, 0]
            for i in range(first, last):
                x = (i - 0.5 * (nx - 1)) * dx
                touched = _distances(x, y, z, voxel, bodies, tables, tubes, quadrics, z_first, z_step, local, d)
                if not touched:
                    for c in range(maps):
                        out[c, k, j, i] = weights[c, 0]
                    continue
                fine = 1
                near = False
                for m in range(count):
                    if abs(d[m]) < margin:
                        near = True
                        if bodies[m, 0] >= 3:
                            fine = 2
                cz, cy, cx = 1, 1, 1
                if not near or fine * base == 1:
                    _mix(d, voxel, total)
                else:
                    cz, cy, cx = fine * cells[0], fine * cells[1], fine * cells[2]
                    cell = voxel / fine if base == 1 else (volume / (cz * cy * cx)) ** (1.0 / 3.0)
                    total[:] = 0.0
                    for kk in range(cz):
                        zz = z + ((kk + 0.5) / cz - 0.5) * dz
                        for jj in range(cy):
                            yy = y + ((jj + 0.5) / cy - 0.5) * dy
                            for ii in range(cx):
                                xx = x + ((ii + 0.5) / cx - 0.5) * dx
                                _distances(xx, yy, zz, cell, bodies, tables, tubes, quadrics, z_first, z_step, local, d)
                                _mix(d, cell, fraction)
                                for m in range(count + 1):
                                    total[m] += fraction[m]
                for c in range(maps):
                    value = 0.0
                    for m in range(count + 1):
                        value += weights[c, m] * total[m]
                    out[c, k, j, i] = value / (cz * cy * cx)


def paint(
    shape: tuple[int, int, int],
    spacing: tuple[float, float, float],
    weights: NDArray[np.float64],
    bodies: NDArray[np.int64],
    tables: NDArray[np.float64],
    tubes: NDArray[np.float64],
    quadrics: NDArray[np.float64],
    z_first: float,
    z_step: float,
) -> NDArray[np.float32]:
    """Weighted sums of the volume fractions of the background and of every body.

    Args:
        shape, spacing: ``(nz, ny, nx)`` and mm; the grid is centred on the origin.
        weights: ``(maps, 1 + bodies)``, the background first.
        bodies: ``(bodies, 3)``: a value of :data:`KINDS`, index of the tube, index of the superquadric (−1 for none).
        tables: ``(tubes, len(TABLE_ROWS), heights)`` at the heights ``z_first + k · z_step``, held constant beyond.
        tubes: ``(tubes, len(TUBE_COLUMNS))``; ``reach`` is the largest in-plane distance from the centreline, at the
            same z, that matters.
        quadrics: ``(superquadrics, QUADRIC_COLUMNS)``; ``margin`` likewise.

    Returns:
        ``(maps, nz, ny, nx)`` float32. The fractions behind them sum to 1 in every voxel.
    """
    # Sub-cells as nearly cubic as whole numbers allow: the ramp has one width for all directions.
    cells = np.clip(np.rint(np.asarray(spacing) / min(spacing)), 1, 4).astype(np.int64)
    out = np.empty((len(weights), *shape), dtype=np.float32)
    _fill(out, weights, np.asarray(spacing, dtype=np.float64), cells, bodies, tables, tubes, quadrics, z_first, z_step)
    return out
