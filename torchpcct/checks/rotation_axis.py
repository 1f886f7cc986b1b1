"""Where is the rotation axis? Found from the readings, with an error that contains the truth.

* Conjugate rays that were measured see one line: of a full turn of any beam, or what a scan covers
  twice (:mod:`torchpcct.checks.conjugate_rays`). What all views of a full turn share is taken off
  before: the mean over the turn is the same on both sides of the axis, gains of single cells are
  not.
* Of half a turn of parallel rays the ends meet: the first views, mirrored, go on where the last
  ones stop.
* There, too, the centroid of an object that is seen whole runs through the views as a sine about
  the axis (Helgason and Ludwig's condition of first order). Gains of single cells pull it aside in
  all views alike, so that they are part of its error.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from torchpcct.checks.conjugate_rays import centre_test
from torchpcct.checks.orbit_plane import orbit_plane
from torchpcct.checks.ray_pairs import ConjugateRays
from torchpcct.detector_window import DetectorWindow
from torchpcct.geometry import ConeBeam, Geometry, view_step
from torchpcct.readings import MEDIAN_TO_SD

__all__ = ["RotationAxis", "axis_column", "rotation_axis"]

LEAST = 0.02
"""Error in columns below which none is stated, of conjugate rays: interpolation between views."""
LEAST_HALF = 0.05
"""The same of the two ends of half a turn."""
_SIGMAS = 3.0
"""Standard errors of the error that is stated."""
_COARSE_VIEWS = 48
"""Views of the first search."""
_COARSE_STEPS = 64
"""Places of the axis in the first search."""
_REACH = 0.45
"""Part of the detector's width, to either side of its middle, where the axis is looked for."""
_COMPARED = 0.1
"""Share of what the ends show that must be compared at a place of the axis: air is like air."""
_LIKE_SIGMAS = 5.0
"""How much more than noise, in standard errors, conjugate rays must resemble each other at the
axis; of a hundred columns that are tried one shows three by chance."""
_PART = 8
"""Columns over which products of conjugate rays are summed."""
_UNLIKE = 0.3
"""Squared difference of a half turn's ends over what they show, above which they have nothing in
common but noise."""
_LEAST_VIEWS = 4
"""Views of half a turn: what lies between two that are farther apart is no straight line."""
_ALIKE_SIGMAS = 3.0
"""How much more than at the axis, in standard errors, a half turn's ends must differ elsewhere."""
_NEARBY = 2.0
"""Columns beside the axis that need not differ so."""
_NOTHING = (
    "the readings do not tell the axis: where it might be they are no more alike than elsewhere "
    "(nothing but noise, or an object that is round about the axis)"
)
"""Said where no place of the axis stands out."""
_BLOCKS = 16
"""Blocks of views whose scatter is the error of the axis."""
_TIED = 1.7
"""Both ends compare the same readings, which counts them twice (√2), and smoothing ties
neighbouring blocks: measured on 120 simulated half turns."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class RotationAxis:
    """Result of :func:`rotation_axis`.

    Attributes:
        column: onto which the rotation axis projects, fractional, counted from 0.
        error: three standard errors, at least ``LEAST`` or ``LEAST_HALF``.
        how: what it was found from.
    """

    column: float
    error: float
    how: str

    def __str__(self) -> str:
        digits = max(0, min(3, math.ceil(-math.log10(self.error) - 1e-9)))
        up = math.ceil(self.error * 10**digits - 1e-9) / 10**digits
        return f"axis at column {self.column:.{digits}f} ± {up:.{digits}f}"


G = TypeVar("G", bound=Geometry)


def axis_column(geometry: Geometry) -> float:
    """Column onto which the rotation axis projects, as the geometry describes it."""
    pitch, offset = geometry.column_pitch, geometry.column_offset
    return float((geometry.columns - 1) / 2 - offset / pitch)


def at_axis(geometry: G, column: float) -> G:
    """The geometry whose axis projects onto ``column``."""
    return geometry.with_column_offset(
        ((geometry.columns - 1) / 2 - column) * geometry.column_pitch
    )


def rotation_axis(lines: Tensor, geometry: Geometry) -> RotationAxis:
    """The column of the rotation axis; where the geometry has it does not matter.

    Args:
        lines: line integrals ``(views, [rows,] columns)`` of any unit, finite, views in any order.
        geometry: parallel, fan or cone beam on a circle.

    Raises:
        ValueError: too few conjugate rays (less than half a turn of parallel rays, a fan or cone
            beam that meets hardly any line twice), or nothing to be seen.
    """
    g: Geometry = geometry
    shares = _shares(g.angles)
    shared = (
        0.0 if shares is None else torch.tensordot(torch.from_numpy(shares).to(lines), lines, 1)
    )
    found = _by_conjugates(lines - shared, g)
    if found is not None:
        # Of a part of a turn what single cells have wrong stays, and is alike in all views.
        return _stated(
            found[0], found[1] * (1.0 if shares is not None else 2.0), LEAST, "conjugate rays"
        )
    if not g.parallel:
        few = (
            "hardly any line was measured twice (conjugate rays), which the search for the axis of "
            "a fan or cone beam needs: scan a full turn"
        )
        raise ValueError(few if shares is None else _NOTHING)
    # What all views of a full turn share may tell it, too: an object that is round about the axis
    # has edges.
    turn = _turned(g.angles)
    half = np.flatnonzero(turn <= math.pi + 1e-4)
    order = half[np.argsort(turn[half], kind="stable")]
    ends = math.pi - float(turn[order[-1]])
    if order.size < _LEAST_VIEWS:
        raise ValueError(
            f"{order.size} view{'s' * (order.size != 1)} in half a turn are too few, "
            f"{_LEAST_VIEWS} are needed: the first ones are continued to where the last one stands"
        )
    if ends > 2.0 * view_step(g.angles) + 1e-4:
        raise ValueError(
            f"the views cover {math.degrees(turn[order[-1]]):.0f}° of the 180° that the search "
            "needs"
        )
    values = lines.detach().cpu().double().numpy()
    column, error = _by_ends(values[order], turn[order])
    whole = _by_centroid(values, g.angles)
    if whole is None or abs(whole[0] - column) > 5.0 * math.hypot(error, whole[1]) + 1.0:
        return _stated(column, error, LEAST_HALF, "the ends of the half turn")
    trust = np.maximum([error, whole[1]], 1e-6) ** -2.0
    column = float(trust @ [column, whole[0]] / trust.sum())
    return _stated(
        column,
        float(trust.sum() ** -0.5),
        LEAST_HALF,
        "the ends of the half turn and the object's centroid",
    )


def _stated(column: float, error: float, least: float, how: str) -> RotationAxis:
    if not (math.isfinite(column) and math.isfinite(error)):
        raise ValueError(_NOTHING)
    return RotationAxis(column, max(_SIGMAS * error, least), how)


def _shares(angles: Floats) -> Floats | None:
    """The part of a full turn that each view stands for; None if they do not cover it."""
    turn = np.mod(angles, 2 * math.pi)
    order = np.argsort(turn, kind="stable")
    gaps = np.diff(turn[order], append=turn[order[0]] + 2 * math.pi)
    if gaps.max() > 2.5 * 2 * math.pi / angles.size:
        return None
    shares = np.empty_like(turn)
    shares[order] = (gaps + np.roll(gaps, 1)) / (4 * math.pi)
    return shares


def _turned(angles: Floats) -> Floats:
    """The angle of every view from the end of the widest gap on, rad, whatever their order and
    direction."""
    turn = np.mod(angles, 2 * math.pi)
    ordered = np.sort(turn)
    gaps = np.diff(ordered, append=ordered[0] + 2 * math.pi)
    begin = ordered[(int(np.argmax(gaps)) + 1) % ordered.size]
    # Rounding puts what equals the beginning at 0, not at a whole turn.
    return np.mod(turn - begin + 1e-9, 2 * math.pi) - 1e-9


def _by_conjugates(lines: Tensor, geometry: Geometry) -> tuple[float, float] | None:
    """Column and its standard error; None where hardly any ray has a conjugate, or they are
    alike by chance."""
    column = _coarse(lines, geometry)
    if column is None:
        return None
    error = math.inf
    for _ in range(12):
        test = centre_test(lines, at_axis(geometry, column))
        if "centre" not in test.sizes:
            break
        error = test.errors["centre"]
        step = min(max(test.sizes["centre"], -2.0), 2.0)
        column += step  # described too high by so much: the axis lies at a higher column
        if abs(step) < max(0.05 * error, 1e-3):
            break
    alike = math.isfinite(error) and _likeness(lines, at_axis(geometry, column)) >= _LIKE_SIGMAS
    return (column, error) if alike else None


def _likeness(lines: Tensor, geometry: Geometry) -> float:
    """By how many standard deviations conjugate rays resemble each other more than noise does.

    Of noise alone the products of the two are as often below 0 as above: the sums over parts of the
    views, a few columns wide, tell how far their sum may lie from 0.
    """
    values = lines.detach().to("cpu", torch.float32)
    if isinstance(geometry, ConeBeam):
        plane = orbit_plane(values, geometry)
        if plane is None:
            return 0.0
        values, geometry = plane.lines, geometry.central_fan
    values = values.reshape(geometry.views, 1, geometry.columns)
    window = DetectorWindow.full(geometry)
    base = np.arange(geometry.views)
    conjugate, known = ConjugateRays(geometry, window, (0.0, 0.0)).conjugate(values, base)
    products = torch.where(known, values * conjugate, 0.0)[:, 0].double()
    parts = F.pad(products, (0, -products.shape[1] % _PART)).unflatten(1, (-1, _PART)).sum(2)
    spread = float(parts.square().sum().sqrt())
    return float(parts.sum()) / spread if spread > 0 else 0.0


def _coarse(lines: Tensor, geometry: Geometry) -> float | None:
    """The column at which conjugate rays resemble each other most, to about one; of a cone beam
    in one row."""
    window = DetectorWindow.full(geometry)
    values = lines.detach().to("cpu", torch.float32).reshape(window.shape)
    row = 0
    if isinstance(geometry, ConeBeam):
        row, geometry = int(np.argmin(np.abs(geometry.row_positions))), geometry.central_fan
    columns = geometry.columns
    width = max(1, columns // _COARSE_STEPS) | 1
    middle = F.avg_pool1d(values[:, row][:, None], width, 1, width // 2, count_include_pad=False)
    base = np.argsort(geometry.angles % (2 * math.pi), kind="stable")
    base = base[:: max(1, base.size // _COARSE_VIEWS)]
    here, window = middle[torch.from_numpy(base)], DetectorWindow.full(geometry)

    def likeness(column: float) -> float:
        conjugate, known = ConjugateRays(at_axis(geometry, column), window, (0.0, 0.0)).conjugate(
            middle, base
        )
        return (
            float((here * conjugate)[known].sum()) if int(known.sum()) > columns // 4 else -math.inf
        )

    best, reach = (columns - 1) / 2, int(_REACH * columns) // width
    steps = [width, 1] if width > 1 else [1]
    for step in steps:
        tried = best + step * np.arange(-reach, reach + 1)
        found = [likeness(c) for c in tried]
        if not max(found) > -math.inf:
            return None
        best, reach = float(tried[int(np.argmax(found))]), width
    return best


def _by_ends(lines: Floats, turn: Floats) -> tuple[float, float]:
    """Column and standard error of a half turn ``(views, columns)`` in the order of ``turn``.

    The first views are continued backwards to where the last one stands, mirrored, and the last
    ones forwards.
    """
    from scipy.interpolate import CubicSpline
    from scipy.ndimage import gaussian_filter1d

    columns = lines.shape[1]
    at = np.arange(columns)
    step = float(np.median(np.diff(turn)))
    lack = (math.pi - turn[-1]) / step
    # Between two views what lies off the axis moves by up to step × radius: finer structure says
    # nothing.
    width = max(2.0, 0.25 * step * columns) / 2.355
    ends = gaussian_filter1d(lines[[0, 1, -2, -1]], width, axis=-1, mode="nearest")
    onward = [(1 + lack) * ends[0] - lack * ends[1], (1 + lack) * ends[3] - lack * ends[2]]
    mirrors = [CubicSpline(at, ends[3]), CubicSpline(at, ends[0])]

    def compared(column: float) -> tuple[int, Floats, Floats, Floats, Floats]:
        """Of the readings that have a counterpart: how many of each end they are, differences,
        slopes, their power, squares of the readings."""
        there = 2 * column - at
        inside = (there >= 0) & (there <= columns - 1)
        parts = []
        for o, m in zip(onward, mirrors, strict=True):
            # Noise of the two slopes is independent: their product does not know it (instrumental
            # variables).
            here, slope = np.gradient(o), m(there, 1)
            parts.append([o - m(there), slope - here, -4.0 * slope * here, o**2 + m(there) ** 2])
        differences, slopes, power, levels = (
            np.where(inside, np.stack(v), 0.0) for v in zip(*parts, strict=True)
        )
        return int(inside.sum()), differences, slopes, power, levels

    most = 2.0 * float((ends[[0, 3]] ** 2).sum())

    def unlike(column: float) -> tuple[float, float, float]:
        """Mean squared difference at a place of the axis over what the ends show, the mean itself,
        and the relative standard error of that of noise."""
        count, differences, _, _, levels = compared(column)
        # Both ends compare the same readings, and smoothing ties neighbours.
        independent = max(count / (2.0 * math.sqrt(math.pi) * width), 1.0)
        total, shown = float((differences**2).sum()), float(levels.sum())
        # Air is like air: a part of what the ends show must be compared.
        relative = total / shown if shown > _COMPARED * most else math.inf
        return relative, total / max(count, 1), 2.0 / independent

    reach = int(_REACH * columns)
    places = (columns - 1) / 2 + np.arange(-reach, reach + 1)
    found = [unlike(float(c)) for c in places]
    differing = np.array([relative for relative, _, _ in found])
    column = float(places[int(np.argmin(differing))])
    if differing.min() > _UNLIKE:
        return math.nan, math.inf
    for _ in range(12):
        _, differences, slopes, power, _ = compared(column)
        total = float(power.sum())
        if total <= 0:
            return math.nan, math.inf
        move = float((differences * slopes).sum()) / total
        column += min(max(move, -2.0), 2.0)
        if abs(move) < 1e-4:
            break
    scores = [
        float(b.sum())
        for b in np.array_split(slopes * differences - move * power, _BLOCKS, axis=-1)
    ]
    error = _TIED * math.sqrt(np.square(scores).sum() * _BLOCKS / (_BLOCKS - 1)) / total
    _, least, uncertain = unlike(column)
    far = np.abs(places - column) > max(_NEARBY, 2.0 * _SIGMAS * error)
    for at_place in np.flatnonzero(far & np.isfinite(differing)):
        _, there, also = found[at_place]
        if there <= least * (1.0 + _ALIKE_SIGMAS * math.sqrt(uncertain + also)):
            return math.nan, math.inf  # as alike as at the axis
    return float(column), error


def _by_centroid(lines: Floats, angles: Floats) -> tuple[float, float] | None:
    """Column and standard error of a sinogram ``(views, columns)`` whose object is seen whole,
    else None."""
    columns = lines.shape[1]
    margin = max(1, columns // 50)
    mass = lines.sum(1)
    edges = np.abs(np.concatenate([lines[:, :margin], lines[:, -margin:]], 1).mean(1))
    if columns < 8 or mass.min() <= 0 or float((edges > 0.05 * lines.max(1)).mean()) > 0.02:
        return None
    at = np.arange(columns)
    centroid = (lines @ at) / mass
    waves = np.stack([np.ones_like(angles), np.cos(angles), np.sin(angles)], 1)
    kept = np.ones(len(angles), bool)
    for _ in range(5):  # views that a lost reading has pulled aside are left out
        fit = np.linalg.lstsq(waves[kept], centroid[kept], rcond=None)[0]
        off = centroid - waves @ fit
        kept = np.abs(off) <= 5.0 * MEDIAN_TO_SD * np.median(np.abs(off)) + 1e-9
    used = waves[kept]
    variance = float(np.square(off[kept]).sum()) / max(len(used) - 3, 1)
    noise = math.sqrt(np.linalg.inv(used.T @ used)[0, 0] * variance)
    mean = lines.mean(0)
    second = mean[2:] - 2.0 * mean[1:-1] + mean[:-2]
    cells = MEDIAN_TO_SD * float(np.median(np.abs(second))) / math.sqrt(6.0)
    return float(fit[0]), math.hypot(
        noise, cells * float(np.linalg.norm(at - fit[0])) / float(mass.mean())
    )
