"""Error against exact projection pairs and time: Gram-preconditioned PWLS, FISTA and ordered
subsets, one problem.

    python tests/bench/solvers.py [--views 1968] [--voxel 0.2] [--out tests/bench]

The problem is the paper's plaque at 2.0 s with the package's q-GGMRF prior, on the inset's
footprint. The reference is the float64 minimum, converged to 1e-3 HU. FISTA is the accelerated
gradient method with the separable (SQS) majoriser of data and prior (Beck, Teboulle 2009; Erdogan,
Fessler 1999); OS-SQS replaces the data gradient by that of one of 12 subsets of the views, with
momentum (Kim, Ramani, Fessler 2015). One pair is one A and one Aᵀ of all views.
"""

import argparse
import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch
from results import write_results
from torch import Tensor

from recon.gram.gram import Gram
from recon.least_squares.inset_problem import InsetProblem
from recon.least_squares.pwls import pwls
from recon.least_squares.qggmrf import DEFAULT_PRIOR
from recon.study.paper.plaque_scan import inset_grid
from torchpcct import Projector, acquire
from torchpcct.detector_window import DetectorWindow
from torchpcct.scanner import presets
from torchpcct.scene.plaque import plaque_scene

EXPOSURE_S = 2.0
SUBSETS = 12


class Problem:
    """One noisy scan: y, W, A, the prior, and the float64 minimum."""

    def __init__(self, views: int, voxel_mm: float) -> None:
        scene, plaque = plaque_scene()
        grid = inset_grid(plaque, voxel_mm)
        clean = acquire(scene, presets.pcct(views=views), region=grid, duty=min(1.0, views / 1968))
        inset = InsetProblem(clean, grid)
        self.hu = inset.mu_ref / 1000.0
        self.A, self.w = inset.projector, inset.weights * EXPOSURE_S
        self.y = inset.data(clean.with_noise(EXPOSURE_S, 0))
        self.grid = grid
        start = time.perf_counter()
        self.gram = Gram(self.A, self.w, nodes=5)
        self.gram_seconds = time.perf_counter() - start
        self.prior = DEFAULT_PRIOR.bind(self.gram.information(self.hu), grid.spacing, self.hu)
        self.reference = pwls(
            self.A,
            self.y.double(),
            self.w.double(),
            self.prior,
            mu_per_hu=self.hu,
            gram=self.gram,
            tolerance=1e-3,
            max_exact=60,
        ).volume

    def rmsd(self, x: Tensor) -> float:
        """Root mean square distance to the minimum, HU."""
        return float((x.double() - self.reference).square().mean().sqrt()) / self.hu

    def majoriser(self) -> Tensor:
        """Separable curvature of data and prior: AᵀW A 1 plus the prior's largest eigenvalue."""
        flat = self.A.T(self.w * self.A(torch.ones(self.grid.shape)))
        return flat + float(self.prior.spectrum(self.grid.shape).max())


def ours(p: Problem) -> Iterator[tuple[float, float, float]]:
    """(pairs, seconds, HU) of PWLS stopped after more and more pairs."""
    for most in (1, 2, 3, 4, 6):
        start = time.perf_counter()
        result = pwls(
            p.A, p.y, p.w, p.prior, mu_per_hu=p.hu, gram=p.gram, tolerance=1e-6, max_exact=most
        )
        yield result.report["exact_pairs"], time.perf_counter() - start, p.rmsd(result.volume)


def fista(p: Problem, iterations: int = 60) -> Iterator[tuple[float, float, float]]:
    """(pairs, seconds, HU) after each iteration."""
    b = p.A.T(p.w * p.y)
    return _accelerated(p, [lambda x: p.A.T(p.w * p.A(x)) - b], iterations)


def ordered_subsets(p: Problem, passes: int = 30) -> Iterator[tuple[float, float, float]]:
    """(pairs, seconds, HU) after each subset, subsets in bit-reversed order."""
    g, window = p.A.geometry, p.A.window
    gradients = []
    for first in sorted(range(SUBSETS), key=lambda k: f"{k:04b}"[::-1]):
        views = np.arange(first, g.views, SUBSETS)
        part = DetectorWindow(
            window.first_column[views], window.columns, window.first_row, window.rows
        )
        A = Projector(g.select(views), p.grid, part)
        index = torch.from_numpy(views)
        w, y = p.w[index], p.y[index]
        scale = g.views / len(views)
        gradients.append(lambda x, A=A, w=w, y=y, scale=scale: A.T(w * (A(x) - y)) * scale)
    return _accelerated(p, gradients, passes * SUBSETS)


def _accelerated(
    p: Problem, gradients: list[Callable[[Tensor], Tensor]], iterations: int
) -> Iterator[tuple[float, float, float]]:
    d = p.majoriser()
    x = z = torch.zeros(p.grid.shape)
    t, spent = 1.0, 0.0
    for k in range(iterations):
        start = time.perf_counter()
        new = z - (gradients[k % len(gradients)](z) + p.prior.gradient(z[None])[0]) / d
        t_next = (1 + math.sqrt(1 + 4 * t * t)) / 2
        z = new + (t - 1) / t_next * (new - x)
        x, t = new, t_next
        spent += time.perf_counter() - start
        if (k + 1) % len(gradients) == 0:
            yield (k + 1) / len(gradients), spent, p.rmsd(x)


def main() -> None:
    """Run, print the table, write ``solvers.json``, ``solvers.md`` and ``solvers.png``."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--views", type=int, default=1968)
    parser.add_argument("--voxel", type=float, default=0.2)
    parser.add_argument("--iterations", type=int, default=60)
    parser.add_argument("--out", type=Path, default=Path("tests/bench"))
    args = parser.parse_args()
    p = Problem(args.views, args.voxel)
    curves = {
        "Gram + exact pairs": list(ours(p)),
        "FISTA (SQS)": list(fista(p, args.iterations)),
        f"OS-SQS, {SUBSETS} subsets, momentum": list(
            ordered_subsets(p, max(1, args.iterations // 2))
        ),
    }
    rows = []
    for name, points in curves.items():
        for pairs, seconds, hu in points:
            if pairs in (1, 2, 3, 4, 6, 10, 20, 30, 60):
                rows.append(f"| {name} | {pairs:g} | {seconds:.2f} | {hu:.3g} |")
    text = "\n".join(
        [
            "# PWLS: distance to the converged minimum",
            "",
            f"`python tests/bench/solvers.py --views {args.views} --voxel {args.voxel:g}`; the "
            f"Gram operator ({p.gram_seconds:.1f} s once per scan) is not counted.",
            "",
            "| solver | exact pairs | seconds | rms distance, HU |",
            "|---|---|---|---|",
            *rows,
            "",
            "![Distance to the minimum](solvers.png)",
            "",
        ]
    )
    print(text)
    write_results(args.out, "solvers", curves, text)
    _draw(curves, args.out / "solvers.png")


def _draw(curves: dict[str, list[tuple[float, float, float]]], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), sharey=True, layout="constrained")
    for name, points in curves.items():
        pairs, seconds, hu = zip(*points, strict=True)
        axes[0].loglog(pairs, hu, ".-", label=name)
        axes[1].loglog(seconds, hu, ".-", label=name)
    axes[0].set(xlabel="exact projection pairs", ylabel="rms distance to the minimum, HU")
    axes[1].set(xlabel="seconds")
    axes[0].legend(fontsize=8)
    for axis in axes:
        axis.axhline(1.0, color="0.7", lw=0.8)
        axis.grid(alpha=0.3)
    figure.savefig(path, dpi=80)
    plt.close(figure)


if __name__ == "__main__":
    main()
