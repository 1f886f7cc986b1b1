# mypy: disable-error-code="assignment"
"""CPU kernels of the cone beam: distance-driven overlaps, followed slab by slab, z innermost.

Model (De Man and Basu 2004, Phys. Med. Biol. 49:2463, in its separable form). In each slab of voxels (a grid row or
column, whichever the ray crosses more often) the edges of a detector cell are projected onto the slab's middle plane.
The reading is the mean of the voxel values over that rectangle, times the path through the slab, summed over slabs.
In the plane the overlaps are written out; along z they are differences of a running sum, read at the projected row
edges by linear interpolation, which is the same overlap.

Forward runs in parallel over views, the adjoint over slabs: no two threads write to one place and every sum has a
fixed order, so that results do not depend on the number of threads.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

__all__ = ["backproject", "project"]

# NaN and Inf must survive, so only the flags that leave them alone.
_FLAGS = {"contract", "nsz", "arcp", "reassoc"}
_inline = njit(inline="always", fastmath=_FLAGS)


@_inline
def _edge_line(pose, table, j, axis, lattice, parallel):
    """In-slab coordinate of a ray, ``t(r) = p + q r``: r counts slabs, t voxel edges along the slab."""
    a, b = table[j, 0], table[j, 1]
    if parallel:
        sx, sy = pose[0] + b * pose[5], pose[1] + b * pose[6]
        dx, dy = pose[3], pose[4]
    else:
        sx, sy = pose[0], pose[1]
        dx, dy = a * pose[3] + b * pose[5], a * pose[4] + b * pose[6]
    # lattice: y of slab row 0, its pitch, x of the first voxel edge, its pitch; then the same for slab columns.
    if axis == 0:
        slope = dx / dy
        return (sx - lattice[2] + (lattice[0] - sy) * slope) / lattice[3], slope * lattice[1] / lattice[3]
    slope = dy / dx
    return (sy - lattice[6] + (lattice[4] - sx) * slope) / lattice[7], slope * lattice[5] / lattice[7]


@_inline
def _depth_line(pose, table, j, axis, lattice, parallel):
    """Ray parameter at the slabs, ``λ(r) = l + m r``, the path per slab, and the squared in-plane ray length."""
    a, b = table[j, 0], table[j, 1]
    if parallel:
        dx, dy = pose[3], pose[4]
    else:
        dx, dy = a * pose[3] + b * pose[5], a * pose[4] + b * pose[6]
    square = dx * dx + dy * dy
    if axis == 0:
        return (lattice[0] - pose[1]) / dy, lattice[1] / dy, lattice[1] * math.sqrt(square) / abs(dy), square
    return (lattice[4] - pose[0]) / dx, lattice[5] / dx, lattice[5] * math.sqrt(square) / abs(dx), square


@njit(parallel=True, cache=True, fastmath=_FLAGS)
def project(sums, pose, edges, centers, first, segments, start, lattice, z0, dz, row0, row_pitch, data):
    """Cone-beam line integrals.

    Args:
        sums: ``(batch, ny, nx, nz + 1)`` running sums of the volume along z (0 first).
        pose, edges, centers, first: see ``rays.Rays``.
        segments, start: see ``rays.Segments``.
        lattice: ``(8,)`` slab positions, see ``_edge_line``.
        z0, dz: lower edge of the grid along z and its pitch (mm).
        row0, row_pitch: lower edge of the first row kept, and the pitch (mm on the detector).
        data: ``(batch, views, rows, columns)`` output, overwritten.
    """
    batch, ny, nx, nze = sums.shape
    views, rows, columns = data.shape[1:]
    real = sums.dtype.type
    zero, one = real(0), real(1)
    z_top = real(nze - 1)
    for v in prange(views):
        acc = np.zeros((batch, columns, rows), dtype=sums.dtype)
        blend = np.empty(nze, dtype=sums.dtype)
        index = np.empty(rows + 1, dtype=np.uint32)
        part = np.empty(rows + 1, dtype=sums.dtype)
        read = np.empty(rows + 1, dtype=sums.dtype)
        at = pose[v]
        for s in range(start[v], start[v + 1]):
            axis = segments[s, 1]
            slabs = ny if axis == 0 else nx
            width = nx if axis == 0 else ny
            for j in range(segments[s, 2], segments[s, 2] + segments[s, 3]):
                col = first[v] + j
                p0, q0 = _edge_line(at, edges, col, axis, lattice, False)
                p1, q1 = _edge_line(at, edges, col + 1, axis, lattice, False)
                l0, l1, path, _ = _depth_line(at, centers, col, axis, lattice, False)
                for r in range(slabs):
                    ta, tb = p0 + q0 * r, p1 + q1 * r
                    lo, hi = max(min(ta, tb), 0.0), min(max(ta, tb), float(width))
                    depth = l0 + l1 * r
                    if hi <= lo or depth <= 0.0:
                        continue
                    scale = path / abs(tb - ta)
                    zeta0 = real((at[2] + depth * (row0 + at[7] - at[2]) - z0) / dz)
                    zeta1 = real(depth * row_pitch / dz)
                    for i in range(rows + 1):
                        zeta = min(max(zeta0 + zeta1 * real(i), zero), z_top)
                        k = min(np.int32(zeta), np.int32(nze - 2))
                        index[i] = k
                        part[i] = zeta - real(k)
                    gain = real(1.0 / (depth * row_pitch / dz))
                    k0 = int(lo)
                    k1 = min(math.ceil(hi), width)
                    for n in range(batch):
                        for k in range(k0, k1):
                            w = real(scale * (min(hi, k + 1.0) - max(lo, float(k))))
                            line = sums[n, r, k] if axis == 0 else sums[n, k, r]
                            if k == k0:
                                for z in range(nze):
                                    blend[z] = w * line[z]
                            else:
                                for z in range(nze):
                                    blend[z] += w * line[z]
                        for i in range(rows + 1):
                            k = np.uint64(index[i])
                            read[i] = blend[k] * (one - part[i]) + blend[k + np.uint64(1)] * part[i]
                        out = acc[n, j]
                        for i in range(rows):
                            out[i] += gain * (read[i + 1] - read[i])
                _, _, _, square = _depth_line(at, centers, col, axis, lattice, False)
                for i in range(rows):
                    rise = row0 + (i + 0.5) * row_pitch + at[7] - at[2]
                    slant = real(math.sqrt(1.0 + rise * rise / square))
                    for n in range(batch):
                        acc[n, j, i] *= slant
        for n in range(batch):
            for i in range(rows):
                for j in range(columns):
                    data[n, v, i, j] = acc[n, j, i]


@njit(parallel=True, cache=True, fastmath=_FLAGS)
def _row_sums(data, pose, centers, first, row0, row_pitch, begin, sums):
    """Readings times their slant, summed along the rows: ``(batch, views, columns, rows + 1)``."""
    batch, chunk, columns, edges = sums.shape
    for v in prange(chunk):
        at = pose[begin + v]
        for j in range(columns):
            a, b = centers[first[begin + v] + j, 0], centers[first[begin + v] + j, 1]
            dx, dy = a * at[3] + b * at[5], a * at[4] + b * at[6]
            square = dx * dx + dy * dy
            for n in range(batch):
                sums[n, v, j, 0] = 0
            for i in range(edges - 1):
                rise = row0 + (i + 0.5) * row_pitch + at[7] - at[2]
                slant = data.dtype.type(math.sqrt(1.0 + rise * rise / square))
                for n in range(batch):
                    sums[n, v, j, i + 1] = sums[n, v, j, i] + slant * data[n, begin + v, i, j]


@njit(parallel=True, cache=True, fastmath=_FLAGS)
def _gather(
    sums, pose, edges, centers, first, segments, seg0, seg1, begin, axis, lattice, z0, dz, row0, row_pitch, out
):
    """Add the segments of one axis to ``out``, ``(batch, slabs, width, nz)``; see ``project``."""
    batch, slabs, width, nz = out.shape
    rows = sums.shape[3] - 1
    real = sums.dtype.type
    zero, one = real(0), real(1)
    top = real(rows)
    block = 8
    for task in prange((slabs + block - 1) // block):
        index = np.empty(nz + 1, dtype=np.uint32)
        part = np.empty(nz + 1, dtype=sums.dtype)
        read = np.empty(nz + 1, dtype=sums.dtype)
        diff = np.empty(nz, dtype=sums.dtype)
        for s in range(seg0, seg1):
            if segments[s, 1] != axis:
                continue
            v = segments[s, 0]
            at = pose[v]
            for j in range(segments[s, 2], segments[s, 2] + segments[s, 3]):
                col = first[v] + j
                p0, q0 = _edge_line(at, edges, col, axis, lattice, False)
                p1, q1 = _edge_line(at, edges, col + 1, axis, lattice, False)
                l0, l1, path, _ = _depth_line(at, centers, col, axis, lattice, False)
                for r in range(task * block, min(task * block + block, slabs)):
                    ta, tb = p0 + q0 * r, p1 + q1 * r
                    lo, hi = max(min(ta, tb), 0.0), min(max(ta, tb), float(width))
                    depth = l0 + l1 * r
                    if hi <= lo or depth <= 0.0:
                        continue
                    scale = path / abs(tb - ta)
                    rho1 = dz / (depth * row_pitch)
                    rho0 = real(((z0 - at[2]) / depth - (row0 + at[7] - at[2])) / row_pitch)
                    step = real(rho1)
                    for z in range(nz + 1):
                        rho = min(max(rho0 + step * real(z), zero), top)
                        k = min(np.int32(rho), np.int32(rows - 1))
                        index[z] = k
                        part[z] = rho - real(k)
                    k0 = int(lo)
                    k1 = min(math.ceil(hi), width)
                    for n in range(batch):
                        line = sums[n, v - begin, j]
                        for z in range(nz + 1):
                            k = np.uint64(index[z])
                            read[z] = line[k] * (one - part[z]) + line[k + np.uint64(1)] * part[z]
                        for z in range(nz):
                            diff[z] = read[z + 1] - read[z]
                        for k in range(k0, k1):
                            w = real(scale * (min(hi, k + 1.0) - max(lo, float(k))))
                            target = out[n, r, k]
                            for z in range(nz):
                                target[z] += w * diff[z]


def backproject(data, pose, edges, centers, first, segments, start, lattice, z0, dz, row0, row_pitch, shape, memory):
    """The exact transpose of :func:`project`.

    Args:
        data: ``(batch, views, rows, columns)``.
        shape: ``(nz, ny, nx)``.
        memory: bytes allowed for the row sums; the views are taken in chunks that fit.

    Returns:
        ``(batch, nz, ny, nx)``, dtype of ``data``.
    """
    batch, views, rows, columns = data.shape
    nz, ny, nx = shape
    by_row = np.zeros((batch, ny, nx, nz), dtype=data.dtype)
    by_column = np.zeros((batch, nx, ny, nz), dtype=data.dtype)
    per_view = batch * columns * (rows + 1) * data.itemsize
    chunk = int(max(1, min(views, memory // per_view)))
    for begin in range(0, views, chunk):
        stop = min(begin + chunk, views)
        sums = np.empty((batch, stop - begin, columns, rows + 1), dtype=data.dtype)
        _row_sums(data, pose, centers, first, row0, row_pitch, begin, sums)
        seg0, seg1 = start[begin], start[stop]
        for axis, out in ((0, by_row), (1, by_column)):
            _gather(
                sums, pose, edges, centers, first, segments, seg0, seg1, begin, axis, lattice,
                z0, dz, row0, row_pitch, out,
            )  # fmt: skip
    return np.ascontiguousarray((by_row + by_column.transpose(0, 2, 1, 3)).transpose(0, 3, 1, 2))
