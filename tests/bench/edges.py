"""How sharp a vessel's outline is: 10–90 % widths in plane and along z, by method.

    python tests/bench/edges.py [--draws 4] [--doses 0.35 2.0] [--out tests/bench/edges.json]

An ellipsoid of 3.4 × 3.4 × 8.6 mm, enhanced blood in fat at the plaque's place, along the scanner's axis and across it
(along x): its middle third shows the width in plane in the first, and along z, where its surface faces up or down, in
the second. The paper's scan with 1968 views; the profile is the mean over the draws and over the surface, so noise
hardly counts.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from pathlib import Path
from typing import Any

import numpy as np

import recon
from recon.least_squares.inset_problem import InsetProblem
from recon.study.paper.plaque_scan import inset_grid
from torchpcct import VolumeGrid
from torchpcct.acquisition.acquire import acquire
from torchpcct.files import atomic_write
from torchpcct.metrics import edge_profile, edge_width, ellipsoid_distance
from torchpcct.scan import Scan
from torchpcct.scanner import presets
from torchpcct.scene.bodies import Ellipsoid
from torchpcct.scene.plaque import Plaque
from torchpcct.scene.scene import Body, Scene
from torchpcct.volume import Volume

RADIUS_MM, LENGTH_MM = 1.7, 8.6
"""As long as the inset holds."""
REACH_MM, BIN_MM = (1.2, 1.2), 0.05
FACING = math.cos(math.radians(30.0))
"""Of the normal of a surface that faces up or down."""
FBP_GRID_MM, GRID_MM = 0.25, 0.2
DIRECTIONS = {"in plane": 2, "along z": 0}
"""Direction of the profile → long axis, (x, y, z)."""
METHODS: dict[str, tuple[str, float, dict[str, Any]]] = {
    "FBP soft": ("fbp", FBP_GRID_MM, {"kernel": "soft"}),
    "FBP standard": ("fbp", FBP_GRID_MM, {"kernel": "standard"}),
    "PWLS": ("pwls", GRID_MM, {}),
    "MBIR": ("mbir", GRID_MM, {}),
    "MBIR, fidelity 1": ("mbir", GRID_MM, {"fidelity": 1.0}),
}


def radii(axis: int) -> tuple[float, ...]:
    """Semi-axes, (x, y, z)."""
    return tuple(LENGTH_MM / 2 if k == axis else RADIUS_MM for k in range(3))


def vessel_scan(axis: int) -> Scan:
    """The noise-free scan of a vessel along an axis."""
    vessel = Body("lumen", Ellipsoid(radii(axis), position=Plaque().position), "blood_iodine", "patient")
    patient = Body("patient", Ellipsoid((120.0, 120.0, 1000.0)), "pericoronary_fat")
    return acquire(Scene((patient, vessel)), presets.pcct(), region=grid_of(FBP_GRID_MM), exposure_s=None)


def grid_of(voxel_mm: float) -> VolumeGrid:
    """Of the study's inset."""
    return inset_grid(Plaque(), voxel_mm)


def width(volumes: list[Volume], axis: int) -> float:
    """10–90 % width in mm of the mean of the volumes; of a vessel across the axis where it faces up or down."""
    grid = volumes[0].grid
    points = np.meshgrid(*(a - c for a, c in zip(grid.axes, grid.center, strict=True)), indexing="ij")
    distance = ellipsoid_distance(grid, grid.center, radii(axis)[::-1])
    mask = np.abs(points[2 - axis]) < LENGTH_MM / 6
    if axis != 2:
        mask &= np.abs(points[0]) >= FACING * np.hypot(points[0], points[1])
    mean = np.mean([v.data.double().numpy() for v in volumes], axis=0)
    return edge_width(*edge_profile(mean, distance, REACH_MM, BIN_MM, mask))


def main() -> None:
    """Scan, reconstruct, print, write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--draws", type=int, default=4)
    parser.add_argument("--doses", type=float, nargs="+", default=[0.35, 2.0])
    parser.add_argument("--out", type=Path, default=Path("tests/bench/edges.json"))
    args = parser.parse_args()
    began = time.process_time()
    rows: list[dict[str, Any]] = []
    for direction, axis in DIRECTIONS.items():
        clean = vessel_scan(axis)
        problem = InsetProblem(clean, grid_of(GRID_MM))
        for dose in args.doses:
            scans = [clean.with_noise(dose, seed) for seed in range(args.draws)]
            for name, (method, voxel, options) in METHODS.items():
                kept = {} if method == "fbp" else {"problem": problem}
                volumes = recon.reconstruct(scans, grid_of(voxel), method, **kept, **options)
                found = width(volumes, axis)
                rows.append({"method": name, "direction": direction, "exposure_s": dose, "width_mm": found})
                print(f"{name:13s} {direction:9s} {dose:g} s  {found:.2f} mm", flush=True)
    data = {"draws": args.draws, "rows": rows, "processor_seconds": round(time.process_time() - began)}
    with atomic_write(args.out) as part:
        part.write_text(json.dumps(data, indent=1) + "\n")


if __name__ == "__main__":
    main()
