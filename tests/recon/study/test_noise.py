"""The noise study: exact moments, realisations without reconstruction, and what few runs
establish."""

import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from tiny_studies import TINY, assert_report_is_whole

from recon.analytic.exact_noise import roi_adjoints, roi_covariance, voxel_covariance
from recon.analytic.inset import InsetFbp
from recon.study.noise import (
    NoiseSettings,
    RoiStatistics,
    few_run_tables,
    measured_table,
    pair_differences,
    published,
    resampled_tables,
    table_checks,
)
from recon.study.paper import published as paper
from recon.study.paper.plaque_scan import inset_grid
from torchpcct.metrics.intervals import resampling
from torchpcct.metrics.placement import RoiRule, place_rois
from torchpcct.metrics.roi import axial_grid
from torchpcct.scene.plaque import plaque_scene


@pytest.fixture
def measured(tiny):
    return tiny("noise").measured.seen


# --- the study ------------------------------------------------------------------------------------


def test_realisations_without_reconstruction_are_those_of_fbp(tiny):
    check = tiny("noise").measured.data["full_reconstructions"]
    assert check["reconstructed"] == 2
    assert check["largest_difference_in_sd"] < 0.03


AXES = NoiseSettings(**TINY["noise"]).axes


def test_joint_covariance_holds_the_covariances_of_every_setting(measured):
    scanned = measured.scanned
    single = list(
        itertools.chain.from_iterable(
            roi_covariance(scanned.clean, scanned.fbp, scanned.pairs, 1.0)
        )
    )
    joint = measured.covariance
    assert [(k, v) for v in (0.25, 0.40) for k in ("soft", "bone")] == AXES
    for i, matrix in enumerate(single):
        np.testing.assert_allclose(joint[2 * i : 2 * i + 2, 2 * i : 2 * i + 2], matrix, rtol=2e-4)
    np.testing.assert_allclose(joint, joint.T, rtol=1e-6)
    assert np.linalg.eigvalsh(joint).min() > -1e-6 * np.trace(joint)


def test_realisations_follow_the_exact_law(measured):
    """Whitened by the exact covariance, the deviations are standard normal: χ² of all settings
    together."""
    for exposure, values in measured.means.items():
        deviation = (values - measured.expected).reshape(len(values), -1)
        root = np.linalg.cholesky(measured.covariance / exposure)
        white = np.linalg.solve(root, deviation.T)
        assert (white**2).mean() == pytest.approx(1.0, abs=4.5 * np.sqrt(2 / white.size))


def test_adjoint_vectors_of_the_grids_share_one_window(measured):
    scanned = measured.scanned
    adjoints = roi_adjoints(scanned.clean, scanned.fbp, scanned.pairs)
    assert [tuple(v.shape[:2]) for v in adjoints.vectors] == [(2, 2), (2, 2)]
    assert adjoints.matrix.shape[0] == 8
    assert adjoints.window.rows < scanned.clean.window.rows
    whole = replace(
        scanned.clean,
        counts=torch.ones(scanned.clean.geometry.shape),
        window=None,
        exterior=None,
        region=None,
    )
    with pytest.raises(ValueError, match="windowed"):
        whole.crop(adjoints.window)
    with pytest.raises(ValueError, match="windowed"):
        roi_adjoints(whole, scanned.fbp, scanned.pairs)


def test_covariance_of_a_voxel_is_that_of_two_functionals(measured):
    scanned = measured.scanned
    fbp = InsetFbp(scanned.clean, scanned.grids[:1], ["soft"])
    (grid,) = fbp.grids
    here = tuple(n // 2 for n in grid.shape)
    there = (here[0], here[1] + 1, here[2] - 2)
    found = voxel_covariance(scanned.clean, fbp, 2.0, here)
    assert found.shape == grid.shape
    singles = torch.zeros(2, *grid.shape, dtype=torch.float64)
    singles[0][here] = singles[1][there] = 1.0
    ((exact,),) = roi_covariance(
        scanned.clean, fbp, [[SimpleNamespace(weights=w) for w in singles]], 2.0
    )
    assert [float(found[here]), float(found[there])] == pytest.approx(exact[0].tolist(), rel=1e-3)
    with pytest.raises(ValueError, match="one grid with one kernel"):
        voxel_covariance(scanned.clean, scanned.fbp, 2.0, here)


def test_noise_falls_with_the_square_root_of_dose(tiny):
    found = tiny("noise").measured.data["noise_against_dose"]
    assert np.all(np.abs(found["slopes"] + 0.5) < 0.015)
    assert 0.9 < found["variance_ratios"][0] < found["variance_ratios"][1] < 1.1


def test_report(tiny, tmp_path):
    sections = ("## Which rankings are established", "## Agreement", "## What was modelled")
    data = assert_report_is_whole(
        tiny("noise"), tmp_path, {"noise_images.png", "noise_cnr.png"}, sections
    )
    assert len(data["doses"]["1x"]) == 4
    assert data["pairs"]["pairs"] == 6
    assert sum(data["ten_run_experiments"]["winners"].values()) == pytest.approx(1.0)
    means = tiny("noise").measured.seen.means[2.0][:10, 1]  # of the first ten runs, bone at 0.25 mm
    row = data["doses"]["5.7x"][1]["ten_runs"]
    assert row["cnr"] == pytest.approx(
        (means[:, 1] - means[:, 0]).mean() / np.hypot(*means.std(0, ddof=1))
    )
    assert row["cnr_interval"][0] < row["cnr"] < row["cnr_interval"][1]


# --- statistics -----------------------------------------------------------------------------------

MEAN = np.array([[40.0, 90.0], [45.0, 95.0], [50.0, 85.0]])


def _covariance(seed=0):
    a = np.random.default_rng(seed).normal(size=(6, 6))
    return a @ a.T * 10 + 20 * np.eye(6)


def exact_table(covariance):
    return RoiStatistics(MEAN, np.sqrt(np.diag(covariance)).reshape(MEAN.shape))


def test_few_run_tables_have_the_moments_of_their_law():
    covariance = _covariance()
    table = few_run_tables(MEAN, covariance, 20_000, seed=1)
    sd = np.sqrt(np.diag(covariance)).reshape(3, 2)
    np.testing.assert_allclose(table.mean.mean(0), MEAN, atol=5 * sd.max() / np.sqrt(200_000))
    np.testing.assert_allclose((table.sd**2).mean(0), sd**2, rtol=0.02)
    # The mean of ten correlated runs keeps their correlation.
    flat = table.mean.reshape(-1, 6)
    np.testing.assert_allclose(
        np.cov(flat.T), covariance / 10, atol=0.03 * np.trace(covariance) / 10
    )


def test_resampled_tables_are_the_tables_of_resamples():
    values = np.random.default_rng(0).normal(MEAN, 10.0, (15, 3, 2))
    fast = resampled_tables(values, resampling(15, 40, 5))
    slow = measured_table(values[resampling(15, 40, 5)])
    np.testing.assert_allclose(fast.mean, slow.mean, rtol=1e-10)
    np.testing.assert_allclose(fast.sd, slow.sd, rtol=1e-8)


def test_pairwise_intervals_cover_the_exact_difference():
    """200 experiments of 60 runs: a 90 % interval covers the truth in about 90 % of them."""
    covariance = _covariance(3)
    exact = exact_table(covariance)
    root = np.linalg.cholesky(covariance)
    rng = np.random.default_rng(4)
    hits = 0
    for trial in range(200):
        means = MEAN + (rng.standard_normal((60, 6)) @ root.T).reshape(60, 3, 2)
        pair = pair_differences(means, exact, [(0, 1)], level=0.9, draws=400, seed=trial)[0]
        assert pair.exact == pytest.approx(exact.cnr[0] - exact.cnr[1])
        hits += pair.low <= pair.exact <= pair.high
    assert 0.82 < hits / 200 < 0.96


def test_a_setting_does_not_differ_from_itself():
    means = np.random.default_rng(0).normal(MEAN, 10.0, (20, 3, 2))
    means[:, 1] = means[:, 0]
    pair = pair_differences(means, exact_table(_covariance()), [(0, 1)], draws=100)[0]
    assert (pair.difference, pair.low, pair.high) == (0, 0, 0)
    assert not pair.established


def test_table_checks_are_those_of_the_paper():
    i, j = 0, 1
    means = (paper.FOREGROUND[i, j, 0], paper.BACKGROUND[i, j, 0])
    covariance = np.diag([paper.FOREGROUND[i, j, 1] ** 2, paper.BACKGROUND[i, j, 1] ** 2])
    assert [c.ok for c in table_checks("soft", 0.25, means, covariance)] == [True] * 5
    far = table_checks("soft", 0.25, (means[0] + 11, means[1]), covariance * 4)
    assert [c.ok for c in far] == [False, False, True, False, False]
    assert "standard error" in far[0].note
    assert "with p = " in far[1].note
    assert far[2].note == ""
    assert table_checks("soft", 0.5, means, covariance) == []
    assert published(paper.CNR, "soft", 0.25, 2.0) == 2.20
    assert published(paper.CNR, "soft", 0.25, 0.35) is None


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
