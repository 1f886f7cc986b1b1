"""Conjugate gradients, the method by which everything quadratic in this package is solved.

:func:`conjugate_gradient` is the linear one. The nonlinear ones of PWLS
(:mod:`recon.least_squares.model_solver` inside, :mod:`recon.least_squares.pwls` outside) share
:func:`dot` and :func:`per_volume` with it, not the recursion: their gradient is computed afresh in
every step, their step length is searched for, and the next direction needs both gradients
(Polak–Ribière) or the exact curvature.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

__all__ = ["conjugate_gradient"]


def dot(a: Tensor, b: Tensor, axes: int) -> Tensor:
    """Inner products over the last ``axes`` axes, accumulated in float64."""
    return (a * b).sum(dim=tuple(range(-axes, 0)), dtype=torch.float64)


def per_volume(factor: Tensor, like: Tensor) -> Tensor:
    """One factor for every volume, ``(batch,)``, in the dtype of the volumes ``(batch, …)``,
    ready to multiply them."""
    return factor.to(like.dtype).reshape(-1, *[1] * (like.dim() - 1))


def conjugate_gradient(
    apply: Callable[[Tensor], Tensor],
    right: Tensor,
    precondition: Callable[[Tensor], Tensor],
    *,
    iterations: int,
    tolerance: float = 0.0,
) -> Tensor:
    """Solve H x = right for every vector of a batch, from x = 0 (Hestenes, Stiefel 1952).

    Args:
        apply: x ↦ H x, symmetric and positive definite.
        right: ``(batch, ...)``.
        precondition: about H⁻¹, symmetric and positive definite.
        iterations: largest number of them.
        tolerance: stop when the norm of the residual, in the metric of the preconditioner, has
            fallen by this factor for all.

    Returns:
        x like ``right``.
    """
    axes = right.dim() - 1
    x, left = torch.zeros_like(right), right
    step = z = precondition(left)
    size = dot(left, z, axes)
    goal = tolerance**2 * size
    for _ in range(iterations):
        curved = apply(step)
        alpha = per_volume(size / dot(step, curved, axes).clamp_min(1e-300), x)
        x, left = x + alpha * step, left - alpha * curved
        z = precondition(left)
        before, size = size, dot(left, z, axes)
        # Asked only where it may happen: on a GPU the question waits for all that was asked before.
        if tolerance and bool((size <= goal).all()):
            break
        step = z + per_volume(size / before.clamp_min(1e-300), x) * step
    return x
