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
from recon.mbir.mbir import average_onto
from recon.pwls.qggmrf import quadratic
from recon.study.dose_factor import measure as study
from recon.study.dose_factor.analysis import analyse
from recon.study.dose_factor.estimates import controlled
from recon.study.dose_factor.measure import measure
from recon.study.dose_factor.measures import crop_window
from recon.study.dose_factor.methods import (
    LinearFilter,
    Misstated,
    Penalised,
    fingerprint,
    load_methods,
)
from recon.study.dose_factor.other_rois import averaged_rois, wide_rois
from recon.study.dose_factor.realisations import Realisations
from recon.study.dose_factor.report import headline
from recon.study.dose_factor.scene import StudyScene
from recon.study.dose_factor.settings import MAIN_SCENES, METHODS, Settings
from recon.study.dose_factor.store import Store
from recon.study.dose_factor.tissue_values import tissue_groups
from recon.study.dose_factor.variant import Variant
from recon.study.paper.plaque_scan import inset_grid
from torchpcct import VolumeGrid

TINY = Settings(**SMALLEST["dose-factor"])


@pytest.fixture(scope="module")
def folder(tiny):
    return tiny("dose-factor").folder


@pytest.fixture(scope="module")
def measured(tiny):
    return tiny("dose-factor").measured


@pytest.fixture(scope="module")
def analysed(measured):
    return analyse(measured)


def plain(report):
    """The report's data without what a clock measured."""
    data = json.loads(json.dumps(report, default=float))
    data.pop("seconds", None)
    for entry in data["methods"]:
        entry.pop("seconds_per_volume")
    return data


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


def test_an_interrupted_study_goes_on_to_the_same_report(measured, analysed, folder, tmp_path):
    for part in ("scans", "scenes"):
        shutil.copytree(folder / part, tmp_path / part)

    def stop(step, fraction):
        if step == "linear" and fraction > 0.3:
            raise _Stop

    with pytest.raises(_Stop):
        measure(TINY, stop, tmp_path)
    done = {p: p.stat().st_mtime_ns for p in (tmp_path / "methods").rglob("*.npz")}
    assert done
    assert not list(tmp_path.rglob("*.part.*"))
    again = measure(TINY, folder=tmp_path)
    assert plain(analyse(again)) == plain(analysed)
    assert all(p.stat().st_mtime_ns == t for p, t in done.items())


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


def test_pieces_of_other_settings_or_cut_off_are_made_again(tmp_path, caplog):
    store = Store(tmp_path)
    assert store.piece("a/b", "one", lambda: {"x": np.arange(3)})["x"].tolist() == [0, 1, 2]
    assert store.piece("a/b", "one", lambda: {"x": np.zeros(1)})["x"].tolist() == [0, 1, 2]
    assert store.piece("a/b", "two", lambda: {"x": np.ones(1)})["x"].tolist() == [1]
    path = store.path("a/b.npz")
    path.write_bytes(path.read_bytes()[:100])
    assert store.piece("a/b", "two", lambda: {"x": np.full(1, 7)})["x"].tolist() == [7]
    assert "computed again" in caplog.text


def test_half_contrast_carries_the_papers_noise(measured):
    paper, half = (measured.samples["linear", name, 2.0]["roi"] for name in ("paper", "half_contrast"))
    difference = paper - half
    # The method is linear: with the same noise only the noise-free difference is left.
    assert np.abs(difference - difference.mean(0)).max() < 0.1


def synthetic(measured, slope, sd, n=1500, shift=0.0):
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
    data = analyse(synthetic(measured, slope, sd))
    entry = data["methods"][0]
    assert entry["slope"]["value"] == pytest.approx(slope, rel=1e-6)
    assert entry["contrast_sd_raw_hu"]["value"] == pytest.approx(sd, rel=0.06)
    assert entry["contrast_sd_hu"]["value"] == pytest.approx(sd / slope, rel=0.06)
    assert entry["contrast_sd_hu"]["low"] < entry["contrast_sd_hu"]["value"] < entry["contrast_sd_hu"]["high"]
    limit = data["ceiling"][0]
    assert entry["efficiency"]["value"] == pytest.approx((limit["contrast_sd_hu"] * slope / sd) ** 2, rel=0.12)
    fbp = data["fbp"][0]["doses"][0]
    factor = entry["factors"]["soft 0.25 mm"]
    assert factor["contrast_variance"]["value"] == pytest.approx((fbp["contrast_sd_hu"] * slope / sd) ** 2, rel=0.12)
    own = slope * data["truth"]["contrasts_hu"]["paper"] / sd
    assert factor["paper_cnr"]["value"] == pytest.approx((own / fbp["paper_cnr"]) ** 2, rel=0.12)
    # Crops of pure noise: the observer sees nothing.
    assert entry["observer"]["volume"]["auc"]["low"] < 0.5 + 0.05
    assert entry["false_contrast_hu"]["value"] == pytest.approx(
        slope * data["truth"]["contrasts_hu"]["absent_core"], abs=1.0
    )


def test_bias_is_reported_as_bias(measured):
    data = analyse(synthetic(measured, 1.0, 5.0, shift=12.0))
    entry = data["methods"][0]
    assert entry["false_contrast_hu"]["value"] == pytest.approx(12.0, abs=1.0)
    assert entry["slope"]["value"] == pytest.approx(1.0, rel=1e-6)
    assert "5.7" in headline(data)


def problem_of(folder):
    scene = StudyScene("paper", TINY, Store(folder))
    return scene, scene.problem, torch.from_numpy(scene.facts.statistic)


def test_methods_are_consistent(measured, folder):
    scene, problem, b = problem_of(folder)
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


def test_method_registry(caplog):
    assert [m.name for m in load_methods(["tv", "linear"])] == ["tv", "linear"]
    assert fingerprint(LinearFilter()) != fingerprint(LinearFilter(mu=0.7))
    one, two = load_methods(["mbir_one_pass", "mbir"])
    assert fingerprint(one) != fingerprint(two)
    with pytest.raises(ValueError, match="unknown method 'magic'"):
        load_methods(["magic"])


def test_control_variates():
    rng = np.random.default_rng(3)
    noise = rng.standard_normal((200, 2))
    values = np.array([5.0, -2.0]) + noise @ np.array([[2.0, 0.3], [0.1, 1.0]]) + 0.1 * rng.standard_normal((200, 2))
    found = controlled(values, 7.0 + 3.0 * noise, [7.0, 7.0])
    np.testing.assert_allclose(found.mean(0), [5.0, -2.0], atol=4 * 0.1 / math.sqrt(200))
    assert found.std(0).max() < 0.15 < 5 * 0.15 < values.std(0).min()
    # Noise that has nothing to do with the control stays.
    free = rng.standard_normal((200, 2))
    np.testing.assert_allclose(controlled(free, noise, [0.0, 0.0]).mean(0), free.mean(0), atol=0.03)


def test_missing_weights_leave_mbir_out(monkeypatch, caplog):
    import recon.mbir.mbir

    def missing(**options):
        raise FileNotFoundError("no weights at nowhere")

    monkeypatch.setattr(recon.mbir.mbir.Mbir, "load", missing)
    assert [m.name for m in load_methods(METHODS)] == [m for m in METHODS if "mbir" not in m and m != "fbp_cnn"]
    assert "mbir is left out" in caplog.text
    with pytest.raises(ValueError, match="no method to run"):
        load_methods(["mbir"])


def test_a_method_that_fails_is_named(measured, folder):
    class Broken:
        name = "broken"

        def __call__(self, problem, b, exposure_s):
            return b * float("nan")

    scene, _, b = problem_of(folder)
    with pytest.raises(ValueError, match=r"'broken'.*--methods"):
        study._timed(Broken(), scene, b[None], 2.0)


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


def test_rois_on_larger_voxels_are_those_of_the_averaged_volume():
    variant = Variant("paper", replace(TINY, voxel_mm=0.2))
    coarse = inset_grid(variant.plaque, 0.35)
    volume = torch.randn(variant.grid.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    place = crop_window(variant.grid, variant.core_center)[0]
    expected = [float(r(average_onto(volume, variant.grid, coarse))) for r in variant.rois.on(coarse)]
    np.testing.assert_allclose(averaged_rois(variant, 0.35).means(volume[place].numpy(), 0.2), expected, rtol=1e-9)


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


def test_pitch_of_the_scene():
    fine, paper = (Variant(name, TINY).scanner.geometry for name in ("pitch_0.30mm:absent", "paper"))
    assert (fine.pitch[1], paper.pitch[1]) == (0.30, 0.35)
    assert (fine.pitch[0], fine.views, fine.sod) == (paper.pitch[0], paper.views, paper.sod)
    bodies = [Variant(name, TINY).scene.bodies for name in ("pitch_0.30mm:absent", "absent_core")]
    assert [b.name for b in bodies[0]] == [b.name for b in bodies[1]]


def test_a_method_that_is_told_another_exposure(measured, folder):
    _, problem, b = problem_of(folder)
    linear = LinearFilter()
    told = Misstated("told", linear, 4.0)
    # The data are the same, their weights are not: as if they were those of four times the exposure.
    torch.testing.assert_close(told(problem, 2.0 * b[None], 2.0), linear(problem, 8.0 * b[None], 8.0))
    assert fingerprint(told) != fingerprint(linear)


def test_an_fbp_image_as_data(measured, folder):
    scene, problem, b = problem_of(folder)
    noise = Realisations(TINY, Store(folder), lambda name: scene)
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


def test_tissue_groups_and_crop():
    names = ["patient", "wall", "fibrous", "lumen", "core", "stent_0", "stent_0_blood", "fibrous_texture_3"]
    groups = tissue_groups(names)
    assert groups["lumen"] == ["lumen", "stent_0_blood"]
    assert groups["fibrous"] == ["fibrous", "fibrous_texture_3"]
    assert groups["stent"] == ["stent_0"]
    grid = VolumeGrid((30, 24, 24), 0.4, (0.0, 5.0, -5.0))
    place, crop = crop_window(grid, (0.1, 5.0, -5.3))
    for axis, part, own in zip(grid.axes, place, crop.axes, strict=True):
        np.testing.assert_allclose(axis[part], own)
    with pytest.raises(ValueError, match="leaves the inset"):
        crop_window(grid, (5.9, 5.0, -5.0))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"n": 2}, "n must be at least 3"),
        ({"doses": ()}, "doses is empty"),
        ({"doses": (0.0,)}, "doses must be different exposures"),
        ({"methods": ("magic",)}, "'magic' of methods"),
        ({"scenes": ("nowhere",)}, "'nowhere' of scenes"),
        ({"kernels": ("bone",)}, "FBP soft"),
        ({"rois": ("vessel",)}, "'vessel' of rois"),
    ],
)
def test_bad_settings(changes, message):
    with pytest.raises(ValueError, match=message):
        Settings(**changes)
    with pytest.raises(TypeError, match="n must be a whole number"):
        Settings(n=7.5)


def test_command_line(measured, folder, monkeypatch, capsys):
    monkeypatch.setattr(Settings, "quick", classmethod(lambda cls, **changes: TINY))
    assert main(["dose-factor", "--quick", "--out", str(folder)]) == 0
    captured = capsys.readouterr()
    assert captured.out.startswith("The paper assumes 5.7×")
    assert "Command: `torchpcct dose-factor --quick" in captured.out
    assert "min on two idle cores" in captured.err


def test_command_line_refuses(tmp_path, capsys):
    assert main(["dose-factor", "--n", "2", "--out", str(tmp_path / "o")]) == 2
    assert "n must be at least 3" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
