"""The first commands of a newcomer: ``demo``, ``doctor``, ``train``."""

from __future__ import annotations

import argparse
import importlib
import shlex
import sys
import time
from collections.abc import Callable
from importlib import util
from importlib.machinery import PathFinder
from pathlib import Path
from typing import TYPE_CHECKING

# What loads torch or numba is imported by the commands: help and refusals come at once.
from recon.cli.parsing import FORCE, Commands, add_options, examples
from torchpcct.files import require_writable

if TYPE_CHECKING:
    from recon.study.study import ProgressBars


_DEMO_VIEWS = 984
"""Views of the demonstration's scan: half of the scanner's."""


# --- demo -----------------------------------------------------------------------------------------


def demo_steps(arguments: argparse.Namespace, run: Callable[[list[str]], int]) -> int:
    """The demonstration: each command is printed and then run, as if it had been typed.

    Args:
        arguments: of ``demo``.
        run: a command line, gives its exit status.

    Returns:
        The first exit status that is not 0, or 0.
    """
    folder: Path = arguments.out
    try:
        require_writable(folder)
    except OSError as error:
        print(f"torchpcct demo: {error}", file=sys.stderr)
        return 2
    scan, fbp, mbir, page = (
        str(folder / n) for n in ("scan.h5", "fbp.nii.gz", "mbir.nii.gz", "view.html")
    )
    steps = (
        (
            f"the paper's plaque scan, {_DEMO_VIEWS} views, 2 s of exposure",
            ["simulate", "--exposure", "2", "--views", str(_DEMO_VIEWS), "--out", scan],
        ),
        (
            "filtered backprojection",
            ["reconstruct", scan, "--method", "fbp", "--kernel", "soft", "--out", fbp],
        ),
        ("model-based reconstruction", ["reconstruct", scan, "--method", "mbir", "--out", mbir]),
        (
            "both in one page",
            ["view", fbp, mbir, "--level", "150", "--window", "600", "--html", page],
        ),
    )
    start = time.perf_counter()
    for what, words in steps:
        words += ["--force"] * arguments.force
        print(f"# {what}\n$ {shlex.join(['torchpcct', *words])}", flush=True)
        if status := run(words):
            return status
        print(flush=True)
    print(
        f"{time.perf_counter() - start:.0f} s in all. Open {page} in a browser: the paper looks "
        "for the dark core "
        "beside the bright lumen.\nThe lines after $ do the same when you type them. What MBIR "
        "saves: torchpcct compare"
    )
    return 0


def add_demo(commands: Commands) -> None:
    parser = commands.add_parser(
        "demo",
        help="simulate a plaque scan, reconstruct it twice, look at it in the browser: 1 min",
        description="Simulate the paper's plaque scan, reconstruct it by FBP and MBIR, write a "
        "page that shows both, "
        "and print the commands that do this. Half a minute on two cores; the first time kernels "
        "are compiled, too.",
    )
    examples(parser, "torchpcct demo --out first_look")
    folder = {"default": Path("out/demo")}
    add_options(
        parser, ("--out", Path, "FOLDER", "for the files (default out/demo)", folder), FORCE
    )


# --- train ----------------------------------------------------------------------------------------


def train(words: list[str]) -> int:
    """Run the training that was installed with this package, whatever folders ``train`` the user
    has.

    By its path and not by an import statement: the training stands above this package.

    Args:
        words: its command line.

    Returns:
        Its exit status; 2 where this installation has none.
    """
    root = str(Path(__file__).parents[2])
    spec = PathFinder.find_spec("train", [root])
    if spec is None or spec.loader is None or not (Path(root) / "train" / "__main__.py").exists():
        print(f"torchpcct train: {root} holds no train/: install torchpcct again", file=sys.stderr)
        return 2
    if getattr(sys.modules.get("train"), "__file__", None) != spec.origin:
        for name in [n for n in sys.modules if n.split(".")[0] == "train"]:
            del sys.modules[name]
        sys.modules["train"] = package = util.module_from_spec(spec)
        spec.loader.exec_module(package)
    status: int = importlib.import_module("train.__main__").main(words)
    return status


def add_train(commands: Commands) -> None:
    """For the list of commands alone: ``train`` reads its own options."""
    commands.add_parser(
        "train", help="train the learned prior of MBIR (extra train)", add_help=False
    )


# --- doctor ---------------------------------------------------------------------------------------


def _doctor(arguments: argparse.Namespace, progress: ProgressBars) -> int:
    from recon.cli.doctor import outcomes  # loads all that it looks at

    broken = 0
    for name, well, text in outcomes():
        broken += not well
        print(f"{'ok    ' if well else 'BROKEN'}  {name:<13} {text}", flush=True)
    print(
        "all is well"
        if not broken
        else f"{broken} broken; each line says what to do; paste this into an issue"
    )
    return int(broken > 0)


def add_doctor(commands: Commands) -> None:
    parser = commands.add_parser(
        "doctor",
        help="check the installation and a few computations: seconds",
        description="Print versions, processor, GPU, threads and the folder of compiled kernels, "
        "check the shipped "
        "weights, test the projector's adjoint, and reconstruct a disc of known value: for an "
        "issue. Exit status 1 if "
        "something is broken, with its remedy.",
    )
    examples(parser, "torchpcct doctor > doctor.txt")
    parser.set_defaults(run=_doctor, device="cpu", no_progress=True, verbose=False)
