"""A run in one process: its state, and what is done with it: resume, step, validate, save, export
with a record.

The optimiser, the average of the weights and the learning rate count updates: steps less those that
were skipped. The learning rate is a closed form in that number, the other two keep all they know in
tensors, so a checkpoint restores their bits.
"""

from __future__ import annotations

import json
import math
import platform
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import safetensors
import torch
from torch import Tensor, nn
from torch.optim import Adam, Optimizer
from torch.optim.lr_scheduler import LambdaLR
from torch.optim.swa_utils import AveragedModel

from recon.evaluate.report import filled
from recon.mbir.mbir import WEIGHTS_FORMAT
from recon.mbir.weights_io import TensorFileError, digest, write_tensors
from recon.study.study import environment
from torchpcct.files import atomic_write
from train.checkpoint import CheckpointStore
from train.config import OF_THE_END, TrainConfig, differences
from train.data import Data, seed_of
from train.logs import Logs
from train.objective import Objective
from train.processes import Group
from train.soap import Soap

if TYPE_CHECKING:
    from torchpcct.typing import JsonObject

__all__ = ["Run"]


PATIENCE = 20
"""Steps with a loss or gradient that is not finite, in a row, after which a run is given up."""
FREE_TO_CHANGE = {"checkpoint_seconds"}
"""Fields of the configuration that do not change the result, so that a resumed run may have
others."""


class DivergedError(RuntimeError):
    """The loss or its gradient was not finite for too many steps in a row."""


@dataclass
class State:
    """What a checkpoint holds beside the tensors: where the run is.

    Args:
        step: steps done.
        validated: step of the last validation.
        skipped: steps left out since the loss or gradient was not finite; bad: those at the end in
            a row.
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
    best: JsonObject | None = None
    sessions: list[JsonObject] = field(default_factory=list)
    machine: JsonObject = field(default_factory=dict)


def rate_factor(config: TrainConfig, update: int) -> float:
    """Share of the learning rate at an update, counted from 0: linear warm-up, constant, at last a
    cosine.

    It ends with ``final_fraction``.
    """
    if update < config.warmup:
        return (update + 1) / config.warmup
    first = max(config.decay_begins, config.warmup)
    phase = max(update - first, 0) / max(1, config.steps - first)
    return config.final_fraction + (1 - config.final_fraction) * 0.5 * (
        1 + math.cos(math.pi * phase)
    )


def _optimiser(config: TrainConfig, model: nn.Module) -> Optimizer:
    rate = config.learning_rate
    groups = [{"params": model.parameters(), "initial_lr": rate}]
    return (
        Soap(groups, lr=rate)
        if config.optimiser == "soap"
        else Adam(groups, lr=rate, betas=(0.9, 0.99))
    )


def _averaged(model: nn.Module, ema: float) -> AveragedModel:
    """Moving average of parameters and buffers; it starts at the weights of now."""

    @torch.no_grad()
    def mix(
        averages: tuple[Tensor, ...] | list[Tensor],
        fresh: tuple[Tensor, ...] | list[Tensor],
        count: Tensor | int,
    ) -> None:
        if not averages[0].is_floating_point():
            torch._foreach_copy_(averages, fresh)
            return
        torch._foreach_lerp_(averages, fresh, 1 - min(ema, int(count) / (9 + int(count))))

    average = AveragedModel(model, multi_avg_fn=mix, use_buffers=True).requires_grad_(False).eval()
    average.update_parameters(model)
    return average


class Run:
    """State of a run in one process.

    Args:
        config: of the run.
        model: with its starting weights.
        group: processes that share the run; the first one writes.
        out: folder of the run.
    """

    def __init__(self, config: TrainConfig, model: nn.Module, group: Group, out: Path) -> None:
        self.config = config
        self.model = model
        self.group = group
        self.out = out
        self.writes = group.rank == 0
        self.store = CheckpointStore(out)
        self.state = State()
        self.average = _averaged(model, config.ema)
        self.best: dict[str, Tensor] = {}
        self.optimiser = _optimiser(config, model)
        self.logs: Logs | None = None
        self.notes: list[str] = []
        self._begun = self._saved = time.monotonic()
        self._before = 0.0

    def begin(self, resume: bool, command: str) -> None:
        """Prepare the folder, or load the checkpoint.

        Raises:
            FileExistsError, TensorFileError, ValueError: see :func:`train.loop.train`.
        """
        machine = {
            "threads": torch.get_num_threads(),
            "processes": self.group.size,
            "torch": torch.__version__,
        }
        state = self.state
        if resume:
            state = self.state = self._load()
            changed = [k for k, v in machine.items() if state.machine.get(k) != v]
            if changed:
                was = ", ".join(f"{k} {state.machine.get(k)} → {machine[k]}" for k in changed)
                self.notes.append(
                    f"the result will differ in its last digits from an uninterrupted run: {was}"
                )
        elif self.writes:
            self.out.mkdir(parents=True, exist_ok=True)
            if any(path.name != "views" for path in self.out.iterdir()):
                raise FileExistsError(
                    f"{self.out} is not empty: continue the run in it with --resume, or use another"
                )
        if self.writes:
            self.store.clean()
            with atomic_write(self.out / "config.yaml") as part:
                part.write_text(self.config.to_yaml(), encoding="utf-8")
        done = state.step - state.skipped
        self.rate = LambdaLR(
            self.optimiser, lambda update: rate_factor(self.config, update), last_epoch=done - 1
        )
        state.machine = machine
        state.sessions.append({"command": command, "first_step": state.step})
        self._before = state.seconds

    def _load(self) -> State:
        tensors, metadata, warning = self.store.load()
        if warning:
            self.notes.append(warning)
        before = TrainConfig.from_yaml(metadata["config"])
        other = set(differences(self.config.as_dict(), before.as_dict())) - FREE_TO_CHANGE
        reached = metadata["state"]["step"]
        # What comes later has changed nothing yet.
        if reached <= min(self.config.end_begins, before.end_begins):
            other -= {
                "steps",
                "decay",
                "final_fraction",
                "objective.end_from",
                *(f"objective.{name}" for name in OF_THE_END),
            }
        if reached <= min(self.config.late_begins, before.late_begins):
            other = {name for name in other if not name.startswith("late.")}
        if other:
            raise ValueError(
                f"the run in {self.out} has another configuration ({', '.join(sorted(other))}): "
                "resume it unchanged, or start a new run from its weights"
            )
        known: dict[int, dict[str, Tensor]] = {}
        for key, value in _part(tensors, "optimiser").items():
            index, name = key.split(".")
            # Copied to where torch puts tensors: products of those that begin elsewhere have other
            # last digits.
            known.setdefault(int(index), {})[name] = value.clone()
        try:
            self.model.load_state_dict(_part(tensors, "model"))
            self.average.load_state_dict(_part(tensors, "average"))
            self.optimiser.load_state_dict({**self.optimiser.state_dict(), "state": known})
        except (RuntimeError, KeyError, ValueError) as error:
            raise TensorFileError(
                f"the checkpoint in {self.out} belongs to another model: {error}"
            ) from error
        self.best = _part(tensors, "best")
        return State(**metadata["state"])

    def step(self, values: Mapping[str, float]) -> None:
        """One optimisation step with the gradient that :func:`train.processes.gradient` left in the
        model.

        Raises:
            DivergedError: too many steps in a row were skipped.
        """
        state, config = self.state, self.config
        rate = float(self.rate.get_last_lr()[0])
        norm = float(nn.utils.clip_grad_norm_(self.model.parameters(), config.clip))
        if math.isfinite(norm):
            self.optimiser.step()
            self.rate.step()
            self.average.update_parameters(self.model)
            state.bad = 0
        else:
            state.skipped += 1
            state.bad += 1
        state.step += 1
        self._tick()
        row = {
            "seconds": state.seconds,
            "lr": rate,
            "grad_norm": norm,
            "skipped": state.skipped,
            **values,
        }
        if self.logs is not None:
            self.logs.step(
                state.step, row, state.step % config.log_every == 0 or state.step == config.steps
            )
        if state.bad >= PATIENCE:
            raise DivergedError(
                f"the loss or its gradient was not finite in {PATIENCE} steps in a row, up to step "
                f"{state.step}: the weights have not changed since step {state.step - state.bad}; "
                f"try a smaller learning rate than {config.learning_rate:g}"
            )

    def validate(self, held_out: Data, objective: Objective) -> None:
        """Validate the averaged weights, keep them if they are the best, unless that has been
        done at this step."""
        state = self.state
        if state.validated == state.step:
            return
        if not self.writes:
            state.validated = state.step
            return
        # It may take a while: what was trained up to here is safe before it starts.
        if time.monotonic() - self._saved > 1.0:
            self.save()
        torch.manual_seed(seed_of("validation", self.config.seed))
        with torch.no_grad():
            result = objective.validate(self.average.module, held_out)
        score = float(result.score)
        figures = {k: float(v) for k, v in result.figures.items() if k != "score"}
        self._tick()
        better = math.isfinite(score) and (
            state.best is None
            or score > state.best["score"]
            # A part of the loss that comes later may cost some of the score.
            or state.best["step"] <= (self.config.loss_changes or 0) < state.step
        )
        if better:
            state.best = {
                "score": score,
                "step": state.step,
                "seconds": state.seconds,
                "figures": finite(figures),
            }
            self.best = {k: v.clone() for k, v in self.average.module.state_dict().items()}
        if self.logs is not None:
            self.logs.validated(state.step, score, figures, result.pictures)
        state.validated = state.step
        self.save()
        if better:
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
        known = {
            f"{i}.{k}": v
            for i, s in self.optimiser.state_dict()["state"].items()
            for k, v in s.items()
        }
        parts = {
            "model": self.model.state_dict(),
            "average": self.average.state_dict(),
            "best": self.best,
            "optimiser": known,
        }
        tensors = {f"{part}.{k}": v for part, values in parts.items() for k, v in values.items()}
        self.store.save(tensors, {"config": self.config.to_yaml(), "state": vars(self.state)})

    def export(self) -> None:
        """Write the best weights and their card."""
        if self.writes and self.best:
            export(self.out, self.best, self.config, vars(self.state))

    def finish(self) -> None:
        """After the last step or a signal: the card with the final time."""
        self.save()
        self.export()
        if self.logs is not None and self.state.step == self.config.steps and not self.best:
            self.logs.message("no validation gave a finite score: there are no weights to ship")

    def _tick(self) -> None:
        self.state.seconds = self._before + time.monotonic() - self._begun


def _part(tensors: Mapping[str, Tensor], name: str) -> dict[str, Tensor]:
    return {k.split(".", 1)[1]: v for k, v in tensors.items() if k.startswith(f"{name}.")}


def _cpu() -> str:
    """Model of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return (names or [platform.processor() or platform.machine()])[0]


def finite(value: object) -> object:
    """JSON values with the numbers that JSON does not know ('nan', 'inf') as text."""
    if isinstance(value, Mapping):
        return {k: finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value


def export(
    folder: Path, weights: Mapping[str, Tensor], config: TrainConfig, state: JsonObject
) -> None:
    """Write ``weights.safetensors`` (the package's network in float16), ``card.json`` and the same
    as ``training.md``.

    Args:
        folder: existing.
        weights: state of the model.
        config: of the run.
        state: fields of :class:`train.run.State` as of now; ``best`` describes the weights.
    """
    best = state["best"]
    # Half the bytes, and 0.05 % of a weight: no volume changes by a tenth of a HU. Another network
    # is kept as it is.
    foreign = "class" in config.network
    halved = (
        {}
        if foreign
        else {k: w.to(torch.float16) for k, w in weights.items() if k.startswith("network.")}
    )
    stored = {**weights, **halved}
    versions = {**environment(), "safetensors": safetensors.__version__}
    system = f"{platform.system()} {versions.pop('machine')}"
    card = {
        "validation": {"score": best["score"], **best["figures"]},
        "step": best["step"],
        "steps_done": state["step"],
        "steps_skipped": state["skipped"],
        "seconds_to_these_weights": round(best["seconds"], 1),
        "seconds": round(state["seconds"], 1),
        "parameters": sum(w.numel() for w in weights.values()),
        "sha256_of_tensors": digest({k: w.to(weights[k].dtype) for k, w in stored.items()}),
        "seed": config.seed,
        "config": finite(config.as_dict()),
        "sessions": state["sessions"],
        "threads": state["machine"].get("threads"),
        "processes": state["machine"].get("processes"),
        "hardware": {"cpu": _cpu(), "cores": versions.pop("cores"), "system": system},
        "versions": versions,
        "written": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    # Enough to build the model that the weights belong to, without the card.
    header = {
        "network": card["config"]["network"],
        "unroll": config.unroll,
        "step": best["step"],
        "score": best["score"],
        **({"voxel_mm": config.data.voxel_mm} if foreign else {}),
    }
    write_tensors(folder / "weights.safetensors", WEIGHTS_FORMAT, stored, header)
    record = (
        filled(
            Path(__file__).parent / "templates" / "training.md.j2",
            {**card, "yaml": config.to_yaml()},
        )
        + "\n"
    )
    texts = {
        "card.json": json.dumps(card, indent=2, ensure_ascii=False) + "\n",
        "training.md": record,
    }
    for name, text in texts.items():
        with atomic_write(folder / name) as part:
            part.write_text(text, encoding="utf-8")
