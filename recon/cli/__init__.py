"""Command line: ``torchpcct`` alone says where to begin.

:mod:`~recon.cli.start` has the first commands of a newcomer; :mod:`~recon.cli.simulate` makes
scans, :mod:`~recon.cli.reconstruct` volumes of them, :mod:`~recon.cli.calibrate` their geometry;
:mod:`~recon.cli.evaluate` and :mod:`~recon.cli.recovery` measure methods, :mod:`~recon.cli.studies`
runs the studies; :mod:`~recon.cli.view` shows files, :mod:`~recon.cli.plaque` reads tissues.
:mod:`~recon.cli.scan_options` are the options of every scan that is read, :mod:`~recon.cli.parsing`
is what all commands share; :mod:`~torchpcct.acquisition.config` reads the configuration of
``simulate``.
"""

from __future__ import annotations

import argparse
import itertools
import shutil
import sys
import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

# What loads torch or numba is imported by the commands: help and refusals come at once.
from recon.cli.calibrate import add_calibrate
from recon.cli.evaluate import add_dose_factor, add_evaluate, add_show_task
from recon.cli.parsing import (
    Commands,
    Ended,
    Parser,
    as_options,
    check_limits,
    ending_by_signals,
    is_path,
    showing_messages,
)
from recon.cli.plaque import add_plaque
from recon.cli.reconstruct import add_reconstruct
from recon.cli.recovery import add_recovery
from recon.cli.simulate import add_lower_dose, add_show_config, add_simulate
from recon.cli.start import add_demo, add_doctor, add_train, demo_steps, train
from recon.cli.studies import add_compare, add_hardcases, add_study, add_verify
from recon.cli.view import add_info, add_view
from torchpcct import __version__
from torchpcct.files import WriteError, speak_any_encoding

if TYPE_CHECKING:
    from recon.study.study import ProgressBars


_GROUPS = {
    "begin": (add_demo, add_doctor),
    "simulate and reconstruct": (
        add_simulate,
        add_show_config,
        add_reconstruct,
        add_calibrate,
        add_lower_dose,
        add_train,
    ),
    "look": (add_view, add_info),
    "measure": (add_evaluate, add_recovery, add_show_task, add_plaque),
    "studies": (add_compare, add_dose_factor, add_hardcases, add_study, add_verify),
}
"""Commands as the help lists them."""
_BEGIN = """\
torchpcct {version}: simulate a photon-counting CT scan, reconstruct it,
measure how much dose a method really saves.

A first look, 1 min      torchpcct demo
Does all work here?      torchpcct doctor
Your own scan            torchpcct info scan.h5
                         torchpcct reconstruct scan.h5 --find-axis --out volume.nii.gz
Look at volumes          torchpcct view a.nii.gz b.nii.gz --html view.html
The main result, 8 min   torchpcct compare --workers 2
Your own method          torchpcct evaluate --task nodule --method mylab.nets:reconstruct

{groups}

torchpcct --help says what each command does; torchpcct COMMAND --help has its options and examples.
"""
"""What ``torchpcct`` alone prints."""


def _parser() -> tuple[Parser, Commands, str]:
    """Parser, its commands, and what ``torchpcct`` alone says."""
    parser = Parser(
        prog="torchpcct",
        description="Photon-counting CT: simulate, reconstruct, and measure what model-based "
        "reconstruction saves.",
        epilog="commands and options by Tab, in bash:\n"
        "  torchpcct --print-completion bash > "
        "~/.local/share/bash-completion/completions/torchpcct\n",
    )
    parser.add_argument("--version", action="version", version=f"torchpcct {__version__}")
    parser.add_argument(
        "--print-completion",
        action=_Completion,
        choices=("bash", "zsh", "tcsh"),
        metavar="SHELL",
        help="print the completion of bash, zsh or tcsh (needs the extra completion)",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    groups, listing, width = [], [], shutil.get_terminal_size().columns - 2
    for title, adders in _GROUPS.items():
        first = len(commands.choices)
        for add in adders:
            add(commands)
        added = commands._choices_actions[first:]
        groups.append(f"{title + ':':<25} {', '.join(a.dest for a in added)}")
        rows = (
            textwrap.wrap(f"  {a.dest:<12} {a.help}", width, subsequent_indent=" " * 15)
            for a in added
        )
        listing += [f"{title}:", *itertools.chain(*rows), ""]
    parser.listing = "\n".join(listing)
    return parser, commands, _BEGIN.format(version=__version__, groups="\n".join(groups))


class _Completion(argparse.Action):
    """Print the completion of a shell, and end."""

    def __call__(
        self,
        parser: Any,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        try:
            import shtab
        except ImportError:
            parser.error("--print-completion needs shtab: pip install 'torchpcct[completion]'")
        for sub in next(a for a in parser._actions if a.dest == "command").choices.values():
            for action in sub._actions:
                if is_path(action):
                    action.complete = shtab.FILE
        print(shtab.complete(parser, values))
        parser.exit()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit status: 0 done, 1 not written (a full disk) or, of
    ``doctor``, something is broken, 2 refused input, 130 interrupted, 128 + N ended by signal N.
    Without a command it says where to begin, which is no error."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    speak_any_encoding()
    if words[:1] == ["train"]:
        return train(words[1:])
    parser, commands, begin = _parser()
    if not words:
        print(begin, end="")
        return 0
    options, rest = parser.parse_known_args(words)
    if rest:
        commands.choices[options.command].error(f"unrecognized arguments: {' '.join(rest)}")
    if options.command == "demo":
        return demo_steps(options, main)
    options.command_line = words
    chosen = commands.choices[options.command]
    with showing_messages(chosen._actions, options.verbose) as options.warn, ending_by_signals():
        return _run(options, chosen)


def _run(options: argparse.Namespace, parser: Parser) -> int:
    progress: ProgressBars | None = None
    try:
        check_limits(options, parser)
        from recon.study.study import ProgressBars

        progress = ProgressBars(not options.no_progress and sys.stderr.isatty())
        if options.device != "cpu" and options.command != "reconstruct":
            raise ValueError(
                f"--device {options.device}: reconstruct computes on a GPU, {options.command} "
                "does not; use --device cpu"
            )
        if options.device == "cuda" and not _cuda():
            raise ValueError("--device cuda: PyTorch finds no CUDA device here; use --device cpu")
        return options.run(options, progress) or 0
    except WriteError as error:
        return _failed(options.command, progress, str(error), 1)
    except (ValueError, TypeError, OSError, ImportError, OverflowError, MemoryError) as error:
        text = (
            as_options(str(error), parser._actions)
            or "out of memory: use larger voxels or a smaller grid"
        )
        return _failed(options.command, progress, text, 2)
    except RuntimeError as error:
        if type(error).__name__ == "LeftOut":
            return _failed(options.command, progress, str(error), 1)
        if "no locator available" not in str(error):
            raise
        text = (
            "numba cannot keep compiled kernels: set NUMBA_CACHE_DIR to a folder that you can write"
        )
        return _failed(options.command, progress, text, 2)
    except Ended as error:
        return _failed(
            options.command, progress, f"{error}, nothing half written", 128 + error.number
        )
    except KeyboardInterrupt:
        return _failed(options.command, progress, "interrupted, nothing half written", 130)


def _cuda() -> bool:
    import torch

    return torch.cuda.is_available()


def _failed(command: str, progress: ProgressBars | None, text: str, status: int) -> int:
    if progress is not None:
        progress.close()
    print(f"torchpcct {command}: {text}", file=sys.stderr)
    return status
