"""Measured scans: voxels coarser than the detector's cells credit no kernel, a single slice is a
volume, too."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from refusals import refused
from sound_scans import CYLINDER, Solid, transmissions

from recon import reconstruct
from recon.evaluate.methods import denoiser
from recon.evaluate.report import measured_text
from recon.evaluate.without_truth import evaluate_scans, evaluate_volumes
from torchpcct import ConeBeam, FanBeam, ParallelBeam, Scan, VolumeGrid, full_turn
from torchpcct.scan_grid import cells_at_axis
from torchpcct.vector_geometry import VectorGeometry

MU = 0.02
CELLS = 96
VIEWS = 120
PHOTONS = 2e5


@pytest.fixture(scope="module")
def scans():
    """Two of a disc with many inserts, in one plane; cells of 1 mm."""
    draw, geometry = (
        np.random.default_rng(3),
        ParallelBeam(np.arange(VIEWS) * np.pi / VIEWS, CELLS, 1.0),
    )
    solids = [Solid(CYLINDER, (0.0, 0.0, 0.0), (40.0, 40.0, 1e5), MU)]
    for _ in range(80):
        size, turn = draw.uniform(1.0, 5.0), draw.uniform(0.0, 2.0 * math.pi)
        away = draw.uniform(0.0, 40.0 - size)
        place, radii = (
            (away * math.cos(turn), away * math.sin(turn), 0.0),
            (size, size * draw.uniform(0.5, 1.0), 1e5),
        )
        solids.append(
            Solid(CYLINDER, place, radii, MU * draw.uniform(-0.5, 0.5), draw.uniform(0.0, 3.0))
        )
    shone = PHOTONS * transmissions(geometry, solids, subs=(3, 1, 1))
    return [
        Scan.from_counts(
            np.random.default_rng(k).poisson(shone).astype(np.float64),
            geometry,
            air=np.full(CELLS, PHOTONS),
            mu_water=MU,
        )
        for k in range(2)
    ]


@pytest.mark.parametrize("voxel", [1.0, 1.5, 2.0, 3.0])
def test_a_softer_kernel_saves_no_dose_on_coarse_voxels(scans, voxel):
    """Where it would seem to: against FBP that aliases noise."""
    grid = VolumeGrid((round(84 / voxel),) * 2, voxel)
    methods = ["fbp:soft", "fbp:standard", "gaussian@fbp:ram-lak"]
    rows = evaluate_scans(scans, grid, methods)
    for row in rows:
        assert row["low"] < 1.05, row
        assert row["high"] > 0.95, row
        assert row["dose_factor"] == pytest.approx(1.0, abs=0.25), row
        assert bool(row["note"]) == (voxel > 1.0)
    if voxel > 1.0:
        assert (
            f"voxels of {voxel:g} mm are coarser than the detector's cells, 1 mm at the axis"
            in rows[0]["note"]
        )
        assert f"on voxels of {voxel / math.ceil(voxel):g} mm and" in rows[0]["note"]
        assert f"Note: {rows[0]['note']}.\n" in measured_text(rows, "HU", "fbp:ram-lak")


def test_of_volumes_the_condition_is_stated(scans):
    """Of files of others nothing is known of the detector; where it is, the factors are sound,
    or said not to be."""
    grid = VolumeGrid((28, 28), 3.0)
    sharp, soft = (
        [reconstruct(s, grid, "fbp", kernel=kernel) for s in scans]
        for kernel in ("ram-lak", "soft")
    )
    cells = sharp[0].report["cells_mm"]
    assert cells == [1.0, 1.0]
    volumes = ({"theirs": [v.data for v in soft]}, [v.data for v in sharp], 3.0)
    for known, said in (
        (None, "no smaller than the voxels, 3 mm in the plane"),
        (cells, "not to be trusted: the voxels of 3 mm"),
    ):
        (row,) = evaluate_volumes(*volumes, cells_mm=known)
        assert row["dose_factor"] > 2.0
        assert said in row["note"]
        assert f"Note: {row['note']}.\n" in measured_text([row], "HU", "theirs")
    (row,) = evaluate_volumes(*volumes, cells_mm=[3.0, 3.0])
    assert row["note"] == ""


def test_views_are_exchanged_with_their_flux(scans):
    """The second scan's tube gave a third less: its views keep their own flux in the other scan."""
    first, second = scans
    dimmer = replace(
        second, counts=torch.round(second.counts * 0.67), flux=torch.full((VIEWS,), 0.67).double()
    )
    grid = VolumeGrid((42, 42), 2.0)
    (row,) = evaluate_scans([first, dimmer], grid, "fbp:ram-lak", n=2, seed=1)
    (plain,) = evaluate_scans(scans, grid, "fbp:ram-lak")
    assert row["noise"] == pytest.approx(plain["noise"], rel=0.1)
    with pytest.raises(ValueError, match="of the same exposure only"):
        evaluate_scans([first, replace(second, air=second.air / 2)], grid, "fbp:soft", n=2)


def test_cells_at_the_axis():
    angles = full_turn(8)
    assert cells_at_axis(ParallelBeam(angles, 16, 0.7)) == (math.inf, 0.7, 0.7)
    assert cells_at_axis(FanBeam(angles, 400.0, 800.0, 16, 0.7)) == (math.inf, 0.35, 0.35)
    cone = ConeBeam(angles, 400.0, 800.0, 16, 8, (1.4, 0.7))
    assert cells_at_axis(cone) == (0.7, 0.35, 0.35)
    assert cells_at_axis(VectorGeometry.of(cone)) == pytest.approx((0.7, 0.35, 0.35))


def test_scans_by_other_scanners_and_in_other_units_are_refused(scans):
    """Their artefacts and values would count as noise; another start of the turn, or an axis that
    was calibrated, does not matter."""
    first, second = scans
    g, grid = first.geometry, VolumeGrid((42, 42), 2.0)
    fan = FanBeam(g.angles, 400.0, 800.0, CELLS, 2.0)

    def pair(**changes):
        return lambda: evaluate_scans([first, replace(second, **changes)], grid, "fbp:soft")

    refused(
        (r"volumes in HU and mm\^-1: give both the same mu_water", pair(unit="mm^-1")),
        ("parallel rays on cells of 1 mm .* divergent rays on cells of 1 mm", pair(geometry=fan)),
        (r"cells of 1 mm .* cells of 1\.1 mm", pair(geometry=replace(g, pitch=1.1))),
    )
    for sound in (
        replace(g, offset=0.4),
        replace(g, pitch=1.001),
        VectorGeometry.of(g),
        replace(g, angles=g.angles + 1e-3),
    ):
        (row,) = pair(geometry=sound)()
        assert not row["why"]


def test_regions_without_noise_have_no_factor_and_say_so(scans):
    """Outside of what was measured, or within one brick: no warnings of numpy."""
    grid = VolumeGrid((96, 96), 1.0)
    for part, why in ((slice(0, 6), "does it lie outside"), (slice(45, 49), "too small")):
        mask = np.zeros(grid.shape, bool)
        mask[part, part] = True
        (row,) = evaluate_scans(scans, grid, "fbp:soft", mask)
        assert math.isnan(row["dose_factor"])
        assert why in row["why"]


def test_what_volumes_cannot_be_is_named():
    draw = np.random.default_rng(0)
    pairs = [[draw.normal(size=(1, 16, 16)) for _ in range(2)] for _ in range(2)]
    mine, reference = {"mine": pairs[0]}, pairs[1]
    mask = np.ones((16, 16))

    def of(volumes, given, *rest, **options):
        return lambda: evaluate_volumes(volumes, given, *rest, **options)

    refused(
        (r"voxel_mm\[0\] must be greater than 0 mm, got -1", of(mine, reference, -1.0)),
        (r"voxel_mm\[0\] must be finite", of(mine, reference, math.nan)),
        ("voxel_mm must be one length or", of(mine, reference, [1.0] * 4)),
        (r"cells_mm\[1\] must be greater", of(mine, reference, 1.0, cells_mm=[1.0, -1.0])),
        ("cells_mm must be at most three", of(mine, reference, 1.0, cells_mm=[1.0] * 4)),
        ("volumes must name .* got none", of({}, reference, 1.0)),
        ("mine: two volumes .* got 1", of({"mine": pairs[0][:1]}, reference, 1.0)),
        ("reference: two volumes .* got 3", of(mine, [*reference, *reference[:1]], 1.0)),
        ("mine: a volume must hold real numbers", of({"mine": ["x", "y"]}, reference, 1.0)),
        ("mine: a volume must hold", of({"mine": [1j * v for v in pairs[0]]}, reference, 1.0)),
        (r"region must be a mask of the volumes' shape", of(mine, reference, 1.0, mask[1:])),
        ("region must be a mask, True where", of(mine, reference, 1.0, 0.5 * mask)),
        ("region must be a mask, True where", of(mine, reference, 1.0, math.nan * mask)),
    )
    assert evaluate_volumes(mine, reference, (1.0, 1.0), mask)[0]["method"] == "mine"


def test_what_a_users_function_refuses_has_its_name(scans):
    def denoise(volume):
        return math.sqrt(volume)

    def reconstruction(scan, grid):
        raise ValueError("too noisy")

    grid = VolumeGrid((42, 42), 2.0)
    refused(
        ("denoise@fbp:soft: ", lambda: evaluate_scans(scans, grid, denoiser(denoise, "fbp:soft"))),
        ("reconstruction: too noisy", lambda: evaluate_scans(scans, grid, reconstruction)),
    )
