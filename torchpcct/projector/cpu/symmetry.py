"""Which rotations and reflections of the image map the scan onto itself.

An operation ``(m, s)`` maps a point ``p`` to ``R^m S^s p``: R turns by 90° counter-clockwise, S
mirrors y. If it maps every view to another view of the scan, the readings of view β of the image
``f(R^m S^s p)`` are the readings of the mapped view of ``f``. Then one pass over a part of the
views serves all operations at once. The grid need not be centred on the axis: the operated grids
then lie apart from each other, by whole voxels and by a part of one (:class:`Placement`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchpcct.geometry import Geometry, VolumeGrid
from torchpcct.projector.rays import Rays

Ints = NDArray[np.int64]
_TURNS = [(m, 0) for m in range(4)]
"""Quarter turns, without reflection: (turns, reflected)."""
_SETS = (
    _TURNS + [(m, 1) for m in range(4)],
    _TURNS,
    [(0, 0), (1, 0), (0, 1), (1, 1)],
    [(0, 0), (2, 0), (0, 1), (2, 1)],
    [(0, 0), (1, 0)],
    [(0, 0), (2, 0)],
    [(0, 0), (0, 1)],
    [(0, 0)],
)
"""Groups of turns and reflections of the grid that lanes are made of, the largest first."""
_COST = {1: 1.0, 2: 1.2, 4: 1.3, 8: 1.5}
"""Lanes → time of a pass over that with one lane (a vector of 8 float32 is one register), measured
with lanes at the same place."""
_COST_APART = {2: 2.6, 4: 2.8, 8: 3.2}
"""The same of lanes at different places."""
_TOLERANCE = 1e-9
"""Difference in rad of angles that are the same."""
_SAME_PLACE = 1e-12
"""Voxels; rounding of the centre."""


@dataclass(frozen=True, eq=False)
class Orbits:
    """Views that are projected, and where the lanes of each go.

    Args:
        operations: the operations ``(m, s)``, the identity first.
        views: ``(n,)`` int64, the views that are projected.
        target: ``(n, lanes)`` int64, the view that each lane is the reading of, or -1 (a double, to
            be ignored).
        reverse: ``(n, lanes)`` int64, 1 if the lane's columns run backwards.
    """

    operations: tuple[tuple[int, int], ...]
    views: Ints
    target: Ints
    reverse: Ints


@dataclass(frozen=True, eq=False)
class Placement:
    """Where the operated grids lie on one lattice that holds them all.

    Args:
        center: centre of the lattice's voxels ``(y, x)``, mm, for a lattice of the shape ``shape``.
        shape: rows and columns of the lattice.
        shift: ``(operations, 2)`` int64, row and column of the lattice where each operated grid
            begins.
        part: ``(operations, 2)`` float64, part of a row and column by which it lies beyond that.
    """

    center: tuple[float, float]
    shape: tuple[int, int]
    shift: Ints
    part: NDArray[np.float64]

    @property
    def apart(self) -> bool:
        """True if the operated grids do not share a lattice exactly."""
        return bool(self.part.any())


def place(operations: tuple[tuple[int, int], ...], grid: VolumeGrid) -> Placement:
    """The lattice of all operated grids on which they lie least apart."""
    cy, cx = grid.center
    centers = np.empty((len(operations), 2))
    for i, (m, s) in enumerate(operations):
        x, y = cx, cy
        for _ in range(m):
            x, y = y, -x  # the operated image shows the point p at S^s R^-m p
        centers[i] = (-y if s else y), x
    centers /= np.asarray(grid.spacing)
    start, middle = np.empty(2), np.empty(2)
    shift, part = np.empty(centers.shape, dtype=np.int64), np.empty_like(centers)
    for axis in range(2):
        fraction = np.sort(np.mod(centers[:, axis], 1.0))
        gaps = np.diff(np.append(fraction, fraction[0] + 1.0))
        # The parts of a voxel lie on a circle: cut it in the widest gap.
        first = fraction[(int(gaps.argmax()) + 1) % fraction.size]
        spread = 1.0 - gaps.max()
        middle[axis] = first + (spread / 2 if spread > _SAME_PLACE else 0.0)
        away = centers[:, axis] - middle[axis]
        whole = np.round(away).astype(np.int64)
        part[:, axis] = away - whole
        start[axis] = whole.min()
        shift[:, axis] = whole - whole.min()
    part[np.abs(part) < _SAME_PLACE] = 0.0
    more = shift.max(axis=0)
    center = (middle + start + more / 2) * np.asarray(grid.spacing)
    shape = tuple(int(n + k) for n, k in zip(grid.shape, more, strict=True))
    return Placement((float(center[0]), float(center[1])), (shape[0], shape[1]), shift, part)


def no_orbits(views: int) -> Orbits:
    """Every view on its own."""
    return Orbits(
        ((0, 0),), np.arange(views), np.arange(views)[:, None], np.zeros((views, 1), dtype=np.int64)
    )


def find_orbits(geometry: Geometry, grid: VolumeGrid, rays: Rays, windowed: bool) -> Orbits:
    """The cheapest set of operations (the identity alone, if the scan or the grid has no
    symmetry)."""
    views = geometry.views
    trivial = no_orbits(views)
    turn = 2 * math.pi
    angles = np.mod(geometry.angles, turn)
    order = np.argsort(angles, kind="stable")
    sorted_angles = angles[order]
    gaps = np.diff(np.append(sorted_angles, sorted_angles[0] + turn))
    if windowed or (views > 1 and gaps.min() < _TOLERANCE):
        return trivial
    square = grid.shape[0] == grid.shape[1] and math.isclose(
        grid.spacing[0], grid.spacing[1], rel_tol=1e-12
    )
    position = rays.edges[:, 1] if rays.edges.shape[0] else np.zeros(1)
    even = bool(np.abs(position + position[::-1]).max() <= 1e-9 * np.abs(position).max())

    def find(wanted: NDArray[np.float64]) -> Ints:
        """Index of the view at each angle, -1 where there is none."""
        wanted = np.mod(wanted, turn)
        right = np.searchsorted(sorted_angles, wanted) % views
        best = np.full(wanted.shape, -1)
        for near in (right, (right - 1) % views):
            distance = np.abs(np.mod(sorted_angles[near] - wanted + math.pi, turn) - math.pi)
            best = np.where(distance < _TOLERANCE, order[near], best)
        return best

    best, best_cost = trivial, views * _COST[1]
    for operations in _SETS[:-1]:
        if any((m % 2 and not square) or (s and not even) for m, s in operations):
            continue
        target = np.empty((views, len(operations)), dtype=np.int64)
        reverse = np.empty_like(target)
        for lane, (m, s) in enumerate(operations):
            wanted = (-angles if s else angles) + m * math.pi / 2
            target[:, lane], reverse[:, lane] = find(wanted), s
            if rays.parallel and even:
                # A parallel view and the one from the other side read the same lines, columns
                # reversed.
                other = find(wanted + math.pi)
                swap = target[:, lane] < 0
                target[swap, lane], reverse[swap, lane] = other[swap], 1 - s
        if (target < 0).any():
            continue
        seen = [False] * views
        chosen = []
        for v, row in enumerate(target.tolist()):
            if seen[v]:
                continue
            for lane, to in enumerate(row):
                if seen[to]:
                    target[v, lane] = -1
                seen[to] = True
            chosen.append(v)
        placed = place(tuple(operations), grid)
        cost = len(chosen) * (_COST_APART if placed.apart else _COST)[len(operations)]
        # empty voxels between the lanes' grids and the rest
        cost *= math.prod(placed.shape) / math.prod(grid.shape)
        if cost < best_cost:
            best_cost = cost
            best = Orbits(tuple(operations), np.array(chosen), target[chosen], reverse[chosen])
    return best


def address(operation: tuple[int, int], ny: int, nx: int) -> Ints:
    """``(base, per row, per column)``: flat index in the image that the operated image reads at
    (row, column)."""
    m, s = operation
    index = np.arange(ny * nx).reshape(ny, nx)
    for _ in range(m):
        index = index[:, ::-1].T
    if s:
        index = index[::-1]
    base = int(index[0, 0])
    down = int(index[1, 0]) - base if index.shape[0] > 1 else 0
    right = int(index[0, 1]) - base if index.shape[1] > 1 else 0
    return np.array([base, down, right], dtype=np.int64)


def inverse(operation: tuple[int, int], ny: int, nx: int) -> Ints:
    """Row and column of the operated image that show pixel (y, x): two times (base, per y, per
    x)."""
    row, column = np.array([0, 1, 0]), np.array([0, 0, 1])
    for _ in range(operation[0]):
        row, column = np.array([nx - 1, 0, 0]) - column, row
        ny, nx = nx, ny
    if operation[1]:
        row = np.array([ny - 1, 0, 0]) - row
    return np.concatenate([row, column]).astype(np.int64)
