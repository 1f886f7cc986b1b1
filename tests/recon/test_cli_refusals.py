"""The command line under bad input and bad circumstances: at once, in words, and nothing left behind."""

import io
import json
import os
import resource
import shutil
import time
from types import SimpleNamespace

import h5py
import nibabel
import numpy as np
import pytest
import torch
from fresh_python import run_python

from recon.cli import main
from recon.evaluate.store import Store
from torchpcct import ParallelBeam, Scan, Volume, VolumeGrid
from torchpcct.files import _part, atomic_write, require_writable


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["reconstruct", "{tmp}/f", "--voxel", "1e-9", "--out", "{tmp}/a.h5"], "--voxel makes 1000000000"),
        (["reconstruct", "{tmp}/f", "--extent", "inf", "1", "1", "--out", "{tmp}/a.h5"], "--extent[0] must be finite"),
        (["reconstruct", "{tmp}/f", "--extent", "1", "-1", "1", "--out", "{tmp}/a.h5"], "--extent[1] must be greater"),
        (["reconstruct", "{tmp}/f", "--center", "1", "nan", "1", "--out", "{tmp}/a.h5"], "--center[1] must be finite"),
        (["reconstruct", "{tmp}/f", "--out", "{tmp}/a.h5"], "unknown scan format 'f'"),
        (["reconstruct", "{tmp}/f", "--out", "{tmp}/none/a.h5"], "create it first"),
        (["reconstruct", "{tmp}/f", "--tissues", "--out", "{tmp}/a.h5"], "--tissues is an option of --method mbir"),
        (["reconstruct", "{tmp}/f", "--method", "pwls", "--fidelity", "0", "--out", "{tmp}/a.h5"], "not of pwls"),
        (["simulate", "--views", "0", "--out", "{tmp}/a.h5"], "--views must be at least 1"),
        (["simulate", "--exposure", "nan", "--out", "{tmp}/a.h5"], "--exposure must be finite"),
        (["compare", "--out", "{tmp}/f"], "is a file"),
        (["study", "noise", "--seed", "-3", "--out", "{tmp}/o"], "seed must be at least 0"),
        (["study", "noise", "--out", "{tmp}/f/g"], "cannot write into"),
        (["compare", "--device", "cuda", "--out", "{tmp}/o"], "use --device cpu"),
        (["simulate", "--out", "{tmp}/a.png"], "unknown ending of 'a.png'"),
        (["simulate", "--config", "{tmp}/none.yaml", "--out", "{tmp}/a.h5"], "none.yaml"),
        (["reconstruct", "{tmp}", "--method", "art", "--out", "{tmp}/a.h5"], "unknown method 'art'"),
        (["view", "{tmp}/none.h5", "--out", "{tmp}/a.bmp"], "unknown ending of 'a.bmp'"),
        (["info", "{tmp}/none.h5"], "none.h5"),
        (["simulate", "--exposure", "0", "--out", "{tmp}/a.h5"], "--exposure must be greater than 0 s"),
        (["simulate", "--seed", "-1", "--exposure", "1", "--out", "{tmp}/a.h5"], "seed"),
        (["reconstruct", "{tmp}/none.h5", "--out", "{tmp}/a.png"], "unknown volume format"),
        (["reconstruct", "{tmp}/none.h5", "--voxel", "0", "--out", "{tmp}/a.h5"], "--voxel must be greater than 0 mm"),
        (["plaque", "{tmp}/none.h5", "--out", "{tmp}/a"], "none.h5"),
    ],
)
def test_refusals_name_value_and_remedy_and_leave_nothing(tmp_path, capsys, arguments, message):
    (tmp_path / "f").write_bytes(b"no scan")
    assert main([a.format(tmp=tmp_path) for a in arguments]) == 2
    assert message in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["f"]


def test_help_and_refusals_load_neither_torch_nor_numba():
    code = (
        "import sys, contextlib\nfrom recon.cli import main\n"
        "for a in (['--help'], ['simulate', '--views', '0', '--out', 'a.h5'], ['reconstruct', 'x', '--voxel', '0', "
        "'--out', 'a.h5']):\n"
        "    with contextlib.suppress(SystemExit): main(a)\n"
        "print('LOADED', sorted({'torch', 'numba', 'scipy'} & set(sys.modules)))"
    )
    assert "LOADED []" in run_python(code).stdout


def test_what_a_killed_process_left_is_swept_by_the_next_write(tmp_path):
    process = int(run_python("import os; print(os.getpid())").stdout)
    old, mine, other = (_part(tmp_path / "v.h5", n) for n in (process, os.getppid(), 1))
    elsewhere = tmp_path / f".{process}-ffffff-00000000.part.v.h5"  # of another machine: who knows whether it lives?
    for part in (old, mine, other, elsewhere):
        part.write_bytes(b"half")
        os.utime(part, (time.time() - 3600,) * 2)
    series, fresh = _part(tmp_path / "v.h5", process), _part(tmp_path / "w.h5", process)
    series.mkdir()
    (series / "0001.dcm").write_bytes(b"half")
    os.utime(series, (time.time() - 3600,) * 2)
    fresh.write_bytes(b"half")
    for name in ("v.h5", "w.h5"):
        with atomic_write(tmp_path / name) as part:
            part.write_bytes(b"whole")
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(
        [mine.name, other.name, elsewhere.name, fresh.name, "v.h5", "w.h5"]
    )


def test_folders_that_cannot_be_written_are_refused(tmp_path, monkeypatch):
    require_writable(tmp_path / "a" / "b")
    assert (tmp_path / "a" / "b").is_dir()
    (tmp_path / "f").write_text("")
    with pytest.raises(NotADirectoryError, match="is a file"):
        require_writable(tmp_path / "f")

    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("tempfile.TemporaryFile", refuse)
    with pytest.raises(PermissionError, match="name another folder"):
        require_writable(tmp_path)


def test_damaged_pieces_are_computed_again(tmp_path, monkeypatch):
    """Of 600 damaged pieces 5 stopped the study, and 2 came back incomplete."""
    monkeypatch.setattr(os, "fsync", lambda handle: None)  # a disk is slow, and not what is tested
    arrays = {"a": np.arange(7.0), "b": np.ones((2, 3), np.float32)}
    store = Store(tmp_path)
    store.piece("p", "key", lambda: arrays)
    good = (tmp_path / "p.npz").read_bytes()
    assert store.piece("p", "key", pytest.fail)["a"].tolist() == list(range(7))
    rng = np.random.default_rng(0)
    for trial in range(600):
        content = bytearray(good)
        at = int(rng.integers(len(good)))
        if trial % 3 == 0:
            content[at] ^= 1 << int(rng.integers(8))
        elif trial % 3 == 1:
            del content[at:]
        else:
            content[at : at + 40] = rng.integers(0, 256, len(content[at : at + 40]), dtype=np.uint8).tobytes()
        (tmp_path / "p.npz").write_bytes(bytes(content))
        found = store.piece("p", "key", lambda: arrays)
        assert sorted(found) == ["a", "b"]
        assert all(np.array_equal(found[k], arrays[k]) for k in arrays)
    # A sound archive that lacks a part, and one with another value.
    with np.load(io.BytesIO(good)) as file:
        seal = {k: file[k] for k in ("key", "sum")}
        parts = {k: file[k] for k in file.files if k not in seal}
    assert "a0" in parts
    for other in ({k: v for k, v in parts.items() if k != "a1"}, {**parts, "a0": parts["a0"] + 1e-12}):
        np.savez(tmp_path / "p.npz", **seal, **other)
        assert sorted(store.piece("p", "key", lambda: arrays)) == ["a", "b"]
        assert np.array_equal(store.piece("p", "key", pytest.fail)["a"], arrays["a"])


def test_a_package_that_nobody_can_write_names_numbas_variable(monkeypatch):
    import torchpcct

    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.warns(RuntimeWarning, match="set NUMBA_CACHE_DIR"):
        torchpcct._check_cache("/usr/lib/torchpcct", "/nobody/.cache/numba")
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/tmp")
    torchpcct._check_cache("/usr/lib/torchpcct", "/nobody/.cache/numba")


@pytest.fixture(scope="module")
def lines(tmp_path_factory):
    """A scan of one slice and one of two slices in a folder, to be copied."""
    folder = tmp_path_factory.mktemp("lines")
    geometry = ParallelBeam(np.arange(24) * np.pi / 24, 12, 1.0)
    one = np.tile(0.1 * (np.abs(np.arange(12) - 5.5) < 3), (24, 1))
    two = np.stack([one, one])
    Scan.from_line_integrals(one, geometry, photons=1e4).save(folder / "one.h5")
    Scan.from_line_integrals(two, geometry, photons=1e4, mu_water=0.02).save(folder / "two.h5")
    return folder


def _contents(folder):
    return {p.name: p.read_bytes() for p in folder.iterdir()}


def test_no_command_writes_onto_what_it_reads(tmp_path, lines, capsys):
    shutil.copy(lines / "one.h5", tmp_path / "one.h5")
    shutil.copy(lines / "one.h5", tmp_path / "v.h5.yaml")  # any content: it is never read
    (tmp_path / "link.h5").symlink_to("one.h5")
    os.link(tmp_path / "one.h5", tmp_path / "hard.h5")
    (tmp_path / "a.h5.yaml").write_text("scene: {kind: water}", encoding="utf-8")
    Volume(torch.zeros(2, 2, 2), VolumeGrid((2, 2, 2), 1.0)).save(tmp_path / "patient.h5")
    (tmp_path / "b.yaml").write_text("scene: {kind: volume, file: patient.h5}", encoding="utf-8")
    before = _contents(tmp_path)
    for command in (
        "reconstruct one.h5 --out one.h5",
        "reconstruct one.h5 --out link.h5",
        "reconstruct link.h5 --out one.h5",
        "reconstruct one.h5 --out hard.h5",
        "reconstruct one.h5 --geometry v.h5.yaml --out v.h5",
        "lower-dose one.h5 --fraction 0.5 --out link.h5",
        "simulate --config a.h5.yaml --out a.h5",
        "simulate --config b.yaml --out patient.h5",
        "view one.h5 --out b.png",
    ):
        words = [str(tmp_path / w) if w.endswith((".h5", ".yaml", ".png")) else w for w in command.split()]
        if words[0] == "view":
            os.link(tmp_path / "one.h5", tmp_path / "b.png")
            before = _contents(tmp_path)
        assert main([*words, "--force"]) == 2, command
        assert "which is read: name another file" in capsys.readouterr().err
        assert _contents(tmp_path) == before


def test_files_of_others_are_replaced_by_force_only(tmp_path, lines, capsys):
    scan = str(lines / "two.h5")
    nibabel.save(nibabel.Nifti1Image(np.zeros((2, 2, 2), np.float32), np.eye(4)), tmp_path / "patient.nii.gz")
    with h5py.File(tmp_path / "tooth.h5", "w") as file:
        file["exchange/data"] = np.zeros(3)
    (tmp_path / "w.mha.json").write_text('{"mine": 1}', encoding="utf-8")
    (tmp_path / "x.nii.yaml").write_text("mine: 1", encoding="utf-8")
    (tmp_path / "picture.png").write_text("no picture", encoding="utf-8")
    (tmp_path / "study").mkdir()
    (tmp_path / "study" / "report.md").write_text("mine", encoding="utf-8")
    (tmp_path / "d.nii").mkdir()
    before = _contents(tmp_path / "study")
    for words, expected_text in (
        (["reconstruct", scan, "--out", "patient.nii.gz"], "patient.nii.gz exists and was not made by torchpcct recon"),
        (["reconstruct", scan, "--out", "tooth.h5"], "tooth.h5 exists and was not made by torchpcct reconstruct: name"),
        (["reconstruct", scan, "--out", "w.mha"], "w.mha.json exists"),
        (["reconstruct", scan, "--out", "x.nii"], "x.nii.yaml exists"),
        (["reconstruct", scan, "--out", "d.nii"], "is a folder"),
        (["simulate", "--out", "tooth.h5"], "tooth.h5 exists and was not made by torchpcct simulate"),
        (["lower-dose", scan, "--fraction", "0.5", "--out", "tooth.h5"], "not made by torchpcct lower-dose"),
        (["view", scan, "--out", "picture.png"], "picture.png exists and was not made"),
        (["study", "noise", "--quick", "--out", "study"], "study holds report.md, not made by torchpcct study"),
        (["compare", "--quick", "--out", "study"], "not made by torchpcct compare: name another folder, or --force"),
        (["plaque", scan, "--out", "study"], "study holds report.md, not made by torchpcct plaque"),
    ):
        words[-1] = str(tmp_path / words[-1])
        assert main(words) == 2, words
        assert expected_text in capsys.readouterr().err
    assert _contents(tmp_path / "study") == before
    for name in ("patient.nii.gz", "w.mha", "x.nii"):
        command = ["reconstruct", scan, "--out", str(tmp_path / name)]
        assert main([*command, "--force"]) == 0
        assert main(command) == 0  # ours by now
        assert Volume.load(tmp_path / name).grid.shape[0] == 2


def test_a_result_that_cannot_be_written_is_found_before_it_is_computed(tmp_path, lines, capsys, monkeypatch):
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=100_000))
    monkeypatch.setattr("recon.api.reconstruct", lambda *_, **__: pytest.fail("computed"))
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "a").write_text("")
    one, two = str(lines / "one.h5"), str(lines / "two.h5")
    for words, expected_text in (
        ([one, "--out", "series"], "a DICOM CT series holds HU, this volume is in mm^-1"),
        ([two, "--out", "full"], "is not empty: series in one folder mix"),
        ([two, "--out", "slice.dcm"], "a DICOM series is a folder"),
        ([one, "--extent", "2", "4", "4", "--out", "a.h5"], "--extent takes two numbers, Y X"),
        ([one, "--center", "2", "4", "4", "--out", "a.h5"], "--center takes two numbers, Y X"),
        ([one, "--extent", "4", "--out", "a.h5"], "of slices two, Y X; got 1"),
        ([two, "--voxel", "0.01", "--extent", "3", "3", "--out", "a.h5"], "a.h5 needs 0.00 GiB, 0.00 GiB are free"),
    ):
        assert main(["reconstruct", *words[:-1], str(tmp_path / words[-1])]) == 2, words
        assert expected_text in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["full"]


def test_one_slice_is_a_volume_of_one_slice(tmp_path, lines):
    for name in ("v.nii.gz", "v.mha", "v.h5"):
        grid = ["--voxel", "0.5", "--extent", "4", "5", "--center", "1", "2"]
        assert main(["reconstruct", str(lines / "one.h5"), *grid, "--out", str(tmp_path / name)]) == 0
        found = Volume.load(tmp_path / name).grid
        np.testing.assert_allclose([*found.shape, *found.spacing, *found.center], [1, 8, 10, 0.5, 0.5, 0.5, 0, 1, 2])
        assert json.loads((tmp_path / f"{name}.json").read_text())["shape"] == [1, 8, 10]
    grid = ["--extent", "4", "4", "--center", "7", "0", "0"]
    assert main(["reconstruct", str(lines / "two.h5"), *grid, "--out", str(tmp_path / "series")]) == 0
    assert Volume.load(tmp_path / "series").grid.center == (7.0, 0.0, 0.0)


def test_a_dicom_slice_is_shown(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    data = 300 * torch.arange(2.0 * 6 * 5).reshape(2, 6, 5) / 60
    Volume(data, VolumeGrid((2, 6, 5), (2.5, 1.0, 1.0))).save("series")
    shutil.copy("series/0002.dcm", "IM2")
    for name in ("series/0002.dcm", "IM2"):
        assert main(["info", name]) == 0
        assert "shape: [1, 6, 5]\nspacing_mm: [2.5, 1.0, 1.0]" in capsys.readouterr().out
        assert main(["view", name]) == 0
    assert sorted(p.name for p in tmp_path.glob("*.png")) == ["0002.png", "IM2.png"]


def test_a_full_disk_is_one_sentence_and_status_1(tmp_path, lines, capsys):
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (300, limits[1]))
    try:
        for name in ("v.h5", "v.nii.gz", "v.mha", "series"):
            assert main(["reconstruct", str(lines / "two.h5"), "--out", str(tmp_path / name)]) == 1
            assert capsys.readouterr().err == f"torchpcct reconstruct: cannot write {tmp_path / name}: File too large\n"
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert list(tmp_path.iterdir()) == []
