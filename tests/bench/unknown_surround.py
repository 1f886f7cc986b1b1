"""What an unknown surround costs: PWLS and MBIR of the plaque in a whole scan, beside the same with its true surround.

    python tests/bench/unknown_surround.py [--draws 8] [--views 1968] [--out tests/bench/unknown_surround.json]

Patients, scanned on the whole detector: the paper's cylinder of fat, and a thorax with ribs, spine and lungs, the
plaque in the fat beside the vertebra, once with columns enough and once cut off on both sides (984 views).
True surround: the line
integrals of the same patient without the plaque, noise free, are taken off. Both ways see the same readings, weights
and noise. Error: of the mean of the paper's ROIs, noise free, and of all voxels of the inset's middle half (root mean
square). SD: of the voxels in that half over all draws, their mean over the draws taken off. Seconds are those of the
processor, from the scan to the volume; the problem's include the surround of the first scan, which is kept.
"""

from __future__ import annotations

import argparse
import json
import logging
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from recon.fbp.fbp import fbp
from recon.mbir.mbir import Mbir
from recon.pwls.inset_problem import DEFAULT_PRIOR, InsetProblem
from recon.pwls.pwls import pwls
from recon.study.paper.plaque_scan import inset_grid
from torchpcct.acquisition.acquire import acquire
from torchpcct.files import written_whole
from torchpcct.metrics.placement import place_rois
from torchpcct.metrics.roi import axial_grid
from torchpcct.scan import Scan
from torchpcct.scanner import presets
from torchpcct.scene.phantoms import thorax
from torchpcct.scene.plaque import Plaque, plaque_scene
from torchpcct.scene.scene import Body, Scene
from torchpcct.volume import to_hu

DOSE = 2.0
IN_THE_MEDIASTINUM = (-40.0, -79.0, 0.0)
"""Of the thorax's plaque, mm: in fat, 9 mm beside the vertebra and as far from the lung."""


WIDE = 2000
"""Columns that hold the thorax; the scanner's own 1500 cut it off at both arms."""


def patients() -> dict[str, tuple[Scene, Scene, Plaque, int]]:
    """With the plaque, without it, the plaque, and the detector's columns. The inset around it is all fat."""
    with_plaque, plaque = plaque_scene()
    chest, inside = thorax(), Plaque(position=IN_THE_MEDIASTINUM)
    vessel = [
        Body(b.name, getattr(inside, "outer" if b.name == "wall" else "inner" if b.name == "fibrous" else b.name),
             b.material, b.parent if b.parent != "patient" else "mediastinum")
        for b in with_plaque.bodies if b.parent is not None
    ]  # fmt: skip
    return {
        "cylinder of 24 cm": (with_plaque, Scene([b for b in with_plaque.bodies if b.parent is None]), plaque, 1500),
        "thorax": (chest.add(*vessel), chest, inside, WIDE),
        "thorax, cut off": (chest.add(*vessel), chest, inside, 1500),
    }


class Ways:
    """One patient's scan, read with the surround unknown and known."""

    def __init__(self, scene: Scene, alone: Scene, plaque: Plaque, columns: int, views: int) -> None:
        # Of a thorax no reading is like another: half the views and thin rays make it minutes instead of an hour.
        many = len(alone.bodies) > 1
        views = views // 2 if many else views
        scanner = presets.pcct(views=views, columns=columns)
        self.grid = inset_grid(plaque, 0.2)
        self.scan, without = (
            acquire(s, scanner, duty=views / 1968, sub_rays=1 if many else None) for s in (scene, alone)
        )
        self.rois = place_rois(scene, axial_grid(self.grid.center)).on(self.grid)
        self.network = Mbir.load()
        began = time.process_time()
        self.problem = InsetProblem(self.scan, self.grid)
        self.seconds_made = time.process_time() - began
        # The fat inside the inset is the inset's own.
        around = without.line_integrals()
        fat = float(fbp(around, self.scan.geometry, self.grid, outside=self.problem.mu_ref).mean())
        own = self.problem.projector(torch.full(self.grid.shape, fat - self.problem.level))
        self.around = self._crop(around) - own

    def _crop(self, lines: Tensor) -> Tensor:
        return self.problem.outer.crop(lines, self.problem.window)

    def known(self, scan: Scan) -> Tensor:
        """What :meth:`InsetProblem.data` gives, from the true surround."""
        return self._crop(scan.line_integrals()) - self.around


def volumes(ways: Ways, scan: Scan, dose: float) -> tuple[dict[str, Tensor], dict[str, float]]:
    """``"method, way"`` → volume in HU; seconds of each step."""
    problem, seconds = ways.problem, {}
    began = time.process_time()
    data = {"unknown": problem.data(scan)}
    seconds["unknown surround"] = time.process_time() - began
    data["known"] = ways.known(scan)
    found = {}
    for way, y in data.items():
        began = time.process_time()
        result = pwls(
            problem.projector, y, problem.weights * dose, DEFAULT_PRIOR, hu=problem.mu_ref / 1000.0,
            gram=problem.model.scaled(dose), tolerance=0.3,
        )  # fmt: skip
        found[f"pwls, {way}"] = to_hu(result.x + problem.level, problem.mu_ref)
        seconds["pwls"] = time.process_time() - began
        began = time.process_time()
        with torch.no_grad():
            found[f"mbir, {way}"] = ways.network(problem, problem.statistic(scan, y).b[None], dose)[0]
        seconds["mbir"] = time.process_time() - began
    return found, seconds


def middle(volumes: Tensor) -> Tensor:
    """The middle half of ``(..., z, y, x)`` along every axis."""
    for axis in (-3, -2, -1):
        n = volumes.shape[axis]
        volumes = volumes.narrow(axis, n // 4, n // 2)
    return volumes


def measured(ways: Ways, draws: int) -> dict[str, Any]:
    """All figures of one patient."""
    clean, _ = volumes(ways, ways.scan, 1.0)
    noisy: dict[str, list[Tensor]] = {}
    spent: list[dict[str, float]] = []
    for seed in range(draws):
        found, seconds = volumes(ways, ways.scan.with_noise(DOSE, seed), DOSE)
        spent.append(seconds)
        for name, volume in found.items():
            noisy.setdefault(name, []).append(volume)
    result: dict[str, Any] = {}
    for method in ("pwls", "mbir"):
        error = clean[f"{method}, unknown"] - clean[f"{method}, known"]
        stacks = [torch.stack(noisy[f"{method}, {way}"]) for way in ("unknown", "known")]
        sd = [float(middle(s - s.mean(0)).square().sum().div(middle(s).numel() * (1 - 1 / draws)).sqrt())
              for s in stacks]  # fmt: skip
        shifts = [[float(roi(u) - roi(k)) for roi in ways.rois] for u, k in zip(*stacks, strict=True)]
        result[method] = {
            "roi_error_hu": [float(roi(error)) for roi in ways.rois],
            "rms_error_hu": float(middle(error).square().mean().sqrt()),
            "sd_hu": dict(zip(("unknown", "known"), sd, strict=True)), "sd_ratio": sd[0] / sd[1],
            "roi_error_noisy_hu": np.mean(shifts, 0).tolist(), "roi_error_noisy_sd_hu": np.std(shifts, 0).tolist(),
        }  # fmt: skip
    result["seconds"] = {name: float(np.median([s[name] for s in spent])) for name in spent[0]}
    result["seconds"]["problem"] = ways.seconds_made
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--draws", type=int, default=8)
    parser.add_argument("--views", type=int, default=1968)
    parser.add_argument("--patients", nargs="*", metavar="NAME", help="only these; the file keeps the others")
    parser.add_argument("--out", type=Path, default=Path("tests/bench/unknown_surround.json"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    logging.disable(logging.WARNING)
    found: dict[str, Any] = json.loads(options.out.read_text(encoding="utf-8")) if options.out.exists() else {}
    found |= {"exposure_s": DOSE, "threads": 1}
    for name, patient in patients().items():
        if options.patients and name not in options.patients:
            continue
        ways = Ways(*patient, options.views)
        result = {"views": ways.scan.geometry.views, "draws": options.draws, **measured(ways, options.draws)}
        print(name, json.dumps(result, indent=1), flush=True)
        found[name] = result
        with written_whole(options.out) as part:
            part.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
