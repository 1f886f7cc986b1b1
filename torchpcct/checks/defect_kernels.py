"""CPU kernels of the search for defects: sums over the views of what each detector cell has
read."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

RATIOS = 8
"""Ratios of readings that are multiplied before the logarithm is taken of all: the largest, of 1e15
to 0.5, leave the product far from what a double can hold."""


@njit(nogil=True, cache=True)
def levels(begin, end, counts, first, views, dark, bright):
    """Add to every cell how often it read 0, and its counts.

    Args:
        counts: ``(views, rows, columns)``.
        first: ``(views,)`` int64 detector column of the first reading.
        views: int64 indices of the views that count.
        dark, bright: ``(rows, detector columns)`` float64.
    """
    columns = counts.shape[2]
    for r in range(begin, end):
        for v in views:
            row, zeros, total = counts[v, r], dark[r, first[v] :], bright[r, first[v] :]
            for c in range(columns):
                zeros[c] += row[c] <= 0
            for c in range(columns):
                total[c] += row[c]


@njit(nogil=True, cache=True, error_model="numpy")
def bends(begin, end, counts, first, views, dead, above, times):
    """Add how far the log of every cell lies above the mean of its neighbours', and how often all
    three were good.

    Args:
        counts, first, views: as in :func:`levels`.
        dead: ``(rows, detector columns)`` bool, cells to leave out.
        above, times: ``(rows, detector columns)`` float64.
    """
    columns, width = counts.shape[2], dead.shape[1]
    # In place of three logarithms a reading one of the product of a few ratios, n² over that of
    # the neighbours.
    product, usable = np.empty(width), np.empty(width, dtype=np.bool_)
    for r in range(begin, end):
        product[:] = 1.0
        usable[0] = usable[width - 1] = False
        for c in range(1, width - 1):
            usable[c] = not (dead[r, c - 1] or dead[r, c] or dead[r, c + 1])
        low, high = width, 0
        for k in range(views.size):
            at = first[views[k]]
            row, good, ratio, count = (
                counts[views[k], r],
                usable[at:],
                product[at:],
                times[r, at:],
            )
            for c in range(1, columns - 1):
                left, n, right = row[c - 1], row[c], row[c + 1]
                lit = (left > 0) & (n > 0) & (right > 0) & good[c]
                twice = np.float64(n) + 0.5
                beside = (np.float64(left) + 0.5) * (np.float64(right) + 0.5)
                ratio[c] *= twice * twice / beside if lit else 1.0
                count[c] += 1.0 if lit else 0.0
            low, high = min(low, at), max(high, at + columns)
            if k % RATIOS == RATIOS - 1 or k == views.size - 1:
                for c in range(low, high):
                    above[r, c] += 0.5 * math.log(product[c])
                    product[c] = 1.0
                low, high = width, 0
