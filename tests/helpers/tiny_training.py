"""A training that takes a blink: six numbers in, one out, with everything a run of
:mod:`train.loop` needs around it.

Run as a script, it is the training that the tests kill, or start as one of several processes.
"""

import csv
import os
import signal
import subprocess
import sys
import time
import weakref
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import distributed, nn

from recon.mbir.mbir import WEIGHTS_FORMAT
from recon.mbir.weights_io import read_tensors, write_tensors
from train import __main__ as command_line
from train.checkpoint import CHECKPOINT_FORMAT
from train.config import TrainConfig
from train.loop import train
from train.processes import Group, gradient

ROOT = Path(__file__).parents[2]
STEPS = 12


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
    def __init__(self, seed=0):
        self.seed = seed

    def batch(self, step, batch, indices):
        seeds = [self.seed + 1000 * step + i for i in indices]
        return torch.stack(
            [torch.randn(7, generator=torch.Generator().manual_seed(seed)) for seed in seeds]
        )


class StubObjective:
    """Squared error of a fixed function; ``at`` maps a number of the step to something to do in
    it."""

    def __init__(self, at=None, pause=0.0):
        self.at = at or {}
        self.pause = pause
        self.validations = 0

    def __call__(self, model, batch, progress):
        time.sleep(self.pause)
        error = (model(batch[:, :6]).squeeze(1) - batch[:, :6].square().sum(1)).square()
        # Draws on the global generator must be reproducible too.
        total = error.sum() * (1 + 1e-3 * torch.rand(()))
        total = self.at.get(round(progress * STEPS), lambda t: t)(total)
        return StubLoss(total, {"square": float(error.detach().sum()), "scenes": float(len(batch))})

    @torch.no_grad()
    def validate(self, model, held_out):
        assert not model.training
        self.validations += 1
        batch = held_out.batch(10**6, 16, range(16))
        error = (model(batch[:, :6]).squeeze(1) - batch[:, :6].square().sum(1)).square().mean()
        picture = np.linspace(-200, 500, 12, dtype=np.float32).reshape(3, 4) + float(error)
        return StubValidation(
            -float(error), {"rms": float(error.sqrt()), "bias": float("nan")}, {"a b": picture}
        )


def stub_model(seed=0):
    torch.manual_seed(seed)
    return nn.Sequential(
        nn.Linear(6, 8), nn.Tanh(), nn.BatchNorm1d(8, momentum=0.1).eval(), nn.Linear(8, 1)
    )


def stub_config(**changes):
    values = dict(
        steps=STEPS, batch=4, warmup=3, ema=0.9, validate_every=5, clip=20.0, learning_rate=0.02
    )
    return TrainConfig(**{**values, **changes})


def run(out, config=None, objective=None, model=None, **options):
    """:func:`train.loop.train` on the stubs: the last state, and the signal that ended it."""
    options = {"tensorboard": False, **options}
    config = config or stub_config()
    data, objective = StubData(config.seed), objective or StubObjective()
    return train(config, model or stub_model(config.seed), data, data, objective, out, **options)


def stub_build(objective):
    """In the place of :func:`train.__main__.build`."""
    return lambda config, views, device: (
        stub_model(config.seed),
        StubData(config.seed),
        StubData(config.seed),
        objective,
    )


def send(*numbers):
    """An action for :class:`StubObjective`: signals to the own process."""

    def action(total):
        for number in numbers:
            os.kill(os.getpid(), number)
        return total

    return action


def rows(path, without=("seconds",)):
    with open(path, newline="") as file:
        return [{k: v for k, v in row.items() if k not in without} for row in csv.DictReader(file)]


def weights_of(out):
    """Tensors and header of the weights that a run ships."""
    return read_tensors(out / "weights.safetensors", WEIGHTS_FORMAT)


def assert_same_run(first, second):
    """Everything but times and command lines is the same, to the bit."""
    a, meta_a = read_tensors(first / "checkpoint.safetensors", CHECKPOINT_FORMAT)
    b, meta_b = read_tensors(second / "checkpoint.safetensors", CHECKPOINT_FORMAT)
    assert {k.split(".")[0] for k in a} == {"model", "average", "best", "optimiser"}
    assert_same_tensors(a, b)
    for meta in (meta_a, meta_b):
        for key in ("seconds", "sessions"):
            meta["state"].pop(key)
        meta["state"]["best"].pop("seconds")
    assert meta_a["state"] == meta_b["state"]
    for name in ("log.csv", "validation.csv"):
        assert rows(first / name) == rows(second / name)
    assert_same_tensors(weights_of(first)[0], weights_of(second)[0])
    names = [sorted(p.name for p in (x / "pictures").iterdir()) for x in (first, second)]
    assert names[0] == names[1]
    for name in names[0]:
        assert (first / "pictures" / name).read_bytes() == (second / "pictures" / name).read_bytes()


def assert_same_tensors(a, b):
    assert a.keys() == b.keys()
    for name in a:
        assert torch.equal(a[name], b[name]), name


def script(*arguments, more=None, **options):
    """A process of this Python, which finds the packages and has as many threads as this one."""
    environment = {
        **os.environ,
        "PYTHONPATH": str(ROOT),
        "OMP_NUM_THREADS": str(torch.get_num_threads()),
    }
    environment.update(more or {})
    return subprocess.Popen(
        [sys.executable, *arguments], env=environment, cwd=ROOT, text=True, **options
    )


def _slow(out):
    run(Path(out), stub_config(checkpoint_seconds=0.1), StubObjective(pause=0.05))


def _gradients(out):
    """One process of two: a gradient, a whole run, the same run interrupted and resumed, and one
    with SOAP, of which every process keeps its own weights."""
    out = Path(out)
    if "STORE" in os.environ:
        rank = int(os.environ["RANK"])
        distributed.init_process_group(
            "gloo", init_method=os.environ["STORE"], rank=rank, world_size=2
        )
    else:
        distributed.init_process_group("gloo")
    rank = distributed.get_rank()
    config, model = stub_config(batch=5), stub_model()
    values, _ = gradient(config, model, StubData(), StubObjective(), 4, Group())
    found = {name: p.grad for name, p in model.named_parameters()}
    write_tensors(out / f"rank{rank}.safetensors", "gradient", found, {"values": values})
    run(out / "whole", config)
    state, _ = run(
        out / "two", config, StubObjective({6: send(signal.SIGTERM)} if rank == 1 else {})
    )
    assert state.step == 8
    distributed.barrier()
    assert run(out / "two", config, resume=True)[0].step == STEPS
    soap = stub_config(batch=5, optimiser="soap")
    run(out / "soap", soap, model=model)
    write_tensors(out / f"soap{rank}.safetensors", "weights", model.state_dict(), {})
    group = weakref.ref(distributed.group.WORLD)
    distributed.destroy_process_group()
    assert group() is None, (
        "held, the group keeps its threads, which abort the process at its exit now and then"
    )


def _command(out):
    command_line.build = stub_build(StubObjective())
    assert command_line.main(["--quick", "--out", out, "--threads", "1", "--no-tensorboard"]) == 0


if __name__ == "__main__":
    {"slow": _slow, "gradients": _gradients, "command": _command}[sys.argv[1]](sys.argv[2])
