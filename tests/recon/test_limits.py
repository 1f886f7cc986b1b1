"""The limit with unknown outlines, against dense matrices."""

import math

import numpy as np
import pytest
import torch
from inset_operators import HU, problem

from recon.gram.gram import Gram
from recon.limits import contrast_limit, deformation_limit, known_inside, outline_maps


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
    found = contrast_limit(inset, inside, (1, 2), mu_per_hu=HU, free_sd_hu=sd)
    assert found == pytest.approx(dense(inset, inside, (1, 2), sd), rel=2e-3)


def test_less_knowledge_is_worse(inset, fractions):
    sds = [contrast_limit(inset, known_inside(fractions, r), (0, 2), mu_per_hu=HU) for r in (0, 1)]
    assert sds[1] > 1.05 * sds[0]
    halved = contrast_limit(inset.scaled(0.25), known_inside(fractions), (0, 2), mu_per_hu=HU, free_sd_hu=400.0)
    assert halved == pytest.approx(2 * sds[0], rel=0.02)


FACTOR, VOXEL = 5, 0.5


@pytest.fixture(scope="module")
def ball():
    """A ball in a ball, one slice per half mm: fractions and outlines on the inset's 4 x 9 x 9 voxels."""
    axes = [(np.arange(n * FACTOR) - (n * FACTOR - 1) / 2) * VOXEL / FACTOR for n in (4, 9, 9)]
    z, y, x = np.meshgrid(*axes, indexing="ij")
    r = np.sqrt(x**2 + y**2 + z**2)
    labels = (r < 1.9).astype(int) + (r < 0.8)
    fractions = np.stack([
        (labels == k).reshape(4, FACTOR, 9, FACTOR, 9, FACTOR).mean((1, 3, 5)) for k in range(3)
    ])  # fmt: skip
    return labels, fractions


def test_outlines_have_the_area_of_spheres(ball):
    labels, _ = ball
    maps = outline_maps(labels, (0.0, 100.0, 40.0), FACTOR, VOXEL / FACTOR)
    assert maps.shape == (2, 4, 9, 9)  # ball and background do not touch
    inner = 4 * math.pi * 0.8**2
    assert maps[1].sum() * VOXEL**3 == pytest.approx(-60.0 * inner, rel=0.05)
    # The outer ball is cut off at z = ±1 mm: a zone of height 2.
    assert maps[0].sum() * VOXEL**3 == pytest.approx(100.0 * 2 * math.pi * 1.9 * 2.0, rel=0.07)


@pytest.mark.parametrize("displacement", [0.0, 0.1, 1.0])
def test_deformations_against_a_dense_inverse(inset, ball, displacement):
    labels, fractions = ball
    maps = outline_maps(labels, (0.0, 100.0, 40.0), FACTOR, VOXEL / FACTOR)
    n = fractions[0].size
    h = inset.apply(torch.eye(n).reshape(n, 4, 9, 9)).reshape(n, n).double().numpy() * HU**2
    at = np.stack(np.meshgrid(*(np.arange(k) * VOXEL for k in (4, 9, 9)), indexing="ij"), -1).reshape(-1, 3)
    kernel = np.exp(-((at[:, None] - at[None]) ** 2).sum(-1) / (2 * 0.8**2)) * displacement**2
    change = [m.reshape(-1).astype(float) for m in maps]
    prior = sum(np.outer(c, c) * kernel for c in change)
    # Marginal information of the volume: (H⁻¹ + P)⁻¹ = H − H (P⁻¹ + H)⁻¹ H, without inverting either.
    marginal = h @ np.linalg.inv(np.eye(n) + prior @ h)
    m = fractions[1:].reshape(2, -1).T
    t = np.array([1.0, -1.0])
    expected = math.sqrt(t @ np.linalg.inv(m.T @ marginal @ m) @ t)
    found = deformation_limit(
        inset,
        fractions[1:],
        maps,
        (0, 1),
        mu_per_hu=HU,
        voxel_mm=VOXEL,
        displacement_mm=displacement,
        correlation_mm=0.8,
    )
    # White noise beyond the grid's edge is cut off, so the field is a little smaller there.
    assert found == pytest.approx(expected, rel=0.06 if displacement else 2e-3)


def test_less_known_outlines_are_worse(inset, ball):
    labels, fractions = ball
    maps = outline_maps(labels, (0.0, 100.0, 40.0), FACTOR, VOXEL / FACTOR)
    sds = [
        deformation_limit(inset, fractions[1:], maps, (0, 1), mu_per_hu=HU, voxel_mm=VOXEL, displacement_mm=d)
        for d in (0.0, 0.1, 0.3)
    ]  # fmt: skip
    assert sds[0] < sds[1] < sds[2]


def test_refusals(inset, fractions):
    with pytest.raises(ValueError, match="no voxel"):
        contrast_limit(inset, known_inside(fractions, 3), (1, 2), mu_per_hu=HU)
    with pytest.raises(ValueError, match="rings"):
        known_inside(fractions, -1)
    with pytest.raises(ValueError, match="displacement_mm must be at least 0"):
        deformation_limit(inset, fractions, fractions, (1, 2), mu_per_hu=HU, voxel_mm=1.0, displacement_mm=-0.1)
    with pytest.raises(ValueError, match="no multiple of factor"):
        outline_maps(np.zeros((4, 4, 5), int), (0.0,), 2, 0.1)
