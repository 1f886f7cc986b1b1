"""FBP of an inset with several channels of line integrals, and its covariance."""

import numpy as np
import pytest
import torch
from refusals import refused
from small_scan import SPECTRAL_GRID as GRID

from recon.analytic.exact_noise import functional_covariance
from recon.analytic.fbp import fbp
from recon.analytic.inset import InsetFbp, static_fbp
from torchpcct import VolumeGrid


@pytest.fixture(scope="module")
def run(spectral):
    return InsetFbp(spectral[0], [GRID], ["standard"], exterior=spectral[3])


def test_channels_are_the_fbp_of_the_whole_rows(spectral, run):
    clean, _, inside, around = spectral
    g, w = clean.geometry, clean.window
    whole = around[:, None].expand(2, *g.shape).clone()
    index = torch.from_numpy(w.column_indices)[:, None].expand(g.views, g.rows, -1)
    whole.scatter_(-1, index.expand(2, *index.shape), inside)
    (found,) = run.images(inside)
    torch.testing.assert_close(found[0], fbp(whole, g, GRID, "standard"), rtol=0, atol=1e-4)
    same = fbp(around[:, None].expand(2, *g.shape), g, GRID, "standard")
    torch.testing.assert_close(static_fbp(around, g, GRID), same, rtol=0, atol=1e-4)


def test_channels_take_batches_kernels_and_motion(spectral, run):
    clean, _, inside, around = spectral
    several = InsetFbp(clean, [GRID], ["soft", "standard"], exterior=around)
    (found,) = several.images(torch.stack([inside, 2 * inside]))
    assert found.shape == (2, 2, 2, *GRID.shape)
    torch.testing.assert_close(found[1, 0], run.images(inside)[0][0])
    still = InsetFbp(
        clean,
        [GRID],
        ["soft", "standard"],
        exterior=around,
        motion=np.zeros((clean.geometry.views, 3)),
    )
    torch.testing.assert_close(
        still.images(torch.stack([inside, 2 * inside]))[0], found, rtol=1e-5, atol=1e-5
    )


def test_refusals(spectral, run):
    clean, _, inside, around = spectral
    beside, w = VolumeGrid((6, 12, 12), 0.4, (0.0, 30.0, 30.0)), clean.window
    spread = torch.zeros(3, w.views, w.rows, w.columns)
    refused(
        ("channels", lambda: run.images(inside[:1])),
        (
            "exterior must have the shape",
            lambda: InsetFbp(clean, [GRID], ["standard"], exterior=around[..., :9]),
        ),
        ("decompose the energy bins, or sum", lambda: InsetFbp(clean, [GRID], ["standard"])),
        ("beyond the region", lambda: InsetFbp(clean, [beside], ["standard"], exterior=around)),
        (
            "ray_covariance",
            lambda: functional_covariance(run, torch.zeros(2, *GRID.shape), torch.zeros(2, 3)),
        ),
        ("functionals", lambda: functional_covariance(run, torch.zeros(2, 3), spread)),
    )


def test_covariance_of_functionals_is_that_of_their_responses(spectral, run):
    """h, the response of a functional to each reading, by differentiating the reconstruction:
    Cov = Σ h h C."""
    clean, _, inside, _ = spectral
    w = clean.window
    functionals = torch.zeros(2, *GRID.shape)
    functionals[0, 3, 6, 6] = 1.0
    functionals[1, 2:4, 4:7, 4:7] = 1.0 / 18
    generator = torch.Generator().manual_seed(0)
    spread = torch.rand(w.views, w.rows, w.columns, generator=generator) + 0.5
    c = torch.stack([4.0 * spread, -1.0 * spread, 0.5 * spread])

    def values(lines):
        return torch.einsum("fzyx,czyx->cf", functionals, run.images(lines)[0][0])

    at = inside.clone().requires_grad_()
    first = values(at)[0]
    h = [torch.autograd.grad(v, at, retain_graph=True)[0][0].double() for v in first]
    noise = torch.randn(inside.shape, generator=generator)
    response = values(inside + noise) - values(inside)
    expected = torch.stack([(a * n).sum() for n in noise.double() for a in h]).reshape(2, 2)
    torch.testing.assert_close(
        response.double(), expected, rtol=1e-3, atol=1e-3 * float(expected.abs().max())
    )
    sums = [[[float((a * b * v).sum()) for v in c.double()] for b in h] for a in h]
    np.testing.assert_allclose(functional_covariance(run, functionals, c), sums, rtol=1e-4)
