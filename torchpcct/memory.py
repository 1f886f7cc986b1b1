"""Memory that the machine or the container has left."""

from __future__ import annotations

import os
from pathlib import Path


def free_bytes() -> int:
    """Memory that can still be allocated: of the container, or of the machine."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        free = next(
            1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable")
        )
    except (OSError, StopIteration):  # no Linux
        free = (
            os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
            if hasattr(os, "sysconf")
            else 2**62
        )
    try:
        most = Path("/sys/fs/cgroup/memory.max").read_text().strip()
        used = int(Path("/sys/fs/cgroup/memory.current").read_text())
        free = free if most == "max" else min(free, int(most) - used)
    except (OSError, ValueError):  # no container
        pass
    return free
