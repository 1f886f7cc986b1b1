"""What the kernels' compiler and thread pool ask of a process: a word while it waits, and no use after a fork."""

from __future__ import annotations

import contextlib
import logging
import os
import sys
from functools import cache
from typing import Any

__all__ = ["announce_compilation", "refuse_after_fork"]

_LOG = logging.getLogger(__name__)
_OURS = ("torchpcct.", "recon.", "train.")
_forked_from_threads = False


def _note_fork() -> None:
    """In a forked child: were threads of GNU OpenMP running in the parent?"""
    global _forked_from_threads
    numba = sys.modules.get("numba")
    with contextlib.suppress(ValueError):  # no kernel has run yet: the child starts threads of its own
        _forked_from_threads = numba is not None and numba.threading_layer() == "omp"


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_note_fork)


def refuse_after_fork() -> None:
    """Raise an error where numba would end the process.

    Raises:
        RuntimeError: this process was forked from one that had run kernels on GNU OpenMP.
    """
    if _forked_from_threads:
        raise RuntimeError(
            "this process was forked after its parent had run projector kernels, and threads of GNU OpenMP do not "
            "outlive a fork: start workers with multiprocessing_context='spawn' (DataLoader), or set the environment "
            "variable NUMBA_THREADING_LAYER=workqueue before Python starts, or project in the main process"
        )


@cache
def announce_compilation() -> None:
    """From now on, log a warning when the first kernel of the package is compiled rather than read from the cache."""
    from numba.core import event

    class Announce(event.Listener):
        said = False

        def on_start(self, event: Any) -> None:
            function = getattr(event.data.get("dispatcher"), "py_func", None)
            if not self.said and getattr(function, "__module__", "").startswith(_OURS):
                Announce.said = True
                _LOG.warning(
                    "compiling kernels for this processor: this call takes up to a minute longer, later ones read them "
                    "from numba's cache"
                )

        def on_end(self, event: Any) -> None:
            pass

    event.register("numba:compile", Announce())
