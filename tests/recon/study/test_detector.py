"""The detector study at small scale; the physics it uses is tested in tests/torchpcct/scanner."""

import pytest
from tiny_studies import assert_report_is_whole

from recon.study.detector.settings import Settings


def test_report(tiny, tmp_path):
    data = assert_report_is_whole(tiny("detector"), tmp_path, {"detector.png"}, ("## Charge sharing", "## Pile-up"))
    checks = {c["name"]: c for c in data["checks"]}
    assert checks["counted / incident behind 24 cm fat"]["ok"]
    assert checks["pile-up behind the body, calibrated, HU"]["ok"]
    first = data["efficiency"][0]["rows"][0]
    # Repeated counts cost efficiency, but not all that separates 60 mm from the published value.
    assert 0.72 < first["dqe"] < first["one_interaction"] - 0.03
    entry = data["pile_up"][0]
    assert entry["air"]["lost_percent"] > 40 > 2 > entry["body"]["lost_percent"] > 0.5
    assert abs(entry["uncorrected_body_hu"]) > 100


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"photons": 10}, "photons"),
        ({"dead_times_ns": ()}, "dead_times"),
        ({"charge_sharing": (0.0,)}, "charge_sharing"),
    ],
)
def test_bad_settings(change, match):
    with pytest.raises(ValueError, match=match):
        Settings(**change)
