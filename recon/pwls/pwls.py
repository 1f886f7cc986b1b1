"""Penalised weighted least squares on an inset, to the exact solution with a handful of projections.

    Φ(x) = ½ ‖y − A x‖²_W + R(x)

The FFT model of AᵀWA (:class:`recon.gram.gram.Gram`) carries the inner iterations; each outer iteration measures the
true gradient with one exact projection pair (A, Aᵀ) and lets the model solve for what is left (defect correction, as a
flexible conjugate gradient method with exact line search, Notay 2000, SIAM J. Sci. Comput. 22:1444). So the result is
the minimum of Φ itself, not of the model, and the exact gradient certifies it.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from recon.conjugate_gradient import dot, per_volume
from recon.gram.gram import Gram, check_weights
from recon.pwls.model_solver import ModelSolver, line_search
from recon.pwls.qggmrf import QGGMRF, BoundPrior
from torchpcct.validate import number, whole

__all__ = ["PwlsResult", "pwls", "solve_normal", "weighted_data"]

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class PwlsResult:
    """A reconstruction and its certificate.

    Args:
        x: ``(..., *grid.shape)`` mm⁻¹.
        report: ``exact_pairs`` (A and Aᵀ applied together), ``inner_iterations`` (one entry per outer iteration),
            ``gradient`` (norm of the exact gradient of Φ over that of the zero volume, worst volume of the batch,
            one entry per outer iteration), ``rmsd_hu`` (root mean square distance to the minimum in HU, as the
            model sees it from the exact gradient, worst volume, one entry per outer iteration), ``converged``,
            ``tolerance_hu``, ``seconds``, and the prior (``strength``, ``lambda``, ``threshold_hu_per_mm``, ``p``,
            ``q``).
    """

    x: Tensor
    report: Mapping[str, Any] = field(default_factory=dict)


def pwls(
    A: Any,
    y: Tensor,
    weights: Tensor,
    prior: QGGMRF | BoundPrior,
    *,
    hu: float,
    gram: Any = None,
    start: Tensor | None = None,
    tolerance: float = 0.2,
    max_exact: int = 12,
    callback: Callable[[dict[str, Any]], None] | None = None,
) -> PwlsResult:
    """Minimise ½‖y − A x‖²_W + R(x).

    Args:
        A: the exact operator (:class:`torchpcct.projector.Projector`).
        y: line integrals with the background taken off, ``(..., *A.range_shape)`` float32 or float64; readings of
            weight 0 may hold anything. Leading dimensions are independent noise realisations.
        weights: W, ``A.range_shape``: expected inverse variances of y (from smooth expected counts: weights taken
            from the noisy counts themselves bias the result).
        prior: a prior in noise-normalised units, or one that is bound already.
        hu: 1 HU in mm⁻¹ (μ_ref / 1000).
        gram: model of AᵀWA with these weights (:class:`recon.gram.gram.Gram`, kept from an earlier call); default: made
            here.
        start: first volume ``(..., *grid.shape)`` mm⁻¹, default 0. It costs one exact pair and does not change the
            result.
        tolerance: stop when the volume is this close to the minimum: root mean square, in HU (see ``rmsd_hu``).
        max_exact: largest number of exact pairs; if it is reached, the report says ``converged: False`` and a
            warning is logged.
        callback: called after each outer iteration with a dict of ``outer``, ``exact_pairs``, ``gradient`` and
            ``rmsd_hu``.

    Returns:
        The volume in the dtype of y, and the report.

    Raises:
        ValueError: shapes that do not fit, data that are not finite, weights that are negative or all 0,
            a tolerance ≤ 0.
        TypeError: data or weights that are not float tensors.
    """
    started = time.perf_counter()
    check_weights(weights, A.range_shape)
    weighted = weighted_data(y, tuple(A.range_shape), weights > 0, lambda v: weights.to(v.dtype) * v)
    w = weights.to(weighted.dtype)
    model = Gram(A, weights) if gram is None else gram

    def exact(x: Tensor) -> Tensor:
        out: Tensor = A.T(w * A(x))
        return out

    result = solve_normal(
        A.T(weighted), exact, model, prior, hu=hu, spacing=A.grid.spacing, start=start, tolerance=tolerance,
        max_exact=max_exact, callback=callback,
    )  # fmt: skip
    return PwlsResult(result.x, {**result.report, "seconds": time.perf_counter() - started})


def weighted_data(y: Any, shape: tuple[int, ...], known: Tensor, weigh: Callable[[Tensor], Tensor]) -> Tensor:
    """W y of data ``(..., *shape)``, where readings that are not ``known`` count as 0 and may hold anything.

    Raises:
        TypeError: no float tensor.
        ValueError: another shape, or readings of positive weight that are not finite.
    """
    if not isinstance(y, Tensor) or y.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"y must be a float32 or float64 tensor, got {getattr(y, 'dtype', type(y).__name__)}")
    if tuple(y.shape[-len(shape) :]) != shape:
        raise ValueError(f"y must have shape (..., {', '.join(map(str, shape))}), got {tuple(y.shape)}")
    weighted = weigh(torch.where(known, y, torch.zeros((), dtype=y.dtype, device=y.device)))
    if not torch.isfinite(weighted).all():
        raise ValueError("y holds NaN or Inf in readings of positive weight: give these readings the weight 0")
    return weighted


def solve_normal(
    b: Tensor,
    exact: Callable[[Tensor], Tensor],
    gram: Any,
    prior: QGGMRF | BoundPrior,
    *,
    hu: float,
    spacing: tuple[float, ...],
    channels: bool = False,
    start: Tensor | None = None,
    tolerance: float = 0.2,
    max_exact: int = 12,
    callback: Callable[[dict[str, Any]], None] | None = None,
) -> PwlsResult:
    """The same from the sufficient statistic b = AᵀW y: minimise ½ xᵀHx − bᵀx + R(x).

    Args:
        b: ``(..., [channels,] *grid.shape)``.
        exact: x ↦ H x = AᵀWA x; ``gram.apply`` itself solves the model's problem.
        gram: the model of H: ``apply(x)``, ``periodic_spectrum()`` and, for a :class:`QGGMRF`, ``information(hu)``.
        spacing: voxel size per axis in mm.
        channels: whether the volumes have an axis of channels, which the prior joins and ``gram`` treats alike.
        prior, hu, start, tolerance, max_exact, callback: see :func:`pwls`.
    """
    started = time.perf_counter()
    axes = len(spacing) + channels
    shape = b.shape[-axes:]
    number("tolerance", tolerance, positive=True, unit="HU")
    whole("max_exact", max_exact)
    if start is not None and tuple(start.shape[-axes:]) != tuple(shape):
        raise ValueError(f"start must have shape (..., {', '.join(map(str, shape))}), got {tuple(start.shape)}")
    bound = prior.bind(gram.information(hu), spacing, hu, channels) if isinstance(prior, QGGMRF) else prior
    lead = b.shape[:-axes]
    b = b.reshape(-1, *shape)
    solver = ModelSolver(gram, bound, b)
    reference = dot(b, b, axes).sqrt().clamp_min(torch.finfo(b.dtype).tiny)

    pairs = 0
    if start is None:
        x = torch.zeros_like(b)
        data_gradient = -b
    else:
        if not torch.isfinite(start).all():
            raise ValueError("start holds NaN or Inf")
        x = start.to(b).expand(*lead, *shape).reshape(b.shape).clone()
        data_gradient = exact(x) - b
        pairs += 1
    inner: list[int] = []
    gradients: list[float] = []
    distances: list[float] = []
    previous: tuple[Tensor, Tensor] | None = None
    converged = b.shape[0] == 0
    while not converged:
        # Without exact pairs the first step starts from far: solve the model well. Later steps repair its error.
        step, count = solver.step(x, data_gradient)
        inner.append(count)
        gradient = data_gradient + bound.gradient(x)
        gradients.append(float((dot(gradient, gradient, axes).sqrt() / reference).max()))
        distances.append(float((dot(step, step, axes) / step[0].numel()).sqrt().max()) / hu)
        if callback is not None:
            callback({"outer": len(inner), "exact_pairs": pairs, "gradient": gradients[-1], "rmsd_hu": distances[-1]})
        converged = distances[-1] <= tolerance
        if converged or pairs >= max_exact:
            break
        curved = exact(step)
        pairs += 1
        if previous is not None:
            step, curved = _conjugate(x, step, curved, previous, bound)
        # From the model's own α = 1.
        alpha = per_volume(line_search(bound, x, step, curved, data_gradient, start=1.0, most=4, tolerance=1e-3), x)
        x = x + alpha * step
        data_gradient = data_gradient + alpha * curved
        previous = (step, curved)
    if not converged:
        _LOG.warning(
            "PWLS stopped after %d exact pairs, %.3g HU from the minimum (tolerance %.3g HU): raise max_exact",
            pairs, distances[-1], tolerance,
        )  # fmt: skip
    report = {
        "method": "pwls",
        "exact_pairs": pairs,
        "inner_iterations": inner,
        "gradient": gradients,
        "rmsd_hu": distances,
        "converged": converged,
        "tolerance_hu": tolerance,
        "strength": prior.strength if isinstance(prior, QGGMRF) else None,
        "lambda": bound.lam,
        "threshold_hu_per_mm": bound.threshold,
        "p": bound.p,
        "q": bound.q,
        "seconds": time.perf_counter() - started,
    }
    return PwlsResult(x.reshape(*lead, *shape), report)


def _conjugate(
    x: Tensor, step: Tensor, curved: Tensor, previous: tuple[Tensor, Tensor], bound: BoundPrior
) -> tuple[Tensor, Tensor]:
    """Make ``step`` conjugate to the previous one under the exact Hessian; costs no projection."""
    old, old_curved = previous
    _, old_prior = bound.along(x, old, old)
    _, mixed_prior = bound.along(x, step, old)
    down = dot(old, old_curved, bound.axes) + old_prior
    beta = -(dot(step, old_curved, bound.axes) + mixed_prior) / down.clamp_min(torch.finfo(torch.float64).tiny)
    beta = per_volume(torch.where(down > 0, beta, torch.zeros_like(beta)), step)
    return step + beta * old, curved + beta * old_curved
