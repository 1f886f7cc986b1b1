"""Estimates with 95 % intervals as JSON values: ``value``, ``low`` and ``high``, and ``why`` where there is none."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchpcct.metrics import cnr, cnr_interval, mean_interval

__all__ = ["attempt", "estimate", "mean_of", "none", "paper_cnr"]

Floats = NDArray[np.float64]


def estimate(value: Any) -> dict[str, float | None]:
    """Of value, low and high; what is not finite is None."""
    v, low, high = (float(x) for x in (value[0], value[1], value[2]))
    return {k: (x if math.isfinite(x) else None) for k, x in (("value", v), ("low", low), ("high", high))}


def none(why: str) -> dict[str, Any]:
    """No figure, and the reason."""
    return {"value": None, "low": None, "high": None, "why": why}


def attempt(compute: Callable[[], Any]) -> Any:
    """The figure, or why there is none."""
    try:
        return compute()
    except ValueError as error:
        return none(str(error))


def mean_of(values: Floats) -> dict[str, float | None]:
    """Mean of a sample."""
    return estimate((values.mean(), *mean_interval(values)))


def paper_cnr(roi: Floats) -> dict[str, float | None]:
    """The paper's CNR of ROI means ``(n, 2)``: core, fibrous."""
    return estimate((cnr(roi[:, 0], roi[:, 1]), *cnr_interval(roi[:, 0], roi[:, 1])))
