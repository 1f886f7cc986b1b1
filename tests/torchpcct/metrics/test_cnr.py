"""The paper's CNR and its intervals."""

import numpy as np
import pytest

from recon.study.paper import published as paper
from torchpcct.metrics import cnr, cnr_from_moments, cnr_interval, sd_interval


def test_paper_table_from_its_own_moments():
    fg, bg = paper.FOREGROUND, paper.BACKGROUND
    ours = cnr_from_moments(fg[..., 0], fg[..., 1], bg[..., 0], bg[..., 1])
    assert ours.shape == (4, 5)
    np.testing.assert_allclose(ours, paper.CNR, atol=0.01)


def test_definition_by_hand():
    assert cnr([1.0, 3.0], [11.0, 15.0]) == pytest.approx((13 - 2) / np.sqrt(2 + 8))
    batch = cnr(np.array([[1.0, 3.0], [2.0, 6.0]]), np.array([[11.0, 15.0], [22.0, 30.0]]))
    np.testing.assert_allclose(batch, [(13 - 2) / np.sqrt(10)] * 2)


def test_sd_interval_matches_the_known_factors():
    low, high = sd_interval(1.0, 10)
    assert (low, high) == (pytest.approx(0.688, abs=1e-3), pytest.approx(1.826, abs=1e-3))


@pytest.mark.parametrize(("n", "rho"), [(5, 0.0), (10, 0.0), (10, 0.7), (50, -0.5)])
def test_interval_coverage(n, rho):
    """Nominally 95 %; of 6000 experiments with n = 5 and independent means it was 92.8 %, as the
    docstring says."""
    rng = np.random.default_rng(8)
    sd_fg, sd_bg = 10.0, 20.0
    truth = 50 / np.hypot(sd_fg, sd_bg)
    cov = [[sd_fg**2, rho * sd_fg * sd_bg], [rho * sd_fg * sd_bg, sd_bg**2]]
    covered = 0
    for seed, (fg, bg) in enumerate(
        rng.multivariate_normal([40, 90], cov, (600, n)).swapaxes(1, 2)
    ):
        low, high = cnr_interval(fg, bg, draws=1000, seed=seed)
        covered += low <= truth <= high
    assert 0.90 <= covered / 600 <= 0.98  # a percentile bootstrap of 10 pairs covers 0.82
