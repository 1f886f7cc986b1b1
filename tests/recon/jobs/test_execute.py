"""Jobs in other processes and on a cluster: the same figures, nothing lost, and what is wrong is
said."""

import contextlib
import doctest
import json
import os
import pickle
import re
import signal
import subprocess
import sys
import threading
import time
import warnings
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest
import torch
from fresh_python import run_python
from some_jobs import (
    compiles,
    dies,
    found_in,
    full,
    holds,
    kills,
    noted,
    refuses,
    set_version,
    waits,
)
from some_jobs import threads as threads_of
from tiny_studies import INSERT, TINY

from recon.cli import main
from recon.cli.parsing import Ended, ending_by_signals
from recon.evaluate.experiment import evaluate
from recon.evaluate.methods import Method, method_of
from recon.evaluate.tasks import read_task
from recon.jobs import execute
from recon.jobs.execute import Cluster, Job, LeftOut, Processes, run
from recon.jobs.sources import _content, _follow, source_digest
from recon.jobs.store import StudyCache
from recon.slabs import reconstruct_to
from recon.study import registry
from recon.study.results import differences
from torchpcct import ConeBeam, Scan, Volume, VolumeGrid, full_turn
from torchpcct.formats.volume_slabs import SlabFile

PAGE = Path(__file__).parents[3] / "notebooks" / "docs" / "howto" / "cluster.md"
METHODS = ["fbp:soft", "gaussian@fbp:soft", "mbir"]


@pytest.fixture(scope="module", autouse=True)
def _patience():
    """On a busy machine a scheduler answers late, and a process that is told to end ends late."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(execute, "_ANSWER_S", 300.0)
        patch.setattr(execute, "_LAST_S", 300.0)
        yield


@pytest.fixture(scope="module")
def task(tmp_path_factory):
    path = tmp_path_factory.mktemp("task") / "insert.yaml"
    # On the voxels that the network knows, few of them.
    text = INSERT.replace("size: [6, 8, 8], voxel_mm: 0.4", "size: [3, 6, 6], voxel_mm: 0.2")
    path.write_text(text.replace("views: 90", "views: 40"))
    return read_task(path)


@pytest.fixture(scope="module")
def processes():
    with Processes(2, 1) as executor:
        yield executor


@pytest.fixture(scope="module")
def process():
    """One is enough for most tests, and starts in half the time."""
    with Processes(1, 1) as executor:
        yield executor


@pytest.fixture(scope="module")
def cluster():
    """Of two machines: addresses of this one that look like two.

    On a busy machine a killed worker takes longer to come back than Dask's test cluster waits by
    default (15 s), which then gives it up for good: a job that waits for it would wait for ever.
    """
    distributed, dask = pytest.importorskip("distributed"), pytest.importorskip("dask")
    patient = {
        "distributed.deploy.lost-worker-timeout": "600s",
        "distributed.comm.timeouts.connect": "300s",
        "distributed.scheduler.allowed-failures": 1,  # fewer workers to start again
    }
    nodes = {
        k: {"cls": distributed.Nanny, "options": {"host": f"127.0.0.{k}", "nthreads": 1}}
        for k in (1, 2)
    }
    scheduler = {
        "cls": distributed.Scheduler,
        "options": {"host": "127.0.0.1", "dashboard_address": ":0"},
    }
    with dask.config.set(patient), distributed.SpecCluster(nodes, scheduler) as workers:
        executor = Cluster(workers.scheduler_address)
        yield executor
        executor.shutdown()


@pytest.fixture
def unconnected():
    """Of no scheduler: what it asks of one is answered by ``client``."""
    executor = object.__new__(Cluster)
    executor.address, executor.avoid, executor._given = "tcp://127.0.0.1:1", {}, {}
    executor._asked, executor._doubted = (-9.0, []), (-9.0, set())
    executor._without = (None, execute._NO_WORKER_S)
    executor._seen = set()
    executor.client = SimpleNamespace(
        status="running", futures={}, scheduler_info=lambda n: {"workers": ["tcp://127.0.0.1:2"]}
    )
    return executor


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


@pytest.mark.extended
def test_processes_give_the_same_figures(task, serial, processes, tmp_path, monkeypatch):
    own = []
    monkeypatch.setattr(
        "recon.evaluate.measure.volume_of", lambda method, realisation: own.append(method.name)
    )
    found = evaluate(task, METHODS, n=8, folder=tmp_path, executor=processes)
    assert own == []  # nothing was left for this process
    assert figures(found) == serial
    assert not [p for p in tmp_path.rglob(".*")]
    monkeypatch.setattr(execute, "_run", pytest.fail)
    assert figures(evaluate(task, METHODS, n=8, folder=tmp_path, executor=processes)) == serial


@pytest.mark.extended
@pytest.mark.cluster
@pytest.mark.parametrize("shared", [pytest.param(True, marks=pytest.mark.slow), False])
def test_a_cluster_gives_the_same_figures(task, serial, cluster, tmp_path, monkeypatch, shared):
    if not shared:  # a marker that no worker sees: they compute on a disk of their own
        monkeypatch.setattr(
            execute, "marker", lambda folder: contextlib.nullcontext(folder / "not" / f"{shared}")
        )
    monkeypatch.setattr("recon.evaluate.measure.volume_of", pytest.fail)
    assert figures(evaluate(task, METHODS, n=8, folder=tmp_path, executor=cluster)) == serial
    assert bool(list(tmp_path.rglob("*.h5"))) is shared  # scans stay where they were made


@pytest.mark.extended
@pytest.mark.parametrize(
    "name",
    [
        "detector",
        *(
            pytest.param(n, marks=pytest.mark.slow)
            for n in ("bowtie", "motion", "resolution", "spectral", "hardcases", "compare")
        ),
    ],
)
def test_a_study_gives_the_same_report(name, processes, tmp_path):
    settings = {
        **TINY[name],
        **({"cases": ("dead-column", "metal")} if name == "hardcases" else {}),
    }
    run_tiny_with(name, settings, tmp_path / "here")
    processes.log = tmp_path / "run.log"
    with execute.using(processes):
        run_tiny_with(name, settings, tmp_path / "there")
    assert "done     " in processes.log.read_text()
    here, there = (
        json.loads((tmp_path / x / "report.json").read_text()) for x in ("here", "there")
    )
    assert list(differences(here, there)) == []
    assert not [p for p in (tmp_path / "there").rglob(".*")]


def run_tiny_with(name, settings, folder):
    made = registry.settings_class(name)(**settings)
    registry.run(name, made, cache=folder).save(folder)


@pytest.mark.extended
def test_many_scans_are_reconstructed_as_if_each_were_alone(processes, here, capsys, cli):
    g = ConeBeam(full_turn(24), 300.0, 500.0, 24, 4, 1.0)
    for k in range(3):
        Scan.from_counts(torch.full(g.shape, 900.0 + k), g, air=1000.0).save(f"s{k}.h5")
    (here / "bad.h5").write_bytes(b"no scan")
    command = "reconstruct s0.h5 bad.h5 s1.h5 s2.h5"
    assert main([*command.split(), "--out", "out", "--workers", "1"]) == 2
    text = capsys.readouterr()
    assert "1 of 4 scans are not reconstructed" in text.err
    assert text.out.count("voxels of") == 3
    cli(f"{command} --out alone", 2)
    for k in range(3):
        a, b = (Volume.load(f"{folder}/s{k}_fbp.nii.gz").data for folder in ("out", "alone"))
        assert torch.equal(a, b)
    assert "--out FOLDER says where" in cli(command, 2)
    assert "4 jobs" in cli(f"{command} --out out --dry-run")


def test_many_scans_go_on_after_an_interruption(tmp_path, monkeypatch, capsys):
    g = ConeBeam(full_turn(24), 300.0, 500.0, 24, 4, 1.0)
    for k in range(3):
        Scan.from_counts(torch.full(g.shape, 900.0 + k), g, air=1000.0).save(tmp_path / f"s{k}.h5")
    command = [
        "reconstruct",
        *(str(tmp_path / f"s{k}.h5") for k in range(3)),
        "--out",
        str(tmp_path / "out"),
    ]
    save, saved = Volume.save, []

    def interrupted(volume, path):
        if len(saved) == 2:
            raise KeyboardInterrupt
        save(volume, path)
        saved.append(Path(path).name)

    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "s2_fbp.nii.gz.done").write_text("mine")  # not the command's note
    monkeypatch.setattr(Volume, "save", interrupted)
    with pytest.raises((KeyboardInterrupt, SystemExit)):
        raise SystemExit(main(command))
    # One of the two is made again: its scan has changed.
    Scan.from_counts(torch.full(g.shape, 800.0), g, air=1000.0).save(tmp_path / "s1.h5")
    monkeypatch.setattr(
        Volume, "save", lambda volume, path: saved.append(Path(path).name) or save(volume, path)
    )
    capsys.readouterr()
    assert main(command) == 0
    assert saved == [f"s{k}_fbp.nii.gz" for k in (0, 1, 1, 2)]
    assert capsys.readouterr().out.count("already there") == 1
    assert [path.read_text() for path in (tmp_path / "out").glob("*.done")] == ["mine"]


@pytest.mark.parametrize(
    "where",
    ["processes", pytest.param("cluster", marks=pytest.mark.cluster)],
)
@pytest.mark.extended
def test_slabs_of_a_volume_are_jobs(where, tmp_path, monkeypatch, request):
    """The same file, to the bit, as slab by slab in one process; what was made is made once."""
    g, grid = ConeBeam(full_turn(24), 300.0, 500.0, 24, 12, 1.0), VolumeGrid((10, 12, 12), 0.6)
    scan, made = tmp_path / "scan.h5", SlabFile.write
    counts = torch.poisson(torch.full(g.shape, 500.0), generator=torch.Generator().manual_seed(0))
    Scan.from_counts(counts, g, air=1000.0, gain=1.0).save(scan)
    with warnings_off():
        here = reconstruct_to(scan, grid, tmp_path / "here.nii")
    executor = request.getfixturevalue(where)
    if where == "cluster":  # on disks of their own
        monkeypatch.setattr(
            execute, "marker", lambda folder: contextlib.nullcontext(folder / "not" / "there")
        )
    executor.log = tmp_path / "run.log"

    def interrupted(self, values):
        made(self, values)
        raise KeyboardInterrupt

    with execute.using(executor), warnings_off():
        monkeypatch.setattr(SlabFile, "write", interrupted)
        with pytest.raises(KeyboardInterrupt):
            reconstruct_to(scan, grid, tmp_path / "there.nii")
        monkeypatch.setattr(SlabFile, "write", made)
        there = reconstruct_to(scan, grid, tmp_path / "there.nii")
    assert (tmp_path / "there.nii").read_bytes() == (tmp_path / "here.nii").read_bytes()
    assert (here["slabs"], there["slabs"], there["resumed_at"]) == (1, 4, 3)  # of what was left
    assert here["warnings"] == there["warnings"]
    assert "done     slices 0 … 2" in executor.log.read_text()
    assert not list(tmp_path.glob("*unfinished*"))
    executor.log = None


@contextlib.contextmanager
def warnings_off():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def test_a_lambda_is_computed_here(task, process, tmp_path, caplog):
    mine = Method("mine", lambda realisation: realisation.fbp("soft"), kernels=("soft",))
    found = evaluate(task, ["fbp:soft", mine], n=8, folder=tmp_path, executor=process)
    assert {r["method"] for r in found.records} == {"fbp:soft", "mine"}
    assert "mine is computed in this process" in caplog.text


def test_without_an_executor_jobs_are_run_here_as_they_are(tmp_path):
    """In their order, with arguments that nobody could pickle; what is done stays done."""
    ran, seen = [], []

    def first(folder, number):
        (folder / "a").write_text("1")
        return number() + 1

    def second(folder):
        assert ran == ["first"]
        raise ValueError("no")

    jobs = [Job("first", first, (lambda: 41,)), Job("second", second, after=("first",), args=())]
    progress = lambda *step: seen.append(step)  # noqa: E731
    with pytest.raises(ValueError, match="no"):
        run(jobs, tmp_path / "new", None, progress, lambda job: ran.append(job.name))
    assert (tmp_path / "new" / "a").read_text() == "1"
    assert seen == [("first", 0.0), ("second", 0.5)]
    seen.clear()
    assert run(jobs[:1], tmp_path / "new", None, progress) == {"first": 42}
    assert seen == [("first", 0.0), ("first", 1.0)]
    assert run([], tmp_path / "none", None) == {}
    assert not (tmp_path / "none").exists()


@pytest.mark.extended
def test_a_job_whose_process_dies_is_repeated_and_left_out_after_three(
    processes, tmp_path, caplog, capfd
):
    jobs = [
        Job("once", dies, ("once", 1)),
        Job("always", dies, ("always", 9)),
        Job("needs it", noted, ("n", 1), after=("always",)),
        *(Job(f"other {k}", noted, (f"o{k}", k)) for k in range(8)),
    ]
    processes.log = tmp_path / "run.log"
    with pytest.raises(
        LeftOut,
        match=r"2 of 11 jobs are missing: always \(its process died \(SIGKILL: .*\)\); needs it "
        r"\(needs alw",
    ):
        run(jobs, tmp_path, processes)
    assert (tmp_path / "once.txt").exists()
    assert len(list(tmp_path.glob("o*.txt"))) == 9
    assert (tmp_path / "always.deaths").read_text() == "xxx"
    text = processes.log.read_text()
    assert text.count("done     ") == 9
    assert text.count("failed   ") == 4
    assert caplog.messages.count("noted 3") == 1  # what a worker says is said here
    assert "noted" not in capfd.readouterr().err


def test_how_a_process_ended_is_waited_for():
    """Two threads wait for a process: who comes second is told nothing until the first has noted
    it."""

    class Child:
        def __init__(self):
            self.told = [None, None, -signal.SIGKILL, -signal.SIGKILL]

        def join(self, timeout):
            pass

        @property
        def exitcode(self):
            return self.told.pop(0)

    assert execute._how_it_ended([Child()]).startswith("SIGKILL")


@pytest.mark.extended
@pytest.mark.slow
@pytest.mark.cluster
def test_a_job_that_kills_workers_of_a_cluster_is_left_out_alone(cluster, tmp_path):
    """Dask counts every job that a dead worker had been given: the others must not be among
    them."""
    jobs = [
        Job("once", dies, ("once", 1)),
        Job("always", dies, ("always", 99)),
        *(Job(f"other {k}", noted, (f"o{k}", k)) for k in range(8)),
    ]
    with pytest.raises(LeftOut, match=r"1 of 10 jobs are missing: always \(KilledWorker"):
        run(jobs, tmp_path, cluster)
    assert len(list(tmp_path.glob("o*.txt"))) == 9


def test_what_a_job_itself_refuses_ends_the_run(process, tmp_path):
    with pytest.raises(ValueError, match="bad input"):
        run([Job("bad", refuses, ())], tmp_path, process)
    with pytest.raises(execute.Unportable):
        run([Job("lambda", lambda folder: None, ())], tmp_path, process)


def test_threads_of_all_libraries_are_the_workers(process, tmp_path):
    assert run([Job("t", threads_of, ())], tmp_path, process)["t"] == (1, 1, 1)


@pytest.mark.extended
@pytest.mark.cluster
def test_threads_on_a_cluster(cluster, tmp_path):
    """Of each job what its command asks for, whatever another command asked of the same worker."""
    one = [Job("t", threads_of, ())]
    found = []
    for number in (1, 2, 1):
        cluster.threads = number
        cluster.avoid = {"127.0.0.2": "the other worker would do as well"}
        found.append(run(one, tmp_path, cluster)["t"])
    cluster.avoid = {}
    assert found == [(1, 1, 1), (2, 2, 2), (1, 1, 1)]


@pytest.mark.extended
def test_workers_of_a_machine_compile_a_kernel_once(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    with Processes(2, 1) as executor:
        executor.log = tmp_path / "run.log"
        run([Job(f"{k}", compiles, (f"{k}", 2)) for k in range(2)], tmp_path, executor)
    assert executor.log.read_text().count("s of it compiling") == 1


@pytest.mark.extended
@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_a_signal_ends_the_processes_and_takes_back_what_is_half_written(tmp_path):
    """SIGTERM to the command alone, as ``kill`` sends it; a batch system sends it to its
    processes, too."""
    log, jobs = (
        tmp_path / "log",
        [Job("quick", noted, ("q", 1)), Job("holds", holds, (60.0,), after=("quick",))],
    )
    log.mkdir()

    def signalled():
        wait_until((tmp_path / "begun").exists)
        os.kill(os.getpid(), signal.SIGTERM)

    def command():
        with ending_by_signals(), Processes(1, 1) as executor:
            executor.log = log / "run.log"
            run(jobs, tmp_path, executor)

    sender = threading.Thread(target=signalled)
    sender.start()
    with pytest.raises(Ended, match="ended by SIGTERM") as ended:
        command()
    sender.join()
    assert ended.value.number == signal.SIGTERM
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "begun").read_text()), 0)
    assert {p.name for p in tmp_path.iterdir()} == {"q.txt", "begun", "log"}
    assert (
        "ended    ended by SIGTERM: 1 of 2 jobs are done, and kept" in (log / "run.log").read_text()
    )


def wait_until(condition, seconds=600.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="signals")
@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_signal_ends_evaluate(tmp_path, name):
    number = getattr(signal, name)
    command = [
        sys.executable,
        "-c",
        "import sys; from recon.cli import main; sys.exit(main())",
        "evaluate",
        "--task",
        "nodule",
        "--method",
        "fbp:soft",
        "--n",
        "400",
        "--workers",
        "1",
        "--out",
        "out",
    ]
    path = os.pathsep.join(p for p in sys.path if p)
    with subprocess.Popen(
        command,
        cwd=tmp_path,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": path},
    ) as process:
        wait_until(lambda: list(tmp_path.glob("out/cache/**/*.h5")))
        children = psutil.Process(process.pid).children(recursive=True)
        process.send_signal(number)
        said = process.communicate(timeout=600)[1]
    assert process.returncode == 128 + number
    assert said.splitlines()[-1] == f"torchpcct evaluate: ended by {name}, nothing half written"
    assert "Traceback" not in said
    assert children
    assert not psutil.wait_procs(children, 100.0)[1]
    assert not [p for p in tmp_path.rglob("*.part.*")]


@pytest.mark.extended
def test_what_lies_in_the_current_folder_hides_no_module(tmp_path, monkeypatch):
    """Neither in a process when it starts, nor later; a module of the user's own is found there,
    after all others."""
    for name in ("selectors", "spekpy", "mine"):
        (tmp_path / f"{name}.py").write_text("")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [p for p in sys.path if p not in ("", str(tmp_path))])
    with Processes(1, 1) as executor:
        (found,) = run([Job("a", found_in, ("spekpy",))], tmp_path, executor).values()
        assert str(tmp_path) not in " ".join(found)
        with pytest.raises(ModuleNotFoundError):
            run([Job("b", found_in, ("mine",))], tmp_path, executor)
        monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path)])
        (found,) = run([Job("c", found_in, ("mine",))], tmp_path, executor).values()
        assert found[0] == str(tmp_path / "mine.py")
        (found,) = run([Job("d", found_in, ("xraydb",))], tmp_path, executor).values()
        assert str(tmp_path) not in " ".join(found)


@pytest.mark.parametrize(
    ("method", "is_of_a_module"),
    [
        ("fbp:soft", False),
        ("pwls", False),
        ("mbir:tissues", False),
        ("files:a/b", False),
        ("tv@fbp:soft", False),
        ("mylab.nets:reconstruct", True),
        ("mylab.nets:denoise@fbp:detail", True),
    ],
)
def test_modules_are_looked_for_in_the_current_folder_only_for_a_method_of_one(
    method, is_of_a_module, here, monkeypatch
):
    monkeypatch.setattr(sys, "path", [p for p in sys.path if p not in ("", str(here))])
    before, seen = list(sys.path), []
    Path("a/b").mkdir(parents=True)
    monkeypatch.setattr(
        "recon.evaluate.experiment.evaluate", lambda *_, **__: seen.append(list(sys.path))
    )
    assert main(["evaluate", "--task", "nodule", "--method", method, "--out", "out"]) == 0
    assert seen == [[*before, os.getcwd()] if is_of_a_module else before]


@pytest.mark.cluster
def test_a_job_that_is_done_while_the_scheduler_answers_is_no_loss(unconnected, monkeypatch):
    """Keys of jobs that are lost, asked for, and forgotten when the answer comes: the scheduler
    is not gone."""
    pytest.importorskip("distributed")
    asked, given = [], {"a": Future(), "b": Future()}

    def run_on_scheduler(function, keys):
        asked.append(keys)
        if len(asked) == 1:
            given["a"].set_result(1)
        return keys

    client = unconnected.client
    client.run_on_scheduler = run_on_scheduler
    client.futures = {k: SimpleNamespace(status="lost") for k in given}
    unconnected._given = given
    unconnected.check()
    assert asked == [["a", "b"]]
    unconnected.check()  # too soon to ask again
    client.futures["b"].status = "pending"
    monkeypatch.setattr(execute, "_AGAIN_S", 0.0)
    unconnected.check()
    assert len(asked) == 1
    client.futures["b"].status = "lost"
    with pytest.raises(ConnectionError, match="is gone"):
        unconnected.check()


@pytest.mark.cluster
def test_a_cluster_without_workers_says_so(unconnected, monkeypatch, caplog):
    pytest.importorskip("distributed")
    workers = []
    unconnected.client.scheduler_info = lambda n: {"workers": workers}
    for now, times_said in ((100.0, 0), (129.0, 0), (131.0, 1), (399.0, 1), (401.0, 2)):
        monkeypatch.setattr(execute, "time", SimpleNamespace(monotonic=lambda now=now: now))
        unconnected.check()
        assert len(caplog.messages) == times_said
    assert caplog.messages[0].startswith("no worker since 31 s: jobs wait until one comes to the")
    workers.append("tcp://127.0.0.1:2")
    monkeypatch.setattr(execute, "time", SimpleNamespace(monotonic=lambda: 402.5))
    unconnected.check()
    assert unconnected._without == (None, execute._NO_WORKER_S)


@pytest.mark.cluster
@pytest.mark.parametrize("away_s", [2.0, 299.0, 310.0])
def test_a_machine_that_comes_back_is_waited_for_where_another_is_left_aside(
    unconnected, monkeypatch, tmp_path, away_s
):
    """While it was started again, all jobs were left out; after minutes they are."""
    pytest.importorskip("distributed")
    one, other, now = "tcp://127.0.0.1:1", "tcp://127.0.0.2:2", [0.0]
    unconnected.client.scheduler_info = lambda n: {
        "workers": [other] if 0.0 < now[0] <= away_s else [one, other]
    }
    unconnected.submit = lambda function, *given: _done(function(*given))
    clock = SimpleNamespace(
        monotonic=lambda: now[0],
        sleep=lambda seconds: now.__setitem__(0, now[0] + seconds),
        perf_counter=time.perf_counter,
    )
    monkeypatch.setattr(execute, "time", clock)
    assert unconnected.workers == 2
    unconnected.avoid["127.0.0.2"] = "its disk is full"
    assert unconnected.workers == 1
    now[0] = 1.5
    if away_s < execute._BACK_S:
        assert run([Job("x", noted, ("x", 1))], tmp_path, unconnected)["x"][0] == 1
        assert now[0] > away_s
    else:
        with pytest.raises(LeftOut, match="no worker is left: its disk is full"):
            run([Job("x", noted, ("x", 1))], tmp_path, unconnected)
    unconnected.avoid["127.0.0.1"] = "its disk is full, too"
    assert unconnected.hopeless


def _done(value):
    future = Future()
    future.set_result(value)
    return future


@pytest.mark.extended
@pytest.mark.cluster
def test_a_full_disk_of_one_machine_is_named_and_the_rest_goes_on(cluster, tmp_path, caplog):
    jobs = [Job(f"{k}", full, (f"f{k}", "127.0.0.1")) for k in range(6)]
    try:
        assert len(run(jobs, tmp_path, cluster)) == 6
        assert list(cluster.avoid) == ["127.0.0.1"]
        assert re.search(
            r"the worker tcp://127\.0\.0\.1:\d+ cannot write: .*No space left on device",
            caplog.text,
        )
        more = [Job(f"{k}", full, (f"f{k}", "127.0.0.2")) for k in range(6)]
        with pytest.raises(
            LeftOut, match=r"6 of 6 jobs are missing.*no worker is left: .*No space left on device"
        ):
            run(more, tmp_path, cluster)
    finally:
        cluster.avoid.clear()


@pytest.mark.extended
@pytest.mark.cluster
def test_a_worker_of_another_version_gets_no_jobs(cluster, tmp_path, caplog):
    (old,) = [a for a in cluster._addresses if "127.0.0.2" in a]
    try:
        cluster.client.run(set_version, "0.0.9", workers=[old])
        cluster.log = tmp_path / "run.log"
        run([Job(f"{k}", waits, (0.3,)) for k in range(6)], tmp_path, cluster)
        assert cluster.log.read_text().count("on tcp://127.0.0.1:") == 6
        assert f"the worker {old} has another torchpcct (its version 0.0.9" in caplog.text
    finally:
        cluster.log = None
        cluster.client.run(set_version, execute.VERSION, workers=[old])
        cluster.avoid.clear()


def test_what_is_installed_while_a_worker_runs_it_does_not_have(tmp_path):
    path = tmp_path / "module.py"
    path.write_text("a")
    found = _content(path)
    path.write_text("b")
    assert _content(path) == found


def test_another_version_is_refused(process, tmp_path, monkeypatch):
    monkeypatch.setattr(execute, "VERSION", "0.0.9")
    with pytest.raises(ValueError, match=r"has another torchpcct.*install the same one"):
        run([Job("x", noted, ("x", 1))], tmp_path, process)
    monkeypatch.undo()
    monkeypatch.setattr(execute, "source_digest", lambda module: "others")
    with pytest.raises(ValueError, match="has another torchpcct"):
        run([Job("x", noted, ("x", 1))], tmp_path, process)


@pytest.mark.cluster
def test_an_unreachable_scheduler_is_told_in_one_sentence(here, cli, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(execute, "_ANSWER_S", 0.5)
    said = cli("evaluate --out out --scheduler tcp://127.0.0.1:9", 2)
    (output,) = [line for line in said.splitlines() if line]
    assert "no Dask scheduler answers at tcp://127.0.0.1:9 within 0.5 s" in output
    said = cli("evaluate --out out --scheduler none.json", 2)
    assert "neither an address, tcp://HOST:PORT, nor a scheduler's file" in said


@pytest.mark.extended
@pytest.mark.cluster
def test_a_scheduler_that_dies_is_told_in_one_sentence_and_what_is_done_is_kept(tmp_path):
    pytest.importorskip("distributed")
    file = tmp_path / "scheduler.json"
    words = (
        "scheduler --host 127.0.0.1 --port 0",
        "worker --nthreads 1 --no-nanny --death-timeout 600",
    )
    started = [
        subprocess.Popen(
            [
                sys.executable,
                "-m",
                "dask",
                *text.split(),
                "--no-dashboard",
                "--scheduler-file",
                file,
            ],
            cwd=tmp_path,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        )
        for text in words
    ]
    try:
        wait_until(file.exists)
        jobs = [
            Job("first", noted, ("first", 1)),
            Job("second", kills, (started[0].pid,), after=("first",)),
        ]
        with pytest.raises(ConnectionError, match="is gone: what is done is kept"):
            run(jobs, tmp_path, Cluster(str(file)))
    finally:
        for process in started:
            process.kill()
            process.wait()
    assert (tmp_path / "first.txt").read_text() == "1"


@pytest.mark.cluster
def test_the_recipe_of_dask_jobqueue():
    """The page prints the script of a worker that SLURM would be given."""
    pytest.importorskip("dask_jobqueue")
    flags = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    with warnings_off():  # its scheduler looks for a free port
        found = doctest.testfile(str(PAGE), module_relative=False, optionflags=flags)
    assert found.attempted > 3
    assert not found.failed


SRUN = """#!/bin/bash
echo "$@" >> "$CALLS"
while [[ $1 == --* ]]; do shift; done
exec "$@"
"""
COMMAND = """#!{python}
import sys
sys.path[:0] = {path!r}
from pathlib import Path
from some_jobs import noted
from recon.jobs import execute
from recon.jobs.execute import Cluster, Job, run
execute._ANSWER_S = 300.0
cluster = Cluster(sys.argv[sys.argv.index("--scheduler") + 1])
run([Job("x", noted, ("x", 1))], Path({folder!r}), cluster)
"""


@contextlib.contextmanager
def job_of_the_page(folder, srun):
    """The page's script for SLURM as it stands, run in a folder: its process and its text."""
    (script,) = re.findall(r"```bash\n(#!/bin/bash.*?)```", PAGE.read_text(encoding="utf-8"), re.S)
    path = [p for p in sys.path if p]
    texts = {
        "srun": srun,
        "torchpcct": COMMAND.format(python=sys.executable, path=path, folder=str(folder)),
        "job": script.replace("/shared/$USER", str(folder)),
    }
    for name, text in texts.items():
        (folder / name).write_text(text)
        (folder / name).chmod(0o755)
    environment = {
        **os.environ,
        "PATH": os.pathsep.join(
            [str(folder), str(Path(sys.executable).parent), os.environ["PATH"]]
        ),
        "SLURM_JOB_ID": "17",
        "CALLS": str(folder / "calls"),
        "PYTHONPATH": os.pathsep.join(path),
    }
    job = subprocess.Popen(
        [folder / "job"],
        cwd=folder,
        env=environment,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        yield job, script
    finally:
        with contextlib.suppress(ProcessLookupError):  # none of its steps is left
            os.killpg(job.pid, signal.SIGKILL)  # as SLURM ends the steps of a job that is over
        job.wait()


@pytest.mark.extended
@pytest.mark.cluster
def test_the_recipe_of_srun(tmp_path):
    """The page's script with an ``srun`` that starts one process of each step here."""
    pytest.importorskip("distributed")
    with job_of_the_page(tmp_path, SRUN) as (job, script):
        assert job.wait(600) == 0
    assert (tmp_path / "x.txt").read_text() == "1"
    tasks = re.findall(r"--ntasks=(\d+) --exact", (tmp_path / "calls").read_text())
    assert sum(map(int, tasks)) == int(re.search(r"#SBATCH --ntasks=(\d+)", script)[1])


@pytest.mark.skipif(os.name != "posix", reason="a script of bash")
def test_the_recipe_of_srun_ends_where_the_scheduler_does(tmp_path):
    """It would wait for the scheduler's file until the allocation is over."""
    failing = SRUN.replace('exec "$@"', "exit 3")
    with job_of_the_page(tmp_path, failing) as (job, _):
        assert job.wait(60) == 1
    assert "torchpcct" not in (tmp_path / "calls").read_text()


def test_a_dry_run_lists_the_jobs(here, cli):
    text = cli("evaluate --task plaque --n 16 --dry-run --out x")
    assert "plaque: 2 s, 8-16, fbp:soft" in text
    assert "core hours" in text
    assert not list((here / "x").rglob("*.npz"))


LISTED = {
    "compare": "plaque: scan, signal present",
    "detector": "pile_up 20.0",
    "bowtie": "kept noise_thorax",
    "motion": "scan EID-CT 0.0",
    "paths": "50 jobs",
    "hardcases": "anatomy ",
    "recovery": "realisation 2.0 1",
    "spectral": "noisy 0",
}
"""A job of each study that has any."""


@pytest.mark.parametrize("name", registry.STUDIES)
def test_a_dry_run_of_a_study_computes_nothing(here, cli, name, monkeypatch):
    def measure(*_):
        raise AssertionError

    monkeypatch.setattr(registry.part(name), "measure", measure)
    text = cli(f"study {name} --dry-run --out x")
    assert LISTED.get(name, "nothing was run") in text
    assert not [path for path in here.rglob("*") if path.is_file()]


def test_a_dry_run_leaves_out_what_is_done(here, cli):
    settings = registry.build_settings("detector")
    cache = StudyCache(here / "x", settings)
    function, calls = registry.part("detector")._pile_ups(settings)
    for job in cache._left(function, calls[:2]):
        cache._store.cached(cache._done(job), cache._key, dict)
    text = cli("study detector --dry-run --out x")
    assert "1 jobs" in text
    assert "pile_up 100.0" in text


CALLED = """
import pickle, sys
from pathlib import Path
from recon.evaluate.realisations import Realisations
from recon.evaluate.measure import Measurement, Reader
from recon.jobs.sources import _follow
from recon.jobs.store import Store
seen, called = set(), set()
_follow("recon.evaluate.measure", "", seen)
known = {name for name, _ in seen}
def note(frame, event, what):
    name = frame.f_globals.get("__name__", "")
    if event == "call" and name not in known and name.startswith(("torchpcct", "recon", "train")):
        while frame.f_code.co_name != "<module>" or frame.f_globals["__name__"] == "__main__":
            frame = frame.f_back
            if frame is None:  # not while modules load
                called.add(name)
                return
sys.setprofile(note)
task, methods = pickle.loads(Path(sys.argv[1]).read_bytes())
draws = Realisations(task, Store(Path(sys.argv[2])), 0, [k for m in methods for k in m.kernels])
reader = Reader(task, task.truth(draws.ground_truth))
for m in methods:
    Measurement(m, draws, reader, 20.0)
sys.setprofile(None)
print(*called)
"""


@pytest.mark.extended
def test_a_digest_covers_all_that_a_result_needs(task, tmp_path):
    """Every function that is called while a result is computed stands in a module that the digest
    has read, and the digest reads neither studies nor the command line."""
    (tmp_path / "given").write_bytes(pickle.dumps((task, [method_of(m) for m in METHODS])))
    called = run_python(CALLED, tmp_path / "given", tmp_path / "store").stdout.split()
    packages = {"recon", "torchpcct"}  # where lazy names are looked up
    assert set(called) - packages == set()
    seen = set()
    _follow("recon.evaluate.experiment", "", seen)
    assert not [m for m, _ in seen if m.startswith(("recon.cli", "recon.study", "train"))]
    assert source_digest("recon.evaluate.measure") != source_digest("recon.study.hardcases.measure")
