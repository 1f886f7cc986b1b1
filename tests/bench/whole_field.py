"""PWLS of a whole field of view: distance to the minimum against time, beside FISTA and OS-SART on the same projector.

    python tests/bench/whole_field.py {parallel,cone,large} [--threads 1] [--out tests/bench/whole_field.json]

``parallel``: 416², 181 views; ``cone``: 48³, 120 × 72² readings; both with the same weak prior (strength 0.3), hard on
every solver. ``large``: 128³, 360 × 192², with the prior that ``reconstruct`` takes, ours alone, to its own stop.
Seconds are those of the processor (``time.process_time``), so that what else the machine does counts little; with one
thread they are those of an idle machine. The reference is the float64 minimum. FISTA: Beck and Teboulle 2009 with the
separable majoriser; OS-SART: 20 subsets of interleaved views, relaxation 0.99ⁿ, as TIGRE has it (Wang, Jiang 2004); it
has no prior, so the distance that it ends at is not its error. FISTA and ours start with the same FBP, OS-SART with 0.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from recon.least_squares.field_model import FieldModel
from recon.least_squares.field_problem import FieldProblem, field_prior
from recon.least_squares.pwls import pwls
from recon.least_squares.qggmrf import QGGMRF
from torchpcct import ConeBeam, ParallelBeam, Projector, Scan, VolumeGrid, full_turn

MU = 0.02
HU = MU / 1000
PRIOR = QGGMRF(0.3, 300.0)
PHOTONS = 1e5
SETUPS: dict[str, tuple[Any, VolumeGrid]] = {
    "parallel": (ParallelBeam(np.arange(181) * math.pi / 181, 416, 0.5), VolumeGrid((416, 416), 0.5)),
    "cone": (ConeBeam(full_turn(120), 400.0, 700.0, 72, 72, 1.1), VolumeGrid((48, 48, 48), 0.8)),
    "large": (ConeBeam(full_turn(360), 400.0, 700.0, 192, 192, 1.1), VolumeGrid((128, 128, 128), 0.8)),
}
SUBSETS = 20

Point = tuple[float, float]


def body(grid: VolumeGrid) -> Tensor:
    """Water with two lungs, a spine, ribs and small rods; of a volume, round at both ends."""
    axes = torch.meshgrid(*[torch.from_numpy(a) for a in grid.axes], indexing="ij")
    y, x = (2 * a / (0.85 * e) for a, e in zip(axes[-2:], grid.extent[-2:], strict=True))
    mu = torch.zeros(grid.shape, dtype=torch.float64)
    mu[(x / 0.95) ** 2 + (y / 0.75) ** 2 < 1] = 1.0
    for side in (-1, 1):
        mu[((x - 0.45 * side) / 0.2) ** 2 + ((y - 0.05) / 0.35) ** 2 < 1] = 0.25
    mu[(x / 0.12) ** 2 + ((y + 0.5) / 0.1) ** 2 < 1] = 2.0
    for i in range(8):
        angle = 2 * math.pi * i / 8 + 0.2
        mu[(x - 0.86 * math.cos(angle)) ** 2 + (y - 0.66 * math.sin(angle)) ** 2 < 0.03**2] = 2.2
    for i in range(6):
        mu[(x - 0.02 - 0.1 * (i - 3)) ** 2 + (y - 0.55) ** 2 < (0.012 * (i + 1)) ** 2] = 1.4
    if grid.ndim == 3:
        mu[axes[0].abs() > 0.35 * grid.extent[0]] = 0.0
    return (MU * mu).float()


class Problem:
    """One noisy scan, its FBP, and, if asked for, the minimum in float64."""

    def __init__(self, name: str, reference: bool) -> None:
        geometry, grid = SETUPS[name]
        lines = Projector(geometry, grid)(body(grid))
        counts = torch.poisson(PHOTONS * torch.exp(-lines), generator=torch.Generator().manual_seed(0))
        scan = Scan.from_counts(counts, geometry, air=PHOTONS, mu_water=MU)
        field = FieldProblem(scan, grid)
        self.A, self.grid = field.projector, grid
        self.y, self.w = field.slices(scan)[0]
        began = time.process_time()
        first = field.start(self.y)
        assert first is not None
        self.first, self.fbp_seconds = first, time.process_time() - began
        model = FieldModel(self.A, self.w)
        self.asked = field_prior(grid.spacing[-1], grid.ndim) if name == "large" else PRIOR
        self.prior = self.asked.bind(model.information(HU), grid.spacing, HU)
        self.inside = model.determined
        self.minimum: Tensor | None = None
        if reference:
            self.minimum = pwls(
                self.A,
                self.y.double(),
                self.w.double(),
                self.prior,
                mu_per_hu=HU,
                start=first,
                tolerance=1e-2,
                max_exact=400,
            ).x

    def rmsd(self, x: Tensor) -> float:
        """Distance to the minimum in HU, over the voxels that all views see."""
        if self.minimum is None:
            return math.nan
        return float((x.double() - self.minimum)[self.inside].square().mean().sqrt()) / HU


def ours(p: Problem) -> tuple[list[Point], dict[str, Any]]:
    """(seconds, HU) before each projection pair, and the report at the default stop."""
    points: list[Point] = []
    spent = [p.fbp_seconds, time.process_time()]

    def note(at: dict[str, Any]) -> None:
        spent[0] += time.process_time() - spent[1]
        points.append((spent[0], p.rmsd(at["x"][0])))
        spent[1] = time.process_time()

    result = pwls(p.A, p.y, p.w, p.asked, mu_per_hu=HU, start=p.first, tolerance=1.0, callback=note)
    return points, dict(result.report)


def fista(p: Problem, iterations: int) -> Iterator[Point]:
    """(seconds, HU) after each iteration."""
    began = time.process_time()
    curvature = p.A.T(p.w * p.A(torch.ones(p.grid.shape))) + float(p.prior.spectrum(p.grid.shape).max())
    curvature = curvature.clamp_min(1e-6 * float(curvature.max()))
    b = p.A.T(p.w * p.y)
    x = z = p.first
    t, spent = 1.0, p.fbp_seconds + time.process_time() - began
    for _ in range(iterations):
        began = time.process_time()
        new = z - (p.A.T(p.w * p.A(z)) - b + p.prior.gradient(z[None])[0]) / curvature
        following = (1 + math.sqrt(1 + 4 * t * t)) / 2
        z = new + (t - 1) / following * (new - x)
        x, t = new, following
        spent += time.process_time() - began
        yield spent, p.rmsd(x)


def os_sart(p: Problem, passes: int) -> Iterator[Point]:
    """(seconds, HU) after each pass through all views."""
    g = p.A.geometry
    began = time.process_time()
    parts = []
    for first in range(SUBSETS):
        views = np.arange(first, g.views, SUBSETS)
        A = Projector(g.select(views), p.grid)
        rows, columns = A(torch.ones(p.grid.shape)), A.T(torch.ones(A.range_shape))
        index = torch.from_numpy(views)
        parts.append((A, p.y[index], rows.clamp_min(1e-3), columns.clamp_min(1e-3)))
    x, relaxation, spent = torch.zeros(p.grid.shape), 1.0, time.process_time() - began
    for _ in range(passes):
        began = time.process_time()
        for k in np.random.default_rng(0).permutation(SUBSETS):
            A, y, rows, columns = parts[k]
            x = x + relaxation * A.T((y - A(x)) / rows) / columns
        relaxation *= 0.99
        spent += time.process_time() - began
        yield spent, p.rmsd(x)


def first_below(points: list[Point], hu: float) -> float | None:
    """Seconds until the distance is below ``hu`` for the first time."""
    return next((round(s, 2) for s, d in points if d <= hu), None)


def main() -> None:
    """Run one setup, print it, and add it to the JSON file."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("setup", choices=list(SETUPS))
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--iterations", type=int, default=120)
    parser.add_argument("--out", type=Path, default=Path("tests/bench/whole_field.json"))
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    p = Problem(args.setup, reference=args.setup != "large")
    wall = time.perf_counter()
    curves: dict[str, list[Point]] = {}
    curves["ours"], report = ours(p)
    wall = time.perf_counter() - wall
    scale = 10.0
    if p.minimum is not None:
        curves["FISTA"] = list(fista(p, args.iterations))
        curves["OS-SART"] = list(os_sart(p, max(args.iterations // 6, 1)))
        scale = 0.01 * float(p.minimum[p.inside].square().mean().sqrt()) / HU
    found = {
        "setup": args.setup,
        "threads": args.threads,
        "one_percent_hu": round(scale, 2) if p.minimum is not None else None,
        "stop": {
            "exact_pairs": report["exact_pairs"], "converged": report["converged"],
            "estimated_hu": report["rmsd_hu"][-1], "true_hu": curves["ours"][-1][1] if p.minimum is not None else None,
            "misfit": report["misfit"], "processor_seconds": curves["ours"][-1][0], "wall_seconds": wall,
            "load": Path("/proc/loadavg").read_text().split()[:3] if Path("/proc/loadavg").exists() else None,
        },
        "peak_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
        "seconds_to": {
            name: {"1 %": first_below(points, scale), "1 HU": first_below(points, 1.0), "ends_at_hu": points[-1][1]}
            for name, points in curves.items()
        } if p.minimum is not None else None,
        "curves": {name: [(round(s, 3), round(d, 4)) for s, d in points] for name, points in curves.items()}
        if p.minimum is not None else None,
    }  # fmt: skip
    print(json.dumps({k: v for k, v in found.items() if k != "curves"}, indent=1))
    known = json.loads(args.out.read_text()) if args.out.exists() else {}
    known[f"{args.setup}, {args.threads} threads"] = found
    args.out.write_text(json.dumps(known, indent=1) + "\n")


if __name__ == "__main__":
    main()
