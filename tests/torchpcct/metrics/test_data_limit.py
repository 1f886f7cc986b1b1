"""The limit of the data against dense linear algebra, simulated least squares and closed forms."""

import math
import sys

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchpcct import ConeBeam, full_turn
from torchpcct.acquisition.path_lengths import tissue_path_lengths
from torchpcct.detector_window import DetectorWindow
from torchpcct.metrics import ceiling, information_matrix, paper_cnr_ceiling
from torchpcct.scene import Body, Ellipsoid, EllipticCylinder, Scene, SinusoidalMotion
from torchpcct.scene.plaque import plaque_scene


def system(seed, tissues=4, shape=(3, 5, 7)):
    rng = np.random.default_rng(seed)
    return rng.uniform(0, 2, (tissues, *shape)), rng.uniform(0.1, 3, shape)


@pytest.mark.parametrize("kind", ["stack", "list", "tensors", "float32"])
def test_information_against_dense_algebra(kind, monkeypatch):
    # The package's attribute of that name is the function.
    monkeypatch.setattr(sys.modules["torchpcct.metrics.data_limit"], "_CHUNK", 16)
    maps, weight = system(0)
    a = maps.reshape(4, -1).T
    expected = 0.02**2 * a.T @ np.diag(weight.ravel()) @ a
    given_maps = {
        "stack": maps,
        "list": list(maps),
        "tensors": torch.from_numpy(maps).unbind(),
        "float32": maps.astype(np.float32),
    }[kind]
    f = information_matrix(given_maps, weight, scale=0.02)
    assert f.dtype == np.float64
    np.testing.assert_allclose(f, expected, rtol=1e-6 if kind == "float32" else 1e-13)


def test_limit_is_the_pseudo_inverse_of_the_weighted_system():
    maps, weight = system(1)
    root = np.sqrt(weight.ravel())[:, None] * maps.reshape(4, -1).T
    estimator = np.linalg.pinv(root)  # its rows are the least-squares weights of unit-variance readings
    h = np.array([[1, -1, 0, 0], [0, 0.3, 0.7, 0]])
    limit = ceiling(information_matrix(maps, weight), h)
    np.testing.assert_allclose(limit.covariance, estimator @ estimator.T, rtol=1e-10, atol=1e-14)
    np.testing.assert_allclose(limit.functional_sd, np.linalg.norm(h @ estimator, axis=1), rtol=1e-10)
    np.testing.assert_allclose(limit.amplitude_sd, np.linalg.norm(estimator, axis=1), rtol=1e-10)
    assert ceiling(information_matrix(maps, weight), h[0]).contrast_sd == pytest.approx(limit.functional_sd[0])
    with pytest.raises(ValueError, match="functional_sd"):
        _ = limit.contrast_sd


def test_limit_is_reached_by_simulated_least_squares():
    maps, weight = system(2, tissues=3)
    a, w = maps.reshape(3, -1).T, weight.ravel()
    f = information_matrix(maps, weight)
    rng = np.random.default_rng(3)
    c = np.array([40.0, 100.0, 500.0])
    y = a @ c + rng.standard_normal((4000, w.size)) / np.sqrt(w)
    estimates = np.linalg.solve(f, (a.T * w) @ y.T)
    limit = ceiling(f, [-1, 1, 0])
    contrast = estimates[1] - estimates[0]
    assert contrast.std() == pytest.approx(limit.contrast_sd, rel=0.05)
    assert contrast.mean() == pytest.approx(60, abs=5 * limit.contrast_sd / math.sqrt(4000))
    figure = (estimates[1].mean() - estimates[0].mean()) / math.sqrt(estimates[0].var() + estimates[1].var())
    assert paper_cnr_ceiling(f, c, 0, 1) == pytest.approx(figure, rel=0.05)


@settings(max_examples=30, deadline=None)
@given(st.floats(0.01, 100), st.integers(0, 1000))
def test_scaling_with_dose_and_more_unknowns(dose, seed):
    maps, weight = system(seed)
    f = information_matrix(maps, weight)
    h = [1, -1, 0, 0]
    assert ceiling(f, h, dose).contrast_sd == pytest.approx(ceiling(f, h).contrast_sd / math.sqrt(dose))
    assert ceiling(f * dose, h).contrast_sd == pytest.approx(ceiling(f, h, dose).contrast_sd)
    # An amplitude taken as known never hurts.
    assert ceiling(f[:3, :3], h[:3]).contrast_sd <= ceiling(f, h).contrast_sd * (1 + 1e-12)
    amplitudes = [40, 100, 60, 500]
    assert paper_cnr_ceiling(f, amplitudes, 0, 1, dose) == pytest.approx(
        math.sqrt(dose) * paper_cnr_ceiling(f, amplitudes, [1, 0, 0, 0], [0, 1.0, 0, 0])
    )


def test_tissues_of_different_size_keep_their_digits():
    maps, weight = system(4)
    f = information_matrix(maps, weight)
    units = np.array([1e-6, 1.0, 1e5, 1e3])
    scaled = ceiling(f * units[:, None] * units, np.eye(4))
    np.testing.assert_allclose(scaled.amplitude_sd * units, ceiling(f, np.eye(4)).amplitude_sd, rtol=1e-9)


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda f, m, w: information_matrix([], w), "empty"),
        (lambda f, m, w: information_matrix(m, w[:2]), "same detector window"),
        (lambda f, m, w: information_matrix(m, -w), "negative"),
        (lambda f, m, w: information_matrix(m, w * np.nan), "NaN"),
        (lambda f, m, w: information_matrix(m, w, scale=0), "scale"),
        (lambda f, m, w: information_matrix([m[0], m[0] * 0], w) is ceiling(np.diag([1.0, 0]), [1, 0]), "tissue 1"),
        (lambda f, m, w: ceiling(information_matrix([m[0], 2 * m[0]], w), [1, 0]), "tell the tissues apart"),
        (lambda f, m, w: ceiling(f[:2], [1, 0]), "square"),
        (lambda f, m, w: ceiling(f + np.triu(f, 1), [1, 0, 0, 0]), "symmetric"),
        (lambda f, m, w: ceiling(f, [1, 0]), "functionals"),
        (lambda f, m, w: ceiling(f, [1, 0, 0, 0], dose=0), "dose"),
        (lambda f, m, w: paper_cnr_ceiling(f, [1, 2], 0, 1), "amplitudes"),
        (lambda f, m, w: paper_cnr_ceiling(f, [1, 2, 3, 4], 0, 4), "background"),
        (lambda f, m, w: paper_cnr_ceiling(f, [1, 2, 3, 4], [1.0], 1), "foreground"),
    ],
)
def test_refusals(call, match):
    maps, weight = system(5)
    with pytest.raises(ValueError, match=match):
        call(information_matrix(maps, weight), maps, weight)


# Path lengths of the tissues.


GEOMETRY = ConeBeam(full_turn(5, 0.3), 60.0, 110.0, 14, 6, (1.7, 2.5), (0.6, -0.625), "curved")
SCENE = Scene(
    [
        Body("patient", EllipticCylinder((15.0, 15.0), math.inf), "pericoronary_fat"),
        Body("ball", Ellipsoid((6.0, 6.0, 6.0), position=(2.0, 1.0, 0.5)), "fibrous_tissue", "patient"),
        Body("core", Ellipsoid((3.0, 3.0, 3.0), position=(2.5, 1.0, 0.0)), "necrotic_core", "ball"),
    ]
)


def ball_chord(center, radius, origin, direction):
    """Chord of a ball by its distance from the line."""
    offset = np.asarray(center) - origin
    d2 = np.square(offset).sum(-1) - np.square((offset * direction).sum(-1))
    return 2 * np.sqrt(np.maximum(radius**2 - d2, 0))


@pytest.mark.parametrize("detector", ["flat", "curved"])
def test_path_lengths_of_single_rays(detector):
    g = ConeBeam(GEOMETRY.angles, 60.0, 110.0, 14, 6, (1.7, 2.5), (0.6, -0.625), detector)
    window = DetectorWindow([2, 0, 3, 1, 4], 9, 1, 4)
    lengths = tissue_path_lengths(SCENE, ["ball", "core"], g, window, sub_rays=1, dtype=torch.float64)
    assert lengths.shape == (2, 5, 4, 9)
    for view in range(5):
        beta = g.angles[view]
        radial, across = np.array([np.cos(beta), np.sin(beta), 0]), np.array([-np.sin(beta), np.cos(beta), 0])
        for row in range(4):
            for column in range(9):
                u = g.column_positions[window.first_column[view] + column]
                a, b = (np.cos(u / 110), 110 * np.sin(u / 110)) if detector == "curved" else (1.0, u)
                line = -110 * a * radial + b * across + np.array([0, 0, g.row_positions[1 + row]])
                line /= np.linalg.norm(line)
                ball, core = (
                    ball_chord(c, r, 60 * radial, line) for c, r in (((2.0, 1.0, 0.5), 6.0), ((2.5, 1.0, 0.0), 3.0))
                )
                np.testing.assert_allclose(lengths[:, view, row, column], [ball - core, core], atol=1e-9)


def test_path_lengths_add_up_and_average_over_the_beam():
    scene, _ = plaque_scene()
    names = scene.names
    g = ConeBeam(full_turn(2), 626.0, 1098.0, 300, 4, (0.5, 1.5), detector="curved")
    window = DetectorWindow([130, 130], 20, 0, 4)
    tissues = tissue_path_lengths(scene, names, g, window, sub_rays=16, dtype=torch.float64)
    chords = tissue_path_lengths(Scene(scene.bodies[:1]), names[:1], g, window, sub_rays=16, dtype=torch.float64)
    assert (tissues >= -1e-12).all()
    torch.testing.assert_close(tissues.sum(0), chords[0], rtol=1e-12, atol=1e-10)
    joined = tissue_path_lengths(scene, [names[1:3], names[3]], g, window, sub_rays=16, dtype=torch.float64)
    torch.testing.assert_close(joined[0], tissues[1:3].sum(0))
    assert tissue_path_lengths(scene, names[:1], g, window, sub_rays=1).dtype == torch.float32


def test_mass_is_kept_by_every_blur(monkeypatch):
    """The core's path lengths, summed over a fine detector, are its volume in every view, whatever the beam's width."""
    monkeypatch.setattr("torchpcct.acquisition.path_lengths._LINES", 1000)
    g = ConeBeam(full_turn(3, 0.1), 600.0, 900.0, 60, 60, 0.2)
    scene = Scene([Body("ball", Ellipsoid((2.0, 1.5, 1.0)), "fibrous_tissue")])
    for beam in ({"sub_rays": 32}, {"sub_rays": 32, "focal_spot": (0.9, 0.7), "view_step": 0.01}):
        sums = tissue_path_lengths(scene, ["ball"], g, dtype=torch.float64, **beam).sum((0, 2, 3))
        volume = sums * (0.2 / 1.5) ** 2
        np.testing.assert_allclose(volume, 4 / 3 * math.pi * 3, rtol=5e-4)


def test_path_lengths_see_the_beam_of_the_readings():
    """Readings of one energy and a weak contrast are the path lengths times that contrast, finite beam included."""
    from torchpcct.acquisition.bodies import BodySet
    from torchpcct.acquisition.transmission import Beam, expected_readings, sub_rays
    from torchpcct.scene.chords import pack

    g, views = GEOMETRY, GEOMETRY.views
    kinds, params = pack([SCENE["core"].shape])
    mu, zero = 1e-5, np.zeros((1, views, 3))
    bodies = BodySet(kinds, params, np.full((1, 1), mu), zero, zero, (0.0, 0.0, np.inf))
    beam = Beam(np.ones((1, g.columns, 1)), np.ones(g.rows), (0.9, 0.7), sub_rays(32))
    window = DetectorWindow(np.zeros(views, np.int64), g.columns, 0, g.rows)
    readings = expected_readings(g, window, bodies, beam, np.full(views, 0.02))[0]
    lengths = tissue_path_lengths(
        SCENE, ["core"], g, sub_rays=32, focal_spot=(0.9, 0.7), view_step=0.02, dtype=torch.float64
    )
    np.testing.assert_allclose(lengths[0], -np.log(readings.numpy()) / mu, atol=1e-4)


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
