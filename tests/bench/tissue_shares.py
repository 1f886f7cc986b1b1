"""How much of a fitted core MBIR with tissues should draw: the trade-off between its contrast and its noise.

    python tests/bench/tissue_shares.py [--draws 48] [--plaques 16] [--doses 0.35 2.0] [--out notebooks/plaque]

One reading a draw, blind; then the image with the core enters the tissues' image T (`recon.mbir.tissues`) with a share
that is never its own, half of the core's probability P, P (what the package does), P², all of it from P = 0.95 on, or
always; the rest of the fibrous layer is the plain reconstruction's. Draws are the paper's plaque with and without its
core (noise-free readings of 1968 views, noise of b = AᵀW y) and the held-out plaques of training. Corrected SD: of the
contrast with the core, over the slope between both; ± of a ratio is its jackknife standard error over the draws, which
all rows share.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from results import write_results
from rod_values import ROD_HU, true_volume
from tissues import CONTRAST_HU, held_out_draws
from torch import Tensor

from recon.mbir.mbir import Mbir
from recon.mbir.tissues import TissueMbir, tissue_image
from recon.plaque import TissueData, read_plaque
from recon.plaque.reading import CERTAIN
from recon.pwls.inset_problem import InsetProblem
from recon.study.dose_factor.settings import Settings
from recon.study.dose_factor.variant import Variant
from torchpcct.acquisition.acquire import acquire

SHARES: dict[str, Callable[[float], float]] = {
    "never": lambda p: 0.0,
    "P / 2": lambda p: p / 2.0,
    "P": lambda p: p,
    "P²": lambda p: p**2,
    "from P = 0.95 on": lambda p: float(p >= CERTAIN),
    "always": lambda p: 1.0,
}
PLAIN, SHIPPED = "no tissues", "P"


@dataclass(frozen=True)
class Draw:
    """A statistic ``(z, y, x)``, the true volume (HU), its vessel, and ROI name → (core, fibrous) means."""

    b: Tensor
    true: Tensor
    vessel: Tensor
    rois: dict[str, tuple[Callable[[Tensor], Any], Callable[[Tensor], Any]]]


def paper_draws(problem: InsetProblem, clean: list[Tensor], draws: int, dose: float) -> Iterator[list[Draw]]:
    """Of the paper's plaque, with its core and without."""
    scenes = [Variant(name, Settings()) for name in ("paper", "absent_core")]
    rois = {name: scenes[0].pair_of(roi).on(problem.grid) for name, roi in (("paper", "paper"), ("whole", "tissue"))}
    true, (_, vessel) = zip(*(true_volume(s.scene, problem.grid) for s in scenes), strict=True)
    gram = problem.gram.scaled(dose)
    for k in range(draws):
        noise = gram.noise(generator=torch.Generator().manual_seed(k))
        yield [Draw(clean[i] * dose + noise, true[i], vessel, rois) for i in range(2)]


def plaque_draws(problem: InsetProblem, draws: int, dose: float) -> Iterator[list[Draw]]:
    """Of the held-out plaques, likewise."""
    for pair, core, fibrous, vessel in held_out_draws(problem, draws, dose):
        rois = {"small": (lambda v, m=core: v[m].mean(), lambda v, m=fibrous: v[m].mean())}
        yield [Draw(b, true, vessel, rois) for b, true in pair]


def measured(problem: InsetProblem, pairs: Iterator[list[Draw]], dose: float) -> dict[str, Any]:
    """Method → ``(draws, 2, ROIs + 1)``: contrasts and mean squared error in the vessel; and what was read."""
    network = Mbir.load()
    method = TissueMbir(network)
    found: dict[str, list[Any]] = {name: [] for name in (PLAIN, *SHARES)}
    presence, rois = [], []
    for pair in pairs:
        rows: dict[str, list[Any]] = {name: [] for name in found}
        for draw in pair:
            rois = list(draw.rois)
            with torch.no_grad():
                volumes, p = shown(method, problem, draw.b, dose)
            presence.append(p)
            for name, volume in volumes.items():
                contrast = [float(fibrous(volume)) - float(core(volume)) for core, fibrous in draw.rois.values()]
                rows[name].append([*contrast, float((volume - draw.true)[draw.vessel].square().mean())])
        for name, row in rows.items():
            found[name].append(row)
    return {"presence": np.reshape(presence, (-1, 2)).tolist(), "rois": rois,
            "values": {name: np.array(rows) for name, rows in found.items()}}  # fmt: skip


def shown(method: TissueMbir, problem: InsetProblem, b: Tensor, dose: float) -> tuple[dict[str, Tensor], float]:
    """Volumes by share, and P (NaN: no tissues were used)."""
    plain = Mbir.solved(method, problem, b[None], dose)
    volume = method.in_hu(problem, plain.u, plain.normal)[0]
    try:
        reading = read_plaque(TissueData.of_statistic(b, problem, dose), seed=method.seed)
        usable = not reading.warnings
    except ValueError:
        usable = False
    if not usable:
        return dict.fromkeys((PLAIN, *SHARES), volume), float("nan")
    volumes = {PLAIN: volume}
    for name, share in SHARES.items():
        u = method.around(problem, plain.normal, tissue_image(reading, volume, share(reading.presence)))
        volumes[name] = method.in_hu(problem, u[None], plain.normal)[0]
    return volumes, reading.presence


def corrected(values: Any, contrast: float) -> float:
    """SD of the contrast with the core, ``(draws, 2)``, at slope 1."""
    return float(values[:, 0].std(ddof=1) / (values[:, 0] - values[:, 1]).mean() * contrast)


def figures(found: dict[str, Any], contrast: float) -> dict[str, Any]:
    """By method: RMSE in the vessel, and by ROI slope, errors and corrected SD, beside that of the shipped share."""
    out: dict[str, Any] = {}
    for name, values in found["values"].items():
        of: dict[str, Any] = {"rmse_vessel_hu": float(np.sqrt(values[:, :, -1].mean()))}
        for j, roi in enumerate(found["rois"]):
            v, shipped = values[:, :, j], found["values"][SHIPPED][:, :, j]
            n = len(v)
            left_out = [np.arange(n) != k for k in range(n)]
            ratios = [corrected(v[i], contrast) / corrected(shipped[i], contrast) for i in left_out]
            of[roi] = {
                "slope": float((v[:, 0] - v[:, 1]).mean() / contrast),
                "corrected_sd_hu": corrected(v, contrast),
                "ratio": corrected(v, contrast) / corrected(shipped, contrast),
                "ratio_se": float(np.sqrt((n - 1) * np.var(ratios))),
                "rmse_hu": float(np.sqrt(np.mean((v[:, 0] - contrast) ** 2))),
                "no_core_hu": float(v[:, 1].mean()), "no_core_rmse_hu": float(np.sqrt(np.mean(v[:, 1] ** 2))),
            }  # fmt: skip
        out[name] = of
    return out


def text(result: dict[str, Any]) -> str:
    """Markdown."""
    lines = ["# How much of a fitted core is drawn", "", f"`{result['command']}`", "",
             (__doc__ or "").split("\n\n")[-1].replace("\n", " ").strip(), ""]  # fmt: skip
    for run in result["runs"]:
        for roi in run["rois"]:
            lines += [f"## {run['scenes']}, {run['exposure_s']:g} s, {roi} ROIs, {len(run['presence'])} draws", "",
                      "| share of the core | slope | corrected SD, HU | over that of P | RMSE | no core: mean, RMSE | "
                      "RMSE vessel |", "|---" * 7 + "|"]  # fmt: skip
            for name, of in run["methods"].items():
                f = of[roi]
                lines.append(
                    f"| {name} | {f['slope']:.2f} | {f['corrected_sd_hu']:.1f} | {f['ratio']:.2f} ± "
                    f"{f['ratio_se']:.2f} | {f['rmse_hu']:.1f} | {f['no_core_hu']:.1f}, {f['no_core_rmse_hu']:.1f} | "
                    f"{of['rmse_vessel_hu']:.1f} |"
                )
            lines.append("")
    return "\n".join(lines)


def main() -> None:
    """Both kinds of draws at every dose; the files are written after each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=48, help="of the paper's plaque")
    parser.add_argument("--plaques", type=int, default=16, help="held-out plaques")
    parser.add_argument("--doses", type=float, nargs="+", default=[0.35, 2.0], metavar="S")
    parser.add_argument("--out", type=Path, default=Path("notebooks/plaque"), help="folder for the report")
    options = parser.parse_args()
    paper, absent = (Variant(name, Settings()) for name in ("paper", "absent_core"))
    scans = [acquire(v.scene, v.scanner, region=paper.grid) for v in (paper, absent)]
    problem = InsetProblem(scans[0], paper.grid)
    clean = [problem.statistic(scan).b.to(torch.float32) for scan in scans]
    true_contrast = ROD_HU["fibrous"] - ROD_HU["core"]
    result: dict[str, Any] = {
        "command": f"python tests/bench/tissue_shares.py --draws {options.draws} --plaques {options.plaques}",
        "torch": torch.__version__, "cpu_seconds": 0.0, "runs": [],
    }  # fmt: skip
    for dose in options.doses:
        for scenes, pairs, contrast in (
            ("the paper's plaque", paper_draws(problem, clean, options.draws, dose), true_contrast),
            ("held-out plaques", plaque_draws(problem, options.plaques, dose), CONTRAST_HU),
        ):  # fmt: skip
            began = time.process_time()
            found = measured(problem, pairs, dose)
            result["cpu_seconds"] += time.process_time() - began
            result["runs"].append({"scenes": scenes, "exposure_s": dose, "rois": found["rois"],
                                   "presence": found["presence"], "methods": figures(found, contrast)})  # fmt: skip
            write_results(options.out, "shares", result, text(result))
    print(text(result))


if __name__ == "__main__":
    main()
