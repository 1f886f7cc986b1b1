"""Measures of the resolution study: a thin wire's width, and the plaque's segmentation under growing blur."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from recon.fbp.inset import InsetFbp
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.plaque_measures import PlaqueSegmentation, basin_depth, cap_on_line, dice, segment_plaque

if TYPE_CHECKING:
    from torchpcct.scanner import Scanner
    from torchpcct.scene import Scene
    from torchpcct.scene.plaque import Plaque

__all__ = [
    "FWHM_PER_SIGMA",
    "Blurred",
    "SystemWidth",
    "blur",
    "centers",
    "crossing",
    "measure",
    "point_width",
    "truth",
    "wire_width",
]

FWHM_PER_SIGMA = 2.0 * math.sqrt(2.0 * math.log(2.0))

_WIRE_RADIUS_MM = 0.03
_WIRE_PIXEL_MM = 0.02
_WIRE_PIXELS = 121
_WIRE_ROWS = 4


@dataclass(frozen=True)
class SystemWidth:
    """Full widths at half maximum in mm of a point in the axial plane.

    Attributes:
        area: diameter of the disc of the size of all that exceeds half of the maximum: the width to quote.
        radial, tangential: along and across the direction from the isocentre.
        undershoot: lowest value around the peak relative to it.
    """

    area: float
    radial: float
    tangential: float
    undershoot: float


def wire_width(scanner: Scanner, position: tuple[float, float], kernel: str, *, duty: float = 1.0) -> SystemWidth:
    """Width of the system's in-plane point spread: a thin wire along z in the fat cylinder, reconstructed by FBP.

    Args:
        scanner: its outer detector rows are left out (the wire does not change along z).
        position: ``(x, y)`` mm of the wire.
        kernel: reconstruction kernel.
        duty: share of a view's time with the beam on.

    Returns:
        Widths with the wire's own diameter (0.06 mm) taken off in quadrature.
    """
    from dataclasses import replace

    from torchpcct.acquisition.acquire import acquire
    from torchpcct.scene import Body, EllipticCylinder, Scene
    from torchpcct.scene.plaque import PATIENT_DIAMETER

    x, y = position
    scene = Scene(
        [
            Body("patient", EllipticCylinder(PATIENT_DIAMETER / 2.0), "pericoronary_fat"),
            Body("wire", EllipticCylinder(_WIRE_RADIUS_MM, position=(x, y, 0.0)), "fibrous_tissue", "patient"),
        ]
    )
    flat = scanner.replace(geometry=replace(scanner.geometry, rows=_WIRE_ROWS))
    grid = VolumeGrid((1, _WIRE_PIXELS, _WIRE_PIXELS), _WIRE_PIXEL_MM, (0.0, y, x))
    scan = acquire(scene, flat, region=grid, duty=duty)
    image = InsetFbp(scan, [grid], [kernel])(scan)[0][0, 0].double().numpy()
    return point_width(image, grid.slice)


def point_width(image: NDArray[np.float64], grid: VolumeGrid) -> SystemWidth:
    """Widths of the bright point in the middle of an image ``(y, x)`` on ``grid``; see :func:`wire_width`."""
    from scipy.ndimage import map_coordinates

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
        widths.append(_full_width(reach, profile) * grid.spacing[0])
    fine = map_coordinates(point, np.mgrid[0 : image.shape[0] - 1 : 0.25, 0 : image.shape[1] - 1 : 0.25], order=3)
    area = 2.0 * math.sqrt(float((fine >= 0.5).sum()) * (0.25 * grid.spacing[0]) ** 2 / math.pi)
    # The wire is a disc: its variance along a line is a quarter of its squared radius.
    own = FWHM_PER_SIGMA * _WIRE_RADIUS_MM / 2.0
    area, radial, tangential = (math.sqrt(max(w * w - own * own, 0.0)) for w in (area, *widths))
    return SystemWidth(area, radial, tangential, float(point.min()))


def _full_width(x: NDArray[np.float64], profile: NDArray[np.float64]) -> float:
    top = int(profile.argmax())
    half = 0.5 * profile[top]
    right = top + int(np.flatnonzero(profile[top:] < half)[0])
    left = top - int(np.flatnonzero(profile[top::-1] < half)[0])
    b = x[right - 1] + (profile[right - 1] - half) / (profile[right - 1] - profile[right]) * (x[right] - x[right - 1])
    a = x[left + 1] - (profile[left + 1] - half) / (profile[left + 1] - profile[left]) * (x[left + 1] - x[left])
    return float(b - a)


def blur(image: Tensor, sigma_px: float) -> Tensor:
    """Gaussian blur of an image ``(y, x)``, cut at 4 σ, with its border repeated.

    Args:
        image: float tensor.
        sigma_px: standard deviation in pixels; 0 returns the image.
    """
    if sigma_px == 0:
        return image
    from kornia.filters import gaussian_blur2d

    size = 2 * math.ceil(4.0 * sigma_px) + 1
    blurred: Tensor = gaussian_blur2d(image[None, None], (size, size), (float(sigma_px), float(sigma_px)), "replicate")
    return blurred[0, 0]


@dataclass(frozen=True, eq=False)
class Blurred:
    """What one image yields.

    Attributes:
        sigma_px: of the blur.
        image: ``(y, x)`` HU.
        segmentation: of the image.
        cap_line: cap thickness in mm along the line from the lumen's to the core's centre.
        core_dice, lumen_dice: overlap with the true tissue.
        depth: of the core's basin in HU (:func:`torchpcct.metrics.plaque_measures.basin_depth`).
    """

    sigma_px: float
    image: Tensor
    segmentation: PlaqueSegmentation
    cap_line: float
    core_dice: float
    lumen_dice: float
    depth: float

    def as_dict(self) -> dict[str, Any]:
        """JSON values."""
        s = self.segmentation
        return {
            "sigma_px": self.sigma_px,
            "fwhm_mm": FWHM_PER_SIGMA * self.sigma_px * s.grid.spacing[0],
            "lumen_mm2": s.lumen_area,
            "core_found": s.core_found,
            "core_mm2": s.core_area,
            "cap_mm": s.cap_thickness,
            "cap_line_mm": self.cap_line,
            "lumen_dice": self.lumen_dice,
            "core_dice": self.core_dice,
            "basin_depth_hu": self.depth,
        }


def centers(plaque: Plaque) -> tuple[tuple[float, float], tuple[float, float]]:
    """``(y, x)`` mm of the lumen's centre in the plaque's middle slice and of the core's."""
    x, y, _, _ = (float(v) for v in plaque.section("lumen", 0.0))
    lumen, core = plaque.to_scanner((x, y, 0.0)), plaque.to_scanner(plaque.core_center)
    return (float(lumen[1]), float(lumen[0])), (float(core[1]), float(core[0]))


def truth(scene: Scene, image: VolumeGrid) -> dict[str, NDArray[np.bool_]]:
    """Where lumen and core are in an axial image ``(1, y, x)``: name → ``(y, x)`` bool."""
    labels = scene.labels(image)[0]
    return {name: labels == scene.index(name) for name in ("lumen", "core")}


def measure(
    image: Tensor,
    grid: VolumeGrid,
    sigma_px: float,
    masks: dict[str, NDArray[np.bool_]],
    line: tuple[tuple[float, float], tuple[float, float]],
) -> Blurred:
    """Blur an axial image and measure it.

    Args:
        image: ``(y, x)`` HU.
        grid: ``(1, y, x)``.
        sigma_px: of the blur.
        masks: ``lumen`` and ``core``, of :func:`truth`.
        line: its ends, of :func:`centers`.
    """
    blurred = blur(image, sigma_px)
    found = segment_plaque(blurred, grid)
    return Blurred(
        sigma_px,
        blurred,
        found,
        cap_on_line(blurred, grid, *line),
        dice(found.core, masks["core"]),
        dice(found.lumen, masks["lumen"]),
        basin_depth(blurred, grid, masks["core"]),
    )


def crossing(x: Any, values: Any, limit: float) -> float:
    """First x at which ``values`` exceed ``limit``, by linear interpolation; NaN values count as exceeding, and the
    last x is returned where none does."""
    x, v = np.asarray(x, dtype=np.float64), np.asarray(values, dtype=np.float64)
    for k in range(len(x)):
        if not v[k] <= limit:
            if k == 0 or math.isnan(v[k]):
                return float(x[k])
            return float(x[k - 1] + (limit - v[k - 1]) / (v[k] - v[k - 1]) * (x[k] - x[k - 1]))
    return float(x[-1])
