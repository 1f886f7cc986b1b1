"""By how much are line integrals of few photons off on average? The logarithm of a noisy reading
is not that of its mean.

To second order ln(n + a) of Poisson counts n with mean m lies (a - ½) / m above ln m, with
electronic noise σ another σ² / (2 m²) below. :meth:`torchpcct.scan.Scan.line_integrals` takes that
off counts (:func:`torchpcct.readings.log_bias`); what is left is of rays that leave so few photons
that their number is not known. Line integrals that another software made are as they are. Their
noise tells what was done: the variance of exp(-p) grows by the signal u of a photon with its mean
y, and is u (y - a u) where a photons were added before the logarithm was taken, u y + σ² u² where
the electronics add noise (photon transfer, Janesick 2007).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter
from torch import Tensor

from torchpcct.readings import (
    MEDIAN_TO_SD,
    expected,
    fewest,
    log_bias,
    many,
    normal_nodes,
    second_differences,
    shifted,
    smoothed,
)
from torchpcct.scan import Scan

__all__ = ["logarithm_error"]

Floats = NDArray[np.float64]

_AROUND = 7
"""Views and columns over which readings are averaged for their mean."""
_LEAST_MEAN = 0.02
"""Photons to which the mean of so many is known at best."""
_UNKNOWN = 2.0
"""Mean over the fewest photons that the logarithm is corrected of, below which it is not known."""
_MOST_MEAN = 60.0
"""Photons from which a logarithm is off by less than a hundredth, whatever was added."""
_GROUPS = 8
"""Groups of columns side by side, which share a bow-tie filter's part."""
_CLASSES = 12
"""Classes of brightness in which noise is looked at."""
_FEWEST = 100
"""Second differences of a class, at least."""
_UNEVEN = 0.03
"""Relative error of a variance that a beam leaves which is not even within a group."""
_EDGES = 16.0
"""χ² of a class from which it is of edges, and says nothing."""
_FITS = 3.0
"""χ² over the number of classes up to which it is noise that is looked at."""
_CLIPPED = 2.5
"""Photons below which readings without any change the noise of logarithms."""
_BRIGHT = 5.0
"""Photons in the median class of a group from which its noise tells their signal; in darker ones
it is that of the groups beside."""
_BEYOND = (-1.0, -0.5, 0.0, *(float(v) for v in np.geomspace(0.5, 2500.0, 25)))
"""What the variance may be above the photons that are read: less, where one or half of one was
added, more, where electronics add noise."""
_SURE = 6.0
"""χ² by which something else must fit better than photons without any change."""
_COUNTED = 4.3
"""Photons below which single ones are resolved in the readings."""
_SEVERAL = 0.5
"""Standard deviation of these readings, in photons, from which there are several of them."""
_RESOLVED = 0.5
"""Mean cosine of readings between whole photons from which they are resolved."""
_CLEARLY = 0.05
"""How much more it must be of whole photons than of halves, or less."""
_ERRORS = 5.0
"""Standard errors that it must be more beyond that."""
_SAME = 1.001
"""Factor within which readings are the same."""
_CLIPPED_SHARE = 0.05
"""Share of readings that are the lowest one, from which those without a photon were set to it."""
_NEARBY = np.linspace(0.75, 1.3, 111)
"""Factors within which the noise tells the signal of a photon."""
_MOST = 4000
"""Readings of a group that are looked at for single photons."""
_TRIMMED = 4.0
"""Standard deviations beyond which a second difference is an edge."""


class _Made(NamedTuple):
    """How line integrals were made: of ``max(n + added + noise, floor)`` photons, each of which
    ``signal (columns,)`` of air stands for; whether it is sure that nothing else was added."""

    signal: Floats
    added: float
    noise: float
    floor: float
    sure: bool


def logarithm_error(scan: Scan) -> tuple[Tensor, bool] | None:
    """Mean error of a scan's line integrals that follows from their logarithms being those of few
    photons, as far as it can be determined.

    Args:
        scan: noisy, without window and energy bins.

    Returns:
        The shape of ``scan.counts``: how much too high line integrals are on average, and whether
        its sign is known; None where no ray leaves so few photons that it matters.
    """
    if scan.noise_free or scan.window is not None:
        return None
    if scan.logged:
        return _of_logarithms(scan)
    quanta = scan.counts if scan.quantum is None else scan.counts / scan.quantum
    noise = scan._noise_in_quanta()
    if float(quanta.amin()) >= fewest(noise):
        return None
    mean = _mean_around(quanta, scan)
    least = max(_LEAST_MEAN, noise / _AROUND)
    known = np.geomspace(least, many(noise), 80)
    bias = expected(known, noise, lambda n: np.log(shifted(n, noise))) - np.log(known)
    z, weight = normal_nodes(3.0, 31)
    estimate = known[:, None] + np.sqrt((known + noise**2) / 10.0)[:, None] * z
    taken_off = log_bias(torch.from_numpy(estimate).clamp(min=0.0), noise).numpy() @ weight
    # Above, the bias is taken off well.
    taken_off = np.where(known < _UNKNOWN * fewest(noise), taken_off, bias)
    found = np.interp(np.log(np.maximum(mean, least)), np.log(known), taken_off - bias)
    return torch.from_numpy(found), True


def _of_logarithms(scan: Scan) -> tuple[Tensor, bool] | None:
    shone = torch.exp(-scan._logarithm())
    if scan.dead is not None:
        shone = shone.masked_fill(scan.dead, math.nan)
    rows = scan.geometry.has_rows
    y = (shone if rows or shone.ndim == 2 else shone.movedim(0, 1)).double()
    made = _made(y.reshape(scan.geometry.views, -1, scan.geometry.columns).numpy())
    if made is None:
        return None
    m = np.geomspace(_LEAST_MEAN, _MOST_MEAN + 6.0 * made.noise, 120)

    def kept(n: Floats) -> Floats:
        return np.maximum(n + made.added, made.floor)

    level = expected(m, made.noise, kept)
    error = np.log(m) - expected(m, made.noise, lambda n: np.log(kept(n)))
    error[-1] = 0.0
    mean = _mean_around(
        torch.nan_to_num(shone, nan=1.0).double() / torch.from_numpy(made.signal), scan
    )
    return torch.from_numpy(np.interp(mean, level, error)), made.sure


def _mean_around(values: Tensor, scan: Scan) -> Floats:
    """Mean over the neighbouring views and columns, of what :func:`smoothed` leaves."""
    smooth = smoothed(values.double(), scan.dead, scan.geometry.has_rows).numpy()
    size = [1] * smooth.ndim
    size[-1] = size[-3 if scan.geometry.has_rows else -2] = _AROUND
    found: Floats = uniform_filter(smooth, size, mode="nearest")
    return found


def _made(y: Floats) -> _Made | None:
    """How logarithms were made, by the noise of ``y = exp(-p)``, ``(views, rows, columns)``; None:
    of so many photons that it does not matter, or it cannot be determined."""
    groups = np.array_split(np.arange(y.shape[-1]), max(1, min(_GROUPS, y.shape[-1] // 8)))
    classes = [_transfer(y[..., columns]) for columns in groups]
    if not all(level.size for level, _, _ in classes):
        return None
    clipped = np.array([_at_lowest(y[..., columns]) > _CLIPPED_SHARE for columns in groups])
    fits = {beyond: _units(classes, clipped, beyond) for beyond in _BEYOND}
    counted, known = _counted(y, groups, {k: fits[k][0] for k in (0.0, -0.5, -1.0)})
    clearest = max(counted, key=lambda k: counted[k].score)
    alike = (-0.5,) if clearest == -0.5 else (-1.0, 0.0)
    found = counted[clearest]
    unlike = max(other.score for k, other in counted.items() if k not in alike)
    if found.score > max(_RESOLVED, unlike + _CLEARLY + _ERRORS * found.error):
        # 0 or 1 were added, which are the same readings, or a half.
        units_of = {k: np.where(known, found.units, fits[k][0]) for k in alike}
        fits = {k: (units, _misfit(classes, units, k)) for k, units in units_of.items()}
    beyond = min(fits, key=lambda k: fits[k][1])
    others = [fit[1] for k, fit in fits.items() if k * beyond <= 0.0 and k != beyond]
    fitting = fits[beyond][1] < _FITS * sum(len(level) for level, _, _ in classes)
    sure = fitting and all(chi2 - fits[beyond][1] > _SURE for chi2 in others)
    # Without a sign of more nothing was added.
    beyond = beyond if sure else 0.0
    units = fits[beyond][0]
    signal = np.concatenate([np.full(c.size, u) for c, u in zip(groups, units, strict=True)])
    lowest = float(np.nanmin(y / signal))
    made = _Made(
        signal, max(-beyond, 0.0), math.sqrt(max(beyond, 0.0)), min(max(lowest, 0.01), 1.0), sure
    )
    darkest = min(
        float(level.min()) / unit for (level, _, _), unit in zip(classes, units, strict=True)
    )
    return made if darkest < _MOST_MEAN + 6.0 * made.noise else None


def _at_lowest(y: Floats) -> float:
    """Share of readings that are the lowest one."""
    known = y[np.isfinite(y)]
    return float(np.mean(known <= _SAME * known.min()))


class _Counted(NamedTuple):
    """How clearly the lowest readings are whole photons and what was added to them, up to 1; its
    standard error; the signal of a photon in each group of columns."""

    score: float
    error: float
    units: Floats


def _counted(
    y: Floats, groups: list[NDArray[np.int64]], units: dict[float, Floats]
) -> tuple[dict[float, _Counted], NDArray[np.bool_]]:
    """What whole photons tell where 0, ½ or 1 was added (keys: its negative), near the ``units``
    by the noise; in which groups of columns they tell it, the same ones for all."""
    found = {k: unit.copy() for k, unit in units.items()}
    known = np.zeros(len(groups), dtype=np.bool_)
    cosines: dict[float, list[Floats]] = {k: [] for k in units}
    for at, columns in enumerate(groups):
        readings = y[..., columns][np.isfinite(y[..., columns])]
        # The lowest may be what readings without a photon are set to.
        readings = readings[readings > _SAME * readings.min()]
        lowest = {k: readings / unit[at] for k, unit in units.items()}
        lowest = {k: x[x < _COUNTED][:_MOST] for k, x in lowest.items()}
        # A few photons more or less fit a longer or shorter step as well.
        if any(x.size < _FEWEST or x.std() < _SEVERAL for x in lowest.values()):
            continue
        known[at] = True
        for k, x in lowest.items():
            half = 0.5 * (k == -0.5)
            steps = np.cos(2.0 * math.pi * (x / _NEARBY[:, None] + half))
            best = int(steps.mean(1).argmax())
            found[k][at] *= _NEARBY[best]
            cosines[k].append(steps[best])
    counted = {}
    for k, of in cosines.items():
        every = np.concatenate(of) if of else np.zeros(1)
        error = float(every.std()) / math.sqrt(every.size)
        counted[k] = _Counted(float(every.mean()), error, found[k])
    return counted, known


def _units(
    classes: list[tuple[Floats, Floats, Floats]], clipped: NDArray[np.bool_], beyond: float
) -> tuple[Floats, float]:
    """The signal of a photon in each group of columns where the variance of ``m`` photons is ``m +
    beyond``, and how badly that fits (χ²); of ``clipped`` groups noise does not tell it."""
    units, bright = np.empty(len(classes)), np.zeros(len(classes), dtype=np.bool_)
    for k, (level, variance, _) in enumerate(classes):
        unit = float(np.median(variance / level))
        for _ in range(40):
            x = level / unit
            clear = x > _CLIPPED
            if clear.sum() < 2:
                clear = x >= np.sort(x)[-2:][0]
            model = np.maximum(x + beyond, 0.2 * x)
            # Edges of the object are in some of the classes.
            ratio = float(np.median((variance / model)[clear])) / unit**2
            if abs(ratio - 1.0) < 1e-4:
                break
            unit *= ratio**0.5
        units[k] = unit
        bright[k] = not clipped[k] and np.median(level / unit) > _BRIGHT
    if bright.any():  # single photons, clipped or not, tell little of their signal
        at = np.arange(len(units))
        units = np.where(bright, units, np.interp(at, at[bright], units[bright]))
    return units, _misfit(classes, units, beyond)


def _misfit(classes: list[tuple[Floats, Floats, Floats]], units: Floats, beyond: float) -> float:
    """χ² of variances that should be those of ``m + beyond`` photons.

    Second differences share readings: the relative variance of their mean square is 3.9 over
    their number.
    """
    chi2 = 0.0
    for (level, variance, number), unit in zip(classes, units, strict=True):
        x = level / unit
        model = np.maximum(x + beyond, 0.2 * x)
        clear = x > _CLIPPED
        error = 3.9 / number + _UNEVEN**2
        off = np.square(variance / (unit**2 * model) - 1.0) / error
        chi2 += float(np.minimum(off, _EDGES)[clear].sum())
    return chi2


def _transfer(y: Floats) -> tuple[Floats, Floats, Floats]:
    """Mean, variance and number of readings in classes of brightness, by second differences along
    the views or the columns, whichever vary less."""
    both = [_along(np.moveaxis(y, axis, -1)) for axis in (0, -1)]
    known = [values for values in both if values[0].size]
    if not known:
        return (np.zeros(0),) * 3
    return min(known, key=lambda v: float((v[1] / v[0]).mean()))


def _along(y: Floats) -> tuple[Floats, Floats, Floats]:
    second, mean = second_differences(y)
    known = np.isfinite(second) & (mean > 0.0)
    second, mean = second[known], mean[known]
    if second.size < _FEWEST:
        return (np.zeros(0),) * 3
    # Sums of three whole numbers are often equal but for their last digits, which depend on what
    # was summed: these must not decide which of them belong to a class.
    order = np.argsort(np.round(np.log(mean), 3), kind="stable")
    found = []
    for members in np.array_split(order, _CLASSES):
        d, m = second[members], mean[members]
        if d.size < _FEWEST:
            continue
        # Given the sum of three readings of photons, its variance is exactly six times their mean.
        ratio = d / np.sqrt(6.0 * m)
        sd = MEDIAN_TO_SD * float(np.median(np.abs(ratio)))
        inner = ratio[np.abs(ratio) <= _TRIMMED * max(sd, 1e-300)]
        found.append((float(m.mean()), float(np.square(inner).mean() * m.mean()), float(d.size)))
    level, variance, number = np.array(found).reshape(-1, 3).T
    some = variance > 0.0
    return level[some], variance[some], number[some]
