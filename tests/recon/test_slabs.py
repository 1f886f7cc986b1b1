"""Volumes slab by slab: the same bits as in one piece, within a limit of memory, and nothing
half written."""

import errno
import math
import re
import warnings
from dataclasses import replace

import nibabel
import numpy as np
import pytest
import tifffile
import torch
import zarr
from foreign_files import data_exchange
from fresh_python import run_python
from refusals import refused

import recon
from recon import slabs
from recon.slabs import ScanSlices, plan_slabs, reconstruct_to
from torchpcct import (
    ConeBeam,
    FanBeam,
    ParallelBeam,
    Projector,
    Scan,
    Volume,
    VolumeGrid,
    full_turn,
)
from torchpcct.files import WriteError
from torchpcct.formats.scans import open_scan
from torchpcct.formats.volume_slabs import SlabFile

CONE = ConeBeam(full_turn(60), 200.0, 300.0, 64, 40, 1.5)
PARALLEL = ParallelBeam(np.arange(50) * math.pi / 50, 64, 1.0)
GRID = VolumeGrid((24, 40, 40), 1.0)
STACK = VolumeGrid((6, 40, 40), 1.0)


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    """Limits count the arrays alone: what the interpreter holds depends on the tests before."""
    monkeypatch.setattr(slabs, "_RESERVE", 0)
    monkeypatch.setattr(slabs, "resident_bytes", lambda: 0)


def made(geometry, slices=0, radius=14.0, dead=False, **more):
    """Poisson counts of a ball (of a stack: a disk) with a dense detail, read by cells of which
    some are broken."""
    grid = VolumeGrid((40, 64, 64) if geometry.has_rows else (64, 64), 1.0)
    *z, y, x = np.meshgrid(*grid.axes, indexing="ij")
    body = 0.02 * ((x - 2) ** 2 + y**2 + sum(0.3 * v**2 for v in z) < radius**2) + 0.03 * (
        np.hypot(x - 4, y + 5) < 3
    )
    lines = Projector(geometry, grid)(torch.from_numpy(body).float())
    if slices:
        lines = torch.stack([lines * (0.5 + 0.1 * k) for k in range(slices)])
    counts = torch.poisson(2e4 * torch.exp(-lines), generator=torch.Generator().manual_seed(0))
    mask = torch.zeros(counts.shape, dtype=torch.bool)
    if dead and geometry.has_rows:
        mask[:, :, 20] = mask[:, 3, 10] = mask[:, 7] = True
        counts[:, 9, 30] = counts[7, 8, 33] = counts[4] = 0
        counts[:, 5, 25] *= 1.5
    elif dead:
        mask[2, :, 10] = True
        counts[1, :, 30] = counts[1, 7, 33] = 0
    return Scan.from_counts(
        counts.masked_fill(mask, 0.0), geometry, air=2e4, gain=1.0, dead=mask, mu_water=0.02, **more
    )


def slabs_and_whole(scan, grid, path, memory, method="fbp", source=None):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        whole = recon.reconstruct(scan, grid, method)
    report = reconstruct_to(source or scan, grid, path, method, memory=memory)
    assert report["slabs"] > 1
    return report, Volume.load(path), whole


CASES = {
    "cone with broken cells": (CONE, GRID, {"dead": True}, 4_500_000),
    "offset curved detector": (
        replace(CONE, offset=(3.0, 14.0), detector="curved"),
        GRID,
        {},
        4_200_000,
    ),
    "rows that end inside": (CONE, GRID, {"radius": 30.0}, 4_600_000),
    # Heights change by rows within a tile: the backprojection looks its rows up one by one.
    "wide cone": (
        ConeBeam(full_turn(60), 50.0, 80.0, 80, 60, 1.0),
        VolumeGrid((20, 30, 30), 1.0),
        {},
        7_500_000,
    ),
    "grid beyond the field of view": (
        CONE,
        VolumeGrid((24, 80, 80), 1.0, (2.0, 0.0, 0.0)),
        {},
        4_200_000,
    ),
    "parallel stack": (PARALLEL, STACK, {"slices": 6, "dead": True}, 250_000),
    "fan stack": (
        FanBeam(full_turn(50), 200.0, 300.0, 64, 1.5),
        STACK,
        {"slices": 6, "dead": True},
        250_000,
    ),
}


@pytest.mark.parametrize(
    "case",
    [
        c
        if c in ("cone with broken cells", "parallel stack")
        else pytest.param(c, marks=pytest.mark.extended)
        for c in CASES
    ],
)
def test_slabs_are_the_whole_volume(case, tmp_path):
    geometry, grid, options, memory = CASES[case]
    report, volume, whole = slabs_and_whole(
        made(geometry, **options), grid, tmp_path / "v.nii", memory
    )
    assert float((volume.data - whole.data).abs().max()) <= 1e-4
    assert volume.grid == whole.grid
    assert report["dead_readings"] == whole.report["dead_readings"]
    # What the whole was warned of is not lost: broken cells, rows that end inside.
    assert len(report["warnings"]) == len(whole.report["warnings"])
    assert report["mean"] == pytest.approx(float(whole.data.mean()), abs=1e-3)


@pytest.mark.extended
def test_pwls_of_a_stack(tmp_path):
    scan = made(PARALLEL, slices=4)
    grid = VolumeGrid((4, 24, 24), 1.6)
    needs = plan_slabs(PARALLEL, grid, "1GB", "pwls").memory
    _, volume, whole = slabs_and_whole(scan, grid, tmp_path / "v.nii", needs - 1, "pwls")
    torch.testing.assert_close(volume.data, whole.data, atol=1e-4, rtol=0)


def _files(scan, folder):
    """The same parallel-beam readings in every format that is read in parts, with their options."""
    # as a camera takes them, view by view
    images = scan.counts.movedim(0, 1).numpy().astype(np.uint16)
    scan.save(folder / "own.h5")
    data_exchange(
        folder / "exchange.h5",
        images,
        np.full((1, *images.shape[1:]), 2e4),
        PARALLEL.angles,
        None,
        1000.0,
    )
    np.save(folder / "images.npy", images)
    tifffile.imwrite(folder / "images.tif", images, photometric="minisblack")
    zarr.create_array(folder / "images.zarr", data=images)
    for k, image in enumerate(images):
        tifffile.imwrite(folder / f"image{k:03}.tiff", image)
    text = (
        "readings: '{}'\nkind: counts\nair: 20000\ngain: 1.0\nmu_water: 0.02\ngeometry: "
        "{{kind: parallel, columns: 64, "
    )
    text += "pitch: 1, angles_deg: {{start: 0, step: 3.6, count: 50}}}}\n"
    for name in ("images.npy", "images.tif", "images.zarr", "*.tiff"):
        (folder / f"{name[-4:]}.yaml").write_text(text.format(name))
    stacks = {f"{name}.yaml": {} for name in (".npy", ".tif", "zarr", "tiff")}
    return {"own.h5": {}, "exchange.h5": {"gain": 1.0, "mu_water": 0.02}, **stacks}


def test_files_are_read_in_parts(tmp_path):
    for name, options in _files(made(PARALLEL, slices=6), tmp_path).items():
        whole, source = (
            open_scan(tmp_path / name, **options),
            ScanSlices(tmp_path / name, **options),
        )
        assert (source.count, source.counts.shape) == (6, whole.counts.shape)
        torch.testing.assert_close(
            source.read(2, 5).scan.line_integrals(), whole.line_integrals()[2:5], atol=1e-6, rtol=0
        )
    _, volume, whole = slabs_and_whole(
        whole, STACK, tmp_path / "v.nii", 250_000, source=tmp_path / "zarr.yaml"
    )
    assert float((volume.data - whole.data).abs().max()) <= 1e-4


def test_rows_of_a_cone_beam_are_read_in_parts(tmp_path):
    scan = made(CONE, dead=True)
    scan.save(tmp_path / "own.h5")
    np.save(tmp_path / "images.npy", scan.counts.numpy())
    np.save(tmp_path / "dead.npy", scan.dead.numpy())
    (tmp_path / "scan.yaml").write_text(
        "readings: images.npy\ndead: dead.npy\nkind: counts\nair: 20000\ngain: 1.0\nmu_water: "
        "0.02\n"
        "geometry: {kind: cone, sod: 200, sdd: 300, columns: 64, rows: 40, pitch: 1.5, "
        "angles_deg: {start: 0, step: 6, count: 60}}\n"
    )
    for name in ("own.h5", "scan.yaml"):
        part = open_scan(tmp_path / name, slices=slice(10, 17))
        np.testing.assert_allclose(
            part.geometry.row_positions, CONE.row_positions[10:17], atol=1e-12
        )
        assert torch.equal(part.counts, scan.counts[:, 10:17])
        assert torch.equal(part.dead, scan.dead[:, 10:17])
        assert part.info["slices"] == [10, 17, 40]
        whole = ScanSlices(tmp_path / name).geometry
        np.testing.assert_allclose(whole.row_positions, CONE.row_positions, atol=1e-12)


def test_no_more_than_a_band_is_in_memory(tmp_path, monkeypatch):
    scan = made(CONE)
    scan.save(tmp_path / "scan.h5")
    plan = plan_slabs(CONE, GRID, 4_200_000)
    most, opened = max(high - low for low, high in plan.bands), []
    read = open_scan
    monkeypatch.setattr(
        slabs, "open_scan", lambda *a, **k: opened.append(read(*a, **k)) or opened[-1]
    )
    report = reconstruct_to(tmp_path / "scan.h5", GRID, tmp_path / "v.nii", memory=4_200_000)
    assert report["memory_bytes"] <= 4_200_000
    rows = [part.geometry.rows for part in opened]
    assert max(rows) <= most + 2 * slabs.HALO < 40
    assert 7 * 4 * 60 * 64 * max(rows) <= 4_200_000


def test_a_method_that_needs_the_whole_volume_is_named(tmp_path):
    with pytest.raises(ValueError, match="method='mbir' needs the whole volume at once: leave out"):
        reconstruct_to(made(CONE), GRID, tmp_path / "v.nii", "mbir", memory="1GB")
    with pytest.raises(ValueError, match="unknown method 'fpb'"):
        reconstruct_to(made(CONE), GRID, tmp_path / "v.nii", "fpb", memory="1GB")


def test_a_limit_that_is_too_small_names_the_smallest_that_works(tmp_path):
    scan = made(CONE)
    with pytest.raises(
        ValueError, match=r"memory=1MB is too little.*give memory=\d+MB or more"
    ) as error:
        reconstruct_to(scan, GRID, tmp_path / "v.nii", memory="1MB")
    smallest = re.search(r"give memory=(\d+)MB", str(error.value))[1]
    reconstruct_to(scan, GRID, tmp_path / "v.nii", memory=f"{smallest}MB")
    with pytest.raises(ValueError, match="too little"):
        plan_slabs(CONE, GRID, f"{int(smallest) - 1}MB")
    for bad in ("4 apples", "", "-1GB", 0):
        with pytest.raises(ValueError, match="memory must be"):
            plan_slabs(CONE, GRID, bad)


@pytest.mark.extended
@pytest.mark.parametrize("name", ["v.nii", "v.zarr"])
def test_killed_between_slabs(name, tmp_path, monkeypatch):
    """The finished slabs stay under a name that is not the volume's, and the next call goes on
    with them."""
    scan, path, memory = made(CONE), tmp_path / name, 4_200_000
    write = SlabFile.write

    def killed(self, data):
        write(self, data)
        raise KeyboardInterrupt

    def begin():
        with monkeypatch.context() as patch:
            patch.setattr(SlabFile, "write", killed)
            with pytest.raises(KeyboardInterrupt):
                reconstruct_to(scan, GRID, path, memory=memory)

    begin()
    assert not path.exists()
    assert (tmp_path / f"{name}.unfinished").exists()
    thick = plan_slabs(CONE, GRID, memory).slabs[0][1]
    report = reconstruct_to(scan, GRID, path, memory=2 * memory)  # with another limit, too
    assert report["resumed_at"] == thick
    whole = recon.reconstruct(scan, GRID)
    assert float((Volume.load(path).data - whole.data).abs().max()) <= 1e-4
    assert [p.name for p in tmp_path.iterdir()] == [name]
    # What was begun with other sources, or other settings, is begun anew.
    begin()
    with monkeypatch.context() as patch:
        patch.setattr(slabs, "source_digest", lambda module: "other")
        assert reconstruct_to(scan, GRID, path, memory=memory)["resumed_at"] == 0
    begin()
    assert reconstruct_to(scan, GRID, path, memory=memory, kernel="soft")["resumed_at"] == 0
    assert torch.equal(Volume.load(path).data, recon.reconstruct(scan, GRID, kernel="soft").data)


def test_a_full_disk(tmp_path, monkeypatch):
    scan, path = made(CONE), tmp_path / "v.nii"
    calls = []

    def full(handle):
        calls.append(handle)
        if len(calls) == 2:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("torchpcct.formats.volume_slabs.os.fsync", full)
    with pytest.raises(WriteError, match=r"cannot write .*v\.nii: No space left on device"):
        reconstruct_to(scan, GRID, path, memory=4_200_000)
    monkeypatch.undo()
    assert not path.exists()
    with pytest.raises(FileNotFoundError, match="does not exist"):
        reconstruct_to(scan, GRID, tmp_path / "none" / "v.nii")


def test_what_slabs_do_not_do_is_refused_by_name(tmp_path):
    scan, path = made(CONE), tmp_path / "v.nii"
    dead = torch.zeros(scan.counts.shape, dtype=torch.bool)
    dead[:, 6:15] = True
    bins = replace(scan, counts=scan.counts[None], air=scan.air[None])
    refused(
        ("couples all slices", lambda: reconstruct_to(scan, GRID, path, "pwls")),
        ("method='mbir' needs the whole volume", lambda: reconstruct_to(scan, GRID, path, "mbir")),
        (
            r"v\.nii\.gz' cannot be written slab",
            lambda: reconstruct_to(scan, GRID, tmp_path / "v.nii.gz"),
        ),
        ("needs a grid of as many", lambda: reconstruct_to(made(PARALLEL, slices=6), GRID, path)),
        ("cannot be read slice by slice", lambda: reconstruct_to(tmp_path / "s.prep", GRID, path)),
        (
            "dead near row",
            lambda: reconstruct_to(replace(scan, dead=dead), GRID, path, memory=4_200_000),
        ),
        ("4 axes", lambda: reconstruct_to(bins, GRID, path)),
    )
    assert not list(tmp_path.iterdir())


def test_ome_zarr_says_where_it_lies(tmp_path):
    grid = VolumeGrid((3, 4, 5), (1.5, 0.5, 0.25), (3.0, -7.0, 11.0))
    data = torch.randn(grid.shape)
    for _ in range(2):  # a second one takes the place of the first
        Volume(data, grid, {}, "mm^-1").save(tmp_path / "v.zarr")
    group = zarr.open_group(tmp_path / "v.zarr", mode="r")
    image = group.attrs["ome"]["multiscales"][0]
    assert group.attrs["ome"]["version"] == "0.5"
    assert image["axes"] == [{"name": n, "type": "space", "unit": "millimeter"} for n in "zyx"]
    scale, translation = image["datasets"][0]["coordinateTransformations"]
    assert (scale["scale"], translation["translation"]) == (
        [1.5, 0.5, 0.25],
        [float(a[0]) for a in grid.axes],
    )
    array = group[image["datasets"][0]["path"]]
    assert array.metadata.dimension_names == ("z", "y", "x")
    np.testing.assert_array_equal(array[...], data.numpy())
    loaded = Volume.load(tmp_path / "v.zarr")
    assert (loaded.grid, loaded.unit) == (grid, "mm^-1")
    (tmp_path / "v.zarr" / "zarr.json").write_text("{}")
    with pytest.raises(ValueError, match="cannot be read as an OME-Zarr"):
        Volume.load(tmp_path / "v.zarr")


@pytest.mark.parametrize("name", ["notes.txt", "0/c/0/0/0.txt", "labels/zarr.json", "link"])
def test_a_folder_with_files_of_others_is_not_replaced(tmp_path, name):
    folder, grid = tmp_path / "v.zarr", VolumeGrid((3, 4, 5), 1.0)
    volume = Volume(torch.zeros(grid.shape), grid, {})
    volume.save(folder)
    if name == "link":
        folder.rename(tmp_path / "far.zarr")
        folder.symlink_to(tmp_path / "far.zarr", target_is_directory=True)
    else:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("mine")
    before = {path: path.is_file() and path.read_bytes() for path in tmp_path.rglob("*")}
    for write in (volume.save, lambda path: SlabFile(path, grid, "HU", "key", 1)):
        with pytest.raises(
            FileExistsError, match="link to a folder" if name == "link" else "did not write there"
        ):
            write(folder)
    assert {path: path.is_file() and path.read_bytes() for path in tmp_path.rglob("*")} == before


@pytest.mark.parametrize(
    "name", ["v.nii.unfinished", "v.nii.unfinished.json", "v.zarr.unfinished/notes.txt"]
)
def test_files_of_others_with_the_names_of_an_unfinished_volume_stay(tmp_path, name):
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_text('{"key": "mine"}')
    with pytest.raises(FileExistsError, match="is not an unfinished volume of torchpcct: move it"):
        SlabFile(
            tmp_path / name.partition(".unfinished")[0], VolumeGrid((3, 4, 5), 1.0), "HU", "key", 1
        )
    assert [p.name for p in tmp_path.rglob("*") if p.is_file()] == [path.name]
    assert path.read_text() == '{"key": "mine"}'


def test_nifti_is_that_of_a_whole_volume(tmp_path):
    scan = made(PARALLEL, slices=6)
    reconstruct_to(scan, STACK, tmp_path / "slabs.nii", memory=250_000)
    recon.reconstruct(scan, STACK).save(tmp_path / "whole.nii")
    assert (tmp_path / "slabs.nii").read_bytes() == (tmp_path / "whole.nii").read_bytes()
    assert nibabel.load(tmp_path / "slabs.nii").header.get_zooms() == (1.0, 1.0, 1.0)


def test_the_plan_of_a_volume_of_2048_cubed():
    geometry, grid = (
        ParallelBeam(np.arange(3000) * math.pi / 3000, 2048, 0.01),
        VolumeGrid((2048, 2048, 2048), 0.01),
    )
    plan = plan_slabs(geometry, grid, "4GB")
    assert plan.memory <= 4e9
    assert plan.written == 4 * 2048**3
    assert plan.read == 2 * 4 * 3000 * 2048 * 2048  # once to look at it, once to reconstruct
    assert plan.slabs[0][0] == 0
    assert plan.slabs[-1][1] == 2048
    assert all(a[1] == b[0] for a, b in zip(plan.slabs, plan.slabs[1:], strict=False))
    assert re.search(
        r"\d+ slabs of up to \d+ slices, .* writes 34\.36 GB, about \d+ s on one core", str(plan)
    )


def test_on_the_command_line(here, cli):
    made(CONE).save("scan.h5")
    start = "reconstruct scan.h5 --voxel 1 --out v.zarr --no-progress --memory"
    assert re.search(r"v\.zarr: \d+ slabs of up to \d+ slices", cli(f"{start} 4.2MB --dry-run"))
    assert "readings, rotation axis and edges were tested in rows" in cli(f"{start} 4.3MB")
    cli("reconstruct scan.h5 --voxel 1 --out whole.nii")
    assert float((Volume.load("v.zarr").data - Volume.load("whole.nii").data).abs().max()) <= 1e-4
    assert "--clean is not done slab by slab" in cli(f"{start} 4.3MB --clean", 2)
    assert "give --axis COLUMN" in cli(f"{start} 4.3MB --find-axis", 2)


LIMITED = """
import resource, sys
resource.setrlimit(resource.RLIMIT_DATA, (10**9, 10**9))
from torchpcct import VolumeGrid
from recon.slabs import reconstruct_to
reconstruct_to(sys.argv[1], VolumeGrid((512, 512, 512), 0.155), sys.argv[2], memory="850MB")
# Not ru_maxrss, which begins with the memory of the process that started this one.
print(next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM")))
"""


@pytest.mark.slow
def test_512_cubed_within_a_gigabyte(tmp_path):
    """Of the process, with all that it imports (some 0.4 GB): the volume and the readings are 0.5
    and 0.25 GB.

    The limit counts what is asked for, ``memory`` what is used."""
    geometry = ConeBeam(full_turn(240), 400.0, 600.0, 512, 512, 0.375)
    u, v = np.meshgrid(geometry.column_positions, geometry.row_positions)
    counts, rng = np.empty(geometry.shape, np.float32), np.random.default_rng(0)
    for k, angle in enumerate(geometry.angles):
        c, s = math.cos(angle), math.sin(angle)
        ray = np.stack([-600 * c - u * s, -600 * s + u * c, v], -1)
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
        lines = 0.0
        for mu, radius, at in (
            (0.02, 45.0, (0, 0, 0)),
            (0.01, 8.0, (20, 10, 15)),
            (0.03, 6.0, (-25, 5, -30)),
        ):
            source = np.array([400 * c, 400 * s, 0.0]) - at
            along = ray @ source
            lines = lines + 2 * mu * np.sqrt(np.maximum(along**2 - source @ source + radius**2, 0))
        counts[k] = rng.poisson(3e4 * np.exp(-lines))
    counts[:, 100, 200] = 0
    scan = Scan.from_counts(counts, geometry, air=3e4, gain=1.0, mu_water=0.02)
    scan.save(tmp_path / "scan.h5")
    del counts
    done = run_python(LIMITED, tmp_path / "scan.h5", tmp_path / "v.nii")
    assert 1024 * int(done.stdout) <= 1e9
    whole = recon.reconstruct(scan, VolumeGrid((512, 512, 512), 0.155))
    assert float((Volume.load(tmp_path / "v.nii").data - whole.data).abs().max()) <= 1e-4
