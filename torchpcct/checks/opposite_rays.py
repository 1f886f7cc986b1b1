"""Does a full turn agree with itself? Opposite rays see one line, so a wrong description shows without an image.

The ray of source angle β and fan angle γ is met again by that of β + π − 2γ and −γ (the consistency condition behind
the moments of Helgason and Ludwig). Read there D(β + a, γ + e) instead of D(β, γ), the difference is, to first order,

    r = −a ∂D/∂β − e ∂D/∂γ + noise,

and each error of the description has its own a and e:

* columns described ε above where they are: e = −2ε (of a detector rolled by θ ε = θ v changes with the row's height v);
* fan angles (pitch over sdd) too small by the factor 1 + κ: a = 2κγ, nothing in the middle, most at the edges;
* steps between the views too small by the factor 1 + s: a = s (β' − β), β' the described angle of the opposite ray.

r is regressed on each pattern. The slopes of the two rays have independent noise, so the product of one's, smoothed,
and the other's, raw, neither shrinks nor stretches the estimate (instrumental variables, Durbin 1954, Rev. Int. Stat.
Inst. 22:23). Its error is that of the sums over blocks of views, which knows nothing of how noisy a reading is: the
test statistic is Student's. The cause that explains most of r is named. Where none does, the share of r in what changes
from view to view says whether the rays have anything in common; products of neighbouring columns are free of noise.

An object that moves during the turn stands elsewhere when the opposite ray comes: ε then changes with β. Of a movement
c(β) along the columns, opposite rays show c(β) + c(β + π), so once in a turn looks like an object that stands elsewhere
and is none of our business; twice in a turn is what is tested, a wave cos 2β, sin 2β of ε.

What no opposite rays can show, since the described scan is that of another object, a right one: the angle of the first
view (the object turned), sod (the object scaled, its attenuation the other way; so are parallel rays' pitch), both the
direction of rotation and that of the columns (the object mirrored; of parallel rays each alone), a displacement of the
object, and all that happens to both rays alike: water's attenuation, gain and bowtie if air was measured with them,
spectrum and pile-up (:mod:`torchpcct.checks.moments` sees those in bodies that are not round).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from torchpcct.checks.orbit_plane import PARTED, orbit_plane, shared_square
from torchpcct.detector_window import DetectorWindow
from torchpcct.geometry import ConeBeam, Geometry, ParallelBeam, view_step
from torchpcct.validate import checked

__all__ = ["CENTRE_TOLERANCE", "UNKNOWN", "OppositeRays", "ScanTest", "centre_test", "check_lines", "geometry_test"]

CENTRE_TOLERANCE = 0.1
"""Error of the centre in columns that is no finding: alignment, and what interpolation between the views leaves."""
SCALE_TOLERANCE, STEP_TOLERANCE = 0.003, 0.001
"""Relative errors of the fan angles and of the steps between views that are none: what mechanics leave."""
FALSE_ALARMS = 0.005
"""Share of scans with an error of :data:`CENTRE_TOLERANCE` that are taken for wrong; of faultless ones it is less."""
_BLOCKS = 24
# Readings whose opposites are looked up; more only cost time.
_MOST = 500_000
# Views beside an opposite angle that are farther apart than so many usual steps do not stand for it.
_GAP_STEPS = 3.0
_ROWS, _COLUMNS = 9, (5, 25)
"""Readings over which the slope is smoothed: a few columns for small errors, many for those of several columns."""
_DIFFER, _STRANGERS = 0.03, 0.3
"""Mean square of the difference over that of what changes from view to view: from the first one opposite rays differ,
from the second one they have nothing to do with each other."""
_FLAT_CELLS = 2.0
"""Rows count whose opposite rays part by less, along z."""
_INTERPOLATED = 0.5
"""What a cause explains at least, of what interpolation leaves: a sound scan of few readings 0.2, errors of 1 % 1.3."""
_ALIGNED = {"centre": 0.05, "step": 0.08, "scale": 0.25}
"""Share of what rays may part by that looks like a cause, where no row tells how much that is: of 45 sound scans of two
or three rows without noise 0.035, 0.042 and 0.13 at most."""
_EXPLAINED = 0.1
"""Share of the difference that a cause must explain to be named where opposite rays have little in common."""
_LARGEST = 0.3
"""Relative errors and angles in rad beyond which nothing is linear: no cause is named for what is larger."""
_FINE_STEP_RAD = math.radians(2.5)
_REBINNED = 15.0
"""Factor on the tolerances of readings that are interpolated from another orbit."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ScanTest:
    """What a test of a scan found.

    Attributes:
        sizes: cause → its estimated size, if it were the only one; causes that this scan cannot show are missing.
        errors: cause → standard error of its size, where there is one.
        findings: what was found, in words; empty: nothing at the stated rate of false alarms.
    """

    sizes: Mapping[str, float]
    errors: Mapping[str, float]
    findings: tuple[str, ...]


UNKNOWN = ScanTest({}, {}, ())
"""Of a scan in which nothing is to be seen."""


@checked
def centre_test(
    lines: Tensor,
    geometry: Geometry,
    window: DetectorWindow | None = None,
    about: tuple[float, float] = (0.0, 0.0),
) -> ScanTest:
    """Measure the rotation centre by the opposite rays of a scan, of a cone beam by those near the plane of the source.

    Args:
        lines: line integrals ``(views, [rows,] columns)`` of any unit, on ``window``, what all views share taken off.
            Views in any order.
        geometry: parallel, fan or cone beam.
        window: of the readings; None: the whole detector.
        about: (y, x) in mm of what the readings show: views are interpolated along its path.

    Returns:
        The test of ``centre``: how many columns too high the described positions of the columns are; and of ``swing``,
        the amplitude in columns by which it changes twice in a turn. :data:`UNKNOWN` where no opposite rays were
        measured or nothing is to be seen.

    Raises:
        ValueError: a wrong shape, NaN or Inf.
    """
    pairs = _Pairs.of(lines, geometry, window, about)
    return UNKNOWN if pairs is None else _centre(pairs, FALSE_ALARMS)[0]


@checked
def geometry_test(
    lines: Tensor,
    geometry: Geometry,
    window: DetectorWindow | None = None,
    about: tuple[float, float] = (0.0, 0.0),
    rebinned: bool = False,
) -> ScanTest:
    """Test the description of a scan by its opposite rays: centre, fan angles, steps between views, roll.

    Args:
        lines, geometry, window, about: see :func:`centre_test`.
        rebinned: the readings are interpolated from another orbit, so causes beside the centre must be larger to be
            told (:data:`_REBINNED`).

    Returns:
        The test of ``centre`` (see :func:`centre_test`), ``scale`` (fan angles described too small, relative), ``step``
        (steps between views described too small, relative), ``roll`` in rad, and ``mismatch``: the mean square of the
        difference over that of what changes from view to view, noise taken off, 0 of a sound scan, 1 of rays that have
        nothing to do with each other. Of several causes the one that explains most is named, and its size measured
        again where nothing is left of it; the others' are of first order. What is said after ± is twice the standard
        error: 95 % of such errors lie within.

    Raises:
        ValueError: a wrong shape, NaN or Inf.
    """
    pairs = _Pairs.of(lines, geometry, window, about)
    if pairs is None:
        return UNKNOWN
    centre, explained = _centre(pairs, FALSE_ALARMS / 3.0)
    sizes, errors = ({k: v for k, v in values.items() if k == "centre"} for values in (centre.sizes, centre.errors))
    # What is found: how much of the difference it explains, its cause, and what is said of a cause without a size.
    ranked = [
        (explained / pairs.here.numel(), "centre" if "rotation centre" in text else "", text)
        for text in centre.findings[:1]
    ]
    stack = _Pairs.stacked(lines, geometry, window, about) if window is None else pairs
    causes = [(stack, "roll"), (pairs, "scale"), (pairs, "step")]
    for of, name in causes:
        cause = None if of is None else of.cause(name)
        if of is None or cause is None:
            continue
        tolerance = cause[1] * (_REBINNED if rebinned else 1.0)
        tried = [of.fit(name, columns, tolerance) for columns in _COLUMNS]
        fits = [f for f in tried if f is not None]
        if not fits:
            continue
        # The wider slopes reach farther, the narrower ones see smaller errors.
        level = FALSE_ALARMS / (3.0 * len(causes) * len(_COLUMNS))
        best = next((f for f in reversed(fits) if f.found(level, tolerance, _LARGEST)), fits[0])
        sizes[name], errors[name] = best.size, best.error
        if best.found(level, tolerance, _LARGEST) and best.explained > of.unexplained(name):
            ranked.append((best.explained / of.here.numel(), name, ""))
    mismatch, differ = pairs.mismatch(FALSE_ALARMS / 3.0)
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

            def described(size: float) -> _Pairs | None:
                if name == "roll":
                    turned = _unrolled(lines, geometry, window, size)
                    make = _Pairs.stacked if window is None else _Pairs.of
                    return make(turned, geometry, window, about)
                return _Pairs.of(lines, _described(geometry, name, size), window, about)

            sizes[name], errors[name] = _measured(name, sizes[name], errors[name], described)
            text = _TEXTS[name](sizes[name], 2.0 * errors[name])
        found.append(text)
    return ScanTest(sizes, errors, tuple(found))


def _measured(name: str, size: float, error: float, described: Callable[[float], _Pairs | None]) -> tuple[float, float]:
    """The size of an error, and its standard error, at which nothing is left of it (Gauss and Newton).

    The difference is of first order in the size only near 0.

    Args:
        size, error: of first order.
        described: the readings as they are where an error of that size is taken out of the description.
    """
    total = size
    for _ in range(8):
        try:
            pairs = described(total)
        except ValueError:  # no such geometry
            break
        fits = [] if pairs is None else [f for f in (pairs.fit(name, columns) for columns in _COLUMNS) if f is not None]
        if not fits:
            break
        best = min(fits, key=lambda f: f.error)
        if name in ("scale", "step"):
            total = (1.0 + total) * (1.0 + min(max(best.size, -0.1), 0.1)) - 1.0
        else:
            total += best.size
        if abs(best.size) < 0.2 * best.error:
            return total, best.error
    return size, max(error, abs(size) / 3.0)


def _described(geometry: Any, name: str, size: float) -> Any:
    """The geometry without an error of a size: of the ``centre``, ``scale`` or ``step``."""
    if name == "step":
        first = geometry.angles[0]
        return replace(geometry, angles=first + (1.0 + size) * (geometry.angles - first))
    cone = isinstance(geometry, ConeBeam)
    pitch, offset = (geometry.pitch[1], geometry.offset[1]) if cone else (geometry.pitch, geometry.offset)
    if name == "centre":
        offset = offset - size * pitch
    else:
        pitch, offset = (1.0 + size) * pitch, (1.0 + size) * offset
    if cone:
        return replace(geometry, pitch=(geometry.pitch[0], pitch), offset=(geometry.offset[0], offset))
    return replace(geometry, pitch=pitch, offset=offset)


def _unrolled(lines: Tensor, geometry: Any, window: DetectorWindow | None, roll: float) -> Tensor:
    """Readings ``(views, rows, columns)`` of a detector that is rolled by an angle in rad, between its columns."""
    first = 0 if window is None else window.first_row
    shifts = roll * geometry.row_positions[first : first + lines.shape[1]] / geometry.pitch[1]
    columns = lines.shape[2]
    turned = []
    for row, shift in zip(lines.unbind(1), shifts, strict=True):
        at = np.clip(np.arange(columns) + shift, 0, columns - 1)
        low = np.minimum(at.astype(int), max(columns - 2, 0))
        turned.append(
            torch.lerp(row[:, low], row[:, np.minimum(low + 1, columns - 1)], torch.from_numpy(at - low).to(row))
        )
    return torch.stack(turned, 1)


def _centre_text(size: float, error: float) -> str:
    return (
        f"opposite rays disagree: the geometry puts the columns about {abs(size):.2f} ± {error:.2g} columns too "
        f"{'high' if size > 0 else 'low'}: the rotation centre (the detector's column offset) is wrong, or the object "
        "moved"
    )


def _scale_text(size: float, error: float) -> str:
    small, pitch, sdd = ("small", "larger", "smaller") if size > 0 else ("large", "smaller", "larger")
    return (
        f"opposite rays disagree: the fan angles are described about {100 * abs(size):.2g} ± {100 * error:.1g} % too "
        f"{small}: the column pitch is {pitch} than described, the distance source-detector (sdd) {sdd}, or the "
        "detector is not flat or curved as described; sizes and values in the volume are wrong by as much"
    )


def _step_text(size: float, error: float) -> str:
    return (
        f"opposite rays disagree: the steps between the views are described about {100 * abs(size):.2g} ± "
        f"{100 * error:.1g} % too {'small' if size > 0 else 'large'}: the range of the angles is wrong (a full turn?), "
        "or views are missing"
    )


def _roll_text(size: float, error: float) -> str:
    return (
        f"opposite rays disagree, in higher rows the other way than in lower ones: the detector is rolled by about "
        f"{math.degrees(abs(size)):.2g} ± {math.degrees(error):.1g}° against the rotation axis"
    )


_TEXTS = {"centre": _centre_text, "scale": _scale_text, "step": _step_text, "roll": _roll_text}


def _mismatch_text(mismatch: float, strangers: bool, mirrored: bool) -> str:
    share = f"{100 * math.sqrt(mismatch):.0f} % of what changes from view to view"
    if mirrored:
        return (
            f"opposite rays disagree by {share}, but not with the columns counted the other way: reverse the columns, "
            "or the sign of the angles"
        )
    if strangers:
        return (
            f"opposite rays have little in common (they disagree by {share}): the angles of the views (sign, range, "
            "order), the order of the columns or the axes of the data are wrong"
        )
    return f"opposite rays disagree by {share}: the object moved, or the order or the angles of some views are wrong"


def _centre(pairs: _Pairs, false_alarms: float) -> tuple[ScanTest, float]:
    """The centre's test, and how much of the squared difference its error explains."""
    found = []
    for columns in _COLUMNS:
        sums = pairs.sums(pairs.centre(), columns)
        if sums is not None:
            score, power = sums
            turn = 2.0 * pairs.angles
            waves = [_blocks(power * wave(turn), pairs.used(columns)) for wave in (np.cos, np.sin)]
            score, power = (_blocks(v, pairs.used(columns)) for v in sums)
            design = np.stack([power, *waves], 1)
            test = _tested(score, power, design, false_alarms / len(_COLUMNS), pairs)
            found.append((test, test.sizes.get("centre", 0.0) ** 2 * float(power.sum())))
    return next((f for f in found if f[0].findings), found[0] if found else (UNKNOWN, 0.0))


@dataclass(frozen=True)
class _Fit:
    """Size of one cause, its standard error, p-value against the tolerance, and the squared difference explained.

    ``noise`` is the part of the error that noise has.
    """

    size: float
    error: float
    p_value: float
    explained: float
    noise: float

    def found(self, level: float, tolerance: float, most: float = math.inf) -> bool:
        # Where nearly nothing is to be seen the slopes' product is noise, and the size anything.
        return self.p_value < level and max(tolerance, 2.0 * self.noise) < abs(self.size) < most


def _blocks(values: Floats, used: NDArray[np.int64]) -> Floats:
    return np.array([values[b].sum() for b in np.array_split(used, _BLOCKS)])


def _spread(blocks: Floats) -> float:
    """Standard error of the sum of blocks, from their scatter."""
    return max(float(blocks.std(ddof=1)) * math.sqrt(blocks.size), float(np.finfo(np.float64).tiny))


def _above(blocks: Floats) -> float:
    """Student's p-value of blocks whose sum should be 0 or less."""
    from scipy import stats

    return float(stats.t.sf(float(blocks.sum()) / _spread(blocks), blocks.size - 1))


def _fitted(score: Floats, power: Floats, tolerance: float, stray: float) -> _Fit:
    """Regression of the blocks' scores on their powers, and Student's test of a size beyond ``tolerance``.

    ``stray``: square of the difference that is neither noise nor the cause's, and pulls the size aside.
    """
    total = float(power.sum())
    size = float(score.sum()) / total
    beyond = math.copysign(1.0, size) * (score - math.copysign(tolerance, size) * power)
    noise = _spread(score - size * power) / total
    error = math.hypot(noise, math.sqrt(stray / max(total, 1e-300)))
    return _Fit(size, error, min(1.0, 2.0 * _above(beyond)), size**2 * total, noise)


Pattern = tuple[Tensor, str]
"""Factor of the slope, and which slope: along the ``"columns"`` or the ``"angles"``."""


class _Pairs:
    """Readings, those of their opposite rays, and the slopes of both."""

    def __init__(self, rays: OppositeRays, values: Tensor, parted: float = 0.0, *, guarded: bool = True) -> None:
        self.rays, self._values = rays, values
        angles = rays.geometry.angles
        self._order = np.argsort(angles % (2 * math.pi), kind="stable")
        self._at = np.arange(0, angles.size, max(1, math.ceil(values.numel() / _MOST)))
        self.base = self._order[self._at]
        self.angles = angles[self.base]
        self.here, self.opposite, self.known = self._look(self.base)
        self.difference = self.here - self.opposite
        self.parted, self._guarded = parted * float(self.known.sum()), guarded
        self._slopes: dict[tuple[str, int], tuple[Any, ...]] = {}
        self._whole: dict[int, Tensor] = {}
        self._beside: Any = None

    @classmethod
    def of(
        cls, lines: Tensor, geometry: Geometry, window: DetectorWindow | None, about: tuple[float, float]
    ) -> _Pairs | None:
        """Of a whole cone beam the plane of the source; None where no row lies near it."""
        if window is not None or not isinstance(geometry, ConeBeam):
            return cls.stacked(lines, geometry, window, about)
        _check(lines, geometry, DetectorWindow.full(geometry))
        plane = orbit_plane(lines.detach().to("cpu", torch.float32), geometry)
        if plane is None:
            return None
        fan = geometry.central_fan
        return cls(OppositeRays(fan, DetectorWindow.full(fan), about), plane.lines, plane.parted, guarded=plane.guarded)

    @classmethod
    def stacked(
        cls, lines: Tensor, geometry: Geometry, window: DetectorWindow | None, about: tuple[float, float]
    ) -> _Pairs | None:
        """Of a cone beam the rows near the plane of the source, each with its own; None where there is none."""
        window = DetectorWindow.full(geometry) if window is None else window
        _check(lines, geometry, window)
        values = lines.detach().to("cpu", torch.float32).reshape(window.shape)
        parted = 0.0
        if isinstance(geometry, ConeBeam):
            window, values = _flat_part(geometry, window, values)
            if not values.shape[1]:
                return None
            parted = _parted(geometry, window, values, about)
            geometry, window, values = _joined_rows(geometry, window, values)
        return cls(OppositeRays(geometry, window, about), values, parted)

    def _look(self, views: NDArray[np.int64]) -> tuple[Tensor, Tensor, Tensor]:
        return self._values[torch.from_numpy(views)], *self.rays.opposite(self._values, views)

    def centre(self) -> Pattern:
        return torch.full((1,), 2.0), "columns"

    def cause(self, name: str) -> tuple[Pattern, float] | None:
        """Pattern and tolerance of one cause; None: the scan cannot show it."""
        g, w = self.rays.geometry, self.rays.window
        if name == "centre":
            return self.centre(), CENTRE_TOLERANCE
        if name == "roll":
            if not isinstance(g, ConeBeam) or w.rows < 3:
                return None
            height = g.row_positions[w.first_row : w.first_row + w.rows]
            height = torch.from_numpy(height - height.mean())[:, None].float() / g.pitch[1]
            return (2.0 * height, "columns"), CENTRE_TOLERANCE / float(height.max())
        gamma = self.rays.fan_angles(self.base)
        if name == "scale":
            factor, tolerance = 2.0 * gamma, SCALE_TOLERANCE
        else:
            turn = self.angles[:, None] % (2 * math.pi)
            across = (turn + math.pi - (0.0 if self.rays.parallel else 2.0) * gamma) % (2 * math.pi)
            factor, tolerance = across - turn + 0.0 * gamma, STEP_TOLERANCE
        if name == "scale" and self.rays.parallel:
            return None
        return (torch.from_numpy(factor)[:, None].float(), "angles"), tolerance

    def whole(self, columns: int) -> Tensor:
        """A slope reaches over neighbours: all of them must have an opposite."""
        if columns not in self._whole:
            known = -self.known.float()[:, None]
            self._whole[columns] = -F.max_pool2d(known, (1, 2 * columns + 1), 1, (0, columns))[:, 0] > 0.5
        return self._whole[columns]

    def used(self, columns: int) -> NDArray[np.int64]:
        return np.flatnonzero(self.whole(columns).flatten(1).any(1).numpy())

    def slopes(self, along: str, columns: int) -> tuple[Any, ...]:
        """Smoothed slopes of both rays, raw ones of both, and where they are known."""
        if (along, columns) not in self._slopes:
            pairs = [
                [_slope(v, *size) for v in (self.here, self.opposite)] for size in ((_ROWS, columns), (1, columns // 5))
            ]
            known = self.whole(columns)
            if along == "angles":
                (before, behind), step, rate = self.beside()
                for size, slopes in zip(((_ROWS, columns), (1, columns // 5)), pairs, strict=True):
                    for k, slope in enumerate(slopes):
                        turned = _smooth(behind[k] - before[k], *size) / step
                        slopes[k] = turned - rate * slope
                known = known & before[2] & behind[2]
            self._slopes[along, columns] = (*pairs, known)
        return self._slopes[along, columns]

    def beside(self) -> Any:
        """The views before and behind, the angle between them, and the columns that a window moves per rad."""
        if self._beside is None:
            n, turn = self._order.size, self.rays.geometry.angles % (2 * math.pi)
            ends = [self._order[(self._at + k) % n] for k in (-1, 1)]
            step = (turn[ends[1]] - turn[ends[0]]) % (2 * math.pi)
            good = (step > 1e-9) & (step <= 2.0 * _GAP_STEPS * view_step(self.rays.geometry.angles))
            step = np.where(good, step, 1.0)
            first = self.rays.window.first_column
            rate = (first[ends[1]] - first[ends[0]]) / step
            looked = [self._look(e) for e in ends]
            mask = torch.from_numpy(good)[:, None, None]
            sides = [(*part[:2], part[2] & mask) for part in looked]
            self._beside = sides, *(torch.from_numpy(v)[:, None, None].float() for v in (step, rate))
        return self._beside

    def sums(self, pattern: Pattern, columns: int) -> tuple[Floats, Floats] | None:
        """Score and power of a pattern in every view; None: too few views."""
        if self.used(columns).size < _BLOCKS:
            return None
        factor, along = pattern
        smooth, raw, known = self.slopes(along, columns)
        score = -self.difference * factor * (smooth[0] + smooth[1]) / 2
        power = factor.square() * (smooth[0] * raw[1] + smooth[1] * raw[0]) / 2
        score, power = (torch.where(known, v, 0.0).double().sum((1, 2)).numpy() for v in (score, power))
        return score, power

    def fit(self, name: str, columns: int, tolerance: float = 0.0) -> _Fit | None:
        """The size of one cause, by slopes over so many columns."""
        cause = self.cause(name)
        sums = None if cause is None else self.sums(cause[0], columns)
        if sums is None:
            return None
        score, power = (_blocks(v, self.used(columns)) for v in sums)
        return _fitted(score, power, tolerance, self.stray(name)) if power.sum() > 0 else None

    def _between_views(self) -> Tensor:
        """How far readings lie from the mean of those in the views before and behind."""
        (before, behind), *_ = self.beside()
        difference: Tensor = self.here - (before[0] + behind[0]) / 2
        return difference

    @cached_property
    def interpolated(self) -> float:
        """What linear interpolation between views and columns leaves of a difference, summed squares, noise taken off.

        The second difference is eight times the error in the middle between two readings, 120 times its mean square.
        """
        n = self._order.size
        bend = self.here[..., 2:] - 2.0 * self.here[..., 1:-1] + self.here[..., :-2]
        beside = self._values[torch.from_numpy(self._order[(self._at + 1) % n])]
        other = beside[..., 2:] - 2.0 * beside[..., 1:-1] + beside[..., :-2]
        along = float(torch.where(self.known[..., 1:-1], bend * other, 0.0).double().sum())
        turned = 4.0 * float(_product(self._between_views(), self.known).sum())
        return max(along, 0.0) / 120.0 + max(turned, 0.0) / 120.0

    def aligned(self, name: str) -> float:
        """Of the squared difference that rays part by, what may look like one cause.

        What rows show bounds it. Where no row tells where the object ends, all of it may end there, and that bound is
        worth little: of what it allows at most so much looked like the cause in sound scans drawn at random.
        """
        return self.parted * (1.0 if self._guarded else _ALIGNED.get(name, 1.0))

    def unexplained(self, name: str) -> float:
        """Of the squared difference, what a cause must explain more than to be one."""
        return _INTERPOLATED * self.interpolated + self.aligned(name)

    def stray(self, name: str) -> float:
        """Of the squared difference, what pulls a size aside, as a variance: little of it looks like a cause."""
        return self.aligned(name) / 4.0 + self.interpolated / 16.0

    @property
    def disagreement(self) -> float:
        """Mean square of the difference, noise taken off."""
        return float(_product(self.difference, self.known).sum()) / self.here.numel()

    def mismatch(self, false_alarms: float) -> tuple[float, int]:
        """Share of the difference in what changes from view to view, and whether it is 1: too large, 2: nearly all."""
        used = np.flatnonzero(self.known.flatten(1).any(1).numpy())
        if used.size < _BLOCKS:
            return math.nan, 0
        between = self._between_views()
        seen = self.known.float().sum(0).clamp_min(1.0)

        def change(v: Tensor) -> Tensor:
            return v - torch.where(self.known, v, 0.0).sum(0) / seen

        different, stray, *changing = (
            _blocks(_product(v, self.known), used)
            for v in (self.difference, between, change(self.here), change(self.opposite))
        )
        signal = changing[0] + changing[1]
        if signal.sum() <= 0:
            return math.nan, 0
        share = float(different.sum() / signal.sum())
        # What interpolation between views leaves is no finding: a view from its neighbours is off by more than that.
        sampled = float(stray.sum() / signal.sum())

        def beyond(value: Floats, limit: float) -> bool:
            return _above(value - limit * signal - self.parted / signal.size) < false_alarms / 3

        grade = sum(beyond(different, max(limit, 2.0 * sampled)) for limit in (_DIFFER, _STRANGERS))
        # Views that their neighbours do not foretell, in steps that they should: out of order.
        if not grade and view_step(self.rays.geometry.angles) < _FINE_STEP_RAD:
            grade = 2 * (beyond(different, _STRANGERS) and beyond(stray, _STRANGERS))
        return max(share, 0.0), grade

    def agrees_mirrored(self, most: float) -> bool:
        """Whether the rays disagree by less than ``most`` if the columns are counted the other way."""
        g, w = self.rays.geometry, self.rays.window
        if w.columns != g.columns:
            return False
        other, known = self.rays.opposite(self._values.flip(-1), self.base)
        difference = _product(self.here.flip(-1) - other, known).sum()
        here = self.here.flip(-1)
        return bool(difference < most * 2.0 * _product(here - here.mean(0), known).sum())


def check_lines(lines: Tensor, shape: tuple[int, ...], fits: bool = True) -> None:
    """Refuse line integrals that no test can take.

    Args:
        lines: of a scan.
        shape: that they must have; fits: false where none would do.

    Raises:
        ValueError: another shape, NaN or Inf.
    """
    if tuple(lines.shape) != shape or not fits:
        raise ValueError(f"lines must have the shape {shape}, got {tuple(lines.shape)}")
    if not bool(torch.isfinite(lines).all()):
        raise ValueError("lines hold NaN or Inf: bridge dead readings before (torchpcct.readings.bridge)")


def _check(lines: Tensor, geometry: Geometry, window: DetectorWindow) -> None:
    expected = window.shape if isinstance(geometry, ConeBeam) else (window.views, window.columns)
    check_lines(lines, expected, window.views == geometry.views)


def _product(values: Tensor, known: Tensor) -> Floats:
    """Sum of the products of close columns in every view, whose noise is independent: squares without noise.

    Interpolation between columns makes next ones share a reading, not those three apart.
    """
    both = known[..., 3:] & known[..., :-3]
    products: Floats = torch.where(both, values[..., 3:] * values[..., :-3], 0.0).double().sum((1, 2)).numpy()
    return products


def _flat_part(geometry: ConeBeam, window: DetectorWindow, values: Tensor) -> tuple[DetectorWindow, Tensor]:
    """The rows whose opposite rays part by less than :data:`_FLAT_CELLS` over what the window shows."""
    row, column = geometry.pitch
    reach = window.columns * column / geometry.magnification / 2
    flat = np.abs(geometry.row_positions) <= max(0.5 * _FLAT_CELLS, _FLAT_CELLS * geometry.sod / reach) * row + 1e-9
    kept = np.flatnonzero(flat[window.first_row : window.first_row + window.rows])
    if kept.size == 0:
        return window, values[:, :0]
    first, count = int(kept[0]), int(kept[-1] - kept[0] + 1)
    return window.with_rows(window.first_row + first, count), values[:, first : first + count]


def _parted(geometry: ConeBeam, window: DetectorWindow, values: Tensor, about: tuple[float, float]) -> float:
    """Mean square by which opposite rays of rows ``(views, rows, columns)`` may differ, since they part along z.

    To first order by 2 (s / sod) v ∂p/∂v (:mod:`torchpcct.checks.orbit_plane`), v the height of the row.
    """
    rays = OppositeRays(geometry, window, about)
    if values.shape[1] < 2:
        return 0.0
    turn = geometry.angles
    off = geometry.sod * np.sin(rays.fan_angles(np.arange(turn.size)) - rays.path(turn)[0][:, None])
    height = geometry.row_positions[window.first_row : window.first_row + window.rows] / geometry.pitch[0]
    height = torch.from_numpy((height[1:] + height[:-1]) / 2)[:, None].float()
    steps = height * values.diff(dim=1) * torch.from_numpy(2.0 * off / geometry.sod)[:, None].float()
    return PARTED * float(np.mean([shared_square(part) for part in steps.unbind(1)]))


def _joined_rows(geometry: ConeBeam, window: DetectorWindow, values: Tensor) -> Any:
    """Means over neighbouring rows, so many that the readings are :data:`_MOST` if three rows are left of them."""
    join = min(math.ceil(values.numel() / _MOST), max(window.rows // 3, 1))
    rows, (pitch, column) = window.rows // join, geometry.pitch
    values = values[:, : rows * join].unflatten(1, (rows, join)).mean(2)
    first = geometry.row_positions[window.first_row]
    middle = float(first + (rows * join - 1) / 2 * pitch)
    wider = replace(geometry, rows=rows, pitch=(join * pitch, column), offset=(middle, geometry.offset[1]))
    return wider, window.with_rows(0, rows), values


def _tested(score: Floats, power: Floats, waves: Floats, false_alarms: float, pairs: _Pairs) -> ScanTest:
    if power.sum() <= 0.0:
        return UNKNOWN
    fit = _fitted(score, power, CENTRE_TOLERANCE, pairs.stray("centre"))
    swing, swinging = _swing(score, waves)
    findings = []
    if fit.found(false_alarms / 2, CENTRE_TOLERANCE) and fit.explained > pairs.aligned("centre"):
        findings.append(_centre_text(fit.size, 2.0 * fit.error))
    # A wave has half the square of its amplitude.
    if swinging < false_alarms / 2 and 0.5 * swing**2 * power.sum() > pairs.unexplained("centre"):
        findings.append(
            f"opposite rays disagree by {swing:.2f} columns to either side in the course of a turn: the object moved, "
            "or the angles of the views are wrong"
        )
    sizes = {"centre": fit.size} | ({} if math.isnan(swing) else {"swing": swing})
    return ScanTest(sizes, {"centre": fit.error}, tuple(findings))


def _swing(score: Floats, waves: Floats) -> tuple[float, float]:
    """Amplitude of the second and third of ``waves`` ``(blocks, 3)`` in the scores, and its p-value.

    Where a few blocks hold most of what is seen, theirs is what noise leaves: the likelier of the usual covariance
    and that of White (1980, Econometrica 48:817).
    """
    from scipy import stats

    scale = np.abs(waves[:, :1]).mean()
    design, y = waves / scale, score / scale
    if np.linalg.cond(design) > 20.0:
        return math.nan, 1.0  # a part of the turn: the wave is not told from the constant
    found = np.linalg.lstsq(design, y, rcond=None)[0]
    count = y.size - 3
    residuals = y - design @ found
    inverse = np.linalg.inv(design.T @ design)
    usual = max(float(residuals @ residuals) / count, np.finfo(np.float64).tiny) * inverse
    white = inverse @ ((design * residuals[:, None] ** 2).T @ design) @ inverse * (y.size / count)
    amplitude = float(np.hypot(*found[1:]))
    if amplitude <= CENTRE_TOLERANCE:
        return amplitude, 1.0
    rest = found[1:] * (1.0 - CENTRE_TOLERANCE / amplitude)
    statistic = min(rest @ np.linalg.solve(covariance[1:, 1:], rest) / 2.0 for covariance in (usual, white))
    return amplitude, float(stats.f.sf(statistic, 2, count))


def _slope(values: Tensor, rows: int, columns: int) -> Tensor:
    """Central difference along the columns, averaged over ``rows`` (of a smaller stack less) × ``columns`` (odd)."""
    kernel = torch.zeros(columns + 2)
    for k in range(columns):
        kernel[k] -= 0.5
        kernel[k + 2] += 0.5
    return _convolved(values, rows, kernel / columns)


def _smooth(values: Tensor, rows: int, columns: int) -> Tensor:
    """Mean over ``rows`` (of a smaller stack less) × ``columns`` (odd)."""
    return _convolved(values, rows, torch.full((columns,), 1.0 / columns))


def _convolved(values: Tensor, rows: int, kernel: Tensor) -> Tensor:
    rows = min(rows, 2 * ((values.shape[1] - 1) // 2) + 1)
    padded = F.pad(values[:, None], (kernel.numel() // 2,) * 2 + (rows // 2,) * 2, mode="replicate")
    return F.conv2d(padded, kernel.expand(1, 1, rows, -1) / rows)[:, 0]


class OppositeRays:
    """Where the opposite of a reading lies: view, row and column, all fractional."""

    def __init__(self, geometry: Any, window: DetectorWindow, about: tuple[float, float]) -> None:
        self.geometry, self.window = geometry, window
        self.parallel = isinstance(geometry, ParallelBeam)
        u = geometry.column_positions
        self.flat = not isinstance(geometry, ConeBeam)
        self.start, self.step = float(u[0]), float(u[1] - u[0]) if u.size > 1 else 1.0
        self.rows = geometry.row_positions if isinstance(geometry, ConeBeam) else np.zeros(1)
        y, x = about
        self.radius, self.polar = math.hypot(x, y), math.atan2(y, x)

    def fan_angles(self, views: NDArray[np.int64]) -> Floats:
        """Of the readings of some views, ``(views, columns)`` rad; parallel: position in mm."""
        g = self.geometry
        found: Floats = (g.column_positions if self.parallel else g.fan_angles)[self.window.column_indices[views]]
        return found

    def path(self, beta: Floats) -> tuple[Floats, Floats]:
        """Fan angle (parallel: position in mm) of the point that is followed, and its depth from the source."""
        across = self.radius * np.sin(self.polar - beta)
        if self.parallel:
            return across, np.ones_like(across)
        depth = self.geometry.sod - self.radius * np.cos(self.polar - beta)
        curved = self.geometry.detector == "curved"
        return np.arctan2(across, depth), np.hypot(across, depth) if curved else depth

    def opposite(self, values: Tensor, base: NDArray[np.int64]) -> tuple[Tensor, Tensor]:
        """The opposite of every reading ``(base, rows, columns)`` of the views ``base``, and where it was measured.

        Each pair counts once, with its ray of positive fan angle.
        """
        g, w = self.geometry, self.window
        gamma = self.fan_angles(base)
        turn = g.angles % (2 * math.pi)
        order = np.argsort(turn, kind="stable")
        beta = turn[base][:, None] + math.pi - (0.0 if self.parallel else 2.0) * gamma
        after = np.searchsorted(turn[order], beta % (2 * math.pi)) % turn.size
        ends = [order[after - 1], order[after]]
        before, behind = ((beta - turn[ends[0]]) % (2 * math.pi), (turn[ends[1]] - beta) % (2 * math.pi))
        share = before / np.maximum(before + behind, 1e-12)
        close = before + behind <= _GAP_STEPS * view_step(g.angles) + 1e-9
        known = torch.from_numpy((gamma > 0) & close)[:, None].expand(-1, w.rows, -1).clone()
        target, depth = self.path(beta)
        own_depth = self.path(turn[base])[1][:, None]
        total = torch.zeros(known.shape)
        for views, part in zip(ends, (1.0 - share, share), strict=True):
            there, depth = self.path(turn[views])
            angle = there - target - gamma
            flat = not self.parallel and g.detector == "flat"
            position = angle if self.parallel else g.sdd * (np.tan(angle) if flat else angle)
            column = (position - self.start) / self.step - w.first_column[views]
            height = self.rows[w.first_row : w.first_row + w.rows][:, None] * (own_depth / depth)[:, None]
            pitch = self.rows[1] - self.rows[0] if self.rows.size > 1 else 1.0
            row = (height - self.rows[0]) / pitch - w.first_row
            found, inside = _bilinear(values, views, row, column)
            total += torch.from_numpy(part)[:, None].float() * found
            known &= inside
        return total, known


def _bilinear(values: Tensor, views: NDArray[np.int64], row: Floats, column: Floats) -> tuple[Tensor, Tensor]:
    """``values[views, row, column]`` between rows and columns, ``(base, rows, columns)``, and what lies inside."""
    rows, columns = values.shape[1:]
    inside = torch.from_numpy((column >= 0) & (column <= columns - 1))[:, None]
    inside = inside & torch.from_numpy((row >= -0.5) & (row <= rows - 0.5))
    at = torch.from_numpy(np.clip(column, 0, columns - 1))[:, None]
    up = torch.from_numpy(np.clip(row, 0, rows - 1))
    view = torch.from_numpy(views)[:, None]
    left, low = at.floor().long().clamp(max=max(columns - 2, 0)), up.floor().long().clamp(max=max(rows - 2, 0))
    right, high = (left + 1).clamp(max=columns - 1), (low + 1).clamp(max=rows - 1)
    across, along = (at - left).float(), (up - low).float()
    lower, upper = (torch.lerp(values[view, r, left], values[view, r, right], across) for r in (low, high))
    return torch.lerp(lower, upper, along), inside
