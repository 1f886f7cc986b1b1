"""Local impulse responses of AᵀWA: one kernel per in-plane node, banded along z.

A kernel K holds G(p + l, z + b; p, z) for the node p, all slices z, all in-plane lags l and the few
slice lags b that share a detector row. Along z it is NOT a convolution: the detector's rows sample
z coarsely (row pitch at the axis ≥ voxel), in the same phase in every view near the mid-plane, so
that neighbouring slices differ by tens of per cent.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchpcct.detector_window import DetectorWindow, footprint
from torchpcct.geometry import ConeBeam, Geometry, VolumeGrid

if TYPE_CHECKING:
    from torchpcct.projector import Projector


Nodes = tuple[tuple[float, float], ...]


def node_positions(count: int) -> Nodes:
    """In-plane positions (y, x) of the nodes in units of the grid's half edge: 1, 5 or 9.

    Raises:
        ValueError: another count.
    """
    if count == 1:
        return ((0.0, 0.0),)
    if count == 5:
        return ((0.0, 0.0), (-0.45, -0.45), (-0.45, 0.45), (0.45, -0.45), (0.45, 0.45))
    if count == 9:
        at = (-0.85, 0.0, 0.85)
        return tuple((y, x) for y in at for x in at)
    raise ValueError(
        f"nodes must be 1 (stationary), 5 (linear in position) or 9 (quadratic), got {count}"
    )


def slice_reach(geometry: Geometry, grid: VolumeGrid) -> int:
    """Largest slice lag of two voxels that share a detector row (0 in 2-D)."""
    if grid.ndim == 2 or not isinstance(geometry, ConeBeam):
        return 0
    nz, dz = grid.shape[0], grid.spacing[0]
    near = geometry.sod - grid.in_plane_radius
    far = geometry.sod + grid.in_plane_radius
    row = geometry.pitch[0] * far / geometry.sdd
    top = (
        max(abs(geometry.row_positions[0]), abs(geometry.row_positions[-1])) + geometry.pitch[0] / 2
    )
    reach = max(abs(grid.center[0] - grid.extent[0] / 2), abs(grid.center[0] + grid.extent[0] / 2))
    tilt = min(top / geometry.sdd, reach / near)
    lag = (dz + row + tilt * math.hypot(*grid.extent[-2:])) / dz
    return min(max(math.ceil(lag) - 1, 0), nz - 1)


def kernel_at(projector: Projector, weights: Tensor, node: tuple[int, int], reach: int) -> Tensor:
    """Impulse responses of AᵀWA for all slices of one voxel column.

    Args:
        projector: the exact operator A of an inset (geometry, grid, window).
        weights: ``range_shape`` CPU weights.
        node: index (y, x) of the voxel column.
        reach: largest slice lag, see :func:`slice_reach`.

    Returns:
        ``(2·reach + 1, nz, 2·ny − 1, 2·nx − 1)``; entry [b, z, ly, lx] couples slice z to slice z +
        b − reach. The dtype is that of the weights.
    """
    geometry, grid = projector.geometry, projector.grid
    flat = grid.ndim == 2
    nz = 1 if flat else grid.shape[0]
    ny, nx = grid.shape[-2:]
    axes = grid.axes
    at = (axes[-2][node[0]], axes[-1][node[1]])

    def around(shape: tuple[int, int]) -> VolumeGrid:
        if flat:
            return VolumeGrid(shape, grid.spacing, at)
        return VolumeGrid((nz, *shape), grid.spacing, (grid.center[0], *at))

    column = around((1, 1))
    window = projector.window or DetectorWindow.full(geometry)
    part = footprint(geometry, column, margin=1).within(window)
    w = window.crop(weights.unsqueeze(1) if flat else weights, part)
    w = w.squeeze(1) if flat else w
    make = type(projector)
    step = min(2 * reach + 1, nz)
    # Slices that are `step` apart share no detector row: their responses are read from one pass.
    comb = torch.zeros(step, nz, 1, 1, dtype=w.dtype)
    for k in range(step):
        comb[k, k::step] = 1
    seen = make(geometry, column, part)(comb.squeeze(1) if flat else comb)
    spread = make(geometry, around((2 * ny - 1, 2 * nx - 1)), part).T(seen * w)
    spread = spread.unsqueeze(1) if flat else spread
    kernel = torch.zeros(2 * reach + 1, nz, 2 * ny - 1, 2 * nx - 1, dtype=w.dtype)
    for b in range(-reach, reach + 1):
        z = torch.arange(max(0, -b), min(nz, nz - b))
        kernel[b + reach, z] = spread[z % step, z + b]
    return _self_adjoint(kernel, reach)


def _self_adjoint(kernel: Tensor, reach: int) -> Tensor:
    """K(l; z, z') = K(−l; z', z), which the response of a single node keeps only on average."""
    nz = kernel.shape[1]
    mirrored = kernel.flip(2, 3)
    out = kernel.clone()
    for b in range(-reach, reach + 1):
        z = torch.arange(max(0, -b), min(nz, nz - b))
        out[b + reach, z] = 0.5 * (kernel[b + reach, z] + mirrored[reach - b, z + b])
    return out
