"""The unrolled reconstruction: its linear parts against dense solutions, its fidelity, hard
cases."""

import math
from dataclasses import replace

import pytest
import torch
from inset_operators import HU, matrix, problem, tissue

from recon.data_term import Quadratic
from recon.gram.gram import Gram
from recon.mbir.frequencies import filtered, squared_frequencies
from recon.mbir.network import NetworkConfig, bilateral_prior
from recon.mbir.unrolled import Unrolled, fidelity_frequency, first_views, low_residual, start

SMALL = NetworkConfig((6, 8, 8), 0.4)
SHAPE = (8, 12, 12)


@pytest.fixture(scope="module")
def scan():
    """Gram operator of a small inset (0.4 mm), a tissue, and its noise-free right-hand side."""
    A, w = problem(shape=SHAPE, rows=10)
    gram = Gram(A, w, nodes=1)
    x = tissue(A.grid)
    return gram, x, gram.apply(x)


def model(seed=0, steps=2, bilateral=False):
    """With a network that does something."""
    torch.manual_seed(seed)
    made = Unrolled(replace(SMALL, bilateral=bilateral), steps)
    torch.nn.init.normal_(made.network.leave.weight, std=0.02)
    return made.eval().requires_grad_(False)


def normal(scan, exposure=1.0, noise=0.0, seed=0, batch=1):
    gram, _, b = scan
    b = (b * exposure).expand(batch, *b.shape)
    if noise:
        generator = torch.Generator().manual_seed(seed)
        b = b + noise * math.sqrt(exposure) * gram.noise((batch,), generator=generator)
    return Quadratic(
        gram, b, torch.full((batch,), exposure), (0.4,) * 3, 1000 * HU
    ).in_noise_units()


def test_normalisation(scan):
    """H is about 1 at 0.5 lp/mm, and doubling the exposure keeps it while the noise scale falls
    by √2."""
    gram, _, _ = scan
    one, two = normal(scan), normal(scan, exposure=2.0)
    assert float(two.unit_hu / one.unit_hu) == pytest.approx(1 / math.sqrt(2))
    torch.testing.assert_close(one.spectrum(), two.spectrum())
    assert float(one.unit_hu) == pytest.approx((gram.information(HU) * 0.4**3) ** -0.5)
    assert 0.1 < float(one.spectrum()[0, 0, 2, 2]) < 10


def test_start_is_the_wiener_filter(scan):
    """(H + λ + μ f²)⁻¹ β by a dense solve; the few steps leave about a per cent."""
    p = normal(scan, noise=1.0)
    prior = 0.01 + 0.8 * squared_frequencies(SHAPE, 0.4).double()
    dense = matrix(lambda v: p.operator.apply(v) * p.scale[0].double() + filtered(v, prior), SHAPE)
    exact = torch.linalg.solve(0.5 * (dense + dense.T), p.b.double().reshape(-1)).reshape(SHAPE)
    found = start(p, p.spectrum())[0].double()
    assert float((found - exact).norm() / exact.norm()) < 0.03


def test_no_steps_are_linear(scan):
    net, first, second = model(), normal(scan, noise=1.0, seed=1), normal(scan, noise=1.0, seed=2)
    both = replace(first, b=first.b - 2 * second.b)
    found = [net(p, steps=0) for p in (first, second, both)]
    torch.testing.assert_close(found[2], found[0] - 2 * found[1], rtol=1e-3, atol=1e-3)
    whole = [net(p) for p in (first, second, both)]
    assert float((whole[2] - whole[0] + 2 * whole[1]).std()) > 0.01


def test_final_data_consistency(scan):
    """Whatever the network adds, the low frequencies of what the scanner sees stay the data's, the
    more the fidelity."""
    p = normal(scan, noise=1.0)
    quiet, loud = model(), model()
    loud.network.leave.weight.mul_(30.0)
    left = {}
    for fidelity in (0.0, 0.5, 1.0):
        free, bound = (loud(p, fidelity, final_data_consistency=word) for word in (False, True))
        left[fidelity] = [float(low_residual(p, p.b - p.apply(u), fidelity)) for u in (free, bound)]
        assert left[fidelity][1] < 0.35 * left[fidelity][0]
        # Both networks agree on them.
        low = torch.exp(
            -math.log(2) * squared_frequencies(SHAPE, 0.4) / fidelity_frequency(fidelity) ** 2
        )
        apart = [
            filtered(
                quiet(p, fidelity, final_data_consistency=w)
                - loud(p, fidelity, final_data_consistency=w),
                low,
            ).norm()
            for w in (False, True)
        ]
        assert apart[1] < 0.6 * apart[0]
    assert low_residual(p, p.b, 0.5) == pytest.approx(1.0)


def test_another_prior_takes_the_place_of_the_network(scan):
    """The filter alone asks nothing of the weights, and what it gives is made consistent with
    the data."""
    p = normal(scan, noise=1.0)
    first, second = (model(seed, bilateral=True) for seed in (0, 1))
    found = first(p, 0.5, prior=bilateral_prior)
    torch.testing.assert_close(found, second(p, 0.5, prior=bilateral_prior), rtol=0, atol=0)
    assert not torch.equal(found, first(p, 0.5))
    with pytest.raises(ValueError, match="without the bilateral filter"):
        model()(p, 0.5, prior=bilateral_prior)


def test_noise_grows_with_the_fidelity(scan):
    net = model(steps=1)
    torch.nn.init.zeros_(net.network.leave.weight)
    p = normal(scan, noise=1.0, batch=6)
    sd = [float(net(p, fidelity).std(0).mean()) for fidelity in (0.0, 0.5, 1.0)]
    assert sd[0] < sd[1] < sd[2]
    fidelities = torch.tensor([0.0, 0.5, 1.0, 0.0, 0.5, 1.0])
    torch.testing.assert_close(net(p, fidelities)[1], net(p, 0.5)[1])


def test_frequencies_of_the_fidelity():
    assert fidelity_frequency(0.0) == pytest.approx(0.2)
    assert fidelity_frequency(1.0) == pytest.approx(0.8)
    for bad in (-0.1, 1.1, math.nan):
        with pytest.raises(ValueError, match="fidelity"):
            fidelity_frequency(bad)


def test_batch_equals_single(scan):
    net = model()
    together = net(normal(scan, noise=1.0, batch=3))
    generator = torch.Generator().manual_seed(0)
    noise = scan[0].noise((3,), generator=generator)
    for k in range(3):
        p = Quadratic(scan[0], (scan[2] + noise[k])[None], torch.ones(1), (0.4,) * 3, 1000 * HU)
        p = p.in_noise_units()
        torch.testing.assert_close(net(p)[0], together[k], rtol=1e-4, atol=1e-4)


def test_every_parameter_learns(scan):
    net = model().requires_grad_(True).train()
    net(normal(scan, noise=1.0)).square().sum().backward()
    for name, p in net.named_parameters():
        assert p.grad is not None, name
        assert float(p.grad.abs().max()) > 0, name


def test_noise_levels_of_the_training_are_kept(scan):
    net = model().train()
    for exposure in (1.0, 4.0, 0.5):
        net(normal(scan, exposure))
    expected = [float(normal(scan, e).unit_hu) for e in (4.0, 0.5)]
    assert net.seen_scale_hu.tolist() == pytest.approx(expected)
    net.eval()(normal(scan, 100.0))
    assert net.seen_scale_hu.tolist() == pytest.approx(expected)


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e6])
def test_extreme_data_stay_in_proportion(scan, size):
    """Homogeneous of degree one at a given noise scale: from nothing to a million times the
    right-hand side."""
    net, p = model(), normal(scan, noise=1.0)
    scaled = replace(p, b=p.b * size)
    found, expected = net(scaled), net(p) * size
    assert torch.isfinite(found).all()
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=float(expected.abs().max()) * 1e-5)


def test_callback_sees_every_step(scan):
    net, p, seen = model(), normal(scan, noise=1.0), []
    free = net(p, callback=lambda k, v: seen.append((k, v)), final_data_consistency=False)
    assert [k for k, _ in seen] == [0, 1, 2]
    assert torch.equal(seen[0][1], start(p, p.spectrum()))
    assert torch.equal(seen[2][1], free)
    assert not torch.equal(seen[1][1], free)


def test_views_that_are_known_need_not_be_made_again(scan):
    net, p = model(steps=1, bilateral=True), normal(scan, noise=1.0)
    torch.testing.assert_close(net(p, 0.5, views=first_views(p, bilateral=True)), net(p, 0.5))
