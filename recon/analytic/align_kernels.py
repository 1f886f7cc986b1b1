"""Numba kernels that weight detector rows and move them into a frame that is common to all
views."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

_OPTIONS: Any = {"nogil": True, "cache": True, "error_model": "numpy"}


@njit(**_OPTIONS)
def align(begin, end, data, angular, cosine, first, offset, out):
    """``out[v, r, offset[v] + i] = angular · cosine · data[v, r, i]``, zero elsewhere.

    ``angular (V, 1 or columns)`` and ``cosine (R, columns)`` refer to detector columns, ``first[v]
    + i``.
    """
    _, rows, width = data.shape
    length = out.shape[2]
    for v in range(begin, end):
        low, start = offset[v], first[v]
        for r in range(rows):
            source, target, weights = data[v, r], out[v, r], cosine[r, start : start + width]
            for i in range(low):
                target[i] = 0
            for i in range(low + width, length):
                target[i] = 0
            part = target[low : low + width]
            if angular.shape[1] == 1:
                factor = angular[v, 0]
                for i in range(width):
                    part[i] = factor * weights[i] * source[i]
            else:
                factors = angular[v, start : start + width]
                for i in range(width):
                    part[i] = factors[i] * weights[i] * source[i]


@njit(**_OPTIONS)
def unalign(begin, end, aligned, angular, cosine, first, offset, out):
    """Transpose of :func:`align`, added to ``out (V, R, width)``."""
    _, rows, width = out.shape
    for v in range(begin, end):
        low, start = np.uint64(offset[v]), np.uint64(first[v])
        for r in range(rows):
            for i in range(width):
                c = start + np.uint64(i)
                factor = angular[v, 0] if angular.shape[1] == 1 else angular[v, c]
                out[v, r, i] += factor * cosine[r, c] * aligned[v, r, low + np.uint64(i)]
