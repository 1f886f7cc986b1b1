"""Shapes, the tree of bodies, motion, labels and volume fractions."""

import math

import numpy as np
import pytest
from refusals import refusals, refused

from torchpcct.geometry import VolumeGrid
from torchpcct.scene import (
    Body,
    Box,
    BulgedTube,
    Ellipsoid,
    EllipticCylinder,
    NarrowedTube,
    Scene,
    SinusoidalMotion,
    chord_lengths,
    rotation_matrix,
)
from torchpcct.scene.materials import MATERIALS
from torchpcct.scene.phantoms.quality import CTDI_HOLES, ctdi, water_cylinder

TILT = rotation_matrix((1.0, 2.0, -0.5), 0.7)
SHAPES = [
    Ellipsoid((0.6, 0.985, 0.7), position=(1.0, 2.0, 0.3), rotation=TILT),
    EllipticCylinder((1.2, 0.7), 2.0, position=(1.0, 2.0, 0.3), rotation=TILT),
    Box((0.5, 1.0, 1.5), position=(1.0, 2.0, 0.3), rotation=TILT),
    BulgedTube(1.68, 0.45, 6.0, 4.83, position=(1.0, 2.0, 0.3), rotation=TILT),
    NarrowedTube(1.49, 0.45, 6.0, 4.83, position=(1.0, 2.0, 0.3), rotation=TILT),
    BulgedTube(1.0, 1.2, 6.0, 2.0),
    NarrowedTube(1.0, 1.2, 6.0, 2.0),
]


def nested() -> Scene:
    return Scene(
        [
            Body("outer", EllipticCylinder(20.0), "pericoronary_fat"),
            Body(
                "ball",
                Ellipsoid((6.0, 5.0, 4.0), position=(3.0, 0.0, 0.0), rotation=0.3),
                "water",
                "outer",
            ),
            Body("core", Ellipsoid(1.5, position=(4.0, 1.0, 0.5)), "necrotic_core", "ball"),
            Body("box", Box(2.0, position=(-8.0, 0.0, 0.0)), "cortical_bone", "outer"),
        ]
    )


def volume(shape):
    """In mm³, by a formula or from the sections."""
    if isinstance(shape, Ellipsoid):
        return 4 / 3 * math.pi * math.prod(shape.semi_axes)
    if isinstance(shape, Box):
        return 8 * math.prod(shape.half_lengths)
    if isinstance(shape, EllipticCylinder):
        return 2 * math.pi * math.prod(shape.semi_axes) * shape.half_length
    heights = np.linspace(-shape.half_length, shape.half_length, 2001)
    _, a, b = shape.section(heights)
    return float(np.trapezoid(math.pi * a * b, heights))


@pytest.mark.parametrize("shape", SHAPES, ids=lambda s: type(s).__name__)
def test_shape_is_consistent(shape):
    """Surface points have level 1 and fill the bounding box, and so do random points inside
    their volume."""
    surface = shape.surface_points(20000)
    level = shape.level(surface)
    assert level.max() <= 1.0 + 1e-9  # caps hold inner points of the end sections, too
    assert np.median(np.abs(level - 1.0)) < 1e-12
    low, high = shape.bounding_box
    assert (surface >= low - 1e-9).all()
    assert (surface <= high + 1e-9).all()
    rng = np.random.default_rng(0)
    points = rng.uniform(low, high, (200_000, 3))
    inside = shape.contains(points)
    box = math.prod(high - low)
    assert inside.mean() * box == pytest.approx(
        volume(shape), abs=4 * box * math.sqrt(0.25 / len(points))
    )
    assert not shape.contains(high + 0.1)
    np.testing.assert_allclose(shape.to_local(shape.to_scanner(points[:9])), points[:9], atol=1e-12)


def test_bounding_box_is_tight_for_an_ellipsoid():
    shape = SHAPES[0]
    surface = shape.surface_points(200_000)
    np.testing.assert_allclose(surface.min(0), shape.bounding_box[0], atol=1e-3)
    np.testing.assert_allclose(surface.max(0), shape.bounding_box[1], atol=1e-3)


def test_infinite_shapes():
    endless = EllipticCylinder(3.0)
    assert endless.bounding_box.tolist() == [[-3.0, -3.0, -math.inf], [3.0, 3.0, math.inf]]
    assert BulgedTube(1.0, 0.2, 3.0).bounding_box[1].tolist() == [1.4, 1.0, math.inf]
    lying = EllipticCylinder(3.0, rotation=rotation_matrix((0.0, 1.0, 0.0), math.pi / 2))
    assert lying.bounding_box[1] == pytest.approx([math.inf, 3.0, 3.0])


def test_rotational_symmetry_is_recognised():
    upright = rotation_matrix((1.0, 0.0, 0.0), math.pi)
    for shape in (
        EllipticCylinder(3.0),
        EllipticCylinder(3.0, 2.0, position=(0, 0, 5.0), rotation=upright),
        Ellipsoid(2.0, rotation=TILT),
        Ellipsoid((2.0, 2.0, 1.0), rotation=0.7),
        BulgedTube(1.0, 0.0, 3.0),
        NarrowedTube(1.0, 0.0, 3.0),
    ):
        assert shape.rotationally_symmetric, shape
    for shape in (
        EllipticCylinder(3.0, position=(1.0, 0, 0)),
        EllipticCylinder((3.0, 3.1)),
        EllipticCylinder(3.0, rotation=TILT),
        Ellipsoid((2.0, 2.1, 1.0)),
        Ellipsoid((2.0, 2.0, 1.0), rotation=TILT),
        BulgedTube(1.0, 0.1, 3.0),
        Box(1.0),
    ):
        assert not shape.rotationally_symmetric, shape


test_bad_input_is_named = refusals(
    (r"semi_axes\[0\] must be greater than 0", lambda: Ellipsoid(0.0)),
    ("semi_axes must be 3 numbers", lambda: Ellipsoid((1.0, 2.0))),
    (r"position\[1\] must be finite", lambda: Ellipsoid(1.0, position=(0.0, math.nan, 0.0))),
    ("proper rotation", lambda: Ellipsoid(1.0, rotation=2 * np.eye(3))),
    ("proper rotation", lambda: Ellipsoid(1.0, rotation=-np.eye(3))),
    ("3 × 3", lambda: Ellipsoid(1.0, rotation=np.eye(2))),
    ("must be a number", lambda: Ellipsoid("a")),
    ("half_length must be greater", lambda: EllipticCylinder(1.0, -1.0)),
    ("amplitude must be at least 0 mm", lambda: BulgedTube(1.0, -0.1, 3.0)),
    ("axis must be 3 finite", lambda: rotation_matrix((0, 0, 0), 1.0)),
    ("shape", lambda: Box(1.0).level(np.zeros(2))),
    ("amplitude must be at least 0 mm", lambda: SinusoidalMotion("a", -1.0)),
    ("rate_bpm must be greater", lambda: SinusoidalMotion("a", 1.0, rate_bpm=0.0)),
    ("name of a body", lambda: SinusoidalMotion(3, 1.0)),
    ("at least one body", lambda: Scene([])),
    (r"bodies\[0\] must be a Body", lambda: Scene([Box(1.0)])),
    ("shape must be a Shape", lambda: Body("a", "box", "water")),
    ("used twice", lambda: Scene([Body("a", Box(1.0), "water")] * 2)),
    ("parents before their children", lambda: Scene([Body("a", Box(1.0), "water", "b")])),
    ("no body 'b'", lambda: Scene([Body("a", Box(1.0), "water")], SinusoidalMotion("b", 1.0))),
    ("unknown material 'wader'", lambda: Scene([Body("a", Box(1.0), "wader")]).materials),
    ("Material or its name", lambda: Scene([Body("a", Box(1.0), 3)]).materials),
    ("at least 1", lambda: nested().volume_fractions(VolumeGrid((4, 4), 1.0), 0)),
    ("VolumeGrid", lambda: nested().volume_fractions((4, 4))),
    ("every body once", lambda: nested().render(VolumeGrid((4, 4), 1.0), {"ball": 1.0})),
    ("finite times", lambda: nested().offsets([math.nan])),
    ("energy_kev", lambda: nested().material_map(VolumeGrid((4, 4), 1.0), -5.0)),
)


def test_overlaps_are_refused():
    def inside(shape, *others, motion=None):
        return Scene([outer, *others, Body("new", shape, "air", "outer")], motion)

    outer = Body("outer", EllipticCylinder(10.0), "water")
    ball = Body("ball", Ellipsoid(2.0, position=(7.0, 0, 0)), "air", "outer")
    touching, short = (
        Box(1.0, position=(4.0, 0.0, 0.0)),
        Body("short", EllipticCylinder(5.0, 5.0), "water"),
    )
    Scene([outer, ball])
    assert len(inside(touching, ball)) == 3
    inside(touching, ball, motion=SinusoidalMotion("outer", 50.0))  # all move together
    refused(
        ("'new' leaves its parent 'outer'", lambda: inside(Ellipsoid(2.0, position=(8.1, 0, 0)))),
        ("'new' and 'ball' overlap", lambda: inside(Box(1.0, position=(5.0, 0.0, 0.0)), ball)),
        # one swallows the other
        ("overlap", lambda: inside(Ellipsoid(0.1, position=(7.0, 0, 0)), ball)),
        ("overlap", lambda: inside(ball.shape, ball)),
        (
            "leaves its parent",
            lambda: Scene([short, Body("long", EllipticCylinder(1.0), "air", "short")]),
        ),
        (
            "'ball' leaves its parent 'outer'",
            lambda: Scene([outer, ball], SinusoidalMotion("ball", 1.5)),
        ),
        ("overlap", lambda: inside(touching, ball, motion=SinusoidalMotion("ball", 0.5))),
    )


def test_tree():
    scene = nested()
    assert scene.parents.tolist() == [-1, 0, 1, 0]
    assert scene.inside("ball") == ("ball", "core")
    assert scene.names == ("outer", "ball", "core", "box")
    energies = np.array([40.0, 64.0, 80.0])
    contrast = scene.contrast(energies)
    assert contrast.shape == (4, 3)
    expected = MATERIALS["necrotic_core"].attenuation(energies) - MATERIALS["water"].attenuation(
        energies
    )
    np.testing.assert_allclose(contrast[2], expected, rtol=1e-14)
    np.testing.assert_allclose(
        contrast[0], MATERIALS["pericoronary_fat"].attenuation(energies), rtol=1e-14
    )
    other = scene.replace_material("core", "air")
    assert other.materials[2].name == "air"
    assert scene.materials[2].name == "necrotic_core"
    assert len(scene.add(Body("pin", Box(0.2, position=(4.0, 1.0, 0.5)), "air", "core"))) == 5
    assert scene.bounding_box("core").tolist() == [[2.5, -0.5, -1.0], [5.5, 2.5, 2.0]]
    with pytest.raises(ValueError, match="no body 'x' in the scene"):
        scene.index("x")


def test_line_integral_is_the_sum_over_labels():
    """Chord times contrast, summed over bodies, equals the integral of the labelled materials
    along the ray."""
    scene = nested()
    energy = np.array([60.0])
    mu = np.array([m.attenuation(energy)[0] for m in scene.materials] + [0.0])
    rng = np.random.default_rng(0)
    for _ in range(5):
        o = np.array([-60.0, rng.uniform(-4, 4), rng.uniform(-2, 2)])
        d = np.array([1.0, rng.uniform(-0.1, 0.1), rng.uniform(-0.05, 0.05)])
        d /= np.linalg.norm(d)
        t = np.arange(0.0, 120.0, 1e-3) + 5e-4
        sampled = mu[scene.labels(o + t[:, None] * d)].sum() * 1e-3
        exact = (chord_lengths(scene, o, d)[:, 0] * scene.contrast(energy)[:, 0]).sum()
        assert exact == pytest.approx(sampled, abs=3e-3 * mu.max())


def test_motion():
    scene = nested().with_motion(SinusoidalMotion("ball", 2.0, direction=math.pi / 2))
    assert not scene.is_static
    assert scene.moving.tolist() == [False, True, True, False]
    offsets = scene.offsets([0.0, 0.25, 0.35, 0.5, 0.75])
    assert offsets.shape == (4, 5, 3)
    wave = 2.0 * np.sin(2 * math.pi * np.array([0.0, 0.25, 0.35, 0.5, 0.75]))
    np.testing.assert_allclose(offsets[1, :, 1], wave, atol=1e-15)
    np.testing.assert_allclose(offsets[2], offsets[1])
    assert not offsets[[0, 3]].any()
    assert np.abs(offsets[:, :, [0, 2]]).max() < 1e-15
    # The paper's range: one rotation of 0.35 s covers [0, A].
    along = SinusoidalMotion("ball", 2.0).displacement(np.linspace(0.0, 0.35, 1000))[:, 0]
    assert along.min() == 0.0
    assert along.max() == pytest.approx(2.0, abs=1e-4)
    assert SinusoidalMotion("ball", 2.0).scaled(0.2).amplitude == pytest.approx(0.4)
    still = nested().with_motion(SinusoidalMotion("ball", 0.0))
    assert still.is_static
    assert not still.moving.any()
    np.testing.assert_allclose(
        scene.bounding_box("core"), [[2.5, -2.5, -1.0], [5.5, 4.5, 2.0]], atol=1e-12
    )


def test_motions_add():
    moves = [
        SinusoidalMotion("ball", 1.0),
        SinusoidalMotion("core", 0.5, rate_bpm=120.0, direction=math.pi / 2),
    ]
    scene = nested().with_motion(moves)
    t = np.array([0.1, 0.2])
    offsets = scene.offsets(t)
    np.testing.assert_allclose(offsets[2], moves[0].displacement(t) + moves[1].displacement(t))
    np.testing.assert_allclose(offsets[1], moves[0].displacement(t))


def test_labels():
    scene = nested()
    points = [
        (4.0, 1.0, 0.5),
        (3.0, -3.0, 0.0),
        (-8.0, 1.9, 0.0),
        (0.0, 15.0, 99.0),
        (0.0, 21.0, 0.0),
    ]
    assert scene.labels(points).tolist() == [2, 1, 3, 0, -1]
    grid = VolumeGrid((3, 5, 7), (1.0, 2.0, 3.0), (0.5, -1.0, 2.0))
    labels = scene.labels(grid)
    z, y, x = grid.axes
    assert labels.shape == grid.shape
    assert labels[2, 1, 5] == scene.labels((x[5], y[1], z[2]))
    assert scene.labels(grid.slice).shape == (5, 7)


def test_volume_fractions():
    scene = nested()
    grid = VolumeGrid((24, 90, 90), 0.5)
    fractions = scene.volume_fractions(grid, 4)
    assert fractions.min() >= 0.0
    assert fractions.max() <= 1.0
    volumes = fractions.sum(axis=(1, 2, 3)) * 0.5**3
    ball, core, box = (volume(scene.shapes[k]) for k in (1, 2, 3))
    assert volumes[1:] == pytest.approx([ball - core, core, box], rel=3e-4)
    assert volumes[0] == pytest.approx(math.pi * 20.0**2 * 12.0 - ball - box, rel=1e-4)
    # Voxels whose label is the same at a fine scale are filled by that body alone.
    core_voxel = tuple(
        round(v) for v in ((0.5 + 5.75) / 0.5, (1.0 + 22.25) / 0.5, (4.0 + 22.25) / 0.5)
    )
    assert fractions[(2, *core_voxel)] == pytest.approx(1.0)
    # Against brute force on a few voxel rows.
    fine = VolumeGrid((24, 90 * 1, 90), 0.5)
    sub = (np.arange(8) + 0.5) / 8 - 0.5
    z, y, x = fine.axes
    k, j = 13, 46
    zz, yy, xx = np.meshgrid(
        z[k] + 0.5 * sub, y[j] + 0.5 * sub, (x[:, None] + 0.5 * sub).ravel(), indexing="ij"
    )
    labels = scene.labels(np.stack([xx, yy, zz], axis=-1)).reshape(8, 8, 90, 8)
    for body in range(4):
        np.testing.assert_allclose(
            fractions[body, k, j], (labels == body).mean(axis=(0, 1, 3)), atol=0.05
        )


def test_volume_fractions_converge_and_2d_is_the_middle_plane():
    disc = water_cylinder(10.0)
    grid = VolumeGrid((30, 30), 0.5)
    errors = [abs(disc.volume_fractions(grid, n).sum() * 0.25 - math.pi * 25.0) for n in (2, 32)]
    assert errors[1] < min(2e-3, errors[0])
    solid = disc.volume_fractions(VolumeGrid((1, 30, 30), 0.5), 6)
    np.testing.assert_allclose(solid[:, 0], disc.volume_fractions(grid, 36), atol=1e-12)


def test_render():
    scene = nested()
    grid = VolumeGrid((1, 90, 90), 0.5)
    image = scene.render(
        grid, {"outer": -100.0, "ball": 0.0, "core": 40.0, "box": 1000.0}, outside=-1000.0
    )
    assert image.shape == grid.shape
    assert (image.min(), image.max()) == pytest.approx((-1000.0, 1000.0))
    mu = scene.material_map(grid, 60.0)
    assert mu.max() == pytest.approx(float(MATERIALS["cortical_bone"].attenuation(60.0)), rel=1e-9)
    assert mu[0, 0, 0] == 0.0


def test_ctdi():
    scene = ctdi()
    assert scene.names == ("phantom", *CTDI_HOLES)
    assert [m.name for m in scene.materials[:2]] == ["pmma", "water"]
    assert [s.position for s in scene.shapes[2:4]] == [
        (150.0, 0.0, 0.0),
        pytest.approx((0.0, 150.0, 0.0)),
    ]
    lengths = chord_lengths(scene, (-626.0, 0.0, 0.0), (1.0, 0.0, 0.0))[:, 0]
    assert lengths == pytest.approx([320.0, 13.0, 13.0, 0.0, 13.0, 0.0], abs=1e-9)
