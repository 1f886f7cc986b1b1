"""Detectors as they are: half fans, rows that end inside the object, dead cells. Compared with
exact bodies."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic import Ellipsoid, Gaussian, line_integrals

from recon.analytic.angular_weights import angular_weights, offset_share
from recon.analytic.detector_edges import Rows, continued, cut_off, ends_cut_off
from recon.analytic.fbp import fbp
from torchpcct.angles import is_offset
from torchpcct.geometry import ConeBeam, FanBeam, ParallelBeam, VolumeGrid, full_turn
from torchpcct.scan import Scan

MU = 0.02
BODY = (
    Ellipsoid((4.0, -6.0), (70.0, 85.0), value=MU),
    Gaussian((20.0, 30.0), 8.0, value=0.3 * MU),
    Gaussian((-30.0, -45.0), 6.0, value=-0.2 * MU),
)
GRID = VolumeGrid((96, 96), 2.0)
FULL = {
    "parallel": ParallelBeam(full_turn(240), 220, 1.0),
    "flat": FanBeam(full_turn(360), 600.0, 1000.0, 220, 1.7),
    "curved": FanBeam(full_turn(360), 600.0, 1000.0, 220, 1.7, detector="curved"),
}


def truth_and_inside(grid, margin=6.0, radius=math.inf):
    """Values at the voxels, and those that lie ``margin`` mm inside the body and within
    ``radius`` of the axis."""
    y, x = grid.axes[-2][:, None], grid.axes[-1]
    value = sum(b.at(np.zeros(1), y, x) for b in BODY)
    shrunk = (
        Ellipsoid((4.0, -6.0), (70.0 - margin, 85.0 - margin), value=1.0).at(np.zeros(1), y, x) > 0
    )
    return value, shrunk & (np.hypot(y, x) < radius)


def cropped(geometry, before, behind):
    """The geometry without its first and last columns."""
    pitch = geometry.pitch[1] if isinstance(geometry, ConeBeam) else geometry.pitch
    shift = 0.5 * (before - behind) * pitch
    offset = (
        (geometry.offset[0], geometry.offset[1] + shift)
        if isinstance(geometry, ConeBeam)
        else shift
    )
    return replace(geometry, columns=geometry.columns - before - behind, offset=offset)


def scanned(geometry):
    return torch.from_numpy(line_integrals(geometry, BODY, sub=(1, 2)))


def worst(image, grid, radius=math.inf):
    value, inside = truth_and_inside(grid, radius=radius)
    assert inside.sum() > 100
    return float(np.abs(image.numpy() - value)[..., inside].max() / MU)


@pytest.mark.parametrize("lost", [(90, 0), (0, 60), (12, 0)], ids=["first", "last", "few"])
@pytest.mark.parametrize("kind", FULL)
def test_offset_detectors_see_the_whole_object(kind, lost):
    """Half of the cells are enough: within 1 % of the exact values everywhere, as the whole
    detector is."""
    geometry = cropped(FULL[kind], *lost)
    assert is_offset(geometry)
    sinogram = scanned(geometry)
    assert worst(fbp(sinogram, geometry, GRID), GRID) < 0.01
    whole = scanned(FULL[kind])
    assert worst(fbp(whole, FULL[kind], GRID), GRID) < 0.01


@pytest.mark.parametrize("detector", ["flat", "curved"])
def test_offset_cone_beams(detector):
    whole = ConeBeam(full_turn(180), 600.0, 1000.0, 220, 4, (3.0, 1.7), (0.5, 0.0), detector)
    geometry, grid = cropped(whole, 0, 90), VolumeGrid((2, 96, 96), (1.0, 2.0, 2.0))
    image = fbp(scanned(geometry), geometry, grid)
    assert worst(image, grid) < 0.01


def test_shares_of_a_pair_add_up_to_one_and_vanish_at_the_short_edge():
    for u in (np.arange(100) - 20.0, np.arange(100) - 80.0):
        share = offset_share(u)
        overlap = np.abs(u) <= 19
        np.testing.assert_allclose(
            share[overlap] + np.interp(-u, u, share)[overlap], 1.0, atol=1e-12
        )
        assert share[np.abs(u).argmax()] == 1.0
        short = share[0] if u[-1] > -u[0] else share[-1]
        assert 0.0 <= short < 2e-3
    with pytest.raises(ValueError, match="lie on one side of the projection of the rotation axis"):
        offset_share(np.arange(10) + 3.0)


def test_half_a_turn_of_an_offset_detector_is_refused():
    geometry = cropped(replace(FULL["flat"], angles=np.arange(500) * math.pi / 360), 90, 0)
    with pytest.raises(
        ValueError, match=r"the detector is offset .* needs a full turn, but the views cover 250"
    ):
        angular_weights(geometry)


@pytest.mark.parametrize("lost", [(0, 14), (14, 0)])
def test_a_short_scan_of_an_offset_detector_within_its_short_side(lost):
    """An object that both sides see is measured whole in 240°, however far the long side
    reaches."""
    turn = np.arange(480) * math.radians(240.0) / 479
    geometry = cropped(replace(FULL["flat"], angles=turn), *lost)
    assert is_offset(geometry)
    radius = geometry.fov_radius
    grid = VolumeGrid((96, 96), 2.0 * (radius - 1.0) / 96)
    assert worst(fbp(scanned(geometry), geometry, grid), grid) < 0.015
    with pytest.raises(
        ValueError, match=rf"reconstruct no more than {radius:.4g} mm about the axis"
    ):
        fbp(scanned(geometry), geometry, VolumeGrid((96, 96), 2.1 * radius / 96))


@pytest.mark.parametrize("kind", FULL)
def test_rows_that_end_inside_the_object_are_continued(kind):
    """60 % of the width: 1 % in the inner 80 % of the field of view; just ending the rows errs
    by more than 10 %."""
    geometry = cropped(FULL[kind], 44, 44)
    sinogram = scanned(geometry)
    radius = 0.8 * (66.0 if kind == "parallel" else geometry.fov_radius)
    with pytest.warns(UserWarning, match="end inside the object at the first and the last column"):
        ended = fbp(sinogram, geometry, GRID)
    assert worst(ended, GRID, radius) > 0.1
    assert worst(fbp(sinogram, geometry, GRID, outside=MU), GRID, radius) < 0.01


def test_a_cut_cylinder_is_continued_exactly():
    for whole in (
        *FULL.values(),
        ConeBeam(full_turn(12), 600.0, 1000.0, 220, 3, (40.0, 1.7), detector="curved"),
    ):
        # The rays of a fan turn: off the axis the fit is close, not exact.
        body = [
            Ellipsoid(
                (5.0, -6.0) if isinstance(whole, ParallelBeam) else (0.0, 0.0), 95.0, value=MU
            )
        ]
        geometry = cropped(whole, 40, 30)
        lines = torch.from_numpy(line_integrals(geometry, body, sub=1))
        weights = np.ones((geometry.views, 1))
        assert cut_off(lines, geometry, weights) == (True, True)
        rows = continued(Rows(lines, geometry, weights), (True, True), MU)
        expected = line_integrals(rows.geometry, body, sub=1)
        # The square root amplifies rounding where the chord ends.
        np.testing.assert_allclose(rows.lines.numpy(), expected, atol=1e-6 * expected.max())
        before = (rows.geometry.columns - geometry.columns) // 2
        assert torch.equal(rows.lines[..., before : before + geometry.columns], lines)


def test_an_offset_detector_may_be_cut_on_its_long_side_too():
    geometry = cropped(FULL["flat"], 44, 90)
    sinogram = scanned(geometry)
    radius = 0.75 * 600.0 * math.sin(math.atan(66 * 1.7 / 1000.0))
    with pytest.warns(UserWarning, match="at the first column"):
        fbp(sinogram, geometry, GRID)
    assert worst(fbp(sinogram, geometry, GRID, outside=MU), GRID, radius) < 0.015


def test_noise_in_air_is_not_taken_for_an_object():
    geometry = FULL["flat"]
    sinogram = scanned(geometry)
    noise = torch.randn(sinogram.shape, generator=torch.Generator().manual_seed(0))
    for level in (0.05, 0.3):
        fbp(sinogram + level * noise, geometry, VolumeGrid((8, 8), 2.0))  # warnings are errors
    order = torch.randperm(geometry.views, generator=torch.Generator().manual_seed(1))
    cut = cropped(geometry, 44, 44)
    shuffled = cut.select(order.numpy())
    with pytest.warns(UserWarning, match="end inside the object"):
        fbp(scanned(cut)[order] + 0.05 * noise[:, 44:-44], shuffled, VolumeGrid((8, 8), 2.0))


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_dead_column_stays_one_column(bad):
    for columns in ([70], [40, 150, 151]):
        sinogram = scanned(FULL["flat"])
        sinogram[:, columns] = bad
        with pytest.warns(UserWarning, match="taken for dead"):
            image = fbp(sinogram, FULL["flat"], GRID)
        assert worst(image, GRID) < 0.02
        value, inside = truth_and_inside(GRID)
        rms = np.sqrt(np.mean((image.numpy() - value)[inside] ** 2)) / MU
        assert rms < 0.003


def test_noise_of_few_photons_in_air_is_no_object_beyond_the_row():
    """Logarithms of a dozen photons lie far above 0 in some views; of an object that stands at the
    edge in a tenth of the turn they do in all."""
    g = ParallelBeam(full_turn(74), 91, 1.4)
    weights = np.ones((74, 1))
    clear = np.zeros((74, 91))
    clear[:, 20:60] = 2.0
    cut = clear.copy()
    cut[30:40, -4:] = 1.0
    told = []
    for seed in range(240):
        rng = np.random.default_rng(seed)
        lines = [
            12.0 / (rng.poisson(12.0 * np.exp(-p)) + 0.5) for p in (clear, cut)[: 2 - seed % 2]
        ]
        told.append([cut_off(torch.from_numpy(np.log(p)), g, weights) for p in lines])
    assert sum(any(t[0]) for t in told) == 0
    assert sum(t[1] == (False, True) for t in told[::2]) > 100


@pytest.mark.parametrize(("photons", "noise"), [(7.0, 3.2), (4.0, 2.0)])
def test_noise_of_fewer_photons_than_the_electronics_add_is_none_either(photons, noise):
    """Their logarithms have outliers that the median of the steps between views does not show."""
    geometry = ParallelBeam(full_turn(236), 9, 1.4)
    clear = np.zeros((400, 236, 9))
    clear[..., 3:6] = 0.5
    cut = clear.copy()
    cut[:, 59:141, -3:] = 0.7
    rng, told = np.random.default_rng(0), []
    for p in (clear, cut):
        readings = rng.poisson(photons * np.exp(-p)) + noise * rng.standard_normal(p.shape)
        scan = Scan.from_counts(
            readings, geometry, air=photons, dark=np.zeros(9), electronic_noise=noise
        )
        told.append(
            [
                ends_cut_off(1.0, lines[:, 0], lines[:, -1], geometry, np.ones((236, 1)))
                for lines in scan.line_integrals()
            ]
        )
    assert sum(first + last for first, last in told[0]) <= 4
    assert sum(ends == (False, True) for ends in told[1]) >= 395
