"""The hard cases: each makes something of a sound scan that happens in practice, and says what a
result must be.

Some change the scan, others what is scanned (metal, a calcification, a large patient). A case that
leaves the information in the data (some dead cells, a short scan) has a right answer: that of the
sound scan, up to noise. One that makes the scan's description wrong (centre, gain) has none; it
must be noticed.

Three sound scans are made hard: the plaque's; for what needs a whole field of view, a slice of the
thorax in a fan beam, 360 views of 240 columns, exact path lengths at 70 keV, Poisson noise; and for
what happens along the axis a cylinder of water with balls at several heights in a cone beam.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from torchpcct.acquisition.path_lengths import tissue_path_lengths
from torchpcct.geometry import ConeBeam, FanBeam, VolumeGrid, full_turn
from torchpcct.scan import NOISE_FREE_EXPOSURE_S, Scan
from torchpcct.scanner.linearisation import WaterLinearisation
from torchpcct.scene import Body, EllipticCylinder, Scene
from torchpcct.scene.bodies import Ellipsoid, rotation_matrix
from torchpcct.scene.materials import material
from torchpcct.scene.phantoms import thorax
from torchpcct.scene.plaque import Plaque, plaque_scene
from torchpcct.scene.plaque.variants import calcification_bodies, stent_bodies

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from torchpcct.scene.bodies import Shape
    from torchpcct.typing import Reals


KEV = 70.0
"""Energy of the body's scan and of the cone beam's, keV."""
PHOTONS = 3e3
"""Photons of a reading in air of the body's scan."""
VIEWS = 360
"""Of the body's scan."""
GRID = VolumeGrid((116, 158), 2.4, (-34.0, -14.0))
"""On which the body is reconstructed."""
GEOMETRY = FanBeam(full_turn(VIEWS), 541.0, 949.0, 240, 3.6)
"""Of the body's scan, mm."""
CONE = ConeBeam(full_turn(120), 541.0, 949.0, 112, 12, (4.0, 3.6))
"""Geometry of the cone beam's scan, mm."""
CONE_PHOTONS = 3e4
"""Photons of a reading in air of the cone beam's scan."""
CONE_GRID = VolumeGrid((5, 60, 84), (2.0, 2.4, 2.4))
"""On which the cone beam's scan is reconstructed."""
WATER = float(np.ravel(material("water").attenuation(KEV))[0])
"""Attenuation of water at that energy, mm⁻¹."""

Apply = Callable[[Scan, Scan, np.random.Generator], Scan]
"""The noise-free scan, its noisy realisation and a random generator, to the scan that is
reconstructed."""


@dataclass(frozen=True)
class Case:
    """One hard case.

    Args:
        title: what is wrong with the scan, a table's cell.
        apply: what is done to the scan.
        noise: the best that any method can do, as noise over that of the sound scan: lost quanta
            are lost. What a larger body takes comes on top of it.
        scene: the scene around a plaque, or instead of the body, if it is another one than the
            sound scan's; ``apply`` then gets scans of it. What it adds to the sound scan's own
            bodies, and the voxels beside that, are left out of the errors.
        base: ``"plaque"``, ``"body"`` or ``"cone"``: whose scan is made hard.
        unseen: why no data, or not these, can show it; empty: they can.
        other: the scene's own bodies differ from those of the sound scan: what the case adds to the
            error against its own truth counts.
        tissues: reconstructed by MBIR with tissues, too.
    """

    title: str
    apply: Apply
    noise: float = 1.0
    scene: Callable[[Plaque], Scene] | None = None
    base: str = "plaque"
    unseen: str = ""
    other: bool = False
    tissues: bool = False


def untouched(scene: Scene, sound: Scene, grid: VolumeGrid) -> NDArray[np.bool_]:
    """Mask ``grid.shape`` of the voxels that no body which ``scene`` has beyond those of ``sound``
    touches, nor a neighbour of theirs: there the case shows what the sound scan does."""
    added = [k for k, name in enumerate(scene.names) if name not in set(sound.names)]
    if not added:
        return np.ones(grid.shape, dtype=bool)
    share = scene.volume_fractions(grid)[added].sum(0)
    return ~np.asarray(ndimage.binary_dilation(share > 0, np.ones((3, 3, 3))))


Change = Callable[[Tensor, Tensor, np.random.Generator], Tensor]
"""Readings, those in air at the same cells, and a random generator, to other readings."""


def _redrawn(clean: Scan, scan: Scan, counts: Tensor) -> Scan:
    """Other expected readings with the noise of ``scan``."""
    assert scan.exposure_s is not None
    return replace(clean, counts=counts.float()).with_noise(scan.exposure_s, scan.seed or 0)


def _expected(change: Change) -> Apply:
    """Other expected readings; noise comes after it, the sound scan's."""
    return lambda clean, scan, rng: _redrawn(
        clean, scan, change(clean.counts, clean._at_window(clean.air), rng)
    )


def _piled_up(lost: float) -> Apply:
    """A detector that loses this share of its counts in air to a dead time that pulses prolong, air
    measured alike. Counts so spaced have the variance m (1 − 2 a τ exp(−a τ)) of their mean m (Yu
    and Fessler, Phys. Med. Biol. 45, 2043, 2000), as those of a binomial distribution."""

    def apply(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
        assert scan.exposure_s is not None
        rate = lost * (clean.counts / clean._at_window(clean.air)).double().numpy()
        share = scan.exposure_s / NOISE_FREE_EXPOSURE_S
        mean = share * clean.counts.double().numpy() * np.exp(lost - rate)
        lack = 2.0 * rate * np.exp(-rate)
        counts = rng.binomial(np.round(mean / lack).astype(np.int64), lack)
        return replace(scan, counts=torch.from_numpy(counts).to(scan.counts))

    return apply


def _read(change: Change) -> Apply:
    """Other readings, after the noise."""
    return lambda clean, scan, rng: replace(
        scan, counts=change(scan.counts, scan._at_window(scan.air), rng)
    )


def _views(title: str, keep: Callable[[int], NDArray[np.integer]]) -> Case:
    """Only some of the views."""

    def apply(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
        return scan.select(keep(scan.geometry.views))

    return Case(title, apply, (720 / keep(720).size) ** 0.5)


def _described(
    title: str, change: Callable[[ConeBeam], ConeBeam], unseen: str = "", tissues: bool = False
) -> Case:
    """The geometry is described wrongly."""
    return Case(
        title,
        lambda clean, scan, rng: replace(scan, geometry=change(scan.geometry)),
        unseen=unseen,
        tissues=tissues,
    )


# --- the plaque's scan ----------------------------------------------------------------------------


def _dosed(title: str, factor: float, noise: float, tissues: bool = False) -> Case:
    """Another dose, ``factor`` times that of the sound scan."""

    def apply(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
        assert scan.exposure_s is not None
        return clean.with_noise(scan.exposure_s * factor, scan.seed or 0)

    return Case(title, apply, noise, tissues=tissues)


def _lost(share: float) -> Case:
    def change(n: Tensor, air: Tensor, rng: np.random.Generator) -> Tensor:
        return n.masked_fill(
            torch.from_numpy(rng.random(tuple(n.shape), dtype=np.float32) < share), 0.0
        )

    return Case(f"{100 * share:g} % of the readings lost", _read(change), (1 - share) ** -0.5)


def _cells(title: str, rows: slice, columns: int, factor: float) -> Case:
    """Detector cells near the centre of the first view's footprint, multiplied by ``factor`` in
    every view."""

    def apply(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
        assert scan.window is not None
        counts, first = scan.counts.clone(), scan.window.first_column
        middle = int(first[0]) + scan.window.columns // 2
        for v in range(counts.shape[0]):
            low, high = max(middle - int(first[v]), 0), max(middle + columns - int(first[v]), 0)
            counts[v, rows, low:high] = torch.round(counts[v, rows, low:high] * factor)
        return replace(scan, counts=counts)

    return Case(title, apply)


def _centre(columns: float) -> Case:
    return _described(
        f"centre wrong by {columns:g} columns",
        lambda g: replace(g, offset=(g.offset[0], g.offset[1] + columns * g.pitch[1])),
        tissues=columns == 0.5,
    )


def _jitter(share: float) -> Apply:
    """Angles that scatter by a share of a step."""

    def apply(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
        g = scan.geometry
        step = 2 * np.pi / g.views
        return replace(
            scan, geometry=replace(g, angles=g.angles + share * step * rng.standard_normal(g.views))
        )

    return apply


def _per_view(amplitude: float, drift: bool) -> Apply:
    """A gain that drifts over the scan, or changes at random from view to view."""

    def change(n: Tensor, air: Tensor, rng: np.random.Generator) -> Tensor:
        views = len(n)
        part = (
            torch.linspace(0, 1, views)
            if drift
            else torch.from_numpy(rng.standard_normal(views)).float()
        )
        return n * (1 + amplitude * part).reshape(-1, *(1,) * (n.ndim - 1))

    return _expected(change)


def _cell_gains(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
    """Gains of the cells off by 1 %, which air does not show: rings."""
    gains = 1 + 0.01 * torch.from_numpy(rng.standard_normal(tuple(clean.air.shape))).float()
    return _redrawn(clean, scan, clean.counts * clean._at_window(gains))


def _rolled(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
    """The detector turned by 2° about its normal: a row at the height h reads what lies h tan 2°
    beside it."""
    assert clean.exterior is not None
    still, g = clean._at_window(clean.exterior), clean.geometry
    shifts = math.tan(math.radians(2.0)) * g.row_positions / g.pitch[1]
    ratio = (clean.counts / still).numpy()
    moved = [
        ndimage.shift(ratio[:, k], (0, s), order=1, mode="nearest") for k, s in enumerate(shifts)
    ]
    return _redrawn(clean, scan, torch.from_numpy(np.stack(moved, 1)).float() * still)


def _bowtie(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
    """The bowtie three columns (1 mm on the detector) beside where it was in the air
    calibration."""
    return replace(
        scan, counts=torch.round(scan.counts * scan._at_window(scan.air.roll(3, -1) / scan.air))
    )


def _moving(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
    """Everything but its exterior swings along x by six columns (1.2 mm) to either side, once in
    a turn."""
    assert scan.exterior is not None
    still = scan._at_window(scan.exterior)
    turn = scan.geometry.angles
    shifts = np.round(-6 * np.cos(turn + 0.7) * np.sin(turn)).astype(int).tolist()
    moved = torch.stack(
        [ratio.roll(k, -1) for ratio, k in zip(scan.counts / still, shifts, strict=True)]
    )
    return replace(scan, counts=torch.round(moved * still))


def _narrow(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
    """Only the middle eighth of the columns around the inset was kept."""
    assert scan.window is not None
    w = scan.window
    columns = w.columns // 8
    return scan.crop(
        replace(w, first_column=w.first_column + (w.columns - columns) // 2, columns=columns)
    )


def _without(gaps: tuple[tuple[float, float], ...]) -> Callable[[int], np.ndarray]:
    """Views outside of some arcs, in degrees."""

    def keep(n: int) -> np.ndarray:
        at = np.arange(n) * 360.0 / n
        return np.flatnonzero(~np.any([(at >= a) & (at < b) for a, b in gaps], axis=0))

    return keep


def _scanned(title: str, other: bool = False, tissues: bool = True, **options: Any) -> Case:
    """Another scene about the plaque, by options of its maker; those that hang on the plaque are
    functions of it."""

    def scene(plaque: Plaque) -> Scene:
        return plaque_scene(
            plaque, **{k: v(plaque) if callable(v) else v for k, v in options.items()}
        )[0]

    return Case(title, lambda clean, scan, rng: scan, scene=scene, other=other, tissues=tissues)


def _beside(material: str, diameter: float) -> Callable[[Plaque], tuple[Body, ...]]:
    """A rod along the vessel, 1 mm of fat between the two."""

    def bodies(plaque: Plaque) -> tuple[Body, ...]:
        away = (-(plaque.vessel_diameter / 2 + 1.0 + diameter / 2), 0.0, 0.0)
        place = tuple(plaque.to_scanner(away).tolist())
        rod = EllipticCylinder(diameter / 2, 0.49 * plaque.vessel_length, position=place)
        return (Body("implant", rod, material, "patient"),)

    return bodies


_PLAQUE: dict[str, Case] = {
    "sound": Case("nothing", lambda clean, scan, rng: scan, tissues=True),
    "dose-100th": _dosed("1/100 of the dose", 1 / 100, 10.0, tissues=True),
    "dose-million": _dosed("a million times the dose", 1e6, 2**0.5),
    "lost-0.1": _lost(0.001),
    "lost-1": _lost(0.01),
    "lost-10": _lost(0.1),
    "lost-50": _lost(0.5),
    "dead-cell": _cells("a dead cell", slice(10, 11), 1, 0.0),
    "dead-column": _cells("a dead column", slice(None), 1, 0.0),
    "dead-columns": _cells("three dead columns", slice(None), 3, 0.0),
    "dead-row": _cells("a dead row", slice(10, 11), 4000, 0.0),
    "hot-cell": _cells("a cell that reads 1.6 times too much", slice(10, 11), 1, 1.6),
    "dark-views": Case(
        "three views without signal",
        _read(
            lambda n, air, rng: n.index_fill(
                0, torch.from_numpy(rng.choice(n.shape[0], 3, replace=False)), 0.0
            )
        ),
    ),
    "shuffled": Case(
        "views in random order",
        lambda clean, scan, rng: _views("", rng.permutation).apply(clean, scan, rng),
    ),
    "gap": _views("40° of views missing", _without(((100, 140),))),
    "two-gaps": _views("two gaps of 20°", _without(((100, 120), (200, 220)))),
    "small-gaps": _views("two gaps of 3°", _without(((100, 103), (200, 203)))),
    "short-scan": _views("a short scan of 240°", _without(((240, 360),))),
    "too-short": _views("half a turn", _without(((180, 360),))),
    "60-views": _views("60 views", lambda n: np.linspace(0, n, 60, endpoint=False).astype(int)),
    "three-views": _views(
        "three views", lambda n: np.linspace(0, n, 3, endpoint=False).astype(int)
    ),
    "jitter": Case("angles jitter by 1 % of a step", _jitter(0.01)),
    "centre-0.25": _centre(0.25),
    "centre-0.5": _centre(0.5),
    "centre-1": _centre(1.0),
    "centre-2": _centre(2.0),
    "motion": Case("strong motion", _moving, tissues=True),
    # Water attenuates 1.2 % less at 64 keV than at 62 keV.
    "spectrum": Case(
        "spectrum off by 2 keV", _read(lambda n, air, rng: torch.round(air * (n / air) ** 0.988))
    ),
    "bowtie": Case("bowtie 1 mm beside its calibration", _bowtie),
    "truncated": Case("columns cut off inside of the inset's footprint", _narrow),
    "gain-drift": Case("gain drifts by 1 %", _per_view(0.01, drift=True)),
    "calcification": _scanned(
        "a calcification of 1500 HU beside the lumen", extra=calcification_bodies
    ),
    "stent": _scanned("a stent in the lumen", extra=partial(stent_bodies, rings=4)),
    "metal": _scanned("a titanium rod of 1.2 mm beside the vessel", extra=_beside("titanium", 1.2)),
    "dynamic-range": _scanned(
        "a tungsten rod of 1.2 mm: readings of 1e-6 of those in air", extra=_beside("tungsten", 1.2)
    ),
    "large-body": _scanned("a body of 50 cm", tissues=False, patient_diameter=500.0),
    "step": _described(
        "steps between views 2 % too small", lambda g: replace(g, angles=0.98 * g.angles)
    ),
    "sdd-large": _described(
        "sdd 3 % too large", lambda g: replace(g, sdd=1.03 * g.sdd), tissues=True
    ),
    "sdd-small": _described("sdd 3 % too small", lambda g: replace(g, sdd=0.97 * g.sdd)),
    "pitch": _described(
        "pitch 3 % too large", lambda g: replace(g, pitch=(g.pitch[0], 1.03 * g.pitch[1]))
    ),
    "rolled": Case("a detector rolled by 2°", _rolled),
    "pile-up": Case("pile-up of 10 %", _piled_up(0.1)),
    "scatter": Case(
        "scatter: 5 % of the mean reading", _expected(lambda n, air, rng: n + 0.05 * n.mean())
    ),
    "dark": Case(
        "a dark signal of 0.1 % of air left in", _expected(lambda n, air, rng: n + 0.001 * air)
    ),
    "saturation": Case(
        "saturated at the mean reading",
        _expected(lambda n, air, rng: n.clamp(max=float(n.mean()))),
    ),
    "lag": Case(
        "5 % of a reading in the next view",
        _expected(lambda n, air, rng: 0.95 * n + 0.05 * n.roll(1, 0)),
    ),
    "flicker": Case("the tube flickers by 2 %", _per_view(0.02, drift=False)),
    "rings": Case("gains of the cells off by 1 %", _cell_gains),
    "second-vessel": _scanned(
        "a second enhanced vessel of 3 mm, 1 mm beside", extra=_beside("blood_iodine", 3.0)
    ),
    "unenhanced": _scanned("an unenhanced vessel", other=True, blood="blood"),
    "no-core": _scanned("no core", other=True, core_contrast=0.0),
}
"""Cases of the plaque's scan."""


# --- a whole body ---------------------------------------------------------------------------------


def body_scan(scene: Scene) -> Scan:
    """The noise-free scan of a body, the thorax or another."""
    g = GEOMETRY
    lines = _lines_of(scene, ConeBeam(g.angles, g.sod, g.sdd, g.columns, 1, g.pitch))[:, 0]
    air = torch.full((g.columns,), PHOTONS)
    return Scan((air * torch.exp(-lines)).float(), air, g, _water(g.columns, WATER))


def _lines_of(scene: Scene, g: ConeBeam) -> Tensor:
    """Line integrals ``(views, rows, columns)``."""
    groups: dict[float, list[str]] = {}
    for name, tissue in zip(scene.names, scene.materials, strict=True):
        groups.setdefault(float(np.ravel(tissue.attenuation(KEV))[0]), []).append(name)
    paths = tissue_path_lengths(scene, list(groups.values()), g)
    return torch.tensordot(torch.tensor(list(groups)), paths, dims=1)


def body_truth(scene: Scene) -> Tensor:
    """``GRID.shape`` HU."""
    section = VolumeGrid((1, *GRID.shape), (1.0, *GRID.spacing), (0.0, *GRID.center))
    return torch.from_numpy(scene.material_map(section, KEV)[0] / WATER * 1000.0 - 1000.0).float()


def _water(columns: int, mu: float) -> WaterLinearisation:
    return WaterLinearisation.polynomial((1.0,), columns, mu)


def _columns(first: float, last: float) -> Apply:
    def apply(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
        g = scan.geometry
        low, high = round(first * g.columns), round(last * g.columns)
        part = replace(
            g, columns=high - low, offset=g.offset + g.pitch * ((low + high) - g.columns) / 2
        )
        return replace(
            scan,
            counts=scan.counts[:, low:high],
            air=scan.air[low:high],
            geometry=part,
            linearisation=_water(high - low, WATER),
        )

    return apply


def _implants(_: Plaque) -> Scene:
    """Two screws of titanium of 12 mm in the muscle of the back."""
    rods = [
        Body(
            f"implant_{k}",
            EllipticCylinder(6.0, position=(-14.0 + x, -34.0 - 85.0, 0.0)),
            "titanium",
            "muscle",
        )
        for k, x in enumerate((-35.0, 35.0))
    ]
    return Scene([*thorax().bodies, *rods])


def _zeros(views: slice, columns: slice) -> Apply:
    def change(n: Tensor, air: Tensor, rng: np.random.Generator) -> Tensor:
        n = n.clone()
        n[views, columns] = 0.0
        return n

    return _read(change)


def _given(title: str, change: Callable[[Reals], Reals], air: float | None = PHOTONS) -> Case:
    """What a user makes of an array of readings: counts with these in air; None: line integrals."""

    def apply(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
        n, g = change(scan.counts.numpy()), scan.geometry
        if air is None:
            return Scan.from_line_integrals(n, g, mu_water=WATER)
        return Scan.from_counts(n, g, air=air, mu_water=WATER)

    return Case(title, apply)


def _lines(n: Reals) -> Reals:
    return np.log(PHOTONS / (n + 1.0))


def _spoilt(value: float) -> Callable[[Reals], Reals]:
    return lambda n: np.where(np.random.default_rng(0).random(n.shape) < 0.01, np.float32(value), n)


def _turned(scan: Scan, angles: ArrayLike, counts: Tensor | None = None) -> Scan:
    return replace(
        scan,
        counts=scan.counts if counts is None else counts,
        geometry=replace(scan.geometry, angles=angles),
    )


def _exchanged(n: Tensor, air: Tensor, rng: np.random.Generator) -> Tensor:
    """Two views a quarter of a turn apart."""
    order = torch.arange(len(n))
    order[[50, 140]] = order[[140, 50]]
    return n[order]


def _stuck(n: Tensor, views: slice, columns: slice = slice(None)) -> Tensor:
    """The first of these views again and again, noise and all."""
    n = n.clone()
    n[views, columns] = n[views.start, columns]
    return n


def _shifted(n: Tensor, air: Tensor, columns: NDArray[np.float64]) -> Tensor:
    """Every view moved by so many columns."""
    lines = torch.log(air / n).double().numpy()
    moved = [
        ndimage.shift(row, c, order=3, mode="nearest")
        for row, c in zip(lines, columns, strict=True)
    ]
    return air * torch.exp(-torch.from_numpy(np.stack(moved))).float()


def _swung(amplitude_mm: float, cycles: float) -> Change:
    """The body swings along y: its columns along with it, as far as it lies across the rays."""

    def change(n: Tensor, air: Tensor, rng: np.random.Generator) -> Tensor:
        g = GEOMETRY
        swing = amplitude_mm * np.sin(cycles * (g.angles - g.angles[0]))
        return _shifted(n, air, swing * np.cos(g.angles) * g.magnification / g.pitch)

    return change


def _flying(n: Tensor, air: Tensor, rng: np.random.Generator) -> Tensor:
    """One column to either side, view by view."""
    return _shifted(n, air, np.where(np.arange(len(n)) % 2, 1.0, -1.0))


def _line_integrals(scan: Scan, base: float) -> Scan:
    """Logarithms to another base than e, given as line integrals."""
    lines = torch.log(scan._at_window(scan.air) / scan.counts.clamp_min(0.5)) / base
    return Scan.from_line_integrals(lines.numpy(), scan.geometry, mu_water=WATER)


_TURNED = "the object turned is another object"
"""Why no test can see it: turned."""
_MIRRORED = "the object seen in a mirror is another object"
"""Why no test can see it: mirrored."""
_SIZED = (
    "an object that is larger by as much and attenuates as much less has the same line integrals"
)
"""Why no test can see it: another size."""
_FAINT = "neighbouring views differ by less than their noise"
"""Why no test can see it: noise."""
_PLANE = "only the plane of the source has conjugate rays, and rows beside it are averaged"
"""Why no test can see it: a cone beam's rows."""
_SCALED = "line integrals tell attenuation, not what of it is water's"
"""Why no test can see it: the value of water."""

_BODY: dict[str, Case] = {
    "sound": Case("nothing", lambda clean, scan, rng: scan),
    # How it is described.
    "step-small": _PLAQUE["step"],
    "step-large": _described(
        "steps between views 2 % too large", lambda g: replace(g, angles=1.02 * g.angles)
    ),
    "inclusive": _described(
        "last view given as the first (inclusive end)",
        lambda g: replace(g, angles=np.linspace(0, 2 * math.pi, g.views)),
    ),
    "direction": _described("turns the other way", lambda g: replace(g, angles=-g.angles)),
    "jitter": Case("angles jitter by 30 % of a step", _jitter(0.3), unseen=_FAINT),
    "start": _described(
        "first view 10° wrong", lambda g: replace(g, angles=g.angles + math.radians(10)), _TURNED
    ),
    "sdd-large": replace(_PLAQUE["sdd-large"], tissues=False),
    "sdd-small": _PLAQUE["sdd-small"],
    "sod": _described("sod 3 % too large", lambda g: replace(g, sod=1.03 * g.sod), _SIZED),
    "sod-sdd": _described(
        "sod and sdd 3 % too large", lambda g: replace(g, sod=1.03 * g.sod, sdd=1.03 * g.sdd)
    ),
    "sdd-pitch": _described(
        "sdd and pitch 3 % too large", lambda g: replace(g, sdd=1.03 * g.sdd, pitch=1.03 * g.pitch)
    ),
    "pitch": _described("pitch 3 % too large", lambda g: replace(g, pitch=1.03 * g.pitch)),
    "curved": _described("flat detector given as curved", lambda g: replace(g, detector="curved")),
    "centre-0.5": _described(
        "centre wrong by 0.5 columns", lambda g: replace(g, offset=0.5 * g.pitch)
    ),
    "centre-2": _described(
        "centre wrong by 2 columns", lambda g: replace(g, offset=-2.0 * g.pitch)
    ),
    "quarter": Case(
        "quarter offset of the wrong sign",
        lambda clean, scan, rng: replace(
            scan,
            counts=scan.counts.roll(1, -1),
            geometry=replace(scan.geometry, offset=-0.5 * scan.geometry.pitch),
        ),
    ),
    "reversed": Case("columns reversed", _read(lambda n, air, rng: n.flip(-1))),
    "swapped": Case(
        "views and columns swapped",
        lambda clean, scan, rng: _turned(scan, full_turn(240), scan.counts[:240].T.contiguous()),
    ),
    "not-square": _given("views and columns swapped, not square", lambda n: n.T.copy()),
    "order": Case(
        "views in random order, angles not",
        _read(lambda n, air, rng: n[torch.from_numpy(rng.permutation(VIEWS))]),
    ),
    "text-order": Case(
        "files in the order of the text of their names",
        _read(lambda n, air, rng: n[torch.tensor(sorted(range(VIEWS), key=str))]),
    ),
    "exchanged": Case("two views exchanged", _read(_exchanged)),
    "lost-views": Case(
        "five views lost, the angles taken for even",
        lambda clean, scan, rng: _turned(
            scan, full_turn(VIEWS - 5), torch.cat([scan.counts[:70], scan.counts[75:]])
        ),
    ),
    "stuck": Case("twenty views stuck", _read(lambda n, air, rng: _stuck(n, slice(100, 120)))),
    "stuck-module": Case(
        "32 columns stuck for 60 views",
        _read(lambda n, air, rng: _stuck(n, slice(100, 160), slice(96, 128))),
    ),
    "pairs": Case(
        "neighbouring columns exchanged",
        _read(lambda n, air, rng: n[:, torch.arange(n.shape[1]).reshape(-1, 2).flip(-1).flatten()]),
    ),
    "half-as-full": Case(
        "half a turn given as a whole one",
        lambda clean, scan, rng: _turned(scan, full_turn(VIEWS // 2), scan.counts[: VIEWS // 2]),
    ),
    "full-as-half": _described(
        "a turn given as half a one", lambda g: replace(g, angles=g.angles / 2)
    ),
    "two-turns": _described("a turn given as two", lambda g: replace(g, angles=2 * g.angles)),
    "water": Case(
        "water's attenuation 5 % wrong",
        lambda clean, scan, rng: replace(
            scan, linearisation=_water(scan.geometry.columns, 1.05 * WATER)
        ),
        unseen=_SCALED,
    ),
    "water-cm": Case(
        "water's attenuation given in cm⁻¹",
        lambda clean, scan, rng: replace(
            scan, linearisation=_water(scan.geometry.columns, 10.0 * WATER)
        ),
    ),
    "log10": Case(
        "logarithms to base 10",
        lambda clean, scan, rng: _line_integrals(scan, math.log(10.0)),
    ),
    # Which part of it there is.
    "twice": Case(
        "every view stored twice",
        lambda clean, scan, rng: _turned(
            scan, scan.geometry.angles.repeat(2), scan.counts.repeat_interleave(2, 0)
        ),
    ),
    "short-scan": _PLAQUE["short-scan"],
    "short-step": Case(
        "a short scan, steps 2 % too small",
        lambda clean, scan, rng: _turned(
            scan, 0.98 * scan.geometry.angles[:240], scan.counts[:240]
        ),
        1.5**0.5,
    ),
    "half-turn": _PLAQUE["too-short"],
    "gap": _PLAQUE["gap"],
    "60-views": _views("60 views", lambda n: np.arange(0, n, 6)),
    "cut-both": Case("cut off on both sides", _columns(0.25, 0.75)),
    "cut-little": Case("cut off a little on both sides", _columns(0.16, 0.84)),
    "offset": Case("a detector of three quarters", _columns(0.0, 0.75), 2**0.5),
    "quarter-detector": Case("less than half a detector", _columns(0.0, 0.45)),
    # What the readings are.
    "20-photons": _dosed("20 photons in air", 20.0 / PHOTONS, (PHOTONS / 20.0) ** 0.5),
    "log-as-counts": _given("line integrals given as counts", lambda n: _lines(n) + 1.0, 10.0),
    "log-as-transmission": _given(
        "line integrals given as transmissions", lambda n: _lines(n).clip(0), 1.0
    ),
    "counts-as-log": _given("counts given as line integrals", lambda n: n, None),
    "transmission-as-log": _given(
        "transmissions given as line integrals", lambda n: n / PHOTONS, None
    ),
    "transmission": _given("transmissions given as counts", lambda n: n / PHOTONS, 1.0),
    "percent": _given(
        "transmissions in per cent given as counts", lambda n: 100.0 * n / PHOTONS, 100.0
    ),
    "gain": _given("a signal of 40 a photon given as counts", lambda n: 40.0 * n, 40.0 * PHOTONS),
    "air-twice": _given("air twice too bright", lambda n: n, 2.0 * PHOTONS),
    "air-less": _given("air 10 % too dark", lambda n: n, 0.9 * PHOTONS),
    "negative": _given("readings of the other sign", lambda n: -n),
    "nan": _given("1 % of the readings NaN", _spoilt(math.nan)),
    "inf": _given("1 % of the readings infinite", _spoilt(math.inf)),
    "dark": Case("a dark signal of 1 % left in", _expected(lambda n, air, rng: n + 0.01 * air)),
    "scatter": _PLAQUE["scatter"],
    "saturation": Case(
        "saturated at half of air",
        _expected(lambda n, air, rng: n.clamp(max=0.5 * float(air.mean()))),
    ),
    "pile-up": _PLAQUE["pile-up"],
    "hardening": Case(
        "beam hardening, not corrected",
        _expected(lambda n, air, rng: air * torch.exp(-(p := torch.log(air / n)) + 0.015 * p**2)),
    ),
    "lag": _PLAQUE["lag"],
    "rings": Case(
        "gains of the columns off by 1 %",
        _expected(
            lambda n, air, rng: (
                n * (1 + 0.01 * torch.from_numpy(rng.standard_normal(n.shape[1])).float())
            )
        ),
    ),
    "drift": _PLAQUE["gain-drift"],
    "drift-10": Case("gain drifts by 10 %", _per_view(0.1, drift=True)),
    "flicker": _PLAQUE["flicker"],
    "dead-column": Case("a dead column", _zeros(slice(None), slice(112, 113))),
    "dead-part": Case(
        "eight columns dead for a fifth of the turn", _zeros(slice(90, 162), slice(112, 120))
    ),
    "dead-views": Case("three views without signal", _zeros(slice(40, 43), slice(None))),
    "hot-column": Case(
        "a column that reads 1.6 times too much",
        _expected(lambda n, air, rng: n * torch.where(torch.arange(n.shape[1]) == 112, 1.6, 1.0)),
    ),
    "column-95": Case(
        "the middle column reads 5 % too little",
        _expected(lambda n, air, rng: n * torch.where(torch.arange(n.shape[1]) == 120, 0.95, 1.0)),
    ),
    "breathing": Case("breathing of 6 mm, 2.3 times a turn", _expected(_swung(6.0, 2.3))),
    "breathing-twice": Case("breathing of 6 mm, twice a turn", _expected(_swung(6.0, 2.0))),
    "flying": Case("a focal spot that flies by two columns, ignored", _expected(_flying)),
    "moved": Case(
        "moved by two columns after half a turn",
        _read(lambda n, air, rng: torch.cat([n[:180], n[180:].roll(2, -1)])),
    ),
    "metal": Case("two titanium screws of 12 mm", lambda clean, scan, rng: scan, scene=_implants),
}
"""Cases of the body's scan."""

# --- a cone beam ----------------------------------------------------------------------------------


def balls() -> Scene:
    """An endless cylinder of water with ellipsoids of fat, soft tissue, bone and air at several
    heights."""
    inside = (
        ("fat", (16.0, 20.0, 9.0), (-36.0, 16.0, 3.0), "adipose"),
        ("muscle", (22.0, 13.0, 8.0), (32.0, -14.0, -4.0), "skeletal_muscle"),
        ("bone", (9.0, 9.0, 7.0), (8.0, 34.0, -2.0), "spongiosa"),
        ("vertebra", (12.0, 12.0, 6.0), (0.0, -34.0, 5.0), "cortical_bone"),
        ("lung", (8.0, 8.0, 6.0), (-46.0, -20.0, -6.0), "lung"),
    )
    bodies = [
        Body(n, Ellipsoid(axes, position=at), material, "water") for n, axes, at, material in inside
    ]
    return Scene([Body("water", EllipticCylinder((90.0, 65.0)), "water"), *bodies])


def cone_scan(
    scene: Scene, moved: Callable[[float], tuple[float, float, float]] | None = None
) -> Scan:
    """The noise-free scan of a scene in a cone beam.

    Args:
        scene: at rest.
        moved: of the angle, how far all of it has moved then: x, y, z in mm.
    """
    g = CONE
    if moved is None:
        lines = _lines_of(scene, g)
    else:
        parts = [
            (_displaced(scene, moved(angle)), g.select(slice(k, k + 1)))
            for k, angle in enumerate(g.angles)
        ]
        lines = torch.cat([_lines_of(*part) for part in parts])
    air = torch.full(g.shape[1:], CONE_PHOTONS)
    return Scan((air * torch.exp(-lines)).float(), air, g, _water(g.columns, WATER))


def cone_truth(scene: Scene) -> Tensor:
    """``CONE_GRID.shape`` HU."""
    return torch.from_numpy(scene.material_map(CONE_GRID, KEV) / WATER * 1000.0 - 1000.0).float()


def _displaced(scene: Scene, by: tuple[float, float, float]) -> Scene:
    def there(body: Body) -> Body:
        shape: Shape = body.shape
        return replace(body, shape=replace(shape, position=tuple(np.add(shape.position, by))))

    return Scene([there(body) for body in scene.bodies])


def _travelled(title: str, height: Callable[[float], float]) -> Case:
    """The table moves along z during the turn."""

    def apply(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
        return _redrawn(
            clean, scan, cone_scan(balls(), lambda angle: (0.0, 0.0, height(angle))).counts
        )

    return Case(title, apply)


def _tilted(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
    """Gantry and orbit tilted by 12° about x: to them the scene is."""
    tilt = rotation_matrix((1.0, 0.0, 0.0), math.radians(-12.0))

    def there(body: Body) -> Body:
        shape: Shape = body.shape
        return replace(
            body,
            shape=replace(
                shape, position=tuple(tilt @ shape.position), rotation=tilt @ shape.matrix
            ),
        )

    return _redrawn(clean, scan, cone_scan(Scene([there(body) for body in balls().bodies])).counts)


_CONE: dict[str, Case] = {
    "sound": Case("nothing", lambda clean, scan, rng: scan),
    "helix": _travelled(
        "a helix of 20 mm a turn read as a circle", lambda angle: 20.0 * angle / (2 * math.pi)
    ),
    "sdd": _described("sdd 1 % too large", lambda g: replace(g, sdd=1.01 * g.sdd), _PLANE),
    "jitter": Case("angles jitter by 30 % of a step", _jitter(0.3)),
    "wobble": _travelled(
        "a table that wobbles by 3 mm along z", lambda angle: 3.0 * math.sin(3.0 * angle)
    ),
    "tilt": Case("the gantry tilted by 12°", _tilted, unseen=_TURNED),
    "rows-reversed": Case("rows reversed", _read(lambda n, air, rng: n.flip(1)), unseen=_MIRRORED),
    "order": Case(
        "files in the order of the text of their names",
        _read(lambda n, air, rng: n[torch.tensor(sorted(range(len(n)), key=str))]),
    ),
    "stuck": Case("twelve views stuck", _read(lambda n, air, rng: _stuck(n, slice(40, 52)))),
}
"""Cases of the cone beam's scan."""

CASES: dict[str, Case] = _PLAQUE | {
    f"body-{name}": replace(case, base="body") for name, case in _BODY.items()
}
"""All cases by name."""
CASES |= {f"cone-{name}": replace(case, base="cone") for name, case in _CONE.items()}
"""Name → case. A new one needs nothing but its entry in one of the three tables."""
