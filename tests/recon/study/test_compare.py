"""The comparison at small scale, and the ROIs that it measures in."""

import math
import re

import numpy as np
import pytest
from tiny_studies import TINY, assert_report_is_whole

from recon.fbp.exact_noise import roi_covariance
from recon.study.compare.answer import answer, claim
from recon.study.compare.measure import measure
from recon.study.compare.placements import vary_placement
from recon.study.compare.settings import Settings
from recon.study.compare.tables import tables
from recon.study.paper import facts as paper
from recon.study.paper.plaque_scan import inset_grid, prepare
from recon.study.report import markdown_table
from torchpcct.metrics.placement import RoiRule, place_rois
from torchpcct.metrics.roi import axial_grid
from torchpcct.scanner import presets
from torchpcct.scene.plaque import plaque_scene

TERMINAL = 110
"""Characters that a table may be wide."""


def test_report(tiny, tmp_path):
    study = tiny("compare")
    data = assert_report_is_whole(study, tmp_path, {"compare.png"}, ("0.40 mm, paper", "## Agreement with the paper"))
    assert data["study"] == "compare"
    assert data["rois"]["foreground_mm2"] > 0
    assert len(data["statistics"]) == 2
    d = next(e for e in data["statistics"] if e["exposure_s"] == 2.0)
    fg, bg = (np.array(d[roi]["means_hu"]) for roi in ("foreground", "background"))
    assert d["cnr"] == pytest.approx((bg.mean() - fg.mean()) / np.hypot(bg.std(ddof=1), fg.std(ddof=1)))
    assert d["cnr_interval"][0] < d["cnr"] < d["cnr_interval"][1]
    # 48 views with the tube load of the whole scan: the slope of noise against dose is still −½.
    assert data["noise_against_dose"][0]["pixel"] == pytest.approx(-0.5, abs=0.02)
    # The exact figure and the paper's stand in rows of their own, one kernel a column.
    rows = [[c.strip() for c in line.split("|")[1:-1]] for line in study.report.text.splitlines() if line[:1] == "|"]
    e = next(e for e in data["noise_free"] if "covariance_hu2_s" in e)
    exact = (e["background_hu"] - e["foreground_hu"]) / np.sqrt(np.trace(e["covariance_hu2_s"]) / 2.0)
    assert ["0.40 mm, exact", f"{exact:.2f}"] in rows
    assert ["0.40 mm, paper", "1.51"] in rows


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


@pytest.fixture(scope="module")
def scanned():
    """A thinned scan of the plaque on 0.4 mm voxels."""
    return prepare(("soft", "bone"), (0.4,), plaque_scene(), presets.pcct(views=48), paper.FULL_VIEWS["PCCT"])


def test_placements_start_with_the_nominal_one(scanned):
    scan = scanned
    grid = scan.grids[0]
    soft, bone = vary_placement(scan.clean, grid, scan.rois, ("soft", "bone"))
    assert (soft.kernel, bone.kernel) == ("soft", "bone")
    assert soft.means.shape == soft.variances.shape == (16, 2)
    volumes = scan.fbp(scan.clean)[0]
    expected = roi_covariance(scan.clean, scan.fbp, scan.pairs, 1.0)[0]
    for k, found in enumerate((soft, bone)):
        np.testing.assert_allclose(found.means[0], [float(r(volumes[k])) for r in scan.pairs[0]], atol=0.02)
        np.testing.assert_allclose(found.variances[0], np.diag(expected[k]), rtol=2e-3)
        low, high = found.range_of("core", "SD", 4.0)
        assert low <= np.sqrt(found.variances[0, 0] / 4.0) <= high
        few, many = found.range_of("core", "SD", 4.0, 10), found.range_of("core", "mean", 4.0, 10)
        assert few == pytest.approx((0.548 * low, 1.454 * high), rel=1e-3)  # chi-squared, 9 degrees of freedom
        assert many[0] < found.means[:, 0].min() - 0.3 * low
        assert many[1] > found.means[:, 0].max() + 0.3 * low
    # Half a voxel of 0.4 mm matters to a sharp kernel: the range is a range.
    low, high = bone.range_of("fibrous", "SD", 2.0)
    assert high > 1.02 * low
    assert len(np.unique(bone.means.round(6), axis=0)) == 16


def record(method, exposure, figure, where, value, low=math.nan, high=math.nan):
    return {"task": "plaque", "method": method, "exposure_s": exposure, "figure": figure, "where": where,
            "value": value, "low": low, "high": high}  # fmt: skip


def report_values(low, high, exposures=(0.35, 2.0)):
    records = [record("fbp:soft", e, "CNR", "small", 1.91 * math.sqrt(e / 2.0)) for e in exposures]
    for e in exposures:
        records += [
            record("mbir", e, "CNR", "small", 1.0, 0.9, 1.1),
            record("mbir", e, "dose factor: CNR", "small", 5.55, low, high),
            record("mbir", e, "dose factor: contrast at slope 1", "lesion", 0.85, 0.8, 0.9),
        ]
    return {"settings": {"views": 1968, "method_draws": 16}, "records": records, "claim": claim(records)}


@pytest.mark.parametrize(
    ("low", "high", "said"), [(5.8, 9.0, " reaches "), (2.0, 5.6, " does not reach "), (5.0, 6.0, " may or may not ")]
)
def test_the_answer_is_one_sentence_made_of_the_results(low, high, said):
    data = report_values(low, high)
    text = answer(data)
    assert said in text
    assert len(re.findall(r"[.!?](?=\s|\*)", text)) == 1
    assert "MBIR's CNR of 1.00 [0.90, 1.10]" in text
    assert "the 1.91 of FBP" in text
    assert "0.85 [0.80, 0.90] by the contrast of the lesion" in text
    assert "detectability" not in text  # was not measured
    assert "WARNING" not in text
    data["settings"]["views"] = 246
    assert "says nothing about the question" in answer(data)
    assert data["claim"]["needed"] == pytest.approx(2.0 / 0.35)


def test_no_claim_without_both_exposures():
    data = report_values(4.0, 6.0, exposures=(2.0,))
    assert data["claim"] is None
    assert "5.7" not in answer(data)
    assert answer({**data, "records": []}) == ""


def test_tables_fit_a_terminal():
    """At full size, with the widest figures that the paper has."""
    roi = {"mean_hu": 111.06, "sd_hu": 47.88}
    settings = Settings()
    keys = [{"kernel": k, "voxel_mm": v} for k in settings.kernels for v in settings.voxels_mm]
    data = {
        "settings": vars(settings),
        "statistics": [{**k, "exposure_s": 2.0, "foreground": roi, "background": roi, "cnr": 1.91} for k in keys],
        "noise_free": [
            {**k, "foreground_hu": 111.1, "background_hu": 111.1, "covariance_hu2_s": [[4000.0, 0.0], [0.0, 4000.0]]}
            for k in keys
        ],
    }  # fmt: skip
    rows = [line for line in tables(data, "5.7x", 2.0).splitlines() if line.startswith("|")]
    assert len(rows) > 40
    assert max(map(len, rows)) <= TERMINAL


def test_settings_refuse_too_few_realisations():
    with pytest.raises(ValueError, match="method_draws must be at least 8"):
        Settings(method_draws=7)
    assert Settings(method_draws=0, methods=()).methods == ()
    with pytest.raises(ValueError, match="at least 3"):
        Settings(realizations=2)
