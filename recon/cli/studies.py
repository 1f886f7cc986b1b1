"""The commands of the studies: ``compare``, ``hardcases``, ``study``, ``verify``."""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import TYPE_CHECKING

# What loads torch or numba is imported by the commands: help and refusals come at once.
from recon.cli.parsing import (
    MANY,
    REALISATIONS,
    Commands,
    add_execution,
    add_options,
    check_results,
    command,
    executing,
)
from recon.names import METHODS
from recon.study import registry
from recon.study.names import check_case
from torchpcct.files import atomic_write, require_writable
from torchpcct.validate import choice

if TYPE_CHECKING:
    from recon.study.study import ProgressBars, StudySettings


def _run_study(
    name: str, settings: StudySettings, arguments: argparse.Namespace, progress: ProgressBars
) -> None:
    """Run a study of the registry, save and print its report."""
    folder = arguments.out or Path("out") / name
    require_writable(folder)
    names = (name, registry.folder(name).replace("_", "-"))
    check_results(
        arguments, folder, lambda report: report.get("study") in names, "report.*", "*.png"
    )
    from recon.jobs.store import StudyCache  # loads torch

    start = time.perf_counter()
    report = None
    with executing(arguments, folder):
        report = registry.run(name, settings, progress, folder)
    progress.close()
    if report is None:
        return
    files = report.save(folder)
    StudyCache.clear(folder)
    print(report.screen)
    print(f"\n{time.perf_counter() - start:.0f} s in all. Written: {', '.join(map(str, files))}")


def _study(arguments: argparse.Namespace, progress: ProgressBars) -> None:
    name, changes = arguments.name, arguments.changes
    settings = registry.build_settings(
        name, quick=arguments.quick, seed=arguments.seed, changes=changes
    )
    _run_study(name, settings, arguments, progress)


def _own_study(arguments: argparse.Namespace, progress: ProgressBars) -> None:
    """A study that is a command of its own, with options named like its settings."""
    from recon.evaluate.names import check_method

    for name in arguments.methods or []:
        if arguments.command == "compare":
            check_method(name)
        else:
            choice("method", name, (*METHODS, "tissues"))
    for name in getattr(arguments, "cases", None) or []:
        check_case(name)
    given = {name: value for name, value in vars(arguments).items() if value is not None}
    settings = registry.settings_class(arguments.command).of(given, arguments.quick)
    _run_study(arguments.command, settings, arguments, progress)


def _verify(arguments: argparse.Namespace, progress: ProgressBars) -> None:
    root = arguments.root
    for name in arguments.again:
        registry.folder(name)
    from recon.study import results

    stale = []
    for name, text in results.render(root).items():
        if not (root / name).exists() or (root / name).read_text(encoding="utf-8") != text:
            stale.append(name)
            if arguments.write:
                with atomic_write(root / name) as part:
                    part.write_text(text, encoding="utf-8")
    outcome = "say what the results say" if not stale else f"rendered: {', '.join(stale)}"
    print(
        outcome
        if arguments.write or not stale
        else f"stale: {', '.join(stale)} (--write renders them)"
    )
    changed = []
    for name in arguments.again:
        committed = json.loads(
            (root / "notebooks" / registry.folder(name) / "report.json").read_text(encoding="utf-8")
        )
        settings = registry.settings_class(name).of(committed["settings"])
        again = json.loads(registry.run(name, settings, progress).json)
        found = list(results.differences(committed, again))
        progress.close()
        print("\n".join([f"{name}: {len(found)} figures differ from the committed ones", *found]))
        changed += found
    if (stale and not arguments.write) or changed:
        raise ValueError(
            "README.md, notebooks/RESULTS.md and the committed reports do not agree: see above"
        )


def add_compare(commands: Commands) -> None:
    parser = command(
        commands,
        "compare",
        _own_study,
        registry.STUDIES["compare"],
        "Simulate the paper's plaque scan at full size, reconstruct it by FBP, PWLS, the best "
        "simple filter and MBIR on the same noise realisations at 1× and 5.7× dose, and print "
        "what dose each saves. After an interruption the same command goes on.",
        "torchpcct compare --quick",
        "torchpcct compare --n 200 --methods fbp:soft pwls mbir:fidelity=1",
        out="folder for report.html, .md, .json and two pictures (default out/compare)",
    )
    add_options(
        parser,
        ("--n", int, "N", "realisations, at least 8 (default 16)", {"limits": REALISATIONS}),
        ("--methods", str, "METHOD", "as of evaluate --method", {"nargs": "+"}),
        ("--quick", bool, None, "reduced views and methods: a first look, some minutes"),
    )
    add_execution(parser)


def add_hardcases(commands: Commands) -> None:
    parser = command(
        commands,
        "hardcases",
        _own_study,
        registry.STUDIES["hardcases"],
        "Break the plaque's scan in many ways, reconstruct what is left by every method, and "
        "print the error, the warnings, and whether it was wrong without a warning.",
        "torchpcct hardcases --quick",
        "torchpcct hardcases --methods fbp pwls --views 246",
        out="folder for report.html, .md, .json and the figure (default out/hardcases)",
    )
    add_options(
        parser,
        ("--quick", bool, None, "an eighth of the views, by FBP alone"),
        ("--methods", str, "M", "fbp pwls mbir (default: all)", {"nargs": "+"}),
        ("--cases", str, "NAME", "only these cases", {"nargs": "+"}),
        (
            "--views",
            int,
            "N",
            "views of the scan (default 360)",
            {"limits": {"low": 120, "high": MANY}},
        ),
    )
    add_execution(parser)


def add_study(commands: Commands) -> None:
    listed = "".join(f"  {name:<12} {text}\n" for name, text in registry.STUDIES.items())
    parser = command(
        commands,
        "study",
        _study,
        "any study of the paper by its name; torchpcct study --help lists them",
        "Run a study of the paper at full scale and print its figures beside the published ones. "
        "After an interruption the same command goes on.",
        "torchpcct study noise --quick",
        "torchpcct study motion --set thinning=4",
        before=f"studies:\n{listed}\n",
        out="folder for report.html, .md, .json and the figures (default out/NAME)",
    )
    add_options(parser, ("name", str, "NAME", "of the study"))
    add_execution(parser)
    changes = {"dest": "changes", "action": "append", "default": []}
    add_options(
        parser,
        ("--quick", bool, None, "reduced settings: a first look, < 60 s"),
        ("--set", str, "FIELD=VALUE", "change a setting (repeatable)", changes),
    )


def add_verify(commands: Commands) -> None:
    parser = command(
        commands,
        "verify",
        _verify,
        "check README.md and RESULTS.md against the committed reports",
        "Render the results again from the committed reports (notebooks/results.template.md) and "
        "compare; compute studies again if asked.",
        "torchpcct verify --write",
        "torchpcct verify --again phantom",
    )
    parser.set_defaults(no_progress=False)
    add_options(
        parser,
        (
            "--root",
            Path,
            None,
            "folder of the repository (default: this one)",
            {"default": Path(), "read": True},
        ),
        ("--write", bool, None, "write what is rendered"),
        (
            "--again",
            str,
            "STUDY",
            "compute these studies again, in full",
            {"nargs": "*", "default": []},
        ),
    )
