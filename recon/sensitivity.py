"""Worst-case response of a reconstruction to its data: the largest singular value of its Jacobian, by power iteration.

An unstable method turns a perturbation that nobody sees in the data into a structure in the image (Antun, Renna, Poon,
Adcock, Hansen 2020, PNAS 117:30088). The gain is in HU mm^1.5 per unit of whitened data: the L2 norm of the change of
the volume over the norm of the perturbation in units of each reading's standard deviation. It does not depend on the
voxel size, so methods on different grids can be compared.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from torchpcct.validate import checked, whole

__all__ = ["worst_case_gain"]


@checked
def worst_case_gain(
    reconstruct: Callable[[Tensor], Tensor],
    data: Tensor,
    covariance: Callable[[Tensor], Tensor],
    voxel_mm: float,
    *,
    iterations: int = 20,
    seed: int = 0,
) -> tuple[float, Tensor]:
    """Largest √(eigenvalue) of J C Jᵀ at ``data``.

    Args:
        reconstruct: data → volume in HU, twice differentiable (a linear method is).
        data: where the Jacobian J is taken: line integrals, or a statistic of them.
        covariance: C, the covariance of the data: the variance of each line integral as a factor, or the Gram operator
            for b = AᵀW y.
        voxel_mm: size of the cubic voxels.
        iterations: of the power method; it comes from below.
        seed: of its start.

    Returns:
        Gain in HU mm^1.5 per unit of whitened data, and the worst change of the volume, of unit norm.

    Raises:
        ValueError: fewer than one iteration, or a Jacobian that is zero or not finite at these data.
    """
    whole("iterations", iterations)
    x = data.detach().clone().requires_grad_()
    out = reconstruct(x)
    v = torch.randn(out.shape, generator=torch.Generator().manual_seed(seed)).to(out)
    v = v / v.norm()
    gain = 0.0
    # A vector–Jacobian product is linear in its vector, so its derivative by the vector is J: no forward mode needed.
    probe = torch.zeros_like(out, requires_grad=True)
    (back,) = torch.autograd.grad(out, x, probe, create_graph=True)
    for _ in range(iterations):
        (transposed,) = torch.autograd.grad(out, x, v, retain_graph=True)
        (v,) = torch.autograd.grad(back, probe, covariance(transposed.detach()), retain_graph=True)
        size = float(v.norm())
        if not (math.isfinite(size) and size > 0):
            raise ValueError(f"the response to the data has norm {size}: constant or not finite at these data")
        gain, v = math.sqrt(size), v / size
    return gain * voxel_mm**1.5, v
