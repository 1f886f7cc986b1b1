"""The plane of a cone beam's orbit: the only rays that others meet again, as one row of a fan beam.

Rows beside the plane are read, too, since cells have a height and noise is averaged. A ray at the
height v of the detector passes the object at z = v (1 + s / sod) / M, s behind the axis, its
opposite at v (1 - s / sod) / M. Over rows that lie evenly about the plane all that is odd in v
cancels, a slope of the object along z first of all. Of what is even, e(v), the conjugate rays of
the mean over −V … V differ, to first order in s / sod, by

    2 (s / sod) · (e(V) - mean of e),

integrating ∫ v e'(v) dv by parts: only what changes between the rows that are averaged and their
border counts. An object that is the same in all rows has none of it, the face of a disc within the
rows all. s is not known of a ray, but over the views it is what t = sod · sin γ is, so that a mean
square is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpcct.geometry import ConeBeam

_FLAT_CELLS = 1.0
"""Rows whose conjugate rays part by more than so many of them at the border of the field are not
averaged."""
PARTED = 2.5
"""Times the mean square of what conjugate rays part by, as it is here estimated, that they may
differ: 2.1 times at most of 150 sound scans drawn at random (bodies beside the axis, parts of a
turn, opaque ones)."""
THIN = 0.5
"""Of a view's sum, what ends between the rows that are averaged and the next, from which on the
object may be thinner than a row: how it changes within one is not known then."""
_NEEDED = 16.0
"""Square of the standard errors of a finding: how many variances of noise weigh as much as what
rays part by."""


@dataclass(frozen=True)
class OrbitPlane:
    """The mean of the rows about the plane of the source.

    Attributes:
        lines: ``(views, 1, columns)``.
        parted: mean square by which conjugate rays of a sound scan may differ, since they part
            along z.
        part: of the sum of a view, what changes between the rows and their border, or from row to
            row.
        away: root mean square distance of the object from the axis, over sod.
        rows: how many were averaged.
        lacking: ``(views, columns)``, what they may lack because cells average transmissions
            (:func:`lack_of_cells`).
    """

    lines: Tensor
    parted: float
    part: float
    away: float
    rows: int
    lacking: Tensor

    def turned(self, *, closed: bool) -> float:
        """Relative change with the direction that the sum of a view may show, as the rays part
        along z.

        Args:
            closed: over a full turn, what is of first order has another period than what is tested.
        """
        return 2.0 * self.part * (self.away**2 if closed else self.away)


def orbit_plane(lines: Tensor, geometry: ConeBeam) -> OrbitPlane | None:
    """The plane of the source as one row; None: no row lies in it.

    As many rows are averaged as a test of the result gains by: the more, the less noise, and the
    farther the rays part.

    Args:
        lines: line integrals ``(views, rows, columns)``.
        geometry: of the scan.
    """
    levels, onward = _levels(geometry)
    if not levels:
        return None
    heights, row = np.array(levels), geometry.pitch[0]
    even = [(_row(lines, geometry, v) + _row(lines, geometry, -v)) / 2 for v in heights]
    counts = np.where(heights > 0, 2, 1)
    off_axis = geometry.sod * torch.from_numpy(np.sin(geometry.fan_angles)).to(lines)
    reach = float(off_axis.abs().max())
    flat = max(0.5, _FLAT_CELLS * geometry.sod / reach) if reach else math.inf
    flat *= row * (1 + 1e-9)
    noise: float | None = None
    best: tuple[float, OrbitPlane] | None = None
    total, lacking, rows = torch.zeros_like(even[0]), torch.zeros_like(even[0]), 0
    stepping = 0.0
    for k, level in enumerate(even):
        if k and heights[k] > flat:
            break
        total, rows = total + float(counts[k]) * level, rows + int(counts[k])
        mean = total / rows
        border, guarded = _border(lines, geometry, heights[k] + onward)
        beside = [
            _row(lines, geometry, side * v)
            for v in (heights[k] - onward, heights[k] + onward)
            for side in (-1, 1)
        ]
        ends = [level] if border is None else [beside[2] - beside[0], beside[3] - beside[1]]
        steps = [e.double().numpy() for e in ends]
        lacking += float(counts[k]) * torch.from_numpy(
            np.mean([lack_of_cells(step) for step in steps], axis=0)
        )
        step = np.mean([_without_noise(step) for step in steps], axis=0)
        stepping += float(counts[k]) * float(np.minimum(step, np.abs(level.numpy())).mean())
        # Without rows beside them nobody knows where the object ends: all of it may.
        change = mean if border is None else border - mean
        square = shared_square(change)
        if border is not None:
            square = max(
                square, shared_square((level - border) / 2), 0.0 if guarded else shared_square(mean)
            )
        away = _spread(change, off_axis) if square > 0 else 0.0
        parted = PARTED * 4.0 * square * away / geometry.sod**2
        # Of absolute values: what all views share may have been taken off the line integrals.
        sums, all_of_it = change.mean(1), float(mean.abs().mean())
        # Of a body thinner than a row every row steps, and the means may be alike.
        ends_within = max(float(sums.abs().mean()), stepping / rows)
        share = ends_within / all_of_it if all_of_it > 0 else 1.0
        if share > THIN:
            crossing = shared_square(_crossing(lines, geometry, float(heights[k]), onward))
            crossing /= rows**2
            parted = max(parted, crossing)
        if noise is None:
            # Of one row: the border is the mean of two, the first level of one or two.
            noise = max(float(change.double().square().mean()) - shared_square(change), 0.0) / (
                0.5 + 1.0 / rows
            )
        cost = _NEEDED * 2.0 * noise / rows + parted * mean.numel() / 2
        if best is None or cost < best[0]:
            far = math.sqrt(_spread(mean, off_axis)) / geometry.sod
            best = (
                cost,
                OrbitPlane(mean[:, None], parted, min(share, 1.0), far, rows, lacking / rows),
            )
    return None if best is None else best[1]


def _levels(geometry: ConeBeam) -> tuple[list[float], float]:
    """Heights v ≥ 0 in steps of a row at which the detector has something to say of v and −v; and
    how far from the last of them what lies beside is read."""
    row = geometry.pitch[0]
    low, high = geometry.row_positions[0], geometry.row_positions[-1]
    ends = min(-low, high) + 1e-6 * row
    odd = abs((low / row) % 1.0 - 0.5) < 0.25
    first = 0.5 * row if odd else 0.0
    if ends < first:
        # A plane in the outer half of the outermost row, read from it and the next, or nowhere.
        inside = min(-low, high) >= -0.5 * row * (1 + 1e-9)
        return [0.0] if inside else [], 1.5 * row
    return list(np.arange(first, ends, row)), row


def _border(lines: Tensor, geometry: ConeBeam, height: float) -> tuple[Tensor | None, bool]:
    """What lies beside the rows up to a height, and whether it does on both sides; None: no row
    is there."""
    low, high = geometry.row_positions[0], geometry.row_positions[-1]
    reach = height - (0.5 + 1e-6) * geometry.pitch[0]
    sides = [
        _row(lines, geometry, side * height)
        for side, end in ((-1, -low), (1, high))
        if end >= reach
    ]
    return (sum(sides[1:], sides[0]) / len(sides) if sides else None), len(sides) == 2


def _crossing(lines: Tensor, geometry: ConeBeam, height: float, onward: float) -> Tensor:
    """What may leave the rows up to a height for those beside them on the way to the conjugate ray,
    or come from there, ``(views, columns)``.

    A body thinner than a row that lies at their border is in one of them from this side, in the
    other from that side: no more of it than the lesser of the two reads, and nothing where they and
    the row beyond read the same.
    """
    tolerance, row = 1e-6 * geometry.pitch[0], geometry.pitch[0]
    low, high = geometry.row_positions[0], geometry.row_positions[-1]
    total = torch.zeros_like(lines[:, 0])
    for side, end in ((-1, -low), (1, high)):
        if end < height + onward - row / 2 - tolerance:
            continue
        heights = (height, height + onward, height + onward + row)
        inside, beside, beyond = (_row(lines, geometry, side * v) for v in heights)
        if end < heights[2] - row / 2 - tolerance:  # nobody knows what is there
            beyond = torch.zeros_like(beside)
        step = torch.maximum((inside - beside).abs(), (beside - beyond).abs())
        total += torch.minimum(torch.minimum(inside, beside).clamp_min(0.0), step)
    return total


def _row(lines: Tensor, geometry: ConeBeam, height: float) -> Tensor:
    """``(views, columns)`` at a height on the detector, between its neighbours."""
    at = float(
        np.clip((height - geometry.row_positions[0]) / geometry.pitch[0], 0, geometry.rows - 1)
    )
    near = round(at)
    if abs(at - near) < 1e-6:
        return lines[:, near]
    low = math.floor(at)
    return torch.lerp(lines[:, low], lines[:, low + 1], at - low)


def lack_of_cells(steps: NDArray[np.float64]) -> NDArray[np.float64]:
    """What line integrals may lack in cells in which the object ends, ``(views, columns)``.

    The logarithm of a mean of transmissions lies below the mean of the line integrals: where they
    step by J from one neighbour to the other, and the step covers the part q of the cell, by q J +
    ln(1 - q (1 - exp(-J))). Its maximum over q is taken, J² / 8 of small steps.

    Args:
        steps: J, with noise that is independent from view to view.
    """
    step = np.maximum(_without_noise(steps), 1e-3)
    passing = -np.expm1(-step)
    lack: NDArray[np.float64] = step * (1.0 - passing / step) / passing + np.log(passing / step)
    return np.maximum(lack, 0.0)


def _without_noise(steps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sizes of steps that the next view has, too."""
    size: NDArray[np.float64] = np.sqrt(np.maximum(steps * np.roll(steps, 1, 0), 0.0))
    return size


def shared_square(values: Tensor) -> float:
    """Mean square of ``(views, columns)`` without its noise: products of neighbours, whose noise is
    independent.

    A detail may be as narrow as a column, or wander on by more than itself from view to view: the
    larger of the two.
    """
    if min(values.shape) < 2:
        return float(values.double().square().mean())
    across = float((values[:, 1:] * values[:, :-1]).double().sum()) / values.numel()
    onward = float((values * values.roll(1, 0)).double().mean())
    return max(across, onward, 0.0)


def _spread(values: Tensor, away: Tensor) -> float:
    """Twice the mean square of the distances from the axis at which values are: that from the
    axis of their places."""
    weight = (values[:, 1:] * values[:, :-1]).double().sum(0).clamp_min(0.0)
    if float(weight.sum()) <= 0:
        return float(away.square().max())
    square = ((away[1:] + away[:-1]) / 2).square().double()
    return 2.0 * float((weight * square).sum() / weight.sum())
