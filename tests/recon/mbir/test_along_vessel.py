"""Smoothing along vessels: directions of tilted tubes, and the penalty against a dense matrix."""

import math

import pytest
import torch

from recon.mbir.along_vessel import VesselSmoothing

VOXEL = 0.2


def directions(pilot):
    return VesselSmoothing.of(pilot, VOXEL, torch.ones(len(pilot))).tensor


def tube(direction, shape=(28, 28, 28), radius=1.5):
    """A tube of 400 HU through the middle, (z, y, x) ``direction``."""
    axes = [(torch.arange(n) - (n - 1) / 2) * VOXEL for n in shape]
    p = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)
    d = torch.tensor(direction) / torch.linalg.vector_norm(torch.tensor(direction))
    distance = (p - (p @ d)[..., None] * d).norm(dim=-1)
    return 400.0 * torch.sigmoid((radius - distance) / 0.1), d


@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (1.0, 0.5, 0.0), (1.0, -0.4, 0.7), (0.0, 0.6, 0.8)])
def test_finds_the_direction_of_a_tube_in_noise(direction):
    volume, d = tube(direction)
    noisy = volume + 100.0 * torch.randn(volume.shape, generator=torch.Generator().manual_seed(0))
    zz, yy, xx, zy, zx, yx = directions(noisy[None])[0, :, 14, 14, 14]
    tensor = torch.stack([torch.stack([zz, zy, zx]), torch.stack([zy, yy, yx]), torch.stack([zx, yx, xx])])
    assert float(tensor.trace()) > 0.6
    assert float(d @ tensor @ d / tensor.trace()) > math.cos(math.radians(8)) ** 2


def test_a_plane_and_noise_alone_are_not_smoothed():
    noise = torch.randn(1, 28, 28, 28, generator=torch.Generator().manual_seed(0))
    plane = 400.0 * (torch.arange(28) > 13).float().expand(1, 28, 28, 28)
    for volume in (noise, 100 * noise + plane):
        coherence = directions(volume)[:, :3].sum(1)
        assert float(coherence.mean()) < 0.35


def smoothing(shape=(4, 5, 6), seed=0):
    generator = torch.Generator().manual_seed(seed)
    t = torch.randn(2, *shape, 3, generator=generator, dtype=torch.float64)
    t = t / t.norm(dim=-1, keepdim=True) * torch.rand(2, *shape, 1, generator=generator, dtype=torch.float64).sqrt()
    pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    tensor = torch.stack([t[..., i] * t[..., j] for i, j in pairs], 1)
    return VesselSmoothing(tensor, torch.tensor([0.7, 2.0], dtype=torch.float64))


def test_gradient_is_a_symmetric_positive_operator_within_its_bound():
    s, shape = smoothing(), (4, 5, 6)
    n = math.prod(shape)
    columns = [s.gradient(e.reshape(shape).expand(2, *shape)).reshape(2, n) for e in torch.eye(n, dtype=torch.float64)]
    matrix = torch.stack(columns, -1)
    torch.testing.assert_close(matrix, matrix.mT)
    values = torch.linalg.eigvalsh(matrix)
    assert float(values.min()) > -1e-12
    assert bool((values[:, -1] <= s.bound()).all())
    assert float(s.gradient(torch.ones(2, *shape, dtype=torch.float64)).abs().max()) < 1e-12


def test_gradient_is_that_of_the_energy():
    s = smoothing()
    u = torch.randn(2, 4, 5, 6, dtype=torch.float64, requires_grad=True)
    (expected,) = torch.autograd.grad(s.energy(u).sum(), u)
    torch.testing.assert_close(s.gradient(u), expected)


def test_uniform_field_equals_its_spectrum_inside():
    """Along z everywhere: the operator is a convolution, whose eigenvalues the spectrum holds."""
    tensor = torch.zeros(1, 6, 32, 8, 8)
    tensor[:, 0] = 1.0
    s = VesselSmoothing(tensor, torch.tensor([1.5]))
    k = 5
    wave = torch.cos(2 * math.pi * k / 32 * torch.arange(32.0))[:, None, None].expand(1, 32, 8, 8)
    inside = (0, slice(8, 24), 4, 4)
    torch.testing.assert_close(s.gradient(wave)[inside], s.spectrum()[0, k, 0, 0] * wave[inside], rtol=1e-4, atol=1e-4)


def test_nan_and_zero_volumes_do_not_stop_it():
    for value in (0.0, math.nan, 1e-30, 1e18):
        assert bool(torch.isfinite(directions(torch.full((1, 9, 10, 11), value))).all())
