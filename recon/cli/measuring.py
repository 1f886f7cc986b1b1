"""The commands that measure: ``evaluate``, ``recovery``, ``dose-factor``, ``show-task``;
``compare``, ``hardcases``, ``study``, ``verify``."""

from __future__ import annotations

import argparse
import json
import shlex
import time
from pathlib import Path
from typing import TYPE_CHECKING

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
    find_modules_here,
)
from recon.cli.scans import add_reader_options, grid_of_scan, reader_options
from recon.names import METHODS
from recon.study import registry
from recon.study.names import check_case
from torchpcct.files import atomic_write, require_writable
from torchpcct.validate import choice

if TYPE_CHECKING:
    from collections.abc import Sequence

    from recon.evaluate.without_truth import Comparison
    from recon.study.study import ProgressBars, StudySettings
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
                f"--{name} is of measured scans and volumes: give it with --scans or --volumes"
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
    before = measured_before(out / "report.json", tasks, out / "pieces", **settings)
    methods = [*before, *(name for name in methods if name not in before)]
    with executing(arguments, out):
        found = evaluate(
            tasks,
            methods,
            exposures_s=arguments.exposures_s,
            n=n,
            seed=arguments.seed,
            folder=out / "pieces",
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
    """Measured scans or volumes, of which nobody knows the truth: table, page and files."""
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
                f"{flag} is of simulated tasks: leave it out with --scans and --volumes"
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
            "--reference names one of the --volumes; of --scans it is FBP with the kernel ram-lak"
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
                f"{flag} is of --scans: --volumes takes what lies in the two folders, a file a "
                "method"
            )
    if arguments.n is not None:
        raise ValueError(
            "--n is of --scans: two folders of volumes hold one pair of noise realisations"
        )
    for name in ("voxel", "extent", "center"):
        if getattr(arguments, name) is not None:
            raise ValueError(f"--{name} is of --scans: volumes say themselves where they lie")
    first, second = arguments.volumes
    reference = arguments.reference or "fbp"
    for folder in (first, second):
        if not folder.is_dir():
            raise ValueError(
                f"{folder} is no folder: --volumes takes two, with one volume a method in each"
            )
    stems = [volume_files(folder) for folder in (first, second)]
    names = [name for name in stems[0] if name in stems[1]]
    if reference not in names:
        raise ValueError(
            f"{first} and {second} hold {', '.join(names) or 'no volumes of one name'}: "
            "--reference names the one of a linear method that has smoothed nothing (FBP, kernel "
            "ram-lak)"
        )
    pairs = {name: [Volume.load(s[name]) for s in stems] for name in names}
    grid, unit = pairs[reference][0].grid, pairs[reference][0].unit
    for name, both in pairs.items():
        if any(not same_grid(v.grid, grid) or v.unit != unit for v in both):
            raise ValueError(
                f"{name} lies on another grid or has another unit than {reference}: "
                f"{both[0].grid}, {grid}"
            )
    data = {name: [v.data for v in both] for name, both in pairs.items()}
    base = data.pop(reference)
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
        try:
            parts = [
                slice(*(int(end) if end else None for end in part.split(":")))
                for part in text.split(",")
            ]
        except (ValueError, TypeError):
            parts = []
        if len(parts) != len(grid.shape):
            raise ValueError(
                f"--region {text}: neither a file nor ranges of voxels, Z0:Z1,Y0:Y1,X0:X1, of "
                f"{grid.shape} voxels"
            )
        mask[tuple(parts)] = True
    else:
        volume = Volume.load(text)
        if not same_grid(volume.grid, grid):
            raise ValueError(f"--region {text} lies on {volume.grid}, the volumes on {grid}")
        mask = np.asarray(volume.data) != 0
    if mask.sum() < 2:
        raise ValueError(f"--region {text} holds {int(mask.sum())} voxels: two or more are needed")
    return mask


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


# --- studies --------------------------------------------------------------------------------------


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
    from recon.jobs.store import Pieces  # loads torch

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


# --- parsing --------------------------------------------------------------------------------------


_METHODS_TEXT = """\
methods: fbp:KERNEL, pwls, mbir, mbir:fidelity=1, mbir:weights=FILE, mbir:vessel, mbir:tissues,
         mbir:prior=PRIOR (a filter below, or package.module:function),
         mbir:weights=FILE,network=package.module:Class,
         FILTER@fbp:KERNEL (gaussian, perona_malik, bilateral, nlm, tv, bm4d),
         package.module:function of (scan, grid), files:FOLDER;
         each with energies=CONTRAST among its options (fbp:soft,energies=iodine): energy bins
         summed with the weights that show the contrast best (task, iodine or two materials A/B)

"""
"""What the help says of methods."""


REALISATIONS = {"low": 8, "high": MANY}
"""Limits of numbers of noise realisations."""


def add_evaluate(commands: Commands) -> None:
    parser = command(
        commands,
        "evaluate",
        _evaluate,
        "how much dose does a method save at a task?",
        "Measure reconstruction methods, yours too, at tasks, ready or yours, on the same noise "
        "realisations: dose factors with intervals beside the Cramér–Rao bound, noise, error, "
        "contrast, detectability, pictures. Finished pieces are kept in the folder: the same "
        "command goes on after an interruption, and a second one with more methods computes only "
        "those.",
        "torchpcct evaluate --task nodule --method mbir --n 20",
        "torchpcct evaluate --task my.yaml --method mylab.nets:reconstruct --denoiser "
        "mylab.nets:denoise@fbp:detail",
        before=_METHODS_TEXT,
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
        group="measured scans and volumes, of which nobody knows the truth",
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


# --- recovery -------------------------------------------------------------------------------------


def _recovery(arguments: argparse.Namespace, progress: ProgressBars) -> None:
    from recon.evaluate.insertion import (
        InsertedBall,
        contrast_recovery,
        recovery_table,
    )
    from recon.evaluate.methods import names_module
    from torchpcct.formats.scans import open_scan

    balls = [InsertedBall(*pair) for pair in arguments.ball or _BALLS]
    methods = arguments.method or ["pwls", "mbir"]
    if any(map(names_module, methods)):
        find_modules_here()
    scan = open_scan(arguments.scan, **reader_options(arguments))
    found = contrast_recovery(
        scan,
        grid_of_scan(scan, arguments),
        methods,
        balls,
        places=arguments.at,
        n=arguments.n,
        seed=arguments.seed,
    )
    if arguments.json:
        print(json.dumps([row.as_dict() for row in found], indent=2))
    else:
        print(recovery_table(found))


_BALLS = ((0.5, 600.0), (1.0, 100.0), (1.0, -100.0), (2.0, 30.0))
"""Diameters in mm and contrasts in HU that are tried where none are named: a calcification, plaque
in fat and fat in plaque, what is faint."""


def add_recovery(commands: Commands) -> None:
    """Add the command."""
    parser = command(
        commands,
        "recovery",
        _recovery,
        "what a method would show of a lesion in your scan",
        "Insert balls of known size and contrast into the readings of a scan, measured or "
        "simulated, reconstruct it with and without them, and print how much of their contrast "
        "each method shows, beside soft FBP of the same scan. A method with a prior may show less "
        "of what is small or faint, the less the lower the dose.",
        "torchpcct recovery scan.h5 --method mbir --method pwls",
        "torchpcct recovery scan.h5 --ball 1.5 -60 --method mbir:fidelity=1",
        before=_METHODS_TEXT,
    )
    add_reader_options(parser)
    add_options(
        parser,
        (
            "--method",
            str,
            None,
            "to measure, repeat for more (default pwls, mbir)",
            {"action": "append"},
        ),
        (
            "--ball",
            float,
            ("MM", "HU"),
            "diameter and contrast, repeat for more (default 0.5 mm +600 HU, 1 mm ±100 HU, "
            "2 mm +30 HU)",
            {"nargs": 2, "action": "append"},
        ),
        (
            "--at",
            float,
            "MM",
            "middle of a ball, Z Y X, of one slice Y X; repeat for more (default: places in the "
            "object)",
            {"nargs": "+", "action": "append"},
        ),
        (
            "--n",
            int,
            None,
            "places, where none are named (default 8)",
            {"default": 8, "limits": {"low": 1, "high": MANY}},
        ),
        (
            "--seed",
            int,
            None,
            "of the places (default 0)",
            {"default": 0, "limits": {"low": 0, "high": MANY}},
        ),
        ("--json", bool, None, "print all figures as JSON"),
    )
    add_options(
        parser,
        ("--voxel", float, "MM", "voxel size (default: the detector's)", {"limits": LENGTH}),
        ("--extent", float, "MM", "edge lengths, Z Y X", {"nargs": "+", "limits": LENGTH}),
        ("--center", float, "MM", "centre, Z Y X", {"nargs": "+", "limits": PLACE}),
        group="voxels",
    )


def add_dose_factor(commands: Commands) -> None:
    parser = command(
        commands,
        "dose-factor",
        _evaluate,
        "the whole measurement: every method of the package at every plaque task",
        "evaluate with the methods of this package, the simple filters among them, at the paper's "
        "plaque, its variants, vessels of other directions, a sphere in muscle, line pairs and a "
        "low-contrast rod, with 200 realisations: hours on two cores, kept piece by piece.",
        "torchpcct dose-factor --task plaque --method mbir --method fbp:soft --n 40",
        before=_METHODS_TEXT,
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
        "do README and RESULTS.md say what the committed reports say?",
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
