"""Channelised Hotelling observer: is the core there? A task figure that contrast shrinkage cannot improve.

Each image is reduced to its responses to a few channels centred at the known place of the core; the observer is the
best linear combination of them, ``w = K⁻¹ (v̄₁ − v̄₀)`` with the mean covariance K of both classes. Present and absent
images with the same noise seed form a PAIR: they are left out together when the observer is trained, and the interval
of the area under the ROC curve treats the pair as the sampling unit.

Channels: dense difference of Gaussians (Abbey and Barrett, J. Opt. Soc. Am. A 18, 473 (2001)), radial in mm, so that
they serve a plane or a volume of any spacing.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import expit, logit, ndtri

from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.intervals import Estimate, bca_interval, evaluate, leave_one_out, resampling
from torchpcct.metrics.roi import as_array
from torchpcct.validate import checked, coverage

__all__ = [
    "ObserverResult",
    "auc",
    "channel_responses",
    "d_prime",
    "dog_channels",
    "hotelling_scores",
    "observe",
    "template_channel",
]

Floats = NDArray[np.float64]


@checked
def dog_channels(
    grid: VolumeGrid,
    center: tuple[float, ...],
    count: int = 10,
    lowest: float | None = None,
    ratio: float = 1.4,
    width: float = 1.67,
) -> Floats:
    """Dense difference-of-Gaussians channels: ``exp(−f² / 2 (Q s_j)²) − exp(−f² / 2 s_j²)``, ``s_j = s₀ αʲ``.

    Args:
        grid: ``(y, x)`` axial plane or ``(z, y, x)`` volume.
        center: of the channels in mm, in the order of the grid's axes (the core's known place).
        count: channels.
        lowest: s₀ in cycles per mm; None: 0.005 cycles per voxel of the finest axis, as in the source.
        ratio, width: α and Q of the source.

    Returns:
        ``(count, *grid.shape)`` float64, each of unit norm.

    Raises:
        ValueError: a centre of other axes than the grid, a count < 1, parameters that do not give channels.
    """
    if len(center) != grid.ndim:
        raise ValueError(f"center must have {grid.ndim} numbers in mm, one per axis of the grid, got {center!r}")
    s0 = 0.005 / min(grid.spacing) if lowest is None else float(lowest)
    if count < 1 or not s0 > 0 or not ratio > 1 or not width > 1:
        raise ValueError(f"need count ≥ 1, lowest > 0, ratio > 1 and width > 1, got {count}, {s0}, {ratio}, {width}")
    squares = np.zeros(grid.shape)
    for axis, (positions, c) in enumerate(zip(grid.axes, center, strict=True)):
        shape = [1] * grid.ndim
        shape[axis] = -1
        squares = squares + np.square(positions - c).reshape(shape)

    def gaussian(s: float) -> Floats:
        return s**grid.ndim * np.exp(-2.0 * (math.pi * s) ** 2 * squares)

    channels = np.stack([gaussian(width * s) - gaussian(s) for s in s0 * ratio ** np.arange(count)])
    return channels / np.sqrt(np.square(channels).sum(tuple(range(1, channels.ndim)), keepdims=True))


@checked
def template_channel(expected_difference: ArrayLike) -> Floats:
    """The known signal itself as a channel, ``(1, ...)`` of unit norm: to be stacked with the others.

    Args:
        expected_difference: mean image with the core minus mean image without it.

    Raises:
        ValueError: an image that is 0 everywhere, or NaN or Inf.
    """
    t = as_array(expected_difference).astype(np.float64)
    norm = float(np.sqrt(np.square(t).sum()))
    if not (math.isfinite(norm) and norm > 0):
        raise ValueError("expected_difference must be finite and differ from 0 somewhere")
    return (t / norm)[None]


@checked
def channel_responses(images: ArrayLike, channels: ArrayLike) -> Floats:
    """Inner products of images ``(n, ...)`` with channels ``(c, ...)``, ``(n, c)`` float64.

    Raises:
        ValueError: images and channels of different shapes, NaN or Inf.
    """
    x, c = as_array(images), as_array(channels)
    if x.ndim < 2 or x.shape[1:] != c.shape[1:]:
        raise ValueError(f"images (n, ...) and channels (c, ...) must match, got {x.shape} and {c.shape}")
    flat = c.reshape(c.shape[0], -1).astype(np.float64)
    responses = np.stack([flat @ image.reshape(-1).astype(np.float64) for image in x])
    if not np.isfinite(responses).all():
        raise ValueError("images hold NaN or Inf: check the reconstruction before measuring it")
    return responses


@checked
def hotelling_scores(present: ArrayLike, absent: ArrayLike) -> tuple[Floats, Floats]:
    """Decision variables of the Hotelling observer, each pair scored by an observer trained on all others.

    Args:
        present, absent: ``(n, channels)`` responses; pair k has one noise seed.

    Returns:
        scores of present and absent, ``(n,)`` each, scaled to the observer's own d′ units: the expected difference of a
        trained observer is its d′².

    Raises:
        ValueError: wrong shapes, too few training pairs for the channels, channels that are linearly dependent.
    """
    a, b = np.asarray(present, dtype=np.float64), np.asarray(absent, dtype=np.float64)
    if a.ndim != 2 or a.shape != b.shape:
        raise ValueError(f"present and absent must be (n, channels) pairs, got {a.shape} and {b.shape}")
    n, c = a.shape
    used = n - 1
    if used <= c:
        raise ValueError(f"{used} training pairs are too few for {c} channels: use at least {c + 1}, or fewer channels")
    da, db = a - a.mean(0), b - b.mean(0)
    own = [d[:, :, None] * d[:, None] for d in (da, db)]
    # About the mean of the others the scatter is S − n / (n − 1) d dᵀ.
    scatter = da.T @ da + db.T @ db - (own[0] + own[1]) * n / used
    means = [(x.sum(0) - x) / used for x in (a, b)]
    w = _templates(scatter / (2 * used - 2), means[0] - means[1])
    # Scores from the middle of the two classes: the threshold 0 is that of the trained observer.
    middle = (means[0] + means[1]) / 2
    return ((a - middle) * w).sum(1), ((b - middle) * w).sum(1)


def _templates(scatter: Any, difference: Any) -> Floats:
    """``K⁻¹ Δ`` for stacks, scaled by the channels' SDs so that their units do not matter."""
    sd = np.sqrt(np.einsum("...ii->...i", scatter))
    if not (sd > 0).all():
        raise ValueError("a channel does not vary over the realisations: leave it out")
    scaled = scatter / sd[..., :, None] / sd[..., None, :]
    if np.linalg.cond(scaled).max() > 1e12:
        raise ValueError("the channels are linearly dependent on these images: use fewer")
    return np.linalg.solve(scaled, (difference / sd)[..., None])[..., 0] / sd


def _pair(present: Any, absent: Any) -> tuple[Floats, Floats]:
    a, b = np.asarray(present, dtype=np.float64), np.asarray(absent, dtype=np.float64)
    if a.ndim != 1 or b.ndim != 1 or min(a.size, b.size) < 2:
        raise ValueError(f"scores must be two 1-D arrays of at least 2, got {a.shape} and {b.shape}")
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise ValueError("scores hold NaN or Inf")
    return a, b


@checked
def auc(present: ArrayLike, absent: ArrayLike, *, level: float = 0.95) -> Estimate:
    """Area under the ROC curve (Wilcoxon) with an interval on the logit scale.

    The variance is DeLong's; each pair of one noise seed is one sampling unit (Obuchowski 1997), which counts the
    correlation between its two scores. Scores that are parted perfectly have no measured variance: then the
    lower bound is that of n successes in n trials, (α / 2)^(1 / n).

    Args:
        present, absent: ``(n,)`` scores; pair k has one noise seed.
        level: coverage.

    Raises:
        ValueError: fewer than 2 scores, NaN or Inf, unequal numbers, a level outside (0, 1).
    """
    a, b = _pair(present, absent)
    if a.size != b.size:
        raise ValueError(f"present and absent must be pairs, got {a.size} and {b.size} scores")
    coverage("level", level)

    def beaten(scores: Floats, by: Floats) -> Floats:
        ordered = np.sort(scores)
        return (ordered.searchsorted(by) + ordered.searchsorted(by, "right")) / (2.0 * scores.size)

    v10, v01 = beaten(b, a), 1.0 - beaten(a, b)
    area = float(v10.mean())
    if area in (0.0, 1.0):
        bound = ((1 - level) / 2) ** (1.0 / a.size)
        return Estimate(area, bound, 1.0) if area == 1.0 else Estimate(area, 0.0, 1.0 - bound)
    variance = float((v10 + v01).var(ddof=1)) / a.size
    half = ndtri(0.5 + level / 2) * math.sqrt(variance) / (area * (1 - area))
    return Estimate(area, float(expit(logit(area) - half)), float(expit(logit(area) + half)))


@checked
def d_prime(present: ArrayLike, absent: ArrayLike, level: float = 0.95, draws: int = 2000, seed: int = 0) -> Estimate:
    """Detectability ``(s̄₁ − s̄₀) / sqrt((σ₁² + σ₀²) / 2)`` with a bootstrap interval over pairs.

    Args:
        present, absent: ``(n,)`` scores, n ≥ 3; pair k has one noise seed.
        level, draws, seed: of the bootstrap.

    Raises:
        ValueError: fewer than 3 pairs, unequal numbers, scores that do not vary.
    """
    a, b = _pair(present, absent)
    if a.size != b.size or a.size < 3:
        raise ValueError(f"present and absent must be at least 3 pairs, got {a.size} and {b.size}")
    if a.var() + b.var() == 0:
        raise ValueError("the scores do not vary: d′ needs noisy realisations")

    def statistic(index: Any) -> Floats:
        x, y = a[index], b[index]
        with np.errstate(divide="ignore", invalid="ignore"):
            return (x.mean(-1) - y.mean(-1)) / np.sqrt((x.var(-1, ddof=1) + y.var(-1, ddof=1)) / 2)

    value = float(statistic(np.arange(a.size)[None])[0])
    resampled = evaluate(statistic, resampling(a.size, draws, seed))
    return Estimate(value, *bca_interval(value, resampled, statistic(leave_one_out(a.size)), level))


class ObserverResult(NamedTuple):
    """What :func:`observe` found: area, detectability, and the scores ``(n,)`` they come from."""

    auc: Estimate
    d_prime: Estimate
    present: Floats
    absent: Floats


@checked
def observe(present: ArrayLike, absent: ArrayLike, channels: ArrayLike) -> ObserverResult:
    """Channelised Hotelling observer on images.

    Args:
        present, absent: ``(n, ...)`` images or volumes in HU; pair k has one noise seed.
        channels: ``(c, ...)``, e.g. of :func:`dog_channels`.
    """
    s1, s0 = hotelling_scores(*(channel_responses(x, channels) for x in (present, absent)))
    return ObserverResult(auc(s1, s0), d_prime(s1, s0), s1, s0)
