"""A compiled kernel is not older than the functions it holds."""

import importlib
import os
import pkgutil
import re
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import filelock
import pytest
from fresh_python import run_python
from numba import TypingError
from numba.core import caching

import recon
import torchpcct
import train
from torchpcct.cache_folder import ensure_cache, private_folder
from torchpcct.kernel_cache import compiled_once, sources

HELPER = """
    from numba import njit
    @njit(cache=True)
    def value(x):
        return x + {}
"""
KERNEL = """
    from numba import njit
    from torchpcct.made_up.helper import value
    from torchpcct.kernel_cache import forget_outdated
    @njit(cache=True)
    def kernel(x):
        return 2 * value(x)
    {}
"""
RUN = """
    import sys, types
    package = types.ModuleType("torchpcct.made_up")
    package.__path__ = [sys.argv[1]]
    sys.modules["torchpcct.made_up"] = package
    from torchpcct.made_up.kernel import kernel
    print(kernel(1), sum(kernel.stats.cache_hits.values()))
"""


def run(folder):
    value, hits = run_python(
        textwrap.dedent(RUN), folder, NUMBA_CACHE_DIR=str(folder / "cache")
    ).stdout.split()
    return int(value), int(hits)


def edit(path, text, age):
    path.write_text(textwrap.dedent(text))
    then = time.time() + age
    os.utime(path, (then, then))


@pytest.mark.extended
@pytest.mark.parametrize(
    ("call", "second"),
    [("forget_outdated(__name__)", 202), pytest.param("", 4, marks=pytest.mark.slow)],
)
def test_an_edited_function_reaches_the_kernels_that_call_it(tmp_path, call, second):
    """Without the call numba gives the old result: if that ends, the module is of no use any
    more."""
    edit(tmp_path / "helper.py", HELPER.format(1), age=-100)
    edit(tmp_path / "kernel.py", KERNEL.format(call), age=-100)
    assert run(tmp_path) == (4, 0)
    assert run(tmp_path) == (4, 1)  # kept
    edit(tmp_path / "helper.py", HELPER.format(100), age=0)
    assert run(tmp_path)[0] == second
    # a wrong clock: no process compiles again and again
    edit(tmp_path / "helper.py", HELPER.format(1000), age=3600)
    assert run(tmp_path) == (second, 1)


def modules():
    for package in (torchpcct, recon, train):
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            source = Path(found.module_finder.path, *found.name.rpartition(".")[2:]).with_suffix(
                ".py"
            )
            if source.exists() and "cache=True" in source.read_text(encoding="utf-8"):
                yield found.name, source.read_text(encoding="utf-8")


def test_every_module_whose_kernels_hold_others_forgets_outdated_ones():
    seen = dict(modules())
    assert "torchpcct.projector.cpu.cone_kernels" in seen
    for name in seen:
        importlib.import_module(name)
    missing = [
        n
        for n, text in seen.items()
        if sources(n) and not re.search(r"\nforget_outdated\(\s*__name__", text)
    ]
    assert not missing
    held = {p.name for p in sources("torchpcct.projector.cpu.plane_kernels")}
    assert {"cone_kernels.py", "simd.py", "simd_interpolation.py"} <= held


SCRIPT = """
import hashlib, sys
import numba
import torch
from torchpcct import FanBeam, Projector, VolumeGrid, full_turn

numba.njit(lambda x: x)(1)  # of no concern to ours
print("theirs", file=sys.stderr, flush=True)
A = Projector(FanBeam(full_turn(50), 400.0, 700.0, 64, 2.0), VolumeGrid((40, 40), 1.0))
x = torch.rand(A.domain_shape, generator=torch.Generator().manual_seed(0))
y = A(x)
print([hashlib.sha256(v.numpy().tobytes()).hexdigest() for v in (y, A.T(y))])
"""


@pytest.mark.extended
def test_a_fresh_process_and_later_ones(tmp_path):
    found = [run_python(SCRIPT, NUMBA_CACHE_DIR=str(tmp_path)) for _ in range(2)]
    theirs, _, ours = found[0].stderr.partition("theirs")
    assert (theirs.count("compiling kernels"), ours.count("compiling kernels")) == (0, 1)
    assert "compiling kernels" not in found[1].stderr
    assert found[0].stdout == found[1].stdout


@pytest.fixture
def kernels(tmp_path, monkeypatch):
    """Two new kernels, kept in a cache of their own; locks in a cache folder of a user of their
    own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "user"))
    (tmp_path / "made_up_kernels.py").write_text(
        "from numba import njit\n"
        "@njit(cache=True)\ndef inner(x):\n    return x + 1\n"
        "@njit(cache=True)\ndef outer(x):\n    return 2 * inner(x)\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    sys.modules.pop("made_up_kernels", None)
    yield importlib.import_module("made_up_kernels")
    sys.modules.pop("made_up_kernels", None)


def locks(tmp_path):
    return sorted((tmp_path / "user" / "torchpcct" / "locks").glob("*.lock"))


def held(path):
    """Whether somebody has this lock."""
    lock = filelock.FileLock(path)
    try:
        lock.acquire(timeout=0)
    except filelock.Timeout:
        return True
    lock.release()
    return False


def test_each_kernel_has_a_lock_of_its_own_until_it_is_kept(kernels, tmp_path, monkeypatch):
    states, save = [], caching.Cache.save_overload

    def saved(kernel, *given):
        states.append([*map(held, locks(tmp_path))])
        save(kernel, *given)

    monkeypatch.setattr(caching.Cache, "save_overload", saved)
    with compiled_once():
        assert kernels.outer(1) == 4
        assert not any(map(held, locks(tmp_path)))
    assert [len(state) for state in states] == [2, 2]  # of inner, then of outer
    assert [sum(state) for state in states] == [2, 1]
    assert caching.Cache.load_overload.__qualname__ == "Cache.load_overload"


def test_nobody_waits_longer_than_he_has_patience_and_only_for_the_same_kernel(
    kernels, tmp_path, monkeypatch
):
    """By what is asked of the locks: how long compiling itself takes, the machine's load says."""
    with compiled_once():
        kernels.outer(1)
    everything = [filelock.FileLock(path) for path in locks(tmp_path)]
    for lock in everything:
        lock.acquire()
    asked, acquire = [], filelock.FileLock.acquire

    def acquired(lock, timeout=None, **given):
        asked.append(timeout)
        return acquire(lock, timeout, **given)

    monkeypatch.setattr(filelock.FileLock, "acquire", acquired)
    try:
        with compiled_once(patience_s=0.3):
            # another signature: not in the cache, and both locks are taken
            assert kernels.outer(1.5) == 5.0
        assert asked == [0.3, 0.0]
        fresh = importlib.reload(kernels)
        with compiled_once(patience_s=300.0):
            assert fresh.outer(2.5) == 7.0  # in the cache: no lock is asked for
        assert len(asked) == 2
    finally:
        for lock in everything:
            lock.release()


def test_a_compilation_that_fails_holds_no_lock(kernels, tmp_path):
    with compiled_once():
        with pytest.raises(TypingError):
            kernels.outer("text")
        assert locks(tmp_path)
        assert not any(map(held, locks(tmp_path)))


@pytest.mark.parametrize("case", ["link", "others may write", "no home", "a file"])
def test_without_a_folder_of_ones_own_there_is_no_lock(kernels, tmp_path, monkeypatch, case):
    user, target = tmp_path / "user", tmp_path / "victim"
    target.mkdir()
    if case == "link":
        user.mkdir()
        (user / "torchpcct").symlink_to(target, target_is_directory=True)
    elif case == "others may write":
        (user / "torchpcct").mkdir(parents=True)
        (user / "torchpcct").chmod(0o777)
    elif case == "a file":
        user.write_text("mine")
    else:
        monkeypatch.setenv("XDG_CACHE_HOME", "relative")
        monkeypatch.setattr(Path, "home", lambda: (_ for _ in ()).throw(RuntimeError("no home")))
    assert private_folder("locks") is None
    if case == "link":
        with compiled_once():
            assert kernels.outer(1) == 4
    assert list(target.iterdir()) == []
    if case == "a file":
        assert user.read_text() == "mine"


def test_locks_need_nothing_that_windows_lacks(kernels, tmp_path, monkeypatch):
    """``os.getuid`` and ``fcntl`` are of Unix alone."""
    monkeypatch.delattr(os, "getuid", raising=False)
    monkeypatch.setitem(sys.modules, "fcntl", None)
    with compiled_once():
        assert kernels.outer(1) == 4
    assert len(locks(tmp_path)) == 2


def test_where_nothing_can_be_kept_a_temporary_folder_is(tmp_path):
    """A read-only installation of a user without a home: numba refused to load the kernels."""
    code = (
        "import os; from pathlib import Path; import torchpcct.cache_folder as k; "
        "os.access = lambda *_: False; k._writable = lambda _: False; k.ensure_cache(); "
        "f = Path(os.environ['NUMBA_CACHE_DIR']); print(f.is_dir() and k.is_temporary(f), f)"
    )
    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"} | {
        "TMPDIR": str(tmp_path)
    }
    run = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    kept, folder = run.stdout.split()
    assert kept == "True"
    assert not Path(folder).exists()  # gone with the process


def test_a_folder_that_can_be_written_is_left_to_numba(monkeypatch):
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    ensure_cache()
    assert "NUMBA_CACHE_DIR" not in os.environ
