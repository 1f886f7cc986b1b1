"""Inner iterations of PWLS: preconditioned nonlinear conjugate gradients on the FFT model of the
data term."""

from __future__ import annotations

import torch
from torch import Tensor

from recon.conjugate_gradient import dot, per_volume
from recon.data_term import NormalOperator
from recon.least_squares.qggmrf import BoundPrior

ROUNDING = 30.0
"""Steps below this many units of rounding of the first one are noise."""
REDUCTION = 3e-3
"""Iterations end when the norm of the preconditioned gradient has fallen by this factor."""
MOST = 60
"""Iterations at most."""


class ModelSolver:
    """Minimises d ↦ gᵀd + ½ dᵀG d + R(x + d) for a model G of the data term's Hessian.

    Args:
        gram: G.
        prior: R.
        x: volumes ``(batch, *shape)``; only their shape, dtype and device matter.
    """

    def __init__(self, gram: NormalOperator, prior: BoundPrior, x: Tensor) -> None:
        self.gram, self.prior = gram, prior
        self._floor: Tensor | None = None
        self._grid = x.shape[-len(prior.spacing) :]
        self._data = gram.periodic_spectrum().to(x)
        self._prior = prior.spectrum(self._grid).to(x)

    def _precondition(self, q: Tensor, share: float) -> Tensor:
        axes = tuple(range(-len(self._grid), 0))
        spectrum = torch.fft.rfftn(q, dim=axes) / (self._data + share * self._prior)
        return torch.fft.irfftn(spectrum, s=self._grid, dim=axes)

    def step(self, x: Tensor, data_gradient: Tensor) -> tuple[Tensor, int]:
        """The minimising d, ``(batch, *shape)``, and the number of iterations (applications of
        G)."""
        prior, axes = self.prior, self.prior.axes
        d = torch.zeros_like(x)
        model = data_gradient
        q = model + prior.gradient(x)
        share = mean_share(prior, x)
        z = self._precondition(q, share)
        qz = dot(q, z, axes)
        # rounding: the first, largest energy sets what later steps can resolve
        if self._floor is None:
            self._floor = qz * (ROUNDING * torch.finfo(x.dtype).eps) ** 2
        goal = torch.maximum(qz * REDUCTION**2, self._floor)
        if bool((qz <= self._floor).all()):
            return d, 0
        s = -z
        at = x
        count = 0
        while count < MOST:
            curved = self.gram.apply(s)
            count += 1
            a = per_volume(line_search(prior, at, s, curved, model, start=0.0, most=2), x)
            d = d + a * s
            model = model + a * curved
            at = x + d
            old = q
            q = model + prior.gradient(at)
            z = self._precondition(q, share)
            new = dot(q, z, axes)
            if bool((new <= goal).all()):
                break
            beta = (new - dot(old, z, axes)) / qz.clamp_min(torch.finfo(torch.float64).tiny)
            qz = new
            s = -z + per_volume(beta.clamp_min(0), x) * s
        return d, count


def mean_share(prior: BoundPrior, x: Tensor) -> float:
    """Mean curvature of the prior at x relative to that at gradient 0, for preconditioners."""
    if prior.lam == 0 or x.shape[0] == 0:
        return 0.0
    ratio = [float(prior.curvature(t).mean()) for t in prior.gradients(x[:1]) if t.numel()]
    top = float(prior.curvature(torch.zeros(1, dtype=x.dtype, device=x.device)))
    return max(sum(ratio) / max(len(ratio), 1) / top, 1e-3)


def line_search(
    prior: BoundPrior,
    x: Tensor,
    step: Tensor,
    curved: Tensor,
    data_gradient: Tensor,
    *,
    start: float,
    most: int,
    tolerance: float = 0.0,
) -> Tensor:
    """α of the minimum of α gᵀs + ½ α² sᵀH s + R(x + α s) for each volume, ``(batch,)`` float64:
    majorise, minimise.

    Args:
        prior: R.
        x, step: x and s, ``(batch, *shape)``.
        curved: H s.
        data_gradient: g, the gradient of the data term at x.
        start: first α.
        most: largest number of iterations.
        tolerance: stop when no α changes by more.
    """
    slope, bend = dot(data_gradient, step, prior.axes), dot(step, curved, prior.axes)
    alpha = torch.full_like(slope, start)
    for _ in range(most):
        pull, stiffness = prior.along(x + per_volume(alpha, x) * step, step, step)
        total = bend + stiffness
        # A slightly indefinite model must not reverse the step.
        move = torch.where(
            total > 0,
            (slope + alpha * bend + pull) / total.clamp_min(1e-300),
            torch.zeros_like(total),
        )
        alpha = alpha - move
        if tolerance and float(move.abs().max()) < tolerance:
            break
    return alpha
