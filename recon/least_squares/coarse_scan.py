"""AᵀWA of waves that change slowly in the plane, by the rays of a coarser scan.

No model with one spectrum for each place describes them in a cone beam with a circular orbit: which
of them the rays measure depends on the height and on the side of the field (Tuy 1983, SIAM J. Appl.
Math. 43:546), their response extends beyond the last rows, and objects with flat faces consist of
them. But they need neither all columns nor all views: on voxels twice as wide, with all slices and
a quarter of the views, a pair of projections costs a sixth and includes all of that.
"""

from __future__ import annotations

import copy
import itertools
import math
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from torchpcct.geometry import VolumeGrid
from torchpcct.projector import Projector

if TYPE_CHECKING:
    from numpy.typing import NDArray

WIDER = 2
"""Voxels of the coarser scan in voxels of the grid, in the plane."""
CUT = 0.2
"""In-plane frequency, 1/voxel, at which half of a wave's energy is taken from the coarser scan: all
of it at frequencies a quarter lower, none a quarter higher, at 0.25, the highest that the wider
voxels represent."""
EVERY = 4
"""Views of the scan for one of the coarser scan, at most."""
DIRECTIONS = 0.75
"""Views of the coarser scan for each voxel across the grid, at least: π · CUT directions of the
half circle tell such waves apart, and half as many again."""
LEAST_ACROSS = 8
"""Voxels across a grid from which there is something to save."""


class CoarseScan:
    """Low-pass, AᵀWA of the coarser scan, low-pass.

    Args:
        projector: A of a cone beam, or of another geometry with rows.
        weights: W, ``projector.range_shape``.

    Attributes:
        views: of the coarser scan.
        rest: share of a wave's energy that is left to another model, ``rfft2`` layout.
    """

    def __init__(self, projector: Projector, weights: Tensor) -> None:
        grid, geometry, window = projector.grid, projector.geometry, projector.window
        views = int(projector.range_shape[0])
        wanted = max(views // EVERY, math.ceil(DIRECTIONS * max(grid.shape[1:])))
        # An odd number: of an even one opposite views see the same.
        self.views = min(wanted | 1, views)
        borders = np.round(np.arange(self.views + 1) * views / self.views).astype(int)
        picked = (borders[:-1] + borders[1:] - 1) // 2
        self._weights = torch.stack([weights[a:b].sum(0) for a, b in itertools.pairwise(borders)])
        self._shape = tuple(grid.shape)
        self._more = tuple(-n % WIDER for n in grid.shape[1:])
        (nz, *plane), (dz, *steps) = grid.shape, grid.spacing
        wide = VolumeGrid(
            (nz, *((n + more) // WIDER for n, more in zip(plane, self._more, strict=True))),
            (dz, *(WIDER * h for h in steps)),
            (
                grid.center[0],
                *(
                    c + more * h / 2
                    for c, more, h in zip(grid.center[1:], self._more, steps, strict=True)
                ),
            ),
        )
        self._projector = Projector(
            geometry.select(picked), wide, None if window is None else window.select(picked)
        )
        fy: NDArray[np.float64] = np.fft.fftfreq(plane[0])[:, None].astype(np.float64)
        fx: NDArray[np.float64] = np.fft.rfftfreq(plane[1]).astype(np.float64)
        slow = np.clip((1.25 * CUT - np.hypot(fy, fx)) / (0.5 * CUT), 0.0, 1.0) * (math.pi / 2)
        # Voxels are joined, and the wider ones blur the rays once more.
        low = np.sin(slow) / (_blur(fy) * _blur(fx)) ** 2
        self._low = torch.from_numpy(low).to(weights)
        self.rest = torch.from_numpy(np.cos(slow) ** 2).to(weights)

    def apply(self, x: Tensor) -> Tensor:
        """``(..., *grid.shape)``."""
        wide = self._projector.domain_shape
        padded = F.pad(self._filter(x), (0, self._more[1], 0, self._more[0]))
        cells = padded.reshape(*x.shape[:-2], wide[1], WIDER, wide[2], WIDER)
        lines = self._projector(cells.mean((-3, -1)))
        back = self._projector.T(self._weights.to(x) * lines) / WIDER**2
        back = back.repeat_interleave(WIDER, -2).repeat_interleave(WIDER, -1)
        return self._filter(back[..., : self._shape[1], : self._shape[2]])

    def _filter(self, x: Tensor) -> Tensor:
        waves = torch.fft.rfft2(x).mul_(self._low.to(x))
        return torch.fft.irfft2(waves, s=self._shape[1:])

    def scaled(self, factor: float) -> CoarseScan:
        """That of ``factor`` · W."""
        other = copy.copy(self)
        other._weights = self._weights * factor
        return other


def coarse_scan(projector: Any, weights: Tensor) -> CoarseScan | None:
    """The coarser scan; None in a plane, of operators that are no
    :class:`torchpcct.projector.Projector` at rest, of grids of a few voxels and where wider voxels
    at the grid's edge would reach a source."""
    if not isinstance(projector, Projector) or not projector.at_rest or projector.grid.ndim < 3:
        return None
    if min(projector.grid.shape[1:]) < LEAST_ACROSS:
        return None
    try:
        return CoarseScan(projector, weights)
    except ValueError:
        return None


def _blur(f: NDArray[np.float64]) -> NDArray[np.float64]:
    """What of a wave of f per voxel the mean of ``WIDER`` voxels keeps; of fast ones, which are cut
    off, nothing that could be divided by."""
    kept: NDArray[np.float64] = np.maximum(np.sinc(WIDER * f) / np.sinc(f), 0.5)
    return kept
