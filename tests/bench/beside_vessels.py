"""Readings of the paper's vessel beside a second one, of a vessel without contrast agent, and of sound plaques.

    python tests/bench/beside_vessels.py [--particles 300] [--work out/bench-beside] [--scans FOLDER]

Second vessels (lumen 1.6-3 mm, wall 0.2 mm) run along the paper's vessel or cross it, 0.5-3 mm apart, over all of the
inset; they and vessels whose lumen has 40 HU are painted on 0.1 mm voxels. No such vessel holds a plaque body: a figure
of one, without a warning, is a false claim. Sound are the paper's plaque, scanned, and held-out ones of training; a
reading of those that is refused as a whole, or says that something stands beside the vessel, is a false refusal.
Finished readings in the work folder are kept; ``beside_vessels.json`` beside this tells all of them.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from plaque import TISSUES_HU, Draws
from torch import Tensor

from recon.evaluate.vessels import vessel
from recon.plaque import TissueData, read_plaque
from torchpcct import Projector
from torchpcct.files import atomic_write
from torchpcct.geometry import VolumeGrid

FIRST_SEED, OUTER_MM, WALL_MM, WALL_HU, PLAIN_BLOOD_HU, HALF_MM = 9000, 1.7, 0.2, 50.0, 40.0, 4.2
EXPOSURES_S = {"second vessel": (0.35, 0.7), "no contrast agent": (0.35, 0.7), "sound": (0.35, 0.7, 2.0)}
COUNTS = {"second vessel": 16, "no contrast agent": 8, "sound": 8}
"""Of each exposure."""


def tube(grid: VolumeGrid, k: int) -> tuple[Any, Any]:
    """``grid.shape`` masks of second vessel k, all of it and its lumen: even k run along the first, odd cross it."""
    rng = np.random.default_rng(FIRST_SEED + k)
    while True:
        radius, gap, turn = rng.uniform(0.8, 1.5), rng.uniform(0.5, 3.0), rng.uniform(0, 2 * np.pi)
        off = (OUTER_MM + gap + WALL_MM + radius) * np.array([np.sin(turn), np.cos(turn)])
        if np.abs(off).max() < HALF_MM:
            break
    if k % 2:
        along, z = np.array([rng.uniform(-0.5, 0.5), np.cos(turn), -np.sin(turn)]), rng.uniform(-2.5, 2.5)
    else:
        tilt, side = rng.uniform(0, 0.35), rng.uniform(0, 2 * np.pi)
        along, z = np.array([np.cos(tilt), np.sin(tilt) * np.sin(side), np.sin(tilt) * np.cos(side)]), 0.0
    offsets = (a - c - o for a, c, o in zip(grid.axes, grid.center, (z, *off), strict=True))
    p = np.meshgrid(*offsets, indexing="ij", sparse=True)
    rho2 = sum(v * v for v in p) - sum(v * d for v, d in zip(p, along / np.linalg.norm(along), strict=True)) ** 2
    return rho2 < (radius + WALL_MM) ** 2, rho2 < radius**2


def statistic(draws: Draws, kind: str, k: int, exposure_s: float) -> Tensor:
    """AᵀW y of reading k, noisy."""
    problem, seed = draws.problem, FIRST_SEED + k
    if kind == "sound" and k % 2:
        return problem.statistic(draws.clean("paper").with_noise(exposure_s, seed)).b
    gram, hu = problem.gram.scaled(exposure_s), problem.mu_ref / 1000.0
    if kind == "sound":
        image = draws._held_out(8 * seed + k // 2)[0]
        b = gram.apply(image * hu + problem.mu_ref - problem.level)
    else:
        g, fat = problem.grid, TISSUES_HU["fat"]
        fine = VolumeGrid(tuple(2 * n for n in g.shape), g.spacing[0] / 2, g.center)
        blood = PLAIN_BLOOD_HU if kind == "no contrast agent" else TISSUES_HU["lumen"]
        values = {n: TISSUES_HU[n] - fat for n in ("wall", "fibrous")} | {"lumen": blood - fat}
        values["core"] = values["fibrous"]
        above = vessel("straight", problem.grid.center).painted(fine, values)
        if kind == "second vessel":
            for part, value in zip(tube(fine, k), (WALL_HU, TISSUES_HU["lumen"]), strict=True):
                above[part] = value - fat
        lines = Projector(problem.geometry, fine, problem.window)(torch.as_tensor(above * hu, dtype=gram.dtype))
        b = problem.projector.T(problem.weights * lines).to(gram.dtype) * exposure_s
    return b + gram.noise(generator=torch.Generator().manual_seed(seed))


def read(draws: Draws, kind: str, k: int, exposure_s: float, particles: int) -> dict[str, Any]:
    """What is kept of a reading."""
    start = time.process_time()
    data = TissueData.of_statistic(statistic(draws, kind, k, exposure_s), draws.problem, exposure_s)
    try:
        r = read_plaque(data, particles=particles, seed=FIRST_SEED + k)
    except ValueError as error:
        found: dict[str, Any] = {"outcome": "refused in words", "error": str(error)}
    else:
        claims = [n for n in r.figures if n in r.given_core]
        outcome = "warned" if r.warnings else "taken off" if r.taken_off_hu else "claims" if claims else "no core said"
        found = {"outcome": outcome, "claims": claims, "presence": r.presence, "calcifications": r.calcifications,
                 "contrast": r.given_core["contrast"].value, "lumen": r.figures["lumen"].value, "left": r.left.score,
                 "chi2": r.chi2, "chi2_sd": r.chi2_sd, "taken_off_hu": r.taken_off_hu}  # fmt: skip
    return {"kind": kind, "exposure_s": exposure_s, "k": k, "cpu_s": time.process_time() - start} | found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--particles", type=int, default=300)
    parser.add_argument("--work", type=Path, default=Path("out/bench-beside"), help="folder for finished readings")
    parser.add_argument("--scans", type=Path, help="folder with noise-free scans")
    draws = Draws((options := parser.parse_args()).work, options.scans)
    options.work.mkdir(parents=True, exist_ok=True)
    for k, (kind, n), e in product(range(max(COUNTS.values())), COUNTS.items(), EXPOSURES_S["sound"]):
        path = options.work / f"{kind.replace(' ', '_')}_{e:g}s_{k}.json"
        if k < n and e in EXPOSURES_S[kind] and not path.exists():
            print(found := read(draws, kind, k, e, options.particles), flush=True)
            with atomic_write(path) as part:
                part.write_text(json.dumps(found), encoding="utf-8")
    rows = [json.loads(p.read_text(encoding="utf-8")) for p in sorted(options.work.glob("*.json"))]
    told = {f"{kind}, {e:g} s": dict(Counter(r["outcome"] for r in rows if (r["kind"], r["exposure_s"]) == (kind, e)))
            for kind in COUNTS for e in EXPOSURES_S[kind]}  # fmt: skip
    result = {"particles": options.particles, "outcomes": told, "readings": rows}
    with atomic_write(Path(__file__).with_suffix(".json")) as part:
        part.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(told, indent=1))


if __name__ == "__main__":
    main()
