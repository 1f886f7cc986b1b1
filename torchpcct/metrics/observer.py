"""Channelised Hotelling observer: is the core there? A task figure that contrast shrinkage cannot
improve.

Each image is reduced to its responses to a few channels centred at the known place of the core; the
observer is the best linear combination of them, ``w = K⁻¹ (v̄₁ − v̄₀)`` with the mean covariance K
of both classes. Present and absent images with the same noise seed form a PAIR: they are left out
together when the observer is trained, and by the jackknife that gives the interval of d′.

Channels: dense difference of Gaussians (Abbey and Barrett, J. Opt. Soc. Am. A 18, 473 (2001)),
radial in mm, so that they serve a plane or a volume of any spacing.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.control import controlled_log_variance, controlled_mean
from torchpcct.metrics.intervals import Jackknifed, combined
from torchpcct.metrics.roi import as_array
from torchpcct.validate import checked

__all__ = [
    "channel_responses",
    "d_prime",
    "dog_channels",
    "hotelling_scores",
    "observe",
    "template_channel",
]

Floats = NDArray[np.float64]
_RATIO = 1.4
"""Of the widths of neighbouring channels: α of the dense difference-of-Gaussians channels of Abbey
and Barrett, J. Opt. Soc. Am. A 18 (2001) 473."""
_WIDTH = 1.67
"""Of a channel's wider Gaussian over its narrower one: Q of the same."""


@checked
def dog_channels(
    grid: VolumeGrid, center: tuple[float, ...], count: int = 10, lowest: float | None = None
) -> Floats:
    """Dense difference-of-Gaussians channels: ``exp(−f² / 2 (Q s_j)²) − exp(−f² / 2 s_j²)``, ``s_j
    = s₀ αʲ``, with the source's α = 1.4 and Q = 1.67.

    Args:
        grid: ``(y, x)`` axial plane or ``(z, y, x)`` volume.
        center: of the channels in mm, in the order of the grid's axes (the core's known place).
        count: channels.
        lowest: s₀ in cycles per mm; None: 0.005 cycles per voxel of the finest axis, as in the
            source.

    Returns:
        ``(count, *grid.shape)`` float64, each of unit norm.

    Raises:
        ValueError: a centre of other axes than the grid, a count < 1, a frequency that is not
            positive.
    """
    if len(center) != grid.ndim:
        raise ValueError(
            f"center must have {grid.ndim} numbers in mm, one per axis of the grid, got {center!r}"
        )
    s0 = 0.005 / min(grid.spacing) if lowest is None else float(lowest)
    if count < 1 or not s0 > 0:
        raise ValueError(f"need count ≥ 1 and lowest > 0, got {count} and {s0}")
    squares = np.zeros(grid.shape)
    for axis, (positions, c) in enumerate(zip(grid.axes, center, strict=True)):
        shape = [1] * grid.ndim
        shape[axis] = -1
        squares = squares + np.square(positions - c).reshape(shape)

    def gaussian(s: float) -> Floats:
        return s**grid.ndim * np.exp(-2.0 * (math.pi * s) ** 2 * squares)

    channels = np.stack(
        [gaussian(_WIDTH * s) - gaussian(s) for s in s0 * _RATIO ** np.arange(count)]
    )
    return channels / np.sqrt(
        np.square(channels).sum(tuple(range(1, channels.ndim)), keepdims=True)
    )


@checked
def template_channel(expected_difference: ArrayLike) -> Floats:
    """The known signal itself as a channel, ``(1, ...)`` of unit norm: to be stacked with the
    others.

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
        raise ValueError(
            f"images (n, ...) and channels (c, ...) must match, got {x.shape} and {c.shape}"
        )
    flat = c.reshape(c.shape[0], -1).astype(np.float64)
    responses = np.stack([flat @ image.reshape(-1).astype(np.float64) for image in x])
    if not np.isfinite(responses).all():
        raise ValueError("images hold NaN or Inf: check the reconstruction before measuring it")
    return responses


@checked
def hotelling_scores(present: ArrayLike, absent: ArrayLike) -> tuple[Floats, Floats]:
    """Decision variables of the Hotelling observer, each pair scored by an observer trained on all
    others.

    Args:
        present, absent: ``(n, channels)`` responses; pair k has one noise seed.

    Returns:
        scores of present and absent, ``(n,)`` each, scaled to the observer's own d′ units: the
        expected difference of a trained observer is its d′².

    Raises:
        ValueError: wrong shapes, too few training pairs for the channels, channels that are
            linearly dependent.
    """
    a, b = np.asarray(present, dtype=np.float64), np.asarray(absent, dtype=np.float64)
    if a.ndim != 2 or a.shape != b.shape:
        raise ValueError(
            f"present and absent must be (n, channels) pairs, got {a.shape} and {b.shape}"
        )
    n, c = a.shape
    used = n - 1
    if used <= c:
        raise ValueError(
            f"{used} training pairs are too few for {c} channels: use at least {c + 1}, or fewer "
            "channels"
        )
    da, db = a - a.mean(0), b - b.mean(0)
    own = [d[:, :, None] * d[:, None] for d in (da, db)]
    # About the mean of the others the scatter is S − n / (n − 1) d dᵀ.
    scatter = da.T @ da + db.T @ db - (own[0] + own[1]) * n / used
    means = [(x.sum(0) - x) / used for x in (a, b)]
    w = _templates(scatter / (2 * used - 2), means[0] - means[1])
    # Scores from the middle of the two classes: the threshold 0 is that of the trained observer.
    middle = (means[0] + means[1]) / 2
    return ((a - middle) * w).sum(1), ((b - middle) * w).sum(1)


def _templates(scatter: Floats, difference: Floats) -> Floats:
    """``K⁻¹ Δ`` for stacks, scaled by the channels' SDs so that their units do not matter."""
    sd = np.sqrt(np.einsum("...ii->...i", scatter))
    if not (sd > 0).all():
        raise ValueError("a channel does not vary over the realisations: leave it out")
    scaled = scatter / sd[..., :, None] / sd[..., None, :]
    if np.linalg.cond(scaled).max() > 1e12:
        raise ValueError("the channels are linearly dependent on these images: use fewer")
    return np.linalg.solve(scaled, (difference / sd)[..., None])[..., 0] / sd


@checked
def d_prime(present: ArrayLike, absent: ArrayLike) -> Jackknifed:
    """Detectability ``(s̄₁ − s̄₀) / sqrt((σ₁² + σ₀²) / 2)``, with a jackknife over pairs.

    Args:
        present, absent: ``(n,)`` scores, n ≥ 5; pair k has one noise seed.

    Raises:
        ValueError: fewer than 5 pairs, unequal numbers, NaN or Inf, scores that do not vary.
    """
    means, variances = (
        [find(s, None, None) for s in (present, absent)]
        for find in (controlled_mean, controlled_log_variance)
    )
    return combined(
        lambda a, b, v, w: (a - b) / np.sqrt((np.exp(v) + np.exp(w)) / 2.0), *means, *variances
    )


@checked
def observe(present: ArrayLike, absent: ArrayLike, channels: ArrayLike) -> Jackknifed:
    """Detectability that the channelised Hotelling observer finds in images.

    Args:
        present, absent: ``(n, ...)`` images or volumes in HU; pair k has one noise seed.
        channels: ``(c, ...)``, e.g. of :func:`dog_channels`.
    """
    return d_prime(*hotelling_scores(*(channel_responses(x, channels) for x in (present, absent))))
