"""Cached results: what goes in comes out, kills lose one result at most, and nothing of another
version is used."""

import io
import json
import os
import signal
import time
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import pytest
import torch
from fresh_python import run_python
from tiny_studies import run_tiny

import recon.jobs.store as store_module
from recon.jobs import execute
from recon.jobs.store import Store, StudyCache, packed, unpacked
from recon.study.noise import RoiStatistics
from recon.study.results import differences
from torchpcct import ConeBeam, VolumeGrid, full_turn
from torchpcct.scan import Scan


@dataclass(frozen=True)
class _Settings:
    seed: int = 0


def _through_disk(value, tmp_path):
    np.savez(tmp_path / "p.npz", **packed(value))
    with np.load(tmp_path / "p.npz", allow_pickle=False) as file:
        return unpacked(dict(file))


def test_values_come_back_as_they_were(tmp_path):
    value = {
        ("fbp", 0.25): (np.arange(6).reshape(2, 3), [True, None, 1.5, "α"]),
        0.35: np.float64(2.0),
        "nested": {"tensor": torch.arange(4.0), "empty": ()},
        "of this software": [
            RoiStatistics(np.ones((2, 2)), np.zeros((2, 2))),
            VolumeGrid((2, 3, 4), 0.5),
        ],
    }
    back = _through_disk(value, tmp_path)
    assert list(back) == list(value)
    array, rest = back["fbp", 0.25]
    np.testing.assert_array_equal(array, value["fbp", 0.25][0])
    assert rest == [True, None, 1.5, "α"]
    assert back[0.35] == 2.0
    assert torch.equal(back["nested"]["tensor"], torch.arange(4.0))
    assert back["nested"]["empty"] == ()
    table, grid = back["of this software"]
    assert isinstance(table, RoiStatistics)
    np.testing.assert_array_equal(table.mean, np.ones((2, 2)))
    assert grid == VolumeGrid((2, 3, 4), 0.5)


def test_a_scan_comes_back_whole(tmp_path):
    g = ConeBeam(full_turn(3), 500.0, 900.0, 4, 2, 1.0)
    scan = Scan.from_counts(torch.full(g.shape, 7.0), g, air=9.0)
    back = _through_disk(scan, tmp_path)
    assert back.geometry == g
    assert torch.equal(back.line_integrals(), scan.line_integrals())
    assert {f.name for f in fields(back) if getattr(back, f.name) is None} == {
        f.name for f in fields(scan) if getattr(scan, f.name) is None
    }


def test_what_cannot_be_kept_is_refused():
    for value in (object(), {1: {2}}, np.array([object()]), _Settings()):
        with pytest.raises(TypeError, match="a cached result cannot hold"):
            packed(value)
    foreign = {"tree": np.array(json.dumps({"made": ["os", "path", {}]}))}
    with pytest.raises(ValueError, match="not a dataclass of this software"):
        unpacked(foreign)


def test_finished_results_are_used_again_by_the_same_settings_and_source_only(
    tmp_path, monkeypatch
):
    computed = []

    def run(settings=_Settings(), folder=tmp_path):
        cache = StudyCache(folder, settings).within("part")
        return cache("x", lambda: computed.append(1) or len(computed))

    assert (run(), run()) == (1, 1)
    assert run(_Settings(seed=1)) == 2
    monkeypatch.setattr(store_module, "source_digest", lambda: "another version")
    assert run(_Settings(seed=1)) == 3
    assert run(folder=None) == 4
    StudyCache.clear(tmp_path)
    assert list(tmp_path.iterdir()) == []
    StudyCache.clear(tmp_path)  # nothing there: nothing to do


def _content(folder):
    return {
        path.relative_to(folder).as_posix(): None if path.is_dir() else path.read_bytes()
        for path in folder.rglob("*")
    }


@pytest.mark.parametrize("linked", [False, True])
def test_only_what_a_study_wrote_is_ever_removed(tmp_path, linked):
    """Files of the user in ``OUT/cache``, also of a cached result's name and kind, also where it
    is a link."""
    out, cache = tmp_path / "out", tmp_path / "out" / "cache"
    out.mkdir()
    if linked:
        (tmp_path / "mine").mkdir()
        cache.symlink_to(tmp_path / "mine", target_is_directory=True)
    for name in (
        "deep/notes.txt",
        "deep/.part",
        "empty/nothing/",
        "other.d/data.npz",
        "deep/x.npz",
    ):
        path = cache / name
        (path if name.endswith("/") else path.parent).mkdir(parents=True, exist_ok=True)
        if path.suffix == ".npz":
            np.savez(path, key=np.ones(3), measured=np.arange(5))
        elif not name.endswith("/"):
            path.write_text("mine")
    g = ConeBeam(full_turn(3), 500.0, 900.0, 4, 2, 1.0)
    scan = Scan.from_counts(torch.full(g.shape, 7.0), g, air=9.0)
    for name in ("present.h5", "present-0123456789abcdef.h5"):
        scan.save(cache / name)
    (tmp_path / "elsewhere.txt").write_text("mine")
    (cache / "link.txt").symlink_to(tmp_path / "elsewhere.txt")
    Path(cache / "link.npz").symlink_to(tmp_path / "elsewhere.txt")
    mine = _content(tmp_path)
    study = StudyCache(out, _Settings())
    for name in ("a", "deep/x", "deep/deeper/y", "link"):
        assert study(name, lambda name=name: name) == name
    store = Store(study.folder("evaluate"))
    store.keep_scan(scan, store.path("task/present-fedcba9876543210.h5"))
    assert Scan.load(store.path("task/present-fedcba9876543210.h5")).geometry == g
    own = {"a.npz", "deep/deeper/y.npz", "evaluate/task/present-fedcba9876543210.h5"}
    assert own <= {
        name.removeprefix("out/cache/").removeprefix("mine/") for name in _content(tmp_path)
    }
    (cache / "copy of a.npz").write_bytes((cache / "a.npz").read_bytes())
    scan_copy = cache / "copy-fedcba9876543210.h5"
    scan_copy.write_bytes(store.path("task/present-fedcba9876543210.h5").read_bytes())
    mine = {**mine, **{k: v for k, v in _content(tmp_path).items() if "copy" in k}}
    StudyCache.clear(out)
    assert _content(tmp_path) == mine
    assert (cache / "link.npz").is_symlink()


def test_the_folder_of_an_earlier_version_stays_as_it_is(tmp_path):
    """``OUT/pieces``, where results were cached before: neither read nor removed."""
    settings = _Settings()
    assert StudyCache(tmp_path, settings)("x", lambda: 1) == 1
    (tmp_path / "cache").rename(tmp_path / "pieces")
    before = _content(tmp_path)
    assert StudyCache(tmp_path, settings)("x", lambda: 2) == 2
    StudyCache.clear(tmp_path)
    assert _content(tmp_path) == before


def test_results_of_an_earlier_version_are_not_used_nor_cleared(tmp_path, caplog):
    """In a folder that the user names again; their mark was ``piece``."""
    caplog.set_level("INFO")
    store = Store(tmp_path)
    for name in ("x", "y"):
        assert store.cached(name, "key", lambda: 1) == 1
        with np.load(tmp_path / f"{name}.npz", allow_pickle=False) as file:
            arrays = {"piece" if k == "cached_as" else k: file[k] for k in file.files}
        np.savez(tmp_path / f"{name}.npz", **arrays)
    assert not store.has("x", "key")
    assert store.cached("x", "key", lambda: 2) == 2
    assert "x.npz was made by an earlier version: computed again" in caplog.text
    assert not any(record.levelname == "WARNING" for record in caplog.records)
    store.clear()
    assert [path.name for path in tmp_path.iterdir()] == ["y.npz"]


def test_a_result_does_not_replace_a_file_of_the_user(tmp_path, caplog):
    np.savez(tmp_path / "x.npz", measured=np.arange(5))
    mine = (tmp_path / "x.npz").read_bytes()
    store = Store(tmp_path)
    assert [store.cached("x", "key", lambda: 7) for _ in range(2)] == [7, 7]
    Store(tmp_path / "far").cached("x", "key", lambda: 7)
    execute._keep(
        tmp_path, {name: (tmp_path / "far/x.npz").read_bytes() for name in ("x.npz", "y.npz")}
    )
    assert (tmp_path / "x.npz").read_bytes() == mine
    assert store.cached("y", "key", lambda: 8) == 7
    assert "x.npz is not a stored result of a study: it is left unchanged" in caplog.text


def test_one_name_is_one_result(tmp_path):
    for folder in (tmp_path, None):
        cache = StudyCache(folder, _Settings())
        cache("x", lambda: 1)
        cache.within("part")("x", lambda: 2)
        with pytest.raises(
            ValueError, match="two cached results of a study have the name 'part/x'"
        ):
            cache.within("part")("x", lambda: 3)


def test_kills_at_random_moments_lose_one_result_at_most(tmp_path, monkeypatch):
    """A study of 12 cached results is killed (SIGKILL) again and again until it gets
    through; many kills hit a write."""

    def slowly(path, savez=np.savez, **arrays):
        savez(whole := io.BytesIO(), **arrays)
        with Path(path).open("wb") as file:
            for half in (whole.getvalue()[:500], whole.getvalue()[500:]):
                file.write(half)
                file.flush()
                time.sleep(0.01)

    monkeypatch.setattr(np, "savez", slowly)
    rng, log, count = np.random.default_rng(0), tmp_path / "log", 12

    def study():
        cache = StudyCache(tmp_path, _Settings())

        def compute(k):
            time.sleep(0.01)
            with log.open("a") as file:
                file.write(f"{k}\n")
            return np.full(1000, k)

        return sum(int(cache(f"deep/{k}", lambda k=k: compute(k)).sum()) for k in range(count))

    kills = 0
    while True:
        child = os.fork()
        if child == 0:
            study()
            os._exit(0)
        end = time.monotonic() + float(rng.uniform(0.0, 0.12)) * (1 + kills / 20)
        while (
            time.monotonic() < end
            and os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None
        ):
            time.sleep(0.002)
        os.kill(child, signal.SIGKILL)
        if os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0:
            break
        kills += 1
        for path in tmp_path.rglob("*.npz"):
            if ".part." not in path.name:
                np.load(path, allow_pickle=False).close()  # no damaged file, ever
    assert study() == 1000 * sum(range(count))
    assert len(log.read_text().split()) <= count + kills
    assert kills > 0
    StudyCache.clear(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["log"]


_KILLED = """
import os, signal, sys
from pathlib import Path
from tiny_studies import run_tiny
from recon.jobs.store import StudyCache
left, keep = int(sys.argv[2]), StudyCache.__call__
def call(self, name, compute):
    def dying():
        global left
        left -= 1
        value = compute()
        if left < 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return value
    return keep(self, name, dying)
StudyCache.__call__ = call
run_tiny(sys.argv[1], Path(sys.argv[3]))
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["noise", "motion", "resolution", "hardcases", "detector", "bowtie", "spectral"]
)
def test_a_killed_study_goes_on_where_it_was(name, tmp_path, monkeypatch):
    """Killed at a random result, again and again: the report is that of a run in one go, and no
    result is computed twice."""
    kills = np.random.default_rng(0).integers(1, 4, 4)
    for after in kills:
        run = run_python(_KILLED, name, after, tmp_path / "killed", check=False)
        if run.returncode == 0:
            break
        assert run.returncode == -signal.SIGKILL, run.stderr
    # The cache of an evaluation is not the study's.
    kept = (tmp_path / "killed").rglob("cache/**/*.npz")
    finished = len([path for path in kept if "evaluate" not in path.parts])
    assert finished >= 1
    made, keep = [], StudyCache.__call__
    monkeypatch.setattr(
        StudyCache, "__call__", lambda self, n, f: keep(self, n, lambda: made.append(n) or f())
    )
    resumed = run_tiny(name, tmp_path / "killed")
    again = len(made)
    whole = run_tiny(name, tmp_path / "whole")
    assert len(made) - again == again + finished
    assert list(differences(json.loads(whole.report.json), json.loads(resumed.report.json))) == []
