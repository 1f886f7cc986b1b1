"""PWLS against dense float64 solutions, and its hard cases."""

import inset_operators
import pytest
import torch
from inset_operators import HU, minimum, problem, tissue
from refusals import refused

from recon.data_term import Quadratic
from recon.gram.gram import Gram
from recon.least_squares.pwls import minimise, pwls
from recon.least_squares.qggmrf import QGGMRF, quadratic

EDGE = QGGMRF(0.15, 100.0)


@pytest.fixture(scope="module")
def inset():
    A, w = problem(views=120, shape=(4, 9, 9), rows=6)
    gram = Gram(A, w)
    return A, w, gram, noisy(A, w)


def noisy(A, w, seed=0, batch=()):
    clean = A(tissue(A.grid)).expand(*batch, *A.range_shape)
    return (
        clean
        + torch.randn(clean.shape, generator=torch.Generator().manual_seed(seed))
        / w.clamp_min(1e-3).sqrt()
    )


def hu_rms(a, b):
    return float((a.double() - b.double()).square().mean().sqrt()) / HU


@pytest.fixture(scope="module")
def dense(inset):
    return inset_operators.dense(inset[0])


def reference(dense, A, w, y, prior, information):
    """The minimum with dense float64 matrices, to 1e-7 HU."""
    weights = w.double().flatten()
    data = torch.where(w > 0, y, torch.zeros(())).double().flatten()
    H, b = dense.T @ (weights[:, None] * dense), dense.T @ (weights * data)
    return minimum(H, b, prior.bind(information, A.grid.spacing, HU), A.domain_shape, 1e-7 * HU)


@pytest.mark.parametrize(
    "prior", [QGGMRF(0.3, 4.0, relative=True), quadratic(0.01)], ids=["edge-preserving", "weak"]
)
def test_distance_is_right_where_the_model_converges_slowly(prior):
    """A shift-invariant model of few views: each step is a fifth or half of the one before."""
    A, w = problem(views=60, shape=(6, 21, 21), rows=8)
    y = noisy(A, w)
    gram = Gram(A, w, nodes=1)
    bound = prior.bind(gram.information(HU), A.grid.spacing, HU)
    exact = pwls(
        A,
        y.double(),
        w.double(),
        bound,
        mu_per_hu=HU,
        gram=Gram(A, w.double(), nodes=1),
        tolerance=1e-3,
    ).volume
    for tolerance in (2.0, 0.2):
        found = pwls(A, y, w, bound, mu_per_hu=HU, gram=gram, tolerance=tolerance)
        assert found.report["model"] == "gram"
        true = hu_rms(found.volume, exact)
        assert true < tolerance
        assert 0.8 * true < found.report["rmsd_hu"][-1] < 1.5 * true


@pytest.mark.parametrize("prior", [quadratic(0.15), EDGE, QGGMRF(0.5, 30.0, 2.0, 1.2, 6)])
def test_exact_minimum_within_three_pairs(inset, dense, prior):
    A, w, gram, y = inset
    x = reference(dense, A, w, y, prior, gram.information(HU))
    result = pwls(A, y, w, prior, mu_per_hu=HU, gram=gram, max_exact=3, tolerance=0.5)
    assert hu_rms(result.volume, x) < 1.0
    report = result.report
    assert report["converged"]
    assert report["exact_pairs"] <= 3
    tight = pwls(A, y, w, prior, mu_per_hu=HU, gram=gram, tolerance=0.02)
    assert hu_rms(tight.volume, x) < 0.05
    # The reported distance is honest.
    assert hu_rms(result.volume, x) < 3 * report["rmsd_hu"][-1] + 0.02
    assert tight.report["gradient"][-1] < 1e-4


def test_batch_of_realisations(inset):
    A, w, gram, _ = inset
    y = noisy(A, w, 7, (2, 2))
    result = pwls(A, y, w, EDGE, mu_per_hu=HU, gram=gram, tolerance=0.05)
    assert result.volume.shape == (2, 2, *A.domain_shape)
    alone = pwls(A, y[1, 0], w, EDGE, mu_per_hu=HU, gram=gram, tolerance=0.05)
    assert hu_rms(result.volume[1, 0], alone.volume) < 0.1
    assert pwls(A, y[:0], w, EDGE, mu_per_hu=HU, gram=gram).volume.shape == (0, 2, *A.domain_shape)


def masked(w, case):
    gen = torch.Generator().manual_seed(11)
    w = w.clone()
    if case == "dead columns":
        w[:, :, 3] = 0
        w[:, :, 8:10] = 0
    elif case == "missing views":
        w[30:60] = 0
    elif case == "nearly zero":
        w[torch.rand(w.shape, generator=gen) < 0.3] *= 1e-8
    else:
        w[torch.rand(w.shape, generator=gen) < case] = 0
    return w


@pytest.mark.parametrize("case", [0.001, 0.05, 0.5, "dead columns", "missing views", "nearly zero"])
def test_lost_readings(inset, dense, case):
    """Readings of weight 0 may hold anything; the minimum of the remaining ones is found."""
    A, full, _, y = inset
    w = masked(full, case)
    y = torch.where(w > 0, y, torch.full((), torch.nan))
    gram = Gram(A, w)
    x = reference(dense, A, w, y, EDGE, gram.information(HU))
    result = pwls(A, y, w, EDGE, mu_per_hu=HU, gram=gram, tolerance=0.1, max_exact=30)
    assert result.report["converged"]
    assert hu_rms(result.volume, x) < 1.0


def test_low_dose_is_the_same_problem_scaled(inset):
    """1/100 of the dose with the noise in the same units: strength is noise-normalised, so x is
    the same."""
    A, w, gram, y = inset
    full = pwls(A, y, w, quadratic(0.15), mu_per_hu=HU, gram=gram, tolerance=0.02)
    low = pwls(A, y, w / 100, quadratic(0.15), mu_per_hu=HU, gram=gram.scaled(0.01), tolerance=0.02)
    assert hu_rms(full.volume, low.volume) < 0.1


def test_report_and_callback(inset):
    A, w, gram, y = inset
    seen = []
    result = pwls(A, y, w, EDGE, mu_per_hu=HU, gram=gram, callback=seen.append)
    assert [s["rmsd_hu"] for s in seen] == result.report["rmsd_hu"]
    assert result.report["gradient"][0] == pytest.approx(1.0)
    assert len(result.report["inner_iterations"]) == len(seen)
    assert result.report["strength"] == EDGE.strength


def test_from_the_right_hand_side(inset):
    """The problem of the model, without a projector, is close to the exact one."""
    A, w, gram, y = inset
    b = A.T(w * y)
    term = Quadratic(gram, b[None], torch.ones(1), A.grid.spacing, 1000 * HU)
    model = minimise(term, EDGE, tolerance=0.05)
    exact = pwls(A, y, w, EDGE, mu_per_hu=HU, gram=gram, tolerance=0.05)
    assert hu_rms(model.volume, exact.volume) < 0.1 * hu_rms(exact.volume, torch.zeros(()))
    assert model.report["converged"]


def test_refusals(inset):
    A, w, gram, y = inset
    refused(
        (
            "weight 0",
            lambda: pwls(A, torch.full_like(y, torch.nan), w, EDGE, mu_per_hu=HU, gram=gram),
        ),
        ("tolerance", lambda: pwls(A, y, w, EDGE, mu_per_hu=HU, gram=gram, tolerance=0.0)),
        (
            "start",
            lambda: pwls(
                A, y, w, EDGE, mu_per_hu=HU, gram=gram, start=torch.full(A.domain_shape, torch.nan)
            ),
        ),
        ("max_exact", lambda: pwls(A, y, w, EDGE, mu_per_hu=HU, gram=gram, max_exact=0)),
    )
