"""Command line: ``torchpcct`` alone says where to begin.

Here stand the studies and :func:`main`; :mod:`~recon.cli.starting` has the first commands of a newcomer,
:mod:`~recon.cli.scans` those that make scans and volumes, :mod:`~recon.cli.evaluating` the measurement of methods,
:mod:`~recon.cli.looking` what shows files, :mod:`~recon.cli.plaque` reads tissues,
:mod:`~torchpcct.acquisition.config` reads what ``simulate`` is told, :mod:`~recon.cli.parsing` is what all share.
"""

from __future__ import annotations

import argparse
import itertools
import json
import shlex
import shutil
import sys
import textwrap
import time
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from recon.cli.evaluating import add_dose_factor, add_evaluate, add_show_task
from recon.cli.looking import add_info, add_view
from recon.cli.parsing import (
    Commands,
    Parser,
    add_execution,
    as_options,
    check_results,
    command,
    examples,
    executing,
    saying,
)

# What loads torch or numba is imported by the commands: help and refusals come at once.
from recon.cli.plaque import add_plaque
from recon.cli.scans import add_lower_dose, add_reconstruct, add_show_config, add_simulate
from recon.cli.starting import add_demo, add_doctor, add_train, demo_steps, train
from recon.study import registry
from torchpcct import __version__
from torchpcct.files import WriteError, atomic_write, require_writable
from torchpcct.validate import whole

if TYPE_CHECKING:
    from recon.study.study import ProgressBars

__all__ = ["main"]


# --- commands -----------------------------------------------------------------------------------------------------


def _run_study(name: str, settings: Any, arguments: argparse.Namespace, progress: ProgressBars) -> None:
    """Run a study of the registry, save and print its report."""
    if hasattr(settings, "seed"):
        whole("--seed", settings.seed, low=0)
    folder = arguments.out or Path("out") / name
    require_writable(folder)
    names = (name, registry.folder(name).replace("_", "-"))
    check_results(arguments, folder, lambda report: report.get("study") in names, "report.*", "*.png")
    minutes = {part: seconds / 60 for part, seconds in settings.estimated_seconds().items()}
    if minutes:
        listed = ", ".join(f"{part} {value:.1f}" for part, value in minutes.items())
        total = f"about {sum(minutes.values()):.0f} min on two idle cores if nothing is finished yet"
        print(f"{total} ({listed})", file=sys.stderr)
    from recon.evaluate.store import Pieces  # loads torch

    start = time.perf_counter()
    report = None
    with executing(arguments, folder):
        report = registry.run(name, settings, progress, folder)
    progress.close()
    if report is None:
        return
    if "command" in report.data:
        report.made_by(shlex.join(["torchpcct", *arguments.command_line]))
    files = report.save(folder)
    Pieces.clear(folder)
    print(report.screen or report.text)
    print(f"\n{time.perf_counter() - start:.0f} s in all. Written: {', '.join(map(str, files))}")


def _study(arguments: argparse.Namespace, progress: ProgressBars) -> None:
    name, changes = arguments.name, arguments.changes
    settings = registry.build_settings(name, quick=arguments.quick, seed=arguments.seed, changes=changes)
    _run_study(name, settings, arguments, progress)


def _own_study(arguments: argparse.Namespace, progress: ProgressBars) -> None:
    """A study that is a command of its own, with options named like its settings."""
    kind = registry.part(arguments.command, "settings").Settings
    given = {f.name: getattr(arguments, f.name, None) for f in fields(kind)}
    changes = {name: tuple(v) if isinstance(v, list) else v for name, v in given.items() if v is not None}
    settings = kind.quick(**changes) if arguments.quick else kind(**changes)
    _run_study(arguments.command, settings, arguments, progress)


def _verify(arguments: argparse.Namespace, progress: ProgressBars) -> None:
    from recon.study import results

    root = arguments.root
    stale = []
    for name, text in results.render(root).items():
        if not (root / name).exists() or (root / name).read_text(encoding="utf-8") != text:
            stale.append(name)
            if arguments.write:
                with atomic_write(root / name) as part:
                    part.write_text(text, encoding="utf-8")
    outcome = "say what the results say" if not stale else f"rendered: {', '.join(stale)}"
    print(outcome if arguments.write or not stale else f"stale: {', '.join(stale)} (--write renders them)")
    changed = []
    for name in arguments.again:
        committed = json.loads((root / "notebooks" / registry.folder(name) / "report.json").read_text(encoding="utf-8"))
        settings = registry.settings_of(name, committed["settings"])
        again = json.loads(registry.run(name, settings, progress).json)
        found = list(results.differences(committed, again))
        progress.close()
        print("\n".join([f"{name}: {len(found)} figures differ from the committed ones", *found]))
        changed += found
    if (stale and not arguments.write) or changed:
        raise ValueError("README.md, notebooks/RESULTS.md and the committed reports do not agree: see above")


# --- parsing ------------------------------------------------------------------------------------------------------


def _add_compare(commands: Commands) -> None:
    parser = command(
        commands, "compare", _own_study, registry.STUDIES["compare"],
        "Simulate the paper's plaque scan at full size, reconstruct it by FBP, PWLS, the best simple filter and MBIR "
        "on the same noise realisations at 1× and 5.7× dose, and print what dose each saves. After an interruption the "
        "same command goes on.",
        "folder for report.html, .md, .json and compare.png (default out/compare)",
    )  # fmt: skip
    examples(parser, "torchpcct compare --quick", "torchpcct compare --n 200 --methods fbp:soft pwls mbir:fidelity=1")
    parser.add_argument("--n", type=int, metavar="N", help="realisations (default 16)")
    parser.add_argument("--methods", nargs="+", metavar="METHOD", help="as of evaluate --method")
    parser.add_argument("--quick", action="store_true", help="reduced views and methods: a first look, < 45 s")
    add_execution(parser)


def _add_hardcases(commands: Commands) -> None:
    parser = command(
        commands, "hardcases", _own_study, registry.STUDIES["hardcases"],
        "Break the plaque's scan in many ways, reconstruct what is left by every method, and print the error, what was "
        "said, and whether it was wrong without a warning.",
        "folder for report.html, .md, .json and the figure (default out/hardcases)",
    )  # fmt: skip
    examples(parser, "torchpcct hardcases --quick", "torchpcct hardcases --methods fbp pwls --views 246")
    parser.add_argument("--quick", action="store_true", help="an eighth of the views, by FBP alone")
    parser.add_argument("--methods", nargs="+", metavar="M", help="fbp pwls mbir (default: all)")
    parser.add_argument("--cases", nargs="+", metavar="NAME", help="only these cases")
    parser.add_argument("--views", type=int, metavar="N", help="views of the scan (default 984)")
    add_execution(parser)


def _add_study(commands: Commands) -> None:
    parser = command(
        commands, "study", _study, "any study of the paper by its name; torchpcct study --help lists them",
        "Run a study of the paper at full scale and print its figures beside the published ones. After an interruption "
        "the same command goes on.",
        "folder for report.html, .md, .json and the figures (default out/NAME)",
    )  # fmt: skip
    listed = "".join(f"  {name:<12} {text}\n" for name, text in registry.STUDIES.items())
    before = f"studies:\n{listed}\n"
    examples(parser, "torchpcct study noise --quick", "torchpcct study motion --set views=492", before=before)
    parser.add_argument("name", metavar="NAME", help="name of the study")
    add_execution(parser)
    parser.add_argument("--quick", action="store_true", help="reduced settings: a first look, < 60 s")
    parser.add_argument(
        "--set",
        dest="changes",
        action="append",
        default=[],
        metavar="FIELD=VALUE",
        help="change a setting (repeatable)",
    )


def _add_verify(commands: Commands) -> None:
    parser = commands.add_parser(
        "verify", help="do README and RESULTS.md say what the committed reports say?",
        description="Render the results again from the committed reports (notebooks/results.template.md) and compare; "
        "compute studies again if asked.",
    )  # fmt: skip
    examples(parser, "torchpcct verify --write", "torchpcct verify --again phantom")
    parser.set_defaults(run=_verify, device="cpu", no_progress=False, verbose=False)
    parser.add_argument("--root", type=Path, default=Path(), help="folder of the repository (default: this one)")
    parser.add_argument("--write", action="store_true", help="write what is rendered")
    parser.add_argument("--again", nargs="*", default=[], metavar="STUDY", help="compute these studies again, in full")


_GROUPS = {
    "begin": (add_demo, add_doctor),
    "simulate and reconstruct": (add_simulate, add_show_config, add_reconstruct, add_lower_dose, add_train),
    "look": (add_view, add_info),
    "measure": (add_evaluate, add_show_task, add_plaque),
    "studies": (_add_compare, add_dose_factor, _add_hardcases, _add_study, _add_verify),
}
_BEGIN = """\
torchpcct {version}: simulate a photon-counting CT scan, reconstruct it, measure how much dose a method really saves.

A first look, 1 min     torchpcct demo
Does all work here?     torchpcct doctor
Your own scan           torchpcct info scan.h5
                        torchpcct reconstruct scan.h5 --find-axis --out volume.nii.gz
Look at volumes         torchpcct view a.nii.gz b.nii.gz --html view.html
The main result, 5 min  torchpcct compare
Your own method         torchpcct evaluate --task nodule --method mylab.nets:reconstruct

{groups}

torchpcct --help says what each command does; torchpcct COMMAND --help has its options and examples.
"""


def _parser() -> tuple[Parser, Commands, str]:
    """Parser, its commands, and what ``torchpcct`` alone says."""
    parser = Parser(
        prog="torchpcct",
        description="Photon-counting CT: simulate, reconstruct, and measure what model-based reconstruction saves.",
        epilog="commands and options by Tab, in bash:\n"
        "  torchpcct --print-completion bash > ~/.local/share/bash-completion/completions/torchpcct\n",
    )
    parser.add_argument("--version", action="version", version=f"torchpcct {__version__}")
    parser.add_argument(
        "--print-completion", action=_Completion, choices=("bash", "zsh", "tcsh"), metavar="SHELL",
        help="print the completion of bash, zsh or tcsh (needs the extra completion)",
    )  # fmt: skip
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    groups, listing, width = [], [], shutil.get_terminal_size().columns - 2
    for title, adders in _GROUPS.items():
        first = len(commands.choices)
        for add in adders:
            add(commands)
        added = commands._choices_actions[first:]
        groups.append(f"{title + ':':<25} {', '.join(a.dest for a in added)}")
        rows = (textwrap.wrap(f"  {a.dest:<12} {a.help}", width, subsequent_indent=" " * 15) for a in added)
        listing += [f"{title}:", *itertools.chain(*rows), ""]
    parser.listing = "\n".join(listing)
    return parser, commands, _BEGIN.format(version=__version__, groups="\n".join(groups))


class _Completion(argparse.Action):
    """Print the completion of a shell, and end."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        try:
            import shtab
        except ImportError:
            parser.error("--print-completion needs shtab: pip install 'torchpcct[completion]'")
        for sub in next(a for a in parser._actions if a.dest == "command").choices.values():
            for action in sub._actions:
                if action.type is Path:
                    action.complete = shtab.FILE
        print(shtab.complete(parser, values))
        parser.exit()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit status: 0 done, 1 not written (a full disk) or, of ``doctor``, something is
    broken, 2 refused input, 130 interrupted. Without a command it says where to begin, which is no error."""
    words = list(sys.argv[1:] if arguments is None else arguments)
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
    actions = commands.choices[options.command]._actions
    with saying(actions, options.verbose) as options.warn:
        return _run(options, actions)


def _run(options: argparse.Namespace, actions: Any) -> int:
    progress: Any = None
    try:
        from recon.study.study import ProgressBars

        progress = ProgressBars(not options.no_progress and sys.stderr.isatty())
        if options.device == "cuda" and not _cuda():
            raise ValueError("--device cuda: PyTorch finds no CUDA device here; use --device cpu")
        return options.run(options, progress) or 0
    except WriteError as error:
        return _failed(options.command, progress, str(error), 1)
    except (ValueError, TypeError, OSError, ImportError, OverflowError, MemoryError) as error:
        text = as_options(str(error), actions) or "out of memory: use larger voxels or a smaller grid"
        return _failed(options.command, progress, text, 2)
    except RuntimeError as error:
        if type(error).__name__ == "LeftOut":
            return _failed(options.command, progress, str(error), 1)
        if "no locator available" not in str(error):
            raise
        text = "numba cannot keep compiled kernels: set NUMBA_CACHE_DIR to a folder that you can write"
        return _failed(options.command, progress, text, 2)
    except KeyboardInterrupt:
        return _failed(options.command, progress, "interrupted, nothing half written", 130)


def _cuda() -> bool:
    import torch

    return torch.cuda.is_available()


def _failed(command: str, progress: Any, text: str, status: int) -> int:
    if progress is not None:
        progress.close()
    print(f"torchpcct {command}: {text}", file=sys.stderr)
    return status
