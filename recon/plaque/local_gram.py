"""AᵀWA between the voxels of a vessel, as dense blocks of two slices: a product with many columns is a few GEMMs.

A vessel fills a few per cent of the inset. What a model of it changes is 0 elsewhere, so the blocks replace the
transforms of the whole inset, hundreds of them in one fit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from recon.plaque.kernels import gather_block, symmetric_step
from torchpcct.threads import run

__all__ = ["LocalGram"]

Floats = NDArray[np.floating[Any]]

LARGEST = 1_500_000_000
"""Bytes that the blocks may take."""


_RANK = 5e-4
"""Share of a column's norm that may be lost where a slice's columns are written in fewer."""


@dataclass(frozen=True, eq=False)
class _Packed:
    """Columns of one slice, ``basis @ mix``.

    Neighbouring splines times the same wave are almost the same on a slice across the vessel: fewer columns do.

    Attributes:
        rows, used: voxels and columns that are not 0.
        basis: ``(rows, q)``; mix: ``(q, used)``.
    """

    rows: NDArray[np.int64]
    used: NDArray[np.int64]
    basis: Floats
    mix: Floats


def _packed(part: Floats) -> _Packed | None:
    there = part != 0
    rows, used = np.flatnonzero(there.any(1)), np.flatnonzero(there.any(0))
    if not len(rows):
        return None
    columns = part[np.ix_(rows, used)]
    norm = np.sqrt(np.einsum("nk,nk->k", columns, columns))
    unit = columns / norm
    exact = unit.astype(np.float64)
    values, vectors = np.linalg.eigh(exact.T @ exact)
    kept = vectors[:, values > _RANK**2].astype(part.dtype)
    return _Packed(rows, used, unit @ kept, kept.T * norm)


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
                    work = 4 * len(polynomials) * out.shape[1]
                    run(gather_block, len(out), near[b, z], polynomials, planes[z + b], runs[z], out, operations=work)
                    blocks[z, b] = out
        return cls(blocks, slices)

    def apply(self, x: Floats) -> Floats:
        """G x of columns ``(n, k)`` float32."""
        out = np.zeros_like(x)
        if x.shape[1] == 1:
            self._apply_one(x[:, 0], out[:, 0])
            return out
        at, parts = self.slices, self._pack(x)
        for (z, b), block in self.blocks.items():
            for of, to, turned in ((z, z + b, False), (z + b, z, True)) if b else ((z, z, False),):
                p = parts[of]
                if p is not None:
                    near = block[p.rows].T if turned else block[:, p.rows]
                    out[at[to] : at[to + 1], p.used] += (near @ p.basis) @ p.mix
        return out

    def _apply_one(self, x: Floats, out: Floats) -> None:
        at = self.slices
        for (z, b), block in self.blocks.items():
            here, there = slice(at[z], at[z + 1]), slice(at[z + b], at[z + b + 1])
            if b:
                symmetric_step(block, x[here], x[there], out[here], out[there])
            else:
                out[there] += block @ x[here]

    def curvature(self, x: Floats) -> NDArray[np.float64]:
        """xᵀ G x of columns ``(n, k)`` float32, ``(k, k)``."""
        parts = self._pack(x)
        out = np.zeros((x.shape[1], x.shape[1]))
        for (z, b), block in self.blocks.items():
            here, there = parts[z], parts[z + b]
            if here is not None and there is not None:
                met = there.basis.T @ (block[np.ix_(there.rows, here.rows)] @ here.basis)
                met = there.mix.T @ met @ here.mix
                out[np.ix_(there.used, here.used)] += met
                if b:
                    out[np.ix_(here.used, there.used)] += met.T
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

    def _pack(self, x: Floats) -> list[_Packed | None]:
        at = self.slices
        return [_packed(x[at[z] : at[z + 1]]) for z in range(len(at) - 1)]

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
