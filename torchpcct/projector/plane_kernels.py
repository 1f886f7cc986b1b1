"""CPU kernels of the parallel and fan beam: branchless distance-driven (Basu and De Man 2006, Proc. SPIE 6142:65).

The overlap of a cell with the pixels of a grid row is the difference of the row's running sum at the two projected
cell edges, read by linear interpolation. The adjoint spreads the same weights back. See ``volume_kernels`` for the
model and the order of the loops.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from torchpcct.projector.volume_kernels import _FLAGS, _depth_line, _edge_line

__all__ = ["backproject", "project"]


@njit(parallel=True, cache=True, fastmath=_FLAGS)
def project(sums, axis, pose, edges, centers, first, segments, start, lattice, parallel, data):
    """Add the segments of one axis to the line integrals.

    Args:
        sums: ``(batch, slabs, width + 1)`` running sums along each slab (0 first).
        axis: 0 (slabs are grid rows) or 1 (grid columns).
        pose, edges, centers, first: see ``rays.Rays``; segments, start: see ``rays.Segments``.
        lattice: ``(8,)`` slab positions, see ``_edge_line``.
        data: ``(batch, views, columns)``, added to.
    """
    batch, slabs, entries = sums.shape
    real = sums.dtype.type
    zero, top = real(0), real(entries - 1)
    for v in prange(data.shape[1]):
        at = pose[v]
        read = np.empty((2, slabs), dtype=sums.dtype)
        for s in range(start[v], start[v + 1]):
            if segments[s, 1] != axis:
                continue
            for n in range(batch):
                for j in range(segments[s, 2], segments[s, 2] + segments[s, 3] + 1):
                    col = first[v] + j
                    p, q = _edge_line(at, edges, col, axis, lattice, parallel)
                    p1, q1 = real(p), real(q)
                    now, before = read[j % 2], read[(j + 1) % 2]
                    for r in range(slabs):
                        t = min(max(p1 + q1 * real(r), zero), top)
                        k = np.uint64(min(np.int32(t), np.int32(entries - 2)))
                        low = sums[n, r, k]
                        now[r] = low + (t - real(k)) * (sums[n, r, k + np.uint64(1)] - low)
                    if j > segments[s, 2]:
                        l0, l1, path, _ = _depth_line(at, centers, col - 1, axis, lattice, parallel)
                        pb, qb = _edge_line(at, edges, col - 1, axis, lattice, parallel)
                        total = zero
                        for r in range(slabs):
                            if parallel or l0 + l1 * r > 0:
                                total += (now[r] - before[r]) * real(1.0 / ((p - pb) + (q - qb) * r))
                        data[n, v, j - 1] += real(path) * total


@njit(parallel=True, cache=True, fastmath=_FLAGS)
def backproject(data, axis, pose, edges, centers, first, segments, lattice, parallel, out):
    """The transpose of :func:`project`: ``out``, ``(batch, slabs, width)``, is overwritten."""
    batch, slabs, width = out.shape
    real = data.dtype.type
    zero, top = real(0), real(width)
    block = 8
    for task in prange((slabs + block - 1) // block):
        r0, r1 = task * block, min(task * block + block, slabs)
        spread = np.zeros((batch, block, width + 1), dtype=np.float64)
        for s in range(segments.shape[0]):
            if segments[s, 1] != axis:
                continue
            v = segments[s, 0]
            at = pose[v]
            for j in range(segments[s, 2], segments[s, 2] + segments[s, 3]):
                col = first[v] + j
                pa, qa = _edge_line(at, edges, col, axis, lattice, parallel)
                pb, qb = _edge_line(at, edges, col + 1, axis, lattice, parallel)
                l0, l1, path, _ = _depth_line(at, centers, col, axis, lattice, parallel)
                for r in range(r0, r1):
                    if not parallel and l0 + l1 * r <= 0:
                        continue
                    weight = real(1.0 / ((pb - pa) + (qb - qa) * r)) * real(path)
                    ta = min(max(real(pa) + real(qa) * real(r), zero), top)
                    tb = min(max(real(pb) + real(qb) * real(r), zero), top)
                    ka = np.uint64(min(np.int32(ta), np.int32(width - 1)))
                    kb = np.uint64(min(np.int32(tb), np.int32(width - 1)))
                    fa, fb = ta - real(ka), tb - real(kb)
                    for n in range(batch):
                        value = weight * data[n, v, j]
                        line = spread[n, r - r0]
                        line[ka] -= (real(1) - fa) * value
                        line[ka + np.uint64(1)] -= fa * value
                        line[kb] += (real(1) - fb) * value
                        line[kb + np.uint64(1)] += fb * value
        for n in range(batch):
            for r in range(r0, r1):
                total = 0.0
                for k in range(width, 0, -1):
                    total += spread[n, r - r0, k]
                    out[n, r, k - 1] = real(total)
