"""Beam-hardening correction that makes water linear: from polychromatic to water-equivalent line
integrals.

A path through t mm of water reads p(t) = −ln(N / N_air) < μ t, because soft photons go first; the
bowtie hardens the beam differently in every column. Per column, ``mu_ref · t`` is fitted as a
polynomial of p (the paper: 5th order over 10 mm steps up to 380 mm; here a higher order, so that
what is left is far below 1 HU). Water then reads 0 HU at every radius and in every geometry; other
materials keep the small nonlinearity that no water correction removes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from torchpcct.detector_window import DetectorWindow
from torchpcct.threads import run
from torchpcct.validate import number, numbers, reals, whole

if TYPE_CHECKING:
    import h5py


__all__ = ["WaterLinearisation"]

Floats = NDArray[np.float64]

POLYNOMIAL_UP_TO = 12.0
"""Largest line integral for which a polynomial of :meth:`WaterLinearisation.polynomial` is taken
at its word."""
THICKEST_MM = 400.0
"""Of the water in the calibration."""
_SAMPLES = 400
"""Thicknesses of water in the calibration."""


@dataclass(frozen=True, eq=False)
class WaterLinearisation:
    """Per-column map from polychromatic line integrals to ``mu_ref`` × water thickness.

    Args:
        coefficients: ``(columns, order)`` float64; ``mu_ref t = p Σ_k coefficients[k] (p /
            scale)^k``.
        scale: ``(columns,)`` the largest p of the calibration; the map continues straight beyond it
            and below 0.
        mu_ref: attenuation in mm⁻¹ that water is given.

    Raises:
        ValueError: tables of other shapes, of no column or no coefficient, NaN or Inf, a scale or
            ``mu_ref`` ≤ 0.
        TypeError: tables that are not real numbers.
    """

    coefficients: Floats
    scale: Floats
    mu_ref: float

    def __post_init__(self) -> None:
        # The kernel reads by index and checks nothing: a table of another shape would be read
        # beyond its end.
        coefficients, scale = (
            np.ascontiguousarray(reals(name, getattr(self, name)))
            for name in ("coefficients", "scale")
        )
        for name, array in (("coefficients", coefficients), ("scale", scale)):
            if not np.isfinite(array).all():
                raise ValueError(
                    f"{name} must be finite, {int((~np.isfinite(array)).sum())} entries are NaN "
                    "or Inf"
                )
        if (
            coefficients.ndim != 2
            or scale.ndim != 1
            or coefficients.shape[0] != scale.size
            or not coefficients.size
        ):
            raise ValueError(
                "coefficients must have the shape (columns, order) and scale (columns,), got "
                f"{coefficients.shape} and {scale.shape}"
            )
        if not (scale > 0).all():
            column = int(np.argmin(scale > 0))
            raise ValueError(
                f"scale must be greater than 0 in every column, column {column} has "
                f"{scale[column]:g}"
            )
        object.__setattr__(self, "coefficients", coefficients)
        object.__setattr__(self, "scale", scale)
        object.__setattr__(
            self, "mu_ref", number("mu_ref", self.mu_ref, positive=True, unit="mm⁻¹")
        )

    @classmethod
    def polynomial(
        cls, coefficients: Sequence[float], columns: int, mu_ref: float
    ) -> WaterLinearisation:
        """The same polynomial ``c₁ p + c₂ p² + …`` in every column; ``(1.0,)`` leaves the line
        integrals as they are.

        Args:
            coefficients: c₁, c₂, … of line integrals p up to :data:`POLYNOMIAL_UP_TO`; beyond it
                and below 0 the map continues straight.
            columns: of the detector.
            mu_ref: attenuation of water in mm⁻¹.

        Raises:
            ValueError, TypeError: no coefficients, values that are not finite numbers, ``mu_ref`` ≤
                0.
        """
        given = np.array(numbers("coefficients", coefficients))
        scaled = given * POLYNOMIAL_UP_TO ** np.arange(given.size)
        number("mu_ref", mu_ref, positive=True, unit="mm⁻¹")
        return cls(np.tile(scaled, (columns, 1)), np.full(columns, POLYNOMIAL_UP_TO), float(mu_ref))

    @classmethod
    def calibrate(
        cls,
        weights: ArrayLike,
        mu_water: ArrayLike,
        order: int = 7,
        shift: Callable[[Floats], Floats] | None = None,
    ) -> WaterLinearisation:
        """Fit from the spectra of the columns, behind up to ``THICKEST_MM`` of water.

        Args:
            weights: ``(columns, E)`` expected signal per energy without an object.
            mu_water: ``(E,)`` attenuation of water in mm⁻¹.
            order: number of coefficients.
            shift: what else the detector adds to the line integrals ``(columns, samples)`` that it
                is given (pile-up).

        Raises:
            ValueError: an order < 1.
        """
        whole("order", order)
        w, mu = np.asarray(weights, np.float64), np.asarray(mu_water, np.float64)
        # Chebyshev nodes: no ringing at the ends.
        t = THICKEST_MM * (0.5 - 0.5 * np.cos(np.pi * (np.arange(_SAMPLES) + 0.5) / _SAMPLES))
        transmitted = np.exp(-np.outer(mu, t))
        p = -np.log(w @ transmitted / w.sum(1, keepdims=True))
        if shift is not None:
            p = p + shift(p)
        scale = p[:, -1]
        centre = w[w.shape[0] // 2] @ np.exp(-mu * THICKEST_MM / 2)
        mu_ref = float((w[w.shape[0] // 2] * np.exp(-mu * THICKEST_MM / 2)) @ mu / centre)
        x = p / scale[:, None]
        powers = x[..., None] ** np.arange(order)
        target = mu_ref * t / p
        coefficients = np.stack(
            [np.linalg.lstsq(a, b, rcond=None)[0] for a, b in zip(powers, target, strict=True)]
        )
        return cls(coefficients, scale, mu_ref)

    def _evaluate(
        self, p: Tensor, window: DetectorWindow | None, *, slope: bool, overwrite: bool = False
    ) -> Tensor:
        # numba: presets load without it
        from torchpcct.scanner.linearisation_kernel import evaluate

        columns = self.scale.size if window is None else window.columns
        if p.shape[-1] != columns:
            raise ValueError(
                f"p must have {columns} columns on its last axis, got shape {tuple(p.shape)}"
            )
        if p.dtype not in (torch.float32, torch.float64):
            raise TypeError(f"p must be float32 or float64, got {p.dtype}")
        if window is not None:
            if tuple(p.shape[-3:-1]) != (window.views, window.rows):
                raise ValueError(
                    f"p must have the shape (..., {window.views}, {window.rows}, {columns}) on "
                    f"this window, got {tuple(p.shape)}"
                )
            if int(window.first_column.max()) + columns > self.scale.size:
                raise ValueError(
                    f"the window reaches beyond the {self.scale.size} columns of the water "
                    "correction"
                )
        if p.device.type != "cpu":
            return self._evaluate_there(p.detach(), window, slope)
        flat = p.detach().contiguous().reshape(-1, columns)
        if window is None:
            first = np.zeros(1, np.int64)
        else:
            first = np.repeat(window.first_column, window.rows)
        out = flat if overwrite else torch.empty_like(flat)
        work = flat.shape[1] * 3 * self.coefficients.shape[1]
        terms = np.ascontiguousarray(self.coefficients.T)
        run(
            evaluate,
            len(flat),
            flat.numpy(),
            first,
            terms,
            self.scale,
            slope,
            out.numpy(),
            operations=work,
        )
        return out.reshape(p.shape)

    def _evaluate_there(self, p: Tensor, window: DetectorWindow | None, slope: bool) -> Tensor:
        """What :func:`~torchpcct.scanner.linearisation_kernel.evaluate` computes, with torch on
        the device of ``p``."""

        def of_columns(values: NDArray[np.float64]) -> Tensor:
            if window is not None:  # (views, 1, columns)
                values = values[window.column_indices][:, None]
            return torch.from_numpy(np.ascontiguousarray(values)).to(p.device)

        scale = of_columns(self.scale)
        x = (p / scale).clamp_(0.0, 1.0)
        value, local = torch.zeros_like(x), torch.zeros_like(x)
        for power in reversed(range(self.coefficients.shape[1])):
            local = local.mul_(x).add_(value)
            value = value.mul_(x).add_(of_columns(self.coefficients[:, power]))
        bend = value + x * local
        if slope:
            return torch.where(p.isnan(), math.nan, bend).to(p.dtype)
        inside = scale * x
        return (inside * value + (p - inside) * bend).to(p.dtype)

    def apply(
        self, p: Tensor, window: DetectorWindow | None = None, *, overwrite: bool = False
    ) -> Tensor:
        """Water-equivalent line integrals ``mu_ref t``.

        Args:
            p: ``(..., columns)`` polychromatic line integrals; with a window ``(..., views, rows,
                window.columns)``.
            window: the part of the detector that ``p`` holds.
            overwrite: whether ``p`` may be overwritten: nobody else needs it.

        Returns:
            Tensor of the shape, dtype and device of ``p``. NaN stays NaN. Not differentiable: see
            :meth:`slope`.

        Raises:
            ValueError: a shape that does not fit the detector or the window.
        """
        return self._evaluate(p, window, slope=False, overwrite=overwrite)

    def slope(self, p: Tensor, window: DetectorWindow | None = None) -> Tensor:
        """Derivative of :meth:`apply`: what it multiplies the standard deviation of ``p`` by."""
        return self._evaluate(p, window, slope=True)

    def save(self, group: h5py.Group) -> None:
        """Write into an HDF5 group."""
        group["coefficients"] = self.coefficients
        group["scale"] = self.scale
        group.attrs["mu_ref_per_mm"] = self.mu_ref

    @classmethod
    def load(cls, group: h5py.Group) -> WaterLinearisation:
        """Read what :meth:`save` wrote."""
        return cls(
            group["coefficients"][()], group["scale"][()], float(group.attrs["mu_ref_per_mm"])
        )
