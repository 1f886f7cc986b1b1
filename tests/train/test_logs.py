"""What a run leaves to look at: tables, pictures, events, a progress line, the card."""

import csv
import json
import signal
import sys

import numpy as np
import pytest
import torch
import yaml
from matplotlib.image import imread
from tiny_training import STEPS, StubObjective, rows, run, send, stub_config

from train.logs import Logs, Table


def test_table_is_cut_back_to_the_checkpoint(tmp_path):
    path = tmp_path / "t.csv"
    table = Table(path)
    for step in (1, 2, 3):
        table.append(step, {"a": step / 3, "b": float("nan")})
    table.close()
    path.write_text(path.read_text() + "4,0.1")  # cut short
    again = Table(path, after=2)
    assert [r["step"] for r in rows(path)] == ["1", "2"]
    again.append(3, {"a": 7.0, "c": 1e-9})
    again.close()
    with open(path, newline="") as file:
        found = list(csv.reader(file))
    assert found == [
        ["step", "a", "b", "c"],
        ["1", repr(1 / 3), "nan", ""],
        ["2", repr(2 / 3), "nan", ""],
        ["3", "7", "", "1e-09"],
    ]
    assert Table(path, after=0).columns == []
    assert not path.exists()


def test_picture_window(tmp_path):
    logs = Logs(tmp_path, 0, 10, progress=False, tensorboard=False)
    image = np.array([[-200.0, -150.0, 150.0], [450.0, 900.0, np.nan]])
    logs.validated(3, 0.5, {}, {"0.35s_1": image})
    logs.close()
    picture = imread(tmp_path / "pictures" / "0.35s_1_000003.png")
    assert picture.shape == (256, 384, 4)
    assert (255 * picture[::128, ::128, 0]).round().tolist() == [[0, 0, 128], [255, 255, 0]]


def test_fewer_rows_and_a_progress_line(tmp_path, capfd):
    run(tmp_path / "x", stub_config(log_every=5), progress=True)
    assert [r["step"] for r in rows(tmp_path / "x" / "log.csv")] == ["5", "10", "12"]
    text = capfd.readouterr().err
    assert f"{STEPS}/{STEPS}" in text
    assert "validation score" in text


def test_tensorboard_events(tmp_path):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    run(tmp_path / "x", objective=StubObjective({5: send(signal.SIGTERM)}), tensorboard=True)
    run(tmp_path / "x", tensorboard=True, resume=True)
    events = EventAccumulator(str(tmp_path / "x" / "tensorboard")).Reload()
    assert [e.step for e in events.Scalars("train/loss")] == list(range(1, STEPS + 1))
    assert [e.step for e in events.Scalars("validation/score")] == [5, 10, 12]


def test_without_tensorboard(tmp_path, monkeypatch, caplog):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with caplog.at_level("INFO", logger="train"):
        assert run(tmp_path / "x", stub_config(steps=2), tensorboard=True)[0].step == 2
    assert "tensorboard is not installed" in caplog.text


def test_card(uninterrupted):
    card = json.loads((uninterrupted / "card.json").read_text())
    assert card["config"]["steps"] == STEPS
    assert card["seed"] == 0
    assert card["sessions"] == [{"command": "python -m train --out whole", "first_step": 0}]
    assert card["versions"]["torch"] == torch.__version__
    assert set(card["versions"]) >= {
        "torchpcct",
        "python",
        "numpy",
        "scipy",
        "numba",
        "safetensors",
    }
    assert card["hardware"]["cores"] >= 1
    assert card["hardware"]["cpu"]
    assert card["validation"]["bias"] == "nan"
    assert card["parameters"] == 65 + 33
    assert 0 <= card["seconds_to_these_weights"] <= card["seconds"] + 0.1
    text = (uninterrupted / "training.md").read_text()
    assert "python -m train --out whole" in text
    assert yaml.safe_load(text.split("```yaml\n")[1].split("```")[0])["validate_every"] == 5
