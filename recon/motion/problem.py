"""The readings of an inset that moves, and what volumes along a path leave of them."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from torch import Tensor

from recon.analytic.fbp import FbpPlan
from recon.motion.belief import evidence_of, likelihood_of
from recon.variable_projection import (
    Normal,
    misfit,
    normal_equations,
    smoothed_cells,
    unexplained,
)
from torchpcct.detector_window import DetectorWindow, footprint
from torchpcct.geometry import ConeBeam, VolumeGrid, project_points
from torchpcct.projector import Projector, with_parameters
from torchpcct.projector.posed import PosedEngine
from torchpcct.readings import MEDIAN_TO_SD
from torchpcct.scan import Scan

if TYPE_CHECKING:
    from torchpcct.typing import Floats

_VIEWS = 96
"""Views that neighbouring ones are averaged to: an inset of 5 mm then turns by 0.16 mm at its edge
within one."""
_MOST_VOXELS = 500_000
"""Of the working grid, whose voxels are as large as cells are seen at the inset; of a larger inset
they are larger."""
_INTERVALS = 4
"""Of the cubic spline in a scan; a coefficient per axis for each, and three more."""
_HARMONICS = 2
"""Of the heart's rate, if that is given."""
REACH_MM = 2.5
"""Largest displacement from the mean that is looked for."""
_TIMES = 2
"""How often what a volume explains is taken off, beside the first time."""
_SPEED = 3.0
"""Of the prior of a path over a scan, relative: speeds, 1 / scan."""
_BEND = 6.0
"""Of the same: changes of the speed, 1 / scan²."""
_SMOOTH_VOXELS = 1.0
"""Standard deviation by which the volume is smoothed before its effects are computed."""
_NOISES = 3.0
"""Voxels of no more than so many times their noise have no effect."""
_MODEL = 0.35
"""White noise that does to the path what errors of the model do (voxels, the cone's missing data),
over the readings' root mean square, of voxels as large as a cell. Without noise, 0.13 root mean
square over the directions of the path of 19 vessels."""
_COARSER = 3.0
"""Power of the voxel over the cell that errors of the model grow with."""
FLOOR_MM = 0.01
"""Of every standard error, and of a path that is applied: below, voxels and averaged views are as
likely the cause, and a prior that the readings chose themselves says too little of its error."""
_LEFT_MODEL = 0.0012
"""What errors of the model leave of the smoothed readings, mean square in units of their noise's
variance, over :attr:`MotionProblem.signal`; of the paper's plaque, at rest."""


class MotionProblem:
    """The readings of an inset, and what volumes that move leave of them.

    Attributes:
        basis: ``(views, k)`` of mean zero, of the scan's views; independent standard normal
            coefficients are the prior of a path of 1 mm², mean square, along one axis. With a jump
            one column more: 1 mm from a view on.
        smooth: columns of ``basis`` without the jump's.
        jump: first averaged view after the jump; None: no jump.
    """

    def __init__(self, scan: Scan, grid: VolumeGrid, rate: float | None) -> None:
        geometry = scan.geometry
        self._noise_free = scan.noise_free
        region = grid if scan.region is None else scan.region
        size = math.prod(region.extent) / _MOST_VOXELS
        spacing = max(geometry.cell, size ** (1.0 / 3.0))
        self._coarse = (spacing / geometry.cell) ** _COARSER
        self.grid = VolumeGrid(
            tuple(max(1, math.ceil(e / spacing - 1e-6)) for e in region.extent),
            spacing,
            region.center,
        )
        angles = np.unwrap(geometry.angles)
        groups = np.array_split(np.arange(geometry.views), min(_VIEWS, geometry.views))
        self._averaging = _averages(groups, geometry.views)
        self.geometry = replace(geometry, angles=self._averaging @ angles)
        self.basis = basis_of((angles - angles[0]) / (angles[-1] - angles[0]), rate)
        self.smooth = self.basis.shape[1]
        self.jump: int | None = None
        self._few = self._averaging @ self.basis
        self.window = self._window()
        window = scan.window
        assert window is not None
        around = window.take(scan.exterior_line_integrals())
        place, here = (_centre_columns(g, self.grid) for g in (geometry, self.geometry))
        shift = place - self._averaging.astype(bool).T @ here

        def averaged(values: Tensor, beyond: float | None, total: bool) -> Tensor:
            found = _aligned(values, window, self.window, groups, shift, beyond)
            counts = torch.tensor([len(g) for g in groups], dtype=found.dtype)
            return found * counts.view(-1, 1, 1) if total else found

        self.lines = averaged(scan.line_integrals().float() - around.float(), 0.0, False)
        self.weights = averaged(window.take(scan.exterior_weights()).float(), None, True)

    def _window(self) -> DetectorWindow:
        """The readings of the working grid wherever it may be."""
        g = self.geometry
        paths = [np.zeros(3)]
        paths += [sign * REACH_MM * np.eye(3)[axis] for axis in (1, 2) for sign in (-1, 1)]
        windows = [footprint(g, self.grid, 1, np.tile(p, (g.views, 1))) for p in paths]
        return DetectorWindow.union(windows, g.columns)

    @cached_property
    def signal(self) -> float:
        """Mean square of the inset's readings over their noise's."""
        found = float((self.lines.double().square() * self.weights).mean())
        return max(0.0, found - (0.0 if self._noise_free else 1.0))

    @property
    def inflation(self) -> float:
        """Variance of noise and model over that of noise alone, as the path meets it."""
        return 1.0 + (_MODEL * self._coarse) ** 2 * self.signal

    @property
    def left_by_model(self) -> float:
        """What errors of the model leave of the smoothed readings, mean square over the noise's."""
        return _LEFT_MODEL * self._coarse * self.signal

    def errors(self, covariance: Floats) -> Floats:
        """Standard errors ``(views, 3)`` mm of a path."""
        k = self.basis.shape[1]
        blocks = [covariance[a * k : (a + 1) * k, a * k : (a + 1) * k] for a in range(3)]
        variances = [np.einsum("vi,ij,vj->v", self.basis, b, self.basis) for b in blocks]
        return np.sqrt(np.maximum(np.stack(variances, 1), 0.0) + FLOOR_MM**2)

    def start(self) -> Floats:
        """Coefficients ``(k, 3)`` from the centres of mass of the readings."""
        g, (rows, columns) = self.geometry, self.window.shape[1:]
        y, w = (v.double().numpy() for v in (self.lines, self.weights))
        mass = y.sum((1, 2))
        if not abs(mass.mean()) > 3.0 * math.sqrt((1.0 / w).sum((1, 2)).mean() / len(mass)):
            return np.zeros((self._few.shape[1], 3))
        mass = np.full_like(mass, mass.mean())
        at_column = (
            self.window.first_column[:, None] - _centre_columns(g, self.grid)[:, None]
        ) + np.arange(columns)
        at_row = np.arange(rows) - (rows - 1) / 2
        cy, cx = self.grid.center[-2:]
        away = np.stack([cx - g.sod * np.cos(g.angles), cy - g.sod * np.sin(g.angles)], 1)
        distance = np.linalg.norm(away, axis=1)
        # Across the ray to the inset, along growing columns; (views, 3) z, y, x.
        across = np.stack([0 * distance, -away[:, 0], away[:, 1]], 1) / distance[:, None]
        sides = (
            (at_column[:, None, :], g.column_pitch, across),
            (at_row[None, :, None], g.row_pitch, np.tile([1.0, 0.0, 0.0], (len(mass), 1))),
        )
        left, right = [], []
        for at, pitch, direction in sides:
            to_mm = pitch * distance / g.sdd
            centre = (y * at).sum((1, 2)) / mass * to_mm
            noise = np.sqrt((np.broadcast_to(at, y.shape) ** 2 / w).sum((1, 2))) / mass * to_mm
            moved = direction[:, :, None] * self._few[:, None, :]  # (views, 3, k)
            rows_of = np.concatenate([moved.reshape(len(mass), -1), 10.0 * direction], 1)
            left.append(rows_of / np.abs(noise)[:, None])
            right.append(centre / np.abs(noise))
        a, b = np.concatenate(left), np.concatenate(right)
        found = np.linalg.solve(a.T @ a + np.eye(a.shape[1]), a.T @ b)
        return found[:-3].reshape(3, -1).T

    def path(self, coefficients: Floats) -> Floats:
        """``(views, 3)`` mm in the views of the scan."""
        return self.basis @ coefficients

    def _plan(self, kernel: str, motion: Floats) -> FbpPlan:
        return FbpPlan(self.geometry, [self.grid], kernel, motion=motion, window=self.window)

    def _volume(self, plan: FbpPlan, lines: Tensor) -> Tensor:
        return plan.backprojected(plan.filtered(lines, held=self.window))[0]

    def _left(self, motion: Floats) -> Callable[[Tensor], Tensor]:
        """What volumes that move leave of readings."""
        engine = Projector(self.geometry, self.grid, self.window, motion)
        plan = self._plan("ram-lak", motion)
        return lambda lines: unexplained(lines, partial(self._volume, plan), engine, _TIMES + 1)

    def misfits(self) -> tuple[float, float]:
        """What a volume at rest leaves of the readings, and of noise alone, over the noise."""
        noise = torch.randn(self.lines.shape, generator=torch.Generator().manual_seed(0))
        drawn = torch.stack([self.lines, noise / self.weights.sqrt()])
        found = smoothed_cells(self._left(np.zeros((self.geometry.views, 3)))(drawn), 2)
        rest, quiet = (misfit(f, self.weights, 2) for f in found)
        return rest, quiet

    def at(self, coefficients: Floats, effects: Effects | None = None) -> tuple[Normal, Effects]:
        """Equations for what is to be added to the coefficients, axis by axis, and the effects;
        ``effects``: of another state nearby, which are not computed again."""
        motion = np.ascontiguousarray(self._few @ coefficients)
        left = self._left(motion)
        rest = smoothed_cells(left(self.lines[None]), 2)
        if effects is None:
            posed = PosedEngine(
                with_parameters(self.geometry), self.grid, self.window, torch.from_numpy(motion)
            )
            # Source and detector move against the inset.
            tangents = torch.zeros(3, self.geometry.views, 4, 3, dtype=torch.float64)
            for axis in range(3):
                tangents[axis, :, :2, 2 - axis] = -1.0
            # Of a smoother volume: its noise must not be taken for edges that move.
            soft = self._volume(self._plan("soft", motion), self.lines)
            effects = Effects(posed.derivatives(_quiet(soft), tangents), left)
            effects = replace(effects, own=effects.over_time(self._few))
        effects = replace(effects, rest=rest)
        return normal_equations(effects.own.flatten(0, 1), rest, self.weights, 2), effects

    def first_view(self, view: int) -> int:
        """First view of the scan in an averaged view."""
        return int(np.argmax(self._averaging[view] > 0.0))

    def late(self, view: int) -> Floats:
        """``(views,)`` of mean zero: a displacement of 1 mm from an averaged view on."""
        found = self._averaging[view:].any(0).astype(np.float64)
        return found - found.mean()

    def with_jump(self, view: int) -> MotionProblem:
        """The same readings, of paths that may jump at an averaged view, too."""
        found = copy.copy(self)
        found.jump = view
        found.basis = np.column_stack([self.basis[:, : self.smooth], self.late(view)])
        found._few = self._averaging @ found.basis
        return found

    def gains(self, views: Sequence[int], at: Floats, effects: Effects) -> Floats:
        """By how much the evidence of paths that jump at one of some averaged views is above that
        of the paths of this problem.

        Args:
            views: the averaged views.
            at: coefficients of a path of this problem.
            effects: there.
        """
        k, smooth = self.basis.shape[1], [*range(self.smooth)]
        given = self._averaging @ np.stack([self.late(view) for view in views], 1)
        own = torch.cat([effects.own, effects.over_time(given)], 1)
        every = normal_equations(own.flatten(0, 1), effects.rest, self.weights, 2)
        several = np.vstack([at, np.zeros((1, 3))])
        found = []
        for m in range(len(views)):
            with_one = _part(every, [*range(k), k + m], own.shape[1])
            likelihood = likelihood_of(with_one, several, self.inflation)
            jumping = evidence_of(likelihood, [*smooth, k], jumps=True, round_only=True)
            now = evidence_of(likelihood, [*range(k)], jumps=k > self.smooth, round_only=True)
            found.append(jumping - now)
        return np.array(found)


@dataclass(frozen=True)
class Effects:
    """What the path does to the readings, near one path.

    Attributes:
        moved: ``(3, views, rows, columns)``, by a displacement of 1 mm in every view.
        left: what volumes along the path leave of readings.
        own: ``(3, k, views, rows, columns)``, what they leave of the coefficients' effects,
            smoothed.
        rest: ``(1, views, rows, columns)``, and of the readings.
    """

    moved: Tensor
    left: Callable[[Tensor], Tensor]
    own: Tensor = field(default_factory=lambda: torch.empty(0))
    rest: Tensor = field(default_factory=lambda: torch.empty(0))

    def over_time(self, paths: Floats) -> Tensor:
        """:attr:`own` of other paths ``(views, m)`` along each axis."""
        given = torch.from_numpy(np.ascontiguousarray(paths.T, dtype=np.float32))
        effects = self.moved[:, None] * given[None, :, :, None, None]
        return smoothed_cells(self.left(effects.flatten(0, 1)), 2).unflatten(0, (3, len(given)))


def _part(found: Normal, columns: Sequence[int], of: int) -> Normal:
    """The equations of some columns of a path's basis, of all ``of``."""
    at = np.concatenate([np.add(axis * of, columns) for axis in range(3)])
    information, spread = (m[np.ix_(at, at)] for m in (found.information, found.spread))
    return Normal(information, found.pull[at], spread, found.misfit)


def _quiet(volume: Tensor) -> Tensor:
    """Smoothed, and what is no more than its noise shrunk to nothing (non-negative garrote; Breiman
    1995, Technometrics 37:373): effects of noise would be found again in the readings' noise."""
    soft = torch.from_numpy(gaussian_filter(volume.numpy(), _SMOOTH_VOXELS, mode="nearest"))
    noise = MEDIAN_TO_SD * soft.abs().median()
    return soft * (1.0 - (_NOISES * noise / soft.abs().clamp_min(1e-12)).square()).clamp_min(0.0)


def basis_of(times: Floats, rate: float | None) -> Floats:
    """Of paths over ``times`` 0…1, or of harmonics of ``rate`` per scan: ``(views, k)``."""
    fine = np.linspace(0.0, 1.0, 401)
    if rate is None:
        from scipy.interpolate import BSpline

        knots = np.concatenate([[0.0] * 3, np.linspace(0, 1, _INTERVALS + 1), [1.0] * 3])
        spline = BSpline(knots, np.eye(_INTERVALS + 3), 3)
        given, speed, bend = spline(times), spline(fine, 1), spline(fine, 2)
    else:
        turns = 2.0 * math.pi * rate * np.arange(1, _HARMONICS + 1)

        def waves(order: int, t: Floats) -> Floats:
            late = order * math.pi / 2
            phase = t[:, None] * turns + late
            return np.concatenate([np.cos(phase), np.sin(phase)], 1) * np.tile(turns**order, 2)

        given, speed, bend = waves(0, times), waves(1, fine), waves(2, fine)
    given = given - given.mean(0)
    cost = (speed.T @ speed / _SPEED**2 + bend.T @ bend / _BEND**2) / len(fine)
    # A constant costs nothing and does nothing.
    values, vectors = np.linalg.eigh(cost)
    kept = values > 1e-9 * values[-1]
    white = given @ (vectors[:, kept] / np.sqrt(values[kept]))
    return white / math.sqrt((white**2).sum(1).mean())


def _averages(groups: list[NDArray[np.int64]], views: int) -> Floats:
    """``(groups, views)``, the mean over each group."""
    found = np.zeros((len(groups), views))
    for k, group in enumerate(groups):
        found[k, group] = 1.0 / len(group)
    return found


def _centre_columns(geometry: ConeBeam, grid: VolumeGrid) -> Floats:
    """Where the middle of a grid falls in every view, in columns."""
    cy, cx = grid.center[-2:]
    position, _ = project_points(geometry, cx, cy)
    return np.asarray((position - geometry.column_positions[0]) / geometry.column_pitch)


def _aligned(
    values: Tensor,
    held: DetectorWindow,
    wanted: DetectorWindow,
    groups: list[NDArray[np.int64]],
    shift: Floats,
    beyond: float | None,
) -> Tensor:
    """Means over groups of views, each moved along the columns so that what lies at the grid's
    middle stays in place.

    Args:
        values: ``(views, rows, columns)`` on ``held``.
        wanted: the window of the means, one view a group; its rows are among those held.
        shift: ``(views,)`` columns.
        beyond: value of what is not held; None: of its neighbour.
    """
    row = wanted.first_row - held.first_row
    kept = values[:, row : row + wanted.rows]
    out = values.new_zeros(len(groups), wanted.rows, wanted.columns)
    for k, group in enumerate(groups):
        for view in group:
            at = wanted.first_column[k] + shift[view] - held.first_column[view]
            first, part = math.floor(at), at - math.floor(at)
            columns = first + torch.arange(wanted.columns + 1)
            inside = (columns >= 0) & (columns < held.columns)
            found = kept[view][:, columns.clamp(0, held.columns - 1)]
            if beyond is not None:
                found = torch.where(inside, found, beyond)
            out[k] += (1.0 - part) * found[:, :-1] + part * found[:, 1:]
        out[k] /= len(group)
    return out
