"""Settings of the simple filters (``recon.filters``): tuned on held-out vessels of four directions.

    python tests/bench/rivals.py [--filters NAME ...] [--bases NAME ...] [--doses S ...]

For every exposure, filter and base (FBP kernel on 0.2 mm, PWLS) the settings with the least error
in the vessel, mean over four held-out plaques on vessels along z, tilted, in plane and curved
(other diameters, plaques, tissue values and draws than those of any task). Results are written one
by one into ``recon/evaluate/rivals_tuning.json``, where the methods ``FILTER@fbp:KERNEL`` of
:mod:`recon.evaluate` find them, and kept: the same command goes on. BM4D (licence: non-commercial)
counts where it is installed.
"""

import argparse
import importlib.util
import itertools
import json
import time
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rival_scenes import DIRECTIONS, KERNELS, Bench, Place
from torch import Tensor

import recon.evaluate
from recon.analytic.exact_noise import voxel_covariance
from recon.analytic.inset import InsetFbp
from recon.filters import FILTERS, flat_noise
from recon.least_squares.qggmrf import DEFAULT_PRIOR
from recon.least_squares.reconstruct import TOLERANCE_HU

HERE = Path(__file__).parent
TUNED = Path(str(recon.evaluate.__path__[0])) / "rivals_tuning.json"
"""Where the instrument finds them."""
DOSES = (0.35, 0.7, 2.0)
BASES = (*KERNELS, "pwls")
SEARCH: dict[str, dict[str, list[Any]]] = {
    "gaussian": {"sigma": [0.4, 0.6, 0.8, 1.0, 1.3]},
    "perona_malik": {
        "edge": [0.8, 1.0, 1.3, 1.6, 2.0, 2.5],
        "steps": [4, 8, 15, 25, 40],
        "sigma": [0.4, 0.55, 0.7, 0.9, 1.2, 1.6],
    },
    "bilateral": {
        "edge": [1.0, 1.4, 2.0, 2.8, 4.0],
        "reach": [0.8, 1.1, 1.5, 2.0, 2.5, 3.0, 4.0],
        "sigma": [0.4, 0.7, 1.0, 1.4, 1.9, 2.6],
    },
    "nlm": {
        "strength": [0.4, 0.6, 0.8, 1.1, 1.5],
        "patch": [1, 2, 3],
        "search": [3, 4],
        "noise_factor": [0.75, 1.0, 1.25],
    },
    "tv": {"strength": [0.15, 0.3, 0.5, 0.7, 1.0, 1.5, 2.2, 3.0]},
    "bm4d": {"strength": [0.8, 1.0, 1.25]},
}
TUNED_DRAWS = {"nlm": 1, "bm4d": 1}
"""Draws of each direction; 2 where not named."""
FIRST_SEED = 1000
"""Of the tuning's draws: 1000 to 1003; those measured begin with 0, as in the dose-factor study."""


class Methods:
    """Volumes of a place by a method's name: a base, or ``base + filter``."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench

    @lru_cache(maxsize=256)  # noqa: B019
    def level(self, base: str, dose: float, sigma: float) -> float:
        """Noise in fat of a base smoothed by ``sigma``, HU: of the noise alone, on the tuning's
        draws."""
        place = self.bench.held_out("along z")
        clean = self.base(base, "along z", dose, None)
        found = [
            flat_noise(
                self.base(base, "along z", dose, FIRST_SEED + k) - clean, place.flat, sigma=sigma
            )
            for k in range(2)
        ]
        return float(np.sqrt(np.mean(np.square(found))))

    @lru_cache(maxsize=64)  # noqa: B019
    def base(self, name: str, direction: str, dose: float, seed: int | None) -> Tensor:
        """Volume in HU of a held-out plaque; ``seed`` None: noise free."""
        place = self.bench.held_out(direction)
        noise = None if seed is None else self.bench.noise(dose, seed)
        if name in KERNELS:
            k = KERNELS.index(name)
            return place.fbp[k] + (0.0 if noise is None else noise[0][k])
        b, p = place.b * dose + (0.0 if noise is None else noise[1]), self.bench.problem
        with torch.no_grad():
            term = p.term_of(b[None], dose)
            return p.solve(term, DEFAULT_PRIOR, tolerance=TOLERANCE_HU)[0][0]

    @lru_cache(maxsize=8)  # noqa: B019
    def covariance(self, kernel: str) -> Any:
        """Exact, of FBP's noise about the middle voxel."""
        b = self.bench
        middle = [n // 2 for n in b.grid.shape]
        fbp = InsetFbp(b.clean, [b.grid], [kernel])
        found = b.store.cached(
            f"covariance_{kernel}",
            "1",
            lambda: {"c": voxel_covariance(b.clean, fbp, 1.0, middle).numpy()},
        )["c"]
        return found[tuple(slice(m - 10, m + 11) for m in middle)]

    def filtered(
        self, name: str, base: str, volume: Tensor, dose: float, settings: dict[str, Any]
    ) -> Tensor:
        """A base's volume filtered."""
        sigma = settings.get("sigma", 0.0) if name in ("perona_malik", "bilateral") else 0.0
        more = {"covariance": self.covariance(base)} if name == "bm4d" else {}
        return FILTERS[name](volume, self.level(base, dose, sigma), **settings, **more)


def error(volume: Tensor, place: Place) -> float:
    """Mean square error inside, HU²."""
    return float((volume - place.true)[place.inside].double().square().mean())


def tune(
    bench: Bench, folder: Path, doses: list[float], names: list[str], bases: list[str]
) -> None:
    """Settings of every filter on every base."""
    methods, path = Methods(bench), TUNED
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
    cases = [
        (direction, FIRST_SEED + (i + 2 * k) % 4)
        for i, direction in enumerate(DIRECTIONS)
        for k in range(draws)
    ]
    values = SEARCH[name]
    tried: dict[tuple[int, ...], dict[str, float]] = {}

    def by_direction(change: Callable[[Tensor], Tensor]) -> dict[str, float]:
        squares: dict[str, list[float]] = {}
        for direction, seed in cases:
            volume = change(methods.base(base, direction, dose, seed))
            squares.setdefault(direction, []).append(
                error(volume, methods.bench.held_out(direction))
            )
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
    return {
        "settings": settings(best),
        "rmse_hu": mean(best),
        "directions": tried[best],
        "unfiltered_hu": plain,
        "tried": len(tried),
    }


def read(path: Path) -> Any:
    """What a run before has left."""
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}


def tuning_text(kept: dict[str, Any]) -> str:
    """Markdown."""
    lines = [
        "# Settings of the rivals",
        "",
        "`python tests/bench/rivals.py`: error in the vessel, HU, on held-out plaques; lengths in "
        "voxels of 0.2 mm, thresholds in units of the noise.",
        "",
        f"| s | base | filter | unfiltered | mean | {' | '.join(DIRECTIONS)} | settings |",
        "|---" * (6 + len(DIRECTIONS)) + "|",
    ]
    for dose, at in kept.items():
        for method, t in sorted(at.items(), key=lambda item: item[1]["rmse_hu"]):
            base, _, name = method.partition(" + ")
            settings = ", ".join(f"{k} {v:g}" for k, v in t["settings"].items())
            lines.append(
                f"| {dose} | {base} | {name} | {t['unfiltered_hu']:.1f} | {t['rmse_hu']:.1f} | "
                + " | ".join(f"{v:.1f}" for v in t["directions"].values())
                + f" | {settings} |"
            )
    return "\n".join([*lines, ""])


def main() -> None:
    """Tune."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--doses", type=float, nargs="+", default=list(DOSES), metavar="S")
    parser.add_argument(
        "--filters", nargs="+", default=list(SEARCH), choices=SEARCH, metavar="NAME"
    )
    parser.add_argument("--bases", nargs="+", default=list(BASES), choices=BASES, metavar="NAME")
    parser.add_argument(
        "--work", type=Path, default=Path("out/bench-rivals"), help="folder of scans and draws"
    )
    parser.add_argument("--out", type=Path, default=HERE, help="folder of the text")
    options = parser.parse_args()
    torch.set_num_threads(1)
    names = [n for n in options.filters if n != "bm4d" or importlib.util.find_spec("bm4d")]
    tune(Bench(options.work), options.out, options.doses, names, options.bases)


if __name__ == "__main__":
    main()
