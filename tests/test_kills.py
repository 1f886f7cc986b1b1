"""Killed (SIGKILL) at random moments, commands lose no file and little work, and end as if nothing
had been.

Each command runs in its own process, as a person starts it; its settings alone are small. What dies
in the middle of a result or of a write is :mod:`recon.jobs.test_store` and :mod:`train.test_run`;
here nobody chooses the moment.
"""

import io
import json
import os
import signal
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tiny_training import assert_same_run

from recon.mbir.weights_io import read_tensors
from recon.study.results import differences
from train.checkpoint import CHECKPOINT_FORMAT
from train.config import LONGEST_INTERVAL

KILLS = 6
LOST_S = 120.0

STUDY = """
import sys, time
from pathlib import Path
from tiny_studies import INSERT, TINY
from recon.cli import main
from recon.study import registry
from recon.jobs.store import Store
out, name = sys.argv[1:]
kind = registry.settings_class(name) if name != "evaluate" else type("", (), {})
kind.QUICK = TINY.get(name)
cached = Store.cached
def noted(self, at, key, compute):
    def computed():
        arrays = compute()
        with Path(out + ".computed").open("a") as file:
            file.write(at + "\\n")
        return arrays
    return cached(self, at, key, computed)
Store.cached = noted
Path(out + ".begun").touch()
if name == "evaluate":
    # On the voxels that the network knows.
    insert = "name: insert" + INSERT.replace("voxel_mm: 0.4", "voxel_mm: 0.2")
    Path(out + ".yaml").write_text(insert)
    methods = ["--method", "mbir", "--method", "gaussian@fbp:soft"]
    start = ["evaluate", "--task", out + ".yaml", *methods, "--n", "16"]
else:
    start = [name, "--quick"] if name == "compare" else ["study", name, "--quick"]
assert main([*start, "--out", out]) == 0
"""
TRAIN = """
import sys
from pathlib import Path
from tiny_training import StubObjective, stub_build
from train import __main__ as command_line
out = sys.argv[1]
command_line.build = stub_build(StubObjective(pause=0.03))
Path(out + ".begun").touch()
begun = any((Path(out) / f"checkpoint{x}.safetensors").exists() for x in ("", ".previous"))
arguments = ["--config", out + ".yaml", "--out", out, "--threads", "1", "--no-tensorboard"]
assert command_line.main([*arguments, *(["--resume"] if begun else [])]) == 0
"""


def _start(script, *arguments):
    path = os.pathsep.join(
        [str(Path(__file__).parent / "helpers"), str(Path(__file__).parents[1]), *sys.path]
    )
    command = [sys.executable, "-c", script, *map(str, arguments)]
    return subprocess.Popen(
        command,
        env={**os.environ, "PYTHONPATH": path},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )


def _whole(path):
    """A file that can be read to its end."""
    data = path.read_bytes()
    if path.suffix == ".npz":
        assert zipfile.ZipFile(io.BytesIO(data)).testzip() is None, path
    elif path.suffix == ".json":
        json.loads(data)
    elif path.suffix == ".png":
        Image.open(io.BytesIO(data)).load()
    elif path.name.startswith("checkpoint"):
        read_tensors(path, CHECKPOINT_FORMAT)


def _finished(folder):
    """Names of the files that are there, whole; those that are being written have ``part`` or
    ``next`` in theirs."""
    names = {
        p
        for p in folder.rglob("*")
        if p.is_file() and ".part." not in p.name and ".next." not in p.name
    }
    for path in names:
        _whole(path)
    return names


def _begun(script, out, *arguments):
    """A process that has done its imports."""
    begun = Path(f"{out}.begun")
    begun.unlink(missing_ok=True)
    process = _start(script, out, *arguments)
    while not begun.exists():
        assert process.poll() is None, process.stderr.read().decode()
        time.sleep(0.01)
    return process


def _uninterrupted(script, out, *arguments):
    """Run it; seconds without the imports."""
    process, start = _begun(script, out, *arguments), time.monotonic()
    error = process.communicate()[1].decode()
    assert process.returncode == 0, error
    return time.monotonic() - start


def _killed(script, out, span, *arguments):
    """Run until it is through, killed before within ``span`` s: number of kills, the longest
    work lost to one, s."""
    kills, lost = 0, 0.0
    rng = np.random.default_rng(len(arguments))
    while True:
        there = _finished(out) if out.exists() else set()
        process, start = _begun(script, out, *arguments), time.time()
        # Some moments early, where folders and first files are made; the others anywhere.
        moment = rng.uniform(0.0, span / 20 if kills % 3 == 0 else span)
        try:
            process.wait(float(moment) if kills < KILLS else None)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
        end = time.time()
        error = process.communicate()[1].decode()
        if process.returncode == 0:
            return kills, lost
        assert process.returncode == -signal.SIGKILL, error
        kills += 1
        now = _finished(out) if out.exists() else set()
        assert there <= now, f"lost: {there - now}"
        lost = max(lost, end - max([start, *(p.stat().st_mtime for p in now)]))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["compare", "noise", "evaluate"])
def test_studies_killed_at_random_moments(name, tmp_path):
    seconds = _uninterrupted(STUDY, tmp_path / "whole", name)
    kills, lost = _killed(STUDY, tmp_path / "killed", seconds, name)
    assert kills >= 2
    assert lost < LOST_S
    killed, whole = (
        (tmp_path / f"{x}.computed").read_text().split("\n")[:-1] for x in ("killed", "whole")
    )
    assert set(killed) == set(whole)
    assert len(killed) <= len(whole) + kills  # what was computed, not yet written
    reports = [json.loads((tmp_path / x / "report.json").read_text()) for x in ("whole", "killed")]
    for report in reports:
        report.pop("command", None)
        report["records"] = [r for r in report.get("records", ()) if r["figure"] != "seconds"]
    assert list(differences(*reports)) == []
    names = [
        {p.relative_to(tmp_path / x) for p in (tmp_path / x).rglob("*")}
        for x in ("whole", "killed")
    ]
    assert names[0] == names[1]  # and nothing half written is left


@pytest.mark.slow
def test_training_killed_at_random_moments(tmp_path):
    assert LONGEST_INTERVAL <= LOST_S  # no configuration keeps less often
    settings = (
        "steps: 200\nbatch: 4\nwarmup: 3\nema: 0.9\nvalidate_every: 50\nclip: "
        "20.0\nlearning_rate: 0.02\n"
        "checkpoint_seconds: 0.3\n"
    )
    for name in ("killed", "whole"):
        (tmp_path / f"{name}.yaml").write_text(settings)
    seconds = _uninterrupted(TRAIN, tmp_path / "whole")
    kills, lost = _killed(TRAIN, tmp_path / "killed", seconds)
    assert kills >= 3
    assert lost < 30.0  # a hundred checkpoints
    assert_same_run(tmp_path / "killed", tmp_path / "whole")
    assert not [
        p for p in (tmp_path / "killed").rglob("*") if ".part." in p.name or ".next." in p.name
    ]
