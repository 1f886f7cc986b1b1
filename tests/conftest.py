"""Tests run in two processes (``-n 2`` of pyproject.toml; ``-n 0`` runs them in one), which
share the cores."""

import gc
import os

import pytest

# Triton reads it when it is first imported, by whichever test: its kernels then run on the CPU, see
# test_triton.py.
os.environ.setdefault("TRITON_INTERPRET", "1")


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """What is loaded until tests begin stays until they end: looked through for garbage again and
    again, it takes a tenth of the time of all tests."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.collect()
        gc.freeze()
        gc.enable()


@pytest.fixture(scope="session", autouse=True)
def _a_cache_of_its_own(tmp_path_factory):
    """Commands keep readings and locks in the user's cache: here in a folder of the tests.

    Matplotlib's list of fonts stays where the user has it: made anew, it takes each process that
    draws more than a second.
    """
    import matplotlib

    folder = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MPLCONFIGDIR", matplotlib.get_cachedir())
        patch.setenv("XDG_CACHE_HOME", str(folder))
        yield folder


@pytest.fixture(scope="session", autouse=True)
def _cores_are_shared():
    """Each process computes with its share of the cores: threads that wait for each other are
    slower than few."""
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    if workers > 1:
        import torch

        from torchpcct.threads import get_num_threads, set_num_threads

        threads = max(1, (os.cpu_count() or 1) // workers)
        set_num_threads(min(threads, get_num_threads()))
        torch.set_num_threads(threads)
