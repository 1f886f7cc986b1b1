"""The gradient of a batch, on one process and on two."""

import json
import subprocess

import pytest
import tiny_training
import torch
from tiny_training import (
    STEPS,
    StubData,
    StubObjective,
    assert_same_run,
    assert_same_tensors,
    rows,
    run,
    script,
    stub_config,
    stub_model,
)

from recon.mbir.weights_io import read_tensors
from train.checkpoint import CheckpointStore
from train.processes import Group, gradient


def test_gradient_is_that_of_the_mean_loss():
    model = stub_model()
    values, stop = gradient(stub_config(), model, StubData(), StubObjective(), 4, Group())
    assert not stop
    weight = model[0].weight
    found = weight.grad.flatten()
    at, change = int(found.abs().argmax()), 1e-2
    losses = []
    for sign in (1, -1):
        with torch.no_grad():
            weight.view(-1)[at] += sign * change
        losses.append(
            gradient(stub_config(), model, StubData(), StubObjective(), 4, Group())[0]["loss"]
        )
        with torch.no_grad():
            weight.view(-1)[at] -= sign * change
    assert float(found[at]) == pytest.approx((losses[0] - losses[1]) / (2 * change), rel=1e-2)
    assert values["scenes"] == 1.0


def launch(out, launcher):
    """Two processes of ``tiny_training gradients``; torchrun itself imports torch once more, and
    waits."""
    words = [tiny_training.__file__, "gradients", str(out)]
    if launcher == "torchrun":
        words = ["-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2", *words]
        started = [script(*words, stderr=subprocess.PIPE)]
    else:
        store = {"WORLD_SIZE": "2", "STORE": f"file://{out}/rendezvous"}
        started = [
            script(*words, stderr=subprocess.PIPE, more={**store, "RANK": str(rank)})
            for rank in range(2)
        ]
    try:
        for process in started:
            _, errors = process.communicate(timeout=600)
            assert process.returncode == 0, errors
    finally:
        for process in started:
            process.kill()


@pytest.mark.extended
@pytest.mark.parametrize("launcher", ["plain", pytest.param("torchrun", marks=pytest.mark.slow)])
def test_two_processes_give_the_gradients_of_one(tmp_path, launcher):
    launch(tmp_path, launcher)
    config, model = stub_config(batch=5), stub_model()
    values, _ = gradient(config, model, StubData(), StubObjective(), 4, Group())
    (first, meta), (second, meta_second) = (
        read_tensors(tmp_path / f"rank{r}.safetensors", "gradient") for r in (0, 1)
    )
    assert_same_tensors(first, second)
    assert meta == meta_second
    for name, p in model.named_parameters():
        torch.testing.assert_close(first[name], p.grad, rtol=1e-5, atol=1e-5)
    assert meta["values"] == pytest.approx(values, rel=1e-5)
    # A whole run, interrupted by a signal to process 1 only and resumed.
    one = tmp_path / "one"
    run(one, config)
    a, b = (CheckpointStore(p).load()[0] for p in (one, tmp_path / "two"))
    for name in a:
        torch.testing.assert_close(a[name], b[name], rtol=2e-3, atol=2e-4)
    assert [r["step"] for r in rows(tmp_path / "two" / "log.csv")] == [
        str(n + 1) for n in range(STEPS)
    ]
    # Resumed, it gives the bits of the uninterrupted run of two processes.
    assert_same_run(tmp_path / "two", tmp_path / "whole")
    # Each process computes bases and steps of SOAP by itself, from the same gradients.
    a, b = (read_tensors(tmp_path / f"soap{r}.safetensors", "weights")[0] for r in (0, 1))
    assert_same_tensors(a, b)
    assert not torch.equal(a["0.weight"], stub_model().state_dict()["0.weight"])


@pytest.mark.slow
def test_command_line_under_torchrun(tmp_path):
    torchrun = [
        "-m",
        "torch.distributed.run",
        "--standalone",
        "--nproc_per_node=2",
        tiny_training.__file__,
        "command",
    ]
    process = script(*torchrun, str(tmp_path / "x"), stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    out, errors = process.communicate(timeout=600)
    assert process.returncode == 0, errors
    assert out.count("weights and card in") == 1
    card = json.loads((tmp_path / "x" / "card.json").read_text())
    assert card["processes"] == 2
    assert card["steps_done"] == 20


def test_more_processes_than_scenes_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("train.loop.Group", lambda: type("G", (), {"rank": 0, "size": 8})())
    with pytest.raises(ValueError, match=r"batch \(4\)"):
        run(tmp_path / "x")
