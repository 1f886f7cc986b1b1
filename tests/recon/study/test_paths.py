"""The study of paths: the vessels that it draws, how it counts, and a whole run at small scale."""

import numpy as np
import pytest
from tiny_studies import assert_report_is_whole

from recon.motion import InsetMotion, Jump, PathTooLongError
from recon.study import motion_estimates
from recon.study.motion_estimates import JumpMotion
from recon.study.paths import KINDS, SMOOTH, _together, compared, drawn


@pytest.mark.parametrize("kind", KINDS)
def test_vessels_are_drawn_by_their_numbers(kind):
    scene, grid, motions = drawn(kind, 3)
    assert drawn(kind, 3)[2] == motions
    assert any(m != n for m, n in zip(drawn(kind, 4)[2], motions, strict=False)) or not motions
    assert any(isinstance(m, JumpMotion) for m in motions) is (kind not in SMOOTH)
    assert {m.body for m in motions} <= {b.name for b in scene.bodies}
    y, x = grid.center[1:]
    assert 15.0 <= np.hypot(x, y) <= 55.0


def test_an_estimate_is_compared_with_the_truth():
    truth = np.zeros((10, 3))
    truth[5:, 2] = 0.4
    truth -= truth.mean(0)
    path, errors = truth + np.array([0.0, 0.03, 0.04]), np.full((10, 3), 0.018)
    said = Jump(5, np.array([0.0, 0.0, 0.5]), np.full(3, 0.1))
    found = InsetMotion(
        path, errors, True, 9.0, 0.2, (2.0, 1.0), 3, ["parts move differently"], said
    )
    row = compared(found, truth, JumpMotion("wall", 0.4, at_s=0.1))
    assert row["error_mm"] == pytest.approx(0.05)
    assert row["true_mm"] == pytest.approx(0.2)
    assert row["inside"] == pytest.approx(2 / 3)
    assert row["jumps"]
    assert row["other"]
    assert row["jump_error_mm"] == pytest.approx(0.1)
    assert compared(found, truth, None)["jump_mm"] is None
    # A refused estimate has no error, and changes none.
    refused = compared(None, truth, JumpMotion("wall", 0.4, at_s=0.1))
    assert refused["refused"]
    assert refused["true_mm"] == row["true_mm"]
    both = _together([r | {"cpu_seconds": 1.0} for r in (row, refused)])
    assert (both["n"], both["refused"], both["jumps"]) == (2, 1, 1)
    assert both["error_mm"] == row["error_mm"]
    assert _together([refused | {"cpu_seconds": 1.0}])["error_mm"] is None


def test_a_path_that_leads_too_far_is_no_end_of_a_study(monkeypatch):
    def too_far(scan, grid):
        raise PathTooLongError("2.7 mm")

    monkeypatch.setattr(motion_estimates, "estimate_motion", too_far)
    assert motion_estimates.motion_or_refusal(None, None) is None
    row = motion_estimates._row([None, None], np.ones((4, 3)))
    assert (row["refused"], row["held"], row["error_mm"]) == (2, 0, None)


@pytest.mark.extended
def test_report(tiny, tmp_path):
    study = tiny("paths")
    data = assert_report_is_whole(study, tmp_path, {"paths.png"}, ("jump was reported", "at rest"))
    rest, line = data["paths"]
    assert not rest["held"]
    assert line["held"]
    assert line["error_mm"] < 0.3 * line["true_mm"]
    assert not line["jumps"]
    assert data["mbir_seconds"] > 0.0
