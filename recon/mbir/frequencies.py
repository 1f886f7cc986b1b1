"""Volumes and their frequencies: line pairs per mm in the layout of ``rfftn``, filters there."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import torch
from torch import Tensor


def squared_frequencies(
    shape: Sequence[int], voxel_mm: float, like: Tensor | None = None
) -> Tensor:
    """f² in (line pairs per mm)² on the frequencies of ``rfftn`` of volumes, ``(z, y, x//2 + 1)``;
    not to be changed.

    Args:
        shape: ``(z, y, x)`` of the volumes; voxel_mm: their voxels.
        like: whose dtype and device they get; None: float32 on the CPU.
    """
    dtype, device = (
        (torch.float32, torch.device("cpu")) if like is None else (like.dtype, like.device)
    )
    return _squared_frequencies(tuple(shape), voxel_mm, dtype, device)


@lru_cache(maxsize=32)
def _squared_frequencies(
    shape: tuple[int, ...], voxel_mm: float, dtype: torch.dtype, device: torch.device
) -> Tensor:
    z, y, x = shape
    # Not of inference mode: they are kept, and a training may come after.
    with torch.inference_mode(False):
        total: Tensor = (
            torch.fft.fftfreq(z, voxel_mm)[:, None, None] ** 2
            + torch.fft.fftfreq(y, voxel_mm)[:, None] ** 2
            + torch.fft.rfftfreq(x, voxel_mm) ** 2
        )
        return total.to(device, dtype)


def to_frequencies(v: Tensor) -> Tensor:
    """``rfftn`` of volumes ``(..., z, y, x)``."""
    return torch.fft.rfftn(v, dim=(-3, -2, -1))


def from_frequencies(spectrum: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Volumes ``(..., *shape)`` of :func:`to_frequencies`."""
    return torch.fft.irfftn(spectrum, s=shape, dim=(-3, -2, -1))


def filtered(v: Tensor, spectrum: Tensor) -> Tensor:
    """Volumes ``(..., z, y, x)`` times ``spectrum`` on the frequencies of ``rfftn``."""
    return from_frequencies(spectrum * to_frequencies(v), v.shape[-3:])
