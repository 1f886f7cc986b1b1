"""Volumes as NIfTI, MetaImage and DICOM series: what :class:`torchpcct.volume.Volume` saves and loads.

The scanner's x, y, z are taken for right, anterior, superior: NIfTI's axes. DICOM and ITK have x and y the other way,
so the same point carries the opposite sign there; every reader shows the same volume at the same place.
"""

from __future__ import annotations

import gzip
import json
import os
import shutil
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torchpcct.files import atomic_write, is_own_hdf5, require_folder, require_writable
from torchpcct.formats.damage import check_size, needed, reading
from torchpcct.geometry import VolumeGrid
from torchpcct.validate import UNITS

__all__ = [
    "ENDINGS",
    "check_target",
    "check_volume_name",
    "format_of",
    "is_own_volume",
    "nifti_header",
    "read_dicom",
    "read_meta_image",
    "read_nifti",
    "write_dicom",
    "write_meta_image",
    "write_nifti",
]

ENDINGS = {"NIfTI": (".nii", ".nii.gz"), "MetaImage": (".mha",), "HDF5": (".h5", ".hdf5"), "OME-Zarr": (".zarr",)}
"""Of files, and of the folder of an OME-Zarr; a name without ending is a folder for a DICOM series."""

_DICOM = (".dcm", ".ima")
_STRAIGHT = 1e-4
_MADE_BY = "torchpcct, "
_HU_RANGE = (-32768, 32767)
_ROUNDED = 1e-9
"""Relative, of a decimal string of ten digits."""


def format_of(path: str | os.PathLike[str]) -> str:
    """Name of the format that the ending of ``path`` stands for; a file of one DICOM image is "DICOM", too.

    Raises:
        ValueError: none.
    """
    name = str(path)
    for form, endings in ENDINGS.items():
        if name.endswith(endings):
            return form
    if Path(path).suffix.lower() in _DICOM or (not Path(path).suffix and Path(path).name not in ("", ".", "..")):
        return "DICOM"
    known = ", ".join(e for endings in ENDINGS.values() for e in endings)
    raise ValueError(f"unknown volume format {Path(path).name!r}: use {known}, or no ending for a DICOM series")


def check_volume_name(path: str | os.PathLike[str]) -> None:
    """Raise ``ValueError`` unless the ending of ``path`` names a volume format that is written; none: a folder for a
    DICOM series."""
    if format_of(path) == "DICOM" and Path(path).suffix.lower() in _DICOM:
        raise ValueError(f"{Path(path).name!r} would be one slice: a DICOM series is a folder, a name without ending")


def check_target(path: str | os.PathLike[str], voxels: int = 0, unit: str = "HU") -> None:
    """Find out whether a volume can be written, before it is computed.

    Args:
        path: file or folder to write.
        voxels: of the volume.
        unit: HU or mm^-1.

    Raises:
        ValueError: an unknown ending, a folder in the place of a file, a series into a folder that holds something, or
            in another unit than HU.
        OSError: nothing can be written there, or less than the volume needs.
        ImportError: the package that writes the format is not installed.
    """
    check_volume_name(path)
    require_folder(path)
    target, form = Path(path), format_of(path)
    if form == "DICOM":
        needed("pydicom")
        _check_series(target, unit)
    elif target.is_dir() and not (form == "OME-Zarr" and is_own_volume(target)):
        raise ValueError(f"{target} is a folder: name a file to write")
    if form == "OME-Zarr":
        needed("zarr")
    require_writable(target.parent)
    compressed = form in ("MetaImage", "OME-Zarr") or target.suffix == ".gz"
    least = 0 if compressed else voxels * (2 if form == "DICOM" else 4)
    free = shutil.disk_usage(target.parent).free
    if least > free:
        raise OSError(f"{target} needs {least / 2**30:.2f} GiB, {free / 2**30:.2f} GiB are free: name another folder")


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
            return "torchpcct" in json.loads((Path(path) / "zarr.json").read_text(encoding="utf-8"))["attributes"]
        except (OSError, ValueError, KeyError, TypeError):
            return False
    try:
        with gzip.open(path) if str(path).endswith(".gz") else open(path, "rb") as file:
            header = file.read(2**12)
    except (OSError, EOFError, zlib.error):
        return False
    return (_MADE_BY.encode() in header[:348]) if form == "NIfTI" else b"\nUnit = " in header


def _check_series(folder: Path, unit: str) -> None:
    """Raise ``ValueError`` unless a CT series can be written to a new or empty folder."""
    if unit != "HU":
        raise ValueError(f"a DICOM CT series holds HU, this volume is in {unit}: save it as .nii.gz, .mha or .h5")
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is a file: name a new folder, or .nii.gz, .mha or .h5")
    if folder.is_dir() and any(folder.iterdir()):
        raise ValueError(f"{folder} is not empty: series in one folder mix, name a new one")


def _unit(written: str, name: str) -> str:
    """The unit that a file of ours names; files of other software (``written`` empty) are in HU.

    Raises:
        ValueError: another unit.
    """
    if written and written not in UNITS:
        raise ValueError(f"its {name} gives the unit {written!r}, expected {' or '.join(UNITS)}")
    return written or "HU"


def write_nifti(path: str | os.PathLike[str], data: Any, grid: VolumeGrid, unit: str) -> None:
    """Write NIfTI-1, float32, mm, RAS, with qform and sform (scanner coordinates); the unit stands in ``descrip``."""
    import nibabel

    # NIfTI stores (x, y, z).
    image = nibabel.Nifti1Image(np.asarray(data, dtype=np.float32).transpose(2, 1, 0), None, nifti_header(grid, unit))
    with atomic_write(path) as part, part.open("wb") as raw:
        if not str(path).endswith(".gz"):
            image.to_stream(raw)
        else:
            with gzip.GzipFile("", "wb", compresslevel=1, fileobj=raw, mtime=0) as packed:  # the same for the same
                image.to_stream(packed)


def nifti_header(grid: VolumeGrid, unit: str) -> Any:
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


def read_nifti(path: str | os.PathLike[str]) -> tuple[Any, VolumeGrid, str]:
    """Data ``(z, y, x)`` float32, grid and unit of a NIfTI volume, axes in any order or direction.

    Raises:
        FileNotFoundError: no such file. ValueError: damaged, not 3-D, oblique, or an affine without inverse; a volume
            of ours in an unknown unit.
    """
    import nibabel

    with reading(path, "NIfTI"):
        if str(path).endswith(".gz"):
            with gzip.open(path) as file:  # to its end, where its checksum stands: NiBabel stops after the last voxel
                while file.read(2**24):
                    pass
        image: Any = nibabel.load(path)
        check_size(image.shape, "the volume")
        if len(image.shape) != 3:
            raise ValueError(f"it has the shape {image.shape}, expected three axes")
        image = nibabel.as_closest_canonical(image)
        matrix = image.affine[:3, :3]
        if not np.isfinite(image.affine).all():
            raise ValueError("its affine is not finite")
        spacing = np.diag(matrix).copy()
        if (spacing <= 0).any() or np.abs(matrix - np.diag(spacing)).max() > _STRAIGHT * spacing.max():
            raise ValueError("its axes are oblique: resample it to straight axes first")
        text = bytes(image.header["descrip"]).rstrip(b"\0").decode("ascii", "replace")
        unit = _unit(text.removeprefix(_MADE_BY) if text.startswith(_MADE_BY) else "", "descrip")
        data = np.asarray(image.dataobj, dtype=np.float32).transpose(2, 1, 0)
        return np.ascontiguousarray(data), _grid(data.shape, spacing, image.affine[:3, 3]), unit


def _grid(shape: tuple[int, ...], spacing: Any, first: Any) -> VolumeGrid:
    """Grid from spacing and first voxel, both x, y, z in mm."""
    s, f = np.asarray(spacing, dtype=np.float64)[::-1], np.asarray(first, dtype=np.float64)[::-1]
    center = f + s * (np.array(shape) - 1) / 2
    return VolumeGrid(tuple(int(n) for n in shape), tuple(float(v) for v in s), tuple(float(v) for v in center))


def write_meta_image(path: str | os.PathLike[str], data: Any, grid: VolumeGrid, unit: str) -> None:
    """Write a MetaImage (``.mha``, float32, compressed); the unit stands in the field ``Unit``."""
    # Not by ITK, which does not look whether a full disk has taken the last of a file.
    packed = zlib.compress(np.ascontiguousarray(np.asarray(data, dtype="<f4")).tobytes(), 2)
    x, y, z = (float(axis[0]) for axis in grid.axes[::-1])
    fields = {
        "ObjectType": "Image", "NDims": "3", "BinaryData": "True", "BinaryDataByteOrderMSB": "False",
        "CompressedData": "True", "CompressedDataSize": str(len(packed)),
        "TransformMatrix": "-1 0 0 0 -1 0 0 0 1", "Offset": f"{-x!r} {-y!r} {z!r}", "CenterOfRotation": "0 0 0",
        "ElementSpacing": " ".join(map(repr, reversed(grid.spacing))),
        "DimSize": " ".join(map(str, reversed(grid.shape))), "Unit": unit, "ElementType": "MET_FLOAT",
        "ElementDataFile": "LOCAL",
    }  # fmt: skip
    with atomic_write(path) as part, part.open("wb") as file:
        file.write("".join(f"{name} = {value}\n" for name, value in fields.items()).encode())
        file.write(packed)


def read_meta_image(path: str | os.PathLike[str]) -> tuple[Any, VolumeGrid, str]:
    """Data ``(z, y, x)`` float32, grid and unit of a MetaImage by SimpleITK; errors as :func:`read_nifti`."""
    sitk = needed("SimpleITK")
    with reading(path, "a MetaImage"):
        reader = sitk.ImageFileReader()
        reader.SetFileName(str(path))
        reader.ReadImageInformation()
        check_size(reader.GetSize(), "the volume")
        if reader.GetDimension() != 3 or reader.GetNumberOfComponents() != 1:
            raise ValueError(f"it has {reader.GetDimension()} axes of {reader.GetNumberOfComponents()} components")
        unit = _unit(reader.GetMetaData("Unit").strip() if reader.HasMetaDataKey("Unit") else "", "field Unit")
        _check_compressed(Path(path).read_bytes())
        image = sitk.DICOMOrient(reader.Execute(), "RAS")
        direction = np.array(image.GetDirection()).reshape(3, 3)
        if np.abs(direction - np.diag([-1.0, -1.0, 1.0])).max() > _STRAIGHT:
            raise ValueError("its axes are oblique: resample it to straight axes first")
        data = sitk.GetArrayFromImage(image).astype(np.float32)
        x, y, z = image.GetOrigin()
        return data, _grid(data.shape, image.GetSpacing(), (-x, -y, z)), unit


def _check_compressed(content: bytes) -> None:
    """Raise where the compressed voxels of a MetaImage are damaged: ITK fills what it cannot unpack with anything."""
    mark = b"ElementDataFile = LOCAL\n"
    header, found, packed = content.partition(mark)
    if not found or b"CompressedData = True" not in header:
        return
    unpack = zlib.decompressobj()
    while packed and not unpack.eof:
        unpack.decompress(packed, 2**24)  # bit by bit: a damaged stream may ask for any memory
        packed = unpack.unconsumed_tail
    unpack.flush()
    if not unpack.eof:
        raise ValueError("its compressed voxels end too early")


def write_dicom(folder: str | os.PathLike[str], data: Any, grid: VolumeGrid, unit: str) -> None:
    """Write a CT series in HU, one file a slice, into a new or empty folder, which appears whole or not at all.

    int16, intercept 0, slope 1, or where values lie beyond int16 the least slope that holds them.

    Raises:
        ValueError: a volume in mm⁻¹, values that are not finite, a folder that holds files.
    """
    pydicom = needed("pydicom")
    from pydicom.uid import CTImageStorage, generate_uid

    _check_series(Path(folder), unit)
    values = np.asarray(data, dtype=np.float64)
    if not np.isfinite(values).all():
        raise ValueError("DICOM holds finite HU, the volume has NaN or infinite values: save it as .nii.gz or .h5")
    slope = float(_ds(max(1.0, values.max() / _HU_RANGE[1], values.min() / _HU_RANGE[0]) * (1 + _ROUNDED)))
    slope = 1.0 if slope < 1 + 2 * _ROUNDED else slope
    stored = np.rint(values / slope).astype("<i2")
    study, series, frame = (generate_uid() for _ in range(3))
    x, y, z = (float(axis[0]) for axis in grid.axes[::-1])
    dz, dy, dx = grid.spacing
    images = []
    for k, image in enumerate(stored):
        d = pydicom.Dataset()
        d.SOPClassUID = CTImageStorage
        d.StudyInstanceUID, d.SeriesInstanceUID, d.FrameOfReferenceUID = study, series, frame
        d.Modality, d.Manufacturer, d.SeriesDescription = "CT", "torchpcct", "simulated or reconstructed by torchpcct"
        d.ImageType = ["DERIVED", "PRIMARY", "AXIAL"]
        d.PatientName, d.PatientID, d.PatientBirthDate, d.PatientSex = "", "torchpcct", "", ""
        d.StudyDate = d.StudyTime = d.StudyID = d.AccessionNumber = d.ReferringPhysicianName = ""
        d.SeriesNumber, d.InstanceNumber, d.PositionReferenceIndicator = 1, k + 1, ""
        d.ImageOrientationPatient = [-1, 0, 0, 0, -1, 0]
        d.ImagePositionPatient = [_ds(-x), _ds(-y), _ds(z + k * dz)]
        d.PixelSpacing, d.SliceThickness = [_ds(dy), _ds(dx)], _ds(dz)
        d.RescaleSlope, d.RescaleIntercept, d.RescaleType = _ds(slope), "0", "HU"
        d.ImagesInAcquisition = len(stored)
        d.WindowCenter, d.WindowWidth, d.KVP, d.AcquisitionNumber = "40", "400", "", ""
        d.set_pixel_data(image, "MONOCHROME2", 16)
        images.append(d)
    with atomic_write(os.path.realpath(folder)) as part:
        part.mkdir()
        for k, d in enumerate(images):
            d.save_as(part / f"{k + 1:04d}.dcm", enforce_file_format=True)


def _ds(value: float) -> str:
    """A DICOM decimal string: at most 16 characters."""
    return f"{value:.10g}"


def read_dicom(path: str | os.PathLike[str]) -> tuple[Any, VolumeGrid, str]:
    """Data ``(z, y, x)`` float32, grid and unit (HU) of a DICOM CT series in a folder, or of one image's file.

    Slices that lack within a series are found by their places, those at its ends only in series of ours, which know
    how many there are. One slice is as thick as it says, else 1 mm.

    Raises:
        FileNotFoundError: no such file or folder, or no files in it.
        ValueError: damaged files, several series, missing or doubled slices, oblique axes.
        ImportError: pydicom is not installed.
    """
    pydicom = needed("pydicom")
    root = Path(path)
    paths = sorted(p for p in root.iterdir() if p.is_file() and not p.name.startswith(".")) if root.is_dir() else [root]
    if not paths:
        raise FileNotFoundError(f"no DICOM files in {path}")
    slices = []
    for file in paths:
        with reading(file, "a DICOM image"):
            d = pydicom.dcmread(file)
            check_size((len(paths), d.Rows, d.Columns), "the series")
            pixels = d.pixel_array.astype(np.float32) * np.float32(d.RescaleSlope) + np.float32(d.RescaleIntercept)
            ours = root.is_dir() and str(d.get("Manufacturer", "")) == _MADE_BY.strip(", ")
            slices.append(_Slice(
                str(d.SeriesInstanceUID), tuple(float(v) for v in d.ImageOrientationPatient),
                np.array([float(v) for v in d.ImagePositionPatient]), tuple(float(v) for v in d.PixelSpacing), pixels,
                float(d.get("SliceThickness") or 1.0), int(d.get("ImagesInAcquisition") or 0) if ours else 0,
            ))  # fmt: skip
    with reading(path, "a DICOM series"):
        return *_joined(slices), "HU"


class _Slice(NamedTuple):
    series: str
    orientation: tuple[float, ...]
    position: Any
    pixel: tuple[float, ...]
    image: Any
    thickness: float
    of: int
    """Slices of its series, 0: unknown."""


def _joined(slices: list[_Slice]) -> tuple[Any, VolumeGrid]:
    series, orientation, _, pixel, image, thickness, count = slices[0]
    for other in slices[1:]:
        if other.series != series:
            raise ValueError("it holds several series: keep each in a folder of its own")
        if other.orientation != orientation or other.pixel != pixel or other.image.shape != image.shape:
            raise ValueError("its slices differ in orientation, spacing or size")
    row, column = np.array(orientation[:3]), np.array(orientation[3:])
    if abs(abs(row[0]) - 1) > _STRAIGHT or abs(abs(column[1]) - 1) > _STRAIGHT:
        raise ValueError("its slices are not axial: resample it to straight axes first")
    slices.sort(key=lambda s: float(s.position[2]))
    z = np.array([float(s.position[2]) for s in slices])
    gaps = np.diff(z)
    if gaps.size and (gaps.min() <= 0 or np.ptp(gaps) > 0.01 * float(np.median(gaps))):
        at = int(np.argmax(np.abs(gaps - np.median(gaps))))
        raise ValueError(f"slices lack or repeat between z = {z[at]:g} and {z[at + 1]:g} mm")
    if count and count != len(slices):
        raise ValueError(f"it holds {len(slices)} of the {count} slices of its series")
    drift = np.abs(np.array([s.position[:2] for s in slices]) - slices[0].position[:2]).max()
    if drift > 0.01 * min(pixel):
        raise ValueError("its slices are shifted against each other (gantry tilt)")
    data = np.stack([s.image for s in slices])
    x, y = -slices[0].position[0], -slices[0].position[1]  # LPS to RAS
    dy, dx = pixel
    if row[0] > 0:  # columns run to the left: ours to the right
        data, x = data[..., ::-1], x - (data.shape[2] - 1) * dx
    if column[1] > 0:
        data, y = data[:, ::-1], y - (data.shape[1] - 1) * dy
    dz = float(np.median(gaps)) if gaps.size else thickness
    return np.ascontiguousarray(data), _grid(data.shape, (dx, dy, dz), (x, y, z[0]))
