"""Vessels of any direction: their geometry, their statistic, and what is told of their reconstructions."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from inset_operators import problem

from recon.evaluate.vessels import LENGTH_MM, SHAPES, Centreline, Vessel, vessel
from recon.gram.gram import Gram
from recon.study.dose_factor.settings import VESSELS
from recon.study.dose_factor.vessel_rows import vessel_rows
from recon.study.dose_factor.vessels import FINE_MM, fine_grid, projected
from torchpcct import VolumeGrid
from torchpcct.metrics.placement import place_rois
from torchpcct.metrics.roi import axial_grid
from torchpcct.scene import Scene
from torchpcct.scene.plaque import Plaque, plaque_scene
from torchpcct.scene.scene import voxel_centres

CENTER = (0.0, -30.38, -29.63)
GRID = VolumeGrid((50, 44, 44), 0.2, CENTER)
X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


def test_settings_name_all_shapes_and_the_straight_one_first():
    assert tuple(SHAPES) == VESSELS
    assert vessel(VESSELS[0], CENTER).line == Centreline(Z, X)


def test_distances_to_a_line_and_an_arc_are_exact():
    rng = np.random.default_rng(0)
    points = rng.uniform(-3, 3, (200, 3))
    h = math.sqrt(0.5)
    line = Centreline((0.0, h, h), X).local(points)
    np.testing.assert_allclose(line[:, 0], points[:, 0])
    np.testing.assert_allclose(line[:, 2], (points[:, 1] + points[:, 2]) * h, atol=1e-12)
    np.testing.assert_allclose(line[:, 1], (points[:, 1] - points[:, 2]) * h, atol=1e-12)

    arc = Centreline(Z, X, 5.0)
    angle = rng.uniform(-0.8, 0.8, 200)
    on_it = np.stack([0 * angle, 5 * (1 - np.cos(angle)), 5 * np.sin(angle)], axis=-1)
    np.testing.assert_allclose(arc.local(on_it), np.stack([0 * angle, 0 * angle, 5 * angle], -1), atol=1e-12)
    # Against the nearest of densely sampled points of the arc.
    fine = np.linspace(-1.5, 1.5, 200_001)
    curve = np.stack([0 * fine, 5 * (1 - np.cos(fine)), 5 * np.sin(fine)], axis=-1)
    for p, local in zip(points[:20], arc.local(points[:20]), strict=True):
        distance = np.linalg.norm(curve - p, axis=-1)
        assert math.hypot(*local[:2]) == pytest.approx(distance.min(), abs=1e-8)
        assert local[2] == pytest.approx(5 * fine[distance.argmin()], abs=1e-4)
    np.testing.assert_allclose(arc.point(arc.local(points)), points, atol=1e-12)


@pytest.mark.parametrize(("tangent", "side", "radius"), [(Z, Z, 5.0), ((0.0, 0.0, 2.0), X, 5.0), (Z, X, 0.0)])
def test_centreline_refuses(tangent, side, radius):
    with pytest.raises(ValueError, match="must be"):
        Centreline(tangent, side, radius)


@pytest.mark.parametrize("name", VESSELS)
def test_tissues_have_the_volumes_of_the_analytic_plaque(name):
    shape, plaque = vessel(name, CENTER), Plaque(vessel_length=LENGTH_MM)
    # The outer side of the sharpest bend reaches 4.8 mm along z.
    fine = VolumeGrid((124, 110, 110), 0.08, CENTER)
    labels = shape.labels(voxel_centres(fine))
    volume = {k: float((labels == shape.straight.index(k)).sum() * 0.08**3) for k in ("core", "lumen", "wall")}
    assert volume["core"] == pytest.approx(plaque.core.volume, rel=0.01)
    if name == "bifurcating":
        assert volume["lumen"] > 1.1 * plaque.lumen.volume
    else:
        assert volume["lumen"] == pytest.approx(plaque.lumen.volume, rel=0.01)
        assert volume["wall"] == pytest.approx(plaque.outer.volume - plaque.inner.volume, rel=0.01)
    if name == "straight":
        painted = shape.painted(VolumeGrid((25, 28, 28), 0.4, CENTER), {"core": 2.0, "lumen": 1.0}, 4).sum() * 0.4**3
        assert painted == pytest.approx(2 * plaque.core.volume + plaque.lumen.volume, rel=0.01)


def test_the_straight_vessel_is_the_analytic_scene():
    plaque = Plaque(position=CENTER[::-1], vessel_length=LENGTH_MM)
    scene: Scene = plaque_scene(plaque)[0]
    points = voxel_centres(GRID)
    np.testing.assert_array_equal(vessel("straight", CENTER).labels(points), scene.labels(points))


def test_the_section_of_the_straight_vessel_has_the_papers_rois():
    paper = place_rois(plaque_scene(Plaque(position=CENTER[::-1]))[0], axial_grid(CENTER))
    ours = vessel("straight", CENTER).rois("section")
    for theirs, mask in ((paper.foreground, ours.foreground), (paper.background, ours.background)):
        middle = [np.mean(a[i]) for a, i in zip(paper.image.axes, np.nonzero(theirs), strict=True)]
        own = [np.mean(a[i]) for a, i in zip(ours.image.axes, np.nonzero(mask), strict=True)]
        np.testing.assert_allclose(own, middle, atol=0.05)
        # Two slices of the section.
        assert mask.sum() * 0.05**2 / 2 == pytest.approx(theirs.sum() * 0.035**2, rel=0.05)


def test_a_vessel_turned_in_plane_has_turned_labels():
    along_x, along_y = (vessel(name, CENTER).labels(voxel_centres(GRID)) for name in ("in_plane_x", "in_plane_y"))
    # By −90° about z: what lies at (x, y) comes to (y, −x).
    np.testing.assert_array_equal(along_x, along_y.transpose(0, 2, 1)[:, ::-1])
    assert (along_x != along_y).any()


@pytest.mark.parametrize("name", VESSELS)
def test_rois_lie_in_their_tissue_and_fat_is_plain(name):
    shape = vessel(name, CENTER)
    index = shape.straight.index
    # The same tissue is read in every vessel, whatever its direction; mm³ in all, mm² of the section.
    for roi, sizes, rel in (("tissue", (1.71, 2.33), 0.05), ("section", (1.02, 0.225), 0.2)):
        pair = shape.rois(roi)
        labels = shape.labels(voxel_centres(pair.image))
        assert (labels[pair.foreground] == index("core")).all()
        assert (labels[pair.background] == index("fibrous")).all()
        cell = np.prod(pair.image.spacing) / (0.1 if roi == "section" else 1.0)
        for mask, expected in zip((pair.foreground, pair.background), sizes, strict=True):
            assert mask.sum() * cell == pytest.approx(expected, rel=rel)
    fat = shape.plain_fat(GRID)
    assert fat.sum() > 1000
    inside = np.argwhere(shape.labels(voxel_centres(GRID)) != index("patient"))[::20]
    for voxel in np.argwhere(fat)[::200]:
        assert np.linalg.norm((inside - voxel) * 0.2, axis=-1).min() > 1.5


def test_the_truth_is_finer_than_the_methods_grid():
    for voxel in (0.2, 0.4):
        grid = VolumeGrid((6, 5, 4), voxel, CENTER)
        fine = fine_grid(grid)
        assert fine.spacing == pytest.approx((FINE_MM,) * 3)
        assert fine.extent == pytest.approx(grid.extent)
    shape = vessel("tilted", CENTER)
    coarse = VolumeGrid((22, 22, 22), 0.4, CENTER)
    fine = shape.painted(fine_grid(coarse), {"lumen": 1.0}).reshape(22, 4, 22, 4, 22, 4).mean((1, 3, 5))
    np.testing.assert_allclose(fine, shape.painted(coarse, {"lumen": 1.0}, 8), atol=1e-12)


def test_the_statistic_of_a_vessel_on_the_methods_grid_is_the_grams():
    A, weights = problem(views=120, shape=(12, 23, 23), voxel=0.4)
    gram = Gram(A, weights)
    of = SimpleNamespace(geometry=A.geometry, window=A.window, projector=A, weights=weights)
    shape = Vessel(Centreline(X, (0.0, -1.0, 0.0)), A.grid.center)
    values = {"wall": 160.0, "fibrous": 199.0, "core": 136.0, "lumen": 575.0}
    x = torch.from_numpy(shape.painted(A.grid, values) * 2e-5).float()
    b, model = projected(of, x, A.grid), gram.apply(x)
    assert float((b - model).norm() / b.norm()) < 0.02
    # The finer truth gives another statistic, but about the same.
    fine = fine_grid(A.grid)
    finer = projected(of, shape.painted(fine, values) * 2e-5, fine)
    assert 1e-4 < float((finer - b).norm() / b.norm()) < 0.1


TWINS = 8


def _found(gains, n=40):
    """What a linear filter of 10 HU shows, and a method with ``gains``: 0.8 of the contrast and 5 HU too little, its
    noise that of the filter but for a factor. The second pair of ROIs reads twice the contrast of the first."""
    found = {}
    covariance = np.kron(np.eye(2), np.diag([36.0, 64.0]))
    for seed, (name, gain) in enumerate(gains.items()):
        rng = np.random.default_rng(seed)
        noise = rng.standard_normal((n, 4)) * np.sqrt(np.diag(covariance))
        for method, slope, off in (("linear", 1.0, 0.0), ("mbir", 0.8, -5.0)):
            seen, false = off + 60.0 * slope, off
            clean = np.array([[40.0, 40.0 + seen, 40.0, 40.0 + 2 * seen], [100.0, 100 + false, 100, 100 + 2 * false]])
            if method == "linear":
                found[method, name, 2.0] = {"mean": clean, "covariance": covariance, "fat_variance": np.array(400.0)}
                continue
            scale = 0.8 / math.sqrt(gain)
            found[method, name, 2.0] = {
                "readings": clean[0] + scale * noise, "absent": clean[1] + scale * noise[:TWINS],
                "fat": 20.0 * scale * rng.standard_normal((n, 50)), "controls": 7.0 + noise[:, None],
                "control_mean": np.full((1, 4), 7.0), "control_covariance": covariance[None, :, None],
            }  # fmt: skip
    return found


def test_rows_say_what_is_gained_and_kept():
    rows = vessel_rows(_found({"straight": 3.0, "curved_5mm": 1.5}), 60.0)
    by = {(r["vessel"], r["method"]): r for r in rows if r["roi"] == "section"}
    assert len(rows) == 2 * len(by) == 8
    assert by["straight", "mbir"]["to_linear"]["value"] == pytest.approx(3.0)
    bent = by["curved_5mm", "mbir"]
    # The control follows the method: no sampling error, in the variance, the gain and the means.
    for key, value in (("to_linear", 1.5), ("kept", 0.5), ("slope", 0.8), ("contrast_hu", 43.0),
                       ("false_contrast_hu", -5.0), ("contrast_sd_hu", 8.0 / math.sqrt(1.5))):  # fmt: skip
        assert [bent[key][k] for k in ("value", "low", "high")] == pytest.approx([value] * 3), key
    assert bent["realizations"] == 40
    assert bent["fat_sd_hu"]["value"] == pytest.approx(16.0 / math.sqrt(1.5), rel=0.05)
    filtered = by["curved_5mm", "linear"]
    assert filtered["realizations"] is None
    for key, value in (("fat_sd_hu", 20.0), ("contrast_sd_hu", 10.0), ("contrast_hu", 60.0), ("slope", 1.0)):
        assert filtered[key] == pytest.approx({"value": value}), key
    assert filtered["to_linear"]["value"] is None
    assert by["straight", "mbir"]["kept"]["value"] is None
    wide = next(r for r in rows if (r["roi"], r["vessel"], r["method"]) == ("tissue", "curved_5mm", "mbir"))
    assert wide["slope"]["value"] == pytest.approx(1.6)
    assert not vessel_rows({}, 60.0)


def test_rows_without_the_linear_filter_or_the_straight_vessel():
    found = _found({"straight": 3.0, "tilted": 2.0})
    alone = vessel_rows({k: v for k, v in found.items() if k[0] == "mbir"}, 60.0)
    assert {r["to_linear"]["value"] for r in alone} == {None}
    tilted = vessel_rows({k: v for k, v in found.items() if k[1] == "tilted"}, 60.0)
    assert tilted[1]["to_linear"]["value"] == pytest.approx(2.0)
    assert tilted[1]["kept"]["value"] is None
