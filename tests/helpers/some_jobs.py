"""Jobs for tests of recon.jobs.execute, which other processes import."""

import errno
import importlib
import logging
import os
import signal
import sys
import time

from numba import njit

from recon.jobs import execute
from torchpcct.files import atomic_write


def noted(folder, name, value):
    """Write a file, give a value and where it was computed."""
    logging.getLogger("recon").warning("noted %s", value)
    (folder / f"{name}.txt").write_text(str(value))
    return value, os.getpid()


def dies(folder, name, times):
    """Kill its own process the first ``times`` times."""
    seen = folder / f"{name}.deaths"
    with seen.open("a") as file:
        file.write("x")
    if len(seen.read_text()) <= times:
        os.kill(os.getpid(), signal.SIGKILL)
    return noted(folder, name, times)


def full(folder, name, host):
    """A full disk of one machine; long enough that each gets one."""
    time.sleep(0.3)
    if f"//{host}:" in execute._where()[0]:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder))
    return noted(folder, name, 0)


def set_version(version):
    """Of a worker."""
    execute.VERSION = version


def kills(folder, process):
    """Another process, and with it what this job was given by."""
    os.kill(process, signal.SIGKILL)
    time.sleep(60)


def waits(folder, seconds):
    """Take so long, and no processor."""
    time.sleep(seconds)


def holds(folder, seconds):
    """A file that it has begun to write; it says so by another, and which process it is."""
    with atomic_write(folder / "result.txt") as part:
        part.write_text("half")
        (folder / "begun").write_text(str(os.getpid()))
        time.sleep(seconds)


def found_in(folder, module):
    """Where a module is found, and what of the current folder was loaded before."""
    return importlib.import_module(module).__file__, sys.modules["selectors"].__file__


@njit(cache=True)
def _kernel(x):
    return x.sum()  # compiled in less time than a worker waits for another, on a busy machine, too


def compiles(folder, name, together):
    """Compile a kernel, when as many others are about to."""
    import numpy as np

    (folder / f"{name}.here").touch()
    while len(list(folder.glob("*.here"))) < together:
        time.sleep(0.01)
    return float(_kernel(np.ones(4)))


def refuses(folder):
    """An own error of a job."""
    raise ValueError("bad input")


def threads(folder):
    """What each library was given."""
    import torch
    from threadpoolctl import threadpool_info

    from torchpcct.threads import get_num_threads

    return (
        torch.get_num_threads(),
        get_num_threads(),
        max(pool["num_threads"] for pool in threadpool_info()),
    )
