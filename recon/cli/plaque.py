"""The command that reads a vessel's tissues: ``plaque``."""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path
from typing import TYPE_CHECKING

# What loads torch or numba is imported by the command: help and refusals come at once.
from recon.cli.parsing import Commands, check_results, command, examples
from torchpcct import VolumeGrid
from torchpcct.validate import number, numbers, whole

if TYPE_CHECKING:
    from recon.study.study import ProgressBars

__all__ = ["add_plaque"]


def _plaque(arguments: argparse.Namespace, progress: ProgressBars) -> None:
    if not arguments.scan.exists():
        raise FileNotFoundError(f"{arguments.scan} does not exist (torchpcct simulate makes scans)")
    folder = arguments.out or Path("out") / "plaque"
    names = ("report.md", "report.json", "tissues.nii.gz", "image.nii.gz", "plaque.png")
    check_results(arguments, folder, lambda report: "presence" in report, *names)
    voxel = number("--voxel", arguments.voxel, positive=True, unit="mm")
    number("--point-sd", arguments.point_sd, positive=True, unit="mm")
    whole("--particles", arguments.particles, 50)
    whole("--seed", arguments.seed, 0)
    for name in ("point", "center", "extent"):
        if getattr(arguments, name) is not None:
            numbers(f"--{name}", getattr(arguments, name), 3, positive=name == "extent", unit="mm")
    from recon import reconstruct
    from recon.least_squares.inset_problem import InsetProblem
    from recon.plaque.beside import fbp_deviations
    from recon.plaque.data import TissueData
    from recon.plaque.reading import read_plaque
    from recon.plaque.report import save, table
    from recon.plaque.start import require_within
    from recon.plaque.vessel_prior import VesselPrior
    from recon.study.paper.plaque_scan import INSET_MM
    from torchpcct.scan import Scan
    from torchpcct.scene.plaque import PAPER_POSITION

    believed = VesselPrior(tuple(arguments.wall or VesselPrior.wall), tuple(arguments.fibrous or VesselPrior.fibrous))
    shape = tuple(math.ceil(e / voxel - 1e-6) for e in arguments.extent or INSET_MM)
    grid = VolumeGrid(shape, voxel, tuple(arguments.center or PAPER_POSITION[::-1]))
    if arguments.point is not None:
        require_within(arguments.point, grid)
    scan = Scan.load(arguments.scan)
    start = time.perf_counter()
    problem = InsetProblem(scan, grid)
    data = TissueData.of_scan(scan, problem)
    made = time.perf_counter()
    reading = read_plaque(
        data, arguments.point, point_sd=arguments.point_sd, particles=arguments.particles, vessel_prior=believed,
        seed=arguments.seed,
    )  # fmt: skip
    seconds = {"operator": round(made - start, 2), "reading": round(time.perf_counter() - made, 2)}
    others = {"soft FBP": reconstruct(scan, grid, "fbp", kernel="soft").data}
    for method in arguments.beside:
        others[method.upper()] = reconstruct(scan, grid, method, progress=progress.of(method)).data
    progress.close()
    deviations = {}
    if scan.window is not None and scan.surround is not None:
        deviations["soft FBP"] = fbp_deviations(scan, grid, reading.regions)
    files = save(reading, folder, others, deviations)
    print(table(reading, others, deviations))
    print(f"{seconds}. Written: {', '.join(map(str, files))}")


def add_plaque(commands: Commands) -> None:
    """Add the command."""
    parser = command(
        commands, "plaque", _plaque, "read a vessel's tissues: values, outlines and plaque bodies with intervals",
        "Fit a contrast-enhanced vessel's tissues to a scan: outlines of lumen and outer wall, tissue values, plaque "
        "bodies with the probability that they are there; beside each figure what FBP reads over the same regions.",
        "folder for report.md, report.json, tissues.nii.gz, image.nii.gz and plaque.png (default out/plaque)",
    )  # fmt: skip
    examples(parser, "torchpcct plaque plaque.h5 --beside mbir --out reading")
    parser.add_argument("scan", type=Path, metavar="SCAN", help="scan file written by simulate")
    axes = ("Z", "Y", "X")
    parser.add_argument("--point", type=float, nargs=3, metavar=axes, help="where a reader sees the plaque, mm")
    parser.add_argument("--point-sd", type=float, default=0.4, metavar="MM", help="error of the point (default 0.4)")
    parser.add_argument("--particles", type=int, default=300, metavar="N", help="shapes followed (default 300)")
    for tissue in ("wall", "fibrous"):
        parser.add_argument(
            f"--{tissue}", type=float, nargs=2, metavar=("HU", "SD"),
            help="value and SD that are expected before the scan (default: usual ones, named in the report)",
        )  # fmt: skip
    parser.add_argument("--beside", nargs="*", default=[], choices=("pwls", "mbir"), help="also read these")
    parser.add_argument("--voxel", type=float, default=0.2, metavar="MM", help="voxel size (default 0.2)")
    parser.add_argument("--center", type=float, nargs=3, metavar=axes, help="centre in mm (default: the plaque)")
    parser.add_argument("--extent", type=float, nargs=3, metavar=axes, help="edge lengths in mm (default: the inset)")
