"""PWLS of torchpcct beside that of svmbir and mbirtorch at equal cost function: time against the
distance to the minimum.

    pip install -e ".[peers]" svmbir && python tests/bench/peers_pwls.py [--rounds 3] [--size 128]
    [--out FOLDER] [--python /other/venv/bin/python]

A slice of ellipses in a parallel beam with Poisson noise, minimised as ½ Σ w (y − A x)² + R(x) with
a quadratic prior R of the same weights for all: of the 8 nearest neighbours as svmbir has it, and
of the 4 nearest as mbirtorch has it. (Their edge-preserving priors count the distance of diagonal
neighbours in another way than ours, so no settings make them equal.) The operators A differ by how
each samples a pixel, so each toolkit is compared with its own minimum, reached by many more
iterations; how far the minima lie apart stands beside. All start as they do by default, ours from
0, the others from their own first image. Every toolkit computes in a process of its own, the
processes take turns, and the seconds are those of whole calls: preparation, first image, iterations
(svmbir's matrix, which it keeps on the disk, and compilation are done before).
"""

import argparse
import datetime
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch
from peers import mbirtorch_model
from processes import Process, answers
from projectors import _ellipses, _machine, line_integrals
from results import write_results

from recon.least_squares.pwls import pwls
from recon.least_squares.qggmrf import BoundPrior
from torchpcct import ParallelBeam, Projector, VolumeGrid
from torchpcct.threads import get_num_threads

MU_WATER = 0.02
"""Of the largest ellipse, mm⁻¹."""
HU = MU_WATER / 1000
PHOTONS = 1e5
"""Of an unattenuated reading."""
BLUR = 0.2
"""Line pairs a voxel at which the prior's curvature equals that of the data."""
ITERATIONS = (1, 2, 4, 8, 16, 24, 32, 48, 64)
TARGETS_HU = (30.0, 3.0, 1.0)
"""Distances to the minimum, rms, whose times are in the table; the curve ends at the last."""
MANY = 200
"""Iterations to what counts as the minimum."""
NO_SLICES = 1e-6
"""Weight of the neighbours above and below, which a slice alone does not have: svmbir takes them
for 0."""
NEIGHBOURS = {"svmbir": 26, "mbirtorch": 6}
"""Of the prior, counted in a volume: 8 and 4 in a slice."""


class Problem:
    """One noisy slice.

    Args:
        size: voxels of an edge, of 200 mm in all.
    """

    def __init__(self, size: int) -> None:
        self.grid = VolumeGrid((size, size), 200.0 / size)
        views = size * 3 // 2
        self.beam = ParallelBeam(np.arange(views) * np.pi / views, size * 3 // 2, 200.0 / size)
        bodies = _ellipses(self.grid)
        exact = MU_WATER * line_integrals(self.beam, bodies, None, 4)
        expected = PHOTONS * np.exp(-exact)
        counts = np.random.default_rng(0).poisson(expected)
        self.y = -np.log(np.maximum(counts, 0.5) / PHOTONS)
        self.w = expected

    def prior(self, neighbours: int) -> BoundPrior:
        """Ours, quadratic: ½ λ V Σ ω (Δ / (d · HU))² over pairs at the distance d."""
        # Of uniform weights the data know the rays' density over the frequency f, in 1 / (HU² mm²):
        # λ (2 π f)² is as large at the frequency of the blur.
        information = float(self.w.mean()) * self.beam.views / self.beam.column_pitch * HU**2
        frequency = BLUR / self.grid.spacing[-1]
        lam = information / frequency / (2 * np.pi * frequency) ** 2
        return BoundPrior(lam, np.inf, 2.0, 1.0, neighbours, self.grid.spacing, HU)

    def sigma_x(self, neighbours: int, sides: float) -> float:
        """The scale σ of ``b Δ² / (4 σ²)``, the peers' quadratic potential, that makes their energy
        ours.

        Args:
            neighbours: see :meth:`prior`.
            sides: Σ b of all neighbours in their units, where that of a neighbour at the side is 1.
        """
        prior = self.prior(neighbours)
        (d, weight) = next((d, w) for step, d, w in prior.offsets if sum(map(abs, step)) == 1)
        ours = 0.5 * prior.lam * np.prod(self.grid.spacing) * weight / (d * HU) ** 2
        return float(np.sqrt(1 / sides / (4 * ours)))


Minimiser = Callable[[int], np.ndarray]


def of_torchpcct(p: Problem, neighbours: int) -> Minimiser:
    """Ours; an iteration is an exact projection pair."""
    A = Projector(p.beam, p.grid)
    y, w = (torch.as_tensor(v, dtype=torch.float32) for v in (p.y, p.w))
    prior = p.prior(neighbours)

    def minimise(iterations: int) -> np.ndarray:
        found = pwls(A, y, w, prior, mu_per_hu=HU, tolerance=1e-4, max_exact=iterations)
        return found.volume.numpy()

    return minimise


def of_svmbir(p: Problem, neighbours: int) -> Minimiser:
    """svmbir's ICD in C; it starts on coarser grids."""
    import svmbir

    sigma = p.sigma_x(neighbours, 4 + 4 * np.sqrt(0.5))
    options = {"delta_channel": p.beam.column_pitch, "delta_pixel": p.grid.spacing[-1]}
    options |= {"roi_radius": 2 * max(p.grid.extent), "positivity": False, "verbose": 0}
    rows, columns = p.grid.shape

    def minimise(iterations: int) -> np.ndarray:
        return svmbir.recon(
            p.y[:, None],
            p.beam.angles,
            weights=p.w[:, None],
            num_rows=rows,
            num_cols=columns,
            sigma_y=1.0,
            sigma_x=sigma,
            p=2.0,
            q=2.0,
            b_interslice=NO_SLICES,
            stop_threshold=0.0,
            max_iterations=iterations,
            num_threads=get_num_threads(),
            **options,
        )[0]

    return minimise


def of_mbirtorch(p: Problem, neighbours: int) -> Minimiser:
    """mbirtorch's vectorised coordinate descent; it starts from FBP."""
    model = mbirtorch_model(p.beam, p.grid)
    model.set_params(
        auto_regularize_flag=False,
        sigma_y=1.0,
        sigma_x=p.sigma_x(neighbours, 4.0),
        p=2.0,
        q=2.0,
        qggmrf_nbr_wts=[1.0, 1.0, NO_SLICES],
    )
    y, w = (v[:, None].astype(np.float32) for v in (p.y, p.w))

    def minimise(iterations: int) -> np.ndarray:
        volume, _ = model.recon(
            y,
            weights=w,
            max_iterations=iterations,
            stop_threshold_change_pct=0.0,
            logfile_path=None,
            print_logs=False,
            rng=np.random.default_rng(0),
        )
        return np.asarray(volume)[:, :, 0].T

    return minimise


MINIMISERS = {"svmbir": of_svmbir, "mbirtorch": of_mbirtorch, "torchpcct": of_torchpcct}


def curve(minimise: Minimiser, minimum: Path) -> Iterator[tuple[int, float, float, float]]:
    """Iterations, seconds (wall, processor) and rms distance to the minimum in HU; the minimum is
    kept in a file."""
    if not minimum.exists():
        np.save(minimum, minimise(MANY))
    reference = np.load(minimum)
    minimise(1)  # compiles and loads
    for k in ITERATIONS:
        begin = time.perf_counter(), time.process_time()
        volume = minimise(k)
        seconds = time.perf_counter() - begin[0], time.process_time() - begin[1]
        distance = float(np.sqrt(np.mean((volume - reference) ** 2))) / HU
        yield k, *seconds, distance
        if distance < TARGETS_HU[-1]:
            return


def reached(rounds: list[list[list[float]]]) -> list[str]:
    """The cells of a toolkit: iterations, seconds and processor seconds to each of the targets."""
    curve = [np.median(points, axis=0) for points in zip(*rounds, strict=True)]
    cells = []
    for target in TARGETS_HU:
        first = next((p for p in curve if p[3] < target), None)
        if first is None:
            cells.append(f"not in {curve[-1][0]:.0f}, {curve[-1][1]:.2f} s")
        else:
            cells.append(f"{first[0]:.0f}, {first[1]:.2f} s ({first[2]:.2f} s)")
    return cells


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    parser.add_argument("--python", default=sys.executable)
    parser.add_argument("--worker", choices=list(MINIMISERS), help=argparse.SUPPRESS)
    parser.add_argument("--neighbours", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    if options.worker:
        answer = answers()
        minimise = MINIMISERS[options.worker](Problem(options.size), options.neighbours)
        minimum = options.out / f"{options.worker}_{options.neighbours}_{options.size}.npy"
        answer(["curve"])
        for _ in sys.stdin:
            answer(list(curve(minimise, minimum)))
        return
    runs: dict[tuple[str, int], list[list[list[float]]]] = {}
    for _ in range(options.rounds):
        for peer, neighbours in NEIGHBOURS.items():
            for name in ("torchpcct", peer):
                call = [__file__, "--worker", name, "--size", options.size]
                call += ["--neighbours", neighbours, "--out", options.out]
                process = Process(options.python, *call)
                found = process.ask("curve") if process.operations else None
                process.close()
                if found is None:
                    raise SystemExit(f"{name} ended: install it (see above), or read its words")
                runs.setdefault((name, neighbours), []).append(found)
    minima = {
        (name, n): np.load(options.out / f"{name}_{n}_{options.size}.npy") for name, n in runs
    }
    columns = ["neighbours", "toolkit", *(f"to {t:g} HU" for t in TARGETS_HU)]
    columns.append("its minimum from ours, HU")
    lines = [f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    for (name, n), rounds in runs.items():
        apart = float(np.sqrt(np.mean((minima[name, n] - minima["torchpcct", n]) ** 2))) / HU
        beside = "–" if name == "torchpcct" else f"{apart:.2f}"
        cells = ["8" if n == 26 else "4", name, *reached(rounds), beside]
        lines.append(f"| {' | '.join(cells)} |")
    now = datetime.datetime.now(datetime.UTC)
    text = [
        "# PWLS at equal cost function",
        "",
        f"`python tests/bench/peers_pwls.py --size {options.size} --rounds {options.rounds}`: "
        f"{options.size}² voxels, {options.size * 3 // 2} views, photons {PHOTONS:g}, quadratic "
        f"prior. Iterations, seconds of the whole call and, in brackets, of the processor, to an "
        f"rms distance from the toolkit's own minimum. {_machine()}, {now:%Y-%m-%d %H:%M} UTC, "
        f"load {os.getloadavg()[0]:.1f}.",
        "",
        *lines,
    ]
    kept = [{"toolkit": name, "neighbours": n, "rounds": r} for (name, n), r in runs.items()]
    report = "\n".join(text) + "\n"
    write_results(options.out, "peers_pwls", kept, report)
    print(report)


if __name__ == "__main__":
    main()
