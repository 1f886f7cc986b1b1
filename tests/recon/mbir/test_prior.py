"""The learned prior: an energy whose gradient, bound and conditioning are what they claim to be."""

import pytest
import torch

from recon.mbir.prior import LearnedPrior, PriorConfig, from_blocks, to_blocks


def prior(seed=0, **config):
    """A prior with random values, float64."""
    torch.manual_seed(seed)
    made = LearnedPrior(PriorConfig(**{"levels": 2, "filters": 6, "units": 4, **config})).double()
    with torch.no_grad():
        for p in made.parameters():
            p += 0.4 * torch.randn_like(p)
    return made.requires_grad_(False)


@pytest.mark.parametrize("shape", [(8, 8, 8), (9, 10, 7), (3, 5, 4)])
def test_gradient_is_that_of_the_energy(shape):
    p = prior()
    u = (2.0 * torch.randn(2, *shape, dtype=torch.float64)).requires_grad_()
    scale = torch.tensor([60.0, 500.0], dtype=torch.float64)
    (expected,) = torch.autograd.grad(p.energy(u, scale).sum(), u)
    torch.testing.assert_close(p.gradient(u, scale), expected, rtol=1e-10, atol=1e-12)


def test_slope_bound_holds():
    """No pair of volumes has gradients further apart than the bound allows; some come close to its order."""
    p = prior(levels=1)
    scale = torch.full((1,), 200.0, dtype=torch.float64)
    v = torch.randn(1, 8, 8, 8, dtype=torch.float64)
    for _ in range(40):  # power iteration on the Hessian at 0, where the potentials bend most
        v = p.gradient(1e-5 * v / v.norm(), scale) / 1e-5
    steepest, bound = float(v.norm()), float(p.slope_bound(scale))
    assert steepest <= bound * (1 + 1e-6)
    assert steepest > 0.2 * bound
    a, b = torch.randn(2, 1, 8, 8, 8, dtype=torch.float64)
    assert float((p.gradient(a, scale) - p.gradient(b, scale)).norm() / (a - b).norm()) <= bound


def test_large_contrasts_are_let_go():
    """The pull on a step grows with its height at first and falls again: an edge of bone is not shrunk like noise."""
    p = LearnedPrior(PriorConfig(levels=1)).double().requires_grad_(False)
    step = torch.zeros(1, 8, 8, 8, dtype=torch.float64)
    step[..., 4:] = 1.0
    scale = torch.full((1,), 200.0, dtype=torch.float64)
    pulls = [float(p.gradient(h * step, scale).norm()) for h in (0.1, 1.0, 1e4)]
    assert pulls[0] < pulls[1]
    assert pulls[2] < pulls[1]


def test_a_constant_inside_costs_nothing():
    p = prior(levels=1)
    flat = torch.full((1, 16, 16, 16), 3.0, dtype=torch.float64)
    gradient = p.gradient(flat, torch.full((1,), 200.0, dtype=torch.float64))
    assert float(gradient[:, 4:-4, 4:-4, 4:-4].abs().max()) < 1e-12
    assert float(gradient.abs().max()) > 1e-3  # against the background outside of the grid


def test_scale_conditions_the_strength():
    p = LearnedPrior().requires_grad_(False)
    low, high = (float(p.curvature(torch.tensor([s]))) for s in (60.0, 600.0))
    assert high > 2 * low


def test_blocks_are_a_permutation():
    u = torch.arange(2.0 * 4 * 6 * 8).reshape(2, 4, 6, 8)
    blocks = to_blocks(u)
    assert blocks.shape == (2, 8, 2, 3, 4)
    assert torch.equal(blocks[0, :, 0, 0, 0], u[0, :2, :2, :2].flatten())
    assert torch.equal(from_blocks(blocks), u)


def test_size_of_the_shipped_configuration():
    assert sum(p.numel() for p in LearnedPrior().parameters()) <= 50_000


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"levels": 0}, "levels"),
        ({"filters": 25}, "multiple"),
        ({"units": True}, "units"),
        ({"thresholds": (0.0,)}, "thresholds"),
        ({"voxel_mm": -1.0}, "voxel_mm"),
    ],
)
def test_refusals(changes, message):
    with pytest.raises(ValueError, match=message):
        PriorConfig(**changes)
