"""Do all columns of the detector lie where the geometry says? A module that is displaced against
the others.

A detector is made of modules, blocks of columns side by side. One that is displaced by part of a
column, or whose columns were sorted in one place too far, reads the object beside where it is.
Conjugate rays see one line: where columns k and k' meet as a pair and are described ε and ε' above
where they are, the difference of their readings is −(ε + ε') times the slope along the columns (see
:mod:`torchpcct.checks.conjugate_rays`, where ε is the same for all). Its regression on the slope,
column by column, is a profile of (ε + ε') / 2 that is flat or slowly changing for errors of the
centre, of the fan angles and for motion; a displaced module stands out of it as a box. Every gain,
and whatever else of a column is the same in all views, is taken off as the mean over the views.

What this cannot show: on which side of the axis the module is, since a pair has a column on either;
a displacement of both alike the other way; modules of scans without conjugate rays (short scans),
of a few columns, beside the object, or in front of what is round about the axis.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from torchpcct.checks.ray_pairs import BLOCKS, RayPairs, varying
from torchpcct.checks.scan_test import UNKNOWN, ScanTest

__all__ = ["module_test"]

Floats = NDArray[np.float64]

MODULE_TOLERANCE = 0.4
"""Displacement of a module in columns that is no finding: of thin walls that rays pass along,
interpolation between few views leaves as much."""
_SIGMAS = 6.5
"""Standard errors from which a displacement is none of chance, the largest of all blocks."""
_SURE = 3.0
"""Standard errors by which it must be larger than tolerated."""
_FIRST_ORDER = 0.1
"""Part of a displacement to which it is known at best, of slopes that change within it."""
_SLOPE_COLUMNS = 5
"""Columns over which slopes are smoothed."""
_EVEN = 8.0
"""Effective number of blocks of views that a displacement must be seen in."""
_PARTED = 0.01
"""Share of the squared difference by which rays may part that may look like a block: 0.002 of sound
scans of two rows in which one was seen."""
_BENDS = 6
"""Degree of the polynomial over the columns that they look like as well."""
_SQUARE = 0.9
"""Part of what a block explains that this polynomial explains at most: 0.97 and more of 26 such
scans, 0.65 to 0.86 of displaced modules."""
_SEEN = 2.5
"""Effective number of columns that a displacement must be seen in: edges are blurred one by one,
over the width of coarse cells, and a module has :data:`_LEAST`."""
_LEAST = 4
"""Columns of the narrowest module, and the fewest beside it."""
_MOST = 128
"""Groups of columns of a side that are distinguished."""


def module_test(pairs: RayPairs) -> ScanTest:
    """Test whether a block of columns is displaced against the others.

    Args:
        pairs: of a whole detector, of a cone beam in the plane of the source.

    Returns:
        The test of ``module``: by how many columns a block of columns lies beside its place, the
        one that stands out most; its sign is that of
        :func:`~torchpcct.checks.conjugate_rays.centre_test`. ``others`` is the same of all other
        columns. :data:`~torchpcct.checks.scan_test.UNKNOWN` where too little is to be seen.
    """
    if pairs.used(_SLOPE_COLUMNS).size < 2 * BLOCKS:
        return UNKNOWN
    score, power, first, group = _profile(pairs)
    found = _block(score, power)
    if found is None:
        return UNKNOWN
    (begin, end), here, there = found
    # One of the two columns of a pair.
    size, error = 2.0 * (here.size - there.size), 2.0 * math.hypot(here.error, there.error)
    sigmas = abs(size) / error
    findings = []
    sure = sigmas > _SIGMAS and abs(size) > MODULE_TOLERANCE + _SURE * error
    if sure and _is_block(score, power, begin, end, _PARTED * pairs.parted):
        g = pairs.rays.geometry
        low, high = first + group * begin, min(first + group * end, g.columns) - 1
        mirrored = round(-2.0 * float(g.column_positions[0]) / g.column_pitch)
        known = math.hypot(error, _FIRST_ORDER * size)
        findings.append(_text(low, high, mirrored, begin == 0, size, known))
    sizes, errors = {"module": size, "others": there.size}, {"module": error, "others": there.error}
    return ScanTest(sizes, errors, tuple(findings))


class _Part(NamedTuple):
    """How far columns are described above where they are, and the standard error."""

    size: float
    error: float


def _profile(pairs: RayPairs) -> tuple[Floats, Floats, int, int]:
    """Score and power of a shift, ``(blocks, groups)``: of groups of columns beyond the axis over
    blocks of views; the first column, and how many a group has."""
    smooth, raw, known = pairs.slopes("columns", _SLOPE_COLUMNS)
    kept = known.double()
    # Without what is the same in all views.
    slopes, own = ([varying(v, kept, 0) for v in both] for both in (smooth, raw))
    # Of a shift the difference is -2 times the slope.
    score = -varying(pairs.residue, kept, 0) * (slopes[0] + slopes[1])
    power = 2.0 * (slopes[0] * own[1] + slopes[1] * own[0])
    order = torch.from_numpy(np.argsort(pairs.angles, kind="stable"))
    both = [
        torch.stack([part.sum((0, 1)) for part in torch.tensor_split(v[order], BLOCKS)]).numpy()
        for v in (score, power)
    ]
    # A pair counts once, with its column beyond the axis.
    beyond = np.flatnonzero(kept.sum((0, 1)).numpy() > 0)
    if not beyond.size:
        return both[0][:, :0], both[1][:, :0], 0, 1
    first, last = int(beyond[0]), int(beyond[-1])
    group = math.ceil((last + 1 - first) / _MOST)
    starts = np.arange(first, last + 1, group)
    sums = [np.add.reduceat(v[:, : last + 1], starts, axis=1) for v in both]
    return sums[0], sums[1], first, group


def _sized(score: Floats, power: Floats) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Size, its squared error by the scatter of the blocks (first axis), and where it is seen in
    many of these."""
    total = power.sum(0)
    seen = (total > 0.0) & (total**2 > _EVEN * (power**2).sum(0))
    safe = np.where(seen, total, 1.0)
    size = score.sum(0) / safe
    square = ((score - size * power) ** 2).sum(0) * BLOCKS / (BLOCKS - 1.0) / safe**2
    return size, square, seen & (square > 0.0)


def _block(score: Floats, power: Floats) -> tuple[tuple[int, int], _Part, _Part] | None:
    """The block of columns that differs most from all others: its first and its end; and what is
    found in it, and in all others."""
    groups = score.shape[1]
    if groups < 3 * _LEAST:
        return None
    sums = [np.cumsum(np.pad(v, ((0, 0), (1, 0))), axis=1) for v in (score, power)]
    begin, end = (k.ravel() for k in np.meshgrid(np.arange(groups), np.arange(1, groups + 1)))
    fits = (end - begin >= _LEAST) & (end - begin <= groups - _LEAST)
    begin, end = begin[fits], end[fits]
    inside = [s[:, end] - s[:, begin] for s in sums]
    outside = [s[:, -1:] - part for s, part in zip(sums, inside, strict=True)]
    here, square, seen = _sized(*inside)
    there, other, seen_there = _sized(*outside)
    errors = np.sqrt(np.maximum(square + other, 1e-300))
    sigmas = np.where(seen & seen_there, np.abs(here - there) / errors, 0.0)
    best = int(np.argmax(sigmas))
    if not sigmas[best]:
        return None
    parts = [_Part(float(v[best]), math.sqrt(e[best])) for v, e in ((here, square), (there, other))]
    return (int(begin[best]), int(end[best])), parts[0], parts[1]


def _is_block(score: Floats, power: Floats, begin: int, end: int, parted: float) -> bool:
    """Whether what a block explains is seen in several of its columns, and is more of the squared
    difference than a parabola over the columns does, which errors of the centre, of the fan angles
    and of the orbit look like; and where rays that part along z may be what it explains, more than
    a polynomial that bends as often as they make it.

    Args:
        score, power: ``(blocks, groups)``.
        begin, end: groups of the block.
        parted: squared difference that rays may part by where they look like a block.
    """
    a, b = score.sum(0), np.maximum(power.sum(0), 0.0)
    at = np.arange(a.size)
    x = np.linspace(-1.0, 1.0, a.size)
    inside = ((at >= begin) & (at < end)).astype(np.float64)

    def explained(*model: Floats) -> float:
        design = np.stack(model, 1)
        product = design.T @ a
        normal = design.T @ (b[:, None] * design)
        return float(product @ np.linalg.pinv(normal, hermitian=True) @ product)

    within = b[begin:end]
    if within.sum() ** 2 < _SEEN * np.square(within).sum():
        return False
    block = explained(x**0, inside)
    if block <= explained(x**0, x, x**2):
        return False
    constant = explained(x**0)
    smooth = explained(*(x**k for k in range(_BENDS + 1)))
    return block - constant > parted or smooth - constant < _SQUARE * (block - constant)


def _text(low: int, high: int, mirrored: int, middle: bool, size: float, error: float) -> str:
    """``mirrored``: sum of a column's number and that on the other side of the axis; ``middle``:
    whether the block begins at the axis."""
    part = " (half of that if it reaches over the axis)" if middle else ""
    return (
        f"conjugate rays disagree in the columns {low} … {high}, or those on the other side of the "
        f"axis ({mirrored - high} … {mirrored - low}), by a displacement of about {abs(size):.2f} "
        f"± {2.0 * error:.1g} columns{part} that the others do not have: a module of the detector "
        "is displaced, or its columns are in the wrong order; edges behind it are torn "
        "or double; give the true positions, or mask it (dead=)"
    )
