"""The training engine on a tiny model: resuming, crashes, several processes, logs, configuration, command line.

Run as a script, it is the training that the tests kill or start with torchrun.
"""

import csv
import json
import os
import pickle
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from safetensors.torch import save_file
from torch import nn

from train.card import load_weights
from train.checkpoint import CHECKPOINT_FORMAT, CheckpointError, Store, read_tensors, write_atomically, write_tensors
from train.config import TrainConfig, differences, load_config, packaged_config
from train.logs import Table, save_picture
from train.loop import Adam, DivergedError, Group, gradient, learning_rate, train

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class StubConfig:
    width: int = 8


@dataclass
class StubLoss:
    total: torch.Tensor
    parts: dict


@dataclass
class StubValidation:
    score: float
    figures: dict
    pictures: dict = field(default_factory=dict)


class StubData:
    def batch(self, seed, step, indices):
        drawn = [torch.randn(7, generator=torch.Generator().manual_seed(seed + 1000 * step + i)) for i in indices]
        return torch.stack(drawn)


class StubObjective:
    """Squared error of a fixed function; ``at`` maps a number of the step to something to do in it."""

    def __init__(self, at=None, pause=0.0):
        self.at = at or {}
        self.pause = pause
        self.validations = 0

    def __call__(self, model, batch, progress):
        time.sleep(self.pause)
        error = (model(batch[:, :6]).squeeze(1) - batch[:, :6].square().sum(1)).square()
        # Draws on the global generator must be reproducible too.
        total = error.sum() * (1 + 1e-3 * torch.rand(()))
        for step, action in self.at.items():
            if step == round(progress * 30):
                total = action(total)
        return StubLoss(total, {"square": float(error.detach().sum()), "scenes": float(len(batch))})

    @torch.no_grad()
    def validate(self, model, data, seed):
        assert not model.training
        self.validations += 1
        batch = data.batch(seed, 10**6, range(16))
        error = (model(batch[:, :6]).squeeze(1) - batch[:, :6].square().sum(1)).square().mean()
        picture = np.linspace(-200, 500, 12, dtype=np.float32).reshape(3, 4) + float(error)
        return StubValidation(-float(error), {"rms": float(error.sqrt()), "bias": float("nan")}, {"a b": picture})


def stub_model(seed=0):
    torch.manual_seed(seed)
    return nn.Sequential(nn.Linear(6, 8), nn.Tanh(), nn.BatchNorm1d(8, momentum=0.1).eval(), nn.Linear(8, 1))


def stub_config(**changes):
    values = dict(steps=30, batch=4, warmup=3, ema=0.9, validate_every=7, clip=20.0, learning_rate=0.02)
    return TrainConfig(**{**values, "data": StubConfig(), "objective": StubConfig(), **changes})


def run(out, config=None, objective=None, **options):
    options = {"tensorboard": False, **options}
    config = config or stub_config()
    return train(config, stub_model(config.seed), StubData(), objective or StubObjective(), out, **options)


def send(number):
    def action(total):
        os.kill(os.getpid(), number)
        return total

    return action


def rows(path, without=("seconds",)):
    with open(path, newline="") as file:
        return [{k: v for k, v in row.items() if k not in without} for row in csv.DictReader(file)]


def assert_same_run(first, second):
    """Everything but times and command lines is the same, to the bit."""
    a, meta_a = read_tensors(first / "checkpoint.safetensors", CHECKPOINT_FORMAT)
    b, meta_b = read_tensors(second / "checkpoint.safetensors", CHECKPOINT_FORMAT)
    assert a.keys() == b.keys()
    assert {k.split(".")[0] for k in a} == {"model", "average", "best", "adam"}
    for name in a:
        assert torch.equal(a[name], b[name]), name
    for meta in (meta_a, meta_b):
        for key in ("seconds", "sessions"):
            meta["state"].pop(key)
        meta["state"]["best"].pop("seconds")
    assert meta_a["state"] == meta_b["state"]
    for name in ("log.csv", "validation.csv"):
        assert rows(first / name) == rows(second / name)
    weights_a, weights_b = (load_weights(p / "weights.safetensors")[0] for p in (first, second))
    for name in weights_a:
        assert torch.equal(weights_a[name], weights_b[name])
    names = [sorted(p.name for p in (x / "pictures").iterdir()) for x in (first, second)]
    assert names[0] == names[1]
    for name in names[0]:
        assert (first / "pictures" / name).read_bytes() == (second / "pictures" / name).read_bytes()


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    out = tmp_path_factory.mktemp("run") / "whole"
    outcome = run(out, command="python -m train --out whole")
    assert outcome.finished
    assert outcome.step == 30
    return out


# Resuming


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_resumed_run_is_bit_for_bit_the_uninterrupted_one(tmp_path, uninterrupted, number):
    """Interrupted twice: in the middle, and in the step before a validation."""
    before = signal.getsignal(number)
    for step, resume in ((10, False), (20, True)):
        outcome = run(tmp_path / "x", objective=StubObjective({step: send(number)}), resume=resume)
        assert not outcome.finished
        assert outcome.signal == number
        # The signal came during step number `step` (from 0); all processes agree on it in the next one.
        assert outcome.step == step + 2
    assert signal.getsignal(number) is before
    assert run(tmp_path / "x", resume=True).finished
    assert_same_run(tmp_path / "x", uninterrupted)


def test_validation_due_at_an_interruption_is_made_up(tmp_path, uninterrupted):
    outcome = run(tmp_path / "x", objective=StubObjective({12: send(signal.SIGTERM)}))
    assert outcome.step == 14
    assert len(rows(tmp_path / "x" / "validation.csv")) == 1
    run(tmp_path / "x", resume=True)
    assert_same_run(tmp_path / "x", uninterrupted)


def test_finished_run_resumed_changes_nothing(tmp_path, uninterrupted):
    run(tmp_path / "x")
    objective = StubObjective()
    assert run(tmp_path / "x", objective=objective, resume=True).finished
    assert objective.validations == 0
    assert_same_run(tmp_path / "x", uninterrupted)


def script(*arguments, more=None, **options):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": str(torch.get_num_threads())}
    environment.update(more or {})
    return subprocess.Popen([sys.executable, *arguments], env=environment, cwd=ROOT, text=True, **options)


def test_killed_run_resumed(tmp_path, uninterrupted):
    """SIGKILL at an arbitrary moment: the log ran ahead of the checkpoint, and is cut back."""
    out = tmp_path / "x"
    process = script(__file__, "slow", str(out))
    try:
        log, deadline = out / "log.csv", time.monotonic() + 60
        while not (log.exists() and len(log.read_text().splitlines()) > 17):
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.002)
    finally:
        process.kill()
        process.wait()
    reached = int(rows(log)[-1]["step"])
    state = Store(out).load()[1]["state"]
    assert 0 < state["step"] <= reached < 30
    assert run(out, resume=True).finished
    assert_same_run(out, uninterrupted)


class Crash(BaseException):
    pass


@pytest.mark.parametrize("call", ["replace", "fsync"])
def test_crash_at_any_write(tmp_path, uninterrupted, monkeypatch, call):
    """The process ends at the n-th rename or flush, for many n: what is left always continues to the same result."""
    real = getattr(os, call)
    config = stub_config(checkpoint_seconds=1e-9)
    loadable = 0
    for n in (1, 3, 4, 5, 6, 34, 35, 36, 37):
        out = tmp_path / str(n)
        count = 0

        def crash(*arguments, limit=n):
            nonlocal count
            count += 1
            if count == limit:
                raise Crash
            return real(*arguments)

        monkeypatch.setattr(os, call, crash)
        with pytest.raises(Crash):
            run(out, config)
        monkeypatch.undo()
        try:
            Store(out).load()
        except CheckpointError:
            # Only before the first checkpoint, when nothing has been trained.
            assert not (out / "log.csv").exists() or not rows(out / "log.csv")
            continue
        loadable += 1
        run(out, resume=True)
        assert_same_run(out, uninterrupted)
        assert not list(out.glob("*.tmp"))
        assert not list(out.glob("*next*"))
    assert loadable >= 5


@pytest.mark.parametrize("damage", ["cut", "flip", "missing", "foreign", "pickle"])
def test_damaged_checkpoint_falls_back_to_the_previous_one(tmp_path, uninterrupted, damage, caplog):
    out = tmp_path / "x"
    run(out, objective=StubObjective({16: send(signal.SIGTERM)}))
    store = Store(out)

    def spoil(path):
        data = path.read_bytes()
        if damage == "cut":
            path.write_bytes(data[: len(data) * 2 // 3])
        elif damage == "flip":
            path.write_bytes(data[:-10] + bytes([data[-10] ^ 1]) + data[-9:])
        elif damage == "missing":
            path.unlink()
        elif damage == "foreign":
            save_file({"model.0.weight": torch.zeros(3)}, path)
        else:
            path.write_bytes(pickle.dumps({"model": [1.0]}))

    older = read_tensors(store.previous, CHECKPOINT_FORMAT)[1]["state"]["step"]
    spoil(store.current)
    metadata, warning = store.load()[1:]
    assert metadata["state"]["step"] == older
    assert "checkpoint.safetensors" in warning
    both = tmp_path / "both"
    both.mkdir()
    for path in (store.current, store.previous):
        if path.exists():
            (both / path.name).write_bytes(path.read_bytes())
    spoil(both / store.previous.name)
    with pytest.raises(CheckpointError, match=r"checkpoint.safetensors .*checkpoint.previous.safetensors "):
        run(both, resume=True)
    with caplog.at_level("INFO", logger="train"):
        run(out, resume=True)
    assert "continuing from the previous checkpoint" in caplog.text
    assert_same_run(out, uninterrupted)


def test_previous_checkpoint_is_the_one_before(tmp_path):
    store = Store(tmp_path)
    for n in range(3):
        store.save({"x": torch.full((2,), float(n))}, {"n": n})
    assert store.load()[1:] == ({"n": 2}, None)
    assert read_tensors(store.previous, CHECKPOINT_FORMAT)[1] == {"n": 1}
    assert sorted(p.name for p in tmp_path.iterdir()) == ["checkpoint.previous.safetensors", "checkpoint.safetensors"]


def test_tensors_of_every_kind_round_trip(tmp_path):
    base = torch.randn(4, 3)
    tensors = {
        "shared": base,
        "transposed": base.T,
        "scalar": torch.tensor(2.5),
        "int": torch.arange(3),
        "empty": torch.zeros(0, 2),
        "half": base.to(torch.bfloat16),
        "flag": torch.tensor([True, False]),
    }
    write_tensors(tmp_path / "t", "kind", tensors, {"x": 0.1, "µ": [1, None]})
    found, metadata = read_tensors(tmp_path / "t", "kind")
    assert metadata == {"x": 0.1, "µ": [1, None]}
    for name, value in tensors.items():
        assert found[name].dtype == value.dtype
        assert torch.equal(found[name], value)
    with pytest.raises(CheckpointError, match="not a 'other'"):
        read_tensors(tmp_path / "t", "other")


def test_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "f"
    write_atomically(path, b"old")

    def full(*_):
        raise OSError("no space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="no space"):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["f"]


def test_resume_refuses_another_configuration_or_model(tmp_path):
    run(tmp_path / "x", objective=StubObjective({5: send(signal.SIGTERM)}))
    with pytest.raises(ValueError, match=r"learning_rate, objective\.width"):
        run(tmp_path / "x", stub_config(learning_rate=1.0, objective=StubConfig(9)), resume=True)
    with pytest.raises(CheckpointError, match="another model"):
        train(stub_config(), nn.Linear(6, 1), StubData(), StubObjective(), tmp_path / "x", resume=True)
    assert run(tmp_path / "x", stub_config(checkpoint_seconds=3.0), resume=True).finished


def test_resume_with_other_threads_says_so(tmp_path, caplog):
    run(tmp_path / "x", objective=StubObjective({5: send(signal.SIGTERM)}))
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(threads + 1)
        with caplog.at_level("INFO", logger="train"):
            run(tmp_path / "x", resume=True)
    finally:
        torch.set_num_threads(threads)
    assert f"threads {threads} → {threads + 1}" in caplog.text


def test_folder_in_use_is_refused(tmp_path):
    (tmp_path / "note.txt").write_text("mine")
    with pytest.raises(FileExistsError, match="--resume"):
        run(tmp_path)
    with pytest.raises(CheckpointError, match="no checkpoint to resume from"):
        run(tmp_path / "nothing", resume=True)
    assert [p.name for p in tmp_path.iterdir()] == ["note.txt"]


# Optimisation


def test_learning_rate_follows_the_steps():
    config = stub_config(steps=1000, warmup=10, learning_rate=1.0, final_fraction=0.1)
    assert learning_rate(config, 0) == pytest.approx(0.1)
    assert learning_rate(config, 9) == 1.0
    assert learning_rate(config, 10) == 1.0
    assert learning_rate(config, 505) == pytest.approx(0.55, abs=1e-3)
    assert learning_rate(config, 999) == pytest.approx(0.1, abs=1e-4)
    assert learning_rate(stub_config(steps=1, warmup=0), 0) == 0.02


def test_it_trains_and_the_best_average_is_shipped(uninterrupted):
    validations = rows(uninterrupted / "validation.csv")
    assert [r["step"] for r in validations] == ["7", "14", "21", "28", "30"]
    scores = [float(r["score"]) for r in validations]
    assert scores[-1] > scores[0]
    weights, header = load_weights(uninterrupted / "weights.safetensors")
    assert header["score"] == max(scores)
    model = stub_model(5).eval()
    model.load_state_dict(weights)
    assert StubObjective().validate(model, StubData(), 0).score == pytest.approx(max(scores), rel=1e-5)
    first, last = (rows(uninterrupted / "log.csv")[i] for i in (0, -1))
    assert list(first) == ["step", "lr", "grad_norm", "skipped", "loss", "square", "scenes"]
    assert float(first["scenes"]) == 1.0
    assert float(first["lr"]) == pytest.approx(0.02 / 3)
    assert last["step"] == "30"


def test_average_of_weights(tmp_path):
    """The average is the recursion over the weights of every step."""
    seen = []

    def keep(total):
        return total

    class Watch(StubObjective):
        def __call__(self, model, batch, progress):
            seen.append(model[0].weight.detach().clone())
            return super().__call__(model, batch, progress)

    run(tmp_path / "x", objective=Watch({0: keep}))
    tensors, _, _ = Store(tmp_path / "x").load()
    expected = seen[0]
    for step, weight in enumerate([*seen[1:], tensors["model.0.weight"]]):
        decay = min(0.9, (1 + step) / (10 + step))
        expected = decay * expected + (1 - decay) * weight
    torch.testing.assert_close(tensors["average.0.weight"], expected, rtol=1e-5, atol=1e-6)


def test_gradient_is_that_of_the_mean_loss():
    model = stub_model()
    vector, values, stop = gradient(stub_config(), model, StubData(), StubObjective(), 4, Group())
    assert not stop
    weight = model[0].weight
    at, change = int(vector[: weight.numel()].abs().argmax()), 1e-2
    losses = []
    for sign in (1, -1):
        with torch.no_grad():
            weight.view(-1)[at] += sign * change
        losses.append(gradient(stub_config(), model, StubData(), StubObjective(), 4, Group())[1]["loss"])
        with torch.no_grad():
            weight.view(-1)[at] -= sign * change
    assert float(vector[at]) == pytest.approx((losses[0] - losses[1]) / (2 * change), rel=1e-2)
    assert values["scenes"] == 1.0


def test_adam_is_that_of_torch():
    ours, theirs = stub_model(), stub_model()
    adam, reference = Adam(ours), torch.optim.Adam(theirs.parameters(), lr=0.1, betas=(0.9, 0.99))
    for step in range(20):
        vector = torch.randn(len(adam.moments["first"]), generator=torch.Generator().manual_seed(step))
        start = 0
        for p in theirs.parameters():
            p.grad = vector[start : start + p.numel()].view_as(p).clone()
            start += p.numel()
        reference.step()
        adam.step(vector, 0.1)
    for a, b in zip(ours.parameters(), theirs.parameters(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-6)


def test_long_gradients_are_shortened(tmp_path):
    """Adam forgets a common factor of all gradients: compare the first moments after one step."""
    moments = {}
    for clip in (1e-3, float("inf")):
        out = tmp_path / str(clip)
        run(out, stub_config(steps=1, clip=clip))
        moments[clip] = Store(out).load()[0]["adam.first"]
    norm = float(rows(out / "log.csv")[0]["grad_norm"])
    assert float(moments[1e-3].norm()) == pytest.approx(0.1 * 1e-3, rel=1e-4)
    torch.testing.assert_close(moments[1e-3], moments[float("inf")] * (1e-3 / norm), rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_steps_that_are_not_finite_are_skipped(tmp_path, bad):
    outcome = run(tmp_path / "x", objective=StubObjective({9: lambda t: t * bad, 10: lambda t: t * bad}))
    assert outcome.finished
    assert outcome.skipped == 2
    tensors, _, _ = Store(tmp_path / "x").load()
    assert all(torch.isfinite(t).all() for t in tensors.values())
    table = rows(tmp_path / "x" / "log.csv")
    assert [r["skipped"] for r in table[8:12]] == ["0", "1", "2", "2"]
    assert json.loads((tmp_path / "x" / "card.json").read_text())["steps_skipped"] == 2


def test_loss_that_is_not_finite_with_a_finite_gradient_is_skipped(tmp_path):
    outcome = run(tmp_path / "x", objective=StubObjective({9: lambda t: t + float("inf")}))
    assert outcome.skipped == 1


def test_diverged_run_is_given_up(tmp_path):
    at = {k: (lambda t: t * float("nan")) for k in range(8, 30)}
    with pytest.raises(DivergedError, match=r"20 steps in a row, up to step 28: .*since step 8"):
        run(tmp_path / "x", objective=StubObjective(at))


# Several processes


def launch(out, launcher):
    """Two processes of :func:`_gradients`; torchrun itself imports torch once more, and waits."""
    if launcher == "torchrun":
        words = ["-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2", __file__, "gradients", str(out)]
        started = [script(*words, stderr=subprocess.PIPE)]
    else:
        store = {"WORLD_SIZE": "2", "STORE": f"file://{out}/rendezvous"}
        started = [
            script(__file__, "gradients", str(out), stderr=subprocess.PIPE, more={**store, "RANK": str(rank)})
            for rank in range(2)
        ]
    try:
        for process in started:
            _, errors = process.communicate(timeout=180)
            assert process.returncode == 0, errors
    finally:
        for process in started:
            process.kill()


@pytest.mark.parametrize("launcher", ["plain", pytest.param("torchrun", marks=pytest.mark.slow)])
def test_two_processes_give_the_gradients_of_one(tmp_path, launcher):
    launch(tmp_path, launcher)
    config = stub_config(batch=5)
    alone, values, _ = gradient(config, stub_model(), StubData(), StubObjective(), 4, Group())
    ranks = [read_tensors(tmp_path / f"rank{r}.safetensors", "gradient") for r in range(2)]
    assert torch.equal(ranks[0][0]["gradient"], ranks[1][0]["gradient"])
    assert ranks[0][1] == ranks[1][1]
    torch.testing.assert_close(ranks[0][0]["gradient"], alone, rtol=1e-5, atol=1e-5)
    assert ranks[0][1]["values"] == pytest.approx(values, rel=1e-5)
    # A whole run, interrupted by a signal to process 1 only and resumed.
    one = tmp_path / "one"
    run(one, config)
    a, b = (Store(p).load()[0] for p in (one, tmp_path / "two"))
    for name in a:
        torch.testing.assert_close(a[name], b[name], rtol=2e-3, atol=2e-4)
    assert [r["step"] for r in rows(tmp_path / "two" / "log.csv")] == [str(n + 1) for n in range(30)]
    # Resumed, it gives the bits of the uninterrupted run of two processes.
    assert_same_run(tmp_path / "two", tmp_path / "whole")


@pytest.mark.slow
def test_command_line_under_torchrun(tmp_path):
    torchrun = ["-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2", __file__, "command"]
    process = script(*torchrun, str(tmp_path / "x"), stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    out, errors = process.communicate(timeout=180)
    assert process.returncode == 0, errors
    assert out.count("weights and card in") == 1
    card = json.loads((tmp_path / "x" / "card.json").read_text())
    assert card["processes"] == 2
    assert card["steps_done"] == 20


def test_more_processes_than_scenes_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("train.loop.Group", lambda: type("G", (), {"rank": 0, "size": 8})())
    with pytest.raises(ValueError, match=r"batch \(4\)"):
        run(tmp_path / "x")


# Logs


def test_table_is_cut_back_to_the_checkpoint(tmp_path):
    path = tmp_path / "t.csv"
    table = Table(path)
    for step in (1, 2, 3):
        table.append(step, {"a": step / 3, "b": float("nan")})
    table.close()
    path.write_text(path.read_text() + "4,0.1")  # cut short
    again = Table(path, after=2)
    assert again.steps == [1, 2]
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
    from PIL import Image

    save_picture(tmp_path / "p.png", np.array([[-200.0, -150.0, 150.0], [450.0, 900.0, np.nan]]))
    image = np.asarray(Image.open(tmp_path / "p.png"))
    assert image.shape == (256, 384)
    assert image[::128, ::128].tolist() == [[0, 0, 128], [255, 255, 0]]
    with pytest.raises(ValueError, match="2-D"):
        save_picture(tmp_path / "q.png", np.zeros((2, 2, 2)))


def test_fewer_rows(tmp_path):
    run(tmp_path / "x", stub_config(log_every=8))
    assert [r["step"] for r in rows(tmp_path / "x" / "log.csv")] == ["8", "16", "24", "30"]


def test_tensorboard_events(tmp_path):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    run(tmp_path / "x", objective=StubObjective({9: send(signal.SIGTERM)}), tensorboard=True)
    run(tmp_path / "x", tensorboard=True, resume=True)
    events = EventAccumulator(str(tmp_path / "x" / "tensorboard")).Reload()
    assert [e.step for e in events.Scalars("train/loss")] == list(range(1, 31))
    assert [e.step for e in events.Scalars("validation/score")] == [7, 14, 21, 28, 30]


def test_without_tensorboard(tmp_path, monkeypatch, caplog):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with caplog.at_level("INFO", logger="train"):
        assert run(tmp_path / "x", stub_config(steps=2), tensorboard=True).finished
    assert "tensorboard is not installed" in caplog.text


def test_progress_line(tmp_path, capfd):
    run(tmp_path / "x", progress=True)
    text = capfd.readouterr().err
    assert "30/30" in text
    assert "validation score" in text


def test_card(uninterrupted):
    card = json.loads((uninterrupted / "card.json").read_text())
    assert card["config"]["steps"] == 30
    assert card["seed"] == 0
    assert card["sessions"] == [{"command": "python -m train --out whole", "first_step": 0}]
    assert card["versions"]["torch"] == torch.__version__
    assert card["hardware"]["cores"] >= 1
    assert card["hardware"]["cpu"]
    assert card["validation"]["bias"] == "nan"
    assert card["parameters"] == 65 + 33
    assert 0 < card["seconds_to_these_weights"] <= card["seconds"] + 0.1
    text = (uninterrupted / "card.md").read_text()
    assert "python -m train --out whole" in text
    assert yaml.safe_load(text.split("```yaml\n")[1].split("```")[0])["validate_every"] == 7


# Configuration


def test_configuration_round_trip(tmp_path):
    config = TrainConfig(steps=7, clip=float("inf"), prior={"levels": 2, "thresholds": [0.1, 1.0]}, learning_rate=1e-5)
    assert TrainConfig.from_yaml(config.to_yaml()).to_yaml() == config.to_yaml()
    assert TrainConfig.from_yaml(config.to_yaml()) == config
    (tmp_path / "c.yaml").write_text(config.to_yaml())
    assert load_config(tmp_path / "c.yaml") == config
    assert TrainConfig.from_yaml("") == TrainConfig()
    assert TrainConfig.from_yaml("learning_rate: 1e-3").learning_rate == 1e-3
    assert differences(config.as_dict(), replace(config, seed=3).as_dict()) == ["seed"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("stepps: 3", "unknown key 'stepps'"),
        ("prior: {levels: 2, filterz: 3}", r"unknown key 'prior\.filterz'"),
        ("data: {nonsense: 1}", r"unknown key 'data\.nonsense'"),
        ("objective: {nonsense: 1}", r"unknown key 'objective\.nonsense'"),
        ("prior: {filters: 32}", "prior: filters"),
        ("steps: 3.5", "steps must be of type int"),
        ("steps: true", "steps must be of type int"),
        ("steps: 0", "steps must be an integer of at least 1"),
        ("learning_rate: fast", "learning_rate must be a number"),
        ("learning_rate: .nan", "learning_rate must be positive"),
        ("checkpoint_seconds: 121", "checkpoint_seconds must be at most 120"),
        ("ema: 1.0", "ema must be"),
        ("final_fraction: 2", "final_fraction must be"),
        ("prior: 3", "prior must be a mapping"),
        ("- 3", "mapping"),
        ("a: [", "not YAML"),
    ],
)
def test_bad_configurations_name_the_key(text, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        TrainConfig.from_yaml(text)
    (tmp_path / "bad.yaml").write_text(text)
    with pytest.raises(ValueError, match=r"bad\.yaml"):
        load_config(tmp_path / "bad.yaml")


def test_packaged_configurations():
    assert packaged_config("default").steps > packaged_config("quick").steps


# Command line


@pytest.fixture
def main(monkeypatch):
    from train import __main__ as module

    objective = StubObjective()
    monkeypatch.setattr(module, "build", lambda config: (stub_model(config.seed), StubData(), objective))
    module.objective = objective
    return module.main


def test_command_line(tmp_path, main, capsys):
    out = tmp_path / "runs" / "x"
    common = ["--out", str(out), "--no-progress", "--no-tensorboard"]
    start = ["--quick", "--steps", "30", "--seed", "4"]
    main.__globals__["objective"].at = {9: send(signal.SIGTERM)}
    assert main([*start, *common]) == 128 + signal.SIGTERM
    message = capsys.readouterr().out
    assert f"python -m train --out {out} --resume" in message
    assert "stopped at step 11 of 30" in message
    assert main([*start, *common]) == 1
    assert "--resume" in capsys.readouterr().err
    assert main(["--resume", "--seed", "5", *common]) == 1
    assert "seed" in capsys.readouterr().err
    main.__globals__["objective"].at = {}
    assert main(["--resume", *common]) == 0
    assert "weights and card in" in capsys.readouterr().out
    assert json.loads((out / "card.json").read_text())["config"]["seed"] == 4
    weights = out / "weights.safetensors"
    assert main([*start, "--out", str(tmp_path / "y"), "--weights", str(weights), "--no-progress"]) == 0
    assert main([*start, "--out", str(tmp_path / "z"), "--weights", str(out / "card.md")]) == 1
    assert "card.md is damaged or not a safetensors file" in capsys.readouterr().err


def test_second_interrupt_stops_at_once(tmp_path, main, capsys):
    def twice(total):
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)
        return total

    common = ["--out", str(tmp_path / "x"), "--no-progress", "--no-tensorboard"]
    main.__globals__["objective"].at = {9: twice}
    assert main(["--quick", "--steps", "30", *common]) == 130
    assert "stopped at once" in capsys.readouterr().err
    main.__globals__["objective"].at = {}
    assert main(["--resume", *common]) == 0
    main(["--quick", "--steps", "30", "--out", str(tmp_path / "y"), *common[2:]])
    assert_same_run(tmp_path / "x", tmp_path / "y")


def test_command_line_refusals(tmp_path, main, capsys):
    for words in (["--quick", "--config", "x.yaml"], ["--threads", "0"], ["--resume", "--weights", "x"]):
        with pytest.raises(SystemExit):
            main(words)
    (tmp_path / "c.yaml").write_text("stepps: 1")
    assert main(["--config", str(tmp_path / "c.yaml"), "--out", str(tmp_path / "o")]) == 1
    assert "c.yaml: unknown key 'stepps'" in capsys.readouterr().err
    assert main(["--config", str(tmp_path / "none.yaml")]) == 1
    assert main(["--resume", "--out", str(tmp_path / "none")]) == 1
    assert "no checkpoint" in capsys.readouterr().err


def _slow(out):
    run(Path(out), stub_config(checkpoint_seconds=0.05), StubObjective(pause=0.02))


def _gradients(out):
    """One process of two: a gradient, a whole run, and the same run interrupted and resumed."""
    import torch.distributed as distributed

    out = Path(out)
    if "STORE" in os.environ:
        rank = int(os.environ["RANK"])
        distributed.init_process_group("gloo", init_method=os.environ["STORE"], rank=rank, world_size=2)
    else:
        distributed.init_process_group("gloo")
    rank = distributed.get_rank()
    config = stub_config(batch=5)
    vector, values, _ = gradient(config, stub_model(), StubData(), StubObjective(), 4, Group())
    write_tensors(out / f"rank{rank}.safetensors", "gradient", {"gradient": vector}, {"values": values})
    run(out / "whole", config)
    outcome = run(out / "two", config, StubObjective({12: send(signal.SIGTERM)} if rank == 1 else {}))
    assert outcome.step == 14
    assert not outcome.finished
    distributed.barrier()
    assert run(out / "two", config, resume=True).finished
    distributed.destroy_process_group()


def _command(out):
    from train import __main__ as module

    module.build = lambda config: (stub_model(config.seed), StubData(), StubObjective())
    assert module.main(["--quick", "--out", out, "--threads", "1", "--no-tensorboard"]) == 0


if __name__ == "__main__":
    {"slow": _slow, "gradients": _gradients, "command": _command}[sys.argv[1]](sys.argv[2])
