"""Figures of a method that is not linear, each with all that linear functionals of the same draws tell of its luck."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchpcct.metrics import Jackknifed, controlled_log_variance, controlled_mean

__all__ = ["Controls"]

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Controls:
    """Readings of linear controls on the draws of one exposure, and their exact moments.

    A control has the same rows as the method: where a combination of the method's rows is asked for, the same
    combination of the rows of every control goes with it.

    Attributes:
        readings: ``(n, controls, rows)`` of every draw; mean: ``(controls, rows)``; covariance: ``(controls, rows,
            controls, rows)``.
    """

    readings: Floats
    mean: Floats
    covariance: Floats

    def of(self, h: Floats, n: int) -> tuple[Floats, Floats]:
        """Deviations ``(n, controls)`` of a combination of the first rows, and their covariance."""
        k = len(h)
        deviation = (self.readings[:n] - self.mean)[..., :k] @ h
        return deviation, np.einsum("i,aibj,j->ab", h, self.covariance[:, :k, :, :k], h)

    def expectation(self, values: Floats, h: Floats) -> Jackknifed:
        """Expectation of values of the first draws that follow a combination of rows."""
        return controlled_mean(values, self.of(h, len(values))[0], np.zeros(len(self.mean)))

    def log_variance(self, values: Floats, h: Floats) -> Jackknifed:
        """ln of their variance."""
        return controlled_log_variance(values, *self.of(h, len(values)))
