"""The commands that measure: ``evaluate``, ``dose-factor``, ``show-task``; ``compare``, ``hardcases``, ``study``,
``verify``."""

from __future__ import annotations

import argparse
import json
import os
import shlex
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

# What loads torch or numba is imported by the commands: help and refusals come at once.
from recon.cli.parsing import (
    EXPOSURE,
    LENGTH,
    MANY,
    PLACE,
    Commands,
    Parser,
    add_execution,
    add_options,
    check_results,
    command,
    executing,
)
from recon.names import METHODS
from recon.study import registry
from torchpcct.files import atomic_write, require_writable
from torchpcct.validate import choice

if TYPE_CHECKING:
    from recon.study.study import ProgressBars

__all__ = [
    "add_compare",
    "add_dose_factor",
    "add_evaluate",
    "add_hardcases",
    "add_show_task",
    "add_study",
    "add_verify",
]

_STUDY_TASKS = (
    "plaque", "half_contrast", "half_size_core", "two_cores", "small_vessel", "tilted", "in_plane", "curved",
    "muscle_sphere", "line_pairs_10", "line_pairs_14", "rod",
)  # fmt: skip
_STUDY_METHODS = (
    "fbp:soft", "fbp:standard", "fbp:detail", "gaussian@fbp:standard", "perona_malik@fbp:standard",
    "nlm@fbp:standard", "tv@fbp:standard", "bilateral@fbp:detail", "pwls", "mbir:outlines=no,prior=bilateral",
    "mbir:outlines=no", "mbir:fidelity=0", "mbir", "mbir:fidelity=1", "mbir:tissues",
)  # fmt: skip
"""Of ``dose-factor``: every method of the package, and each filter on the kernel on which it has the least error."""

_MEASURED = ("noise", "noise_reference", "dose_factor", "f50", "resolution")


def _evaluate(arguments: argparse.Namespace, progress: ProgressBars) -> None:
    from recon.evaluate.names import check_method, check_task

    for name in arguments.task or []:
        check_task(name)
    for name in [*(arguments.method or []), *map(_denoiser, arguments.denoiser or [])]:
        check_method(name)
    from recon.evaluate.experiment import evaluate, export_scans
    from recon.evaluate.methods import names_module
    from recon.evaluate.report import save, text_of

    out = arguments.out or Path(f"out/{arguments.command}")
    if out.is_file():
        raise ValueError(f"{out} is a file: --out names a folder")
    check_results(arguments, out, lambda report: "records" in report, "report.*", "*.png")
    if getattr(arguments, "volumes", None):
        _volumes(arguments.volumes[0], arguments.volumes[1], arguments.reference)
        return
    methods = [*(arguments.method or []), *map(_denoiser, arguments.denoiser or [])]
    if any(map(names_module, methods)):
        sys.path.append(os.getcwd())  # the user's own modules lie where the command is run; none hides another one
    if not methods:
        methods = list(arguments.methods)
    tasks = arguments.task or list(arguments.tasks)
    if arguments.scans:
        _scans(arguments, methods)
        return
    if arguments.export is not None:
        written = export_scans(
            tasks, arguments.export, exposures_s=arguments.exposures_s, n=arguments.n,
            seed=arguments.seed, progress=progress,
        )  # fmt: skip
        progress.close()
        print(
            f"{len(written)} scans in {arguments.export}: reconstruct each on the grid of its folder's grid.json, save "
            "the volumes under the same names in another folder, and evaluate --method files:FOLDER"
        )
        return
    found = None
    with executing(arguments, out):
        found = evaluate(
            tasks, methods, exposures_s=arguments.exposures_s, n=arguments.n, seed=arguments.seed,
            folder=out / "pieces", progress=progress,
        )  # fmt: skip
    progress.close()
    if found is None:
        return
    files = save(found, out, f"torchpcct {shlex.join(arguments.command_line)}")
    print(text_of(found))
    print(f"all figures, pictures and the page: {', '.join(str(f) for f in files)}")


def _scans(arguments: argparse.Namespace, methods: list[str]) -> None:
    """Measured scans, of which nobody knows the truth."""
    from recon.cli.scans import grid_of_scan
    from recon.evaluate.without_truth import evaluate_scans
    from torchpcct.formats.scans import open_scan

    scans = [open_scan(path) for path in arguments.scans]
    grid = grid_of_scan(scans[0], arguments)
    _print_measured(evaluate_scans(scans, grid, methods), scans[0].unit, "FBP", "FBP as sharp: kernel ram-lak")


def _volumes(first: Path, second: Path, reference: str) -> None:
    """Volumes of two scans of one object that other programs made, one folder a scan."""
    from recon.evaluate.without_truth import evaluate_volumes
    from torchpcct.volume import Volume

    for folder in (first, second):
        if not folder.is_dir():
            raise ValueError(f"{folder} is no folder: --volumes takes two, with one volume a method in each")
    stems = [{p.name.partition(".")[0]: p for p in sorted(f.iterdir()) if p.is_file()} for f in (first, second)]
    names = [name for name in stems[0] if name in stems[1]]
    if reference not in names:
        raise ValueError(
            f"{first} and {second} hold {', '.join(names) or 'no volumes of one name'}: --reference names the one of a "
            "linear method that has smoothed nothing (FBP, kernel ram-lak)"
        )
    pairs = {name: [Volume.load(s[name]) for s in stems] for name in names}
    grid, unit = pairs[reference][0].grid, pairs[reference][0].unit
    for name, both in pairs.items():
        if any(v.grid != grid or v.unit != unit for v in both):
            raise ValueError(
                f"{name} lies on another grid or has another unit than {reference}: {both[0].grid}, {grid}"
            )
    data = {name: [v.data for v in both] for name, both in pairs.items()}
    base = data.pop(reference)
    found = evaluate_volumes(data, base, grid.spacing[-1])
    _print_measured(found, unit, reference, f"{reference} as sharp: that volume")


def _print_measured(found: list[dict[str, Any]], unit: str, reference: str, meaning: str) -> None:
    """Table of noise at equal resolution."""
    rows = [("method", "noise", f"of {reference} as sharp", "dose factor", "f50, lp/mm", "agree up to, lp/mm")]
    rows += [(r["method"], *(f"{r[k]:.3g}".replace("nan", "–") for k in _MEASURED)) for r in found]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        print("  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip())
    if any(r["f50"] == float("inf") for r in found):
        print("no dose factor where the scans show nothing fine enough to tell how sharp a method is (f50 inf)")
    print(f"noise of one scan in {unit}; {meaning} with a Gaussian that gives it the same f50")


def _denoiser(text: str) -> str:
    """``package.module:function@BASE``."""
    if "@" not in text:
        raise ValueError(f"a denoiser needs a base: {text}@fbp:detail")
    return text


def _show_task(arguments: argparse.Namespace, progress: ProgressBars) -> None:
    from recon.evaluate.tasks import TASKS, task_text

    if arguments.name is None:
        width = max(map(len, TASKS))
        for name in TASKS:
            title = next(line for line in task_text(name).splitlines() if line.startswith("title:"))
            print(f"{name:<{width}}  {title[len('title:') :].strip()}")
        return
    print(task_text(arguments.name), end="")


# --- studies -----------------------------------------------------------------------------------------------------


def _run_study(name: str, settings: Any, arguments: argparse.Namespace, progress: ProgressBars) -> None:
    """Run a study of the registry, save and print its report."""
    folder = arguments.out or Path("out") / name
    require_writable(folder)
    names = (name, registry.folder(name).replace("_", "-"))
    check_results(arguments, folder, lambda report: report.get("study") in names, "report.*", "*.png")
    from recon.evaluate.store import Pieces  # loads torch

    start = time.perf_counter()
    report = None
    with executing(arguments, folder):
        report = registry.run(name, settings, progress, folder)
    progress.close()
    if report is None:
        return
    files = report.save(folder)
    Pieces.clear(folder)
    print(report.screen)
    print(f"\n{time.perf_counter() - start:.0f} s in all. Written: {', '.join(map(str, files))}")


def _study(arguments: argparse.Namespace, progress: ProgressBars) -> None:
    name, changes = arguments.name, arguments.changes
    settings = registry.build_settings(name, quick=arguments.quick, seed=arguments.seed, changes=changes)
    _run_study(name, settings, arguments, progress)


def _own_study(arguments: argparse.Namespace, progress: ProgressBars) -> None:
    """A study that is a command of its own, with options named like its settings."""
    from recon.evaluate.names import check_method

    for name in arguments.methods or []:
        if arguments.command == "compare":
            check_method(name)
        else:
            choice("method", name, (*METHODS, "tissues"))
    given = {name: value for name, value in vars(arguments).items() if value is not None}
    settings = registry.part(arguments.command).Settings.of(given, arguments.quick)
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
    print(outcome if arguments.write or not stale else f"stale: {', '.join(stale)} (--write renders them)")
    changed = []
    for name in arguments.again:
        committed = json.loads((root / "notebooks" / registry.folder(name) / "report.json").read_text(encoding="utf-8"))
        settings = registry.part(name).Settings.of(committed["settings"])
        again = json.loads(registry.run(name, settings, progress).json)
        found = list(results.differences(committed, again))
        progress.close()
        print("\n".join([f"{name}: {len(found)} figures differ from the committed ones", *found]))
        changed += found
    if (stale and not arguments.write) or changed:
        raise ValueError("README.md, notebooks/RESULTS.md and the committed reports do not agree: see above")


# --- parsing ------------------------------------------------------------------------------------------------------


_METHODS_TEXT = """\
methods: fbp:KERNEL, pwls, mbir, mbir:fidelity=1, mbir:weights=FILE, mbir:tissues,
         mbir:outlines=no, mbir:outlines=no,prior=bilateral,
         FILTER@fbp:KERNEL (gaussian, perona_malik, bilateral, nlm, tv, bm4d),
         package.module:function of (scan, grid), files:FOLDER

"""


REALISATIONS = {"low": 8, "high": MANY}


def add_evaluate(commands: Commands) -> None:
    parser = command(
        commands, "evaluate", _evaluate, "how much dose does a method save at a task?",
        "Measure reconstruction methods, yours too, at tasks, ready or yours, on the same noise realisations: dose "
        "factors with intervals beside the limit of the data, noise, error, contrast, detectability, pictures. "
        "Finished pieces are kept in the folder: the same command goes on after an interruption, and a second one with "
        "more methods computes only those.",
        "torchpcct evaluate --task nodule --method mbir --n 20",
        "torchpcct evaluate --task my.yaml --method mylab.nets:reconstruct --denoiser mylab.nets:denoise@fbp:detail",
        before=_METHODS_TEXT,
        out="folder for report.md, .json, .csv, .html and pictures (default out/evaluate)",
    )  # fmt: skip
    parser.set_defaults(tasks=("plaque",), methods=("fbp:soft", "bilateral@fbp:detail", "mbir"))
    _add_common(parser, n=20)
    add_options(
        parser,
        ("--scans", Path, "FILE", "measured scans instead of tasks: two of one object, or one, which is halved; noise "
         "at equal resolution", {"nargs": "+", "read": True}),
        ("--volumes", Path, "FOLDER", "volumes of two scans of one object instead of tasks: in each folder one file "
         "per method, of the same name", {"nargs": 2, "read": True}),
        ("--reference", str, "NAME", "with --volumes: the one by a linear method that smoothed nothing (default fbp)",
         {"default": "fbp"}),
        ("--voxel", float, "MM", "with --scans: voxel size (default: the detector's)", {"limits": LENGTH}),
        ("--extent", float, "MM", "with --scans: of the volume, Z Y X", {"nargs": "+", "limits": LENGTH}),
        ("--center", float, "MM", "with --scans: of the volume, Z Y X", {"nargs": "+", "limits": PLACE}),
        group="measured scans and volumes, of which nobody knows the truth",
    )  # fmt: skip
    add_options(parser, ("--export", Path, "FOLDER", "write the noisy scans for another program instead of evaluating"))


def add_dose_factor(commands: Commands) -> None:
    parser = command(
        commands, "dose-factor", _evaluate, "the whole measurement: every method of the package at every plaque task",
        "evaluate with the methods of this package, the simple filters among them, at the paper's plaque, its "
        "variants, vessels of other directions, a sphere in muscle, line pairs and a low-contrast rod, with 200 "
        "realisations: hours on two cores, kept piece by piece.",
        "torchpcct dose-factor --task plaque --method mbir --method fbp:soft --n 40",
        before=_METHODS_TEXT,
        out="folder for report.md, .json, .csv, .html and pictures (default out/dose-factor)",
    )  # fmt: skip
    parser.set_defaults(tasks=_STUDY_TASKS, methods=_STUDY_METHODS, scans=None, export=None)
    _add_common(parser, n=200)


def _add_common(parser: Parser, n: int) -> None:
    many = {"action": "append"}
    exposures = {"dest": "exposures_s", "nargs": "+", "limits": EXPOSURE}
    add_options(
        parser,
        ("--task", str, "TASK", "name (see show-task) or YAML file, repeatable", many),
        ("--method", str, "METHOD", "see below (repeatable)", many),
        ("--denoiser", str, "FUNCTION@BASE", "function of (volume) or (volume, sigma), HU, after BASE", many),
        ("--exposure", float, "S", "in s (default: those of each task)", exposures),
    )
    add_execution(parser)
    add_options(
        parser,
        ("--n", int, None, f"noise realisations, at least 8 (default {n})", {"default": n, "limits": REALISATIONS}),
    )


def add_show_task(commands: Commands) -> None:
    parser = command(
        commands, "show-task", _show_task, "print a ready task as YAML; without a name list them",
        "Print a ready task as YAML, to copy and change. Without a name: all of them.",
        "torchpcct show-task nodule > mine.yaml",
    )  # fmt: skip
    add_options(parser, ("name", str, "NAME", "", {"nargs": "?"}))


def add_compare(commands: Commands) -> None:
    parser = command(
        commands, "compare", _own_study, registry.STUDIES["compare"],
        "Simulate the paper's plaque scan at full size, reconstruct it by FBP, PWLS, the best simple filter and MBIR "
        "on the same noise realisations at 1× and 5.7× dose, and print what dose each saves. After an interruption the "
        "same command goes on.",
        "torchpcct compare --quick", "torchpcct compare --n 200 --methods fbp:soft pwls mbir:fidelity=1",
        out="folder for report.html, .md, .json and compare.png (default out/compare)",
    )  # fmt: skip
    add_options(
        parser,
        ("--n", int, "N", "realisations, at least 8 (default 16)", {"limits": REALISATIONS}),
        ("--methods", str, "METHOD", "as of evaluate --method", {"nargs": "+"}),
        ("--quick", bool, None, "reduced views and methods: a first look, some minutes"),
    )
    add_execution(parser)


def add_hardcases(commands: Commands) -> None:
    parser = command(
        commands, "hardcases", _own_study, registry.STUDIES["hardcases"],
        "Break the plaque's scan in many ways, reconstruct what is left by every method, and print the error, what was "
        "said, and whether it was wrong without a warning.",
        "torchpcct hardcases --quick", "torchpcct hardcases --methods fbp pwls --views 246",
        out="folder for report.html, .md, .json and the figure (default out/hardcases)",
    )  # fmt: skip
    add_options(
        parser,
        ("--quick", bool, None, "an eighth of the views, by FBP alone"),
        ("--methods", str, "M", "fbp pwls mbir (default: all)", {"nargs": "+"}),
        ("--cases", str, "NAME", "only these cases", {"nargs": "+"}),
        ("--views", int, "N", "views of the scan (default 360)", {"limits": {"low": 120, "high": MANY}}),
    )
    add_execution(parser)


def add_study(commands: Commands) -> None:
    listed = "".join(f"  {name:<12} {text}\n" for name, text in registry.STUDIES.items())
    parser = command(
        commands, "study", _study, "any study of the paper by its name; torchpcct study --help lists them",
        "Run a study of the paper at full scale and print its figures beside the published ones. After an interruption "
        "the same command goes on.",
        "torchpcct study noise --quick", "torchpcct study motion --set thinning=4", before=f"studies:\n{listed}\n",
        out="folder for report.html, .md, .json and the figures (default out/NAME)",
    )  # fmt: skip
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
        commands, "verify", _verify, "do README and RESULTS.md say what the committed reports say?",
        "Render the results again from the committed reports (notebooks/results.template.md) and compare; "
        "compute studies again if asked.",
        "torchpcct verify --write", "torchpcct verify --again phantom",
    )  # fmt: skip
    parser.set_defaults(no_progress=False)
    add_options(
        parser,
        ("--root", Path, None, "folder of the repository (default: this one)", {"default": Path(), "read": True}),
        ("--write", bool, None, "write what is rendered"),
        ("--again", str, "STUDY", "compute these studies again, in full", {"nargs": "*", "default": []}),
    )
