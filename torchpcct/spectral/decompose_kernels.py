"""Numba kernels of the projection-domain decomposition. All arithmetic is float64.

Notation of one ray, bin i: expected counts λ_i(a) = s Σ_E S_i(E) exp(−a₁ μ₁(E) − a₂ μ₂(E));
subscripts of λ are derivatives by a. ``m[i]`` holds λ, λ₁, λ₂, λ₁₁, λ₁₂, λ₂₂.

Newton's method on the score U = Σ (n*_i − λ_i) ∂λ_i / λ_i, where n* = n, or n plus the
pseudo-counts c_i = ½ tr(F⁻¹ ∂²λ_i) that remove the bias of order 1 / counts (Firth 1993; this form
follows from Cox and Snell's bias of a curved Poisson model). F = Σ ∂λ_i ∂λ_iᵀ / λ_i is the Fisher
information.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from torchpcct.typing import Floats, Ints, Reals

# exp(x) = 2^k exp(r): one loop without branches or calls, which LLVM turns into vector instructions
# (numba calls the scalar libm otherwise: 4 times slower).
_LOG2E = 1.0 / math.log(2.0)
"""1 / ln 2, so that x / ln 2 rounds to k."""
_MAGIC = 1.5 * 2.0**52
"""Added to a number below 2^51, it leaves the nearest whole number in the low bits of the sum."""
_LN2_HIGH = 6.93147180369123816490e-01
"""ln 2 in so few bits that k times it is exact (Cody and Waite, Software Manual for the Elementary
Functions, 1980)."""
_LN2_LOW = 1.90821492927058770002e-10
"""The rest of ln 2."""
_C2, _C3, _C4, _C5, _C6, _C7, _C8, _C9, _C10, _C11 = (1.0 / math.factorial(k) for k in range(2, 12))

_LOWEST = -300.0
"""Least exponent: neither counts nor their products overflow; only passing iterates get there."""
_HIGHEST = 200.0
"""Largest exponent, for the same reason."""

_PATIENCE = 40
"""After so many steps they are halved, after twice as many quartered, …"""

_SUM = {"reassoc", "contract", "nsz"}
"""What LLVM may change in sums: their order, and products and sums as one operation."""


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _transmissions(a1: float, a2: float, mu: Floats, v: Floats) -> None:
    for e in range(mu.shape[1]):
        mu1, mu2 = mu[0, e], mu[1, e]
        x = min(max(-(a1 * mu1 + a2 * mu2), _LOWEST), _HIGHEST)
        t = x * _LOG2E + _MAGIC
        k = t - _MAGIC
        r = (x - k * _LN2_HIGH) - k * _LN2_LOW
        p = _C8 + r * (_C9 + r * (_C10 + r * _C11))
        p = 1.0 + r * (
            1.0 + r * (_C2 + r * (_C3 + r * (_C4 + r * (_C5 + r * (_C6 + r * (_C7 + r * p))))))
        )
        w = np.int64(
            np.float64(p).view(np.int64) + (np.float64(t).view(np.int64) << np.int64(52))
        ).view(np.float64)
        w1, w2 = -w * mu1, -w * mu2
        v[0, e] = w
        v[1, e] = w1
        v[2, e] = w2
        v[3, e] = -w1 * mu1
        v[4, e] = -w1 * mu2
        v[5, e] = -w2 * mu2


@njit(cache=True, error_model="numpy", fastmath=_SUM)
def _moments(spectra: Floats, v: Floats, scale: float, m: Floats) -> None:
    for b in range(spectra.shape[0]):
        s0 = s1 = s2 = s3 = s4 = s5 = 0.0
        for e in range(spectra.shape[1]):
            s = spectra[b, e]
            s0 += s * v[0, e]
            s1 += s * v[1, e]
            s2 += s * v[2, e]
            s3 += s * v[3, e]
            s4 += s * v[4, e]
            s5 += s * v[5, e]
        m[b, 0] = max(scale * s0, 1e-250)
        m[b, 1] = scale * s1
        m[b, 2] = scale * s2
        m[b, 3] = scale * s3
        m[b, 4] = scale * s4
        m[b, 5] = scale * s5


@njit(cache=True, error_model="numpy")
def _information(m: Floats) -> tuple[float, float, float]:
    f11 = f12 = f22 = 0.0
    for b in range(m.shape[0]):
        inverse = 1.0 / m[b, 0]
        f11 += m[b, 1] * m[b, 1] * inverse
        f12 += m[b, 1] * m[b, 2] * inverse
        f22 += m[b, 2] * m[b, 2] * inverse
    return f11, f12, f22


@njit(cache=True, error_model="numpy")
def _newton(
    n: Floats, m: Floats, reduce_bias: bool
) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Score, Fisher information and the (observed, if positive definite) information that scales
    the step."""
    f11, f12, f22 = _information(m)
    # Where all detected photons have nearly one energy, the two materials cannot be distinguished.
    det = max(f11 * f22 - f12 * f12, 1e-13 * f11 * f22)
    g11, g12, g22 = f22 / det, -f12 / det, f11 / det
    u1 = u2 = o11 = o12 = o22 = 0.0
    for b in range(m.shape[0]):
        inverse = 1.0 / m[b, 0]
        excess = n[b] - m[b, 0]
        if reduce_bias:
            excess += 0.5 * (g11 * m[b, 3] + 2.0 * g12 * m[b, 4] + g22 * m[b, 5])
        r = excess * inverse
        l1, l2 = m[b, 1] * inverse, m[b, 2] * inverse
        u1 += excess * l1
        u2 += excess * l2
        o11 += r * (m[b, 3] - m[b, 1] * l1)
        o12 += r * (m[b, 4] - m[b, 1] * l2)
        o22 += r * (m[b, 5] - m[b, 2] * l2)
    j11, j12, j22 = f11 - o11, f12 - o12, f22 - o22
    if not (j11 > 0.0 and j22 > 0.0 and j11 * j22 - j12 * j12 > 0.1 * det):
        j11, j12, j22 = f11, f12, f22
    merit = g11 * u1 * u1 + 2.0 * g12 * u1 * u2 + g22 * u2 * u2
    return u1, u2, f11, f12, f22, j11, j12, j22, merit


@njit(cache=True, error_model="numpy")
def _direction(
    u1: float, u2: float, j11: float, j12: float, j22: float, held1: bool, held2: bool
) -> tuple[float, float]:
    if held1 and held2:
        return 0.0, 0.0
    if held1:
        return 0.0, u2 / j22
    if held2:
        return u1 / j11, 0.0
    det = max(j11 * j22 - j12 * j12, 1e-13 * j11 * j22)
    return (j22 * u1 - j12 * u2) / det, (j11 * u2 - j12 * u1) / det


@njit(cache=True, error_model="numpy")
def _iterate(
    n: Floats,
    scale: float,
    mu: Floats,
    spectra: Floats,
    v: Floats,
    m: Floats,
    a1: float,
    a2: float,
    bounds: Floats,
    reach: Floats,
    reduce_bias: bool,
    tolerance: float,
    limit: int,
) -> tuple[float, float, float, float, float, int]:
    """Damped Newton steps from (a1, a2) inside the box ``bounds``; ends after a step shorter
    than ``tolerance`` SDs."""
    f11 = f12 = f22 = 0.0
    d1 = d2 = 0.0
    best = math.inf
    halvings = 0
    for k in range(limit):
        _transmissions(a1, a2, mu, v)
        _moments(spectra, v, scale, m)
        u1, u2, f11, f12, f22, j11, j12, j22, merit = _newton(n, m, reduce_bias)
        held1 = (a1 <= bounds[0, 0] and u1 < 0.0) or (a1 >= bounds[0, 1] and u1 > 0.0)
        held2 = (a2 <= bounds[1, 0] and u2 < 0.0) or (a2 >= bounds[1, 1] and u2 > 0.0)
        if not merit <= 2.0 * best and halvings < 6 and not (held1 or held2):
            # Overshot: back by half the step. A little growth is no failure, as the metric F
            # changes on the way.
            halvings += 1
            d1, d2 = 0.5 * d1, 0.5 * d2
            a1, a2 = a1 - d1, a2 - d2
            continue
        best, halvings = merit, 0
        d1, d2 = _direction(u1, u2, j11, j12, j22, held1, held2)
        longest = max(abs(d1) / reach[0], abs(d2) / reach[1])
        if longest > 1.0:
            d1, d2 = d1 / longest, d2 / longest
        # A few starved rays jump back and forth about the solution: shorten their steps more and
        # more.
        shorter = 2.0 ** (k // _PATIENCE)
        d1, d2 = d1 / shorter, d2 / shorter
        b1 = min(max(a1 + d1, bounds[0, 0]), bounds[0, 1])
        b2 = min(max(a2 + d2, bounds[1, 0]), bounds[1, 1])
        d1, d2 = b1 - a1, b2 - a2
        a1, a2 = b1, b2
        if (
            d1 * d1 * f11 + 2.0 * d1 * d2 * f12 + d2 * d2 * f22
        ) * shorter * shorter <= tolerance * tolerance:
            return a1, a2, f11, f12, f22, k + 1
    return a1, a2, f11, f12, f22, -1


@njit(nogil=True, cache=True, error_model="numpy")
def solve(
    begin: int,
    end: int,
    counts: Reals,
    column: Ints,
    scale: Floats,
    mu: Floats,
    spectra: Floats,
    coarse_mu: Floats,
    coarse_spectra: Floats,
    air: Floats,
    start_step: Floats,
    start: Floats,
    direction: Floats,
    bounds: Floats,
    reach: Floats,
    reduce_bias: bool,
    coarse_tolerance: float,
    tolerance: float,
    limit: int,
    out: Reals,
    information: Reals,
    steps: NDArray[np.int32],
) -> None:
    """Estimates for ``counts`` (bins, rays); see :func:`torchpcct.spectral.decompose.decompose`.

    ``start`` (columns, nodes) tabulates the path along ``direction`` over the line integral ln(air
    / Σ counts), in steps of ``start_step`` (columns,) from 0. ``steps``: number of Newton steps
    with the full spectra, −1 at the limit.
    """
    bins = counts.shape[0]
    v = np.empty((6, mu.shape[1]))
    group_v = np.empty((6, coarse_mu.shape[1]))
    m = np.empty((bins, 6))
    n = np.empty(bins)
    for i in range(begin, end):
        c = column[i]
        s = scale[i]
        total = 0.0
        for b in range(bins):
            n[b] = counts[b, i]
            total += n[b]
        p = (math.log(air[c] * s) - math.log(total + 0.5)) / start_step[c]
        # NaN, too, of spectra that nothing attenuates
        p = min(p, start.shape[1] - 1.0) if p > 0.0 else 0.0
        k = min(int(p), start.shape[1] - 2)
        t = start[c, k] + (p - k) * (start[c, k + 1] - start[c, k])
        a1 = min(max(t * direction[0], bounds[0, 0]), bounds[0, 1])
        a2 = min(max(t * direction[1], bounds[1, 0]), bounds[1, 1])
        # A few energies bring the estimate near, at a fraction of the cost; the full spectra then
        # decide.
        a1, a2, _, _, _, _ = _iterate(
            n,
            s,
            coarse_mu,
            coarse_spectra[c],
            group_v,
            m,
            a1,
            a2,
            bounds,
            reach,
            reduce_bias,
            coarse_tolerance,
            12,
        )
        a1, a2, f11, f12, f22, count = _iterate(
            n, s, mu, spectra[c], v, m, a1, a2, bounds, reach, reduce_bias, tolerance, limit
        )
        out[0, i] = a1
        out[1, i] = a2
        information[0, i] = f11
        information[1, i] = f12
        information[2, i] = f22
        steps[i] = count


@njit(nogil=True, cache=True, error_model="numpy")
def expected(
    begin: int,
    end: int,
    line_integrals: Floats,
    column: Ints,
    scale: Floats,
    mu: Floats,
    spectra: Floats,
    counts: Reals,
    slopes: Floats,
) -> None:
    """λ into ``counts`` (bins, rays); λ₁, λ₂, λ₁₁, λ₁₂, λ₂₂ into ``slopes`` (5, bins, rays)."""
    bins = counts.shape[0]
    v = np.empty((6, mu.shape[1]))
    m = np.empty((bins, 6))
    for i in range(begin, end):
        _transmissions(line_integrals[0, i], line_integrals[1, i], mu, v)
        _moments(spectra[column[i]], v, scale[i], m)
        for b in range(bins):
            counts[b, i] = m[b, 0]
            for k in range(5):
                slopes[k, b, i] = m[b, 1 + k]
