"""What readings and priors of all sizes and directions say of a path: its mean, its covariance, and
how likely the readings are."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from recon.variable_projection import (
    Normal,
)

if TYPE_CHECKING:
    from torchpcct.typing import Floats

_SIZES_MM = (0.02, 0.05, 0.1, 0.2, 0.4, 0.8)
"""Of the prior's motion across the axis of the scanner, root mean squares."""
_HEIGHTS_MM = (0.003, 0.02, 0.05, 0.1, 0.2, 0.4, 0.8)
"""Of the same along the axis."""
_WIDTHS = {1.0: 1, 0.3: 12, 0.1: 24}
"""Smaller extent of the prior's motion across the axis over its larger one, and how many directions
of the larger one are tried: a line is an ellipse of a tenth."""
_LEAST_MM = 0.003
"""Of the prior's scale along any direction."""
_JUMPS_MM = (0.1, 0.3, 0.9)
"""Of the prior's jump along each axis, standard deviations."""
_NEGLIGIBLE = 1e-7
"""Share of the whole below which a prior does nothing."""


@dataclass(frozen=True)
class Belief:
    """What the readings and the prior say of the coefficients ``(k, 3)``, flattened axis by axis.

    Attributes:
        mean, covariance: of the coefficients.
        evidence: logarithm of the marginal likelihood over that of rest.
        gain: of that by the jump; 0 without one.
    """

    mean: Floats
    covariance: Floats
    evidence: float
    gain: float = 0.0


def believed(found: Normal, at: Floats, inflation: float, jumps: bool = False) -> Belief:
    """The coefficients under normal priors of all sizes and directions, weighted by how likely the
    readings are under each; the covariance holds how far their means differ.

    Args:
        found: equations about ``at``.
        at: ``(k, 3)``.
        jumps: whether the last of the k is a jump.
    """
    k = len(at)
    precision, pull = likelihood_of(found, at, inflation)
    prior, shares = _priors(k - jumps, jumps)
    means, evidence = _weighed(precision, pull, prior, shares)
    top = float(evidence.max())
    weights = np.exp(evidence - top)
    total = float(weights.sum())
    likely = weights > _NEGLIGIBLE * total
    weights, means = weights[likely] / weights[likely].sum(), means[likely]
    covariances = np.linalg.solve(np.eye(3 * k) + prior[likely] @ precision, prior[likely])
    mean = weights @ means
    apart = means - mean
    covariance = np.einsum("m,mij->ij", weights, covariances) + (apart.T * weights) @ apart
    whole = top + math.log(total)
    gain = whole - evidence_of((precision, pull), range(k - 1)) if jumps else 0.0
    return Belief(mean.reshape(3, k).T, 0.5 * (covariance + covariance.T), whole, gain)


def likelihood_of(found: Normal, at: Floats, inflation: float) -> tuple[Floats, Floats]:
    """Precision and pull of the coefficients by the readings alone, about zero."""
    h = found.information
    unit = np.sqrt(np.maximum(np.diag(h), 1e-300))
    spread = found.spread * inflation / np.outer(unit, unit)
    inverse = np.linalg.pinv(spread, rcond=1e-6, hermitian=True) / np.outer(unit, unit)
    return h @ inverse @ h, h @ inverse @ (found.pull + h @ at.T.ravel())


def _weighed(
    precision: Floats, pull: Floats, prior: Floats, shares: Floats
) -> tuple[Floats, Floats]:
    """Means ``(n, 3 k)`` under each prior, and logarithms of how likely the readings are under it
    over rest, times its share."""
    matrix = np.eye(len(pull)) + prior @ precision
    means = np.asarray(np.linalg.solve(matrix, (prior @ pull)[..., None])[..., 0], np.float64)
    evidence = 0.5 * means @ pull - 0.5 * np.linalg.slogdet(matrix)[1] + np.log(shares)
    return means, np.asarray(evidence, np.float64)


def evidence_of(
    likelihood: tuple[Floats, Floats],
    columns: Sequence[int],
    jumps: bool = False,
    round_only: bool = False,
) -> float:
    """Logarithm of the marginal likelihood over that of rest, of paths of some columns only; for
    ``jumps`` and ``round_only`` see :func:`_priors`."""
    precision, pull = likelihood
    at = np.arange(len(pull)).reshape(3, -1)[:, columns].ravel()
    priors = _priors(len(columns) - jumps, jumps, round_only)
    found = _weighed(precision[np.ix_(at, at)], pull[at], *priors)[1]
    return float(np.logaddexp.reduce(found))


@cache
def _priors(k: int, jumps: bool, round_only: bool = False) -> tuple[Floats, Floats]:
    """Covariances ``(n, 3 k, 3 k)`` of the coefficients of ``k`` columns, axis by axis, and how
    likely each is before any reading; ``jumps``: of one column more. ``round_only``: of no
    direction in the plane."""
    found, shares = [], []
    for width, ways in ({1.0: 1} if round_only else _WIDTHS).items():
        for way in math.pi * np.arange(ways) / ways:
            along = np.array([math.sin(way), math.cos(way)])
            across = np.array([math.cos(way), -math.sin(way)])
            shape = np.outer(along, along) + width**2 * np.outer(across, across)
            for size, height in product(_SIZES_MM, _HEIGHTS_MM):
                one = np.zeros((3, 3))
                one[0, 0] = height**2
                one[1:, 1:] = size**2 * shape + _LEAST_MM**2 * np.eye(2)
                found.append(one)
                shares.append(1.0 / ways)
    between, likely = np.stack(found), np.array(shares) / sum(shares)
    if not jumps:
        return np.einsum("mij,kl->mikjl", between, np.eye(k)).reshape(-1, 3 * k, 3 * k), likely
    whole = np.zeros((len(_JUMPS_MM), len(between), 3, k + 1, 3, k + 1))
    whole[:, :, :, :k, :, :k] = np.einsum("mij,kl->mikjl", between, np.eye(k))
    for size, one in zip(_JUMPS_MM, whole, strict=True):
        one[:, :, k, :, k] = size**2 * np.eye(3)
    n = 3 * (k + 1)
    return whole.reshape(-1, n, n), np.tile(likely, len(_JUMPS_MM)) / len(_JUMPS_MM)
