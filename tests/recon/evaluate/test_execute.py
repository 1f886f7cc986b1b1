"""Jobs in other processes and on a cluster: the same figures, nothing lost, and what is wrong is said."""

import contextlib
import json
import os
import pickle
import subprocess
import sys
import time

import pytest
import torch
from some_jobs import dies, full, noted, refuses, threads
from tiny_studies import INSERT, TINY

from recon.cli import main
from recon.evaluate import execute
from recon.evaluate.execute import Cluster, Job, LeftOut, Processes, run
from recon.evaluate.experiment import evaluate
from recon.evaluate.methods import Method, method_of
from recon.evaluate.sources import _follow, source_digest
from recon.evaluate.tasks import read_task
from recon.study import registry
from recon.study.results import differences
from torchpcct import ConeBeam, Scan, Volume, full_turn

METHODS = ["fbp:soft", "gaussian@fbp:soft", "mbir"]


@pytest.fixture(scope="module")
def task(tmp_path_factory):
    path = tmp_path_factory.mktemp("task") / "insert.yaml"
    # On the voxels that the network knows, few of them.
    path.write_text(INSERT.replace("size: [6, 8, 8], voxel_mm: 0.4", "size: [3, 6, 6], voxel_mm: 0.2"))
    return read_task(path)


@pytest.fixture(scope="module")
def processes():
    with Processes(2, 1) as executor:
        yield executor


@pytest.fixture(scope="module")
def cluster():
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as workers:
        executor = Cluster(workers.scheduler_address)
        yield executor
        executor.shutdown()


def figures(found):
    return [json.dumps(r) for r in found.records if r["figure"] != "seconds"]


@pytest.fixture(scope="module")
def serial(task, tmp_path_factory):
    before = torch.get_num_threads()
    torch.set_num_threads(1)  # of MBIR the last bits depend on their number
    try:
        return figures(evaluate(task, METHODS, n=8, folder=tmp_path_factory.mktemp("serial")))
    finally:
        torch.set_num_threads(before)


def names(folder):
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*.npz")}


def test_processes_give_the_same_figures(task, serial, processes, tmp_path, monkeypatch):
    own = []
    monkeypatch.setattr("recon.evaluate.measure.volume_of", lambda method, draw: own.append(method.name))
    found = evaluate(task, METHODS, n=8, folder=tmp_path, executor=processes)
    assert own == []  # nothing was left for this process
    assert figures(found) == serial
    assert not [p for p in tmp_path.rglob(".*")]
    monkeypatch.setattr(execute, "_run", pytest.fail)
    assert figures(evaluate(task, METHODS, n=8, folder=tmp_path, executor=processes)) == serial


@pytest.mark.cluster
@pytest.mark.parametrize("shared", [True, False])
def test_a_cluster_gives_the_same_figures(task, serial, cluster, tmp_path, monkeypatch, shared):
    if not shared:  # a marker that no worker sees: they compute on a disk of their own
        monkeypatch.setattr(execute, "marker", lambda folder: contextlib.nullcontext(folder / "not" / f"{shared}"))
    monkeypatch.setattr("recon.evaluate.measure.volume_of", pytest.fail)
    assert figures(evaluate(task, METHODS, n=8, folder=tmp_path, executor=cluster)) == serial
    assert bool(list(tmp_path.rglob("*.h5"))) is shared  # scans stay where they were made


@pytest.mark.parametrize(
    "name",
    ["hardcases", *(pytest.param(n, marks=pytest.mark.slow) for n in ("bowtie", "motion", "resolution", "spectral",
                                                                      "detector", "compare"))],
)  # fmt: skip
def test_a_study_gives_the_same_report(name, processes, tmp_path):
    settings = {**TINY[name], **({"cases": ("dead-column", "metal")} if name == "hardcases" else {})}
    run_tiny_with(name, settings, tmp_path / "here")
    processes.log = tmp_path / "run.log"
    with execute.using(processes):
        run_tiny_with(name, settings, tmp_path / "there")
    assert "done     " in processes.log.read_text()
    here, there = (json.loads((tmp_path / x / "report.json").read_text()) for x in ("here", "there"))
    assert list(differences(here, there)) == []
    assert not [p for p in (tmp_path / "there").rglob(".*")]


def run_tiny_with(name, settings, folder):
    made = registry.part(name).Settings(**settings)
    registry.run(name, made, pieces=folder).save(folder)


def test_many_scans_are_reconstructed_as_if_each_were_alone(processes, tmp_path, capsys):
    g = ConeBeam(full_turn(24), 300.0, 500.0, 24, 4, 1.0)
    for k in range(3):
        Scan.from_counts(torch.full(g.shape, 900.0 + k), g, air=1000.0).save(tmp_path / f"s{k}.h5")
    (tmp_path / "bad.h5").write_bytes(b"no scan")
    scans = [str(tmp_path / f"{name}.h5") for name in ("s0", "bad", "s1", "s2")]
    out, alone = tmp_path / "out", tmp_path / "alone"
    assert main(["reconstruct", *scans, "--out", str(out), "--workers", "2"]) == 2
    text = capsys.readouterr()
    assert "1 of 4 scans are not reconstructed" in text.err
    assert text.out.count("voxels of") == 3
    assert main(["reconstruct", *scans, "--out", str(alone)]) == 2
    for k in range(3):
        a, b = (Volume.load(folder / f"s{k}_fbp.nii.gz").data for folder in (out, alone))
        assert torch.equal(a, b)
    assert main(["reconstruct", *scans]) == 2
    assert "--out FOLDER says where" in capsys.readouterr().err
    assert main(["reconstruct", *scans, "--out", str(out), "--dry-run"]) == 0
    assert "4 jobs" in capsys.readouterr().out


def test_a_lambda_is_computed_here(task, processes, tmp_path, caplog):
    mine = Method("mine", lambda draw: draw.fbp("soft"), kernels=("soft",))
    found = evaluate(task, ["fbp:soft", mine], n=8, folder=tmp_path, executor=processes)
    assert {r["method"] for r in found.records} == {"fbp:soft", "mine"}
    assert "mine is computed here, not by other processes" in caplog.text


def test_a_job_whose_process_dies_is_repeated_and_left_out_after_three(processes, tmp_path, caplog, capfd):
    jobs = [Job("once", dies, ("once", 1)), Job("always", dies, ("always", 9)),
            Job("needs it", noted, ("n", 1), after=("always",)),
            *(Job(f"other {k}", noted, (f"o{k}", k)) for k in range(8))]  # fmt: skip
    processes.log = tmp_path / "run.log"
    with pytest.raises(LeftOut, match=r"2 of 11 jobs are missing: always \(its process died\); needs it \(needs alw"):
        run(jobs, tmp_path, processes)
    assert (tmp_path / "once.txt").exists()
    assert len(list(tmp_path.glob("o*.txt"))) == 9
    assert (tmp_path / "always.deaths").read_text() == "xxx"
    text = processes.log.read_text()
    assert text.count("done     ") == 9
    assert text.count("failed   ") == 4
    assert caplog.messages.count("noted 3") == 1  # what a worker says is said here
    assert "noted" not in capfd.readouterr().err


def test_what_a_job_itself_refuses_ends_the_run(processes, tmp_path):
    with pytest.raises(ValueError, match="bad input"):
        run([Job("bad", refuses, ())], tmp_path, processes)
    with pytest.raises(execute.Unportable):
        run([Job("lambda", lambda folder: None, ())], tmp_path, processes)


def test_threads_of_all_libraries_are_the_workers(processes, tmp_path):
    assert run([Job("t", threads, ())], tmp_path, processes)["t"] == (1, 1, 1)


@pytest.mark.cluster
def test_threads_on_a_cluster(cluster, tmp_path):
    assert run([Job("t", threads, ())], tmp_path, cluster)["t"] == (1, 1, 1)


@pytest.mark.cluster
def test_a_full_disk_of_one_worker_is_named_and_the_rest_goes_on(cluster, tmp_path, caplog):
    pid = run([Job("who", noted, ("who", 1))], tmp_path, cluster)["who"][1]
    jobs = [Job(f"{k}", full, (f"f{k}", pid)) for k in range(6)]
    try:
        values = run(jobs, tmp_path, cluster)
        assert len(values) == 6
        assert len(cluster.avoid) <= 1
        assert not cluster.avoid or "No space left on device" in caplog.text
    finally:
        cluster.avoid.clear()


def test_another_version_is_refused(processes, tmp_path, monkeypatch):
    monkeypatch.setattr(execute, "VERSION", "0.0.9")
    with pytest.raises(ValueError, match=r"has another torchpcct.*install the same one"):
        run([Job("x", noted, ("x", 1))], tmp_path, processes)
    monkeypatch.undo()
    monkeypatch.setattr(execute, "source_digest", lambda module: "others")
    with pytest.raises(ValueError, match="has another torchpcct"):
        run([Job("x", noted, ("x", 1))], tmp_path, processes)


@pytest.mark.cluster
def test_an_unreachable_scheduler_is_told_in_one_sentence(tmp_path, capsys):
    pytest.importorskip("distributed")
    start = time.monotonic()
    command = ["evaluate", "--out", str(tmp_path), "--scheduler"]
    assert main([*command, "tcp://127.0.0.1:9"]) == 2
    assert time.monotonic() - start < 10.0
    (output,) = [line for line in capsys.readouterr().err.splitlines() if line]
    assert "no Dask scheduler answers at tcp://127.0.0.1:9" in output
    assert main([*command, str(tmp_path / "none.json")]) == 2
    assert "dask scheduler --scheduler-file writes it" in capsys.readouterr().err


def test_a_dry_run_lists_the_jobs(task, tmp_path, capsys):
    assert main(["evaluate", "--task", "plaque", "--n", "16", "--dry-run", "--out", str(tmp_path / "x")]) == 0
    text = capsys.readouterr().out
    assert "plaque: 2 s, 8-16, fbp:soft" in text
    assert "core hours" in text
    assert not list((tmp_path / "x").rglob("*.npz"))


CALLED = """
import pickle, sys
from pathlib import Path
from recon.evaluate.draws import Draws
from recon.evaluate.measure import Measurement, Reader
from recon.evaluate.sources import _follow
from recon.evaluate.store import Store
seen, called = set(), set()
_follow("recon.evaluate.measure", "", seen)
known = {name for name, _ in seen}
def note(frame, event, what):
    name = frame.f_globals.get("__name__", "")
    if event == "call" and name not in known and name.startswith(("torchpcct", "recon", "train")):
        while frame is not None and frame.f_code.co_name != "<module>" or frame.f_globals["__name__"] == "__main__":
            frame = frame.f_back
            if frame is None:  # not while modules load
                called.add(name)
                return
sys.setprofile(note)
task, methods = pickle.loads(Path(sys.argv[1]).read_bytes())
draws = Draws(task, Store(Path(sys.argv[2])), 0, [k for m in methods for k in m.kernels])
reader = Reader(task, task.truth(draws.facts))
for m in methods:
    Measurement(m, draws, reader, 20.0, draws.store)
sys.setprofile(None)
print(*called)
"""


def test_a_digest_covers_all_that_a_piece_runs(task, tmp_path):
    """Every function that is called while a piece is computed stands in a module that the digest has read, and the
    digest reads neither studies nor the command line."""
    (tmp_path / "given").write_bytes(pickle.dumps((task, [method_of(m) for m in METHODS])))
    path = os.pathsep.join([p for p in sys.path if p])
    called = subprocess.run(
        [sys.executable, "-c", CALLED, tmp_path / "given", tmp_path / "store"], check=True, capture_output=True,
        text=True, env={**os.environ, "PYTHONPATH": path},
    ).stdout.split()  # fmt: skip
    packages = {"recon", "torchpcct"}  # where lazy names are looked up
    assert set(called) - packages == set()
    seen = set()
    _follow("recon.evaluate.experiment", "", seen)
    assert not [m for m, _ in seen if m.startswith(("recon.cli", "recon.study", "train"))]
    assert source_digest("recon.evaluate.measure") != source_digest("recon.study.hardcases.measure")
