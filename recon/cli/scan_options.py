"""Options of the commands that read a scan: its file, what that does not know, and the grid."""

from __future__ import annotations

import argparse
import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

# What loads torch or numba is imported by the commands: help and refusals come at once.
from recon.cli.parsing import (
    LENGTH,
    Parser,
    add_options,
)
from torchpcct import VolumeGrid

if TYPE_CHECKING:
    from recon.slabs import ScanSlices
    from torchpcct.scan import Scan

MOST_VOXELS = 2**31
"""Of a volume, 8 GiB: what is asked for beyond is a slip of the voxel size."""


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
            f"{text!r} selects no slice: the second number must be larger than the first"
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
            "angles of Data Exchange, NeXus and Nikon in degrees: a text file with one a line, or "
            "the first and their step",
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
        group="properties of the scan that the file lacks",
    )


def _number_or_file(text: str) -> float | str:
    """A number, or a file or pattern by its full path: workers may stand in another folder."""
    try:
        value = float(text)
    except ValueError:
        return _there(text)
    if not math.isfinite(value) or value < 0:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a reading: give a finite number of at least 0, or a file"
        )
    return value


def _there(text: str) -> str:
    """A file that is there, or a pattern, by its full path."""
    path = Path(text).absolute()
    if not text.strip():
        raise argparse.ArgumentTypeError("it is empty")
    if not path.exists() and not any(c in text for c in "*?["):
        raise argparse.ArgumentTypeError(f"{text!r} is neither a number nor an existing file")
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


def length(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a length in mm (files must be given before this option)"
        ) from None


def require_voxels(shape: tuple[int, ...]) -> None:
    if math.prod(shape) > MOST_VOXELS:
        raise ValueError(
            f"--voxel makes {' × '.join(map(str, shape))} voxels, more than {MOST_VOXELS:.0e}: "
            "enlarge the voxels, or reconstruct a smaller --extent"
        )
