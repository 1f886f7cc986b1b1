"""From readings to figures with intervals, and to dose factors.

One rule makes every dose factor: of two methods the one whose figure is larger sees what the other
needs more dose for, and every figure here (noise variance, variance of a contrast at slope 1, CNR²,
d′²) is proportional to the dose for a linear method. So the factor is the ratio of the method's
figure to the linear reference's at the same dose. Both are of the same noise realisations, so what
is luck of the realisations cancels in the ratio; intervals are jackknife intervals over
realisations (:mod:`torchpcct.metrics.intervals`). What is drawn is controlled
(:mod:`torchpcct.metrics.control`) by linear functionals of the same noise, whose moments are
exactly known: of MBIR by its own response (:mod:`recon.evaluate.response`), of other methods by the
reference's ROI means. Of FBP all but noise and d′ is exact.

* slope: contrast that the signal adds over the true one; a method may buy low noise with it, so
  contrasts are compared at slope 1: variance over slope², in units of the true contrast, which of
  weighted energy bins (:mod:`recon.evaluate.energies`) is another than of their sum;
* ``without signal``: contrast that is read where there is none (less what other tissues in the ROIs
  make);
* the paper's CNR: (background − signal) / √(σ² + σ²) of the ROI means over realisations;
* d′: a Hotelling observer on the channels of :class:`recon.evaluate.measure.Reader`, trained on the
  other pairs;
* invented contrast: where one tissue is so far from all edges that their blur does not reach, the
  error should have no sign. Of two halves of the realisations one names the hundredth of the voxels
  with the largest mean errors, the other tells its own mean error there, in their direction; so
  what is noise adds nothing on average;
* false body: the largest contrast, of either sign, that a ball of 1 mm has with what is around it,
  anywhere in the inset where no blur of an edge reaches; a mean over realisations. Of noise, too:
  the larger it is beside what is shown of a true body, the less can a body be believed;
* false contour: the mean error's largest fall over 0.4 mm with the distance from the bodies, where
  no border is;
* limit: the variance of the best unbiased estimate if all outlines were known, the same ratio.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypedDict

import numpy as np
from numpy.typing import NDArray

from recon.evaluate.measure import OBSERVERS, RoiReadings
from recon.evaluate.task import GroundTruth
from torchpcct.metrics.control import controlled_log_variance, controlled_mean
from torchpcct.metrics.intervals import Estimate, Jackknifed, combined, log_of_sum
from torchpcct.metrics.observer import d_prime, hotelling_scores

if TYPE_CHECKING:
    from torchpcct.typing import Ints

__all__ = ["Record", "ReferenceNoise", "pivot", "records_of"]

Floats = NDArray[np.float64]


class Record(TypedDict):
    """A figure of a method at one exposure.

    ``low`` and ``high`` end the 95 % interval of ``value`` from ``n`` realisations; NaN: it is
    exact, or a time.
    """

    task: str
    method: str
    exposure_s: float
    figure: str
    where: str
    value: float
    low: float
    high: float
    unit: str
    n: int


_CONTRAST = (-1.0, 1.0)
"""Background less signal."""
_LEAST_SLOPE = 0.05
"""Less contrast than that of the true one cannot be corrected for."""
_SHARE = 0.01
"""Share of the voxels of the background in which invented contrast is looked for."""
_ENOUGH = 200
"""Voxels that there must be for that."""


Figure = Jackknifed | float
"""A float is exact."""


@dataclass(frozen=True, eq=False)
class ReferenceNoise:
    """What holds without sampling error of the linear reference.

    Attributes:
        covariance: ``(rois, 2, rois, 2)`` of the ROI means at the exposure, HU².
        mean: ``(2, rois, 2)`` of noise-free data, with and without the signal.
        realisations: ``(n, 2, rois, 2)`` of the same realisations as those of the methods.
    """

    covariance: Floats
    mean: Floats
    realisations: Floats


class _Figures:
    """Of one method at one exposure.

    Args:
        readings: of its volumes.
        true: ``(rois,)`` contrasts that the signal adds, HU: background less signal.
        absent: ``(rois,)`` true contrasts without the signal, HU.
        reference: on the same realisations; what is drawn is controlled by it.
        exact: the method's own covariance of ROI means as
            :attr:`ReferenceNoise.covariance`; None: it is drawn.
    """

    def __init__(
        self,
        readings: RoiReadings,
        true: Floats,
        absent: Floats,
        reference: ReferenceNoise,
        exact: Floats | None,
    ) -> None:
        self.r, self.true, self.absent, self.reference, self.exact = (
            readings,
            true,
            absent,
            reference,
            exact,
        )
        self._sign = np.sign(true)

    def _row(self, roi: int, row: tuple[float, float]) -> Floats:
        """Weights of an ROI's two means: signal, background."""
        out = np.zeros((len(self.true), 2))
        out[roi] = row
        return out

    def mean(self, weights: Floats, without_signal: int) -> Figure:
        """Expectation of a functional of the ROI means, with (0) or without (1) the signal."""
        if self.exact is not None:
            return float((weights * self.r.clean_rois[without_signal]).sum())
        values, control = (
            np.einsum("nrs,rs->n", v[:, without_signal], weights)
            for v in (self.r.rois, self.reference.realisations)
        )
        return controlled_mean(
            values, control, float((weights * self.reference.mean[without_signal]).sum())
        )

    def log_variance(self, weights: Floats) -> Figure:
        """ln of its variance with the signal."""
        if self.exact is not None:
            return math.log(float(np.einsum("rs,rstu,tu->", weights, self.exact, weights)))
        values, control = (
            np.einsum("nrs,rs->n", v[:, 0], weights)
            for v in (self.r.rois, self.reference.realisations)
        )
        known = float(np.einsum("rs,rstu,tu->", weights, self.reference.covariance, weights))
        return controlled_log_variance(values, control, known)

    def slope(self, roi: int) -> Figure:
        """Of the contrast of an ROI."""
        row, true = self._row(roi, _CONTRAST), float(self.true[roi])
        if self.exact is not None:
            return float(((self.r.clean_rois[0] - self.r.clean_rois[1]) * row).sum()) / true
        return joint(
            lambda m: m / true,
            _mean(np.einsum("nrs,rs->n", self.r.rois[:, 0] - self.r.rois[:, 1], row)),
        )

    def without(self, roi: int) -> Figure:
        """Contrast beyond what there is without the signal, in the direction of the true one."""
        known = self.absent[roi]
        return joint(
            lambda m: (m - known) * self._sign[roi], self.mean(self._row(roi, _CONTRAST), 1)
        )

    def log_corrected(self, roi: int) -> Figure:
        """ln of the contrast's variance at slope 1."""
        return joint(
            lambda v, s: v - 2.0 * np.log(np.abs(s)),
            self.log_variance(self._row(roi, _CONTRAST)),
            self.slope(roi),
        )

    def log_relative(self, roi: int) -> Figure:
        """ln of that variance in units of the squared true contrast: methods whose HU differ can be
        compared."""
        scale = _log_of_square(self.true[roi])
        return joint(lambda v: v - scale, self.log_corrected(roi))

    def cnr(self, roi: int) -> Figure:
        """The paper's."""
        sign = self._sign[roi]
        return joint(
            lambda c, a, b: sign * c / np.sqrt(np.exp(a) + np.exp(b)),
            self.mean(self._row(roi, _CONTRAST), 0),
            self.log_variance(self._row(roi, (1.0, 0.0))),
            self.log_variance(self._row(roi, (0.0, 1.0))),
        )

    def log_noise(self, tissue: str) -> Jackknifed:
        """ln of a voxel's variance in a flat tissue."""
        v = self.r.flat[tissue].astype(np.float64)
        return log_of_sum(np.square(v - v.mean(0)).mean(1), lost=1)

    def d_prime(self, observer: str) -> Jackknifed | None:
        """None: too few realisations for the channels."""
        present, absent = np.moveaxis(self.r.channels[observer], 1, 0)
        if len(present) < 2 * present.shape[1] + 4:
            return None
        return d_prime(*hotelling_scores(present, absent))

    def rmse(self, square: Floats) -> Jackknifed:
        """HU."""
        return combined(np.sqrt, _mean(square))

    def invented(self) -> Jackknifed:
        """See the module, HU."""

        def both(errors: Floats, halves: tuple[Ints, Ints]) -> float:
            means = [errors[half].mean(0) for half in halves]
            return float(np.mean([_confirmed(*means), _confirmed(*means[::-1])]))

        errors, index = self.r.invented.astype(np.float64), np.arange(self.r.n)
        halves = index[::2], index[1::2]
        left_out = [
            both(errors, (halves[0][halves[0] != k], halves[1][halves[1] != k])) for k in index
        ]
        return Jackknifed(both(errors, halves), np.array(left_out))

    def contour(self) -> Jackknifed:
        """See the module, HU."""
        shells, n = self.r.shells, self.r.n
        mean = shells.mean(0)
        return Jackknifed(
            _fall(mean), np.array([_fall((n * mean - own) / (n - 1)) for own in shells])
        )


def _confirmed(found: Floats, other: Floats) -> float:
    """Mean of the other half's errors where the largest ones were found, in their direction."""
    count = max(1, round(_SHARE * found.size))
    at = np.argpartition(np.abs(found), -count)[-count:]
    return float((np.sign(found[at]) * other[at]).mean())


def _fall(profile: Floats) -> float:
    """Largest fall to one of the next two shells; 0: it falls nowhere."""
    falls = [profile[:-step] - profile[step:] for step in (1, 2)]
    return max(0.0, float(np.concatenate(falls).max()))


def joint(function: Callable[..., float | Floats], *figures: Figure) -> Figure:
    """:func:`torchpcct.metrics.intervals.combined`, exact where all figures are."""
    if any(isinstance(f, Jackknifed) for f in figures):
        return combined(function, *figures)
    return float(function(*figures))


def records_of(
    task: str,
    method: str,
    exposure_s: float,
    readings: RoiReadings,
    base: RoiReadings,
    reference: ReferenceNoise,
    ground_truth: GroundTruth,
    true: Floats,
    absent: Floats,
    rois: tuple[str, ...],
    exact: Floats | None = None,
    base_true: Floats | None = None,
) -> list[Record]:
    """All figures of a method at an exposure, one record each: task, method, exposure, figure,
    where, value, interval.

    Args:
        task, method, exposure_s: what was measured.
        readings: of the method; base: of the linear reference on the same realisations.
        reference: what is exactly known of the reference.
        ground_truth: of the task.
        true: ``(rois,)`` contrasts that the signal adds, HU.
        absent: ``(rois,)`` true contrasts without it, HU.
        rois: their names.
        exact: covariance of a linear method's ROI means; None: drawn.
        base_true: ``true`` of the linear reference, if its HU are others; None: the same.
    """
    control = reference
    if readings.control is not None:
        drawn, mean, covariance = readings.control
        control = ReferenceNoise(covariance, mean, drawn)
    own, other = (
        _Figures(readings, true, absent, control, exact),
        _Figures(
            base,
            true if base_true is None else base_true,
            absent,
            reference,
            reference.covariance,
        ),
    )
    found: list[Record] = []

    def add(
        figure: str, where: str, value: Figure, unit: str = "", transform: float | None = None
    ) -> None:
        """``transform`` t: of a logarithm, exp(t · value)."""
        if isinstance(value, Jackknifed):
            made = value.estimate() if transform is None else value.exponential(scale=transform)
        else:
            exactly = float(value) if transform is None else math.exp(transform * float(value))
            made = Estimate(exactly, math.nan, math.nan)
        found.append(
            {
                "task": task,
                "method": method,
                "exposure_s": exposure_s,
                "figure": figure,
                "where": where,
                "value": made.value,
                "low": made.low,
                "high": made.high,
                "unit": unit,
                "n": readings.n,
            }
        )

    def factor(figure: str, where: str, above: Figure, below: Figure) -> None:
        add(f"dose factor: {figure}", where, joint(lambda a, b: a - b, above, below), transform=1.0)

    for tissue in readings.flat:
        add("noise", tissue, own.log_noise(tissue), "HU", transform=0.5)
        factor("noise", tissue, other.log_noise(tissue), own.log_noise(tissue))
    add("error", "near the bodies", own.rmse(readings.square), "HU")
    add("error", "beside the signal", own.rmse(readings.square_beside), "HU")
    if readings.invented.shape[1] >= _ENOUGH:
        add("invented contrast", "about the bodies", own.invented(), "HU")
    if np.isfinite(readings.false_body).all():
        add("false body", "where nothing is", _mean(readings.false_body), "HU")
    if readings.shells.shape[1] >= 3:
        add("false contour", "about the bodies", own.contour(), "HU")
    add("error without noise", "near the bodies", math.sqrt(readings.clean_square), "HU")
    add("undershoot without noise", "beside the bodies", readings.clean_rim, "HU")
    for k, roi in enumerate(rois):
        slope = own.slope(k)
        add("slope", roi, slope)
        add("contrast without signal", roi, own.without(k), "HU")
        if _value(slope) > _LEAST_SLOPE:
            add("contrast SD at slope 1", roi, own.log_corrected(k), "HU", transform=0.5)
            factor("contrast at slope 1", roi, other.log_relative(k), own.log_relative(k))
    lesion = rois.index("lesion")
    best = math.log(ground_truth.bound_hu**2 / exposure_s) - _log_of_square(true[lesion])
    factor("Cramér–Rao bound", "lesion", other.log_relative(lesion), best)
    add("CNR", rois[0], own.cnr(0))
    if _value(own.cnr(0)) > 0 and _value(other.cnr(0)) > 0:
        factor("CNR", rois[0], _log_square(own.cnr(0)), _log_square(other.cnr(0)))
    for observer in OBSERVERS:
        d, e = own.d_prime(observer), other.d_prime(observer)
        if d is not None:
            add("d'", observer, d)
        if d is not None and e is not None and d.value > 0 and e.value > 0:
            factor("d'", observer, _log_square(d), _log_square(e))
    add("seconds", "a volume", readings.seconds, "s")
    for figure, shares in (
        ("share with a vessel model", readings.vessel_used),
        ("share with a warning", readings.warned),
    ):
        for where, share in zip(("with the signal", "without the signal"), shares, strict=True):
            if not math.isnan(share):
                add(figure, where, share)
    return found


def _value(figure: Figure) -> float:
    return figure.value if isinstance(figure, Jackknifed) else figure


def _log_of_square(contrast: float) -> float:
    return 2.0 * math.log(max(abs(float(contrast)), 1e-12))


def _log_square(figure: Figure) -> Figure:
    return joint(lambda v: 2.0 * np.log(np.maximum(np.abs(v), 1e-12)), figure)


def _mean(values: Floats) -> Jackknifed:
    return controlled_mean(values, None, None)


def pivot(records: list[Record], figure: str) -> Mapping[tuple[str, float, str], Record]:
    """(method, exposure, where) → record of a figure."""
    return {(r["method"], r["exposure_s"], r["where"]): r for r in records if r["figure"] == figure}
