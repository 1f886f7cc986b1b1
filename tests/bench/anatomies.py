"""Anatomies that break assumptions: what every method shows of them, beside them, and where nothing is.

    python tests/bench/anatomies.py RUNS [--draws N] [--doses S ...] [--anatomies NAME ...] [--methods NAME ...]

The scenes are those of :mod:`recon.evaluate.anatomies`, each with its feature and without, at the place and on the
scanner of the paper. Everything linear is computed once: noise draws of FBP and of AᵀW y (``rival_scenes.py``) serve
every scene. What methods make of a scene is kept in RUNS, one piece for each anatomy and exposure; the same command
goes on. It writes ``anatomies.json`` and ``anatomies.md`` into the folder of ``--out``.

* contrast recovered: Σ ± (V with − V without) / Σ |T with − T without| over the feature's voxels, on the same draw;
* error beside: rms of V − T within 0.6 mm of the feature, with it;
* invented: what stays of V − T where nothing differs, mean over the draws, smoothed by 0.3 mm: its 99th percentile;
* drawn: share of volumes whose vessel was drawn; warnings: share of volumes that carry any.
"""

import argparse
import json
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rival_scenes import KERNELS, PAPER_HU, Bench
from scipy import ndimage
from torch import Tensor

from recon.evaluate.anatomies import ANATOMIES, Regions, coarsened
from recon.evaluate.rivals import __file__ as _RIVALS
from recon.evaluate.sources import source_digest
from recon.filters import FILTERS, SMOOTHED_BY, flat_noise
from recon.least_squares.qggmrf import DEFAULT_PRIOR
from recon.least_squares.reconstruct import TOLERANCE_HU
from recon.mbir.mbir import Mbir
from recon.mbir.outlines import OutlineMbir
from torchpcct.volume import to_hu

HERE = Path(__file__).parent
DOSES, DRAWS, FIRST_DRAW, LEVEL_DRAWS = (2.0, 0.35), 16, 400, (1000, 1001)
SMOOTHED_MM, PERCENTILE = 0.3, 99.0
SHOWN = {"fbp": "FBP soft", "bilateral": "bilateral", "perona_malik": "Perona-Malik", "pwls": "PWLS",
         "network": "network alone", "drawing": "drawing"}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Scene:
    """Noise-free FBP ``(kernels, z, y, x)`` HU, b ``(z, y, x)`` at 1 s, and the truth ``(z, y, x)`` HU."""

    fbp: Tensor
    b: Tensor
    true: Tensor


@dataclass(frozen=True, eq=False)
class Shown:
    """A method's volume ``(z, y, x)`` HU, whether a vessel was drawn, and its warnings."""

    volume: Tensor
    drawn: bool = False
    warnings: tuple[str, ...] = ()


class Scenes:
    """Scenes with and without features, and the volumes that methods make of them."""

    def __init__(self, folder: Path, methods: Iterable[str]) -> None:
        self.bench, self.methods = Bench(folder), tuple(methods)
        self.networks = {"network": Mbir.load(), "drawing": OutlineMbir(Mbir.load())}
        self.tuning = json.loads((Path(_RIVALS).parent / "rivals_tuning.json").read_text(encoding="utf-8"))

    def scene(self, name: str, feature: bool) -> Scene:
        """Painted and projected once; anatomies with the same base share it."""
        return self._scene(*self._shared(name, feature))

    @staticmethod
    def _shared(name: str, feature: bool) -> tuple[str, bool]:
        """The first scene that is the same."""
        own = ANATOMIES[name]
        if feature and own.feature:
            return name, True
        return next(n for n, other in ANATOMIES.items() if other.base_key == own.base_key), False

    @lru_cache(maxsize=6)  # noqa: B019
    def _scene(self, name: str, feature: bool) -> Scene:
        what, bench = ANATOMIES[name], self.bench

        def compute() -> dict[str, Any]:
            above_fat = what.painted(bench.grid, feature=feature) - what.values["fat"]
            fbp, b = bench.projected(above_fat)
            return {"fbp": fbp.numpy(), "b": b.numpy(), "true": coarsened(above_fat) + PAPER_HU["patient"]}

        key = source_digest("recon.evaluate.anatomies")
        found = bench.store.piece(f"anatomies/{name}_{'with' if feature else 'without'}", key, compute)
        return Scene(*(torch.from_numpy(found[k]).float() for k in ("fbp", "b", "true")))

    def regions(self, name: str) -> Regions:
        """Where to read."""
        what, bench = ANATOMIES[name], self.bench
        shift = what.values["fat"] - PAPER_HU["patient"]
        both = [(self.scene(name, f).true.double() + shift).numpy() for f in (True, False)]
        # Single precision of the truth must not count as a change.
        both[1] = np.where(np.abs(both[0] - both[1]) < 1e-3, both[0], both[1])
        return what.regions(both[0], both[1], bench.grid)

    @lru_cache(maxsize=8)  # noqa: B019
    def best(self, name: str, dose: float) -> tuple[str, dict[str, Any]]:
        """The FBP kernel after which a filter had the least error on held-out vessels, and its settings."""
        nearest = min(self.tuning, key=lambda text: abs(np.log(float(text.split()[0]) / dose)))
        found = {k: self.tuning[nearest][f"{k} + {name}"] for k in KERNELS if f"{k} + {name}" in self.tuning[nearest]}
        kernel = min(found, key=lambda k: found[k]["rmse_hu"])
        return kernel, found[kernel]["settings"]

    @lru_cache(maxsize=16)  # noqa: B019
    def level(self, kernel: str, dose: float, sigma: float) -> float:
        """Noise of FBP smoothed by ``sigma``, HU."""
        inner = torch.zeros(self.bench.grid.shape, dtype=torch.bool)
        inner[4:-4, 4:-4, 4:-4] = True
        noises = [self.bench.noise(dose, k)[0][KERNELS.index(kernel)] for k in LEVEL_DRAWS]
        return float(np.sqrt(np.mean([flat_noise(n, inner, sigma=sigma) ** 2 for n in noises])))

    def shown(self, name: str, feature: bool, dose: float, k: int) -> dict[str, Shown]:
        """Every method's volume of draw ``k``."""
        name, feature = self._shared(name, feature)
        return self._made(name, feature, dose, k) if feature else self._kept(name, dose, k)

    @lru_cache(maxsize=2 * DRAWS)  # noqa: B019
    def _kept(self, name: str, dose: float, k: int) -> dict[str, Shown]:
        """Of scenes without a feature, which many anatomies share."""
        return self._made(name, False, dose, k)

    def _made(self, name: str, feature: bool, dose: float, k: int) -> dict[str, Shown]:
        scene = self._scene(name, feature)
        noise, noise_b = self.bench.noise(dose, k)
        b = scene.b * dose + noise_b
        run: dict[str, Callable[[], Shown]] = {
            "fbp": lambda: Shown((scene.fbp + noise)[KERNELS.index("soft")]),
            "bilateral": lambda: self._filtered("bilateral", scene.fbp + noise, dose),
            "perona_malik": lambda: self._filtered("perona_malik", scene.fbp + noise, dose),
            "pwls": lambda: self._pwls(b, dose),
            "network": lambda: self._mbir("network", b, dose),
            "drawing": lambda: self._mbir("drawing", b, dose),
        }
        return {method: run[method]() for method in self.methods}

    def _filtered(self, name: str, fbp: Tensor, dose: float) -> Shown:
        kernel, settings = self.best(name, dose)
        level = self.level(kernel, dose, settings.get("sigma", SMOOTHED_BY[name]))
        return Shown(FILTERS[name](fbp[KERNELS.index(kernel)], level, **settings))

    def _pwls(self, b: Tensor, dose: float) -> Shown:
        p = self.bench.problem
        with torch.no_grad():
            found = p.solve_statistic(b[None], dose, DEFAULT_PRIOR, tolerance=TOLERANCE_HU)
        return Shown(to_hu(found.x + p.level, p.mu_ref)[0])

    @torch.no_grad()
    def _mbir(self, name: str, b: Tensor, dose: float) -> Shown:
        network = self.networks[name]
        found = network.solved(self.bench.problem, b[None], dose)
        note = found.notes[0]
        drawn = bool(note.get("vessel", {}).get("drawn", False))
        volume = network.in_hu(self.bench.problem, found.u, found.normal)[0]
        return Shown(volume, drawn, tuple(note.get("warnings", ())))


def figures(scenes: Scenes, name: str, dose: float, draws: int) -> dict[str, Any]:
    """Method → its figures on one anatomy."""
    where, pair = scenes.regions(name), [scenes.scene(name, f) for f in (True, False)]
    feature, beside, elsewhere = (torch.from_numpy(m) for m in (where.feature, where.beside, where.elsewhere))
    change = (pair[0].true - pair[1].true)[feature].double()
    voxel = scenes.bench.grid.spacing[0]
    kept: dict[str, dict[str, list[Any]]] = {}
    sums: dict[str, Tensor] = {}
    for k in range(FIRST_DRAW, FIRST_DRAW + draws):
        shown = [scenes.shown(name, f, dose, k) for f in (True, False)]
        for method, seen in shown[0].items():
            row = kept.setdefault(method, {"recovered": [], "square": [], "drawn": [], "warnings": []})
            error = seen.volume - pair[0].true
            if ANATOMIES[name].feature:
                differs = (seen.volume - shown[1][method].volume)[feature].double()
                row["recovered"].append(float((differs * change.sign()).sum() / change.abs().sum()))
                row["square"].append(float(error[beside].double().square().mean()))
            row["drawn"].append(seen.drawn)
            row["warnings"].append(bool(seen.warnings))
            sums[method] = sums.get(method, torch.zeros_like(error)) + error / draws
    found = {}
    for method, row in kept.items():
        smooth = ndimage.gaussian_filter(sums[method].numpy(), SMOOTHED_MM / voxel, mode="nearest")
        found[method] = {
            "recovered": _mean(row["recovered"]),
            "recovered_sd": float(np.std(row["recovered"], ddof=1)) if len(row["recovered"]) > 1 else None,
            "beside_hu": float(np.sqrt(_mean(row["square"]))) if row["square"] else None,
            "invented_hu": float(np.percentile(np.abs(smooth[elsewhere.numpy()]), PERCENTILE)),
            "drawn": float(np.mean(row["drawn"])),
            "warnings": float(np.mean(row["warnings"])),
        }
    return found


def _mean(values: list[float]) -> Any:
    return float(np.mean(values)) if values else None


def tables(results: dict[str, Any]) -> str:
    """Markdown: one table a figure, methods side by side; every cell holds the exposures in order."""
    doses = list(results)
    texts = []
    titles = {
        "recovered": ("Contrast recovered", ".2f"),
        "beside_hu": ("Error beside the feature, HU", ".0f"),
        "invented_hu": ("Invented where nothing differs, HU", ".0f"),
        "drawn": ("Share of volumes drawn", ".2f"),
        "warnings": ("Share of volumes with a warning", ".2f"),
    }
    for key, (title, form) in titles.items():
        methods = [m for m in SHOWN if any(m in row for at in results.values() for row in at.values())]
        if key in ("drawn", "warnings"):
            methods = [m for m in methods if m in ("network", "drawing")]
        if not methods:
            continue
        lines = [f"## {title}", "", f"| | {' | '.join(SHOWN[m] for m in methods)} |", "|---" * (len(methods) + 1) + "|"]
        for name in results[doses[0]]:
            cells = [[results[d].get(name, {}).get(m, {}).get(key) for d in doses] for m in methods]
            text = [" / ".join("–" if v is None else format(v, form) for v in cell) for cell in cells]
            lines.append(f"| {ANATOMIES[name].title} | {' | '.join(text)} |")
        texts.append("\n".join(lines))
    return "\n\n".join(texts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, help="folder of scans, draws and finished pieces")
    parser.add_argument("--draws", type=int, default=DRAWS, metavar="N")
    parser.add_argument("--doses", type=float, nargs="+", default=list(DOSES), metavar="S")
    parser.add_argument("--anatomies", nargs="+", default=list(ANATOMIES), choices=ANATOMIES, metavar="NAME")
    parser.add_argument("--methods", nargs="+", default=list(SHOWN), choices=SHOWN, metavar="NAME")
    parser.add_argument("--out", type=Path, default=HERE, help="folder of the tables")
    options = parser.parse_args()
    torch.set_num_threads(1)
    scenes = Scenes(options.runs, options.methods)
    results: dict[str, Any] = {}
    for dose in options.doses:
        for name in options.anatomies:
            began = time.process_time()
            sources = source_digest("recon.evaluate.anatomies", "recon.mbir.outlines", "recon.evaluate.rivals")
            key = f"1 {options.draws} {options.methods} {sources}"
            piece = f"results/{name}_{dose:g}s"
            found = scenes.bench.store.piece(piece, key, lambda n=name, d=dose: figures(scenes, n, d, options.draws))
            results.setdefault(f"{dose:g} s", {})[name] = found
            plain = {"draws": options.draws, "first_seed": FIRST_DRAW, "results": results}
            options.out.mkdir(parents=True, exist_ok=True)
            (options.out / "anatomies.json").write_text(json.dumps(plain, indent=1) + "\n", encoding="utf-8")
            text = (
                f"# Anatomies that break assumptions\n\n`python tests/bench/anatomies.py RUNS`: {options.draws} draws; "
            )
            text += f"cells: {' / '.join(results)}.\n\n{tables(results)}\n"
            (options.out / "anatomies.md").write_text(text, encoding="utf-8")
            print(f"{name} {dose:g} s: {time.process_time() - began:.0f} s of processor time", flush=True)


if __name__ == "__main__":
    main()
