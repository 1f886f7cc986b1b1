"""The thorax: nesting, tissues, adult dimensions."""

import math

import numpy as np
import pytest

from torchpcct.geometry import VolumeGrid
from torchpcct.scene.phantoms.thorax import RIB_ANGLES_DEG, thorax


def box(scene, name):
    """In-plane bounding box: the bodies are endless along z."""
    return scene.bounding_box(name)[:, :2]


@pytest.fixture(scope="module")
def scene():
    return thorax()


def test_bodies_nest_also_when_looked_at_closely(scene):
    scene.validate(samples=20_000)


def test_adult_dimensions(scene):
    low, high = box(scene, "skin")
    assert (high - low) == pytest.approx((340.0, 236.0))
    heart = box(scene, "heart")
    assert heart.mean(0) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert 100.0 < (heart[1] - heart[0])[0] < 120.0
    assert len(
        [n for n in scene.names if n.startswith("rib_") and not n.endswith("marrow")]
    ) == 2 * len(RIB_ANGLES_DEG)


def test_ribs_are_mirror_images(scene):
    middle = box(scene, "skin").mean(0)[0]
    for k in range(len(RIB_ANGLES_DEG)):
        left, right = (box(scene, f"rib_{side}_{k}") for side in ("left", "right"))
        np.testing.assert_allclose(left[:, 1], right[:, 1])
        np.testing.assert_allclose(left[:, 0] - middle, middle - right[::-1, 0])


def test_tissue_areas_of_a_slice(scene):
    grid = VolumeGrid((1, 250, 360), 1.0, (0.0, -34.0, -14.0))
    # cm²
    fractions = dict(
        zip(scene.names, scene.volume_fractions(grid).sum((1, 2, 3)) / 100.0, strict=True)
    )
    assert sum(fractions.values()) == pytest.approx(math.pi * 17.0 * 11.8, rel=1e-3)
    assert 180.0 < fractions["lungs"] < 280.0
    chambers = sum(
        fractions[n] for n in ("left_ventricle", "right_ventricle", "left_atrium", "right_atrium")
    )
    assert 50.0 < fractions["heart"] + chambers < 80.0
    bone = sum(
        v for n, v in fractions.items() if n.startswith(("rib", "vertebra", "sternum", "arch"))
    )
    assert 20.0 < bone < 45.0


def test_it_moves_as_a_whole(scene):
    moved = thorax(center=(0.0, 0.0))
    shift = box(moved, "skin") - box(scene, "skin")
    for name in scene.names:
        np.testing.assert_allclose(box(moved, name) - box(scene, name), shift)


def test_blood_and_muscle_can_be_exchanged():
    scene = thorax(blood="blood_iodine", myocardium="soft_tissue")
    assert scene["left_ventricle"].material == scene["aorta"].material == "blood_iodine"
    assert scene["heart"].material == "soft_tissue"


def test_bad_values():
    with pytest.raises(ValueError, match="center"):
        thorax(center=(0.0,))
