# mypy: ignore-errors
"""Triton counterparts of the kernels in :mod:`recon.mbir.bilateral` for CUDA: one lane a voxel,
sums over neighbours.

Both passes gather, so there are no atomics and the results are the same bits every time.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

_BLOCK = 256
"""Voxels of one program."""


@triton.jit
def _neighbour(k, offsets, weights, i, nz, ny, nx, voxels):
    """How far along the volume neighbour ``k`` of voxels ``i`` lies, whether it is inside, and
    its weight in space."""
    dz, dy, dx = (
        tl.load(offsets + 3 * k),
        tl.load(offsets + 3 * k + 1),
        tl.load(offsets + 3 * k + 2),
    )
    x, y, z = i % nx + dx, i // nx % ny + dy, i // (nx * ny) + dz
    valid = (i < voxels) & (z >= 0) & (z < nz) & (y >= 0) & (y < ny) & (x >= 0) & (x < nx)
    return (dz * ny + dy) * nx + dx, valid, tl.where(valid, tl.load(weights + k), 0.0)


@triton.jit
def _forward_kernel(
    u, g, scale, offsets, weights, out, total, nz, ny, nx, voxels, count, BLOCK: tl.constexpr
):
    batch = tl.program_id(1)
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < voxels
    base = batch.to(tl.int64) * voxels
    s = tl.load(scale + batch)
    quarter = 0.25 * s * s
    here, mine = tl.load(g + base + i, inside, 0.0), tl.load(u + base + i, inside, 0.0)
    sums, counts = tl.zeros((BLOCK,), tl.float32), tl.full((BLOCK,), 1.0, tl.float32)
    k = count * 0  # while loops: the interpreter cannot take a tensor as the end of a range
    while k < count:
        step, valid, near = _neighbour(k, offsets, weights, i, nz, ny, nx, voxels)
        j = base + i + step
        d = tl.load(g + j, valid, 0.0) - here
        r = tl.maximum(1.0 - d * d * quarter, 0.0)
        w = near * r * r
        sums += w * (tl.load(u + j, valid, 0.0) - mine)
        counts += w
        k += 1
    tl.store(out + base + i, mine + sums / counts, inside)
    tl.store(total + base + i, counts, inside)


@triton.jit
def _backward_kernel(
    u,
    g,
    scale,
    offsets,
    weights,
    out,
    total,
    grad,
    grad_u,
    grad_g,
    nz,
    ny,
    nx,
    voxels,
    count,
    BLOCK: tl.constexpr,
):
    batch = tl.program_id(1)
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < voxels
    base = batch.to(tl.int64) * voxels
    s = tl.load(scale + batch)
    quarter = 0.25 * s * s
    here, mine = tl.load(g + base + i, inside, 0.0), tl.load(u + base + i, inside, 0.0)
    own = tl.load(grad + base + i, inside, 0.0) / tl.load(total + base + i, inside, 1.0)
    made = tl.load(out + base + i, inside, 0.0)
    of_u, of_g = own, tl.zeros((BLOCK,), tl.float32)
    k = count * 0
    while k < count:
        step, valid, near = _neighbour(k, offsets, weights, i, nz, ny, nx, voxels)
        j = base + i + step
        d = tl.load(g + j, valid, 0.0) - here
        r = tl.maximum(1.0 - d * d * quarter, 0.0)
        w = near * r
        other = tl.load(grad + j, valid, 0.0) / tl.load(total + j, valid, 1.0)
        of_u += w * r * other
        # dw/dd = −s r d scale²: by g here with the other sign, and as a neighbour of j.
        slope = w * d * 4.0 * quarter
        of_g += slope * own * (tl.load(u + j, valid, 0.0) - made)
        of_g += slope * other * (mine - tl.load(out + j, valid, 0.0))
        k += 1
    tl.store(grad_u + base + i, of_u, inside)
    tl.store(grad_g + base + i, of_g, inside)


def _arguments(u: Tensor, offsets: Tensor) -> tuple[tuple[int, int], tuple[int, ...]]:
    batch, nz, ny, nx = u.shape
    voxels = nz * ny * nx
    return (triton.cdiv(voxels, _BLOCK), batch), (nz, ny, nx, voxels, len(offsets))


def forward(
    u: Tensor, g: Tensor, scale: Tensor, offsets: Tensor, weights: Tensor
) -> tuple[Tensor, Tensor]:
    """The filtered volumes and the sums of weights, ``(batch, z, y, x)`` float32.

    Args:
        u, g: volumes and guide, contiguous float32.
        scale: ``(batch,)`` one over the threshold.
        offsets, weights: ``(n, 3)`` int32 and ``(n,)`` float32.
    """
    out, total = torch.empty_like(u), torch.empty_like(u)
    programs, sizes = _arguments(u, offsets)
    _forward_kernel[programs](u, g, scale, offsets, weights, out, total, *sizes, BLOCK=_BLOCK)
    return out, total


def backward(
    u: Tensor,
    g: Tensor,
    scale: Tensor,
    offsets: Tensor,
    weights: Tensor,
    out: Tensor,
    total: Tensor,
    grad: Tensor,
) -> tuple[Tensor, Tensor]:
    """Gradients by volumes and guide, given that by the filtered volumes."""
    grad_u, grad_g = torch.empty_like(u), torch.empty_like(u)
    programs, sizes = _arguments(u, offsets)
    _backward_kernel[programs](
        u, g, scale, offsets, weights, out, total, grad, grad_u, grad_g, *sizes, BLOCK=_BLOCK
    )
    return grad_u, grad_g
