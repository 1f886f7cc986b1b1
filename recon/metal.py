"""Metal in a volume: nothing here corrects what it does to the tissue beside it, so that a
warning names it."""

from __future__ import annotations

import torch
from torch import Tensor

from torchpcct.readings import MEDIAN_TO_SD
from torchpcct.validate import checked

__all__ = ["metal_warnings"]

DENSEST_HU = 3000.0
"""Enamel, the densest tissue. Titanium reads 16 000 HU."""
_SIGMAS = 6.0
"""Standard deviations of noise above enamel that are none of chance."""
_AIR_HU = -1000.0
"""CT number of air."""
_RINGING = 0.5
"""How far a volume may read below air beside metal, over how far metal reads above air: an edge
undershoots by a fifth at most, streaks of metal are shallower than metal is dense. What rings where
few views see it reads as far below air as above tissue."""
_BESIDE = 7
"""Voxels of the square about metal in which it may."""


@checked
def metal_warnings(volume: Tensor) -> list[str]:
    """Whether a volume in HU reads more than tissue can, and more than its noise explains.

    Args:
        volume: any shape, the last two axes those of a slice, HU. Its noise is taken from the
            median deviation from the median: where most of it is one tissue that is the noise, else
            more, and metal has to be denser to be noticed.

    Returns:
        Warnings; empty if there is no metal.
    """
    middle = volume.median()
    noise = MEDIAN_TO_SD * float((volume - middle).abs().median())
    limit = DENSEST_HU + _SIGMAS * noise
    slices = volume.reshape(-1, *volume.shape[-2:]) if volume.ndim > 1 else volume[None, None]
    peak = max((_densest(s, limit) for s in slices if float(s.max()) > limit), default=limit)
    if not peak > limit:
        return []
    return [
        f"the volume reaches {peak:.0f} HU, more than any tissue: metal hardens the beam and "
        "starves the rays behind it; streaks and shades beside it are no tissue, and are not "
        "corrected"
    ]


def _densest(values: Tensor, limit: float) -> float:
    """The largest value ``(y, x)`` above ``limit`` that is none of ringing, or ``limit``."""
    pooled = torch.nn.functional.max_pool2d(-values[None, None], _BESIDE, 1, _BESIDE // 2)
    below = _AIR_HU + pooled[0, 0]
    dense = (values > limit) & (below < _RINGING * (values - _AIR_HU))
    return float(values[dense].max()) if bool(dense.any()) else limit
