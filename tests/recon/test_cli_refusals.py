"""The command line under bad input and bad circumstances: at once, in words, and nothing left behind."""

import io
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from recon.cli import main
from recon.study.store import Store
from torchpcct.files import _part, require_writable, written_whole

ROOT = Path(__file__).parent.parent.parent


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["reconstruct", "{tmp}/f", "--voxel", "1e-9", "--out", "{tmp}/a.h5"], "--voxel makes 1000000000"),
        (["reconstruct", "{tmp}/f", "--voxel", "nan", "--out", "{tmp}/a.h5"], "--voxel must be finite"),
        (["reconstruct", "{tmp}/f", "--extent", "inf", "1", "1", "--out", "{tmp}/a.h5"], "--extent[0] must be finite"),
        (["reconstruct", "{tmp}/f", "--extent", "1", "-1", "1", "--out", "{tmp}/a.h5"], "--extent[1] must be greater"),
        (["reconstruct", "{tmp}/f", "--center", "1", "nan", "1", "--out", "{tmp}/a.h5"], "--center[1] must be finite"),
        (["reconstruct", "{tmp}/f", "--out", "{tmp}/a.h5"], "unknown scan format 'f'"),
        (["reconstruct", "{tmp}/f", "--out", "{tmp}/none/a.h5"], "create it first"),
        (["reconstruct", "{tmp}/f", "--tissues", "--out", "{tmp}/a.h5"], "--tissues is an option of --method mbir"),
        (["reconstruct", "{tmp}/f", "--method", "pwls", "--look", "0", "--out", "{tmp}/a.h5"], "not of pwls"),
        (["simulate", "--views", "0", "--out", "{tmp}/a.h5"], "--views must be at least 1"),
        (["simulate", "--exposure", "nan", "--out", "{tmp}/a.h5"], "exposure_s) must be finite"),
        (["simulate", "--exposure", "-1", "--out", "{tmp}/a.h5"], "exposure_s) must be greater than 0"),
        (["compare", "--seed", "-1", "--out", "{tmp}/o"], "seed must be at least 0"),
        (["compare", "--out", "{tmp}/f"], "is a file"),
        (["dose-factor", "--out", "{tmp}/f"], "is a file"),
        (["study", "noise", "--seed", "-3", "--out", "{tmp}/o"], "seed must be at least 0"),
        (["study", "noise", "--out", "{tmp}/f/g"], "cannot write into"),
        (["compare", "--device", "cuda", "--out", "{tmp}/o"], "use --device cpu"),
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
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert "LOADED []" in run.stdout


def test_the_package_is_lazy_but_its_functions_take_the_place_of_the_packages():
    code = (
        "import recon, recon.fbp.inset, recon.pwls.joint\n"
        "print(callable(recon.fbp), callable(recon.pwls), recon.METHODS)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert run.stdout.startswith("True True ('fbp', 'pwls'")


def test_what_a_killed_process_left_is_swept_by_the_next_write(tmp_path):
    dead = subprocess.run(
        [sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, text=True
    ).stdout
    process = int(dead)
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
        with written_whole(tmp_path / name) as part:
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
        key = file["key"]
    for other in ({"a": arrays["a"]}, {**arrays, "a": arrays["a"] + 1e-12}):
        np.savez(tmp_path / "p.npz", key=key, **other)
        assert sorted(store.piece("p", "key", lambda: arrays)) == ["a", "b"]
        assert np.array_equal(store.piece("p", "key", pytest.fail)["a"], arrays["a"])
    np.savez(tmp_path / "p.npz", key=np.array("key"), a=np.zeros(2))  # of an earlier version
    assert store.piece("p", "key", pytest.fail)["a"].tolist() == [0, 0]


def test_a_package_that_nobody_can_write_names_numbas_variable(monkeypatch):
    import torchpcct

    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.warns(RuntimeWarning, match="set NUMBA_CACHE_DIR"):
        torchpcct._check_cache("/usr/lib/torchpcct", "/nobody/.cache/numba")
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/tmp")
    torchpcct._check_cache("/usr/lib/torchpcct", "/nobody/.cache/numba")
