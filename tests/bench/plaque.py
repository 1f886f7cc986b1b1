"""Readings of the paper's plaque from noisy scans: bias, spread, coverage, presence, beside FBP
over the same regions.

    python tests/bench/plaque.py [--n 48] [--work out/bench-plaque] [--out notebooks/plaque]
    [--mbir] [--summary]

Every draw is a noisy scan of the paper's scene (1968 views, drawn readings), read blind or from a
point that misses the core's centre by 0.4 mm (standard deviation, each axis); the scene without its
core is read blind. FBP is that of the same readings. A calcification, half the contrast and two
cores are scans of analytic bodies, too. Texture, soft edges and the held-out plaques of training
(``train.scenes.held_out``) are painted on voxels of half the reader's size and projected exactly;
their noise is drawn by the operator. Finished draws in the work folder are kept: after an
interruption the same command goes on; ``--summary`` tells what there is, ``--mbir`` reads MBIR of
the package's weights over the regions of the finished draws. True values are those of rods of each
tissue at the plaque's place (least squares on noise-free readings), areas and volumes those of the
scene.
"""

import argparse
import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from results import write_results
from rival_scenes import ROD_HU
from scipy import ndimage
from scipy.stats import beta, chi2

from recon.analytic.inset import InsetFbp
from recon.least_squares.inset_problem import InsetProblem
from recon.mbir.mbir import Mbir
from recon.study.paper.plaque_scan import inset_grid
from recon.vessel import read_plaque
from recon.vessel.reading import CERTAIN, read_regions
from torchpcct.acquisition.acquire import acquire
from torchpcct.files import atomic_write
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.plaque_measures import cap_on_line, lumen_area
from torchpcct.projector import Projector
from torchpcct.scan import Scan
from torchpcct.scanner import presets
from torchpcct.scene import Body, Scene
from torchpcct.scene.bodies import Ellipsoid
from torchpcct.scene.plaque import Plaque, plaque_scene, plaque_variant
from train.scenes.held_out import held_out_plaques


@dataclass(frozen=True)
class Case:
    """What is drawn: scene, exposure in s, whether a reader's point is given, and of how many
    draws one is read."""

    scene: str
    exposure_s: float
    pointed: bool
    every: int = 1


CASES = {
    "2.0 s, blind": Case("paper", 2.0, False),
    "2.0 s, with a point": Case("paper", 2.0, True),
    "2.0 s, no core, blind": Case("absent_core", 2.0, False),
    "2.0 s, no core, with a point": Case("absent_core", 2.0, True),
    "0.35 s, with a point": Case("paper", 0.35, True),
    "0.35 s, blind": Case("paper", 0.35, False),
    "2.0 s, held-out plaques, with a point": Case("held out", 2.0, True),
    "2.0 s, texture of 10 HU, with a point": Case("texture", 2.0, True, 2),
    "2.0 s, soft edges, with a point": Case("soft edges", 2.0, True, 2),
    "2.0 s, calcification, with a point": Case("calcification", 2.0, True, 2),
    "2.0 s, half contrast, with a point": Case("half_contrast", 2.0, True, 2),
    "2.0 s, two cores, blind": Case("two cores", 2.0, False, 2),
    "2.0 s, one of the two cores, with a point": Case("one core", 2.0, True, 2),
}
SCANNED = ("paper", "absent_core", "calcification", "half_contrast", "two cores", "one core")
POINT_SD_MM = 0.4
TISSUES_HU = {**ROD_HU, "contrast": ROD_HU["fibrous"] - ROD_HU["core"]}
"""By rods of 4 mm. Least squares over the plaque's true outlines gives the lumen 478.8 HU on voxels
of 0.05 mm, 479.9 on 0.1 mm and 484.9 on 0.2 mm, where each voxel's mean is averaged once more by
the projector."""
TEXTURE_HU = 10.0
TEXTURE_MM = 0.3
SOFT_MM = 0.12
_FINER = 2
_POINTS = 3
"""Voxels of a painting along each edge of one of the reader's, and points along each edge of one
of those."""
PLAQUE_ONLY = ("core", "contrast", "core volume", "cap thickness")


def truth(plaque: Plaque, **changed: float) -> dict[str, float]:
    """Of every figure, in its unit."""
    volume = 4 / 3 * np.pi * float(np.prod(plaque.core.semi_axes))
    return {
        **TISSUES_HU,
        "wall thickness": plaque.wall_thickness,
        "lumen area": float(plaque.area("lumen", plaque.core_center[2])),
        "core volume": volume,
        "cap thickness": plaque.minimum_cap,
        **changed,
    }


def scene_of(name: str) -> tuple[Scene, Plaque]:
    """What is scanned; two cores lie 3.2 mm apart along the vessel, 1.9 mm³ each."""
    if name not in ("two cores", "one core"):
        return plaque_variant(name)
    long = Plaque(bulge_length=12.0, core_semi_axes=(0.5, 0.95, 0.95))
    middle, _, radius, _ = (float(v) for v in long.section("lumen", 1.6))
    x = middle + radius + 0.2 + 0.5
    scene, plaque = plaque_scene(long, core_shift=(x - long.core_center[0], 0.0, -1.6))
    if name == "two cores":
        other = Ellipsoid(long.core_semi_axes, position=tuple(plaque.to_scanner((x, 0.0, 1.6))))
        scene = scene.add(Body("core2", other, "necrotic_core", "fibrous"))
    return scene, plaque


class Draws:
    """Noisy scans of the scenes, and their readings, one file each."""

    def __init__(self, work: Path, scans: Path | None) -> None:
        self.work, self.scans = work, scans
        self.grid = inset_grid(plaque_scene()[1], 0.2)
        self._clean: dict[str, Scan] = {}
        self._problem: InsetProblem | None = None
        self._fbp: InsetFbp | None = None
        self._exact: Projector | None = None
        self._tissues: dict[str, Any] = {}

    @property
    def problem(self) -> InsetProblem:
        """What all scans share."""
        if self._problem is None:
            self._problem = InsetProblem(self.clean("paper"), self.grid)
        return self._problem

    def clean(self, name: str) -> Scan:
        """The noise-free scan, from a folder or simulated."""
        if name not in self._clean:
            path = None if self.scans is None else self.scans / f"{_stem(name)}_1968.h5"
            known = path is not None and path.exists()
            self._clean[name] = (
                Scan.load(path)
                if known
                else acquire(scene_of(name)[0], presets.pcct(), region=self.grid)
            )
        return self._clean[name]

    @property
    def fine(self) -> VolumeGrid:
        """Of what is painted."""
        return VolumeGrid(
            tuple(_FINER * n for n in self.grid.shape),
            tuple(s / _FINER for s in self.grid.spacing),
            self.grid.center,
        )

    def drawn(
        self, name: str, exposure_s: float, k: int
    ) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Statistic AᵀW y and soft FBP of a noisy scan; of what is drawn through the operator,
        no FBP."""
        path = self.work / "statistics" / f"{name.replace(' ', '_')}_{exposure_s:g}s_{k}.npz"
        if path.exists():
            with np.load(path) as kept:
                return torch.from_numpy(kept["b"]), torch.from_numpy(
                    kept["fbp"]
                ) if "fbp" in kept else None
        if name in SCANNED:
            scan = self.clean(name).with_noise(exposure_s, k)
            found = {"b": self.problem.term(scan).b[0].numpy()}
            if name in ("paper", "absent_core"):
                if self._fbp is None:
                    self._fbp = InsetFbp(self.clean("paper"), [self.grid], ["soft"])
                found["fbp"] = self._fbp(scan)[0][0].numpy()
        else:
            image = self._held_out(k)[0] if name == "held out" else self._image(name, k)
            gram, hu = self.problem.gram.scaled(exposure_s), self.problem.mu_ref / 1000.0
            above = image * hu + self.problem.mu_ref - self.problem.level
            if self._exact is None:
                self._exact = Projector(self.problem.geometry, self.fine, self.problem.window)
            seen = self.problem.projector.T(self.problem.weights * exposure_s * self._exact(above))
            b = seen + gram.noise(generator=torch.Generator().manual_seed(k))
            found = {"b": b.numpy()}
        with atomic_write(path) as part, part.open("wb") as file:
            np.savez(file, **found)
        return torch.from_numpy(found["b"]), torch.from_numpy(
            found["fbp"]
        ) if "fbp" in found else None

    def read(self, case: str, k: int) -> None:
        """One reading, unless it is on disk."""
        what = CASES[case]
        path = self.work / f"{_stem(case)}_{k}.json"
        if path.exists() or k % what.every:
            return
        b, fbp = self.drawn(what.scene, what.exposure_s, k)
        data = self.problem.term_of(b[None], what.exposure_s)
        plaque = scene_of(what.scene)[1] if what.scene in SCANNED else plaque_scene()[1]
        seeds = np.array(plaque.to_scanner([plaque.section("lumen", 0.0)[0], 0.0, 0.0]))[::-1]
        centre, true = np.array(plaque.to_scanner(plaque.core_center))[::-1], truth(plaque)
        if what.scene == "held out":
            _, centre, true = self._held_out(k)
        elif what.scene == "half_contrast":
            true = truth(plaque, contrast=31.08, core=72.14)
        point = (
            centre + POINT_SD_MM * np.random.default_rng(k).standard_normal(3)
            if what.pointed
            else None
        )
        start, cpu = time.perf_counter(), time.process_time()
        try:
            reading = read_plaque(data, point, point_sd=POINT_SD_MM, seed=k)
        except ValueError as error:
            found: dict[str, Any] = {"refused": str(error)}
        else:
            found = {
                "presence": reading.presence,
                "figures": {
                    n: asdict(e) for n, e in {**reading.figures, **reading.given_core}.items()
                },
                "truth": true,
                "calcifications": reading.calcifications,
                "mean_contrast": reading.mean_contrast,
                "second_core": reading.second_core,
                "third_core": reading.third_core is not None,
                "warnings": len(reading.warnings),
                "left": reading.left.score,
                "chi2": reading.chi2,
                "chi2_sd": reading.chi2_sd,
                "texture_hu": reading.texture_hu,
                "log_evidence": reading.info["log_evidence"],
            }
            if fbp is not None:
                found["fbp"] = reading.read(fbp)
                if what.scene == "paper":
                    found["fbp_thresholds"] = _thresholds(fbp, self.grid, seeds, centre)
            shares = {n: np.round(255 * v).astype(np.uint8) for n, v in reading.regions.items()}
            with atomic_write(path.with_suffix(".npz")) as part, part.open("wb") as file:
                np.savez_compressed(file, **shares)
        found |= {"seconds": time.perf_counter() - start, "cpu_seconds": time.process_time() - cpu}
        with atomic_write(path) as part:
            part.write_text(json.dumps(found), encoding="utf-8")

    def beside(self, case: str, k: int, network: Mbir) -> None:
        """MBIR over the regions of a finished reading."""
        what, path = CASES[case], self.work / f"{_stem(case)}_{k}.json"
        if not path.with_suffix(".npz").exists() or what.scene not in ("paper", "absent_core"):
            return
        found = json.loads(path.read_text(encoding="utf-8"))
        if "presence" not in found or "mbir" in found:
            return
        with torch.no_grad():
            b, _ = self.drawn(what.scene, what.exposure_s, k)
            volume = network(self.problem.term_of(b[None], what.exposure_s))[0]
        with np.load(path.with_suffix(".npz")) as shares:
            found["mbir"] = read_regions({n: shares[n] / 255.0 for n in shares.files}, volume)
        with atomic_write(path) as part:
            part.write_text(json.dumps(found), encoding="utf-8")

    def _held_out(self, k: int) -> tuple[torch.Tensor, Any, dict[str, float]]:
        """The k-th plaque of the family, its core's centre and true values."""
        scenes = held_out_plaques(
            self.fine.shape, self.fine.spacing[0], seed=k // 8, contrasts=(-60.0,)
        )
        image, core, vessel = (
            scenes.image[k % 8, 0],
            scenes.core[k % 8].double(),
            scenes.scenes[k % 8].vessels[0],
        )
        axes = [torch.from_numpy(a) for a in self.fine.axes]
        total = float(core.sum())
        centre = [
            float((core.sum([i for i in range(3) if i != d]) * axes[d]).sum()) / total
            for d in range(3)
        ]
        true = {
            "fat": scenes.scenes[k % 8].background,
            "wall": vessel.wall_hu,
            "fibrous": vessel.fibrous_hu,
            "lumen": vessel.lumen_hu,
            "core": vessel.fibrous_hu - 60.0,
            "contrast": 60.0,
            "wall thickness": vessel.wall,
            "lumen area": np.pi * vessel.at(0.0)[-2:].prod(),
            "core volume": total * float(np.prod(self.fine.spacing)),
        }
        return image, np.array(centre), true

    def _image(self, name: str, k: int) -> torch.Tensor:
        """The paper's plaque with what the model does not have, HU on the fine grid."""
        if not self._tissues:
            scene, _ = plaque_scene()
            points = VolumeGrid(
                tuple(_POINTS * n for n in self.fine.shape),
                tuple(s / _POINTS for s in self.fine.spacing),
                self.fine.center,
            )
            labels = np.asarray(scene.labels(points))
            values = np.full(labels.shape, TISSUES_HU["fat"], np.float32)
            for tissue in ("wall", "fibrous", "lumen", "core"):
                values[labels == scene.index(tissue)] = TISSUES_HU[tissue]
            soft = ndimage.gaussian_filter(
                values, [SOFT_MM / s for s in points.spacing], mode="nearest"
            )
            tissue = np.isin(
                labels, [scene.index(name) for name in ("wall", "fibrous", "core")]
            ).astype(np.float32)
            shape = [n for size in self.fine.shape for n in (size, _POINTS)]
            self._tissues = {
                n: torch.from_numpy(v.reshape(shape).mean((1, 3, 5))).float()
                for n, v in {"soft edges": soft, "texture": values, "tissue": tissue}.items()
            }
        if name != "texture":
            return self._tissues[name]
        sd = [TEXTURE_MM / np.sqrt(2) / s for s in self.fine.spacing]
        rough = ndimage.gaussian_filter(
            np.random.default_rng(k).standard_normal(self.fine.shape), sd, mode="wrap"
        )
        rough *= TEXTURE_HU / rough.std()
        return (
            self._tissues["texture"] + torch.from_numpy(rough) * self._tissues["tissue"]
        ).float()


def _thresholds(fbp: torch.Tensor, grid: VolumeGrid, lumen: Any, core: Any) -> dict[str, float]:
    """Lumen area and cap by thresholds on the middle slice, the true centres given."""
    image, plane = (
        fbp[grid.shape[0] // 2],
        VolumeGrid(grid.shape[1:], grid.spacing[1:], grid.center[1:]),
    )
    return {
        "lumen area": lumen_area(image, plane, tuple(lumen[1:])),
        "cap thickness": cap_on_line(image, plane, tuple(lumen[1:]), tuple(core[1:])),
    }


def _stem(case: str) -> str:
    return case.replace(" ", "_").replace(",", "")


def summary(work: Path) -> dict[str, Any]:
    """Figures of all finished draws."""
    cases = {}
    for case, what in CASES.items():
        draws = [
            json.loads(p.read_text(encoding="utf-8"))
            for p in sorted(work.glob(f"{_stem(case)}_*.json"))
        ]
        read = [d for d in draws if "presence" in d]
        if not read:
            continue
        presence = np.array([d["presence"] for d in read])
        claimed = int((presence >= CERTAIN).sum())
        entry: dict[str, Any] = {
            "case": case,
            "n": len(draws),
            "failed": len(draws) - len(read),
            "claimed": claimed,
            "claimed_share": _share(claimed, len(draws)),
            "median_presence": float(np.median(presence)),
            "least_presence": float(presence.min()),
            "warned": sum(bool(d.get("warnings")) for d in read),
            "second_core": sum(d["second_core"] >= CERTAIN for d in read),
            "mean_contrast": float(np.mean([d["mean_contrast"] for d in read])),
            "calcified": sum(d.get("calcifications", 0) > 0 for d in read),
            "chi2": float(np.mean([d["chi2"] for d in read])),
            "texture_hu": float(np.mean([d["texture_hu"] for d in read])),
            "cpu_seconds": float(np.median([d["cpu_seconds"] for d in read])),
            "figures": {},
        }
        absent, true = what.scene == "absent_core", read[0]["truth"]
        for name in true:
            if absent and name in PLAQUE_ONLY:
                continue
            exact = np.array([d["truth"][name] for d in read])
            values = np.array([d["figures"][name]["value"] for d in read])
            inside = sum(
                d["figures"][name]["low"] <= t <= d["figures"][name]["high"]
                for d, t in zip(read, exact, strict=True)
            )
            told = float(np.mean([d["figures"][name]["sd"] for d in read]))
            entry["figures"][name] = _spread(values, exact) | {
                "coverage": _share(inside, len(read)),
                "told_sd": told,
            }
            for other in ("fbp", "mbir", "fbp_thresholds"):
                pairs = [
                    (d.get(other, {}).get(name, np.nan), t)
                    for d, t in zip(read, exact, strict=True)
                ]
                # thresholds can lose the edges
                beside = [pair for pair in pairs if np.isfinite(pair[0])]
                if len(beside) > 1:
                    entry["figures"][name][other] = _spread(*np.array(beside).T)
        contrast = np.array([d["figures"]["contrast"]["value"] for d in read])
        if absent:
            entry["contrast_if_there"] = float(contrast.mean())
        else:
            # What a user is given: the contrast of the claimed cores.
            given = np.array(
                [
                    d["figures"]["contrast"]["value"] - d["truth"]["contrast"]
                    for d in read
                    if _given(d)
                ]
            )
            covered = sum(
                d["figures"]["contrast"]["low"]
                <= d["truth"]["contrast"]
                <= d["figures"]["contrast"]["high"]
                for d in read
                if _given(d)
            )
            entry["given"] = {
                "n": len(given),
                "covered": covered,
                "bias": float(given.mean()) if len(given) else float("nan"),
                "rmse": float(np.sqrt(np.mean(given**2))) if len(given) else float("nan"),
            }
        cases[_stem(case)] = entry
    for case, what in CASES.items():
        absent = _stem(
            f"{what.exposure_s:.1f} s, no core, {'with a point' if what.pointed else 'blind'}"
        )
        if what.scene == "paper" and absent in cases and _stem(case) in cases:
            contrast = cases[_stem(case)]["figures"]["contrast"]
            slope = (contrast["mean"] - cases[absent]["contrast_if_there"]) / contrast["true"]
            contrast |= {"slope": slope, "corrected_sd": contrast["sd"] / slope}
    return {"command": "python tests/bench/plaque.py", "point_sd_mm": POINT_SD_MM, "cases": cases}


def _given(draw: dict[str, Any]) -> bool:
    """Whether the reading gives a contrast (see ``recon.vessel.reading``), or refuses it."""
    low, high = (draw["figures"]["contrast"][end] for end in ("low", "high"))
    return draw["presence"] >= CERTAIN and not low <= 0.0 <= high


def _share(found: int, n: int) -> dict[str, float]:
    """k of n, and Clopper and Pearson's 95 % interval."""
    low = float(beta.ppf(0.025, found, n - found + 1)) if found else 0.0
    high = float(beta.ppf(0.975, found + 1, n - found)) if found < n else 1.0
    return {"value": found / n, "low": low, "high": high}


def _spread(values: Any, true: Any) -> dict[str, Any]:
    """Mean, bias, standard deviation of the error with its 95 % interval, RMSE."""
    n, sd = len(values), float((values - true).std(ddof=1)) if len(values) > 1 else float("nan")
    low, high = (
        sd * float(np.sqrt((n - 1) / chi2.ppf(q, n - 1))) if n > 1 else float("nan")
        for q in (0.975, 0.025)
    )
    return {
        "true": float(true.mean()),
        "mean": float(values.mean()),
        "bias": float((values - true).mean()),
        "sd": sd,
        "sd_low": low,
        "sd_high": high,
        "rmse": float(np.sqrt(np.mean((values - true) ** 2))),
    }


def _contrast(entry: dict[str, Any]) -> str:
    """What a user is given of the contrast, and how much of a true one is read."""
    if "given" not in entry:
        return (
            f"Contrast if there were one: {entry['contrast_if_there']:+.1f} HU; over a core that "
            f"is there and one that is not: {entry['mean_contrast']:+.1f} HU."
        )
    told = "No contrast given."
    if entry["given"]["n"]:
        told = (
            "Contrast given: {n} times, bias {bias:+.1f}, RMSE {rmse:.1f} HU, in its interval "
            "{covered} times."
        ).format(**entry["given"])
    contrast = entry["figures"]["contrast"]
    told += " Of all draws, over a core that is there and one that is not: bias {:+.1f} HU.".format(
        entry["mean_contrast"] - contrast["true"]
    )
    if "slope" in contrast:
        told += (
            " From no core to all of it: slope {slope:.2f}, SD at slope 1 {corrected_sd:.1f} HU."
        ).format(**contrast)
    return told


def text(result: dict[str, Any]) -> str:
    """Markdown."""
    lines = [
        "# Reading the paper's plaque by its tissues",
        "",
        f"`{result['command']}`",
        "",
        "Bias and SD of the posterior mean over the draws; coverage: of the 95 % intervals; told: "
        "mean posterior SD. Beside them what other volumes of the same scans read over the same "
        "regions, and by thresholds (FBP, middle slice, true centres given).",
        "",
    ]
    for entry in result["cases"].values():
        share = entry["claimed_share"]
        lines += [
            f"## {entry['case']}: n = {entry['n']}",
            "",
            f"Claimed (P ≥ {CERTAIN}): {entry['claimed']} of {entry['n']} [{share['low']:.2f}, "
            f"{share['high']:.2f}]; median P {entry['median_presence']:.3f}, least "
            f"{entry['least_presence']:.3f}; not read {entry['failed']}; calcified "
            f"{entry['calcified']}; a second core {entry['second_core']}; warned "
            f"{entry['warned']}; residual {entry['chi2']:.3f}; texture {entry['texture_hu']:.1f} "
            f"HU; {entry['cpu_seconds']:.1f} CPU s a reading (loaded machine). {_contrast(entry)}",
            "",
            "| | true | mean | bias | SD [95 %] | told | RMSE | coverage | soft FBP: mean, SD | "
            "MBIR: mean, SD | FBP by thresholds: bias, RMSE |",
            "|---" * 11 + "|",
        ]
        for name, f in entry["figures"].items():
            d = 1 if abs(f["true"]) > 20 else 2
            cells = [
                f"{f['true']:.{d}f}",
                f"{f['mean']:.{d}f}",
                f"{f['bias']:+.{d}f}",
                f"{f['sd']:.{d}f} [{f['sd_low']:.{d}f}, {f['sd_high']:.{d}f}]",
                f"{f['told_sd']:.{d}f}",
                f"{f['rmse']:.{d}f}",
                "{value:.2f} [{low:.2f}, {high:.2f}]".format(**f["coverage"]),
            ]
            for other, keys in (
                ("fbp", ("mean", "sd")),
                ("mbir", ("mean", "sd")),
                ("fbp_thresholds", ("bias", "rmse")),
            ):
                cells.append(
                    ", ".join(f"{f[other][key]:.{d}f}" for key in keys) if other in f else "–"
                )
            lines.append(f"| {name} | " + " | ".join(cells) + " |")
        lines.append("")
    return "\n".join(lines)


def picture(result: dict[str, Any]) -> Any:
    """Error of the contrast, by case: mean and standard deviation of the readings and of FBP
    over the same regions."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 5), layout="constrained")
    axes = figure.subplots(1, 2, width_ratios=(3, 2))
    cases = [c for c in result["cases"].values() if "contrast" in c["figures"]]
    for row, entry in enumerate(cases):
        f = entry["figures"]["contrast"]
        for shift, key, colour in (
            (0.0, None, "tab:blue"),
            (0.2, "fbp", "tab:orange"),
            (0.4, "mbir", "tab:green"),
        ):
            g = f if key is None else f.get(key)
            if g is not None:
                axes[0].errorbar(
                    g["bias"], row + shift, xerr=g["sd"], fmt="o", color=colour, capsize=3
                )
        cover = f["coverage"]
        axes[1].errorbar(
            cover["value"],
            row,
            fmt="o",
            color="tab:blue",
            capsize=3,
            xerr=[[cover["value"] - cover["low"]], [cover["high"] - cover["value"]]],
        )
    for colour, name in (
        ("tab:blue", "tissues as unknowns"),
        ("tab:orange", "soft FBP, same regions"),
        ("tab:green", "MBIR, same regions"),
    ):
        if name.startswith(("tissues", "soft")) or any(
            "mbir" in c["figures"]["contrast"] for c in cases
        ):
            axes[0].plot([], [], "o", color=colour, label=name)
    axes[0].axvline(0.0, color="0.6", lw=0.8)
    axes[0].set_yticks(range(len(cases)), [f"{c['case']} ({c['n']})" for c in cases])
    axes[0].set_xlabel("contrast, error in HU: bias ± SD")
    axes[0].legend(fontsize=8, loc="lower right")
    axes[1].axvline(0.95, color="0.6", lw=0.8)
    axes[1].set_yticks([])
    axes[1].set_xlabel("coverage of 95 % intervals")
    for ax in axes:
        ax.invert_yaxis()
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--n", type=int, default=48, help="draws of every case")
    parser.add_argument(
        "--work", type=Path, default=Path("out/bench-plaque"), help="folder for finished draws"
    )
    parser.add_argument(
        "--scans", type=Path, help="folder with noise-free scans, to save the simulation"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("notebooks/plaque"), help="folder for the report"
    )
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=list(CASES))
    parser.add_argument(
        "--mbir", action="store_true", help="read MBIR over the regions of finished draws"
    )
    parser.add_argument("--summary", action="store_true", help="only tell what is finished")
    options = parser.parse_args()
    (options.work / "statistics").mkdir(parents=True, exist_ok=True)
    options.out.mkdir(parents=True, exist_ok=True)
    if not options.summary:
        draws = Draws(options.work, options.scans)
        network = Mbir.load() if options.mbir else None
        for k in range(options.n):
            for case in options.cases:
                if network is None:
                    draws.read(case, k)
                else:
                    draws.beside(case, k, network)
    result = summary(options.work)
    result |= {
        "seeds": f"0 … {options.n - 1}, the same of scan, point and Monte Carlo",
        "torch": torch.__version__,
    }
    write_results(options.out, "report", result, text(result))
    with atomic_write(options.out / "plaque.png") as part:
        picture(result).savefig(part, dpi=120)
    print(text(result))


if __name__ == "__main__":
    main()
