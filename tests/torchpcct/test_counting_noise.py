"""Counting noise: right distribution, and a pure function of (seed, reading)."""

import numpy as np
import pytest
import torch
from scipy import stats

from torchpcct.counting_noise import normal, poisson, split, thinned


def assert_poisson(draws, mean):
    """Whole numbers of the mean, variance and histogram of a Poisson law."""
    n = draws.size
    assert (draws == np.round(draws)).all()
    assert draws.min() >= 0
    assert abs(draws.mean() - mean) < 4.5 * np.sqrt(mean / n)
    # Var of the sample variance of a Poisson law: (mu4 - var²)/n with mu4 = mean + 3 mean²
    assert abs(draws.var() - mean) < 4.5 * np.sqrt((mean + 2 * mean**2) / n)
    edges = np.unique(np.linspace(*stats.poisson.ppf([1e-3, 1 - 1e-3], mean), 24).astype(int))
    expected = np.diff(np.concatenate([[0], stats.poisson.cdf(edges, mean), [1]])) * n
    observed = np.histogram(draws, bins=np.concatenate([[-1], edges + 0.5, [np.inf]]))[0]
    keep = expected > 10
    chi2 = ((observed - expected)[keep] ** 2 / expected[keep]).sum()
    assert chi2 < stats.chi2.ppf(1 - 1e-5, keep.sum())


@pytest.mark.parametrize("mean", [0.03, 0.7, 4.0, 9.99, 10.0, 37.3, 115.0, 16070.0, 3e6])
def test_poisson_distribution(mean):
    assert_poisson(
        poisson(torch.full((1, 400_000), mean, dtype=torch.float64), [0], seed=3).numpy().ravel(),
        mean,
    )


def test_seeds_and_neighbours_are_uncorrelated():
    mean = torch.full((200, 1000), 50.0)
    index = np.arange(200) * 1000
    a, b = (poisson(mean, index, seed=s).numpy() - 50 for s in (0, 1))
    bound = 4.5 / np.sqrt(a.size) * 50
    assert abs((a * b).mean()) < bound
    assert abs((a[:, 1:] * a[:, :-1]).mean()) < bound
    assert abs((a[1:] * a[:-1]).mean()) < bound


def test_normal():
    z = normal((100, 3000), np.arange(100) * 3000, seed=5, dtype=torch.float64).numpy().ravel()
    assert stats.kstest(z, "norm").pvalue > 1e-4


@pytest.mark.parametrize(("seed", "error"), [(-1, ValueError), (1.5, TypeError), (True, TypeError)])
def test_bad_seed_and_index(seed, error):
    with pytest.raises(error, match="seed"):
        poisson(torch.ones(1, 1), [0], seed=seed)
    with pytest.raises(ValueError, match="first_index"):
        poisson(torch.ones(2, 1), [0], seed=0)


@pytest.mark.parametrize("fraction", [0.02, 0.25, 0.5, 0.9])
@pytest.mark.parametrize("mean", [0.4, 7.0, 60.0, 16070.0])
def test_thinned_poisson_counts_are_poisson_of_the_lower_dose(mean, fraction):
    n, index = 100_000, [0]
    full = poisson(torch.full((1, n), mean, dtype=torch.float64), index, seed=3)
    draws = thinned(full, index, 3, fraction)
    assert (draws <= full).all()
    low, rest = draws.numpy().ravel(), (full - draws).numpy().ravel()
    assert_poisson(low, mean * fraction)
    # What stays and what goes of Poisson counts are independent, also where both were drawn with
    # one seed.
    assert abs(np.corrcoef(low, rest)[0, 1]) < 4.5 / np.sqrt(n)


def test_thinned_readings_that_are_no_counts_have_the_right_moments():
    n, fraction, mean, quantum, electronic = 200_000, 0.3, 40.0, 2.5, 3.0
    signal = quantum * poisson(torch.full((1, n), mean, dtype=torch.float64), [0], seed=1)
    signal += electronic * normal((1, n), [0], 1, torch.float64, purpose=1)
    low = (
        thinned(signal, [0], 1, fraction, torch.full_like(signal, quantum), electronic)
        .numpy()
        .ravel()
    )
    expected, variance = fraction * quantum * mean, fraction * quantum**2 * mean + electronic**2
    assert abs(low.mean() - expected) < 4.5 * np.sqrt(variance / n)
    # Rounding to whole quanta adds up to a quarter of quantum² · fraction².
    assert (
        -0.03 * variance < low.var() - variance < 0.03 * variance + 0.25 * (quantum * fraction) ** 2
    )


@pytest.mark.parametrize("fraction", [0.2, 0.7])
def test_electronic_noise_is_the_same_at_any_dose(fraction):
    """A fraction f of it is left: √(1 − f²) of it is to be added, not √(1 − f)."""
    n, mean, quantum, electronic = 100_000, 4000.0, 0.5, 40.0
    signal = quantum * poisson(torch.full((1, n), mean, dtype=torch.float64), [0], seed=1)
    signal += electronic * normal((1, n), [0], 1, torch.float64, purpose=1)
    low = (
        thinned(signal, [0], 1, fraction, torch.full_like(signal, quantum), electronic)
        .numpy()
        .ravel()
    )
    variance = fraction * quantum**2 * mean + electronic**2
    assert (
        abs(low.var() / variance - 1.0)
        < 4.5 * np.sqrt(2.0 / n) + 0.25 * (quantum * fraction) ** 2 / variance
    )


def test_a_window_is_thinned_as_the_whole():
    counts = poisson(torch.full((6, 50), 80.0), np.arange(6) * 50, seed=11)
    full = thinned(counts, np.arange(6) * 50, 4, 0.6)
    assert torch.equal(
        thinned(counts[2:5, 7:30], np.arange(2, 5) * 50 + 7, 4, 0.6), full[2:5, 7:30]
    )


@pytest.mark.parametrize("mean", [2.0**31, 9.9e11, 1e12, 2.0**53, 2.0**63, 2.0**64, 1e25])
@pytest.mark.parametrize("fraction", [1e-12, 1e-9, 1e-3, 0.4, 0.97])
def test_counts_beyond_every_integer_keep_mean_and_variance(mean, fraction):
    """No whole number of 32, 53 or 63 bits ends them, and none is negative or more than there
    were."""
    n = 20_000
    full = torch.full((1, n), mean, dtype=torch.float64)
    draws = poisson(full, [0], seed=3).numpy()
    kept = thinned(full, [0], 3, fraction).numpy()
    assert kept.min() >= 0
    assert kept.max() <= mean
    for values, centre, variance in (
        (draws, mean, mean),
        (kept, mean * fraction, mean * fraction * (1 - fraction)),
    ):
        assert abs((values - centre).mean()) < 4.5 * np.sqrt(variance / n) + 1e-9 * np.sqrt(
            variance
        )
        # Fourth moment of few counts: variance · (1 + 3 variance).
        assert abs(values.var() / variance - 1) < 4.5 * np.sqrt((2 + 1 / variance) / n)


def test_infinite_expectations_are_no_numbers():
    values = torch.tensor([[np.inf, np.nan, 0.0, 5.0]], dtype=torch.float64)
    assert torch.isnan(poisson(values, [0], 0))[0].tolist() == [True, True, False, False]
    assert torch.isnan(thinned(values, [0], 0, 0.5))[0].tolist() == [True, True, False, False]
    assert torch.isnan(
        poisson(torch.full((1, 2), 1e300, dtype=torch.float64), [0], 0, scale=1e10)
    ).all()


@pytest.mark.parametrize("total", [0.8, 40.0, 16070.0])
def test_bins_that_a_sum_is_split_into_are_independent_poisson_counts(total):
    """Their sum is what was given; each is Poisson of its share, and none tells of another."""
    n, shares = 100_000, torch.tensor([0.55, 0.05, 0.0, 0.4], dtype=torch.float64)
    given = poisson(torch.full((1, n), total, dtype=torch.float64), [0], seed=3)
    expected = (total * shares).reshape(-1, 1, 1).expand(-1, 1, n)
    bins = split(given, expected, [0], seed=3)
    assert torch.equal(bins.sum(0), given)
    assert (bins[2] == 0).all()
    for k in (0, 1, 3):
        assert_poisson(bins[k].numpy().ravel(), total * float(shares[k]))
    seen = np.corrcoef(bins[[0, 1, 3], 0].numpy())
    assert np.abs(seen[np.triu_indices(3, 1)]).max() < 4.5 / np.sqrt(n)
    assert torch.equal(split(given, expected, [0], seed=3), bins)
    assert not torch.equal(split(given, expected, [0], seed=4), bins)


def test_bins_of_nothing_and_of_what_is_no_count():
    counts = torch.tensor([[3.0, 0.0, -1.0, 2.0]])
    expected = torch.tensor([[[1.0, 0.0, 1.0, 0.0]], [[0.0, 0.0, 1.0, 0.0]]])
    bins = split(counts, expected, [0], seed=0)
    assert bins[:, 0, 0].tolist() == [3.0, 0.0]
    assert bins[:, 0, 1].tolist() == [0.0, 0.0]
    assert bins[0, 0, 2:].isnan().all()
    with pytest.raises(ValueError, match=r"\(bins, …\)"):
        split(counts, expected[0], [0], seed=0)
