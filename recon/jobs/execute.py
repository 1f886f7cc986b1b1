"""Jobs in other processes and on other machines, through any :class:`concurrent.futures.Executor`.

A job computes files of a folder (entries of a :class:`~recon.jobs.store.Store`, volumes);
afterwards the one program that everybody knows reads them and goes on, as if it had computed them
itself before it was interrupted. So what comes out does not depend on where it was computed, and
whatever dies, nothing finished is lost.

* serial: no executor, in this process;
* :class:`Processes`: of this machine (spawned), one job each at a time; a process that dies takes
  its own job alone;
* :class:`Cluster`: the workers of a Dask scheduler. Who repeats a job of a worker that died is
  Dask.

Where a worker sees the folder (the disk is shared) it writes there; where it does not, it computes
in a folder of its own, and the files come back with the job's result.
"""

from __future__ import annotations

import contextlib
import errno
import importlib
import logging
import multiprocessing
import os
import pickle
import platform
import secrets
import signal
import socket
import sys
import threading
import time
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ThreadPoolExecutor,
)
from concurrent.futures import ProcessPoolExecutor as Pool
from concurrent.futures import wait as wait_for
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from tempfile import gettempdir
from typing import TYPE_CHECKING, Any, TypeVar

from recon.jobs.sources import source_digest
from torchpcct.files import VERSION, WriteError, atomic_write, is_foreign, marker
from torchpcct.kernel_cache import compiled_once
from torchpcct.validate import whole

if TYPE_CHECKING:
    from multiprocessing.process import BaseProcess
    from types import FrameType, TracebackType


__all__ = ["Cluster", "Job", "LeftOut", "Processes", "Unfit", "Unportable", "using"]

log = logging.getLogger(__name__)

DEATHS = 3
"""Of processes until a job is left out; a Dask scheduler counts by itself."""
_ANSWER_S = 8.0
"""That a scheduler may take."""
_AGAIN_S = 0.5
"""Until a scheduler is asked a second time for a job that it does not know, or for a worker."""
_NO_WORKER_S = 30.0
"""Until a cluster without workers is reported."""
_BACK_S = 300.0
"""For which a machine that is gone is waited for where all others are left aside: a worker that
died is started again, which takes long on a busy machine."""
_LAST_S = 5.0
"""Between asking processes to end and ending them."""
_NOTED_S = 0.01
"""Until it is asked again how a process ended."""
_SAFE_PATH = "PYTHONSAFEPATH"
"""Environment variable by which Python leaves the current folder out of its path."""

_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO)
"""Errors of a disk that is full, read-only or broken."""

Progress = Callable[[str, float], None]


class LeftOut(RuntimeError):
    """Jobs that could not be done anywhere; all others are done, and kept."""


class Planned(Exception):
    """All jobs were listed, none was run (``--dry-run``)."""


class Unportable(TypeError):
    """A function or value that no other process can be given."""


class Unfit(ValueError):
    """A worker that cannot take jobs, named: its torchpcct is another one, it takes several at
    once, its disk is full.

    Args:
        worker: its address.
        why: what is wrong with it.
    """

    def __str__(self) -> str:
        return f"the worker {self.args[0]} {self.args[1]}"


@dataclass(frozen=True)
class Job:
    """Something to compute.

    Args:
        name: unique; it says to people what it is.
        function: of a module, called as ``function(folder, *args)``; it writes into ``folder`` what
            is not there yet.
        args: to be pickled; all that the result depends on, seeds too.
        makes: patterns of the files in ``folder`` that are wanted back from a disk that is not
            shared.
        after: names of jobs that have to be done before.
        module: the one whose sources, with all they import, must be the worker's; empty: that of
            ``function``.
        seconds, mib, bytes: expected on one core, in memory, and on the disk; 0: not known.
    """

    name: str
    function: Callable[..., object]
    args: tuple[Any, ...]
    makes: tuple[str, ...] = ()
    after: tuple[str, ...] = ()
    module: str = ""
    seconds: float = 0.0
    mib: float = 0.0
    bytes: float = 0.0


@dataclass(frozen=True)
class _Run:
    """What the jobs of a run share; ``path``: a folder of modules, looked into after all others."""

    folder: str
    marker: str
    client: tuple[str, int]
    threads: int | None
    version: str
    path: str


@dataclass
class _Done:
    """What comes back: ``messages`` are what was logged as warnings."""

    where: str
    value: object = None
    files: dict[str, bytes] = field(default_factory=dict)
    seconds: float = 0.0
    compiled_s: float = 0.0
    messages: list[str] = field(default_factory=list)


# --- where jobs are run ---------------------------------------------------------------------------


_current: ContextVar[Executor | None] = ContextVar("executor", default=None)


def current() -> Executor | None:
    """The executor of the innermost :func:`using`; None: everything is computed here, one after
    another."""
    return _current.get()


@contextlib.contextmanager
def using(executor: Executor | None) -> Iterator[None]:
    """Let evaluations and studies of a block run their jobs by an executor."""
    token = _current.set(executor)
    try:
        yield
    finally:
        _current.reset(token)


T = TypeVar("T")


class Processes(ThreadPoolExecutor):
    """Processes of this machine. Each has a thread that waits for it, and is replaced if it dies.

    Args:
        workers: number of processes.
        threads: of each; None: they share the cores.
        preload: a module that is slow to load and that the jobs need: processes load it at once.
    """

    def __init__(self, workers: int, threads: int | None = None, preload: str = "") -> None:
        self.workers = whole("workers", workers)
        self.threads = whole("threads", threads or max(1, (os.cpu_count() or 1) // workers))
        super().__init__(workers)
        self._own, self._pools, self._starting = threading.local(), list[Pool](), threading.Lock()
        self._ended = False
        # all of them load what is slow to load, while the first jobs are thought of
        for _ in range(workers):
            self.submit(_load, preload)

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        """See :class:`concurrent.futures.Executor`; ``BrokenProcessPool`` is the death of this
        job's process alone."""
        return super().submit(self._in_process, fn, *args, **kwargs)

    def _in_process(self, fn: Callable[..., T], *args: object) -> T:
        pool: Pool | None = getattr(self._own, "pool", None)
        if pool is None:
            pool = Pool(
                1,
                multiprocessing.get_context("spawn"),
                initializer=_begin_process,
                initargs=(os.environ.get(_SAFE_PATH),),
            )
            self._own.pool = pool
            self._pools.append(pool)
        children: list[BaseProcess] = []
        try:
            # a process starts when it is first given something
            with self._starting, _without_current_folder():
                if self._ended:
                    raise BrokenExecutor("ended")
                job = pool.submit(fn, *args)
                children = _children(pool)
            return job.result()
        except BrokenExecutor as error:
            self._own.pool = None
            error.add_note(_how_it_ended(children))  # for the report of the run
            raise

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """What is running is finished, but for an interruption (Ctrl-C, a signal of the system)."""
        if kind is not None and issubclass(kind, KeyboardInterrupt):
            self.end()
        self.shutdown(cancel_futures=kind is not None)

    def end(self) -> None:
        """End the processes now: each is asked to, and has a few seconds to take back what it is
        writing."""
        with self._starting:
            self._ended = True
        super().shutdown(wait=False, cancel_futures=True)
        children = [p for pool in self._pools for p in _children(pool)]
        for child in children:
            child.terminate()
        until = time.monotonic() + _LAST_S
        for child in children:
            child.join(max(0.0, until - time.monotonic()))
            if child.is_alive():
                child.kill()

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """See :class:`concurrent.futures.Executor`."""
        super().shutdown(wait, cancel_futures=cancel_futures)
        for pool in self._pools:
            pool.shutdown(wait, cancel_futures=cancel_futures)


def _children(pool: Pool) -> list[BaseProcess]:
    """Its processes, of which the library says nothing in public."""
    return list((getattr(pool, "_processes", None) or {}).values())


def _how_it_ended(children: Sequence[BaseProcess]) -> str:
    """Signal or status by which a process of :class:`Processes` ended; empty: it is not known."""
    until = time.monotonic() + _LAST_S
    for child in children:
        child.join(_LAST_S)
        # The pool waits for it, too: who comes second is told nothing until the first has noted it.
        while child.exitcode is None and time.monotonic() < until:
            time.sleep(_NOTED_S)
        code = child.exitcode or 0
        if code > 0:
            return f"status {code}"
        if code == -getattr(signal, "SIGKILL", 9):
            return "SIGKILL: somebody's, or the system's where memory is short"
        if code < 0:
            return next((s.name for s in signal.Signals if s == -code), f"signal {-code}")
    return ""


def _load(module: str) -> None:
    if module:
        importlib.import_module(module)
    # of all files as they are loaded: what is installed while a worker runs, it does not have
    source_digest()


@contextlib.contextmanager
def _without_current_folder() -> Iterator[None]:
    """A process that is started meanwhile imports nothing from the current folder but what this
    process would.

    Python looks there first for the modules that it needs to start
    (https://docs.python.org/3/using/cmdline.html).
    """
    before = os.environ.get(_SAFE_PATH)
    os.environ[_SAFE_PATH] = "1"
    try:
        yield
    finally:
        _set_safe_path(before)


def _set_safe_path(value: str | None) -> None:
    if value is None:
        os.environ.pop(_SAFE_PATH, None)
    else:
        os.environ[_SAFE_PATH] = value


class _EndSignal(BaseException):
    """A signal asks a process to end: what its job is writing is taken back on the way out."""


_working = False
"""Whether this process, one of :class:`Processes`, is at a job."""


def _begin_process(safe_path: str | None) -> None:
    """First thing in a process of :class:`Processes`.

    Args:
        safe_path: what Python's variable of this name was before it was started; its own programs
            find that again.
    """
    _set_safe_path(safe_path)

    def on_signal(number: int, frame: FrameType | None) -> None:
        if not _working:
            os._exit(128 + number)
        raise _EndSignal(number)

    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), on_signal)
    # A process whose parent was killed would wait for its next job forever.
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_after, args=(parent,), daemon=True).start()


def _end_after(parent: BaseProcess) -> None:
    parent.join()
    os._exit(1)


class Cluster(Executor):
    """The workers of a Dask scheduler, started with ``--nthreads 1``.

    Args:
        scheduler: its address, or the file of ``dask scheduler --scheduler-file``.
        threads: of each worker.
        preload: a module that is slow to load and that the jobs need: workers load it at once.

    Raises:
        ImportError: ``distributed`` is not installed.
        OSError: no scheduler answers.
    """

    def __init__(self, scheduler: str, threads: int | None = None, preload: str = "") -> None:
        try:
            from distributed import Client, fire_and_forget
        except ImportError as error:
            raise ImportError("--scheduler needs Dask: pip install 'torchpcct[cluster]'") from error
        is_file = scheduler.endswith(".json") or Path(scheduler).is_file()
        if is_file and not Path(scheduler).is_file():
            raise FileNotFoundError(
                f"{scheduler} does not exist: dask scheduler --scheduler-file writes it"
            )
        given = {"scheduler_file": scheduler} if is_file else {"address": scheduler}
        quiet = logging.getLogger("distributed")
        level, self.address, self.threads = quiet.level, scheduler, whole("threads", threads or 1)
        quiet.setLevel(logging.CRITICAL)  # its own account of the same, in many lines
        try:
            self.client = Client(**given, timeout=_ANSWER_S, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            raise ConnectionError(
                f"no Dask scheduler answers at {scheduler} within {_ANSWER_S:g} s"
            ) from error
        finally:
            quiet.setLevel(level)
        self.avoid: dict[str, str] = {}  # machine → why
        self._asked: tuple[float, list[str]] = -9.0, []
        self._given = dict[str, Future[Any]]()
        self._doubted: tuple[float, set[str]] = -9.0, set()
        self._without: tuple[float | None, float] = None, _NO_WORKER_S
        self._seen = set[str]()  # machines that have had a worker
        from cloudpickle import dumps

        self.dumps = dumps
        for address in self._addresses:
            first = self.client.submit(
                _load, preload, workers=[address], allow_other_workers=True, pure=False
            )
            # not kept: a worker that dies would lose it, and nobody needs it
            fire_and_forget(first)

    @property
    def workers(self) -> int:
        """As many as there are now."""
        return len(self._addresses)

    @property
    def _addresses(self) -> list[str]:
        now = time.monotonic()
        if now - self._asked[0] > 1.0:  # a way to the scheduler and back
            self._asked = now, list(self.client.scheduler_info(-1)["workers"])
            self._seen.update(map(_machine, self._asked[1]))
        return [a for a in self._asked[1] if _machine(a) not in self.avoid]

    @property
    def hopeless(self) -> bool:
        """Whether no worker is left that could take a job: every machine that has had one is left
        aside, or those that are not have been gone for minutes."""
        if self.workers or not self.avoid:
            return False
        since = self._without[0]
        return self._seen <= set(self.avoid) or (
            since is not None and time.monotonic() - since >= _BACK_S
        )

    @property
    def dashboard(self) -> str:
        """Address of the scheduler's page."""
        return str(self.client.dashboard_link)

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        """See :class:`concurrent.futures.Executor`."""
        # Machines, not workers: one that dies is started again under another address.
        only = {"workers": sorted(set(map(_machine, self._addresses)))} if self.avoid else {}
        kwargs["key"] = f"torchpcct-{secrets.token_hex(16)}"
        found: Future[T] = self.client.get_executor(pure=False, **only).submit(fn, *args, **kwargs)
        self._given[kwargs["key"]] = found
        return found

    def refuse(self, error: Unfit) -> None:
        """Give no more jobs to the machine of a worker, whose other workers have the same
        software and disks."""
        if self.avoid.setdefault(_machine(error.args[0]), str(error)) == str(error):
            log.warning("%s; jobs go to other machines", error)

    def check(self) -> None:
        """Raise ``ConnectionError`` if the scheduler is gone, or was: it has forgotten what it was
        given.

        A warning says that there is no worker, and for how long.
        """
        now = time.monotonic()
        if self.workers:
            self._without = None, _NO_WORKER_S
        since, tell_at = self._without
        since = now if since is None and not self.workers else since
        if since is not None and now - since >= tell_at:
            log.warning(
                "no worker since %.0f s: jobs wait until one comes to the scheduler %s (dask "
                "worker --nthreads 1); what is done is kept, Ctrl-C ends",
                now - since,
                self.address,
            )
            tell_at *= 10
        self._without = since, tell_at
        if self.client.status in ("closing", "closed"):
            raise _gone(self)
        # What only a dead worker held is lost as well, but the scheduler knows it and has it
        # computed again. A job that is done while the scheduler answers is forgotten rightly: so
        # only what runs on counts, and that twice.
        self._given = {key: future for key, future in self._given.items() if not future.done()}
        if not self._lost() or now - self._doubted[0] < _AGAIN_S:
            return
        try:
            # a lambda is sent whole: the scheduler need not have torchpcct
            unknown = self.client.run_on_scheduler(
                lambda keys, dask_scheduler: [
                    key for key in keys if key not in dask_scheduler.tasks
                ],
                self._lost(),
            )
        except (OSError, TimeoutError):
            return  # the client's status says so soon
        unknown = set(unknown).intersection(self._lost())
        if unknown & self._doubted[1]:
            raise _gone(self)
        self._doubted = time.monotonic(), unknown

    def _lost(self) -> list[str]:
        """Keys of jobs that are not done, and whose worker or scheduler is gone."""
        states = self.client.futures
        return [
            k
            for k, f in self._given.items()
            if not f.done() and getattr(states.get(k), "status", "") == "lost"
        ]

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Part from the scheduler, which goes on; what was submitted and is not done is dropped."""
        self.client.close()


def _machine(address: str) -> str:
    from distributed.comm import get_address_host

    return str(get_address_host(address))


# --- what a worker does ---------------------------------------------------------------------------


def _where() -> tuple[str, str | None, int]:
    """This worker's name, its folder if Dask gave it one, and how many jobs it takes at once."""
    distributed = sys.modules.get("distributed")
    try:
        worker: Any = distributed.get_worker()  # type: ignore[union-attr]
    except (AttributeError, ValueError):
        return f"{socket.gethostname()} process {os.getpid()}", None, 1
    return str(worker.address), str(worker.local_directory), int(worker.state.nthreads)


@lru_cache(maxsize=1)  # until another number is asked for
def _use_threads(threads: int) -> None:
    """In a worker: torch, BLAS and our own kernels. Dask sets none of the last two, and N
    workers would fight."""
    import torch
    from threadpoolctl import threadpool_limits

    from torchpcct.threads import set_num_threads

    threadpool_limits(threads)
    torch.set_num_threads(threads)
    set_num_threads(threads)


@contextlib.contextmanager
def _compiling(own: bool) -> Iterator[Callable[[], float]]:
    """Gives the seconds in which numba has compiled kernels. Of the workers of a machine each
    compiles others."""
    from numba.core import event

    timer = event.TimingListener()
    alone = contextlib.nullcontext() if own else compiled_once()
    with event.install_listener("numba:compile", timer), alone:
        yield lambda: timer.duration if timer.done else 0.0


@contextlib.contextmanager
def captured_warnings(*loggers: str, alone: bool = False) -> Iterator[list[str]]:
    """The warnings that loggers are given meanwhile; ``""`` is the root. ``alone``: no other
    handler gets them."""
    messages: list[str] = []

    class Listener(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            messages.append(record.getMessage())

    listener, watched = Listener(logging.WARNING), [logging.getLogger(name) for name in loggers]
    before = [logger.propagate for logger in watched]
    for logger in watched:
        logger.addHandler(listener)
        logger.propagate = logger.propagate and not alone
    try:
        yield messages
    finally:
        for logger, propagate in zip(watched, before, strict=True):
            logger.removeHandler(listener)
            logger.propagate = propagate


def _run_packed(call: bytes, module: str, digest: str, makes: tuple[str, ...], of: _Run) -> _Done:
    """Run a job where this is called."""
    global _working
    try:
        _working = True
        return _do_job(call, module, digest, makes, of)
    except _EndSignal as ended:
        os._exit(128 + ended.args[0])
    finally:
        _working = False


def _do_job(call: bytes, module: str, digest: str, makes: tuple[str, ...], of: _Run) -> _Done:
    own = of.client == (platform.node(), os.getpid())
    where, scratch, at_once = _where()
    if not own:
        if at_once > 1:
            raise Unfit(
                where,
                f"takes {at_once} jobs at once: start it with --nthreads 1 (more workers of a "
                "machine: --nworkers)",
            )
        if of.path and of.path not in sys.path and os.path.isdir(of.path):
            sys.path.append(of.path)
        source_digest()  # as in _load, for a worker that came later
        if (VERSION, source_digest(module)) != (of.version, digest):
            raise Unfit(
                where,
                f"has another torchpcct (its version {VERSION}, here {of.version}; the sources of "
                f"{module} differ): install the same one, and start it again",
            )
        if of.threads is not None:
            _use_threads(of.threads)
    function, args = pickle.loads(call)
    shared = own or Path(of.marker).exists()
    folder = Path(of.folder) if shared else Path(scratch or gettempdir()) / Path(of.marker).name
    start = time.perf_counter()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # What a worker logs the client logs for it; what its own process logs stands already.
        with _compiling(own) as compiled, captured_warnings(*([] if own else [""])) as messages:
            value = function(folder, *args)
    except OSError as error:
        if scratch is None or (error.errno not in _DISK and not isinstance(error, WriteError)):
            raise
        raise Unfit(where, f"cannot write: {error}") from error
    made = (
        {}
        if shared
        else {
            p.relative_to(folder).as_posix(): p.read_bytes()
            for pattern in makes
            for p in folder.glob(pattern)
        }
    )
    return _Done(where, value, made, time.perf_counter() - start, compiled(), messages)


# --- the client -----------------------------------------------------------------------------------


def packed_call(executor: Executor | None, value: object) -> bytes:
    """A value as a job of this executor carries it.

    Raises:
        Unportable: it cannot be pickled (a lambda, a function in a function), or another process
            would not find it.
    """
    dumps = getattr(executor, "dumps", None)
    try:
        return bytes((dumps or pickle.dumps)(value))
    except Exception as error:  # whatever pickling it raises
        raise Unportable(str(error)) from error


def run(
    jobs: Sequence[Job],
    folder: Path,
    executor: Executor | None,
    progress: Progress | None = None,
    finished: Callable[[Job], object] | None = None,
) -> dict[str, Any]:
    """Run jobs, as many at once as there are workers.

    Args:
        jobs: with what they need before them.
        folder: that they write into, made if need be.
        executor: any; by one of this module a job whose worker dies is repeated. None: in this
            process, one after another, with their arguments as they are.
        progress: called with a text and the finished fraction.
        finished: called with each job that is done, its files in ``folder``.

    Returns:
        Name → what the job's function gave.

    Raises:
        LeftOut: jobs of which three workers died, or for which no worker is left; all others are
            done.
        Unportable: a job that cannot be pickled.
        Unfit: a process that has other sources than this one; of a cluster such workers are left
            aside.
        ConnectionError: the scheduler is gone.
        Exception: whatever a job's function raises; those that are done are kept.
    """
    if isinstance(executor, Planner):
        raise Planned(_table(jobs))
    if not jobs:
        return {}
    folder.mkdir(parents=True, exist_ok=True)
    if executor is None:
        return _run_here(jobs, folder, progress, finished)
    with marker(folder) as here:
        of = _Run(
            str(folder.resolve()),
            str(here.resolve()),
            (platform.node(), os.getpid()),
            getattr(executor, "threads", None),
            VERSION,
            _current_folder(),
        )
        return _run(jobs, folder, executor, of, _Log(executor, jobs), progress, finished)


def _run_here(
    jobs: Sequence[Job],
    folder: Path,
    progress: Progress | None,
    finished: Callable[[Job], object] | None,
) -> dict[str, Any]:
    values = {}
    for k, job in enumerate(jobs):
        if progress is not None:
            progress(job.name, k / len(jobs))
        values[job.name] = job.function(folder, *job.args)
        if finished is not None:
            finished(job)
    if progress is not None:
        progress(jobs[-1].name, 1.0)
    return values


def _current_folder() -> str:
    """If this process finds modules there, so must those that work for it; else empty."""
    here = os.getcwd()
    return here if any(os.path.abspath(path) == here for path in sys.path) else ""


def _run(
    jobs: Sequence[Job],
    folder: Path,
    executor: Executor,
    of: _Run,
    run_log: _Log,
    progress: Progress | None,
    finished: Callable[[Job], object] | None,
) -> dict[str, Any]:
    names = {job.name for job in jobs}
    needs = {job.name: names.intersection(job.after) for job in jobs}
    next_: dict[str, list[Job]] = defaultdict(list)
    for job in jobs:
        for name in needs[job.name]:
            next_[name].append(job)
    ready = deque(job for job in jobs if not needs[job.name])
    values, lost, deaths = dict[str, Any](), dict[str, str](), Counter[str]()
    running: dict[Future[_Done], Job] = {}
    messages: set[str] = set()

    def leave_out(job: Job, why: str) -> None:
        if lost.setdefault(job.name, why) is why:
            for other in next_[job.name]:
                leave_out(other, f"needs {job.name}")

    try:
        while ready or running:
            workers, avoid = getattr(executor, "workers", 16), getattr(executor, "avoid", {})
            # No more than there are workers: what waits on one that dies would count as having
            # killed it.
            while ready and len(running) < max(1, workers):
                if isinstance(executor, Cluster) and avoid and not workers:
                    if not executor.hopeless:
                        break
                    leave_out(ready.popleft(), f"no worker is left: {'; '.join(avoid.values())}")
                    continue
                job = ready.popleft()
                module = job.module or job.function.__module__
                call = packed_call(executor, (job.function, job.args))
                running[
                    executor.submit(_run_packed, call, module, source_digest(module), job.makes, of)
                ] = job
            for future in wait_for(running, 1.0, FIRST_COMPLETED)[0] if running else ():
                job = running.pop(future)
                try:
                    done = future.result()
                except CancelledError:
                    raise _gone(executor) from None
                except Unfit as error:
                    if not isinstance(executor, Cluster):
                        raise
                    executor.refuse(error)
                    run_log.note(f"again    {job.name}: {error}")
                    ready.append(job)
                    continue
                except Exception as error:
                    why = _death(error, executor)
                    deaths[job.name] += 1
                    run_log.note(f"failed   {job.name}: {why}")
                    if deaths[job.name] < DEATHS and isinstance(executor, Processes):
                        ready.append(job)
                    else:
                        leave_out(job, why)
                    continue
                _keep(folder, done.files)
                values[job.name] = done.value
                run_log.done(job, done)
                for text in dict.fromkeys(done.messages):
                    if text not in messages:
                        messages.add(text)
                        log.warning("%s", text)
                if finished is not None:
                    finished(job)
                for other in next_[job.name]:
                    needs[other.name].discard(job.name)
                    if not needs[other.name] and other.name not in lost:
                        ready.append(other)
            if ready and not running:
                time.sleep(_AGAIN_S)
            if isinstance(executor, Cluster):
                executor.check()
            if progress is not None:
                progress(
                    run_log.text(len(values), len(running), len(lost)), len(values) / len(jobs)
                )
    except KeyboardInterrupt as error:
        run_log.note(
            f"ended    {error or 'interrupted'}: {len(values)} of {len(jobs)} jobs are done, and "
            "kept"
        )
        raise
    finally:
        for future in running:
            future.cancel()
    if lost:
        listed = [f"{name} ({why})" for name, why in lost.items()]
        raise LeftOut(
            f"{len(lost)} of {len(jobs)} jobs are missing: "
            f"{'; '.join(listed[:5])}{'; …' if listed[5:] else ''}. The others are done and kept: "
            "the same command tries these again"
        )
    return values


def _keep(folder: Path, files: dict[str, bytes]) -> None:
    """Write what came back from another disk; a file that no store wrote stays."""
    for name, data in files.items():
        path = folder / name
        if path.suffix == ".npz" and is_foreign(path):
            continue
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as part:
            part.write_bytes(data)


def _death(error: Exception, executor: Executor) -> str:
    """What to say of a job whose worker died; any other error is raised."""
    if isinstance(error, BrokenExecutor) and isinstance(executor, Processes):
        how = "; ".join(filter(None, getattr(error, "__notes__", ())))
        return f"its process died ({how})" if how else "its process died"
    if type(error).__name__ == "KilledWorker":  # of Dask, which has repeated it
        return "KilledWorker: every worker that took it died"
    raise error


def _gone(executor: Executor) -> ConnectionError:
    return ConnectionError(
        f"the scheduler {getattr(executor, 'address', '')} is gone: what is done is kept, the "
        "same command goes on"
    )


class _Log:
    """What a run says of itself: a line for each job in the executor's log file, and its
    progress."""

    def __init__(self, executor: Executor, jobs: Sequence[Job]) -> None:
        self.path: Path | None = getattr(executor, "log", None)
        self.weights = {job.name: job.seconds or 1.0 for job in jobs}
        self.start, self.finished, self.compiled_s = time.perf_counter(), 0.0, 0.0
        self.note(f"{len(jobs)} jobs, torchpcct {VERSION}, {platform.node()}: {' '.join(sys.argv)}")

    def note(self, text: str) -> None:
        """Write a line."""
        if self.path is not None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("a", encoding="utf-8") as file:
                file.write(f"{time.strftime('%Y-%m-%d %H:%M:%S')} {text}\n")

    def done(self, job: Job, by: _Done) -> None:
        """A job is done."""
        self.finished += self.weights[job.name]
        self.compiled_s += by.compiled_s
        compiled = f", {by.compiled_s:.1f} s of it compiling" if by.compiled_s else ""
        back = f", {sum(map(len, by.files.values()))} bytes back" if by.files else ""
        self.note(f"done     {job.name}: {by.seconds:.3f} s{compiled} on {by.where}{back}")

    def text(self, done: int, running: int, failed: int) -> str:
        """Of the progress: the step, and after a bar what changes."""
        left = sum(self.weights.values()) - self.finished
        seconds = (
            left * (time.perf_counter() - self.start) / self.finished if self.finished else None
        )
        until = (
            ""
            if seconds is None
            else f", {seconds / 60:.0f} min left"
            if seconds > 90
            else f", {seconds:.0f} s left"
        )
        compiled = f", {self.compiled_s:.0f} s compiling" if self.compiled_s else ""
        return f"jobs|{done} done, {running} running, {failed} failed{until}{compiled}"


class Planner(Executor):
    """No executor: :func:`run` lists the jobs and raises :class:`Planned` with the list."""

    workers = 1


def _table(jobs: Sequence[Job]) -> str:
    rows = [f"{'s':>8} {'MiB':>6} {'kB kept':>8}  job"]
    rows += [f"{j.seconds:8.1f} {j.mib:6.0f} {j.bytes / 1e3:8.0f}  {j.name}" for j in jobs]
    total = sum(j.seconds for j in jobs)
    rows.append(
        f"{len(jobs)} jobs, about {total / 3600:.2f} core hours, "
        f"{max((j.mib for j in jobs), default=0.0):.0f} MiB in a process, "
        f"{sum(j.bytes for j in jobs) / 1e6:.1f} MB kept (estimates of one core; 0: not known)"
    )
    return "\n".join(rows)
