"""Keep the spectra of a Gram operator positive definite.

Exact impulse responses carry the beat of voxels and detector cells, and the square of lags is cut off: at a few per
mille of the frequencies the fitted spectrum is indefinite, which would let a weakly regularised solution escape there.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpcct.threads import run

__all__ = ["cholesky", "make_definite"]

# Smallest pivot, as a share of the diagonal, that a definite spectrum must have.
LEAST_PIVOT = 1e-4
# Stiffness added between two neighbouring slices at a time, as a share of the mean diagonal, and how often per
# frequency. Indefinite modes alternate from slice to slice, so this leaves objects that are smooth along z alone.
STIFFNESS, ADDITIONS = 2e-2, 600
# Where that does not help: shares of the position-dependent terms that are kept, then shifts of the diagonal.
KEPT = (0.5, 0.2, 0.0)
SHIFTS = (3e-3, 1e-2, 3e-2, 0.1, 0.3, 1.0, 3.0)


def cholesky(kernel: Tensor) -> tuple[Tensor, NDArray[np.bool_]]:
    """Banded L with L Lᴴ = kernel, ``(reach + 1, nz, ...)``, and where the kernel is positive definite, ``(...)``."""
    from recon.gram.kernels import banded_cholesky  # numba loads with its first use

    flat = kernel.cpu().reshape(*kernel.shape[:2], -1).to(torch.complex128).contiguous().numpy()
    lower = np.zeros_like(flat)
    definite = np.zeros(flat.shape[2], dtype=np.bool_)
    work = 4 * lower[..., 0].size * len(lower)
    run(banded_cholesky, definite.size, flat, LEAST_PIVOT, lower, definite, operations=work)
    return torch.from_numpy(lower).reshape(kernel.shape).to(kernel), definite.reshape(tuple(kernel.shape[2:]))


def make_definite(spectra: Tensor) -> Tensor:
    """Shift and damp spectra as little as needed.

    Args:
        spectra: ``(terms, reach + 1, nz, fy, fx)`` complex lower bands of K_c; terms 1, 3 (y, x) or 6 (… y², yx, x²).

    Returns:
        Spectra of the same shape for which Σ_c b_c K_c is positive definite at the centre, the corners and the edge
        midpoints of the grid, b_c ∈ monomials of y, x ∈ {−1, 0, 1}.
    """
    terms, bands, nz = spectra.shape[:3]
    flat = spectra.reshape(terms, bands, nz, -1).to(torch.complex128).numpy().copy()
    level = np.abs(flat[0, 0].real).mean(axis=0)

    from recon.gram.kernels import damp, stiffen  # numba loads with its first use

    plain = flat.copy()
    definite = np.zeros(flat.shape[-1], dtype=np.bool_)
    run(stiffen, definite.size, flat, _points(terms), LEAST_PIVOT, STIFFNESS, ADDITIONS, definite)
    todo = np.flatnonzero(~definite)
    flat[..., todo] = plain[..., todo]
    kept = np.array(KEPT if terms > 1 else ())
    least = 1e-9 * level.max()
    run(damp, todo.size, flat, _points(terms), LEAST_PIVOT, kept, np.array(SHIFTS), level, least, todo)
    return torch.from_numpy(flat).reshape(spectra.shape).to(spectra)


def _points(terms: int) -> NDArray[np.float64]:
    """Polynomials b_c at the centre, the corners and the edge midpoints of the grid, ``(points, terms)``."""
    at = (-1, 0, 1) if terms > 1 else (0,)
    return np.array([[1, y, x, y * y, y * x, x * x][:terms] for y in at for x in at], dtype=np.float64)
