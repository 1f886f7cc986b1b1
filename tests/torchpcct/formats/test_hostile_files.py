"""Files that would never end, fill the memory, or lead elsewhere: refused in one sentence that
names them."""

import contextlib
import gzip
import os
import resource
import shutil
import zlib

import h5py
import nibabel
import numpy as np
import pydicom
import pytest
import tifffile
import torch
import yaml

from torchpcct import ParallelBeam, Scan, Volume, VolumeGrid
from torchpcct.files import require_ordinary, seal
from torchpcct.formats.damage import check_expansion, read_numbers
from torchpcct.formats.geometry_yaml import geometry_of, geometry_values
from torchpcct.formats.scans import open_scan
from torchpcct.formats.volume_files import is_own_volume

GEOMETRY = ParallelBeam(np.arange(6) * np.pi / 6, 8, 1.0)
GRID = VolumeGrid((40, 300, 20), 1.0)
_MOST = 200 * 2**20
"""Bytes by which reading such a file may enlarge this process."""


@contextlib.contextmanager
def little_memory():
    """A block that allocates no more than :data:`_MOST`."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    yield
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024 < _MOST


@pytest.fixture(params=["device", "link to a device", "pipe"])
def endless(request, tmp_path):
    path = tmp_path / "endless"
    if request.param == "device":
        return "/dev/zero"
    if request.param == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero")
    return str(path)


def described(folder, **changed):
    np.save(folder / "n.npy", np.full((6, 8), 50.0))
    text = {
        "readings": "n.npy",
        "kind": "counts",
        "air": 100.0,
        "geometry": geometry_values(GEOMETRY),
        **changed,
    }
    (folder / "scan.yaml").write_text(yaml.safe_dump(text), encoding="utf-8")
    return folder / "scan.yaml"


def test_yaml_that_names_what_never_ends(tmp_path, endless):
    values = geometry_values(GEOMETRY)
    for ending in (".npy", ".tif", ".mat"):
        link = tmp_path / f"link{ending}"
        link.unlink(missing_ok=True)
        link.symlink_to(endless)
        for key in ("readings", "air", "dark", "dead"):
            with pytest.raises(ValueError, match=rf"link\{ending} is a (device|pipe), not a file"):
                open_scan(described(tmp_path, **{key: link.name}))
    for geometry in (
        {**values, "angles_deg": endless},
        {**values, "pose": {"roll_deg": endless}},
        {"kind": "vectors", "vectors": endless, "columns": 8},
        {"kind": "rtk", "file": endless, "columns": 8, "rows": 2, "pitch": 1.0},
    ):
        with pytest.raises(ValueError, match=r"is a (device|pipe), not a file"):
            open_scan(described(tmp_path, geometry=geometry))
        with pytest.raises(ValueError, match=r"is a (device|pipe), not a file"):
            geometry_of(geometry, tmp_path)


@pytest.mark.parametrize(
    "name",
    [
        "a.h5",
        "a.nxs",
        "a.yaml",
        "a.txrm",
        "a.xtekct",
        "a.mat",
        "a.prep",
        "v.nii",
        "v.nii.gz",
        "v.mha",
        "v.dcm",
    ],
)
def test_files_of_every_format_that_never_end(tmp_path, name):
    (tmp_path / name).symlink_to("/dev/zero")
    geometry = {"geometry": GEOMETRY} if name.endswith((".mat", ".prep")) else {}
    read = Volume.load if name.startswith("v") else open_scan
    with pytest.raises(ValueError, match=rf"{name} is a device, not a file"):
        read(tmp_path / name, **geometry)
    assert not name.startswith("v") or name == "v.dcm" or not is_own_volume(tmp_path / name)
    if name == "a.h5":
        for own in (Scan.load, Volume.load):
            with pytest.raises(ValueError, match="is a device, not a file"):
                own(tmp_path / name)


def test_folders_with_a_pipe_in_them(tmp_path):
    Volume(torch.zeros(2, 3, 4), VolumeGrid((2, 3, 4), 1.0)).save(tmp_path / "s")
    Volume(torch.zeros(2, 3, 4), VolumeGrid((2, 3, 4), 1.0)).save(tmp_path / "v.zarr")
    os.mkfifo(tmp_path / "s" / "0003.dcm")
    (tmp_path / "v.zarr" / "0" / "c" / "0" / "0" / "0").unlink()
    os.mkfifo(tmp_path / "v.zarr" / "0" / "c" / "0" / "0" / "0")
    for name, pipe in (("s", r"0003\.dcm"), ("v.zarr", "0/0/0")):
        with pytest.raises(ValueError, match=rf"{pipe} is a pipe, not a file"):
            Volume.load(tmp_path / name)
        with pytest.raises(ValueError, match=rf"{pipe} is a pipe"):
            require_ordinary(tmp_path / name)


def _gzip(path, header, size):
    """A header and zeros, packed a thousandfold, in pieces."""
    with gzip.open(path, "wb", 1) as file:
        file.write(header)
        for _ in range(size // 2**24):
            file.write(bytes(2**24))
    return path


def _nifti_header(shape):
    header = nibabel.Nifti1Header()
    header.set_data_dtype(np.float32)
    header.set_data_shape(shape)
    header.set_sform(np.eye(4), code=1)
    header["vox_offset"] = 352
    return bytes(header.binaryblock) + bytes(4)


def test_nifti_that_unpacks_to_more_than_it_says_or_than_fits(tmp_path):
    _gzip(tmp_path / "a.nii.gz", _nifti_header((5, 4, 3)), 2**25)
    with (
        little_memory(),
        pytest.raises(ValueError, match=r"a\.nii\.gz .*: it unpacks to more than the 592 bytes"),
    ):
        Volume.load(tmp_path / "a.nii.gz")
    _gzip(tmp_path / "b.nii.gz", _nifti_header((2000, 2000, 1000)), 2**24)
    with (
        little_memory(),
        pytest.raises(
            ValueError,
            match=r"b\.nii\.gz .* compressed to .* more than 200 times|b\.nii\.gz .*memory",
        ),
    ):
        Volume.load(tmp_path / "b.nii.gz")


def _deflated(path, zeros):
    """A deflated CT image with that many zeros as pixels, made without holding them."""
    Volume(torch.zeros(1, 4, 5), VolumeGrid((1, 4, 5), 1.0)).save(path.with_name("plain"))
    d = pydicom.dcmread(path.with_name("plain") / "0001.dcm")
    d.file_meta.TransferSyntaxUID = "1.2.840.10008.1.2.1.99"
    del d.PixelData
    pydicom.dcmwrite(path, d, enforce_file_format=True)
    content = path.read_bytes()
    length = 144 + int(pydicom.filereader.read_file_meta_info(path).FileMetaInformationGroupLength)
    body = zlib.decompress(content[length:], -zlib.MAX_WBITS)
    pack = zlib.compressobj(1, wbits=-zlib.MAX_WBITS)
    with path.open("wb") as file:
        file.write(content[:length])
        file.write(pack.compress(body + b"\xe0\x7f\x10\x00OW\0\0" + zeros.to_bytes(4, "little")))
        for start in range(0, zeros, 2**24):
            file.write(pack.compress(bytes(min(2**24, zeros - start))))
        file.write(pack.flush())
    return path


def test_dicom_that_inflates_to_more_than_an_image(tmp_path):
    sound = Volume.load(_deflated(tmp_path / "a.dcm", 40))
    assert float(sound.data.abs().max()) == 0.0
    shutil.rmtree(tmp_path / "plain")
    with (
        little_memory(),
        pytest.raises(ValueError, match=r"b\.dcm .* deflated data set is of more than 128 MiB"),
    ):
        Volume.load(_deflated(tmp_path / "b.dcm", 5 * 2**25))


def test_tiffs_and_arrays_of_absurd_sizes(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((64, 64), np.uint16), compression="zlib")
    with tifffile.TiffFile(tmp_path / "a.tif", mode="r+") as file:
        for name, size in (("ImageWidth", 2**16), ("ImageLength", 2**15), ("RowsPerStrip", 2**15)):
            file.pages[0].tags[name].overwrite(size)
    with (
        little_memory(),
        pytest.raises(
            ValueError, match=r"a\.tif cannot be read as a TIFF image: the image of 4 GiB"
        ),
    ):
        open_scan(described(tmp_path, readings="a.tif"))
    np.save(tmp_path / "b.npy", np.zeros((6, 8)))
    content = (
        (tmp_path / "b.npy")
        .read_bytes()
        .replace(b"(6, 8), }              ", b"(600000, 80000), }     ")
    )
    (tmp_path / "b.npy").write_bytes(content)
    assert b"600000" in content
    with little_memory(), pytest.raises(ValueError, match=r"b\.npy cannot be read as"):
        open_scan(described(tmp_path, readings="b.npy"))
    with little_memory(), pytest.raises(ValueError, match=r"b\.npy cannot be read as a table"):
        read_numbers(tmp_path / "b.npy", "a table")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("0,000\n1,500\n", r"'0,000' in line 1 is no number: .* decimal point"),
        ("angle\n0.0\n", "'angle' in line 1 is no number: .* # before a comment"),
        ("# deg\n0.0\n0.5;1.0\n", r"'0\.5;1\.0' in line 3 is no number: .* apart by blanks"),
        ("", "it holds no numbers"),
        ("# deg\n\n", "it holds no numbers"),
    ],
)
def test_tables_of_other_spellings_say_what_to_write(tmp_path, text, said):
    path = tmp_path / "angles.txt"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=rf"angles\.txt .*{said}"):
        read_numbers(path, "a table of angles")


def test_tables_have_comments_and_a_byte_order_mark(tmp_path):
    path = tmp_path / "angles.txt"
    path.write_bytes("\ufeff# deg\n0 1.5  # start\n\n2 3e0\n".encode())
    assert read_numbers(path, "a table").tolist() == [[0.0, 1.5], [2.0, 3.0]]
    with pytest.raises(ValueError, match=r"the image needs .* GiB of memory are free"):
        check_expansion((2**17, 2**18), "the image", 2**40)


@pytest.mark.parametrize("kind", ["scan", "volume"])
def test_files_of_ours_that_were_made_to_lead_elsewhere(tmp_path, kind):
    """Their seal can be made again by whoever changes them."""
    path, name = tmp_path / "own.h5", {"scan": "counts", "volume": "data"}[kind]
    if kind == "scan":
        Scan.from_counts(np.full((6, 8), 50.0), GEOMETRY, air=100.0).save(path)
    else:
        Volume(torch.zeros(3, 4), VolumeGrid((3, 4), 1.0)).save(path)
    load = {"scan": Scan.load, "volume": Volume.load}[kind]
    load(path)
    with h5py.File(tmp_path / "other.h5", "w") as other:
        other["x"] = np.zeros((6, 8), np.float32)
    with h5py.File(path, "a") as file:
        del file[name]
        file[name] = h5py.ExternalLink("other.h5", "/x")
    seal(path)
    with pytest.raises(
        ValueError, match=rf"own\.h5 .*: its /{name} is a link to another file, other\.h5"
    ):
        load(path)
