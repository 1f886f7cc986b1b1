"""Scan geometries and voxel grids: frozen, validated, in mm and rad.

Conventions (one page, used everywhere in the package)
-------------------------------------------------------
* Index ``k`` of ``n`` sits at ``(k - (n - 1) / 2) * pitch + offset``.
* ``e_r(β) = (cos β, sin β)``, ``e_t(β) = (-sin β, cos β)``; β grows counter-clockwise.
* The source of view β is at ``sod * e_r(β)``; columns grow along ``+e_t``, rows along ``+z``.
* A flat detector has its centre at ``-(sdd - sod) * e_r``. A curved detector lies on an arc of
  radius ``sdd`` about the source: column ``u`` (mm along the arc) is seen at the fan angle ``γ = u
  / sdd``. Its rows stand parallel to z (a cylinder segment).
* A parallel ray of column ``u`` runs along ``-e_r`` through ``u * e_t``.
* Volumes are ``(..., z, y, x)`` (2-D ``(..., y, x)``), line integrals ``(..., view, row, column)``
  (2-D ``(..., view, column)``).
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from torchpcct.validate import checked, choice, number, per_axis, whole

if TYPE_CHECKING:
    from torchpcct.typing import Views
    from torchpcct.validate import Limits

    class _HasGrid(Protocol):
        """A scan that knows the grid of what it sees."""

        def seen_grid(self, voxel: float | None, extent: object, center: object) -> VolumeGrid:
            """See :meth:`VolumeGrid.of`."""
            ...


__all__ = ["Beam", "ConeBeam", "FanBeam", "Geometry", "ParallelBeam", "VolumeGrid", "full_turn"]

Floats = NDArray[np.float64]

_DEGREES_SPAN_RAD = 20.0
"""Range of angles from which on they may be degrees taken as rad: more than three turns."""
_DEGREES_STEP_RAD = 0.04
"""Together with steps of so many rad and more (2.3°): 20 and more degrees, up to 9000 views a turn,
taken as rad. Helical scans of as many turns have far smaller steps."""


_LENGTHS: Limits = {"positive": True, "low": 1e-9, "high": 1e12, "unit": "mm"}
"""Limits of lengths: a cell narrower than 1e-9 mm is below the wavelength of X-rays, also where
somebody counts in metres, and a source 1e12 mm away is farther than the moon is."""
_MOST_CELLS = 10**7
"""Columns and rows at most: as many cells of a µm make a detector of 10 m."""
_MOST_OFFSET = 1e9
"""Cells between the detector's middle and the beam's axis at most: single ones of a nm, a metre
aside. Detectors of many cells are seen at an angle long before."""
_STEEPEST_RAD = math.radians(85.0)
"""Largest angle between a ray and the line from the source through the axis, on a flat detector:
beyond, less than a thousandth of the light is left and a ray crosses eleven cells in a depth of
one. Pitches in µm and distances in cm are found by it."""
_FARTHEST_RAD = 1e9
"""Angles at most: of larger ones double precision loses a thousandth of the step between views."""


@checked
def full_turn(views: int, start: float = 0.0) -> Floats:
    """Equally spaced source angles over a full turn.

    Args:
        views: number of angles, at least 1.
        start: the first angle, rad.

    Returns:
        ``(views,)`` rad float64.

    Raises:
        ValueError, TypeError: a number of views below 1 or not whole.
    """
    return np.arange(whole("views", views), dtype=np.float64) * (2.0 * math.pi / views) + start


def _angles(value: object) -> Floats:
    try:
        given = np.asarray(value)
        # numpy would drop an imaginary part, and take None for NaN
        if given.dtype.kind not in "fiu":
            raise TypeError
        angles = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        raise TypeError(
            f"angles must be real numbers in rad, got {type(value).__name__}: {value!r:.60}"
        ) from None
    if angles.ndim != 1 or angles.size == 0:
        raise ValueError(
            f"angles must be a non-empty 1-D sequence in rad, got shape {angles.shape}"
        )
    if not np.isfinite(angles).all():
        raise ValueError(
            f"angles must be finite, but view {int(np.argmin(np.isfinite(angles)))} is not"
        )
    far = np.abs(angles) > _FARTHEST_RAD
    if far.any():
        view = int(np.argmax(far))
        raise ValueError(
            f"angles must lie within ±{_FARTHEST_RAD:g} rad, got {angles[view]:g} at view {view}: "
            "round-off would turn such views at random; give them modulo 2π"
        )
    if np.ptp(angles) > _DEGREES_SPAN_RAD and view_step(angles) > _DEGREES_STEP_RAD:
        warnings.warn(
            f"the angles cover {np.ptp(angles) / (2 * math.pi):.0f} turns in steps of "
            f"{view_step(angles):.3g} rad: they look like degrees; give rad (numpy.deg2rad), or "
            "angles modulo 2π if they are rad",
            UserWarning,
            stacklevel=4,
        )
    angles.setflags(write=False)
    return angles


def cells(name: str, value: object) -> int:
    """Number of a detector's columns or rows, as :func:`torchpcct.validate.whole` checks it."""
    return whole(name, value, high=_MOST_CELLS)


def _require_near(name: str, offset: float, pitch: float) -> None:
    """Refuse (ValueError) a detector that is farther from the beam's axis than any is."""
    if abs(offset) > _MOST_OFFSET * pitch:
        raise ValueError(
            f"{name} must be the position of the detector's middle in mm, at most "
            f"{_MOST_OFFSET:g} cells from the beam's axis, got {offset:g} mm with cells of "
            f"{pitch:g} mm"
        )


def view_step(angles: Floats) -> float:
    """The usual angle between neighbouring views in rad, whatever their order; 0 for fewer than two
    distinct views.

    Args:
        angles: ``(views,)`` rad. Views closer than 1e-9 rad are repetitions of one view.
    """
    steps = np.diff(np.sort(angles))
    steps = steps[steps > 1e-9]
    return float(np.median(steps)) if steps.size else 0.0


def _axis(count: int, pitch: float, offset: float) -> Floats:
    return (np.arange(count, dtype=np.float64) - (count - 1) / 2.0) * pitch + offset


def _short(name: str, value: object) -> str:
    """A value in one line: of many angles the first and the last in degrees, of other arrays the
    shape."""
    if name == "angles" and isinstance(value, np.ndarray):
        ends = f"{math.degrees(value[0]):.5g}°" + (
            f" … {math.degrees(value[-1]):.5g}°" if value.size > 1 else ""
        )
        return f"{value.size} views, {ends}" if value.size > 1 else ends
    return (
        f"array{value.shape}" if isinstance(value, np.ndarray) and value.size > 4 else repr(value)
    )


G = TypeVar("G", bound="Geometry")


class Geometry:
    """What all scan geometries share: ``angles`` (rad), equality by value, view subsets and
    scaling."""

    angles: Floats
    columns: int

    @property
    def views(self) -> int:
        """Number of views."""
        return int(self.angles.size)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of one sinogram: ``(views, columns)`` or ``(views, rows, columns)``."""
        return (self.views, self.columns)

    @property
    def has_rows(self) -> bool:
        """Whether the detector has rows, so that one sinogram makes a volume and not a plane."""
        return len(self.shape) == 3

    @property
    def on_circle(self) -> bool:
        """Whether one detector turns about the axis: parallel, fan and cone beams; not what is
        given view by view."""
        return True

    @property
    def parallel(self) -> bool:
        """Whether the rays of a view are parallel."""
        return False

    @property
    def column_pitch(self) -> float:
        """Width of a cell, mm on the detector."""
        raise NotImplementedError

    @property
    def row_pitch(self) -> float:
        """Height of a cell, mm on the detector; inf without rows, whose slices have any height."""
        return math.inf

    @property
    def column_offset(self) -> float:
        """Position of the detector's centre along the columns, mm."""
        raise NotImplementedError

    @property
    def row_offset(self) -> float:
        """Position of the detector's centre along the rows, mm; 0 without rows."""
        return 0.0

    @property
    def column_positions(self) -> Floats:
        """Column centres along the detector, ``(columns,)`` mm; of a curved one along the arc."""
        return _axis(self.columns, self.column_pitch, self.column_offset)

    @property
    def ray_distances(self) -> Floats:
        """Distance from the axis of the ray to every column centre, signed, ``(columns,)`` mm."""
        raise NotImplementedError

    @property
    def row_positions(self) -> Floats:
        """Row centres along z on the detector, ``(rows,)`` mm; 0 without rows."""
        return np.zeros(1)

    @property
    def magnification(self) -> float:
        """Of the detector over the axis: ``sdd / sod``, 1 for parallel rays."""
        return 1.0

    @property
    def cell(self) -> float:
        """Width of a column as it is seen at the axis, mm."""
        return self.column_pitch / self.magnification

    @property
    def cell_height(self) -> float:
        """Height of a row as it is seen at the axis, mm; inf without rows."""
        return self.row_pitch / self.magnification

    def widened(self: G, before: int, behind: int) -> G:
        """The same beam with so many more columns before the first and behind the last one
        (fewer: negative), the others at their places."""
        changed = self.with_column_offset(
            self.column_offset + 0.5 * (behind - before) * self.column_pitch
        )
        return replace(changed, columns=self.columns + before + behind)  # type: ignore[type-var]

    def interleaved(self: G) -> G:
        """The same beam on twice as many columns of half the pitch, every second one at the place
        of one of this beam."""
        pitch, offset = self.column_pitch / 2.0, self.column_offset + self.column_pitch / 4.0
        return replace(self, columns=2 * self.columns, pitch=pitch, offset=offset)  # type: ignore[type-var]

    def scaled(self: G, factor: float) -> G:
        """The same beam with columns so much wider, and their offset so much larger."""
        pitch, offset = factor * self.column_pitch, factor * self.column_offset
        return replace(self, pitch=pitch, offset=offset)  # type: ignore[type-var]

    def with_column_offset(self: G, offset: float) -> G:
        """The same beam with the detector's centre elsewhere along the columns, mm."""
        return replace(self, offset=offset)  # type: ignore[type-var]

    def with_rows(self: G, first: int, rows: int) -> G:
        """The same beam on ``rows`` rows, the first of which is row ``first`` of this detector, at
        their places; without rows a beam is that of every slice, and stays."""
        return self

    def select(self: G, views: Views) -> G:
        """The same scanner with a subset (or reordering) of the views: an index array, mask or
        slice."""
        return replace(self, angles=self.angles[views])  # type: ignore[type-var]

    def _key(self) -> tuple[object, ...]:
        values = (getattr(self, f.name) for f in fields(self))  # type: ignore[arg-type]
        return (type(self), *(v.tobytes() if isinstance(v, np.ndarray) else v for v in values))

    def __repr__(self) -> str:
        values = {f.name: getattr(self, f.name) for f in fields(self)}  # type: ignore[arg-type]
        return (
            f"{type(self).__name__}({', '.join(f'{n}={_short(n, v)}' for n, v in values.items())})"
        )

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Geometry) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())


@dataclass(frozen=True, eq=False, repr=False)
class ParallelBeam(Geometry):
    """Parallel rays in a plane.

    Args:
        angles: view angles β, ``(views,)`` rad. Rays of a view run along ``-e_r(β)``.
        columns: detector cells per view.
        pitch: cell width in mm.
        offset: position of the detector's centre along ``e_t``, in mm (a quarter column: ``pitch /
            4``).

    Raises:
        ValueError: a count < 1, a length ≤ 0, a non-finite or empty value, what no scan can have (a
            pitch beyond 1e-9 … 1e12 mm, 1e7 cells, angles beyond 1e9 rad).
        TypeError: a value of the wrong kind.
    """

    angles: Floats
    columns: int
    pitch: float
    offset: float = 0.0

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        set_(self, "angles", _angles(self.angles))
        set_(self, "columns", cells("columns", self.columns))
        set_(self, "pitch", number("pitch", self.pitch, **_LENGTHS))
        set_(self, "offset", number("offset", self.offset, unit="mm"))
        _require_near("offset", self.offset, self.pitch)

    @property
    def parallel(self) -> bool:
        return True

    @property
    def column_pitch(self) -> float:
        return self.pitch

    @property
    def column_offset(self) -> float:
        return self.offset

    @property
    def ray_distances(self) -> Floats:
        return self.column_positions

    @property
    def fov_radius(self) -> float:
        """Radius in mm of the disc about the axis that every view sees whole (outer cell edges)."""
        u = self.column_positions
        return max(float(min(-u[0], u[-1])) + self.pitch / 2.0, 0.0)


class _Divergent(Geometry):
    """What fan and cone beams share: a point source at ``sod`` and a detector at ``sdd``."""

    sod: float
    sdd: float
    pitch: Any
    detector: str

    def _validate_divergent(self) -> None:
        set_ = object.__setattr__
        set_(self, "angles", _angles(self.angles))
        set_(self, "sod", number("sod", self.sod, **_LENGTHS))
        set_(self, "sdd", number("sdd", self.sdd, **_LENGTHS))
        set_(self, "columns", cells("columns", self.columns))
        if self.sdd <= self.sod:
            raise ValueError(
                f"sdd ({self.sdd} mm) must be greater than sod ({self.sod} mm): sdd is the "
                "distance from the source to the detector, not from the isocentre"
            )
        choice("detector", self.detector, ("flat", "curved"))

    def _validate_arc(self) -> None:
        if self.detector == "curved":
            pitch, offset = self.column_pitch, self.column_offset
            half = (self.columns * pitch / 2 + abs(offset)) / self.sdd
            if half >= math.pi / 2:
                raise ValueError(
                    f"a curved detector of {self.columns} columns × {pitch} mm at sdd {self.sdd} "
                    f"mm spans a half-fan of {math.degrees(half):.1f}°, 90° or more: reduce "
                    "columns or pitch"
                )

    def _validate_place(self) -> None:
        """Of a detector whose size is known: that its rays can meet it."""
        _require_near("offset", self.column_offset, self.column_pitch)
        sides = [(self.columns, self.column_pitch, self.column_offset, "columns")]
        if self.has_rows:
            _require_near("offset", self.row_offset, self.row_pitch)
            sides.append((self.shape[1], self.row_pitch, self.row_offset, "rows"))
        self._validate_arc()
        for count, pitch, offset, name in sides:
            if name == "columns" and self.detector == "curved":
                continue
            steepest = math.atan((count * pitch / 2 + abs(offset)) / self.sdd)
            if steepest > _STEEPEST_RAD:
                raise ValueError(
                    f"a detector of {count} {name} × {pitch:g} mm, {offset:g} mm off the beam's "
                    f"axis, at sdd {self.sdd:g} mm is met by rays at "
                    f"{math.degrees(steepest):.2f}°, more than "
                    f"{math.degrees(_STEEPEST_RAD):g}°: are {name}, pitch, offset and sdd in "
                    "one unit, mm?"
                )

    @property
    def magnification(self) -> float:
        return self.sdd / self.sod

    @property
    def ray_distances(self) -> Floats:
        return self.sod * np.sin(self.fan_angles)

    @property
    def fan_angles(self) -> Floats:
        """Fan angle γ of each column centre, ``(columns,)`` rad."""
        u = self.column_positions
        return u / self.sdd if self.detector == "curved" else np.arctan(u / self.sdd)

    @property
    def fov_radius(self) -> float:
        """Radius in mm of the disc about the isocentre that every view sees whole (outer cell
        edges)."""
        u = self.column_positions
        half_pitch = (
            0.5 * (u[-1] - u[0]) / (self.columns - 1)
            if self.columns > 1
            else 0.5 * self.column_pitch
        )
        edge = min(-(u[0] - half_pitch), u[-1] + half_pitch)
        gamma = edge / self.sdd if self.detector == "curved" else math.atan(edge / self.sdd)
        return self.sod * math.sin(max(gamma, 0.0))


@dataclass(frozen=True, eq=False, repr=False)
class FanBeam(_Divergent):
    """A fan of rays in the plane z = 0.

    Args:
        angles: source angles β, ``(views,)`` rad.
        sod: distance source–isocentre in mm.
        sdd: distance source–detector in mm (greater than ``sod``).
        columns: detector cells per view.
        pitch: cell width in mm, measured on the detector.
        offset: position of the detector's centre along the columns, in mm.
        detector: ``"flat"`` or ``"curved"`` (arc about the source).

    Raises:
        ValueError: a count < 1, a length ≤ 0, ``sdd <= sod``, an unknown detector, a half-fan of
            90° or more (flat: 85°), what no scan can have (lengths beyond 1e-9 … 1e12 mm, 1e7
            cells, 1e9 off the axis, angles beyond 1e9 rad).
        TypeError: a value of the wrong kind.
    """

    angles: Floats
    sod: float
    sdd: float
    columns: int
    pitch: float
    offset: float = 0.0
    detector: str = "flat"

    def __post_init__(self) -> None:
        self._validate_divergent()
        object.__setattr__(self, "pitch", number("pitch", self.pitch, **_LENGTHS))
        object.__setattr__(self, "offset", number("offset", self.offset, unit="mm"))
        self._validate_place()

    @property
    def column_pitch(self) -> float:
        return self.pitch

    @property
    def column_offset(self) -> float:
        return self.offset


@dataclass(frozen=True, eq=False, repr=False)
class ConeBeam(_Divergent):
    """A cone of rays on a circular orbit.

    Args:
        angles: source angles β, ``(views,)`` rad.
        sod: distance source–isocentre in mm.
        sdd: distance source–detector in mm (greater than ``sod``).
        columns: detector columns.
        rows: detector rows.
        pitch: ``(row, column)`` pitch in mm on the detector, or one number for both.
        offset: ``(row, column)`` position of the detector's centre in mm, or one number for both.
        detector: ``"flat"`` or ``"curved"`` (arc about the source, rows parallel to z).

    Raises:
        ValueError: a count < 1, a length ≤ 0, ``sdd <= sod``, an unknown detector, a half-fan of
            90° or more (flat: 85°), what no scan can have (lengths beyond 1e-9 … 1e12 mm, 1e7
            cells, 1e9 off the axis, angles beyond 1e9 rad).
        TypeError: a value of the wrong kind.
    """

    angles: Floats
    sod: float
    sdd: float
    columns: int
    rows: int
    pitch: Any
    offset: Any = (0.0, 0.0)
    detector: str = "flat"

    def __post_init__(self) -> None:
        self._validate_divergent()
        object.__setattr__(self, "rows", cells("rows", self.rows))
        object.__setattr__(self, "pitch", per_axis("pitch", self.pitch, 2, **_LENGTHS))
        object.__setattr__(self, "offset", per_axis("offset", self.offset, 2, unit="mm"))
        self._validate_place()

    @property
    def shape(self) -> tuple[int, ...]:
        return (self.views, self.rows, self.columns)

    @property
    def column_pitch(self) -> float:
        return float(self.pitch[1])

    @property
    def row_pitch(self) -> float:
        return float(self.pitch[0])

    @property
    def column_offset(self) -> float:
        return float(self.offset[1])

    @property
    def row_offset(self) -> float:
        return float(self.offset[0])

    @property
    def row_positions(self) -> Floats:
        return _axis(self.rows, self.row_pitch, self.row_offset)

    def interleaved(self) -> ConeBeam:
        return replace(
            self,
            columns=2 * self.columns,
            pitch=(self.row_pitch, self.column_pitch / 2.0),
            offset=(self.row_offset, self.column_offset + self.column_pitch / 4.0),
        )

    def scaled(self, factor: float) -> ConeBeam:
        return replace(
            self,
            pitch=(self.row_pitch, factor * self.column_pitch),
            offset=(self.row_offset, factor * self.column_offset),
        )

    def with_column_offset(self, offset: float) -> ConeBeam:
        return replace(self, offset=(self.row_offset, offset))

    def with_rows(self, first: int, rows: int) -> ConeBeam:
        shift = (first + 0.5 * (rows - self.rows)) * self.row_pitch
        return replace(self, rows=rows, offset=(self.row_offset + shift, self.column_offset))

    @property
    def central_fan(self) -> FanBeam:
        """The fan beam of the plane z = 0."""
        return FanBeam(
            self.angles,
            self.sod,
            self.sdd,
            self.columns,
            self.column_pitch,
            self.column_offset,
            self.detector,
        )


Beam: TypeAlias = ParallelBeam | FanBeam | ConeBeam
"""A scan on a circle."""


def project_points(
    geometry: Beam, x: Floats | float, y: Floats | float, z: Floats | float = 0.0
) -> tuple[Floats, Floats]:
    """Where points fall on the detector in every view, in mm: position along the columns, height.

    Args:
        geometry: parallel, fan or cone beam.
        x, y: mm, ``(views, …)``, or one number for all views; they lie before the source.
        z: mm, of a shape that broadcasts with theirs.
    """
    x, y, z = (np.asarray(v, dtype=np.float64) for v in (x, y, z))
    trailing = (1,) * (max(x.ndim, y.ndim, 1) - 1)
    c, s = (f(geometry.angles).reshape(-1, *trailing) for f in (np.cos, np.sin))
    across = y * c - x * s
    if isinstance(geometry, ParallelBeam):
        return across, z
    depth = geometry.sod - (x * c + y * s)
    # On a curved detector the height follows the slant in-plane distance, on a flat one the depth.
    if geometry.detector == "curved":
        return geometry.sdd * np.arctan2(across, depth), geometry.sdd * z / np.hypot(across, depth)
    return geometry.sdd * across / depth, geometry.sdd * z / depth


def beam(geometry: Geometry) -> Beam:
    """The geometry, where it must be one on a circle.

    Raises:
        TypeError: another one.
    """
    if not isinstance(geometry, ParallelBeam | FanBeam | ConeBeam):
        raise TypeError(
            f"geometry must be ParallelBeam, FanBeam or ConeBeam, got {type(geometry).__name__}"
        )
    return geometry


@dataclass(frozen=True)
class VolumeGrid:
    """A regular voxel grid.

    Args:
        shape: ``(y, x)`` or ``(z, y, x)`` voxel counts.
        spacing: voxel size in mm, one number or one per axis in the order of ``shape``.
        center: position of the grid's centre in mm, one number or one per axis in the order of
            ``shape``.

    Raises:
        ValueError: a count < 1, a spacing ≤ 0, a wrong number of axes.
        TypeError: a value of the wrong kind.
    """

    shape: Any
    spacing: Any
    center: Any = 0.0
    ndim: int = field(init=False, repr=False)

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        if not isinstance(self.shape, Sequence) or isinstance(self.shape, str):
            raise TypeError(f"shape must be (y, x) or (z, y, x), got {self.shape!r}")
        if len(self.shape) not in (2, 3):
            raise ValueError(
                f"shape must have 2 or 3 axes, (y, x) or (z, y, x), got {self.shape!r}"
            )
        set_(self, "shape", tuple(whole(f"shape[{i}]", n) for i, n in enumerate(self.shape)))
        set_(self, "ndim", len(self.shape))
        set_(
            self, "spacing", per_axis("spacing", self.spacing, self.ndim, positive=True, unit="mm")
        )
        set_(self, "center", per_axis("center", self.center, self.ndim, unit="mm"))

    @classmethod
    @checked
    def of(
        cls,
        scan: _HasGrid,
        *,
        voxel: float | None = None,
        extent: object = None,
        center: object = None,
    ) -> VolumeGrid:
        """The grid of what a scan sees.

        A scan that was acquired for a region (:func:`torchpcct.acquire`) gives that region. Of an
        earlier file, which does not say for which, and of a part of a scan
        (:meth:`torchpcct.Scan.crop`): a box that all views see. Of a whole detector: the square
        about the field of view, of a cone beam as high as all views see it.

        Args:
            scan: a :class:`torchpcct.Scan`, or the :class:`recon.slabs.ScanSlices` of a
                file.
            voxel: edge length in mm; None: of the region's voxels, or, of a whole detector and of a
                region given as one voxel, of a detector cell as it is seen at the axis.
            extent: edge lengths in mm: z, y, x of a scan with rows, y, x of slices, which are those
                of the readings. None: all that is seen.
            center: in mm, z, y, x, or y, x of slices. None: of what is seen.

        Raises:
            ValueError: values out of range, another number of axes, a part of a detector that sees
                no box in all views.
        """
        return scan.seen_grid(voxel, extent, center)

    @property
    def axes(self) -> tuple[Floats, ...]:
        """Voxel centres per axis in mm, in the order of ``shape``."""
        return tuple(
            _axis(n, s, c) for n, s, c in zip(self.shape, self.spacing, self.center, strict=True)
        )

    @property
    def extent(self) -> tuple[float, ...]:
        """Edge lengths in mm, in the order of ``shape``."""
        return tuple(n * s for n, s in zip(self.shape, self.spacing, strict=True))

    @property
    def in_plane_radius(self) -> float:
        """Distance in mm of the farthest voxel corner from the rotation axis."""
        reach = [abs(c) + e / 2 for c, e in zip(self.center, self.extent, strict=True)]
        return math.hypot(reach[-1], reach[-2])

    @property
    def voxels(self) -> int:
        """Number of voxels."""
        return math.prod(self.shape)

    @property
    def slice(self) -> VolumeGrid:
        """The 2-D ``(y, x)`` grid of one slice."""
        return VolumeGrid(self.shape[-2:], self.spacing[-2:], self.center[-2:])
