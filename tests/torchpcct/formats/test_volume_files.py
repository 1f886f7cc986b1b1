"""Volumes in and out: what SimpleITK, nibabel and pydicom see of ours, and we of theirs."""

import shutil

import nibabel
import numpy as np
import pydicom
import pytest
import SimpleITK
import torch
from pydicom.data import get_testdata_file

from torchpcct import Volume, VolumeGrid

GRID = VolumeGrid((4, 6, 5), (1.5, 0.5, 0.25), (3.0, -7.0, 11.0))
DATA = torch.round(torch.linspace(-1000, 900, 120).reshape(GRID.shape))
GRID_OF_SLICES = VolumeGrid((4, 40, 40), (1.5, 0.5, 0.25))
NAMES = ("v.nii.gz", "v.nii", "v.mha", "v.h5", "series")


def sitk_read(path):
    if path.is_dir():
        reader = SimpleITK.ImageSeriesReader()
        reader.SetFileNames(reader.GetGDCMSeriesFileNames(str(path)))
        return reader.Execute()
    return SimpleITK.ReadImage(str(path))


@pytest.mark.parametrize("name", NAMES)
def test_round_trip(tmp_path, name):
    unit = "HU" if name == "series" else "mm^-1"
    Volume(DATA, GRID, {"method": "fbp", "kernel": "soft"}, unit).save(tmp_path / name)
    back = Volume.load(tmp_path / name)
    if name == "v.h5":
        assert (back.grid, back.report) == (GRID, {"method": "fbp", "kernel": "soft"})
    assert torch.equal(back.data, DATA)
    assert (back.grid.shape, back.unit) == (GRID.shape, unit)
    np.testing.assert_allclose([*back.grid.spacing, *back.grid.center], [*GRID.spacing, *GRID.center], atol=1e-5)


def test_units_of_other_files(tmp_path):
    """What other software wrote is in HU; a unit that is named and not known is no HU."""
    image = SimpleITK.GetImageFromArray(DATA.numpy())
    SimpleITK.WriteImage(image, str(tmp_path / "foreign.mha"))
    SimpleITK.WriteImage(image, str(tmp_path / "foreign.nii"))
    assert [Volume.load(tmp_path / f"foreign.{end}").unit for end in ("mha", "nii")] == ["HU", "HU"]
    image.SetMetaData("Unit", "Bq/ml")
    SimpleITK.WriteImage(image, str(tmp_path / "pet.mha"))
    with pytest.raises(ValueError, match="its field Unit gives the unit 'Bq/ml', expected HU or mm"):
        Volume.load(tmp_path / "pet.mha")


@pytest.mark.parametrize("name", [n for n in NAMES if n != "v.h5"])
def test_other_software_sees_the_same_place(tmp_path, name):
    """The point (x, y, z) of the scanner is (−x, −y, z) in ITK, in every format, and holds the same value."""
    Volume(DATA, GRID).save(tmp_path / name)
    image = sitk_read(tmp_path / name)
    for k, j, i in ((0, 0, 0), (3, 1, 4), (2, 5, 0)):
        z, y, x = (axis[n] for axis, n in zip(GRID.axes, (k, j, i), strict=True))
        index = image.TransformPhysicalPointToIndex((-x, -y, z))
        assert float(image[index]) == float(DATA[k, j, i])


def test_nifti_has_qform_and_sform(tmp_path):
    Volume(DATA, GRID).save(tmp_path / "v.nii.gz")
    header = nibabel.load(tmp_path / "v.nii.gz").header
    assert (int(header["qform_code"]), int(header["sform_code"])) == (1, 1)
    np.testing.assert_allclose(header.get_qform(), header.get_sform(), atol=1e-6)


@pytest.mark.parametrize("name", ["v.nii.gz", "v.mha"])
def test_a_compressed_file_with_a_wrong_bit_or_a_lost_end_is_refused(tmp_path, name):
    """Each has a checksum at the end of its voxels; 103 of 200 such .nii.gz were read, by half a million HU off."""
    rng, path = np.random.default_rng(0), tmp_path / name
    data = torch.from_numpy(rng.integers(-900, 900, GRID_OF_SLICES.shape).astype(np.float32))
    Volume(data, GRID_OF_SLICES).save(path)
    content, refused = path.read_bytes(), 0
    first = 400 if name == "v.mha" else 10  # of the voxels: what stands before has no checksum
    for k in range(40):
        broken = bytearray(content[: rng.integers(first, len(content))] if k % 4 == 3 else content)
        if k % 4 != 3:
            broken[rng.integers(first, len(content))] ^= 1 << int(rng.integers(8))
        path.write_bytes(broken)
        try:
            assert torch.equal(Volume.load(path).data, data)  # a bit that fills the last byte
        except ValueError as error:
            refused += "cannot be read as" in str(error)
    assert refused >= 38


@pytest.mark.parametrize("name", [n for n in NAMES if n != "v.h5"])
def test_a_2d_image_is_a_volume_of_one_slice_in_every_format(tmp_path, name):
    image = Volume(DATA[0], VolumeGrid((6, 5), (0.5, 0.25), (-7.0, 11.0)))
    image.save(tmp_path / name)
    back = Volume.load(tmp_path / name)
    assert torch.equal(back.data, DATA[:1])
    np.testing.assert_allclose([*back.grid.spacing, *back.grid.center], [0.25, 0.5, 0.25, 0.0, -7.0, 11.0], atol=1e-5)


def test_a_single_slice_of_a_series_keeps_its_thickness_and_is_read_as_a_file(tmp_path):
    Volume(DATA, GRID).save(tmp_path / "s")
    one = Volume.load(tmp_path / "s" / "0002.dcm")
    assert torch.equal(one.data, DATA[1:2])
    np.testing.assert_allclose(one.grid.spacing, GRID.spacing)
    np.testing.assert_allclose(one.grid.center, [GRID.axes[0][1], *GRID.center[1:]], atol=1e-6)
    with pytest.raises(ValueError, match=r"'0002\.dcm' would be one slice: a DICOM series is a folder"):
        one.save(tmp_path / "0002.dcm")


def test_dicom_holds_values_beyond_int16(tmp_path):
    """Metal by a sharp kernel: in coarser steps, not lost after the reconstruction."""
    data = DATA.clone()
    data[0, 0, 0], data[1, 1, 1] = 210745.0, -40000.0
    Volume(data, GRID).save(tmp_path / "s")
    back = Volume.load(tmp_path / "s").data
    assert float((back - data).abs().max()) <= 0.5 * 210745 / 32767 * 1.001
    with pytest.raises(ValueError, match="NaN or infinite"):
        Volume(DATA / 0.0, GRID).save(tmp_path / "t")


def test_dicom_series_appear_whole_or_not_at_all(tmp_path, monkeypatch):
    """Killed at 22 of 60 slices, a series read as a volume of 22, somewhere else."""
    save, left = pydicom.Dataset.save_as, iter(range(2))

    def interrupted(*given, **more):
        save(*given, **more)
        if next(left, None) is None:
            assert not (tmp_path / "s").exists()
            raise KeyboardInterrupt

    monkeypatch.setattr(pydicom.Dataset, "save_as", interrupted)
    with pytest.raises(KeyboardInterrupt):
        Volume(DATA, GRID).save(tmp_path / "s")
    assert list(tmp_path.iterdir()) == []
    monkeypatch.undo()
    Volume(DATA, GRID).save(tmp_path / "s")
    shutil.copy(tmp_path / "s" / "0004.dcm", tmp_path / "last.dcm")
    (tmp_path / "s" / "0004.dcm").unlink()
    with pytest.raises(ValueError, match="it holds 3 of the 4 slices"):
        Volume.load(tmp_path / "s")
    for name in ("0004.dcm", "0005.dcm"):
        shutil.copy(tmp_path / "last.dcm", tmp_path / "s" / name)
    with pytest.raises(ValueError, match="slices lack or repeat between z"):
        Volume.load(tmp_path / "s")


def test_dicom_series_are_in_hu_and_whole(tmp_path):
    Volume(DATA, GRID).save(tmp_path / "s")
    first = pydicom.dcmread(tmp_path / "s" / "0001.dcm")
    assert (first.RescaleType, first.Modality, len(list((tmp_path / "s").iterdir()))) == ("HU", "CT", 4)
    with pytest.raises(ValueError, match="is not empty"):
        Volume(DATA, GRID).save(tmp_path / "s")
    with pytest.raises(ValueError, match=r"holds HU, this volume is in mm\^-1"):
        Volume(DATA, GRID, unit="mm^-1").save(tmp_path / "t")


@pytest.mark.parametrize("flip", [(1, 1, 1), (-1, 1, 1), (1, -1, -1)])
def test_files_of_other_software_in_any_direction(tmp_path, flip):
    """A volume written by SimpleITK with flipped axes reads as what SimpleITK itself says of every point."""
    image = SimpleITK.GetImageFromArray(DATA.numpy().astype(np.int16))
    image.SetSpacing((0.25, 0.5, 1.5))
    image.SetOrigin((3.0, -8.0, 20.0))
    image.SetDirection(tuple(np.diag(np.array(flip, float)).ravel()))
    for name in ("a.mha", "a.nii.gz"):
        SimpleITK.WriteImage(image, str(tmp_path / name))
        volume = Volume.load(tmp_path / name)
        z, y, x = np.meshgrid(*volume.grid.axes, indexing="ij")
        for k, j, i in ((0, 0, 0), (3, 5, 4), (1, 2, 3)):
            index = image.TransformPhysicalPointToIndex((-x[k, j, i], -y[k, j, i], z[k, j, i]))
            assert float(volume.data[k, j, i]) == float(image[index])


def test_a_clinical_slice_reads_as_pydicom_says(tmp_path):
    path = get_testdata_file("CT_small.dcm")
    (tmp_path / "ct").mkdir()
    shutil.copy(path, tmp_path / "ct" / "a.dcm")
    volume, d = Volume.load(tmp_path / "ct"), pydicom.dcmread(path)
    expected = d.pixel_array * float(d.RescaleSlope) + float(d.RescaleIntercept)
    np.testing.assert_array_equal(volume.data[0].numpy(), expected[::-1, ::-1])


def test_unknown_endings_and_oblique_axes(tmp_path):
    with pytest.raises(ValueError, match=r"unknown volume format 'v\.png': use \.nii"):
        Volume(DATA, GRID).save(tmp_path / "v.png")
    affine = np.array([[0.9, -0.4, 0, 0], [0.4, 0.9, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1]])
    nibabel.save(nibabel.Nifti1Image(np.zeros((3, 4, 5), np.float32), affine), tmp_path / "o.nii")
    with pytest.raises(ValueError, match="oblique"):
        Volume.load(tmp_path / "o.nii")
    with pytest.raises(FileNotFoundError):
        Volume.load(tmp_path / "none.nii")
