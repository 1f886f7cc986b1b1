"""The motion study: its measures, its settings, and a whole run at small scale."""

import math

import pytest
from plaque_image import tissue_volume
from tiny_studies import assert_report_is_whole

from recon.study.motion import ESTIMATED, Reference, observe
from recon.study.paper.plaque_scan import inset_grid
from torchpcct.scene.plaque import plaque_scene


@pytest.fixture(scope="module")
def drawn():
    """The plaque as its tissues' values on 0.2 mm voxels."""
    scene, plaque = plaque_scene()
    grid = inset_grid(plaque, 0.2)
    return Reference.of(scene, plaque, grid), tissue_volume(scene, grid).float()


def test_measures_of_a_known_volume(drawn):
    reference, volume = drawn
    found = observe(volume, reference, volume)
    assert found["nrmse"] == 0.0
    assert found["roi_hu"] == pytest.approx((40.0, 100.0), abs=6.0)  # of binary voxels of 0.2 mm
    assert found["lumen_dice"] > 0.95
    deviation = float((volume.double() + 100.0).square().mean().sqrt())
    raised = observe(volume + 10.0, reference, volume)
    assert raised["nrmse"] == pytest.approx(10.0 / deviation, rel=1e-5)
    assert raised["contrast_hu"] == pytest.approx(found["contrast_hu"], abs=1e-4)
    assert raised["basin_depth_hu"] == pytest.approx(found["basin_depth_hu"], abs=1e-4)
    away = observe(volume.roll(8, dims=-1), reference, volume)
    assert math.isnan(away["cap_line_mm"])  # 1.6 mm: the lumen's centre reads fat
    assert away["lumen_dice"] < 0.4
    assert away["lumen_mm2"] == pytest.approx(found["lumen_mm2"], rel=0.02)


@pytest.mark.extended
def test_motion_spoils_and_its_knowledge_repairs(tiny):
    measured = tiny("motion").measured
    m = measured.seen
    assert measured.data["range_mm"] == pytest.approx((0.0, 2.0), abs=0.01)
    small, large = (m.residual["PCCT", f] for f in (0.2, 1.0))
    assert 0.05 < small[0]["nrmse"] < large[0]["nrmse"]
    assert large[1]["nrmse"] < large[0]["nrmse"]  # the shift alone taken out
    fixed = m.compensated["fbp", 0.0, False][0]
    assert fixed["nrmse"] < 0.1 * large[0]["nrmse"]
    wrong = m.compensated["fbp", 0.2, False][0]
    estimated = m.compensated["fbp", ESTIMATED, False][0]
    assert estimated["nrmse"] < wrong["nrmse"]
    assert fixed["nrmse"] < wrong["nrmse"] < large[0]["nrmse"]
    # An estimate that is wrong by a fifth leaves a fifth of the motion.
    assert wrong["nrmse"] == pytest.approx(small[0]["nrmse"], rel=0.15)
    noisy = m.compensated["fbp", 0.0, True][0]
    assert noisy["nrmse"] > fixed["nrmse"]
    rest = m.at_rest["PCCT"]["lumen_mm2"]
    assert fixed["lumen_mm2"] == pytest.approx(rest, rel=0.02)
    assert m.compensated["pwls", 0.0, False][0]["nrmse"] < 0.1 * large[0]["nrmse"]
    assert m.compensated["pwls", None, False][0]["nrmse"] == 0.0
    # to its certified minimum with the true motion only
    assert ("pwls", 0.2, False) not in m.compensated


@pytest.mark.extended
def test_report(tiny, tmp_path):
    study = tiny("motion")
    sections = (
        "one view in 24",
        "wrong by 20 %",
        "## Agreement with the paper",
        "## What was modelled",
    )
    data = assert_report_is_whole(study, tmp_path, {"motion.png", "motion_images.png"}, sections)
    assert "segmentation finds it" in study.report.text
    assert {"range [0, A]", "EID-CT less sensitive"} <= {c["paper"] for c in data["checks"]}
    assert len(data["residual"]) == 3
    assert len(data["compensated"]) == 12
    found = data["estimates"][0]
    assert found["held"] == 1
    assert found["jumps"] == 0
    assert found["error_mm"] < 0.2 * found["true_mm"]
    first = data["residual"][0]["in_place"]
    here = study.measured.seen.residual["PCCT", 0.2][0]
    assert (first["nrmse"], first["lumen_mm2"]) == (here["nrmse"], here["lumen_mm2"])
