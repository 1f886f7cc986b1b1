"""CTDI figures of a scanner: dose in the bores of the standard phantom, and their weighted mean.

    CTDI_w = 1/3 · central + 2/3 · mean of the peripheral bores  (IEC 60601-2-44)

Dose is that of the bore's own filling (the plaque study: water) and not the air kerma that a pencil
chamber reads; for the latter give a ``phantom`` whose bores hold air.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from torchpcct.dose.primary import primary_dose
from torchpcct.dose.scatter import monte_carlo_dose
from torchpcct.geometry import VolumeGrid
from torchpcct.scanner import Scanner
from torchpcct.scene import Scene
from torchpcct.scene.phantoms.quality import CTDI_HOLES, ctdi
from torchpcct.validate import checked

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


__all__ = ["CtdiDose", "ctdi_dose"]

Floats = NDArray[np.float64]

_SAMPLES = 60
"""Points of a disc over which a dose is averaged."""
_PIXEL_MM = 1.0
"""Pixel of the dose map that the simulated chamber is read from."""


@dataclass(frozen=True)
class CtdiDose:
    """Dose in the bores of a CTDI phantom, mGy per rotation.

    Attributes:
        central, peripheral: by unscattered photons, mean over the central and over the four
            peripheral bores.
        central_scattered, peripheral_scattered: by scattered photons, 0 where none were asked for.
        central_error, peripheral_error: standard errors of the scattered parts (finite number of
            histories).
    """

    central: float
    peripheral: float
    central_scattered: float = 0.0
    peripheral_scattered: float = 0.0
    central_error: float = 0.0
    peripheral_error: float = 0.0

    @property
    def total_central(self) -> float:
        """Primary and scattered dose in the central bore."""
        return self.central + self.central_scattered

    @property
    def total_peripheral(self) -> float:
        """Primary and scattered dose in the peripheral bores."""
        return self.peripheral + self.peripheral_scattered

    @property
    def weighted(self) -> float:
        """CTDI_w: one third of the central and two thirds of the peripheral dose."""
        return (self.total_central + 2.0 * self.total_peripheral) / 3.0

    @property
    def weighted_error(self) -> float:
        """Standard error of :attr:`weighted`."""
        return math.hypot(self.central_error, 2.0 * self.peripheral_error) / 3.0


def disc_samples(center: ArrayLike, radius: float, count: int = _SAMPLES) -> Floats:
    """``count`` points that fill a disc evenly (sunflower seeds), ``(count, 2)`` of x, y in mm."""
    k = np.arange(count) + 0.5
    r, phi = radius * np.sqrt(k / count), k * (math.pi * (3.0 - math.sqrt(5.0)))
    return np.asarray(center, dtype=np.float64) + np.stack(
        [r * np.cos(phi), r * np.sin(phi)], axis=-1
    )


@checked
def ctdi_dose(
    scanner: Scanner,
    exposure_s: float,
    *,
    phantom: Scene | None = None,
    axial: str = "contiguous",
    quantity: str = "absorbed",
    histories: int = 0,
    seed: int = 0,
) -> CtdiDose:
    """Dose in the bores of a CTDI phantom.

    Args:
        scanner: its fan must cover the phantom, or the outer bores are partly shaded.
        exposure_s: duration of the rotation in s at the source's current.
        phantom: scene with the bodies of :func:`torchpcct.scene.phantoms.quality.ctdi`; None: the
            32 cm body phantom with water in its bores.
        axial, quantity: see :func:`torchpcct.dose.primary_dose`; the default is the primary part of
            CTDI100.
        histories: photons of the Monte Carlo for the scattered part
            (:func:`torchpcct.dose.monte_carlo_dose`); 0: no scatter. 4 million give 1.5 % in the
            central bore.
        seed: of the Monte Carlo.

    Raises:
        ValueError: bad options, a scene without the phantom's bodies; scatter with ``axial`` or
            ``quantity`` other than the default.
    """
    scene = ctdi() if phantom is None else phantom
    holes = [scene[name].shape for name in CTDI_HOLES]
    points = np.stack([disc_samples(h.position[:2], h.semi_axes[0]) for h in holes])  # type: ignore[attr-defined]
    dose = primary_dose(scene, scanner, points, exposure_s, axial=axial, quantity=quantity).mean(-1)
    central, peripheral = float(dose[0]), float(dose[1:].mean())
    if not histories:
        return CtdiDose(central, peripheral)
    if (axial, quantity) != ("contiguous", "absorbed"):
        raise ValueError(
            "scattered dose exists for axial='contiguous' and quantity='absorbed' only"
        )
    half = float(scene.bounding_box()[1, :2].max())
    pixels = 2 * math.ceil(half / _PIXEL_MM) + 4
    grid = VolumeGrid((pixels, pixels), _PIXEL_MM)
    result = monte_carlo_dose(scene, scanner, grid, exposure_s, histories=histories, seed=seed)
    labels = scene.labels(grid)
    index = [scene.index(name) for name in CTDI_HOLES]
    _, c, c_error = result.mean(labels == index[0])
    _, p, p_error = result.mean(np.isin(labels, index[1:]))
    return CtdiDose(central, peripheral, c, p, c_error, p_error)
