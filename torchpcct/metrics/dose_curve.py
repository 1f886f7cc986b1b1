"""Figures of merit against dose: FBP's curve, from which the dose that gives a figure is read.

FBP is linear: its ROI means keep their expectation at every dose and their covariance falls as 1 / dose, so its curve
of the paper's CNR (∝ √dose) and of the contrast's variance (∝ 1 / dose) is exact (:class:`DoseCurve`). A figure
without a closed form, such as an observer's, is measured at several doses (:class:`MeasuredDoseCurve`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri

from torchpcct.validate import choice, number

__all__ = ["DOSES", "FIGURES", "DoseCurve", "MeasuredDoseCurve", "finite_pairs", "invert_rising"]

Floats = NDArray[np.float64]

DOSES = (0.125, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
"""Doses of FBP's curve relative to the method's. Nothing is extrapolated beyond the first and the last."""

_EDGE = 1e-9
"""Relative rounding of the figure that still counts as the curve's end."""


def _paper_cnr(samples: Floats) -> Floats:
    mean, variance = samples.mean(-2), samples.var(-2, ddof=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return (mean[..., 1] - mean[..., 0]) / np.sqrt(variance.sum(-1))


def _contrast_variance(samples: Floats) -> Floats:
    return (samples[..., 1] - samples[..., 0]).var(-1, ddof=1)


def _d_prime(samples: Floats) -> Floats:
    mean, variance = samples.mean(-2), samples.var(-2, ddof=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return (mean[..., 1] - mean[..., 0]) / np.sqrt(variance.mean(-1))


def _auc_detectability(samples: Floats) -> Floats:
    n = samples.shape[-2]
    flat = samples.reshape(-1, n, 2)
    area = np.empty(len(flat))
    for k, pair in enumerate(flat):
        absent = np.sort(pair[:, 0])
        area[k] = (absent.searchsorted(pair[:, 1]) + absent.searchsorted(pair[:, 1], "right")).sum() / (2.0 * n * n)
    # Perfectly parted scores only say that the area exceeds what half a pair would change.
    area = np.clip(area, 0.5 / n**2, 1 - 0.5 / n**2)
    return (math.sqrt(2.0) * ndtri(area)).reshape(samples.shape[:-2])


FIGURES: dict[str, Callable[[Floats], Floats]] = {
    "paper_cnr": _paper_cnr,
    "contrast_variance": _contrast_variance,
    "d_prime": _d_prime,
    "auc": _auc_detectability,
}
"""Figures of ``(..., realisations, 2)`` samples. ``paper_cnr`` and ``contrast_variance`` take ROI means in HU (columns
foreground, background); ``d_prime`` and ``auc`` take observer scores (columns absent, present), ``auc`` as the
detectability √2 Φ⁻¹(AUC), which grows as √dose for normal scores where the area itself saturates."""


def _doses(value: Any) -> Floats:
    doses = np.array(value, dtype=np.float64)
    if doses.ndim != 1 or doses.size < 2 or not np.isfinite(doses).all() or not (doses > 0).all():
        raise ValueError(f"doses must be at least 2 positive numbers, got {value!r}")
    if not (np.diff(doses) > 0).all():
        raise ValueError(f"doses must increase, got {doses.tolist()}")
    return doses


def invert_rising(doses: Floats, values: Floats, figure: Floats) -> Floats:
    """Dose at which rising curves ``values (..., m)`` reach ``figure (...)``; 0 below and Inf above their range."""
    with np.errstate(divide="ignore", invalid="ignore"):
        v, t = np.log(np.maximum(values, 0.0)), np.log(np.maximum(figure, 0.0))
        t = np.where(np.abs(t - v[..., -1]) <= _EDGE, v[..., -1], t)
        t = np.where(np.abs(t - v[..., 0]) <= _EDGE, v[..., 0], t)
    m = doses.size
    # −Inf marks a figure that is not positive: it lies below every curve, also below one that starts at 0.
    k = np.where(np.isneginf(t), 0, (v <= t[..., None]).sum(-1))
    low = np.clip(k - 1, 0, m - 2)
    v0 = np.take_along_axis(v, low[..., None], -1)[..., 0]
    v1 = np.take_along_axis(v, low[..., None] + 1, -1)[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        part = np.where(np.isneginf(v0), 1.0, (t - v0) / (v1 - v0))
    log_dose = np.log(doses)
    dose = np.exp(log_dose[low] + np.clip(part, 0.0, 1.0) * (log_dose[low + 1] - log_dose[low]))
    dose = np.where(t == v[..., -1], doses[-1], dose)
    return np.where(k == 0, 0.0, np.where(t > v[..., -1], np.inf, dose))


@dataclass(frozen=True, eq=False)
class DoseCurve:
    """A figure of FBP against dose, interpolated linearly in log-log: exact for a power of the dose.

    Args:
        doses: ``(m,)`` increasing, m ≥ 2.
        values: ``(m,)`` positive, strictly rising (CNR, d′) or strictly falling (a variance).

    Raises:
        ValueError: values that are not positive or not strictly monotone.
    """

    doses: Any
    values: Any

    def __post_init__(self) -> None:
        doses, values = _doses(self.doses), np.array(self.values, dtype=np.float64)
        if values.shape != doses.shape or not np.isfinite(values).all() or not (values > 0).all():
            raise ValueError(f"values must be {doses.size} positive numbers, one per dose, got {self.values!r}")
        steps = np.diff(values)
        if not ((steps > 0).all() or (steps < 0).all()):
            raise ValueError(
                "values must rise or fall strictly with the dose: a measured curve with sampling noise belongs in "
                "MeasuredDoseCurve"
            )
        object.__setattr__(self, "doses", doses)
        object.__setattr__(self, "values", values)

    @classmethod
    def paper_cnr(cls, means: Any, covariance: Any, doses: Any = DOSES) -> DoseCurve:
        """FBP's exact curve of the paper's CNR.

        Args:
            means: ``(foreground, background)`` expectations in HU.
            covariance: ``(2, 2)`` of the two ROI means at dose 1, HU² (e.g. ``recon.fbp.exact_noise.roi_covariance``).
            doses: range of the curve.

        Raises:
            ValueError: a background that does not exceed the foreground, variances that are not positive.
        """
        fg, bg = (float(m) for m in means)
        c = _covariance(covariance)
        if not bg > fg:
            raise ValueError(f"the background ({bg} HU) must exceed the foreground ({fg} HU) for a CNR above 0")
        d = _doses(doses)
        return cls(d, (bg - fg) / math.sqrt(c[0, 0] + c[1, 1]) * np.sqrt(d))

    @classmethod
    def contrast_variance(cls, covariance: Any, slope: float = 1.0, doses: Any = DOSES) -> DoseCurve:
        """FBP's exact curve of the slope-corrected variance of background minus foreground, HU².

        Args:
            covariance: ``(2, 2)`` of the two ROI means at dose 1, HU².
            slope: FBP's own contrast slope (a blurred core shows less than its contrast).
            doses: range of the curve.
        """
        c = _covariance(covariance)
        d = _doses(doses)
        return cls(d, (c[0, 0] + c[1, 1] - 2 * c[0, 1]) / number("slope", slope, positive=True) ** 2 / d)

    def __call__(self, dose: ArrayLike) -> Any:
        """Figure at doses inside the range (a float for one dose).

        Raises:
            ValueError: a dose outside the range: nothing is extrapolated.
        """
        d = np.asarray(dose, dtype=np.float64)
        if not ((d >= self.doses[0]) & (d <= self.doses[-1])).all():
            raise ValueError(f"dose must lie in {self.doses[0]:g}…{self.doses[-1]:g}, got {dose!r}: extend the curve")
        value = np.exp(np.interp(np.log(d), np.log(self.doses), np.log(self.values)))
        return float(value) if value.ndim == 0 else value

    def invert(self, figure: ArrayLike) -> Any:
        """Dose that gives ``figure`` (a float for one figure); 0 below the curve's range of doses, Inf above it."""
        f = np.asarray(figure, dtype=np.float64)
        values = self.values
        if values[-1] < values[0]:
            with np.errstate(divide="ignore"):
                values, f = 1.0 / values, 1.0 / f
        dose = invert_rising(self.doses, np.broadcast_to(values, (*f.shape, values.size)), f)
        return float(dose) if f.ndim == 0 else dose


def _covariance(value: Any) -> Floats:
    c = np.asarray(value, dtype=np.float64)
    if c.shape != (2, 2) or not np.isfinite(c).all() or not (np.diag(c) > 0).all():
        raise ValueError(f"covariance must be a finite (2, 2) matrix with positive variances, got {value!r}")
    return c


@dataclass(frozen=True, eq=False)
class MeasuredDoseCurve:
    """FBP's realisations at several doses, for figures without a closed form.

    The measured figures are made monotone (mean of the running maximum from below and the running minimum from above).

    Args:
        doses: ``(m,)`` increasing.
        samples: ``(m, realisations, 2)`` as :data:`FIGURES` takes them; realisation k uses the noise seed k at every
            dose and in the method's samples.
        slope: FBP's contrast slope, for ``contrast_variance``.
    """

    doses: Any
    samples: Any
    slope: float = 1.0

    def __post_init__(self) -> None:
        doses, samples = _doses(self.doses), finite_pairs("samples", self.samples, 3)
        if samples.shape[0] != doses.size:
            raise ValueError(f"samples has {samples.shape[0]} doses on its first axis, doses {doses.size}")
        number("slope", self.slope, positive=True)
        object.__setattr__(self, "doses", doses)
        object.__setattr__(self, "samples", samples)

    def figures(self, figure: str, indices: Any = None) -> Floats:
        """Monotone figure at every dose, ``(m,)``, or ``(draws, m)`` for resampled realisations ``(draws, n)``."""
        index = np.arange(self.samples.shape[1])[None] if indices is None else indices
        values = np.stack([FIGURES[choice("figure", figure, FIGURES)](s[index]) for s in self.samples], axis=-1)
        sign = -1.0 if figure == "contrast_variance" else 1.0
        if figure == "contrast_variance":
            values = values / self.slope**2
        v = sign * values
        v = (np.maximum.accumulate(v, -1) + np.minimum.accumulate(v[..., ::-1], -1)[..., ::-1]) / 2
        return sign * (v[0] if indices is None else v)


def finite_pairs(name: str, value: Any, axes: int) -> Floats:
    """Samples as float64, ``(realisations ≥ 3, 2)`` for 2 axes; ``ValueError`` for other shapes, NaN and Inf."""
    s = np.asarray(value, dtype=np.float64)
    if s.ndim != axes or s.shape[-1] != 2 or s.shape[-2] < 3:
        wanted = "(realisations ≥ 3, 2)" if axes == 2 else "(doses, realisations ≥ 3, 2)"
        raise ValueError(f"{name} must have the shape {wanted}, got {s.shape}")
    if not np.isfinite(s).all():
        raise ValueError(f"{name} holds NaN or Inf: check the reconstructions before measuring them")
    return s
