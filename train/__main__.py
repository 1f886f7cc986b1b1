"""Command line: ``python -m train``, or ``torchrun --nproc_per_node=N -m train`` for N processes.

The numbers of threads are set before torch and numba are loaded, so this module imports them late.
"""

from __future__ import annotations

import argparse
import logging
import os
import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from train.config import TrainConfig

__all__ = ["build", "main"]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m train",
        description="Train the unrolled reconstruction's prior on scenes that are made as it goes. Interrupt it at any "
        "moment: --resume continues bit for bit. With torchrun --nproc_per_node=N -m train, N processes share a step.",
    )
    parser.add_argument("--config", type=Path, metavar="FILE", help="YAML file (default: train/configs/default.yaml)")
    parser.add_argument("--quick", action="store_true", help="train/configs/quick.yaml: a look at whether it works")
    parser.add_argument(
        "--out", type=Path, default=Path("runs/train"), metavar="PATH", help="folder of the run (default runs/train)"
    )
    parser.add_argument("--resume", action="store_true", help="continue the run in --out")
    parser.add_argument("--steps", type=int, metavar="N", help="optimisation steps, instead of the configuration's")
    parser.add_argument("--seed", type=int, metavar="N", help="seed, instead of the configuration's")
    parser.add_argument("--weights", type=Path, metavar="FILE", help="start from the weights of another run")
    parser.add_argument("--threads", type=int, metavar="N", help="threads per process (default: torch's choice)")
    parser.add_argument("--no-progress", action="store_true", help="no progress line")
    parser.add_argument("--no-tensorboard", action="store_true", help="no TensorBoard events")
    return parser


def build(config: TrainConfig) -> tuple[Any, Any, Any]:
    """Model with its starting weights, data, and objective."""
    import torch

    from recon.mbir.prior import PriorConfig
    from recon.mbir.unrolled import Unrolled
    from train.data import Data
    from train.objective import Objective

    torch.manual_seed(config.seed)
    model = Unrolled(PriorConfig(**config.prior), steps=config.unroll)
    return model, Data(config.data), Objective(config.objective)


def _configure(arguments: argparse.Namespace) -> TrainConfig:
    from train.checkpoint import Store
    from train.config import TrainConfig, load_config, packaged_config

    if arguments.config is not None:
        config = load_config(arguments.config)
    elif arguments.quick:
        config = packaged_config("quick")
    elif arguments.resume:
        config = TrainConfig.from_yaml(Store(arguments.out).load()[1]["config"])
    else:
        config = packaged_config("default")
    changes = {k: v for k, v in (("steps", arguments.steps), ("seed", arguments.seed)) if v is not None}
    return replace(config, **changes)


@contextmanager
def _processes() -> Iterator[None]:
    """The process group that torchrun's environment describes, if any."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield
        return
    import torch.distributed as distributed

    distributed.init_process_group("gloo")
    try:
        yield
    finally:
        distributed.destroy_process_group()


def _run(arguments: argparse.Namespace, command: str) -> int:
    import torch

    from train.loop import train

    if arguments.threads is not None:
        torch.set_num_threads(arguments.threads)
    first = int(os.environ.get("RANK", "0")) == 0
    config = _configure(arguments)
    with _processes():
        model, data, objective = build(config)
        if arguments.weights is not None:
            from train.card import load_weights

            model.load_state_dict(load_weights(arguments.weights)[0])
        outcome = train(
            config,
            model,
            data,
            objective,
            arguments.out,
            resume=arguments.resume,
            command=command,
            progress=first and not arguments.no_progress,
            tensorboard=not arguments.no_tensorboard,
        )
    if not first:
        return 0
    if not outcome.finished:
        print(f"stopped at step {outcome.step} of {config.steps}; continue with: "
              f"python -m train --out {shlex.quote(str(arguments.out))} --resume")  # fmt: skip
        return 128 + outcome.signal if outcome.signal else 1
    skipped = f", {outcome.skipped} steps skipped" if outcome.skipped else ""
    score = "none" if outcome.score is None else f"{outcome.score:.5g}"
    print(f"{outcome.step} steps in {outcome.seconds / 60:.1f} min{skipped}; best validation score {score}; "
          f"weights and card in {arguments.out}")  # fmt: skip
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status (128 + signal after an interruption)."""
    words = list(sys.argv[1:] if argv is None else argv)
    parser = _parser()
    arguments = parser.parse_args(words)
    if arguments.config is not None and arguments.quick:
        parser.error("--config and --quick exclude each other")
    if arguments.weights is not None and arguments.resume:
        parser.error("--weights starts a new run; --resume continues one")
    # Before torch loads: OpenMP threads that wait should sleep, on machines shared with others by far the faster way.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    if arguments.threads is not None:
        if arguments.threads < 1:
            parser.error(f"--threads must be at least 1, got {arguments.threads}")
        os.environ["OMP_NUM_THREADS"] = os.environ["NUMBA_NUM_THREADS"] = str(arguments.threads)
    logging.basicConfig(format="%(message)s")
    logging.getLogger("train").setLevel(logging.INFO)
    from train.checkpoint import CheckpointError
    from train.loop import DivergedError

    try:
        return _run(arguments, shlex.join(["python", "-m", "train", *words]))
    except (ValueError, OSError, CheckpointError, DivergedError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        # The second Ctrl-C, or one before the first step.
        print(f"stopped at once; --resume continues from the last checkpoint in {arguments.out}", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
