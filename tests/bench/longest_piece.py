"""The most that a kill can cost: the longest stretch of a command, at paper scale, between two results that are kept.

    python tests/bench/longest_piece.py [NAME …] [--threads 1] [--work out/longest-piece]

Every command runs in a process of its own, from nothing, and what it keeps is noted with its time: pieces of a study,
checkpoints of a training. Two lengths are told: that of the longest piece itself, and that of the longest stretch
without a kept result, which also holds what is computed between pieces and is done again in any case (imports, loading
the scene, the report). Commands that finish go on without their finished pieces next time; ``dose-factor`` runs with
fewer draws than the published table (blocks of draws are pieces of one size, however many there are), a training until
its second validation. Times are those of the wall: what else the machine does makes them longer. Finished
measurements are kept in ``longest_piece.json`` beside this file.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

RESULT = Path(__file__).with_suffix(".json")
LIMIT_S = 120.0
"""What a kill may cost."""

COMMANDS: dict[str, list[str]] = {
    "phantom": ["study", "phantom"],
    "detector": ["study", "detector"],
    "resolution": ["study", "resolution"],
    "noise": ["study", "noise"],
    "compare": ["compare"],
    "spectral": ["study", "spectral"],
    "bowtie": ["study", "bowtie"],
    "hardcases": ["hardcases"],
    "motion": ["study", "motion"],
    "dose-factor": ["dose-factor", "--n", "8", "--exposure", "0.35", "--task", "plaque", "--task", "curved"],
    "train": [],
}  # fmt: skip

STUDY = """
import sys, time
out, log, *command = sys.argv[1:]
from recon.evaluate.store import Store
inner, running = Store.piece, []
def noted(self, name, key, compute):
    spent = []
    def timed():
        start = time.monotonic()
        running.append(name)
        try:
            return compute()
        finally:
            running.pop()
            spent.append(time.monotonic() - start)
    found = inner(self, name, key, timed)
    for seconds in spent:
        with open(log, "a") as file:
            file.write(f"{time.monotonic()} {seconds} {len(running)} {name}\\n")
    return found
Store.piece = noted
from recon.cli import main
sys.exit(main([*command, "--out", out, "--no-progress"]))
"""

TRAIN = """
import os, signal, sys, time
out, log, *_ = sys.argv[1:]
from train import run
from train.__main__ import main
inner, check = run.Run.save, run.Run.validate
def noted(self):
    inner(self)
    with open(log, "a") as file:
        file.write(f"{time.monotonic()} 0 0 step {self.state.step}\\n")
def validated(self, *arguments):
    check(self, *arguments)
    if self.state.validated >= 2 * self.config.validate_every:
        os.kill(os.getpid(), signal.SIGTERM)
run.Run.save, run.Run.validate = noted, validated
sys.exit(main(["--out", out, "--no-tensorboard", "--threads", os.environ["OMP_NUM_THREADS"]]))
"""


def measured(name: str, threads: int, work: Path) -> dict[str, Any]:
    """Run a command; its longest piece and its longest stretch without one."""
    out, log = work / name, work / f"{name}.log"
    shutil.rmtree(out, ignore_errors=True)
    log.unlink(missing_ok=True)
    count = str(threads)
    environment = {**os.environ, "OMP_NUM_THREADS": count, "NUMBA_NUM_THREADS": count}
    script = TRAIN if name == "train" else STUDY
    start = time.monotonic()
    with (work / f"{name}.txt").open("w") as printed:
        code = subprocess.run(
            [sys.executable, "-c", script, str(out), str(log), *COMMANDS[name]], env=environment, stdout=printed,
            stderr=subprocess.STDOUT, check=False,
        ).returncode  # fmt: skip
    end = time.monotonic()
    lines = [line.split(" ", 3) for line in log.read_text().splitlines()] if log.exists() else []
    events = [(float(at), float(seconds), int(depth), piece) for at, seconds, depth, piece in lines]
    # A piece that others are part of costs what is left of it, were they kept; the stretches tell that.
    alone = max(((s, piece) for _, s, depth, piece in events if not depth), default=(0.0, ""))
    marks = [(start, "the start"), *((at, piece) for at, _, _, piece in events), (end, "the end")]
    stretch = max((b[0] - a[0], f"from {a[1]} to {b[1]}") for a, b in pairwise(marks))
    return {
        "command": " ".join(["torchpcct", *COMMANDS[name]]) if COMMANDS[name] else "python -m train",
        "exit": code, "seconds": round(end - start, 1), "kept": len(events), "threads": threads,
        "longest_piece_s": round(alone[0], 1), "longest_piece": alone[1],
        "longest_stretch_s": round(stretch[0], 1), "longest_stretch": stretch[1],
    }  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(COMMANDS)}; all if none is given")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--work", type=Path, default=Path("out/longest-piece"))
    options = parser.parse_args()
    unknown = set(options.names) - set(COMMANDS)
    if unknown:
        parser.error(f"no such command: {', '.join(sorted(unknown))}; there are {', '.join(COMMANDS)}")
    options.work.mkdir(parents=True, exist_ok=True)
    found = json.loads(RESULT.read_text(encoding="utf-8")) if RESULT.exists() else {}
    for name in options.names or COMMANDS:
        found[name] = measured(name, options.threads, options.work.absolute())
        print(name, json.dumps(found[name]), flush=True)
        RESULT.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return int(any(found[n]["longest_stretch_s"] > LIMIT_S for n in options.names or COMMANDS))


if __name__ == "__main__":
    raise SystemExit(main())
