"""Per-view geometry: every view has its own source and its own flat detector, wherever they stand.

One concept for detectors that tilt, roll and jitter, sources that wobble, axes counted the other
way, helices, tilted parallel rays (laminography), and what ASTRA's ``parallel_vec``,
``fanflat_vec``, ``parallel3d_vec`` and ``cone_vec`` or RTK's XML say. A view is four vectors in mm:
the source (of parallel rays: their direction), the detector's centre, ``u``, the step to the next
column, and ``v``, the step to the next row. Cell ``(i, j)`` of ``rows × columns`` stands at
``centre + (j − (columns − 1) / 2) u + (i − (rows − 1) / 2) v``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from torchpcct.geometry import ConeBeam, FanBeam, Geometry, ParallelBeam, beam, cells
from torchpcct.validate import checked, number, reals

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from torchpcct.typing import Views


__all__ = ["VectorGeometry", "helical_motion"]

Floats = NDArray[np.float64]

_FARTHEST_MM = 1e12
"""Places at most: the moon is nearer."""
_NARROWEST_MM = 1e-9
"""Steps to the next cell at least: the wavelength of X-rays is longer, in metres, too."""


@dataclass(frozen=True, eq=False, repr=False)
class VectorGeometry(Geometry):
    """A scan that is given view by view.

    Args:
        vectors: ``(views, 6)`` without rows: source x, y, centre x, y, u x, y; ``(views, 12)`` with
            rows: source x, y, z, centre, u, v; mm. ASTRA's, whose order and directions these are.
        columns: detector columns.
        rows: detector rows, None without.
        parallel: parallel rays; then the first entries are the rays' direction, of any length.

    Raises:
        ValueError: a wrong shape, values that are not finite or beyond 1e12 mm, rays of no
            direction, a detector without area, with cells narrower than 1e-9 mm, or that its rays
            meet edge on.
        TypeError: a value of the wrong kind.
    """

    vectors: Floats
    columns: int
    rows: int | None = None
    parallel: bool = False

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        v = np.array(reals("vectors", self.vectors))
        width = 6 if self.rows is None else 12
        if v.ndim != 2 or v.shape[1] not in (6, 12) or not len(v):
            raise ValueError(f"vectors must have shape (views, 6) or (views, 12), got {v.shape}")
        if v.shape[1] != width:
            raise ValueError(
                f"{v.shape[1]} numbers per view need rows "
                f"{'= None' if v.shape[1] == 6 else '≥ 1'}, got {self.rows!r}"
            )
        if not np.isfinite(v).all():
            view = int(np.argmin(np.isfinite(v).all(1)))
            raise ValueError(f"vectors must be finite, but those of view {view} are not")
        far = np.abs(v) > _FARTHEST_MM
        if far.any():
            view = int(np.argmax(far.any(1)))
            raise ValueError(
                f"vectors must be places in mm, within ±{_FARTHEST_MM:g}, got "
                f"{v[view][far[view]][0]:g} in view {view}"
            )
        if not isinstance(self.parallel, bool):
            raise TypeError(f"parallel must be True or False, got {self.parallel!r}")
        v.setflags(write=False)
        set_(self, "vectors", v)
        set_(self, "columns", cells("columns", self.columns))
        set_(self, "rows", None if self.rows is None else cells("rows", self.rows))
        ray, _, u, up = self.poses.transpose(1, 0, 2)
        if not self.parallel:
            ray = self.poses[:, 1] - ray
        sizes = [np.linalg.norm(x, axis=1) for x in (ray, u, up)]
        least = np.minimum(np.abs(u).max(1), np.abs(up).max(1))  # squares of 1e-300 would be 0
        narrow = (least > 0.0) & (least < _NARROWEST_MM)
        if narrow.any():
            view = int(narrow.argmax())
            raise ValueError(
                f"u and v must be the steps to the next column and row in mm, at least "
                f"{_NARROWEST_MM:g}, got {least[view]:g} in view {view}"
            )
        volume = np.abs((np.cross(u, up) * ray).sum(1))
        bad = volume <= 1e-9 * sizes[0] * sizes[1] * sizes[2]
        if bad.any():
            raise ValueError(
                f"the rays of view {int(bad.argmax())} do not meet their detector, or meet it edge "
                "on: are its vectors in the order source, centre, u, v?"
            )

    @property
    def poses(self) -> Floats:
        """``(views, 4, 3)`` source (or direction), centre, u, v; without rows in the plane z =
        0, v along z, 1 mm."""
        if self.rows is not None:
            return np.asarray(self.vectors).reshape(-1, 4, 3)
        out = np.zeros((len(self.vectors), 4, 3))
        out[:, :3, :2] = np.asarray(self.vectors).reshape(-1, 3, 2)
        out[:, 3, 2] = 1.0
        return out

    @property
    def angles(self) -> Floats:  # type: ignore[override]
        """Direction from the axis to the source, or against parallel rays, ``(views,)`` rad."""
        sign = -1.0 if self.parallel else 1.0
        return np.arctan2(sign * self.poses[:, 0, 1], sign * self.poses[:, 0, 0])

    @property
    def views(self) -> int:
        return len(self.vectors)

    @property
    def shape(self) -> tuple[int, ...]:
        return (
            (self.views, self.columns)
            if self.rows is None
            else (self.views, self.rows, self.columns)
        )

    @classmethod
    @checked
    def of(cls, geometry: Geometry, motion: object = None) -> VectorGeometry:
        """A circular scan with a flat detector, view by view; its ``vectors`` are what ASTRA takes.

        Args:
            geometry: parallel, fan or cone beam.
            motion: displacement of the grid in every view as for ``Projector``, or None: source and
                detector move the other way, so that the volume may stand still.

        Raises:
            ValueError: a curved detector, which flat ones cannot describe; a motion of the wrong
                shape.
            TypeError: another geometry.
        """
        geometry = beam(geometry)
        radial = np.stack([np.cos(geometry.angles), np.sin(geometry.angles)], axis=1)
        tangent = np.stack([-radial[:, 1], radial[:, 0]], axis=1)
        u = geometry.column_pitch * tangent
        if isinstance(geometry, ParallelBeam):
            first, centre = -radial, geometry.column_offset * tangent
        else:
            if geometry.detector == "curved":
                raise ValueError(
                    "vectors describe flat detectors only, this one is curved: use detector='flat'"
                )
            first = geometry.sod * radial
            centre = (geometry.sod - geometry.sdd) * radial + geometry.column_offset * tangent
        parts, rows = [first, centre, u], None
        if geometry.has_rows:
            zero, rows = np.zeros((geometry.views, 1)), geometry.shape[1]
            up = [zero, zero, zero + geometry.row_pitch]
            parts = [first, zero, centre, zero + geometry.row_offset, u, zero, *up]
        made = cls(np.concatenate(parts, axis=1), geometry.columns, rows, geometry.parallel)
        return made if motion is None else made.moved(motion)

    def border_rays(self) -> tuple[Floats, Floats, Floats]:
        """The rays through the outer edge of the detector, each ``(views, rays)``.

        Returns:
            Distance from the z axis at their closest approach in mm, their height z there in mm,
            and how much they climb per mm on the way across the axis. Of a detector without rows
            the heights and climbs are 0.

        Raises:
            ValueError: rays along z, which have no closest approach.
        """
        half_v = (self.rows or 0) / 2
        across = np.arange(self.columns + 1) - self.columns / 2
        up = np.arange((self.rows or 0) + 1) - half_v
        edge = [(c, r) for r in {-half_v, half_v} for c in across] + [
            (s * self.columns / 2, r) for r in up for s in (-1, 1)
        ]
        at, (first, centre, u, v) = np.array(edge), self.poses.transpose(1, 0, 2)
        point = centre[:, None] + at[:, :1] * u[:, None] + at[:, 1:] * v[:, None]
        ray = (
            np.broadcast_to(first[:, None], point.shape)
            if self.parallel
            else point - first[:, None]
        )
        flat = np.linalg.norm(ray[..., :2], axis=-1, keepdims=True)
        if (flat <= 1e-6 * np.linalg.norm(ray, axis=-1, keepdims=True)).any():
            raise ValueError(
                f"rays of view {int(flat.min(1).argmin())} run along z: turn the scan so that "
                "they do not"
            )
        ray = ray / flat
        to_axis = -(point[..., :2] * ray[..., :2]).sum(-1, keepdims=True)
        nearest = point + to_axis * ray
        return np.linalg.norm(nearest[..., :2], axis=-1), nearest[..., 2], ray[..., 2]

    @property
    def on_circle(self) -> bool:
        return False

    @property
    def column_pitch(self) -> float:
        """Length of u, mm: the median over the views."""
        return float(np.median(np.linalg.norm(self.poses[:, 2], axis=1)))

    @property
    def row_pitch(self) -> float:
        """Length of v, mm: the median over the views; inf without rows."""
        if self.rows is None:
            return math.inf
        return float(np.median(np.linalg.norm(self.poses[:, 3], axis=1)))

    @property
    def column_offset(self) -> float:
        """Along u from where the ray through the axis (at the source's height) meets the detector
        to its centre, mm: the median over the views."""
        return float(np.median(self._offsets(2)))

    @property
    def row_offset(self) -> float:
        """The same along v."""
        return 0.0 if self.rows is None else float(np.median(self._offsets(3)))

    def _offsets(self, axis: int) -> Floats:
        first, centre, u, v = self.poses.transpose(1, 0, 2)
        source = np.zeros_like(first) if self.parallel else first
        ray = first if self.parallel else first * [-1.0, -1.0, 0.0]
        normal = np.cross(u, v)
        way = ((centre - source) * normal).sum(1) / (ray * normal).sum(1)
        along = self.poses[:, axis]
        offset = centre - source - way[:, None] * ray
        return np.asarray((offset * along).sum(1) / np.linalg.norm(along, axis=1))

    @property
    def magnification(self) -> float:
        """Of the detector over the axis: the median over the views."""
        return self.column_pitch / self.cell

    @property
    def cell(self) -> float:
        """Width of a column where the rays cross the axis, mm: the median over the views."""
        return float(np.median(self._cells))

    @property
    def cell_height(self) -> float:
        """Height of a row where the rays cross the axis, mm, in the ratio of v to u."""
        if self.rows is None:
            return math.inf
        columns, rows = (np.linalg.norm(self.poses[:, k], axis=1) for k in (2, 3))
        return self.cell * float(np.median(rows / columns))

    @property
    def _cells(self) -> Floats:
        source, centre, u, _ = self.poses.transpose(1, 0, 2)
        width = np.linalg.norm(u, axis=1)
        if not self.parallel:
            orbit = np.linalg.norm(source[:, :2], axis=1)
            least = 1e-9 * float(np.abs(self.vectors).max())
            depth = ((source - centre)[:, :2] * source[:, :2]).sum(1) / np.maximum(orbit, least)
            width = width * orbit / np.maximum(np.abs(depth), least)
        return np.asarray(width)

    def widened(self, before: int, behind: int) -> VectorGeometry:
        """The same detectors with so many more columns before the first and behind the last one
        (fewer: negative), the others at their places."""
        poses = self.poses
        wide = self._with(1, poses[:, 1] + 0.5 * (behind - before) * poses[:, 2])
        return replace(wide, columns=self.columns + before + behind)

    def interleaved(self) -> VectorGeometry:
        poses = self.poses
        finer = self._with(1, poses[:, 1] + poses[:, 2] / 4.0, 2, poses[:, 2] / 2.0)
        return replace(finer, columns=2 * self.columns)

    def scaled(self, factor: float) -> VectorGeometry:
        poses, more = self.poses, (factor - 1.0) * self.column_offset
        along = poses[:, 2] / np.linalg.norm(poses[:, 2], axis=1, keepdims=True)
        return self._with(1, poses[:, 1] + more * along, 2, factor * poses[:, 2])

    def with_column_offset(self, offset: float) -> VectorGeometry:
        """The detectors displaced along u, so that their offset is this one."""
        poses = self.poses
        along = poses[:, 2] / np.linalg.norm(poses[:, 2], axis=1, keepdims=True)
        return self._with(1, poses[:, 1] + (offset - self.column_offset) * along)

    def with_rows(self, first: int, rows: int) -> VectorGeometry:
        """The same detectors on ``rows`` rows, the first of which is row ``first``, at their
        places."""
        if self.rows is None:
            return self
        poses = self.poses
        up = (first + 0.5 * (rows - self.rows)) * poses[:, 3]
        return replace(self._with(1, poses[:, 1] + up), rows=rows)

    def select(self, views: Views) -> VectorGeometry:
        """The same scan with a subset (or reordering) of the views: an index array, mask or
        slice."""
        return replace(self, vectors=self.vectors[views])

    def flipped(self, *, columns: bool = False, rows: bool = False) -> VectorGeometry:
        """The same detector with columns or rows counted the other way."""
        return self._with(
            2, -self.poses[:, 2] if columns else None, 3, -self.poses[:, 3] if rows else None
        )

    def shifted(self, columns: ArrayLike = 0.0, rows: ArrayLike = 0.0) -> VectorGeometry:
        """The detector displaced in its own plane, by parts of a cell: ``centre + columns · u +
        rows · v``.

        Args:
            columns, rows: numbers, or ``(views,)``: jitter.
        """
        c, r = (_per_view(n, x, self.views) for n, x in (("columns", columns), ("rows", rows)))
        poses = self.poses
        return self._with(1, poses[:, 1] + c * poses[:, 2] + r * poses[:, 3])

    def turned(
        self, roll: ArrayLike = 0.0, tilt: ArrayLike = 0.0, slant: ArrayLike = 0.0
    ) -> VectorGeometry:
        """The detector turned about its own centre: first slant, then tilt, then roll.

        Args:
            roll: about its normal u × v, rad, one number or ``(views,)``.
            tilt: about u.
            slant: about v.

        Raises:
            ValueError: roll or tilt of a detector without rows.
        """
        if self.rows is None and (np.any(roll) or np.any(tilt)):
            raise ValueError(
                "a detector without rows can only be slanted: roll and tilt would leave the plane"
            )
        roll, tilt, slant = (
            _per_view(n, x, self.views)
            for n, x in (("roll", roll), ("tilt", tilt), ("slant", slant))
        )
        u, v = self.poses[:, 2], self.poses[:, 3]
        u = _rotated(u, v, slant)
        v = _rotated(v, u, tilt)
        normal = np.cross(u, v)
        return self._with(2, _rotated(u, normal, roll), 3, _rotated(v, normal, roll))

    def moved(self, motion: object) -> VectorGeometry:
        """The scan as seen from a grid that is displaced by ``motion``, as for ``Projector``.

        Raises:
            ValueError: a motion of the wrong shape.
        """
        axes = 2 if self.rows is None else 3
        shift, turn = split_motion(motion, self.views, axes)
        back = np.zeros((self.views, 3))
        back[:, :axes] = shift[:, ::-1]
        poses = self.poses.copy()
        poses[:, 1] -= back
        if not self.parallel:
            poses[:, 0] -= back
        if turn is not None:
            c, s = np.cos(turn)[:, None], np.sin(turn)[:, None]
            x, y = poses[..., 0].copy(), poses[..., 1].copy()
            poses[..., 0], poses[..., 1] = c * x + s * y, c * y - s * x
        return self._with(0, poses[:, 0], 1, poses[:, 1], 2, poses[:, 2], 3, poses[:, 3])

    def as_circular(self) -> tuple[Geometry, Floats | None] | None:
        """The circular scan, and the motion of the grid or None, that this scan is, to 1e-9; else
        None.

        A radial displacement and a larger orbit look the same: the orbit is the one with the
        smallest motion.
        """
        if self.parallel and self.rows is not None:
            return None  # no parallel beam with rows is one of ours
        v, (source, centre, u, up) = np.array(self.vectors), self.poses.transpose(1, 0, 2)
        angles = np.arctan2(-u[:, 0], u[:, 1])  # columns grow along (-sin, cos)
        radial, tangent = (np.stack(x, axis=1) for x in ((u[:, 1], -u[:, 0]), (u[:, 0], u[:, 1])))
        pitch = np.linalg.norm(tangent, axis=1)
        radial, tangent, pitch = (
            radial / pitch[:, None],
            tangent / pitch[:, None],
            float(pitch.mean()),
        )
        found: Geometry
        if self.parallel:
            offset = float((centre[:, :2] * tangent).sum(1).mean())
            found, motion = (
                ParallelBeam(angles, self.columns, pitch, offset),
                offset * tangent - centre[:, :2],
            )
        else:
            way = source - centre
            sdd, offset = (
                float((way[:, :2] * radial).sum(1).mean()),
                -float((way[:, :2] * tangent).sum(1).mean()),
            )
            sod, row_pitch = float((source[:, :2] * radial).sum(1).mean()), float(up[:, 2].mean())
            if not (0 < sod < sdd and row_pitch > 0):
                return None
            orbit, pitches = (angles, sod, sdd, self.columns), (row_pitch, pitch)
            if self.rows is None:
                found = FanBeam(*orbit, pitch, offset)
            else:
                found = ConeBeam(*orbit, self.rows, pitches, (-float(way[:, 2].mean()), offset))
            axes = 2 if self.rows is None else 3
            motion = self.of(found).vectors[:, :axes] - v[:, :axes]
        motion = np.ascontiguousarray(motion[:, ::-1])
        again, far = self.of(found, motion).vectors, float(np.abs(v).max())
        scale = np.full(v.shape[1], far)
        if self.parallel:  # a ray's direction has no length, and its line no sense
            v[:, :2] *= (
                np.sign((v[:, :2] * again[:, :2]).sum(1)) / np.linalg.norm(v[:, :2], axis=1)
            )[:, None]
            axes = 2 if self.rows is None else 3
            far = float(np.abs(v[:, axes:]).max())
            scale[:axes], scale[axes:] = 1.0, far
        if (np.abs(again - v) > 1e-9 * scale).any():
            return None
        return found, None if np.abs(motion).max() <= 1e-9 * far else motion

    def _with(self, *parts: int | Floats | None) -> VectorGeometry:
        """Other vectors: place, ``(views, 3)`` or None (unchanged), in turn."""
        poses = self.poses.copy()
        for place, value in zip(parts[::2], parts[1::2], strict=True):
            if value is not None:
                poses[:, place] = value
        flat = poses.reshape(-1, 12) if self.rows is not None else poses[:, :3, :2].reshape(-1, 6)
        return replace(self, vectors=flat)


@checked
def check_motion(motion: object, views: int, axes: int) -> Floats:
    """Displacements of the grid per view as ``(views, axes)`` float64.

    Raises:
        ValueError: a wrong shape, values that are not finite.
    """
    shift = _numbers(motion)
    if shift.shape != (views, axes):
        raise ValueError(
            f"motion needs the shape ({views}, {axes}): views and the grid's axes, got "
            f"{shift.shape}"
        )
    if not np.isfinite(shift).all():
        raise ValueError("motion has values that are not finite")
    return shift


def _numbers(motion: object) -> Floats:
    """A copy in float64, of a tensor, too."""
    plain = motion.detach().cpu().numpy() if hasattr(motion, "detach") else motion
    return np.array(plain, dtype=np.float64)


@checked
def split_motion(motion: object, views: int, axes: int) -> tuple[Floats, Floats | None]:
    """Displacements of the grid per view ``(views, axes)``, and rotations about z ``(views,)`` rad
    where a last column more has them.

    Raises:
        ValueError: a wrong shape, values that are not finite.
    """
    given = _numbers(motion)
    if given.shape != (views, axes + 1):
        return check_motion(given, views, axes), None
    if not np.isfinite(given).all():
        raise ValueError("motion has values that are not finite")
    return given[:, :axes], given[:, axes]


@checked
def helical_motion(geometry: ConeBeam, feed: float, start: float = 0.0) -> Floats:
    """The table's travel as a displacement of the grid, ``(views, 3)`` z, y, x mm, for
    ``Projector(…, motion=…)``.

    The source stands ``feed · (β − β₀) / 2π`` above ``start`` in the view of the angle β; angles go
    on beyond 2π.

    Args:
        geometry: cone beam, flat or curved.
        feed: travel of the source along +z in a turn, mm.
        start: height of the source in the first view, mm.

    Raises:
        TypeError: not a cone beam. ValueError: numbers that are not finite.
    """
    if not isinstance(geometry, ConeBeam):
        raise TypeError(f"a helix needs a ConeBeam, got {type(geometry).__name__}")
    height = number("start", start) + number("feed", feed) * (
        geometry.angles - geometry.angles[0]
    ) / (2 * math.pi)
    out = np.zeros((geometry.views, 3))
    out[:, 0] = -height
    return out


def _per_view(name: str, value: ArrayLike, views: int) -> Floats:
    """``(views, 1)`` of one number or one per view."""
    given = np.asarray(value, dtype=np.float64)
    if given.shape not in ((), (views,)) or not np.isfinite(given).all():
        raise ValueError(
            f"{name} must be one finite number or one per view, ({views},), got shape {given.shape}"
        )
    return np.broadcast_to(given, (views,))[:, None]


def _rotated(x: Floats, axis: Floats, angle: Floats) -> Floats:
    """Rodrigues' rotation of ``(views, 3)`` about axes of any length by ``(views, 1)`` rad."""
    axis = axis / np.linalg.norm(axis, axis=1, keepdims=True)
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(
        x * c + np.cross(axis, x) * s + axis * (axis * x).sum(1, keepdims=True) * (1 - c)
    )
