"""Files of other scanners, written by h5py and pydicom alone."""

import itertools
import math
import struct
from pathlib import Path

import h5py
import numpy as np


def data_exchange(path: Path, data, white, angles, dark=None, pixel_um=None, **storage) -> Path:
    """A scan as beamlines write it: uint16 frames ``(views, rows, columns)``, theta in degrees,
    pixel size in µm."""
    with h5py.File(path, "w") as file:
        file.create_dataset("exchange/data", data=np.rint(data).astype(np.uint16), **storage)
        file["exchange/data_white"] = np.asarray(white).astype(np.uint16)
        if dark is not None:
            file["exchange/data_dark"] = np.asarray(dark).astype(np.uint16)
        file["exchange/theta"] = np.rad2deg(angles)
        file["exchange/theta"].attrs["units"] = "deg"
        if pixel_um is not None:
            file["measurement/instrument/detector/pixel_size"] = pixel_um
            file["measurement/instrument/detector/pixel_size"].attrs["units"] = "um"
    return path


def ct_pd(
    folder: Path,
    lines,
    geometry,
    climb: float = 0.0,
    spot: str = "FFSNONE",
    shifts=None,
    photons=None,
) -> Path:
    """A folder of DICOM-CT-PD: focal spot at (−ρ sin φ, ρ cos φ), element i at φ + (i − i₀)Δ / d;
    water 0.02 mm⁻¹.

    ``shifts``: deflections (angle in rad, height and radius in mm) that the views have in turn.
    ``photons``: of unattenuated readings, ``(views, columns)``.
    """
    import pydicom
    from pydicom.dataset import FileMetaDataset
    from pydicom.uid import ExplicitVRLittleEndian, generate_uid

    folder.mkdir()
    g, n, rows = geometry, geometry.columns, geometry.rows
    centre = ((n + 1) / 2 + g.offset[1] / g.pitch[1], (rows + 1) / 2 - g.offset[0] / g.pitch[0])
    for k, view in enumerate(lines):
        d = pydicom.Dataset()
        d.file_meta = FileMetaDataset()
        d.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
        d.file_meta.MediaStorageSOPClassUID = d.SOPClassUID = "1.2.840.10008.5.1.4.1.1.66"
        d.file_meta.MediaStorageSOPInstanceUID = d.SOPInstanceUID = generate_uid()
        d.InstanceNumber, d.Rows, d.Columns = k + 1, n, rows  # channels are image rows
        d.SamplesPerPixel, d.PhotometricInterpretation, d.PixelRepresentation = 1, "MONOCHROME2", 0
        d.BitsAllocated, d.BitsStored, d.HighBit = 16, 16, 15
        d.RescaleSlope, d.RescaleIntercept = "0.0001", "-0.1"
        for group in (0x7029, 0x7031, 0x7033, 0x7041):
            d.add_new((group, 0x10), "LO", "DICOM-CT-PD")
        for tag, vr, value in (
            (0x70291002, "FL", g.pitch[1]),
            (0x70291006, "FL", g.pitch[0]),
            (0x7029100B, "CS", "CYLINDRICAL"),
            (0x70291010, "US", rows),
            (0x70291011, "US", n),
            (0x70311001, "FL", g.angles[k] - math.pi / 2),
            (0x70311002, "FL", climb * k),
            (0x70311003, "FL", g.sod),
            (0x70311031, "FL", g.sdd),
            (0x70311033, "FL", list(centre)),
            (0x7033100E, "CS", spot),
            (0x70411001, "DS", "0.02"),
        ):
            d.add_new(tag, vr, value)
        if shifts is not None:
            for tag, value in zip(
                (0x7033100B, 0x7033100C, 0x7033100D), shifts[k % len(shifts)], strict=True
            ):
                d.add_new(tag, "FL", value)
        if photons is not None:
            d.add_new(0x70331065, "FL", photons[k][::-1].tolist())
        d.PixelData = np.rint((view[:, ::-1].T + 0.1) / 0.0001).astype("<u2").tobytes()
        # names in the other order
        d.save_as(folder / f"{len(lines) - k:04d}.dcm", enforce_file_format=True)
    return folder


def nexus(
    path: Path, data, white, angles, dark=None, pixel_um=None, unit="deg", times=None
) -> Path:
    """An NXtomo file as beamlines write it: darks, flats, projections and flats again in one data
    set, keys, angles of all frames, and NXdata with soft links."""
    darks = [] if dark is None else list(dark)
    half = len(white) // 2
    frames = [*darks, *white[:half], *data, *white[half:]]
    key = [2] * len(darks) + [1] * half + [0] * len(data) + [1] * (len(white) - half)
    turned = np.zeros(len(key))
    turned[np.array(key) == 0] = np.rad2deg(angles) if unit == "deg" else angles
    with h5py.File(path, "w") as file:
        entry = file.create_group("entry")
        entry.attrs["NX_class"] = "NXentry"
        entry["definition"] = "NXtomo"
        detector = entry.create_group("instrument/detector")
        detector.attrs["NX_class"] = "NXdetector"
        detector["data"] = np.rint(frames).astype(np.uint16)
        detector["image_key"] = key
        if pixel_um is not None:
            detector["x_pixel_size"] = pixel_um * 1e-6
            detector["x_pixel_size"].attrs["units"] = "m"
        if times is not None:
            detector["count_time"] = np.where(np.array(key) == 1, times[1], times[0])
        entry["sample/rotation_angle"] = turned
        entry["sample/rotation_angle"].attrs["units"] = unit
        entry["data/data"] = h5py.SoftLink("/entry/instrument/detector/data")
        entry["data/image_key"] = h5py.SoftLink("/entry/instrument/detector/image_key")
    return path


def xtekct(folder: Path, readings, geometry, white: float, start: float = 30.0, **more) -> Path:
    """A Nikon scan: uint16 images from behind the detector, top row first, of views that count as
    the object turns.

    The geometry's first angle must be ``start`` + 90°.
    """
    import tifffile

    folder.mkdir()
    for k, view in enumerate(readings):
        tifffile.imwrite(
            folder / f"part_{k + 1:04d}.tif", np.rint(view[::-1, ::-1]).astype(np.uint16)
        )
    g = geometry
    values = {
        "Name": "part",
        "InputSeparator": "_",
        "InputFolderName": "",
        "SrcToObject": g.sod,
        "SrcToDetector": g.sdd,
        "DetectorPixelsX": g.columns,
        "DetectorPixelsY": g.rows,
        "DetectorPixelSizeX": g.pitch[1],
        "DetectorPixelSizeY": g.pitch[0],
        "CentreOfRotationTop": g.offset[1],
        "CentreOfRotationBottom": g.offset[1],
        "InitialAngle": start,
        "AngularStep": 360.0 / g.views,
        "Projections": g.views,
        "WhiteLevel": white,
        **more,
    }
    text = "[XTekCT]\r\n" + "".join(f"{name}={value}\r\n" for name, value in values.items())
    (folder / "part.xtekct").write_bytes(
        b"\xef\xbb\xbf" + f"{text}[Xrays]\r\nXraykV=120\r\n".encode()
    )
    return folder / "part.xtekct"


def txrm(path: Path, readings, geometry, air, shifts=None, **more) -> Path:
    """A Zeiss scan of a cone beam that turns clockwise from −90°: uint16 images, a float
    reference, mm and µm; ``more`` of ``ImageInfo``."""
    g = geometry
    degrees = -np.rad2deg(g.angles) - 90.0
    voxel = 1e3 * g.pitch[1] * g.sod / g.sdd
    streams = {
        "ImageInfo/ImageWidth": np.uint32(g.columns),
        "ImageInfo/ImageHeight": np.uint32(g.rows),
        "ImageInfo/NoOfImages": np.uint32(g.views),
        "ImageInfo/DataType": np.uint32(5),
        "ImageInfo/Angles": degrees.astype("<f4"),
        "ImageInfo/PixelSize": np.float32(voxel),
        "ImageInfo/StoRADistance": np.full(g.views, -g.sod, "<f4"),
        "ImageInfo/DtoRADistance": np.full(g.views, g.sdd - g.sod, "<f4"),
        "ImageInfo/XrayGeometry": np.int32(1),
        **{f"ImageInfo/{name}": value for name, value in more.items()},
        "ReferenceData/DataType": np.uint32(10),
        "ReferenceData/Image": np.asarray(air, "<f4"),
        **{
            f"ImageData{k // 100 + 1}/Image{k + 1}": np.rint(v).astype("<u2")
            for k, v in enumerate(readings)
        },
    }
    for axis, values in (shifts or {}).items():
        streams[f"alignment/{axis}-shifts"] = np.asarray(values, "<f4")
    compound_file(path, {name: np.asarray(values).tobytes() for name, values in streams.items()})
    return path


def compound_file(path: Path, streams: dict[str, bytes]) -> None:
    """A compound file (OLE, [MS-CFB] version 3) of streams in storages: what ``olefile`` reads
    and does not write."""
    end, free, no = 0xFFFFFFFE, 0xFFFFFFFF, 0xFFFFFFFF
    entries, children = [["Root Entry", 5, no, no, no, end, 0]], {}
    for name in streams:
        storage, _, _ = name.rpartition("/")
        children.setdefault(storage, []).append(name)
    mini, minifat, large = b"", [], []

    def entry(name: str, kind: int) -> int:
        entries.append([name, kind, no, no, no, 0, 0])
        return len(entries) - 1

    storages = []
    for storage, names in children.items():
        storages.append(entry(storage, 1))
        before = None
        for name in names:
            at, content = entry(name.rpartition("/")[2], 2), streams[name]
            if before is None:
                entries[storages[-1]][4] = at
            else:
                entries[before][3] = at  # a tree of right siblings alone
            before = at
            entries[at][6] = len(content)
            if len(content) < 4096:
                first, n = len(minifat), -(-len(content) // 64)
                entries[at][5] = first
                minifat += [*range(first + 1, first + n), end]
                mini += content.ljust(64 * n, b"\0")
            else:
                large.append((at, content))
    for left, right in itertools.pairwise(storages):
        entries[left][3] = right
    entries[0][4] = storages[0]
    fat, sectors = [], []

    def put(content: bytes) -> int:
        n, first = -(-len(content) // 512), len(sectors)
        padded = content.ljust(512 * n, b"\0")
        sectors.extend(padded[512 * k : 512 * (k + 1)] for k in range(n))
        fat.extend([*range(first + 1, first + n), end])
        return first

    for at, content in large:
        entries[at][5] = put(content)
    entries[0][5:] = [put(mini), len(mini)]
    packed = np.array(minifat + [free] * (-len(minifat) % 128), "<u4").tobytes()
    minifat_at, minifat_n = put(packed), len(packed) // 512
    directory = b"".join(
        name.encode("utf-16-le").ljust(64, b"\0")
        + struct.pack("<HBBIII", 2 * len(name) + 2, kind, 1, left, right, child)
        + bytes(16 + 4 + 16)
        + struct.pack("<IQ", start, size)
        for name, kind, left, right, child, start, size in entries
    )
    directory_at = put(directory.ljust(-(-len(directory) // 512) * 512, b"\0"))
    n = next(n for n in range(1, 109) if 128 * n >= len(fat) + n)
    fat_at = len(sectors)
    fat += [0xFFFFFFFD] * n
    fat += [free] * (128 * n - len(fat))
    header = (
        bytes.fromhex("d0cf11e0a1b11ae1")
        + bytes(16)
        + struct.pack("<HHHHH", 0x3E, 3, 0xFFFE, 9, 6)
        + bytes(6)
    )
    header += struct.pack("<IIIIIIIII", 0, n, directory_at, 0, 4096, minifat_at, minifat_n, end, 0)
    header += np.array([*range(fat_at, fat_at + n), *[free] * (109 - n)], "<u4").tobytes()
    path.write_bytes(header + b"".join(sectors) + np.array(fat, "<u4").tobytes())
