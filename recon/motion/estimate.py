"""From a scan to the path of its inset."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from recon.motion.belief import Belief, believed
from recon.motion.path import InsetMotion, Jump, PathTooLongError
from recon.motion.problem import FLOOR_MM, REACH_MM, Effects, MotionProblem
from torchpcct.geometry import ConeBeam, VolumeGrid
from torchpcct.scan import Scan
from torchpcct.validate import checked, number
from torchpcct.vector_geometry import check_motion

if TYPE_CHECKING:
    from torchpcct.typing import Floats

__all__ = ["estimate_motion", "path_of"]

_LOG = logging.getLogger(__name__)
_LEAST_VIEWS = 48
"""Fewer views a turn leave streaks that pass for motion."""
_REACH_ALONG_MM = 1.0
"""Farthest from the mean along the axis of the turn. A vessel along it shows little of such a
motion: one that moved by 1.2 mm, 0.75 from its mean, was followed, of 2 mm the path was wrong by
more than the motion (the case "along z" of ``torchpcct study motion``)."""
_STEPS = 6
"""Most iterations."""
_SETTLED = 0.5
"""Change of the path in the last step over its standard error, root mean squares."""
_NEAR_MM = 0.05
"""Change below which the effects of the path are not computed again."""
_LARGEST_STEP_MM = 0.7
"""Of one iteration."""
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
_LEAST_EVIDENCE = 6.0
"""Logarithm of the marginal likelihood's ratio to rest, from which on a motion is believed."""
_ANOTHER = 3.0
"""Times that, beside what noise leaves, from which on something else moves."""
_CHANCE = 1.05
"""Times what a draw of the noise leaves, from which on another draw is not the cause."""


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
    problem = MotionProblem(scan, grid, _beats(scan, heart_rate, rotation_s))
    tell = progress or (lambda _: None)
    rest, quiet = problem.misfits()
    found = _followed(problem, problem.start(), tell)
    if found is None:
        return _none(problem, rest)
    if heart_rate is None and found.belief.evidence >= _LEAST_EVIDENCE:
        found = _with_jump(found)
    path, errors, belief = found.path, found.errors, found.belief
    size, error = _rms(path), _rms(errors)
    held = belief.evidence >= _LEAST_EVIDENCE and size > max(FLOOR_MM, error)
    along = float(np.abs(path[:, 0]).max())
    if held and along > _REACH_ALONG_MM:
        raise PathTooLongError(
            f"the estimated path reaches {along:.2g} mm from its mean along the axis, more than "
            f"the {_REACH_ALONG_MM:g} mm up to which such estimates are reliable: give the "
            "displacement in every view, motion=path, or reconstruct a part of the turn"
        )
    after = found.problem.at(found.coefficients, found.effects)[0].misfit if held else rest
    jump = found.jump if held else None
    texts = []
    if not held:
        texts.append(
            "the readings show no motion of the inset: the best fitting path has "
            f"{size:.2g} ± {error:.2g} mm, root mean square; none is applied"
        )
    if jump is not None:
        texts.append(
            f"the inset jumps by {jump.length:.2g} ± {jump.error:.2g} mm at view {jump.view} of "
            f"{len(path)}: its motion is not smooth; the path contains the jump"
        )
    if after**2 > _CHANCE * quiet**2 + _ANOTHER * problem.left_by_model:
        texts.append(
            "the residual of the readings along the path exceeds the noise "
            f"({after:.2g} times): the inset does not move as one rigid body along one path, parts "
            "of it may move differently, turn or jump"
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

    problem: MotionProblem
    before: Floats
    coefficients: Floats
    belief: Belief
    effects: Effects
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
            np.sqrt(np.diag(self.belief.covariance)[last] + FLOOR_MM**2),
        )


def _followed(
    problem: MotionProblem,
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
    effects: Effects | None = None
    for step in range(1, _STEPS + 1):
        found, now = problem.at(at, effects)
        if not np.diag(found.information).max() > 0.0:
            return None
        belief = believed(found, at, problem.inflation, problem.jump is not None)
        change = problem.path(belief.mean - at)
        largest = float(np.abs(change).max())
        here = at
        at = at + (belief.mean - at) / max(1.0, largest / _LARGEST_STEP_MM)
        farthest = float(np.abs(problem.path(at)).max())
        if farthest > REACH_MM:
            raise PathTooLongError(
                f"the estimated path reaches {farthest:.2g} mm from its mean, more than the "
                f"{REACH_MM:g} mm that are searched: the inset moves too far in this scan, or its "
                "content is too faint; give the displacement in every view, motion=path"
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


def _none(problem: MotionProblem, left: float) -> InsetMotion:
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
            "motion is estimated for cone beams on a circle only, this scan has a "
            f"{type(scan.geometry).__name__}: give the displacement in every view, motion=path"
        )
    if scan.window is None or scan.exterior is None:
        raise ValueError(
            "motion can be estimated only if the exterior of the inset is known: acquire the "
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
