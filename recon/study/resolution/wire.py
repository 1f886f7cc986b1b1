"""How wide the system makes a point: a thin wire, reconstructed."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from recon.analytic.inset import InsetFbp
from recon.study.resolution.blur import FWHM_PER_SIGMA
from torchpcct.acquisition.acquire import acquire
from torchpcct.geometry import VolumeGrid
from torchpcct.scanner import Scanner
from torchpcct.scene import Body, EllipticCylinder, Scene
from torchpcct.scene.plaque import PATIENT_DIAMETER

__all__ = ["SystemWidth", "point_width", "wire_width"]

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
