"""Detectors: what one incident photon leaves in each reading.

A detector turns photons that reach a cell into *bins* of signal. ``response(energies)`` is the
expected signal per incident photon and ``variance(energies)`` its second moment, so that for
Poisson-distributed photons N(E) the reading of bin i has mean Σ N response_i and variance Σ N
variance_i + electronic_noise². A counting detector has response = variance (a sum of Poisson
numbers is Poisson); an energy-integrating one has one bin, in keV.
"""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from torchpcct.scanner.compton import recoil
from torchpcct.scene.materials import MATERIALS, Material
from torchpcct.validate import choice, number, numbers, whole

__all__ = ["Detector", "Scintillator", "SiliconDetector"]

Floats = NDArray[np.float64]

SILICON_THRESHOLDS_KEV = (5.0, 12.0, 22.0, 32.0, 42.0, 52.0, 62.0, 74.0)
"""Assumed thresholds of the eight energy bins of a deep-silicon detector."""

SILICON_LENGTH_MM = 60.0
"""Assumed length of silicon along the beam, mm."""
SILICON_SEGMENTS = 3
"""Assumed number of depth segments."""
SILICON_SIGMA_KEV = 1.6
"""Assumed energy resolution (standard deviation) of a silicon strip with its electronics, keV."""

SILICON_FILL_FACTOR = 0.96
"""Assumed sensitive share of a cell: tungsten foils of 20 µm between silicon sheets at 0.5 mm
pitch absorb the rest."""

SEGMENT_DESIGN_KEV = 60.0
"""Assumed energy at which the depth segments share the load equally."""

SCINTILLATOR_DEPTH_MM = 3.0
"""Assumed thickness of the scintillator along the beam, mm (public CatSim/XCIST default)."""
SCINTILLATOR_FILL_FACTOR = 0.81
"""Assumed sensitive share of a scintillator cell: 0.9 in either direction (public CatSim/XCIST
default)."""

SCINTILLATOR_NOISE_KEV = 206.0
"""Assumed electronic noise of an energy-integrating cell, per reading: 3500 electrons at 17
electrons per keV (public CatSim/XCIST default)."""

_MODES = ("counting", "spectral")
"""What a detector reads: one number a reading, or one a bin."""


def _halves(nodes: int) -> tuple[Floats, Floats]:
    """Gauss–Legendre nodes and weights of the ratio at which charge is split, 0…1; the nodes are
    symmetric: reversed, they are those of the other part."""
    parts, weights = np.polynomial.legendre.leggauss(nodes)
    return (parts + 1) / 2, weights / 2


_PARTS = _halves(24)
"""Parts of a charge that two cells share, and their weights."""


@runtime_checkable
class Detector(Protocol):
    """What :class:`torchpcct.scanner.Scanner` needs of a detector."""

    @property
    def bins(self) -> int:
        """Number of readings per cell and view."""

    @property
    def energy_integrating(self) -> bool:
        """Whether readings are energies (keV) instead of counts."""

    @property
    def electronic_noise(self) -> float:
        """Standard deviation added to every reading, in its unit (counts or keV)."""

    def response(self, energies_kev: ArrayLike) -> Floats:
        """Expected signal per incident photon, ``(bins, E)``."""

    def variance(self, energies_kev: ArrayLike) -> Floats:
        """Expected squared signal per incident photon, ``(bins, E)``."""

    def __hash__(self) -> int:
        """Detectors are values: equal ones share cached spectra."""


@dataclass(frozen=True)
class SiliconDetector:
    """Edge-on ("deep") silicon strips that count photons in energy bins.

    Model: a photon that reaches the silicon interacts once, photoelectrically (all its energy
    stays: electron range and fluorescence escape are negligible at this size) or by Compton
    scattering (the recoil electron's energy stays, distributed after Klein and Nishina; the
    scattered photon is lost to the tungsten foils or leaves). Coherent scatter is forward peaked
    and taken as no interaction. Energies are blurred by a normal distribution and sorted by the
    thresholds; what lies below the lowest one is lost.

    Args:
        mode: ``"spectral"``: one bin per threshold, the last one open; ``"counting"``: one bin,
            their sum.
        thresholds_kev: lower edges of the bins in keV, increasing.
        length_mm: length of silicon along the beam.
        segments: number of depth segments, read out one by one and summed; they share the count
            rate (:meth:`segment_shares`), which matters for pile-up only.
        sigma_kev: standard deviation of the recorded energy.
        fill_factor: sensitive share of the cell's area (tungsten foils, guard structures).
        dead_layer_mm: insensitive silicon at the entrance.
        charge_sharing: share of the interactions whose charge is split, at a uniformly distributed
            ratio, between two cells; each part counts where it exceeds a threshold. 0 switches it
            off. The correlation that it makes between neighbours is not modelled.
        dead_time_ns: dead time per depth segment after a count; 0 switches pile-up off
            (:mod:`torchpcct.scanner.pileup`).
        merge_ns: time after a count in which further pulses add to its height, at most the dead
            time; it shifts counts to higher bins.

    Raises:
        TypeError: a value that is no number.
        ValueError: a value outside its range, thresholds that do not increase, an unknown mode.
    """

    mode: str = "counting"
    thresholds_kev: tuple[float, ...] = SILICON_THRESHOLDS_KEV
    length_mm: float = SILICON_LENGTH_MM
    segments: int = SILICON_SEGMENTS
    sigma_kev: float = SILICON_SIGMA_KEV
    fill_factor: float = SILICON_FILL_FACTOR
    dead_layer_mm: float = 0.0
    charge_sharing: float = 0.0
    dead_time_ns: float = 0.0
    merge_ns: float = 0.0

    def __post_init__(self) -> None:
        choice("mode", self.mode, _MODES)
        whole("segments", self.segments)
        thresholds = numbers("thresholds_kev", self.thresholds_kev, low=0.0, unit="keV")
        if any(not b > a for a, b in itertools.pairwise(thresholds)):
            raise ValueError(f"thresholds_kev must be increasing, got {self.thresholds_kev!r}")
        object.__setattr__(self, "thresholds_kev", thresholds)
        for name, low, high, unit in (
            ("length_mm", 1e-3, 1e3, "mm"),
            ("sigma_kev", 1e-3, 50.0, "keV"),
            ("fill_factor", 1e-6, 1.0, "(a share of the cell)"),
            ("dead_layer_mm", 0.0, 1e3, "mm"),
            ("charge_sharing", 0.0, 1.0, "(a share of events)"),
            ("dead_time_ns", 0.0, 1e6, "ns"),
            ("merge_ns", 0.0, self.dead_time_ns, "ns (the dead time)"),
        ):
            object.__setattr__(
                self, name, number(name, getattr(self, name), low=low, high=high, unit=unit)
            )

    @property
    def bins(self) -> int:
        """1 in counting mode, else one per threshold."""
        return 1 if self.mode == "counting" else len(self.thresholds_kev)

    @property
    def energy_integrating(self) -> bool:
        return False

    @property
    def electronic_noise(self) -> float:
        """0: the lowest threshold keeps electronic noise out of the counts."""
        return 0.0

    def interaction(self, energies_kev: ArrayLike) -> tuple[Floats, Floats]:
        """Probability of an interaction in the sensitive silicon.

        Args:
            energies_kev: of the incident photons, ``(E,)``.

        Returns:
            Photoelectric and Compton interactions per incident photon, two arrays ``(E,)`` float64.

        Raises:
            ValueError: energies outside the cross-section table.
        """
        photo, compton = (
            MATERIALS["silicon"].attenuation(energies_kev, kind) for kind in ("photo", "incoh")
        )
        both = photo + compton
        reached = self.fill_factor * np.exp(-both * self.dead_layer_mm)
        stopped = reached * -np.expm1(-both * self.length_mm) / both
        return stopped * photo, stopped * compton

    def above(self, energies_kev: ArrayLike, thresholds_kev: ArrayLike) -> Floats:
        """Expected counts above thresholds per incident photon, ``(thresholds, E)``.

        Args:
            energies_kev: ``(E,)`` photon energies in keV.
            thresholds_kev: ``(T,)`` any thresholds in keV (−inf: all interactions).
        """
        return self._above(energies_kev, thresholds_kev, 0.0)

    def photons_above(self, energies_kev: ArrayLike, thresholds_kev: ArrayLike) -> Floats:
        """Photons that count at least once, per incident photon.

        Without charge sharing this equals :meth:`above`; with it a photon may count in two cells,
        or in none.

        Args:
            energies_kev: of the incident photons, ``(E,)``.
            thresholds_kev: ``(thresholds,)``.

        Returns:
            ``(thresholds, E)`` float64.
        """
        return self._above(energies_kev, thresholds_kev, 1.0)

    def _above(self, energies_kev: ArrayLike, thresholds_kev: ArrayLike, both: float) -> Floats:
        """Of a split deposit the chances of both parts to count, less ``both`` times that of
        both at once."""
        energies = np.atleast_1d(np.asarray(energies_kev, dtype=np.float64))
        thresholds = np.atleast_1d(np.asarray(thresholds_kev, dtype=np.float64))
        deposit, chance = self._deposits(energies)
        out = np.empty((thresholds.size, energies.size))
        parts, weights = _PARTS
        for i, t in enumerate(thresholds):
            whole = ndtr((deposit - t) / self.sigma_kev)
            if self.charge_sharing:
                one = [ndtr((u * deposit - t) / self.sigma_kev) for u in parts]
                shared = sum(
                    w * (2.0 * a - both * a * b)
                    for a, b, w in zip(one, one[::-1], weights, strict=True)
                )
                whole = (1 - self.charge_sharing) * whole + self.charge_sharing * shared
            out[i] = (chance * whole).sum(axis=1)
        return out

    def _deposits(self, energies: Floats) -> tuple[Floats, Floats]:
        """All deposits of each photon energy, keV, with their probabilities, ``(E, deposits)``: the
        photopeak first, then the Compton continuum."""
        photo, compton = self.interaction(energies)
        electron, probability = recoil(energies)
        deposit = np.concatenate([energies[:, None], electron], axis=1)
        chance = np.concatenate([photo[:, None], compton[:, None] * probability], axis=1)
        return deposit, chance

    def response(self, energies_kev: ArrayLike) -> Floats:
        """Expected counts per incident photon, ``(bins, E)`` float64."""
        if self.mode == "counting":
            return self.above(energies_kev, self.thresholds_kev[:1])
        cumulative = self.above(energies_kev, self.thresholds_kev)
        cumulative[:-1] -= cumulative[1:]
        return np.maximum(cumulative, 0.0)  # round-off of the difference

    def variance(self, energies_kev: ArrayLike) -> Floats:
        """Equal to :meth:`response`: counts are Poisson."""
        return self.response(energies_kev)

    def joint_counts(self, energies_kev: ArrayLike) -> Floats:
        """Expected products of the counts that one photon leaves in two bins, in all cells
        together, per incident photon: ``(bins, bins, E)``.

        Without charge sharing a photon counts once, and the matrix is diagonal, :meth:`response`.
        With it both parts of a photon may count: Σ_kl w_k w_l of this matrix is the variance of a
        sum with weights over many cells, where the counts of two neighbours are one photon's.
        """
        energies = np.atleast_1d(np.asarray(energies_kev, dtype=np.float64))
        deposit, chance = self._deposits(energies)
        thresholds = self.thresholds_kev[: self.bins]
        out = np.zeros((self.bins, self.bins, energies.size))

        def in_bins(values: Floats) -> list[Floats]:
            above = [ndtr((values - t) / self.sigma_kev) for t in thresholds]
            return [a - b for a, b in itertools.pairwise([*above, np.zeros_like(values)])]

        for k, whole_ in enumerate(in_bins(deposit)):
            out[k, k] = (1.0 - self.charge_sharing) * (chance * whole_).sum(1)
        if not self.charge_sharing:
            return out
        parts, weights = _PARTS
        both = [in_bins(u * deposit) for u in parts]
        for first, second, w in zip(both, both[::-1], weights, strict=True):
            for k, one in enumerate(first):
                # each part by itself, and one together with the other, in either order
                scaled = self.charge_sharing * w * 2.0 * chance * one
                out[k, k] += scaled.sum(1)
                for m, other in enumerate(second):
                    product = 0.5 * (scaled * other).sum(1)
                    out[k, m] += product
                    out[m, k] += product
        return out

    @functools.cached_property
    def segment_mm(self) -> tuple[float, ...]:
        """Length of each depth segment in mm, entrance first: equal numbers of interactions at
        60 keV."""
        mu = float(
            sum(
                MATERIALS["silicon"].attenuation(SEGMENT_DESIGN_KEV, kind)
                for kind in ("photo", "incoh")
            )
        )
        stopped = -math.expm1(-mu * self.length_mm)
        ends = [-math.log1p(-stopped * k / self.segments) / mu for k in range(self.segments + 1)]
        return tuple(b - a for a, b in itertools.pairwise(ends))

    def segment_shares(self, energies_kev: ArrayLike) -> Floats:
        """Share of the interactions that falls into each depth segment, ``(segments, E)``,
        summing to 1."""
        mu = sum(
            MATERIALS["silicon"].attenuation(energies_kev, kind) for kind in ("photo", "incoh")
        )
        ends = np.concatenate([[0.0], np.cumsum(self.segment_mm)])
        left = np.exp(-np.multiply.outer(ends, mu))
        return np.asarray((left[:-1] - left[1:]) / (1.0 - left[-1]))


@dataclass(frozen=True)
class Scintillator:
    """An energy-integrating scintillator: the signal is the absorbed energy in keV.

    Every stopped photon deposits all its energy (K-fluorescence escape and optical gain noise are
    neglected), so the signal per photon is η E and its second moment η E².

    Args:
        material: scintillator (default: the garnet "lumex").
        depth_mm: thickness along the beam.
        fill_factor: sensitive share of the cell's area.
        electronic_noise_kev: standard deviation of the electronic noise per reading, in keV of
            absorbed energy.

    Raises:
        ValueError: a value outside its range.
    """

    material: Material = field(default_factory=lambda: MATERIALS["lumex"])
    depth_mm: float = SCINTILLATOR_DEPTH_MM
    fill_factor: float = SCINTILLATOR_FILL_FACTOR
    electronic_noise_kev: float = SCINTILLATOR_NOISE_KEV

    def __post_init__(self) -> None:
        if not isinstance(self.material, Material):
            raise TypeError(
                f"material must be a Material, got {self.material!r}: use material('lumex')"
            )
        for name, low, high, unit in (
            ("depth_mm", 1e-3, 1e3, "mm"),
            ("fill_factor", 1e-6, 1.0, "(a share of the cell)"),
            ("electronic_noise_kev", 0.0, 1e9, "keV"),
        ):
            object.__setattr__(
                self, name, number(name, getattr(self, name), low=low, high=high, unit=unit)
            )

    @property
    def bins(self) -> int:
        """1."""
        return 1

    @property
    def energy_integrating(self) -> bool:
        return True

    @property
    def electronic_noise(self) -> float:
        """Standard deviation per reading in keV."""
        return self.electronic_noise_kev

    def absorbed(self, energies_kev: ArrayLike) -> Floats:
        """Probability that an incident photon is absorbed, ``(E,)``."""
        energies = np.atleast_1d(np.asarray(energies_kev, dtype=np.float64))
        return np.asarray(
            self.fill_factor * -np.expm1(-self.material.attenuation(energies) * self.depth_mm)
        )

    def response(self, energies_kev: ArrayLike) -> Floats:
        """Expected absorbed energy in keV per incident photon, ``(1, E)`` float64."""
        energies = np.atleast_1d(np.asarray(energies_kev, dtype=np.float64))
        return (self.absorbed(energies) * energies)[None]

    def variance(self, energies_kev: ArrayLike) -> Floats:
        """Expected squared absorbed energy in keV² per incident photon, ``(1, E)`` float64."""
        energies = np.atleast_1d(np.asarray(energies_kev, dtype=np.float64))
        return (self.absorbed(energies) * energies**2)[None]
