"""Two channels mixed into two of equal, uncorrelated noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

__all__ = ["Whitening"]

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Whitening:
    """Mixes two channels into two of equal, uncorrelated noise.

    Attributes:
        forward: ``(2, 2)``: whitened = forward @ channels. Its first row is the gain that was asked for.
        backward: ``(2, 2)``, the inverse.
    """

    forward: Floats
    backward: Floats

    @classmethod
    def of(cls, information: ArrayLike, gain: ArrayLike) -> Whitening:
        """From the mean information of the channels.

        Args:
            information: ``(3,)`` F₁₁, F₁₂, F₂₂, positive definite.
            gain: ``(2,)`` combination of the channels that becomes the first whitened channel and sets the unit of
                both: e.g. HU per basis coefficient at one energy (:func:`torchpcct.spectral.vmi_weights`).

        Raises:
            ValueError: information that is not positive definite, a gain of 0, wrong shapes.
        """
        f, g = np.asarray(information, np.float64), np.asarray(gain, np.float64)
        if f.shape != (3,) or g.shape != (2,) or not (np.isfinite(f).all() and np.isfinite(g).all()):
            raise ValueError(f"information must hold 3, gain 2 finite numbers, got {information!r} and {gain!r}")
        if not (f[0] > 0 and f[2] > 0 and f[0] * f[2] > f[1] ** 2):
            raise ValueError(f"information must be positive definite, packed as F11, F12, F22, got {f}")
        if not g.any():
            raise ValueError("gain must not be 0")
        covariance = np.linalg.inv([[f[0], f[1]], [f[1], f[2]]])
        toward = covariance @ g
        other = np.array([-toward[1], toward[0]])  # uncorrelated with the first
        other *= np.sqrt((g @ toward) / (other @ covariance @ other))
        forward = np.stack([g, other])
        return cls(forward, np.linalg.inv(forward))

    def apply(self, channels: Tensor) -> Tensor:
        """Whitened channels, ``(..., 2, *shape)`` with 3 trailing axes."""
        return _mix(self.forward, channels)

    def undo(self, whitened: Tensor) -> Tensor:
        """The channels, ``(..., 2, *shape)`` with 3 trailing axes."""
        return _mix(self.backward, whitened)

    def information(self, packed: Tensor) -> Tensor:
        """Information ``(3, ...)`` of the channels → of the whitened channels."""
        (a, b), (c, d) = self.backward
        f11, f12, f22 = packed
        return torch.stack([
            a * a * f11 + 2 * a * c * f12 + c * c * f22,
            a * b * f11 + (a * d + b * c) * f12 + c * d * f22,
            b * b * f11 + 2 * b * d * f12 + d * d * f22,
        ])  # fmt: skip


def _mix(matrix: Floats, x: Tensor) -> Tensor:
    if x.ndim < 4 or x.shape[-4] != 2:
        raise ValueError(f"expected two channels (..., 2, n, n, n), got the shape {tuple(x.shape)}")
    first, second = x.unbind(-4)
    (a, b), (c, d) = matrix.tolist()
    return torch.stack([a * first + b * second, c * first + d * second], dim=-4)
