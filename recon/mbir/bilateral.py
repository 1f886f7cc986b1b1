"""The joint bilateral filter as a differentiable layer: a mean over the neighbours that look alike
in a guide.

    out_i = Σ_j s(i − j) ρ((g_j − g_i) / t) u_j / Σ_j s(i − j) ρ((g_j − g_i) / t)

s is a Gaussian in space, ρ(x) = (1 − x²/4)² within ``|x| < 2`` and 0 beyond (Tukey's biweight;
about exp(−x²/2), at a fraction of its cost). Constants pass through, a turned volume gives the
turned result, and a neighbour beyond an edge of the guide does not count at all: so edges keep
their place and height, and no voxel is pushed beyond its neighbours. After FBP it is the strongest
simple filter for plaques (:mod:`recon.filters`); here it is one of the network's views of the data
(:mod:`recon.mbir.network`).
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from torchpcct.devices import require_triton
from torchpcct.threads import run
from torchpcct.validate import number, shaped, whole

_LEAST = 1e-12
"""Of a threshold: its square is a float32 still."""


@cache
def _offsets(reach: float, step: int) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """``(n, 3)`` neighbours z, y, x within twice the reach, and their weights."""
    radius = math.floor(2.0 * reach / step + 1e-9)
    axis = step * np.arange(-radius, radius + 1)
    at = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    square = np.square(at).sum(1)
    kept = (square <= (2.0 * reach) ** 2) & (square > 0)
    return at[kept].astype(np.int64), np.exp(-0.5 * square[kept] / reach**2).astype(np.float32)


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _forward(begin, end, u, g, scale, offsets, weights, out, total):
    """Rows (batch · z · y) ``begin … end``: the filtered volume and the sums of weights."""
    nz, ny, nx = u.shape[1:]
    for row in range(begin, end):
        b, z, y = row // (nz * ny), row // ny % nz, row % ny
        quarter = np.float32(0.25) * scale[b] * scale[b]
        here, mine = g[b, z, y], u[b, z, y]
        sums, counts = out[b, z, y], total[b, z, y]
        sums[:] = 0.0
        counts[:] = 1.0
        for k in range(len(weights)):
            zz, yy, dx = z + offsets[k, 0], y + offsets[k, 1], offsets[k, 2]
            if zz < 0 or zz >= nz or yy < 0 or yy >= ny:
                continue
            first, last = max(0, -dx), min(nx, nx - dx)
            s, there, values = weights[k], g[b, zz, yy], u[b, zz, yy]
            for x in range(first, last):
                d = there[x + dx] - here[x]
                r = max(np.float32(1.0) - d * d * quarter, np.float32(0.0))
                w = s * r * r
                sums[x] += w * (values[x + dx] - mine[x])
                counts[x] += w
        for x in range(nx):
            sums[x] = mine[x] + sums[x] / counts[x]


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _backward(begin, end, u, g, scale, offsets, weights, out, total, grad, grad_u, grad_g):
    """Gradients by volume and guide, gathered: what row ``begin … end`` gives to others, and
    they to it."""
    nz, ny, nx = u.shape[1:]
    for row in range(begin, end):
        b, z, y = row // (nz * ny), row // ny % nz, row % ny
        quarter = np.float32(0.25) * scale[b] * scale[b]
        for x in range(nx):
            grad_u[b, z, y, x] = grad[b, z, y, x] / total[b, z, y, x]
            grad_g[b, z, y, x] = 0.0
        for k in range(len(weights)):
            zz, yy, dx = z + offsets[k, 0], y + offsets[k, 1], offsets[k, 2]
            if zz < 0 or zz >= nz or yy < 0 or yy >= ny:
                continue
            first, last = max(0, -dx), min(nx, nx - dx)
            s = weights[k]
            for x in range(first, last):
                j = x + dx
                d = g[b, zz, yy, j] - g[b, z, y, x]
                r = max(np.float32(1.0) - d * d * quarter, np.float32(0.0))
                own = grad[b, z, y, x] / total[b, z, y, x]
                other = grad[b, zz, yy, j] / total[b, zz, yy, j]
                grad_u[b, z, y, x] += s * r * r * other
                # dw/dd = −s r d scale²: by g here with the other sign, and as a neighbour of j.
                slope = s * r * d * np.float32(4.0) * quarter
                grad_g[b, z, y, x] += slope * own * (u[b, zz, yy, j] - out[b, z, y, x])
                grad_g[b, z, y, x] += slope * other * (u[b, z, y, x] - out[b, zz, yy, j])


class _Bilateral(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, u: Tensor, guide: Tensor, threshold: Tensor, reach: float, step: int
    ) -> Tensor:
        values, g = (v.detach().float().contiguous() for v in (u, guide))
        # Where there is no noise (and so no threshold) every difference is an edge.
        scale = 1.0 / threshold.detach().float().clamp_min(_LEAST)
        offsets, weights = _offsets(reach, step)
        if u.device.type != "cpu":
            require_triton(u.device, "the bilateral filter")
            from recon.mbir import bilateral_triton  # where there is a GPU

            near = (
                torch.from_numpy(offsets).int().to(u.device),
                torch.from_numpy(weights).to(u.device),
            )
            out, total = bilateral_triton.forward(values, g, scale, *near)
            ctx.kept = (values, g, scale, *near, out, total, u.dtype)
            return out.to(u.dtype)
        out, total = torch.empty_like(values), torch.empty_like(values)
        rows = math.prod(values.shape[:3])
        given = [v.numpy() for v in (values, g, scale)]
        run(
            _forward,
            rows,
            *given,
            offsets,
            weights,
            out.numpy(),
            total.numpy(),
            operations=8 * len(weights) * values.shape[3],
        )
        ctx.kept = (values, g, scale, offsets, weights, out, total, u.dtype)
        return out.to(u.dtype)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Any:
        values, g, scale, offsets, weights, out, total, dtype = ctx.kept
        slope = grad.detach().float().contiguous()
        if grad.device.type != "cpu":
            from recon.mbir import bilateral_triton

            found = bilateral_triton.backward(values, g, scale, offsets, weights, out, total, slope)
        else:
            found = torch.empty_like(values), torch.empty_like(values)
            rows = math.prod(values.shape[:3])
            given = [v.numpy() for v in (values, g, scale)]
            kept = [v.numpy() for v in (out, total, slope, *found)]
            run(
                _backward,
                rows,
                *given,
                offsets,
                weights,
                *kept,
                operations=20 * len(weights) * values.shape[3],
            )
        return (*(f.to(dtype) for f in found), None, None, None)


def joint_bilateral(
    u: Tensor, guide: Tensor, threshold: Tensor, reach: float = 2.5, step: int = 1
) -> Tensor:
    """Filtered volumes ``(batch, z, y, x)``, differentiable in volume and guide; in float32, on the
    device of ``u``.

    Args:
        u: volumes.
        guide: of the same shape, so smooth that its differences are edges and not noise.
        threshold: ``(batch,)`` differences of the guide that weigh about exp(−½) (t above).
        reach: standard deviation of s in voxels; it ends at twice that.
        step: only every so many voxels along each axis are neighbours: of smooth volumes the others
            add nothing.

    Raises:
        ValueError: volumes that have not four axes, a guide or thresholds that do not belong to
            them, a reach ≤ 0, a step < 1.
    """
    shaped("u", u, (None, None, None, None))
    shaped("guide", guide, tuple(u.shape))
    shaped("threshold", threshold, (u.shape[0],))
    number("reach", reach, positive=True, unit="voxels")
    whole("step", step)
    found: Tensor = _Bilateral.apply(u, guide, threshold, reach, step)
    return found
