"""Mean, covariance and response of ROI means after a LINEAR reconstruction of b = AᵀW y, without sampling error.

A linear method is x̂ = M b + x₀, so an ROI mean r·x̂ is one inner product g·b with the adjoint g = Mᵀr. One solve per ROI
gives g, and with it

* the expectation for any scene: g·E[b] + r·x₀;
* the response to a change δb: g·δb, and so every contrast slope;
* the covariance gᵀ Cov(b) g' of the noise that is really drawn. The weights W of the problem are those of the
  background, the readings' variances V those of the whole scene, so Cov(b) = AᵀW V W A: one projection per ROI
  (:func:`statistic_covariance`). With V = W⁻¹ it is the Gram operator AᵀWA;
* the ROI means of any number of draws of b, without reconstructing: g·b. They are the controls of
  :mod:`torchpcct.metrics.control`, of known mean and covariance.

Adjoints. A converged solve (H + Q)⁻¹ is its own adjoint: the method itself is run on the ROI (``"solve"``). A fixed
number of steps is not symmetric: its adjoint is the vector-Jacobian product by autograd (``"vjp"``). Both are checked
against the forward method, and a method that is not linear is refused.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.fbp.exact_noise import line_integral_variance
from torchpcct.scan import NOISE_FREE_EXPOSURE_S, Scan
from torchpcct.validate import choice, number

__all__ = ["ExactLinear", "exact_linear", "statistic_covariance"]

Floats = NDArray[np.float64]

LINEARITY = 2e-3
"""Largest deviation of f(signal + noise) from f(signal) + f(noise), root mean square over that of f(noise). A solver
that stops at a tolerance is linear to that only: give it a tight one."""
AGREEMENT = 2e-4
"""Largest deviation of g·b from r·M b that an adjoint may have, root mean square over noise and ROIs, relative."""
_SOLVE_HU = 1e6
"""ROIs are solved for at a size of so many HU, about: a solver's tolerance of 1 HU is then of no account."""


@dataclass(frozen=True, eq=False)
class ExactLinear:
    """ROI means of a linear method at one exposure. Made by :func:`exact_linear`.

    Attributes:
        adjoints: ``(rois, z, y, x)`` float64, g in HU per unit of b.
        offset_hu: ``(rois,)`` ROI means of b = 0.
        exposure_s: exposure whose weights b is made with.
        linearity: relative deviation from linearity that was found.
        agreement: relative deviation of g·b from the reconstruction's ROI means that was found.
    """

    adjoints: Tensor
    offset_hu: Floats
    exposure_s: float
    linearity: float
    agreement: float

    def means(self, b: Tensor) -> Floats:
        """ROI means in HU of statistics ``(..., z, y, x)``, ``(..., rois)``: expectations of noise-free ones."""
        return self.response(b) + self.offset_hu

    def response(self, change: Tensor) -> Floats:
        """Change of the ROI means in HU, ``(..., rois)``, for a change of b ``(..., z, y, x)``."""
        found: Floats = torch.einsum("...zyx,rzyx->...r", change.to(torch.float64), self.adjoints).numpy()
        return found

    def covariance(self, problem: Any, clean: Scan | None = None) -> Floats:
        """Covariance of the ROI means in HU², ``(rois, rois)``; arguments of :func:`statistic_covariance`."""
        return statistic_covariance(problem, self.adjoints, self.exposure_s, clean)


def statistic_covariance(problem: Any, vectors: Tensor, exposure_s: float, clean: Scan | None = None) -> Floats:
    """gᵢᵀ Cov(b) gⱼ of functionals of b = AᵀW y with the weights of an exposure.

    Args:
        problem: :class:`recon.pwls.inset_problem.InsetProblem`.
        vectors: ``(m, z, y, x)`` g.
        exposure_s: exposure in s, of the weights and of the noise.
        clean: the noise-free scan whose readings are drawn from (delta method for their logarithm): Cov(b) = AᵀW V W A.
            None: noise of covariance V = W⁻¹, gᵀ G g, as :meth:`recon.gram.gram.Gram.noise` draws it (but for the
            position-dependent part of G, which the draws leave out).

    Returns:
        ``(m, m)`` float64.

    Raises:
        ValueError: a scan that is noisy, or of another window than the problem's.
    """
    g = vectors.to(torch.float64)
    exposure = number("exposure_s", exposure_s, positive=True, unit="s")
    if clean is None:
        applied = problem.gram.scaled(exposure).apply(g.to(torch.float32)).to(torch.float64)
        matrix = torch.einsum("azyx,bzyx->ab", g, applied).numpy()
        return np.asarray((matrix + matrix.T) / 2)
    if clean.window != problem.outer or clean.geometry != problem.geometry:
        raise ValueError("this scan has another geometry or window than the one the problem was made for")
    variance = line_integral_variance(clean.crop(problem.window), exposure)
    root = problem.weights * (exposure / NOISE_FREE_EXPOSURE_S) * variance.sqrt()
    rows = torch.stack([(problem.projector(v.to(root.dtype)) * root).flatten(1) for v in g])
    total = torch.zeros((len(g), len(g)), dtype=torch.float64)
    for view in range(rows.shape[1]):  # one view in float64 at a time
        part = rows[:, view].to(torch.float64)
        total += part @ part.T
    return np.asarray(total.numpy())


def exact_linear(
    method: Callable[[Any, Tensor, float], Tensor],
    problem: Any,
    rois: Sequence[Any],
    statistic: Tensor,
    exposure_s: float,
    adjoint: str = "auto",
    seed: int = 0,
) -> ExactLinear:
    """The exact ROI means of a linear method.

    Args:
        method: of :mod:`recon.study.dose_factor.methods`, called as ``method(problem, b, exposure_s)``; differentiable
            for ``"vjp"``. A solver with a tolerance in HU needs a tight one (0.05 HU; at 1 HU it is not linear enough).
        problem: :class:`recon.pwls.inset_problem.InsetProblem`, or what the method asks of one.
        rois: functionals with ``weights`` ``(z, y, x)``, e.g. of :class:`torchpcct.metrics.roi.RoiMean`; a single voxel
            or an observer's channel as well.
        statistic: ``(z, y, x)`` a noise-free b with the weights of ``exposure_s``: where linearity is checked.
        exposure_s: exposure in s.
        adjoint: ``"solve"``, ``"vjp"`` or ``"auto"``: the first where it proves right
            (:data:`AGREEMENT`), else the second.
        seed: of the noise that linearity is checked with.

    Raises:
        ValueError: a method that is not linear, or an adjoint that does not agree with it.
    """
    choice("adjoint", adjoint, ("auto", "solve", "vjp"))
    weights = torch.stack([torch.as_tensor(r.weights, dtype=torch.float64) for r in rois])
    b = statistic[None]
    generator = torch.Generator().manual_seed(seed)
    noise = problem.gram.scaled(exposure_s).noise((2,), generator=generator).to(b)

    def run(statistics: Tensor) -> Tensor:
        with torch.no_grad():
            return method(problem, statistics, exposure_s).to(torch.float64)

    def read(volumes: Tensor) -> Floats:
        return np.asarray(torch.einsum("...zyx,rzyx->...r", volumes, weights).numpy())

    zero, first, second, both = run(torch.cat([torch.zeros_like(b), b, noise[:1], b + noise[:1]]))
    size = float((second - zero).square().mean().sqrt())
    linearity = float((both - first - second + zero).square().mean().sqrt()) / max(size, 1e-300)
    if not linearity <= LINEARITY:
        raise ValueError(
            f"the method is not linear: f(signal + noise) differs from f(signal) + f(noise) by {linearity:.2g} of the "
            "noise's effect; draw realisations and use torchpcct.metrics.control"
        )
    probe = torch.cat([noise, b])
    truth = read(run(probe) - zero)
    scale = np.sqrt(np.mean(np.square(truth[:2])))
    offset = read(zero)
    g: Tensor | None
    found = None
    for kind in ("solve", "vjp") if adjoint == "auto" else (adjoint,):
        if kind == "solve":
            gain = float((first - zero).square().mean().sqrt() / b.square().mean().sqrt().clamp_min(1e-30))
            g = _by_solving(run, weights, zero, _SOLVE_HU / max(gain, 1e-30), b)
        else:
            g = _by_autograd(method, problem, weights, b, exposure_s)
        if g is None:
            continue
        own = torch.einsum("bzyx,rzyx->br", probe.to(torch.float64), g).numpy()
        agreement = float(np.sqrt(np.mean(np.square((own - truth)[:2]))) / max(scale, 1e-300))
        found = ExactLinear(g, offset, float(exposure_s), linearity, agreement)
        if agreement <= AGREEMENT:
            return found
    why = "it is not differentiable" if found is None else f"g·b differs from the ROI means by {found.agreement:.2g}"
    raise ValueError(f"no adjoint of the method was found ({why}): a solve that converges, or autograd, is needed")


def _by_solving(run: Callable[[Tensor], Tensor], weights: Tensor, zero: Tensor, scale: float, like: Tensor) -> Tensor:
    """M r of every ROI, for M = Mᵀ; ``scale`` times the largest weight makes a large volume."""
    size = scale / weights.abs().amax(dim=(1, 2, 3), keepdim=True)
    return (run((weights * size).to(like)) - zero) / size


def _by_autograd(method: Any, problem: Any, weights: Tensor, b: Tensor, exposure_s: float) -> Tensor | None:
    """Mᵀr of every ROI by one backward pass each; None for a method that autograd cannot see through."""
    with torch.enable_grad():
        leaf = b.expand(len(weights), *b.shape[1:]).clone().requires_grad_()
        volumes = method(problem, leaf, exposure_s)
        if not volumes.requires_grad:
            return None
        (gradient,) = torch.autograd.grad((volumes * weights.to(volumes)).sum(), leaf)
    return gradient.to(torch.float64)
