"""Exact ROI means of linear reconstructions: dense matrices, draws, and methods that are not linear."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from inset_operators import HU, matrix, problem, tissue

from recon.fbp.exact_noise import line_integral_variance
from recon.gram.gram import Gram
from recon.mbir.mbir import Mbir
from recon.mbir.network import NetworkConfig
from recon.mbir.unrolled import Unrolled
from recon.pwls.qggmrf import QGGMRF, quadratic
from recon.study.dose_factor.exact_linear import exact_linear, statistic_covariance
from recon.study.dose_factor.methods import LinearFilter, Penalised

SHAPE = (6, 8, 8)
DOSE = 0.5


@pytest.fixture(scope="module")
def inset():
    """A small inset in double precision, with the attributes of an InsetProblem that methods ask for."""
    A, w = problem(shape=SHAPE, rows=10, dtype=torch.float64)
    gram = Gram(A, w, nodes=1)
    p = SimpleNamespace(gram=gram, grid=A.grid, mu_ref=1000 * HU, level=-0.1 * 1000 * HU, projector=A, _weights=w)
    return p, gram.apply(tissue(A.grid).double()) * DOSE


@pytest.fixture(scope="module")
def rois():
    """A small ball, a voxel, a plane's worth of the rest."""
    weights = torch.zeros(3, *SHAPE, dtype=torch.float64)
    weights[0, 2:4, 3:5, 3:5] = 1 / 8
    weights[1, 3, 1, 6] = 1.0
    weights[2, 1] = 1 / 64
    return [SimpleNamespace(weights=w) for w in weights]


def network(**parts):
    """Random weights; without its steps it is linear, and not symmetric."""
    torch.manual_seed(1)
    model = Unrolled(NetworkConfig((6, 8, 8), 0.4), 2)
    torch.nn.init.normal_(model.network.leave.weight, std=0.02)
    return Mbir(model.double(), **parts)


def dense(method, p):
    """M of x̂ = M b + x₀, by columns, ``(voxels, voxels)``."""
    n = math.prod(SHAPE)
    size = 1e-2 / HU  # of b, so that a tolerance in HU does not count
    eye = size * torch.eye(n, dtype=torch.float64).reshape(n, *SHAPE)
    parts = [method(p, block, DOSE) for block in eye.split(128)]
    zero = method(p, torch.zeros_like(eye[:1]), DOSE)
    return ((torch.cat(parts) - zero).reshape(n, n) / size).T, zero.reshape(n)


@pytest.mark.parametrize(
    ("make", "kind"),
    [
        (lambda b: LinearFilter(steps=40), "solve"),
        (lambda b: LinearFilter("along", mu=0.25, along=25.0, steps=40), "auto"),
        (lambda b: network(steps=0), "vjp"),
        (lambda b: network(steps=0, last_word=False), "auto"),
    ],
)
def test_against_dense_matrices(inset, rois, make, kind):
    p, b = inset
    method = make(b)
    found = exact_linear(method, p, rois, b, DOSE, adjoint=kind)
    M, offset = dense(method, p)
    r = torch.stack([roi.weights.reshape(-1) for roi in rois])
    expected = r @ M
    g = found.adjoints.reshape(3, -1)
    assert float((g - expected).norm() / expected.norm()) < 2e-4
    np.testing.assert_allclose(found.offset_hu, (r @ offset).numpy(), atol=1e-9)
    direct = r @ (M @ b.reshape(-1) + offset)
    np.testing.assert_allclose(found.means(b), direct.numpy(), atol=0.02)
    np.testing.assert_allclose(found.response(0.1 * b), 0.1 * (direct - r @ offset).numpy(), atol=2e-3)
    covariance = DOSE * expected @ matrix(p.gram.apply, SHAPE) @ expected.T
    np.testing.assert_allclose(found.covariance(p), covariance.numpy(), rtol=1e-3, atol=1e-3 * float(covariance.max()))


def test_quadratic_pwls(inset, rois):
    """A solve that stops early, against (G + Q)⁻¹; one that stops far too early is refused."""
    p, b = inset
    method = Penalised("quadratic", quadratic(0.25), tolerance=0.02)
    found = exact_linear(method, p, rois, b, DOSE)
    gram = p.gram.scaled(DOSE)
    bound = method.prior.bind(gram.information(HU), p.grid.spacing, HU)
    H = matrix(gram.apply, SHAPE) + matrix(bound.gradient, SHAPE)
    r = torch.stack([roi.weights.reshape(-1) for roi in rois])
    expected = torch.linalg.solve(H, r.T).T / HU
    g = found.adjoints.reshape(3, -1)
    assert float((g - expected).norm() / expected.norm()) < 1e-4
    with pytest.raises(ValueError, match=r"not linear|no adjoint"):
        exact_linear(Penalised("quadratic", quadratic(0.25), tolerance=3.0), p, rois, b, DOSE, adjoint="solve")


def test_draws_have_the_covariance(inset, rois):
    """400 draws of Gram noise: sample covariance within its sampling error; g·b is the reconstruction's ROI mean."""
    p, b = inset
    method = network(steps=0)
    found = exact_linear(method, p, rois, b, DOSE)
    noise = p.gram.scaled(DOSE).noise((400,), generator=torch.Generator().manual_seed(5)).double()
    volumes = torch.cat([method(p, (b + part), DOSE) for part in noise.split(100)])
    means = torch.stack([(volumes * roi.weights).sum((1, 2, 3)) for roi in rois], 1).numpy()
    np.testing.assert_allclose(found.means(b + noise), means, atol=1e-3)
    exact = found.covariance(p)
    sd = np.sqrt(np.diag(exact))
    # A correlation's standard error is below 1/√n, a variance's √(2/n) of it.
    np.testing.assert_allclose(np.cov(means.T) / np.outer(sd, sd), exact / np.outer(sd, sd), atol=3.5 * 2**0.5 / 20)


def test_noise_of_the_readings(clean, problem):
    """Weights of the background, variances of the whole scan: AᵀW V W A by matrices, and by drawing readings."""
    g = torch.zeros((2, *problem.grid.shape), dtype=torch.float64)
    g[0, 3:5, 8:10, 8:10], g[1, 4, 3, 3] = 1.0, 1.0
    found = statistic_covariance(problem, g, 2.0, clean)
    V = line_integral_variance(clean.crop(problem.window), 2.0).double()
    W = 2.0 * problem.weights.double()
    expected = [[float((W * problem.projector(a.float()) * V * W * problem.projector(c.float())).sum()) for c in g]
                for a in g]  # fmt: skip
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    b = np.array([[float((problem.statistic(clean.with_noise(2.0, k)).b * v).sum()) for v in g] for k in range(60)])
    assert np.sqrt(b.var(0, ddof=1)) == pytest.approx(np.sqrt(np.diag(found)), rel=0.3)
    # The ball's own shadow is darker than the background: the weights promise a little less noise than there is.
    assumed = statistic_covariance(problem, g, 2.0)
    assert 1.0 < found[0, 0] / assumed[0, 0] < 1.1
    with pytest.raises(ValueError, match="another geometry or window"):
        statistic_covariance(problem, g, 2.0, clean.crop(problem.window))


def test_what_is_not_linear_is_refused(inset, rois):
    p, b = inset
    with pytest.raises(ValueError, match="not linear"):
        exact_linear(Penalised("qggmrf", QGGMRF(0.3, 300.0), tolerance=0.05), p, rois, b, DOSE)
    with pytest.raises(ValueError, match="not linear"):
        exact_linear(network(), p, rois, b, DOSE)
    with pytest.raises(ValueError, match="no adjoint"):
        exact_linear(network(steps=0), p, rois, b, DOSE, adjoint="solve")
