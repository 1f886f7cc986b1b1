"""Photons followed through an edge-on silicon detector: what the one-interaction response leaves
out.

A Compton-scattered photon may interact again, in another strip or depth segment, and count twice; a
tungsten foil may stop it. Counting some photons twice adds noise: with k counts per incident
photon, the zero-frequency detective quantum efficiency of the counts is E[k]² / E[k²] (Rabbani,
Shaw and Van Metter, J. Opt. Soc. Am. A 4, 895, 1987), not the share of photons that count. This
module follows photons one by one to find out. It is a reference for
:class:`~torchpcct.scanner.detector.SiliconDetector`, which lets a photon interact once;
:class:`TransportedSilicon` brings it into scans.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from torchpcct.scanner.compton import ELECTRON_REST_KEV
from torchpcct.scanner.detector import SiliconDetector
from torchpcct.scene.materials import MATERIALS
from torchpcct.validate import checked, number, whole

__all__ = ["TransportedSilicon"]

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_NODES_KEV = np.arange(10.0, 151.0, 2.0)
"""Photon energies that are followed; the difference is smooth between them."""

_MOST_INTERACTIONS = 20
"""A photon is dropped after so many."""

_HEIGHT_KEV = 0.1
"""Step of pulse heights."""
_HEIGHTS = np.arange(0.5 * _HEIGHT_KEV, _NODES_KEV[-1] + 1.0, _HEIGHT_KEV)
"""Pulse heights at which further counts are tabulated, keV."""


@dataclass(frozen=True)
class Stack:
    """Silicon sheets side by side, tungsten foils between them; strips within a sheet have no foil
    between them.

    Args:
        sheet_pitch_mm: from one sheet to the next (foil included).
        foil_mm: thickness of a tungsten foil; 0: none.
        strip_pitch_mm: of the strips within a sheet.

    Raises:
        ValueError: a value out of range, a foil as thick as the pitch.
    """

    sheet_pitch_mm: float = 0.50
    foil_mm: float = 0.02
    strip_pitch_mm: float = 0.35

    def __post_init__(self) -> None:
        number("sheet_pitch_mm", self.sheet_pitch_mm, low=1e-3, high=1e3, unit="mm")
        number("strip_pitch_mm", self.strip_pitch_mm, low=1e-3, high=1e3, unit="mm")
        number(
            "foil_mm",
            self.foil_mm,
            low=0.0,
            high=0.99 * self.sheet_pitch_mm,
            unit="mm (less than the pitch)",
        )


@dataclass(frozen=True)
class Deposits:
    """Energies left in silicon.

    Attributes:
        incident_kev: ``(photons,)`` energies of the incident photons.
        photon: ``(N,)`` index of the incident photon of each deposit.
        sheet, strip, segment: ``(N,)`` where, sheet and strip counted from the cell that the photon
            was aimed at.
        energy_kev: ``(N,)``.
        order: ``(N,)`` 0 for a photon's first interaction, 1 for its second …
    """

    incident_kev: Floats
    photon: Ints
    sheet: Ints
    strip: Ints
    segment: Ints
    energy_kev: Floats
    order: Ints

    @property
    def photons(self) -> int:
        """Number of incident photons."""
        return self.incident_kev.size

    def pulses(self) -> tuple[Ints, Floats]:
        """Incident photon and height in keV of every pulse: of all that one photon left in one
        segment of a strip."""
        keys = np.stack([self.photon, self.sheet, self.strip, self.segment], axis=1)
        places, index = np.unique(keys, axis=0, return_inverse=True)
        return places[:, 0], np.bincount(index.reshape(-1), self.energy_kev).astype(np.float64)

    def counts(
        self,
        threshold_kev: float,
        sigma_kev: float,
        rng: np.random.Generator,
        charge_sharing: float = 0.0,
    ) -> Ints:
        """Counts of every incident photon, ``(photons,)``, over the whole detector.

        What is left in one depth segment of a strip adds up to one pulse.

        Args:
            threshold_kev: a pulse counts above it.
            sigma_kev: standard deviation of a pulse's height.
            rng: of the heights' noise.
            charge_sharing: share of the pulses that split, at a uniformly distributed ratio,
                between two cells.
        """
        owner, heights = self.pulses()
        if charge_sharing:
            split = np.flatnonzero(rng.random(heights.size) < charge_sharing)
            part = rng.random(split.size) * heights[split]
            heights[split] = heights[split] - part
            heights, owner = np.append(heights, part), np.append(owner, owner[split])
        counted = heights + rng.normal(0.0, sigma_kev, heights.size) > threshold_kev
        return np.bincount(owner[counted], minlength=self.photons)


@checked
def follow(
    detector: SiliconDetector,
    energies_kev: ArrayLike,
    weights: ArrayLike,
    photons: int,
    rng: np.random.Generator,
    stack: Stack | None = None,
) -> Deposits:
    """Follow photons that enter the front of the detector along the strips, evenly over one cell.

    Photoelectric absorption leaves all energy where it happens; Compton scattering follows Klein
    and Nishina for free electrons; coherent scatter is left out. What a foil absorbs or scatters is
    lost (fluorescence of tungsten needs more than 69.5 keV and is left out).

    Args:
        detector: its length, dead layer and segments; its ``fill_factor`` is replaced by the foils
            of ``stack``.
        energies_kev, weights: ``(E,)`` spectrum of the incident photons.
        photons: number of incident photons.
        rng: of all random numbers.
        stack: sheets and foils.

    Raises:
        ValueError: no photons, a spectrum without any.
    """
    stack = stack or Stack()
    whole("photons", photons)
    chance = np.asarray(weights, dtype=np.float64)
    if not (np.isfinite(chance).all() and (chance >= 0).all() and chance.sum() > 0):
        raise ValueError("weights must be finite, ≥ 0 and not all 0")
    incident = rng.choice(
        np.atleast_1d(np.asarray(energies_kev, dtype=np.float64)), photons, p=chance / chance.sum()
    )
    energy, index = incident, np.arange(photons)
    # x along the sheet, y across the sheets (a sheet fills 0 … pitch − foil of its period), z
    # depth.
    place = np.zeros((photons, 3))
    place[:, 0] = rng.uniform(0.0, stack.strip_pitch_mm, photons)
    place[:, 1] = rng.uniform(0.0, stack.sheet_pitch_mm, photons)
    direction = np.zeros((photons, 3))
    direction[:, 2] = 1.0
    alive = place[:, 1] < stack.sheet_pitch_mm - stack.foil_mm  # the others meet a foil edge-on
    ends = detector.dead_layer_mm + np.cumsum(detector.segment_mm)
    table = _Attenuation()
    found: list[tuple[Ints | Floats, ...]] = []
    for order in range(_MOST_INTERACTIONS):
        index, place, direction, energy = (
            index[alive],
            place[alive],
            direction[alive],
            energy[alive],
        )
        place, alive = _fly(place, direction, energy, stack, float(ends[-1]), table, rng)
        index, place, direction, energy = (
            index[alive],
            place[alive],
            direction[alive],
            energy[alive],
        )
        absorbed = rng.random(index.size) < table.photo_share(energy)
        scattered, cosine = _scatter(energy, rng)
        left = np.where(absorbed, energy, energy - scattered)
        seen = place[:, 2] >= detector.dead_layer_mm
        sheet = np.floor(place[:, 1] / stack.sheet_pitch_mm).astype(np.int64)
        strip = np.floor(place[:, 0] / stack.strip_pitch_mm).astype(np.int64)
        segment = np.minimum(np.searchsorted(ends, place[:, 2]), ends.size - 1)
        found.append(
            tuple(a[seen] for a in (index, sheet, strip, segment, left, np.full(index.size, order)))
        )
        if index.size == 0:
            break
        direction = _turn(direction, cosine, rng.uniform(0.0, 2.0 * np.pi, index.size))
        energy, alive = scattered, ~absorbed
    photon, sheet, strip, segment, left, orders = (
        np.concatenate(parts) for parts in zip(*found, strict=True)
    )
    return Deposits(incident, photon, sheet, strip, segment, left, orders)


@checked
def efficiency(counts: ArrayLike, task: ArrayLike | None = None) -> tuple[float, float]:
    """Zero-frequency DQE of counts against an ideal energy-resolving detector, and its standard
    error.

    Args:
        counts: ``(photons,)`` counts k of every incident photon.
        task: ``(photons,)`` relative change g of the photon's probability by what is to be
            detected: its attenuation coefficient for a change of thickness or density. None: the
            same for all, E[k]² / E[k²].

    Returns:
        ``E[g k]² / (E[k²] E[g²])`` and its standard error.

    Raises:
        ValueError: shapes that differ.
    """
    k = np.asarray(counts, dtype=np.float64)
    g = np.ones_like(k) if task is None else np.asarray(task, dtype=np.float64)
    if g.shape != k.shape:
        raise ValueError(f"task has shape {g.shape}, counts {k.shape}: they must be equal")
    first, second, third = float((g * k).mean()), float((k * k).mean()), float((g * g).mean())
    if first == 0:
        return 0.0, 0.0
    value = first**2 / (second * third)
    influence = value * (2 * g * k / first - k * k / second - g * g / third)
    return value, float(influence.std() / k.size**0.5)


class _Attenuation:
    """Attenuation in mm⁻¹ from tables, by interpolation."""

    def __init__(self) -> None:
        self.grid = np.linspace(2.0, 200.0, 1981)
        silicon, tungsten = MATERIALS["silicon"], MATERIALS["tungsten"]
        self.photo = silicon.attenuation(self.grid, "photo")
        self.both = self.photo + silicon.attenuation(self.grid, "incoh")
        self.foil = tungsten.attenuation(self.grid, "photo") + tungsten.attenuation(
            self.grid, "incoh"
        )

    def photo_share(self, energy: Floats) -> Floats:
        return np.interp(energy, self.grid, self.photo / self.both)

    def silicon(self, energy: Floats) -> Floats:
        return np.interp(energy, self.grid, self.both)

    def tungsten(self, energy: Floats) -> Floats:
        return np.interp(energy, self.grid, self.foil)


def _fly(
    place: Floats,
    direction: Floats,
    energy: Floats,
    stack: Stack,
    depth: float,
    table: _Attenuation,
    rng: np.random.Generator,
) -> tuple[Floats, NDArray[np.bool_]]:
    """To the next interaction in silicon: places, and whether there is one."""
    place = place.copy()
    silicon = stack.sheet_pitch_mm - stack.foil_mm
    free = rng.exponential(size=energy.size) / table.silicon(energy)  # path in silicon still to go
    through = table.tungsten(energy)
    done = np.zeros(energy.size, dtype=bool)
    lost = np.zeros(energy.size, dtype=bool)
    while True:
        on = np.flatnonzero(~(done | lost))
        if on.size == 0:
            return place, done
        p, d = place[on], direction[on]
        period = np.floor(p[:, 1] / stack.sheet_pitch_mm)
        wall = np.where(
            d[:, 1] > 0, period * stack.sheet_pitch_mm + silicon, period * stack.sheet_pitch_mm
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            to_wall = np.where(d[:, 1] == 0, np.inf, (wall - p[:, 1]) / d[:, 1])
            to_end = np.where(
                d[:, 2] > 0,
                (depth - p[:, 2]) / d[:, 2],
                np.where(d[:, 2] < 0, -p[:, 2] / d[:, 2], np.inf),
            )
        to_wall, to_end = np.maximum(to_wall, 0.0), np.maximum(to_end, 0.0)
        step = np.minimum(np.minimum(to_wall, to_end), free[on])
        stops, leaves = free[on] <= np.minimum(to_wall, to_end), to_end <= to_wall
        place[on] = p + step[:, None] * d
        free[on] -= step
        done[on[stops]] = True
        lost[on[~stops & leaves]] = True
        cross = on[~stops & ~leaves]
        slant = stack.foil_mm / np.abs(direction[cross, 1])
        stopped = rng.random(cross.size) < -np.expm1(-through[cross] * slant)
        lost[cross[stopped]] = True
        passed = cross[~stopped]
        up = direction[passed, 1] > 0
        rest = slant[~stopped]
        place[passed] += rest[:, None] * direction[passed]
        # On the far face exactly, whatever the rounding.
        sheet = np.round((place[passed, 1] - np.where(up, 0.0, silicon)) / stack.sheet_pitch_mm)
        place[passed, 1] = sheet * stack.sheet_pitch_mm + np.where(up, 1e-9, silicon - 1e-9)
        out = (place[passed, 2] < 0) | (place[passed, 2] > depth)
        lost[passed[out]] = True


def _scatter(energy: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Energy after Compton scattering and cosine of the angle: rejection from the flat cosine."""
    cosine, ratio = np.empty(energy.size), np.empty(energy.size)
    left = np.arange(energy.size)
    while left.size:
        c = rng.uniform(-1.0, 1.0, left.size)
        r = 1.0 / (1.0 + energy[left] / ELECTRON_REST_KEV * (1.0 - c))
        keep = rng.uniform(0.0, 2.0, left.size) < r**2 * (r + 1.0 / r - 1.0 + c**2)
        cosine[left[keep]], ratio[left[keep]] = c[keep], r[keep]
        left = left[~keep]
    return energy * ratio, cosine


def _turn(direction: Floats, cosine: Floats, azimuth: Floats) -> Floats:
    """Directions turned by the polar angle of ``cosine`` and ``azimuth`` about themselves."""
    axis = np.where(np.abs(direction[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    a = np.cross(direction, axis)
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    b = np.cross(direction, a)
    sine = np.sqrt(np.maximum(1.0 - cosine**2, 0.0))
    out = cosine[:, None] * direction + sine[:, None] * (
        np.cos(azimuth)[:, None] * a + np.sin(azimuth)[:, None] * b
    )
    return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))


@dataclass(frozen=True)
class TransportedSilicon(SiliconDetector):
    """Edge-on silicon whose photons are followed through all interactions.

    What a photon leaves in other cells is counted as if in its own: right where neighbouring cells
    see the same intensity; the blur and the correlation between neighbours are not modelled. Counts
    stay Poisson here; the noise that counting a photon twice adds is in
    :func:`torchpcct.scanner.silicon_transport.efficiency`.

    Args:
        photons: number of photons followed, evenly over energies of 10…150 keV.
        transport_seed: of them.
        stack: sheets and foils; ``fill_factor`` must be the share of the pitch that the foils
            leave.
        Others: see :class:`torchpcct.scanner.detector.SiliconDetector`.

    Raises:
        ValueError: ``fill_factor`` that contradicts the foils; charge sharing or pile-up, which are
            not followed.
    """

    photons: int = 1_000_000
    transport_seed: int = 0
    stack: Stack = field(default_factory=Stack)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.stack, Stack):
            raise TypeError(f"stack must be a Stack, got {type(self.stack).__name__}")
        whole("photons", self.photons, 1000)
        whole("transport_seed", self.transport_seed, 0)
        share = 1.0 - self.stack.foil_mm / self.stack.sheet_pitch_mm
        if abs(share - self.fill_factor) > 1e-6:
            raise ValueError(
                f"fill_factor must be {share:g}, what the stack's foils leave, got "
                f"{self.fill_factor:g}"
            )
        if self.charge_sharing or self.dead_time_ns:
            raise ValueError(
                "followed photons know neither charge sharing nor pile-up: leave both at 0"
            )

    def above(self, energies_kev: ArrayLike, thresholds_kev: ArrayLike) -> Floats:
        """Expected counts above thresholds per incident photon, ``(thresholds, E)``, with all
        interactions."""
        thresholds = np.atleast_1d(np.asarray(thresholds_kev, dtype=np.float64))
        energies = np.atleast_1d(np.asarray(energies_kev, dtype=np.float64))
        # Bins, blur and mode do not change what is followed: they share the cache.
        more = _further(replace(self, mode="counting", thresholds_kev=(5.0,), sigma_kev=1.0))
        counted = more @ ndtr((_HEIGHTS[:, None] - thresholds) / self.sigma_kev)
        return super().above(energies, thresholds) + np.stack(
            [np.interp(energies, _NODES_KEV, c) for c in counted.T]
        )


@functools.lru_cache(maxsize=4)
def _further(detector: TransportedSilicon) -> Floats:
    """Pulses per photon of all interactions less those of the first alone, ``(nodes, heights)``."""
    rng = np.random.default_rng(detector.transport_seed)
    d = follow(
        detector, _NODES_KEV, np.ones(_NODES_KEV.size), detector.photons, rng, detector.stack
    )
    node = np.searchsorted(_NODES_KEV, d.incident_kev)
    first = d.order == 0
    shape = (_NODES_KEV.size, _HEIGHTS.size)

    def histogram(photon: Ints, height: Floats) -> Floats:
        place = np.minimum((height / _HEIGHT_KEV).astype(np.int64), _HEIGHTS.size - 1)
        flat = np.bincount(node[photon] * _HEIGHTS.size + place, minlength=shape[0] * shape[1])
        return flat.reshape(shape).astype(np.float64)

    difference = histogram(*d.pulses()) - histogram(d.photon[first], d.energy_kev[first])
    return np.asarray(difference / np.bincount(node, minlength=shape[0])[:, None])
