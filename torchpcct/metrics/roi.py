"""Regions of interest on the finely interpolated axial image of the paper's protocol.

The paper interpolates every reconstruction linearly to 0.035 mm voxels (an axial image of 256 ×
256) and takes ROI means there. Interpolation and mean are linear, so an ROI mean is one inner
product of the volume with a fixed weight volume: :class:`RoiMean` computes that weight volume once.
It is also what the exact variance of a linear reconstruction needs (one adjoint pass per ROI).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpcct.geometry import VolumeGrid

if TYPE_CHECKING:
    from torchpcct.typing import Bools


__all__ = ["RoiMean"]

PROTOCOL_PIXEL_MM = 0.035
"""Edge of a pixel of the protocol's axial image, mm (Li et al.)."""
PROTOCOL_PIXELS = 256
"""Pixels along its edge."""


def as_array(image: object) -> Any:
    """An image, tensor on any device or array, as a NumPy array of its own dtype."""
    return image.detach().cpu().numpy() if isinstance(image, Tensor) else np.asarray(image)


def axial_grid(center: tuple[float, float, float]) -> VolumeGrid:
    """The protocol's axial image: 256 × 256 pixels of 0.035 mm about ``center`` (z, y, x) in mm,
    one slice."""
    return VolumeGrid((1, PROTOCOL_PIXELS, PROTOCOL_PIXELS), PROTOCOL_PIXEL_MM, center)


def _linear_weights(
    nodes: NDArray[np.float64], points: NDArray[np.float64], axis: str
) -> NDArray[np.float64]:
    """``(points, nodes)`` linear interpolation matrix; up to half a cell beyond the outer nodes
    is held constant."""
    n = nodes.size
    step = nodes[1] - nodes[0] if n > 1 else np.inf
    position = (points - nodes[0]) / step if n > 1 else np.zeros(points.size)
    if n > 1 and (position.min() < -0.5 - 1e-6 or position.max() > n - 0.5 + 1e-6):
        raise ValueError(
            f"the image reaches {axis} = {points.min():.3f} … {points.max():.3f} mm, beyond the "
            f"volume's {nodes[0] - step / 2:.3f} … {nodes[-1] + step / 2:.3f} mm: reconstruct a "
            "larger grid or move the image"
        )
    position = np.clip(position, 0, n - 1)
    low = np.minimum(position.astype(np.int64), max(n - 2, 0))
    fraction = position - low
    weights = np.zeros((points.size, n))
    weights[np.arange(points.size), low] = 1 - fraction
    if n > 1:
        weights[np.arange(points.size), low + 1] += fraction
    return weights


def _matrices(grid: VolumeGrid, image: VolumeGrid) -> tuple[NDArray[np.float64], ...]:
    if grid.ndim != 3 or image.ndim != 3:
        raise ValueError(
            f"volume and image grids must be (z, y, x), got {grid.shape} and {image.shape}"
        )
    return tuple(
        _linear_weights(g, p, a) for g, p, a in zip(grid.axes, image.axes, "zyx", strict=True)
    )


def sample_axial(volume: Tensor, grid: VolumeGrid, image: VolumeGrid) -> Tensor:
    """Trilinear interpolation of ``volume`` ``(..., z, y, x)`` on ``grid`` to the voxel centres of
    ``image``.

    Returns:
        ``(..., *image.shape)``, dtype and device of ``volume``.

    Raises:
        ValueError: ``image`` reaches beyond ``grid``, or the volume's shape is not the grid's.
    """
    if tuple(volume.shape[-3:]) != grid.shape:
        raise ValueError(f"volume has shape {tuple(volume.shape)}, its grid {grid.shape}")
    for matrix, axis in zip(_matrices(grid, image), (-3, -2, -1), strict=True):
        m = torch.as_tensor(matrix, dtype=volume.dtype, device=volume.device)
        volume = torch.movedim(torch.movedim(volume, axis, -1) @ m.T, -1, axis)
    return volume


@dataclass(frozen=True)
class RoiMean:
    """Mean over a mask of the interpolated axial image, as a functional of the volume.

    Args:
        grid: the volume's grid (z, y, x).
        image: the grid of the interpolated image, e.g. :func:`axial_grid`.
        mask: bool array of the image's shape (a leading axis of 1 may be left out).

    Raises:
        ValueError: an empty mask, a wrong shape, an image that reaches beyond the volume.
    """

    grid: VolumeGrid
    image: VolumeGrid
    mask: Bools

    def __post_init__(self) -> None:
        mask = np.asarray(self.mask, dtype=bool)
        if mask.shape == self.image.shape[1:] and self.image.shape[0] == 1:
            mask = mask[None]
        if mask.shape != self.image.shape:
            raise ValueError(f"mask has shape {mask.shape}, the image {self.image.shape}")
        if not mask.any():
            raise ValueError(
                "the ROI is empty: no pixel of the image lies in it; enlarge the ROI or move it"
            )
        wz, wy, wx = _matrices(self.grid, self.image)
        weights = np.einsum("zyx,za,yb,xc->abc", mask / mask.sum(), wz, wy, wx, optimize=True)
        object.__setattr__(self, "mask", mask)
        object.__setattr__(self, "_weights", torch.from_numpy(weights))

    @property
    def weights(self) -> Tensor:
        """``grid.shape`` float64 weights that sum to 1."""
        return self._weights  # type: ignore[attr-defined]

    def __call__(self, volume: Tensor) -> Tensor:
        """ROI mean of ``volume`` ``(..., z, y, x)``, ``(...)`` float64."""
        if tuple(volume.shape[-3:]) != self.grid.shape:
            raise ValueError(
                f"volume has shape {tuple(volume.shape)}, the ROI's grid {self.grid.shape}"
            )
        return torch.einsum(
            "...zyx,zyx->...", volume.to(torch.float64), self.weights.to(volume.device)
        )
