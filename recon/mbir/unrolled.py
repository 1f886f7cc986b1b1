"""Unrolled model-based reconstruction: a few preconditioned data steps, each with a step of the learned prior.

The problem is normalised before the network sees it. With the data's information I at 0.5 lp/mm (1/(HU² mm³), see
:meth:`recon.gram.gram.Gram.information`) and the voxel volume V, the noise scale is c = (I V)^(−1/2) HU, and

    u = x / c,      H = c² G  (about 1 at 0.5 lp/mm),      β = c b,      β = H u + noise of covariance H.

So the same tissue at four times the dose looks to the network like twice the contrast at the same noise.
Each step k of the K unrolled ones reads

    u ← u − η_k M_k (H u − β + ∇R(u) + ∇S(u)) + θ_k (u − u_previous),    M_k = (circulant of H, S + λ_k)^(−1) by FFT,

with the learned prior R and the smoothing S along vessels, whose direction the linear solution before the first step
tells (:mod:`recon.mbir.along_vessel`).

Whatever smooths, shrinks. So the steps are passed through again with what the first pass left in the data added back,
β ← β + w (β − H u): a Bregman iteration (Osher, Burger, Goldfarb, Xu, Yin 2005, Multiscale Model. Simul. 4:460), which
restores contrast while the prior, sure of its edges by then, keeps the noise out. Each pass has an energy of its own:
that of the second is made with the volume that the first one ends at, and what steers S is fixed by the data of the
first. :mod:`recon.mbir.minimise` runs both to their stationary points.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn

from recon.mbir.along_vessel import VesselSmoothing
from recon.mbir.prior import REFERENCE_SCALE_HU, LearnedPrior, PriorConfig, from_frequencies, to_frequencies
from torchpcct.validate import whole

__all__ = ["FLOOR", "NormalisedProblem", "Unrolled"]

LARGEST_ADD_BACK = 2.0
FLOOR = 0.05
"""Smallest damping: frequencies that the scanner does not see are never divided by less."""


@dataclass(frozen=True)
class NormalisedProblem:
    """A batch of normalised problems that share one Gram operator.

    Args:
        gram: ``apply`` and ``periodic_spectrum`` of G at unit exposure, in mm⁻¹ units (:class:`recon.gram.gram.Gram`).
        beta: ``(batch, z, y, x)``, c·b in HU units.
        scale_hu: ``(batch,)`` noise scales c.
        factor: ``(batch,)`` so that H = factor · G.
        voxel_mm: voxel size.
    """

    gram: Any
    beta: Tensor
    scale_hu: Tensor
    factor: Tensor
    voxel_mm: float

    @classmethod
    def from_statistic(cls, gram: Any, b: Tensor, exposure: Tensor, hu: float, voxel_mm: float) -> NormalisedProblem:
        """From AᵀW y.

        Args:
            gram: Gram operator at unit exposure.
            b: ``(batch, z, y, x)``, AᵀW y with the weights of the exposures, y in line integrals of mm⁻¹.
            exposure: ``(batch,)`` factors on the Gram operator's weights.
            hu: 1 HU in mm⁻¹.
            voxel_mm: size of the cubic voxels.
        """
        unit = gram.information(hu)
        scale = (unit * exposure.to(b) * voxel_mm**3).rsqrt()
        factor = exposure.to(b) * (scale * hu) ** 2
        return cls(gram, b * (scale * hu).reshape(-1, 1, 1, 1), scale, factor, voxel_mm)

    def apply(self, u: Tensor) -> Tensor:
        """H u."""
        out: Tensor = self.gram.apply(u) * self.factor.reshape(-1, 1, 1, 1)
        return out

    def spectrum(self) -> Tensor:
        """Eigenvalues of the circulant approximation of H, ``(batch, z, y, x//2 + 1)``."""
        return self.gram.periodic_spectrum().to(self.beta) * self.factor.reshape(-1, 1, 1, 1)


class Unrolled(nn.Module):
    """K unrolled steps with one shared prior.

    Args:
        config: of the prior.
        steps: K of each pass.
        add_back: ``(a, b)`` of the weight ``w = a + b ln(c / 200 HU)`` of the residual in a second pass, c the noise
            scale; None: one pass.
    """

    def __init__(
        self, config: PriorConfig | None = None, steps: int = 8, add_back: tuple[float, float] | None = None
    ) -> None:
        super().__init__()
        whole("steps", steps)
        self.add_back = add_back
        self.prior = LearnedPrior(config)
        self.steps = steps
        self.seen_scale_hu: Tensor
        self.log_step = nn.Parameter(torch.zeros(steps))
        self.momentum = nn.Parameter(torch.full((steps,), 0.3))
        self.log_damping = nn.Parameter(torch.full((steps + 1,), math.log(2.0)))
        # What the training has seen, so that the weights know themselves where they may be trusted.
        self.register_buffer("seen_scale_hu", torch.zeros(2))

    def forward(self, problem: NormalisedProblem, callback: Callable[[int, Tensor], None] | None = None) -> Tensor:
        """The reconstruction ``(batch, z, y, x)`` in noise units (times ``problem.scale_hu``: HU above background).

        Args:
            problem: normalised problem.
            callback: called with the number of each step, counted over both passes, and the volume after it.
        """
        scale = problem.scale_hu
        if self.training:
            low, high = self.seen_scale_hu.unbind()
            least = scale.min() if not low else torch.minimum(low, scale.min())
            self.seen_scale_hu = torch.stack([least, torch.maximum(high, scale.max())])
        return self.passes(problem, callback)[0]

    @property
    def iterations(self) -> int:
        """Steps of all passes."""
        return self.steps * (1 if self.add_back is None else 2)

    def passes(
        self, problem: NormalisedProblem, callback: Callable[[int, Tensor], None] | None = None
    ) -> tuple[Tensor, NormalisedProblem, VesselSmoothing]:
        """The reconstruction with what its energy needs, for :func:`recon.mbir.minimise.residual`.

        Args:
            problem: normalised problem.
            callback: as for :meth:`forward`.

        Returns:
            The volume ``(batch, z, y, x)`` in noise units, the problem of the last pass and the smoothing along vessels
            of all passes.
        """
        count = itertools.count()

        def solve(problem: NormalisedProblem, smoothing: VesselSmoothing, _: Tensor | None) -> Tensor:
            return self.descend(problem, smoothing, callback and (lambda _, u: callback(next(count), u)))

        return self.in_turn(problem, solve)

    def in_turn(
        self, problem: NormalisedProblem, solve: Callable[[NormalisedProblem, VesselSmoothing, Tensor | None], Tensor]
    ) -> tuple[Tensor, NormalisedProblem, VesselSmoothing]:
        """Every pass of the reconstruction by a solver of one.

        Args:
            problem: of the data.
            solve: gives the volume of one pass for its problem, the smoothing along vessels and the volume of the pass
                before (None in the first).

        Returns:
            As for :meth:`passes`.
        """
        # One smoothing for all passes: its directions are those of the data, not of data with a residual added.
        smoothing = self.vessel_smoothing(problem)
        u = solve(problem, smoothing, None)
        if self.add_back is not None:
            problem = self.added_back(problem, u)
            u = solve(problem, smoothing, u)
        return u, problem, smoothing

    def added_back(self, problem: NormalisedProblem, u: Tensor) -> NormalisedProblem:
        """The second pass's problem, β + w (β − H u) in place of β.

        Args:
            problem: of the first pass.
            u: ``(batch, z, y, x)`` noise units, the volume that the first pass has ended at.

        Raises:
            ValueError: a model of one pass.
        """
        if self.add_back is None:
            raise ValueError("this model has one pass: nothing is added back")
        a, b = self.add_back
        level = torch.log(problem.scale_hu / REFERENCE_SCALE_HU)
        weight = (a + b * level).clamp(0.0, LARGEST_ADD_BACK).reshape(-1, 1, 1, 1)
        return replace(problem, beta=problem.beta + weight * (problem.beta - problem.apply(u)))

    def _damping(self, scale: Tensor) -> Tensor:
        """λ_k of every step and, last, of the linear start: ``(steps + 1, batch, 1, 1, 1)``."""
        # The prior's own curvature sets how far a step may go, at every noise level and throughout the training.
        curvature = self.prior.curvature(scale)
        return (torch.exp(self.log_damping)[:, None] * curvature + FLOOR)[..., None, None, None]

    def vessel_smoothing(self, problem: NormalisedProblem) -> VesselSmoothing:
        """S of a problem: directions from the regularised linear solution."""
        scale, shape = problem.scale_hu, problem.beta.shape[-3:]
        with torch.no_grad():
            curved = problem.spectrum() + self.prior.quadratic(shape, problem.voxel_mm, scale)
            pilot = from_frequencies(to_frequencies(problem.beta) / (curved + self._damping(scale)[self.steps]), shape)
        return VesselSmoothing.of(pilot, problem.voxel_mm, self.prior.along_strength(scale))

    def descend(
        self,
        problem: NormalisedProblem,
        smoothing: VesselSmoothing,
        callback: Callable[[int, Tensor], None] | None = None,
    ) -> Tensor:
        """One pass: K steps from the regularised linear solution towards the minimum of the energy."""
        scale, shape = problem.scale_hu, problem.beta.shape[-3:]
        quadratic = self.prior.quadratic(shape, problem.voxel_mm, scale)
        damping = self._damping(scale)
        curved = problem.spectrum() + quadratic + smoothing.spectrum()
        u = from_frequencies(to_frequencies(problem.beta) / (curved + damping[self.steps]), shape)
        previous = u
        for k in range(self.steps):
            gradient = problem.apply(u) - problem.beta + self.prior.gradient(u, scale) + smoothing.gradient(u)
            step = from_frequencies(
                (to_frequencies(gradient) + quadratic * to_frequencies(u)) / (curved + damping[k]), shape
            )
            new = u - torch.exp(self.log_step[k]) * step + self.momentum[k] * (u - previous)
            u, previous = new, u
            if callback is not None:
                callback(k, u)
        return u
