"""AᵀWA between the voxels of a vessel, as dense blocks of two slices: a product with many columns
is a few GEMMs.

A vessel fills a few per cent of the inset. What a model of it changes is 0 elsewhere, so the blocks
replace the transforms of the whole inset, hundreds of them in one fit.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from recon.vessel.kernels import gather_block, symmetric_step
from torchpcct.threads import run
from torchpcct.validate import shaped

Floats = NDArray[np.floating]

LARGEST = 1_500_000_000
"""Bytes that the blocks may take."""


class LocalGram:
    """G restricted to a set of voxels.

    Args:
        blocks: (first slice, lag) → ``(n, m)`` from voxels of the slice to those of slice + lag, in
            their order.
        slices: start of every slice in the set, ``(nz + 1,)``.
    """

    def __init__(self, blocks: dict[tuple[int, int], Floats], slices: NDArray[np.int64]) -> None:
        self.blocks, self.slices = blocks, slices

    @classmethod
    def of(cls, gram: Any, index: NDArray[np.int64], scale: float) -> LocalGram:
        """From an operator with ``lag_kernels()`` and ``polynomials``
        (:class:`recon.gram.gram.Gram`).

        Args:
            gram: the operator.
            index: ``(n, 3)`` z, y, x of the voxels, ordered by z.
            scale: factor on the operator.

        Raises:
            ValueError: so many voxels that the blocks would take more than 1.5 GB; an index that is
                not ``(n, 3)``, or beyond the grid.
        """
        ny, nx = gram.grid.shape[-2:]
        shaped("index", index, (None, 3))
        nz = gram.grid.shape[0] if gram.grid.ndim == 3 else 1
        if len(index) and not ((index >= 0) & (index < (nz, ny, nx))).all():
            raise ValueError(f"index must lie in the grid of {nz} × {ny} × {nx} voxels, z, y, x")
        kernels = (gram.lag_kernels() * scale).float()
        lags, (py, px) = kernels.shape[1], kernels.shape[-2:]
        # Lags from −(n − 1) to n − 1 in a row, mirrored along x: the lag falls with the x of the
        # voxel read.
        kernels = kernels[..., torch.arange(1 - ny, ny) % py, :][
            ..., torch.arange(nx - 1, -nx, -1) % px
        ]
        near = np.ascontiguousarray(kernels.permute(1, 2, 0, 3, 4).numpy())
        polynomials = np.ascontiguousarray(gram.polynomials.float().numpy())
        slices = np.searchsorted(index[:, 0], np.arange(nz + 1))
        counts = np.diff(slices)
        size = 4 * sum(int(counts[: nz - b] @ counts[b:]) for b in range(lags))
        if size > LARGEST:
            raise ValueError(
                f"the vessel holds {len(index)} voxels, whose operator would take {size / 1e9:.1f} "
                "GB: take larger voxels or a smaller inset"
            )
        planes = [np.ascontiguousarray(index[slices[z] : slices[z + 1], 1:]) for z in range(nz)]
        runs = [_runs(p) for p in planes]
        blocks = {}
        for b in range(lags):
            for z in range(nz - b):
                if len(planes[z]) and len(planes[z + b]):
                    out = np.empty((len(planes[z + b]), len(planes[z])), np.float32)
                    work = 4 * len(polynomials) * out.shape[1]
                    run(
                        gather_block,
                        len(out),
                        near[b, z],
                        polynomials,
                        planes[z + b],
                        runs[z],
                        out,
                        operations=work,
                    )
                    blocks[z, b] = out
        return cls(blocks, slices)

    def apply(self, x: Floats) -> Floats:
        """G x of columns ``(n, k)`` float32."""
        out = np.zeros_like(x)
        if x.shape[1] == 1:
            self._apply_single(x[:, 0], out[:, 0])
            return out
        at, parts = self.slices, self._used(x)
        for (z, b), block in self.blocks.items():
            for of, to, turned in ((z, z + b, False), (z + b, z, True)) if b else ((z, z, False),):
                columns, part = parts[of]
                if len(columns):
                    out[at[to] : at[to + 1], columns] += (block.T if turned else block) @ part
        return out

    def _apply_single(self, x: Floats, out: Floats) -> None:
        at = self.slices
        for (z, b), block in self.blocks.items():
            here, there = slice(at[z], at[z + 1]), slice(at[z + b], at[z + b + 1])
            if b:
                symmetric_step(block, x[here], x[there], out[here], out[there])
            else:
                out[there] += block @ x[here]

    def curvature(self, x: Floats) -> NDArray[np.float64]:
        """xᵀ G x of columns ``(n, k)`` float32, ``(k, k)``."""
        parts = self._used(x)
        out = np.zeros((x.shape[1], x.shape[1]))
        for (z, b), block in self.blocks.items():
            (columns, here), (others, there) = parts[z], parts[z + b]
            if len(columns) and len(others):
                met = there.T @ (block @ here)
                out[np.ix_(others, columns)] += met
                if b:
                    out[np.ix_(columns, others)] += met.T
        return out

    def energies(self, x: Floats) -> NDArray[np.float64]:
        """xᵀ G x of every row of ``(k, n)`` float32."""
        at = self.slices
        parts = []
        for z in range(len(at) - 1):
            part = x[:, at[z] : at[z + 1]]
            rows = np.flatnonzero(part.any(0))
            parts.append((rows, part[:, rows].T))
        out = np.zeros(len(x))
        for (z, b), block in self.blocks.items():
            (rows, here), (others, there) = parts[z], parts[z + b]
            if len(rows) and len(others):
                met = block[np.ix_(others, rows)] @ here
                out += (2.0 if b else 1.0) * np.einsum("nk,nk->k", met, there)
        return out

    def _used(self, x: Floats) -> list[tuple[NDArray[np.int64], Floats]]:
        """Columns that are not 0 on a slice, and what they are there: a spline's reach only a
        few slices."""
        found = []
        for z in range(len(self.slices) - 1):
            part = x[self.slices[z] : self.slices[z + 1]]
            columns = np.flatnonzero(part.any(0))
            found.append((columns, part[:, columns]))
        return found

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
    """``(runs, 4)`` y, first x, first position, count of voxels ``(n, 2)`` that lie side by side
    along x."""
    first = np.flatnonzero(np.any(np.diff(plane, axis=0, prepend=-2) != (0, 1), axis=1))
    count = np.diff(first, append=len(plane))
    return np.column_stack([plane[first], first, count])
