"""Float32 against float64: every operator and method against problem size, and numbers that are
hard on float32.

    python tests/bench/precision.py [--largest 256] [--keep]

``table``: the same float32 input through both precisions; ``rms`` and ``worst`` are the difference
over the rms of the float64 result, of the methods in HU. ``hard``: sums of 1e8 terms, subnormals
and 1e30, cancellation in the logarithm, footprints near 45°, weights that are nearly zero, singular
bins, an observer with too few samples, solvers from zero, noise and 10⁴ HU. With ``--keep`` the
figures go to ``precision.json`` and ``precision.md`` beside this file; the small ones hardly depend
on the processor and are pinned by ``tests/test_precision.py``.
"""

import argparse
import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from recon.analytic.fbp import fbp
from recon.conjugate_gradient import dot
from recon.data_term import Quadratic
from recon.gram.gram import Gram
from recon.least_squares.pwls import pwls
from recon.least_squares.qggmrf import QGGMRF
from recon.mbir.mbir import Mbir
from torchpcct import ConeBeam, FanBeam, ParallelBeam, Projector, Scan, VolumeGrid, full_turn
from torchpcct.detector_window import footprint
from torchpcct.metrics.observer import hotelling_scores
from torchpcct.spectral import SpectralModel, decompose

MU = 0.02
HU = MU / 1000
VOXEL = 0.5
BEAMS = ("parallel", "fan", "cone")

Row = dict[str, Any]


def setup(beam: str, n: int) -> tuple[Any, VolumeGrid]:
    """A whole field of n² or n³ voxels with as many views and 1.5 times as many columns."""
    size = n * VOXEL
    columns, rows = math.ceil(1.5 * n), n
    if beam == "parallel":
        return ParallelBeam(np.arange(n) * math.pi / n, columns, VOXEL), VolumeGrid((n, n), VOXEL)
    if beam == "fan":
        return FanBeam(full_turn(n), 3 * size, 5 * size, columns, 1.7 * VOXEL), VolumeGrid(
            (n, n), VOXEL
        )
    cone = ConeBeam(full_turn(n), 3 * size, 5 * size, columns, rows, 1.7 * VOXEL)
    return cone, VolumeGrid((n // 2, n, n), VOXEL)


def inset(n: int) -> tuple[Projector, Tensor, VolumeGrid]:
    """An inset of n//2 × n × n voxels in a wide cone beam, and weights that vary by half."""
    grid = VolumeGrid((max(n // 2, 2), n, n), 0.2)
    geometry = ConeBeam(full_turn(120), 300.0, 500.0, 12 * n, n, 0.4)
    A = Projector(geometry, grid, footprint(geometry, grid, margin=1))
    return A, 1e4 * (1 + 0.5 * noise(A.range_shape, 3).sin()), grid


def noise(shape: Any, seed: int = 0) -> Tensor:
    """Normal float32 values."""
    return torch.randn(tuple(shape), generator=torch.Generator().manual_seed(seed))


def body(grid: VolumeGrid) -> Tensor:
    """Water, round, with a texture of 10 %, float32 mm⁻¹."""
    axes = torch.meshgrid(
        *[torch.from_numpy(a / e) for a, e in zip(grid.axes, grid.extent, strict=True)],
        indexing="ij",
    )
    inside = sum(a.square() for a in axes[-2:]) < 0.42**2
    return (MU * inside * (1 + 0.1 * noise(grid.shape, 1))).float()


def apart(single: Tensor, double: Tensor) -> Row:
    """Difference over the rms of the float64 result: rms and largest."""
    error, scale = single.double() - double, double.square().mean().sqrt()
    return {
        "rms": float(error.square().mean().sqrt() / scale),
        "worst": float(error.abs().max() / scale),
    }


def both(operator: Callable[[Tensor], Tensor], x: Tensor) -> Row:
    return apart(operator(x), operator(x.double()))


def linear(
    geometry: Any, grid: VolumeGrid, A: Projector, x: Tensor, y: Tensor
) -> tuple[tuple[str, Any, Tensor], ...]:
    """Linear operators of a whole field, and what they are given."""
    return (
        ("A", A, x),
        ("Aᵀ", A.T, y),
        ("FBP", lambda v: fbp(v, geometry, grid, "soft", outside=0.0), y),
    )


def operators(beam: str, n: int) -> Iterator[Row]:
    """Projector, adjoint, FBP of a whole field."""
    geometry, grid = setup(beam, n)
    A = Projector(geometry, grid)
    x = body(grid)
    y = A(x)
    for name, operator, given in linear(geometry, grid, A, x, y):
        yield {
            "what": f"{name}, {beam} beam",
            "n": n,
            "unknowns": grid.voxels,
            **both(operator, given),
        }


def methods(n: int, tolerance: float = 1e-3) -> Iterator[Row]:
    """Gram operator, PWLS to within ``tolerance`` HU and MBIR of an inset."""
    A, weights, grid = inset(n)
    x = body(grid) + 1e-4 * noise(grid.shape, 2)
    y = A(x) + noise(A.range_shape, 4) / weights.sqrt()
    model, exact = Gram(A, weights), Gram(A, weights.double())
    about = {"n": n, "unknowns": grid.voxels}
    yield {"what": "Gram operator", **about, **apart(model(x), exact(x.double()))}
    prior = QGGMRF(0.15, 100.0)
    bound = prior.bind(model.information(HU), grid.spacing, HU)
    yield {
        "what": "gradient of the q-GGMRF",
        **about,
        **both(lambda v: bound.gradient(v[None])[0], x),
    }
    found = [
        pwls(
            A, v, w, prior, mu_per_hu=HU, gram=g, tolerance=tolerance, max_exact=100
        ).volume.double()
        / HU
        for v, w, g in ((y, weights, model), (y.double(), weights.double(), exact))
    ]
    yield {"what": "PWLS, HU", **about, **hu(*found)}
    network = Mbir.load()
    b = A.T(weights * y)[None]
    volumes = []
    for gram, dtype in ((model, torch.float32), (exact, torch.float64)):
        term = Quadratic(gram, b.to(dtype), torch.ones(1), (network.voxel_mm,) * 3, 1000 * HU)
        normal = term.in_noise_units()
        with torch.no_grad():
            u = network.model.to(dtype)(normal, 0.5)
        volumes.append((u * normal.unit_hu.reshape(-1, 1, 1, 1)).double())
    yield {"what": "MBIR, HU", **about, **hu(*volumes)}


def hu(single: Tensor, double: Tensor) -> Row:
    error = single - double
    return {"rms": float(error.square().mean().sqrt()), "worst": float(error.abs().max())}


def sums(terms: int) -> Row:
    """Inner product of equal terms: float32 alone stops growing at 2²⁴ of them."""
    ones = torch.full((terms,), 0.1)
    exact = terms * float(ones[0]) ** 2
    return {
        "what": "inner product",
        "terms": terms,
        "relative": abs(float(dot(ones, ones, 1)) / exact - 1),
    }


def scaled(scale: float, n: int = 32) -> Iterator[Row]:
    """Linear operators of an input of other magnitude; subnormal float32 as they are, with the
    few bits they have."""
    geometry, grid = setup("fan", n)
    A = Projector(geometry, grid)
    x = body(grid)
    y = A(x)
    for name, operator, given in linear(geometry, grid, A, x, y):
        other = given * scale
        yield {"what": f"{name}, fan beam", "scale": scale, **both(operator, other)}


def logarithm(air: float) -> Row:
    """Line integrals of 0 … 1e-6 from many photons, in units of their noise."""
    true = torch.tensor([0.0, 1e-6, 1e-4, 1e-2, 1.0, 5.0], dtype=torch.float64)
    cone = ConeBeam(full_turn(1), 300.0, 500.0, true.numel(), 1, 1.0)
    counts = (air * torch.exp(-true)).float()
    scan = Scan.from_counts(counts.reshape(1, 1, -1), cone, air=air, gain=1.0)
    half = torch.log(torch.tensor(air, dtype=torch.float64)) - torch.log(counts.double() + 0.5)
    error = (scan.line_integrals().double().flatten() - half).abs()
    in_noise = float((error * counts.double().sqrt()).max())
    return {
        "what": "−ln(counts / air)",
        "air": air,
        "worst": float(error.max()),
        "in_noise": in_noise,
    }


def diagonal(beside: float, n: int = 64) -> Row:
    """Views at 45° and so much beside it, rad: where rows and columns of the grid change their
    parts."""
    angles = [math.pi / 4 + k * math.pi / 2 + beside for k in range(4)]
    geometry = ParallelBeam(angles, math.ceil(1.5 * n), VOXEL)
    A = Projector(geometry, VolumeGrid((n, n), VOXEL))
    x = body(VolumeGrid((n, n), VOXEL))
    y = A(x)
    inner = abs(float(dot(y, y, 2)) - float(dot(x, A.T(y), 2))) / float(dot(y, y, 2))
    return {"what": "A near 45°", "beside": beside, **both(A, x), "adjoint": inner}


def light_weights(share: float, n: int = 8) -> Row:
    """PWLS where a third of the readings weigh nearly nothing and hold nonsense, against weights
    of 0."""
    A, weights, grid = inset(n)
    y = A(body(grid)) + noise(A.range_shape, 4) / weights.sqrt()
    third = torch.arange(weights.shape[-1]) % 3 == 0
    prior = QGGMRF(0.15, 100.0)
    found = []
    for factor in (share, 0.0):
        w = torch.where(third, weights * factor, weights)
        data = torch.where(third, y + 1.0, y)
        found.append(
            pwls(A, data, w, prior, mu_per_hu=HU, tolerance=1e-3, max_exact=100).volume.double()
            / HU
        )
    return {"what": "PWLS, nearly zero weights", "share": share, **hu(*found)}


def starts(where: str, start: str, n: int = 8) -> Row:
    """PWLS from another first volume to within 0.2 HU, against the minimum in float64, HU."""
    if where == "inset":
        A, weights, grid = inset(n)
    else:
        geometry, grid = setup("fan", 4 * n)
        A = Projector(geometry, grid)
        weights = torch.full(A.range_shape, 1e6)
    y = A(body(grid)) + noise(A.range_shape, 4) / weights.sqrt()
    first = {
        "zero": None,
        "noise": 0.5 * MU * noise(grid.shape, 5),
        "10⁴ HU": torch.full(grid.shape, 11 * MU),
    }[start]
    exact = pwls(A, y.double(), weights.double(), QGGMRF(0.15, 100.0), mu_per_hu=HU, tolerance=0.01)
    found = pwls(A, y, weights, QGGMRF(0.15, 100.0), mu_per_hu=HU, start=first)
    return {
        "what": f"PWLS, {where}, from {start}",
        **hu(found.volume.double() / HU, exact.volume / HU),
    }


def refused(what: str, call: Callable[[], Any]) -> Row:
    """A problem without an answer: what is said about it."""
    try:
        call()
    except ValueError as error:
        return {"what": what, "refused": str(error)}
    return {"what": what, "refused": ""}


def spectral(second: Any) -> SpectralModel:
    """Two bins of one column: a falling spectrum, and ``second`` ``(energies,)`` photons above
    it."""
    energies = np.linspace(30.0, 100.0, 36)
    return SpectralModel(energies, np.stack([np.linspace(2e4, 0.0, 36), second])[None])


def bins(beside: float) -> Row:
    """Decomposition by two bins whose spectra differ by so much: exact counts, error in mm and
    its noise."""
    falling = np.linspace(2e4, 0.0, 36)
    model = spectral((1 - beside) * falling + beside * falling[::-1])
    true = torch.tensor([[200.0], [5.0]], dtype=torch.float64)
    counts = model.expected(true)
    found = decompose(counts, model, bias_reduction=False, tolerance=1e-7)
    single = decompose(counts.float(), model, bias_reduction=False, tolerance=1e-7)
    sd = found.covariance[[0, 2]].sqrt()
    return {
        "what": "decomposition, nearly equal bins",
        "beside": beside,
        "in_noise": float(((found.line_integrals - true) / sd).abs().max()),
        "in_noise_float32": float(((single.line_integrals.double() - true) / sd).abs().max()),
        "noise_mm": float(sd.max()),
        "converged": bool(found.converged.all()),
    }


def hard_refusals() -> Iterator[Row]:
    """Singular problems."""
    yield refused("two bins of one spectrum", lambda: spectral(3.0 * np.linspace(2e4, 0.0, 36)))
    yield refused("two bins, one of them empty", lambda: spectral(np.zeros(36)))
    responses = noise((2, 6, 8)).double().numpy()
    yield refused("observer of 8 channels from 6 pairs", lambda: hotelling_scores(*responses))
    responses = noise((2, 40, 8)).double().numpy()
    responses[..., 7] = responses[..., 0]
    yield refused("observer of two equal channels", lambda: hotelling_scores(*responses))


def hard(terms: int) -> Iterator[Row]:
    """All hard cases."""
    yield sums(terms)
    for scale in (1e30, 1e-30, 1e-41):
        yield from scaled(scale)
    for air in (1e3, 1e5, 1e7, 1e9):
        yield logarithm(air)
    for beside in (0.0, 1e-12, 1e-8, 1e-4):
        yield diagonal(beside)
    for share in (1e-6, 1e-12, 1e-30):
        yield light_weights(share)
    for where in ("inset", "whole field"):
        for start in ("zero", "noise", "10⁴ HU"):
            yield starts(where, start)
    for beside in (1.0, 1e-2, 1e-4):
        yield bins(beside)
    yield from hard_refusals()


UNITS = {
    "relative": "relative error",
    "rms": "rms",
    "worst": "worst",
    "in_noise": "worst in SDs of its noise",
    "in_noise_float32": "the same of float32 counts",
    "adjoint": "adjoint against forward",
    "noise_mm": "noise, mm",
    "converged": "converged",
    "refused": "refused: “",
}


def report(found: dict[str, Any]) -> str:
    """Both tables as Markdown."""
    sizes = sorted({r["n"] for r in found["table"]})
    lines = [
        "# Float32 against float64",
        "",
        "Written by `python tests/bench/precision.py --keep`, which says what is compared.",
        "Difference of the two over the rms of the float64 result, of PWLS and MBIR in HU: rms "
        "(worst), for planes of",
        "n² and volumes of n²·n/2 voxels.",
        "",
        "| n | " + " | ".join(map(str, sizes)) + " |",
        "|---" * (len(sizes) + 1) + "|",
    ]
    for what in dict.fromkeys(r["what"] for r in found["table"]):
        cells = {
            r["n"]: f"{r['rms']:.1e} ({r['worst']:.1e})"
            for r in found["table"]
            if r["what"] == what
        }
        lines.append(f"| {what} | " + " | ".join(cells.get(n, "") for n in sizes) + " |")
    lines += ["", "| hard on float32 | of | found |", "|---|---|---|"]
    for row in found["hard"]:
        of = ", ".join(
            f"{k} {v:g}"
            for k, v in row.items()
            if k in ("terms", "scale", "air", "beside", "share")
        )
        values = []
        for key, text in UNITS.items():
            if key in row:
                value = row[key]
                values.append(
                    f"{text}{value}”"
                    if key == "refused"
                    else text
                    if value is True
                    else f"not {text}"
                    if value is False
                    else f"{text} {value:.1e}"
                )
        lines.append(f"| {row['what']} | {of} | {'; '.join(values)} |")
    return "\n".join([*lines, "", NOTES])


NOTES = """\
* A sums along rows and columns first and takes differences then, so its rounding grows with n;
  Aᵀ's hardly does.
* FBP's rounding is below 0.01 HU at every size.
* Below 1e-38 float32 has ever fewer bits (seven at 1e-41 · 0.02), and results are as coarse.
* The PWLS insets are tiny and starved (noise of 600 HU), which makes rounding count most: 5e-4 of
  their noise is left.
* MBIR's network works in units of the noise: it has no tolerance, and rounding is all that differs.
* MBIR, joint PWLS and `conjugate_gradient` always start from zero; PWLS alone can be given a start.
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--largest", type=int, default=512, help="voxels along an edge of a plane")
    parser.add_argument("--terms", type=int, default=10**8)
    parser.add_argument("--keep", action="store_true")
    options = parser.parse_args()
    found: dict[str, Any] = {"torch": torch.__version__.partition("+")[0], "table": [], "hard": []}

    def note(part: str, row: Row) -> None:
        found[part].append(row)
        print(part, row, flush=True)

    for row in hard(options.terms):
        note("hard", row)
    for n in (32, 64, 128, 256, 512):
        for beam in BEAMS:
            if n <= (options.largest if beam != "cone" else options.largest // 4):
                for row in operators(beam, n):
                    note("table", row)
    for n in (8, 16, 32):
        if n <= options.largest // 8:
            for row in methods(n):
                note("table", row)
    if options.keep:
        text = json.dumps(found, indent=1, ensure_ascii=False)
        Path(__file__).with_suffix(".json").write_text(text + "\n", encoding="utf-8")
        Path(__file__).with_suffix(".md").write_text(report(found), encoding="utf-8")


if __name__ == "__main__":
    main()
