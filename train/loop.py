"""The training loop: deterministic, resumable bit for bit, on one or several processes.

What happens in a step depends on the configuration and the step's number only: the data are a pure
function of ``(seed, step, index)``, the learning rate and the averaging of the weights follow the
count of updates, and torch's global generator is seeded anew before each step and each validation.
So a run that is killed and resumed gives the same bits as one that was not, on the same machine
with the same numbers of threads and processes.

Several processes share the scenes of a batch (:mod:`train.processes`). Process 0 alone validates
and writes.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from torch import nn

from torchpcct.files import alone
from train.config import TrainConfig
from train.data import Data, InTurn
from train.logs import Logs
from train.objective import Objective
from train.processes import Group, gradient
from train.run import Run, State

if TYPE_CHECKING:
    from types import FrameType


def train(
    config: TrainConfig,
    model: nn.Module,
    data: Data | InTurn,
    held_out: Data,
    objective: Objective,
    out: Path,
    *,
    resume: bool = False,
    command: str = "",
    progress: bool = False,
    tensorboard: bool = True,
) -> tuple[State, int]:
    """Train, from the start or from the checkpoint in ``out``, until the last step or a SIGTERM or
    SIGINT.

    Args:
        config: of the run; a resumed one must have the same, but for ``checkpoint_seconds``.
        model: with its starting weights; it ends with the last ones, not the averaged ones.
        data: source of the scenes; ``batch`` must be a pure function of its arguments.
        held_out: scenes of the validation.
        objective: what is minimised, and what the weights are chosen by.
        out: folder of the run, made if missing. It gets ``checkpoint*.safetensors``,
            ``config.yaml``, ``log.csv``, ``validation.csv``, ``pictures``, ``tensorboard``, and the
            best weights with their card as ``weights.safetensors``, ``card.json``, ``training.md``.
        resume: continue from the checkpoint.
        command: command line, for the card.
        progress: show a progress line.
        tensorboard: write events.

    Returns:
        Where the run is at the end, and the number of the signal that ended it: 0 if there was
        none, or if it came to another process.

    Raises:
        FileExistsError: ``out`` is not empty, and ``resume`` is false.
        FolderInUseError: another process trains in ``out``.
        TensorFileError: no whole checkpoint to resume from, or it belongs to another model.
        ValueError: the configuration is not the checkpoint's, or there are more processes than
            scenes in a batch.
        DivergedError: loss or gradient not finite for 20 steps in a row.
    """
    group = Group()
    if group.size > config.batch:
        raise ValueError(
            f"batch ({config.batch}) must be at least the number of processes ({group.size})"
        )
    run = Run(config, model, group, Path(out))
    if run.writes and not resume:
        run.out.mkdir(parents=True, exist_ok=True)
    with alone(run.out) if run.writes else nullcontext():
        run.begin(resume, command)
        return _trained(run, data, held_out, objective, progress, tensorboard)


def _trained(
    run: Run,
    data: Data | InTurn,
    held_out: Data,
    objective: Objective,
    progress: bool,
    tensorboard: bool,
) -> tuple[State, int]:
    """The steps of a run that has begun; see :func:`train`."""
    config, model, group, state = run.config, run.model, run.group, run.state
    with _logs(run, progress, tensorboard), _signals(group.size == 1) as caught:
        run.save()
        stop = False
        while True:
            last = state.step == config.steps
            if not stop and state.step and (last or state.step % config.validate_every == 0):
                run.validate(held_out, objective)
            if last or stop:
                break
            values, stop = gradient(config, model, data, objective, state.step, group, bool(caught))
            run.step(values)
            if stop or run.due():
                run.save()
        run.finish()
    return state, caught[0] if caught else 0


@contextmanager
def _logs(run: Run, progress: bool, tensorboard: bool) -> Iterator[None]:
    """Logs of the process that writes."""
    if not run.writes:
        yield
        return
    run.logs = Logs(
        run.out, run.state.step, run.config.steps, progress, tensorboard, run.state.validated
    )
    try:
        for text in run.notes:
            run.logs.message(text)
        yield
    finally:
        run.logs.close()


@contextmanager
def _signals(alone: bool) -> Iterator[list[int]]:
    """SIGTERM and SIGINT are collected in a list instead of ending the process; a second SIGINT
    ends it.

    Args:
        alone: one process. Several get the signal from the terminal and once more from their
            launcher: then a second one means nothing.
    """
    caught: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield caught
        return

    def handle(number: int, _frame: FrameType | None) -> None:
        if caught and alone and number == signal.SIGINT:
            raise KeyboardInterrupt
        caught.append(number)

    before: dict[int, Callable[..., object] | int | None] = {}
    try:
        for which in (signal.SIGTERM, signal.SIGINT):
            before[which] = signal.signal(which, handle)
        yield caught
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
