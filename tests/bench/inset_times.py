"""What a volume of the paper's inset costs, and how far it is from the truth: FBP, PWLS, MBIR, tissues.

    python tests/bench/inset_times.py [--rounds 5] [--exposure 2.0] [--out tests/bench/inset_times.json]

A scan of 1968 views, from its readings to a volume in HU: whole, or with the problem (Gram operator, background, the
network's weights) kept from an earlier scan. Methods take turns, a new noise realisation each round; medians of wall
time, after one round that is not counted. Run it on an idle machine. Error: root mean square inside the vessel, from
the volume-weighted mean of true tissue values. A reading of the tissues gives no volume.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rod_values import true_volume

import recon
from recon.least_squares.inset_problem import InsetProblem
from recon.mbir.mbir import Mbir
from recon.plaque import TissueData, read_plaque
from recon.study.paper.plaque_scan import inset_grid
from recon.study.study import environment
from torchpcct import VolumeGrid, acquire
from torchpcct.files import atomic_write
from torchpcct.scan import Scan
from torchpcct.scanner import presets
from torchpcct.scene.plaque import plaque_scene
from torchpcct.threads import get_num_threads
from torchpcct.volume import Volume


def methods(coarse: VolumeGrid, fine: VolumeGrid, clean: Scan) -> dict[str, Callable[[Scan], Volume | None]]:
    """By name, each from a scan."""
    problem, network = InsetProblem(clean, fine), Mbir.load()
    kept: dict[str, Any] = {"problem": problem}
    learned = {**kept, "network": network}

    def read(scan: Scan) -> None:
        read_plaque(TissueData.of_scan(scan, problem))

    return {
        "FBP soft 0.25 mm": lambda scan: recon.reconstruct(scan, coarse, "fbp", kernel="soft"),
        "PWLS": lambda scan: recon.reconstruct(scan, fine, "pwls"),
        "PWLS kept": lambda scan: recon.reconstruct(scan, fine, "pwls", **kept),
        "MBIR": lambda scan: recon.reconstruct(scan, fine, "mbir"),
        "MBIR kept": lambda scan: recon.reconstruct(scan, fine, "mbir", **learned),
        "MBIR + tissues kept": lambda scan: recon.reconstruct(scan, fine, "mbir", tissues=True, **learned),
        "reading of tissues kept": read,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--exposure", type=float, default=2.0, metavar="S")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    options = parser.parse_args()
    scene, plaque = plaque_scene()
    coarse, fine = inset_grid(plaque, 0.25), inset_grid(plaque, 0.2)
    region = VolumeGrid((1, 1, 1), tuple(np.maximum(coarse.extent, fine.extent)), fine.center)
    clean = acquire(scene, presets.pcct(), region=region)
    truth = {grid: true_volume(scene, grid) for grid in (coarse, fine)}
    run = methods(coarse, fine, clean)
    seconds: dict[str, list[float]] = {name: [] for name in run}
    squares: dict[str, list[float]] = {name: [] for name in run}
    for k in range(options.rounds + 1):
        scan = clean.with_noise(options.exposure, k)
        for name, method in run.items():
            began = time.perf_counter()
            volume = method(scan)
            if k:
                seconds[name].append(time.perf_counter() - began)
                if volume is not None:
                    true, vessel = truth[volume.grid]
                    squares[name].append(float((volume.data - true)[vessel].square().mean()))
    rows = [
        {"method": name, "seconds": float(np.median(s)), "least_seconds": min(s), "most_seconds": max(s),
         **({"rmse_vessel_hu": float(np.sqrt(np.mean(squares[name])))} if squares[name] else {})}
        for name, s in seconds.items()
    ]  # fmt: skip
    shapes = {"coarse": list(coarse.shape), "fine": list(fine.shape)}
    result = {"command": f"python tests/bench/inset_times.py --rounds {options.rounds}", **environment(),
              "threads": [torch.get_num_threads(), get_num_threads()], "shapes": shapes,
              "exposure_s": options.exposure, "rows": rows}  # fmt: skip
    with atomic_write(options.out) as part:
        part.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    for row in rows:
        print(f"{row['method']:26} {row['seconds']:6.2f} s [{row['least_seconds']:.2f}, {row['most_seconds']:.2f}]  "
              f"{row.get('rmse_vessel_hu', float('nan')):.1f} HU")  # fmt: skip


if __name__ == "__main__":
    main()
