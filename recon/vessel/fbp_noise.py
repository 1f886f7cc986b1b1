"""What the noise of a scan does to FBP's means over a reading's regions: the other half of an
honest comparison."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from recon.analytic.exact_noise import roi_adjoints
from recon.analytic.inset import InsetFbp
from recon.vessel.reading import core_regions
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.roi import RoiMean
from torchpcct.scan import Scan

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


def fbp_deviations(
    scan: Scan, grid: VolumeGrid, regions: Mapping[str, ArrayLike]
) -> dict[str, float]:
    """Standard deviation in HU of soft FBP's mean over each region, and of the contrast, of the
    noise alone.

    One adjoint pass a region (:mod:`recon.analytic.exact_noise`), with the variance of the readings
    that is expected behind the known exterior: what the inset adds to the attenuation, a few per
    cent of the counts, is left out, and so is that the regions were found in the same noise.

    Args:
        scan: windowed, its exterior known, noisy or noise free (then of the exposure its readings
            stand for).
        grid: of the regions.
        regions: name → shares of the voxels, as :attr:`recon.vessel.reading.PlaqueReading.regions`.

    Raises:
        ValueError: a scan of the whole detector, or of an unknown exterior.
    """
    if scan.window is None or scan.exterior is None:
        raise ValueError(
            "the noise of regions needs a scan whose exterior is known: acquire it with region="
        )
    masks = core_regions(regions)
    fbp = InsetFbp(scan, [grid], ["soft"])
    slope = scan.linearisation.slope(scan.air.log() - scan.exterior.log())
    variance = slope.square() / scan.exterior
    pair = [n for n in masks if n in ("fibrous", "core")]
    # The vectors are large: no more than two at a time.
    groups: list[list[str]] = [pair] if pair else []
    groups += [[n] for n in masks if n not in pair]
    found: dict[str, float] = {}
    for names in groups:
        adjoints = roi_adjoints(scan, fbp, [[RoiMean(grid, grid, masks[n]) for n in names]])
        covariance = adjoints.covariance_of(adjoints.window.take(variance))
        found |= {n: math.sqrt(covariance[k, k]) for k, n in enumerate(names)}
        if len(names) == 2:
            found["contrast"] = math.sqrt(
                covariance[0, 0] + covariance[1, 1] - 2.0 * covariance[0, 1]
            )
    return found
