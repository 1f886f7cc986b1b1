"""What the angles of the views cover, and whether the detector reaches farther to one side."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from torchpcct.validate import checked

if TYPE_CHECKING:
    from torchpcct.geometry import Geometry

Floats = NDArray[np.float64]

OPEN_GAP_STEPS = 3.0
"""A gap between neighbouring views counts as the end of the scan when it exceeds this many median
steps."""
SAME_VIEW = 0.02
"""Views closer than this share of the mean step are repetitions of one view (angles are stored with
few digits)."""
OFFSET_SHARE = 0.02
"""A detector is an offset one if it reaches farther to one side by more than this share of its
width."""


@checked
def view_steps(
    angles: Floats, period: float = 2.0 * math.pi, smallest_opening: float = 0.0
) -> tuple[Floats, float, float]:
    """Angle each view stands for, whatever the order, the spacing and the repetitions of the views.

    Args:
        angles: ``(views,)`` rad, any order, any number of turns.
        period: angle after which the scan repeats: 2π, or π for parallel rays.
        smallest_opening: gaps up to this angle in rad never end the scan; the views beside them
            fill in.

    Returns:
        ``steps`` ``(views,)`` rad: half the gap to the neighbours on either side, shared among
        views at the same angle; ``start`` and ``span`` of the covered arc in rad. A gap of more
        than three median steps ends the scan: the views beside it then stand for as much on the
        open side as on the other, and ``span < period``. Without such a gap the scan is closed,
        ``span == period`` and the steps add up to it.
    """
    wrapped = np.mod(angles, period)
    order = np.argsort(wrapped, kind="stable")
    ordered = wrapped[order]
    same = SAME_VIEW * period / angles.size
    group = np.concatenate([[0], np.cumsum(np.diff(ordered) > same)])
    distinct = ordered[np.concatenate([[True], np.diff(group) > 0])]
    if distinct.size > 1 and distinct[0] + period - distinct[-1] <= same:
        group[group == group[-1]] = 0  # 0 and the period are the same view
        distinct = distinct[:-1]
    # gap after each distinct view
    gaps = np.append(np.diff(distinct), distinct[0] + period - distinct[-1])
    last = int(np.argmax(gaps))
    start, span = float(distinct[0]), period
    if distinct.size > 1 and gaps[last] > max(
        OPEN_GAP_STEPS * float(np.median(gaps)), smallest_opening
    ):
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


@checked
def is_offset(geometry: Geometry) -> bool:
    """Whether the detector reaches farther to one side by more than ``OFFSET_SHARE`` of its width
    and two columns.

    Quarter-column offsets are not meant: there nearly every line is measured twice.
    """
    u = geometry.column_positions
    width = u[-1] - u[0]
    return bool(
        abs(u[0] + u[-1])
        > max(OFFSET_SHARE * width, 2.0 * width / max(u.size - 1, 1)) * (1.0 + 1e-9)
    )
