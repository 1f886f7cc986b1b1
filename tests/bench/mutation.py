"""Planted faults: does a test fail for each? ``python tests/bench/mutation.py [NAME …]``

Every entry of ``faults.yaml`` is a fault that a person could make, in one place of the source, and
the test that must notice. The repository's packages are copied, the fault is planted in the copy,
and the test runs on it, in a process that is forked after the slow imports. A fault that its test
does not notice is printed, and the exit status is 1. First every test must pass on the sound copy.
What was found is kept in the table, fault by fault.
"""

import os
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import yaml

ROOT = Path(__file__).resolve().parent.parent.parent
TABLE = Path(__file__).with_name("faults.yaml")
LIMIT_S = 300
HOW = {1: "fails", 2: "cannot be collected", 124: f"hangs ({LIMIT_S} s)"}
"""Exit status of pytest → how a fault is noticed: a test failed; an import broke; nothing came
back."""


class Fault(NamedTuple):
    """``old`` in ``file`` becomes ``new``; ``test`` must fail; ``then``: what was found last."""

    name: str
    file: str
    test: str
    old: str
    new: str
    then: str = ""


TIER = "not slow and not peers"
"""Also the tests that are too long for the default tier."""


def read_faults() -> list[Fault]:
    """The table."""
    return [Fault(**row) for row in yaml.safe_load(TABLE.read_text(encoding="utf-8"))]


FAULTS = read_faults()


def _run(copy: Path, tests: list[str]) -> int:
    """Exit status of pytest on the copy, 124 if it takes too long."""
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        os.chdir(copy)
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, 1)
        os.dup2(null, 2)
        os.environ["PYTHONPATH"] = str(copy)
        sys.path.insert(0, str(copy))
        import pytest

        os._exit(
            int(pytest.main(["-n", "0", "-x", "-q", "-p", "no:cacheprovider", "-m", TIER, *tests]))
        )
    end = time.monotonic() + LIMIT_S * len(tests)
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.05)
    os.kill(child, 9)
    os.waitpid(child, 0)
    return 124


def _keep(fault: Fault, found: str) -> None:
    """Put the finding of a fault into the table."""
    rows = [f._asdict() | ({"then": found} if f.name == fault.name else {}) for f in read_faults()]
    TABLE.write_text(
        yaml.safe_dump(rows, sort_keys=False, allow_unicode=True, width=10_000), encoding="utf-8"
    )


def main(names: list[str]) -> int:
    """Plant the faults (all, or those whose names are given); 0 if all are noticed."""
    if unknown := set(names) - {f.name for f in FAULTS}:
        print(f"no such fault: {', '.join(sorted(unknown))}")
        return 2
    chosen = [f for f in FAULTS if not names or f.name in names]
    # Slow imports, none of them ours, once for all forks; no thread is started yet.
    import h5py  # noqa: F401
    import numba  # noqa: F401
    import scipy.stats  # noqa: F401
    import torch  # noqa: F401

    missed = []
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "copy"
        for part in ("torchpcct", "recon", "train", "tests"):
            shutil.copytree(ROOT / part, copy / part)  # with the kernels that numba has compiled
        for file in ("pyproject.toml", "README.md"):
            shutil.copy2(ROOT / file, copy / file)
        if (status := _run(copy, sorted({f.test for f in chosen}))) != 0:
            print(f"the tests do not pass on the sound source (status {status})")
            return 1
        for fault in chosen:
            path = copy / fault.file
            good = path.read_text(encoding="utf-8")
            if good.count(fault.old) != 1:
                print(
                    f"{fault.name}: {fault.file} holds {fault.old!r} {good.count(fault.old)} "
                    "times, not once"
                )
                missed.append(fault)
                continue
            before = path.stat()
            path.write_text(good.replace(fault.old, fault.new), encoding="utf-8")
            status = _run(copy, [fault.test])
            path.write_text(good, encoding="utf-8")
            os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
            for stale in (copy / fault.file).parent.glob(f"__pycache__/{path.stem}.cpython-*.pyc"):
                stale.unlink()
            print(
                f"{'caught' if status in HOW else 'MISSED'}  {fault.name:<36} {fault.test}",
                flush=True,
            )
            _keep(fault, HOW.get(status, "MISSED"))
            if status not in HOW:
                missed.append(fault)
    print(f"{len(chosen) - len(missed)} of {len(chosen)} planted faults caught")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
