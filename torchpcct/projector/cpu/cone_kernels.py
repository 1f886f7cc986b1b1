# mypy: disable-error-code="assignment, call-arg"
"""CPU kernels of the cone beam: distance-driven overlaps, followed slab by slab, z innermost.

Model (De Man and Basu 2004, Phys. Med. Biol. 49:2463, in its separable form). In each slab of
voxels (a grid row or column, whichever the ray crosses more often) the edges of a detector cell are
projected onto the slab's middle plane. The reading is the mean of the voxel values over that
rectangle, times the path through the slab, summed over slabs. In the plane the overlaps are written
out; along z they are differences of a running sum, read at the projected row edges by linear
interpolation, which is the same overlap.

Several volumes at a time share what depends on the geometry alone: their lines along z stand one
after the other in one long line, which is read and written with one weight.

Forward runs in parallel over views, the adjoint over slabs: no two threads write to one place and
every sum has a fixed order, so that results depend neither on the number of threads nor on what
else is in the batch.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from torchpcct.kernel_cache import forget_outdated
from torchpcct.projector.cpu.simd import add_lines, spread_line, spread_lines, sum_lines
from torchpcct.projector.cpu.simd_interpolation import add_steps, set_steps
from torchpcct.projector.tables import MAX_LAYERS_PER_SLAB, NEAREST
from torchpcct.threads import run

_FLAGS = {"contract", "nsz", "arcp", "reassoc"}
"""NaN and Inf must survive, so only the flags that leave them alone."""
SLAB_BLOCK = 24
"""Slabs of one task of the adjoint: enough to reuse a layer, few enough to share the work. Fixed,
for determinism."""
BLOCK_BYTES = 512 << 10
"""Of the running sums of a block of slabs in the forward pass: the second-level cache holds them
while :data:`VIEWS` views read them. Fixed, for determinism."""
VIEWS = 4
"""Views that the forward pass takes through a block of slabs, one after the other."""
INNER: Any = {
    "cache": True,
    "forceinline": True,
    "error_model": "numpy",
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
}
"""Of functions that only kernels call. Without wrappers for Python and C they compile faster.
Inlined they exist once, in the kernel: of one that is called, a fresh process and one that reads
the cache have copies that round differently."""
# Ray geometry in float64, called per cell and not per voxel.
_small = njit(**INNER, fastmath=_FLAGS)
_kernel = njit(nogil=True, cache=True, fastmath=_FLAGS, error_model="numpy")


def padded(n: int) -> int:
    """``n`` rounded up to whole SIMD registers, so that no loop along z has a scalar remainder."""
    return (n + 7) // 8 * 8


@_small
def _edge_line(pose, table, j, axis, lattice, parallel):
    """In-slab coordinate of a ray, ``t(r) = p + q r``: r counts slabs, t voxel edges along the
    slab."""
    a, b = table[j, 0], table[j, 1]
    if parallel:
        sx, sy = pose[0] + b * pose[5], pose[1] + b * pose[6]
        dx, dy = pose[3], pose[4]
    else:
        sx, sy = pose[0], pose[1]
        dx, dy = a * pose[3] + b * pose[5], a * pose[4] + b * pose[6]
    # lattice: y of slab row 0, its pitch, x of the first voxel edge, its pitch; then the same for
    # slab columns.
    if axis == 0:
        slope = dx / dy
        return (sx - lattice[2] + (lattice[0] - sy) * slope) / lattice[3], slope * lattice[
            1
        ] / lattice[3]
    slope = dy / dx
    return (sy - lattice[6] + (lattice[4] - sx) * slope) / lattice[7], slope * lattice[5] / lattice[
        7
    ]


@_small
def _depth_line(pose, table, j, axis, lattice, parallel):
    """Ray parameter at the slabs, ``λ(r) = l + m r``, the path per slab, and the squared
    in-plane ray length."""
    a, b = table[j, 0], table[j, 1]
    if parallel:
        dx, dy = pose[3], pose[4]
    else:
        dx, dy = a * pose[3] + b * pose[5], a * pose[4] + b * pose[6]
    square = dx * dx + dy * dy
    if axis == 0:
        return (
            (lattice[0] - pose[1]) / dy,
            lattice[1] / dy,
            lattice[1] * math.sqrt(square) / abs(dy),
            square,
        )
    return (
        (lattice[4] - pose[0]) / dx,
        lattice[5] / dx,
        lattice[5] * math.sqrt(square) / abs(dx),
        square,
    )


@_small
def _cell(pose, edges, centers, j, axis, lattice):
    """Lines of a cell's two edges (see ``_edge_line``) and its depth line (see ``_depth_line``)."""
    p0, q0 = _edge_line(pose, edges, j, axis, lattice, False)
    p1, q1 = _edge_line(pose, edges, j + 1, axis, lattice, False)
    l0, l1, path, square = _depth_line(pose, centers, j, axis, lattice, False)
    return p0, q0, p1, q1, l0, l1, path, square


@_kernel
def tabulate_cells(segments, pose, edges, centers, first, lattice, parallel, cells, axes):
    """Per view and column ``p0, q0, p1, q1, l0, l1, path, square`` into ``cells``, and the main
    axis into ``axes``.

    The lines of the cell's two edges (see ``_edge_line``) and of its depth (see ``_depth_line``),
    of any beam.
    """
    for s in range(segments.shape[0]):
        v, axis, start, count = segments[s]
        for j in range(start, start + count):
            k, cell = first[v] + j, cells[v, j]
            cell[0], cell[1] = _edge_line(pose[v], edges, k, axis, lattice, parallel)
            cell[2], cell[3] = _edge_line(pose[v], edges, k + 1, axis, lattice, parallel)
            cell[4], cell[5], cell[6], cell[7] = _depth_line(
                pose[v], centers, k, axis, lattice, parallel
            )
            axes[v, j] = axis


@_small
def _with_room(room, offset, low, high):
    """The entries' arrays, or larger ones."""
    if room <= offset.size:
        return offset, low, high
    return (
        np.empty(room, dtype=np.int64),
        np.empty(room, dtype=low.dtype),
        np.empty(room, dtype=low.dtype),
    )


@_small
def _clear(line):
    for z in range(line.size):
        line[z] = 0


@_small
def _room(p0, q0, p1, q1, r0, r1, width):
    """Entries that ``_plan`` may need: the cell's width is largest in the first or the last
    slab."""
    widest = max(abs(p1 - p0 + (q1 - q0) * r0), abs(p1 - p0 + (q1 - q0) * (r1 - 1)))
    return (r1 - r0) * (int(min(widest, float(width))) + 2)


@_small
def _plan(
    p0,
    q0,
    p1,
    q1,
    l0,
    l1,
    path,
    layer,
    layered,
    r0,
    r1,
    width,
    across,
    along,
    layers,
    ends,
    offset,
    low,
    high,
):
    """What one cell reads of the slabs ``r0 … r1``: runs of slabs between the same two layers, and
    their lines.

    Entry e adds line ``offset[e]`` with the weight ``low[e]`` to the run's lower layer and
    ``high[e]`` to the upper. ``layers`` and ``ends`` receive the lower layer of every run and the
    end of its entries. Where slabs are interpolated one by one (``layered`` false) a slab is a run,
    its row is the slab, and all its weight is ``low``.

    Returns:
        the number of runs.
    """
    real = low.dtype.type
    runs, e, now = 0, 0, -1
    inverse = 1.0 / layer
    for r in range(r0, r1):
        ta, tb = p0 + q0 * r, p1 + q1 * r
        lo, hi = max(min(ta, tb), 0.0), min(max(ta, tb), float(width))
        depth = l0 + l1 * r
        if hi <= lo or depth <= NEAREST:
            continue
        scale = path / abs(tb - ta)
        share = 0.0
        if layered:
            at = depth * inverse
            here = int(at)
            share = at - here
        else:
            here = r
        if here != now:
            now = here
            layers[runs] = now
            runs += 1
        start = r * across
        k = int(lo)
        left = lo
        while left < hi:
            right = min(hi, k + 1.0)
            w = scale * (right - left)
            offset[e] = start + k * along
            high[e] = real(w * share)
            low[e] = real(w - w * share)
            e += 1
            k += 1
            left = float(k)
        ends[runs - 1] = e
    return runs


@_small
def _add_rows(lanes, lines, at, depth, z0, dz, row0, row_pitch, out):
    """Add the row means of one layer (running sums ``lines`` of all volumes) at the ray parameter
    ``depth`` to ``out``, ``(batch, rows)``."""
    real = lines.dtype.type
    step = depth * row_pitch / dz
    zeta = real((at[2] + depth * (row0 + at[7] - at[2]) - z0) / dz)
    batch, rows = out.shape
    knots = lines.size // batch
    for n in range(batch):
        line = lines[n * knots : (n + 1) * knots]
        add_steps(lanes, line, zeta, real(step), knots - 8, knots, real(1.0 / step), out[n], rows)


@_small
def _give(at, centers, first, row0, row_pitch, sums, v, data):
    """Sums over the slabs, ``(columns, batch, ≥ rows)``, times the slant of each ray as the
    readings of view ``v`` of ``(batch, views, rows, columns)``."""
    batch, _, rows, columns = data.shape
    for j in range(columns):
        a, b = centers[first + j, 0], centers[first + j, 1]
        dx, dy = a * at[3] + b * at[5], a * at[4] + b * at[6]
        square = dx * dx + dy * dy
        for i in range(rows):
            rise = row0 + (i + 0.5) * row_pitch + at[7] - at[2]
            slant = data.dtype.type(math.sqrt(1.0 + rise * rise / square))
            for n in range(batch):
                data[n, v, i, j] = sums[j, n, i] * slant


@_kernel
def _project(
    begin,
    end,
    lanes,
    lines,
    ny,
    nx,
    pose,
    edges,
    centers,
    first,
    segments,
    start,
    lattice,
    z0,
    dz,
    row0,
    row_pitch,
    layer,
    data,
):
    """The views ``begin … end``; ``lines``: ``(ny * nx, batch * knots)``, ``data``: ``(batch,
    views, rows, columns)``."""
    batch, _, rows, columns = data.shape
    length = lines.shape[1]
    knots = length // batch
    most = max(ny, nx)
    block = most
    # Of one volume: where a block ends a sum does, and it must not depend on the batch.
    if ny * nx * knots * lines.itemsize > 2 * BLOCK_BYTES:
        block = max(BLOCK_BYTES // (most * knots * lines.itemsize), 4)
    flat = lines.reshape(-1)
    pair, slab = np.empty((2, length), dtype=lines.dtype), np.empty(length, dtype=lines.dtype)
    # padded(rows)
    sums = np.empty((VIEWS, columns, batch, (rows + 7) // 8 * 8), dtype=lines.dtype)
    for line in pair:
        _clear(line)
    layers, ends = np.empty(max(ny, nx), dtype=np.int64), np.empty(max(ny, nx), dtype=np.int64)
    offset = np.empty(0, dtype=np.int64)
    low, high = np.empty(0, dtype=lines.dtype), np.empty(0, dtype=lines.dtype)
    for v0 in range(begin, end, VIEWS):
        v1 = min(v0 + VIEWS, end)
        sums[:] = 0
        for r0 in range(0, most, block):
            for v in range(v0, v1):
                at, total = pose[v], sums[v - v0]
                for s in range(start[v], start[v + 1]):
                    axis = segments[s, 1]
                    slabs, width = (ny, nx) if axis == 0 else (nx, ny)
                    across, along = (nx * length, length) if axis == 0 else (length, nx * length)
                    r1 = min(r0 + block, slabs)
                    if r1 <= r0:
                        continue
                    for j in range(segments[s, 2], segments[s, 2] + segments[s, 3]):
                        p0, q0, p1, q1, l0, l1, path, _ = _cell(
                            at, edges, centers, first[v] + j, axis, lattice
                        )
                        layered = abs(l1) < MAX_LAYERS_PER_SLAB * layer
                        offset, low, high = _with_room(
                            _room(p0, q0, p1, q1, r0, r1, width), offset, low, high
                        )
                        runs = _plan(
                            p0,
                            q0,
                            p1,
                            q1,
                            l0,
                            l1,
                            path,
                            layer,
                            layered,
                            r0,
                            r1,
                            width,
                            across,
                            along,
                            layers,
                            ends,
                            offset,
                            low,
                            high,
                        )
                        e0 = 0
                        for n in range(runs):
                            now, e1 = layers[n], ends[n]
                            if not layered:
                                sum_lines(lanes, flat, offset, low, e0, e1, length, slab)
                                depth = l0 + l1 * now
                                _add_rows(lanes, slab, at, depth, z0, dz, row0, row_pitch, total[j])
                                e0 = e1
                                continue
                            add_lines(
                                lanes,
                                flat,
                                offset,
                                low,
                                high,
                                e0,
                                e1,
                                length,
                                pair[now % 2],
                                pair[(now + 1) % 2],
                            )
                            e0 = e1
                            after = layers[n + 1] if n + 1 < runs else -9
                            for m in range(now, now + 2):
                                if m != after and m != after + 1:
                                    line = pair[m % 2]
                                    _add_rows(
                                        lanes,
                                        line,
                                        at,
                                        m * layer,
                                        z0,
                                        dz,
                                        row0,
                                        row_pitch,
                                        total[j],
                                    )
                                    _clear(line)
        for v in range(v0, v1):
            _give(pose[v], centers, first[v], row0, row_pitch, sums[v - v0], v, data)


def project(
    lines,
    ny,
    nx,
    pose,
    edges,
    centers,
    first,
    segments,
    start,
    lattice,
    z0,
    dz,
    row0,
    row_pitch,
    layer,
    data,
):
    """Cone-beam line integrals of a batch of volumes.

    Args:
        lines: ``(ny * nx, batch * (padded(nz) + 8))`` running sums of the volumes along z: of each
            0 first, the total repeated.
        pose, edges, centers, first: see ``rays.Rays``.
        segments, start: see ``rays.Segments``.
        lattice: ``(8,)`` slab positions, see ``_edge_line``.
        z0, dz: lower edge of the grid along z and its pitch (mm).
        row0, row_pitch: lower edge of the first row kept, and the pitch (mm on the detector).
        layer: spacing of the depth layers in the ray parameter, see ``layer_spacing``.
        data: ``(batch, views, rows, columns)`` output, overwritten.
    """
    lanes = (0,) * (32 // lines.dtype.itemsize)
    run(
        _project,
        data.shape[1],
        lanes,
        lines,
        ny,
        nx,
        pose,
        edges,
        centers,
        first,
        segments,
        start,
        lattice,
        z0,
        dz,
        row0,
        row_pitch,
        layer,
        data,
    )


@_kernel
def _row_sums(begin, end, data, pose, centers, first, row0, row_pitch, view0, sums, dark):
    """Readings times their slant, summed along the rows: ``(views, columns, batch, rows + 1)``,
    from ``view0`` on; and which ``(views, columns)`` hold nothing but zeros."""
    _, columns, batch, edges = sums.shape
    for n in range(begin, end):
        v = view0 + n
        at = pose[v]
        for j in range(columns):
            a, b = centers[first[v] + j, 0], centers[first[v] + j, 1]
            dx, dy = a * at[3] + b * at[5], a * at[4] + b * at[6]
            square = dx * dx + dy * dy
            nothing = True
            for k in range(batch):
                sums[n, j, k, 0] = 0
            for i in range(edges - 1):
                rise = row0 + (i + 0.5) * row_pitch + at[7] - at[2]
                slant = data.dtype.type(math.sqrt(1.0 + rise * rise / square))
                for k in range(batch):
                    value = data[k, v, i, j]
                    nothing &= value == 0
                    sums[n, j, k, i + 1] = sums[n, j, k, i] + slant * value
            dark[n, j] = nothing


@_small
def _layer_values(lanes, sums, at, depth, z0, dz, row0, row_pitch, values):
    """Transpose of ``_add_rows``: what each voxel of a line at ``depth`` collects from the
    running row sums ``(batch, rows + 1)``, for all volumes."""
    real = sums.dtype.type
    rho = ((z0 - at[2]) / depth - (row0 + at[7] - at[2])) / row_pitch
    pitch = dz / (depth * row_pitch)
    batch, edges = sums.shape
    nz = values.size // batch
    for n in range(batch):
        line = values[n * nz : (n + 1) * nz]
        set_steps(lanes, sums[n], real(rho), real(pitch), edges - 1, edges, line, nz)


@_kernel
def _gather(
    begin,
    end,
    lanes,
    sums,
    dark,
    pose,
    edges,
    centers,
    first,
    segments,
    seg0,
    seg1,
    view0,
    lattice,
    z0,
    dz,
    row0,
    row_pitch,
    layer,
    by_row,
    by_column,
):
    """Add a chunk of views to ``by_row``, ``(ny, nx, batch * padded(nz))``, and ``by_column``,
    its transpose, by blocks. What is ``dark`` adds nothing."""
    row_tasks = (by_row.shape[0] + SLAB_BLOCK - 1) // SLAB_BLOCK
    length = by_row.shape[2]
    pair = np.empty((2, length), dtype=sums.dtype)
    layers, ends = np.empty(SLAB_BLOCK, dtype=np.int64), np.empty(SLAB_BLOCK, dtype=np.int64)
    offset = np.empty(0, dtype=np.int64)
    low, high = np.empty(0, dtype=sums.dtype), np.empty(0, dtype=sums.dtype)
    for task in range(begin, end):
        axis = 0 if task < row_tasks else 1
        out, r0 = (
            (by_row, task * SLAB_BLOCK)
            if axis == 0
            else (by_column, (task - row_tasks) * SLAB_BLOCK)
        )
        slabs, width = out.shape[:2]
        r1 = min(r0 + SLAB_BLOCK, slabs)
        flat = out.reshape(-1)
        for s in range(seg0, seg1):
            if segments[s, 1] != axis:
                continue
            v = segments[s, 0]
            at = pose[v]
            for j in range(segments[s, 2], segments[s, 2] + segments[s, 3]):
                if dark[v - view0, j]:
                    continue
                p0, q0, p1, q1, l0, l1, path, _ = _cell(
                    at, edges, centers, first[v] + j, axis, lattice
                )
                layered = abs(l1) < MAX_LAYERS_PER_SLAB * layer
                offset, low, high = _with_room(
                    _room(p0, q0, p1, q1, r0, r1, width), offset, low, high
                )
                runs = _plan(
                    p0,
                    q0,
                    p1,
                    q1,
                    l0,
                    l1,
                    path,
                    layer,
                    layered,
                    r0,
                    r1,
                    width,
                    width * length,
                    length,
                    layers,
                    ends,
                    offset,
                    low,
                    high,
                )
                e0, before = 0, -9
                for n in range(runs):
                    now, e1 = layers[n], ends[n]
                    line = sums[v - view0, j]
                    if layered:
                        for m in range(now, now + 2):
                            if m != before and m != before + 1:
                                _layer_values(
                                    lanes, line, at, m * layer, z0, dz, row0, row_pitch, pair[m % 2]
                                )
                        before = now
                        spread_lines(
                            lanes,
                            flat,
                            offset,
                            low,
                            high,
                            e0,
                            e1,
                            length,
                            pair[now % 2],
                            pair[(now + 1) % 2],
                        )
                    else:
                        _layer_values(
                            lanes, line, at, l0 + l1 * now, z0, dz, row0, row_pitch, pair[0]
                        )
                        spread_line(lanes, flat, offset, low, e0, e1, length, pair[0])
                    e0 = e1


def backproject(
    data,
    pose,
    edges,
    centers,
    first,
    segments,
    start,
    lattice,
    z0,
    dz,
    row0,
    row_pitch,
    layer,
    chunk,
    volumes,
):
    """The exact transpose of :func:`project`.

    Args:
        data: ``(batch, views, rows, columns)``.
        chunk: views whose row sums are held at a time; the result does not depend on it.
        volumes: ``(batch, nz, ny, nx)`` output, overwritten; dtype of ``data``.
    """
    batch, views, rows, columns = data.shape
    _, nz, ny, nx = volumes.shape
    lanes = (0,) * (32 // data.dtype.itemsize)
    by_row = np.zeros((ny, nx, batch * padded(nz)), dtype=data.dtype)
    by_column = np.zeros((nx, ny, batch * padded(nz)), dtype=data.dtype)
    tasks = sum(-(-slabs // SLAB_BLOCK) for slabs in (ny, nx))
    for before in range(0, views, chunk):
        after = min(before + chunk, views)
        sums = np.empty((after - before, columns, batch, rows + 1), dtype=data.dtype)
        dark = np.empty((after - before, columns), dtype=np.bool_)
        run(
            _row_sums,
            after - before,
            data,
            pose,
            centers,
            first,
            row0,
            row_pitch,
            before,
            sums,
            dark,
        )
        run(
            _gather,
            tasks,
            lanes,
            sums,
            dark,
            pose,
            edges,
            centers,
            first,
            segments,
            start[before],
            start[after],
            before,
            lattice,
            z0,
            dz,
            row0,
            row_pitch,
            layer,
            by_row,
            by_column,
        )
    by_row += by_column.transpose(1, 0, 2)
    volumes[...] = by_row.reshape(ny, nx, batch, -1)[..., :nz].transpose(2, 3, 0, 1)


forget_outdated(__name__)
