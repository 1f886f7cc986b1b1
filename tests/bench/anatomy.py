"""MBIR on anatomy that its training never saw: a thorax, whole field of view, beside FBP and PWLS.

    python tests/bench/anatomy.py [--slices 12] [--photons 1e3 3e4] [--out tests/bench/anatomy.json]

A stack of fan-beam slices (600 views, 560 cells of 0.91 mm at the axis) of the analytic thorax, which leans by 0.7
voxels from slice to slice, so that the third dimension helps as it would in a patient; exact path lengths at 70 keV,
Poisson noise. And its middle slice alone. Error: root mean square inside the body against volume-weighted true values;
and of the regions (voxels three or more away from another tissue) the mean error, which is what a prior could invent,
and the standard deviation, which is noise and what it could invent in detail.
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
from torchpcct.files import written_whole
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


def figures(part: Anatomy, photons: float) -> dict[str, Any]:
    """Method → error in the body, and mean error and SD of each region, HU; one noise realisation."""
    geometry = FanBeam(full_turn(VIEWS), SOD_MM, SDD_MM, COLUMNS, PITCH_MM)
    grid = VolumeGrid(tuple(part.true.shape), VOXEL_MM)
    counts = torch.poisson(photons * torch.exp(-part.lines.double()), generator=torch.Generator().manual_seed(0))
    scan = Scan.from_counts(counts.float(), geometry, air=photons, mu_water=part.mu_water)
    found: dict[str, Any] = {}
    for name, (method, options) in METHODS.items():
        began = time.perf_counter()
        volume = recon.reconstruct(scan, grid, method, **options)
        off = volume.data.reshape(part.true.shape) - part.true
        found[name] = {
            "rmse_hu": float(off[part.body].square().mean().sqrt()),
            "mean_error_hu": {n: float(off[r].mean()) for n, r in part.regions.items()},
            "sd_hu": {n: float(off[r].std()) for n, r in part.regions.items()},
            "warnings": list(volume.report.get("warnings", [])), "seconds": time.perf_counter() - began,
        }  # fmt: skip
    least = found["FBP soft"]["rmse_hu"]
    return {name: {**of, "over_soft_fbp": of["rmse_hu"] / least} for name, of in found.items()}


def main() -> None:
    """The file is written after every dose."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--slices", type=int, default=12)
    parser.add_argument("--photons", type=float, nargs="+", default=[1e3, 3e4], help="of an unattenuated reading")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    options = parser.parse_args()
    whole = anatomy(options.slices)
    result: dict[str, Any] = {
        "command": f"python tests/bench/anatomy.py --slices {options.slices}", **environment(),
        "voxels": {n: int(r.sum()) for n, r in whole.regions.items()}, "runs": [],
    }  # fmt: skip
    for photons in options.photons:
        for name, part in (("stack", whole), ("slice", whole.middle())):
            result["runs"].append({"data": name, "photons": photons, "methods": figures(part, photons)})
            with written_whole(options.out) as file:
                file.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
