"""The study of contrast recovery: its rows are those of the insertion test, pooled."""

from tiny_studies import assert_report_is_whole


def test_report(tiny, tmp_path):
    data = assert_report_is_whole(
        tiny("recovery"), tmp_path, {"recovery.png"}, ("## 2 s", "1 mm, +200 HU (4 balls)")
    )
    rows = {row["method"]: row for row in data["rows"]}
    assert set(rows) == {"fbp:standard", "pwls"}
    for row in rows.values():
        assert (row["diameter_mm"], row["contrast_hu"], row["exposure_s"]) == (1.0, 200.0, 2.0)
        assert row["balls"] == 4
        assert 0.5 < row["soft_fbp"] < 1.0
    # FBP is linear: every ball of every realisation reads alike, but for where voxels lie.
    assert rows["fbp:standard"]["standard_error"] < 0.02
    assert rows["fbp:standard"]["verdict"] == "more"
    assert "MBIR shows less" not in tiny("recovery").report.text  # it was not measured
