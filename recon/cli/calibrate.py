"""``torchpcct calibrate``: the geometry of a scan from the object itself."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path
from typing import TYPE_CHECKING

# What loads torch or numba is imported by the commands: help and refusals come at once.
from recon.cli.parsing import (
    LENGTH,
    PLACE,
    Commands,
    add_options,
    as_json,
    check_ending,
    check_output,
    command,
    without_ending,
)
from recon.cli.scan_options import (
    add_reader_options,
    grid_of_scan,
    length,
    reader_options,
    require_voxels,
)
from torchpcct.files import (
    atomic_write,
)

if TYPE_CHECKING:
    from recon.study.study import ProgressBars

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
    require_voxels(grid.shape)
    names = None
    if arguments.free is not None:
        names = [name.strip() for name in arguments.free.split(",") if name.strip()]
    found = calibrate(scan, grid, names, progress=progress.of("calibrate"))
    progress.close()
    # Vectors, which take the place of what a file says of itself.
    made = found.geometry
    vectors = made if isinstance(made, VectorGeometry) else VectorGeometry.of(made)
    scan_name = " ".join(arguments.scan.name.splitlines())  # of one line, as a comment is
    about = [f"{_CALIBRATED}{scan_name}", *str(found).splitlines()]
    sized = "" if found.lengths == "mm" else " --pitch MM"
    if sized:
        about.append("lengths in pixels, the file does not know their size: give --pitch MM, too")
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
        f"--geometry {shlex.quote(str(arguments.out))}{sized}"
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
        "estimate a scan's geometry from the object itself",
        "Estimate parameters of a scan's geometry from its readings, with standard errors, and "
        "write the geometry for reconstruct --geometry. The whole object must lie in the field of "
        "view in all views. Parameters that the readings do not determine are refused.",
        "torchpcct calibrate tooth.h5 --free offset,roll --out tooth.yaml",
        "torchpcct reconstruct tooth.h5 --geometry tooth.yaml --out tooth.nii.gz",
        out="geometry to write, .yaml (default SCAN_geometry.yaml)",
        draws=False,
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
            length,
            "MM",
            f"centre, Z Y X (default: the axis); {own}",
            {"nargs": "+", "limits": PLACE},
        ),
        (
            "--extent",
            length,
            "MM",
            f"edge lengths, Z Y X (default: what is seen); {own}",
            {"nargs": "+", "limits": LENGTH},
        ),
        group="voxels",
    )
    add_reader_options(parser)
    add_options(parser, ("--json", bool, None, "print all numbers as JSON"))
