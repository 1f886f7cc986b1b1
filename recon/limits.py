"""What the data give when shapes are known only so well: limits between the ideal and a method that must find them.

:mod:`torchpcct.metrics.data_limit` takes the outlines of all tissues as known. Here they are not:

* :func:`contrast_limit` knows only the inside of each tissue; voxels that an outline crosses, and those within a few
  rings of it, may hold anything;
* :func:`deformation_limit` knows the outlines up to a smooth displacement of a given size, as a method does that has
  found them roughly.

Both write the volume as

    x = Σ_k a_k m_k + B z,      z ~ N(0, 1) each,

m_k the tissues' maps and B z what is unknown beside their values a_k. The covariance of the a_k is the inverse of the
Schur complement of AᵀWA; one conjugate-gradient solve per contrast.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from recon.conjugate_gradient import conjugate_gradient
from recon.linear_operator import gaussian_kernel, separable_filter
from torchpcct.validate import checked, number, whole

__all__ = ["contrast_limit", "deformation_limit", "known_inside", "outline_maps"]


_CROFTON = {
    step: {1: 0.0915558, 2: 0.0739613, 3: 0.0703913}[sum(map(abs, step))]
    for step in itertools.product((-1, 0, 1), repeat=3)
    if step > (0, 0, 0)
}
"""Each direction to a neighbouring voxel, one of two opposite ones, and its share of the sphere."""


@checked
def known_inside(fractions: NDArray[np.float64], rings: int = 0) -> NDArray[np.bool_]:
    """Voxels that belong to one tissue for sure.

    Args:
        fractions: ``(tissues, z, y, x)`` volume fractions that add up to 1 (:func:`torchpcct.scene.raster`).
        rings: voxel layers next to an outline that are not known either; 0 frees the crossed voxels alone.

    Returns:
        ``(tissues, z, y, x)`` masks.
    """
    whole("rings", rings, 0)
    pure = np.asarray(fractions) > 0.999
    if rings:
        pure = np.stack([ndimage.binary_erosion(p, iterations=rings, border_value=1) for p in pure])
    return np.asarray(pure, dtype=bool)


@checked
def contrast_limit(
    gram: Any,
    inside: NDArray[np.bool_],
    contrast: tuple[int, int],
    *,
    mu_per_hu: float,
    free_sd_hu: float = 200.0,
    iterations: int = 400,
    tolerance: float = 1e-6,
) -> float:
    """Smallest standard deviation in HU of the difference of two tissues of which only the inside is known.

    Args:
        gram: AᵀWA of the inset at the exposure in question (``apply``), in mm⁻¹.
        inside: ``(tissues, z, y, x)`` masks of the tissues (:func:`known_inside`), each of one unknown value; voxels
            in no mask are free.
        contrast: indices of the two tissues.
        mu_per_hu: 1 HU in mm⁻¹.
        free_sd_hu: standard deviation of each free voxel.
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
    free = (1.0 - masks.sum(0)) * free_sd_hu
    pair = (present.index(contrast[0]), present.index(contrast[1]))
    return _smallest_sd(
        gram, masks, (lambda z: free * z, lambda y: free * y), tuple(free.shape), pair, mu_per_hu, iterations, tolerance
    )


@checked
def outline_maps(
    labels: NDArray[np.integer[Any]], values: Sequence[float], factor: int, fine_mm: float
) -> NDArray[np.float32]:
    """What a displacement of each outline by 1 mm changes in each voxel.

    The areas are Crofton's: twice the mean number of crossings of lines in 13 directions (Lehmann, Legland 2012,
    Insight Journal, "Efficient N-dimensional surface estimation using Crofton formula"); up to 7 % off for a plane.

    An outline lies between two tissues; where it moves by d along its normal, a voxel changes by the difference of the
    two values times d times the outline's area in it over the voxel's volume.

    Args:
        labels: ``(factor·z, factor·y, factor·x)`` index of the tissue in each fine voxel.
        values: HU of each tissue.
        factor: fine voxels along each edge of a voxel.
        fine_mm: edge of a fine voxel, less than the thinnest tissue.

    Returns:
        ``(outlines, z, y, x)`` HU per mm, one for each two tissues that touch and differ.

    Raises:
        ValueError: a shape that is no multiple of ``factor``.
    """
    if any(n % factor for n in labels.shape):
        raise ValueError(f"labels of shape {labels.shape} are no multiple of factor {factor}")
    shape = tuple(n // factor for n in labels.shape)
    count = len(values)
    areas = np.zeros((count * count, *shape))
    for step, weight in _CROFTON.items():
        first = tuple(slice(max(0, -d), n - max(0, d)) for d, n in zip(step, labels.shape, strict=True))
        second = tuple(slice(max(0, d), n - max(0, -d)) for d, n in zip(step, labels.shape, strict=True))
        a, b = labels[first], labels[second]
        at = np.nonzero(a != b)
        one, other = a[at], b[at]
        pair = np.minimum(one, other) * count + np.maximum(one, other)
        voxel = tuple((k + f.start) // factor for k, f in zip(at, first, strict=True))
        index = np.ravel_multi_index((pair, *voxel), areas.shape)
        crossed = np.bincount(index, minlength=areas.size).reshape(areas.shape)
        areas += 2.0 * weight * crossed * fine_mm**2 / math.sqrt(sum(d * d for d in step))
    maps = [
        (values[b] - values[a]) * areas[a * count + b] / (factor * fine_mm) ** 3
        for a, b in itertools.combinations(range(count), 2)
        if values[a] != values[b] and areas[a * count + b].any()
    ]
    return np.asarray(maps, dtype=np.float32).reshape(-1, *shape)


@checked
def deformation_limit(
    gram: Any,
    fractions: NDArray[np.float64],
    outlines: NDArray[np.float32],
    contrast: tuple[int, int],
    *,
    mu_per_hu: float,
    voxel_mm: float,
    displacement_mm: float,
    correlation_mm: float = 0.5,
    iterations: int = 600,
    tolerance: float = 1e-5,
) -> float:
    """Smallest standard deviation in HU of the difference of two tissues whose outlines are known up to a smooth error.

    Each outline is displaced along its normal by a Gaussian random field; its effect on the volume is taken to first
    order. That is right for displacements well below the thickness of the tissues between the outlines: as large as the
    paper's cap (0.17 mm) or wall (0.19 mm) they are extrapolated, for a layer cannot vanish or turn over here.

    The figure hinges on the voxels, which must be small beside the layers: on large ones outlines that lie close
    together change the same voxels and cannot be told apart (the paper's plaque: not converged at 0.2 mm).

    Args:
        gram: AᵀWA of the inset at the exposure in question (``apply``), in mm⁻¹.
        fractions: ``(tissues, z, y, x)`` volume fractions of the tissues whose values are unknown.
        outlines: ``(outlines, z, y, x)`` HU per mm of displacement (:func:`outline_maps`).
        contrast: indices of the two tissues in ``fractions``.
        mu_per_hu: 1 HU in mm⁻¹.
        voxel_mm: edge of the cubic voxels.
        displacement_mm: standard deviation of the displacement; 0: the shapes are known.
        correlation_mm: ℓ of its correlation exp(−r² / 2ℓ²).
        iterations, tolerance: of the conjugate gradients.

    Raises:
        ValueError: a displacement or correlation out of range.
    """
    number("displacement_mm", displacement_mm, low=0.0)
    number("correlation_mm", correlation_mm, positive=True)
    masks = torch.from_numpy(np.asarray(fractions, dtype=np.float32))
    change = torch.from_numpy(np.asarray(outlines, dtype=np.float32)) * displacement_mm
    # White noise through a kernel of unit norm and σ = ℓ/√2 has unit variance and the correlation exp(−r²/2ℓ²).
    sd = correlation_mm / math.sqrt(2.0) / voxel_mm
    kernel = gaussian_kernel(sd, math.ceil(4 * sd), change)
    kernel = kernel / kernel.norm()

    def smooth(v: Tensor) -> Tensor:
        return separable_filter(v, kernel, "constant")

    unknown = (lambda z: (change * smooth(z)).sum(0), lambda y: smooth(change * y))
    return _smallest_sd(gram, masks, unknown, tuple(change.shape), contrast, mu_per_hu, iterations, tolerance)


def _smallest_sd(
    gram: Any,
    masks: Tensor,
    unknown: tuple[Callable[[Tensor], Tensor], Callable[[Tensor], Tensor]],
    shape: tuple[int, ...],
    contrast: tuple[int, int],
    mu_per_hu: float,
    iterations: int,
    tolerance: float,
) -> float:
    """√(tᵀ C t), C the covariance of the values of ``masks``, t the contrast; ``unknown``: B and Bᵀ."""
    forward, transposed = unknown
    count = len(masks)

    def curve(v: Tensor) -> Tensor:
        """The inverse covariance of all unknowns, ``(1, values + fields)``."""
        a, z = v[0, :count], v[0, count:].reshape(shape)
        y = gram.apply((torch.einsum("k,kzyx->zyx", a, masks) + forward(z)) * mu_per_hu) * mu_per_hu
        return torch.cat([torch.einsum("kzyx,zyx->k", masks, y), (transposed(y) + z).flatten()])[None]

    diagonal = torch.stack([(m * gram.apply(m * mu_per_hu)).sum() * mu_per_hu for m in masks])
    # The mean of the other diagonal, from a random vector of signs (Hutchinson).
    signs = torch.randint(0, 2, shape, generator=torch.Generator().manual_seed(0)).flatten().to(torch.float32) * 2 - 1
    own = float((signs * curve(torch.cat([torch.zeros(count), signs])[None])[0, count:]).mean().clamp_min(1.0))
    scale = torch.cat([diagonal, torch.full((math.prod(shape),), own)])
    target = torch.zeros_like(scale)[None]
    target[0, contrast[0]], target[0, contrast[1]] = 1.0, -1.0
    solved = conjugate_gradient(curve, target, lambda v: v / scale, iterations=iterations, tolerance=tolerance)
    return float((solved * target).sum().clamp_min(0.0).sqrt())
