"""Readings of detectors that were stored as integers."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np

from torchpcct.checks.readings import CLIPPED_SHARE


def as_counted(arrays: Mapping[str, Any], what: str) -> dict[str, Any]:
    """Readings of a scan as the detector has counted them, with warnings about what its integers
    do not hold.

    Readings that were stored as signed integers though a detector counts from 0 are read as
    unsigned: a camera's 16 bits reach 65535; stored as int16, what exceeds 32767 comes out far
    below 0. A few counts below 0, of readings whose dark was taken off, stay.

    Readings at the end of their type are of a detector or a file that is saturated.

    Args:
        arrays: of one scan, by name.
        what: they are of, for the warnings.
    """
    found = _unsigned(arrays, what)
    for name, values in found.items():
        readings = np.asarray(values)
        if readings.dtype.kind not in "iu" or not readings.ndim:
            continue
        top = np.iinfo(readings.dtype).max
        share = np.count_nonzero(readings == top) / max(readings.size, 1)
        if share >= CLIPPED_SHARE:
            warnings.warn(
                f"{what}: {100 * share:.2g} % of {name} are {top}, the most that "
                f"{readings.dtype} holds: the detector or the file is saturated, and what is "
                "brighter reads too low; lower the exposure, or mask those readings by dead=",
                UserWarning,
                stacklevel=2,
            )
    return found


def _unsigned(arrays: Mapping[str, Any], what: str) -> dict[str, Any]:
    signed = {
        k: a
        for k, a in ((k, np.asarray(v)) for k, v in arrays.items())
        if a.dtype.kind == "i" and a.ndim
    }
    for name, values in signed.items():
        bits = 8 * values.dtype.itemsize
        negative = values[values < 0]
        if bits > 16 or 2 * int((negative < -(2 ** (bits - 6))).sum()) <= negative.size:
            continue
        same = [k for k, v in signed.items() if v.dtype == values.dtype]
        warnings.warn(
            f"{what}: {name} of type int{bits} reach down to {int(negative.min())}: they are read "
            f"as uint{bits}, as a detector counts",
            UserWarning,
            stacklevel=3,
        )
        return {**arrays, **{k: signed[k].view(f"u{values.dtype.itemsize}") for k in same}}
    return dict(arrays)
