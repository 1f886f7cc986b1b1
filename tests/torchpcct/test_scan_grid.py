"""The grid of what a scan sees: regions, windows of which nothing else is known, whole
detectors."""

import re
from dataclasses import replace
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
from small_scan import GRID, SCENE, scanner

from recon import reconstruct
from torchpcct import ConeBeam, FanBeam, ParallelBeam, Scan, VolumeGrid, acquire, full_turn
from torchpcct.detector_window import DetectorWindow, footprint
from torchpcct.files import seal
from torchpcct.scan_grid import grid_of

CELL = 0.35 / (1098.0 / 626.0)


@pytest.fixture(scope="module")
def clean():
    return acquire(SCENE, scanner(views=24), region=GRID, duty=0.06, sub_rays=16)


def test_a_scan_gives_the_region_it_was_acquired_for(clean, tmp_path):
    assert VolumeGrid.of(clean) is clean.region is GRID
    noisy = clean.with_noise(1.0, 0)
    noisy.save(tmp_path / "scan.h5")
    loaded = Scan.load(tmp_path / "scan.h5")
    for scan in (noisy, noisy.at_dose(0.5), noisy.select(slice(0, 24, 2)), loaded):
        assert VolumeGrid.of(scan) == GRID
    assert VolumeGrid.of(clean, voxel=0.8) == VolumeGrid((4, 9, 9), 0.8, GRID.center)
    assert VolumeGrid.of(clean, voxel=0.7).shape == (5, 11, 11)  # as much as the region, or more
    assert VolumeGrid.of(clean, extent=(2.0, 4, 6)) == VolumeGrid((5, 10, 15), 0.4, GRID.center)
    assert VolumeGrid.of(clean, center=(0, -30, -29)) == VolumeGrid(GRID.shape, 0.4, (0, -30, -29))


def test_a_region_of_one_voxel_is_an_extent(clean):
    box = replace(clean, region=VolumeGrid((1, 1, 1), (3.2, 7.2, 7.2), GRID.center))
    found = VolumeGrid.of(box)
    assert found.spacing == pytest.approx((CELL,) * 3)
    assert found.shape == (17, 37, 37)  # it is covered
    assert found.center == GRID.center


def test_a_file_without_a_region_still_loads_and_shows_what_it_sees(clean, tmp_path):
    path = tmp_path / "old.h5"
    clean.with_noise(1.0, 0).save(path)
    with h5py.File(path, "r+") as file:
        for name in [n for n in file["window"].attrs if n.startswith("region")]:
            del file["window"].attrs[name]
        file.attrs["version"] = 4
    seal(path)
    scan = Scan.load(path)
    assert scan.region is None
    found = VolumeGrid.of(scan)
    # All rows are kept, and cells are whole: the plane to a cell and a half.
    assert found.center[1:] == pytest.approx(GRID.center[1:], abs=CELL)
    assert found.extent[1:] == pytest.approx(GRID.extent[1:], abs=1.5 * CELL)
    assert reconstruct(scan, found, "fbp").data.shape == found.shape


@pytest.mark.parametrize("detector", ["curved", "flat"])
@pytest.mark.parametrize("arc", [2 * np.pi, 3.6])
def test_the_box_that_a_window_sees_lies_within_it(detector, arc):
    """Of windows that no region made, too."""
    draw = np.random.default_rng(3)
    angles = draw.uniform(0, 6) + np.arange(40) * arc / 40
    geometry = ConeBeam(angles, 600.0, 1000.0, 900, 20, (1.0, 0.5), (1.0, 3.0), detector)
    for _ in range(4):
        place = (draw.uniform(-2, 2), *draw.uniform(-40, 40, 2))
        region = VolumeGrid((1, 1, 1), (4.0, *draw.uniform(10, 20, 2)), place)
        exact = footprint(geometry, region, margin=1)
        first = np.maximum(exact.first_column - draw.integers(0, 9, 40), 0)
        for window in (
            exact,
            DetectorWindow(first, exact.columns + 12, exact.first_row, exact.rows),
        ):
            scan = _windowed(geometry, window)
            box = grid_of(scan)
            assert window.holds(footprint(geometry, box, margin=1))
            assert np.all(np.abs(np.subtract(box.center[1:], region.center[1:])) < 3.0)
            if window is exact and arc > 6:
                assert box.extent[1:] == pytest.approx(region.extent[1:], abs=1.0)


def _windowed(geometry, window):
    return SimpleNamespace(geometry=geometry, window=window, region=None)


def test_a_window_that_sees_no_box_asks_for_one():
    geometry = ConeBeam(full_turn(8), 600.0, 1000.0, 40, 4, 1.0)
    first = np.array([0, 38, 0, 38, 0, 38, 0, 38])
    for window in (DetectorWindow(first, 2, 0, 4), DetectorWindow(np.minimum(first, 32), 8, 0, 4)):
        with pytest.raises(ValueError, match="give extent and center"):
            grid_of(_windowed(geometry, window))


def test_whole_detectors_give_their_field_of_view():
    flat = Scan.from_line_integrals(
        np.full((3, 12, 20), 0.1), ParallelBeam(np.arange(12) * np.pi / 12, 20, 0.5)
    )
    assert VolumeGrid.of(flat) == VolumeGrid((3, 19, 19), 0.5)
    assert VolumeGrid.of(flat, voxel=1.0, extent=(4, 6)) == VolumeGrid((3, 4, 6), 1.0)
    one = replace(flat, **flat.each(lambda v: v[0]), air=flat.air[0])
    assert VolumeGrid.of(one, center=(1, 2)) == VolumeGrid((19, 19), 0.5, (1, 2))
    fan = FanBeam(full_turn(12), 100.0, 200.0, 20, 1.0)
    radius = 100 * np.sin(np.arctan(9.5 / 200))
    assert VolumeGrid.of(Scan.from_line_integrals(np.full((12, 20), 0.1), fan)).extent[
        0
    ] == pytest.approx(2 * radius, abs=0.5)
    cone = Scan.from_line_integrals(
        np.full((12, 8, 20), 0.1), ConeBeam(full_turn(12), 100.0, 200.0, 20, 8, 1.0)
    )
    # 8 rows of 0.5 mm at the axis, less towards the source
    assert VolumeGrid.of(cone) == VolumeGrid((7, 19, 19), 0.5)


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"voxel": 0}, "voxel must be greater than 0 mm"),
        ({"voxel": float("nan")}, "voxel must be finite"),
        ({"extent": (1, 2)}, "extent must be three numbers, Z Y X; got 2"),
        ({"extent": (1, -2, 1)}, "extent[1] must be greater than 0 mm"),
        ({"center": (1, 2)}, "center must be three numbers, Z Y X; got 2"),
        ({"center": (1, float("inf"), 2)}, "center[1] must be finite"),
    ],
)
def test_values_that_make_no_grid_are_refused(clean, asked, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        VolumeGrid.of(clean, **asked)


def test_only_a_part_of_a_detector_has_a_region(clean):
    whole = Scan.from_counts(
        np.ones((8, 4, 6), np.float32), ConeBeam(full_turn(8), 60.0, 100.0, 6, 4, 1.0), air=2.0
    )
    for scan, region in ((whole, GRID), (clean, GRID.slice)):
        with pytest.raises(ValueError, match="region must be"):
            replace(scan, region=region)
    with pytest.raises(TypeError, match="region must be a VolumeGrid"):
        replace(clean, region=(8, 18, 18))
    part = clean.window.widened(-20, clean.window)
    assert clean.crop(part).region is None
    assert clean.crop(clean.window).region == GRID
