"""CPU kernels of the search for defects: sums over the views of what each detector cell has
read."""

from __future__ import annotations

import math

import numpy as np
from numba import njit


@njit(nogil=True, cache=True)
def levels(begin, end, counts, first, views, seen, dark, bright):
    """Add to every cell how often it was read, how often it read 0, and its counts.

    Args:
        counts: ``(views, rows, columns)``.
        first: ``(views,)`` int64 detector column of the first reading.
        views: int64 indices of the views that count.
        seen, dark, bright: ``(rows, detector columns)`` float64.
    """
    columns = counts.shape[2]
    for r in range(begin, end):
        for v in views:
            at = first[v]
            for c in range(columns):
                n = counts[v, r, c]
                seen[r, at + c] += 1.0
                dark[r, at + c] += n <= 0
                bright[r, at + c] += n


@njit(nogil=True, cache=True)
def bends(begin, end, counts, first, views, dead, above, times):
    """Add how far the log of every cell lies above the mean of its neighbours', and how often all
    three were good.

    Args:
        counts, first, views: as in :func:`levels`.
        dead: ``(rows, detector columns)`` bool, cells to leave out.
        above, times: ``(rows, detector columns)`` float64.
    """
    columns = counts.shape[2]
    for r in range(begin, end):
        log = np.empty(columns)
        for v in views:
            at = first[v]
            for c in range(columns):
                n = counts[v, r, c]
                log[c] = np.nan if n <= 0 or dead[r, at + c] else math.log(n + np.float32(0.5))
            for c in range(1, columns - 1):
                bend = log[c] - (log[c - 1] + log[c + 1]) / 2
                if bend == bend:
                    above[r, at + c] += bend
                    times[r, at + c] += 1.0
