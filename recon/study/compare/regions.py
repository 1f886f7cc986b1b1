"""Where the dose factors are read: the paper's two ROIs, all of the two tissues, and plain fat."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from recon.study.paper.plaque_scan import INSET_MM
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.placement import RoiPair, whole_rois
from torchpcct.metrics.roi import RoiMean
from torchpcct.scene import Scene
from torchpcct.scene.plaque import Plaque

__all__ = ["PAIRS", "Regions"]

PAIRS = {"roi": (0, 1), "whole": (2, 3)}
"""Contrast → its (core, fibrous) among the ROI means of :meth:`Regions.on`."""

_SLICE_MM, _PIXELS = 0.05, 64
_FROM_VESSEL_MM, _FROM_EDGE_MM = 1.0, 0.8
"""The blur of every kernel has ended so far from the vessel; the grid's edges are kept clear of."""


@dataclass(frozen=True, eq=False)
class Regions:
    """What is read of every volume.

    Args:
        scene, plaque: the paper's.
        rois: the paper's two ROIs.
    """

    scene: Scene
    plaque: Plaque
    rois: RoiPair

    @property
    def whole(self) -> RoiPair:
        """All core and all fibrous tissue in the slices of the core, margins left out; the dose-factor study's
        "tissue"."""
        x, y, z = (float(v) for v in self.plaque.to_scanner(self.plaque.core_center))
        slices = math.floor(2 * float(self.plaque.core.semi_axes[2]) / _SLICE_MM)
        return whole_rois(self.scene, VolumeGrid((max(1, slices), _PIXELS, _PIXELS), _SLICE_MM, (z, y, x)))

    def on(self, grid: VolumeGrid) -> list[RoiMean]:
        """Core, fibrous tissue in the paper's ROIs; core, fibrous tissue of the whole lesion."""
        return [*self.rois.on(grid), *self.whole.on(grid)]

    def fat(self, grid: VolumeGrid) -> NDArray[np.bool_]:
        """Voxels of plain fat, ``grid.shape``."""
        plain = self.scene.labels(grid) == self.scene.index("patient")
        inside = ndimage.distance_transform_edt(plain, sampling=grid.spacing) > _FROM_VESSEL_MM
        for axis, (position, middle, extent) in enumerate(zip(grid.axes, grid.center, INSET_MM, strict=True)):
            near = np.abs(position - middle) < extent / 2 - _FROM_EDGE_MM
            inside &= np.expand_dims(near, tuple(a for a in range(3) if a != axis))
        return np.asarray(inside)

    def fat_voxels(self, grid: VolumeGrid, count: int) -> list[Any]:
        """Weights of single voxels of plain fat, spread over the region."""
        places = np.argwhere(self.fat(grid))
        chosen = places[np.random.default_rng(0).choice(len(places), size=min(count, len(places)), replace=False)]
        weights = np.zeros((len(chosen), *grid.shape))
        weights[(np.arange(len(chosen)), *chosen.T)] = 1.0
        return list(weights)
