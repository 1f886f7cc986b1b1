"""What is found out about a scan is found once, as long as the scan lives and is the same."""

import gc
import weakref
from dataclasses import replace

import numpy as np
import pytest

from torchpcct import ParallelBeam, Scan, scan_memory
from torchpcct.scan_memory import once


@pytest.fixture
def scan():
    geometry = ParallelBeam(np.arange(4) * np.pi / 4, 6, 1.0)
    counts, air = np.full((4, 6), 100.0, np.float32), np.full(6, 200.0, np.float32)
    return Scan.from_counts(counts, geometry, air=air)


def test_each_thing_is_found_once(scan):
    calls = []

    def find(value):
        return lambda: calls.append(value) or value

    assert [once(scan, "a", find(1)), once(scan, "a", find(2))] == [1, 1]
    assert once(scan, "a", find(3), "another grid") == 3
    assert once(replace(scan), "a", find(4)) == 4  # a copy knows nothing
    assert calls == [1, 3, 4]
    for k in range(scan_memory.MOST):
        once(scan, "b", find(k), k)
    assert once(scan, "a", find(5)) == 5  # the oldest went
    others = [replace(scan) for _ in range(scan_memory.MOST_SCANS)]
    for other in others:
        once(other, "a", find(6))
    assert once(scan, "a", find(7)) == 7
    assert len(scan_memory._found) == scan_memory.MOST_SCANS


@pytest.mark.parametrize("change", ["torch", "numpy", "air", "rows"])
def test_changed_readings_are_looked_at_again(scan, change):
    assert once(scan, "a", lambda: 1) == 1
    if change == "torch":
        scan.counts[1, 2] = 3.0
    elif change == "numpy":
        scan.counts.numpy()[1, 2] = 3.0
    elif change == "air":
        scan.air.numpy()[0] = 3.0
    else:
        scan.counts.numpy()[0] = 50.0
        scan.counts.numpy()[1] = 150.0
    assert once(scan, "a", lambda: 2) == 2


def test_a_failure_is_not_kept_and_a_scan_is_released(scan):
    with pytest.raises(ZeroDivisionError):
        once(scan, "a", lambda: 1 / 0)
    assert once(scan, "a", lambda: 2) == 2
    passing = replace(scan)
    seen, number = weakref.ref(passing), id(passing)
    once(passing, "a", lambda: 3)
    del passing
    gc.collect()
    assert seen() is None
    assert number not in scan_memory._found
