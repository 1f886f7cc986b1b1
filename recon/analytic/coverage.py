"""Does the scan see what is to be reconstructed, and agree with itself? FBP itself never fails:
without data it extrapolates, plausibly, and a wrong rotation centre it draws as sharp double edges.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import torch

from recon.analytic.angular_weights import INNER_GAP_RAD, angular_weights
from recon.analytic.any_orbit import rebin_to_circle
from recon.analytic.detector_edges import cut_off
from torchpcct.angles import OPEN_GAP_STEPS, SAME_VIEW, is_offset
from torchpcct.checks.defects import BRIGHT
from torchpcct.detector_window import footprint
from torchpcct.geometry import (
    Beam,
    ConeBeam,
    Geometry,
    ParallelBeam,
    VolumeGrid,
    beam,
    project_points,
    view_step,
)
from torchpcct.scan import Scan
from torchpcct.validate import checked
from torchpcct.vector_geometry import VectorGeometry, check_motion

if TYPE_CHECKING:
    from torch import Tensor

    from torchpcct.typing import Floats, Ints


__all__ = ["consistency_warnings"]

STREAK_CELLS = 10.0
"""Distance between the paths of neighbouring views at the border of the field of view, in cells at
the axis, from which streaks of an object at the border are wider than what the kernels smooth. 1968
views of the paper's scanner: 1.6."""
_CENTRE_MARGIN = 8
"""Columns beside a grid's footprint that the test of the rotation centre looks at."""


_FEWEST_VIEWS = 24
"""Views of a windowed scan whose borders are compared with the exterior."""
_FEWEST_CELLS = 500
"""Cells, each seen in both halves of the views, that the spread of gains is found from."""
_BLOCKS = 12
"""Blocks of views in which borders are compared."""
_BLOCK_SIGMAS = 2.0
"""Standard errors by which a block must deviate."""
_MOST_READINGS = 3_000_000
"""Readings that are looked at; more only cost time."""
_EVEN = 0.1
"""Relative change over the views of what a row ends at, from which it is no air that is
described too bright."""
_EXTERIOR_TOLERANCE = 0.01
"""Relative deviation of the readings at a window's borders from its exterior that is no finding."""
_GAIN_TOLERANCE = 0.004
"""Standard deviation of the gains of single cells that is no finding."""
_BORDER = 2
"""Columns at either border of a window that are compared with the exterior."""
_RIM = 0.05
"""Share of the mean line integral of the densest column from which a column passes through the
object."""
_STEADY = 0.98
"""Share of a motion's variance along z that a straight line explains from which it is a table's
travel."""
_TRAVEL = 0.25
"""Share of the height that the rows cover at the axis from which such a motion is a table's
travel."""


@checked
def refuse_helix(geometry: Geometry, motion: object) -> None:
    """Raise ``ValueError`` for a motion that makes a cone beam's circle a helix, which FDK cannot
    reconstruct.

    Args:
        geometry: of the scan.
        motion: ``(views, 3)`` z, y, x mm, or None.
    """
    if motion is None or not isinstance(geometry, ConeBeam) or geometry.views < 3:
        return
    z = np.asarray(motion, dtype=np.float64).reshape(-1, 3)[:, 0]
    height = geometry.rows * geometry.cell_height
    if z.size != geometry.views or np.ptp(z) <= _TRAVEL * height:
        return
    if np.corrcoef(z, geometry.angles)[0, 1] ** 2 > _STEADY:
        raise ValueError(
            f"the table travels by {np.ptp(z):.2f} mm, the rows cover {height:.2f} mm at the axis: "
            "filtered backprojection of a helix is not provided. Use recon.pwls with "
            "Projector(geometry, grid, motion=motion)"
        )


@checked
def check_rows(geometry: Geometry, grid: VolumeGrid, motion: object = None) -> list[str]:
    """Refuse a grid that no view of a cone beam sees; say which slices are not seen by all views,
    or by none.

    Args:
        geometry: parallel and fan beams have no rows, and pass.
        grid: ``(z, y, x)``.
        motion: displacement of the grid per view, ``(views, 3)`` z, y, x mm, or None.

    Returns:
        Warnings; empty if all views see all slices.

    Raises:
        ValueError: the centres of all slices lie above or below the detector in every view.
    """
    if not isinstance(geometry, ConeBeam) or grid.ndim != 3:
        return []
    shift = (
        np.zeros((1, 3)) if motion is None else np.asarray(motion, dtype=np.float64).reshape(-1, 3)
    )
    half = geometry.row_pitch / 2
    bottom, top = geometry.row_positions[0] - half, geometry.row_positions[-1] + half
    # The grid's nearest and farthest voxels from the source over the turn: their rows are the
    # highest and the lowest.
    radius = min(
        grid.in_plane_radius + float(np.hypot(shift[:, 1], shift[:, 2]).max()), 0.999 * geometry.sod
    )
    inner = max(float(np.hypot(*grid.center[1:])) - math.hypot(*grid.extent[1:]) / 2, 0.0)
    heights = geometry.sdd / np.array(
        [geometry.sod - radius, geometry.sod + radius, geometry.sod - inner]
    )
    z = grid.axes[0]
    low, high = z + shift[:, 0].min(), z + shift[:, 0].max()
    margin = 1e-6 * geometry.pitch[0]
    by_all = (np.outer(heights, high).max(0) <= top + margin) & (
        np.outer(heights, low).min(0) >= bottom - margin
    )
    by_some = (np.outer(heights, low).min(0) <= top + margin) & (
        np.outer(heights, high).max(0) >= bottom - margin
    )
    reach = (
        f"the {geometry.rows} rows cover z = {bottom / heights[2]:.2f} … "
        f"{top / heights[2]:.2f} mm at the grid"
    )
    if not by_some.any():
        raise ValueError(
            f"the grid (z = {z[0]:g} … {z[-1]:g} mm) is seen in no view: {reach}; move it along z"
        )
    found = []
    for seen, how in (
        (by_some, "are seen in no view"),
        (by_all | ~by_some, "are not seen in every view"),
    ):
        if not seen.all():
            out = z[~seen]
            found.append(
                f"{out.size} of {z.size} slices (z = {out.min():g} … {out.max():g} mm) {how} and "
                f"are extrapolated: {reach}"
            )
    return found


@checked
def view_notes(geometry: Geometry) -> list[str]:
    """What is unusual about the views and right nevertheless: both ends of a turn, or half a turn,
    among them.

    Args:
        geometry: of the scan, views in the order in which they were taken.
    """
    first, last = float(geometry.angles[0]), float(geometry.angles[-1])
    turn = math.pi if geometry.parallel and abs(last - first) < 1.5 * math.pi else 2.0 * math.pi
    beyond = abs(abs(last - first) - turn)
    if geometry.views < 3 or beyond > SAME_VIEW * turn / geometry.views:
        return []
    how = ", mirrored" if turn < 4.0 else ""
    return [
        f"the views reach from {math.degrees(first):.5g}° to {math.degrees(last):.5g}°, both ends "
        f"included: the last repeats the first{how}, and the two share one step of "
        f"{math.degrees(view_step(geometry.angles)):.3g}°"
    ]


@checked
def sampling_warnings(geometry: Geometry) -> list[str]:
    """Whether the views are too few for the field of view.

    Args:
        geometry: of the scan.

    Returns:
        Warnings; empty if the views suffice.
    """
    geometry = beam(geometry)
    cell, radius = geometry.cell, geometry.fov_radius
    if geometry.parallel:
        radius = float(np.abs(geometry.column_positions).max())
    apart = view_step(geometry.angles) * radius
    if apart <= STREAK_CELLS * cell:
        return []
    needed = math.ceil(2 * math.pi * radius / (STREAK_CELLS * cell))
    return [
        f"{geometry.views} views are few: at the border of the field of view ({radius:.0f} mm) the "
        f"paths of neighbouring views lie {apart:.1f} mm apart, {apart / cell:.0f} cells: edges "
        f"there draw streaks; {needed} views a turn would keep them below {STREAK_CELLS:g} cells"
    ]


@checked
def consistency_warnings(scan: Scan, grid: VolumeGrid, motion: Floats | None = None) -> list[str]:
    """Whether a scan contradicts itself or its description, whatever reconstructs it.

    Neighbouring views (:mod:`torchpcct.checks.neighbours`: order, missing, stuck, travel) and
    columns (:mod:`torchpcct.checks.columns`: gains, places); conjugate rays
    (:mod:`torchpcct.checks.conjugate_rays`; :mod:`torchpcct.checks.modules`: modules of the
    detector); where they agree, the moments of the views
    (:mod:`torchpcct.checks.moments`: no line integrals, motion) of a whole field; lines through the
    object that no view measured; rows that end inside the object; and of a window whether its
    borders see the exterior, and its cells have one
    gain.

    Args:
        scan: counting or energy integrating, without energy bins; of several slices the middle one
            is looked at.
        grid: what is reconstructed.
        motion: of an inset in a known exterior, which stands still: its displacement in every view,
            ``(views, 3)`` z, y, x mm. Its readings are compared as they would be at rest.

    Returns:
        Warnings; empty if nothing is found, or nothing can be compared.

    Raises:
        ValueError: a motion of another shape.
    """
    from recon.analytic.few_photons import bias_warnings  # reconstructs, which imports this module
    from recon.analytic.water_unit import unit_warnings
    from torchpcct.checks.columns import column_test
    from torchpcct.checks.conjugate_rays import geometry_test  # loads scipy.stats
    from torchpcct.checks.moments import moment_test
    from torchpcct.checks.neighbours import neighbour_test
    from torchpcct.checks.readings import without_light

    whole, window, about = scan, scan.window, (0.0, 0.0)
    if window is not None:
        window, about = (
            footprint(scan.geometry, grid, margin=_CENTRE_MARGIN).within(window),
            tuple(grid.center[-2:]),
        )
        scan = scan.crop(window)
    lines, geometry = scan.line_integrals(), scan.geometry
    if isinstance(geometry, VectorGeometry):
        try:
            lines, circle = rebin_to_circle(lines, geometry)
        except ValueError:  # nearly no circle: only an iterative method takes it
            return []
        if circle.motion is not None:  # of sources beside the circle conjugate rays need not meet
            return []
        geometry = circle.geometry
    if lines.ndim > len(geometry.shape):
        lines = lines[lines.shape[0] // 2]
    if window is not None:
        lines = window.less(lines, scan.exterior_line_integrals())
        if motion is not None:
            lines = _at_rest(lines, geometry, about, check_motion(motion, geometry.views, 3))
        found = list(geometry_test(lines, geometry, window, about).findings)
        if motion is not None:
            found = [
                f"with the given motion taken out of the readings, {text} (or the motion is not "
                "theirs: its sign, the order z, y, x, the order of its views?)"
                for text in found
            ]
        return [*_exterior_texts(_thinned_out(whole)), *found]
    order = neighbour_test(lines, geometry)
    columns = list(column_test(lines, geometry).findings)
    # in no order at all: conjugate rays and moments are, too
    if order.findings and "jump" not in order.sizes:
        return [*order.findings, *columns]
    conjugate = geometry_test(lines, geometry)
    texts = conjugate.findings
    if order.findings:  # neighbours tell it themselves, or something that looks like it
        texts = tuple(text for text in texts if "views scatter" not in text)
    found = [*_stuck_texts(scan, geometry), *order.findings, *texts]
    try:
        weights = angular_weights(geometry)
    except ValueError:  # FBP refuses these views, other methods need not
        weights = np.ones((geometry.views, 1))
    unmeasured = _unmeasured_texts(lines, geometry, grid)
    found += [*columns, *unmeasured]
    sides = cut_off(lines, geometry, weights)
    # What rays without light read is not what they pass: of that other tests say nothing.
    lit = scan.logged or not without_light(scan)
    few = bias_warnings(scan, lines, geometry) if lit else []
    lit = lit and (scan.logged or not few)
    if any(sides):
        found.append(_cut_text(lines, sides))
    elif lit and len(found) == len(columns) + len(unmeasured) and not is_offset(geometry):
        found += moment_test(lines, geometry).findings
    if scan.unit == "HU" and lit:
        found += unit_warnings(lines, geometry, scan.linearisation.mu_ref)
    return [*found, *few]


def _at_rest(lines: Tensor, geometry: Beam, about: tuple[float, float], motion: Floats) -> Tensor:
    """Readings ``(views, [rows,] columns)`` of what moves, its exterior taken off, moved to where
    they would be at rest, between columns and rows; beyond the window stands its border's value.

    Exact of parallel rays. Of others what lies off ``about`` is displaced by up to its distance
    over that to the source less or more: 1 % of the displacement at 5 mm of 500 mm.

    Args:
        lines: on a window.
        geometry: of the scan.
        about: (y, x) of the inset's middle, mm.
        motion: ``(views, 3)`` z, y, x mm.
    """
    y, x = about
    rest = project_points(geometry, x, y)
    moved = project_points(geometry, x + motion[:, 2], y + motion[:, 1], motion[:, 0])
    pitches = (geometry.column_pitch, geometry.row_pitch)[: lines.ndim - 1]
    for axis, (pitch, there, here) in enumerate(zip(pitches, moved, rest, strict=False), start=1):
        shift = torch.from_numpy((there - here) / pitch)
        lines = _shifted(lines, shift.to(lines.dtype), -axis)
    return lines


def _shifted(values: Tensor, shift: Tensor, axis: int) -> Tensor:
    """Values ``(views, …)`` at so many places further along an axis, another number in each
    view."""
    moved = values.movedim(axis, -1)
    last = moved.shape[-1] - 1
    at = (torch.arange(last + 1) + shift[:, None]).clamp(0, last)
    low = at.floor().clamp(max=max(last - 1, 0))
    index = low.long().view(len(at), *(1,) * (moved.ndim - 2), -1).expand(moved.shape)
    share = (at - low).view(len(at), *(1,) * (moved.ndim - 2), -1)
    near = moved.gather(-1, index)
    return torch.lerp(near, moved.gather(-1, (index + 1).clamp(max=last)), share).movedim(-1, axis)


def _unmeasured_texts(lines: Tensor, geometry: Beam, grid: VolumeGrid) -> list[str]:
    """Lines through the object and the grid that no view measured, of a cone beam in the plane of
    the source: FBP refuses an arc below half a turn and the detector's fan, an iterative method
    takes it, and needs half a turn and the object's.

    A line is given by its direction and its distance t from the axis. The column at t measures the
    directions of the views less its fan angle, that at -t the same lines from their other ends.
    """
    mean = lines.reshape(geometry.views, -1, geometry.columns).double().mean((0, 1)).numpy()
    t = geometry.ray_distances
    seen = np.abs(t) <= math.hypot(*grid.center[-2:]) + math.hypot(*grid.extent[-2:]) / 2
    seen &= mean > _RIM * mean.max(initial=0.0)
    columns = np.flatnonzero(seen)
    if not columns.size:
        return []
    usual = view_step(geometry.angles)
    lacking = _gaps(geometry)[columns] - usual
    worst = int(np.argmax(lacking))
    if lacking[worst] <= max(INNER_GAP_RAD, OPEN_GAP_STEPS * usual):
        return []
    return [
        f"no view measured the lines at {abs(t[columns[worst]]):.3g} mm from the axis, which pass "
        f"through the object, in {math.degrees(lacking[worst]):.2g}° of their directions: edges "
        "along them are smeared, and values beside them wrong by tens of HU; add views until they "
        "cover half a turn and the fan of the object"
    ]


@lru_cache(maxsize=16)
def _gaps(geometry: Beam) -> Floats:
    """Largest angle between directions next to each other in which the lines of each column are
    measured, ``(columns,)`` rad."""
    t = geometry.ray_distances
    fan = np.zeros_like(t) if isinstance(geometry, ParallelBeam) else geometry.fan_angles
    found = np.zeros(t.size)
    for column in range(t.size):
        directions = [geometry.angles - fan[column]]
        if t.min() <= -t[column] <= t.max():
            directions.append(geometry.angles + fan[column] + math.pi)
        # Runs in order are merged.
        ordered = np.sort(np.concatenate(directions) % (2.0 * math.pi), kind="stable")
        found[column] = max(
            np.diff(ordered).max(initial=0.0), ordered[0] + 2 * math.pi - ordered[-1]
        )
    found.setflags(write=False)
    return found


def _stuck_texts(scan: Scan, geometry: Geometry) -> list[str]:
    """Views that repeat the readings of others, of several slices in the middle one."""
    from torchpcct.checks.neighbours import stuck_views

    readings = scan.counts
    if readings.ndim > len(geometry.shape):
        readings = readings[readings.shape[0] // 2]
    return stuck_views(readings, geometry) if tuple(readings.shape) == geometry.shape else []


def _thinned_out(scan: Scan) -> Scan:
    """Every n-th view of a windowed scan, so that a test of it costs little beside its
    reconstruction."""
    stride = math.ceil(scan.counts.numel() / _MOST_READINGS)
    return scan if stride == 1 or scan.counts.ndim != 3 else scan.select(slice(None, None, stride))


def _exterior_texts(scan: Scan) -> list[str]:
    """Whether a window's borders, which see next to nothing of the inset, read what the known
    exterior says; and whether cells deviate from those in the rows beside them in the views of even
    and of odd number alike, as gains do and noise does not."""
    window = scan.window
    assert window is not None
    lines = window.less(scan.line_integrals(), scan.exterior_line_integrals()).double()
    if lines.ndim != 3 or lines.shape[-1] < 4 * _BORDER or lines.shape[0] < _FEWEST_VIEWS:
        return []
    found = []
    # What stands at the rim of the inset is at one border at a time, not at both over a third of
    # the turn.
    off = [_border_deviation(scan, part) for part in (slice(_BORDER), slice(-_BORDER, None))]
    for sign, side in ((1.0, "above"), (-1.0, "below")):
        least = min(
            float(np.quantile(sign * ratio - _BLOCK_SIGMAS * error, 0.7)) for ratio, error in off
        )
        if least > _EXTERIOR_TOLERANCE:
            size = 100.0 * np.mean([np.quantile(sign * ratio, 0.7) for ratio, _ in off])
            found.append(
                f"beside the inset the readings of a third of the views or more lie {size:.2g} % "
                f"{side} those of the known exterior: they hold something else than the "
                "transmission (a dark signal, scatter, pile-up, saturation), or exposure or "
                "exterior are not those of the scan; values are off by a smooth background"
            )
    gain = _gain_spread(lines, window.column_indices)
    if gain > _GAIN_TOLERANCE:
        found.append(
            "the cells of the detector differ from their neighbours in the next rows by "
            f"{100 * gain:.2g} % in all their views (standard deviation): gains that the "
            "calibration in air did not see, which draw rings"
        )
    return found


def _border_deviation(scan: Scan, part: slice) -> tuple[Floats, Floats]:
    """Relative deviation of the columns ``part`` of a window from the exterior in blocks of views,
    and its standard error from the scatter of the views: ratios of sums, which have no bias of a
    logarithm."""
    assert scan.window is not None
    assert scan.exterior is not None
    expected = scan.window.take(scan.exterior)[..., part].double()
    if scan.flux is not None:
        expected = expected * scan.flux.double()[:, None, None]
    read = scan.counts[..., part].double()
    # Lost readings at a border have neighbours on one side only, and are not found.
    sound = (read > 0) | (expected < BRIGHT)
    views = [(values * sound).sum((1, 2)).numpy() for values in (read, expected)]
    blocks = np.array_split(np.arange(len(read)), _BLOCKS)
    ratios = [views[0][k].sum() / max(views[1][k].sum(), 1e-9) - 1.0 for k in blocks]
    errors = [
        np.std(views[0][k] / np.maximum(views[1][k], 1e-9)) / math.sqrt(max(k.size - 1, 1))
        for k in blocks
    ]
    return np.array(ratios), np.array(errors)


def _gain_spread(lines: Tensor, columns: Ints) -> float:
    """Standard deviation of the cells' gains, less 4 standard errors; 0 where there are too few
    rows.

    Args:
        lines: ``(views, rows, columns)`` of a window.
        columns: ``(views, columns)`` detector column of each.
    """
    if lines.shape[1] < 3:
        return 0.0
    bend = (lines[:, 1:-1] - (lines[:, :-2] + lines[:, 2:]) / 2).movedim(1, 0).numpy()
    low, width = int(columns.min()), int(np.ptp(columns)) + 1
    means, counts = [], []
    for part in (slice(0, None, 2), slice(1, None, 2)):
        at = (columns[part] - low).ravel()
        counts.append(np.bincount(at, minlength=width))
        means.append(
            np.stack([np.bincount(at, row[part].ravel(), width) for row in bend])
            / np.maximum(counts[-1], 1)
        )
    often = (counts[0] > 0) & (counts[1] > 0)
    # Independent noise, the same gains: the mean product is the variance of the gains, times 1 + 2
    # / 4 for the bend.
    product = (means[0] * means[1])[:, often]
    if product.size < _FEWEST_CELLS:
        return 0.0
    weight = np.broadcast_to(np.minimum(counts[0], counts[1])[often], product.shape)
    mean = float((weight * product).sum() / weight.sum())
    error = float(np.sqrt((weight**2 * (product - mean) ** 2).sum()) / weight.sum())
    return math.sqrt(max(mean - 4.0 * error, 0.0) / 1.5)


def _cut_text(lines: Tensor, sides: tuple[bool, bool]) -> str:
    ends = [
        lines[..., k].reshape(lines.shape[0], -1).mean(1)
        for k, cut in ((0, sides[0]), (-1, sides[1]))
        if cut
    ]
    level = max(float(end.mean()) for end in ends)
    if all(sides) and all(float(end.std()) < _EVEN * level for end in ends):
        return (
            f"no row ends in air: its line integrals are {level:.2g} at both ends in all views "
            f"alike: air is {math.exp(level):.2g} times too bright (measured with another exposure "
            "or gain, or readings saturate), or the object reaches beyond the detector all around"
        )
    where = " and the ".join(name for name, cut in (("first", sides[0]), ("last", sides[1])) if cut)
    return (
        f"the rows end inside the object at the {where} column (line integrals of {level:.2g} on "
        "average there): what lies beyond is not known, so values are off by a smooth background, "
        "most near the edge of the field of view; differences between neighbours are not"
    )
