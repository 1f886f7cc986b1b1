"""Scans of Zeiss (Xradia) X-ray microscopes: ``.txrm``, an OLE file of images with their angles.

Names of the streams and the directions of columns, rows and angles as in dxchange and CIL's
``ZEISSDataReader`` (https://github.com/TomographicImaging/CIL): columns and rows as they are, the
source turns clockwise.
"""

from __future__ import annotations

import os
import warnings
from typing import TYPE_CHECKING, Unpack

import numpy as np

from torchpcct.formats.arrays import given_array
from torchpcct.formats.damage import check_expansion, needed, reading
from torchpcct.formats.integer_readings import as_counted
from torchpcct.geometry import ConeBeam, Geometry, ParallelBeam
from torchpcct.scan import Scan
from torchpcct.scan_file import slice_axis, sliced
from torchpcct.validate import number
from torchpcct.vector_geometry import VectorGeometry

if TYPE_CHECKING:
    import olefile
    from numpy.typing import ArrayLike

    from torchpcct.typing import Array, CountsOptions, Floats


__all__ = ["read_txrm"]

_TYPES = {3: "<u1", 5: "<u2", 10: "<f4"}
"""Of images, by the number that the files call ``DataType``."""
_CONE = 1
"""``XrayGeometry`` of a cone beam."""
_A_STORAGE = 100
"""Images of a storage ``ImageData1``, ``ImageData2``, …"""
_STILL = 1e-3
"""Shift of an image, in cells, that is none."""
_SAME_PLACE = 1e-3
"""Relative difference of distances that are the same."""
_SAME_TIME = 1e-2
"""Of exposures."""


def read_txrm(
    path: str | os.PathLike[str],
    *,
    slices: slice | None = None,
    air: ArrayLike | str | os.PathLike[str] | None = None,
    dark: ArrayLike | str | os.PathLike[str] = 0.0,
    mu_water: float | None = None,
    **options: Unpack[CountsOptions],
) -> Scan:
    """The scan of a ``.txrm`` file: a cone beam, or parallel rays of an instrument with optics.

    Images that were shifted against each other while they were taken make a
    :class:`~torchpcct.vector_geometry.VectorGeometry`.

    Args:
        path: ``.txrm`` file.
        slices: detector rows to read; None: all.
        air: reading without the object; None: the file's reference image.
        dark, mu_water, options: of :meth:`torchpcct.Scan.from_counts`; ``gain`` by default from the
            noise.

    Raises:
        FileNotFoundError: no such file.
        ValueError: damaged, a value or image that is missing; no reference image and no ``air``.
        ImportError: ``olefile`` is not installed.
    """
    olefile = needed("olefile")
    with reading(path, "a Zeiss scan"), olefile.OleFileIO(os.fspath(path)) as file:
        held = _Streams(file)
        width, height = (
            int(held.numbers(f"ImageInfo/Image{name}", "<u4")[0]) for name in ("Width", "Height")
        )
        count = int(held.numbers("ImageInfo/NoOfImages", "<u4")[0])
        if file.exists("ImageInfo/ImagesTaken"):  # of a scan that was stopped
            count = min(count, int(held.numbers("ImageInfo/ImagesTaken", "<u4")[0]))
        kind = _type(held.numbers("ImageInfo/DataType", "<u4")[0])
        check_expansion((count, height, width), "the scan", os.stat(path).st_size)
        geometry = _geometry(held, count, height, width)
        if options.get("flux") is None:
            _check_exposures(held, count, path)
        rows = slice(None)
        info: dict[str, object] = {"file": str(path), "format": "Zeiss"}
        if slices is not None:
            slice_axis(geometry, (count, height, width))
            geometry, kept = sliced(geometry, slices, height)
            info["slices"], rows = kept, slice(*kept[:2])
        readings = np.stack(
            [
                held.image(f"ImageData{k // _A_STORAGE + 1}/Image{k + 1}", kind, height, width)[
                    rows
                ]
                for k in range(count)
            ]
        )
        if air is None:
            if not file.exists("ReferenceData/Image"):
                raise ValueError(
                    "it has no reference image: give air=, the reading without the object"
                )
            of = "ReferenceData/DataType"
            reference = _type(held.numbers(of, "<u4")[0]) if file.exists(of) else kind
            air = held.image("ReferenceData/Image", reference, height, width)[rows]
        options.setdefault("gain", "noise")
        arrays = as_counted(
            {"readings": readings, "air": given_array(air), "dark": given_array(dark)}, str(path)
        )
        readings = arrays.pop("readings")
        if not geometry.has_rows:
            readings = np.moveaxis(readings, 0, 1)
        return Scan.from_counts(
            readings, geometry, mu_water=mu_water, info=info, **arrays, **options
        )


def _type(code: int) -> str:
    if int(code) not in _TYPES:
        raise ValueError(f"its images are of the unknown type {int(code)}")
    return _TYPES[int(code)]


class _Streams:
    """Streams of an OLE file as numbers."""

    def __init__(self, file: olefile.OleFileIO) -> None:
        self.file = file

    def numbers(self, name: str, kind: str, count: int = 1) -> Array:
        """At least ``count`` numbers of a stream."""
        if not self.file.exists(name):
            raise ValueError(f"it has no {name}")
        content = self.file.openstream(name).read()
        size = np.dtype(kind).itemsize
        if len(content) < size * count:
            raise ValueError(f"its {name} holds {len(content) // size} of {count} numbers")
        return np.frombuffer(content, kind, count)

    def of_images(self, name: str, count: int) -> Floats:
        """What stands there once, or for each image; of a scan that was stopped the rest may be
        0."""
        size = self.file.get_size(name) // np.dtype("<f4").itemsize
        return self.numbers(name, "<f4", max(1, min(size, count))).astype(np.float64)

    def distance(self, name: str, count: int) -> float:
        """A distance in mm of all images."""
        first = self.numbers(name, "<f4")[0]
        each = np.abs(self.of_images(name, count))
        other = np.flatnonzero((np.abs(each - each[0]) > _SAME_PLACE * each[0]) & (each != 0))
        if other.size:
            raise ValueError(
                f"its {name} is {each[0]:g} mm of image 1 and {each[other[0]]:g} mm of image "
                f"{other[0] + 1}: the axis or the detector was moved; export the images of one "
                "distance, or make a stack of them with a geometry of vectors"
            )
        return number(name, abs(float(first)), positive=True, unit="mm")

    def image(self, name: str, kind: str, height: int, width: int) -> Array:
        return self.numbers(name, kind, height * width).reshape(height, width)


def _check_exposures(held: _Streams, count: int, path: str | os.PathLike[str]) -> None:
    """Warn of exposures that differ between images."""
    name = "ImageInfo/ExpTimes"
    if not held.file.exists(name):
        return
    times = held.of_images(name, count)
    times = times[times > 0]
    if times.size and np.ptp(times) > _SAME_TIME * times.mean():
        warnings.warn(
            f"{path}: the exposures of its images reach from {times.min():g} to {times.max():g} s, "
            "and are taken for equal: give flux=, the exposure of each view over that of the "
            "reference, unless the readings were divided by it",
            UserWarning,
            stacklevel=3,
        )


def _geometry(held: _Streams, count: int, height: int, width: int) -> Geometry:
    degrees = held.numbers("ImageInfo/Angles", "<f4", count).astype(np.float64)
    angles = -np.deg2rad(degrees) - np.pi / 2
    cell = (
        number(
            "ImageInfo/PixelSize",
            held.numbers("ImageInfo/PixelSize", "<f4")[0],
            positive=True,
            unit="µm",
        )
        * 1e-3
    )
    cone = (
        not held.file.exists("ImageInfo/XrayGeometry")
        or held.numbers("ImageInfo/XrayGeometry", "<i4")[0] == _CONE
    )
    if not cone:
        return ParallelBeam(angles, width, cell)
    sod, beyond = (
        held.distance(name, count)
        for name in ("ImageInfo/StoRADistance", "ImageInfo/DtoRADistance")
    )
    pitch = cell * (sod + beyond) / sod  # the files say the size of a voxel
    circle = ConeBeam(angles, sod, sod + beyond, width, height, pitch)
    shifts = {}
    for axis, name in (("columns", "x"), ("rows", "y")):
        stream = next(
            (
                s
                for s in (f"alignment/{name}-shifts", f"Alignment/{name.upper()}-Shifts")
                if held.file.exists(s)
            ),
            None,
        )
        if stream is not None:
            shifts[axis] = held.numbers(stream, "<f4", count).astype(np.float64)
            wrong = np.flatnonzero(~np.isfinite(shifts[axis]))
            if wrong.size:
                raise ValueError(
                    f"its {stream} of image {wrong[0] + 1} is {shifts[axis][wrong[0]]}, no shift: "
                    "export the scan again"
                )
    if any(float(np.abs(s).max()) > _STILL for s in shifts.values()):
        return VectorGeometry.of(circle).shifted(**shifts)
    return circle
