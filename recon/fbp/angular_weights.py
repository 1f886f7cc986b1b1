"""Angular weights of filtered backprojection: view spacing and redundancy (full circle, short scan, over-scan).

The weight of a reading is (angle its view stands for) × (its share among the readings of the same line). The lines of a
divergent beam are measured twice in a full circle, at (β, γ) and at (β + π − 2γ, −γ) with this package's signs, so the
shares of such a pair add up to 1.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from torchpcct.geometry import ConeBeam, FanBeam, Geometry, ParallelBeam

__all__ = ["angular_weights", "parker_share", "view_steps"]

Floats = NDArray[np.float64]

#: A gap between neighbouring views counts as the end of the scan when it exceeds this many median steps.
OPEN_GAP_STEPS = 3.0
#: Views closer than this, in rad, are repetitions of one view.
SAME_VIEW_RAD = 1e-9
#: A parallel-beam scan may lack this angle in rad before it is refused; below it the neighbours fill in.
PARALLEL_GAP_RAD = math.radians(5.0)


def view_steps(
    angles: Floats, period: float = 2.0 * math.pi, smallest_opening: float = 0.0
) -> tuple[Floats, float, float]:
    """Angle each view stands for, whatever the order, the spacing and the repetitions of the views.

    Args:
        angles: ``(views,)`` rad, any order, any number of turns.
        period: angle after which the scan repeats: 2π, or π for parallel rays.
        smallest_opening: gaps up to this angle in rad never end the scan; the views beside them fill in.

    Returns:
        ``steps`` ``(views,)`` rad: half the gap to the neighbours on either side, shared among views at the same angle;
        ``start`` and ``span`` of the covered arc in rad. A gap of more than three median steps ends the scan: the views
        beside it then stand for as much on the open side as on the other, and ``span < period``. Without such a gap the
        scan is closed, ``span == period`` and the steps add up to it.
    """
    wrapped = np.mod(angles, period)
    order = np.argsort(wrapped, kind="stable")
    ordered = wrapped[order]
    group = np.concatenate([[0], np.cumsum(np.diff(ordered) > SAME_VIEW_RAD)])
    distinct = ordered[np.concatenate([[True], np.diff(group) > 0])]
    if distinct.size > 1 and distinct[0] + period - distinct[-1] <= SAME_VIEW_RAD:
        group[group == group[-1]] = 0  # 0 and the period are the same view
        distinct = distinct[:-1]
    gaps = np.append(np.diff(distinct), distinct[0] + period - distinct[-1])  # gap after each distinct view
    last = int(np.argmax(gaps))
    start, span = float(distinct[0]), period
    if distinct.size > 1 and gaps[last] > max(OPEN_GAP_STEPS * float(np.median(gaps)), smallest_opening):
        before, after = gaps[last - 1], gaps[(last + 1) % distinct.size]
        open_gap = gaps[last]
        right, left = gaps.copy(), np.roll(gaps, 1)
        first = (last + 1) % distinct.size
        right[last], left[first] = min(before, open_gap), min(after, open_gap)
        steps = (left + right) / 2.0
        start = float(distinct[first] - left[first] / 2.0)
        span = float(steps.sum())
    else:
        steps = (gaps + np.roll(gaps, 1)) / 2.0
    share = steps / np.bincount(group, minlength=distinct.size)
    out = np.empty_like(wrapped)
    out[order] = share[group]
    return out, start, span


def parker_share(beta: Floats, gamma: Floats, half_fan: float) -> Floats:
    """Parker's smooth share of a reading in a scan of ``π + 2 · half_fan``.

    With ``half_fan`` equal to the detector's it is Parker's minimal scan (Med. Phys. 9, 254, 1982); a larger value, the
    virtual fan of Silver (Med. Phys. 27, 773, 2000), spreads the redundancy of an over-scan up to the full turn.

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
    # A ray at the fan's edge in a minimal scan meets its opposite at the very ends: one of the two, the first, counts.
    tiny = np.finfo(np.float64).tiny
    up = np.sin(0.5 * math.pi * np.clip(beta / np.maximum(rise, tiny), 0.0, 1.0)) ** 2
    down = np.sin(0.5 * math.pi * np.clip((end - beta) / np.maximum(end - fall, tiny), 0.0, 1.0)) ** 2
    share = np.where(beta < rise, up, np.where(beta < fall, 1.0, down))
    return np.where((beta < 0.0) | (beta > end), 0.0, share)


def angular_weights(geometry: Geometry) -> Floats:
    """Weights of all readings: the angle of each view times the share of each column.

    Args:
        geometry: parallel, fan or cone beam. Views may come in any order, irregularly spaced and repeated.

    Returns:
        ``(views, columns)``, or ``(views, 1)`` where all columns share one weight; float64, rad.
        Parallel: the steps over π. Divergent: half the steps over a closed circle, Parker's smooth weights over an arc.

    Raises:
        ValueError: the views cover less than π (parallel) or π plus the fan angle (divergent).
        TypeError: not a geometry.
    """
    if isinstance(geometry, ParallelBeam):
        steps, _, span = view_steps(geometry.angles, math.pi, PARALLEL_GAP_RAD)
        if span < math.pi:
            raise ValueError(
                f"the views cover {math.degrees(span):.1f}°, but parallel rays need 180°: add views, or pass `weights`"
            )
        return steps[:, None]
    if not isinstance(geometry, FanBeam | ConeBeam):
        raise TypeError(f"geometry must be a ParallelBeam, FanBeam or ConeBeam, got {type(geometry).__name__}")
    steps, start, span = view_steps(geometry.angles)
    if span >= 2.0 * math.pi:
        return 0.5 * steps[:, None]
    gamma = geometry.fan_angles
    half_fan = 0.5 * (span - math.pi)
    reach = float(np.abs(gamma).max())
    slack = float(steps.max())  # the scan's ends are known to about one step
    if half_fan < reach - slack:
        raise ValueError(
            f"the views cover {math.degrees(span):.1f}°, but this fan needs 180° + {math.degrees(2 * reach):.1f}° = "
            f"{math.degrees(math.pi + 2 * reach):.1f}°: add views, or pass `weights`"
        )
    beta = np.mod(geometry.angles - start, 2.0 * math.pi)
    return steps[:, None] * parker_share(beta[:, None], gamma[None, :], max(half_fan, reach))
