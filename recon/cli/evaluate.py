"""The commands that compare methods: ``evaluate``, ``dose-factor``, ``show-task``."""

from __future__ import annotations

import argparse
import json
import re
import shlex
from pathlib import Path
from typing import TYPE_CHECKING

# What loads torch or numba is imported by the commands: help and refusals come at once.
from recon.cli.parsing import (
    EXPOSURE,
    LENGTH,
    PLACE,
    REALISATIONS,
    Commands,
    Parser,
    add_execution,
    add_options,
    check_results,
    command,
    executing,
    find_modules_here,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from recon.evaluate.without_truth import Comparison
    from recon.study.study import ProgressBars
    from torchpcct.geometry import VolumeGrid
    from torchpcct.typing import Bools

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
    "lumen",
)
"""Tasks of ``dose-factor``."""
_STUDY_METHODS = (
    "fbp:soft",
    "fbp:standard",
    "fbp:detail",
    "fbp:soft,energies",
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
    "mbir:vessel",
    "mbir:tissues",
)
"""Of ``dose-factor``: every method of the package, and each filter on the kernel on which it has
the least error."""


METHODS_TEXT = """\
methods: fbp:KERNEL, pwls, mbir, mbir:fidelity=1, mbir:weights=FILE, mbir:vessel, mbir:tissues,
         mbir:prior=PRIOR (a filter below, or package.module:function),
         mbir:weights=FILE,network=package.module:Class,
         FILTER@fbp:KERNEL (gaussian, perona_malik, bilateral, nlm, tv, bm4d),
         package.module:function of (scan, grid), files:FOLDER;
         each with energies=CONTRAST among its options (fbp:soft,energies=iodine): energy bins
         summed with the weights that show the contrast best (task, iodine or two materials A/B)

"""
"""What the help says of methods."""


def _evaluate(arguments: argparse.Namespace, progress: ProgressBars) -> None:
    from recon.evaluate.names import check_method, check_task

    for name in arguments.task or []:
        check_task(name)
    for name in [*(arguments.method or []), *map(_denoiser, arguments.denoiser or [])]:
        check_method(name)
    from recon.evaluate.experiment import evaluate, export_scans, measured_before
    from recon.evaluate.methods import names_module
    from recon.evaluate.report import save, text_of

    out = arguments.out or Path(f"out/{arguments.command}")
    if out.is_file():
        raise ValueError(f"{out} is a file: --out names a folder")
    check_results(arguments, out, lambda report: "records" in report, "report.*", "*.png")
    if getattr(arguments, "scans", None) or getattr(arguments, "volumes", None):
        _measured(arguments, out)
        return
    for name in ("region", "reference", "voxel", "extent", "center"):
        if getattr(arguments, name, None) is not None:
            raise ValueError(
                f"--{name} applies to measured scans and volumes: give it with --scans or --volumes"
            )
    n = arguments.realisations if arguments.n is None else arguments.n
    methods = [*(arguments.method or []), *map(_denoiser, arguments.denoiser or [])]
    if any(map(names_module, [*methods, *_reported(out)])):
        find_modules_here()
    if not methods:
        methods = list(arguments.methods)
    tasks = arguments.task or list(arguments.tasks)
    if arguments.export is not None:
        if arguments.dry_run:
            print(_planned_export(tasks, arguments.exposures_s, n, arguments.export))
            return
        written = export_scans(
            tasks,
            arguments.export,
            exposures_s=arguments.exposures_s,
            n=n,
            seed=arguments.seed,
            progress=progress,
        )
        progress.close()
        print(
            f"{len(written)} scans in {arguments.export}. Save their volumes in HU, on the grid "
            "of each folder's "
            "grid.json, under the same names in OTHER/TASK, as this does:\n"
            f"  torchpcct reconstruct {arguments.export}/{written[0].parent.name}/*.h5 --out OTHER/"
            f"{written[0].parent.name}\n"
            f"  torchpcct evaluate --task {tasks[0]} --method files:OTHER --n {n}"
        )
        return
    found = None
    settings = {"exposures_s": arguments.exposures_s, "n": n, "seed": arguments.seed}
    before = measured_before(out / "report.json", tasks, out / "cache", **settings)
    methods = [*before, *(name for name in methods if name not in before)]
    with executing(arguments, out):
        found = evaluate(
            tasks,
            methods,
            exposures_s=arguments.exposures_s,
            n=n,
            seed=arguments.seed,
            folder=out / "cache",
            progress=progress,
        )
    progress.close()
    if found is None:
        return
    files = save(found, out, f"torchpcct {shlex.join(arguments.command_line)}")
    print(text_of(found))
    print(f"all figures, pictures and the page: {', '.join(str(f) for f in files)}")


def _reported(out: Path) -> list[str]:
    """Methods of the report in a folder, if there is one."""
    try:
        report = json.loads((out / "report.json").read_text(encoding="utf-8"))
        return [str(name) for name in report["settings"]["methods"]]
    except (OSError, ValueError, KeyError, TypeError):
        return []


def _planned_export(
    tasks: list[str], exposures_s: Sequence[float] | None, n: int, folder: Path
) -> str:
    """What ``--export`` would write."""
    from recon.evaluate.tasks import read_task

    lines = []
    for task in map(read_task, tasks):
        exposures = exposures_s or task.exposures_s
        times = ", ".join(f"{e:g}" for e in exposures)
        lines.append(
            f"{folder / task.name}: {2 * (n + 1) * len(exposures)} scans at {times} s, and "
            "grid.json"
        )
    return "\n".join(lines)


def _measured(arguments: argparse.Namespace, out: Path) -> None:
    """Measured scans or volumes, without a known ground truth: table, page and files."""
    from recon.evaluate.report import measured_text, save_measured

    of_tasks = {
        "--task": arguments.task,
        "--exposure": arguments.exposures_s,
        "--export": arguments.export,
        "--workers": arguments.workers,
        "--dry-run": arguments.dry_run,
    }
    for flag, value in of_tasks.items():
        if value:
            raise ValueError(
                f"{flag} applies to simulated tasks: leave it out with --scans and --volumes"
            )
    if arguments.scans and arguments.volumes:
        raise ValueError("give --scans or --volumes, not both")
    rows, unit, reference = _scans(arguments) if arguments.scans else _volumes(arguments)
    files = save_measured(
        rows, unit, reference, out, f"torchpcct {shlex.join(arguments.command_line)}"
    )
    print(measured_text(rows, unit, reference))
    print(f"all figures and the page: {', '.join(map(str, files))}")


def _scans(arguments: argparse.Namespace) -> tuple[list[Comparison], str, str]:
    """Rows, unit and name of the reference."""
    from recon.evaluate.methods import names_module
    from recon.evaluate.without_truth import evaluate_scans
    from torchpcct import VolumeGrid
    from torchpcct.formats.scans import open_scan

    if arguments.reference is not None:
        raise ValueError(
            "--reference names one of the --volumes; with --scans the reference is FBP with the "
            "kernel ram-lak: leave it out"
        )
    methods = [*(arguments.method or []), *map(_denoiser, arguments.denoiser or [])] or list(
        arguments.methods
    )
    if any(map(names_module, methods)):
        find_modules_here()
    scans = [open_scan(path) for path in arguments.scans]
    grid = VolumeGrid.of(
        scans[0], voxel=arguments.voxel, extent=arguments.extent, center=arguments.center
    )
    region = _region(arguments.region, grid)
    found = evaluate_scans(
        scans,
        grid,
        methods,
        region,
        n=1 if arguments.n is None else arguments.n,
        seed=arguments.seed,
    )
    return found, scans[0].unit, "fbp:ram-lak"


def _volumes(arguments: argparse.Namespace) -> tuple[list[Comparison], str, str]:
    """The same of volumes of two scans of one object that other programs made, one folder a
    scan."""
    from recon.evaluate.methods import same_grid, volume_files
    from recon.evaluate.without_truth import evaluate_volumes
    from torchpcct.volume import Volume

    for flag, value in (("--method", arguments.method), ("--denoiser", arguments.denoiser)):
        if value:
            raise ValueError(
                f"{flag} applies to --scans: --volumes compares the files in the two folders, one "
                "for each method; leave it out"
            )
    if arguments.n is not None:
        raise ValueError(
            "--n applies to --scans: two folders of volumes contain one pair of noise "
            "realisations; leave it out"
        )
    for name in ("voxel", "extent", "center"):
        if getattr(arguments, name) is not None:
            raise ValueError(
                f"--{name} applies to --scans: volumes have a grid already; leave it out"
            )
    first, second = arguments.volumes
    reference = arguments.reference or "fbp"
    for folder in (first, second):
        if not folder.is_dir():
            raise ValueError(
                f"{folder} is not a folder: --volumes takes two, with one volume of each method in "
                "both"
            )
    stems = [volume_files(folder) for folder in (first, second)]
    names = [name for name in stems[0] if name in stems[1]]
    if reference not in names:
        raise ValueError(
            f"{first} and {second} both have {', '.join(names) or 'no volumes of the same name'}, "
            f"but not {reference}: --reference names the volume of a linear method without "
            "smoothing (FBP, kernel ram-lak)"
        )
    alone = [str(files[name]) for files in stems for name in files if name not in names]
    if alone:
        arguments.warn(f"left out, as the other folder has none of that name: {', '.join(alone)}")
    pairs = {name: [Volume.load(s[name]) for s in stems] for name in names}
    grid, unit = pairs[reference][0].grid, pairs[reference][0].unit
    for name, both in pairs.items():
        for files, volume in zip(stems, both, strict=True):
            if not same_grid(volume.grid, grid):
                raise ValueError(
                    f"{files[name]} has the grid {volume.grid}, {stems[0][reference]} {grid}: "
                    "resample it"
                )
            if volume.unit != unit:
                raise ValueError(
                    f"{files[name]} is in {volume.unit}, {stems[0][reference]} in {unit}: give all "
                    "in one unit"
                )
    data = {name: [v.data for v in both] for name, both in pairs.items()}
    base = data.pop(reference)
    if not data:
        raise ValueError(
            f"{first} and {second} both have {reference} alone: put a volume of another method, of "
            "the same name, into both"
        )
    cells = _cells(stems[0][reference])
    found = evaluate_volumes(
        data, base, grid.spacing, _region(arguments.region, grid), cells_mm=cells
    )
    return found, unit, reference


def _cells(path: Path) -> list[float] | None:
    """What ``reconstruct`` wrote beside a volume of the detector's cells at the axis, mm; None:
    nothing."""
    try:
        return [
            float(c)
            for c in json.loads(Path(f"{path}.json").read_text(encoding="utf-8"))["cells_mm"]
        ]
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _region(text: str | None, grid: VolumeGrid) -> Bools | None:
    """A mask from a volume's file, or from ranges of voxels, ``Z0:Z1,Y0:Y1,X0:X1``."""
    import numpy as np

    from recon.evaluate.methods import same_grid
    from torchpcct.volume import Volume

    if text is None:
        return None
    mask: Bools = np.zeros(grid.shape, bool)
    if not Path(text).exists():
        mask[_ranges(text, grid.shape)] = True
    else:
        volume = Volume.load(text)
        if not same_grid(volume.grid, grid):
            raise ValueError(
                f"--region {text} has the grid {volume.grid}, the volumes {grid}: resample it"
            )
        mask = np.asarray(volume.data) != 0
    if mask.sum() < 2:
        raise ValueError(
            f"--region {text} selects {int(mask.sum())} voxels, at least two are needed"
        )
    return mask


def _ranges(text: str, shape: Sequence[int]) -> tuple[slice, ...]:
    """Of voxels, ``Z0:Z1,Y0:Y1,X0:X1``, an end left out or counted from behind as in Python.

    Raises:
        ValueError: something else, or beyond the voxels.
    """
    axes, parts = "ZYX"[-len(shape) :], text.split(",")
    ends = [re.fullmatch(r"\s*(-?\d+)?:(-?\d+)?\s*", part) for part in parts]
    if len(parts) != len(shape) or None in ends:
        form = ",".join(f"{axis}0:{axis}1" for axis in axes)
        raise ValueError(
            f"--region {text}: neither an existing file nor ranges of voxels, {form} (one voxel is "
            f"5:6), within the {' × '.join(map(str, shape))} voxels"
        )
    found = [[None if v is None else int(v) for v in end.groups()] for end in ends if end]
    for axis, n, part, pair in zip(axes, shape, parts, found, strict=True):
        if any(v is not None and not -n <= v <= n for v in pair):
            raise ValueError(
                f"--region {text}: {part.strip()} reaches beyond the {n} voxels along "
                f"{axis.lower()}: ranges are of voxels, not mm; an end left out is that of the "
                "volume"
            )
    return tuple(slice(*pair) for pair in found)


def _denoiser(text: str) -> str:
    """``package.module:function@BASE``."""
    if "@" not in text:
        raise ValueError(
            f"--denoiser {text} does not name the method that it is applied to: {text}@fbp:detail"
        )
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
        commands,
        "evaluate",
        _evaluate,
        "how much dose does a method save at a task?",
        "Measure reconstruction methods, yours too, at tasks, ready or yours, on the same noise "
        "realisations: dose factors with intervals beside the Cramér–Rao bound, noise, error, "
        "contrast, detectability, pictures. Finished results are cached in the folder: the same "
        "command goes on after an interruption, and a second one with more methods computes only "
        "those.",
        "torchpcct evaluate --task nodule --method mbir --n 20",
        "torchpcct evaluate --task my.yaml --method mylab.nets:reconstruct --denoiser "
        "mylab.nets:denoise@fbp:detail",
        before=METHODS_TEXT,
        out="folder for report.md, .json, .csv, .html and pictures (default out/evaluate)",
    )
    parser.set_defaults(tasks=("plaque",), methods=("fbp:soft", "bilateral@fbp:detail", "mbir"))
    _add_common(parser, n=20)
    add_options(
        parser,
        (
            "--scans",
            Path,
            "FILE",
            "measured scans instead of tasks: two of one object, or one, which is halved; noise "
            "at equal resolution",
            {"nargs": "+", "read": True},
        ),
        (
            "--volumes",
            Path,
            "FOLDER",
            "volumes of two scans of one object instead of tasks: in each folder one file "
            "per method, of the same name",
            {"nargs": 2, "read": True},
        ),
        (
            "--reference",
            str,
            "NAME",
            "with --volumes: the one by a linear method that smoothed nothing (default fbp)",
        ),
        (
            "--region",
            str,
            "MASK",
            "where noise is measured: a volume that is not 0 there, or voxels "
            "Z0:Z1,Y0:Y1,X0:X1 (default: everywhere)",
        ),
        (
            "--voxel",
            float,
            "MM",
            "with --scans: voxel size (default: the detector's)",
            {"limits": LENGTH},
        ),
        (
            "--extent",
            float,
            "MM",
            "with --scans: of the volume, Z Y X",
            {"nargs": "+", "limits": LENGTH},
        ),
        (
            "--center",
            float,
            "MM",
            "with --scans: of the volume, Z Y X",
            {"nargs": "+", "limits": PLACE},
        ),
        group="measured scans and volumes, without a known ground truth",
    )
    add_options(
        parser,
        (
            "--export",
            Path,
            "FOLDER",
            "write the noisy scans for another program instead of evaluating",
        ),
    )


def add_dose_factor(commands: Commands) -> None:
    parser = command(
        commands,
        "dose-factor",
        _evaluate,
        "the whole measurement: every method of the package at every plaque task",
        "evaluate with the methods of this package, the simple filters among them, at the paper's "
        "plaque, its variants, vessels of other directions, a sphere in muscle, line pairs and a "
        "low-contrast rod, with 200 realisations: hours on two cores; what is finished is cached.",
        "torchpcct dose-factor --task plaque --method mbir --method fbp:soft --n 40",
        before=METHODS_TEXT,
        out="folder for report.md, .json, .csv, .html and pictures (default out/dose-factor)",
    )
    parser.set_defaults(
        tasks=_STUDY_TASKS, methods=_STUDY_METHODS, scans=None, volumes=None, export=None
    )
    _add_common(parser, n=200)


def _add_common(parser: Parser, n: int) -> None:
    many = {"action": "append"}
    exposures = {"dest": "exposures_s", "nargs": "+", "limits": EXPOSURE}
    add_options(
        parser,
        ("--task", str, "TASK", "name (see show-task) or YAML file, repeatable", many),
        ("--method", str, "METHOD", "see below (repeatable)", many),
        (
            "--denoiser",
            str,
            "FUNCTION@BASE",
            "function of (volume) or (volume, sigma), HU, after BASE",
            many,
        ),
        ("--exposure", float, "S", "in s (default: those of each task)", exposures),
    )
    add_execution(parser)
    parser.set_defaults(realisations=n)
    add_options(
        parser,
        (
            "--n",
            int,
            None,
            f"noise realisations, at least 8 (default {n})",
            {"limits": REALISATIONS},
        ),
    )


def add_show_task(commands: Commands) -> None:
    parser = command(
        commands,
        "show-task",
        _show_task,
        "print a ready task as YAML; without a name list them",
        "Print a ready task as YAML, to copy and change. Without a name: all of them.",
        "torchpcct show-task nodule > mine.yaml",
    )
    add_options(parser, ("name", str, "NAME", "", {"nargs": "?"}))
