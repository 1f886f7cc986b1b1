"""Metal in a volume: nothing here corrects what it does to the tissue beside it, so that a
warning names it."""

from __future__ import annotations

from torch import Tensor

from torchpcct.readings import MEDIAN_TO_SD
from torchpcct.validate import checked

__all__ = ["metal_warnings"]

DENSEST_HU = 3000.0
"""Enamel, the densest tissue. Titanium reads 16 000 HU."""
_SIGMAS = 6.0


@checked
def metal_warnings(volume: Tensor) -> list[str]:
    """Whether a volume in HU reads more than tissue can, and more than its noise explains.

    Args:
        volume: any shape, HU. Its noise is taken from the median deviation from the median: where
            most of it is one tissue that is the noise, else more, and metal has to be denser to be
            noticed.

    Returns:
        Warnings; empty if there is no metal.
    """
    peak, middle = float(volume.max()), volume.median()
    noise = MEDIAN_TO_SD * float((volume - middle).abs().median())
    if not peak > DENSEST_HU + _SIGMAS * noise:
        return []
    return [
        f"the volume reaches {peak:.0f} HU, more than any tissue: metal hardens the beam and "
        "starves the rays behind it; streaks and shades beside it are no tissue, and are not "
        "corrected"
    ]
