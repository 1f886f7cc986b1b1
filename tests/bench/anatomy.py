"""MBIR on anatomy that its training never saw: a thorax, whole field of view, beside FBP and PWLS.

    python tests/bench/anatomy.py [--slices 12] [--photons 1e3 3e4] [--methods NAME …] [--out tests/bench/anatomy.json]

A stack of fan-beam slices (600 views, 560 cells of 0.91 mm at the axis) of the analytic thorax, which leans by 0.7
voxels from slice to slice, so that the third dimension helps as it would in a patient; exact path lengths at 70 keV,
Poisson noise. And its middle slice alone. Error: root mean square inside the body against volume-weighted true values;
and of the regions (voxels three or more away from another tissue) the mean error, which is what a prior could invent,
and the standard deviation, which is noise and what it could invent in detail. FBP soft + Gauss: blurred in all three
dimensions, by that of a few widths which has the least error in the body: the best that a Gauss can do, by a look at
the truth. Each method's error stands over that of FBP soft, and over that of the better FBP kernel at that exposure.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import ndimage

import recon
from recon.study.study import environment
from torchpcct.acquisition.path_lengths import tissue_path_lengths
from torchpcct.files import atomic_write
from torchpcct.geometry import ConeBeam, FanBeam, VolumeGrid, full_turn
from torchpcct.scan import Scan
from torchpcct.scene.materials import material
from torchpcct.scene.phantoms import thorax

KEV, VOXEL_MM, SIDE, LEAN = 70.0, 0.9, 440, (0.6, 0.36)
VIEWS, COLUMNS, PITCH_MM, SOD_MM, SDD_MM = 600, 560, 1.6, 541.0, 949.0
METHODS: dict[str, tuple[str, dict[str, Any]]] = {
    "FBP soft": ("fbp", {"kernel": "soft"}), "FBP standard": ("fbp", {"kernel": "standard"}),
    "PWLS": ("pwls", {}), "MBIR": ("mbir", {}),
}  # fmt: skip
BLURRED, WIDTHS = "FBP soft + Gauss", (0.3, 0.4, 0.5, 0.6, 0.7, 0.85, 1.0, 1.2, 1.5, 2.0)
"""A method, and the standard deviations in voxels that it chooses from."""
REGIONS = ("lungs", "heart", "muscle", "vertebra_marrow", "mediastinum")
_INNER = 3


@dataclass(frozen=True)
class Anatomy:
    """Exact line integrals ``(slices, views, columns)``, truth in HU ``(slices, y, x)``, the body, and regions."""

    lines: torch.Tensor
    true: torch.Tensor
    body: torch.Tensor
    regions: dict[str, torch.Tensor]
    mu_water: float

    def middle(self) -> Anatomy:
        """The middle slice alone."""
        k = slice(len(self.lines) // 2, len(self.lines) // 2 + 1)
        return Anatomy(self.lines[k], self.true[k], self.body[k], {n: r[k] for n, r in self.regions.items()},
                       self.mu_water)  # fmt: skip


def anatomy(slices: int) -> Anatomy:
    """The leaning thorax."""
    angles = full_turn(VIEWS)
    one = ConeBeam(angles, SOD_MM, SDD_MM, COLUMNS, 1, PITCH_MM)
    section = VolumeGrid((1, SIDE, SIDE), VOXEL_MM)
    mu_water = float(np.ravel(material("water").attenuation(KEV))[0])
    lines, true, labels = [], [], []
    for k in range(slices):
        shift = (k - slices // 2) * VOXEL_MM
        scene = thorax(center=(shift * LEAN[0], shift * LEAN[1]))
        groups: dict[float, list[str]] = {}
        for name, tissue in zip(scene.names, scene.materials, strict=True):
            groups.setdefault(float(np.ravel(tissue.attenuation(KEV))[0]), []).append(name)
        paths = tissue_path_lengths(scene, list(groups.values()), one)
        lines.append(torch.tensordot(torch.tensor(list(groups)), paths[:, :, 0], dims=1))
        true.append(torch.from_numpy(scene.material_map(section, KEV)[0] / mu_water * 1000.0 - 1000.0).float())
        labels.append(scene.labels(section)[0])
    found = {name: np.stack([ndimage.binary_erosion(at == scene.index(name), iterations=_INNER) for at in labels])
             for name in REGIONS}  # fmt: skip
    return Anatomy(torch.stack(lines), torch.stack(true), torch.from_numpy(np.stack(labels) >= 0),
                   {n: torch.from_numpy(r) for n, r in found.items()}, mu_water)  # fmt: skip


def error_of(part: Anatomy, volume: torch.Tensor) -> dict[str, Any]:
    """In the body, and mean error and SD of each region, HU."""
    off = volume.reshape(part.true.shape) - part.true
    return {
        "rmse_hu": float(off[part.body].square().mean().sqrt()),
        "mean_error_hu": {n: float(off[r].mean()) for n, r in part.regions.items()},
        "sd_hu": {n: float(off[r].std()) for n, r in part.regions.items()},
    }  # fmt: skip


def blurred(part: Anatomy, volume: torch.Tensor) -> dict[str, Any]:
    """:func:`error_of` the volume after the Gauss that leaves the least."""
    found = []
    for width in WIDTHS:
        image = torch.from_numpy(ndimage.gaussian_filter(volume.reshape(part.true.shape).numpy(), width))
        found.append({**error_of(part, image), "width_voxels": width, "warnings": []})
    return min(found, key=lambda of: float(of["rmse_hu"]))


def compared(found: dict[str, Any]) -> dict[str, Any]:
    """With each error over FBP soft's, and over the better FBP kernel's."""
    soft, best = found["FBP soft"]["rmse_hu"], min(found[n]["rmse_hu"] for n in ("FBP soft", "FBP standard"))
    over = {n: {"over_soft_fbp": of["rmse_hu"] / soft, "over_better_fbp": of["rmse_hu"] / best}
            for n, of in found.items()}  # fmt: skip
    return {n: {**of, **over[n]} for n, of in found.items()}


def figures(part: Anatomy, photons: float, names: list[str]) -> dict[str, Any]:
    """Method → :func:`error_of` it, of one noise realisation."""
    geometry = FanBeam(full_turn(VIEWS), SOD_MM, SDD_MM, COLUMNS, PITCH_MM)
    grid = VolumeGrid(tuple(part.true.shape), VOXEL_MM)
    counts = torch.poisson(photons * torch.exp(-part.lines.double()), generator=torch.Generator().manual_seed(0))
    scan = Scan.from_counts(counts.float(), geometry, air=photons, mu_water=part.mu_water)
    found: dict[str, Any] = {}
    for name in names:
        began = time.perf_counter()
        if name == BLURRED:
            found[name] = blurred(part, recon.reconstruct(scan, grid, "fbp", kernel="soft").data)
        else:
            method, options = METHODS[name]
            volume = recon.reconstruct(scan, grid, method, **options)
            found[name] = {**error_of(part, volume.data), "warnings": list(volume.report.get("warnings", []))}
        found[name]["seconds"] = time.perf_counter() - began
    return found


def main() -> None:
    """The file is written after every dose."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--slices", type=int, default=12)
    parser.add_argument("--photons", type=float, nargs="+", default=[1e3, 3e4], help="of an unattenuated reading")
    names = [*METHODS, BLURRED]
    parser.add_argument("--methods", nargs="+", choices=names, default=names, metavar="NAME",
                        help="only these; the file keeps the others")  # fmt: skip
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    options = parser.parse_args()
    whole = anatomy(options.slices)
    kept: dict[Any, Any] = {}
    if options.out.exists() and len(options.methods) <= len(METHODS):
        before = json.loads(options.out.read_text(encoding="utf-8"))["runs"]
        kept = {(run["data"], run["photons"]): run["methods"] for run in before}
    result: dict[str, Any] = {
        "command": f"python tests/bench/anatomy.py --slices {options.slices}", **environment(),
        "voxels": {n: int(r.sum()) for n, r in whole.regions.items()}, "runs": [],
    }  # fmt: skip
    for photons in options.photons:
        for name, part in (("stack", whole), ("slice", whole.middle())):
            found = {**kept.get((name, photons), {}), **figures(part, photons, options.methods)}
            result["runs"].append({"data": name, "photons": photons, "methods": compared(found)})
            with atomic_write(options.out) as file:
                file.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
