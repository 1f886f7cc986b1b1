"""Conjugate rays: where they lie, what they read, and how both change along the columns and with
the views.

The ray of source angle β and fan angle γ is met again by that of β + π − 2γ and −γ.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from torchpcct.checks.orbit_plane import PARTED, orbit_plane, shared_square
from torchpcct.checks.scan_test import check_lines
from torchpcct.detector_window import DetectorWindow
from torchpcct.geometry import ConeBeam, Geometry, view_step
from torchpcct.readings import quartile_sd, second_differences

BLOCKS = 24
"""Parts of the views whose scatter tells the error of a sum."""
_MOST = 500_000
"""Readings whose conjugates are looked up; more only cost time."""
_SMALL = 60_000
"""Readings of a scan whose pairs are kept, in 5 MB."""
_GAP_STEPS = 3.0
"""Views beside a conjugate angle that are farther apart than so many usual steps do not stand for
it."""
_ROWS = 9
"""Most rows over which slopes are smoothed."""
WIDTHS = (5, 25)
"""Columns over which slopes are smoothed: a few for small errors, many for those of several
columns; raw ones over a fifth of them."""
_FLAT_CELLS = 2.0
"""Rows count whose conjugate rays part by less, along z."""
_ALIGNED = {"centre": 0.05, "step": 0.06, "scale": 0.25, "roll": 0.05}
"""Share of the squared difference by which rays may part that looks like a cause at most: of 300
sound cone beams drawn at random, without noise, 0.021, 0.026, 0.056 and 0.009 (of two plates 0.13
and 0.61, as fan angles by more than a third)."""
_INTERPOLATED = 12.0 / 7.0
"""Variance of a sum of differences of conjugate rays over many columns, over what their second
differences show: where conjugates lie half way between two columns, neighbours share a reading."""
_FEWEST_BENDS = 8
"""Second differences from which their quartiles tell how noisy they are."""

Floats = NDArray[np.float64]
Pattern = tuple[Tensor, str]
"""Factor of the slope, and which slope: along the ``"columns"`` or the ``"angles"``."""


class RayPairs:
    """Readings, those of their conjugate rays, and the slopes of both."""

    def __init__(self, rays: ConjugateRays, values: Tensor, parted: float = 0.0) -> None:
        self.rays, self._values = rays, values
        self._pairs = pairs = _pairs_of(rays.geometry, rays.window, rays.about)
        self.base, self.angles, self.known = pairs.base, pairs.angles, pairs.known
        self.here = values[torch.from_numpy(self.base)]
        self.conjugate = pairs.places.of(values)
        self.difference = self.here - self.conjugate
        self.parted = parted * float(self.known.sum())
        self._slopes: dict[tuple[str, int], tuple[Any, ...]] = {}
        self._in_rows: dict[str, dict[int, list[Tensor]]] = {}

    @classmethod
    def of(
        cls,
        lines: Tensor,
        geometry: Geometry,
        window: DetectorWindow | None,
        about: tuple[float, float],
    ) -> RayPairs | None:
        """Of a whole cone beam the plane of the source; None where no row lies near it."""
        if window is not None or not isinstance(geometry, ConeBeam):
            return cls.stacked(lines, geometry, window, about)
        _check(lines, geometry, DetectorWindow.full(geometry))
        plane = orbit_plane(lines.detach().to("cpu", torch.float32), geometry)
        if plane is None:
            return None
        fan = geometry.central_fan
        return cls(ConjugateRays(fan, DetectorWindow.full(fan), about), plane.lines, plane.parted)

    @classmethod
    def stacked(
        cls,
        lines: Tensor,
        geometry: Geometry,
        window: DetectorWindow | None,
        about: tuple[float, float],
    ) -> RayPairs | None:
        """Of a cone beam the rows near the plane of the source, each with its own; None where
        there is none."""
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
        return cls(ConjugateRays(geometry, window, about), values, parted)

    def _with_conjugates(self, way: int) -> tuple[Tensor, Tensor, Tensor]:
        """Readings and conjugates of the views that lie so many places behind each."""
        pairs = self._pairs
        if pairs.all_views:  # they are looked up already
            return tuple(v.roll(-way, 0) for v in (self.here, self.conjugate, self.known))  # type: ignore[return-value]
        views = pairs.views_behind(way)
        return self._values[torch.from_numpy(views)], *self.rays.conjugate(self._values, views)

    def shifted(self) -> Pattern:
        """Columns described too high."""
        return torch.full((1,), 2.0), "columns"

    def heights(self) -> Tensor:
        """Of the rows from their middle, in columns."""
        g, w = self.rays.geometry, self.rays.window
        height = g.row_positions[w.first_row : w.first_row + w.rows]
        return torch.from_numpy(height - height.mean()).float() / g.pitch[1]

    def pattern(self, name: str) -> Pattern | None:
        """Of one cause (``centre``, ``roll``, ``scale`` or ``step``) of the size 1; None: the
        scan cannot show it."""
        if name == "centre":
            return self.shifted()
        if name == "roll":
            if not self.rays.geometry.has_rows or self.rays.window.rows < 3:
                return None
            return 2.0 * self.heights()[:, None], "columns"
        if name == "scale":
            return None if self.rays.parallel else (self._pairs.twice_fan_angles, "angles")
        return self._pairs.turned_between, "angles"

    def used(self, columns: int) -> NDArray[np.int64]:
        """Views in which a slope is known."""
        return self._pairs.used(columns)

    def slopes(self, along: str, columns: int) -> tuple[Any, ...]:
        """Smoothed slopes of both rays, raw ones of both, and where they are known."""
        if (along, columns) not in self._slopes:
            sizes, known = ((_ROWS, columns), (1, columns // 5)), self._pairs.whole(columns)
            pairs = self._smoothed(along, sizes)
            if along == "angles":
                before, behind = self.beside
                step, rate = self._pairs.step, self._pairs.rate
                pairs = [[v / step for v in both] for both in pairs]
                if bool((rate != 0.0).any()):  # of a window that moves with the views
                    pairs = [
                        [turned - rate * slope for turned, slope in zip(*both, strict=True)]
                        for both in zip(pairs, self.slopes("columns", columns)[:2], strict=True)
                    ]
                known = known & before[2] & behind[2]
            self._slopes[along, columns] = (*pairs, known)
        return self._slopes[along, columns]

    def _smoothed(self, along: str, sizes: tuple[tuple[int, int], ...]) -> list[list[Tensor]]:
        """Slopes of both rays along the columns, or their changes from the view before to the one
        behind, smoothed over so many rows and columns.

        Of single rows, where the number of rows does not matter, all widths at once and kept: the
        time is that of the widest.
        """
        kernel_of: Callable[[int], Tensor] = _difference if along == "columns" else _mean
        if self.here.shape[1] > 1:
            return _filtered(self._changes(along), kernel_of, sizes)
        if along not in self._in_rows:
            widths = sorted({w for columns in WIDTHS for w in (columns, columns // 5)})
            found = _filtered(self._changes(along), kernel_of, tuple((1, w) for w in widths))
            self._in_rows[along] = dict(zip(widths, found, strict=True))
        return [self._in_rows[along][columns] for _, columns in sizes]

    def _changes(self, along: str) -> tuple[Tensor, Tensor]:
        """Of both rays: what they read, or how that changes from the view before to the one
        behind."""
        if along == "columns":
            return self.here, self.conjugate
        before, behind = self.beside
        return behind[0] - before[0], behind[1] - before[1]

    @cached_property
    def beside(self) -> list[tuple[Tensor, Tensor, Tensor]]:
        """Of the views before and behind each: readings, conjugates, and which of them are known
        and near enough."""
        looked = [self._with_conjugates(k) for k in (-1, 1)]
        return [(here, there, known & self._pairs.near) for here, there, known in looked]

    def sums(self, pattern: Pattern, columns: int) -> tuple[Floats, Floats, Floats] | None:
        """Score and power of a pattern in every view, and which part of the score interpolation
        would have left had it been in straight lines; None: too few views."""
        if self.used(columns).size < BLOCKS:
            return None
        factor, along = pattern
        smooth, raw, known = self.slopes(along, columns)
        slope = factor * (smooth[0] + smooth[1]) / 2
        power = factor.square() * (smooth[0] * raw[1] + smooth[1] * raw[0]) / 2
        values = (-self.residue * slope, power, -self.curvature * slope)
        score, power, bent = (
            torch.where(known, v, 0.0).sum((1, 2), dtype=torch.float64).numpy() for v in values
        )
        return score, power, bent

    def shared_error(self, pattern: Pattern, columns: int, size: float) -> float:
        """Standard error of the sum of a pattern's scores by what each column has in all views
        alike: noise of the air frames, or gains.

        The scatter of views shows nothing of it; that from column to column of the mean over the
        views does, all that noise leaves of it included. Along the angles the slopes of a turn add
        up to nothing: 0.

        Args:
            pattern, columns: see :meth:`sums`.
            size: of the pattern, which is taken off.
        """
        factor, along = pattern
        if along != "columns":
            return 0.0
        smooth, _, known = self.slopes(along, columns)
        slope = factor * (smooth[0] + smooth[1]) / 2
        # Wide slopes are known of few columns, what they are taken off is of more.
        left = self.residue + size * slope
        left = torch.where(self.known, left, 0.0).sum(0, dtype=torch.float64)
        number = self.known.sum(0)
        bend, _ = second_differences((left / number.clamp_min(1)).numpy())
        there = (number[:, 2:] > 0) & (number[:, 1:-1] > 0) & (number[:, :-2] > 0)
        bend = bend[there.numpy()]
        if not bend.size:
            return 0.0
        few = bend.size < _FEWEST_BENDS
        sd = math.sqrt(float(np.square(bend).mean())) if few else quartile_sd(bend)
        total = torch.where(known, slope, 0.0).sum(0, dtype=torch.float64)
        return sd * math.sqrt(_INTERPOLATED * float(total.square().sum()) / 6.0)

    @cached_property
    def between_views(self) -> Tensor:
        """How far readings lie from the mean of those in the views before and behind."""
        before, behind = self.beside
        difference: Tensor = self.here - (before[0] + behind[0]) / 2
        return difference

    @cached_property
    def curvature(self) -> Tensor:
        """By how much the conjugate is too low for having been interpolated in straight lines."""
        return self._pairs.places.curvature(self._values, self.between_views)

    @cached_property
    def residue(self) -> Tensor:
        """The difference without what interpolation leaves, to second order."""
        return self.difference - self.curvature

    @cached_property
    def blurred(self) -> float:
        """Squared difference, noise taken off, that cells and the focal spot may leave where rays
        spread.

        They average over more of the object behind the axis than before it, s / sod of the width at
        the axis either way: of the second difference D from column to column s / (6 sod) by the
        cells, as much again by the spot.
        """
        if self.rays.parallel:
            return 0.0
        bend = self.here[..., 2:] - 2.0 * self.here[..., 1:-1] + self.here[..., :-2]
        beside = self._values[torch.from_numpy(self._pairs.views_behind(1))]
        other = beside[..., 2:] - 2.0 * beside[..., 1:-1] + beside[..., :-2]
        square = float(torch.where(self.known[..., 1:-1], bend * other, 0.0).double().sum())
        reach = float(np.sin(np.abs(self.rays.fan_angles(self.base)).max()))
        return max(square, 0.0) * (reach / 3.0) ** 2

    def aligned(self, name: str) -> float:
        """Of the squared difference that rays part by or that blur leaves, what may look like
        one cause."""
        return _ALIGNED[name] * (self.parted + self.blurred)

    @property
    def disagreement(self) -> float:
        """Mean square of the difference, noise taken off."""
        return float(product(self.difference, self.known).sum()) / self.here.numel()

    def agrees_mirrored(self, most: float) -> bool:
        """Whether the rays disagree by less than ``most`` if the columns are counted the other
        way."""
        g, w = self.rays.geometry, self.rays.window
        if w.columns != g.columns:
            return False
        other, known = self.rays.conjugate(self._values.flip(-1), self.base)
        difference = product(self.here.flip(-1) - other, known).sum()
        here = self.here.flip(-1)
        return bool(difference < most * 2.0 * product(here - here.mean(0), known).sum())


def unwrapped(angles: Floats) -> Floats:
    """Angles as the scanner turned, where they are given from 0 to 2π; views in no order stay as
    they are."""
    turned: Floats = np.unwrap(angles)
    steps = np.diff(turned)
    return turned if bool((steps > 0).all() or (steps < 0).all()) else angles


def _check(lines: Tensor, geometry: Geometry, window: DetectorWindow) -> None:
    expected = window.shape if geometry.has_rows else (window.views, window.columns)
    check_lines(lines, expected, window.views == geometry.views)


def product(values: Tensor, known: Tensor) -> Floats:
    """Sum of the products of close columns in every view, whose noise is independent: squares
    without noise.

    Interpolation between columns makes next ones share a reading, not those three apart.
    """
    both = known[..., 3:] & known[..., :-3]
    products: Floats = (
        torch.where(both, values[..., 3:] * values[..., :-3], 0.0).double().sum((1, 2)).numpy()
    )
    return products


def _flat_part(
    geometry: ConeBeam, window: DetectorWindow, values: Tensor
) -> tuple[DetectorWindow, Tensor]:
    """The rows whose conjugate rays part by less than :data:`_FLAT_CELLS` over what the window
    shows."""
    row, column = geometry.pitch
    reach = window.columns * column / geometry.magnification / 2
    flat = (
        np.abs(geometry.row_positions)
        <= max(0.5 * _FLAT_CELLS, _FLAT_CELLS * geometry.sod / reach) * row + 1e-9
    )
    kept = np.flatnonzero(flat[window.first_row : window.first_row + window.rows])
    if kept.size == 0:
        return window, values[:, :0]
    first, count = int(kept[0]), int(kept[-1] - kept[0] + 1)
    return window.with_rows(window.first_row + first, count), values[:, first : first + count]


def _parted(
    geometry: ConeBeam, window: DetectorWindow, values: Tensor, about: tuple[float, float]
) -> float:
    """Mean square by which conjugate rays of rows ``(views, rows, columns)`` may differ, since they
    part along z.

    To first order by 2 (s / sod) v ∂p/∂v (:mod:`torchpcct.checks.orbit_plane`), v the height of the
    row.
    """
    rays = ConjugateRays(geometry, window, about)
    if values.shape[1] < 2:
        return 0.0
    turn = geometry.angles
    off = geometry.sod * np.sin(rays.fan_angles(np.arange(turn.size)) - rays.path(turn)[0][:, None])
    height = (
        geometry.row_positions[window.first_row : window.first_row + window.rows]
        / geometry.pitch[0]
    )
    height = torch.from_numpy((height[1:] + height[:-1]) / 2)[:, None].float()
    steps = (
        height * values.diff(dim=1) * torch.from_numpy(2.0 * off / geometry.sod)[:, None].float()
    )
    return PARTED * float(np.mean([shared_square(part) for part in steps.unbind(1)]))


def _joined_rows(geometry: ConeBeam, window: DetectorWindow, values: Tensor) -> Any:
    """Means over neighbouring rows, so many that the readings are :data:`_MOST` if three rows
    are left of them."""
    join = min(math.ceil(values.numel() / _MOST), max(window.rows // 3, 1))
    rows, (pitch, column) = window.rows // join, geometry.pitch
    values = values[:, : rows * join].unflatten(1, (rows, join)).mean(2)
    first = geometry.row_positions[window.first_row]
    middle = float(first + (rows * join - 1) / 2 * pitch)
    wider = replace(
        geometry, rows=rows, pitch=(join * pitch, column), offset=(middle, geometry.offset[1])
    )
    return wider, window.with_rows(0, rows), values


@lru_cache
def _difference(columns: int) -> Tensor:
    """Central difference along the columns, averaged over so many (odd)."""
    kernel = torch.zeros(columns + 2)
    for k in range(columns):
        kernel[k] -= 0.5
        kernel[k + 2] += 0.5
    return kernel / columns


def _mean(columns: int) -> Tensor:
    """Mean over so many columns (odd)."""
    return torch.full((columns,), 1.0 / columns)


def _filtered(
    pair: tuple[Tensor, Tensor],
    kernel_of: Callable[[int], Tensor],
    sizes: tuple[tuple[int, int], ...],
) -> list[list[Tensor]]:
    """Two stacks ``(views, rows, columns)`` under the kernels of several sizes, rows (of a smaller
    stack less) × columns; of each size both."""
    kernels = [kernel_of(columns) for _, columns in sizes]
    if pair[0].shape[1] > 1:
        return [
            [_convolved(v, rows, kernel) for v in pair]
            for (rows, _), kernel in zip(sizes, kernels, strict=True)
        ]
    # Of single rows the views make one image, and all kernels are applied at once.
    width = max(kernel.numel() for kernel in kernels)
    bank = torch.stack([F.pad(k, ((width - k.numel()) // 2,) * 2) for k in kernels])
    images = F.pad(
        torch.stack([v[:, 0] for v in pair])[:, None], (width // 2,) * 2 + (0, 0), mode="replicate"
    )
    found = F.conv2d(images, bank[:, None, None])
    return [[found[k, size].unsqueeze(1) for k in range(2)] for size in range(len(sizes))]


def _convolved(values: Tensor, rows: int, kernel: Tensor) -> Tensor:
    rows = min(rows, 2 * ((values.shape[1] - 1) // 2) + 1)
    padded = F.pad(values[:, None], (kernel.numel() // 2,) * 2 + (rows // 2,) * 2, mode="replicate")
    return F.conv2d(padded, kernel.expand(1, 1, rows, -1) / rows)[:, 0]


def varying(values: Tensor, kept: Tensor, axis: int) -> Tensor:
    """``values`` in double precision without their mean along an axis over what is ``kept`` (1; 0:
    left out, and 0 in the result)."""
    v = values.double() * kept
    number = kept.sum(axis, keepdim=True).clamp(min=1.0)
    return (v - v.sum(axis, keepdim=True) / number) * kept


class ConjugateRays:
    """Where the conjugate of a reading lies: view, row and column, all fractional."""

    def __init__(self, geometry: Any, window: DetectorWindow, about: tuple[float, float]) -> None:
        self.geometry, self.window, self.about = geometry, window, about
        self.parallel = geometry.parallel
        u = geometry.column_positions
        self.flat = not geometry.has_rows
        self.start, self.step = float(u[0]), float(u[1] - u[0]) if u.size > 1 else 1.0
        self.rows = geometry.row_positions
        y, x = about
        self.radius, self.polar = math.hypot(x, y), math.atan2(y, x)

    def fan_angles(self, views: NDArray[np.int64]) -> Floats:
        """Of the readings of some views, ``(views, columns)`` rad; parallel: position in mm."""
        g = self.geometry
        found: Floats = (g.column_positions if self.parallel else g.fan_angles)[
            self.window.column_indices[views]
        ]
        return found

    def path(self, beta: Floats) -> tuple[Floats, Floats]:
        """Fan angle (parallel: position in mm) of the point that is followed, and its depth from
        the source."""
        if self.radius == 0.0:  # the axis, which all views see alike
            depth = 1.0 if self.parallel else self.geometry.sod
            return np.zeros_like(beta), np.full_like(beta, depth)
        across = self.radius * np.sin(self.polar - beta)
        if self.parallel:
            return across, np.ones_like(across)
        depth = self.geometry.sod - self.radius * np.cos(self.polar - beta)
        curved = self.geometry.detector == "curved"
        return np.arctan2(across, depth), np.hypot(across, depth) if curved else depth

    def conjugate(self, values: Tensor, base: NDArray[np.int64]) -> tuple[Tensor, Tensor]:
        """The conjugate of every reading ``(base, rows, columns)`` of the views ``base``, and where
        it was measured.

        Each pair counts once, with its ray of positive fan angle.
        """
        places = self.places(base)
        return places.of(values), places.known

    def places(self, base: NDArray[np.int64]) -> Places:
        """Where the conjugates of the readings of the views ``base`` lie."""
        g, w = self.geometry, self.window
        gamma = self.fan_angles(base)
        turn = g.angles % (2 * math.pi)
        order = np.argsort(turn, kind="stable")
        beta = turn[base][:, None] + math.pi - (0.0 if self.parallel else 2.0) * gamma
        after = np.searchsorted(turn[order], beta % (2 * math.pi)) % turn.size
        ends = [order[after - 1], order[after]]
        before, behind = (
            (beta - turn[ends[0]]) % (2 * math.pi),
            (turn[ends[1]] - beta) % (2 * math.pi),
        )
        share = before / np.maximum(before + behind, 1e-12)
        close = before + behind <= _GAP_STEPS * view_step(g.angles) + 1e-9
        known = torch.from_numpy((gamma > 0) & close)[:, None].expand(-1, w.rows, -1)
        target, depth = self.path(beta)
        own_depth = self.path(turn[base])[1][:, None]
        across, away = self.path(turn)
        found = []
        for views, part in zip(ends, (1.0 - share, share), strict=True):
            there, depth = across[views], away[views]
            angle = there - target - gamma
            flat = not self.parallel and g.detector == "flat"
            position = angle if self.parallel else g.sdd * (np.tan(angle) if flat else angle)
            column = (position - self.start) / self.step - w.first_column[views]
            height = (
                self.rows[w.first_row : w.first_row + w.rows][:, None]
                * (own_depth / depth)[:, None]
            )
            pitch = self.rows[1] - self.rows[0] if self.rows.size > 1 else 1.0
            row = (height - self.rows[0]) / pitch - w.first_row
            found.append(Place(views, part, row, column, w.rows, w.columns))
            known = known & found[-1].inside
        return Places(found, known)


class Place:
    """One of the two views between which conjugates lie, and where in it.

    Args:
        views, part: number of the view, and its share in the conjugate, ``(base, columns)``.
        row: fractional, ``(base, rows, columns)``.
        column: fractional, ``(base, columns)``.
        rows, columns: of the readings.
    """

    def __init__(
        self,
        views: NDArray[np.int64],
        part: Floats,
        row: Floats,
        column: Floats,
        rows: int,
        columns: int,
    ) -> None:
        self.views, self.part, self.column = views, part, column
        self.share = torch.from_numpy(part)[:, None].float()
        inside = torch.from_numpy((column >= 0) & (column <= columns - 1))[:, None]
        self.inside = inside & torch.from_numpy((row >= -0.5) & (row <= rows - 0.5))
        at = np.clip(column, 0, columns - 1)[:, None]
        left = np.minimum(np.floor(at).astype(np.int64), max(columns - 2, 0))
        self._across = torch.from_numpy(at - left).float()
        self._step = min(columns - 1, 1)
        view = views[:, None] * rows
        self._along: Tensor | None = None
        if rows == 1:
            lines = [view]
        else:
            up = np.clip(row, 0, rows - 1)
            low = np.minimum(np.floor(up).astype(np.int64), rows - 2)
            self._along = torch.from_numpy(up - low).float()
            lines = [view + low, view + low + 1]
        self._places = [torch.from_numpy(k * columns + left) for k in lines]

    def of(self, values: Tensor) -> Tensor:
        """Readings ``(views, rows, columns)`` between rows and columns, ``(base, rows,
        columns)``."""
        flat = values.reshape(-1)
        found = [
            torch.lerp(flat[left], flat[left + self._step], self._across) for left in self._places
        ]
        return found[0] if self._along is None else torch.lerp(found[0], found[1], self._along)


class Places(NamedTuple):
    """Where conjugates lie: between two views; and which rays have a pair, ``(base, rows,
    columns)``."""

    ends: list[Place]
    known: Tensor

    def of(self, values: Tensor) -> Tensor:
        """The conjugates of readings ``(views, rows, columns)``."""
        total = torch.zeros(self.known.shape)
        for end in self.ends:
            total += end.share * end.of(values)
        return total

    def curvature(self, values: Tensor, between: Tensor) -> Tensor:
        """By how much :meth:`of` is too low, to second order, since it is interpolated in straight
        lines.

        A second difference D from neighbour to neighbour leaves -s (1 - s) D / 2 at the part s of
        the way.

        Args:
            values: see :meth:`of`.
            between: ``(base, rows, columns)``, how far the readings themselves lie from the mean of
                those in the views before and behind, -D / 2 along the views, which their conjugates
                share.
        """
        bend = F.pad(values[..., 2:] - 2.0 * values[..., 1:-1] + values[..., :-2], (1, 1))
        total = torch.zeros(self.known.shape)
        for end in self.ends:
            way = end.column - np.floor(end.column)
            part = end.part * -0.5 * way * (1.0 - way)
            total += torch.from_numpy(part)[:, None].float() * end.of(bend)
        share = self.ends[1].part
        return total + torch.from_numpy(share * (1.0 - share))[:, None].float() * between


class _Pairs:
    """What the pairs of a geometry share, whatever they read.

    Attributes:
        base, angles: of the views whose readings are compared, in the order of their angles.
        all_views: whether these are all.
        places: of the conjugates.
        step, rate, near: angle between the view before and the one behind, rad; columns that the
            window moves between them per rad; whether they are near enough, ``(base, 1, 1)``.
    """

    def __init__(self, rays: ConjugateRays) -> None:
        self.rays = rays
        angles = rays.geometry.angles
        self._order = np.argsort(angles % (2 * math.pi), kind="stable")
        stride = max(1, math.ceil(math.prod(rays.window.shape) / _MOST))
        self._at = np.arange(0, angles.size, stride)
        self.base, self.all_views = self._order[self._at], stride == 1
        self.angles = angles[self.base]
        self.places = rays.places(self.base)
        before, behind = self.views_behind(-1), self.views_behind(1)
        turn = angles % (2 * math.pi)
        step = (turn[behind] - turn[before]) % (2 * math.pi)
        good = (step > 1e-9) & (step <= 2.0 * _GAP_STEPS * view_step(angles))
        step = np.where(good, step, 1.0)
        first = rays.window.first_column
        rate = (first[behind] - first[before]) / step
        self.near = torch.from_numpy(good)[:, None, None]
        self.step, self.rate = (torch.from_numpy(v)[:, None, None].float() for v in (step, rate))
        self._whole: dict[int, Tensor] = {}
        self._used: dict[int, NDArray[np.int64]] = {}

    @property
    def known(self) -> Tensor:
        """Which rays have a pair, ``(base, rows, columns)``."""
        return self.places.known

    def views_behind(self, way: int) -> NDArray[np.int64]:
        """The views so many places behind those of ``base``."""
        return self._order[(self._at + way) % self._order.size]

    def whole(self, columns: int) -> Tensor:
        """A slope reaches over neighbours: all of them must have a conjugate."""
        if columns not in self._whole:
            width = self.known.shape[-1]
            missing = F.pad((~self.known).cumsum(-1, dtype=torch.int32), (1, 0))
            at = torch.arange(width)
            first, end = (at - columns).clamp_min(0), (at + columns + 1).clamp_max(width)
            self._whole[columns] = missing[..., end] == missing[..., first]
        return self._whole[columns]

    def used(self, columns: int) -> NDArray[np.int64]:
        """Views in which a slope is known."""
        if columns not in self._used:
            self._used[columns] = np.flatnonzero(self.whole(columns).flatten(1).any(1).numpy())
        return self._used[columns]

    @cached_property
    def twice_fan_angles(self) -> Tensor:
        """What a conjugate's view moves by if fan angles grow, ``(base, 1, columns)``."""
        return torch.from_numpy(2.0 * self.rays.fan_angles(self.base))[:, None].float()

    @cached_property
    def turned_between(self) -> Tensor:
        """What it moves by if steps between views grow: the way from a reading's view to its
        conjugate's, ``(base, 1, columns)`` rad."""
        turned = unwrapped(self.rays.geometry.angles)
        way = sum(end.part * turned[end.views] for end in self.places.ends)
        return torch.from_numpy(way - turned[self.base][:, None])[:, None].float()


def _pairs_of(geometry: Any, window: DetectorWindow, about: tuple[float, float]) -> _Pairs:
    """Of small scans kept for the next one of the same geometry: there, looking for them costs as
    much as all else."""
    few = math.prod(window.shape) <= _SMALL
    return _kept_pairs(geometry, window, about) if few else _new_pairs(geometry, window, about)


def _new_pairs(geometry: Any, window: DetectorWindow, about: tuple[float, float]) -> _Pairs:
    return _Pairs(ConjugateRays(geometry, window, about))


_kept_pairs = lru_cache(maxsize=2)(_new_pairs)
