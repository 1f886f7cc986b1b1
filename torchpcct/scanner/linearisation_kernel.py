"""The water correction of whole scans in one pass over memory."""

from __future__ import annotations

from typing import Any

from numba import njit

__all__ = ["evaluate"]


@njit(nogil=True, cache=True)
def evaluate(
    begin: int, end: int, p: Any, first_column: Any, coefficients: Any, scale: Any, slope: bool, out: Any
) -> None:
    """Corrected line integrals (or the slope of the correction) of ``(lines, columns)`` readings.

    Line i starts at detector column ``first_column[i % first_column.size]``. Inside 0 … scale a polynomial, beyond
    both ends straight on.
    """
    order = coefficients.shape[1]
    for i in range(begin, end):
        start = first_column[i % first_column.size]
        for j in range(p.shape[1]):
            c = start + j
            value = 0.0
            derivative = 0.0
            q = float(p[i, j])
            x = min(max(q / scale[c], 0.0), 1.0)
            for k in range(order - 1, -1, -1):
                derivative = derivative * x + value
                value = value * x + coefficients[c, k]
            local = value + x * derivative  # d(mu_ref t) / dp at the clamped p
            if slope:
                out[i, j] = local + 0.0 * q  # NaN stays NaN
            else:
                out[i, j] = scale[c] * x * value + (q - scale[c] * x) * local
