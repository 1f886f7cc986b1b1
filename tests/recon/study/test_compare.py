"""The comparison at small scale, and the ROIs that it measures in."""

import numpy as np
import pytest
from tiny_studies import TINY, assert_report_is_whole

from recon.study.compare.measure import measure
from recon.study.compare.settings import Settings
from recon.study.paper.plaque_scan import inset_grid
from recon.study.report import markdown_table
from torchpcct.metrics.placement import RoiRule, place_rois
from torchpcct.metrics.roi import axial_grid
from torchpcct.scene.plaque import plaque_scene


def test_report(tiny, tmp_path):
    study = tiny("compare")
    data = assert_report_is_whole(study, tmp_path, {"compare.png"}, ("paper 1.51", "## Agreement with the paper"))
    assert data["study"] == "compare"
    assert data["rois"]["foreground_mm2"] > 0
    assert len(data["statistics"]) == 2
    d = next(e for e in data["statistics"] if e["exposure_s"] == 2.0)
    fg, bg = (np.array(d[roi]["means_hu"]) for roi in ("foreground", "background"))
    assert d["cnr"] == pytest.approx((bg.mean() - fg.mean()) / np.hypot(bg.std(ddof=1), fg.std(ddof=1)))
    assert d["cnr_interval"][0] < d["cnr"] < d["cnr_interval"][1]
    # 48 views with the tube load of the whole scan: the slope of noise against dose is still −½.
    assert data["noise_against_dose"][0]["pixel"] == pytest.approx(-0.5, abs=0.02)


def test_the_same_seed_gives_the_same_figures(tiny):
    again = measure(Settings(**TINY["compare"]))
    assert again.means.keys() == tiny("compare").measured.means.keys()
    for key, means in tiny("compare").measured.means.items():
        np.testing.assert_array_equal(again.means[key], means)


def test_markdown_table_is_aligned():
    lines = markdown_table(["a", "bb"], [["long name", "1"], ["x", "22"]]).splitlines()
    assert len({len(line) for line in lines}) == 1
    assert lines[1] == "|:----------|---:|"


def test_rois_lie_inside_their_tissues():
    scene, plaque = plaque_scene()
    image = axial_grid(inset_grid(plaque, 0.1).center)
    rois = place_rois(scene, image)
    labels = scene.labels(image)
    assert (labels[rois.foreground] == scene.index("core")).all()
    assert (labels[rois.background] == scene.index("fibrous")).all()
    assert rois.background.sum() < rois.foreground.sum()
    with pytest.raises(ValueError, match="foreground ROI is empty"):
        place_rois(scene, image, rule=RoiRule(core_margin=3.0))
