"""What is measured on every reconstruction beside the ROI means: a crop, an observer's channels, lumen and cap."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.study.dose_factor.variant import Variant
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.observer import dog_channels
from torchpcct.metrics.plaque_measures import LUMEN_HU, cap_on_line, lumen_area
from torchpcct.metrics.roi import sample_axial

__all__ = ["CROP_MM", "DOG_CHANNELS", "LUMEN_HALF_HU", "OBSERVERS", "crop_window", "observer_channels", "segmentation"]

Floats = NDArray[np.float64]

CROP_MM = 3.8
"""Edge of the cube about the core that is kept of every realisation: the core (1.97 mm) and the cap with a margin."""

OBSERVERS = ("axial", "volume")
DOG_CHANNELS = 6
_LOWEST_CHANNEL = 0.1
"""Difference-of-Gaussians channels from 0.1 line pairs per mm (the crop holds no lower ones) to 0.5."""

LUMEN_HALF_HU = 293.0
"""Half way between blood (482 HU as this scanner sees it) and fibrous tissue (105 HU). At the paper's 250 HU the
contour lies outside the edge: the true volume, averaged over 0.2 mm voxels, has 4.24 mm² there and 4.04 mm² here, of
4.11 mm²."""

_CAP_CORE_HU, _CAP_STEP_MM = 70.0, 0.01


def crop_window(grid: VolumeGrid, center: tuple[float, float, float]) -> tuple[tuple[slice, ...], VolumeGrid]:
    """The cube about ``center`` (z, y, x in mm): its place in a volume, and its grid.

    Raises:
        ValueError: the cube leaves the grid.
    """
    places, middle = [], []
    for n, step, axis, c in zip(grid.shape, grid.spacing, grid.axes, center, strict=True):
        half = round(CROP_MM / step / 2)
        k = round((c - axis[0]) / step)
        if k - half < 0 or k + half >= n:
            raise ValueError(f"the crop of {CROP_MM} mm about {center} mm leaves the inset: enlarge the inset")
        places.append(slice(k - half, k + half + 1))
        middle.append(float(axis[k]))
    shape = tuple(p.stop - p.start for p in places)
    return tuple(places), VolumeGrid(shape, grid.spacing, tuple(middle))


def observer_channels(variant: Variant, grid: VolumeGrid, observer: str) -> Floats:
    """Channels on the crop, ``(1 + DOG_CHANNELS, *crop)``: the core's own shape, then difference-of-Gaussians.

    Args:
        variant: where the core is.
        grid: of the volumes.
        observer: ``"axial"`` looks at the protocol's axial image (linear interpolation between two slices), as the
            paper does; ``"volume"`` at all slices of the core.
    """
    z, y, x = variant.core_center
    crop = crop_window(grid, variant.core_center)[1]
    if observer == "axial":
        image = VolumeGrid((1, *crop.shape[1:]), crop.spacing, (z, *crop.center[1:]))
        dogs = dog_channels(image.slice, (y, x), DOG_CHANNELS, lowest=_LOWEST_CHANNEL)[:, None]
        depth = np.clip(1.0 - np.abs(crop.axes[0] - z) / crop.spacing[0], 0.0, None)[:, None, None]
    elif observer == "volume":
        image, depth = crop, np.ones((1, 1, 1))
        dogs = dog_channels(crop, variant.core_center, DOG_CHANNELS, lowest=_LOWEST_CHANNEL)
    else:
        raise ValueError(f"observer must be one of {', '.join(OBSERVERS)}, got {observer!r}")
    core = (variant.plain.labels(image) == variant.plain.index("core")).astype(np.float64)
    channels: Floats = np.concatenate([core[None] / np.sqrt(core.sum()), dogs]) * depth
    return channels


def segmentation(variant: Variant, grid: VolumeGrid, volume: Tensor) -> tuple[float, float, float]:
    """Lumen area (mm²), cap thickness (mm) and lumen area at half maximum in the protocol's axial image.

    NaN where the edges are lost. The first area is the paper's, at 250 HU; the last at :data:`LUMEN_HALF_HU`. The cap
    is measured on the line from the lumen's to the core's centre, between where the image first falls below 250 HU and
    below 70 HU: the core's whole contour at 70 HU runs into the thin wall (67 HU) beside it.
    """
    image = variant.rois.image
    section = sample_axial(volume.to(torch.float64), grid, image)
    (_, *lumen), (_, *core) = variant.lumen_center, variant.core_center
    area, half = (lumen_area(section, image, (lumen[0], lumen[1]), hu) for hu in (LUMEN_HU, LUMEN_HALF_HU))
    cap = cap_on_line(
        section, image, (lumen[0], lumen[1]), (core[0], core[1]),
        core_hu=_CAP_CORE_HU, step_mm=_CAP_STEP_MM, interpolate=False,
    )  # fmt: skip
    return area, cap, half
