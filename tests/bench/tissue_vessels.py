"""MBIR with tissues on the paper's plaque in vessels of other directions, beside MBIR alone.

    python tests/bench/tissue_vessels.py [--draws 12] [--doses 0.35 2.0] [--vessels NAME ...] [--out notebooks/plaque]

Vessels are those of the dose-factor study (`recon.evaluate.vessels`), painted on 0.1 mm voxels, with
their core and with fibrous tissue in its place; all carry the same noise, of the paper scan's Gram operator. A reading
is blind. Contrast is that of all of core and fibrous tissue (± standard error), RMSE that of the voxels of vessel wall
and lumen against the painted truth.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from results import write_results
from rod_values import ROD_HU
from tissues import reconstructed

from recon.evaluate.vessels import vessel
from recon.mbir.mbir import Mbir
from recon.mbir.tissues import TissueMbir
from recon.pwls.inset_problem import InsetProblem
from recon.study.dose_factor.settings import VESSEL_ROIS, VESSELS
from recon.study.dose_factor.vessels import fine_grid, projected
from recon.study.paper.plaque_scan import inset_grid
from torchpcct.acquisition.acquire import acquire
from torchpcct.scanner import presets
from torchpcct.scene.plaque import plaque_scene

TISSUES_HU = {name: value - ROD_HU["fat"] for name, value in ROD_HU.items() if name != "fat"}
"""Above the fat."""
DEFAULT = ["straight", "tilted", "in_plane_x", "curved_5mm", "bifurcating"]


def measured(problem: InsetProblem, name: str, doses: list[float], draws: int) -> dict[str, Any]:
    """Dose → method → figures of one vessel."""
    shape, grid = vessel(name, problem.grid.center), fine_grid(problem.grid)
    values = TISSUES_HU
    twin = {**values, "core": values["fibrous"]}
    hu = problem.mu_ref / 1000.0
    painted = np.stack([shape.painted(grid, v) for v in (values, twin)])
    clean = projected(problem, painted * hu, grid).to(torch.float32)
    n = problem.grid.shape
    factor = grid.shape[0] // n[0]
    true = torch.from_numpy(painted.reshape(2, n[0], factor, n[1], factor, n[2], factor).mean((2, 4, 6)))
    true = true + (problem.level / problem.mu_ref - 1.0) * 1000.0
    vessel_voxels = true > true.min() + 10.0
    pairs = [shape.rois(roi).on(problem.grid) for roi in VESSEL_ROIS]
    network = Mbir.load()
    methods = {"mbir": network, "mbir_tissues": TissueMbir(network)}
    found: dict[str, Any] = {}
    for dose in doses:
        rows: dict[str, list[Any]] = {k: [] for k in methods}
        used, presence, gram = 0, [], problem.gram.scaled(dose)
        for k in range(draws):
            noise = gram.noise(generator=torch.Generator().manual_seed(k))
            for label, method in methods.items():
                row = []
                for i in range(2):
                    b = (clean[i] * dose + noise)[None]
                    volume, tissues = reconstructed(method, problem, b, dose)
                    if tissues is not None:
                        used += tissues["used"]
                        presence.append(tissues.get("presence", float("nan")))
                    contrast = [float(fibrous(volume)) - float(core(volume)) for core, fibrous in pairs]
                    inside = vessel_voxels[i]
                    row.append([*contrast, float((volume - true[i])[inside].square().mean())])
                rows[label].append(row)
        found[f"{dose:g}"] = {
            "used": used, "of": 2 * draws, "presence": np.reshape(presence, (-1, 2)).tolist(),
            "methods": {k: figures(np.array(v), values["fibrous"] - values["core"]) for k, v in rows.items()},
        }  # fmt: skip
    return found


def figures(values: Any, contrast: float) -> dict[str, float]:
    """Of ``(draws, 2, ROIs + 1)``."""
    there, absent = values[:, 0, :-1], values[:, 1, :-1]
    out: dict[str, float] = {}
    for j, roi in enumerate(VESSEL_ROIS):
        raised = (there - absent)[:, j] / contrast
        out |= {
            f"{roi}_slope": float(raised.mean()), f"{roi}_slope_se": float(raised.std(ddof=1) / np.sqrt(len(raised))),
            f"{roi}_contrast_hu": float(there[:, j].mean()), f"{roi}_contrast_sd_hu": float(there[:, j].std(ddof=1)),
            f"{roi}_false_hu": float(absent[:, j].mean()),
            f"{roi}_false_se_hu": float(absent[:, j].std(ddof=1) / np.sqrt(len(raised))),
        }  # fmt: skip
    return {**out, "rmse_vessel_hu": float(np.sqrt(values[:, :, -1].mean()))}


def text(result: dict[str, Any]) -> str:
    """Markdown."""
    lines = ["# MBIR with tissues on vessels of other directions", "", f"`{result['command']}`", "",
             (__doc__ or "").split("\n\n")[-1].replace("\n", " ").strip(), "",
             "| vessel | s | method | tissues used | slope, section | all | SD, all | no core, all | RMSE vessel |",
             "|---" * 9 + "|"]  # fmt: skip
    for name, doses in result["vessels"].items():
        for dose, run in doses.items():
            for label, f in run["methods"].items():
                used = f"{run['used']} of {run['of']}" if label == "mbir_tissues" else ""
                lines.append(
                    f"| {name} | {dose} | {label} | {used} | {f['section_slope']:.2f} ± {f['section_slope_se']:.2f} | "
                    f"{f['tissue_slope']:.2f} ± {f['tissue_slope_se']:.2f} | {f['tissue_contrast_sd_hu']:.0f} | "
                    f"{f['tissue_false_hu']:.1f} ± {f['tissue_false_se_hu']:.1f} | {f['rmse_vessel_hu']:.0f} |"
                )
    return "\n".join([*lines, ""])


def main() -> None:
    """Every vessel; the files are written after each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=12)
    parser.add_argument("--doses", type=float, nargs="+", default=[0.35, 2.0], metavar="S")
    parser.add_argument("--vessels", nargs="+", default=DEFAULT, choices=VESSELS, metavar="NAME")
    parser.add_argument("--out", type=Path, default=Path("notebooks/plaque"), help="folder for the report")
    options = parser.parse_args()
    scene, plaque = plaque_scene()
    grid = inset_grid(plaque, 0.2)
    problem = InsetProblem(acquire(scene, presets.pcct(), region=grid), grid)
    result: dict[str, Any] = {
        "command": f"python tests/bench/tissue_vessels.py --draws {options.draws}", "torch": torch.__version__,
        "tissues_hu": TISSUES_HU, "cpu_seconds": 0.0, "vessels": {},
    }  # fmt: skip
    for name in options.vessels:
        began = time.process_time()
        result["vessels"][name] = measured(problem, name, options.doses, options.draws)
        result["cpu_seconds"] += time.process_time() - began
        write_results(options.out, "vessels", result, text(result))
    print(text(result))


if __name__ == "__main__":
    main()
