"""A Dask cluster's workers, scheduler and client, killed at random: ``python tests/bench/cluster_kills.py [N]``.

``torchpcct evaluate`` of a small task runs on two workers. N times each, at a random moment of it, a worker, the
scheduler or the client (the command itself) is killed; whoever is dead is started again, and the same command goes on
until it ends. No piece that stood on the disk may be lost or computed again to other figures, and the report must be
that of a serial run, but for times.
"""

from __future__ import annotations

import collections
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from results import write_results

from recon.study.results import differences

RNG = np.random.default_rng(0)
TASK = """
scene:
  kind: bodies
  bodies:
    - {name: patient, shape: cylinder, semi_axes: 100, material: water}
    - {name: insert, shape: ellipsoid, semi_axes: 1.5, position: {x: 30, y: 10, z: 0}, material: soft_tissue,
       parent: patient}
signal: insert
scanner: {preset: pcct, views: 90}
inset: {size: [6, 8, 8], voxel_mm: 0.4}
exposures_s: [10, 20]
"""
METHODS = ["fbp:soft", "gaussian@fbp:soft", "tv@fbp:soft"]
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}


def _start(*command: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        command, env=ENVIRONMENT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True
    )


def _kill(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


class Parts:
    """Scheduler and two workers without nanny, each a process that can be killed."""

    def __init__(self) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.address = f"tcp://127.0.0.1:{self.port}"
        self.running: dict[str, subprocess.Popen[bytes]] = {}
        self.renew()

    def renew(self) -> None:
        """Start what is not alive."""
        scheduler = ["scheduler", "--host", "127.0.0.1", "--port", str(self.port), "--no-dashboard"]
        worker = ["worker", self.address, "--nthreads", "1", "--no-nanny", "--no-dashboard", "--death-timeout", "120"]
        for name, command in (("scheduler", scheduler), ("worker 0", worker), ("worker 1", worker)):
            found = self.running.get(name)
            if found is None or found.poll() is not None:
                self.running[name] = _start(sys.executable, "-m", "dask", *command)

    def end(self) -> None:
        """Kill all."""
        for process in self.running.values():
            _kill(process)


def _evaluate(out: Path, *more: str) -> subprocess.Popen[bytes]:
    methods = [part for m in METHODS for part in ("--method", m)]
    return _start(
        sys.executable, "-m", "recon.cli", "evaluate", "--task", str(out.parent / "insert.yaml"), *methods, "--n", "24",
        "--no-progress", "--out", str(out), *more,
    )  # fmt: skip


def _report(out: Path) -> Any:
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    report.pop("command", None)
    report["records"] = [r for r in report["records"] if r["figure"] != "seconds"]
    return report


def main(kills: int = 20, budget_s: float = 1e9) -> None:
    """Kill, and write cluster_kills.json and .md beside this file."""
    top = Path(tempfile.mkdtemp(prefix="cluster-kills"))
    (top / "insert.yaml").write_text(TASK, encoding="utf-8")
    serial = _evaluate(top / "serial")
    assert serial.wait() == 0, serial.stderr and serial.stderr.read().decode()
    whole, parts = _report(top / "serial"), Parts()
    seen: dict[str, collections.Counter[str]] = collections.defaultdict(collections.Counter)
    began, run, span = time.monotonic(), 0, 60.0
    try:
        while min((seen[k]["killed"] for k in ("worker", "scheduler", "client")), default=0) < kills:
            if time.monotonic() - began > budget_s:
                break
            out = top / f"run{run}"
            run += 1
            while True:
                parts.renew()
                there = {p: p.read_bytes() for p in out.rglob("*.npz") if ".part." not in p.name}
                start, client = time.monotonic(), _evaluate(out, "--scheduler", parts.address)
                who = min(("worker", "scheduler", "client"), key=lambda k: (seen[k]["killed"], RNG.uniform()))
                at = float(RNG.uniform(0.1 * span, 0.8 * span))
                try:
                    client.wait(at)
                except subprocess.TimeoutExpired:
                    seen[who]["killed"] += 1
                    _kill({"client": client, "scheduler": parts.running["scheduler"],
                           "worker": parts.running[f"worker {RNG.integers(2)}"]}[who])  # fmt: skip
                    if who == "worker":
                        parts.renew()
                    if who == "scheduler":
                        for k in range(2):
                            _kill(parts.running[f"worker {k}"])
                code = client.wait()
                span = max(20.0, time.monotonic() - start) if code == 0 else span
                lost = [p for p, data in there.items() if not p.exists() or p.read_bytes() != data]
                seen[who]["pieces lost"] += len(lost)
                if code == 0:
                    break
                text = (client.stderr and client.stderr.read().decode()) or ""
                if code not in (2, -signal.SIGKILL) or "Traceback" in text:
                    seen[who]["unexpected ends"] += 1
                    print(code, text[-1500:], flush=True)
            seen["all"]["reports"] += 1
            seen["all"]["reports that differ"] += bool(list(differences(whole, _report(out))))
            print(run, dict(seen), flush=True)
    finally:
        parts.end()
    found: dict[str, Any] = {k: dict(v) for k, v in seen.items()}
    found |= {"command": " ".join(sys.argv), "date": time.strftime("%Y-%m-%d")}
    write_results(Path(__file__).parent, "cluster_kills", found, f"{json.dumps(found)}\n")


if __name__ == "__main__":
    main(*map(float, sys.argv[1:]))  # type: ignore[arg-type]
