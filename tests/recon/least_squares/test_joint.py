"""Two channels: joint reconstruction against dense float64 minima, its hard cases, whitening,
basis images."""

import math

import inset_operators
import numpy as np
import pytest
import torch
from inset_operators import minimum, problem
from refusals import refused
from small_scan import SPECTRAL_GRID as GRID

from recon.analytic.inset import InsetFbp
from recon.gram.gram import Gram
from recon.least_squares.basis_problem import BasisProblem, Whitening
from recon.least_squares.pwls import mean_weights, pwls, weigh
from recon.least_squares.qggmrf import QGGMRF, quadratic

EDGE = QGGMRF(0.15, 100.0)


def anisotropic(w, seed=5):
    """2 × 2 information whose two variances and correlation change from ray to ray by tens of
    per cent."""
    rng = torch.Generator().manual_seed(seed)
    first = w * (1 + 0.3 * torch.rand(w.shape, generator=rng))
    second = w * (1 - 0.3 * torch.rand(w.shape, generator=rng))
    cross = 0.6 * (torch.rand(w.shape, generator=rng) - 0.5) * (first * second).sqrt()
    return torch.stack([first, cross, second])


def tissue(grid):
    _, y, x = np.meshgrid(
        *(a - c for a, c in zip(grid.axes, grid.center, strict=True)), indexing="ij"
    )
    disc = (np.hypot(y, x - 0.3) < 1.2).astype(float)
    core = (np.hypot(y - 0.4, x) < 0.7).astype(float)
    return torch.from_numpy(np.stack([160 * disc - 60 * core, 300 * disc + 80 * core])).float()


def correlated_noise(f, shape, seed):
    """Noise with the covariance F⁻¹ on every ray, ``(*shape, 2, *range)``."""
    f11, f12, f22 = f.double()
    # Cholesky of F = L Lᵀ, noise = L⁻ᵀ n.
    l11 = f11.sqrt()
    l21 = f12 / l11
    l22 = (f22 - l21**2).sqrt()
    n = torch.randn(
        (2, *shape, *f11.shape), generator=torch.Generator().manual_seed(seed), dtype=torch.float64
    )
    second = n[1] / l22
    first = (n[0] - l21 * second) / l11
    return torch.stack([first, second], dim=len(shape)).float()


@pytest.fixture(scope="module")
def inset():
    A, w = problem(views=40, shape=(3, 8, 8), rows=6)
    w = w * 1e-4  # of line integrals in HU mm
    f = anisotropic(w)
    y = A(tissue(A.grid)) + correlated_noise(f, (), 1)
    return A, f, Gram(A, mean_weights(f)), y


@pytest.fixture(scope="module")
def dense(inset):
    return inset_operators.dense(inset[0])


def normal_matrix(dense, f):
    """AᵀFA and Aᵀ F as dense float64 matrices of both channels."""
    f11, f12, f22 = (v.double().flatten()[:, None] for v in f)
    rows = [torch.cat([dense.T @ (f11 * dense), dense.T @ (f12 * dense)], 1)]
    rows.append(torch.cat([dense.T @ (f12 * dense), dense.T @ (f22 * dense)], 1))
    return torch.cat(rows)


def reference(dense, f, y, bound, shape, start):
    """The minimum with dense float64 matrices, to 1e-8 HU."""
    weighted = weigh(f.double().reshape(3, -1), y.double().reshape(2, -1), 1)
    b = torch.cat([dense.T @ weighted[0], dense.T @ weighted[1]])
    return minimum(normal_matrix(dense, f), b, bound, (2, *shape), 1e-8, start)


def rms(a, b):
    return float((a.double() - b.double()).square().mean().sqrt())


@pytest.mark.parametrize("prior", [quadratic(0.15), EDGE, QGGMRF(0.5, 30.0, 2.0, 1.2, 6)])
def test_exact_minimum(inset, dense, prior):
    A, f, gram, y = inset
    bound = prior.bind(gram.information(1.0), A.grid.spacing, 1.0, channels=True)
    fine = pwls(
        A, y.double(), f.double(), prior, mu_per_hu=1.0, gram=gram, tolerance=1e-6, max_exact=80
    )
    x = reference(dense, f, y, bound, A.domain_shape, fine.volume)
    result = pwls(A, y, f, prior, mu_per_hu=1.0, gram=gram, tolerance=0.02)
    assert result.report["converged"]
    assert result.volume.shape == (2, *A.domain_shape)
    assert rms(result.volume, x) < 0.06
    assert result.report["gradient"][-1] < 1e-3
    # float64 takes it to the digits of the reference.
    assert fine.volume.dtype == torch.float64
    assert rms(fine.volume, x) < 1e-5


def test_certificate_is_the_gradient_of_the_objective(inset):
    A, f, gram, y = inset
    bound = EDGE.bind(gram.information(1.0), A.grid.spacing, 1.0, channels=True)

    def gradient(x):
        x = x.detach().double().requires_grad_()
        r = y.double() - A(x)
        value = 0.5 * (r * weigh(f.double(), r, 3)).sum() + bound.value(x)
        return torch.autograd.grad(value, x)[0].norm()

    result = pwls(A, y, f, EDGE, mu_per_hu=1.0, gram=gram, tolerance=0.5)
    measured = float(gradient(result.volume) / gradient(torch.zeros(2, *A.domain_shape)))
    assert measured == pytest.approx(result.report["gradient"][-1], rel=0.02)


def test_correlation_that_changes_from_ray_to_ray_is_information():
    """Where the sign of the correlation alternates, the cross terms hold 81 % of the variance
    (separate: 1 / 0.19)."""
    A, w = problem(views=60, shape=(3, 8, 8), rows=6)
    w = w * 1e-5
    sign = torch.where(torch.arange(60) % 2 == 0, 1.0, -1.0)[:, None, None]
    f = torch.stack([w, 0.9 * sign * w, w])
    truth = tissue(A.grid)
    y = A(truth) + correlated_noise(f, (6,), 3)
    weak = quadratic(0.02)
    joint = pwls(A, y, f, weak, mu_per_hu=1.0, tolerance=0.2, max_exact=60).volume
    alone = pwls(A, y, w * (1 - 0.81), weak, mu_per_hu=1.0, tolerance=0.2, max_exact=60).volume
    clean = A(truth).expand_as(y)
    scatter = rms(
        joint,
        pwls(A, clean[0], f, weak, mu_per_hu=1.0, tolerance=0.2, max_exact=60).volume.expand_as(
            joint
        ),
    )
    apart = rms(
        alone,
        pwls(
            A, clean[0], w * (1 - 0.81), weak, mu_per_hu=1.0, tolerance=0.2, max_exact=60
        ).volume.expand_as(alone),
    )
    assert scatter == pytest.approx(math.sqrt(0.19) * apart, rel=0.15)


def test_lost_rays_may_hold_anything(inset):
    A, f, _, y = inset
    lost = torch.rand(A.range_shape, generator=torch.Generator().manual_seed(4)) < 0.1
    f = torch.where(lost, torch.zeros(()), f)
    result = pwls(
        A, torch.where(lost, torch.nan, y), f, EDGE, mu_per_hu=1.0, tolerance=0.1, max_exact=40
    )
    assert result.report["converged"]
    bound = EDGE.bind(Gram(A, mean_weights(f)).information(1.0), A.grid.spacing, 1.0, channels=True)
    full = pwls(
        A,
        torch.where(lost, torch.zeros(()), y),
        f,
        bound,
        mu_per_hu=1.0,
        tolerance=0.1,
        max_exact=40,
    )
    assert rms(result.volume, full.volume) < 0.3


def test_refusals(inset):
    A, f, gram, y = inset
    refused(
        ("information", lambda: pwls(A, y, f.int(), EDGE, mu_per_hu=1.0)),
        ("shape", lambda: pwls(A, y, f[:2], EDGE, mu_per_hu=1.0)),
        (
            "semi-definite",
            lambda: pwls(A, y, torch.stack([f[0], 2 * f[2], f[2]]), EDGE, mu_per_hu=1.0),
        ),
        ("finite", lambda: pwls(A, y, f * torch.nan, EDGE, mu_per_hu=1.0)),
        ("all information is 0", lambda: pwls(A, y, 0 * f, EDGE, mu_per_hu=1.0)),
        ("y must", lambda: pwls(A, y.int(), f, EDGE, mu_per_hu=1.0, gram=gram)),
        ("y must have the shape", lambda: pwls(A, y[:1], f, EDGE, mu_per_hu=1.0, gram=gram)),
        ("NaN or Inf", lambda: pwls(A, y * torch.inf, f, EDGE, mu_per_hu=1.0, gram=gram)),
    )


def test_whitening_makes_noise_equal_and_uncorrelated():
    f = np.array([0.011, 0.31, 11.2])
    gain = np.array([900.0, 4000.0])
    w = Whitening.of(f, gain)
    covariance = np.linalg.inv([[f[0], f[1]], [f[1], f[2]]])
    mixed = w.forward @ covariance @ w.forward.T
    np.testing.assert_allclose(
        mixed, np.eye(2) * (gain @ covariance @ gain), rtol=1e-9, atol=1e-6 * mixed[0, 0]
    )
    np.testing.assert_allclose(w.forward[0], gain)
    x = torch.rand(4, 2, 2, 3, 5, dtype=torch.float64)
    torch.testing.assert_close(w.undo(w.apply(x)), x)
    # Information follows the congruence, here of a tensor of rays.
    packed = torch.from_numpy(f).reshape(3, 1, 1).expand(3, 4, 5)
    white = w.information(packed)
    np.testing.assert_allclose(
        white[:, 0, 0], np.array([1, 0, 1]) / (gain @ covariance @ gain), atol=1e-12
    )


def test_whitening_refuses():
    refused(
        ("positive definite", lambda: Whitening.of((1.0, 2.0, 1.0), (1.0, 0.0))),
        ("gain", lambda: Whitening.of((1.0, 0.0, 1.0), (0.0, 0.0))),
        (
            "two channels",
            lambda: Whitening.of((1.0, 0.0, 1.0), (1.0, 0.0)).apply(torch.zeros(3, 2, 2, 2)),
        ),
    )


def test_basis_images_of_a_ball(spectral):
    clean, model, lines, around = spectral
    basis = BasisProblem(clean, model, GRID)
    assert basis.anisotropy < 0.1
    images, report = basis.solve(lines, clean.window, QGGMRF(1e-3, 300.0), dose=2.0, tolerance=0.2)
    assert report["converged"]
    assert images.shape == (2, *GRID.shape)
    reference = InsetFbp(clean, [GRID], ["soft"], exterior=around).images(lines)[0][0]
    white, fbp_white = (basis.whitening.apply(v) for v in (images, reference))
    for place in ((slice(2, 4), slice(5, 7), slice(5, 7)), (slice(2, 4), slice(0, 2), slice(0, 2))):
        middle = (slice(None), *place)
        # HU at 52 keV, and the second channel in units of equal noise
        assert float((white[middle] - fbp_white[middle]).mean((1, 2, 3)).abs().max()) < 8
    with pytest.raises(ValueError, match="dose"):
        basis.solve(lines, clean.window, dose=0.0)
