"""What goes on beyond an inset's grid, or lies beside it, is named by the methods that cannot
explain it; FBP can."""

from dataclasses import replace

import pytest
import torch
from small_scan import CENTER, GRID

from recon import reconstruct
from recon.least_squares.inset_problem import InsetProblem
from torchpcct import VolumeGrid

SHORT = replace(GRID, shape=(2, 18, 18))
"""Two slices of 0.4 mm within a ball of 2.4 mm."""
BESIDE = VolumeGrid((8, 6, 6), 0.4, (CENTER[0], CENTER[1] + 3.2, CENTER[2]))
"""2.4 mm in the plane, which a ball of 3.2 mm reaches into by less than half of it."""
EXPOSURES_S = (None, 2.0)
SLICES, SIDES = "end of the grid's slices", "lies beside the grid"


def found(scan, grid):
    return InsetProblem(scan, grid, nodes=1).beyond(scan)


def with_exposure(clean, exposure_s, seed=0):
    return clean if exposure_s is None else clean.with_noise(exposure_s, seed)


@pytest.mark.parametrize("exposure_s", EXPOSURES_S)
def test_a_ball_that_slices_cut_is_named_at_both_ends(clean, exposure_s):
    (text,) = found(with_exposure(clean, exposure_s), SHORT)
    assert "the lower and the upper " + SLICES in text
    assert "z = -0.4 … 0.4 mm" in text


def test_only_the_end_that_is_cut_is_named(clean):
    z, y, x = CENTER
    upper = VolumeGrid((5, 18, 18), 0.4, (z + 1.0, y, x))
    (text,) = found(clean, upper)
    assert "beyond the lower " + SLICES in text


@pytest.mark.parametrize("exposure_s", EXPOSURES_S)
def test_a_ball_beside_the_grid_is_named_with_the_region_that_holds_it(clean, exposure_s):
    (text,) = found(with_exposure(clean, exposure_s), BESIDE)
    assert SIDES in text
    assert str(GRID) in text


def test_a_grid_that_holds_the_ball_is_not_warned_of(clean):
    """Few photons neither, for which whole rows are off by the bias of the logarithm."""
    fitting = replace(GRID, shape=(6, 8, 8))
    for grid in (GRID, fitting, replace(GRID, shape=(10, 24, 24))):
        for exposure_s in (None, 2.0, 0.02, 0.002):
            for seed in range(1 if exposure_s is None else 5):
                assert not found(with_exposure(clean, exposure_s, seed), grid)


def test_a_moving_grid_is_followed(clean, problem):
    """Of a ball at rest, that grid leaves it; the problem at rest says nothing."""
    path = torch.zeros(clean.geometry.views, 3).numpy()
    assert not problem.with_motion(path).beyond(clean)
    path[:, 1] = 6.0
    assert SIDES in problem.with_motion(path).beyond(clean)[0]


@pytest.mark.parametrize("method", ["pwls", "mbir"])
def test_volumes_carry_the_warning(clean, method):
    """Without noise nothing else speaks against them."""
    options = {"tolerance": 5.0} if method == "pwls" else {}
    assert any(
        SLICES in text for text in reconstruct(clean, SHORT, method, **options).report["warnings"]
    )


def test_fbp_of_few_slices_is_that_of_many(clean):
    many, few = (reconstruct(clean, grid, "fbp") for grid in (GRID, SHORT))
    torch.testing.assert_close(few.data, many.data[3:5], rtol=0, atol=1e-3)
    assert not any(SLICES in text for text in few.report["warnings"])
