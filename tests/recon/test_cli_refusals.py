"""The command line under bad input and bad circumstances: at once, in words, and nothing left
behind."""

import io
import json
import os
import re
import resource
import shlex
import shutil
import socket
import time
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import h5py
import nibabel
import numpy as np
import pytest
import torch
from fresh_python import run_python

from recon.cli import _parser
from recon.cli.parsing import check_limits
from recon.cli.scan_options import length
from recon.jobs.store import Store
from recon.study import registry
from torchpcct import ParallelBeam, Scan, Volume, VolumeGrid
from torchpcct.files import _part, atomic_write, require_writable
from train.__main__ import _parser as train_parser


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("reconstruct f --voxel 1e-9 --out a.h5", "--voxel makes 1000000000"),
        ("reconstruct f --extent inf 1 1 --out a.h5", "--extent[0] must be finite"),
        ("reconstruct f --extent 1 -1 1 --out a.h5", "--extent[1] must be greater"),
        ("reconstruct f --center 1 nan 1 --out a.h5", "--center[1] must be finite"),
        ("reconstruct f --out a.h5", "unknown scan format 'f'"),
        ("reconstruct f --out none/a.h5", "create it first"),
        ("reconstruct f --tissues --out a.h5", "--tissues is an option of --method mbir"),
        ("reconstruct f --method pwls --fidelity 0 --out a.h5", "not of pwls"),
        ("simulate --views 0 --out a.h5", "--views must be at least 1"),
        ("simulate --exposure nan --out a.h5", "--exposure must be finite"),
        ("compare --out f", "is a file"),
        ("study noise --seed -3 --out o", "seed must be at least 0"),
        ("study noise --out f/g", "cannot write into"),
        ("compare --device cuda --out o", "use --device cpu"),
        ("simulate --out a.png", "unknown ending of 'a.png'"),
        ("simulate --config none.yaml --out a.h5", "none.yaml"),
        ("reconstruct . --method art --out a.h5", "unknown method 'art'"),
        ("view none.h5 --out a.bmp", "unknown ending of 'a.bmp'"),
        ("info none.h5", "none.h5"),
        ("simulate --exposure 0 --out a.h5", "--exposure must be greater than 0 s"),
        ("simulate --seed -1 --exposure 1 --out a.h5", "seed"),
        ("reconstruct none.h5 --out a.png", "unknown volume format"),
        ("reconstruct none.h5 --voxel 0 --out a.h5", "--voxel must be greater than 0 mm"),
        ("plaque none.h5 --out a", "none.h5"),
        ("reconstruct p*.h5 --out a.h5", "p*.h5 does not exist (the shell replaces a pattern:"),
        ("view v?.nii --out a.png", "no such file: v?.nii (the shell replaces a pattern: write"),
        ("evaluate --scans s[0-9].h5 --out a", "without quotes, or does no file match?)"),
    ],
)
def test_refusals_name_value_and_remedy_and_leave_nothing(here, cli, words, message):
    (here / "f").write_bytes(b"no scan")
    assert message in cli(words, 2)
    assert [p.name for p in here.iterdir()] == ["f"]


_LIGHT = """\
--help
simulate --views 0 --out a.h5
simulate --config none.yaml --out a.h5
reconstruct x --voxel 0 --out a.h5
reconstruct f.h5 --method art
reconstruct f.h5 --kernel sotf
reconstruct f.h5 --fidelity 2
reconstruct f.h5 --memory 4XB
reconstruct f.h5 --slices 3
reconstruct f.h5 --workers 0
reconstruct f.h5 --scheduler nowhere
reconstruct f.h5 --threads 2 --workers -1
lower-dose f.h5 --fraction 0
info none.h5
view none.nii
plaque f.h5 --wall 0 -1
evaluate --task nodul
evaluate --task none.yaml
evaluate --method fbp:sotf
evaluate --method mbir:fidelity=2
evaluate --method mbir:weights=none
evaluate --method files:nowhere
evaluate --method pwls:x
evaluate --denoiser mine.nets:run@pwls
evaluate --scans none.h5
evaluate --n 7
dose-factor --exposure 0
compare --methods mbri
hardcases --methods art
hardcases --cases lost-0.2
study nosie
study noise --set view=3
study hardcases --set views
study spectral --set energy=3
verify --again nosie
train --steps 0
train --weights none
"""


def test_help_and_refusals_load_neither_torch_nor_numba(tmp_path):
    (tmp_path / "f.h5").write_bytes(b"no scan")
    code = (
        "import sys, contextlib, shlex\nfrom recon.cli import main\n"
        f"for words in {_LIGHT.splitlines()}:\n"
        "    with contextlib.suppress(SystemExit): main(shlex.split(words))\n"
        "print('LOADED', sorted({'torch', 'numba', 'scipy'} & set(sys.modules)))"
    )
    done = run_python(code, cwd=tmp_path)
    assert "LOADED []" in done.stdout
    assert len(done.stderr.splitlines()) == len(_LIGHT.splitlines()) - 1, done.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["f.h5"]


_FIRST = {
    "reconstruct": ["s"],
    "calibrate": ["s"],
    "lower-dose": ["s"],
    "view": ["v"],
    "info": ["f"],
    "plaque": ["s"],
    "study": ["noise"],
}


def _parsers():
    return {**_parser()[1].choices, "train": train_parser()}


def _options():
    """Every option of every command that takes a value, with what else the command needs."""
    for name, parser in _parsers().items():
        needed = [a.option_strings[0] for a in parser._actions if a.required and a.option_strings]
        for action in parser._actions:
            if action.option_strings and action.nargs != 0:
                words = [f"{flag}=0.5" for flag in needed if flag not in action.option_strings]
                yield name, parser, action, [*words, *_FIRST.get(name, [])]


def _refused(parser, action, words, value):
    """Whether a value ends with status 2, or with a sentence of :func:`check_limits` that names
    the option."""
    flag, count = action.option_strings[0], action.nargs if isinstance(action.nargs, int) else 1
    given = [f"{flag}={value}"] if count == 1 else [flag, *[value] * count]
    try:
        arguments = parser.parse_args([*words, *given])
        parser.read.clear()
        check_limits(arguments, parser)
    except SystemExit as stop:
        return stop.code == 2
    except ValueError as error:
        return str(error).startswith(flag)
    return False


def test_every_number_of_the_command_line_has_limits(capsys):
    numbers = [option for option in _options() if option[2].type in (int, float, length)]
    assert len(numbers) > 60
    values = ("nan", "inf", "-inf", "1e400", "1e30", "9" * 40, "x")
    assert not [
        (n, a.dest, v) for n, p, a, words in numbers for v in values if not _refused(p, a, words, v)
    ]
    # Below 0 are places, grey values and HU alone.
    below = {
        action.dest
        for _, parser, action, words in numbers
        if not _refused(parser, action, words, "-3")
    }
    assert below == {"center", "level", "point", "wall", "fibrous"}
    assert all(line.startswith("torchpcct ") for line in capsys.readouterr().err.splitlines())


def test_no_option_takes_an_empty_text(capsys):
    assert not [
        (n, a.dest)
        for n, p, a, words in _options()
        for v in ("", "  ")
        if not _refused(p, a, words, v)
    ]
    assert all(line.startswith("torchpcct ") for line in capsys.readouterr().err.splitlines())


def test_the_examples_of_studies_are_settings_that_they_take():
    """One named a field that the study does not have."""
    for name in ("study", "compare", "hardcases"):
        examples = re.findall(r"^  torchpcct (.*)$", _parsers()[name].epilog, re.MULTILINE)
        assert examples
        for line in examples:
            given = _parser()[0].parse_args(shlex.split(line))
            if name == "study":
                assert registry.build_settings(given.name, quick=given.quick, changes=given.changes)
            else:
                values = {key: value for key, value in vars(given).items() if value is not None}
                assert registry.settings_class(name).of(values, given.quick)
    assert (
        f"(default {registry.settings_class('hardcases')().views})"
        in _parsers()["hardcases"].format_help()
    )


def test_a_scan_alone_is_given_to_the_workers_that_were_asked_for(here, lines, cli, monkeypatch):
    shutil.copy(lines / "one.h5", "one.h5")
    for words, message in (
        ("--workers 0", "--workers must be at least 1, got 0"),
        ("--threads 0 --workers 1", "--threads must be at least 1"),
        ("--threads 2", "--threads K applies to workers"),
        ("--scheduler nowhere", "'nowhere' is neither an address"),
    ):
        assert message in cli(f"reconstruct one.h5 {words}", 2)
    assert [p.name for p in here.iterdir()] == ["one.h5"]
    asked = []
    monkeypatch.setattr(
        "recon.jobs.execute.Processes", lambda *n: asked.append(n[:2]) or ThreadPoolExecutor(1)
    )
    assert "one_fbp.nii.gz: 1 × " in cli("reconstruct one.h5 --workers 3 --threads 2")
    assert asked == [(3, 2)]
    assert {p.name for p in here.iterdir() if not p.name.startswith("jobs-")} == {
        "one.h5",
        "one_fbp.nii.gz",
        "one_fbp.nii.gz.json",
        "one_fbp.nii.gz.yaml",
    }
    assert "unknown kernel" in cli("reconstruct one.h5 --workers 1 --kernel sotf", 2)


@pytest.mark.cluster
def test_a_scheduler_that_is_gone_is_said(here, lines, cli, monkeypatch):
    monkeypatch.setattr("recon.jobs.execute._ANSWER_S", 1.0)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    said = cli(
        f"reconstruct {lines / 'one.h5'} --scheduler tcp://127.0.0.1:{port} --out one.nii", 2
    )
    assert re.fullmatch(
        rf"torchpcct reconstruct: no Dask scheduler answers at \S+:{port} within 1 s\n", said
    )
    assert not (here / "one.nii").exists()


def test_what_a_killed_process_left_is_swept_by_the_next_write(tmp_path):
    process = int(run_python("import os; print(os.getpid())").stdout)
    old, mine, other = (_part(tmp_path / "v.h5", n) for n in (process, os.getppid(), 1))
    # of another machine: who knows whether it lives?
    elsewhere = tmp_path / f".{process}-ffffff-00000000.part.v.h5"
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


def test_damaged_results_are_computed_again(tmp_path, monkeypatch):
    """Of 600 damaged files 5 stopped the study, and 2 came back incomplete."""
    monkeypatch.setattr(os, "fsync", lambda handle: None)  # a disk is slow, and not what is tested
    arrays = {"a": np.arange(7.0), "b": np.ones((2, 3), np.float32)}
    store = Store(tmp_path)
    store.cached("p", "key", lambda: arrays)
    good = (tmp_path / "p.npz").read_bytes()
    assert store.cached("p", "key", pytest.fail)["a"].tolist() == list(range(7))
    rng = np.random.default_rng(0)
    for trial in range(600):
        content = bytearray(good)
        at = int(rng.integers(len(good)))
        if trial % 3 == 0:
            content[at] ^= 1 << int(rng.integers(8))
        elif trial % 3 == 1:
            del content[at:]
        else:
            content[at : at + 40] = rng.integers(
                0, 256, len(content[at : at + 40]), dtype=np.uint8
            ).tobytes()
        (tmp_path / "p.npz").write_bytes(bytes(content))
        found = store.cached("p", "key", lambda: arrays)
        assert sorted(found) == ["a", "b"]
        assert all(np.array_equal(found[k], arrays[k]) for k in arrays)
    # A sound archive that lacks a part, and one with another value.
    with np.load(io.BytesIO(good)) as file:
        seal = {k: file[k] for k in ("key", "sum")}
        parts = {k: file[k] for k in file.files if k not in seal}
    assert "a0" in parts
    for other in (
        {k: v for k, v in parts.items() if k != "a1"},
        {**parts, "a0": parts["a0"] + 1e-12},
    ):
        np.savez(tmp_path / "p.npz", **seal, **other)
        assert sorted(store.cached("p", "key", lambda: arrays)) == ["a", "b"]
        assert np.array_equal(store.cached("p", "key", pytest.fail)["a"], arrays["a"])


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


def test_no_command_writes_onto_what_it_reads(here, lines, cli):
    shutil.copy(lines / "one.h5", "one.h5")
    shutil.copy(lines / "one.h5", "v.h5.yaml")  # any content: it is never read
    (here / "link.h5").symlink_to("one.h5")
    os.link("one.h5", "hard.h5")
    os.link("one.h5", "b.png")
    (here / "a.h5.yaml").write_text("scene: {kind: water}", encoding="utf-8")
    Volume(torch.zeros(2, 2, 2), VolumeGrid((2, 2, 2), 1.0)).save("patient.h5")
    (here / "b.yaml").write_text("scene: {kind: volume, file: patient.h5}", encoding="utf-8")
    before = _contents(here)
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
        assert "which is read: name another file" in cli(f"{command} --force", 2)
        assert _contents(here) == before


def test_files_of_others_are_replaced_by_force_only(here, lines, cli):
    scan = lines / "two.h5"
    nibabel.save(
        nibabel.Nifti1Image(np.zeros((2, 2, 2), np.float32), np.eye(4)), here / "patient.nii.gz"
    )
    with h5py.File(here / "tooth.h5", "w") as file:
        file["exchange/data"] = np.zeros(3)
    (here / "w.mha.json").write_text('{"mine": 1}', encoding="utf-8")
    (here / "x.nii.yaml").write_text("mine: 1", encoding="utf-8")
    (here / "picture.png").write_text("no picture", encoding="utf-8")
    (here / "study").mkdir()
    (here / "study" / "report.md").write_text("mine", encoding="utf-8")
    (here / "d.nii").mkdir()
    before = _contents(here / "study")
    for words, expected_text in (
        (
            f"reconstruct {scan} --out patient.nii.gz",
            "patient.nii.gz exists and was not made by torchpcct recon",
        ),
        (
            f"reconstruct {scan} --out tooth.h5",
            "tooth.h5 exists and was not made by torchpcct reconstruct: name",
        ),
        (f"reconstruct {scan} --out w.mha", "w.mha.json exists"),
        (f"reconstruct {scan} --out x.nii", "x.nii.yaml exists"),
        (f"reconstruct {scan} --out d.nii", "is a folder"),
        ("simulate --out tooth.h5", "tooth.h5 exists and was not made by torchpcct simulate"),
        (f"lower-dose {scan} --fraction 0.5 --out tooth.h5", "not made by torchpcct lower-dose"),
        (f"view {scan} --out picture.png", "picture.png exists and was not made"),
        ("study noise --quick --out study", "study holds report.md, not made by torchpcct study"),
        (
            "compare --quick --out study",
            "not made by torchpcct compare: name another folder, or --force",
        ),
        (f"plaque {scan} --out study", "study holds report.md, not made by torchpcct plaque"),
    ):
        assert expected_text in cli(words, 2)
    assert _contents(here / "study") == before
    for name in ("patient.nii.gz", "w.mha", "x.nii"):
        cli(f"reconstruct {scan} --out {name} --force")
        cli(f"reconstruct {scan} --out {name}")  # ours by now
        assert Volume.load(name).grid.shape[0] == 2


def test_a_result_that_cannot_be_written_is_found_before_it_is_computed(
    here, lines, cli, monkeypatch
):
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=100_000))
    monkeypatch.setattr("recon.api.reconstruct", lambda *_, **__: pytest.fail("computed"))
    (here / "full").mkdir()
    (here / "full" / "a").write_text("")
    one, two = lines / "one.h5", lines / "two.h5"
    for words, expected_text in (
        (f"{one} --out series", "a DICOM CT series holds HU, this volume is in mm^-1"),
        (f"{two} --out full", "is not empty: series in one folder mix"),
        (f"{two} --out slice.dcm", "a DICOM series is a folder"),
        (f"{one} --extent 2 4 4 --out a.h5", "--extent must be two numbers, Y X: this scan"),
        (f"{one} --center 2 4 4 --out a.h5", "--center must be two numbers, Y X; got 3"),
        (f"{one} --extent 4 --out a.h5", "of slices two, Y X; got 1"),
        (f"{two} --voxel 0.01 --extent 3 3 --out a.h5", "a.h5 needs 0.00 GiB, 0.00 GiB are free"),
    ):
        assert expected_text in cli(f"reconstruct {words}", 2)
    assert [p.name for p in here.iterdir()] == ["full"]


def test_one_slice_is_a_volume_of_one_slice(here, lines, cli):
    for name in ("v.nii.gz", "v.mha", "v.h5"):
        cli(f"reconstruct {lines / 'one.h5'} --voxel 0.5 --extent 4 5 --center 1 2 --out {name}")
        found = Volume.load(name).grid
        np.testing.assert_allclose(
            [*found.shape, *found.spacing, *found.center], [1, 8, 10, 0.5, 0.5, 0.5, 0, 1, 2]
        )
        assert json.loads((here / f"{name}.json").read_text())["shape"] == [1, 8, 10]
    cli(f"reconstruct {lines / 'two.h5'} --extent 4 4 --center 7 0 0 --out series")
    assert Volume.load("series").grid.center == (7.0, 0.0, 0.0)


def test_a_dicom_slice_is_shown(here, cli):
    data = 300 * torch.arange(2.0 * 6 * 5).reshape(2, 6, 5) / 60
    Volume(data, VolumeGrid((2, 6, 5), (2.5, 1.0, 1.0))).save("series")
    shutil.copy("series/0002.dcm", "IM2")
    for name in ("series/0002.dcm", "IM2"):
        assert "shape: [1, 6, 5]\nspacing_mm: [2.5, 1.0, 1.0]" in cli(f"info {name}")
        cli(f"view {name}")
    assert sorted(p.name for p in here.glob("*.png")) == ["0002.png", "IM2.png"]


def test_a_full_disk_is_one_sentence_and_status_1(here, lines, cli):
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (300, limits[1]))
    try:
        for name in ("v.h5", "v.nii.gz", "v.mha", "series"):
            said = cli(f"reconstruct {lines / 'two.h5'} --out {here / name}", 1)
            assert said == f"torchpcct reconstruct: cannot write {here / name}: File too large\n"
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert list(here.iterdir()) == []
