"""Sharing of kernels among threads: every index once, whoever calls and whatever goes wrong
(forks: test_operator)."""

import gc
import threading
import time
import weakref

import numpy as np
import pytest
from fresh_python import run_python
from numba import njit

from torchpcct import threads


@pytest.fixture(params=[1, 2, 5], autouse=True)
def number(request):
    before = threads.get_num_threads()
    threads.set_num_threads(request.param)
    yield request.param
    threads.set_num_threads(before)


@njit(nogil=True)
def _count(begin, end, out):
    for i in range(begin, end):
        out[i] += 1


@pytest.mark.parametrize("count", [0, 1, 3, 7, 8, 1000])
def test_every_index_once(count):
    out = np.zeros(count + 1)
    for n in range(1, 200):
        threads.run(_count, count, out)
        assert (out == np.append(np.full(count, n), 0)).all()


def test_threads_take_part_and_pieces_are_as_large_as_asked(number):
    seen, together = [], threading.Barrier(number)

    def kernel(begin, end):
        seen.append((begin, end, threading.get_ident()))
        if len(seen) <= number:
            together.wait(300)  # passes only if as many threads compute at once

    threads.run(kernel, 1000, operations=300)
    assert len({ident for _, _, ident in seen}) == number
    assert sorted(i for begin, end, _ in seen for i in range(begin, end)) == list(range(1000))
    assert len(seen) == (1 if number == 1 else 6)


def test_little_work_stays_here():
    seen = []
    threads.run(
        lambda begin, end: seen.append((begin, end, threading.get_ident())), 99, operations=1000
    )
    assert seen == [(0, 99, threading.get_ident())]


def test_what_a_kernel_raises_comes_back_after_all_threads_have_ended(number):
    running, wrong = [], []

    def kernel(begin, end):
        running.append(begin)
        try:
            if begin >= 50:
                raise ZeroDivisionError(begin)
        finally:
            running.remove(begin)

    for _ in range(50):
        with pytest.raises(ZeroDivisionError):
            threads.run(kernel if number > 1 else lambda *_: kernel(50, 100), 100)
        wrong += running
    assert not wrong
    out = np.zeros(100)
    threads.run(_count, 100, out)  # and the threads serve on
    assert (out == 1).all()


def test_calls_within_calls_and_from_several_threads_at_once():
    out = np.zeros((6, 40, 50))

    def inner(begin, end, image):
        for n in range(begin, end):
            threads.run(_count, 50, image[n])

    def call(image):
        for _ in range(20):
            threads.run(inner, 40, image)

    callers = [threading.Thread(target=call, args=(image,), daemon=True) for image in out]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join(600)
        assert not caller.is_alive()
    assert (out == 20).all()


def test_helpers_are_no_more_than_asked_for_and_keep_nothing(number):
    class Kept:
        pass

    kept = Kept()
    gone = weakref.ref(kept)
    for _ in range(100):
        threads.run(lambda begin, end, _: None, 100, kept)
    del kept
    gc.collect()
    assert gone() is None
    ready = time.monotonic() + 300  # those of the tests before end late
    while (
        count := sum(t.name.startswith("torchpcct") for t in threading.enumerate())
    ) > number - 1:
        assert time.monotonic() < ready, count
        time.sleep(0.001)


def test_compiled_once_by_threads_that_meet():
    compiled = njit(nogil=True)(_count.py_func)
    for dtype in (np.float32, np.float64, np.int64):
        out = np.zeros(1000, dtype)
        threads.run(compiled, 1000, out)
        assert (out == 1).all()
    assert len(compiled.overloads) == 3


@pytest.mark.parametrize("number_asked", [0, -1])
def test_fewer_than_one_is_refused(number_asked):
    with pytest.raises(ValueError, match="at least 1"):
        threads.set_num_threads(number_asked)


def test_the_environment_sets_the_number():
    code = "from torchpcct.threads import get_num_threads; print(get_num_threads())"
    assert run_python(code, NUMBA_NUM_THREADS="3").stdout.strip() == "3"
