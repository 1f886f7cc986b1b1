"""Every writer, killed (SIGKILL) at random moments and on full disks: ``python tests/bench/kills.py [KILLS]``.

Kills: a process writes one of two contents over and over under one name (a series: under new names); at a random moment
it is killed. What stands under the name must be one of the two, whole; nothing, if it was the first write. The next
write must sweep what the dead one left.

Full disks: a file system in memory of a random size (``mount -t tmpfs``, as root), or a limit on the size of files. The
writer must raise ``WriteError`` and leave nothing, or write all, and the process must end by itself (HDF5 used to crash
at the end of the program).
"""

from __future__ import annotations

import collections
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from results import write_results

from recon.evaluate.store import Store
from recon.mbir.weights_io import read_tensors, write_tensors
from torchpcct import ConeBeam, Scan, Volume, VolumeGrid, full_turn
from torchpcct.files import LEFTOVER, WriteError, atomic_write

LONGEST = 4.0
"""Until a kill, in times that a write takes."""
CONE = ConeBeam(full_turn(40), 300.0, 500.0, 64, 16, 1.0)
GRID = VolumeGrid((12, 48, 48), 1.0)
RNG = np.random.default_rng(0)
NUMBERS = [torch.from_numpy(RNG.integers(-900, 2000, GRID.shape).astype(np.float32)) for _ in range(2)]
SCANS = [Scan.from_counts(RNG.poisson(5e4, CONE.shape), CONE, air=5e4) for _ in range(2)]


def _text(path: Path, k: int) -> None:
    with atomic_write(path) as part:
        part.write_text(json.dumps(NUMBERS[k].tolist()), encoding="utf-8")


def _volume(path: Path, k: int) -> None:
    Volume(NUMBERS[k], GRID).save(path)


Writer = tuple[Callable[[Path, int], Any], Callable[[Path], Any], list[Any]]
VOLUME: Writer = (_volume, lambda path: Volume.load(path).data, NUMBERS)
WRITERS: dict[str, Writer] = {
    "scan.h5": (lambda path, k: SCANS[k].save(path), lambda path: Scan.load(path).counts, [s.counts for s in SCANS]),
    **dict.fromkeys(("volume.h5", "volume.nii", "volume.nii.gz", "volume.mha", "series"), VOLUME),
    "weights.safetensors": (
        lambda path, k: write_tensors(path, "test", {"a": NUMBERS[k]}, {}),
        lambda path: read_tensors(path, "test")[0]["a"], NUMBERS,
    ),
    "piece.npz": (
        lambda path, k: Store(path.parent).piece(path.stem, str(k), lambda: {"a": NUMBERS[k].numpy()}),
        lambda path: torch.from_numpy(np.load(path)["a"]), NUMBERS,
    ),
    "report.json": (_text, lambda path: torch.tensor(json.loads(path.read_text(encoding="utf-8"))), NUMBERS),
}  # fmt: skip


def kill(name: str, folder: Path, number: int, seconds: float) -> str:
    """Kill one writer, which takes ``seconds`` for a write.

    Returns:
        ``whole``, ``none`` (killed before the first write was through), or what is wrong.
    """
    write, read, contents = WRITERS[name]
    child = os.fork()
    if child == 0:
        k = 0
        while True:
            write(folder / (f"{name}{number}_{k}" if name == "series" else name), k % 2)
            k += 1
    time.sleep(float(RNG.uniform(0.0, LONGEST * seconds)))
    os.kill(child, signal.SIGKILL)
    if os.waitpid(child, 0)[1] != signal.SIGKILL:
        return "writer died by itself"
    found = sorted(p for p in folder.iterdir() if not LEFTOVER.match(p.name))
    for path in found if name == "series" else found[:1]:
        try:
            values = read(path)
        except Exception as error:
            return f"lost: {type(error).__name__}: {error}"
        if not any(torch.equal(values, one) for one in contents):
            return "lost: another content"
    return "whole" if found else "none"


def swept(name: str, folder: Path) -> bool:
    """Whether a write of the same name takes away what killed writers left."""
    old = [p for p in folder.iterdir() if LEFTOVER.match(p.name)]
    for part in old:
        os.utime(part, (time.time() - 3600,) * 2)
        target = part.name.split(".part.")[1] if name == "series" else name
        if not (folder / target).is_dir():
            WRITERS[name][0](folder / target, 1)
            WRITERS[name][0](folder / target, 0) if name == "piece.npz" else None
    return not [p for p in folder.iterdir() if LEFTOVER.match(p.name)]


def full(name: str, folder: Path, size: int, mounted: bool) -> str:
    """Write to a disk of ``size`` bytes: ``refused`` or ``written``, or what is wrong."""
    if mounted:
        limit = f"size={size // 4096 * 4096 + 4096}"
        subprocess.run(["mount", "-t", "tmpfs", "-o", limit, "tmpfs", folder], check=True)
    try:
        child = os.fork()
        if child == 0:
            if not mounted:
                resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
            try:
                WRITERS[name][0](folder / name, 0)
            except WriteError:
                sys.exit(3)
            sys.exit(0)  # by the ordinary way, where HDF5 flushes
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        left = sorted(p.name for p in folder.iterdir())
        if status == 3:
            return "refused" if not left else f"refused, leaves {left}"
        if status != 0:
            return f"status {status}, leaves {left}"
        _, read, contents = WRITERS[name]
        return "written" if torch.equal(read(folder / name), contents[0]) else "written wrong"
    finally:
        if os.getpid() == PARENT:
            if mounted:
                subprocess.run(["umount", folder], check=True)
            elif (folder / name).is_file():
                (folder / name).unlink()


PARENT = os.getpid()


def main(kills: int = 225) -> None:
    """Run both and write kills.json and kills.md."""
    found: dict[str, dict[str, dict[str, int]]] = {"kills": {}, "full_disks": {}}
    top = Path(tempfile.mkdtemp(prefix="kills"))
    probe = top / "probe"
    probe.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=8k", "tmpfs", probe]
    mounted = subprocess.run(command, capture_output=True, check=False).returncode == 0
    if mounted:
        subprocess.run(["umount", probe], check=True)
    for name in WRITERS:
        folder = top / name.replace(".", "_")
        folder.mkdir()
        sample = top / "sample"
        for k in range(2):  # the first one loads what the children need
            shutil.rmtree(sample, ignore_errors=True)
            sample.mkdir()
            start = time.perf_counter()
            WRITERS[name][0](sample / name, k)
            seconds = time.perf_counter() - start
        seen = collections.Counter(kill(name, folder, k, seconds) for k in range(kills // len(WRITERS)))
        seen["parts left"] = len([p for p in folder.iterdir() if LEFTOVER.match(p.name)])
        seen["parts not swept"] = 0 if swept(name, folder) else 1
        found["kills"][name] = dict(seen)
        disk = top / f"disk_{folder.name}"
        disk.mkdir()
        size = sum(p.stat().st_size for p in sample.rglob("*") if p.is_file())
        sizes = [int(f * size) for f in (0.0, 0.2, 0.5, 0.8, 2.0)]
        found["full_disks"][name] = dict(collections.Counter(full(name, disk, s, mounted) for s in sizes))
        print(name, found["kills"][name], found["full_disks"][name], flush=True)
    result = {"disks": "tmpfs" if mounted else "RLIMIT_FSIZE", **found}
    lost = sum(n for seen in found["kills"].values() for what, n in seen.items() if what.startswith(("lost", "writer")))
    total = sum(n for seen in found["kills"].values() for what, n in seen.items() if not what.startswith("parts"))
    text = f"{total} kills: {lost} files lost. Full disks: {found['full_disks']}.\n"
    write_results(Path(__file__).parent, "kills", result, text)
    print(text)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
