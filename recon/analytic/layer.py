"""Filtered backprojection as a layer of a network."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from recon.analytic.fbp import fbp
from torchpcct.geometry import Geometry, VolumeGrid

__all__ = ["Fbp"]


class Fbp(nn.Module):
    """:func:`recon.analytic.fbp.fbp` of one geometry on one grid, without parameters.

    Shape:
        ``(..., views, [rows,] columns)`` → ``(..., *grid.shape)``: axes of batch and channel go through. float32 or
        float64; float16 and bfloat16, as autocast leaves them, are computed and returned in float32.

    Args:
        geometry: parallel, fan or cone beam.
        grid: ``(y, x)`` or ``(z, y, x)``.
        kernel: reconstruction kernel.
    """

    def __init__(self, geometry: Geometry, grid: VolumeGrid, kernel: str = "standard") -> None:
        super().__init__()
        self.geometry, self.grid, self.kernel = geometry, grid, kernel

    def forward(self, sinogram: Tensor) -> Tensor:
        narrow = isinstance(sinogram, Tensor) and sinogram.dtype in (torch.float16, torch.bfloat16)
        return fbp(sinogram.float() if narrow else sinogram, self.geometry, self.grid, self.kernel)

    def extra_repr(self) -> str:
        return f"{type(self.geometry).__name__}, {self.geometry.shape} -> {self.grid.shape}, {self.kernel}"
