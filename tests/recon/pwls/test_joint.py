"""Joint reconstruction of two channels: dense float64 minima, whitening, the vectorial prior, FBP of channels."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from inset_operators import matrix, problem

from recon.fbp.channels import ChannelFbp, static_fbp
from recon.fbp.fbp import fbp
from recon.gram.gram import Gram
from recon.pwls.basis_problem import BasisProblem
from recon.pwls.joint import Whitening, joint_pwls, mean_weights, weigh
from recon.pwls.joint_prior import JointPrior
from recon.pwls.pwls import pwls
from recon.pwls.qggmrf import QGGMRF, quadratic
from torchpcct import VolumeGrid, acquire
from torchpcct.detector_window import shadow
from torchpcct.scanner import presets
from torchpcct.scene import Body, Ellipsoid, EllipticCylinder, Scene
from torchpcct.spectral import SpectralModel, decompose_scan, decompose_surround

EDGE = QGGMRF(0.15, 100.0)


def anisotropic(w, seed=5):
    """2 × 2 information whose two variances and correlation change from ray to ray by tens of per cent."""
    rng = torch.Generator().manual_seed(seed)
    first = w * (1 + 0.3 * torch.rand(w.shape, generator=rng))
    second = w * (1 - 0.3 * torch.rand(w.shape, generator=rng))
    cross = 0.6 * (torch.rand(w.shape, generator=rng) - 0.5) * (first * second).sqrt()
    return torch.stack([first, cross, second])


def tissue(grid):
    _, y, x = np.meshgrid(*(a - c for a, c in zip(grid.axes, grid.center, strict=True)), indexing="ij")
    disc = (np.hypot(y, x - 0.3) < 1.2).astype(float)
    core = (np.hypot(y - 0.4, x) < 0.7).astype(float)
    return torch.from_numpy(np.stack([160 * disc - 60 * core, 300 * disc + 80 * core])).float()


def draw(f, shape, seed):
    """Noise with the covariance F⁻¹ on every ray, ``(*shape, 2, *range)``."""
    f11, f12, f22 = f.double()
    # Cholesky of F = L Lᵀ, noise = L⁻ᵀ n.
    l11 = f11.sqrt()
    l21 = f12 / l11
    l22 = (f22 - l21**2).sqrt()
    n = torch.randn((2, *shape, *f11.shape), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    second = n[1] / l22
    first = (n[0] - l21 * second) / l11
    return torch.stack([first, second], dim=len(shape)).float()


@pytest.fixture(scope="module")
def inset():
    A, w = problem(views=120, shape=(3, 8, 8), rows=6)
    w = w * 1e-4  # of line integrals in HU mm
    f = anisotropic(w)
    y = A(tissue(A.grid)) + draw(f, (), 1)
    return A, f, Gram(A, mean_weights(f)), y


@pytest.fixture(scope="module")
def dense(inset):
    A = inset[0]
    n = math.prod(A.domain_shape)
    return A(torch.eye(n, dtype=torch.float64).reshape(n, *A.domain_shape)).reshape(n, -1).T


def normal_matrix(dense, f):
    """AᵀFA and Aᵀ F as dense float64 matrices of both channels."""
    f11, f12, f22 = (v.double().flatten()[:, None] for v in f)
    rows = [torch.cat([dense.T @ (f11 * dense), dense.T @ (f12 * dense)], 1)]
    rows.append(torch.cat([dense.T @ (f12 * dense), dense.T @ (f22 * dense)], 1))
    return torch.cat(rows)


def reference(dense, f, y, bound, shape):
    """The minimum with dense float64 matrices: majorise and minimise until the steps are below 1e-8 HU."""
    data = y.double().reshape(2, -1)
    weighted = weigh(f.double().reshape(3, -1), data, 1)
    b = torch.cat([dense.T @ weighted[0], dense.T @ weighted[1]])
    H = normal_matrix(dense, f)
    x = torch.zeros_like(b)
    for _ in range(2000):
        at = x.reshape(1, 2, *shape)
        R = matrix(lambda v, at=at: bound.majorizer(at.expand(len(v), -1, -1, -1, -1), v), (2, *shape))
        new = torch.linalg.solve(H + R, b)
        done = float((new - x).abs().max()) < 1e-8
        x = new
        if done:
            break
    assert done
    return x.reshape(2, *shape)


def rms(a, b):
    return float((a.double() - b.double()).square().mean().sqrt())


@pytest.mark.parametrize("prior", [quadratic(0.15), EDGE, QGGMRF(0.5, 30.0, 2.0, 1.2, 6)])
def test_exact_minimum(inset, dense, prior):
    A, f, gram, y = inset
    bound = JointPrior.bind(prior, gram.information(1.0), A.grid.spacing, 1.0)
    x = reference(dense, f, y, bound, A.domain_shape)
    result = joint_pwls(y, f, A, prior, gram=gram, tolerance=0.02)
    assert result.report["converged"]
    assert result.x.shape == (2, *A.domain_shape)
    assert rms(result.x, x) < 0.06
    assert result.report["gradient"][-1] < 1e-3
    # float64 takes it to the digits of the reference.
    fine = joint_pwls(y.double(), f.double(), A, prior, gram=gram, tolerance=1e-6, max_exact=80)
    assert fine.x.dtype == torch.float64
    assert rms(fine.x, x) < 1e-5


def test_certificate_is_the_gradient_of_the_objective(inset):
    A, f, gram, y = inset
    bound = JointPrior.bind(EDGE, gram.information(1.0), A.grid.spacing, 1.0)

    def gradient(x):
        x = x.detach().double().requires_grad_()
        r = y.double() - A(x)
        value = 0.5 * (r * weigh(f.double(), r, 3)).sum() + bound.value(x)
        return torch.autograd.grad(value, x)[0].norm()

    result = joint_pwls(y, f, A, EDGE, gram=gram, tolerance=0.5)
    measured = float(gradient(result.x) / gradient(torch.zeros(2, *A.domain_shape)))
    assert measured == pytest.approx(result.report["gradient"][-1], rel=0.02)


def test_correlation_that_changes_from_ray_to_ray_is_information():
    """Where the sign of the correlation alternates, the cross terms hold 81 % of the variance (separate: 1 / 0.19)."""
    A, w = problem(views=60, shape=(3, 8, 8), rows=6)
    w = w * 1e-5
    sign = torch.where(torch.arange(60) % 2 == 0, 1.0, -1.0)[:, None, None]
    f = torch.stack([w, 0.9 * sign * w, w])
    truth = tissue(A.grid)
    y = A(truth) + draw(f, (6,), 3)
    weak = quadratic(0.02)
    joint = joint_pwls(y, f, A, weak, tolerance=0.2, max_exact=60).x
    alone = pwls(y, w * (1 - 0.81), A, weak, hu=1.0, tolerance=0.2, max_exact=60).x
    clean = A(truth).expand_as(y)
    scatter = rms(joint, joint_pwls(clean[0], f, A, weak, tolerance=0.2, max_exact=60).x.expand_as(joint))
    apart = rms(alone, pwls(clean[0], w * (1 - 0.81), A, weak, hu=1.0, tolerance=0.2, max_exact=60).x.expand_as(alone))
    assert scatter == pytest.approx(math.sqrt(0.19) * apart, rel=0.15)


def test_equal_uncorrelated_channels_are_two_scalar_problems(inset):
    A, f, _, y = inset
    w = mean_weights(f)
    isotropic = torch.stack([w, torch.zeros_like(w), w])
    gram = Gram(A, w)
    joint = joint_pwls(y, isotropic, A, quadratic(0.15), gram=gram, tolerance=0.02)
    alone = pwls(y, w, A, quadratic(0.15), hu=1.0, gram=gram, tolerance=0.02)
    assert rms(joint.x, alone.x) < 0.05


def test_lost_rays_may_hold_anything(inset):
    A, f, _, y = inset
    lost = torch.rand(A.range_shape, generator=torch.Generator().manual_seed(4)) < 0.1
    f = torch.where(lost, torch.zeros(()), f)
    result = joint_pwls(torch.where(lost, torch.nan, y), f, A, EDGE, tolerance=0.1, max_exact=40)
    assert result.report["converged"]
    bound = JointPrior.bind(EDGE, Gram(A, mean_weights(f)).information(1.0), A.grid.spacing, 1.0)
    full = joint_pwls(torch.where(lost, torch.zeros(()), y), f, A, bound, tolerance=0.1, max_exact=40)
    assert rms(result.x, full.x) < 0.3


# -- whitening --------------------------------------------------------------------------------------------------------


def test_whitening_makes_noise_equal_and_uncorrelated():
    f = np.array([0.011, 0.31, 11.2])
    gain = np.array([900.0, 4000.0])
    w = Whitening.of(f, gain)
    covariance = np.linalg.inv([[f[0], f[1]], [f[1], f[2]]])
    mixed = w.forward @ covariance @ w.forward.T
    np.testing.assert_allclose(mixed, np.eye(2) * (gain @ covariance @ gain), rtol=1e-9, atol=1e-6 * mixed[0, 0])
    np.testing.assert_allclose(w.forward[0], gain)
    x = torch.rand(4, 2, 2, 3, 5, dtype=torch.float64)
    torch.testing.assert_close(w.undo(w.apply(x)), x)
    # Information follows the congruence, here of a tensor of rays.
    packed = torch.from_numpy(f).reshape(3, 1, 1).expand(3, 4, 5)
    white = w.information(packed)
    np.testing.assert_allclose(white[:, 0, 0], np.array([1, 0, 1]) / (gain @ covariance @ gain), atol=1e-12)


def test_whitening_refuses():
    with pytest.raises(ValueError, match="positive definite"):
        Whitening.of((1.0, 2.0, 1.0), (1.0, 0.0))
    with pytest.raises(ValueError, match="gain"):
        Whitening.of((1.0, 0.0, 1.0), (0.0, 0.0))
    with pytest.raises(ValueError, match="two channels"):
        Whitening.of((1.0, 0.0, 1.0), (1.0, 0.0)).apply(torch.zeros(3, 2, 2, 2))


# -- prior ------------------------------------------------------------------------------------------------------------


PRIORS = [quadratic(1.0), EDGE, QGGMRF(1.0, 50.0, 1.8, 1.1), QGGMRF(1.0, 50.0, 2.0, 1.3, 6)]


@pytest.mark.parametrize("prior", PRIORS)
@pytest.mark.parametrize("shape", [(3, 4, 5), (5, 6)])
def test_prior_kernels_are_the_gradient_of_the_value(prior, shape):
    bound = JointPrior.bind(prior, 0.01, (0.5, 0.4, 0.3)[-len(shape) :], 1.0)
    generator = torch.Generator().manual_seed(1)
    x, v, u = (100 * torch.randn(2, 2, *shape, generator=generator, dtype=torch.float64) for _ in range(3))
    at = x.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(bound.value(at).sum(), at)
    torch.testing.assert_close(bound.gradient(x), gradient)
    torch.testing.assert_close(bound.majorizer(x, v), bound._plain_majorizer(x, v))
    pull, bend = bound.along(x, v, u)
    axes = tuple(range(-len(shape) - 1, 0))
    torch.testing.assert_close(pull, (v * gradient).sum(axes))
    torch.testing.assert_close(bend, (v * bound._plain_majorizer(x, u)).sum(axes))


def test_prior_turns_with_the_channels():
    """Only the length of the difference counts: a rotation of the channels changes nothing."""
    bound = JointPrior.bind(EDGE, 0.01, (0.5, 0.5, 0.5), 1.0)
    x = 100 * torch.randn(2, 4, 5, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    c, s = math.cos(0.7), math.sin(0.7)
    turned = torch.stack([c * x[0] - s * x[1], s * x[0] + c * x[1]])
    torch.testing.assert_close(bound.value(turned), bound.value(x))
    one = torch.stack([x[0], torch.zeros_like(x[0])])
    scalar = EDGE.bind(0.01, (0.5, 0.5, 0.5), 1.0)
    torch.testing.assert_close(bound.value(one), scalar.value(x[0]))
    torch.testing.assert_close(bound.gradient(one)[0], scalar.gradient(x[0]))


def test_prior_spectrum_is_its_periodic_curvature():
    bound = JointPrior.bind(quadratic(1.0), 0.01, (0.5, 0.5), 1.0)
    spectrum = bound.spectrum((2, 8, 8))
    scalar = quadratic(1.0).bind(0.01, (0.5, 0.5), 1.0).spectrum((8, 8))
    torch.testing.assert_close(spectrum, scalar.expand(2, -1, -1))


def test_prior_refuses_bad_spacing():
    with pytest.raises(ValueError, match="spacing"):
        JointPrior(1.0, 1.0, 2.0, 1.0, 26, (0.5, 0.5, 0.5, 0.5), 1.0)


def test_refusals(inset):
    A, f, gram, y = inset
    with pytest.raises(TypeError, match="information"):
        joint_pwls(y, f.int(), A, EDGE)
    with pytest.raises(ValueError, match="shape"):
        joint_pwls(y, f[:2], A, EDGE)
    with pytest.raises(ValueError, match="semi-definite"):
        joint_pwls(y, torch.stack([f[0], 2 * f[2], f[2]]), A, EDGE)
    with pytest.raises(ValueError, match="finite"):
        joint_pwls(y, f * torch.nan, A, EDGE)
    with pytest.raises(ValueError, match="all information is 0"):
        joint_pwls(y, 0 * f, A, EDGE)
    with pytest.raises(TypeError, match="y must"):
        joint_pwls(y.int(), f, A, EDGE, gram=gram)
    with pytest.raises(ValueError, match="y must have the shape"):
        joint_pwls(y[:1], f, A, EDGE, gram=gram)
    with pytest.raises(ValueError, match="NaN or Inf"):
        joint_pwls(y * torch.inf, f, A, EDGE, gram=gram)


# -- FBP of channels and the whole chain ------------------------------------------------------------------------------

CENTER = (0.0, -30.38, -29.63)
GRID = VolumeGrid((6, 16, 16), 0.4, CENTER)
BALL = Ellipsoid((1.6, 1.6, 0.9), position=CENTER[::-1])
SCENE = Scene(
    [Body("patient", EllipticCylinder(120.0), "pericoronary_fat"), Body("ball", BALL, "fibrous_tissue", "patient")]
)


@pytest.fixture(scope="module")
def scan():
    scanner = presets.pcct(views=120, mode="spectral")
    scanner = scanner.replace(geometry=replace(scanner.geometry, rows=10))
    clean = acquire(SCENE, scanner, region=GRID, duty=0.06, sub_rays=16)
    return clean, SpectralModel.of(scanner, 1.0)


@pytest.fixture(scope="module")
def lines(scan):
    clean, model = scan
    return decompose_scan(clean, model).line_integrals, decompose_surround(clean, model)


def test_channel_fbp_is_the_fbp_of_the_whole_rows(scan, lines):
    clean, _ = scan
    inside, around = lines
    g, w = clean.geometry, clean.window
    whole = around[:, None].expand(2, *g.shape).clone()
    index = torch.from_numpy(w.column_indices)[:, None].expand(g.views, g.rows, -1)
    whole.scatter_(-1, index.expand(2, *index.shape), inside)
    exact = fbp(whole, g, GRID, "standard")
    found = ChannelFbp(g, w, around, GRID)
    torch.testing.assert_close(found(inside), exact, rtol=0, atol=1e-4)
    torch.testing.assert_close(found(inside[None]).squeeze(0), found(inside))
    same = fbp(around[:, None].expand(2, *g.shape), g, GRID, "standard")
    torch.testing.assert_close(static_fbp(around, g, GRID), same, rtol=0, atol=1e-4)
    torch.testing.assert_close(found.background, same, rtol=0, atol=1e-4)
    with pytest.raises(ValueError, match="channels"):
        found(inside[:1])
    with pytest.raises(ValueError, match="surround"):
        ChannelFbp(g, w, around[..., :9], GRID)
    with pytest.raises(ValueError, match="beyond the window"):
        ChannelFbp(g, shadow(g, GRID), around, GRID)


def test_covariance_of_functionals_is_that_of_draws(scan, lines):
    clean, _ = scan
    g, w = clean.geometry, clean.window
    images = ChannelFbp(g, w, lines[1], GRID)
    functionals = torch.zeros(2, *GRID.shape)
    functionals[0, 3, 8, 8] = 1.0
    functionals[1, 2:4, 6:9, 6:9] = 1.0 / 18
    spread = torch.rand(w.views, w.rows, w.columns, generator=torch.Generator().manual_seed(0)) + 0.5
    c = torch.stack([4.0 * spread, -1.0 * spread, 0.5 * spread])
    exact = images.covariance(functionals, c)
    f11, f12, f22 = c
    det = f11 * f22 - f12**2
    noise = draw(torch.stack([f22, -f12, f11]) / det, (60,), 6)
    clean_images = images(lines[0])
    draws = torch.stack([images(lines[0] + n) - clean_images for n in noise])
    values = torch.einsum("fzyx,nczyx->fcn", functionals, draws).double()
    for i in range(2):
        found = torch.cov(values[i]).numpy()[(0, 0, 1), (0, 1, 1)]
        # Sampling error of a variance from 60 draws: 18 %.
        np.testing.assert_allclose(found, exact[i, i], rtol=0.5)
    assert exact[0, 1] == pytest.approx(exact[1, 0])
    with pytest.raises(ValueError, match="ray_covariance"):
        images.covariance(functionals, c[:, 1:])
    with pytest.raises(ValueError, match="functionals"):
        images.covariance(functionals[:, 1:], c)


def test_basis_images_of_a_ball(scan, lines):
    clean, model = scan
    problem = BasisProblem(clean, model, GRID)
    assert problem.anisotropy < 0.1
    images, report = problem.solve(lines[0], clean.window, QGGMRF(1e-3, 300.0), dose=2.0, tolerance=0.2)
    assert report["converged"]
    assert images.shape == (2, *GRID.shape)
    reference = ChannelFbp(clean.geometry, clean.window, lines[1], GRID, "soft")(lines[0])
    white, fbp_white = (problem.whitening.apply(v) for v in (images, reference))
    for place in ((slice(2, 4), slice(7, 9), slice(7, 9)), (slice(2, 4), slice(0, 2), slice(0, 2))):
        middle = (slice(None), *place)
        # HU at 52 keV, and the second channel in units of equal noise
        assert float((white[middle] - fbp_white[middle]).mean((1, 2, 3)).abs().max()) < 8
    with pytest.raises(ValueError, match="dose"):
        problem.solve(lines[0], clean.window, dose=0.0)
