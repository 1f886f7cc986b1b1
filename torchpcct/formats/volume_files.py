"""Volumes as NIfTI and MetaImage, and the names of all formats: what
:class:`torchpcct.volume.Volume` saves and loads.

The scanner's x, y, z are taken for right, anterior, superior: NIfTI's axes. DICOM and ITK have x
and y the other way, so the same point carries the opposite sign there; every reader shows the same
volume at the same place.
"""

from __future__ import annotations

import gzip
import io
import itertools
import json
import math
import os
import re
import shutil
import warnings
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from torchpcct.files import (
    atomic_write,
    is_own_hdf5,
    require_folder,
    require_ordinary,
    require_writable,
)
from torchpcct.formats.damage import check_expansion, check_size, needed, reading
from torchpcct.formats.dicom_series import DICOM_ENDINGS, check_series
from torchpcct.formats.lengths import MM
from torchpcct.formats.volume_grid import STRAIGHT, grid_from
from torchpcct.geometry import VolumeGrid
from torchpcct.validate import UNITS

if TYPE_CHECKING:
    import nibabel
    from numpy.typing import ArrayLike

    from torchpcct.typing import Floats32


__all__ = ["check_volume_name"]

ENDINGS = {
    "NIfTI": (".nii", ".nii.gz"),
    "MetaImage": (".mha",),
    "HDF5": (".h5", ".hdf5"),
    "OME-Zarr": (".zarr",),
}
"""Of files, and of the folder of an OME-Zarr; a name without ending is a folder for a DICOM
series."""

_ENDING = re.compile(r"\.[A-Za-z][A-Za-z0-9]{0,7}$")
"""What is meant to name a format."""
_MADE_BY = "torchpcct, "
"""Beginning of the description in files that are written."""
_MM = {0: 1.0, 1: 1e3, 2: 1.0, 3: 1e-3}
"""Millimetres of NIfTI's units of length: unknown (in practice mm), metre, millimetre,
micrometre."""
_SAME_PLACE = 0.1
"""Part of a voxel by which sform and qform may differ: they are kept in float32, as a rotation in
the one, as a matrix in the other."""
_LONGEST_HEADER = 2**16
"""Bytes of a MetaImage's header at most."""
_AFTER_VOXELS = 2**20
"""Bytes that may stand behind the voxels of a packed NIfTI."""


def format_of(path: str | os.PathLike[str]) -> str:
    """Name of the format that the ending of ``path`` stands for, in any capitals; a file of one
    DICOM image is "DICOM", too, and so is any folder: dots in the names of archives
    (``1.2.840.113619``) are no endings.

    Raises:
        ValueError: another ending.
    """
    name, ending = Path(path).name.lower(), Path(path).suffix
    for form, endings in ENDINGS.items():
        if name.endswith(endings):
            return form
    if (
        ending.lower() in DICOM_ENDINGS
        or Path(path).is_dir()
        or (name not in ("", "..") and not _ENDING.match(ending))
    ):
        return "DICOM"
    known = ", ".join(e for endings in ENDINGS.values() for e in endings)
    raise ValueError(
        f"unknown volume format {Path(path).name!r}: use {known}, or no ending for a DICOM series"
    )


def check_volume_name(path: str | os.PathLike[str]) -> None:
    """Raise ``ValueError`` unless the ending of ``path`` names a volume format that is written;
    none: a folder for a DICOM series."""
    if format_of(path) == "DICOM" and Path(path).suffix.lower() in DICOM_ENDINGS:
        raise ValueError(
            f"{Path(path).name!r} would be one slice: a DICOM series is a folder, a name without "
            "ending"
        )


def check_target(path: str | os.PathLike[str], voxels: int = 0, unit: str = "HU") -> None:
    """Find out whether a volume can be written, before it is computed.

    Args:
        path: file or folder to write.
        voxels: of the volume.
        unit: HU or mm^-1.

    Raises:
        ValueError: an unknown ending, a folder in the place of a file, a series into a folder that
            holds something, or in another unit than HU.
        OSError: nothing can be written there, or less than the volume needs.
        ImportError: the package that writes the format is not installed.
    """
    check_volume_name(path)
    require_folder(path)
    target, form = Path(path), format_of(path)
    if form == "DICOM":
        needed("pydicom")
        check_series(target, unit)
    elif target.is_dir() and not (form == "OME-Zarr" and is_own_volume(target)):
        raise ValueError(f"{target} is a folder: name a file to write")
    if form == "OME-Zarr":
        needed("zarr")
    require_writable(target.parent)
    compressed = form in ("MetaImage", "OME-Zarr") or target.suffix.lower() == ".gz"
    least = 0 if compressed else voxels * (2 if form == "DICOM" else 4)
    free = shutil.disk_usage(target.parent).free
    if least > free:
        raise OSError(
            f"{target} needs {least / 2**30:.2f} GiB, {free / 2**30:.2f} GiB are free: name "
            "another folder"
        )


def is_own_volume(path: str | os.PathLike[str]) -> bool:
    """Whether a file is a volume that this software has written, as far as its header says.

    For the folder of a series it is true: :func:`check_target` wants an empty one.
    """
    form = format_of(path)
    if form == "DICOM":
        return Path(path).is_dir()
    if form == "HDF5":
        return is_own_hdf5(path, "volume")
    if form == "OME-Zarr":
        try:
            return (
                "torchpcct"
                in json.loads((Path(path) / "zarr.json").read_text(encoding="utf-8"))["attributes"]
            )
        except (OSError, ValueError, KeyError, TypeError):
            return False
    try:
        require_ordinary(path)
        with gzip.open(path) if _is_packed(path) else open(path, "rb") as file:
            header = file.read(2**12)
    except (OSError, EOFError, ValueError, zlib.error):
        return False
    return (_MADE_BY.encode() in header[:348]) if form == "NIfTI" else b"\nUnit = " in header


def _unit(written: str, name: str, given: str | None) -> str:
    """The unit that a file of ours names; files of other software (``written`` empty) are in what
    was ``given``, or HU.

    Raises:
        ValueError: another unit, or a given one that is not the file's.
    """
    if written and written not in UNITS:
        raise ValueError(f"its {name} gives the unit {written!r}, expected {' or '.join(UNITS)}")
    if written and given is not None and given != written:
        raise ValueError(f"its {name} gives the unit {written!r}, not {given!r}")
    return written or given or "HU"


def write_nifti(path: str | os.PathLike[str], data: ArrayLike, grid: VolumeGrid, unit: str) -> None:
    """Write NIfTI-1, float32, mm, RAS, with qform and sform (scanner coordinates); the unit
    stands in ``descrip``."""
    import nibabel

    # NIfTI stores (x, y, z).
    image = nibabel.Nifti1Image(
        np.asarray(data, dtype=np.float32).transpose(2, 1, 0), None, nifti_header(grid, unit)
    )
    with atomic_write(path) as part, part.open("wb") as raw:
        if not _is_packed(path):
            image.to_stream(raw)
        else:
            # the same for the same
            with gzip.GzipFile("", "wb", compresslevel=1, fileobj=raw, mtime=0) as packed:
                image.to_stream(packed)


def nifti_header(grid: VolumeGrid, unit: str) -> nibabel.Nifti1Header:
    """The header of a NIfTI-1 file of float32 voxels, which begin at byte 352."""
    import nibabel

    affine = np.diag([*grid.spacing[::-1], 1.0])
    affine[:3, 3] = [axis[0] for axis in grid.axes[::-1]]
    header = nibabel.Nifti1Header()
    header.set_data_dtype(np.float32)
    header.set_data_shape(grid.shape[::-1])
    header.set_qform(affine, code="scanner")
    header.set_sform(affine, code="scanner")
    header.set_xyzt_units("unknown" if unit == "pixel^-1" else "mm")
    header["descrip"] = (_MADE_BY + unit).encode()
    header["vox_offset"] = 352
    return header


def read_nifti(
    path: str | os.PathLike[str], unit: str | None = None
) -> tuple[Floats32, VolumeGrid, str]:
    """Data ``(z, y, x)`` float32, grid in mm and unit of a NIfTI volume, axes in any order or
    direction.

    Lengths are in the file's unit (metres, millimetres, micrometres; mm where it is unknown). Axes
    of one behind the third are left out.

    Args:
        path: ``.nii`` or ``.nii.gz``.
        unit: of the numbers of other software's files; None: HU.

    Raises:
        FileNotFoundError: no such file. ValueError: damaged, several volumes, oblique, or an affine
            without inverse; a volume of ours in an unknown unit, or in another than ``unit``.
    """
    import nibabel

    with reading(path, "NIfTI"):
        if _is_packed(path):
            _check_packed(path)
        with gzip.open(path) if _is_packed(path) else open(path, "rb") as file:
            kind_of = _image_kind(file.read(4))
        # By what it holds: nibabel looks for another file where an ending is partly in capitals.
        holder = nibabel.fileholders.FileHolder(filename=str(path))
        image: Any = kind_of.from_file_map({"image": holder, "header": holder})
        header_bytes = kind_of.header_class.sizeof_hdr
        if image.dataobj.offset < header_bytes:
            raise ValueError(
                f"its voxels begin at byte {image.dataobj.offset}, within its header of "
                f"{header_bytes} bytes: its vox_offset is damaged"
            )
        shape, kind = tuple(image.shape), image.header.get_data_dtype()
        check_expansion(shape, "the volume", os.stat(path).st_size, max(4, kind.itemsize))
        if len(shape) < 3 or any(n > 1 for n in shape[3:]):
            volumes = math.prod(shape[3:])
            raise ValueError(
                f"it has the shape {shape}, {volumes} volumes: split them into files of one"
                if volumes > 1
                else f"it has the shape {shape}, expected three axes"
            )
        if kind.kind not in "iuf":
            raise ValueError(f"its voxels are {kind}, no real numbers")
        _warn_of_places(image.header)  # as the file has it: NiBabel changes it with the axes
        image = image.slicer[(..., *(0,) * (len(shape) - 3))] if len(shape) > 3 else image
        image = nibabel.as_closest_canonical(image)
        code = int(image.header["xyzt_units"]) % 8
        if code not in _MM:
            raise ValueError(f"its unit of length is the unknown code {code}")
        affine = image.affine.copy()
        affine[:3] *= _MM[code]
        matrix = affine[:3, :3]
        if not np.isfinite(affine).all():
            raise ValueError("its affine is not finite")
        spacing = np.diag(matrix).copy()
        if (spacing <= 0).any() or np.abs(
            matrix - np.diag(spacing)
        ).max() > STRAIGHT * spacing.max():
            raise ValueError("its axes are oblique: resample it to straight axes first")
        text = bytes(image.header["descrip"]).rstrip(b"\0").decode("ascii", "replace")
        unit = _unit(
            text.removeprefix(_MADE_BY) if text.startswith(_MADE_BY) else "", "descrip", unit
        )
        data = np.asarray(image.dataobj, dtype=np.float32).transpose(2, 1, 0)
        return np.ascontiguousarray(data), grid_from(data.shape, spacing, affine[:3, 3]), unit


def _is_packed(path: str | os.PathLike[str]) -> bool:
    """Whether a NIfTI is packed, by its ending in any capitals."""
    return str(path).lower().endswith(".gz")


def _image_kind(begin: bytes) -> Any:
    """NIfTI-1 or 2, by the first four bytes."""
    import nibabel

    sizes = {int.from_bytes(begin, order) for order in ("little", "big")}
    for kind in (nibabel.Nifti1Image, nibabel.Nifti2Image):
        if kind.header_class.sizeof_hdr in sizes:
            return kind
    raise ValueError(
        "it is empty" if not begin else "it does not begin as NIfTI does (a packed one is .nii.gz)"
    )


def _warn_of_places(header: Any) -> None:
    """Warn where a NIfTI's sform and qform put voxels at different places, or neither says where
    they are: readers differ in what they take."""
    known = [int(header[f"{form}_code"]) > 0 for form in ("sform", "qform")]
    if not any(known):
        warnings.warn(
            "its sform and qform are both unset (code 0), so it does not say which side is right: "
            "its middle is taken for 0 and its x axis points to the left, as by nibabel, for other "
            "programs to the right; set the sform to the right place",
            UserWarning,
            stacklevel=2,
        )
    if not all(known):
        return
    sform, qform = header.get_sform(), header.get_qform()
    ends = np.array(list(itertools.product(*((0, n - 1) for n in header.get_data_shape()[:3]))))
    apart = np.abs(ends @ (sform - qform)[:3, :3].T + (sform - qform)[:3, 3]).max()
    voxel = np.abs(np.linalg.norm(sform[:3, :3], axis=0)).min()
    if not apart <= _SAME_PLACE * voxel:
        warnings.warn(
            f"its sform and qform differ by up to {apart:.4g} of its units of length: the sform is "
            "taken, as by nibabel, other programs take the qform; set both to the right one",
            UserWarning,
            stacklevel=2,
        )


def _check_packed(path: str | os.PathLike[str]) -> None:
    """Unpack a ``.nii.gz`` to its end, where its checksum stands: NiBabel stops after the last
    voxel.

    Raises:
        ValueError: it holds more than its header says.
    """
    with gzip.open(path) as file:
        begin = file.read(1024)
        header: Any = _image_kind(begin[:4]).header_class
        held = header.from_fileobj(io.BytesIO(begin), check=False)
        bits, shape = int(held["bitpix"]), held.get_data_shape()
        check_size(shape, "the volume")
        most = int(held["vox_offset"]) + math.prod(map(int, shape)) * bits // 8 + _AFTER_VOXELS
        total = len(begin)
        while part := file.read(2**24):
            total += len(part)
            if total > most:
                raise ValueError(
                    f"it unpacks to more than the {most - _AFTER_VOXELS} bytes that its header says"
                )


def write_meta_image(
    path: str | os.PathLike[str], data: ArrayLike, grid: VolumeGrid, unit: str
) -> None:
    """Write a MetaImage (``.mha``, float32, compressed); the unit stands in the field ``Unit``."""
    # Not by ITK, which does not look whether a full disk has taken the last of a file.
    packed = zlib.compress(np.ascontiguousarray(np.asarray(data, dtype="<f4")).tobytes(), 2)
    x, y, z = (float(axis[0]) for axis in grid.axes[::-1])
    fields = {
        "ObjectType": "Image",
        "NDims": "3",
        "BinaryData": "True",
        "BinaryDataByteOrderMSB": "False",
        "CompressedData": "True",
        "CompressedDataSize": str(len(packed)),
        "TransformMatrix": "-1 0 0 0 -1 0 0 0 1",
        "Offset": f"{-x!r} {-y!r} {z!r}",
        "CenterOfRotation": "0 0 0",
        "ElementSpacing": " ".join(map(repr, reversed(grid.spacing))),
        "DimSize": " ".join(map(str, reversed(grid.shape))),
        "Unit": unit,
        "ElementType": "MET_FLOAT",
        "ElementDataFile": "LOCAL",
    }
    with atomic_write(path) as part, part.open("wb") as file:
        file.write("".join(f"{name} = {value}\n" for name, value in fields.items()).encode())
        file.write(packed)


def read_meta_image(
    path: str | os.PathLike[str], unit: str | None = None
) -> tuple[Floats32, VolumeGrid, str]:
    """Data ``(z, y, x)`` float32, grid and unit of a MetaImage by SimpleITK; arguments and errors
    as :func:`read_nifti`.

    Lengths are in its ``DistanceUnits``, mm if it has none. Its voxels are in the file itself; what
    lies in another file is refused.
    """
    sitk = needed("SimpleITK")
    with reading(path, "a MetaImage"):
        with open(path, "rb") as file:
            fields = _meta_fields(file.read(_LONGEST_HEADER))
            begin = fields.end
        reader = sitk.ImageFileReader()
        reader.SetFileName(str(path))
        reader.SetImageIO("MetaImageIO")  # whatever capitals its ending has
        reader.ReadImageInformation()
        size = tuple(reader.GetSize())
        check_size(size, "the volume")
        if len(size) < 3 or any(n > 1 for n in size[3:]) or reader.GetNumberOfComponents() != 1:
            raise ValueError(
                f"it has {size} voxels of {reader.GetNumberOfComponents()} components, expected "
                "one volume of x, y, z: write each by itself"
            )
        unit = _unit(fields.get("Unit"), "field Unit", unit)
        length = fields.get("DistanceUnits").lower()
        if length not in ("", "?", *MM):
            raise ValueError(f"its lengths are in the unknown unit {length!r}: write them in mm")
        mm = MM.get(length, 1.0)
        check_expansion(size, "the volume", os.stat(path).st_size)
        if not all(0.0 < v < math.inf for v in reader.GetSpacing()):
            raise ValueError(f"its ElementSpacing is {fields.get('ElementSpacing')}")
        held = _unpacked_size(path, begin) if fields.packed else os.stat(path).st_size - begin
        try:
            image = reader.Execute()
        except RuntimeError as error:
            raise ValueError(
                f"its {held} bytes of voxels are not those of {size} {fields.get('ElementType')}: "
                "copy or write it again"
            ) from error
        image = image[(..., *(0,) * (len(size) - 3))] if len(size) > 3 else image
        image = sitk.DICOMOrient(image, "RAS")
        direction = np.array(image.GetDirection()).reshape(3, 3)
        if np.abs(direction - np.diag([-1.0, -1.0, 1.0])).max() > STRAIGHT:
            raise ValueError("its axes are oblique: resample it to straight axes first")
        values = sitk.GetArrayFromImage(image)
        if fields.packed and held != values.nbytes:
            raise ValueError(
                f"its compressed voxels unpack to {held} bytes, not to the {values.nbytes} of its "
                "size: copy or write it again"
            )
        x, y, z = (mm * v for v in image.GetOrigin())
        spacing = [mm * v for v in image.GetSpacing()]
        return values.astype(np.float32), grid_from(values.shape, spacing, (-x, -y, z)), unit


class _MetaFields(NamedTuple):
    """Fields of a MetaImage's header, and where its voxels begin."""

    values: dict[str, str]
    end: int

    def get(self, name: str) -> str:
        """A field; empty: it has none."""
        return self.values.get(name, "")

    @property
    def packed(self) -> bool:
        """Whether the voxels are compressed, as MetaIO reads it."""
        return self.get("CompressedData")[:1] in ("T", "t", "1")


def _meta_fields(begin: bytes) -> _MetaFields:
    """The header of a MetaImage, which ends with ``ElementDataFile``.

    Raises:
        ValueError: none; voxels in other files; compressed ones of no given size, which ITK reads
            as zeros.
    """
    values: dict[str, str] = {}
    at = 0
    while "ElementDataFile" not in values:
        line, found, _ = begin[at:].partition(b"\n")
        name, equals, value = line.decode("latin-1").partition("=")
        if not (found and equals):
            raise ValueError("it does not begin as a MetaImage does, with its fields")
        values[name.strip()] = value.strip()
        at += len(line) + 1
    file = values["ElementDataFile"]
    if file.upper() != "LOCAL":
        raise ValueError(
            f"it keeps its voxels in another file, {file!r}: write it as one .mha "
            "(ElementDataFile = LOCAL)"
        )
    fields = _MetaFields(values, at)
    if fields.packed and not fields.get("CompressedDataSize"):
        raise ValueError("it does not say its CompressedDataSize: write it again, uncompressed")
    if fields.get("HeaderSize") not in ("", "0", "-1"):
        raise ValueError(
            f"its HeaderSize is {fields.get('HeaderSize')}, but its voxels follow its header: "
            "leave HeaderSize out"
        )
    scale = [fields.get(f"ElementToIntensityFunction{name}") for name in ("Slope", "Offset")]
    if any(v and float(v) != usual for v, usual in zip(scale, (1.0, 0.0), strict=True)):
        raise ValueError(
            f"its values are to be scaled (ElementToIntensityFunctionSlope {scale[0] or 1}, "
            f"Offset {scale[1] or 0}), which hardly any program does: write the scaled values"
        )
    return fields


def _unpacked_size(path: str | os.PathLike[str], begin: int) -> int:
    """Bytes of compressed voxels, unpacked bit by bit: ITK fills what it cannot unpack with
    anything.

    Raises:
        ValueError: they end too early. zlib.error: they are damaged.
    """
    unpack, total = zlib.decompressobj(), 0
    with open(path, "rb") as file:
        file.seek(begin)
        packed = file.read(2**20)
        while packed and not unpack.eof:
            total += len(unpack.decompress(packed, 2**24))  # a damaged stream may ask for any
            packed = unpack.unconsumed_tail or file.read(2**20)
    total += len(unpack.flush())
    if not unpack.eof:
        raise ValueError("its compressed voxels end too early")
    return total
