"""The q-GGMRF prior against its definition, automatic differentiation and closed forms."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refused

from recon.least_squares.qggmrf import QGGMRF, BoundPrior, quadratic

HU = 2e-5
EDGE = QGGMRF(0.15, 100.0)
FORMS = [(2.0, 1.0, 200.0), (2.0, 1.2, 200.0), (1.6, 1.1, 200.0), (2.0, 1.0, math.inf)]


def bound(p=2.0, q=1.0, threshold=200.0, neighbors=26, spacing=(0.25, 0.2, 0.3)):
    return BoundPrior(3e-5, threshold, p, q, neighbors, spacing, HU)


def volume(*shape, seed=0, hu=80.0, dtype=torch.float64):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype) * hu * HU


@pytest.mark.parametrize(("p", "q", "threshold"), FORMS)
def test_potential_is_the_published_one(p, q, threshold):
    t = torch.tensor([-500.0, -20.0, 3.0, 150.0, 4000.0], dtype=torch.float64)
    prior = bound(p, q, threshold)
    if math.isinf(threshold):
        expected = t**2 / 2
    else:
        expected = (
            t.abs() ** p * threshold ** (2 - p) / (p * (1 + (t.abs() / threshold) ** (p - q)))
        )
    tolerance = 1e-12 if p == 2.0 else 2e-3  # below p = 2 the tip is rounded
    assert torch.allclose(
        prior.potential(t), expected, rtol=tolerance, atol=tolerance * threshold**2 if p < 2 else 0
    )


@pytest.mark.parametrize(("p", "q", "threshold"), FORMS)
@pytest.mark.parametrize("neighbors", [6, 26])
def test_gradient_is_the_derivative_of_the_value(p, q, threshold, neighbors):
    prior = bound(p, q, threshold, neighbors)
    x = volume(2, 4, 5, 6).requires_grad_()
    prior.value(x).sum().backward()
    assert torch.allclose(
        prior.gradient(x.detach()), x.grad, rtol=1e-9, atol=1e-9 * float(x.grad.abs().max())
    )


@pytest.mark.parametrize(("p", "q", "threshold"), FORMS)
def test_fused_passes_equal_the_plain_ones(p, q, threshold):
    prior = bound(p, q, threshold)
    x, v, u = (volume(3, 5, 6, 7, seed=s) for s in range(3))
    plain = prior._plain_majorizer(x, v)
    assert torch.allclose(
        prior.majorizer(x, v), plain, rtol=1e-10, atol=1e-12 * float(plain.abs().max())
    )
    pull, bend = prior.along(x, v, u)
    assert torch.allclose(pull, (v * prior._plain_majorizer(x, x)).sum((1, 2, 3)), rtol=1e-9)
    assert torch.allclose(bend, (v * prior._plain_majorizer(x, u)).sum((1, 2, 3)), rtol=1e-9)
    assert prior.along(x[0], v[0], u[0])[0].shape == ()


def test_fused_passes_in_a_plane_and_in_single_precision():
    prior = bound(spacing=(0.2, 0.3))
    x = volume(6, 7)
    assert torch.allclose(prior.majorizer(x, x), prior._plain_majorizer(x, x), rtol=1e-10)
    single = prior.majorizer(x.float(), x.float())
    assert single.dtype == torch.float32
    assert torch.allclose(
        single.double(), prior.gradient(x), rtol=1e-4, atol=1e-5 * float(single.abs().max())
    )


@settings(max_examples=40, deadline=None)
@given(
    st.floats(-3000, 3000),
    st.floats(-3000, 3000),
    st.floats(1, 1000),
    st.sampled_from([(2.0, 1.0), (2.0, 1.5), (1.5, 1.0), (2.0, 2.0)]),
)
def test_parabola_touches_and_lies_above(t, s, threshold, form):
    prior = bound(*form, threshold)
    a, b = torch.tensor([t], dtype=torch.float64), torch.tensor([s], dtype=torch.float64)
    above = prior.potential(a) + prior.curvature(a) * (b * b - a * a) / 2
    assert float(above - prior.potential(b)) >= -1e-9 * float(above.abs() + 1)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1000), st.floats(0, 1), st.sampled_from([(2.0, 1.0), (2.0, 1.3), (1.5, 1.0)]))
def test_energy_is_convex(seed, share, form):
    prior = bound(*form)
    a, b = volume(3, 4, 5, seed=seed, hu=300), volume(3, 4, 5, seed=seed + 1, hu=30)
    chord = share * prior.value(a) + (1 - share) * prior.value(b)
    assert float(chord - prior.value(share * a + (1 - share) * b)) >= -1e-9 * float(chord + 1)


@pytest.mark.parametrize("voxel", [0.1, 0.2, 0.4])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_energy_of_a_ramp_does_not_depend_on_voxel_or_direction(voxel, axis):
    """½ λ g² per mm³ for a ramp of g HU/mm; counted over the pairs inside a periodic interior."""
    n = 24
    prior = BoundPrior(2.0, math.inf, 2.0, 1.0, 26, (voxel,) * 3, HU)
    index = torch.arange(n, dtype=torch.float64) * voxel
    shape = [1, 1, 1]
    shape[axis] = n
    x = (7.0 * HU * index).reshape(shape).expand(n, n, n).contiguous()
    volume_mm3 = (n * voxel) ** 3
    assert float(prior.value(x)) == pytest.approx(0.5 * 2.0 * 49.0 * volume_mm3, rel=0.12)
    fine = BoundPrior(2.0, math.inf, 2.0, 1.0, 26, (voxel / 2,) * 3, HU)
    shape[axis] = 2 * n
    ramp = (7.0 * HU * torch.arange(2 * n, dtype=torch.float64) * voxel / 2).reshape(shape)
    y = ramp.expand(2 * n, 2 * n, 2 * n).contiguous()
    assert float(fine.value(y)) == pytest.approx(float(prior.value(x)), rel=0.08)


def test_spectrum_is_that_of_the_periodic_matrix():
    prior = bound(threshold=math.inf)
    shape = (6, 8, 5)
    wave = torch.zeros(shape, dtype=torch.float64)
    wave[3, 4, 2] = 1.0
    response = torch.fft.irfftn(prior.spectrum(shape) * torch.fft.rfftn(wave), s=shape)
    assert torch.allclose(
        response, prior._plain_majorizer(wave, wave), atol=1e-9 * float(response.max())
    )


# -- several channels ------------------------------------------------------------------------------


def both(prior, spacing):
    return prior.bind(0.01, spacing, 1.0, channels=True)


@pytest.mark.parametrize(
    "prior", [quadratic(1.0), EDGE, QGGMRF(1.0, 50.0, 1.8, 1.1), QGGMRF(1.0, 50.0, 2.0, 1.3, 6)]
)
@pytest.mark.parametrize("shape", [(3, 4, 5), (5, 6)])
def test_kernels_of_channels_are_the_gradient_of_the_value(prior, shape):
    joint = both(prior, (0.5, 0.4, 0.3)[-len(shape) :])
    generator = torch.Generator().manual_seed(1)
    x, v, u = (
        100 * torch.randn(2, 2, *shape, generator=generator, dtype=torch.float64) for _ in range(3)
    )
    at = x.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(joint.value(at).sum(), at)
    torch.testing.assert_close(joint.gradient(x), gradient)
    torch.testing.assert_close(joint.majorizer(x, v), joint._plain_majorizer(x, v))
    pull, bend = joint.along(x, v, u)
    axes = tuple(range(-len(shape) - 1, 0))
    torch.testing.assert_close(pull, (v * gradient).sum(axes))
    torch.testing.assert_close(bend, (v * joint._plain_majorizer(x, u)).sum(axes))


def test_channels_may_be_turned():
    """Only the length of the difference counts: a rotation of the channels changes nothing, and
    one is the scalar."""
    joint, scalar = both(EDGE, (0.5,) * 3), EDGE.bind(0.01, (0.5,) * 3, 1.0)
    x = 100 * torch.randn(
        2, 4, 5, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(2)
    )
    c, s = math.cos(0.7), math.sin(0.7)
    turned = torch.stack([c * x[0] - s * x[1], s * x[0] + c * x[1]])
    torch.testing.assert_close(joint.value(turned), joint.value(x))
    torch.testing.assert_close(joint.gradient(x[:1])[0], scalar.gradient(x[0]))
    one = torch.stack([x[0], torch.zeros_like(x[0])])
    torch.testing.assert_close(joint.value(one), scalar.value(x[0]))
    torch.testing.assert_close(joint.gradient(one)[0], scalar.gradient(x[0]))
    # Without edges the channels do not see each other: one spectrum preconditions all.
    apart = both(quadratic(1.0), (0.5,) * 3).gradient(x)
    torch.testing.assert_close(apart, quadratic(1.0).bind(0.01, (0.5,) * 3, 1.0).gradient(x))


def test_binding_scales_with_the_noise():
    a = QGGMRF(0.5, 3.0, relative=True).bind(1e-3, (0.2,) * 3, HU)
    b = QGGMRF(0.5, 3.0, relative=True).bind(4e-3, (0.2,) * 3, HU)
    assert b.lam == pytest.approx(4 * a.lam)
    assert b.threshold == pytest.approx(a.threshold / 2)
    assert QGGMRF(0.5, 100.0).bind(4e-3, (0.2,) * 3, HU).threshold == 100.0
    assert math.isinf(quadratic(1.0).bind(1e-3, (0.2,) * 3, HU).threshold)


def test_refusals():
    refused(
        ("exponents", lambda: QGGMRF(1.0, 1.0, p=1.0, q=1.5)),
        ("neighbors", lambda: QGGMRF(1.0, 1.0, neighbors=18)),
        ("information", lambda: QGGMRF(1.0, 1.0).bind(0.0, (0.2,) * 3, HU)),
        ("mu_per_hu", lambda: QGGMRF(1.0, 1.0).bind(1.0, (0.2,) * 3, 0.0)),
        ("axes", lambda: bound().value(torch.zeros(3, 3))),
        ("4 axes", lambda: both(EDGE, (0.5,) * 3).gradient(torch.zeros(3, 3, 3))),
    )
