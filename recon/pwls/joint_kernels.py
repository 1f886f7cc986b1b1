"""CPU kernels of the vectorial q-GGMRF (:mod:`recon.pwls.joint_prior`): as :mod:`recon.pwls.qggmrf_kernels`, several
channels.

The potential acts on the length of the difference of two voxels' channel vectors, so one curvature serves all channels
of a pair. Rows of voxels are independent of each other: results do not depend on the number of threads.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange

__all__ = ["along", "majorize"]

_FLAGS = {"contract", "reassoc", "arcp", "nsz"}


@njit(inline="always")
def _curvatures(x0, x1, scale, factor, kind, form, out):
    """out = factor · ρ'(t)/t for every voxel of a row, t = scale · |x0 − x1|; x0, x1 ``(channels, n)``."""
    n = out.size
    one = form[0] / form[0]
    if kind == 0:
        out[:] = factor
        return
    out[:] = one - one
    for c in range(x0.shape[0]):
        a, b = x0[c], x1[c]
        for j in range(n):
            i = np.uint64(j)
            d = a[i] - b[i]
            out[i] += d * d
    if kind == 1:
        reach, ratio = scale * form[0], form[2]
        for j in range(n):
            i = np.uint64(j)
            r = np.sqrt(out[i]) * reach
            d = one + r
            out[i] = factor * (one + ratio * r) / (d * d)
        return
    for j in range(n):
        i = np.uint64(j)
        r = np.sqrt(out[i]) * scale * form[0]
        if form[3] != 0:
            r = np.sqrt(r * r + form[4] * form[4])
        bend = r ** form[1]
        d = one + bend
        k = (one + form[2] * bend) / (d * d)
        if form[3] != 0:
            k *= r ** form[3]
        out[i] = factor * k


@njit(parallel=True, cache=True, fastmath=_FLAGS, error_model="numpy")
def majorize(x: Any, v: Any, steps: Any, scales: Any, factors: Any, kind: int, form: Any, out: Any) -> None:
    """out = Σ_neighbours factor · ρ'(t)/t · (v_j − v_k), t = scale · |x_j − x_k| over the channels.

    Args:
        x, v: ``(batch, channels, nz, ny, nx)`` contiguous.
        steps: ``(neighbours, 3)`` int64, ALL neighbours (both signs).
        scales, factors, kind, form: see :func:`recon.pwls.qggmrf_kernels.majorize`.
        out: like x.
    """
    batch, channels, nz, ny, nx = x.shape
    for row in prange(batch * nz * ny):
        n = row // (nz * ny)
        z = (row // ny) % nz
        y = row % ny
        work = np.empty(nx, x.dtype)
        for c in range(channels):
            out[n, c, z, y, :] = 0
        for k in range(steps.shape[0]):
            z1, y1, dx = z + steps[k, 0], y + steps[k, 1], steps[k, 2]
            if z1 < 0 or z1 >= nz or y1 < 0 or y1 >= ny:
                continue
            low, high = max(0, -dx), nx - max(0, dx)
            w = work[low:high]
            _curvatures(
                x[n, :, z, y, low:high], x[n, :, z1, y1, low + dx : high + dx], scales[k], factors[k], kind, form, w
            )
            for c in range(channels):
                v0, v1, to = v[n, c, z, y, low:high], v[n, c, z1, y1, low + dx : high + dx], out[n, c, z, y, low:high]
                for j in range(high - low):
                    i = np.uint64(j)
                    to[i] += w[i] * (v0[i] - v1[i])


@njit(parallel=True, cache=True, fastmath=_FLAGS, error_model="numpy")
def along(x: Any, u: Any, v: Any, steps: Any, scales: Any, factors: Any, kind: int, form: Any, out: Any) -> None:
    """Row sums of the two inner products ⟨v, M(x) x⟩ and ⟨v, M(x) u⟩, M the matrix of :func:`majorize`.

    Args:
        steps, scales, factors: HALF of the neighbours.
        out: ``(batch, nz, ny, 2)`` float64.
        x, u, v, kind, form: as in :func:`majorize`.
    """
    batch, channels, nz, ny, nx = x.shape
    for row in prange(batch * nz * ny):
        n = row // (nz * ny)
        z = (row // ny) % nz
        y = row % ny
        work = np.empty(nx, x.dtype)
        first = second = 0.0
        for k in range(steps.shape[0]):
            z1, y1, dx = z + steps[k, 0], y + steps[k, 1], steps[k, 2]
            if z1 < 0 or z1 >= nz or y1 < 0 or y1 >= ny:
                continue
            low, high = max(0, -dx), nx - max(0, dx)
            w = work[low:high]
            _curvatures(
                x[n, :, z, y, low:high], x[n, :, z1, y1, low + dx : high + dx], scales[k], factors[k], kind, form, w
            )
            for c in range(channels):
                x0, x1 = x[n, c, z, y, low:high], x[n, c, z1, y1, low + dx : high + dx]
                u0, u1 = u[n, c, z, y, low:high], u[n, c, z1, y1, low + dx : high + dx]
                v0, v1 = v[n, c, z, y, low:high], v[n, c, z1, y1, low + dx : high + dx]
                a = b = work[0] - work[0]
                for j in range(high - low):
                    i = np.uint64(j)
                    pull = w[i] * (v0[i] - v1[i])
                    a += pull * (x0[i] - x1[i])
                    b += pull * (u0[i] - u1[i])
                first += a
                second += b
        out[n, z, y, 0] = first
        out[n, z, y, 1] = second
