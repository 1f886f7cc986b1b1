"""Cone-beam scans of Nikon / X-Tek machines: ``NAME.xtekct`` beside ``NAME_0001.tif``, …

The files count views as the object turns, columns from the right and rows from the top, as CIL's
``NikonDataReader`` has found (https://github.com/TomographicImaging/CIL): here the source turns the
other way, columns and rows are turned over.
"""

from __future__ import annotations

import configparser
import os
import re
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Unpack

import numpy as np

from torchpcct.formats.arrays import given_array, read_array
from torchpcct.formats.damage import read_text, reading
from torchpcct.formats.file_names import in_number_order
from torchpcct.formats.geometry_yaml import angles_of
from torchpcct.formats.integer_readings import as_counted
from torchpcct.geometry import ConeBeam
from torchpcct.scan import Scan
from torchpcct.scan_file import sliced
from torchpcct.validate import number

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import ArrayLike

    from torchpcct.typing import CountsOptions, Floats


__all__ = ["read_xtekct"]

_NEEDED = (
    "SrcToObject",
    "SrcToDetector",
    "DetectorPixelsX",
    "DetectorPixelsY",
    "DetectorPixelSizeX",
    "DetectorPixelSizeY",
    "Projections",
    "AngularStep",
    "WhiteLevel",
)
"""Entries that an .xtekct file must have."""
_STRAIGHT_DEG = 1e-3
"""Tilt of the object's axis that does not matter."""
_PLACED = 0.1
"""Offset of the detector that does not matter, in cells."""
_UNEVEN = 0.5
"""Steps of the turn by which listed angles may differ from even ones, as a table's do that is
read out while it turns."""


def read_xtekct(
    path: str | os.PathLike[str],
    *,
    slices: slice | None = None,
    angles_deg: object = None,
    air: ArrayLike | str | os.PathLike[str] | None = None,
    dark: ArrayLike | str | os.PathLike[str] = 0.0,
    mu_water: float | None = None,
    **options: Unpack[CountsOptions],
) -> Scan:
    """The scan that an ``.xtekct`` file describes.

    Its images are flat-field corrected: a reading without the object is ``WhiteLevel``.

    Args:
        path: ``.xtekct`` file.
        slices: detector rows to read, counted upwards; None: all.
        angles_deg: of the object in degrees, a list, the name of a file or a mapping of start and
            step; None: the file's ``InitialAngle`` and ``AngularStep``. Programs read the lists of
            angles that may lie beside it (``.ang``, ``_ctdata.txt``) in both directions: a warning
            says where they do not go on evenly.
        air: reading without the object; None: the file's ``WhiteLevel``.
        dark, mu_water, options: of :meth:`torchpcct.Scan.from_counts`; ``gain`` by default from the
            noise.

    Raises:
        FileNotFoundError: no such file, or no images.
        ValueError: a value that is missing or none, another number of images than ``Projections``,
            damaged images.
    """
    text = read_text(path, "a Nikon scan", other="cp1252")  # names of operators and parts
    with reading(path, "a Nikon scan"):
        file = configparser.ConfigParser(interpolation=None, strict=False)
        file.read_string(text)
        if not file.has_section("XTekCT"):
            raise ValueError("it has no section [XTekCT]")
        about = file["XTekCT"]
        missing = [name for name in _NEEDED if not about.get(name, "").strip()]
        if missing:
            raise ValueError(f"it has no {', '.join(missing)}")
        values = {
            name: number(name, about[name], positive=name != "AngularStep") for name in _NEEDED
        }
        for name in ("Projections", "DetectorPixelsX", "DetectorPixelsY"):
            if not values[name].is_integer():
                raise ValueError(f"{name} must be a whole number, got {about[name]!r}")
        views, columns, rows = (
            int(values[k]) for k in ("Projections", "DetectorPixelsX", "DetectorPixelsY")
        )
        turned = _turned(Path(path), about, values["AngularStep"], views, angles_deg)
        magnification = values["SrcToDetector"] / values["SrcToObject"]
        top, bottom = (_optional(about, f"CentreOfRotation{end}") for end in ("Top", "Bottom"))
        moved = about.get("ObjectOffsetX", "").strip()
        offset = number("ObjectOffsetX", moved) * magnification if moved else (top + bottom) / 2
        height = rows * values["DetectorPixelSizeY"]
        roll = _optional(about, "ObjectRoll") or float(np.rad2deg(np.arctan2(bottom - top, height)))
        tilts = {"ObjectRoll": roll, "ObjectTilt": _optional(about, "ObjectTilt")}
        for name, degrees in tilts.items():
            if abs(degrees) > _STRAIGHT_DEG:
                warnings.warn(
                    f"{path}: the rotation axis is inclined ({name} {degrees:.3g}°), which is left "
                    "out: give a VectorGeometry for it",
                    UserWarning,
                    stacklevel=2,
                )
        for axis, cell in (
            ("X", values["DetectorPixelSizeX"]),
            ("Y", values["DetectorPixelSizeY"]),
        ):
            shift = _optional(about, f"DetectorOffset{axis}")
            if abs(shift) > _PLACED * cell:
                warnings.warn(
                    f"{path}: DetectorOffset{axis} {shift:g} mm is left out, as programs differ in "
                    "its direction: find the rotation axis (find_axis, --find-axis), or calibrate",
                    UserWarning,
                    stacklevel=2,
                )
        geometry = ConeBeam(
            turned + np.pi / 2,
            values["SrcToObject"],
            values["SrcToDetector"],
            columns,
            rows,
            (values["DetectorPixelSizeY"], values["DetectorPixelSizeX"]),
            (0.0, offset),
        )
        names = _images(Path(path), about, views)
        info: dict[str, object] = {"file": str(path), "format": "Nikon"}
        pick = None
        if slices is not None:
            geometry, kept = sliced(geometry, slices, rows)
            info["slices"], (first, stop, _) = kept, kept

            def pick(shape: tuple[int, ...]) -> tuple[slice, ...]:
                return (slice(None), slice(rows - stop, rows - first), slice(None))

    readings = read_array([os.fspath(name) for name in names], Path(), pick)
    expected = (views, geometry.rows, columns)
    if readings.shape != expected:
        raise ValueError(f"{path}: its images have the shape {readings.shape}, it says {expected}")
    options.setdefault("gain", "noise")
    white = values["WhiteLevel"] if air is None else given_array(air)
    held = as_counted(
        {"readings": readings[:, ::-1, ::-1], "air": white, "dark": given_array(dark)}, str(path)
    )
    return Scan.from_counts(
        held.pop("readings"), geometry, mu_water=mu_water, info=info, **held, **options
    )


def _optional(about: Mapping[str, str], name: str) -> float:
    text = about.get(name, "").strip()
    return number(name, text) if text else 0.0


def _turned(path: Path, about: Mapping[str, str], step: float, views: int, given: object) -> Floats:
    """Angles of the object in rad."""
    if given is not None:
        return angles_of(given, path.parent, views)
    if not step and views > 1:
        raise ValueError(
            f"AngularStep is 0 and there are {views} Projections: the object has not turned; "
            "write the step in degrees"
        )
    even = step * np.arange(views)
    for beside in (path.with_suffix(".ang"), path.parent / "_ctdata.txt"):
        if not beside.is_file():
            continue
        listed = _listed(read_text(beside, "a list of angles", other="cp1252"))
        if listed.size != views:
            raise ValueError(f"{beside.name} lists {listed.size} angles of {views} Projections")
        turn = np.abs(listed - listed[0])
        # Tables count on beyond a turn, or begin again.
        off = np.abs((turn - np.abs(even) + 180.0) % 360.0 - 180.0)
        if off.max() > _UNEVEN * abs(step):
            warnings.warn(
                f"{path}: {beside.name} lists angles that do not go on by AngularStep ({step:g}°; "
                f"view {int(off.argmax()) + 1} is {off.max():.3g}° off), which is what is taken: "
                "give angles_deg= if the list is right",
                UserWarning,
                stacklevel=3,
            )
    return np.deg2rad(_optional(about, "InitialAngle") + even)


_LINE = re.compile(r"\s*\d+[:,\s]\s*([-+]?\d*\.?\d+(?:[eE][-+]?\d+)?)\b")
"""Number of a view, and its angle in degrees."""


def _listed(text: str) -> Floats:
    """Angles in degrees of the lines after the last heading, which may hold numbers, too."""
    found: list[str] = []
    for line in text.splitlines():
        match = _LINE.match(line)
        if match:
            found.append(match.group(1))
        elif line.strip():
            found.clear()
    return np.array(found, dtype=np.float64)


def _images(path: Path, about: Mapping[str, str], views: int) -> list[Path]:
    """The projections, in their order."""
    name, folder = (
        about.get("Name", "").strip() or path.stem,
        about.get("InputFolderName", "").strip().replace("\\", "/"),
    )
    wanted = re.compile(
        re.escape(name + about.get("InputSeparator", "_").strip()) + r"\d+\.tiff?", re.IGNORECASE
    )
    # moved from where it was written
    places = [path.parent / folder, path.parent / Path(folder).name, path.parent]
    found: list[Path] = []
    for place in dict.fromkeys(places):
        if place.is_dir():
            found = in_number_order(
                [each for each in place.iterdir() if wanted.fullmatch(each.name)]
            )
        if found:
            break
    if len(found) != views:
        raise ValueError(f"it says {views} Projections, {len(found)} images {name}_….tif are there")
    counts = [int(number.group()) for each in found if (number := re.search(r"\d+$", each.stem))]
    steps = np.diff(counts)  # every second view of a scan is sound, too
    if steps.size and (steps[0] < 1 or np.any(steps != steps[0])):
        at = int(np.argmax(steps != np.median(steps)))
        raise ValueError(
            f"the numbers of its images do not go on evenly: {found[at + 1].name} follows "
            f"{found[at].name}; a view is missing or there twice, and all that follow would have "
            "wrong angles: restore its images as they were taken"
        )
    return found
