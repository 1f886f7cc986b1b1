"""The linear response of MBIR to the noise of its data: the best linear control of its figures.

A backward pass gives g = ∂(ROI mean)/∂b of b = AᵀW y, and g·b of every realisation costs nothing.
Every functional g·b has the exactly known mean g·E[b] and covariance gᵀ Cov(b) g of the readings'
noise, whatever the method; the closer g follows the method, the higher the correlation, and the
fewer realisations an interval needs (:mod:`torchpcct.metrics.control`). For Gaussian noise the best
g of all is the gradient's expectation over the noise (Stein 1981, Ann. Statist. 9:1135, lemma 1),
here its mean over a few realisations that serve nothing else.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.analytic.exact_noise import line_integral_variance
from recon.data_term import Quadratic
from recon.least_squares.inset_problem import InsetProblem
from torchpcct.scan import NOISE_FREE_EXPOSURE_S, Scan

_DRAWS = 2
"""Of the noise that the gradient is averaged over."""
_SEED = 1 << 40
"""Of these realisations: apart from all realisations."""


def response(
    method: Callable[[Quadratic], Tensor],
    problem: InsetProblem,
    weights: Tensor,
    term: Quadratic,
    exposure_s: float,
) -> Tensor:
    """g of every functional, HU per unit of b, ``(rows, z, y, x)`` float64.

    Args:
        method: from data terms to volumes in HU, differentiable in their b.
        problem: of the scan.
        weights: ``(rows, z, y, x)`` of the functionals of the volume.
        term: of noise-free data at ``exposure_s``, a batch of one.
        exposure_s: in s.
    """
    generator = torch.Generator().manual_seed(_SEED)
    noise = problem.gram.noise((_DRAWS,), generator=generator).to(term.b) * exposure_s**0.5
    g = torch.zeros((len(weights), *term.b.shape[1:]), dtype=torch.float64)
    for b in term.b + noise:
        with torch.enable_grad():
            leaf = b[None].clone().requires_grad_()
            volume = method(replace(term, b=leaf))
        # One row at a time: a graph for all of them would hold several GB.
        for k, w in enumerate(weights):
            kept = k + 1 < len(weights)
            g[k] += (
                torch.autograd.grad(volume, leaf, w.to(volume)[None], retain_graph=kept)[0][
                    0
                ].double()
                / _DRAWS
            )
    return g


def right_hand_side_covariance(
    problem: InsetProblem, g: Tensor, exposure_s: float, clean: Scan
) -> NDArray[np.float64]:
    """gᵢᵀ Cov(b) gⱼ of functionals ``(m, z, y, x)`` of b = AᵀW y with the weights of an exposure,
    ``(m, m)``.

    The weights W are those of the background, the readings' variances V those of the whole
    noise-free scan ``clean`` (delta method for their logarithm), so Cov(b) = AᵀW V W A: one
    projection per functional.

    Raises:
        ValueError: a scan that is noisy, or of another window than the problem's.
    """
    if clean.window != problem.outer or clean.geometry != problem.geometry:
        raise ValueError(
            "this scan has another geometry or window than the one the problem was made for"
        )
    variance = line_integral_variance(clean.crop(problem.window), exposure_s)
    root = problem.weights * (exposure_s / NOISE_FREE_EXPOSURE_S) * variance.sqrt()
    rows = torch.stack([(problem.projector(v.to(root.dtype)) * root).flatten(1) for v in g])
    total = torch.zeros((len(g), len(g)), dtype=torch.float64)
    for view in range(rows.shape[1]):  # one view in float64 at a time
        part = rows[:, view].to(torch.float64)
        total += part @ part.T
    return np.asarray(total.numpy())
