"""What the tissues add to MBIR on plaques that neither the network nor the reading was tuned on.

    python tests/bench/tissues.py [--plaques 16] [--doses 0.35 2.0] [--out notebooks/plaque]

Plaques of the family that checkpoints are chosen by (``train.scenes.held_out``: vessels of 2.6 and 4.4 mm,
superquadrics and crescents, tilted), but never the eight that chose the shipped weights; with their core (60 HU below
the fibrous tissue) and without it, they are drawn through the operator of the paper's scan with its noise; a reading
is blind. Contrast is that of the voxels wholly inside; errors are root mean squares; corrected: the SD over the slope.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from results import write_results

from recon.mbir.mbir import Mbir
from recon.mbir.tissues import TissueMbir
from recon.pwls.inset_problem import InsetProblem
from recon.study.dose_factor.methods import LinearFilter
from recon.study.paper.plaque_scan import inset_grid
from torchpcct.acquisition.acquire import acquire
from torchpcct.scanner import presets
from torchpcct.scene.plaque import plaque_scene
from train.scenes.held_out import CHECKPOINT_SIZE, unseen_plaque

CONTRAST_HU = 60.0
SMALL = "2.6 mm"
GROUPS = {"all": slice(None), SMALL: slice(0, None, 2), "4.4 mm": slice(1, None, 2)}
"""Of the plaques, whose vessels alternate."""


def measured(problem: InsetProblem, plaques: int, dose: float) -> dict[str, Any]:
    """Method → ``(plaques, 2, 3)``: with and without core; contrast, error in the vessel, error beside it."""
    network = Mbir.load()
    methods = {"linear": LinearFilter(), "mbir": network, "mbir_tissues": TissueMbir(network)}
    found: dict[str, list[Any]] = {name: [] for name in methods}
    used, presence, start = 0, [], time.process_time()
    for pair, core_roi, fibrous_roi, vessel in held_out_draws(problem, plaques, dose):
        rows: dict[str, list[Any]] = {name: [] for name in methods}
        for b, true in pair:
            for name, method in methods.items():
                volume, tissues = reconstructed(method, problem, b[None], dose)
                if tissues is not None:
                    used += tissues["used"]
                    presence.append(tissues.get("presence", float("nan")))
                core, fibrous = (float(volume[roi].mean()) for roi in (core_roi, fibrous_roi))
                error = (volume - true).square()
                rows[name].append([fibrous - core, float(error[vessel].mean()), float(error[~vessel].mean())])
        for name, row in rows.items():
            found[name].append(row)
    return {
        "used": used, "of": 2 * plaques, "presence": np.reshape(presence, (-1, 2)).tolist(),
        "cpu_seconds": time.process_time() - start, "methods": {n: np.array(v) for n, v in found.items()},
    }  # fmt: skip


def held_out_draws(
    problem: InsetProblem, plaques: int, dose: float
) -> Iterator[tuple[list[tuple[torch.Tensor, torch.Tensor]], torch.Tensor, torch.Tensor, torch.Tensor]]:
    """Of each plaque, with its core and without: statistic and true volume (HU); and core, fibrous tissue, vessel.

    The plaques that chose the checkpoint are left out.
    """
    gram, hu = problem.gram.scaled(dose), problem.mu_ref / 1000.0
    for k in range(plaques):
        held, i = unseen_plaque(k, problem.grid.shape, problem.grid.spacing, contrasts=(-CONTRAST_HU, 0.0))
        vessel = held.image[i, 1] > held.scenes[i].background + 10.0
        noise = gram.noise(generator=torch.Generator().manual_seed(CHECKPOINT_SIZE + k))
        pair = [(gram.apply(true * hu + problem.mu_ref - problem.level) + noise, true) for true in held.image[i]]
        yield pair, held.core_roi[i] > 0, held.fibrous_roi[i] > 0, vessel


def reconstructed(
    method: Any, problem: InsetProblem, b: torch.Tensor, dose: float
) -> tuple[torch.Tensor, dict[str, Any] | None]:
    """Volume of one statistic ``(1, z, y, x)`` in HU, and what is said of its tissues (None: not asked for)."""
    if isinstance(method, TissueMbir):
        solved = method.solved(problem, b, dose)
        return method.in_hu(problem, solved.u, solved.normal)[0], solved.notes[0]["tissues"]
    with torch.no_grad():
        return method(problem, b, dose)[0], None


def figures(values: Any) -> dict[str, float]:
    """Of ``(plaques, 2, 3)``."""
    there, absent = values[:, 0, 0], values[:, 1, 0]
    slope = float((there - absent).mean() / CONTRAST_HU)
    return {
        "slope": slope, "corrected_sd_hu": float(there.std(ddof=1)) / slope,
        "contrast_hu": float(there.mean()), "contrast_sd_hu": float(there.std(ddof=1)),
        "contrast_rmse_hu": float(np.sqrt(np.mean((there - CONTRAST_HU) ** 2))),
        "false_contrast_hu": float(absent.mean()), "false_contrast_rmse_hu": float(np.sqrt(np.mean(absent**2))),
        "rmse_vessel_hu": float(np.sqrt(values[:, :, 1].mean())),
        "rmse_beside_hu": float(np.sqrt(values[:, :, 2].mean())),
    }  # fmt: skip


def text(result: dict[str, Any]) -> str:
    """Markdown."""
    lines = ["# MBIR with tissues on held-out plaques", "", f"`{result['command']}`", "",
             (__doc__ or "").split("\n\n")[-1].replace("\n", " ").strip(), "", *result.get("notes", [])]  # fmt: skip
    for run in result["doses"]:
        lines += [f"## {run['exposure_s']:g} s: {run['of']} volumes, tissues used in {run['used']}", "",
                  "| vessels | method | slope | contrast: mean, SD, RMSE | corrected | no core: mean, RMSE | "
                  "RMSE vessel | fat |",
                  "|---" * 8 + "|"]  # fmt: skip
        for group, methods in run["groups"].items():
            for name, f in methods.items():
                lines.append(
                    f"| {group} | {name} | {f['slope']:.2f} | {f['contrast_hu']:.1f}, {f['contrast_sd_hu']:.1f}, "
                    f"{f['contrast_rmse_hu']:.1f} | {f['corrected_sd_hu']:.1f} | {f['false_contrast_hu']:.1f}, "
                    f"{f['false_contrast_rmse_hu']:.1f} | "
                    f"{f['rmse_vessel_hu']:.1f} | {f['rmse_beside_hu']:.1f} |"
                )
        lines.append("")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plaques", type=int, default=16, help="held-out plaques, each with and without its core")
    parser.add_argument("--doses", type=float, nargs="+", default=[0.35, 2.0], metavar="S")
    parser.add_argument("--out", type=Path, default=Path("notebooks/plaque"), help="folder for the report")
    options = parser.parse_args()
    scene, plaque = plaque_scene()
    grid = inset_grid(plaque, 0.2)
    problem = InsetProblem(acquire(scene, presets.pcct(), region=grid), grid)
    doses = []
    for dose in options.doses:
        found = measured(problem, options.plaques, dose)
        groups = {g: {n: figures(v[part]) for n, v in found["methods"].items()} for g, part in GROUPS.items()}
        doses.append({"exposure_s": dose, "groups": groups, **{k: v for k, v in found.items() if k != "methods"}})
    result = {"command": f"python tests/bench/tissues.py --plaques {options.plaques}", "contrast_hu": CONTRAST_HU,
              "plaques": options.plaques, "chose_the_checkpoint": 0,
              "torch": torch.__version__, "doses": doses}  # fmt: skip
    write_results(options.out, "held_out", result, text(result))
    print(text(result))


if __name__ == "__main__":
    main()
