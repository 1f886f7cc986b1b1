"""Random training scenes: what they hold, that they are area-averaged and reproducible, and what they must not hold."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from train.scenes.drawing import draw_scene
from train.scenes.held_out import validation_scenes
from train.scenes.rasterise import rasterise
from train.scenes.scene import SceneConfig, Solid, Texture, TrainingScene, Vessel, is_paper_family

EXTENT = (9.0, 9.0, 11.2)
SMALL = (15, 15, 19)


def vessel(**changes: object) -> Vessel:
    base = Vessel(
        position=(0.3, -0.2),
        slope=(0.0, 0.0),
        diameter=3.36,
        aspect=1.0,
        angle=0.0,
        wall=0.19,
        wall_hu=20.0,
        fibrous_hu=92.0,
        lumen_hu=350.0,
        lumen_radius=0.7,
        lumen_aspect=1.0,
        lumen_angle=0.0,
        eccentricity=0.8,
        eccentric_angle=3.0,
    )
    return replace(base, **changes)


PAPER_CORE = Solid("core", "ellipsoid", 40.0, (0.6, 0.0, 0.0), (0.6, 0.985, 0.985), cap=0.17, contrast=-52.0)


def test_same_seed_same_scene() -> None:
    first, second = (rasterise(draw_scene(3, EXTENT), SMALL, (0.6, 0.6, 0.6)) for _ in range(2))
    assert first.shape == (3, *SMALL)
    assert first.dtype == np.float32
    assert np.array_equal(first, second)
    assert draw_scene(3, EXTENT) == draw_scene(3, EXTENT) != draw_scene(4, EXTENT)


def test_content_of_many_scenes() -> None:
    scenes = [draw_scene(seed, EXTENT) for seed in range(200)]
    image, core, surround = np.stack([rasterise(s, SMALL, (0.6, 0.6, 0.6)) for s in scenes], axis=1)
    config = SceneConfig()
    assert np.isfinite(image).all()
    # Five SD of texture beyond the ranges
    assert image.min() >= config.fat[0] + config.wide_contrast[0] - 75.0
    assert image.max() <= config.calcification_hu[1] + 75.0
    for mask in (core, surround):
        assert mask.min() >= 0.0
        assert mask.max() <= 1.0 + 1e-6
    assert (core + surround).max() <= 1.0 + 1e-6
    contrasts = np.array([s.cores[0].contrast if s.cores else 0.0 for s in scenes])
    real = contrasts[contrasts != 0]
    assert 0.3 <= 1.0 - len(real) / len(scenes) <= 0.6
    assert 0.4 < (real < 0).mean() < 0.8
    assert np.abs(real).min() >= config.core_contrast[0]
    assert np.abs(real).max() <= config.core_contrast[1]
    counts = {
        "free": sum(bool(s.free) for s in scenes),
        "two": sum(len(s.vessels) == 2 for s in scenes),
        "texture": sum(bool(s.textures) for s in scenes),
        "calcium": sum(any(v.kind == "calcification" for w in s.vessels for v in w.solids) for s in scenes),
        "virtual": sum(bool(s.cores) and s.cores[0].contrast == 0 for s in scenes),
    }
    assert all(10 <= n <= 90 for n in counts.values()), counts
    assert {c.shape for s in scenes for c in s.cores} == {"ellipsoid", "superquadric", "crescent", "rod"}
    # Not a figment of the drawing: most cores lie inside the grid, with 0.05 mm³ or more.
    assert (core.sum((1, 2, 3))[contrasts != 0] * 0.6**3 >= 0.05).mean() > 0.8


@pytest.mark.parametrize("axes", [(0.6, 0.6, 0.6), (0.4, 0.9, 1.4), (0.3, 0.5, 2.0)])
@pytest.mark.parametrize("spacing", [(0.2, 0.2, 0.2), (0.4, 0.2, 0.2)])
def test_ellipsoid_has_its_volume_at_any_offset(axes: tuple, spacing: tuple) -> None:
    rng = np.random.default_rng(5)
    shape = tuple(round(5.0 / s) for s in spacing)
    for _ in range(4):
        q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        centre = tuple(rng.uniform(-0.2, 0.2, 3))
        body = Solid("free", "ellipsoid", 1.0, centre, axes, rotation=tuple(q.ravel()))
        image = rasterise(TrainingScene(0.0, free=(body,)), shape, spacing)[0].astype(np.float64)
        assert image.sum() * math.prod(spacing) == pytest.approx(4 / 3 * math.pi * math.prod(axes), rel=0.01)
        where = np.meshgrid(
            *[(np.arange(n) - (n - 1) / 2) * s for n, s in zip(shape, spacing, strict=True)], indexing="ij"
        )
        centroid = [float((image * w).sum() / image.sum()) for w in where]
        assert centroid == pytest.approx(centre[::-1], abs=0.005)


def test_second_tissue_lies_behind_all_and_leaves_both() -> None:
    """Fat beside muscle: one border through the inset, and the vessel where it was."""
    config = SceneConfig(second_tissue=1.0, texture_probability=0.0, free_probability=0.0, second_vessel=0.0)
    shares = []
    for seed in range(30):
        scene = draw_scene(seed, EXTENT, config)
        image, core, around = rasterise(scene, (20, 20, 20), (0.2, 0.2, 0.2))
        plain = rasterise(replace(scene, tissues=()), (20, 20, 20), (0.2, 0.2, 0.2))[0]
        (second,) = scene.tissues
        filled = core + around > 0.999
        np.testing.assert_allclose(image[filled], plain[filled], atol=0.1)
        assert image.min() >= min(plain.min(), second.hu) - 1e-3
        shares.append(float((np.abs(image - second.hu) < 1e-3).mean()))
        assert (second.hu > -20.0) == (scene.background < -20.0)
    assert min(shares) < 0.2
    assert max(shares) > 0.5


def test_voxels_are_averages_of_finer_ones() -> None:
    for seed in (5, 7, 11):
        scene = replace(draw_scene(seed, EXTENT), textures=(Texture(10.0, 0.8, seed),) * 2)
        coarse = rasterise(scene, (20, 20, 20), (0.2, 0.2, 0.2))[0]
        fine = rasterise(scene, (80, 80, 80), (0.05, 0.05, 0.05))[0].reshape(20, 4, 20, 4, 20, 4).mean((1, 3, 5))
        spread = float(fine.std())
        assert float(np.sqrt(np.mean((coarse - fine) ** 2))) < 0.06 * spread
        assert abs(float(np.mean(coarse - fine))) < 0.01 * spread


def test_tilted_tube_has_the_thickness_asked_for() -> None:
    """Across the tube, not across the slice: a slice of the tilted one is longer by 1 / cos."""
    tube = vessel(slope=(math.tan(0.6), 0.0), position=(0.0, 0.0), lumen_radius=0.6, lumen_hu=92.0, wall_hu=92.0)
    image = rasterise(TrainingScene(-90.0, (tube,)), (21, 60, 60), (0.2, 0.2, 0.2))[0]
    area = float((image[10] + 90.0).sum()) / 182.0 * 0.04
    assert area == pytest.approx(math.pi * 1.68**2 / math.cos(0.6), rel=0.01)


def test_masks_are_the_contrast() -> None:
    """Core and surround are the derivatives of the image by the HU of the two tissues."""
    tube = vessel(solids=(PAPER_CORE,))

    def paint(vessel: Vessel) -> np.ndarray:
        return rasterise(TrainingScene(-90.0, (vessel,)), (30, 30, 30), (0.2, 0.2, 0.2))

    image, core, surround = paint(tube)
    core_up = replace(tube, solids=(replace(PAPER_CORE, hu=50.0),))
    assert np.allclose(paint(core_up)[0] - image, 10 * core, atol=1e-3)
    assert np.allclose(paint(replace(tube, fibrous_hu=102.0))[0] - image, 10 * surround, atol=1e-3)
    assert float(core.max()) == pytest.approx(1.0)
    assert float(surround.max()) == pytest.approx(1.0)


def test_other_spacings_show_the_same_scene() -> None:
    for seed in (9, 10, 11):
        scene = draw_scene(seed, (9.0, 9.0, 10.8))
        fine = rasterise(scene, (30, 30, 36), (0.3, 0.3, 0.3))[0]
        coarse = rasterise(scene, (15, 20, 18), (0.6, 0.45, 0.6))[0]
        assert fine.mean() == pytest.approx(coarse.mean(), abs=2.0)


def test_paper_family_is_recognised() -> None:
    assert is_paper_family(TrainingScene(-90.0, (vessel(solids=(PAPER_CORE,)),)))
    turned = replace(PAPER_CORE, semi_axes=(1.1, 0.5, 0.9), contrast=-36.0)
    assert is_paper_family(TrainingScene(-90.0, (vessel(diameter=2.6), vessel(diameter=3.6, solids=(turned,)))))
    relatives = (
        vessel(diameter=2.9, solids=(PAPER_CORE,)),
        vessel(solids=(PAPER_CORE, PAPER_CORE)),
        vessel(solids=(replace(PAPER_CORE, contrast=-80.0),)),
        vessel(solids=(replace(PAPER_CORE, shape="superquadric", exponent=4.0),)),
    )
    assert all(is_paper_family(TrainingScene(-90.0, (v,))) for v in relatives)
    others = (
        vessel(diameter=2.6, solids=(PAPER_CORE,)),
        vessel(solids=(replace(PAPER_CORE, contrast=-95.0),)),
        vessel(solids=(replace(PAPER_CORE, contrast=52.0),)),
        vessel(solids=(replace(PAPER_CORE, semi_axes=(0.6, 0.65, 0.985)),)),
        vessel(),
    )
    assert not any(is_paper_family(TrainingScene(-90.0, (v,))) for v in others)


def test_the_rule_takes_something_away(monkeypatch: pytest.MonkeyPatch) -> None:
    """One draw in a hundred: a rule that rejects nothing excludes nothing."""
    monkeypatch.setattr("train.scenes.drawing.is_paper_family", lambda scene: False)
    rejected = sum(is_paper_family(draw_scene(seed, EXTENT)) for seed in range(600))
    assert 3 <= rejected <= 18


def test_paper_family_is_never_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Even where the distribution is narrowed to the family, which shows that the rejection is what keeps it out."""
    config = SceneConfig(
        diameter=(3.1, 3.6),
        core_size=(0.55, 1.1),
        core_contrast=(36.0, 69.0),
        core_negative=1.0,
        core_counts=(1.0,),
        core_probability=1.0,
        free_probability=0.0,
    )
    assert not any(is_paper_family(draw_scene(seed, EXTENT, config)) for seed in range(200))
    monkeypatch.setattr("train.scenes.drawing.is_paper_family", lambda scene: False)
    assert any(is_paper_family(draw_scene(seed, EXTENT, config)) for seed in range(200))


def test_texture_has_its_sd_and_length() -> None:
    values = np.stack([Texture(8.0, 0.6, seed).field((12, 12, 12), (0.6, 0.6, 0.6)) for seed in range(40)])
    # Averaging over voxels of 0.6 mm takes some of the variance: (1 + h² / 6 l²) ^ −1/2 per axis, or about
    assert values.std() == pytest.approx(8.0 * (1 + 1 / 6) ** -0.75, rel=0.05)
    points = np.stack([Texture(8.0, 0.6, seed).field((10, 10, 10), (0.06, 0.06, 0.6)) for seed in range(80)])
    correlation = np.mean(points[..., 1:] * points[..., :-1]) / np.mean(points**2)
    assert correlation == pytest.approx(math.exp(-0.5), abs=0.12)


def test_validation_scenes() -> None:
    shape, spacing = (45, 45, 56), (0.2, 0.2, 0.2)
    scenes = validation_scenes(shape, spacing, seed=0, size=4)
    assert scenes.image.shape == (4, 4, *shape)
    assert torch.equal(scenes.image, validation_scenes(shape, spacing, seed=0, size=4).image)
    for scene in scenes.scenes:
        assert not is_paper_family(scene)
        assert scene.vessels[0].diameter in (2.6, 4.4)
    axes = (-3, -2, -1)
    core = (scenes.image * scenes.core_roi[:, None]).sum(axes) / scenes.core_roi.sum(axes)[:, None]
    fibrous = (scenes.image * scenes.fibrous_roi[:, None]).sum(axes) / scenes.fibrous_roi.sum(axes)[:, None]
    assert torch.allclose(core - fibrous, torch.tensor([-60.0, -30.0, 0.0, 40.0]).expand(4, 4), atol=0.7)
    assert float((scenes.core_roi * scenes.fibrous_roi).max()) == 0.0
    assert float(scenes.core_roi.sum(axes).min()) >= 20
    assert float(scenes.fibrous_roi.sum(axes).min()) >= 20
    assert torch.equal(scenes.image[:, 2][scenes.core == 0], scenes.image[:, 0][scenes.core == 0])
    coarser = validation_scenes((24, 24, 29), (0.375, 0.375, 0.375))
    assert float(coarser.core_roi.sum(axes).min()) >= 1


def test_invalid_grids() -> None:
    for shape, spacing in (((8, 8), (1, 1, 1)), ((8, 8, 0), (1, 1, 1)), ((8, 8, 8), (1, 1, -1))):
        with pytest.raises(ValueError, match="must be three positive"):
            validation_scenes(shape, spacing)
    with pytest.raises(ValueError, match="no voxel wholly inside"):
        validation_scenes((6, 6, 6), (1.5, 1.5, 1.5))
