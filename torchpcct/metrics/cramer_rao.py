"""The Cramér–Rao bound, what the data can give: the limit of generalised least squares for tissues
of known shape and unknown attenuation.

With path-length maps ``a_i`` (one per tissue) and independent readings of variance ``1 / w`` the
line integrals are ``y = Σ_i c_i a_i + noise``. The Gauss-Markov theorem: no unbiased linear
estimate of any functional ``h·c`` has a variance below ``hᵀ F⁻¹ h`` with the information ``F_ij =
<a_i, w a_j>``; for normal noise this is the Cramér–Rao bound, which binds every unbiased method,
linear or not. A reconstruction that must find the shapes knows less, so the limit holds for it as
well; a figure beyond it is bias.

All amplitudes of the information matrix count as unknown. A tissue whose value is taken as known
(say, the patient's fat, pinned by the rest of the scan) is left out of the maps.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from torchpcct.validate import checked, number

__all__ = ["cramer_rao_bound", "information_matrix"]

Floats = NDArray[np.float64]

_CHUNK = 1 << 20
"""Readings done together."""
_WORST_CONDITION = 1e12
"""Of the information scaled to a unit diagonal. Beyond it the inverse has no digits left in
float64."""


@checked
def information_matrix(
    maps: Sequence[ArrayLike] | Tensor, inverse_variance: ArrayLike, *, scale: float = 1.0
) -> Floats:
    """Fisher information of the tissue amplitudes, ``F_ij = scale² Σ a_i w a_j``.

    Args:
        maps: one array or tensor per tissue, or a stack ``(tissues, ...)``: path lengths in mm, any
            float dtype.
        inverse_variance: ``w``, the inverse variance of each line integral, shape of one map; 0 for
            a reading that is not used.
        scale: line integral per map unit and unit of amplitude: ``mu_ref / 1000`` for path lengths
            in mm and amplitudes in HU (``mu_ref`` in mm⁻¹).

    Returns:
        ``(tissues, tissues)`` float64 in amplitude⁻², summed in float64 over chunks.

    Raises:
        ValueError: no maps, shapes that differ, a negative weight, NaN or Inf, a scale that is not
            positive.
    """
    number("scale", scale, positive=True)
    if len(maps) == 0:
        raise ValueError("maps is empty: give the path lengths of at least one tissue")
    weight = torch.as_tensor(inverse_variance)
    tensors = [torch.as_tensor(m) for m in maps]
    for k, t in enumerate(tensors):
        if t.shape != weight.shape:
            raise ValueError(
                f"maps[{k}] has the shape {tuple(t.shape)}, inverse_variance "
                f"{tuple(weight.shape)}: compute both on the same detector window"
            )
    flat = [t.reshape(-1) for t in tensors]
    weight = weight.reshape(-1)
    total = torch.zeros((len(flat), len(flat)), dtype=torch.float64)
    for first in range(0, weight.numel(), _CHUNK):
        part = slice(first, first + _CHUNK)
        a = torch.stack([f[part].to(device="cpu", dtype=torch.float64) for f in flat])
        w = weight[part].to(device="cpu", dtype=torch.float64)
        if bool((w < 0).any()):
            raise ValueError(
                "inverse_variance must not be negative: use 0 for readings to leave out"
            )
        total += (a * w) @ a.T
    if not bool(torch.isfinite(total).all()):
        raise ValueError(
            "maps or inverse_variance hold NaN or Inf: give readings without a variance the "
            "weight 0"
        )
    result: Floats = total.numpy() * scale**2
    return (result + result.T) / 2


@checked
def cramer_rao_bound(information: ArrayLike, functionals: ArrayLike) -> Floats:
    """Smallest covariance of any unbiased estimate of linear functionals of the tissue amplitudes.

    Args:
        information: ``(tissues, tissues)`` of :func:`information_matrix`, which is proportional to
            the dose.
        functionals: ``(tissues,)`` one functional (a contrast: +1 and −1 at two tissues), or ``(m,
            tissues)`` several (an ROI inside one tissue: the unit vector of this tissue; across
            tissues: its area fractions).

    Returns:
        ``(m, m)`` float64, the square of the amplitudes' unit.

    Raises:
        ValueError: wrong shapes, an information that is not symmetric or that does not determine
            all amplitudes.
    """
    f = np.array(information, dtype=np.float64)
    if f.ndim != 2 or f.shape[0] != f.shape[1] or f.size == 0:
        raise ValueError(f"information must be a square matrix, got the shape {f.shape}")
    if not np.isfinite(f).all() or not np.allclose(f, f.T, rtol=1e-9, atol=1e-12 * np.abs(f).max()):
        raise ValueError(
            "information must be finite and symmetric: compute it with information_matrix"
        )
    h = np.atleast_2d(np.array(functionals, dtype=np.float64))
    if h.ndim != 2 or h.shape[1] != f.shape[0] or not np.isfinite(h).all():
        raise ValueError(
            f"functionals must be finite and ({f.shape[0]},) or (m, {f.shape[0]}), got {h.shape}"
        )
    diagonal = np.diag(f)
    if not (diagonal > 0).all():
        raise ValueError(
            f"no reading sees tissue {int(np.argmin(diagonal))}: leave its map out or widen the "
            "window"
        )
    # Tissues differ in size by orders of magnitude: a unit diagonal keeps the digits.
    root = 1.0 / np.sqrt(diagonal)
    values, vectors = np.linalg.eigh(f * root[:, None] * root)
    if values[0] <= values[-1] / _WORST_CONDITION:
        worst = np.abs(vectors[:, 0] * root)
        raise ValueError(
            "the readings cannot tell the tissues apart (least determined: "
            f"{int(worst.argmax())}): merge or drop maps"
        )
    spread = h @ (root[:, None] * vectors / np.sqrt(values))
    return np.asarray(spread @ spread.T)
