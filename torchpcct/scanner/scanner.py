"""A scanner: geometry, tube, filters, bowties and detector, and the photons and signals that
follow from them."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchpcct.geometry import ConeBeam, full_turn
from torchpcct.scanner.detector import Detector, SiliconDetector
from torchpcct.scanner.filters import Bowtie, behind_filters
from torchpcct.scanner.linearisation import WaterLinearisation
from torchpcct.scanner.pileup import PileUpMap
from torchpcct.scanner.source import Slabs, Source, slabs
from torchpcct.scene.materials import MATERIALS, Material
from torchpcct.validate import number

__all__ = ["Scanner"]

Floats = NDArray[np.float64]

_SIGMAS = 10.0
"""Standard deviations of the recorded energy within which any photon is recorded."""
PILE_UP_ORDER = 15
"""Coefficients per column of a water correction with pile-up, which bends the curve more."""


@dataclass(frozen=True)
class Scanner:
    """A CT scanner.

    Args:
        name: what it is called.
        geometry: cone beam with the view angles of one turn.
        source: the tube.
        detector: counting or energy integrating (:mod:`torchpcct.scanner.detector`).
        filters: flat slabs in front of the tube, ``((material, mm), …)``; a ray at fan angle γ
            crosses mm / cos γ.
        bowties: one bowtie or a sequence of them, one behind the other.
        energy_bin_kev: width of the energy bins of the simulation in keV, 0.1…5.

    Raises:
        TypeError: a part of the wrong kind.
        ValueError: a value outside its range, thresholds above all energies.
    """

    name: str
    geometry: ConeBeam
    source: Source
    detector: Detector
    filters: Slabs = ()
    bowties: tuple[Bowtie, ...] = ()
    energy_bin_kev: float = 1.0

    def __post_init__(self) -> None:
        for field_name, kind in (
            ("geometry", ConeBeam),
            ("source", Source),
            ("detector", Detector),
        ):
            value = getattr(self, field_name)
            if not isinstance(value, kind):
                raise TypeError(
                    f"{field_name} must be a {kind.__name__}, got {type(value).__name__}"
                )
        if isinstance(self.detector, SiliconDetector):
            lowest, blur = self.detector.thresholds_kev[0], self.detector.sigma_kev
            if lowest > self.source.kvp + _SIGMAS * blur:
                raise ValueError(
                    f"thresholds_kev must begin below the tube's {self.source.kvp:g} kV, got "
                    f"{lowest:g} keV: no photon would be counted"
                )
        bowties = (self.bowties,) if isinstance(self.bowties, Bowtie) else tuple(self.bowties or ())
        if not all(isinstance(b, Bowtie) for b in bowties):
            raise TypeError(f"bowties must be Bowtie objects, got {self.bowties!r}")
        width = number("energy_bin_kev", self.energy_bin_kev, low=0.1, high=5.0, unit="keV")
        object.__setattr__(self, "filters", slabs("filters", self.filters))
        object.__setattr__(self, "bowties", bowties)
        object.__setattr__(self, "energy_bin_kev", width)

    def replace(self, **changes: Any) -> Scanner:
        """A copy with some fields changed."""
        return replace(self, **changes)

    def with_views(self, views: int) -> Scanner:
        """The same scanner with another number of views over one turn."""
        angles = full_turn(views, float(self.geometry.angles[0]))
        return replace(self, geometry=replace(self.geometry, angles=angles))

    def quanta(self) -> tuple[Floats, Floats]:
        """Photons that reach a cell of the central plane (z = 0) in air, per reading and mAs of
        tube load.

        Fluence behind inherent filtration × inverse square of the distance source–cell × cell area
        seen by the beam × transmission of flat filters (oblique path) and bowties. Air itself is
        not in the way.

        Returns:
            ``energies`` (E,) keV and ``photons`` (columns, E), float64, read-only, cached.
        """
        return _quanta(_Optics.of(self))

    def weights(self) -> tuple[Floats, Floats]:
        """Expected signal in air per reading and mAs, by the energy of the photons that make it.

        Returns:
            ``energies`` (E,) keV and ``weights`` (bins, columns, E) in counts or keV, float64,
            read-only, cached: quanta × detector response. Their sum over E is the air reading per
            mAs.
        """
        return _weights(_Optics.of(self), self.detector, False)

    def noise_weights(self) -> tuple[Floats, Floats]:
        """As :meth:`weights`, for the variance of a reading: quanta × second moment of the
        detector's signal.

        The electronic noise ``detector.electronic_noise**2`` comes on top.
        """
        return _weights(_Optics.of(self), self.detector, True)

    @property
    def row_factor(self) -> Floats:
        """Quanta of each row relative to the central plane, ``(rows,)``: inverse square and
        obliquity.

        The longer path through the filters, below 1e-4 at 1° of cone angle, is left out.
        """
        height = self.geometry.row_positions / self.geometry.sdd
        return np.asarray((1.0 + height**2) ** -1.5)

    def mas_per_view(self, exposure_s: float) -> float:
        """Tube load of one view in mAs for a scan of ``exposure_s`` seconds over all views.

        Raises:
            ValueError: ``exposure_s`` ≤ 0 or not finite.
        """
        return (
            self.source.current_ma
            * number("exposure_s", exposure_s, positive=True, unit="s")
            / self.geometry.views
        )

    def pile_up(self) -> PileUpMap | None:
        """What pile-up makes of the expected readings at the tube's current, cached; None without a
        dead time.

        Only what stands before the patient, the detector and the current matter, not the number of
        views.
        """
        if isinstance(self.detector, SiliconDetector) and self.detector.dead_time_ns:
            return _pile_up(_Optics.of(self), self.detector)
        return None

    def behind(self, paths: Mapping[Material, float]) -> Floats:
        """:meth:`weights` behind homogeneous slabs, material → path in mm: ``(bins, columns,
        E)``."""
        energies, weights = self.weights()
        depth = sum(m.attenuation(energies) * float(t) for m, t in paths.items()) if paths else 0.0
        return np.asarray(weights * np.exp(-depth))

    def water_linearisation(self) -> WaterLinearisation:
        """Beam-hardening correction that makes water linear, one polynomial per column; within 2e-5
        of the path.

        Of the sum of all energy bins, and calibrated on what the detector records: pile-up, if the
        detector has a dead time, is part of the curve.
        """
        return _linearisation(_Optics.of(self), self.detector, self.pile_up())


@dataclass(frozen=True)
class _Optics:
    """What the quanta depend on; not on the views, so that scanners with other views share the
    cache."""

    geometry: ConeBeam
    source: Source
    filters: Slabs
    bowties: tuple[Bowtie, ...]
    energy_bin_kev: float

    @classmethod
    def of(cls, scanner: Scanner) -> _Optics:
        geometry = replace(scanner.geometry, angles=np.zeros(1))
        return cls(
            geometry, scanner.source, scanner.filters, scanner.bowties, scanner.energy_bin_kev
        )


@functools.lru_cache(maxsize=8)
def _quanta(optics: _Optics) -> tuple[Floats, Floats]:
    g = optics.geometry
    spectrum = optics.source.spectrum(optics.energy_bin_kev)
    gamma = g.fan_angles
    # The arc stands square to the beam; a flat detector is hit obliquely, at a greater distance.
    obliquity = np.ones_like(gamma) if g.detector == "curved" else np.cos(gamma)
    per_mm2 = (1000.0 * obliquity / g.sdd) ** 2 * obliquity
    photons = np.multiply.outer(per_mm2 * g.pitch[0] * g.pitch[1], spectrum.fluence)
    photons = behind_filters(photons, gamma, spectrum.energies, optics.filters, optics.bowties)
    photons.setflags(write=False)
    return spectrum.energies, photons


@functools.lru_cache(maxsize=8)
def _weights(optics: _Optics, detector: Detector, squared: bool) -> tuple[Floats, Floats]:
    energies, photons = _quanta(optics)
    response = detector.variance(energies) if squared else detector.response(energies)
    weights = photons * response[:, None, :]
    weights.setflags(write=False)
    return energies, weights


@functools.lru_cache(maxsize=4)
def _pile_up(optics: _Optics, detector: SiliconDetector) -> PileUpMap:
    energies, quanta = _quanta(optics)
    # per mA·s times mA
    return PileUpMap.calibrate(detector, energies, quanta * optics.source.current_ma)


@functools.lru_cache(maxsize=16)
def _linearisation(
    optics: _Optics, detector: Detector, pile_up: PileUpMap | None
) -> WaterLinearisation:
    energies, weights = _weights(optics, detector, False)
    combined, water = weights.sum(0), MATERIALS["water"].attenuation(energies)
    if pile_up is None:
        return WaterLinearisation.calibrate(combined, water)
    return WaterLinearisation.calibrate(combined, water, PILE_UP_ORDER, pile_up.shift)
