"""Does a full turn agree with itself? Opposite rays see one line, so a wrong rotation centre shows without an image.

The ray of source angle β and fan angle γ is met again by that of β + π − 2γ and −γ. If the columns are described ε
above where they are, the two lie 2ε apart (the consistency condition behind the moments of Helgason and Ludwig, of
which the first is the sinusoid of the centre of mass). Their difference r is regressed on the slope t of the readings
along the columns, r = −2 ε t + noise. The slopes of the two rays have independent noise, so the product of one's,
smoothed, and the other's, raw, neither shrinks nor stretches the estimate (instrumental variables, Durbin 1954, Rev.
Int. Stat. Inst. 22:23). Its error is that of the sums
over blocks of views, which knows nothing of how noisy a reading is: the test statistic is Student's.

An object that moves during the turn stands elsewhere when the opposite ray comes: ε then changes with β. Of a movement
c(β) along the columns, opposite rays show c(β) + c(β + π), so once in a turn looks like an object that stands elsewhere
and is none of our business; twice in a turn is what is tested, a wave cos 2β, sin 2β of ε.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from torchpcct.detector_window import DetectorWindow
from torchpcct.geometry import ConeBeam, Geometry, ParallelBeam, view_step
from torchpcct.validate import coverage

__all__ = ["CENTRE_TOLERANCE", "CentreTest", "centre_test"]

CENTRE_TOLERANCE = 0.1
"""Error of the centre in columns that is no finding: alignment, and what interpolation between the views leaves."""
FALSE_ALARMS = 0.005
"""Share of scans with an error of :data:`CENTRE_TOLERANCE` that are taken for wrong; of faultless ones it is less."""
_BLOCKS = 24
# Readings whose opposites are looked up; more only cost time.
_MOST = 1_000_000
# Views beside an opposite angle that are farther apart than so many usual steps do not stand for it.
_GAP_STEPS = 3.0
_ROWS, _COLUMNS = 9, (5, 25)
"""Readings over which the slope is smoothed: a few columns for small errors, many for those of several columns."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class CentreTest:
    """Result of :func:`centre_test`.

    Attributes:
        columns: how many columns too high the described positions of the columns are; NaN: not known.
        error: its standard error.
        swing: amplitude in columns by which it changes twice in a turn; NaN: not known.
        p_value: probability that noise alone looks like an error (or swing) beyond :data:`CENTRE_TOLERANCE` at least so
            much.
        findings: what was found, in words; empty: nothing at the stated rate of false alarms.
    """

    columns: float
    error: float
    swing: float
    p_value: float
    findings: tuple[str, ...]


_UNKNOWN = CentreTest(math.nan, math.inf, math.nan, 1.0, ())


def centre_test(
    lines: Tensor,
    geometry: Geometry,
    window: DetectorWindow | None = None,
    about: tuple[float, float] = (0.0, 0.0),
    false_alarms: float = FALSE_ALARMS,
) -> CentreTest:
    """Compare the opposite rays of a scan, of a cone beam those near the plane of the source.

    Args:
        lines: line integrals ``(views, [rows,] columns)`` of any unit, on ``window``, what all views share taken off.
            Views in any order.
        geometry: parallel, fan or cone beam.
        window: of the readings; None: the whole detector.
        about: (y, x) in mm of what the readings show: views are interpolated along its path.
        false_alarms: share of scans with an error of :data:`CENTRE_TOLERANCE` that raise an alarm.

    Returns:
        The test; with ``p_value`` 1 and no finding where no opposite rays were measured or nothing is to be seen.

    Raises:
        ValueError: a wrong shape, NaN or Inf, a rate outside (0, 1).
    """
    coverage("false_alarms", false_alarms)
    window = DetectorWindow.full(geometry) if window is None else window
    expected = window.shape if isinstance(geometry, ConeBeam) else (window.views, window.columns)
    if tuple(lines.shape) != expected or window.views != geometry.views:
        raise ValueError(f"lines must have the shape {expected}, got {tuple(lines.shape)}")
    values = lines.detach().to("cpu", torch.float32).reshape(window.shape)
    if not bool(torch.isfinite(values).all()):
        raise ValueError("lines hold NaN or Inf: bridge dead readings before (torchpcct.dead_cells.bridge)")
    if isinstance(geometry, ConeBeam):
        window, values = _flat_part(geometry, window, values)
    if values.shape[1] == 0:
        return _UNKNOWN
    rays = _Rays(geometry, window, about)
    stride = max(1, math.ceil(values.numel() / _MOST))
    base = np.argsort(geometry.angles % (2 * math.pi), kind="stable")[::stride]
    here = values[torch.from_numpy(base)]
    opposite, known = rays.opposite(values, base)
    difference = here - opposite
    turn = 2.0 * geometry.angles[base]
    found = []
    for columns in _COLUMNS:
        smooth, raw = ([_slope(v, *size) for v in (here, opposite)] for size in ((_ROWS, columns), (1, columns // 5)))
        # A slope reaches over neighbours: all of them must have an opposite.
        whole = -F.max_pool2d((-known.float())[:, None], (1, 2 * columns + 1), 1, (0, columns))[:, 0] > 0.5
        score = torch.where(whole, -difference * (smooth[0] + smooth[1]) / 2, 0.0).double().sum((1, 2)).numpy()
        power = torch.where(whole, smooth[0] * raw[1] + smooth[1] * raw[0], 0.0).double().sum((1, 2)).numpy()
        used = np.flatnonzero(whole.flatten(1).any(1).numpy())
        if used.size < _BLOCKS:
            continue
        parts = (score, power, power * np.cos(turn), power * np.sin(turn))
        sums = [np.array([v[b].sum() for b in np.array_split(used, _BLOCKS)]) for v in parts]
        found.append(_tested(sums[0], sums[1], np.stack(sums[1:], 1), false_alarms / len(_COLUMNS)))
    return next((f for f in found if f.findings), found[0] if found else _UNKNOWN)


def _flat_part(geometry: ConeBeam, window: DetectorWindow, values: Tensor) -> tuple[DetectorWindow, Tensor]:
    """The rows whose opposite rays part by less than two cells over what the window shows."""
    row, column = geometry.pitch
    reach = window.columns * column / geometry.magnification / 2
    flat = np.abs(geometry.row_positions) <= max(1.0, 2.0 * geometry.sod / reach) * row
    kept = np.flatnonzero(flat[window.first_row : window.first_row + window.rows])
    if kept.size == 0:
        return window, values[:, :0]
    first, count = int(kept[0]), int(kept[-1] - kept[0] + 1)
    return window.with_rows(window.first_row + first, count), values[:, first : first + count]


def _tested(score: Floats, power: Floats, waves: Floats, false_alarms: float) -> CentreTest:
    from scipy import stats

    if power.sum() <= 0.0:
        return _UNKNOWN
    size = float(score.sum() / power.sum())

    def deviation(of: float) -> tuple[float, float]:
        left = score - of * power
        spread = float(left.std(ddof=1)) * math.sqrt(left.size)
        return float(left.sum()), max(spread, float(np.finfo(np.float64).tiny))

    error = deviation(size)[1] / float(power.sum())
    total, spread = deviation(math.copysign(CENTRE_TOLERANCE, size))
    beyond = max(math.copysign(1.0, size) * total / spread, 0.0)
    centre = float(min(1.0, 2.0 * stats.t.sf(beyond, score.size - 1)))
    swing, swinging = _swing(score, waves)
    findings = []
    if centre < false_alarms / 2 and abs(size) > CENTRE_TOLERANCE:
        findings.append(
            f"opposite rays disagree: the geometry puts the columns about {abs(size):.2f} ± {error:.2g} columns too "
            f"{'high' if size > 0 else 'low'}: the rotation centre (the detector's column offset) is wrong, or the "
            "object moved"
        )
    if swinging < false_alarms / 2:
        findings.append(
            f"opposite rays disagree by {swing:.2f} columns to either side in the course of a turn: the object moved, "
            "or the angles of the views are wrong"
        )
    return CentreTest(size, error, swing, min(1.0, 2.0 * min(centre, swinging)), tuple(findings))


def _swing(score: Floats, waves: Floats) -> tuple[float, float]:
    """Amplitude of the second and third of ``waves`` ``(blocks, 3)`` in the scores, and its p-value.

    Blocks enter with the same weight but for their power: what noise leaves has the variance of the residuals.
    """
    from scipy import stats

    scale = np.abs(waves[:, :1]).mean()
    design, y = waves / scale, score / scale
    if np.linalg.cond(design) > 20.0:
        return math.nan, 1.0  # a part of the turn: the wave is not told from the constant
    found, left = np.linalg.lstsq(design, y, rcond=None)[:2]
    count = y.size - 3
    covariance = np.linalg.inv(design.T @ design)[1:, 1:] * max(float(left.sum()) / count, np.finfo(np.float64).tiny)
    amplitude = float(np.hypot(*found[1:]))
    if amplitude <= CENTRE_TOLERANCE:
        return amplitude, 1.0
    rest = found[1:] * (1.0 - CENTRE_TOLERANCE / amplitude)
    return amplitude, float(stats.f.sf(rest @ np.linalg.solve(covariance, rest) / 2.0, 2, count))


def _slope(values: Tensor, rows: int, columns: int) -> Tensor:
    """Central difference along the columns, averaged over ``rows`` (of a smaller stack less) × ``columns`` (odd)."""
    rows = min(rows, 2 * ((values.shape[1] - 1) // 2) + 1)
    kernel = torch.zeros(1, 1, rows, columns + 2)
    for k in range(columns):
        kernel[..., k] -= 0.5
        kernel[..., k + 2] += 0.5
    padded = F.pad(values[:, None], ((columns + 1) // 2,) * 2 + (rows // 2,) * 2, mode="replicate")
    return F.conv2d(padded, kernel / (rows * columns))[:, 0]


class _Rays:
    """Where the opposite of a reading lies: view, row and column, all fractional."""

    def __init__(self, geometry: Any, window: DetectorWindow, about: tuple[float, float]) -> None:
        self.geometry, self.window = geometry, window
        self.parallel = isinstance(geometry, ParallelBeam)
        u = geometry.column_positions
        self.start, self.step = float(u[0]), float(u[1] - u[0]) if u.size > 1 else 1.0
        self.rows = geometry.row_positions if isinstance(geometry, ConeBeam) else np.zeros(1)
        y, x = about
        self.radius, self.polar = math.hypot(x, y), math.atan2(y, x)

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
        gamma = (g.column_positions if self.parallel else g.fan_angles)[w.column_indices[base]]
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
