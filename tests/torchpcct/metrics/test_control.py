"""Control variates: least squares by another way, the coverage of the intervals, and what is
refused."""

import math

import numpy as np
import pytest
from refusals import refused

from torchpcct.metrics import (
    Jackknifed,
    combined,
    controlled_log_variance,
    controlled_mean,
)
from torchpcct.metrics.intervals import log_of_sum

SIGMA = np.array([[1.0, 0.3], [0.3, 2.0]])
MU = np.array([3.0, -1.0])


def draws(n, correlation=0.97, kind="normal", seed=0, beta=(0.8, 0.2)):
    """y, x and the true variance of y."""
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((n, 2)) @ np.linalg.cholesky(SIGMA).T
    explained = np.array(beta) @ SIGMA @ beta
    rest = explained * (1 / correlation**2 - 1)
    e = rng.standard_t(6, n) / math.sqrt(1.5) if kind == "tails" else rng.standard_normal(n)
    bent = 0.05 * (x[:, 0] ** 2 - 1) if kind == "bent" else 0.0
    y = 5.0 + x @ beta + math.sqrt(rest) * e + bent
    return y, x + MU, explained + rest + (2 * 0.05**2 if kind == "bent" else 0.0)


def refitted(y, x, k):
    """Both figures of ordinary least squares by numpy, realisation k left out (None: none)."""
    keep = np.arange(len(y)) != (-1 if k is None else k)
    y, x = y[keep], x[keep]
    n, m = x.shape
    design = np.c_[np.ones(n), x - MU]
    coefficients, residual, *_ = np.linalg.lstsq(design, y, rcond=None)
    rest = residual[0] / (n - m - 1)
    slopes = coefficients[1:]
    return coefficients[0], slopes @ SIGMA @ slopes + rest * (1 - m / (n - m - 2))


def test_closed_forms_are_refits():
    y, x, _ = draws(15)
    mean, variance = controlled_mean(y, x, MU), controlled_log_variance(y, x, SIGMA)
    own = refitted(y, x, None)
    assert (mean.value, math.exp(variance.value)) == pytest.approx(own, rel=1e-12)
    for k in range(15):
        a, v = refitted(y, x, k)
        assert mean.left_out[k] == pytest.approx(a, rel=1e-11)
        assert math.exp(variance.left_out[k]) == pytest.approx(v, rel=1e-11)


def test_variance_is_unbiased():
    """Mean over 1500 experiments of 12 draws, where the correction for the error of β is 7 % of
    the variance."""
    found = [
        math.exp(controlled_log_variance(*draws(12, 0.8, seed=s)[:2], SIGMA).value)
        for s in range(1500)
    ]
    true = draws(12, 0.8)[2]
    assert np.mean(found) == pytest.approx(true, abs=3.5 * np.std(found) / math.sqrt(1500))
    assert np.std(found) / math.sqrt(1500) < 0.015 * true


def test_without_controls():
    y, _, _ = draws(30)
    assert controlled_mean(y, None, None).value == pytest.approx(y.mean())
    assert controlled_log_variance(y, None).value == pytest.approx(math.log(y.var(ddof=1)))
    error = controlled_mean(y, None, None).standard_error
    assert error == pytest.approx(y.std(ddof=1) / math.sqrt(30))  # the jackknife of a mean is exact


def test_a_linear_method_is_exact():
    """Nothing is left of the sampling error of a method that the controls explain wholly."""
    _, x, _ = draws(20)
    y = 7.0 + (x - MU) @ [0.5, -2.0]
    mean, log_variance = controlled_mean(y, x, MU), controlled_log_variance(y, x, SIGMA)
    assert mean.estimate() == pytest.approx((7.0, 7.0, 7.0), abs=1e-10)
    true = np.array([0.5, -2.0]) @ SIGMA @ [0.5, -2.0]
    assert log_variance.exponential() == pytest.approx((true, true, true), rel=1e-9)


@pytest.mark.parametrize(("correlation", "width"), [(0.0, 1.217), (0.97, 1.069), (0.999, 1.0125)])
def test_half_width_of_a_factor(correlation, width):
    """×1.22, ×1.07, ×1.01 at n = 200, as exp(z √(2 (1 − R⁴) / n)); the intervals of simulated
    experiments have it."""
    assert math.exp(1.96 * math.sqrt(2.0 * (1.0 - correlation**4) / 200)) == pytest.approx(
        width, abs=1e-3
    )
    found = []
    for s in range(60):
        y, x, _ = draws(200, correlation or 0.97, seed=s)
        f = controlled_log_variance(y, *((x, SIGMA) if correlation else (None,))).exponential()
        found.append(math.log(f.high / f.low) / 2)
    assert math.exp(np.mean(found)) - 1 == pytest.approx(width - 1, rel=0.08)


def paper_cnr(y, z, x):
    means = [controlled_mean(v, x, MU) for v in (y, z)]
    logs = [controlled_log_variance(v, x, SIGMA) for v in (y, z)]
    return combined(lambda f, b, vf, vb: (b - f) / np.sqrt(np.exp(vf) + np.exp(vb)), *means, *logs)


@pytest.mark.parametrize(
    ("experiments", "low", "high"),
    [(150, 0.89, 1.0), pytest.param(1000, 0.93, 0.97, marks=pytest.mark.slow)],
)
@pytest.mark.parametrize("kind", ["normal", "tails", "bent"])
def test_coverage(kind, experiments, low, high):
    """Of experiments of 200 draws: variance, mean and CNR within 93–97 % (binomial error of
    1000: 0.7 %)."""
    hits = np.zeros(3)
    for s in range(experiments):
        y, x, true = draws(200, 0.97, kind, seed=s)
        z = (
            9.0
            + (x - MU) @ [0.1, 0.7]
            + np.random.default_rng(10_000 + s).standard_normal(200) * 0.2
        )
        true_z = np.array([0.1, 0.7]) @ SIGMA @ [0.1, 0.7] + 0.04
        figures = (
            (controlled_log_variance(y, x, SIGMA).exponential(), true),
            (controlled_mean(y, x, MU).estimate(), 5.0),
            (paper_cnr(y, z, x).estimate(), 4.0 / math.sqrt(true + true_z)),
        )
        hits += [f.low <= t <= f.high for f, t in figures]
    assert (low * experiments <= hits).all(), hits
    assert (hits <= high * experiments).all(), hits


def test_pairs_of_methods():
    """A factor of two methods of the same draws: what they share cancels, and the interval says
    so."""
    y, _, _ = draws(200, 0.9)
    first, second = controlled_log_variance(y, None), controlled_log_variance(2.0 * y + 1.0, None)
    assert combined(np.subtract, second, first).exponential() == pytest.approx((4.0, 4.0, 4.0))
    alone = combined(lambda v: second.value - v, first).exponential()
    assert alone.high / alone.low > 1.4


def test_combined_and_sums():
    y, _, _ = draws(20)
    parts = np.square(y - y.mean())
    log = log_of_sum(parts, lost=1)
    assert log.value == pytest.approx(math.log(y.var(ddof=1)))
    np.testing.assert_allclose(
        log.left_out, [math.log(np.delete(y, k).var(ddof=1)) for k in range(20)]
    )
    mean = log_of_sum(np.square(y))
    np.testing.assert_allclose(
        mean.left_out, [math.log(np.square(np.delete(y, k)).mean()) for k in range(20)]
    )
    assert combined(np.subtract, log, log).estimate() == pytest.approx((0, 0, 0))
    half = log.exponential(scale=-0.5)
    assert half.low < half.value < half.high


def test_refusals():
    y, x, _ = draws(20)
    refused(
        ("controls must be", lambda: controlled_mean(y, x[:10], MU)),
        ("at least 7 realisations", lambda: controlled_mean(y[:6], x[:6], MU)),
        ("one per control", lambda: controlled_mean(y, x, [1.0])),
        ("linearly dependent", lambda: controlled_mean(y, np.c_[x, x[:, 0]], [3, -1, 3])),
        ("NaN", lambda: controlled_mean(np.full(20, np.nan), x, MU)),
        (r"\(2, 2\)", lambda: controlled_log_variance(y, x, 1.0)),
        ("no covariance", lambda: controlled_log_variance(y, x, [[1.0, 2.0], [2.0, 1.0]])),
        ("do not vary", lambda: controlled_log_variance(np.ones(20), None)),
        (
            "same realisations",
            lambda: combined(np.subtract, Jackknifed(1.0, y), Jackknifed(1.0, y[:5])),
        ),
    )
