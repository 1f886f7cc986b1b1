"""The outline of a vessel in its own coordinates: r(θ, s), Fourier orders times B-splines, with
a smooth prior."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from recon.vessel.centreline import Coordinates
from recon.vessel.kernels import outline_radius, outline_spread

if TYPE_CHECKING:
    from torchpcct.typing import Reals


Floats = NDArray[np.float64]

_KNOT_MM = 0.9
"""Distance of the knots of the cubic splines along the vessel, mm."""
_CORRELATION_MM = 2.0
"""ℓ of the prior's correlation along the vessel, Matérn's of order 5/2: smooth, but for sudden
bends."""
_SD = (0.4, 0.3, 0.17, 0.06, 0.03)
"""Prior standard deviation of every order, as a share of the radius: narrow arteries are as
round as wide ones."""


@dataclass(frozen=True, eq=False)
class OutlineAt:
    """Everything of an outline that does not change with its shape, at given points.

    Attributes:
        first: ``(n,)`` first of the four splines that reach each point.
        spline, spline_slope: ``(n, 4)`` their values and derivatives along s.
        wave, wave_slope: ``(n, 2·orders + 1)`` Fourier functions and their derivatives by θ.
    """

    first: NDArray[np.int64]
    spline: Floats
    spline_slope: Floats
    wave: Floats
    wave_slope: Floats

    def radius(self, shape: Floats) -> tuple[Floats, Floats, Floats]:
        """r, dr/dθ and dr/ds at the points for coefficients ``(splines, 2·orders + 1)``."""
        found = np.empty((3, len(self.first)))
        parts = (self.first, self.spline, self.spline_slope, self.wave, self.wave_slope)
        outline_radius(*parts, np.ascontiguousarray(shape), *found)
        return found[0], found[1], found[2]

    def spread(self, slope: Floats, out: Reals) -> None:
        """Add slope · dr/d(coefficients) to ``out`` ``(n, splines · (2·orders + 1))``, of any
        float type."""
        outline_spread(slope, self.first, self.spline, self.wave, out)


@dataclass(frozen=True)
class Outline:
    """Splines from ``low`` to ``high`` along the line.

    Args:
        low, high: mm.
        orders: Fourier orders, as :class:`recon.vessel.prior.VesselPrior` has them.
    """

    low: float
    high: float
    orders: int

    @property
    def splines(self) -> int:
        """Number of splines."""
        return int(np.ceil((self.high - self.low) / _KNOT_MM)) + 3

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return self.splines * (2 * self.orders + 1)

    def at(self, c: Coordinates) -> OutlineAt:
        """The outline's functions at points; beyond its ends it goes on as it ends."""
        return self.at_angles(c.s, c.theta)

    def at_angles(self, s: Floats, theta: Floats) -> OutlineAt:
        """The same from positions and angles ``(n,)``."""
        t = np.clip((s - self.low) / _KNOT_MM, 0.0, self.splines - 3 - 1e-9)
        first = np.floor(t).astype(np.int64)
        u = t - first
        spline = (
            np.stack(
                [(1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, -3 * u**3 + 3 * u**2 + 3 * u + 1, u**3], 1
            )
            / 6
        )
        slope = np.stack([-((1 - u) ** 2), 3 * u**2 - 4 * u, -3 * u**2 + 2 * u + 1, u**2], 1) / (
            2 * _KNOT_MM
        )
        k = np.arange(1, self.orders + 1)
        c, s_ = np.cos(theta[:, None] * k), np.sin(theta[:, None] * k)
        ones = np.ones((len(theta), 1))
        return OutlineAt(
            first, spline, slope, np.hstack([ones, c, s_]), np.hstack([0 * ones, -k * s_, k * c])
        )

    def constant(self, radius: Floats, at: Floats) -> Floats:
        """Coefficients ``(splines, 2·orders + 1)`` of a round vessel of ``radius`` at positions
        ``at``, smoothed."""
        shape = np.zeros((self.splines, 2 * self.orders + 1))
        centres = self.low + (np.arange(self.splines) - 1) * _KNOT_MM
        weight = np.exp(-0.5 * ((centres[:, None] - at) / _KNOT_MM) ** 2) + 1e-9
        shape[:, 0] = (weight @ radius) / weight.sum(1)
        return shape

    def precision(self, radius: float, freedom: float = 1.0, least_order: int = 0) -> Floats:
        """Prior inverse covariance of all coefficients, mm⁻²; 0 for those of a smaller Fourier
        order.

        Args:
            radius: of the vessel, mm.
            freedom: of all but the radius, factor on their standard deviations.
            least_order: the smallest that counts.
        """
        centres = np.arange(self.splines) * _KNOT_MM
        lag = math.sqrt(5.0) * np.abs(centres[:, None] - centres) / _CORRELATION_MM
        k = (1 + lag + lag**2 / 3) * np.exp(-lag)
        order = np.concatenate([[0], np.arange(1, self.orders + 1), np.arange(1, self.orders + 1)])
        sd = radius * np.array(_SD)[order] * np.where(order > 0, freedom, 1.0)
        return np.kron(np.linalg.inv(k), np.diag((order >= least_order) / sd**2))
