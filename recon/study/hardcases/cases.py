"""The hard cases: each makes something of a sound scan that happens in practice, and says what a result must be.

Some change the scan, others what is scanned (metal, a calcification, a large patient). A case that leaves the
information in the data (some dead cells, a short scan) has a right answer: that of the sound scan, up to noise. One
that makes the scan's description wrong (centre, gain) has none; it must be noticed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage

from torchpcct.geometry import VolumeGrid
from torchpcct.scan import Scan
from torchpcct.scene import Body, EllipticCylinder, Scene
from torchpcct.scene.plaque import Plaque, plaque_scene
from torchpcct.scene.plaque.variants import calcification_bodies, stent_bodies

__all__ = ["CASES", "Case", "untouched"]


@dataclass(frozen=True)
class Case:
    """One hard case.

    Args:
        title: what is wrong with the scan, a table's cell.
        apply: the noise-free scan, its noisy realisation and a random generator, to the scan that is reconstructed.
        noise: the best that any method can do, as noise over that of the sound scan: lost quanta are lost. What a
            larger body takes comes on top of it.
        scene: the scene around a plaque, if it is another one than the sound scan's; ``apply`` then gets scans of it.
            What it adds to the plaque's own bodies, and the voxels beside that, are left out of the errors.
    """

    title: str
    apply: Callable[[Scan, Scan, np.random.Generator], Scan]
    noise: float = 1.0
    scene: Callable[[Plaque], Scene] | None = None


def untouched(scene: Scene, plaque: Plaque, grid: VolumeGrid) -> NDArray[np.bool_]:
    """Voxels that no body which ``scene`` has beyond those of the plaque touches, nor a neighbour of theirs.

    Args:
        scene: of a case.
        plaque: in it.
        grid: ``(z, y, x)``.

    Returns:
        ``grid.shape``, True where the case shows what the sound scan does.
    """
    own = set(plaque_scene(plaque)[0].names)
    added = [k for k, name in enumerate(scene.names) if name not in own]
    if not added:
        return np.ones(grid.shape, dtype=bool)
    share = scene.volume_fractions(grid)[added].sum(0)
    return ~np.asarray(ndimage.binary_dilation(share > 0, np.ones((3, 3, 3))))


def _lost(share: float) -> Case:
    def apply(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
        lost = torch.from_numpy(rng.random(tuple(scan.counts.shape), dtype=np.float32) < share)
        return replace(scan, counts=scan.counts.masked_fill(lost, 0.0))

    return Case(f"{100 * share:g} % of the readings lost", apply, (1 - share) ** -0.5)


def _cells(title: str, rows: slice, columns: int, factor: float) -> Case:
    """Detector cells near the centre of the first view's shadow, multiplied by ``factor`` in every view."""

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
    """Only some of the views."""

    def apply(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
        assert scan.window is not None
        kept = keep(scan.geometry.views)
        return replace(
            scan, counts=scan.counts[torch.from_numpy(kept)], geometry=scan.geometry.select(kept),
            window=scan.window.select(kept),
        )  # fmt: skip

    return Case(title, apply, (720 / keep(720).size) ** 0.5)


def _dark_views(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
    counts = scan.counts.clone()
    counts[torch.from_numpy(rng.choice(counts.shape[0], 3, replace=False))] = 0
    return replace(scan, counts=counts)


def _centre(columns: float) -> Case:
    def apply(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
        g = scan.geometry
        offset = (g.offset[0], g.offset[1] + columns * g.pitch[1])
        return replace(scan, geometry=replace(g, offset=offset))

    return Case(f"centre wrong by {columns:g} columns", apply)


def _jitter(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
    g = scan.geometry
    step = 2 * np.pi / g.views
    return replace(scan, geometry=replace(g, angles=g.angles + 0.01 * step * rng.standard_normal(g.views)))


def _drift(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
    gain = 1 + 0.01 * torch.linspace(0, 1, scan.counts.shape[0])[:, None, None]
    return replace(scan, counts=torch.round(scan.counts * gain))


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


def _scanned(title: str, scene: Callable[[Plaque], Scene]) -> Case:
    return Case(title, lambda clean, scan, rng: scan, scene=scene)


def _beside(material: str, diameter: float) -> Callable[[Plaque], Scene]:
    """A rod of metal along the vessel, 1 mm of fat between the two."""

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


def _large(plaque: Plaque) -> Scene:
    return plaque_scene(plaque, patient_diameter=500.0)[0]


CASES: dict[str, Case] = {
    "sound": Case("nothing", lambda clean, scan, rng: scan),
    "dose-100th": Case("1/100 of the dose", _hundredth, 10.0),
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
    "motion": Case("strong motion", _moving),
    "spectrum": Case("spectrum off by 2 keV", _harder),
    "bowtie": Case("bowtie 1 mm beside its calibration", _bowtie),
    "truncated": Case("columns cut off inside of the inset's shadow", _narrow),
    "gain-drift": Case("gain drifts by 1 %", _drift),
    "calcification": _scanned("a calcification of 1500 HU beside the lumen", _calcified),
    "stent": _scanned("a stent in the lumen", _stented),
    "metal": _scanned("a titanium rod of 1.2 mm beside the vessel", _beside("titanium", 1.2)),
    "dynamic-range": _scanned("a tungsten rod of 1.2 mm: readings of 1e-6 of those in air", _beside("tungsten", 1.2)),
    "large-body": _scanned("a body of 50 cm", _large),
}
"""Name → case. A new one needs nothing but its entry here."""
