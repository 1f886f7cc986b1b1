"""``torchpcct recovery``: how much of a lesion's contrast is shown in a scan."""

from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING

from recon.cli.evaluate import METHODS_TEXT

# What loads torch or numba is imported by the commands: help and refusals come at once.
from recon.cli.parsing import (
    LENGTH,
    MANY,
    PLACE,
    Commands,
    add_options,
    command,
    find_modules_here,
)
from recon.cli.scan_options import add_reader_options, grid_of_scan, reader_options

if TYPE_CHECKING:
    from recon.study.study import ProgressBars

_BALLS = ((0.5, 600.0), (1.0, 100.0), (1.0, -100.0), (2.0, 30.0))
"""Diameters in mm and contrasts in HU that are tried where none are named: a calcification, plaque
in fat and fat in plaque, what is faint."""


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
        before=METHODS_TEXT,
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
