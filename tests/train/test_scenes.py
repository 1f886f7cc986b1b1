"""Random training scenes: what they hold, that they are area-averaged and reproducible, and what
they must not hold."""

import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch

from train.scenes.drawing import STEP, curve, draw_scene, vessel_table
from train.scenes.held_out import held_out_plaques
from train.scenes.rasterise import rasterise
from train.scenes.scene import (
    COLUMNS,
    SceneConfig,
    Solid,
    Texture,
    Tissue,
    TrainingScene,
    Vessel,
    is_paper_family,
)

EXTENT = (8.0, 6.4, 6.4)
SHAPE = (20, 16, 16)
VOXEL = 0.4
Z = np.array([0.0, 0.0, 1.0])


def tube(
    direction=Z, bend=0.0, outer=1.5, lumen=0.8, wall=0.0, start=(0.03, 0.02, 0.01), **values
) -> Vessel:
    """A vessel of constant sections; at first without contrast between its parts."""
    line = curve(
        np.array(start),
        direction / np.linalg.norm(direction),
        np.full((161, 2), bend / math.sqrt(2)),
        80,
    )
    table = vessel_table(line, (0.0, 0.0, outer, outer), (0.0, 0.0, lumen, lumen))
    plain = {"wall_hu": 100.0, "fibrous_hu": 100.0, "lumen_hu": 100.0, "diameter": 2 * outer}
    return Vessel(table, 0.0, 0.0, wall, **{**plain, **values})


def core(**changes) -> Solid:
    base = Solid(
        Tissue.CORE,
        40.0,
        (0.6, 0.0, 0.0),
        (0.6, 0.985, 0.985),
        (Tissue.LAYER,),
        vessel=0,
        cap=0.17,
        contrast=-52.0,
    )
    return replace(base, **changes)


def paper_like(vessel: Vessel, *cores: Solid) -> TrainingScene:
    return TrainingScene(-90.0, vessels=(vessel,), cores=cores)


def test_same_seed_same_scene() -> None:
    first, second = (rasterise(draw_scene(3, EXTENT), SHAPE, VOXEL) for _ in range(2))
    for name in ("image", "data", "signal", "around"):
        one, other = getattr(first, name), getattr(second, name)
        assert one.shape == SHAPE
        assert one.dtype == np.float32
        assert np.array_equal(one, other)
    assert not np.array_equal(first.image, rasterise(draw_scene(4, EXTENT), SHAPE, VOXEL).image)


def test_what_many_scenes_hold() -> None:
    """Every kind of disease is drawn often enough to be learned, and most cores lie inside."""
    scenes = [draw_scene(seed, EXTENT) for seed in range(400)]
    kinds = Counter(
        s.kind
        for scene in scenes
        for s in {s.kind: s for s in (*scene.beside, *scene.solids)}.values()
    )
    kinds["stent"] = sum(bool(s.stents) for s in scenes)
    kinds["halo"] = sum(bool(s.halos) for s in scenes)
    kinds["two"] = sum(len(s.vessels) == 2 for s in scenes)
    kinds["core"] = sum(any(c.contrast for c in s.cores) for s in scenes)
    kinds["motion"] = sum(any(s.motion) for s in scenes)
    for name in (
        "free",
        "beside",
        "strand",
        "nodule",
        "spotty",
        "calcification",
        "ulcer",
        "mural thrombus",
        "free thrombus",
        "flap",
        "false lumen",
        "occlusion",
        "stent",
        "halo",
        "two",
        "core",
        "motion",
    ):
        assert kinds[name] >= 5, (name, kinds)
    contrasts = np.array([c.contrast for s in scenes for c in s.cores if c.contrast])
    config = SceneConfig()
    assert 0.5 < (contrasts < 0).mean() < 0.8
    assert np.abs(contrasts).min() >= config.core_contrast[0]
    assert np.abs(contrasts).max() <= config.core_contrast[1]
    painted = [rasterise(s, SHAPE, VOXEL) for s in scenes[:40]]
    volumes = [
        float(p.signal.sum()) * VOXEL**3
        for s, p in zip(scenes, painted, strict=False)
        if s.cores and s.cores[0].contrast and s.signal == Tissue.CORE
    ]
    assert np.mean(np.array(volumes) > 0.05) > 0.7
    for p in painted:
        assert np.isfinite(p.image).all()
        assert -1100.0 < p.image.min() <= p.image.max() < 8000.0
        assert p.signal.min() >= 0
        assert (p.signal + p.around).max() <= 1 + 1e-5


def test_small_bodies_beside_vessels_leave_the_rest_as_it_is() -> None:
    """They are as small as nodules, displace no vessel, and are there as often as asked for."""
    plain, with_small = SceneConfig(), SceneConfig(small_probability=0.5, nodule_size=(0.3, 0.5))
    number, of_vessels = 0, 0
    for seed in range(100):
        scene, other = draw_scene(seed, EXTENT, with_small), draw_scene(seed, EXTENT, plain)
        if not other.vessels:
            assert scene.solids == other.solids
            continue
        small = [s for s in scene.solids if s.kind == "free"]
        assert len(small) <= 4
        of_vessels, number = of_vessels + 1, number + bool(small)
        for body in small:
            assert max(sorted(body.semi_axes)[:2]) <= 0.5
            assert set(body.displaces) == {Tissue.BACKGROUND, Tissue.BESIDE}
            assert -150.0 <= body.hu - scene.background <= 300.0
        if not small:
            assert scene.blur == other.blur
            assert [s.kind for s in scene.solids] == [s.kind for s in other.solids]
    assert 0.35 * of_vessels < number < 0.65 * of_vessels


def test_a_scene_without_its_lesions_is_a_healthy_one() -> None:
    """Vessels, stents and the tissue beside them are as they were, and nothing else is left."""
    seen: Counter[str] = Counter()
    for seed in range(40):
        scene = draw_scene(seed, EXTENT, SceneConfig(small_probability=0.5))
        healthy = scene.without_lesions()
        for name in ("background", "vessels", "stents", "textures", "blur", "motion"):
            assert getattr(healthy, name) is getattr(scene, name)
        assert (healthy.cores, healthy.solids, healthy.halos) == ((), (), ())
        assert {body.kind for body in healthy.beside} <= {"beside"}
        seen += Counter(body.kind for body in scene.beside if body not in healthy.beside)
        seen["tissue"] += len(healthy.beside)
    assert min(seen[kind] for kind in ("tissue", "nodule", "strand")) > 0


@pytest.mark.parametrize("axes", [(0.6, 0.6, 0.6), (0.4, 0.9, 1.4), (0.3, 0.5, 2.0)])
def test_ellipsoid_has_its_volume_at_any_offset(axes: tuple) -> None:
    rng = np.random.default_rng(5)
    shape = (25, 25, 25)
    for _ in range(4):
        q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        centre = tuple(rng.uniform(-0.2, 0.2, 3))
        body = Solid(Tissue.INSERT, 1.0, centre, axes, tuple(Tissue), rotation=tuple(q.ravel()))
        image = rasterise(TrainingScene(0.0, solids=(body,)), shape, 0.2).image.astype(np.float64)
        assert image.sum() * 0.008 == pytest.approx(4 / 3 * math.pi * math.prod(axes), rel=0.004)
        at = (np.arange(25) - 12) * 0.2
        centroid = [
            float((image * w).sum() / image.sum()) for w in np.meshgrid(at, at, at, indexing="ij")
        ]
        assert centroid == pytest.approx(centre[::-1], abs=0.003)


@pytest.mark.parametrize("direction", [(0, 0, 1), (0.6, 0, 0.8), (1, 0, 0), (1, 1, 1)])
def test_tubes_have_their_section_in_every_direction(direction: tuple) -> None:
    """The volume of a straight tube in a ball is that of the cylinder in it, by points on a fine
    grid."""
    d = np.array(direction, dtype=np.float64)
    image = rasterise(
        TrainingScene(0.0, vessels=(tube(d, outer=0.9, start=(0, 0, 0)),)), (18, 18, 18), 0.2
    ).image
    fine = (np.arange(180) - 89.5) * 0.02
    z, y, x = np.meshgrid(fine, fine, fine, indexing="ij", sparse=True)
    along = (x * d[0] + y * d[1] + z * d[2]) / np.linalg.norm(d)
    inside = x**2 + y**2 + z**2 - along**2 < 0.81
    exact = 100.0 * inside.reshape(18, 10, 18, 10, 18, 10).mean((1, 3, 5))
    assert float(np.sqrt(np.square(image - exact).mean())) < 0.3
    assert float(image.sum()) == pytest.approx(float(exact.sum()), rel=4e-3)


def test_a_ring_closes() -> None:
    """A tube of constant curvature is a torus: its volume is 2π R times its section, and it
    stays on its circle."""
    radius = 3.0
    line = curve(np.zeros(3), Z, np.stack([np.full(161, 1 / radius), np.zeros(161)], 1), 80)
    centre = line[6:9, 80] * radius
    assert np.abs(np.linalg.norm(line[:3].T - centre, axis=1) - radius).max() < 0.01
    frames = line[3:12].T.reshape(-1, 3, 3)
    assert np.abs(frames @ frames.transpose(0, 2, 1) - np.eye(3)).max() < 1e-9
    keep = slice(80 - 47, 80 + 48)  # 2π R = 18.85 mm, 95 nodes of 0.2 mm
    table = vessel_table(line, (0.0, 0.0, 0.7, 0.7), (0.0, 0.0, 0.3, 0.3))[:, keep]
    table[:3] -= centre[:, None]
    vessel = Vessel(np.ascontiguousarray(table), 0.0, 0.0, 0.0, 100.0, 100.0, 100.0)
    image = rasterise(TrainingScene(0.0, vessels=(vessel,)), (40, 20, 40), 0.2).image
    turned = rasterise(TrainingScene(0.0, vessels=(vessel,)), (40, 40, 40), 0.2).image
    volume = max(image.sum(), turned.sum()) * 0.008 / 100
    assert volume == pytest.approx(2 * math.pi * radius * math.pi * 0.49, rel=0.02)


def test_layers_are_nested() -> None:
    """Where faces are closer than a cell, nothing of what is outside gets in between."""
    vessel = tube(
        outer=1.0,
        lumen=0.97,
        wall=0.02,
        wall_hu=0.0,
        fibrous_hu=0.0,
        lumen_hu=100.0,
        start=(0, 0, 0),
    )
    image = rasterise(TrainingScene(-1000.0, vessels=(vessel,)), (4, 14, 14), 0.2).image
    areas = math.pi * (100.0 * 0.97**2 + 1000.0) - 1000.0 * math.pi * (1 - 1.0**2)
    assert float(image[2].sum() + 1000.0 * 196) * 0.04 == pytest.approx(areas, rel=4e-3)


def test_voxels_are_averages_of_finer_ones() -> None:
    """Near faces, to a HU (0.5 % of the spread where something is very dense) of what takes 27
    times as long."""
    errors, relative = [], []
    # Wires are thinner than cells; where vessels meet, in a few cells, it is not known what lies in
    # front of what.
    config = SceneConfig(
        stent_probability=0.0, wide_probability=0.0, branch_probability=0.0, second_vessel=0.0
    )
    for seed in range(12):
        scene = draw_scene(seed, (2.4, 2.4, 2.4), config)
        coarse, fine = (rasterise(scene, (12, 12, 12), 0.2, cells).image for cells in (2, 6))
        near = np.abs(np.gradient(fine)).max(0) > 5.0
        if near.any():
            errors.append(float(np.sqrt(np.square(coarse - fine)[near].mean())))
            relative.append(errors[-1] / float(fine.std()))
    assert np.median(errors) < 1.0
    assert np.mean(relative) < 0.01


def test_data_are_blurred_and_the_truth_is_not() -> None:
    scene = TrainingScene(-90.0, vessels=(tube(),), blur=0.1, motion=(0.0, 0.2))
    found = rasterise(scene, SHAPE, VOXEL)
    sharp = rasterise(replace(scene, blur=0.0, motion=(0.0, 0.0)), SHAPE, VOXEL)
    assert np.array_equal(found.image, sharp.image)
    assert np.array_equal(sharp.data, sharp.image)
    assert found.data.mean() == pytest.approx(found.image.mean(), abs=0.05)
    steepest = [np.abs(np.gradient(found.data[10], axis=axis)).max() for axis in (0, 1)]
    assert steepest[1] < steepest[0] < np.abs(np.gradient(found.image[10], axis=0)).max() + 1e-3


def test_masks_are_the_contrast() -> None:
    """Core and tissue about it are the derivatives of the image by the HU of the two."""
    vessel = tube(
        outer=1.68,
        lumen=0.5,
        wall=0.19,
        fibrous_hu=92.0,
        lumen_hu=350.0,
        wall_hu=20.0,
        holds_core=True,
    )

    def paint(vessel: Vessel, *cores: Solid):
        return rasterise(paper_like(vessel, *cores), (24, 24, 24), 0.2)

    found = paint(vessel, core())
    assert np.allclose(
        paint(vessel, core(hu=50.0)).image - found.image, 10 * found.signal, atol=1e-3
    )
    assert np.allclose(
        paint(replace(vessel, fibrous_hu=102.0), core()).image - found.image,
        10 * found.around,
        atol=1e-3,
    )
    assert float(found.signal.max()) == pytest.approx(1.0)
    assert float(found.around.max()) == pytest.approx(1.0)


def test_what_a_body_displaces_is_all_it_displaces() -> None:
    """A crater fills the layer and leaves wall and fat; a thrombus fills the lumen and leaves
    the layer."""
    vessel = tube(
        outer=1.5,
        lumen=0.8,
        wall=0.3,
        wall_hu=10.0,
        fibrous_hu=90.0,
        lumen_hu=400.0,
        start=(0, 0, 0),
    )
    plain = rasterise(paper_like(vessel), (16, 20, 20), 0.2).image
    for tissue, hu, displaces, before in (
        (Tissue.LUMEN, 400.0, (Tissue.FIBROUS,), 90.0),
        (Tissue.INSERT, 60.0, (Tissue.LUMEN,), 400.0),
    ):
        body = Solid(tissue, hu, (0.9, 0.0, 0.0), (0.6, 0.5, 0.5), displaces, vessel=0)
        changed = (
            rasterise(replace(paper_like(vessel), solids=(body,)), (16, 20, 20), 0.2).image - plain
        )
        assert np.abs(changed).max() > 200.0
        pure = np.abs(plain - before) < 1e-3
        others = [np.abs(plain - v) < 1e-3 for v in (10.0, -90.0, 90.0, 400.0) if v != before]
        assert np.abs(changed[pure]).max() > 100.0
        for other in others:
            assert np.abs(changed[other]).max() < 1e-3


def test_paper_family_is_recognised() -> None:
    vessel = tube(outer=1.68)
    assert is_paper_family(paper_like(vessel, core()))
    turned = core(semi_axes=(1.1, 0.5, 0.9), contrast=-36.0, vessel=1)
    assert is_paper_family(
        replace(
            paper_like(tube(outer=1.3)), vessels=(tube(outer=1.3), tube(outer=1.8)), cores=(turned,)
        )
    )
    relatives = ([core(), core()], [core(contrast=-80.0)], [core(exponent=4.0)])
    assert all(is_paper_family(paper_like(vessel, *cores)) for cores in relatives)
    others = (
        [core(contrast=-95.0)],
        [core(contrast=52.0)],
        [core(semi_axes=(0.6, 0.65, 0.985))],
        [],
    )
    assert not any(is_paper_family(paper_like(vessel, *cores)) for cores in others)
    assert not is_paper_family(paper_like(tube(outer=1.3), core()))


def test_the_rule_takes_something_away(monkeypatch: pytest.MonkeyPatch) -> None:
    """A rule that rejects nothing excludes nothing."""
    monkeypatch.setattr("train.scenes.drawing.is_paper_family", lambda scene: False)
    rejected = sum(is_paper_family(draw_scene(seed, EXTENT)) for seed in range(400))
    assert 1 <= rejected <= 20


def test_paper_family_is_never_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Even where the distribution is narrowed to the family, which shows that the rejection is
    what keeps it out."""
    config = SceneConfig(
        diameter=(3.1, 3.6),
        core_size=(0.55, 1.1),
        core_contrast=(36.0, 69.0),
        core_negative=1.0,
        core_counts=(1.0,),
        core_probability=1.0,
        free_probability=0.0,
    )
    assert not any(is_paper_family(draw_scene(seed, EXTENT, config)) for seed in range(100))
    monkeypatch.setattr("train.scenes.drawing.is_paper_family", lambda scene: False)
    assert any(is_paper_family(draw_scene(seed, EXTENT, config)) for seed in range(100))


def test_texture_has_its_sd_and_length() -> None:
    values = np.stack(
        [Texture(8.0, 0.6, seed).field((12, 12, 12), (0.6, 0.6, 0.6)) for seed in range(40)]
    )
    # Averaging over voxels of 0.6 mm takes some of the variance: (1 + h² / 6 l²) ^ −1/2 per axis,
    # or about
    assert values.std() == pytest.approx(8.0 * (1 + 1 / 6) ** -0.75, rel=0.05)
    points = np.stack(
        [Texture(8.0, 0.6, seed).field((10, 10, 10), (0.06, 0.06, 0.6)) for seed in range(80)]
    )
    correlation = np.mean(points[..., 1:] * points[..., :-1]) / np.mean(points**2)
    assert correlation == pytest.approx(math.exp(-0.5), abs=0.12)


def test_bends_are_not_tighter_than_asked_for() -> None:
    config = SceneConfig(
        bend_probability=1.0, bend_radius=(3.0, 3.0), diameter=(2.0, 2.0), free_probability=0.0
    )
    tightest = []
    for seed in range(20):
        table = draw_scene(seed, EXTENT, config).vessels[0].table
        tangents = table[3:6].T
        turns = np.arccos(np.clip((tangents[1:] * tangents[:-1]).sum(1), -1, 1)) / STEP
        tightest.append(turns.max())
        assert np.allclose(np.diff(table[COLUMNS.index("s")]), STEP)
    assert max(tightest) == pytest.approx(1 / 3, rel=0.02)
    assert min(tightest) > 0.25


def test_held_out_plaques() -> None:
    shape = (45, 45, 56)
    found = held_out_plaques(shape, 0.2, seed=0, size=4)
    assert found.image.shape == (4, 4, *shape)
    assert torch.equal(found.image, held_out_plaques(shape, 0.2, seed=0, size=4).image)
    for scene in found.scenes:
        assert not is_paper_family(scene)
        assert scene.vessels[0].diameter in (2.6, 4.4)
    axes = (-3, -2, -1)
    core_hu = (found.image * found.core_roi[:, None]).sum(axes) / found.core_roi.sum(axes)[:, None]
    fibrous = (found.image * found.fibrous_roi[:, None]).sum(axes) / found.fibrous_roi.sum(axes)[
        :, None
    ]
    assert torch.allclose(
        core_hu - fibrous, torch.tensor([-60.0, -30.0, 0.0, 40.0]).expand(4, 4), atol=0.7
    )
    assert float((found.core_roi * found.fibrous_roi).max()) == 0.0
    assert float(found.core_roi.sum(axes).min()) >= 20
    assert float(found.fibrous_roi.sum(axes).min()) >= 20
    assert torch.equal(found.image[:, 2][found.core == 0], found.image[:, 0][found.core == 0])
    coarser = held_out_plaques((24, 24, 29), 0.375)
    assert float(coarser.core_roi.sum(axes).min()) >= 1


def test_invalid_grids() -> None:
    for shape in ((8, 8), (8, 8, 0)):
        with pytest.raises(ValueError, match="must be three positive"):
            held_out_plaques(shape, 1.0)
    with pytest.raises(ValueError, match="voxel_mm"):
        held_out_plaques((8, 8, 8), -1.0)
    with pytest.raises(ValueError, match="no voxel wholly inside"):
        held_out_plaques((6, 6, 6), 1.5)
