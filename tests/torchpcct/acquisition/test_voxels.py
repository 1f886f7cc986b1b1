"""Scans of voxel volumes against exact chords, and the calibration from CT numbers to tissues."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from torchpcct import VolumeGrid, acquire
from torchpcct.scanner import presets
from torchpcct.scene import Body, EllipticCylinder, Scene
from torchpcct.scene.materials import MATERIALS
from torchpcct.scene.voxels import BODY_TISSUES, VoxelScene

GRID = VolumeGrid((3, 100, 100), (2.0, 1.0, 1.0))


def scanner(views=12, mode="counting"):
    s = presets.pcct(views=views, mode=mode)
    return s.replace(geometry=replace(s.geometry, rows=2, columns=300, pitch=(0.5, 0.7)))


def test_a_mixture_reads_the_given_number_in_its_spectrum_and_its_tissue_in_any():
    energies, weights = np.array([50.0, 70.0, 90.0]), np.array([1.0, 2.0, 1.0])
    hu = np.linspace(-1000, 2500, 27).reshape(3, 3, 3)
    scene = VoxelScene(hu, VolumeGrid((3, 3, 3), 1.0), energies_kev=energies, weights=weights)
    mu = scene.mixed(scene.contrast(energies)) + MATERIALS["air"].attenuation(energies)[:, None, None, None]
    water = MATERIALS["water"].attenuation(energies)
    read = 1000 * (np.tensordot(weights, mu, 1) / (weights @ water) - 1)
    reached = np.maximum(hu, scene.numbers[0])  # air reads −999
    np.testing.assert_allclose(read, reached, atol=0.5)
    one = np.full((1, 1, 1), scene.numbers[3])
    pure = VoxelScene(one, VolumeGrid((1, 1, 1), 1.0), energies_kev=energies, weights=weights)
    assert BODY_TISSUES[3] == "skeletal_muscle"
    at_30 = pure.mixed(pure.contrast([30.0]))[0, 0, 0, 0] + MATERIALS["air"].attenuation([30.0])[0]
    assert at_30 == pytest.approx(MATERIALS["skeletal_muscle"].attenuation([30.0])[0], rel=1e-6)


@pytest.mark.parametrize("mode", ["counting", "spectral"])
def test_voxels_of_a_cylinder_scan_as_the_cylinder(mode):
    """Muscle with a bone rod, voxels of 1 mm against exact chords."""
    s = scanner(mode=mode)
    exact = Scene(
        [
            Body("muscle", EllipticCylinder(semi_axes=40.0), "skeletal_muscle"),
            Body("bone", EllipticCylinder(semi_axes=6.0, position=(12.0, -9.0, 0.0)), "cortical_bone", "muscle"),
        ]
    )
    energy = 70.0
    numbers = {name: MATERIALS[exact[name].material].hu(energy) for name in exact.names}
    voxels = exact.render(GRID, numbers, outside=MATERIALS["air"].hu(energy))
    a = acquire(exact, s, sub_rays=16)
    b = acquire(VoxelScene(voxels, GRID, energies_kev=energy), s)
    assert a.counts.shape == b.counts.shape
    torch.testing.assert_close(a.air, b.air)
    p, q = -torch.log(a.counts / a.air.unsqueeze(-3)), -torch.log(b.counts / b.air.unsqueeze(-3))
    # Away from edges, which voxels of 1 mm show as they are: means over 9 columns, and the whole of each view.
    rows, smooth = (-1, 1, p.shape[-1]), lambda t: torch.nn.functional.avg_pool1d(t, 9, 1)
    assert float((smooth(p.reshape(rows)) - smooth(q.reshape(rows))).square().mean().sqrt()) < 0.01 * float(p.max())
    torch.testing.assert_close(q.sum(-1), p.sum(-1), rtol=1e-2, atol=0)


def test_water_voxels_read_their_thickness():
    """The scanner's water correction turns the readings into mu_ref × thickness, whatever the spectrum: to 0.3 %."""
    hu = np.where(np.abs(GRID.axes[2]) < 30, 0.0, -1000.0) * np.ones(GRID.shape)  # a slab of 60 mm
    scene = VoxelScene(hu, GRID, tissues=("air", "water", "cortical_bone"))
    scan = acquire(scene, scanner(views=4))
    middle = scan.line_integrals()[0, :, 145:155]
    fan = np.cos(scan.geometry.fan_angles[145:155])
    thickness = middle.numpy() / scan.linearisation.mu_ref
    np.testing.assert_allclose(thickness, np.tile(60.0 / fan, (2, 1)), rtol=3e-3)
    assert scan.info["plan"]["basis_maps"] <= 3
    noisy = acquire(scene, scanner(views=4), exposure_s=1.0, seed=2)
    assert torch.equal(noisy.counts, scan.with_noise(1.0, 2).counts)


def test_bad_voxel_scenes_are_refused():
    with pytest.raises(ValueError, match=r"shape \(z, y, x\) of its grid"):
        VoxelScene(np.zeros((2, 2, 2)), GRID)
    with pytest.raises(ValueError, match="300 voxels are NaN"):
        VoxelScene(np.where(np.arange(100) < 1, np.nan, np.zeros(GRID.shape)), GRID)
    with pytest.raises(ValueError, match="in the order of their CT numbers"):
        VoxelScene(np.zeros(GRID.shape), GRID, tissues=("cortical_bone", "air"))
    with pytest.raises(ValueError, match="scanned whole, at rest"):
        acquire(VoxelScene(np.zeros(GRID.shape), GRID), scanner(), region=GRID)
