"""Does every cell of the detector read what it should, where it should? Tests of columns that hold
in all views.

No object but one that turns with the detector stays in a column: what a cell reads above or below
its neighbours in the views of every part of the scan is its gain. What is round about the axis does
stay; its shadow is the same on the other side of the axis, so what the mirrored place shows, too,
is taken off. The cell on the axis is its own mirror image: a wire there and a gain of its cell are
the same readings, and only a large deviation is named.

Columns that alternate about their places (the order of two is exchanged, a readout that interleaves
them wrongly) leave a residual that alternates from column to column and looks like the slope along
the columns.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpcct.checks.scan_test import UNKNOWN, ScanTest, check_lines
from torchpcct.geometry import Geometry
from torchpcct.readings import MEDIAN_TO_SD
from torchpcct.validate import checked

__all__ = ["column_test"]

Floats = NDArray[np.float64]

GAIN_TOLERANCE = 0.03
"""Deviation of a cell's log signal from its neighbours' that is no finding."""
AXIS_TOLERANCE = 0.1
"""The same of the cell on the axis, where something thin may be."""
PLACE_TOLERANCE = 0.25
"""Columns by which those of even and odd number may lie beside their places."""
_FEWEST_COLUMNS = 16
"""Columns of a detector that is tested; of the test of places twice as many."""
_FEWEST_VIEWS = 32
"""Views of a scan that is tested."""
_BLOCKS = 16
"""Parts of the scan in which a deviation must be found."""
_WIDTHS = (1, 2, 3)
"""Columns side by side that deviate alike."""
_SIGMAS = 8.0
"""Standard errors from which a deviation is none of chance."""
_ALIKE = 0.25
"""Share of a deviation by which its neighbours may differ from half of it, the other way."""
_CONSTANT = 0.3
"""Share of a deviation that every part of the scan must show."""


@checked
def column_test(lines: Tensor, geometry: Geometry) -> ScanTest:
    """Test gains and places of the detector's columns.

    Args:
        lines: line integrals ``(views, [rows,] columns)`` of any unit.
        geometry: parallel, fan or cone beam.

    Returns:
        The test of ``gain`` (largest factor by which a cell reads more or less than its neighbours,
        less 1) and ``place`` (columns by which those of even and odd number lie beside their
        places). :data:`~torchpcct.checks.scan_test.UNKNOWN` of fewer than 16 columns or 32 views.

    Raises:
        ValueError: a wrong shape, NaN or Inf.
    """
    g: Geometry = geometry
    check_lines(lines, g.shape)
    if g.columns < _FEWEST_COLUMNS or g.views < _FEWEST_VIEWS:
        return UNKNOWN
    order = torch.from_numpy(np.argsort(g.angles, kind="stable"))
    parts = [lines.detach()[k.to(lines.device)] for k in torch.tensor_split(order, _BLOCKS)]
    blocks = torch.stack([part.mean(0, dtype=torch.float64) for part in parts]).cpu().numpy()
    blocks = blocks.reshape(_BLOCKS, -1, g.columns)
    gain, gain_text = _gain(blocks, g)
    place, error = _place(lines, g)
    findings = [gain_text] if gain_text else []
    if abs(place) - _SIGMAS * error > PLACE_TOLERANCE:
        findings.append(
            f"the columns of even and of odd number are displaced by about {abs(place):.1f} "
            f"columns in opposite directions ({abs(place) / error:.0f} standard errors): "
            "neighbouring columns are exchanged, or interleaved the wrong way; edges are torn; "
            "sort the columns"
        )
    return ScanTest({"gain": gain, "place": place}, {"place": error}, tuple(findings))


def _gain(blocks: Floats, g: Geometry) -> tuple[float, str]:
    """Largest gain error, and what to say of it."""
    columns = g.columns
    u = np.asarray(g.column_positions)
    step = float(u[1] - u[0])
    largest, text = 0.0, ""
    for width in _WIDTHS:
        if columns < 8 * width:
            break
        means = np.lib.stride_tricks.sliding_window_view(blocks, width, axis=-1).mean(-1)
        bend = means[..., width:-width] - (means[..., : -2 * width] + means[..., 2 * width :]) / 2.0
        # Index k is of the columns k + width … k + 2 width − 1.
        centre = u[width] + step * ((width - 1) / 2.0) + step * np.arange(bend.shape[-1])
        mirrored = (-centre - centre[0]) / step
        inside = (mirrored >= 0) & (mirrored <= bend.shape[-1] - 1)
        low = np.clip(np.floor(mirrored).astype(int), 0, bend.shape[-1] - 2)
        share = np.clip(mirrored - low, 0.0, 1.0)
        other = np.where(inside, (1.0 - share) * bend[..., low] + share * bend[..., low + 1], 0.0)
        own = np.abs(centre) < 0.49 * width * step
        mean, opposite = bend.mean(0), other.mean(0)
        # The place whose mirror image deviates more is that image.
        excess = np.where(own, bend, bend - other)
        size = excess.mean(0)
        # Of the parts without the object's edges.
        error = (
            MEDIAN_TO_SD
            * np.median(np.abs(excess - np.median(excess, axis=0)), axis=0)
            / math.sqrt(_BLOCKS)
        )
        usual = MEDIAN_TO_SD * np.median(np.abs(size), axis=-1, keepdims=True)
        tolerance = np.where(own, AXIS_TOLERANCE, GAIN_TOLERANCE)
        # An edge of the object may stand in the column in two parts of the scan.
        constant = np.partition(np.sign(size) * excess, 2, axis=0)[2] > _CONSTANT * np.abs(size)
        wrong = (
            np.abs(size) > np.maximum(tolerance, _SIGMAS * np.maximum(error, usual))
        ) & constant
        # Nothing alike may stand about the mirrored place: interpolation blurs thin walls, and the
        # faces of a round body that end within a row. Near the axis the column itself is there.
        index = np.arange(bend.shape[-1])
        sides = []
        for k in (-1, 0, 1, 2):
            there = np.clip(low + k, 0, bend.shape[-1] - 1)
            apart = np.abs(there - index) >= 2 * width
            like = np.maximum(2.0 * np.sign(mean) * mean[..., there], np.abs(mean[..., there]))
            sides.append(np.where(apart, like, 0.0))
        alike = 1.5 * np.maximum(
            np.where(np.abs(centre) < 3.0 * width * step, np.abs(opposite), 0.0),
            np.max(sides, axis=0),
        )
        wrong &= np.abs(mean) > np.where(inside, alike, 0.0)
        # The neighbours of a wrong gain bend by half as much, the other way.
        left, right = (np.roll(mean, k, axis=-1) for k in (width, -width))
        neighbours = np.maximum(np.abs(left + mean / 2.0), np.abs(right + mean / 2.0))
        wrong &= neighbours < _ALIKE * np.abs(mean)
        wrong[..., :width] = wrong[..., -width:] = False
        if not wrong.any():
            continue
        found = np.where(wrong, np.abs(mean), 0.0)
        most = float(found.max())
        if most <= 1.1 * abs(largest):
            continue
        row, column = np.unravel_index(int(np.argmax(found)), found.shape)
        largest = float(math.expm1(-mean[row, column]))
        deviation = float(error[row, column])
        text = _gain_text(wrong, int(row), int(column) + width, width, largest, deviation, g)
    return largest, text


def _gain_text(
    wrong: NDArray[np.bool_],
    row: int,
    column: int,
    width: int,
    size: float,
    error: float,
    g: Geometry,
) -> str:
    many = int(wrong.sum()) - 1
    what = f"column {column}" if width == 1 else f"columns {column} … {column + width - 1}"
    if g.has_rows and wrong[:, column - width].mean() < 0.5:
        what += f" of row {row}"
    more = f" (and {many} more)" if many > 0 and not g.has_rows else ""
    reads = "reads" if width == 1 else "read"
    return (
        f"{what}{more} {reads} {1.0 + size:.3g} ± {error * (1.0 + size):.1g} times what its "
        "neighbours do, in all views: a wrong gain, which draws a ring; measure air again, or "
        "mask it (dead=)"
    )


def _place(lines: Tensor, g: Geometry) -> tuple[float, float]:
    """Shift of the columns that alternates, in columns, and its error from the scatter of blocks
    of views."""
    rows = lines.detach().reshape(g.views, -1, g.columns)
    rows = rows[:, :: max(1, rows.shape[1] // 8)]
    rows = rows[:: max(1, rows.numel() // 4_000_000)]
    p = rows.to("cpu", torch.float64).numpy()
    p = p - p.mean(0)  # edges of what is round stay in their columns, and say nothing of these
    # Over an even distance, which an exchange of neighbours keeps; of readings that the bend does
    # not hold.
    slope = (p[..., 8:] - p[..., :-8]) / 8.0
    bend = p[..., 4:-4] - (p[..., 5:-3] + p[..., 3:-5]) / 2.0
    sign = 1.0 - 2.0 * (np.arange(bend.shape[-1]) % 2)
    score = (sign * bend * slope).sum((1, 2))
    # next to each other they share no reading
    power = (slope[..., 1:] * slope[..., :-1]).sum((1, 2))
    total = float(power.sum())
    if len(p) < _BLOCKS or total <= 0.0 or g.columns < 2 * _FEWEST_COLUMNS:
        return 0.0, math.inf
    parts = np.array([score[b].sum() for b in np.array_split(np.arange(len(p)), _BLOCKS)])
    # A shift by ε to either side bends by 2 ε slopes.
    return float(parts.sum()) / (2.0 * total), float(parts.std(ddof=1)) * math.sqrt(_BLOCKS) / (
        2.0 * total
    )
