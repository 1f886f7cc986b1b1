"""What a detector does not show: the short side of an offset one, and objects that reach beyond its
edges.

The ramp filter needs whole rows. Where a row ends inside the object, it is continued by the chords
of a cylinder that fits its last readings in value and slope (Hsieh et al., Med. Phys. 31, 2385,
2004). Where the rows of an offset detector end early, redundancy weights have taken them to zero
(Wang 2002), and zeros follow.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpcct.angles import is_offset
from torchpcct.geometry import Beam, ConeBeam, Geometry, ParallelBeam, VolumeGrid
from torchpcct.readings import MEDIAN_TO_SD
from torchpcct.validate import checked

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

Floats = NDArray[np.float64]
G = TypeVar("G", bound=Geometry)

_CUT = 0.03
"""Rows are cut off if their end exceeds this fraction of the highest line integral."""
_CUT_VIEWS = 0.05
"""In more than this fraction of the views."""
_CUT_RANGES = 40
"""Ranges of the views over which the ends are averaged."""
_CUT_FEWEST = 12
"""The fewest of them, where there is more noise."""
_CUT_SIGMAS = 3.5
"""Standard errors by which a mean must lie above the limit."""
_CUT_PARTS = (6, 3)
"""Parts of the turn over which the ends are averaged, too: of few photons no less tells."""
_CUT_WIDE_SIGMAS = 4.5
"""Standard errors for those, few of which are independent: the noise of the air frames is in all
views alike."""
_CUT_OUTLIER = 6.0
"""Standard deviations of a step between views beyond which it is none of the noise."""
_LEFT_OUT = 0.1
"""Weight relative to the other end below which an end does not count."""
_FEWEST_COLUMNS = 4
"""Readings that a cylinder is fitted to at least; rows of fewer are not continued."""
_WIDEST_RAD = math.radians(85.0)
"""Fan angle up to which a row is continued: at 90° a flat detector ends nowhere."""


class Rows(NamedTuple):
    """Rows with columns added on either side, and what belongs to them.

    Attributes:
        lines: ``(..., views, [rows,] columns)``.
        geometry: of the wider detector.
        weights: ``(views, 1)`` or ``(views, columns)`` angular weights.
    """

    lines: Tensor
    geometry: Beam
    weights: Floats


@checked
def cut_off(lines: Tensor, geometry: Beam, weights: Floats) -> tuple[bool, bool]:
    """Whether the rows end inside the object, at the first and at the last column.

    A side that the weights leave out (the short one of an offset detector) does not count.
    """
    means = lines.detach()
    return ends_cut_off(
        *row_ends(means.mean(-2) if geometry.has_rows else means), geometry, weights
    )


def row_ends(means: Tensor) -> tuple[float, Tensor, Tensor]:
    """The highest of line integrals ``(..., views, columns)``, means over the rows, and what the
    rows end at."""
    width = max(1, means.shape[-1] // 256)
    return float(means.amax()), means[..., :width].mean(-1), means[..., -width:].mean(-1)


def ends_cut_off(
    highest: float, first: Tensor, last: Tensor, geometry: Beam, weights: Floats
) -> tuple[bool, bool]:
    """:func:`cut_off` of what :func:`row_ends` says of a scan."""
    limit = _CUT * highest
    order = torch.from_numpy(np.argsort(np.mod(geometry.angles, 2.0 * math.pi), kind="stable")).to(
        first.device
    )
    found = [limit > 0 and _rises(end[..., order], limit) for end in (first, last)]
    if _leaves_out_short_side(weights, geometry):
        shown = weights.sum(0)
        found = [found[0] and shown[0] > shown[-1], found[1] and shown[-1] > shown[0]]
    return found[0], found[1]


def _leaves_out_short_side(weights: Floats, geometry: Beam) -> bool:
    """Whether these are the weights of a full turn of an offset detector; a short scan needs
    both sides."""
    if weights.shape[1] == 1 or not is_offset(geometry):
        return False
    ends = sorted((float(weights[:, 0].sum()), float(weights[:, -1].sum())))
    return ends[0] < _LEFT_OUT * ends[1]


def _rises(end: Tensor, limit: float) -> bool:
    """Whether ``end (..., views)`` lies above a limit in more than :data:`_CUT_VIEWS` of the views,
    noise set aside.

    An object is cut off over ranges of views; noise is not: means over a fortieth of the turn are
    compared, or over as much more, up to a twelfth, as makes their noise a third of the limit, with
    a margin of :data:`_CUT_SIGMAS` of their standard errors; and means over :data:`_CUT_PARTS` of
    the turn with a larger one. Logarithms of few photons have far outliers, which the median of
    the steps between views does not know of: their variance counts, those of single lost readings
    left out.
    """
    series = end.reshape(-1, 1, end.shape[-1]).double()
    views = series.shape[-1]
    width, sd = max(1, views // _CUT_RANGES), 0.0
    if views > 2:
        steps = series.diff(dim=-1)
        usual = float(steps.abs().median()) * MEDIAN_TO_SD
        steps = steps.clamp(-_CUT_OUTLIER * usual, _CUT_OUTLIER * usual)
        sd = max(usual, float(steps.square().mean().sqrt())) / math.sqrt(2.0)
        enough = math.ceil(min((3.0 * sd / limit) ** 2, views))
        width = max(width, min(views // _CUT_FEWEST, enough))

    def share(width: int, sigmas: float) -> float:
        smooth = torch.nn.functional.avg_pool1d(series, width, 1)
        return float((smooth > limit + sigmas * sd / math.sqrt(width)).double().mean())

    # One outlier lifts all means that it is in.
    least = max(_CUT_VIEWS, 1.25 * width / (views - width + 1))
    if share(width, _CUT_SIGMAS) > least:
        return True
    wide = [views // part for part in _CUT_PARTS if views // part > width]
    return any(share(n, _CUT_WIDE_SIGMAS) > _CUT_VIEWS for n in wide)


def _room(geometry: Beam) -> tuple[int, int]:
    """Columns that fit before the first and behind the last one, as many as the detector has at
    most."""
    u, n = geometry.column_positions, geometry.columns
    if isinstance(geometry, ParallelBeam):
        return n, n
    pitch = geometry.column_pitch
    far = geometry.sdd * (_WIDEST_RAD if geometry.detector == "curved" else math.tan(_WIDEST_RAD))
    return tuple(int(min(n, max(0.0, (far - abs(end)) / pitch - 1))) for end in (u[0], u[-1]))  # type: ignore[return-value]


@checked
def mirrored(rows: Rows, grid: VolumeGrid, travel: float = 0.0) -> Rows:
    """The rows of an offset detector with zeros on the short side, where the grid needs them.

    Filtered rows do not end with the readings: a voxel beyond the short side reads the filter's
    tail there.
    """
    g = rows.geometry
    if not _leaves_out_short_side(rows.weights, g):
        return rows
    t = g.ray_distances
    half_cell = 0.5 * (t[-1] - t[0]) / max(t.size - 1, 1)
    if grid.in_plane_radius + travel <= min(-t[0], t[-1]) + half_cell:
        return rows
    pitch = g.column_pitch
    missing = round(abs(g.column_positions[0] + g.column_positions[-1]) / pitch)
    before, behind = (missing, 0) if t[-1] > -t[0] else (0, missing)
    lines = torch.nn.functional.pad(rows.lines, (before, behind))
    weights = np.pad(rows.weights, ((0, 0), (before, behind)))
    return Rows(lines, g.widened(before, behind), weights)


@checked
def continued(rows: Rows, sides: tuple[bool, bool], outside: float) -> Rows:
    """The rows continued on the sides where they are cut off.

    Args:
        rows: line integrals; gradients pass through the measured columns only.
        sides: of :func:`cut_off`.
        outside: attenuation in mm⁻¹ of the object beyond the edges.
    """
    g = rows.geometry
    room = [space if side else 0 for space, side in zip(_room(g), sides, strict=True)]
    if outside <= 0 or not any(room) or g.columns < _FEWEST_COLUMNS:
        return rows
    wide = g.widened(*room)
    t = wide.ray_distances
    cone, heights = g.has_rows, g.row_positions
    fit = max(_FEWEST_COLUMNS, min(32, g.columns // 20))
    parts = [rows.lines]
    for side, space in enumerate(room):
        if not space:
            continue
        first = room[0]
        near = (
            slice(first, first + fit)
            if side == 0
            else slice(first + g.columns - fit, first + g.columns)
        )
        far = slice(0, space) if side == 0 else slice(first + g.columns, None)
        end = g.column_positions[0 if side == 0 else -1]
        away = 1.0
        if isinstance(g, ConeBeam):
            away = g.sdd if g.detector == "curved" else math.hypot(g.sdd, end)
        # A ray that climbs crosses an upright cylinder on a path longer by 1 / cos of its slope.
        mu = outside * np.sqrt(1.0 + (heights / away) ** 2)
        last = rows.lines[..., :fit] if side == 0 else rows.lines[..., -fit:]
        part = _cylinder(last.detach(), t[near], t[far], mu if cone else mu[0])
        parts.insert(0 if side == 0 else len(parts), part)
    weights = rows.weights
    if weights.shape[1] > 1:
        weights = np.pad(weights, ((0, 0), tuple(room)), mode="edge")
    return Rows(torch.cat(parts, -1), wide, weights)


def _cylinder(last: Tensor, near: Floats, far: Floats, mu: float | Floats) -> Tensor:
    """Chords at ``far`` of the cylinder that fits the readings ``last (..., [rows,] fit)`` at
    ``near`` best.

    With the chord p = 2 μ √(R² − (t − t₀)²), p² / (4 μ²) + t² is a straight line in t: a linear
    fit. It is exact for parallel rays, and for cylinders on the axis of a fan; a fan's rays see
    another t₀ each, a little.
    """

    def there(values: ArrayLike | Tensor) -> Tensor:
        return torch.as_tensor(values, dtype=torch.float64, device=last.device)

    double = there(2.0 * np.asarray(mu))
    double = double[:, None] if double.ndim else double
    t, u = there(near), there(far)
    line = (last.double().clamp(min=0) / double) ** 2 + t * t
    centred = t - t.mean()
    slope = (line * centred).sum(-1, keepdim=True) / (centred * centred).sum()
    level = line.mean(-1, keepdim=True) - slope * t.mean()

    def chord(at: Tensor) -> Tensor:
        return double * (level + slope * at - at * at).clamp(min=0).sqrt()

    # Rows that do end in air before the edge are not continued: the fit must meet the outermost
    # readings.
    end = torch.argsort((t - u.mean()).abs())[:3]
    fitted = chord(t[end]).mean(-1, keepdim=True)
    share = last.double()[..., end].mean(-1, keepdim=True) / fitted.clamp(
        min=torch.finfo(torch.float64).tiny
    )
    return (chord(u) * share.clamp(0.0, 1.0)).to(last.dtype)
