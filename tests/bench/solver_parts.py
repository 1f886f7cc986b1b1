"""What each part of PWLS of a whole cone beam brings, in projection pairs.

    python tests/bench/solver_parts.py [--voxels 32] [--objects plates tooth] [--out tests/bench]

Six objects in a wide cone (half angle 14°), one noise draw each, from FBP to 1 HU: the solver as it
is, and with one of its parts left out, halved or doubled. The parts were chosen on the first four
objects; the rods and the foam took no part in that. A part that brings nothing takes as many pairs
without. The minimum is that of the same solver to 0.02 HU. Counts need no idle machine; seconds are
of the processor.
"""

import argparse
import contextlib
import logging
import math
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
from results import write_results
from torch import Tensor

from recon.analytic.fbp import fbp
from recon.least_squares import coarse_scan, field_model
from recon.least_squares.field_problem import field_prior
from recon.least_squares.pwls import pwls
from torchpcct import ConeBeam, Projector, VolumeGrid, full_turn

Shape = Callable[[Tensor, Tensor, Tensor], Tensor]
"""Density, in units of water, at z, y, x, which reach from -1 to 1."""

PHOTONS = 5e4
CONE = 0.25
"""Half the grid over the distance from the source."""
WATER_LINE = 4.0
"""Line integral of as much water as the grid is wide."""
MOST = 150
"""Pairs after which a row is given up."""


def plates(z: Tensor, y: Tensor, x: Tensor) -> Tensor:
    """Thin plates across the axis, in a cylinder."""
    r = torch.hypot(x, y)
    density = 1.0 * ((r < 0.7) & (z.abs() < 0.75))
    for k in range(-4, 5):
        density = torch.where((r < 0.5) & ((z - 0.15 * k).abs() < 0.04), 1.5, density)
    return density


def tooth(z: Tensor, y: Tensor, x: Tensor) -> Tensor:
    """Dentine under a cap of enamel, with a canal."""
    r = torch.hypot(x, y)
    width = 0.55 - 0.25 * (z + 0.2).clamp(0, 1)
    cap = (r < width) & (r > width - 0.12) & (z < -0.1) & (z > -0.8)
    density = 1.8 * ((r < width) & (z.abs() < 0.8)) + 1.2 * cap
    return torch.where((r < 0.12) & (z > -0.4) & (z < 0.8), 1.0, density)


def head(z: Tensor, y: Tensor, x: Tensor) -> Tensor:
    """A ball in a shell twice as dense, with a lesion."""
    r = torch.sqrt((x / 0.8) ** 2 + y**2 + (z / 0.9) ** 2)
    lesion = torch.sqrt((x - 0.2) ** 2 + y**2 + (z + 0.2) ** 2) < 0.15
    return 1.0 * (r < 0.85) + 1.0 * ((r < 0.85) & (r > 0.76)) + 0.05 * lesion


def thorax(z: Tensor, y: Tensor, x: Tensor) -> Tensor:
    """Lungs, a spine and a heart in water."""
    density = 1.0 * ((x / 0.85) ** 2 + (y / 0.62) ** 2 + (z / 0.8) ** 2 < 1)
    for side in (-1, 1):
        lung = ((x - side * 0.38) / 0.27) ** 2 + (y / 0.4) ** 2 + (z / 0.6) ** 2 < 1
        density = torch.where(lung, 0.25, density)
    spine = (torch.hypot(x, y - 0.42) < 0.13) & (z.abs() < 0.6)
    density = torch.where(spine, 1.9, density)
    heart = ((x - 0.1) / 0.2) ** 2 + ((y + 0.1) / 0.2) ** 2 + ((z - 0.1) / 0.25) ** 2 < 1
    return torch.where(heart, 1.08, density)


def rods(z: Tensor, y: Tensor, x: Tensor) -> Tensor:
    """A bundle of thin rods beside the axis, tilted and of several densities, in a light block."""
    density = 0.3 * (((x - 0.25).abs() < 0.5) & ((y + 0.2).abs() < 0.45) & (z.abs() < 0.7))
    for k in range(1, 26):
        i, j = divmod(k - 1, 5)
        tilt = 0.075 * ((k % 3) - 1)
        r = torch.hypot(x - 0.25 - 0.17 * (i - 2) - tilt * z, y + 0.2 - 0.16 * (j - 2))
        rod = (r < 0.05) & ((z - 0.1 * ((k % 4) - 1.5)).abs() < 0.6)
        density = torch.where(rod, 0.8 + 0.3 * (k % 5), density)
    return density


def foam(z: Tensor, y: Tensor, x: Tensor) -> Tensor:
    """A ball with 70 bubbles."""
    random = np.random.default_rng(7)
    density = 1.0 * (z**2 + y**2 + x**2 < 0.8**2)
    for _ in range(70):
        (c, b, a), radius = random.uniform(-0.75, 0.75, 3), random.uniform(0.05, 0.17)
        bubble = (z - c) ** 2 + (y - b) ** 2 + (x - a) ** 2 < radius**2
        density = torch.where(bubble, 0.0, density)
    return density


OBJECTS: dict[str, tuple[Shape, float]] = {
    "plates": (plates, 1.0),
    "tooth": (tooth, 1.0),
    "head": (head, 1.0),
    "thorax": (thorax, 1.0),
    "rods": (rods, 1.5),
    "foam": (foam, 1.2),
}
"""What is scanned, and by how much denser than water it is."""


class Case:
    """One object's noisy scan, FBP, and the minimum."""

    def __init__(self, name: str, voxels: int) -> None:
        self.name = name
        shape, dense = OBJECTS[name]
        half = voxels / 2
        sod = half / CONE
        columns = math.ceil(1.14 * voxels) + 4
        rows = math.ceil(1.02 * voxels * (1 + CONE)) + 2
        geometry = ConeBeam(full_turn(3 * voxels), sod, 1.6 * sod, columns, rows, 1.6)
        grid = VolumeGrid((voxels,) * 3, 1.0)
        self.A = Projector(geometry, grid)
        places = torch.meshgrid(*(torch.from_numpy(a) / half for a in grid.axes), indexing="ij")
        water = WATER_LINE / voxels
        lines = self.A((dense * water * shape(*places)).float())
        self.w = PHOTONS * torch.exp(-lines)
        noise = torch.randn(lines.shape, generator=torch.Generator().manual_seed(1))
        self.y = lines + noise / self.w.sqrt()
        self.hu, self.prior = water / 1000.0, field_prior(1.0, 3)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # rows that end above the object
            found = fbp(self.y, geometry, grid, "soft", outside=water)
        self.start: Tensor | None = torch.nan_to_num(found, 0.0, 0.0, 0.0).clamp_min(0.0)
        self.reference = self.solved(tolerance=0.02, max_exact=400).volume

    def solved(self, **options: Any) -> Any:
        given = {"mu_per_hu": self.hu, "start": self.start, "max_exact": MOST} | options
        return pwls(self.A, self.y, self.w, self.prior, **given)

    def run(self) -> tuple[int | None, int, float, float]:
        """Pairs to 1 HU, None if they did not suffice; how often the model was applied; HU from
        the minimum, where the data determine it; and seconds."""
        applied = 0

        def apply(model: field_model.FieldModel, x: Tensor) -> Tensor:
            nonlocal applied
            applied += 1
            return plain(model, x)

        plain, began = field_model.FieldModel.apply, time.process_time()
        with mock.patch.object(field_model.FieldModel, "apply", apply):
            found = self.solved(tolerance=1.0)
        seconds = time.process_time() - began
        report = found.report
        here = field_model.FieldModel(self.A, self.w).determined
        off = (found.volume - self.reference)[here].double().square().mean().sqrt()
        pairs = report["exact_pairs"] if report["converged"] else None
        return pairs, applied, float(off) / self.hu, seconds


def changed(module: Any, **values: Any) -> Callable[[], Any]:
    """Other values of a module's constants."""
    return lambda: mock.patch.multiple(module, **values)


def one_sector() -> Any:
    """One sector of all directions."""
    return mock.patch.multiple(
        field_model,
        SECTORS_BESIDE_COARSE_SCAN=1,
        _sectors=lambda ways, _: np.ones((1, *ways.shape)),
    )


PARTS: dict[str, Callable[[], Any]] = {
    "as it is": contextlib.nullcontext,
    "no coarser scan": changed(field_model, coarse_scan=lambda *_: None),
    "its cut-off at half the frequency": changed(coarse_scan, CUT=0.1),
    "its cut-off at four fifths of it": changed(coarse_scan, CUT=0.16),
    "its voxels as wide as those of the grid": changed(coarse_scan, WIDER=1),
    "half of its views": changed(coarse_scan, EVERY=8, DIRECTIONS=0.375),
    "twice its views": changed(coarse_scan, EVERY=2, DIRECTIONS=1.5),
    "half of the iterations on the model (4)": changed(field_model, INNER_OF_VOLUMES=4),
    "twice as many (16)": changed(field_model, INNER_OF_VOLUMES=16),
    "until the residual is 10 % of the first, not 3 %": changed(field_model, INNER_REDUCTION=0.1),
    "16, or until it is 10 %": changed(field_model, INNER_OF_VOLUMES=16, INNER_REDUCTION=0.1),
    "one sector of directions": one_sector,
    "six sectors": changed(field_model, SECTORS_BESIDE_COARSE_SCAN=6),
    "twelve sectors": changed(field_model, SECTORS_BESIDE_COARSE_SCAN=12),
    "one spectrum for all slices": changed(field_model, FACTOR=math.inf),
}
"""What is done to the solver."""


def counted(cases: Sequence[Case], part: Callable[[], Any]) -> list[str]:
    """The cells of one row: pairs of each object; of all how often the model was applied, most HU
    from the minimum, seconds."""
    cells, applied, off, seconds = [], 0, 0.0, 0.0
    with part():
        for case in cases:
            pairs, times, left, took = case.run()
            cells.append(f"> {MOST}" if pairs is None else str(pairs))
            applied, off, seconds = applied + times, max(off, left), seconds + took
    return [*cells, str(applied), f"{off:.2f}", f"{seconds:.1f}"]


def main() -> None:
    """Run, print the table, write ``solver_parts.json`` and ``solver_parts.md``."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--voxels", type=int, default=32)
    parser.add_argument("--objects", nargs="+", choices=list(OBJECTS), default=list(OBJECTS))
    parser.add_argument("--out", type=Path, default=Path("tests/bench"))
    args = parser.parse_args()
    logging.disable(logging.WARNING)  # what did not converge is in the table
    cases = [Case(name, args.voxels) for name in args.objects]
    head_row = ["", *args.objects, "model applied", "most HU from the minimum", "s"]
    lines = [
        "# PWLS of a whole cone beam: what each part brings",
        "",
        f"`python tests/bench/solver_parts.py --voxels {args.voxels}`: exact projection pairs from "
        f"FBP to 1 HU as the solver estimates it, {args.voxels}³ voxels, {3 * args.voxels} views, "
        "one noise draw; of all objects how often the model was applied, and seconds of the "
        "processor, the model's own making included.",
        "",
        f"| {' | '.join(head_row)} |",
        "|" + "---|" * len(head_row),
    ]
    print("\n".join(lines), flush=True)
    rows = []
    for name, part in [*PARTS.items(), ("from 0", contextlib.nullcontext)]:
        if name == "from 0":
            for case in cases:
                case.start = None
        row = [name, *counted(cases, part)]
        rows.append(dict(zip(["part", *head_row[1:]], row, strict=True)))
        lines.append(f"| {' | '.join(row)} |")
        print(lines[-1], flush=True)
    write_results(args.out, "solver_parts", rows, "\n".join([*lines, ""]))


if __name__ == "__main__":
    main()
