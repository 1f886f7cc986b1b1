"""Files that appear whole or not at all, whatever the disk, other writers and the user's
keyboard do meanwhile."""

import os
import resource
import signal
import threading
from pathlib import Path

import h5py
import numpy as np
import pytest
from fresh_python import run_python

from recon.jobs.store import Store
from torchpcct.files import (
    FolderInUseError,
    WriteError,
    alone,
    atomic_write,
    require_folder,
    write_hdf5,
    write_together,
)

FULL = """
import os, resource, sys
from pathlib import Path
import h5py, numpy as np, torch
from recon.mbir.weights_io import write_tensors
from recon.jobs.store import Store
from torchpcct import ConeBeam, Scan, Volume, VolumeGrid, full_turn
from torchpcct.files import write_hdf5
folder, rng = Path(sys.argv[1]), np.random.default_rng(0)
cone = ConeBeam(full_turn(40), 300.0, 500.0, 64, 16, 1.0)
scan = Scan.from_counts(rng.poisson(5e4, cone.shape), cone, air=5e4)
small = Volume(torch.randn(4, 9, 9), VolumeGrid((4, 9, 9), 1.0))  # a last buffer may be lost
volume = Volume(torch.round(300 * torch.randn(12, 64, 64)), VolumeGrid((12, 64, 64), 1.0))
def objects(path):  # more structure than HDF5 keeps in memory
    with write_hdf5(path, "test") as file:
        file.create_dataset("a", data=np.ones((12000, 2, 4)), chunks=(1, 2, 4), compression="lzf")
        for k in range(600):
            file.create_group(f"g{k}").attrs["text"] = "t" * 1000
numbers = {"a": torch.rand(40000)}
writers = {
    "s.h5": scan.save,
    "o.h5": objects,
    "w.safetensors": lambda path: write_tensors(path, "k", numbers, {}),
    "p": lambda path: Store(folder).cached("p", "", lambda: {"a": rng.random(40000)}),
}
for size in (600, 5000, 40000):
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
    for name in (*writers, "v.h5", "v.nii", "v.nii.gz", "v.mha", "small.mha", "series"):
        if size > {"series": 5000, "small.mha": 600}.get(name, size):
            continue  # it fits
        try:
            writers.get(name, small.save if name == "small.mha" else volume.save)(folder / name)
            print("written:", name, size)
        except OSError as error:
            print(error)
"""


def test_what_cannot_be_written_is_an_error_in_one_sentence_and_leaves_nothing(tmp_path):
    """A limit on the size of files, for a full disk: every writer fails at several moments, HDF5
    not at the end."""
    run = run_python(FULL, tmp_path)
    output = run.stdout.splitlines()
    assert len(output) == 3 * 10 - 3
    assert [
        s for s in output if not (s.startswith("cannot write ") and s.endswith("File too large"))
    ] == []
    assert run.stderr == ""
    assert list(tmp_path.iterdir()) == []


def test_two_writers_of_one_name_do_not_meet(tmp_path, monkeypatch):
    path = tmp_path / "f"
    with atomic_write(path) as one, atomic_write(path) as other:
        one.write_text("one")
        other.write_text("other")
    assert path.read_text() == "one"  # who ends last
    gone = tmp_path / one.name  # seen, and renamed by its writer before it could be looked at
    monkeypatch.setattr(Path, "glob", lambda *_: [gone])
    with atomic_write(path) as part:
        part.write_text("three")
    assert [p.name for p in tmp_path.iterdir()] == ["f"]


def test_a_study_outlives_another_one_that_clears_the_same_folder(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "fsync", lambda handle: None)
    done = threading.Event()

    def clear():
        while not done.wait(0.001):
            Store(tmp_path / "cache").clear()

    other = threading.Thread(target=clear)
    other.start()
    try:
        store = Store(tmp_path / "cache")
        found = [
            store.cached(f"deep/{k % 3}", str(k), lambda k=k: {"a": np.full(9, k)})["a"][0]
            for k in range(150)
        ]
    finally:
        done.set()
        other.join()
    assert found == list(range(150))
    Store(tmp_path / "cache").clear()
    assert list(tmp_path.iterdir()) == []


def test_an_interruption_while_hdf5_writes_waits_for_it(tmp_path):
    """Ctrl-C in what HDF5 asks of the file would be a write that is lost, and a file that is
    sealed without it."""
    path = tmp_path / "f.h5"
    # A shell that starts commands in the background has them ignore Ctrl-C.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)

    def write():
        with write_hdf5(path, "test") as file:
            file["a"] = np.arange(9)
            os.kill(os.getpid(), signal.SIGINT)
            file["b"] = np.arange(9)

    with pytest.raises(KeyboardInterrupt):
        write()
    assert list(tmp_path.iterdir()) == []
    assert signal.signal(signal.SIGINT, before) is signal.default_int_handler
    with write_hdf5(path, "test") as file:
        file["a"] = np.arange(9)
    with h5py.File(path) as file:
        assert file["a"][8] == 8


def test_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "f"

    def write(text):
        with atomic_write(path) as part:
            part.write_text(text)

    def full(*_):
        raise OSError(28, "No space left on device")

    write("old")
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(WriteError, match=r"^cannot write .*/f: No space left on device$"):
        write("new")
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["f"]


def test_a_file_in_the_place_of_the_folder_is_named(tmp_path):
    (tmp_path / "taken").write_text("mine", encoding="utf-8")
    for name in ("taken/a.h5", "taken/deeper/a.h5"):
        with pytest.raises(NotADirectoryError, match=r"taken is a file, no folder; choose another"):
            require_folder(tmp_path / name)
    with pytest.raises(FileNotFoundError, match="missing does not exist, create it first"):
        require_folder(tmp_path / "missing" / "a.h5")


def test_a_folder_that_is_removed_meanwhile_is_no_file(tmp_path, monkeypatch):
    """Between two looks at it, by another process."""
    folder, look = tmp_path / "cache", Path.stat
    folder.mkdir()

    def looked_at(path, **options):
        found = look(path, **options)
        if path == folder:
            folder.rmdir()
        return found

    monkeypatch.setattr(Path, "stat", looked_at)
    with pytest.raises(FileNotFoundError, match="cache does not exist, create it first"):
        require_folder(folder / "a.h5")


NAMES = ("report.json", "report.md", "report.html")


def test_files_that_belong_together_are_all_written_or_none(tmp_path):
    """A limit on the size of files, for a full disk: the old report stays whole."""
    write_together(tmp_path, dict.fromkeys(NAMES, b"old"))
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, limits[1]))
    try:
        with pytest.raises(WriteError, match=r"cannot write .*report\.md: File too large"):
            write_together(tmp_path, {**dict.fromkeys(NAMES, b"new"), "report.md": bytes(9000)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == dict.fromkeys(
        NAMES, b"old"
    )


def test_of_two_writers_of_the_same_files_one_has_written_them_all(tmp_path, monkeypatch):
    """The second one begins after the first one's first file is there."""
    second = threading.Thread(
        target=write_together, args=(tmp_path, dict.fromkeys(NAMES, b"second"))
    )
    real, replaced = os.replace, []

    def replace(source, target):
        real(source, target)
        replaced.append(target)
        if len(replaced) == 1:
            second.start()
            second.join(0.5)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", replace)
        write_together(tmp_path, dict.fromkeys(NAMES, b"first"))
        second.join()
    assert len(replaced) == 2 * len(NAMES)
    assert {(tmp_path / name).read_bytes() for name in NAMES} == {b"second"}


def test_a_folder_is_held_by_one(tmp_path):
    with alone(tmp_path):
        with pytest.raises(FolderInUseError, match=r"another process writes into .*: wait until"):
            alone(tmp_path).__enter__()
        with alone(tmp_path / "another"):  # which is not there
            pass
        with alone(tmp_path, wait_s=0.01):  # waits, and goes on
            pass
    with alone(tmp_path), pytest.raises(FolderInUseError), alone(tmp_path):
        pass
    with pytest.raises(KeyError), alone(tmp_path):
        raise KeyError
    with alone(tmp_path):
        assert list(tmp_path.iterdir()) == []
