"""What is read off every volume of the plaque: ROI means, observer channels, fat, edges, errors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from recon.study.dose_factor.measures import OBSERVERS, crop_window, observer_channels
from recon.study.dose_factor.settings import ROIS
from recon.study.dose_factor.variant import Variant
from recon.study.paper.plaque_scan import Functional
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics import edge_mask, ellipsoid_distance

__all__ = ["BIN_MM", "DIRECTIONS", "REACH_MM", "Readings", "true_volume"]

Floats = NDArray[np.float64]

DIRECTIONS = ("plane", "z")
REACH_MM = (0.5, 1.0)
BIN_MM = 0.05
"""Of the edge profile of the core, inwards and outwards."""

_FAT_OFFSET_MM, _FAT_MM = 3.3, (2.0, 6.0)
"""Uniform fat above and below the vessel: distance of the middle from the vessel's axis, and size (y, x)."""
_FAT_SLICES_MM = (-4.0, -2.0, 0.0, 2.0, 4.0)
_CLEAR_MM = 0.6
"""Fat whose error counts keeps this far from the vessel and from the rim of the inset."""
_FINE = 5
"""Points along the edge of a voxel for its true value."""
_EDGE_MM = 0.2
"""The core's edge: voxels whose middle is no further from its surface."""


class Readings:
    """The readings on one grid.

    Args:
        variant: where things are: a scene of the paper's shapes.
        grid: of the volumes.
        tissue_hu: true value of every tissue.

    Attributes:
        weights: ``(2 · rois + channels, z, y, x)`` float64: core and fibrous mean of every ROI of
            :data:`recon.study.dose_factor.settings.ROIS`, then the channels of every observer.
        samples: of fat, vessel and the core's edge the voxels whose exact variance stands for the region's, and their
            shares in it. One in every slice (of the vessel those of the fat, of the fat in both its parts): FDK smooths
            along z where it interpolates between detector rows and not where a slice meets a row, so the variance of a
            single slice may be a third above the mean.
        distances: direction → ``(bins,)`` mm from the core's surface, of :meth:`read`'s ``profile``.
    """

    def __init__(self, variant: Variant, grid: VolumeGrid, tissue_hu: Mapping[str, float]) -> None:
        self.grid = grid
        pairs = [variant.pair_of(name) for name in ROIS]
        rows = [r.weights for pair in pairs for r in pair.on(grid)]
        self._crop, crop = crop_window(grid, variant.core_center)
        for observer in OBSERVERS:
            for channel in observer_channels(variant, grid, observer):
                whole = torch.zeros(grid.shape, dtype=torch.float64)
                whole[self._crop] = torch.from_numpy(channel)
                rows.append(whole)
        self.weights = torch.stack(rows)
        self._truth, patient = true_volume(variant, grid, tissue_hu)
        self._boxes = _fat_boxes(grid, patient)
        vessel = patient < 0.5
        away = ndimage.distance_transform_edt(patient > 1 - 1e-9, grid.spacing) >= _CLEAR_MM
        rim = [round(_CLEAR_MM / s) for s in grid.spacing]
        inner = np.zeros(grid.shape, dtype=bool)
        inner[tuple(slice(k, n - k) for k, n in zip(rim, grid.shape, strict=True))] = True
        self._masks = [torch.from_numpy(vessel), torch.from_numpy(away & inner)]
        fat: list[tuple[int, ...]] = [
            (z, (y.start + y.stop) // 2, (x.start + x.stop) // 2) for slices, y, x in self._boxes for z in slices
        ]
        slices = self._boxes[0][0]
        distance = ellipsoid_distance(crop, variant.core_center, tuple(variant.plaque.core.semi_axes[::-1]))
        self._edge = np.flatnonzero(np.abs(distance) <= _EDGE_MM)
        corner = np.array([part.start for part in self._crop])
        rim = np.argwhere(np.abs(distance) <= _EDGE_MM) + corner
        self.samples = [(fat, np.full(len(fat), 1.0 / len(fat))), _by_slice(np.argwhere(vessel), slices),
                        _by_slice(rim, np.unique(rim[:, 0]).tolist())]  # fmt: skip
        self.distances: dict[str, Floats] = {}
        self._profiles = self._edges(distance, crop)

    def _edges(self, distance: Floats, crop: VolumeGrid) -> list[Tensor]:
        """Matrices ``(bins, voxels of the crop)`` that average over voxels of equal distance from the core."""
        count = round(sum(REACH_MM) / BIN_MM)
        matrices = []
        for direction in DIRECTIONS:
            mask = edge_mask(distance, crop.spacing, direction)
            use = mask & (distance >= -REACH_MM[0]) & (distance < -REACH_MM[0] + count * BIN_MM)
            places = np.flatnonzero(use)
            r = distance.ravel()[places]
            index = np.minimum(((r + REACH_MM[0]) / BIN_MM).astype(np.int64), count - 1)
            bins, row = np.unique(index, return_inverse=True)
            matrix = np.zeros((len(bins), distance.size))
            matrix[row, places] = 1.0 / np.bincount(row)[row]
            self.distances[direction] = matrix[:, places] @ r
            matrices.append(torch.from_numpy(matrix))
        return matrices

    def functionals(self) -> list[Functional]:
        """The rows of :attr:`weights`, then single voxels: of :attr:`samples`, and the middle one."""
        singles = []
        for place in (*(place for places, _ in self.samples for place in places), self.middle):
            weights = torch.zeros(self.grid.shape, dtype=torch.float64)
            weights[place] = 1.0
            singles.append(weights)
        return [Functional(w) for w in (*self.weights, *singles)]

    @property
    def middle(self) -> tuple[int, ...]:
        """The middle voxel."""
        return tuple(n // 2 for n in self.grid.shape)

    def channels_of_crops(self, crops: Any) -> Floats:
        """``(n, channels)`` of the observers on crops about the core ``(n, z, y, x)``."""
        rows = self.weights[2 * len(ROIS) :][(slice(None), *self._crop)].numpy()
        found: Floats = np.einsum("nzyx,rzyx->nr", np.asarray(crops, dtype=np.float64), rows)
        return found

    def linear(self, volumes: Tensor) -> Floats:
        """``(n, rows)`` of :attr:`weights`."""
        found: Floats = torch.einsum("nzyx,rzyx->nr", volumes.double(), self.weights).numpy()
        return found

    def profiles(self, volumes: Tensor) -> dict[str, Floats]:
        """Direction → ``(n, bins)`` mean over voxels of equal distance from the core's surface."""
        crop = volumes[(slice(None), *self._crop)].double().flatten(1)
        return {d: (crop @ m.T).numpy() for d, m in zip(DIRECTIONS, self._profiles, strict=True)}

    def fat(self, volumes: Tensor) -> NDArray[np.float32]:
        """``(n, slices, y, x)`` of uniform fat."""
        return torch.cat([volumes[(slice(None), *box)] for box in self._boxes], 1).float().numpy()

    def edge(self, volumes: Tensor) -> NDArray[np.float32]:
        """``(n, voxels)`` of the core's edge."""
        crop = volumes[(slice(None), *self._crop)].flatten(1)
        return crop[:, torch.from_numpy(self._edge)].float().numpy()

    @property
    def fat_shape(self) -> tuple[int, int]:
        """``(y, x)`` voxels of a slice of :meth:`fat`."""
        _, y, x = self._boxes[0]
        return y.stop - y.start, x.stop - x.start

    def squares(self, volumes: Tensor) -> Floats:
        """``(n, 2)`` mean square error against the true volume in HU²: inside the vessel, in fat."""
        error = (volumes.double() - self._truth).square()
        found: Floats = torch.stack([error[:, m].mean(1) for m in self._masks], 1).numpy()
        return found


def _by_slice(places: NDArray[np.int64], slices: list[int]) -> tuple[list[tuple[int, ...]], Floats]:
    """Of the places in each of the slices the one in the middle, and how many there are over those of all."""
    of = [places[places[:, 0] == z] for z in slices]
    counts = np.array([len(p) for p in of], dtype=np.float64)
    return [tuple(map(int, p[len(p) // 2])) for p in of], counts / counts.sum()


def _fat_boxes(grid: VolumeGrid, patient: NDArray[np.float64]) -> list[tuple[Any, slice, slice]]:
    z, y, x = grid.axes
    slices = sorted({int(np.abs(z - grid.center[0] - at).argmin()) for at in _FAT_SLICES_MM})

    def part(axis: Floats, middle: float, size: float) -> slice:
        count = round(size / float(axis[1] - axis[0]))
        first = round((middle - float(axis[0])) / float(axis[1] - axis[0]) - (count - 1) / 2)
        return slice(first, first + count)

    boxes = []
    for sign in (-1, 1):
        box = (slices, part(y, grid.center[1] + sign * _FAT_OFFSET_MM, _FAT_MM[0]), part(x, grid.center[2], _FAT_MM[1]))
        if not (patient[box] > 1 - 1e-9).all() or box[1].start < 0 or box[1].stop > grid.shape[1]:
            raise ValueError("the region of uniform fat touches the vessel or the rim of the inset")
        boxes.append(box)
    return boxes


def true_volume(variant: Variant, grid: VolumeGrid, tissue_hu: Mapping[str, float]) -> tuple[Tensor, Floats]:
    """Tissues averaged over voxels, HU ``(z, y, x)``, and the share of every voxel outside of the vessel."""
    values = np.array([tissue_hu[b.name] for b in variant.scene.bodies])
    outside = np.array([b.name == "patient" for b in variant.scene.bodies], dtype=float)
    truth, share = np.empty(grid.shape), np.empty(grid.shape)
    _, y, x = grid.shape
    step = grid.spacing[0]
    for k, z in enumerate(grid.axes[0]):
        fine = VolumeGrid(
            (_FINE, y * _FINE, x * _FINE), tuple(s / _FINE for s in (step, *grid.spacing[1:])), (z, *grid.center[1:])
        )
        labels = np.asarray(variant.scene.labels(fine)).reshape(_FINE, y, _FINE, x, _FINE)
        truth[k] = values[labels].mean((0, 2, 4))
        share[k] = outside[labels].mean((0, 2, 4))
    return torch.from_numpy(truth), share
