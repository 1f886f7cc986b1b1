"""Jobs in other processes and on a cluster: the same figures, nothing lost, and what is wrong is said."""

import contextlib
import json
import os
import subprocess
import sys
import time

import pytest
from some_jobs import dies, full, noted, refuses, threads
from tiny_studies import INSERT

from recon.cli import main
from recon.evaluate import execute
from recon.evaluate.execute import Cluster, Job, LeftOut, Processes, run
from recon.evaluate.experiment import evaluate
from recon.evaluate.methods import Method
from recon.evaluate.sources import _follow, source_digest
from recon.evaluate.tasks import read_task

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
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as workers:
        executor = Cluster(workers.scheduler_address)
        yield executor
        executor.shutdown()


def figures(found):
    return [json.dumps(r) for r in found.records if r["figure"] != "seconds"]


@pytest.fixture(scope="module")
def serial(task, tmp_path_factory):
    import torch

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


def test_a_lambda_is_computed_here(task, processes, tmp_path, caplog):
    mine = Method("mine", lambda draw: draw.fbp("soft"), kernels=("soft",))
    found = evaluate(task, ["fbp:soft", mine], n=8, folder=tmp_path, executor=processes)
    assert {r["method"] for r in found.records} == {"fbp:soft", "mine"}
    assert "mine is computed here, not by other processes" in caplog.text


def test_a_job_whose_process_dies_is_repeated_and_left_out_after_three(processes, tmp_path):
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
    (said,) = [line for line in capsys.readouterr().err.splitlines() if line]
    assert "no Dask scheduler answers at tcp://127.0.0.1:9" in said
    assert main([*command, str(tmp_path / "none.json")]) == 2
    assert "dask scheduler --scheduler-file writes it" in capsys.readouterr().err


def test_a_dry_run_lists_the_jobs(task, tmp_path, capsys):
    assert main(["evaluate", "--task", "plaque", "--n", "16", "--dry-run", "--out", str(tmp_path / "x")]) == 0
    text = capsys.readouterr().out
    assert "plaque: 2 s, 8-16, fbp:soft" in text
    assert "core hours" in text
    assert not list((tmp_path / "x").rglob("*.npz"))


LOADED = """
import sys, os
from tiny_studies import INSERT
from pathlib import Path
from recon.evaluate.measure import Measurement, Reader
from recon.evaluate.draws import Draws
from recon.evaluate.store import Store
from recon.evaluate.task import Task
from recon.evaluate.methods import method_of
import pickle
task, methods = pickle.loads(Path(sys.argv[1]).read_bytes())
draws = Draws(task, Store(Path(sys.argv[2])), 0, [k for m in methods for k in m.kernels])
reader = Reader(task, task.truth(draws.facts))
for m in methods:
    Measurement(m, draws, reader, 20.0, draws.store)
print(*(m for m in sys.modules if m.startswith(("torchpcct.", "recon.")) and "." in m))
"""


def test_a_digest_covers_all_that_a_piece_imports(task, tmp_path):
    """What a process has really loaded after measuring is among the modules that the imports name, and not much else
    is."""
    import pickle

    from recon.evaluate.methods import method_of

    (tmp_path / "given").write_bytes(pickle.dumps((task, [method_of(m) for m in METHODS])))
    path = os.pathsep.join([p for p in sys.path if p])
    loaded = subprocess.run(
        [sys.executable, "-c", LOADED, tmp_path / "given", tmp_path / "store"], check=True, capture_output=True,
        text=True, env={**os.environ, "PYTHONPATH": path},
    ).stdout.split()  # fmt: skip
    seen = set()
    _follow("recon.evaluate.measure", "", seen)
    modules = {name for name, _ in seen}
    packages = {m for m in loaded if any(other.startswith(f"{m}.") for other in loaded)}
    assert set(loaded) - packages - modules == set()
    assert not [m for m in modules if m.startswith(("recon.cli", "recon.study", "train"))]
    assert source_digest("recon.evaluate.measure") != source_digest("recon.study.hardcases.measure")
