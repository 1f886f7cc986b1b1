"""The dose-factor study end to end at the smallest scale, its pieces, and its figures on samples of known truth."""

import json
import math
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny_studies import TINY as SMALLEST
from tiny_studies import assert_report_is_whole

from recon.cli import main
from recon.pwls.qggmrf import quadratic
from recon.study import registry
from recon.study.dose_factor import measure as study
from recon.study.dose_factor.exact import Exact
from recon.study.dose_factor.main_scenes import method_entry
from recon.study.dose_factor.measure import measure
from recon.study.dose_factor.measures import crop_window
from recon.study.dose_factor.methods import (
    LinearFilter,
    Misstated,
    Penalised,
    fingerprint,
)
from recon.study.dose_factor.other_rois import wide_rois
from recon.study.dose_factor.realisations import Realisations
from recon.study.dose_factor.scene import StudyScene
from recon.study.dose_factor.settings import MAIN_SCENES, Settings
from recon.study.dose_factor.store import Store
from recon.study.dose_factor.variant import Variant
from recon.study.dose_factor.vessels import VesselScans

TINY = Settings(**SMALLEST["dose-factor"])


@pytest.fixture(scope="module")
def folder(tiny):
    return tiny("dose-factor").folder


@pytest.fixture(scope="module")
def measured(tiny):
    return tiny("dose-factor").measured


@pytest.fixture(scope="module")
def analysed(tiny):
    return tiny("dose-factor").report.data


@pytest.fixture(scope="module")
def scene(folder, measured):
    """The paper's scene: its scan, problem and facts."""
    return StudyScene("paper", TINY, Store(folder))


@pytest.fixture(scope="module")
def clean_b(scene):
    return torch.from_numpy(scene.facts.statistic)


def test_truth_is_what_the_scanner_sees(measured, analysed):
    tissues = analysed["truth"]["tissues_hu"]
    assert tissues["fibrous"] - tissues["core"] == pytest.approx(62, abs=3)
    # Noise-free FBP on 0.1 mm reads about the same in the core (48 views leave streaks).
    assert measured.facts["paper"].reference_hu[0] == pytest.approx(tissues["core"], abs=15)
    contrasts = [measured.facts[name].contrast_hu for name in MAIN_SCENES]
    np.testing.assert_allclose(contrasts, np.array([1, 0, 0.5, -1]) * contrasts[0], atol=1.5)


def test_exact_fbp_describes_its_realisations(measured, analysed):
    samples = measured.fbp["paper", 2.0]["roi"]
    fbp = analysed["fbp"][0]
    sd = np.sqrt(np.diag(measured.facts["paper"].fbp_covariance["soft 0.25 mm"])[:2] / 2.0)
    assert np.abs(samples.mean(0) - fbp["roi_hu"]).max() < 4 * sd.max() / math.sqrt(len(samples))
    assert (samples.std(0, ddof=1) < 2.5 * sd).all()
    assert 0.4 < fbp["slope"] < 1.05
    assert fbp["doses"][0]["d_prime_volume"] > fbp["doses"][0]["d_prime_axial"] > 0


def test_nothing_linear_exceeds_the_limit(analysed):
    limit = analysed["ceiling"][0]
    for fbp in analysed["fbp"]:
        assert fbp["doses"][0]["contrast_sd_hu"] > limit["contrast_sd_hu"]
        assert fbp["doses"][0]["paper_cnr"] < limit["paper_cnr"]
        if not fbp["blur_mm"]:
            assert fbp["doses"][0]["d_prime_volume"] < limit["d_prime"]
    # An unknown amplitude more can only raise the limit's SD.
    assert limit["contrast_sd_fat_unknown_hu"] >= limit["contrast_sd_hu"]


def test_report(tiny, tmp_path):
    study = tiny("dose-factor")
    sections = ("physics allows at most", "# Measured dose factors", "half_size_core")
    data = assert_report_is_whole(study, tmp_path, {"dose_factor.png", "dose_factor_images.png"}, sections)
    assert data["study"] == "dose-factor"
    assert {e["method"] for e in data["methods"]} == {"linear"}
    assert study.report.text.startswith("The paper assumes 5.7×; measured")
    assert sections[0] in study.report.text.splitlines()[0]


class _Stop(Exception):
    pass


def test_an_interrupted_study_goes_on_to_the_same_figures(measured, folder, tmp_path):
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True, ignore=shutil.ignore_patterns("methods"))
    (tmp_path / "data" / "paper_2s_3-6.npz").unlink()

    def stop(step, fraction):
        if step == "linear" and fraction > 0.3:
            raise _Stop

    with pytest.raises(_Stop):
        measure(TINY, stop, tmp_path)
    done = {p: p.stat().st_mtime_ns for p in (tmp_path / "methods").rglob("*.npz")}
    assert done
    assert not list(tmp_path.rglob("*.part.*"))
    again = measure(TINY, folder=tmp_path)
    assert all(p.stat().st_mtime_ns == t for p, t in done.items())
    for part in ("fbp", "samples", "extra"):
        own, other = getattr(measured, part), getattr(again, part)
        assert own.keys() == other.keys()
        for key, values in own.items():
            assert values.keys() == other[key].keys()
            for name, value in values.items():
                np.testing.assert_array_equal(other[key][name], value)


def test_a_finished_study_computes_nothing(measured, folder, monkeypatch):
    calls = []
    monkeypatch.setattr(Store, "piece", _counting(Store.piece, calls))
    measure(TINY, folder=folder)
    assert not calls


def _counting(piece, calls):
    def counted(self, name, key, compute):
        def noted():
            calls.append(name)
            return compute()

        return piece(self, name, key, noted)

    return counted


def test_vessels(measured, analysed, scene, clean_b):
    rows = analysed["vessels"]
    assert [(r["roi"], r["vessel"]) for r in rows] == [
        (roi, name) for roi in ("section", "tissue") for name in ("straight", "curved_5mm")
    ]
    assert {len(v["roi"]) for v in measured.vessels.values()} == {TINY.scene_n}
    for row in rows:
        # 0.4 mm voxels and 3 realisations: enough to see that there is a core, and none without.
        assert 0.4 < row["slope"]["value"] < 1.3
        assert abs(row["false_contrast_hu"]["value"]) < 25
    # The shared response of a linear filter to the noise is what the filter of the noisy statistic says.
    noise = Realisations(TINY, scene.store, lambda name: scene)
    scans, filtered = VesselScans(noise), LinearFilter()
    clean = torch.from_numpy(scans.clean("curved_5mm")["b"])[0] * 2.0
    both = filtered(scene.problem, clean + noise.gram_noise("paper", 2.0, range(3)), 2.0)
    shared = scans._reconstructed(filtered, clean, 2.0, range(3))
    assert float((both - shared).abs().max()) < 0.2


def test_half_contrast_carries_the_papers_noise(measured):
    paper, half = (measured.samples["linear", name, 2.0]["roi"] for name in ("paper", "half_contrast"))
    difference = paper - half
    # The method is linear: with the same noise only the noise-free difference is left.
    assert np.abs(difference - difference.mean(0)).max() < 0.1


def synthetic(measured, slope, sd, n=600, shift=0.0):
    """Samples of a method with a known slope, SD and false contrast."""
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((n, 2)) * sd / math.sqrt(2)
    scene_crop = measured.samples["linear", "paper", 2.0]["crop"].shape[1:]
    samples = {}
    for name in MAIN_SCENES:
        contrast = slope * measured.facts[name].contrast_hu + shift
        roi = noise + np.array([-contrast / 2, contrast / 2]) + 70.0
        crop = rng.standard_normal((n, *scene_crop)).astype(np.float16)
        shape = np.tile([4.0, 0.2, 4.1], (n, 1))
        samples["linear", name, 2.0] = {"roi": roi, "crop": crop, "shape": shape}
    return replace(measured, samples=samples, fbp={}, settings=replace(TINY, n=n, fast_noise=True))


def test_figures_of_a_method_of_known_slope_and_noise(measured):
    slope, sd = 0.8, 10.0
    exact = Exact(synthetic(measured, slope, sd))
    entry = method_entry(exact, "linear", 2.0)
    assert entry["slope"]["value"] == pytest.approx(slope, rel=1e-6)
    assert entry["contrast_sd_raw_hu"]["value"] == pytest.approx(sd, rel=0.06)
    assert entry["contrast_sd_hu"]["value"] == pytest.approx(sd / slope, rel=0.06)
    assert entry["contrast_sd_hu"]["low"] < entry["contrast_sd_hu"]["value"] < entry["contrast_sd_hu"]["high"]
    limit = exact.limits(2.0)
    assert entry["efficiency"]["value"] == pytest.approx((limit["contrast_sd_hu"] * slope / sd) ** 2, rel=0.12)
    fbp = exact.at("soft 0.25 mm", 2.0)
    factor = entry["factors"]["soft 0.25 mm"]
    assert factor["contrast_variance"]["value"] == pytest.approx((fbp["contrast_sd_hu"] * slope / sd) ** 2, rel=0.12)
    own = slope * exact.truth[0] / sd
    assert factor["paper_cnr"]["value"] == pytest.approx((own / fbp["paper_cnr"]) ** 2, rel=0.12)
    # Crops of pure noise: the observer sees nothing.
    assert entry["observer"]["volume"]["auc"]["low"] < 0.5 + 0.05
    assert entry["false_contrast_hu"]["value"] == pytest.approx(slope * exact.truth[1], abs=1.0)


def test_bias_is_reported_as_bias(measured):
    entry = method_entry(Exact(synthetic(measured, 1.0, 5.0, n=200, shift=12.0)), "linear", 2.0)
    assert entry["false_contrast_hu"]["value"] == pytest.approx(12.0, abs=1.0)
    assert entry["slope"]["value"] == pytest.approx(1.0, rel=1e-6)


def test_methods_are_consistent(scene, clean_b):
    problem, b = scene.problem, clean_b
    background = 1000.0 * (problem.level / problem.mu_ref - 1.0)
    batch = torch.stack([2.0 * b, torch.zeros_like(b), b])
    linear = LinearFilter(lam=0.01, mu=0.8)(problem, batch, 2.0) - background
    assert linear[1].abs().max() < 1e-2
    torch.testing.assert_close(linear[0], 2 * linear[2], rtol=1e-3, atol=0.05)
    # Converged: more steps change nothing that an ROI would notice.
    more = LinearFilter(lam=0.01, mu=0.8, steps=40)(problem, batch[:1], 2.0)[0] - background
    rois = scene.rois.on(scene.grid)
    assert all(abs(float(r(linear[0]) - r(more))) < 0.1 for r in rois)
    # The quadratic prior at weak strength and the linear filter see the same contrast.
    weak = Penalised("quadratic", quadratic(0.05), tolerance=0.2)(problem, batch[:1], 2.0)[0] - background
    contrasts = [float(rois[1](v) - rois[0](v)) for v in (linear[0], weak)]
    assert contrasts[0] == pytest.approx(contrasts[1], abs=20)


def test_a_method_that_fails_is_named(scene, clean_b):
    class Broken:
        name = "broken"

        def __call__(self, problem, b, exposure_s):
            return b * float("nan")

    with pytest.raises(ValueError, match=r"'broken'.*--methods"):
        study._timed(Broken(), scene, clean_b[None], 2.0)


def test_wider_rois(analysed):
    variant = Variant("paper", TINY)
    paper = variant.rois.as_dict()
    x = variant.core_center[2]
    for name in TINY.rois:
        pair, wide = variant.wide_rois(name), wide_rois(variant, name)
        assert pair.as_dict()["background_mm2"] > 2 * paper["background_mm2"]
        # A linear ramp reads as the mean position of the mask.
        grid = crop_window(variant.grid, variant.core_center)[1]
        ramp = np.broadcast_to(grid.axes[2], grid.shape)
        at = [np.mean(np.broadcast_to(pair.image.axes[2], m.shape)[m]) for m in (pair.foreground, pair.background)]
        np.testing.assert_allclose(wide.means(ramp, variant.grid.spacing[2]), at, atol=1e-9)
        assert abs(at[0] - x) < 0.1 < abs(at[1] - x)
        # More data in the ROI, less noise; never less than the limit.
        rows = next(e["rows"] for e in analysed["wide_rois"] if e["roi"] == name)
        sd = rows[0]["contrast_sd_hu"]["value"]
        paper_sd = analysed["fbp"][0]["doses"][0]["contrast_sd_hu"]
        assert analysed["ceiling"][0]["contrast_sd_hu"] < sd < paper_sd
        # The factor is the ratio of variances at the study's dose.
        method = next(r for r in rows if not r["exact"])
        ratio = (sd / method["contrast_sd_hu"]["value"]) ** 2
        assert method["factors"]["contrast_variance"]["value"] == pytest.approx(ratio, rel=0.02)
    with pytest.raises(ValueError, match="rois must be of section, tissue"):
        variant.wide_rois("vessel")


def test_rougher_outlines_raise_the_limit(analysed):
    sds = [e["contrast_sd_hu"] for e in analysed["shape_limits"]]
    ideal = analysed["ceiling"][0]["contrast_sd_hu"]
    assert sds[0] < sds[1] < sds[2]
    # Voxels of 0.4 mm and the Gram operator describe the known shapes about as well as exact path lengths.
    assert sds[0] == pytest.approx(ideal, rel=0.25)


def test_worst_case_gain_of_fbp(analysed):
    gains = analysed["worst_case_gains"]
    assert [g["exposure_s"] for g in gains] == [2.0]
    # A sharper kernel answers more.
    soft, standard = (gains[0][f"FBP {k} 0.25 mm"] for k in ("soft", "standard"))
    assert 0 < soft < standard


def test_exact_noise_of_wider_rois_is_that_of_fbp(measured):
    rois, first = wide_rois(Variant("paper", TINY), "tissue"), 2 * TINY.rois.index("tissue")
    samples = rois.means(measured.fbp["paper", 2.0]["crop"], 0.25)
    expected = rois.means(measured.facts["paper"].fbp_crop["soft 0.25 mm"], 0.25)
    sd = np.sqrt(np.diag(measured.wide["soft 0.25 mm"])[first : first + 2] / 2.0)
    assert np.abs(samples.mean(0) - expected).max() < 4 * sd.max() / math.sqrt(len(samples))
    ratio = samples.std(0, ddof=1) / sd
    assert (ratio > 0.3).all()
    assert (ratio < 2.0).all()


def test_a_method_that_is_told_another_exposure(scene, clean_b):
    problem, b = scene.problem, clean_b
    linear = LinearFilter()
    told = Misstated("told", linear, 4.0)
    # The data are the same, their weights are not: as if they were those of four times the exposure.
    torch.testing.assert_close(told(problem, 2.0 * b[None], 2.0), linear(problem, 8.0 * b[None], 8.0))
    assert fingerprint(told) != fingerprint(linear)


def test_an_fbp_image_as_data(scene, clean_b):
    problem, b = scene.problem, clean_b
    noise = Realisations(TINY, scene.store, lambda name: scene)
    piece = noise.images("paper", 2.0, range(2))
    assert piece["shape"].shape == (2, 3)
    assert noise.image_statistic("paper", 2.0, range(2)).shape == (2, *b.shape)
    x = torch.zeros_like(b)
    x[10:18, 8:15, 8:15] = 200.0
    hu = problem.mu_ref / 1000.0
    volume = x + 1000.0 * (problem.level / problem.mu_ref - 1.0)
    statistic = noise._as_statistic(scene, volume, 2.0)
    torch.testing.assert_close(
        statistic, problem.gram.scaled(2.0).apply(x * hu), rtol=1e-3, atol=1e-3 * float(b.abs().max())
    )


def test_command_line(tiny, tmp_path, monkeypatch, capsys):
    asked = {}

    def run(name, settings, progress, folder):
        asked.update(name=name, settings=settings, folder=folder)
        return replace(tiny("dose-factor").report, data=dict(analysed_data))

    analysed_data = tiny("dose-factor").report.data
    monkeypatch.setattr(registry, "run", run)
    options = ["--quick", "--n", "9", "--doses", "0.5", "2", "--scenes", "--fast-noise", "--out", str(tmp_path)]
    assert main(["dose-factor", *options]) == 0
    expected = Settings.quick(n=9, doses=(0.5, 2.0), scenes=(), fast_noise=True)
    assert asked == {"name": "dose-factor", "settings": expected, "folder": tmp_path}
    captured = capsys.readouterr()
    assert captured.out.startswith("The paper assumes 5.7×")
    assert "Command: `torchpcct dose-factor --quick --n 9" in captured.out
    assert "min on two idle cores" in captured.err
    assert json.loads((tmp_path / "report.json").read_text())["command"].startswith("torchpcct dose-factor")
