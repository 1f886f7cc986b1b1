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
first. :func:`minimise_passes` runs both to their stationary points.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn

from recon.mbir.along_vessel import Steering
from recon.mbir.prior import REFERENCE_SCALE_HU, LearnedPrior, PriorConfig

__all__ = ["NormalProblem", "Unrolled", "energy", "minimise", "minimise_passes", "residual"]

LARGEST_ADD_BACK = 2.0
FLOOR = 0.05
"""Smallest damping: frequencies that the scanner does not see are never divided by less."""


@dataclass(frozen=True)
class NormalProblem:
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
    def from_statistic(cls, gram: Any, b: Tensor, exposure: Tensor, hu: float, voxel_mm: float) -> NormalProblem:
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
        if steps < 1:
            raise ValueError(f"steps must be at least 1, got {steps}")
        self.add_back = add_back
        self.prior = LearnedPrior(config)
        self.steps = steps
        self.seen_scale_hu: Tensor
        self.log_step = nn.Parameter(torch.zeros(steps))
        self.momentum = nn.Parameter(torch.full((steps,), 0.3))
        self.log_damping = nn.Parameter(torch.full((steps + 1,), math.log(2.0)))
        # What the training has seen, so that the weights know themselves where they may be trusted.
        self.register_buffer("seen_scale_hu", torch.zeros(2))

    def forward(self, problem: NormalProblem, callback: Callable[[int, Tensor], None] | None = None) -> Tensor:
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
        self, problem: NormalProblem, callback: Callable[[int, Tensor], None] | None = None
    ) -> tuple[Tensor, NormalProblem, Steering]:
        """The reconstruction with what its energy needs, for :func:`residual`.

        Args:
            problem: normalised problem.
            callback: as for :meth:`forward`.

        Returns:
            The volume ``(batch, z, y, x)`` in noise units, the problem of the last pass and the steering of all passes.
        """
        count = itertools.count()

        def solve(problem: NormalProblem, steering: Steering, _: Tensor | None) -> Tensor:
            return self.descend(problem, steering, callback and (lambda _, u: callback(next(count), u)))

        return self.in_turn(problem, solve)

    def in_turn(
        self, problem: NormalProblem, solve: Callable[[NormalProblem, Steering, Tensor | None], Tensor]
    ) -> tuple[Tensor, NormalProblem, Steering]:
        """Every pass of the reconstruction by a solver of one.

        Args:
            problem: of the data.
            solve: gives the volume of one pass for its problem, the steering and the volume of the pass before (None
                in the first).

        Returns:
            As for :meth:`passes`.
        """
        # One steering for all passes: directions are those of the data, not of data with a residual added.
        steering = self.steering(problem)
        u = solve(problem, steering, None)
        if self.add_back is not None:
            problem = self.added_back(problem, u)
            u = solve(problem, steering, u)
        return u, problem, steering

    def added_back(self, problem: NormalProblem, u: Tensor) -> NormalProblem:
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

    def steering(self, problem: NormalProblem) -> Steering:
        """S of a problem: directions from the regularised linear solution."""
        scale, shape = problem.scale_hu, problem.beta.shape[-3:]
        with torch.no_grad():
            curved = problem.spectrum() + self.prior.quadratic(shape, problem.voxel_mm, scale)
            pilot = _inverse(_spectrum(problem.beta) / (curved + self._damping(scale)[self.steps]), shape)
        return Steering.of(pilot, problem.voxel_mm, self.prior.along_strength(scale))

    def descend(
        self, problem: NormalProblem, steering: Steering, callback: Callable[[int, Tensor], None] | None = None
    ) -> Tensor:
        """One pass: K steps from the regularised linear solution towards the minimum of the energy."""
        scale, shape = problem.scale_hu, problem.beta.shape[-3:]
        quadratic = self.prior.quadratic(shape, problem.voxel_mm, scale)
        damping = self._damping(scale)
        curved = problem.spectrum() + quadratic + steering.spectrum()
        u = _inverse(_spectrum(problem.beta) / (curved + damping[self.steps]), shape)
        previous = u
        for k in range(self.steps):
            gradient = problem.apply(u) - problem.beta + self.prior.gradient(u, scale) + steering.gradient(u)
            step = _inverse((_spectrum(gradient) + quadratic * _spectrum(u)) / (curved + damping[k]), shape)
            new = u - torch.exp(self.log_step[k]) * step + self.momentum[k] * (u - previous)
            u, previous = new, u
            if callback is not None:
                callback(k, u)
        return u


def _spectrum(v: Tensor) -> Tensor:
    return torch.fft.rfftn(v, dim=(-3, -2, -1))


def _inverse(spectrum: Tensor, shape: torch.Size) -> Tensor:
    return torch.fft.irfftn(spectrum, s=shape, dim=(-3, -2, -1))


def _filtered(v: Tensor, spectrum: Tensor) -> Tensor:
    return _inverse(spectrum * _spectrum(v), v.shape[-3:])


def energy(model: Unrolled, problem: NormalProblem, u: Tensor, steering: Steering | None = None) -> Tensor:
    """Φ(u) = ½ uᵀH u − βᵀu + R(u) + S(u) of each volume, ``(batch,)`` float64.

    Args:
        model, problem: whose energy.
        u: ``(batch, z, y, x)`` noise units.
        steering: None: that of the problem; for a second pass it must be given, that of the first pass's problem.
    """
    steering = steering or model.steering(problem)
    data = (u * (0.5 * problem.apply(u) - problem.beta)).sum(dim=(1, 2, 3), dtype=torch.float64)
    quadratic = model.prior.quadratic(u.shape[-3:], problem.voxel_mm, problem.scale_hu)
    smooth = 0.5 * (u * _filtered(u, quadratic)).sum(dim=(1, 2, 3), dtype=torch.float64)
    return data + smooth + model.prior.energy(u, problem.scale_hu).double() + steering.energy(u)


class _Preconditioned:
    """∇Φ and its preconditioned form."""

    def __init__(self, model: Unrolled, problem: NormalProblem, steering: Steering | None) -> None:
        self.model, self.problem = model, problem
        self.quadratic = model.prior.quadratic(problem.beta.shape[-3:], problem.voxel_mm, problem.scale_hu)
        self.steering = steering or model.steering(problem)
        self.bound = model.prior.slope_bound(problem.scale_hu).reshape(-1, 1, 1, 1)
        self.weight = problem.spectrum() + self.quadratic + self.steering.spectrum() + self.bound + FLOOR

    def steepest(self, iterations: int = 12) -> Tensor:
        """Largest eigenvalue of M times an upper bound of the Hessian, ``(batch,)``, by power iteration."""
        generator = torch.Generator().manual_seed(0)
        shape = self.problem.beta.shape
        v = torch.randn(shape[1:], generator=generator).to(self.problem.beta).expand(shape).clone()
        size = torch.ones(shape[0])
        for _ in range(iterations):
            smooth = _filtered(v, self.quadratic) + self.steering.gradient(v)
            v = self(self.problem.apply(v) + smooth + self.bound * v)
            size = v.flatten(1).norm(dim=1)
            v = v / size.clamp_min(torch.finfo(v.dtype).tiny).reshape(-1, 1, 1, 1)
        return size.to(v)

    def gradient(self, u: Tensor) -> Tensor:
        smooth = _filtered(u, self.quadratic) + self.steering.gradient(u)
        return self.problem.apply(u) - self.problem.beta + smooth + self.model.prior.gradient(u, self.problem.scale_hu)

    def __call__(self, gradient: Tensor) -> Tensor:
        return _inverse(_spectrum(gradient) / self.weight, gradient.shape[-3:])

    def size(self, gradient: Tensor) -> Tensor:
        """√(gᵀM g), ``(batch,)``."""
        return (gradient * self(gradient)).sum(dim=(1, 2, 3), dtype=torch.float64).clamp_min(0.0).sqrt()


def residual(model: Unrolled, problem: NormalProblem, u: Tensor, steering: Steering | None = None) -> Tensor:
    """Norm of ∇Φ(u) over that of ∇Φ(0) = −β, in the metric of the preconditioner, ``(batch,)``.

    Args:
        model, problem: whose energy, that of one pass.
        u: ``(batch, z, y, x)`` noise units.
        steering: as for :func:`energy`.
    """
    metric = _Preconditioned(model, problem, steering)
    return metric.size(metric.gradient(u)) / metric.size(problem.beta).clamp_min(torch.finfo(torch.float64).tiny)


def minimise(
    model: Unrolled,
    problem: NormalProblem,
    start: Tensor,
    tolerance: float = 1e-3,
    most: int = 400,
    steering: Steering | None = None,
) -> tuple[Tensor, dict[str, Any]]:
    """Run the energy of one pass to a stationary point: preconditioned gradient descent with momentum.

    The energy is not convex; from one start it falls monotonically (a step that would raise it is halved and loses its
    momentum), so the point that is reached belongs to the valley of the start.

    Args:
        model: whose prior is used.
        problem: normalised problem of the pass.
        start: ``(batch, z, y, x)`` noise units.
        tolerance: of :func:`residual`, worst volume.
        most: largest number of iterations.
        steering: as for :func:`energy`.

    Returns:
        The volumes, and ``iterations``, ``residual`` (list), ``converged``.
    """
    metric = _Preconditioned(model, problem, steering)
    reference = metric.size(problem.beta).clamp_min(torch.finfo(torch.float64).tiny)
    u, previous = start, start
    value = energy(model, problem, u, metric.steering)
    # Power iteration comes from below: a little shorter, and halved where the energy rises all the same.
    length = 1.0 / (1.1 * metric.steepest())
    count, ages = 0, torch.zeros_like(length)
    sizes = metric.size(metric.gradient(u)) / reference
    while count < most and bool((sizes > tolerance).any()):
        count += 1
        momentum = (ages / (ages + 3.0)).reshape(-1, 1, 1, 1)
        ahead = u + momentum * (u - previous)
        gradient = metric.gradient(ahead)
        trial = ahead - length.reshape(-1, 1, 1, 1) * metric(gradient)
        new = energy(model, problem, trial, metric.steering)
        # Rounding of the energy's large terms must not count as a rise.
        worse = new > value + 1e-6 * value.abs()
        keep = worse.reshape(-1, 1, 1, 1)
        # Momentum that points uphill is dropped (O'Donoghue, Candès 2015): near the end the energy cannot tell.
        uphill = (gradient * (trial - u)).sum(dim=(1, 2, 3)) > 0
        previous = u
        u = torch.where(keep, u, trial)
        value = torch.where(worse, value, new)
        ages = torch.where(worse | uphill, torch.zeros_like(ages), ages + 1.0)
        length = torch.where(worse & (momentum.flatten() == 0), 0.5 * length, length)
        if count % 5 == 0 or count == most:
            sizes = metric.size(metric.gradient(u)) / reference
    return u, {"iterations": count, "residual": sizes.tolist(), "converged": bool((sizes <= tolerance).all())}


def minimise_passes(
    model: Unrolled, problem: NormalProblem, start: Tensor | None = None, tolerance: float = 1e-3, most: int = 400
) -> tuple[Tensor, dict[str, Any]]:
    """Run every pass to a stationary point of its energy, the second one from where the first has ended.

    With the shipped weights the point does not depend on the start: from zero it is the same within 0.01 HU (root mean
    square) at a tolerance of 1e-5, on the paper's plaque at 0.35 s and at 2 s.

    Args:
        model: with one pass or two.
        problem: normalised problem of the data.
        start: ``(batch, z, y, x)`` noise units, where the first pass starts; None: at the end of its unrolled steps.
        tolerance, most: of each pass, as for :func:`minimise`.

    Returns:
        The volumes, and ``iterations`` (of all passes, with the unrolled steps that were made), ``residual`` (list, of
        the last pass's energy), ``converged`` (every pass).
    """
    reports: list[dict[str, Any]] = []

    def solve(problem: NormalProblem, steering: Steering, before: Tensor | None) -> Tensor:
        begin = start if before is None else before
        begin = model.descend(problem, steering) if begin is None else begin
        u, report = minimise(model, problem, begin, tolerance, most, steering)
        reports.append(report)
        return u

    u = model.in_turn(problem, solve)[0]
    return u, {
        "iterations": sum(r["iterations"] for r in reports) + (model.steps if start is None else 0),
        "residual": reports[-1]["residual"],
        "converged": all(r["converged"] for r in reports),
    }
