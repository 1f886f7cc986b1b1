"""Projection-domain decomposition: counts in energy bins → line integrals of two basis materials.

Every ray by itself, by maximum likelihood of its Poisson counts (Alvarez 2011 for the problem; no
linearisation, no calibration table): Newton's method on the exact model of
:class:`~torchpcct.spectral.model.SpectralModel`. The estimate is asymptotically efficient, its bias
of order 1 / counts is removed by pseudo-counts (Firth 1993), which also keep rays without any count
finite; see :mod:`torchpcct.spectral.decompose_kernels` for the formulas.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchpcct.scan import Scan
from torchpcct.spectral.decompose_kernels import solve
from torchpcct.spectral.model import SpectralModel, evaluate, one_bin
from torchpcct.threads import run
from torchpcct.validate import checked

if TYPE_CHECKING:
    from torchpcct.typing import Floats, Ints


__all__ = [
    "Decomposition",
    "cramer_rao",
    "decompose",
    "decompose_exterior",
    "decompose_scan",
    "inverse",
]

TOLERANCE = 0.1
"""Newton's method ends after a step below this many standard deviations; it converges
quadratically, what is then left is a thousand times below the noise (root mean square)."""

COARSE_TOLERANCE = 0.5
"""The same for the first steps, on grouped energies."""

EXACT_TOLERANCE = 1e-7
"""The same for noise-free counts, where standard deviations are no measure."""

NAMED = 0.01
"""Fraction of rays that one bin alone counts from which on a warning names them."""
REFUSED = 0.5
"""Fraction of such rays from which on the scan is refused."""

STEP_LIMIT = 160
"""Most rays take three steps; a few in a million, with a handful of counts, need their steps
damped."""


@checked
def inverse(packed: Tensor) -> Tensor:
    """Inverse of symmetric 2 × 2 matrices packed as ``(3, ...)``: entries 11, 12, 22;
    information ↔ covariance."""
    if packed.shape[:1] != (3,):
        raise ValueError(f"packed must have the shape (3, ...), got {tuple(packed.shape)}")
    a, b, c = packed
    return torch.stack([c, -b, a]) / (a * c - b * b)


@dataclass(frozen=True, eq=False)
class Decomposition:
    """Line integrals of two basis materials.

    Attributes:
        line_integrals: ``(2, ...)`` in mm, dtype of the counts.
        information: ``(3, ...)`` Fisher information F₁₁, F₁₂, F₂₂ in mm⁻² at the estimate: the
            weights of a joint model-based reconstruction.
        at_bound: ``(...)`` bool, rays whose estimate stopped at the bounds: they hold (almost) no
            counts.
        converged: ``(...)`` bool.
    """

    line_integrals: Tensor
    information: Tensor
    at_bound: Tensor
    converged: Tensor

    @property
    def covariance(self) -> Tensor:
        """``(3, ...)`` covariance C₁₁, C₁₂, C₂₂ in mm², the inverse of the information."""
        return inverse(self.information)


@checked
def decompose(
    counts: Tensor,
    model: SpectralModel,
    *,
    columns: object = None,
    scale: object = None,
    bias_reduction: bool = True,
    tolerance: float = TOLERANCE,
) -> Decomposition:
    """Maximum-likelihood decomposition of every ray.

    Args:
        counts: ``(bins, ...)`` ≥ 0, float32 or float64, on the CPU.
        model: forward model with the exposure of the counts.
        columns: detector column of each ray, broadcast to ``counts.shape[1:]``; None: the last
            axis.
        scale: relative intensity of each ray (row factor), broadcast alike; None: 1.
        bias_reduction: remove the bias of order 1 / counts. False gives plain maximum likelihood:
            exact for expected counts, unbounded (up to ``model.bounds``, far beyond any body) for
            rays without counts.
        tolerance: the iteration ends after a step below this many standard deviations.

    Returns:
        :class:`Decomposition`; not differentiable.

    Raises:
        TypeError: counts that are no floating-point tensor.
        ValueError: a wrong number of bins, negative or non-finite counts, counts in a bin for which
            the model expects none, indices outside the detector, a tolerance outside (0, 1); more
            than half of the rays counted by one bin alone. (Of fewer, from 1 % on, a
            ``UserWarning`` says how many.)
    """
    if not isinstance(counts, Tensor) or counts.dtype not in (torch.float32, torch.float64):
        kind = counts.dtype if isinstance(counts, Tensor) else type(counts).__name__
        raise TypeError(
            f"counts must be a float32 or float64 tensor, got {kind}: convert with counts.float()"
        )
    if counts.ndim < 1 or counts.shape[0] != model.bins:
        raise ValueError(
            f"counts must have the model's {model.bins} bins first, got the shape "
            f"{tuple(counts.shape)}"
        )
    if counts.numel():
        low, high = (float(v) for v in torch.aminmax(counts.detach()))
        if not (low >= 0 and np.isfinite(high)):  # aminmax propagates NaN
            raise ValueError(
                f"counts must be finite and ≥ 0, got {low}…{high}: give raw counts, not line "
                "integrals"
            )
    if not 0 < tolerance < 1:
        raise ValueError(f"tolerance must lie in (0, 1) standard deviations, got {tolerance}")
    box = np.ascontiguousarray(model.bounds)
    column, intensity = model.rays(tuple(counts.shape[1:]), columns, scale)
    n, shape = counts.detach().contiguous().reshape(model.bins, -1), counts.shape[1:]
    _check_bins(n.numpy(), model, column)
    line_integrals, information = (
        torch.empty((k, column.size), dtype=counts.dtype) for k in (2, 3)
    )
    steps = torch.empty(column.size, dtype=torch.int32)
    # One step goes at most two attenuation lengths at 60 keV.
    reach = np.diff(model.bounds, axis=1)[:, 0] / 10.0
    run(
        solve,
        column.size,
        n.numpy(),
        column,
        intensity,
        model.attenuation,
        model.spectra,
        *model.coarse,
        *model.start,
        box,
        reach,
        bool(bias_reduction),
        COARSE_TOLERANCE,
        float(tolerance),
        STEP_LIMIT,
        line_integrals.numpy(),
        information.numpy(),
        steps.numpy(),
        operations=30 * model.spectra[0].size,
    )
    # Absurd counts (1e30) would carry infinite information in float32.
    information.clamp_(max=torch.finfo(counts.dtype).max)
    line_integrals, information = line_integrals.reshape(2, *shape), information.reshape(3, *shape)
    low_, high_ = (
        torch.from_numpy(b.copy()).reshape(2, *(1,) * (counts.ndim - 1)).to(counts.dtype)
        for b in box.T
    )
    at_bound = ((line_integrals <= low_) | (line_integrals >= high_)).any(0)
    return Decomposition(line_integrals, information, at_bound, (steps > 0).reshape(shape))


def _check_bins(counts: Floats, model: SpectralModel, column: Ints) -> None:
    """Refuse, or name, rays ``(bins, rays)`` that cannot tell two materials apart."""
    silent = model.spectra.sum(-1) == 0.0  # (columns, bins)
    for b in np.flatnonzero(silent.any(0)):
        if (counts[b] * silent[column, b] > 0).any():
            raise ValueError(
                f"bin {b} counted photons in a column where the model expects none: build the "
                "model from the scanner and the thresholds of the scan"
            )
    share = float(one_bin(counts).mean()) if counts.shape[1] else 0.0
    if share < NAMED:
        return
    text = (
        f"{100 * share:.3g} % of the rays are counted by one energy bin alone, which cannot "
        "tell two materials apart"
    )
    if share > REFUSED:
        raise ValueError(
            f"{text}: set lower thresholds, or a higher tube voltage, or sum the bins and "
            "reconstruct HU"
        )
    warnings.warn(
        f"{text}: their line integrals depend on single photons; expose longer, or sum the bins",
        UserWarning,
        stacklevel=4,
    )


@checked
def cramer_rao(
    line_integrals: Tensor,
    model: SpectralModel,
    *,
    columns: object = None,
    scale: object = None,
    order: int = 1,
) -> Tensor:
    """Smallest covariance of any unbiased estimate, at true line integrals.

    Args:
        line_integrals: ``(2, ...)`` mm, float32 or float64.
        model: forward model with the exposure of interest.
        columns, scale: of each ray, as for :func:`decompose`.
        order: 1: Cramér–Rao, F⁻¹ with F = Σ_i ∂λ_i ∂λ_iᵀ / λ_i. 2: the sharper bound of
            Bhattacharyya (1946), which tells how much of an excess over Cramér–Rao no unbiased
            estimate can avoid; they agree at high counts.

    Returns:
        ``(3, ...)`` C₁₁, C₁₂, C₂₂ in mm², dtype of ``line_integrals``.

    Raises:
        ValueError: a wrong shape, indices outside the detector, another order.
    """
    if line_integrals.ndim < 1 or line_integrals.shape[0] != 2:
        raise ValueError(
            f"line_integrals must have the shape (2, ...), got {tuple(line_integrals.shape)}"
        )
    if order not in (1, 2):
        raise ValueError(f"order must be 1 (Cramér–Rao) or 2 (Bhattacharyya), got {order!r}")
    shape = tuple(line_integrals.shape[1:])
    column, intensity = model.rays(shape, columns, scale)
    counts, slopes = evaluate(model, line_integrals, column, intensity)
    # Products of derivatives of the likelihood, Σ_i ∂_u λ_i ∂_v λ_i / λ_i: rays first, then 5 × 5.
    products = np.einsum("ubr,vbr->ruv", slopes / counts, slopes)
    information = products[:, :2, :2].copy()
    if order == 2:
        first, second = ((0, 0), (0, 1), (1, 1)), products[:, 2:, 2:].copy()
        for u, (p, q) in enumerate(first):
            for v, (s, t) in enumerate(first):
                f = information
                second[:, u, v] += f[:, p, s] * f[:, q, t] + f[:, p, t] * f[:, q, s]
        mixed = products[:, :2, 2:]
        information = information - mixed @ np.linalg.solve(second, mixed.swapaxes(1, 2))
    packed = torch.from_numpy(information[:, (0, 0, 1), (0, 1, 1)].T.copy())
    return inverse(packed).reshape(3, *shape).to(line_integrals.dtype)


@checked
def decompose_scan(
    scan: Scan, model: SpectralModel, *, readings: Tensor | None = None, **options: Any
) -> Decomposition:
    """:func:`decompose` of all readings of a spectral scan, ``(2, views, rows, columns)``; or of
    those chosen by ``readings``, bool ``(views, rows, columns)``: ``(2, chosen)``.

    Noise-free scans are decomposed without bias reduction and to ``EXACT_TOLERANCE`` unless
    ``options`` say otherwise.

    Raises:
        ValueError: a scan of one bin, or of another scanner or exposure than the model.
    """
    _check_spectral(scan)
    columns, scale = model.cells(scan)
    exact = {"bias_reduction": False, "tolerance": EXACT_TOLERANCE} if scan.noise_free else {}
    counts = scan.counts
    if readings is not None:
        columns, scale = (v.broadcast_to(readings.shape)[readings] for v in (columns, scale))
        counts = counts[:, readings]
    return decompose(counts, model, columns=columns, scale=scale, **{**exact, **options})


@checked
def decompose_exterior(scan: Scan, model: SpectralModel) -> Tensor:
    """Line integrals ``(2, rows, columns)`` in mm of a windowed scan's exterior, which is noise
    free.

    Raises:
        ValueError: the scan is not windowed, has one bin, or does not fit the model.
    """
    _check_spectral(scan)
    if scan.exterior is None:
        raise ValueError("a full scan has no exterior: use decompose_scan()")
    model.cells(scan)
    scale = torch.from_numpy(model.row_factor)[:, None]
    return decompose(
        scan.exterior, model, scale=scale, bias_reduction=False, tolerance=EXACT_TOLERANCE
    ).line_integrals


def _check_spectral(scan: Scan) -> None:
    if scan.counts.ndim != 4 or not scan.counting:
        raise ValueError(
            f"material decomposition needs photon counts in energy bins, got counts of the shape "
            f"{tuple(scan.counts.shape)}: acquire with presets.pcct(mode='spectral')"
        )
