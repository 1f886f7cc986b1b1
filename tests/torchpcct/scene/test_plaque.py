"""The plaque: the paper's numbers, the variants."""

import math

import numpy as np
import pytest
from refusals import refusals

from torchpcct.scene.materials import MATERIALS
from torchpcct.scene.plaque import Plaque, interpolate_material, plaque_scene
from torchpcct.scene.plaque.variants import VARIANTS, plaque_variant, stent_bodies, textured


@pytest.fixture(scope="module")
def paper():
    return plaque_scene()


def test_place_and_size(paper):
    scene, plaque = paper
    assert math.hypot(*plaque.position[:2]) == pytest.approx(42.4, abs=0.1)
    assert scene.bounding_box("patient")[1, 0] == 120.0
    low, high = scene.bounding_box("wall")
    assert high[2] - low[2] == pytest.approx(230 * 0.042)
    assert scene.is_static
    assert scene["patient"].shape.rotationally_symmetric
    assert [m.name for m in scene.materials] == [
        "pericoronary_fat",
        "vessel_wall",
        "fibrous_tissue",
        "blood_iodine",
        "necrotic_core",
    ]


def test_minimum_cap_by_dense_sampling(paper):
    """Distance of all pairs of points of both surfaces, in the plaque's frame."""
    _, plaque = paper
    assert plaque.minimum_cap == pytest.approx(0.17, abs=1e-8)
    core = plaque.outer.to_local(plaque.core.surface_points(60_000))
    z = np.linspace(-1.2, 1.2, 241)
    centre, radius, _ = plaque.section("lumen", z)[0], *plaque.section("lumen", z)[2:]
    across = np.hypot(core[:, None, 0] - centre, core[:, None, 1]) - radius
    distance = np.hypot(np.maximum(across, 0.0), core[:, None, 2] - z)
    assert distance.min() == pytest.approx(0.17, abs=3e-4)
    assert plaque.core_center[0] == pytest.approx(1.569, abs=5e-4)


@pytest.mark.parametrize(
    "change",
    [{"cap_thickness": 0.065}, {"bulge": 0.6}, {"lumen_narrowing": 1.2}, {"orientation": 2.0}],
)
def test_parameters_keep_the_cap(change):
    scene, plaque = plaque_scene(**change)
    assert plaque.minimum_cap == pytest.approx(change.get("cap_thickness", 0.17), abs=1e-7)
    assert scene.labels(plaque.to_scanner(plaque.core_center)) == scene.index("core")


def test_sections(paper):
    _, plaque = paper
    z = np.array([0.0, 0.5, 2.0, 4.0])
    for name, shape in (
        ("outer", plaque.outer),
        ("inner", plaque.inner),
        ("lumen", plaque.lumen),
        ("core", plaque.core),
    ):
        cx, cy, ax, ay = plaque.section(name, z)
        for k in range(2):
            edge = plaque.to_scanner([(cx[k] + ax[k], cy[k], z[k]), (cx[k], cy[k] - ay[k], z[k])])
            np.testing.assert_allclose(shape.level(edge), 1.0, atol=1e-12)
    assert plaque.section("core", 2.0)[2] == 0.0
    assert plaque.area("lumen", 0.0) == pytest.approx(math.pi * (1.49**2 / 1.94) ** 2)
    with pytest.raises(ValueError, match="outer, inner, lumen, core"):
        plaque.section("cap")


@pytest.mark.parametrize("name", VARIANTS)
def test_variants_are_valid_scenes(name):
    scene, plaque = plaque_variant(name)
    scene.validate(4000)
    hu = dict(zip(scene.names, (m.hu(64.0) for m in scene.materials), strict=True))
    fibrous, core = 99.7, 39.7
    expected = {
        "absent_core": fibrous,
        "half_contrast": (fibrous + core) / 2,
        "flipped_contrast": 2 * fibrous - core,
    }.get(name, core)
    assert hu["core"] == pytest.approx(expected, abs=4)
    assert hu["fibrous"] == pytest.approx(core if name == "core_for_fibrous" else fibrous, abs=4)
    if name == "calcification":
        assert hu["calcification"] == pytest.approx(1500.0, abs=1)
    if name == "stent":
        assert hu["stent_2"] > 5000
    if name == "half_size_core":
        assert plaque.core.semi_axes == pytest.approx((0.3, 0.4925, 0.4925))
    if name == "textured":
        assert len(scene) > 100
        values = np.array([hu[n] for n in scene.names if n.startswith("fibrous_texture")])
        assert abs(values.mean() - fibrous) < 8
        assert 5 < values.std() < 30
    if name.endswith("patient"):
        assert scene.bounding_box("patient")[1, 0] in (90.0, 145.0)


def test_mirrored_and_turned():
    (_, plaque), (scene, mirrored) = plaque_scene(), plaque_variant("mirrored")
    core = np.array(plaque.core.position) - plaque.position
    np.testing.assert_allclose(
        np.array(mirrored.core.position) - mirrored.position, -core, atol=1e-12
    )
    assert scene.labels(mirrored.core.position) == scene.index("core")
    scene, turned = plaque_variant("turned")
    np.testing.assert_allclose(
        np.array(turned.core.position) - turned.position, (0.0, core[0], 0.0), atol=1e-12
    )


def test_contrast_is_exactly_linear():
    energies = np.linspace(20.0, 100.0, 9)
    a, b = MATERIALS["fibrous_tissue"], MATERIALS["necrotic_core"]
    for weight in (-1.0, 0.0, 0.5, 1.0):
        mixed = interpolate_material("mixed", a, b, weight).attenuation(energies)
        np.testing.assert_allclose(
            mixed,
            a.attenuation(energies) * (1 - weight) + b.attenuation(energies) * weight,
            rtol=1e-12,
        )
    with pytest.raises(ValueError, match="negative amount of"):
        interpolate_material("impossible", "water", "blood_iodine", -1.0)


test_bad_input_is_named = refusals(
    ("wall_thickness", lambda: Plaque(wall_thickness=2.0)),
    ("lumen_narrowing must be at least 1", lambda: Plaque(lumen_narrowing=0.5)),
    ("bulge must be at least 0 mm", lambda: Plaque(bulge=-0.1)),
    ("position must be 3 numbers", lambda: Plaque(position=(1.0, 2.0))),
    ("'core' leaves its parent 'fibrous'", lambda: plaque_scene(core_semi_axes=(1.0, 1.2, 1.2))),
    ("'wall' leaves its parent 'patient'", lambda: plaque_scene(patient_diameter=60.0)),
    ("'core' and 'lumen' overlap", lambda: plaque_scene(core_shift=(-0.3, 0.0, 0.0))),
    ("'wall' leaves its parent 'patient'", lambda: plaque_scene(motion_amplitude=90.0)),
    ("cap", lambda: plaque_scene(cap=0.2)),
    ("unknown variant 'none'", lambda: plaque_variant("none")),
    ("at least 1", lambda: stent_bodies(Plaque(), rings=0)),
    ("leaves the vessel", lambda: stent_bodies(Plaque(), rings=9)),
    ("endless", lambda: textured(plaque_scene()[0], "patient", np.random.default_rng(0))),
)
