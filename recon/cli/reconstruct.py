"""``torchpcct reconstruct``: one scan or many, whole or in slabs, here or on a cluster."""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import math
import shlex
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

# What loads torch or numba is imported by the commands: help and refusals come at once.
from recon.cli.parsing import (
    LENGTH,
    PLACE,
    PLAN_OPTIONS,
    Commands,
    add_execution,
    add_options,
    as_json,
    check_output,
    command,
    difference_beside,
    executing,
    find_modules_here,
    hint_of_missing,
    is_picture,
    length_of,
    motion_beside,
    without_ending,
    write_summary,
)
from recon.cli.scan_options import (
    add_reader_options,
    grid_of_scan,
    length,
    reader_options,
    require_voxels,
)
from recon.names import KERNELS, is_module_name, split_method
from torchpcct import VolumeGrid
from torchpcct.files import (
    VERSION,
    WriteError,
    atomic_write,
    fingerprint,
    require_folder,
    require_writable,
)
from torchpcct.formats.volume_files import check_target, is_own_volume
from torchpcct.validate import choice, memory_bytes

if TYPE_CHECKING:
    from recon.jobs.execute import Job
    from recon.slabs import ScanSlices
    from recon.study.study import ProgressBars
    from torchpcct.scan import Scan
    from torchpcct.typing import JsonObject
    from torchpcct.volume import Volume

_NO_SIZE = " (the file does not know their size: --pitch MM)"
"""Said of a file of unknown pixels."""
_DONE = ".done"
"""Ending of the note beside a finished volume of many."""
_FBP_RATE = 1e8
"""Voxel updates of the backprojection a second on one core, for a rough estimate."""


def _size(text: str) -> str:
    """``4GB`` of a command line, as it is."""
    try:
        memory_bytes(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a size such as 4GB or 500MiB") from None
    return text


_DIFFERENCE = "vessel_difference_hu"
"""Difference that a vessel model makes to the volume, in a report of MBIR."""
_OPTIONS = {
    "kernel": "fbp",
    **dict.fromkeys(("fidelity", "vessel", "tissues", "point", "weights", "network"), "mbir"),
}
"""Options that one method has."""


def _method_options(arguments: argparse.Namespace) -> dict[str, Any]:
    """Those that were given, with the method or beside it.

    Raises:
        ValueError: an option of another method, or given twice; a class without weights of it.
    """
    method, named = split_method(arguments.method)
    if arguments.kernel is not None:
        choice("kernel", arguments.kernel, KERNELS)
    given = {
        k: v
        for k, v in vars(arguments).items()
        if k in _OPTIONS and v is not None and v is not False
    }
    for name in given:
        if method != _OPTIONS[name]:
            option = name.replace("_", "-")
            raise ValueError(
                f"--{option} is an option of --method {_OPTIONS[name]}, not of {method}"
            )
        if name in named:
            raise ValueError(
                f"--{name} is given in --method {arguments.method}, too: leave out one of them"
            )
    given = named | given
    if "network" in given:
        if "weights" not in given:
            raise ValueError(
                "--network is the class of a network of your own: give its --weights FILE, too"
            )
        if not is_module_name(given["network"]):
            raise ValueError(f"--network must be package.module:Class, got {given['network']!r}")
    if any(is_module_name(given.get(name, "")) for name in ("network", "prior")):
        find_modules_here()
    return given


def _method(arguments: argparse.Namespace) -> str:
    """Its name without options."""
    return split_method(arguments.method)[0]


def _reconstruct(arguments: argparse.Namespace, progress: ProgressBars) -> None:
    """One scan, or many, each as if it were alone."""
    _method_options(arguments)
    elsewhere = arguments.workers or arguments.threads or arguments.scheduler
    if len(arguments.scan) == 1:
        arguments.scan = arguments.scan[0]
        if arguments.dry_run or not elsewhere:
            _reconstruct_scan(arguments, progress)
        elif arguments.memory is not None:  # by slabs, which are jobs
            with executing(arguments, (arguments.out or Path()).parent):
                _reconstruct_scan(arguments, progress)
        else:
            _reconstruct_elsewhere(arguments, progress)
        return
    from recon.jobs import execute

    folder: Path | None = arguments.out
    if folder is None:
        raise ValueError(f"{len(arguments.scan)} scans: --out FOLDER says where their volumes go")
    require_writable(folder)
    ending = ".nii.gz" if arguments.memory is None else ".nii"
    outs = [f"{without_ending(scan)}_{_method(arguments)}{ending}" for scan in arguments.scan]
    twice = {name for name in outs if outs.count(name) > 1}
    if twice:
        raise ValueError(
            f"several scans would become {', '.join(sorted(twice))}: give the files other names"
        )
    jobs = [_job(arguments, scan, out) for scan, out in zip(arguments.scan, outs, strict=True)]
    refused = []

    def print_outcome(name: str, messages: list[str], text: str, error: str) -> None:
        for warning in messages:
            arguments.warn(f"{name}: {warning}")
        refused.extend([f"{name}: {error}"] if error else [])
        print(text or f"{name}: {error}")

    with executing(arguments, folder) as executor:
        found = execute.run(jobs, folder, executor, progress) if executor is not None else {}
        for k, job in enumerate(jobs):
            progress("scans", k / len(jobs))
            outcome: Any = found[job.name] if found else job.function(folder, *job.args)
            print_outcome(job.name, *outcome)
    for out in outs:
        if _note(folder / f"{out}{_DONE}"):
            (folder / f"{out}{_DONE}").unlink(missing_ok=True)
    if refused:
        raise ValueError(
            f"{len(refused)} of {len(jobs)} scans are not reconstructed: {'; '.join(refused)}"
        )


def _reconstruct_elsewhere(arguments: argparse.Namespace, progress: ProgressBars) -> None:
    """One scan as a job of the workers that were asked for."""
    from recon.jobs import execute

    out = arguments.out or Path(f"{without_ending(arguments.scan)}_{_method(arguments)}.nii.gz")
    require_folder(out)
    with executing(arguments, out.parent) as executor:
        job = _job(arguments, arguments.scan, out.name)
        messages, text, error = execute.run([job], out.parent, executor, progress)[job.name]
    out.with_name(f"{out.name}{_DONE}").unlink(missing_ok=True)
    for message in messages:
        arguments.warn(message)
    if error:
        raise ValueError(error)
    print(text)


def _job(arguments: argparse.Namespace, scan: Path, out: str) -> Job:
    """The reconstruction of a scan into a folder's file ``out``."""
    from recon.jobs import execute

    common = {k: v for k, v in vars(arguments).items() if k not in ("run", "warn", "scan", "out")}
    mib = 4 * scan.stat().st_size / 2**20 if scan.is_file() else 0.0
    return execute.Job(
        str(scan),
        reconstruct_scan,
        ({**common, "scan": scan.resolve()}, out),
        (f"{out}*",),
        mib=mib,
    )


def reconstruct_scan(folder: Path, options: dict[str, Any], out: str) -> tuple[list[str], str, str]:
    """A scan of many, anywhere: warnings, what is printed, and why it is refused.

    A note lies beside a finished volume until all are: an interrupted command that is given again
    goes on, where scan, options and volume are what they were.
    """
    from recon.study.study import ProgressBars

    noted, scan = folder / f"{out}{_DONE}", options["scan"]
    asked = {
        k: str(v)
        for k, v in options.items()
        if k not in ("force", "no_progress", "workers", "threads", "scheduler", "command_line")
    }

    def state() -> JsonObject:
        return {
            "torchpcct": VERSION,
            "asked": asked,
            "scan": fingerprint(scan),
            "volume": fingerprint(folder / out),
        }

    note = _note(noted)
    with contextlib.suppress(OSError):
        if note and note["state"] == state():
            return note["messages"], f"{note['text']}, already there", ""
    messages: list[str] = []
    arguments = argparse.Namespace(**options, out=folder / out, warn=messages.append)
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        try:
            _reconstruct_scan(arguments, ProgressBars(False))
        except WriteError:
            raise
        except (ValueError, TypeError, OSError, ImportError, OverflowError) as error:
            return messages, "", str(error)
    text = printed.getvalue().rstrip()
    if not options["dry_run"] and (note or not noted.exists()):
        with atomic_write(noted) as part:
            part.write_text(
                json.dumps({"state": state(), "messages": messages, "text": text}), encoding="utf-8"
            )
    return messages, text, ""


def _note(path: Path) -> JsonObject:
    """What :func:`reconstruct_scan` noted beside a volume; empty: nothing, or the file is
    somebody else's."""
    try:
        note = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return note if isinstance(note, dict) and {"state", "messages", "text"} <= note.keys() else {}


def _reconstruct_scan(arguments: argparse.Namespace, progress: ProgressBars) -> None:
    options, method = _method_options(arguments), _method(arguments)
    slabs = arguments.memory is not None
    if arguments.motion is not None:
        if slabs:
            raise ValueError("--memory works slab by slab, without --motion: leave out one of them")
        options["motion"] = arguments.motion
    if arguments.out is None:
        arguments.out = Path(
            f"{without_ending(arguments.scan)}_{method}.nii{'' if slabs else '.gz'}"
        )
    check_target(arguments.out)
    check_output(arguments, is_own_volume, arguments.scan, arguments.geometry, beside=True)
    if arguments.motion is not None:
        for path, is_own in zip(
            motion_beside(arguments.out), (_is_path_table, is_picture), strict=True
        ):
            check_output(argparse.Namespace(**{**vars(arguments), "out": path}), is_own)
    for name in ("extent", "center"):
        given = getattr(arguments, name)
        if given is not None and len(given) not in (2, 3):
            raise ValueError(
                f"--{name} must be three numbers, Z Y X, of slices two, Y X; got {len(given)}"
            )
    if arguments.voxel is not None and not slabs:
        require_voxels(
            tuple(math.ceil(e / arguments.voxel) for e in arguments.extent or (1.0, 1.0, 1.0))
        )
    if not arguments.scan.exists():
        raise FileNotFoundError(
            f"{arguments.scan} does not exist{hint_of_missing('scan', arguments.scan)}"
        )
    import yaml

    from recon.api import reconstruct
    from torchpcct.formats.scans import open_scan

    if slabs:
        if arguments.device != "cpu":
            raise ValueError(
                "--memory works slab by slab, on the CPU: leave out --memory or "
                f"--device {arguments.device}"
            )
        _reconstruct_slabs(arguments, options, progress)
        return
    scan = open_scan(arguments.scan, **reader_options(arguments))
    if arguments.find_axis:
        from torchpcct.formats.preprocess import centred, find_axis

        axis = find_axis(scan)
        scan = centred(scan, axis)
        if not arguments.json:
            print(f"{axis} (found from {axis.how})")
    if arguments.clean:
        from torchpcct.formats.preprocess import cleaned

        scan = cleaned(scan)
    grid = grid_of_scan(scan, arguments)
    require_voxels(grid.shape)
    check_target(arguments.out, grid.voxels, scan.unit)
    config = _config(arguments, scan, grid, options)
    if arguments.dry_run:
        bytes_ = 4 * (3 * scan.counts.numel() + 2 * grid.voxels)
        seconds = grid.voxels * scan.geometry.views / _FBP_RATE
        if arguments.json:
            estimate = {"file": str(arguments.out), "gib": bytes_ / 2**30, "fbp_seconds": seconds}
            print(as_json({**config, "estimate": estimate}))
            return
        print(yaml.safe_dump(config, sort_keys=False, allow_unicode=True))
        print(
            f"{arguments.out}: about {bytes_ / 2**30:.2f} GiB; FBP about {seconds:.1f} s on one "
            "core, iterative methods many times that"
        )
        return
    if "weights" in options:
        from recon.mbir.mbir import Mbir

        options["network"] = Mbir.load(options.pop("weights"), network=options.pop("network", None))
    volume = reconstruct(
        scan, grid, method, progress=progress.of(method), device=arguments.device, **options
    )
    progress.close()
    placed = {"axis": scan.info["axis"]} if arguments.find_axis else {}
    volume = replace(volume, report={**volume.report, **placed, **_provenance(arguments)}).slices()
    changed = volume.report.get(_DIFFERENCE)
    if changed is not None:
        beside = difference_beside(arguments.out)
        replace(volume, data=changed, report={}).save(beside)
        volume = replace(volume, report={**volume.report, _DIFFERENCE: beside.name})
    if arguments.motion is not None:
        volume = _with_path(volume, *motion_beside(arguments.out))
    volume.save(arguments.out)
    report = {**volume.report, "mean": float(volume.data.mean())}
    _write_volume_summary(arguments, config, volume.grid, volume.unit, report)


def _is_path_table(path: Path) -> bool:
    """Whether a file is a table of a path, as :func:`recon.motion.path_table` writes it."""
    from recon.motion.path import TABLE_HEADER

    with path.open("rb") as file:
        return file.read(200).split(b"\n")[0].decode("utf-8", "replace") == ",".join(TABLE_HEADER)


def _with_path(volume: Volume, table: Path, picture: Path) -> Volume:
    """The volume with the names of the files in its report to which its path was written."""
    from recon.motion import path_figure, path_table

    motion = volume.report["motion"]
    with atomic_write(table) as part:
        part.write_text(path_table(motion), encoding="utf-8")
    with atomic_write(picture) as part:
        path_figure(motion).savefig(part, format="png")
    named = {**motion, "table": table.name, "picture": picture.name}
    return replace(volume, report={**volume.report, "motion": named})


def _config(
    arguments: argparse.Namespace,
    scan: Scan | ScanSlices,
    grid: VolumeGrid,
    options: dict[str, Any],
) -> JsonObject:
    from torchpcct.formats.geometry_yaml import geometry_values

    return {
        "scan": str(arguments.scan),
        "geometry": geometry_values(scan.geometry),
        "method": _method(arguments),
        "grid": {
            "shape": list(grid.shape),
            "spacing": list(grid.spacing),
            "center": list(grid.center),
        },
        "unit": scan.unit,
        "clean": arguments.clean,
        **{k: v if k != "weights" else str(v) for k, v in options.items()},
    }


def _provenance(arguments: argparse.Namespace) -> JsonObject:
    return {
        "torchpcct": VERSION,
        "command": shlex.join(["torchpcct", *arguments.command_line]),
        "input": str(arguments.scan),
        "input_sha256": fingerprint(arguments.scan),
    }


def _reconstruct_slabs(
    arguments: argparse.Namespace, options: dict[str, Any], progress: ProgressBars
) -> None:
    """``--memory``: slab by slab (:mod:`recon.slabs`)."""
    import yaml

    from recon.slabs import ScanSlices, plan_slabs, reconstruct_to
    from torchpcct.formats.volume_slabs import check_slab_name

    check_slab_name(arguments.out)
    for name, remedy in (
        ("clean", "filters over all slices"),
        ("find_axis", "give --axis COLUMN, which --find-axis --slices A:B of a few slices finds,"),
    ):
        if getattr(arguments, name):
            raise ValueError(
                f"--{name.replace('_', '-')} is not done slab by slab: {remedy} or leave out "
                "--memory"
            )
    reader = reader_options(arguments)
    if reader.pop("slices", None) is not None:
        raise ValueError(
            "--memory takes all slices of the scan: leave out --slices, or reconstruct those "
            "without --memory"
        )
    source = ScanSlices(arguments.scan, **reader)
    grid = grid_of_scan(source, arguments)
    check_target(arguments.out, grid.voxels, source.unit)
    config = {**_config(arguments, source, grid, options), "memory": arguments.memory}
    method = _method(arguments)
    plan = plan_slabs(source.geometry, grid, arguments.memory, method)
    if arguments.dry_run:
        if arguments.json:
            print(as_json({**config, "estimate": {"file": str(arguments.out), **asdict(plan)}}))
        else:
            print(yaml.safe_dump(config, sort_keys=False, allow_unicode=True))
            print(f"{arguments.out}: {plan}")
        return
    if not arguments.json:
        print(plan)
    report = reconstruct_to(
        source,
        grid,
        arguments.out,
        method,
        memory=arguments.memory,
        progress=progress.of(method),
        **options,
    )
    progress.close()
    _write_volume_summary(
        arguments, config, grid, source.unit, {**report, **_provenance(arguments)}
    )


def _write_volume_summary(
    arguments: argparse.Namespace,
    config: JsonObject,
    grid: VolumeGrid,
    unit: str,
    report: JsonObject,
) -> None:
    size = " × ".join(map(str, grid.shape))
    spacing = " × ".join(f"{s:.4g}" for s in grid.spacing)
    length = length_of(unit)
    noted = _NO_SIZE if length == "pixels" else ""
    short = f"{size} voxels of {spacing} {length}{noted}, "
    short += f"{arguments.method}, mean {report['mean']:.4g} {unit}, {report['seconds']} s"
    short += "".join(f"\n  {text}" for text in report.get("notes", []))
    for text in report.get("warnings", []):
        arguments.warn(text)
    place = {f"spacing_{length}": list(grid.spacing), f"center_{length}": list(grid.center)}
    write_summary(arguments, short, config, shape=list(grid.shape), **place, unit=unit, **report)


def add_reconstruct(commands: Commands) -> None:
    parser = command(
        commands,
        "reconstruct",
        _reconstruct,
        "reconstruct a scan file to a volume",
        "Reconstruct a scan, of torchpcct or of another program, and write the volume, with a "
        "record of the command beside it (.json, .yaml). Volumes of many scans are written into a "
        "folder, each as SCAN_METHOD.nii.gz.",
        "torchpcct reconstruct tooth.h5 --find-axis --out tooth.nii.gz",
        "torchpcct reconstruct scan.h5 --method mbir --fidelity 1 --out mbir.nii.gz",
        "torchpcct reconstruct scans/*.h5 --out volumes --workers 4",
        out="folder of many scans; of one, volume to write: .nii, .nii.gz, .mha, .h5, .zarr, or "
        "no ending for DICOM "
        "(default SCAN_METHOD.nii.gz)",
        draws=False,
        on_device=True,
    )
    own = "for separate slices only Y X"
    add_options(
        parser,
        (
            "--method",
            str,
            None,
            "fbp, pwls or mbir (default fbp); with options as evaluate has them: "
            "mbir:prior=perona-malik, or mbir:prior=package.module:function in the network's place",
            {"default": "fbp"},
        ),
        (
            "--kernel",
            str,
            None,
            "of FBP, from quiet to sharp: soft, standard (default), detail, bone, ram-lak",
        ),
        (
            "--fidelity",
            float,
            "F",
            "of MBIR, from 0 (quiet) to 1 (more contrast and noise; default 0.5)",
            {"limits": {"low": 0.0, "high": 1.0}},
        ),
        (
            "--vessel",
            bool,
            None,
            "MBIR of an inset: fit a vessel with smooth outlines to the data first, and let the "
            "network reconstruct the rest; sharper, but disease with other outlines may be "
            "missing. The difference from the volume without it is written to a second file",
        ),
        (
            "--tissues",
            bool,
            None,
            "MBIR of an inset: fit the vessel's tissues (values and a core) to the data first",
        ),
        (
            "--weights",
            Path,
            "FILE",
            "of MBIR, from your own training (default: those that ship)",
            {"read": True},
        ),
        ("--network", str, "MODULE:CLASS", "with --weights: the class of a network of your own"),
        (
            "--point",
            float,
            ("Z", "Y", "X"),
            "with --tissues: where a reader sees the plaque, mm",
            {"nargs": 3, "limits": PLACE},
        ),
        (
            "--motion",
            str,
            None,
            "estimate: find the rigid motion of an inset (a scan with region) from its readings, "
            "and take it out; the path with its errors is in the report, and beside the volume as "
            "_motion.csv and _motion.png",
            {"choices": ["estimate"]},
        ),
        group="method",
    )
    add_options(
        parser,
        (
            "--voxel",
            float,
            "MM",
            "voxel size (default: the region's or the detector's)",
            {"limits": LENGTH},
        ),
        (
            "--center",
            length,
            "MM",
            f"centre, Z Y X (default: region or axis); {own}",
            {"nargs": "+", "limits": PLACE},
        ),
        (
            "--extent",
            length,
            "MM",
            f"edge lengths, Z Y X (default: what is seen); {own}",
            {"nargs": "+", "limits": LENGTH},
        ),
        (
            "--memory",
            _size,
            "SIZE",
            "limit of a process, e.g. 4GB, for volumes larger than memory: slab by slab, by "
            "--workers too, to .nii or .zarr (default SCAN_METHOD.nii); after an interruption the "
            "same command goes on",
        ),
        group="voxels",
    )
    add_reader_options(parser, many=True)
    add_options(
        parser,
        (
            "--find-axis",
            bool,
            None,
            "find the rotation axis: of a full turn, or half a turn of parallel rays",
        ),
        ("--clean", bool, None, "take out stripes and outliers (parallel and fan beams)"),
        group="corrections of the scan",
    )
    add_options(parser, *PLAN_OPTIONS)
    add_execution(parser, dry_run=False)
