"""Kernels on several threads: a compiled loop over ``begin … end`` is dealt out in pieces, to the
caller too.

numba's own loops (``prange``) take a quarter longer to compile, and run on OpenMP, whose threads do
not outlive a fork and fight with those of torch. These here are plain threads that wait asleep; a
forked process starts its own.
"""

from __future__ import annotations

import os
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import pairwise
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable


__all__ = ["get_num_threads", "set_num_threads"]

_PIECES = 4
"""Pieces per thread at most: whoever is done takes the next, so that unequal work is shared."""
_LEAST = 50_000
"""Operations of a piece at least: as long as it takes to wake a thread, some 50 µs."""
_number: int | None = None
_helpers: ThreadPoolExecutor | None = None


def get_num_threads() -> int:
    """Threads of a call: those of :func:`set_num_threads`, else of the environment's
    ``NUMBA_NUM_THREADS``, else all that the processor has."""
    global _number
    if _number is None:
        from numba import config  # late: importing the package stays quick

        _number = int(config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
    return _number


def set_num_threads(number: int) -> None:
    """Set the number of threads of all later calls in this process.

    Args:
        number: at least 1.

    Raises:
        ValueError: a number below 1.
    """
    global _number
    if number < 1:
        raise ValueError(f"the number of threads must be at least 1, got {number}")
    _number = int(number)
    _renew()


def _renew() -> None:
    """Helpers are started anew: of another number, or in a forked process, where the threads
    stayed behind."""
    global _helpers
    _helpers = None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew)


def _helped(work: Callable[[], None], number: int) -> list[Future[None]]:
    """``work`` on so many other threads, as soon as one is free."""
    global _helpers
    if _helpers is None:
        _helpers = ThreadPoolExecutor(max(get_num_threads() - 1, 1), "torchpcct")
    try:
        return [_helpers.submit(work) for _ in range(number)]
    # the system, or an interpreter that is ending, has no more threads: the caller does it all
    except RuntimeError:
        return []


def run(kernel: Callable[..., None], count: int, *args: object, operations: int = _LEAST) -> None:
    """``kernel(begin, end, *args)`` on pieces of 0 … count, at once on several threads.

    Args:
        kernel: compiled with ``nogil=True``; whatever it writes at an index must be that index's
            alone, so that the result does not depend on the pieces.
        count: number of indices.
        operations: about how many sums and products an index takes; too little work for two stays
            on this thread.

    Raises:
        Exception: what a kernel raises, once no other thread computes any more.
    """
    threads = get_num_threads()
    number = min(count, _PIECES * threads, count * operations // _LEAST)
    if threads == 1 or number <= 1:
        if count:
            kernel(0, count, *args)
        return
    pieces = deque(pairwise(count * i // number for i in range(number + 1)))
    given = [args]

    def work() -> None:
        while pieces:
            try:
                begin, end = pieces.popleft()
            except IndexError:  # another was faster
                return
            kernel(begin, end, *given[0])

    helping = _helped(work, min(threads, number) - 1)
    try:
        work()
    finally:
        pieces.clear()  # of a call that went wrong
        # Those that help elsewhere are not waited for: nothing is left for them.
        errors = [future.exception() for future in helping if not future.cancel()]
        given.clear()  # who wakes only now must not keep the arrays
    for error in errors:
        if error is not None:
            raise error
