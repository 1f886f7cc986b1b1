"""Which resolution the plaque needs: PCCT and EID-CT without noise, and PCCT blurred step by step.

Protocol of Li et al., section "Image Resolution": standard kernel, voxels of 0.1 mm, axial image interpolated linearly
to 0.035 mm pixels and blurred there with Gaussians of σ = 0 … 10 pixels; lumen and core by thresholds; an image is
acceptable where the lumen's area and the cap's thickness are within 20 % of those of the sharp image.

What the paper leaves open, and what is done here: the reference of the 20 % is the unblurred PCCT image (the paper
normalises the lumen's area so); the cap is measured on the line that joins lumen and core (the caption's red line);
the core counts as segmented while the band of its CT numbers does not join the rim around the vessel; and its
boundary as visible while its basin keeps half of its depth.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from recon.study.paper import facts as paper
from recon.study.paper.plaque_scan import REFERENCE_KERNEL, REFERENCE_VOXEL_MM, PlaqueScan, prepare
from recon.study.resolution.blur import FWHM_PER_SIGMA, Blurred, SystemWidth, centers, measure, truth, wire_width
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.roi import PROTOCOL_PIXEL_MM, PROTOCOL_PIXELS, axial_grid, sample_axial

if TYPE_CHECKING:
    from recon.study.report import Report
    from torchpcct.scanner import Scanner
    from torchpcct.scene import Scene
    from torchpcct.scene.plaque import Plaque

__all__ = ["FULL_VIEWS", "Imaged", "Measured", "Settings", "Smoothed", "measure_all", "run"]

FULL_VIEWS = {"PCCT": 1968, "EID-CT": 984}
"""Views per turn of the paper."""

_MIDDLE_ROWS, _MIDDLE_SLICES = 12, 21
"""Detector rows and slices of scans of which the middle slice alone is read."""


@dataclass(frozen=True)
class Settings:
    """Settings of the resolution study; it draws no noise.

    Args:
        thinning: simulate one view in so many (1: all); thinned views last as long as one of the complete scan.
        sigmas_px: standard deviations of the blur in pixels of 0.035 mm, from 0, rising.
        tolerance: relative error of lumen area and cap thickness that is accepted.
        bulges_mm: variants of the plaque for the test of what the core's segmentation hinges on: how far the vessel
            bulges, an assumption of ours that sets how much tissue lies between the core and the fat.
        exposure_s: of the PCCT in the comparison of CNRs; the EID-CT gets the same fluence at the isocentre.

    Raises:
        ValueError: a value out of range.
    """

    thinning: int = 1
    sigmas_px: tuple[float, ...] = tuple(1.25 * k for k in range(9))
    tolerance: float = 0.20
    bulges_mm: tuple[float, ...] = (0.425, 0.475, 0.5)
    exposure_s: float = paper.TABLE_EXPOSURE_S

    def __post_init__(self) -> None:
        if self.thinning < 1:
            raise ValueError(f"thinning must be at least 1, got {self.thinning}")
        s = np.array(self.sigmas_px, dtype=np.float64)
        if s.size < 3 or s[0] != 0 or not (np.diff(s) > 0).all():
            raise ValueError(f"sigmas_px must rise from 0 in at least 3 values, got {self.sigmas_px}")
        if not 0 < self.tolerance < 1:
            raise ValueError(f"tolerance must lie between 0 and 1, got {self.tolerance}")
        if not self.exposure_s > 0:
            raise ValueError(f"exposure_s must be greater than 0 s, got {self.exposure_s}")

    @classmethod
    def quick(cls, **changes: Any) -> Settings:
        """A first look: an eighth of the views, one variant."""
        return cls(**{"thinning": 8, "bulges_mm": (0.5,), **changes})


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
    image: VolumeGrid
    scanners: dict[str, Imaged]
    variants: dict[float, tuple[float, list[Blurred]]]
    true_mm2: dict[str, float]
    seconds: dict[str, float] = field(default_factory=dict)


def run(settings: Settings, progress: Callable[[str, float], None] | None = None) -> Report:
    """Simulate, blur, segment, measure; see :mod:`recon.study.registry`."""
    from recon.study.resolution.report import build_report

    return build_report(measure_all(settings, progress))


def measure_all(settings: Settings, progress: Callable[[str, float], None] | None = None) -> Measured:
    """The study without its report."""
    from torchpcct.scanner import presets
    from torchpcct.scene.plaque import plaque_scene

    report = progress or (lambda step, fraction: None)
    scene, plaque = plaque_scene()
    x, y, z = plaque.position
    measured = Measured(
        settings, plaque, axial_grid((z, y, x)), {}, {},
        {name: float(plaque.area(name, 0.0)) for name in ("lumen", "core")},
    )  # fmt: skip
    kept: dict[str, _Kept] = {}
    sod = presets.pcct(8).geometry.sod
    for name, preset in (("PCCT", presets.pcct), ("EID-CT", presets.eid)):
        start = time.perf_counter()
        scanner = preset(FULL_VIEWS[name] // settings.thinning)
        exposure = settings.exposure_s * (scanner.geometry.sod / sod) ** 2
        sigmas = settings.sigmas_px if name == "PCCT" else settings.sigmas_px[:1]
        measured.scanners[name], kept[name] = _image(
            name, scanner, (scene, plaque), measured.image, sigmas, exposure, partial(report, name)
        )
        measured.seconds[name] = time.perf_counter() - start
    start = time.perf_counter()
    bulges = sorted({plaque.bulge, *settings.bulges_mm})
    for done, bulge in enumerate(bulges):
        measured.variants[bulge] = _variant(bulge, settings)
        report("variants", (done + 1) / len(bulges))
    measured.scanners["PCCT"].smoothed = _smooth(measured, kept)
    measured.seconds["variants"] = time.perf_counter() - start
    return measured


def _image(
    name: str,
    scanner: Scanner,
    bodies: tuple[Scene, Plaque],
    image: VolumeGrid,
    sigmas: tuple[float, ...],
    exposure_s: float,
    progress: Callable[[float], None],
) -> tuple[Imaged, _Kept]:
    from recon.fbp.exact_noise import roi_covariance
    from torchpcct.scene.plaque import plaque_scene

    scene, plaque = bodies
    scanned = prepare([REFERENCE_KERNEL], [REFERENCE_VOXEL_MM], bodies, scanner, FULL_VIEWS[name], progress)
    volume = scanned.fbp(scanned.clean)[0][0]
    core, fibrous = (float(r(volume)) for r in scanned.pairs[0])
    covariance = roi_covariance(scanned.clean, scanned.fbp, scanned.pairs, exposure_s)[0][0]
    duty = min(1.0, scanner.geometry.views / FULL_VIEWS[name])
    grid, slab = _middle_slices(plaque_scene(core_contrast=0.0)[0], plaque, scanner, duty)
    empty = [float(r(slab)) for r in scanned.rois.on(grid)]
    z, y, x = image.center
    high = math.floor(scanned.fine.extent[0] / PROTOCOL_PIXEL_MM)
    cut = VolumeGrid((high, 1, PROTOCOL_PIXELS), PROTOCOL_PIXEL_MM, (z, y, x))
    axial = sample_axial(volume.double(), scanned.fine, image)[0]
    masks, line = truth(scene, image), centers(plaque)
    imaged = Imaged(
        axial,
        sample_axial(volume.double(), scanned.fine, cut)[:, 0],
        (core, fibrous),
        (empty[0], empty[1]),
        math.sqrt(float(np.trace(covariance))),
        exposure_s,
        wire_width(scanner, plaque.position[:2], REFERENCE_KERNEL, duty=duty),
        [measure(axial, image, s, masks, line) for s in sigmas],
        dict(scanned.clean.info["plan"]),
    )
    return imaged, _Kept(scanned, volume, (grid, slab))


@dataclass
class _Kept:
    """One scanner's scan, its volume, and the middle slices without a core."""

    scanned: PlaqueScan
    volume: Tensor
    empty: tuple[VolumeGrid, Tensor]


@dataclass(frozen=True)
class _Functional:
    """A linear functional of a volume, as :func:`recon.fbp.exact_noise.roi_covariance` takes ROIs."""

    weights: Tensor


def _smooth(m: Measured, kept: dict[str, _Kept]) -> Smoothed:
    """The PCCT blurred by the Gaussian that makes up for the difference in width: in the plane that of the wire, along
    z that of the detector rows at the isocentre (as uniform ones: variance width² / 12)."""
    from scipy.ndimage import gaussian_filter

    from recon.fbp.exact_noise import roi_covariance

    wide, narrow = m.scanners["EID-CT"].width.area, m.scanners["PCCT"].width.area
    plane = math.sqrt(max(wide**2 - narrow**2, 0.0)) / FWHM_PER_SIGMA
    rows = [k.scanned.clean.geometry.pitch[0] / k.scanned.clean.geometry.magnification for k in kept.values()]
    along = math.sqrt(max(rows[1] ** 2 - rows[0] ** 2, 0.0) / 12.0)
    sigma = (along, plane, plane)

    def blurred(values: Tensor) -> Tensor:
        return torch.from_numpy(gaussian_filter(values.double().numpy(), np.array(sigma) / REFERENCE_VOXEL_MM))

    k = kept["PCCT"]
    # A Gaussian is its own transpose: blurred weights on the volume are the weights on the blurred volume.
    pair = [_Functional(blurred(r.weights)) for r in k.scanned.pairs[0]]
    core, fibrous = (float((f.weights * k.volume).sum()) for f in pair)
    grid, slab = k.empty
    empty = [float((blurred(r.weights) * slab).sum()) for r in k.scanned.rois.on(grid)]
    rois: Any = [pair]
    covariance = roi_covariance(k.scanned.clean, k.scanned.fbp, rois, m.scanners["PCCT"].exposure_s)[0][0]
    contrast = fibrous - core
    return Smoothed(sigma, contrast, contrast - (empty[1] - empty[0]), math.sqrt(float(np.trace(covariance))))


def _middle_slices(scene: Scene, plaque: Plaque, scanner: Scanner, duty: float) -> tuple[VolumeGrid, Tensor]:
    """The middle of the inset by the reference FBP, from the detector's middle rows: grid and ``(z, y, x)`` HU."""
    from recon.fbp.inset import InsetFbp
    from torchpcct.acquisition.acquire import acquire

    x, y, z = plaque.position
    grid = VolumeGrid((_MIDDLE_SLICES, 90, 90), REFERENCE_VOXEL_MM, (z, y, x))
    scanner = scanner.replace(geometry=replace(scanner.geometry, rows=_MIDDLE_ROWS))
    scan = acquire(scene, scanner, region=grid, duty=duty)
    return grid, InsetFbp(scan, [grid], [REFERENCE_KERNEL])(scan)[0][0]


def _variant(bulge: float, settings: Settings) -> tuple[float, list[Blurred]]:
    """Fibrous tissue between core and wall, and the blur series of the plaque with another bulge, middle slice."""
    from torchpcct.scanner import presets
    from torchpcct.scene.plaque import plaque_scene

    scene, plaque = plaque_scene(bulge=bulge)
    x, y, z = plaque.position
    image = axial_grid((z, y, x))
    views = FULL_VIEWS["PCCT"] // (2 * settings.thinning)
    grid, slab = _middle_slices(scene, plaque, presets.pcct(views), views / FULL_VIEWS["PCCT"])
    axial = sample_axial(slab.double(), grid, image)[0]
    masks, line = truth(scene, image), centers(plaque)
    centre, _, half, _ = (float(v) for v in plaque.section("inner", 0.0))
    core, _, core_half, _ = (float(v) for v in plaque.section("core", 0.0))
    series = [measure(axial, image, s, masks, line) for s in settings.sigmas_px]
    return centre + half - core - core_half, series
