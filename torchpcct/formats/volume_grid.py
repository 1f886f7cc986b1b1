"""Grids of volumes in files: from spacing and first voxel."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from torchpcct.geometry import VolumeGrid

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


STRAIGHT = 1e-4
"""Relative deviation of axes from those of the scanner that is none."""


def grid_from(shape: tuple[int, ...], spacing: ArrayLike, first: ArrayLike) -> VolumeGrid:
    """Grid from spacing and first voxel, both x, y, z in mm."""
    s, f = np.asarray(spacing, dtype=np.float64)[::-1], np.asarray(first, dtype=np.float64)[::-1]
    center = f + s * (np.array(shape) - 1) / 2
    return VolumeGrid(
        tuple(int(n) for n in shape), tuple(float(v) for v in s), tuple(float(v) for v in center)
    )
