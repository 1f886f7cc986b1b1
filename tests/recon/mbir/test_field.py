"""The learned prior on whole fields: operator and noise units, blocks, grids, foreign scans from
end to end."""

import math

import numpy as np
import pytest
import torch

from recon import reconstruct
from recon.data_term import Quadratic
from recon.least_squares.field_problem import FieldProblem
from recon.mbir.field import FieldGram, _turned, blockwise, trained_grid
from recon.mbir.frequencies import filtered
from recon.mbir.mbir import Mbir
from recon.mbir.network import Network, NetworkConfig
from torchpcct import ConeBeam, ParallelBeam, Projector, Scan, VolumeGrid, full_turn

MU = 0.02
HU = 2e-5
PARALLEL = ParallelBeam(np.arange(120) * math.pi / 120, 48, 0.5)
SLICES = VolumeGrid((8, 48, 48), 0.5)
CONE = ConeBeam(full_turn(90), 60.0, 100.0, 48, 16, 1.0)


def stack(photons=5e3, seed=0):
    """A scan of eight slices of water with rods that lean, and its truth."""
    z, y, x = torch.meshgrid(*[torch.from_numpy(a) for a in SLICES.axes], indexing="ij")
    mu = MU * (torch.hypot(y, x) < 9) + 0.2 * MU * (torch.hypot(y - 2 - 0.3 * z, x) < 1.5)
    truth = (mu - 0.6 * MU * (torch.hypot(y + 4, x - 2) < 2.5)).float()
    lines = Projector(PARALLEL, SLICES.slice)(truth)
    counts = torch.poisson(
        photons * torch.exp(-lines), generator=torch.Generator().manual_seed(seed)
    )
    return Scan.from_counts(counts, PARALLEL, air=photons, mu_water=MU), truth


@pytest.fixture(scope="module")
def shipped():
    return Mbir.load()


def test_noise_looks_the_same_everywhere_in_noise_units():
    """β − H u has variance about that of the spectrum, in the middle and where the rays are
    bright."""
    scan, truth = stack()
    problem = FieldProblem(scan, SLICES)
    slices = problem.slices(scan)
    gram = FieldGram(problem, [w for _, w in slices], 0.2)
    b = gram.ratio * torch.stack([problem.projector.T(w * y) for y, w in slices])
    normal = Quadratic(gram, b[None], torch.ones(1), (0.2,) * 3, 1000 * HU).in_noise_units()
    u = truth / HU / (normal.unit_hu * gram.ratio)
    noise = (normal.b - normal.apply(u[None]))[0]
    expected = float(normal.spectrum().expand(1, 8, 48, 25).mean())
    r = torch.hypot(
        *torch.meshgrid(*[torch.from_numpy(a) for a in SLICES.slice.axes], indexing="ij")
    )
    for ring in (r < 5, (r > 8.5) & (r < 11)):
        assert float(noise[:, ring].square().mean()) == pytest.approx(expected, rel=0.4)
    assert float(gram.ratio[:, r < 11].max() / gram.ratio[:, r < 11].min()) > 1.1
    v, w = torch.randn(2, 1, *SLICES.shape, generator=torch.Generator().manual_seed(1))
    assert float((v * normal.apply(w)).sum()) == pytest.approx(
        float((w * normal.apply(v)).sum()), rel=1e-3
    )


def test_blocks_with_all_that_the_network_sees_are_the_whole():
    torch.manual_seed(0)
    network = Network(NetworkConfig((4, 4, 4))).eval().requires_grad_(False)
    a, b = torch.randn(2, 1, 8, 8, 160)
    scales, condition = torch.full((8, 8, 160), 270.0), torch.tensor([[math.log(1.35), 0.0, 1.0]])
    whole = network(a, b, condition)
    parts = blockwise(network, scales, a, b, condition, None, block=24, halo=56)
    torch.testing.assert_close(parts, whole, atol=1e-4 * float(whole.std()), rtol=1e-4)
    near = blockwise(network, scales, a, b, condition, None, block=24, halo=16)
    assert 0 < float((near - whole).square().mean().sqrt()) < 0.1 * float(whole.std())


def test_a_stack_of_slices_is_nearer_to_the_truth_than_fbp(shipped):
    scan, truth = stack()
    inside = (
        torch.hypot(
            *torch.meshgrid(*[torch.from_numpy(a) for a in SLICES.slice.axes], indexing="ij")
        )
        < 11
    )
    wanted = 1000 * (truth / MU - 1)

    def rmse(volume):
        return float((volume.data - wanted)[:, inside].square().mean().sqrt())

    volume = reconstruct(scan, SLICES, "mbir", network=shipped)
    assert rmse(volume) < 0.9 * rmse(reconstruct(scan, SLICES, "fbp", kernel="soft"))
    assert 0 < volume.report["residual"] < 0.02
    assert 0.5 < volume.report["chi2"] < 1.2
    assert volume.report["voxel_mm"] == 0.5


def starved(photons, seed=0):
    """Two dense rods beside the middle of eight slices of water: few photons cross both."""
    _, y, x = torch.meshgrid(*[torch.from_numpy(a) for a in SLICES.axes], indexing="ij")
    rods = torch.hypot(x.abs() - 6, y) < 2
    truth = (MU * (torch.hypot(y, x) < 11) + 60 * MU * rods).float()
    lines = Projector(PARALLEL, SLICES.slice)(truth)
    counts = torch.poisson(
        photons * torch.exp(-lines), generator=torch.Generator().manual_seed(seed)
    )
    return Scan.from_counts(counts, PARALLEL, air=photons, mu_water=MU)


@pytest.mark.extended
def test_a_denoiser_in_the_networks_place_is_told_the_noise_of_the_field():
    """What it sees of two scans differs by that noise; a filter by name lowers the error without
    any weights."""
    seen = []

    def nothing(volume, sigma):
        seen.append((volume, sigma))
        return volume

    inside = (
        torch.hypot(
            *torch.meshgrid(*[torch.from_numpy(a) for a in SLICES.slice.axes], indexing="ij")
        )
        < 8
    )
    volumes = [reconstruct(stack(seed=k)[0], SLICES, "mbir", prior=nothing) for k in range(2)]
    (first, sigma), (second, _) = seen
    assert float((first - second)[:, inside].std()) / math.sqrt(2) == pytest.approx(sigma, rel=0.25)
    scan, truth = stack()
    wanted = 1000 * (truth / MU - 1)
    filtered = reconstruct(scan, SLICES, "mbir:prior=perona-malik")
    errors = [
        float((v.data - wanted)[:, inside].square().mean().sqrt()) for v in (volumes[0], filtered)
    ]
    assert errors[1] < 0.7 * errors[0]
    assert filtered.report["prior"] == "perona_malik"
    assert "weights_sha256" not in filtered.report


def test_a_step_towards_the_data_is_not_mostly_noise_where_rays_beside_the_middle_are_starved():
    scan = starved(5e4)
    problem = FieldProblem(scan, SLICES)
    slices = problem.slices(scan)
    gram = FieldGram(problem, [w for _, w in slices], 0.2)
    noise = torch.stack(
        [
            problem.projector.T(
                w.sqrt() * torch.randn(w.shape, generator=torch.Generator().manual_seed(k))
            )
            for k, (_, w) in enumerate(slices)
        ]
    )
    b = (gram.ratio * noise)[None]
    normal = Quadratic(gram, b, torch.ones(1), (0.2,) * 3, 1000 * HU).in_noise_units()
    step = filtered(normal.b, 1.0 / (normal.spectrum() + 0.1))[0]
    y, x = torch.meshgrid(*[torch.from_numpy(a) for a in SLICES.slice.axes], indexing="ij")
    # Noise of covariance H becomes H / (H + 0.1)², 2.5 at most, wherever H is what it is taken for.
    for part in ((y.abs() > 5) & (torch.hypot(y, x) < 10), torch.hypot(y, x) < 3):
        assert 1.0 < float(step[:, part].square().mean()) < 2.5


def test_mean_of_a_spectrum_over_the_directions():
    y, x = torch.fft.fftfreq(30)[:, None], torch.fft.rfftfreq(41)
    round_one = torch.exp(-20 * (y**2 + x**2))
    longer = 1 + 0.5 * torch.cos(2 * torch.atan2(y.expand(30, 21), x.expand(30, 21)))
    found = _turned(torch.stack([round_one, round_one * longer]), (2, 30, 41))
    inside = (torch.hypot(y, x) > 0.1) & (torch.hypot(y, x) < 0.45)
    assert float((found[0] - round_one)[inside].abs().max()) < 0.08
    assert float((found[1] / found[0])[inside].sub(1).abs().max()) < 0.1


def test_one_slice_and_a_cone_beam(shipped):
    scan, _ = stack()
    one = Scan.from_line_integrals(scan.line_integrals()[3], PARALLEL, photons=5e3, mu_water=MU)
    volume = reconstruct(one, SLICES.slice, "mbir", network=shipped)
    assert volume.data.shape == (48, 48)
    assert any("single slice" in text for text in volume.report["warnings"])

    grid = VolumeGrid((6, 28, 28), 1.2)
    z, y, x = torch.meshgrid(*[torch.from_numpy(a) for a in grid.axes], indexing="ij")
    body = (MU * (torch.hypot(y, x) < 11) * (z.abs() < 2)).float()
    lines = Projector(CONE, grid)(body)
    scan = Scan.from_line_integrals(lines, CONE, photons=1e4, mu_water=MU)
    coarse = reconstruct(scan, grid, "mbir", network=shipped)
    # 1.2 mm on cells of 0.6 mm: worked on voxels of a cell, and averaged.
    assert coarse.report["voxel_mm"] == pytest.approx(0.6)
    middle = (torch.hypot(y, x) < 8) & (z.abs() < 1)
    assert abs(float(coarse.data[middle].mean())) < 15


def test_grids_that_the_network_can_work_on():
    assert trained_grid(SLICES.slice, PARALLEL) == SLICES.slice
    assert trained_grid(VolumeGrid((4, 8, 8), (1.0, 0.6, 0.6)), CONE) == VolumeGrid((7, 8, 8), 0.6)
    scan, _ = stack()
    with pytest.raises(ValueError, match="finer than what the network was trained for"):
        reconstruct(scan, VolumeGrid((8, 96, 96), 0.25), "mbir")
    with pytest.raises(ValueError, match="noise_map"):
        reconstruct(scan, SLICES, "mbir", noise_map=True)
