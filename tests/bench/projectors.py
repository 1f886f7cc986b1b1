"""Time against error of the projectors, ours and peers, interleaved in one run.

    python tests/bench/projectors.py [--repeats 5] [--out tests/bench/results] [--xcist
    path/to/libcatsim.so]

Peers take part where they are installed: ASTRA (``pip install astra-toolbox``) and the
distance-driven C projector of XCIST, from the library that ships in ``gecatsim`` or the one named
by ``--xcist``. Both use one core. Errors are relative L2 against exact, cell-averaged line
integrals. The medians depend on what else the machine does; the ratios within a run less: the load
average stands above the table.
"""

import argparse
import ctypes
import datetime
import importlib.util
import json
import math
import os
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from torchpcct.detector_window import footprint
from torchpcct.geometry import ConeBeam, FanBeam, ParallelBeam, VolumeGrid, full_turn
from torchpcct.projector import Projector
from torchpcct.threads import get_num_threads, set_num_threads
from torchpcct.vector_geometry import VectorGeometry

sys.path.insert(0, str(Path(__file__).parent.parent / "helpers"))  # where pytest finds them, too
from analytic import Ellipsoid, Gaussian, line_integrals, rasterize

Pass = Callable[[], Any]


class Peer(NamedTuple):
    """One projector on one case: the passes to time, a forward projection to check, and which views
    it takes.

    ``adjoint`` is None where the library has none. Views ``0, every, 2 every, …`` are taken, the
    times multiplied.
    """

    forward: Pass
    adjoint: Pass | None
    check: Callable[[np.ndarray], np.ndarray]
    every: int = 1


class Case:
    """One scan, its test images and their exact line integrals."""

    def __init__(self, name, geometry, grid, window=None, bodies=None):
        self.name, self.geometry, self.grid, self.window = name, geometry, grid, window
        self.gaussians = bodies or _gaussians(grid)
        self.images = {"gaussians": rasterize(grid, self.gaussians)}
        # Two rays across a cell are not enough where a body is only a few cells wide, as in the 2-D
        # inset.
        self.exact = {
            "gaussians": line_integrals(
                geometry, self.gaussians, window, 5 if grid.ndim == 2 else 2
            )
        }
        if grid.ndim == 2:
            ellipses = _ellipses(grid)
            self.images["ellipses"] = rasterize(grid, ellipses, 8)
            self.exact["ellipses"] = line_integrals(geometry, ellipses, window, 4)

    def errors(self, peer: Peer) -> dict[str, float]:
        """Relative L2 error of the forward projection per image."""
        errors = {}
        for name, image in self.images.items():
            exact = self.exact[name][:: peer.every]
            errors[name] = float(np.linalg.norm(peer.check(image) - exact) / np.linalg.norm(exact))
        return errors


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
    return [
        big,
        *(
            Ellipsoid(c, tuple(2 * r for r in radii), a, v)
            for c, radii, a, v in _spread(grid, 2, 6)
        ),
    ]


def cases() -> list[Callable[[], Case]]:
    """The scans of the table."""
    fan = FanBeam(full_turn(984), 626.0, 1098.0, 888, 0.6)
    paper = ConeBeam(full_turn(1968), 626.0, 1098.0, 1500, 40, (0.5, 0.35), detector="curved")
    inset = VolumeGrid((128, 128), 0.1, (-30.38, -29.63))
    plaque = [
        VolumeGrid((n, m, m), s, (0.0, -30.38, -29.63))
        for n, m, s in ((56, 45, 0.2), (113, 90, 0.1))
    ]
    soft = [
        Gaussian((0.5, -30.0, -30.0), (1.2, 1.0, 0.9), 0.4),
        Gaussian((-1.5, -31.5, -28.5), 0.8, value=-0.5),
    ]
    flat = FanBeam(full_turn(1968), 626.0, 1098.0, 1500, 0.35)  # ASTRA knows no curved detector
    return [
        lambda: Case("fan 512² × 984 × 888", fan, VolumeGrid((512, 512), 250 / 512)),
        lambda: Case("fan, shifted grid", fan, VolumeGrid((512, 512), 250 / 512, (1.0, 2.0))),
        lambda: Case(
            "parallel 512² × 720 × 729",
            ParallelBeam(np.arange(720) * math.pi / 720, 729, 1.0),
            VolumeGrid((512, 512), 1.0),
        ),
        lambda: Case("inset 128², 1968 × 1500", flat, inset, footprint(flat, inset)),
        lambda: Case("inset 45² × 56, 0.2 mm", paper, plaque[0], footprint(paper, plaque[0]), soft),
        lambda: Case(
            "inset 90² × 113, 0.1 mm", paper, plaque[1], footprint(paper, plaque[1]), soft
        ),
        lambda: Case(  # fewer bodies: the exact integrals of 13 million readings take a minute
            "cone 128³, 360 × 192²",
            ConeBeam(full_turn(360), 600.0, 1200.0, 192, 192, 1.5),
            VolumeGrid((128,) * 3, 1.0),
            bodies=_gaussians(VolumeGrid((128,) * 3, 1.0))[:3],
        ),
    ]


def ours(case: Case, dtype: torch.dtype, threads: int) -> Peer:
    A = Projector(case.geometry, case.grid, case.window)
    x = torch.as_tensor(case.images["gaussians"], dtype=dtype)
    y = torch.rand(A.range_shape, dtype=dtype)

    def on_threads(work: Pass) -> Pass:
        def run() -> Any:
            set_num_threads(threads)
            return work()

        return run

    return Peer(
        on_threads(lambda: A(x)),
        on_threads(lambda: A.T(y)),
        lambda image: A(torch.as_tensor(image, dtype=dtype)).double().numpy(),
    )


def astra_line(case: Case) -> Peer | None:
    """ASTRA's line projector on the whole detector, cropped to the window afterwards."""
    if importlib.util.find_spec("astra") is None or case.grid.ndim == 3:
        return None
    import astra

    g, grid = case.geometry, case.grid
    if getattr(g, "detector", "flat") == "curved":
        return None
    (ny, nx), (cy, cx), (ey, ex) = grid.shape, grid.center, grid.extent
    volume = astra.create_vol_geom(ny, nx, cx - ex / 2, cx + ex / 2, cy - ey / 2, cy + ey / 2)
    vectors = VectorGeometry.of(g).vectors
    kind, line = (
        ("parallel_vec", "line") if isinstance(g, ParallelBeam) else ("fanflat_vec", "line_fanflat")
    )
    projection = astra.create_proj_geom(kind, g.columns, vectors)
    projector = astra.create_projector(line, projection, volume)
    image_id, data_id = (
        astra.data2d.create("-vol", volume),
        astra.data2d.create("-sino", projection),
    )

    def algorithm(name: str) -> int:
        config = astra.astra_dict(name)
        config.update({"ProjectorId": projector, "ProjectionDataId": data_id})
        config["VolumeDataId" if name == "FP" else "ReconstructionDataId"] = image_id
        return astra.algorithm.create(config)

    fp, bp = algorithm("FP"), algorithm("BP")

    def forward(image: np.ndarray) -> np.ndarray:
        astra.data2d.store(image_id, np.ascontiguousarray(image[::-1], dtype=np.float32))
        astra.algorithm.run(fp)
        data = astra.data2d.get(data_id).astype(np.float64)
        return (
            data
            if case.window is None
            else np.take_along_axis(data, case.window.column_indices, axis=1)
        )

    return Peer(lambda: astra.algorithm.run(fp), lambda: astra.algorithm.run(bp), forward)


def xcist(case: Case, path: str | None) -> Peer | None:
    """XCIST's distance-driven projectors on the whole detector: ``DD2FanProj``, ``DD2ParProj`` or
    ``DD3Proj``.

    Lengths are in pixels. XCIST's axes and signs are not documented: the flips that fit the exact
    answer are taken, found on a few views. On 3-D insets every twelfth view is projected and the
    time multiplied: XCIST has no window, and the whole detector of all views would take minutes. On
    the far off-centre 2-D inset its error is larger than the pixels explain (3e-2 on small
    Gaussians); the cause was not found, so quote that row with care.
    """
    if path is None:
        return None
    library = ctypes.CDLL(path)
    g, grid = case.geometry, case.grid
    pixel, solid = grid.spacing[-1], grid.ndim == 3
    every = 12 if solid and case.window is not None else 1
    angles = np.ascontiguousarray(g.angles[::every], dtype=np.float32)
    u = g.column_positions
    sod = 0.0 if isinstance(g, ParallelBeam) else g.sod
    back = 1.0 if isinstance(g, ParallelBeam) else g.sdd
    if getattr(g, "detector", "flat") == "curved":
        xds, yds = back * np.sin(u / back), sod - back * np.cos(u / back)
    else:
        xds, yds = u, np.full(u.size, sod - back)
    xds, yds = (np.ascontiguousarray(v / pixel, dtype=np.float32) for v in (xds, yds))
    rows = slice(0, 1)
    if solid:
        rows = (
            slice(case.window.first_row, case.window.first_row + case.window.rows)
            if case.window
            else slice(None)
        )
        zds = np.ascontiguousarray(g.row_positions[rows] / pixel, dtype=np.float32)
        shape: tuple[int, ...] = (angles.size, g.columns, zds.size)
        image = np.zeros((*grid.shape[1:], grid.shape[0]), dtype=np.float32)
        heights = np.zeros(angles.size, dtype=np.float32)
    else:
        shape, image = (angles.size, g.columns), np.zeros(grid.shape, dtype=np.float32)
    data = np.zeros(shape, dtype=np.float32)
    shift = np.array(grid.center[-2:]) / pixel

    def pointer(a: np.ndarray) -> Any:
        return a.ctypes.data_as(ctypes.POINTER(ctypes.c_float))

    def run(signs: tuple[int, int, int], back: bool = False, views: np.ndarray = angles) -> None:
        i, f = ctypes.c_int, ctypes.c_float
        swap, sx, sy = signs
        dx, dy = (
            float(s) * float(v)
            for s, v in zip((sx, sy), shift if swap else shift[::-1], strict=True)
        )
        n = i(views.size)
        if solid:
            library.DD3Proj(
                f(0.0),
                f(sod / pixel),
                f(0.0),
                i(g.columns),
                i(zds.size),
                pointer(xds),
                pointer(yds),
                pointer(zds),
                f(1.0),
                f(dx),
                f(dy),
                f(grid.center[0] / pixel),
                pointer(views),
                pointer(heights),
                n,
                pointer(data),
                i(grid.shape[2]),
                i(grid.shape[1]),
                i(grid.shape[0]),
                pointer(image),
            )
            return
        source = () if isinstance(g, ParallelBeam) else (f(dx), f(sod / pixel + dy))
        x, y = (np.ascontiguousarray(v + np.float32(d)) for v, d in ((xds, dx), (yds, dy)))
        name = (
            "DD2ParProj" if isinstance(g, ParallelBeam) else "DD2FanBack" if back else "DD2FanProj"
        )
        getattr(library, name)(
            i(g.columns),
            *source,
            pointer(x),
            pointer(y),
            f(dx),
            f(dy),
            pointer(views),
            n,
            pointer(data),
            i(grid.shape[1]),
            i(grid.shape[0]),
            pointer(image),
        )

    def apply(x: np.ndarray, flips: Any, views: np.ndarray) -> np.ndarray:
        planes = x.transpose(1, 2, 0) if solid else x
        planes = planes.swapaxes(0, 1) if flips[0] else planes
        planes = planes[::-1] if flips[1] else planes
        image[:] = planes[:, ::-1] if flips[2] else planes
        run((flips[0], 2 * flips[4] - 1, 2 * flips[5] - 1), views=views)
        out = data[: views.size].astype(np.float64) * pixel
        if solid:
            out = out.swapaxes(1, 2)
        return out[..., ::-1] if flips[3] else out

    def crop(full: np.ndarray, views: np.ndarray) -> np.ndarray:
        if case.window is None:
            return full
        columns = case.window.column_indices[views]
        return np.stack([view[..., c] for view, c in zip(full, columns, strict=True)])

    few = np.arange(angles.size)[3 :: max(1, angles.size // 9)]
    indices = np.arange(g.views)[::every]
    best, chosen = math.inf, (0,) * 6
    for flips in np.ndindex(2, 2, 2, 2, *((2, 2) if shift.any() else (1, 1))):
        found = crop(
            apply(case.images["gaussians"], flips, np.ascontiguousarray(angles[few])), indices[few]
        )
        error = float(np.linalg.norm(found - case.exact["gaussians"][indices[few]]))
        if error < best:
            best, chosen = error, flips
    signs = (chosen[0], 2 * chosen[4] - 1, 2 * chosen[5] - 1)
    return Peer(
        lambda: run(signs),
        (lambda: run(signs, back=True)) if isinstance(g, FanBeam) else None,
        lambda x: crop(apply(x, chosen, angles), indices),
        every,
    )


def measure(case: Case, repeats: int, library: str | None) -> list[dict[str, Any]]:
    """One table row per projector; the timed passes are interleaved."""
    cores = get_num_threads()
    found = {
        f"torchpcct float32, {cores} threads": ours(case, torch.float32, cores),
        "torchpcct float32, 1 thread": ours(case, torch.float32, 1),
        f"torchpcct float64, {cores} threads": ours(case, torch.float64, cores),
        "ASTRA line": astra_line(case),
        "XCIST distance-driven": xcist(case, library),
    }
    present = {name: peer for name, peer in found.items() if peer is not None}
    rows: list[dict[str, Any]] = []
    for name, peer in present.items():
        rows.append(
            {"case": case.name, "projector": name, "every": peer.every, **case.errors(peer)}
        )
    times: dict[tuple[str, int], list[float]] = {}
    for repeat in range(repeats + 1):
        for name, peer in present.items():
            for direction, work in enumerate((peer.forward, peer.adjoint)):
                if work is None:
                    continue
                begin = time.perf_counter()
                work()
                if repeat:  # the first round warms caches
                    times.setdefault((name, direction), []).append(
                        (time.perf_counter() - begin) * peer.every
                    )
    for row in rows:
        for direction, key in ((0, "forward"), (1, "adjoint")):
            values = times.get((row["projector"], direction), [math.nan])
            row[f"{key} median s"], row[f"{key} min s"] = float(np.median(values)), min(values)
    return rows


def table(rows: list[dict[str, Any]]) -> str:
    lines = [
        "| case | projector | forward s: median (min) | adjoint s | error Gaussians | error "
        "ellipses |",
        "|---|---|---|---|---|---|",
    ]
    for r in rows:
        ellipses = f"{r['ellipses']:.2e}" if "ellipses" in r else "–"
        forward, adjoint = (
            "–"
            if math.isnan(r[f"{key} median s"])
            else f"{r[f'{key} median s']:.3f} ({r[f'{key} min s']:.3f})"
            for key in ("forward", "adjoint")
        )
        note = f" (one view in {r['every']}, × {r['every']})" if r["every"] > 1 else ""
        lines.append(
            f"| {r['case']} | {r['projector']}{note} | {forward} | {adjoint} | "
            f"{r['gaussians']:.2e} | {ellipses} |"
        )
    return "\n".join(lines)


def picture(rows: list[dict[str, Any]], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

    names = list(dict.fromkeys(r["case"] for r in rows))
    figure, axes = plt.subplots(
        2, math.ceil(len(names) / 2), figsize=(3.6 * math.ceil(len(names) / 2), 6.4)
    )
    marks = ["C0o", "C0<", "C0s", "C1^", "C3v"]
    style = dict(zip(dict.fromkeys(r["projector"] for r in rows), marks, strict=False))
    for axis, name in zip(axes.flat, names, strict=False):
        for r in rows:
            if r["case"] == name:
                axis.loglog(
                    r["forward median s"],
                    r["gaussians"],
                    style[r["projector"]],
                    label=r["projector"],
                )
        axis.set_title(name, fontsize=9)
        axis.set_xlabel("forward projection, s (median)", fontsize=8)
        axis.set_ylabel("relative L2 error", fontsize=8)
        for scale in (axis.xaxis, axis.yaxis):
            scale.set_major_locator(LogLocator(subs=(1, 2, 5)))
            scale.set_major_formatter(FormatStrFormatter("%.0e" if scale is axis.yaxis else "%g"))
            scale.set_minor_formatter(NullFormatter())
        axis.margins(0.2, 0.2)
        errors = [r["gaussians"] for r in rows if r["case"] == name]
        axis.set_ylim(min(errors) / 2, max(errors) * 2)  # equal errors stay equal marks
        axis.grid(alpha=0.3, which="both")
    axes.flat[0].legend(fontsize=7)
    for axis in axes.flat[len(names) :]:
        axis.axis("off")
    figure.tight_layout()
    figure.savefig(path, dpi=130)
    plt.close(figure)


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
        # a run cut short keeps what it measured
        print(_write(rows, options.out).splitlines()[-1], flush=True)


def _machine() -> str:
    """Processor and number of cores."""
    info = Path("/proc/cpuinfo")
    names = (
        [x.split(":")[1].strip() for x in info.read_text().splitlines() if "model name" in x]
        if info.exists()
        else []
    )
    return f"{names[0] if names else platform.machine()}, {os.cpu_count()} cores"


def _write(rows: list[dict[str, Any]], out: Path) -> str:
    now = datetime.datetime.now(datetime.UTC)
    report = (
        f"{_machine()}, torch {torch.__version__}, {now:%Y-%m-%d %H:%M} UTC, load "
        f"{os.getloadavg()[0]:.1f} at the end"
    )
    report += f"\n\n{table(rows)}\n"
    (out / "projectors.md").write_text(report)
    (out / "projectors.json").write_text(json.dumps(rows, indent=1))
    picture(rows, out / "projectors.png")
    return report


if __name__ == "__main__":
    main()
