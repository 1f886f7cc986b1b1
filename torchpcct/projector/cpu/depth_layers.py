"""What the cone-beam kernels are handed: running sums along z, and the spacing of the depth layers."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchpcct.geometry import VolumeGrid

__all__ = ["layer_spacing", "running_sums"]

# Row edges may move by this part of the blur between two depth layers (see layer_spacing).
LAYER_SHIFT = 0.04


def running_sums(x: NDArray[Any]) -> NDArray[Any]:
    """``(nz, ny, nx)`` to the ``lines`` of ``volume_kernels.project``."""
    nz, ny, nx = x.shape
    lines = np.empty((ny * nx, (nz + 7) // 8 * 8 + 8), dtype=x.dtype)
    lines[:, 0] = 0
    np.cumsum(x.reshape(nz, ny * nx).T, axis=-1, out=lines[:, 1 : nz + 1])
    lines[:, nz + 1 :] = lines[:, nz, None]
    return lines


def layer_spacing(pose: NDArray[np.float64], grid: VolumeGrid, row0: float, row_pitch: float, rows: int) -> float:
    """Spacing of depth layers in the ray parameter λ; layers replace slabs where slabs are closer than this.

    The heights of the row edges grow with λ, so each slab needs its own interpolation along z. Where the magnification
    changes little (a small grid), slabs are instead shared linearly between two layers, and only layers are
    interpolated. Between two layers the row edges move by at most ``LAYER_SHIFT`` of the blur that the voxel and the
    row have anyway; the error is of second order in it.
    """
    z, hz = grid.axes[0], grid.spacing[0]
    reach = max(abs(z[0] - hz / 2 - pose[:, 2]).max(), abs(z[-1] + hz / 2 - pose[:, 2]).max())
    ends = np.array([row0, row0 + rows * row_pitch])
    rise = np.abs(ends + (pose[:, 7] - pose[:, 2])[:, None]).max()
    # Depths of the grid's corners and centre in every view; rows are finest, and moves largest, at the nearest.
    x, y = (grid.center[i] + grid.extent[i] / 2 * np.array([-1, -1, 1, 1, 0]) for i in (2, 1))
    y[:4] = y[[0, 2, 0, 2]]
    offset = np.stack([x, y], axis=-1) - pose[:, None, :2]
    depth = (offset * pose[:, None, 3:5]).sum(axis=-1) / (pose[:, None, 3:5] ** 2).sum(axis=-1)
    near = depth.min()
    if near <= 0:
        return 1e-6  # slabs one by one
    depth = depth[:, 4].min()
    blur = math.hypot(hz, depth * row_pitch)
    return float(min(LAYER_SHIFT * blur / max(min(rise, reach / depth), 1e-12), near / 4))
