"""What a method makes of a scan, before :func:`recon.api.reconstruct` makes a volume with a report of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from torch import Tensor

if TYPE_CHECKING:
    from torchpcct.metrics.residual_test import ResidualTest  # loads scipy.stats

__all__ = ["Solution"]


class Solution(NamedTuple):
    """A volume, and what is to be said of it.

    Attributes:
        volume: ``grid.shape`` HU.
        report: how it was made.
        warnings: what speaks against it, but for the findings of ``tests``.
        tests: what is left of the data, slice by slice; none of a noise-free scan.
    """

    volume: Tensor
    report: dict[str, Any]
    warnings: Sequence[str] = ()
    tests: Sequence[ResidualTest] = ()
