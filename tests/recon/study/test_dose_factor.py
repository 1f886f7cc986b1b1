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
from recon.evaluate.store import Store
from recon.fbp.inset import InsetFbp
from recon.pwls.qggmrf import quadratic
from recon.study import registry
from recon.study.dose_factor import measure as study
from recon.study.dose_factor.exact import Exact
from recon.study.dose_factor.figures_found import drawn_figures, log_detectability
from recon.study.dose_factor.measure import measure
from recon.study.dose_factor.methods import (
    LinearFilter,
    Misstated,
    Penalised,
    fingerprint,
)
from recon.study.dose_factor.places import Places
from recon.study.dose_factor.readings import Readings, true_volume
from recon.study.dose_factor.realisations import Realisations
from recon.study.dose_factor.reconstructed import in_parts, reconstructed
from recon.study.dose_factor.response import linear_response
from recon.study.dose_factor.scene import StudyScene
from recon.study.dose_factor.seen import Seen
from recon.study.dose_factor.settings import MAIN_SCENES, ROIS, Settings
from recon.study.dose_factor.vessels import VesselPlace
from torchpcct.acquisition import transmission
from torchpcct.metrics import RegionNoise

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


def test_an_interrupted_simulation_keeps_blocks_of_views(tmp_path, monkeypatch):
    """And takes them away when the scan is there."""
    settings, store = replace(TINY, views=128), Store(tmp_path)
    whole = transmission.expected_readings
    blocks = []

    def some(part, *arguments):
        if part.views == 64:
            blocks.append(part)
            if len(blocks) == 2:
                raise KeyboardInterrupt
        return whole(part, *arguments)

    monkeypatch.setattr("torchpcct.acquisition.acquire.expected_readings", some)
    with pytest.raises(KeyboardInterrupt):
        _ = StudyScene("paper", settings, store).clean
    assert [p.name for p in (tmp_path / "scans/paper_128").iterdir()] == ["views_0-64.npz"]
    clean = StudyScene("paper", settings, store).clean
    assert len(blocks) == 3
    assert [p.name for p in (tmp_path / "scans").iterdir()] == ["paper_128.h5"]
    monkeypatch.undo()
    other = StudyScene("paper", settings, Store(tmp_path / "other")).clean
    assert torch.equal(clean.counts, other.counts)


def test_truth_is_that_of_rods(measured, analysed):
    tissues = analysed["truth"]["tissues_hu"]
    # The figures of recon.study.paper.rods, however few views the study has.
    expected = {"core": 41.1, "wall": 63.5, "fibrous": 103.2, "lumen": 480.0, "patient": -92.7}
    assert tissues == pytest.approx(expected, abs=1.0)
    contrasts = [measured.facts[name].contrast_hu for name in MAIN_SCENES]
    np.testing.assert_allclose(contrasts, np.array([1, 0, 0.5, -1]) * contrasts[0], atol=1.5)


def entry(analysed, method):
    return next(e for e in analysed["methods"] if e["method"] == method)


def test_exact_fbp_is_that_of_its_realisations(scene, measured):
    noise = Realisations(TINY, scene.store, lambda name: scene)
    blocks = [noise.data("paper", 2.0, block) for block in TINY.blocks(TINY.n)]
    roi = np.concatenate([p["roi"] for p in blocks])
    found = measured.fbp["soft 0.25 mm"]
    sd = np.sqrt(np.diag(found["covariance"])[:2] / 2.0)
    assert np.abs(roi.mean(0) - found["readings"][0, :2]).max() < 4 * sd.max() / math.sqrt(len(roi))
    ratio = roi.std(0, ddof=1) / sd
    assert ((ratio > 0.5) & (ratio < 1.7)).all()
    # The observer's channels of the same draws, too.
    seen = measured.controls[2.0]["fbp"]
    sd = np.sqrt(np.diag(found["covariance"])[6:] / 2.0)
    ratio = seen.std(0, ddof=1) / sd
    assert ((ratio > 0.4) & (ratio < 1.9)).all()


def test_exact_noise_of_fbp_in_fat_is_that_of_all_slices_that_methods_are_read_in(scene, measured):
    """A slice that meets a detector row is noisier than its neighbours: one voxel of it is not the region."""
    grid = scene.grid_of(0.25)
    readings, fbp = Readings(scene, grid, scene.facts.tissue_hu), InsetFbp(scene.clean, [grid], ["soft"])
    noisy = torch.stack([fbp(scene.clean.with_noise(2.0, seed))[0][0] for seed in range(16)])
    drawn = readings.fat(noisy).astype(float).var(0, ddof=1).mean()
    assert drawn == pytest.approx(measured.fbp["soft 0.25 mm"]["variance"][0] / 2.0, rel=0.07)


def test_noise_at_matched_resolution_is_told_where_the_resolution_is(analysed):
    """Both at the core's edge: not the resolution of an edge with the noise of plain fat."""
    for e in analysed["methods"]:
        matched = e["factors"]["noise_matched"]
        if matched["value"] is not None:
            assert matched["value"] == pytest.approx((matched["fbp_sd_hu"] / e["edge_sd_hu"]["value"]) ** 2)
    soft = entry(analysed, "FBP soft 0.25 mm")
    assert soft["factors"]["noise_matched"]["fbp_sd_hu"] == pytest.approx(soft["edge_sd_hu"]["value"], rel=1e-3)


def test_exact_linear_is_that_of_its_realisations(scene, measured):
    noise = Realisations(TINY, scene.store, lambda name: scene)
    b = noise.statistic("paper", 2.0, range(7))
    readings = Readings(scene, scene.grid, scene.facts.tissue_hu)
    volumes = LinearFilter()(scene.problem, b, 2.0)
    own, control = readings.linear(volumes), measured.controls[2.0]["readings"][:7, : len(readings.weights)]
    np.testing.assert_allclose(control, own, atol=2e-3 * own.std(0).max())
    found = measured.linear["linear", 2.0]
    # Noise of a voxel in fat, and the error against the true volume.
    fat = readings.fat(volumes).astype(float)
    assert fat.var(0, ddof=1).mean() == pytest.approx(found["variance"][0], rel=0.25)
    square = readings.squares(volumes).mean(0)
    assert square == pytest.approx(found["square"] + found["variance"][1::-1], rel=0.25)


def test_exact_noise_spectrum_is_that_of_realisations(scene, measured):
    readings = Readings(scene, scene.grid, scene.facts.tissue_hu)
    problem, method = scene.problem, LinearFilter()
    noise = problem.gram.scaled(2.0).noise((40,), generator=torch.Generator().manual_seed(5)).float()
    drawn = RegionNoise.of(readings.fat(method(problem, noise, 2.0)), TINY.voxel_mm, 0.5)
    exact = Exact(measured).figures("linear", 2.0).noise
    np.testing.assert_allclose(exact.frequencies, drawn.frequencies)
    np.testing.assert_allclose(exact.radial, drawn.radial, rtol=0.3)


def test_nothing_linear_exceeds_the_limit(analysed):
    limit = analysed["limits"][0]
    for name in ("FBP soft 0.25 mm", "linear"):
        e = entry(analysed, name)
        assert e["rois"]["paper"]["corrected_sd_hu"]["value"] > limit["contrast_sd_hu"]
        assert e["paper_cnr"]["value"] < limit["paper_cnr"]
    # An unknown amplitude more can only raise the limit's SD.
    assert limit["contrast_sd_fat_unknown_hu"] >= limit["contrast_sd_hu"]


def test_fbp_against_itself(analysed):
    e = entry(analysed, "FBP soft 0.25 mm")
    assert [f["value"] for f in e["factors"].values()] == pytest.approx([1.0] * len(e["factors"]), abs=1e-6)
    assert e["noise_magnitude_ratio"]["value"] == pytest.approx(1.0)
    assert e["realizations"] is None


def test_factors_are_ratios_of_figures(analysed):
    own, fbp = (entry(analysed, k) for k in ("linear", "FBP soft 0.25 mm"))
    factors = {k: v["value"] for k, v in own["factors"].items()}
    assert factors["noise"] == pytest.approx((fbp["fat_sd_hu"]["value"] / own["fat_sd_hu"]["value"]) ** 2)
    assert factors["paper_cnr"] == pytest.approx((own["paper_cnr"]["value"] / fbp["paper_cnr"]["value"]) ** 2)
    for roi in ROIS:
        sds = [e["rois"][roi]["corrected_sd_hu"]["value"] for e in (fbp, own)]
        assert factors[f"contrast_{roi}"] == pytest.approx((sds[0] / sds[1]) ** 2)
    r = own["rois"]["paper"]
    size = math.hypot(r["contrast_bias_hu"]["value"], r["contrast_sd_hu"]["value"])
    assert r["contrast_rmse_hu"]["value"] == pytest.approx(size)


def test_report(tiny, tmp_path):
    study = tiny("dose-factor")
    sections = ("(limit ", "# Measured dose factors", "half size core", "What each method is for")
    data = assert_report_is_whole(study, tmp_path, {"dose_factor.png", "dose_factor_images.png"}, sections)
    assert data["study"] == "dose-factor"
    assert {e["method"] for e in data["methods"]} == {"FBP soft 0.25 mm", "linear", "qggmrf"}
    assert study.report.text.startswith("The paper assumes 5.7×; measured")
    tables = [line for line in study.report.text.splitlines() if line.startswith("|")]
    assert max(map(len, tables)) <= 100


class _Stop(Exception):
    pass


def test_an_interrupted_study_goes_on_to_the_same_figures(measured, folder, tmp_path):
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    # A scene, a block of its noise and of a further scene are missing: most is found finished, as after a crash.
    for name in ("data/paper_2s_7-14", *(f"methods/qggmrf/{n}" for n in ("paper_2s_0-7", "paper_2s_7-12",
                 "half_contrast_2s_0-7", "half_size_core_2s_7-9"))):  # fmt: skip
        (tmp_path / f"{name}.npz").unlink()

    def stop(step, fraction):
        if step == "qggmrf" and fraction > 0.5:
            raise _Stop

    with pytest.raises(_Stop):
        measure(TINY, stop, tmp_path)
    done = {p: p.stat().st_mtime_ns for p in (tmp_path / "methods").rglob("*.npz")}
    assert tmp_path / "methods" / "qggmrf" / "paper_2s_7-12.npz" in done
    assert tmp_path / "methods" / "qggmrf" / "half_size_core_2s_7-9.npz" not in done
    assert not list(tmp_path.rglob("*.part.*"))
    again = measure(TINY, folder=tmp_path)
    assert all(p.stat().st_mtime_ns == t for p, t in done.items())
    for part in ("fbp", "linear", "controls", "samples", "extra"):
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


def test_places(measured, analysed):
    rows = analysed["vessels"]
    assert [(r["roi"], r["vessel"], r["method"]) for r in rows] == [
        (roi, name, method)
        for roi in ("section", "tissue") for name in TINY.vessels for method in ("linear", "qggmrf")
    ]  # fmt: skip
    for row in [*rows, *analysed["scenes"]]:
        # 0.4 mm voxels: enough to see that there is a core, and none without.
        assert 0.3 < row["slope"]["value"] < 1.4
        assert abs(row["false_contrast_hu"]["value"]) < 25
        assert row["realizations"] == (TINY.scene_n if row["method"] == "qggmrf" else None)
    # Nothing that is exact is drawn.
    assert {len(v["readings"]) for v in measured.vessels.values() if "readings" in v} == {TINY.scene_n}
    assert [m for (m, *_), v in measured.extra.items() if "readings" in v] == ["qggmrf"]


class _Named:
    """A linear method that nobody knows to be linear; ``seen``: autograd can see through it."""

    def __init__(self, seen):
        self.name, self.seen = "mbir_one_step", seen

    def fingerprint(self):
        return str(self.seen)

    def __call__(self, problem, b, exposure_s):
        volume = LinearFilter()(problem, b, exposure_s)
        return volume if self.seen else volume.detach()


@pytest.mark.parametrize("seen", [True, False])
def test_at_a_place_a_linear_method_in_disguise_has_its_exact_figures(scene, folder, seen):
    noise = Realisations(TINY, Store(folder), lambda name: scene)
    places, place = Places(noise), VesselPlace(noise, "curved_5mm")
    exact, drawn = (places.found(m, place, 2.0) for m in (LinearFilter(), _Named(seen)))
    assert drawn["controls"].shape == (TINY.scene_n, 1 if seen else len(TINY.controls), 4)
    for pair in range(2):
        known, found = (Seen.of(f, pair) for f in (exact, drawn))
        for key in ("core", "fibrous", "contrast", "added", "absent", "log_core", "log_contrast", "log_absent"):
            figure, value = getattr(found, key), getattr(known, key)
            assert figure.value == pytest.approx(value, abs=2e-3 if key.startswith("log") else 0.1), key
            assert figure.standard_error < (1e-3 if key.startswith("log") else 0.05), key
        assert found.auc(1.0)["value"] == pytest.approx(known.auc(1.0)["value"], abs=1e-3)
        assert found.log_fat.value == pytest.approx(known.log_fat, abs=0.2)
    # The moments are those of the readings' noise, not of the Gram operator's.
    given = (LinearFilter(), place.problem, place.weights, place.statistics[0] * 2, 2.0, None)
    response, averaged = (linear_response(*given, draws=k) for k in (0, 2))
    torch.testing.assert_close(
        averaged.adjoints, response.adjoints, rtol=1e-3, atol=1e-3 * response.adjoints.abs().max()
    )
    ratio = np.diag(exact["covariance"]) / np.diag(response.covariance)
    assert (np.abs(ratio - 1) < 0.1).all()
    assert (np.abs(ratio - 1) > 1e-4).all()


def as_if_drawn(measured, **changes):
    """The nonlinear method's samples replaced by those of a control, with every reading changed as told."""
    c = measured.controls[2.0]
    rows = c["readings"].shape[1] // len(TINY.controls)
    samples = {}
    for k, name in enumerate(MAIN_SCENES):
        readings = c["readings"][:, :rows] + (c["mean"][k] - c["mean"][0])[:rows]
        found = {key: v for key, v in measured.samples["qggmrf", name, 2.0].items()}
        samples["qggmrf", name, 2.0] = {**found, "readings": changes.get("readings", lambda r: r)(readings)}
    return replace(measured, samples=samples)


def test_a_linear_method_in_disguise_has_its_exact_figures(measured):
    exact = Exact(measured)
    drawn, known = (f for f in (drawn_figures(as_if_drawn(measured), "qggmrf", 2.0, exact.truth),
                                exact.figures("linear", 2.0)))  # fmt: skip
    for key in ("log_core", "log_fibrous", "log_contrast"):
        for a, b in zip(getattr(drawn, key), getattr(known, key), strict=True):
            assert a.value == pytest.approx(b, abs=1e-6)
            assert a.standard_error < 1e-6
    for name in MAIN_SCENES[:2]:
        assert [m.value for m in drawn.means[name]] == pytest.approx(known.means[name], abs=1e-3)
    for observer, value in known.log_detectability.items():
        assert drawn.log_detectability[observer].value == pytest.approx(value, abs=1e-6)
    for name, value in known.slopes.items():
        assert drawn.slopes[name].value == pytest.approx(value, abs=1e-5)


def test_a_method_controlled_by_its_own_response_has_its_exact_figures(measured, folder):
    run = study._Study(TINY, Store(folder), lambda name, part: None)
    response = run._response(_Named(True), 2.0)
    assert run._response(_Named(False), 2.0) is None
    found = replace(as_if_drawn(measured), responses={("qggmrf", 2.0): response})
    # The readings of the same draws, seen by the gradient alone; g·b leaves the background out.
    gap = found.samples["qggmrf", "paper", 2.0]["readings"] - response["readings"]
    assert gap.std(0).max() < 2e-3 * response["readings"].std(0).max()
    exact = Exact(measured)
    drawn, known = drawn_figures(found, "qggmrf", 2.0, exact.truth), exact.figures("linear", 2.0)
    for key in ("log_core", "log_fibrous", "log_contrast"):
        for a, b in zip(getattr(drawn, key), getattr(known, key), strict=True):
            assert a.value == pytest.approx(b, abs=2e-3)
            assert a.standard_error < 1e-3
    for observer, value in known.log_detectability.items():
        assert drawn.log_detectability[observer].value == pytest.approx(value, abs=5e-3)


def test_shrunk_contrast_is_corrected_and_bias_is_reported(measured):
    exact = Exact(measured)
    known = exact.figures("linear", 2.0)
    shrunk = drawn_figures(as_if_drawn(measured, readings=lambda r: 0.5 * r + 20.0), "qggmrf", 2.0, exact.truth)
    for k in range(len(ROIS)):
        a, b = (f.log_corrected(k, exact.difference) for f in (shrunk, known))
        assert a.value == pytest.approx(b, abs=1e-5)
        assert shrunk.means["paper"][2 * k].value == pytest.approx(0.5 * known.means["paper"][2 * k] + 20.0, abs=1e-3)
        assert shrunk.slope(k, 1.0).value == pytest.approx(0.5 * known.slope(k, 1.0), abs=1e-5)


def test_detectability_is_free_of_the_bias_of_few_draws():
    rng = np.random.default_rng(2)
    true, found = 2.0, []
    for _ in range(300):
        noise = rng.standard_normal((24, 6)) @ np.diag([1, 2, 3, 1, 2, 3])
        delta = np.array([true, 0, 0, 0, 0, 0])
        found.append(math.exp(log_detectability(noise + delta, noise).value))
    # Without the factors of the inverse Wishart matrix the mean would be 23 / 16 of it.
    assert np.mean(found) == pytest.approx(true**2, rel=0.1)
    with pytest.raises(ValueError, match="use at least 11"):
        log_detectability(noise[:10], noise[:10])


def test_true_volume_and_regions(scene):
    hu = scene.facts.tissue_hu
    truth, outside = true_volume(scene, scene.grid, hu)
    assert outside.min() == 0.0
    assert outside.max() == 1.0
    assert float(truth.max()) == pytest.approx(hu["lumen"])
    assert truth[torch.from_numpy(outside == 1.0)].numpy() == pytest.approx(hu["patient"])
    readings = Readings(scene, scene.grid, hu)
    assert readings.squares(truth[None]).max() == pytest.approx(0.0, abs=1e-9)
    assert readings.fat(truth[None]) == pytest.approx(hu["patient"], rel=1e-6)
    ramp = truth + 3.0
    assert readings.squares(ramp[None])[0] == pytest.approx([9.0, 9.0])


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

    with pytest.raises(ValueError, match=r"'broken'.*paper_2s.*--methods"):
        reconstructed(Broken(), scene.problem, clean_b[None], 2.0, scene.store, "paper_2s", "")


def test_parts_of_a_long_method_are_kept_until_their_block_is(scene, clean_b, tmp_path):
    class Long:
        name, calls = "tv", 0

        def __call__(self, problem, b, exposure_s):
            self.calls += 1
            if self.calls == 3:
                raise KeyboardInterrupt
            return 2.0 * b

    method, store = Long(), Store(tmp_path)
    b = torch.stack([clean_b * (1 + k) for k in range(5)])
    with pytest.raises(KeyboardInterrupt):
        reconstructed(method, scene.problem, b, 2.0, store, "tv/0-5", "key")
    assert sorted(p.name for p in (tmp_path / "tv/0-5").iterdir()) == ["0.npz", "2.npz"]
    volume, seconds = reconstructed(method, scene.problem, b, 2.0, store, "tv/0-5", "key")
    assert method.calls == 4  # the last part alone was missing
    assert torch.equal(volume, 2.0 * b)
    assert seconds > 0
    store.drop("tv/0-5")
    assert not list((tmp_path / "tv").iterdir())


def test_a_long_linear_method_keeps_its_calls_in_their_order(scene, clean_b, tmp_path, monkeypatch):
    class Linear:
        name, seen = "quadratic", 0

        def __call__(self, problem, b, exposure_s):
            self.seen += len(b)
            return 2.0 * b

    monkeypatch.setattr("recon.study.dose_factor.reconstructed.LINEAR_PART", 2)
    method, store = Linear(), Store(tmp_path)
    b = torch.stack([clean_b * (1 + k) for k in range(5)])
    for _ in range(2):  # the second time all is there
        run = in_parts(method, store, "exact/quadratic", "key")
        with torch.no_grad():
            assert torch.equal(run(scene.problem, b, 2.0), 2.0 * b)
            assert torch.equal(run(scene.problem, b[:1] + 1.0, 2.0), 2.0 * (b[:1] + 1.0))
        assert method.seen == 6
    names = {p.name for p in (tmp_path / "exact/quadratic").iterdir()}
    assert names == {"0_0.npz", "0_2.npz", "0_4.npz", "1_0.npz"}
    leaf = b[:1].clone().requires_grad_()
    assert run(scene.problem, leaf, 2.0).requires_grad  # autograd sees through it
    method.name = "linear"
    assert in_parts(method, store, "exact/linear", "key") is method


def test_wider_rois(analysed, scene):
    x = scene.core_center[2]
    readings = Readings(scene, scene.grid, scene.facts.tissue_hu)
    # A linear ramp reads as the mean position of the mask.
    ramp = torch.from_numpy(np.broadcast_to(scene.grid.axes[2], scene.grid.shape).copy())
    found = readings.linear(ramp[None])[0]
    sds = []
    for k, name in enumerate(ROIS):
        pair = scene.pair_of(name)
        at = [np.mean(np.broadcast_to(pair.image.axes[2], m.shape)[m]) for m in (pair.foreground, pair.background)]
        np.testing.assert_allclose(found[2 * k : 2 * k + 2], at, atol=1e-6)
        assert abs(at[0] - x) < 0.1 < abs(at[1] - x)
        sds.append(entry(analysed, "FBP soft 0.25 mm")["rois"][name]["corrected_sd_hu"]["value"])
    # More data in the ROI, less noise.
    assert sds[0] > sds[1] > sds[2]
    with pytest.raises(ValueError, match="rois must be of section, tissue"):
        scene.wide_rois("vessel")


def test_rougher_outlines_raise_the_limit(analysed):
    sds = [e["contrast_sd_hu"] for e in analysed["shape_limits"]]
    ideal = analysed["limits"][0]["contrast_sd_hu"]
    assert sds[0] < sds[1] < sds[2]
    # Voxels of 0.4 mm and the Gram operator describe the known shapes about as well as exact path lengths.
    assert sds[0] == pytest.approx(ideal, rel=0.25)


def test_worst_case_gain_of_fbp(analysed):
    gains = analysed["worst_case_gains"]
    assert [g["exposure_s"] for g in gains] == [2.0]
    # A sharper kernel answers more.
    soft, standard = (gains[0][f"FBP {k} 0.25 mm"] for k in ("soft", "standard"))
    assert 0 < soft < standard


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
    assert noise.images(2.0, range(2)).shape == (2, *b.shape)
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
