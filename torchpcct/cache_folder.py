"""Where numba keeps compiled kernels, if it would find no place by itself."""

from __future__ import annotations

import atexit
import logging
import os
import shutil
import sys
import tempfile
from pathlib import Path

__all__ = ["ensure_cache", "is_temporary"]

_TEMPORARY = "torchpcct-kernels-"


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
