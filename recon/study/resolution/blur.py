"""The plaque's axial image under growing blur, and the blurs at which it loses what."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from recon.study.paper.measures import PlaqueImage, Truth, measure_plaque

__all__ = ["FWHM_PER_SIGMA", "Blurred", "blur", "blur_series", "crossing", "limits"]

FWHM_PER_SIGMA = 2.0 * math.sqrt(2.0 * math.log(2.0))


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
class Blurred(PlaqueImage):
    """Measures of a blurred image; ``sigma_px``: of the blur, pixels."""

    sigma_px: float

    @property
    def fwhm_mm(self) -> float:
        """Full width at half maximum of the blur."""
        return FWHM_PER_SIGMA * self.sigma_px * self.segmentation.grid.spacing[0]

    def as_dict(self) -> dict[str, Any]:
        """JSON values."""
        cap = self.segmentation.cap_thickness
        return {"sigma_px": self.sigma_px, "fwhm_mm": self.fwhm_mm, "cap_mm": cap, **super().as_dict()}


def blur_series(image: Tensor, truth: Truth, sigmas_px: Sequence[float]) -> list[Blurred]:
    """Blur an axial image ``(y, x)`` HU on ``truth.image`` by every σ, and measure it."""
    return [Blurred(**vars(measure_plaque(blur(image, s), truth)), sigma_px=s) for s in sigmas_px]


def limits(series: list[Blurred], tolerance: float) -> dict[str, Any]:
    """Where a blur series loses what: blurs in pixels.

    Returns:
        ``cap``: blur at which the cap's thickness on the line has changed by ``tolerance``; ``lumen``: the same of the
        lumen's area; ``core_lost``: first blur of the series at which the core is not segmented (None: at none);
        ``basin``: blur at which the core's basin has half of its depth.
    """
    sigmas = [b.sigma_px for b in series]
    sharp = series[0]
    lost = [b.sigma_px for b in series if not b.segmentation.core_found]

    def change(values: list[float], reference: float) -> list[float]:
        return [abs(v / reference - 1.0) for v in values]

    areas = [b.segmentation.lumen_area for b in series]
    return {
        "cap": crossing(sigmas, change([b.cap_line for b in series], sharp.cap_line), tolerance),
        "lumen": crossing(sigmas, change(areas, areas[0]), tolerance),
        "core_lost": lost[0] if lost else None,
        "basin": crossing(sigmas, [sharp.depth - b.depth for b in series], 0.5 * sharp.depth),
    }


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
