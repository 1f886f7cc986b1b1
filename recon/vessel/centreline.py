"""The line a vessel runs along, in any direction: found in a smooth volume, and coordinates about
it.

A line is a cubic spline through points in mm with a frame that does not turn about it (rotation
minimising: Wang, Jüttler, Zheng, Liu 2008, "Computation of rotation minimizing frames", the double
reflection). A point of space has three coordinates there: s along the line, and distance ρ and
angle θ in the plane across.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from torchpcct.geometry import VolumeGrid

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


Floats = NDArray[np.float64]

_STEP_MM = 0.4
"""Of the walk along a vessel, and between the points that its line goes through."""
_AHEAD_MM = np.array([[0.5], [1.0], [1.5], [2.0]])
"""Where a walk that no longer moves on looks whether the vessel does."""
_SMOOTH_MM = 1.0
"""Length along the vessel below which bends of the points found are taken for noise."""
_FINE_MM = 0.05
"""Spacing of the points of the line's table, mm."""
_MOST_STEPS = 400
"""Sections of a walk along a vessel at most."""
_RIM_MM = 0.5
"""The walk ends so far from the rim of the volume, mm."""


@dataclass(frozen=True)
class Coordinates:
    """Points about a line.

    Attributes:
        s, rho, theta: ``(n,)`` mm, mm, rad.
        frame: ``(n, 3, 3)`` unit vectors (z, y, x): away from the line, around it, along it.
    """

    s: Floats
    rho: Floats
    theta: Floats
    frame: Floats


@dataclass(frozen=True, eq=False)
class Centreline:
    """A smooth line.

    Args:
        points: ``(n, 3)`` z, y, x mm, n ≥ 4, in order; the line goes on straight beyond both ends.
    """

    points: Floats

    @cached_property
    def _at(self) -> Floats:
        """Position of every point along the line, 0 in the first."""
        return np.concatenate(
            [[0.0], np.cumsum(np.linalg.norm(np.diff(self.points, axis=0), axis=1))]
        )

    @cached_property
    def _spline(self) -> CubicSpline:
        return CubicSpline(self._at, self.points, bc_type="natural")

    @property
    def length(self) -> float:
        """mm."""
        return float(self._at[-1])

    def point(self, s: ArrayLike) -> Floats:
        """``(..., 3)`` z, y, x mm."""
        s = np.asarray(s, np.float64)
        inside = np.clip(s, 0.0, self.length)
        beyond: Floats = self._spline(inside) + (s - inside)[..., None] * self._spline(inside, 1)
        return beyond

    def tangent(self, s: ArrayLike) -> Floats:
        """``(..., 3)`` unit vectors."""
        t = self._spline(np.clip(s, 0.0, self.length), 1)
        return np.asarray(t / np.linalg.norm(t, axis=-1, keepdims=True))

    @cached_property
    def _samples(self) -> tuple[Floats, Floats, Floats]:
        """Positions, points and a first normal of a fine polyline that reaches 20 mm beyond both
        ends."""
        count = int(np.ceil((self.length + 40.0) / _FINE_MM)) + 1
        s = np.linspace(-20.0, self.length + 20.0, count)
        x, t = self.point(s), self.tangent(s)
        normal = np.empty_like(t)
        start = np.zeros(3)
        start[np.argmin(np.abs(t[0]))] = 1.0
        normal[0] = start - (start @ t[0]) * t[0]
        normal[0] /= np.linalg.norm(normal[0])
        for i in range(count - 1):
            v1 = x[i + 1] - x[i]
            c1 = v1 @ v1
            r, along = normal[i] - 2 / c1 * (v1 @ normal[i]) * v1, t[i] - 2 / c1 * (v1 @ t[i]) * v1
            v2 = t[i + 1] - along
            c2 = v2 @ v2
            normal[i + 1] = r if c2 < 1e-24 else r - 2 / c2 * (v2 @ r) * v2
        return s, x, normal

    def across(self, s: ArrayLike) -> tuple[Floats, Floats]:
        """Two unit vectors across the line at s, ``(..., 3)`` each; θ grows from the first to
        the second."""
        at, _, normals = self._samples
        index = np.clip(
            np.rint((np.asarray(s) - at[0]) / (at[1] - at[0])).astype(int), 0, len(at) - 1
        )
        t = self.tangent(s)
        first = normals[index]
        first = first - np.sum(first * t, -1, keepdims=True) * t
        first /= np.linalg.norm(first, axis=-1, keepdims=True)
        return first, np.cross(t, first)

    def coordinates(self, points: Floats) -> Coordinates:
        """Of points ``(n, 3)`` z, y, x in mm: of the nearest point of the line."""
        at, _, _ = self._samples
        s = at[self._tree.query(points)[1]]
        for _ in range(2):
            t = self.tangent(s)
            s = s + np.sum((points - self.point(s)) * t, -1)
        t = self.tangent(s)
        off = points - self.point(s)
        first, second = self.across(s)
        u, v = np.sum(off * first, -1), np.sum(off * second, -1)
        rho, theta = np.hypot(u, v), np.arctan2(v, u)
        away = np.cos(theta)[:, None] * first + np.sin(theta)[:, None] * second
        around = -np.sin(theta)[:, None] * first + np.cos(theta)[:, None] * second
        return Coordinates(s, np.maximum(rho, 1e-6), theta, np.stack([away, around, t], axis=1))

    def within(self, points: Floats, distance: float) -> NDArray[np.intp]:
        """Which of the points ``(n, 3)`` lie nearer than ``distance`` mm, to some hundredths of
        a millimetre."""
        return np.flatnonzero(
            np.isfinite(self._tree.query(points, distance_upper_bound=distance)[0])
        )

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self._samples[1])


def follow(
    volume: Floats, grid: VolumeGrid, threshold: float, start: Floats, reach: float
) -> tuple[Centreline, Floats]:
    """Walk along a bright vessel from a point in it, both ways, to its ends or to the rim of the
    volume.

    Args:
        volume: ``grid.shape`` HU, smooth.
        grid: of the volume.
        threshold: HU; the vessel is brighter.
        start: ``(3,)`` z, y, x mm.
        reach: mm, radius of the ball whose bright voxels tell where the vessel is and where it
            goes.

    Returns:
        the line, and where on it the vessel ends, ``(2,)`` mm: beyond the rim of the volume where
        it goes on.

    Raises:
        ValueError: nothing bright at the point, or a vessel too short to have a direction.
    """
    excess = np.clip(volume - threshold, 0.0, None)
    index = np.argwhere(excess > 0)
    weight = excess[tuple(index.T)]
    origin, step = np.array([a[0] for a in grid.axes]), np.array(grid.spacing)
    points = origin + index * step
    tree = cKDTree(points) if len(points) else None

    def ball(at: Floats) -> tuple[Floats, Floats, float]:
        near = (
            np.array(tree.query_ball_point(at, reach), dtype=int)
            if tree is not None
            else np.empty(0, int)
        )
        if len(near) < 8:
            return at, np.zeros(3), 0.0
        w = weight[near]
        middle = w @ points[near] / w.sum()
        spread = (points[near] - middle).T @ ((points[near] - middle) * w[:, None]) / w.sum()
        return middle, np.linalg.eigh(spread)[1][:, -1], float(w.sum())

    middle, direction, mass = ball(np.asarray(start, float))
    for _ in range(3):
        middle, direction, mass = ball(middle)
    if not mass:
        raise ValueError(
            f"no vessel brighter than {threshold:.0f} HU at {np.round(start, 2).tolist()} mm (z, "
            "y, x): a plaque is read beside a lumen with contrast agent; give a point in it or "
            "beside it"
        )
    halves: list[list[Floats]] = []
    ends = []
    for sign in (1.0, -1.0):
        at, along, ended = middle, sign * direction, False
        walked: list[Floats] = []
        while len(walked) < _MOST_STEPS:
            moved, turned, full = ball(at + _STEP_MM * along)
            turned = turned if turned @ along >= 0 else -turned
            # At an end the ball's mass stays behind: it no longer moves on. Noise holds it back
            # too, where it is bright ahead.
            ahead = at + _AHEAD_MM * along
            there = ndimage.map_coordinates(excess, ((ahead - origin) / step).T, order=1)
            if (full < 0.25 * mass or (moved - at) @ along < 0.25 * _STEP_MM) and not there.all():
                ended = True
                break
            on = moved - along * ((moved - at) @ along - _STEP_MM)
            low, high = origin - step / 2, origin + (np.array(grid.shape) - 0.5) * step
            if np.any(on < low + _RIM_MM) or np.any(on > high - _RIM_MM):
                break
            at, along = on, _unit(0.6 * along + 0.4 * turned)
            walked.append(at)
        halves.append(walked)
        ends.append(ended)
    found = np.array([*halves[1][::-1], middle, *halves[0]])
    if len(found) < 6:
        raise ValueError(
            f"the bright region at {np.round(start, 1).tolist()} mm (z, y, x) is no vessel that "
            "can be read: it has no direction, or is shorter than 5 mm. Rings of metal (a stent), "
            "bone and noise are as bright; give a point in a lumen with contrast agent"
        )
    line = Centreline(smooth_line(found))
    profile = np.linspace(-2.0, line.length + 2.0, int((line.length + 4.0) / 0.05))
    values = ndimage.map_coordinates(
        volume, ((line.point(profile) - origin) / step).T, order=1, mode="nearest"
    )
    dark = values < threshold
    centre = np.searchsorted(profile, line.length / 2)
    before, after = np.flatnonzero(dark[:centre]), np.flatnonzero(dark[centre:])
    first = float(profile[before[-1]]) if ends[1] and len(before) else -np.inf
    last = float(profile[centre + after[0]]) if ends[0] and len(after) else np.inf
    return line, np.array([first, last])


def sections(
    mask: NDArray[np.bool_], grid: VolumeGrid, line: Centreline, low: float, high: float
) -> tuple[Floats, Floats, Floats]:
    """Centres and radii of a region across a line.

    Args:
        mask: ``grid.shape``, the region.
        grid: of the mask.
        line: along it.
        low, high: part of the line, mm.

    Returns:
        positions ``(n,)`` along the line, centres ``(n, 3)`` and radii ``(n,)`` of discs of the
        same area, mm.
    """
    points = np.array([a[0] for a in grid.axes]) + np.argwhere(mask) * np.array(grid.spacing)
    c = line.coordinates(points)
    at = np.arange(low + _STEP_MM / 2, high, _STEP_MM)
    volume = float(np.prod(grid.spacing))
    keep, centres, radii = [], [], []
    for s in at:
        # Half a step beyond the ends nothing is seen: sections there would be too small and off the
        # line.
        if s < low + _STEP_MM or s > high - _STEP_MM:
            continue
        inside = np.abs(c.s - s) < _STEP_MM
        count = int(inside.sum())
        if count * volume / (2 * _STEP_MM) > 0.1:
            keep.append(s)
            off = points[inside] - line.point(c.s[inside])
            centres.append(line.point(s) + off.mean(0))
            radii.append(np.sqrt(count * volume / (2 * _STEP_MM) / np.pi))
    return np.array(keep), np.array(centres).reshape(-1, 3), np.array(radii)


def smooth_line(points: Floats) -> Floats:
    """Points of a walk ``(n, 3)``, filtered along it; a straight line stays what it is, also at its
    ends.

    Whittaker's smoother: least squares with a penalty on second differences."""
    bend = np.diff(np.eye(len(points)), 2, axis=0)
    return np.asarray(
        np.linalg.solve(np.eye(len(points)) + (_SMOOTH_MM / _STEP_MM) ** 4 * bend.T @ bend, points)
    )


def _unit(v: Floats) -> Floats:
    return v / np.linalg.norm(v)
