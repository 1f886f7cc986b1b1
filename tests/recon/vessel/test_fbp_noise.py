"""FBP's noise over regions, against the exact covariance of the same means."""

from types import SimpleNamespace

import numpy as np
import pytest
from small_scan import GRID

from recon.analytic.exact_noise import roi_covariance
from recon.analytic.inset import InsetFbp
from recon.vessel.fbp_noise import fbp_deviations
from torchpcct.metrics.roi import RoiMean


def test_deviations_are_those_of_fbp(clean):
    z, y, x = np.meshgrid(
        *(a - c for a, c in zip(GRID.axes, GRID.center, strict=True)), indexing="ij"
    )
    regions = {
        "fibrous": (np.abs(x + 0.8) < 0.5) & (np.abs(y) < 1) & (np.abs(z) < 1),
        "core": (np.abs(x - 0.8) < 0.5) & (np.abs(y) < 1) & (np.abs(z) < 1),
        "fat": np.hypot(x, y) > 2.4,
    }
    found = fbp_deviations(clean, GRID, {n: r.astype(np.float32) for n, r in regions.items()})
    rois = [RoiMean(GRID, GRID, regions[n]) for n in ("fibrous", "core", "fat")]
    exact = roi_covariance(clean, InsetFbp(clean, [GRID], ["soft"]), [rois], 1.0)[0][0]
    # The ball takes some of the photons, which the expected readings do not know.
    for k, name in enumerate(("fibrous", "core", "fat")):
        assert found[name] == pytest.approx(exact[k, k] ** 0.5, rel=0.03)
    assert found["contrast"] == pytest.approx(
        (exact[0, 0] + exact[1, 1] - 2 * exact[0, 1]) ** 0.5, rel=0.03
    )


def test_a_scan_of_the_whole_detector_is_refused():
    with pytest.raises(ValueError, match="exterior is known"):
        fbp_deviations(
            SimpleNamespace(window=None, exterior=None),
            GRID,
            {"fat": np.ones(GRID.shape, np.float32)},
        )
