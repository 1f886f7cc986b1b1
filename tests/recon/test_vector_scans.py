"""Scans whose geometry is given view by view: readings, files, methods and command line, against
a ball's chords."""

import json
import math

import numpy as np
import pytest
import torch
import yaml
from analytic import Ellipsoid, Gaussian, rasterize, vector_lines
from refusals import refused

from recon import reconstruct
from recon.least_squares.field_problem import larger_grid
from recon.least_squares.qggmrf import QGGMRF
from torchpcct import ConeBeam, Projector, Scan, VectorGeometry, Volume, VolumeGrid, full_turn
from torchpcct.formats.geometry_yaml import geometry_of, geometry_values
from torchpcct.formats.scans import open_scan
from torchpcct.metrics.half_split import halves
from torchpcct.vector_geometry import helical_motion

MU = 0.02
BALL = [Ellipsoid((1.0, -2.0, 0.5), 8.0, value=MU)]
CONE = ConeBeam(full_turn(60), 150.0, 250.0, 44, 36, (1.3, 1.2))
ROLL = math.radians(3.0)
TILT = math.radians(4.0)
WOBBLING = VectorGeometry.of(CONE).turned(ROLL, TILT).shifted(np.tile([0.5, -0.5], 30), 0.25)
HELIX = VectorGeometry.of(CONE, helical_motion(CONE, 30.0, -15.0))


def scan_of(geometry, bodies=BALL, sub=1):
    return Scan.from_line_integrals(
        vector_lines(geometry, bodies, sub), geometry, photons=1e6, mu_water=MU
    )


def test_one_ray_by_hand():
    """The middle ray of 3 × 3 cells through a ball of radius 8 mm at 5 mm from it: 2 √39 mm of
    water."""
    vectors = [
        [100.0, 5, 0, -50, 5, 0, 0, 1, 0, 0, 0, 1],
        [5.0, 100, 0, 5, -50, 0, 1, 0, 0, 0, 0, 1],
    ]
    geometry = VectorGeometry(vectors, 3, 3)
    chord = 2.0 * math.sqrt(39.0) * MU
    assert chord == pytest.approx(0.249800, abs=1e-6)
    counts = 1e5 * np.exp(-vector_lines(geometry, [Ellipsoid((0.0, 0.0, 0.0), 8.0, value=MU)], 1))
    scan = Scan.from_counts(counts, geometry, air=1e5, mu_water=MU)
    assert scan.line_integrals()[:, 1, 1].tolist() == pytest.approx([chord, chord], abs=1e-5)
    assert scan.weights().shape == (2, 3, 3)
    assert geometry.cell == pytest.approx(100.125**2 / 15000.0, rel=1e-4)
    distance, height, climb = geometry.border_rays()
    # From (100, 5) to the outer edge at (-50, 6.5): (100 · 6.5 + 50 · 5) / 150.0075 mm beside the
    # axis.
    assert distance.max() == pytest.approx(900.0 / math.hypot(150.0, 1.5), rel=1e-9)
    assert np.abs(climb).max() == pytest.approx(0.01, rel=1e-3)
    assert np.abs(height).max() == pytest.approx(1.0, abs=0.01)
    with pytest.raises(
        ValueError, match=r"readings have the shape \(2, 3, 4\), the geometry needs"
    ):
        Scan.from_counts(np.ones((2, 3, 4)), geometry, air=1.0)


def helix():
    """Rows that see 8 of the grid's 24 mm at a time, over three turns of 8 mm."""
    cone = ConeBeam(
        np.linspace(0, 6 * math.pi, 72, endpoint=False), 150.0, 250.0, 28, 6, (2.2, 2.0)
    )
    return VectorGeometry.of(cone, helical_motion(cone, 8.0, -12.0))


def wobbling():
    """A detector that rolls by 10° and tilts by 5°, and jitters by a cell."""
    rng = np.random.default_rng(0)
    cone = ConeBeam(full_turn(36), 150.0, 250.0, 28, 24, (2.2, 2.0))
    g = VectorGeometry.of(cone).turned(np.radians(rng.uniform(-10, 10, 36)), np.radians(5.0))
    return g.shifted(rng.uniform(-1, 1, 36), rng.uniform(-1, 1, 36))


@pytest.mark.extended
@pytest.mark.parametrize("make", [helix, wobbling])
def test_pwls_of_what_fbp_refuses_or_bends(make):
    geometry, grid = make(), VolumeGrid((12, 12, 12), 2.0)
    body = [Gaussian((1.0, 2.0, -1.0), (5.0, 3.5, 4.0), value=MU)]
    scan = scan_of(geometry, body, 2)
    found = reconstruct(
        scan, grid, "pwls", prior=QGGMRF(strength=0.02, threshold=3000.0), tolerance=2.0
    )
    assert found.report["converged"]
    error = (found.data.numpy() - 1000.0 * (rasterize(grid, body, 3) / MU - 1.0))[1:-1, 1:-1, 1:-1]
    assert np.sqrt((error**2).mean()) < 20.0  # of the body itself: 170 HU
    # Taken for the ideal circle, the same data are not explained.
    x, lines = MU * (1 + found.data / 1000.0), scan.line_integrals()
    circle = ConeBeam(geometry.angles, 150.0, 250.0, 28, geometry.rows, (2.2, 2.0))
    off = [float((Projector(g, grid)(x) - lines).norm()) for g in (circle, geometry)]
    assert off[0] > 3 * off[1]


def test_what_a_method_cannot_do_it_refuses_with_the_remedy():
    scan, grid = scan_of(HELIX), VolumeGrid((4, 8, 8), 2.0)
    refused(
        (r'climbs by 29\.50 mm.*Use the method "pwls"', lambda: reconstruct(scan, grid, "fbp")),
        ('got VectorGeometry: use "pwls"', lambda: reconstruct(scan, grid, "mbir")),
    )


def test_the_grid_grows_to_what_the_rays_cross():
    """Of a circle given view by view as of the circle; of a helix by its travel."""
    small = VolumeGrid((4, 8, 8), 2.0)
    circle, vectors = larger_grid(small, CONE), larger_grid(small, VectorGeometry.of(CONE))
    # 22 cells of 1.2 mm at 250 mm: 150 · 26.4 / √(250² + 26.4²) mm; the grid of the circle counts
    # cell centres.
    assert VectorGeometry.of(CONE).border_rays()[0].max() == pytest.approx(15.7524, abs=1e-4)
    assert [abs(a - b) <= 2 for a, b in zip(circle.shape, vectors.shape, strict=True)] == [True] * 3
    helix = larger_grid(small, HELIX)
    assert helix.extent[0] == pytest.approx(vectors.extent[0] + 29.5, abs=2.5)
    assert helix.center[0] == pytest.approx(-0.25, abs=1.1)  # from -15 to 14.5 mm


def test_halves_of_a_helix_take_every_second_view_of_each_turn():
    cone = ConeBeam(np.arange(8) * math.pi / 2 + 0.1, 150.0, 250.0, 4, 3, 1.0)
    geometry = VectorGeometry.of(cone, helical_motion(cone, 8.0))
    scan = Scan.from_counts(np.full(geometry.shape, 50.0), geometry, air=100.0)
    one, two = halves(scan)
    assert one.geometry.poses[:, 0, 2].tolist() == pytest.approx([0.0, 4.0, 8.0, 12.0])
    assert two.geometry.poses[:, 0, 2].tolist() == pytest.approx([2.0, 6.0, 10.0, 14.0])


def test_geometries_in_yaml(tmp_path):
    circle = {
        "kind": "cone",
        "angles_deg": {"step": 6, "count": 60},
        "sod": 150,
        "sdd": 250,
        "columns": 44,
        "rows": 36,
        "pitch": [1.3, 1.2],
    }
    np.savetxt(tmp_path / "jitter.txt", np.tile([0.5, -0.5], 30))
    pose = {"roll_deg": 3.0, "tilt_deg": 4.0, "columns": "jitter.txt", "rows": 0.25}
    found = geometry_of({**circle, "pose": pose}, tmp_path)
    np.testing.assert_allclose(found.vectors, WOBBLING.vectors, atol=1e-9)
    helix = geometry_of({**circle, "pose": {"feed": 30, "start": -15}})
    np.testing.assert_allclose(helix.vectors, HELIX.vectors, atol=1e-9)
    assert helix.poses[59, 0, 2] == pytest.approx(14.5)
    np.save(tmp_path / "poses.npy", WOBBLING.vectors)
    given = {"kind": "vectors", "vectors": "poses.npy", "columns": 44}
    assert geometry_of({**given, "rows": 36}, tmp_path) == WOBBLING
    refused(
        ("12 numbers per view need rows", lambda: geometry_of(given, tmp_path)),
        ("geometry needs columns", lambda: geometry_of({"kind": "vectors", "vectors": []})),
        (
            r"geometry\.pose must be a mapping of roll_deg",
            lambda: geometry_of({**circle, "pose": {"roll": 3.0}}),
        ),
        (
            "first height of a helix: give feed",
            lambda: geometry_of({**circle, "pose": {"start": 3.0}}),
        ),
    )


def test_the_command_line_takes_vectors(here, cli):
    """In place of a scan file's own circle, and for a stack that holds no geometry."""
    lines = vector_lines(WOBBLING, BALL, 1)
    Scan.from_line_integrals(lines, CONE, photons=1e6, mu_water=MU).save("scan.h5")
    (here / "vectors.yaml").write_text(yaml.safe_dump(geometry_values(WOBBLING)), encoding="utf-8")
    command = "reconstruct scan.h5 --geometry vectors.yaml --out v.h5"
    cli(f"{command} --voxel 2 --extent 4 20 20")
    volume = Volume.load("v.h5")
    assert float(volume.data[:, 3:5, 5].mean()) == pytest.approx(0.0, abs=40.0)  # x = 1, y = -2
    assert volume.report["warnings"] == []
    assert yaml.safe_load((here / "v.h5.yaml").read_text())["geometry"]["kind"] == "vectors"
    plan = json.loads(cli(f"{command} --dry-run --json"))["grid"]
    assert plan["spacing"][0] == pytest.approx(0.72, rel=0.01)  # 1.2 mm · 150 / 250
    np.save("lines.npy", lines)
    (here / "stack.yaml").write_text("readings: lines.npy\nkind: line_integrals\nmu_water: 0.02\n")
    assert open_scan(here / "stack.yaml", WOBBLING).geometry == WOBBLING
    with pytest.raises(
        ValueError, match=r"holds its geometry: leave out geometry, or give a VectorGeometry"
    ):
        open_scan(here / "scan.h5", CONE)
    slices = Scan.from_line_integrals(
        np.moveaxis(lines, 1, 0), CONE.central_fan, photons=1e6, mu_water=MU
    )
    slices.save("slices.h5")
    assert torch.equal(open_scan("slices.h5", WOBBLING).counts, slices.counts.movedim(0, 1))
