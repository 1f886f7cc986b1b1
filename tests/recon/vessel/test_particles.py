"""Sequential Monte Carlo against a Gaussian posterior, whose evidence is known."""

import math

import numpy as np
import pytest

from recon.vessel.particles import sample_towards

MEAN = np.array([1.0, -0.5, 0.3])
SD = np.array([0.2, 0.5, 0.1])


def prior(x):
    return -0.5 * (x**2).sum(1), np.zeros(len(x))


def posterior(x):
    return prior(x)[0], -0.5 * (((x - MEAN) / SD) ** 2).sum(1)


def exact(sd):
    """Mean, variance and log evidence of a standard normal prior times exp(−½ ((x − m) / sd)²)."""
    variance = 1 / (1 + sd**-2.0)
    log = (0.5 * np.log(variance) - 0.5 * MEAN**2 / (1 + sd**2)).sum()
    return MEAN * variance / sd**2, variance, log


def test_gaussian_posterior_and_its_evidence():
    rng = np.random.default_rng(0)
    found = [sample_towards(rng.standard_normal((400, 3)), prior, posterior, rng) for _ in range(8)]
    mean, variance, log = exact(SD)
    points = np.concatenate([c.points for c in found])
    assert np.allclose(points.mean(0), mean, atol=0.15 * np.sqrt(variance))
    assert np.allclose(points.var(0), variance, rtol=0.15)
    assert np.mean([c.log_evidence for c in found]) == pytest.approx(log, abs=0.25)


def test_from_one_posterior_to_another():
    rng = np.random.default_rng(1)

    def wider(x):
        return prior(x)[0], -0.5 * (((x - MEAN) / (2 * SD)) ** 2).sum(1)

    first = sample_towards(rng.standard_normal((2000, 3)), prior, wider, rng)
    second = sample_towards(first.points, wider, posterior, rng, log_evidence=first.log_evidence)
    assert second.log_evidence == pytest.approx(exact(SD)[2], abs=0.4)
    assert np.allclose(second.points.mean(0), exact(SD)[0], atol=0.15)


def test_what_the_prior_excludes_is_never_reached():
    rng = np.random.default_rng(2)

    def half(x):
        return np.where(x[:, 0] > 0, prior(x)[0], -math.inf), np.zeros(len(x))

    def target(x):
        return half(x)[0], -0.5 * ((x[:, 0] + 1) / 0.1) ** 2

    assert (
        sample_towards(np.abs(rng.standard_normal((200, 3))), half, target, rng).points[:, 0] > 0
    ).all()
