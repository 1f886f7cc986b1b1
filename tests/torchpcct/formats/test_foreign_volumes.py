"""Volumes of other software in forms that are rarer than those of ``test_volume_files.py``: read
as their format means them, or refused by what is wrong."""

import os
import re
import zlib

import nibabel
import numpy as np
import pydicom
import pytest
import torch

from torchpcct import Volume, VolumeGrid

GRID = VolumeGrid((4, 6, 5), (1.5, 0.5, 0.25), (3.0, -7.0, 11.0))
DATA = torch.round(torch.linspace(-1000, 900, 120).reshape(GRID.shape))


# --- NIfTI ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("turned", [(1, 1, 1), (-1, -1, 1), (1, -1, -1)])
def test_sform_and_qform_that_disagree_are_said_of_axes_in_any_direction(tmp_path, turned):
    """NiBabel takes the qform away where it turns axes, before it could be compared."""
    sform = np.diag([*(0.5 * np.array(turned)), 1.0])
    qform = sform.copy()
    qform[0, 3] = 9.0
    image = nibabel.Nifti1Image(np.ones((3, 4, 5), np.float32), sform)
    image.set_sform(sform, 1)
    image.set_qform(qform, 1)
    nibabel.save(image, tmp_path / "v.nii")
    with pytest.warns(UserWarning, match="its sform and qform differ by up to 9 of its units"):
        Volume.load(tmp_path / "v.nii")


def test_a_place_that_neither_form_gives_is_said(tmp_path):
    image = nibabel.Nifti1Image(np.ones((3, 4, 5), np.float32), None)
    image.header.set_zooms((0.5, 0.5, 0.6))
    nibabel.save(image, tmp_path / "v.nii")
    with pytest.warns(UserWarning, match=r"both unset \(code 0\), so it does not say which side"):
        grid = Volume.load(tmp_path / "v.nii").grid
    np.testing.assert_allclose(grid.spacing, (0.6, 0.5, 0.5), rtol=1e-6)


def test_voxels_that_begin_within_the_header(tmp_path):
    nibabel.save(nibabel.Nifti1Image(np.ones((9, 9, 9), np.float32), np.eye(4)), tmp_path / "v.nii")
    content = bytearray((tmp_path / "v.nii").read_bytes())
    content[108:112] = np.float32(0).tobytes()
    (tmp_path / "v.nii").write_bytes(content)
    with pytest.raises(ValueError, match="its voxels begin at byte 0, within its header of 348"):
        Volume.load(tmp_path / "v.nii")


# --- MetaImage ------------------------------------------------------------------------------------


def meta(path, content=None, file="LOCAL", **fields):
    """A MetaImage with other fields; None: without."""
    x, y, z = (float(axis[0]) for axis in GRID.axes[::-1])
    header = {
        "ObjectType": "Image",
        "NDims": "3",
        "BinaryData": "True",
        "BinaryDataByteOrderMSB": "False",
        "CompressedData": "False",
        "TransformMatrix": "-1 0 0 0 -1 0 0 0 1",
        "Offset": f"{-x} {-y} {z}",
        "ElementSpacing": "0.25 0.5 1.5",
        "DimSize": "5 6 4",
        "ElementType": "MET_FLOAT",
        **fields,
        "ElementDataFile": file,
    }
    text = "".join(f"{name} = {value}\n" for name, value in header.items() if value is not None)
    path.write_bytes(text.encode() + (DATA.numpy().tobytes() if content is None else content))
    return path


@pytest.mark.parametrize(
    ("unit", "mm"), [(None, 1), ("mm", 1), ("?", 1), ("um", 1e-3), ("cm", 10), ("m", 1000)]
)
def test_lengths_of_a_meta_image_are_in_its_unit(tmp_path, unit, mm):
    volume = Volume.load(meta(tmp_path / "v.mha", DistanceUnits=unit))
    assert torch.equal(volume.data, DATA)
    np.testing.assert_allclose(volume.grid.spacing, np.array(GRID.spacing) * mm)
    np.testing.assert_allclose(volume.grid.center, np.array(GRID.center) * mm)


def test_a_meta_image_of_one_volume_with_more_axes(tmp_path):
    path = meta(
        tmp_path / "v.mha",
        NDims="4",
        DimSize="5 6 4 1",
        ElementSpacing="0.25 0.5 1.5 1",
        Offset="0 0 0 0",
        TransformMatrix="-1 0 0 0 0 -1 0 0 0 0 1 0 0 0 0 1",
    )
    volume = Volume.load(path)
    assert torch.equal(volume.data, DATA)
    assert volume.grid.spacing == GRID.spacing


PACKED = zlib.compress(DATA.numpy().tobytes())
HALF = zlib.compress(DATA[:2].numpy().tobytes())


@pytest.mark.parametrize(
    ("content", "fields", "said"),
    [
        (PACKED, {"CompressedData": "True"}, "it does not say its CompressedDataSize"),
        (
            HALF,
            {"CompressedData": "True", "CompressedDataSize": str(len(HALF))},
            "its compressed voxels unpack to 240 bytes, not to the 480 of its size",
        ),
        (
            PACKED[:-9],
            {"CompressedData": "true", "CompressedDataSize": str(len(PACKED))},
            "its compressed voxels end too early",
        ),
        (bytes(200), {}, r"its 200 bytes of voxels are not those of \(5, 6, 4\) MET_FLOAT"),
        (None, {"DistanceUnits": "furlong"}, "its lengths are in the unknown unit 'furlong'"),
        (None, {"HeaderSize": "100"}, "its HeaderSize is 100"),
        (None, {"ElementSpacing": "0 0.5 1.5"}, "its ElementSpacing is 0 0.5 1.5"),
        (None, {"ElementToIntensityFunctionSlope": "2"}, "its values are to be scaled"),
        (None, {"NDims": "2", "DimSize": "5 24"}, r"it has \(5, 24\) voxels of 1 components"),
    ],
)
def test_meta_images_that_would_be_read_wrongly(tmp_path, content, fields, said):
    """ITK reads zeros or a part where voxels cannot be unpacked, and header where it is told to."""
    path = meta(tmp_path / "v.mha", content, **fields)
    with pytest.raises(ValueError, match=f"v.mha cannot be read as a MetaImage: {said}"):
        Volume.load(path)


@pytest.mark.parametrize("file", ["v.raw", "/dev/zero", "pipe", "LIST", ""])
def test_a_meta_image_keeps_its_voxels(tmp_path, file):
    """Of a pipe the reader would wait for ever."""
    (tmp_path / "v.raw").write_bytes(DATA.numpy().tobytes())
    os.mkfifo(tmp_path / "pipe")
    path = meta(tmp_path / "v.mha", b"", file)
    with pytest.raises(
        ValueError, match=f"keeps its voxels in another file, {re.escape(repr(file))}"
    ):
        Volume.load(path)


# --- DICOM ----------------------------------------------------------------------------------------


@pytest.fixture
def series(tmp_path):
    """Function that writes a series and changes slice k of it by ``change(d, k)``."""

    def make(change):
        Volume(DATA, GRID).save(tmp_path / "series")
        for k, path in enumerate(sorted((tmp_path / "series").iterdir())):
            d = pydicom.dcmread(path)
            d.Manufacturer = "X"
            change(d, k)
            d.save_as(path)
        return tmp_path / "series"

    return make


def _at(*z):
    """Slices at other heights."""

    def change(d, k):
        d.ImagePositionPatient = [*d.ImagePositionPatient[:2], z[k]]

    return change


def _tilted(d, k):
    d.ImageOrientationPatient = [1, 1e-7 * k, 0, 0, 1, 0]


def _spaced(d, k):
    d.PixelSpacing = ["0.5", "0.25" if k else "0.2500001"]


@pytest.mark.parametrize(
    ("change", "spacing"),
    [
        (_at(0, 0.62, 1.25, 1.88), 1.88 / 3),  # 0.625 mm in two decimals
        (_at(0, 1.5, 3.0, 4.5), 1.5),
        (_tilted, 1.5),
        (_spaced, 1.5),
    ],
)
def test_places_of_slices_are_rounded(series, change, spacing):
    volume = Volume.load(series(change))
    assert torch.equal(volume.data, DATA)
    np.testing.assert_allclose(volume.grid.spacing, (spacing, 0.5, 0.25), rtol=1e-5)


@pytest.mark.parametrize("z", [(0, 1, 2, 3.5), (0, 1, 2, 4), (0, 1, 2.2, 3), (0, 1, 1, 2)])
def test_slices_at_uneven_places_are_refused(series, z):
    with pytest.raises(
        ValueError, match=r"slices are missing or repeated between z = .* keep each"
    ):
        Volume.load(series(_at(*z)))


def _without(name):
    return lambda d, k: delattr(d, name)


def _to_the_left(d, k):
    d.PixelData = (d.pixel_array.astype(int) << 4).astype(np.int16).tobytes()
    d.BitsStored, d.HighBit = 12, 15


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (_without("ImagePositionPatient"), "it has no ImagePositionPatient, so its place"),
        (_without("ImageOrientationPatient"), "it has no ImageOrientationPatient"),
        (_without("PixelSpacing"), "it has no PixelSpacing"),
        (_without("SeriesInstanceUID"), "it has no SeriesInstanceUID"),
        (
            lambda d, k: setattr(d, "ImagePositionPatient", None),
            "it has no ImagePositionPatient",
        ),
        (
            lambda d, k: setattr(d, "ImagePositionPatient", [1, 2]),
            "its ImagePositionPatient has 2 numbers, expected 3",
        ),
        (lambda d, k: setattr(d, "PixelSpacing", "0.5"), "its PixelSpacing has 1 numbers"),
        (
            lambda d, k: setattr(d, "PhotometricInterpretation", "PALETTE COLOR"),
            "its pixels are PALETTE COLOR, no grey values",
        ),
        (_to_the_left, "its HighBit is 15 of 12 BitsStored"),
        (
            lambda d, k: setattr(d, "NumberOfFrames", 4),
            r"it holds 4 frames of 1 colours, .* convert it to NIfTI \(dcm2niix\)",
        ),
    ],
)
def test_slices_without_a_place_and_pixels_that_are_stored_otherwise(series, change, said):
    with pytest.raises(ValueError, match=rf"0001\.dcm cannot be read as a DICOM image: {said}"):
        Volume.load(series(change))
