"""OME-Zarr: what is damaged or lost is refused by name, what earlier versions and other software
wrote is read."""

import json
import math
import re
import shutil

import numpy as np
import pytest
import torch
import zarr

from torchpcct import Volume, VolumeGrid
from torchpcct.formats.volume_slabs import SlabFile

GRID = VolumeGrid((40, 12, 10), (1.5, 0.5, 0.25), (3.0, -7.0, 11.0))
DATA = torch.round(300 * torch.randn(GRID.shape, generator=torch.Generator().manual_seed(0)))


@pytest.fixture(scope="module", params=["whole", "in slabs"])
def written(request, tmp_path_factory):
    path = tmp_path_factory.mktemp("zarr") / "v.zarr"
    if request.param == "whole":
        Volume(DATA, GRID, unit="mm^-1").save(path)
    else:
        slabs = SlabFile(path, GRID, "mm^-1", "key", 32)
        for first in (0, 32):
            slabs.write(DATA[first : first + 32].numpy())
        slabs.finish({"method": "fbp"})
    return path


def test_round_trip(written):
    back = Volume.load(written)
    assert torch.equal(back.data, DATA)
    assert (back.unit, back.grid.shape) == ("mm^-1", GRID.shape)
    np.testing.assert_allclose(
        [*back.grid.spacing, *back.grid.center], [*GRID.spacing, *GRID.center]
    )
    assert {path.name for path in (written / "0" / "c").iterdir()} == {"0", "1"}


def test_flipped_bits_are_refused_or_change_nothing(written, tmp_path):
    """Of voxels and of what describes them."""
    path, rng = tmp_path / "v.zarr", np.random.default_rng(0)
    shutil.copytree(written, path)
    whole, refused = Volume.load(written), 0
    files = sorted(f for f in path.rglob("*") if f.is_file())
    for k in range(60):
        file = files[k % len(files)]
        content = bytearray(file.read_bytes())
        sound = bytes(content)
        content[rng.integers(len(content))] ^= 1 << int(rng.integers(8))
        file.write_bytes(content)
        try:
            found = Volume.load(path)
            assert torch.equal(found.data, DATA)
            assert (found.grid, found.unit) == (whole.grid, whole.unit)
        except ValueError as error:
            assert "v.zarr cannot be read as an OME-Zarr" in str(error)  # noqa: PT017
            refused += 1
        file.write_bytes(sound)
    assert refused >= 58


def test_a_lost_or_damaged_chunk_is_named(written, tmp_path):
    path = tmp_path / "v.zarr"
    shutil.copytree(written, path)
    chunk = path / "0" / "c" / "1" / "0" / "0"
    content = chunk.read_bytes()
    chunk.write_bytes(content[:-5])
    with pytest.raises(ValueError, match="its chunk 0/c/1/0/0 is damaged: "):
        Volume.load(path)
    chunk.unlink()
    with pytest.raises(ValueError, match="its chunk 0/c/1/0/0 is lost"):
        Volume.load(path)


def test_volumes_without_any_value_are_kept(tmp_path):
    Volume(torch.full((3, 4, 5), torch.nan), VolumeGrid((3, 4, 5), 1.0)).save(tmp_path / "v.zarr")
    back = Volume.load(tmp_path / "v.zarr", fill=math.nan)
    assert bool(back.data.isnan().all())


def image(names="zyx", unit="millimeter", scale=(2.0, 1.0, 0.5), lead=0):
    axes = [{"name": n, "type": "space", **({"unit": unit} if unit else {})} for n in names]
    for axis in axes[:lead]:
        axis["type"] = "other"
    transforms = [{"type": "scale", "scale": [*(1.0,) * lead, *scale]}]
    return {"axes": axes, "datasets": [{"path": "0", "coordinateTransformations": transforms}]}


def older(path, attributes, **changed):
    """As versions before checksums wrote it, or other software."""
    group = zarr.create_group(path, zarr_format=3, attributes=attributes)
    options = {"fill_value": 0.0, "chunks": (2, 4, 5), **changed}
    array = group.create_array("0", shape=(3, 4, 5), dtype="float32", **options)
    array[:2] = np.arange(40.0).reshape(2, 4, 5) + 1
    return array


def test_volumes_that_were_written_before_there_were_checksums(tmp_path):
    about = {"ome": {"version": "0.5", "multiscales": [image()]}, "torchpcct": {"unit": "mm^-1"}}
    older(tmp_path / "v.zarr", about)[2:] = 7.0
    back = Volume.load(tmp_path / "v.zarr")
    assert (back.unit, back.grid.spacing, float(back.data[2, 3, 4])) == (
        "mm^-1",
        (2.0, 1.0, 0.5),
        7.0,
    )
    (tmp_path / "v.zarr" / "0" / "c" / "1" / "0" / "0").unlink()
    with pytest.raises(ValueError, match="its chunk 0/c/1/0/0 is lost"):
        Volume.load(tmp_path / "v.zarr")


def test_other_software_may_leave_out_chunks_of_the_fill_value(tmp_path):
    older(
        tmp_path / "v.zarr",
        {"ome": {"version": "0.5", "multiscales": [image(unit="micrometer")]}},
        fill_value=0.0,
    )
    back = Volume.load(tmp_path / "v.zarr")
    assert (back.unit, float(back.data[2].abs().max()), float(back.data[0, 0, 0])) == (
        "HU",
        0.0,
        1.0,
    )
    np.testing.assert_allclose(back.grid.spacing, (2e-3, 1e-3, 0.5e-3))
    group = zarr.create_group(
        tmp_path / "t.zarr", attributes={"ome": {"multiscales": [image("tczyx", lead=2)]}}
    )
    group.create_array("0", shape=(1, 1, 3, 4, 5), dtype="int16")[...] = 9
    assert Volume.load(tmp_path / "t.zarr").data.shape == (3, 4, 5)


@pytest.mark.parametrize(
    ("attributes", "said"),
    [
        (image(unit="furlong"), "its lengths are in the unknown unit 'furlong': write"),
        (image("xyz"), "its axes are x, y, z.*write it with its axes in that order"),
        (image("yx", scale=(1.0, 1.0)), "its axes are y, x"),
        (image(scale=(2.0, 1.0)), "its scale has 2 numbers, of 3 axes"),
        ({**image(), "datasets": [{"path": "0"}]}, "have no scale, the size of a voxel"),
        (
            {**image(), "coordinateTransformations": [{"type": "rotation", "rotation": [0.0]}]},
            "an operation 'rotation': resample it to straight axes",
        ),
        (
            {**image(), "coordinateTransformations": [{"type": "scale", "path": "s"}]},
            "its scale lies in another file",
        ),
    ],
)
def test_axes_and_units_that_are_not_understood(tmp_path, attributes, said):
    older(tmp_path / "v.zarr", {"ome": {"multiscales": [attributes]}})
    with pytest.raises(ValueError, match=said):
        Volume.load(tmp_path / "v.zarr")


@pytest.mark.parametrize(
    ("names", "unit", "mm"),
    [("zyx", "Micrometer", 1e-3), ("ZYX", "angstrom", 1e-7), ("zyx", "inch", 25.4)],
)
def test_units_and_axes_in_any_capitals(tmp_path, names, unit, mm):
    about = image(names, unit)
    about["coordinateTransformations"] = [{"type": "identity"}]
    older(tmp_path / "v.zarr", {"ome": {"multiscales": [about]}})
    spacing = Volume.load(tmp_path / "v.zarr").grid.spacing
    np.testing.assert_allclose(spacing, np.array((2.0, 1.0, 0.5)) * mm)


@pytest.mark.parametrize("unit", [None, ""])
def test_lengths_without_a_unit_are_taken_for_millimetres_and_said(tmp_path, unit):
    about = image()
    for axis in about["axes"]:
        axis["unit"] = unit
    older(tmp_path / "v.zarr", {"ome": {"multiscales": [about]}})
    with pytest.warns(UserWarning, match="gives its lengths no unit: they are taken for mill"):
        assert Volume.load(tmp_path / "v.zarr").grid.spacing == (2.0, 1.0, 0.5)
    # A volume of ours of unknown pixels has none, and that is said by its own unit.
    grid = VolumeGrid((3, 4, 5), 1.0)
    Volume(torch.ones(3, 4, 5), grid, unit="pixel^-1").save(tmp_path / "own.zarr")
    assert Volume.load(tmp_path / "own.zarr").unit == "pixel^-1"


def test_metadata_keep_one_digest_of_themselves(written):
    text = (written / "zarr.json").read_text(encoding="utf-8")
    assert len(re.findall(r"torchpcct-sha256:[0-9a-f]{64}", text)) == 1
    assert json.loads(text)["attributes"]["torchpcct"]["unit"] == "mm^-1"
