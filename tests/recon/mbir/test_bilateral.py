"""The joint bilateral filter as a layer, and as a view of the network."""

import sys
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.mbir.bilateral import _offsets, joint_bilateral
from recon.mbir.network import GUIDE_VOXELS, Network, NetworkConfig, edge_preserved, local_mean
from recon.mbir.unrolled import Unrolled, guide_noise, limited

T = torch.tensor([0.6, 1.1])


def volumes(shape=(2, 6, 7, 8), seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(shape, generator=generator), 0.5 * torch.randn(shape, generator=generator)


def by_definition(u, guide, threshold, reach=2.5, step=1):
    """The sum over all pairs of voxels."""
    out = torch.empty_like(u, dtype=torch.float64)
    at = (
        torch.stack(torch.meshgrid(*[torch.arange(n) for n in u.shape[1:]], indexing="ij"), -1)
        .reshape(-1, 3)
        .double()
    )
    apart = at[:, None] - at
    square = apart.square().sum(-1)
    near = (
        torch.exp(-0.5 * square / reach**2)
        * (square <= (2 * reach) ** 2)
        * (apart % step == 0).all(-1)
    )
    for b in range(len(u)):
        g, v = guide[b].double().flatten(), u[b].double().flatten()
        alike = (1 - ((g[:, None] - g) / threshold[b]).square() / 4).clamp_min(0).square()
        weights = near * alike
        out[b] = (weights @ v / weights.sum(1)).reshape(u.shape[1:])
    return out


@pytest.mark.parametrize(("reach", "step"), [(2.5, 1), (1.2, 1), (3.0, 2)])
def test_it_is_what_it_says(reach, step):
    u, guide = volumes()
    found = joint_bilateral(u, guide, T, reach, step).double()
    torch.testing.assert_close(found, by_definition(u, guide, T, reach, step), rtol=1e-4, atol=1e-5)


def test_without_noise_nothing_is_filtered_and_nan_raises_nothing():
    u, guide = volumes()
    torch.testing.assert_close(joint_bilateral(u, guide, 0.0 * T), u)
    bad = u.clone()
    bad[0, 2, 3, 4] = float("nan")
    for found in (joint_bilateral(bad, guide, T), joint_bilateral(u, bad, T)):
        assert bool(found[1].isfinite().all())
    assert bool(joint_bilateral(bad, guide, T)[0].isnan().any())


@pytest.mark.parametrize("nx", [1, 5, 16, 37])
def test_rows_of_any_length(nx):
    u, guide = volumes((2, 3, 4, nx))
    guide = guide + 1e3
    found = joint_bilateral(u, guide, T).double()
    torch.testing.assert_close(found, by_definition(u, guide, T), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("which", [0, 1])
def test_gradients(which):
    given = list(volumes((2, 4, 5, 6)))
    push, seen = (
        torch.randn(2, 4, 5, 6, generator=torch.Generator().manual_seed(k)) for k in (3, 4)
    )
    given[which].requires_grad_()
    (joint_bilateral(*given, T) * seen).sum().backward()
    slope = float((given[which].grad * push).sum())
    ends = []
    for sign in (1, -1):
        moved = [v.detach() for v in given]
        moved[which] = moved[which] + sign * 1e-2 * push
        ends.append(float((joint_bilateral(*moved, T).double() * seen).sum()))
    assert (ends[0] - ends[1]) / 2e-2 == pytest.approx(slope, rel=0.02, abs=0.02)


def test_the_gpu_kernels_give_the_same():
    """By Triton's interpreter, forward and both gradients."""
    if sys.platform != "linux":  # where the test extra brings Triton along
        pytest.importorskip("triton")
    from triton import knobs

    if not knobs.runtime.interpret:
        pytest.skip("TRITON_INTERPRET=0: kernels need a GPU")
    from recon.mbir import bilateral_triton

    given = [v.requires_grad_() for v in volumes((2, 4, 5, 6))]
    push = torch.randn(2, 4, 5, 6, generator=torch.Generator().manual_seed(3))
    found = joint_bilateral(*given, T, 3.0, 2)
    found.backward(push)
    offsets, weights = (torch.from_numpy(v) for v in _offsets(3.0, 2))
    near, plain = (offsets.int(), weights), [v.detach() for v in given]
    out, total = bilateral_triton.forward(*plain, 1 / T, *near)
    torch.testing.assert_close(out, found.detach())
    gradients = bilateral_triton.backward(*plain, 1 / T, *near, out, total, push)
    for mine, other in zip(gradients, given, strict=True):
        torch.testing.assert_close(mine, other.grad, rtol=1e-4, atol=1e-6)


CONFIG = NetworkConfig((6, 8, 8), 0.4, local_mm=1.6, turns=True, bilateral=True)


def test_the_network_starts_from_half_of_it():
    """With its last layer off it gives the filtered volume's share; turned and shifted scenes
    come along."""
    torch.manual_seed(0)
    network = Network(CONFIG).eval().requires_grad_(False)
    u, towards = volumes((1, 8, 8, 8))
    condition, noise = torch.zeros(1, 3), torch.tensor([0.3])

    def run(u, towards):
        return network(u, towards, condition, edge_preserved(towards, noise))

    found = run(u, towards)
    torch.testing.assert_close(run(u + 5, towards + 5), found + 5, rtol=1e-4, atol=1e-4)
    turned = run(*(torch.rot90(v, 1, (-2, -1)) for v in (u, towards)))
    torch.testing.assert_close(turned, torch.rot90(found, 1, (-2, -1)), rtol=1e-4, atol=1e-4)
    network.leave.weight.zero_()
    level = local_mean(u, 4.0)
    smooth = joint_bilateral(towards, local_mean(towards, GUIDE_VOXELS), 2.8 * noise, 2.5)
    smooth = joint_bilateral(smooth, smooth, 1.4 * noise, 4.0, 2)
    torch.testing.assert_close(run(u, towards), 0.5 * (level + smooth), rtol=1e-4, atol=1e-4)
    with pytest.raises(ValueError, match="smoothed view"):
        network(u, towards, condition)


@settings(max_examples=30, deadline=None)
@given(st.floats(-50, 50), st.floats(0.1, 3.0), st.floats(0.0, 4.0), st.integers(0, 1000))
def test_overshoot_of_strong_edges_is_cut_off_and_weak_structures_stay(level, noise, ripple, seed):
    """Within 5 voxels of a step of 30 guide noises nothing leaves the range of the filter's
    values."""
    sd = torch.tensor([noise])
    smoothed = torch.full((1, 6, 6, 40), level)
    smoothed[..., :10] += 30 * noise
    u = smoothed + ripple * noise * torch.randn(
        smoothed.shape, generator=torch.Generator().manual_seed(seed)
    )
    found = limited(u, smoothed, sd)
    assert float(found[..., 5:15].max()) <= float(smoothed.max()) + 1e-4
    assert float(found[..., 5:15].min()) >= float(smoothed.min()) - 1e-4
    torch.testing.assert_close(
        found[..., 15:], u[..., 15:].clamp(level - 10 * noise, level + 10 * noise)
    )
    beside, kept = u[..., 5:15], found[..., 5:15]
    inner = (beside > level + 1e-3 * noise) & (beside < level + 29.999 * noise)
    torch.testing.assert_close(kept[inner], beside[inner])


@pytest.mark.extended
def test_noise_of_the_guide_is_that_of_draws(normalised):
    """White spectra of two sizes: the formula against drawn noise through the same steps."""
    problem, towards = normalised
    found = guide_noise(problem.spectrum(), problem.b.shape[-3:], problem.voxel_mm)
    inner = local_mean(towards, GUIDE_VOXELS)[:, 6:-6, 6:-6, 6:-6]
    assert float(inner.std()) == pytest.approx(float(found[0]), rel=0.1)


@pytest.fixture(scope="module")
def normalised():
    """Noise alone, and the first step towards it."""
    from recon.mbir.frequencies import filtered
    from recon.mbir.unrolled import start
    from train.config import DataConfig
    from train.data import situation_term

    config = DataConfig(shape=(28, 28, 28), views=120)
    empty = situation_term(config.situations[0], config)
    noise = empty.operator.noise((8,), generator=torch.Generator().manual_seed(0))
    problem = replace(empty, b=noise, scale=torch.ones(8)).in_noise_units()
    spectrum = problem.spectrum()
    v = start(problem, spectrum)
    return problem, v + filtered(problem.b - problem.apply(v), 1.0 / (spectrum + 0.1))


@pytest.mark.extended
def test_unrolled_with_the_filter_is_differentiable_in_the_data(normalised):
    problem, _ = normalised
    model = Unrolled(replace(CONFIG, voxel_mm=0.2), steps=1).eval()
    beta = problem.b[:1].clone().requires_grad_()
    one = replace(problem, b=beta, unit=problem.unit_hu[:1], scale=problem.scale[:1])
    model(one).square().sum().backward()
    assert bool(torch.isfinite(beta.grad).all())
    assert float(beta.grad.abs().max()) > 0
