"""What stands between tube and patient: flat slabs, and bowties whose thickness depends on the
fan angle."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import PchipInterpolator

from torchpcct.scanner.source import Slabs
from torchpcct.scene.materials import MATERIALS, Material
from torchpcct.validate import checked, number, numbers

__all__ = ["Bowtie", "large_bowtie", "roi_bowtie"]

Floats = NDArray[np.float64]

# Aluminium path in cm against the fan angle in rad: public "large" bowtie table of the CatSim/XCIST
# simulator, thinned out to where cubic interpolation follows it.
_LARGE_RAD = (
    0.0,
    0.04,
    0.05,
    0.06,
    0.08,
    0.10,
    0.12,
    0.15,
    0.20,
    0.25,
    0.30,
    0.32,
    0.34,
    0.36,
    0.40,
    0.48,
)
"""Fan angles of the nodes of the large bowtie, rad."""
_LARGE_CM = (
    0.2548,
    0.2553,
    0.2574,
    0.2635,
    0.2947,
    0.363,
    0.4791,
    0.738,
    1.363,
    2.157,
    3.013,
    3.2756,
    3.4318,
    3.4967,
    3.564,
    3.712,
)
"""Path through it at the nodes, cm of aluminium."""

ROI_THICKNESS_MM = 39.0
"""Published: thickness of the part that blocks, mm."""
ROI_DIAMETER_MM = 100.0
"""Published: diameter of the region that is spared, mm."""
ROI_DISTANCE_MM = 263.0
"""Published: distance of the filter from the isocentre, mm."""
ROI_RAMP_MM = 15.0
"""Inferred width of the ramp of the region-of-interest bowtie, measured where the bowtie stands. It
is not published; a gradual slope is, and 52 % less dose in the peripheral bores of a 32 cm phantom.
Widths of 0, 15 and 30 mm give 56, 51 and 45 % by unscattered photons."""


@dataclass(frozen=True)
class Bowtie:
    """A bowtie filter, symmetric about the central ray.

    The thickness is the path of a ray in the plane z = 0, interpolated between the nodes by a
    monotone cubic (PCHIP, Fritsch and Carlson 1980) mirrored about γ = 0: smooth, no overshoot.
    Beyond the last node it stays constant.

    Args:
        material: what it is made of.
        fan_angles_rad: nodes γ ≥ 0 in rad, strictly increasing from 0.
        thickness_mm: path length in mm at the nodes, ≥ 0.
        name: what it is called.

    Raises:
        ValueError: nodes that do not increase from 0, a negative or non-finite thickness, lengths
            that differ.
        TypeError: ``material`` is no :class:`~torchpcct.scene.materials.Material`.
    """

    material: Material
    fan_angles_rad: tuple[float, ...]
    thickness_mm: tuple[float, ...]
    name: str = "bowtie"

    def __post_init__(self) -> None:
        if not isinstance(self.material, Material):
            raise TypeError(
                f"material must be a Material, got {self.material!r}: use material('aluminium')"
            )
        angles = numbers("fan_angles_rad", self.fan_angles_rad, high=math.pi / 2, unit="rad")
        thickness = numbers("thickness_mm", self.thickness_mm, low=0.0, unit="mm")
        if len(angles) != len(thickness) or len(angles) < 2:
            raise ValueError(
                f"{self.name}: give at least 2 nodes, as many thicknesses as fan angles"
            )
        if angles[0] != 0 or any(not b > a for a, b in itertools.pairwise(angles)):
            raise ValueError(
                f"{self.name}: fan angles must increase strictly from 0 rad, got {angles}"
            )
        object.__setattr__(self, "fan_angles_rad", angles)
        object.__setattr__(self, "thickness_mm", thickness)

    def thickness(self, fan_angles_rad: ArrayLike) -> Floats:
        """Path length through the filter.

        Args:
            fan_angles_rad: of either sign, of any shape.

        Returns:
            Lengths in mm, of the same shape, float64; beyond the last node that of the last node.
        """
        # Rounded to the picometre: slopes near the smallest float overflow inside the interpolator.
        nodes, values = np.array(self.fan_angles_rad), np.round(self.thickness_mm, 9)
        curve = PchipInterpolator(np.r_[-nodes[:0:-1], nodes], np.r_[values[:0:-1], values])
        return np.asarray(
            curve(np.minimum(np.abs(np.asarray(fan_angles_rad, np.float64)), nodes[-1]))
        )

    def transmission(self, fan_angles_rad: ArrayLike, energies_kev: ArrayLike) -> Floats:
        """Transmitted share of the photons.

        Args:
            fan_angles_rad: of either sign, ``(angles,)``.
            energies_kev: ``(E,)``.

        Returns:
            ``(angles, E)`` float64 in 0 … 1.

        Raises:
            ValueError: energies outside the cross-section table.
        """
        return np.exp(
            -np.multiply.outer(
                self.thickness(fan_angles_rad), self.material.attenuation(energies_kev)
            )
        )


@checked
def large_bowtie() -> Bowtie:
    """Aluminium body bowtie for a large field of view: 2.5 mm at the centre, 37 mm at 0.48 rad."""
    return Bowtie(MATERIALS["aluminium"], _LARGE_RAD, tuple(10.0 * t for t in _LARGE_CM), "large")


@checked
def roi_bowtie(sod: float) -> Bowtie:
    """A bowtie of aluminium that spares a centred region of interest and blocks the rest (Li et
    al., dose study).

    Nothing in the way of rays that cross the region about the isocentre, the full thickness
    outside, and a smooth ramp between. Its material is not published; graphite and PMMA of this
    thickness are too weak.

    Args:
        sod: distance source–isocentre of the scanner in mm.

    Raises:
        ValueError: a source that does not lie beyond the filter.
    """
    number("sod", sod, positive=True, unit="mm")
    if sod <= ROI_DISTANCE_MM:
        raise ValueError(
            f"the filter stands {ROI_DISTANCE_MM:g} mm from the isocentre, the source at {sod:g} mm"
        )
    inner = math.asin(ROI_DIAMETER_MM / 2 / sod)
    outer = math.atan(math.tan(inner) + ROI_RAMP_MM / (sod - ROI_DISTANCE_MM))
    angles = (0.0, inner, outer, min(outer + 0.1, 1.5))
    return Bowtie(
        MATERIALS["aluminium"], angles, (0.0, 0.0, ROI_THICKNESS_MM, ROI_THICKNESS_MM), "roi"
    )


@checked
def behind_filters(
    photons: Floats,
    fan_angles_rad: Floats,
    energies_kev: Floats,
    flat: Slabs,
    bowties: tuple[Bowtie, ...],
) -> Floats:
    """Photons ``(angles, E)`` that pass flat slabs, obliquely, and bowties; ``photons``
    broadcasts to that shape."""
    slab: Floats = sum(
        (m.attenuation(energies_kev) * t for m, t in flat), np.zeros(energies_kev.size)
    )
    photons = photons * np.exp(-np.multiply.outer(1.0 / np.cos(fan_angles_rad), slab))
    for bowtie in bowties:
        photons = photons * bowtie.transmission(fan_angles_rad, energies_kev)
    return photons
