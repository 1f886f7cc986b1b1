"""Volumes in and out: what SimpleITK, nibabel and pydicom see of ours, and we of theirs."""

import re
import shutil
import subprocess

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
    np.testing.assert_allclose(
        [*back.grid.spacing, *back.grid.center], [*GRID.spacing, *GRID.center], atol=1e-5
    )


@pytest.mark.parametrize(
    "name", ["v.NII.GZ", "v.Nii.gz", "v.nii.Gz", "v.Nii", "v.MHA", "v.H5", "v.Zarr"]
)
def test_endings_in_capitals_mean_what_small_ones_do(tmp_path, name):
    Volume(DATA, GRID).save(tmp_path / name)
    assert torch.equal(Volume.load(tmp_path / name).data, DATA)
    if name.lower().endswith(".gz"):
        assert (tmp_path / name).read_bytes()[:2] == b"\x1f\x8b"
    small = tmp_path / name.lower()
    (tmp_path / name).rename(small)
    assert torch.equal(Volume.load(small).data, DATA)


@pytest.mark.parametrize("shift", [0.0, 1e-3, 5.0])
@pytest.mark.parametrize("factor", [1.0, 2.0, -1.0])
def test_sform_and_qform_that_disagree_are_said(tmp_path, factor, shift):
    """ITK takes the qform, nibabel the sform."""
    affine = np.diag([0.5, 0.5, 2.0, 1.0])
    affine[:3, 3] = 10.0, 20.0, 30.0
    image = nibabel.load(nifti(tmp_path / "v.nii", affine))
    other = affine @ np.diag([factor, 1.0, 1.0, 1.0])
    other[2, 3] += shift
    image.header.set_qform(other, code=1)
    nibabel.save(nibabel.Nifti1Image(image.get_fdata(), None, image.header), tmp_path / "w.nii")
    if factor == 1.0 and shift < 0.1:
        grid = Volume.load(tmp_path / "w.nii").grid
    else:
        with pytest.warns(UserWarning, match="its sform and qform differ by up to [0-9.]+ of its"):
            grid = Volume.load(tmp_path / "w.nii").grid
    assert grid.spacing == (2.0, 0.5, 0.5)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("v.nii", b"", "it is empty"),
        ("v.nii.gz", b"", "it is empty"),
        ("v.nii", b"\x1f\x8b" + bytes(400), "it does not begin as NIfTI does"),
        ("v.mha", b"", "it does not begin as a MetaImage does"),
    ],
)
def test_files_that_hold_something_else(tmp_path, name, content, said):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=f"{name} cannot be read as .*{said}"):
        Volume.load(tmp_path / name)


def nifti(path, affine, unit=None, shape=(5, 4, 3), sform=True):
    image = nibabel.Nifti1Image(np.arange(np.prod(shape), dtype=np.float32).reshape(shape), affine)
    image.header.set_sform(affine, code=1 if sform else 0)
    image.header.set_qform(affine, code=0 if sform else 1)
    if unit is not None:
        image.header.set_xyzt_units(unit)
    nibabel.save(image, path)
    return path


@pytest.mark.parametrize(
    ("unit", "mm"), [("micron", 1e-3), ("mm", 1.0), ("meter", 1e3), ("unknown", 1.0), (None, 1.0)]
)
@pytest.mark.parametrize("sform", [True, False])
def test_nifti_lengths_are_in_its_unit(tmp_path, unit, mm, sform):
    affine = np.diag([-0.05, 0.1, 0.2, 1.0])
    affine[:3, 3] = 1.0, 2.0, 3.0
    volume = Volume.load(nifti(tmp_path / "v.NII", affine / mm, unit, sform=sform))
    np.testing.assert_allclose(volume.grid.spacing, (0.2, 0.1, 0.05), rtol=1e-5)
    np.testing.assert_allclose(volume.grid.center, (3.2, 2.15, 0.9), rtol=1e-5)
    raw = bytearray((tmp_path / "v.NII").read_bytes())
    raw[123] = 5  # xyzt_units: a code that means nothing
    (tmp_path / "v.NII").write_bytes(raw)
    with pytest.raises(ValueError, match="its unit of length is the unknown code 5"):
        Volume.load(tmp_path / "v.NII")


def test_nifti_of_one_volume_with_more_axes(tmp_path):
    plain = Volume.load(nifti(tmp_path / "v.nii", np.eye(4)))
    for shape in ((5, 4, 3, 1), (5, 4, 3, 1, 1)):
        more = Volume.load(nifti(tmp_path / "m.nii.gz", np.eye(4), shape=shape))
        assert torch.equal(more.data, plain.data)
        assert more.grid == plain.grid
    with pytest.raises(
        ValueError, match=r"shape \(5, 4, 3, 2\), 2 volumes: split them into files of one"
    ):
        Volume.load(nifti(tmp_path / "t.nii", np.eye(4), shape=(5, 4, 3, 2)))


def test_a_unit_may_be_given_for_files_that_do_not_say_it(tmp_path):
    assert Volume.load(nifti(tmp_path / "v.nii", np.eye(4)), unit="mm^-1").unit == "mm^-1"
    for name in ("v.nii.gz", "v.mha", "v.h5", "v.zarr"):
        Volume(DATA, GRID, unit="mm^-1").save(tmp_path / name)
        assert Volume.load(tmp_path / name, unit="mm^-1").unit == "mm^-1"
        with pytest.raises(ValueError, match=r"gives the unit 'mm\^-1', not 'HU'"):
            Volume.load(tmp_path / name, unit="HU")
    with pytest.raises(ValueError, match="unknown unit 'Bq': use one of HU"):
        Volume.load(tmp_path / "v.nii", unit="Bq")


def test_units_of_other_files(tmp_path):
    """What other software wrote is in HU; a unit that is named and not known is no HU."""
    image = SimpleITK.GetImageFromArray(DATA.numpy())
    SimpleITK.WriteImage(image, str(tmp_path / "foreign.mha"))
    SimpleITK.WriteImage(image, str(tmp_path / "foreign.nii"))
    assert [Volume.load(tmp_path / f"foreign.{end}").unit for end in ("mha", "nii")] == ["HU", "HU"]
    image.SetMetaData("Unit", "Bq/ml")
    SimpleITK.WriteImage(image, str(tmp_path / "pet.mha"))
    with pytest.raises(
        ValueError, match="its field Unit gives the unit 'Bq/ml', expected HU or mm"
    ):
        Volume.load(tmp_path / "pet.mha")


@pytest.mark.parametrize("name", [n for n in NAMES if n != "v.h5"])
def test_other_software_sees_the_same_place(tmp_path, name):
    """The point (x, y, z) of the scanner is (−x, −y, z) in ITK, in every format, and holds the
    same value."""
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
    """Each has a checksum at the end of its voxels; 103 of 200 such .nii.gz were read, by half a
    million HU off."""
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
    np.testing.assert_allclose(
        [*back.grid.spacing, *back.grid.center], [0.25, 0.5, 0.25, 0.0, -7.0, 11.0], atol=1e-5
    )


def test_a_single_slice_of_a_series_keeps_its_thickness_and_is_read_as_a_file(tmp_path):
    Volume(DATA, GRID).save(tmp_path / "s")
    one = Volume.load(tmp_path / "s" / "0002.dcm")
    assert torch.equal(one.data, DATA[1:2])
    np.testing.assert_allclose(one.grid.spacing, GRID.spacing)
    np.testing.assert_allclose(one.grid.center, [GRID.axes[0][1], *GRID.center[1:]], atol=1e-6)
    with pytest.raises(
        ValueError, match=r"'0002\.dcm' would be one slice: a DICOM series is a folder"
    ):
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
    with pytest.raises(ValueError, match="it has 3 of the 4 slices"):
        Volume.load(tmp_path / "s")
    for name in ("0004.dcm", "0005.dcm"):
        shutil.copy(tmp_path / "last.dcm", tmp_path / "s" / name)
    with pytest.raises(ValueError, match="slices are missing or repeated between z"):
        Volume.load(tmp_path / "s")


@pytest.fixture
def series(tmp_path):
    """A function that writes a series whose slices a function has changed, and returns its
    folder."""
    Volume(DATA, GRID).save(tmp_path / "plain")

    def changed(change, name="s"):
        folder, uid = tmp_path / name, pydicom.uid.generate_uid()
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        for path in (tmp_path / "plain").iterdir():
            d = pydicom.dcmread(path)
            d.SeriesInstanceUID, d.Manufacturer = uid, "another"
            change(d)
            d.save_as(folder / path.name)
        return folder

    return changed


@pytest.mark.parametrize(
    "name", ["1.000000-Full Dose Images-53322", "1.2.840.113619.2.55", "scan.v2", "a.nii.d"]
)
def test_dicom_folders_may_have_dots_in_their_names(tmp_path, name):
    (tmp_path / name).mkdir()
    Volume(DATA, GRID).save(tmp_path / name)
    assert torch.equal(Volume.load(tmp_path / name).data, DATA)


def test_a_series_named_by_an_identifier_is_written_and_other_endings_are_not(tmp_path):
    Volume(DATA, GRID).save(tmp_path / "1.2.840.113619.2.55")
    assert torch.equal(Volume.load(tmp_path / "1.2.840.113619.2.55").data, DATA)
    with pytest.raises(ValueError, match=r"unknown volume format 'v\.nrrd'"):
        Volume(DATA, GRID).save(tmp_path / "v.nrrd")


def test_what_archives_leave_beside_slices_is_left_out_and_damaged_slices_are_not(series):
    folder = series(lambda d: None)
    directory, report = pydicom.dcmread(folder / "0001.dcm"), pydicom.dcmread(folder / "0001.dcm")
    directory.file_meta.MediaStorageSOPClassUID = "1.2.840.10008.1.3.10"
    directory.save_as(folder / "DICOMDIR")
    for name in ("Rows", "Columns", "PixelData", "BitsAllocated"):
        delattr(report, name)
    report.SOPClassUID = report.file_meta.MediaStorageSOPClassUID = "1.2.840.10008.5.1.4.1.1.88.11"
    report.save_as(folder / "report.dcm")
    for name, content in (
        ("readme.txt", b"hello"),
        ("LICENSE", b"Creative Commons\r\n"),
        ("._0001.dcm", b"\0\5"),
        ("thumbs.db", bytes(600)),
        ("picture.png", b"\x89PNG" + bytes(200)),
    ):
        (folder / name).write_bytes(content)
    (folder / "folder").mkdir()
    assert torch.equal(Volume.load(folder).data, DATA)
    for name, content in (("0005", bytes(900)), ("IM5.dcm", b"text")):
        (folder / name).write_bytes(content)
        with pytest.raises(ValueError, match=f"{name} cannot be read as a DICOM image"):
            Volume.load(folder)
        (folder / name).unlink()
    (folder / "0005.dcm").symlink_to(folder / "gone.dcm")
    with pytest.raises(FileNotFoundError, match=r"0005\.dcm is a link to nothing: take it away"):
        Volume.load(folder)
    (folder / "0005.dcm").unlink()
    (folder / "0005.dcm").write_bytes(b"")
    with pytest.raises(ValueError, match=r"0005\.dcm cannot be read .*it is empty: take it away"):
        Volume.load(folder)
    (folder / "0005.dcm").unlink()
    slices = [folder / f"000{k}.dcm" for k in (1, 2, 3, 4)]
    for path in slices:
        path.rename(path.with_suffix(""))
    assert torch.equal(Volume.load(folder).data, DATA)


@pytest.mark.parametrize("slice_number", [2, 4])
def test_a_slice_that_ends_early_is_never_left_out(series, slice_number):
    """Of a series of others nothing says how many slices there are: cut off at any byte, the last
    one was taken for a report without an image."""
    path = series(lambda d: setattr(d, "Manufacturer", "X")) / f"000{slice_number}.dcm"
    content = path.read_bytes()
    pixels = content.index(b"\xe0\x7f\x10\x00")
    for length in (132, 144, 156, 180, 407, *range(1, pixels + 8, 50), len(content) - 1):
        path.write_bytes(content[:length])
        with pytest.raises(ValueError, match=f"000{slice_number}.dcm cannot be read as a DICOM"):
            Volume.load(path.parent)


def _no_rescale(d):
    del d.RescaleSlope, d.RescaleIntercept


def _pet(d):
    d.Modality, d.Units = "PT", "BQML"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda d: setattr(d, "RescaleType", "US"),
            r"its RescaleType is US \(unspecified\), not HU; .*unit='HU'",
        ),
        (lambda d: setattr(d, "RescaleType", "HU_MOD"), "its RescaleType is HU_MOD, not HU"),
        (lambda d: setattr(d, "RescaleType", "Z_EFF"), "its RescaleType is Z_EFF, not HU"),
        (_no_rescale, "it has no RescaleSlope and no RescaleIntercept"),
        (lambda d: delattr(d, "RescaleSlope"), "it has no RescaleSlope: its values are not HU"),
        (lambda d: setattr(d, "RescaleSlope", "0"), "its RescaleSlope is 0"),
        (_pet, "its modality is PT in BQML: only CT images are in HU"),
        (lambda d: setattr(d, "Modality", "MR"), "its modality is MR"),
        (lambda d: setattr(d, "NumberOfFrames", 2), "it holds 2 frames"),
    ],
)
def test_dicom_that_does_not_say_that_it_is_in_hu_is_refused(series, change, said):
    with pytest.raises(ValueError, match=rf"000\d\.dcm cannot be read as a DICOM image: {said}"):
        Volume.load(series(change))


def test_dicom_in_hu_that_does_not_say_the_type_or_is_said_to_be(series):
    for change in (lambda d: delattr(d, "RescaleType"), lambda d: delattr(d, "Modality")):
        assert torch.equal(Volume.load(series(change)).data, DATA)
    unspecified = series(lambda d: setattr(d, "RescaleType", "US"))
    assert torch.equal(Volume.load(unspecified, unit="HU").data, DATA)
    plain = Volume.load(series(_no_rescale), unit="mm^-1")
    assert (torch.equal(plain.data, DATA), plain.unit) == (True, "mm^-1")


def _padded(value, marked, limit=None, vr="SS"):
    """The first row and a pixel inside hold a value, which the header marks."""

    def change(d):
        pixels = d.pixel_array.copy()
        pixels[0], pixels[3, 2] = value, value
        d.PixelData = pixels.tobytes()
        if marked is not None:
            d.add_new(0x00280120, vr, marked)
        if limit is not None:
            d.add_new(0x00280121, "SS", limit)

    return change


@pytest.mark.parametrize(
    ("value", "change", "inside"),
    [
        (-2000, _padded(-2000, -2000), -1000),
        (-2000, _padded(-2000, 63536, vr="US"), -1000),
        (-2000, _padded(-2000, -3024, limit=-1500), -1000),
        (0, _padded(0, 0), 0),  # water within: the same value, but not at the border
        (-1000, _padded(-1000, -1000), -1000),
    ],
)
def test_padding_about_the_picture_is_air_and_said(series, value, change, inside):
    folder = series(change)
    with pytest.warns(
        UserWarning, match=r"of 120 pixels are padding around the image, .* read as air, -1000 HU"
    ):
        data = Volume.load(folder).data
    expected = DATA.flip(1, 2).clone()
    expected[:, 0], expected[:, 3, 2] = -1000.0, inside
    assert torch.equal(data.flip(1, 2), expected)


def _in_floats(d):
    """Pixels as DICOM's parametric maps hold them."""
    pixels = d.pixel_array.astype("<f4")
    pixels[1, 2] = np.nan
    del d.PixelData
    d.FloatPixelData, d.BitsAllocated = pixels.tobytes(), 32
    del d.BitsStored, d.HighBit, d.PixelRepresentation


@pytest.mark.parametrize("name", [*NAMES, "v.zarr"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_voxels_that_are_no_numbers_are_refused_or_filled(tmp_path, series, name, value):
    """By every reader: they would be in each figure, or left out of it without a word."""
    path = series(_in_floats) if name == "series" else tmp_path / name
    data, bad = DATA.clone(), 4
    if name != "series":
        data[1:3, 2, 1], data[0, 0, 0], bad = value, value, 3
        Volume(data, GRID).save(path)
    said = (
        f"{re.escape(str(path))}: {bad} of 120 voxels are NaN or infinite: make it again .* give "
        r"them the value of air, Volume\.load\(path, fill=-1000\)\.save\(path\)"
    )
    with pytest.raises(ValueError, match=said):
        Volume.load(path)
    filled = Volume.load(path, fill=-1000.0).data
    assert bool(filled.isfinite().all())
    kept = Volume.load(path, fill=np.nan).data
    assert int((~kept.isfinite()).sum()) == bad
    assert torch.equal(filled, torch.where(kept.isfinite(), kept, torch.full_like(kept, -1000.0)))
    if name != "series":
        assert torch.equal(kept[1:3, 2, 1].isnan(), torch.tensor([np.isnan(value)] * 2))


def test_padding_in_all_corners_that_nothing_marks(series):
    def corners(d):
        pixels = d.pixel_array.copy()
        pixels[[0, -1]] = -3024
        d.PixelData = pixels.tobytes()

    with pytest.warns(UserWarning, match="40 of 120 pixels are padding"):
        assert float(Volume.load(series(corners)).data[:, [0, -1]].max()) == -1000.0


def test_slices_stand_upright_and_have_what_their_class_demands(tmp_path):
    """Seen from the feet, anterior up: rows run to the left, columns to the back. Two volumes
    are two patients."""
    for name in ("s", "t"):
        Volume(DATA, GRID).save(tmp_path / name)
    first, other = (pydicom.dcmread(tmp_path / name / "0001.dcm") for name in ("s", "t"))
    assert first.ImageOrientationPatient == [1, 0, 0, 0, 1, 0]
    # ours: to the right, to the front
    np.testing.assert_array_equal(first.pixel_array, DATA[0].flip(0, 1).numpy())
    assert (first.PatientPosition, first.BodyPartExamined) == ("HFS", "WHOLEBODY")
    assert re.fullmatch(r"\d{8}", first.StudyDate) is not None
    assert first.PatientID != other.PatientID
    checker = shutil.which("dciodvfy")
    if checker is None:
        pytest.skip("dciodvfy (dicom3tools) is not installed")
    said = subprocess.run(
        [checker, str(tmp_path / "s" / "0001.dcm")], capture_output=True, text=True, check=False
    )
    assert (said.stdout + said.stderr).strip() == "CTImage"


def test_dicom_series_are_in_hu_and_whole(tmp_path):
    Volume(DATA, GRID).save(tmp_path / "s")
    first = pydicom.dcmread(tmp_path / "s" / "0001.dcm")
    assert (first.RescaleType, first.Modality, len(list((tmp_path / "s").iterdir()))) == (
        "HU",
        "CT",
        4,
    )
    with pytest.raises(ValueError, match="is not empty"):
        Volume(DATA, GRID).save(tmp_path / "s")
    with pytest.raises(ValueError, match=r"holds HU, this volume is in mm\^-1"):
        Volume(DATA, GRID, unit="mm^-1").save(tmp_path / "t")


@pytest.mark.parametrize("flip", [(1, 1, 1), (-1, 1, 1), (1, -1, -1)])
def test_files_of_other_software_in_any_direction(tmp_path, flip):
    """A volume written by SimpleITK with flipped axes reads as what SimpleITK itself says of
    every point."""
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


@pytest.mark.parametrize("turned", [(1, 1), (1, -1), (-1, 1), (-1, -1)])
def test_a_foreign_series_lies_where_others_see_it(tmp_path, turned):
    """Rows and columns of any direction: every pixel where its position, orientation and spacing
    put it, as in ITK."""
    Volume(DATA, GRID).save(tmp_path / "s")
    for k, path in enumerate(sorted((tmp_path / "s").iterdir())):
        d = pydicom.dcmread(path)
        d.Manufacturer, d.ImageOrientationPatient = "another", [turned[0], 0, 0, 0, turned[1], 0]
        d.ImagePositionPatient = [41.5, -17.25, 8.0 + 1.5 * k]
        d.save_as(path)
    volume, image = Volume.load(tmp_path / "s"), sitk_read(tmp_path / "s")
    z, y, x = volume.grid.axes
    assert sorted(z) == list(z)
    for index in np.ndindex(5, 6, 4):  # column, row, slice
        right, down, up = image.TransformIndexToPhysicalPoint(index)
        at = [
            int(np.abs(axis - v).argmin())
            for axis, v in zip((z, y, x), (up, -down, -right), strict=True)
        ]
        np.testing.assert_allclose([z[at[0]], y[at[1]], x[at[2]]], [up, -down, -right], atol=1e-4)
        assert float(volume.data[tuple(at)]) == float(image[index])


def test_unknown_endings_and_oblique_axes(tmp_path):
    with pytest.raises(ValueError, match=r"unknown volume format 'v\.png': use \.nii"):
        Volume(DATA, GRID).save(tmp_path / "v.png")
    affine = np.array([[0.9, -0.4, 0, 0], [0.4, 0.9, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1]])
    nibabel.save(nibabel.Nifti1Image(np.zeros((3, 4, 5), np.float32), affine), tmp_path / "o.nii")
    with pytest.raises(ValueError, match="oblique"):
        Volume.load(tmp_path / "o.nii")
    with pytest.raises(FileNotFoundError):
        Volume.load(tmp_path / "none.nii")
