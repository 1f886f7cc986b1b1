"""The comparison at small scale, and the ROIs that it measures in."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_studies import TINY, assert_report_is_whole

from recon.fbp.exact_noise import roi_covariance
from recon.pwls.inset_problem import InsetProblem
from recon.study.compare.answer import answer, claim, dose_section
from recon.study.compare.draws import Draws, reconstruct_draws
from recon.study.compare.factors import dose_factors, reference_entry
from recon.study.compare.measure import MBIR, PWLS, measure
from recon.study.compare.placements import vary_placement
from recon.study.compare.reference import Reference
from recon.study.compare.regions import Regions
from recon.study.compare.settings import Settings
from recon.study.compare.tables import tables
from recon.study.dose_factor.methods import LinearFilter
from recon.study.dose_factor.response import Response, linear_response
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
    """A thinned scan of the plaque on 0.4 mm voxels, its problem and regions."""
    scene, plaque = plaque_scene()
    scan = prepare(("soft", "bone"), (0.4,), (scene, plaque), presets.pcct(views=48), paper.FULL_VIEWS["PCCT"])
    return scan, InsetProblem(scan.clean, scan.grids[0]), Regions(scene, plaque, scan.rois)


def test_regions_lie_in_their_tissues(scanned):
    scan, _, regions = scanned
    grid = scan.grids[0]
    labels = regions.scene.labels(grid)
    fat = regions.fat(grid)
    assert fat.sum() > 2000
    assert (labels[fat] == regions.scene.index("patient")).all()
    assert not fat[[0, -1]].any()
    assert not fat[:, [0, -1]].any()
    voxels = regions.fat_voxels(grid, 5)
    assert len(voxels) == 5
    assert all(w.sum() == 1 and w[fat].sum() == 1 for w in voxels)
    core, fibrous = regions.whole.foreground, regions.whole.background
    inside = regions.scene.labels(regions.whole.image)
    assert (inside[core] == regions.scene.index("core")).all()
    assert (inside[fibrous] == regions.scene.index("fibrous")).all()
    assert core.any(axis=(1, 2)).sum() > 20  # of 39 slices: a volume, not a section


def test_control_of_a_linear_method_is_the_method(scanned):
    """Its gradient is its adjoint: correlation 1, and the draws' variance does not matter any more."""
    scan, problem, regions = scanned
    method, exposure = LinearFilter(steps=16), 2.0
    grid = scan.grids[0]
    rois = regions.on(grid)
    clean = problem.statistic(scan.clean).b * exposure
    weights = torch.stack([r.weights for r in rois])
    control = linear_response(method, problem, weights, clean, exposure, scan.clean)
    noisy = torch.stack([problem.statistic(scan.clean.with_noise(exposure, seed)).b for seed in range(6)])
    change = 0.1 * clean
    draws = reconstruct_draws(method, problem, rois, regions.fat(grid), noisy, change, exposure, control)
    offset = draws.means - draws.controls  # what b = 0 reads
    np.testing.assert_allclose(offset, np.broadcast_to(offset[0], offset.shape), atol=0.05)
    assert draws.means.std(0).min() > 2  # HU: the noise is far larger than that
    # The twin has the same noise, so only its expectation differs.
    difference = draws.absent - draws.means
    assert difference.std(0).max() < 0.05
    np.testing.assert_allclose(difference[0], 0.1 * control.mean, rtol=1e-3, atol=0.05)
    # The exact variance is that of the drawn noise: 6 draws of 4 ROI means, chi-squared within 4 standard deviations.
    z = np.linalg.solve(np.linalg.cholesky(control.covariance), (draws.controls - control.mean).T)
    assert np.square(z).sum() == pytest.approx(24, abs=4 * np.sqrt(2 * 24))
    assert draws.fat.shape == (6,)
    assert linear_response(torch.no_grad()(method), problem, weights, clean, exposure, scan.clean) is None


def test_placements_start_with_the_nominal_one(scanned):
    scan, _, _ = scanned
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


TRUTH, PRESENT, ABSENT = 60.0, np.array([50.0, 86.0, 45.0, 93.0]), np.array([80.0, 86.0, 88.0, 92.0])
REFERENCE = Reference(PRESENT, ABSENT, np.diag([400.0, 500.0, 100.0, 150.0]), 900.0, 0.01)


def drawn(n, exposure, seed, controlled=True):
    """Draws of a method whose ROI means are 0.9 times the deviations of a control, plus a little of their own.

    Contrast variance at 1 s: 0.81 (100 + 200) + 2 · 1 = 245 in the ROIs; slope (32 + 4) / 60."""
    rng = np.random.default_rng(seed)
    covariance = np.diag([100.0, 200.0, 40.0, 60.0]) / exposure
    deviation = rng.standard_normal((n, 4)) * np.sqrt(np.diag(covariance))
    own = rng.standard_normal((n, 4)) / np.sqrt(exposure)
    means = np.array([52.0, 84.0, 50.0, 90.0]) + 0.9 * deviation + own
    absent = np.array([86.0, 82.0, 90.0, 88.0]) + 0.9 * deviation + own
    fat = rng.chisquare(4000, n) / 4000 * 225.0 / exposure * (n - 1) / n
    control = Response(torch.zeros(4, 1, 1, 1), np.zeros(4), covariance) if controlled else None
    images = (torch.zeros(1), torch.zeros(1))
    return Draws(exposure, means, absent, fat, images, deviation if controlled else None, control)


def test_dose_factors_of_known_draws():
    """Truth inside the interval as often as promised, and an interval that the control has made narrow."""
    exposure = 2.0
    slope, fbp_slope = (32.0 + 4.0) / TRUTH, (36.0 - 6.0) / TRUTH
    truth = {
        "paper_cnr_factor": (32.0 / np.sqrt(0.81 * 300 + 2)) ** 2 / (36.0**2 / 900.0),
        "roi": 900.0 / 245.0 * (slope / fbp_slope) ** 2,
        "fat_factor": 900.0 / 225.0,
    }
    hits = dict.fromkeys(truth, 0)
    for seed in range(100):
        e = dose_factors(drawn(10, exposure, seed), REFERENCE, TRUTH)
        found = {**e, "roi": e["contrast"]["roi"]["factor"]}
        for name, value in truth.items():
            hits[name] += found[name]["low"] <= value <= found[name]["high"]
    assert all(86 <= count <= 100 for count in hits.values()), hits
    roi = e["contrast"]["roi"]
    assert roi["slope"]["value"] == pytest.approx(slope, abs=1e-9)  # the twin's noise cancels
    assert roi["bias_hu"]["low"] < 32.0 - TRUTH < roi["bias_hu"]["high"]
    assert roi["false_contrast_hu"]["low"] < -4.0 < roi["false_contrast_hu"]["high"]
    assert roi["correlation"] > 0.99
    plain = dose_factors(drawn(10, exposure, 99, controlled=False), REFERENCE, TRUTH)["contrast"]["roi"]
    assert plain["correlation"] is None
    width, plain_width = (r["factor"]["high"] / r["factor"]["low"] for r in (roi, plain))
    assert width < 1.2
    assert plain_width > 3


def report_values(low, exposures=(0.35, 2.0)):
    factors = [{"method": "mbir", **dose_factors(drawn(10, e, 1), REFERENCE, TRUTH)} for e in exposures]
    factors[0]["paper_cnr_factor"] = low
    references = [reference_entry(REFERENCE, e, TRUTH) for e in (0.35, 2.0)]
    return {
        "settings": {"views": 1968, "realizations": 10, "control": True}, "dose_factors": factors,
        "reference": references, "claim": claim(factors, references), "true_values": {"contrast_hu": TRUTH},
        "mbir_voxel_mm": 0.2,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("low", "high", "said"), [(5.8, 9.0, " reaches "), (2.0, 5.6, " does not reach "), (5.0, 6.0, " may or may not ")]
)
def test_the_answer_is_one_sentence_made_of_the_results(low, high, said):
    data = report_values({"value": 5.55, "low": low, "high": high})
    text = answer(data)
    assert said in text
    assert len(re.findall(r"[.!?](?=\s|\*)", text)) == 1
    factor = data["dose_factors"][1]["contrast"]["whole"]["factor"]
    assert (
        f"{factor['value']:.2f} [{factor['low']:.2f}, {factor['high']:.2f}] times by the variance of the contrast over"
        in text
    )
    assert "WARNING" not in text
    data["settings"]["views"] = 246
    assert "says nothing about the question" in answer(data)
    assert data["claim"]["needed"] == pytest.approx(2.0 / 0.35)


def test_no_claim_without_both_exposures():
    data = report_values({"value": 5.0, "low": 4.0, "high": 6.0}, exposures=(2.0,))
    assert data["claim"] is None
    assert "5.7" not in answer(data)


def test_tables_fit_a_terminal():
    """At full size, with the widest figures that the paper has."""
    roi = {"mean_hu": 111.06, "sd_hu": 47.88}
    settings = Settings()
    keys = [("fbp", k, v) for k in settings.kernels for v in settings.voxels_mm] + [(*PWLS, 0.25), (*MBIR, 0.2)]
    names = ("method", "kernel", "voxel_mm")
    data = {
        "settings": vars(settings),
        "statistics": [
            {**dict(zip(names, k, strict=True)), "exposure_s": 2.0, "foreground": roi, "background": roi, "cnr": 1.91}
            for k in keys
        ],
        "noise_free": [
            {**dict(zip(names, k, strict=True)), "foreground_hu": 111.1, "background_hu": 111.1,
             "covariance_hu2_s": [[4000.0, 0.0], [0.0, 4000.0]]}
            for k in keys[:-2]
        ],
    }  # fmt: skip
    text = tables(data, "5.7x", 2.0) + "\n\n" + dose_section(report_values({"value": 5.55, "low": 5.0, "high": 16.0}))
    rows = [line for line in text.splitlines() if line.startswith("|")]
    assert len(rows) > 50
    assert max(map(len, rows)) <= TERMINAL


def test_settings_refuse_too_few_realisations_for_mbir():
    with pytest.raises(ValueError, match="at least 8 for MBIR with control"):
        Settings(realizations=7)
    assert Settings(realizations=5, control=False).exposures((2.0, 0.35)) == (0.35, 2.0)
    with pytest.raises(ValueError, match="at least 3"):
        Settings(realizations=2, mbir=False)


def test_the_table_says_which_estimate_the_headline_is():
    """A controlled CNR of 0.88 once stood over a table of ten raw draws that said 0.08, without a word."""
    folder = Path(__file__).parents[3] / "notebooks" / "compare"
    data = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    text = (folder / "report.md").read_text(encoding="utf-8")
    said = answer(data)
    assert said == data["answer"]
    assert said in text
    assert "MBIR's controlled CNR of" in said
    name, exposure = next(iter(data["settings"]["doses"].items()))
    section = tables(data, name, exposure)
    assert section in text
    row = next(line for line in section.splitlines() if "controlled" in line)
    (factors,) = (f for f in data["dose_factors"] if f["exposure_s"] == exposure)
    assert row.split("|")[-2].strip() == f"{factors['paper_cnr']['value']:.2f}"
    assert "controlled" not in tables({**data, "settings": {**data["settings"], "control": False}}, name, exposure)
