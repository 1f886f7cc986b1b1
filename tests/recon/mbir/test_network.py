"""The network: homogeneous, blind to nothing that it should see, any shape."""

import itertools
from dataclasses import replace
from functools import partial

import pytest
import torch
from refusals import refusals

from recon.mbir.network import (
    Network,
    NetworkConfig,
    from_blocks,
    largest_nearby,
    local_mean,
    to_blocks,
)

SMALL = NetworkConfig((6, 8, 8), 0.4)


@pytest.fixture(scope="module")
def network():
    """Random weights everywhere, the last layer and the gains included."""
    torch.manual_seed(0)
    made = Network(SMALL).double().requires_grad_(False)
    for name, p in made.named_parameters():
        if "gain" in name or "leave" in name:
            p.normal_(0.0, 0.2)
    return made.eval()


def volumes(shape=(2, 12, 16, 8), seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn((2, *shape), generator=generator, dtype=torch.float64)


CONDITION = torch.tensor([[0.3, -0.2, 0.0], [-1.0, 0.5, 1.0]], dtype=torch.float64)


def test_homogeneous(network):
    """Ten times the input gives ten times the output; nothing gives nothing."""
    u, towards = volumes()
    found = network(u, towards, CONDITION)
    assert float(found.std()) > 0.01
    torch.testing.assert_close(network(10 * u, 10 * towards, CONDITION), 10 * found)
    assert not network(0 * u, 0 * towards, CONDITION).any()


@pytest.mark.parametrize("which", range(3))
def test_condition_counts(network, which):
    u, towards = volumes()
    other = CONDITION.clone()
    other[0, which] += 1.0
    first, second = network(u, towards, CONDITION), network(u, towards, other)
    assert float((first[0] - second[0]).abs().max()) > 1e-3
    assert torch.equal(first[1], second[1])


@pytest.mark.parametrize("shape", [(1, 1, 1), (5, 7, 9), (8, 8, 8), (1, 13, 20)])
def test_any_shape_is_padded_with_background(network, shape):
    """What lies beyond the grid is 0, so a volume in a larger one of zeros gives the same as
    alone, but at the rim."""
    u, towards = volumes((2, *shape))
    found = network(u, towards, CONDITION)
    assert found.shape == u.shape
    padded = [
        torch.nn.functional.pad(v, (0, -shape[2] % 8, 0, -shape[1] % 8, 0, -shape[0] % 8))
        for v in (u, towards)
    ]
    whole = network(*padded, CONDITION)[:, : shape[0], : shape[1], : shape[2]]
    torch.testing.assert_close(found, whole)


def test_shifted_volumes_give_shifted_results(network):
    """By whole cells of the coarsest level, away from the rim: nothing depends on where a voxel
    lies."""
    u, towards = volumes((2, 128, 8, 8))
    for v in (u, towards):
        v[:, :56], v[:, 64:] = 0.0, 0.0
    found = network(u, towards, CONDITION)
    moved = network(u.roll(8, 1), towards.roll(8, 1), CONDITION)
    torch.testing.assert_close(moved, found.roll(8, 1))


def test_low_precision_is_for_training_only():
    torch.manual_seed(0)
    net = Network(SMALL)
    torch.nn.init.normal_(net.leave.weight, std=0.1)
    u, towards = volumes().float()
    condition = CONDITION.float()
    net.requires_grad_(False)
    exact = net.train()(u, towards, condition)
    net.half_precision = True
    rough = net(u, towards, condition)
    assert rough.dtype == torch.float32
    assert 0 < float((rough - exact).norm() / exact.norm()) < 0.05
    assert torch.equal(net.eval()(u, towards, condition), exact)


def test_blocks_and_back():
    u = volumes()[0]
    blocks = to_blocks(u)
    assert blocks.shape == (2, 8, 6, 8, 4)
    assert torch.equal(blocks[0, 0], u[0, ::2, ::2, ::2])
    assert torch.equal(from_blocks(blocks), u)


test_refusals = refusals(
    ("3 levels", lambda: NetworkConfig((8, 8))),
    ("channels", lambda: NetworkConfig((8, 0, 8))),
    ("voxel_mm", lambda: NetworkConfig(voxel_mm=0.0)),
    ("local_mm", lambda: NetworkConfig(local_mm=-1.0)),
    ("local_mm", lambda: NetworkConfig(local_mm="a")),
    ("turns", lambda: NetworkConfig(turns=1)),
    ("extremes", lambda: NetworkConfig(bilateral=True, gate=True, extremes=1)),
    ("set gate", lambda: NetworkConfig(bilateral=True, extremes=True)),
)


def test_shipped_size():
    assert sum(p.numel() for p in Network().parameters()) <= 300_000


def with_config(network, **options):
    """The same weights with other options."""
    made = Network(replace(SMALL, **options)).double().requires_grad_(False).eval()
    made.load_state_dict(network.state_dict())
    return made


def test_relative_to_the_local_mean_a_constant_passes_through(network):
    """Relative to the level it does not: what is unsure is drawn to 0."""
    u, towards = volumes()
    local = with_config(network, local_mm=1.6)
    found = local(u, towards, CONDITION)
    torch.testing.assert_close(local(u + 7.0, towards + 7.0, CONDITION), found + 7.0)
    torch.testing.assert_close(local(3.0 * u, 3.0 * towards, CONDITION), 3.0 * found)
    moved = network(u + 7.0, towards + 7.0, CONDITION) - 7.0
    assert float((moved - network(u, towards, CONDITION)).abs().max()) > 0.1


def test_local_mean_by_hand():
    """Weights of a Gaussian over the voxels that there are; a volume of one voxel is its own
    mean."""
    v = torch.zeros(1, 1, 1, 5, dtype=torch.float64)
    v[..., 0] = 1.0
    weights = torch.exp(-0.5 * (torch.arange(5, dtype=torch.float64) / 2.0) ** 2)
    assert float(local_mean(v, 2.0)[..., 0]) == pytest.approx(float(1.0 / weights.sum()))
    torch.testing.assert_close(
        local_mean(torch.full((1, 3, 4, 5), 2.5), 3.0), torch.full((1, 3, 4, 5), 2.5)
    )
    assert float(local_mean(torch.ones(1, 1, 1, 1), 8.0)) == 1.0


@pytest.mark.parametrize(("mirrored", "mean_over"), [(False, False), (False, True), (True, True)])
@pytest.mark.parametrize("quarters", range(4))
def test_a_turned_scene_gives_the_turned_volume(network, quarters, mirrored, mean_over):
    u, towards = volumes((2, 4, 8, 8))
    symmetric = partial(with_config(network, turns=True), mirrored=mean_over)

    def turned(v):
        return torch.rot90(v.flip(-2) if mirrored else v, quarters, (-2, -1))

    found = symmetric(turned(u), turned(towards), CONDITION)
    torch.testing.assert_close(
        found, turned(symmetric(u, towards, CONDITION)), rtol=1e-5, atol=1e-6
    )
    if quarters or mirrored:
        alone = network(turned(u), turned(towards), CONDITION) - turned(
            network(u, towards, CONDITION)
        )
        assert float(alone.abs().max()) > 1e-3


def test_turns_of_what_is_not_square(network):
    """The mean over turns changes no shape."""
    u, towards = volumes((2, 3, 7, 10))
    assert with_config(network, turns=True, local_mm=1.0)(u, towards, CONDITION).shape == u.shape


def test_gradients_of_the_local_mean_under_autocast():
    """The backward pass, too, where a plain product of matrices is computed in 8 bits."""
    v, seen = (torch.randn(1, 6, 7, 8, generator=torch.Generator().manual_seed(k)) for k in (0, 1))

    def gradient():
        x = v.clone().requires_grad_()
        return torch.autograd.grad((local_mean(x, 1.5) * seen).sum(), x)[0]

    plain = gradient()
    with torch.autocast("cpu", torch.bfloat16):
        torch.testing.assert_close(gradient(), plain)


@pytest.mark.parametrize("reach", [1, 2, 5])
@pytest.mark.parametrize("shape", [(1, 1, 1), (3, 8, 5), (12, 2, 9)])
def test_largest_nearby_by_hand(reach, shape):
    v = torch.randn(2, *shape, generator=torch.Generator().manual_seed(5))
    found = largest_nearby(v, reach)
    for at in itertools.product(*(range(n) for n in shape)):
        near = tuple(slice(max(i - reach, 0), i + reach + 1) for i in at)
        assert torch.equal(found[(slice(None), *at)], v[(slice(None), *near)].flatten(1).amax(1))


def with_extremes():
    """Random weights, but for the last layer: it gives nothing of its own, and equal weights."""
    torch.manual_seed(0)
    config = replace(SMALL, bilateral=True, gate=True, extremes=True, local_mm=1.6, turns=True)
    made = Network(config).double().requires_grad_(False).eval()
    made.leave.weight.zero_()
    return made


def test_extremes_are_views_that_the_gate_takes():
    """With equal weights of the four choices the result is their mean: nothing (the local mean),
    the filtered view, its highest and its lowest value nearby."""
    network = with_extremes()
    (u, towards), (filtered, _) = volumes(), volumes(seed=1)
    level = local_mean(u, 1.6 / SMALL.voxel_mm)
    high, low = largest_nearby(filtered, 1), -largest_nearby(-filtered, 1)
    torch.testing.assert_close(
        network(u, towards, CONDITION, filtered), (level + filtered + high + low) / 4
    )


def test_with_extremes_units_turns_and_constants_are_kept():
    network = with_extremes()
    network.leave.weight.normal_(0.0, 0.2, generator=torch.Generator().manual_seed(3))
    u, towards = volumes((2, 8, 8, 8))
    filtered = volumes((2, 8, 8, 8), seed=1)[0]
    found = network(u, towards, CONDITION, filtered)
    scaled = network(1e6 * u, 1e6 * towards, CONDITION, 1e6 * filtered)
    more = network(2e6 * u, 2e6 * towards, CONDITION, 2e6 * filtered)
    torch.testing.assert_close(more, 2 * scaled, rtol=1e-4, atol=1.0)
    moved = network(u + 7.0, towards + 7.0, CONDITION, filtered + 7.0)
    torch.testing.assert_close(moved, found + 7.0)
    turned = [torch.rot90(v, 1, (-2, -1)) for v in (u, towards, filtered)]
    torch.testing.assert_close(
        network(turned[0], turned[1], CONDITION, turned[2]), torch.rot90(found, 1, (-2, -1))
    )


def test_every_weight_of_a_network_with_extremes_learns():
    network = with_extremes()
    network.leave.weight.normal_(0.0, 0.2, generator=torch.Generator().manual_seed(3))
    network.requires_grad_(True).train()
    u, towards = volumes()
    network(u, towards, CONDITION, volumes(seed=1)[0]).square().sum().backward()
    assert all(p.grad.abs().amax() > 0 for p in network.parameters())
