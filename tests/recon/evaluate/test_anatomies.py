"""Anatomies that break assumptions: each feature is there, in the tissue it belongs to, and the base is not changed."""

import math

import numpy as np
import pytest

from recon.evaluate.anatomies import ANATOMIES, TISSUES_HU, anatomy, coarsened
from torchpcct import VolumeGrid
from torchpcct.scene.raster import label_fractions
from torchpcct.scene.scene import voxel_centres

COARSE = VolumeGrid((29, 23, 23), 0.4)
POINTS = voxel_centres(COARSE)


@pytest.mark.parametrize("name", ANATOMIES)
def test_the_feature_is_all_that_differs(name):
    what = ANATOMIES[name]
    names = list(what.values)
    with_, without = (what.labels(POINTS, feature=f) for f in (True, False))
    changed = {names[k] for k in np.unique(with_[with_ != without])}
    fine = label_fractions(lambda p: what.labels(p, feature=True) != what.labels(p, feature=False), 2, COARSE)
    if not what.feature:
        assert not changed
        return
    assert fine[1].sum() * 0.4**3 > 0.05, "a feature of 0.05 mm³ or more"
    assert changed <= {part.tissue for part in what.feature}
    # The inset holds it: nothing differs at its rim along x and y.
    differs = with_ != without
    assert not differs[:, [0, -1]].any()
    assert not differs[:, :, [0, -1]].any()


def test_features_have_the_sizes_they_are_said_to_have():
    def volume_mm3(name, tissue):
        what = anatomy(name)
        index = list(what.values).index(tissue)
        grid = VolumeGrid((60, 60, 60), 0.1)
        both = [
            label_fractions(lambda p, f=f: (what.labels(p, feature=f) == index) - 1, 1, grid) for f in (True, False)
        ]
        return float((both[0] - both[1]).sum()) * 0.1**3

    # A ball of 0.5 mm that lies across the wall's two faces, one of 1.1 mm that the lumen's wall cuts.
    assert 0.3 < volume_mm3("calcification", "calcium") / (math.pi / 6 * 0.5**3) < 1.0
    assert 0.7 < volume_mm3("thrombus", "thrombus") / (math.pi / 6 * 1.1**3) < 1.0
    a, b, c = ANATOMIES["core"].feature[0].inside.__closure__[0].cell_contents.semi_axes
    assert volume_mm3("core", "core") == pytest.approx(4 / 3 * math.pi * a * b * c, rel=2e-3)


def test_truth_and_regions_agree_with_the_labels():
    what, grid = anatomy("calcification"), VolumeGrid((12, 24, 24), 0.2)
    with_, without = (coarsened(what.painted(grid, feature=f)) for f in (True, False))
    assert with_.shape == grid.shape
    assert without.min() == TISSUES_HU["fat"]
    where = what.regions(with_, without, grid)
    assert where.feature.any()
    assert (where.beside >= where.feature).all()
    assert not (where.elsewhere & where.beside).any()
    np.testing.assert_array_equal(with_[where.elsewhere], without[where.elsewhere])
    assert ((with_ - without)[where.feature] > 300.0).all()
    healthy = anatomy("healthy")
    assert healthy.base_key == what.base_key
    nothing = healthy.regions(without, without, grid)
    assert not nothing.feature.any()
    assert not nothing.beside.any()
    assert nothing.elsewhere.sum() > where.elsewhere.sum()
    with pytest.raises(ValueError, match="ulcer"):
        anatomy("ulcre")
