"""The commands that make files: ``simulate``, ``show-config``, ``reconstruct``, ``calibrate``,
``lower-dose``."""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import math
import re
import shlex
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

# What loads torch or numba is imported by the commands: help and refusals come at once.
from recon.cli.parsing import (
    EXPOSURE,
    LENGTH,
    MANY,
    PLACE,
    SCAN_ENDINGS,
    Commands,
    Parser,
    add_execution,
    add_options,
    as_json,
    check_ending,
    check_output,
    command,
    executing,
    find_modules_here,
    is_picture,
    length_of,
    map_beside,
    motion_beside,
    tell,
    without_ending,
)
from recon.names import KERNELS, is_module_name, split_method
from torchpcct import VolumeGrid
from torchpcct.files import (
    VERSION,
    WriteError,
    atomic_write,
    fingerprint,
    is_own_hdf5,
    require_folder,
    require_writable,
)
from torchpcct.formats.volume_files import check_target, is_own_volume
from torchpcct.validate import choice, memory_bytes

if TYPE_CHECKING:
    from recon.jobs.execute import Job
    from recon.slabs import ScanSlices
    from recon.study.study import ProgressBars
    from torchpcct.acquisition.config import SimulationConfig
    from torchpcct.scan import Scan
    from torchpcct.scene.voxels import VoxelScene
    from torchpcct.typing import JsonObject
    from torchpcct.volume import Volume

_PAPER_VIEWS = 1968
"""Views of a turn in the paper."""
MOST_VOXELS = 2**31
"""Of a volume, 8 GiB: what is asked for beyond is a slip of the voxel size."""
_NO_SIZE = " (the file does not know their size: --pitch MM)"
"""Said of a file of unknown pixels."""
_DONE = ".done"
"""Ending of the note beside a finished volume of many."""
_FBP_RATE = 1e8
"""Voxel updates of the backprojection a second on one core, for a rough estimate."""


# --- simulate -------------------------------------------------------------------------------------


def _paper(arguments: argparse.Namespace) -> SimulationConfig:
    """The paper's plaque scan, from the options alone."""
    from recon.study.paper.plaque_scan import inset_grid
    from torchpcct.acquisition.config import SimulationConfig
    from torchpcct.scanner import presets
    from torchpcct.scene.plaque import plaque_scene

    scene, plaque = plaque_scene()
    views = _PAPER_VIEWS if arguments.views is None else arguments.views
    region = None if arguments.whole else inset_grid(plaque, 0.25)
    kept = (
        None
        if region is None
        else {
            "shape": list(region.shape),
            "spacing": list(region.spacing),
            "center": list(region.center),
        }
    )
    values = {
        "scene": {"kind": "plaque"},
        "scanner": {"preset": "pcct", "views": views},
        "exposure_s": arguments.exposure,
        "seed": arguments.seed or 0,
        "region": kept,
        "tolerance_hu": 0.5,
    }
    return SimulationConfig(
        scene, presets.pcct(views=views), region, arguments.exposure, values["seed"], 0.5, values
    )


def _simulate(arguments: argparse.Namespace, progress: ProgressBars) -> None:
    check_ending(arguments.out, SCAN_ENDINGS)
    check_output(arguments, _is_scan, arguments.config, beside=True)
    if arguments.config is not None and (arguments.views is not None or arguments.whole):
        raise ValueError(
            "--views and --whole are the plaque scan's: put views and region into the configuration"
        )
    from torchpcct.acquisition.acquire import acquire, plan, readings_key
    from torchpcct.acquisition.config import read_config
    from torchpcct.acquisition.kept import ReadingsFolder
    from torchpcct.scene.voxels import VoxelScene

    if arguments.config is None:
        config = _paper(arguments)
    else:
        config = read_config(arguments.config, exposure_s=arguments.exposure, seed=arguments.seed)
        check_output(arguments, _is_scan, config.values["scene"].get("file"), beside=True)
    voxels = isinstance(config.scene, VoxelScene)
    if arguments.dry_run:
        import yaml

        print(yaml.safe_dump(config.values, sort_keys=False, allow_unicode=True))
        print(
            _voxel_plan(config, config.scene)
            if isinstance(config.scene, VoxelScene)
            else plan(
                config.scene,
                config.scanner,
                region=config.region,
                tolerance_hu=config.tolerance_hu,
                rotation_s=config.exposure_s,
            ).table()
        )
        return
    options: dict[str, Any] = (
        {} if voxels else {"region": config.region, "tolerance_hu": config.tolerance_hu}
    )
    if not isinstance(config.scene, VoxelScene) and not arguments.fresh:
        options["keep"] = ReadingsFolder(
            readings_key(config.scene, config.scanner, rotation_s=config.exposure_s, **options)
        )
    scan = acquire(
        config.scene,
        config.scanner,
        exposure_s=config.exposure_s,
        seed=config.seed,
        progress=progress.of("simulate"),
        **options,
    )
    progress.close()
    scan.save(arguments.out)
    mean = float(scan.counts.mean())
    short = (
        f"{' × '.join(map(str, scan.counts.shape))} readings, mean {mean:.4g}, "
        f"{scan.info['seconds']} s"
    )
    if voxels:
        short += f"; {_dense(scan.info['plan']['above_muscle'])}"
    tell(
        arguments,
        short,
        config.values,
        readings=list(scan.counts.shape),
        exposure_s=scan.exposure_s,
        seed=scan.seed,
        mean_count=mean,
        **scan.info,
    )


def _is_scan(path: Path) -> bool:
    return is_own_hdf5(path, "scan")


def _voxel_plan(config: SimulationConfig, scene: VoxelScene) -> str:
    g = config.scanner.geometry
    readings = math.prod(g.shape)
    return (
        f"{readings / 1e6:.2f} M readings of a voxel volume, about {readings * 4 * 2 / 2**30:.2f} "
        "GiB\n"
        f"{_dense(scene.above_muscle)}"
    )


def _dense(shares: dict[str, float]) -> str:
    """What is above muscle, and what it is scanned as."""
    listed = ", ".join(f"{share:.1%} of the voxels as {name}" for name, share in shares.items())
    return f"above muscle, scanned (scene.dense): {listed}"


_OUTPUT = (
    ("--dry-run", bool, None, "print the plan, memory and time; compute nothing"),
    ("--json", bool, None, "print the whole summary as JSON"),
)
"""Options of commands that make scans."""


def add_simulate(commands: Commands) -> None:
    parser = command(
        commands,
        "simulate",
        _simulate,
        "simulate a scan to an HDF5 file",
        "Simulate a scan of any scene (--config, see show-config) or, without one, of the paper's "
        "plaque by the deep-silicon PCCT, and write it to HDF5, with what was done beside (.json, "
        ".yaml).",
        "torchpcct simulate --exposure 2 --out plaque.h5",
        "torchpcct show-config > scene.yaml; torchpcct simulate --config scene.yaml --out scan.h5",
        out="HDF5 file to write",
        required=True,
        seed=None,
    )
    add_options(
        parser,
        ("--config", Path, "YAML", "scene, scanner and exposure", {"read": True}),
        ("--exposure", float, "S", "exposure in s (default: noise free)", {"limits": EXPOSURE}),
        (
            "--views",
            int,
            None,
            f"views per rotation of the plaque scan (default {_PAPER_VIEWS})",
            {"limits": {"high": MANY}},
        ),
        ("--whole", bool, None, "keep the whole detector, not only the plaque's surroundings"),
        (
            "--fresh",
            bool,
            None,
            "compute the expected readings, also where an earlier call with another seed kept them",
        ),
        *_OUTPUT,
    )


def _show_config(arguments: argparse.Namespace, progress: ProgressBars) -> None:
    from torchpcct.acquisition.config import EXAMPLE
    from torchpcct.formats.stack import EXAMPLE as STACK_EXAMPLE

    print(STACK_EXAMPLE if arguments.stack else EXAMPLE, end="")


def add_show_config(commands: Commands) -> None:
    parser = command(
        commands,
        "show-config",
        _show_config,
        "print a full example for simulate --config, or of a .yaml stack",
        "Print a full YAML example: for simulate --config, or, with --stack, of a stack of "
        "projections.",
        "torchpcct show-config > scene.yaml",
        "torchpcct show-config --stack > projections.yaml",
    )
    add_options(parser, ("--stack", bool, None, "the file beside TIFF or NumPy projections"))


# --- reconstruct ----------------------------------------------------------------------------------


def _size(text: str) -> str:
    """``4GB`` of a command line, as it is."""
    try:
        memory_bytes(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no size such as 4GB or 500MiB") from None
    return text


def _slices(text: str) -> slice:
    """``A:B`` of a command line, either end left out."""
    found = re.fullmatch(r"\s*(\d*):(\d*)\s*", text)
    if not found or found[1] == found[2] == "":
        raise argparse.ArgumentTypeError(
            f"{text!r} is not A:B, the first slice and the one after the last, from 0"
        )
    first, stop = (int(end) if end else None for end in found.groups())
    if first is not None and stop is not None and first >= stop:
        raise argparse.ArgumentTypeError(
            f"{text!r} holds no slice: the second number must be the larger one"
        )
    return slice(first, stop)


def add_reader_options(parser: Parser, many: bool = False) -> None:
    """The scan, or many of them, and what its file may not know, see :func:`reader_options`."""
    nargs = {"nargs": "+"} if many else {"read": True}
    formats = (
        ".h5 (ours, Data Exchange, NeXus), .yaml stack, .xtekct, .txrm, .mat, CatSim, "
        "DICOM-CT-PD folder"
    )
    add_options(parser, ("scan", Path, "SCAN", formats, nargs))
    add_options(
        parser,
        (
            "--geometry",
            Path,
            "YAML",
            "geometry of files that do not hold it; one with kind: vectors, kind: rtk or "
            "pose: takes the place of the file's own",
            {"read": True},
        ),
        (
            "--mu-water",
            float,
            "MM⁻¹",
            "attenuation of water; with it the volume is in HU",
            {"limits": {**LENGTH, "unit": "mm⁻¹"}},
        ),
        (
            "--axis",
            float,
            "COLUMN",
            "where the rotation axis projects to, counted from 0",
            {"limits": {"low": 0.0, "high": 1e6}},
        ),
        (
            "--pitch",
            float,
            "MM",
            "cell width of parallel beams, where the file does not hold it",
            {"limits": LENGTH},
        ),
        (
            "--photons",
            float,
            "N",
            "photons of an unattenuated reading, of scans given as line integrals",
            {"limits": {"positive": True, "high": 1e18}},
        ),
        ("--slices", _slices, "A:B", "read only these slices (parallel, fan) or rows (cone beam)"),
        (
            "--angles-deg",
            _angles,
            "FILE|START:STEP",
            "angles of Data Exchange and NeXus in degrees: a text file with one a line, or the "
            "first and their step",
        ),
        (
            "--air",
            _number_or_file,
            "N|FILE",
            "reading without the object, of files that hold none: a number, or .tif, "
            ".npy, a pattern",
        ),
        ("--dark", _number_or_file, "N|FILE", "reading without beam, as --air"),
        ("--entry", str, "NAME", "of a NeXus file with several scans"),
        ("--variable", str, "NAME", "of a MATLAB file with several arrays"),
        (
            "--spot",
            int,
            "K",
            "of a flying focal spot: only the views from its position K",
            {"limits": {"low": 0, "high": 63}},
        ),
        group="what the file does not know of its scan",
    )


def _number_or_file(text: str) -> float | str:
    """A number, or a file or pattern by its full path: workers may stand in another folder."""
    try:
        value = float(text)
    except ValueError:
        return _there(text)
    if not math.isfinite(value) or value < 0:
        raise argparse.ArgumentTypeError(
            f"{text!r} is no reading: a finite number of 0 or more, or a file"
        )
    return value


def _there(text: str) -> str:
    """A file that is there, or a pattern, by its full path."""
    path = Path(text).absolute()
    if not text.strip():
        raise argparse.ArgumentTypeError("it is empty")
    if not path.exists() and not any(c in text for c in "*?["):
        raise argparse.ArgumentTypeError(f"{text!r} is neither a number nor a file that is there")
    return str(path)


def _angles(text: str) -> dict[str, float] | str:
    """``START:STEP`` in degrees, or a text file by its full path."""
    try:
        start, step = map(float, text.split(":"))
    except ValueError:
        return _there(text)
    if not math.isfinite(start) or not math.isfinite(step) or step == 0:
        raise argparse.ArgumentTypeError(f"{text!r}: start and step must be finite, the step not 0")
    return {"start": start, "step": step}


_READ_WITH = (
    "axis",
    "pitch",
    "mu_water",
    "photons",
    "angles_deg",
    "air",
    "dark",
    "entry",
    "variable",
    "spot",
)
"""Options that a scan's file is read with."""


def reader_options(arguments: argparse.Namespace) -> dict[str, Any]:
    """What the command line says of the scan's file beside it."""
    given = {name: getattr(arguments, name) for name in _READ_WITH}
    options: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    if arguments.slices is not None:
        options["slices"] = arguments.slices
    if arguments.geometry is not None:
        from torchpcct.formats.damage import read_yaml, reading
        from torchpcct.formats.geometry_yaml import geometry_of

        values = read_yaml(arguments.geometry, "a geometry")
        with reading(arguments.geometry, "a geometry"):
            options["geometry"] = geometry_of(values, arguments.geometry.parent)
    return options


def grid_of_scan(scan: Scan | ScanSlices, arguments: argparse.Namespace) -> VolumeGrid:
    """The grid that was asked for, see :meth:`torchpcct.VolumeGrid.of`."""
    return VolumeGrid.of(
        scan, voxel=arguments.voxel, extent=arguments.extent, center=arguments.center
    )


def _length(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"{text!r} is no length in mm (a file stands before this option)"
        ) from None


def _require_voxels(shape: tuple[int, ...]) -> None:
    if math.prod(shape) > MOST_VOXELS:
        raise ValueError(
            f"--voxel makes {' × '.join(map(str, shape))} voxels, more than {MOST_VOXELS:.0e}: "
            "enlarge the voxels, or reconstruct a smaller --extent"
        )


_MAP = "drawn_minus_plain_hu"
"""What a drawn vessel has changed, in a report of MBIR."""
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
                f"--{name} stands in --method {arguments.method}, too: leave out one of them"
            )
    given = named | given
    if "network" in given:
        if "weights" not in given:
            raise ValueError(
                "--network is the class of weights of yours: give it with --weights FILE"
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
        _require_voxels(
            tuple(math.ceil(e / arguments.voxel) for e in arguments.extent or (1.0, 1.0, 1.0))
        )
    if not arguments.scan.exists():
        raise FileNotFoundError(f"{arguments.scan} does not exist (torchpcct simulate makes scans)")
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
    _require_voxels(grid.shape)
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
    changed = volume.report.get(_MAP)
    if changed is not None:
        beside = map_beside(arguments.out)
        replace(volume, data=changed, report={}).save(beside)
        volume = replace(volume, report={**volume.report, _MAP: beside.name})
    if arguments.motion is not None:
        volume = _with_path(volume, *motion_beside(arguments.out))
    volume.save(arguments.out)
    report = {**volume.report, "mean": float(volume.data.mean())}
    _tell_volume(arguments, config, volume.grid, volume.unit, report)


def _is_path_table(path: Path) -> bool:
    """Whether a file is a table of a path, as :func:`recon.motion_path.path_table` writes it."""
    from recon.motion_path import TABLE_HEADER

    with path.open("rb") as file:
        return file.read(200).split(b"\n")[0].decode("utf-8", "replace") == ",".join(TABLE_HEADER)


def _with_path(volume: Volume, table: Path, picture: Path) -> Volume:
    """The volume with the names of the files in its report to which its path was written."""
    from recon.motion_path import path_figure, path_table

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
    _tell_volume(arguments, config, grid, source.unit, {**report, **_provenance(arguments)})


def _tell_volume(
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
    tell(arguments, short, config, shape=list(grid.shape), **place, unit=unit, **report)


def add_reconstruct(commands: Commands) -> None:
    parser = command(
        commands,
        "reconstruct",
        _reconstruct,
        "reconstruct a scan file to a volume",
        "Reconstruct a scan, ours or a foreign one, and write the volume, with what was done "
        "beside (.json, .yaml). Many scans go into a folder, each SCAN_METHOD.nii.gz.",
        "torchpcct reconstruct tooth.h5 --find-axis --out tooth.nii.gz",
        "torchpcct reconstruct scan.h5 --method mbir --fidelity 1 --out mbir.nii.gz",
        "torchpcct reconstruct scans/*.h5 --out volumes --workers 4",
        out="folder of many scans; of one, volume to write: .nii, .nii.gz, .mha, .h5, .zarr, or "
        "no ending for DICOM "
        "(default SCAN_METHOD.nii.gz)",
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
            _length,
            "MM",
            f"centre, Z Y X (default: region or axis); {own}",
            {"nargs": "+", "limits": PLACE},
        ),
        (
            "--extent",
            _length,
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
    add_options(parser, *_OUTPUT)
    add_execution(parser, dry_run=False)


# --- calibrate ------------------------------------------------------------------------------------


_CALIBRATED = "# torchpcct calibrate: "
"""How a geometry begins that ``calibrate`` has written."""


def _calibrate(arguments: argparse.Namespace, progress: ProgressBars) -> None:
    if arguments.out is None:
        arguments.out = Path(f"{without_ending(arguments.scan)}_geometry.yaml")
    check_ending(arguments.out, (".yaml", ".yml"))
    check_output(arguments, _is_calibrated, arguments.scan, arguments.geometry)
    import yaml

    from recon.calibration import calibrate
    from torchpcct.formats.geometry_yaml import geometry_values
    from torchpcct.formats.scans import open_scan
    from torchpcct.vector_geometry import VectorGeometry

    scan = open_scan(arguments.scan, **reader_options(arguments))
    grid = grid_of_scan(scan, arguments)
    _require_voxels(grid.shape)
    names = None
    if arguments.free is not None:
        names = [name.strip() for name in arguments.free.split(",") if name.strip()]
    found = calibrate(scan, grid, names, progress=progress.of("calibrate"))
    progress.close()
    # Vectors, which take the place of what a file says of itself.
    made = found.geometry
    vectors = made if isinstance(made, VectorGeometry) else VectorGeometry.of(made)
    about = [f"{_CALIBRATED}{arguments.scan.name}", *str(found).splitlines()]
    text = "\n# ".join(about) + "\n"
    text += yaml.safe_dump(geometry_values(vectors), sort_keys=False, default_flow_style=None)
    with atomic_write(arguments.out) as part:
        part.write_text(text, encoding="utf-8")
    if arguments.json:
        print(as_json({"file": str(arguments.out), **found.report()}))
        return
    print(found)
    print(
        f"{arguments.out}: torchpcct reconstruct {shlex.quote(str(arguments.scan))} "
        f"--geometry {shlex.quote(str(arguments.out))}"
    )


def _is_calibrated(path: Path) -> bool:
    try:
        with path.open(encoding="utf-8") as file:
            return file.readline().startswith(_CALIBRATED)
    except (OSError, ValueError):
        return False


def add_calibrate(commands: Commands) -> None:
    parser = command(
        commands,
        "calibrate",
        _calibrate,
        "find a scan's geometry from the object itself",
        "Find numbers of a scan's geometry from its readings, with standard errors, and write the "
        "geometry for reconstruct --geometry. The whole object must be seen in all views. What "
        "the readings do not determine is refused.",
        "torchpcct calibrate tooth.h5 --free offset,roll --out tooth.yaml",
        "torchpcct reconstruct tooth.h5 --geometry tooth.yaml --out tooth.nii.gz",
        out="geometry to write, .yaml (default SCAN_geometry.yaml)",
    )
    add_options(
        parser,
        (
            "--free",
            str,
            "NAMES",
            "what to find, of offset (the detector's, along the columns), axis (off the line from "
            "the source that meets the detector upright), row_offset, roll, tilt, slant, sdd, "
            "with commas (default offset, of a detector with rows offset,roll)",
        ),
    )
    own = "for separate slices only Y X"
    add_options(
        parser,
        (
            "--voxel",
            float,
            "MM",
            "voxel size (default: of a detector cell at the axis)",
            {"limits": LENGTH},
        ),
        (
            "--center",
            _length,
            "MM",
            f"centre, Z Y X (default: the axis); {own}",
            {"nargs": "+", "limits": PLACE},
        ),
        (
            "--extent",
            _length,
            "MM",
            f"edge lengths, Z Y X (default: what is seen); {own}",
            {"nargs": "+", "limits": LENGTH},
        ),
        group="voxels",
    )
    add_reader_options(parser)
    add_options(parser, ("--json", bool, None, "print all numbers as JSON"))


# --- lower-dose -----------------------------------------------------------------------------------


def _lower_dose(arguments: argparse.Namespace, progress: ProgressBars) -> None:
    if arguments.out is None:
        arguments.out = Path(f"{without_ending(arguments.scan)}_{arguments.fraction:g}.h5")
    check_ending(arguments.out, SCAN_ENDINGS)
    check_output(arguments, _is_scan, arguments.scan, arguments.geometry, beside=True)
    from torchpcct.formats.geometry_yaml import geometry_values
    from torchpcct.formats.scans import open_scan

    scan = open_scan(arguments.scan, **reader_options(arguments)).at_dose(
        arguments.fraction, arguments.seed
    )
    scan.save(arguments.out)
    note = scan.info["lower_dose"]
    how = (
        "photons thinned, exact"
        if note["exact"]
        else "mean and variance right, higher moments approximate"
    )
    short = (
        f"{' × '.join(map(str, scan.counts.shape))} readings at {arguments.fraction:g} of the "
        f"dose ({how})"
    )
    config = {"scan": str(arguments.scan), "geometry": geometry_values(scan.geometry), **note}
    tell(
        arguments,
        short,
        config,
        readings=list(scan.counts.shape),
        exposure_s=scan.exposure_s,
        **note,
    )


def add_lower_dose(commands: Commands) -> None:
    parser = command(
        commands,
        "lower-dose",
        _lower_dose,
        "a measured scan as if it had been taken with less dose",
        "Write a scan, ours or a foreign one, as it would have been at a fraction of its dose, "
        "noise included. Photon counts are thinned, which is exact; other readings get the right "
        "mean and variance. Refused where the number of photons is not known.",
        "torchpcct lower-dose scan.h5 --fraction 0.25 --out quarter.h5",
        out="HDF5 file to write (default SCAN_FRACTION.h5)",
    )
    add_reader_options(parser)
    limits = {"positive": True, "high": 1.0}
    add_options(
        parser,
        ("--fraction", float, "F", "of the dose, 0 < F ≤ 1", {"required": True, "limits": limits}),
        ("--json", bool, None, "print the whole summary as JSON"),
    )
