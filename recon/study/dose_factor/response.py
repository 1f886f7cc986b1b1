"""The linear response of a method to the noise of its data: the best linear control of its figures.

A backward pass gives g = ∂(ROI mean)/∂b, and g·b of every draw costs nothing. Any functional g·b has the exactly known
mean g·E[b] and variance gᵀ Cov(b) g of the readings' noise, whatever the method; the closer g follows the method, the
higher the correlation and the narrower the interval (:mod:`torchpcct.metrics.control`). For Gaussian noise the best g
of all is the gradient's expectation over the noise (Stein 1981, Ann. Statist. 9:1135, lemma 1), here its mean over a
few draws that serve nothing else; the gradient at the noise-free b is the cheap substitute.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.study.dose_factor.exact_linear import statistic_covariance
from torchpcct.scan import Scan

__all__ = ["RESPONSE_DRAWS", "Response", "linear_response"]

RESPONSE_DRAWS = 4
"""Of the noise that a response is averaged over, where the method counts most."""

_SEED = 1 << 40
"""Of the draws that the gradient is averaged over: apart from all realisations."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Response:
    """Linear functionals of b, one for each row, with their exact moments at one exposure.

    Attributes:
        adjoints: ``(rows, z, y, x)`` float64, g in HU per unit of b; mean: ``(rows,)``; covariance: ``(rows, rows)``
            HU².
    """

    adjoints: Tensor
    mean: Floats
    covariance: Floats

    def of(self, b: Tensor) -> Floats:
        """Of statistics ``(n, z, y, x)``: ``(n, rows)`` HU."""
        found: Floats = torch.einsum("nzyx,rzyx->nr", b.to(torch.float64), self.adjoints).numpy()
        return found


def linear_response(
    method: Callable[[Any, Tensor, float], Tensor],
    problem: Any,
    weights: Tensor,
    statistic: Tensor,
    exposure_s: float,
    clean: Scan | None,
    draws: int = 0,
) -> Response | None:
    """The response of a method's rows; None for a method that autograd cannot see through.

    Args:
        method: of :mod:`recon.study.dose_factor.methods`.
        problem: :class:`recon.pwls.inset_problem.InsetProblem` of the scan.
        weights: ``(rows, z, y, x)`` of the rows on the problem's grid.
        statistic: ``(z, y, x)`` the noise-free b with the weights of ``exposure_s``.
        exposure_s: in s.
        clean: the noise-free scan whose noise the covariance is of; None: the Gram operator's, see
            :func:`recon.study.dose_factor.exact_linear.statistic_covariance`.
        draws: of the noise that the gradient is averaged over; 0: the gradient at the noise-free b.
    """
    about = [statistic]
    if draws:
        generator = torch.Generator().manual_seed(_SEED)
        noise = problem.gram.noise((draws,), generator=generator).to(statistic) * exposure_s**0.5
        about = list(statistic + noise)
    g = torch.zeros((len(weights), *statistic.shape), dtype=torch.float64)
    for b in about:
        found = _gradients(method, problem, weights, b, exposure_s)
        if found is None:
            return None
        g += found / len(about)
    mean = torch.einsum("zyx,rzyx->r", statistic.to(torch.float64), g).numpy()
    return Response(g, mean, statistic_covariance(problem, g, exposure_s, clean))


def _gradients(
    method: Callable[[Any, Tensor, float], Tensor], problem: Any, weights: Tensor, statistic: Tensor, exposure_s: float
) -> Tensor | None:
    """``(rows, z, y, x)`` float64, of every row at one b."""
    with torch.enable_grad():
        leaf = statistic[None].clone().requires_grad_()
        volume = method(problem, leaf, exposure_s)
    if not volume.requires_grad:
        return None
    # One row at a time: a graph for all of them would hold several GB.
    gradients = [
        torch.autograd.grad(volume, leaf, w.to(volume)[None], retain_graph=k + 1 < len(weights))[0][0]
        for k, w in enumerate(weights)
    ]
    return torch.stack(gradients).to(torch.float64)
