"""Soft outlines and bodies on voxels, and the Gram operator between chosen voxels."""

import math

import numpy as np
import pytest
import torch
from inset_operators import problem

from recon.gram.gram import Gram
from recon.vessel.kernels import core_fractions, sharpened
from recon.vessel.local_gram import LocalGram
from recon.vessel.model import SOFT, _behind


@pytest.mark.parametrize("radius", [0.9, 1.1, 2.3])
def test_what_is_taken_off_is_what_drawing_and_projecting_have_averaged(radius):
    """Chords of a disc by its soft drawing, each value projected as a box; means over voxels
    take a higher value."""
    step, count, off = 0.2, 40, 0.03
    at = (np.arange(count) - 19.5) * step
    y, x = np.meshgrid(at, at, indexing="ij")
    variance = np.full(y.shape, (SOFT * step) ** 2)
    soft = _behind(np.hypot(y, x - off) - radius + 0.5 / radius * variance, variance)[0]
    sub = (np.arange(20) - 9.5) * step / 20
    boxes = np.mean([np.hypot(y + a, x + b - off) < radius for a in sub for b in sub], 0)
    place = np.pad(np.arange(count**2).reshape(count, count), 1, constant_values=-1)
    beside = [
        place[1 + a : 1 + a + count, 1 + b : 1 + b + count].ravel()
        for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1))
    ]
    none = np.full(count**2, -1)
    out, own = np.empty((count**2, 1)), soft.reshape(-1, 1).copy()
    sharpened(own, np.stack([none, none, *beside], 1), SOFT**2 + 1 / 12, out)
    # The stencil takes what lies on either side of the plane for 0: an endless tube is as high
    # there as here.
    image = (out - (SOFT**2 + 1 / 12) * own).reshape(count, count)

    def factor(image):
        """Multiple of a drawing's projection along y that is nearest to the exact chords, on
        cells of 0.5 mm."""
        fine = (np.arange(4000) - 1999.5) * 0.002
        chords = 2 * np.sqrt(np.clip(radius**2 - (fine - off) ** 2, 0.0, None))
        seen = step * image.sum(0)[np.clip(np.floor((fine + 4.0) / step).astype(int), 0, count - 1)]
        seen, chords = (np.convolve(v, np.full(250, 1 / 250), "same") for v in (seen, chords))
        return seen @ chords / (seen @ seen)

    assert abs(factor(image) - 1) < 0.3 * abs(factor(boxes) - 1)


def body(centre, semi, spacing=0.2, count=24, cap=0.0, lumen=None):
    at = (np.arange(count) - (count - 1) / 2) * spacing
    points = np.stack(np.meshgrid(at, at, at, indexing="ij"), -1).reshape(-1, 3)
    n = len(points)
    far = np.full(n, 50.0) if lumen is None else lumen(points)
    out = np.empty((1, n), np.float32)
    core_fractions(
        0,
        1,
        np.array([centre]),
        np.eye(3)[None],
        np.array([semi]),
        np.array([cap]),
        points,
        np.full(3, SOFT * spacing),
        np.ones(n),
        far,
        np.full(n, SOFT * spacing),
        np.tile([0.0, 0.0, 1.0], (n, 1)),
        0.0,
        out,
    )
    return float(out.sum(dtype=np.float64)) * spacing**3


@pytest.mark.parametrize("semi", [(0.6, 0.985, 0.985), (0.4, 0.5, 1.2), (0.3, 0.3, 0.3)])
def test_volume_of_an_ellipsoid(semi):
    exact = 4 / 3 * math.pi * math.prod(semi)
    assert body((0.03, -0.05, 0.07), semi) == pytest.approx(exact, rel=0.01)


def test_the_cap_cuts_a_ball_in_half():
    """A lumen whose surface is 0.17 mm from the ball's middle plane: half of the ball is left
    with a cap of 0.17."""
    whole = 4 / 3 * math.pi * 0.8**3
    assert body((0, 0, 0), (0.8,) * 3, cap=0.17, lumen=lambda p: p[:, 2] + 0.17) == pytest.approx(
        whole / 2, rel=0.01
    )


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
    assert (
        np.abs(local.energies(np.ascontiguousarray(x.T)) - np.diag(x.T @ exact)).max() < 2e-5 * size
    )
    chosen = np.flatnonzero(rng.random(len(index)) < 0.3)
    few = np.zeros_like(x)
    few[chosen] = x[chosen]
    assert np.allclose(
        local.part(chosen).apply(x[chosen]),
        local.apply(few)[chosen],
        rtol=1e-4,
        atol=1e-5 * np.abs(exact).max(),
    )


def test_too_many_voxels_are_refused(monkeypatch):
    A, w = problem(views=12, shape=(2, 5, 5))
    monkeypatch.setattr("recon.vessel.local_gram.LARGEST", 1000)
    with pytest.raises(ValueError, match="50 voxels"):
        LocalGram.of(Gram(A, w, 1), np.argwhere(np.ones(A.domain_shape)), 1.0)
