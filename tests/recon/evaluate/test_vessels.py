"""Painted vessels: shares of voxels against converged ones, and volumes that bending keeps."""

import importlib.util
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from recon.evaluate.task import Task
from recon.evaluate.tasks import TASKS, VesselTask, read_task, task_text
from recon.evaluate.vessels import SHAPES, PaintedVessel
from recon.jobs.store import Store
from torchpcct import VolumeGrid
from torchpcct.scene.plaque import Plaque
from torchpcct.scene.raster import label_fractions

HU = {"patient": -92.65, "wall": 63.53, "fibrous": 103.22, "lumen": 479.97, "core": 41.07}
PAINTED = [name for name in TASKS if "\nvessel:" in task_text(name)]
BENCH = Path(__file__).parents[2] / "bench"
POINTS = 1 << 14


def points_of_unit_cube(count):
    """Golden-ratio sequence of three dimensions (Roberts 2018): nothing in common with what is
    tested."""
    phi = 1.2207440846057596
    return np.mod(0.5 + np.arange(1, count + 1)[:, None] / phi ** np.arange(1, 4), 1.0) - 0.5


def off_by(vessel, grid, values, voxels):
    """RMS error in HU in so many of the voxels that a face crosses, drawn at random."""
    shares = np.stack(list(vessel.volume_fractions(grid).values()))
    np.testing.assert_allclose(shares.sum(0), 1.0, atol=1e-12)
    crossed = np.argwhere(shares.max(0) < 1.0)
    cube, hu, errors = (
        points_of_unit_cube(POINTS) * grid.spacing[0],
        np.array([*values.values()]),
        [],
    )
    for at in np.random.default_rng(3).choice(crossed, voxels, replace=False):
        centre = [grid.axes[a][at[a]] for a in (2, 1, 0)]
        true = np.bincount(vessel.labels(centre + cube), minlength=len(hu)) / POINTS
        errors.append(float(hu @ (shares[(slice(None), *at)] - true)))
    return math.sqrt(np.mean(np.square(errors)))


def cut_out(grid, slices, first=0.0):
    """Some slices, beginning ``first`` mm from the middle."""
    middle = grid.center[0] + first + slices * grid.spacing[0] / 2
    return VolumeGrid((slices, *grid.shape[1:]), grid.spacing, (middle, *grid.center[1:]))


@pytest.mark.parametrize("name", PAINTED)
def test_shares_of_every_painted_task_are_converged(name):
    task = read_task(name)
    assert off_by(task._vessel, cut_out(task.grid, 3, 0.3), HU, 12) < 0.5
    few = replace(task, grid=cut_out(task.grid, 1))
    assert list(few.volume_fractions) == list(few._groups)
    np.testing.assert_allclose(np.sum(list(few.volume_fractions.values()), axis=0), 1.0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("voxel_mm", [0.2, 0.1])
def test_shares_of_all_vessels_are_converged(name, voxel_mm):
    line, branch = SHAPES[name]
    grid = VolumeGrid((round(9 / voxel_mm),) * 3, voxel_mm, (0.013, -30.38, -29.63))
    assert off_by(PaintedVessel(line, (0.0, -30.38, -29.63), branch), grid, HU, 150) < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("direction", ["along z", "tilted", "in plane", "curved"])
def test_shares_of_the_held_out_vessels_are_converged(direction, monkeypatch):
    monkeypatch.setitem(sys.modules, "rival_scenes", None)
    spec = importlib.util.spec_from_file_location("held_out", BENCH / "rival_scenes.py")
    bench = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "held_out", bench)
    spec.loader.exec_module(bench)
    line, geometry, values = bench._HELD_OUT[direction]
    plaque = Plaque(position=(0.0, 0.0, 0.0), vessel_length=8.0, **geometry)
    grid = VolumeGrid((57, 45, 45), 0.2, (0.0, -30.38, -29.63))
    assert (
        off_by(
            PaintedVessel(line, grid.center, plaque=plaque),
            grid,
            dict(zip(HU, values, strict=True)),
            150,
        )
        < 0.5
    )


def test_painting_is_the_mean_of_the_values_and_bending_keeps_volumes():
    grid = VolumeGrid((10, 40, 40), 0.2)
    straight, tilted = (
        PaintedVessel(SHAPES[n][0], grid.center) for n in ("straight", "in_plane_x")
    )
    shares = straight.volume_fractions(grid)
    exact = straight.straight.volume_fractions(grid, 40)
    assert np.abs(np.stack(list(shares.values())) - exact).max() < 0.02
    assert np.sqrt(np.square(np.stack(list(shares.values())) - exact).mean()) < 3e-4
    painted = straight.painted(grid, {"lumen": 10.0, "wall": 2.0})
    np.testing.assert_allclose(painted, 10.0 * shares["lumen"] + 2.0 * shares["wall"])
    core = (
        tilted.volume_fractions(VolumeGrid((20, 20, 20), 0.2, (0.0, -1.0, 0.0)))["core"].sum()
        * 0.2**3
    )
    a, b, c = tilted.plaque.core.semi_axes
    assert core == pytest.approx(4 / 3 * math.pi * a * b * c, rel=1e-3)


def test_label_fractions_of_boxes_and_slivers_are_exact_and_bad_labels_are_named():
    grid = VolumeGrid((6, 6, 6), 1.0)

    def layers(points):
        # Outside, then a layer of 0.02 voxels, then the inside: the sliver lies between faces that
        # are found.
        return np.where(points[..., 0] < 0.331, -1, np.where(points[..., 0] < 0.351, 0, 1))

    shares = label_fractions(layers, 2, grid)
    np.testing.assert_allclose(shares[0].sum(2), 0.02, atol=2e-3)
    np.testing.assert_allclose(shares[1].sum(2), 3.0 - 0.351, atol=2e-3)
    box = label_fractions(lambda p: (np.abs(p - 0.1) < 1.15).all(-1) - 1, 1, grid)
    assert box.sum() == pytest.approx(2.3**3, rel=3e-3)
    with pytest.raises(ValueError, match="below count = 2, got 2"):
        label_fractions(lambda p: np.full(p.shape[:-1], 2), 2, grid)
    with pytest.raises(ValueError, match="3-D"):
        label_fractions(layers, 2, grid.slice)
    with pytest.raises(TypeError, match="VolumeGrid"):
        label_fractions(layers, 2, (6, 6, 6))
    with pytest.raises(ValueError, match="count"):
        label_fractions(layers, 0, grid)


def test_its_scan_is_that_of_the_vessel_and_what_it_is_made_of_is_prepared_apart(
    monkeypatch, tmp_path
):
    """:meth:`Task.scan` of any task is one of :meth:`Task.scans`; the vessel along z is not."""
    asked = []
    monkeypatch.setattr(VesselTask, "scans", lambda self, store: ("with", "without"))
    monkeypatch.setattr(Task, "scan", lambda self, store, signal: asked.append((store, signal)))
    task, store = read_task("tilted"), Store(tmp_path)
    assert [task.scan(store, s) for s in ("present", "absent")] == ["with", "without"]
    assert not asked
    task.prepare(store, "absent")
    assert [(s.folder, signal) for s, signal in asked] == [(tmp_path / "straight", "absent")]
