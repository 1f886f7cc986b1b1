"""DICOM files: those of a folder, and CT series as volumes in HU."""

from __future__ import annotations

import datetime
import hashlib
import logging
import os
import re
import warnings
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from torchpcct.files import VERSION, atomic_write, require_ordinary
from torchpcct.formats.damage import check_expansion, needed, reading
from torchpcct.formats.volume_grid import STRAIGHT, grid_from
from torchpcct.geometry import VolumeGrid

if TYPE_CHECKING:
    from types import ModuleType

    import pydicom
    from numpy.typing import ArrayLike, NDArray

    from torchpcct.typing import Bools, Floats32, Ints


_LOG = logging.getLogger(__name__)

DICOM_ENDINGS = (".dcm", ".ima", ".dicom", ".dic")
"""Of files that are DICOM whatever is in them."""
_PREAMBLE = 128
"""Bytes before a DICOM file's mark."""
_MARK = b"DICM"
"""That mark."""
_DIRECTORY = b"1.2.840.10008.1.3.10"
"""Class of a DICOMDIR, which lists files and has no pixels."""
_DEFLATED = "1.2.840.10008.1.2.1.99"
"""Transfer syntax whose whole data set is packed."""
_MOST_INFLATED = 2**27
"""Bytes that such a data set may have: an image of 8192² pixels."""
_CT_CLASS = "1.2.840.10008.5.1.4.1.1.2"
"""CT Image Storage, and the beginning of its enhanced classes."""
_PIXELS = ("PixelData", "FloatPixelData", "DoubleFloatPixelData")
"""What may hold the pixels of an image."""
_MADE_BY = "torchpcct"
"""Manufacturer in files that are written."""
_HU_RANGE = (-32768, 32767)
"""Values of 16 bits, HU at a slope of 1."""
_ROUNDED = 1e-9
"""Relative, of a decimal string of ten digits."""
_LOWEST = -1024.5
"""Below it no tissue and no air reads, HU."""
_OFF_PLACE = 0.05
"""Part of the slices' distance by which one may lie off its place."""
_AIR = -1000.0
"""CT number of air, HU."""


# --- files ----------------------------------------------------------------------------------------


def dicom_files(folder: str | os.PathLike[str]) -> list[Path]:
    """DICOM files of a folder, in the order of their names, without what archives put beside them.

    Left out: hidden files, a DICOMDIR, texts, and files of other endings that do not begin as DICOM
    does. A file that ends like DICOM, or has no ending, is one, damaged or not.

    Raises:
        FileNotFoundError: none; a link to nothing. ValueError: a device or a pipe.
    """
    found = []
    for path in sorted(Path(folder).iterdir()) if Path(folder).is_dir() else []:
        if path.name.startswith(".") or path.is_dir():
            continue
        if not path.exists():
            raise FileNotFoundError(f"{path} is a link to nothing: take it away")
        require_ordinary(path)
        with path.open("rb") as file:
            begin = file.read(1024)
        if begin[_PREAMBLE : _PREAMBLE + 4] == _MARK:
            slices = _DIRECTORY + b"\0" not in begin and path.name.upper() != "DICOMDIR"
        else:
            ending = path.suffix.lower()
            slices = ending in DICOM_ENDINGS or not (
                re.fullmatch(r"\.[a-z]\w*", ending) or _is_text(begin)
            )
        if slices:
            found.append(path)
        else:
            _LOG.info("%s is no slice: left out", path)
    if not found:
        raise FileNotFoundError(f"no DICOM files in {folder}: name the folder that they lie in")
    return found


def _is_text(content: bytes) -> bool:
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError:
        return False
    return bool(text) and all(c.isprintable() or c in "\r\n\t\ufeff" for c in text)


def open_dicom(path: str | os.PathLike[str], **options: object) -> pydicom.Dataset:
    """A DICOM data set, for a block of :func:`torchpcct.formats.damage.reading`.

    Args:
        path: file.
        options: of ``pydicom.dcmread``.

    Raises:
        ValueError: no DICOM; a deflated data set of more than 128 MiB, which no image is; several
            frames; colours.
        ImportError: pydicom is not installed.
    """
    pydicom = needed("pydicom")
    with open(path, "rb") as file:
        begin = file.read(_PREAMBLE + len(_MARK))
    if begin[_PREAMBLE:] != _MARK:
        raise ValueError(
            "it is empty: take it away, or copy it again"
            if not begin
            else "it does not begin as DICOM does: take it away, or copy it again"
        )
    if str(pydicom.filereader.read_file_meta_info(path).get("TransferSyntaxUID", "")) == _DEFLATED:
        _check_inflated(path, pydicom)
    data = pydicom.dcmread(path, **options)
    frames, samples = int(data.get("NumberOfFrames") or 1), int(data.get("SamplesPerPixel") or 1)
    if frames > 1 or samples > 1:
        raise ValueError(
            f"it holds {frames} frames of {samples} colours, expected one grey image: export it as "
            "one file an image, or convert it to NIfTI (dcm2niix)"
        )
    if "Rows" in data and "Columns" in data:
        check_expansion((data.Rows, data.Columns), "the image", os.stat(path).st_size, 8)
    return data


def _check_inflated(path: str | os.PathLike[str], pydicom: ModuleType) -> None:
    """Inflate bit by bit and throw away: pydicom would take all at once."""
    length = int(
        pydicom.filereader.read_file_meta_info(path).get("FileMetaInformationGroupLength", 0)
    )
    unpack, total = zlib.decompressobj(-zlib.MAX_WBITS), 0
    with open(path, "rb") as file:
        file.seek(_PREAMBLE + len(_MARK) + 12 + length)
        packed = file.read(2**16)
        while packed and not unpack.eof:
            total += len(unpack.decompress(packed, 2**20))
            if total > _MOST_INFLATED:
                raise ValueError(
                    f"its deflated data set is of more than {_MOST_INFLATED // 2**20} MiB: no "
                    "image is"
                )
            packed = unpack.unconsumed_tail or file.read(2**16)


# --- writing --------------------------------------------------------------------------------------


def check_series(folder: Path, unit: str) -> None:
    """Raise ``ValueError`` unless a CT series can be written to a new or empty folder."""
    if unit != "HU":
        raise ValueError(
            f"a DICOM CT series holds HU, this volume is in {unit}: save it as .nii.gz, .mha or .h5"
        )
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is a file: name a new folder, or .nii.gz, .mha or .h5")
    if folder.is_dir() and any(folder.iterdir()):
        raise ValueError(f"{folder} is not empty: series in one folder mix, name a new one")


def write_dicom(
    folder: str | os.PathLike[str], data: ArrayLike, grid: VolumeGrid, unit: str
) -> None:
    """Write a CT series in HU, one file a slice, into a new or empty folder, which appears whole or
    not at all.

    int16, intercept 0, slope 1, or where values lie beyond int16 the least slope that holds them.
    Slices are seen from the feet, anterior up, as radiologists expect them. Each volume is a study
    of a patient of its own.

    Raises:
        ValueError: a volume in mm⁻¹, values that are not finite, a folder that holds files.
    """
    pydicom = needed("pydicom")
    from pydicom.uid import CTImageStorage, generate_uid

    check_series(Path(folder), unit)
    values = np.asarray(data, dtype=np.float64)
    if not np.isfinite(values).all():
        raise ValueError(
            "DICOM holds finite HU, the volume has NaN or infinite values: save it as .nii.gz or "
            ".h5"
        )
    slope = float(
        _ds(max(1.0, values.max() / _HU_RANGE[1], values.min() / _HU_RANGE[0]) * (1 + _ROUNDED))
    )
    slope = 1.0 if slope < 1 + 2 * _ROUNDED else slope
    stored = np.rint(values / slope).astype("<i2")[:, ::-1, ::-1]
    study, series, frame = (generate_uid() for _ in range(3))
    patient, now = hashlib.sha256(study.encode()).hexdigest()[:12], datetime.datetime.now()
    date, time = now.strftime("%Y%m%d"), now.strftime("%H%M%S")
    # of the first pixel
    x, y, z = float(grid.axes[2][-1]), float(grid.axes[1][-1]), float(grid.axes[0][0])
    dz, dy, dx = grid.spacing
    images = []
    for k, image in enumerate(stored):
        d = pydicom.Dataset()
        d.SOPClassUID = CTImageStorage
        d.StudyInstanceUID, d.SeriesInstanceUID, d.FrameOfReferenceUID = study, series, frame
        d.SpecificCharacterSet = "ISO_IR 192"
        d.Modality, d.Manufacturer, d.SeriesDescription = (
            "CT",
            _MADE_BY,
            "simulated or reconstructed by torchpcct",
        )
        d.ManufacturerModelName, d.SoftwareVersions = _MADE_BY, VERSION
        d.ImageType = ["DERIVED", "PRIMARY", "AXIAL"]
        d.PatientID, d.PatientName = f"{_MADE_BY}-{patient}", f"{_MADE_BY}^{patient}"
        d.PatientBirthDate = d.PatientSex = ""
        # The scanner's x, y, z are right, anterior, superior. No part with a left and a right one
        # is known.
        d.PatientPosition, d.BodyPartExamined = "HFS", "WHOLEBODY"
        d.StudyID, d.AccessionNumber, d.ReferringPhysicianName = "1", "", ""
        d.StudyDate = d.SeriesDate = d.AcquisitionDate = d.ContentDate = date
        d.StudyTime = d.SeriesTime = d.AcquisitionTime = d.ContentTime = time
        d.SeriesNumber, d.InstanceNumber, d.PositionReferenceIndicator = 1, k + 1, ""
        d.ImageOrientationPatient = [1, 0, 0, 0, 1, 0]
        d.ImagePositionPatient = [_ds(-x), _ds(-y), _ds(z + k * dz)]
        d.PixelSpacing, d.SliceThickness = [_ds(dy), _ds(dx)], _ds(dz)
        d.RescaleSlope, d.RescaleIntercept, d.RescaleType = _ds(slope), "0", "HU"
        d.ImagesInAcquisition = len(stored)
        d.WindowCenter, d.WindowWidth, d.KVP, d.AcquisitionNumber = "40", "400", "", 1
        d.set_pixel_data(np.ascontiguousarray(image), "MONOCHROME2", 16)
        images.append(d)
    with atomic_write(os.path.realpath(folder)) as part:
        part.mkdir()
        for k, d in enumerate(images):
            d.save_as(part / f"{k + 1:04d}.dcm", enforce_file_format=True)


def _ds(value: float) -> str:
    """A DICOM decimal string: at most 16 characters."""
    return f"{value:.10g}"


# --- reading --------------------------------------------------------------------------------------


def read_dicom(
    path: str | os.PathLike[str], unit: str | None = None
) -> tuple[Floats32, VolumeGrid, str]:
    """Data ``(z, y, x)`` float32, grid and unit (HU) of a DICOM CT series in a folder, or of one
    image's file.

    Slices that lack within a series are found by their places, those at its ends only in series of
    ours, which know how many there are. One slice is as thick as it says, else 1 mm. Padding about
    the picture (``PixelPaddingValue``, or one value below −1024 HU in all corners) is read as air,
    −1000 HU, with a ``UserWarning``.

    Args:
        path: folder or file.
        unit: of its numbers, where the images do not say that they are in HU; None: such images are
            refused.

    Raises:
        FileNotFoundError: no such file or folder, or no files in it.
        ValueError: damaged files, several series, missing or doubled slices, oblique axes; images
            of another modality than CT, without rescale slope and intercept, or whose
            ``RescaleType`` is not HU.
        ImportError: pydicom is not installed.
    """
    root = Path(path)
    paths = dicom_files(root) if root.is_dir() else [root]
    slices: list[_Slice] = []
    replaced = 0
    for file in paths:
        with reading(file, "a DICOM image"):
            d = open_dicom(file)
            if root.is_dir() and "Rows" not in d and not _may_be_ct(d):
                _LOG.info("%s holds no image: left out", file)  # reports, contours and the like
                continue
            if not any(name in d for name in _PIXELS):
                raise ValueError("it ends before its pixels: copy it again")
            if not slices:
                check_expansion(
                    (len(paths), d.Rows, d.Columns),
                    "the series",
                    sum(p.stat().st_size for p in paths),
                )
            _check_placed(d)
            ours = str(d.get("Manufacturer", "")) == _MADE_BY
            pixels, padded = _hounsfield(d, unit, ours)
            replaced += padded
            slices.append(
                _Slice(
                    str(d.SeriesInstanceUID),
                    tuple(float(v) for v in d.ImageOrientationPatient),
                    np.array([float(v) for v in d.ImagePositionPatient]),
                    tuple(float(v) for v in d.PixelSpacing),
                    pixels,
                    float(d.get("SliceThickness") or 1.0),
                    int(d.get("ImagesInAcquisition") or 0) if ours and root.is_dir() else 0,
                )
            )
    if not slices:
        raise FileNotFoundError(f"no DICOM images in {path}")
    with reading(path, "a DICOM series"):
        data, grid = _joined(slices)
    if replaced:
        warnings.warn(
            f"{path}: {replaced} of {data.size} pixels are padding around the image, and are read "
            f"as air, {_AIR:.0f} HU",
            UserWarning,
            stacklevel=3,
        )
    return data, grid, unit or "HU"


_PLACE = {
    "SeriesInstanceUID": 0,
    "ImageOrientationPatient": 6,
    "ImagePositionPatient": 3,
    "PixelSpacing": 2,
}
"""What says where a slice lies, and of how many numbers."""


def _check_placed(d: pydicom.Dataset) -> None:
    """Raise ``ValueError`` unless an image says where it lies and how large its pixels are."""
    for name, count in _PLACE.items():
        value = d.get(name)
        if value in (None, ""):
            raise ValueError(
                f"it has no {name}, so its place is unknown: export it again as CT images, or "
                "convert it to NIfTI with its place"
            )
        if count and (isinstance(value, str) or np.size(value) != count):
            raise ValueError(f"its {name} has {np.size(value)} numbers, expected {count}")


def _may_be_ct(d: pydicom.Dataset) -> bool:
    """Whether a data set names the class of CT images, or none: the beginning of one that was cut
    off."""
    named = [
        str(d.get("SOPClassUID") or ""),
        str(d.file_meta.get("MediaStorageSOPClassUID") or ""),
    ]
    begins = [name for name in named if name] or [""]
    return any(name.startswith(_CT_CLASS) or _CT_CLASS.startswith(name) for name in begins)


def _hounsfield(d: pydicom.Dataset, unit: str | None, ours: bool) -> tuple[Floats32, int]:
    """Float32 pixels of an image in HU, and how many of them are padding.

    Raises:
        ValueError: numbers whose unit is not given as HU.
    """
    if unit is None:
        _check_ct(d)
    held = {name: d.get(name) for name in ("RescaleSlope", "RescaleIntercept")}
    missing = [name for name, value in held.items() if value in (None, "")]
    if missing and unit is None:
        raise ValueError(f"it has no {' and no '.join(missing)}: its values are not HU{_KNOWN}")
    slope = 1.0 if "RescaleSlope" in missing else float(held["RescaleSlope"])
    intercept = 0.0 if "RescaleIntercept" in missing else float(held["RescaleIntercept"])
    if not (np.isfinite([slope, intercept]).all() and slope != 0):
        raise ValueError(f"its RescaleSlope is {slope:g}, its RescaleIntercept {intercept:g}")
    kind = str(d.get("PhotometricInterpretation") or "")
    if not kind.startswith("MONOCHROME"):
        raise ValueError(f"its pixels are {kind or 'of an unknown kind'}, no grey values")
    if "BitsStored" in d and int(d.get("HighBit", d.BitsStored - 1)) != d.BitsStored - 1:
        raise ValueError(
            f"its HighBit is {d.HighBit} of {d.BitsStored} BitsStored, which DICOM has given up: "
            f"write its values into the lowest bits, HighBit {d.BitsStored - 1}"
        )
    stored = d.pixel_array
    pixels = stored.astype(np.float32) * np.float32(slope) + np.float32(intercept)
    padding = None if unit not in (None, "HU") else _padding(d, stored, pixels, ours)
    if padding is None or not padding.any():
        return pixels, 0
    pixels[padding] = _AIR
    return pixels, int(padding.sum())


_KNOWN = "; if you know that they are, Volume.load(..., unit='HU') reads them"
"""Remedy that refusals of series without HU end with."""


def _check_ct(d: pydicom.Dataset) -> None:
    """Raise ``ValueError`` unless an image says that its numbers are HU; DICOM's CT need not say
    the type."""
    modality, kind = str(d.get("Modality") or "").strip(), str(d.get("RescaleType") or "").strip()
    if kind not in ("", "HU"):
        unspecified = " (unspecified)" if kind == "US" else ""
        raise ValueError(f"its RescaleType is {kind}{unspecified}, not HU{_KNOWN}")
    if modality != "CT" and not (
        modality == "" and str(d.get("SOPClassUID", "")).startswith(_CT_CLASS)
    ):
        units = f" in {d.Units}" if d.get("Units") else ""
        raise ValueError(
            f"its modality is {modality or 'unknown'}{units}: only CT images are in HU"
        )


def _padding(d: pydicom.Dataset, stored: Ints, pixels: Floats32, ours: bool) -> Bools | None:
    """Mask of what fills the square about the picture; None: the image has none.

    A marked value that tissue can have, too, counts where it reaches the border of the image.
    """
    if d.get("PixelPaddingValue") is not None:
        bits = 8 * stored.dtype.itemsize
        low = high = int(d.PixelPaddingValue)
        if d.get("PixelPaddingRangeLimit") is not None:
            high = int(d.PixelPaddingRangeLimit)
        if stored.dtype.kind == "i":  # written as unsigned by some
            low, high = ((v + 2 ** (bits - 1)) % 2**bits - 2 ** (bits - 1) for v in (low, high))
        marked = (stored >= min(low, high)) & (stored <= max(low, high))
    else:
        corners = stored[[0, 0, -1, -1], [0, -1, 0, -1]]
        if ours or np.ptp(corners) or pixels[0, 0] >= _LOWEST:
            return None
        marked = stored == corners[0]
    possible = marked & (pixels >= _LOWEST)
    if possible.any():
        from scipy.ndimage import label

        parts, _ = label(possible)
        at_border = np.unique(np.concatenate([parts[0], parts[-1], parts[:, 0], parts[:, -1]]))
        marked &= ~possible | np.isin(parts, at_border[at_border > 0])
    return marked


class _Slice(NamedTuple):
    series: str
    orientation: tuple[float, ...]
    position: NDArray[np.float64]
    pixel: tuple[float, ...]
    image: Floats32
    thickness: float
    of: int
    """Slices of its series, 0: unknown."""


def _joined(slices: list[_Slice]) -> tuple[Floats32, VolumeGrid]:
    series, orientation, _, pixel, image, thickness, count = slices[0]
    for other in slices[1:]:
        if other.series != series:
            raise ValueError("it holds several series: keep each in a folder of its own")
        if (
            not np.allclose(other.orientation, orientation, rtol=0.0, atol=STRAIGHT)
            or not np.allclose(other.pixel, pixel, rtol=STRAIGHT, atol=0.0)
            or other.image.shape != image.shape
        ):
            raise ValueError(
                "its slices differ in orientation, spacing or size: keep those that belong "
                "together in a folder of their own"
            )
    row, column = np.array(orientation[:3]), np.array(orientation[3:])
    if abs(abs(row[0]) - 1) > STRAIGHT or abs(abs(column[1]) - 1) > STRAIGHT:
        raise ValueError("its slices are not axial: resample it to straight axes first")
    slices.sort(key=lambda s: float(s.position[2]))
    z = np.array([float(s.position[2]) for s in slices])
    gaps = np.diff(z)
    # Places are rounded, some to two decimals: they may lie off even steps, which rounding does
    # not make longer.
    off = np.abs(z - np.linspace(z[0], z[-1], z.size)).max()
    if gaps.size and not (gaps.min() > 0 and off <= _OFF_PLACE * float(np.median(gaps))):
        at = int(np.argmax(np.abs(gaps - np.median(gaps))))
        raise ValueError(
            f"slices are missing or repeated between z = {z[at]:g} and {z[at + 1]:g} mm: copy the "
            "others, too, and keep each scan in a folder of its own"
        )
    if count and count != len(slices):
        raise ValueError(
            f"it has {len(slices)} of the {count} slices of its series: copy the others, too"
        )
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
    dz = float(gaps.mean()) if gaps.size else thickness
    return np.ascontiguousarray(data), grid_from(data.shape, (dx, dy, dz), (x, y, z[0]))
