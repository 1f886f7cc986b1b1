"""The first ten minutes with the command line: what it says unasked, what it guesses, what it
finds broken."""

import re
import shlex
import shutil
import subprocess
import sys
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import pytest
import torch
from fresh_python import run_python

import recon.api
from recon.cli import _parser as make_parser
from recon.cli import doctor, main, start
from torchpcct import Volume

ROOT = Path(__file__).parent.parent.parent


def _commands():
    return make_parser()[1].choices


def test_without_a_command_it_says_where_to_begin(cli):
    output = cli("")
    assert len(output.splitlines()) <= 24
    assert max(map(len, output.splitlines())) <= 120
    examples = re.findall(r" {2}(torchpcct .*)", output)
    assert len(examples) >= 6
    for line in examples:  # they are commands that the parser takes
        make_parser()[0].parse_args(shlex.split(line)[1:])
    for name in _commands():
        assert re.search(rf"\b{name}\b", output)


def test_every_command_stands_in_the_help_once_and_has_examples_that_it_takes(cli, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    output = cli("--help")
    for name in _commands():
        assert len(re.findall(rf"^  {name} ", output, re.MULTILINE)) == 1
        text = cli(f"{name} --help")
        assert text.startswith(f"usage: torchpcct {name} ")
        examples = re.findall(rf"^  torchpcct ({name}.*)$", text, re.MULTILINE)
        assert examples
        for line in examples:
            if name != "train":
                make_parser()[0].parse_args(shlex.split(line.split(" >")[0]))


@pytest.mark.parametrize(
    ("words", "expected_text"),
    [
        ("recontruct scan.h5", "unknown command 'recontruct' (did you mean 'reconstruct'?)"),
        (
            "reconstruct scan.h5 --kernal soft",
            "unrecognized arguments: --kernal soft (did you mean '--kernel'?)",
        ),
        ("simulate --out a.h5 --device cdua", "(did you mean 'cuda'?)"),
        ("evaluate --task nodul --out out", "(did you mean 'nodule'?)"),
        ("evaluate --method pwsl --out out", "(did you mean 'pwls'?)"),
        ("evaluate --method mbri:fidelity=1 --out out", "(did you mean 'mbir'?)"),
        ("evaluate --method fbp:sotf --out out", "(did you mean 'soft'?)"),
        ("evaluate --exposure -1 --out out", "--exposure[0] must be greater than 0 s"),
        ("study nosie --out out", "(did you mean 'noise'?)"),
        ("study noise --set view=3 --out out", "(did you mean 'views'?)"),
        ("view a.h5 b.h5", "add --html FILE"),
        ("view a.h5 --html a.html --slice 3", "--slice and --plane belong to a picture"),
    ],
)
def test_a_slip_is_answered_with_what_was_meant(here, cli, words, expected_text):
    assert expected_text in cli(words, 2)


@pytest.mark.extended
@pytest.mark.parametrize("quick", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_the_demo_does_what_its_lines_do(quick, tmp_path, cli, monkeypatch):
    if quick:  # FBP in place of MBIR
        real = recon.api.reconstruct
        monkeypatch.setattr(start, "_DEMO_VIEWS", 12)
        monkeypatch.setattr(
            "recon.api.reconstruct", lambda scan, grid, method, **_: real(scan, grid, "fbp")
        )
    first, second = tmp_path / "first", tmp_path / "second"
    second.mkdir()
    lines = re.findall(r"^\$ torchpcct (.*)$", cli(f"demo --out {first}"), re.MULTILINE)
    assert [line.split()[0] for line in lines] == ["simulate", "reconstruct", "reconstruct", "view"]
    for line in lines:
        cli(line.replace(str(first), str(second)))
    for name in ("fbp.nii.gz", "mbir.nii.gz"):
        assert torch.equal(Volume.load(first / name).data, Volume.load(second / name).data)
    assert (first / "view.html").read_bytes() == (second / "view.html").read_bytes()
    # What is there of others stays, and is named.
    shutil.copy(first / "view.html", second / "scan.h5")
    (second / "view.html").write_text("mine", encoding="utf-8")
    assert "not made by torchpcct simulate" in cli(f"demo --out {second}", 2)
    assert (second / "view.html").read_text(encoding="utf-8") == "mine"
    cli(f"demo --out {second / 'view.html'}", 2)


def test_doctor_names_what_is_broken_and_what_to_do(capsys, cli, monkeypatch):
    monkeypatch.setattr(doctor, "_faults", lambda names: {})  # tried below
    output = cli("doctor")
    assert len(re.findall("^ok ", output, re.MULTILINE)) == len(doctor._CHECKS)
    assert re.search("weights +sha256 [0-9a-f]{64}, as their card says", output)
    monkeypatch.setattr(
        "torchpcct.projector.Projector.T", lambda self, y: 1.001 * torch.ones(8, 20, 20)
    )
    monkeypatch.setattr("recon.mbir.mbir.Mbir.weights_sha256", "0" * 64)
    monkeypatch.setattr(
        "recon.api.reconstruct", lambda *_, **__: Volume(torch.full((40, 40), 9.0), _[1])
    )
    monkeypatch.setattr(
        doctor, "require_writable", lambda folder: (_ for _ in ()).throw(PermissionError("no"))
    )
    monkeypatch.setattr(
        "importlib.metadata.requires",
        lambda name: ["numpy>=99", "nonesuch>=1", "x>=1; extra == 'io'"],
    )
    assert main(["doctor"]) == 1
    lines = dict(
        re.findall(r"^BROKEN +(\S+(?: \S+)?)  +(.*)$", capsys.readouterr().out, re.MULTILINE)
    )
    assert set(lines) == {"packages", "kernel cache", "weights", "adjoint", "FBP"}
    assert "is older than 99" in lines["packages"]
    assert lines["packages"].endswith("pip install --force-reinstall 'numpy>=99' 'nonesuch>=1'")
    assert "sha256 0000" in lines["weights"]
    assert "reads up to 9.0 HU off" in lines["FBP"]
    assert "differ by" in lines["adjoint"]
    assert all("pip install" in text or "set NUMBA_CACHE_DIR" in text for text in lines.values())


def test_doctor_loads_the_packages_of_the_extras(tmp_path, monkeypatch):
    """What is installed may still be broken: an error, a missing symbol, an end of the process."""
    for name, text in (
        ("sound", ""),
        ("raises", "raise ImportError('undefined symbol: x\\nmore')"),
        ("ends", "import os; os.abort()"),
        ("old", ""),
    ):
        (tmp_path / f"{name}.py").write_text(text, encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    versions = {"sound": "1.0", "raises": "1.0", "ends": "1.0", "old": "1.9"}
    monkeypatch.setattr(
        "importlib.metadata.version", lambda name: versions.get(name) or _no_package(name)
    )
    monkeypatch.setattr(
        "importlib.metadata.requires",
        lambda _: [
            'sound>=1; extra == "a"',
            'raises>=1; extra == "a"',
            'ends>=1; sys_platform == "linux" and extra == "b"',
            'old>=1.10; extra == "b"',
            'lacking; extra == "c"',
            'broken; extra == "test"',
            "numpy>=1",
        ],
    )
    with pytest.raises(ValueError, match="does not load") as found:
        doctor._extras()
    assert sorted(str(found.value).split("; ")) == [
        "ends of b does not load (it ends the process, status -6): pip install --force-reinstall "
        "'ends'",
        "old 1.9 of b is older than 1.10: pip install 'old>=1.10'",
        "raises of a does not load (undefined symbol: x): pip install --force-reinstall 'raises'",
    ]
    monkeypatch.setattr(
        "importlib.metadata.requires", lambda _: ['sound>=1; extra == "a"', 'lacking; extra == "c"']
    )
    assert doctor._extras() == "a; c lacks lacking (pip install 'torchpcct[c]')"


def _no_package(name):
    raise PackageNotFoundError(name)


def test_the_module_is_the_command(tmp_path):
    for module in ("torchpcct", "recon.cli"):
        done = subprocess.run(
            [sys.executable, "-m", module, "reconstruct", "x.h5", "--voxel", "0"],
            capture_output=True,
            text=True,
            cwd=tmp_path,
            env={"PYTHONPATH": str(ROOT)},
        )
        assert done.returncode == 2
        assert done.stderr == "torchpcct reconstruct: --voxel must be greater than 0 mm, got 0\n"


def test_train_is_ours_whatever_lies_in_the_folder(tmp_path):
    (tmp_path / "train").mkdir()
    for name in ("__init__", "__main__"):
        (tmp_path / "train" / f"{name}.py").write_text("print('MINE')", encoding="utf-8")
    # theirs is loaded, too
    code = "import train, sys; from recon.cli import main; sys.exit(main(['train', '--help']))"
    for words in (["-m", "recon.cli", "train", "--help"], ["-c", code]):
        run = subprocess.run(
            [sys.executable, *words],
            capture_output=True,
            text=True,
            cwd=tmp_path,
            env={"PYTHONPATH": str(ROOT)},
        )
        assert run.returncode == 0, run.stderr
        assert "usage: torchpcct train" in run.stdout
        assert run.stdout.count("MINE") == (words[0] == "-c")


def test_the_completion_knows_commands_and_options(cli, monkeypatch):
    pytest.importorskip("shtab")
    script = cli("--print-completion bash")
    subprocess.run(["bash", "-n"], input=script, text=True, check=True)
    assert "--find-axis" in script
    assert all(name in script for name in _commands())
    monkeypatch.setitem(sys.modules, "shtab", None)
    assert "pip install 'torchpcct[completion]'" in cli("--print-completion bash", 2)


WITHOUT_UNIX = """
import os, sys
for name in ("fcntl", "resource", "pwd", "grp", "termios"):
    sys.modules[name] = None
for name in ("getuid", "fork", "sysconf", "sync", "sched_getaffinity"):
    delattr(os, name)
import recon.cli, recon.study.registry as registry
from recon.jobs import execute
from recon.jobs.execute import _compiling
for name in registry.STUDIES:
    registry.part(name)
with _compiling(False) as seconds:
    print(seconds())
from recon.study.compare import _peak_memory_gib
print(_peak_memory_gib())
"""


@pytest.mark.extended
def test_studies_need_no_module_that_only_unix_has():
    assert run_python(WITHOUT_UNIX).stdout.split() == ["0.0", "0.0"]
