"""The Cramér–Rao bound against dense linear algebra, simulated least squares and closed forms."""

import sys

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refusals

from torchpcct.metrics import cramer_rao_bound, information_matrix


def system(seed, tissues=4, shape=(3, 5, 7)):
    rng = np.random.default_rng(seed)
    return rng.uniform(0, 2, (tissues, *shape)), rng.uniform(0.1, 3, shape)


@pytest.mark.parametrize("kind", ["stack", "list", "tensors", "float32"])
def test_information_against_dense_algebra(kind, monkeypatch):
    # The package's attribute of that name is the function.
    monkeypatch.setattr(sys.modules["torchpcct.metrics.cramer_rao"], "_CHUNK", 16)
    maps, weight = system(0)
    a = maps.reshape(4, -1).T
    expected = 0.02**2 * a.T @ np.diag(weight.ravel()) @ a
    given_maps = {
        "stack": maps,
        "list": list(maps),
        "tensors": torch.from_numpy(maps).unbind(),
        "float32": maps.astype(np.float32),
    }[kind]
    f = information_matrix(given_maps, weight, scale=0.02)
    assert f.dtype == np.float64
    np.testing.assert_allclose(f, expected, rtol=1e-6 if kind == "float32" else 1e-13)


def test_limit_is_the_pseudo_inverse_of_the_weighted_system():
    maps, weight = system(1)
    root = np.sqrt(weight.ravel())[:, None] * maps.reshape(4, -1).T
    # its rows are the least-squares weights of unit-variance readings
    estimator = np.linalg.pinv(root)
    h = np.array([[1, -1, 0, 0], [0, 0.3, 0.7, 0]])
    f = information_matrix(maps, weight)
    np.testing.assert_allclose(
        cramer_rao_bound(f, np.eye(4)), estimator @ estimator.T, rtol=1e-10, atol=1e-14
    )
    np.testing.assert_allclose(
        cramer_rao_bound(f, h), h @ estimator @ estimator.T @ h.T, rtol=1e-10
    )
    assert cramer_rao_bound(f, h[0]) == pytest.approx(cramer_rao_bound(f, h)[:1, :1])


@settings(max_examples=30, deadline=None)
@given(st.floats(0.01, 100), st.integers(0, 1000))
def test_scaling_with_dose_and_more_unknowns(dose, seed):
    maps, weight = system(seed)
    f = information_matrix(maps, weight)
    h = [1, -1, 0, 0]
    assert cramer_rao_bound(f * dose, h) == pytest.approx(cramer_rao_bound(f, h) / dose)
    # An amplitude taken as known never hurts.
    assert cramer_rao_bound(f[:3, :3], h[:3]) <= cramer_rao_bound(f, h) * (1 + 1e-12)


def test_tissues_of_different_size_keep_their_digits():
    maps, weight = system(4)
    f = information_matrix(maps, weight)
    units = np.array([1e-6, 1.0, 1e5, 1e3])
    scaled = cramer_rao_bound(f * units[:, None] * units, np.eye(4))
    np.testing.assert_allclose(
        scaled * units[:, None] * units, cramer_rao_bound(f, np.eye(4)), rtol=1e-9
    )


MAPS, WEIGHT = system(5)
INFORMATION = information_matrix(MAPS, WEIGHT)
test_refusals = refusals(
    ("empty", lambda: information_matrix([], WEIGHT)),
    ("same detector window", lambda: information_matrix(MAPS, WEIGHT[:2])),
    ("negative", lambda: information_matrix(MAPS, -WEIGHT)),
    ("NaN", lambda: information_matrix(MAPS, WEIGHT * np.nan)),
    ("scale", lambda: information_matrix(MAPS, WEIGHT, scale=0)),
    ("tissue 1", lambda: cramer_rao_bound(np.diag([1.0, 0]), [1, 0])),
    (
        "tell the tissues apart",
        lambda: cramer_rao_bound(information_matrix([MAPS[0], 2 * MAPS[0]], WEIGHT), [1, 0]),
    ),
    ("square", lambda: cramer_rao_bound(INFORMATION[:2], [1, 0])),
    ("symmetric", lambda: cramer_rao_bound(INFORMATION + np.triu(INFORMATION, 1), [1, 0, 0, 0])),
    ("functionals", lambda: cramer_rao_bound(INFORMATION, [1, 0])),
)
