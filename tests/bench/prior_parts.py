"""What each part of the learned prior brings, on held-out vessels.

    python tests/bench/prior_parts.py RUNS

The weights that ship, whole and with one part left out, are measured on the four held-out vessels
that simple filters are tuned on (``rival_scenes.py``: along z, tilted, in plane, curved; other
diameters, plaques and tissues than the paper's), with and without the core, so nothing here was
chosen on a scene that a report quotes. Figures are kept in the folder RUNS; the same command goes
on. It writes ``prior_parts.json`` and ``prior_parts.md`` beside this file.
"""

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import torch
from results import write_results
from rival_scenes import DIRECTIONS, Bench, Place
from scipy import ndimage
from torch import Tensor

from recon.mbir.known import KnownImage
from recon.mbir.mbir import Mbir
from recon.mbir.network import bilateral_prior
from recon.mbir.priors import prior_of
from recon.vessel.known import KnownVessel
from recon.vessel.layer import LayerField

HERE = Path(__file__).parent
DOSES = (0.35, 2.0)
DRAWS = 6
FIRST_DRAW = 100
MOVED_HU = 150.0


def _one_orientation(network: Mbir) -> Mbir:
    config = network.model.network.config
    network.model.network.config = replace(config, turns=False)
    return network


class _OneLength(KnownVessel):
    """What the layer holds is correlated over 0.5 mm in every direction."""

    def image_of(self, *scan: Any) -> KnownImage:
        with mock.patch.object(LayerField.__init__, "__defaults__", ((0.5, 0.5, 0.5),)):
            return super().image_of(*scan)


def _with_vessel(network: Mbir) -> Mbir:
    return network.with_known(KnownVessel())


USES: dict[str, Callable[[Mbir], Mbir]] = {
    "as it ships": lambda n: n,
    "overshoot beside edges not cut off": lambda n: Mbir(n.model, cut_overshoot=False),
    "nothing put back": lambda n: Mbir(n.model, restore=False),
    "one orientation of the network instead of eight": _one_orientation,
    "no data consistency at the end": lambda n: Mbir(n.model, final_data_consistency=False),
    "its filtered view in the network's place": lambda n: Mbir(n.model, prior=bilateral_prior),
    "Perona and Malik's filter in the network's place": lambda n: Mbir(
        n.model, prior=prior_of("perona-malik")
    ),
    "the linear start alone": lambda n: Mbir(n.model, steps=0),
    "around a vessel model": _with_vessel,
    "vessel model, what is in the layer correlated over 0.5 mm in every direction": lambda n: (
        n.with_known(_OneLength())
    ),
    "vessel model, eight turns of the network instead of four": lambda n: _with_vessel(
        Mbir(n.model, prior=n.model.network)
    ),
    "vessel model, overshoot not cut off": lambda n: _with_vessel(
        Mbir(n.model, cut_overshoot=False)
    ),
    "vessel model, nothing put back": lambda n: _with_vessel(Mbir(n.model, restore=False)),
    "vessel model, no data consistency at the end": lambda n: _with_vessel(
        Mbir(n.model, final_data_consistency=False)
    ),
    "vessel model, the filtered view in the network's place": lambda n: _with_vessel(
        Mbir(n.model, prior=bilateral_prior)
    ),
    "vessel model, Perona and Malik's filter in the network's place": lambda n: _with_vessel(
        Mbir(n.model, prior=prior_of("perona-malik"))
    ),
}


@torch.no_grad()
def figures(network: Mbir, bench: Bench) -> dict[str, Any]:
    """Means over the held-out vessels."""
    found: dict[str, Any] = {}
    pairs = [(bench.held_out(d), bench.held_out(d, core=False)) for d in DIRECTIONS]

    def volume(b: Tensor, dose: float) -> Tensor:
        return network(bench.problem.term_of(b[None], dose))[0]

    for dose in DOSES:
        rows = []
        for with_core, without in pairs:
            clean = volume(dose * with_core.b, dose)
            whole, middle = (
                partial(_contrast, with_core, of) for of in (with_core.core, _inner(with_core.core))
            )
            errors, flat, contrasts, middles = [], [], [], []
            for k in range(FIRST_DRAW, FIRST_DRAW + DRAWS):
                noise = bench.noise(dose, k)[1]
                v, w = (volume(dose * p.b + noise, dose) for p in (with_core, without))
                errors.append(_square(v - with_core.true, with_core))
                contrasts.append((whole(v), whole(w)))
                middles.append((middle(v), middle(w)))
                flat.append(v[with_core.flat])
            slope, of_middle = (
                float(-torch.tensor(read).diff(dim=1).mean())
                / (of(with_core.true) - of(without.true))
                for read, of in ((contrasts, whole), (middles, middle))
            )
            row = {
                "error": torch.tensor(errors).mean().sqrt(),
                "clean": _square(clean - with_core.true, with_core) ** 0.5,
                "fat": torch.stack(flat).var(0).mean().sqrt(),
                "slope": slope,
                "middle": of_middle,
                "sd": torch.tensor(contrasts)[:, 0].std() / slope,
                "rim": clean[_rim(with_core)].min() - with_core.true.min(),
            }
            rows.append(row)
        found[f"{dose:g}"] = {
            k: float(torch.tensor([float(r[k]) for r in rows]).mean()) for k in rows[0]
        }
    place = pairs[0][0]
    moved = volume(
        place.b
        + bench.problem.gram.apply(
            torch.full_like(place.b, MOVED_HU) * bench.problem.mu_ref / 1000
        ),
        1.0,
    )
    still = volume(place.b, 1.0)
    found["moved_hu"] = _square(moved - still - MOVED_HU, place) ** 0.5
    return found


def _square(error: Tensor, place: Place) -> float:
    return float(error[place.inside].square().mean())


def _contrast(place: Place, of: Tensor, v: Tensor) -> float:
    return float(v[place.around].double().mean() - v[of].double().mean())


def _inner(core: Tensor) -> Tensor:
    """Voxels of a core whose six neighbours are in it, too."""
    return torch.from_numpy(ndimage.binary_erosion(core.numpy()))


def _rim(place: Place) -> Tensor:
    """Fat within two voxels of bodies."""
    near = torch.nn.functional.max_pool3d(place.inside[None, None].float(), 5, 1, 2)[0, 0] > 0
    return near & (place.true <= place.true.min() + 1e-3)


COLUMNS = (
    ("error", "error, HU"),
    ("clean", "without noise"),
    ("fat", "SD in fat"),
    ("slope", "slope"),
    ("middle", "slope, middle"),
    ("sd", "contrast SD at slope 1"),
    ("rim", "deepest undershoot"),
)


def table(results: dict[str, Any]) -> str:
    """Markdown; every cell 0.35 s / 2.0 s."""
    lines = [
        "| | " + " | ".join(t for _, t in COLUMNS) + " | constant added |",
        "|---" * (len(COLUMNS) + 2) + "|",
    ]
    for name, r in results.items():
        cells = [
            " / ".join(f"{r[f'{d:g}'][k]:.{2 if k in ('slope', 'middle') else 1}f}" for d in DOSES)
            for k, _ in COLUMNS
        ]
        lines.append(f"| {name} | " + " | ".join(cells) + f" | {r['moved_hu']:.1f} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", type=Path)
    a = parser.parse_args()
    bench = Bench(a.runs / "bench")
    began = time.perf_counter()
    results: dict[str, Any] = {}

    for use, make in USES.items():
        kept = a.runs / f"{use.replace(' ', '_').replace(',', '')}.json"
        if not kept.exists():
            kept.write_text(json.dumps(figures(make(Mbir.load()), bench)), encoding="utf-8")
        results[use] = json.loads(kept.read_text(encoding="utf-8"))
        text = (
            f"0.35 / 2.0 s; means over four held-out vessels and {DRAWS} noise draws. Undershoot: "
            "the darkest fat "
            "beside the vessel without noise, against the truth. Constant added: change of the "
            "volume, HU rms, beside "
            f"the {MOVED_HU:g} HU that were added to the inset.\n\n{table(results)}\n"
        )
        write_results(
            HERE,
            "prior_parts",
            {"draws": DRAWS, "results": results},
            f"# What each part of the prior brings\n\n{text}",
        )
        print(f"{time.perf_counter() - began:.0f} s: {use}", flush=True)


if __name__ == "__main__":
    main()
