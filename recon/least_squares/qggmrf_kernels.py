"""CPU kernels of the q-GGMRF: the passes of :class:`recon.least_squares.qggmrf.BoundPrior`, fused
over all neighbours.

The curvature formula is that of ``BoundPrior.curvature``, to which the tests compare these kernels.
Rows of voxels are independent of each other in every pass, so results do not depend on the number
of threads; ``begin … end`` of ``batch · nz · ny`` are worked on. Inner loops run over slices with
unsigned indices and without branches (one loop for each kind of potential), so that they vectorise.

Of several channels the curvature of the length of their difference is written to a buffer first and
serves them all; a single one, which would take 5 to 14 % longer that way, does without.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

_FLAGS = {"contract", "reassoc", "arcp", "nsz"}
"""Liberties of the compiler: NaN and Inf of an image must survive."""
_VIEWS_ONLY: Any = {
    "nogil": True,
    "cache": True,
    "fastmath": _FLAGS,
    "error_model": "numpy",
    "_nrt": False,
}
"""Kernels that allocate nothing need no reference counts, which took a fifth of the time: one for
every row's slice."""


@njit(inline="always")
def _simple(r, factor, form):
    """factor · ρ'(t) / t at r = |t| / T for p = 2 and q = 1."""
    one = form[0] / form[0]
    d = one + r
    return factor * (one + form[2] * r) / (d * d)


@njit(inline="always")
def _general(r, form):
    """ρ'(t) / t at r = |t| / T for any 1 ≤ q ≤ p ≤ 2."""
    one = form[0] / form[0]
    if form[3] != 0:
        r = np.sqrt(r * r + form[4] * form[4])
    bend = r ** form[1]
    d = one + bend
    c = (one + form[2] * bend) / (d * d)
    return c * r ** form[3] if form[3] != 0 else c


@njit(inline="always")
def _add_pull(x0, x1, v0, v1, scale, factor, kind, form, to):
    """to += factor · ρ'(t)/t · (v0 − v1), t = scale · (x0 − x1)."""
    n = x0.size
    if kind == 0:
        for j in range(n):
            i = np.uint64(j)
            to[i] += factor * (v0[i] - v1[i])
    elif kind == 1:
        reach = scale * form[0]
        for j in range(n):
            i = np.uint64(j)
            to[i] += _simple(abs(x0[i] - x1[i]) * reach, factor, form) * (v0[i] - v1[i])
    else:
        for j in range(n):
            i = np.uint64(j)
            to[i] += (
                factor * _general(abs((x0[i] - x1[i]) * scale) * form[0], form) * (v0[i] - v1[i])
            )


@njit(inline="always")
def _two_sums(x0, x1, u0, u1, v0, v1, scale, kind, form):
    """Sums of ρ'(t)/t · (x0 − x1)(v0 − v1) and ρ'(t)/t · (u0 − u1)(v0 − v1)."""
    n = x0.size
    one = form[0] / form[0]
    a = b = one - one
    if kind == 0:
        for j in range(n):
            i = np.uint64(j)
            a += (x0[i] - x1[i]) * (v0[i] - v1[i])
            b += (u0[i] - u1[i]) * (v0[i] - v1[i])
    elif kind == 1:
        reach = scale * form[0]
        for j in range(n):
            i = np.uint64(j)
            t = x0[i] - x1[i]
            c = _simple(abs(t) * reach, one, form) * (v0[i] - v1[i])
            a += c * t
            b += c * (u0[i] - u1[i])
    else:
        for j in range(n):
            i = np.uint64(j)
            t = x0[i] - x1[i]
            c = _general(abs(t * scale) * form[0], form) * (v0[i] - v1[i])
            a += c * t
            b += c * (u0[i] - u1[i])
    return a, b


@njit(inline="always")
def _curvatures(x0, x1, scale, factor, kind, form, out):
    """out = factor · ρ'(t)/t for every voxel of a row, t = scale · |x0 − x1|; x0, x1
    ``(channels, n)``."""
    n = out.size
    if kind == 0:
        out[:] = factor
        return
    out[:] = 0
    for c in range(x0.shape[0]):
        a, b = x0[c], x1[c]
        for j in range(n):
            i = np.uint64(j)
            d = a[i] - b[i]
            out[i] += d * d
    if kind == 1:
        reach = scale * form[0]
        for j in range(n):
            i = np.uint64(j)
            out[i] = _simple(np.sqrt(out[i]) * reach, factor, form)
    else:
        for j in range(n):
            i = np.uint64(j)
            out[i] = factor * _general(np.sqrt(out[i]) * scale * form[0], form)


@njit(**_VIEWS_ONLY)
def _majorize(begin, end, x, v, steps, scales, factors, kind, form, out, work):
    _, channels, nz, ny, nx = x.shape
    for row in range(begin, end):
        n, z, y = row // (nz * ny), (row // ny) % nz, row % ny
        for c in range(channels):
            out[n, c, z, y, :] = 0
        for k in range(steps.shape[0]):
            z1, y1, dx = z + steps[k, 0], y + steps[k, 1], steps[k, 2]
            if z1 < 0 or z1 >= nz or y1 < 0 or y1 >= ny:
                continue
            low, high = max(0, -dx), nx - max(0, dx)
            if channels == 1:
                _add_pull(
                    x[n, 0, z, y, low:high],
                    x[n, 0, z1, y1, low + dx : high + dx],
                    v[n, 0, z, y, low:high],
                    v[n, 0, z1, y1, low + dx : high + dx],
                    scales[k],
                    factors[k],
                    kind,
                    form,
                    out[n, 0, z, y, low:high],
                )
                continue
            w = work[low:high]
            _curvatures(
                x[n, :, z, y, low:high],
                x[n, :, z1, y1, low + dx : high + dx],
                scales[k],
                factors[k],
                kind,
                form,
                w,
            )
            for c in range(channels):
                v0, v1, to = (
                    v[n, c, z, y, low:high],
                    v[n, c, z1, y1, low + dx : high + dx],
                    out[n, c, z, y, low:high],
                )
                for j in range(high - low):
                    i = np.uint64(j)
                    to[i] += w[i] * (v0[i] - v1[i])


@njit(nogil=True, cache=True, fastmath=_FLAGS, error_model="numpy")
def majorize(begin, end, x, v, steps, scales, factors, kind, form, out):
    """out = Σ_neighbours factor · ρ'(t)/t · (v_j − v_k); t = scale · length of x_j − x_k over the
    channels.

    Args:
        x, v: ``(batch, channels, nz, ny, nx)`` contiguous.
        steps: ``(neighbours, 3)`` int64, ALL neighbours (both signs).
        scales, factors: ``(neighbours,)`` in the dtype of x: 1 / (mu_per_hu d) and λ V ω /
            (mu_per_hu d)².
        kind: 0 quadratic, 1 p = 2 and q = 1 (no powers), 2 general.
        form: ``(5,)`` in the dtype of x: 1 / T, p − q, q / p, p − 2, ε / T.
        out: like x.
    """
    _majorize(
        begin, end, x, v, steps, scales, factors, kind, form, out, np.empty(x.shape[-1], x.dtype)
    )


@njit(**_VIEWS_ONLY)
def _along(begin, end, x, u, v, steps, scales, factors, kind, form, out, work):
    _, channels, nz, ny, nx = x.shape
    one = form[0] / form[0]
    for row in range(begin, end):
        n, z, y = row // (nz * ny), (row // ny) % nz, row % ny
        first = second = 0.0
        for k in range(steps.shape[0]):
            z1, y1, dx = z + steps[k, 0], y + steps[k, 1], steps[k, 2]
            if z1 < 0 or z1 >= nz or y1 < 0 or y1 >= ny:
                continue
            low, high = max(0, -dx), nx - max(0, dx)
            if channels == 1:
                a, b = _two_sums(
                    x[n, 0, z, y, low:high],
                    x[n, 0, z1, y1, low + dx : high + dx],
                    u[n, 0, z, y, low:high],
                    u[n, 0, z1, y1, low + dx : high + dx],
                    v[n, 0, z, y, low:high],
                    v[n, 0, z1, y1, low + dx : high + dx],
                    scales[k],
                    kind,
                    form,
                )
                first += factors[k] * a
                second += factors[k] * b
                continue
            w = work[low:high]
            _curvatures(
                x[n, :, z, y, low:high],
                x[n, :, z1, y1, low + dx : high + dx],
                scales[k],
                factors[k],
                kind,
                form,
                w,
            )
            for c in range(channels):
                x0, x1 = x[n, c, z, y, low:high], x[n, c, z1, y1, low + dx : high + dx]
                u0, u1 = u[n, c, z, y, low:high], u[n, c, z1, y1, low + dx : high + dx]
                v0, v1 = v[n, c, z, y, low:high], v[n, c, z1, y1, low + dx : high + dx]
                a = b = one - one
                for j in range(high - low):
                    i = np.uint64(j)
                    pull = w[i] * (v0[i] - v1[i])
                    a += pull * (x0[i] - x1[i])
                    b += pull * (u0[i] - u1[i])
                first += a
                second += b
        out[n, z, y, 0] = first
        out[n, z, y, 1] = second


@njit(nogil=True, cache=True, fastmath=_FLAGS, error_model="numpy")
def along(begin, end, x, u, v, steps, scales, factors, kind, form, out):
    """Row sums of the two inner products ⟨v, M(x) x⟩ and ⟨v, M(x) u⟩, M the matrix of
    :func:`majorize`.

    Args:
        steps, scales, factors: HALF of the neighbours.
        out: ``(batch, nz, ny, 2)`` float64.
        x, u, v, kind, form: as in :func:`majorize`.
    """
    _along(
        begin, end, x, u, v, steps, scales, factors, kind, form, out, np.empty(x.shape[-1], x.dtype)
    )
