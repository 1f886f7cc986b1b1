"""The water correction of whole scans in one pass over memory."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from torchpcct.typing import Floats, Ints, Reals


@njit(nogil=True, cache=True)
def evaluate(
    begin: int,
    end: int,
    p: Reals,
    first_column: Ints,
    coefficients: Floats,
    scale: Floats,
    slope: bool,
    out: Reals,
) -> None:
    """Corrected line integrals (or the slope of the correction) of ``(lines, columns)`` readings.

    Line i starts at detector column ``first_column[i % first_column.size]``; the ``coefficients``
    are ``(order, columns)``. Inside 0 … scale a polynomial, beyond both ends straight on.
    """
    columns = p.shape[1]
    x, value, local = np.empty(columns), np.empty(columns), np.empty(columns)
    # Term by term over a whole line: what stands side by side in memory is computed at once.
    for i in range(begin, end):
        start = first_column[i % first_column.size]
        beyond = 0
        for j in range(columns):
            at = float(p[i, j]) / scale[start + j]
            beyond += not 0.0 <= at <= 1.0
            x[j] = min(max(at, 0.0), 1.0)
            value[j] = local[j] = 0.0
        if not slope and beyond == 0:
            for k in range(coefficients.shape[0] - 1, -1, -1):
                term = coefficients[k, start : start + columns]
                for j in range(columns):
                    value[j] = value[j] * x[j] + term[j]
            for j in range(columns):
                out[i, j] = float(p[i, j]) * value[j]
            continue
        for k in range(coefficients.shape[0] - 1, -1, -1):
            term = coefficients[k, start : start + columns]
            for j in range(columns):
                local[j] = local[j] * x[j] + value[j]
                value[j] = value[j] * x[j] + term[j]
        for j in range(columns):
            q = float(p[i, j])
            bend = value[j] + x[j] * local[j]  # d(mu_ref t) / dp at the clamped p
            if slope:
                out[i, j] = bend + 0.0 * q  # NaN stays NaN
            else:
                inside = scale[start + j] * x[j]
                out[i, j] = inside * value[j] + (q - inside) * bend
