"""Kernels on several threads: a compiled loop over ``begin … end`` is dealt out in pieces, to the caller too.

numba's own loops (``prange``) take a quarter longer to compile, and run on OpenMP, whose threads do not outlive a fork
and fight with those of torch. These here are plain threads that wait asleep; a forked process starts its own.
"""

from __future__ import annotations

import os
import threading
from collections import deque
from itertools import pairwise
from queue import SimpleQueue
from typing import Any

__all__ = ["get_num_threads", "run", "set_num_threads"]

_PIECES = 4
"""Pieces per thread at most: whoever is done takes the next, so that unequal work is shared."""
_LEAST = 50_000
"""Operations of a piece at least: as long as it takes to wake a thread, some 50 µs."""
_number: int | None = None


def get_num_threads() -> int:
    """Threads of a call: those of :func:`set_num_threads`, else of the environment's ``NUMBA_NUM_THREADS``, else all
    that the processor has."""
    global _number
    if _number is None:
        from numba import config  # late: importing the package stays quick

        _number = int(config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
    return _number


def set_num_threads(number: int) -> None:
    """Let every call of this process run on so many threads from now on; ``ValueError`` below 1."""
    global _number
    if number < 1:
        raise ValueError(f"the number of threads must be at least 1, got {number}")
    _number = int(number)


class _Call:
    """The pieces of one call that nobody has taken yet, and reports from those who took some."""

    def __init__(self, kernel: Any, pieces: list[tuple[int, int]], args: tuple[Any, ...]) -> None:
        self.kernel, self.pieces, self.args = kernel, deque(pieces), args
        self.reports: SimpleQueue[tuple[int, BaseException | None]] = SimpleQueue()

    def work(self) -> tuple[int, BaseException | None]:
        """Take pieces until none is left: how many, and what went wrong; after that they are not computed."""
        taken, error = 0, None
        while True:
            try:
                begin, end = self.pieces.popleft()
            except IndexError:
                return taken, error
            taken += 1
            if error is None:
                try:
                    self.kernel(begin, end, *self.args)
                except BaseException as caught:
                    error = caught


class _Helper:
    """A thread that waits for calls. It is in ``idle`` while it waits, and is taken from there by who needs it."""

    def __init__(self, idle: deque[_Helper]) -> None:
        self.calls: SimpleQueue[_Call] = SimpleQueue()
        threading.Thread(target=self._serve, args=(idle,), name="torchpcct", daemon=True).start()

    def _serve(self, idle: deque[_Helper]) -> None:
        while True:
            call = self.calls.get()
            report, reports = call.work(), call.reports
            del call  # the arrays are the caller's alone when it goes on, and this thread is free for its next call
            idle.append(self)
            reports.put(report)
            del report, reports


class _Pool:
    def __init__(self) -> None:
        self.idle: deque[_Helper] = deque()
        self.started, self.lock = 0, threading.Lock()

    def helpers(self, number: int) -> list[_Helper]:
        """At most so many. Those that help elsewhere are not waited for: the caller does their part itself."""
        found: list[_Helper] = []
        while len(found) < number:
            try:
                found.append(self.idle.pop())
            except IndexError:
                with self.lock:
                    if self.started >= number:
                        break
                    try:
                        found.append(_Helper(self.idle))
                    except RuntimeError:  # the system, or an interpreter that is ending, has no more threads
                        break
                    self.started += 1
        return found


_pool = _Pool()


def _renew() -> None:
    """In a forked process: the threads stayed behind, and another may have held the lock."""
    global _pool
    _pool = _Pool()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew)


def run(kernel: Any, count: int, *args: Any, operations: int = _LEAST) -> None:
    """``kernel(begin, end, *args)`` on pieces of 0 … count, at once on several threads.

    Args:
        kernel: compiled with ``nogil=True``; whatever it writes at an index must be that index's alone, so that the
            result does not depend on the pieces.
        count: number of indices.
        operations: about how many sums and products an index takes; too little work for two stays on this thread.

    Raises:
        Exception: what a kernel raises, once no other thread computes any more.
    """
    threads = get_num_threads()
    number = min(count, _PIECES * threads, count * operations // _LEAST)
    if threads == 1 or number <= 1:
        if count:
            kernel(0, count, *args)
        return
    bounds = [count * i // number for i in range(number + 1)]
    call = _Call(kernel, list(pairwise(bounds)), args)
    try:
        for helper in _pool.helpers(min(threads, number) - 1):
            helper.calls.put(call)
        reports = [call.work()]
        while sum(taken for taken, _ in reports) < number:
            reports.append(call.reports.get())
    finally:
        call.pieces.clear()  # of an interrupted call
        call.args = ()  # a helper that wakes only now must not keep the arrays
    for _, error in reports:
        if error is not None:
            raise error
