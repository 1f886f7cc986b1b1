"""Scans of other scanners, whole field: parallel, fan, cone, stacks, dead cells, bodies beyond
the grid."""

import math

import numpy as np
import pytest
import torch

from recon import reconstruct
from recon.least_squares.field_problem import FieldProblem, field_prior, larger_grid
from recon.least_squares.qggmrf import DEFAULT_PRIOR
from torchpcct import ConeBeam, FanBeam, ParallelBeam, Projector, Scan, VolumeGrid, full_turn

MU = 0.02
GEOMETRIES = {
    "parallel": (ParallelBeam(np.arange(90) * math.pi / 90, 36, 1.0), VolumeGrid((32, 32), 1.0)),
    "fan": (FanBeam(full_turn(120), 100.0, 160.0, 60, 1.0), VolumeGrid((32, 32), 1.0)),
    "cone": (ConeBeam(full_turn(90), 100.0, 160.0, 56, 16, 1.0), VolumeGrid((6, 32, 32), 1.0)),
}


def body(grid, radius=11.0, half_height=2.0):
    """Water with a denser rod; ends inside the grid along z."""
    axes = torch.meshgrid(*[torch.from_numpy(a) for a in grid.axes], indexing="ij")
    y, x = axes[-2:]
    mu = MU * (torch.hypot(y, x) < radius) + 0.2 * MU * (torch.hypot(y - 3, x + 4) < 3)
    if grid.ndim == 3:
        mu = mu * (axes[0].abs() < half_height)
    return mu.float()


def hu_error(volume, truth, where):
    return float((volume.data - 1000 * (truth / MU - 1))[where].square().mean().sqrt())


@pytest.mark.parametrize(
    "name",
    [
        name if name == "parallel" else pytest.param(name, marks=pytest.mark.extended)
        for name in GEOMETRIES
    ],
)
def test_counts_and_line_integrals_of_any_geometry(name):
    geometry, grid = GEOMETRIES[name]
    truth = body(grid)
    lines = Projector(geometry, grid)(truth)
    counts = torch.poisson(2e4 * torch.exp(-lines), generator=torch.Generator().manual_seed(0))
    inside = (
        torch.hypot(*torch.meshgrid(*[torch.from_numpy(a) for a in grid.axes[-2:]], indexing="ij"))
        < 9
    )
    inside = inside.expand(grid.shape)
    scan = Scan.from_counts(counts, geometry, air=2e4, mu_water=MU)
    fbp = reconstruct(scan, grid, "fbp")
    volume = reconstruct(scan, grid, "pwls", tolerance=2.0)
    assert volume.report["converged"]
    assert volume.report["warnings"] == []
    assert 0.5 < volume.report["chi2"] < 1.1
    assert hu_error(volume, truth, inside) < hu_error(fbp, truth, inside)
    given = Scan.from_line_integrals(lines, geometry, photons=2e4, mu_water=MU)
    assert hu_error(reconstruct(given, grid, "pwls", tolerance=2.0), truth, inside) < hu_error(
        volume, truth, inside
    )


def test_a_stack_is_each_slice_alone():
    geometry, grid = GEOMETRIES["parallel"]
    lines = Projector(geometry, grid)(torch.stack([body(grid), body(grid, radius=6.0)]))
    stack = VolumeGrid((2, *grid.shape), 1.0)
    both = reconstruct(
        Scan.from_line_integrals(lines, geometry, photons=1e5, mu_water=MU), stack, "pwls"
    )
    assert both.report["slices"] == 2
    for k in (0, 1):
        one = Scan.from_line_integrals(lines[k], geometry, photons=1e5, mu_water=MU)
        torch.testing.assert_close(
            both.data[k], reconstruct(one, grid, "pwls").data, atol=0.1, rtol=0
        )
    with pytest.raises(ValueError, match="slices first"):
        FieldProblem(Scan.from_line_integrals(lines, geometry, photons=1e5), grid)


def test_a_body_beyond_the_grid_is_reconstructed_with_it():
    """The same values as from a grid that holds everything."""
    geometry, grid = GEOMETRIES["fan"]
    scan = Scan.from_line_integrals(
        Projector(geometry, grid)(body(grid)), geometry, photons=1e5, mu_water=MU
    )
    small = VolumeGrid((14, 14), 1.0, (2.0, -3.0))
    problem = FieldProblem(scan, small)
    assert problem.work == larger_grid(small, geometry)
    assert problem.work.extent[0] > 30
    assert FieldProblem(scan, grid).work == grid
    prior = field_prior(1.0, 2)
    part = reconstruct(scan, small, "pwls", prior=prior, tolerance=0.3).data
    whole = reconstruct(scan, grid, "pwls", prior=prior, tolerance=0.3).data
    first = [round(s[0] - w[0]) for s, w in zip(small.axes, grid.axes, strict=True)]
    cut = whole[first[0] : first[0] + 14, first[1] : first[1] + 14]
    assert float((part - cut).square().mean().sqrt()) < 3.0


def test_dead_cells_and_electronic_noise():
    geometry, grid = GEOMETRIES["parallel"]
    lines = Projector(geometry, grid)(body(grid))
    raw = 5e4 * torch.exp(-lines) + 300.0
    raw[:, 20] = float("nan")
    scan = Scan.from_counts(
        raw, geometry, air=5e4 + 300.0, dark=300.0, electronic_noise=20.0, mu_water=MU
    )
    assert not scan.counting
    volume = reconstruct(scan, grid, "pwls")
    assert volume.report["converged"]
    assert abs(float(volume.data[10:14, 14:18].mean())) < 10


def test_the_prior_follows_the_voxels():
    assert field_prior(0.25) == DEFAULT_PRIOR
    # A micro-CT scan: the same numbers, all lengths a hundredth.
    geometry, grid = GEOMETRIES["parallel"]
    lines = Projector(geometry, grid)(body(grid))
    fine = ParallelBeam(geometry.angles, geometry.columns, 0.01)
    scans = [(Scan.from_line_integrals(lines, geometry, photons=1e4, mu_water=MU), grid)]
    scans += [
        (
            Scan.from_line_integrals(lines, fine, photons=1e4, mu_water=100 * MU),
            VolumeGrid(grid.shape, 0.01),
        )
    ]
    large, small = (reconstruct(s, g, "pwls", tolerance=0.3).data for s, g in scans)
    assert float((large - small).square().mean().sqrt()) < 0.2 * float(large[8:24, 8:24].std())
