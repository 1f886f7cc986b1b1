"""The command line, ``torchpcct train``, on a tiny model."""

import json
import signal

import pytest
import torch
from fresh_python import run_python
from tiny_training import StubObjective, assert_same_run, send, stub_build

from recon.mbir.network import NetworkConfig
from recon.mbir.unrolled import Unrolled
from train import __main__ as command_line
from train.checkpoint import start_from


@pytest.fixture
def objective(monkeypatch):
    stub = StubObjective()
    monkeypatch.setattr(command_line, "build", stub_build(stub))
    return stub


def test_command_line(tmp_path, objective, capsys):
    out = tmp_path / "runs" / "x"
    common = ["--out", str(out), "--no-progress", "--no-tensorboard"]
    start = ["--quick", "--steps", "12", "--seed", "4"]
    objective.at = {6: send(signal.SIGTERM)}
    assert command_line.main([*start, *common]) == 128 + signal.SIGTERM
    message = capsys.readouterr().out
    assert f"torchpcct train --out {out} --resume" in message
    assert "stopped at step 8 of 12" in message
    assert command_line.main([*start, *common]) == 2
    assert "--resume" in capsys.readouterr().err
    assert command_line.main(["--resume", "--seed", "5", *common]) == 2
    assert "seed" in capsys.readouterr().err
    objective.at = {}
    assert command_line.main(["--resume", *common]) == 0
    assert "weights and card in" in capsys.readouterr().out
    assert json.loads((out / "card.json").read_text())["config"]["seed"] == 4
    weights = out / "weights.safetensors"
    plain = ["--no-progress", "--no-tensorboard"]
    assert (
        command_line.main([*start, "--out", str(tmp_path / "y"), "--weights", str(weights), *plain])
        == 0
    )
    assert (
        command_line.main(
            [*start, "--out", str(tmp_path / "z"), "--weights", str(out / "training.md")]
        )
        == 2
    )
    assert "training.md is damaged or not a safetensors file" in capsys.readouterr().err


def test_second_interrupt_stops_at_once(tmp_path, objective, capsys):
    common = ["--no-progress", "--no-tensorboard"]
    objective.at = {6: send(signal.SIGINT, signal.SIGINT)}
    assert (
        command_line.main(["--quick", "--steps", "12", "--out", str(tmp_path / "x"), *common])
        == 130
    )
    assert "stopped at once" in capsys.readouterr().err
    objective.at = {}
    assert command_line.main(["--resume", "--out", str(tmp_path / "x"), *common]) == 0
    command_line.main(["--quick", "--steps", "12", "--out", str(tmp_path / "y"), *common])
    assert_same_run(tmp_path / "x", tmp_path / "y")


def test_refusals(tmp_path, objective, capsys):
    here = str(tmp_path)
    for words in (["--quick", "--config", here], ["--steps", "x"], ["--resume", "--weights", here]):
        with pytest.raises(SystemExit, match="2"):
            command_line.main(words)
    for words, message in (
        (["--threads", "0"], "--threads must be at least 1, got 0"),
        (["--painters", "-1"], "--painters must be at least 1, got -1"),
        (["--weights", "x"], "no such file: x"),
    ):
        capsys.readouterr()
        assert command_line.main(words) == 2
        assert capsys.readouterr().err == f"torchpcct train: {message}\n"
    (tmp_path / "c.yaml").write_text("stepps: 1")
    assert (
        command_line.main(["--config", str(tmp_path / "c.yaml"), "--out", str(tmp_path / "o")]) == 2
    )
    assert "c.yaml: unknown key 'stepps'" in capsys.readouterr().err
    assert command_line.main(["--config", str(tmp_path / "none.yaml")]) == 2
    assert command_line.main(["--resume", "--out", str(tmp_path / "none")]) == 2
    assert "no checkpoint" in capsys.readouterr().err


def test_nothing_heavy_is_loaded_before_the_numbers_of_threads_are_set():
    code = "import sys, train.__main__; print({'torch', 'numpy', 'numba'} & set(sys.modules))"
    assert run_python(code).stdout == "set()\n"


def test_a_wider_network_starts_where_the_narrower_one_stood():
    torch.manual_seed(0)
    narrow, wide = (
        Unrolled(NetworkConfig(channels, 0.2, 1.6, bilateral=True), 1)
        for channels in ((4, 6, 8), (8, 9, 8))
    )
    with torch.no_grad():
        narrow.network.share.fill_(0.3)
        for block in narrow.network.down:
            block.gain.weight.normal_()
    start_from(wide, narrow.state_dict())
    volumes, condition = torch.randn(2, 1, 16, 16, 16), torch.randn(1, 3)
    found = [m.network.eval()(*volumes, condition, torch.ones(1)) for m in (narrow, wide)]
    torch.testing.assert_close(found[0], found[1])
    found[1].square().sum().backward()
    assert wide.network.leave.weight.grad[:, 4:].abs().max() > 0  # the new channels learn
    with pytest.raises(ValueError, match="same or wider"):
        start_from(narrow, wide.state_dict())
    with pytest.raises(ValueError, match="share has the shape none"):
        start_from(narrow, {k: v for k, v in narrow.state_dict().items() if k != "network.share"})
