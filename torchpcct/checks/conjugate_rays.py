"""Does a full turn agree with itself? Conjugate rays see one line, so a wrong description shows
without an image.

The ray of source angle β and fan angle γ is met again by that of β + π − 2γ and −γ (the consistency
condition behind the moments of Helgason and Ludwig). Read there D(β + a, γ + e) instead of D(β, γ),
the difference is, to first order,

    r = −a ∂D/∂β − e ∂D/∂γ + noise,

and each error of the description has its own a and e:

* columns described ε above where they are: e = −2ε (of a detector rolled by θ ε = θ v changes with
  the row's height v);
* fan angles (pitch over sdd) too small by the factor 1 + κ: a = 2κγ, nothing in the middle, most at
  the edges;
* steps between the views too small by the factor 1 + s: a = s (β' − β), β' the described angle at
  which the scanner was when it read the conjugate ray: half a turn later, or earlier.

r is regressed on each pattern. The slopes of the two rays have independent noise, so the product of
one's, smoothed, and the other's, raw, neither shrinks nor stretches the estimate (instrumental
variables, Durbin 1954, Rev. Int. Stat. Inst. 22:23). Its error is that of the sums over blocks of
views, which knows nothing of how noisy a reading is: the test statistic is Student's. What all
views have alike, as the noise of the air frames, scatters from column to column only; of an object
that is round about the axis that is most of the error (:meth:`RayPairs.shared_error`). The cause
that explains most of r is named. Where none does, the share of r in what changes from view to view
says whether the rays have anything in common; products of neighbouring columns are free of noise.

An object that moves during the turn stands elsewhere when the conjugate ray comes: ε then changes
with β. Of a movement c(β) along the columns, conjugate rays show c(β) + c(β + π), so once in a turn
looks like an object that stands elsewhere and is none of our business; twice in a turn is what is
tested, a wave cos 2β, sin 2β of ε.

What no conjugate rays can show, since the described scan is that of another object, a right one:
the angle of the first view (the object turned), sod (the object scaled, its attenuation the other
way; so are parallel rays' pitch), both the direction of rotation and that of the columns (the
object mirrored; of parallel rays each alone), a displacement of the object, and all that happens to
both rays alike: water's attenuation, gain and bowtie if air was measured with them, spectrum and
pile-up (:mod:`torchpcct.checks.moments` sees those in bodies that are not round).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpcct.checks.modules import module_test
from torchpcct.checks.ray_pairs import BLOCKS, WIDTHS, RayPairs, product, unwrapped
from torchpcct.checks.scan_test import UNKNOWN, ScanTest
from torchpcct.checks.view_scatter import view_scatter_test
from torchpcct.detector_window import DetectorWindow
from torchpcct.geometry import Geometry, view_step
from torchpcct.validate import checked

__all__ = ["centre_test", "geometry_test"]

CENTRE_TOLERANCE = 0.1
"""Error of the centre in columns that is no finding: alignment, and what interpolation between
the views leaves."""
SCALE_TOLERANCE = 0.003
"""Relative error of the fan angles that is no finding: what mechanics leave."""
STEP_TOLERANCE = 0.001
"""Relative error of the steps between views that is no finding: what mechanics leave."""
FALSE_ALARMS = 0.0005
"""Share of scans with an error of :data:`CENTRE_TOLERANCE` that are taken for wrong; of faultless
ones it is less. None of 500 sound scans should give a finding."""
_DIFFER = 0.03
"""Mean square of the difference, over that of what changes from view to view, from which conjugate
rays differ."""
_STRANGERS = 0.3
"""The same from which they have nothing to do with each other."""
_EXPLAINED = 0.1
"""Share of the difference that a cause must explain to be named where conjugate rays have little
in common."""
_LARGEST = 0.3
"""Relative errors and angles in rad beyond which nothing is linear: no cause is named for what
is larger."""
_KNOWN = 0.1
"""Part of its tolerance to which a size is known at best."""
_FINE_STEP_RAD = math.radians(2.5)
"""Step between views in rad below which neighbouring views foretell each other: where they do not,
the views are out of order."""

Floats = NDArray[np.float64]


@checked
def centre_test(
    lines: Tensor,
    geometry: Geometry,
    window: DetectorWindow | None = None,
    about: tuple[float, float] = (0.0, 0.0),
) -> ScanTest:
    """Measure the rotation centre by the conjugate rays of a scan, of a cone beam by those near the
    plane of the source.

    Args:
        lines: line integrals ``(views, [rows,] columns)`` of any unit, on ``window``, what all
            views share taken off. Views in any order.
        geometry: parallel, fan or cone beam.
        window: of the readings; None: the whole detector.
        about: (y, x) in mm of what the readings show: views are interpolated along its path.

    Returns:
        The test of ``centre``: how many columns too high the described positions of the columns
        are; and of ``swing``, the amplitude in columns by which it changes twice in a turn.
        :data:`UNKNOWN` where no conjugate rays were measured or nothing is to be seen.

    Raises:
        ValueError: a wrong shape, NaN or Inf.
    """
    pairs = RayPairs.of(lines, geometry, window, about)
    return UNKNOWN if pairs is None else _centre(pairs, FALSE_ALARMS)[0]


@checked
def geometry_test(
    lines: Tensor,
    geometry: Geometry,
    window: DetectorWindow | None = None,
    about: tuple[float, float] = (0.0, 0.0),
) -> ScanTest:
    """Test the description of a scan by its conjugate rays: centre, fan angles, steps between
    views, roll.

    Args:
        lines, geometry, window, about: see :func:`centre_test`.

    Returns:
        The test of ``centre`` (see :func:`centre_test`), ``scale`` (fan angles described too small,
        relative), ``step`` (steps between views described too small, relative), ``roll`` in rad,
        ``module`` (columns by which a block of them lies beside its place, of a whole detector;
        see :mod:`torchpcct.checks.modules`, which names it in place of a centre that ``others``
        do not show), ``view_scatter`` (standard deviation of the angles about the described ones,
        in steps; :mod:`torchpcct.checks.view_scatter`), and ``mismatch``: the mean square of the
        difference over that of what changes from view to view, noise taken off, 0 of a sound scan,
        1 of rays that have nothing to do with each other.
        Of several causes the one that explains most is named, and its size measured again where
        nothing is left of it; the others' are of first order. The figure after ± is twice the
        standard error: 95 % of such errors lie within.

    Raises:
        ValueError: a wrong shape, NaN or Inf.
    """
    pairs = RayPairs.of(lines, geometry, window, about)
    if pairs is None:
        return UNKNOWN
    centre, explained = _centre(pairs, FALSE_ALARMS / 3.0)
    sizes, errors = (
        {k: v for k, v in values.items() if k == "centre"}
        for values in (centre.sizes, centre.errors)
    )
    # What is found: how much of the difference it explains, its cause, and the text of a cause
    # without a size.
    ranked = [
        (explained / pairs.here.numel(), "centre" if "rotation centre" in text else "", text)
        for text in centre.findings[:1]
    ]
    # Of a whole cone beam the pairs are those of the plane of the source, which has no rows.
    stack: RayPairs | None = pairs
    if window is None and geometry.has_rows:
        stack = RayPairs.stacked(lines, geometry, window, about)
    causes = [(stack, "roll"), (pairs, "scale"), (pairs, "step")]
    for of, name in causes:
        if of is None or of.pattern(name) is None:
            continue
        tolerance = _tolerance(of, name)
        fits = _fits(of, name, tolerance)
        if not fits:
            continue
        # The wider slopes reach farther, the narrower ones see smaller errors.
        level = FALSE_ALARMS / (3.0 * len(causes) * len(WIDTHS))
        best = next((f for f in reversed(fits) if f.exceeds(level, _LARGEST)), fits[0])
        sizes[name], errors[name] = best.size, best.error
        if best.exceeds(level, _LARGEST):
            ranked.append((best.explained / of.here.numel(), name, ""))
    mismatch, differ = _mismatch(pairs, FALSE_ALARMS / 3.0)
    mirrored = differ > 0 and pairs.agrees_mirrored(min(_DIFFER, mismatch / 4.0))
    explained = max((share for share, *_ in ranked), default=0.0)
    if differ and (mirrored or explained < _EXPLAINED * pairs.disagreement):
        ranked = [(math.inf, "", _mismatch_text(mismatch, differ == 2, mirrored))]
    if math.isfinite(mismatch):
        sizes["mismatch"] = mismatch
    found = []
    if ranked:
        _, name, text = max(ranked)
        if name:

            def described(size: float) -> RayPairs | None:
                if name == "roll":
                    turned = _unrolled(lines, geometry, window, size)
                    make = RayPairs.stacked if window is None else RayPairs.of
                    return make(turned, geometry, window, about)
                return RayPairs.of(lines, _described(geometry, name, size), window, about)

            sizes[name], errors[name] = _measured(name, sizes[name], errors[name], described)
            text = _TEXTS[name](sizes[name], 2.0 * errors[name])
        found.append(text)
    if window is None:
        module = module_test(pairs)
        sizes |= module.sizes
        errors |= module.errors
        if module.findings and (not found or _at_their_places(module)):
            found = [*module.findings]
        scatter = view_scatter_test(pairs)
        sizes |= scatter.sizes
        errors |= scatter.errors
        found = found or [*scatter.findings]
    return ScanTest(sizes, errors, tuple(found))


def _at_their_places(module: ScanTest) -> bool:
    """Whether all columns but those of a displaced module lie where they are described."""
    return abs(module.sizes["others"]) < CENTRE_TOLERANCE + 3.0 * module.errors["others"]


def _measured(
    name: str, size: float, error: float, described: Callable[[float], RayPairs | None]
) -> tuple[float, float]:
    """The size of an error, and its standard error, at which nothing is left of it (Gauss and
    Newton).

    The difference is of first order in the size only near 0.

    Args:
        size, error: of first order.
        described: the readings as they are where an error of that size is taken out of the
            description.
    """
    total = size
    for _ in range(8):
        try:
            pairs = described(total)
        except ValueError:  # no such geometry
            break
        fits = [] if pairs is None else _fits(pairs, name, _tolerance(pairs, name))
        if not fits:
            break
        best = min(fits, key=lambda f: f.error)
        if name in ("scale", "step"):
            total = (1.0 + total) * (1.0 + min(max(best.size, -0.1), 0.1)) - 1.0
        else:
            total += best.size
        if abs(best.size) < 0.1 * best.error:
            return total, best.error
    return size, max(error, abs(size) / 3.0)


def _described(geometry: Any, name: str, size: float) -> Any:
    """The geometry without an error of a size: of the ``centre``, ``scale`` or ``step``."""
    if name == "step":
        turned = unwrapped(geometry.angles)
        return replace(geometry, angles=turned[0] + (1.0 + size) * (turned - turned[0]))
    if name == "centre":
        return geometry.with_column_offset(geometry.column_offset - size * geometry.column_pitch)
    return geometry.scaled(1.0 + size)


def _unrolled(lines: Tensor, geometry: Any, window: DetectorWindow | None, roll: float) -> Tensor:
    """Readings ``(views, rows, columns)`` of a detector that is rolled by an angle in rad,
    between its columns."""
    first = 0 if window is None else window.first_row
    shifts = roll * geometry.row_positions[first : first + lines.shape[1]] / geometry.pitch[1]
    columns = lines.shape[2]
    turned = []
    for row, shift in zip(lines.unbind(1), shifts, strict=True):
        at = np.clip(np.arange(columns) + shift, 0, columns - 1)
        low = np.minimum(at.astype(int), max(columns - 2, 0))
        turned.append(
            torch.lerp(
                row[:, low],
                row[:, np.minimum(low + 1, columns - 1)],
                torch.from_numpy(at - low).to(row),
            )
        )
    return torch.stack(turned, 1)


def _centre_text(size: float, error: float) -> str:
    return (
        f"conjugate rays disagree: the geometry puts the columns about {abs(size):.2f} ± "
        f"{error:.2g} columns too {'high' if size > 0 else 'low'}: the rotation centre (the "
        "detector's column offset) is wrong, or the object moved. torchpcct calibrate finds it"
    )


def _scale_text(size: float, error: float) -> str:
    small, pitch, sdd = (
        ("small", "larger", "smaller") if size > 0 else ("large", "smaller", "larger")
    )
    return (
        f"conjugate rays disagree: the fan angles are described about {100 * abs(size):.2g} ± "
        f"{100 * error:.1g} % too {small}: the column pitch is {pitch} than described, the "
        f"distance source-detector (sdd) {sdd}, or the detector is not flat or curved as "
        "described; sizes and values in the volume are wrong by as much"
    )


def _step_text(size: float, error: float) -> str:
    return (
        "conjugate rays disagree: the steps between the views are described about "
        f"{100 * abs(size):.2g} ± {100 * error:.1g} % too {'small' if size > 0 else 'large'}: the "
        "range of the angles is wrong (a full turn?), or views are missing"
    )


def _roll_text(size: float, error: float) -> str:
    return (
        "conjugate rays disagree, in higher rows the other way than in lower ones: the detector is "
        f"rolled by about {math.degrees(abs(size)):.2g} ± {math.degrees(error):.1g}° against the "
        "rotation axis. torchpcct calibrate finds it"
    )


_TEXTS = {"centre": _centre_text, "scale": _scale_text, "step": _step_text, "roll": _roll_text}
"""Text of each error of a geometry."""


def _mismatch_text(mismatch: float, strangers: bool, mirrored: bool) -> str:
    share = f"{100 * math.sqrt(mismatch):.0f} % of what changes from view to view"
    if mirrored:
        return (
            f"conjugate rays disagree by {share}, but not with the columns counted the other way: "
            "reverse the columns, or the sign of the angles"
        )
    if strangers:
        return (
            f"conjugate rays have little in common (they disagree by {share}): the angles of the "
            "views (sign, range, order), the order of the columns or the axes of the data are wrong"
        )
    return (
        f"conjugate rays disagree by {share}: the object moved, or the order or the angles of "
        "some views are wrong"
    )


def _centre(pairs: RayPairs, false_alarms: float) -> tuple[ScanTest, float]:
    """The centre's test, and how much of the squared difference its error explains."""
    found = []
    for columns in WIDTHS:
        sums = pairs.sums(pairs.shifted(), columns)
        if sums is not None:
            turn = 2.0 * pairs.angles
            turning = [sums[1] * wave(turn) for wave in (np.cos, np.sin)]
            score, power, bent, *waves = _blocks(np.stack([*sums, *turning]), pairs.used(columns))
            if power.sum() > 0:
                design = np.stack([power, *waves], 1)
                size = float(score.sum() / power.sum())
                stray = _Stray(
                    pairs.aligned("centre"), pairs.shared_error(pairs.shifted(), columns, size)
                )
                test = _tested(score, bent, design, false_alarms / len(WIDTHS), stray)
                found.append((test, test.sizes["centre"] ** 2 * float(power.sum())))
    return next((f for f in found if f[0].findings), found[0] if found else (UNKNOWN, 0.0))


@dataclass(frozen=True)
class _Stray:
    """What is no error of the description and may look like one: squared difference of rays that
    part or are blurred, and the standard error of the scores by what all views share."""

    parted: float
    shared: float


@dataclass(frozen=True)
class _Fit:
    """Size of one cause, its standard error, p-value against the tolerance, and the squared
    difference explained."""

    size: float
    error: float
    p_value: float
    explained: float

    def exceeds(self, level: float, most: float = math.inf) -> bool:
        return self.p_value < level and abs(self.size) < most


def _tolerance(pairs: RayPairs, name: str) -> float:
    """The size of a cause that is no finding."""
    if name == "roll":
        return CENTRE_TOLERANCE / float(pairs.heights().max())
    return {"centre": CENTRE_TOLERANCE, "scale": SCALE_TOLERANCE, "step": STEP_TOLERANCE}[name]


def _blocks(values: Floats, used: NDArray[np.int64]) -> Floats:
    """Sums of ``(..., views)`` over equal parts of the views that are used, ``(..., BLOCKS)``; the
    first parts hold one more where they are not equal."""
    kept = values.take(used, -1)
    part, more = divmod(used.size, BLOCKS)
    ends = np.arange(1, BLOCKS + 1) * part + np.minimum(np.arange(1, BLOCKS + 1), more)
    first = [0, *ends[:-1].tolist()]
    parts = [kept[..., a:b] for a, b in zip(first, ends.tolist(), strict=True)]
    return np.stack([np.add.reduce(part, axis=-1) for part in parts], -1)


def _spread(blocks: Floats) -> float:
    """Standard error of the sum of blocks, from their scatter."""
    return max(float(blocks.std(ddof=1)) * math.sqrt(blocks.size), float(np.finfo(np.float64).tiny))


def _above(blocks: Floats) -> float:
    """Student's p-value of blocks whose sum should be 0 or less."""
    return _student(float(blocks.sum()) / _spread(blocks), blocks.size - 1)


def _student(statistic: float, freedom: float) -> float:
    """Student's p-value of one side."""
    from scipy import special  # loads with its first use

    return float(special.stdtr(freedom, -statistic))


def _fitted(score: Floats, power: Floats, bent: Floats, tolerance: float, stray: _Stray) -> _Fit:
    """Regression of the blocks' scores on their powers, and Student's test of a size beyond the
    tolerance.

    The scatter is that of sizes without one block each (the jackknife; MacKinnon and White 1985, J.
    Econometrics 29:305), its degrees of freedom those of as many equal blocks as the powers are
    worth (Satterthwaite 1946, Biometrics Bull. 2:110): an edge may be seen by few views.

    Args:
        bent: part of the scores that second order has taken off; half of it may be left.
        stray: what may look like the cause and is none.
    """
    from scipy import special  # loads with its first use

    total = float(power.sum())
    size, share = float(score.sum()) / total, power / total
    left = (score - size * power) / (total * np.maximum(np.abs(1.0 - share), 1e-3))
    noise = max(
        float(np.sqrt(np.square(left).sum())),
        stray.shared / total,
        float(np.finfo(np.float64).tiny),
    )
    freedom = 1.0 / float(np.square(share).sum()) - 1.0
    unknown = 0.5 * abs(float(bent.sum())) / total + math.sqrt(stray.parted / total)
    beyond = abs(size) - tolerance - unknown
    p_value = 2.0 * _student(beyond / noise, freedom) if freedom > 0 and beyond > 0 else 1.0
    usual = float(special.stdtrit(max(freedom, 1.0), 0.975) / special.ndtri(0.975))
    error = math.sqrt((usual * noise) ** 2 + (unknown / 2.0) ** 2 + (_KNOWN * tolerance) ** 2)
    return _Fit(size, error, min(p_value, 1.0), size**2 * total)


def _fit(pairs: RayPairs, name: str, columns: int, tolerance: float) -> _Fit | None:
    """The size of one cause, by slopes over so many columns."""
    pattern = pairs.pattern(name)
    sums = None if pattern is None else pairs.sums(pattern, columns)
    if pattern is None or sums is None:
        return None
    score, power, bent = _blocks(np.stack(sums), pairs.used(columns))
    if power.sum() <= 0:
        return None
    shared = pairs.shared_error(pattern, columns, float(score.sum() / power.sum()))
    return _fitted(score, power, bent, tolerance, _Stray(pairs.aligned(name), shared))


def _fits(pairs: RayPairs, name: str, tolerance: float) -> list[_Fit]:
    """By narrow slopes and by wide ones; those that there are."""
    tried = (_fit(pairs, name, columns, tolerance) for columns in WIDTHS)
    return [fit for fit in tried if fit is not None]


def _mismatch(pairs: RayPairs, false_alarms: float) -> tuple[float, int]:
    """Share of the difference in what changes from view to view, and whether it is 1: too large,
    2: nearly all."""
    used = np.flatnonzero(pairs.known.flatten(1).any(1).numpy())
    if used.size < BLOCKS:
        return math.nan, 0
    between = pairs.between_views
    seen = pairs.known.float().sum(0).clamp_min(1.0)

    def change(v: Tensor) -> Tensor:
        return v - torch.where(pairs.known, v, 0.0).sum(0) / seen

    changing = [change(pairs.here), change(pairs.conjugate)]
    # Columns at other places sample a thin wall otherwise: of what is round about the axis all
    # views do so alike, and nothing of the object tells them apart.
    compared = (pairs.difference, change(pairs.difference), between, *changing)
    different, apart, stray, *changed = _blocks(
        np.stack([product(v, pairs.known) for v in compared]), used
    )
    signal = changed[0] + changed[1]
    if signal.sum() <= 0:
        return math.nan, 0
    share = float(different.sum() / signal.sum())
    # What interpolation between views leaves is no finding: a view from its neighbours is off by
    # more than that.
    sampled = float(stray.sum() / signal.sum())

    def beyond(value: Floats, limit: float) -> bool:
        return _above(value - limit * signal - pairs.parted / signal.size) < false_alarms / 3

    grade = sum(
        all(beyond(value, max(limit, 2.0 * sampled)) for value in (different, apart))
        for limit in (_DIFFER, _STRANGERS)
    )
    # Views that their neighbours do not foretell, in steps that they should: out of order.
    if not grade and view_step(pairs.rays.geometry.angles) < _FINE_STEP_RAD:
        grade = 2 * (beyond(different, _STRANGERS) and beyond(stray, _STRANGERS))
    return max(share, 0.0), grade


def _tested(
    score: Floats, bent: Floats, design: Floats, false_alarms: float, stray: _Stray
) -> ScanTest:
    power = design[:, 0]
    fit = _fitted(score, power, bent, CENTRE_TOLERANCE, stray)
    # A wave has half the square of its amplitude.
    amplitude = math.sqrt(2.0 * stray.parted / float(power.sum()))
    swing, swinging = _swing(score, bent, design, amplitude)
    findings = []
    if fit.exceeds(false_alarms / 2):
        findings.append(_centre_text(fit.size, 2.0 * fit.error))
    if swinging < false_alarms / 2:
        findings.append(
            f"conjugate rays disagree by {swing:.2f} columns to either side in the course of a "
            "turn: the object moved, or the angles of the views are wrong"
        )
    sizes = {"centre": fit.size} | ({} if math.isnan(swing) else {"swing": swing})
    return ScanTest(sizes, {"centre": fit.error}, tuple(findings))


def _swing(score: Floats, bent: Floats, waves: Floats, parted: float) -> tuple[float, float]:
    """Amplitude of the second and third of ``waves`` ``(blocks, 3)`` in the scores, and its
    p-value.

    Where a few blocks hold most of what is seen, theirs is what noise leaves: the likelier of the
    usual covariance and that of the jackknife (MacKinnon and White 1985, J. Econometrics 29:305).

    Args:
        bent: see :func:`_fitted`.
        parted: amplitude that may be none.
    """
    from scipy import special  # loads with its first use

    scale = np.abs(waves[:, :1]).mean()
    design, y = waves / scale, score / scale
    if np.linalg.cond(design) > 20.0:
        return math.nan, 1.0  # a part of the turn: the wave is not distinguished from the constant
    inverse = np.linalg.inv(design.T @ design)
    found, left = (inverse @ (design.T @ values) for values in (y, 0.5 * bent / scale))
    count = y.size - 3
    freedom = 1.0 / float(np.square(waves[:, 0] / waves[:, 0].sum()).sum()) - 3.0
    residuals = y - design @ found
    usual = max(float(residuals @ residuals) / count, np.finfo(np.float64).tiny) * inverse
    own = np.einsum("ij,jk,ik->i", design, inverse, design)
    without = residuals / np.maximum(1.0 - own, 1e-3)
    jackknife = inverse @ ((design * without[:, None] ** 2).T @ design) @ inverse
    amplitude = float(np.hypot(*found[1:]))
    tolerance = CENTRE_TOLERANCE + float(np.hypot(*left[1:])) + parted
    if amplitude <= tolerance or freedom <= 0.0:
        return amplitude, 1.0
    rest = found[1:] * (1.0 - tolerance / amplitude)
    statistic = min(
        rest @ np.linalg.solve(covariance[1:, 1:], rest) / 2.0 for covariance in (usual, jackknife)
    )
    return amplitude, float(special.fdtrc(2, freedom, statistic))
