"""Which resolution the plaque needs: PCCT and EID-CT without noise, and PCCT blurred step by step.

Protocol of Li et al., section "Image Resolution": standard kernel, voxels of 0.1 mm, axial image
interpolated linearly to 0.035 mm pixels and blurred there with Gaussians of σ = 0 … 10 pixels;
lumen and core by thresholds; an image is acceptable where the lumen's area and the cap's thickness
are within 20 % of those of the sharp image.

What the paper leaves open, and what is done here: the reference of the 20 % is the unblurred PCCT
image (the paper normalises the lumen's area so); the cap is measured on the line that joins lumen
and core (the caption's red line); the core counts as segmented while the band of its CT numbers
does not join the rim around the vessel; and its boundary as visible while its basin keeps half of
its depth.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from torch import Tensor

from recon.analytic.exact_noise import roi_covariance
from recon.jobs.store import StudyCache
from recon.study.figures import curve_axes, middle_panel, plaque_panel
from recon.study.paper import published as paper
from recon.study.paper.plaque_scan import (
    REFERENCE_KERNEL,
    REFERENCE_VOXEL_MM,
    SCANNERS,
    PlaqueImage,
    PlaqueScan,
    Truth,
    duty,
    equal_dose,
    measure_plaque,
    prepare,
    reference_fbp,
)
from recon.study.report import Check, around
from recon.study.study import Measured, Progress, StudySettings, silent
from torchpcct.acquisition.acquire import acquire
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.resolution import first_below
from torchpcct.metrics.roi import PROTOCOL_PIXEL_MM, sample_axial
from torchpcct.scanner import Scanner
from torchpcct.scene import Body, EllipticCylinder, Scene
from torchpcct.scene.plaque import PATIENT_DIAMETER, Plaque, plaque_scene
from torchpcct.validate import number
from torchpcct.viz import panels

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike

    from torchpcct.typing import JsonObject


FWHM_PER_SIGMA = 2.0 * math.sqrt(2.0 * math.log(2.0))
"""Full width at half maximum of a Gaussian of unit standard deviation."""
_PX_FWHM = FWHM_PER_SIGMA * PROTOCOL_PIXEL_MM
"""The same of one pixel's, mm."""
_STEP_PX = 1.25
"""Step of the blurs, pixels: so exactly limits are known."""

_MIDDLE_ROWS = 12
"""Detector rows of scans of which the middle slice alone is read."""
_MIDDLE_SLICES = 21
"""Slices of such scans."""

_WIRE_RADIUS_MM = 0.03
"""Radius of the wire that resolution is measured on; its width is taken off."""
_WIRE_PIXEL_MM = 0.02
"""Pixel of its image."""
_WIRE_PIXELS = 121
"""Along the edge of its image."""
_WIRE_ROWS = 4
"""Detector rows of its scan."""


@dataclass(frozen=True)
class ResolutionSettings(StudySettings):
    """Settings of the resolution study; it draws no noise.

    Args:
        thinning: simulate one view in so many (1: all); thinned views last as long as one of the
            complete scan.
        sigmas_px: standard deviations of the blur in pixels of 0.035 mm, from 0, rising.
        tolerance: relative error of lumen area and cap thickness that is accepted.
        exposure_s: of the PCCT in the comparison of CNRs; the EID-CT gets the same fluence at the
            isocentre.
    """

    thinning: int = 1
    sigmas_px: tuple[float, ...] = tuple(1.25 * k for k in range(9))
    tolerance: float = 0.20
    exposure_s: float = paper.TABLE_EXPOSURE_S

    # An eighth of the views.
    QUICK: ClassVar[dict[str, object]] = {"thinning": 8}

    def __post_init__(self) -> None:
        self.check_whole(thinning=1)
        s = np.array(self.sigmas_px, dtype=np.float64)
        if s.size < 3 or s[0] != 0 or not (np.diff(s) > 0).all():
            raise ValueError(
                f"sigmas_px must rise from 0 in at least 3 values, got {self.sigmas_px}"
            )
        if not 0 < self.tolerance < 1:
            raise ValueError(f"tolerance must lie between 0 and 1, got {self.tolerance}")
        number("exposure_s", self.exposure_s, positive=True, unit="s")


@dataclass
class Imaged:
    """One scanner's noise-free image, for the pictures: its scan, volume ``(z, y, x)`` HU, and
    blur series."""

    scanned: PlaqueScan
    volume: Tensor
    blurred: list[PlaqueImage]


def measure(
    settings: ResolutionSettings, progress: Progress = silent, folder: str | Path | None = None
) -> Measured:
    """Simulate, blur, segment, measure; finished parts are cached."""
    cache = StudyCache(folder, settings)
    scene, plaque = plaque_scene()
    seen: dict[str, Imaged] = {}
    entries: dict[str, JsonObject] = {}
    for name in SCANNERS:
        seen[name], entries[name] = _image(
            name, (scene, plaque), settings, cache.within(name), partial(progress, name)
        )
        progress(name, 1.0)
    series = seen["PCCT"].blurred
    found = limits(series, settings.tolerance)
    margin = _PX_FWHM * min(found["cap"], found["lumen"])
    areas = {f"{name}_mm2": float(plaque.area(name, 0.0)) for name in ("lumen", "core")}
    data = {
        "truth": {**areas, "cap_mm": plaque.cap_thickness},
        "scanners": entries,
        "limits_px": found,
        "limits_fwhm_mm": {name: _PX_FWHM * found[name] for name in ("cap", "lumen")},
        "margin_fwhm_mm": margin,
        "final_fwhm_mm": math.hypot(entries["PCCT"]["fwhm_mm"]["area"], margin),
        "cap_excess": series[0]["cap_line_mm"] / plaque.cap_thickness - 1.0,
    }
    return Measured(settings, data, seen)


def _image(
    name: str,
    bodies: tuple[Scene, Plaque],
    settings: ResolutionSettings,
    cache: StudyCache,
    progress: Callable[[float], None],
) -> tuple[Imaged, dict[str, object]]:
    """One scanner's image and its JSON values: what the two ROIs read, with and without a core;
    noise at the same fluence at the isocentre for all scanners; width of a point; and the blur
    series (EID-CT: without blur only)."""
    scene, plaque = bodies
    scanner = SCANNERS[name](paper.FULL_VIEWS[name] // settings.thinning)
    on, exposure_s = (
        duty(scanner, paper.FULL_VIEWS[name]),
        settings.exposure_s * equal_dose(scanner),
    )
    full = paper.FULL_VIEWS[name]
    scanned = prepare(
        [REFERENCE_KERNEL], [REFERENCE_VOXEL_MM], bodies, scanner, full, progress, cache
    )
    volume = scanned.fbp(scanned.clean)[0][0]
    grid, slab = cache(
        "empty", lambda: _middle_slices(plaque_scene(core_contrast=0.0)[0], plaque, scanner, on)
    )
    truth = Truth.of(scene, plaque)
    axial = sample_axial(volume.double(), scanned.fine, truth.image)[0]
    series = blur_series(
        axial, truth, settings.sigmas_px if name == "PCCT" else settings.sigmas_px[:1]
    )
    core, fibrous = (float(roi(volume)) for roi in scanned.pairs[0])
    empty_core, empty_fibrous = (float(roi(slab)) for roi in scanned.rois.on(grid))
    sd = math.sqrt(
        float(np.trace(roi_covariance(scanned.clean, scanned.fbp, scanned.pairs, exposure_s)[0][0]))
    )
    # The core's part of the contrast is what goes if the core goes; the rest is blood and fat
    # blurred into the ROIs.
    own = fibrous - core - (empty_fibrous - empty_core)
    width = cache("wire", lambda: wire_width(scanner, plaque.position[:2], on))
    return Imaged(scanned, volume, series), {
        "roi_hu": (core, fibrous),
        "empty_hu": (empty_core, empty_fibrous),
        "own_contrast_hu": own,
        "contrast_sd_hu": sd,
        "cnr": (fibrous - core) / sd,
        "own_cnr": own / sd,
        "exposure_s": exposure_s,
        "fwhm_mm": width,
        "blurred": [b.measures for b in series],
        "plan": dict(scanned.clean.info["plan"]),
    }


def _middle_slices(
    scene: Scene, plaque: Plaque, scanner: Scanner, on: float
) -> tuple[VolumeGrid, Tensor]:
    """The middle of the inset by the reference FBP, from the detector's middle rows: grid and
    ``(z, y, x)`` HU."""
    grid = VolumeGrid((_MIDDLE_SLICES, 90, 90), REFERENCE_VOXEL_MM, plaque.position[::-1])
    scanner = scanner.replace(geometry=replace(scanner.geometry, rows=_MIDDLE_ROWS))
    scan = acquire(scene, scanner, region=grid, duty=on)
    return grid, reference_fbp(scan, grid)


# --- width of a point -----------------------------------------------------------------------------


def wire_width(scanner: Scanner, position: tuple[float, float], duty: float) -> dict[str, float]:
    """Width of the system's in-plane point spread: a thin wire along z at ``(x, y)`` mm in the fat
    cylinder, by FBP.

    Returns:
        Full widths at half maximum in mm with the wire's own diameter (0.06 mm) taken off in
        quadrature: ``area``, diameter of the disc of the size of all that exceeds half of the
        maximum, the width to quote; ``radial`` and ``tangential``, along and across the direction
        from the isocentre; and ``undershoot``, the lowest value around the peak relative to it.
    """
    x, y = position
    scene = Scene(
        [
            Body("patient", EllipticCylinder(PATIENT_DIAMETER / 2.0), "pericoronary_fat"),
            Body(
                "wire",
                EllipticCylinder(_WIRE_RADIUS_MM, position=(x, y, 0.0)),
                "fibrous_tissue",
                "patient",
            ),
        ]
    )
    flat = scanner.replace(geometry=replace(scanner.geometry, rows=_WIRE_ROWS))
    grid = VolumeGrid((1, _WIRE_PIXELS, _WIRE_PIXELS), _WIRE_PIXEL_MM, (0.0, y, x))
    scan = acquire(scene, flat, region=grid, duty=duty)
    return point_width(reference_fbp(scan, grid)[0].double().numpy(), grid.slice)


def point_width(image: NDArray[np.float64], grid: VolumeGrid) -> dict[str, float]:
    """Widths of the bright point in the middle of an image ``(y, x)`` on ``grid``; see
    :func:`wire_width`."""
    base = np.median(np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]]))
    point = (image - base) / (image - base).max()
    middle = (np.array(image.shape) - 1) / 2
    peak = np.array(np.unravel_index(int(point.argmax()), point.shape), dtype=np.float64)
    outward = np.array(grid.center) / np.hypot(*grid.center)
    across = np.array([-outward[1], outward[0]])
    reach = np.arange(-middle.min() * 0.8, middle.min() * 0.8 + 0.125, 0.25)
    widths = []
    for direction in (outward, across):
        profile = map_coordinates(point, peak[:, None] + direction[:, None] * reach, order=3)
        top = int(profile.argmax())
        right, left = (
            first_below(reach[top::way], profile[top::way], profile[top] / 2, math.nan)
            for way in (1, -1)
        )
        widths.append((right - left) * grid.spacing[0])
    fine = map_coordinates(
        point, np.mgrid[0 : image.shape[0] - 1 : 0.25, 0 : image.shape[1] - 1 : 0.25], order=3
    )
    area = 2.0 * math.sqrt(float((fine >= 0.5).sum()) * (0.25 * grid.spacing[0]) ** 2 / math.pi)
    # The wire is a disc: its variance along a line is a quarter of its squared radius.
    own = FWHM_PER_SIGMA * _WIRE_RADIUS_MM / 2.0
    area, radial, tangential = (math.sqrt(max(w * w - own * own, 0.0)) for w in (area, *widths))
    return {
        "area": area,
        "radial": radial,
        "tangential": tangential,
        "undershoot": float(point.min()),
    }


# --- blur -----------------------------------------------------------------------------------------


def blur(image: Tensor, sigma_px: float) -> Tensor:
    """Gaussian blur of an image ``(y, x)``, cut at 4 σ, with its border repeated; 0 returns the
    image. Differentiable: kornia's filter of tensors, which is all that is used of kornia."""
    if sigma_px == 0:
        return image
    from kornia.filters import gaussian_blur2d

    size = 2 * math.ceil(4.0 * sigma_px) + 1
    blurred: Tensor = gaussian_blur2d(
        image[None, None], (size, size), (float(sigma_px), float(sigma_px)), "replicate"
    )
    return blurred[0, 0]


def blur_series(image: Tensor, truth: Truth, sigmas_px: Sequence[float]) -> list[PlaqueImage]:
    """Blur an axial image ``(y, x)`` HU on ``truth.image`` by every σ, and measure it."""
    series = []
    for sigma in sigmas_px:
        fwhm = FWHM_PER_SIGMA * sigma * truth.image.spacing[-1]
        found = measure_plaque(blur(image, sigma), truth, sigma_px=sigma, fwhm_mm=fwhm)
        found.measures["cap_mm"] = found.segmentation.cap_thickness
        series.append(found)
    return series


def limits(series: list[PlaqueImage], tolerance: float) -> JsonObject:
    """Where a blur series loses what: blurs in pixels.

    Returns:
        ``cap``: blur at which the cap's thickness on the line has changed by ``tolerance``;
        ``lumen``: the same of the lumen's area; ``core_lost``: first blur of the series at which
        the core is not segmented (None: at none); ``basin``: blur at which the core's basin has
        half of its depth.
    """
    sigmas, caps, areas, depths = (
        np.array([b[name] for b in series])
        for name in ("sigma_px", "cap_line_mm", "lumen_mm2", "basin_depth_hu")
    )
    lost = [b["sigma_px"] for b in series if not b["core_found"]]
    return {
        "cap": crossing(sigmas, np.abs(caps / caps[0] - 1.0), tolerance),
        "lumen": crossing(sigmas, np.abs(areas / areas[0] - 1.0), tolerance),
        "core_lost": lost[0] if lost else None,
        "basin": crossing(sigmas, depths[0] - depths, 0.5 * depths[0]),
    }


def crossing(x: ArrayLike, values: ArrayLike, limit: float) -> float:
    """First x at which ``values`` exceed ``limit``, by linear interpolation; NaN values count as
    exceeding, and the last x is returned where none does."""
    x, v = np.asarray(x, dtype=np.float64), np.asarray(values, dtype=np.float64)
    return first_below(x, -np.where(np.isnan(v), limit, v), -limit, float(x[-1]))


# --- the report -----------------------------------------------------------------------------------


def checks(data: JsonObject) -> list[Check]:
    """The protocol's limits of the PCCT, and what the EID-CT loses, beside the paper's."""
    p, e, published, found = (
        data["scanners"]["PCCT"],
        data["scanners"]["EID-CT"],
        paper.RESOLUTION,
        data["limits_px"],
    )
    (last, lost), cap = published["last_kernels_px"], published["cap_limit_px"]
    areas = np.array([b["lumen_mm2"] for b in p["blurred"]])
    core, fibrous = paper.NOISE_FREE_ROI_HU["foreground"], paper.NOISE_FREE_ROI_HU["background"]
    joined = math.inf if found["core_lost"] is None else found["core_lost"]
    own, roi_hu, eid = e["own_contrast_hu"] / p["own_contrast_hu"], p["roi_hu"], e["blurred"][0]
    coarse = (
        f"the contrast {'rises' if own > 1 else 'falls'} to {100 * own:.0f} %, the noise of the "
        f"ROI means to {100 * e['contrast_sd_hu'] / p['contrast_sd_hu']:.0f} %: the coarse cells "
        "pass little of the noise either"
    )
    return [
        around("PCCT core ROI, HU", roi_hu[0], core, 8.0),
        around("PCCT fibrous ROI, HU", roi_hu[1], fibrous, 8.0),
        Check(
            "PCCT fibrous ROI below 100 HU through the blur of edges",
            roi_hu[1],
            fibrous,
            high=100.0,
        ),
        Check(
            "core's boundary visible (half of its basin's depth), up to σ, px",
            found["basin"],
            f"{last:g} … {lost:g}",
            last - _STEP_PX,
            lost + _STEP_PX,
        ),
        around(
            "first blur at which the band 20–60 HU joins the rim, σ, px", joined, lost, _STEP_PX
        ).explained("set by the tissue on the fat side, which the paper does not give, see below"),
        Check(
            "cap thickness within 20 %, up to σ, px",
            found["cap"],
            f"< {cap:g}",
            cap - _STEP_PX,
            cap + _STEP_PX,
        ),
        Check(
            "largest rise of the lumen's area from one blur to the next, %",
            100 * float((np.diff(areas) / areas[0]).max()),
            "shrinks a little",
            high=0.0,
        ),
        Check(
            "lumen area at the strongest blur, % of the sharp image's",
            100 * float(areas[-1] / areas[0]),
            "small change",
            80.0,
            100.0,
        ),
        Check(
            "final resolution, FWHM, mm",
            data["final_fwhm_mm"],
            published["final_fwhm_mm"],
            0.35,
            0.50,
        ),
        Check(
            "EID-CT: core segmented (1: yes)",
            float(eid["core_found"]),
            "hardly discernible",
            high=0.0,
        ),
        Check(
            "EID-CT: depth of the core's basin, HU",
            eid["basin_depth_hu"],
            "boundary not resolved",
            high=1.0,
        ),
        Check(
            "EID-CT: contrast that the core makes, over the PCCT's",
            own,
            "hardly discernible",
            high=0.5,
        ),
        Check(
            "EID-CT: CNR that the core makes, over the PCCT's at equal fluence",
            e["own_cnr"] / p["own_cnr"],
            "hardly discernible",
            high=0.5,
        ).explained(coarse),
    ]


def figures(measured: Measured) -> dict[str, Figure]:
    """The images under blur, and what blur does to lumen, cap and core."""
    return {"resolution_images.png": _images(measured.seen), "resolution.png": _curves(measured)}


def _sagittal(s: Imaged) -> Tensor:
    """``(z, x)`` HU through core and lumen, in the protocol's pixels."""
    image, high = s.scanned.rois.image, math.floor(s.scanned.fine.extent[0] / PROTOCOL_PIXEL_MM)
    cut = VolumeGrid((high, 1, image.shape[2]), PROTOCOL_PIXEL_MM, image.center)
    return sample_axial(s.volume.double(), s.scanned.fine, cut)[:, 0]


def _images(scanners: dict[str, Imaged]) -> Figure:
    """First row: both scanners; second: PCCT under blur with its segmentation; third: the same,
    along the vessel."""
    series = scanners["PCCT"].blurred
    top = []
    for name, s in scanners.items():
        top += [
            middle_panel(s.blurred[0].image, f"{name}, axial"),
            middle_panel(_sagittal(s), "along the vessel"),
        ]
    middle = [plaque_panel(b, f"σ = {b['sigma_px']:g}", f"{b['fwhm_mm']:.2f} mm") for b in series]
    bottom = [middle_panel(blur(_sagittal(scanners["PCCT"]), b["sigma_px"])) for b in series]
    return panels(
        [top, middle, bottom],
        ("no blur", "PCCT axial", "PCCT along"),
        "Noise-free plaque in different resolutions",
        "C150 / W600 HU. Outlines: lumen (red), core where segmented (yellow). Below: FWHM of the "
        "blur.",
    )


def _curves(m: Measured) -> Figure:
    """Lumen area, cap thickness and depth of the core's basin against the blur."""
    figure, (lumen, cap, basin) = curve_axes(
        "σ of the blur, 0.035 mm pixels",
        ["lumen area, of the sharp image's", "cap thickness, mm", "depth of the core's basin, HU"],
    )
    series = m.seen["PCCT"].blurred
    x = [b["sigma_px"] for b in series]
    areas = np.array([b["lumen_mm2"] for b in series])
    lumen.plot(x, areas / areas[0], "o-", color="black")
    lumen.axhspan(1 - m.settings.tolerance, 1, color="0.92", label="within tolerance")
    lumen.set_ylim(0.75, 1.02)
    values = np.array([b["cap_line_mm"] for b in series])
    cap.plot(x, values, "o-", color="black", label="on the line")
    closest = np.array([b["cap_mm"] for b in series])
    cap.plot(x, closest, "x", color="tab:blue", label="smallest distance")
    low, high = values[0] * (1 - m.settings.tolerance), values[0] * (1 + m.settings.tolerance)
    cap.axhspan(low, high, color="0.92", label="within tolerance")
    cap.axhline(m.data["truth"]["cap_mm"], color="0.5", linestyle=":", label="true")
    cap.axvline(
        float(paper.RESOLUTION["cap_limit_px"]),
        color="tab:red",
        linestyle="--",
        label="paper's limit",
    )
    cap.legend(fontsize=7)
    basin.plot(x, [b["basin_depth_hu"] for b in series], "o-", color="black")
    kept = [(b["sigma_px"], b["basin_depth_hu"]) for b in series if b["core_found"]]
    if kept:
        basin.plot(
            *zip(*kept, strict=True), "s", color="black", markersize=7, label="core segmented"
        )
        basin.legend(fontsize=7)
    return figure
