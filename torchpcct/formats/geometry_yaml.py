"""Scan geometries as YAML: what a geometry needs, in mm and degrees.

kind: cone                 # parallel, fan, cone
angles_deg: {start: 0, step: 0.5, count: 720}      # or a list, or the name of a text file with one angle a line
sod: 626                   # not parallel
sdd: 1098
columns: 888
rows: 64                   # cone only
pitch: [1.1, 1.0]          # [row, column], or one number
offset: [0, 0.25]          # optional
detector: curved           # flat (default) or curved
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from torchpcct.geometry import ConeBeam, FanBeam, Geometry, ParallelBeam
from torchpcct.validate import choice, number, whole

__all__ = ["geometry_of", "geometry_values"]

_OWN = {
    "parallel": {"columns", "pitch", "offset"},
    "fan": {"sod", "sdd", "columns", "pitch", "offset", "detector"},
    "cone": {"sod", "sdd", "columns", "rows", "pitch", "offset", "detector"},
}
_KINDS: dict[str, Any] = {"parallel": ParallelBeam, "fan": FanBeam, "cone": ConeBeam}


def geometry_of(values: Any, folder: Path = Path()) -> Geometry:
    """The geometry that a mapping describes; see the module's text.

    Args:
        values: mapping, as read from YAML.
        folder: where a file of angles is looked for.

    Raises:
        ValueError, TypeError: missing, unknown or bad values.
    """
    if not isinstance(values, Mapping):
        raise TypeError(f"geometry must be a mapping with kind, angles_deg, columns, pitch …, got {values!r}")
    given = dict(values)
    kind = choice("geometry.kind", given.pop("kind", None), tuple(_KINDS))
    angles = _angles(given.pop("angles_deg", None), folder)
    unknown = sorted(map(str, set(given) - _OWN[kind]))
    if unknown:
        raise ValueError(
            f"unknown in a {kind} geometry: {', '.join(unknown)}; it takes {', '.join(sorted(_OWN[kind]))}"
        )
    missing = sorted(_OWN[kind] - {"offset", "detector"} - set(given))
    if missing:
        raise ValueError(f"geometry needs {', '.join(missing)}")
    made: Geometry = _KINDS[kind](angles, **given)
    return made


def _angles(value: Any, folder: Path) -> Any:
    if isinstance(value, Mapping):
        unknown = sorted(map(str, set(value) - {"start", "step", "count"}))
        if unknown or not {"step", "count"} <= set(value):
            raise ValueError(f"angles_deg must be {{start, step, count}}, a list or a file's name, got {dict(value)!r}")
        count = whole("angles_deg.count", value["count"])
        step = number("angles_deg.step", value["step"], unit="°")
        start = number("angles_deg.start", value.get("start", 0.0), unit="°")
        return np.deg2rad(start + step * np.arange(count))
    if isinstance(value, str):
        return np.deg2rad(np.loadtxt(folder / value, dtype=np.float64, ndmin=1))
    if value is None:
        raise ValueError("geometry needs angles_deg: {start, step, count}, a list or the name of a text file")
    return np.deg2rad(np.asarray(value, dtype=np.float64))


def geometry_values(geometry: Any) -> dict[str, Any]:
    """The mapping that :func:`geometry_of` reads; evenly spaced angles as start, step and count."""
    kind = next(name for name, made in _KINDS.items() if type(geometry) is made)
    degrees = np.rad2deg(geometry.angles)
    step = float(degrees[1] - degrees[0]) if degrees.size > 1 else 0.0
    even = degrees[0] + step * np.arange(degrees.size)
    angles: Any = degrees.tolist()
    if math.isclose(float(np.abs(even - degrees).max()), 0.0, abs_tol=1e-9):
        angles = {"start": float(degrees[0]), "step": step, "count": int(degrees.size)}
    values: dict[str, Any] = {"kind": kind, "angles_deg": angles}
    for name in ("sod", "sdd", "columns", "rows", "pitch", "offset", "detector"):
        if name in _OWN[kind]:
            value = getattr(geometry, name)
            values[name] = list(value) if isinstance(value, tuple) else value
    return values
