"""Scan geometries as YAML: what a geometry needs, in mm and degrees.

A circular scan::

    kind: cone                 # parallel, fan, cone
    angles_deg: {start: 0, step: 0.5, count: 720}   # or a list, or a text file, one angle a line
    sod: 626                   # not parallel
    sdd: 1098
    columns: 888
    rows: 64                   # cone only
    pitch: [1.1, 1.0]          # [row, column], or one number
    offset: [0, 0.25]          # optional
    detector: curved           # flat (default) or curved
    pose:       # optional, flat detectors: numbers, lists or text files with one number a view
      {roll_deg: 0.3, tilt_deg: 0, slant_deg: 0, columns: jitter.txt, rows: 0.5, feed: 20,
       start: -30}

``pose`` makes a :class:`~torchpcct.vector_geometry.VectorGeometry`: ``columns`` and ``rows``
displace the detector by parts of a cell, along its own axes as they are turned; ``feed`` (mm of the
source along z in a turn) and ``start`` (its first height, mm) make a helix.

Every view by itself, ASTRA's vectors::

    kind: vectors
    vectors: poses.npy         # or .txt, or a list: (views, 6) or (views, 12) mm
    columns: 888
    rows: 64                   # with 12 numbers a view
    parallel: false            # optional

RTK's ``ThreeDCircularProjectionGeometry``::

    kind: rtk
    file: geometry.xml
    columns: 888
    rows: 64
    pitch: 1.0                 # [row, column], or one number
    origin: [0, 0]             # optional: of the first pixel, mm
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchpcct.formats.damage import read_numbers
from torchpcct.formats.rtk import read_rtk
from torchpcct.geometry import ConeBeam, FanBeam, Geometry, ParallelBeam
from torchpcct.validate import choice, number, reals, whole
from torchpcct.vector_geometry import VectorGeometry, helical_motion

if TYPE_CHECKING:
    from collections.abc import Callable

    from torchpcct.geometry import Beam
    from torchpcct.typing import Floats


_OWN = {
    "parallel": {"columns", "pitch", "offset"},
    "fan": {"sod", "sdd", "columns", "pitch", "offset", "detector"},
    "cone": {"sod", "sdd", "columns", "rows", "pitch", "offset", "detector"},
}
"""Fields of each kind of beam besides ``angles_deg`` and ``pose``."""
_KINDS: dict[str, Callable[..., Beam]] = {
    "parallel": ParallelBeam,
    "fan": FanBeam,
    "cone": ConeBeam,
}
"""Beams by ``kind``."""
_VECTORS = {
    "vectors": {"vectors", "columns", "rows", "parallel"},
    "rtk": {"file", "columns", "rows", "pitch", "origin"},
}
"""Fields of geometries given view by view."""
_OPTIONAL = {"offset", "detector", "parallel", "origin"}
"""Fields with a default."""
_TURNED = ("roll_deg", "tilt_deg", "slant_deg")
"""Fields of ``pose``: turns of the detector."""
_FULL_TURN_DEG = 360.0
"""Their largest value."""
_SHIFTED = ("columns", "rows")
"""Shifts of the detector, mm."""
_HELIX = ("feed", "start")
"""Travel of the table."""


def geometry_of(values: object, folder: Path = Path()) -> Geometry:
    """The geometry that a mapping describes; see the module's text.

    Args:
        values: mapping, as read from YAML.
        folder: where a file of angles is looked for.

    Raises:
        ValueError, TypeError: missing, unknown or bad values.
    """
    if not isinstance(values, Mapping):
        raise TypeError(
            "geometry must be a mapping with kind, angles_deg, columns, pitch …, got "
            f"{values!r:.200}"
        )
    given = dict(values)
    kind = choice("geometry.kind", given.pop("kind", None), (*_KINDS, *_VECTORS))
    own = (_OWN | _VECTORS)[kind]
    pose = given.pop("pose", None) if kind in _KINDS else None
    angles = angles_of(given.pop("angles_deg", None), folder) if kind in _KINDS else None
    unknown = sorted(map(str, set(given) - own))
    if unknown:
        raise ValueError(
            f"unknown in a {kind} geometry: {', '.join(unknown)}; it takes {', '.join(sorted(own))}"
        )
    missing = sorted(own - _OPTIONAL - ({"rows"} if kind == "vectors" else set()) - set(given))
    if missing:
        raise ValueError(f"geometry needs {', '.join(missing)}")
    if kind == "rtk":
        return read_rtk(folder / str(given.pop("file")), **given)
    if kind == "vectors":
        return VectorGeometry(_table("vectors", given.pop("vectors"), folder), **given)
    made: Geometry = _KINDS[kind](angles, **given)
    return made if pose is None else _posed(made, pose, folder)


def _table(name: str, value: object, folder: Path) -> Any:
    """Numbers as they are, or those of a ``.npy`` or text file."""
    if isinstance(value, str):
        return read_numbers(folder / value, f"a table of {name}")
    return value


def _posed(circle: Any, pose: object, folder: Path) -> VectorGeometry:
    """A circular scan whose detector is displaced and turned, or whose table travels."""
    known = (*_TURNED, *_SHIFTED, *_HELIX)
    if not isinstance(pose, Mapping) or not set(pose) <= set(known):
        raise ValueError(
            f"geometry.pose must be a mapping of {', '.join(known)}, got {pose!r:.200}"
        )
    given = {name: _table(f"pose.{name}", value, folder) for name, value in pose.items()}
    helix = {name: given.pop(name) for name in _HELIX if name in given}
    numbers = {name: reals(f"geometry.pose.{name}", value) for name, value in given.items()}
    for name in _TURNED:
        if name in numbers and not (np.abs(numbers[name]) <= _FULL_TURN_DEG).all():
            raise ValueError(
                f"geometry.pose.{name} must lie within ±{_FULL_TURN_DEG:g}°, got "
                f"{numbers[name].flat[np.argmax(~(np.abs(numbers[name]) <= _FULL_TURN_DEG))]:g}"
            )
    if "start" in helix and "feed" not in helix:
        raise ValueError("geometry.pose.start is the first height of a helix: give feed, too")
    found = VectorGeometry.of(circle, helical_motion(circle, **helix) if helix else None)
    found = found.turned(
        **{name[:-4]: np.deg2rad(numbers[name]) for name in _TURNED if name in numbers}
    )
    return found.shifted(**{name: numbers[name] for name in _SHIFTED if name in numbers})


def angles_of(value: object, folder: Path = Path(), views: int | None = None) -> Floats:
    """Angles ``(views,)`` in rad that ``angles_deg`` describes.

    Args:
        value: mapping of start (0, if left out), step and count, a list, or the name of a text or
            ``.npy`` file with one angle a line; all in degrees.
        folder: where the file is looked for.
        views: how many there must be; then a mapping needs no count.

    Raises:
        FileNotFoundError: no such file.
        ValueError, TypeError: missing, unknown or bad values, another number of angles.
    """
    found = _angles(
        value if views is None or not isinstance(value, Mapping) else {"count": views, **value},
        folder,
    )
    if views is not None and found.shape != (views,):
        raise ValueError(
            f"angles_deg must be {views} angles, one a view, got the shape {found.shape}"
        )
    return found


_MOST_VIEWS = 10**7
"""More are a slip of the pen: their angles alone would fill the memory."""


def _angles(value: object, folder: Path) -> Floats:
    if isinstance(value, Mapping):
        unknown = sorted(map(str, set(value) - {"start", "step", "count"}))
        if unknown or not {"step", "count"} <= set(value):
            raise ValueError(
                f"angles_deg must be {{start, step, count}}, a list or a file's name, got "
                f"{dict(value)!r:.200}"
            )
        count = whole("angles_deg.count", value["count"], high=_MOST_VIEWS)
        step = number("angles_deg.step", value["step"], unit="°")
        start = number("angles_deg.start", value.get("start", 0.0), unit="°")
        return np.deg2rad(start + step * np.arange(count))
    if isinstance(value, str):
        return np.deg2rad(np.atleast_1d(read_numbers(folder / value, "a table of angles")))
    if value is None:
        raise ValueError(
            "geometry needs angles_deg: {start, step, count}, a list or the name of a text file"
        )
    return np.deg2rad(reals("angles_deg", value))


def geometry_values(geometry: Geometry) -> dict[str, object]:
    """The mapping that :func:`geometry_of` reads; evenly spaced angles as start, step and count."""
    if isinstance(geometry, VectorGeometry):
        rows = {} if geometry.rows is None else {"rows": geometry.rows}
        lists = geometry.vectors.tolist()
        return {
            "kind": "vectors",
            "columns": geometry.columns,
            **rows,
            "parallel": geometry.parallel,
            "vectors": lists,
        }
    kind = next(name for name, made in _KINDS.items() if type(geometry) is made)
    degrees = np.rad2deg(geometry.angles)
    step = float(degrees[1] - degrees[0]) if degrees.size > 1 else 0.0
    even = degrees[0] + step * np.arange(degrees.size)
    angles: list[float] | dict[str, float] = degrees.tolist()
    if math.isclose(float(np.abs(even - degrees).max()), 0.0, abs_tol=1e-9):
        angles = {"start": float(degrees[0]), "step": step, "count": int(degrees.size)}
    values: dict[str, object] = {"kind": kind, "angles_deg": angles}
    for name in ("sod", "sdd", "columns", "rows", "pitch", "offset", "detector"):
        if name in _OWN[kind]:
            value = getattr(geometry, name)
            values[name] = list(value) if isinstance(value, tuple) else value
    return values
