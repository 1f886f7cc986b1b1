"""Simple filters of FBP and PWLS (``recon.evaluate.rivals``) beside MBIR, on the same noise draws.

    python tests/bench/rivals.py tune | measure [--draws 16] [--places NAME ...] [--methods NAME ...] [--doses S ...]

``tune``: for every exposure, filter and base (FBP kernel on 0.2 mm, PWLS) the settings with the least error in the
vessel, mean over four held-out plaques on vessels along z, tilted, in plane and curved (other diameters, plaques,
tissue values and draws than those measured). ``measure``: the paper's plaque and further scenes, each with its twin
without the core, by all methods on the same draws (``rival_scenes.py``). Results are written one by one, and kept: the
same command goes on. BM4D (licence: non-commercial) counts where it is installed.

RMSE: voxels more than half in the vessel, truth averaged over voxels; "clean": of the noise-free volume, filtered with
the same settings. SD: over draws, of voxels of flat tissue. Slope: contrast that the core adds over the true one; no
core: contrast read from the twin; SD of the contrast over the slope. Rim: on noise-free data, lowest fat within 0.8 mm
of the vessel; fibrous tissue 0.3 to 0.5 mm from the lumen without a core; core voxels next to the cap.
"""

from __future__ import annotations

import argparse
import importlib.util
import itertools
import json
import time
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from results import write_results
from rival_scenes import DIRECTIONS, KERNELS, PLACES, Bench, Place
from rod_values import ROD_HU
from torch import Tensor

import recon.evaluate
from recon.evaluate.rivals import FILTERS, flat_noise
from recon.fbp.exact_noise import voxel_covariance
from recon.fbp.inset import InsetFbp
from recon.mbir.mbir import Mbir
from recon.pwls.qggmrf import DEFAULT_PRIOR
from recon.study.dose_factor.methods import Penalised

HERE = Path(__file__).parent
TUNED = Path(str(recon.evaluate.__path__[0])) / "rivals_tuning.json"
"""Where the instrument finds them."""
DOSES, BASES = (0.35, 0.7, 2.0), (*KERNELS, "pwls")
SEARCH: dict[str, dict[str, list[Any]]] = {
    "gaussian": {"sigma": [0.4, 0.6, 0.8, 1.0, 1.3]},
    "perona_malik": {
        "edge": [0.8, 1.0, 1.3, 1.6, 2.0, 2.5], "steps": [4, 8, 15, 25, 40], "sigma": [0.4, 0.55, 0.7, 0.9, 1.2, 1.6],
    },
    "bilateral": {
        "edge": [1.0, 1.4, 2.0, 2.8, 4.0], "reach": [0.8, 1.1, 1.5, 2.0, 2.5, 3.0], "sigma": [0.4, 0.7, 1.0, 1.4, 1.9],
    },
    "nlm": {"strength": [0.4, 0.6, 0.8, 1.1, 1.5], "patch": [1, 2, 3], "search": [3, 4], "told": [0.75, 1.0, 1.25]},
    "tv": {"strength": [0.15, 0.3, 0.5, 0.7, 1.0, 1.5, 2.2, 3.0]},
    "bm4d": {"strength": [0.8, 1.0, 1.25]},
}  # fmt: skip
TUNED_DRAWS = {"nlm": 1, "bm4d": 1}
"""Draws of each direction; 2 where not named."""
FIRST_SEED = 1000
"""Of the tuning's draws: 1000 to 1003; those measured begin with 0, as in the dose-factor study."""
FEW = {"bm4d": 2, "pwls": 8, "MBIR, 8 turns": 4}
"""Fewer draws of what takes long."""
WITHOUT_CORE = 8
"""Draws of a twin."""


class Methods:
    """Volumes of a place by a method's name: a base, or ``base + filter``."""

    def __init__(self, bench: Bench, tuned: dict[str, Any]) -> None:
        self.bench, self.tuned = bench, tuned
        self.networks = {"MBIR": Mbir.load(), "MBIR, 8 turns": Mbir.load()}
        turned = self.networks["MBIR, 8 turns"].model.network
        turned.config = replace(turned.config, turns=True)

    @lru_cache(maxsize=64)  # noqa: B019
    def base(self, name: str, place: Place, dose: float, seed: int | None, twin: int = 0) -> Tensor:
        """Volume in HU; ``seed`` None: noise free."""
        noise = None if seed is None else self.bench.noise(dose, seed)
        if name in KERNELS:
            k = KERNELS.index(name)
            return place.fbp[twin, k] + (0.0 if noise is None else noise[0][k])
        b = place.b[twin] * dose + (0.0 if noise is None else noise[1])
        method = self.networks.get(name) or Penalised("qggmrf", DEFAULT_PRIOR, tolerance=2.0)
        with torch.no_grad():
            return method(self.bench.problem, b[None], dose)[0]

    @lru_cache(maxsize=256)  # noqa: B019
    def level(self, base: str, dose: float, sigma: float) -> float:
        """Noise in fat of a base smoothed by ``sigma``, HU: of the noise alone, on the tuning's draws."""
        place = self.bench.held_out("along z")
        clean = self.base_kept(base, "along z", dose, None)
        found = [flat_noise(self.base_kept(base, "along z", dose, FIRST_SEED + k) - clean, place.flat, sigma=sigma)
                 for k in range(2)]  # fmt: skip
        return float(np.sqrt(np.mean(np.square(found))))

    @lru_cache(maxsize=64)  # noqa: B019
    def base_kept(self, base: str, direction: str, dose: float, seed: int | None) -> Tensor:
        """A base on a held-out plaque."""
        return self.base(base, self.bench.held_out(direction), dose, seed)

    @lru_cache(maxsize=8)  # noqa: B019
    def covariance(self, kernel: str) -> Any:
        """Exact, of FBP's noise about the middle voxel."""
        b = self.bench
        middle = [n // 2 for n in b.grid.shape]
        fbp = InsetFbp(b.clean, [b.grid], [kernel])
        found = b.store.piece(f"covariance_{kernel}", "1", lambda: {
            "c": voxel_covariance(b.clean, fbp, 1.0, middle).numpy()})["c"]  # fmt: skip
        return found[tuple(slice(m - 10, m + 11) for m in middle)]

    def filtered(self, name: str, base: str, volume: Tensor, dose: float, settings: dict[str, Any]) -> Tensor:
        """A base's volume filtered."""
        sigma = settings.get("sigma", 0.0) if name in ("perona_malik", "bilateral") else 0.0
        more = {"covariance": self.covariance(base)} if name == "bm4d" else {}
        return FILTERS[name](volume, self.level(base, dose, sigma), **settings, **more)

    def __call__(self, method: str, place: Place, dose: float, seed: int | None, twin: int) -> Tensor:
        base, _, name = method.partition(" + ")
        volume = self.base(base, place, dose, seed, twin)
        if not name:
            return volume
        return self.filtered(name, base, volume, dose, self.tuned[f"{dose:g} s"][method]["settings"])


def error(volume: Tensor, place: Place, twin: int = 0) -> float:
    """Mean square error inside, HU²."""
    return float((volume - place.true[twin])[place.inside].double().square().mean())


def tune(bench: Bench, folder: Path, doses: list[float], names: list[str], bases: list[str]) -> None:
    """Settings of every filter on every base."""
    methods, path = Methods(bench, {}), TUNED
    for dose, name, base in itertools.product(doses, names, bases):
        method, key = f"{base} + {name}", f"{dose:g} s"
        if method in read(path).get(key, {}) or (name == "bm4d" and base == "pwls"):
            continue
        began = time.process_time()
        found = searched(methods, name, base, dose)
        found["seconds"] = round(time.process_time() - began, 1)
        print(key, method, found, flush=True)
        kept = read(path)
        kept.setdefault(key, {})[method] = found
        TUNED.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")
        (folder / "rivals_tuning.md").write_text(tuning_text(kept), encoding="utf-8")


def searched(methods: Methods, name: str, base: str, dose: float) -> dict[str, Any]:
    """Coordinate search from the middle of every setting's values."""
    draws = TUNED_DRAWS.get(name, 1 if base == "pwls" else 2)
    cases = [(direction, FIRST_SEED + (i + 2 * k) % 4) for i, direction in enumerate(DIRECTIONS) for k in range(draws)]
    values = SEARCH[name]
    tried: dict[tuple[int, ...], dict[str, float]] = {}

    def by_direction(change: Callable[[Tensor], Tensor]) -> dict[str, float]:
        squares: dict[str, list[float]] = {}
        for direction, seed in cases:
            volume = change(methods.base_kept(base, direction, dose, seed))
            squares.setdefault(direction, []).append(error(volume, methods.bench.held_out(direction)))
        return {direction: float(np.sqrt(np.mean(v))) for direction, v in squares.items()}

    def settings(at: tuple[int, ...]) -> dict[str, Any]:
        return {k: v[i] for (k, v), i in zip(values.items(), at, strict=True)}

    def mean(at: tuple[int, ...]) -> float:
        if any(not 0 <= i < len(v) for i, v in zip(at, values.values(), strict=True)):
            return np.inf
        if at not in tried:
            tried[at] = by_direction(lambda u: methods.filtered(name, base, u, dose, settings(at)))
        return float(np.mean(list(tried[at].values())))

    best, before = tuple(len(v) // 2 for v in values.values()), None
    while best != before:
        before = best
        for axis, step in itertools.product(range(len(best)), (1, -1)):
            while mean(there := (*best[:axis], best[axis] + step, *best[axis + 1 :])) < mean(best):
                best = there
    plain = float(np.mean(list(by_direction(lambda u: u).values())))
    return {"settings": settings(best), "rmse_hu": mean(best), "directions": tried[best], "unfiltered_hu": plain,
            "tried": len(tried)}  # fmt: skip


def best_of(tuned: dict[str, Any], name: str) -> str:
    """The base on which a filter has the least error, mean over the exposures' ratios."""
    bases = [b for b in KERNELS if all(f"{b} + {name}" in at for at in tuned.values())]
    if not bases:
        raise SystemExit(
            f"{name} has not been tuned at every exposure on one kernel: run tune before, or name --methods"
        )
    return min(bases, key=lambda b: np.mean([np.log(at[f"{b} + {name}"]["rmse_hu"]) for at in tuned.values()]))


def measure(bench: Bench, folder: Path, tuned: dict[str, Any], options: argparse.Namespace) -> None:
    """Every method at every place and exposure."""
    methods, path = Methods(bench, tuned), folder / "rivals.json"
    for name, method, dose in itertools.product(options.places, options.methods, options.doses):
        key = {"place": name, "method": method, "exposure_s": dose}
        n = min(options.draws, *(FEW.get(part, options.draws) for part in method.split(" + ")))
        if any(key.items() <= r.items() and r["draws"] >= n for r in read(path).get("rows", [])):
            continue
        began = time.process_time()
        row = {**key, "draws": n, **figures(partial(methods, method, bench.place(name), dose), bench.place(name), n)}
        row["seconds"] = round(time.process_time() - began, 1)
        print(key, {k: round(v, 1) for k, v in row.items() if isinstance(v, float)}, flush=True)
        rows = [r for r in read(path).get("rows", []) if not key.items() <= r.items()]
        kept = {"true_hu": ROD_HU, "rows": [*rows, row]}
        write_results(folder, "rivals", kept, text(kept))


def figures(volume: Callable[[int | None, int], Tensor], place: Place, n: int) -> dict[str, Any]:
    """Of ``n`` draws."""
    clean = [volume(None, twin).double() for twin in range(2)]
    found = {"rmse_clean_hu": error(clean[0], place) ** 0.5}
    for name, mask in place.rim.items():
        seen = clean[1 if name == "fibrous" else 0][mask]
        found[f"rim_{name}_hu"] = float(seen.min() if name == "fat" else seen.mean())
    squares: list[float] = []
    flat: list[Tensor] = []
    read_: list[Any] = []
    for seed in range(n):
        pair = [volume(seed, twin).double() for twin in range(2 if seed < min(n, WITHOUT_CORE) else 1)]
        squares.append(error(pair[0], place))
        flat.append(pair[0][place.flat])
        read_.append([[float(((b - a) * v).sum()) for a, b in place.rows.values()] for v in pair])
    found["rmse_hu"] = float(np.sqrt(np.mean(squares)))
    found["rmse_se_hu"] = float(np.std(squares, ddof=1) / np.sqrt(n) / 2 / found["rmse_hu"])
    found["flat_sd_hu"] = float(torch.stack(flat).var(0).mean().sqrt())
    there = np.array([r[0] for r in read_])
    twins = np.array([r for r in read_ if len(r) == 2])
    rois = {}
    for j, roi in enumerate(place.rows):
        slope = float((twins[:, 0, j] - twins[:, 1, j]).mean() / place.contrast)
        mean, sd = float(there[:, j].mean()), float(there[:, j].std(ddof=1))
        # All draws tell of the contrast without a core, those of the twin what the core adds.
        rois[roi] = {"contrast_hu": mean, "slope": slope, "sd_hu": sd, "corrected_sd_hu": sd / slope,
                     "no_core_hu": mean - slope * place.contrast}  # fmt: skip
    return {**found, "rois": rois}


def read(path: Path) -> Any:
    """What a run before has left."""
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}


def tuning_text(kept: dict[str, Any]) -> str:
    """Markdown."""
    lines = [
        "# Settings of the rivals",
        "",
        "`python tests/bench/rivals.py tune`: error in the vessel, HU, on held-out plaques; lengths in voxels of "
        "0.2 mm, thresholds in units of the noise.",
        "",
        f"| s | base | filter | unfiltered | mean | {' | '.join(DIRECTIONS)} | settings |",
        "|---" * (6 + len(DIRECTIONS)) + "|",
    ]
    for dose, at in kept.items():
        for method, t in sorted(at.items(), key=lambda item: item[1]["rmse_hu"]):
            base, _, name = method.partition(" + ")
            settings = ", ".join(f"{k} {v:g}" for k, v in t["settings"].items())
            lines.append(f"| {dose} | {base} | {name} | {t['unfiltered_hu']:.1f} | {t['rmse_hu']:.1f} | "
                         + " | ".join(f"{v:.1f}" for v in t["directions"].values()) + f" | {settings} |")  # fmt: skip
    return "\n".join([*lines, ""])


def text(kept: dict[str, Any]) -> str:
    """Markdown."""
    doc = (__doc__ or "").split("\n\n")
    lines = ["# MBIR and its simplest rivals", "", doc[2].replace("\n", " "), "", doc[3].replace("\n", " ").strip(), ""]
    for name in dict.fromkeys(r["place"] for r in kept["rows"]):
        here = [r for r in kept["rows"] if r["place"] == name]
        rois = list(here[0]["rois"])
        lines += [f"## {name}", "", "| s | method | n | RMSE | clean | SD, flat | " + " | ".join(
            f"{roi}: slope, SD / slope, no core" for roi in rois) + " | rim: fat, fibrous, core |",
            "|---" * (7 + len(rois)) + "|"]  # fmt: skip
        for r in sorted(here, key=lambda r: (r["exposure_s"], r["rmse_hu"])):
            cells = [
                f"{c['slope']:.2f}, {c['corrected_sd_hu']:.1f}, {c['no_core_hu']:+.0f}" for c in r["rois"].values()
            ]
            rim = ", ".join(f"{r[f'rim_{k}_hu']:.0f}" for k in ("fat", "fibrous", "core") if f"rim_{k}_hu" in r)
            rmse = f"{r['rmse_hu']:.1f} ± {r['rmse_se_hu']:.1f} | {r['rmse_clean_hu']:.1f} | {r['flat_sd_hu']:.1f}"
            head = f"{r['exposure_s']:g} | {r['method']} | {r['draws']} | {rmse}"
            lines.append(f"| {head} | {' | '.join(cells)} | {rim} |")
        lines.append("")
    return "\n".join(lines)


def main() -> None:
    """Tune or measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", choices=["tune", "measure"])
    parser.add_argument("--draws", type=int, default=16)
    parser.add_argument("--doses", type=float, nargs="+", metavar="S", help="default: all tuned, 0.35 and 2 measured")
    parser.add_argument("--places", nargs="+", default=["paper"], choices=PLACES, metavar="NAME")
    parser.add_argument("--methods", nargs="+", metavar="NAME", help="default: all")
    parser.add_argument("--filters", nargs="+", default=list(SEARCH), choices=SEARCH, metavar="NAME")
    parser.add_argument("--bases", nargs="+", default=list(BASES), choices=BASES, metavar="NAME")
    parser.add_argument("--work", type=Path, default=Path("out/bench-rivals"), help="folder of scans and draws")
    parser.add_argument("--out", type=Path, default=HERE, help="folder of the results")
    options = parser.parse_args()
    torch.set_num_threads(1)
    bench = Bench(options.work)
    names = [n for n in options.filters if n != "bm4d" or importlib.util.find_spec("bm4d")]
    if options.task == "tune":
        tune(bench, options.out, options.doses or list(DOSES), names, options.bases)
        return
    tuned = read(TUNED)
    options.doses = options.doses or [0.35, 2.0]
    if not options.methods:
        filtered = [f"{best_of(tuned, n)} + {n}" for n in names]
        options.methods = [*BASES, *filtered, "pwls + perona_malik", "MBIR", "MBIR, 8 turns"]
    measure(bench, options.out, tuned, options)


if __name__ == "__main__":
    main()
