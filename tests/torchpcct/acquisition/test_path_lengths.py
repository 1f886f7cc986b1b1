"""Path lengths of the tissues against chords of balls."""

import math

import numpy as np
import pytest
import torch

from torchpcct import ConeBeam, full_turn
from torchpcct.acquisition.path_lengths import tissue_path_lengths
from torchpcct.detector_window import DetectorWindow
from torchpcct.scene import Body, Ellipsoid, EllipticCylinder, Scene, SinusoidalMotion
from torchpcct.scene.plaque import plaque_scene

GEOMETRY = ConeBeam(full_turn(5, 0.3), 60.0, 110.0, 14, 6, (1.7, 2.5), (0.6, -0.625), "curved")
SCENE = Scene(
    [
        Body("patient", EllipticCylinder((15.0, 15.0), math.inf), "pericoronary_fat"),
        Body(
            "ball",
            Ellipsoid((6.0, 6.0, 6.0), position=(2.0, 1.0, 0.5)),
            "fibrous_tissue",
            "patient",
        ),
        Body("core", Ellipsoid((3.0, 3.0, 3.0), position=(2.5, 1.0, 0.0)), "necrotic_core", "ball"),
    ]
)


def ball_chord(center, radius, origin, direction):
    """Chord of a ball by its distance from the line."""
    offset = np.asarray(center) - origin
    d2 = np.square(offset).sum(-1) - np.square((offset * direction).sum(-1))
    return 2 * np.sqrt(np.maximum(radius**2 - d2, 0))


@pytest.mark.parametrize("detector", ["flat", "curved"])
def test_path_lengths_of_single_rays(detector, monkeypatch):
    monkeypatch.setattr("torchpcct.acquisition.path_lengths._VIEWS", 2)
    g = ConeBeam(GEOMETRY.angles, 60.0, 110.0, 14, 6, (1.7, 2.5), (0.6, -0.625), detector)
    window = DetectorWindow([2, 0, 3, 1, 4], 9, 1, 4)
    lengths = tissue_path_lengths(
        SCENE, ["ball", "core"], g, window, sub_rays=1, dtype=torch.float64
    )
    assert lengths.shape == (2, 5, 4, 9)
    for view in range(5):
        beta = g.angles[view]
        radial, across = (
            np.array([np.cos(beta), np.sin(beta), 0]),
            np.array([-np.sin(beta), np.cos(beta), 0]),
        )
        for row in range(4):
            for column in range(9):
                u = g.column_positions[window.first_column[view] + column]
                a, b = (
                    (np.cos(u / 110), 110 * np.sin(u / 110)) if detector == "curved" else (1.0, u)
                )
                line = -110 * a * radial + b * across + np.array([0, 0, g.row_positions[1 + row]])
                line /= np.linalg.norm(line)
                ball, core = (
                    ball_chord(c, r, 60 * radial, line)
                    for c, r in (((2.0, 1.0, 0.5), 6.0), ((2.5, 1.0, 0.0), 3.0))
                )
                np.testing.assert_allclose(
                    lengths[:, view, row, column], [ball - core, core], atol=1e-9
                )


def test_path_lengths_add_up_and_average_over_the_beam():
    scene, _ = plaque_scene()
    names = scene.names
    g = ConeBeam(full_turn(2), 626.0, 1098.0, 300, 4, (0.5, 1.5), detector="curved")
    window = DetectorWindow([130, 130], 20, 0, 4)
    tissues = tissue_path_lengths(scene, names, g, window, sub_rays=16, dtype=torch.float64)
    chords = tissue_path_lengths(
        Scene(scene.bodies[:1]), names[:1], g, window, sub_rays=16, dtype=torch.float64
    )
    assert (tissues >= -1e-12).all()
    torch.testing.assert_close(tissues.sum(0), chords[0], rtol=1e-12, atol=1e-10)
    joined = tissue_path_lengths(
        scene, [names[1:3], names[3]], g, window, sub_rays=16, dtype=torch.float64
    )
    torch.testing.assert_close(joined[0], tissues[1:3].sum(0))
    assert tissue_path_lengths(scene, names[:1], g, window, sub_rays=1).dtype == torch.float32


def test_mass_is_kept_by_every_blur():
    """The core's path lengths, summed over a fine detector, are its volume in every view,
    whatever the beam's width."""
    g = ConeBeam(full_turn(3, 0.1), 600.0, 900.0, 60, 60, 0.2)
    scene = Scene([Body("ball", Ellipsoid((2.0, 1.5, 1.0)), "fibrous_tissue")])
    for beam in ({"sub_rays": 32}, {"sub_rays": 32, "focal_spot": (0.9, 0.7), "view_step": 0.01}):
        sums = tissue_path_lengths(scene, ["ball"], g, dtype=torch.float64, **beam).sum((0, 2, 3))
        volume = sums * (0.2 / 1.5) ** 2
        np.testing.assert_allclose(volume, 4 / 3 * math.pi * 3, rtol=5e-4)


@pytest.mark.parametrize(
    ("names", "change", "match"),
    [
        ([], {}, "non-empty"),
        ("core", {}, "non-empty"),
        (["nothing"], {}, "no body"),
        (["core", ("ball", "core")], {}, "twice"),
        (["core"], {"window": DetectorWindow([0], 3)}, "views"),
        (["core"], {"sub_rays": 3}, "sub-rays"),
    ],
)
def test_path_length_refusals(names, change, match):
    with pytest.raises(ValueError, match=match):
        tissue_path_lengths(SCENE, names, GEOMETRY, **change)


def test_path_lengths_refuse_moving_scenes_and_other_beams():
    moving = SCENE.with_motion(SinusoidalMotion("core", 0.5))
    with pytest.raises(ValueError, match="moves"):
        tissue_path_lengths(moving, ["core"], GEOMETRY)
    with pytest.raises(TypeError, match="ConeBeam"):
        tissue_path_lengths(SCENE, ["core"], GEOMETRY.central_fan)
