"""Figures of paired realisations with each realisation left out once: intervals, and figures made of figures.

All methods see the same noise seeds, so what they have in common cancels in a ratio or a difference only if the figures
are left without the same realisation together. A :class:`Jackknifed` carries its replicates along, and any smooth
function of several has its interval for free.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from torchpcct.metrics.bootstrap import Estimate
from torchpcct.validate import checked, coverage

__all__ = ["Jackknifed", "combined", "log_of_sum"]

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Jackknifed:
    """A figure of n paired realisations.

    Attributes:
        value: of all realisations.
        left_out: ``(n,)``, each realisation left out once; realisation k has the same noise seed in every figure that
            this one is combined with.
    """

    value: float
    left_out: Floats

    @property
    def standard_error(self) -> float:
        """Jackknife standard error (Efron, Stein 1981, Ann. Stat. 9:586)."""
        n = self.left_out.size
        return math.sqrt((n - 1) / n * float(np.square(self.left_out - self.left_out.mean()).sum()))

    def estimate(self, level: float = 0.95) -> Estimate:
        """The figure with Student's interval of n − 1 degrees of freedom."""
        coverage("level", level)
        half = float(stats.t.ppf(0.5 + level / 2, self.left_out.size - 1)) * self.standard_error
        return Estimate(self.value, self.value - half, self.value + half)

    def exponential(self, level: float = 0.95, scale: float = 1.0) -> Estimate:
        """exp(scale · figure) with the interval of the figure: for logarithms of a variance (½: the SD)."""
        value, *ends = (math.exp(scale * v) for v in self.estimate(level))
        return Estimate(value, *sorted(ends))


@checked
def combined(function: Callable[..., Any], *figures: Jackknifed | float) -> Jackknifed:
    """A smooth function of figures of the same realisations; numbers are taken as exact.

    Args:
        function: of as many arguments as there are figures, on floats and arrays alike.
        figures: at least one :class:`Jackknifed`.

    Raises:
        ValueError: figures of different numbers of realisations, or none of a sample; a value that is not finite.
    """
    sizes = {f.left_out.size for f in figures if isinstance(f, Jackknifed)}
    if len(sizes) != 1:
        raise ValueError(f"figures must be of the same realisations, got numbers of realisations {sorted(sizes)}")
    value = float(function(*[f.value if isinstance(f, Jackknifed) else f for f in figures]))
    left_out = function(*[f.left_out if isinstance(f, Jackknifed) else f for f in figures])
    left_out = np.broadcast_to(np.asarray(left_out, dtype=np.float64), (sizes.pop(),))
    if not (math.isfinite(value) and np.isfinite(left_out).all()):
        raise ValueError(f"the combined figure is not finite ({value}): check its arguments (a logarithm of 0?)")
    return Jackknifed(value, left_out)


def log_of_sum(parts: Any, lost: int = 0) -> Jackknifed:
    """ln(Σ parts / (n − lost)) of non-negative parts, one for each realisation.

    Args:
        parts: ``(n,)``.
        lost: 0 for a mean. 1 for squared deviations from the mean of the realisations, where the sum without one loses
            n / (n − 1) of its part.

    Raises:
        ValueError: fewer than 3 realisations; nothing varies.
    """
    p = np.asarray(parts, dtype=np.float64)
    n = p.size
    if p.ndim != 1 or n < 3:
        raise ValueError(f"parts must be (realisations ≥ 3,), got the shape {p.shape}")
    rest = (p.sum() - p * (n / (n - lost))) / (n - 1 - lost)
    if not (p.sum() > 0 and (rest > 0).all()):
        raise ValueError("the realisations do not vary: they must be noisy")
    return Jackknifed(math.log(p.sum() / (n - lost)), np.log(rest))
