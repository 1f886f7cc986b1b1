"""What the model lacks: texture is measured, a calcification becomes a body, a foreign body is
warned of."""

from copy import copy
from dataclasses import replace
from types import SimpleNamespace

import drawn_vessel
import numpy as np
import pytest
import torch
from scipy import ndimage

from recon.vessel import read_plaque, reading
from recon.vessel.data import grid_of, pilot
from recon.vessel.data import scores as scores_in
from recon.vessel.model import VesselModel
from recon.vessel.quality import LENGTH_MM, PRIOR_VARIANCE_HU2, STRIKING, Leftover, misfit, texture
from recon.vessel.report import save, table
from recon.vessel.start import find_vessel
from torchpcct.volume import Volume


def fitted(gram, volume, seed):
    data = drawn_vessel.data(gram, volume, seed)
    vessel = VesselModel(data, find_vessel(pilot(data), grid_of(data), None))
    fit = vessel.fit(vessel.first_guess())
    body = np.zeros((1, len(vessel.index)))
    return vessel, vessel.fit(np.append(fit.parameters, 0.0), body)


def test_texture_is_told_from_none(gram):
    plain = drawn_vessel.image(gram.finer, 0.0, samples=3)
    rough = np.random.default_rng(0).standard_normal(gram.finer.shape)
    rough = ndimage.gaussian_filter(rough, LENGTH_MM / np.sqrt(2) / 0.15, mode="constant")
    rough *= 60.0 / rough.std()
    soft = (plain > -20) & (plain < 250)
    rng = np.random.default_rng(0)
    fits = [fitted(gram, v, 4) for v in (plain, plain + torch.from_numpy(rough).float() * soft)]
    smooth, textured = (texture(*f, rng) for f in fits)
    assert textured.sd_hu > 2 * smooth.sd_hu
    assert textured.sd_hu > 25
    assert smooth.high_hu < 25
    assert textured.sd_of("contrast") >= 0
    # Data that say next to nothing leave the prior: the variance's mean, and its 95 % limit, ln 20
    # times as much.
    vessel, fit = copy(fits[0][0]), fits[0][1]
    whole = vessel.gram
    vessel.gram = SimpleNamespace(apply=lambda v: 1e-6 * whole.apply(v))
    faint = SimpleNamespace(
        drawing=fit.drawing,
        bodies=fit.bodies,
        parameters=fit.parameters,
        covariance=fit.covariance,
        curved=1e-6 * fit.curved,
        residual=1e-3 * fit.residual,
    )
    unknown = texture(vessel, faint, rng)
    assert unknown.sd_hu**2 == pytest.approx(PRIOR_VARIANCE_HU2, rel=0.02)
    assert unknown.high_hu**2 == pytest.approx(3.0 * PRIOR_VARIANCE_HU2, rel=0.02)


def test_a_calcification_becomes_a_body_and_not_a_core(gram, tmp_path):
    found = read_plaque(
        drawn_vessel.data(gram, drawn_vessel.image(gram.finer, 0.0, 3, 1200.0), 5), particles=150
    )
    assert found.calcifications >= 1  # a coarse grid may make two bodies of it
    assert abs(found.chi2 - 1) < 4 * found.chi2_sd
    assert found.presence < 0.95
    assert found.figures["calcification 1"].value > 400
    at = np.argwhere(found.regions["calcification"] > 0.3).mean(0)
    place = np.array([a[0] for a in gram.grid.axes]) - gram.grid.center + at * 0.3
    # The vessel tilts: 1 mm along it moves its axis by about the tilt in y.
    y = drawn_vessel.TILT - drawn_vessel.HARD_AT[1]
    assert np.linalg.norm(place - (1.0, y, drawn_vessel.HARD_AT[0])) < 0.5
    save(found, tmp_path / "sound")
    save(replace(found, taken_off_hu=300.0), tmp_path / "beside")
    labels = [Volume.load(tmp_path / name / "tissues.nii.gz").data for name in ("sound", "beside")]
    assert (labels[0] == 5).any()
    assert not (labels[1] > 3).any()  # what stands in for a neighbour is drawn as no plaque body


def test_what_the_model_does_not_have_is_warned_of(gram):
    volume = drawn_vessel.image(gram.finer, 0.0, samples=3)
    right = misfit(*fitted(gram, volume, 6))
    volume[24:30, 32:38, 22:28] += 600.0  # metal at the outer wall
    wrong = misfit(*fitted(gram, volume, 6))
    assert abs(right[0] - 1) < 4 * right[1]
    assert wrong[0] - 1 > 4 * wrong[1]


def tube(grid, at, radius):
    """``grid.shape`` share of a tube along z through (y, x) mm about the grid's centre."""
    _, y, x = np.meshgrid(
        *(a - c for a, c in zip(grid.axes, grid.center, strict=True)), indexing="ij", sparse=True
    )
    edge = (radius - np.hypot(y - at[0], x - at[1])) / grid.spacing[0]
    return torch.from_numpy(np.clip(edge + 0.5, 0.0, 1.0) + np.zeros(grid.shape)).float()


def with_tube(gram, at):
    """A vessel without a core, and a second one along z."""
    volume = drawn_vessel.image(gram.finer, 0.0, samples=3)
    for radius, hu in ((0.9, 140.0), (0.7, 350.0)):
        volume = volume + hu * tube(gram.finer, at, radius)
    return volume


@pytest.fixture(scope="module")
def both(gram):
    """A second vessel in the corner of the inset."""
    return read_plaque(drawn_vessel.data(gram, with_tube(gram, (2.6, -2.6)), 7), particles=60)


def test_a_second_vessel_apart_is_taken_off_the_data(both):
    assert both.explained
    assert both.warnings == []
    assert both.calcifications == 0
    assert both.taken_off_hu > 300.0
    assert not both.certain
    assert set(both.figures).isdisjoint(both.given_core)
    assert "stands beside the vessel" in both.refused["contrast"]
    assert "were taken off the data" in table(both)
    assert both.figures["lumen"].value == pytest.approx(drawn_vessel.VALUES["lumen"], abs=10)


@pytest.mark.extended
def test_beside_a_second_vessel_that_is_not_known_nothing_of_a_plaque_is_claimed(gram, monkeypatch):
    """The fit takes what it sees of it for plaque bodies."""
    monkeypatch.setattr(reading, "_ROUNDS", 0)
    at = (0.0, 3.4)
    found = read_plaque(drawn_vessel.data(gram, with_tube(gram, at), 7), particles=60)
    assert found.left.score > STRIKING
    assert found.left.beside
    assert np.hypot(*(np.array(found.left.at_mm[1:]) - gram.grid.center[1:] - at)) < 1.2
    assert "beside the vessel" in found.warnings[0]
    assert set(found.figures).isdisjoint(found.given_core)
    assert set(found.refused) == set(found.given_core)
    assert "none can be identified" in table(found)


def test_noise_alone_is_not_striking_anywhere_in_the_volume(gram):
    data = drawn_vessel.data(gram, torch.zeros(gram.finer.shape))
    scores = np.array(
        [
            scores_in(
                data,
                gram.noise(generator=torch.Generator().manual_seed(k)) * drawn_vessel.HU,
                (0.4, 1.2),
            )
            for k in range(20)
        ]
    )
    assert np.abs(scores).max() < STRIKING
    assert scores.std() == pytest.approx(1.0, abs=0.15)
    assert scores[:, [0, -1]].std() < 1.4


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"lumen": 40.0}, "only with contrast agent"),
        ({"lumen": 150.0}, "only with contrast agent"),
        ("stent", "no vessel that can be read"),
        ("rings", "no direction, or is shorter than 5 mm. Rings of metal"),
        ("short", "no direction, or is shorter"),
    ],
)
def test_what_is_no_enhanced_vessel_is_refused_in_words(gram, change, why):
    """A stent was refused by SciPy's own words, a short bright piece by a division by zero."""
    volume = drawn_vessel.image(
        gram.finer, 0.0, samples=2, **(change if isinstance(change, dict) else {})
    )
    off = torch.arange(len(volume))[:, None, None] / 2 - (len(volume) - 1) / 4
    inside = tube(gram.finer, (0.0, drawn_vessel.LUMEN_OFF), 1.1)
    shell = inside - tube(gram.finer, (0.0, drawn_vessel.LUMEN_OFF), 0.9)
    if change == "stent":
        volume = volume + 9000.0 * shell * (off.abs() < 10)
    elif change == "rings":
        volume = volume + 25000.0 * shell * ((off.abs() % 5 - 2.5).abs() < 0.5)
    elif change == "short":
        volume = torch.where((off.abs() > 4) & (volume > 100.0), 100.0, volume)
    with pytest.raises(ValueError, match=why):
        read_plaque(drawn_vessel.data(gram, volume, 8), particles=60)


@pytest.mark.extended
def test_a_second_core_is_read_beside_the_first(gram, tmp_path):
    point = (
        gram.grid.center[0] - 1.5,
        gram.grid.center[1] - 1.5 * drawn_vessel.TILT,
        gram.grid.center[2] + 1.15,
    )
    two, one = (
        read_plaque(
            drawn_vessel.data(gram, drawn_vessel.image(gram.finer, 200.0, 3, cores=cores), 9),
            point,
            particles=60,
        )
        for cores in ((-1.5, 1.5), (-1.5,))
    )
    assert [r.presence > 0.95 for r in (two, one)] == [True, True]
    assert two.second_core > 0.95 > 0.7 > one.second_core
    assert two.warnings == one.warnings == []
    assert one.info["second_core"] is None
    other = two.info["second_core"]
    assert (
        np.linalg.norm(np.array(other["at_mm"]) - point - (3.0, 3.0 * drawn_vessel.TILT, 0.0)) < 0.6
    )
    assert other["volume_mm3"] == pytest.approx(1.05, rel=0.6)
    for name in ("contrast", "second contrast"):
        assert abs(two.figures[name].value - 200.0) < 3.5 * two.figures[name].sd
        assert two.figures[name].value > 120.0
    assert "Both were read together" in table(two)
    save(two, tmp_path)
    labels = Volume.load(tmp_path / "tissues.nii.gz").data
    assert (labels == 4).any()
    assert (labels == 6).any()
    more = replace(two, third_core={**other, "probability": 0.97})
    assert "one more core is there with a probability of 0.97, at (1." in more.warnings[0]
    assert two.mean_contrast == pytest.approx(two.presence * two.given_core["contrast"].value)
    foreign = replace(two, left=Leftover(9.0, 50.0, (0.0, 1.0, 2.0), False))
    assert not foreign.certain
    assert "in the vessel, at (0.0, 1.0, 2.0) mm" in foreign.warnings[0]
