"""Multi-material decomposition: volume fractions of several tissues from two basis images.

Mendonça, Lamb and Sahani, "A flexible method for multi-material decomposition of dual-energy CT
images", IEEE Trans. Med. Imaging 33 (2014) 99: a voxel is an ideal mixture, whose basis
coefficients are the volume-weighted means of its parts. Two coefficients and Σ α = 1 determine
three fractions, so of all triplets of tissues one is chosen per voxel: the one whose triangle in
the plane of coefficients holds the voxel or comes nearest. Where triangles overlap, the smallest
one wins (the most specific explanation); a voxel outside all of them moves to the nearest point of
the nearest triangle.

Cleaning: Li et al. name "a standard 2D k-means clustering" without its features. :func:`clean`
takes the fractions and starts the clusters at the pure tissues, so that each keeps its name and the
result does not depend on chance. :func:`nearest` keeps the centres there and measures distances in
the two dimensions of the basis plane, in units of its noise: voxels at the edge of the vessel,
mixed with fat, then move no centre.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from torchpcct.scene.materials import Material
from torchpcct.spectral.basis import FIT_ENERGIES_KEV, Basis
from torchpcct.validate import checked

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from torchpcct.typing import Floats


__all__ = ["MMD_TISSUES", "clean", "label", "mmd", "nearest"]

MMD_TISSUES = ("blood_iodine", "necrotic_core", "fibrous_tissue", "pericoronary_fat")
"""The tissues of Li et al."""

_SLACK = 1e-9  # round-off: a voxel on an edge is inside
"""Round-off: a voxel on an edge is inside."""
_ITERATIONS = 50
"""Most of Lloyd's algorithm, which usually ends after a few."""


@checked
def mmd(
    basis_images: Tensor,
    basis: Basis,
    tissues: Sequence[Material | str] | ArrayLike = MMD_TISSUES,
    covariance: ArrayLike | None = None,
) -> Tensor:
    """Volume fractions.

    Args:
        basis_images: ``(2, ...)`` basis coefficients (dimensionless).
        basis: of the images.
        tissues: three or more materials (or their names), or their coefficients ``(2, K)`` e.g.
            measured in ROIs.
        covariance: ``(3,)`` C₁₁, C₁₂, C₂₂ of the noise: distances are then in standard deviations,
            which makes the nearest mixture the most likely one. None: distance between the
            attenuations at 40…140 keV.

    Returns:
        ``(K, ...)`` fractions ≥ 0 with sum 1, at most three of them not 0; dtype of
        ``basis_images``.

    Raises:
        ValueError: fewer than three tissues, all of them on one line, a wrong shape, NaN or Inf in
            the images, a covariance that is not positive definite.
    """
    images = torch.as_tensor(basis_images)
    if images.ndim < 1 or images.shape[0] != 2 or not images.is_floating_point():
        raise ValueError(
            f"basis_images must be floating-point (2, ...), got {images.dtype} "
            f"{tuple(images.shape)}"
        )
    if not bool(torch.isfinite(images).all()):
        raise ValueError(
            "basis_images hold NaN or Inf: check the decomposition and the reconstruction"
        )
    corners = _corners(basis, tissues)
    transform = _whitening(basis, covariance)
    corners = transform @ corners
    x = torch.from_numpy(transform) @ images.detach().to(torch.float64).reshape(2, -1).cpu()
    count = corners.shape[1]
    triplets = sorted(itertools.combinations(range(count), 3), key=lambda t: _area(corners[:, t]))
    scale = max(_area(corners[:, t]) for t in triplets)
    triplets = [t for t in triplets if _area(corners[:, t]) > 1e-9 * scale]
    if not scale > 1e-12 * float((corners**2).sum()):
        raise ValueError(
            "the tissues lie on one line of the basis plane: three fractions are not determined"
        )
    best = torch.full((x.shape[1],), torch.inf, dtype=torch.float64)
    fractions = torch.zeros((count, x.shape[1]), dtype=torch.float64)
    for t in triplets:
        alpha, distance = _nearest(x, torch.from_numpy(corners[:, t]))
        better = distance < best  # strictly: on a tie the smaller triangle, which came first, stays
        best = torch.where(better, distance, best)
        candidate = torch.zeros_like(fractions)
        candidate[list(t)] = alpha
        fractions = torch.where(better, candidate, fractions)
    return fractions.reshape(count, *images.shape[1:]).to(images)


def _corners(basis: Basis, tissues: Any) -> Floats:
    if isinstance(tissues, np.ndarray | Tensor):
        c = torch.as_tensor(tissues).detach().to("cpu", torch.float64).numpy()
    else:
        c = (
            np.stack([basis.coefficients(t) for t in tissues], axis=1)
            if len(tissues)
            else np.zeros((2, 0))
        )
    if c.ndim != 2 or c.shape[0] != 2 or c.shape[1] < 3 or not np.isfinite(c).all():
        raise ValueError(
            "mmd needs 3 or more tissues: materials, names, or finite coefficients (2, K); got "
            f"{tissues!r}"
        )
    return c


def _whitening(basis: Basis, covariance: ArrayLike | None) -> NDArray[np.floating]:
    """2 × 2 matrix after which distances are Euclidean."""
    if covariance is None:
        mu = basis.attenuation(FIT_ENERGIES_KEV)
        return np.linalg.cholesky(mu @ mu.T).T
    c = np.asarray(covariance, np.float64)
    if c.shape != (3,) or not (c[0] > 0 and c[2] > 0 and c[0] * c[2] > c[1] ** 2):
        raise ValueError(
            "covariance must be 3 values C11, C12, C22 of a positive definite matrix, got "
            f"{covariance!r}"
        )
    return np.linalg.cholesky(np.linalg.inv(np.array([[c[0], c[1]], [c[1], c[2]]]))).T


def _area(corners: Floats) -> float:
    a, b = (corners[:, 1:] - corners[:, :1]).T
    return float(abs(a[0] * b[1] - a[1] * b[0]))


def _nearest(x: Tensor, corners: Tensor) -> tuple[Tensor, Tensor]:
    """Fractions ``(3, n)`` of the triangle's point nearest to each ``x`` (2, n), and the squared
    distance (n,)."""
    matrix = torch.cat([corners, torch.ones(1, 3, dtype=torch.float64)])
    target = torch.cat([x, torch.ones(1, x.shape[1], dtype=torch.float64)])
    alpha = torch.linalg.solve(matrix, target)
    inside = (alpha >= -_SLACK).all(0)
    alpha = alpha.clamp_min(0)
    alpha = alpha / alpha.sum(0)
    distance = torch.where(inside, 0.0, torch.inf)
    for i, j in ((0, 1), (1, 2), (2, 0)):
        start, edge = corners[:, i, None], (corners[:, j] - corners[:, i])[:, None]
        s = (((x - start) * edge).sum(0) / (edge * edge).sum()).clamp(0, 1)
        d = (x - start - s * edge).square().sum(0)
        on_edge = torch.zeros_like(alpha)
        on_edge[i], on_edge[j] = 1 - s, s
        nearer = d < distance
        alpha = torch.where(nearer, on_edge, alpha)
        distance = torch.where(nearer, d, distance)
    return alpha, distance


@checked
def label(fractions: Tensor) -> Tensor:
    """The tissue with the largest fraction in each voxel.

    Args:
        fractions: volume fractions of K tissues, ``(K, ...)``, floating point.

    Returns:
        Index of the tissue, ``(...)`` int64.

    Raises:
        TypeError: fractions of another dtype, or without an axis of tissues.
    """
    if not fractions.is_floating_point() or not fractions.ndim:
        raise TypeError(
            f"fractions must be a floating point tensor (K, ...), got {fractions.dtype}"
        )
    return fractions.argmax(0)


@checked
def nearest(
    fractions: Tensor,
    basis: Basis,
    tissues: Sequence[Material | str] | ArrayLike = MMD_TISSUES,
    covariance: ArrayLike | None = None,
) -> Tensor:
    """The pure tissue nearest to each mixture: k-means whose centres stay at the tissues, which are
    known.

    The largest fraction is a poor label where tissues lie nearly on one line of the basis plane:
    the necrotic core lies 0.08 standard deviations off the line from fat to fibrous tissue (0.2 mm
    voxels, the exposure of the paper's tables), so noise turns a core into a mixture of fat and
    fibrous tissue with hardly any core in it. The mixture itself stays where it was; with its
    distance to the tissues measured in standard deviations, the nearest one is the most likely.

    Args:
        fractions: ``(K, ...)`` of :func:`mmd`.
        basis, tissues, covariance: as given there.

    Returns:
        ``(...)`` int64 index of the tissue.

    Raises:
        ValueError: a number of fractions that is not that of the tissues; see also :func:`mmd`.
    """
    corners = _whitening(basis, covariance) @ _corners(basis, tissues)
    if fractions.ndim < 1 or fractions.shape[0] != corners.shape[1]:
        raise ValueError(
            f"fractions must have {corners.shape[1]} tissues first, got the shape "
            f"{tuple(fractions.shape)}"
        )
    points = torch.from_numpy(corners)
    x = points @ fractions.detach().to(torch.float64).reshape(len(fractions), -1).cpu()
    # less |x|², the same for all tissues
    distance = points.square().sum(0)[:, None] - 2 * points.T @ x
    return distance.argmin(0).reshape(fractions.shape[1:]).to(fractions.device)


@checked
def clean(fractions: Tensor) -> Tensor:
    """Labels from noisy fractions by k-means.

    Args:
        fractions: ``(K, y, x)`` or ``(K, z, y, x)`` of :func:`mmd`.

    Returns:
        ``(y, x)`` or ``(z, y, x)`` int64 labels 0…K−1 in the order of the tissues. A cluster that
        loses its last voxel keeps its centre.

    Raises:
        ValueError: a wrong number of axes.
    """
    if fractions.ndim not in (3, 4):
        raise ValueError(
            f"fractions must be (K, y, x) or (K, z, y, x), got the shape {tuple(fractions.shape)}"
        )
    count = fractions.shape[0]
    x = fractions.detach().to(torch.float64).reshape(count, -1)
    centres = torch.eye(count, dtype=torch.float64, device=x.device)  # (clusters, K)
    labels = torch.full((x.shape[1],), -1, device=x.device)
    for _ in range(_ITERATIONS):
        # less |x|², the same for all clusters
        distance = centres.square().sum(1)[:, None] - 2 * centres @ x
        new = distance.argmin(0)
        if bool((new == labels).all()):
            break
        labels = new
        size = torch.bincount(labels, minlength=count)
        sums = torch.zeros_like(centres).index_add_(0, labels, x.T)
        centres = torch.where((size > 0)[:, None], sums / size.clamp_min(1)[:, None], centres)
    return labels.reshape(fractions.shape[1:])
