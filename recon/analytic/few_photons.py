"""By how much does an image of few photons read too high or too low?"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import uniform_filter
from torch import Tensor

from recon.analytic.water_unit import row_image
from torchpcct.checks.logarithm import logarithm_error
from torchpcct.geometry import Beam
from torchpcct.scan import Scan

TOLERANCE = 0.015
"""Error of a region, over the attenuation of the object, that is no finding: the noise of a region
of some ten voxels at such doses is as large. Twice as much where the error is not known well."""
_REGION = 0.06
"""Width of a region, in fields of view."""
_OBJECT = 0.4
"""Attenuation over the object's highest, of regions, from which a place is inside."""


def bias_warnings(scan: Scan, lines: Tensor, geometry: Beam) -> list[str]:
    """How far filtered backprojection is off where logarithms are of few photons.

    Args:
        scan: noisy, without energy bins.
        lines: its line integrals ``(views, [rows,] columns)``, of the middle slice of several.
        geometry: of ``lines``.

    Returns:
        One sentence, or none.
    """
    if lines.shape[0] != scan.geometry.views:
        return []
    found = logarithm_error(scan)
    if found is None:
        return []
    error, sure = found
    if error.ndim > lines.ndim:
        error = error[error.shape[0] // 2]
    error, p = (v.reshape(geometry.views, -1, geometry.columns).double() for v in (error, lines))
    row = int(error.abs().mean((0, 2)).argmax())
    images = [row_image(values[:, row], geometry) for values in (error, p)]
    if images[0] is None or images[1] is None:
        return []
    size = max(3, round(_REGION * len(images[0])))
    off, density = (uniform_filter(image, size) for image in images if image is not None)
    inside = density > _OBJECT * float(density.max())
    if not inside.any():
        return []
    least, most = float(off[inside].min()), float(off[inside].max())
    worst = most if most > -least else least
    usual = float(np.median(density[inside]))
    if abs(worst) < (1.0 if sure and scan.logged else 2.0) * TOLERANCE * usual:
        return []
    if scan.unit == "HU":
        text = f"{1000.0 * abs(worst) / scan.linearisation.mu_ref:.2g} HU"
    else:
        text = f"{abs(worst):.2g} {scan.unit}"
    if not scan.logged:
        return [
            f"some rays leave so few photons that their number is not known: filtered "
            f"backprojection reads too {'high' if worst > 0 else 'low'} by about {text} in the "
            "worst region; raise the exposure, or bin the readings"
        ]
    if sure:
        side = f"too {'high' if worst > 0 else 'low'} by about {text} in the worst region"
    else:
        side = (
            f"off by about {text} in the worst region: too high where the logarithm is that of "
            "the readings, too low where 1 was added, right where a half was"
        )
    return [
        "these are logarithms of few photons, whose mean is not the logarithm of the mean: "
        f"filtered backprojection reads {side}; give the readings (Scan.from_counts), of which "
        "that is taken off"
    ]
