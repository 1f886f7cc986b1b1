"""Angular weights of filtered backprojection: view spacing and redundancy (full circle, short scan,
over-scan).

The weight of a reading is (angle its view stands for) × (its share among the readings of the same
line). The lines of a divergent beam are measured twice in a full circle, at (β, γ) and at (β + π −
2γ, −γ) with this package's signs, so the shares of such a pair add up to 1.
"""

from __future__ import annotations

import logging
import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from torchpcct.angles import OPEN_GAP_STEPS, SAME_VIEW, is_offset, view_steps
from torchpcct.geometry import Beam, Geometry, ParallelBeam, VolumeGrid, beam
from torchpcct.validate import checked

__all__ = ["angular_weights"]

_LOG = logging.getLogger(__name__)

Floats = NDArray[np.float64]

PARALLEL_GAP_RAD = math.radians(5.0)
"""A parallel-beam scan may lack this angle in rad before it is refused; below it the neighbours
fill in."""
INNER_GAP_RAD = math.radians(5.0)
"""Views that lack inside of the covered arc: neighbours stand for them up to this angle in rad,
with a warning."""
SHORT_RAD = math.radians(2.0)
"""A short scan may lack this angle in rad, or one step if that is less, of half a turn and the fan:
lines at the fan's edge are not measured then."""
WIDEST_STEP_RAD = math.radians(75.0)
"""The largest angle in rad that one view may stand for: five views a turn pass, as a test of
operators, not of images."""
_SMALL = 60_000
"""Readings of a row in all views up to which weights are kept, half a megabyte of them at most."""


def _lacking(angles: Floats, period: float) -> str:
    """What to say of a few views that lack inside of the arc they cover; nothing where none does.

    Args:
        angles: ``(views,)`` rad, any order.
        period: see :func:`torchpcct.angles.view_steps`.

    Raises:
        ValueError: fewer than two distinct views, steps wider than 75°, or an inner gap of more
            than 5° and three median steps.
    """
    ordered = np.sort(np.mod(angles, period))
    gaps = np.append(np.diff(ordered), ordered[0] + period - ordered[-1])
    gaps = gaps[gaps > SAME_VIEW * period / angles.size]
    usual = float(np.median(gaps)) if gaps.size > 1 else period
    # The widest gap may be the scan's end, if it is far wider than the steps.
    widest = np.sort(gaps)[::-1]
    inner = widest[1] if widest.size > 1 and widest[0] > OPEN_GAP_STEPS * usual else widest[0]
    if max(usual, min(inner, period)) > WIDEST_STEP_RAD + 1e-9 and inner <= OPEN_GAP_STEPS * usual:
        remedy = (
            'add views, or reconstruct by "pwls" or "mbir"'
            if gaps.size > 1
            else "are the angles those of the views?"
        )
        raise ValueError(
            f"{gaps.size} distinct view{'s' * (gaps.size > 1)} in steps of up to "
            f"{math.degrees(inner):.0f}° are too few for filtered backprojection (at most "
            f"{math.degrees(WIDEST_STEP_RAD):.0f}°): {remedy}"
        )
    if inner > OPEN_GAP_STEPS * usual:
        lacking = (
            f"views are missing within the scan: a gap of {math.degrees(inner):.2f}° "
            f"where the usual step is {math.degrees(usual):.2f}°"
        )
        if inner > INNER_GAP_RAD:
            raise ValueError(
                f"{lacking}; reconstruct by 'pwls' or 'mbir', or interpolate the views"
            )
        return (
            f"{lacking}: the views on either side of it are weighted in place of those that are "
            "missing"
        )
    return ""


@checked
def parker_share(beta: Floats, gamma: Floats, half_fan: float) -> Floats:
    """Parker's smooth share of a reading in a scan of ``π + 2 · half_fan``.

    With ``half_fan`` equal to the detector's it is Parker's minimal scan (Med. Phys. 9, 254, 1982);
    a larger value, the virtual fan of Silver (Med. Phys. 27, 773, 2000), spreads the redundancy of
    an over-scan up to the full turn.

    Args:
        beta: source angle from the start of the scan in rad, 0 … π + 2 · half_fan; any shape.
        gamma: fan angle in rad, −half_fan … half_fan, of a shape that broadcasts with ``beta``.
        half_fan: (span − π) / 2 in rad, at most π/2.

    Returns:
        float64 shares 0 … 1 with ``share(β, γ) + share(β + π − 2γ, −γ) = 1``; 0 outside the scan.
    """
    beta, gamma = np.broadcast_arrays(beta, gamma)
    rise = 2.0 * (half_fan + gamma)  # the line at β < rise is measured again at the end of the scan
    fall = math.pi + 2.0 * gamma
    end = math.pi + 2.0 * half_fan
    # A ray at the fan's edge in a minimal scan meets its conjugate at the very ends: one of the
    # two, the first, counts.
    tiny = 1e-300  # no angle over it overflows
    up = np.sin(0.5 * math.pi * np.clip(beta / np.maximum(rise, tiny), 0.0, 1.0)) ** 2
    down = (
        np.sin(0.5 * math.pi * np.clip((end - beta) / np.maximum(end - fall, tiny), 0.0, 1.0)) ** 2
    )
    share = np.where(beta < rise, up, np.where(beta < fall, 1.0, down))
    return np.where((beta < 0.0) | (beta > end), 0.0, share)


@checked
def offset_share(position: Floats) -> Floats:
    """Share of a reading in a full turn of an offset detector (Wang, Med. Phys. 29, 1634, 2002).

    Lines that both halves of the turn measure are shared along a sine over the overlap, from 1 on
    the long side to 0 at the short edge, where the rows end; beyond the overlap the long side alone
    counts.

    Args:
        position: fan angles or, of parallel rays, cell positions: ``(columns,)``, evenly spaced,
            increasing.

    Returns:
        ``(columns,)`` with ``share(p) + share(-p) = 1`` inside the overlap.
    """
    half_cell = 0.5 * (position[-1] - position[0]) / max(position.size - 1, 1)
    low, high = -(position[0] - half_cell), position[-1] + half_cell
    if min(low, high) <= 0:
        raise ValueError(
            f"all {position.size} columns of the detector lie on one side of the projection of the "
            "rotation axis, so that no turn measures all lines: check offset, or move the detector"
        )
    side = 1.0 if high >= low else -1.0
    phase = np.clip(side * position / min(low, high), -1.0, 1.0)
    return 0.5 * (1.0 + np.sin(0.5 * math.pi * phase))


def _reach(grid: VolumeGrid) -> float:
    """How far a grid reaches from the axis in mm, the corners of one that is centred on it left
    aside."""
    far = math.hypot(*grid.center[-2:])
    y, x = grid.extent[-2:]
    return far + (math.hypot(y, x) if far > 1e-6 * max(y, x) else max(y, x)) / 2


@checked
def angular_weights(geometry: Geometry, grid: VolumeGrid | None = None) -> Floats:
    """Weights of all readings: the angle of each view times the share of each column.

    Args:
        geometry: parallel, fan or cone beam. Views may come in any order, irregularly spaced and
            repeated.
        grid: what is reconstructed: a short scan of an offset detector is complete within its short
            side.

    Returns:
        ``(views, columns)``, or ``(views, 1)`` where all columns share one weight; float64, rad.
        Parallel: the steps over π. Divergent: half the steps over a closed circle, Parker's smooth
        weights over an arc. A full turn of an offset detector (:func:`torchpcct.angles.is_offset`):
        the steps times :func:`offset_share`.

    Raises:
        ValueError: the views cover less than π (parallel) or π plus the fan angle (divergent), or
            less than a full turn of a divergent beam with an offset detector; they are too few, or
            lack inside of the arc.
        TypeError: not a geometry.
    """
    geometry = beam(geometry)
    # Of other scans the grid does not matter.
    field = grid if is_offset(geometry) else None
    small = geometry.views * geometry.columns <= _SMALL
    weights, lacking = (_kept_weights if small else _weights)(geometry, field)
    if lacking:
        _LOG.warning("%s", lacking)
    return weights.copy() if small else weights


def _weights(geometry: Beam, grid: VolumeGrid | None) -> tuple[Floats, str]:
    """Those of :func:`angular_weights`, and what to say of a few views that lack."""
    parallel = isinstance(geometry, ParallelBeam)
    lacking = _lacking(geometry.angles, math.pi if parallel else 2.0 * math.pi)
    return _of_covered(geometry, grid), lacking


_kept_weights = lru_cache(maxsize=4)(_weights)
"""Of small scans: there they take as long as the backprojection itself."""


def _of_covered(geometry: Beam, grid: VolumeGrid | None) -> Floats:
    """Those of :func:`angular_weights` of views that do not lack inside of their arc."""
    if isinstance(geometry, ParallelBeam):
        if is_offset(geometry):
            steps, _, span = view_steps(geometry.angles)
            if span >= 2.0 * math.pi:
                return steps[:, None] * offset_share(geometry.column_positions)
        steps, _, span = view_steps(geometry.angles, math.pi, PARALLEL_GAP_RAD)
        if span < math.pi:
            raise ValueError(
                f"the views cover {math.degrees(span):.1f}°, but parallel rays need 180°: add "
                "views, or "
                'reconstruct by "pwls" or "mbir"'
            )
        return steps[:, None]
    steps, start, span = view_steps(geometry.angles)
    gamma = geometry.fan_angles
    if span >= 2.0 * math.pi:
        return steps[:, None] * (offset_share(gamma) if is_offset(geometry) else 0.5)
    half_fan = 0.5 * (span - math.pi)
    reach = float(np.abs(gamma).max())
    if is_offset(geometry):
        field = geometry.fov_radius
        if grid is None or _reach(grid) > field * (1.0 + 1e-6):
            raise ValueError(
                f"the detector is offset (fan {math.degrees(gamma[0]):.1f}° … "
                f"{math.degrees(gamma[-1]):.1f}°), which "
                f"needs a full turn, but the views cover {math.degrees(span):.1f}°: reconstruct "
                "no more than "
                f"{field:.4g} mm about the axis (the detector's short side), add views, or "
                'reconstruct by "pwls" or "mbir"'
            )
        reach = float(min(-gamma[0], gamma[-1]))
    # The scan's ends are known to about one step, but a step may be wider than what may lack.
    if 2.0 * (reach - half_fan) > min(float(steps.max()), SHORT_RAD) * (1.0 + 1e-6):
        raise ValueError(
            f"the views cover {math.degrees(span):.1f}°, but this fan needs 180° + "
            f"{math.degrees(2 * reach):.1f}° = "
            f"{math.degrees(math.pi + 2 * reach):.1f}°: add views, or "
            'reconstruct by "pwls" or "mbir"'
        )
    beta = np.mod(geometry.angles - start, 2.0 * math.pi)
    virtual = max(half_fan, reach)
    # Beyond the short side of an offset detector lines are measured once, if at all: no line of the
    # field.
    return steps[:, None] * parker_share(
        beta[:, None], np.clip(gamma, -virtual, virtual)[None, :], virtual
    )
