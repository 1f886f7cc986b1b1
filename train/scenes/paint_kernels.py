"""Painter of the training scenes: tissue fractions of small cells, of tubes about curves and of
superquadrics.

Every body is a signed, approximately Euclidean distance d (negative inside) and the normal of its
face. Its part of a cell is what a plane at that distance cuts off a cube, where d carries the term
``cell² / 24 · ∇²d`` of its own average over the cell: without it a ball of radius R becomes too
large by ``(cell / 2 R)²``. Bodies are painted in order; each displaces, of the tissues that it may
displace, the same proportion. So the fractions of a cell sum to 1.

Frames, all in mm. A tube is given by nodes along a curve (:data:`train.scenes.scene.COLUMNS`). The
foot of a point is found from the nearest node by one Newton step; ``(u, w)`` are its coordinates in
the plane normal to the curve there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import numba
import numpy as np

from train.scenes.scene import Tissue

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from torchpcct.typing import Floats, Ints


OUTER, INNER, LUMEN, QUADRIC, QUADRIC_IN_TUBE, STENT, HALO = range(7)
"""What a body is: the wall's outside, its inside, the lumen; a superquadric, one in a tube's
frame; wires; fat."""
FAR = 1e3
"""A distance beyond every inset, mm."""
TISSUES = len(Tissue)
"""Number of tissues."""
BACKGROUND = int(Tissue.BACKGROUND)
"""Number of what no body covers."""


Painting: TypeAlias = "tuple[Floats, Floats, Floats, Ints, Floats, Floats, float]"
"""Tables, tubes, reaches, bodies, values and rows of a scene, and its background."""


@numba.njit(cache=True, fastmath=True)
def _cut(d: float, nx: float, ny: float, nz: float, cell: float) -> float:
    """Part of a cube of side ``cell`` that lies below a plane at the distance d of its centre,
    normal ``(nx, ny, nz)``.

    The volume below a plane in the unit cube is a sum of cubes over its corners (Schwartz 1981, J.
    Algorithms 2).
    """
    a, b, c = max(abs(nx), 1e-3), max(abs(ny), 1e-3), max(abs(nz), 1e-3)
    h = 0.5 * (a + b + c) - d / cell
    if h <= 0.0:
        return 0.0
    if h >= a + b + c:
        return 1.0
    total = h**3
    total -= max(h - a, 0.0) ** 3 + max(h - b, 0.0) ** 3 + max(h - c, 0.0) ** 3
    total += max(h - a - b, 0.0) ** 3 + max(h - a - c, 0.0) ** 3 + max(h - b - c, 0.0) ** 3
    return min(max(total / (6.0 * a * b * c), 0.0), 1.0)


@numba.njit(cache=True, fastmath=True)
def _ellipse(u: float, w: float, a: float, b: float, cell: float) -> tuple[float, float, float]:
    """Distance to the ellipse of semi-axes a, b, and the unit gradient: its function over the
    gradient's length, plus the curvature's term."""
    p, q = u / a, w / b
    r = np.sqrt(p * p + q * q)
    if r < 1e-6:
        return -min(a, b), 1.0, 0.0
    p, q = p / a, q / b
    g = np.sqrt(p * p + q * q)
    curvature = r * (q * q / (a * a) + p * p / (b * b)) / (g * g * g)
    return (r - 1.0) * r / g + min(curvature * cell / 24.0, 0.25) * cell, p / g, q / g


@numba.njit(cache=True, fastmath=True)
def _quadric(
    x: float, y: float, z: float, row: NDArray[np.float64], cell: float
) -> tuple[float, float, float, float]:
    """Distance averaged over a cube of side ``cell`` about a point relative to the superquadric's
    centre, and the unit gradient."""
    x0 = row[3] * x + row[4] * y + row[5] * z
    x1 = row[6] * x + row[7] * y + row[8] * z
    x2 = row[9] * x + row[10] * y + row[11] * z
    s0, s1, s2 = np.sign(x0), np.sign(x1), np.sign(x2)
    x0, x1, x2 = abs(x0), abs(x1), abs(x2)
    if max(x0 - row[12], x1 - row[13], x2 - row[14]) > cell:
        return FAR, 1.0, 0.0, 0.0
    p = row[15]
    x0, x1, x2 = x0 / row[12], x1 / row[13], x2 / row[14]
    s = np.sqrt(x0 * x0 + x1 * x1 + x2 * x2) if p == 2.0 else (x0**p + x1**p + x2**p) ** (1.0 / p)
    if s < 1e-3:
        return -min(row[12], row[13], row[14]), 1.0, 0.0, 0.0
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
    g0, g1, g2 = s0 * g0 / g, s1 * g1 / g, s2 * g2 / g
    # The correction is a series in cell · curvature: it means nothing where the cell is larger than
    # the edge is round.
    return (
        (s - 1.0) / g + min(curvature / g * cell / 24.0, 0.25) * cell,
        row[3] * g0 + row[6] * g1 + row[9] * g2,
        row[4] * g0 + row[7] * g1 + row[10] * g2,
        row[5] * g0 + row[8] * g1 + row[11] * g2,
    )


@numba.njit(cache=True, fastmath=True)
def _foot(
    x: float,
    y: float,
    z: float,
    t: NDArray[np.float64],
    tube: NDArray[np.float64],
    reach: float,
    cell: float,
    out: NDArray[np.float64],
) -> float:
    """Of a point in a tube's frame; returns by how far it lies beyond ``reach``, then with
    ``out[0]`` FAR.

    ``out``: distances to the outer section and to the lumen; u, w, s; place in the lumen (0 on its
    axis, 1 on its border) and coordinates there; nearest node; gradients of both distances in (u,
    w).
    """
    out[0] = FAR
    nodes = t.shape[1]
    nearest, best = 0, np.inf
    for k in range(nodes):
        d = (x - t[0, k]) ** 2 + (y - t[1, k]) ** 2 + (z - t[2, k]) ** 2
        if d < best:
            nearest, best = k, d
    if best >= reach * reach:
        return np.sqrt(best) - reach
    step = t[12, 1] - t[12, 0]
    vx, vy, vz = x - t[0, nearest], y - t[1, nearest], z - t[2, nearest]
    along = vx * t[3, nearest] + vy * t[4, nearest] + vz * t[5, nearest]
    # Tangents turn towards the centre of curvature, where feet crowd.
    a, b = max(nearest - 1, 0), min(nearest + 1, nodes - 1)
    turn = (vx * (t[3, b] - t[3, a]) + vy * (t[4, b] - t[4, a]) + vz * (t[5, b] - t[5, a])) / (
        step * (b - a)
    )
    at = nearest + min(max(along / (max(1.0 - turn, 0.2) * step), -1.0), 1.0)
    k = min(max(int(at), 0), nodes - 2)
    f = min(max(at - k, 0.0), 1.0)
    # The curve between two nodes: cubic in its tangents, so that strong bends have no corners.
    h0, h1 = (1 + 2 * f) * (1 - f) ** 2, f * f * (3 - 2 * f)
    g0, g1 = f * (1 - f) ** 2 * step, f * f * (f - 1) * step
    vx = x - (h0 * t[0, k] + h1 * t[0, k + 1] + g0 * t[3, k] + g1 * t[3, k + 1])
    vy = y - (h0 * t[1, k] + h1 * t[1, k + 1] + g0 * t[4, k] + g1 * t[4, k + 1])
    vz = z - (h0 * t[2, k] + h1 * t[2, k + 1] + g0 * t[5, k] + g1 * t[5, k + 1])
    r0, r1 = 1 - f, f
    u = (
        vx * (r0 * t[6, k] + r1 * t[6, k + 1])
        + vy * (r0 * t[7, k] + r1 * t[7, k + 1])
        + vz * (r0 * t[8, k] + r1 * t[8, k + 1])
    )
    w = (
        vx * (r0 * t[9, k] + r1 * t[9, k + 1])
        + vy * (r0 * t[10, k] + r1 * t[10, k + 1])
        + vz * (r0 * t[11, k] + r1 * t[11, k + 1])
    )
    # Beyond an end of the curve the tube is over.
    end = -FAR
    if (nearest == 0 and at <= 0.0) or (nearest == nodes - 1 and at >= nodes - 1):
        end = abs(along)
    du, dw = u - (r0 * t[13, k] + r1 * t[13, k + 1]), w - (r0 * t[14, k] + r1 * t[14, k + 1])
    c, s = tube[0], tube[1]
    outer, p, q = _ellipse(
        c * du + s * dw,
        c * dw - s * du,
        r0 * t[15, k] + r1 * t[15, k + 1],
        r0 * t[16, k] + r1 * t[16, k + 1],
        cell,
    )
    out[9], out[10] = c * p - s * q, s * p + c * q
    du, dw = u - (r0 * t[17, k] + r1 * t[17, k + 1]), w - (r0 * t[18, k] + r1 * t[18, k + 1])
    c, s = tube[2], tube[3]
    p, q = c * du + s * dw, c * dw - s * du
    la, lb = r0 * t[19, k] + r1 * t[19, k + 1], r0 * t[20, k] + r1 * t[20, k + 1]
    lumen, gp, gq = _ellipse(p, q, la, lb, cell)
    out[11], out[12] = c * gp - s * gq, s * gp + c * gq
    out[0], out[1] = max(outer, end), max(lumen, end)
    out[2], out[3], out[4] = u, w, t[12, 0] + at * step
    out[5] = np.sqrt((p / la) ** 2 + (q / lb) ** 2)
    out[6], out[7], out[8] = p, q, nearest
    return 0.0


@numba.njit(cache=True, fastmath=True)
def _wire(local: NDArray[np.float64], row: NDArray[np.float64]) -> float:
    """Distance to the wires of a stent.

    ``row``: inset, half width, pitch, waves, amplitude, first, last.
    """
    s = local[4]
    if s < row[5] - row[1] or s > row[6] + row[1]:
        return FAR
    across = local[1] + row[0]
    if abs(across) > 4 * row[1]:
        return FAR
    angle = np.arctan2(local[7], local[6])
    radius = max(np.sqrt(local[6] ** 2 + local[7] ** 2), 0.1)
    ring = np.round((s - row[5]) / row[2])
    zigzag = row[4] * np.sin(row[3] * angle)
    steep = row[4] * row[3] * np.cos(row[3] * angle) / radius
    along = abs(s - row[5] - ring * row[2] - zigzag) / np.sqrt(1.0 + steep * steep)
    bar = abs(((angle / (2 * np.pi) * row[3] / 2 + 0.25) % 1.0) - 0.5) * 4 * np.pi / row[3] * radius
    return np.sqrt(across**2 + min(along, bar) ** 2) - row[1]


@numba.njit(cache=True, fastmath=True, nogil=True)
def _fill(
    out: NDArray[np.float32],
    cell: float,
    tables: NDArray[np.float64],
    tubes: NDArray[np.float64],
    reaches: NDArray[np.float64],
    bodies: NDArray[np.int64],
    values: NDArray[np.float64],
    rows: NDArray[np.float64],
    background: float,
    signal: int,
    around: int,
) -> None:
    _, nz, ny, nx = out.shape
    vessels = tables.shape[0]
    local = np.zeros((max(vessels, 1), 13))
    beyond, within = np.zeros(max(vessels, 1)), np.zeros(max(vessels, 1))
    part, hu = np.empty(TISSUES), np.empty(TISSUES)
    for k in range(nz):
        z = (k - 0.5 * (nz - 1)) * cell
        for j in range(ny):
            y = (j - 0.5 * (ny - 1)) * cell
            beyond[:] = 0.0
            for i in range(nx):
                x = (i - 0.5 * (nx - 1)) * cell
                for v in range(vessels):
                    beyond[v] -= cell
                    if beyond[v] <= 0.0:
                        beyond[v] = _foot(x, y, z, tables[v], tubes[v], reaches[v], cell, local[v])
                part[:] = 0.0
                hu[:] = 0.0
                within[:] = 0.0
                part[BACKGROUND], hu[BACKGROUND] = 1.0, background
                for m in range(bodies.shape[0]):
                    kind, v, own, mask = bodies[m, 0], bodies[m, 1], bodies[m, 2], bodies[m, 3]
                    if v >= 0 and local[v, 0] == FAR:
                        continue
                    row = rows[m]
                    d, gx, gy, gz = FAR, 1.0, 1.0, 1.0
                    value = values[m]
                    if kind == QUADRIC:
                        d, gx, gy, gz = _quadric(x - row[0], y - row[1], z - row[2], row, cell)
                    elif kind == HALO:
                        d = max(local[v, 0], 0.0)
                        one = 0.5 * (1.0 - np.cos(np.arctan2(local[v, 3], local[v, 2]) - row[2]))
                        width = row[0] * (1.0 - row[3] * one)
                        hu[BACKGROUND] += (
                            part[BACKGROUND] * value / (1.0 + np.exp((d - width) / row[1]))
                        )
                        continue
                    elif kind == STENT:
                        d = _wire(local[v], row)
                        # wires are thinner than cells: of no one direction
                        gx, gy, gz = 0.577, 0.577, 0.577
                    else:
                        gu, gw, gs = local[v, 9], local[v, 10], 0.0
                        if kind == OUTER:
                            d = local[v, 0]
                        elif kind == INNER:
                            d = local[v, 0] + tubes[v, 4]
                        elif kind == LUMEN:
                            d, gu, gw = local[v, 1], local[v, 11], local[v, 12]
                            mixed = 1.0 + tubes[v, 6] * min(local[v, 5], 1.0) ** 2
                            value *= (1.0 + tubes[v, 5] * local[v, 4]) * mixed
                        else:
                            d, gu, gw, gs = _quadric(
                                local[v, 2] - row[0],
                                local[v, 3] - row[1],
                                local[v, 4] - row[2],
                                row,
                                cell,
                            )
                            if row[16] > 0.0 and row[16] - local[v, 1] > d:
                                d, gu, gw, gs = (
                                    row[16] - local[v, 1],
                                    local[v, 11],
                                    local[v, 12],
                                    0.0,
                                )
                        if abs(d) < cell:
                            t, n = tables[v], int(local[v, 8])
                            gx = gu * t[6, n] + gw * t[9, n] + gs * t[3, n]
                            gy = gu * t[7, n] + gw * t[10, n] + gs * t[4, n]
                            gz = gu * t[8, n] + gw * t[11, n] + gs * t[5, n]
                    if d >= cell:
                        continue
                    o = 1.0 if d <= -cell else _cut(d, gx, gy, gz, cell)
                    # A vessel's faces are nested: what is within one is a part of what is within
                    # the one before.
                    if kind == OUTER:
                        within[v] = o
                    elif kind in (INNER, LUMEN):
                        o, within[v] = min(o / max(within[v], 1e-6), 1.0), o
                    moved = 0.0
                    for g in range(TISSUES):
                        if mask >> g & 1 and g != own:
                            moved += o * part[g]
                            part[g] *= 1.0 - o
                            hu[g] *= 1.0 - o
                    if mask >> own & 1:  # another of its kind takes its value
                        hu[own] += o * part[own] * value - o * hu[own]
                    part[own] += moved
                    hu[own] += moved * value
                total = 0.0
                for g in range(TISSUES):
                    total += hu[g]
                out[0, k, j, i] = total
                out[1, k, j, i] = part[signal]
                out[2, k, j, i] = part[around]
                out[3, k, j, i] = part[0] + part[1]
                out[4, k, j, i] = part[2] + part[3] + part[4] + part[5]


def paint(
    shape: tuple[int, int, int], cell: float, arrays: Painting, signal: int, around: int
) -> NDArray[np.float32]:
    """Averages over cubic cells of a grid about the origin, ``(5, nz, ny, nx)`` float32.

    Image in HU; fractions of the tissue ``signal``, of the tissue ``around``, of background and
    what is beside, of wall and layers.

    Args:
        shape, cell: of the grid; mm.
        arrays: ``(tables, tubes, reaches, bodies, values, rows, background)`` of
            :mod:`train.scenes.rasterise`.
        signal, around: tissues.
    """
    out = np.empty((5, *shape), dtype=np.float32)
    tables, tubes, reaches, bodies, values, rows, background = arrays
    _fill(out, cell, tables, tubes, reaches, bodies, values, rows, background, signal, around)
    return out
