"""Operations of torchpcct beside those of peers: one process a toolkit, calls interleaved.

    pip install -e ".[peers]" && python tests/bench/peers.py [--rounds 7] [--small] [--out FOLDER]
    [--python /other/venv/bin/python] [--toolkits torchpcct ASTRA] [--cases parallel fan cone]

Every toolkit computes in a process of its own, so that none disturbs the threads or the memory of
another; the processes take turns, one call each, so that all meet the same load of the machine. The
first call (which compiles, loads and allocates) stands beside the steady state. Errors are relative
L2 against exact, cell-averaged integrals of the same objects, and of FBP against the pixels of
smooth ones. A toolkit takes part where it is installed, in the operations that it has.
"""

import argparse
import datetime
import importlib.util
import json
import os
import pickle
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parent))
from processes import Process, answers
from projectors import Case, _gaussians, _machine, astra_line, ours, xcist
from results import write_results

from recon import fbp
from torchpcct.geometry import ConeBeam, FanBeam, ParallelBeam, VolumeGrid, full_turn
from torchpcct.threads import get_num_threads
from torchpcct.vector_geometry import VectorGeometry


class Toolkit(NamedTuple):
    """What one toolkit does on one case: operations to time, and what some of them give.

    Attributes:
        operations: by name, called without arguments.
        projected: forward projection of an image; None: there is none.
        reconstructed: FBP of the exact line integrals; None: there is none.
        every: views 0, every, 2 every, … are taken, the times multiplied.
    """

    operations: dict[str, Callable[[], Any]]
    projected: Callable[[np.ndarray], np.ndarray] | None = None
    reconstructed: Callable[[], np.ndarray] | None = None
    every: int = 1


CASES = ("parallel", "fan", "cone")
"""Beams of :func:`bench_cases`, in its order."""


def bench_cases(small: bool) -> list[Callable[[], Case]]:
    """A parallel, a fan and a cone beam, as large as asked for."""
    n = 128 if small else 512
    fan = FanBeam(full_turn(984 * n // 512), 626.0, 1098.0, 888 * n // 512, 0.6 * 512 / n)
    m = 32 if small else 128
    cone = ConeBeam(full_turn(360 * m // 128), 600.0, 1200.0, 3 * m // 2, 3 * m // 2, 192.0 / m)
    volume = VolumeGrid((m,) * 3, 128.0 / m)
    parallel = ParallelBeam(
        np.arange(720 * n // 512) * np.pi / (720 * n // 512), 729 * n // 512, 512.0 / n
    )
    return [
        lambda: Case(f"parallel {n}²", parallel, VolumeGrid((n, n), 512.0 / n)),
        lambda: Case(f"fan {n}²", fan, VolumeGrid((n, n), 250 / n)),
        lambda: Case(f"cone {m}³", cone, volume, bodies=_gaussians(volume)[:3]),
    ]


def of_torchpcct(case: Case) -> Toolkit:
    """Ours, in float32 on all threads."""
    mine = ours(case, torch.float32, get_num_threads())
    lines = torch.as_tensor(case.exact["gaussians"], dtype=torch.float32)
    assert mine.adjoint is not None

    def reconstruct() -> np.ndarray:
        return fbp(lines, case.geometry, case.grid, "ram-lak").numpy()

    operations = {"forward": mine.forward, "back": mine.adjoint, "FBP": reconstruct}
    return Toolkit(operations, mine.check, reconstruct)


def of_astra(case: Case) -> Toolkit | None:
    """ASTRA's line projector on the CPU, and FBP with it."""
    peer = astra_line(case)
    if peer is None:
        return None
    import astra

    assert peer.adjoint is not None
    g, grid = case.geometry, case.grid
    (ny, nx), (cy, cx), (ey, ex) = grid.shape, grid.center, grid.extent
    volume = astra.create_vol_geom(ny, nx, cx - ex / 2, cx + ex / 2, cy - ey / 2, cy + ey / 2)
    operations = {"forward": peer.forward, "back": peer.adjoint}
    if not isinstance(g, ParallelBeam):  # its FBP on the CPU takes no other rays
        return Toolkit(operations, peer.check)
    # Its columns grow along (cos, sin) of the angle, ours along (−sin, cos).
    turned = g.angles + np.pi / 2
    projection = astra.create_proj_geom("parallel", g.column_pitch, g.columns, turned)
    projector = astra.create_projector("line", projection, volume)
    lines = astra.data2d.create("-sino", projection, case.exact["gaussians"].astype(np.float32))
    image = astra.data2d.create("-vol", volume)
    config = astra.astra_dict("FBP")
    config.update({"ProjectorId": projector, "ProjectionDataId": lines})
    config["ReconstructionDataId"] = image
    algorithm = astra.algorithm.create(config)

    def reconstruct() -> np.ndarray:
        astra.algorithm.run(algorithm)
        return np.asarray(astra.data2d.get(image))[::-1]

    return Toolkit({**operations, "FBP": reconstruct}, peer.check, reconstruct)


def of_xcist(case: Case) -> Toolkit | None:
    """XCIST's distance-driven C projectors."""
    spec = importlib.util.find_spec("gecatsim")
    if spec is None or spec.origin is None:
        return None
    library = Path(spec.origin).parent / "lib" / "libcatsim.so"
    peer = xcist(case, str(library)) if library.exists() else None
    if peer is None:
        return None
    operations = {"forward": peer.forward}
    if peer.adjoint is not None:
        operations["back"] = peer.adjoint
    return Toolkit(operations, peer.check, every=peer.every)


def of_rtk(case: Case) -> Toolkit | None:
    """RTK's Joseph projectors and FDK on the CPU."""
    if importlib.util.find_spec("itk") is None or case.grid.ndim == 2:
        return None
    import itk

    try:
        rtk = itk.RTK
    except AttributeError:
        return None
    g, grid = case.geometry, case.grid
    turn = rtk.ThreeDCircularProjectionGeometry.New()
    for angle in np.degrees(g.angles):
        turn.AddProjection(g.sod, g.sdd, 90.0 - float(angle))  # it turns the other way
    kind = itk.Image[itk.F, 3]

    def image(values: np.ndarray, spacing: tuple[float, ...]) -> Any:
        """``values (z, y, x)`` as RTK has them: its y is our z, centred."""
        made = itk.image_from_array(np.ascontiguousarray(values, dtype=np.float32))
        made.SetSpacing([float(s) for s in spacing])
        size = values.shape[::-1]
        made.SetOrigin([-(n - 1) / 2 * s for n, s in zip(size, spacing, strict=True)])
        return made

    def volume(values: np.ndarray) -> Any:
        # RTK turns about its y axis.
        return image(values.transpose(1, 0, 2), (grid.spacing[2], grid.spacing[0], grid.spacing[1]))

    def stack(values: np.ndarray) -> Any:
        made = image(values, (g.pitch[1], g.pitch[0], 1.0))
        origin = made.GetOrigin()
        made.SetOrigin([origin[0], origin[1], 0.0])
        return made

    # Its columns grow the other way, too.
    lines, blank = case.exact["gaussians"][..., ::-1], np.zeros(g.shape, np.float32)

    def projected(values: np.ndarray) -> np.ndarray:
        run = rtk.JosephForwardProjectionImageFilter[kind, kind].New()
        run.SetInput(0, stack(blank))
        run.SetInput(1, volume(values))
        run.SetGeometry(turn)
        run.Update()
        return itk.array_from_image(run.GetOutput())[..., ::-1]

    def back() -> Any:
        run = rtk.JosephBackProjectionImageFilter[kind, kind].New()
        run.SetInput(0, volume(np.zeros(grid.shape)))
        run.SetInput(1, stack(lines))
        run.SetGeometry(turn)
        run.Update()
        return run.GetOutput()

    def reconstruct() -> np.ndarray:
        run = rtk.FDKConeBeamReconstructionFilter[kind].New()
        run.SetInput(0, volume(np.zeros(grid.shape)))
        run.SetInput(1, stack(lines))
        run.SetGeometry(turn)
        run.Update()
        return itk.array_from_image(run.GetOutput()).transpose(1, 0, 2)

    x = case.images["gaussians"]
    operations = {"forward": lambda: projected(x), "back": back, "FBP": reconstruct}
    return Toolkit(operations, projected, reconstruct)


def of_mbirtorch(case: Case) -> Toolkit | None:
    """mbirtorch's projectors and direct reconstruction on the CPU, compiled by torch."""
    g, grid = case.geometry, case.grid
    if importlib.util.find_spec("mbirtorch") is None or isinstance(g, FanBeam):
        return None
    model = mbirtorch_model(g, grid)
    lines = case.exact["gaussians"].reshape(model.get_params("sinogram_shape")).astype(np.float32)

    def volume(values: np.ndarray) -> np.ndarray:
        """``values ([z,] y, x)`` as mbirtorch has them, ``(x, y, z)`` or ``(x, y, 1)``."""
        return np.ascontiguousarray(
            values.T.reshape(model.get_params("recon_shape")), dtype=np.float32
        )

    def projected(values: np.ndarray) -> np.ndarray:
        return np.asarray(model.forward_project(volume(values))).reshape(g.shape)

    def reconstruct() -> np.ndarray:
        return np.asarray(model.recon_direct(lines)).reshape(grid.shape[::-1]).T

    x = case.images["gaussians"]
    operations = {
        "forward": lambda: projected(x),
        "back": lambda: model.back_project(lines),
        "FBP": reconstruct,
    }
    return Toolkit(operations, projected, reconstruct)


def mbirtorch_model(geometry: ParallelBeam | ConeBeam, grid: VolumeGrid) -> Any:
    """mbirtorch's model of a scan, without the mask that cuts a volume to a cylinder."""
    import mbirtorch

    shape = {"delta_voxel": grid.spacing[-1], "use_ror_mask": False, "verbose": 0}
    if isinstance(geometry, ParallelBeam):
        model = mbirtorch.ParallelBeamModel((geometry.views, 1, geometry.columns), geometry.angles)
        model.set_params(
            delta_det_channel=geometry.column_pitch, recon_shape=(*grid.shape[::-1], 1), **shape
        )
        return model
    model = mbirtorch.ConeBeamModel(
        geometry.shape,
        geometry.angles,
        source_detector_dist=geometry.sdd,
        source_iso_dist=geometry.sod,
    )
    model.set_params(
        delta_det_channel=geometry.column_pitch,
        delta_det_row=geometry.row_pitch,
        recon_shape=grid.shape[::-1],
        **shape,
    )
    return model


def of_torchtomo(case: Case) -> Toolkit | None:
    """torchtomo's projectors and FBP on the CPU, by operations of PyTorch.

    Its parallel beam has as many columns as the image, so it takes no part there; of a large cone
    beam every 90th view is projected, since all would take many minutes.
    """
    g, grid = case.geometry, case.grid
    if importlib.util.find_spec("torchtomo") is None or isinstance(g, ParallelBeam):
        return None
    import torchtomo

    def tensor(values: np.ndarray) -> torch.Tensor:
        """``(1, 1, …)`` float32."""
        return torch.as_tensor(np.ascontiguousarray(values)[None, None], dtype=torch.float32)

    x, lines = case.images["gaussians"], case.exact["gaussians"]
    if grid.ndim == 3:
        every = 90 if grid.voxels > 1e5 else 1
        vectors = VectorGeometry.of(g).vectors[::every]
        source, middle, across, down = (vectors[:, None, None, k : k + 3] for k in (0, 3, 6, 9))
        columns, rows = (np.arange(n) - (n - 1) / 2 for n in (g.columns, g.rows))
        cells = middle + columns[:, None] * across + rows[:, None, None] * down
        cone = torchtomo.ConeBeam(
            grid.shape, tensor(source[:, 0, 0])[0, 0], tensor(cells)[0, 0], grid.spacing
        )
        operations = {
            "forward": lambda: cone.forward(tensor(x)),
            "back": lambda: cone.adjoint(tensor(lines[::every])),
        }
        return Toolkit(
            operations, lambda image: cone.forward(tensor(image))[0, 0].numpy(), every=every
        )
    pixel, half = grid.spacing[-1], grid.extent[-1] / 2
    # Lengths are in pixels, integrals in halves of the image; its views start a quarter turn later,
    # and all its axes point the other way.
    fan = torchtomo.FanBeam(
        grid.shape[0],
        g.views,
        g.columns,
        src_dist=g.sod / pixel,
        det_dist=(g.sdd - g.sod) / pixel,
        det_spacing=g.column_pitch / pixel,
        angles=torch.as_tensor(g.angles + np.pi / 2, dtype=torch.float32),
        circle=False,
    )

    def projected(image: np.ndarray) -> np.ndarray:
        return fan.forward(tensor(image[::-1, ::-1]))[0, 0].numpy()[:, ::-1] * half

    turned = tensor(lines[:, ::-1] / half)

    def reconstruct() -> np.ndarray:
        return fan.fbp(turned)[0, 0].numpy()[::-1, ::-1]

    operations = {
        "forward": lambda: projected(x),
        "back": lambda: fan.adjoint(turned),
        "FBP": reconstruct,
    }
    return Toolkit(operations, projected, reconstruct)


TOOLKITS: dict[str, Callable[[Case], Toolkit | None]] = {
    "torchpcct": of_torchpcct,
    "ASTRA": of_astra,
    "XCIST": of_xcist,
    "RTK": of_rtk,
    "mbirtorch": of_mbirtorch,
    "torchtomo": of_torchtomo,
}


# --- one toolkit, in a process of its own ---------------------------------------------------------


def _error(found: np.ndarray, exact: np.ndarray) -> float:
    """Relative L2 error."""
    return float(np.linalg.norm(found - exact) / np.linalg.norm(exact))


def serve(name: str, case: Case) -> None:
    """Answer the lines of the standard input, each the name of an operation, with its seconds."""
    answer = answers()
    toolkit = TOOLKITS[name](case)
    if toolkit is None:
        answer(None)
        return
    answer(list(toolkit.operations))
    for line in sys.stdin:
        wanted = line.strip()
        if wanted == "errors":
            errors = {}
            if toolkit.projected is not None:
                errors["forward"] = _error(
                    toolkit.projected(case.images["gaussians"]),
                    case.exact["gaussians"][:: toolkit.every],
                )
            if toolkit.reconstructed is not None:
                errors["FBP"] = _error(toolkit.reconstructed(), case.images["gaussians"])
            answer(errors)
            continue
        begin = time.perf_counter(), time.process_time()
        toolkit.operations[wanted]()
        end = time.perf_counter(), time.process_time()
        answer([(b - a) * toolkit.every for a, b in zip(begin, end, strict=True)])


# --- all of them ----------------------------------------------------------------------------------


def measure(
    python: str, names: list[str], label: str, case: Path, rounds: int
) -> list[dict[str, Any]]:
    """One row for each toolkit and operation; ``case`` is the file of the case ``label``."""

    def begun(name: str) -> Process:
        return Process(python, __file__, "--worker", name, "--case", case)

    processes = {name: begun(name) for name in names}
    rows = []
    for name, process in processes.items():
        errors = process.ask("errors") if process.operations else {}
        for operation in process.operations:
            row = {"case": label, "toolkit": name, "operation": operation, "steady": []}
            rows.append({**row, "error": (errors or {}).get(operation)})
    # The errors' calls have warmed some operations up: the first call is that of a new process.
    for row in rows:
        fresh = begun(row["toolkit"])
        answer = fresh.ask(row["operation"])
        fresh.close()
        if answer is None:
            raise SystemExit(
                f"{row['toolkit']} ended at {row['operation']} of {label}, of too little memory "
                "perhaps: leave it out with --toolkits, or the case with --cases"
            )
        row["first_s"] = answer[0]
    for _ in range(rounds):
        for row in rows:
            row["steady"].append(processes[row["toolkit"]].ask(row["operation"]))
    for process in processes.values():
        process.close()
    for row in rows:
        wall, processor = np.array(row.pop("steady")).T
        row |= {"median_s": float(np.median(wall)), "least_s": float(wall.min())}
        row["processor_s"] = float(np.median(processor))
    return rows


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown; ``× torchpcct`` compares the medians."""
    lines = [
        "| case | operation | toolkit | s: median (least) | processor s | × torchpcct | first call "
        "s | error |",
        "|---|---|---|---|---|---|---|---|",
    ]
    own = {(r["case"], r["operation"]): r["median_s"] for r in rows if r["toolkit"] == "torchpcct"}
    for r in sorted(rows, key=lambda r: (r["case"], r["operation"])):
        ratio = r["median_s"] / own.get((r["case"], r["operation"]), float("nan"))
        error = "–" if r["error"] is None else f"{r['error']:.2e}"
        lines.append(
            f"| {r['case']} | {r['operation']} | {r['toolkit']} | {r['median_s']:.3f} "
            f"({r['least_s']:.3f}) | {r['processor_s']:.3f} | {ratio:.1f} | {r['first_s']:.2f} | "
            f"{error} |"
        )
    return "\n".join(lines)


def page(rows: list[dict[str, Any]]) -> str:
    """The table, and when each of its cases was measured: they may be measured one by one."""
    runs = {r["case"]: r["run"] for r in rows}
    return "\n".join(
        [
            "# Operations beside those of peers",
            "",
            "`python tests/bench/peers.py`, calls interleaved. ASTRA takes one core, the others "
            "all: compare processor seconds, too.",
            "",
            *(f"* {case}: {run}" for case, run in sorted(runs.items())),
            "",
            table(rows),
            "",
        ]
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--small", action="store_true")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    parser.add_argument("--python", default=sys.executable)
    parser.add_argument("--toolkits", nargs="+", choices=list(TOOLKITS), default=list(TOOLKITS))
    parser.add_argument("--cases", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    parser.add_argument("--case", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        serve(options.worker, pickle.loads(options.case.read_bytes()))
        return
    cases = bench_cases(options.small)
    kept = options.out / "peers.json"
    rows: list[dict[str, Any]] = json.loads(kept.read_text()) if kept.exists() else []
    for number in map(CASES.index, options.cases):
        case = cases[number]()
        label = case.name
        with tempfile.TemporaryDirectory() as folder:
            # Exact integrals of a cone beam take longer than what is measured: once for all.
            file = Path(folder) / "case.pickle"
            file.write_bytes(pickle.dumps(case))
            found = measure(options.python, options.toolkits, label, file, options.rounds)
        now = datetime.datetime.now(datetime.UTC)
        run = (
            f"{options.rounds} rounds, {_machine()}, {now:%Y-%m-%d %H:%M} UTC, load "
            f"{os.getloadavg()[0]:.1f}"
        )
        rows = [r for r in rows if r["case"] != label] + [r | {"run": run} for r in found]
        write_results(options.out, "peers", rows, page(rows))
        print(table(rows), flush=True)


if __name__ == "__main__":
    main()
