"""The detector study at small scale."""

import pytest

from recon.study.detector import measure as study


def test_the_study_at_small_scale(tmp_path):
    report = study.run(study.Settings(photons=3000, dead_times_ns=(50.0,), charge_sharing=(0.1,)))
    report.save(tmp_path)
    assert (tmp_path / "detector.png").read_bytes().startswith(b"\x89PNG")
    checks = {c["name"]: c for c in report.data["checks"]}
    assert checks["counted / incident behind 24 cm fat"]["ok"]
    assert checks["pile-up behind the body, calibrated, HU"]["ok"]
    first = report.data["efficiency"][0]["rows"][0]
    # Repeated counts cost efficiency, but not all that separates 60 mm from the published value.
    assert 0.72 < first["dqe"] < first["one_interaction"] - 0.03
    entry = report.data["pile_up"][0]
    assert entry["air"]["lost_percent"] > 40 > 2 > entry["body"]["lost_percent"] > 0.5
    assert abs(entry["uncorrected_body_hu"]) > 100
    assert "## Charge sharing" in report.text


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"photons": 10}, "photons"),
        ({"dead_times_ns": ()}, "dead_times"),
        ({"charge_sharing": (0.0,)}, "charge_sharing"),
        ({"seed": -1}, "seed"),
    ],
)
def test_bad_settings(change, match):
    with pytest.raises(ValueError, match=match):
        study.Settings(**change)
