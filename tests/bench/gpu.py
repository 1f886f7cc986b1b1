"""torchpcct on a card: do its kernels compute what the CPU's do, how fast, and how fast is a
training?

    python tests/bench/gpu.py        # at most 8 minutes; writes gpu.md and gpu.json beside itself

One command without arguments, for the first minutes on a card: versions; agreement of every Triton
kernel with the CPU in float32 and float64 (forward, adjoint, the identity between both, gradients),
of FBP, PWLS and MBIR; times by CUDA events (median of 5 after a first call) beside those of
torchtomo and diffct where these are installed; whole reconstructions on the card and on the CPU;
half a minute of training with its scenes per second. What fails, and what there was no time for,
stands in the table as such.

Without a card it says so and ends. With TRITON_INTERPRET=1 it runs at tiny sizes on the CPU, the
kernels by Triton's interpreter: that tests this program, not the card.
"""

import argparse
import datetime
import json
import math
import os
import platform
import statistics
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import replace
from importlib import metadata, util
from pathlib import Path
from typing import Any

import numpy as np
import torch

from recon.analytic.backproject import BackprojectionPlan
from recon.analytic.fbp import fbp
from recon.api import reconstruct
from torchpcct import (
    ConeBeam,
    FanBeam,
    ParallelBeam,
    Projector,
    Scan,
    VectorGeometry,
    VolumeGrid,
    acquire,
)
from torchpcct.detector_window import DetectorWindow
from torchpcct.geometry import full_turn
from torchpcct.scanner import presets
from torchpcct.scene.plaque import plaque_scene
from torchpcct.vector_geometry import helical_motion
from train.__main__ import build
from train.config import LateConfig, load_config
from train.processes import Group, gradient
from train.run import Run

LIMIT_S = 440.0
"""Seconds after which nothing new is begun."""
SLOWEST_S = 20.0
"""First calls that take longer are not repeated."""
ROUNDS = 5
"""Calls that a median is of."""
TRAINING_S = 25.0
GOALS_MS = {
    ("cone 256³, 360 × 384²", "forward"): 100,
    ("cone 256³, 360 × 384²", "adjoint"): 150,
    ("cone 512³, 360 × 1024 × 768", "forward"): 250,
    ("cone 512³, 360 × 1024 × 768", "adjoint"): 350,
}
BOUNDS = {torch.float32: 1e-5, torch.float64: 1e-10}
"""Relative errors up to which a kernel agrees."""


class Bench:
    """Where it runs, how much time is left, and the table."""

    def __init__(self, device: torch.device, tiny: bool) -> None:
        self.device, self.tiny, self.began = device, tiny, time.perf_counter()
        self.rows: list[dict[str, Any]] = []

    @property
    def left(self) -> float:
        return LIMIT_S - (time.perf_counter() - self.began)

    def add(self, part: str, what: str, **found: Any) -> None:
        self.rows.append({"part": part, "what": what, **found})
        said = ", ".join(
            f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in found.items()
        )
        print(f"{part:10s} {what}: {said}", flush=True)

    def run(self, part: str, what: str, work: Callable[[], dict[str, Any]]) -> None:
        """Add what ``work`` finds, or why it finds nothing."""
        if self.left <= 0:
            self.add(part, what, failed="no time was left")
            return
        try:
            found = work()
        except Exception as error:  # the next one may work
            traceback.print_exc(limit=-3)
            found = {"failed": f"{type(error).__name__}: {error}".partition("\n")[0]}
        self.add(part, what, **found)
        if self.device.type == "cuda":
            torch.cuda.empty_cache()

    def milliseconds(self, work: Callable[[], Any]) -> dict[str, float]:
        """First call, which compiles, and the median of the next ones."""
        times = []
        for k in range(1 + ROUNDS):
            if self.device.type == "cuda":
                begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
                begin.record()
                work()
                end.record()
                torch.cuda.synchronize()
                times.append(begin.elapsed_time(end))
            else:
                begun = time.perf_counter()
                work()
                times.append(1e3 * (time.perf_counter() - begun))
            if k == 0 and (times[0] > 1e3 * SLOWEST_S or self.tiny):
                return {"first_ms": times[0]}
        return {"first_ms": times[0], "ms": statistics.median(times[1:])}


def random(shape: Any, dtype: torch.dtype = torch.float32, seed: int = 0) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def error(found: torch.Tensor, expected: torch.Tensor) -> float:
    """Relative, in the Euclidean norm; both are compared on the CPU in float64."""
    a, b = found.detach().cpu().double(), expected.detach().cpu().double()
    return float((a - b).norm() / b.norm())


# -- agreement -------------------------------------------------------------------------------------


def agreement_cases(tiny: bool) -> dict[str, tuple[Any, VolumeGrid, Any, Any]]:
    """Geometry, grid, window and motion of every kind of scan."""
    views, n, z = (3, 6, 3) if tiny else (60, 96, 24)
    turn = full_turn(views)
    columns, rows = 2 * n, 2 * z
    plane, volume = VolumeGrid((n, n - 1), 1.0), VolumeGrid((z, n - 1, n), 1.0)
    far = {"sod": 20.0 * n, "sdd": 40.0 * n, "columns": columns}
    near = {"sod": 1.5 * n, "sdd": 3.0 * n, "columns": columns}
    window = DetectorWindow(np.full(views, n // 2), n)
    sway = np.stack([np.cos(turn), np.sin(2 * turn), np.sin(turn)], 1)
    cone = ConeBeam(turn, rows=rows, pitch=(2.2, 2.2), **near)
    long = ConeBeam(turn, rows=rows, pitch=(1.1, 9.0), **near)
    helix = VectorGeometry.of(cone, helical_motion(cone, 0.5 * z, -0.25 * z))
    slanted = VectorGeometry.of(FanBeam(turn, pitch=2.2, **near)).turned(slant=0.3 * np.cos(turn))
    return {
        "parallel": (ParallelBeam(turn, columns, 1.1, 0.3), plane, None, None),
        "fan": (FanBeam(turn, pitch=2.2, **near), plane, None, None),
        "fan, curved": (FanBeam(turn, pitch=2.2, detector="curved", **near), plane, None, None),
        "fan, window": (FanBeam(turn, pitch=2.2, **near), plane, window, None),
        "cone": (ConeBeam(turn, rows=rows, pitch=(2.2, 2.2), **near), volume, None, None),
        "cone, layers": (ConeBeam(turn, rows=rows, pitch=(2.2, 2.2), **far), volume, None, None),
        "cone, moving": (cone, volume, None, sway),
        # Detectors that lean: no circular scan describes them.
        "vectors, helix": (helix.turned(tilt=0.05), volume, None, None),
        "vectors, rolled long cells": (
            VectorGeometry.of(long).turned(0.6, 0.2, 0.1),
            volume,
            None,
            None,
        ),
        "vectors, parallel": (laminography(turn, rows, columns), volume, None, None),
        "vectors, plane": (slanted, plane, None, None),
    }


def laminography(turn: Any, rows: int, columns: int) -> VectorGeometry:
    """Parallel rays that leave the plane of rotation by half a rad."""
    radial = np.stack([np.cos(turn), np.sin(turn), 0 * turn], 1)
    tangent = np.stack([-np.sin(turn), np.cos(turn), 0 * turn], 1)
    ray = np.array([0.0, 0.0, math.sin(0.5)]) - math.cos(0.5) * radial
    vectors = [ray, 0 * ray, 1.1 * tangent, 1.1 * np.cross(tangent, ray)]
    return VectorGeometry(np.concatenate(vectors, 1), columns, rows, parallel=True)


def projector_agreement(bench: Bench, case: Any, dtype: torch.dtype) -> dict[str, Any]:
    geometry, grid, window, motion = case
    A = Projector(geometry, grid, window, motion)
    passes = A._engine.on(bench.device)
    x, y = random((1, *A.domain_shape), dtype), random((1, *A.range_shape), dtype, 1)
    forward, adjoint = (
        f(v.to(bench.device)) for f, v in ((passes.forward, x), (passes.adjoint, y))
    )
    left = float((forward.double().cpu() * y.double()).sum())
    right = float((adjoint.double().cpu() * x.double()).sum())
    size = float(forward.double().norm()) * float(y.double().norm())
    again = passes.adjoint(y.to(bench.device))
    found = {
        "forward": error(forward, A(x.double())),
        "adjoint": error(adjoint, A.T(y.double())),
        "identity": abs(left - right) / size,
        "same_bits": bool(torch.equal(again, adjoint)),
    }
    agrees = max(found["forward"], found["adjoint"]) <= BOUNDS[dtype]
    return found | {"agrees": agrees and found["same_bits"]}


def fbp_agreement(bench: Bench, case: Any, dtype: torch.dtype) -> dict[str, Any]:
    """Backprojection and its gradient; on a card the whole of FBP."""
    geometry, grid, _, motion = case
    plan = BackprojectionPlan(geometry, grid, DetectorWindow.full(geometry), motion)
    y = random((1, *geometry.shape), dtype)
    here = plan.forward(y.double())
    there = plan._forward_there(y.to(bench.device))
    v = random(here.shape, dtype, 1)
    found = {
        "backprojection": error(there, here),
        "its transpose": error(
            plan._transpose_there(v.to(bench.device)), plan.transpose(v.double())
        ),
    }
    if bench.device.type == "cuda":
        expect = fbp(y.double(), geometry, grid, motion=motion, outside=0.0)
        moved = y.to(bench.device)
        found["fbp"] = error(fbp(moved, geometry, grid, motion=motion, outside=0.0), expect)
    return found | {"agrees": max(found.values()) <= BOUNDS[dtype]}


def gradient_agreement(bench: Bench, case: Any) -> dict[str, Any]:
    """Of ½ ‖A x − y‖² by autograd, against Aᵀ(A x − y) on the CPU."""
    geometry, grid, window, motion = case
    A = Projector(geometry, grid, window, motion)
    x, y = random(A.domain_shape), random(A.range_shape, seed=1)
    there = x.to(bench.device).requires_grad_()
    (0.5 * (A(there) - y.to(bench.device)).square().sum()).backward()
    off = error(there.grad, A.T(A(x) - y))
    return {"gradient": off, "agrees": off <= BOUNDS[torch.float32]}


def chain_agreement(bench: Bench, method: str, kind: str, **options: Any) -> dict[str, Any]:
    """HU between the volumes of one scan on the CPU and on the device."""
    scan, grid = field_scan(kind, *((8, 12) if bench.tiny else (64, 180)))
    here = reconstruct(scan, grid, method, **options)
    there = reconstruct(scan, grid, method, device=bench.device, **options)
    off = float((there.data.cpu() - here.data).abs().max())
    return {"hu_apart": off, "on_cpu": there.report.get("on_cpu", []), "agrees": off < 1.0}


def field_scan(kind: str, n: int, views: int) -> tuple[Scan, VolumeGrid]:
    """Noisy scan of a disc of water, and a grid of n voxels of 100 mm in all."""
    turn, pitch = full_turn(views), 3.2 * 64 / n
    if kind == "fan":
        geometry: Any = FanBeam(turn, 300.0, 600.0, n * 3 // 2, pitch)
        grid = VolumeGrid((n, n), 100.0 / n)
    elif kind == "vectors":
        fan = FanBeam(turn, 300.0, 600.0, n * 3 // 2, pitch)
        geometry = VectorGeometry.of(fan).turned(slant=0.1 * np.cos(turn))
        grid = VolumeGrid((n, n), 100.0 / n)
    else:
        geometry = ConeBeam(turn, 300.0, 600.0, n * 3 // 2, n // 2, (pitch, pitch))
        grid = VolumeGrid((n // 4, n, n), 100.0 / n)
    y, x = grid.axes[-2:]
    disc = torch.from_numpy(0.02 * (np.hypot(y[:, None], x) < 35.0)).float().expand(grid.shape)
    lines = Projector(geometry, grid)(disc.contiguous())
    counts = torch.poisson(1e5 * torch.exp(-lines), generator=torch.Generator().manual_seed(0))
    return Scan.from_counts(counts, geometry, air=1e5, gain=1.0, mu_water=0.02), grid


# -- times -----------------------------------------------------------------------------------------


def timed_cases(tiny: bool) -> dict[str, tuple[Any, VolumeGrid]]:
    """Geometry and grid; scans given by vectors are timed alone, the peers do not take them
    here."""

    def cone(n: int, views: int, rows: int, columns: int) -> tuple[ConeBeam, VolumeGrid]:
        pitch = 1.5 * 2.0 * n / columns
        beam = ConeBeam(full_turn(views), 3.0 * n, 6.0 * n, columns, rows, (pitch, pitch))
        return beam, VolumeGrid((n,) * 3, 1.0)

    if tiny:
        fan = FanBeam(full_turn(3), 24.0, 48.0, 10, 2.4), VolumeGrid((8, 8), 1.0)
        return {"fan 8²": fan, "cone 4³": cone(4, 3, 4, 6)}
    fan = FanBeam(full_turn(720), 1536.0, 3072.0, 720, 2.2), VolumeGrid((512, 512), 1.0)
    leaning, voxels = cone(128, 180, 192, 192)
    return {
        "fan 512², 720 × 720": fan,
        "cone 64³, 90 × 96²": cone(64, 90, 96, 96),
        "vectors 128³, 180 × 192²": (VectorGeometry.of(leaning).turned(0.02, 0.03), voxels),
        "cone 256³, 360 × 384²": cone(256, 360, 384, 384),
        "cone 512³, 360 × 1024 × 768": cone(512, 360, 768, 1024),
    }


def operations(bench: Bench, geometry: Any, grid: VolumeGrid) -> dict[str, Callable[[], Any]]:
    """Of torchpcct, float32."""
    A = Projector(geometry, grid)
    passes = A._engine.on(bench.device)
    x, y = (torch.rand((1, *s), device=bench.device) for s in (A.domain_shape, A.range_shape))
    made = {"forward": lambda: passes.forward(x), "adjoint": lambda: passes.adjoint(y)}
    if isinstance(geometry, VectorGeometry):
        return made
    plan = BackprojectionPlan(geometry, grid, DetectorWindow.full(geometry))
    return made | {"backprojection of FBP": lambda: plan._forward_there(y)}


def diffct(bench: Bench, geometry: Any, grid: VolumeGrid) -> dict[str, Callable[[], Any]]:
    import diffct as peer

    cone = isinstance(geometry, ConeBeam)
    if not cone:
        raise ValueError("compared in cone beams only")
    orbit = peer.circular_trajectory_3d(
        geometry.views, sid=geometry.sod, sdd=geometry.sdd, device=bench.device
    )
    A = peer.Projector(
        orbit,
        volume_shape=grid.shape,
        detector_shape=(geometry.columns, geometry.rows),
        detector_spacing=geometry.pitch[1],
    )
    x = torch.rand(A.volume_shape, device=bench.device)
    y = A.project(x)
    return {"forward": lambda: A.project(x), "adjoint": lambda: A.backproject(y)}


def torchtomo(bench: Bench, geometry: Any, grid: VolumeGrid) -> dict[str, Callable[[], Any]]:
    import torchtomo as peer

    beta = torch.tensor(geometry.angles)
    radial = torch.stack([beta.cos(), beta.sin(), 0 * beta], 1)
    tangent = torch.stack([-beta.sin(), beta.cos(), 0 * beta], 1)
    if isinstance(geometry, ConeBeam):
        u, v = (torch.from_numpy(w) for w in (geometry.column_positions, geometry.row_positions))
        cells = (geometry.sod - geometry.sdd) * radial[:, None, None] + tangent[:, None, None] * u[
            :, None
        ]
        cells = cells + torch.stack([0 * v, 0 * v, v], 1)[:, None]
        A = peer.ConeBeam(
            grid.shape, (geometry.sod * radial).float(), cells.float(), backend="cuda"
        ).to(bench.device)
        shape: tuple[int, ...] = (1, 1, *grid.shape)
    else:
        A = peer.FanBeam(
            img_size=grid.shape[0],
            n_angles=geometry.views,
            n_det=geometry.columns,
            src_dist=geometry.sod,
            det_dist=geometry.sdd - geometry.sod,
            det_spacing=geometry.column_pitch,
            backend="cuda",
        ).to(bench.device)
        shape = (1, 1, *grid.shape)
    x = torch.rand(shape, device=bench.device)
    y = A.forward(x)
    return {"forward": lambda: A.forward(x), "adjoint": lambda: A.adjoint(y)}


def timed(bench: Bench) -> None:
    peers = [p for p in (torchtomo, diffct) if util.find_spec(p.__name__) and not bench.tiny]
    for name, (geometry, grid) in timed_cases(bench.tiny).items():
        others = [] if isinstance(geometry, VectorGeometry) else peers
        for maker in (operations, *others):
            toolkit = "torchpcct" if maker is operations else maker.__name__
            made: dict[str, Callable[[], Any]] = {}

            def make(maker: Any = maker, made: Any = made, of: Any = (geometry, grid)) -> Any:
                begun = time.perf_counter()
                made.update(maker(bench, *of))
                return {"seconds": time.perf_counter() - begun}

            bench.run("set up", f"{toolkit}, {name}", make)
            for operation, work in made.items():
                given = toolkit, name, operation, work, geometry, grid
                bench.run(
                    "time",
                    f"{toolkit}, {name}, {operation}",
                    lambda given=given: measured(bench, *given),
                )


def measured(
    bench: Bench,
    toolkit: str,
    name: str,
    operation: str,
    work: Callable[[], Any],
    geometry: Any,
    grid: VolumeGrid,
) -> dict[str, Any]:
    found: dict[str, Any] = bench.milliseconds(work)
    if toolkit != "torchpcct" or "ms" not in found:
        return found
    goal = GOALS_MS.get((name, operation))
    if goal is not None:
        found |= {"goal_ms": goal, "reached": found["ms"] <= goal}
    return found | roofline(geometry, grid, found["ms"])


def roofline(geometry: Any, grid: VolumeGrid, ms: float) -> dict[str, float]:
    """Voxel visits per nanosecond: rays times slabs times the two voxels that a cell touches in
    each; and the least traffic, volume and readings once each."""
    visits = 2.0 * math.prod(geometry.shape) * max(grid.shape[-2:])
    traffic = 4.0 * (math.prod(geometry.shape) + grid.voxels)
    return {"visits_per_ns": visits / (1e6 * ms), "least_traffic_gb_s": traffic / (1e6 * ms)}


def bandwidth(bench: Bench) -> dict[str, float]:
    """Of a copy, and of multiply-adds in float32 with cuBLAS, what the card can at best."""
    n = 2**12 if bench.tiny else 2**28
    a = torch.rand(n, device=bench.device)
    b = torch.empty_like(a)
    found = bench.milliseconds(lambda: b.copy_(a))
    size = 64 if bench.tiny else 8192
    m = torch.rand(size, size, device=bench.device)
    product = bench.milliseconds(lambda: m @ m)
    return {
        "copy_gb_s": 8e-6 * n / found.get("ms", found["first_ms"]),
        "fp32_tflop_s": 2e-9 * size**3 / product.get("ms", product["first_ms"]),
    }


# -- whole reconstructions -------------------------------------------------------------------------


def reconstructed_scans(tiny: bool) -> dict[str, tuple[Scan, VolumeGrid, tuple[str, ...], bool]]:
    """Scan, grid, methods, and whether the CPU computes them, too."""
    scene, plaque = plaque_scene(vessel_length=6.0)
    size = (5, 8, 8) if tiny else (33, 39, 39)
    inset = VolumeGrid(size, 0.2, plaque.position[::-1])
    scanner = presets.pcct(views=246 if tiny else 1968, rows=8 if tiny else 28)
    window = acquire(scene, scanner, exposure_s=2.0, seed=0, region=inset, duty=1 / 4)
    n, views = (8, 12) if tiny else (512, 720)
    fan, plane = field_scan("fan", n, views)
    m, turn = (8, 12) if tiny else (128, 180)
    cone, volume = field_scan("cone", m, turn)
    return {
        "inset of the paper, 33 × 39², 1 968 views": (window, inset, ("fbp", "pwls", "mbir"), True),
        f"fan beam {n}², {views} views": (fan, plane, ("fbp", "pwls"), True),
        f"cone beam {m // 4} × {m}², {turn} views": (cone, volume, ("fbp", "pwls"), False),
    }


def whole_seconds(
    bench: Bench, scan: Scan, grid: VolumeGrid, method: str, on_cpu: bool
) -> dict[str, Any]:
    """Of ``recon.reconstruct``, tests of the data among it: the first call on the device, which
    compiles and fits what a scan keeps, the next one, and that of the CPU with all its threads."""

    def seconds(device: torch.device | str) -> tuple[float, Any]:
        begun = time.perf_counter()
        volume = reconstruct(scan, grid, method, device=device)
        volume.data.cpu()
        return time.perf_counter() - begun, volume

    first, there = seconds(bench.device)
    found = {"first_s": first, "next_s": seconds(bench.device)[0]}
    if on_cpu:
        seconds("cpu")
        found["cpu_next_s"], here = seconds("cpu")
        off = (there.data.cpu() - here.data).square().mean().sqrt()
        found["hu_rms_apart"] = float(off)
        found["agrees"] = bool(off < 0.2)
    return found


# -- training --------------------------------------------------------------------------------------


def training(bench: Bench) -> dict[str, Any]:
    """Steps of ``torchpcct train`` as it is packaged, on a few scenes: what a training does once
    all views are on the device."""
    root = Path(__file__).parents[2] / "train" / "configs"
    config = load_config(root / ("quick.yaml" if bench.tiny else "default.yaml"))
    kept = replace(config.data, scenes_kept=2 * config.batch, situations=config.data.situations[:1])
    config = replace(config, data=kept, late=LateConfig(), steps=10**6)
    with tempfile.TemporaryDirectory() as folder:
        model, data, _, objective = build(config, Path(folder) / "views", str(bench.device))
        begun = time.perf_counter()
        data.prepare(max(1, len(os.sched_getaffinity(0)) - 2))
        painted = time.perf_counter() - begun
        run = Run(config, model, Group(), Path(folder) / "run")
        run.begin(False, "")
        volumes: list[int] = []
        model.register_forward_pre_hook(lambda _, given: volumes.append(len(given[0].b)))
        losses: list[float] = []

        def step() -> None:
            values, _ = gradient(config, model, data, objective, run.state.step, run.group)
            run.step(values)
            losses.append(values["loss"])

        def seconds(work: Callable[[], Any], limit: float, least: int) -> tuple[float, int]:
            """Of one call, mean over calls until the limit; and how many calls there were."""
            calls, begun = 0, time.perf_counter()
            while calls < least or time.perf_counter() - begun < limit:
                work()
                calls += 1
            if bench.device.type == "cuda":
                torch.cuda.synchronize()
            return (time.perf_counter() - begun) / calls, calls

        for _ in range(1 if bench.tiny else 5):  # what is compiled and tuned at first
            step()
        size = range(config.batch)
        batch, _ = seconds(lambda: data.batch(run.state.step, config.batch, size), 0.0, 4)
        volumes.clear()
        whole, steps = seconds(step, 0.0 if bench.tiny else min(TRAINING_S, bench.left), 2)
    return {
        "painted_s": painted,
        "step_ms": 1e3 * whole,
        "batch_ms": 1e3 * batch,
        "scenes_per_s": config.batch / whole,
        "volumes_per_s": sum(volumes) / steps / whole,
        "steps": steps,
        "skipped": run.state.skipped,
        "first_loss": losses[0],
        "last_loss": losses[-1],
        "agrees": run.state.skipped == 0 and all(map(math.isfinite, losses)),
    }


# -- the whole -------------------------------------------------------------------------------------


def versions(device: torch.device) -> dict[str, str]:
    found = {"python": platform.python_version(), "torch": torch.__version__}
    for name in ("triton", "numba", "torchpcct", "torchtomo", "diffct"):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "none"
    if device.type == "cuda":
        about = torch.cuda.get_device_properties(device)
        found |= {
            "cuda": str(torch.version.cuda),
            "card": about.name,
            "memory": f"{about.total_memory / 2**30:.0f} GiB",
            "capability": f"{about.major}.{about.minor}",
        }
    else:
        found["card"] = "none: Triton's interpreter on the CPU"
    return found


def table(about: dict[str, str], rows: list[dict[str, Any]], seconds: float) -> str:
    said = ", ".join(f"{k} {v}" for k, v in about.items())
    failed = [r for r in rows if "failed" in r or r.get("agrees") is False]
    lines = [
        "# On a card",
        "",
        f"`python tests/bench/gpu.py`, {datetime.date.today()}, {seconds:.0f} s: {said}.",
        "",
        f"{len(failed)} of {len(rows)} rows failed, disagree, or had no time.",
    ]
    for part in dict.fromkeys(r["part"] for r in rows):
        own = [r for r in rows if r["part"] == part]
        columns = list(dict.fromkeys(k for r in own for k in r if k not in ("part", "what")))
        lines += ["", f"## {part.capitalize()}", "", f"| | {' | '.join(columns)} |"]
        lines.append("|---" * (len(columns) + 1) + "|")
        for r in own:
            cells = [r.get(c, "") for c in columns]
            shown = [f"{c:.3g}" if isinstance(c, float) else str(c) for c in cells]
            lines.append(f"| {r['what']} | {' | '.join(shown)} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    out = parser.parse_args().out
    tiny = os.environ.get("TRITON_INTERPRET") == "1"
    if not tiny and not torch.cuda.is_available():
        raise SystemExit(
            "no CUDA device that torch can use, so there is nothing to time: TRITON_INTERPRET=1 "
            "runs this program at tiny sizes on the CPU"
        )
    if not util.find_spec("triton"):
        raise SystemExit("the kernels need Triton: pip install triton")
    bench = Bench(torch.device("cpu" if tiny else "cuda:0"), tiny)
    about = versions(bench.device)
    print(about, flush=True)
    cases = agreement_cases(tiny)
    if tiny:
        of_each_kernel = "parallel", "fan", "cone, layers", "cone", "vectors, plane"
        cases = {name: cases[name] for name in of_each_kernel}
    for name, case in cases.items():
        for dtype in BOUNDS:
            kind = str(dtype).removeprefix("torch.")
            bench.run(
                "projector",
                f"{name}, {kind}",
                lambda c=case, d=dtype: projector_agreement(bench, c, d),
            )
            if case[2] is None and not isinstance(case[0], VectorGeometry):
                bench.run(
                    "FBP", f"{name}, {kind}", lambda c=case, d=dtype: fbp_agreement(bench, c, d)
                )
    for name in ("fan", "cone"):
        bench.run("gradient", name, lambda c=cases[name]: gradient_agreement(bench, c))
        bench.run("chain", f"fbp, {name}", lambda k=name: chain_agreement(bench, "fbp", k))
        bench.run(
            "chain",
            f"pwls, {name}",
            lambda k=name: chain_agreement(bench, "pwls", k, tolerance=5.0),
        )
    bench.run("gradient", "vectors", lambda: gradient_agreement(bench, cases["vectors, plane"]))
    for method, options in (("fbp", {}), ("pwls", {"tolerance": 5.0})):
        bench.run(
            "chain",
            f"{method}, vectors",
            lambda m=method, o=options: chain_agreement(bench, m, "vectors", **o),
        )
    bench.run("chain", "mbir, fan", lambda: chain_agreement(bench, "mbir", "fan"))
    bench.run("card", "at best", lambda: bandwidth(bench))
    timed(bench)
    for what, (scan, grid, methods, on_cpu) in reconstructed_scans(tiny).items():
        for method in methods:
            given = scan, grid, method, on_cpu
            bench.run(
                "whole",
                f"{method}, {what}",
                lambda given=given: whole_seconds(bench, *given),
            )
    bench.run("training", "network of MBIR", lambda: training(bench))
    seconds = time.perf_counter() - bench.began
    text = table(about, bench.rows, seconds)
    out.mkdir(parents=True, exist_ok=True)
    (out / "gpu.md").write_text(text, encoding="utf-8")
    values = {"about": about, "seconds": seconds, "rows": bench.rows}
    (out / "gpu.json").write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
