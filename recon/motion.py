"""Motion of an inset, estimated from its own scan, with an interval and a test.

What lies in the inset moves rigidly along a smooth path; its exterior is known and stands still.
The path is found together with the volume by variable projection
(:mod:`recon.variable_projection`): FBP along the present path gives the volume, the derivatives of
its projections by the displacement in every view are what the path does to the readings, and what
another volume would explain of them is taken off.

**Start.** The centre of mass of what is left when the exterior is taken off moves on the detector
as the inset does, whatever the inset looks like (the first of the consistency conditions of
Helgason and Ludwig). A path fitted to it does not sit in the local minimum of no motion.

**What a turn holds.** A view sees the displacement across its rays, not along them. What a path
does along the rays of every view is told by its smoothness alone: a Gaussian prior on speed and
acceleration. How large the motion is and whether it goes to and fro along a line, the readings tell
by their marginal likelihood (MacKay 1992, Neural Comput. 4:415), and seldom for certain: path and
errors are means over all sizes and directions, each as likely as the readings make it (Bayesian
model averaging, Hoeting et al. 1999, Stat. Sci. 14:382). The one likeliest prior would take a line
for certain and state errors along the rays that are several times too small. A constant
displacement is another volume; the path's mean is zero.

**A jump** is no smooth path, but one that differs along the rays often explains its readings, and
is then wrong by as much as the jump. Paths that may jump at one view, too, are compared with the
smooth ones by their marginal likelihood: a smooth path that does what a jump does is large and
bent, and therefore less likely.

**Voxels** of the working grid are no larger than a detector cell as it is seen at the inset. What
larger ones cannot show looks like motion along the rays, and is more than the noise.
"""

from __future__ import annotations

import copy
import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from torch import Tensor

from recon.analytic.fbp import FbpPlan
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
from torchpcct.validate import checked, number
from torchpcct.vector_geometry import check_motion

if TYPE_CHECKING:
    from torchpcct.typing import JsonObject

__all__ = ["InsetMotion", "Jump", "PathTooLongError", "estimate_motion", "path_of"]

_LOG = logging.getLogger(__name__)
Floats = NDArray[np.float64]

_VIEWS = 96
"""Views that neighbouring ones are averaged to: an inset of 5 mm then turns by 0.16 mm at its edge
within one."""
_LEAST_VIEWS = 48
"""Fewer views a turn leave streaks that pass for motion."""
_MOST_VOXELS = 500_000
"""Of the working grid, whose voxels are as large as cells are seen at the inset; of a larger inset
they are larger."""
_INTERVALS = 4
"""Of the cubic spline in a scan; a coefficient per axis for each, and three more."""
_HARMONICS = 2
"""Of the heart's rate, if that is given."""
_REACH_MM = 2.5
"""Largest displacement from the mean that is looked for."""
_REACH_ALONG_MM = 1.0
"""Farthest from the mean along the axis of the turn. A vessel along it shows little of such a
motion: one that moved by 1.2 mm, 0.75 from its mean, was followed, of 2 mm the path was wrong by
more than the motion (the case "along z" of ``torchpcct study motion``)."""
_TIMES = 2
"""How often what a volume explains is taken off, beside the first time."""
_STEPS = 6
"""Most iterations."""
_SETTLED = 0.5
"""Change of the path in the last step over its standard error, root mean squares."""
_NEAR_MM = 0.05
"""Change below which the effects of the path are not computed again."""
_LARGEST_STEP_MM = 0.7
"""Of one iteration."""
_SPEED = 3.0
"""Of the prior of a path over a scan, relative: speeds, 1 / scan."""
_BEND = 6.0
"""Of the same: changes of the speed, 1 / scan²."""
_SIZES_MM = (0.02, 0.05, 0.1, 0.2, 0.4, 0.8)
"""Of the prior's motion across the axis of the scanner, root mean squares."""
_HEIGHTS_MM = (0.003, 0.02, 0.05, 0.1, 0.2, 0.4, 0.8)
"""Of the same along the axis."""
_WIDTHS = {1.0: 1, 0.3: 12, 0.1: 24}
"""Smaller extent of the prior's motion across the axis over its larger one, and how many directions
of the larger one are tried: a line is an ellipse of a tenth."""
_LEAST_MM = 0.003
"""Of the prior's scale along any direction."""
_JUMPS_MM = (0.1, 0.3, 0.9)
"""Of the prior's jump along each axis, standard deviations."""
_JUMP_VIEWS = 8
"""Averaged views from one place where a jump is looked for to the next; about the best one it is
looked for at every view."""
_JUMP_REACH = 2
"""Averaged views by which a jump may be found elsewhere once the path has it."""
_JUMP_TIMES = 3
"""Places of a jump that the path is followed with, at most."""
_JUMP_EVIDENCE = 8.0
"""Logarithm of the marginal likelihood's ratio to the smooth path, from which on a jump is
believed. Of six smooth motions it is -5 to -3, of six jumps 30 to 900."""
_NEGLIGIBLE = 1e-7
"""Share of the whole below which a prior does nothing."""
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
_LEAST_EVIDENCE = 6.0
"""Logarithm of the marginal likelihood's ratio to rest, from which on a motion is believed."""
_FLOOR_MM = 0.01
"""Of every standard error, and of a path that is applied: below, voxels and averaged views are as
likely the cause, and a prior that the readings chose themselves says too little of its error."""
_LEFT_MODEL = 0.0012
"""What errors of the model leave of the smoothed readings, mean square in units of their noise's
variance, over :attr:`_MotionProblem.signal`; of the paper's plaque, at rest."""
_ANOTHER = 3.0
"""Times that, beside what noise leaves, from which on something else moves."""
_CHANCE = 1.05
"""Times what a draw of the noise leaves, from which on another draw is not the cause."""


class PathTooLongError(ValueError):
    """The inset moves further than is looked for, or too little of it can be seen to tell."""


@dataclass(frozen=True)
class Jump:
    """A displacement at once.

    Attributes:
        view: first view of the scan after it.
        mm: ``(3,)`` z, y, x.
        errors: ``(3,)`` standard errors.
    """

    view: int
    mm: Floats
    errors: Floats

    @property
    def length(self) -> float:
        """Of the displacement, mm."""
        return float(np.linalg.norm(self.mm))

    @property
    def error(self) -> float:
        """Standard error of :attr:`length`."""
        return float(np.linalg.norm(self.mm * self.errors)) / max(self.length, 1e-12)

    def report(self) -> JsonObject:
        """All numbers, for JSON."""
        return {
            "view": self.view,
            "mm": np.round(self.mm, 4).tolist(),
            "errors_mm": np.round(self.errors, 4).tolist(),
        }


@dataclass(frozen=True)
class InsetMotion:
    """Result of :func:`estimate_motion`.

    Attributes:
        path: ``(views, 3)`` z, y, x mm, displacement of the inset in every view of the scan, of
            mean zero; zeros if no motion is held.
        errors: ``(views, 3)`` standard errors of the path that was found, applied or not.
        held: whether the readings hold a motion.
        evidence: logarithm of the marginal likelihood of the motion over that of rest.
        rms_mm: root mean square displacement of the path that was found, applied or not.
        misfit: what is left of the smoothed readings over their noise, root mean square, at rest
            and along ``path``.
        steps: iterations done.
        warnings: what restrains trust in the result.
        jump: that the path has, if the readings hold one; None: the path is smooth.
    """

    path: Floats
    errors: Floats
    held: bool
    evidence: float
    rms_mm: float
    misfit: tuple[float, float]
    steps: int
    warnings: list[str] = field(default_factory=list)
    jump: Jump | None = None

    def report(self) -> JsonObject:
        """All numbers, for JSON."""
        return {
            "held": self.held,
            "rms_mm": self.rms_mm,
            "evidence": self.evidence,
            "misfit": list(self.misfit),
            "steps": self.steps,
            "path_mm": np.round(self.path, 4).tolist(),
            "errors_mm": np.round(self.errors, 4).tolist()
            if np.isfinite(self.errors).all()
            else None,
            "jump": None if self.jump is None else self.jump.report(),
        }


class _MotionProblem:
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
        self.basis = _basis((angles - angles[0]) / (angles[-1] - angles[0]), rate)
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
        paths += [sign * _REACH_MM * np.eye(3)[axis] for axis in (1, 2) for sign in (-1, 1)]
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
        return np.sqrt(np.maximum(np.stack(variances, 1), 0.0) + _FLOOR_MM**2)

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

    def at(self, coefficients: Floats, effects: _Effects | None = None) -> tuple[Normal, _Effects]:
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
            effects = _Effects(posed.derivatives(_quiet(soft), tangents), left)
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

    def with_jump(self, view: int) -> _MotionProblem:
        """The same readings, of paths that may jump at an averaged view, too."""
        found = copy.copy(self)
        found.jump = view
        found.basis = np.column_stack([self.basis[:, : self.smooth], self.late(view)])
        found._few = self._averaging @ found.basis
        return found

    def gains(self, views: Sequence[int], at: Floats, effects: _Effects) -> Floats:
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
            likelihood = _likelihood(with_one, several, self.inflation)
            jumping = _evidence(likelihood, [*smooth, k], jumps=True, round_only=True)
            now = _evidence(likelihood, [*range(k)], jumps=k > self.smooth, round_only=True)
            found.append(jumping - now)
        return np.array(found)


@dataclass(frozen=True)
class _Effects:
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


def _basis(times: Floats, rate: float | None) -> Floats:
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


@dataclass(frozen=True)
class _Belief:
    """What the readings and the prior say of the coefficients ``(k, 3)``, flattened axis by axis.

    Attributes:
        mean, covariance: of the coefficients.
        evidence: logarithm of the marginal likelihood over that of rest.
        gain: of that by the jump; 0 without one.
    """

    mean: Floats
    covariance: Floats
    evidence: float
    gain: float = 0.0


def _believed(found: Normal, at: Floats, inflation: float, jumps: bool = False) -> _Belief:
    """The coefficients under normal priors of all sizes and directions, weighted by how likely the
    readings are under each; the covariance holds how far their means differ.

    Args:
        found: equations about ``at``.
        at: ``(k, 3)``.
        jumps: whether the last of the k is a jump.
    """
    k = len(at)
    precision, pull = _likelihood(found, at, inflation)
    prior, shares = _priors(k - jumps, jumps)
    means, evidence = _weighed(precision, pull, prior, shares)
    top = float(evidence.max())
    weights = np.exp(evidence - top)
    total = float(weights.sum())
    likely = weights > _NEGLIGIBLE * total
    weights, means = weights[likely] / weights[likely].sum(), means[likely]
    covariances = np.linalg.solve(np.eye(3 * k) + prior[likely] @ precision, prior[likely])
    mean = weights @ means
    apart = means - mean
    covariance = np.einsum("m,mij->ij", weights, covariances) + (apart.T * weights) @ apart
    whole = top + math.log(total)
    gain = whole - _evidence((precision, pull), range(k - 1)) if jumps else 0.0
    return _Belief(mean.reshape(3, k).T, 0.5 * (covariance + covariance.T), whole, gain)


def _likelihood(found: Normal, at: Floats, inflation: float) -> tuple[Floats, Floats]:
    """Precision and pull of the coefficients by the readings alone, about zero."""
    h = found.information
    unit = np.sqrt(np.maximum(np.diag(h), 1e-300))
    spread = found.spread * inflation / np.outer(unit, unit)
    inverse = np.linalg.pinv(spread, rcond=1e-6, hermitian=True) / np.outer(unit, unit)
    return h @ inverse @ h, h @ inverse @ (found.pull + h @ at.T.ravel())


def _weighed(
    precision: Floats, pull: Floats, prior: Floats, shares: Floats
) -> tuple[Floats, Floats]:
    """Means ``(n, 3 k)`` under each prior, and logarithms of how likely the readings are under it
    over rest, times its share."""
    matrix = np.eye(len(pull)) + prior @ precision
    means = np.asarray(np.linalg.solve(matrix, (prior @ pull)[..., None])[..., 0], np.float64)
    evidence = 0.5 * means @ pull - 0.5 * np.linalg.slogdet(matrix)[1] + np.log(shares)
    return means, np.asarray(evidence, np.float64)


def _evidence(
    likelihood: tuple[Floats, Floats],
    columns: Sequence[int],
    jumps: bool = False,
    round_only: bool = False,
) -> float:
    """Logarithm of the marginal likelihood over that of rest, of paths of some columns only; for
    ``jumps`` and ``round_only`` see :func:`_priors`."""
    precision, pull = likelihood
    at = np.arange(len(pull)).reshape(3, -1)[:, columns].ravel()
    priors = _priors(len(columns) - jumps, jumps, round_only)
    found = _weighed(precision[np.ix_(at, at)], pull[at], *priors)[1]
    return float(np.logaddexp.reduce(found))


@cache
def _priors(k: int, jumps: bool, round_only: bool = False) -> tuple[Floats, Floats]:
    """Covariances ``(n, 3 k, 3 k)`` of the coefficients of ``k`` columns, axis by axis, and how
    likely each is before any reading; ``jumps``: of one column more. ``round_only``: of no
    direction in the plane."""
    found, shares = [], []
    for width, ways in ({1.0: 1} if round_only else _WIDTHS).items():
        for way in math.pi * np.arange(ways) / ways:
            along = np.array([math.sin(way), math.cos(way)])
            across = np.array([math.cos(way), -math.sin(way)])
            shape = np.outer(along, along) + width**2 * np.outer(across, across)
            for size, height in product(_SIZES_MM, _HEIGHTS_MM):
                one = np.zeros((3, 3))
                one[0, 0] = height**2
                one[1:, 1:] = size**2 * shape + _LEAST_MM**2 * np.eye(2)
                found.append(one)
                shares.append(1.0 / ways)
    between, likely = np.stack(found), np.array(shares) / sum(shares)
    if not jumps:
        return np.einsum("mij,kl->mikjl", between, np.eye(k)).reshape(-1, 3 * k, 3 * k), likely
    whole = np.zeros((len(_JUMPS_MM), len(between), 3, k + 1, 3, k + 1))
    whole[:, :, :, :k, :, :k] = np.einsum("mij,kl->mikjl", between, np.eye(k))
    for size, one in zip(_JUMPS_MM, whole, strict=True):
        one[:, :, k, :, k] = size**2 * np.eye(3)
    n = 3 * (k + 1)
    return whole.reshape(-1, n, n), np.tile(likely, len(_JUMPS_MM)) / len(_JUMPS_MM)


@checked
def estimate_motion(
    scan: Scan,
    grid: VolumeGrid,
    *,
    heart_rate: float | None = None,
    rotation_s: float | None = None,
    progress: Callable[[float], None] | None = None,
) -> InsetMotion:
    """The rigid displacement of what lies in an inset, in every view, from its own readings.

    Args:
        scan: counting, one channel, of a cone beam on a circle, acquired with ``region``: the
            exterior is known, all else lies in the region at all times.
        grid: ``(z, y, x)`` grid of the inset; the working grid covers the scan's region.
        heart_rate: beats a minute; the path then repeats itself with every beat and does not jump.
            None: any smooth path, a cubic spline, with one jump if the readings hold one.
        rotation_s: time of one turn in s, for ``heart_rate``.
        progress: called with the finished fraction, 0…1.

    Returns:
        The path with standard errors, and whether the readings hold it; if not, the path is zero
        and ``warnings`` say so. A jump is reported there, too. The errors are those of noise, of a
        model of voxels and of what no view sees, under the prior.

    Raises:
        ValueError: an unknown exterior, energy bins, another geometry, fewer than 48 views, a
            heart's rate without the time of a turn. PathTooLongError: a path that leads further
            than 2.5 mm away from its mean, or than 1 mm along the axis.
        TypeError: no :class:`torchpcct.Scan`.
    """
    _require_inset(scan)
    problem = _MotionProblem(scan, grid, _beats(scan, heart_rate, rotation_s))
    tell = progress or (lambda _: None)
    rest, quiet = problem.misfits()
    found = _followed(problem, problem.start(), tell)
    if found is None:
        return _none(problem, rest)
    if heart_rate is None and found.belief.evidence >= _LEAST_EVIDENCE:
        found = _with_jump(found)
    path, errors, belief = found.path, found.errors, found.belief
    size, error = _rms(path), _rms(errors)
    held = belief.evidence >= _LEAST_EVIDENCE and size > max(_FLOOR_MM, error)
    along = float(np.abs(path[:, 0]).max())
    if held and along > _REACH_ALONG_MM:
        raise PathTooLongError(
            f"the path that fits leads {along:.2g} mm away from its mean along the axis, more than "
            f"the {_REACH_ALONG_MM:g} mm up to which such a path can be trusted: give the "
            "displacement in every view, motion=path, or reconstruct a part of the turn"
        )
    after = found.problem.at(found.coefficients, found.effects)[0].misfit if held else rest
    jump = found.jump if held else None
    texts = []
    if not held:
        texts.append(
            "the readings hold no motion of the inset: the path that fits best has "
            f"{size:.2g} ± {error:.2g} mm, root mean square; none is applied"
        )
    if jump is not None:
        texts.append(
            f"the inset jumps by {jump.length:.2g} ± {jump.error:.2g} mm at view {jump.view} of "
            f"{len(path)}: its motion is not smooth; the path holds the jump"
        )
    if after**2 > _CHANCE * quiet**2 + _ANOTHER * problem.left_by_model:
        texts.append(
            "what the inset leaves of the readings along the path is more than noise "
            f"({after:.2g} times): it does not move as one rigid body along one path, parts of "
            "it may move differently, turn or jump"
        )
    for text in texts:
        _LOG.warning("%s", text)
    tell(1.0)
    return InsetMotion(
        path if held else np.zeros_like(path),
        errors,
        held,
        belief.evidence,
        size,
        (rest, after),
        found.steps,
        texts,
        jump,
    )


@dataclass(frozen=True)
class _Found:
    """A path that was followed to where it does not change any more.

    Attributes:
        problem: whose coefficients they are.
        before: coefficients about which the last equations were.
        coefficients: of the path.
        belief: of the last equations.
        effects: of ``before``, of the last equations.
        steps: iterations done.
    """

    problem: _MotionProblem
    before: Floats
    coefficients: Floats
    belief: _Belief
    effects: _Effects
    steps: int

    @property
    def path(self) -> Floats:
        return self.problem.path(self.coefficients)

    @property
    def errors(self) -> Floats:
        return self.problem.errors(self.belief.covariance)

    @property
    def jump(self) -> Jump | None:
        """The jump of the path, if it may have one."""
        if self.problem.jump is None:
            return None
        k = len(self.coefficients)
        last = np.arange(3) * k + k - 1
        return Jump(
            self.problem.first_view(self.problem.jump),
            self.coefficients[-1],
            np.sqrt(np.diag(self.belief.covariance)[last] + _FLOOR_MM**2),
        )


def _followed(
    problem: _MotionProblem,
    at: Floats,
    tell: Callable[[float], None] = lambda _: None,
    before: int = 0,
) -> _Found | None:
    """Gauss and Newton's iterations from coefficients; None: the inset shows nothing.

    Args:
        tell: called with the finished fraction.
        before: iterations done before.

    Raises:
        PathTooLongError: a path longer than is looked for.
    """
    effects: _Effects | None = None
    for step in range(1, _STEPS + 1):
        found, now = problem.at(at, effects)
        if not np.diag(found.information).max() > 0.0:
            return None
        belief = _believed(found, at, problem.inflation, problem.jump is not None)
        change = problem.path(belief.mean - at)
        largest = float(np.abs(change).max())
        here = at
        at = at + (belief.mean - at) / max(1.0, largest / _LARGEST_STEP_MM)
        farthest = float(np.abs(problem.path(at)).max())
        if farthest > _REACH_MM:
            raise PathTooLongError(
                f"the path that fits leads {farthest:.2g} mm away from its mean, more than the "
                f"{_REACH_MM:g} mm that are looked for: the inset moves too far in this scan, or "
                "what it holds is too faint for its motion to be found"
            )
        effects = now if largest < _NEAR_MM else None
        tell(step / (_STEPS + 1))
        if _rms(change) < _SETTLED * _rms(problem.errors(belief.covariance)):
            break
    return _Found(problem, here, at, belief, now, before + step)


def _with_jump(smooth: _Found) -> _Found:
    """The path with a jump where that makes the readings much likelier, or as it is."""
    views = range(_JUMP_VIEWS, smooth.problem.geometry.views, _JUMP_VIEWS)
    gain, view = _likeliest(smooth, views)
    if gain <= _JUMP_EVIDENCE:
        return smooth
    finer, near = _likeliest(smooth, _about(smooth, view, _JUMP_VIEWS // 2))
    view = near if finer > gain else view
    found = smooth
    start = np.vstack([smooth.before, np.zeros((1, 3))])
    for _ in range(_JUMP_TIMES):
        again = _followed(smooth.problem.with_jump(view), start, before=found.steps)
        if again is None:
            return smooth
        found = again
        gain, near = _likeliest(found, _about(found, view, _JUMP_REACH))
        if gain <= 0.0:
            break
        view, start = near, found.coefficients
    return found if found.belief.gain > _JUMP_EVIDENCE else smooth


def _about(found: _Found, view: int, reach: int) -> list[int]:
    """Averaged views about one, without it, at which a path can jump."""
    last = min(view + reach, found.problem.geometry.views - 1)
    return [v for v in range(max(1, view - reach), last + 1) if v != view]


def _likeliest(found: _Found, views: Sequence[int]) -> tuple[float, int]:
    """The largest gain of evidence by a jump at one of the views, and that view."""
    gains = found.problem.gains(views, found.before, found.effects)
    return float(gains.max()), views[int(gains.argmax())]


def _none(problem: _MotionProblem, left: float) -> InsetMotion:
    """Nothing is seen in the inset, so nothing of it is seen to move."""
    nowhere = np.zeros((len(problem.basis), 3))
    text = "the inset shows nothing above its noise whose motion could be found; none is applied"
    _LOG.warning("%s", text)
    unknown = np.full_like(nowhere, math.inf)
    return InsetMotion(nowhere, unknown, False, 0.0, 0.0, (left, left), 1, [text])


def _rms(path: Floats) -> float:
    """Root mean square length of displacements ``(views, 3)``."""
    return math.sqrt(float((path**2).sum(1).mean()))


def _require_inset(scan: Scan) -> None:
    if not isinstance(scan, Scan):
        raise TypeError(f"scan must be a Scan, got {type(scan).__name__}")
    if not isinstance(scan.geometry, ConeBeam):
        raise ValueError(
            "motion is estimated of a cone beam on a circle, this scan has a "
            f"{type(scan.geometry).__name__}: give the displacement in every view, motion=path"
        )
    if scan.window is None or scan.exterior is None:
        raise ValueError(
            "the motion of an inset and an unknown exterior cannot both be found: acquire the "
            "scan with region="
        )
    if scan.counts.ndim != 3:
        raise ValueError(
            "motion is estimated from one channel; sum the energy bins with weights before: "
            "scan.weighted(bin_weights(scanner, …))"
        )
    if scan.geometry.views < _LEAST_VIEWS:
        raise ValueError(
            f"motion needs at least {_LEAST_VIEWS} views, this scan has {scan.geometry.views}: of "
            "fewer, streaks pass for motion"
        )


def _beats(scan: Scan, heart_rate: float | None, rotation_s: float | None) -> float | None:
    """Beats in one scan."""
    if heart_rate is None:
        if rotation_s is not None:
            raise ValueError("rotation_s is for heart_rate: give both, or neither")
        return None
    if rotation_s is None:
        raise ValueError("heart_rate needs rotation_s, the time of one turn in s")
    beats = number("heart_rate", heart_rate, positive=True) / 60.0
    turn = number("rotation_s", rotation_s, positive=True, unit="s")
    angles = np.unwrap(scan.geometry.angles)
    return beats * turn * abs(float(angles[-1] - angles[0])) / (2.0 * math.pi)


def path_of(motion: object, scan: Scan, grid: VolumeGrid) -> tuple[Floats, InsetMotion | None]:
    """What :func:`recon.reconstruct` was given as ``motion``: the path in every view, and how it
    was estimated if it was.

    Raises:
        ValueError: another word than "estimate"; see :func:`estimate_motion`.
    """
    if isinstance(motion, str):
        if motion != "estimate":
            raise ValueError(
                f'motion must be "estimate" or the displacement in every view, got {motion!r}'
            )
        motion = estimate_motion(scan, grid)
    if isinstance(motion, InsetMotion):
        return motion.path, motion
    return check_motion(motion, scan.geometry.views, 3), None
