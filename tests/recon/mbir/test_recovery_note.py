"""What MBIR says of small and faint bodies: the measured figures, for the weights, the noise and
the fidelity that they were measured for."""

import json

import pytest

from recon.mbir import recovery_note
from recon.mbir.mbir import Mbir
from recon.study.recovery import mbir_recovery

ROWS = (
    {"noise_scale_hu": 40.0, "diameter_mm": 1.0, "recovered": 0.25, "soft_fbp": 0.69},
    {"noise_scale_hu": 40.0, "diameter_mm": 0.5, "recovered": 0.40, "soft_fbp": 0.42},
    {"noise_scale_hu": 40.0, "diameter_mm": 2.0, "recovered": 0.10, "soft_fbp": 0.80},
    {"noise_scale_hu": 40.0, "diameter_mm": 3.0, "recovered": 0.60, "soft_fbp": 0.80},
    {"noise_scale_hu": 16.0, "diameter_mm": 1.0, "recovered": 0.65, "soft_fbp": 0.69},
)


@pytest.fixture(autouse=True)
def measured(monkeypatch):
    rows = tuple({"fidelity": 0.5, "contrast_hu": 100.0, **row} for row in ROWS)
    monkeypatch.setattr(recovery_note, "_measured", lambda: ("abc", rows))


def test_the_smallest_balls_that_lose_contrast_are_named():
    (text,) = recovery_note.contrast_note("abc", 45.0, 0.5)
    first = text.index("25 % of a ball of 1 mm and +100 HU (soft FBP 69 %)")
    assert first < text.index("10 % of a ball of 2 mm")
    assert "0.5 mm" not in text  # hardly less than by soft FBP
    assert "3 mm" not in text


def test_between_two_noise_scales_the_figures_lie_between(measured):
    (text,) = recovery_note.contrast_note("abc", (16.0 * 40.0) ** 0.5, 0.5)
    assert "45 % of a ball of 1 mm" in text  # the mean of 25 and 65
    assert text.count("a ball") == 1  # the others were measured at more noise only


def test_of_a_size_the_ball_that_loses_most_is_named(monkeypatch):
    row = {"noise_scale_hu": 40.0, "fidelity": 0.5, "diameter_mm": 1.0, "soft_fbp": 0.69}
    rows = (
        {**row, "contrast_hu": 400.0, "recovered": 0.5},
        {**row, "contrast_hu": -100.0, "recovered": 0.2},
        {**row, "contrast_hu": 100.0, "recovered": 0.3},
    )
    monkeypatch.setattr(recovery_note, "_measured", lambda: ("abc", rows))
    (text,) = recovery_note.contrast_note("abc", 40.0, 0.5)
    assert "20 % of a ball of 1 mm and -100 HU" in text
    assert text.count("a ball") == 1


@pytest.mark.parametrize(
    "given",
    [
        ("other weights", 40.0, 0.5),
        ("abc", 80.0, 0.5),
        ("abc", 40.0, 0.7),
        ("abc", 16.0, 0.5),  # nothing is lost there
        ("abc", 1.0, 0.5),
    ],
)
def test_nothing_is_said_of_what_was_not_measured(given):
    assert recovery_note.contrast_note(*given) == []


def test_other_priors_have_no_note():
    assert Mbir(prior="bilateral").notes(40.0) == []


def test_the_study_gives_the_file():
    row = {"diameter_mm": 1.0, "contrast_hu": 100.0, "soft_fbp": 0.7}
    report = {
        "settings": {"exposures_s": [0.35, 2.0]},
        "noise_scale_hu": [39.0, 16.3],
        "weights_sha256": "abc",
        "rows": [
            {**row, "exposure_s": 2.0, "method": "pwls", "recovered": 0.6},
            {**row, "exposure_s": 2.0, "method": "mbir", "recovered": 0.4},
            {**row, "exposure_s": 0.35, "method": "mbir:fidelity=1", "recovered": 0.5},
        ],
    }
    found = json.loads(mbir_recovery(report))
    assert found["weights_sha256"] == "abc"
    assert [
        (r["noise_scale_hu"], r["fidelity"], r["recovered"], r["soft_fbp"]) for r in found["rows"]
    ] == [(16.3, 0.5, 0.4, 0.7), (39.0, 1.0, 0.5, 0.7)]
