"""Command line: ``torchpcct train``, or ``torchrun --nproc_per_node=N -m recon.cli train`` for N
processes.

``python -m train`` does the same where the user has no folder of that name.

The numbers of threads are set before torch and numba are loaded, so this module imports all that
needs them late.
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
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import nn

    from recon.cli.parsing import Parser
    from recon.mbir.unrolled import Unrolled
    from train.config import TrainConfig
    from train.data import Data, InTurn
    from train.objective import Objective


def _parser() -> Parser:
    from recon.cli.parsing import MOST, Parser, add_options

    parser = Parser(
        prog="torchpcct train",
        description="Train the unrolled reconstruction's prior on scenes that are made as it "
        "goes.\n"
        "Interrupt it at any moment: --resume continues bit for bit.",
        epilog="examples:\n  torchpcct train --quick --out runs/first\n  torchpcct train --out "
        "runs/mine --resume\n"
        "N processes share a step with\n  torchrun --nproc_per_node=N -m recon.cli train --out "
        "runs/mine\n",
    )
    many = {"limits": {"high": 10**9}}
    add_options(
        parser,
        (
            "--config",
            Path,
            "FILE",
            "YAML file of what differs from a packaged configuration, its base (default: "
            "train/configs/default.yaml)",
            {"read": True},
        ),
        ("--quick", bool, None, "train/configs/quick.yaml: a look at whether it works"),
        (
            "--out",
            Path,
            "PATH",
            "folder of the run (default runs/train)",
            {"default": Path("runs/train")},
        ),
        ("--resume", bool, None, "continue the run in --out"),
        ("--steps", int, "N", "optimisation steps, instead of the configuration's", many),
        (
            "--seed",
            int,
            "N",
            "seed, instead of the configuration's",
            {"limits": {"low": 0, "high": 2**62}},
        ),
        (
            "--weights",
            Path,
            "FILE",
            "start from the weights of another run, of a network as wide or less",
            {"read": True},
        ),
        (
            "--threads",
            int,
            "N",
            "threads per process (default: torch's choice)",
            {"limits": {"high": MOST}},
        ),
        ("--device", str, "NAME", "where it trains: cpu (default) or cuda", {"default": "cpu"}),
        (
            "--views",
            Path,
            "PATH",
            "folder of what the network sees of the scenes, several GB; runs of one seed and the "
            "same data share it (default: the folder views in --out)",
        ),
        (
            "--painters",
            int,
            "N",
            "processes that make all views beforehand (default: each is made when it is first "
            "used; needed for the speed of a GPU)",
            {"limits": {"high": MOST}},
        ),
        ("--no-progress", bool, None, "no progress line"),
        ("--no-tensorboard", bool, None, "no TensorBoard events"),
    )
    return parser


def build(
    config: TrainConfig, views: Path, device: str = "cpu"
) -> tuple[Unrolled, Data | InTurn, Data, Objective]:
    """Model with its starting weights, data of the training and of the validation, and objective.

    Args:
        config: of the run.
        views: folder of the views.
        device: where it trains.

    A network of a user's own is imported, as the configuration names it.

    Raises:
        ValueError: a device that torch does not have here; a network that cannot be imported or
            trained.
        TypeError: a class that makes no module, or whose modules do not take what a prior is given.
    """
    import torch

    from recon.mbir.network import Network
    from recon.mbir.priors import network_of
    from recon.mbir.unrolled import Unrolled
    from train.data import Data, InTurn, seed_of
    from train.objective import Objective

    try:
        where = torch.zeros((), device=device).device
    except (RuntimeError, AssertionError) as error:
        raise ValueError(
            f"no device {device!r} here: take cpu, or cuda on a machine with a GPU ({error})"
        ) from error
    torch.manual_seed(config.seed)
    named = config.network.get("class")
    network = network_of(config.network, named)
    model = Unrolled(
        network, steps=config.unroll, voxel_mm=None if named is None else config.data.voxel_mm
    )
    if named is not None:
        _require_trainable(named, model, network, config.data.shape)
    model.to(where)
    fast = where.type == "cuda" or torch.ops.mkldnn._is_mkldnn_bf16_supported()
    if isinstance(model.network, Network):
        model.network.half_precision = config.bfloat16 and fast
    first = Data(config.data, config.seed, views, where)
    data: Data | InTurn = first
    if config.late_begins < config.steps:
        late = Data(config.late_data, seed_of("late", config.seed), views, where)
        data = InTurn(first, late, config.late_begins)
    few = replace(config.data, scenes_kept=config.objective.held_out)
    held_out = Data(few, seed_of("held out", config.seed), views, where)
    return model, data, held_out, Objective(config.objective, config.single)


def _require_trainable(
    name: str, model: Unrolled, network: nn.Module, shape: Sequence[int]
) -> None:
    """Refuse a network of a user's own that no training can use, before anything is written
    (ValueError, TypeError)."""
    import torch

    from recon.mbir.priors import same_kind

    if not any(p.requires_grad for p in network.parameters()):
        raise ValueError(f"network {name} has no parameters that a training could change")
    takes = "(estimate, towards, condition, smoothed) as forward of recon.mbir.network.Network does"
    if model.network is not network:
        raise TypeError(f"network {name} is a denoiser: one to be trained takes {takes}")
    volumes = torch.zeros((2, *shape))
    was = network.training
    try:
        with torch.no_grad():
            made = network.eval()(volumes, volumes, torch.zeros((2, 3)), volumes)
    except (RuntimeError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise ValueError(
            f"network {name} must take {takes}, volumes of {tuple(volumes.shape)}: {error}"
        ) from error
    finally:
        network.train(was)
    same_kind(made, volumes, network)


@contextmanager
def _processes() -> Iterator[None]:
    """The process group that torchrun's environment describes, if any."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield
        return
    from torch import distributed

    distributed.init_process_group("gloo")
    try:
        yield
    finally:
        distributed.destroy_process_group()


def _run(arguments: argparse.Namespace, command: str) -> int:
    import torch

    from recon.cli.parsing import find_modules_here
    from recon.mbir.mbir import WEIGHTS_FORMAT
    from recon.mbir.weights_io import read_tensors
    from torchpcct.files import WriteError
    from train.checkpoint import CheckpointStore, start_from
    from train.config import TrainConfig, load_config, packaged_config
    from train.loop import train
    from train.run import DivergedError

    if arguments.threads is not None:
        torch.set_num_threads(arguments.threads)
    first = int(os.environ.get("RANK", "0")) == 0
    try:
        if arguments.config is not None:
            config = load_config(arguments.config)
        elif arguments.resume and not arguments.quick:
            config = TrainConfig.from_yaml(CheckpointStore(arguments.out).load()[1]["config"])
            if "class" in config.network:
                raise ValueError(
                    f"the run in {arguments.out} trains {config.network['class']}, which no file "
                    "alone may import: if you trust it, name its configuration, --config "
                    f"{shlex.quote(str(arguments.out / 'config.yaml'))}"
                )
        else:
            config = packaged_config("quick" if arguments.quick else "default")
        changes = {
            k: v for k, v in (("steps", arguments.steps), ("seed", arguments.seed)) if v is not None
        }
        config = replace(config, **changes)
        if "class" in config.network:
            find_modules_here()
        with _processes():
            views = arguments.views or arguments.out / "views"
            model, data, held_out, objective = build(config, views, arguments.device)
            if arguments.weights is not None:
                start_from(model, read_tensors(arguments.weights, WEIGHTS_FORMAT)[0])
            if arguments.painters is not None:
                held_out.prepare(arguments.painters)
                data.prepare(arguments.painters)
            state, number = train(
                config,
                model,
                data,
                held_out,
                objective,
                arguments.out,
                resume=arguments.resume,
                command=command,
                progress=first and not arguments.no_progress,
                tensorboard=not arguments.no_tensorboard,
            )
    except (DivergedError, WriteError) as error:
        return _failed(str(error), 1)
    except (ValueError, TypeError, OSError, ImportError) as error:
        return _failed(str(error), 2)
    if not first:
        return 0
    if state.step < config.steps:
        out = shlex.quote(str(arguments.out))
        named = f" --config {out}/config.yaml" if "class" in config.network else ""
        again = f"torchpcct train --out {out}{named} --resume"
        print(f"stopped at step {state.step} of {config.steps}; continue with: {again}")
        return 128 + number if number else 1
    skipped = f", {state.skipped} steps skipped" if state.skipped else ""
    score = f"{state.best['score']:.5g}" if state.best else "none"
    print(
        f"{state.step} steps in {state.seconds / 60:.1f} min{skipped}; best validation score "
        f"{score}; weights and card in {arguments.out}"
    )
    return 0


def _failed(text: str, status: int) -> int:
    print(f"torchpcct train: {text}", file=sys.stderr)
    return status


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status: 0 done, 1 diverged or not finished, 2 refused
    input, 128 + signal after an interruption."""
    from recon.cli.parsing import check_limits

    words = list(sys.argv[1:] if argv is None else argv)
    from torchpcct.files import speak_any_encoding

    speak_any_encoding()
    parser = _parser()
    arguments = parser.parse_args(words)
    try:
        check_limits(arguments, parser)
    except (ValueError, OSError) as error:
        return _failed(str(error), 2)
    if arguments.config is not None and arguments.quick:
        parser.error("--config and --quick exclude each other")
    if arguments.weights is not None and arguments.resume:
        parser.error("--weights starts a new run; --resume continues one")
    # Before torch loads: OpenMP threads that wait should sleep, on machines shared with others by
    # far the faster way.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    if arguments.threads is not None:
        os.environ["OMP_NUM_THREADS"] = os.environ["NUMBA_NUM_THREADS"] = str(arguments.threads)
    logging.basicConfig(format="%(message)s")
    logging.getLogger("train").setLevel(logging.INFO)
    try:
        return _run(arguments, shlex.join(["torchpcct", "train", *words]))
    except KeyboardInterrupt:
        # The second Ctrl-C, or one before the first step.
        print(
            f"stopped at once; --resume continues from the last checkpoint in {arguments.out}",
            file=sys.stderr,
        )
        return 130


if __name__ == "__main__":
    sys.exit(main())
