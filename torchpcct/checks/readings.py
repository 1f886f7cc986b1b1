"""Checks of readings by themselves: too bright, clipped at either end, above an offset, almost no
signal, or no counts at all.

The description of a scan can be wrong in ways that no shape or sign shows, and FBP reconstructs it
all the same: water of -750 HU from transmissions given as counts. What speaks against a description
is in the readings: air beside the object reads as air does; photons have the noise of photons,
which an offset has not; a full well reads the same again and again; and no body is darkest at its
edge. What the readings do not show, nobody can know from them: a wrong ``mu_water`` or pitch, a
dark offset or scatter behind a round body in the middle.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from torchpcct.checks.floor import clipped_floor, folded_share
from torchpcct.readings import (
    DIM,
    FEWEST,
    MEDIAN_TO_SD,
    quartile_sd,
    second_differences,
    smoothed,
)
from torchpcct.scan import Scan

__all__ = ["reading_warnings"]

AIR_TOLERANCE = 0.015
"""Line integral of air below which the beam, or its calibration, is not that of the scan; 0.5 HU
in 30 cm of water."""
STARVED_SHARE = 0.05
"""Share of readings without light from which a volume is wrong for it."""
CLIPPED_SHARE = 0.005
"""Share of clipped readings from which a volume is wrong for it."""
OFFSET_SHARE = 0.05
"""Offset, over the darkest readings, from which it is named."""
OFFSET_SIGMAS = 4.5
"""Standard errors to which an offset must be known to be named."""
LOST_SHARE = 0.05
"""Part of the variance that the brightest readings lack, from which it is named; a detector that
loses a share x of its counts lacks 2 x."""
LOST_SIGMAS = 4.5
"""Standard errors to which it must be known."""
_QUARTILE_ERROR = 2.8
"""Relative error of a variance by the quartiles of n second differences, times √n."""
_DARK_SHARE = 0.3
"""Part of what bright readings lack that dark ones may lack, being fewer: filters take all."""
_BASE_GROUPS = 8
"""Groups of columns in which the growth of the noise is looked at."""
_BASE_CLASSES = 12
"""Classes of line integrals in each."""
_BASE_RANGE = 0.3
"""Range of line integrals over which the growth of the noise can be measured; in 80 sound scans
with 0.8 and more it was exp(1.4 p) at most."""
_BASE_SIGMAS = 3.0
"""Standard errors to which it must be known."""
_BASE_OFF = 0.3
"""How far the growth may lie off that of logarithms to base 10."""
_ELECTRONIC = 2.0
"""exp(2 p) is the fastest growth, of electronic noise alone."""
_BRIGHT = 0.85
"""Part of the brightest mean above which readings are bright."""
_DARK = 0.2
"""Part of the brightest mean below which readings are dark."""
_TOGETHER = (16, 4)
"""Views and columns whose mean tells whether readings are brighter than air."""
_REPEATED = 0.9
"""Share of equal readings from which a view is the one before."""
_LEAST_COLUMNS = 24
"""Columns of a detector that is tested."""
_LEAST_VIEWS = 16
"""Views of a scan that is tested."""
_AS_BEFORE = (
    "give the readings as they were before, negative ones too, with dark= or electronic_noise=, "
    "or, where those are lost, mask the whole shadow (dead=) or scan at a higher exposure"
)
"""What to do about negative readings that are none any more."""
_MOST = 4_000_000
"""Readings that are looked at; more only cost time."""


def reading_warnings(scan: Scan) -> list[str]:
    """What the readings of a noisy scan say against its description.

    Args:
        scan: of any geometry, without energy bins. What was acquired with a known exterior is only
            tested for light and for a lowest value.

    Returns:
        One sentence for each finding; empty if there is none.
    """
    g = scan.geometry
    if scan.noise_free or scan.counts.ndim > len(g.shape) + (not g.has_rows):
        return []
    dim = [] if scan.logged else without_light(scan)
    if g.columns < _LEAST_COLUMNS or g.views < _LEAST_VIEWS:
        return dim
    stack = g.has_rows or scan.counts.ndim == 2

    def by_view(values: Tensor) -> NDArray[np.float64]:
        """``(views, rows, columns)``, some of the rows, NaN where dead."""
        live = values if scan.dead is None else values.masked_fill(scan.dead, math.nan)
        shaped = (live if stack else live.movedim(0, 1)).reshape(g.views, -1, values.shape[-1])
        return shaped[:, :: max(1, math.ceil(values.numel() / _MOST))].double().numpy()

    counts = by_view(scan.counts)
    quantum = 1.0 if scan.quantum is None else float(scan.quantum.median())
    if scan.window is not None:
        return dim + _at_the_floor(counts, quantum)
    lines = by_view(scan._logarithm())
    floor = _at_the_floor(counts, quantum)
    flux = 1.0 if scan.flux is None else scan._per_view(scan.flux)
    shone = by_view(scan.counts / (scan._at_window(scan.air) * flux))
    inverted = _no_counts(lines, shone)
    if inverted:  # of the rest nothing is to be believed then
        return inverted + floor
    if scan.logged:
        return floor + _other_base(lines) + _brighter_than_air(-lines, logarithms=True)
    # Views that were stored twice have no noise between them; they are named elsewhere.
    repeated = (counts[1:] == counts[:-1]).mean((1, 2)) > _REPEATED
    counts = counts[np.r_[True, ~repeated]]
    # Of transmissions the noise says nothing of the photons in each cell.
    unknown = str(scan.info.get("signal_of_one_photon_from")).startswith("noise")
    transfer = [] if unknown else _transfer_texts(counts, quantum)
    return dim + (floor or _clipped(counts, quantum) or transfer or _brighter_than_air(shone))


def without_light(scan: Scan) -> list[str]:
    """Whether too many rays are too dark for their line integrals to be known.

    Args:
        scan: of counts, without energy bins.

    Returns:
        One sentence, or none.
    """
    quanta = scan.counts if scan.quantum is None else scan.counts / scan.quantum
    if float(quanta.amin()) >= FEWEST:
        return []
    expected = scan._expected(quanta)
    if scan.exterior is None:
        expected = smoothed(expected, scan.dead, scan.geometry.has_rows)
    share = float((expected < FEWEST).float().mean())
    if share <= STARVED_SHARE:
        return []
    return [
        f"{100 * share:.2g} % of the rays leave less than {FEWEST:g} photons a reading: how dark "
        "they are the data do not say, and what they pass reads too low; raise the exposure, or "
        "bin the readings"
    ]


def _no_counts(lines: NDArray[np.float64], transmissions: NDArray[np.float64]) -> list[str]:
    """Whether the object is brighter than what surrounds it."""
    bright = float((lines < -math.log(1.5)).mean())
    if bright > 0.05:  # single readings of a few photons may be by their noise
        views, columns = (n // k for n, k in zip(lines.shape[::2], _TOGETHER, strict=True))
        some = transmissions[: views * _TOGETHER[0], :, : columns * _TOGETHER[1]]
        blocks = some.reshape(views, _TOGETHER[0], -1, columns, _TOGETHER[1])
        mean = _mean(blocks, (1, 4))
        spread = np.sqrt(np.maximum(_mean(blocks**2, (1, 4)) - mean**2, 0.0))
        bright = float((mean - 3.0 * spread / math.sqrt(math.prod(_TOGETHER)) > 1.5).mean())
    if bright > 0.05:
        return [
            f"{100 * bright:.0f} % of the readings are more than 1.5 times as bright as air: air, "
            "gain or flux are not those of the scan, or these are line integrals given as counts "
            "(Scan.from_line_integrals takes them)"
        ]
    quarter = lines.shape[-1] // 4
    ends = min(float(np.nanmean(side)) for side in _ends(lines))
    middle = float(np.nanmedian(lines[..., quarter:-quarter]))
    if ends > max(1.3 * middle + 0.1, 0.5 * float(np.nanquantile(lines[::4], 0.9))):
        return [
            f"the rays at both ends of the rows are the darkest (line integrals of {ends:.2g}, in "
            f"the middle {middle:.2g}): these are transmissions or counts given as line integrals, "
            "or line integrals given as counts"
        ]
    return []


def _brighter_than_air(transmissions: NDArray[np.float64], logarithms: bool = False) -> list[str]:
    """Whether the rays beside the object read more than air does, by their transmissions, or, where
    only those are known, by the ``logarithms``: of few photons their mean is not that of a beam."""
    # The darker end of each view; views differ by the tube, so that the spread is theirs.
    view = np.min(np.stack([_mean(side, (1, 2)) for side in _ends(transmissions)]), axis=0)
    view = np.exp(view) if logarithms else view
    view = view[np.isfinite(view)]
    if not view.size:
        return []
    excess, spread = float(view.mean()) - 1.0, float(view.std()) / math.sqrt(view.size)
    if not excess > max(AIR_TOLERANCE, 5.0 * spread):
        return []
    return [
        f"the rays beside the object are {100 * excess:.2g} % brighter than air: an "
        "offset (dark=) or scatter adds to the readings, or the beam is not that of the air frame "
        "(flux=); the object reads too low"
    ]


def _other_base(lines: NDArray[np.float64]) -> list[str]:
    """Whether the noise of line integrals grows faster than that of photons and electronics can.

    The variance of p = ln(N0 / N) is exp(p) / N0 of photons, and grows as exp(2 p) where electronic
    noise is all. Logarithms to base 10 are a 2.303th of p: their variance grows as exp(2.303 p).
    """
    groups, means, logs, errors = [], [], [], []
    # Of columns side by side, which share a bow-tie filter's part.
    for group, part in enumerate(np.array_split(lines, _BASE_GROUPS, axis=2)):
        second = part[2:] - 2.0 * part[1:-1] + part[:-2]
        mean = (part[2:] + part[1:-1] + part[:-2]) / 3.0
        known = np.isfinite(second)
        if not known.any():
            continue
        edges = np.quantile(mean[known], np.linspace(0.0, 1.0, _BASE_CLASSES + 1))
        at = np.where(known, np.clip(np.searchsorted(edges, mean, "right"), 1, _BASE_CLASSES), 0)
        for k in range(1, _BASE_CLASSES + 1):
            chosen = at == k
            both = chosen[1:] & chosen[:-1]
            number = int(chosen.sum())
            if number < 60 or both.sum() < 40:
                continue
            sd = quartile_sd(second[chosen])
            a, b = second[1:][both], second[:-1][both]
            small = (np.abs(a) < 4.0 * sd) & (np.abs(b) < 4.0 * sd)
            a, b = a[small], b[small]
            # White noise: -2/3. Details of the object are none.
            if sd <= 0.0 or (a * b).sum() > -0.5 * math.sqrt((a * a).sum() * (b * b).sum()):
                continue
            groups.append(group)
            means.append(float(mean[chosen].mean()))
            logs.append(2.0 * math.log(sd))
            errors.append(_QUARTILE_ERROR / math.sqrt(number))
    if len(means) < _LEAST_CLASSES:
        return []
    weight = 1.0 / np.square(errors)
    same = np.equal.outer(groups, groups).astype(np.float64)
    x, y = (v - same @ (weight * v) / (same @ weight) for v in (np.array(means), np.array(logs)))
    power = float((weight * x * x).sum())
    if max(means) - min(means) < _BASE_RANGE or power <= 0.0:
        return []
    slope = float((weight * x * y).sum()) / power
    free = max(len(means) - len(set(groups)) - 1, 1)
    spread = float((weight * np.square(y - slope * x)).sum()) / free
    known_to = _BASE_SIGMAS * math.sqrt(max(spread, 1.0) / power)
    # What details of the object add to the noise of some classes grows anyhow.
    if slope - known_to < _ELECTRONIC or abs(slope - math.log(10.0)) > _BASE_OFF:
        return []
    return [
        f"the noise of the line integrals p grows as exp({slope:.2g} p), that of photons as "
        "exp(p): these are logarithms to base 10 (multiply them by 2.303), and the object "
        "reads too low"
    ]


def _ends(lines: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The outermost columns on either side that are alive."""
    live = np.flatnonzero(np.isfinite(lines).any((0, 1)))
    edge = max(2, lines.shape[-1] // 50)
    return lines[..., live[:edge]], lines[..., live[-edge:]]


def _mean(values: NDArray[np.float64], axes: tuple[int, ...]) -> NDArray[np.float64]:
    known = np.isfinite(values)
    number = known.sum(axes)
    total = np.where(known, values, 0.0).sum(axes)
    return np.where(number > 0, total / np.maximum(number, 1), np.nan)


def _at_the_floor(counts: NDArray[np.float64], quantum: float) -> list[str]:
    """Whether readings were clipped at their lowest value, or negative ones made positive."""
    floor = clipped_floor(counts, quantum)
    if not floor.clipped:
        folded = folded_share(counts)
        if folded == 0.0:
            return []
        return [
            f"{100 * folded:.2g} % of the readings lie closer above 0 than half of their noise, "
            "and none below: negative ones, after the dark was taken off, were made positive "
            "(absolute values?), the darkest rays read too bright and what they pass too low; "
            f"{_AS_BEFORE}"
        ]
    where = "are marked as dead" if math.isnan(floor.value) else f"read {floor.value:.3g}"
    how = "left out" if math.isnan(floor.value) else "clipped there"
    return [
        f"{100 * floor.share:.2g} % of the readings {where}, {100 * floor.excess:.2g} % more than "
        f"photons leave dark beside readings of several photons: lower ones were {how} (negative "
        "ones, after the dark was taken off?), the darkest rays read too bright and what they pass "
        f"too low; {_AS_BEFORE}"
    ]


def _clipped(counts: NDArray[np.float64], quantum: float) -> list[str]:
    """Readings that stop at the detector's full well: the highest of a cell comes again and
    again."""
    columns = counts.shape[-1]
    views = counts.shape[0]
    highest = np.nanmax(np.where(np.isnan(counts), -np.inf, counts), axis=0)
    at_top = counts >= highest
    # A handful of photons comes again and again, too.
    often = (at_top.sum(0) >= max(5, 0.05 * views)) & (highest > DIM * quantum)
    share = float((at_top & often).sum()) / counts.size
    if share < CLIPPED_SHARE:
        return []
    # Below, there must be noise: white, of more than one step of the digits, and more than the
    # highest readings have.
    second = counts[..., 2:] - 2.0 * counts[..., 1:-1] + counts[..., :-2]
    flat = at_top & often
    free = ~(flat[..., 2:] | flat[..., 1:-1] | flat[..., :-2]) & np.isfinite(second)
    both = free[..., 1:] & free[..., :-1]
    level = counts[..., 1:-1]
    upper = free & (level > 0.5 * np.nanmedian(level[free])) if free.any() else free
    if upper.sum() < 100 or both.sum() < 100:
        return []
    a, b = second[..., 1:][both], second[..., :-1][both]
    limit = 5.0 * np.median(np.abs(a)) + 1e-300  # edges are no noise
    small = (np.abs(a) < limit) & (np.abs(b) < limit)
    white = float(
        (a * b)[small].sum()
        / max(float(np.sqrt((a * a)[small].sum() * (b * b)[small].sum())), 1e-300)
    )
    noise = MEDIAN_TO_SD * float(np.median(np.abs(second[upper]))) / math.sqrt(6.0)
    digits = [
        np.diff(np.unique(counts[:, r, c]))
        for r in (0,)
        for c in range(0, columns, max(1, columns // 16))
    ]
    step = (
        float(np.median([d.min() for d in digits if d.size]))
        if any(d.size for d in digits)
        else 0.0
    )
    if white > -0.1 or noise < 2.0 * step:
        return []
    return [
        f"{100 * share:.2g} % of the readings stop at the highest value of their cell: the "
        "detector is saturated, and the thin parts of the object read too low; lower the "
        "exposure, or mask those readings by dead="
    ]


def _transfer_texts(counts: NDArray[np.float64], quantum: float) -> list[str]:
    """What is wrong with the variance of readings of a mean: over an offset, or of a detector that
    loses counts."""
    # From view to view: there details change least, and cells of a scintillator share no light.
    classes = _transfer(np.moveaxis(counts, 0, -1), np.nanquantile(counts, _CLASSES))
    return _offset(*classes, quantum) or _lost_counts(*classes, quantum)


def _lost_counts(
    mean: NDArray[np.float64],
    variance: NDArray[np.float64],
    number: NDArray[np.int64],
    quantum: float,
) -> list[str]:
    """Bright readings whose noise is that of fewer photons than they count, beside dark ones whose
    noise is right.

    A dead time τ spaces the counts of a rate a more evenly: their variance over their mean is
    1 − 2 a τ exp(−a τ) if pulses prolong it, and 1 / (1 + a τ)² if not (Yu and Fessler, Phys. Med.
    Biol. 45, 2043, 2000); both lose a share a τ of the counts, to first order. Filters and
    neighbours that share light take as much of the noise of dark readings.
    """
    known = (number >= 100) & (variance > 0) & (mean > DIM * quantum)
    if not known.any():
        return []
    m, weight = mean[known], number[known].astype(float)
    ratio = variance[known] / (m * quantum)
    top = float(m.max())
    bright, dark = m > _BRIGHT * top, m < _DARK * top
    if not (bright.any() and dark.any()):
        return []
    # Details of the object add to some classes, and never take.
    brightest, darkest = (float(np.average(ratio[k], weights=weight[k])) for k in (bright, dark))
    errors = [_QUARTILE_ERROR / math.sqrt(float(weight[k].sum())) for k in (bright, dark)]
    least = darkest - LOST_SIGMAS * darkest * errors[1]
    if brightest * (1.0 + LOST_SIGMAS * errors[0]) > min(1.0 - LOST_SHARE, least):
        return []
    if 1.0 - np.median(ratio[dark]) > _DARK_SHARE * (1.0 - brightest):
        return []
    return [
        f"the brightest readings have {100.0 * (1.0 - brightest):.2g} % less variance than photons "
        "have, the darkest do not: as of a detector that loses "
        f"{50.0 * (1.0 - brightest):.2g} % of its counts in air to its dead time (pile-up), and "
        "less behind the object, which reads too low; correct the readings and air for the dead "
        "time, or calibrate in water at the same tube current"
    ]


def _offset(
    mean: NDArray[np.float64],
    variance: NDArray[np.float64],
    number: NDArray[np.int64],
    quantum: float,
) -> list[str]:
    """Readings over an offset: their noise is that of fewer photons than they count.

    The variance of readings m, from the differences between views, is F (m - D) + c m²: F is the
    signal of a photon, D the offset, and c what details of the object add (Janesick 2007, with the
    object in the beam).
    """
    many = (number >= 100) & (variance > 0) & (mean > 0)
    if many.sum() < _LEAST_CLASSES:
        return []
    many[many] = mean[many] > DIM * np.median(variance[many] / mean[many])
    while many.sum() >= _LEAST_CLASSES:
        m, v = mean[many], variance[many]
        # Of n values of which three share a reading, by the distance of their quartiles.
        error = v * 3.5 / np.sqrt(number[many])
        design = np.stack([m, -np.ones_like(m), m * m], 1)
        scale = np.abs(design).max(0)
        weighted = design / scale / error[:, None]
        inverse = np.linalg.pinv(weighted.T @ weighted)
        fit = inverse @ (weighted.T @ (v / error))
        left = v / error - weighted @ fit
        if left.max() < 4.0:
            break
        many[np.flatnonzero(many)[int(left.argmax())]] = False  # edges
    else:
        return []
    photon, product, spread = (
        fit[0] / scale[0],
        fit[1] / scale[1],
        math.sqrt(inverse[1, 1]) / scale[1],
    )
    # Else it is not the noise of photons that was found.
    explained = (
        0.3 < photon / quantum < 1.5 and float(np.square(left).mean()) < 2.0 and m[-1] > 3.0 * m[0]
    )
    if not explained or product < OFFSET_SIGMAS * spread or product / photon < OFFSET_SHARE * m[0]:
        return []
    # What details add to the noise of the brighter readings bends the curve, too: the dark ones
    # must lack some.
    ratio, third = v / (m * quantum), max(len(m) // 3, 1)
    dark, bright = (
        float(np.average(ratio[:third], weights=number[many][:third])),
        float(np.median(ratio[-third:])),
    )
    sure = OFFSET_SIGMAS * dark * 3.5 / math.sqrt(float(number[many][:third].sum()))
    if dark + sure > (1.0 - OFFSET_SHARE / 2) * min(1.0, bright):
        return []
    return [
        "the darkest readings have less noise than photons can have: as over an offset of "
        f"{product / photon:.2g} (the darkest read {m[0]:.2g}); give dark=, and air= of the same "
        "detector, or the object reads too low"
    ]


_CLASSES = np.linspace(0.0, 1.0, 25)
"""Quantiles of the readings between which their noise is taken together."""
_LEAST_CLASSES = 12
"""Classes that a line through noise and mean is fitted to, at least."""


def _transfer(
    n: NDArray[np.float64], edges: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Mean, variance (between neighbours on the last axis) and number of the readings between
    ``edges``."""
    second, mean = second_differences(n)
    known = np.isfinite(second)
    second, mean = second[known], mean[known]
    at = np.clip(np.searchsorted(edges, mean, side="right") - 1, 0, len(edges) - 2)
    at = at.astype(np.int8)  # so short that its order is counted
    order = np.argsort(at, kind="stable")
    parts = np.split(order, np.searchsorted(at[order], np.arange(1, len(edges) - 1)))
    # Over √m, so that the dimmer ones of a class do not count for more.
    second /= np.sqrt(np.maximum(6.0 * mean, 1e-300))
    m = np.array([mean[p].mean() if p.size else 0.0 for p in parts])
    sd = [quartile_sd(second[p]) if p.size else 0.0 for p in parts]
    v = np.array([s**2 * level for s, level in zip(sd, m.tolist(), strict=True)])
    return m, v, np.array([p.size for p in parts])
