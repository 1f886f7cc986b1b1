"""CPU kernels of the Gram operator: Hermitian banded matrices along z, one per in-plane frequency.

:func:`torchpcct.threads.run` calls them on ``begin … end`` of the rows of frequencies, or
frequencies, or ``todo``.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

_VIEWS_ONLY: Any = {
    "nogil": True,
    "cache": True,
    "fastmath": {"contract", "reassoc", "nsz"},
    "_nrt": False,
}
"""It allocates nothing, and needs no reference counts."""


@njit(**_VIEWS_ONLY)
def banded_add(begin, end, kernel, x, scale, out):
    """out += scale · K x for every frequency of the rows ``begin … end`` along y.

    Real and imaginary parts stand side by side: a complex product with the scale would take twice
    the operations.

    Args:
        kernel: ``(reach + 1, nz, fy, 2 · fx)`` lower bands; the main diagonal is real.
        x, out: ``(batch, nz, fy, 2 · fx)``, contiguous.
        scale: in the precision of x.
    """
    bands, nz, _, parts = kernel.shape
    fx = parts // 2
    for n in range(x.shape[0]):
        # Slice by slice, as they lie in memory: along z each row would be on another page.
        for z in range(nz):
            for y in range(begin, end):
                to, here, diagonal = out[n, z, y], x[n, z, y], kernel[0, z, y]
                for i in range(fx):
                    to[2 * i] += scale * diagonal[2 * i] * here[2 * i]
                    to[2 * i + 1] += scale * diagonal[2 * i] * here[2 * i + 1]
                for b in range(1, bands):
                    if z >= b:
                        lower, below = kernel[b, z - b, y], x[n, z - b, y]
                        for i in range(fx):
                            re, im = scale * lower[2 * i], scale * lower[2 * i + 1]
                            to[2 * i] += re * below[2 * i] - im * below[2 * i + 1]
                            to[2 * i + 1] += re * below[2 * i + 1] + im * below[2 * i]
                    if z + b < nz:
                        upper, above = kernel[b, z, y], x[n, z + b, y]
                        for i in range(fx):
                            re, im = scale * upper[2 * i], scale * upper[2 * i + 1]
                            to[2 * i] += re * above[2 * i] + im * above[2 * i + 1]
                            to[2 * i + 1] += re * above[2 * i + 1] - im * above[2 * i]


@njit(inline="always")
def _first_failure(matrix, least, lower):
    """Slice at which the banded Cholesky factorisation meets a pivot ≤ least · diagonal; −1 if
    none."""
    bands, nz = matrix.shape
    for j in range(nz):
        inverse = 0.0
        for b in range(min(bands, nz - j)):
            # Real and imaginary parts by themselves: numba divides by a complex number.
            re, im = matrix[b, j].real, matrix[b, j].imag
            for i in range(max(0, j + b - bands + 1), j):
                here, own = lower[j + b - i, i], lower[j - i, i]
                re -= here.real * own.real + here.imag * own.imag
                im -= here.imag * own.real - here.real * own.imag
            if b == 0:
                diagonal = matrix[0, j].real
                if not (diagonal > 0.0 and re > least * diagonal):
                    return j
                root = math.sqrt(re)
                inverse = 1.0 / root
                lower[0, j] = root
            else:
                lower[b, j] = complex(re * inverse, im * inverse)
    return -1


@njit(nogil=True, cache=True)
def banded_cholesky(begin, end, kernel, least, lower, definite):
    """L with L Lᴴ = K for every frequency, and whether K is positive definite there.

    Args:
        kernel: ``(reach + 1, nz, frequencies)`` complex128 lower bands.
        least: smallest pivot that counts as positive, as a share of the main diagonal.
        lower: like kernel; filled up to the first pivot that fails.
        definite: ``(frequencies,)`` bool.
    """
    for f in range(begin, end):
        definite[f] = _first_failure(kernel[:, :, f], least, lower[:, :, f]) < 0


@njit(nogil=True, cache=True)
def stiffen(begin, end, terms, points, least, step, most, definite):
    """Tie neighbouring slices together, just where and as much as the matrices Σ_c points[k, c]
    terms[c] need it.

    Args:
        terms: ``(terms, reach + 1, nz, frequencies)`` complex128 lower bands; ``terms[0]`` is
            changed in place.
        points: ``(points, terms)``.
        least: smallest pivot, as a share of the diagonal.
        step: stiffness added at a time, as a share of the mean diagonal.
        most: largest number of additions per frequency.
        definite: ``(frequencies,)`` bool, whether it succeeded.
    """
    count, bands, nz, _ = terms.shape
    own = np.empty((count, bands, nz), dtype=np.complex128)
    matrix = np.empty((bands, nz), dtype=np.complex128)
    lower = np.empty((bands, nz), dtype=np.complex128)
    for f in range(begin, end):
        # A copy in one place: in memory the bands of a frequency lie a whole slice apart.
        for c in range(count):
            for b in range(bands):
                for z in range(nz):
                    own[c, b, z] = terms[c, b, z, f]
        level = 0.0
        for z in range(nz):
            level += abs(own[0, 0, z].real) / nz
        added = 0
        good = True
        k = 0
        passed = 0
        while passed < points.shape[0]:
            for b in range(bands):
                for z in range(nz):
                    value = own[0, b, z]
                    for c in range(1, count):
                        value += points[k, c] * own[c, b, z]
                    matrix[b, z] = value
            j = _first_failure(matrix, least, lower)
            if j < 0:
                passed += 1
                k = (k + 1) % points.shape[0]
                continue
            passed = 0
            if added >= most or bands < 2 or nz < 2:
                good = False
                break
            added += 1
            upper = max(j, 1)
            # Larger doses where many were needed.
            stiffness = step * level * (1.0 + 0.05 * added)
            own[0, 0, upper] += stiffness
            own[0, 0, upper - 1] += stiffness
            own[0, 1, upper - 1] -= stiffness
        definite[f] = good
        if added:
            for b in range(bands):
                for z in range(nz):
                    terms[0, b, z, f] = own[0, b, z]


@njit(nogil=True, cache=True)
def damp(begin, end, terms, points, least, kept, shifts, level, lowest, todo):
    """Damp position-dependent terms, then shift the diagonal, until all Σ_c points[k, c] terms[c]
    are definite.

    Args:
        terms, points, least: as in :func:`stiffen`; changed in place at the frequencies ``todo``.
        kept: shares of the terms but the first that are kept, descending to 0; empty where there is
            but one term.
        shifts: ascending shares of ``level`` that are added to the diagonal of the first term
            alone.
        level: ``(frequencies,)`` mean diagonal.
        lowest: what the diagonal becomes at least where nothing helps.
        todo: indices of frequencies.
    """
    count, bands, nz, _ = terms.shape
    for t in range(begin, end):
        f = todo[t]
        own = np.empty((count, bands, nz), dtype=np.complex128)
        for c in range(count):
            for b in range(bands):
                for z in range(nz):
                    own[c, b, z] = terms[c, b, z, f]
        matrix = np.empty((bands, nz), dtype=np.complex128)
        lower = np.empty((bands, nz), dtype=np.complex128)
        found = False
        keep = 0.0
        shift = 0.0
        for s in range(kept.size + shifts.size):
            keep = kept[s] if s < kept.size else 0.0
            shift = 0.0 if s < kept.size else shifts[s - kept.size] * level[f]
            found = True
            # Without position-dependent terms all points are alike.
            for k in range(points.shape[0] if keep > 0.0 else 1):
                for b in range(bands):
                    for z in range(nz):
                        value = own[0, b, z]
                        for c in range(1, count):
                            value += keep * points[k, c] * own[c, b, z]
                        matrix[b, z] = value
                for z in range(nz):
                    matrix[0, z] += shift
                if _first_failure(matrix, least, lower) >= 0:
                    found = False
                    break
            if found:
                break
        for b in range(bands):
            for z in range(nz):
                for c in range(1, count):
                    terms[c, b, z, f] = keep * own[c, b, z] if found else 0.0
                if not found:
                    terms[0, b, z, f] = 0.0
        for z in range(nz):
            if found:
                terms[0, 0, z, f] += shift
            else:
                terms[0, 0, z, f] = max(level[f], lowest)
