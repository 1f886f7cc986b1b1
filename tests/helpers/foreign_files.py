"""Files of other scanners, written by h5py and pydicom alone."""

import math
from pathlib import Path

import h5py
import numpy as np


def data_exchange(path: Path, data, white, angles, dark=None, pixel_um=None, **storage) -> Path:
    """A scan as beamlines write it: uint16 frames ``(views, rows, columns)``, theta in degrees, pixel size in µm."""
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


def ct_pd(folder: Path, lines, geometry, climb: float = 0.0, spot: str = "FFSNONE") -> Path:
    """A folder of DICOM-CT-PD: focal spot at (−ρ sin φ, ρ cos φ), element i at φ + (i − i₀)Δ / d; water 0.02 mm⁻¹."""
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
            (0x70291002, "FL", g.pitch[1]), (0x70291006, "FL", g.pitch[0]), (0x7029100B, "CS", "CYLINDRICAL"),
            (0x70291010, "US", rows), (0x70291011, "US", n), (0x70311001, "FL", g.angles[k] - math.pi / 2),
            (0x70311002, "FL", climb * k), (0x70311003, "FL", g.sod), (0x70311031, "FL", g.sdd),
            (0x70311033, "FL", list(centre)), (0x7033100E, "CS", spot), (0x70411001, "DS", "0.02"),
        ):  # fmt: skip
            d.add_new(tag, vr, value)
        d.PixelData = np.rint((view[:, ::-1].T + 0.1) / 0.0001).astype("<u2").tobytes()
        d.save_as(folder / f"{len(lines) - k:04d}.dcm", enforce_file_format=True)  # names in the other order
    return folder
