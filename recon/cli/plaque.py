"""The command that reads a vessel's tissues: ``plaque``."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING

# What loads torch or numba is imported by the command: help and refusals come at once.
from recon.cli.parsing import LENGTH, MANY, PLACE, Commands, add_options, check_results, command
from torchpcct import VolumeGrid
from torchpcct.validate import number

if TYPE_CHECKING:
    from recon.study.study import ProgressBars


def _plaque(arguments: argparse.Namespace, progress: ProgressBars) -> None:
    for name in ("wall", "fibrous"):
        if getattr(arguments, name) is not None:
            number(f"--{name} SD", getattr(arguments, name)[1], positive=True, unit="HU")
    folder = arguments.out or Path("out") / "plaque"
    names = ("report.md", "report.json", "tissues.nii.gz", "image.nii.gz", "plaque.png")
    check_results(arguments, folder, lambda report: "presence" in report, *names)
    from recon import reconstruct
    from recon.least_squares.inset_problem import InsetProblem
    from recon.vessel.fbp_noise import fbp_deviations
    from recon.vessel.prior import VesselPrior
    from recon.vessel.reading import read_plaque
    from recon.vessel.report import save, table
    from recon.vessel.start import require_within
    from torchpcct.scan import Scan

    believed = VesselPrior(
        tuple(arguments.wall or VesselPrior.wall), tuple(arguments.fibrous or VesselPrior.fibrous)
    )
    scan = Scan.load(arguments.scan)
    if scan.window is None and (arguments.center is None or arguments.extent is None):
        raise ValueError(
            f"{arguments.scan} has the whole detector, and the vessel model needs a small inset: "
            "give its --center Z Y X and --extent Z Y X in mm"
        )
    grid = VolumeGrid.of(
        scan, voxel=arguments.voxel, extent=arguments.extent, center=arguments.center
    )
    if arguments.point is not None:
        require_within(arguments.point, grid)
    start = time.perf_counter()
    problem = InsetProblem(scan, grid)
    term = problem.term(scan)
    made = time.perf_counter()
    reading = read_plaque(
        term,
        arguments.point,
        point_sd=arguments.point_sd,
        particles=arguments.particles,
        vessel_prior=believed,
        seed=arguments.seed,
    )
    seconds = {"operator": round(made - start, 2), "reading": round(time.perf_counter() - made, 2)}
    others = {"soft FBP": reconstruct(scan, grid, "fbp", kernel="soft").data}
    for method in arguments.beside:
        others[method.upper()] = reconstruct(scan, grid, method, progress=progress.of(method)).data
    progress.close()
    deviations = {}
    if scan.window is not None and scan.exterior is not None:
        deviations["soft FBP"] = fbp_deviations(scan, grid, reading.regions)
    files = save(reading, folder, others, deviations)
    print(table(reading, others, deviations))
    print(f"{seconds}. Written: {', '.join(map(str, files))}")


def add_plaque(commands: Commands) -> None:
    """Add the command."""
    parser = command(
        commands,
        "plaque",
        _plaque,
        "fit a model of a vessel: CT numbers, outlines and plaque bodies with intervals",
        "Fit a model of a contrast-enhanced vessel to a scan: outlines of lumen and outer wall, "
        "one CT number per tissue, plaque bodies with the probability that they exist. Each value "
        "is printed together with that of FBP over the same region.",
        "torchpcct plaque plaque.h5 --beside mbir --out reading",
        out="folder for report.md, report.json, tissues.nii.gz, image.nii.gz and plaque.png "
        "(default out/plaque)",
    )
    length, place = LENGTH, {"nargs": 3, "limits": PLACE}
    value = {"nargs": 2, "limits": {"low": -1e5, "high": 1e5, "unit": "HU"}}
    believed = (
        "value that is expected of this tissue, and its standard deviation (default: see "
        "the report)"
    )
    axes = ("Z", "Y", "X")
    add_options(
        parser,
        ("scan", Path, "SCAN", "scan file written by simulate", {"read": True}),
        ("--point", float, axes, "where a reader sees the plaque, mm", place),
        (
            "--point-sd",
            float,
            "MM",
            "its standard deviation (default 0.4)",
            {"default": 0.4, "limits": length},
        ),
        (
            "--particles",
            int,
            "N",
            "vessel shapes to try (default 300)",
            {"default": 300, "limits": {"low": 50, "high": MANY}},
        ),
        ("--wall", float, ("HU", "SD"), believed, value),
        ("--fibrous", float, ("HU", "SD"), believed, value),
        (
            "--beside",
            str,
            None,
            "measure in these images, too",
            {"nargs": "*", "default": [], "choices": ("pwls", "mbir")},
        ),
        ("--voxel", float, "MM", "voxel size (default 0.2)", {"default": 0.2, "limits": length}),
        ("--center", float, axes, "centre in mm (default: of the region that was scanned)", place),
        (
            "--extent",
            float,
            axes,
            "edge lengths in mm (default: the region)",
            {"nargs": 3, "limits": length},
        ),
    )
