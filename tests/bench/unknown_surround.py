"""What an unknown surround costs: PWLS and MBIR of the plaque in a whole scan, beside the same with its true surround.

    python tests/bench/unknown_surround.py [--draws 4] [--out tests/bench/unknown_surround.json]

Patients: the paper's cylinder of fat, simulated with all effects (1968 views); a thorax with ribs, spine and lungs,
drawn on voxels of 0.55 mm and projected at one energy (984 views) onto columns that hold it, the plaque in the fat
beside the vertebra. (With a spectrum, bones harden the beam, and readings contradict each
other: what a volume should show then is a matter of weights.) True surround: the line integrals of the same patient
without the plaque, noise free, are taken off. Both ways see the same readings, weights and noise. Error: of the mean of
the paper's ROIs, noise free, and of all voxels of the inset's middle half (root mean square). SD: of the voxels in that
half over all draws, their mean over the draws taken off. Seconds are those of the processor, on one thread; the
problem's include the surround of the first scan, which is kept.
"""

from __future__ import annotations

import argparse
import json
import logging
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rod_values import ROD_HU
from torch import Tensor

from recon.analytic.fbp import fbp
from recon.least_squares.inset_problem import DEFAULT_PRIOR, InsetProblem
from recon.least_squares.pwls import pwls
from recon.mbir.mbir import Mbir
from recon.study.paper.plaque_scan import inset_grid
from torchpcct import Projector, VolumeGrid
from torchpcct.acquisition.acquire import acquire
from torchpcct.files import atomic_write
from torchpcct.metrics.placement import place_rois
from torchpcct.metrics.roi import axial_grid
from torchpcct.scan import Scan
from torchpcct.scanner import presets
from torchpcct.scene.phantoms import thorax
from torchpcct.scene.plaque import Plaque, plaque_scene
from torchpcct.scene.scene import Scene
from torchpcct.volume import to_hu

IN_THE_MEDIASTINUM = (-40.0, -79.0, 0.0)
"""Of the thorax's plaque, mm: in fat, 9 mm beside the vertebra and as far from the lung."""
WIDE = 2000
"""Columns that hold the thorax; the scanner's own 1500 would cut it off, and PWLS and MBIR would refuse it."""
TISSUES_HU = {"patient" if name == "fat" else name: value for name, value in ROD_HU.items()}
KEV, PHOTONS, MU_WATER = 70.0, 4e5, 0.0193
CYLINDER, THORAX = "cylinder of 24 cm", "thorax"


@dataclass(frozen=True)
class Patient:
    """A scan and what is true of it.

    Attributes:
        scan: noise free; of the exposure ``dose`` is a ``noisy`` one by its seed.
        around: line integrals without the plaque, of the whole detector.
        fat: mm⁻¹ inside the inset, without the plaque.
    """

    scan: Scan
    noisy: Callable[[int], Scan]
    dose: float
    around: Tensor
    fat: float
    grid: VolumeGrid
    rois: Any


def cylinder() -> Patient:
    """The paper's."""
    scene, plaque = plaque_scene()
    alone = Scene([b for b in scene.bodies if b.parent is None])
    grid, scanner, dose = inset_grid(plaque, 0.2), presets.pcct(), 2.0
    scan, without = (acquire(s, scanner) for s in (scene, alone))
    around = without.line_integrals()
    fat = float(fbp(around, scan.geometry, grid).mean())
    rois = place_rois(scene, axial_grid(grid.center)).on(grid)
    return Patient(scan, lambda seed: scan.with_noise(dose, seed), dose, around, fat, grid, rois)


def chest() -> Patient:
    """The thorax, and in its fat the paper's plaque."""
    plaque = Plaque(position=IN_THE_MEDIASTINUM)
    geometry = presets.pcct(views=984, columns=WIDE).geometry
    # Constant along z: as many slices as the rays of all rows cross.
    slices = VolumeGrid((14, 680, 680), (1.2, 0.55, 0.55))
    section = VolumeGrid((1, *slices.shape[1:]), slices.spacing)
    mu = torch.from_numpy(np.asarray(thorax().material_map(section, KEV))).float()
    around = Projector(geometry, slices)(mu.expand(slices.shape).contiguous())
    grid = inset_grid(plaque, 0.2)
    vessel = plaque_scene(plaque)[0]
    image = torch.from_numpy(np.asarray(vessel.render(grid, TISSUES_HU))).float()
    y, x = (np.abs(a - c) < 3.0 for a, c in zip(section.axes[1:], grid.center[1:], strict=True))
    fat = float(mu[0][np.ix_(y, x)].mean())
    lines = around + Projector(geometry, grid)((image - TISSUES_HU["patient"]) * (MU_WATER / 1000.0))
    expected = PHOTONS * torch.exp(-lines)

    def scanned(counts: Tensor) -> Scan:
        return Scan.from_counts(counts, geometry, air=PHOTONS, mu_water=MU_WATER)

    def noisy(seed: int) -> Scan:
        return scanned(torch.poisson(expected, generator=torch.Generator().manual_seed(seed)))

    rois = place_rois(vessel, axial_grid(grid.center)).on(grid)
    return Patient(scanned(expected), noisy, 1.0, around, fat, grid, rois)


def patients() -> Iterator[tuple[str, Callable[[], Patient]]]:
    """By name."""
    yield CYLINDER, cylinder
    yield THORAX, chest


class Ways:
    """One patient's scan, read with the surround unknown and known."""

    def __init__(self, patient: Patient) -> None:
        self.patient, self.network = patient, Mbir.load()
        began = time.process_time()
        self.problem = InsetProblem(patient.scan, patient.grid)
        self.seconds_made = time.process_time() - began
        # The fat inside the inset is the inset's own.
        own = self.problem.projector(torch.full(patient.grid.shape, patient.fat - self.problem.level))
        self.around = self._crop(patient.around) - own

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
            problem.projector, y, problem.weights * dose, DEFAULT_PRIOR, mu_per_hu=problem.mu_ref / 1000.0,
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
    patient = ways.patient
    clean, _ = volumes(ways, patient.scan, 1.0)
    noisy: dict[str, list[Tensor]] = {}
    spent: list[dict[str, float]] = []
    for seed in range(draws):
        found, seconds = volumes(ways, patient.noisy(seed), patient.dose)
        spent.append(seconds)
        for name, volume in found.items():
            noisy.setdefault(name, []).append(volume)
    result: dict[str, Any] = {}
    for method in ("pwls", "mbir"):
        error = clean[f"{method}, unknown"] - clean[f"{method}, known"]
        stacks = [torch.stack(noisy[f"{method}, {way}"]) for way in ("unknown", "known")]
        sd = [float(middle(s - s.mean(0)).square().sum().div(middle(s).numel() * (1 - 1 / draws)).sqrt())
              for s in stacks]  # fmt: skip
        shifts = [[float(roi(u) - roi(k)) for roi in patient.rois] for u, k in zip(*stacks, strict=True)]
        at = [float(roi(error)) for roi in patient.rois]
        result[method] = {
            "roi_error_hu": at, "worst_roi_error_hu": max(map(abs, at)),
            "rms_error_hu": float(middle(error).square().mean().sqrt()),
            "sd_hu": dict(zip(("unknown", "known"), sd, strict=True)), "sd_ratio": sd[0] / sd[1],
            "roi_error_noisy_hu": np.mean(shifts, 0).tolist(), "roi_error_noisy_sd_hu": np.std(shifts, 0).tolist(),
        }  # fmt: skip
    result["seconds"] = {name: float(np.median([s[name] for s in spent])) for name in spent[0]}
    result["seconds"]["problem"] = ways.seconds_made
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--draws", type=int, default=4)
    parser.add_argument("--patients", nargs="*", metavar="NAME", help="only these; the file keeps the others")
    parser.add_argument("--out", type=Path, default=Path("tests/bench/unknown_surround.json"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    logging.disable(logging.WARNING)
    found: dict[str, Any] = json.loads(options.out.read_text(encoding="utf-8")) if options.out.exists() else {}
    for name, make in patients():
        if options.patients and name not in options.patients:
            continue
        ways = Ways(make())
        geometry = ways.patient.scan.geometry
        found[name] = {"views": geometry.views, "columns": geometry.columns, "draws": options.draws, "threads": 1,
                       **measured(ways, options.draws)}  # fmt: skip
        print(name, json.dumps(found[name], indent=1), flush=True)
        with atomic_write(options.out) as part:
            part.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
