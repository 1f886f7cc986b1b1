"""What a reconstruction has left in the data: noise stays out, patterns too weak to be seen are
found."""

import math
from dataclasses import replace

import pytest
import torch
from inset_operators import HU, problem

from recon.data_term import Quadratic
from recon.gram.gram import Gram
from recon.mbir import residual
from recon.mbir.frequencies import filtered, squared_frequencies
from recon.mbir.residual import MissingBody, missing_body, significant_residual

DAMPING = 0.1
SHAPE = (18, 24, 24)


@pytest.fixture(scope="module")
def gram():
    A, w = problem(shape=SHAPE, rows=20)
    return Gram(A, w, nodes=1)


def left(gram, x, noise, batch=1):
    """Normalised problem of an image in HU with noise, ``(batch, z, y, x)``; nothing of it is
    reconstructed yet."""
    generator = torch.Generator().manual_seed(3)
    b = gram.apply(x * HU) + noise * gram.noise((batch,), generator=generator)
    return Quadratic(gram, b, torch.ones(batch), (0.4,) * 3, 1000 * HU).in_noise_units()


def found(p):
    return significant_residual(p, p.spectrum(), torch.zeros_like(p.b), DAMPING)


def bars(shape, hu):
    """Half a line pair per mm along x."""
    return hu * torch.sin(2 * math.pi * 0.2 * torch.arange(shape[-1])).expand(shape)


def test_noise_is_left_where_it_is(gram):
    """One in six billion coefficients passes: nothing is put into nearly all volumes of noise."""
    p = left(gram, torch.zeros(SHAPE), 1.0, batch=50)
    step = filtered(p.b, 1.0 / (p.spectrum() + DAMPING))
    found_of_noise = found(p)
    assert int(found_of_noise.flatten(1).any(1).sum()) <= 4
    assert float(found_of_noise.square().mean()) < 1e-5 * float(step.square().mean())


def test_a_pattern_is_followed_to_where_it_is_weaker(gram):
    """A block that would not stand out by itself counts beside one that does."""
    tall = (18, 24, 72)
    A, w = problem(shape=tall, rows=20)
    wide = Gram(A, w, nodes=1)
    scale = float(left(wide, torch.zeros(tall), 1.0).unit_hu)
    fading = bars(tall, scale) * torch.linspace(1.5, 0.0, tall[-1])
    v = found(left(wide, fading, 1.0))[0] * scale
    middle = (..., slice(30, 42))
    share = float((v * fading)[middle].sum() / fading[middle].square().sum())
    assert share > 0.4


def test_weak_bars_are_put_back(gram):
    """At half of the noise of a voxel no bar is seen, together they are beyond doubt."""
    empty = left(gram, torch.zeros(SHAPE), 1.0)
    scale = float(empty.unit_hu)
    pattern = bars(SHAPE, scale / 2)
    v = found(left(gram, pattern, 1.0))[0] * scale
    share = float((v * pattern).sum() / pattern.square().sum())
    assert 0.5 < share < 1.2
    assert float((v - share * pattern).square().mean().sqrt()) < 0.5 * scale / 2


def test_without_noise_it_is_the_step_towards_the_data(gram):
    """Blocks add up to the volume; what is far below the noise stays out."""
    p = left(gram, bars(SHAPE, 5000.0), 0.0)
    v, pattern = found(p)[0] * float(p.unit_hu), bars(SHAPE, 5000.0)
    inside = (slice(2, -2), slice(3, -3), slice(3, -3))
    share = (v * pattern)[inside].sum() / pattern[inside].square().sum()
    assert 0.8 < float(share) < 1.1
    assert float((v - share * pattern)[inside].norm() / pattern[inside].norm()) < 0.2


def test_mirrored_data_give_the_mirrored_volume(gram):
    """Blocks lie symmetrically; the projector has the symmetry along z."""
    p = left(gram, bars(SHAPE, 40.0), 1.0)
    other = replace(p, b=p.b.flip(-3))
    torch.testing.assert_close(found(other).flip(-3), found(p), rtol=1e-3, atol=1e-4)


def test_a_thin_stack_is_looked_at_slice_by_slice():
    A, w = problem(shape=(3, 24, 24), rows=8)
    gram = Gram(A, w, nodes=1)
    p = left(gram, bars((3, 24, 24), 400.0), 0.0)
    assert float(found(p).abs().max()) > 0.0


def test_slices_smaller_than_a_block_hold_no_pattern():
    A, w = problem(shape=(18, 12, 24), rows=20)
    p = left(Gram(A, w, nodes=1), bars((18, 12, 24), 5000.0), 0.0)
    assert not found(p).any()


BALL_MM = 1.4
"""Diameter of the ball that is missing: one of those that are looked for."""
BALL_VOXEL = (8, 13, 11)


def ball(shape=SHAPE, voxel=0.4, middle=BALL_VOXEL):
    """How much of each voxel lies in it, from 8³ points."""
    at = [(torch.arange(8 * n) + 0.5) / 8 - 0.5 - m for n, m in zip(shape, middle, strict=True)]
    squares = [(voxel * a).square() for a in at]
    near = squares[0][:, None, None] + squares[1][:, None] + squares[2] < (BALL_MM / 2) ** 2
    return torch.nn.functional.avg_pool3d(near.float()[None], 8)[0]


def missed(p, u=None) -> list[MissingBody | None]:
    return missing_body(p, p.left(torch.zeros_like(p.b) if u is None else u), torch.tensor(1.0))


def striking_hu(gram, deviations):
    """Contrast of the ball that stands out of the noise of :func:`left` by so much."""
    x = ball() * HU
    return deviations / float((x * gram.apply(x)).sum().sqrt())


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_body_that_is_missing_is_found_where_it_is(gram, sign):
    hu = sign * striking_hu(gram, 15.0)
    (body,) = missed(left(gram, ball() * hu, 1.0))
    assert body is not None
    assert max(abs(a - b) for a, b in zip(body.voxel, BALL_VOXEL, strict=True)) <= 1
    assert body.diameter_mm == pytest.approx(BALL_MM)
    assert 9.0 < body.deviations < 18.0
    assert body.contrast_hu == pytest.approx(hu, rel=0.2)


def test_no_body_is_missing_in_noise(gram):
    assert not any(missed(left(gram, torch.zeros(SHAPE), 1.0, batch=200)))


@pytest.mark.parametrize(("deviations", "is_said"), [(5.5, False), (9.5, True)])
def test_edges_of_vessels_stand_out_by_less(gram, deviations, is_said):
    (body,) = missed(left(gram, ball() * striking_hu(gram, deviations), 0.0))
    assert (body is not None) is is_said


def test_a_body_that_the_volume_shows_is_not_missing(gram):
    hu = striking_hu(gram, 40.0)
    p = left(gram, ball() * hu, 1.0)
    assert missed(p, (ball() * hu / float(p.unit_hu))[None]) == [None]
    # a third of it is missed
    (body,) = missed(p, (ball() * hu / 1.5 / float(p.unit_hu))[None])
    assert body is not None
    assert body.contrast_hu == pytest.approx(hu / 3, rel=0.35)


@pytest.mark.parametrize("cut", [0.0, 1.0])
@pytest.mark.parametrize(("noise_hu", "is_said"), [(33.0, False), (50.0, True)])
def test_edges_that_stand_out_of_little_noise_are_not_said(gram, noise_hu, is_said, cut):
    """At a high dose every edge leaves more than noise in the data, whatever low frequencies a data
    consistency has taken away."""
    hu = 20.0 * noise_hu
    dose = (striking_hu(gram, 1.0) / noise_hu) ** 2
    b = dose * gram.apply(ball() * hu * HU)[None]
    p = Quadratic(gram, b, torch.full((1,), dose), (0.4,) * 3, 1000 * HU).in_noise_units()
    f2 = squared_frequencies(SHAPE, 0.4, p.b)
    kept = f2 / (f2 + cut**2).clamp_min(1e-9)
    (body,) = missing_body(p, filtered(p.b, kept), kept)
    assert (body is not None) is is_said


def test_a_body_is_as_large_as_what_is_left_of_its_frequencies_says(gram):
    """A data consistency has taken low ones away, of noise and ball: the contrast counts them."""
    hu = striking_hu(gram, 40.0)
    p = left(gram, ball() * hu, 1.0)
    f2 = squared_frequencies(SHAPE, 0.4, p.b)
    kept = f2 / (f2 + 0.3**2)
    (body,) = missing_body(p, filtered(p.b, kept), kept)
    assert body is not None
    assert max(abs(a - b) for a, b in zip(body.voxel, BALL_VOXEL, strict=True)) <= 1
    assert body.contrast_hu == pytest.approx(hu, rel=0.2)
    (taken_as_whole,) = missing_body(p, filtered(p.b, kept), torch.tensor(1.0))
    assert taken_as_whole is None or taken_as_whole.contrast_hu < 0.7 * hu


@pytest.mark.parametrize(("times", "louder"), [(0.5, 0.5), (1.35, 1.0), (4.0, 4.0 / 1.5)])
def test_what_is_left_in_most_places_is_noise(gram, monkeypatch, times, louder):
    """A prior that sharpens leaves up to half as much again; beyond, it is what is missing."""
    monkeypatch.setattr(residual, "_STANDS_OUT", 0.0)
    p = left(gram, torch.zeros(SHAPE), 1.0, batch=20)
    usual, now = (
        sum(body.deviations for body in missing_body(p, k * p.b, torch.tensor(1.0)))
        for k in (1.0, times)
    )
    assert now == pytest.approx(louder * usual, rel=0.1)


def test_thin_and_small_volumes_are_not_searched():
    A, w = problem(shape=(4, 10, 10), rows=6)
    p = left(Gram(A, w, nodes=1), torch.full((4, 10, 10), 900.0), 1.0)
    assert missed(p) == [None]


def test_it_is_differentiable(gram):
    p = left(gram, bars(SHAPE, 80.0), 1.0)
    beta = p.b.clone().requires_grad_(True)
    v = significant_residual(
        replace(p, b=beta),
        p.spectrum(),
        torch.zeros_like(beta),
        DAMPING,
    )
    v.sum().backward()
    step = torch.randn(beta.shape, generator=torch.Generator().manual_seed(0))
    moved = found(replace(p, b=p.b + 1e-4 * step))
    expected = float((beta.grad * step).sum()) * 1e-4
    assert float((moved - v.detach()).sum()) == pytest.approx(expected, rel=0.05, abs=1e-4)
