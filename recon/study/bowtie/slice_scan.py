"""Scans of one slice with the whole detector, with and without the ROI bowtie: noise, images, residual cupping.

The paper's dose study is two-dimensional and uses an energy-integrating detector without electronic noise behind the
PCCT's tube and bowties. Here its cells are those of the paper's EID-CT, on an arc wide enough for the phantoms (the
PCCT's own field of view of 296 mm is not).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpcct import counting_noise as noise
from torchpcct.acquisition.bodies import BodySet
from torchpcct.acquisition.transmission import Beam, expected_readings, sub_rays
from torchpcct.detector_window import DetectorWindow
from torchpcct.geometry import FanBeam, VolumeGrid
from torchpcct.scanner.linearisation import WaterLinearisation
from torchpcct.volume import to_hu

if TYPE_CHECKING:
    from torchpcct.scanner import Scanner
    from torchpcct.scene import Scene

__all__ = [
    "BOWTIES",
    "SliceScan",
    "polynomial_linearisation",
    "radial_profile",
    "slice_image",
    "slice_scans",
    "wide_scanner",
]

Floats = NDArray[np.float64]

BOWTIES = ("large", "large+roi")

HALF_FAN_RAD = 0.32
"""Half-angle of the fan: holds the thorax with the heart at the isocentre (radius 190 mm)."""

CALIBRATION_ORDER, CALIBRATION_STEP_MM, CALIBRATION_MAX_MM = 5, 10.0, 380.0
"""Beam-hardening correction as published: 5th order, 10 mm steps of water up to 380 mm."""


def wide_scanner(bowtie: str, views: int, detector: str = "eid") -> Scanner:
    """The paper's scanner of the dose study, one detector row.

    Args:
        bowtie: one of :data:`BOWTIES`.
        views: per rotation.
        detector: ``"eid"``: energy-integrating cells of 1.02 × 1.10 mm without electronic noise; ``"silicon"``: the
            PCCT's counting cells of 0.35 × 0.5 mm.

    Raises:
        ValueError: another detector or bowtie.
    """
    from torchpcct.scanner import Scintillator, presets

    if detector not in ("eid", "silicon"):
        raise ValueError(f"detector must be 'eid' or 'silicon', got {detector!r}")
    scanner = presets.pcct(views=views, bowtie=bowtie, rows=1)
    pitch = presets.EID_PITCH_MM if detector == "eid" else presets.PCCT_PITCH_MM
    columns = 2 * math.ceil(HALF_FAN_RAD * scanner.geometry.sdd / pitch[1])
    geometry = replace(scanner.geometry, columns=columns, pitch=pitch)
    if detector == "silicon":
        return scanner.replace(geometry=geometry)
    return scanner.replace(geometry=geometry, detector=Scintillator(electronic_noise_kev=0.0))


@dataclass(frozen=True)
class SliceScan:
    """Expected readings of one slice.

    Attributes:
        geometry: fan beam of the slice.
        mean: ``(views, columns)`` expected signal (keV or counts), float64.
        gain: ``(views, columns)`` variance over mean of the signal: keV per quantum; 1 for counts.
        air: ``(columns,)`` signal in air.
        linearisation: water correction.
    """

    geometry: FanBeam
    mean: Tensor
    gain: Tensor
    air: Tensor
    linearisation: WaterLinearisation

    def line_integrals(self, seed: int | None = None) -> Tensor:
        """Water-linearised line integrals ``(views, columns)`` float32; a seed adds noise, None gives expectations.

        Noise: ``gain`` times a Poisson number of mean ``mean / gain``, which has the exact mean and variance; half a
        quantum in the logarithm as in :meth:`torchpcct.Scan.line_integrals`. Readings of equal expectation carry equal
        noise in every scan of a seed.
        """
        reading = self.mean
        if seed is not None:
            first = np.arange(self.mean.shape[0]) * self.mean.shape[1]
            reading = (noise.poisson(self.mean / self.gain, first, seed) + 0.5) * self.gain
        p = torch.log(self.air) - torch.log(reading)
        return self.linearisation.apply(p.to(torch.float32))


def slice_scans(
    scene: Scene, scanners: Sequence[Scanner], exposure_s: float, linearisations: Sequence[WaterLinearisation] = ()
) -> list[SliceScan]:
    """Expected readings of the slice z = 0 by scanners that differ in their bowties only, in one pass over the rays.

    Each reading is that of its central ray; smooth bodies need no finite beam at the voxels of this study.

    Args:
        scene: bodies at rest.
        scanners: one detector row, equal geometry and spectrum bins.
        exposure_s: of one rotation.
        linearisations: for every scanner; default: :func:`polynomial_linearisation`.

    Raises:
        ValueError: a moving scene, scanners of different geometries.
    """
    g = scanners[0].geometry
    if not scene.is_static or any(s.geometry != g for s in scanners):
        raise ValueError("the scene must stand still and all scanners must have one geometry")
    energies = scanners[0].weights()[0]
    spectra = [w[1][0] for s in scanners for w in (s.weights(), s.noise_weights())]
    kinds, params = scene.pack()
    still = np.zeros((len(scene), g.views, 3))
    bodies = BodySet(kinds, params, scene.contrast(energies), still, still, (0.0, 0.0, math.inf))
    window = DetectorWindow(np.zeros(g.views, np.int64), g.columns, 0, 1)
    beam = Beam(np.stack(spectra), scanners[0].row_factor, (0.0, 0.0), sub_rays(1))
    readings = expected_readings(g, window, bodies, beam, np.zeros(g.views))[:, :, 0]
    scans = []
    for k, scanner in enumerate(scanners):
        load = scanner.mas_per_view(exposure_s)
        mean = readings[2 * k] * load
        air = torch.from_numpy(spectra[2 * k].sum(-1) * load)
        line = linearisations[k] if linearisations else polynomial_linearisation(scanner)
        scans.append(SliceScan(g.central_fan, mean, readings[2 * k + 1] * load / mean, air, line))
    return scans


def polynomial_linearisation(
    scanner: Scanner,
    order: int = CALIBRATION_ORDER,
    step_mm: float = CALIBRATION_STEP_MM,
    max_mm: float = CALIBRATION_MAX_MM,
) -> WaterLinearisation:
    """The paper's beam-hardening correction: per column a polynomial through 0, fitted to equal steps of water.

    The value of water is that of the library's own correction, so that images of both compare.

    Args:
        scanner: of one energy bin.
        order: of the polynomial.
        step_mm, max_mm: calibration thicknesses.

    Raises:
        ValueError: fewer thicknesses than coefficients.
    """
    from torchpcct.scene.materials import MATERIALS

    thickness = np.arange(step_mm, max_mm + 0.5 * step_mm, step_mm)
    if thickness.size < order:
        raise ValueError(f"{thickness.size} thicknesses do not determine {order} coefficients: take smaller steps")
    energies, weights = scanner.weights()
    mu_water = MATERIALS["water"].attenuation(energies)
    transmitted = weights[0] @ np.exp(-np.outer(mu_water, thickness))
    p = np.log(weights[0].sum(-1))[:, None] - np.log(transmitted)
    middle = weights.shape[1] // 2
    mu_ref = WaterLinearisation.calibrate(weights[0, middle : middle + 1], mu_water).mu_ref
    scale = p[:, -1]
    powers = (p / scale[:, None])[..., None] ** np.arange(1, order + 1)
    fits = [np.linalg.lstsq(a, mu_ref * thickness / s, rcond=None)[0] for a, s in zip(powers, scale, strict=True)]
    return WaterLinearisation(np.stack(fits), scale, mu_ref)


def slice_image(scan: SliceScan, grid: VolumeGrid, kernel: str, seed: int | None = None) -> Floats:
    """FBP of a slice in HU, ``grid.shape`` float64."""
    from recon.fbp.fbp import fbp

    image = fbp(scan.line_integrals(seed), scan.geometry, grid, kernel)
    return np.asarray(to_hu(image, scan.linearisation.mu_ref).numpy(), dtype=np.float64)


def radial_profile(image: Any, grid: VolumeGrid, radius: float, step_mm: float = 5.0) -> Floats:
    """Means over rings of ``step_mm`` about the isocentre out to ``radius``, ``(rings, 2)`` of radius and mean."""
    y, x = np.meshgrid(*grid.axes, indexing="ij")
    ring = (np.hypot(x, y) / step_mm).astype(np.int64)
    count = int(radius / step_mm)
    total = np.bincount(ring.ravel(), np.asarray(image, np.float64).ravel())[:count]
    return np.stack([(np.arange(count) + 0.5) * step_mm, total / np.bincount(ring.ravel())[:count]], axis=1)
