"""Readings of the paper's plaque from noisy scans: bias, spread, coverage, presence, beside FBP over the same regions.

    python tests/bench/plaque.py [--n 48] [--work out/bench-plaque] [--out tests/bench]

Every draw is a noisy scan of the paper's scene (1968 views, drawn readings), read blind or from a point that misses the
core's centre by 0.4 mm (standard deviation, each axis); the scene without its core is read blind. FBP is that of the
same readings. The held-out plaques of training (``train.scenes.held_out``) are drawn through the same operator, without
readings. Finished draws in the work folder are kept: after an interruption the same command goes on, and
``--summary`` tells what there is. True values are those of rods of each tissue at the plaque's place
(``torchpcct dose-factor``), areas and volumes those of the scene.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import chi2

from recon.fbp.inset import InsetFbp
from recon.plaque import TissueData, read_plaque
from recon.pwls.inset_problem import InsetProblem
from recon.study.paper.plaque_scan import inset_grid
from torchpcct.acquisition.acquire import acquire
from torchpcct.files import written_whole
from torchpcct.scan import Scan
from torchpcct.scanner import presets
from torchpcct.scene.plaque import plaque_scene, plaque_variant
from train.scenes.held_out import validation_scenes

CASES = {
    "2.0 s, blind": ("paper", 2.0, False),
    "2.0 s, with a point": ("paper", 2.0, True),
    "2.0 s, no core, blind": ("absent_core", 2.0, False),
    "0.35 s, with a point": ("paper", 0.35, True),
    "2.0 s, held-out plaques, with a point": ("held out", 2.0, True),
}
POINT_SD_MM = 0.4
TISSUES_HU = {"fat": -92.65, "wall": 63.53, "fibrous": 103.22, "lumen": 479.97, "core": 41.07, "contrast": 62.15}
"""By rods (``notebooks/dose_factor``)."""


def truth() -> dict[str, float]:
    """Of every figure, in its unit."""
    _, plaque = plaque_scene()
    volume = 4 / 3 * np.pi * float(np.prod(plaque.core.semi_axes))
    return {**TISSUES_HU, "wall thickness": plaque.wall_thickness, "lumen area": float(plaque.area("lumen", 0.0)),
            "core volume": volume, "cap thickness": plaque.cap_thickness}  # fmt: skip


class Draws:
    """Noisy scans of the scenes, and their readings, one file each."""

    def __init__(self, work: Path, scans: Path | None) -> None:
        self.work, self.scans = work, scans
        self.grid = inset_grid(plaque_scene()[1], 0.2)
        self._clean: dict[str, Scan] = {}
        self._problem: InsetProblem | None = None
        self._fbp: InsetFbp | None = None

    def clean(self, name: str) -> Scan:
        """The noise-free scan, from the folder of the dose-factor study or simulated."""
        if name not in self._clean:
            path = None if self.scans is None else self.scans / f"{name}_1968.h5"
            known = path is not None and path.exists()
            self._clean[name] = Scan.load(path) if known else acquire(
                plaque_variant(name)[0], presets.pcct(), region=self.grid
            )  # fmt: skip
        return self._clean[name]

    def read(self, case: str, k: int) -> None:
        """One reading, unless it is on disk."""
        name, dose, pointed = CASES[case]
        path = self.work / f"{case.replace(' ', '_').replace(',', '')}_{k}.json"
        if path.exists():
            return
        if self._problem is None:
            self._problem = InsetProblem(self.clean("paper"), self.grid)
            self._fbp = InsetFbp(self.clean("paper"), [self.grid], ["soft"])
        assert self._fbp is not None
        if name == "held out":
            data, centre, true, fbp = self._held_out(k, dose)
        else:
            scan, true = self.clean(name).with_noise(dose, k), truth()
            fbp = self._fbp(scan)[0][0]
            data = TissueData.of_scan(scan, self._problem)
            plaque = plaque_scene()[1]
            centre = np.array(plaque.to_scanner(plaque.core_center))[::-1]
        point = centre + POINT_SD_MM * np.random.default_rng(k).standard_normal(3) if pointed else None
        start, cpu = time.perf_counter(), time.process_time()
        try:
            reading = read_plaque(data, point, point_sd=POINT_SD_MM, seed=k)
        except ValueError as error:
            found: dict[str, Any] = {"refused": str(error)}
        else:
            found = {
                "presence": reading.presence,
                "figures": {n: e.as_dict() for n, e in {**reading.figures, **reading.given_core}.items()},
                "truth": true,
                "fbp": {} if fbp is None else reading.read(fbp),
                "chi2": reading.chi2,
                "chi2_sd": reading.chi2_sd,
                "texture_hu": reading.texture_hu,
                "log_evidence": reading.info["log_evidence"],
            }
        found |= {"seconds": time.perf_counter() - start, "cpu_seconds": time.process_time() - cpu}
        with written_whole(path) as part:
            part.write_text(json.dumps(found), encoding="utf-8")

    def _held_out(self, k: int, dose: float) -> tuple[TissueData, Any, dict[str, float], None]:
        """The k-th plaque of the family, its core's centre and true values; noise of the operator."""
        assert self._problem is not None
        scenes = validation_scenes(self.grid.shape, self.grid.spacing, seed=k // 8, contrasts=(-60.0,))
        image, core, vessel = scenes.image[k % 8, 0], scenes.core[k % 8].double(), scenes.scenes[k % 8].vessels[0]
        gram, hu = self._problem.gram.scaled(dose), self._problem.mu_ref / 1000.0
        b = gram.apply(image * hu) + gram.noise(generator=torch.Generator().manual_seed(k))
        axes = [torch.from_numpy(a) for a in self.grid.axes]
        total = float(core.sum())
        centre = [float((core.sum([i for i in range(3) if i != d]) * axes[d]).sum()) / total for d in range(3)]
        true = {"fat": scenes.scenes[k % 8].background, "wall": vessel.wall_hu, "fibrous": vessel.fibrous_hu,
                "lumen": vessel.lumen_hu, "core": vessel.fibrous_hu - 60.0, "contrast": 60.0,
                "wall thickness": vessel.wall, "lumen area": np.pi * vessel.lumen_radius**2 * vessel.lumen_aspect,
                "core volume": total * float(np.prod(self.grid.spacing))}  # fmt: skip
        return TissueData(b * hu, gram, hu * hu, "statistic drawn from the operator"), np.array(centre), true, None


def summary(work: Path) -> dict[str, Any]:
    """Figures of all finished draws."""
    cases = {}
    for case in CASES:
        stem = case.replace(" ", "_").replace(",", "")
        draws = [json.loads(p.read_text(encoding="utf-8")) for p in sorted(work.glob(f"{stem}_*.json"))]
        read = [d for d in draws if "presence" in d]
        if not read:
            continue
        presence = np.array([d["presence"] for d in read])
        entry: dict[str, Any] = {
            "n": len(draws),
            "failed": len(draws) - len(read),
            "claimed": int((presence >= 0.95).sum()),
            "median_presence": float(np.median(presence)),
            "chi2": float(np.mean([d["chi2"] for d in read])),
            "texture_hu": float(np.mean([d["texture_hu"] for d in read])),
            "cpu_seconds": float(np.median([d["cpu_seconds"] for d in read])),
            "figures": {},
        }
        absent, true = CASES[case][0] == "absent_core", read[0].get("truth", truth())
        for name in true:
            if absent and name in ("core", "contrast", "core volume", "cap thickness"):
                continue
            exact = np.array([d.get("truth", true)[name] for d in read])
            values = np.array([d["figures"][name]["value"] for d in read])
            inside = [
                d["figures"][name]["low"] <= t <= d["figures"][name]["high"] for d, t in zip(read, exact, strict=True)
            ]
            entry["figures"][name] = _spread(values, exact) | {"coverage": float(np.mean(inside))}
            beside = [(d["fbp"][name], t) for d, t in zip(read, exact, strict=True) if name in d["fbp"]]
            if len(beside) > 1:
                entry["figures"][name]["fbp_same_regions"] = _spread(*np.array(beside).T)
        cases[case] = entry
    return {"command": "python tests/bench/plaque.py", "point_sd_mm": POINT_SD_MM, "cases": cases}


def _spread(values: Any, true: Any) -> dict[str, Any]:
    """Mean, bias, standard deviation of the error with its 95 % interval, RMSE."""
    n, sd = len(values), float((values - true).std(ddof=1)) if len(values) > 1 else float("nan")
    low, high = (sd * float(np.sqrt((n - 1) / chi2.ppf(q, n - 1))) if n > 1 else float("nan") for q in (0.975, 0.025))
    return {"true": float(true.mean()), "mean": float(values.mean()), "bias": float((values - true).mean()), "sd": sd,
            "sd_low": low, "sd_high": high, "rmse": float(np.sqrt(np.mean((values - true) ** 2)))}  # fmt: skip


def text(result: dict[str, Any]) -> str:
    """Markdown."""
    lines = ["# Reading the paper's plaque by its tissues", "", f"`{result['command']}`", ""]
    for case, entry in result["cases"].items():
        lines += [
            f"## {case}: n = {entry['n']}",
            "",
            f"Claimed (P ≥ 0.95): {entry['claimed']} of {entry['n']}; median P {entry['median_presence']:.3f}; "
            f"not read {entry['failed']}; residual {entry['chi2']:.3f}; texture {entry['texture_hu']:.1f} HU; "
            f"{entry['cpu_seconds']:.1f} CPU s a reading (loaded machine).",
            "",
            "| | true | mean | bias | SD [95 %] | RMSE | coverage | soft FBP, same regions: mean, SD |",
            "|---|---|---|---|---|---|---|---|",
        ]
        for name, f in entry["figures"].items():
            d = 1 if abs(f["true"]) > 20 else 2
            fbp = f.get("fbp_same_regions")
            beside = f"{fbp['mean']:.{d}f}, {fbp['sd']:.{d}f}" if fbp else "–"
            lines.append(
                f"| {name} | {f['true']:.{d}f} | {f['mean']:.{d}f} | {f['bias']:+.{d}f} | {f['sd']:.{d}f} "
                f"[{f['sd_low']:.{d}f}, {f['sd_high']:.{d}f}] | {f['rmse']:.{d}f} | {f['coverage']:.2f} | {beside} |"
            )
        lines.append("")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=48, help="draws of every case")
    parser.add_argument("--work", type=Path, default=Path("out/bench-plaque"), help="folder for finished draws")
    parser.add_argument("--scans", type=Path, help="folder scans/ of the dose-factor study, to save the simulation")
    parser.add_argument("--out", type=Path, default=Path("tests/bench"), help="folder for plaque.json and plaque.md")
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=list(CASES))
    parser.add_argument("--summary", action="store_true", help="only tell what is finished")
    options = parser.parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    if not options.summary:
        draws = Draws(options.work, options.scans)
        for k in range(options.n):
            for case in options.cases:
                draws.read(case, k)
    result = summary(options.work)
    for name, content in (("plaque.json", json.dumps(result, indent=1) + "\n"), ("plaque.md", text(result))):
        with written_whole(options.out / name) as part:
            part.write_text(content, encoding="utf-8")
    print(text(result))


if __name__ == "__main__":
    main()
