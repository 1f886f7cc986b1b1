"""The measured dose factor: the dose at which FBP reaches what a method shows at dose 1, with an interval.

FBP is linear: its ROI means keep their expectation at every dose and their covariance falls as 1 / dose, so its curve
of the paper's CNR (∝ √dose) and of the contrast's variance (∝ 1 / dose) is exact (:class:`DoseCurve`). A figure
without a closed form, such as an observer's, is measured at several doses (:class:`MeasuredDoseCurve`) on the same
noise seeds as the method's. Intervals resample the realisations, all doses and methods with the same indices.

A factor from fewer than 200 realisations says little: a variance ratio of 5.7 has the 95 % interval [1.4, 22.9] at
n = 10, [3.8, 8.5] at 100 and [4.3, 7.5] at 200. The bootstrap's nominal 95 % cover the truth in 91–92 % of simulated
experiments at n = 40 and in 94–95 % at n = 200 (normal ROI means, CNR and variance).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchpcct.metrics.bootstrap import Estimate, bca_interval, evaluate, leave_one_out, resampling

__all__ = [
    "DOSES",
    "FIGURES",
    "ContrastSlope",
    "DoseCurve",
    "DoseFactor",
    "MeasuredDoseCurve",
    "contrast_slope",
    "dose_factor",
    "efficiency",
    "roi_bias",
]

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
    from scipy.special import ndtri

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


def _figure(name: str) -> Callable[[Floats], Floats]:
    if name not in FIGURES:
        raise ValueError(f"figure must be one of {', '.join(FIGURES)}, got {name!r}")
    return FIGURES[name]


def _doses(value: Any) -> Floats:
    doses = np.array(value, dtype=np.float64)
    if doses.ndim != 1 or doses.size < 2 or not np.isfinite(doses).all() or not (doses > 0).all():
        raise ValueError(f"doses must be at least 2 positive numbers, got {value!r}")
    if not (np.diff(doses) > 0).all():
        raise ValueError(f"doses must increase, got {doses.tolist()}")
    return doses


def _invert(doses: Floats, values: Floats, figure: Floats) -> Floats:
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
        if not slope > 0:
            raise ValueError(f"slope must be greater than 0, got {slope}")
        d = _doses(doses)
        return cls(d, (c[0, 0] + c[1, 1] - 2 * c[0, 1]) / slope**2 / d)

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
        dose = self._invert(f)
        return float(dose) if f.ndim == 0 else dose

    def _invert(self, figure: Floats) -> Floats:
        values = self.values
        if values[-1] < values[0]:
            with np.errstate(divide="ignore"):
                values, figure = 1.0 / values, 1.0 / figure
        return _invert(self.doses, np.broadcast_to(values, (*figure.shape, values.size)), figure)


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
        doses, samples = _doses(self.doses), _samples("samples", self.samples, 3)
        if samples.shape[0] != doses.size:
            raise ValueError(f"samples has {samples.shape[0]} doses on its first axis, doses {doses.size}")
        if not self.slope > 0:
            raise ValueError(f"slope must be greater than 0, got {self.slope}")
        object.__setattr__(self, "doses", doses)
        object.__setattr__(self, "samples", samples)

    def figures(self, figure: str, indices: Any = None) -> Floats:
        """Monotone figure at every dose, ``(m,)``, or ``(draws, m)`` for resampled realisations ``(draws, n)``."""
        index = np.arange(self.samples.shape[1])[None] if indices is None else indices
        values = np.stack([_figure(figure)(s[index]) for s in self.samples], axis=-1)
        sign = -1.0 if figure == "contrast_variance" else 1.0
        if figure == "contrast_variance":
            values = values / self.slope**2
        v = sign * values
        v = (np.maximum.accumulate(v, -1) + np.minimum.accumulate(v[..., ::-1], -1)[..., ::-1]) / 2
        return sign * (v[0] if indices is None else v)


def _samples(name: str, value: Any, axes: int) -> Floats:
    s = np.asarray(value, dtype=np.float64)
    if s.ndim != axes or s.shape[-1] != 2 or s.shape[-2] < 3:
        wanted = "(realisations ≥ 3, 2)" if axes == 2 else "(doses, realisations ≥ 3, 2)"
        raise ValueError(f"{name} must have the shape {wanted}, got {s.shape}")
    if not np.isfinite(s).all():
        raise ValueError(f"{name} holds NaN or Inf: check the reconstructions before measuring them")
    return s


class DoseFactor(NamedTuple):
    """A dose factor and its interval; 0 and Inf stand for a dose outside the curve's range."""

    value: float
    low: float
    high: float
    lowest_dose: float
    highest_dose: float

    def label(self, dose: float) -> str:
        """``dose`` as text: ``<0.125`` and ``>16`` beyond the curve's range."""
        if dose <= 0:
            return f"<{self.lowest_dose:g}"
        return f">{self.highest_dose:g}" if math.isinf(dose) else f"{dose:.3g}"

    def __str__(self) -> str:
        return f"{self.label(self.value)} [{self.label(self.low)}, {self.label(self.high)}]"


@dataclass(frozen=True, eq=False)
class ContrastSlope:
    """Slope of the measured against the true contrast, with what pairs it with other figures.

    Attributes:
        value, low, high: slope and its interval.
        intercept: measured contrast where the true one is 0 (false contrast), HU.
        draws: ``(draws,)`` slopes of resampled realisations; jackknife: ``(realisations,)`` with one left out.
        seed: of the resampling.
    """

    value: float
    low: float
    high: float
    intercept: float
    draws: Floats
    jackknife: Floats
    seed: int

    def _paired(self, realizations: int, draws: int, seed: int) -> None:
        if (self.jackknife.size, self.draws.size, self.seed) != (realizations, draws, seed):
            own = (self.jackknife.size, self.draws.size, self.seed)
            raise ValueError(
                f"the slope was resampled with (realisations, draws, seed) = {own}, the figure with "
                f"{realizations, draws, seed}: use the same, or give slope.value"
            )


def contrast_slope(
    true_contrasts: Any, measured: Any, level: float = 0.95, draws: int = 2000, seed: int = 0
) -> ContrastSlope:
    """Weighted least-squares slope over scenes whose core differs; 1 is unbiased, below 1 shrinks contrast.

    Args:
        true_contrasts: ``(scenes,)`` HU, at least 2 different values (sign-flipped ones too).
        measured: ``(scenes, realisations)`` contrasts in HU; realisation k has the noise seed k in every scene. A scene
            counts with the inverse variance over its realisations.
        level, draws, seed: of the bootstrap over realisations.

    Raises:
        ValueError: wrong shapes, fewer than 3 realisations, equal true contrasts, NaN or Inf, a scene without noise.
    """
    t, y = np.asarray(true_contrasts, dtype=np.float64), np.asarray(measured, dtype=np.float64)
    if t.ndim != 1 or y.ndim != 2 or y.shape[0] != t.size or y.shape[1] < 3:
        raise ValueError(
            f"true_contrasts must be (scenes,) and measured (scenes, realisations ≥ 3), got {t.shape} and {y.shape}"
        )
    if not (np.isfinite(t).all() and np.isfinite(y).all()):
        raise ValueError("true_contrasts or measured hold NaN or Inf: check the reconstructions")
    variance = y.var(1, ddof=1)
    if not (variance > 0).all():
        raise ValueError(f"the contrasts of scene {int(np.argmin(variance))} do not vary: realisations must be noisy")
    weight = 1.0 / variance
    weight /= weight.sum()
    centered = t - weight @ t
    spread = float(weight @ centered**2)
    if not spread > 0:
        raise ValueError("true_contrasts must hold at least 2 different values")
    # The slope is linear in the scenes' means, so it is the mean of what each realisation alone would give.
    each = (weight * centered / spread) @ y
    n = each.size
    value = float(each.mean())
    resampled = evaluate(lambda i: each[i].mean(-1), resampling(n, draws, seed))
    jackknife = (each.sum() - each) / (n - 1)
    low, high = bca_interval(value, resampled, jackknife, level)
    intercept = float(weight @ y.mean(1) - value * (weight @ t))
    return ContrastSlope(value, low, high, intercept, resampled, jackknife, seed)


def _slopes(slope: float | ContrastSlope, n: int, draws: int, seed: int) -> tuple[float, Any, Any]:
    """Slope of the sample, of every draw and with each realisation left out."""
    value = slope.value if isinstance(slope, ContrastSlope) else float(slope)
    if not (math.isfinite(value) and value > 0):
        raise ValueError(
            f"slope must be a positive number, got {value}: contrast of the wrong sign cannot be corrected"
        )
    if isinstance(slope, ContrastSlope):
        slope._paired(n, draws, seed)
        return value, slope.draws, slope.jackknife
    return value, value, value


def dose_factor(
    samples: Any,
    curve: DoseCurve | MeasuredDoseCurve,
    figure: str = "paper_cnr",
    *,
    slope: float | ContrastSlope = 1.0,
    level: float = 0.95,
    draws: int = 2000,
    seed: int = 0,
) -> DoseFactor:
    """The dose at which FBP reaches a method's figure, with a paired-bootstrap interval over realisations.

    Args:
        samples: ``(realisations, 2)`` of the method at dose 1, columns as in :data:`FIGURES`.
        curve: FBP's curve of the SAME figure: exact (only the method is resampled) or measured (both are, paired).
        figure: one of :data:`FIGURES`.
        slope: the method's contrast slope, for ``contrast_variance`` (which it divides, squared). A number is taken as
            exact; a :class:`ContrastSlope` of the same realisations, draws and seed is resampled along.
        level, draws, seed: of the bootstrap (bias-corrected and accelerated).

    Returns:
        the factor; 0 or Inf, printed as ``<0.125`` or ``>16``, where FBP reaches the figure beyond its curve only.

    Raises:
        ValueError: wrong shapes, an unknown figure, NaN or Inf, a slope for another figure, a measured curve with
            another number of realisations, samples that do not vary.
    """
    s = _samples("samples", samples, 2)
    n = s.shape[0]
    compute = _figure(figure)
    if figure != "contrast_variance" and not (isinstance(slope, int | float) and slope == 1.0):
        raise ValueError(f"slope corrects the contrast_variance only: leave it at 1 for {figure!r}")
    if not (s.var(0) > 0).all():
        raise ValueError("samples do not vary over the realisations: they must be noisy")
    if isinstance(curve, MeasuredDoseCurve):
        if curve.samples.shape[1] != n:
            raise ValueError(f"the curve has {curve.samples.shape[1]} realisations, samples {n}: pair them by seed")
    elif not isinstance(curve, DoseCurve):
        raise TypeError(f"curve must be a DoseCurve or a MeasuredDoseCurve, got {type(curve).__name__}")
    if isinstance(curve, DoseCurve) and (curve.values[-1] < curve.values[0]) != (figure == "contrast_variance"):
        raise ValueError(f"the curve {'falls' if figure != 'contrast_variance' else 'rises'} with dose: not {figure!r}")
    exact, drawn, left_out = _slopes(slope, n, draws, seed)

    def doses(indices: Any, slopes: Any) -> Floats:
        values = evaluate(lambda i: compute(s[i]), indices) / np.square(slopes)
        if isinstance(curve, DoseCurve):
            return curve._invert(values)
        table = evaluate(lambda i: curve.figures(figure, i), indices)
        if figure == "contrast_variance":
            with np.errstate(divide="ignore"):
                table, values = 1.0 / table, 1.0 / values
        return _invert(curve.doses, table, values)

    value = float(doses(np.arange(n)[None], exact)[0])
    with np.errstate(divide="ignore"):
        jackknife = np.log(doses(leave_one_out(n), left_out))
    low, high = bca_interval(value, doses(resampling(n, draws, seed), drawn), jackknife, level)
    return DoseFactor(value, low, high, float(curve.doses[0]), float(curve.doses[-1]))


def efficiency(
    ideal_sd: float,
    contrasts: Any,
    slope: float | ContrastSlope = 1.0,
    level: float = 0.95,
    draws: int = 2000,
    seed: int = 0,
) -> Estimate:
    """Ideal variance over the method's slope-corrected variance of the contrast: 1 for the best unbiased method.

    Args:
        ideal_sd: SD of the contrast by :func:`torchpcct.metrics.data_limit`, HU, at the dose of ``contrasts``.
        contrasts: ``(realisations,)`` background minus foreground, HU; at least 3.
        slope: the method's contrast slope, as in :func:`dose_factor`.
        level, draws, seed: of the bootstrap over realisations.

    Raises:
        ValueError: an ideal SD or slope that is not positive, NaN or Inf, contrasts that do not vary.
    """
    c = np.asarray(contrasts, dtype=np.float64)
    if c.ndim != 1 or c.size < 3 or not np.isfinite(c).all():
        raise ValueError(f"contrasts must be at least 3 finite numbers, (realisations,), got the shape {c.shape}")
    if not (math.isfinite(ideal_sd) and ideal_sd > 0):
        raise ValueError(f"ideal_sd must be a positive number in HU, got {ideal_sd}")
    if c.var() == 0:
        raise ValueError("contrasts do not vary over the realisations: they must be noisy")
    exact, drawn, left_out = _slopes(slope, c.size, draws, seed)

    def ratio(indices: Any, slopes: Any) -> Floats:
        variance = evaluate(lambda i: c[i].var(-1, ddof=1), indices)
        with np.errstate(divide="ignore"):
            return np.square(slopes) * ideal_sd**2 / variance

    value = float(ratio(np.arange(c.size)[None], exact)[0])
    with np.errstate(divide="ignore"):
        jackknife = np.log(ratio(leave_one_out(c.size), left_out))
    low, high = bca_interval(value, ratio(resampling(c.size, draws, seed), drawn), jackknife, level)
    return Estimate(value, low, high)


def roi_bias(means: Any, truth: Any, level: float = 0.95) -> list[Estimate]:
    """Mean minus truth of each ROI with Student's interval.

    Args:
        means: ``(realisations, rois)`` HU.
        truth: ``(rois,)`` HU: the tissue's value, or the noise-free mean of a reference reconstruction.

    Raises:
        ValueError: wrong shapes, fewer than 2 realisations, NaN or Inf.
    """
    from torchpcct.metrics.cnr import mean_interval

    m, t = np.asarray(means, dtype=np.float64), np.asarray(truth, dtype=np.float64)
    if m.ndim != 2 or t.shape != m.shape[1:]:
        raise ValueError(f"means must be (realisations, rois) and truth (rois,), got {m.shape} and {t.shape}")
    return [Estimate(float(d.mean()), *mean_interval(d, level)) for d in (m - t).T]
