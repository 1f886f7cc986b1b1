"""Inner iterations of PWLS: preconditioned nonlinear conjugate gradients on the FFT model of the data term."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from recon.pwls.qggmrf import BoundPrior

__all__ = ["ModelSolver", "dot"]

# Steps below this many units of rounding of the first one are noise.
ROUNDING = 30.0


def dot(a: Tensor, b: Tensor, axes: int) -> Tensor:
    """Inner products over the last ``axes`` axes, accumulated in float64."""
    return (a * b).sum(dim=tuple(range(-axes, 0)), dtype=torch.float64)


class ModelSolver:
    """Minimises d ↦ gᵀd + ½ dᵀG d + R(x + d) for a model G of the data term's Hessian.

    Args:
        gram: ``apply(x)`` and ``periodic_spectrum()``.
        prior: R.
        shape: of one volume.
        dtype, device: of the volumes.
        reduction: stop when the preconditioned gradient norm has fallen by this factor.
        most: largest number of iterations.
    """

    def __init__(
        self,
        gram: Any,
        prior: BoundPrior,
        shape: tuple[int, ...] | torch.Size,
        dtype: torch.dtype,
        device: torch.device,
        reduction: float = 3e-3,
        most: int = 60,
    ) -> None:
        self.gram, self.prior, self.reduction, self.most = gram, prior, reduction, most
        self._floor: Tensor | None = None
        self.shape = tuple(shape)
        self._data = gram.periodic_spectrum().to(device=device, dtype=dtype)
        self._prior = prior.spectrum(self.shape).to(device=device, dtype=dtype)

    def _precondition(self, q: Tensor, share: float) -> Tensor:
        axes = tuple(range(-len(self.shape), 0))
        spectrum = torch.fft.rfftn(q, dim=axes) / (self._data + share * self._prior)
        return torch.fft.irfftn(spectrum, s=self.shape, dim=axes)

    def step(self, x: Tensor, data_gradient: Tensor) -> tuple[Tensor, int]:
        """The minimising d, ``(batch, *shape)``, and the number of iterations (applications of G)."""
        prior, axes = self.prior, len(self.shape)
        one = [1] * axes
        d = torch.zeros_like(x)
        model = data_gradient
        q = model + prior.gradient(x)
        share = self._mean_share(x)
        z = self._precondition(q, share)
        qz = dot(q, z, axes)
        if self._floor is None:  # rounding: the first, largest energy sets what later steps can resolve
            self._floor = qz * (ROUNDING * torch.finfo(x.dtype).eps) ** 2
        goal = torch.maximum(qz * self.reduction**2, self._floor)
        if bool((qz <= self._floor).all()):
            return d, 0
        s = -z
        at = x
        count = 0
        while count < self.most:
            curved = self.gram.apply(s)
            count += 1
            slope, bend = dot(model, s, axes), dot(s, curved, axes)
            alpha = torch.zeros_like(slope)
            for _ in range(2):  # majorise and minimise along s
                there = at + alpha.to(x.dtype).reshape(-1, *one) * s
                pull, stiffness = prior.along(there, s, s)
                total = bend + stiffness
                # A slightly indefinite model must not reverse the step.
                move = (slope + alpha * bend + pull) / total.clamp_min(1e-300)
                alpha = torch.where(total > 0, alpha - move, alpha)
            a = alpha.to(x.dtype).reshape(-1, *one)
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
            s = -z + beta.clamp_min(0).to(x.dtype).reshape(-1, *one) * s
        return d, count

    def _mean_share(self, x: Tensor) -> float:
        """Mean curvature of the prior at x relative to that at gradient 0, for the preconditioner."""
        prior = self.prior
        if prior.lam == 0 or x.shape[0] == 0:
            return 0.0
        ratio = [float(prior.curvature(t).mean()) for t in prior.gradients(x[:1]) if t.numel()]
        top = float(prior.curvature(torch.zeros(1, dtype=x.dtype, device=x.device)))
        return max(sum(ratio) / max(len(ratio), 1) / top, 1e-3)
