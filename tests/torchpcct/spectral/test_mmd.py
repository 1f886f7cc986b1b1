"""Multi-material decomposition: exact mixtures, nearest mixtures, cleaning."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refused

from torchpcct.metrics.plaque_measures import dice
from torchpcct.spectral import MMD_TISSUES, clean, label, mmd, nearest, pe_pvc

BASIS = pe_pvc()
CORNERS = torch.from_numpy(np.stack([BASIS.coefficients(t) for t in MMD_TISSUES], axis=1))


def test_pure_tissues():
    fractions = mmd(CORNERS, BASIS)
    torch.testing.assert_close(fractions, torch.eye(4, dtype=torch.float64), rtol=0, atol=1e-6)


@pytest.mark.parametrize("triplet", [(0, 1, 2), (0, 1, 3), (1, 2, 3)])
def test_exact_mixtures_return_their_fractions(triplet):
    # The core lies inside the triangle of the other three, so mixtures of the core with two others
    # are unique.
    exact = torch.zeros(4, 200, dtype=torch.float64)
    exact[list(triplet)] = torch.from_numpy(
        np.random.default_rng(sum(triplet)).dirichlet(np.ones(3), 200).T.copy()
    )
    torch.testing.assert_close(mmd(CORNERS @ exact, BASIS), exact, rtol=0, atol=1e-6)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.booleans())
def test_fractions_are_fractions_and_nearest(seed, correlated):
    rng = np.random.default_rng(seed)
    x = torch.from_numpy(CORNERS.mean(1, keepdim=True).numpy() + rng.normal(0, 0.3, (2, 40)))
    c = (0.02, -0.006, 0.002) if correlated else None
    fractions = mmd(x, BASIS, covariance=c)
    assert (fractions >= 0).all()
    torch.testing.assert_close(fractions.sum(0), torch.ones(40, dtype=torch.float64))
    assert ((fractions > 1e-12).sum(0) <= 3).all()
    if c is None:
        return
    # No mixture on a grid of all four is nearer than the one found.
    inverse = np.linalg.inv(np.array([[c[0], c[1]], [c[1], c[2]]]))

    def distance(f):
        d = (CORNERS @ f - x).numpy()
        return np.einsum("ik,ij,jk->k", d, inverse, d)

    found = distance(fractions)
    for shares in rng.dirichlet(np.full(4, 0.5), 200):
        grid = torch.from_numpy(shares)[:, None].expand(4, 40)
        assert (found <= distance(grid) + 1e-9).all()


def test_smallest_triangle_explains_where_several_hold():
    square = torch.tensor(
        [[0.0, 1.0, 1.0, 0.0, 0.5], [0.0, 0.0, 1.0, 1.0, 0.4]], dtype=torch.float64
    )
    x = torch.tensor([[0.5], [0.2]], dtype=torch.float64)
    fractions = mmd(x, BASIS, square)[:, 0]
    torch.testing.assert_close(fractions, torch.tensor([0.25, 0.25, 0, 0, 0.5]).double())


def test_shape_and_dtype():
    fractions = mmd(torch.rand(2, 3, 4, 5), BASIS)
    assert fractions.shape == (4, 3, 4, 5)
    assert fractions.dtype == torch.float32
    assert label(fractions).shape == (3, 4, 5)


def phantom():
    """Fat with a vessel of blood, fibrous tissue and a core."""
    y, x = np.mgrid[:48, :48]
    r = np.hypot(y - 24, x - 24)
    truth = np.full((48, 48), 3)
    truth[r < 18] = 2
    truth[np.hypot(y - 24, x - 16) < 6] = 0
    truth[np.hypot(y - 24, x - 31) < 5] = 1
    return torch.from_numpy(truth)


def test_cleaning_loses_the_core_as_noise_grows():
    truth = phantom()
    rng = np.random.default_rng(3)
    c = np.array([[4e-4, -1.35e-4], [-1.35e-4, 5e-5]])
    noise = torch.from_numpy(rng.multivariate_normal([0, 0], c, truth.numel()).T).reshape(
        2, *truth.shape
    )
    images = CORNERS[:, truth]
    scores = []
    for share in (0.0, 0.25, 0.5, 1.0):
        fractions = mmd(images + share * noise, BASIS, covariance=(c[0, 0], c[0, 1], c[1, 1]))
        labels = clean(fractions)
        scores.append({name: dice(labels == k, truth == k) for k, name in enumerate(MMD_TISSUES)})
    assert scores[0]["blood_iodine"] > 0.9
    core = [s["necrotic_core"] for s in scores]
    assert core[0] > 0.9
    assert core == sorted(core, reverse=True)
    fibrous = MMD_TISSUES.index("fibrous_tissue")
    raw = dice(label(mmd(images + 0.5 * noise, BASIS)) == fibrous, truth == fibrous)
    assert scores[2]["fibrous_tissue"] > raw


def test_cleaning_keeps_pure_labels_and_repeats():
    truth = phantom()
    fractions = torch.nn.functional.one_hot(truth, 4).permute(2, 0, 1).double()
    assert torch.equal(clean(fractions), truth)
    stacked = torch.stack([fractions] * 3, 1) + 0.1 * torch.rand(
        4, 3, 48, 48, generator=torch.Generator().manual_seed(0)
    )
    assert torch.equal(clean(stacked), clean(stacked))
    assert clean(stacked).shape == (3, 48, 48)
    # A tissue that is not there leaves its cluster empty: no warning, no failure.
    only_fat = torch.zeros(4, 8, 8)
    only_fat[3] = 1
    assert (clean(only_fat) == 3).all()


def test_nearest_finds_what_the_largest_fraction_loses():
    """Core and fibrous tissue 4 standard deviations apart, on one line with fat: errors as of a
    threshold between."""
    truth = torch.tensor([1, 2, 3]).repeat(4000)
    # a quarter of the noise of the paper's tables
    c = np.array([[0.0440, -0.0145], [-0.0145, 0.0053]]) / 16
    noise = np.random.default_rng(5).multivariate_normal([0, 0], c, truth.numel()).T
    fractions = mmd(
        CORNERS[:, truth] + torch.from_numpy(noise), BASIS, covariance=(c[0, 0], c[0, 1], c[1, 1])
    )
    found = nearest(fractions, BASIS, covariance=(c[0, 0], c[0, 1], c[1, 1]))
    assert found.dtype == torch.int64
    wrong = float((found != truth).double().mean())
    assert wrong < 0.06
    assert float((label(fractions) != truth).double().mean()) > 3 * wrong


def test_nearest_of_pure_tissues():
    fractions = torch.eye(4).reshape(4, 2, 2)
    assert nearest(fractions, BASIS).tolist() == [[0, 1], [2, 3]]
    with pytest.raises(ValueError, match="4 tissues"):
        nearest(fractions[:3], BASIS)


def test_errors():
    x = torch.rand(2, 4)
    refused(
        ("floating-point", lambda: mmd(torch.zeros(3, 4), BASIS)),
        ("NaN", lambda: mmd(x * torch.nan, BASIS)),
        ("3 or more", lambda: mmd(x, BASIS, ("water", "adipose"))),
        ("one line", lambda: mmd(x, BASIS, np.array([[0.0, 1.0, 2.0], [0.0, 1.0, 2.0]]))),
        ("positive definite", lambda: mmd(x, BASIS, covariance=(1.0, 2.0, 1.0))),
        (r"\(K, y, x\)", lambda: clean(torch.rand(4, 5))),
    )
