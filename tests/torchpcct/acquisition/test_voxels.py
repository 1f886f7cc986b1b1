"""Scans of voxel volumes against exact chords, and the calibration from CT numbers to tissues."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from refusals import refused

import recon
from torchpcct import VolumeGrid, VoxelScene, acquire
from torchpcct.scanner import presets
from torchpcct.scene import Body, EllipticCylinder, Scene
from torchpcct.scene.materials import MATERIALS, material
from torchpcct.scene.voxels import BODY_TISSUES, DENSE

GRID = VolumeGrid((3, 100, 100), (2.0, 1.0, 1.0))


def scanner(views=12, mode="counting"):
    s = presets.pcct(views=views, mode=mode)
    return s.replace(geometry=replace(s.geometry, rows=2, columns=300, pitch=(0.5, 0.7)))


def test_a_mixture_reads_the_given_number_in_its_spectrum_and_its_tissue_in_any():
    energies, weights = np.array([50.0, 70.0, 90.0]), np.array([1.0, 2.0, 1.0])
    hu = np.linspace(-1000, 2500, 27).reshape(3, 3, 3)
    scene = VoxelScene(hu, VolumeGrid((3, 3, 3), 1.0), energies_kev=energies, weights=weights)
    mu = (
        scene.mixed(scene.contrast(energies))
        + MATERIALS["air"].attenuation(energies)[:, None, None, None]
    )
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
            Body(
                "bone",
                EllipticCylinder(semi_axes=6.0, position=(12.0, -9.0, 0.0)),
                "cortical_bone",
                "muscle",
            ),
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
    # Away from edges, which voxels of 1 mm show as they are: means over 9 columns, and the whole of
    # each view.
    rows, smooth = (-1, 1, p.shape[-1]), lambda t: torch.nn.functional.avg_pool1d(t, 9, 1)
    assert float(
        (smooth(p.reshape(rows)) - smooth(q.reshape(rows))).square().mean().sqrt()
    ) < 0.01 * float(p.max())
    torch.testing.assert_close(q.sum(-1), p.sum(-1), rtol=1e-2, atol=0)


def test_water_voxels_read_their_thickness():
    """The scanner's water correction turns the readings into mu_ref × thickness, whatever the
    spectrum: to 0.3 %."""
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


def test_numbers_come_back_from_a_polychromatic_scan():
    """Fat, lung, muscle, and above it iodine, bone and dense water in rods of 10 mm, told apart
    by labels: 5 HU."""
    rods = [
        (-100, "bone"),
        (-700, "bone"),
        (100, "iodine"),
        (200, "iodine"),
        (300, "iodine"),
        (200, "bone"),
        (350, "bone"),
        (400, "water"),
    ]
    grid = VolumeGrid((1, 124, 124), (6.0, 1.0, 1.0))
    y, x = grid.axes[1][:, None], grid.axes[2][None, :]
    hu = np.where(np.hypot(x, y) < 60.0, 40.0, -1000.0) * np.ones(grid.shape)
    dense = np.zeros(grid.shape, dtype=np.uint8)
    places = [(35 * np.cos(k * np.pi / 4), 35 * np.sin(k * np.pi / 4)) for k in range(len(rods))]
    for (number, name), (px, py) in zip(rods, places, strict=True):
        inside = np.hypot(x - px, y - py) < 5.0
        hu[:, inside], dense[:, inside] = number, DENSE.index(name)
    s = presets.pcct(views=300, energy_bin_kev=4.0)
    s = s.replace(geometry=replace(s.geometry, rows=1, columns=340, pitch=(0.7, 0.7)))
    scene = VoxelScene(hu, grid, dense=dense)
    scan = acquire(scene, s)
    volume = recon.reconstruct(scan, VolumeGrid((1, 180, 180), 0.5), "fbp", kernel="standard")
    y, x = volume.grid.axes[1][:, None], volume.grid.axes[2][None, :]
    for (number, name), (px, py) in zip(rods, places, strict=True):
        found = float(volume.data[0][torch.from_numpy(np.hypot(x - px, y - py) < 2.6)].mean())
        assert found == pytest.approx(number, abs=5.0), name
    shares = scan.info["plan"]["above_muscle"]
    assert shares["iodine"] == pytest.approx((dense == 1).mean(), rel=1e-6)
    assert scene.water_diameter == pytest.approx(122, abs=1)  # 120 mm of muscle
    # A volume with a spectrum of its own keeps it: 300 HU of iodine at 70 keV are brighter at 100
    # kVp.
    told = VoxelScene(hu, grid, energies_kev=70.0, dense="iodine")
    assert told.read_by([50.0, 60.0], [1.0, 1.0]) is told


@pytest.mark.parametrize("dense", DENSE)
def test_what_is_above_muscle_is_the_users_choice(dense):
    """300 HU at 70 keV, read at 50 keV: a mixture by volume of two materials, computed by hand."""
    low, high = {
        "bone": (MATERIALS["spongiosa"], MATERIALS["cortical_bone"]),
        "iodine": (MATERIALS["skeletal_muscle"], material("iodine 200 mg/ml in blood")),
        "water": (MATERIALS["skeletal_muscle"], MATERIALS["water"].with_density(5.0)),
    }[dense]
    share = (300 - low.hu(70.0)) / (high.hu(70.0) - low.hu(70.0))
    expected = low.hu(50.0) + share * (high.hu(50.0) - low.hu(50.0))
    assert expected == pytest.approx({"bone": 496, "iodine": 585, "water": 304}[dense], abs=1)
    for given in (dense, np.full((1, 1, 1), DENSE.index(dense))):
        s = VoxelScene(
            np.full((1, 1, 1), 300.0), VolumeGrid((1, 1, 1), 1.0), energies_kev=70.0, dense=given
        )
        water, air = (MATERIALS[m].attenuation([50.0]) for m in ("water", "air"))
        read = 1000 * (float(s.mixed(s.contrast([50.0]))[0, 0, 0, 0] + air[0]) / water[0] - 1)
        assert read == pytest.approx(expected, abs=0.01)


def test_bad_voxel_scenes_are_refused():
    water = np.zeros(GRID.shape)
    refused(
        ("'gold': use one of bone, iodine, water", lambda: VoxelScene(water, GRID, dense="gold")),
        (
            r"dense needs the shape \(z, y, x\)",
            lambda: VoxelScene(water, GRID, dense=np.zeros((2, 2, 2))),
        ),
        (
            "dense must hold 0 bone, 1 iodine, 2 water",
            lambda: VoxelScene(water, GRID, dense=water + 3),
        ),
        (
            "one of bone, iodine, water, or a whole number",
            lambda: VoxelScene(water, GRID, dense=None),
        ),
        (
            "dense or tissues, not both",
            lambda: VoxelScene(water, GRID, dense="iodine", tissues=("air", "water")),
        ),
        (r"shape \(z, y, x\) of its grid", lambda: VoxelScene(np.zeros((2, 2, 2)), GRID)),
        (
            "300 voxels are NaN",
            lambda: VoxelScene(np.where(np.arange(100) < 1, np.nan, water), GRID),
        ),
        (
            "in the order of their CT numbers",
            lambda: VoxelScene(water, GRID, tissues=("cortical_bone", "air")),
        ),
        (
            "scanned whole, at rest",
            lambda: acquire(VoxelScene(water, GRID), scanner(), region=GRID),
        ),
    )
