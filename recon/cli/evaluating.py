"""The commands of the instrument: ``evaluate``, ``show-task``."""

from __future__ import annotations

import argparse
import os
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

# What loads torch or numba is imported by the commands: help and refusals come at once.
from recon.cli.parsing import Commands, add_execution, check_results, command, examples, executing

if TYPE_CHECKING:
    from recon.study.study import ProgressBars

__all__ = ["add_dose_factor", "add_evaluate", "add_show_task"]

_STUDY_TASKS = (
    "plaque",
    "half_contrast",
    "half_size_core",
    "two_cores",
    "small_vessel",
    "tilted",
    "in_plane",
    "curved",
    "muscle_sphere",
    "line_pairs_10",
    "line_pairs_14",
    "rod",
)
_STUDY_METHODS = (
    "fbp:soft",
    "fbp:standard",
    "fbp:detail",
    "gaussian@fbp:standard",
    "perona_malik@fbp:standard",
    "nlm@fbp:standard",
    "tv@fbp:standard",
    "bilateral@fbp:detail",
    "pwls",
    "mbir:prior=bilateral",
    "mbir:fidelity=0",
    "mbir",
    "mbir:fidelity=1",
    "mbir:tissues",
)
"""Of ``dose-factor``: every method of the package, and each filter on the kernel on which it has the least error."""

_MEASURED = ("noise", "noise_reference", "dose_factor", "f50", "resolution")


def _evaluate(arguments: argparse.Namespace, progress: ProgressBars) -> None:
    from recon.evaluate.experiment import evaluate, export_scans
    from recon.evaluate.report import save, text_of

    out = arguments.out or Path(f"out/{arguments.command}")
    if out.is_file():
        raise ValueError(f"{out} is a file: --out names a folder")
    check_results(arguments, out, lambda report: "records" in report, "report.*", "*.png")
    if getattr(arguments, "volumes", None):
        _volumes(arguments.volumes[0], arguments.volumes[1], arguments.reference)
        return
    # The user's own modules lie where the command is run.
    sys.path.insert(0, os.getcwd())
    methods = [*(arguments.method or []), *map(_denoiser, arguments.denoiser or [])]
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


def add_evaluate(commands: Commands) -> None:
    parser = command(
        commands, "evaluate", _evaluate, "how much dose does a method save at a task?",
        "Measure reconstruction methods, yours too, at tasks, ready or yours, on the same noise realisations: dose "
        "factors with intervals beside the limit of the data, noise, error, contrast, detectability, pictures. "
        "Finished pieces are kept in the folder: the same command goes on after an interruption, and a second one with "
        "more methods computes only those.",
        "folder for report.md, .json, .csv, .html and pictures (default out/evaluate)",
    )  # fmt: skip
    parser.set_defaults(tasks=("plaque",), methods=("fbp:soft", "bilateral@fbp:detail", "mbir"))
    examples(
        parser, "torchpcct evaluate --task nodule --method mbir --n 20",
        "torchpcct evaluate --task my.yaml --method mylab.nets:reconstruct --denoiser mylab.nets:denoise@fbp:detail",
        before="methods: fbp:KERNEL, pwls, mbir, mbir:fidelity=1, mbir:weights=FILE, mbir:tissues,\n"
        "         FILTER@fbp:KERNEL (gaussian, perona_malik, bilateral, nlm, tv, bm4d),\n"
        "         package.module:function of (scan, grid), files:FOLDER\n\n",
    )  # fmt: skip
    _add_common(parser, n=20)
    measured = parser.add_argument_group("measured scans and volumes, of which nobody knows the truth")
    measured.add_argument(
        "--scans",
        nargs="+",
        type=Path,
        metavar="FILE",
        help="measured scans instead of tasks: two of one object, or one, which is halved; noise at equal resolution",
    )
    measured.add_argument(
        "--volumes",
        nargs=2,
        type=Path,
        metavar="FOLDER",
        help="volumes of two scans of one object instead of tasks: a file of the same name a method in each folder",
    )
    measured.add_argument(
        "--reference",
        default="fbp",
        metavar="NAME",
        help="with --volumes: name of a linear method, unsmoothed (default fbp)",
    )
    measured.add_argument(
        "--voxel", type=float, metavar="MM", help="with --scans: voxel size (default: the detector's)"
    )
    measured.add_argument("--extent", type=float, nargs="+", metavar="MM", help="with --scans: edge lengths, Z Y X")
    measured.add_argument("--center", type=float, nargs="+", metavar="MM", help="with --scans: centre, Z Y X")
    parser.add_argument(
        "--export", type=Path, metavar="FOLDER", help="write the noisy scans for another program instead of evaluating"
    )


def add_dose_factor(commands: Commands) -> None:
    parser = command(
        commands, "dose-factor", _evaluate, "the whole measurement: every method of the package at every plaque task",
        "evaluate with the methods of this package, the simple filters among them, at the paper's plaque, its "
        "variants, vessels of other directions, a sphere in muscle, line pairs and a low-contrast rod, with 200 "
        "realisations: hours on two cores, kept piece by piece.",
        "folder for report.md, .json, .csv, .html and pictures (default out/dose-factor)",
    )  # fmt: skip
    examples(parser, "torchpcct dose-factor --task plaque --method mbir --method fbp:soft --n 40")
    parser.set_defaults(tasks=_STUDY_TASKS, methods=_STUDY_METHODS, scans=None, export=None)
    _add_common(parser, n=200)


def _add_common(parser: argparse.ArgumentParser, n: int) -> None:
    parser.add_argument("--task", action="append", metavar="TASK", help="ready task or YAML file (repeatable)")
    parser.add_argument("--method", action="append", metavar="METHOD", help="see below (repeatable)")
    parser.add_argument(
        "--denoiser", action="append", metavar="FUNCTION@BASE", help="a function of (volume) or (volume, sigma) in HU"
    )
    parser.add_argument(
        "--exposure", dest="exposures_s", type=float, nargs="+", metavar="S", help="exposures (default: of the task)"
    )
    add_execution(parser)
    parser.add_argument("--n", type=int, default=n, help=f"noise realisations, at least 8 (default {n})")


def add_show_task(commands: Commands) -> None:
    parser = commands.add_parser(
        "show-task", help="print a ready task as YAML; without a name list them",
        description="Print a ready task as YAML, to copy and change. Without a name: all of them.",
    )  # fmt: skip
    examples(parser, "torchpcct show-task nodule > mine.yaml")
    parser.set_defaults(run=_show_task, device="cpu", no_progress=True, verbose=False)
    parser.add_argument("name", nargs="?", metavar="NAME")
