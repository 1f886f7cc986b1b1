"""AᵀWA between the voxels of a vessel, as dense blocks of two slices: a product with many columns is a few GEMMs.

A vessel fills a few per cent of the inset. What a model of it changes is 0 elsewhere, so the blocks replace the
transforms of the whole inset, hundreds of them in one fit.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from recon.plaque.kernels import gather_block

__all__ = ["LocalGram"]

Floats = NDArray[np.floating[Any]]

LARGEST = 1_500_000_000
"""Bytes that the blocks may take."""


class LocalGram:
    """G restricted to a set of voxels.

    Args:
        blocks: (first slice, lag) → ``(n, m)`` from voxels of the slice to those of slice + lag, in their order.
        slices: start of every slice in the set, ``(nz + 1,)``.
    """

    def __init__(self, blocks: dict[tuple[int, int], Floats], slices: NDArray[np.int64]) -> None:
        self.blocks, self.slices = blocks, slices

    @classmethod
    def of(cls, gram: Any, index: NDArray[np.int64], scale: float) -> LocalGram:
        """From an operator with ``lag_kernels()`` and ``polynomials`` (:class:`recon.gram.gram.Gram`).

        Args:
            gram: the operator.
            index: ``(n, 3)`` z, y, x of the voxels, ordered by z.
            scale: factor on the operator.

        Raises:
            ValueError: so many voxels that the blocks would take more than 1.5 GB.
        """
        ny, nx = gram.grid.shape[-2:]
        kernels = (gram.lag_kernels() * scale).float()
        _, lags, nz, py, px = kernels.shape
        # Lags from −(n − 1) to n − 1 in a row, mirrored along x: the lag falls with the x of the voxel read.
        kernels = kernels[..., torch.arange(1 - ny, ny) % py, :][..., torch.arange(nx - 1, -nx, -1) % px]
        near = np.ascontiguousarray(kernels.permute(1, 2, 0, 3, 4).numpy())
        polynomials = np.ascontiguousarray(gram.polynomials.float().numpy())
        slices = np.searchsorted(index[:, 0], np.arange(nz + 1))
        counts = np.diff(slices)
        size = 4 * sum(int(counts[: nz - b] @ counts[b:]) for b in range(lags))
        if size > LARGEST:
            raise ValueError(
                f"the vessel holds {len(index)} voxels, whose operator would take {size / 1e9:.1f} GB: "
                "take larger voxels or a smaller inset"
            )
        planes = [np.ascontiguousarray(index[slices[z] : slices[z + 1], 1:]) for z in range(nz)]
        runs = [_runs(p) for p in planes]
        blocks = {}
        for b in range(lags):
            for z in range(nz - b):
                if len(planes[z]) and len(planes[z + b]):
                    out = np.empty((len(planes[z + b]), len(planes[z])), np.float32)
                    gather_block(near[b, z], polynomials, planes[z + b], runs[z], out)
                    blocks[z, b] = out
        return cls(blocks, slices)

    def apply(self, x: Floats) -> Floats:
        """G x of columns ``(n, k)`` float32."""
        out = np.zeros_like(x)
        at = self.slices
        parts = [x[at[z] : at[z + 1]] for z in range(len(at) - 1)]
        used = [np.flatnonzero(np.any(p != 0, axis=0)) for p in parts]
        packed = [np.ascontiguousarray(p[:, u]) for p, u in zip(parts, used, strict=True)]
        for (z, b), block in self.blocks.items():
            if len(used[z]):
                out[at[z + b] : at[z + b + 1], used[z]] += block @ packed[z]
            if b and len(used[z + b]):
                out[at[z] : at[z + 1], used[z + b]] += block.T @ packed[z + b]
        return out

    def part(self, chosen: NDArray[np.int64]) -> LocalGram:
        """G between some of the voxels, whose positions are given in rising order."""
        at = np.searchsorted(chosen, self.slices)
        inside = [chosen[at[z] : at[z + 1]] - self.slices[z] for z in range(len(at) - 1)]
        blocks = {
            (z, b): np.ascontiguousarray(block[np.ix_(inside[z + b], inside[z])])
            for (z, b), block in self.blocks.items()
            if len(inside[z]) and len(inside[z + b])
        }
        return LocalGram(blocks, at)


def _runs(plane: NDArray[np.int64]) -> NDArray[np.int64]:
    """``(runs, 4)`` y, first x, first position, count of voxels ``(n, 2)`` that lie side by side along x."""
    first = np.flatnonzero(np.any(np.diff(plane, axis=0, prepend=-2) != (0, 1), axis=1))
    count = np.diff(first, append=len(plane))
    return np.column_stack([plane[first], first, count])
