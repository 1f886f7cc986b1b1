"""Time against error of the projectors, ours and peers, interleaved in one run.

    python tests/bench/projectors.py [--repeats 5] [--out tests/bench/results] [--xcist path/to/libcatsim.so]

Peers take part where they are installed: ASTRA (``pip install astra-toolbox``) and the distance-driven C projector of
XCIST, from the library that ships in ``gecatsim`` or the one named by ``--xcist``. Both use one core. Errors are
relative L2 against exact, cell-averaged line integrals. The medians
depend on what else the machine does; the ratios within a run less.
"""

from __future__ import annotations

import argparse
import ctypes
import importlib.util
import json
import math
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchpcct.geometry import ConeBeam, FanBeam, ParallelBeam, VolumeGrid, full_turn
from torchpcct.projector import Projector
from torchpcct.projector.analytic import Ellipsoid, Gaussian, line_integrals, rasterize
from torchpcct.window import shadow

Pass = Callable[[], Any]


class Case:
    """One scan, its test images and their exact line integrals."""

    def __init__(self, name, geometry, grid, window=None, bodies=None):
        self.name, self.geometry, self.grid, self.window = name, geometry, grid, window
        self.gaussians = bodies or _gaussians(grid)
        self.images = {"gaussians": rasterize(grid, self.gaussians)}
        # Smooth bodies: 2 × 2 rays per cell are exact to 1e-5.
        self.exact = {"gaussians": line_integrals(geometry, self.gaussians, window, 2)}
        if grid.ndim == 2:
            ellipses = _ellipses(grid)
            self.images["ellipses"] = rasterize(grid, ellipses, 8)
            self.exact["ellipses"] = line_integrals(geometry, ellipses, window, 4)

    def errors(self, forward: Callable[[np.ndarray], np.ndarray]) -> dict[str, float]:
        return {
            name: float(np.linalg.norm(forward(image) - self.exact[name]) / np.linalg.norm(self.exact[name]))
            for name, image in self.images.items()
        }


def _spread(grid: VolumeGrid, seed: int, count: int) -> list[tuple[Any, Any, float, float]]:
    rng = np.random.default_rng(seed)
    half = min(grid.extent) / 2
    bodies = []
    for _ in range(count):
        radius, turn = 0.55 * half * math.sqrt(rng.random()), rng.uniform(0, 2 * math.pi)
        offset = [radius * math.sin(turn), radius * math.cos(turn)]
        offset = ([rng.uniform(-0.3, 0.3) * half] if grid.ndim == 3 else []) + offset
        radii = tuple(half * rng.uniform(0.05, 0.09, grid.ndim))
        center = tuple(c + o for c, o in zip(grid.center, offset, strict=True))
        bodies.append((center, radii, rng.uniform(0, math.pi), rng.uniform(0.5, 1.5)))
    return bodies


def _gaussians(grid: VolumeGrid) -> list[Any]:
    return [Gaussian(*body) for body in _spread(grid, 1, 8)]


def _ellipses(grid: VolumeGrid) -> list[Any]:
    half = min(grid.extent) / 2
    big = Ellipsoid(tuple(grid.center), (0.9 * half, 0.8 * half), 0.4, 1.0)
    return [big, *(Ellipsoid(c, tuple(2 * r for r in radii), a, v) for c, radii, a, v in _spread(grid, 2, 6))]


def cases() -> list[Callable[[], Case]]:
    """The scans of the table."""
    fan = FanBeam(full_turn(984), 626.0, 1098.0, 888, 0.6)
    paper = ConeBeam(full_turn(1968), 626.0, 1098.0, 1500, 40, (0.5, 0.35), detector="curved")
    inset = VolumeGrid((128, 128), 0.1, (-30.38, -29.63))
    plaque = [VolumeGrid((n, m, m), s, (0.0, -30.38, -29.63)) for n, m, s in ((56, 45, 0.2), (113, 90, 0.1))]
    soft = [Gaussian((0.5, -30.0, -30.0), (1.2, 1.0, 0.9), 0.4), Gaussian((-1.5, -31.5, -28.5), 0.8, value=-0.5)]
    plane = paper.central_fan
    return [
        lambda: Case("fan 512² × 984 × 888", fan, VolumeGrid((512, 512), 250 / 512)),
        lambda: Case("fan, shifted grid", fan, VolumeGrid((512, 512), 250 / 512, (1.0, 2.0))),
        lambda: Case(
            "parallel 512² × 720 × 729",
            ParallelBeam(np.arange(720) * math.pi / 720, 729, 1.0),
            VolumeGrid((512, 512), 1.0),
        ),
        lambda: Case("inset 128², 1968 × 1500", plane, inset, shadow(plane, inset)),
        lambda: Case(
            "cone 128³, 360 × 192²", ConeBeam(full_turn(360), 600.0, 1200.0, 192, 192, 1.5), VolumeGrid((128,) * 3, 1.0)
        ),
        lambda: Case("inset 45² × 56, 0.2 mm", paper, plaque[0], shadow(paper, plaque[0]), soft),
        lambda: Case("inset 90² × 113, 0.1 mm", paper, plaque[1], shadow(paper, plaque[1]), soft),
    ]


def ours(case: Case, dtype: torch.dtype) -> tuple[Pass, Pass, Callable[[np.ndarray], np.ndarray]]:
    A = Projector(case.geometry, case.grid, case.window)
    x = torch.as_tensor(case.images["gaussians"], dtype=dtype)
    y = A(x)
    return (lambda: A(x)), (lambda: A.T(y)), lambda image: A(torch.as_tensor(image, dtype=dtype)).double().numpy()


def astra_line(case: Case) -> tuple[Pass, Pass, Callable[[np.ndarray], np.ndarray]] | None:
    """ASTRA's line projector on the whole detector, cropped to the window afterwards."""
    if importlib.util.find_spec("astra") is None or case.grid.ndim == 3:
        return None
    import astra

    g, grid = case.geometry, case.grid
    if getattr(g, "detector", "flat") == "curved":
        return None
    (ny, nx), (cy, cx), (ey, ex) = grid.shape, grid.center, grid.extent
    volume = astra.create_vol_geom(ny, nx, cx - ex / 2, cx + ex / 2, cy - ey / 2, cy + ey / 2)
    c, s = np.cos(g.angles), np.sin(g.angles)
    if isinstance(g, ParallelBeam):
        vectors = np.stack([-c, -s, g.offset * -s, g.offset * c, g.pitch * -s, g.pitch * c], axis=1)
        projection = astra.create_proj_geom("parallel_vec", g.columns, vectors)
        projector = astra.create_projector("line", projection, volume)
    else:
        back = g.sdd - g.sod
        vectors = np.stack(
            [g.sod * c, g.sod * s, -back * c - g.offset * s, -back * s + g.offset * c, -g.pitch * s, g.pitch * c],
            axis=1,
        )
        projection = astra.create_proj_geom("fanflat_vec", g.columns, vectors)
        projector = astra.create_projector("line_fanflat", projection, volume)
    image_id, data_id = astra.data2d.create("-vol", volume), astra.data2d.create("-sino", projection)

    def algorithm(kind: str) -> int:
        config = astra.astra_dict(kind)
        config.update({"ProjectorId": projector, "ProjectionDataId": data_id})
        config["VolumeDataId" if kind == "FP" else "ReconstructionDataId"] = image_id
        return astra.algorithm.create(config)

    fp, bp = algorithm("FP"), algorithm("BP")

    def forward(image: np.ndarray) -> np.ndarray:
        astra.data2d.store(image_id, np.ascontiguousarray(image[::-1], dtype=np.float32))
        astra.algorithm.run(fp)
        return astra.data2d.get(data_id).astype(np.float64)

    return (lambda: astra.algorithm.run(fp)), (lambda: astra.algorithm.run(bp)), forward


def xcist(case: Case, path: str | None) -> tuple[Pass, Pass, Callable[[np.ndarray], np.ndarray]] | None:
    """XCIST's 2-D distance-driven fan projector (``DD2FanProj``), whole detector."""
    if path is None or not isinstance(case.geometry, FanBeam) or case.window is not None or any(case.grid.center):
        return None
    library = ctypes.CDLL(path)
    g, grid = case.geometry, case.grid
    pixel, (ny, nx) = grid.spacing[0], grid.shape
    f = ctypes.c_float
    u = g.column_positions
    xds, yds = (np.ascontiguousarray(v / pixel, dtype=np.float32) for v in (u, np.full(u.size, g.sod - g.sdd)))
    angles = np.ascontiguousarray(g.angles, dtype=np.float32)
    data = np.zeros((g.views, g.columns), dtype=np.float32)
    image = np.zeros((ny, nx), dtype=np.float32)

    def pointer(a: np.ndarray) -> Any:
        return a.ctypes.data_as(ctypes.POINTER(f))

    def run(name: str) -> None:
        getattr(library, name)(
            ctypes.c_int(g.columns), f(0.0), f(g.sod / pixel), pointer(xds), pointer(yds), f(0.0), f(0.0),
            pointer(angles), ctypes.c_int(g.views), pointer(data), ctypes.c_int(nx), ctypes.c_int(ny), pointer(image),
        )  # fmt: skip

    def settle() -> tuple[bool, ...]:
        """XCIST's image axes: take the flips that fit the exact answer."""
        best, choice = math.inf, (False, False, False, False)
        reference = case.exact["gaussians"]
        for flips in np.ndindex(2, 2, 2, 2):
            error = np.linalg.norm(apply(case.images["gaussians"], flips) - reference)
            if error < best:
                best, choice = error, flips
        return choice

    def apply(x: np.ndarray, flips: Any) -> np.ndarray:
        x = x.T if flips[0] else x
        x = x[::-1] if flips[1] else x
        x = x[:, ::-1] if flips[2] else x
        image[:] = x
        run("DD2FanProj")
        out = data.astype(np.float64) * pixel
        return out[:, ::-1] if flips[3] else out

    chosen = settle()
    return (lambda: run("DD2FanProj")), (lambda: run("DD2FanBack")), lambda x: apply(x, chosen)


def measure(case: Case, repeats: int, library: str | None) -> list[dict[str, Any]]:
    """One table row per projector; the timed passes are interleaved."""
    found = {
        "torchpcct float32": ours(case, torch.float32),
        "torchpcct float64": ours(case, torch.float64),
        "ASTRA line": astra_line(case),
        "XCIST distance-driven": xcist(case, library),
    }
    present = {name: passes for name, passes in found.items() if passes is not None}
    rows: list[dict[str, Any]] = []
    for name, passes in present.items():
        rows.append({"case": case.name, "projector": name, **case.errors(passes[2])})
    times: dict[tuple[str, int], list[float]] = {}
    for repeat in range(repeats + 1):
        for name, passes in present.items():
            for direction in (0, 1):
                begin = time.perf_counter()
                passes[direction]()
                if repeat:  # the first round warms caches
                    times.setdefault((name, direction), []).append(time.perf_counter() - begin)
    for row in rows:
        for direction, key in ((0, "forward"), (1, "adjoint")):
            values = times[row["projector"], direction]
            row[f"{key} median s"], row[f"{key} min s"] = float(np.median(values)), min(values)
    return rows


def table(rows: list[dict[str, Any]]) -> str:
    lines = [
        "| case | projector | forward s: median (min) | adjoint s | error Gaussians | error ellipses |",
        "|---|---|---|---|---|---|",
    ]
    for r in rows:
        ellipses = f"{r['ellipses']:.2e}" if "ellipses" in r else "–"
        lines.append(
            f"| {r['case']} | {r['projector']} | {r['forward median s']:.3f} ({r['forward min s']:.3f}) | "
            f"{r['adjoint median s']:.3f} ({r['adjoint min s']:.3f}) | {r['gaussians']:.2e} | {ellipses} |"
        )
    return "\n".join(lines)


def picture(rows: list[dict[str, Any]], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    names = list(dict.fromkeys(r["case"] for r in rows))
    figure, axes = plt.subplots(2, math.ceil(len(names) / 2), figsize=(3.6 * math.ceil(len(names) / 2), 6.4))
    ours_marks = {"torchpcct float32": "C0o", "torchpcct float64": "C0s"}
    marks = {**ours_marks, "ASTRA line": "C1^", "XCIST distance-driven": "C3v"}
    for axis, name in zip(axes.flat, names, strict=False):
        for r in rows:
            if r["case"] == name:
                axis.loglog(r["forward min s"], r["gaussians"], marks[r["projector"]], label=r["projector"])
        axis.set_title(name, fontsize=9)
        axis.set_xlabel("forward projection, s (best of run)", fontsize=8)
        axis.set_ylabel("relative L2 error", fontsize=8)
        axis.grid(alpha=0.3, which="both")
    axes.flat[0].legend(fontsize=7)
    for axis in axes.flat[len(names) :]:
        axis.axis("off")
    figure.tight_layout()
    figure.savefig(path, dpi=130)
    plt.close(figure)


def growth(repeats: int) -> dict[str, Any]:
    """Time against size over a decade of pixels: fan beam, views and columns growing with the grid's edge n."""
    sizes, seconds = [162, 256, 362, 512], []
    for n in sizes:
        geometry = FanBeam(full_turn(2 * n - n % 4), 626.0, 1098.0, int(1.75 * n), 0.6 * 512 / n)
        A = Projector(geometry, VolumeGrid((n, n), 250 / n))
        x = torch.rand(n, n)
        A(x)
        best = math.inf
        for _ in range(repeats):
            begin = time.perf_counter()
            A(x)
            best = min(best, time.perf_counter() - begin)
        seconds.append(best)
    exponent = float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])
    return {"edge": sizes, "seconds": seconds, "exponent (3 is n views × n² pixels)": exponent}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    parser.add_argument("--xcist")
    options = parser.parse_args()
    library = options.xcist
    if library is None and (spec := importlib.util.find_spec("gecatsim")) and spec.origin:
        candidate = Path(spec.origin).parent / "lib" / "libcatsim.so"
        library = str(candidate) if candidate.exists() else None
    options.out.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = []
    for make in cases():
        rows += measure(make(), options.repeats, library)
        _write(rows, None, options.out)  # a run cut short keeps what it measured
    print(_write(rows, growth(options.repeats), options.out))


def _write(rows: list[dict[str, Any]], grown: dict[str, Any] | None, out: Path) -> str:
    report = f"{platform.processor() or platform.machine()}, torch {torch.__version__}\n\n{table(rows)}\n"
    if grown is not None:
        report += f"\nTime against size: {grown}\n"
    (out / "projectors.md").write_text(report)
    (out / "projectors.json").write_text(json.dumps({"rows": rows, "growth": grown}, indent=1))
    picture(rows, out / "projectors.png")
    return report


if __name__ == "__main__":
    main()
