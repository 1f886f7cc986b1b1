"""The training loop: deterministic, resumable bit for bit, on one or several processes.

What happens in a step depends on the configuration and the step's number only: the data are a pure function of
``(seed, step, index)``, the learning rate and the averaging of the weights follow the step count, and torch's global
generator is seeded anew before each step and each validation. So a run that is killed and resumed gives the same bits
as one that was not, on the same machine with the same numbers of threads and processes.

With several processes each takes every n-th scene of the batch; gradients are summed and divided by the whole batch.
All then take the same step, so the weights stay equal without being sent. Process 0 alone validates and writes.
"""

from __future__ import annotations

import copy
import hashlib
import logging
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import torch
import yaml
from numpy.typing import NDArray
from torch import Tensor, nn

from train.card import export, finite
from train.checkpoint import CheckpointError, Store
from train.config import TrainConfig, differences
from train.logs import Logs

__all__ = ["Adam", "DivergedError", "Group", "Outcome", "gradient", "learning_rate", "train"]

logger = logging.getLogger(__name__)

PATIENCE = 20
"""Steps with a loss or gradient that is not finite, in a row, after which a run is given up."""
FREE_TO_CHANGE = {"checkpoint_seconds"}
"""Fields of the configuration that do not change the result, so that a resumed run may have others."""


class DivergedError(RuntimeError):
    """The loss or its gradient was not finite for too many steps in a row."""


class Loss(Protocol):
    """Sums over the scenes of a batch."""

    @property
    def total(self) -> Tensor:
        """Differentiable scalar."""

    @property
    def parts(self) -> Mapping[str, float]:
        """Its parts, for the log."""


class Validation(Protocol):
    """Figures of a validation."""

    @property
    def score(self) -> float:
        """What the best weights are chosen by: higher is better."""

    @property
    def figures(self) -> Mapping[str, float]:
        """Anything else worth a column."""

    @property
    def pictures(self) -> Mapping[str, NDArray[Any]]:
        """2-D sections in HU."""


class Data(Protocol):
    """Source of the scenes."""

    def batch(self, seed: int, step: int, indices: Sequence[int]) -> Any:
        """Scenes ``indices`` of a step: a pure function, whichever process asks for them."""


class Objective(Protocol):
    """What is minimised, and what the weights are chosen by."""

    def __call__(self, model: nn.Module, batch: Any, progress: float) -> Loss:
        """Loss of a batch; ``progress`` goes from 0 to 1 over the run."""

    def validate(self, model: nn.Module, data: Any, seed: int) -> Validation:
        """Figures on held-out scenes."""


class Group:
    """The processes of a run: one, or those of an initialised ``torch.distributed`` (gloo)."""

    def __init__(self) -> None:
        import torch.distributed as distributed

        self._distributed: Any = distributed if distributed.is_available() and distributed.is_initialized() else None
        self.rank: int = self._distributed.get_rank() if self._distributed else 0
        self.size: int = self._distributed.get_world_size() if self._distributed else 1

    def sum(self, values: Tensor) -> Tensor:
        """Sum over the processes, in place and the same bits in all."""
        if self._distributed:
            self._distributed.all_reduce(values)
        return values

    def gather(self, values: Mapping[str, float]) -> list[Mapping[str, float]]:
        """The figures of every process, in the order of ranks."""
        if not self._distributed:
            return [values]
        out: list[Any] = [None] * self.size
        self._distributed.all_gather_object(out, dict(values))
        return out


class Adam:
    """Adam on all parameters as one vector (Kingma, Ba 2015, arXiv:1412.6980), β = (0.9, 0.99).

    The vector is what the processes exchange anyhow, and two moments make a checkpoint that needs no pickling.

    Args:
        model: whose parameters it changes, all of one type.
    """

    BETAS = (0.9, 0.99)
    EPSILON = 1e-8

    def __init__(self, model: nn.Module) -> None:
        self.parameters = list(model.parameters())
        size = sum(p.numel() for p in self.parameters)
        like = self.parameters[0].detach()
        self.moments = {"first": like.new_zeros(size), "second": like.new_zeros(size)}
        self.updates = 0

    def load(self, moments: Mapping[str, Tensor], updates: int) -> None:
        """Continue from a checkpoint.

        Raises:
            KeyError, RuntimeError: the moments are missing, or those of another model.
        """
        for name, value in self.moments.items():
            if moments[name].shape != value.shape:
                raise RuntimeError(f"{len(moments[name])} moments for {len(value)} parameters")
            value.copy_(moments[name])
        self.updates = updates

    @torch.no_grad()
    def step(self, gradient: Tensor, rate: float) -> None:
        """One step against ``gradient`` (all parameters, in order) with a learning rate."""
        self.updates += 1
        first, second = self.moments["first"], self.moments["second"]
        first.lerp_(gradient, 1 - self.BETAS[0])
        second.lerp_(gradient.square(), 1 - self.BETAS[1])
        scale = (second / (1 - self.BETAS[1] ** self.updates)).sqrt_().add_(self.EPSILON)
        change = first / scale * (rate / (1 - self.BETAS[0] ** self.updates))
        start = 0
        for p in self.parameters:
            p.sub_(change[start : start + p.numel()].view_as(p))
            start += p.numel()


@dataclass
class State:
    """What a checkpoint holds beside the tensors: where the run is.

    Args:
        step: steps done.
        validated: step of the last validation.
        skipped: steps left out since the loss or gradient was not finite; bad: those at the end in a row.
        seconds: wall time spent, over all sessions.
        best: ``score``, ``step``, ``seconds`` and ``figures`` of the best validation.
        sessions: command line and first step of each start.
        machine: what the same bits need: threads, processes, torch version.
    """

    step: int = 0
    validated: int = 0
    skipped: int = 0
    bad: int = 0
    seconds: float = 0.0
    best: dict[str, Any] | None = None
    sessions: list[dict[str, Any]] = field(default_factory=list)
    machine: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Outcome:
    """How a run ended.

    Args:
        step: steps done.
        finished: whether those are all; else a signal ended it.
        signal: its number, or 0 (also if it came to another process).
        score: of the best validation, or ``None``.
        skipped: steps left out since the loss or gradient was not finite.
        seconds: wall time, over all sessions.
    """

    step: int
    finished: bool
    signal: int
    score: float | None
    skipped: int
    seconds: float


def learning_rate(config: TrainConfig, step: int) -> float:
    """Learning rate of a step, counted from 0: linear warm-up, then a cosine to ``final_fraction``."""
    if step < config.warmup:
        return config.learning_rate * (step + 1) / config.warmup
    phase = (step - config.warmup) / max(1, config.steps - config.warmup)
    return config.learning_rate * (
        config.final_fraction + (1 - config.final_fraction) * 0.5 * (1 + math.cos(math.pi * phase))
    )


def gradient(
    config: TrainConfig,
    model: nn.Module,
    data: Data,
    objective: Objective,
    step: int,
    group: Group,
    stop: bool = False,
) -> tuple[Tensor, dict[str, float], bool]:
    """Gradient of the mean loss over the batch of a step.

    Args:
        step: counted from 0.
        group: processes that share the batch.
        stop: this process wants to stop.

    Returns:
        All gradients as one vector in the order of ``model.parameters()``, not finite if the loss is not; the loss and
        its parts as means over the batch; whether any process wants to stop. Equal in all processes, and equal for any
        number of processes but for the rounding of the sums.
    """
    torch.manual_seed(_seed_of("step", config.seed, step))
    parameters = list(model.parameters())
    for p in parameters:
        p.grad = None
    batch = data.batch(config.seed, step, range(group.rank, config.batch, group.size))
    loss = objective(model, batch, step / config.steps)
    loss.total.backward()
    pieces = [(torch.zeros_like(p) if p.grad is None else p.grad).reshape(-1) for p in parameters]
    total = loss.total.detach().reshape(1).to(pieces[0])
    # One message: the gradient, the loss (for whether it is finite), and the wish to stop, on which all must agree.
    flat = group.sum(torch.cat([*pieces, total, total.new_tensor([float(stop)])]))
    vector = flat[:-2] / config.batch
    if not torch.isfinite(flat[-2]):
        vector = torch.full_like(vector, math.nan)
    values: dict[str, float] = {}
    for part in group.gather({"loss": float(loss.total.detach()), **loss.parts}):
        for name, value in part.items():
            values[name] = values.get(name, 0.0) + float(value) / config.batch
    return vector, values, bool(flat[-1] > 0)


def train(
    config: TrainConfig,
    model: nn.Module,
    data: Data,
    objective: Objective,
    out: Path,
    *,
    resume: bool = False,
    command: str = "",
    progress: bool = False,
    tensorboard: bool = True,
) -> Outcome:
    """Train, from the start or from the checkpoint in ``out``, until the last step or a SIGTERM or SIGINT.

    Args:
        config: of the run; a resumed one must have the same, but for ``checkpoint_seconds``.
        model: with its starting weights; it ends with the last ones, not the averaged ones.
        data, objective: see :class:`Data`, :class:`Objective`.
        out: folder of the run, made if missing. It gets ``checkpoint*.safetensors``, ``config.yaml``, ``log.csv``,
            ``validation.csv``, ``pictures``, ``tensorboard``, and the best weights with their card as
            ``weights.safetensors``, ``card.json``, ``card.md``.
        resume: continue from the checkpoint.
        command: command line, for the card.
        progress: show a progress line.
        tensorboard: write events.

    Raises:
        FileExistsError: ``out`` is not empty, and ``resume`` is false.
        CheckpointError: no whole checkpoint to resume from, or it belongs to another model.
        ValueError: the configuration is not the checkpoint's, or there are more processes than scenes in a batch.
        DivergedError: loss or gradient not finite for 20 steps in a row.
    """
    group = Group()
    if group.size > config.batch:
        raise ValueError(f"batch ({config.batch}) must be at least the number of processes ({group.size})")
    run = _Run(config, model, group, Path(out))
    run.begin(resume, command)
    with _logs(run, progress, tensorboard) as logs, _signals(group.size == 1) as caught:
        run.logs = logs
        for text in run.notes:
            run.message(text)
        run.save()
        stop = False
        while True:
            state = run.state
            last = state.step == config.steps
            if not stop and state.step and (last or state.step % config.validate_every == 0):
                run.validate(data, objective)
            if last or stop:
                break
            vector, values, stop = gradient(config, model, data, objective, state.step, group, bool(caught))
            run.step(vector, values)
            if stop or run.due():
                run.save()
        run.finish()
    best = run.state.best
    return Outcome(
        step=run.state.step,
        finished=run.state.step == config.steps,
        signal=caught[0] if caught else 0,
        score=best["score"] if best else None,
        skipped=run.state.skipped,
        seconds=run.state.seconds,
    )


class _Run:
    """State of a run in one process."""

    def __init__(self, config: TrainConfig, model: nn.Module, group: Group, out: Path) -> None:
        self.config = config
        self.model = model
        self.group = group
        self.out = out
        self.writes = group.rank == 0
        self.store = Store(out)
        self.state = State()
        self.average = copy.deepcopy(model).requires_grad_(False).eval()
        self.best: dict[str, Tensor] | None = None
        self.adam = Adam(model)
        self.logs: Logs | None = None
        self.notes: list[str] = []
        self._begun = self._saved = time.monotonic()
        self._before = 0.0

    def begin(self, resume: bool, command: str) -> None:
        """Prepare the folder, or load the checkpoint."""
        machine = {
            "threads": torch.get_num_threads(),
            "processes": self.group.size,
            "torch": torch.__version__,
        }
        if resume:
            self._load()
            changed = [k for k, v in machine.items() if self.state.machine.get(k) != v]
            if changed:
                was = ", ".join(f"{k} {self.state.machine.get(k)} → {machine[k]}" for k in changed)
                self.notes.append(f"the result will differ in its last digits from an uninterrupted run: {was}")
        elif self.writes:
            self.out.mkdir(parents=True, exist_ok=True)
            if any(self.out.iterdir()):
                raise FileExistsError(f"{self.out} is not empty: continue the run in it with --resume, or use another")
        if self.writes:
            self.store.clean()
            (self.out / "config.yaml").write_text(self.config.to_yaml(), encoding="utf-8")
        self.state.machine = machine
        self.state.sessions.append({"command": command, "first_step": self.state.step})
        self._before = self.state.seconds

    def _load(self) -> None:
        tensors, metadata, warning = self.store.load()
        if warning:
            self.notes.append(warning)
        other = set(differences(self.config.as_dict(), yaml.safe_load(metadata["config"]))) - FREE_TO_CHANGE
        if other:
            raise ValueError(
                f"the run in {self.out} has another configuration ({', '.join(sorted(other))}): resume it unchanged, "
                "or start a new run from its weights"
            )
        self.state = State(**metadata["state"])
        try:
            self.model.load_state_dict(_group(tensors, "model"))
            self.average.load_state_dict(_group(tensors, "average"))
            self.best = _group(tensors, "best") or None
            self.adam.load(_group(tensors, "adam"), self.state.step - self.state.skipped)
        except (RuntimeError, KeyError, ValueError) as error:
            raise CheckpointError(f"the checkpoint in {self.out} belongs to another model: {error}") from error

    def step(self, vector: Tensor, values: dict[str, float]) -> None:
        """One optimisation step with a gradient of :func:`gradient`.

        Raises:
            DivergedError: too many steps in a row were skipped.
        """
        state, config = self.state, self.config
        rate = learning_rate(config, state.step)
        norm = float(torch.linalg.vector_norm(vector))
        if math.isfinite(norm):
            if norm > config.clip:
                vector = vector * (config.clip / norm)
            self.adam.step(vector, rate)
            self._average()
            state.bad = 0
        else:
            state.skipped += 1
            state.bad += 1
        state.step += 1
        self._tick()
        row = {"seconds": state.seconds, "lr": rate, "grad_norm": norm, "skipped": state.skipped, **values}
        if self.logs is not None:
            self.logs.step(state.step, row, state.step % config.log_every == 0 or state.step == config.steps)
        if state.bad >= PATIENCE:
            raise DivergedError(
                f"the loss or its gradient was not finite in {PATIENCE} steps in a row, up to step {state.step}: "
                f"the weights have not changed since step {state.step - state.bad}; try a smaller learning rate than "
                f"{config.learning_rate:g}"
            )

    def _average(self) -> None:
        decay = min(self.config.ema, (1 + self.state.step) / (10 + self.state.step))
        fresh = self.model.state_dict()
        with torch.no_grad():
            for name, value in self.average.state_dict().items():
                if value.is_floating_point():
                    value.lerp_(fresh[name], 1 - decay)
                else:
                    value.copy_(fresh[name])

    def validate(self, data: Data, objective: Objective) -> None:
        """Validate the averaged weights, keep them if they are the best, unless that has been done at this step."""
        state = self.state
        if state.validated == state.step:
            return
        if not self.writes:
            state.validated = state.step
            return
        # It may take a while: what was trained up to here is safe before it starts.
        if state.step and time.monotonic() - self._saved > 1.0:
            self.save()
        torch.manual_seed(_seed_of("validation", self.config.seed, 0))
        with torch.no_grad():
            result = objective.validate(self.average, data, self.config.seed)
        score = float(result.score)
        figures = {k: float(v) for k, v in result.figures.items() if k != "score"}
        self._tick()
        if math.isfinite(score) and (state.best is None or score > state.best["score"]):
            state.best = {"score": score, "step": state.step, "seconds": state.seconds, "figures": finite(figures)}
            self.best = {k: v.detach().clone() for k, v in self.average.state_dict().items()}
        if self.logs is not None:
            self.logs.validated(state.step, score, figures, result.pictures)
        state.validated = state.step
        self.save()
        if state.best is not None and state.best["step"] == state.step:
            self.export()

    def due(self) -> bool:
        """Whether it is time for a checkpoint."""
        return self.writes and time.monotonic() - self._saved >= self.config.checkpoint_seconds

    def save(self) -> None:
        """Write a checkpoint."""
        self._saved = time.monotonic()
        if not self.writes:
            return
        if self.logs is not None:
            self.logs.sync()
        self._tick()
        tensors = {f"model.{k}": v for k, v in self.model.state_dict().items()}
        tensors |= {f"average.{k}": v for k, v in self.average.state_dict().items()}
        tensors |= {f"best.{k}": v for k, v in (self.best or {}).items()}
        tensors |= {f"adam.{k}": v for k, v in self.adam.moments.items()}
        self.store.save(tensors, {"config": self.config.to_yaml(), "state": vars(self.state)})

    def export(self) -> None:
        """Write the best weights and their card."""
        if self.writes and self.best is not None:
            export(self.out, self.best, self.config, vars(self.state))

    def finish(self) -> None:
        """After the last step or a signal: the card with the final time."""
        self.save()
        self.export()
        if self.writes and self.state.step == self.config.steps and self.best is None:
            self.message("no validation gave a finite score: there are no weights to ship")

    def message(self, text: str) -> None:
        """Tell the user."""
        if self.logs is not None:
            self.logs.message(text)
        elif self.writes:
            logger.warning(text)

    def _tick(self) -> None:
        self.state.seconds = self._before + time.monotonic() - self._begun


def _group(tensors: Mapping[str, Tensor], name: str) -> dict[str, Tensor]:
    return {k.split(".", 1)[1]: v for k, v in tensors.items() if k.startswith(f"{name}.")}


def _seed_of(*key: Any) -> int:
    return int.from_bytes(hashlib.sha256(repr(key).encode()).digest()[:7], "big")


@contextmanager
def _logs(run: _Run, progress: bool, tensorboard: bool) -> Iterator[Logs | None]:
    """Logs of the process that writes."""
    if not run.writes:
        yield None
        return
    logs = Logs(run.out, run.state.step, run.config.steps, progress, tensorboard, run.state.validated)
    try:
        yield logs
    finally:
        logs.close()


@contextmanager
def _signals(alone: bool) -> Iterator[list[int]]:
    """SIGTERM and SIGINT are collected in a list instead of ending the process; a second SIGINT ends it.

    Args:
        alone: one process. Several get the signal from the terminal and once more from their launcher: then a second
            one means nothing.
    """
    caught: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield caught
        return

    def handle(number: int, _frame: Any) -> None:
        if caught and alone and number == signal.SIGINT:
            raise KeyboardInterrupt
        caught.append(number)

    before: dict[int, Callable[..., Any] | int | None] = {}
    try:
        for which in (signal.SIGTERM, signal.SIGINT):
            before[which] = signal.signal(which, handle)
        yield caught
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
