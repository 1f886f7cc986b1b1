"""What numba keeps of compiled kernels: a message before it compiles, and kernels older than a
function they hold.

A kernel holds the compiled code of all functions it calls, but numba's cache looks at the kernel's
own file only. Where one of them, in another file, is edited or updated in place (``git pull`` of an
editable installation), the cache would go on giving the old code, silently.
"""

from __future__ import annotations

import hashlib
import logging
import platform
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from torchpcct.cache_folder import private_folder

if TYPE_CHECKING:
    from numba.core.caching import Cache
    from numba.core.event import Event


OURS = ("torchpcct.", "recon.", "train.")
"""What the names of our modules begin with."""


def sources(name: str, *constants: str) -> set[Path]:
    """Files of the compiled functions that a module's kernels may call, its own left out.

    Args:
        name: of an imported module.
        constants: names of modules whose constants its kernels hold, of which numba keeps no
            record.
    """
    found: set[str] = set()
    _follow(sys.modules[name], found)
    files = {sys.modules[n].__file__ for n in (found | set(constants)) - {name}}
    return {Path(f) for f in files if f is not None}


def _follow(module: ModuleType, found: set[str]) -> None:
    if module.__name__ in found:
        return
    found.add(module.__name__)
    for value in list(vars(module).values()):
        inner = getattr(value, "__wrapped__", None)  # numba's functions wrap Python's
        other = getattr(inner, "__module__", "") or ""
        if (
            other.startswith(OURS)
            and type(value).__module__.startswith("numba.")
            and other in sys.modules
        ):
            _follow(sys.modules[other], found)


def forget_outdated(name: str, *constants: str) -> int:
    """Forget a module's compiled kernels where they are older than a function they call; to be
    called at its end.

    Args:
        name, constants: as for :func:`sources`.

    Returns:
        How many were forgotten. Files that cannot be removed stay.
    """
    module = sys.modules[name]
    # A file from the future (a wrong clock) would have the kernels compiled by every process.
    newest = max(
        (t for t in map(_changed, sources(name, *constants)) if t <= time.time()), default=0.0
    )
    forgotten = 0
    for folder in folders(name):
        for index in Path(folder).glob(f"{Path(str(module.__file__)).stem}.*.nbi"):
            try:
                if _changed(index) < newest:
                    index.unlink()
                    forgotten += 1
            except OSError:  # another process was faster, or may not write here
                continue
    return forgotten


def folders(name: str) -> set[str]:
    """Where the compiled code of an imported module's kernels lies."""
    kernels = [
        v for v in vars(sys.modules[name]).values() if getattr(v, "__module__", None) == name
    ]
    found = {getattr(getattr(kernel, "stats", None), "cache_path", None) for kernel in kernels}
    return {path for path in found if path is not None}


def _changed(path: Path) -> float:
    return path.stat().st_mtime


@cache
def announce_compilation() -> None:
    """From now on, log a warning when the first kernel of the package is compiled rather than
    read from the cache."""
    from numba.core import event

    class Announce(event.Listener):
        announced = False

        def on_start(self, event: Event) -> None:
            function = getattr(event.data.get("dispatcher"), "py_func", None)
            if not self.announced and getattr(function, "__module__", "").startswith(OURS):
                Announce.announced = True
                logging.getLogger(__name__).warning(
                    "compiling kernels for this processor: this call takes up to a minute longer, "
                    "later ones read them from numba's cache"
                )

        def on_end(self, event: Event) -> None:
            pass

    event.register("numba:compile", Announce())


# --- processes that need the same kernel ----------------------------------------------------------


@contextmanager
def compiled_once(patience_s: float = 60.0) -> Iterator[None]:
    """Of the processes of a machine that are in such a block one compiles a kernel; the others read
    it from the cache.

    Each kernel has a lock of its own, so that nobody waits for a kernel that he does not need. All
    waits of a block together last ``patience_s`` at most; then, and where no lock can be had (no
    folder of one's own, a disk without locks), a process compiles for itself: that takes time, and
    the result is the same.
    """
    from filelock import BaseFileLock, FileLock, Timeout
    from numba.core import caching, event

    held: dict[str, BaseFileLock] = {}
    load, save, left = caching.Cache.load_overload, caching.Cache.save_overload, patience_s

    def name_of(kernel: Cache) -> str:
        where = f"{platform.node()} {kernel.cache_path} {kernel._impl.filename_base}"
        return hashlib.sha256(where.encode()).hexdigest()[:32]

    def loaded(kernel: Cache, *given: object) -> object:
        nonlocal left
        found, name = load(kernel, *given), name_of(kernel)
        folder = None if found is not None or name in held else private_folder("locks")
        if folder is None:
            return found
        lock, start = FileLock(folder / f"{name}.lock"), time.monotonic()
        try:
            lock.acquire(timeout=max(left, 0.0))
        except (Timeout, OSError, NotImplementedError):
            return None
        finally:
            left -= time.monotonic() - start
        found = load(kernel, *given)  # who had the lock may have compiled it
        if found is None:
            held[name] = lock
        else:
            lock.release()
        return found

    def saved(kernel: Cache, *given: object) -> None:
        try:
            save(kernel, *given)
        finally:
            if name_of(kernel) in held:
                held.pop(name_of(kernel)).release()

    def release_all() -> None:
        while held:
            held.popitem()[1].release()

    class Ended(event.Listener):  # also a compilation that fails, and saves nothing
        depth = 0

        def on_start(self, event: Event) -> None:
            self.depth += 1

        def on_end(self, event: Event) -> None:
            self.depth -= 1
            if self.depth == 0:
                release_all()

    caches: Any = caching.Cache
    caches.load_overload, caches.save_overload = loaded, saved
    try:
        with event.install_listener("numba:compiler_lock", Ended()):
            yield
    finally:
        caches.load_overload, caches.save_overload = load, save
        release_all()
