"""Shares of voxels behind planes and inside bodies, and the Gram operator between chosen voxels."""

import math

import numpy as np
import pytest
import torch
from inset_operators import problem

from recon.gram.gram import Gram
from recon.plaque.kernels import core_fractions, plane_fractions
from recon.plaque.local_gram import LocalGram

HALF = np.array([0.1, 0.15, 0.08])


def shares(distance, normal, blur=0.0):
    n = len(distance)
    share, slope = np.empty(n), np.empty(n)
    plane_fractions(np.asarray(distance, float), np.broadcast_to(normal * HALF, (n, 3)).copy(), np.full(n, blur), share,
                    slope)  # fmt: skip
    return share, slope


@pytest.mark.parametrize("normal", [(0.6, 0.64, 0.48), (0.3, -0.9, math.sqrt(0.1)), (0.8, 0.6, 0.0)])
def test_share_of_a_voxel_behind_a_plane(normal):
    normal = np.array(normal)
    distance = np.linspace(-0.25, 0.25, 41)
    share, slope = shares(distance, normal)
    at = (np.arange(60) + 0.5) / 30 - 1
    points = np.stack(np.meshgrid(*(at * h for h in HALF), indexing="ij"), -1) @ normal
    exact = [(points + d < 0).mean() for d in distance]
    assert np.abs(share - exact).max() < 0.015
    eps = 1e-6
    numeric = (shares(distance - eps, normal)[0] - shares(distance + eps, normal)[0]) / (2 * eps)
    assert np.allclose(slope, numeric, atol=1e-4)


def test_a_blurred_edge_is_wider_by_the_variance():
    """The derivative of the share is the edge's profile: its variance is that of the voxel plus the blur's."""
    normal, d = np.array([0.6, 0.64, 0.48]), np.linspace(-0.6, 0.6, 4001)
    for blur in (0.0, 0.004):
        profile = shares(d, normal, blur)[1]
        variance = (profile * d**2).sum() / profile.sum()
        assert variance == pytest.approx(float(((normal * HALF) ** 2).sum() / 3 + blur), rel=2e-3)


def body(centre, semi, spacing=0.2, count=24, cap=0.0, lumen=None):
    at = (np.arange(count) - (count - 1) / 2) * spacing
    points = np.stack(np.meshgrid(at, at, at, indexing="ij"), -1).reshape(-1, 3)
    n = len(points)
    far = np.full(n, 50.0) if lumen is None else lumen(points)
    normals = np.tile([0.0, 0.0, spacing / 2], (n, 1))
    out = np.empty((1, n), np.float32)
    core_fractions(0, 1, np.array([centre]), np.eye(3)[None], np.array([semi]), np.array([cap]), points,
                   np.full(3, spacing / 2), np.ones(n), far, normals, 0.0, out)  # fmt: skip
    return float(out.sum(dtype=np.float64)) * spacing**3


@pytest.mark.parametrize("semi", [(0.6, 0.985, 0.985), (0.4, 0.5, 1.2), (0.3, 0.3, 0.3)])
def test_volume_of_an_ellipsoid(semi):
    exact = 4 / 3 * math.pi * math.prod(semi)
    assert body((0.03, -0.05, 0.07), semi) == pytest.approx(exact, rel=0.01)


def test_the_cap_cuts_a_ball_in_half():
    """A lumen whose surface is 0.17 mm from the ball's middle plane: half of the ball is left with a cap of 0.17."""
    whole = 4 / 3 * math.pi * 0.8**3
    assert body((0, 0, 0), (0.8,) * 3, cap=0.17, lumen=lambda p: p[:, 2] + 0.17) == pytest.approx(whole / 2, rel=0.01)


@pytest.mark.parametrize("nodes", [5, 9])
def test_blocks_are_the_operator(nodes):
    A, w = problem(views=120, shape=(8, 11, 13), rows=10)
    gram = Gram(A, w, nodes).scaled(2.0)
    rng = np.random.default_rng(0)
    index = np.argwhere(rng.random(A.domain_shape) < 0.4)
    local = LocalGram.of(gram, index, 3.0)
    x = rng.standard_normal((len(index), 3)).astype(np.float32)
    x[:, 1] *= index[:, 0] < 3  # a column that is 0 in most slices
    volumes = torch.zeros(3, *A.domain_shape, dtype=torch.float64)
    volumes[(slice(None), *index.T)] = torch.from_numpy(x.T).double()
    exact = 3.0 * gram.apply(volumes)[(slice(None), *index.T)].numpy().T
    assert np.abs(local.apply(x) - exact).max() < 2e-5 * np.abs(exact).max()
    size = np.abs(x.T @ exact).max()
    assert np.abs(local.apply(x[:, :1]) - exact[:, :1]).max() < 2e-5 * np.abs(exact).max()
    assert np.abs(local.curvature(x) - x.T @ exact).max() < 2e-5 * size
    assert np.abs(local.energies(np.ascontiguousarray(x.T)) - np.diag(x.T @ exact)).max() < 2e-5 * size
    chosen = np.flatnonzero(rng.random(len(index)) < 0.3)
    few = np.zeros_like(x)
    few[chosen] = x[chosen]
    assert np.allclose(local.part(chosen).apply(x[chosen]), local.apply(few)[chosen], rtol=1e-4,
                       atol=1e-5 * np.abs(exact).max())  # fmt: skip


def test_too_many_voxels_are_refused(monkeypatch):
    A, w = problem(views=12, shape=(2, 5, 5))
    monkeypatch.setattr("recon.plaque.local_gram.LARGEST", 1000)
    with pytest.raises(ValueError, match="50 voxels"):
        LocalGram.of(Gram(A, w, 1), np.argwhere(np.ones(A.domain_shape)), 1.0)
