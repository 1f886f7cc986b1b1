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
from torch.nn import functional as F

from torchpcct.devices import require_triton
from torchpcct.threads import run
from torchpcct.validate import number, shaped, whole

_LEAST = 1e-12
"""Of a threshold: its square is a float32 still."""
_AT_ONCE = 16
"""float32 that a processor computes at once at most."""


@cache
def _offsets(reach: float, step: int) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """``(n, 3)`` neighbours z, y, x within twice the reach, and their weights."""
    radius = math.floor(2.0 * reach / step + 1e-9)
    axis = step * np.arange(-radius, radius + 1)
    at = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    square = np.square(at).sum(1)
    kept = (square <= (2.0 * reach) ** 2) & (square > 0)
    return at[kept].astype(np.int64), np.exp(-0.5 * square[kept] / reach**2).astype(np.float32)


def _padded(v: Tensor, beyond: int, fill: float = 0.0) -> NDArray[np.float32]:
    """Rows of ``(batch, z, y, x)`` with ``beyond`` voxels more at both ends, and filled up to a
    multiple of what a processor computes at once: then every neighbour along a row exists, and no
    row has a rest that is computed number by number, which took five sixths of the time."""
    return F.pad(v, (beyond, beyond + -v.shape[-1] % _AT_ONCE), value=fill).numpy()


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _forward(begin, end, u, g, scale, offsets, weights, beyond, out, total):
    """Rows (batch · z · y) ``begin … end``: the filtered volume and the sums of weights.

    u and g have ``beyond`` voxels more at both ends of their rows than out and total.
    """
    nz, ny, nx = out.shape[1:]
    for row in range(begin, end):
        b, z, y = row // (nz * ny), row // ny % nz, row % ny
        quarter = np.float32(0.25) * scale[b] * scale[b]
        g0, u0 = g[b, z, y, beyond : beyond + nx], u[b, z, y, beyond : beyond + nx]
        sums, counts = out[b, z, y], total[b, z, y]
        sums[:] = 0.0
        counts[:] = 1.0
        for k in range(len(weights)):
            zz, yy, at = z + offsets[k, 0], y + offsets[k, 1], beyond + offsets[k, 2]
            if zz < 0 or zz >= nz or yy < 0 or yy >= ny:
                continue
            s, g1, u1 = weights[k], g[b, zz, yy, at : at + nx], u[b, zz, yy, at : at + nx]
            for x in range(nx):
                d = g1[x] - g0[x]
                r = max(np.float32(1.0) - d * d * quarter, np.float32(0.0))
                w = s * r * r
                sums[x] += w * (u1[x] - u0[x])
                counts[x] += w
        for x in range(nx):
            sums[x] = u0[x] + sums[x] / counts[x]


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _backward(begin, end, u, g, scale, offsets, weights, beyond, out, share, grad_u, grad_g):
    """Gradients by volume and guide, gathered: what row ``begin … end`` gives to others, and
    they to it.

    share: the gradient over the sum of weights; it, u, g and out have longer rows, as above.
    """
    nz, ny, nx = grad_u.shape[1:]
    here = slice(beyond, beyond + nx)
    for row in range(begin, end):
        b, z, y = row // (nz * ny), row // ny % nz, row % ny
        quarter = np.float32(0.25) * scale[b] * scale[b]
        u0, g0, out0, share0 = (
            u[b, z, y, here],
            g[b, z, y, here],
            out[b, z, y, here],
            share[b, z, y, here],
        )
        by_u, by_g = grad_u[b, z, y], grad_g[b, z, y]
        by_u[:] = share0
        by_g[:] = 0.0
        for k in range(len(weights)):
            zz, yy, at = z + offsets[k, 0], y + offsets[k, 1], beyond + offsets[k, 2]
            if zz < 0 or zz >= nz or yy < 0 or yy >= ny:
                continue
            s, there = weights[k], slice(at, at + nx)
            u1, g1, out1, share1 = (
                u[b, zz, yy, there],
                g[b, zz, yy, there],
                out[b, zz, yy, there],
                share[b, zz, yy, there],
            )
            for x in range(nx):
                d = g1[x] - g0[x]
                r = max(np.float32(1.0) - d * d * quarter, np.float32(0.0))
                w = s * r
                by_u[x] += w * r * share1[x]
                # dw/dd = −s r d scale²: by g here with the other sign, and as a neighbour of g1.
                by_g[x] += w * d * (share0[x] * (u1[x] - out0[x]) + share1[x] * (u0[x] - out1[x]))
        for x in range(nx):
            by_g[x] *= np.float32(4.0) * quarter


def on_cpu(
    u: Tensor, g: Tensor, scale: Tensor, offsets: NDArray[np.int64], weights: NDArray[np.float32]
) -> tuple[tuple[Any, ...], Tensor, Tensor]:
    """What the kernels were given, the filtered volumes and the sums of weights; arguments as of
    :func:`recon.mbir.bilateral_triton.forward`."""
    beyond, nx = int(offsets[:, 2].max(initial=0)), u.shape[-1]
    out, total = (torch.empty(*u.shape[:-1], nx + -nx % _AT_ONCE) for _ in range(2))
    # Beyond the ends of its rows the guide is so far from all its values that nothing counts.
    finite = torch.nan_to_num(g, 0.0, 0.0, 0.0)
    apart = float(2.0 * finite.abs().amax() + 4.0 / scale.amin()) if g.numel() else 0.0
    given = (
        _padded(u, beyond),
        _padded(g, beyond, apart),
        scale.numpy(),
        offsets,
        weights,
        beyond,
    )
    run(
        _forward,
        math.prod(u.shape[:3]),
        *given,
        out.numpy(),
        total.numpy(),
        operations=8 * len(weights) * nx,
    )
    return given, out[..., :nx].contiguous(), total[..., :nx].contiguous()


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
            ctx.kept = ((values, g, scale, *near), out, total, u.dtype)
            return out.to(u.dtype)
        given, out, total = on_cpu(values, g, scale, offsets, weights)
        ctx.kept = (given, out, total, u.dtype)
        return out.to(u.dtype)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Any:
        given, out, total, dtype = ctx.kept
        slope = grad.detach().float().contiguous()
        if grad.device.type != "cpu":
            from recon.mbir import bilateral_triton

            u, g, scale, *near = given
            found = bilateral_triton.backward(u, g, scale, near[0], near[1], out, total, slope)
        else:
            *_, weights, beyond = given
            nx = out.shape[-1]
            made = [torch.empty(*out.shape[:-1], nx + -nx % _AT_ONCE) for _ in range(2)]
            run(
                _backward,
                math.prod(out.shape[:3]),
                *given,
                _padded(out, beyond),
                _padded(slope / total, beyond),
                *(v.numpy() for v in made),
                operations=15 * len(weights) * nx,
            )
            found = (made[0][..., :nx].contiguous(), made[1][..., :nx].contiguous())
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
