"""Defective readings: found where they are, and only there; filled as their neighbours are."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter1d
from sound_scans import BALL, Solid, transmissions

from torchpcct import ConeBeam, FanBeam, ParallelBeam, Scan, full_turn
from torchpcct.checks.defects import dead_readings, find_defects, repair_defects
from torchpcct.scanner.linearisation import WaterLinearisation

VIEWS = 90
ROWS = 6
COLUMNS = 60
U = np.arange(COLUMNS) - 29.5
AIR = torch.full((ROWS, COLUMNS), 4000.0)


def expected():
    """Counts behind a 12 cm cylinder with an insert that walks over the columns, 20 … 4000."""
    lines = 0.02 * 120 * np.sqrt(np.clip(1 - (U / 26) ** 2, 0, 1))
    centre = 14 * np.sin(full_turn(VIEWS))[:, None]
    lines = lines + 1.5 * np.exp(-((U - centre) ** 2) / 4)
    return np.broadcast_to(4000 * np.exp(-lines)[:, None, :], (VIEWS, ROWS, COLUMNS))


def behind_lead(width, swing, left):
    """Counts of a bar of lead so many cells wide that walks over the columns."""
    opaque = np.array(expected())
    for v, angle in enumerate(full_turn(VIEWS)):
        c = int(left + swing * np.sin(angle))
        opaque[v, :, c : c + width] = 0.01
    return torch.from_numpy(np.random.default_rng(2).poisson(opaque).astype(np.float32))


@pytest.fixture
def counts():
    return torch.from_numpy(np.random.default_rng(0).poisson(expected()).astype(np.float32))


def test_good_data_are_left_alone(counts):
    found = find_defects(counts, AIR)
    assert not found.mask.any()
    assert found.text == ""


@pytest.mark.parametrize("level", [0.02, 0.3, 1.0])
def test_starved_data_are_left_alone(level):
    """Zeros of noise, anywhere and behind metal, are no defects."""
    low = np.random.default_rng(1).poisson(expected() * level / 60).astype(np.float32)
    assert not find_defects(torch.from_numpy(low), AIR * level / 60).mask.any()
    assert not find_defects(behind_lead(3, 14, 30), AIR).mask.any()


def test_every_kind_of_defect_is_found_and_nothing_else(counts):
    bad = torch.zeros(counts.shape, dtype=torch.bool)
    bad[:, 2, 10] = bad[:, :, 33] = bad[:, :, 34] = bad[40] = bad[17, 4, 50] = True
    broken = counts.clone()
    broken[bad] = 0
    broken[:, 1, 45] *= 1.6
    bad[:, 1, 45] = True
    found = find_defects(broken, AIR)
    assert torch.equal(found.mask, bad)
    assert (found.dead_cells, found.hot_cells, found.dead_views, found.lost_readings) == (
        13,
        1,
        1,
        1,
    )
    assert (
        "13 dead detector cells, 1 cell of a wrong gain, 1 view without signal, 1 single lost "
        "reading:" in found.text
    )


@pytest.mark.parametrize(("share", "least"), [(0.001, 0.99), (0.1, 0.99), (0.4, 0.99)])
def test_readings_lost_at_random_are_found(counts, share, least):
    lost = torch.rand(counts.shape, generator=torch.Generator().manual_seed(3)) < share
    lost[:, :, [0, -1]] = False  # a reading at the edge has no neighbour on one side
    found = find_defects(torch.where(lost, 0.0, counts), AIR).mask
    assert not (found & ~lost).any()
    bright = torch.from_numpy(expected() > 150)
    assert float((found & lost & bright).sum() / (lost & bright).sum()) > least
    # Zeros at the edges of a wide bar of lead are bright on one side only.
    found = find_defects(torch.where(lost, 0.0, behind_lead(8, 10, 26)), AIR).mask
    # single readings: no cell that is left out in all views
    assert not (found & ~lost & ~found.all(0)).any()


def test_a_dead_row_is_found(counts):
    """The neighbours of its cells are in the other rows."""
    bad = torch.zeros(counts.shape, dtype=torch.bool)
    bad[:, 3] = True
    assert torch.equal(find_defects(torch.where(bad, 0.0, counts), AIR).mask, bad)


def test_cells_are_followed_through_a_window(counts):
    first = (np.arange(VIEWS) % 7).astype(np.int64)
    part = torch.stack([counts[v, :, f : f + 40] for v, f in enumerate(first)])
    bad = torch.zeros(part.shape, dtype=torch.bool)
    for v, f in enumerate(first):
        bad[v, 3, 25 - f] = True
    found = find_defects(torch.where(bad, 0.0, part), AIR, first)
    assert torch.equal(found.mask, bad)
    assert (found.dead_cells, found.lost_readings) == (1, 0)


def test_a_scan_is_mended_and_says_so(counts):
    g = ConeBeam(full_turn(VIEWS), 626.0, 1098.0, COLUMNS, ROWS, 1.0)
    water = WaterLinearisation(np.ones((COLUMNS, 1)), np.ones(COLUMNS), 0.02)
    scan = Scan(counts, AIR, g, water, exposure_s=1.0, seed=0)
    same, texts = repair_defects(scan)
    assert same is scan
    assert texts == []
    broken = counts.clone()
    broken[:, :, 33] = 0
    fixed, texts = repair_defects(replace(scan, counts=broken))
    assert "6 dead detector cells" in texts[0]
    truth = torch.from_numpy(np.log(4000 / expected()))
    error = (fixed.line_integrals() - truth)[:, :, 33]
    # Before: ln(4000 / ½) ≈ 9 for 2.4; now noise of two readings and the curvature between them.
    assert float(error.square().mean().sqrt()) < 0.12
    clean = replace(scan, counts=broken, exposure_s=None, seed=None)
    assert repair_defects(clean)[0] is clean


def foreign(kind, slices):
    """Readings of every kind of scan over a dark frame of 20, sound and with cells that are dead
    for a while."""
    geometry = {
        "parallel": ParallelBeam(full_turn(VIEWS) / 2, COLUMNS, 1.0),
        "fan": FanBeam(full_turn(VIEWS), 300.0, 500.0, COLUMNS, 1.0),
        "cone": ConeBeam(full_turn(VIEWS), 300.0, 500.0, COLUMNS, ROWS, 1.0),
    }[kind]
    n = torch.from_numpy(np.random.default_rng(5).poisson(expected()) + 20.0)
    bad = torch.zeros(n.shape, dtype=torch.bool)
    bad[20:50, 4, 15] = bad[60:72, 4, 40:43] = bad[7, 4, 30] = bad[80:82, 4, 25:27] = bad[
        30:34, 1, 50
    ] = True
    if not geometry.has_rows:
        n, bad = (v.movedim(1, 0) if slices else v[:, 4] for v in (n, bad))
    options = {"air": 4020.0, "dark": 20.0, "electronic_noise": 2.0}
    return [Scan.from_counts(v, geometry, **options) for v in (n, n.masked_fill(bad, 0.0))], bad


@pytest.mark.parametrize(
    ("kind", "slices"), [("parallel", False), ("parallel", True), ("fan", False), ("cone", False)]
)
def test_cells_that_are_dead_for_part_of_the_turn_are_bridged_and_weigh_nothing(kind, slices):
    (sound, broken), bad = foreign(kind, slices)
    assert repair_defects(sound)[0] is sound
    fixed, texts = repair_defects(broken)
    assert torch.equal(fixed.dead, bad)
    assert "dead for part of the views" in texts[0]
    assert dead_readings(fixed) == int(bad.sum())
    assert not fixed.weights()[bad].any()
    # The logarithm of 0 was 6 off.
    assert float((fixed.line_integrals() - sound.line_integrals())[bad].abs().max()) < 0.8
    again, repeated = repair_defects(fixed)
    assert again is fixed
    assert repeated == texts


@pytest.mark.parametrize("blur", [0.3, 0.6])
def test_shadows_of_opaque_pins_and_plates_are_no_defects(blur):
    """One to eight cells wide, near the axis and far from it; a plate is opaque in a few views
    only."""
    views, columns, sub = 180, 160, 8
    beta, u = (
        full_turn(views)[:, None],
        ((np.arange(columns * sub) + 0.5) / sub - columns / 2)[None],
    )
    lines = 0.03 * np.sqrt(np.clip(70.0**2 - u**2, 0, None)) + 0 * beta
    for distance, at, long, thick in (
        (0.3, 0.0, 2.2, 2.2),
        (4.0, 1.0, 1.2, 1.2),
        (25.0, 2.0, 0.8, 0.8),
        (40.0, 3.0, 4.0, 4.0),
        (60.0, 4.0, 1.5, 1.5),
        (30.0, 5.0, 12.0, 0.7),
        (5.0, 0.5, 9.0, 1.0),
    ):
        half = np.hypot(long * np.cos(beta - at), thick * np.sin(beta - at))
        across = np.clip(1 - ((u - distance * np.sin(at - beta)) / half) ** 2, 0, None)
        lines = lines + 30.0 * 2 * long * thick / half * np.sqrt(across)
    shone = (
        gaussian_filter1d(np.exp(-lines), blur * sub, axis=1).reshape(views, columns, sub).mean(-1)
    )
    n = np.random.default_rng(0).poisson(2e4 * shone).astype(np.float32)
    assert (n == 0).mean() > 0.05
    assert not find_defects(torch.from_numpy(n[:, None]), torch.full((1, columns), 2e4)).mask.any()


def test_cells_of_a_wrong_gain_side_by_side_are_found(counts):
    broken, bad = counts.clone(), torch.zeros(counts.shape, dtype=torch.bool)
    broken[:, 1, 20:22] *= 1.6
    broken[:, 3, 50] *= 0.7
    bad[:, 1, 20:22] = bad[:, 3, 50] = True
    found = find_defects(broken, AIR)
    assert torch.equal(found.mask, bad)
    assert found.hot_cells == 3


@pytest.mark.parametrize("radii", [(13.0, 62.0, 62.0), (9.0, 20.0, 20.0), (4.0, 48.0, 48.0)])
@pytest.mark.parametrize("cell", [3.0, 8.0])
def test_outlines_of_round_bodies_are_no_gains(radii, cell):
    """An ellipsoid about the axis in coarse cells: its outline stays on its cells, in every row
    on others."""
    columns = round(180.0 / cell)
    g = ConeBeam(full_turn(40), 500.0, 800.0, columns, 9, (4.0, cell))
    body = Solid(BALL, (0.0, 0.0, 0.0), radii[::-1], 5.0 / (2.0 * radii[1]))
    shone = transmissions(g, [body], subs=(4, 4, 1))
    for seed in range(2):
        n = np.random.default_rng(seed).poisson(4e4 * shone).astype(np.float32)
        assert find_defects(torch.from_numpy(n), torch.full(g.shape[1:], 4e4)).text == ""


@pytest.mark.parametrize(
    ("columns", "rows", "pitch", "up", "aside", "radius", "height", "most"),
    [
        (97, 15, 7.342, 3.671, -1.069, 35.21, 18.1, 4.49),  # alike on both sides of the axis
        (45, 15, 3.968, 1.984, 0.25, 23.87, 29.06, 4.7),
        # a quarter column aside: above and below the plane
        (48, 12, 2.231, 1.1155, 0.25, 27.66, 26.1, 2.84),
        (68, 6, 3.603, 0.0, 0.25, 45.94, 33.0, 5.3),
    ],
)
def test_outlines_on_both_sides_are_no_gains(columns, rows, pitch, up, aside, radius, height, most):
    """2 to 4 cells of a wrong gain were found in each: one cell of the outline stands out of a
    row that is smooth."""
    cell = 180.0 / columns
    g = ConeBeam(full_turn(24), 500.0, 800.0, columns, rows, (pitch, cell), (up, aside * cell))
    shone = transmissions(
        g, [Solid(BALL, (0.0, 0.0, 0.0), (radius, radius, height), most / (2.0 * radius))]
    )
    for seed in range(2):
        n = np.random.default_rng(seed).poisson(4e4 * shone).astype(np.float32)
        assert find_defects(torch.from_numpy(n), torch.full(g.shape[1:], 4e4)).text == ""


def test_a_detail_as_narrow_as_a_cell_is_no_lost_reading():
    """A thin dense post along the rows' axis, dim in every row: a reading of it that is 0 is
    noise."""
    columns = (30 + 12 * np.sin(full_turn(VIEWS))).astype(int)
    n = np.array(expected())
    for view, column in enumerate(columns):
        n[view, :, column] = 4.0
    n = np.random.default_rng(0).poisson(n).astype(np.float32)
    assert float((n == 0).sum()) > 3
    assert find_defects(torch.from_numpy(n), AIR).text == ""


def test_a_dim_row_between_bright_ones_has_no_lost_readings():
    """A disc seen edge on darkens one row to a few photons: zeros there are noise, and what was
    lost in the bright rows is not."""
    mean = np.full((VIEWS, 5, COLUMNS), 600.0)
    mean[:, 2, 5:-5] = 4.0
    n = torch.from_numpy(np.random.default_rng(3).poisson(mean).astype(np.float32))
    assert float((n == 0).sum()) > 50
    assert find_defects(n, torch.full((5, COLUMNS), 600.0)).text == ""
    bad = torch.rand(n.shape, generator=torch.Generator().manual_seed(1)) < 0.002
    bad &= torch.from_numpy(mean > 100.0)
    bad[:, :, [0, -1]] = False
    found = find_defects(n.masked_fill(bad, 0.0), torch.full((5, COLUMNS), 600.0)).mask
    assert not (found & ~bad).any()
    assert int((found & bad).sum()) > 0.9 * int(bad.sum())


def test_zeros_of_details_narrower_than_a_cell_are_not_lost():
    """A dense grain jumps by several columns from view to view, so that neither the next views nor
    rows tell: its shadow of a few photons also leaves some."""
    rng = np.random.default_rng(4)
    mean = np.full((400, 1, COLUMNS), 90.0)
    grain = rng.integers(10, 50, 400)
    mean[np.arange(400), 0, grain] = rng.uniform(1.0, 6.0, 400)
    air = torch.full((1, COLUMNS), 90.0)
    n = torch.from_numpy(rng.poisson(mean).astype(np.float32))
    assert float((n == 0).sum()) > 20
    assert find_defects(n, air).text == ""
    lost = torch.from_numpy(rng.poisson(np.full(mean.shape, 90.0)).astype(np.float32))
    lost[np.arange(400), 0, grain] = 0.0
    assert find_defects(lost, air).lost_readings == 400
