"""The unrolled reconstruction and its energy, against dense solutions and on hard cases."""

import math

import pytest
import torch
from certificate import certificate, second
from inset_operators import HU, problem, tissue

from recon.gram.gram import Gram
from recon.mbir.minimise import energy, minimise, minimise_passes, residual
from recon.mbir.prior import PriorConfig
from recon.mbir.unrolled import NormalisedProblem, Unrolled

SMALL = PriorConfig(levels=2, filters=12, units=4)


@pytest.fixture(scope="module")
def scan():
    """Gram operator of a small inset (0.4 mm), a tissue, and its noise-free statistic."""
    A, w = problem(shape=(8, 12, 12), rows=10)
    gram = Gram(A, w, nodes=1)
    x = tissue(A.grid)
    return gram, x, gram.apply(x)


def model(seed=0, prior=SMALL, steps=6):
    torch.manual_seed(seed)
    return Unrolled(prior, steps).eval().requires_grad_(False)


def normal(scan, exposure=1.0, noise=0.0, seed=0, batch=1):
    gram, _, b = scan
    b = (b * exposure).expand(batch, *b.shape)
    if noise:
        generator = torch.Generator().manual_seed(seed)
        b = b + noise * math.sqrt(exposure) * gram.noise((batch,), generator=generator)
    return NormalisedProblem.from_statistic(gram, b, torch.full((batch,), exposure), HU, 0.4)


def no_prior(net):
    """Only the quadratic part of the energy is left."""
    net.prior.gain.fill_(-60.0)
    net.prior.along[0] = -60.0
    return net


def dense(problem, net):
    """Minimum of the quadratic energy by a dense solve."""
    n = problem.beta[0].numel()
    eye = torch.eye(n).reshape(n, *problem.beta.shape[1:])
    h = problem.gram.apply(eye) * problem.factor[0]
    q = net.prior.quadratic(problem.beta.shape[-3:], problem.voxel_mm, problem.scale_hu[:1])
    smooth = torch.fft.irfftn(q * torch.fft.rfftn(eye, dim=(1, 2, 3)), s=eye.shape[1:], dim=(1, 2, 3))
    matrix = (h + smooth).reshape(n, n).double()
    return torch.linalg.solve(0.5 * (matrix + matrix.T), problem.beta[0].reshape(n).double()).reshape(eye.shape[1:])


def test_normalisation(scan):
    """H is about 1 at 0.5 lp/mm, and doubling the exposure keeps it while the noise scale falls by √2."""
    gram, _, _ = scan
    one, two = normal(scan), normal(scan, exposure=2.0)
    assert float(two.scale_hu / one.scale_hu) == pytest.approx(1 / math.sqrt(2))
    torch.testing.assert_close(one.spectrum(), two.spectrum())
    assert float(one.scale_hu) == pytest.approx((gram.information(HU) * 0.4**3) ** -0.5)
    assert 0.1 < float(one.spectrum()[0, 0, 2, 2]) < 10


def test_quadratic_energy_against_a_dense_solve(scan):
    net, p = no_prior(model()), normal(scan, noise=1.0)
    exact = dense(p, net)
    found, report = minimise(net, p, torch.zeros_like(p.beta), tolerance=1e-5, most=600)
    assert report["converged"]
    assert float((found[0] - exact).norm() / exact.norm()) < 1e-3


def test_gradient_of_the_energy_and_the_certificate(scan):
    net, p = model(), normal(scan, noise=1.0)
    net.double()
    p = NormalisedProblem(p.gram, p.beta.double(), p.scale_hu.double(), p.factor.double(), p.voxel_mm)
    u = torch.randn_like(p.beta).requires_grad_()
    (gradient,) = torch.autograd.grad(energy(net, p, u).sum(), u)
    direction = torch.randn_like(u)
    with torch.no_grad():
        rise = (energy(net, p, u + 1e-4 * direction) - energy(net, p, u - 1e-4 * direction)) / 2e-4
    assert float(rise) == pytest.approx(float((gradient * direction).sum()), rel=1e-4)
    with torch.no_grad():
        assert float(residual(net, p, torch.zeros_like(p.beta))) == pytest.approx(1.0)
        found, _ = minimise(net, p, net(p), tolerance=1e-4, most=600)
        assert float(residual(net, p, found)) <= 1e-4


def test_energy_falls_to_the_same_minimum_from_any_start(scan):
    """Mild potentials: zero, noise and 10⁴ HU end at one volume, and no step ever raises the energy."""
    net, p = model(), normal(scan, noise=1.0)
    ends = []
    generator = torch.Generator().manual_seed(1)
    for start in (0.0, 5.0, 1e4 / float(p.scale_hu)):
        u = start * (torch.randn(p.beta.shape, generator=generator) if start == 5.0 else torch.ones_like(p.beta))
        before = energy(net, p, u)
        end, report = minimise(net, p, u, tolerance=1e-4, most=800)
        assert report["converged"]
        assert float(energy(net, p, end)) <= float(before)
        ends.append(end)
    scale = ends[0].square().mean().sqrt()
    for end in ends[1:]:
        assert float((end - ends[0]).square().mean().sqrt() / scale) < 0.01


def test_batch_equals_single(scan):
    net = model()
    together = net(normal(scan, noise=1.0, batch=3))
    generator = torch.Generator().manual_seed(0)
    noise = scan[0].noise((3,), generator=generator)
    for k in range(3):
        p = NormalisedProblem.from_statistic(scan[0], (scan[2] + noise[k])[None], torch.ones(1), HU, 0.4)
        torch.testing.assert_close(net(p)[0], together[k], rtol=1e-4, atol=1e-4)


def test_every_parameter_learns(scan):
    torch.manual_seed(0)
    net = Unrolled(SMALL, 3)
    net(normal(scan, noise=1.0)).square().sum().backward()
    for name, p in net.named_parameters():
        assert p.grad is not None, name
        assert float(p.grad.abs().sum()) > 0, name


@pytest.mark.parametrize("exposure", [0.01, 1.0, 100.0])
def test_finite_at_any_dose(scan, exposure):
    out = model()(normal(scan, exposure=exposure, noise=1.0))
    assert torch.isfinite(out).all()


def test_fed_with_its_own_output(scan):
    """Reconstructing the statistic of its own output 100 times does not run away."""
    gram, net = scan[0], model()
    p = normal(scan, noise=1.0)
    first = u = net(p)
    for _ in range(100):
        u = net(NormalisedProblem(gram, p.apply(u), p.scale_hu, p.factor, p.voxel_mm))
    assert torch.isfinite(u).all()
    assert float(u.norm()) <= 2 * float(first.norm())


def test_nan_is_not_hidden(scan):
    p = normal(scan)
    p.beta[0, 0, 0, 0] = math.nan
    assert not torch.isfinite(model()(p)).all()


def test_remembers_the_noise_scales_it_was_trained_at(scan):
    net = Unrolled(SMALL, 1)
    for exposure in (4.0, 1.0):
        net(normal(scan, exposure=exposure))
    low, high = net.seen_scale_hu.tolist()
    assert high / low == pytest.approx(2.0, rel=1e-5)
    before = net.seen_scale_hu.clone()
    net.eval()(normal(scan, exposure=100.0))
    assert torch.equal(net.seen_scale_hu, before)


def test_steps_are_refused():
    with pytest.raises(ValueError, match="steps"):
        Unrolled(SMALL, 0)


def test_adding_the_residual_back_restores_contrast(scan):
    """A strong prior shrinks; a second pass brings the volume closer to the data, the more so the larger its weight."""
    left = []
    for add_back in (None, (0.5, 0.0), (1.0, 0.0)):
        torch.manual_seed(0)
        net = Unrolled(SMALL, 6, add_back).eval().requires_grad_(False)
        net.prior.gain += 2.0
        p = normal(scan)
        left.append(float((p.beta - p.apply(net(p))).norm() / p.beta.norm()))
    assert left[1] < 0.9 * left[0]
    assert left[2] < 0.9 * left[1]


def test_callback_sees_every_step(scan):
    net, seen = Unrolled(SMALL, 3, (0.5, 0.0)).eval().requires_grad_(False), []
    last = net(normal(scan), lambda k, u: seen.append((k, u)))
    assert [k for k, _ in seen] == list(range(net.iterations))
    assert torch.equal(seen[-1][1], last)


@pytest.fixture(scope="module")
def two_passes():
    """A prior and a smoothing along vessels strong enough that much is added back."""
    torch.manual_seed(0)
    net = Unrolled(SMALL, 6, (0.8, 0.3)).eval().requires_grad_(False)
    net.prior.gain += 1.0
    net.prior.along[0] = 2.0
    return net


def test_residual_of_the_second_pass(scan, two_passes):
    """Two volumes of one batch; neither the energy of the first pass nor another smoothing has this gradient."""
    net, p = two_passes, normal(scan, noise=1.0, batch=2)
    u, last, smoothing = net.passes(p)
    assert torch.equal(u, net(p))
    expected = certificate(net, p, net.descend(p, net.vessel_smoothing(p)), u)
    torch.testing.assert_close(residual(net, last, u, smoothing), expected, rtol=1e-3, atol=0)
    assert float((residual(net, p, u) / expected).min()) > 1.5
    assert float((residual(net, last, u) / expected - 1).abs().min()) > 0.1


def test_every_pass_ends_at_its_stationary_point(scan, two_passes):
    """Pass after pass by hand, from zero, against the whole from its unrolled steps and from their end."""
    net, p = two_passes, normal(scan, noise=1.0)
    zero, smoothing = torch.zeros_like(p.beta), net.vessel_smoothing(p)
    u1, _ = minimise(net, p, zero, tolerance=1e-5, most=800)
    u2, _ = minimise(net, second(net, p, u1), zero, tolerance=1e-5, most=800, smoothing=smoothing)
    for start, steps in ((None, 6), (net(p), 0)):
        found, report = minimise_passes(net, p, start, tolerance=1e-5, most=800)
        assert report["converged"]
        assert report["iterations"] > steps + 10
        assert max(report["residual"]) <= 1e-5
        assert float(certificate(net, p, u1, found)) <= 1e-4
        assert float((found - u2).norm() / u2.norm()) < 1e-3
        # What was added back stays.
        assert float((found - u1).norm() / u2.norm()) > 0.1


def test_first_pass_that_stopped_early_is_not_converged(scan):
    """Here the second pass, which adds nothing back, only goes on with the first, and ends at the point."""
    torch.manual_seed(0)
    net, p = Unrolled(SMALL, 6, (0.0, 0.0)).eval().requires_grad_(False), normal(scan, noise=1.0)
    _, report = minimise_passes(net, p, torch.zeros_like(p.beta), most=12)
    assert max(report["residual"]) <= 1e-3
    assert not report["converged"]


def test_one_pass_adds_nothing_back(scan):
    p = normal(scan)
    with pytest.raises(ValueError, match="one pass"):
        model().added_back(p, torch.zeros_like(p.beta))
