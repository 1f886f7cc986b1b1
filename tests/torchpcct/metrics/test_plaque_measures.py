"""Lumen, core and cap by contours and by thresholds, against drawn shapes whose measures are
known."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refusals
from scipy.special import ndtr

from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.plaque_measures import (
    basin_depth,
    cap_on_line,
    dice,
    lumen_area,
    segment_plaque,
)

GRID = VolumeGrid((160, 180), (0.03, 0.025), (-30.0, -29.0))


def distance(center: tuple[float, float], grid: VolumeGrid = GRID) -> np.ndarray:
    """Of every pixel from a point, mm."""
    y, x = np.meshgrid(*grid.axes, indexing="ij")
    return np.hypot(y - center[0], x - center[1])


def edge(
    center: tuple[float, float], radius: float, grid: VolumeGrid = GRID, width: float = 0.08
) -> np.ndarray:
    """1 inside a disc, 0 outside, with a linear edge whose middle lies on the circle."""
    return np.clip(0.5 - (distance(center, grid) - radius) / width, 0.0, 1.0)


def vessel(
    lumen: float = 0.8,
    core: float = 0.35,
    cap: float = 0.2,
    angle: float = 0.0,
    grid: VolumeGrid = GRID,
) -> tuple[np.ndarray, tuple[float, float], tuple[float, float]]:
    """Fat, fibrous tissue (90 HU), blood (410) and beside it a core (30), with the thresholds
    halfway between; and the centres of the two."""
    a = (-30.0 - 0.35 * math.sin(angle), -29.0 - 0.35 * math.cos(angle))
    away = lumen + cap + core
    b = (a[0] + away * math.sin(angle), a[1] + away * math.cos(angle))
    image = -100.0 + 190.0 * edge((-30.0, -29.0), 1.75, grid)
    return image + 320.0 * edge(a, lumen, grid) - 60.0 * edge(b, core, grid), a, b


@settings(max_examples=10, deadline=None)
@given(
    lumen=st.floats(0.4, 0.85),
    core=st.floats(0.2, 0.4),
    cap=st.floats(0.1, 0.25),
    angle=st.floats(-math.pi, math.pi),
)
def test_discs(lumen, core, cap, angle):
    image, a, b = vessel(lumen, core, cap, angle)
    found = segment_plaque(image, GRID)
    # Counting pixels errs by a fraction of those on the rim.
    assert found.lumen_area == pytest.approx(
        math.pi * lumen**2, abs=0.15 * 2 * math.pi * lumen * 0.03
    )
    assert found.core_area == pytest.approx(math.pi * core**2, abs=0.2 * 2 * math.pi * core * 0.03)
    assert found.cap_thickness == pytest.approx(cap, abs=0.004)
    assert cap_on_line(image, GRID, a, b) == pytest.approx(cap, abs=0.003)
    # Contours lie between the pixels.
    assert math.sqrt(lumen_area(image, GRID, a) / math.pi) == pytest.approx(lumen, abs=1e-3)


@pytest.mark.parametrize("radius", [0.4, 1.1])
def test_contours_at_another_threshold_of_a_blurred_edge(radius):
    grid, sigma = VolumeGrid((1, 200, 200), 0.035, (0.0, -30.0, -29.0)), 0.1
    image = 100.0 + 400.0 * ndtr((radius - distance((-30.0, -29.5), grid.slice)) / sigma)
    higher = lumen_area(torch.from_numpy(image)[None], grid, (-30.0, -29.5), threshold=400.0)
    # A thirtieth of a pixel: what linear interpolation of a bent profile costs.
    assert math.sqrt(higher / math.pi) == pytest.approx(radius - sigma * 0.6745, abs=1.2e-3)


def test_area_is_in_square_millimetres_of_any_pixel():
    grid = VolumeGrid((80, 150), (0.06, 0.03), (1.0, 2.0))
    area = lumen_area(500 * edge((1.01, 2.02), 0.9, grid, 0.2), grid, (1.0, 2.0))
    assert area == pytest.approx(math.pi * 0.9**2, rel=3e-3)


def test_contours_that_are_lost_are_nan():
    image, a, _ = vessel()
    assert math.isnan(lumen_area(image, GRID, a, threshold=600.0))
    assert math.isnan(lumen_area(image, GRID, (-33.0, -32.0)))


def test_rims_belong_to_the_band_but_not_to_the_core():
    image, _, b = vessel()
    found = segment_plaque(image, GRID)
    assert found.core_found
    assert found.band.sum() > 1.5 * found.core.sum()  # the rim between tissue and fat
    assert distance(b)[found.core].max() < 0.35
    assert (found.band & ~found.core)[distance(b) < 0.25].sum() == 0


def test_an_open_core_is_lost_but_not_its_line():
    image, a, b = vessel()
    rows, columns = (np.abs(GRID.axes[0] - b[0]) < 0.05), GRID.axes[1] > b[1]
    image[np.ix_(rows, columns)] = np.minimum(image[np.ix_(rows, columns)], 50.0)
    found = segment_plaque(image, GRID)
    assert not found.core_found
    assert math.isnan(found.core_area)
    assert math.isnan(found.cap_thickness)
    assert found.lumen_area == pytest.approx(math.pi * 0.8**2, rel=0.02)
    assert cap_on_line(image, GRID, a, b) == pytest.approx(0.2, abs=0.003)


def test_a_diagonal_line_of_bright_pixels_closes():
    image = np.full((7, 7), 100.0)
    image[:2] = -100.0
    image[3, 3] = image[2, 2] = 40.0  # dark pixels that touch at a corner only
    image[5, 3] = 500.0
    found = segment_plaque(image, VolumeGrid((7, 7), 0.5))
    assert found.core.sum() == 1
    assert found.core[3, 3]
    assert found.core_area == 0.25


def test_nothing_there():
    found = segment_plaque(np.full((5, 6), -100.0), VolumeGrid((5, 6), 0.1))
    assert not found.lumen.any()
    assert math.isnan(found.lumen_area)
    assert math.isnan(found.cap_thickness)
    fat = np.full((5, 6), -100.0)
    assert math.isnan(cap_on_line(fat, VolumeGrid((5, 6), 0.1), (0.0, -0.2), (0.0, 0.2)))
    bright = np.full((5, 6), 500.0)
    assert math.isnan(cap_on_line(bright, VolumeGrid((5, 6), 0.1), (0.0, -0.2), (0.0, 0.2)))


def test_tensors_slices_and_any_place():
    image, _, _ = vessel()
    plain = segment_plaque(image, GRID)
    one = VolumeGrid((1, *GRID.shape), (0.1, *GRID.spacing), (3.0, 5.0, 7.0))
    moved = segment_plaque(torch.from_numpy(image)[None].float(), one)
    np.testing.assert_array_equal(moved.core, plain.core)
    assert moved.cap_thickness == pytest.approx(plain.cap_thickness, abs=1e-6)
    turned = segment_plaque(image.T, VolumeGrid(GRID.shape[::-1], GRID.spacing[::-1]))
    np.testing.assert_array_equal(turned.core, plain.core.T)
    assert turned.cap_thickness == pytest.approx(plain.cap_thickness, rel=1e-9)
    double = segment_plaque(image, VolumeGrid(GRID.shape, tuple(2 * s for s in GRID.spacing)))
    assert double.cap_thickness == pytest.approx(2 * plain.cap_thickness, rel=1e-9)
    assert double.lumen_area == pytest.approx(4 * plain.lumen_area, rel=1e-12)


def test_depth_of_a_basin():
    image = np.full((7, 9), 100.0)
    image[:, :2] = -90.0
    image[3, 4:7] = (55.0, 40.0, 60.0)
    grid = VolumeGrid((7, 9), 0.1)
    core = np.zeros((7, 9), bool)
    core[2:5, 3:8] = True
    assert basin_depth(image, grid, core) == 100.0 - 40.0
    image[3, 2:4] = 65.0, 70.0  # a way to the fat, and its highest point
    assert basin_depth(image, grid, core) == 70.0 - 40.0
    image[3, 2:4] = 100.0
    image[2, 7] = image[1, 8] = -50.0  # corners do not open it
    assert basin_depth(image, grid, core) == 100.0 + 50.0
    slope = np.broadcast_to(np.arange(9.0), (7, 9))
    assert basin_depth(slope, grid, core) == 0.0
    assert not segment_plaque(slope, grid).core_found


def test_dice():
    a, b = np.zeros((2, 4), bool), np.zeros((2, 4), bool)
    assert math.isnan(dice(a, b))
    a[0], b[0, 2:] = True, True
    assert dice(a, b) == pytest.approx(2 * 2 / 6)
    assert dice(a, ~a) == 0.0


test_refusals = refusals(
    ("one slice of the grid's shape", lambda: segment_plaque(np.zeros((3, 3)), GRID)),
    (
        "sample the axial image",
        lambda: segment_plaque(np.zeros((2, 3, 3)), VolumeGrid((2, 3, 3), 1.0)),
    ),
    ("NaN", lambda: segment_plaque(np.full(GRID.shape, np.nan), GRID)),
    ("leaves the image", lambda: cap_on_line(np.zeros(GRID.shape), GRID, (-30, -29), (-30, -9))),
    ("apart", lambda: cap_on_line(np.zeros(GRID.shape), GRID, (-30, -29), (-30, -29))),
    ("must mark pixels", lambda: basin_depth(np.zeros(GRID.shape), GRID, np.zeros(GRID.shape))),
    ("same shape", lambda: dice(np.zeros(3), np.zeros(4))),
    ("shape", lambda: lumen_area(np.zeros((3, 3)), GRID, (0, 0))),
    ("NaN", lambda: lumen_area(np.full(GRID.shape, np.nan), GRID, (0, 0))),
)
