"""The commands that make scans: ``simulate``, ``show-config``, ``lower-dose``."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

# What loads torch or numba is imported by the commands: help and refusals come at once.
from recon.cli.parsing import (
    EXPOSURE,
    MANY,
    PLAN_OPTIONS,
    SCAN_ENDINGS,
    Commands,
    add_options,
    check_ending,
    check_output,
    command,
    without_ending,
    write_summary,
)
from recon.cli.scan_options import add_reader_options, reader_options
from torchpcct.files import (
    is_own_hdf5,
)

if TYPE_CHECKING:
    from recon.study.study import ProgressBars
    from torchpcct.acquisition.config import SimulationConfig
    from torchpcct.scene.voxels import VoxelScene

_PAPER_VIEWS = 1968
"""Views of a turn in the paper."""


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
            "--views and --whole apply to the plaque scan: with --config set views and region there"
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
    write_summary(
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


def add_simulate(commands: Commands) -> None:
    parser = command(
        commands,
        "simulate",
        _simulate,
        "simulate a scan to an HDF5 file",
        "Simulate a scan of any scene (--config, see show-config) or, without one, of the paper's "
        "plaque by the deep-silicon PCCT, and write it to HDF5, with a record of the command "
        "(.json, .yaml).",
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
        *PLAN_OPTIONS,
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
    write_summary(
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
        "Write a scan, of torchpcct or of another program, as if taken at a fraction of its dose, "
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
