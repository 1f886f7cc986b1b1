"""The limit with unknown outlines, against dense matrices."""

import math

import numpy as np
import pytest
import torch
from test_gram import HU, problem

from recon.gram import Gram
from recon.limits import contrast_limit, known_inside


@pytest.fixture(scope="module")
def inset():
    A, w = problem(shape=(4, 9, 9), rows=6)
    return Gram(A, w, nodes=1)


@pytest.fixture(scope="module")
def fractions():
    """Background, a shell and a core, with voxels that the outlines cross."""
    z, y, x = np.meshgrid(np.arange(4) - 1.5, np.arange(9) - 4.0, np.arange(9) - 4.0, indexing="ij")
    r = np.sqrt(0.5 * z**2 + y**2 + x**2)
    outer, inner = np.clip(4.2 - r, 0, 1), np.clip(2.6 - r, 0, 1)
    return np.stack([1 - outer, outer - inner, inner])


def dense(gram, inside, contrast, sd):
    n = inside[0].size
    h = gram.apply(torch.eye(n).reshape(n, *inside[0].shape)).reshape(n, n).double().numpy() * HU**2
    columns = [m.reshape(-1).astype(float) for m in inside if m.any()]
    free = np.flatnonzero(~inside.any(0).reshape(-1))
    unit = np.eye(n)[free]
    m = np.stack([*columns, *unit], axis=1)
    penalty = np.concatenate([np.zeros(len(columns)), np.full(len(free), 1 / sd**2)])
    covariance = np.linalg.inv(m.T @ h @ m + np.diag(penalty))
    t = np.zeros(len(m.T))
    t[contrast[0]], t[contrast[1]] = 1, -1
    return math.sqrt(t @ covariance @ t)


@pytest.mark.parametrize("sd", [50.0, 400.0])
def test_against_a_dense_inverse(inset, fractions, sd):
    inside = known_inside(fractions)
    found = contrast_limit(inset, inside, (1, 2), hu=HU, free_sd_hu=sd)
    assert found == pytest.approx(dense(inset, inside, (1, 2), sd), rel=2e-3)


def test_less_knowledge_is_worse(inset, fractions):
    sds = [contrast_limit(inset, known_inside(fractions, r), (0, 2), hu=HU) for r in (0, 1)]
    assert sds[1] > 1.05 * sds[0]
    halved = contrast_limit(inset.scaled(0.25), known_inside(fractions), (0, 2), hu=HU, free_sd_hu=400.0)
    assert halved == pytest.approx(2 * sds[0], rel=0.02)


def test_refusals(inset, fractions):
    with pytest.raises(ValueError, match="no voxel"):
        contrast_limit(inset, known_inside(fractions, 3), (1, 2), hu=HU)
    with pytest.raises(ValueError, match="rings"):
        known_inside(fractions, -1)
