"""What the data give when shapes are known only so well: the limit between the ideal and a method that must find them.

:mod:`torchpcct.metrics.ceiling` takes the outlines of all tissues as known. Here only the inside of each tissue is
known: voxels that an outline crosses, and those within a few rings of it, may hold anything. With

    x = Σ_k a_k m_k + z,      m_k: the inside of tissue k,   z: free voxels, z ~ N(0, s²) each,

the covariance of the a_k is the inverse of the Schur complement of AᵀWA; one conjugate-gradient solve per contrast.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

__all__ = ["contrast_limit", "known_inside"]


def known_inside(fractions: NDArray[np.float64], rings: int = 0) -> NDArray[np.bool_]:
    """Voxels that belong to one tissue for sure.

    Args:
        fractions: ``(tissues, z, y, x)`` volume fractions that add up to 1 (:func:`torchpcct.scene.raster`).
        rings: voxel layers next to an outline that are not known either; 0 frees the crossed voxels alone.

    Returns:
        ``(tissues, z, y, x)`` masks.
    """
    if rings < 0:
        raise ValueError(f"rings must be at least 0, got {rings}")
    pure = np.asarray(fractions) > 0.999
    if rings:
        from scipy import ndimage

        pure = np.stack([ndimage.binary_erosion(p, iterations=rings, border_value=1) for p in pure])
    return np.asarray(pure, dtype=bool)


def contrast_limit(
    gram: Any,
    inside: NDArray[np.bool_],
    contrast: tuple[int, int],
    *,
    hu: float,
    free_sd_hu: float = 200.0,
    iterations: int = 400,
    tolerance: float = 1e-6,
) -> float:
    """Smallest standard deviation in HU of the difference of two tissues.

    Args:
        gram: AᵀWA of the inset at the exposure in question (``apply``), in mm⁻¹.
        inside: ``(tissues, z, y, x)`` masks of the tissues (:func:`known_inside`), each of one unknown value; voxels
            in no mask are free.
        contrast: indices of the two tissues.
        hu: 1 HU in mm⁻¹.
        free_sd_hu: s.
        iterations, tolerance: of the conjugate gradients.

    Raises:
        ValueError: one of the two tissues has no inside: its value cannot be told from its outline.
    """
    masks = torch.from_numpy(np.asarray(inside, dtype=np.float32))
    for k in contrast:
        if not masks[k].any():
            raise ValueError(f"tissue {k} has no voxel that is inside for sure: take smaller voxels or fewer rings")
    present = [k for k in range(len(masks)) if masks[k].any()]
    masks = masks[present]
    first, second = (present.index(k) for k in contrast)
    free = 1.0 - masks.sum(0)

    def curve(a: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        y = gram.apply((torch.einsum("k,kzyx->zyx", a, masks) + free * z) * hu) * hu
        return torch.einsum("kzyx,zyx->k", masks, y), free * y + free * z / free_sd_hu**2

    diagonal = torch.stack([(m * gram.apply(m * hu)).sum() * hu for m in masks])
    # A voxel's own information, the same everywhere but for a slow drift.
    one = torch.zeros(masks.shape[1:])
    centre = tuple(n // 2 for n in one.shape)
    one[centre] = 1.0
    own = float(gram.apply(one * hu)[centre]) * hu + 1.0 / free_sd_hu**2
    target = torch.zeros(len(masks))
    target[first], target[second] = 1.0, -1.0
    a, z = torch.zeros_like(target), torch.zeros_like(free)
    ra, rz = target.clone(), torch.zeros_like(free)
    pa, pz = ra / diagonal, rz / own
    size = _dot(ra, pa) + _dot(rz, pz)
    start = size
    for _ in range(iterations):
        qa, qz = curve(pa, pz)
        step = size / (_dot(pa, qa) + _dot(pz, qz))
        a, z = a + step * pa, z + step * pz
        ra, rz = ra - step * qa, rz - step * qz
        ya, yz = ra / diagonal, rz / own
        new = _dot(ra, ya) + _dot(rz, yz)
        if new <= tolerance**2 * start:
            break
        pa, pz = ya + new / size * pa, yz + new / size * pz
        size = new
    return float((a * target).sum().clamp_min(0.0).sqrt())


def _dot(a: Tensor, b: Tensor) -> float:
    return float((a * b).sum(dtype=torch.float64))
