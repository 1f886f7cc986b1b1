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

__all__ = ["backproject", "padded", "project"]

# NaN and Inf must survive, so only the flags that leave them alone.
_FLAGS = {"contract", "nsz", "arcp", "reassoc"}
# Slabs farther apart than this part of a layer are interpolated one by one (see layers.layer_spacing).
MAX_LAYERS_PER_SLAB = 0.4
# Slabs closer to the source than this part of the source-detector distance are behind it.
NEAREST = 1e-6
# Slabs of one task of the adjoint: enough to reuse a layer, few enough to share the work. Fixed, for determinism.
SLAB_BLOCK = 12
# Ray geometry in float64, called per cell and not per voxel.
_small = njit(cache=True, fastmath=_FLAGS, error_model="numpy")


@_small
def padded(n):
    """``n`` rounded up to whole SIMD registers, so that no loop along z has a scalar remainder."""
    return (n + 7) // 8 * 8


@_small
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


@_small
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


@_small
def _rows_at(zeta0, step, last, index, part):
    """Interpolation knots of equally spaced heights: ``zeta0 + step * i`` clamped to the knots 0…last."""
    real = part.dtype.type
    top = real(last)
    for i in range(index.size):
        zeta = min(max(zeta0 + step * real(i), real(0)), top)
        k = min(np.int32(zeta), np.int32(last - 1))
        index[i] = k
        part[i] = zeta - real(k)


@_small
def _read(line, index, part, read):
    for i in range(index.size):
        k = np.uint64(index[i])
        low = line[k]
        read[i] = low + part[i] * (line[k + np.uint64(1)] - low)


@_small
def _blend(lines, base, stride, k0, k1, lo, hi, scale, out):
    """``out = scale * Σ_k overlap(k) lines[base + k * stride]`` over the voxels that the interval [lo, hi] touches."""
    real = out.dtype.type
    n = out.size
    first = lines[base + k0 * stride]
    w0 = real(scale * (min(hi, k0 + 1.0) - lo))
    if k1 - k0 == 1:
        for z in range(n):
            out[z] = w0 * first[z]
        return
    second = lines[base + (k0 + 1) * stride]
    w1 = real(scale * (min(hi, k0 + 2.0) - (k0 + 1.0)))
    if k1 - k0 == 2:
        for z in range(n):
            out[z] = w0 * first[z] + w1 * second[z]
        return
    third = lines[base + (k0 + 2) * stride]
    w2 = real(scale * (min(hi, k0 + 3.0) - (k0 + 2.0)))
    for z in range(n):
        out[z] = w0 * first[z] + w1 * second[z] + w2 * third[z]
    for k in range(k0 + 3, k1):
        w = real(scale * (min(hi, k + 1.0) - k))
        line = lines[base + k * stride]
        for z in range(n):
            out[z] += w * line[z]


@_small
def _share(values, part, low, high):
    """Share a slab between the two layers it lies between."""
    keep = values.dtype.type(1) - part
    for z in range(values.size):
        low[z] += keep * values[z]
        high[z] += part * values[z]


@_small
def _add_rows(line, at, depth, z0, dz, row0, row_pitch, index, part, read, out):
    """Add the row means of one layer (running sums ``line``) at the ray parameter ``depth`` to ``out``."""
    real = line.dtype.type
    step = depth * row_pitch / dz
    _rows_at(real((at[2] + depth * (row0 + at[7] - at[2]) - z0) / dz), real(step), line.size - 8, index, part)
    _read(line, index, part, read)
    gain = real(1.0 / step)
    for i in range(out.size):
        out[i] += gain * (read[i + 1] - read[i])


@_small
def _project_view(
    lines, ny, nx, at, edges, centers, first, segments, s0, s1, lattice, z0, dz, row0, row_pitch, layer, acc, data
):
    """All segments of one view; ``lines``: ``(batch, ny * nx, knots)``, ``data``: ``(batch, rows, columns)``."""
    batch, _, knots = lines.shape
    columns, rows = acc.shape[1:]
    real = lines.dtype.type
    blend = np.empty(knots, dtype=lines.dtype)
    pair = np.zeros((2, batch, knots), dtype=lines.dtype)
    index = np.zeros(padded(rows + 1), dtype=np.uint32)
    part = np.zeros(index.size, dtype=lines.dtype)
    read = np.zeros(index.size, dtype=lines.dtype)
    acc[:] = 0
    for s in range(s0, s1):
        axis = segments[s, 1]
        slabs, width = (ny, nx) if axis == 0 else (nx, ny)
        across, along = (nx, 1) if axis == 0 else (1, nx)
        for j in range(segments[s, 2], segments[s, 2] + segments[s, 3]):
            p0, q0 = _edge_line(at, edges, first + j, axis, lattice, False)
            p1, q1 = _edge_line(at, edges, first + j + 1, axis, lattice, False)
            l0, l1, path, square = _depth_line(at, centers, first + j, axis, lattice, False)
            layered = abs(l1) < MAX_LAYERS_PER_SLAB * layer
            low = -1  # the pair holds layers ``low`` (at pair[low % 2]) and ``low + 1``
            for r in range(slabs):
                ta, tb = p0 + q0 * r, p1 + q1 * r
                lo, hi = max(min(ta, tb), 0.0), min(max(ta, tb), float(width))
                depth = l0 + l1 * r
                if hi <= lo or depth <= NEAREST:
                    continue
                k0, k1 = int(lo), min(math.ceil(hi), width)
                scale = path / abs(tb - ta)
                now = int(depth / layer) if layered else -1
                if layered and now != low:
                    for m in range(low, low + 2):
                        if low >= 0 and m != now and m != now + 1:
                            for n in range(batch):
                                line = pair[m % 2, n]
                                _add_rows(
                                    line, at, m * layer, z0, dz, row0, row_pitch, index, part, read, acc[n, j]
                                )  # fmt: skip
                                line[:] = 0
                    low = now
                for n in range(batch):
                    _blend(lines[n], r * across, along, k0, k1, lo, hi, scale, blend)
                    if layered:
                        _share(blend, real(depth / layer - now), pair[now % 2, n], pair[(now + 1) % 2, n])
                    else:
                        _add_rows(blend, at, depth, z0, dz, row0, row_pitch, index, part, read, acc[n, j])
            if low >= 0:
                for m in range(low, low + 2):
                    for n in range(batch):
                        line = pair[m % 2, n]
                        _add_rows(line, at, m * layer, z0, dz, row0, row_pitch, index, part, read, acc[n, j])
                        line[:] = 0
            for i in range(rows):
                rise = row0 + (i + 0.5) * row_pitch + at[7] - at[2]
                slant = real(math.sqrt(1.0 + rise * rise / square))
                for n in range(batch):
                    acc[n, j, i] *= slant
    for n in range(batch):
        for i in range(rows):
            for j in range(columns):
                data[n, i, j] = acc[n, j, i]


@njit(parallel=True, cache=True)
def project(lines, ny, nx, pose, edges, centers, first, segments, start, lattice, z0, dz, row0, row_pitch, layer, data):
    """Cone-beam line integrals.

    Args:
        lines: ``(batch, ny * nx, padded(nz) + 8)`` running sums of the volume along z: 0 first, the total repeated.
        pose, edges, centers, first: see ``rays.Rays``.
        segments, start: see ``rays.Segments``.
        lattice: ``(8,)`` slab positions, see ``_edge_line``.
        z0, dz: lower edge of the grid along z and its pitch (mm).
        row0, row_pitch: lower edge of the first row kept, and the pitch (mm on the detector).
        layer: spacing of the depth layers in the ray parameter, see ``layer_spacing``.
        data: ``(batch, views, rows, columns)`` output, overwritten.
    """
    batch, views, rows, columns = data.shape
    for v in prange(views):
        acc = np.empty((batch, columns, rows), dtype=lines.dtype)
        _project_view(
            lines, ny, nx, pose[v], edges, centers, first[v], segments, start[v], start[v + 1], lattice,
            z0, dz, row0, row_pitch, layer, acc, data[:, v],
        )  # fmt: skip


@_small
def _row_sums_view(data, at, centers, first, row0, row_pitch, sums):
    batch, columns, edges = sums.shape
    for j in range(columns):
        a, b = centers[first + j, 0], centers[first + j, 1]
        dx, dy = a * at[3] + b * at[5], a * at[4] + b * at[6]
        square = dx * dx + dy * dy
        for n in range(batch):
            sums[n, j, 0] = 0
        for i in range(edges - 1):
            rise = row0 + (i + 0.5) * row_pitch + at[7] - at[2]
            slant = data.dtype.type(math.sqrt(1.0 + rise * rise / square))
            for n in range(batch):
                sums[n, j, i + 1] = sums[n, j, i] + slant * data[n, i, j]


@njit(parallel=True, cache=True)
def _row_sums(data, pose, centers, first, row0, row_pitch, begin, sums):
    """Readings times their slant, summed along the rows: ``(batch, views, columns, rows + 1)``."""
    for v in prange(sums.shape[1]):
        _row_sums_view(data[:, begin + v], pose[begin + v], centers, first[begin + v], row0, row_pitch, sums[:, v])


@_small
def _spread(target, k0, k1, lo, hi, scale, values):
    """Transpose of ``_blend`` on one slab: ``target``, ``(width, nz)``."""
    real = values.dtype.type
    for k in range(k0, k1):
        w = real(scale * (min(hi, k + 1.0) - max(lo, float(k))))
        line = target[k]
        for z in range(values.size):
            line[z] += w * values[z]


@_small
def _layer_values(sums, at, depth, z0, dz, row0, row_pitch, index, part, read, values):
    """Transpose of ``_add_rows``: what each voxel of a line at ``depth`` collects from the running row sums."""
    real = sums.dtype.type
    rho = ((z0 - at[2]) / depth - (row0 + at[7] - at[2])) / row_pitch
    _rows_at(real(rho), real(dz / (depth * row_pitch)), sums.size - 1, index, part)
    _read(sums, index, part, read)
    for z in range(values.size):
        values[z] = read[z + 1] - read[z]


@_small
def _gather_slabs(
    sums, pose, edges, centers, first, segments, seg0, seg1, begin, axis, lattice, z0, dz, row0, row_pitch, layer,
    r0, r1, out,
):  # fmt: skip
    """Slabs ``r0 … r1`` of ``_gather``; ``out``: ``(batch, slabs, width, padded(nz))``."""
    batch, _, width, nz = out.shape
    real = sums.dtype.type
    index = np.empty(nz + 8, dtype=np.uint32)
    part = np.empty(nz + 8, dtype=sums.dtype)
    read = np.empty(nz + 8, dtype=sums.dtype)
    pair = np.empty((2, batch, nz), dtype=sums.dtype)
    mixed = np.empty(nz, dtype=sums.dtype)
    for s in range(seg0, seg1):
        if segments[s, 1] != axis:
            continue
        v = segments[s, 0]
        at = pose[v]
        for j in range(segments[s, 2], segments[s, 2] + segments[s, 3]):
            p0, q0 = _edge_line(at, edges, first[v] + j, axis, lattice, False)
            p1, q1 = _edge_line(at, edges, first[v] + j + 1, axis, lattice, False)
            l0, l1, path, _ = _depth_line(at, centers, first[v] + j, axis, lattice, False)
            layered = abs(l1) < MAX_LAYERS_PER_SLAB * layer
            low = -1
            for r in range(r0, r1):
                ta, tb = p0 + q0 * r, p1 + q1 * r
                lo, hi = max(min(ta, tb), 0.0), min(max(ta, tb), float(width))
                depth = l0 + l1 * r
                if hi <= lo or depth <= NEAREST:
                    continue
                k0, k1 = int(lo), min(math.ceil(hi), width)
                scale = path / abs(tb - ta)
                now = int(depth / layer) if layered else -1
                if layered and now != low:
                    for m in range(now, now + 2):
                        if low < 0 or (m != low and m != low + 1):
                            for n in range(batch):
                                _layer_values(
                                    sums[n, v - begin, j], at, m * layer, z0, dz, row0, row_pitch,
                                    index, part, read, pair[m % 2, n],
                                )  # fmt: skip
                    low = now
                for n in range(batch):
                    if layered:
                        high = real(depth / layer - now)
                        keep = real(1) - high
                        a, b = pair[now % 2, n], pair[(now + 1) % 2, n]
                        for z in range(nz):
                            mixed[z] = keep * a[z] + high * b[z]
                    else:
                        _layer_values(
                            sums[n, v - begin, j], at, depth, z0, dz, row0, row_pitch, index, part, read, mixed
                        )  # fmt: skip
                    _spread(out[n, r], k0, k1, lo, hi, scale, mixed)


@njit(parallel=True, cache=True)
def _gather(
    sums, pose, edges, centers, first, segments, seg0, seg1, begin, lattice, z0, dz, row0, row_pitch, layer,
    by_row, by_column,
):  # fmt: skip
    """Add a chunk of views to ``by_row``, ``(batch, ny, nx, padded(nz))``, and ``by_column``, its transpose."""
    ny, nx = by_row.shape[1:3]
    row_tasks = (ny + SLAB_BLOCK - 1) // SLAB_BLOCK
    tasks = row_tasks + (nx + SLAB_BLOCK - 1) // SLAB_BLOCK
    for task in prange(tasks):
        axis = 0 if task < row_tasks else 1
        out, r0 = (by_row, task * SLAB_BLOCK) if axis == 0 else (by_column, (task - row_tasks) * SLAB_BLOCK)
        _gather_slabs(
            sums, pose, edges, centers, first, segments, seg0, seg1, begin, axis, lattice,
            z0, dz, row0, row_pitch, layer, r0, min(r0 + SLAB_BLOCK, out.shape[1]), out,
        )  # fmt: skip


def backproject(
    data, pose, edges, centers, first, segments, start, lattice, z0, dz, row0, row_pitch, layer, shape, memory
):
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
    by_row = np.zeros((batch, ny, nx, padded(nz)), dtype=data.dtype)
    by_column = np.zeros((batch, nx, ny, padded(nz)), dtype=data.dtype)
    per_view = batch * columns * (rows + 1) * data.itemsize
    chunk = int(max(1, min(views, memory // per_view)))
    for begin in range(0, views, chunk):
        stop = min(begin + chunk, views)
        sums = np.empty((batch, stop - begin, columns, rows + 1), dtype=data.dtype)
        _row_sums(data, pose, centers, first, row0, row_pitch, begin, sums)
        _gather(
            sums, pose, edges, centers, first, segments, start[begin], start[stop], begin, lattice,
            z0, dz, row0, row_pitch, layer, by_row, by_column,
        )  # fmt: skip
    by_row += by_column.transpose(0, 2, 1, 3)
    return np.ascontiguousarray(by_row[..., :nz].transpose(0, 3, 1, 2))
