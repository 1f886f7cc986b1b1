"""What is believed of a vessel before the data."""

from __future__ import annotations

from dataclasses import dataclass

from torchpcct.validate import number, numbers, whole

__all__ = ["VesselPrior"]

MOST_ORDERS = 4
"""Fourier orders of a section: 1 moves it, 2 makes it an ellipse, 3 an egg; a flat ellipse needs
4."""


@dataclass(frozen=True)
class VesselPrior:
    """Values of wall and fibrous tissue, and how free the outlines are.

    A wall is about one voxel thick, and its value trades with its thickness; values of fibrous
    tissue and core trade with the core's size and the outlines: a prior as wide as the tissues' own
    variety keeps them from what no tissue is. Fibrous plaque has 91 ± 21 HU (Schroeder et al. 2001,
    J. Am. Coll. Cardiol. 37, 1430), unenhanced muscle 50 to 60 HU. An enhanced wall wants another
    value.

    Args:
        wall: mean and standard deviation, HU.
        fibrous: the same.
        orders: Fourier orders of lumen and outer outline, 2 to 4: the more, the flatter the
            ellipses they can be, and the less the data say of what lies between them.
        shift: standard deviation of what both differ by from their means together, HU; 0: the
            scanner is calibrated. MBIR draws outlines with 200, so that it does not matter to them
            where the scanner's zero lies.
        freedom: how far sections may move and leave a circle, relative to arteries at large of the
            same size. With 0.4 outlines are rounder: less error, and more contrast read where there
            is no core (``train/experiments.md``).

    Raises:
        ValueError: a value that is not finite, a standard deviation or freedom that is not
            positive, a negative shift, orders out of range.
        TypeError: values of the wrong kind.
    """

    wall: tuple[float, float] = (50.0, 15.0)
    fibrous: tuple[float, float] = (95.0, 25.0)
    orders: int = 3
    shift: float = 0.0
    freedom: float = 1.0

    def __post_init__(self) -> None:
        for name in ("wall", "fibrous"):
            mean, sd = numbers(name, getattr(self, name), 2, unit="HU")
            number(f"standard deviation of {name}", sd, positive=True, unit="HU")
            object.__setattr__(self, name, (mean, sd))
        object.__setattr__(self, "shift", number("shift", self.shift, low=0.0, unit="HU"))
        object.__setattr__(self, "freedom", number("freedom", self.freedom, positive=True))
        number("orders", whole("orders", self.orders, 2), high=MOST_ORDERS)
