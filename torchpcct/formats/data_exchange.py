"""Data Exchange HDF5 (De Carlo et al., J. Synchrotron Rad. 21, 1224, 2014): synchrotron and neutron
projections.

What it shares with other parallel-beam files of beamlines (:mod:`~torchpcct.formats.nexus`) is
:class:`Frames`.
"""

from __future__ import annotations

import math
import os
import warnings
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple, Unpack

import numpy as np

from torchpcct.formats.arrays import given_array
from torchpcct.formats.damage import check_expansion, check_size, reading
from torchpcct.formats.geometry_yaml import angles_of
from torchpcct.formats.integer_readings import as_counted
from torchpcct.formats.lengths import MM, RAD, unit_text
from torchpcct.geometry import ParallelBeam
from torchpcct.hdf5 import inside
from torchpcct.readings import TRANSFER_FRAMES
from torchpcct.scan import Scan
from torchpcct.validate import number

if TYPE_CHECKING:
    import h5py
    from numpy.typing import ArrayLike

    from torchpcct.typing import Array, Bools, CountsOptions, Floats


__all__ = ["read_data_exchange"]

_PIXEL = (
    "measurement/instrument/detector/pixel_size",
    "measurement/instrument/detector/x_pixel_size",
    "measurement/instrument/detector/pixel_size_x",
)
"""Where Data Exchange files keep the size of a pixel, the first that is there."""
_HALF_TURNS = 4
"""Angles without a unit that end within a step of so many half turns, or fewer, are in rad."""
_LARGEST_UNNAMED_MM = 10.0
"""Largest pixel whose size has no unit: it is in m as the format says, or nobody knows in what."""
_SAME_SIZE = 1e-4
"""Relative difference of pixel sizes that are the same."""
_LARGEST_RAD = 7.0
"""Ranges of angles without a unit that may be either, if they are no half turns: beyond it they
are degrees."""


class Frames(NamedTuple):
    """What a file of a parallel beam holds, and what the arguments add.

    Attributes:
        path: of the file.
        format: its name.
        data: ``(views, rows, columns)``, the rows that were asked for.
        white, dark: frames ``(frames, rows, columns)``, one frame, or a number.
        angles: ``(views,)`` rad.
        pitch: cell width in mm; None: not known.
        pixel_size: what the file says of it.
        rows: first, stop and number of the file's rows, of which ``data`` are some; None: all.
    """

    path: str
    format: str
    data: Array
    white: ArrayLike
    dark: ArrayLike
    angles: Floats
    pitch: float | None
    pixel_size: str
    rows: list[int] | None

    def scan(self, mu_water: float | None = None, **options: Unpack[CountsOptions]) -> Scan:
        """The scan, its rotation axis in the detector's middle.

        Args:
            mu_water, options: of :meth:`torchpcct.Scan.from_counts`. Air frames that cannot tell
                what one photon reads (fewer than four, or averaged before): ``gain="noise"`` unless
                a number is given.

        Raises:
            ValueError: ``mu_water`` where the pixel size is not known; rows that are not there.
        """
        unknown = self.pitch is None
        if unknown and mu_water is not None:
            raise ValueError(
                f"HU need the pixel size, but {self.pixel_size}: give pitch= with mu_water="
            )
        pitch = 1.0 if self.pitch is None else number("pitch", self.pitch, positive=True, unit="mm")
        if not self.data.size:
            raise ValueError(
                f"slices= must lie within the {self.rows[2] if self.rows else 0} rows of the file"
            )
        info: dict[str, object] = {
            "file": self.path,
            "format": self.format,
            "pixel_size": self.pixel_size,
        }
        if self.rows is not None:
            info["slices"] = self.rows
        geometry = ParallelBeam(self.angles, self.data.shape[2], pitch)
        held = as_counted({"readings": self.data, "air": self.white, "dark": self.dark}, self.path)
        white = np.asarray(held["air"])
        if options.get("gain") is None and (white.ndim < 3 or len(white) < TRANSFER_FRAMES):
            options["gain"] = "noise"
        scan = Scan.from_counts(
            np.moveaxis(held["readings"], 0, 1),
            geometry,
            air=held["air"],
            dark=held["dark"],
            mu_water=mu_water,
            info=info,
            **options,
        )
        return replace(scan, unit="pixel^-1") if unknown else scan


def read_data_exchange(
    path: str | os.PathLike[str],
    *,
    pitch: float | None = None,
    slices: slice | None = None,
    angles_deg: object = None,
    air: ArrayLike | str | os.PathLike[str] | None = None,
    dark: ArrayLike | str | os.PathLike[str] | None = None,
    mu_water: float | None = None,
    **options: Unpack[CountsOptions],
) -> Scan:
    """A parallel-beam scan: ``/exchange/data`` (views, rows, columns) with white and dark frames
    and ``theta``.

    Args:
        path: HDF5 file.
        pitch: cell width in mm; None: the file's pixel size. If it knows none, lengths are in
            pixels and volumes in pixel^-1.
        slices: rows to read; None: all.
        angles_deg: angles in degrees, as :func:`torchpcct.formats.geometry_yaml.angles_of` takes
            them; None: the file's ``theta``. That is in degrees or rad as it says; without a unit
            in rad where it ends at half turns.
        air, dark: readings without the object, and without beam: a number, an array of one frame or
            several, or the name of a file of :func:`torchpcct.formats.arrays.read_array`; None: the
            file's white and dark frames.
        mu_water, options: of :meth:`torchpcct.Scan.from_counts`; see :meth:`Frames.scan`.

    Returns:
        Scan with counts ``(slices, views, columns)``, the rotation axis in the detector's middle
        (:func:`torchpcct.formats.preprocess.find_axis` finds it).

    Raises:
        FileNotFoundError: no such file.
        ValueError: no Data Exchange file, damaged, one that keeps data in other files; without
            angles or air readings where none are given, angles in an unknown unit; ``mu_water``
            where the pixel size is not known.
    """
    import h5py

    with reading(path, "a Data Exchange file"), h5py.File(path, "r") as file:
        data = inside(file, "exchange/data")
        if data is None:
            raise ValueError("it has no /exchange/data")
        check_size(data.shape, "/exchange/data")
        if data.ndim != 3:
            raise ValueError(
                f"/exchange/data has the shape {data.shape}, expected (views, rows, columns)"
            )
        rows = slice(None) if slices is None else slices
        theta = inside(file, "exchange/theta")
        if angles_deg is not None:
            angles = angles_of(angles_deg, views=data.shape[0])
        elif theta is None:
            raise ValueError("it has no angles, /exchange/theta: give angles_deg=")
        else:
            angles = angles_in(theta, data.shape[0], "/exchange/data")
        frames = {}
        for name, given, own in (("air", air, "data_white"), ("dark", dark, "data_dark")):
            frames[name] = (
                _frames(inside(file, f"exchange/{own}"), data.shape, rows)
                if given is None
                else (given_frames(given, data.shape, rows))
            )
        if frames["air"] is None:
            raise ValueError(
                "it has no white frames, /exchange/data_white: readings cannot be normalised; "
                "give air=, the reading without the object"
            )
        if pitch is None:
            pitch, source = _pixel_size(file)
        else:
            source = f"given, {pitch} mm"
        part = None if slices is None else [*slices.indices(data.shape[1])[:2], data.shape[1]]
        return Frames(
            str(path),
            "Data Exchange",
            _rows(data, rows),
            frames["air"],
            0.0 if frames["dark"] is None else frames["dark"],
            angles,
            pitch,
            source,
            part,
        ).scan(mu_water, **options)


def _rows(data: h5py.Dataset, rows: slice) -> Array:
    """Some rows of a data set ``(frames, rows, columns)``."""
    size = (data.shape[0], max(1, len(range(*rows.indices(data.shape[1])))), data.shape[2])
    check_expansion(size, data.name, data.id.get_storage_size, data.dtype.itemsize)
    return data[:, rows]


def _frames(data: h5py.Dataset | None, shape: tuple[int, ...], rows: slice) -> ArrayLike | None:
    """Frames without the object or without beam: several, one, or one number for all cells;
    None: there are none."""
    if data is None:
        return None
    check_size(data.shape, data.name)
    if data.ndim == 3:
        return _rows(data, rows)
    return given_frames(np.asarray(data[()]), shape, rows)


def given_frames(given: object, shape: tuple[int, ...], rows: slice) -> Any:
    """Frames that a caller gives: a number, frames of the whole detector or of the rows, or the
    name of their file."""
    values = np.asarray(given_array(given))
    if values.size == 1:
        return float(values.reshape(()))
    return values[..., rows, :] if values.ndim > 1 and values.shape[-2] == shape[1] else values


def angles_in(data: h5py.Dataset, views: int, what: str, of: slice | Bools = slice(None)) -> Floats:
    """Angles ``(views,)`` in rad of a data set with or without a unit.

    Args:
        data: HDF5 data set.
        views: how many there must be.
        what: holds the views, for the message.
        of: index of those that are wanted.

    Raises:
        ValueError: another number, an unknown unit, or none where the angles may be degrees or rad.
    """
    angles = np.asarray(data[()], dtype=np.float64).ravel()
    if angles.size != views:
        raise ValueError(
            f"{data.name} has {angles.size} angles, {what} {views} views: give angles_deg="
        )
    angles = angles[of]
    unit = next(
        (unit_text(data.attrs[name]) for name in ("units", "unit") if name in data.attrs), ""
    )
    if unit:
        if unit not in RAD:
            raise ValueError(
                f"its angles, {data.name}, are in {unit!r}, which is neither deg nor rad: give "
                "angles_deg="
            )
        return angles * RAD[unit]
    span = float(np.ptp(angles)) if angles.size else 0.0
    step = span / max(angles.size - 1, 1)
    turns = round((span + 0.5 * step) / math.pi)
    if 1 <= turns <= _HALF_TURNS and -0.01 <= turns * math.pi - span <= 1.5 * step:
        warnings.warn(
            f"its angles, {data.name}, have no unit and cover {span:.4g}: they are taken as rad, "
            f"{turns} half turn{'s' * (turns > 1)}; angles_deg= sets them",
            UserWarning,
            stacklevel=2,
        )
        return angles
    if span <= _LARGEST_RAD and angles.size > 1:
        raise ValueError(
            f"its angles, {data.name}, have no unit and cover {span:.4g}: deg or rad? Give "
            "angles_deg="
        )
    return np.deg2rad(angles)


def length_in(data: h5py.Dataset) -> tuple[float | None, str]:
    """A length in mm of a data set of one number, or of equal ones, None if it has no known unit
    or is none; and what it says."""
    written = "units" in data.attrs
    unit = unit_text(data.attrs["units"]) if written else "m"
    sizes = np.ravel(data[()]).astype(np.float64)
    if sizes.size > 1 and not float(np.ptp(sizes)) <= _SAME_SIZE * abs(float(sizes[0])):
        return None, f"the file has pixels of {sizes.min():g} to {sizes.max():g} {unit}, not of one"
    value = float(sizes[0]) if sizes.size else math.nan
    known = unit in MM and math.isfinite(value) and value > 0
    if not written and known and value * MM[unit] > _LARGEST_UNNAMED_MM:
        return None, f"the file's pixel size is {value:g} without a unit, no size in m"
    return value * MM[unit] if known else None, f"the file's pixel size is {value:g} {unit}"


def _pixel_size(file: h5py.File) -> tuple[float | None, str]:
    """The pixel size in mm, None if the file does not know it, and what it says of it."""
    for name in _PIXEL:
        data = inside(file, name)
        if data is not None:
            return length_in(data)
    return None, "the file does not know its pixel size"
