"""Jobs for tests of recon.evaluate.execute, which other processes import."""

import errno
import logging
import os
import signal
import time


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


def full(folder, name, pid):
    """A full disk for one process."""
    if os.getpid() == pid:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder))
    return noted(folder, name, 0)


def waits(folder, seconds):
    """Compute for so long."""
    end = time.perf_counter() + seconds
    while time.perf_counter() < end:
        pass


def refuses(folder):
    """An own error of a job."""
    raise ValueError("bad input")


def threads(folder):
    """What each library was given."""
    import torch
    from threadpoolctl import threadpool_info

    from torchpcct.threads import get_num_threads

    return torch.get_num_threads(), get_num_threads(), max(pool["num_threads"] for pool in threadpool_info())
