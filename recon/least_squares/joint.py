"""Joint model-based reconstruction of several images from line integrals with correlated noise.

    Φ(x) = ½ Σ_rays (a − A x)ᵀ F (a − A x) + R(x),          a, x: two channels; F: 2 × 2 Fisher information of each ray

The line integrals of two basis materials, decomposed ray by ray, are strongly anticorrelated: reconstructing each by
itself throws away what one says about the other. F is the information matrix of the decomposition
(:class:`torchpcct.spectral.Decomposition`), R the q-GGMRF of both channels (:mod:`recon.least_squares.qggmrf`).

The channels are mixed first so that the mean of F over the rays is a multiple of the identity
(:mod:`recon.least_squares.basis_problem`). In these coordinates noise is isotropic, which is what R needs, and AᵀFA is
nearly the same scalar operator in each channel: one FFT model (:class:`recon.gram.gram.Gram`) with the weights ½ tr F
serves as the preconditioner of all. What it leaves out (F's change from ray to ray) the exact projections repair, as in
:mod:`recon.least_squares.pwls`, whose iteration this is.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from recon.gram.gram import Gram
from recon.least_squares.pwls import PwlsResult, solve_normal, weighted_data
from recon.least_squares.qggmrf import QGGMRF, BoundPrior

__all__ = ["joint_pwls", "mean_weights"]


def weigh(information: Tensor, y: Tensor, axes: int) -> Tensor:
    """F y of every ray: ``(3, *range)`` times ``(..., 2, *range)``, ``axes`` axes of rays."""
    first, second = y.unbind(-axes - 1)
    f11, f12, f22 = information
    return torch.stack([f11 * first + f12 * second, f12 * first + f22 * second], dim=-axes - 1)


def check_information(information: Any, shape: tuple[int, ...]) -> None:
    """Refuse information matrices that are not finite and positive semi-definite, of a wrong shape, or all 0."""
    if not isinstance(information, Tensor) or information.dtype not in (torch.float32, torch.float64):
        kind = getattr(information, "dtype", type(information).__name__)
        raise TypeError(f"information must be a float32 or float64 tensor, got {kind}")
    if tuple(information.shape) != (3, *shape):
        raise ValueError(f"information must have the shape {(3, *shape)} (F11, F12, F22), got "
                         f"{tuple(information.shape)}")  # fmt: skip
    if not torch.isfinite(information).all():
        raise ValueError("information must be finite: give rays that hold none the matrix 0")
    f11, f12, f22 = information
    slack = 1e-5 * (f11 * f22).clamp_min(0)
    if bool((f11 < 0).any()) or bool((f22 < 0).any()) or bool((f12 * f12 > f11 * f22 + slack).any()):
        raise ValueError("information must be positive semi-definite on every ray, packed as F11, F12, F22")
    if not bool((f11 + f22 > 0).any()):
        raise ValueError("all information is 0: no ray says anything about the inset")


def joint_pwls(
    A: Any,
    y: Tensor,
    information: Tensor,
    prior: QGGMRF | BoundPrior,
    *,
    mu_per_hu: float = 1.0,
    gram: Gram | None = None,
    tolerance: float = 0.2,
    max_exact: int = 20,
    callback: Callable[[dict[str, Any]], None] | None = None,
) -> PwlsResult:
    """Minimise ½ Σ (y − A x)ᵀ F (y − A x) + R(x) over two channels.

    Args:
        A: the exact operator (:class:`torchpcct.projector.Projector`).
        y: whitened line integrals with the background taken off, ``(..., 2, *A.range_shape)`` float32 or float64; rays
            of information 0 may hold anything. Leading dimensions are independent realisations.
        information: F of the whitened channels, ``(3, *A.range_shape)`` (F₁₁, F₁₂, F₂₂), from smooth expected counts.
            It should be near a multiple of the identity (:class:`recon.least_squares.basis_problem.Whitening`): that is
            for speed alone.
        prior: in noise-normalised units, or bound already.
        mu_per_hu: the value of the channels that counts as 1 HU.
        gram: FFT model of Aᵀ diag(½ tr F) A, kept from an earlier call; None: made here.
        tolerance: stop when the images are this close to the minimum: root mean square over both channels, in HU.
        max_exact: largest number of exact projection pairs (each of two channels).
        callback: see :func:`recon.least_squares.pwls.pwls`.

    Returns:
        Images ``(..., 2, *grid.shape)`` in the dtype of y, and the report of :func:`recon.least_squares.pwls.pwls`:
        ``gradient`` is the norm of the exact gradient of Φ over that of the zero images.

    Raises:
        ValueError: shapes that do not fit, data that are not finite, F not positive semi-definite or all 0, a
            tolerance ≤ 0.
        TypeError: data or information that are not float tensors.
    """
    started = time.perf_counter()
    n = len(A.range_shape)
    check_information(information, tuple(A.range_shape))
    known = information[0] + information[2] > 0
    weighted = weighted_data(y, (2, *A.range_shape), known, lambda v: weigh(information.to(v.dtype), v, n))
    f = information.to(weighted.dtype)

    def exact(x: Tensor) -> Tensor:
        out: Tensor = A.T(weigh(f, A(x), n))
        return out

    result = solve_normal(
        A.T(weighted), exact, gram if gram is not None else Gram(A, mean_weights(information)), prior,
        mu_per_hu=mu_per_hu,
        spacing=A.grid.spacing, channels=True, tolerance=tolerance, max_exact=max_exact, callback=callback,
    )  # fmt: skip
    return PwlsResult(result.x, {**result.report, "method": "joint-pwls", "seconds": time.perf_counter() - started})


def mean_weights(information: Tensor) -> Tensor:
    """½ tr F of every ray: the weights of the FFT model."""
    return (0.5 * (information[0] + information[2])).contiguous()
