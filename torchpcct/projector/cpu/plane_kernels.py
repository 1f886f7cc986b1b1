# mypy: disable-error-code="assignment, call-arg"
"""CPU kernels of the parallel and fan beam: branchless distance-driven (Basu and De Man 2006, Proc.
SPIE 6142:65).

The overlap of a cell with the pixels of a grid row is the difference of the row's running sum at
the two projected cell edges, read by linear interpolation. Three steps make it fast: slabs are
summed per block before neighbouring edges are subtracted; the cell's width on the slab is a product
of a factor of the slab and a factor of the cell; and all images that share the geometry (symmetric
copies, batch) are lanes of one SIMD register. The adjoint spreads the same weights. Forward runs in
parallel over views, the adjoint over slab blocks; all sums have a fixed order.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from torchpcct.kernel_cache import forget_outdated
from torchpcct.projector.cpu.cone_kernels import _depth_line, _edge_line, _kernel, _small
from torchpcct.projector.cpu.simd import add_edges, sum_edges

BLOCK = 16  # slabs per block: their knots fit the second-level cache
TILE = 32  # pixels of a tile's edge


@_kernel
def tabulate(
    segments,
    offset,
    pose,
    edges,
    centers,
    first,
    lattice,
    slabs,
    parallel,
    bias,
    across,
    p,
    q,
    gain,
    weight,
):
    """Edge lines ``p, q`` and cell gains of every segment (at ``offset[s]``), slab weights
    ``(segments, …, lanes)``.

    Cell width on slab r: divergent ``(q1 - q0) (r - r_source)``, parallel ``p1 - p0``. ``bias``:
    added to p, per axis. ``across``: ``(2, lanes)``, slabs by which each lane's slabs lie beyond
    the lattice's.
    """
    real = p.dtype.type
    lanes = across.shape[1]
    for s in range(segments.shape[0]):
        v, axis, start, count = segments[s]
        at = pose[v]
        here = offset[s]
        p0, q0 = 0.0, 0.0
        for j in range(count + 1):
            p1, q1 = _edge_line(at, edges, first[v] + start + j, axis, lattice, parallel)
            p[here + j], q[here + j] = real(p1 + bias[axis]), real(q1)
            if j > 0:
                _, _, path, _ = _depth_line(
                    at, centers, first[v] + start + j - 1, axis, lattice, parallel
                )
                gain[here + j - 1] = real(path / (p1 - p0 if parallel else q1 - q0))
            p0, q0 = p1, q1
        gain[here + count] = 0
        l0, l1, _, _ = _depth_line(
            at, centers, first[v] + start + count // 2, axis, lattice, parallel
        )
        for r in range(slabs[axis]):
            for l in range(lanes):
                if parallel:
                    weight[s, r, l] = 1
                else:
                    # l0 + l1 r is proportional to the distance from the source, positive in front
                    # of it.
                    depth = l0 + l1 * (r + across[axis, l])
                    weight[s, r, l] = real(l1 / depth) if depth > 1e-6 else real(0)


@_small
def _active(p, q, here, count, r0, r1, top):
    """Edges ``e0…e1`` of a segment between which a block of slabs has anything to read."""
    e0, e1 = 0, count + 1
    a, b = p[here] + q[here] * r0, p[here] + q[here] * (r1 - 1)
    rising = p[here + count] + q[here + count] * r0 > a
    while e0 + 1 < count + 1:
        a = p[here + e0 + 1] + q[here + e0 + 1] * r0
        b = p[here + e0 + 1] + q[here + e0 + 1] * (r1 - 1)
        if (max(a, b) < 0) if rising else (min(a, b) > top):
            e0 += 1
        else:
            break
    while e1 - 2 > e0:
        a = p[here + e1 - 2] + q[here + e1 - 2] * r0
        b = p[here + e1 - 2] + q[here + e1 - 2] * (r1 - 1)
        if (min(a, b) > top) if rising else (max(a, b) < 0):
            e1 -= 1
        else:
            break
    return e0, e1


@njit(nogil=True, cache=True)
def load_image(begin, end, image, address, place, count, width, sums):
    """Running sums of one axis, ``(slabs, knots, lanes)``, of ``(batch, pixels)`` under the lane
    addresses.

    ``address``: ``(lanes, 4)``: batch index, base, per slab, per step. ``place``: ``(lanes, 2)``:
    slab and knot where the ``count`` slabs of ``width`` pixels begin; all around is zero. The last
    knot repeats up to the end, so that the interpolation may read beyond it.
    """
    _, knots, lanes = sums.shape
    for r in range(begin, end):
        for l in range(lanes):
            i, first = r - place[l, 0], place[l, 1]
            total = sums.dtype.type(0)
            if i < 0 or i >= count:
                for k in range(knots):
                    sums[r, k, l] = total
                continue
            n, base = address[l, 0], address[l, 1] + i * address[l, 2]
            step = address[l, 3]
            for k in range(first + 1):
                sums[r, k, l] = total
            for k in range(width):
                total += image[n, base + k * step]
                sums[r, first + 1 + k, l] = total
            for k in range(first + 1 + width, knots):
                sums[r, k, l] = total


@_small
def _project_view(
    lanes,
    reach,
    segments,
    offset,
    s0,
    s1,
    axis,
    sums,
    stride,
    slabs,
    top,
    p,
    q,
    gain,
    weight,
    apart,
    out,
):
    width = len(lanes)
    for r0 in range(0, slabs, BLOCK):
        r1 = min(r0 + BLOCK, slabs)
        for s in range(s0, s1):
            if segments[s, 1] == axis:
                start, count, here = segments[s, 2], segments[s, 3], offset[s]
                e0, e1 = _active(p, q, here, count, r0, r1, top)
                sum_edges(
                    lanes,
                    reach,
                    sums,
                    stride,
                    p[here:],
                    q[here:],
                    weight[s],
                    gain[here:],
                    e0,
                    e1,
                    r0,
                    r1,
                    top,
                    apart,
                    out[start * width :],
                )


@_small
def _beyond(reach):
    """Knots read after the highest interpolation index."""
    return max(1, len(reach))


@njit(nogil=True, cache=True)
def project(
    begin,
    end,
    lanes,
    reach,
    segments,
    offset,
    start,
    by_row,
    by_column,
    p,
    q,
    gain,
    weight,
    apart,
    out,
):
    """Lane readings of canonical views, ``out``: ``(views, columns * lanes)``, overwritten.

    ``by_row, by_column``: ``(slabs, knots * lanes)``. ``apart``: ``(2, 2 * lanes)``, see
    ``simd.sum_edges``.
    """
    width = len(lanes)
    real = by_row.dtype.type
    for v in range(begin, end):
        line = out[v]
        line[:] = 0
        for axis in range(2):
            sums = by_row if axis == 0 else by_column
            slabs, stride = sums.shape
            top = real(stride // width - 1 - _beyond(reach))
            _project_view(
                lanes,
                reach,
                segments,
                offset,
                start[v],
                start[v + 1],
                axis,
                sums.reshape(-1),
                stride,
                slabs,
                top,
                p,
                q,
                gain,
                weight,
                apart[axis],
                line,
            )


@_kernel
def deal(out, target, reverse, batch, data):
    """Lane readings ``(views, columns, lanes)`` to ``data``, ``(batch, views, columns)``.

    Lane ``operation + n * operations`` belongs to image ``n``.
    """
    operations = target.shape[1]
    columns = out.shape[1]
    for v in range(out.shape[0]):
        for g in range(operations):
            to = target[v, g]
            if to >= 0:
                for n in range(batch):
                    for j in range(columns):
                        i = columns - 1 - j if reverse[v, g] else j
                        data[n, to, i] = out[v, j, n * operations + g]


@_kernel
def cell_values(data, target, reverse, segments, offset, gain, values):
    """Transpose of ``deal``: readings times their gain as ``values``, ``(entries, lanes)``,
    overwritten."""
    operations = target.shape[1]
    batch, _, columns = data.shape
    for s in range(segments.shape[0]):
        v, start, count, here = segments[s, 0], segments[s, 2], segments[s, 3], offset[s]
        values[here : here + count + 1] = 0
        for g in range(operations):
            to = target[v, g]
            if to >= 0:
                for n in range(batch):
                    l = n * operations + g
                    for j in range(count):
                        i = columns - 1 - start - j if reverse[v, g] else start + j
                        values[here + j, l] = gain[here + j] * data[n, to, i]


@_small
def _spread_block(
    lanes, reach, segments, offset, axis, r0, r1, top, p, q, weight, apart, values, out, stride
):
    width = len(lanes)
    for s in range(segments.shape[0]):
        if segments[s, 1] == axis:
            count, here = segments[s, 3], offset[s]
            e0, e1 = _active(p, q, here, count, r0, r1, top)
            add_edges(
                lanes,
                reach,
                out,
                stride,
                p[here:],
                q[here:],
                weight[s],
                e0,
                e1,
                r0,
                r1,
                top,
                apart,
                values[here * width :],
            )


@_small
def _reverse_sums(out, r0, r1, knots, width, total, place, planes):
    """Knot values to voxels, ``Σ_{k > m} out[k]``, into ``planes``, ``(lanes, slabs, width)``."""
    _, slabs, pixels = planes.shape
    for r in range(r0, r1):
        base = (r - r0) * knots * width
        for l in range(width):
            total[l] = out[base + (knots - 1) * width + l]
        for k in range(knots - 2, 0, -1):
            for l in range(width):
                total[l] += out[base + k * width + l]
                i, m = r - place[l, 0], k - 1 - place[l, 1]
                if 0 <= i < slabs and 0 <= m < pixels:
                    planes[l, i, m] = total[l]


def spread_tasks(size: NDArray[np.int64]) -> int:
    """Tasks of :func:`backproject`: blocks of slabs of both axes."""
    return int((-(-size[:, 0] // BLOCK)).sum())


@njit(nogil=True, cache=True)
def backproject(
    begin,
    end,
    lanes,
    reach,
    segments,
    offset,
    p,
    q,
    weight,
    apart,
    values,
    size,
    place,
    by_row,
    by_column,
):
    """Transpose of :func:`project`: cell values ``(entries * lanes,)`` to ``(lanes, slabs, width)``
    per axis.

    ``size``: ``(2, 2)``, slabs and knots per axis. ``place``: ``(2, lanes, 2)``, see
    ``load_image``.
    """
    width = len(lanes)
    real = by_row.dtype.type
    row_tasks = (size[0, 0] + BLOCK - 1) // BLOCK
    for task in range(begin, end):
        axis = 0 if task < row_tasks else 1
        planes, r0 = (
            (by_row, task * BLOCK) if axis == 0 else (by_column, (task - row_tasks) * BLOCK)
        )
        r1 = min(r0 + BLOCK, size[axis, 0])
        knots = size[axis, 1]
        out = np.zeros((r1 - r0) * knots * width, dtype=by_row.dtype)
        total = np.empty(width, dtype=by_row.dtype)
        _spread_block(
            lanes,
            reach,
            segments,
            offset,
            axis,
            r0,
            r1,
            real(knots - 1 - _beyond(reach)),
            p,
            q,
            weight,
            apart[axis],
            values,
            out,
            knots * width,
        )
        _reverse_sums(out, r0, r1, knots, width, total, place[axis], planes)


@_small
def _collect_tile(plane, at, y0, y1, x0, x1, swap, image):
    for y in range(y0, y1):
        for x in range(x0, x1):
            a = at[0] + at[1] * y + at[2] * x
            b = at[3] + at[4] * y + at[5] * x
            image[y, x] += plane[b, a] if swap else plane[a, b]


@njit(nogil=True, cache=True)
def collect(begin, end, by_row, by_column, inverse, operations, image):
    """Sum the lanes back onto ``image``, ``(batch, ny, nx)``, by rows of tiles; transpose of
    ``load_image``, both axes.

    ``inverse``: ``(operations, 6)``: row and column of the operated image read at pixel (y, x),
    each as base, per y, per x. Tiles, since half of the lanes are read across their rows.
    """
    batch, ny, nx = image.shape
    for tile in range(begin, end):
        y0, y1 = tile * TILE, min((tile + 1) * TILE, ny)
        for n in range(batch):
            image[n, y0:y1] = 0
            for x0 in range(0, nx, TILE):
                for g in range(operations):
                    l = n * operations + g
                    _collect_tile(
                        by_row[l], inverse[g], y0, y1, x0, min(x0 + TILE, nx), False, image[n]
                    )
                    _collect_tile(
                        by_column[l], inverse[g], y0, y1, x0, min(x0 + TILE, nx), True, image[n]
                    )


forget_outdated(__name__)
