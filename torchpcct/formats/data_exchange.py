"""Data Exchange HDF5 (De Carlo et al., J. Synchrotron Rad. 21, 1224, 2014): synchrotron and neutron projections."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from typing import Any

import numpy as np

from torchpcct.formats.damage import check_size, reading
from torchpcct.geometry import ParallelBeam
from torchpcct.readings import TRANSFER_FRAMES
from torchpcct.scan import Scan
from torchpcct.validate import number

__all__ = ["read_data_exchange"]

_MM = {
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), 1e3), "cm": 10.0, "nm": 1e-6,
    **dict.fromkeys(("mm", "millimeter", "millimeters", "millimetre", "millimetres"), 1.0),
    **dict.fromkeys(("um", "µm", "μm", "micron", "microns", "micrometer", "micrometers", "micrometre"), 1e-3),
}  # fmt: skip
_PIXEL = ("measurement/instrument/detector/pixel_size", "measurement/instrument/detector/x_pixel_size",
          "measurement/instrument/detector/pixel_size_x")  # fmt: skip


def read_data_exchange(
    path: str | os.PathLike[str],
    *,
    pitch: float | None = None,
    slices: slice | None = None,
    mu_water: float | None = None,
    **options: Any,
) -> Scan:
    """A parallel-beam scan: ``/exchange/data`` (views, rows, columns) with white and dark frames and ``theta``.

    Args:
        path: HDF5 file.
        pitch: cell width in mm; None: the file's pixel size. If it knows none, lengths are in pixels and volumes in
            pixel^-1.
        slices: rows to read; None: all.
        mu_water, options: of :meth:`torchpcct.Scan.from_counts`. White frames that cannot tell what one photon reads
            (fewer than four, or averaged before): ``gain="noise"`` unless a number is given.

    Returns:
        Scan with counts ``(slices, views, columns)``, the rotation axis in the detector's middle
        (:func:`torchpcct.formats.preprocess.find_axis` finds it).

    Raises:
        FileNotFoundError: no such file.
        ValueError: no Data Exchange file, damaged, without angles; ``mu_water`` where the pixel size is not known.
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
        frames = {name: file[f"exchange/{name}"][..., rows, :] for name in ("data_white", "data_dark")
                  if f"exchange/{name}" in file}  # fmt: skip
        if "data_white" not in frames:
            raise ValueError("it has no white frames, /exchange/data_white: readings cannot be normalised")
        readings = data[:, rows]
        angles = _theta(file, data.shape[0])
        info: dict[str, Any] = {"file": str(path), "format": "Data Exchange"}
        if slices is not None:
            info["slices"] = [*slices.indices(data.shape[1])[:2], data.shape[1]]
        if pitch is None:
            pitch, info["pixel_size"] = _pixel_size(file)
        unknown = pitch is None
        if unknown and mu_water is not None:
            raise ValueError(f"HU need the pixel size, but {info['pixel_size']}: give pitch= with mu_water=")
        pitch = 1.0 if pitch is None else number("pitch", pitch, positive=True, unit="mm")
        if not readings.size:
            raise ValueError(f"slices= must lie within the {data.shape[1]} rows of the file")
        geometry = ParallelBeam(angles, data.shape[2], pitch)
        white = frames["data_white"]
        if options.get("gain") is None and (white.ndim < 3 or len(white) < TRANSFER_FRAMES):
            options["gain"] = "noise"
        scan = Scan.from_counts(
            np.moveaxis(readings, 0, 1), geometry, air=white, dark=frames.get("data_dark", 0.0), mu_water=mu_water,
            info=info, **options,
        )  # fmt: skip
        return replace(scan, unit="pixel^-1") if unknown else scan


def _theta(file: Any, views: int) -> Any:
    if "exchange/theta" not in file:
        raise ValueError("it has no angles, /exchange/theta")
    theta = file["exchange/theta"]
    angles = np.asarray(theta[()], dtype=np.float64).ravel()
    if angles.size != views:
        raise ValueError(f"/exchange/theta has {angles.size} angles, /exchange/data {views} views")
    unit = _text(theta.attrs.get("units", "deg")).lower()
    return angles if unit.startswith("rad") else np.deg2rad(angles)


def _pixel_size(file: Any) -> tuple[float | None, str]:
    """The pixel size in mm, None if the file does not know it, and what it says of it."""
    for name in _PIXEL:
        if name in file:
            unit = _text(file[name].attrs.get("units", "m")).lower()
            value = float(np.ravel(file[name][()])[0])
            known_size = f"the file's pixel size is {value:g} {unit}"
            known = unit in _MM and math.isfinite(value) and value > 0
            return value * _MM[unit] if known else None, known_size
    return None, "the file does not know its pixel size"


def _text(value: Any) -> str:
    first = np.ravel(value)[0]  # some writers make arrays of one
    return first.decode() if isinstance(first, bytes) else str(first)
