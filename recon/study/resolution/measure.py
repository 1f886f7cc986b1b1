"""Both scanners' noise-free images, the PCCT's under blur, and what the segmentation hinges on."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from recon.fbp.exact_noise import roi_covariance
from recon.fbp.inset import InsetFbp
from recon.study.paper.facts import FULL_VIEWS
from recon.study.paper.measures import Truth
from recon.study.paper.plaque_scan import (
    REFERENCE_KERNEL,
    REFERENCE_VOXEL_MM,
    SCANNERS,
    Functional,
    PlaqueScan,
    duty,
    prepare,
)
from recon.study.resolution.blur import FWHM_PER_SIGMA, Blurred, blur_series
from recon.study.resolution.settings import Settings
from recon.study.resolution.wire import SystemWidth, wire_width
from recon.study.study import Clock, Progress, silent
from torchpcct.acquisition.acquire import acquire
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.roi import PROTOCOL_PIXEL_MM, PROTOCOL_PIXELS, sample_axial
from torchpcct.scanner import Scanner
from torchpcct.scene import Scene
from torchpcct.scene.plaque import Plaque, plaque_scene

__all__ = ["Imaged", "Measured", "Smoothed", "measure"]

_MIDDLE_ROWS, _MIDDLE_SLICES = 12, 21
"""Detector rows and slices of scans of which the middle slice alone is read."""


@dataclass(frozen=True)
class Smoothed:
    """ROI figures of a blurred volume: widths of the blur as σ in mm (z, y, x), contrasts and the noise of theirs."""

    sigma_mm: tuple[float, float, float]
    contrast_hu: float
    own_contrast_hu: float
    sd_hu: float


@dataclass
class Imaged:
    """One scanner's noise-free image.

    Attributes:
        axial: ``(y, x)`` HU on the protocol's image; sagittal: ``(z, x)``, through core and lumen.
        roi_hu: means of the core's and the fibrous ROI.
        empty_hu: the same in the plaque without a core (fibrous tissue instead).
        sd_hu: of the difference of the two ROI means at ``exposure_s``, as the paper's CNR takes it, exact.
        exposure_s: equal fluence at the isocentre for all scanners.
        width: of the system.
        blurred: one entry per blur (EID-CT: without blur only).
        plan: what was modelled.
        smoothed: the PCCT's two ROIs after a blur of its volume to the resolution of the EID-CT.
    """

    axial: Tensor
    sagittal: Tensor
    roi_hu: tuple[float, float]
    empty_hu: tuple[float, float]
    sd_hu: float
    exposure_s: float
    width: SystemWidth
    blurred: list[Blurred]
    plan: dict[str, Any]
    smoothed: Smoothed | None = None

    @property
    def contrast_hu(self) -> float:
        """Fibrous ROI minus core ROI."""
        return self.roi_hu[1] - self.roi_hu[0]

    @property
    def own_contrast_hu(self) -> float:
        """The core's part of the contrast: what goes if the core goes. The rest is blood and fat blurred into the
        two ROIs."""
        return self.contrast_hu - (self.empty_hu[1] - self.empty_hu[0])


@dataclass
class Measured:
    """All that the report needs; ``variants``: bulge in mm → (fibrous shell in mm, blur series)."""

    settings: Settings
    plaque: Plaque
    scanners: dict[str, Imaged] = field(default_factory=dict)
    variants: dict[float, tuple[float, list[Blurred]]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def true_mm2(self) -> dict[str, float]:
        """Areas of lumen and core in the middle slice."""
        return {name: float(self.plaque.area(name, 0.0)) for name in ("lumen", "core")}


def measure(settings: Settings, progress: Progress = silent, folder: Path | None = None) -> Measured:
    """Simulate, blur, segment, measure; keeps no pieces."""
    clock = Clock()
    scene, plaque = plaque_scene()
    m = Measured(settings, plaque, seconds=clock.seconds)
    kept: dict[str, _Kept] = {}
    for name in SCANNERS:
        with clock.step(name):
            m.scanners[name], kept[name] = _image(name, (scene, plaque), settings, partial(progress, name))
    with clock.step("variants"):
        bulges = sorted({plaque.bulge, *settings.bulges_mm})
        for done, bulge in enumerate(bulges):
            m.variants[bulge] = _variant(bulge, settings)
            progress("variants", (done + 1) / len(bulges))
        m.scanners["PCCT"].smoothed = _smooth(m, kept)
    return m


@dataclass
class _Kept:
    """One scanner's scan, its volume, and the middle slices without a core."""

    scanned: PlaqueScan
    volume: Tensor
    empty: tuple[VolumeGrid, Tensor]


def _image(
    name: str, bodies: tuple[Scene, Plaque], settings: Settings, progress: Callable[[float], None]
) -> tuple[Imaged, _Kept]:
    scene, plaque = bodies
    scanner = SCANNERS[name](FULL_VIEWS[name] // settings.thinning)
    on = duty(scanner, FULL_VIEWS[name])
    # The spectrum is the same: equal fluence at the isocentre asks for an exposure by the square of the distance.
    exposure_s = settings.exposure_s * (scanner.geometry.sod / SCANNERS["PCCT"](8).geometry.sod) ** 2
    scanned = prepare([REFERENCE_KERNEL], [REFERENCE_VOXEL_MM], bodies, scanner, FULL_VIEWS[name], progress)
    volume = scanned.fbp(scanned.clean)[0][0]
    core, fibrous = (float(r(volume)) for r in scanned.pairs[0])
    covariance = roi_covariance(scanned.clean, scanned.fbp, scanned.pairs, exposure_s)[0][0]
    grid, slab = _middle_slices(plaque_scene(core_contrast=0.0)[0], plaque, scanner, on)
    empty_core, empty_fibrous = (float(r(slab)) for r in scanned.rois.on(grid))
    truth = Truth.of(scene, plaque)
    high = math.floor(scanned.fine.extent[0] / PROTOCOL_PIXEL_MM)
    cut = VolumeGrid((high, 1, PROTOCOL_PIXELS), PROTOCOL_PIXEL_MM, truth.image.center)
    axial = sample_axial(volume.double(), scanned.fine, truth.image)[0]
    imaged = Imaged(
        axial,
        sample_axial(volume.double(), scanned.fine, cut)[:, 0],
        (core, fibrous),
        (empty_core, empty_fibrous),
        math.sqrt(float(np.trace(covariance))),
        exposure_s,
        wire_width(scanner, plaque.position[:2], REFERENCE_KERNEL, duty=on),
        blur_series(axial, truth, settings.sigmas_px if name == "PCCT" else settings.sigmas_px[:1]),
        dict(scanned.clean.info["plan"]),
    )
    return imaged, _Kept(scanned, volume, (grid, slab))


def _smooth(m: Measured, kept: dict[str, _Kept]) -> Smoothed:
    """The PCCT blurred by the Gaussian that makes up for the difference in width: in the plane that of the wire, along
    z that of the detector rows at the isocentre (as uniform ones: variance width² / 12)."""
    wide, narrow = m.scanners["EID-CT"].width.area, m.scanners["PCCT"].width.area
    plane = math.sqrt(max(wide**2 - narrow**2, 0.0)) / FWHM_PER_SIGMA
    rows = [k.scanned.clean.geometry.pitch[0] / k.scanned.clean.geometry.magnification for k in kept.values()]
    along = math.sqrt(max(rows[1] ** 2 - rows[0] ** 2, 0.0) / 12.0)
    sigma = (along, plane, plane)

    def blurred(weights: Tensor) -> Functional:
        # A Gaussian is its own transpose: blurred weights on the volume are the weights on the blurred volume.
        return Functional(torch.from_numpy(gaussian_filter(weights.numpy(), np.array(sigma) / REFERENCE_VOXEL_MM)))

    k = kept["PCCT"]
    pair: Any = [blurred(r.weights) for r in k.scanned.pairs[0]]
    core, fibrous = (f(k.volume) for f in pair)
    grid, slab = k.empty
    empty = [blurred(r.weights)(slab) for r in k.scanned.rois.on(grid)]
    covariance = roi_covariance(k.scanned.clean, k.scanned.fbp, [pair], m.scanners["PCCT"].exposure_s)[0][0]
    contrast = fibrous - core
    return Smoothed(sigma, contrast, contrast - (empty[1] - empty[0]), math.sqrt(float(np.trace(covariance))))


def _middle_slices(scene: Scene, plaque: Plaque, scanner: Scanner, on: float) -> tuple[VolumeGrid, Tensor]:
    """The middle of the inset by the reference FBP, from the detector's middle rows: grid and ``(z, y, x)`` HU."""
    grid = VolumeGrid((_MIDDLE_SLICES, 90, 90), REFERENCE_VOXEL_MM, plaque.position[::-1])
    scanner = scanner.replace(geometry=replace(scanner.geometry, rows=_MIDDLE_ROWS))
    scan = acquire(scene, scanner, region=grid, duty=on)
    return grid, InsetFbp(scan, [grid], [REFERENCE_KERNEL])(scan)[0][0]


def _variant(bulge: float, settings: Settings) -> tuple[float, list[Blurred]]:
    """Fibrous tissue between core and wall, and the blur series of the plaque with another bulge, middle slice."""
    scene, plaque = plaque_scene(bulge=bulge)
    truth = Truth.of(scene, plaque)
    scanner = SCANNERS["PCCT"](FULL_VIEWS["PCCT"] // (2 * settings.thinning))
    grid, slab = _middle_slices(scene, plaque, scanner, duty(scanner, FULL_VIEWS["PCCT"]))
    axial = sample_axial(slab.double(), grid, truth.image)[0]
    centre, _, half, _ = (float(v) for v in plaque.section("inner", 0.0))
    core, _, core_half, _ = (float(v) for v in plaque.section("core", 0.0))
    return centre + half - core - core_half, blur_series(axial, truth, settings.sigmas_px)
