"""Volume fractions of a scene on a voxel grid: reference images and label maps, never used to simulate a scan."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from torchpcct.geometry import VolumeGrid
from torchpcct.kernel_cache import forget_outdated
from torchpcct.scene.bodies import Shape
from torchpcct.scene.chords import interval, pack
from torchpcct.threads import run
from torchpcct.validate import checked, whole

__all__ = ["volume_fractions"]

Floats = NDArray[np.float64]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _fill(
    begin: int, end: int, kinds: Any, params: Any, zs: Any, ys: Any, x_edge: float, dx: float, lines: int, out: Any
) -> None:
    bodies, _, ny, nx = out.shape
    share = 1.0 / lines
    for job in range(begin, end):
        k, j = job // ny, job % ny
        for b in range(bodies):
            for line in range(lines):
                y, z = ys[j, line], zs[k, line]
                t0, t1 = interval(kinds[b], params[b], x_edge, y, z, 1.0, 0.0, 0.0)
                t0, t1 = max(t0, 0.0) / dx, min(t1 / dx, float(nx))
                if t1 <= t0:
                    continue
                first, last = min(int(t0), nx - 1), min(int(t1), nx - 1)
                if first == last:
                    out[b, k, j, first] += (t1 - t0) * share
                else:
                    out[b, k, j, first] += (first + 1 - t0) * share
                    for i in range(first + 1, last):
                        out[b, k, j, i] += share
                    out[b, k, j, last] += (t1 - last) * share


@checked
def volume_fractions(shapes: Sequence[Shape], parents: Sequence[int], grid: VolumeGrid, oversample: int = 4) -> Floats:
    """Share of each voxel that each of ``B`` nested bodies fills itself, without the bodies inside it.

    Each voxel row is crossed by ``oversample²`` lines along x (a rank-1 lattice over the row's y, z section; 2-D grids:
    ``oversample`` lines over y in the plane z = 0), each cut exactly: only y and z are sampled. The fractions of all
    bodies and of the surroundings add up to 1 in every voxel.

    Args:
        shapes: of the bodies, at rest.
        parents: index of the body around each, −1 for none.
        grid: 2-D or 3-D voxel grid.
        oversample: lines per voxel edge, at least 1.

    Returns:
        ``(B, *grid.shape)`` float64, within 0…1.

    Raises:
        ValueError: ``oversample`` below 1. TypeError: not a whole number, or not a grid.
    """
    oversample = whole("oversample", oversample)
    if not isinstance(grid, VolumeGrid):
        raise TypeError(f"grid must be a VolumeGrid, got {type(grid).__name__}")
    kinds, params = pack(shapes)
    y, x = grid.axes[-2:]
    dy, dx = grid.spacing[-2:]
    if grid.ndim == 3:
        lines = oversample**2
        step = np.arange(lines) + 0.5
        # Golden-ratio lattice: no two lines share a y or a z, so edges parallel to an axis are resolved to 1 / lines.
        across, along = step / lines, np.mod(step * 0.6180339887498949, 1.0)
        zs = grid.axes[0][:, None] + (along - 0.5) * grid.spacing[0]
    else:
        lines = oversample
        across = (np.arange(lines) + 0.5) / lines
        zs = np.zeros((1, lines))
    ys = y[:, None] + (across - 0.5) * dy
    filled = np.zeros((kinds.size, zs.shape[0], y.size, x.size))
    work = 50 * kinds.size * lines
    run(
        _fill, len(zs) * len(ys), kinds, params, zs, ys, float(x[0] - dx / 2.0), float(dx), lines, filled,
        operations=work,
    )  # fmt: skip
    own = filled.copy()
    for k, parent in enumerate(parents):
        if parent >= 0:
            own[parent] -= filled[k]
    return np.clip(own, 0.0, 1.0, out=own).reshape(kinds.size, *grid.shape)


forget_outdated(__name__)
