"""Checks of what a caller hands in: each returns the clean value, or raises an error that names value and remedy."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np

__all__ = ["UNITS", "choice", "coverage", "number", "numbers", "per_axis", "whole"]

UNITS = ("HU", "mm^-1", "pixel^-1")
"""Of scans and volumes; of ``pixel^-1`` all lengths are in pixels."""


def number(
    name: str,
    value: Any,
    *,
    positive: bool = False,
    finite: bool = True,
    low: float | None = None,
    high: float | None = None,
    unit: str = "",
) -> float:
    """``value`` as a float.

    Args:
        name: what the message calls it.
        value: anything that ``float`` takes.
        positive: refuse 0 and less.
        finite: refuse infinities; NaN is always refused.
        low, high: closed range.
        unit: for the message.

    Raises:
        TypeError: no number.
        ValueError: NaN, infinite, out of range.
    """
    unit = f" {unit}" if unit else ""
    if isinstance(value, complex):
        raise TypeError(f"{name} must be a real number{unit and ' in' + unit}, got {value!r}")
    try:
        result = float(value)
    except (TypeError, ValueError):
        raise TypeError(
            f"{name} must be a number{unit and ' in' + unit}, got {value!r} ({type(value).__name__})"
        ) from None
    if math.isnan(result) or (finite and math.isinf(result)):
        raise ValueError(f"{name} must be {'finite' if finite else 'a number'}, got {value!r}")
    if positive and result <= 0:
        raise ValueError(f"{name} must be greater than 0{unit}, got {result:g}")
    if low is not None and high is not None and not low <= result <= high:
        raise ValueError(f"{name} must lie in [{low:g}, {high:g}]{unit}, got {result:g}")
    if low is not None and result < low:
        raise ValueError(f"{name} must be at least {low:g}{unit}, got {result:g}")
    if high is not None and result > high:
        raise ValueError(f"{name} must be at most {high:g}{unit}, got {result:g}")
    return result


def coverage(name: str, value: Any) -> float:
    """``value`` as the coverage of an interval: a number between 0 and 1, ends excluded.

    Raises:
        TypeError: no number.
        ValueError: outside; the message reminds those who give per cent.
    """
    share = number(name, value)
    if not 0.0 < share < 1.0:
        raise ValueError(f"{name} must lie in (0, 1), got {share:g}: 95 % is 0.95")
    return share


def numbers(name: str, value: Any, count: int | None = None, **limits: Any) -> tuple[float, ...]:
    """``value`` as a tuple of floats, each checked by :func:`number`.

    Args:
        name: what the message calls it.
        value: a sequence or a 1-D array.
        count: how many there must be; None: any number, but not none.
        limits: of :func:`number`.

    Raises:
        TypeError: an entry that is no number.
        ValueError: no sequence, another count, an entry out of range.
    """
    wanted = "one number or more" if count is None else f"{count} numbers"
    if not isinstance(value, Sequence | np.ndarray) or isinstance(value, str | bytes):
        raise ValueError(f"{name} must be {wanted}, got {value!r}")
    if len(value) != count if count is not None else len(value) == 0:
        raise ValueError(f"{name} must be {wanted}, got {value!r}")
    return tuple(number(f"{name}[{i}]", v, **limits) for i, v in enumerate(value))


def per_axis(name: str, value: Any, axes: int, **limits: Any) -> tuple[float, ...]:
    """One number for every axis: a single one is repeated, ``axes`` of them are taken as they are.

    Raises:
        TypeError, ValueError: see :func:`number`; another count.
    """
    if isinstance(value, Sequence | np.ndarray) and not isinstance(value, str):
        if len(value) != axes:
            raise ValueError(f"{name} must be one number or {axes} numbers (one per axis), got {value!r}")
        return numbers(name, value, axes, **limits)
    return (number(name, value, **limits),) * axes


def whole(name: str, value: Any, low: int = 1) -> int:
    """``value`` as an int of at least ``low``; ``True`` and ``3.0`` are refused.

    Raises:
        TypeError: no whole number.
        ValueError: less than ``low``.
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise TypeError(f"{name} must be a whole number, got {value!r} ({type(value).__name__})")
    if value < low:
        raise ValueError(f"{name} must be at least {low}, got {value}")
    return int(value)


def choice(name: str, value: Any, options: Collection[str]) -> str:
    """``value``, if it is one of the options.

    Raises:
        ValueError: it is not; the message lists them.
    """
    if value not in options:
        raise ValueError(f"unknown {name} {value!r}: use one of {', '.join(options)}")
    return str(value)
