"""What numba keeps of compiled kernels: a message before it compiles, and kernels older than a function they hold.

A kernel holds the compiled code of all functions it calls, but numba's cache looks at the kernel's own file only. Where
one of them, in another file, is edited or updated in place (``git pull`` of an editable installation), the cache would
go on giving the old code, silently.
"""

from __future__ import annotations

import logging
import sys
import time
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

__all__ = ["OURS", "announce_compilation", "folders", "forget_outdated", "sources"]

OURS = ("torchpcct.", "recon.", "train.")
"""What the names of our modules begin with."""


def sources(name: str, *constants: str) -> set[Path]:
    """Files of the compiled functions that a module's kernels may call, its own left out.

    Args:
        name: of an imported module.
        constants: names of modules whose constants its kernels hold, of which numba keeps no record.
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
        if other.startswith(OURS) and type(value).__module__.startswith("numba.") and other in sys.modules:
            _follow(sys.modules[other], found)


def forget_outdated(name: str, *constants: str) -> int:
    """Forget a module's compiled kernels where they are older than a function they call; to be called at its end.

    Args:
        name, constants: as for :func:`sources`.

    Returns:
        How many were forgotten. Files that cannot be removed stay.
    """
    module = sys.modules[name]
    # A file from the future (a wrong clock) would have the kernels compiled by every process.
    newest = max((t for t in map(_changed, sources(name, *constants)) if t <= time.time()), default=0.0)
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
    kernels = [v for v in vars(sys.modules[name]).values() if getattr(v, "__module__", None) == name]
    found = {getattr(getattr(kernel, "stats", None), "cache_path", None) for kernel in kernels}
    return {path for path in found if path is not None}


def _changed(path: Path) -> float:
    return path.stat().st_mtime


@cache
def announce_compilation() -> None:
    """From now on, log a warning when the first kernel of the package is compiled rather than read from the cache."""
    from numba.core import event

    class Announce(event.Listener):
        announced = False

        def on_start(self, event: Any) -> None:
            function = getattr(event.data.get("dispatcher"), "py_func", None)
            if not self.announced and getattr(function, "__module__", "").startswith(OURS):
                Announce.announced = True
                logging.getLogger(__name__).warning(
                    "compiling kernels for this processor: this call takes up to a minute longer, later ones read them "
                    "from numba's cache"
                )

        def on_end(self, event: Any) -> None:
            pass

    event.register("numba:compile", Announce())
