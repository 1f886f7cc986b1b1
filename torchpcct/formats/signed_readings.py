"""Readings of detectors that were stored as signed integers."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np


def unwrapped(arrays: Mapping[str, Any], what: str) -> dict[str, Any]:
    """Readings of a scan, those that were stored as signed integers though a detector counts from 0
    read as unsigned.

    A camera's 16 bits reach 65535; stored as int16, what exceeds 32767 comes out far below 0. A few
    counts below 0, of readings whose dark was taken off, stay.

    Args:
        arrays: of one scan, by name.
        what: they are of, for the warning.
    """
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
            stacklevel=2,
        )
        return {**arrays, **{k: signed[k].view(f"u{values.dtype.itemsize}") for k in same}}
    return dict(arrays)
