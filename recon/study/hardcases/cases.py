"""The hard cases: each makes something of a sound scan that happens in practice, and says what a result must be.

Some change the scan, others what is scanned (metal, a calcification, a large patient). A case that leaves the
information in the data (some dead cells, a short scan) has a right answer: that of the sound scan, up to noise. One
that makes the scan's description wrong (centre, gain) has none; it must be noticed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from scipy import ndimage

from recon.study.hardcases.body import BODY_CASES
from recon.study.hardcases.case import Apply, Case, expected, views
from torchpcct.scan import Scan
from torchpcct.scene import Body, EllipticCylinder, Scene
from torchpcct.scene.plaque import Plaque, plaque_scene
from torchpcct.scene.plaque.variants import calcification_bodies, stent_bodies

__all__ = ["CASES"]


def _lost(share: float) -> Case:
    def apply(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
        lost = torch.from_numpy(rng.random(tuple(scan.counts.shape), dtype=np.float32) < share)
        return replace(scan, counts=scan.counts.masked_fill(lost, 0.0))

    return Case(f"{100 * share:g} % of the readings lost", apply, (1 - share) ** -0.5)


def _cells(title: str, rows: slice, columns: int, factor: float) -> Case:
    """Detector cells near the centre of the first view's footprint, multiplied by ``factor`` in every view."""

    def apply(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
        assert scan.window is not None
        counts, first = scan.counts.clone(), scan.window.first_column
        middle = int(first[0]) + scan.window.columns // 2
        for v in range(counts.shape[0]):
            low, high = max(middle - int(first[v]), 0), max(middle + columns - int(first[v]), 0)
            counts[v, rows, low:high] = torch.round(counts[v, rows, low:high] * factor)
        return replace(scan, counts=counts)

    return Case(title, apply)


def _views(title: str, keep: Callable[[int], np.ndarray]) -> Case:
    return Case(title, views(keep), (720 / keep(720).size) ** 0.5)


def _dark_views(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
    counts = scan.counts.clone()
    counts[torch.from_numpy(rng.choice(counts.shape[0], 3, replace=False))] = 0
    return replace(scan, counts=counts)


def _described(title: str, change: Callable[[Any], Any], unseen: str = "", tissues: bool = False) -> Case:
    """The geometry is described wrongly."""
    return Case(
        title, lambda clean, scan, rng: replace(scan, geometry=change(scan.geometry)), unseen=unseen, tissues=tissues
    )


def _centre(columns: float) -> Case:
    return _described(
        f"centre wrong by {columns:g} columns",
        lambda g: replace(g, offset=(g.offset[0], g.offset[1] + columns * g.pitch[1])),
        tissues=columns == 0.5,
    )


def _jitter(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
    g = scan.geometry
    step = 2 * np.pi / g.views
    return replace(scan, geometry=replace(g, angles=g.angles + 0.01 * step * rng.standard_normal(g.views)))


def _per_view(amplitude: float, drift: bool) -> Apply:
    """A gain that drifts over the scan, or changes at random from view to view."""

    def change(n: Any, air: Any, rng: np.random.Generator) -> Any:
        views = len(n)
        part = torch.linspace(0, 1, views) if drift else torch.from_numpy(rng.standard_normal(views)).float()
        return n * (1 + amplitude * part)[:, None, None]

    return expected(change)


def _cell_gains(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
    """Gains of the cells off by 1 %, which air does not show: rings."""
    assert scan.exposure_s is not None
    gains = 1 + 0.01 * torch.from_numpy(rng.standard_normal(tuple(clean.air.shape))).float()
    return replace(clean, counts=clean.counts * clean._at_window(gains)).with_noise(scan.exposure_s, scan.seed or 0)


def _rolled(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
    """The detector turned by 2° about its normal: a row at the height h reads what lies h tan 2° beside it."""
    assert scan.exposure_s is not None
    assert clean.surround is not None
    still, g = clean._at_window(clean.surround), clean.geometry
    shifts = math.tan(math.radians(2.0)) * g.row_positions / g.pitch[1]
    ratio = (clean.counts / still).numpy()
    moved = [ndimage.shift(ratio[:, k], (0, s), order=1, mode="nearest") for k, s in enumerate(shifts)]
    counts = torch.from_numpy(np.stack(moved, 1)).float() * still
    return replace(clean, counts=counts).with_noise(scan.exposure_s, scan.seed or 0)


def _million(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
    assert scan.exposure_s is not None
    return clean.with_noise(scan.exposure_s * 1e6, scan.seed or 0)


def _harder(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
    """2 keV more: water attenuates 1.2 % less at 64 keV than at 62 keV."""
    air = scan._at_window(scan.air)
    return replace(scan, counts=torch.round(air * (scan.counts / air) ** 0.988))


def _bowtie(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
    """The bowtie three columns (1 mm on the detector) beside where it was in the air calibration."""
    return replace(scan, counts=torch.round(scan.counts * scan._at_window(scan.air.roll(3, -1) / scan.air)))


def _moving(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
    """Everything but its surround swings along x by six columns (1.2 mm) to either side, once in a turn."""
    assert scan.surround is not None
    still = scan._at_window(scan.surround)
    turn = scan.geometry.angles
    shifts = np.round(-6 * np.cos(turn + 0.7) * np.sin(turn)).astype(int).tolist()
    moved = torch.stack([ratio.roll(k, -1) for ratio, k in zip(scan.counts / still, shifts, strict=True)])
    return replace(scan, counts=torch.round(moved * still))


def _narrow(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
    """Only the middle eighth of the columns around the inset was kept."""
    assert scan.window is not None
    w = scan.window
    columns = w.columns // 8
    return scan.crop(replace(w, first_column=w.first_column + (w.columns - columns) // 2, columns=columns))


def _hundredth(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
    assert scan.exposure_s is not None
    return clean.with_noise(scan.exposure_s / 100, scan.seed or 0)


def _shuffled(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
    return _views("", lambda n: rng.permutation(n)).apply(clean, scan, rng)


def _without(gaps: tuple[tuple[float, float], ...]) -> Callable[[int], np.ndarray]:
    """Views outside of some arcs, in degrees."""

    def keep(n: int) -> np.ndarray:
        at = np.arange(n) * 360.0 / n
        return np.flatnonzero(~np.any([(at >= a) & (at < b) for a, b in gaps], axis=0))

    return keep


def _scanned(title: str, scene: Callable[[Plaque], Scene], other: bool = False, tissues: bool = True) -> Case:
    return Case(title, lambda clean, scan, rng: scan, scene=scene, other=other, tissues=tissues)


def _beside(material: str, diameter: float) -> Callable[[Plaque], Scene]:
    """A rod along the vessel, 1 mm of fat between the two."""

    def scene(plaque: Plaque) -> Scene:
        away = (-(plaque.vessel_diameter / 2 + 1.0 + diameter / 2), 0.0, 0.0)
        place = tuple(plaque.to_scanner(away).tolist())
        rod = EllipticCylinder(diameter / 2, 0.49 * plaque.vessel_length, position=place)
        return plaque_scene(plaque, extra=(Body("implant", rod, material, "patient"),))[0]

    return scene


def _stented(plaque: Plaque) -> Scene:
    return plaque_scene(plaque, extra=stent_bodies(plaque, rings=4))[0]


def _calcified(plaque: Plaque) -> Scene:
    return plaque_scene(plaque, extra=calcification_bodies(plaque))[0]


def _unenhanced(plaque: Plaque) -> Scene:
    return plaque_scene(plaque, blood="blood")[0]


def _coreless(plaque: Plaque) -> Scene:
    return plaque_scene(plaque, core_contrast=0.0)[0]


def _large(plaque: Plaque) -> Scene:
    return plaque_scene(plaque, patient_diameter=500.0)[0]


_PLAQUE: dict[str, Case] = {
    "sound": Case("nothing", lambda clean, scan, rng: scan, tissues=True),
    "dose-100th": Case("1/100 of the dose", _hundredth, 10.0, tissues=True),
    "dose-million": Case("a million times the dose", _million, 2**0.5),
    "lost-0.1": _lost(0.001),
    "lost-1": _lost(0.01),
    "lost-10": _lost(0.1),
    "lost-50": _lost(0.5),
    "dead-cell": _cells("a dead cell", slice(10, 11), 1, 0.0),
    "dead-column": _cells("a dead column", slice(None), 1, 0.0),
    "dead-columns": _cells("three dead columns", slice(None), 3, 0.0),
    "dead-row": _cells("a dead row", slice(10, 11), 4000, 0.0),
    "hot-cell": _cells("a cell that reads 1.6 times too much", slice(10, 11), 1, 1.6),
    "dark-views": Case("three views without signal", _dark_views),
    "shuffled": Case("views in random order", _shuffled),
    "gap": _views("40° of views missing", _without(((100, 140),))),
    "two-gaps": _views("two gaps of 20°", _without(((100, 120), (200, 220)))),
    "small-gaps": _views("two gaps of 3°", _without(((100, 103), (200, 203)))),
    "short-scan": _views("a short scan of 240°", _without(((240, 360),))),
    "too-short": _views("half a turn", _without(((180, 360),))),
    "60-views": _views("60 views", lambda n: np.linspace(0, n, 60, endpoint=False).astype(int)),
    "three-views": _views("three views", lambda n: np.linspace(0, n, 3, endpoint=False).astype(int)),
    "jitter": Case("angles jitter by 1 % of a step", _jitter),
    "centre-0.25": _centre(0.25),
    "centre-0.5": _centre(0.5),
    "centre-1": _centre(1.0),
    "centre-2": _centre(2.0),
    "motion": Case("strong motion", _moving, tissues=True),
    "spectrum": Case("spectrum off by 2 keV", _harder),
    "bowtie": Case("bowtie 1 mm beside its calibration", _bowtie),
    "truncated": Case("columns cut off inside of the inset's footprint", _narrow),
    "gain-drift": Case("gain drifts by 1 %", _per_view(0.01, drift=True)),
    "calcification": _scanned("a calcification of 1500 HU beside the lumen", _calcified),
    "stent": _scanned("a stent in the lumen", _stented),
    "metal": _scanned("a titanium rod of 1.2 mm beside the vessel", _beside("titanium", 1.2)),
    "dynamic-range": _scanned("a tungsten rod of 1.2 mm: readings of 1e-6 of those in air", _beside("tungsten", 1.2)),
    "large-body": _scanned("a body of 50 cm", _large, tissues=False),
    "step": _described("steps between views 2 % too small", lambda g: replace(g, angles=0.98 * g.angles)),
    "sdd-large": _described("sdd 3 % too large", lambda g: replace(g, sdd=1.03 * g.sdd), tissues=True),
    "sdd-small": _described("sdd 3 % too small", lambda g: replace(g, sdd=0.97 * g.sdd)),
    "pitch": _described("pitch 3 % too large", lambda g: replace(g, pitch=(g.pitch[0], 1.03 * g.pitch[1]))),
    "rolled": Case("a detector rolled by 2°", _rolled),
    "pile-up": Case("pile-up of 10 %", expected(lambda n, air, rng: n * torch.exp(0.1 - 0.1 * n / air))),
    "scatter": Case("scatter: 5 % of the mean reading", expected(lambda n, air, rng: n + 0.05 * n.mean())),
    "dark": Case("a dark signal of 0.1 % of air left in", expected(lambda n, air, rng: n + 0.001 * air)),
    "saturation": Case(
        "saturated at the mean reading", expected(lambda n, air, rng: n.clamp(max=float(n.mean()))),
    ),
    "lag": Case("5 % of a reading in the next view", expected(lambda n, air, rng: 0.95 * n + 0.05 * n.roll(1, 0))),
    "flicker": Case("the tube flickers by 2 %", _per_view(0.02, drift=False)),
    "rings": Case("gains of the cells off by 1 %", _cell_gains),
    "second-vessel": _scanned("a second enhanced vessel of 3 mm, 1 mm beside", _beside("blood_iodine", 3.0)),
    "unenhanced": _scanned("an unenhanced vessel", _unenhanced, other=True),
    "no-core": _scanned("no core", _coreless, other=True),
}  # fmt: skip

CASES: dict[str, Case] = _PLAQUE | BODY_CASES
"""Name → case. A new one needs nothing but its entry there."""
