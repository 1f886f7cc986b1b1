"""A whole body in a fan beam, and what happens to its scan: the kinds that need a whole field of view.

A slice of the thorax, 360 views of 240 columns, exact path lengths at 70 keV, Poisson noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from recon.study.hardcases.case import Apply, Case, expected, given, views
from torchpcct.acquisition.path_lengths import tissue_path_lengths
from torchpcct.geometry import ConeBeam, FanBeam, VolumeGrid, full_turn
from torchpcct.scan import Scan
from torchpcct.scanner.linearisation import WaterLinearisation
from torchpcct.scene import Body, EllipticCylinder, Scene
from torchpcct.scene.materials import material
from torchpcct.scene.phantoms import thorax

__all__ = ["BODY_CASES", "GRID", "body_scan", "body_truth"]

KEV, PHOTONS, VIEWS = 70.0, 3e3, 360
GRID = VolumeGrid((116, 158), 2.4, (-34.0, -14.0))
GEOMETRY = FanBeam(full_turn(VIEWS), 541.0, 949.0, 240, 3.6)
WATER = float(np.ravel(material("water").attenuation(KEV))[0])


def body_scan(scene: Scene | None = None) -> Scan:
    """The noise-free scan of the thorax, or of a scene."""
    scene = scene or thorax()
    g = GEOMETRY
    row = ConeBeam(g.angles, g.sod, g.sdd, g.columns, 1, g.pitch)
    groups: dict[float, list[str]] = {}
    for name, tissue in zip(scene.names, scene.materials, strict=True):
        groups.setdefault(float(np.ravel(tissue.attenuation(KEV))[0]), []).append(name)
    paths = tissue_path_lengths(scene, list(groups.values()), row)[:, :, 0]
    lines = torch.tensordot(torch.tensor(list(groups)), paths, dims=1)
    air = torch.full((g.columns,), PHOTONS)
    return Scan((air * torch.exp(-lines)).float(), air, g, _water(g.columns, WATER))


def body_truth(scene: Scene | None = None) -> Tensor:
    """``GRID.shape`` HU."""
    section = VolumeGrid((1, *GRID.shape), (1.0, *GRID.spacing), (0.0, *GRID.center))
    return torch.from_numpy((scene or thorax()).material_map(section, KEV)[0] / WATER * 1000.0 - 1000.0).float()


def _water(columns: int, mu: float) -> WaterLinearisation:
    return WaterLinearisation.polynomial((1.0,), columns, mu)


def _done(title: str, apply: Apply, noise: float = 1.0, **more: Any) -> Case:
    return Case(title, apply, noise, base="body", **more)


def _described(title: str, change: Callable[[FanBeam], FanBeam], unseen: str = "") -> Case:
    """The geometry is described wrongly."""
    return Case(
        title, lambda clean, scan, rng: replace(scan, geometry=change(scan.geometry)), base="body", unseen=unseen
    )


def _read(title: str, change: Callable[[Tensor, Tensor, np.random.Generator], Tensor], noise: float = 1.0) -> Case:
    """What is expected, and in air, to what the detector reads on average; noise comes after it."""
    return Case(title, expected(change), noise, base="body")


def _given(title: str, make: Callable[[Any, Scan], Scan]) -> Case:
    """What a user makes of the readings, an array."""
    return Case(title, given(make), base="body")


def _views(title: str, keep: Callable[[int], np.ndarray]) -> Case:
    return Case(title, views(keep), (VIEWS / keep(VIEWS).size) ** 0.5, base="body")


def _columns(first: float, last: float) -> Apply:
    def apply(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
        g = scan.geometry
        low, high = round(first * g.columns), round(last * g.columns)
        part = replace(g, columns=high - low, offset=g.offset + g.pitch * ((low + high) - g.columns) / 2)
        return replace(
            scan, counts=scan.counts[:, low:high], air=scan.air[low:high], geometry=part,
            linearisation=_water(high - low, WATER),
        )  # fmt: skip

    return apply


def _implants() -> Scene:
    """Two screws of titanium of 12 mm in the muscle of the back."""
    rods = [
        Body(f"implant_{k}", EllipticCylinder(6.0, position=(-14.0 + x, -34.0 - 85.0, 0.0)), "titanium", "muscle")
        for k, x in enumerate((-35.0, 35.0))
    ]
    base = thorax()
    return Scene([*base.bodies, *rods])


def _zeros(views: slice, columns: slice) -> Apply:
    def apply(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
        counts = scan.counts.clone()
        counts[views, columns] = 0.0
        return replace(scan, counts=counts)

    return apply


def _logged(lines: Any, scan: Scan) -> Scan:
    return Scan.from_line_integrals(lines, scan.geometry, mu_water=WATER)


def _from_counts(readings: Any, scan: Scan, air: Any, **options: Any) -> Scan:
    return Scan.from_counts(readings, scan.geometry, air=air, mu_water=WATER, **options)


def _lines(n: Any) -> Any:
    return np.log(PHOTONS / (n + 1.0))


def _spoilt(value: float) -> Callable[[Any, Scan], Scan]:
    def make(n: Any, scan: Scan) -> Scan:
        spoilt = n.copy()
        spoilt[np.random.default_rng(0).random(n.shape) < 0.01] = value
        return _from_counts(spoilt, scan, PHOTONS)

    return make


def _turned(scan: Scan, angles: Any, counts: Tensor | None = None) -> Scan:
    return replace(
        scan, counts=scan.counts if counts is None else counts, geometry=replace(scan.geometry, angles=angles)
    )


def _random(rng: np.random.Generator, *shape: int) -> Tensor:
    return torch.from_numpy(rng.standard_normal(shape)).float()


_TURNED = "the object turned is another object"
_SIZED = "an object that is larger by as much and attenuates as much less has the same line integrals"
_SCALED = "line integrals tell attenuation, not what of it is water's"

_CASES = {
    "sound": _done("nothing", lambda clean, scan, rng: scan),
    # How it is described.
    "step-small": _described("steps between views 2 % too small", lambda g: replace(g, angles=0.98 * g.angles)),
    "step-large": _described("steps between views 2 % too large", lambda g: replace(g, angles=1.02 * g.angles)),
    "inclusive": _described(
        "last view given as the first (inclusive end)",
        lambda g: replace(g, angles=np.linspace(0, 2 * math.pi, g.views)),
    ),
    "direction": _described("turns the other way", lambda g: replace(g, angles=-g.angles)),
    "start": _described("first view 10° wrong", lambda g: replace(g, angles=g.angles + math.radians(10)), _TURNED),
    "sdd-large": _described("sdd 3 % too large", lambda g: replace(g, sdd=1.03 * g.sdd)),
    "sdd-small": _described("sdd 3 % too small", lambda g: replace(g, sdd=0.97 * g.sdd)),
    "sod": _described("sod 3 % too large", lambda g: replace(g, sod=1.03 * g.sod), _SIZED),
    "sod-sdd": _described("sod and sdd 3 % too large", lambda g: replace(g, sod=1.03 * g.sod, sdd=1.03 * g.sdd)),
    "sdd-pitch": _described(
        "sdd and pitch 3 % too large", lambda g: replace(g, sdd=1.03 * g.sdd, pitch=1.03 * g.pitch)
    ),
    "pitch": _described("pitch 3 % too large", lambda g: replace(g, pitch=1.03 * g.pitch)),
    "curved": _described("flat detector given as curved", lambda g: replace(g, detector="curved")),
    "centre-0.5": _described("centre wrong by 0.5 columns", lambda g: replace(g, offset=0.5 * g.pitch)),
    "centre-2": _described("centre wrong by 2 columns", lambda g: replace(g, offset=-2.0 * g.pitch)),
    "quarter": _done(
        "quarter offset of the wrong sign", lambda clean, scan, rng: replace(
            scan, counts=scan.counts.roll(1, -1), geometry=replace(scan.geometry, offset=-0.5 * scan.geometry.pitch)
        ),
    ),
    "reversed": _done("columns reversed", lambda clean, scan, rng: replace(scan, counts=scan.counts.flip(-1))),
    "swapped": _done(
        "views and columns swapped", lambda clean, scan, rng: _turned(
            scan, full_turn(240), scan.counts[:240].T.contiguous()
        ),
    ),
    "not-square": _given("views and columns swapped, not square", lambda n, s: _from_counts(n.T.copy(), s, PHOTONS)),
    "order": _done(
        "views in random order, angles not",
        lambda clean, scan, rng: replace(scan, counts=scan.counts[torch.from_numpy(rng.permutation(VIEWS))]),
    ),
    "half-as-full": _done(
        "half a turn given as a whole one",
        lambda clean, scan, rng: _turned(scan, full_turn(VIEWS // 2), scan.counts[: VIEWS // 2]),
    ),
    "full-as-half": _described("a turn given as half a one", lambda g: replace(g, angles=g.angles / 2)),
    "two-turns": _described("a turn given as two", lambda g: replace(g, angles=2 * g.angles)),
    "water": _done(
        "water's attenuation 5 % wrong",
        lambda clean, scan, rng: replace(scan, linearisation=_water(scan.geometry.columns, 1.05 * WATER)),
        unseen=_SCALED,
    ),
    # Which part of it there is.
    "twice": _done(
        "every view stored twice", lambda clean, scan, rng: _turned(
            scan, scan.geometry.angles.repeat(2), scan.counts.repeat_interleave(2, 0)
        ),
    ),
    "short-scan": _views("a short scan of 240°", lambda n: np.arange(n * 240 // 360)),
    "short-step": _done(
        "a short scan, steps 2 % too small", lambda clean, scan, rng: _turned(
            scan, 0.98 * scan.geometry.angles[:240], scan.counts[:240]
        ), 1.5**0.5,
    ),
    "half-turn": _views("half a turn", lambda n: np.arange(n // 2)),
    "gap": _views("40° of views missing", lambda n: np.r_[: n * 100 // 360, n * 140 // 360 : n]),
    "60-views": _views("60 views", lambda n: np.arange(0, n, 6)),
    "cut-both": _done("cut off on both sides", _columns(0.25, 0.75)),
    "cut-little": _done("cut off a little on both sides", _columns(0.16, 0.84)),
    "offset": _done("a detector of three quarters", _columns(0.0, 0.75), 2**0.5),
    "quarter-detector": _done("less than half a detector", _columns(0.0, 0.45)),
    # What the readings are.
    "20-photons": _done(
        "20 photons in air", lambda clean, scan, rng: clean.with_noise(20.0 / PHOTONS, scan.seed or 0),
        (PHOTONS / 20.0) ** 0.5,
    ),
    "log-as-counts": _given("line integrals given as counts", lambda n, s: _from_counts(_lines(n) + 1.0, s, 10.0)),
    "log-as-transmission": _given(
        "line integrals given as transmissions", lambda n, s: _from_counts(_lines(n).clip(0), s, 1.0)
    ),
    "counts-as-log": _given("counts given as line integrals", lambda n, s: _logged(n, s)),
    "transmission-as-log": _given(
        "transmissions given as line integrals", lambda n, s: _logged(n / PHOTONS, s)
    ),
    "transmission": _given("transmissions given as counts", lambda n, s: _from_counts(n / PHOTONS, s, 1.0)),
    "percent": _given(
        "transmissions in per cent given as counts", lambda n, s: _from_counts(100.0 * n / PHOTONS, s, 100.0)
    ),
    "gain": _given("a signal of 40 a photon given as counts", lambda n, s: _from_counts(40.0 * n, s, 40.0 * PHOTONS)),
    "air-twice": _given("air twice too bright", lambda n, s: _from_counts(n, s, 2.0 * PHOTONS)),
    "air-less": _given("air 10 % too dark", lambda n, s: _from_counts(n, s, 0.9 * PHOTONS)),
    "negative": _given("readings of the other sign", lambda n, s: _from_counts(-n, s, PHOTONS)),
    "nan": _given("1 % of the readings NaN", _spoilt(math.nan)),
    "inf": _given("1 % of the readings infinite", _spoilt(math.inf)),
    "dark": _read("a dark signal of 1 % left in", lambda n, air, rng: n + 0.01 * air),
    "scatter": _read("scatter: 5 % of the mean reading", lambda n, air, rng: n + 0.05 * n.mean()),
    "saturation": _read("saturated at half of air", lambda n, air, rng: n.clamp(max=0.5 * float(air.mean()))),
    "pile-up": _read("pile-up of 10 %", lambda n, air, rng: n * torch.exp(0.1 - 0.1 * n / air)),
    "hardening": _read(
        "beam hardening, not corrected", lambda n, air, rng: air * torch.exp(-(p := torch.log(air / n)) + 0.015 * p**2)
    ),
    "lag": _read("5 % of a reading in the next view", lambda n, air, rng: 0.95 * n + 0.05 * n.roll(1, 0)),
    "rings": _read("gains of the columns off by 1 %", lambda n, air, rng: n * (1 + 0.01 * _random(rng, n.shape[1]))),
    "drift": _read("gain drifts by 1 %", lambda n, air, rng: n * (1 + 0.01 * torch.linspace(0, 1, VIEWS)[:, None])),
    "drift-10": _read("gain drifts by 10 %", lambda n, air, rng: n * (1 + 0.1 * torch.linspace(0, 1, VIEWS)[:, None])),
    "flicker": _read("the tube flickers by 2 %", lambda n, air, rng: n * (1 + 0.02 * _random(rng, VIEWS, 1))),
    "dead-column": _done("a dead column", _zeros(slice(None), slice(112, 113))),
    "dead-part": _done("eight columns dead for a fifth of the turn", _zeros(slice(90, 162), slice(112, 120))),
    "dead-views": _done("three views without signal", _zeros(slice(40, 43), slice(None))),
    "hot-column": _read(
        "a column that reads 1.6 times too much",
        lambda n, air, rng: n * torch.where(torch.arange(n.shape[1]) == 112, 1.6, 1.0),
    ),
    "moved": _done(
        "moved by two columns after half a turn", lambda clean, scan, rng: replace(
            scan, counts=torch.cat([scan.counts[:180], scan.counts[180:].roll(2, -1)])
        ),
    ),
    "metal": _done(
        "two titanium screws of 12 mm", lambda clean, scan, rng: scan, scene=lambda plaque: _implants()
    ),
}  # fmt: skip

BODY_CASES = {f"body-{name}": case for name, case in _CASES.items()}
