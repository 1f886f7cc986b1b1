"""Units of length and angle as files name them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


MM = {
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), 1e3),
    **dict.fromkeys(("cm", "centimeter", "centimeters", "centimetre", "centimetres"), 10.0),
    **dict.fromkeys(("dm", "decimeter", "decimeters", "decimetre", "decimetres"), 100.0),
    **dict.fromkeys(("mm", "millimeter", "millimeters", "millimetre", "millimetres"), 1.0),
    **dict.fromkeys(
        (
            "um",
            "µm",
            "μm",
            "micron",
            "microns",
            "micrometer",
            "micrometers",
            "micrometre",
            "micrometres",
        ),
        1e-3,
    ),
    **dict.fromkeys(("nm", "nanometer", "nanometers", "nanometre", "nanometres"), 1e-6),
    **dict.fromkeys(("å", "angstrom", "angstroms"), 1e-7),
    **dict.fromkeys(("in", "inch", "inches"), 25.4),
}
"""Millimetres of a unit, by its name in small letters."""

RAD = {
    **dict.fromkeys(("deg", "degs", "degree", "degrees", "°"), math.pi / 180.0),
    **dict.fromkeys(("rad", "rads", "radian", "radians"), 1.0),
}
"""Radians of a unit, by its name in small letters."""


def unit_text(value: ArrayLike) -> str:
    """A unit that stands as text, bytes or an array of one of them in a file, in small letters."""
    first = np.ravel(value)[0]
    return (
        (first.decode("utf-8", "replace") if isinstance(first, bytes) else str(first))
        .strip()
        .strip("\0")
        .lower()
    )
