"""What a test of a scan found, and which readings no test can take."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["ScanTest"]


@dataclass(frozen=True)
class ScanTest:
    """What a test of a scan found.

    Attributes:
        sizes: cause → its estimated size, if it were the only one; causes that this scan cannot
            show are missing.
        errors: cause → standard error of its size, where there is one.
        findings: what was found, in words; empty: nothing at the stated rate of false alarms.
    """

    sizes: Mapping[str, float]
    errors: Mapping[str, float]
    findings: tuple[str, ...]


UNKNOWN = ScanTest({}, {}, ())
"""Of a scan in which nothing is to be seen."""


def check_lines(lines: Tensor, shape: tuple[int, ...], fits: bool = True) -> None:
    """Refuse line integrals that no test can take.

    Args:
        lines: of a scan.
        shape: that they must have; fits: false where none would do.

    Raises:
        ValueError: another shape, NaN or Inf.
    """
    if tuple(lines.shape) != shape or not fits:
        raise ValueError(f"lines must have the shape {shape}, got {tuple(lines.shape)}")
    if not bool(torch.isfinite(lines).all()):
        raise ValueError(
            "lines hold NaN or Inf: interpolate dead readings before "
            "(torchpcct.readings.interpolate_dead)"
        )
