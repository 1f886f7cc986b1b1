"""Both scanners' noise-free images, the PCCT's under blur, and what the segmentation hinges on."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from recon.analytic.exact_noise import roi_covariance
from recon.analytic.inset import InsetFbp
from recon.evaluate.store import Pieces
from recon.study.paper.facts import FULL_VIEWS
from recon.study.paper.measures import Truth
from recon.study.paper.plaque_scan import (
    REFERENCE_KERNEL,
    REFERENCE_VOXEL_MM,
    SCANNERS,
    Functional,
    PlaqueScan,
    duty,
    equal_dose,
    prepare,
)
from recon.study.resolution.blur import FWHM_PER_SIGMA, Blurred, blur_series
from recon.study.resolution.settings import Settings
from recon.study.resolution.wire import SystemWidth, wire_width
from recon.study.study import Clock, Progress, silent
from torchpcct.acquisition.acquire import acquire
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.roi import RoiMean, sample_axial
from torchpcct.scanner import Scanner
from torchpcct.scene import Scene
from torchpcct.scene.plaque import Plaque, plaque_scene

__all__ = ["Imaged", "Measured", "RoiFigures", "measure"]

_MIDDLE_ROWS, _MIDDLE_SLICES = 12, 21
"""Detector rows and slices of scans of which the middle slice alone is read."""


@dataclass(frozen=True)
class RoiFigures:
    """What the two ROIs read.

    Attributes:
        roi_hu: means of the core's and the fibrous ROI.
        empty_hu: the same in the plaque without a core (fibrous tissue instead).
        sd_hu: of the difference of the two ROI means, as the paper's CNR takes it, exact.
    """

    roi_hu: tuple[float, float]
    empty_hu: tuple[float, float]
    sd_hu: float

    @property
    def contrast_hu(self) -> float:
        """Fibrous ROI minus core ROI."""
        return self.roi_hu[1] - self.roi_hu[0]

    @property
    def own_contrast_hu(self) -> float:
        """The core's part of the contrast: what goes if the core goes. The rest is blood and fat blurred into the
        two ROIs."""
        return self.contrast_hu - (self.empty_hu[1] - self.empty_hu[0])

    @property
    def cnr(self) -> float:
        """Of the contrast."""
        return self.contrast_hu / self.sd_hu

    @property
    def own_cnr(self) -> float:
        """Of the core's part of the contrast."""
        return self.own_contrast_hu / self.sd_hu


@dataclass
class Imaged:
    """One scanner's noise-free image.

    Attributes:
        scanned: the scan, its grid and ROIs; volume: ``(z, y, x)`` HU on that grid.
        empty: grid and volume of the middle slices of the plaque without a core.
        exposure_s: of ``rois``; equal fluence at the isocentre for all scanners.
        rois: what the two ROIs read.
        width: of the system.
        blurred: one entry per blur (EID-CT: without blur only).
    """

    scanned: PlaqueScan
    volume: Tensor
    empty: tuple[VolumeGrid, Tensor]
    exposure_s: float
    rois: RoiFigures
    width: SystemWidth
    blurred: list[Blurred]

    @property
    def plan(self) -> dict[str, Any]:
        """What was modelled."""
        return dict(self.scanned.clean.info["plan"])


@dataclass
class Measured:
    """All that the report needs.

    Attributes:
        scanners: name → image.
        variants: bulge in mm → (fibrous shell in mm, blur series).
        smoothed_sigma_mm: of a Gaussian blur (z, y, x) that brings the PCCT's volume to the resolution of the EID-CT.
        smoothed: what the PCCT's two ROIs read then.
        seconds: per step.
    """

    settings: Settings
    plaque: Plaque
    scanners: dict[str, Imaged]
    variants: dict[float, tuple[float, list[Blurred]]]
    smoothed_sigma_mm: tuple[float, float, float]
    smoothed: RoiFigures
    seconds: dict[str, float]

    @property
    def true_mm2(self) -> dict[str, float]:
        """Areas of lumen and core in the middle slice."""
        return {name: float(self.plaque.area(name, 0.0)) for name in ("lumen", "core")}


def measure(settings: Settings, progress: Progress = silent, folder: str | Path | None = None) -> Measured:
    """Simulate, blur, segment, measure, in resumable pieces."""
    clock, pieces = Clock(), Pieces(folder, settings)
    scene, plaque = plaque_scene()
    scanners: dict[str, Imaged] = {}
    for name in SCANNERS:
        scanners[name] = _image(name, (scene, plaque), settings, pieces.within(name), partial(progress, name))
        clock.lap(name)
    variants: dict[float, tuple[float, list[Blurred]]] = {}
    bulges = sorted({plaque.bulge, *settings.bulges_mm})
    pieces.ahead(_kept_variant, *((bulge,) for bulge in bulges))
    for bulge in bulges:
        variants[bulge] = _kept_variant(settings, pieces, bulge)
        progress("variants", len(variants) / len(bulges))
    smoothed = _smooth(scanners["PCCT"], scanners["EID-CT"])
    clock.lap("variants")
    return Measured(settings, plaque, scanners, variants, *smoothed, clock.seconds)


def _image(
    name: str,
    bodies: tuple[Scene, Plaque],
    settings: Settings,
    pieces: Pieces,
    progress: Callable[[float], None],
) -> Imaged:
    scene, plaque = bodies
    scanner = SCANNERS[name](FULL_VIEWS[name] // settings.thinning)
    on, exposure_s = duty(scanner, FULL_VIEWS[name]), settings.exposure_s * equal_dose(scanner)
    scanned = prepare([REFERENCE_KERNEL], [REFERENCE_VOXEL_MM], bodies, scanner, FULL_VIEWS[name], progress, pieces)
    volume = scanned.fbp(scanned.clean)[0][0]
    empty = pieces("empty", lambda: _middle_slices(plaque_scene(core_contrast=0.0)[0], plaque, scanner, on))
    truth = Truth.of(scene, plaque)
    axial = sample_axial(volume.double(), scanned.fine, truth.image)[0]
    return Imaged(
        scanned,
        volume,
        empty,
        exposure_s,
        _roi_figures(scanned, volume, empty, exposure_s, lambda roi: roi),
        pieces("wire", lambda: wire_width(scanner, plaque.position[:2], REFERENCE_KERNEL, duty=on)),
        blur_series(axial, truth, settings.sigmas_px if name == "PCCT" else settings.sigmas_px[:1]),
    )


def _roi_figures(
    scanned: PlaqueScan,
    volume: Tensor,
    empty: tuple[VolumeGrid, Tensor],
    exposure_s: float,
    weigh: Callable[[RoiMean], RoiMean | Functional],
) -> RoiFigures:
    """Of ``weigh(ROI)`` for both ROIs."""
    grid, slab = empty
    pair: Any = [weigh(r) for r in scanned.pairs[0]]
    core, fibrous = (float(r(volume)) for r in pair)
    empty_core, empty_fibrous = (float(weigh(r)(slab)) for r in scanned.rois.on(grid))
    covariance = roi_covariance(scanned.clean, scanned.fbp, [pair], exposure_s)[0][0]
    return RoiFigures((core, fibrous), (empty_core, empty_fibrous), math.sqrt(float(np.trace(covariance))))


def _smooth(p: Imaged, e: Imaged) -> tuple[tuple[float, float, float], RoiFigures]:
    """Blur the PCCT's volume by the Gaussian that makes up for the difference in width: in the plane that of the wire,
    along z that of the detector rows at the isocentre (as uniform ones: variance width² / 12)."""
    plane = math.sqrt(max(e.width.area**2 - p.width.area**2, 0.0)) / FWHM_PER_SIGMA
    narrow, wide = (g.pitch[0] / g.magnification for g in (s.scanned.clean.geometry for s in (p, e)))
    sigma = (math.sqrt(max(wide**2 - narrow**2, 0.0) / 12.0), plane, plane)

    def blurred(roi: RoiMean) -> Functional:
        # A Gaussian is its own transpose: blurred weights on the volume are the weights on the blurred volume.
        weights = gaussian_filter(roi.weights.numpy(), np.array(sigma) / REFERENCE_VOXEL_MM)
        return Functional(torch.from_numpy(weights))

    return sigma, _roi_figures(p.scanned, p.volume, p.empty, p.exposure_s, blurred)


def _middle_slices(scene: Scene, plaque: Plaque, scanner: Scanner, on: float) -> tuple[VolumeGrid, Tensor]:
    """The middle of the inset by the reference FBP, from the detector's middle rows: grid and ``(z, y, x)`` HU."""
    grid = VolumeGrid((_MIDDLE_SLICES, 90, 90), REFERENCE_VOXEL_MM, plaque.position[::-1])
    scanner = scanner.replace(geometry=replace(scanner.geometry, rows=_MIDDLE_ROWS))
    scan = acquire(scene, scanner, region=grid, duty=on)
    return grid, InsetFbp(scan, [grid], [REFERENCE_KERNEL])(scan)[0][0]


def _kept_variant(settings: Settings, pieces: Pieces, bulge: float) -> tuple[float, list[Blurred]]:
    return pieces(f"bulge_{bulge:g}", partial(_variant, bulge, settings))


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
