"""The program for the first minutes on a card (``tests/bench/gpu.py``) runs without one, too."""

import importlib.util
import json
import sys
from pathlib import Path

import pytest
import torch

PROGRAM = Path(__file__).parent / "bench" / "gpu.py"


@pytest.fixture(scope="module")
def program():
    spec = importlib.util.spec_from_file_location("gpu_bench", PROGRAM)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a card")
def test_without_a_card_it_says_so(program, monkeypatch):
    monkeypatch.setenv("TRITON_INTERPRET", "0")
    monkeypatch.setattr(sys, "argv", ["gpu.py"])
    with pytest.raises(SystemExit, match=r"^no CUDA device that torch can use, .* tiny sizes"):
        program.main()


def test_what_fails_stands_in_the_table(program):
    bench = program.Bench(torch.device("cpu"), tiny=True)

    def broken():
        raise RuntimeError("out of sorts\nand more")

    bench.run("time", "broken", broken)
    bench.run("time", "good", lambda: {"ms": 1.25, "agrees": True})
    bench.began -= program.LIMIT_S
    bench.run("time", "late", lambda: {"ms": 1.0})
    text = program.table({"torch": "2"}, bench.rows, 7.0)
    assert "2 of 3 rows failed" in text
    assert "| broken | RuntimeError: out of sorts |  |  |" in text
    assert "| good |  | 1.25 | True |" in text
    assert "| late | no time was left |" in text


@pytest.mark.extended
def test_it_runs_at_tiny_sizes_by_the_interpreter(program, tmp_path, monkeypatch):
    monkeypatch.setenv("TRITON_INTERPRET", "1")
    monkeypatch.setattr(program, "LIMIT_S", 1e6)
    monkeypatch.setattr(sys, "argv", ["gpu.py", "--out", str(tmp_path)])
    program.main()
    found = json.loads((tmp_path / "gpu.json").read_text())
    assert not [r for r in found["rows"] if "failed" in r or r.get("agrees") is False]
    parts = {r["part"] for r in found["rows"]}
    assert {"projector", "FBP", "gradient", "chain", "time", "training"} <= parts
    assert "## Training" in (tmp_path / "gpu.md").read_text()
