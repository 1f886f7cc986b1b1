"""What the model lacks: texture is measured, a calcification becomes a body, a foreign body is warned of."""

import drawn_vessel
import numpy as np
import pytest
import torch
from scipy import ndimage

from recon.plaque import read_plaque
from recon.plaque.quality import LENGTH_MM, misfit, texture
from recon.plaque.start import find_vessel
from recon.plaque.vessel import Vessel


@pytest.fixture(scope="module")
def gram():
    return drawn_vessel.operator()


def fitted(gram, volume, seed):
    data = drawn_vessel.data(gram, volume, seed)
    vessel = Vessel(data, find_vessel(data.pilot(), data.grid, None))
    fit = vessel.fit(vessel.first_guess())
    body = np.zeros((1, len(vessel.index)))
    return vessel, vessel.fit(np.append(fit.parameters, 0.0), body)


def test_texture_is_told_from_none(gram):
    plain = drawn_vessel.image(gram.grid, 0.0, samples=3)
    rough = np.random.default_rng(0).standard_normal(gram.grid.shape)
    rough = ndimage.gaussian_filter(rough, LENGTH_MM / np.sqrt(2) / 0.3, mode="constant")
    rough *= 60.0 / rough.std()
    soft = (plain > -20) & (plain < 250)
    rng = np.random.default_rng(0)
    smooth, textured = (
        texture(*fitted(gram, v, 4), rng) for v in (plain, plain + torch.from_numpy(rough).float() * soft)
    )
    assert textured.sd_hu > 2 * smooth.sd_hu
    assert textured.sd_hu > 25
    assert smooth.high_hu < 25
    assert textured.sd_of("contrast") >= 0


def test_a_calcification_becomes_a_body_and_not_a_core(gram):
    reading = read_plaque(drawn_vessel.data(gram, drawn_vessel.image(gram.grid, 0.0, 3, 1200.0), 5), particles=150)
    assert reading.calcifications >= 1  # a coarse grid may make two bodies of it
    assert abs(reading.chi2 - 1) < 4 * reading.chi2_sd
    assert reading.presence < 0.95
    assert reading.figures["calcification 1"].value > 400
    at = np.argwhere(reading.regions["calcification"] > 0.3).mean(0)
    place = np.array([a[0] for a in gram.grid.axes]) - gram.grid.center + at * 0.3
    # The vessel tilts: 1 mm along it moves its axis by about the tilt in y.
    y = drawn_vessel.TILT - drawn_vessel.HARD_AT[1]
    assert np.linalg.norm(place - (1.0, y, drawn_vessel.HARD_AT[0])) < 0.5


def test_what_the_model_does_not_have_is_warned_of(gram):
    volume = drawn_vessel.image(gram.grid, 0.0, samples=3)
    right = misfit(*fitted(gram, volume, 6))
    volume[12:15, 16:19, 11:14] += 600.0  # metal at the outer wall
    wrong = misfit(*fitted(gram, volume, 6))
    assert abs(right[0] - 1) < 4 * right[1]
    assert wrong[0] - 1 > 4 * wrong[1]
