"""The X-ray tube: operating point, focal spot, and the spectrum that leaves it."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from torchpcct.scene.materials import MATERIALS, Material
from torchpcct.validate import number, numbers, reals

if TYPE_CHECKING:
    from collections.abc import Iterable


__all__ = ["Source", "Spectrum"]

Floats = NDArray[np.float64]
Slabs = tuple[tuple[Material, float], ...]

ANODE_ANGLE_DEG = 7.0
"""Assumed anode angle of a CT tube."""

INHERENT_ALUMINIUM_MM = 2.5
"""Assumed inherent filtration of tube, window and oil, as aluminium."""

TUBE_OUTPUT = 0.555
"""Assumed photon output relative to spekpy's ideal target. Chosen so that a deep-silicon reading in
air agrees within 2 % with that computed from the 100 kVp, 7° spectrum table of the public
CatSim/XCIST simulator, which the plaque study used: real anodes are rough and give less than the
ideal one."""

THICKEST_MM = 1e6
"""Filters at most, mm: nothing passes a kilometre, not even of air."""
_MOST = 1e9
"""Current in mA and output at most: flash tubes have 1e7 mA."""
_WIDEST_SPOT_MM = 100.0
"""Focal spots at most: the largest sources, of cobalt, have 20 mm; of µm taken for mm they have
hundreds."""
_NEGLIGIBLE = 1e-6
"""Bins are dropped at both ends of the spectrum where together they hold less than this share of
the photons."""


def slabs(name: str, value: Iterable[tuple[Material, float]]) -> Slabs:
    """Validate ``((material, thickness in mm), …)``: homogeneous slabs that every ray crosses.

    Raises:
        TypeError: not a sequence of (Material, number) pairs.
        ValueError: a negative or non-finite thickness.
    """
    try:
        pairs = tuple((m, float(t)) for m, t in value)
    except (TypeError, ValueError):
        raise TypeError(
            f"{name} must be a sequence of (material, thickness in mm) pairs, got {value!r}"
        ) from None
    for m, t in pairs:
        if not isinstance(m, Material):
            raise TypeError(
                f"{name} must hold (Material, mm) pairs, got {m!r}: use material('aluminium')"
            )
        number(f"{name}: thickness of {m.name}", t, low=0.0, high=THICKEST_MM, unit="mm")
    return pairs


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Photons per energy bin.

    Attributes:
        energies: ``(E,)`` bin centres in keV, increasing.
        fluence: ``(E,)`` photons per bin, mm² and mAs at 1 m from the focal spot.
    """

    energies: Floats
    fluence: Floats

    @property
    def total(self) -> float:
        """Photons / mm² / mAs at 1 m."""
        return float(self.fluence.sum())

    @property
    def mean_energy(self) -> float:
        """Photon-weighted mean energy in keV."""
        return float(self.energies @ self.fluence / self.fluence.sum())


@dataclass(frozen=True)
class Source:
    """A tungsten-anode tube.

    The spectrum is spekpy's (Poludniowski et al. 2021, Casnati/NIST bremsstrahlung and
    characteristic model "casim") behind ``filtration``, times ``output``. The heel effect and
    off-focal radiation are not modelled.

    Args:
        kvp: tube voltage in kV, 20…150.
        current_ma: tube current in mA.
        focal_spot: ``(width, length)`` in mm: width across the fan (along the columns), length
            along z as seen from the isocentre. ``(0, 0)`` is a point.
        anode_angle_deg: anode angle in degrees, 3…45.
        filtration: inherent filtration of the tube, ``((material, mm), …)``.
        output: photon output relative to spekpy's ideal target, or to ``table``.
        table: a measured or tabulated spectrum instead of spekpy's, ``(energies in keV, photons /
            mm² / mAs at 1 m)``, already behind ``filtration``; see :meth:`tabulated`.

    Raises:
        ValueError: a value outside its range, a focal spot that is not two numbers; no filtration
            at all (unfiltered spectra are dominated by photons below 10 keV, which no patient beam
            contains).
        TypeError: filtration of the wrong form, a value that is no number.
    """

    kvp: float = 100.0
    current_ma: float = 1000.0
    focal_spot: tuple[float, float] = (0.5, 0.5)
    anode_angle_deg: float = ANODE_ANGLE_DEG
    filtration: Slabs = field(
        default_factory=lambda: ((MATERIALS["aluminium"], INHERENT_ALUMINIUM_MM),)
    )
    output: float = TUBE_OUTPUT
    table: tuple[tuple[float, ...], tuple[float, ...]] | None = None

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        set_(self, "kvp", number("kvp", self.kvp, low=20.0, high=150.0, unit="kV"))
        set_(
            self,
            "anode_angle_deg",
            number("anode_angle_deg", self.anode_angle_deg, low=3.0, high=45.0, unit="°"),
        )
        set_(
            self,
            "current_ma",
            number("current_ma", self.current_ma, positive=True, high=_MOST, unit="mA"),
        )
        set_(
            self,
            "output",
            number("output", self.output, positive=True, high=_MOST, unit="times spekpy's output"),
        )
        spot = numbers("focal_spot", self.focal_spot, 2, low=0.0, high=_WIDEST_SPOT_MM, unit="mm")
        set_(self, "focal_spot", spot)
        set_(self, "filtration", slabs("filtration", self.filtration))
        if self.table is not None:
            set_(self, "table", _table(self.table))
        elif not any(t > 0 for _, t in self.filtration):
            raise ValueError(
                "filtration must not be empty: a tube has at least about 2 mm aluminium equivalent"
            )

    @classmethod
    def tabulated(
        cls, energies_kev: Iterable[float], fluence: Iterable[float], **changes: Any
    ) -> Source:
        """A tube with a measured or tabulated spectrum.

        Args:
            energies_kev: ``(E,)`` energies in keV, increasing.
            fluence: ``(E,)`` photons per entry, mm² and mAs at 1 m, behind the tube's inherent
                filtration.
            changes: other fields; ``output`` is 1, ``kvp`` the highest energy unless given.

        Raises:
            ValueError: tables of different lengths, energies that do not increase, negative or no
                photons.
        """
        energies = tuple(float(v) for v in energies_kev)
        table = (energies, tuple(float(v) for v in fluence))
        return cls(
            **{
                "kvp": max(energies, default=0.0),
                "output": 1.0,
                "filtration": (),
                "table": table,
                **changes,
            }
        )

    def spectrum(self, bin_kev: float = 1.0) -> Spectrum:
        """Photons / mm² / mAs at 1 m behind the tube's inherent filtration.

        Args:
            bin_kev: bin width in keV, 0.1…5.

        Returns:
            :class:`Spectrum`; the negligible bins at its ends are left out. Cached: spekpy takes a
            second.

        Raises:
            ValueError: ``bin_kev`` out of range.
        """
        width = number("bin_kev", bin_kev, low=0.1, high=5.0, unit="keV")
        if self.table is not None:
            return _rebinned(self.table, self.output, width)
        return _spectrum(self.kvp, self.anode_angle_deg, self.filtration, self.output, width)


def _table(value: object) -> tuple[tuple[float, ...], tuple[float, ...]]:
    if not isinstance(value, tuple | list | np.ndarray) or len(value) != 2:
        raise TypeError(f"table must be a pair, energies in keV and fluences, got {value!r:.60}")
    energies, fluence = (reals("table", v) for v in value)
    if energies.ndim != 1 or energies.shape != fluence.shape or energies.size == 0:
        raise ValueError(
            f"table must hold as many fluences as energies, got {energies.shape} and "
            f"{fluence.shape}"
        )
    if not (np.isfinite(energies).all() and energies[0] > 0 and (np.diff(energies) > 0).all()):
        raise ValueError("table energies must be finite, > 0 keV and strictly increasing")
    if not (np.isfinite(fluence).all() and (fluence >= 0).all() and fluence.sum() > 0):
        raise ValueError("table fluences must be finite, ≥ 0 and not all 0")
    return tuple(energies.tolist()), tuple(fluence.tolist())


@functools.lru_cache(maxsize=8)
def _rebinned(
    table: tuple[tuple[float, ...], tuple[float, ...]], output: float, bin_kev: float
) -> Spectrum:
    energies, fluence = np.array(table[0]), output * np.array(table[1])
    # Photon number and energy are kept: a bin stands at the mean energy of its photons. An energy
    # on an edge (up to round-off) belongs to the upper bin.
    index = np.floor(energies / bin_kev + 1e-9).astype(np.int64)
    index -= index[0]
    photons: Floats = np.bincount(index, fluence).astype(np.float64)
    filled = photons > 0
    return _trimmed(
        np.bincount(index, fluence * energies)[filled] / photons[filled], photons[filled]
    )


@functools.lru_cache(maxsize=32)
def _bare_tube(kvp: float, anode_angle_deg: float, bin_kev: float) -> tuple[Floats, Floats]:
    import spekpy  # loads slowly; tabulated spectra do without it

    # z = 100 cm and 1 mAs; spekpy counts photons per cm² and bin.
    tube = spekpy.Spek(kvp=kvp, th=anode_angle_deg, dk=bin_kev, z=100.0, mas=1.0, physics="casim")
    energies, fluence = tube.get_spectrum(diff=False)
    return np.array(energies, dtype=np.float64), np.array(fluence, dtype=np.float64) / 100.0


@functools.lru_cache(maxsize=32)
def _spectrum(
    kvp: float, angle: float, filtration: Slabs, output: float, bin_kev: float
) -> Spectrum:
    energies, fluence = _bare_tube(kvp, angle, bin_kev)
    depth = sum(m.attenuation(energies) * t for m, t in filtration)
    fluence = output * fluence * np.exp(-depth)
    return _trimmed(energies, fluence)


def _trimmed(energies: Floats, fluence: Floats) -> Spectrum:
    share = np.cumsum(fluence) / fluence.sum()
    first = int(np.searchsorted(share, _NEGLIGIBLE / 2))
    last = int(np.searchsorted(share, 1.0 - _NEGLIGIBLE / 2))
    energies, fluence = energies[first : last + 1].copy(), fluence[first : last + 1].copy()
    energies.setflags(write=False)
    fluence.setflags(write=False)
    return Spectrum(energies, fluence)
