"""What once gave a wrong result without a word: each is refused, warned of, or right (scenes,
scans, operators)."""

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from refusals import refused
from small_scan import GRID, SCENE, scanner

from torchpcct import ConeBeam, FanBeam, ParallelBeam, Projector, VolumeGrid, acquire, full_turn
from torchpcct.acquisition.acquire import plan
from torchpcct.detector_window import DetectorWindow, footprint
from torchpcct.geometry import view_step
from torchpcct.scanner.linearisation import WaterLinearisation
from torchpcct.scene.materials import material
from torchpcct.spectral import Basis, vmi_noise


@pytest.fixture(scope="module")
def clean():
    return acquire(SCENE, scanner(), region=GRID, duty=0.06, sub_rays=16)


def test_the_turn_of_a_view_does_not_depend_on_the_order_of_the_views():
    """Views read out of order are the same views: counts follow them, blurred by the same turn."""
    s = scanner(views=60, rows=4)
    order = np.random.default_rng(0).permutation(60)
    shuffled = s.replace(geometry=s.geometry.select(order))
    straight = acquire(SCENE, s, region=GRID, sub_rays=16)
    mixed = acquire(SCENE, shuffled, region=GRID, sub_rays=16)
    np.testing.assert_array_equal(mixed.window.first_column, straight.window.first_column[order])
    torch.testing.assert_close(mixed.counts, straight.counts[order], rtol=2e-6, atol=0)


def test_view_step_by_hand():
    assert view_step(full_turn(8)) == pytest.approx(math.pi / 4)
    assert view_step(full_turn(8)[[3, 0, 5, 1, 2, 7, 4, 6]]) == pytest.approx(math.pi / 4)
    assert view_step(np.array([0.0, 0.0, 0.5, 0.5, 1.0])) == 0.5
    assert view_step(np.array([1.0])) == view_step(np.array([1.0, 1.0])) == 0.0


@pytest.mark.parametrize("tolerance", [math.nan, -1.0, math.inf, -math.inf])
def test_a_tolerance_that_compares_with_nothing_is_refused(tolerance):
    """NaN compares false with every cost, so that all effects were left out; a negative one kept
    all."""
    for call in (plan, acquire):
        with pytest.raises(ValueError, match="tolerance_hu must be"):
            call(SCENE, scanner(views=12, rows=2), tolerance_hu=tolerance)


def test_members_of_a_scan_are_checked(clean):
    s, seven = clean, WaterLinearisation(np.ones((7, 1)), np.ones(7), 0.02)
    aside = replace(s.window, first_column=s.window.first_column + 1500)
    refused(
        ("all counts are zero", lambda: replace(s, counts=s.counts * 0)),
        ("NaN or Inf", lambda: replace(s, counts=s.counts * math.nan)),
        ("negative", lambda: replace(s, counts=-s.counts)),
        ("shape", lambda: replace(s, counts=s.counts[1:])),
        ("exposure_s", lambda: replace(s, exposure_s=0.0)),
        ("exterior", lambda: replace(s, exterior=None)),
        ("air readings", lambda: replace(s, air=s.air * 0)),
        ("air readings must be finite", lambda: replace(s, air=s.air * math.inf)),
        ("air readings must be finite", lambda: replace(s, air=s.air * math.nan)),
        (
            "exterior readings must be finite and greater than 0",
            lambda: replace(s, exterior=s.exterior * 0),
        ),
        ("exterior readings", lambda: replace(s, exterior=s.exterior * math.nan)),
        ("exterior readings", lambda: replace(s, exterior=-s.exterior)),
        (
            "counts must be a tensor of float32",
            lambda: replace(s, counts=s.counts.numpy()),
        ),
        (
            "counts must be a tensor of float32",
            lambda: replace(s, counts=s.counts.long()),
        ),
        ("air must be a tensor of float32", lambda: replace(s, air=1e5)),
        ("geometry must be a ConeBeam", lambda: replace(s, geometry=FanBeam([0.0], 1, 2, 3, 1))),
        ("linearisation must be a WaterLinearisation", lambda: replace(s, linearisation=None)),
        ("window must be a DetectorWindow", lambda: replace(s, window="all")),
        ("seed must be at least 0", lambda: replace(s, seed=-1)),
        ("info must be a mapping", lambda: replace(s, info=3)),
        ("water correction is that of 7 columns", lambda: replace(s, linearisation=seven)),
        ("beyond the detector", lambda: replace(s, window=aside)),
        ("beyond the detector", lambda: replace(s, window=replace(s.window, first_row=5))),
    )


def test_a_window_beyond_the_water_correction_is_refused():
    correction = WaterLinearisation(np.ones((4, 2)), np.ones(4), 0.02)
    with pytest.raises(ValueError, match="beyond the 4 columns"):
        correction.apply(torch.ones(2, 1, 3), DetectorWindow(np.array([0, 2]), 3))
    with pytest.raises(TypeError, match="float32 or float64"):
        correction.apply(torch.ones(4, dtype=torch.int64))


@pytest.mark.parametrize(
    "degrees",
    [np.arange(360.0), np.arange(180.0), np.arange(720) / 2, np.arange(1968) * 360 / 1968],
)
def test_degrees_for_radians_are_noticed(degrees):
    with pytest.warns(UserWarning, match="look like degrees"):
        ParallelBeam(degrees, 10, 1.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ParallelBeam(np.deg2rad(degrees), 10, 1.0)
        ParallelBeam(np.arange(20 * 984) * (2 * math.pi / 984), 10, 1.0)  # a helix of 20 turns


def test_a_windowed_projection_equals_the_whole_one():
    """Whatever else is read: the depth layers of the cone beam must not depend on the rows that
    are kept."""
    g = ConeBeam(full_turn(12), 400.0, 700.0, 60, 40, (2.0, 2.0), detector="curved")
    grid = VolumeGrid((20, 24, 22), (1.9, 2.0, 2.1), (1.0, 4.0, -6.0))
    x = torch.rand(grid.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    whole = Projector(g, grid)(x)
    part = DetectorWindow(np.full(12, 17), 25, 18, 3)
    windowed = Projector(g, grid, part)(x)
    assert float((windowed - whole[:, 18:21, 17:42]).abs().max() / whole.max()) < 1e-12


@pytest.mark.parametrize("detector", ["flat", "curved"])
def test_the_row_offset_moves_the_rows_up(detector):
    """Literal numbers: sod 500, sdd 1000, nine rows of 2 mm moved up by 6 mm. A voxel at z = 4 mm
    on the axis is seen at 8 mm, by row 5; with the offset's sign turned it would be seen by none.
    """
    g = ConeBeam([0.0, 1.0], 500.0, 1000.0, 5, 9, 2.0, (6.0, 0.0), detector)
    np.testing.assert_allclose(g.row_positions, [-2, 0, 2, 4, 6, 8, 10, 12, 14])
    grid = VolumeGrid((1, 1, 1), (0.5, 0.5, 0.5), (4.0, 0.0, 0.0))
    y = Projector(g, grid)(torch.ones(1, 1, 1, dtype=torch.float64))
    seen = y.sum(dim=(0, 2))
    assert seen.argmax() == 5
    assert float(seen[5] / seen.sum()) == pytest.approx(1.0)
    window = footprint(g, grid)
    assert window.first_row <= 5 < window.first_row + window.rows
    assert window.rows <= 3


@pytest.mark.parametrize("z", [500.0, -500.0, 40.0])
def test_a_grid_that_no_row_sees_casts_no_shadow(z):
    g = ConeBeam(full_turn(8), 500.0, 1000.0, 64, 16, 1.0)
    with pytest.raises(ValueError, match="above or below all 16 rows"):
        footprint(g, VolumeGrid((4, 4, 4), 0.5, (z, 0.0, 0.0)))


def test_an_indefinite_covariance_has_no_noise():
    """C12² > C11 C22 gives a negative variance at some energy, which was shown as 0 HU."""
    basis = Basis(material("polyethylene"), material("pvc"))
    for bad in ([1.0, 2.0, 1.0], [1.0, -1.1, 1.0], [math.nan, 0.0, 1.0], [0.0, 0.1, 1.0]):
        with pytest.raises(ValueError, match="C12²"):
            vmi_noise(torch.tensor(bad), basis)
    singular = torch.tensor([4.0, -6.0, 9.0])
    assert bool(torch.isfinite(vmi_noise(singular, basis)).all())
