"""Data Exchange HDF5 (De Carlo et al., J. Synchrotron Rad. 21, 1224, 2014): synchrotron and neutron projections."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from torchpcct.formats.damage import check_size, reading
from torchpcct.geometry import ParallelBeam
from torchpcct.scan import Scan
from torchpcct.validate import number

__all__ = ["read_data_exchange"]

_MM = {"m": 1e3, "meter": 1e3, "cm": 10.0, "mm": 1.0, "um": 1e-3, "µm": 1e-3, "micron": 1e-3, "microns": 1e-3}
_PIXEL = ("measurement/instrument/detector/pixel_size", "measurement/instrument/detector/x_pixel_size",
          "measurement/instrument/detector/pixel_size_x")  # fmt: skip


def read_data_exchange(
    path: str | os.PathLike[str],
    *,
    pitch: float | None = None,
    axis: float | None = None,
    slices: slice | None = None,
    mu_water: float | None = None,
    **options: Any,
) -> Scan:
    """A parallel-beam scan: ``/exchange/data`` (views, rows, columns) with white and dark frames and ``theta``.

    Args:
        path: HDF5 file.
        pitch: cell width in mm; None: the file's pixel size.
        axis: column of the rotation axis (may be fractional); None: the detector's middle.
            :func:`torchpcct.formats.preprocess.find_axis` finds it.
        slices: rows to read; None: all.
        mu_water, options: of :meth:`torchpcct.Scan.from_counts`.

    Returns:
        Scan with counts ``(slices, views, columns)``.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no Data Exchange file, damaged, without angles or pixel size.
    """
    import h5py

    with reading(path, "a Data Exchange file"), h5py.File(path, "r") as file:
        if "exchange/data" not in file:
            raise ValueError("it has no /exchange/data")
        data = file["exchange/data"]
        check_size(data.shape, "/exchange/data")
        if data.ndim != 3:
            raise ValueError(f"/exchange/data has the shape {data.shape}, expected (views, rows, columns)")
        rows = slice(None) if slices is None else slices
        frames = {name: file[f"exchange/{name}"][:, rows] for name in ("data_white", "data_dark")
                  if f"exchange/{name}" in file}  # fmt: skip
        if "data_white" not in frames:
            raise ValueError("it has no white frames, /exchange/data_white: readings cannot be normalised")
        readings = data[:, rows]
        angles = _theta(file, data.shape[0])
        if pitch is None:
            pitch = _pixel_size(file)
        number("pitch", pitch, positive=True, unit="mm")
        columns = data.shape[2]
        offset = (
            0.0 if axis is None else ((columns - 1) / 2 - number("axis", axis, low=0.0, high=columns - 1.0)) * pitch
        )
        geometry = ParallelBeam(angles, columns, pitch, offset)
        return Scan.from_counts(
            np.moveaxis(readings, 0, 1), geometry, air=frames["data_white"], dark=frames.get("data_dark", 0.0),
            mu_water=mu_water, info={"file": str(path), "format": "Data Exchange"}, **options,
        )  # fmt: skip


def _theta(file: Any, views: int) -> Any:
    if "exchange/theta" not in file:
        raise ValueError("it has no angles, /exchange/theta")
    theta = file["exchange/theta"]
    angles = np.asarray(theta[()], dtype=np.float64).ravel()
    if angles.size != views:
        raise ValueError(f"/exchange/theta has {angles.size} angles, /exchange/data {views} views")
    unit = _text(theta.attrs.get("units", "deg")).lower()
    return angles if unit.startswith("rad") else np.deg2rad(angles)


def _pixel_size(file: Any) -> float:
    for name in _PIXEL:
        if name in file:
            unit = _text(file[name].attrs.get("units", "m")).lower()
            if unit not in _MM:
                raise ValueError(f"{name} has the unit {unit!r}: give pitch= in mm")
            return float(np.ravel(file[name][()])[0]) * _MM[unit]
    raise ValueError("it does not know its pixel size: give pitch= in mm")


def _text(value: Any) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)
