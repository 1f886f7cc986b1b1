"""Where numba keeps compiled kernels, if it would find no place by itself, and where we keep what
may be computed again."""

from __future__ import annotations

import atexit
import logging
import os
import shutil
import sys
import tempfile
from contextlib import suppress
from pathlib import Path

_TEMPORARY = "torchpcct-kernels-"
"""How the name of a folder of kernels begins that goes when the process ends."""


def ensure_cache() -> None:
    """Give numba a folder that it can write, where it would find none and refuse to load the
    kernels.

    That is so in an installation that may only be read, by a user without a home (containers,
    cron): the kernels are kept in a temporary folder then, as long as the process lives, unless
    ``NUMBA_CACHE_DIR`` names a lasting one.
    """
    package = Path(__file__).parent
    if os.environ.get("NUMBA_CACHE_DIR") or os.access(package, os.W_OK) or _writable(_user_cache()):
        return
    try:
        folder = tempfile.mkdtemp(prefix=_TEMPORARY)
    except OSError:  # nowhere at all: numba says what it lacks
        return
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    os.environ["NUMBA_CACHE_DIR"] = folder  # other processes that this one starts use it, too
    if "numba" in sys.modules:
        sys.modules["numba"].config.CACHE_DIR = folder
    logging.getLogger(__name__).info(
        "kernels are kept in %s while this process lives: set NUMBA_CACHE_DIR to a folder that "
        "lasts",
        folder,
    )


def is_temporary(folder: Path) -> bool:
    """Whether a folder of kernels is one of :func:`ensure_cache`."""
    return any(part.startswith(_TEMPORARY) for part in folder.parts)


def _user_cache() -> Path:
    """Where numba keeps what it may not write beside a module: that of XDG, or of the system."""
    base = (
        os.environ.get("XDG_CACHE_HOME")
        or os.environ.get("LOCALAPPDATA")
        or os.path.expanduser("~/.cache")
    )
    return Path(base)


def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def private_folder(name: str) -> Path | None:
    """A folder in the user's own cache, made if need be, where nobody else can put a file or a
    link; None: there is none."""
    local = os.environ.get("LOCALAPPDATA" if sys.platform == "win32" else "XDG_CACHE_HOME", "")
    with suppress(OSError, RuntimeError):  # not writable; no home
        base = Path(local) if os.path.isabs(local) else Path.home() / ".cache"
        folder = base / "torchpcct" / name
        for part in (folder.parent, folder):
            part.mkdir(mode=0o700, parents=True, exist_ok=True)
            found = part.lstat()
            # On Windows the profile's own rights keep others out, and these numbers say nothing.
            mine = not hasattr(os, "getuid") or (
                found.st_uid == os.getuid() and not found.st_mode & 0o022
            )
            if part.is_symlink() or not mine:
                return None
        return folder
    return None
